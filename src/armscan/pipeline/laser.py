# SPDX-License-Identifier: Apache-2.0
"""From images of stripes on a board to calibrated light sheets: board poses, the colour channel of
the stripes, extraction, and the fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import cast

import numpy as np

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.pairs import STRANGE_RATIO, rms_of_poses_px
from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import (
    HeadCameras,
    SeenBoard,
    place_board,
    pose_lit_board,
    poses_chi2,
)
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import (
    BoardStripes,
    LaserFit,
    PlacedBoard,
    SheetOptions,
    SkippedImage,
)
from armscan.calibration.sheets.stripes_on_board import (
    find_target_edges,
    runs_along_edge,
)
from armscan.calibration.sheets.voting import choose_print, observe_boards, rank_channels
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration, LaserColour, SensorCalibration
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.instants import ExposurePair, check_sizes
from armscan.pipeline.measure import cached_profile
from armscan.pipeline.progress import Progress, ProgressEvent, in_order, silent
from armscan.pipeline.targets import DETECTION_THREADS, cached_target, on_sensor, wrong_count
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile, StripeFlag
from armscan.storage.detection_cache import DetectionCache
from armscan.storage.observations import Observations
from armscan.vision.stripe.image import SIGMA_RANGE_PX, StripeOptions, shift_of
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import numberings, renumbered, settle_target
from armscan.vision.targets.repeated_print import does_repeat, predict_print
from armscan.vision.targets.target import CircleEdges, Target, TargetView

BOARDS_STAGE = "boards"
STRIPES_STAGE = "stripes"
PRINT_STAGE = "stripes with and without the print"
AGAIN_STAGE = "boards and stripes again"
LITTLE = 0.5
"""Of the usual count of points on the common sheet: with fewer an image is looked at again."""
LEAST_WIDTHS = 3
"""Images with a stripe on the common sheet from which on the line's width is known."""
LARGEST_CHI2 = 900.0
"""Two cameras whose poses of one board differ by more, of 6 expected, did not see one placement:
30 sigma leave room for a board that is not quite flat."""
OWN_CAMERA = CameraOptions(distortion="k1k2p1p2", n_folds=0)
FEWEST_OF_OWN_CAMERA = 5
"""Boards from which on a camera is solved from them, to be set beside the given one: of fewer, it
takes up how they are bent."""


@dataclass(frozen=True, slots=True)
class LaserOptions:
    """Options of the three stages: target, stripes, sheets."""

    stripes: StripeOptions = field(default_factory=StripeOptions)
    sheets: SheetOptions = field(default_factory=SheetOptions)


def calibrate_sheets_from_pairs(
    pairs: Sequence[ExposurePair],
    target: Target,
    camera: CameraCalibration | StereoCalibration,
    *,
    options: LaserOptions | None = None,
    cache: DetectionCache | None = None,
    progress: Progress = silent,
) -> LaserFit | FitFailure:
    """Find board and stripes in every image and calibrate the sheets.

    Parameters
    ----------
    pairs
        Each image with the laser on and the one without laser of the same placement, or None, as
        `armscan.pipeline.instants.pair_exposures` and `pair_by_view` make them. The board is looked
        for in the image without laser, then in the one with it.
    target
        The board.
    camera
        Calibrated with images of the same size; of two cameras, `Exposure.camera` says which one
        took an image.
    options
        Defaults if None.
    cache
        What it knows of targets and stripes is not looked for again.
    progress
        Told of every placement and image.

    Raises
    ------
    InputError
        If an image is not of its camera's size.
    """
    options = options or LaserOptions()
    cameras = HeadCameras.of(camera)
    for pair in pairs:
        check_sizes(filter(None, pair), cameras.model(pair[0].camera))
    places: dict[str, BoardPlacement] = {}
    answers: list[TargetView | FitFailure] = []
    n_places = len({placement_of(pair) for pair in pairs})
    for place in find_placements(pairs, target, cameras, cache):
        places[place.name] = place
        progress(ProgressEvent(BOARDS_STAGE, len(places), n_places, place.name))
        answers += [
            item if isinstance(item, FitFailure) else item[1] for item in place.seen.values()
        ]
        wrong = wrong_count(answers, target)
        if wrong is not None:
            return wrong
    lit = _LitBoards(pairs, places, target, camera, options, cache, progress)
    colour = options.stripes.laser_colour
    channels: tuple[tuple[LaserColour, str], ...] = ((colour, ""),)
    if colour == "auto" and not all(pair[0].is_colourless for pair in lit.shown):
        shown = lit.shown
        channels = (
            rank_channels(
                len(shown),
                lambda k, channel: lit.stripes_of(shown[k], channel),
                cameras,
                options.sheets,
            )
            or channels
        )
    fit = lit.calibrated(channels[0][0])
    reason = channels[0][1]
    for channel, about in channels[1:]:
        if not isinstance(fit, FitFailure):
            break
        again = lit.calibrated(channel)
        if not isinstance(again, FitFailure):
            why = fit.reason.partition(" (not used: ")[0]
            fit, reason = again, f"{about}; {channels[0][0]} shows more, but {why}"
    return fit if isinstance(fit, FitFailure) else replace(fit, channel_reason=reason)


@dataclass(frozen=True, slots=True, eq=False)
class _LitBoards:
    """Photographs of a set with the boards in them: what each channel shows on the boards."""

    pairs: Sequence[ExposurePair]
    places: Mapping[str, BoardPlacement]
    target: Target
    camera: CameraCalibration | StereoCalibration
    options: LaserOptions
    cache: DetectionCache | None
    progress: Progress

    @property
    def shown(self) -> list[ExposurePair]:
        """Those in which the board was found."""
        return [
            pair
            for pair in self.pairs
            if not isinstance(self._place(pair).seen[pair[0].camera], FitFailure)
        ]

    def _place(self, pair: ExposurePair) -> BoardPlacement:
        return self.places[placement_of(pair)]

    def stripes_of(
        self,
        pair: ExposurePair,
        colour: LaserColour,
        line_sigma_px: float | None = None,
        *,
        less_print: bool = False,
    ) -> BoardStripes | FitFailure:
        """Stripes of one photograph, as it is or less the board's print."""
        sigma = self.options.stripes.line_sigma_px or line_sigma_px
        chosen = replace(
            self.options.stripes, laser_colour=colour, line_sigma_px=sigma, on_print=True
        )
        cameras, place = HeadCameras.of(self.camera), self._place(pair)
        if less_print:
            pair = _with_predicted_print(pair, place, self.target, cameras)
        return _board_stripes(pair, place, self.target, cameras, chosen, cache=self.cache)

    def calibrated(self, colour: LaserColour) -> LaserFit | FitFailure:
        """The sheets from the stripes in one channel."""
        cameras, sheets = HeadCameras.of(self.camera), self.options.sheets
        bare = [pair for pair in self.shown if pair[1] is None and does_repeat(self.target)]
        known: dict[tuple[int, bool], BoardStripes | FitFailure] = {}

        def tried(k: int, less: bool) -> BoardStripes | FitFailure:
            exposure = bare[k][0]
            self.progress(ProgressEvent(PRINT_STAGE, len(known), 2 * len(bare), exposure.source))
            stripes = known[id(exposure), less] = self.stripes_of(bare[k], colour, less_print=less)
            return stripes

        less_print, about_print = choose_print(len(bare), tried, cameras, sheets)
        if bare:
            self.progress(ProgressEvent(PRINT_STAGE, 2 * len(bare), 2 * len(bare)))

        def stripes(pair: ExposurePair) -> BoardStripes | FitFailure:
            seen = known.get((id(pair[0]), less_print))
            if seen is not None:
                return seen
            return self.stripes_of(pair, colour, less_print=less_print)

        found: list[BoardStripes | FitFailure] = []
        n_pairs = len(self.pairs)
        self.progress(ProgressEvent(STRIPES_STAGE, 0, n_pairs))
        for (exposure, _), shown in in_order(stripes, self.pairs, DETECTION_THREADS):
            found.append(shown)
            self.progress(ProgressEvent(STRIPES_STAGE, len(found), n_pairs, exposure.source))
        if self.options.stripes.line_sigma_px is None:
            for k, sigma_px in _poor_images(found, cameras, sheets):
                again = self.stripes_of(self.pairs[k], colour, sigma_px, less_print=less_print)
                if _n_clean(again) > _n_clean(found[k]):
                    found[k] = again
        fit = _fit_sheets(self.pairs, found, self.camera, sheets)
        if isinstance(fit, FitFailure):
            return fit
        return replace(fit, laser_colour=colour, print_reason=about_print)


def _fit_sheets(
    pairs: Sequence[ExposurePair],
    found: Sequence[BoardStripes | FitFailure],
    camera: CameraCalibration | StereoCalibration,
    options: SheetOptions,
) -> LaserFit | FitFailure:
    """Calibrate from what each pair gave; the result, or why there is none, says what did not."""
    boards = [item for item in found if isinstance(item, BoardStripes)]
    skipped = [
        SkippedImage(pair[0].source, item.reason.removeprefix(f"{pair[0].source}: "))
        for pair, item in zip(pairs, found, strict=True)
        if isinstance(item, FitFailure)
    ]
    if not boards:
        return FitFailure(
            f"no board with stripes in any of {len(pairs)} images; {skipped[0].source}: "
            f"{skipped[0].reason}",
            "check the target's description and that the board is lit in one image of each pair",
        )
    about_camera = about_cameras(boards, HeadCameras.of(camera))
    about_views = about_moved_views(
        (pair, item.view)
        for pair, item in zip(pairs, found, strict=True)
        if isinstance(item, BoardStripes)
    )
    fit = calibrate_sheets(boards, camera, options)
    if isinstance(fit, FitFailure):
        lost = "; ".join(f"{image.source}: {image.reason}" for image in skipped)
        reason = f"{fit.reason} (not used: {lost})" if lost else fit.reason
        return FitFailure("; ".join((reason, *about_camera)), fit.remedy)
    unseen = {} if options.sheet_names else unseen_lasers(pairs, fit.sheet_names)
    about_lasers = (
        f"laser {name} was on in {n} of {len(pairs)} images, and no sheet came of it: where it "
        "shines in a scan that does not name its lasers, its points may be given to another "
        "sheet; take boards that show it, or leave it off"
        for name, n in unseen.items()
    )
    about = (*about_camera, *about_views, *about_widths(fit), *about_lasers, *fit.warnings)
    skipped = [*skipped, *fit.skipped]
    return replace(fit, skipped=tuple(skipped), warnings=about, lasers_without_sheet=tuple(unseen))


def unseen_lasers(pairs: Sequence[ExposurePair], sheets: Sequence[str]) -> dict[str, int]:
    """Lasers that images name, and how many do, of which no sheet, or line of a fan, came."""
    named = Counter(name for exposure, _ in pairs for name in exposure.lasers)
    return {
        name: n
        for name, n in named.items()
        if not any(sheet == name or sheet.startswith(f"{name}.") for sheet in sheets)
    }


SAID_SHIFT_PX = 0.3
"""Less is made good, and moves a board by less than its own points tell."""


def about_moved_views(shown: Iterable[tuple[ExposurePair, TargetView]]) -> tuple[str, ...]:
    """Says of views without laser that they lie beside those with it (`laid_under`)."""
    found: list[tuple[float, str]] = []
    for (exposure, background), view in shown:
        if background is None:
            continue
        shift = shift_of(around_board(view, background), around_board(view, exposure))
        found.append((0.0 if shift is None else float(np.linalg.norm(shift)), exposure.source))
    largest_px, where = max(found, default=(0.0, ""))
    if largest_px < SAID_SHIFT_PX:
        return ()
    n_moved = sum(1 for px, _ in found if px >= SAID_SHIFT_PX)
    return (
        f"{n_moved} of {len(found)} views without laser were taken {SAID_SHIFT_PX:g} to "
        f"{largest_px:.1f} px beside those with it (most in {where}); they were moved under them: "
        "fasten camera and board, and switch the laser without touching either",
    )


def about_cameras(boards: Sequence[BoardStripes], cameras: HeadCameras) -> tuple[str, ...]:
    """Names cameras that fit the boards far worse than one that is solved from them.

    The poses take up most of a wrong focal length and the boards' bow some of a wrong distortion,
    so that the stripes alone tell little of either.
    """
    said = []
    for number in sorted({board.camera for board in boards}):
        of_place = {board.place: board.view for board in boards if board.camera == number}
        views = [replace(view, source=place) for place, view in of_place.items()]
        if len(views) < FEWEST_OF_OWN_CAMERA:
            continue
        is_fisheye = cameras.model(number).lens == "fisheye"
        options = replace(OWN_CAMERA, distortion="fisheye") if is_fisheye else OWN_CAMERA
        own = calibrate_camera(views, options)
        if isinstance(own, FitFailure):
            continue
        given_px, own_px = (
            rms_of_poses_px(views, model) for model in (cameras.model(number), own.camera)
        )
        if given_px >= STRANGE_RATIO * own_px:
            word = "camera" if cameras.second is None else ("left camera", "right camera")[number]
            said.append(
                f"the boards fit the given {word} to {given_px:.2f} px (rms) only, and one solved "
                f"from them to {own_px:.2f} px: it is not that of these photographs, or its focus "
                "or zoom was moved since; calibrate it anew, as it is"
            )
    return tuple(said)


WIDER = 2.0
"""A beam's width changes with the distance; no head's by so much from the next board to one."""
FEWEST_TO_COMPARE = 5


def about_widths(fit: LaserFit) -> tuple[str, ...]:
    """Names images in which a sheet's line is much wider than in all others of the camera."""
    said: dict[str, str] = {}
    for sheet, camera in product(range(len(fit.sheets)), {board.camera for board in fit.boards}):
        widths = sorted(
            (float(np.median(image.profile.width_px[shown])), image.source)
            for image, board in zip(fit.images, fit.boards, strict=True)
            if board.camera == camera and (shown := image.sheet == sheet).any()
        )
        if len(widths) < FEWEST_TO_COMPARE or widths[-1][0] <= WIDER * widths[-2][0]:
            continue
        (next_px, _), (widest_px, source) = widths[-2:]
        said[source] = (
            f"{source}: its line is {widest_px:.1f} px wide (sigma), in no other image more than "
            f"{next_px:.1f}: the laser may have been moved or focused anew; look, or leave it out"
        )
    return tuple(said.values())


def calibrate_sheets_again(
    found: Observations, sensor: SensorCalibration, options: SheetOptions | None = None
) -> LaserFit | FitFailure:
    """Solve the sheets of a sensor again from the observations that lie beside its document."""
    if len(found.contexts) != len(found.profiles) or not found.contexts:
        return FitFailure(
            "the observations do not say which laser and camera took part: an older version of "
            "armscan wrote them, or they are of a camera",
            "calibrate again from the images",
        )
    cameras = HeadCameras.of(sensor)
    boards = []
    for view, profile, context in zip(found.views, found.profiles, found.contexts, strict=True):
        rims = CircleEdges(
            points_px=np.zeros((0, 2)), circle=np.zeros(0, dtype=np.int64), sigma_px=np.zeros(0)
        )
        board = replace(view, edges=rims if context.has_rims else None)
        pose = estimate_board_pose(board, cameras.model(context.camera))
        if isinstance(pose, FitFailure):
            return pose
        flags = profile.flags & ~int(StripeFlag.TARGET_EDGE)
        boards.append(
            BoardStripes(
                profile=replace(profile, flags=flags),
                view=board,
                sensor_from_board=pose,
                lasers=context.lasers,
                on_edge=context.on_edge,
                camera=context.camera,
                placed=context.placed,
                placement=context.placement,
            )
        )
    fit = calibrate_sheets(boards, sensor, options)
    if isinstance(fit, FitFailure):
        return fit
    return replace(
        fit,
        laser_colour=cast(LaserColour, sensor.laser_colour),
        lasers_without_sheet=sensor.lasers_without_sheet,
    )


def _poor_images(
    found: Sequence[BoardStripes | FitFailure], cameras: HeadCameras, options: SheetOptions
) -> list[tuple[int, float]]:
    """Images of which little lies on the common sheet, and how wide (px) the line is in the others.

    The width of the line is found in each image by itself, and what is bright beside the line may
    be narrower or wider than it. One laser in one set has one width.
    """
    boards = [item for item in found if isinstance(item, BoardStripes)]
    images = observe_boards(boards, cameras, options).images if boards else ()
    rows = [np.concatenate([s.rows for s in i.stripes]) if i.stripes else () for i in images]
    widths = [
        np.median(image.data.profile.width_px[shown])
        for image, shown in zip(images, rows, strict=True)
        if len(shown)
    ]
    if len(widths) < LEAST_WIDTHS:
        return []
    sigma_px = float(np.clip(np.median(widths), *SIGMA_RANGE_PX))
    usual = float(np.median([len(shown) for shown in rows if len(shown)]))
    counts = iter([len(shown) for shown in rows])
    of_image = [next(counts) if isinstance(item, BoardStripes) else 0 for item in found]
    return [(k, sigma_px) for k, count in enumerate(of_image) if count < LITTLE * usual]


def _n_clean(board: BoardStripes | FitFailure) -> int:
    """Count of clean stripe points; -1 for none."""
    return -1 if isinstance(board, FitFailure) else int(board.profile.is_accepted.sum())


def _board_stripes(
    pair: ExposurePair,
    placement: BoardPlacement,
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
    return BoardStripes(
        profile=profile,
        view=view,
        sensor_from_board=pose,
        lasers=exposure.lasers,
        on_edge=None if edges is None else runs_along_edge(profile, edges),
        camera=camera,
        placed=placement.placed,
        placement=placement.name,
    )


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


@dataclass(frozen=True, slots=True, eq=False)
class BoardPlacement:
    """One place of the board.

    Images that saw the board in one place share its pose: those of one view of a recording,
    whatever laser was on and whichever camera took them, and those with one image without laser.

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
) -> Iterator[BoardPlacement]:
    """Look for the board in each placement, given back in order; ``cache`` knows earlier finds.

    The images without laser are tried first.
    """
    target = settle_target((image for pair in pairs for image in filter(None, pair)), target)
    groups: dict[str, dict[int, list[Exposure]]] = {}
    for name, tried in (
        *((placement_of(pair), pair[1]) for pair in pairs if pair[1] is not None),
        *((placement_of(pair), pair[0]) for pair in pairs),
    ):
        images = groups.setdefault(name, {}).setdefault(tried.camera, [])
        if all(tried is not image for image in images):
            images.append(tried)

    def first_seen(camera: int, images: Sequence[Exposure]) -> SeenBoard | FitFailure:
        """The board in the first image that shows it, or why the first does not."""
        failures: list[FitFailure] = []
        for image in images:
            view = cached_target(image, target, cache)
            is_lit = any(image is pair[0] for pair in pairs)
            found = _posed(camera, view, cameras, is_lit=is_lit)
            if not isinstance(found, FitFailure):
                return found
            failures.append(found)
        return failures[0]

    def placement(group: tuple[str, dict[int, list[Exposure]]]) -> BoardPlacement:
        name, by_camera = group
        seen = {camera: first_seen(camera, images) for camera, images in sorted(by_camera.items())}
        found = [item for item in seen.values() if not isinstance(item, FitFailure)]
        if len(found) == 2:
            right = _same_placement(found[0], found[1], target, cameras)
            seen[1] = right
            found = found[:1] if isinstance(right, FitFailure) else [found[0], right]
        return BoardPlacement(name, seen, place_board(found, cameras) if found else None)

    yield from (placed for _, placed in in_order(placement, groups.items(), DETECTION_THREADS))


def _posed(
    camera: int, view: TargetView | FitFailure, cameras: HeadCameras, *, is_lit: bool
) -> SeenBoard | FitFailure:
    if isinstance(view, FitFailure):
        return view
    model = cameras.model(camera)
    view = on_sensor(view, model)
    if view.edges is not None:
        view = correct_centres(view, model)
    if is_lit:
        lit = pose_lit_board(view, model)
        return lit if isinstance(lit, FitFailure) else (camera, *lit)
    pose = estimate_board_pose(view, model)
    return pose if isinstance(pose, FitFailure) else (camera, view, pose)


def _same_placement(
    left: SeenBoard, right: SeenBoard, target: Target, cameras: HeadCameras
) -> SeenBoard | FitFailure:
    """The right camera's board with the numbers of the left one's, unless it is another place.

    A symmetric target may be numbered from either end; the poses tell which.
    """
    turn = cameras.right().right_from_sensor.rotation
    right_from_left = (turn @ left[2].value.rotation).T @ right[2].value.rotation
    best = max(
        numberings(target),
        key=lambda n: float(np.trace(right_from_left @ n.new_from_found.rotation.T)),
    )
    if best.quarter_turns:
        # with its covariances, which are wide where the laser pulls a point
        view = renumbered(right[1], target, best)
        pose = estimate_board_pose(view, cameras.model(1))
        if isinstance(pose, FitFailure):
            return pose
        right = 1, view, pose
    chi2 = poses_chi2(left, right, cameras)
    if chi2 <= LARGEST_CHI2:
        return right
    return FitFailure(
        f"the cameras see the board in different places (chi2 {chi2:.3g} of 6 expected)",
        "check that the images are of one instant, and the stereo calibration",
    )


def _with_predicted_print(
    pair: ExposurePair, placement: BoardPlacement, target: Target, cameras: HeadCameras
) -> ExposurePair:
    """The pair, with the view without laser that the print's repetition tells where it has none."""
    exposure, background = pair
    seen = placement.seen[exposure.camera]
    if background is not None or isinstance(seen, FitFailure):
        return pair
    camera, view, pose = seen
    lit = around_board(view, exposure)
    return exposure, predict_print(lit, view, target, pose.value, cameras.model(camera))


@dataclass(frozen=True, slots=True, eq=False)
class SeenPair:
    """Stripe points of an image with the laser on, and the target found in ``board_source``, or why
    it was not found.
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
    """Board and stripe of each pair by itself, for a person who asks why no sheet came out."""
    seen = []
    for done, (exposure, background) in enumerate(pairs):
        progress(ProgressEvent(AGAIN_STAGE, done, len(pairs), exposure.source))
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
        profile = cached_profile(lit, replace(options.stripes, on_print=True), dark, cache)
        seen.append(SeenPair(exposure.source, board, tried.source, profile))
    progress(ProgressEvent(AGAIN_STAGE, len(pairs), len(pairs)))
    if cache is not None:
        cache.trim()
    return tuple(seen)
