# SPDX-License-Identifier: Apache-2.0
"""Edge points of circles by least squares on raw pixels, starting from rough ellipses.

Each rim is cut into sectors. In a sector the level depends on the distance d to the rim as ``I =
inner + (outer - inner) Phi((d - shift) / blur)`` with Phi the normal distribution (an erf edge).
Inner level, outer level and shift belong to the sector, the blur to the circle; no pixel is shared,
so that the shifts of sectors are independent and their sigma follows from the fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.least_squares import MAD_TO_SIGMA
from armscan.kernels.target_edges import fit_sectors, order_by_sector
from armscan.vision.targets.ellipse import BandPixels, Ellipses, Rims, band_pixels, fit_ellipses
from armscan.vision.targets.saddle import APERTURE_SIGMA_PX, RawGrey

LEVEL_SCATTER = 0.03
"""Scatter of the levels along a rim, as a fraction of the contrast."""
_STEPS = 5


@dataclass(frozen=True, slots=True, eq=False)
class EdgeProfiles:
    """Fitted profiles of N circles in K sectors.

    ``shift_px``: (N, K) outward shift of the edge from the rim. ``sigma_px``: (N, K) its standard
    deviation; infinite where a sector has too few pixels. ``inner``, ``outer``: (N, K) levels of
    the two sides. ``misfit``: (N, K) mean squared residual of the sector over that of its circle.
    ``blur_px``: (N,) standard deviation of the edge. ``noise``: (N,) standard deviation of the
    residuals, grey levels.
    """

    shift_px: FloatArray
    sigma_px: FloatArray
    inner: FloatArray
    outer: FloatArray
    misfit: FloatArray
    blur_px: FloatArray
    noise: FloatArray

    @property
    def contrast(self) -> FloatArray:
        """(N, K) outer minus inner level."""
        return self.outer - self.inner


def fit_profiles(
    pixels: BandPixels,
    n_sectors: int,
    blur_px: FloatArray,
    before: EdgeProfiles | None = None,
) -> EdgeProfiles:
    """Fit all sectors of all circles by Gauss-Newton steps.

    ``pixels``: The bands' pixels. ``n_sectors``: K. ``blur_px``: (N,) blur to start from.
    ``before``: An earlier fit: the levels of a circle's sectors are then taken to scatter by
    `LEVEL_SCATTER` of the contrast around their medians. A sector of a small circle has too few
    pixels to tell its levels from its shift; in a large one this changes nothing.
    """
    n_circles = len(blur_px)
    starts = np.zeros(n_circles * n_sectors + 1, np.int64)
    ordered = np.zeros((2, len(pixels.levels)))
    order_by_sector(
        pixels.levels,
        pixels.distance_px,
        pixels.angle_rad,
        pixels.ellipse,
        n_sectors,
        starts,
        ordered,
    )
    expected = np.zeros((n_circles, 3)) if before is None else _expected(before)
    blur, fits = blur_px.copy(), np.zeros((n_circles * n_sectors, 5))
    fit_sectors(ordered, starts, expected, APERTURE_SIGMA_PX, _STEPS, blur, fits)
    inner, outer, shift, share, square = fits.reshape(n_circles, n_sectors, 5).transpose(2, 0, 1)
    count = np.diff(starts).reshape(n_circles, n_sectors)
    freedom = np.maximum(count.sum(axis=1) - 3.0 * n_sectors - 1.0, 1.0)
    variance = np.maximum(square.sum(axis=1) / freedom, 1e-6)
    own = square / np.maximum(count - 3.0, 1.0)
    typical = np.maximum(np.median(own, axis=1), 1e-6)
    sigma = np.sqrt(share) * np.sqrt(variance)[:, None]
    sigma[count < 5] = np.inf
    misfit = own / typical[:, None]
    return EdgeProfiles(shift, sigma, inner, outer, misfit, blur, np.sqrt(variance))


def _expected(before: EdgeProfiles) -> FloatArray:
    """Levels (N, 2) of an earlier fit and, in column 3, the weight in pixels that they have."""
    inner, outer = np.median(before.inner, axis=1), np.median(before.outer, axis=1)
    contrast = np.maximum(np.abs(outer - inner), 1e-6)
    return np.stack([inner, outer, (before.noise / (LEVEL_SCATTER * contrast)) ** 2], axis=-1)


SECTOR_PX = 4.0
"""Arc length of a sector, px."""
BAND_BLURS = 3.5
"""Half width of the band along a rim, in standard deviations of the edge."""
MIN_SECTORS, MAX_SECTORS = 8, 96
_ROUNDS = 3
_FIRST_BAND_PX = 6.0
_MIN_CONTRAST = 0.35
_MAX_MISFIT = 9.0
_OUTLIER_SIGMAS = 4.5
_MIN_EDGE_FRACTION = 0.5
_MAX_SHAPE_CHANGE = 1.5
_MAX_UNEVENNESS = 0.5
_MAX_SLOPE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredCircles:
    """Edge points of N circles in K sectors.

    ``points_px``: (N, K, 2) edge points, image pixels. ``sigma_px``: (N, K) standard deviation
    along the normal; infinite where a sector was rejected. ``is_good``: (N,) False where too few
    sectors show an edge, or they lie on no ellipse. ``ellipses``: The fits. ``blur_px``: (N,)
    standard deviation of the edges. ``contrast_levels``: (N,) level outside minus level inside.
    """

    points_px: FloatArray
    sigma_px: FloatArray
    is_good: BoolArray
    ellipses: Ellipses
    blur_px: FloatArray
    contrast_levels: FloatArray


def measure_circles(
    grey: RawGrey,
    centres_px: FloatArray,
    shapes_px2: FloatArray,
    min_contrast_levels: float,
    max_band_px: FloatArray | float = np.inf,
) -> MeasuredCircles:
    """Measure circles on raw pixels.

    ``grey``: (H, W) raw levels. ``centres_px``, ``shapes_px2``: (N, 2) and (N, 2, 2): ellipses to
    about 2 px; ``d' S^-1 d = 1`` on the rim. ``min_contrast_levels``: Circles with less contrast
    are not good. ``max_band_px``: (N,) largest half width of the band of pixels looked at, where
    other edges are near.
    """
    rims = Rims.from_shapes(centres_px, shapes_px2)
    perimeter = float(np.median(np.pi * rims.half_px.sum(axis=1)))
    n_sectors = int(np.clip(round(perimeter / SECTOR_PX), MIN_SECTORS, MAX_SECTORS))
    width: FloatArray = np.maximum(_FIRST_BAND_PX, 0.15 * rims.half_px[:, 0])
    gradient = np.zeros((len(rims), 2))
    blur = np.ones(len(rims))
    angle = np.asarray((np.arange(n_sectors) + 0.5) * (2.0 * np.pi / n_sectors), np.float64)
    before: EdgeProfiles | None = None
    for _ in range(_ROUNDS):
        width = np.minimum(np.minimum(width, max_band_px), _widest(rims))
        pixels = band_pixels(grey, rims, width, gradient)
        before = profiles = fit_profiles(pixels, n_sectors, blur, before)
        points, sigma = _edge_points(rims, angle, profiles)
        ellipses, sigma = _robust_fit(points, sigma)
        gradient = gradient + _remaining_gradient(rims, points, profiles)
        rims = _updated(rims, ellipses)
        blur = profiles.blur_px
        width = BAND_BLURS * blur + 1.0
    contrast = np.median(profiles.contrast, axis=1)
    is_good = ellipses.is_ellipse & (np.abs(contrast) >= min_contrast_levels)
    is_good &= np.isfinite(sigma).mean(axis=1) >= _MIN_EDGE_FRACTION
    is_good &= np.hypot(*(rims.centres_px - centres_px).T) < 0.5 * rims.half_px[:, 0]
    return MeasuredCircles(points, sigma, is_good, ellipses, blur, contrast)


def _widest(rims: Rims) -> FloatArray:
    """Half width within which the nearest rim point is unique and the middle is left out."""
    short, long = rims.half_px.T
    return np.asarray(np.maximum(1.5, np.minimum(0.7 * short, 0.9 * short**2 / long)))


def _edge_points(
    rims: Rims, angle: FloatArray, profiles: EdgeProfiles
) -> tuple[FloatArray, FloatArray]:
    """Edge points, and sigma with rejected sectors at infinity."""
    points, normals, curvature = rims.points(angle)
    # Blur moves the middle level of a convex edge inwards by half its variance times curvature.
    shift = profiles.shift_px + 0.5 * profiles.blur_px[:, None] ** 2 * curvature
    typical = np.median(profiles.contrast, axis=1)[:, None]
    is_edge = profiles.contrast * np.sign(typical) > _MIN_CONTRAST * np.abs(typical)
    is_edge &= profiles.misfit < _MAX_MISFIT
    sigma = np.where(is_edge, profiles.sigma_px, np.inf)
    return points + shift[..., None] * normals, sigma


def _robust_fit(points: FloatArray, sigma: FloatArray) -> tuple[Ellipses, FloatArray]:
    """Fit, drop sectors far off their ellipse, fit again; sigma inflated where chi2 asks for it."""
    ellipses = fit_ellipses(points, sigma**-2.0)
    for _ in range(2):
        distance = ellipses.distance_px(points)
        used = np.isfinite(sigma)
        scaled = np.where(used, np.abs(distance) / np.where(used, sigma, 1.0), np.nan)
        scaled[~used.any(axis=1)] = 0.0
        typical = np.maximum(1.0, MAD_TO_SIGMA * np.nanmedian(scaled, axis=1))
        sigma = np.where(scaled <= _OUTLIER_SIGMAS * typical[:, None], sigma, np.inf)
        ellipses = fit_ellipses(points, sigma**-2.0)
    excess = ellipses.chi2 / np.maximum(ellipses.degrees_of_freedom, 1.0)
    sigma = sigma * np.sqrt(np.maximum(1.0, excess))[:, None]
    return fit_ellipses(points, sigma**-2.0), sigma


def _remaining_gradient(rims: Rims, points: FloatArray, profiles: EdgeProfiles) -> FloatArray:
    """Relative slope (N, 2) per px of the illumination, from the light side of all sectors.

    A slope across the band would shift all edges of a circle alike: by 0.004 px where half the
    light is lost across an image of 3072 px and the blur is 2 px.
    """
    is_dark_inside = np.median(profiles.contrast, axis=1) > 0.0
    light = np.where(is_dark_inside[:, None], profiles.outer, profiles.inner)
    mean = np.maximum(np.median(light, axis=1), 1e-6)
    relative = light / mean[:, None] - 1.0
    used = np.isfinite(profiles.sigma_px) & (np.abs(relative) < _MAX_UNEVENNESS)
    offset = points - rims.centres_px[:, None]
    design = np.concatenate([offset, np.ones((*offset.shape[:2], 1))], axis=2) * used[..., None]
    normal = design.transpose(0, 2, 1) @ design + 1e-6 * np.eye(3)
    rhs = design.transpose(0, 2, 1) @ (relative * used)[..., None]
    slope: FloatArray = np.linalg.solve(normal, rhs)[:, :2, 0]
    return np.clip(slope, -_MAX_SLOPE, _MAX_SLOPE)


def _updated(rims: Rims, ellipses: Ellipses) -> Rims:
    """The fitted rims; a fit that ran away leaves the rim as it was."""
    usable = ellipses.is_ellipse & (ellipses.degrees_of_freedom > 0.0)
    safe = ellipses.circles_where(~usable, rims.centres_px)
    half, directions = safe.axes()
    centres, _ = safe.centres()
    ratio = np.abs(np.log(half / rims.half_px)).max(axis=1)
    usable &= ratio < np.log(_MAX_SHAPE_CHANGE)
    return Rims(
        np.where(usable[:, None], centres, rims.centres_px),
        np.where(usable[:, None], half, rims.half_px),
        np.where(usable[:, None, None], directions, rims.directions),
    )
