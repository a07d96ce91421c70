# SPDX-License-Identifier: Apache-2.0
"""The renderer's own kernel: distance from a body of melted limbs, and rays that walk up to it.

A limb is a row of `LIMB_COLUMNS` numbers: start (3), unit axis (3), length, radius at the start,
radius lost per length, tangent of the taper's half angle, blend length, 1 if hollow.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

LIMB_COLUMNS = 12
MAX_STEPS = 2000
"""A ray that has not met the body after so many steps counts as passing."""

CLOSE_MM = 0.2
"""Nearer than this the surface is taken for smooth: a ray may step further than its distance."""
LEAST_STRIDE_MM = 0.02
"""A ray that lies along the surface may cut under it by this much of its way, nanometres deep."""

_INPUT = types.Array(types.float64, 2, "C", readonly=True)
_RESULT = types.float64[::1]
_CROSSED_SIGNATURE = (
    "Tuple((int64, float64, float64))(Array(float64, 1, 'C', True), Array(float64, 2, 'C', True), "
    "Array(float64, 2, 'C', True), int64[::1])"
)


@njit(
    types.float64(types.float64, types.float64, types.float64, _INPUT, types.int64[::1]),
    cache=True,
)
def _distance(
    x: float, y: float, z: float, limbs: NDArray[np.float64], chosen: NDArray[np.int64]
) -> float:
    """Signed distance of one point from the chosen limbs, joined in order."""
    result = 1e30
    for k in chosen:
        vx, vy, vz = x - limbs[k, 0], y - limbs[k, 1], z - limbs[k, 2]
        along = vx * limbs[k, 3] + vy * limbs[k, 4] + vz * limbs[k, 5]
        across2 = max(vx * vx + vy * vy + vz * vz - along * along, 0.0)
        # The nearest ball of a tapered limb lies behind the foot of the perpendicular.
        centre = min(max(along - math.sqrt(across2) * limbs[k, 9], 0.0), limbs[k, 6])
        radius = limbs[k, 7] - limbs[k, 8] * centre
        other = math.sqrt(across2 + (along - centre) ** 2) - radius
        sign = 1.0
        if limbs[k, 11] > 0.0:
            sign = -1.0
        mine = sign * result
        overlap = limbs[k, 10] - abs(mine - other)
        joined = min(mine, other)
        if overlap > 0.0:
            joined -= overlap * overlap / (4.0 * limbs[k, 10])
        result = sign * joined
    return result


@njit(types.void(_INPUT, _INPUT, _RESULT), cache=True)
def distances(
    points: NDArray[np.float64], limbs: NDArray[np.float64], result: NDArray[np.float64]
) -> None:
    """Write the signed distances (N,) of points (N, 3), mm, from the body into ``result``."""
    every = np.arange(limbs.shape[0])
    for i in range(points.shape[0]):
        result[i] = _distance(points[i, 0], points[i, 1], points[i, 2], limbs, every)


@njit(_CROSSED_SIGNATURE, cache=True)
def _crossed(
    ray: NDArray[np.float64],
    limbs: NDArray[np.float64],
    balls: NDArray[np.float64],
    crossed: NDArray[np.int64],
) -> tuple[int, float, float]:
    """Write the limbs whose balls a ray crosses; count, first entry and last exit."""
    count, near, far = 0, np.inf, -np.inf
    for k in range(balls.shape[0]):
        vx, vy, vz = balls[k, 0] - ray[0], balls[k, 1] - ray[1], balls[k, 2] - ray[2]
        middle = vx * ray[3] + vy * ray[4] + vz * ray[5]
        half2 = balls[k, 3] ** 2 - (vx * vx + vy * vy + vz * vz - middle * middle)
        if half2 > 0.0:
            crossed[count] = k
            count += 1
            if limbs[k, 11] == 0.0:
                half = math.sqrt(half2)
                near, far = min(near, middle - half), max(far, middle + half)
    return count, near, far


@njit(types.float64(types.float64, types.float64), cache=True)
def _stride(gap: float, slope: float) -> float:
    """How far to go on from a gap that has shrunk by a part ``slope`` of the last stride."""
    if gap < 0.0:
        return gap / max(slope, 0.05)
    if gap > CLOSE_MM:
        return gap
    if slope > 0.3:
        return gap / min(slope, 1.0)
    return max(2.0 * gap, LEAST_STRIDE_MM)


@njit(types.void(_INPUT, _INPUT, _INPUT, types.float64, _RESULT), cache=True)
def march(
    rays: NDArray[np.float64],
    limbs: NDArray[np.float64],
    balls: NDArray[np.float64],
    tolerance: float,
    travelled: NDArray[np.float64],
) -> None:
    """Walk along rays until the body is ``tolerance`` near.

    ``rays`` (N, 6) are origins and unit directions; ``balls`` (K, 4), centre and radius, hold
    each limb and all that its blend reaches: a ray that misses a ball need not ask that limb.
    ``travelled`` (N,) receives the distance to the hit; infinite for none.
    """
    room = np.zeros(limbs.shape[0], np.int64)
    for i in range(rays.shape[0]):
        count, t, far = _crossed(rays[i], limbs, balls, room)
        crossed = room[:count]
        t = max(t, 0.0)
        travelled[i] = np.inf
        step, last_gap = 0.0, np.inf
        for _ in range(MAX_STEPS):
            if t > far:
                break
            x = rays[i, 0] + t * rays[i, 3]
            y = rays[i, 1] + t * rays[i, 4]
            z = rays[i, 2] + t * rays[i, 5]
            gap = _distance(x, y, z, limbs, crossed)
            slope = (last_gap - gap) / step if step != 0.0 else 0.0
            last_gap = gap
            if abs(gap) < tolerance or (gap < 0.0 and step == 0.0):
                travelled[i] = t + gap
                break
            step = _stride(gap, slope)
            t += step
