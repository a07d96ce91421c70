# SPDX-License-Identifier: Apache-2.0
"""A flat reference plate: a rectangle that is not quite flat."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.simulation.shapes import GREY
from armscan.simulation.surfaces import MISS

N_WAVES = 7
"""Half waves over each side of a plate: on 200 mm the shortest is 29 mm long."""
_GRID = 61


@dataclass(frozen=True, slots=True, eq=False)
class FlatPlate:
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

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        slope_x, slope_y = self.slopes(points_mm[:, 0], points_mm[:, 1])
        normals = np.stack([-slope_x, -slope_y, np.ones(len(slope_x))], axis=1)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), points_mm.shape)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `Solid`, over the face and next to it."""
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
