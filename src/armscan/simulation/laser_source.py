# SPDX-License-Identifier: Apache-2.0
"""A light source with all its sheets: as each lights a part of its own, one pass renders them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.simulation.light import LineLaser

NARROW_RIM_PX, WIDE_RIM_PX = 1, 4


class TracedLight(Protocol):
    """Light whose brightness is ``peak * exp(-reach**2 / 2)``, both smooth along a surface."""

    @property
    def rim_px(self) -> int:
        """How far around it nodes are traced, so that its rim is not taken for an edge."""

    def reach_and_rank(self, points_mm: FloatArray) -> tuple[FloatArray, IntArray]:
        """Distance (N,) from the nearest centre, in sigmas, and the number of centres below."""

    def reach_and_peak(
        self, points_mm: FloatArray, normals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The same distance (N,), and irradiance (N,) if it were zero."""

    def source_of_mm(self, points_mm: FloatArray) -> FloatArray:
        """(3,) or (N, 3) whence the light comes to points (N, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class LaserSource:
    """One light source; see `TracedLight`.

    Parameters
    ----------
    sheets
        In order across the fan. Where there are several they spread from about one axis, further
        apart than they are thick, so that no point is lit by two of them.
    """

    sheets: tuple[LineLaser, ...]
    _middle: LineLaser = field(init=False, repr=False)
    _sense: float = field(init=False, repr=False)
    _between_rad: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.sheets:
            raise InputError("a light source without sheets")
        middle = self.sheets[len(self.sheets) // 2]
        object.__setattr__(self, "_middle", middle)
        rays = np.concatenate([sheet.rays(np.zeros(1)) for sheet in self.sheets])
        angles = np.arctan2(rays @ middle.normal, rays @ middle.forward)
        sense = -1.0 if angles[-1] < angles[0] else 1.0
        angles = sense * angles
        if bool((np.diff(angles) <= 0.0).any()):
            raise InputError("sheets are not in order across their fan", where=middle.source)
        object.__setattr__(self, "_sense", sense)
        object.__setattr__(self, "_between_rad", 0.5 * (angles[1:] + angles[:-1]))

    @property
    def rim_px(self) -> int:
        """As for `TracedLight`: it saves a third of the rays of many sheets, little of one."""
        return NARROW_RIM_PX if len(self.sheets) == 1 else WIDE_RIM_PX

    def reach_and_rank(self, points_mm: FloatArray) -> tuple[FloatArray, IntArray]:
        """As for `TracedLight`."""
        if len(self.sheets) == 1:
            reach = self._middle.reach_mm(points_mm)
            return reach, (reach > 0.0).astype(np.int64)
        nearest = self._nearest(points_mm)
        reach = self._gathered(nearest, lambda sheet, at: sheet.reach_mm(points_mm[at]))
        return reach, nearest + (self._sense * reach > 0.0)

    def reach_and_peak(
        self, points_mm: FloatArray, normals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As for `TracedLight`."""
        if len(self.sheets) == 1:
            return self._middle.reach_and_peak(points_mm, normals)
        both = np.zeros((len(points_mm), 2))
        for sheet, at in self._parts(self._nearest(points_mm)):
            both[at] = np.stack(sheet.reach_and_peak(points_mm[at], normals[at]), axis=1)
        return both[:, 0], both[:, 1]

    def source_of_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `TracedLight`."""
        if len(self.sheets) == 1:
            return self._middle.source_mm
        return np.array([sheet.source_mm for sheet in self.sheets])[self._nearest(points_mm)]

    def _nearest(self, points_mm: FloatArray) -> IntArray:
        """(N,) index of the nearest sheet, by the angle about the axis."""
        v = points_mm - self._middle.source_mm
        angle = np.arctan2(v @ self._middle.normal, v @ self._middle.forward)
        return np.searchsorted(self._between_rad, self._sense * angle).astype(np.int64)

    def _parts(self, nearest: IntArray) -> Iterator[tuple[LineLaser, IntArray]]:
        for k, sheet in enumerate(self.sheets):
            at = np.flatnonzero(nearest == k)
            if len(at):
                yield sheet, at

    def _gathered(
        self, nearest: IntArray, value: Callable[[LineLaser, IntArray], FloatArray]
    ) -> FloatArray:
        result = np.zeros(len(nearest))
        for sheet, at in self._parts(nearest):
            result[at] = value(sheet, at)
        return result


def in_sources(lasers: Sequence[LineLaser]) -> tuple[LaserSource, ...]:
    """The sheets grouped by their light source, in order."""
    names = dict.fromkeys(laser.source for laser in lasers)
    return tuple(LaserSource(tuple(s for s in lasers if s.source == name)) for name in names)
