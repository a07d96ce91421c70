# SPDX-License-Identifier: Apache-2.0
"""How well a fitted length is known, when the points of an exposure err together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.inspection.results import MeasuredLength
from armscan.records.cloud import PointCloud

MIN_BLOCKS = 4
"""Fewest exposures whose differences say anything about their scatter."""

COARSE_BLOCKS = (12, 6)
"""Consecutive exposures are also taken together in these counts of blocks, as neighbours err alike:
an arm by its posture over a whole stroke, a calibration by the direction from which it looks."""

MOST_EXPOSURES = 1000
"""Neighbouring exposures beyond so many are taken together."""

GROUPS = 24
"""Of neighbouring exposures, taken together to see how their errors go together."""

PACES = (2.0, 5.0, 15.0, 50.0)
"""Exposures over which drifting errors stay alike, of which the data choose."""

SIZES = np.array([0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5, 1e6])
"""Variances of exposures' errors over the stated, of which the data choose; far beyond 1 for clouds
whose calibration knows nothing of what went wrong: a mount that slipped, a clock that lags."""

TURN_SIZES = np.array([1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1e3, 1e4])
"""The same of turns about an exposure's middle, at its points' usual distance from it."""

LEAST_NOISE = 1e-4
"""Least variance of a point's own noise over that which exposures share: exact ones have none."""


@dataclass(frozen=True, slots=True, eq=False)
class FitLinearised:
    """A least-squares fit about its optimum.

    Parameters
    ----------
    jacobian
        (N, P) derivative of each point's residual by the parameters.
    directions
        (N, 3) unit vector along which each point's error changes its residual.
    residuals_mm
        (N,) at the optimum.
    length_by_parameters
        (P,) derivative of the length that is asked for.
    """

    jacobian: FloatArray
    directions: FloatArray
    residuals_mm: FloatArray
    length_by_parameters: FloatArray


def measured_length(
    value_mm: float, fit: FitLinearised, cloud: PointCloud, rows: IntArray
) -> MeasuredLength:
    """A length with both of its standard deviations.

    Parameters
    ----------
    value_mm
        The length.
    fit
        What it follows from.
    cloud
        Source of covariances and exposures.
    rows
        (N,) rows in the cloud of the points of the fit.
    """
    numbers = cloud.exposure[rows]
    n = len(np.unique(numbers))
    groups = [exposure_blocks(numbers, n)]
    groups += [exposure_blocks(numbers, most) for most in COARSE_BLOCKS if n >= 2 * most]
    scatter = [_jackknife_mm(fit, block, count) for block, count in groups]
    known = [sigma for sigma in scatter if math.isfinite(sigma)]
    largest = max(known, default=math.nan)
    return MeasuredLength(value_mm, largest, _propagated_mm(fit, cloud, rows))


def exposure_blocks(exposure: IntArray, most: int) -> tuple[IntArray, int]:
    """(N,) number of the block of neighbouring exposures that each point is in, and their count."""
    number = np.unique(exposure, return_inverse=True)[1].astype(np.int64)
    n = int(number.max()) + 1 if len(number) else 0
    blocks = min(n, most)
    return (number * blocks // n if n else number), blocks


def influence_along(fit: FitLinearised) -> FloatArray:
    """(N,) derivative of the length by each point's error along its direction, up to one sign."""
    information = fit.jacobian.T @ fit.jacobian
    return np.asarray(fit.jacobian @ np.linalg.solve(information, fit.length_by_parameters))


def _jackknife_mm(fit: FitLinearised, block: IntArray, n_blocks: int) -> float:
    """Delete-a-block jackknife of the length, linearised about the optimum."""
    if n_blocks < MIN_BLOCKS:
        return math.nan
    p = fit.jacobian.shape[1]
    normal = np.zeros((n_blocks, p, p))
    right = np.zeros((n_blocks, p))
    for i in range(p):
        right[:, i] = np.bincount(block, fit.jacobian[:, i] * fit.residuals_mm, n_blocks)
        for j in range(p):
            normal[:, i, j] = np.bincount(block, fit.jacobian[:, i] * fit.jacobian[:, j], n_blocks)
    remaining = normal.sum(axis=0) - normal
    if not np.all(np.linalg.cond(remaining) < 1e12):
        return math.nan
    change = np.linalg.solve(remaining, right[:, :, None])[:, :, 0] @ fit.length_by_parameters
    spread = change - change.mean()
    return float(np.sqrt((n_blocks - 1) / n_blocks * (spread @ spread)))


def _propagated_mm(fit: FitLinearised, cloud: PointCloud, rows: IntArray) -> float:
    """From the points' covariances; what exposures share of them is what the residuals tell.

    The stripes' own noise is taken out of the covariances and counted point by point, each with the
    correlation length that neighbours along the stripe share; a cloud that does not tell it is
    taken as independent from point to point. The rest shifts an exposure as a whole. No cloud
    tells whether that is new in each exposure, in each visit (exposures that follow each other
    without a gap), drifts from one to the next, or is one for all, and whether exposures turn
    besides. Each of these ways and sizes counts by how likely it makes the residuals' sums over
    exposures: the variance is the mean over them (Bayesian model averaging, Hoeting et al. 1999).
    NaN for a single exposure: an error of the sensor stretches it, and a shift cannot tell.
    """
    if len(np.unique(cloud.exposure[rows])) < 2 or not cloud.covariance_mm2[rows].any():
        return math.nan
    errors = _ExposureErrors.of(fit, cloud, rows)
    influence = influence_along(fit)
    private = float(influence**2 @ errors.private_mm2)
    return math.sqrt(max(private + _shared_mm2(fit, errors, influence), 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class _ExposureErrors:
    """What N points err by each on their own, and what n exposures may err by as a whole.

    Parameters
    ----------
    exposure
        (N,) rank of each point's exposure; from `MOST_EXPOSURES` on neighbours are one.
    number
        (n,) its number in the scan, a measure of time.
    private_mm2
        (N,) variance of each point's residual by the stripe's noise.
    root_mm
        (n, 3, 3) root of the covariance of the exposure's shift.
    moves
        (N, 6) change of each residual by a shift of its exposure, and by a turn about its middle
        that moves points by so much at their usual distance from it.
    """

    exposure: IntArray
    number: FloatArray
    private_mm2: FloatArray
    root_mm: FloatArray
    moves: FloatArray

    @staticmethod
    def of(fit: FitLinearised, cloud: PointCloud, rows: IntArray) -> _ExposureErrors:
        exposure, n = exposure_blocks(cloud.exposure[rows], MOST_EXPOSURES)
        count = np.bincount(exposure, minlength=n)
        covariance, axis, share = without_noise(cloud, rows)
        noise = cloud.sigma_noise_mm[rows] ** 2
        if cloud.noise_length is not None:
            noise = noise * cloud.noise_length[rows]
        along = share * np.einsum("ni,ni->n", axis, fit.directions) ** 2 + 1.0 - share
        mean = _sums(exposure, n, covariance.reshape(-1, 9)).reshape(n, 3, 3)
        values, vectors = np.linalg.eigh(mean / count[:, None, None])
        size = np.sqrt(np.maximum(values, 0.0))
        points = cloud.points_mm[rows]
        lever = points - (_sums(exposure, n, points) / count[:, None])[exposure]
        usual = max(float(np.sqrt(np.mean(np.sum(lever**2, axis=1)))), 1e-9)
        turns = np.cross(lever, fit.directions) / usual
        return _ExposureErrors(
            exposure,
            np.bincount(exposure, cloud.exposure[rows], n) / count,
            noise * along,
            np.asarray((vectors * size[:, None, :]) @ vectors.transpose(0, 2, 1)),
            np.concatenate([fit.directions, turns], axis=1),
        )

    @property
    def visit(self) -> IntArray:
        """(n,) number of the visit that each exposure is of."""
        return np.concatenate([[0], np.cumsum(np.diff(self.number) > self._step)]).astype(np.int64)

    @property
    def _step(self) -> float:
        """Numbers that neighbouring exposures of one visit are apart at most."""
        return 1.5 * max(1.0, float(np.diff(self.number).min()))

    def correlations(self) -> list[FloatArray]:
        """(n, n) of exposures' errors: new in each, in each visit, drifting at several paces."""
        n, visit = len(self.number), self.visit
        apart = np.abs(self.number[:, None] - self.number[None, :])
        same = (visit[:, None] == visit[None, :]).astype(np.float64)
        return [np.eye(n), same, *(np.exp(-apart / pace) for pace in PACES)]


def _shared_mm2(fit: FitLinearised, errors: _ExposureErrors, influence: FloatArray) -> float:
    """Variance of the length by what exposures err as a whole."""
    n = len(errors.number)
    pulls = _sums(errors.exposure, n, influence[:, None] * errors.moves)
    shifts = np.einsum("nij,nj->ni", errors.root_mm, pulls[:, :3])
    scores = _Scores.of(fit, errors)
    ways = errors.correlations()
    shifted = [float(np.einsum("ni,nm,mi->", shifts, way, shifts)) for way in ways]
    alike = float(np.sum(shifts.sum(axis=0) ** 2))
    grouped = [scores.grouped(way) for way in ways]
    sizes = _sizes(len(ways))
    common = np.maximum(1.0 - sizes.sum(axis=1), 0.0)
    is_shift = np.arange(scores.residual.size) % 6 < 3
    y, noise, by = scores.whitened(is_shift)
    terms = np.stack(
        [*(_spread(by, one) for one in grouped), _spread(by, np.ones_like(grouped[0]))]
    )
    mixed = np.column_stack([sizes, common])
    prior = _log_prior(sizes.sum(axis=1), 1.0)
    chance = _log_likelihood(y, noise + np.tensordot(mixed, terms, axes=1)) + prior
    variance = float(_weights(chance) @ (mixed @ np.array([*shifted, alike])))
    best = np.tensordot(
        mixed[int(np.argmax(chance))], np.stack([*grouped, np.ones_like(grouped[0])]), 1
    )
    return variance + _turned_mm2(errors, scores, pulls[:, 3:], (ways, best))


def _turned_mm2(
    errors: _ExposureErrors,
    scores: _Scores,
    pulls: FloatArray,
    shifts: tuple[list[FloatArray], FloatArray],
) -> float:
    """The same by turns of exposures, beside the likeliest way of their shifts."""
    ways, best = shifts
    size = np.sqrt(np.einsum("nij,nij->n", errors.root_mm, errors.root_mm) / 3.0)
    turned = pulls * size[:, None]
    y, noise, by = scores.whitened(np.ones(scores.residual.size, dtype=np.bool_))
    is_shift = np.arange(scores.residual.size) % 6 < 3
    base = noise + _spread(by[:, is_shift], best)
    spread = [_spread(by[:, ~is_shift], scores.grouped(way)) for way in ways[:2]]
    covariances = np.concatenate([base + TURN_SIZES[:, None, None] * one for one in spread])
    found = [float(np.einsum("ni,nm,mi->", turned, way, turned)) for way in ways[:2]]
    variances = np.concatenate([TURN_SIZES * one for one in found])
    prior = np.tile(_log_prior(TURN_SIZES, -0.5), 2)
    return float(_weights(_log_likelihood(y, covariances) + prior) @ variances)


@dataclass(frozen=True, slots=True, eq=False)
class _Scores:
    """Residuals summed by what exposures' motions change them, over G groups of neighbours.

    Parameters
    ----------
    share
        (G, n) of a group's points in each exposure.
    root_mm
        (G, 3, 3) root of the covariance of a group's shift.
    residual
        (6 G,) sums; six motions a group.
    by_motion
        (6 G, 6 G) their derivative by the motions, the fit's answer in it.
    noise_mm2
        (6 G, 6 G) their covariance by the points' own noise.
    """

    share: FloatArray
    root_mm: FloatArray
    residual: FloatArray
    by_motion: FloatArray
    noise_mm2: FloatArray

    @staticmethod
    def of(fit: FitLinearised, errors: _ExposureErrors) -> _Scores:
        n = len(errors.number)
        n_groups = min(n, GROUPS)
        rank = np.arange(n) * n_groups // n
        group = rank[errors.exposure]
        share = np.zeros((n_groups, n))
        share[rank, np.arange(n)] = np.bincount(errors.exposure, minlength=n)
        share /= share.sum(axis=1, keepdims=True)
        jacobian, moves = fit.jacobian, errors.moves
        least = LEAST_NOISE * float(np.mean(errors.root_mm**2))
        noise = errors.private_mm2 + least
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        by_fit, noisy = (
            np.stack(
                [
                    _sums(group, n_groups, moves * (column * weight)[:, None]).ravel()
                    for column in jacobian.T
                ],
                axis=1,
            )
            for weight in (np.ones(len(noise)), noise)
        )
        taken = by_fit @ inverse
        both = taken @ noisy.T
        within = jacobian.T @ (jacobian * noise[:, None])
        return _Scores(
            share,
            np.einsum("gn,nij->gij", share, errors.root_mm),
            _sums(group, n_groups, moves * fit.residuals_mm[:, None]).ravel(),
            _products(group, n_groups, moves, np.ones(len(noise))) - taken @ by_fit.T,
            _products(group, n_groups, moves, noise) - both - both.T + taken @ within @ taken.T,
        )

    def grouped(self, way: FloatArray) -> FloatArray:
        """(G, G) correlations of groups' mean errors, of those (n, n) of exposures."""
        return np.asarray(self.share @ way @ self.share.T)

    def whitened(self, chosen: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Some of the sums as (D,) numbers of about equal noise; that (D, D); by motions (D, C).

        Sums that the fit takes up are left out; motions are in units of their standard deviations.
        """
        both = np.ix_(chosen, chosen)
        values, vectors = np.linalg.eigh(self.by_motion[both])
        is_seen = values > 1e-6 * values[-1]
        size, vectors = np.sqrt(values[is_seen]), vectors[:, is_seen]
        unit = np.zeros((len(self.root_mm), 6, len(self.root_mm), 6))
        for k, root in enumerate(self.root_mm):
            unit[k, :3, k, :3] = root
            unit[k, 3:, k, 3:] = np.eye(3) * np.sqrt(np.sum(root**2) / 3.0)
        flat = unit.reshape(len(chosen), -1)[both]
        return (
            (vectors.T @ self.residual[chosen]) / size,
            (vectors.T @ self.noise_mm2[both] @ vectors) / np.outer(size, size),
            size[:, None] * (vectors.T @ flat),
        )


def _sums(block: IntArray, n: int, values: FloatArray) -> FloatArray:
    """(n, K) sums over blocks of values (N, K)."""
    return np.stack([np.bincount(block, one, n) for one in values.T], axis=1)


def _products(block: IntArray, n: int, values: FloatArray, weights: FloatArray) -> FloatArray:
    """(n K, n K) sums of products of values (N, K), blocks along the diagonal."""
    k = values.shape[1]
    found = np.zeros((n, k, n, k))
    each = np.arange(n)
    for i in range(k):
        for j in range(k):
            found[each, i, each, j] = np.bincount(block, values[:, i] * values[:, j] * weights, n)
    return found.reshape(n * k, n * k)


def _spread(by_motions: FloatArray, correlation: FloatArray) -> FloatArray:
    """(D, D) covariance by motions (D, 3 G) whose errors are correlated by (G, G)."""
    d, n = len(by_motions), len(correlation)
    mixed = np.einsum("dgi,gh->dhi", by_motions.reshape(d, n, 3), correlation)
    return np.asarray(mixed.reshape(d, -1) @ by_motions.T)


def _sizes(n_ways: int) -> FloatArray:
    """(K, n_ways) variances over the stated: each way alone, and with what is new in exposures."""
    alone = [size * np.eye(n_ways)[k] for k in range(n_ways) for size in SIZES]
    both = [
        one * np.eye(n_ways)[k] + own * np.eye(n_ways)[0]
        for k in range(1, n_ways)
        for one in SIZES
        for own in SIZES
    ]
    return np.array(alone + both)


def _log_prior(size: FloatArray, power: float) -> FloatArray:
    """Before the data: a power of the variance over the stated, falling steeply beyond that.

    Of shifts rising, as few data must not make an error small; of turns falling, as an arm's turns
    about its scan point move a feature's points by little beside its shifts.
    """
    return np.asarray(np.where(size > 1.0, -2.0, power) * np.log(size))


def _log_likelihood(y: FloatArray, covariances: FloatArray) -> FloatArray:
    """(K,) of normal numbers (D,) with covariances (K, D, D), up to a constant."""
    root = np.linalg.cholesky(covariances)
    scaled = np.linalg.solve(root, np.broadcast_to(y[:, None], (len(root), len(y), 1)))
    size = np.log(np.einsum("kii->ki", root)).sum(axis=1)
    return np.asarray(-0.5 * np.sum(scaled**2, axis=(1, 2)) - size)


def _weights(chance: FloatArray) -> FloatArray:
    """Of logarithms (K,), to a sum of 1."""
    found = np.exp(chance - chance.max())
    return np.asarray(found / found.sum())


def without_noise(cloud: PointCloud, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariances (N, 3, 3) of points less their own noise, as far as a cloud tells.

    It keeps the noise's length, not its direction. The longest axis stands for that: its variance
    is never below the noise's, so that none becomes negative; it is the right one where noise
    prevails, and where it does not the noise matters little. Also returned are that axis (N, 3) and
    the noise's share of the variance along it (N,): how far the axis is to be trusted.
    """
    covariance = cloud.covariance_mm2[rows]
    values, vectors = np.linalg.eigh(covariance)
    axis, noise = vectors[:, :, 2], cloud.sigma_noise_mm[rows]
    own = noise[:, None] * axis
    share = np.clip(noise**2 / np.maximum(values[:, 2], np.finfo(np.float64).tiny), 0.0, 1.0)
    return np.asarray(covariance - own[:, :, None] * own[:, None, :]), axis, share
