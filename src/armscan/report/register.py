# SPDX-License-Identifier: Apache-2.0
"""The page of a registration of views, its figures and its numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.markers.join_views import JoinedViews
from armscan.models.calibration import Provenance
from armscan.pipeline.register import RegisterOptions
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.records.points import MarkerSet
from armscan.report.drawing import ACCENT, ALERT, MUTED, PALETTE, chart_markup, new_figure, styled
from armscan.report.page import Card, Gallery, Page, Picture, Section, Text, footer, origin_section
from armscan.report.quantity import Table, sentence, significant
from armscan.report.scene3d import SceneDots, SceneLines, scene_markup, uniform_dots
from armscan.storage.clouds import FOREIGN_FRAME, read_cloud
from armscan.storage.documents import MarkerResidual, MovedMarker, ScanNotJoined, ScanTransform
from armscan.storage.files import path_text
from armscan.storage.points import MarkerList, read_marker_list


@dataclass(frozen=True, slots=True)
class RegisterRequest:
    """What to join, and where to write.

    Parameters
    ----------
    lists
        Lists of markers: one for each view, or the old one of an arm that moved.
    moved
        List of the markers that the arm measured at its new place; None for views.
    clouds
        Clouds of the new place; empty to take those beside the lists.
    output
        New folder.
    options
        How to match.
    command
        The command line, for the record.
    """

    lists: tuple[Path, ...]
    output: Path
    moved: Path | None = None
    clouds: tuple[Path, ...] = ()
    options: RegisterOptions = field(default_factory=RegisterOptions)
    command: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class NamedCloud:
    """A cloud and the name of its file in the new folder."""

    name: str
    path: Path
    cloud: PointCloud


def checked(request: RegisterRequest) -> RegisterRequest:
    """Return the request, or say what it lacks.

    Raises
    ------
    OptionError
        If the lists or the options do not go together.
    """
    if request.moved is None:
        if len(request.lists) < 2:
            raise OptionError(
                "one list of markers cannot be joined to anything",
                where=str(request.lists[0]) if request.lists else "",
                remedy="name two views or more, or give --moved NEW for an arm that moved",
            )
        for is_given, option in (
            (bool(request.clouds), "--cloud"),
            (request.options.is_by_id, "--by-id"),
        ):
            if is_given:
                raise OptionError("it needs --moved", where=option, remedy="leave it out")
    elif len(request.lists) != 1:
        raise OptionError(
            f"{len(request.lists)} lists for one old place",
            where="--moved",
            remedy="give one list of the old place and one of the new",
        )
    paths = [*request.lists, *(() if request.moved is None else (request.moved,))]
    twice = [path for path, n in Counter(path.resolve() for path in paths).items() if n > 1]
    if twice:
        raise OptionError("the list is given twice", where=str(twice[0]), remedy="name it once")
    return request


def read_lists(paths: Sequence[Path], frame: str, options: RegisterOptions) -> list[MarkerList]:
    """Read lists of markers; ``frame`` is that of lists which name none."""
    return [read_marker_list(path, frame=frame, sigma_mm=options.sigma_mm) for path in paths]


def cloud_beside(path: Path) -> Path | None:
    """The cloud ``NAME.ply`` beside the list ``NAME.csv``, if there is one."""
    beside = path.with_suffix(".ply")
    return beside if beside.is_file() else None


def read_named_cloud(path: Path, name: str, markers: MarkerList) -> NamedCloud:
    """Read the cloud of a list of markers.

    Raises
    ------
    InputError
        If the cloud is in another frame than the markers.
    """
    cloud = read_cloud(path)
    if cloud.frame not in (markers.markers.frame, FOREIGN_FRAME):
        raise InputError(
            f"the cloud is in {cloud.frame}, its markers are in {markers.markers.frame}",
            where=f"{path} and {markers.path}",
            remedy="measure both in one frame, or correct '# frame =' in the list",
        )
    return NamedCloud(f"{name}.ply", path, cloud)


def different_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A short name for each path: its stem, with the folder before it where stems repeat."""
    stems = Counter(path.stem for path in paths)
    names = [
        path.stem if stems[path.stem] == 1 else f"{path.resolve().parent.name}-{path.stem}"
        for path in paths
    ]
    repeated = {name for name, n in Counter(names).items() if n > 1}
    return tuple(f"{k + 1}-{name}" if name in repeated else name for k, name in enumerate(names))


def common_frame(markers: MarkerList) -> CloudFrame:
    """Frame of the result: Base stays Base; what a handheld sensor measured is on the part."""
    return "Base" if markers.markers.frame == "Base" else "Part"


MAX_CLOUD_DOTS = 12_000
CLOUD_GREY = "#c3ccd4"
RING_STEPS = 24
SHOWN_SHARE = 0.12
"""Length of the longest drawn residual as a share of the scene's extent."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerScene:
    """What to draw, all of it in the common frame.

    Parameters
    ----------
    points_mm, residual_mm
        (K, 3) markers and their residuals.
    is_used
        (K,) False where a marker moved.
    lonely_mm
        (L, 3) markers without partner.
    stations
        Labels with (3,) positions: where views were taken from, or the bases of the arm.
    clouds
        Clouds in the common frame, drawn pale.
    is_z_up
        True for Base.
    """

    points_mm: FloatArray
    residual_mm: FloatArray
    is_used: BoolArray
    lonely_mm: FloatArray
    stations: Sequence[tuple[str, FloatArray]]
    clouds: Sequence[PointCloud]
    is_z_up: bool


def marker_view(scene: MarkerScene) -> Picture:
    """Markers in space, residuals drawn much longer than they are."""
    extent = float(np.linalg.norm(np.ptp(scene.points_mm, axis=0)))
    longest = float(np.linalg.norm(scene.residual_mm, axis=1).max(initial=0.0))
    factor = _round_factor(SHOWN_SHARE * extent / longest) if longest > 0.0 else 1.0
    dots = [_pale(scene.clouds)] if scene.clouds else []
    lines = []
    for chosen, colour in ((scene.is_used, ACCENT), (~scene.is_used, ALERT)):
        if chosen.any():
            dots.append(uniform_dots(scene.points_mm[chosen], colour))
            lines.append(_rings(scene.points_mm[chosen], 0.012 * extent, colour))
            ends = scene.points_mm[chosen] + factor * scene.residual_mm[chosen]
            pairs = np.stack([scene.points_mm[chosen], ends], axis=1).reshape(-1, 3)
            lines.append(SceneLines(pairs, colour))
    if len(scene.lonely_mm):
        dots.append(uniform_dots(scene.lonely_mm, MUTED))
        lines.append(_rings(scene.lonely_mm, 0.008 * extent, MUTED))
    labels = []
    for text, place in scene.stations:
        x, y, z = (float(value) for value in place)
        dots.append(uniform_dots(place[None], PALETTE[2]))
        lines.append(_rings(place[None], 0.008 * extent, PALETTE[2]))
        labels.append((text, (x, y, z)))
    markup = scene_markup(dots, lines, labels, "Markers in space", is_z_up=scene.is_z_up)
    return Picture(
        markup,
        title="Markers in the common frame",
        caption=f"Blue: common markers, with their residuals drawn {factor:g} times as long. "
        "Orange: markers that moved. Grey: markers without partner, and the clouds. Violet: "
        "where the measurements were made from. Drag to turn; click, then scroll to zoom.",
    )


def residual_chart(length_mm: FloatArray, sigma_mm: FloatArray, is_used: BoolArray) -> Picture:
    """Lengths of the residuals in order, beside what the covariances let expect.

    Parameters
    ----------
    length_mm, sigma_mm
        (K,) length of a residual, and root of the trace of its covariance.
    is_used
        (K,) False where a marker moved.
    """
    order = np.argsort(length_mm)
    with styled():
        figure = new_figure(6.0, 3.2)
        axes = figure.add_subplot()
        place = np.arange(1, len(order) + 1)
        used = is_used[order]
        axes.plot(place[used], length_mm[order][used], "o", markersize=3.5, color=ACCENT)
        if not used.all():
            axes.plot(
                place[~used],
                length_mm[order][~used],
                "o",
                markersize=4.5,
                color=ALERT,
                label="moved",
            )
        expected = float(np.sqrt(np.mean(sigma_mm**2)))
        axes.axhline(expected, color=MUTED, linewidth=0.9, linestyle="--", label="expected rms")
        if float(length_mm.max(initial=0.0)) > 20.0 * expected:
            axes.set_yscale("log")
        axes.set_xlabel("markers, the best fitting first")
        axes.set_ylabel("residual, mm")
        axes.grid(axis="y")
        axes.legend()
    return Picture(
        chart_markup(figure, "Residuals of the markers in order of size"),
        title="Residuals",
        caption=f"Dashed: root mean square that the markers' covariances let expect, "
        f"{significant(expected, 'mm')}.",
    )


def drift_chart(names: Sequence[str], sigma_mm: FloatArray, rms_mm: FloatArray) -> Picture:
    """How uncertain each view's place is, in the order in which views were placed."""
    with styled():
        figure = new_figure(6.0, 3.2)
        axes = figure.add_subplot()
        place = np.arange(len(names))
        axes.bar(place, sigma_mm, width=0.6, color=ACCENT, label="uncertainty of its place")
        axes.plot(place, rms_mm, "o", color=ALERT, markersize=4, label="rms of its residuals")
        axes.set_xticks(place, [_short(name) for name in names], rotation=60, ha="right")
        axes.set_ylabel("mm")
        axes.grid(axis="y")
        axes.legend()
    return Picture(
        chart_markup(figure, "Uncertainty of each view's place"),
        title="How far the chain drifts",
        caption="Standard deviation (three axes together) with which a view's markers lie in the "
        "frame of the first view. It grows along a chain; the residuals do not show it.",
    )


def _short(name: str) -> str:
    return name if len(name) <= 14 else f"…{name[-13:]}"


def _round_factor(value: float) -> float:
    """The power of ten times 1, 2 or 5 next below a value."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-12)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12))


def _pale(clouds: Sequence[PointCloud]) -> SceneDots:
    n = sum(len(cloud) for cloud in clouds)
    step = max(1, -(-n // MAX_CLOUD_DOTS))
    return uniform_dots(np.concatenate([cloud.points_mm[::step] for cloud in clouds]), CLOUD_GREY)


def _rings(centres_mm: FloatArray, radius_mm: float, colour: str) -> SceneLines:
    """Three circles about each centre: a mark that is seen from every side."""
    angle = np.linspace(0.0, 2.0 * np.pi, RING_STEPS + 1)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    rings = np.stack([circle, circle[:, [0, 2, 1]], circle[:, [2, 0, 1]]])
    pieces = np.stack([rings[:, :-1], rings[:, 1:]], axis=2).reshape(-1, 3)
    return SceneLines((centres_mm[:, None] + pieces[None]).reshape(-1, 3), colour)


HOW_TO_READ = (
    "A residual is how far a marker, carried to the common frame, lies from where the others say. "
    "It shows how well markers were measured, and markers that moved. It does not show how well "
    "the frames agree: that is the uncertainty, which is larger far from the markers."
)


@dataclass(frozen=True, slots=True, eq=False)
class RegisterReport:
    """One registration, ready for a page, a terminal, a document and a program.

    Parameters
    ----------
    title, subtitle
        What was joined.
    common_frame, common_frame_of
        Name of the common frame, and the list that defines it.
    cards, facts
        Key figures, for the page and for a terminal.
    scans, residuals_table
        Tables of scans and of markers.
    pictures
        The view in space first.
    warnings
        Sentences that a person should read first.
    transforms, residuals, moved, not_joined, chi2, degrees_of_freedom
        Of the document.
    data
        For programs.
    """

    title: str
    subtitle: str
    common_frame: str
    common_frame_of: str
    cards: tuple[Card, ...]
    facts: tuple[tuple[str, str], ...]
    scans: Table
    residuals_table: Table
    pictures: tuple[Picture, ...]
    warnings: tuple[str, ...]
    transforms: tuple[ScanTransform, ...]
    residuals: tuple[MarkerResidual, ...]
    moved: tuple[MovedMarker, ...]
    not_joined: tuple[ScanNotJoined, ...]
    chi2: float
    degrees_of_freedom: int
    data: Mapping[str, Any]


def registration_page(
    report: RegisterReport, provenance: Provenance, *, is_simulated: bool
) -> Page:
    """Lay out the page."""
    view, *charts = report.pictures
    return Page(
        title=report.title,
        subtitle=report.subtitle,
        cards=report.cards,
        warnings=tuple(sentence(warning) for warning in report.warnings),
        sections=(
            Section("In space", (Gallery((view,), 560),)),
            Section("Scans", (report.scans,)),
            Section(
                "How well the markers fit",
                (Text(HOW_TO_READ), Gallery(tuple(charts), 420)),
            ),
            Section("Marker by marker", (report.residuals_table,), is_folded=len(charts) > 1),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


UNLIKELY = 1e-3
LEAST_MM = 1e-6


def map_markers(joined: JoinedViews, frame: str) -> MarkerSet:
    """Markers of all views in the common frame, numbered from 1."""
    n = len(joined.map.markers_mm)
    return MarkerSet(
        ids=np.arange(1, n + 1),
        points_mm=joined.map.markers_mm,
        covariance_mm2=joined.map.marker_covariance_mm2,
        frame=frame,
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
        residuals=_residuals(lists, placed, joined),
        moved=_moved(lists, joined),
        not_joined=tuple(
            ScanNotJoined(name=names[item.view], reason=item.reason) for item in joined.left
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
) -> tuple[ScanTransform, ...]:
    clouds = {item.name.removesuffix(".ply"): item.name for item in carried}
    n_shared, rms = _n_shared(joined), _rms_mm(joined)
    return tuple(
        ScanTransform(
            name=name,
            markers=path_text(lists[view].path),
            own_frame=lists[view].markers.frame,
            rotation_rows=joined.map.part_from_view[k].rotation,
            translation_mm=joined.map.part_from_view[k].translation_mm,
            covariance=joined.map.pose_covariance[k],
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


def _residuals(
    lists: Sequence[MarkerList], placed: Sequence[str], joined: JoinedViews
) -> tuple[MarkerResidual, ...]:
    place = _place_in_view(joined)
    return tuple(
        MarkerResidual(
            name=placed[view],
            id=int(lists[joined.placed[view]].markers.ids[place[k]]),
            common_id=int(joined.sightings.marker[k]) + 1,
            residual_mm=joined.map.residual_mm[k],
            is_used=bool(joined.map.is_used[k]),
        )
        for k, view in enumerate(joined.sightings.view.tolist())
        if _is_shared(joined)[k]
    )


def _moved(lists: Sequence[MarkerList], joined: JoinedViews) -> tuple[MovedMarker, ...]:
    place = _place_in_view(joined)
    return tuple(
        MovedMarker(
            id=int(lists[joined.placed[int(joined.sightings.view[k])]].markers.ids[place[k]]),
            common_id=int(joined.sightings.marker[k]) + 1,
            offset_mm=joined.map.residual_mm[k],
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
