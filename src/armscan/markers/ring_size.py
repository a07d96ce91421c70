# SPDX-License-Identifier: Apache-2.0
"""How large a ring is whose image and place are known."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.camera import CameraModel
from armscan.records.markers import RingImages


def diameters_mm(
    rings: RingImages, rows: IntArray, camera: CameraModel, points_camera_mm: FloatArray
) -> FloatArray:
    """Outer diameters of rings at given places.

    The longer half axis of a circle's image, as an angle at the camera, is radius over distance
    whatever the tilt, to second order in that angle (0.0004 for 6 mm at 140 mm). As an angle,
    because the image itself stretches what lies off its axis.

    Parameters
    ----------
    rings
        Rings of one image.
    rows
        (K,) which of them.
    camera
        The camera that took it.
    points_camera_mm
        (K, 3) where each would be, in that camera's frame.
    """
    angle, half = rings.direction_rad[rows], rings.outer_half_px[rows]
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    axes_px = np.stack([half[:, 1:] * along, half[:, :1] * across], axis=2)
    xy, _, by_px, _ = camera.undistort_with_jacobian(rings.centres_px[rows])
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    length = np.linalg.norm(rays, axis=1)[:, None]
    unit = rays / length
    axes = np.concatenate([by_px @ axes_px, np.zeros((len(rows), 1, 2))], axis=1)
    # Only what is across the ray turns it.
    axes = (axes - unit[:, :, None] * np.einsum("ni,nij->nj", unit, axes)[:, None]) / length[
        ..., None
    ]
    longest = np.linalg.svd(axes, compute_uv=False)[:, 0]
    return np.asarray(2.0 * longest * np.linalg.norm(points_camera_mm, axis=1))
