# SPDX-License-Identifier: Apache-2.0
"""From images of stripes on a board to calibrated light sheets: board poses, the colour channel
of the stripes, extraction, and the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np

from armscan.calibration.cameras.board_pose import estimate_board_pose
from armscan.calibration.sheets.board_points import HeadCameras, place_board, poses_chi2
from armscan.calibration.sheets.calibrate import calibrate_sheets, observe_boards
from armscan.calibration.sheets.result import (
    BoardStripes,
    LaserFit,
    PlacedBoard,
    SheetOptions,
    SkippedImage,
)
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.calibration.sheets.target_edges import find_target_edges
from armscan.devices.sources import ScanSource
from armscan.geometry.arrays import IntArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.calibration import CameraCalibration
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.instants import ExposurePair, check_sizes, pair_by_view, pair_exposures
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.targets import cached_profile, cached_target, wrong_count
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.storage.detection_cache import DetectionCache
from armscan.vision.stripe.image import SIGMA_RANGE_PX, LaserColour, StripeOptions
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import Target, TargetView

SAMPLE = 8
"""Photographs on which every channel is tried, evenly spread over the set."""
FIRST = 3
"""After so many of them, channels that show next to nothing are given up."""
NEXT_TO_NOTHING = 0.1
LEAST_SCATTER_PX = 0.1
"""Scatter below this does not make a channel better: boards and lens are not known better."""
CHANNELS: tuple[LaserColour, ...] = get_args(LaserColour)[1:]


@dataclass(frozen=True, slots=True)
class ChannelEvidence:
    """What one channel showed in the sample.

    Parameters
    ----------
    channel
        Its name.
    n_images
        Photographs with a stripe on the common sheet.
    n_points
        Points of these stripes.
    scatter_px
        Root mean square, over the photographs, of the points' scatter about their straight stripe.
    weight
        Points over the square of their scatter, summed: the precision that the set gets from it.
    """

    channel: LaserColour
    n_images: int
    n_points: int
    scatter_px: float
    weight: float


@dataclass(frozen=True, slots=True)
class ChannelChoice:
    """The channel taken for a set, and the evidence of all, the best first."""

    channel: LaserColour
    n_sampled: int
    evidence: tuple[ChannelEvidence, ...]

    @property
    def reason(self) -> str:
        """Why it was taken, in words."""
        best, *others = self.evidence
        text = (
            f"{best.channel}: the stripe on the common sheet in {best.n_images} of "
            f"{self.n_sampled} sampled photographs, {best.n_points} points that scatter "
            f"{best.scatter_px:.2f} px"
        )
        if others and others[0].weight > 0.0:
            rival = others[0]
            text += (
                f"; next {rival.channel} with {rival.n_images}, {rival.n_points} and "
                f"{rival.scatter_px:.2f} px"
            )
        return text


def choose_channel(
    n_images: int,
    stripes_of: Callable[[int, LaserColour], BoardStripes | None],
    cameras: HeadCameras,
    options: SheetOptions,
) -> ChannelChoice | None:
    """Try every channel on a sample of a set and take the one with the most evidence.

    Parameters
    ----------
    n_images
        Photographs with a board.
    stripes_of
        The stripes of a photograph in a channel; None where there is none.
    cameras
        The cameras.
    options
        Of the light sheets.

    Returns
    -------
    ChannelChoice or None
        None where no channel shows a straight stripe on a board.
    """
    sample = np.unique(np.linspace(0, n_images - 1, min(SAMPLE, n_images)).round().astype(int))
    # The middle one and both ends first: they differ most.
    order = sorted(
        range(len(sample)), key=lambda k: k not in {0, len(sample) // 2, len(sample) - 1}
    )
    found: dict[LaserColour, list[BoardStripes]] = {channel: [] for channel in CHANNELS}
    open_channels = list(CHANNELS)
    for tried, k in enumerate(order):
        for channel in open_channels:
            stripes = stripes_of(int(sample[k]), channel)
            if stripes is not None:
                found[channel].append(stripes)
        if tried == FIRST - 1 and len(order) > FIRST:
            evidence = [_weigh(c, found[c], cameras, options) for c in open_channels]
            best = max(item.weight for item in evidence)
            open_channels = [
                item.channel for item in evidence if item.weight >= NEXT_TO_NOTHING * best
            ]
    evidence = [_weigh(channel, found[channel], cameras, options) for channel in open_channels]
    evidence.sort(key=lambda item: -item.weight)
    if not evidence or evidence[0].weight <= 0.0:
        return None
    return ChannelChoice(evidence[0].channel, len(sample), tuple(evidence))


def _weigh(
    channel: LaserColour,
    boards: Sequence[BoardStripes],
    cameras: HeadCameras,
    options: SheetOptions,
) -> ChannelEvidence:
    images = observe_boards(boards, cameras, options).images if boards else ()
    counts, squares = [], []
    for image in images:
        for sighting in image.sightings:
            counts.append(len(sighting.rows))
            squares.append(_scatter_px(image, sighting.rows) ** 2)
    n, square = np.array(counts, dtype=np.int64), np.array(squares)
    weight = float((n / (square + LEAST_SCATTER_PX**2)).sum())
    scatter = float(np.sqrt((n * square).sum() / n.sum())) if len(n) else 0.0
    n_shown = sum(1 for image in images if image.sightings)
    return ChannelEvidence(channel, n_shown, int(n.sum()), scatter, weight)


def _scatter_px(image: BoardImage, rows: IntArray) -> float:
    """Robust scatter of a stripe's points across a straight line on the board, in pixels."""
    pose = image.placed.sensor_from_board
    flat = ((image.points.points_mm[rows] - pose.translation_mm) @ pose.rotation)[:, :2]
    centred = flat - flat.mean(axis=0)
    along, across = np.linalg.svd(centred, full_matrices=False)[2]
    x, y = centred @ along, centred @ across
    missed = y - np.polyval(np.polyfit(x, y, 1), x)
    mm_px = float(np.median(image.sigma_mm[rows] / image.data.profile.sigma_px[rows]))
    return 1.4826 * float(np.median(np.abs(missed))) / mm_px


LARGEST_CHI2 = 900.0
"""Two cameras whose poses of one board differ by more, of 6 expected, did not see one placement:
30 sigma leave room for a board that is not quite flat."""

SeenBoard = tuple[int, TargetView, Estimate[Pose[Sensor, Board]]]
"""Camera, target, and the board's pose in the camera's own frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """One place of the board.

    Parameters
    ----------
    name
        Of the view, or of the image in which the board was looked for.
    seen
        What each camera saw, by its number; a failure where it found no board.
    placed
        The pose in Sensor from all of them; None where no camera found the board.
    """

    name: str
    seen: dict[int, SeenBoard | FitFailure]
    placed: PlacedBoard | None


def placement_of(pair: ExposurePair) -> str:
    """Name of the placement that a pair shows."""
    exposure, background = pair
    return exposure.view or (exposure if background is None else background).source


def find_placements(
    pairs: Sequence[ExposurePair],
    target: Target,
    cameras: HeadCameras,
    cache: DetectionCache | None = None,
) -> Iterator[Placement]:
    """Look for the board in each placement, one after the other; ``cache`` knows earlier finds.

    The images without laser are tried first.
    """
    groups: dict[str, dict[int, list[Exposure]]] = {}
    for name, tried in (
        *((placement_of(pair), pair[1]) for pair in pairs if pair[1] is not None),
        *((placement_of(pair), pair[0]) for pair in pairs),
    ):
        images = groups.setdefault(name, {}).setdefault(tried.camera, [])
        if all(tried is not image for image in images):
            images.append(tried)
    for name, by_camera in groups.items():
        seen = {
            camera: _see(camera, images, target, cameras, cache=cache)
            for camera, images in sorted(by_camera.items())
        }
        yield _placed(name, seen, target, cameras)


def _see(
    camera: int,
    images: Sequence[Exposure],
    target: Target,
    cameras: HeadCameras,
    *,
    cache: DetectionCache | None,
) -> SeenBoard | FitFailure:
    """The board in the first image that shows it, or why the first does not."""
    failures: list[FitFailure] = []
    for image in images:
        view = cached_target(image, target, cache)
        found = view if isinstance(view, FitFailure) else _posed(camera, view, cameras)
        if not isinstance(found, FitFailure):
            return found
        failures.append(found)
    return failures[0] if failures else FitFailure("there is no image of it", "give one")


def _posed(camera: int, view: TargetView, cameras: HeadCameras) -> SeenBoard | FitFailure:
    model = cameras.model(camera)
    if view.edges is not None:
        view = correct_centres(view, model)
    pose = estimate_board_pose(view, model)
    return pose if isinstance(pose, FitFailure) else (camera, view, pose)


def _placed(
    name: str, seen: dict[int, SeenBoard | FitFailure], target: Target, cameras: HeadCameras
) -> Placement:
    found = {camera: item for camera, item in seen.items() if not isinstance(item, FitFailure)}
    if not found:
        return Placement(name, seen, None)
    if len(found) == 1:
        return Placement(name, seen, place_board(tuple(found.values()), cameras))
    left, right = found[0], _numbered_alike(found[0], found[1], target, cameras)
    if isinstance(right, FitFailure):
        return Placement(name, {**seen, 1: right}, place_board((left,), cameras))
    chi2 = poses_chi2(left, right, cameras)
    if chi2 > LARGEST_CHI2:
        failure = FitFailure(
            f"the cameras see the board in different places (chi2 {chi2:.3g} of 6 expected)",
            "check that the images are of one instant, and the stereo calibration",
        )
        return Placement(name, {**seen, 1: failure}, place_board((left,), cameras))
    return Placement(name, {**seen, 1: right}, place_board((left, right), cameras))


def _numbered_alike(
    left: SeenBoard, right: SeenBoard, target: Target, cameras: HeadCameras
) -> SeenBoard | FitFailure:
    """The right camera's board with the numbers of the left one's.

    A symmetric target may be numbered from either end; the poses tell which.
    """
    turn = cameras.right().right_from_sensor.rotation
    here = turn @ left[2].value.rotation
    there = right[2].value.rotation
    best = max(
        numberings(target),
        key=lambda n: float(np.trace(here.T @ there @ n.new_from_found.rotation.T)),
    )
    if best.quarter_turns == 0:
        return right
    return _posed(1, renumbered(right[1], target, best), cameras)


BOARDS_STAGE = "boards"
STRIPES_STAGE = "stripes"
LITTLE = 0.5
"""Of the usual count of points on the common sheet: with fewer an image is looked at again."""
LEAST_WIDTHS = 3
"""Images with a stripe on the common sheet from which on the line's width is known."""


@dataclass(frozen=True, slots=True)
class LaserOptions:
    """Options of the stages: stripes, sheets."""

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
    images = observe_boards(boards, cameras, options).images if boards else ()
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
    found = find_placements(pairs, target, cameras, cache)
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


STAGE = "boards and stripes again"


@dataclass(frozen=True, slots=True, eq=False)
class SeenPair:
    """What an image with the laser on shows, the board perhaps in the one without.

    Parameters
    ----------
    source
        The image with the laser on.
    board
        The target, or why it was not found.
    board_source
        The image in which it was found.
    profile
        All stripe points.
    """

    source: str
    board: TargetView | FitFailure
    board_source: str
    profile: Profile


def look_at_pairs(
    pairs: Sequence[ExposurePair],
    target: Target,
    options: LaserOptions,
    *,
    cache: DetectionCache | None = None,
    progress: Progress = silent,
) -> tuple[SeenPair, ...]:
    """Look for board and stripe in each pair, without any other image's help."""
    seen = []
    for done, (exposure, background) in enumerate(pairs):
        progress(ProgressEvent(STAGE, done, len(pairs), exposure.source))
        tried = exposure if background is None else background
        board = cached_target(tried, target, cache)
        if isinstance(board, FitFailure) and tried is not exposure:
            again = cached_target(exposure, target, cache)
            if not isinstance(again, FitFailure):
                board, tried = again, exposure
        lit, dark = exposure, background
        if not isinstance(board, FitFailure):
            lit = around_board(board, exposure)
            dark = None if background is None else around_board(board, background)
        profile = cached_profile(lit, options.stripes, dark, cache)
        seen.append(SeenPair(exposure.source, board, tried.source, profile))
    progress(ProgressEvent(STAGE, len(pairs), len(pairs)))
    if cache is not None:
        cache.trim()
    return tuple(seen)
