# SPDX-License-Identifier: Apache-2.0
"""Why points do not lie on the reference: causes of scatter, and how large each is.

The arm's pose errs by a shift of the scan point and a turn about it, alike for all points of a
posture, and by a smaller part that is new in every exposure. A plate is uneven by a smooth random
function of the place on it, so that postures which look at the same place see the same error. The
light sheets are not quite what their parameters describe, by another smooth function, of the place
on the sheet, the same in all postures. A stripe on a sphere may have the wrong curvature. Only the
stripe's own noise is independent.

Standard deviations that nobody gave come from restricted maximum likelihood: the likelihood of
those combinations of the residuals that no hand-eye can change, so that the fitted parameters do
not make the scatter look too small. A dozen postures say little about each cause, so the logarithm
of every standard deviation is held near its typical value by a wide normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import brentq
from scipy.stats import chi2

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
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.calibration import SHEET_PARAMETER_NAMES, ArmNoise
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES

ROTATION_LEVER_MM = 265.0
"""Scatter of the scan point over scatter of the orientation: 0.0053 mm and 0.00115 degrees for an
arm of 0.02 mm repeatability. Stands in where the orientation's scatter is not given: on stripes
of some tens of mm it hardly shows."""
TYPICAL_ARM_MM = 0.006
TYPICAL_ARM_ON_SPHERE_MM = 0.03
"""Robots scan spheres more often than plates, and scatter by 0.1 mm."""
TYPICAL_EXPOSURE_MM = 0.001
TYPICAL_FLATNESS_MM = 0.003
TYPICAL_FORM_MM = 0.003
TYPICAL_SHEET_SHAPE_MM = 0.001
"""What plane and bow leave of the sheets of simulated heads, root mean square."""
SHEET_SHAPE_LENGTH_MM = 15.0
"""Half a calibrated region and less: what is longer, plane and bow take up."""
WIDE = 1.0
"""Standard deviation of the logarithm of a scatter about its typical value: a factor of 2.7."""
VERY_WIDE = 2.0
"""Of arms and robots, and of the form of their sensors' stripes on a sphere: a factor of 7."""
NARROW = 0.5
"""Of the stripe's noise on a sphere, which the section circles have shown: a factor of 1.6."""
LEAST_STRIPE_MM = 1e-5
REGION = 0.95
MAX_SCORING_STEPS = 30
SCORING_SETTLED = 1e-3
LONGEST_STEP = 1.0
MAX_LOG = 7.0
"""A standard deviation leaves its typical value by a factor of 1100 at most."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseComponent:
    """One cause of scatter: ``arm``, ``exposure``, each with its ``rotation``, ``flatness``, ...

    ``covariance`` (M, M) is that of the residuals when ``sigma`` is 1. ``sigma`` is given, or
    typical where it is estimated; ``log_width`` is the standard deviation of its logarithm then.
    """

    name: str
    covariance: FloatArray
    sigma: float
    is_estimated: bool = False
    log_width: float = WIDE


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
    shift, turn = by_pose[:, :3] @ by_pose[:, :3].T, by_pose[:, 3:] @ by_pose[:, 3:].T
    posture = _same(observations.posture)
    if weights is not None:
        posture = posture / weights[observations.posture][:, None]
    is_plate = isinstance(surface, PlateSurface)
    components = _pose_components(
        "arm",
        (posture * shift, posture * turn),
        (options.arm_position_mm, options.arm_rotation_rad),
        (TYPICAL_ARM_MM, WIDE) if is_plate else (TYPICAL_ARM_ON_SPHERE_MM, VERY_WIDE),
    )
    own = np.diag(_stripe_variance_mm2(observations, placed))
    stripe = _component(
        "stripe", own, options.stripe_noise_factor, 1.0, WIDE if is_plate else NARROW
    )
    if not isinstance(surface, PlateSurface):
        form = _component("form", _same(observations.stripe), None, TYPICAL_FORM_MM, VERY_WIDE)
        return (*components, form, stripe)
    if _has_exposure_part(observations, options):
        exposure = _same(observations.stripe)
        components += _pose_components(
            "exposure",
            (exposure * shift, exposure * turn),
            (options.exposure_position_mm, options.exposure_rotation_rad),
            (TYPICAL_EXPOSURE_MM, WIDE),
        )
    on_plate = (placed.points_base_mm - surface.plane.point_mm) @ surface.plane.axes[:2].T
    alike = _alike(on_plate, options.flatness_length_mm)
    return (
        *components,
        _component("flatness", alike, options.plate_flatness_mm, TYPICAL_FLATNESS_MM),
        *_sheet_shape(observations, placed, options),
        stripe,
    )


def _has_exposure_part(observations: CondensedObservations, options: HandEyeOptions) -> bool:
    """True if a part that is new in every exposure was given, or can be told from the posture's."""
    if options.exposure_position_mm is not None or options.exposure_rotation_rad is not None:
        return True
    is_repeated = len(np.unique(observations.stripe)) > len(observations.used_postures)
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
    name: str,
    covariances: tuple[FloatArray, FloatArray],
    given: tuple[float | None, float | None],
    typical: tuple[float, float],
) -> tuple[NoiseComponent, ...]:
    """Shift and turn of one pose; the turn follows the shift unless it is given."""
    position, rotation = given
    if rotation is None:
        tied = covariances[0] + covariances[1] / ROTATION_LEVER_MM**2
        return (_component(name, tied, position, *typical),)
    return (
        _component(name, covariances[0], position, *typical),
        NoiseComponent(f"{name} rotation", covariances[1], rotation),
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
    arm, exposure = known.get("arm", 0.0), known.get("exposure", 0.0)
    return ArmNoise(
        position_mm=arm,
        rotation_rad=known.get("arm rotation", arm / ROTATION_LEVER_MM),
        exposure_position_mm=exposure,
        exposure_rotation_rad=known.get("exposure rotation", exposure / ROTATION_LEVER_MM),
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
    try:
        factor = cho_factor(covariance, lower=True)
        inverse = cho_solve(factor, np.eye(len(covariance)))
        weighted = inverse @ jacobian
        normal = jacobian.T @ weighted
        normal_factor = cho_factor(0.5 * (normal + normal.T), lower=True)
    except LinAlgError:
        return None
    solved = cho_solve(normal_factor, np.eye(jacobian.shape[1]))
    gain = solved @ weighted.T
    projected = inverse - weighted @ gain
    determinants = np.log(np.diag(factor[0])).sum() + np.log(np.diag(normal_factor[0])).sum()
    quadratic = float(residual @ projected @ residual)
    return LinearSolution(
        step=-gain @ residual,
        covariance=0.5 * (solved + solved.T),
        projected=0.5 * (projected + projected.T),
        gain=gain,
        log_likelihood=-0.5 * quadratic - float(determinants),
    )


@dataclass(frozen=True, slots=True, eq=False)
class NoiseEstimate:
    """Standard deviations (C,) of the causes of scatter, and covariance (C, C) of their logarithms.

    Given ones are included, with a covariance of zero.
    """

    sigmas: FloatArray
    log_covariance: FloatArray


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
    typical = np.array([component.sigma for component in components])
    free = np.flatnonzero([c.is_estimated for c in components]).astype(np.int64)
    sigmas = typical.copy() if start is None else start.copy()
    log_covariance = np.zeros((len(components), len(components)))
    if len(free) == 0:
        return NoiseEstimate(sigmas, log_covariance)
    widths = np.array([components[k].log_width for k in free])

    def posterior(sigmas: FloatArray) -> tuple[float, FloatArray, LinearSolution | None]:
        logs = np.log(sigmas[free] / typical[free])
        solution = solve_linear(residual, jacobian, total_covariance(components, sigmas) + known)
        likelihood = -np.inf if solution is None else solution.log_likelihood
        return likelihood - 0.5 * float(((logs / widths) ** 2).sum()), logs, solution

    value, logs, solution = posterior(sigmas)
    information = np.diag(1.0 / widths**2)
    for _ in range(MAX_SCORING_STEPS):
        if solution is None:
            break
        score, information = _score(residual, solution, components, sigmas, free)
        score -= logs / widths**2
        information += np.diag(1.0 / widths**2)
        step = np.linalg.solve(information, score)
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max()))
        for _ in range(6):
            tried = sigmas.copy()
            tried[free] = typical[free] * np.exp(np.clip(logs + step, -MAX_LOG, MAX_LOG))
            trial = posterior(tried)
            if trial[0] >= value - 1e-9:
                break
            step *= 0.3
        else:
            break
        sigmas, (value, logs, solution) = tried, trial
        if float(np.abs(step).max()) < SCORING_SETTLED:
            break
    log_covariance[np.ix_(free, free)] = np.linalg.inv(information)
    return NoiseEstimate(sigmas, log_covariance)


def _score(
    residual: FloatArray,
    solution: LinearSolution,
    components: tuple[NoiseComponent, ...],
    sigmas: FloatArray,
    free: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivative of the restricted log-likelihood by log sigma, and its expected curvature."""
    explained = solution.projected @ residual
    products = [2.0 * sigmas[k] ** 2 * solution.projected @ components[k].covariance for k in free]
    score = np.array(
        [
            sigmas[k] ** 2 * float(explained @ components[k].covariance @ explained)
            - 0.5 * float(np.trace(product))
            for k, product in zip(free, products, strict=True)
        ]
    )
    information = np.array(
        [[0.5 * float((one * other.T).sum()) for other in products] for one in products]
    )
    return score, information


def covariance_over_noise(
    residual: FloatArray,
    jacobian: FloatArray,
    components: tuple[NoiseComponent, ...],
    known: FloatArray,
    estimate: NoiseEstimate,
) -> FloatArray:
    """(K, K) covariance of the solution with the estimated scatter not taken as known.

    The mean covariance over the likely standard deviations, plus the covariance of the solutions
    that they lead to, by two sigma points along each axis of ``log_covariance``. Errors of
    uncertain scatter have longer tails than a normal distribution of the same covariance; it is
    widened until the usual 95 % region of the hand-eye holds 95 % of them.
    """

    def solved(sigmas: FloatArray) -> LinearSolution | None:
        return solve_linear(residual, jacobian, total_covariance(components, sigmas) + known)

    values, axes = np.linalg.eigh(estimate.log_covariance)
    used = np.flatnonzero(values > 1e-12)
    centre = solved(estimate.sigmas)
    if centre is None or len(used) == 0:
        return np.zeros((jacobian.shape[1],) * 2) if centre is None else centre.covariance
    covariances, steps = [], []
    for k in used:
        for sign in (-1.0, 1.0):
            logs = sign * np.sqrt(len(used) * values[k]) * axes[:, k]
            solution = solved(estimate.sigmas * np.exp(logs))
            if solution is not None:
                covariances.append(solution.covariance)
                steps.append(solution.step - centre.step)
    if not steps:
        return centre.covariance
    parts, moved = np.array(covariances), np.array(steps)
    mixed = parts.mean(axis=0) + moved.T @ moved / len(moved)
    return np.asarray(_widening(mixed, parts + moved[:, :, None] * moved[:, None, :]) * mixed)


def _widening(mixed: FloatArray, parts: FloatArray) -> float:
    """Factor on a covariance that makes its joint 95 % region hold 95 % of a mixture (n, K, K).

    Within one part the quadratic form is a weighted sum of chi-squares, taken as one chi-square of
    equal mean and variance (Satterthwaite).
    """
    block = slice(0, N_HAND_EYE)
    shapes = np.linalg.solve(mixed[block, block], parts[:, block, block])
    mean = np.einsum("mii->m", shapes)
    square = np.einsum("mij,mji->m", shapes, shapes)
    limit = float(chi2.ppf(REGION, N_HAND_EYE))

    def excess(factor: float) -> float:
        held = chi2.cdf(factor * limit * mean / square, mean**2 / square)
        return float(np.mean(held)) - REGION

    return 1.0 if excess(1.0) >= 0.0 else float(brentq(excess, 1.0, 100.0))
