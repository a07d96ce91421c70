# SPDX-License-Identifier: Apache-2.0
"""Which of several candidate lines on each board belong to the sheet on which the boards agree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.labels import LEAST_FAN, board_numbers
from armscan.calibration.sheets.result import PointUse, SheetOptions, SkippedImage
from armscan.calibration.sheets.solve import square_root
from armscan.calibration.sheets.stripes_on_board import BoardImage, StripeObservation
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray

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
SECOND_SHARE = 0.5
"""A further sheet is seen on at least this part of the boards that show the first."""
MAX_TRIALS = 3000
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
MIN_SPREAD_RATIO = 0.01
REFITS = 3
SEED = 12


@dataclass(frozen=True, slots=True, eq=False)
class Vote:
    """What the boards agreed on.

    Parameters
    ----------
    images
        The images with the stripes that lie on a common sheet; without vote, as they were given.
    outlying
        Images whose stripes lie on none, with how far off.
    warnings
        What is doubtful about the vote.
    """

    images: tuple[BoardImage, ...]
    outlying: tuple[SkippedImage, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """S stripes as the pieces in space between their ends.

    ``ends_mm`` (S, 2, 3); ``pose_root`` (S, 2, 3, 6) movement of the ends for a sigma of the
    board's pose; ``across_mm_px`` (S, 3) movement for a pixel across; ``length`` (S,) points;
    ``image`` and ``board`` (S,), ``place`` (S,) number of the sighting in its image; ``centre_mm``
    (S, 3) of the camera that saw it, and ``bow_mm`` (S,) what a bow may do on its board.
    """

    ends_mm: FloatArray
    pose_root: FloatArray
    across_mm_px: FloatArray
    length: FloatArray
    image: IntArray
    board: IntArray
    place: IntArray
    centre_mm: FloatArray
    bow_mm: FloatArray


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

    def boards(self, lines: _Lines) -> int:
        return len(np.unique(lines.board[self.agrees]))


def vote_on_sheets(
    on_print: Sequence[BoardImage],
    around: Sequence[BoardImage],
    cameras: HeadCameras,
    options: SheetOptions,
) -> Vote:
    """Keep of each image the stripes that lie on a sheet on which at least three boards agree.

    The stripes on the print vote. Of images that show none there, a stripe beside the print is kept
    if it lies on one of these sheets. Only where the prints show no sheet, the stripes beside them
    vote, and then on one sheet unless the options say how many there are: the walls and floors
    behind show lines, too. Images whose one laser is named vote among themselves. Nothing is
    decided where no three boards agree, or where the lines of a fan are coplanar in too many ways:
    their numbering (`armscan.calibration.sheets.fan`) then judges.

    Parameters
    ----------
    on_print, around
        The images with the stripes on the print, and with those on print and carrier.
    cameras
        The cameras.
    options
        In force.
    """
    images: list[BoardImage] = list(on_print)
    outlying: list[SkippedImage] = []
    warnings: list[str] = []
    for group in _groups(on_print):
        inner, wide = [on_print[i] for i in group], [around[i] for i in group]
        if _most_lines(inner) >= LEAST_FAN:
            continue
        if _most_lines(inner) < 1 and _most_lines(wide) >= LEAST_FAN:
            found = [_Chosen(image) for image in wide]
        else:
            found = _voted(inner, wide, cameras, options)
        for i, item in zip(group, found, strict=True):
            images[i] = item.image
            if item.off is not None:
                outlying.append(item.off)
        n_shown = sum(bool(image.sightings) for image in wide)
        n_agree = sum(bool(item.image.sightings) for item in found)
        if n_agree < 0.5 * n_shown:
            warnings.append(
                f"only {n_agree} of {n_shown} images with a straight line agree on a sheet: look "
                "at those that were left out"
            )
    return Vote(tuple(images), tuple(outlying), tuple(warnings))


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """An image with the stripes that stay, and why it was left out if none did."""

    image: BoardImage
    off: SkippedImage | None = None


def _most_lines(images: Sequence[BoardImage]) -> float:
    return float(np.median([len(image.sightings) for image in images]))


def _voted(
    inner: Sequence[BoardImage],
    wide: Sequence[BoardImage],
    cameras: HeadCameras,
    options: SheetOptions,
) -> list[_Chosen]:
    """Vote on the stripes of the print, or if they show no sheet, on those around it."""
    lines = _lines_of(inner, cameras)
    sheets = _agreements(lines, options.n_sheets or LEAST_FAN)
    if not options.n_sheets and len(sheets) >= LEAST_FAN:
        return [_Chosen(image) for image in inner]
    if sheets:
        kept = [set(lines.place[_any(sheets) & (lines.image == i)]) for i in range(len(inner))]
    else:
        lines = _lines_of(wide, cameras)
        sheets = _agreements(lines, options.n_sheets or 1)
        kept = [set[int]() for _ in inner]
    if not sheets:
        return [_Chosen(image) for image in inner]
    beside = _lines_of(wide, cameras)
    sheets_beside = [_held_against(beside, sheet) for sheet in sheets]
    found = []
    for i, image in enumerate(inner):
        if kept[i]:
            found.append(_Chosen(_with(image, kept[i])))
            continue
        mine = beside.image == i
        there = set(beside.place[_any(sheets_beside) & mine].tolist())
        chosen = _Chosen(_with(wide[i], there))
        if mine.any() and not there:
            off = min(float(sheet.residual_px[mine].min()) for sheet in sheets_beside)
            chosen = _Chosen(chosen.image, _outlying(image, off, sheets[0].boards(lines)))
        found.append(chosen)
    return found


def _any(sheets: Sequence[_Agreement]) -> BoolArray:
    return np.asarray(np.any([sheet.agrees for sheet in sheets], axis=0))


def _groups(images: Sequence[BoardImage]) -> list[list[int]]:
    """Numbers of the images that share one named laser; all others are one group."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for i, image in enumerate(images):
        lasers = image.data.lasers
        groups.setdefault(lasers if len(lasers) == 1 else (), []).append(i)
    return list(groups.values())


def _outlying(image: BoardImage, off_px: float, n_boards: int) -> SkippedImage:
    return SkippedImage(
        image.data.profile.source,
        f"outlying board: its straight stripe lies {off_px:.1f} px from the sheet that {n_boards} "
        "boards agree on",
    )


def _with(image: BoardImage, kept: set[int]) -> BoardImage:
    if len(kept) == len(image.sightings):
        return image
    use = image.use.copy()
    for place, sighting in enumerate(image.sightings):
        if place not in kept:
            use[sighting.rows] = int(PointUse.OUTVOTED)
    sightings = tuple(s for place, s in enumerate(image.sightings) if place in kept)
    return replace(image, use=use, sightings=sightings)


def _lines_of(images: Sequence[BoardImage], cameras: HeadCameras) -> _Lines:
    boards = board_numbers(images)
    found = [(i, k, s) for i, image in enumerate(images) for k, s in enumerate(image.sightings)]
    roots = [square_root(image.placed.covariance) for image in images]
    n = len(found)
    return _Lines(
        np.array([s.ends_mm for _, _, s in found]).reshape(n, 2, 3),
        np.array([s.ends_by_pose @ roots[i] for i, _, s in found]).reshape(n, 2, 3, 6),
        np.array([s.across * _mm_per_px(images[i], s) for i, _, s in found]).reshape(n, 3),
        np.array([float(len(s.rows)) for _, _, s in found]),
        np.array([i for i, _, _ in found], dtype=np.int64),
        np.array([boards[i] for i, _, _ in found], dtype=np.int64),
        np.array([k for _, k, _ in found], dtype=np.int64),
        np.array([cameras.centre_mm(images[i].data.camera) for i, _, _ in found]).reshape(n, 3),
        np.array([_bow_mm(images[i], s) for i, _, s in found]),
    )


def _bow_mm(image: BoardImage, sighting: StripeObservation) -> float:
    print_mm = image.data.view.points_board_mm
    side_mm = float(np.ptp(print_mm, axis=0).max())
    pose = image.placed.sensor_from_board
    ends = (sighting.ends_mm - pose.translation_mm) @ pose.rotation
    middle = 0.5 * (print_mm.min(axis=0) + print_mm.max(axis=0))
    far_mm = float(np.linalg.norm(ends[:, :2] - middle[:2], axis=1).max())
    return BOW_SHARE * side_mm * max(1.0, (far_mm / (0.5 * side_mm)) ** 2)


def _mm_per_px(image: BoardImage, sighting: StripeObservation) -> float:
    rows = sighting.rows
    return float(np.median(image.sigma_mm[rows] / image.data.profile.sigma_px[rows]))


def _agreements(lines: _Lines, most: int) -> list[_Agreement]:
    """Planes from the one with the most support on; lines of one do not count for the next."""
    n_boards = len(np.unique(lines.board))
    found: list[_Agreement] = []
    open_lines = np.ones(len(lines.length), dtype=np.bool_)
    while len(found) < most:
        best = _best_agreement(lines, open_lines, n_boards)
        if best is None:
            break
        least = SECOND_SHARE * found[0].boards(lines) if found else 0.0
        if best.boards(lines) < max(LEAST_BOARDS, least):
            break
        found.append(best)
        open_lines &= ~(best.residual_px < 2.0 * TOLERANCES_PX[0]) & ~best.agrees
    return found


def _held_against(lines: _Lines, sheet: _Agreement) -> _Agreement:
    """The same plane with other lines: which of them agree with it."""
    return _judged(
        lines,
        np.ones(len(lines.length), dtype=np.bool_),
        sheet.normal,
        sheet.offset,
        sheet.limit_px,
    )


def _judged(
    lines: _Lines, own: BoolArray, normal: FloatArray, offset: float, limit_px: float
) -> _Agreement:
    everyone = np.ones(len(lines.length), dtype=np.bool_)
    ratio = _misses(lines, everyone, normal[None], np.array([offset]), limit_px)[0]
    height = np.abs(lines.ends_mm @ normal - offset).max(axis=1)
    residual = height / _mm_of_px(lines, everyone, normal[None])[0]
    agrees = _one_an_image(lines, own & (ratio < 1.0), ratio)
    return _Agreement(normal, offset, limit_px, residual, agrees)


def _best_agreement(lines: _Lines, own: BoolArray, n_boards: int) -> _Agreement | None:
    trials = list(_trial_planes(lines, own))
    if not trials:
        return None
    normals, offsets = (np.concatenate(parts) for parts in zip(*trials, strict=True))
    if not len(normals):
        return None
    best: _Agreement | None = None
    for tolerance in TOLERANCES_PX:
        found = _refined(lines, own, *_most_supported(lines, own, normals, offsets, tolerance))
        if best is None or found.boards(lines) > best.boards(lines):
            best = found
        if best.boards(lines) >= max(LEAST_BOARDS, AGREEING_SHARE * n_boards):
            break
    return best


def _trial_planes(lines: _Lines, own: BoolArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Planes (T, 3), (T,) through two lines of different boards, a random choice of all pairs."""
    chosen = np.flatnonzero(own)
    a, b = np.triu_indices(len(chosen), 1)
    apart = lines.board[chosen[a]] != lines.board[chosen[b]]
    a, b = chosen[a[apart]], chosen[b[apart]]
    if len(a) > MAX_TRIALS:
        # Long lines carry long support: they are tried more often.
        weight = lines.length[a] * lines.length[b]
        generator = np.random.default_rng(SEED)
        pick = generator.choice(len(a), MAX_TRIALS, replace=False, p=weight / weight.sum())
        a, b = a[pick], b[pick]
    for start in range(0, len(a), CHUNK):
        pair = np.concatenate(
            [lines.ends_mm[a[start : start + CHUNK]], lines.ends_mm[b[start : start + CHUNK]]],
            axis=1,
        )
        middle = pair.mean(axis=1)
        values, vectors = np.linalg.eigh(
            np.einsum("tki,tkj->tij", pair - middle[:, None], pair - middle[:, None])
        )
        ray = middle - lines.centre_mm[a[start : start + CHUNK]]
        sine = np.abs(np.einsum("ti,ti->t", vectors[:, :, 0], ray)) / np.linalg.norm(ray, axis=1)
        sound = (values[:, 1] > MIN_SPREAD_RATIO**2 * values[:, 2]) & (sine > LEAST_TRIANGULATION)
        normals = vectors[sound, :, 0]
        yield normals, np.einsum("ti,ti->t", normals, middle[sound])


def _most_supported(
    lines: _Lines, own: BoolArray, normals: FloatArray, offsets: FloatArray, tolerance_px: float
) -> tuple[FloatArray, float, float]:
    """The plane with the longest support, one line an image, and the tolerance."""
    best, best_score = 0, -1.0
    images = lines.image[own]
    order = np.argsort(images, kind="stable")
    starts = np.flatnonzero(np.diff(images[order], prepend=-1))
    for start in range(0, len(normals), CHUNK):
        block = slice(start, start + CHUNK)
        ratio = _misses(lines, own, normals[block], offsets[block], tolerance_px)
        gain = lines.length[own] * np.maximum(1.0 - ratio**2, 0.0)
        score = np.maximum.reduceat(gain[:, order], starts, axis=1).sum(axis=1)
        if float(score.max()) > best_score:
            best, best_score = start + int(np.argmax(score)), float(score.max())
    return normals[best], float(offsets[best]), tolerance_px


def _misses(
    lines: _Lines, own: BoolArray, normals: FloatArray, offsets: FloatArray, tolerance_px: float
) -> FloatArray:
    """(T, S) largest distance of a line's ends from each plane, over what is tolerated."""
    height = np.einsum("ti,sei->tse", normals, lines.ends_mm[own]) - offsets[:, None, None]
    by_pose = np.einsum("ti,seip->tsep", normals, lines.pose_root[own])
    pose = POSE_SIGMAS * np.sqrt((by_pose**2).sum(axis=3))
    allowed = tolerance_px * _mm_of_px(lines, own, normals) + lines.bow_mm[own]
    allowed = allowed[:, :, None] + pose
    return np.asarray((np.abs(height) / allowed).max(axis=2))


def _mm_of_px(lines: _Lines, own: BoolArray, normals: FloatArray) -> FloatArray:
    """(T, S) height over each plane for a pixel across the stripe."""
    across = lines.across_mm_px[own]
    height = np.abs(normals @ across.T)
    return np.asarray(np.maximum(height, GRAZING * np.linalg.norm(across, axis=1)))


def _refined(
    lines: _Lines, own: BoolArray, normal: FloatArray, offset: float, tolerance_px: float
) -> _Agreement:
    """Refit the plane to who agrees, and leave out who is far off by the others' own scatter."""
    found = _judged(lines, own, normal, offset, tolerance_px)
    for _ in range(REFITS):
        if found.boards(lines) < LEAST_BOARDS:
            break
        agrees = found.agrees
        ends = lines.ends_mm[agrees].reshape(-1, 3)
        mm_px = _mm_of_px(lines, agrees, found.normal[None])[0]
        weight = np.repeat(lines.length[agrees] / mm_px**2, 2)
        middle = weight @ ends / weight.sum()
        spread = (ends - middle).T @ ((ends - middle) * weight[:, None])
        normal = np.linalg.eigh(spread)[1][:, 0]
        refit = _judged(lines, own, normal, float(normal @ middle), found.limit_px)
        scatter = 1.4826 * float(np.median(refit.residual_px[agrees]))
        limit = float(np.clip(OUTLYING * scatter, TOLERANCES_PX[0], tolerance_px))
        found = _judged(lines, own, refit.normal, refit.offset, limit)
    return found


def _one_an_image(lines: _Lines, agrees: BoolArray, ratio: FloatArray) -> BoolArray:
    """Of the lines of one image that agree, the one with the most support."""
    gain = np.where(agrees, lines.length * (1.0 - ratio**2), -1.0)
    keep = np.zeros(len(gain), dtype=np.bool_)
    for i in np.unique(lines.image[agrees]):
        own = np.flatnonzero(lines.image == i)
        keep[own[np.argmax(gain[own])]] = True
    return keep
