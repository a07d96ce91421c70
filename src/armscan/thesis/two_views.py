# SPDX-License-Identifier: Apache-2.0
"""A point from two pixels as printed: the closed form of the two-camera head (eqs. 4.6 and 4.7)."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, homogeneous
from armscan.models.two_views import PARALLEL_SINE, TwoViews


def triangulate_directly(views: TwoViews, left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """Points by the closed form of eq. 4.7.

    It uses both coordinates of the left pixel and the first one of the right; what the second one
    says against them is not looked at. Ideal normalised coordinates take the place of
    ``u / f``, so that the two focal lengths of a camera may differ and the lens may distort.

    Parameters
    ----------
    views
        The cameras.
    left_px, right_px
        (N, 2) pixels as taken, row by row of one point.

    Returns
    -------
    points_sensor_mm
        (N, 3); NaN where a pixel cannot be undistorted, the point lies behind the left camera, or
        the epipolar line runs along v in the right image, so that its u says nothing.
    """
    left, left_ok = views.left.undistort(left_px)
    right, right_ok = views.right.undistort(right_px)
    rotation = views.right_from_left.rotation
    translation = views.right_from_left.translation_mm
    rays = homogeneous(left)
    turned = rays @ rotation.T
    u = right[:, 0]
    below = u * turned[:, 2] - turned[:, 0]
    above = translation[0] - u * translation[2]
    is_known = left_ok & right_ok & (np.abs(below) > PARALLEL_SINE)
    depth = np.where(is_known, above / np.where(is_known, below, 1.0), np.nan)
    depth = np.where(depth > 0.0, depth, np.nan)
    return np.asarray(depth[:, None] * rays)
