# SPDX-License-Identifier: Apache-2.0
"""Stripes that another sheet would put on the surface of their neighbours.

Where a thing in front hides a stripe from the right camera, and another from the left, the two
that are left over may fit one another on a sheet of neither: a line of points floating off the
surface, millimetres from it. The sheet that the stripe is really of puts it on the surface.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray

NEIGHBOURS = 24
THINNING = 5
"""Of the samples along a line, so that the nearest are of several lines."""
REACH_PX = 500.0
"""Neighbouring lines of eleven over a field of 2658 px lie within about a third of this."""
SURFACE_MM = 0.1
"""By how much a surface between neighbouring lines differs from a plane, at least."""
SLOPE_MM_PER_PX = 0.03
"""A surface tilted by about 45 degrees at 140 mm: the slope's prior standard deviation."""
OFF_SIGMAS = 4.0
LEAST_OFF_MM = 1.5
"""Nearer to the surface than this, a stretch may well be on it."""
ON_SIGMAS = 2.0
MOST_SIGMA_MM = 0.5
"""A surface that is known no better puts any sheet within reach of it."""
MOST = 0.5
"""Part of a stretch that has to be off, and on for its rival."""


def expected_depths(
    points_px: FloatArray,
    stretch: IntArray,
    known_px: FloatArray,
    known_depth_mm: FloatArray,
    known_stretch: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Depth of the surface through the named points around each point, without its own stretch.

    The inverse depth of a plane is linear over the image; it is fitted to the nearest points.

    Parameters
    ----------
    points_px
        (N, 2) undistorted enough: the lens bends a plane by less than the tolerance.
    stretch
        (N,) number of the stretch that each point is of.
    known_px, known_depth_mm, known_stretch
        (K, 2), (K,) and (K,) of points whose sheet is known.

    Returns
    -------
    depth_mm, sigma_mm
        (N,); infinite sigma where there are too few neighbours.
    """
    depth, sigma = np.ones(len(points_px)), np.full(len(points_px), np.inf)
    for b in np.unique(stretch):
        own = np.flatnonzero(stretch == b)
        others = np.flatnonzero(known_stretch != b)[::THINNING]
        if len(others) < NEIGHBOURS:
            continue
        distance, nearest = cKDTree(known_px[others]).query(points_px[own], NEIGHBOURS)
        near = others[nearest]
        offset = (known_px[near] - points_px[own][:, None, :]) / REACH_PX
        inverse = 1.0 / known_depth_mm[near]
        middle = np.median(inverse, axis=1)
        design = np.concatenate([np.ones((*near.shape, 1)), offset], axis=2)
        noise = SURFACE_MM * middle**2
        slope = SLOPE_MM_PER_PX * REACH_PX * middle**2
        prior = np.zeros((len(own), 3, 3))
        prior[:, 1, 1] = prior[:, 2, 2] = (noise / slope) ** 2
        normal = design.transpose(0, 2, 1) @ design + prior
        right = np.einsum("nkj,nk->nj", design, inverse - middle[:, None])
        fitted = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        misfit = inverse - middle[:, None] - np.einsum("nkj,nj->nk", design, fitted)
        spread = np.maximum(np.sqrt((misfit**2).mean(axis=1)), noise)
        share = np.linalg.inv(normal)[:, 0, 0]
        depth[own] = 1.0 / (middle + fitted[:, 0])
        is_near = distance[:, NEIGHBOURS // 2] < REACH_PX
        error = spread * np.sqrt(1.0 + NEIGHBOURS / 3.0 * share) * depth[own] ** 2
        sigma[own] = np.where(is_near, error, np.inf)
    return depth, sigma


def has_rival_on_surface(
    stretch: IntArray,
    own_depth_mm: FloatArray,
    expected_mm: FloatArray,
    sigma_mm: FloatArray,
    rival_sample: IntArray,
    rival_sheet: IntArray,
    rival_depth_mm: FloatArray,
) -> BoolArray:
    """(B,) True where a stretch is off its neighbours' surface and another sheet puts it on.

    Parameters
    ----------
    stretch
        (N,) number of each sample's stretch, counted from 0.
    own_depth_mm, expected_mm, sigma_mm
        (N,) depth on its own sheet, and that of `expected_depths`.
    rival_sample, rival_sheet, rival_depth_mm
        (R,) other sheets on which a sample may lie.
    """
    n = int(stretch.max()) + 1 if len(stretch) else 0
    count = np.maximum(np.bincount(stretch, minlength=n), 1)
    is_off = np.abs(own_depth_mm - expected_mm) > np.maximum(OFF_SIGMAS * sigma_mm, LEAST_OFF_MM)
    off_share = np.bincount(stretch, is_off, n) / count
    if not len(rival_sample):
        return np.zeros(n, dtype=np.bool_)
    away = np.abs(rival_depth_mm - expected_mm[rival_sample])
    is_on = away < ON_SIGMAS * np.where(sigma_mm < MOST_SIGMA_MM, sigma_mm, 0.0)[rival_sample]
    n_sheets = int(rival_sheet.max()) + 1
    key = stretch[rival_sample] * n_sheets + rival_sheet
    on_share = np.bincount(key, is_on, n * n_sheets).reshape(n, n_sheets) / count[:, None]
    return np.asarray((off_share > MOST) & (on_share.max(axis=1) > MOST))
