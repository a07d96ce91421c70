# SPDX-License-Identifier: Apache-2.0
"""Lines of one source named over images that each show only some of them.

All stripes meet the axis of the fan (`armscan.calibration.laser.fan_fit`), which is found without
names; their heights in the fan then fall into classes, one a sheet. The numbering stands if every
other one, with images moved against each other by whole sheets, fits much worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.coplanarity import PosedSighting
from armscan.calibration.laser.fan_fit import fit_pencil
from armscan.calibration.laser.fan_lines import FanLines, gather_lines
from armscan.calibration.laser.fan_slots import (
    Numbering,
    best_numberings,
    contradicts,
    numbering_of,
    shifted_slots,
    spacing_of,
)
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

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
class FanNames:
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


def name_fan(
    posed: Sequence[Sequence[PosedSighting]], boards: Sequence[int], n_sheets: int = 0
) -> FanNames | FitFailure:
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
    FanNames or FitFailure
        A failure where the placements leave open which stripes belong together: nothing is
        guessed.
    """
    if len({board for board, stripes in zip(boards, posed, strict=True) if stripes}) < 2:
        return FitFailure("fewer than two board placements show a stripe", REMEDY)
    lines = gather_lines(posed)
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
    posed: Sequence[Sequence[PosedSighting]], boards: Sequence[int], sure: _Sure, n_sheets: int
) -> FanNames | FitFailure:
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
    return FanNames(tuple(numbers), tuple(tuple(row) for row in sheets), how, tuple(warnings))


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
