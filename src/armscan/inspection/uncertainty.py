# SPDX-License-Identifier: Apache-2.0
"""How well a fitted length is known, when the points of an exposure err together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import MAD_TO_SIGMA
from armscan.inspection.results import MeasuredLength
from armscan.records.cloud import CalibrationErrors, PointCloud, PointsSeen

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


LEAST_NEIGHBOURS, SCATTER_OF_VARIANCE = 30, 12.0
"""Differences of neighbours that tell their noise; and four times what the variance that their
median tells scatters by, as a part of it, times the root of how many they are: 4 x 2 x 1.17 for a
median of absolute values (Huber, Robust Statistics, 1981), and a quarter more for each point is in
two of them."""
LEAST_PART = 0.01
"""Of their mean that stated variances count as at least, where differences are held to them."""

LEAST_SHARE = 1e-3
"""Least part of what points share that exposures err each for itself, along any direction."""

LEAST_SEEN = 1e-3
"""Part of a motion that a fit must leave in the residuals: of less they tell nothing, as where few
stripes cross a flat face and the fit takes up all of their motions, but for what is not linear."""


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
    """

    jacobian: FloatArray
    directions: FloatArray
    residuals_mm: FloatArray


def measured_length(
    value_mm: float, slope: FloatArray, fit: FitLinearised, cloud: PointCloud, rows: IntArray
) -> MeasuredLength:
    """A length with both of its standard deviations.

    ``slope``: (P,) its derivatives by the fit's parameters. ``rows``: (N,) those in the cloud of
    the points of the fit.
    """
    return FitErrors.of(fit, cloud, rows).measured(value_mm, slope)


def worst_sigma(axes: FloatArray, sigma_along: Callable[[FloatArray], float]) -> float:
    """Standard deviation along the worst of all ways in the span of axes (K, 3); NaN if unknown.

    The variances along the axes and along their sums tell that along any way.
    """
    n = len(axes)
    own = np.zeros((n, n))
    for i, j in combinations_with_replacement(range(n), 2):
        own[i, j] = own[j, i] = sigma_along(axes[i] if i == j else axes[i] + axes[j]) ** 2
    if not np.isfinite(own).all():
        return math.nan
    variance = np.diag(own)
    covariance = 0.5 * (own - variance[:, None] - variance)
    np.fill_diagonal(covariance, variance)
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))


def exposure_blocks(exposure: IntArray, most: int) -> tuple[IntArray, int]:
    """(N,) number of the block of neighbouring exposures that each point is in, and their count."""
    number = np.unique(exposure, return_inverse=True)[1].astype(np.int64)
    n = int(number.max()) + 1 if len(number) else 0
    blocks = min(n, most)
    return (number * blocks // n if n else number), blocks


def influence_along(jacobian: FloatArray, slope: FloatArray) -> FloatArray:
    """(N,) derivative of a length by each point's error along its direction, up to one sign.

    ``jacobian``: (N, P) that of the fit. ``slope``: (P,) that of the length by its parameters.
    """
    return np.asarray(jacobian @ np.linalg.solve(jacobian.T @ jacobian, slope))


@dataclass(frozen=True, slots=True, eq=False)
class FitErrors:
    """What the parameters of one fit err by, for any length that follows from them.

    From the scatter of exposures it is told by a delete-a-block jackknife, linearised about the
    optimum. From the points' covariances: what exposures share of them is what the residuals tell.
    The stripes' own noise is taken out of the covariances and counted point by point, each with the
    correlation length that neighbours along the stripe share; a cloud that does not tell it is
    taken as independent from point to point. What the calibration errs, alike in all exposures, is
    carried to the length as it is, if the cloud tells it apart. The rest shifts an exposure as a
    whole (see `_SharedErrors`).

    Parameters
    ----------
    jacobian
        (N, P) of the fit.
    changes
        (B, P) changes of the parameters without one of B blocks of exposures, for each kind of
        block that tells.
    errors, shared
        Of the points and of exposures as wholes; None for a single exposure, for an error of the
        sensor stretches it, which a shift cannot tell.
    """

    jacobian: FloatArray
    changes: tuple[FloatArray, ...]
    errors: _ExposureErrors | None
    shared: _SharedErrors | None

    @staticmethod
    def of(fit: FitLinearised, cloud: PointCloud, rows: IntArray) -> FitErrors:
        """``rows`` (N,) are those in the cloud of the points of the fit."""
        numbers = cloud.exposure[rows]
        n = len(np.unique(numbers))
        groups = [exposure_blocks(numbers, n)]
        groups += [exposure_blocks(numbers, most) for most in COARSE_BLOCKS if n >= 2 * most]
        changes = [_jackknifed(fit, block, count) for block, count in groups]
        errors = shared = None
        if n >= 2 and cloud.covariance_mm2[rows].any():
            errors = _ExposureErrors.of(fit, cloud, rows)
            shared = _SharedErrors.of(fit, errors)
        told = tuple(one for one in changes if one is not None)
        return FitErrors(fit.jacobian, told, errors, shared)

    def measured(self, value_mm: float, slope: FloatArray) -> MeasuredLength:
        """A length whose derivatives by the parameters are ``slope`` (P,)."""
        spreads = [change @ slope - (change @ slope).mean() for change in self.changes]
        scatter = [math.sqrt((len(one) - 1) / len(one) * float(one @ one)) for one in spreads]
        return MeasuredLength(value_mm, max(scatter, default=math.nan), self._propagated_mm(slope))

    def _propagated_mm(self, slope: FloatArray) -> float:
        if self.errors is None or self.shared is None:
            return math.nan
        influence = influence_along(self.jacobian, slope)
        private = float(influence**2 @ self.errors.private_mm2)
        by_calibration = influence @ self.errors.common_mm
        variance = private + float(by_calibration @ by_calibration)
        return math.sqrt(max(variance + self.shared.variance_mm2(self.errors, influence), 0.0))


def _jackknifed(fit: FitLinearised, block: IntArray, n_blocks: int) -> FloatArray | None:
    """(B, P) changes of the parameters without a block each; None where they do not tell."""
    if n_blocks < MIN_BLOCKS:
        return None
    p = fit.jacobian.shape[1]
    normal = np.zeros((n_blocks, p, p))
    right = np.zeros((n_blocks, p))
    for i in range(p):
        right[:, i] = np.bincount(block, fit.jacobian[:, i] * fit.residuals_mm, n_blocks)
        for j in range(i + 1):
            sums = np.bincount(block, fit.jacobian[:, i] * fit.jacobian[:, j], n_blocks)
            normal[:, i, j] = normal[:, j, i] = sums
    remaining = normal.sum(axis=0) - normal
    if not np.all(np.linalg.cond(remaining) < 1e12):
        return None
    return np.asarray(np.linalg.solve(remaining, right[:, :, None])[:, :, 0])


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
    common_mm
        (N, K) change of each residual by each of K errors of the calibration, one sigma.
    """

    exposure: IntArray
    number: FloatArray
    private_mm2: FloatArray
    root_mm: FloatArray
    moves: FloatArray
    common_mm: FloatArray

    @staticmethod
    def of(fit: FitLinearised, cloud: PointCloud, rows: IntArray) -> _ExposureErrors:
        exposure, n = exposure_blocks(cloud.exposure[rows], MOST_EXPOSURES)
        count = np.bincount(exposure, minlength=n)
        covariance, axis, share = without_noise(cloud, rows)
        total = _sums(exposure, n, covariance.reshape(-1, 9)).reshape(n, 3, 3)
        by_calibration, common = _calibration_errors(cloud, rows, fit.directions)
        mean = total - _sums(exposure, n, by_calibration.reshape(-1, 9)).reshape(n, 3, 3)
        mean, total = (one / count[:, None, None] for one in (mean, total))
        along = share * np.einsum("ni,ni->n", axis, fit.directions) ** 2 + 1.0 - share
        noise = cloud.sigma_noise_mm[rows] ** 2 * along
        noise = noise + _unstated_mm2(fit.residuals_mm, cloud, rows, noise)
        if cloud.noise_length is not None:
            noise = noise * cloud.noise_length[rows]
        values, vectors = np.linalg.eigh(mean)
        least = LEAST_SHARE * np.trace(total, axis1=1, axis2=2)[:, None]
        size = np.sqrt(np.maximum(values, least))
        points = cloud.points_mm[rows]
        lever = points - (_sums(exposure, n, points) / count[:, None])[exposure]
        usual = max(float(np.sqrt(np.mean(np.sum(lever**2, axis=1)))), 1e-9)
        turns = np.cross(lever, fit.directions) / usual
        return _ExposureErrors(
            exposure,
            np.bincount(exposure, cloud.exposure[rows], n) / count,
            noise,
            np.asarray((vectors * size[:, None, :]) @ vectors.transpose(0, 2, 1)),
            np.concatenate([fit.directions, turns], axis=1),
            common,
        )

    @property
    def visit(self) -> IntArray:
        """(n,) number of the visit that each exposure is of."""
        return np.concatenate([[0], np.cumsum(np.diff(self.number) > self._step)]).astype(np.int64)

    @property
    def _step(self) -> float:
        """Numbers that neighbouring exposures of one visit are apart at most."""
        return 1.5 * max(1.0, float(np.diff(self.number).min()))

    @property
    def usual_mm(self) -> FloatArray:
        """(n,) standard deviation of an exposure's shift along any axis, root mean square."""
        return np.asarray(np.sqrt(np.einsum("nij,nij->n", self.root_mm, self.root_mm) / 3.0))

    @property
    def unit_mm(self) -> FloatArray:
        """(n, 6, 6) motions of one standard deviation; points turn by as much as they shift."""
        unit = np.zeros((len(self.root_mm), 6, 6))
        unit[:, :3, :3] = self.root_mm
        unit[:, [3, 4, 5], [3, 4, 5]] = self.usual_mm[:, None]
        return unit

    def ways(self) -> list[FloatArray]:
        """(n, n) correlations of exposures' errors: new in each, in each visit, drifting at several
        paces, and last one for all.
        """
        n, visit = len(self.number), self.visit
        apart = np.abs(self.number[:, None] - self.number[None, :])
        same = (visit[:, None] == visit[None, :]).astype(np.float64)
        return [np.eye(n), same, *(np.exp(-apart / pace) for pace in PACES), np.ones((n, n))]


@dataclass(frozen=True, slots=True, eq=False)
class _SharedErrors:
    """How likely each way and size is in which exposures may err as wholes, by the residuals.

    No cloud tells whether a shift is new in each exposure, in each visit (exposures that follow
    each other without a gap), drifts from one to the next, or is one for all, and whether exposures
    turn besides. Each of these ways and sizes counts by how likely it makes the residuals' sums
    over exposures: a variance is the mean over them (Bayesian model averaging, Hoeting et al.
    1999).

    Parameters
    ----------
    shifts
        (n, n) correlations of exposures' shifts, one a way, and the size of each in the mean.
    turns
        The same of turns, beside shifts of the likeliest ways.
    """

    shifts: tuple[tuple[float, FloatArray], ...]
    turns: tuple[tuple[float, FloatArray], ...]

    @staticmethod
    def of(fit: FitLinearised, errors: _ExposureErrors) -> _SharedErrors:
        scores, ways = _Scores.of(fit, errors), errors.ways()
        sizes = _sizes(len(ways) - 1)
        mixed = np.column_stack([sizes, np.maximum(1.0 - sizes.sum(axis=1), 0.0)])
        y, noise, by = scores.whitened(np.arange(6) < 3)
        terms = np.stack([_spread(by, way) for way in ways])
        prior = _log_prior(sizes.sum(axis=1), 1.0)
        chance = _log_likelihood(y, noise + np.tensordot(mixed, terms, axes=1)) + prior
        best = np.tensordot(mixed[int(np.argmax(chance))], np.stack(ways), 1)
        mean = _weights(chance) @ mixed
        shifts = tuple(zip(mean.tolist(), ways, strict=True))
        return _SharedErrors(shifts, _likely_turns(scores, ways[:2], best))

    def variance_mm2(self, errors: _ExposureErrors, influence: FloatArray) -> float:
        """Variance of a length that N points influence so, by what exposures err as wholes."""
        pulls = _sums(errors.exposure, len(errors.number), influence[:, None] * errors.moves)
        shifts = np.einsum("nij,nj->ni", errors.root_mm, pulls[:, :3]).reshape(1, -1)
        turns = (pulls[:, 3:] * errors.usual_mm[:, None]).reshape(1, -1)
        return sum(
            size * float(_spread(moves, way)[0, 0])
            for moves, ways in ((shifts, self.shifts), (turns, self.turns))
            for size, way in ways
        )


def _likely_turns(
    scores: _Scores, ways: list[FloatArray], shifts: FloatArray
) -> tuple[tuple[float, FloatArray], ...]:
    """Mean size of exposures' turns, one a way, beside shifts of a covariance (n, n)."""
    y, noise, by = scores.whitened(np.ones(6, dtype=np.bool_))
    is_shift = np.arange(by.shape[1]) % 6 < 3
    base = noise + _spread(by[:, is_shift], shifts)
    spread = [_spread(by[:, ~is_shift], way) for way in ways]
    covariances = np.concatenate([base + TURN_SIZES[:, None, None] * one for one in spread])
    prior = np.tile(_log_prior(TURN_SIZES, -0.5), len(ways))
    weights = _weights(_log_likelihood(y, covariances) + prior).reshape(len(ways), -1)
    return tuple(zip((weights @ TURN_SIZES).tolist(), ways, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class _Scores:
    """Residuals summed by what motions of exposures change them, over G groups of neighbours.

    What exposures of one group err differently is in the sums, too: taken as one, shifts that
    differ would look like turns.

    Parameters
    ----------
    residual
        (G, 6) sums, one a motion.
    by_group
        (G, 6, G, 6) their derivative by motions of groups as a whole, the fit's answer in it.
    by_exposure
        (G, 6, n, 6) the same by motions of exposures, of one standard deviation each.
    noise_mm2
        (G, 6, G, 6) their covariance by the points' own noise, and by the calibration's errors.
    least
        What by_group is along motions that the residuals tell, at least.
    """

    residual: FloatArray
    by_group: FloatArray
    by_exposure: FloatArray
    noise_mm2: FloatArray
    least: float

    @staticmethod
    def of(fit: FitLinearised, errors: _ExposureErrors) -> _Scores:
        n = len(errors.number)
        n_groups = min(n, GROUPS)
        rank = np.arange(n) * n_groups // n
        first = np.searchsorted(rank, np.arange(n_groups))
        jacobian, moves = fit.jacobian, errors.moves
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        least = LEAST_NOISE * float(np.mean(errors.root_mm**2))
        noise = errors.private_mm2 + least

        def summed(values: FloatArray, weight: FloatArray) -> FloatArray:
            """(G, 6, K) of values (N, K), by motion."""
            each = _outer_sums(errors.exposure, n, moves * weight[:, None], values)
            return np.asarray(np.add.reduceat(each, first))

        own = _outer_sums(errors.exposure, n, moves, moves)
        by_fit = _outer_sums(errors.exposure, n, moves, jacobian)
        taken = np.add.reduceat(by_fit, first) @ inverse
        by_exposure = -np.einsum("gip,njp->ginj", taken, by_fit)
        by_exposure[rank, :, np.arange(n)] += own
        noisy = summed(jacobian, noise)
        both = np.einsum("gip,hjp->gihj", taken, noisy)
        within = jacobian.T @ (jacobian * noise[:, None])
        private = np.einsum("gip,pq,hjq->gihj", taken, within, taken)
        private -= both + both.transpose(2, 3, 0, 1)
        each = np.arange(n_groups)
        private[each, :, each] += summed(moves, noise)
        common = errors.common_mm
        known = summed(common, np.ones(len(common))) - taken @ (jacobian.T @ common)
        residual = summed(fit.residuals_mm[:, None], np.ones(len(noise)))[:, :, 0]
        return _Scores(
            residual,
            np.add.reduceat(by_exposure, first, axis=2),
            np.einsum("ginj,njk->gink", by_exposure, errors.unit_mm),
            private + np.einsum("gik,hjk->gihj", known, known),
            LEAST_SEEN * float(np.einsum("gii->gi", np.add.reduceat(own, first)).max()),
        )

    def whitened(self, chosen: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Sums by some of the six motions as (D,) numbers of about equal noise; that (D, D); by
        the same motions of exposures (D, n C), in units of their standard deviations.

        Sums that the fit takes up are left out; of all, D is 0 and the data tell nothing.
        """
        rows = self.residual[:, chosen].size
        square = (slice(None), chosen, slice(None))
        by_group = self.by_group[square][..., chosen].reshape(rows, rows)
        values, vectors = np.linalg.eigh(by_group)
        is_seen = values > self.least
        size, vectors = np.sqrt(values[is_seen]), vectors[:, is_seen]
        noise = self.noise_mm2[square][..., chosen].reshape(rows, rows)
        by = self.by_exposure[square][..., chosen].reshape(rows, -1)
        return (
            (vectors.T @ self.residual[:, chosen].ravel()) / size,
            (vectors.T @ noise @ vectors) / np.outer(size, size),
            (vectors.T @ by) / size[:, None],
        )


def _unstated_mm2(
    residuals_mm: FloatArray, cloud: PointCloud, rows: IntArray, stated_mm2: FloatArray
) -> float:
    """Variance that residuals (N,) of neighbours along a stripe differ by beyond the stated (N,).

    A rough surface, or noise that a calibration states too low; 0 where chance may have made it.
    What neighbours share is not in it, so that it is never too large.
    """
    sheet, exposure = cloud.sheet[rows], cloud.exposure[rows]
    is_next = (np.diff(sheet) == 0) & (np.diff(exposure) == 0)
    n = int(is_next.sum())
    if n < LEAST_NEIGHBOURS:
        return 0.0
    stated = (stated_mm2[1:] + stated_mm2[:-1])[is_next] / 2.0
    told = float(np.mean(stated))
    # each over its own: of points some of which are noisier, medians of both would not be alike
    part = np.maximum(stated / told, LEAST_PART) if told > 0.0 else np.ones(n)
    apart = np.abs(np.diff(residuals_mm)[is_next]) / np.sqrt(part)
    found = (MAD_TO_SIGMA * float(np.median(apart))) ** 2 / 2.0
    return found - told if found > (1.0 + SCATTER_OF_VARIANCE / math.sqrt(n)) * told else 0.0


def _sums(block: IntArray, n: int, values: FloatArray) -> FloatArray:
    """(n, K) sums over blocks of values (N, K)."""
    return np.stack([np.bincount(block, one, n) for one in values.T], axis=1)


def _outer_sums(block: IntArray, n: int, left: FloatArray, right: FloatArray) -> FloatArray:
    """(n, J, K) sums over blocks of products of values (N, J) and (N, K)."""
    found = np.zeros((n, left.shape[1], right.shape[1]))
    for k, one in enumerate(right.T):
        found[:, :, k] = _sums(block, n, left * one[:, None])
    return found


def _spread(by_motions: FloatArray, correlation: FloatArray) -> FloatArray:
    """(D, D) covariance by motions (D, 3 n) of exposures whose errors are correlated by (n, n)."""
    d, n = len(by_motions), len(correlation)
    along = by_motions.reshape(d, n, 3).transpose(0, 2, 1).reshape(3 * d, n)
    return np.asarray((along @ correlation).reshape(d, 3 * n) @ along.reshape(d, 3 * n).T)


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


def points_seen(cloud: PointCloud, rows: IntArray) -> tuple[CalibrationErrors, PointsSeen] | None:
    """What a calibration errs, and (N,) rows of the points that it moves; None if not told."""
    errors, seen_from = cloud.calibration_errors, cloud.seen_from_mm
    if errors is None or seen_from is None:
        return None
    exposure = cloud.exposure[rows]
    return errors, PointsSeen(
        points_mm=cloud.points_mm[rows],
        seen_from_mm=seen_from[exposure],
        exposure=exposure,
        sheet=cloud.sheet[rows],
    )


def _calibration_errors(
    cloud: PointCloud, rows: IntArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance (N, 3, 3) of points by the calibration alone, and moves (N, K + 3) along
    directions by it and by what the arm errs alike at all postures.

    Both are zero of a cloud that does not tell.
    """
    told = points_seen(cloud, rows)
    if told is None:
        return np.zeros((len(rows), 3, 3)), np.zeros((len(rows), 0))
    errors, seen = told
    by_arm = errors.arm_mm * np.einsum("ni,nik->nk", directions, errors.turns[seen.exposure])
    along = errors.moves_along_mm(seen, directions)
    return errors.covariance_mm2(seen), np.concatenate([by_arm, along.T], axis=1)


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
