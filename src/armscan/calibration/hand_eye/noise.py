# SPDX-License-Identifier: Apache-2.0
"""Why points do not lie on the reference: causes of scatter, and how large each is.

The arm's pose errs by a shift, a turn about the origin of Tool and a turn about the scan point,
alike for all points of a posture, and by a smaller part that is new in every exposure. About which
point an arm's error turns, nobody knows beforehand; the scatter of both turns tells. A plate is
uneven by a smooth random function of the place on it, so that postures which look at the same place
see the same error. The light sheets are not quite what their parameters describe, by another smooth
function, of the place on the sheet, the same in all postures. A stripe on a sphere may have the
wrong curvature. Only the stripe's own noise is independent.

Standard deviations that nobody gave come from restricted maximum likelihood: the likelihood of
those combinations of the residuals that no hand-eye can change, so that the fitted parameters do
not make the scatter look too small. A dozen postures say little about each cause, so the logarithm
of every standard deviation is held near its typical value by a wide normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import brentq
from scipy.special import chdtr, chdtri

from armscan.calibration.hand_eye.observations import (
    CondensedObservations,
    HandEyeOptions,
)
from armscan.calibration.hand_eye.surface import (
    N_HAND_EYE,
    Placed,
    PlateSurface,
    ReferenceSurface,
)
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.least_squares import normal_draws
from armscan.models.calibration import SHEET_PARAMETER_NAMES, ArmNoise
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES

TYPICAL_ARM_MM = 0.03
"""Measuring arms scatter by 0.005 mm, robots by 0.1 to 0.2."""
TYPICAL_LEVER_MM = 100.0
"""Scatter of the shift over scatter of the orientation; arms have 30 to 300 mm."""
TURNS = ("rotation", "rotation at scan point")
"""About the origin of Tool, and about the scan point; each is expected to be half the variance."""
TYPICAL_EXPOSURE_SHARE = 0.3
"""What is new in every exposure over what a posture's exposures share."""
TYPICAL_FLATNESS_MM = 0.004
TYPICAL_FORM_MM = 0.003
TYPICAL_SHEET_SHAPE_MM = 0.001
"""What plane and bow leave of the sheets of simulated heads, root mean square."""
SHEET_SHAPE_LENGTH_MM = 15.0
"""Half a calibrated region and less: what is longer, plane and bow take up."""
LEAST_TOUCHES = 8
"""Their scatter says how much the arm errs."""
LEAST_ARM_MM = 0.001
WIDE = 1.0
"""Standard deviation of the logarithm of a scatter about its typical value: a factor of 2.7. Levers
of 30 to 300 mm lie within it."""
ARM_WIDTH = 1.5
"""Of arms and robots, and of plates: a factor of 4.5."""
VERY_WIDE = 2.0
"""Of the form of stripes on a sphere: a factor of 7."""
NARROW = 0.5
"""Of the stripe's noise on a sphere, which the section circles have shown: a factor of 1.6."""
LEAST_STRIPE_MM = 1e-5
REGION = 0.95
MAX_SCORING_STEPS = 30
SCORING_SETTLED = 1e-3
LONGEST_STEP = 1.0
MAX_LOG = 7.0
"""A standard deviation leaves its typical value by a factor of 1100 at most."""
INFLATION = 1.5
"""They are drawn from a normal distribution that is so much wider in variance than the posterior
is near its highest point."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseComponent:
    """One cause of scatter: ``arm``, ``exposure``, each with its `TURNS`, ``flatness``, ...

    ``covariance`` (M, M) is that of the residuals when ``sigma`` is 1. ``sigma`` is given, or
    typical where it is estimated; ``log_width`` is the standard deviation of its logarithm then,
    about the typical value, or, where it ``follows`` another component, about the same part of that
    one's as of the typical values.
    """

    name: str
    covariance: FloatArray
    sigma: float
    is_estimated: bool = False
    log_width: float = WIDE
    follows: str = ""


def noise_components(
    observations: CondensedObservations,
    surface: ReferenceSurface,
    placed: Placed,
    options: HandEyeOptions,
    weights: FloatArray | None = None,
) -> tuple[NoiseComponent, ...]:
    """Build the causes of scatter at the given placing.

    ``weights`` (n postures,) are at most 1: below it, a posture's pose is trusted less.
    """
    by_pose = placed.dresidual_dpose
    shift, *turns = (part @ part.T for part in np.split(by_pose, 3, axis=1))
    posture = _same(observations.posture)
    if weights is not None:
        posture = posture / weights[observations.posture][:, None]
    components: tuple[NoiseComponent, ...] = _pose_components(
        [posture * part for part in (shift, *turns)],
        _component("arm", shift, options.arm_position_mm, _expected_arm_mm(surface), ARM_WIDTH),
        options.arm_rotation_rad,
    )
    if _has_exposure_part(observations, options):
        exposure = _same(observations.exposure)
        typical = TYPICAL_EXPOSURE_SHARE * components[0].sigma
        new = _component("exposure", shift, options.exposure_position_mm, typical, ARM_WIDTH)
        components += _pose_components(
            [exposure * part for part in (shift, *turns)],
            replace(new, follows="arm"),
            options.exposure_rotation_rad,
        )
    own = np.diag(_stripe_variance_mm2(observations, placed))
    is_plate = isinstance(surface, PlateSurface)
    stripe = _component(
        "stripe", own, options.stripe_noise_factor, 1.0, WIDE if is_plate else NARROW
    )
    if not isinstance(surface, PlateSurface):
        form = _component("form", _same(observations.stripe), None, TYPICAL_FORM_MM, VERY_WIDE)
        return (*components, form, stripe)
    on_plate = (placed.points_base_mm - surface.plane.point_mm) @ surface.plane.axes[:2].T
    alike = _alike(on_plate, options.flatness_length_mm)
    return (
        *components,
        _component("flatness", alike, options.plate_flatness_mm, TYPICAL_FLATNESS_MM, ARM_WIDTH),
        *_sheet_shape(observations, placed, options),
        stripe,
    )


def arm_components(
    covariances: list[FloatArray], position_mm: float | None, rotation_rad: float | None
) -> tuple[NoiseComponent, ...]:
    """The scatter of an arm's poses by itself: its shift and both `TURNS`.

    ``covariances`` (M, M) are for a standard deviation of 1; sizes are given, or None to be
    estimated.
    """
    shift = _component("arm", covariances[0], position_mm, TYPICAL_ARM_MM, ARM_WIDTH)
    return _pose_components(covariances, shift, rotation_rad)


def _expected_arm_mm(surface: ReferenceSurface) -> float:
    """Expected scatter of the arm's position.

    Touches of the plate scatter about their plane by what arm, tip and plate err by; but they tell
    how the arm repeats itself nearby, so that they bind no more than what arms have in general.
    """
    if isinstance(surface, PlateSurface):
        touched_mm = surface.reference.rms_mm
        if touched_mm is not None and surface.reference.n_points >= LEAST_TOUCHES:
            return max(touched_mm, LEAST_ARM_MM)
    return TYPICAL_ARM_MM


def _has_exposure_part(observations: CondensedObservations, options: HandEyeOptions) -> bool:
    """True if a part that is new in every exposure was given, or can be told from the posture's."""
    if options.exposure_position_mm is not None or options.exposure_rotation_rad is not None:
        return True
    is_repeated = len(np.unique(observations.exposure)) > len(observations.used_postures)
    return is_repeated and options.arm_position_mm is None


def _stripe_variance_mm2(observations: CondensedObservations, placed: Placed) -> FloatArray:
    """(M,) variance of the residuals by the stripe's own noise: its part along the normal."""
    normals = placed.dresidual_dpoint[observations.first]
    variance = np.einsum("ni,nij,nj->n", normals, observations.noise_mm2, normals)
    return np.asarray(np.maximum(variance, LEAST_STRIPE_MM**2))


def _sheet_shape(
    observations: CondensedObservations, placed: Placed, options: HandEyeOptions
) -> tuple[NoiseComponent, ...]:
    """The sheets' own shape beyond their parameters; nothing where points came without a sheet.

    It moves a point as an offset of its sheet would that is a smooth function of the place on the
    sheet. Two stripes of one exposure share arm and plate: without this part, whatever their
    sheets' shapes set between them would count as a scatter of arm or plate.
    """
    by_sensor, sheet = observations.dpoint_dsensor, observations.sheet
    offset = len(CAMERA_PARAMETER_NAMES) + SHEET_PARAMETER_NAMES.index("offset_mm")
    column = offset + len(SHEET_PARAMETER_NAMES) * sheet
    if by_sensor is None or not len(sheet) or column.max() >= by_sensor.shape[2]:
        return ()
    by_offset = by_sensor[np.arange(len(sheet)), :, column]
    moved = np.einsum("ni,ni->n", placed.dresidual_dpoint, by_offset)
    alike = _same(sheet) * _alike(observations.points_mm, SHEET_SHAPE_LENGTH_MM)
    covariance = alike * moved[:, None] * moved[None, :]
    return (_component("sheet shape", covariance, options.sheet_shape_mm, TYPICAL_SHEET_SHAPE_MM),)


def _same(labels: IntArray) -> FloatArray:
    return np.asarray(labels[:, None] == labels[None, :], dtype=np.float64)


def _alike(places_mm: FloatArray, length_mm: float) -> FloatArray:
    """Correlation (N, N) of a smooth error at (N, 2) or (N, 3) places: Matern's of order 5/2.

    Near zero it bends like ``exp(-d^2 / (2 length^2))``. A Gaussian supposes more smoothness than
    any plate or sheet has and, given too long a length, takes whatever else is smooth for exactly
    known.
    """
    apart = np.linalg.norm(places_mm[:, None] - places_mm[None, :], axis=2)
    scaled = apart * (np.sqrt(3.0) / length_mm)
    return np.asarray((1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled))


def _component(
    name: str, covariance: FloatArray, given: float | None, typical: float, width: float = WIDE
) -> NoiseComponent:
    sigma = typical if given is None else given
    return NoiseComponent(name, covariance, sigma, is_estimated=given is None, log_width=width)


def _pose_components(
    covariances: list[FloatArray], shift: NoiseComponent, rotation: float | None
) -> tuple[NoiseComponent, ...]:
    """Shift and turns of one pose, by their (M, M) covariances.

    The turns are sought about what the shift's scatter lets expect, unless the orientation's
    scatter is given: then all of it turns about the origin of Tool.
    """
    expected = shift.sigma / TYPICAL_LEVER_MM / np.sqrt(len(TURNS))
    sigmas = [expected] * len(TURNS) if rotation is None else [rotation]
    return (
        replace(shift, covariance=covariances[0]),
        *(
            NoiseComponent(
                f"{shift.name} {name}",
                covariance,
                sigma,
                is_estimated=rotation is None and shift.sigma > 0.0,
                follows=shift.name,
            )
            for name, covariance, sigma in zip(TURNS, covariances[1:], sigmas, strict=False)
        ),
    )


def total_covariance(components: tuple[NoiseComponent, ...], sigmas: FloatArray) -> FloatArray:
    """(M, M) sum of all causes of scatter with the given standard deviations."""
    total = np.zeros_like(components[0].covariance)
    for component, sigma in zip(components, sigmas, strict=True):
        total += sigma**2 * component.covariance
    return total


def arm_noise(components: tuple[NoiseComponent, ...], sigmas: FloatArray) -> ArmNoise:
    """What the standard deviations say about the arm."""
    known = {one.name: float(sigma) for one, sigma in zip(components, sigmas, strict=True)}
    at_tool, at_scan_point = TURNS
    return ArmNoise(
        position_mm=known["arm"],
        rotation_rad=known.get(f"arm {at_scan_point}", 0.0),
        exposure_position_mm=known.get("exposure", 0.0),
        exposure_rotation_rad=known.get(f"exposure {at_scan_point}", 0.0),
        tool_rotation_rad=known[f"arm {at_tool}"],
        exposure_tool_rotation_rad=known.get(f"exposure {at_tool}", 0.0),
    )


@dataclass(frozen=True, slots=True, eq=False)
class LinearSolution:
    """Generalised least squares of ``e + A x = 0`` at a fixed linearisation.

    Parameters
    ----------
    step
        (K,) solution x.
    covariance
        (K, K) of x.
    projected
        (M, M) ``P = C^-1 - C^-1 A cov A' C^-1``: zero along the columns of A.
    gain
        (K, M) ``G`` with ``x = -G e``.
    log_likelihood
        Restricted log-likelihood of the residuals, without constants.
    """

    step: FloatArray
    covariance: FloatArray
    projected: FloatArray
    gain: FloatArray
    log_likelihood: float


def solve_linear(
    residual: FloatArray, jacobian: FloatArray, covariance: FloatArray
) -> LinearSolution | None:
    """Solve ``residual + jacobian x = 0`` (M,), (M, K) under (M, M) covariance.

    Returns None where the covariance or the normal matrix is not positive definite.
    """
    solved = _solve(residual, jacobian, covariance)
    if solved is None:
        return None
    projected, weighted = _projected(solved)
    return LinearSolution(
        step=solved.step,
        covariance=solved.covariance,
        projected=projected,
        gain=solved.covariance @ weighted.T,
        log_likelihood=solved.log_likelihood,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """``step``, ``covariance`` and ``log_likelihood`` of `LinearSolution`, for less.

    ``lower`` (M, M) is the Cholesky factor of the residuals' covariance, ``whitened`` (M, K) the
    Jacobian over it, ``left`` (M,) what the step leaves of the residuals over it.
    """

    step: FloatArray
    covariance: FloatArray
    log_likelihood: float
    lower: FloatArray
    whitened: FloatArray
    left: FloatArray


def _solve(
    residual: FloatArray, jacobian: FloatArray, covariance: FloatArray, n_unit: int = 0
) -> _Solved | None:
    """As `solve_linear`, without what only the scoring and the checks need.

    The last ``n_unit`` unknowns are known beforehand: 0 with a variance of 1.
    """
    known = np.zeros(jacobian.shape[1])
    known[len(known) - n_unit :] = 1.0
    try:
        lower = cholesky(covariance, lower=True, check_finite=False)
        whitened = solve_triangular(
            lower, np.column_stack([jacobian, residual]), lower=True, check_finite=False
        )
        own, right = whitened[:, :-1], whitened[:, -1]
        factor = cholesky(own.T @ own + np.diag(known), lower=True)
    except LinAlgError:
        return None
    solved = np.asarray(cho_solve((factor, True), np.eye(len(factor))))
    step = -solved @ (own.T @ right)
    left = right + own @ step
    squares = float(left @ left) + float(known @ step**2)
    determinants = np.log(np.diag(lower)).sum() + np.log(np.diag(factor)).sum()
    return _Solved(
        step=step,
        covariance=0.5 * (solved + solved.T),
        log_likelihood=-0.5 * squares - float(determinants),
        lower=lower,
        whitened=own,
        left=left,
    )


def _projected(solved: _Solved) -> tuple[FloatArray, FloatArray]:
    """``projected`` (M, M) of `LinearSolution`, and (M, K) ``C^-1 A``."""
    inverse = np.tril(dpotri(solved.lower, lower=1)[0])
    inverse += np.tril(inverse, -1).T
    weighted = _transposed_solve(solved.lower, solved.whitened)
    root = np.linalg.cholesky(solved.covariance)
    thin = weighted @ root
    return inverse - thin @ thin.T, weighted


def _transposed_solve(lower: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(solve_triangular(lower, values, lower=True, trans=1, check_finite=False))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseEstimate:
    """Standard deviations (C,) of the causes of scatter, and covariance (C, C) of their logarithms.

    Given ones are included, with a covariance of zero. ``is_settled`` is False if the steps ran
    out.
    """

    sigmas: FloatArray
    log_covariance: FloatArray
    is_settled: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """A covariance (M, M) that is zero between groups of observations, by its groups.

    What a posture, an exposure, a sheet or a point has of its own is so; whole ones are one group.
    ``diagonal`` (M,) stands for groups of one each, and there are no others then.
    """

    rows: tuple[slice | IntArray, ...]
    parts: tuple[FloatArray, ...]
    diagonal: FloatArray | None = None

    @staticmethod
    def of(covariance: FloatArray) -> _Blocks:
        """Groups of a symmetric matrix: rows alike in where their first entry is."""
        n = len(covariance)
        labels = np.argmax(covariance != 0.0, axis=1)
        if (labels == np.arange(n)).all() and np.count_nonzero(covariance) == n:
            return _Blocks((), (), np.diag(covariance).copy())
        if covariance[labels[:, None] != labels[None, :]].any():
            return _Blocks((slice(0, n),), (covariance,))
        groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
        parts = tuple(np.ascontiguousarray(covariance[np.ix_(rows, rows)]) for rows in groups)
        return _Blocks(tuple(_as_slice(rows) for rows in groups), parts)

    def times(self, values: FloatArray, product: FloatArray | None = None) -> FloatArray:
        """Covariance times (M,) or (M, N) values, into ``product`` if there is one."""
        product = np.zeros_like(values) if product is None else product
        if self.diagonal is not None:
            np.multiply(values.T, self.diagonal, out=product.T)
        for rows, part in zip(self.rows, self.parts, strict=True):
            if isinstance(rows, slice):
                np.matmul(part, values[rows], out=product[rows])
            else:
                product[rows] = part @ values[rows]
        return product

    def add_to(self, total: FloatArray, factor: float) -> None:
        """Add so many times the covariance to (M, M)."""
        if self.diagonal is not None:
            total[np.diag_indices_from(total)] += factor * self.diagonal
        for rows, part in zip(self.rows, self.parts, strict=True):
            total[(rows, rows) if isinstance(rows, slice) else np.ix_(rows, rows)] += factor * part


def _as_slice(rows: IntArray) -> slice | IntArray:
    """Ascending rows as a slice where they lie side by side."""
    is_whole = int(rows[-1]) - int(rows[0]) + 1 == len(rows)
    return slice(int(rows[0]), int(rows[-1]) + 1) if is_whole else rows


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """Restricted likelihood and prior of the free standard deviations, over their logarithms.

    ``known`` (M, M) is the covariance of all that is not estimated, ``blocks`` (F,) are those of
    what is, for a sigma of 1. ``typical`` (C,) are the components' own, ``free`` (F,) which of them
    are estimated; ``precision`` (F, F) is that of the normal prior of ``logs``, log sigma over
    typical.
    """

    residual: FloatArray
    jacobian: FloatArray
    known: FloatArray
    blocks: tuple[_Blocks, ...]
    typical: FloatArray
    free: IntArray
    precision: FloatArray

    @staticmethod
    def of(
        residual: FloatArray,
        jacobian: FloatArray,
        components: tuple[NoiseComponent, ...],
        known: FloatArray,
    ) -> _Posterior:
        """With the prior of the components: each about its typical value or what it follows."""
        names = [component.name for component in components]
        free = np.flatnonzero([c.is_estimated for c in components]).astype(np.int64)
        deviation = np.eye(len(components))
        for k, component in enumerate(components):
            if component.follows:
                deviation[k, names.index(component.follows)] = -1.0
        scaled = deviation / np.array([component.log_width for component in components])[:, None]
        own = scaled[np.ix_(free, free)]
        typical = np.array([component.sigma for component in components])
        given = np.where([component.is_estimated for component in components], 0.0, typical)
        return _Posterior(
            residual=residual,
            jacobian=jacobian,
            known=known + total_covariance(components, given),
            blocks=tuple(_Blocks.of(components[k].covariance) for k in free),
            typical=typical,
            free=free,
            precision=own.T @ own,
        )

    def logs(self, sigmas: FloatArray) -> FloatArray:
        """(F,) of the free ones of (C,) standard deviations."""
        return np.asarray(np.log(sigmas[self.free] / self.typical[self.free]))

    def sigmas(self, logs: FloatArray) -> FloatArray:
        """(C,) standard deviations."""
        sigmas = self.typical.copy()
        sigmas[self.free] *= np.exp(np.clip(logs, -MAX_LOG, MAX_LOG))
        return sigmas

    def covariance(self, logs: FloatArray) -> FloatArray:
        """(M, M) of the residuals."""
        total = self.known.copy()
        for block, sigma in zip(self.blocks, self.sigmas(logs)[self.free], strict=True):
            block.add_to(total, float(sigma) ** 2)
        return total

    def at(self, logs: FloatArray) -> tuple[float, _Solved | None]:
        """Logarithm of the posterior, and the solution that it belongs to."""
        solution = _solve(self.residual, self.jacobian, self.covariance(logs))
        likelihood = -np.inf if solution is None else solution.log_likelihood
        return likelihood - 0.5 * float(logs @ self.precision @ logs), solution

    def score(self, logs: FloatArray, solved: _Solved) -> tuple[FloatArray, FloatArray]:
        """Derivative (F,) of the restricted likelihood by log sigma, and (F, F) its information.

        With P of `LinearSolution` and ``V_k`` the scatter by a cause: ``e' P V_k P e - tr(P V_k)``
        and ``2 tr(P V_i P V_j)``. ``V_k P`` is a full product only where ``V_k`` is one group.
        """
        projected = _projected(solved)[0]
        explained = _transposed_solve(solved.lower, solved.left)
        variances = self.sigmas(logs)[self.free] ** 2
        products = np.zeros((len(self.blocks), *projected.shape))
        for block, product in zip(self.blocks, products, strict=True):
            block.times(projected, product)
        traces = np.einsum("kii->k", products)
        sizes = np.array([float(explained @ block.times(explained)) for block in self.blocks])
        turned = np.ascontiguousarray(products.transpose(0, 2, 1))
        n_free = len(products)
        curvature = products.reshape(n_free, -1) @ turned.reshape(n_free, -1).T
        score = variances * (sizes - traces)
        return score, 2.0 * variances[:, None] * variances * curvature


def estimate_noise(
    residual: FloatArray,
    jacobian: FloatArray,
    components: tuple[NoiseComponent, ...],
    known: FloatArray,
    start: FloatArray | None = None,
) -> NoiseEstimate:
    """Maximise the restricted likelihood of residuals (M,) with Jacobian (M, K) by scoring.

    ``known`` (M, M) is added to the covariance and not estimated: of probed plane and sensor.
    ``start`` (C,) are the standard deviations to begin with; those of the components if None.
    """
    posterior = _Posterior.of(residual, jacobian, components, known)
    free, precision = posterior.free, posterior.precision
    log_covariance = np.zeros((len(components), len(components)))
    if len(free) == 0:
        return NoiseEstimate(posterior.typical, log_covariance)
    logs = posterior.logs(posterior.typical if start is None else start)
    value, solution = posterior.at(logs)
    information, is_settled = precision, False
    for _ in range(MAX_SCORING_STEPS):
        if solution is None:
            break
        score, information = posterior.score(logs, solution)
        score -= precision @ logs
        information += precision
        step = np.linalg.solve(information, score)
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max()))
        for _ in range(6):
            trial = posterior.at(logs + step)
            if trial[0] >= value - 1e-9:
                break
            step *= 0.3
        else:
            is_settled = float(np.abs(step).max()) < SCORING_SETTLED
            break
        logs, (value, solution) = logs + step, trial
        is_settled = float(np.abs(step).max()) < SCORING_SETTLED
        if is_settled:
            break
    log_covariance[np.ix_(free, free)] = np.linalg.inv(information)
    return NoiseEstimate(posterior.sigmas(logs), log_covariance, is_settled)


@dataclass(frozen=True, slots=True, eq=False)
class SolutionCovariance:
    """Second moments of a solution's errors, and how much longer their tails are than normal ones.

    Parameters
    ----------
    matrix
        (K, K) covariance.
    region_factor
        What the usual 95 % limit of the hand-eye's ``e' C^-1 e`` is to be multiplied with so that
        95 % of the errors lie within it; at least 1.
    """

    matrix: FloatArray
    region_factor: float = 1.0


class CommonCentre(NamedTuple):
    """Derivatives (M, K), causes of scatter and known covariance (M, M) about a ball's one centre.

    About the centre that each stripe itself asks for, where the arm threw it, the throw passes for
    geometry: a stripe near a great circle would tell of what lies beside its sheet.
    """

    jacobian: FloatArray
    components: tuple[NoiseComponent, ...]
    known: FloatArray


def covariance_over_noise(
    residual: FloatArray,
    jacobian: FloatArray,
    components: tuple[NoiseComponent, ...],
    known: FloatArray,
    estimate: NoiseEstimate,
    *,
    n_unit: int = 0,
    common: CommonCentre | None = None,
) -> SolutionCovariance:
    """Covariance of the solution with the estimated scatter not taken as known.

    The mean covariance over the standard deviations that the residuals leave likely, plus the
    covariance of the solutions that they lead to: an integral over their posterior by importance
    sampling. It is what the errors' squares are on average. No covariance says more of errors whose
    scatter is uncertain: of few postures, more than 5 % of them lie outside the usual 95 % region,
    which therefore has its own factor. The last ``n_unit`` unknowns of the ``jacobian`` are known
    beforehand, to a variance of 1, and are not in ``known``, the covariance of the residuals. The
    covariances are those of ``common`` where it is given; how likely they are, and what the
    solutions move by, are not.

    Raises
    ------
    EstimationError
        If the covariance of the residuals is not positive definite.
    """
    posterior = _Posterior.of(residual, jacobian, components, known)
    about = CommonCentre(jacobian, components, known) if common is None else common
    of_stated = _Posterior.of(residual, about.jacobian, about.components, about.known)
    free, mode = posterior.free, posterior.logs(estimate.sigmas)
    centre = _solve(residual, jacobian, posterior.covariance(mode), n_unit)
    stated = _solve(residual, about.jacobian, of_stated.covariance(mode), n_unit)
    if centre is None or stated is None:
        raise EstimationError(
            "the covariance of the hand-eye's residuals is not positive definite",
            remedy="check the standard deviations given, and the poses",
        )
    spread = estimate.log_covariance[np.ix_(free, free)]
    if len(free) == 0 or not spread.any():
        return SolutionCovariance(stated.covariance)
    try:
        factor = np.sqrt(INFLATION) * np.linalg.cholesky(0.5 * (spread + spread.T))
    except LinAlgError:
        raise EstimationError(
            "the postures do not tell how much each cause scatters",
            remedy="take more postures, or give the arm's scatter",
        ) from None
    parts, moved, weights = [], [], []
    for draw in normal_draws(len(free)):
        logs = mode + factor @ draw
        one = _solve(residual, jacobian, posterior.covariance(logs), n_unit)
        own = one
        if common is not None:
            own = _solve(residual, about.jacobian, of_stated.covariance(logs), n_unit)
        if one is not None and own is not None:
            likelihood = one.log_likelihood - 0.5 * float(logs @ posterior.precision @ logs)
            parts.append(own.covariance)
            moved.append(one.step - centre.step)
            weights.append(likelihood + 0.5 * float(draw @ draw))
    share = np.exp(np.array(weights) - max(weights))
    share /= share.sum()
    steps = np.array(moved)
    errors = np.array(parts) + steps[:, :, None] * steps[:, None, :]
    mixed = np.einsum("m,mij->ij", share, errors)
    return SolutionCovariance(mixed, _region_factor(mixed, errors, share))


def _region_factor(mixed: FloatArray, parts: FloatArray, share: FloatArray) -> float:
    """Factor on a covariance that makes its joint 95 % region hold 95 % of a mixture (n, K, K).

    ``share`` (n,) are the parts' weights. Within one part the quadratic form is a weighted sum of
    chi-squares, taken as one chi-square of equal mean and variance (Satterthwaite).
    """
    block = slice(0, N_HAND_EYE)
    shapes = np.linalg.solve(mixed[block, block], parts[:, block, block])
    mean = np.einsum("mii->m", shapes)
    square = np.einsum("mij,mji->m", shapes, shapes)
    limit = float(chdtri(N_HAND_EYE, 1.0 - REGION))

    def excess(factor: float) -> float:
        held = chdtr(mean**2 / square, factor * limit * mean / square)
        return float(share @ held) - REGION

    return 1.0 if excess(1.0) >= 0.0 else float(brentq(excess, 1.0, 100.0))
