# SPDX-License-Identifier: Apache-2.0
"""Which sheets put a stripe on a plane that other stripes lie on.

The sheets are evenly spread and the laser stands between the cameras: on a plane, the left
stripe of sheet i, put on sheet (i + m) / 2, falls within about a pixel of the right stripe of
sheet m, all along. Where a thing in front hides the true partners of both, or where the
calibration's errors are of that size, the residuals alone do not tell. But that point floats
millimetres off the plane on which the neighbours lie, and the stripe's true sheet puts it there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray

NEIGHBOURS = 24
ASKED = 3
"""Times as many neighbours are looked at: those on another thing are passed over."""
SAME_THING_MM = 10.0
"""Neighbours further in front or behind are taken for another thing."""
THINNING = 5
"""Of the samples along a line, so that the nearest are of several lines."""
SCALE_PX = 500.0
NOISE_MM = 0.03
"""Of a named point's depth, without the calibration."""
FLAT_MM = 0.12
"""Neighbours that scatter more about their plane are on a bent surface, or on two."""
ON_MM = 0.15
SIGMAS = 3.0
KNOWN_MM = 0.5
"""A plane that is known no better at a point puts many sheets within reach of it."""
OFF_MM = 2.0
"""Less far off its neighbours' plane than this, a stripe may well be on their bent surface."""


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """Planes seen by the camera: the inverse depth is linear over the image.

    Parameters
    ----------
    middle_px
        (B, 2) about which the numbers are given.
    inverse
        (B, 3) inverse depth in the middle (1/mm) and its change to the right and downwards over
        `SCALE_PX`.
    covariance
        (B, 3, 3).
    stretch
        (B,) number of the stripe around whose middle the plane was fitted.
    """

    middle_px: FloatArray
    inverse: FloatArray
    covariance: FloatArray
    stretch: IntArray


def fit_planes(points_px: FloatArray, depth_mm: FloatArray, stretch: IntArray) -> Planes:
    """Plane through the nearest named points around the middle of each stripe, where it is flat.

    Parameters
    ----------
    points_px
        (N, 2) of named samples. The lens bends a plane by less than the tolerance.
    depth_mm
        (N,) on the sheet of their name.
    stretch
        (N,) number of the stripe.
    """
    none = Planes(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    thin = np.arange(0, len(points_px), THINNING)
    if len(thin) < NEIGHBOURS:
        return none
    numbers = np.unique(stretch)
    middle = np.stack([np.median(points_px[stretch == b], axis=0) for b in numbers])
    own_mm = np.array([np.median(depth_mm[stretch == b]) for b in numbers])
    n_asked = min(ASKED * NEIGHBOURS, len(thin))
    _, nearest = cKDTree(points_px[thin]).query(middle, n_asked)
    near = thin[nearest]
    # What stands in front or behind comes last, so that it is taken only where nothing else is.
    is_other = np.abs(depth_mm[near] - own_mm[:, None]) > SAME_THING_MM
    order = np.argsort(is_other, axis=1, kind="stable")[:, :NEIGHBOURS]
    near = np.take_along_axis(near, order, axis=1)
    place = (points_px[near] - middle[:, None, :]) / SCALE_PX
    design = np.concatenate([np.ones((*near.shape, 1)), place], axis=2)
    inverse = 1.0 / depth_mm[near]
    normal = design.transpose(0, 2, 1) @ design
    is_spread = np.linalg.cond(normal) < 1e6
    normal[~is_spread] = np.eye(3)
    fitted = np.linalg.solve(normal, (design.transpose(0, 2, 1) @ inverse[:, :, None]))[:, :, 0]
    misfit = inverse - np.einsum("nkj,nj->nk", design, fitted)
    scatter = np.sqrt((misfit**2).mean(axis=1)) * np.median(depth_mm[near], axis=1) ** 2
    n_lines = np.array([len(np.unique(row)) for row in stretch[near]])
    kept = is_spread & (scatter < FLAT_MM) & (n_lines > 1)
    noise = np.maximum(scatter, NOISE_MM) / np.median(depth_mm[near], axis=1) ** 2
    covariance = np.linalg.inv(normal) * (noise**2)[:, None, None]
    return Planes(middle[kept], fitted[kept], covariance[kept], numbers[kept])


def depths_off(
    points_px: FloatArray, depth_mm: FloatArray, planes: Planes
) -> tuple[FloatArray, FloatArray]:
    """How far points are off each plane in depth (N, B), mm, and its standard deviation (N, B)."""
    place = (points_px[:, None, :] - planes.middle_px[None, :, :]) / SCALE_PX
    design = np.concatenate([np.ones((*place.shape[:2], 1)), place], axis=2)
    expected = np.einsum("nbj,bj->nb", design, planes.inverse)
    variance = np.einsum("nbj,bjk,nbk->nb", design, planes.covariance, design)
    square = depth_mm[:, None] ** 2
    return (expected - 1.0 / depth_mm[:, None]) * square, np.sqrt(variance) * square


def surface_distance(
    points_px: FloatArray,
    depth_mm: FloatArray,
    piece: IntArray,
    sheet: IntArray,
    planes: Planes,
    *,
    shape: tuple[int, int],
) -> tuple[FloatArray, BoolArray]:
    """How near each sheet puts each piece of stripe to a plane of others.

    Parameters
    ----------
    points_px, depth_mm, piece, sheet
        (H,) samples on sheets.
    planes
        From `fit_planes`.
    shape
        Count of pieces and of sheets.

    Returns
    -------
    distance_mm
        (pieces, sheets) mean distance in depth from the nearest plane that was fitted around
        another piece; infinite where none is known there.
    is_on
        (pieces, sheets) True where that is no more than the plane's own uncertainty.
    """
    distance = np.full(shape, np.inf)
    is_on = np.zeros(shape, dtype=np.bool_)
    if not len(planes.inverse) or not len(piece):
        return distance, is_on
    off, sigma = depths_off(points_px, depth_mm, planes)
    key = piece * shape[1] + sheet
    size = shape[0] * shape[1]
    count = np.maximum(np.bincount(key, minlength=size), 1)
    for b in range(len(planes.inverse)):
        # a tilted line is off at its ends only: the mean of the sizes, not of the signs
        mean = np.bincount(key, np.abs(off[:, b]), size) / count
        spread = np.bincount(key, sigma[:, b], size) / count
        seen = (np.bincount(key, minlength=size) > 0) & (spread < KNOWN_MM)
        seen &= np.repeat(np.arange(shape[0]), shape[1]) != planes.stretch[b]
        mean, spread = mean.reshape(shape), spread.reshape(shape)
        seen = seen.reshape(shape)
        distance = np.where(seen, np.minimum(distance, mean), distance)
        is_on |= seen & (mean <= np.maximum(ON_MM, SIGMAS * spread))
    return distance, is_on
