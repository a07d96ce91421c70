# SPDX-License-Identifier: Apache-2.0
"""Calibrate cameras from exposures: find the target, solve, correct circle centres, and make
the document's content of what was found; one camera or two.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import MIN_PAIRS, SIDES, StereoOptions, StereoPair
from armscan.calibration.cameras.print_errors import agreeing_numberings, missed_places_mm
from armscan.calibration.cameras.result import (
    MIN_VIEWS,
    BoardWarp,
    CameraFit,
    CameraOptions,
)
from armscan.calibration.cameras.stereo_result import SideFit, StereoFit
from armscan.errors import InputError, begun
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose
from armscan.models.calibration import (
    CameraCalibration,
    CameraDiagnostics,
    FTest,
    Provenance,
    WarpedBoard,
)
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.models.two_views import StereoCalibration, StereoDiagnostics
from armscan.pipeline.instants import check_sizes, group_instants
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.targets import FoundTargets, find_targets, on_sensor
from armscan.records.exposure import Exposure
from armscan.records.recording import ExposureRow
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import Numbering, numberings, renumbered
from armscan.vision.targets.target import Target, TargetView

CENTRE_ROUNDS = 5
CENTRES_STABLE = 0.02
"""Circle centres are stable when no camera parameter moves by more than this many sigmas."""
MODEL_ROUNDS = 3
"""Circle centres settle for a pinhole, then, if another lens is chosen, for that one."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraRun:
    """A calibrated camera, and the exposures in which no target was found.

    Parameters
    ----------
    fit
        The result.
    not_found
        (source, reason) of exposures without a usable target.
    centre_rounds
        How often circle centres were measured again with cameras of the model that was chosen
        last; 0 for other targets.
    """

    fit: CameraFit
    not_found: tuple[tuple[str, str], ...]
    centre_rounds: int


def calibrate_camera_from_exposures(
    exposures: Iterable[Exposure],
    target: Target,
    options: CameraOptions | None = None,
    *,
    progress: Progress = silent,
) -> CameraRun | FitFailure:
    """Find the target in each exposure and calibrate.

    The centre of a circle's image is not the image of its centre, and the correction needs
    undistorted edges: for circle grids the centres are measured again with each solution until the
    camera stays where it is.

    Parameters
    ----------
    exposures
        Taken one after the other, so that a generator needs to hold only a few at a time.
    target
        What to look for.
    options
        Of the calibration; None for the defaults.
    progress
        Is told of each exposure and of each solution.

    Returns
    -------
    run
        The camera with its evidence, or why there is none: with the reason for each exposure in
        which the target was not found.

    Raises
    ------
    InputError, OptionError
        As `calibrate_camera`.
    """
    found = find_targets(exposures, target, progress=progress)
    return calibrate_camera_from_found(found, target, options, progress=progress)


def calibrate_camera_from_found(
    found: FoundTargets,
    target: Target,
    options: CameraOptions | None = None,
    *,
    progress: Progress = silent,
) -> CameraRun | FitFailure:
    """As `calibrate_camera_from_exposures`, with the targets looked for already."""
    options = options or CameraOptions()
    if found.wrong_count is not None:
        return found.wrong_count
    missing = _too_few(found)
    if missing is not None:
        return missing
    options = replace(options, leave_out=found.shown_of(options.leave_out))
    run = calibrate_camera_from_views(found.views, options, target=target, progress=progress)
    if isinstance(run, FitFailure):
        return FitFailure(run.reason + found.not_found_text(), run.remedy)
    return CameraRun(run.fit, found.not_found, run.centre_rounds)


def calibrate_camera_from_views(
    views: Sequence[TargetView],
    options: CameraOptions | None = None,
    *,
    target: Target | None = None,
    progress: Progress = silent,
) -> CameraRun | FitFailure:
    """Calibrate; for circles, correct the centres with the camera and calibrate again.

    Parameters, errors and result as `calibrate_camera_from_exposures`, with the target found.
    Views of a ``target`` that looks alike when turned are numbered alike, if what its points miss
    their places by tells how.
    """
    options = options or CameraOptions()
    total = MODEL_ROUNDS if any(view.edges is not None for view in views) else 1
    model = options.distortion
    done = 0
    while True:
        done += 1
        rounds, settled = 0, None
        if total > 1:
            plain = replace(options, distortion=model, n_folds=0, solve_print=False)
            try:
                views, rounds, settled = _with_settled_centres(views, plain)
                if settled is not None:
                    views = _views_numbered_alike(views, settled, target)
            except InputError:
                # a pinhole may fold over where the lens that is chosen does not
                if done > 1 or options.distortion != "auto":
                    raise
        fit = calibrate_camera(views, replace(options, solve_print=False))
        if isinstance(fit, FitFailure):
            return fit
        is_same = settled is not None and settled.free_parameters == fit.free_parameters
        if is_same or done == total:
            progress(ProgressEvent("solve", total, total))
            fit = numbered_alike(views, fit, target)
            printed = fit
            if options.solve_print:
                posed = [one.view for one in fit.views]
                named = {view.source for view in posed}
                left_out = tuple(name for name in options.leave_out if name in named)
                again = calibrate_camera(posed, replace(options, leave_out=left_out))
                if isinstance(again, FitFailure):
                    return again
                printed = replace(again, refused_views=fit.refused_views)
            return CameraRun(printed, (), rounds)
        progress(ProgressEvent("solve", done, total))
        model = "fisheye" if fit.camera.lens == "fisheye" else options.distortion


def _with_settled_centres(
    views: Sequence[TargetView], options: CameraOptions
) -> tuple[Sequence[TargetView], int, CameraFit | None]:
    """Measure circle centres again with the camera until it stays, by one model.

    Which model the views ask for, and how well it predicts, matters only once they are right.
    Returns the views, how often they were measured again, and the camera that fits them; None
    where there is none.
    """
    before: CameraFit | None = None
    for rounds in range(CENTRE_ROUNDS):
        fit = calibrate_camera(views, options)
        if isinstance(fit, FitFailure):
            return views, rounds, None
        if before is not None and _moved_sigmas(before, fit) < CENTRES_STABLE:
            return views, rounds, fit
        before = fit
        if rounds < CENTRE_ROUNDS - 1:
            views = [_corrected(view, fit) for view in views]
    return views, CENTRE_ROUNDS - 1, before


def numbered_alike(views: Sequence[TargetView], fit: CameraFit, target: Target | None) -> CameraFit:
    """The camera of the same views, numbered alike if the target looks alike when turned.

    See `armscan.calibration.cameras.print_errors.agreeing_numberings`.
    """
    alike = _views_numbered_alike(views, fit, target)
    if alike is views:
        return fit
    again = calibrate_camera(alike, fit.options)
    return fit if isinstance(again, FitFailure) else again


def _views_numbered_alike(
    views: Sequence[TargetView], fit: CameraFit, target: Target | None
) -> Sequence[TargetView]:
    """The views, by what their points miss before a camera; themselves where that changes none."""
    if target is None or not target.symmetric_turns:
        return views
    seen = [
        _Seen(fit.camera, view.view, view.sensor_from_board, view.residuals_px, view.is_outlier)
        for view in fit.used_views
        if not view.is_misfit
    ]
    known = numberings(target)
    turn = _numbering_of(seen, known)
    if not turn:
        return views
    return [renumbered(view, target, turn.get(view.source, known[0])) for view in views]


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A view with its camera, and its pose, residuals and outliers before that camera."""

    camera: CameraModel
    view: TargetView
    pose: Pose[Any, Board]
    residuals_px: FloatArray
    is_outlier: BoolArray


def _numbering_of(seen: Sequence[_Seen], known: Sequence[Numbering]) -> dict[str, Numbering]:
    """Numbering of each view, by source, in which all agree; empty if none changes."""
    places = [one.view.points_board_mm[~one.is_outlier] for one in seen]
    missed = [
        missed_places_mm(one.camera, one.pose, board_mm, one.residuals_px[~one.is_outlier])
        for board_mm, one in zip(places, seen, strict=True)
    ]
    chosen = agreeing_numberings(places, missed, known)
    if chosen is None:
        return {}
    return {one.view.source: known[k] for one, k in zip(seen, chosen, strict=True)}


def _corrected(view: TargetView, fit: CameraFit) -> TargetView:
    return view if view.edges is None else correct_centres(view, fit.camera)


def _moved_sigmas(before: CameraFit, after: CameraFit) -> float:
    moved = np.abs(after.camera.parameters - before.camera.parameters)
    is_free = after.sigma > 0.0
    if not np.array_equal(is_free, before.sigma > 0.0):
        return float("inf")
    return float(np.max(moved[is_free] / after.sigma[is_free]))


def _too_few(found: FoundTargets) -> FitFailure | None:
    n_images = len(found.views) + len(found.not_found)
    if len(found.views) >= MIN_VIEWS:
        return None
    if n_images < MIN_VIEWS:
        given = "1 image was" if n_images == 1 else f"{n_images} images were"
        return FitFailure(
            f"{given} given, a camera needs at least {MIN_VIEWS}",
            "take 10 to 20 images with the board tilted by 20 to 45 degrees in all directions",
        )
    return FitFailure(
        f"the target was found in {len(found.views)} of {n_images} images, a camera needs "
        f"{MIN_VIEWS}{found.not_found_text()}",
        "check columns, rows and kind of the target, and that all of it is in the image",
    )


LISTED = 4

Given = tuple[CameraCalibration, CameraCalibration]
ExposedPair = tuple[Exposure | None, Exposure | None]


@dataclass(frozen=True, slots=True, eq=False)
class StereoRun:
    """Two calibrated cameras, and the exposures in which no target was found.

    Parameters
    ----------
    fit
        The result.
    not_found
        (source, reason) of exposures without a usable target.
    """

    fit: StereoFit
    not_found: tuple[tuple[str, str], ...]


def pair_lists(left: Sequence[Exposure], right: Sequence[Exposure]) -> list[ExposedPair]:
    """Pair two lists of exposures in their order.

    Raises
    ------
    InputError
        If the lists differ in length, or an exposure is in both.
    """
    if len(left) != len(right):
        alone = without_partner(left, right)
        has = "has" if len(alone) == 1 else "have"
        named = f"; by the numbers in their names {_listed(alone)} {has} no partner"
        raise InputError(
            f"{len(left)} left images ({_listed(left)}) but {len(right)} right ones "
            f"({_listed(right)}){named if 0 < len(alone) <= LISTED else ''}",
            remedy="give one right image for each left image, in the same order, or name those "
            "without a partner by --leave-out",
        )
    on_the_right = {exposure.source for exposure in right}
    for exposure in left:
        if exposure.source in on_the_right:
            raise InputError(
                "the same image is given for both cameras",
                where=exposure.source,
                remedy="give the images of the right camera as the second argument",
            )
    return list(zip(left, right, strict=True))


def stereo_rows(rows: Sequence[ExposureRow], where: str) -> list[tuple[int | None, int | None]]:
    """Rows of a recording that show a target without laser, paired by instant.

    Parameters
    ----------
    rows
        Of the recording.
    where
        Its name, for messages.

    Raises
    ------
    InputError
        If there are not two cameras, or a camera took two exposures at one instant.
    """
    cameras = sorted({row.camera for row in rows})
    if cameras != [0, 1]:
        listed = ", ".join(str(camera) for camera in cameras)
        raise InputError(
            f"two cameras are needed, 0 (left) and 1 (right); the recording has {listed}",
            where=where,
            remedy="name a recording of a head with two cameras",
        )
    dark = [k for k, row in enumerate(rows) if row.is_dark]
    chosen = dark or list(range(len(rows)))
    pairs = []
    for instant in group_instants([rows[k] for k in chosen], where):
        of_camera = {rows[chosen[k]].camera: chosen[k] for k in instant.rows}
        pairs.append((of_camera.get(0), of_camera.get(1)))
    return pairs


def calibrate_stereo_from_found(
    exposures: Sequence[ExposedPair],
    found: FoundTargets,
    target: Target,
    options: StereoOptions | None = None,
    given: Given | None = None,
    *,
    progress: Progress = silent,
) -> StereoRun | FitFailure:
    """Calibrate from exposures in which the target was looked for.

    Parameters
    ----------
    exposures
        Left and right exposure of each instant; None where one camera has none.
    found
        What `find_targets` saw in them.
    target
        What was looked for.
    options, given
        As `calibrate_stereo`.
    progress
        Is told of each solution.

    Returns
    -------
    run
        Both cameras with their evidence, or why there are none.

    Raises
    ------
    InputError, OptionError
        As `calibrate_stereo`.
    """
    if found.wrong_count is not None:
        return found.wrong_count
    for side, known in enumerate(given or ()):
        check_sizes(filter(None, (pair[side] for pair in exposures)), known.camera)
    pairs = _found_pairs(exposures, {view.source: view for view in found.views}, given)
    missing = _stereo_too_few(exposures, pairs, found)
    if missing is not None:
        return missing
    options = options or StereoOptions()
    options = replace(options, leave_out=found.shown_of(options.leave_out))
    run = calibrate_stereo_from_pairs(pairs, target, options, given, progress=progress)
    if isinstance(run, FitFailure):
        return FitFailure(run.reason + found.not_found_text(), run.remedy)
    return replace(run, not_found=found.not_found)


def calibrate_stereo_from_pairs(
    pairs: Sequence[StereoPair],
    target: Target,
    options: StereoOptions | None = None,
    given: Given | None = None,
    *,
    progress: Progress = silent,
) -> StereoRun | FitFailure:
    """Calibrate; for circles, correct the centres with the cameras and calibrate again.

    Parameters, errors and result as `calibrate_stereo_from_found`, of views of the target.
    """
    has_circles = any(
        view is not None and view.edges is not None for pair in pairs for view in pair.views
    )
    total = CENTRE_ROUNDS if has_circles else 1
    fit = calibrate_stereo(pairs, target, options, given)
    progress(ProgressEvent("solve", 1, total))
    if isinstance(fit, FitFailure):
        return fit
    rounds, is_stable = 0, False
    while rounds < total - 1 and not is_stable:
        cameras = fit.views.left, fit.views.right
        pairs = [StereoPair(*map(_stereo_corrected, pair.views, cameras)) for pair in pairs]
        again = calibrate_stereo(pairs, target, options, given)
        if isinstance(again, FitFailure):
            return again
        rounds += 1
        is_stable = _stereo_moved_sigmas(fit, again) < CENTRES_STABLE
        fit = again
        progress(ProgressEvent("solve", total if is_stable else rounds + 1, total))
    alike = _pairs_numbered_alike(pairs, fit, target)
    again = fit if alike is None else calibrate_stereo(alike, target, options, given)
    return StereoRun(fit if isinstance(again, FitFailure) else again, ())


def _pairs_numbered_alike(
    pairs: Sequence[StereoPair], fit: StereoFit, target: Target
) -> list[StereoPair] | None:
    """The pairs of a target that looks alike when turned, numbered alike; None where that is not
    told or changes nothing.
    """
    if not target.symmetric_turns:
        return None
    seen = []
    for fitted in fit.pairs:
        pair, left, right = fitted.pair, fitted.left, fitted.right
        if fitted.is_misfit:
            continue
        if pair.left is not None and left is not None:
            where = left.sensor_from_board
            seen.append(_Seen(fit.views.left, pair.left, where, left.residuals_px, left.is_outlier))
        elif pair.right is not None and right is not None:
            before = fit.views.right_from_left @ right.sensor_from_board
            seen.append(
                _Seen(fit.views.right, pair.right, before, right.residuals_px, right.is_outlier)
            )
    turn = _numbering_of(seen, numberings(target))
    if not turn:
        return None
    alike: dict[str, TargetView] = {}
    for pair in (fitted.pair for fitted in fit.pairs):
        views = [view for view in pair.views if view is not None]
        for numbering in [turn[view.source] for view in views if view.source in turn][:1]:
            alike |= {view.source: renumbered(view, target, numbering) for view in views}
    # views that could not be used are in no pair of the fit
    return [StereoPair(*(v and alike.get(v.source, v) for v in pair.views)) for pair in pairs]


def stereo_calibration(fit: StereoFit, provenance: Provenance) -> StereoCalibration:
    """The document's content of a fit."""
    n = len(PARAMETER_NAMES)
    held_out = fit.hold_out
    pairs = [pair for pair in fit.pairs if not pair.is_related]
    return StereoCalibration(
        left=_camera(fit.left, fit, fit.views.left, slice(0, n), provenance),
        right=_camera(fit.right, fit, fit.views.right, slice(n, 2 * n), provenance),
        right_from_left=fit.views.right_from_left,
        covariance=fit.covariance,
        rms_px=fit.rms_px,
        n_pairs=len(fit.related),
        n_points=fit.n_points,
        provenance=provenance,
        diagnostics=StereoDiagnostics(
            epipolar_rms_px=fit.epipolar_rms_px,
            epipolar_mean_px=fit.epipolar_mean_px,
            left_out=tuple((pair.pair.name, pair.note) for pair in pairs),
            intrinsics=fit.options.intrinsics,
            hold_out_rms_px=None if held_out is None else held_out.rms_px,
            typical_level=fit.typical_level,
            target_error_mm=fit.target_error_mm,
        ),
    )


def _camera(
    side: SideFit, fit: StereoFit, camera: CameraModel, rows: slice, provenance: Provenance
) -> CameraCalibration:
    covariance = fit.covariance[rows, rows]
    return CameraCalibration(
        camera=camera,
        covariance=covariance,
        has_covariance=bool(np.any(covariance)),
        rms_px=side.rms_px,
        sigma_point_px=side.sigma_point_px,
        n_views=side.n_views,
        n_points=side.n_points,
        covered_px=side.coverage.covered_px,
        provenance=provenance,
        diagnostics=CameraDiagnostics(
            free_parameters=side.single.free_parameters,
            model_reason=side.single.reason,
            hold_out_rms_px=None,
            n_folds=0,
            condition=fit.condition,
            noise_scale=side.noise_scale,
            covered_fraction=side.coverage.fraction,
            board=None,
        ),
    )


def _found_pairs(
    exposures: Sequence[ExposedPair], views: dict[str, TargetView], given: Given | None
) -> list[StereoPair]:
    pairs = []
    for left, right in exposures:
        seen = [None if one is None else views.get(one.source) for one in (left, right)]
        if given is not None:
            both = zip(seen, given, strict=True)
            seen = [view and on_sensor(view, known.camera) for view, known in both]
        if any(view is not None for view in seen):
            pairs.append(StereoPair(seen[0], seen[1]))
    return pairs


def _stereo_too_few(
    exposures: Sequence[ExposedPair],
    pairs: Sequence[StereoPair],
    found: FoundTargets,
) -> FitFailure | None:
    n_both = sum(pair.is_seen_by_both for pair in pairs)
    if n_both >= MIN_PAIRS:
        return None
    counts = []
    for side, word in enumerate(SIDES):
        n_images = sum(pair[side] is not None for pair in exposures)
        n_seen = sum(pair.views[side] is not None for pair in pairs)
        counts.append(f"{n_seen} of {n_images} {word} images")
    return FitFailure(
        f"the target was found in {' and '.join(counts)}, in both of {n_both} pairs; "
        f"{MIN_PAIRS} pairs are needed{found.not_found_text()}",
        "take 10 to 20 pairs in which both cameras see the whole target, and check its columns, "
        "rows and kind",
    )


def _stereo_corrected(view: TargetView | None, camera: CameraModel) -> TargetView | None:
    return view if view is None or view.edges is None else correct_centres(view, camera)


def _stereo_moved_sigmas(before: StereoFit, after: StereoFit) -> float:
    """Largest change of a parameter over its standard deviation."""
    old, new = before.views, after.views
    moved = np.concatenate(
        [
            new.left.parameters - old.left.parameters,
            new.right.parameters - old.right.parameters,
            new.right_from_left.step_from(old.right_from_left),
        ]
    )
    is_free = after.sigma > 0.0
    if not np.array_equal(is_free, before.sigma > 0.0):
        return float("inf")
    return float(np.max(np.abs(moved[is_free]) / after.sigma[is_free]))


def _listed(exposures: Sequence[Exposure]) -> str:
    return begun([exposure.source for exposure in exposures], LISTED)


def without_partner(left: Sequence[Exposure], right: Sequence[Exposure]) -> list[Exposure]:
    """Images without a partner by the last number in their names; none where these do not tell."""
    numbers = [
        [re.findall(r"\d+", PurePath(exposure.source).stem)[-1:] for exposure in side]
        for side in (left, right)
    ]
    counted = [{int(found[0]) for found in side if found} for side in numbers]
    is_told = all(len(seen) == len(side) for seen, side in zip(counted, numbers, strict=True))
    if not is_told or not counted[0] & counted[1]:
        return []
    return [
        exposure
        for side, found, other in zip((left, right), numbers, counted[::-1], strict=True)
        for exposure, number in zip(side, found, strict=True)
        if int(number[0]) not in other
    ]


def camera_calibration(fit: CameraFit, provenance: Provenance) -> CameraCalibration:
    """The document's content of a fit."""
    return CameraCalibration(
        camera=fit.camera,
        covariance=fit.covariance,
        has_covariance=True,
        rms_px=fit.rms_px,
        sigma_point_px=fit.sigma_point_px,
        n_views=fit.n_views,
        n_points=fit.n_points,
        covered_px=fit.coverage.covered_px,
        provenance=provenance,
        diagnostics=_camera_diagnostics(fit),
    )


def _camera_diagnostics(fit: CameraFit) -> CameraDiagnostics:
    """Diagnostics of a camera's calibration."""
    held_out = fit.cross_validation
    return CameraDiagnostics(
        free_parameters=fit.free_parameters,
        model_reason=fit.model_reason,
        hold_out_rms_px=None if held_out is None else held_out.rms_px,
        n_folds=0 if held_out is None else held_out.n_folds,
        condition=fit.condition,
        noise_scale=fit.noise_scale,
        covered_fraction=fit.coverage.fraction,
        board=None if fit.warp is None else _bowed_board(fit.warp),
    )


def _bowed_board(warp: BoardWarp) -> WarpedBoard:
    bow_x, bow_y = warp.bow_mm.tolist()
    sigma_x, sigma_y = warp.sigma_mm.tolist()
    test = FTest(
        f_ratio=warp.f_statistic, degrees_of_freedom=len(warp.bow_mm), p_value=warp.p_value
    )
    return WarpedBoard((bow_x, bow_y), (sigma_x, sigma_y), test)
