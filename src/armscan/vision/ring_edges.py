# SPDX-License-Identifier: Apache-2.0
"""Rims of rings on raw pixels, and the image of a ring's centre from its two rims.

The centre of an ellipse is not the image of the circle's centre. With the homography H of the
ring's plane, the rims are ``Q_k ~ H^-T diag(1, 1, -r_k^2) H^-1``, so that ``Q_2^-1 Q_1`` is similar
to ``diag(1, 1, r_1^2 / r_2^2)``: a double eigenvalue, whose eigenvectors lie on the plane's
vanishing line, and a single one, whose eigenvector is the image of the common centre.

To first order this is ``(c_2 - q c_1) / (1 - q)`` with the ellipses' centres c and ``q = (r_2 /
r_1)^2``: the shift between the centres, continued to radius 0. It uses all that two circles say
about the centre: what else the rims determine (size, axes) is common to both to that order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.vision.targets.circle_edges import measure_circles
from armscan.vision.targets.circle_lattice import Blobs
from armscan.vision.targets.ellipse import Ellipses
from armscan.vision.targets.grey import RawGrey

_MIN_BAND_PX = 1.5
_GAP_SHARE = 0.5
_MAX_MISFIT_SHARE, _MAX_MISFIT_PX = 0.02, 0.2
"""Largest rms distance of edge points from their ellipse: a share of the radius, and pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRims:
    """N measured rims.

    ``ellipses``: The fits. ``centres_px``: (N, 2) centres of the ellipses. ``half_px``: (N, 2) half
    axes, the shorter one first. ``directions``: (N, 2, 2) unit vectors of the two axes, as columns.
    ``contrast_levels``: (N,) level outside minus level inside. ``is_edge``: (N,) True where an edge
    goes round on an ellipse.
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
) -> MeasuredRims:
    """Measure the outlines of blobs.

    ``grey``: (H, W) raw levels. ``blobs``: N blobs. ``gaps_px``: (N,) distance to the nearest other
    rim: the band of pixels reaches half of it. ``min_contrast_levels``: Rims with less contrast are
    no edges.
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
    return MeasuredRims(safe, safe.centres()[0], half, directions, contrast, is_edge)


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

    ``blobs``: N blobs. ``partners``: Rows of the two blobs of each concentric pair, either way
    round.
    """
    half = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2)[:, 0])
    gaps = np.full(len(blobs), np.inf)
    first, second = partners
    distance = np.abs(half[first] - half[second])
    np.minimum.at(gaps, first, distance)
    np.minimum.at(gaps, second, distance)
    return gaps


def common_centres(outer: Ellipses, inner: Ellipses) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Images of the centres of N rings.

    ``outer``, ``inner``: N conics each; row by row two concentric circles seen in perspective.

    Returns ``centres_px``: (N, 2). ``covariance_px2``: (N, 2, 2), the two rims' noise taken as
    independent. ``mismatch``: (N,) half the difference of the two eigenvalues that should be equal,
    over their mean: how far the rims' shapes are from those of concentric circles.
    """
    origin, unit = outer.origin_px, outer.scale_px
    first, dfirst = outer.conics_in(origin, unit)
    second, dsecond = inner.conics_in(origin, unit)
    pencil = np.linalg.solve(second, first)
    eigenvalues, eigenvectors = np.linalg.eig(pencil)
    rows = np.arange(len(pencil))
    single = eigenvalues.real.argmax(axis=1)
    value = eigenvalues[rows, single].real
    vector = eigenvectors[rows, :, single].real
    vector = vector / vector[:, 2:]
    pair = np.stack([eigenvalues[rows, (single + k) % 3] for k in (1, 2)], axis=1)
    mismatch = np.abs(pair[:, 0] - pair[:, 1]) / np.abs(pair.sum(axis=1))
    # (M - e) v = 0 with v_3 = 1, differentiated: three equations for dv_1, dv_2 and de.
    system = pencil - value[:, None, None] * np.eye(3)
    system[:, :, 2] = -vector
    change = np.concatenate([dfirst, -value[:, None, None, None] * dsecond], axis=1)
    changed = np.linalg.solve(second[:, None], change @ vector[:, None, :, None])[..., 0]
    derivative = -np.linalg.solve(system, changed.transpose(0, 2, 1))[:, :2]
    covariance = np.zeros((len(rows), 10, 10))
    covariance[:, :5, :5] = outer.covariance
    covariance[:, 5:, 5:] = inner.covariance
    own_covariance = derivative @ covariance @ derivative.transpose(0, 2, 1)
    centres = origin + unit[:, None] * vector[:, :2]
    return centres, own_covariance * (unit**2)[:, None, None], np.asarray(mismatch)
