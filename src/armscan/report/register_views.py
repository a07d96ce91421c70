# SPDX-License-Identifier: Apache-2.0
"""What is said of views of a handheld scanner that were joined by their markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from armscan.geometry.arrays import FloatArray
from armscan.markers.join_views import JoinedViews
from armscan.records.markers import MarkerSet
from armscan.report.numbers import significant
from armscan.report.page import Card
from armscan.report.register_figures import (
    MarkerScene,
    drift_chart,
    marker_view,
    residual_chart,
)
from armscan.report.register_page import RegisterReport
from armscan.report.register_request import NamedCloud
from armscan.report.summary import Table
from armscan.storage.calibration_bodies import triple
from armscan.storage.marker_files import MarkerList
from armscan.storage.registration_files import (
    MovedBody,
    NotJoinedBody,
    ResidualBody,
    TransformBody,
    transform_body,
)

UNLIKELY = 1e-3
LEAST_MM = 1e-6


def map_markers(joined: JoinedViews, frame: str) -> MarkerSet:
    """Markers of all views in the common frame, numbered from 1."""
    n = len(joined.map.markers_mm)
    return MarkerSet(
        np.arange(1, n + 1), joined.map.markers_mm, joined.map.marker_covariance_mm2, frame
    )


def views_report(
    lists: Sequence[MarkerList],
    names: Sequence[str],
    joined: JoinedViews,
    carried: Sequence[NamedCloud],
    frame: str,
) -> RegisterReport:
    """Describe the registration; ``carried`` are the clouds in the common frame."""
    views = [item.markers for item in lists]
    placed = [names[view] for view in joined.placed]
    sigma, shift = joined.sigma_mm(views), joined.shift_mm(views)
    shared = _is_shared(joined)
    figures = _figures(names, joined, sigma=sigma, shift=shift)
    return RegisterReport(
        title="Views joined by markers",
        subtitle=f"{len(placed)} of {len(views)} views in the frame of {lists[0].path.name}",
        common_frame=frame,
        common_frame_of=lists[0].path.as_posix(),
        cards=_cards(joined, figures),
        facts=_facts(joined, figures),
        scans=_view_table(placed, joined, sigma=sigma, shift=shift),
        residuals_table=_residual_table(lists, placed, joined),
        pictures=(
            marker_view(_scene(placed, joined, carried, frame)),
            drift_chart(placed, sigma, _rms_mm(joined)),
            residual_chart(
                np.linalg.norm(joined.map.residual_mm, axis=1)[shared],
                _expected(joined)[shared],
                joined.map.is_used[shared],
            ),
        ),
        warnings=_warnings(lists, names, joined),
        transforms=_transforms(lists, placed, joined, carried),
        residuals=_residual_bodies(lists, placed, joined),
        moved=_moved(lists, joined),
        not_joined=tuple(
            NotJoinedBody(name=names[item.view], reason=item.reason) for item in joined.left
        ),
        chi2=joined.map.chi2,
        degrees_of_freedom=joined.map.degrees_of_freedom,
        data=figures,
    )


def _figures(
    names: Sequence[str], joined: JoinedViews, *, sigma: FloatArray, shift: FloatArray
) -> dict[str, Any]:
    used = joined.map.residual_mm[joined.map.is_used & _is_shared(joined)]
    last = int(np.argmax(sigma))
    return {
        "n_views": len(names),
        "n_joined": len(joined.placed),
        "not_joined": [names[item.view] for item in joined.left],
        "n_links": joined.n_links,
        "n_markers": len(joined.map.markers_mm),
        "n_sightings": len(joined.sightings),
        "n_left_out": int((~joined.map.is_used).sum()),
        "n_contradictions": joined.n_contradictions,
        "rms_mm": float(np.sqrt((used**2).sum(axis=1).mean())),
        "drift_sigma_mm": float(sigma[last]),
        "drift_of": names[joined.placed[last]],
        "largest_shift_mm": float(shift.max()),
    }


def _cards(joined: JoinedViews, figures: Mapping[str, Any]) -> tuple[Card, ...]:
    most = int(_n_sightings(joined).max())
    return (
        Card(
            "Views joined",
            f"{figures['n_joined']} of {figures['n_views']}",
            f"{joined.n_links} pairs match",
        ),
        Card("Markers", str(figures["n_markers"]), f"{most} views at most see one"),
        Card(
            "Residuals",
            significant(figures["rms_mm"], "mm"),
            "root mean square, three axes together",
        ),
        Card(
            "Drift",
            significant(figures["drift_sigma_mm"], "mm"),
            f"uncertainty of {figures['drift_of']} against the first view",
        ),
    )


def _facts(joined: JoinedViews, figures: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    return (
        (
            "views",
            f"{figures['n_joined']} of {figures['n_views']} joined, {joined.n_links} pairs match",
        ),
        ("markers", f"{figures['n_markers']}, seen {len(joined.sightings)} times"),
        ("residuals", f"{significant(figures['rms_mm'], 'mm')} rms, three axes together"),
        (
            "drift",
            f"{significant(figures['drift_sigma_mm'], 'mm')} uncertainty of "
            f"{figures['drift_of']} against the first view; "
            f"{_shift_text(figures['largest_shift_mm'])}",
        ),
    )


def _transforms(
    lists: Sequence[MarkerList],
    placed: Sequence[str],
    joined: JoinedViews,
    carried: Sequence[NamedCloud],
) -> tuple[TransformBody, ...]:
    clouds = {item.name.removesuffix(".ply"): item.name for item in carried}
    n_shared, rms = _n_shared(joined), _rms_mm(joined)
    return tuple(
        transform_body(
            name,
            lists[view].path,
            lists[view].markers.frame,
            joined.map.part_from_view[k],
            joined.map.pose_covariance[k],
            n_markers=int(n_shared[k]),
            rms_mm=float(rms[k]),
            cloud=clouds.get(name),
        )
        for k, (view, name) in enumerate(zip(joined.placed, placed, strict=True))
    )


def _shift_text(largest_mm: float) -> str:
    if largest_mm < LEAST_MM:
        return "solving together changed nothing: no loop closes"
    return f"solving together moved a view by {significant(largest_mm, 'mm')} at most"


def _n_sightings(joined: JoinedViews) -> FloatArray:
    return np.bincount(joined.sightings.marker, minlength=len(joined.map.markers_mm)).astype(
        np.float64
    )


def _is_shared(joined: JoinedViews) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(K,) sightings of markers that another view saw too: only these have a residual."""
    return np.asarray(_n_sightings(joined)[joined.sightings.marker] > 1)


def _n_shared(joined: JoinedViews) -> FloatArray:
    shared = _is_shared(joined) & joined.map.is_used
    return np.bincount(joined.sightings.view[shared], minlength=len(joined.placed)).astype(
        np.float64
    )


def _rms_mm(joined: JoinedViews) -> FloatArray:
    """(V,) root mean square of a view's residuals."""
    chosen = _is_shared(joined) & joined.map.is_used
    squares = (joined.map.residual_mm[chosen] ** 2).sum(axis=1)
    total = np.bincount(joined.sightings.view[chosen], squares, minlength=len(joined.placed))
    return np.asarray(np.sqrt(total / np.maximum(_n_shared(joined), 1.0)))


def _expected(joined: JoinedViews) -> FloatArray:
    """(K,) about what a residual should be: its sighting's noise, less what the fit takes up."""
    trace = np.trace(joined.sightings.covariance_mm2, axis1=1, axis2=2)
    n_shared = int(_is_shared(joined).sum())
    share = joined.map.degrees_of_freedom / max(3 * n_shared, 1)
    return np.asarray(np.sqrt(trace * min(max(share, 0.0), 1.0)))


def _view_table(
    placed: Sequence[str], joined: JoinedViews, *, sigma: FloatArray, shift: FloatArray
) -> Table:
    n_shared, rms = _n_shared(joined), _rms_mm(joined)
    rows = tuple(
        (
            name,
            f"{len(joined.marker_of[k])}",
            f"{int(n_shared[k])}",
            f"{rms[k]:.4f}",
            f"{sigma[k]:.4f}",
            f"{shift[k]:.4f}",
        )
        for k, name in enumerate(placed)
    )
    heads = ("view", "markers", "shared", "rms mm", "uncertainty mm", "moved by joint solve mm")
    return Table(heads, rows, "In the order in which they were placed")


def _residual_table(
    lists: Sequence[MarkerList], placed: Sequence[str], joined: JoinedViews
) -> Table:
    length = np.linalg.norm(joined.map.residual_mm, axis=1)
    place = _place_in_view(joined)
    rows = []
    for k in np.argsort(-length):
        if not _is_shared(joined)[k]:
            continue
        view = int(joined.sightings.view[k])
        ids = lists[joined.placed[view]].markers.ids
        rows.append(
            (
                placed[view],
                str(int(ids[place[k]])),
                str(int(joined.sightings.marker[k]) + 1),
                *(f"{value:+.4f}" for value in joined.map.residual_mm[k]),
                f"{length[k]:.4f}",
                "" if joined.map.is_used[k] else "does not fit, left out",
            )
        )
    columns = ("view", "its id", "marker", "dx mm", "dy mm", "dz mm", "length mm", "")
    return Table(columns, tuple(rows), "Carried sighting minus marker", (7,))


def _place_in_view(joined: JoinedViews) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """(K,) index of each sighting among the markers of its view."""
    return np.concatenate([np.arange(len(item)) for item in joined.marker_of])


def _residual_bodies(
    lists: Sequence[MarkerList], placed: Sequence[str], joined: JoinedViews
) -> tuple[ResidualBody, ...]:
    place = _place_in_view(joined)
    return tuple(
        ResidualBody(
            name=placed[view],
            id=int(lists[joined.placed[view]].markers.ids[place[k]]),
            common_id=int(joined.sightings.marker[k]) + 1,
            residual_mm=triple(joined.map.residual_mm[k]),
            is_used=bool(joined.map.is_used[k]),
        )
        for k, view in enumerate(joined.sightings.view.tolist())
        if _is_shared(joined)[k]
    )


def _moved(lists: Sequence[MarkerList], joined: JoinedViews) -> tuple[MovedBody, ...]:
    place = _place_in_view(joined)
    return tuple(
        MovedBody(
            id=int(lists[joined.placed[int(joined.sightings.view[k])]].markers.ids[place[k]]),
            common_id=int(joined.sightings.marker[k]) + 1,
            offset_mm=triple(joined.map.residual_mm[k]),
        )
        for k in np.flatnonzero(~joined.map.is_used)
    )


def _scene(
    placed: Sequence[str], joined: JoinedViews, carried: Sequence[NamedCloud], frame: str
) -> MarkerScene:
    first = np.unique(joined.sightings.marker, return_index=True)[1]
    n_seen = _n_sightings(joined)
    rows = [k for k in first if n_seen[joined.sightings.marker[k]] > 1]
    left_out = np.flatnonzero(~joined.map.is_used)
    rows = sorted({*(int(k) for k in rows), *(int(k) for k in left_out)})
    return MarkerScene(
        joined.map.markers_mm[joined.sightings.marker[rows]],
        joined.map.residual_mm[rows],
        joined.map.is_used[rows],
        joined.map.markers_mm[n_seen == 1],
        [
            (name, np.array(pose.translation_mm))
            for name, pose in zip(placed, joined.map.part_from_view, strict=True)
        ],
        [item.cloud for item in carried],
        is_z_up=frame == "Base",
    )


def _warnings(
    lists: Sequence[MarkerList], names: Sequence[str], joined: JoinedViews
) -> tuple[str, ...]:
    found = [
        f"{names[item.view]} is not joined: {item.reason}; {item.remedy}" for item in joined.left
    ]
    assumed = [item for item in lists if item.is_sigma_assumed]
    if assumed:
        sigma = float(np.sqrt(assumed[0].markers.covariance_mm2[0, 0, 0]))
        found.append(
            f"{len(assumed)} lists give no covariance: {sigma:g} mm an axis is assumed for a marker"
        )
    if n := int((~joined.map.is_used).sum()):
        found.append(f"{n} sightings do not fit the others and were left out")
    if joined.n_contradictions:
        found.append(
            f"{joined.n_contradictions} pairs of markers contradict stronger ones and were dropped"
        )
    probability = float(chi2.sf(joined.map.chi2, max(joined.map.degrees_of_freedom, 1)))
    if probability < UNLIKELY:
        ratio = float(np.sqrt(joined.map.chi2 / joined.map.degrees_of_freedom))
        found.append(
            f"the residuals are {ratio:.2g} times what the covariances let expect: the stated "
            "uncertainty is too small by about that factor"
        )
    return tuple(found)
