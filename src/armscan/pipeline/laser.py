# SPDX-License-Identifier: Apache-2.0
"""From images of stripes on a board to calibrated light sheets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armscan.calibration.laser.calibrate import calibrate_sheets, sight_on_boards
from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.result import BoardStripes, LaserFit, SkippedImage
from armscan.calibration.laser.target_edges import find_target_edges
from armscan.devices.scan_source import ScanSource
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration
from armscan.models.stereo import StereoCalibration
from armscan.pipeline.board_placements import (
    Placement,
    SeenBoard,
    find_placements,
    placement_of,
)
from armscan.pipeline.cached_detection import cached_profile
from armscan.pipeline.exposure_pairs import (
    ExposurePair,
    check_sizes,
    pair_by_view,
    pair_exposures,
)
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.stripe_channel import choose_channel
from armscan.pipeline.target_count import wrong_count
from armscan.records.exposure import Exposure
from armscan.storage.detection_cache import DetectionCache
from armscan.vision.stripe.options import SIGMA_RANGE_PX, LaserColour, StripeOptions
from armscan.vision.targets.definition import Target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import TargetView

BOARDS_STAGE = "boards"
STRIPES_STAGE = "stripes"
LITTLE = 0.5
"""Of the usual count of points on the common sheet: with fewer an image is looked at again."""
LEAST_WIDTHS = 3
"""Images with a stripe on the common sheet from which on the line's width is known."""


@dataclass(frozen=True, slots=True)
class LaserOptions:
    """Options of the three stages: target, stripes, sheets."""

    target: TargetOptions = field(default_factory=TargetOptions)
    stripes: StripeOptions = field(default_factory=StripeOptions)
    sheets: SheetOptions = field(default_factory=SheetOptions)


def calibrate_sheets_from_scan(
    source: ScanSource,
    target: Target,
    camera: CameraCalibration | StereoCalibration,
    *,
    options: LaserOptions | None = None,
    progress: Progress = silent,
) -> LaserFit | FitFailure:
    """Find boards and stripes in a recording and calibrate the sheets.

    Exposures of one view and camera share the one that has no laser on; each source may be on
    alone, or a source of several sheets with all of them. With the calibration of two cameras the
    exposures of both are used, else those of camera 0.

    Raises
    ------
    InputError
        If no exposure has a laser on, or an exposure is not of its camera's size.
    """
    exposures = [
        source.exposure(k)
        for k, row in enumerate(source.rows)
        if row.camera == 0 or isinstance(camera, StereoCalibration)
    ]
    pairs = pair_by_view(exposures)
    return calibrate_sheets_from_pairs(pairs, target, camera, options=options, progress=progress)


def calibrate_sheets_from_exposures(
    exposures: Sequence[Exposure],
    target: Target,
    camera: CameraCalibration | StereoCalibration,
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
        Calibrated with images of the same size; of two cameras, `Exposure.camera` says which one
        took an image.
    backgrounds
        The same placements without laser, one for each exposure (one may be given several times),
        or none. The board is then found in the image without laser, or in the one with it where
        that fails.
    options
        Defaults if None.
    progress
        Told of every image.

    Raises
    ------
    InputError
        If images and backgrounds do not pair, or are not of the camera's size.
    """
    pairs = pair_exposures(exposures, backgrounds)
    return calibrate_sheets_from_pairs(pairs, target, camera, options=options, progress=progress)


def calibrate_sheets_from_pairs(
    pairs: Sequence[ExposurePair],
    target: Target,
    camera: CameraCalibration | StereoCalibration,
    *,
    options: LaserOptions | None = None,
    cache: DetectionCache | None = None,
    progress: Progress = silent,
) -> LaserFit | FitFailure:
    """As `calibrate_sheets_from_exposures`, with each exposure's partner chosen already.

    What ``cache`` knows of targets and stripes is not looked for again.
    """
    options = options or LaserOptions()
    cameras = HeadCameras.of(camera)
    for pair in pairs:
        images = [image for image in pair if image is not None]
        check_sizes(images, cameras.model(pair[0].camera))
    places: dict[str, Placement] = {}
    answers: list[TargetView | FitFailure] = []
    for place in _found_placements(pairs, target, cameras, options, cache=cache, progress=progress):
        places[place.name] = place
        answers += [
            item if isinstance(item, FitFailure) else item[1] for item in place.seen.values()
        ]
        wrong = wrong_count(answers, target)
        if wrong is not None:
            return wrong
    shown = [pair for pair in pairs if _seen(pair, places) is not None]

    def stripes_of(
        pair: ExposurePair, colour: LaserColour, line_sigma_px: float | None = None
    ) -> BoardStripes | FitFailure:
        sigma = options.stripes.line_sigma_px or line_sigma_px
        chosen = replace(options.stripes, laser_colour=colour, line_sigma_px=sigma)
        place = places[placement_of(pair)]
        return _board_stripes(pair, place, target, cameras, chosen, cache=cache)

    def tried(k: int, colour: LaserColour) -> BoardStripes | None:
        found = stripes_of(shown[k], colour)
        return None if isinstance(found, FitFailure) else found

    colour, choice = options.stripes.laser_colour, None
    if colour == "auto" and any(pair[0].colour != "mono" for pair in shown):
        choice = choose_channel(len(shown), tried, cameras, options.sheets)
        colour = "auto" if choice is None else choice.channel
    looked: list[BoardStripes | FitFailure] = []
    for done, pair in enumerate(pairs):
        progress(ProgressEvent(STRIPES_STAGE, done, len(pairs), pair[0].source))
        looked.append(stripes_of(pair, colour))
    progress(ProgressEvent(STRIPES_STAGE, len(pairs), len(pairs)))
    if options.stripes.line_sigma_px is None:

        def again(k: int, line_sigma_px: float) -> BoardStripes | FitFailure:
            return stripes_of(pairs[k], colour, line_sigma_px)

        looked = _looked_twice(looked, again, cameras, options.sheets)
    boards = [found for found in looked if isinstance(found, BoardStripes)]
    skipped = [
        SkippedImage(pair[0].source, found.reason.removeprefix(f"{pair[0].source}: "))
        for pair, found in zip(pairs, looked, strict=True)
        if isinstance(found, FitFailure)
    ]
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
    return replace(
        fit,
        skipped=(*skipped, *fit.skipped),
        laser_colour=colour,
        channel_reason="" if choice is None else choice.reason,
    )


def _looked_twice(
    looked: Sequence[BoardStripes | FitFailure],
    again: Callable[[int, float], BoardStripes | FitFailure],
    cameras: HeadCameras,
    options: SheetOptions,
) -> list[BoardStripes | FitFailure]:
    """Look again, for a line as wide as in the others, where little lies on the common sheet.

    The width of the line is found in each image by itself, and what is bright beside the line may
    be narrower or wider than it. One laser in one set has one width.
    """
    found = list(looked)
    shown = [k for k, board in enumerate(found) if isinstance(board, BoardStripes)]
    boards = [board for board in found if isinstance(board, BoardStripes)]
    images = sight_on_boards(boards, cameras, options).images if boards else ()
    widths = [
        np.median(image.data.profile.width_px[np.concatenate([s.rows for s in image.sightings])])
        for image in images
        if image.sightings
    ]
    if len(widths) < LEAST_WIDTHS:
        return found
    sigma_px = float(np.clip(np.median(widths), *SIGMA_RANGE_PX))
    counts = {k: sum(len(s.rows) for s in i.sightings) for k, i in zip(shown, images, strict=True)}
    usual = float(np.median([count for count in counts.values() if count]))
    for k, first in enumerate(looked):
        if counts.get(k, 0) >= LITTLE * usual:
            continue
        second = again(k, sigma_px)
        if isinstance(second, BoardStripes) and _clean(second) > _clean(first):
            found[k] = second
    return found


def _clean(board: BoardStripes | FitFailure) -> int:
    """Count of clean stripe points."""
    return 0 if isinstance(board, FitFailure) else int(board.profile.is_accepted.sum())


def _found_placements(
    pairs: Sequence[ExposurePair],
    target: Target,
    cameras: HeadCameras,
    options: LaserOptions,
    *,
    cache: DetectionCache | None,
    progress: Progress,
) -> Iterator[Placement]:
    """Look for the board in each placement, telling of each."""
    n_places = len({placement_of(pair) for pair in pairs})
    found = find_placements(pairs, target, cameras, options.target, cache)
    for done, placement in enumerate(found):
        progress(ProgressEvent(BOARDS_STAGE, done + 1, n_places, placement.name))
        yield placement


def _seen(pair: ExposurePair, places: Mapping[str, Placement]) -> SeenBoard | None:
    """The board as the pair's camera saw it; None where it found none."""
    seen = places[placement_of(pair)].seen[pair[0].camera]
    return None if isinstance(seen, FitFailure) else seen


def _board_stripes(
    pair: ExposurePair,
    placement: Placement,
    target: Target,
    cameras: HeadCameras,
    options: StripeOptions,
    *,
    cache: DetectionCache | None,
) -> BoardStripes | FitFailure:
    """Stripes of one exposure on its placement's board and around it."""
    exposure, background = pair
    seen = placement.seen[exposure.camera]
    if isinstance(seen, FitFailure):
        return seen
    camera, view, pose = seen
    dark = None if background is None else around_board(view, background)
    profile = cached_profile(around_board(view, exposure), options, dark, cache)
    if not bool(profile.is_accepted.any()):
        return FitFailure("no stripe was found on or around the board", "check laser and exposure")
    edges = find_target_edges(view, target, pose.value, cameras.model(camera))
    placed, name = placement.placed, placement.name
    return BoardStripes(profile, view, pose, exposure.lasers, edges, camera, placed, name)


def around_board(view: TargetView, exposure: Exposure) -> Exposure:
    """The part of an exposure that shows the board, with as much again on every side.

    What is bright elsewhere, a lamp or a window, then does not set the threshold.
    """
    points = exposure.window.to_image(view.points_px)
    reach = float(np.ptp(points, axis=0).max())
    left, top = np.floor(points.min(axis=0) - reach).astype(int)
    right, bottom = np.ceil(points.max(axis=0) + reach).astype(int) + 1
    return exposure.cropped(
        max(left, 0), max(top, 0), min(right, exposure.width_px), min(bottom, exposure.height_px)
    )
