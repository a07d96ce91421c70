# SPDX-License-Identifier: Apache-2.0
"""Circle centres as printed: Canny edge pixels, algebraic least squares (eqs. 2.22 to 2.27).

Kept for comparison: whole pixels lock to the pixel grid, and the centre of the ellipse is not the
image of the circle's centre. `armscan.vision.targets.circle_edges` is what calibration uses.

The print numbers two pairs of equations alike: 2.26 and 2.27 appear in section 2.3.1.1 (here) and
2.27 again in 2.3.1.2 (the projection). Its constraint f = 1 has no solution for an ellipse through
the pixel origin and is badly conditioned far from it (u^2 reaches 1e7 beside 1). Here the points
are first shifted to their mean and divided by their spread: the origin then lies inside the
ellipse, where f cannot vanish, and all columns are of the size 1.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.saddle import Grey8, grey_channels, to_grey8
from armscan.vision.targets.target import TargetView

MIN_POINTS = 6
CANNY_LOW, CANNY_HIGH = 60.0, 160.0
_GAUSSIAN_SIGMA_PX = 1.0
_BAND_PX = 3.0
PRINTED_SIGMA_PX = 0.1
"""One weight for all: the printed way has no other."""


def fit_ellipse_algebraic(points_px: FloatArray) -> FloatArray | FitFailure:
    """Fit an ellipse by minimising the algebraic distance (eq. 2.26) with f = 1.

    Parameters
    ----------
    points_px
        (K, 2) edge points (eq. 2.22).

    Returns
    -------
    (6,) coefficients ``a b c d e f`` of eq. 2.24 in pixels, or why there is no ellipse.
    """
    points = np.asarray(points_px, dtype=np.float64)
    if len(points) < MIN_POINTS:
        return FitFailure(f"{len(points)} edge points, an ellipse needs {MIN_POINTS}")
    mean = points.mean(axis=0)
    scale = float(np.sqrt(((points - mean) ** 2).sum(axis=1).mean()))
    if scale == 0.0:
        return FitFailure("all edge points coincide")
    x, y = ((points - mean) / scale).T
    design = np.column_stack([x * x, x * y, y * y, x, y])
    own, _, rank, _ = np.linalg.lstsq(design, -np.ones(len(points)), rcond=None)
    if rank < 5 or own[1] ** 2 >= 4.0 * own[0] * own[2]:
        return FitFailure("the edge points lie on no ellipse", "choose points all around the rim")
    return _in_pixels(own, mean, scale)


def ellipse_centre(coefficients: FloatArray) -> FloatArray:
    """Centre (2,) of an ellipse given by its (6,) coefficients: where eq. 2.24 has no slope."""
    a, b, c, d, e, _ = coefficients
    return np.linalg.solve(np.array([[2.0 * a, b], [b, 2.0 * c]]), -np.array([d, e]))


def thesis_centres(grey8: Grey8, centres_px: FloatArray, shapes_px2: FloatArray) -> FloatArray:
    """Measure circles the thesis's way.

    Parameters
    ----------
    grey8
        (H, W) 8-bit image.
    centres_px, shapes_px2
        (N, 2) and (N, 2, 2): rough ellipses; Canny pixels within 3 px of their rims are used.

    Returns
    -------
    (N, 2) ellipse centres; NaN where no ellipse was found.
    """
    smooth = cv2.GaussianBlur(grey8, (0, 0), _GAUSSIAN_SIGMA_PX)
    rows, columns = np.nonzero(cv2.Canny(smooth, CANNY_LOW, CANNY_HIGH))
    edges = np.column_stack([columns, rows]).astype(np.float64)
    centres = np.full((len(centres_px), 2), np.nan)
    for k, (centre, shape) in enumerate(zip(centres_px, shapes_px2, strict=True)):
        offset = edges - centre
        radius = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(shape), offset))
        half = np.sqrt(np.linalg.eigvalsh(shape)[0])
        fit = fit_ellipse_algebraic(edges[np.abs(radius - 1.0) * half < _BAND_PX])
        if not isinstance(fit, FitFailure):
            centres[k] = ellipse_centre(fit)
    return centres


def with_printed_centres(view: TargetView, exposure: Exposure) -> TargetView:
    """A view of a circle grid whose centres are those of the printed way, all of one weight.

    Circles without an ellipse are dropped; the edges go, so that no centre is corrected later.
    """
    edges = view.edges
    if edges is None:
        raise InputError("no edges of circles are known", where=view.source)
    window = exposure.window.to_image(view.points_px)
    offsets = [edges.points_px[edges.circle == k] - view.points_px[k] for k in range(len(view))]
    shapes = np.array([2.0 * np.cov(offset.T) for offset in offsets]) / exposure.window.binning**2
    grey = to_grey8(grey_channels(exposure)[0], exposure.full_scale)
    centres = thesis_centres(grey, window, shapes)
    found = np.asarray(np.isfinite(centres).all(axis=1))
    full = exposure.window.to_full_sensor(centres)
    even = np.broadcast_to(np.eye(2) * PRINTED_SIGMA_PX**2, (len(view), 2, 2))
    printed = replace(view, points_px=np.where(found[:, None], full, 0.0), covariance_px2=even)
    return replace(printed.select(found), edges=None)


def _in_pixels(own: FloatArray, mean: FloatArray, scale: float) -> FloatArray:
    """Coefficients of the same curve after undoing the shift and the scale."""
    a, b, c = own[:3] / scale**2
    d, e = own[3:] / scale
    u, v = mean
    return np.array(
        [
            a,
            b,
            c,
            d - 2.0 * a * u - b * v,
            e - b * u - 2.0 * c * v,
            a * u * u + b * u * v + c * v * v - d * u - e * v + 1.0,
        ]
    )
