# SPDX-License-Identifier: Apache-2.0
"""Line lasers: where the light of each goes, how bright and how broad it is, and laser light
seen from a point of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray, frozen_floats
from armscan.geometry.poses import Pose


@dataclass(frozen=True, slots=True)
class Section:
    """Brightness across a sheet: Gaussian unless said, its peak on the sheet's centre.

    Parameters
    ----------
    skew
        Part by which sigma is larger on the side of the sheet's normal, and smaller on the other.
    tail_low, tail_high
        Part of the peak that belongs to a broader Gaussian, on the side against the normal and on
        that of the normal.
    tail_sigmas
        Sigma of that Gaussian, in sigmas of its side.
    """

    skew: float = 0.0
    tail_low: float = 0.0
    tail_high: float = 0.0
    tail_sigmas: float = 2.0

    def __post_init__(self) -> None:
        if not abs(self.skew) < 1.0 or not self.tail_sigmas >= 1.0:
            raise InputError("a section's skew is below 1 and its tail no narrower than the rest")
        if min(self.tail_low, self.tail_high) < 0.0 or max(self.tail_low, self.tail_high) >= 1.0:
            raise InputError("a tail is a part of the peak")

    @property
    def widest(self) -> float:
        """By how much farther than a Gaussian's its light may reach."""
        has_tail = max(self.tail_low, self.tail_high) > 0.0
        return (1.0 + abs(self.skew)) * (self.tail_sigmas if has_tail else 1.0)

    def gaussian_reach(self, reach: FloatArray) -> FloatArray:
        """Reach (N,) at which a Gaussian is as bright as this section is at a reach (N,)."""
        if self == GAUSSIAN:
            return reach
        is_high = reach > 0.0
        own = reach / np.where(is_high, 1.0 + self.skew, 1.0 - self.skew)
        tail = np.where(is_high, self.tail_high, self.tail_low)
        half = 0.5 * own**2
        # log of (1 - tail) exp(-half) + tail exp(-half / w^2), safe for large reach
        excess = np.minimum(half * (1.0 - self.tail_sigmas**-2), _MOST_EXPONENT)
        level = half - np.log1p(tail * np.expm1(excess))
        return np.asarray(np.sign(reach) * np.sqrt(2.0 * np.maximum(level, 0.0)))


_MOST_EXPONENT = 600.0
GAUSSIAN = Section()


@dataclass(frozen=True, slots=True, eq=False)
class LineLaser:
    """A source from which a fan of rays spreads.

    A line lens that is not square to its beam deflects every ray of the fan by the same angle out
    of the fan plane. The rays then lie on a cone about the fan's normal; on a wall the line is a
    hyperbola, not straight. With ``skew_rad = 0`` the sheet is a plane through the source.

    Parameters
    ----------
    source_mm
        (3,) where the fan starts, in the frame of the scene.
    forward, across
        (3,) direction of the fan's middle, and the direction in which it spreads; made unit and
        perpendicular here.
    half_angle_rad
        The fan ends at plus and minus this angle.
    skew_rad
        Angle between the rays and the fan plane: the cause of the bow.
    waist_mm, waist_distance_mm, divergence_rad
        Gaussian sigma of the sheet's thickness at its waist, the distance of the waist from the
        source, and the far-field growth of sigma with distance.
    irradiance
        Irradiance on the fan's middle, on a surface that faces the source at the waist, as the
        part of the camera's full scale that a white surface then shows.
    falloff
        Part of the brightness that is lost from the fan's middle to its ends.
    cubic_rad
        Bends the sheet further: its centre at the fan angle a is raised by this times ``a**3``.
    """

    name: str
    source_mm: FloatArray
    forward: FloatArray
    across: FloatArray
    half_angle_rad: float = 0.6
    skew_rad: float = 0.0
    waist_mm: float = 0.25
    waist_distance_mm: float = 300.0
    divergence_rad: float = 6e-4
    irradiance: float = 1.0
    falloff: float = 0.4
    source: str = ""
    cubic_rad: float = 0.0
    section: Section = GAUSSIAN

    def __post_init__(self) -> None:
        object.__setattr__(self, "source_mm", frozen_floats(self.source_mm, (3,), "source_mm"))
        forward = np.array(frozen_floats(self.forward, (3,), "forward"))
        forward /= np.linalg.norm(forward)
        across = np.array(frozen_floats(self.across, (3,), "across"))
        across -= (across @ forward) * forward
        length = float(np.linalg.norm(across))
        if length < 1e-9:
            raise InputError("the laser's fan spreads along its own direction", where=self.name)
        object.__setattr__(self, "forward", frozen_floats(forward, (3,), "forward"))
        object.__setattr__(self, "across", frozen_floats(across / length, (3,), "across"))
        if not (self.waist_mm > 0.0 and self.waist_distance_mm > 0.0 and self.half_angle_rad > 0.0):
            raise InputError("a laser needs a waist and a fan of positive size", where=self.name)
        object.__setattr__(self, "source", self.source or self.name)

    @property
    def normal(self) -> FloatArray:
        """(3,) normal of the fan plane, the axis of the cone."""
        return np.cross(self.forward, self.across)

    def moved(self, there_from_here: Pose[Any, Any]) -> LineLaser:
        """The same sheet in another frame, or at another place."""
        turn = there_from_here.rotation
        return replace(
            self,
            source_mm=turn @ self.source_mm + there_from_here.translation_mm,
            forward=turn @ self.forward,
            across=turn @ self.across,
        )

    def rays(self, fan_angle_rad: FloatArray) -> FloatArray:
        """(N, 3) unit directions of the sheet's centre at fan angles (N,)."""
        angle = np.asarray(fan_angle_rad, dtype=np.float64)[:, None]
        flat = np.cos(angle) * self.forward + np.sin(angle) * self.across
        centre = self._centre_rad(angle)
        return np.asarray(np.cos(centre) * flat + np.sin(centre) * self.normal)

    def offset_mm(self, points_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) from the centre of the sheet, along the arc."""
        forward, across, up, distance = self._local(points_mm)
        elevation = np.arctan2(up, np.hypot(forward, across))
        centre = self._centre_rad(np.arctan2(across, forward))
        return np.asarray(distance * (elevation - centre))

    def thickness_mm(self, distance_mm: FloatArray) -> FloatArray:
        """Gaussian sigma of the sheet at distances (N,) from the source."""
        growth = self.divergence_rad * (distance_mm - self.waist_distance_mm)
        return np.asarray(np.hypot(self.waist_mm, growth))

    def reach_mm(self, points_mm: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 3) from the sheet's centre, in sigmas of its thickness.

        With another section than a Gaussian: the reach at which a Gaussian is as bright.
        """
        distance = np.linalg.norm(points_mm - self.source_mm, axis=1)
        return self.section.gaussian_reach(self.offset_mm(points_mm) / self.thickness_mm(distance))

    def irradiance_at(self, points_mm: FloatArray, normals: FloatArray) -> FloatArray:
        """Irradiance (N,) on surface points (N, 3) with unit normals (N, 3); shadows not counted.

        The power of the fan spreads over its width and thickness; the surface takes the cosine.
        """
        reach, peak = self.reach_and_peak(points_mm, normals)
        return np.asarray(peak * np.exp(-0.5 * reach**2))

    def reach_and_peak(
        self, points_mm: FloatArray, normals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Reach (N,) as of `reach_mm`, and irradiance (N,) if it were zero."""
        forward, across, up, distance = self._local(points_mm)
        elevation = np.arctan2(up, np.hypot(forward, across))
        sigma = self.thickness_mm(distance)
        angle = np.arctan2(across, forward)
        reach = self.section.gaussian_reach(
            distance * (elevation - self._centre_rad(angle)) / sigma
        )
        spread = self.waist_mm * self.waist_distance_mm / (sigma * distance)
        fan = angle / self.half_angle_rad
        along = np.where(np.abs(fan) <= 1.0, 1.0 - self.falloff * fan**2, 0.0)
        facing = np.einsum("ni,ni->n", self.source_mm - points_mm, normals)
        cosine = np.maximum(facing / distance, 0.0)
        return np.asarray(reach), np.asarray(self.irradiance * spread * along * cosine)

    def _centre_rad(self, fan_angle_rad: FloatArray) -> FloatArray | float:
        """Elevation of the sheet's centre over the fan plane."""
        if self.cubic_rad == 0.0:
            return self.skew_rad
        cube = fan_angle_rad * fan_angle_rad * fan_angle_rad
        return np.asarray(self.skew_rad + self.cubic_rad * cube)

    def _local(self, points_mm: FloatArray) -> tuple[FloatArray, ...]:
        """Coordinates along forward, across and normal, and the distance from the source."""
        v = np.asarray(points_mm, dtype=np.float64) - self.source_mm
        distance = np.linalg.norm(v, axis=1)
        return v @ self.forward, v @ self.across, v @ self.normal, distance


class TracedLight(Protocol):
    """Light whose brightness is ``peak * exp(-reach**2 / 2)``, both smooth along a surface."""

    @property
    def section(self) -> Section:
        """From which the reach follows."""

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
    def section(self) -> Section:
        """As for `TracedLight`: that of the middle sheet; all of a source are alike."""
        return self._middle.section

    @property
    def sense(self) -> float:
        """1 if angles about the middle sheet's source grow with the sheets' order, else -1."""
        return self._sense

    @property
    def between_rad(self) -> FloatArray:
        """(K - 1,) angles, times the sense, midway between neighbouring sheets."""
        return self._between_rad

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
