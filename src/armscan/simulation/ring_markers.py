# SPDX-License-Identifier: Apache-2.0
"""Ring markers stuck on flat faces: a bright disc in a dark ring (figure 4.5).

The laser sees them as a change of the skin's reflectance. In the light of a room, which is known
only every few pixels, they are drawn sharply: the tone of each small cell follows from the
marker's circles in closed form, then the lens blurs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Base
from armscan.geometry.poses import Pose
from armscan.simulation.surfaces import Surface

DISC_DIAMETER_MM = 3.0
"""Section 4.3."""
RING_DIAMETER_MM = 5.6
_LIGHT, _DARK = 0.85, 0.06
_EDGE_MM = 0.05
"""Width over which a sample of laser light averages the two tones: about two pixels."""
_LEAST_SIDE_MM = 1e-9
_FLAT_SHARE = 1e-3
_OFF_FACE_MM = 0.5
"""A point farther from the marker's plane is on another face."""


@dataclass(frozen=True, slots=True, eq=False)
class RingMarker:
    """One marker.

    Parameters
    ----------
    centre_mm, normal
        (3,) middle of the disc, on the face, and the face's normal.
    disc_mm, ring_mm
        Diameters of the bright disc and of the dark ring around it.
    light, dark
        Albedo of the two tones.
    """

    centre_mm: FloatArray
    normal: FloatArray
    disc_mm: float = DISC_DIAMETER_MM
    ring_mm: float = RING_DIAMETER_MM
    light: float = _LIGHT
    dark: float = _DARK

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", frozen_floats(self.centre_mm, (3,), "centre_mm"))
        object.__setattr__(self, "normal", frozen_floats(self.normal, (3,), "normal"))
        if not 0.0 < self.disc_mm < self.ring_mm:
            raise InputError(f"a disc of {self.disc_mm} mm in a ring of {self.ring_mm} mm")

    def seen_from(self, base_from_camera: Pose[Base, Any]) -> RingMarker:
        """The marker, given in Base, in the frame of a camera."""
        turn, place = base_from_camera.rotation, base_from_camera.translation_mm
        return replace(self, centre_mm=(self.centre_mm - place) @ turn, normal=self.normal @ turn)

    def covers(self, radius_mm: FloatArray, sides_mm: FloatArray) -> FloatArray:
        """(..., 2) parts of square samples that disc and ring cover.

        Parameters
        ----------
        radius_mm
            (...) distances of the samples' middles from the centre.
        sides_mm
            (..., 2) by how much the distance changes along each side of a sample.
        """
        disc = _covered(0.5 * self.disc_mm - radius_mm, sides_mm)
        whole = _covered(0.5 * self.ring_mm - radius_mm, sides_mm)
        return np.stack([disc, whole - disc], axis=-1)


def _covered(inside_mm: FloatArray, sides_mm: FloatArray) -> FloatArray:
    """Part of a square on one side of a straight edge, whichever way the edge runs.

    A ramp as wide as the square would leave errors that do not average out along an edge at 45
    degrees, which meets all squares alike.
    """
    sides = np.abs(sides_mm)
    first = np.maximum(sides.max(axis=-1), _LEAST_SIDE_MM)
    second = np.maximum(sides.min(axis=-1), _FLAT_SHARE * first)
    total, rest = 0.5 * (first + second), 0.5 * (first - second)
    area = sum(
        sign * np.maximum(inside_mm + shift, 0.0) ** 2
        for sign, shift in ((1.0, total), (-1.0, rest), (-1.0, -rest), (1.0, -total))
    )
    return np.asarray(np.clip(0.5 * area / (first * second), 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Marked:
    """A surface with markers on it; it is a `Surface` itself.

    Parameters
    ----------
    surface
        What the markers are on.
    markers
        In the frame of the surface.
    """

    surface: Surface
    markers: Sequence[RingMarker]

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.surface.intersect(origins_mm, directions)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.surface.normals(points_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`, markers included."""
        albedo = np.array(self.surface.albedo(points_mm))
        for marker in self.markers:
            offset = points_mm - marker.centre_mm
            height = offset @ marker.normal
            square = np.einsum("ni,ni->n", offset, offset) - height**2
            reach = 0.5 * marker.ring_mm + _EDGE_MM
            near = np.flatnonzero((square < reach**2) & (np.abs(height) < _OFF_FACE_MM))
            radius = np.sqrt(np.maximum(square[near], 0.0))
            sides = np.broadcast_to([_EDGE_MM, 0.0], (len(near), 2))
            disc, ring = marker.covers(radius, sides).T[:, :, None]
            albedo[near] = (
                disc * marker.light + ring * marker.dark + (1.0 - disc - ring) * albedo[near]
            )
        return albedo
