# SPDX-License-Identifier: Apache-2.0
"""The hand-eye on a plate by generalised least squares, noise levels by restricted maximum
likelihood, leave-one-posture-out and the search for postures whose pose is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.stats import chi2
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.observations import (
    N_HAND_EYE,
    HandEyeOptions,
    PlacedNodes,
    PlateNodes,
    PlateReference,
    PlateState,
    place_nodes,
    sensor_covariance,
)
from armscan.calibration.hand_eye.search import Start
from armscan.calibration.hand_eye.solve import (
    LinearSolution,
    NoiseComponent,
    Refined,
    design,
    noise_components,
    plane_covariance,
    refine,
    solve_linear,
    total_covariance,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

REGION = 0.95
MAX_ROUNDS = 30
SETTLED = 1e-3
LONGEST_STEP = 1.0
MAX_LOG = 7.0
"""A standard deviation leaves its typical value by a factor of 1100 at most."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseEstimate:
    """Standard deviations of the causes of scatter.

    Parameters
    ----------
    sigmas
        (C,) of each component, given ones included.
    log_covariance
        (C, C) of their logarithms; zero for given ones.
    """

    sigmas: FloatArray
    log_covariance: FloatArray


def estimate_noise(
    residual: FloatArray,
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    fixed: FloatArray,
    start: FloatArray | None = None,
) -> NoiseEstimate:
    """Maximise the restricted likelihood by scoring.

    Parameters
    ----------
    residual, slopes
        (N,) and (N, K) at the minimum.
    components
        Causes of scatter.
    fixed
        (N, N) covariance that is added and not estimated (the probed plane).
    start
        (C,) standard deviations to begin with; those of the components if None.
    """
    typical = np.array([component.sigma for component in components])
    free = np.flatnonzero([c.is_estimated for c in components]).astype(np.int64)
    sigmas = typical.copy() if start is None else start.copy()
    spread = np.zeros((len(components), len(components)))
    if len(free) == 0:
        return NoiseEstimate(sigmas, spread)
    widths = np.array([components[k].log_width for k in free])
    reach = np.log(sigmas[free] / typical[free])
    posterior, solution = _posterior(residual, slopes, components, fixed, sigmas)
    posterior -= 0.5 * float(((reach / widths) ** 2).sum())
    information = np.diag(1.0 / widths**2)
    for _ in range(MAX_ROUNDS):
        if solution is None:
            break
        score, information = _score(residual, solution, components, sigmas, free)
        score -= reach / widths**2
        information += np.diag(1.0 / widths**2)
        step = np.linalg.solve(information, score)
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max()))
        for _ in range(6):
            trial = np.clip(reach + step, -MAX_LOG, MAX_LOG)
            tried = sigmas.copy()
            tried[free] = typical[free] * np.exp(trial)
            value, at_trial = _posterior(residual, slopes, components, fixed, tried)
            value -= 0.5 * float(((trial / widths) ** 2).sum())
            if value >= posterior - 1e-9:
                break
            step *= 0.3
        else:
            break
        reach, sigmas, posterior, solution = trial, tried, value, at_trial
        if float(np.abs(step).max()) < SETTLED:
            break
    spread[np.ix_(free, free)] = np.linalg.inv(information)
    return NoiseEstimate(sigmas, spread)


def _posterior(
    residual: FloatArray,
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    fixed: FloatArray,
    sigmas: FloatArray,
) -> tuple[float, LinearSolution | None]:
    solution = solve_linear(residual, slopes, total_covariance(components, sigmas) + fixed)
    return (-np.inf if solution is None else solution.log_likelihood), solution


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
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    fixed: FloatArray,
    estimate: NoiseEstimate,
) -> FloatArray:
    """(K, K) covariance of the solution with the estimated scatter not taken as known.

    The mean covariance over the spread of the standard deviations, plus the spread of the
    solutions that they lead to, by two sigma points along each axis of ``log_covariance``. Errors
    of uncertain scatter have longer tails than a normal distribution of the same covariance; it is
    widened until the usual 95 % region of the hand-eye holds 95 % of them.
    """
    values, axes = np.linalg.eigh(estimate.log_covariance)
    used = np.flatnonzero(values > 1e-12)
    centre = solve_linear(residual, slopes, total_covariance(components, estimate.sigmas) + fixed)
    if centre is None or len(used) == 0:
        return np.zeros((slopes.shape[1],) * 2) if centre is None else centre.covariance
    covariances, steps = [], []
    for k in used:
        for sign in (-1.0, 1.0):
            reach = sign * np.sqrt(len(used) * values[k]) * axes[:, k]
            sigmas = estimate.sigmas * np.exp(reach)
            solution = solve_linear(residual, slopes, total_covariance(components, sigmas) + fixed)
            if solution is not None:
                covariances.append(solution.covariance)
                steps.append(solution.step - centre.step)
    if not steps:
        return centre.covariance
    own, moved = np.array(covariances), np.array(steps)
    mixed = own.mean(axis=0) + moved.T @ moved / len(moved)
    return np.asarray(_widening(mixed, own + moved[:, :, None] * moved[:, None, :]) * mixed)


def _widening(mixed: FloatArray, parts: FloatArray) -> float:
    """Factor on a covariance that makes its joint 95 % region hold 95 % of a mixture (M, K, K).

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


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """One posture predicted by the others.

    Parameters
    ----------
    change
        (K,) change of the solution when the posture is left out.
    normalised
        Root mean square of its predicted residuals over their standard deviation.
    probability
        Of a shift and slope of its stripe as large as these, if its pose errs as the others do.
    shift_mm
        Mean distance of its points from where the others predict them.
    """

    change: FloatArray
    normalised: float
    probability: float
    shift_mm: float


def leave_out(
    residual_mm: FloatArray, solution: LinearSolution, own: IntArray, along_mm: FloatArray
) -> LeftOut:
    """Leave the nodes ``own`` (M,) out of a generalised least-squares solution.

    Leaving observations out is giving each of them an unknown of its own: with P of
    `LinearSolution` the prediction error of the block is ``P_kk^-1 (P e)_k`` and has covariance
    ``P_kk^-1``. What the others tell of the plate's flatness there is taken into account.

    Parameters
    ----------
    residual_mm
        (N,) residuals at the minimum.
    solution
        Linearised there.
    own
        Nodes of the posture.
    along_mm
        (M,) place of these nodes along the stripe.
    """
    block = solution.projected[np.ix_(own, own)]
    explained = (solution.projected @ residual_mm)[own]
    values, vectors = np.linalg.eigh(block)
    used = values > 1e-10 * values[-1]
    inverse = (vectors[:, used] / values[used]) @ vectors[:, used].T
    predicted = inverse @ explained
    shape = np.column_stack([np.ones(len(own)), along_mm - along_mm.mean()])
    score = shape.T @ explained
    weight = shape.T @ block @ shape
    statistic = float(score @ np.linalg.pinv(weight, rcond=1e-10) @ score)
    return LeftOut(
        solution.gain[:, own] @ predicted,
        float(np.sqrt(max(float(explained @ predicted), 0.0) / max(int(used.sum()), 1))),
        float(chi2_distribution.sf(statistic, 2)),
        float(predicted.mean()),
    )


def leave_each_out(
    nodes: PlateNodes, residual_mm: FloatArray, solution: LinearSolution
) -> dict[int, LeftOut]:
    """Leave out every posture in turn; keys are posture numbers."""
    result = {}
    for posture in nodes.used_postures:
        own = np.flatnonzero(nodes.posture == posture)
        points = nodes.points_mm[own] - nodes.points_mm[own].mean(axis=0)
        _, _, axes = np.linalg.svd(points, full_matrices=False)
        result[int(posture)] = leave_out(residual_mm, solution, own, points @ axes[0])
    return result


PLATE_FIT_MAX_ROUNDS = 4
SETTLED_LOG = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class PlateFit:
    """A refined hand-eye with its noise model.

    Parameters
    ----------
    refined
        Minimum; its plane is the probed one unless it was solved along.
    slopes
        (N, K) derivative of the residuals, K = 6 or 9.
    components, noise
        Causes of scatter and their standard deviations.
    total
        (N, N) covariance of the residuals, by the probed plane and, unless it is held
        (`hold_sensor`), by the sensor too.
    linear
        Solution linearised at the minimum.
    covariance
        (K, K) of the parameters, estimated scatter not taken as known, without the sensor's part.
    """

    refined: Refined
    slopes: FloatArray
    components: tuple[NoiseComponent, ...]
    noise: NoiseEstimate
    total: FloatArray
    linear: LinearSolution
    covariance: FloatArray

    @property
    def degrees_of_freedom(self) -> int:
        """Residuals less unknowns."""
        n_residuals, n_unknowns = self.slopes.shape
        return int(n_residuals - n_unknowns)


def fit_plate(
    nodes: PlateNodes,
    plate: PlateReference,
    start: PlateState,
    options: HandEyeOptions,
    sigmas: FloatArray | None = None,
    *,
    hold_noise: bool = False,
) -> PlateFit | FitFailure:
    """Refine a hand-eye.

    Parameters
    ----------
    nodes, plate
        Data and reference.
    start
        Close to the solution.
    options
        Noise model, and whether the plate is solved along.
    sigmas
        Standard deviations to begin with; typical ones if None.
    hold_noise
        Keep these standard deviations.
    """
    state = start
    placed = place_nodes(nodes, plate.plane, state)
    components = noise_components(nodes, placed, plate.plane, options)
    if sigmas is None:
        sigmas = np.array([component.sigma for component in components])
    for _ in range(PLATE_FIT_MAX_ROUNDS):
        placed = place_nodes(nodes, plate.plane, state)
        components = noise_components(nodes, placed, plate.plane, options)
        fixed = known_covariance(nodes, placed, plate, options)
        total = total_covariance(components, sigmas) + fixed
        try:
            refined = refine(nodes, plate.plane, state, total, solve_plate=options.solve_plate)
        except LinAlgError:
            return _no_solution()
        slopes = design(refined.placed, options.solve_plate)
        noise = NoiseEstimate(sigmas, np.zeros((len(sigmas), len(sigmas))))
        if not hold_noise:
            noise = estimate_noise(refined.placed.residual_mm, slopes, components, fixed, sigmas)
        change = np.log((noise.sigmas + 1e-12) / (sigmas + 1e-12))
        state, sigmas = refined.state, noise.sigmas
        if float(np.abs(change).max()) < SETTLED_LOG:
            break
    total = total_covariance(components, sigmas) + fixed
    refined = refine(nodes, plate.plane, state, total, solve_plate=options.solve_plate)
    slopes, residual = design(refined.placed, options.solve_plate), refined.placed.residual_mm
    linear = solve_linear(residual, slopes, total)
    if linear is None:
        return _no_solution()
    covariance = covariance_over_noise(residual, slopes, components, fixed, noise)
    by_sensor = sensor_covariance(nodes, placed)
    if by_sensor is not None:
        covariance -= linear.gain @ by_sensor @ linear.gain.T
    return PlateFit(refined, slopes, components, noise, total, linear, covariance)


def known_covariance(
    nodes: PlateNodes, placed: PlacedNodes, plate: PlateReference, options: HandEyeOptions
) -> FloatArray:
    """(N, N) covariance of the residuals by the probed plane and by the sensor's calibration.

    Both err alike in all postures. The plane is left out where it is solved along or exact.
    """
    by_plane = _covariance_by_plane(placed, plate, options)
    by_sensor = sensor_covariance(nodes, placed)
    return by_plane if by_sensor is None else by_plane + by_sensor


def _covariance_by_plane(
    placed: PlacedNodes, plate: PlateReference, options: HandEyeOptions
) -> FloatArray:
    if options.solve_plate or plate.covariance is None:
        return np.zeros((len(placed.residual_mm), len(placed.residual_mm)))
    return plane_covariance(placed, plate.covariance)


def hold_sensor(
    nodes: PlateNodes, plate: PlateReference, fit: PlateFit, options: HandEyeOptions
) -> PlateFit | FitFailure:
    """The hand-eye that belongs to the sensor as it is stored, under the scatter of ``fit``.

    A fit that knows the sensor's covariance explains a part of the residuals by a sensor that is
    moved within it: its hand-eye is that of the moved sensor, and beside the stored one it makes
    wrong points. Here the sensor stands still and the hand-eye takes up what it can of the
    sensor's errors. Its ``total`` and ``covariance`` are without the sensor's part.
    """
    placed = fit.refined.placed
    by_sensor = sensor_covariance(nodes, placed)
    if by_sensor is None:
        return fit
    by_plane = _covariance_by_plane(placed, plate, options)
    total = total_covariance(fit.components, fit.noise.sigmas) + by_plane
    try:
        refined = refine(
            nodes, plate.plane, fit.refined.state, total, solve_plate=options.solve_plate
        )
    except LinAlgError:
        return _no_solution()
    slopes = design(refined.placed, options.solve_plate)
    linear = solve_linear(refined.placed.residual_mm, slopes, total)
    if linear is None:
        return _no_solution()
    # What the sensor's errors leave in the residuals is the coupling's part, not the scatter's.
    own = placed.residual_mm - by_sensor @ fit.linear.projected @ placed.residual_mm
    covariance = covariance_over_noise(own, slopes, fit.components, by_plane, fit.noise)
    return replace(
        fit, refined=refined, slopes=slopes, total=total, linear=linear, covariance=covariance
    )


def plane_after(fit: PlateFit, plate: PlateReference) -> FloatArray:
    """(3,) tilts and offset of the plate as the scan and the probing together give them."""
    if len(fit.linear.step) > N_HAND_EYE or plate.covariance is None:
        return fit.refined.state.plane
    explained = fit.linear.projected @ fit.refined.placed.residual_mm
    return np.asarray(-plate.covariance @ fit.refined.placed.by_plane.T @ explained)


def hand_eye_information(slopes: FloatArray, total: FloatArray) -> FloatArray:
    """(6, 6) inverse covariance of the hand-eye, a free plane eliminated; any rank.

    Raises
    ------
    LinAlgError
        If the covariance ``total`` is not positive definite.
    """
    whitened = solve_triangular(np.linalg.cholesky(total), slopes, lower=True)
    hand_eye, others = whitened[:, :N_HAND_EYE], whitened[:, N_HAND_EYE:]
    if others.shape[1]:
        basis, _ = np.linalg.qr(others)
        hand_eye = hand_eye - basis @ (basis.T @ hand_eye)
    return np.asarray(hand_eye.T @ hand_eye)


def _no_solution() -> FitFailure:
    return FitFailure(
        "the refinement found no minimum: the noise model or the data are degenerate",
        "check the standard deviations given, and the poses",
    )


MAX_WRONG_SHARE = 0.34
LEAST_LEFT = 6
SUSPECT_PROBABILITY = 0.2
WRONG_PROBABILITY = 1e-5
"""Probability, among as many postures, of a shift and slope like those of the posture."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedFit:
    """A refined hand-eye, the nodes it rests on, and what is weak about it, in words.

    ``widening`` (6, 6) is added to the hand-eye's covariance for what contradicts it a little;
    ``plane_check`` says what the stripes alone say of the plate.
    """

    fit: PlateFit
    nodes: PlateNodes
    warnings: tuple[str, ...]
    widening: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    plane_check: str = ""


def fit_without_wrong_postures(
    nodes: PlateNodes,
    plate: PlateReference,
    start: Start,
    first: PlateFit,
    options: HandEyeOptions,
) -> CheckedFit | FitFailure:
    """Leave out postures whose pose is wrong.

    Gross ones are known from the start. Of the rest, the posture that the others predict worst is
    left out for trial; if the scatter of the others then makes its distance all but impossible, it
    stays out, and the next one is tried. ``first`` is the fit without the gross ones.
    """
    n_all = len(nodes.used_postures)
    wrong = start.is_wrong.copy()
    refusal = _refuse_many(nodes, wrong, n_all)
    if refusal is not None:
        return refusal
    gross = wrong.copy()
    fit = first
    while True:
        kept = nodes.select(~wrong[nodes.posture])
        suspect = _suspect(kept, fit)
        if suspect is None or len(kept.used_postures) <= LEAST_LEFT:
            break
        trial = wrong.copy()
        trial[suspect] = True
        without = fit_plate(nodes.select(~trial[nodes.posture]), plate, fit.refined.state, options)
        if isinstance(without, FitFailure) or not _is_contradicted(
            kept, plate, without, options, suspect
        ):
            break
        wrong, fit = trial, without
        refusal = _refuse_many(nodes, wrong, n_all)
        if refusal is not None:
            return refusal
    warnings = _in_words(nodes, wrong, gross, start.rms_mm)
    return CheckedFit(fit, nodes.select(~wrong[nodes.posture]), warnings)


def _suspect(nodes: PlateNodes, fit: PlateFit) -> int | None:
    left = leave_each_out(nodes, fit.refined.placed.residual_mm, fit.linear)
    worst = min(left, key=lambda number: left[number].probability)
    likely = left[worst].probability * len(left)
    return worst if likely < SUSPECT_PROBABILITY else None


def _is_contradicted(
    nodes: PlateNodes,
    plate: PlateReference,
    without: PlateFit,
    options: HandEyeOptions,
    suspect: int,
) -> bool:
    """Predict the suspect with the scatter that the other postures show."""
    judged = fit_plate(
        nodes, plate, without.refined.state, options, without.noise.sigmas, hold_noise=True
    )
    if isinstance(judged, FitFailure):
        return False
    left = leave_each_out(nodes, judged.refined.placed.residual_mm, judged.linear)
    return left[suspect].probability * len(left) < WRONG_PROBABILITY


def _refuse_many(nodes: PlateNodes, wrong: BoolArray, n_all: int) -> FitFailure | None:
    n_wrong = int(wrong[nodes.used_postures].sum())
    if n_wrong <= MAX_WRONG_SHARE * n_all:
        return None
    names = ", ".join(nodes.postures[k] for k in np.flatnonzero(wrong)[:8])
    return FitFailure(
        f"{n_wrong} of {n_all} postures contradict the others ({names})",
        "check that every exposure has its own pose (none missing, doubled or swapped) and that "
        "the plate did not move",
    )


def _in_words(
    nodes: PlateNodes, wrong: BoolArray, gross: BoolArray, rms_mm: FloatArray
) -> tuple[str, ...]:
    """Name the postures that were left out."""
    warnings = []
    if gross.any():
        named = ", ".join(
            f"{nodes.postures[k]} ({rms_mm[k]:.2f} mm)" for k in np.flatnonzero(gross)
        )
        warnings.append(
            f"left out {int(gross.sum())} postures whose stripes lie far from where the others "
            f"put the plate: {named}; a missing, doubled or swapped pose looks like this"
        )
    mild = wrong & ~gross
    if mild.any():
        named = ", ".join(f"{nodes.postures[k]} ({rms_mm[k]:.3f} mm)" for k in np.flatnonzero(mild))
        warnings.append(
            f"left out {int(mild.sum())} postures that fit the others worse than their scatter "
            f"allows: {named}; the arm may have moved during the exposure, or the plate was dirty"
        )
    return tuple(warnings)
