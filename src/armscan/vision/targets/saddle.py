# SPDX-License-Identifier: Apache-2.0
"""Corners where two edges cross, fitted as saddles to raw pixels, and the grey images of an
exposure in which a target may show, the likeliest first.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from armscan.geometry.arrays import BoolArray, FloatArray, ImageArray
from armscan.geometry.least_squares import MAD_TO_SIGMA
from armscan.kernels.target_edges import CROSSING, fit_crossings
from armscan.records.exposure import Exposure

MIN_CONTRAST = 0.02
"""Least contrast of a circle or square, as a fraction of full scale."""
SAME_CHANNEL_LEVELS = 1.5
"""Channels whose mean difference is below this (8-bit levels) show the same."""
_WEIGHTS = (0.299, 0.587, 0.114)
_SAMPLES_PER_CUBE = 65_536

Grey8 = NDArray[np.uint8]
Grey32 = NDArray[np.float32]
RawGrey = ImageArray | FloatArray


def grey_channels(exposure: Exposure) -> list[RawGrey]:
    """Return the grey images (H, W) worth a search, raw levels, without near duplicates.

    A monochrome exposure has one. A colour exposure has its luminance, then red, green and blue
    (a board lit by a red laser shows in red only), then the darkest and the brightest channel.
    """
    if exposure.colour == "mono":
        return [exposure.image]
    image = exposure.image
    red, green, blue = (image[..., k] for k in range(3))
    luminance: FloatArray = _WEIGHTS[0] * red + _WEIGHTS[1] * green + _WEIGHTS[2] * blue
    channels: list[RawGrey] = [luminance]
    darkest = np.minimum(np.minimum(red, green), blue)
    brightest = np.maximum(np.maximum(red, green), blue)
    others = [red, green, blue, darkest, brightest]
    step = max(1, int(np.sqrt(image.shape[0] * image.shape[1] / _SAMPLES_PER_CUBE)))
    limit = SAME_CHANNEL_LEVELS * exposure.full_scale / 255.0
    for other in others:
        differences = [
            np.abs(other[::step, ::step] - known[::step, ::step].astype(np.float64)).mean()
            for known in channels
        ]
        if min(differences) > limit:
            channels.append(np.ascontiguousarray(other))
    return channels


def to_grey8(grey: RawGrey, full_scale: int) -> Grey8:
    """Return an 8-bit copy for OpenCV's finders.

    Up to 8 significant bits the levels are kept. Deeper images are scaled so that their brightest
    0.1 % reach 255, because a dark board would lose its grey levels otherwise.
    """
    if full_scale <= 255 and grey.dtype == np.uint8:
        return np.ascontiguousarray(grey, dtype=np.uint8)
    if full_scale <= 255:
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    top = max(float(np.percentile(grey[::4, ::4], 99.9)), full_scale / 64.0)
    return np.clip(np.rint(grey * (255.0 / top)), 0, 255).astype(np.uint8)


def sample(grey: RawGrey | Grey32, points_px: FloatArray) -> FloatArray:
    """Return the levels (N,) at the pixels nearest to (N, 2) points; NaN outside the image."""
    u = np.rint(points_px[:, 0])
    v = np.rint(points_px[:, 1])
    height, width = grey.shape[:2]
    is_inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    levels = np.full(len(points_px), np.nan)
    levels[is_inside] = grey[v[is_inside].astype(np.int64), u[is_inside].astype(np.int64)]
    return levels


def ring_levels(blurred: Grey32, points_px: FloatArray, radius_px: float, count: int) -> FloatArray:
    """Levels (N, count) on a ring around each point."""
    angle = 2.0 * np.pi * np.arange(count) / count
    at_u = (points_px[:, :1] + radius_px * np.cos(angle)).astype(np.float32)
    at_v = (points_px[:, 1:] + radius_px * np.sin(angle)).astype(np.float32)
    if not len(points_px):
        return np.zeros((0, count))
    levels = cv2.remap(blurred, at_u, at_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels, dtype=np.float64)


def half_turn(angle_rad: FloatArray) -> FloatArray:
    """Angles modulo half a turn, within a quarter turn of 0."""
    return np.asarray(np.mod(angle_rad + 0.5 * np.pi, np.pi) - 0.5 * np.pi)


WINDOW_FRACTION = 0.42
"""Radius of the window, as a fraction of the way to the nearest other edge."""
MAX_WINDOW_PX = 18
MIN_WINDOW_PX = 3
APERTURE_SIGMA_PX = 0.29
"""Standard deviation of a pixel's own width, 1 / sqrt(12): no edge is sharper."""
_STEPS = 15
MAX_RESIDUAL_RATIO = 2.5
"""Largest residual, over the median of the board's corners, of a corner that nothing disturbs. On
undisturbed boards, rendered and photographed, it stays below 1.7; where a line of light makes it
larger, corners are off by up to 2 px, and by less than 0.07 px below."""
_MIN_SIGNIFICANCE = 5.0
"""Least contrast in its standard deviations."""
_MIN_CONTRAST_RATIO = 0.1
"""Least contrast, of that of the board's median corner: less is no print, but what hides it."""
_MAX_TURN_RAD = 0.2
"""Between an edge and the way to the next corner: more is the edge of something else, unless all
corners show it (motion during the exposure rounds them)."""
_LEAST_RESIDUAL = 0.3
_AT_REST_PX = 1e-4
"""A fiftieth of the smallest standard deviation of a corner."""
_OUTLIER_SIGMAS = 4.0


class Saddles(NamedTuple):
    """Fitted corners.

    ``points_px``: (N, 2) image pixels. ``covariance_px2``: (N, 2, 2) from the pixel noise that the
    fit's residuals show. ``is_good``: (N,) False where the fit left its window, found no crossing
    of two edges, or leaves residuals that other corners of the board do not have.
    """

    points_px: FloatArray
    covariance_px2: FloatArray
    is_good: BoolArray

    @property
    def sigma_px(self) -> FloatArray:
        """(N,) standard deviation along an axis."""
        return np.asarray(np.sqrt(0.5 * np.trace(self.covariance_px2, axis1=1, axis2=2)))


def fit_saddles(
    grey: RawGrey,
    corners_px: FloatArray,
    step_x_px: FloatArray,
    step_y_px: FloatArray,
    curvature_1_px: FloatArray | None = None,
) -> Saddles:
    """Refine chessboard corners.

    ``grey``: (H, W) image, raw levels. ``corners_px``: (N, 2) corners to about 2 px, image pixels.
    ``step_x_px``, ``step_y_px``: (N, 2) way to the next corner along the board's x and y.
    ``curvature_1_px``: (N, 2) curvature of the edges along x and along y, 1/px, positive where
    they turn from u towards v on that way; straight without it.
    """
    if not len(corners_px):
        return Saddles(corners_px, np.zeros((0, 2, 2)), np.zeros(0, dtype=np.bool_))
    radius = window_radius(step_x_px, step_y_px)
    origin = np.rint(corners_px)
    levels, offsets, weights = _windows(grey, origin, radius)
    start = _initial(levels, offsets, weights, (corners_px - origin, step_x_px, step_y_px))
    # the first edge runs along y, the second along x
    bends = np.zeros((len(start), 2))
    if curvature_1_px is not None:
        bends[:] = curvature_1_px[:, ::-1]
    parameters, residuals, _ = _fit(levels, offsets, weights, start, bends)
    weights = _without_outliers(residuals, weights)
    parameters, residuals, inverse = _fit(levels, offsets, weights, parameters, bends)
    variance = _variance(residuals, weights)
    inverse *= variance[:, None, None]
    covariance = inverse[:, :2, :2]
    contrast = np.abs(parameters[:, 6])
    moved = np.hypot(*(parameters[:, :2] - (corners_px - origin)).T)
    sigma_px = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    is_good = (moved < 0.6 * radius) & (sigma_px < 0.25 * radius) & np.isfinite(sigma_px)
    is_good &= parameters[:, 4] < radius
    turned = np.abs(np.arcsin(np.sin(parameters[:, 2:4] - start[:, 2:4]))).max(axis=1)
    is_good &= turned < np.maximum(_MAX_TURN_RAD, MAX_RESIDUAL_RATIO * np.median(turned))
    is_good &= parameters[:, 6] * start[:, 6] > 0.0
    is_good &= contrast > _MIN_SIGNIFICANCE * np.sqrt(inverse[:, 6, 6])
    is_good &= contrast > _MIN_CONTRAST_RATIO * np.median(contrast)
    is_good &= ~_is_disturbed(np.sqrt(variance), contrast, is_good)
    return Saddles(origin + parameters[:, :2], covariance, is_good)


def window_radius(step_x_px: FloatArray, step_y_px: FloatArray) -> FloatArray:
    """Radius (N,) px in which nothing but the two edges of a corner is seen."""
    area = np.abs(step_x_px[:, 0] * step_y_px[:, 1] - step_x_px[:, 1] * step_y_px[:, 0])
    longest = np.maximum(np.hypot(*step_x_px.T), np.hypot(*step_y_px.T))
    radius: FloatArray = WINDOW_FRACTION * area / np.maximum(longest, 1e-9)
    return np.clip(np.nan_to_num(radius), MIN_WINDOW_PX, MAX_WINDOW_PX)


def _windows(
    grey: RawGrey, origin: FloatArray, radius: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Levels (N, K), pixel offsets (K, 2) and weights (N, K) of the discs around the origins."""
    reach = int(np.ceil(radius.max()))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    offsets = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
    offsets = offsets[np.hypot(offsets[:, 0], offsets[:, 1]) <= radius.max()]
    height, width = grey.shape[:2]
    at_u = (origin[:, :1] + offsets[:, 0]).astype(np.int64)
    at_v = (origin[:, 1:] + offsets[:, 1]).astype(np.int64)
    is_inside = (at_u >= 0) & (at_v >= 0) & (at_u < width) & (at_v < height)
    levels = grey[np.clip(at_v, 0, height - 1), np.clip(at_u, 0, width - 1)].astype(np.float64)
    is_near = np.hypot(offsets[:, 0], offsets[:, 1]) <= radius[:, None]
    return levels, offsets, (is_inside & is_near).astype(np.float64)


def _initial(
    levels: FloatArray,
    offsets: FloatArray,
    weights: FloatArray,
    lattice: tuple[FloatArray, FloatArray, FloatArray],
) -> FloatArray:
    """Start (N, 9): corner, two normals' angles, blur, mean, contrast, gradient."""
    start, step_x_px, step_y_px = lattice
    parameters = np.zeros((len(levels), CROSSING))
    parameters[:, :2] = start
    parameters[:, 2] = np.arctan2(step_y_px[:, 0], -step_y_px[:, 1])
    parameters[:, 3] = np.arctan2(step_x_px[:, 0], -step_x_px[:, 1])
    parameters[:, 4] = 1.0
    parameters[:, 5] = (levels * weights).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)
    product = weights.copy()
    for angle in (parameters[:, 2:3], parameters[:, 3:4]):
        away = np.cos(angle) * (offsets[:, 0] - parameters[:, :1])
        away += np.sin(angle) * (offsets[:, 1] - parameters[:, 1:2])
        product *= erf(away / (np.sqrt(2.0) * parameters[:, 4:5]))
    scale = np.maximum((product * product).sum(axis=1), 1e-9)
    # sectors of skewed edges are unequal: without the level taken off they would decide the sign
    centred = levels - parameters[:, 5:6]
    parameters[:, 6] = (product * centred).sum(axis=1) / scale
    return parameters


def _fit(
    levels: FloatArray,
    offsets: FloatArray,
    weights: FloatArray,
    start: FloatArray,
    bends: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corners (N, 9), residuals (N, K), inverse normal equations (N, 9, 9)."""
    corners, residuals = start.copy(), np.zeros_like(levels)
    inverses = np.zeros((len(levels), CROSSING * CROSSING))
    blurs = APERTURE_SIGMA_PX, 3.0 * MAX_WINDOW_PX
    fit_crossings(
        levels, offsets, weights, bends, blurs, _STEPS, _AT_REST_PX, corners, residuals, inverses
    )
    return corners, residuals, inverses.reshape(-1, CROSSING, CROSSING)


def _variance(residuals: FloatArray, weights: FloatArray) -> FloatArray:
    freedom = np.maximum(weights.sum(axis=1) - CROSSING, 1.0)
    return np.asarray((weights * residuals**2).sum(axis=1) / freedom)


def _is_disturbed(residual: FloatArray, contrast: FloatArray, is_good: BoolArray) -> BoolArray:
    """Tell where something else than two edges is in the window: a light stripe, dirt, a finger.

    A corner is compared with the board's others, by its residual and by that over its contrast:
    where the light is better both noise and print texture are stronger, without harm.
    """
    if not is_good.any():
        return np.zeros(len(residual), dtype=np.bool_)
    least = np.maximum(residual, _LEAST_RESIDUAL)
    relative = least / np.maximum(contrast, 1e-9)
    return np.asarray(
        (least > MAX_RESIDUAL_RATIO * np.median(least[is_good]))
        & (relative > MAX_RESIDUAL_RATIO * np.median(relative[is_good]))
    )


def _without_outliers(residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Drop pixels that a laser line or dirt put far off the model."""
    size = np.where(weights > 0.0, np.abs(residuals), np.nan)
    size[~(weights > 0.0).any(axis=1)] = 0.0
    sigma = MAD_TO_SIGMA * np.nanmedian(size, axis=1)
    kept = np.abs(residuals) <= _OUTLIER_SIGMAS * np.maximum(sigma, 0.3)[:, None]
    return np.asarray(weights * kept)
