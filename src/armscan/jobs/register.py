# SPDX-License-Identifier: Apache-2.0
"""From lists of markers and clouds of several places of the scanner to one frame.

Writes a folder with the clouds, the markers, the registration's document and its page.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import chdtrc

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.registration import spread_mm
from armscan.geometry.rotations import vector_sigma
from armscan.jobs.job import Job
from armscan.markers.join_views import UNLIKELY, JoinedViews
from armscan.pipeline.register import (
    BY_ID,
    UNCHECKED,
    MarkerResiduals,
    PlaceRegistration,
    RegisterOptions,
    ViewNumbers,
    added_sigma_mm,
    carry_cloud,
    joint_markers,
    place_residuals,
    register_place,
    register_views,
    with_strays,
)
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.records.points import MarkerSet
from armscan.report.markers import (
    MarkerScene,
    RegisterReport,
    drift_chart,
    registration_page,
)
from armscan.report.page import render_page
from armscan.report.quantity import (
    Quantity,
    Summary,
    Table,
    fact,
    only,
    sentences,
    significant,
    with_sigma,
)
from armscan.storage.clouds import FOREIGN_FRAME, CloudPiece, ply_bytes, read_cloud_file
from armscan.storage.documents import (
    CODEC,
    MarkerResidual,
    MovedMarker,
    Registration,
    ScanNotJoined,
    ScanTransform,
    registration_document,
)
from armscan.storage.files import check_new_folder, new_folder, path_text, write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import ASSUMED_SIGMA_MM, MarkerList, markers_csv, read_marker_list

DOCUMENT, PAGE, MARKERS = "registration.json", "registration.html", "markers.csv"
WEAK_SHARE = 0.05
"""Markers whose width is a smaller share of their length lie nearly on a line."""
LEAST_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _NamedCloud:
    """A cloud and the name of its file in the new folder.

    ``n_points`` (N,) are the measured points that each of a fused cloud stands for, or None.
    """

    name: str
    path: Path
    cloud: PointCloud
    remarks: tuple[str, ...] = ()
    n_points: IntArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Joined:
    """What goes into the folder; the first of ``lists`` defines the common frame."""

    frame: str
    report: RegisterReport
    lists: Sequence[MarkerList]
    carried: Sequence[_NamedCloud]
    markers: MarkerSet
    transforms: tuple[ScanTransform, ...]
    residuals: tuple[MarkerResidual, ...]
    moved: tuple[MovedMarker, ...]
    not_joined: tuple[ScanNotJoined, ...]
    chi2: float
    degrees_of_freedom: int


def register(
    job: Job,
    lists: Sequence[Path],
    *,
    moved: Path | None = None,
    clouds: Sequence[Path] = (),
    options: RegisterOptions | None = None,
) -> Summary:
    """Read the lists, join them, carry the clouds, write the folder and say what came out.

    ``lists``: lists of markers: one for each view, or the old one of an arm that moved. ``moved``:
    list of the markers that the arm measured at its new place; None for views. ``clouds``: clouds
    of the new place; empty to take those beside the lists. ``options``: how to match.
    """
    options = options or RegisterOptions()
    folder = job.output or Path("registered")
    check_new_folder(folder)
    _check(lists, moved, clouds, options)
    if moved is None:
        joined = _join_views(job, lists, options)
    else:
        joined = _join_place(lists[0], moved, clouds, options)
    carried = joined.carried
    read = (f"{item.path.name}: {remark}" for item in carried for remark in item.remarks)
    report = replace(joined.report, warnings=(*joined.report.warnings, *read))
    inputs = [*(item.path for item in joined.lists), *(item.path for item in carried)]
    marks = (
        *(item.is_simulated for item in joined.lists),
        *(item.cloud.is_simulated for item in carried),
    )
    is_simulated = any(marks) or are_simulated(inputs)
    forced = [reason for item in carried for reason in item.cloud.forced]
    provenance = job.provenance(inputs, (options,), warnings=report.warnings, forced=forced)
    document = Registration(
        kind="views" if moved is None else "moved arm",
        simulated=is_simulated,
        common_frame=joined.frame,
        common_frame_of=joined.lists[0].path.as_posix(),
        transforms=joined.transforms,
        residuals=joined.residuals,
        moved=joined.moved,
        not_joined=joined.not_joined,
        chi2=joined.chi2,
        degrees_of_freedom=joined.degrees_of_freedom,
        provenance=provenance,
    )
    contents = {
        DOCUMENT: registration_document(document),
        MARKERS: markers_csv(joined.markers, is_simulated=is_simulated),
        **{
            item.name: ply_bytes(CloudPiece(item.cloud, n_points=item.n_points)) for item in carried
        },
        PAGE: render_page(registration_page(report, provenance, is_simulated=is_simulated)),
    }
    with new_folder(folder) as place:
        write_files({place / name: content for name, content in contents.items()})
    return Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        quantities=report.quantities,
        tables=(report.scans,),
        warnings=sentences(report.warnings),
        written=tuple(folder / name for name in contents),
        next_step=f"open {folder / PAGE}",
        forced=provenance.forced,
        extra={
            "kind": "registration",
            "of": document.kind,
            "simulated": is_simulated,
            "common_frame": joined.frame,
            "chi2": joined.chi2,
            "degrees_of_freedom": joined.degrees_of_freedom,
            "transforms": [CODEC.write(item) for item in joined.transforms],
            "moved": [CODEC.write(item) for item in joined.moved],
        },
    )


def _check(
    lists: Sequence[Path], moved: Path | None, clouds: Sequence[Path], options: RegisterOptions
) -> None:
    """Raise if the lists or the options do not go together."""
    if moved is None:
        if len(lists) < 2:
            raise OptionError(
                "one list of markers cannot be joined to anything",
                where=str(lists[0]) if lists else "",
                remedy="name two views or more, or give --moved NEW for an arm that moved",
            )
        for is_given, option in (
            (bool(clouds), "--cloud"),
            (options.is_by_id, "--by-id"),
            (options.is_by_thesis, "--method"),
        ):
            if is_given:
                raise OptionError("it needs --moved", where=option, remedy="leave it out")
    elif len(lists) != 1:
        raise OptionError(
            f"{len(lists)} lists for one old place",
            where="--moved",
            remedy="give one list of the old place and one of the new",
        )
    paths = [*lists, *(() if moved is None else (moved,))]
    twice = [path for path, n in Counter(path.resolve() for path in paths).items() if n > 1]
    if twice:
        raise OptionError("the list is given twice", where=str(twice[0]), remedy="name it once")


def _refuse_vain_sigma(lists: Sequence[MarkerList], options: RegisterOptions) -> None:
    """Raise if a standard deviation is given for markers that all have a covariance."""
    if options.sigma_mm == ASSUMED_SIGMA_MM or options.is_by_thesis:
        return
    if not any(item.is_sigma_assumed for item in lists):
        raise OptionError(
            "without effect: all lists give the covariances of their markers",
            where="--sigma-mm",
            remedy="leave out --sigma-mm, or the six covariances of the lists",
        )


def _cloud_beside(path: Path) -> Path | None:
    """The cloud ``NAME.ply`` beside the list ``NAME.csv``, if there is one."""
    beside = path.with_suffix(".ply")
    return beside if beside.is_file() else None


def _read_cloud(path: Path, name: str, markers: MarkerList) -> _NamedCloud:
    """The cloud of a list of markers, which must be in its frame."""
    found = read_cloud_file(path)
    cloud = found.cloud
    if cloud.frame not in (markers.markers.frame, FOREIGN_FRAME):
        raise InputError(
            f"the cloud is in {cloud.frame}, its markers are in {markers.markers.frame}",
            where=f"{path} and {markers.path}",
            remedy="measure both in one frame, or correct '# frame =' in the list",
        )
    return _NamedCloud(f"{name}.ply", path, cloud, (*found.remarks, *found.doubts), found.n_points)


def _different_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A short name for each path: its stem, with the folder before it where stems repeat."""
    stems = Counter(path.stem for path in paths)
    names = [
        path.stem if stems[path.stem] == 1 else f"{path.resolve().parent.name}-{path.stem}"
        for path in paths
    ]
    repeated = {name for name, n in Counter(names).items() if n > 1}
    return tuple(f"{k + 1}-{name}" if name in repeated else name for k, name in enumerate(names))


def _common_frame(markers: MarkerList) -> CloudFrame:
    """Frame of the result: Base stays Base; what a handheld sensor measured is on the part."""
    return "Base" if markers.markers.frame == "Base" else "Part"


def _assumed_sigma(lists: Sequence[MarkerList]) -> str:
    """What is assumed of the markers of lists that give no covariance, all alike."""
    sigma = float(np.sqrt(lists[0].markers.covariance_mm2[0, 0, 0]))
    return f"{sigma:g} mm an axis is assumed for a marker"


def _uncounted(lists: Sequence[MarkerList]) -> tuple[str, ...]:
    """Warn of errors that markers of such lists have in common, and that are not counted so."""
    return tuple(
        f"markers of {item.path.name} were carried by a move and share its error, which is counted "
        "as one only of the old list of --moved: the stated uncertainty is too small"
        for item in lists
        if item.markers.common is not None
    )


def _too_small(chi2_sum: float, degrees_of_freedom: int) -> tuple[str, ...]:
    """Warn of residuals that the stated covariances do not allow."""
    if float(chdtrc(max(degrees_of_freedom, 1), chi2_sum)) >= UNLIKELY:
        return ()
    ratio = float(np.sqrt(chi2_sum / degrees_of_freedom))
    larger = float(np.sqrt(chi2_sum / (degrees_of_freedom - 2)))
    return (
        f"the residuals are {ratio:.2g} times what the covariances let expect: the registration's "
        f"uncertainty is stated {larger:.2g} times as large, that of the markers is too small by "
        f"{ratio:.2g}",
    )


def _residual_bodies(found: MarkerResiduals) -> tuple[MarkerResidual, ...]:
    return tuple(
        MarkerResidual(
            name=found.scans[k],
            id=int(found.ids[k]),
            common_id=int(found.common_ids[k]),
            residual_mm=found.residual_mm[k],
            is_used=bool(found.is_used[k]),
        )
        for k in range(len(found.scans))
    )


def _rms(residual_mm: FloatArray) -> float:
    """Root mean square length, three axes together."""
    return float(np.sqrt((residual_mm**2).sum(axis=1).mean()))


def _to_match(item: MarkerList) -> MarkerSet:
    """The markers; only of a list that says so were they seen from the origin of its frame."""
    return replace(item.markers, frame="") if item.is_frame_assumed else item.markers


def _join_views(job: Job, paths: Sequence[Path], options: RegisterOptions) -> _Joined:
    lists = [read_marker_list(path, frame="Sensor", sigma_mm=options.sigma_mm) for path in paths]
    _refuse_vain_sigma(lists, options)
    names = _different_names(paths)
    clouds = {
        k: _read_cloud(path, names[k], item)
        for k, item in enumerate(lists)
        if (path := _cloud_beside(item.path)) is not None
    }
    views = [_to_match(item) for item in lists]
    joined = register_views(views, options, job.progress)
    found, frame = joined.map, _common_frame(lists[0])
    carried = [
        replace(
            clouds[view],
            cloud=carry_cloud(
                clouds[view].cloud, found.part_from_view[k], found.pose_covariance[k], frame
            ),
        )
        for k, view in enumerate(joined.placed)
        if view in clouds
    ]
    numbers = ViewNumbers.of(joined, lists, names)
    sigma, shift = joined.sigma_mm(views), joined.shift_mm(views)
    told = _views_quantities(joined, names, numbers, sigma, shift)
    report = RegisterReport(
        title="Views joined by markers",
        subtitle=f"{len(joined.placed)} of {len(views)} views in the frame of {lists[0].path.name}",
        quantities=told,
        cards=only(told, "n_joined", "n_markers", "rms_mm", "drift_sigma_mm"),
        scans=_view_table(joined, numbers, sigma, shift),
        residuals=numbers.shared,
        residuals_are="Carried sighting minus marker",
        scene=_views_scene(joined, numbers, [item.cloud for item in carried], frame),
        drift=drift_chart(numbers.placed, sigma, numbers.rms_mm),
        warnings=_views_warnings(joined, lists, names),
    )
    cloud_of = {item.name.removesuffix(".ply"): item.name for item in carried}
    return _Joined(
        frame=frame,
        report=report,
        lists=lists,
        carried=carried,
        markers=MarkerSet(
            ids=np.arange(1, len(found.markers_mm) + 1),
            points_mm=found.markers_mm,
            covariance_mm2=found.marker_covariance_mm2,
            frame=frame,
        ),
        transforms=tuple(
            ScanTransform(
                name=name,
                markers=path_text(lists[view].path),
                own_frame=lists[view].markers.frame,
                rotation_rows=found.part_from_view[k].rotation,
                translation_mm=found.part_from_view[k].translation_mm,
                covariance=found.pose_covariance[k],
                n_markers=int(numbers.n_shared[k]),
                rms_mm=float(numbers.rms_mm[k]),
                cloud=cloud_of.get(name),
            )
            for k, (view, name) in enumerate(zip(joined.placed, numbers.placed, strict=True))
        ),
        residuals=_residual_bodies(numbers.shared),
        moved=tuple(
            MovedMarker(
                id=int(numbers.ids[k]),
                common_id=int(joined.sightings.marker[k]) + 1,
                offset_mm=found.residual_mm[k],
            )
            for k in np.flatnonzero(~found.is_used)
        ),
        not_joined=tuple(
            ScanNotJoined(name=names[item.view], reason=item.reason) for item in joined.left
        ),
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
    )


def _views_quantities(
    joined: JoinedViews,
    names: Sequence[str],
    numbers: ViewNumbers,
    sigma: FloatArray,
    shift: FloatArray,
) -> tuple[Quantity, ...]:
    last, largest = int(np.argmax(sigma)), float(shift.max())
    drift_of = names[joined.placed[last]]
    moved = f"solving together moved a view by {significant(largest, 'mm')} at most"
    if largest < LEAST_MM:
        moved = "solving together changed nothing: no loop closes"
    n_seen = len(joined.sightings)
    return (
        Quantity(
            "n_joined",
            "Views joined",
            len(joined.placed),
            shown=f"{len(joined.placed)} of {len(names)}",
            meaning=f"{joined.n_links} pairs match",
        ),
        Quantity("n_views", "", len(names)),
        Quantity("not_joined", "", [names[item.view] for item in joined.left]),
        Quantity("n_links", "", joined.n_links),
        Quantity(
            "n_markers",
            "Markers",
            len(joined.map.markers_mm),
            meaning=f"seen {n_seen} times, one by {int(numbers.n_seen.max())} views at most",
        ),
        Quantity("n_sightings", "", n_seen),
        Quantity("n_left_out", "", int((~joined.map.is_used).sum())),
        Quantity("n_contradictions", "", joined.n_contradictions),
        Quantity(
            "rms_mm",
            "Residuals",
            _rms(numbers.shared.residual_mm[numbers.shared.is_used]),
            unit="mm",
            meaning="root mean square, three axes together",
        ),
        Quantity(
            "drift_sigma_mm",
            "Drift",
            float(sigma[last]),
            unit="mm",
            meaning=f"uncertainty of {drift_of} against the first view; {moved}",
        ),
        Quantity("drift_of", "", drift_of),
        Quantity("largest_shift_mm", "", largest),
    )


def _view_table(
    joined: JoinedViews, numbers: ViewNumbers, sigma: FloatArray, shift: FloatArray
) -> Table:
    heads = ("view", "markers", "shared", "rms mm", "uncertainty mm", "moved by joint solve mm")
    rows = tuple(
        (
            name,
            str(len(joined.marker_of[k])),
            str(int(numbers.n_shared[k])),
            *(f"{value[k]:.4f}" for value in (numbers.rms_mm, sigma, shift)),
        )
        for k, name in enumerate(numbers.placed)
    )
    return Table(heads, rows, "In the order in which they were placed")


def _views_scene(
    joined: JoinedViews, numbers: ViewNumbers, clouds: Sequence[PointCloud], frame: CloudFrame
) -> MarkerScene:
    """Each shared marker once, by its first sighting, and every sighting that was left out."""
    marker, found = joined.sightings.marker, joined.map
    first = np.unique(marker, return_index=True)[1]
    shared = first[numbers.n_seen[marker[first]] > 1]
    rows = np.union1d(shared, np.flatnonzero(~found.is_used)).astype(int)
    return MarkerScene(
        points_mm=found.markers_mm[marker[rows]],
        residual_mm=found.residual_mm[rows],
        is_used=found.is_used[rows],
        lonely_mm=found.markers_mm[numbers.n_seen == 1],
        stations=[
            (name, np.array(pose.translation_mm))
            for name, pose in zip(numbers.placed, found.part_from_view, strict=True)
        ],
        clouds=clouds,
        is_z_up=frame == "Base",
    )


def _views_warnings(
    joined: JoinedViews, lists: Sequence[MarkerList], names: Sequence[str]
) -> tuple[str, ...]:
    found = [
        f"{names[item.view]} is not joined: {item.reason}; {item.remedy}" for item in joined.left
    ]
    first = lists[0].markers.frame
    found += [
        f"{item.path.name} is in {item.markers.frame} and {lists[0].path.name} in {first}: the "
        "result is in the frame of the first list, so name that first whose frame it should have"
        for item in lists[1:]
        if item.markers.frame not in (first, "Sensor")
    ]
    assumed = [item for item in lists if item.is_sigma_assumed]
    if assumed:
        found.append(f"{len(assumed)} lists give no covariance: {_assumed_sigma(assumed)}")
    if not joined.map.is_settled:
        found.append(
            "the map of all views was stopped before it reached the best fit; do not rely on it: "
            "leave out the views with the largest residuals"
        )
    if n := int((~joined.map.is_used).sum()):
        found.append(f"{n} sightings do not fit the others and were left out")
    if joined.n_contradictions:
        found.append(
            f"{joined.n_contradictions} pairs of markers contradict stronger ones and were dropped"
        )
    found += [
        f"the markers of {names[view]} scatter {factor:.2g} times as much as its covariances let "
        "expect: its uncertainty is taken for so much larger"
        for view, factor in zip(joined.placed, joined.map.factor, strict=True)
        if factor > 1.0
    ]
    return (*found, *_uncounted(lists))


def _join_place(
    old_path: Path, new_path: Path, paths: Sequence[Path], options: RegisterOptions
) -> _Joined:
    old, new = (
        read_marker_list(path, frame="Base", sigma_mm=options.sigma_mm)
        for path in (old_path, new_path)
    )
    _refuse_vain_sigma((old, new), options)
    for item in (old, new):
        if item.markers.frame == "Sensor":
            raise InputError(
                "the markers are in Sensor, and an arm that moved has measured them in its Base",
                where=str(item.path),
                remedy="leave --moved out for views of a sensor, or correct '# frame =' there",
            )
    if not paths and (beside := _cloud_beside(new_path)) is not None:
        paths = (beside,)
    clouds = [
        _read_cloud(path, name, new)
        for path, name in zip(paths, _different_names(paths), strict=True)
    ]
    place = register_place(old, new, options)
    fit, frame = place.fit, _common_frame(old)
    carried = [
        replace(item, cloud=carry_cloud(item.cloud, fit.value, fit.covariance, frame))
        for item in clouds
    ]
    residuals = place_residuals(old, new, place)
    n_used, rms = int(place.is_used.sum()), _rms(place.residual_mm[place.is_used])
    at_markers = added_sigma_mm(new.markers.points_mm[place.pairs[:, 1]], place)
    rows = [("markers", str(n_used), significant(at_markers))]
    for one in clouds:
        added = added_sigma_mm(one.cloud.points_mm, place)
        rows.append((one.name, f"{len(one.cloud):,}", significant(added)))
    told = _place_quantities(old, new, place, rms, at_markers)
    moved = fact("Moved markers", str(len(place.moved)), "named below" if place.moved else "")
    report = RegisterReport(
        title="The arm's new place in its old frame",
        subtitle=f"{new.path.name} carried to the frame {old.markers.frame} of {old.path.name}",
        quantities=told,
        cards=(*only(told, "n_common", "rms_mm", "sigma_at_markers_mm"), moved),
        scans=Table(("carried", "points", "uncertainty added, mm"), tuple(rows)),
        residuals=with_strays(residuals, old, place),
        residuals_are="Old minus carried new",
        scene=_place_scene(old, new, place, [item.cloud for item in carried]),
        drift=None,
        warnings=_place_warnings(old, new, place),
    )
    transform = ScanTransform(
        name=new.path.stem,
        markers=path_text(new.path),
        own_frame=new.markers.frame,
        rotation_rows=fit.value.rotation,
        translation_mm=fit.value.translation_mm,
        covariance=fit.covariance,
        n_markers=n_used,
        rms_mm=rms,
        cloud=", ".join(item.name for item in carried) or None,
    )
    return _Joined(
        frame=old.markers.frame,
        report=report,
        lists=(old, new),
        carried=carried,
        markers=joint_markers(old, new, place),
        transforms=(transform,),
        residuals=_residual_bodies(residuals),
        moved=tuple(
            MovedMarker(id=item.new_id, common_id=item.old_id, offset_mm=item.offset_mm)
            for item in place.moved
        ),
        not_joined=(),
        chi2=fit.chi2,
        degrees_of_freedom=fit.degrees_of_freedom,
    )


def _place_quantities(
    old: MarkerList, new: MarkerList, place: PlaceRegistration, rms: float, at_markers: float
) -> tuple[Quantity, ...]:
    pose, vector = place.fit.value, place.fit.value.rotation_vector_rad
    turn_sigma = vector_sigma(vector, place.fit.covariance[:3, :3])
    turns = np.degrees(vector), np.degrees(turn_sigma)
    shift = zip(pose.translation_mm, place.fit.sigma[3:], strict=True)
    rival = {
        BY_ID: "given by their ids",
        UNCHECKED: "paired by the thesis's eight steps, unchecked",
    }.get(
        place.n_rival,
        f"found by distances; no other way explains more than {max(place.n_rival, 3)}",
    )
    return (
        Quantity(
            "n_common",
            "Common markers",
            int(place.is_used.sum()),
            meaning=f"of {len(old.markers)} old and {len(new.markers)} new, {rival}",
        ),
        Quantity("n_matched", "", len(place.pairs)),
        Quantity("n_only_old", "", len(place.only_old)),
        Quantity("n_only_new", "", len(place.only_new)),
        Quantity("only_old_ids", "", list(place.only_old)),
        Quantity("only_new_ids", "", list(place.only_new)),
        Quantity(
            "rms_mm",
            "Residuals",
            rms,
            unit="mm",
            meaning="root mean square, three axes together",
        ),
        Quantity(
            "sigma_at_markers_mm",
            "Uncertainty at the markers",
            at_markers,
            unit="mm",
            meaning="one standard deviation, three axes together; common to all points",
        ),
        fact("Translation", f"{', '.join(with_sigma(v, s) for v, s in shift)} mm"),
        fact(
            "Rotation vector",
            f"{', '.join(with_sigma(v, s) for v, s in zip(*turns, strict=True))} degrees",
        ),
        Quantity("chi2_probability", "", place.chi2_probability),
    )


def _place_scene(
    old: MarkerList, new: MarkerList, place: PlaceRegistration, clouds: Sequence[PointCloud]
) -> MarkerScene:
    pose, points = place.fit.value, old.markers.points_mm
    matched = old.markers.ids[place.pairs[:, 0]]
    strays = [item for item in place.moved if item.old_id not in set(matched.tolist())]
    at = np.isin(old.markers.ids, [item.old_id for item in strays])
    lonely_old = points[np.isin(old.markers.ids, place.only_old)]
    lonely_new = new.markers.points_mm[np.isin(new.markers.ids, place.only_new)]
    none = np.zeros((int(at.sum()), 3))
    return MarkerScene(
        points_mm=np.concatenate([points[place.pairs[:, 0]], points[at]]),
        residual_mm=np.concatenate([-place.residual_mm, none]),
        is_used=np.concatenate([place.is_used, np.zeros(len(none), dtype=bool)]),
        lonely_mm=np.concatenate([lonely_old, pose.apply(lonely_new)]),
        stations=[("old base", np.zeros(3)), ("new base", np.array(pose.translation_mm))],
        clouds=clouds,
        is_z_up=old.markers.frame != "Sensor",
    )


def _place_warnings(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> tuple[str, ...]:
    found = [
        f"{item.path.name} gives no covariance: {_assumed_sigma([item])}"
        for item in (old, new)
        if item.is_sigma_assumed
    ]
    found += [
        f"marker {item.old_id} (new {item.new_id}) moved by "
        f"{significant(float(np.linalg.norm(item.offset_mm)), 'mm')} and was left out; "
        "markers.csv has its new place"
        for item in place.moved
    ]
    found += (*_uncounted([new]), *_too_small(place.fit.chi2, place.fit.degrees_of_freedom))
    across = spread_mm(old.markers.points_mm[place.pairs[place.is_used][:, 0]])
    if across[1] < WEAK_SHARE * across[0]:
        found.append(
            f"the common markers lie nearly on a line ({significant(float(across[1]), 'mm')} to "
            "either side): the turn about it is weak"
        )
    return tuple(found)
