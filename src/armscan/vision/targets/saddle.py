# SPDX-License-Identifier: Apache-2.0
"""Corners where two edges cross, fitted as saddles to raw pixels, and the grey images of an
exposure in which a target may show, the likeliest first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from armscan.geometry.arrays import BoolArray, FloatArray, ImageArray
from armscan.geometry.least_squares import MAD_TO_SIGMA
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
_PARAMETERS = 9


def fit_saddles(
    grey: RawGrey, corners_px: FloatArray, step_x_px: FloatArray, step_y_px: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Refine chessboard corners.

    ``grey``: (H, W) image, raw levels. ``corners_px``: (N, 2) corners to about 2 px, image pixels.
    ``step_x_px``, ``step_y_px``: (N, 2) way to the next corner along the board's x and y.

    Returns ``corners_px``: (N, 2) refined corners. ``covariance_px2``: (N, 2, 2) covariance from
    the pixel noise that the fit's residuals show. ``is_good``: (N,) False where the fit left its
    window, found no crossing of two edges, or leaves residuals that other corners of the board do
    not have.
    """
    radius = _window_radius(step_x_px, step_y_px)
    origin = np.rint(corners_px)
    levels, offsets, weights = _windows(grey, origin, radius)
    start = _initial(levels, offsets, weights, (corners_px - origin, step_x_px, step_y_px))
    parameters = _iterate(levels, offsets, weights, start)
    weights = _without_outliers(_model(levels, offsets, parameters)[0], weights)
    parameters = _iterate(levels, offsets, weights, parameters)
    residuals, jacobian = _model(levels, offsets, parameters)
    variance = _variance(residuals, weights)
    normal = (jacobian * weights[:, :, None]).transpose(0, 2, 1) @ jacobian
    inverse = _inverse(normal) * variance[:, None, None]
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
    return origin + parameters[:, :2], covariance, is_good


def _window_radius(step_x_px: FloatArray, step_y_px: FloatArray) -> FloatArray:
    area = np.abs(step_x_px[:, 0] * step_y_px[:, 1] - step_x_px[:, 1] * step_y_px[:, 0])
    longest = np.maximum(np.hypot(*step_x_px.T), np.hypot(*step_y_px.T))
    radius: FloatArray = WINDOW_FRACTION * area / longest
    return np.clip(radius, MIN_WINDOW_PX, MAX_WINDOW_PX)


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
    parameters = np.zeros((len(levels), _PARAMETERS))
    parameters[:, :2] = start
    parameters[:, 2] = np.arctan2(step_y_px[:, 0], -step_y_px[:, 1])
    parameters[:, 3] = np.arctan2(step_x_px[:, 0], -step_x_px[:, 1])
    parameters[:, 4] = 1.0
    parameters[:, 5] = (levels * weights).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)
    edges = _edges(offsets, parameters)
    product = edges[0] * edges[1] * weights
    scale = np.maximum((product * product).sum(axis=1), 1e-9)
    # sectors of skewed edges are unequal: without the level taken off they would decide the sign
    centred = levels - parameters[:, 5:6]
    parameters[:, 6] = (product * centred).sum(axis=1) / scale
    return parameters


def _edges(offsets: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    scale = np.sqrt(2.0) * parameters[:, 4:5]
    du = offsets[:, 0] - parameters[:, :1]
    dv = offsets[:, 1] - parameters[:, 1:2]
    first = np.cos(parameters[:, 2:3]) * du + np.sin(parameters[:, 2:3]) * dv
    second = np.cos(parameters[:, 3:4]) * du + np.sin(parameters[:, 3:4]) * dv
    return np.asarray(erf(first / scale)), np.asarray(erf(second / scale))


def _model(
    levels: FloatArray, offsets: FloatArray, parameters: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, K), measured minus model, and the model's Jacobian (N, K, 9)."""
    s, m, c = (parameters[:, k : k + 1] for k in (4, 5, 6))
    gradient_u, gradient_v = parameters[:, 7:8], parameters[:, 8:9]
    du = offsets[:, 0] - parameters[:, :1]
    dv = offsets[:, 1] - parameters[:, 1:2]
    jacobian = np.zeros((*levels.shape, _PARAMETERS))
    edges, slopes = [], []
    for angle in (parameters[:, 2:3], parameters[:, 3:4]):
        d = np.cos(angle) * du + np.sin(angle) * dv
        edges.append(erf(d / (np.sqrt(2.0) * s)))
        slopes.append(np.sqrt(2.0 / np.pi) / s * np.exp(-0.5 * (d / s) ** 2))
    for k, angle in enumerate((parameters[:, 2:3], parameters[:, 3:4])):
        slope = c * slopes[k] * edges[1 - k]
        d = np.cos(angle) * du + np.sin(angle) * dv
        jacobian[..., 0] -= slope * np.cos(angle)
        jacobian[..., 1] -= slope * np.sin(angle)
        jacobian[..., 2 + k] = slope * (np.cos(angle) * dv - np.sin(angle) * du)
        jacobian[..., 4] -= slope * d / s
    jacobian[..., 0] -= gradient_u
    jacobian[..., 1] -= gradient_v
    jacobian[..., 5] = 1.0
    jacobian[..., 6] = edges[0] * edges[1]
    jacobian[..., 7] = du
    jacobian[..., 8] = dv
    model = m + c * edges[0] * edges[1] + gradient_u * du + gradient_v * dv
    return levels - model, jacobian


def _iterate(
    levels: FloatArray, offsets: FloatArray, weights: FloatArray, parameters: FloatArray
) -> FloatArray:
    """Levenberg-Marquardt on all corners at once; each keeps its own damping until it rests."""
    parameters = parameters.copy()
    active = np.arange(len(levels))
    damping = np.full(len(levels), 1e-3)
    residuals, jacobian = _model(levels, offsets, parameters)
    cost = (weights * residuals**2).sum(axis=1)
    diagonal = np.arange(_PARAMETERS)
    for _ in range(_STEPS):
        weighted = (jacobian * weights[active, :, None]).transpose(0, 2, 1)
        normal = weighted @ jacobian
        normal[:, diagonal, diagonal] *= 1.0 + damping[:, None]
        rhs = (weighted @ residuals[:, :, None])[:, :, 0]
        step = np.einsum("nij,nj->ni", _inverse(normal), rhs)
        trial = parameters[active] + step
        trial[:, 4] = np.clip(trial[:, 4], APERTURE_SIGMA_PX, 3.0 * MAX_WINDOW_PX)
        new_residuals, new_jacobian = _model(levels[active], offsets, trial)
        new_cost = (weights[active] * new_residuals**2).sum(axis=1)
        better = new_cost <= cost
        parameters[active[better]], cost[better] = trial[better], new_cost[better]
        residuals[better], jacobian[better] = new_residuals[better], new_jacobian[better]
        damping = np.where(better, 0.2 * damping, 10.0 * damping)
        moving = np.abs(step[:, :2]).max(axis=1) >= _AT_REST_PX
        if not moving.any():
            break
        active, damping, cost = active[moving], damping[moving], cost[moving]
        residuals, jacobian = residuals[moving], jacobian[moving]
    return parameters


def _variance(residuals: FloatArray, weights: FloatArray) -> FloatArray:
    freedom = np.maximum(weights.sum(axis=1) - _PARAMETERS, 1.0)
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
    sigma = MAD_TO_SIGMA * np.nanmedian(size, axis=1)
    kept = np.abs(residuals) <= _OUTLIER_SIGMAS * np.maximum(sigma, 0.3)[:, None]
    return np.asarray(weights * kept)


def _inverse(normal: FloatArray) -> FloatArray:
    """Inverse of (N, P, P) matrices, ridged where they are singular."""
    diagonal = np.einsum("nii->ni", normal)
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12))
    scaled = normal * scale[:, :, None] * scale[:, None, :]
    scaled = scaled + 1e-10 * np.eye(normal.shape[1])
    return np.asarray(np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :])
