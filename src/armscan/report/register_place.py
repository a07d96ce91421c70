# SPDX-License-Identifier: Apache-2.0
"""What is said of an arm that moved to a new place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.registration import carried_covariance_mm2, spread_mm
from armscan.pipeline.register import PlaceRegistration
from armscan.report.numbers import significant, with_sigma
from armscan.report.page import Card
from armscan.report.register_figures import MarkerScene, marker_view, residual_chart
from armscan.report.register_page import RegisterReport
from armscan.report.register_request import NamedCloud
from armscan.report.summary import Table
from armscan.storage.calibration_bodies import triple
from armscan.storage.marker_files import MarkerList
from armscan.storage.registration_files import MovedBody, ResidualBody, transform_body

UNLIKELY = 1e-3
WEAK_SHARE = 0.05


def place_report(
    old: MarkerList,
    new: MarkerList,
    place: PlaceRegistration,
    carried: Sequence[NamedCloud],
) -> RegisterReport:
    """Describe the registration; ``carried`` are the new clouds in the old frame."""
    frame = old.markers.frame
    used = place.residual_mm[place.is_used]
    rms = float(np.sqrt((used**2).sum(axis=1).mean()))
    at_markers = added_sigma_mm(new.markers.points_mm[place.pairs[:, 1]], place)
    n, n_pairs = int(place.is_used.sum()), len(place.pairs)
    of = f"of {len(old.markers)} old and {len(new.markers)} new"
    name = new.path.stem
    clouds = ", ".join(item.name for item in carried) or None
    return RegisterReport(
        title="The arm's new place in its old frame",
        subtitle=f"{new.path.name} carried to the frame {frame} of {old.path.name}",
        common_frame=frame,
        common_frame_of=old.path.as_posix(),
        cards=(
            Card("Common markers", str(n), of),
            Card("Residuals", significant(rms, "mm"), "root mean square, three axes together"),
            Card(
                "Uncertainty at the markers",
                significant(at_markers, "mm"),
                "one standard deviation, three axes together; common to all points",
            ),
            Card("Moved markers", str(len(place.moved)), "named below" if place.moved else "none"),
        ),
        facts=_facts(place, of, rms, at_markers),
        scans=_scan_table(place, carried, at_markers),
        residuals_table=_residual_table(old, new, place),
        pictures=(
            marker_view(_scene(old, new, place, carried)),
            residual_chart(
                np.linalg.norm(place.residual_mm, axis=1), _expected(old, new, place), place.is_used
            ),
        ),
        warnings=_warnings(old, new, place),
        transforms=(
            transform_body(
                name,
                new.path,
                new.markers.frame,
                place.fit.value,
                place.fit.covariance,
                n_markers=n,
                rms_mm=rms,
                cloud=clouds,
            ),
        ),
        residuals=tuple(
            ResidualBody(
                name=name,
                id=int(new.markers.ids[k]),
                common_id=int(old.markers.ids[i]),
                residual_mm=triple(residual),
                is_used=bool(is_used),
            )
            for (i, k), residual, is_used in zip(
                place.pairs, place.residual_mm, place.is_used, strict=True
            )
        ),
        moved=tuple(
            MovedBody(id=item.new_id, common_id=item.old_id, offset_mm=triple(item.offset_mm))
            for item in place.moved
        ),
        not_joined=(),
        chi2=place.fit.chi2,
        degrees_of_freedom=place.fit.degrees_of_freedom,
        data=_data(place, rms, at_markers, n, n_pairs),
    )


def added_sigma_mm(points_mm: FloatArray, place: PlaceRegistration) -> float:
    """Root mean square uncertainty that the registration adds to (N, 3) points of the new frame."""
    none = np.zeros((len(points_mm), 3, 3))
    added = carried_covariance_mm2(points_mm, none, place.fit.value, place.fit.covariance)
    return float(np.sqrt(np.trace(added, axis1=1, axis2=2).mean()))


def _facts(
    place: PlaceRegistration, of: str, rms: float, at_markers: float
) -> tuple[tuple[str, str], ...]:
    pose, sigma = place.fit.value, place.fit.sigma
    shift = [with_sigma(value, s) for value, s in zip(pose.translation_mm, sigma[3:], strict=True)]
    turn = np.degrees(pose.rotation_vector_rad)
    tilt = ", ".join(with_sigma(v, s) for v, s in zip(turn, np.degrees(sigma[:3]), strict=True))
    rival = (
        "given by their ids"
        if place.n_rival < 0
        else f"found by distances; no other way explains more than {max(place.n_rival, 3)}"
    )
    return (
        ("common markers", f"{int(place.is_used.sum())} {of}, {rival}"),
        ("residuals", f"{significant(rms, 'mm')} rms, three axes together"),
        ("uncertainty", f"{significant(at_markers, 'mm')} at the markers, common to all points"),
        ("translation", f"{', '.join(shift)} mm"),
        ("rotation vector", f"{tilt} degrees"),
    )


def _scan_table(
    place: PlaceRegistration, carried: Sequence[NamedCloud], at_markers: float
) -> Table:
    rows = [("markers", f"{int(place.is_used.sum())}", significant(at_markers))]
    for item in carried:
        original = place.fit.value.inverse()
        points = item.cloud.points_mm @ original.rotation.T + original.translation_mm
        rows.append((item.name, f"{len(points):,}", significant(added_sigma_mm(points, place))))
    return Table(("carried", "points", "uncertainty added, mm"), tuple(rows))


def _residual_table(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> Table:
    length = np.linalg.norm(place.residual_mm, axis=1)
    rows: list[tuple[str, ...]] = []
    for row in np.argsort(-length):
        i, k = place.pairs[row]
        x, y, z = place.residual_mm[row]
        rows.append(
            (
                str(int(old.markers.ids[i])),
                str(int(new.markers.ids[k])),
                f"{x:+.4f}",
                f"{y:+.4f}",
                f"{z:+.4f}",
                f"{length[row]:.4f}",
                "" if place.is_used[row] else "moved, left out",
            )
        )
    matched = {int(n) for n in old.markers.ids[place.pairs[:, 0]]}
    for item in place.moved:
        if item.old_id not in matched:
            x, y, z = -item.offset_mm
            length_mm = float(np.linalg.norm(item.offset_mm))
            rows.insert(
                0,
                (
                    str(item.old_id),
                    str(item.new_id),
                    *(f"{value:+.4f}" for value in (x, y, z)),
                    f"{length_mm:.4f}",
                    "moved, left out",
                ),
            )
    columns = ("old", "new", "dx mm", "dy mm", "dz mm", "length mm", "")
    return Table(columns, tuple(rows), "Old minus carried new", (6,))


def _scene(
    old: MarkerList, new: MarkerList, place: PlaceRegistration, carried: Sequence[NamedCloud]
) -> MarkerScene:
    pose = place.fit.value
    lonely_old = old.markers.points_mm[np.isin(old.markers.ids, place.only_old)]
    lonely_new = new.markers.points_mm[np.isin(new.markers.ids, place.only_new)]
    stations = [("old base", np.zeros(3)), ("new base", np.array(pose.translation_mm))]
    matched = set(old.markers.ids[place.pairs[:, 0]].tolist())
    strays = [item for item in place.moved if item.old_id not in matched]
    at = np.isin(old.markers.ids, [item.old_id for item in strays])
    return MarkerScene(
        np.concatenate([old.markers.points_mm[place.pairs[:, 0]], old.markers.points_mm[at]]),
        np.concatenate([-place.residual_mm, np.zeros((int(at.sum()), 3))]),
        np.concatenate([place.is_used, np.zeros(int(at.sum()), dtype=bool)]),
        np.concatenate([lonely_old, lonely_new @ pose.rotation.T + pose.translation_mm]),
        stations,
        [item.cloud for item in carried],
        is_z_up=old.markers.frame != "Sensor",
    )


def _expected(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> FloatArray:
    i, k = place.pairs[:, 0], place.pairs[:, 1]
    trace = np.trace(
        old.markers.covariance_mm2[i] + new.markers.covariance_mm2[k], axis1=1, axis2=2
    )
    share = max(place.fit.degrees_of_freedom, 0) / (place.fit.degrees_of_freedom + 6)
    return np.asarray(np.sqrt(trace * share))


def _warnings(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> tuple[str, ...]:
    found = [
        f"{item.path.name} gives no covariance: {sigma:g} mm an axis is assumed for a marker"
        for item in (old, new)
        if item.is_sigma_assumed
        for sigma in (float(np.sqrt(item.markers.covariance_mm2[0, 0, 0])),)
    ]
    found += [
        f"marker {item.old_id} (new {item.new_id}) moved by "
        f"{significant(float(np.linalg.norm(item.offset_mm)), 'mm')} and was left out; "
        "markers.csv has its new place"
        for item in place.moved
    ]
    if place.chi2_probability < UNLIKELY:
        ratio = float(np.sqrt(place.fit.chi2 / place.fit.degrees_of_freedom))
        found.append(
            f"the residuals are {ratio:.2g} times what the covariances let expect: the stated "
            "uncertainty is too small by about that factor"
        )
    across = spread_mm(old.markers.points_mm[place.pairs[place.is_used][:, 0]])
    if across[1] < WEAK_SHARE * across[0]:
        found.append(
            f"the common markers lie nearly on a line ({significant(float(across[1]), 'mm')} to "
            "either side): the turn about it is weak"
        )
    return tuple(found)


def _data(
    place: PlaceRegistration, rms: float, at_markers: float, n: int, n_pairs: int
) -> dict[str, object]:
    return {
        "n_common": n,
        "n_matched": n_pairs,
        "n_only_old": len(place.only_old),
        "n_only_new": len(place.only_new),
        "only_old_ids": list(place.only_old),
        "only_new_ids": list(place.only_new),
        "rms_mm": rms,
        "sigma_at_markers_mm": at_markers,
        "chi2_probability": place.chi2_probability,
    }
