# SPDX-License-Identifier: Apache-2.0
"""A rectangle of the sensor with its grid of coarse samples, eight pixels apart."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.simulation.render import COARSE_STEP_PX

Image32 = NDArray[np.float32]

MARGIN_PX = 2 * COARSE_STEP_PX


@dataclass(frozen=True, slots=True)
class Region:
    """Rectangle of full-sensor pixels whose sides are whole cells of the coarse grid."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    @staticmethod
    def around(x_px: int, y_px: int, width_px: int, height_px: int) -> Region:
        """Smallest region with a margin around a window: blur brings light in from there."""
        step = COARSE_STEP_PX
        x, y = (x_px - MARGIN_PX) // step * step, (y_px - MARGIN_PX) // step * step
        right, bottom = x_px + width_px + MARGIN_PX, y_px + height_px + MARGIN_PX
        return Region(x, y, -(-(right - x) // step) * step, -(-(bottom - y) // step) * step)

    def nodes_px(self) -> tuple[FloatArray, tuple[int, int]]:
        """(N, 2) full-sensor pixels of the coarse grid's nodes, and the grid's shape."""
        u = self.x_px + np.arange(0, self.width_px + 1, COARSE_STEP_PX)
        v = self.y_px + np.arange(0, self.height_px + 1, COARSE_STEP_PX)
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        return grid.astype(np.float64), (len(v), len(u))

    def pixels_px(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """(N, 2) full-sensor pixels of rows and columns of the region's image."""
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        return np.asarray(pixels + np.array([self.x_px, self.y_px]))


def between_nodes(nodes: Image32, step_px: int) -> Image32:
    """(step H, step W) pixels between nodes (H, W), each of which is the pixel of its block."""
    step = 1.0 / step_px
    pixels = cv2.warpAffine(
        nodes,
        np.array([[step, 0.0, 0.0], [0.0, step, 0.0]]),
        (step_px * nodes.shape[1], step_px * nodes.shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(pixels, dtype=np.float32)


def to_pixels(nodes: Image32, region: Region) -> Image32:
    """(H, W) values of a region's pixels between those of its coarse grid."""
    return between_nodes(nodes, COARSE_STEP_PX)[: region.height_px, : region.width_px]


def enlarged(cells: NDArray[np.uint8], step_px: int) -> NDArray[np.uint8]:
    """(step H, step W) pixels that bear the value of their cell (H, W)."""
    size = (step_px * cells.shape[1], step_px * cells.shape[0])
    return np.asarray(cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
