# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the renderer: discs of a print, and the detector's grey levels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

_TABLE = types.Array(types.float64, 2, "C", readonly=True)
_FLOATS = types.Array(types.float64, 1, "C", readonly=True)
_IMAGE = types.Array(types.float32, 2, "C", readonly=True)
_IMAGE_OUT = types.Array(types.float32, 2, "C")
_BYTES = types.Array(types.uint8, 2, "C", readonly=True)
_F32 = types.float32

SUBPIXELS = 2
SAMPLES = 8


@njit(types.void(_IMAGE_OUT, _IMAGE, _F32, _F32, _F32), cache=True)
def expose(
    light: NDArray[np.float32],
    noise: NDArray[np.float32],
    per_electron: float,
    read_square: float,
    full_scale: float,
) -> None:
    """Turn light (H, W), parts of full scale, into grey levels, in place.

    ``noise`` (H, W) is standard normal; shot noise has a variance of ``per_electron`` a level of an
    8-bit image, the rest of ``read_square``.
    """
    level = np.float32(255.0)
    gain = np.float32(full_scale / level)
    for v in range(light.shape[0]):
        for u in range(light.shape[1]):
            grey = light[v, u] * level
            sigma = math.sqrt(max(grey, np.float32(0.0)) * per_electron + read_square)
            found = np.rint((grey + sigma * noise[v, u]) * gain)
            light[v, u] = min(max(found, np.float32(0.0)), full_scale)


@njit(
    types.Tuple((types.float64, types.float64))(  # type: ignore[no-untyped-call]
        types.float64, types.float64, _FLOATS, _TABLE, _TABLE, _TABLE
    ),
    cache=True,
)
def _on_board(
    u: float,
    v: float,
    lens: NDArray[np.float64],
    knots_x: NDArray[np.float64],
    knots_y: NDArray[np.float64],
    board_from_ray: NDArray[np.float64],
) -> tuple[float, float]:
    """Place on the board that one pixel sees.

    Its ray is interpolated between knots and improved by one step of the fixed-point search.
    """
    step = lens[9]
    column, row = (u - lens[10]) / step, (v - lens[11]) / step
    i = min(max(int(row), 0), knots_x.shape[0] - 2)
    j = min(max(int(column), 0), knots_x.shape[1] - 2)
    a, b = column - j, row - i
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    x = w00 * knots_x[i, j] + w01 * knots_x[i, j + 1]
    x += w10 * knots_x[i + 1, j] + w11 * knots_x[i + 1, j + 1]
    y = w00 * knots_y[i, j] + w01 * knots_y[i, j + 1]
    y += w10 * knots_y[i + 1, j] + w11 * knots_y[i + 1, j + 1]
    square = x * x + y * y
    gain = 1.0 + square * (lens[4] + square * (lens[5] + square * lens[8]))
    lever = 2.0 * (lens[6] * y + lens[7] * x)
    rx = ((u - lens[2]) / lens[0] - x * lever - lens[7] * square) / gain
    ry = ((v - lens[3]) / lens[1] - y * lever - lens[6] * square) / gain
    h = board_from_ray
    scale = 1.0 / max(h[2, 0] * rx + h[2, 1] * ry + h[2, 2], 1e-9)
    return (
        (h[0, 0] * rx + h[0, 1] * ry + h[0, 2]) * scale,
        (h[1, 0] * rx + h[1, 1] * ry + h[1, 2]) * scale,
    )


@njit(
    types.void(_FLOATS, types.int64, types.int64, _FLOATS, _TABLE, _TABLE, _TABLE, _IMAGE_OUT),
    cache=True,
)
def disc_cells(
    disc: NDArray[np.float64],
    left: int,
    top: int,
    lens: NDArray[np.float64],
    knots_x: NDArray[np.float64],
    knots_y: NDArray[np.float64],
    board_from_ray: NDArray[np.float64],
    cells: NDArray[np.float32],
) -> None:
    """Part of each fine cell of a tile that a disc of a print covers.

    Parameters
    ----------
    disc
        (3,) centre and radius on the board, mm.
    left, top
        The tile's first pixel.
    lens
        (12,) fx, fy, cx, cy, k1, k2, p1, p2, k3, then the knots' step and their first column and
        row, px.
    knots_x, knots_y
        (K, L) rays of the knots.
    board_from_ray
        (3, 3) place on the board, homogeneous, of a ray.
    cells
        (2 H, 2 W) of a tile of H by W pixels; filled here from 64 samples each, the pixel's place
        on the board taken for linear.
    """
    height, width = cells.shape[0] // SUBPIXELS, cells.shape[1] // SUBPIXELS
    x, y = np.zeros((height + 2, width + 2)), np.zeros((height + 2, width + 2))
    for i in range(height + 2):
        for j in range(width + 2):
            px, py = float(left + j - 1), float(top + i - 1)
            x[i, j], y[i, j] = _on_board(px, py, lens, knots_x, knots_y, board_from_ray)
    n = SUBPIXELS * SAMPLES
    share = np.float32(1.0 / SAMPLES**2)
    square = disc[2] * disc[2]
    for i in range(height):
        for j in range(width):
            cx, cy = x[i + 1, j + 1] - disc[0], y[i + 1, j + 1] - disc[1]
            ux, uy = 0.5 * (x[i + 1, j + 2] - x[i + 1, j]), 0.5 * (y[i + 1, j + 2] - y[i + 1, j])
            vx, vy = 0.5 * (x[i + 2, j + 1] - x[i, j + 1]), 0.5 * (y[i + 2, j + 1] - y[i, j + 1])
            reach = 0.55 * (math.sqrt(ux * ux + uy * uy) + math.sqrt(vx * vx + vy * vy))
            away = math.sqrt(cx * cx + cy * cy) - disc[2]
            if abs(away) > reach:
                whole = np.float32(1.0) if away < 0.0 else np.float32(0.0)
                for b in range(SUBPIXELS):
                    for a in range(SUBPIXELS):
                        cells[SUBPIXELS * i + b, SUBPIXELS * j + a] = whole
                continue
            for b in range(SUBPIXELS):
                for a in range(SUBPIXELS):
                    count = 0
                    for q in range(SAMPLES):
                        down = (b * SAMPLES + q + 0.5) / n - 0.5
                        qx, qy = cx + down * vx, cy + down * vy
                        for p in range(SAMPLES):
                            along = (a * SAMPLES + p + 0.5) / n - 0.5
                            sx, sy = qx + along * ux, qy + along * uy
                            count += sx * sx + sy * sy < square
                    cells[SUBPIXELS * i + b, SUBPIXELS * j + a] = share * np.float32(count)


@njit(types.void(_BYTES, _BYTES, _FLOATS, _IMAGE_OUT), cache=True)
def blur_where(
    mask: NDArray[np.uint8],
    wanted: NDArray[np.uint8],
    kernel: NDArray[np.float64],
    blurred: NDArray[np.float32],
) -> None:
    """Write a mask (H, W), 255 for 1, and where it is wanted its blur; borders repeat."""
    height, width = mask.shape
    reach = len(kernel) // 2
    for v in range(height):
        for u in range(width):
            if not wanted[v, u]:
                blurred[v, u] = np.float32(mask[v, u] * (1.0 / 255.0))
                continue
            total = 0.0
            for b in range(-reach, reach + 1):
                row = min(max(v + b, 0), height - 1)
                along = 0.0
                for a in range(-reach, reach + 1):
                    along += kernel[a + reach] * mask[row, min(max(u + a, 0), width - 1)]
                total += kernel[b + reach] * along
            blurred[v, u] = np.float32(total / 255.0)


@njit(types.void(_IMAGE_OUT, _IMAGE, _IMAGE, _IMAGE, _F32, _F32), cache=True)
def lay_over(
    below: NDArray[np.float32],
    tone: NDArray[np.float32],
    lamp: NDArray[np.float32],
    cover: NDArray[np.float32],
    dark: float,
    light: float,
) -> None:
    """Lay a lit print over an image (H, W), in place.

    ``tone`` is its part of the light tone, ``lamp`` the light on it, ``cover`` how much of a pixel
    it covers.
    """
    for v in range(below.shape[0]):
        for u in range(below.shape[1]):
            lit = (dark + (light - dark) * tone[v, u]) * lamp[v, u]
            below[v, u] = cover[v, u] * lit + (np.float32(1.0) - cover[v, u]) * below[v, u]
