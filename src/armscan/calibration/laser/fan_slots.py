# SPDX-License-Identifier: Apache-2.0
"""Heights in a fan become numbers of sheets; and the numberings that could be mistaken for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.fan_fit import (
    Fan,
    Pencil,
    fit_fan,
    heights_in_pencil,
)
from armscan.calibration.laser.fan_lines import FanLines
from armscan.geometry.arrays import FloatArray, IntArray

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
