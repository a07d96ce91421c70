# SPDX-License-Identifier: Apache-2.0
"""Which line belongs to which sheet when the sheets of a fan are alike: lines across the fan,
slots in order, the fit of a fan and the labels that follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.sheets.coplanarity import PosedObservation
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

BOW_ALLOWANCE_MM = 0.1
"""By how much an end of a straight piece may miss its sheet's plane for the sheet's bow: a line
bowed by 0.4 mm over 72 mm leaves the common plane of pieces half as long by up to 0.2 mm."""


@dataclass(frozen=True, slots=True, eq=False)
class FanLines:
    """L stripes, each by its two ends.

    Parameters
    ----------
    image, sighting
        (L,) image, and number of the stripe in the image.
    ends
        (L, 2, 3) ends along the stripes (u), along the line of sight (v) and across both (w), mm
        from the middle of all ends; w runs from left to right in the image, or from top to bottom
        where stripes lie flatter than 45 degrees.
    axes
        (3, 3) rows u, v, w in the Sensor frame.
    posed
        The stripes with their covariances.
    """

    image: IntArray
    sighting: IntArray
    ends: FloatArray
    axes: FloatArray
    posed: tuple[PosedObservation, ...]

    def __len__(self) -> int:
        """Count of stripes."""
        return len(self.image)

    def roots(self, slopes: FloatArray) -> FloatArray:
        """(L, 2, 2) matrices that scale the ends' heights over planes to unit variance.

        Parameters
        ----------
        slopes
            (L, 2) slopes of each stripe's plane along u and v.
        """
        roots = np.zeros((len(self), 2, 2))
        for k, stripe in enumerate(self.posed):
            upward = self.axes[2] - slopes[k, 0] * self.axes[0] - slopes[k, 1] * self.axes[1]
            covariance = stripe.height_covariance_mm2(upward) + BOW_ALLOWANCE_MM**2 * np.eye(2)
            roots[k] = np.linalg.inv(np.linalg.cholesky(covariance))
        return roots


def stack_fan_lines(posed: Sequence[Sequence[PosedObservation]]) -> FanLines:
    """Collect the stripes of all images; there must be one at least."""
    where = [(i, k) for i, stripes in enumerate(posed) for k in range(len(stripes))]
    flat = tuple(posed[i][k] for i, k in where)
    ends = np.stack([stripe.sighting.ends_mm for stripe in flat])
    middle = ends.reshape(-1, 3).mean(axis=0)
    steps = ends[:, 1] - ends[:, 0]
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    along = np.linalg.eigh(steps.T @ steps)[1][:, -1]
    across = np.cross(along, middle)
    across = across / np.linalg.norm(across)
    if not _runs_across(across, middle):
        across = -across
    depth = np.cross(across, along)
    axes = np.stack([along, depth, across])
    image, sighting = np.array(where, dtype=np.int64).T
    return FanLines(image, sighting, (ends - middle) @ axes.T, axes, flat)


def _runs_across(direction: FloatArray, middle_mm: FloatArray) -> bool:
    """True if a step along the direction is seen to the right, or down if mostly up or down."""
    seen = direction[:2] - middle_mm[:2] / middle_mm[2] * direction[2]
    return bool(seen[int(np.argmax(np.abs(seen)))] > 0.0)


PENCIL_SIGMA = np.array([0.5, 1.5, 0.02, 0.02])
"""How far a0, b0 (slopes) and alpha, beta (per mm) may be from zero: a source nearer than 50 mm to
the working volume, or sheets that the camera sees edge on, are no scanner."""
OWN_SLOPE_SIGMA = 0.01
"""By how much a sheet's slopes may differ from those of a plane through the axis: for bow, and for
sheets that miss the axis."""
SPACING_SHARE = 0.15
"""Neighbouring sheets are equally far apart up to this part of their distance."""
PENCIL_ITERATIONS = 40
FAN_ITERATIONS = 6
HUBER_SIGMA = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Pencil:
    """The axis of a fan, and where each stripe lies in it.

    Parameters
    ----------
    axis
        (4,) a0, b0, alpha, beta.
    covariance
        (4, 4) of these.
    height_mm
        (L,) c of the plane through the axis that is nearest to each stripe.
    """

    axis: FloatArray
    covariance: FloatArray
    height_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """Sheets of a fan fitted to named stripes.

    Parameters
    ----------
    slots
        (K,) numbers of the sheets, increasing.
    planes
        (K, 3) a, b, c of each.
    axis
        (4,) as in `Pencil`.
    chi2
        (L,) squares of each stripe's two ends over their variances; 0 where it has no name.
    cost
        Their sum, and what the fan's regularity adds.
    """

    slots: IntArray
    planes: FloatArray
    axis: FloatArray
    chi2: FloatArray
    cost: float


def heights_in_pencil(lines: FanLines, roots: FloatArray, axis: FloatArray) -> FloatArray:
    """(L,) c of the plane through an axis that is nearest to each stripe."""
    u, v, w = (lines.ends[:, :, k] for k in range(3))
    lever = np.einsum("lij,lj->li", roots, 1.0 + axis[2] * u + axis[3] * v)
    target = np.einsum("lij,lj->li", roots, w - axis[0] * u - axis[1] * v)
    return np.asarray((lever * target).sum(axis=1) / (lever**2).sum(axis=1))


def fit_pencil(lines: FanLines, roots: FloatArray) -> Pencil:
    """Find the axis that all stripes meet, without their names, by robust Gauss-Newton steps."""
    axis = np.zeros(4)
    u, v, w = (lines.ends[:, :, k] for k in range(3))
    for _ in range(PENCIL_ITERATIONS):
        c = heights_in_pencil(lines, roots, axis)[:, None]
        lever = 1.0 + axis[2] * u + axis[3] * v
        rest = np.einsum("lij,lj->li", roots, w - axis[0] * u - axis[1] * v - c * lever)
        design = np.einsum("lij,ljk->lik", roots, np.stack([u, v, c * u, c * v], axis=2))
        own = np.einsum("lij,lj->li", roots, lever)
        own = own / np.linalg.norm(own, axis=1)[:, None]
        # Each stripe's own height is free: what lies along it says nothing about the axis.
        design = design - own[:, :, None] * np.einsum("li,lik->lk", own, design)[:, None, :]
        size = np.linalg.norm(rest, axis=1)
        weight = HUBER_SIGMA / np.maximum(size, HUBER_SIGMA)
        weighted = design * weight[:, None, None]
        information = np.einsum("lik,lij->kj", weighted, design) + np.diag(PENCIL_SIGMA**-2)
        pull = np.einsum("lik,li->k", weighted, rest) - axis / PENCIL_SIGMA**2
        step = np.linalg.solve(information, pull)
        axis = axis + step
        if float(np.abs(step / PENCIL_SIGMA).max()) < 1e-6:
            break
    return Pencil(axis, np.linalg.inv(information), heights_in_pencil(lines, roots, axis))


def fit_fan(
    lines: FanLines, roots: FloatArray, slot: IntArray, spacing_mm: float, axis: FloatArray
) -> Fan:
    """Fit one plane a sheet, with the axis and the regularity of the fan as prior knowledge.

    Parameters
    ----------
    lines, roots
        The stripes and `FanLines.roots`.
    slot
        (L,) number of each stripe's sheet, -1 for none.
    spacing_mm
        Distance of neighbouring sheets.
    axis
        (4,) where the steps start.
    """
    named = np.flatnonzero(slot >= 0)
    slots, place = np.unique(slot[named], return_inverse=True)
    k = len(slots)
    heights = heights_in_pencil(lines, roots, axis)[named]
    c = np.array([float(np.median(heights[place == j])) for j in range(k)])
    x = np.concatenate([axis, axis[0] + axis[2] * c, axis[1] + axis[3] * c, c])
    design = np.zeros((2 * len(named), 4 + 3 * k))
    scaled = np.einsum("lij,ljk->lik", roots[named], _plane_terms(lines)[named])
    for term in range(3):
        columns = 4 + term * k + np.repeat(place, 2)
        design[np.arange(2 * len(named)), columns] = scaled[:, :, term].ravel()
    target = np.einsum("lij,lj->li", roots[named], lines.ends[named, :, 2]).ravel()
    for _ in range(FAN_ITERATIONS):
        prior, prior_rest = _prior(x, slots, spacing_mm)
        rest = np.concatenate([target - design @ x, prior_rest])
        x = x + np.linalg.lstsq(np.concatenate([design, prior]), rest, rcond=None)[0]
    rest = target - design @ x
    _, prior_rest = _prior(x, slots, spacing_mm)
    chi2 = np.zeros(len(lines))
    chi2[named] = (rest.reshape(-1, 2) ** 2).sum(axis=1)
    cost = float(chi2.sum() + prior_rest @ prior_rest)
    return Fan(slots, x[4:].reshape(3, k).T.copy(), x[:4], chi2, cost)


def misfits(lines: FanLines, roots: FloatArray, fan: Fan) -> FloatArray:
    """(L, K) squares of each stripe's ends over each plane of a fan."""
    over = lines.ends[:, None, :, 2] - np.einsum("lek,pk->lpe", _plane_terms(lines), fan.planes)
    return np.asarray((np.einsum("lij,lpj->lpi", roots, over) ** 2).sum(axis=2))


def _plane_terms(lines: FanLines) -> FloatArray:
    """(L, 2, 3) u, v and 1 of the ends."""
    return np.concatenate([lines.ends[:, :, :2], np.ones((len(lines), 2, 1))], axis=2)


def _prior(x: FloatArray, slots: IntArray, spacing_mm: float) -> tuple[FloatArray, FloatArray]:
    """Rows (3 K + 3, 4 + 3 K) of what is known of a fan beforehand, and their residuals."""
    k = len(slots)
    c = x[4 + 2 * k :]
    rows = np.zeros((3 * k + 3, 4 + 3 * k))
    rest = np.zeros(3 * k + 3)
    j = np.arange(k)
    for term in range(2):
        own = rows[term * k : (term + 1) * k]
        own[j, 4 + term * k + j] = 1.0
        own[j, 4 + 2 * k + j] = -x[2 + term]
        own[:, term] = -1.0
        own[:, 2 + term] = -c
        slopes = x[4 + term * k : 4 + (term + 1) * k]
        rest[term * k : (term + 1) * k] = x[term] + x[2 + term] * c - slopes
    rows[: 2 * k] /= OWN_SLOPE_SIGMA
    rest[: 2 * k] /= OWN_SLOPE_SIGMA
    gaps = np.diff(slots)
    sigma = SPACING_SHARE * spacing_mm * gaps
    between = rows[2 * k : 3 * k - 1]
    between[j[:-1], 4 + 2 * k + j[1:]] = 1.0 / sigma
    between[j[:-1], 4 + 2 * k + j[:-1]] = -1.0 / sigma
    rest[2 * k : 3 * k - 1] = (spacing_mm * gaps - np.diff(c)) / sigma
    rows[3 * k - 1 : 3 * k + 3, :4] = np.diag(1.0 / PENCIL_SIGMA)
    rest[3 * k - 1 : 3 * k + 3] = -x[:4] / PENCIL_SIGMA
    return rows, rest


CUT_SHARE = 0.4
"""Heights are of one sheet while they follow each other within this part of the spacing."""
CLOSE_SHARE = 0.6
"""Two sheets nearer than this part of the spacing cannot both be there."""
STRAY_CHI2 = 30.0
"""A stripe that misses its sheet by more belongs to none."""
SHEET_COST = 6.0
POLISH_ROUNDS = 6
START_SIGMAS = 4.0
START_SHARE = 0.35
"""Step of the starting axes: by how much of the spacing it moves the worst stripe."""
MAX_STARTS = 25
"""To either side."""


@dataclass(frozen=True, slots=True, eq=False)
class Numbering:
    """A way to number the stripes.

    Parameters
    ----------
    slot
        (L,) number of each stripe's sheet, 0 for the first seen; -1 for a stray stripe.
    fan
        The sheets that it makes.
    cost
        What it costs: misfits, stray stripes, sheets.
    """

    slot: IntArray
    fan: Fan
    cost: float


def spacing_of(lines: FanLines, height_mm: FloatArray) -> float | None:
    """Median distance of neighbouring stripes within an image; None if no image shows two."""
    gaps = [
        gap
        for image in np.unique(lines.image)
        for gap in np.diff(np.sort(height_mm[lines.image == image])).tolist()
    ]
    return float(np.median(gaps)) if gaps and float(np.median(gaps)) > 0.0 else None


def best_numberings(
    lines: FanLines, roots: FloatArray, pencil: Pencil, spacing_mm: float
) -> list[Numbering]:
    """Distinct numberings from starting axes over the range that the stripes leave open.

    The least costly comes first.
    """
    found: dict[tuple[int, ...], Numbering] = {}
    for axis in starting_axes(lines, pencil, spacing_mm):
        numbering = _polished(lines, roots, axis, spacing_mm)
        if numbering is not None:
            found.setdefault(tuple(numbering.slot.tolist()), numbering)
    return sorted(found.values(), key=lambda numbering: numbering.cost)


def starting_axes(lines: FanLines, pencil: Pencil, spacing_mm: float) -> list[FloatArray]:
    """Axes along the two combinations of parameters that leave the heights most uncertain."""
    u, v = lines.ends[:, :, 0].mean(axis=1), lines.ends[:, :, 1].mean(axis=1)
    c = pencil.height_mm
    effect = np.stack([u, v, c * u, c * v], axis=1)
    effect = effect - effect.mean(axis=0)
    root = np.linalg.cholesky(pencil.covariance)
    vectors = np.linalg.svd(effect @ root, full_matrices=False)[2]
    axes = [pencil.axis]
    for direction in (root @ vectors[:2].T).T:
        reach = float(np.abs(effect @ direction).max())
        step = START_SHARE * spacing_mm / max(reach, 1e-12)
        count = min(int(np.ceil(START_SIGMAS / step)), MAX_STARTS)
        axes += [pencil.axis + sign * k * step * direction for k in range(1, count + 1)
                 for sign in (1.0, -1.0)]  # fmt: skip
    return axes


def _polished(
    lines: FanLines, roots: FloatArray, axis: FloatArray, spacing_mm: float
) -> Numbering | None:
    """Number the stripes by their heights, fit the fan, and number again until it stays."""
    slot = slots_by_height(lines, heights_in_pencil(lines, roots, axis), spacing_mm)
    for _ in range(POLISH_ROUNDS):
        if not (slot >= 0).any():
            return None
        fan = fit_fan(lines, roots, slot, spacing_mm, axis)
        height = heights_in_pencil(lines, roots, fan.axis)
        again = slots_by_height(lines, height, spacing_mm)
        again = _without_strays(lines, roots, again, spacing_mm, fan.axis)
        if np.array_equal(again, slot):
            break
        slot, axis = again, fan.axis
    if not (slot >= 0).any():
        return None
    return numbering_of(lines, roots, slot, spacing_mm, axis)


def _without_strays(
    lines: FanLines, roots: FloatArray, slot: IntArray, spacing_mm: float, axis: FloatArray
) -> IntArray:
    """Take the worst stripe off its sheet while one misses it by too much."""
    slot = slot.copy()
    while (slot >= 0).any():
        fan = fit_fan(lines, roots, slot, spacing_mm, axis)
        worst = int(np.argmax(fan.chi2))
        if fan.chi2[worst] <= STRAY_CHI2:
            break
        slot[worst] = -1
    return slot


def numbering_of(
    lines: FanLines, roots: FloatArray, slot: IntArray, spacing_mm: float, axis: FloatArray
) -> Numbering:
    """The fan of a numbering, and its cost."""
    fan = fit_fan(lines, roots, slot, spacing_mm, axis)
    n_stray = int((slot < 0).sum())
    return Numbering(slot, fan, fan.cost + STRAY_CHI2 * n_stray + SHEET_COST * len(fan.slots))


def slots_by_height(lines: FanLines, height_mm: FloatArray, spacing_mm: float) -> IntArray:
    """(L,) number of the sheet of each stripe by its height alone; -1 for a stray one.

    One image shows a sheet at most once, and no two sheets are much nearer than the spacing.
    """
    order = np.argsort(height_mm)
    is_cut = np.diff(height_mm[order]) > CUT_SHARE * spacing_mm
    group = np.zeros(len(lines), dtype=np.int64)
    group[order] = np.concatenate([[0], np.cumsum(is_cut)])
    members = []
    for k in range(int(group.max()) + 1):
        own = np.flatnonzero(group == k)
        middle = float(np.median(height_mm[own]))
        nearest = own[np.argsort(np.abs(height_mm[own] - middle), kind="stable")]
        _, first = np.unique(lines.image[nearest], return_index=True)
        members.append(nearest[first])
    middles = [float(height_mm[own].mean()) for own in members]
    while len(members) > 1:
        gaps = np.diff(middles)
        k = int(np.argmin(gaps))
        if gaps[k] >= CLOSE_SHARE * spacing_mm:
            break
        fewer = k if len(members[k]) < len(members[k + 1]) else k + 1
        del members[fewer], middles[fewer]
    steps = np.maximum(np.rint(np.diff(middles) / spacing_mm).astype(np.int64), 1)
    slot = np.full(len(lines), -1)
    for number, own in zip(np.concatenate([[0], np.cumsum(steps)]), members, strict=True):
        slot[own] = number
    return slot


def shifted_slots(lines: FanLines, numbering: Numbering) -> list[IntArray]:
    """Numberings in which some images are moved by whole sheets against the others.

    Single images, all images beyond one (by depth, along and across the stripes), and images in
    proportion to their place: what a wrong axis would do.
    """
    named = numbering.slot >= 0
    images = np.unique(lines.image[named])
    row = np.searchsorted(images, lines.image[named])
    middle = lines.ends[named].mean(axis=1)
    place = np.stack([middle[row == i].mean(axis=0) for i in range(len(images))])
    moves = [step * np.eye(len(images), dtype=np.int64)[i] for i in range(len(images))
             for step in (-1, 1)]  # fmt: skip
    for coordinate in place.T:
        order = np.argsort(coordinate)
        for cut in range(1, len(images)):
            move = np.zeros(len(images), dtype=np.int64)
            move[order[cut:]] = 1
            moves += [move, -move]
        share = (coordinate - coordinate.mean()) / max(float(np.ptp(coordinate)), 1e-9)
        for reach in (2.0, 3.0, 4.0):
            move = np.rint(reach * share).astype(np.int64)
            moves += [move, -move]
    distinct = {tuple((move - move[0]).tolist()) for move in moves}
    found = []
    for key in sorted(distinct - {(0,) * len(images)}):
        moved = numbering.slot[named] + np.array(key)[row]
        slot = numbering.slot.copy()
        slot[named] = moved - moved.min()
        found.append(slot)
    return found


def contradicts(a: IntArray, b: IntArray) -> bool:
    """True if two numberings differ by more than where they begin, or by strays."""
    both = (a >= 0) & (b >= 0)
    difference = (a - b)[both]
    return bool(len(difference) and np.ptp(difference) != 0)


CLEAR_CHI2 = 25.0
"""By this much, five sigma, a numbering must beat every other one."""
LARGEST_MEAN_CHI2 = 9.0
"""Mean misfit of a stripe's end, in variances, above which the stripes are no fan."""
LEAST_NAMED = 0.5
"""Part of the stripes that must find a sheet."""
UNEVEN_SHARE = 0.3
"""Distances of neighbouring sheets that differ from whole spacings by more do not tell how many
sheets are missing between them."""
REMEDY = (
    "show each line on boards at several depths and tilts, and let neighbouring placements share "
    "lines"
)


@dataclass(frozen=True, slots=True, eq=False)
class FanAssignment:
    """Which line each stripe shows.

    Parameters
    ----------
    numbers
        Numbers of the sheets found, counted from 1 at the left (or top) of the fan.
    sheets
        For each image, the place in ``numbers`` of each of its stripes; -1 for none.
    how, warnings
        In words.
    """

    numbers: tuple[int, ...]
    sheets: tuple[tuple[int, ...], ...]
    how: str
    warnings: tuple[str, ...]


def number_fan(
    posed: Sequence[Sequence[PosedObservation]], boards: Sequence[int], n_sheets: int = 0
) -> FanAssignment | FitFailure:
    """Number the stripes of one source with several sheets.

    Parameters
    ----------
    posed
        The stripes of each image.
    boards
        Number of each image's board placement: two images may show one.
    n_sheets
        How many sheets the source has; 0 if that is not known.

    Returns
    -------
    FanAssignment or FitFailure
        A failure where the placements leave open which stripes belong together: nothing is
        guessed.
    """
    if len({board for board, stripes in zip(boards, posed, strict=True) if stripes}) < 2:
        return FitFailure("fewer than two board placements show a stripe", REMEDY)
    lines = stack_fan_lines(posed)
    roots = lines.roots(np.zeros((len(lines), 2)))
    pencil = fit_pencil(lines, roots)
    roots = lines.roots(pencil.axis[:2] + pencil.height_mm[:, None] * pencil.axis[2:])
    pencil = fit_pencil(lines, roots)
    spacing_mm = spacing_of(lines, pencil.height_mm)
    if spacing_mm is None:
        return FitFailure("no image shows two lines of the source", REMEDY)
    found = best_numberings(lines, roots, pencil, spacing_mm)
    if not found:
        return FitFailure("the stripes do not fall into sheets of one fan", REMEDY)
    sure = _sure(lines, roots, spacing_mm, found)
    if isinstance(sure, FitFailure):
        return sure
    return _named(posed, boards, sure, n_sheets)


@dataclass(frozen=True, slots=True, eq=False)
class _Sure:
    """A numbering that stands, without the images that might be moved.

    Parameters
    ----------
    lines, spacing_mm
        The stripes, and the distance of neighbouring sheets.
    numbering
        Of the stripes.
    margin
        By which the next numbering is worse.
    left_out
        The images that might be moved.
    """

    lines: FanLines
    spacing_mm: float
    numbering: Numbering
    margin: float
    left_out: tuple[int, ...]


def _sure(
    lines: FanLines, roots: FloatArray, spacing_mm: float, found: list[Numbering]
) -> _Sure | FitFailure:
    """Put the best numbering to the test."""
    best = found[0]
    named = best.slot >= 0
    mean = float(best.fan.chi2[named].sum()) / max(2 * int(named.sum()), 1)
    if mean > LARGEST_MEAN_CHI2 or named.mean() < LEAST_NAMED:
        return FitFailure(
            f"{int(named.sum())} of {len(lines)} stripes fit the sheets of one fan, missing them "
            f"by {np.sqrt(mean):.1f} sigma (rms)",
            "check the boards' poses, and that all stripes come from one source",
        )
    clear = CLEAR_CHI2 * max(1.0, mean)
    for other in found[1:]:
        if other.cost - best.cost < clear and contradicts(best.slot, other.slot):
            return _ambiguous(other.cost - best.cost)
    left_out: list[int] = []
    while True:
        rivals = [
            (numbering_of(lines, roots, slot, spacing_mm, best.fan.axis).fan.cost, slot)
            for slot in shifted_slots(lines, best)
        ]
        cost, slot = min(rivals, key=lambda rival: rival[0])
        margin = cost - best.fan.cost
        if margin >= clear:
            return _Sure(lines, spacing_mm, best, margin, tuple(left_out))
        loose = _moved_images(lines, best.slot, slot)
        remaining = np.unique(lines.image[best.slot >= 0])
        if len(loose) != 1 or len(remaining) < 3:
            return _ambiguous(margin)
        left_out.append(loose[0])
        kept = np.where(lines.image == loose[0], -1, best.slot)
        best = numbering_of(lines, roots, kept, spacing_mm, best.fan.axis)


def _ambiguous(margin: float) -> FitFailure:
    return FitFailure(
        "the placements share too few lines, or their boards are too parallel, to tell which "
        f"stripes show the same line (another numbering fits worse by chi2 {margin:.2g} only, need "
        f"{CLEAR_CHI2:.0f})",
        REMEDY,
    )


def _moved_images(lines: FanLines, slot: IntArray, moved: IntArray) -> list[int]:
    """The images that a rival numbering moves against most of the others."""
    named = slot >= 0
    images = [int(i) for i in np.unique(lines.image[named])]
    difference = {i: int((moved - slot)[named & (lines.image == i)][0]) for i in images}
    values = list(difference.values())
    usual = max(set(values), key=values.count)
    return [image for image, value in difference.items() if value != usual]


def _named(
    posed: Sequence[Sequence[PosedObservation]], boards: Sequence[int], sure: _Sure, n_sheets: int
) -> FanAssignment | FitFailure:
    lines, numbering = sure.lines, sure.numbering
    slot = numbering.slot
    board = np.asarray(boards)[lines.image]
    slots = [int(s) for s in numbering.fan.slots]
    n_boards = {s: len(np.unique(board[slot == s])) for s in slots}
    kept = [s for s in slots if n_boards[s] >= 2]
    if not kept:
        return FitFailure("no line is seen on two board placements", REMEDY)
    if n_sheets and len(kept) > n_sheets:
        return FitFailure(
            f"the stripes show {len(kept)} lines, and {n_sheets} were announced",
            "check the count of lines, and that no reflection of the laser is on the board",
        )
    numbers, warnings = _numbers(kept, sure, n_sheets)
    place = {s: k for k, s in enumerate(kept)}
    sheets = [[-1] * len(stripes) for stripes in posed]
    for k in range(len(lines)):
        sheets[int(lines.image[k])][int(lines.sighting[k])] = place.get(int(slot[k]), -1)
    n_named = sum(s in place for s in slot.tolist())
    how = (
        f"{len(kept)} lines of one fan, {n_named} of {len(lines)} stripes, each image showing "
        f"{min(map(len, posed))} to {max(map(len, posed))}; the next numbering is worse by chi2 "
        f"{sure.margin:.3g}"
    )
    if n_named < len(lines):
        warnings.append(
            f"{len(lines) - n_named} of {len(lines)} stripes were given to no sheet (strays, lines "
            "seen on one board only, images that might belong elsewhere in the fan)"
        )
    if sure.left_out:
        warnings.append(
            f"{len(sure.left_out)} images share too few lines with the others to be placed in the "
            "fan"
        )
    return FanAssignment(tuple(numbers), tuple(tuple(row) for row in sheets), how, tuple(warnings))


def _numbers(kept: list[int], sure: _Sure, n_sheets: int) -> tuple[list[int], list[str]]:
    """Numbers from 1 of the sheets kept, and what is doubtful about them."""
    warnings: list[str] = []
    slots = [int(s) for s in sure.numbering.fan.slots]
    # A line seen on one board cannot be calibrated, and still counts, unless it is one too many.
    known = kept if n_sheets and slots[-1] - slots[0] >= n_sheets else slots
    if len(kept) == n_sheets:
        return list(range(1, n_sheets + 1)), warnings
    heights = sure.numbering.fan.planes[[slots.index(s) for s in known], 2]
    share = np.diff(heights) / sure.spacing_mm
    if len(share) and float(np.abs(share - np.rint(share)).max()) > UNEVEN_SHARE:
        warnings.append("the lines are unevenly spaced, so that none is known to be missing")
        numbers = [k + 1 for k, s in enumerate(known) if s in kept]
    else:
        numbers = [s - known[0] + 1 for s in kept]
    n_slots = known[-1] - known[0] + 1
    if n_sheets and n_slots < n_sheets:
        warnings.append(
            f"{n_slots} of {n_sheets} lines were seen: numbered from the first one seen, so that a "
            "line missing before it moves all numbers"
        )
    missing = sorted(set(range(1, numbers[-1] + 1)) - set(numbers))
    if missing:
        words = ", ".join(str(number) for number in missing)
        warnings.append(f"too few boards show line {words}: left out, and its number kept free")
    return numbers, warnings
