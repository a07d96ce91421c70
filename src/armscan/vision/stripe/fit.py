# SPDX-License-Identifier: Apache-2.0
"""Noise-weighted profile fits at ridge points, and the noise model from their residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.arrays import COLUMN, ROW
from armscan.kernels.chains import find_other_lines
from armscan.kernels.stripe.profile_fit import (
    AMPLITUDE,
    CENTRE,
    FIT_COLUMNS,
    FOOT_SIGMAS,
    REACH_SIGMAS,
    SIDE_FAR,
    SIGMA,
    VARIANCE,
    average_sides,
    begin_fits,
    fit_profiles,
    read_sides,
    side_span,
)
from armscan.kernels.stripe.section import (
    BIN_MEANS,
    BLACK_NORMAL,
    BLACK_SCORE,
    HAS_CORE,
    NORMAL_00,
    NORMAL_01,
    NORMAL_11,
    SCORE_0,
    SCORE_1,
    SECTION_COLUMNS,
    bin_residuals,
    common_terms,
    weigh_section,
)
from armscan.vision.stripe.image import StripePlane
from armscan.vision.stripe.ridge import (
    SHORTEST_PX,
    RidgePoints,
    chain_bounds,
    chain_extents,
    median_along,
    widths_at,
)

START_CONTRAST2 = 0.03
START_PER_GAIN = 0.1
BIN_EDGES = np.array(
    [0.0, 0.01, 0.03, 0.07, 0.13, 0.22, 0.33, 0.46, 0.6, 0.75, 0.9, 1.2, 1.7, 2.5, 4.0, 8.0]
)
LEAST_PER_BIN = 30
LEAST_VARIANCE = 0.02
VARIANCE_SAMPLING = 3.0
"""Relative variance of a bin's clipped mean square, times its count."""
VARIANCE_MISFIT = 0.2
"""What three terms leave of the noise's rise with the level, of a bin's variance."""
VARIANCE_ROUNDS = 3


def start_noise(background_noise: float) -> FloatArray:
    """A first guess (3,) of ``C^2``, ``1 / gain``, ``read^2`` from the background's noise."""
    return np.array([START_CONTRAST2, START_PER_GAIN, max(background_noise**2, LEAST_VARIANCE)])


def estimate_noise(
    pixels: FloatArray, n_pixels: int, peak: float, fallback: FloatArray
) -> FloatArray:
    """Fit ``v = C^2 m^2 + (m + background) / gain + read^2`` to squared residuals.

    The residuals are binned by the line's own grey level ``m``; each bin gives a robust variance,
    and non-negative least squares gives the three terms. A bin of which the fit says too much by
    some factor counts as one of which it says too little by it, and thousands of faint pixels no
    more than a hundred bright ones: of lines unlike each other in one image, each has its say.

    ``pixels``: (3, >= n) of `kernels.stripe.section.weigh_section`, ``n_pixels`` of which count.
    ``peak``: amplitude of the bright ones. ``fallback``: (3,) what to return if there are too few
    residuals.
    """
    bins = np.zeros((len(BIN_EDGES) - 1, BIN_MEANS))
    bin_residuals(pixels, n_pixels, BIN_EDGES * peak, bins)
    count, square, light, spread = bins[bins[:, 0] >= LEAST_PER_BIN].T
    if len(count) < 4:
        return fallback
    variance = np.maximum(spread, LEAST_VARIANCE)
    rows = np.stack([square, light, np.ones_like(count)], axis=1)
    certain = 1.0 / np.sqrt(VARIANCE_SAMPLING / count + VARIANCE_MISFIT**2)
    terms = fallback
    for _ in range(VARIANCE_ROUNDS):
        weight = certain / np.sqrt((rows @ terms) * variance)
        terms = np.asarray(nnls(rows * weight[:, None], variance * weight)[0])
        terms[2] = max(terms[2], LEAST_VARIANCE)
    return terms


MOST_SECTION = np.array([0.12, 0.03])
"""Larger terms would turn the flank of the section negative."""
ROBUST_ROUNDS = 8
CLIPPED_SCORE = 0.7
"""Of one profile, in scatters: next to a median, so that a minority at edges hardly counts."""


def estimate_section(
    said: FloatArray,
    section: FloatArray,
    is_usable: BoolArray,
    axis: IntArray,
    chain: IntArray,
) -> FloatArray:
    """Shape (4,) of the line's own section: what all fitted profiles of an axis have in common.

    A laser whose light leans to one side moves the centre of a Gaussian fit by an amount that
    follows the weights, and with them the brightness. Terms of third and fourth order that all
    profiles share are therefore made part of the model; what single profiles have beside them
    stays the sign of an edge.

    ``said``: (N, 8) of `kernels.stripe.section.weigh_section`. ``section``: (4,) of the fit.
    ``is_usable``: (N,) profiles whose core is not clipped and that no other line is near.
    ``axis``: (N,) along which each was fitted. ``chain``: (N,) increasing numbers.
    """
    found = section.copy()
    for along in (COLUMN, ROW):
        rows = np.flatnonzero((axis == along) & is_usable)
        block = _blocks(chain[rows])
        if block.max(initial=-1) + 1 >= LEAST_BLOCKS:
            own = slice(2 * along, 2 * along + 2)
            found[own] = _certain_terms(said[rows], section[own], block)
    return found


def _blocks(chain: IntArray) -> IntArray:
    """(N,) number of the stretch of `BLOCK` neighbours on one chain; -1 where less is left."""
    first, stop = chain_bounds(chain)
    place = np.arange(len(chain)) - first
    is_whole = place < (stop - first) // BLOCK * BLOCK
    begins = is_whole & (place % BLOCK == 0)
    return np.where(is_whole, np.cumsum(begins) - 1, -1)


def estimate_black(said: FloatArray) -> float:
    """What the reflectance is too large by everywhere: the camera's black level, or other light.

    A camera that shows darkness as some grey levels, and ink that is not as dark for the laser as
    for the room's light, make dark print seem lighter or darker than it is under the line.

    ``said``: (N, 8) of `kernels.stripe.section.weigh_section`.
    """
    normal, score = said[:, BLACK_NORMAL], said[:, BLACK_SCORE]
    size = np.sqrt(np.maximum(normal, 1e-12))
    keep, black = np.ones(len(score)), 0.0
    for _ in range(ROBUST_ROUNDS):
        black = float((keep * score).sum() / max(float((keep * normal).sum()), 1e-12))
        ratio = (score - normal * black) / size
        scatter = max(robust_sigma(ratio), 1.0)
        keep = np.minimum(1.0, CLIPPED_SCORE * scatter / np.maximum(np.abs(ratio), 1e-12))
    sigma = CERTAIN_SIGMAS * scatter / np.sqrt(max(float((keep * normal).sum()), 1e-12))
    return float(black * max(1.0 - (sigma / max(abs(black), 1e-12)) ** 2, 0.0))


def _certain_terms(said: FloatArray, start: FloatArray, block: IntArray) -> FloatArray:
    """(2,) terms that profiles share, of what they say (N, 8) beside the ``start`` (2,).

    They are shrunk by how far stretches of the line differ from each other: what comes and goes
    along the line is the surface's. ``block``: (N,) number of the stretch.
    """
    step = np.zeros(2)
    common_terms(said, ROBUST_ROUNDS, CLIPPED_SCORE, step)
    terms = np.clip(start + step, -MOST_SECTION, MOST_SECTION)
    normal = said[:, [NORMAL_00, NORMAL_01, NORMAL_01, NORMAL_11]].reshape(-1, 2, 2)
    rest, diagonal = said[:, [SCORE_0, SCORE_1]] - normal @ step, said[:, [NORMAL_00, NORMAL_11]]
    inside = block >= 0
    sums = [
        [np.bincount(block[inside], one[inside, k]) for one in (rest, diagonal)] for k in (0, 1)
    ]
    # a stretch whose profiles say nothing of a term differs in nothing
    differ = np.array(
        [robust_sigma(apart[weight > 0.0] / weight[weight > 0.0]) for apart, weight in sums]
    )
    sigma = CERTAIN_SIGMAS * differ / np.sqrt(block.max() + 1)
    certain = np.maximum(1.0 - (sigma / np.maximum(np.abs(terms), 1e-12)) ** 2, 0.0)
    return np.asarray(terms * certain * terms**2 / np.maximum(terms**2 + differ**2, 1e-12))


BLOCK = 16
LEAST_BLOCKS = 4
CERTAIN_SIGMAS = 2.0


NOISE_SAMPLE = 1500
"""Points that noise and section are told from; three quarters to one and a half times as many."""
NOISE_ROUNDS = 2
SECTION_ROUNDS = 2
"""More of them where the section is no Gaussian."""
LEAST_SECTION_PX = 1.0
"""Lines of less sigma have five or six pixels, which tell centre, height and width but no skew
beside them: where a line keeps its place between pixels, that would be its own sampling."""
SIDE_HALF = 8
"""Neighbours over which the background beside the line is averaged."""
CLEAR_SIGMAS = 11.0
"""Another line within this many sigmas may light up the background beside a slanted line."""
LEAST_REACH_PX = 6.0
WIDTH_HALF = 8
"""Neighbours of which the median tells a line's own width."""
OWN_WIDTH_ROUNDS = 2
"""A fit ends at two and a half times the width that its window is made for; two reach farther."""


@dataclass(frozen=True, slots=True, eq=False)
class ProfileFits:
    """Result of fitting the cross-section at each ridge point.

    ``ridge``: The ridge points, only those whose fit succeeded. ``values``: (N, 9) columns as in
    `armscan.kernels.stripe.profile_fit`. ``sides``: (N, 2) background on the lower and upper side,
    averaged along the line. ``side_sigma``: (N,) standard deviation of the difference of the two
    sides. ``neighbour``: (N, 2) distance to the nearest other line on the lower and upper side, in
    px. ``section``: (4,) shape of the line's own
    section: see `estimate_section`. ``is_noise_assumed``: True if there were too few residuals to
    estimate the noise, so that it is the first guess. ``ground``: (N, 2) reflectance under the
    line, weighted as the line lights it, and its standard deviation across the line over that.
    """

    ridge: RidgePoints
    values: FloatArray
    sides: FloatArray
    side_sigma: FloatArray
    neighbour: FloatArray
    section: FloatArray
    is_noise_assumed: bool
    ground: FloatArray


def fit_ridge(
    plane: StripePlane,
    ridge: RidgePoints,
    line_sigma_px: float,
    background_noise: float,
) -> ProfileFits:
    """Fit the line's section with weights from the noise model at every ridge point.

    The noise model and the section's departure from a Gaussian are estimated from a sample of the
    points first. Chains shorter than
    `SHORTEST_PX` are fitted, but do not count as lines beside others.
    """
    table = ridge.table
    start = _begin(plane, ridge, line_sigma_px)
    sigma, reach, neighbour = start.sigma, start.reach, start.neighbour
    sides, side_sigma = _sides(plane, table, start)
    guess = noise = start_noise(background_noise)
    bare, black = plane, 0.0
    section = np.zeros(4)
    pick = np.arange(0, len(table), max(round(len(table) / NOISE_SAMPLE), 1))
    sample = np.zeros((len(pick), FIT_COLUMNS))
    for round_ in range(NOISE_ROUNDS + SECTION_ROUNDS):
        if round_ >= NOISE_ROUNDS and not section.any():
            break
        fit_profiles(
            plane.image,
            plane.clipped,
            plane.reflectance,
            table[pick],
            sigma[pick],
            sides[pick],
            noise,
            section,
            reach[pick],
            sample,
        )
        good = sample[:, VARIANCE] > 0.0
        if good.sum() < LEAST_PER_BIN:
            continue
        at = pick[good]
        fitted = _Sample.of(plane, table[at], sigma[at], sides[at], sample[good])
        peak = _nearly_largest(fitted.fits[:, AMPLITUDE])
        noise = estimate_noise(*fitted.left(noise, section), peak, noise)
        said = fitted.said(noise, section)
        is_usable = (reach[at] >= REACH_SIGMAS) & (said[:, HAS_CORE] > 0.0)
        is_usable &= fitted.fits[:, SIGMA] >= LEAST_SECTION_PX
        axis = table[at, 5].astype(np.int64)
        section = estimate_section(said, section, is_usable, axis, ridge.chain[at])
        if plane.reflectance.size > 1:
            black += estimate_black(fitted.said(noise, section))
            plane = bare.with_black(black)
            sides, side_sigma = _sides(plane, table, start)
    values = np.zeros((len(table), FIT_COLUMNS))
    values[pick] = sample
    ground = plane.reflectance
    fit_profiles(
        plane.image, plane.clipped, ground, table, sigma, sides, noise, section, reach, values
    )
    found = {"values": values, "sides": sides, "side_sigma": side_sigma}
    for _ in range(OWN_WIDTH_ROUNDS):
        _fit_in_own_width(plane, ridge, start, noise=noise, section=section, **found)
    good = values[:, VARIANCE] > 0.0
    if not good.all():
        ridge, values, sides = ridge.select(good), values[good], sides[good]
        side_sigma, neighbour = side_sigma[good], neighbour[good]
    return ProfileFits(
        ridge,
        values,
        sides,
        background_noise * side_sigma,
        neighbour,
        section,
        is_noise_assumed=noise is guess,
        ground=_ground(plane, ridge.table, values),
    )


NARROW, HALF_AS_WIDE, WIDE = 0.7, 0.5, 1.4
"""Typical sigmas below which a line that could not be fitted, and one that could, is fitted again
in windows for its own width, and above which any is."""
NARROWEST = 0.33
"""Narrower still are most dots and edges that a photograph shows beside its lines."""
LEAST_OWN_PX = 50.0
"""Length of chains that are fitted again: corners of print between squares are 15 to 40 px long."""
LARGEST_STEP = 0.05
"""Of the background, over the line's height, with which a wider window is still better."""


def _fit_in_own_width(
    plane: StripePlane,
    ridge: RidgePoints,
    start: _Start,
    *,
    noise: FloatArray,
    section: FloatArray,
    values: FloatArray,
    sides: FloatArray,
    side_sigma: FloatArray,
) -> None:
    """Fit again, in windows for their own width, lines that are much narrower or wider than most.

    An over-exposed line on a bright surface is two and three times as wide as the same one on a
    dark surface, where the window made for it holds glow and edges beside the line. Of a line that
    is wider than its window, the flanks pass for background.

    ``start``: Of all points. ``values``, ``sides``, ``side_sigma``: Input and output; rows stay
    where the second fit fails, too.
    """
    is_long = start.length >= LEAST_OWN_PX
    is_lost = values[:, VARIANCE] == 0.0
    own = np.where(is_lost, np.nan, values[:, SIGMA] / start.sigma)
    lost = np.flatnonzero(is_lost & is_long)
    own[lost] = widths_at(plane.image, ridge.table[lost]) / start.line_sigma_px
    narrow = np.where(is_lost, NARROW, HALF_AS_WIDE)
    at = np.flatnonzero(is_long & ((own < narrow) | (own > WIDE)))
    own = median_along(own, ridge.chain, at, WIDTH_HALF)
    is_narrow = (own > NARROWEST) & (own < narrow[at])
    is_other = is_narrow | _has_room(plane, ridge, at, own, start.line_sigma_px)
    at, own = at[is_other], own[is_other]
    if not len(at):
        return
    table = ridge.table[at]
    again = replace(
        start,
        neighbour=start.neighbour[at],
        sigma=start.sigma[at] * own,
        reach=start.reach[at],
        run=start.run[at],
        length=start.length[at],
    )
    beside, beside_sigma = _sides(plane, table, again)
    fits = np.zeros((len(at), FIT_COLUMNS))
    images = (plane.image, plane.clipped, plane.reflectance)
    fit_profiles(*images, table, again.sigma, beside, noise, section, again.reach, fits)
    step = np.abs(beside[:, 1] - beside[:, 0])
    is_stepped = (own > WIDE) & (step > LARGEST_STEP * fits[:, AMPLITUDE])
    good = (fits[:, VARIANCE] > 0.0) & ~is_stepped
    at = at[good]
    values[at], sides[at], side_sigma[at] = fits[good], beside[good], beside_sigma[good]


def _has_room(
    plane: StripePlane, ridge: RidgePoints, at: IntArray, own: FloatArray, line_sigma_px: float
) -> BoolArray:
    """(M,) True for wider lines, ``own`` (M,) typical sigmas, that no other line's foot reaches.

    The background beside them is read farther out than where other lines were looked for.
    """
    is_wide = own > WIDE
    if is_wide.any():
        needed_px = (SIDE_FAR * own + FOOT_SIGMAS) * line_sigma_px
        away = _other_lines(plane, ridge, float(needed_px[is_wide].max()))[at].min(axis=1)
        is_wide &= away > needed_px
    return is_wide


def _nearly_largest(values: FloatArray) -> float:
    """What nine tenths of some values stay below, between two of them as `numpy.quantile` has it.

    In a fraction of the time that this takes.
    """
    place = 0.9 * (len(values) - 1)
    low, high = int(place), min(int(place) + 1, len(values) - 1)
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + (place - low) * (ordered[high] - ordered[low]))


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """Profiles that were fitted, of which noise and section are told; as for `fit_profiles`.

    ``reach``: Pixels that are looked at on both sides.
    """

    plane: StripePlane
    points: FloatArray
    sigma_px: FloatArray
    sides: FloatArray
    fits: FloatArray
    reach: int

    @classmethod
    def of(
        cls,
        plane: StripePlane,
        points: FloatArray,
        sigma_px: FloatArray,
        sides: FloatArray,
        fits: FloatArray,
    ) -> _Sample:
        """The profiles, looked at as far as the background beside most of them is read."""
        reach = math.ceil(side_span(_nearly_largest(fits[:, SIGMA])) / 2.0)
        return cls(plane, points, sigma_px, sides, fits, reach)

    def left(self, noise: FloatArray, section: FloatArray) -> tuple[FloatArray, int]:
        """(3, >= n) pixels of `weigh_section`, and n."""
        pixels = np.zeros((3, len(self.fits) * (2 * self.reach + 1)))
        n = self._weigh(noise, section, np.zeros((0, SECTION_COLUMNS)), pixels)
        return pixels, n

    def said(self, noise: FloatArray, section: FloatArray) -> FloatArray:
        """(N, 8) of `weigh_section`."""
        said = np.zeros((len(self.fits), SECTION_COLUMNS))
        self._weigh(noise, section, said, np.zeros((3, 0)))
        return said

    def _weigh(
        self, noise: FloatArray, section: FloatArray, said: FloatArray, pixels: FloatArray
    ) -> int:
        images = (self.plane.image, self.plane.clipped, self.plane.reflectance)
        fitted = (self.points, self.sigma_px, self.sides, self.fits)
        return weigh_section(*images, *fitted, noise, section, self.reach, said, pixels)


def _ground(plane: StripePlane, points: FloatArray, fits: FloatArray) -> FloatArray:
    """(N, 2) mean reflectance under each line, and how much of it the ground differs there."""
    if plane.reflectance.size == 1 or not len(points):
        even = np.zeros((len(points), 2))
        even[:, 0] = 1.0
        return even
    reach = int(np.ceil(REACH_SIGMAS * float(np.quantile(fits[:, SIGMA], 0.9))))
    height, width = plane.image.shape
    is_column = (points[:, 5] == COLUMN)[:, None]
    line = np.where(is_column, points[:, :1], points[:, 1:2]).astype(np.int64)
    k: IntArray = np.rint(fits[:, CENTRE, None]).astype(np.int64) + np.arange(-reach, reach + 1)
    safe = np.clip(k, 0, np.asarray(np.where(is_column, height, width)) - 1)
    light = np.exp(-0.5 * ((k - fits[:, CENTRE, None]) / fits[:, SIGMA, None]) ** 2)
    light /= light.sum(axis=1, keepdims=True)
    ground = plane.reflectance[np.where(is_column, safe, line), np.where(is_column, line, safe)]
    mean = (light * ground).sum(axis=1)
    spread = np.sqrt((light * (ground - mean[:, None]) ** 2).sum(axis=1))
    return np.stack([mean, spread / mean], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Where fits begin: as for `begin_fits`.

    ``length``: (N,) of each point's chain in px. ``line_sigma_px``: Typical sigma of the lines.
    """

    neighbour: FloatArray
    sigma: FloatArray
    reach: FloatArray
    run: IntArray
    length: FloatArray
    line_sigma_px: float

    @property
    def clear_px(self) -> float:
        """Distance to other lines beyond which these do not light up what lies beside."""
        return CLEAR_SIGMAS * self.line_sigma_px


def _begin(plane: StripePlane, ridge: RidgePoints, line_sigma_px: float) -> _Start:
    n = len(ridge)
    reach_px = max(CLEAR_SIGMAS * line_sigma_px, LEAST_REACH_PX)
    start = _Start(
        _other_lines(plane, ridge, reach_px),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n, dtype=np.int64),
        length=chain_extents(ridge.table, ridge.chain)[2],
        line_sigma_px=line_sigma_px,
    )
    found = (start.neighbour, line_sigma_px, start.sigma, start.reach, start.run)
    begin_fits(ridge.table, ridge.chain, *found)
    return start


def _other_lines(plane: StripePlane, ridge: RidgePoints, reach_px: float) -> FloatArray:
    """(N, 2) distance to other lines of `find_other_lines`."""
    height, width = plane.image.shape
    first, stop, length = chain_extents(ridge.table, ridge.chain)
    is_line = (length >= SHORTEST_PX).astype(np.int64)
    found = np.zeros((len(ridge), 2))
    given = (ridge.table, ridge.chain, first, stop, is_line)
    find_other_lines(*given, height, width, reach_px, found)
    return found


def _sides(plane: StripePlane, points: FloatArray, start: _Start) -> tuple[FloatArray, FloatArray]:
    """Background (N, 2) of `average_sides`, and the sigma (N,) of its difference, in pixels'."""
    raw, ground = np.zeros((len(points), 4)), np.ones((len(points), 4))
    read_sides(plane.image, points, start.sigma, raw)
    if plane.reflectance.size > 1:
        read_sides(plane.reflectance, points, start.sigma, ground)
    found = np.zeros((len(points), 3))
    given = (start.neighbour, start.clear_px, start.run, SIDE_HALF)
    average_sides(raw, ground, *given, found)
    return np.ascontiguousarray(found[:, :2]), found[:, 2].copy()
