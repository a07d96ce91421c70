# SPDX-License-Identifier: Apache-2.0
"""Faces over which a head is held: axes that lean or are turned, and places on them."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotation import rotation_from_vector


def on_face(face: FloatArray, origin_mm: FloatArray, place_mm: tuple[float, float]) -> FloatArray:
    """(3,) point beside a face's origin, along its first two axes."""
    return np.asarray(origin_mm + face[:, :2] @ np.array(place_mm))


def leaning(tilt_deg: float, azimuth_deg: float) -> FloatArray:
    """(3, 3) axes of a face that leans towards an azimuth, without turning about the vertical."""
    azimuth = np.radians(azimuth_deg)
    axis = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return rotation_from_vector(np.radians(tilt_deg) * axis)


def quarter_turn() -> FloatArray:
    """A face whose y axis runs along the x of the one before it."""
    return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
