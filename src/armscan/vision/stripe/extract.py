# SPDX-License-Identifier: Apache-2.0
"""From an exposure to the stripe's centre points."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.stripe.profile_fit import ALIKE, AMPLITUDE
from armscan.kernels.stripe.section import (
    EDGE_BLUR_PX2,
    MARK_PULL,
    MARK_SIGMA,
    MARK_WIDTH,
    MOST_PULL,
    widen_sigmas,
)
from armscan.kernels.stripe.smoothing import find_pulls, take_out_bends
from armscan.records.exposure import Exposure
from armscan.records.profile import REJECTING, Profile, StripeFlag
from armscan.vision.stripe.fit import ProfileFits, fit_ridge
from armscan.vision.stripe.flags import (
    MERGED_SIGMAS,
    close_gaps,
    has_laser_colour,
    is_cut_off,
    is_on_known_ground,
    is_saturated,
    is_short,
    mark,
    near_laser_colour,
)
from armscan.vision.stripe.image import (
    EVEN,
    NORMAL_SCALE,
    ROUNDED_PX,
    StripeOptions,
    StripePlane,
    check_background,
    colour_planes,
    is_thresholded,
    laid_under,
    lit_plane,
    mono_plane,
    relative_reflectance,
    softened,
)
from armscan.vision.stripe.ridge import (
    BLUR_PX,
    ImageLevel,
    RidgePoints,
    find_candidates,
    find_line_sigma,
    is_bright,
    is_of_bytes,
    less_noisy,
    measure_level,
    trace_ridges,
)
from armscan.vision.stripe.smooth import UNKNOWN_SCATTER_PX, Polyline, bends, scatter, smooth
from armscan.vision.stripe.thesis import ROUNDING_PX, THESIS_METHODS, link_centres

SPARSE = 4
"""Of the fast way: background and noise are told from a sixteenth and a fourth of the sample."""
LEAST_SIGMA_PX = 0.002
"""What pixel locking and the shape of the profile leave without any noise."""
MOST_LEFT = 0.2
"""Of an edge's pull: the blur leaves more of it on lines of sigma below 3.2 px. Edges lie beside
only a part of such lines, and the points there are better left out."""

NEARLY_ALL = 0.9
"""Of the points of the plane that shows most: the others' plane is better where both show them."""


def extract_stripes(
    exposure: Exposure,
    options: StripeOptions | None = None,
    background: Exposure | None = None,
) -> Profile:
    """Find every laser line in an exposure and return its centre points with their sigma.

    Candidates are runs above the local background; the Hessian at each candidate gives point and
    direction (eq. 2.41); a Gaussian profile (eq. 2.40), with the skew and the tails that all
    profiles of the image have in common, is fitted with weights from the image's own noise; the
    centres are smoothed along the line where its course allows. A photograph whose three channels
    are alike everywhere is grey, whatever colour is asked for. One that somebody made black and
    white is blurred by a pixel first, and its centres are as uncertain as its rounded edges.

    Parameters
    ----------
    exposure
        The image with the laser on.
    options
        Method, laser colour, thresholds; defaults when None.
    background
        The same view with the laser off, or None.

    Returns
    -------
    Profile
        Points in full-sensor pixels; empty if there is no line.

    Raises
    ------
    InputError
        If the background's size or window differs from the exposure's.
    """
    options = options or StripeOptions()
    if exposure.is_colourless and (background is None or background.is_colourless):
        exposure, background = exposure.as_mono(), background and background.as_mono()
    if background is not None:
        check_background(exposure, background)
    if background is not None:
        background = laid_under(background, exposure)
    elif is_thresholded(exposure):
        profile = _extract(softened(exposure), options)
        rounded = ROUNDED_PX * exposure.window.binning
        return replace(profile, sigma_px=np.hypot(profile.sigma_px, rounded))
    return _extract(exposure, options, background)


def _extract(
    exposure: Exposure, options: StripeOptions, background: Exposure | None = None
) -> Profile:
    full_scale = exposure.full_scale / NORMAL_SCALE
    threshold = None if options.threshold is None else options.threshold / full_scale
    if exposure.colour == "mono" and background is None:
        if options.method == "fit":
            plane, level = lit_plane(exposure, threshold)
            if not level.is_noisy:
                return _find(exposure, plane, level, options, threshold)
        if options.method == "fast" and is_of_bytes(exposure.image):
            level = measure_level(exposure.image, threshold, 1.0 / full_scale, SPARSE)
            return _find_fast(exposure, None, level, options)
    planes: tuple[StripePlane, ...]
    if exposure.colour == "mono":
        planes = (mono_plane(exposure, background),)
    else:
        planes = colour_planes(exposure, background, options.laser_colour)
    if background is not None and options.on_print and options.method == "fit":
        ground = relative_reflectance(background, options.laser_colour)
        planes = tuple(replace(plane, reflectance=ground) for plane in planes)
    profiles = [_find_in(exposure, plane, options, threshold) for plane in planes]
    sure = [int(profile.is_sure.sum()) for profile in profiles]
    return profiles[next(k for k, n in enumerate(sure) if n >= NEARLY_ALL * max(sure))]


def _find_in(
    exposure: Exposure, plane: StripePlane, options: StripeOptions, threshold: float | None
) -> Profile:
    level = measure_level(plane.image, threshold)
    if options.method == "fast":
        return _find_fast(exposure, plane, level, options)
    return _find(exposure, plane, level, options, threshold)


def load_stripe_method(method: str) -> None:
    """Import what a method needs besides, so that `load_kernels` finds its loops."""
    if method == "fast":
        importlib.import_module("armscan.vision.stripe.columns")


def _find_fast(
    exposure: Exposure, plane: StripePlane | None, level: ImageLevel, options: StripeOptions
) -> Profile:
    # its loops are compiled only where they are asked for
    from armscan.vision.stripe.columns import extract_fast

    return extract_fast(exposure, plane, level, options)


def _find(
    exposure: Exposure,
    plane: StripePlane,
    level: ImageLevel,
    options: StripeOptions,
    threshold: float | None,
) -> Profile:
    """Points of the lines in a plane, without its ground's reflectance if they are too thin."""
    bare = replace(plane, reflectance=EVEN)
    image, whole, noise = plane.image, level, level.noise
    if plane.reflectance.size > 1:
        image = plane.on_even_ground(image, noise)
        level = measure_level(image, threshold)
    blur = 0.0
    if level.is_noisy and options.method == "fit":
        blur = BLUR_PX
        image, level = less_noisy(image)
    runs = find_candidates(image, level)
    sigma = options.line_sigma_px
    if sigma is None:
        sigma = find_line_sigma(image, runs, level, blur, near_laser_colour(plane.gate))
    if _is_too_thin(plane, sigma):
        return _find(exposure, bare, whole, options, threshold)
    if options.method == "fit":
        ridge = trace_ridges(image, runs, sigma, level.rise)
    else:
        centres = THESIS_METHODS[options.method](image, level, sigma)
        ridge = link_centres(centres, image)
    ridge = _of_laser(plane, ridge, sigma)
    if not len(ridge):
        return Profile.empty(source=exposure.source)
    if options.method != "fit":
        return thesis_profile(exposure, plane, ridge, sigma, ROUNDING_PX.get(options.method, 0.0))
    profile = to_profile(exposure, plane, fit_ridge(plane, ridge, sigma, noise), options)
    width = profile.width_px[profile.is_accepted] / exposure.window.binning
    # where cores are clipped, runs are wider than the line's own sigma
    if len(width) and _is_too_thin(plane, float(np.median(width))):
        return _find(exposure, bare, whole, options, threshold)
    return profile


def _is_too_thin(plane: StripePlane, sigma_px: float) -> bool:
    """True where the ground is known and its blur leaves too much of an edge's pull on a line."""
    left = EDGE_BLUR_PX2 / sigma_px
    return plane.reflectance.size > 1 and left > MOST_LEFT * MOST_PULL * sigma_px


def _of_laser(plane: StripePlane, ridge: RidgePoints, sigma_px: float) -> RidgePoints:
    """Leave out faint chains, what lacks the laser's colour, and what was white without it."""
    ridge = ridge.select(is_bright(ridge))
    if plane.gate is not None and len(ridge):
        ridge = ridge.select(has_laser_colour(plane.gate, ridge.table, ridge.chain, sigma_px))
    if plane.unknown is not None and len(ridge):
        ridge = ridge.select(is_on_known_ground(plane.unknown, ridge.table, sigma_px))
    return ridge


def thesis_profile(
    exposure: Exposure,
    plane: StripePlane,
    ridge: RidgePoints,
    sigma_px: float,
    rounding_px: float,
) -> Profile:
    """Profile of a thesis method: not smoothed, one sigma and one width for all points.

    ``rounding_px`` is the standard deviation of what the method rounds to, which points that follow
    each other in one row or column of pixels share.
    """
    points, normals, chain = ridge.table[:, :2], ridge.table[:, 2:4], ridge.chain
    flags = np.zeros(len(points), np.int64)
    flags[is_saturated(points, plane.saturated)] |= int(StripeFlag.SATURATED)
    flags[is_short(points, chain)] |= int(StripeFlag.SHORT_SEGMENT)
    own = scatter(points, normals, chain)
    if own is None:
        flags |= int(StripeFlag.NOISE_ASSUMED)
    both = UNKNOWN_SCATTER_PX if own is None else math.hypot(max(own, LEAST_SIGMA_PX), rounding_px)
    in_column, in_row = (_run_lengths(place, chain) for place in points.T)
    n_alike = np.maximum(in_column, in_row)
    sigma = np.full(len(points), both)
    return Profile(
        source=exposure.source,
        points_px=exposure.window.to_full_sensor(points),
        normals_px=normals,
        sigma_px=sigma * exposure.window.binning,
        width_px=np.full(len(points), sigma_px * exposure.window.binning),
        intensity=np.maximum(ridge.table[:, 4], 0.0) * plane.grey_levels_per_unit,
        flags=flags,
        segment=chain,
        noise_length=1.0 + (n_alike - 1.0) * (rounding_px / both) ** 2,
    )


def to_profile(
    exposure: Exposure, plane: StripePlane, fits: ProfileFits, options: StripeOptions
) -> Profile:
    """Flag the fitted centres, smooth them along their chains and map them to the full sensor."""
    if not len(fits.ridge):
        return Profile.empty(source=exposure.source)
    marks, flags = mark(fits, plane.saturated)
    points, normals = np.ascontiguousarray(marks[:, :2]), fits.ridge.table[:, 2:4].copy()
    sigma, width = np.maximum(marks[:, MARK_SIGMA], LEAST_SIGMA_PX), marks[:, MARK_WIDTH].copy()
    chain = fits.ridge.chain
    near = (flags & int(StripeFlag.NEIGHBOUR)) != 0
    if near.any():
        near = close_gaps(near, chain, MERGED_SIGMAS * width)
        flags[near] |= int(StripeFlag.NEIGHBOUR)
    if plane.reflectance.size > 1:
        flags |= int(StripeFlag.GROUND_KNOWN)
    flags[is_cut_off(marks, chain, plane.image.shape)] |= int(StripeFlag.END)
    flags[is_short(points, chain)] |= int(StripeFlag.SHORT_SEGMENT)
    usable = (flags & int(REJECTING | StripeFlag.PULLED)) == 0
    # beyond a crossing a chain may follow the other line: nothing is averaged across it
    is_new = (np.diff(chain) != 0) | (np.diff(near) != 0)
    stretch = np.concatenate([[0], np.cumsum(is_new, dtype=np.int64)])
    alike = sigma**2 * fits.values[:, ALIKE]
    course = straighten(Polyline(points, normals, sigma, stretch, usable), fits)
    smoothed = smooth(course, options.smoothing_px)
    flags[smoothed.is_outlier] |= int(StripeFlag.OUTLIER)
    if fits.is_noise_assumed and not smoothed.is_noise_measured:
        flags |= int(StripeFlag.NOISE_ASSUMED)
    binning = exposure.window.binning
    sigma = np.maximum(smoothed.sigma, LEAST_SIGMA_PX)
    noise_length = np.maximum((smoothed.sigma_sum / sigma) ** 2, 1.0)
    sigma = np.hypot(sigma, np.sqrt(alike))
    on_flanks = flags & int(StripeFlag.SATURATED)
    pull = marks[:, MARK_PULL].copy()
    widen_sigmas(fits.ridge.table, fits.section, width, fits.ground, on_flanks, pull, sigma)
    # a step pulls all points beside it alike
    noise_length += (_run_lengths(pull > 0.0, chain) - noise_length) * (pull / sigma) ** 2
    return Profile(
        source=exposure.source,
        points_px=exposure.window.to_full_sensor(smoothed.points),
        normals_px=smoothed.normals,
        sigma_px=sigma * binning,
        width_px=width * binning,
        intensity=fits.values[:, AMPLITUDE] * fits.ground[:, 0] * plane.grey_levels_per_unit,
        flags=flags,
        segment=np.cumsum(np.diff(chain, prepend=chain[:1]) != 0),
        noise_length=noise_length,
    )


def _run_lengths(values: BoolArray | FloatArray, chain: IntArray) -> IntArray:
    """(N,) how many points of one value follow each other along a chain."""
    is_new = (np.diff(values) != 0) | (np.diff(chain) != 0)
    run = np.concatenate([[0], np.cumsum(is_new)])
    return np.asarray(np.bincount(run)[run])


def straighten(course: Polyline, fits: ProfileFits) -> Polyline:
    """Take out the bias of a column or row that cuts a bent line at a slant: `find_pulls`."""
    points, normals, sigma, chain, _ = course.rows
    pull, matters = np.zeros(len(course)), np.zeros(len(course), dtype=np.bool_)
    given = (fits.ridge.table, fits.values, points, normals, sigma, chain)
    if not find_pulls(*given, pull, matters.view(np.uint8)):
        return course
    corrected = points.copy()
    take_out_bends(bends(course, matters), pull, fits.ridge.table, corrected)
    return replace(course, points=corrected)
