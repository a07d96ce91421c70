# SPDX-License-Identifier: Apache-2.0
"""Shapes with exact ray intersections: box, ball, steps, flat and wavy plates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.poses import Pose
from armscan.simulation.optics.scene import MISS, OneColour, Surface

GREY = (0.7, 0.7, 0.7)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A shape moved from a frame of its own into another one."""

    shape: Surface
    scene_from_shape: Pose[Any, Any]

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        rotation = self.scene_from_shape.rotation
        return self.shape.intersect(self.in_shape(origins_mm), directions @ rotation)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        normals = self.shape.normals(self.in_shape(points_mm))
        return np.asarray(normals @ self.scene_from_shape.rotation.T)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.shape.albedo(self.in_shape(points_mm))

    def in_shape(self, points_mm: FloatArray) -> FloatArray:
        """Points (N, 3) of the scene in the shape's frame."""
        pose = self.scene_from_shape
        return np.asarray((points_mm - pose.translation_mm) @ pose.rotation)


@dataclass(frozen=True, slots=True, eq=False)
class Box(OneColour):
    """A block with sharp edges that stands on z = 0 of its frame, its footprint centred on z.

    ``size_mm`` (3,) is along x, y, z; ``colour`` (3,) is the albedo.
    """

    size_mm: FloatArray
    colour: tuple[float, float, float] = GREY

    def __post_init__(self) -> None:
        size = frozen_floats(self.size_mm, (3,), "size_mm")
        if not bool((size > 0.0).all()):
            raise InputError(f"block of size {size.tolist()} mm")
        object.__setattr__(self, "size_mm", size)

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`: the rays enter through the last of three pairs of faces."""
        origins = self._from_centre(origins_mm)
        half = 0.5 * self.size_mm
        enter, leave = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
        for axis in range(3):
            along = directions[:, axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                a = (-half[axis] - origins[:, axis]) / along
                b = (half[axis] - origins[:, axis]) / along
            enter = np.fmax(enter, np.fmin(a, b))
            leave = np.fmin(leave, np.fmax(a, b))
        return np.where((enter < leave) & (enter > 0.0), enter, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`: of the nearest face."""
        centred = self._from_centre(points_mm)
        depth = np.abs(centred) - 0.5 * self.size_mm
        face = np.argmax(depth, axis=1)
        rows = np.arange(len(face))
        normals = np.zeros(centred.shape)
        normals[rows, face] = np.where(centred[rows, face] < 0.0, -1.0, 1.0)
        return normals

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) signed distance of points (N, 3) from the surface; positive outside."""
        beyond = np.abs(self._from_centre(points_mm)) - 0.5 * self.size_mm
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))

    def _from_centre(self, points_mm: FloatArray) -> FloatArray:
        return np.asarray(points_mm - np.array([0.0, 0.0, 0.5 * self.size_mm[2]]))


class HeightField(OneColour):
    """A face given by its height over x and y."""

    __slots__ = ()

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N,) derivatives of the height along x and y."""
        raise NotImplementedError

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        slope_x, slope_y = self.slopes(points_mm[:, 0], points_mm[:, 1])
        normals = np.stack([-slope_x, -slope_y, np.ones(len(slope_x))], axis=1)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


N_WAVES = 7
"""Half waves over each side of a plate: on 200 mm the shortest is 29 mm long."""
_GRID = 61


@dataclass(frozen=True, slots=True, eq=False)
class FlatPlate(HeightField):
    """A rectangle in x and y of its frame, seen from +z; z = 0 is the best plane through it.

    Parameters
    ----------
    size_mm
        (2,) length along x and width along y, centred on the origin.
    waves_mm
        (K, L) amplitudes of the waves ``cos(k pi x / length) cos(l pi y / width)``, counted from
        the corner; of these the best plane is taken away. None for a perfect plane.
    colour
        (3,) albedo.
    """

    size_mm: FloatArray
    waves_mm: FloatArray | None = None
    colour: tuple[float, float, float] = GREY
    _tilt: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        size = frozen_floats(self.size_mm, (2,), "size_mm")
        if not bool((size > 0.0).all()):
            raise InputError(f"plate of size {size.tolist()} mm")
        object.__setattr__(self, "size_mm", size)
        object.__setattr__(self, "_tilt", np.zeros(3))
        if self.waves_mm is None:
            return
        object.__setattr__(self, "waves_mm", frozen_floats(self.waves_mm, (None, None), "waves_mm"))
        x, y = self._grid()
        basis = np.stack([np.ones(len(x)), x, y], axis=1)
        tilt = np.linalg.lstsq(basis, self.height_mm(x, y), rcond=None)[0]
        object.__setattr__(self, "_tilt", frozen_floats(tilt, (3,), "tilt"))

    @property
    def tilt(self) -> FloatArray:
        """(3,) height and slopes of the best plane through the waves alone."""
        return self._tilt

    @staticmethod
    def draw(
        size_mm: tuple[float, float],
        flatness_mm: float,
        rng: np.random.Generator,
        colour: tuple[float, float, float] = GREY,
    ) -> FlatPlate:
        """Draw a plate whose heights span ``flatness_mm`` from lowest to highest."""
        k, m = np.indices((N_WAVES, N_WAVES))
        order = k + m
        decay = np.where((order >= 2) & (order < N_WAVES), 1.0 / np.maximum(order, 1) ** 1.5, 0.0)
        waves = decay * rng.standard_normal(decay.shape)
        rough = FlatPlate(np.asarray(size_mm), waves, colour)
        span = float(np.ptp(rough.height_mm(*rough._grid())))
        return FlatPlate(np.asarray(size_mm), waves * (flatness_mm / span), colour)

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(N,) height of the face over its best plane at (N,) x and y."""
        if self.waves_mm is None:
            return np.zeros(np.shape(x_mm))
        n_x, n_y = self.waves_mm.shape
        along_x, along_y = self._cosines(x_mm, 0, n_x), self._cosines(y_mm, 1, n_y)
        waves = np.einsum("nk,nk->n", along_x @ self.waves_mm, along_y)
        tilt = self._tilt
        return np.asarray(waves - tilt[0] - tilt[1] * x_mm - tilt[2] * y_mm)

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N,) derivatives of the height along x and y."""
        if self.waves_mm is None:
            return np.zeros(np.shape(x_mm)), np.zeros(np.shape(y_mm))
        n_x, n_y = self.waves_mm.shape
        cos_x, cos_y = self._cosines(x_mm, 0, n_x), self._cosines(y_mm, 1, n_y)
        along_x = np.einsum("nk,nk->n", self._sines(x_mm, 0, n_x) @ self.waves_mm, cos_y)
        along_y = np.einsum("nk,nk->n", cos_x @ self.waves_mm, self._sines(y_mm, 1, n_y))
        return along_x - self._tilt[1], along_y - self._tilt[2]

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`; seen from above only."""
        along = directions[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(
                (along < 0.0) & (origins_mm[:, 2] > 0.0), -origins_mm[:, 2] / along, np.nan
            )
        x = origins_mm[:, 0] + distance * directions[:, 0]
        y = origins_mm[:, 1] + distance * directions[:, 1]
        half = 0.5 * self.size_mm
        inside = np.flatnonzero((np.abs(x) <= half[0]) & (np.abs(y) <= half[1]))
        result = np.full(len(directions), MISS)
        if self.waves_mm is None or len(inside) == 0:
            result[inside] = distance[inside]
            return result
        # The slopes are below 1e-3: one step leaves nanometres.
        height = self.height_mm(x[inside], y[inside])
        result[inside] = distance[inside] + height / along[inside]
        return result

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `Box`, over the face and next to it."""
        return np.asarray(points_mm[:, 2] - self.height_mm(points_mm[:, 0], points_mm[:, 1]))

    def _grid(self) -> tuple[FloatArray, FloatArray]:
        half = 0.5 * self.size_mm
        x, y = np.meshgrid(
            np.linspace(-half[0], half[0], _GRID), np.linspace(-half[1], half[1], _GRID)
        )
        return x.ravel(), y.ravel()

    def _angle(self, position_mm: FloatArray, axis: int) -> FloatArray:
        return np.asarray(np.pi * (position_mm / self.size_mm[axis] + 0.5))

    def _cosines(self, position_mm: FloatArray, axis: int, count: int) -> FloatArray:
        """(N, count) cosines of whole multiples of the angle, by their recurrence."""
        cosine = np.cos(self._angle(position_mm, axis))
        columns = np.ones((count, len(cosine)))
        for k in range(1, count):
            columns[k] = cosine if k == 1 else 2 * cosine * columns[k - 1] - columns[k - 2]
        return columns.T

    def _sines(self, position_mm: FloatArray, axis: int, count: int) -> FloatArray:
        """(N, count) derivatives of the cosines by the position, by the same recurrence."""
        angle = self._angle(position_mm, axis)
        cosine, sine = np.cos(angle), np.sin(angle)
        columns = np.zeros((count, len(cosine)))
        for k in range(1, count):
            columns[k] = sine if k == 1 else 2 * cosine * columns[k - 1] - columns[k - 2]
        columns *= (-np.pi / self.size_mm[axis] * np.arange(count))[:, None]
        return columns.T


_CLOSE_MM = 1e-3
_WALK_STEPS = 200
_NEWTON_STEPS = 4


@dataclass(frozen=True, slots=True)
class Wave:
    """One sine over a plate.

    Parameters
    ----------
    amplitude_mm, length_mm
        Half its height, and the distance from crest to crest.
    azimuth_deg
        Direction in which it runs, from the plate's x axis.
    phase_rad
        At the plate's middle.
    """

    amplitude_mm: float
    length_mm: float
    azimuth_deg: float
    phase_rad: float = 0.0

    @property
    def steepest(self) -> float:
        """Largest slope."""
        return 2.0 * np.pi * self.amplitude_mm / self.length_mm

    def angle_rad(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(N,) phase at places (N,) and (N,)."""
        along = np.cos(self.azimuth_rad) * x_mm + np.sin(self.azimuth_rad) * y_mm
        return np.asarray(2.0 * np.pi / self.length_mm * along + self.phase_rad)

    @property
    def azimuth_rad(self) -> float:
        """The azimuth in radians."""
        return float(np.radians(self.azimuth_deg))


@dataclass(frozen=True, slots=True)
class WavyPlate(HeightField):
    """A rectangle in x and y of its frame whose height is a sum of sines, seen from +z.

    Parameters
    ----------
    size_mm
        Length along x and width along y, centred on the origin.
    waves
        At least one.
    colour
        (3,) albedo.
    """

    size_mm: tuple[float, float]
    waves: tuple[Wave, ...]
    colour: tuple[float, float, float] = GREY

    def __post_init__(self) -> None:
        if not self.waves or min(self.size_mm) <= 0.0:
            raise InputError(f"a wavy plate of {self.size_mm} mm with {len(self.waves)} waves")

    @property
    def highest_mm(self) -> float:
        """No point lies higher than this."""
        return sum(wave.amplitude_mm for wave in self.waves)

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(N,) height at places (N,) and (N,)."""
        heights = [w.amplitude_mm * np.sin(w.angle_rad(x_mm, y_mm)) for w in self.waves]
        return np.asarray(sum(heights))

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N,) derivatives of the height along x and y."""
        rises = [w.steepest * np.cos(w.angle_rad(x_mm, y_mm)) for w in self.waves]
        azimuths = [w.azimuth_rad for w in self.waves]
        along_x = sum(np.cos(a) * rise for a, rise in zip(azimuths, rises, strict=True))
        along_y = sum(np.sin(a) * rise for a, rise in zip(azimuths, rises, strict=True))
        return np.asarray(along_x), np.asarray(along_y)

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`; rays come from above.

        A ray may fall by its height over the surface, divided by the rate at which that can
        shrink, without passing through; close to the surface Newton's steps take over.
        """
        origins = np.broadcast_to(origins_mm, directions.shape)
        result = np.full(len(directions), MISS)
        falls = np.flatnonzero((directions[:, 2] < 0.0) & (origins[:, 2] > self.highest_mm))
        start, ray = origins[falls], directions[falls]
        distance = (self.highest_mm - start[:, 2]) / ray[:, 2]
        steepest = sum(wave.steepest for wave in self.waves)
        rate = -ray[:, 2] + steepest * np.hypot(ray[:, 0], ray[:, 1])
        walking = np.arange(len(falls))
        for _ in range(_WALK_STEPS):
            above = self._above(start[walking] + distance[walking, None] * ray[walking])
            distance[walking] += above / rate[walking]
            walking = walking[above > _CLOSE_MM]
            if len(walking) == 0:
                break
        for _ in range(_NEWTON_STEPS):
            points = start + distance[:, None] * ray
            slope_x, slope_y = self.slopes(points[:, 0], points[:, 1])
            falling = slope_x * ray[:, 0] + slope_y * ray[:, 1] - ray[:, 2]
            # A ray that only grazes a crest keeps its place: it is within `_CLOSE_MM` of it.
            step = self._above(points) / np.where(falling > 1e-3, falling, np.inf)
            distance += np.clip(step, -_CLOSE_MM * 10.0, _CLOSE_MM * 10.0)
        hit = start + distance[:, None] * ray
        is_near = np.abs(hit[:, :2]) <= 0.5 * np.asarray(self.size_mm)
        inside = np.asarray(is_near.all(axis=1))
        inside[walking] = False
        result[falls[inside]] = distance[inside]
        return result

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `Box`, over the face; true to first order close to it."""
        slope_x, slope_y = self.slopes(points_mm[:, 0], points_mm[:, 1])
        return np.asarray(self._above(points_mm) / np.sqrt(1.0 + slope_x**2 + slope_y**2))

    def _above(self, points_mm: FloatArray) -> FloatArray:
        return np.asarray(points_mm[:, 2] - self.height_mm(points_mm[:, 0], points_mm[:, 1]))
