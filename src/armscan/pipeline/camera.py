# SPDX-License-Identifier: Apache-2.0
"""From exposures of a target to a calibrated camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.calibrate import calibrate_camera
from armscan.calibration.camera.options import MIN_VIEWS, CameraOptions
from armscan.calibration.camera.result import CameraFit
from armscan.geometry.estimate import FitFailure
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.target_count import wrong_count
from armscan.records.exposure import Exposure
from armscan.vision.targets.circle_centres import correct_centres
from armscan.vision.targets.definition import Target
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import TargetView

DETECTION_THREADS = 2
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
    options = options or CameraOptions()
    total = len(exposures) if isinstance(exposures, Sized) else 0
    views: list[TargetView] = []
    not_found: list[tuple[str, str]] = []
    answers: list[TargetView | FitFailure] = []
    for done, (source, found) in enumerate(detect_in_order(exposures, target, target_options), 1):
        if isinstance(found, FitFailure):
            not_found.append((source, found.reason))
        else:
            views.append(found)
        progress(ProgressEvent("find target", done, max(total, done), source))
        answers.append(found)
        wrong = wrong_count(answers, target)
        if wrong is not None:
            return wrong
    missing = _too_few(views, not_found)
    if missing is not None:
        return missing
    run = calibrate_camera_from_views(views, options, progress=progress)
    if isinstance(run, FitFailure):
        return FitFailure(run.reason + _listed(not_found), run.remedy)
    return CameraRun(run.fit, tuple(not_found), run.centre_rounds)


def detect_in_order(
    exposures: Iterable[Exposure], target: Target, options: TargetOptions | None
) -> Iterator[tuple[str, TargetView | FitFailure]]:
    """Detect in a few threads, in order, without holding more exposures than threads."""
    waiting: deque[tuple[str, Future[TargetView | FitFailure]]] = deque()
    with ThreadPoolExecutor(DETECTION_THREADS) as pool:
        for exposure in exposures:
            waiting.append((exposure.source, pool.submit(detect_target, exposure, target, options)))
            if len(waiting) == DETECTION_THREADS:
                source, future = waiting.popleft()
                yield source, future.result()
        for source, future in waiting:
            yield source, future.result()


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


def _too_few(views: list[TargetView], not_found: list[tuple[str, str]]) -> FitFailure | None:
    n_images = len(views) + len(not_found)
    if len(views) >= MIN_VIEWS:
        return None
    if n_images < MIN_VIEWS:
        given = "1 image was" if n_images == 1 else f"{n_images} images were"
        return FitFailure(
            f"{given} given, a camera needs at least {MIN_VIEWS}",
            "take 10 to 20 images with the board tilted by 20 to 45 degrees in all directions",
        )
    return FitFailure(
        f"the target was found in {len(views)} of {n_images} images, a camera needs {MIN_VIEWS}"
        + _listed(not_found),
        "check columns, rows and kind of the target, and that all of it is in the image",
    )


def _listed(not_found: list[tuple[str, str]]) -> str:
    """First few of the exposures without target; each reason names its exposure or is prefixed."""
    if not not_found:
        return ""
    parts = [
        reason if reason.startswith(source) else f"{source}: {reason}"
        for source, reason in not_found[:3]
    ]
    more = f"; and {len(not_found) - 3} more" if len(not_found) > 3 else ""
    return f" (no target: {'; '.join(parts)}{more})"
