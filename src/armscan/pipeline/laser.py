# SPDX-License-Identifier: Apache-2.0
"""From images of stripes on a board to calibrated light sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from armscan.calibration.camera.board_pose import estimate_board_pose
from armscan.calibration.laser.calibrate import calibrate_sheets
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.result import BoardStripes, LaserFit, SkippedImage
from armscan.calibration.laser.target_edges import find_target_edges
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration
from armscan.pipeline.exposure_pairs import ExposurePair, check_sizes, pair_exposures
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.options import StripeOptions
from armscan.vision.targets.circle_centres import correct_centres
from armscan.vision.targets.definition import Target
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.options import TargetOptions

STAGE = "boards and stripes"


@dataclass(frozen=True, slots=True)
class LaserOptions:
    """Options of the three stages: target, stripes, sheets."""

    target: TargetOptions = field(default_factory=TargetOptions)
    stripes: StripeOptions = field(default_factory=StripeOptions)
    sheets: SheetOptions = field(default_factory=SheetOptions)


def calibrate_sheets_from_exposures(
    exposures: Sequence[Exposure],
    target: Target,
    camera: CameraCalibration,
    *,
    backgrounds: Sequence[Exposure] = (),
    options: LaserOptions | None = None,
    progress: Progress = silent,
) -> LaserFit | FitFailure:
    """Find board and stripes in every image and calibrate the sheets.

    Parameters
    ----------
    exposures
        With the laser on, the board in view.
    target
        The board.
    camera
        Calibrated with images of the same size.
    backgrounds
        The same placements without laser, one for each exposure, or none. The board is then found
        in the image without laser, or in the one with it where that fails.
    options
        Defaults if None.
    progress
        Told of every image.

    Raises
    ------
    InputError
        If images and backgrounds do not pair, or are not of the camera's size.
    """
    options = options or LaserOptions()
    pairs = pair_exposures(exposures, backgrounds)
    check_sizes([*exposures, *backgrounds], camera.camera)
    boards: list[BoardStripes] = []
    skipped: list[SkippedImage] = []
    for done, pair in enumerate(pairs):
        progress(ProgressEvent(STAGE, done, len(pairs), pair[0].source))
        found = find_board_stripes(pair, target, camera, options)
        if isinstance(found, FitFailure):
            skipped.append(SkippedImage(pair[0].source, found.reason))
        else:
            boards.append(found)
    progress(ProgressEvent(STAGE, len(pairs), len(pairs)))
    if not boards:
        return FitFailure(
            f"no board with stripes in any of {len(pairs)} images; {skipped[0].source}: "
            f"{skipped[0].reason}",
            "check the target's description and that the board is lit in one image of each pair",
        )
    fit = calibrate_sheets(boards, camera, options.sheets)
    if isinstance(fit, FitFailure):
        lost = "; ".join(f"{image.source}: {image.reason}" for image in skipped)
        return FitFailure(f"{fit.reason} (not used: {lost})", fit.remedy) if lost else fit
    return replace(fit, skipped=tuple(skipped))


def find_board_stripes(
    pair: ExposurePair, target: Target, camera: CameraCalibration, options: LaserOptions
) -> BoardStripes | FitFailure:
    """Board, its pose and the stripes of one placement."""
    exposure, background = pair
    lit = exposure if background is None else background
    view = detect_target(lit, target, options.target)
    if isinstance(view, FitFailure) and background is not None:
        retried = detect_target(exposure, target, options.target)
        view = view if isinstance(retried, FitFailure) else retried
    if isinstance(view, FitFailure):
        return view
    if view.edges is not None:
        view = correct_centres(view, camera.camera)
    pose = estimate_board_pose(view, camera.camera)
    if isinstance(pose, FitFailure):
        return pose
    profile = extract_stripes(exposure, options.stripes, background)
    if not bool(profile.is_accepted.any()):
        return FitFailure("no stripe was found", "check the laser and the exposure")
    edges = find_target_edges(view, target, pose.value, camera.camera)
    return BoardStripes(profile, view, pose, exposure.lasers, edges)
