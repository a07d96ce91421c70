# SPDX-License-Identifier: Apache-2.0
"""Rims of rings measured on raw pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.vision.targets.blobs import Blobs
from armscan.vision.targets.circle_edges import measure_circles
from armscan.vision.targets.ellipse import Ellipses
from armscan.vision.targets.grey import RawGrey

_MIN_BAND_PX = 1.5
_GAP_SHARE = 0.5
_MAX_MISFIT_SHARE, _MAX_MISFIT_PX = 0.02, 0.2
"""Largest rms distance of edge points from their ellipse: a share of the radius, and pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Rims:
    """N measured rims.

    Parameters
    ----------
    ellipses
        The fits.
    centres_px
        (N, 2) centres of the ellipses.
    half_px
        (N, 2) half axes, the shorter one first.
    directions
        (N, 2, 2) unit vectors of the two axes, as columns.
    contrast_levels
        (N,) level outside minus level inside.
    is_edge
        (N,) True where an edge goes round on an ellipse.
    """

    ellipses: Ellipses
    centres_px: FloatArray
    half_px: FloatArray
    directions: FloatArray
    contrast_levels: FloatArray
    is_edge: BoolArray

    def __len__(self) -> int:
        """Count of rims."""
        return len(self.centres_px)


def measure_rims(
    grey: RawGrey, blobs: Blobs, gaps_px: FloatArray, min_contrast_levels: float
) -> Rims:
    """Measure the outlines of blobs.

    Parameters
    ----------
    grey
        (H, W) raw levels.
    blobs
        N blobs.
    gaps_px
        (N,) distance to the nearest other rim: the band of pixels reaches half of it.
    min_contrast_levels
        Rims with less contrast are no edges.
    """
    n = len(blobs)
    sizes = np.log2(np.sqrt(np.maximum(np.linalg.det(blobs.shapes_px2), 1.0)))
    octave = np.rint(sizes).astype(np.int64)
    ellipses = Ellipses.circles(np.zeros((n, 2)))
    contrast, is_edge = np.zeros(n), np.zeros(n, np.bool_)
    # Circles measured together share the count of sectors, so that they should be alike in size.
    for value in np.unique(octave):
        rows = np.flatnonzero(octave == value)
        band = np.maximum(_GAP_SHARE * gaps_px[rows], _MIN_BAND_PX)
        circles = measure_circles(
            grey, blobs.centres_px[rows], blobs.shapes_px2[rows], min_contrast_levels, band
        )
        good = circles.is_good & (circles.ellipses.degrees_of_freedom > 0.0)
        good &= _misfit(circles.ellipses, circles.points_px, circles.sigma_px) < 1.0
        ellipses = ellipses.replaced(rows, circles.ellipses)
        contrast[rows], is_edge[rows] = circles.contrast_levels, good
    safe = ellipses.circles_where(~is_edge, blobs.centres_px)
    half, directions = safe.axes()
    is_edge &= _is_near(safe, half, blobs)
    return Rims(safe, safe.centres()[0], half, directions, contrast, is_edge)


def _misfit(ellipses: Ellipses, points_px: FloatArray, sigma_px: FloatArray) -> FloatArray:
    """Rms distance (N,) of the edge points from their ellipse, over what is allowed."""
    used = np.isfinite(sigma_px)
    distance = np.where(used, ellipses.distance_px(points_px), 0.0)
    rms = np.sqrt((distance**2).sum(axis=1) / np.maximum(used.sum(axis=1), 1))
    return np.asarray(rms / (_MAX_MISFIT_SHARE * ellipses.scale_px + _MAX_MISFIT_PX))


def _is_near(ellipses: Ellipses, half: FloatArray, blobs: Blobs) -> BoolArray:
    """True where the rim is still that of the blob, not one that the fit slid to."""
    before = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2))
    change = np.abs(half - before).max(axis=1)
    return np.asarray(change < np.maximum(2.5, 0.25 * before[:, 0]))


def nearest_gaps_px(blobs: Blobs, partners: tuple[IntArray, IntArray]) -> FloatArray:
    """Distance (N,) from each blob's outline to that of its nearest concentric neighbour.

    Parameters
    ----------
    blobs
        N blobs.
    partners
        Rows of the two blobs of each concentric pair, either way round.
    """
    half = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2)[:, 0])
    gaps = np.full(len(blobs), np.inf)
    first, second = partners
    distance = np.abs(half[first] - half[second])
    np.minimum.at(gaps, first, distance)
    np.minimum.at(gaps, second, distance)
    return gaps
