# SPDX-License-Identifier: Apache-2.0
"""The parts of a region that a light may reach: upright strips, each cut to the rows it needs.

A strip is worked on alone with a margin of one coarse cell, of which nothing is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.laser_source import TracedLight
from armscan.simulation.region import Image32, Region, between_nodes, enlarged
from armscan.simulation.render import BAND_SIGMAS, COARSE_STEP_PX, cells_near_sheet
from armscan.simulation.scene import FAINTEST, Hits

STRIDE_PX = 2
FAR_SIGMAS = 9.0
_STRIP_CELLS = 24
_SLACK_SIGMAS = 0.6
"""Half a pixel across the line, and what interpolation on the coarse grid may be wrong by."""
_EDGE_SIGMAS = 1.5
"""Neighbouring pixels whose reach differs by more lie on two sides of an edge."""
_EDGE_SHARE = 0.25
_BEND_SIGMAS = 0.01
"""Second difference above which every pixel is traced: an eighth of it is lost between."""
_BRIGHT_SIGMAS = 4.5
_SQUARE = np.ones((3, 3), np.uint8)

Item = TypeVar("Item", np.float32, np.int32, np.bool_)


@dataclass(slots=True, eq=False)
class Strip:
    """One strip while it is worked on.

    Parameters
    ----------
    region
        Its rectangle of the sensor, margin included.
    place, inner
        Rows and columns of the whole region that are kept, and the same within the strip.
    reach, peak
        (H, W) distance from the sheet's centre in sigmas, and light were it zero.
    is_lit
        (H, W) pixels that the light may reach.
    is_rough
        (H, W) pixels that must be traced themselves; known after `interpolate`.
    """

    region: Region
    place: tuple[slice, slice]
    inner: tuple[slice, slice]
    reach: Image32
    is_lit: BoolArray
    peak: Image32 = field(init=False)
    is_rough: BoolArray = field(init=False)
    _near: BoolArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.peak = np.zeros_like(self.reach)
        self.is_rough = np.zeros_like(self.is_lit)
        self._near = cv2.dilate(self.is_lit.astype(np.uint8), _SQUARE) > 0

    def near_nodes(self, rim_px: int) -> tuple[IntArray, ...]:
        """Rows and columns of the nodes, `STRIDE_PX` apart, that are to be traced."""
        square = np.ones((2 * rim_px + 1, 2 * rim_px + 1), np.uint8)
        near = cv2.dilate(self.is_lit.astype(np.uint8), square)
        return np.nonzero(near[::STRIDE_PX, ::STRIDE_PX])

    def interpolate(self, nodes: tuple[IntArray, ...], reach: FloatArray, peak: FloatArray) -> None:
        """Fill the strip between traced nodes, and tell where that will not do."""
        coarse_reach = np.ascontiguousarray(self.reach[::STRIDE_PX, ::STRIDE_PX])
        coarse_peak = np.zeros_like(coarse_reach)
        coarse_reach[nodes], coarse_peak[nodes] = reach, peak
        rough = _jumps(coarse_reach, coarse_peak, STRIDE_PX) | _bends(coarse_reach)
        is_rough = enlarged(rough.astype(np.uint8), STRIDE_PX)
        self.reach[:] = between_nodes(coarse_reach, STRIDE_PX)
        self.peak[:] = between_nodes(coarse_peak, STRIDE_PX)
        self.is_rough = (cv2.dilate(is_rough, _SQUARE) > 0) & self._near

    def edges(self) -> tuple[IntArray, ...]:
        """Rows and columns of the kept pixels at edges."""
        inside = cv2.erode(self.is_lit.astype(np.uint8), _SQUARE) > 0
        found = _jumps(self.reach, self.peak, 1) & inside
        rows, columns = np.nonzero(found[self.inner])
        return rows + self.inner[0].start, columns + self.inner[1].start

    def put(self, image: NDArray[Item], mine: NDArray[Item]) -> None:
        """Copy what is kept of an array of the strip into one of the whole region."""
        image[self.place] = mine[self.inner]


def cut_strips(nodes: Hits, light: TracedLight, region: Region) -> list[Strip]:
    """Strips of the pixels that a light may reach.

    Where the coarse grid meets one surface smoothly, the reach is interpolated to tell; elsewhere
    all pixels of cells next to the sheet are taken.
    """
    _, shape = region.nodes_px()
    reach, rank = np.full(len(nodes.surface), np.nan), np.zeros(len(nodes.surface))
    is_hit = nodes.surface >= 0
    reach[is_hit], rank[is_hit] = light.reach_and_rank(nodes.points_mm[is_hit])
    cells = cells_near_sheet(reach.reshape(shape), rank.reshape(shape))
    coarse = np.where(is_hit, reach, 0.0).reshape(shape).astype(np.float32)
    rough = _rough_cells(coarse, nodes.surface.reshape(shape))
    strips = []
    for left in range(0, cells.shape[1], _STRIP_CELLS):
        columns = slice(left, min(left + _STRIP_CELLS, cells.shape[1]))
        used = np.flatnonzero(cells[:, columns].any(axis=1))
        if len(used):
            kept = slice(int(used[0]), int(used[-1]) + 1), columns
            strips.append(_strip(region, kept, coarse, cells, rough))
    return strips


def _strip(
    region: Region,
    kept: tuple[slice, slice],
    coarse: Image32,
    cells: BoolArray,
    rough: BoolArray,
) -> Strip:
    step = COARSE_STEP_PX
    # The light's rim is interpolated too: keep a cell around it, and work on one more.
    rows = _wider(kept[0], 1, cells.shape[0])
    worked = _wider(rows, 1, cells.shape[0]), _wider(kept[1], 1, cells.shape[1])
    (top, bottom), (left, right) = ((part.start, part.stop) for part in worked)
    between = between_nodes(coarse[top : bottom + 1, left : right + 1], step)[:-step, :-step]
    is_lit = np.abs(between) < BAND_SIGMAS + _SLACK_SIGMAS
    is_lit |= enlarged(rough[worked].astype(np.uint8), step) > 0
    is_lit &= enlarged(cells[worked].astype(np.uint8), step) > 0
    part = Region(
        region.x_px + step * left,
        region.y_px + step * top,
        step * (right - left),
        step * (bottom - top),
    )
    return Strip(
        part,
        _pixels((rows, kept[1]), 0, 0),
        _pixels((rows, kept[1]), top, left),
        # Outside, the sign of the reach still matters: it is interpolated across the band's rim.
        np.clip(between, -FAR_SIGMAS, FAR_SIGMAS),
        is_lit,
    )


def _wider(part: slice, by: int, count: int) -> slice:
    return slice(max(part.start - by, 0), min(part.stop + by, count))


def _pixels(cells: tuple[slice, slice], top: int, left: int) -> tuple[slice, slice]:
    """Pixels of cells, counted from a first cell."""
    rows, columns = cells
    step = COARSE_STEP_PX
    return (
        slice(step * (rows.start - top), step * (rows.stop - top)),
        slice(step * (columns.start - left), step * (columns.stop - left)),
    )


def _rough_cells(reach: Image32, surface: IntArray) -> BoolArray:
    """(H, W) cells whose corners or neighbours differ in surface, or bend in reach."""
    marks = (surface + 1).astype(np.float32)
    differs = cv2.dilate(marks, _SQUARE) != cv2.erode(marks, _SQUARE)
    bends = np.abs(cv2.Laplacian(reach, cv2.CV_32F)) > _SLACK_SIGMAS
    rough = cv2.dilate((differs | bends | (surface < 0)).astype(np.uint8), _SQUARE)
    return np.asarray(rough[:-1, :-1] > 0)


def _jumps(reach: Image32, peak: Image32, stride_px: int) -> BoolArray:
    """Samples (H, W) around which something jumps: an edge, a shadow, another surface."""
    spread = cv2.dilate(reach, _SQUARE) - cv2.erode(reach, _SQUARE)
    high = cv2.dilate(peak, _SQUARE)
    jump = high - cv2.erode(peak, _SQUARE)
    # A sample that misses the light itself may have a neighbour that does not.
    is_reached = (cv2.erode(np.abs(reach), _SQUARE) < BAND_SIGMAS) & (high > FAINTEST)
    is_rough = (spread > stride_px * _EDGE_SIGMAS) | (jump > _EDGE_SHARE * high)
    return np.asarray(is_rough & is_reached)


def _bends(reach: Image32) -> BoolArray:
    """Samples (H, W) near the light where a straight line between neighbours is not enough."""
    along = cv2.filter2D(reach, cv2.CV_32F, np.array([[1.0, -2.0, 1.0]]))
    across = cv2.filter2D(reach, cv2.CV_32F, np.array([[1.0], [-2.0], [1.0]]))
    bent = np.maximum(np.abs(along), np.abs(across)) > _BEND_SIGMAS
    return np.asarray(bent & (np.abs(reach) < _BRIGHT_SIGMAS))
