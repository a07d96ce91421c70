# SPDX-License-Identifier: Apache-2.0
"""Free-form bodies blended from metaball limbs, and the compiled ray march that meets them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.poses import Part, Pose, Sensor
from armscan.simulation.kernels import Three, compiled
from armscan.simulation.optics.scene import OneColour

MAX_STEPS = 2000
"""A ray that has not met the body after so many steps counts as passing."""

CLOSE_MM = 0.2
"""Nearer than this the surface is taken for smooth: a ray may step further than its distance."""
LEAST_STRIDE_MM = 0.02
"""A ray that lies along the surface may cut under it by this much of its way, nanometres deep."""

_INPUT = types.Array(types.float64, 2, "C", readonly=True)
_RESULT = types.float64[::1]
_CROSSED_SIGNATURE = (
    "Tuple((int64, float64, float64))(UniTuple(float64, 3), UniTuple(float64, 3), "
    "Array(float64, 2, 'C', True), Array(float64, 2, 'C', True), int64[::1])"
)


@njit(
    types.float64(types.float64, types.float64, types.float64, _INPUT, types.int64[::1]),
    cache=True,
)
def distance(
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
        result[i] = distance(points[i, 0], points[i, 1], points[i, 2], limbs, every)


@njit(_CROSSED_SIGNATURE, cache=True)
def _crossed(
    start: Three,
    ray: Three,
    limbs: NDArray[np.float64],
    balls: NDArray[np.float64],
    crossed: NDArray[np.int64],
) -> tuple[int, float, float]:
    """Write the limbs whose balls a ray crosses; count, first entry and last exit."""
    count, near, far = 0, np.inf, -np.inf
    for k in range(balls.shape[0]):
        vx, vy, vz = balls[k, 0] - start[0], balls[k, 1] - start[1], balls[k, 2] - start[2]
        middle = vx * ray[0] + vy * ray[1] + vz * ray[2]
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


@njit(
    "float64(UniTuple(float64, 3), UniTuple(float64, 3), Array(float64, 2, 'C', True), "
    "Array(float64, 2, 'C', True), float64, int64[::1])",
    cache=True,
)
def marched(
    start: Three,
    ray: Three,
    limbs: NDArray[np.float64],
    balls: NDArray[np.float64],
    tolerance: float,
    room: NDArray[np.int64],
) -> float:
    """Distance along a ray, from a start in a unit direction, to the body; infinite for none.

    ``balls`` (K, 4), centre and radius, hold each limb and all that its blend reaches: a ray that
    misses a ball need not ask that limb. ``room`` (K,) or more is written over.
    """
    count, t, far = _crossed(start, ray, limbs, balls, room)
    crossed = room[:count]
    t = max(t, 0.0)
    step, last_gap = 0.0, np.inf
    for _ in range(MAX_STEPS):
        if t > far:
            break
        x, y, z = start[0] + t * ray[0], start[1] + t * ray[1], start[2] + t * ray[2]
        gap = distance(x, y, z, limbs, crossed)
        slope = (last_gap - gap) / step if step != 0.0 else 0.0
        last_gap = gap
        if abs(gap) < tolerance or (gap < 0.0 and step == 0.0):
            return float(t + gap)
        step = _stride(gap, slope)
        t += step
    return np.inf


@compiled
def march(
    rays: NDArray[np.float64],
    limbs: NDArray[np.float64],
    balls: NDArray[np.float64],
    tolerance: float,
    travelled: NDArray[np.float64],
) -> None:
    """Walk along rays (N, 6) until the body is ``tolerance`` near; see `marched`."""
    room = np.zeros(limbs.shape[0], np.int64)
    for i in range(rays.shape[0]):
        start, ray = (rays[i, 0], rays[i, 1], rays[i, 2]), (rays[i, 3], rays[i, 4], rays[i, 5])
        travelled[i] = marched(start, ray, limbs, balls, tolerance, room)


HIT_MM = 1e-5
BLEND_REACH = 1.5
"""Beyond this many blends from a limb, no surface is changed by it: a blend adds a quarter of its
length, and may meet a limb that is already melted with others."""
GRADIENT_STEP_MM = 1e-4


@dataclass(frozen=True, slots=True)
class MetaballLimb:
    """A rounded cone between two balls, centres in the Part frame; taken away if it is hollow.

    Over ``blend_mm`` it melts into those named before it; 0 gives a sharp edge.
    """

    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    start_radius_mm: float
    end_radius_mm: float
    blend_mm: float = 0.0
    is_hollow: bool = False

    def __post_init__(self) -> None:
        if min(self.start_radius_mm, self.end_radius_mm) <= 0.0 or self.blend_mm < 0.0:
            raise InputError("a limb needs positive radii and a blend that is not negative")
        change = abs(self.start_radius_mm - self.end_radius_mm)
        if change > 0.0 and change >= self._length_mm:
            raise InputError("one ball of a limb swallows the other", remedy="use one ball")

    @property
    def row(self) -> FloatArray:
        """(12,) numbers for the kernel; see `armscan.simulation.objects.body`."""
        length = self._length_mm
        axis = np.subtract(self.end_mm, self.start_mm) / length if length > 0.0 else np.zeros(3)
        lost = (self.start_radius_mm - self.end_radius_mm) / length if length > 0.0 else 0.0
        taper = lost / np.sqrt(1.0 - lost * lost)
        numbers = [length, self.start_radius_mm, lost, taper, self.blend_mm, float(self.is_hollow)]
        return np.array([*self.start_mm, *axis, *numbers])

    @property
    def ball(self) -> FloatArray:
        """(4,) centre and radius of a ball that holds the limb."""
        centre = 0.5 * np.add(self.start_mm, self.end_mm)
        thickest = max(self.start_radius_mm, self.end_radius_mm)
        return np.array([*centre, 0.5 * self._length_mm + thickest])

    @property
    def _length_mm(self) -> float:
        return float(np.linalg.norm(np.subtract(self.end_mm, self.start_mm)))


@dataclass(frozen=True, slots=True, eq=False)
class Body(OneColour):
    """Limbs joined in order, at least one, the first solid, standing somewhere in the scene.

    ``colour`` is the albedo (3,).
    """

    limbs: tuple[MetaballLimb, ...]
    sensor_from_part: Pose[Sensor, Part]
    colour: tuple[float, float, float] = (0.82, 0.8, 0.76)
    _rows: FloatArray = field(init=False, repr=False)
    _balls: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.limbs or self.limbs[0].is_hollow:
            raise InputError("the first limb of a body must be solid")
        rows = np.array([limb.row for limb in self.limbs])
        object.__setattr__(self, "_rows", frozen_floats(rows, (None, None), "limbs"))
        balls = np.array([limb.ball for limb in self.limbs])
        later_blends = [limb.blend_mm for limb in reversed(self.limbs)]
        balls[:, 3] += BLEND_REACH * np.maximum.accumulate(later_blends)[::-1]
        object.__setattr__(self, "_balls", frozen_floats(balls, (None, 4), "balls"))

    @property
    def rows(self) -> FloatArray:
        """(K, 12) numbers of the limbs."""
        return self._rows

    @property
    def balls(self) -> FloatArray:
        """(K, 4) centre and radius of a ball about each limb and what its blend reaches."""
        return self._balls

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of points (N, 3) in the Sensor frame from the surface; negative inside.

        It vanishes on the surface and is true to first order close to it.
        """
        points = self._in_part(points_mm)
        result = np.zeros(len(points))
        distances(points, self._rows, result)
        return result

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`: walk along each ray by the distance to the body, until it vanishes."""
        directions_part = directions @ self.sensor_from_part.rotation
        origins_part = np.broadcast_to(self._in_part(origins_mm), directions_part.shape)
        rays = np.concatenate([origins_part, directions_part], axis=1)
        travelled = np.zeros(len(rays))
        march(rays, self._rows, self._balls, HIT_MM, travelled)
        return travelled

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`: gradient of the distance, from four neighbours."""
        corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=np.float64)
        gradient = np.zeros(np.shape(points_mm))
        for corner in corners:
            beside = self.distance_mm(points_mm + GRADIENT_STEP_MM * corner)
            gradient += beside[:, None] * corner
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def _in_part(self, points_mm: FloatArray) -> FloatArray:
        pose = self.sensor_from_part
        return np.ascontiguousarray((points_mm - pose.translation_mm) @ pose.rotation)


_LIMBS = (
    MetaballLimb((-28, 0, -8), (28, 0, -6), 22.0, 20.0),
    MetaballLimb((-30, -14, 0), (30, -10, 0), 12.0, 10.0, 10.0),
    MetaballLimb((-30, 14, 0), (30, 10, 0), 10.0, 12.0, 10.0),
    MetaballLimb((-22, 0, 6), (-20, 0, 8), 11.0, 11.0, 8.0),
    MetaballLimb((18, 6, 2), (26, -6, 4), 11.0, 12.0, 6.0),
    MetaballLimb((-4, -18, 4), (4, 18, 4), 6.0, 7.0, 5.0),
    MetaballLimb((2, 2, 17), (4, 0, 17), 6.0, 6.0, 6.0, is_hollow=True),
)


def free_form_part() -> Body:
    """Return the part in its own frame."""
    here: Pose[Any, Any] = Pose(np.eye(3), np.zeros(3))
    return Body(_LIMBS, here)
