# SPDX-License-Identifier: Apache-2.0
"""Hessian of the smoothed image at candidates, with a Newton step to the ridge (eq. 2.41)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from armscan.kernels.arrays import (
    COLUMN,
    FLOATS_OUT,
    IMAGE_IN,
    ROW,
    TABLE_IN,
    TABLE_OUT,
    TAPS_IN,
    TAPS_OUT,
    Float32Array,
    Float64Array,
)

REACH_SIGMAS = 3.5
"""Taps cut at 3 sigma lock to pixels by 0.02 px, at 3.5 sigma by 0.003 px."""
STEEPNESS_SLACK = 0.85
REPEAT_PX = 1.5
ROUNDS = 3


def gaussian_taps(sigma_px: float) -> Float32Array:
    """Sampled Gaussian and its first two derivatives, (3, 2 r + 1) with r = 3.5 sigma.

    Scaled so that a constant, a ramp and a parabola give their exact derivatives.
    """
    radius = math.ceil(REACH_SIGMAS * sigma_px)
    k = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = np.exp(-0.5 * (k / sigma_px) ** 2)
    smooth /= smooth.sum()
    slope = k * smooth
    slope /= (k * slope).sum()
    bend = (k * k - (k * k * smooth).sum()) * smooth
    bend /= 0.5 * (k * k * bend).sum()
    return np.stack([smooth, slope, bend]).astype(np.float32)


@njit(
    types.void(IMAGE_IN, types.int64, types.int64, TAPS_IN, TAPS_OUT, FLOATS_OUT),
    cache=True,
    nogil=True,
    fastmath=True,
)
def derivatives_at(
    image: Float32Array,
    x: int,
    y: int,
    taps: Float32Array,
    columns: Float32Array,
    result: Float64Array,
) -> None:
    """Smoothed derivatives at one pixel; beyond the border the image is continued constantly.

    Parameters
    ----------
    image
        (H, W) grey levels.
    x, y
        Pixel.
    taps
        (3, m) from `gaussian_taps`.
    columns
        (3, m) scratch.
    result
        (5,) output: d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2.
    """
    height, width = image.shape
    m = taps.shape[1]
    radius = m // 2
    left = x - radius
    is_inside = left >= 0 and left + m <= width
    # views, because an index that might be negative keeps the loops from being vectorised
    down0, down1, down2 = columns[0], columns[1], columns[2]
    taps0, taps1, taps2 = taps[0], taps[1], taps[2]
    down0[:] = np.float32(0.0)
    down1[:] = np.float32(0.0)
    down2[:] = np.float32(0.0)
    for j in range(m):
        row = min(max(y + j - radius, 0), height - 1)
        smooth = taps0[j]
        slope = taps1[j]
        bend = taps2[j]
        if is_inside:
            pixels = image[row, left : left + m]
            for i in range(m):
                value = pixels[i]
                down0[i] += smooth * value
                down1[i] += slope * value
                down2[i] += bend * value
        else:
            for i in range(m):
                value = image[row, min(max(left + i, 0), width - 1)]
                down0[i] += smooth * value
                down1[i] += slope * value
                down2[i] += bend * value
    gx = gy = gxx = gxy = gyy = np.float32(0.0)
    for i in range(m):
        gx += taps1[i] * down0[i]
        gxx += taps2[i] * down0[i]
        gxy += taps1[i] * down1[i]
        gy += taps0[i] * down1[i]
        gyy += taps0[i] * down2[i]
    result[0] = gx
    result[1] = gy
    result[2] = gxx
    result[3] = gxy
    result[4] = gyy


@njit(
    types.boolean(
        IMAGE_IN, types.float64, types.float64, TAPS_IN, TAPS_OUT, FLOATS_OUT, FLOATS_OUT
    ),
    cache=True,
    nogil=True,
)
def step_to_ridge(
    image: Float32Array,
    x_px: float,
    y_px: float,
    taps: Float32Array,
    scratch: Float32Array,
    derivatives: Float64Array,
    result: Float64Array,
) -> bool:
    """Walk from a start to the nearest ridge; False if there is none.

    The eigenvector of the eigenvalue of largest curvature is the normal ``n``; along it the Taylor
    polynomial has its maximum at ``t = -(g . n) / (n' H n)``. The expansion point is moved while
    the step leaves its pixel.

    Parameters
    ----------
    image, taps, scratch
        As for `derivatives_at`.
    x_px, y_px
        Start.
    derivatives
        (5,) scratch.
    result
        (5,) output: x, y, normal x, normal y, negative second derivative along the normal.
    """
    height, width = image.shape
    x = math.floor(x_px + 0.5)
    y = math.floor(y_px + 0.5)
    for _ in range(ROUNDS):
        if x < 0 or y < 0 or x >= width or y >= height:
            return False
        derivatives_at(image, x, y, taps, scratch, derivatives)
        half = 0.5 * (derivatives[2] - derivatives[4])
        gxy = derivatives[3]
        root = math.sqrt(half * half + gxy * gxy)
        bend = 0.5 * (derivatives[2] + derivatives[4]) - root
        if bend >= 0.0 or root <= 0.0:
            return False
        nx = root - half if half < 0.0 else -gxy
        ny = -gxy if half < 0.0 else root + half
        length = math.sqrt(nx * nx + ny * ny)
        nx /= length
        ny /= length
        step = -(derivatives[0] * nx + derivatives[1] * ny) / bend
        dx = step * nx
        dy = step * ny
        if abs(dx) <= 0.6 and abs(dy) <= 0.6:
            result[0] = x + dx
            result[1] = y + dy
            result[2] = nx
            result[3] = ny
            result[4] = -bend
            return True
        if abs(step) > taps.shape[1] // 2:
            return False
        x += math.floor(dx + 0.5)
        y += math.floor(dy + 0.5)
    return False


@njit(
    types.int64(IMAGE_IN, TABLE_IN, types.int64, TAPS_IN, types.float64, TABLE_OUT),
    cache=True,
    nogil=True,
)
def refine_candidates(
    image: Float32Array,
    runs: Float64Array,
    n_runs: int,
    taps: Float32Array,
    least_bend: float,
    points: Float64Array,
) -> int:
    """Ridge point in the column or row of each candidate.

    A column candidate is kept where the line is rather horizontal, a row candidate where it is
    rather vertical, with some overlap around the diagonal so that none is lost there.

    Parameters
    ----------
    image
        (H, W) grey levels.
    runs
        (>= n_runs, 3) from `find_runs`.
    n_runs
        Candidates to use.
    taps
        (3, m) from `gaussian_taps`.
    least_bend
        Smallest negative second derivative across the line.
    points
        (>= n_runs, 6) output rows: x, y, normal x, normal y, negative second derivative, axis.
        The coordinate along the axis 0 (column) or 1 (row) that names the pixel line is whole.

    Returns
    -------
    int
        Count of points.
    """
    height, width = image.shape
    scratch = np.zeros((3, taps.shape[1]), np.float32)
    derivatives = np.zeros(5)
    ridge = np.zeros(5)
    latest = np.full((2, max(height, width)), -1e9)
    count = 0
    for r in range(n_runs):
        is_row = runs[r, 2] == ROW
        if not step_to_ridge(image, runs[r, 0], runs[r, 1], taps, scratch, derivatives, ridge):
            continue
        if ridge[4] < least_bend:
            continue
        nx = abs(ridge[2])
        ny = abs(ridge[3])
        if (nx if is_row else ny) < STEEPNESS_SLACK * (ny if is_row else nx):
            continue
        if is_row:
            line = int(runs[r, 1])
            centre = ridge[0] - (line - ridge[1]) * ridge[3] / ridge[2]
        else:
            line = int(runs[r, 0])
            centre = ridge[1] - (line - ridge[0]) * ridge[2] / ridge[3]
        side = ROW if is_row else COLUMN
        if abs(centre - latest[side, line]) < REPEAT_PX:
            continue
        if centre < 0.0 or centre > (width if is_row else height) - 1:
            continue
        latest[side, line] = centre
        points[count, 0] = centre if is_row else line
        points[count, 1] = line if is_row else centre
        points[count, 2] = ridge[2]
        points[count, 3] = ridge[3]
        points[count, 4] = ridge[4]
        points[count, 5] = side
        count += 1
    return count
