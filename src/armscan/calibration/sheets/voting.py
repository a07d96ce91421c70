# SPDX-License-Identifier: Apache-2.0
"""Which straight stripes the boards agree on: one light sheet draws coplanar lines on all of them.

A photograph shows more straight lines than the laser's: a border of the board, the line where it
went past the board to the wall behind, a reflection, a second laser. Carried to their boards'
planes, the lines of one sheet are coplanar in the Sensor frame and the others are not, so that
three boards and more tell them apart without any limit on brightness or length. In which way to
look at a set, which colour channel, with or without the target's print, is decided alike: by what
its boards then agree on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, get_args

import numpy as np

from armscan.calibration.sheets.board_points import BoardBow, HeadCameras
from armscan.calibration.sheets.coplanarity import MIN_SPREAD_RATIO
from armscan.calibration.sheets.labels import LEAST_FAN, board_numbers
from armscan.calibration.sheets.result import BoardStripes, PointUse, SheetOptions, SkippedImage
from armscan.calibration.sheets.solve import square_matrix_root
from armscan.calibration.sheets.stripes_on_board import (
    BoardImage,
    StripeObservation,
    observe_board_stripes,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.models.calibration import LaserColour

LEAST_BOARDS = 3
"""Any two lines that meet are coplanar: only a third one can agree."""
TOLERANCES_PX = (3.0, 8.0, 20.0)
"""How far across itself a stripe may lie from the common sheet, besides what its board's pose
leaves open: the first with which most boards agree."""
BOW_SHARE = 0.01
"""Of the print's longer side: how far a bowed sheet or board may hold a stripe off a plane. Line
lasers bow by up to 0.7 % over the field that they light, boards of card by about as much. Beside
the print, whose pose is that of its own middle plane, a bent carrier leaves it with the square of
the distance."""
AGREEING_SHARE = 0.6
"""Of the boards: with so many in agreement no wider tolerance is tried."""
SECOND_SHARE = 0.5
"""A further sheet is seen on at least this part of the boards that show the first."""
MAX_TRIALS = 3000
"""Pairs of lines whose planes are tried: all pairs of 78 lines."""
CHUNK = 250
POSE_SIGMAS = 3.0
OUTLYING = 4.0
"""In robust sigmas of all boards' residuals."""
LEAST_TRIANGULATION = 0.02
"""Sine of the angle between the rays and a sheet below which it is taken for a line of the image: a
border or a lit edge behind the boards that stays where it is lies, carried to any board, in the
plane of its own rays. A light sheet at so small an angle measures no depth."""
GRAZING = 0.1
"""Sine of the angle between sheet and board below which a pixel's height is not trusted."""
REFITS = 3
SEED = 12
SAMPLE = 16
"""Photographs that are looked at, evenly spread over the set. On eight of the fourteen of
a speckled line on endoscope images chance chose: points off their boards by 0.29 mm, by 0.20 with
the channel that all fourteen show best."""
LEAST_SHARE = {3: 0.1, 8: 0.5}
"""After so many of them, ways that show less than this share of the best one's are given up."""
LEAST_SCATTER_PX = 0.1
"""Scatter below this does not make a channel better: boards and lens are not known better."""
CHANNELS: tuple[LaserColour, ...] = get_args(LaserColour)[1:]
LEAST_TELLING = 5
"""Boards: of three any lines agree by chance, of four many."""
LEAST_SHOWN = 2
"""Photographs that must show a stripe on the common sheet: one makes no sheet, and may be print."""
Way = TypeVar("Way", LaserColour, bool)


@dataclass(frozen=True, slots=True, eq=False)
class SheetVote:
    """What the boards agreed on: the images with the stripes that lie on a common sheet, without
    vote as they were given, and the outlying ones whose stripes lie on none.
    """

    images: tuple[BoardImage, ...]
    outlying: tuple[SkippedImage, ...] = ()
    warnings: tuple[str, ...] = ()


def observe_boards(
    boards: Sequence[BoardStripes],
    cameras: HeadCameras,
    options: SheetOptions,
    bow: BoardBow | None = None,
) -> SheetVote:
    """Straight stripes on the boards, less the lines on which the boards do not agree.

    Stripes are looked for on the print and, where three boards can vote, on the carrier around it
    as far as the print is long: a board may go on beyond its print by the print's own length.

    Of each image the stripes stay that lie on a sheet on which at least three boards agree. Those
    on the print vote. Of images that show none there, a stripe beside the print is kept if it lies
    on one of these sheets. Only where the prints show no sheet, the stripes beside them vote, and
    then on one sheet unless the options say how many there are: the walls and floors behind show
    lines, too. Images whose one laser is named vote among themselves. Nothing is decided where no
    three boards agree, or where the lines of a fan are coplanar in too many ways, unless the
    options say that there are few: their numbering (`armscan.calibration.sheets.fan`) then judges.
    """
    can_vote = len({board.place for board in boards}) >= LEAST_BOARDS
    n_lines = 0 if can_vote else options.n_sheets
    on_print = [
        observe_board_stripes(board, cameras, options.margin_mm, n_lines, bow) for board in boards
    ]
    if not can_vote:
        return SheetVote(tuple(on_print))
    around = on_print
    if options.margin_mm is None:
        lengths = [float(np.ptp(board.view.points_board_mm, axis=0).max()) for board in boards]
        around = [
            observe_board_stripes(board, cameras, length, bow=bow)
            for board, length in zip(boards, lengths, strict=True)
        ]
    images: list[BoardImage] = list(on_print)
    outlying: list[SkippedImage] = []
    warnings: list[str] = []
    groups: dict[tuple[str, ...], list[int]] = {}
    for i, board in enumerate(boards):
        groups.setdefault(board.lasers if len(board.lasers) == 1 else (), []).append(i)
    for group in groups.values():
        inner, wide = [on_print[i] for i in group], [around[i] for i in group]
        if _most_lines(inner) >= LEAST_FAN and not 0 < options.n_sheets < LEAST_FAN:
            continue
        chosen, off = wide, list[SkippedImage | None]()
        if _most_lines(inner) >= 1 or _most_lines(wide) < LEAST_FAN:
            chosen, off = _voted(inner, wide, cameras, options)
        for i, image in zip(group, chosen, strict=True):
            images[i] = image
        outlying += [item for item in off if item is not None]
        n_shown = sum(bool(image.stripes) for image in wide)
        n_agree = sum(bool(image.stripes) for image in chosen)
        if n_agree < 0.5 * n_shown:
            warnings.append(
                f"only {n_agree} of {n_shown} images with a straight line agree on a sheet: look "
                "at those that were left out"
            )
    return SheetVote(tuple(images), tuple(outlying), tuple(warnings))


def _most_lines(images: Sequence[BoardImage]) -> float:
    return float(np.median([len(image.stripes) for image in images]))


def _voted(
    inner: list[BoardImage], wide: list[BoardImage], cameras: HeadCameras, options: SheetOptions
) -> tuple[list[BoardImage], list[SkippedImage | None]]:
    """Vote on the stripes of the print, or if they show no sheet, on those around it.

    The images with the stripes that stay, and of each why it was left out if none did.
    """
    off: list[SkippedImage | None] = [None for _ in inner]
    voters = _Lines.of(inner, cameras)
    sheets = _agreements(voters, options.n_sheets or LEAST_FAN)
    if not options.n_sheets and len(sheets) >= LEAST_FAN:
        return inner, off
    kept = [set(voters.stripes_of(i, sheets)) for i in range(len(inner))]
    beside = _Lines.of(wide, cameras)
    if not sheets:
        voters = beside
        sheets = _agreements(voters, options.n_sheets or 1)
    if not sheets:
        return inner, off
    everyone = np.ones(len(beside.length), dtype=np.bool_)
    on_these = [
        _held_against(beside, everyone, sheet.normal, sheet.offset, sheet.limit_px)
        for sheet in sheets
    ]
    found = []
    for i, image in enumerate(inner):
        if kept[i]:
            found.append(_with_only(image, kept[i]))
            continue
        there = set(beside.stripes_of(i, on_these))
        found.append(_with_only(wide[i], there))
        shown = beside.image == i
        if shown.any() and not there:
            off_px = min(float(sheet.residual_px[shown].min()) for sheet in on_these)
            off[i] = SkippedImage(
                image.data.profile.source,
                f"outlying board: its straight stripe lies {off_px:.1f} px from the sheet that "
                f"{sheets[0].n_boards(voters)} boards agree on",
            )
    return found, off


def _with_only(image: BoardImage, kept: set[int]) -> BoardImage:
    """The image with the stripes of these numbers."""
    use = image.use.copy()
    for number, stripe in enumerate(image.stripes):
        if number not in kept:
            use[stripe.rows] = int(PointUse.OUTVOTED)
    stripes = tuple(s for number, s in enumerate(image.stripes) if number in kept)
    return replace(image, use=use, stripes=stripes)


@dataclass(frozen=True, slots=True, eq=False)
class _Agreement:
    """A plane ``normal @ x = offset``, how far (px) from it a line may lie to agree, and of all
    lines the (S,) residuals and whether they agree, at most one an image.
    """

    normal: FloatArray
    offset: float
    limit_px: float
    residual_px: FloatArray
    agrees: BoolArray

    def n_boards(self, lines: _Lines) -> int:
        return len(np.unique(lines.board[self.agrees]))


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """S stripes as the pieces in space between their ends.

    ``ends_mm`` (S, 2, 3); ``pose_root`` (S, 2, 3, 6) movement of the ends for a sigma of the
    board's pose; ``across_mm_px`` (S, 3) movement for a pixel across; ``length`` (S,) points;
    ``image`` and ``board`` (S,), ``number`` (S,) of the stripe in its image; ``centre_mm``
    (S, 3) of the camera that saw it, and ``bow_mm`` (S,) what a bow may do on its board.
    """

    ends_mm: FloatArray
    pose_root: FloatArray
    across_mm_px: FloatArray
    length: FloatArray
    image: IntArray
    board: IntArray
    number: IntArray
    centre_mm: FloatArray
    bow_mm: FloatArray

    @staticmethod
    def of(images: Sequence[BoardImage], cameras: HeadCameras) -> _Lines:
        boards = board_numbers(images)
        found = [(i, k, s) for i, image in enumerate(images) for k, s in enumerate(image.stripes)]
        roots = [square_matrix_root(image.placed.covariance) for image in images]
        centres = [cameras.centre_mm(image.data.camera) for image in images]
        n = len(found)
        return _Lines(
            np.array([s.ends_mm for _, _, s in found]).reshape(n, 2, 3),
            np.array([s.dends_dpose @ roots[i] for i, _, s in found]).reshape(n, 2, 3, 6),
            np.array([s.across * images[i].mm_per_px(s.rows) for i, _, s in found]).reshape(n, 3),
            np.array([float(len(s.rows)) for _, _, s in found]),
            np.array([i for i, _, _ in found], dtype=np.int64),
            np.array([boards[i] for i, _, _ in found], dtype=np.int64),
            np.array([k for _, k, _ in found], dtype=np.int64),
            np.array([centres[i] for i, _, _ in found]).reshape(n, 3),
            np.array([_bow_mm(images[i], s) for i, _, s in found]),
        )

    def stripes_of(self, image: int, sheets: Sequence[_Agreement]) -> list[int]:
        """Numbers of an image's stripes that agree with one of the sheets."""
        agrees = np.any([sheet.agrees for sheet in sheets], axis=0) if sheets else False
        return [int(k) for k in self.number[agrees & (self.image == image)]]

    def misses(
        self, chosen: BoolArray, normals: FloatArray, offsets: FloatArray, tolerance_px: float
    ) -> FloatArray:
        """(T, S) largest distance of a line's ends from each plane, over what is tolerated."""
        height = np.einsum("ti,sei->tse", normals, self.ends_mm[chosen]) - offsets[:, None, None]
        by_pose = np.einsum("ti,seip->tsep", normals, self.pose_root[chosen])
        pose = POSE_SIGMAS * np.sqrt((by_pose**2).sum(axis=3))
        allowed = tolerance_px * self.mm_per_px(chosen, normals) + self.bow_mm[chosen]
        allowed = allowed[:, :, None] + pose
        return np.asarray((np.abs(height) / allowed).max(axis=2))

    def mm_per_px(self, chosen: BoolArray, normals: FloatArray) -> FloatArray:
        """(T, S) height over each plane for a pixel across the stripe."""
        across = self.across_mm_px[chosen]
        height = np.abs(normals @ across.T)
        return np.asarray(np.maximum(height, GRAZING * np.linalg.norm(across, axis=1)))


def _bow_mm(image: BoardImage, stripe: StripeObservation) -> float:
    print_mm = image.data.view.points_board_mm
    side_mm = float(np.ptp(print_mm, axis=0).max())
    pose = image.placed.sensor_from_board
    ends = (stripe.ends_mm - pose.translation_mm) @ pose.rotation
    middle = 0.5 * (print_mm.min(axis=0) + print_mm.max(axis=0))
    far_mm = float(np.linalg.norm(ends[:, :2] - middle[:2], axis=1).max())
    return BOW_SHARE * side_mm * max(1.0, (far_mm / (0.5 * side_mm)) ** 2)


def _agreements(lines: _Lines, most: int) -> list[_Agreement]:
    """Planes from the one with the most support on; lines of one do not count for the next."""
    found: list[_Agreement] = []
    is_open = np.ones(len(lines.length), dtype=np.bool_)
    while len(found) < most:
        best = _best_agreement(lines, is_open)
        if best is None:
            break
        least = SECOND_SHARE * found[0].n_boards(lines) if found else 0.0
        if best.n_boards(lines) < max(LEAST_BOARDS, least):
            break
        found.append(best)
        is_open &= ~(best.residual_px < 2.0 * TOLERANCES_PX[0]) & ~best.agrees
    return found


def _best_agreement(lines: _Lines, is_open: BoolArray) -> _Agreement | None:
    normals, offsets = _trial_planes(lines, is_open)
    if not len(normals):
        return None
    enough = max(LEAST_BOARDS, AGREEING_SHARE * len(np.unique(lines.board)))
    best: _Agreement | None = None
    for tolerance_px in TOLERANCES_PX:
        trial = _most_supported(lines, is_open, normals, offsets, tolerance_px)
        found = _refined(lines, is_open, normals[trial], float(offsets[trial]), tolerance_px)
        if best is None or found.n_boards(lines) > best.n_boards(lines):
            best = found
        if best.n_boards(lines) >= enough:
            break
    return best


def _trial_planes(lines: _Lines, is_open: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Planes (T, 3), (T,) through two lines of different boards, a random choice of all pairs."""
    chosen = np.flatnonzero(is_open)
    a, b = np.triu_indices(len(chosen), 1)
    apart = lines.board[chosen[a]] != lines.board[chosen[b]]
    a, b = chosen[a[apart]], chosen[b[apart]]
    if len(a) > MAX_TRIALS:
        # Long lines carry long support: they are tried more often.
        weight = lines.length[a] * lines.length[b]
        generator = np.random.default_rng(SEED)
        pick = generator.choice(len(a), MAX_TRIALS, replace=False, p=weight / weight.sum())
        a, b = a[pick], b[pick]
    pair = np.concatenate([lines.ends_mm[a], lines.ends_mm[b]], axis=1)
    middle = pair.mean(axis=1)
    local = pair - middle[:, None]
    values, vectors = np.linalg.eigh(np.einsum("tki,tkj->tij", local, local))
    ray = middle - lines.centre_mm[a]
    sine = np.abs(np.einsum("ti,ti->t", vectors[:, :, 0], ray)) / np.linalg.norm(ray, axis=1)
    sound = (values[:, 1] > MIN_SPREAD_RATIO**2 * values[:, 2]) & (sine > LEAST_TRIANGULATION)
    normals = vectors[sound, :, 0]
    return normals, np.einsum("ti,ti->t", normals, middle[sound])


def _most_supported(
    lines: _Lines,
    is_open: BoolArray,
    normals: FloatArray,
    offsets: FloatArray,
    tolerance_px: float,
) -> int:
    """Number of the plane with the longest support, one line an image."""
    best, best_score = 0, -1.0
    images = lines.image[is_open]
    order = np.argsort(images, kind="stable")
    starts = np.flatnonzero(np.diff(images[order], prepend=-1))
    for start in range(0, len(normals), CHUNK):
        block = slice(start, start + CHUNK)
        ratio = lines.misses(is_open, normals[block], offsets[block], tolerance_px)
        gain = lines.length[is_open] * np.maximum(1.0 - ratio**2, 0.0)
        score = np.maximum.reduceat(gain[:, order], starts, axis=1).sum(axis=1)
        if float(score.max()) > best_score:
            best, best_score = start + int(np.argmax(score)), float(score.max())
    return best


def _refined(
    lines: _Lines, is_open: BoolArray, normal: FloatArray, offset: float, tolerance_px: float
) -> _Agreement:
    """Refit the plane to who agrees, and leave out who is far off by the others' own scatter."""
    found = _held_against(lines, is_open, normal, offset, tolerance_px)
    for _ in range(REFITS):
        if found.n_boards(lines) < LEAST_BOARDS:
            break
        agrees = found.agrees
        ends = lines.ends_mm[agrees].reshape(-1, 3)
        mm_px = lines.mm_per_px(agrees, found.normal[None])[0]
        weight = np.repeat(lines.length[agrees] / mm_px**2, 2)
        middle = weight @ ends / weight.sum()
        scatter_mm2 = (ends - middle).T @ ((ends - middle) * weight[:, None])
        normal = np.linalg.eigh(scatter_mm2)[1][:, 0]
        refit = _held_against(lines, is_open, normal, float(normal @ middle), found.limit_px)
        scatter = robust_sigma(refit.residual_px[agrees])
        limit = float(np.clip(OUTLYING * scatter, TOLERANCES_PX[0], tolerance_px))
        found = _held_against(lines, is_open, refit.normal, refit.offset, limit)
    return found


def _held_against(
    lines: _Lines, is_open: BoolArray, normal: FloatArray, offset: float, limit_px: float
) -> _Agreement:
    """Which of the open lines agree with a plane: of each image the one with the most support."""
    everyone = np.ones(len(lines.length), dtype=np.bool_)
    ratio = lines.misses(everyone, normal[None], np.array([offset]), limit_px)[0]
    height = np.abs(lines.ends_mm @ normal - offset).max(axis=1)
    residual = height / lines.mm_per_px(everyone, normal[None])[0]
    near = is_open & (ratio < 1.0)
    support = np.where(near, lines.length * (1.0 - ratio**2), -1.0)
    agrees = np.zeros(len(support), dtype=np.bool_)
    for i in np.unique(lines.image[near]):
        of_image = np.flatnonzero(lines.image == i)
        agrees[of_image[np.argmax(support[of_image])]] = True
    return _Agreement(normal, offset, limit_px, residual, agrees)


def rank_channels(
    n_images: int,
    stripes_of: Callable[[int, LaserColour], BoardStripes | FitFailure],
    cameras: HeadCameras,
    options: SheetOptions,
) -> tuple[tuple[LaserColour, str], ...]:
    """Try every channel on a sample of a set: that with the most evidence, and the next to try.

    One photograph does not tell: a lamp, a red handle, the pattern of the board and JPEG's coarse
    colours each win somewhere. Over a set the laser's line is the one that is long, straight on the
    board, narrow, and on the light sheet on which the boards agree. Where a channel shows many
    lines on each board there is no vote: the edges of an overexposed board pass for a fan until the
    fit refuses them. To be tried then is the best other channel in which the boards did agree.

    ``stripes_of`` gives the stripes of one of ``n_images`` photographs with a board in a channel.
    With each channel comes why it was taken, in words; nothing where no channel shows a straight
    stripe on a board.
    """
    sample = _sample(n_images)
    found = _tried(sample, CHANNELS, stripes_of, cameras, options)
    evidence = [(_weigh(boards, cameras, options), c) for c, boards in found.items()]
    evidence = sorted((e for e in evidence if e[0].weight > 0.0), key=lambda e: -e[0].weight)
    if not evidence:
        return ()
    ranked = evidence[:1] + [e for e in evidence[1:] if not e[0].is_fan][:1]
    following = "; next {1} with {0.n_shown}, {0.n_points} and {0.scatter_px:.2f} px"
    reasons = [
        f"{channel}: the stripe on the common sheet in {shown.n_shown} of {len(sample)} sampled "
        f"photographs, {shown.n_points} points that scatter {shown.scatter_px:.2f} px"
        for shown, channel in ranked
    ]
    reasons[0] += following.format(*evidence[1]) if len(evidence) > 1 else ""
    return tuple((channel, why) for (_, channel), why in zip(ranked, reasons, strict=True))


def choose_print(
    n_images: int,
    stripes_of: Callable[[int, bool], BoardStripes | FitFailure],
    cameras: HeadCameras,
    options: SheetOptions,
) -> tuple[bool, str]:
    """Whether a set shows its lines better where the target's print is taken away, and how so.

    ``stripes_of`` gives the stripes of one of ``n_images`` photographs without a view without laser
    as it is, or less its print as `predict_print` knows it. Judged as in `rank_channels`.
    """
    if not n_images:
        return False, ""
    sample = _sample(n_images)
    found = _tried(sample, (False, True), stripes_of, cameras, options)
    as_is, less = (
        _weigh(found.get(less_print, ()), cameras, options) for less_print in (False, True)
    )
    if less.weight <= as_is.weight or less.n_shown < LEAST_SHOWN:
        return False, ""
    before = f"in {as_is.n_shown}, {as_is.n_points} points" if False in found else "given up early"
    return True, (
        f"{n_images} photographs have none without laser: their print is told from its repetition "
        f"and subtracted; the stripe on the common sheet in {less.n_shown} of {len(sample)} that "
        f"were tried, {less.n_points} points that scatter {less.scatter_px:.2f} px (as they are: "
        f"{before})"
    )


def _sample(n_images: int) -> IntArray:
    """Numbers of a few images, evenly spread over a set."""
    return np.unique(np.linspace(0, n_images - 1, min(SAMPLE, n_images)).round().astype(np.int64))


def _tried(
    sample: IntArray,
    ways: Sequence[Way],
    stripes_of: Callable[[int, Way], BoardStripes | FitFailure],
    cameras: HeadCameras,
    options: SheetOptions,
) -> dict[Way, list[BoardStripes]]:
    """Boards with the stripes that each way to look at an image shows, without hopeless ways."""
    # The middle one and both ends first: they differ most.
    order = sorted(
        range(len(sample)), key=lambda k: k not in {0, len(sample) // 2, len(sample) - 1}
    )
    found: dict[Way, list[BoardStripes]] = {way: [] for way in ways}
    for tried, k in enumerate(order):
        for way, boards in found.items():
            shown = stripes_of(int(sample[k]), way)
            if not isinstance(shown, FitFailure):
                boards.append(shown)
        share = LEAST_SHARE.get(tried + 1)
        if share is not None and len(order) > tried + 1:
            shown_by = {way: _weigh(boards, cameras, options) for way, boards in found.items()}
            found = {way: found[way] for way, shown in shown_by.items()
                     if shown.is_worth(share, shown_by.values())}  # fmt: skip
    return found


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Of stripes on the common sheet: weight, photographs, points, scatter (rms); whether they are
    so many on each board that none were voted on.
    """

    weight: float
    n_shown: int
    n_points: int
    scatter_px: float
    is_fan: bool

    def is_worth(self, share: float, others: Iterable[_Evidence]) -> bool:
        """False if it is less than this share of the best other, of fans if it is of a fan."""
        best = {True: 0.0, False: 0.0}
        for other in others:
            best[other.is_fan] = max(best[other.is_fan], other.weight)
        is_blank = self.weight == 0.0 < max(best.values())
        return not is_blank and self.weight >= share * best[self.is_fan]


def _weigh(
    boards: Sequence[BoardStripes], cameras: HeadCameras, options: SheetOptions
) -> _Evidence:
    """What a channel shows on the common sheet.

    The points over the square of their scatter are the precision that a photograph gets from the
    channel. The weight is the square of the sum of its roots, over the boards that agree: a short
    piece of an edge on two boards does not outweigh a line across all.
    """
    images = observe_boards(boards, cameras, options).images if boards else ()
    stripes = [(image, stripe.rows) for image in images for stripe in image.stripes]
    n = np.array([len(rows) for _, rows in stripes], dtype=np.int64)
    square = np.array([_scatter_px(image, rows) ** 2 for image, rows in stripes])
    precision = n / (square + LEAST_SCATTER_PX**2)
    of = np.repeat(np.arange(len(images)), [len(image.stripes) for image in images])
    root = np.sqrt(np.bincount(of, precision, minlength=len(images))).sum()
    return _Evidence(
        weight=float(root**2) * _consensus(images, cameras) ** 2,
        n_shown=sum(1 for image in images if image.stripes),
        n_points=int(n.sum()),
        scatter_px=float(np.sqrt((n * square).sum() / n.sum())) if len(n) else 0.0,
        is_fan=bool(images) and _most_lines(images) >= LEAST_FAN,
    )


def _consensus(images: Sequence[BoardImage], cameras: HeadCameras) -> float:
    """Share of the boards with a straight stripe that have one on the best common sheet.

    After a vote it is 1; it tells of stripes that nobody voted on, a fan's or the borders of boards
    that agree on nothing. 1 where so few boards show any that it tells nothing.
    """
    lines = _Lines.of(images, cameras)
    n_boards = len(np.unique(lines.board))
    if n_boards < LEAST_TELLING:
        return 1.0
    return sum(sheet.n_boards(lines) for sheet in _agreements(lines, 1)) / n_boards


def _scatter_px(image: BoardImage, rows: IntArray) -> float:
    """Robust scatter of a stripe's points across a straight line on the board, in pixels."""
    flat = image.on_board_mm()[rows]
    centred = flat - flat.mean(axis=0)
    along, across = np.linalg.svd(centred, full_matrices=False)[2]
    x, y = centred @ along, centred @ across
    return robust_sigma(y - np.polyval(np.polyfit(x, y, 1), x)) / image.mm_per_px(rows)
