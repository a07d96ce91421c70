# SPDX-License-Identifier: Apache-2.0
"""Refinement of the hand-eye on a sphere under the noise of pose and sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from armscan.calibration.hand_eye.least_squares import LinearSolution, solve_linear
from armscan.calibration.hand_eye.noise_model import (
    ROTATION_LEVER_MM,
    NoiseComponent,
    total_covariance,
)
from armscan.calibration.hand_eye.sphere_options import SphereOptions
from armscan.calibration.hand_eye.sphere_residuals import (
    N_COLUMNS,
    RADIUS_COLUMN,
    SCALE_COLUMN,
    PlacedOnSphere,
    SphereNodes,
    SphereState,
    covariance_by_sensor,
    place_on_sphere,
)
from armscan.calibration.hand_eye.variance_components import NoiseEstimate, estimate_noise
from armscan.geometry.arrays import FloatArray, IntArray

MAX_STEPS = 60
SETTLED = 1e-10
ROUNDS = 6
NOISE_SETTLED = 1e-3
TYPICAL_ARM_MM = 0.03
TYPICAL_FORM_MM = 0.003
FORM_LOG_WIDTH = 2.0
ARM_LOG_WIDTH = 2.0
"""Arms and robots differ by far more than one arm from day to day."""


@dataclass(frozen=True, slots=True, eq=False)
class SphereSolution:
    """A minimum with its noise model.

    Parameters
    ----------
    state, placed
        All unknowns, and the points placed with them.
    components, noise
        Causes of scatter and their standard deviations.
    by_sensor, total
        (M, M) covariance of the residuals by the sensor's calibration, which errs alike in all
        postures, and by everything that the solution weighs: not by a sensor that is held.
    linear
        Linearised at the minimum, in the free columns.
    free
        Columns of `PlacedOnSphere.slopes` that were solved for.
    posture_weights
        (K,) at most 1: below it, the posture's pose is trusted less.
    is_settled
        False if the steps ran out.
    """

    state: SphereState
    placed: PlacedOnSphere
    components: tuple[NoiseComponent, ...]
    noise: NoiseEstimate
    by_sensor: FloatArray
    total: FloatArray
    linear: LinearSolution
    free: IntArray
    posture_weights: FloatArray
    is_settled: bool

    @property
    def slopes(self) -> FloatArray:
        """(M, F) derivative of the residuals by the free unknowns."""
        return np.asarray(self.placed.slopes[:, self.free])


def free_columns(options: SphereOptions) -> IntArray:
    """Which of the eleven unknowns are solved for."""
    extra = [RADIUS_COLUMN] * options.solve_diameter + [SCALE_COLUMN] * options.solve_scale
    return np.array([*range(RADIUS_COLUMN), *extra])


def descend(
    nodes: SphereNodes,
    start: SphereState,
    covariance: FloatArray,
    free: IntArray,
    max_steps: int = MAX_STEPS,
) -> tuple[SphereState, float, bool]:
    """Minimise ``e' C^-1 e`` by damped Gauss-Newton steps: state, minimum, and if it settled."""
    root = np.linalg.cholesky(covariance)
    state, damping = start, 1e-4
    placed = place_on_sphere(nodes, state)
    residual = solve_triangular(root, placed.residual_mm, lower=True)
    chi2 = float(residual @ residual)
    for _ in range(max_steps):
        slopes = solve_triangular(root, placed.slopes[:, free], lower=True)
        scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-12)
        stacked = np.vstack([slopes / scale, np.sqrt(damping) * np.eye(len(free))])
        target = np.concatenate([-residual, np.zeros(len(free))])
        step = np.zeros(N_COLUMNS)
        step[free] = np.linalg.lstsq(stacked, target, rcond=1e-12)[0] / scale
        trial = state.stepped(step)
        moved = place_on_sphere(nodes, trial)
        whitened = solve_triangular(root, moved.residual_mm, lower=True)
        gain = chi2 - float(whitened @ whitened)
        if not gain >= 0.0:
            if damping > 1e8 or abs(gain) < SETTLED * chi2:
                return state, chi2, True
            damping = max(10.0 * damping, 1e-6)
            continue
        state, placed, residual, chi2 = trial, moved, whitened, chi2 - gain
        damping = max(0.1 * damping, 1e-15)
        if gain <= SETTLED * chi2 + 1e-18:
            return state, chi2, True
    return state, chi2, False


def refine_with_noise(
    nodes: SphereNodes, start: SphereState, options: SphereOptions, weights: FloatArray
) -> SphereSolution | None:
    """Minimise and estimate the scatter in turn; None where the postures leave unknowns open."""
    free = free_columns(options)
    state, sigmas, is_settled = start, None, False
    for _ in range(ROUNDS):
        placed = place_on_sphere(nodes, state)
        components = noise_of_sphere(nodes, placed, options, weights)
        by_sensor = covariance_by_sensor(nodes, placed)
        slopes = placed.slopes[:, free]
        if sigmas is None:
            sigmas = _first_sigmas(components, placed)
        noise = estimate_noise(placed.residual_mm, slopes, components, by_sensor, sigmas)
        change = float(np.abs(np.log((noise.sigmas + 1e-12) / (sigmas + 1e-12))).max())
        sigmas = noise.sigmas
        total = total_covariance(components, sigmas) + by_sensor
        state, _, is_settled = descend(nodes, state, total, free)
        if change < NOISE_SETTLED:
            break
    placed = place_on_sphere(nodes, state)
    linear = solve_linear(placed.residual_mm, placed.slopes[:, free], total)
    if linear is None:
        return None
    return SphereSolution(
        state, placed, components, noise, by_sensor, total, linear, free, weights, is_settled
    )


def hold_sensor(nodes: SphereNodes, solution: SphereSolution) -> SphereSolution | None:
    """The hand-eye that belongs to the sensor as it is stored, under the scatter of ``solution``.

    As `armscan.calibration.hand_eye.plate_fit.hold_sensor`: its ``total`` is without the sensor's
    part. None where that leaves unknowns open.
    """
    total = total_covariance(solution.components, solution.noise.sigmas)
    state, _, is_settled = descend(nodes, solution.state, total, solution.free)
    placed = place_on_sphere(nodes, state)
    linear = solve_linear(placed.residual_mm, placed.slopes[:, solution.free], total)
    if linear is None:
        return None
    return replace(
        solution,
        state=state,
        placed=placed,
        by_sensor=covariance_by_sensor(nodes, placed),
        total=total,
        linear=linear,
        is_settled=solution.is_settled and is_settled,
    )


def solve_at(
    nodes: SphereNodes, state: SphereState, options: SphereOptions
) -> LinearSolution | None:
    """Linear solution at a state whose residuals all count as the arm's; None if not solvable."""
    placed = place_on_sphere(nodes, state)
    weights = np.ones(len(nodes.postures))
    components = noise_of_sphere(nodes, placed, options, weights)
    total = total_covariance(components, _first_sigmas(components, placed))
    return solve_linear(placed.residual_mm, placed.slopes[:, free_columns(options)], total)


def noise_of_sphere(
    nodes: SphereNodes, placed: PlacedOnSphere, options: SphereOptions, weights: FloatArray
) -> tuple[NoiseComponent, ...]:
    """Causes of scatter: the arm's pose, common to a posture, the stripe's form, and its noise.

    A stripe whose points all lie a little too far out has the wrong curvature, which the arm's pose
    does not explain: a profile's scale, light that enters the surface. Where the section is nearly
    a great circle, a hundredth of a millimetre of it moves the sphere's centre by a whole one.
    """
    same = (nodes.posture[:, None] == nodes.posture[None, :]) / weights[nodes.posture][:, None]
    shift = same * (placed.by_pose[:, :3] @ placed.by_pose[:, :3].T)
    turn = same * (placed.by_pose[:, 3:] @ placed.by_pose[:, 3:].T)
    position, rotation = options.arm_position_mm, options.arm_rotation_rad
    sigma = TYPICAL_ARM_MM if position is None else position
    tied = shift if rotation is not None else shift + turn / ROTATION_LEVER_MM**2
    arm = [NoiseComponent("arm", tied, sigma, position is None, ARM_LOG_WIDTH)]
    if rotation is not None:
        arm.append(NoiseComponent("arm rotation", turn, rotation))
    section = np.asarray(nodes.section[:, None] == nodes.section[None, :], dtype=np.float64)
    form = NoiseComponent("form", section, TYPICAL_FORM_MM, True, FORM_LOG_WIDTH)
    own = NoiseComponent("stripe", np.diag(nodes.sigma_mm**2), 1.0, True, 0.5)
    return (*arm, form, own)


def _first_sigmas(components: tuple[NoiseComponent, ...], placed: PlacedOnSphere) -> FloatArray:
    sigmas = np.array([one.sigma for one in components])
    if components[0].is_estimated:
        sigmas[0] = max(float(np.sqrt(np.mean(placed.residual_mm**2))), 1e-4)
    return sigmas


def with_weights(nodes: SphereNodes, solution: SphereSolution, limit: float) -> FloatArray:
    """(K,) weights of the postures: below 1 where the pose errs by more than ``limit`` sigmas.

    They fall with the fourth power, so that a gross error does not swell the arm's scatter.
    """
    errors = np.array(
        [leave_out(nodes, solution, k).pose_sigmas for k in range(len(nodes.postures))]
    )
    return np.asarray(np.minimum(1.0, (limit / np.maximum(errors, 1e-9)) ** 4))


@dataclass(frozen=True, slots=True)
class LeftOutPosture:
    """A posture predicted by the others: change (F,) of the solution, size of its pose's error."""

    change: FloatArray
    pose_sigmas: float


def leave_out(nodes: SphereNodes, solution: SphereSolution, posture: int) -> LeftOutPosture:
    """Leave a posture out of the linearised solution.

    Leaving nodes out is giving each an unknown of its own: with P of `LinearSolution` their
    predicted residuals are ``P_kk^-1 (P e)_k`` with covariance ``P_kk^-1``. Of these, the part
    that a shift of the arm's pose makes is compared with its standard deviation, the posture's
    own weight undone.
    """
    own = np.flatnonzero(nodes.posture == posture)
    linear, arm = solution.linear, solution.components[0]
    block = np.ix_(own, own)
    spread = np.linalg.pinv(linear.projected[block], rcond=1e-10, hermitian=True)
    predicted = spread @ (linear.projected @ solution.placed.residual_mm)[own]
    lent = 1.0 - solution.posture_weights[posture]
    usual = spread - lent * float(solution.noise.sigmas[0]) ** 2 * arm.covariance[block]
    shape = solution.placed.by_pose[own, :3]
    carried = np.linalg.pinv(usual, rcond=1e-10, hermitian=True) @ shape
    weight = shape.T @ carried
    strength = np.linalg.eigvalsh(weight)
    known = max(int((strength > 1e-6 * strength[-1]).sum()), 1)
    score = carried.T @ predicted
    statistic = float(score @ np.linalg.pinv(weight, rcond=1e-6, hermitian=True) @ score)
    change = linear.gain[:, own] @ predicted
    return LeftOutPosture(change, float(np.sqrt(max(statistic, 0.0) / known)))
