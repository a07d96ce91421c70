# SPDX-License-Identifier: Apache-2.0
"""From exposures of a target to a calibrated camera."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.camera.calibrate import calibrate_camera
from armscan.calibration.camera.options import MIN_VIEWS, CameraOptions
from armscan.calibration.camera.result import CameraFit
from armscan.geometry.estimate import FitFailure
from armscan.pipeline.found_targets import FoundTargets, find_targets
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.exposure import Exposure
from armscan.vision.targets.circle_centres import correct_centres
from armscan.vision.targets.definition import Target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import TargetView

CENTRE_ROUNDS = 5
CENTRES_STABLE = 0.02
"""Circle centres are stable when no camera parameter moves by more than this many sigmas."""


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
        How often circle centres were measured again with the camera; 0 for other targets.
    """

    fit: CameraFit
    not_found: tuple[tuple[str, str], ...]
    centre_rounds: int


def calibrate_camera_from_exposures(
    exposures: Iterable[Exposure],
    target: Target,
    options: CameraOptions | None = None,
    target_options: TargetOptions | None = None,
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
    options, target_options
        Of the calibration and of the detection; None for the defaults.
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
    found = find_targets(exposures, target, target_options, progress=progress)
    return calibrate_camera_from_found(found, options, progress=progress)


def calibrate_camera_from_found(
    found: FoundTargets, options: CameraOptions | None = None, *, progress: Progress = silent
) -> CameraRun | FitFailure:
    """As `calibrate_camera_from_exposures`, with the targets looked for already."""
    options = options or CameraOptions()
    if found.wrong_count is not None:
        return found.wrong_count
    missing = _too_few(found)
    if missing is not None:
        return missing
    options = replace(options, leave_out=found.shown_of(options.leave_out))
    run = calibrate_camera_from_views(found.views, options, progress=progress)
    if isinstance(run, FitFailure):
        return FitFailure(run.reason + found.not_found_text(), run.remedy)
    return CameraRun(run.fit, found.not_found, run.centre_rounds)


def calibrate_camera_from_views(
    views: Sequence[TargetView],
    options: CameraOptions | None = None,
    *,
    progress: Progress = silent,
) -> CameraRun | FitFailure:
    """Calibrate; for circles, correct the centres with the camera and calibrate again.

    Parameters, errors and result as `calibrate_camera_from_exposures`, with the target found.
    """
    options = options or CameraOptions()
    has_circles = any(view.edges is not None for view in views)
    total = CENTRE_ROUNDS if has_circles else 1
    fit = calibrate_camera(views, options)
    progress(ProgressEvent("solve", 1, total))
    if isinstance(fit, FitFailure):
        return fit
    rounds, is_stable = 0, False
    while rounds < total - 1 and not is_stable:
        views = [_corrected(view, fit) for view in views]
        again = calibrate_camera(views, options)
        if isinstance(again, FitFailure):
            return again
        rounds += 1
        is_stable = _moved_sigmas(fit, again) < CENTRES_STABLE
        fit = again
        progress(ProgressEvent("solve", total if is_stable else rounds + 1, total))
    return CameraRun(fit, (), rounds)


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
