# SPDX-License-Identifier: Apache-2.0
"""Lines of one source with several sheets, numbered over images that each show only some of them.

Sheets that open from one source all but share a line, the fan's axis. In a frame with u along the
stripes, v along the line of sight and w across both, the planes through a line are
``w = a u + b v + c`` with ``a = a0 + alpha c`` and ``b = b0 + beta c``: four numbers for the axis,
and the height c for each sheet. Every stripe, whatever its number, meets the axis, so that the four
follow from all stripes before any is numbered; the heights then fall into classes, one a sheet. The
numbering stands if every other one, with images moved against each other by whole sheets, fits much
worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.sheets.stripes_on_board import StripeObservation
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

BOW_ALLOWANCE_MM = 0.1
"""By how much an end of a straight piece may miss its sheet's plane for the sheet's bow: a line
bowed by 0.4 mm over 72 mm leaves the common plane of pieces half as long by up to 0.2 mm."""
AXIS_SIGMA = np.array([0.5, 1.5, 0.02, 0.02])
"""How far a0, b0 (slopes) and alpha, beta (per mm) may be from zero: a source nearer than 50 mm to
the working volume, or sheets that the camera sees edge on, are no scanner."""
OWN_SLOPE_SIGMA = 0.01
"""By how much a sheet's slopes may differ from those of a plane through the axis: for bow, and for
sheets that miss the axis."""
SPACING_SHARE = 0.15
"""Neighbouring sheets are equally far apart up to this part of their distance."""
AXIS_ITERATIONS = 40
FAN_ITERATIONS = 6
HUBER_SIGMA = 3.0
CUT_SHARE = 0.4
"""Heights are of one sheet while they follow each other within this part of the spacing."""
CLOSE_SHARE = 0.6
"""Two sheets nearer than this part of the spacing cannot both be there."""
STRAY_CHI2 = 30.0
"""A stripe that misses its sheet by more belongs to none."""
SHEET_COST = 6.0
"""Cost of a further sheet: the chi-square that its three numbers must save to be worth it."""
POLISH_ROUNDS = 6
START_SIGMAS = 4.0
START_SHARE = 0.35
"""Step of the starting axes: by how much of the spacing it moves the worst stripe."""
MAX_STARTS = 25
"""To either side."""
CLEAR_CHI2 = 25.0
"""By this much, five sigma, a numbering must beat every other one."""
LARGEST_MEAN_CHI2 = 9.0
"""Mean misfit of a stripe's end, in variances, above which the stripes are no fan."""
LEAST_NUMBERED = 0.5
"""Part of the stripes that must find a sheet."""
HOPELESS_NUMBERED = 0.25
"""A round that leaves fewer on sheets is the last but one: each further stray costs a fit."""
UNEVEN_SHARE = 0.3
"""Distances of neighbouring sheets that differ from whole spacings by more do not tell how many
sheets are missing between them."""
REMEDY = (
    "show each line on boards at several depths and tilts, let neighbouring placements share "
    "lines, and check that the laser is on in the images that are given as such"
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
    stripes: Sequence[Sequence[StripeObservation]], boards: Sequence[int], n_sheets: int = 0
) -> FanAssignment | FitFailure:
    """Number the stripes of one source with several sheets, 0 if it is not known how many.

    ``stripes`` are those of each image and ``boards`` the numbers of the images' board placements.
    Where the placements leave open which stripes belong together, nothing is guessed.
    """
    if len({board for board, shown in zip(boards, stripes, strict=True) if shown}) < 2:
        return FitFailure("fewer than two board placements show a stripe", REMEDY)
    lines = _lines_of(stripes)
    axis, _ = _common_axis(lines)
    height = _heights(lines, axis)
    lines = lines.scaled_for(axis[:2] + height[:, None] * axis[2:])
    axis, covariance = _common_axis(lines)
    height = _heights(lines, axis)
    gaps = [
        gap
        for image in np.unique(lines.image)
        for gap in np.diff(np.sort(height[lines.image == image])).tolist()
    ]
    if not gaps or float(np.median(gaps)) <= 0.0:
        return FitFailure("no image shows two lines of the source", REMEDY)
    lines = replace(lines, spacing_mm=float(np.median(gaps)))
    found: dict[tuple[int, ...], _Fan] = {}
    for start in _starting_axes(lines, axis, covariance):
        fan = _polished(lines, start)
        if fan is not None:
            found.setdefault(tuple(fan.slot.tolist()), fan)
    if not found:
        return FitFailure(
            f"no numbering puts {HOPELESS_NUMBERED:.0%} of the {len(lines)} stripes on sheets of "
            "one fan",
            "check the boards' poses, and that all stripes come from one source; if there are "
            "fewer lines, say so by --sheets, and name the channel that shows them by "
            f"--laser-colour; {REMEDY}",
        )
    certain = _certain(lines, sorted(found.values(), key=lambda fan: fan.cost))
    return certain if isinstance(certain, FitFailure) else certain.assigned(boards, n_sheets)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """L stripes of the images, each by its two ends, in the frame of the fan.

    ``image``, ``number`` (L,) image, and number of the stripe in it; ``ends`` (L, 2, 3) along u, v
    and w, mm from the middle of all ends, w running from left to right in the image, or from top to
    bottom where stripes lie flatter than 45 degrees; ``axes`` (3, 3) rows u, v, w in Sensor;
    ``roots`` (L, 2, 2) scale the ends' heights over planes to unit variance; ``spacing_mm`` of
    neighbouring sheets.
    """

    stripes: Sequence[Sequence[StripeObservation]]
    image: IntArray
    number: IntArray
    ends: FloatArray
    axes: FloatArray
    roots: FloatArray
    spacing_mm: float = 0.0

    def __len__(self) -> int:
        return len(self.image)

    def scaled_for(self, slopes: FloatArray) -> _Lines:
        """The same for planes with these slopes (L, 2) along u and v."""
        roots = np.zeros((len(self), 2, 2))
        for k, (i, number) in enumerate(zip(self.image, self.number, strict=True)):
            upward = self.axes[2] - slopes[k, 0] * self.axes[0] - slopes[k, 1] * self.axes[1]
            covariance = self.stripes[i][number].height_covariance_mm2(upward)
            covariance = covariance + BOW_ALLOWANCE_MM**2 * np.eye(2)
            roots[k] = np.linalg.inv(np.linalg.cholesky(covariance))
        return replace(self, roots=roots)


def _lines_of(stripes: Sequence[Sequence[StripeObservation]]) -> _Lines:
    image, number = np.array(
        [(i, k) for i, shown in enumerate(stripes) for k in range(len(shown))], dtype=np.int64
    ).T
    ends = np.stack([stripe.ends_mm for shown in stripes for stripe in shown])
    middle = ends.reshape(-1, 3).mean(axis=0)
    steps = ends[:, 1] - ends[:, 0]
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    along = np.linalg.eigh(steps.T @ steps)[1][:, -1]
    across = np.cross(along, middle)
    across = across / np.linalg.norm(across)
    in_image = across[:2] - middle[:2] / middle[2] * across[2]
    if in_image[int(np.argmax(np.abs(in_image)))] <= 0.0:
        across = -across
    axes = np.stack([along, np.cross(across, along), across])
    lines = _Lines(stripes, image, number, (ends - middle) @ axes.T, axes, np.zeros((0, 2, 2)))
    return lines.scaled_for(np.zeros((len(image), 2)))


@dataclass(frozen=True, slots=True, eq=False)
class _Fan:
    """Sheets of a fan fitted to numbered stripes.

    ``slot`` (L,) number of each stripe's sheet, -1 for a stray one; ``slots`` (K,) the numbers of
    the sheets, increasing; ``heights`` (K,) c of each; ``axis`` (4,) a0, b0, alpha, beta; ``chi2``
    (L,) squares of each stripe's two ends over their variances, 0 for a stray one; ``fit_cost``
    their sum and what the fan's regularity adds.
    """

    slot: IntArray
    slots: IntArray
    heights: FloatArray
    axis: FloatArray
    chi2: FloatArray
    fit_cost: float

    @property
    def cost(self) -> float:
        """What the numbering costs: misfits, stray stripes, sheets."""
        n_stray = int((self.slot < 0).sum())
        return self.fit_cost + STRAY_CHI2 * n_stray + SHEET_COST * len(self.slots)


def _heights(lines: _Lines, axis: FloatArray) -> FloatArray:
    """(L,) c of the plane through an axis that is nearest to each stripe."""
    u, v, w = (lines.ends[:, :, k] for k in range(3))
    lever = np.einsum("lij,lj->li", lines.roots, 1.0 + axis[2] * u + axis[3] * v)
    target = np.einsum("lij,lj->li", lines.roots, w - axis[0] * u - axis[1] * v)
    return np.asarray((lever * target).sum(axis=1) / (lever**2).sum(axis=1))


def _common_axis(lines: _Lines) -> tuple[FloatArray, FloatArray]:
    """Axis (4,) that all stripes meet, and its covariance (4, 4), by robust Gauss-Newton steps."""
    axis = np.zeros(4)
    u, v, w = (lines.ends[:, :, k] for k in range(3))
    for _ in range(AXIS_ITERATIONS):
        c = _heights(lines, axis)[:, None]
        lever = 1.0 + axis[2] * u + axis[3] * v
        rest = np.einsum("lij,lj->li", lines.roots, w - axis[0] * u - axis[1] * v - c * lever)
        design = np.einsum("lij,ljk->lik", lines.roots, np.stack([u, v, c * u, c * v], axis=2))
        by_height = np.einsum("lij,lj->li", lines.roots, lever)
        by_height = by_height / np.linalg.norm(by_height, axis=1)[:, None]
        # Each stripe's own height is free: what lies along it says nothing about the axis.
        along = np.einsum("li,lik->lk", by_height, design)
        design = design - by_height[:, :, None] * along[:, None, :]
        size = np.linalg.norm(rest, axis=1)
        weighted = design * (HUBER_SIGMA / np.maximum(size, HUBER_SIGMA))[:, None, None]
        information = np.einsum("lik,lij->kj", weighted, design) + np.diag(AXIS_SIGMA**-2)
        pull = np.einsum("lik,li->k", weighted, rest) - axis / AXIS_SIGMA**2
        step = np.linalg.solve(information, pull)
        axis = axis + step
        if float(np.abs(step / AXIS_SIGMA).max()) < 1e-6:
            break
    return axis, np.linalg.inv(information)


def _starting_axes(lines: _Lines, axis: FloatArray, covariance: FloatArray) -> Iterator[FloatArray]:
    """Axes along the two combinations of parameters that leave the heights most uncertain."""
    u, v = lines.ends[:, :, 0].mean(axis=1), lines.ends[:, :, 1].mean(axis=1)
    c = _heights(lines, axis)
    effect = np.stack([u, v, c * u, c * v], axis=1)
    effect = effect - effect.mean(axis=0)
    root = np.linalg.cholesky(covariance)
    vectors = np.linalg.svd(effect @ root, full_matrices=False)[2]
    yield axis
    for direction in (root @ vectors[:2].T).T:
        reach = float(np.abs(effect @ direction).max())
        step = START_SHARE * lines.spacing_mm / max(reach, 1e-12)
        for k in range(1, min(int(np.ceil(START_SIGMAS / step)), MAX_STARTS) + 1):
            yield axis + k * step * direction
            yield axis - k * step * direction


def _polished(lines: _Lines, axis: FloatArray) -> _Fan | None:
    """Number the stripes by their heights, fit the fan, and number again until it stays."""
    slot = _slots_by_height(lines, _heights(lines, axis))
    n_hopeless = 0
    for _ in range(POLISH_ROUNDS):
        n_hopeless += not _is_hopeful(slot)
        if n_hopeless > 1 or not (slot >= 0).any():
            return None
        fan = _fit_fan(lines, slot, axis)
        again = _slots_by_height(lines, _heights(lines, fan.axis))
        again = _without_strays(lines, again, fan.axis)
        if np.array_equal(again, slot):
            break
        slot, axis = again, fan.axis
    return _fit_fan(lines, slot, axis) if _is_hopeful(slot) else None


def _without_strays(lines: _Lines, slot: IntArray, axis: FloatArray) -> IntArray:
    """Take the worst stripe off its sheet while one misses it by too much, and there is hope."""
    slot = slot.copy()
    while _is_hopeful(slot):
        fan = _fit_fan(lines, slot, axis)
        worst = int(np.argmax(fan.chi2))
        if fan.chi2[worst] <= STRAY_CHI2:
            break
        slot[worst] = -1
    return slot


def _is_hopeful(slot: IntArray) -> bool:
    return float((slot >= 0).mean()) >= HOPELESS_NUMBERED


def _slots_by_height(lines: _Lines, height_mm: FloatArray) -> IntArray:
    """(L,) number of the sheet of each stripe by its height alone; -1 for a stray one.

    One image shows a sheet at most once, and no two sheets are much nearer than the spacing.
    """
    order = np.argsort(height_mm)
    is_cut = np.diff(height_mm[order]) > CUT_SHARE * lines.spacing_mm
    members = []
    for piece in np.split(order, np.flatnonzero(is_cut) + 1):
        group = np.sort(piece)
        middle = float(np.median(height_mm[group]))
        nearest = group[np.argsort(np.abs(height_mm[group] - middle), kind="stable")]
        _, first = np.unique(lines.image[nearest], return_index=True)
        members.append(nearest[first])
    middles = [float(height_mm[group].mean()) for group in members]
    while len(members) > 1:
        gaps = np.diff(middles)
        k = int(np.argmin(gaps))
        if gaps[k] >= CLOSE_SHARE * lines.spacing_mm:
            break
        fewer = k if len(members[k]) < len(members[k + 1]) else k + 1
        del members[fewer], middles[fewer]
    steps = np.maximum(np.rint(np.diff(middles) / lines.spacing_mm).astype(np.int64), 1)
    slot = np.full(len(lines), -1)
    for number, group in zip(np.concatenate([[0], np.cumsum(steps)]), members, strict=True):
        slot[group] = number
    return slot


def _fit_fan(lines: _Lines, slot: IntArray, axis: FloatArray) -> _Fan:
    """Fit one plane a sheet, with the axis and the regularity of the fan as prior knowledge.

    ``slot`` (L,) numbers the stripes, -1 for none; the steps start at ``axis`` (4,).
    """
    numbered = np.flatnonzero(slot >= 0)
    slots, place = np.unique(slot[numbered], return_inverse=True)
    k = len(slots)
    heights = _heights(lines, axis)[numbered]
    c = np.array([float(np.median(heights[place == j])) for j in range(k)])
    x = np.concatenate([axis, axis[0] + axis[2] * c, axis[1] + axis[3] * c, c])
    design = np.zeros((2 * len(numbered), 4 + 3 * k))
    ends, roots = lines.ends[numbered], lines.roots[numbered]
    terms = np.concatenate([ends[:, :, :2], np.ones((len(ends), 2, 1))], axis=2)
    scaled = np.einsum("lij,ljk->lik", roots, terms)
    for term in range(3):
        columns = 4 + term * k + np.repeat(place, 2)
        design[np.arange(2 * len(numbered)), columns] = scaled[:, :, term].ravel()
    target = np.einsum("lij,lj->li", roots, ends[:, :, 2]).ravel()
    for _ in range(FAN_ITERATIONS):
        prior, prior_rest = _prior(x, slots, lines.spacing_mm)
        rest = np.concatenate([target - design @ x, prior_rest])
        x = x + np.linalg.lstsq(np.concatenate([design, prior]), rest, rcond=None)[0]
    rest = target - design @ x
    _, prior_rest = _prior(x, slots, lines.spacing_mm)
    chi2 = np.zeros(len(lines))
    chi2[numbered] = (rest.reshape(-1, 2) ** 2).sum(axis=1)
    cost = float(chi2.sum() + prior_rest @ prior_rest)
    return _Fan(slot, slots, x[4 + 2 * k :], x[:4], chi2, cost)


def _prior(x: FloatArray, slots: IntArray, spacing_mm: float) -> tuple[FloatArray, FloatArray]:
    """Rows (3 K + 3, 4 + 3 K) of what is known of a fan beforehand, and their residuals."""
    k = len(slots)
    c = x[4 + 2 * k :]
    rows = np.zeros((3 * k + 3, 4 + 3 * k))
    rest = np.zeros(3 * k + 3)
    j = np.arange(k)
    for term in range(2):
        slopes = x[4 + term * k : 4 + (term + 1) * k]
        of_term = rows[term * k : (term + 1) * k]
        of_term[j, 4 + term * k + j] = 1.0
        of_term[j, 4 + 2 * k + j] = -x[2 + term]
        of_term[:, term] = -1.0
        of_term[:, 2 + term] = -c
        rest[term * k : (term + 1) * k] = x[term] + x[2 + term] * c - slopes
    rows[: 2 * k] /= OWN_SLOPE_SIGMA
    rest[: 2 * k] /= OWN_SLOPE_SIGMA
    gaps = np.diff(slots)
    sigma = SPACING_SHARE * spacing_mm * gaps
    between = rows[2 * k : 3 * k - 1]
    between[j[:-1], 4 + 2 * k + j[1:]] = 1.0 / sigma
    between[j[:-1], 4 + 2 * k + j[:-1]] = -1.0 / sigma
    rest[2 * k : 3 * k - 1] = (spacing_mm * gaps - np.diff(c)) / sigma
    rows[3 * k - 1 : 3 * k + 3, :4] = np.diag(1.0 / AXIS_SIGMA)
    rest[3 * k - 1 : 3 * k + 3] = -x[:4] / AXIS_SIGMA
    return rows, rest


@dataclass(frozen=True, slots=True, eq=False)
class _Certain:
    """A numbering that stands, without the ``n_left_out`` images that might be moved."""

    lines: _Lines
    fan: _Fan
    margin: float
    n_left_out: int

    def assigned(self, boards: Sequence[int], n_sheets: int) -> FanAssignment | FitFailure:
        """The numbering in words and numbers, of the sheets that two boards show."""
        lines, slot = self.lines, self.fan.slot
        board = np.asarray(boards)[lines.image]
        kept = [int(s) for s in self.fan.slots if len(np.unique(board[slot == s])) >= 2]
        if not kept:
            return FitFailure("no line is seen on two board placements", REMEDY)
        if n_sheets and len(kept) > n_sheets:
            return FitFailure(
                f"the stripes show {len(kept)} lines, and {n_sheets} were announced",
                "check the count of lines, and that no reflection of the laser is on the board",
            )
        numbers, warnings = self._numbers(kept, n_sheets)
        sheets = [[-1] * len(shown) for shown in lines.stripes]
        for k, s in enumerate(slot.tolist()):
            if s in kept:
                sheets[int(lines.image[k])][int(lines.number[k])] = kept.index(s)
        n_numbered = sum(s in kept for s in slot.tolist())
        counts = [len(shown) for shown in lines.stripes]
        how = (
            f"{len(kept)} lines of one fan, {n_numbered} of {len(lines)} stripes, each image "
            f"showing {min(counts)} to {max(counts)}; the next numbering is worse by chi2 "
            f"{self.margin:.3g}"
        )
        if n_numbered < len(lines):
            warnings.append(
                f"{len(lines) - n_numbered} of {len(lines)} stripes were given to no sheet (strays,"
                " lines seen on one board only, images that might belong elsewhere in the fan)"
            )
        if self.n_left_out:
            warnings.append(
                f"{self.n_left_out} images share too few lines with the others to be placed in the "
                "fan"
            )
        return FanAssignment(tuple(numbers), tuple(map(tuple, sheets)), how, tuple(warnings))

    def _numbers(self, kept: list[int], n_sheets: int) -> tuple[list[int], list[str]]:
        """Numbers from 1 of the sheets kept, and what is doubtful about them."""
        if len(kept) == n_sheets:
            return list(range(1, n_sheets + 1)), []
        warnings: list[str] = []
        slots = [int(s) for s in self.fan.slots]
        # A line seen on one board cannot be calibrated, and still counts, unless one too many.
        known = kept if n_sheets and slots[-1] - slots[0] >= n_sheets else slots
        heights = self.fan.heights[[slots.index(s) for s in known]]
        share = np.diff(heights) / self.lines.spacing_mm
        if len(share) and float(np.abs(share - np.rint(share)).max()) > UNEVEN_SHARE:
            warnings.append("the lines are unevenly spaced, so that none is known to be missing")
            numbers = [k + 1 for k, s in enumerate(known) if s in kept]
        else:
            numbers = [s - known[0] + 1 for s in kept]
        n_slots = known[-1] - known[0] + 1
        if n_sheets and n_slots < n_sheets:
            warnings.append(
                f"{n_slots} of {n_sheets} lines were seen: numbered from the first one seen, so "
                "that a line missing before it moves all numbers"
            )
        missing = sorted(set(range(1, numbers[-1] + 1)) - set(numbers))
        if missing:
            words = ", ".join(map(str, missing))
            warnings.append(f"too few boards show line {words}: left out, and its number kept free")
        return numbers, warnings


def _certain(lines: _Lines, found: list[_Fan]) -> _Certain | FitFailure:
    """Put the best numbering to the test."""
    best = found[0]
    numbered = best.slot >= 0
    mean = float(best.chi2[numbered].sum()) / max(2 * int(numbered.sum()), 1)
    if mean > LARGEST_MEAN_CHI2 or numbered.mean() < LEAST_NUMBERED:
        return FitFailure(
            f"{int(numbered.sum())} of {len(lines)} stripes fit the sheets of one fan, missing "
            f"them by {np.sqrt(mean):.1f} sigma (rms)",
            "check the boards' poses, and that all stripes come from one source",
        )
    clear = CLEAR_CHI2 * max(1.0, mean)
    for other in found[1:]:
        both = (best.slot >= 0) & (other.slot >= 0)
        differs = both.any() and np.ptp((best.slot - other.slot)[both]) != 0
        if other.cost - best.cost < clear and differs:
            return _ambiguous(other.cost - best.cost)
    n_left_out = 0
    while True:
        alternatives = [_fit_fan(lines, slot, best.axis) for slot in _shifted_slots(lines, best)]
        nearest = min(alternatives, key=lambda fan: fan.fit_cost)
        margin = nearest.fit_cost - best.fit_cost
        if margin >= clear:
            return _Certain(lines, best, margin, n_left_out)
        moved = _moved_images(lines, best.slot, nearest.slot)
        if len(moved) != 1 or len(np.unique(lines.image[best.slot >= 0])) < 3:
            return _ambiguous(margin)
        n_left_out += 1
        kept = np.where(lines.image == moved[0], -1, best.slot)
        best = _fit_fan(lines, kept, best.axis)


def _ambiguous(margin: float) -> FitFailure:
    return FitFailure(
        "the placements share too few lines, or their boards are too parallel, to tell which "
        f"stripes show the same line (another numbering fits worse by chi2 {margin:.2g} only, need "
        f"{CLEAR_CHI2:.0f})",
        REMEDY,
    )


def _moved_images(lines: _Lines, slot: IntArray, moved: IntArray) -> list[int]:
    """The images that another numbering moves against most of the others."""
    numbered = slot >= 0
    images, first = np.unique(lines.image[numbered], return_index=True)
    difference = (moved - slot)[numbered][first].tolist()
    usual = max(set(difference), key=difference.count)
    return [int(image) for image, d in zip(images, difference, strict=True) if d != usual]


def _shifted_slots(lines: _Lines, fan: _Fan) -> Iterator[IntArray]:
    """Numberings in which some images are moved by whole sheets against the others.

    Single images, all images beyond one (by depth, along and across the stripes), and images in
    proportion to their place: what a wrong axis would do.
    """
    numbered = fan.slot >= 0
    images, row = np.unique(lines.image[numbered], return_inverse=True)
    middle = lines.ends[numbered].mean(axis=1)
    place = np.stack([middle[row == i].mean(axis=0) for i in range(len(images))])
    moves = [one for unit in np.eye(len(images), dtype=np.int64) for one in (-unit, unit)]
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
    for key in sorted(distinct - {(0,) * len(images)}):
        moved = fan.slot[numbered] + np.array(key)[row]
        slot = fan.slot.copy()
        slot[numbered] = moved - moved.min()
        yield slot
