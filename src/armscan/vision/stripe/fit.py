# SPDX-License-Identifier: Apache-2.0
"""Noise-weighted profile fits at ridge points, and the noise model from their residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.chains import find_other_lines
from armscan.kernels.profile_fit import (
    AMPLITUDE,
    CENTRE,
    FIT_COLUMNS,
    REACH_SIGMAS,
    SIDE_SPAN,
    SIGMA,
    VARIANCE,
    fit_profiles,
    read_sides,
)
from armscan.vision.stripe.image import StripePlane
from armscan.vision.stripe.ridge import (
    SHORTEST_PX,
    RidgePoints,
    chain_bounds,
    chain_lengths_px,
    mean_along,
)

START_CONTRAST2 = 0.03
START_PER_GAIN = 0.1
BIN_EDGES = np.array([0.0, 0.01, 0.03, 0.07, 0.13, 0.22, 0.33, 0.46, 0.6, 0.75, 0.9, 1.2])
LEAST_PER_BIN = 30
LEAST_VARIANCE = 0.02
FIT_PARAMETERS = 3.0


def start_noise(background_noise: float) -> FloatArray:
    """A first guess (3,) of ``C^2``, ``1 / gain``, ``read^2`` from the background's noise."""
    return np.array([START_CONTRAST2, START_PER_GAIN, max(background_noise**2, LEAST_VARIANCE)])


def estimate_noise(
    seen: _Profiles, section: FloatArray, peak: float, fallback: FloatArray
) -> FloatArray:
    """Fit ``v = C^2 m^2 + (m + background) / gain + read^2`` to squared residuals.

    The residuals are binned by the line's own grey level ``m``; each bin gives a robust variance,
    and non-negative least squares gives the three terms.

    ``seen``: profiles fitted with any sensible weights. ``section``: (4,) that they were fitted
    with. ``peak``: amplitude of the bright ones. ``fallback``: (3,) what to return if there are too
    few residuals.
    """
    level, total, residual = _residuals(seen, _lines(seen, section)[0])
    bins = np.digitize(level / peak, BIN_EDGES)
    rows, variances, counts = [], [], []
    for b in range(1, len(BIN_EDGES)):
        inside = bins == b
        if inside.sum() < LEAST_PER_BIN:
            continue
        m = level[inside]
        rows.append([np.mean(m * m), np.mean(np.maximum(total[inside], 0.0)), 1.0])
        typical = robust_sigma(residual[inside])
        clipped = np.minimum(residual[inside] ** 2, (3.5 * typical) ** 2)
        variances.append(max(float(clipped.mean()), LEAST_VARIANCE))
        counts.append(inside.sum())
    if len(rows) < 4:
        return fallback
    variance = np.array(variances)
    weight = np.sqrt(np.array(counts)) / variance
    terms, _ = nnls(np.array(rows) * weight[:, None], variance * weight)
    terms[2] = max(terms[2], LEAST_VARIANCE)
    return np.asarray(terms)


@dataclass(frozen=True, slots=True, eq=False)
class _Profiles:
    """Pixels (N, K) of fitted profiles.

    ``u``: distance from the centre in sigmas. ``bell``: the Gaussian on its ground. ``background``:
    beside the line. ``above``: grey level over it. ``ground``: reflectance, (1, 1) if even.
    ``is_inside``: in the image. ``is_known``: and not clipped. ``is_column``: (N,).
    """

    u: FloatArray
    bell: FloatArray
    background: FloatArray
    above: FloatArray
    ground: FloatArray
    is_inside: BoolArray
    is_known: BoolArray
    is_column: BoolArray


def _profiles(
    plane: StripePlane, points: FloatArray, sides: FloatArray, fits: FloatArray
) -> _Profiles:
    image = plane.image
    is_column = points[:, 5] == 0
    start = np.where(is_column, points[:, 1], points[:, 0])
    sigma = fits[:, SIGMA]
    reach = int(np.ceil(np.quantile(sigma, 0.9) * SIDE_SPAN / 2.0))
    y, x, k, is_inside = _pixels(plane, points, start, reach)
    u = (k - fits[:, CENTRE][:, None]) / sigma[:, None]
    bell = fits[:, AMPLITUDE][:, None] * np.exp(-0.5 * u * u)
    ramp = (sides[:, 1] - sides[:, 0]) / (SIDE_SPAN * sigma)
    background = sides.mean(axis=1)[:, None] + ramp[:, None] * (k - start[:, None])
    is_known = is_inside
    if plane.clipped.shape == image.shape:
        is_known = is_inside & (plane.clipped[y, x] == 0)
    ground = plane.reflectance.astype(np.float64)
    if ground.shape == image.shape:
        ground = ground[y, x]
        background, bell = background * ground, bell * ground
    above = image[y, x] - background
    return _Profiles(u, bell, background, above, ground, is_inside, is_known, is_column)


def _lines(seen: _Profiles, section: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, K) line's own grey level, and how it falls with u: eq. of `kernels.profile_fit`."""
    of_axis = np.where(seen.is_column[:, None], section[:2], section[2:])
    c3, c4 = of_axis[:, :1], of_axis[:, 1:]
    u = seen.u
    third = u * (u * u - 3.0)
    shape = 1.0 + c3 * third + c4 * (u * u * (u * u - 6.0) + 3.0)
    falling = u * shape - 3.0 * c3 * (u * u - 1.0) - 4.0 * c4 * third
    return seen.bell * np.maximum(shape, 0.0), seen.bell * falling


def _residuals(seen: _Profiles, model: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Model level, model plus background, and residual of every pixel of the fitted profiles."""
    residual = seen.above - model
    pixels = (np.abs(seen.u) < REACH_SIGMAS) & seen.is_inside
    n = pixels.sum(axis=1, keepdims=True)
    freedom = np.sqrt(n / np.maximum(n - FIT_PARAMETERS, 1.0))
    is_side = (np.abs(seen.u) > 3.4) & (np.abs(seen.u) < 4.2) & seen.is_inside
    residual = np.where(pixels, residual * freedom, residual)
    use = pixels | is_side
    return model[use], (model + seen.background)[use], residual[use]


MOST_SECTION = np.array([0.12, 0.03])
"""Larger terms would turn the flank of the section negative."""
ROBUST_ROUNDS = 8
CLIPPED_SCORE = 0.7
"""Of one profile, in scatters: next to a median, so that a minority at edges hardly counts."""
CORE_SIGMAS = 1.3
"""Profiles that are clipped farther out say nothing of the section: their flanks alone are left."""


def estimate_section(
    seen: _Profiles,
    noise: FloatArray,
    section: FloatArray,
    is_alone: BoolArray,
    chain: IntArray,
) -> FloatArray:
    """Shape (4,) of the line's own section: what all fitted profiles of an axis have in common.

    A laser whose light leans to one side moves the centre of a Gaussian fit by an amount that
    follows the weights, and with them the brightness. Terms of third and fourth order that all
    profiles share are therefore made part of the model; what single profiles have beside them
    stays the sign of an edge.

    ``seen``: pixels of the fitted profiles. ``noise``: (3,). ``section``: (4,) of the fit.
    ``is_alone``: (N,) profiles that no other line is near. ``chain``: (N,) increasing numbers.
    """
    u = seen.u
    has_core = ~((np.abs(u) < REACH_SIGMAS) & (np.abs(u) > CORE_SIGMAS) & ~seen.is_known).any(
        axis=1
    )
    third, fourth = seen.bell * u * (u * u - 3.0), seen.bell * (u * u * (u * u - 6.0) + 3.0)
    normal, score = _beside_fit(seen, noise, section, np.stack([third, fourth], axis=2))
    found = section.copy()
    for axis, is_own in enumerate((seen.is_column, ~seen.is_column)):
        rows = np.flatnonzero(is_own & has_core & is_alone)
        blocks = _blocks(chain[rows])
        if len(blocks) >= LEAST_BLOCKS:
            own = slice(2 * axis, 2 * axis + 2)
            found[own] = _common_terms(normal[rows], score[rows], section[own], blocks)
    return found


def _beside_fit(
    seen: _Profiles, noise: FloatArray, section: FloatArray, terms: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal matrices (N, T, T) and scores (N, T) of terms (N, K, T) that the model lacks.

    They count beside what centre, amplitude and width take up already.
    """
    model, falling = _lines(seen, section)
    variance = noise[0] * model**2 + noise[1] * np.maximum(model + seen.background, 0.0) + noise[2]
    weight = ((np.abs(seen.u) < REACH_SIGMAS) & seen.is_known) / variance
    fitted = np.stack([falling, model, falling * seen.u], axis=2)
    weighted = weight[:, :, None] * fitted
    taken = np.linalg.pinv(np.einsum("nki,nkj->nij", weighted, fitted))
    taken = taken @ np.einsum("nki,nkj->nij", weighted, terms)
    rest = terms - fitted @ taken
    weighted = weight[:, :, None] * rest
    normal = np.einsum("nki,nkj->nij", weighted, rest)
    return normal, np.einsum("nki,nk->ni", weighted, seen.above - model)


def estimate_black(seen: _Profiles, noise: FloatArray, section: FloatArray) -> float:
    """What the reflectance is too large by everywhere: the camera's black level, or other light.

    A camera that shows darkness as some grey levels, and ink that is not as dark for the laser as
    for the room's light, make dark print seem lighter or darker than it is under the line.
    """
    light = _lines(seen, section)[0] / seen.ground
    normal, score = _beside_fit(seen, noise, section, -light[:, :, None])
    normal, score = normal[:, 0, 0], score[:, 0]
    size = np.sqrt(np.maximum(normal, 1e-12))
    keep, black = np.ones(len(score)), 0.0
    for _ in range(ROBUST_ROUNDS):
        black = float((keep * score).sum() / max(float((keep * normal).sum()), 1e-12))
        ratio = (score - normal * black) / size
        scatter = max(robust_sigma(ratio), 1.0)
        keep = np.minimum(1.0, CLIPPED_SCORE * scatter / np.maximum(np.abs(ratio), 1e-12))
    sigma = CERTAIN_SIGMAS * scatter / np.sqrt(max(float((keep * normal).sum()), 1e-12))
    return float(black * max(1.0 - (sigma / max(abs(black), 1e-12)) ** 2, 0.0))


def _blocks(chain: IntArray) -> list[IntArray]:
    """Rows of each stretch of `BLOCK` neighbours on one chain."""
    inner = np.flatnonzero(np.diff(chain) != 0) + 1
    return [
        rows[first : first + BLOCK]
        for rows in np.split(np.arange(len(chain)), inner)
        for first in range(0, len(rows) - BLOCK + 1, BLOCK)
    ]


def _common_terms(
    normal: FloatArray, score: FloatArray, start: FloatArray, blocks: list[IntArray]
) -> FloatArray:
    """(2,) terms that profiles share, of their normal matrices (N, 2, 2) and scores (N, 2).

    They are shrunk by how far stretches of the line differ from each other: what comes and goes
    along the line is the surface's.
    """
    size = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-12))
    step, scatter = np.zeros(2), np.ones(2)
    keep = np.ones(score.shape)
    for _ in range(ROBUST_ROUNDS):
        total = np.einsum("ni,nij->ij", keep, normal)
        step = np.linalg.lstsq(total, (keep * score).sum(axis=0), rcond=None)[0]
        ratio = (score - normal @ step) / size
        scatter = np.maximum([robust_sigma(one) for one in ratio.T], 1.0)
        keep = np.minimum(1.0, CLIPPED_SCORE * scatter / np.maximum(np.abs(ratio), 1e-12))
    terms = np.clip(start + step, -MOST_SECTION, MOST_SECTION)
    rest = score - normal @ step
    diagonal = np.einsum("nii->ni", normal)
    apart = np.array([rest[b].sum(axis=0) / diagonal[b].sum(axis=0) for b in blocks])
    differ = np.array([robust_sigma(one) for one in apart.T])
    sigma = CERTAIN_SIGMAS * differ / np.sqrt(len(blocks))
    certain = np.maximum(1.0 - (sigma / np.maximum(np.abs(terms), 1e-12)) ** 2, 0.0)
    return np.asarray(terms * certain * terms**2 / np.maximum(terms**2 + differ**2, 1e-12))


BLOCK = 16
LEAST_BLOCKS = 4
CERTAIN_SIGMAS = 2.0


NOISE_SAMPLE = 1500
NOISE_ROUNDS = 2
SECTION_ROUNDS = 2
"""More of them where the section is no Gaussian."""
SIDE_HALF = 8
"""Neighbours over which the background beside the line is averaged."""
CLEAR_SIGMAS = 11.0
"""Another line within this many sigmas may light up the background beside a slanted line."""
LEAST_REACH_PX = 6.0
FOOT_SIGMAS = 3.2
LEAST_REACH_SIGMAS = 1.4
"""The window shrinks beside another line, so that its foot stays outside."""


@dataclass(frozen=True, slots=True, eq=False)
class ProfileFits:
    """Result of fitting the cross-section at each ridge point.

    ``ridge``: The ridge points, only those whose fit succeeded. ``values``: (N, 8) columns as named
    in `armscan.kernels.profile_fit`. ``sides``: (N, 2) background on the lower and upper side,
    averaged along the line. ``side_sigma``: (N,) standard deviation of the difference of the two
    sides. ``neighbour``: (N, 2) distance to the nearest other line on the lower and upper side, in
    px. ``noise``: (3,) ``C^2``, ``1 / gain``, ``read^2``. ``section``: (4,) shape of the line's own
    section: see `estimate_section`. ``is_noise_assumed``: True if there were too few residuals to
    estimate the noise, so that it is the first guess. ``ground``: (N, 2) reflectance under the
    line, weighted as the line lights it, and its standard deviation across the line over that.
    """

    ridge: RidgePoints
    values: FloatArray
    sides: FloatArray
    side_sigma: FloatArray
    neighbour: FloatArray
    noise: FloatArray
    section: FloatArray
    is_noise_assumed: bool
    ground: FloatArray

    @property
    def lean(self) -> FloatArray:
        """(N,) third-order term of the line's own section."""
        is_column = self.ridge.table[:, 5] == 0
        return np.asarray(np.where(is_column, self.section[0], self.section[2]))


def axis_component(table: FloatArray) -> FloatArray:
    """(N,) size of the normal's component along the fitted column or row."""
    rows = np.arange(len(table))
    return np.abs(table[rows, 3 - table[:, 5].astype(np.int64)])


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
    sigma = line_sigma_px / np.maximum(axis_component(table), 0.5)
    neighbour = _neighbours(plane, ridge, line_sigma_px)
    room = neighbour.min(axis=1) / line_sigma_px - FOOT_SIGMAS
    reach = np.clip(room, LEAST_REACH_SIGMAS, REACH_SIGMAS)
    is_clear = neighbour > CLEAR_SIGMAS * line_sigma_px
    sides, side_sigma = _sides(plane, ridge, sigma, is_clear, background_noise)
    guess = noise = start_noise(background_noise)
    section = np.zeros(4)
    pick = np.arange(0, len(table), max(len(table) // NOISE_SAMPLE, 1))
    for round_ in range(NOISE_ROUNDS + SECTION_ROUNDS):
        if round_ >= NOISE_ROUNDS and not section.any():
            break
        sample = np.zeros((len(pick), FIT_COLUMNS))
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
        seen = _profiles(plane, table[at], sides[at], sample[good])
        peak = float(np.quantile(sample[good, AMPLITUDE], 0.9))
        noise = estimate_noise(seen, section, peak, noise)
        is_alone = reach[at] >= REACH_SIGMAS
        section = estimate_section(seen, noise, section, is_alone, ridge.chain[at])
        if plane.reflectance.size > 1:
            plane = plane.with_black(estimate_black(seen, noise, section))
    values = np.zeros((len(table), FIT_COLUMNS))
    ground = plane.reflectance
    fit_profiles(
        plane.image, plane.clipped, ground, table, sigma, sides, noise, section, reach, values
    )
    good = values[:, VARIANCE] > 0.0
    return ProfileFits(
        ridge.select(good),
        values[good],
        sides[good],
        side_sigma[good],
        neighbour[good],
        noise,
        section,
        is_noise_assumed=noise is guess,
        ground=_ground(plane, table[good], values[good]),
    )


def _ground(plane: StripePlane, points: FloatArray, fits: FloatArray) -> FloatArray:
    """(N, 2) mean reflectance under each line, and how much of it the ground differs there."""
    if plane.reflectance.size == 1 or not len(points):
        return np.tile([1.0, 0.0], (len(points), 1))
    reach = REACH_SIGMAS * float(np.quantile(fits[:, SIGMA], 0.9))
    y, x, k, _ = _pixels(plane, points, fits[:, CENTRE], int(np.ceil(reach)))
    light = np.exp(-0.5 * ((k - fits[:, CENTRE, None]) / fits[:, SIGMA, None]) ** 2)
    light /= light.sum(axis=1, keepdims=True)
    ground = plane.reflectance[y, x]
    mean = (light * ground).sum(axis=1)
    spread = np.sqrt((light * (ground - mean[:, None]) ** 2).sum(axis=1))
    return np.stack([mean, spread / mean], axis=1)


def _pixels(
    plane: StripePlane, points: FloatArray, centre: FloatArray, reach: int
) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
    """Rows, columns and running coordinate (N, K) of the pixels within reach of each centre (N,).

    Beyond the image's border rows and columns are those of the border; the mask (N, K) tells.
    """
    height, width = plane.image.shape
    is_column = (points[:, 5] == 0)[:, None]
    line = np.where(is_column, points[:, :1], points[:, 1:2]).astype(np.int64)
    k: IntArray = np.rint(centre).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    safe = np.clip(k, 0, np.asarray(np.where(is_column, height, width)) - 1)
    return np.where(is_column, safe, line), np.where(is_column, line, safe), k, k == safe


def _neighbours(plane: StripePlane, ridge: RidgePoints, line_sigma_px: float) -> FloatArray:
    height, width = plane.image.shape
    length = chain_lengths_px(ridge.table[:, :2], ridge.chain)
    distance = np.zeros((len(ridge), 2))
    reach = max(CLEAR_SIGMAS * line_sigma_px, LEAST_REACH_PX)
    is_line = (length >= SHORTEST_PX).astype(np.int64)
    bounds = chain_bounds(ridge.chain)
    find_other_lines(ridge.table, ridge.chain, *bounds, is_line, height, width, reach, distance)
    return distance


def _sides(
    plane: StripePlane,
    ridge: RidgePoints,
    sigma: FloatArray,
    is_clear: BoolArray,
    background_noise: float,
) -> tuple[FloatArray, FloatArray]:
    """Background on both sides, averaged along the line, and the sigma of their difference.

    Both are of light on ground of reflectance 1. A side that another line lights up takes the value
    of the other side.
    """
    raw, ground = np.zeros((len(ridge), 4)), np.ones((len(ridge), 4))
    read_sides(plane.image, ridge.table, sigma, raw)
    if plane.reflectance.size > 1:
        read_sides(plane.reflectance, ridge.table, sigma, ground)
    count = raw[:, 1::2] * is_clear
    seen = np.where(raw[:, 1::2] > 0.0, ground[:, 0::2], 1.0)
    level, weight = raw[:, 0::2] / seen, count * seen**2
    stretch = _axis_runs(ridge)
    places = np.minimum(np.subtract(*chain_bounds(stretch)[::-1]), 2 * SIDE_HALF + 1)
    total = np.stack([mean_along(np.ones(len(ridge)), c, stretch, SIDE_HALF) for c in weight.T], 1)
    mean = np.stack(
        [mean_along(v, c, stretch, SIDE_HALF) for v, c in zip(level.T, weight.T, strict=True)], 1
    )
    has_own = (total > 0.0) & is_clear
    lowest = np.where(raw[:, 1::2] > 0.0, level, np.inf).min(axis=1)
    lowest = np.where(np.isfinite(lowest), lowest, 0.0)[:, None]
    sides = np.where(has_own, mean, np.where(has_own[:, ::-1], mean[:, ::-1], lowest))
    pixels = np.where(has_own.all(axis=1), count.min(axis=1), 1.0) * places
    on_ground = background_noise / seen.min(axis=1)
    return sides, on_ground * np.sqrt(2.0 / np.maximum(pixels, 1.0))


def _axis_runs(ridge: RidgePoints) -> IntArray:
    """Number the stretches of a chain that keep the same axis, so that sides do not swap."""
    axis = ridge.table[:, 5]
    is_new = np.concatenate([[0], (np.diff(ridge.chain) != 0) | (np.diff(axis) != 0)])
    return np.cumsum(is_new).astype(np.int64)
