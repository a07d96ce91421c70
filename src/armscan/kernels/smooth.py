# SPDX-License-Identifier: Apache-2.0
"""Local quadratic along the line, with the widest window that the line's course allows."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import Floats, FloatsOut, Ints, Table, TableOut, compiled

SHIFT, SLOPE, BEND, BEND_SIGMA, SIGMA, WINDOW, PREDICTED, PREDICTED_SIGMA = range(8)
"""Columns of a smoothing result."""
LEAST_POINTS = 5
LEAST_COSINE = 0.6
COUNT = 8
"""Place of the count of points among the moments."""


@compiled()
def solve_quadratic(moments: Floats, solved: FloatsOut) -> bool:
    """Fit a weighted parabola; False if it is not determined.

    ``moments``: (9,) sums of w, w s, w s^2, w s^3, w s^4, w d, w s d, w s^2 d, and the count of
    points. ``solved``: (5,) output: value, slope and second derivative at 0, then the variances of
    the value and of the second derivative.
    """
    s0, s1, s2, s3, s4 = moments[0], moments[1], moments[2], moments[3], moments[4]
    c00 = s2 * s4 - s3 * s3
    c01 = s2 * s3 - s1 * s4
    c02 = s1 * s3 - s2 * s2
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    if not determinant > 1e-9 * s0 * s2 * s4:
        return False
    c11 = s0 * s4 - s2 * s2
    c12 = s1 * s2 - s0 * s3
    value = (c00 * moments[5] + c01 * moments[6] + c02 * moments[7]) / determinant
    slope = (c01 * moments[5] + c11 * moments[6] + c12 * moments[7]) / determinant
    c22 = s0 * s2 - s1 * s1
    solved[0] = value
    solved[1] = slope
    solved[2] = 2.0 * (c02 * moments[5] + c12 * moments[6] + c22 * moments[7]) / determinant
    solved[3] = c00 / determinant
    solved[4] = 4.0 * c22 / determinant
    return True


@compiled()
def gather(
    points: Table,
    normals: Table,
    sigma_px: Floats,
    is_used: Ints,
    chain: Ints,
    i: int,
    j: int,
    direction: int,
    reach: float,
    moments: FloatsOut,
) -> int:
    """Add the neighbours of point ``i`` from place ``j`` on to the moments; return where it ended.

    Neighbours are taken in the tangent frame of point ``i`` while they lie on its chain, within
    ``reach`` along the tangent and not turned by more than about 50 degrees.
    """
    nx = normals[i, 0]
    ny = normals[i, 1]
    while 0 <= j < points.shape[0] and chain[j] == chain[i]:
        dx = points[j, 0] - points[i, 0]
        dy = points[j, 1] - points[i, 1]
        s = dy * nx - dx * ny
        if abs(s) > reach or abs(normals[j, 0] * nx + normals[j, 1] * ny) < LEAST_COSINE:
            break
        if is_used[j] != 0:
            d = dx * nx + dy * ny
            w = 1.0 / (sigma_px[j] * sigma_px[j])
            moments[0] += w
            moments[1] += w * s
            moments[2] += w * s * s
            moments[3] += w * s * s * s
            moments[4] += w * s * s * s * s
            moments[5] += w * d
            moments[6] += w * s * d
            moments[7] += w * s * s * d
            moments[COUNT] += 1.0
        j += direction
    return j


@compiled()
def smooth_chains(
    points: Table,
    normals: Table,
    sigma_px: Floats,
    is_used: Ints,
    chain: Ints,
    windows_px: Floats,
    inflation: Floats,
    confidence: float,
    result: TableOut,
) -> None:
    """Smooth every point along its chain by a local quadratic in its own tangent frame.

    Windows grow while their estimates agree within the noise (intersection of confidence
    intervals): a bend stops the growth before its bias exceeds the noise.

    ``points``, ``normals``: (N, 2) centres and unit normals, ordered along the chains.
    ``sigma_px``: (N,) standard deviation along the normal. ``is_used``: (N,) 0 for points that must
    not pull their neighbours. ``chain``: (N,) chain number of each point; a chain is consecutive.
    ``windows_px``: (K,) half widths along the tangent, increasing. ``inflation``: (K,) factor on
    the variance of each window because neighbours' noise is correlated. ``confidence``: Half width
    of the confidence intervals in sigmas. ``result``: (N, 8) output: shift along the normal, slope
    of the line against the tangent, its second derivative (curvature) and that one's sigma, sigma
    of the shift, half window (0: not smoothed), prediction of the point's shift by its neighbours
    alone, and that prediction's sigma (0: there is none).
    """
    n = points.shape[0]
    moments = np.zeros(9)
    others = np.zeros(9)
    solved = np.zeros(5)
    for i in range(n):
        moments[:] = 0.0
        own = 1.0 / (sigma_px[i] * sigma_px[i])
        if is_used[i] != 0:
            moments[0] = own
            moments[COUNT] = 1.0
        for k in range(result.shape[1]):
            result[i, k] = 0.0
        result[i, SIGMA] = sigma_px[i]
        lower = -1e9
        upper = 1e9
        down = i - 1
        up = i + 1
        for k in range(windows_px.shape[0]):
            reach = windows_px[k]
            down = gather(points, normals, sigma_px, is_used, chain, i, down, -1, reach, moments)
            up = gather(points, normals, sigma_px, is_used, chain, i, up, 1, reach, moments)
            if moments[COUNT] < LEAST_POINTS:
                continue
            if not solve_quadratic(moments, solved):
                continue
            value = solved[0]
            sigma = math.sqrt(solved[3] * inflation[k])
            lower = max(lower, value - confidence * sigma)
            upper = min(upper, value + confidence * sigma)
            if lower > upper:
                break
            result[i, SHIFT] = value
            result[i, SLOPE] = solved[1]
            result[i, BEND] = solved[2]
            result[i, BEND_SIGMA] = math.sqrt(solved[4] * inflation[k])
            result[i, SIGMA] = sigma
            result[i, WINDOW] = reach
            others[:] = moments
            if is_used[i] != 0:
                others[0] -= own
            if solve_quadratic(others, solved):
                result[i, PREDICTED] = solved[0]
                result[i, PREDICTED_SIGMA] = math.sqrt(solved[3] * inflation[k])
