# SPDX-License-Identifier: Apache-2.0
"""A free-form body with an analytic shape: rounded limbs that melt into each other.

The shape is known at every point as a distance, so a measured point can be judged against it
without a mesh between them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Part, Sensor
from armscan.geometry.poses import Pose

HIT_MM = 1e-5
BLEND_REACH = 1.5
"""Beyond this many blends from a limb, no surface is changed by it: a blend adds a quarter of its
length, and may meet a limb that is already melted with others."""
GRADIENT_STEP_MM = 1e-4


@dataclass(frozen=True, slots=True)
class Limb:
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
        """(12,) numbers for the kernel; see `armscan.simulation.march_kernel`."""
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

    limbs: tuple[Limb, ...]
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
        from armscan.simulation.march_kernel import distances

        points = self._in_part(points_mm)
        result = np.zeros(len(points))
        distances(points, self._rows, result)
        return result

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`: walk along each ray by the distance to the body, until it vanishes."""
        from armscan.simulation.march_kernel import march

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
