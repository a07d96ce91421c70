# SPDX-License-Identifier: Apache-2.0
"""From marker lists and clouds of several places of the scanner to one frame: lists, clouds, a
document and its page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.registration import carried_covariance_mm2, spread_mm
from armscan.models.calibration import Provenance
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.register import PlaceRegistration, carry_cloud, register_place, register_views
from armscan.records.points import MarkerSet
from armscan.report.page import Card, render_page
from armscan.report.quantity import Summary, Table, sentence, significant, with_sigma
from armscan.report.register import (
    MarkerScene,
    NamedCloud,
    RegisterReport,
    RegisterRequest,
    checked,
    cloud_beside,
    common_frame,
    different_names,
    map_markers,
    marker_view,
    read_lists,
    read_named_cloud,
    registration_page,
    residual_chart,
    views_report,
)
from armscan.storage.clouds import ply_bytes
from armscan.storage.documents import (
    CODEC,
    MarkerResidual,
    MovedMarker,
    Registration,
    ScanTransform,
    new_provenance,
    registration_document,
)
from armscan.storage.files import check_new_folder, new_folder, path_text, write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import MarkerList, markers_csv

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
            ScanTransform(
                name=name,
                markers=path_text(new.path),
                own_frame=new.markers.frame,
                rotation_rows=place.fit.value.rotation,
                translation_mm=place.fit.value.translation_mm,
                covariance=place.fit.covariance,
                n_markers=n,
                rms_mm=rms,
                cloud=clouds,
            ),
        ),
        residuals=tuple(
            MarkerResidual(
                name=name,
                id=int(new.markers.ids[k]),
                common_id=int(old.markers.ids[i]),
                residual_mm=residual,
                is_used=bool(is_used),
            )
            for (i, k), residual, is_used in zip(
                place.pairs, place.residual_mm, place.is_used, strict=True
            )
        ),
        moved=tuple(
            MovedMarker(id=item.new_id, common_id=item.old_id, offset_mm=item.offset_mm)
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


DOCUMENT, PAGE, MARKERS = "registration.json", "registration.html", "markers.csv"


def run_registration(request: RegisterRequest, progress: Progress = silent) -> Summary:
    """Read the lists, join them, carry the clouds, write the folder and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the markers do not join the scans; nothing
        is written then.
    """
    check_new_folder(request.output)
    request = checked(request)
    if request.moved is None:
        return _join_views(request, progress)
    return _join_place(request, request.moved)


def _join_views(request: RegisterRequest, progress: Progress) -> Summary:
    lists = read_lists(request.lists, "Sensor", request.options)
    names = different_names(request.lists)
    clouds = {
        k: read_named_cloud(path, names[k], item)
        for k, item in enumerate(lists)
        if (path := cloud_beside(item.path)) is not None
    }
    joined = register_views([item.markers for item in lists], request.options, progress)
    frame = common_frame(lists[0])
    carried = [
        replace(
            clouds[view],
            cloud=carry_cloud(
                clouds[view].cloud,
                joined.map.part_from_view[k],
                joined.map.pose_covariance[k],
                frame,
            ),
        )
        for k, view in enumerate(joined.placed)
        if view in clouds
    ]
    report = views_report(lists, names, joined, carried, frame)
    return _written(request, report, lists, carried, map_markers(joined, frame))


def _join_place(request: RegisterRequest, moved: Path) -> Summary:
    old, new = read_lists((request.lists[0], moved), "Base", request.options)
    paths = request.clouds
    if not paths and (beside := cloud_beside(moved)) is not None:
        paths = (beside,)
    named = zip(paths, different_names(paths), strict=True)
    clouds = [read_named_cloud(path, name, new) for path, name in named]
    place = register_place(old, new, request.options)
    frame = common_frame(old)
    carried = [
        replace(item, cloud=carry_cloud(item.cloud, place.fit.value, place.fit.covariance, frame))
        for item in clouds
    ]
    report = place_report(old, new, place, carried)
    return _written(request, report, (old, new), carried, _joint_markers(old, new, place))


def _joint_markers(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> MarkerSet:
    """The old markers, and behind them those that only the new place saw, in the old frame.

    A marker that moved keeps its number and has its new place.
    """
    pose = place.fit.value
    carried = new.markers.points_mm @ pose.rotation.T + pose.translation_mm
    covariance = carried_covariance_mm2(
        new.markers.points_mm, new.markers.covariance_mm2, pose, place.fit.covariance
    )
    points, covariances = old.markers.points_mm.copy(), old.markers.covariance_mm2.copy()
    for item in place.moved:
        i = np.flatnonzero(old.markers.ids == item.old_id)
        k = np.flatnonzero(new.markers.ids == item.new_id)
        points[i], covariances[i] = carried[k], covariance[k]
    added = np.isin(new.markers.ids, place.only_new)
    last = int(old.markers.ids.max())
    return MarkerSet(
        ids=np.concatenate([old.markers.ids, last + 1 + np.arange(int(added.sum()))]),
        points_mm=np.concatenate([points, carried[added]]),
        covariance_mm2=np.concatenate([covariances, covariance[added]]),
        frame=old.markers.frame,
    )


def _written(
    request: RegisterRequest,
    report: RegisterReport,
    lists: tuple[MarkerList, ...] | list[MarkerList],
    carried: list[NamedCloud],
    markers: MarkerSet,
) -> Summary:
    inputs = (*(item.path for item in lists), *(item.path for item in carried))
    is_simulated = are_simulated(inputs) or any(item.cloud.is_simulated for item in carried)
    provenance = new_provenance(
        inputs,
        command=request.command,
        options=(request.options,),
        warnings=report.warnings,
        forced=[reason for item in carried for reason in item.cloud.forced],
    )
    page = registration_page(report, provenance, is_simulated=is_simulated)
    contents = {
        DOCUMENT: registration_document(
            _document(request, report, provenance, is_simulated=is_simulated)
        ),
        MARKERS: markers_csv(markers),
        **{item.name: ply_bytes(item.cloud) for item in carried},
        PAGE: render_page(page),
    }
    with new_folder(request.output) as folder:
        write_files({folder / name: content for name, content in contents.items()})
    return Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        facts=report.facts,
        tables=(report.scans,),
        warnings=tuple(sentence(warning) for warning in report.warnings),
        written=tuple(request.output / name for name in contents),
        next_step=f"open {request.output / PAGE}",
        forced=provenance.forced,
        data={
            "kind": "registration",
            "of": "views" if request.moved is None else "moved arm",
            "simulated": is_simulated,
            "common_frame": report.common_frame,
            **report.data,
            "chi2": report.chi2,
            "degrees_of_freedom": report.degrees_of_freedom,
            "transforms": [CODEC.write(item) for item in report.transforms],
            "moved": [CODEC.write(item) for item in report.moved],
        },
    )


def _document(
    request: RegisterRequest, report: RegisterReport, provenance: Provenance, *, is_simulated: bool
) -> Registration:
    return Registration(
        kind="views" if request.moved is None else "moved arm",
        simulated=is_simulated,
        common_frame=report.common_frame,
        common_frame_of=report.common_frame_of,
        transforms=report.transforms,
        residuals=report.residuals,
        moved=report.moved,
        not_joined=report.not_joined,
        chi2=report.chi2,
        degrees_of_freedom=report.degrees_of_freedom,
        provenance=provenance,
    )
