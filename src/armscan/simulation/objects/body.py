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


HIT_MM = 1e-5
BLEND_REACH = 1.5
"""Beyond this many blends from a limb, no surface is changed by it: a blend adds a quarter of its
length, and may meet a limb that is already melted with others."""
GRADIENT_STEP_MM = 1e-4


@dataclass(frozen=True, slots=True)
class MetaballLimb:
    """A rounded cone between two balls.

    Parameters
    ----------
    start_mm, end_mm
        Centres of the balls in the Part frame.
    start_radius_mm, end_radius_mm
        Their radii.
    blend_mm
        Over this length the limb melts into those named before it; 0 gives a sharp edge.
    is_hollow
        True if the limb is taken away instead of added.
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
class Body:
    """Limbs joined in order, standing somewhere in the scene.

    Parameters
    ----------
    limbs
        At least one; the first is solid.
    sensor_from_part
        Where the body stands.
    colour
        (3,) albedo.
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

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of points (N, 3) in the Sensor frame from the surface; negative inside.

        It vanishes on the surface and is true to first order close to it.
        """
        pass

        points = self._in_part(points_mm)
        result = np.zeros(len(points))
        distances(points, self._rows, result)
        return result

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`: walk along each ray by the distance to the body, until it vanishes."""
        pass

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

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), np.shape(points_mm))

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


_FOOT = (
    MetaballLimb((0, -62, 0), (0, -61, 0), 70.0, 70.0),
    MetaballLimb((0, 10, 0), (0, 40, 0), 15.0, 9.0, 6.0),
    MetaballLimb((0, 34, 0), (0, 35, 0), 13.5, 13.5, 1.5),
)
_CHEST = (
    MetaballLimb((0, 55, 3), (0, 76, 0), 16.0, 22.0, 8.0),
    MetaballLimb((-33, 80, -4), (33, 80, -4), 15.0, 15.0, 20.0),
    MetaballLimb((-30, 82, -3), (0, 96, -4), 13.0, 13.0, 12.0),
    MetaballLimb((30, 82, -3), (0, 96, -4), 13.0, 13.0, 12.0),
    MetaballLimb((-15, 71, 15), (-12, 72, 15), 9.5, 9.5, 14.0),
    MetaballLimb((15, 71, 15), (12, 72, 15), 9.5, 9.5, 14.0),
    MetaballLimb((-27, 96, 3), (-4, 91, 13), 2.6, 2.6, 6.0),
    MetaballLimb((27, 96, 3), (4, 91, 13), 2.6, 2.6, 6.0),
)
_HEAD = (
    MetaballLimb((0, 90, -5), (0, 122, -1), 13.0, 11.5, 10.0),
    MetaballLimb((0, 147, -6), (0, 145, 0), 22.5, 21.0, 6.0),
    MetaballLimb((0, 138, 5), (0, 124, 8), 17.0, 11.5, 10.0),
    MetaballLimb((-3, 117.5, 15.5), (3, 117.5, 15.5), 5.2, 5.2, 8.0),
    MetaballLimb((-12, 144.5, 15.5), (-3, 145, 19), 2.8, 3.0, 5.0),
    MetaballLimb((12, 144.5, 15.5), (3, 145, 19), 2.8, 3.0, 5.0),
    MetaballLimb((-11, 139, 22), (-7.5, 139, 23.5), 3.2, 3.6, 4.5, is_hollow=True),
    MetaballLimb((11, 139, 22), (7.5, 139, 23.5), 3.2, 3.6, 4.5, is_hollow=True),
    MetaballLimb((-9.6, 139.3, 16.4), (-8.2, 139.3, 16.8), 4.0, 4.0, 0.6),
    MetaballLimb((9.6, 139.3, 16.4), (8.2, 139.3, 16.8), 4.0, 4.0, 0.6),
    MetaballLimb((-12, 142, 18), (-5.5, 142, 19.5), 1.3, 1.3, 1.5),
    MetaballLimb((12, 142, 18), (5.5, 142, 19.5), 1.3, 1.3, 1.5),
    MetaballLimb((0, 143, 20), (0, 131.5, 25.5), 1.9, 2.7, 3.5),
    MetaballLimb((-3.2, 130.5, 22.5), (3.2, 130.5, 22.5), 1.9, 1.9, 1.5),
    MetaballLimb((-4.5, 125.6, 18.8), (0, 125.2, 20.4), 1.2, 1.7, 1.6),
    MetaballLimb((4.5, 125.6, 18.8), (0, 125.2, 20.4), 1.2, 1.7, 1.6),
    MetaballLimb((-3.6, 123, 18.6), (3.6, 123, 18.6), 1.9, 1.9, 1.2),
    MetaballLimb((-21.5, 143, -3), (-20, 133.5, -1), 3.2, 2.2, 2.0),
    MetaballLimb((21.5, 143, -3), (20, 133.5, -1), 3.2, 2.2, 2.0),
)
_HAIR = (
    MetaballLimb((0, 152, -6), (0, 151, -8), 22.5, 22.5, 0.5),
    MetaballLimb((-20, 150, 4), (-9, 161, 12), 3.6, 4.0, 2.0),
    MetaballLimb((-9, 161, 12), (4, 162, 13), 4.0, 4.0, 2.0),
    MetaballLimb((4, 162, 13), (20, 150, 4), 4.0, 3.6, 2.0),
    MetaballLimb((-16, 160, 3), (0, 169, 5), 3.8, 4.0, 2.0),
    MetaballLimb((0, 169, 5), (16, 160, 3), 4.0, 3.8, 2.0),
    MetaballLimb((0, 150, -30), (0, 146, -32), 10.0, 9.0, 4.0),
)


def bust(sensor_from_part: Pose[Sensor, Part]) -> Body:
    """Return the bust standing at a pose."""
    return Body(_FOOT + _CHEST + _HEAD + _HAIR, sensor_from_part)
