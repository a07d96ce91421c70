# SPDX-License-Identifier: Apache-2.0
"""The estimator of the hand-eye: generalised least squares in turn with the scatter's estimate.

One for all reference surfaces: it minimises the distances of the condensed observations from the
surface (eq. 2.76) under their covariance, on a plate without what the points' own errors pull
(decision 27), tells how well the postures determine each parameter, and what changes without a
posture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.special import chdtrc

from armscan.calibration.hand_eye.noise import (
    CommonCentre,
    LinearSolution,
    NoiseComponent,
    NoiseEstimate,
    covariance_over_noise,
    estimate_noise,
    noise_components,
    solve_linear,
    total_covariance,
)
from armscan.calibration.hand_eye.observations import CondensedObservations, HandEyeOptions
from armscan.calibration.hand_eye.surface import (
    LEVER_MM,
    N_HAND_EYE,
    Conditioning,
    HandEyeState,
    Placed,
    PlateSurface,
    ReferenceSurface,
    SphereSurface,
    conditioning_of,
    free_columns,
    place,
    smooth_along_stripes,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import (
    DenseSystem,
    Minimum,
    Whitening,
    eigen,
    levenberg_marquardt,
    pseudo_inverse,
)
from armscan.geometry.poses import Pose, Sensor, Tool

MAX_STEPS = 60
SETTLED = 1e-10
"""A step that lowers chi2 by less than this part of it ends the search."""
NOISE_ROUNDS = {"plate": (8, 0.02), "sphere": (12, 0.02)}
"""Rounds at most, and change of a sigma's logarithm that ends them.

On a sphere the scatter of a robot is far from its typical value. 2 % of a scatter are 2 % of the
sigmas stated; the posterior's own spread, over which the covariance is integrated, is 14 % of the
arm's scatter for twelve postures and 29 % for five (one over the root of twice the freedom). The
limit is of the scatter, not of the hand-eye: where the sensor is weakly known, a hand-eye called
settled was once half a sigma from where further rounds take it."""
PULL_STEPS, PULL_SETTLED = 12, 0.01
"""Steps, and sigmas that are none, from the least sum of squares to where derivatives of points
without errors are at right angles to the distances. That sum turns the points' errors out of the
distances: nearly parallel postures were pulled by two sigmas. Where the steps come to no end, it
stays, and is not settled."""
MOST_SHARE = 4.0
"""Of a step, where the one before was as far and went the same way."""
FAR_SIGMAS = 3.0
"""Of the points' typical error by the sensor, which may lie that far from the reference."""
ROBUST_ROUNDS = 10
WEIGHTS_SETTLED = 0.02
LEAST_FOR_WEIGHTS = 4
"""With fewer postures a wrong one cannot be told."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Data, reference and noise model of one estimate.

    ``weights`` (n postures,) are at most 1: below it, a posture's pose is trusted less.
    """

    observations: CondensedObservations
    surface: ReferenceSurface
    options: HandEyeOptions
    weights: FloatArray | None = None

    def select(self, kept: BoolArray) -> Problem:
        """With some of the observations (M,)."""
        return replace(self, observations=self.observations.select(kept))

    def without(self, is_wrong: BoolArray) -> Problem:
        """Without some of the postures (n postures,)."""
        return self.select(~is_wrong[self.observations.posture])

    def place(self, state: HandEyeState) -> Placed:
        """Place the observations."""
        return place(self.observations, self.surface, state)

    @property
    def about_common_centre(self) -> Problem:
        """With distances about the sphere's common centre, not where the arm throws each stripe."""
        if not isinstance(self.surface, SphereSurface):
            return self
        return replace(self, surface=replace(self.surface, has_own_centres=False))

    def start(self, pose: Pose[Tool, Sensor]) -> HandEyeState:
        """A hand-eye with the surface as given."""
        return HandEyeState(pose, self.surface.start)

    @property
    def columns(self) -> IntArray:
        """Which entries of a step are solved for."""
        return free_columns(self.surface, self.options)

    def jacobian(self, placed: Placed) -> FloatArray:
        """(M, F) derivative of the distances by what is solved for, of points without errors."""
        return self.of_smooth_stripes(placed.jacobian[:, self.columns])

    def of_smooth_stripes(self, derivative: FloatArray) -> FloatArray:
        """(M, F) of distances, without what the points' own errors do to it on a plate."""
        is_plate = isinstance(self.surface, PlateSurface)
        return smooth_along_stripes(self.observations, derivative) if is_plate else derivative

    def components(self, placed: Placed) -> tuple[NoiseComponent, ...]:
        """Causes of scatter."""
        observations, surface, options = self.observations, self.surface, self.options
        return noise_components(observations, surface, placed, options, self.weights)

    def surface_covariance(self, placed: Placed) -> FloatArray:
        """(M, M) covariance of the residuals by a surface that is known beforehand."""
        prior = self.surface.prior(self.options)
        if prior is None:
            return np.zeros((len(placed.residual_mm),) * 2)
        return np.asarray(placed.by_surface @ prior @ placed.by_surface.T)

    def sensor_covariance(self, placed: Placed) -> FloatArray:
        """(M, M) covariance of the residuals by the sensor's calibration; 0 where it is exact."""
        sensor = self.observations.sensor_covariance
        if placed.by_sensor is None or sensor is None:
            return np.zeros((len(placed.residual_mm),) * 2)
        return np.asarray(placed.by_sensor @ sensor @ placed.by_sensor.T)

    def free_sensor(self, state: HandEyeState) -> HandEyeState:
        """The state with a sensor that may err, where the points tell what that does to them."""
        covariance = self.observations.sensor_covariance
        if state.sensor is not None or covariance is None:
            return state
        if self.observations.dpoint_dsensor is None:
            return state
        return replace(state, sensor=np.zeros(len(covariance)))

    def far_mm(self, placed: Placed) -> float:
        """Typical distance from the reference above which the data contradict each other.

        What is asked for, or what the sensor's own error explains: where that is known badly, arm,
        poses and reference are not to blame.
        """
        by_sensor_mm = float(np.median(np.sqrt(np.diag(self.sensor_covariance(placed)))))
        return max(self.options.max_rms_mm, FAR_SIGMAS * by_sensor_mm)


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeSolution:
    """Where the estimate came to rest, with its noise model.

    Parameters
    ----------
    known
        (M, M) covariance of the residuals by what errs alike in all postures: a probed plane and
        the sensor.
    linear
        Linearised there, in the columns solved for.
    is_settled
        False if the steps ran out: of the least squares, of the scatter's estimate, or of the
        rounds of both.
    """

    problem: Problem
    state: HandEyeState
    placed: Placed
    components: tuple[NoiseComponent, ...]
    noise: NoiseEstimate
    known: FloatArray
    linear: LinearSolution
    is_settled: bool

    @property
    def jacobian(self) -> FloatArray:
        """(M, F) derivative of the residuals by the unknowns solved for."""
        return self.problem.jacobian(self.placed)

    @property
    def log_likelihood(self) -> float:
        """Restricted log-likelihood of the measured points, by which hand-eyes are compared.

        That of their distances from the surface, and how distances follow what each point errs by:
        a hand-eye that turns the errors into the surface explains distances of any points.
        """
        own = next(one for one in self.components if one.name == "stripe")
        return self.linear.log_likelihood + 0.5 * float(np.log(np.diag(own.covariance)).sum())

    @property
    def by_scale(self) -> FloatArray:
        """(M, 1) derivative of the residuals by the scale of the sensor's points less their errors.

        A scale shrinks the points' errors as well as the points. With errors of covariance V in
        residuals e and derivative alike, their product is ``tr(P V)`` on average and pulls the
        scale down by so many times its variance: by half a sigma and more. They are predicted to be
        ``V P e``, and ``e' P V P e`` is the same on average.
        """
        rows = np.arange(len(self.placed.residual_mm))
        own = self.problem.sensor_covariance(self.placed)
        own = own + self.scatter_of("stripe", rows) + self.scatter_of("sheet", rows)
        return np.asarray(self.placed.jacobian[:, -1:] - (own @ self.explained)[:, None])

    @property
    def scatter(self) -> FloatArray:
        """(M, M) covariance of the residuals by the causes of scatter."""
        return total_covariance(self.components, self.noise.sigmas)

    @property
    def explained(self) -> FloatArray:
        """(M,) ``P e``: the residuals by their covariance, zero along the unknowns."""
        return np.asarray(self.linear.projected @ self.placed.residual_mm)

    @property
    def chi2(self) -> float:
        """Sum of squared whitened residuals, less what a step along the unknowns would take."""
        return float(self.placed.residual_mm @ self.explained)

    @property
    def probability(self) -> float:
        """Of residuals at least this large under the noise model."""
        freedom = len(self.placed.residual_mm) - len(self.problem.columns)
        return float(chdtrc(freedom, self.chi2))

    def sigma_of(self, name: str) -> float:
        """Standard deviation of one cause of scatter; 0 where it is none."""
        for component, sigma in zip(self.components, self.noise.sigmas, strict=True):
            if component.name == name:
                return float(sigma)
        return 0.0

    def scatter_of(self, name: str, rows: IntArray) -> FloatArray:
        """(n, n) covariance of some residuals by one cause of scatter, a pose's turns included."""
        found = np.zeros((len(rows), len(rows)))
        for component, sigma in zip(self.components, self.noise.sigmas, strict=True):
            if component.name.split()[0] == name:
                found += sigma**2 * component.covariance[np.ix_(rows, rows)]
        return found

    @property
    def arm_mm(self) -> float:
        """How far the arm's pose throws the scan point, as the postures see it, one sigma an axis.

        Its shift, and what its turn about the origin of Tool adds there.
        """
        return float(np.sqrt(self._arm_variances_mm2.sum()))

    @property
    def log_arm_mm(self) -> float:
        """Standard deviation of the logarithm of `arm_mm`; 0 where the scatters were given."""
        share = self._arm_variances_mm2
        share = share / max(float(share.sum()), 1e-300)
        # rounding may leave less than nothing where the scatter has run off
        return float(np.sqrt(max(float(share @ self.noise.log_covariance[:2, :2] @ share), 0.0)))

    @property
    def _arm_variances_mm2(self) -> FloatArray:
        """(2,) parts of `arm_mm` squared: of the arm's shift and of its turn about Tool."""
        seen = np.array([np.trace(one.covariance) for one in self.components[:2]])
        return np.asarray(self.noise.sigmas[:2] ** 2 * seen / seen[0])

    @property
    def surface_after(self) -> FloatArray:
        """(K,) parameters of the surface as the scan and what was known of it give them."""
        prior = self.problem.surface.prior(self.problem.options)
        if prior is None:
            return self.state.surface
        return np.asarray(self.state.surface - prior @ self.placed.by_surface.T @ self.explained)


def minimise_distances(
    problem: Problem, start: HandEyeState, covariance: FloatArray, columns: IntArray | None = None
) -> Minimum[HandEyeState, DenseSystem] | None:
    """Minimise ``e' C^-1 e`` over the unknowns; None where the covariance is not definite.

    ``covariance`` (M, M) is that of the residuals e of eq. 2.74; ``columns`` are the entries of a
    step that are solved for, those of the problem if None. Where the state lets the sensor err, its
    error s is solved for too, ``s' S^-1 s`` added, and C is without the sensor's part: the same
    minimum as with that part in C, but for curvature, where a small sphere is led far away by a
    sensor that is linearised where it does not stand.
    """
    try:
        whiten = Whitening(covariance)
    except LinAlgError:
        return None
    free = problem.columns if columns is None else columns
    n_all, n_free = N_HAND_EYE + len(start.surface) + 1, len(free)
    root, units = np.zeros((0, 0)), np.zeros((0, 0))
    if start.sensor is not None:
        root, units = problem.observations.sensor_numbers()

    def linearise(state: HandEyeState) -> tuple[FloatArray, FloatArray]:
        placed = problem.place(state)
        jacobian = whiten(placed.jacobian[:, free])
        if state.sensor is None or placed.by_sensor is None:
            return whiten(placed.residual_mm), jacobian
        residual = whiten(placed.residual_mm + placed.moved_mm)
        of_sensor = np.concatenate([np.zeros((len(units), n_free)), np.eye(len(units))], axis=1)
        by_all = np.concatenate([jacobian, whiten(placed.by_sensor @ root)], axis=1)
        return (
            np.concatenate([residual, units @ state.sensor]),
            np.concatenate([by_all, of_sensor]),
        )

    def retract(state: HandEyeState, step: FloatArray) -> HandEyeState:
        whole = np.zeros(n_all)
        whole[free] = step[:n_free]
        moved = state.retract(whole)
        if moved.sensor is None:
            return moved
        return replace(moved, sensor=moved.sensor + root @ step[n_free:])

    return levenberg_marquardt(start, linearise, retract, settled=SETTLED, max_steps=MAX_STEPS)


def estimate(
    problem: Problem,
    start: HandEyeState,
    sigmas: FloatArray | None = None,
    *,
    hold_noise: bool = False,
) -> HandEyeSolution | None:
    """Solve, and estimate the scatter, in turn; None where the data leave unknowns open.

    It begins close to the solution, with ``sigmas`` (C,), typical ones if None, and keeps them with
    ``hold_noise``.
    """
    state = problem.free_sensor(start)
    rounds, settled = NOISE_ROUNDS[problem.surface.method]
    is_settled, last = False, None
    # On a sphere the typical scatter may be far from the true one, and would lead away from it.
    is_solved_first = problem.surface.method == "plate"
    for _ in range(rounds):
        placed = problem.place(state)
        components = problem.components(placed)
        if sigmas is None:
            sigmas = first_sigmas(problem, components, placed)
        before = sigmas
        for is_solving in (is_solved_first, not is_solved_first):
            prior = problem.surface_covariance(placed)
            if is_solving:
                rested = _rest(problem, state, total_covariance(components, sigmas), prior)
                if rested is None:
                    return None
                state, placed = rested[0], problem.place(rested[0])
            elif hold_noise:
                noise = NoiseEstimate(sigmas, np.zeros((len(sigmas), len(sigmas))))
            else:
                jacobian = problem.jacobian(placed)
                known = prior + problem.sensor_covariance(placed)
                noise = estimate_noise(placed.residual_mm, jacobian, components, known, sigmas)
                sigmas = noise.sigmas
        change = np.log((sigmas + 1e-12) / (before + 1e-12))
        is_settled = noise.is_settled and float(np.abs(change).max()) < settled
        if is_settled:
            break
        if not is_solved_first and last is not None and float(change @ last) < 0.0:
            # the part of the change that meets the middle of the oscillation (Aitken)
            ratio = float(change @ last) / float(last @ last)
            sigmas = before * np.exp(change * (1.0 / (1.0 - ratio)))
        last = change
    solution = _solution(problem, state, components, noise)
    if solution is None:
        return None
    return replace(solution, is_settled=solution.is_settled and is_settled)


def first_sigmas(
    problem: Problem, components: tuple[NoiseComponent, ...], placed: Placed
) -> FloatArray:
    """Standard deviations to begin with: typical; on a sphere all residuals count as the arm's."""
    sigmas = np.array([component.sigma for component in components])
    if not isinstance(problem.surface, PlateSurface) and components[0].is_estimated:
        size_mm = max(float(np.sqrt(np.mean(placed.residual_mm**2))), 1e-4)
        for k, component in enumerate(components):
            if component.follows == "arm" and component.is_estimated:
                sigmas[k] *= size_mm / components[0].sigma
        sigmas[0] = size_mm
    return sigmas


def _solution(
    problem: Problem,
    start: HandEyeState,
    components: tuple[NoiseComponent, ...],
    noise: NoiseEstimate,
) -> HandEyeSolution | None:
    scatter = total_covariance(components, noise.sigmas)
    prior = problem.surface_covariance(problem.place(start))
    rested = _rest(problem, start, scatter, prior)
    if rested is None:
        return None
    state, is_settled = rested
    placed = problem.place(state)
    known = prior if state.sensor is None else prior + problem.sensor_covariance(placed)
    linear = solve_linear(placed.residual_mm, problem.jacobian(placed), scatter + known)
    if linear is None:
        return None
    return HandEyeSolution(
        problem=problem,
        state=state,
        placed=placed,
        components=components,
        noise=noise,
        known=known,
        linear=linear,
        is_settled=is_settled,
    )


def _rest(
    problem: Problem, start: HandEyeState, scatter: FloatArray, prior: FloatArray
) -> tuple[HandEyeState, bool] | None:
    """State that a scatter (M, M) and a known surface (M, M) lead to, and whether it is settled.

    On a sphere it is the least sum of squares; on a plate where its derivatives are at right angles
    to the distances (decision 27).
    """
    found = minimise_distances(problem, start, scatter + prior)
    if found is None or not isinstance(problem.surface, PlateSurface):
        return None if found is None else (found.state, found.is_settled)
    state = _without_pull(problem, found.state, scatter, prior)
    return (found.state, False) if state is None else (state, found.is_settled)


def _without_pull(
    problem: Problem, start: HandEyeState, scatter: FloatArray, prior: FloatArray
) -> HandEyeState | None:
    """Where steps by derivatives of points without errors lead; None if to no end.

    Steps that turn back are damped by what they turn back by, those that go on alike lengthened;
    undamped, some alternated for ever.
    """
    state, share = start, 1.0
    last: FloatArray | None = None
    weighed_last: FloatArray = np.zeros(0)
    for _ in range(PULL_STEPS + 1):
        placed = problem.place(state)
        known = prior if state.sensor is None else prior + problem.sensor_covariance(placed)
        linear = solve_linear(placed.residual_mm, problem.jacobian(placed), scatter + known)
        if linear is None:
            return None
        weighed = np.asarray(np.linalg.solve(linear.covariance, linear.step))
        if float(weighed @ linear.step) < PULL_SETTLED**2:
            return state
        if last is not None:
            ratio = float(weighed_last @ linear.step) / float(weighed_last @ last)
            share = min(MOST_SHARE, share / max(1.0 - ratio, share / MOST_SHARE))
        last, weighed_last = linear.step, weighed
        state = _stepped(problem, state, placed, linear, share)
    return None


def _stepped(
    problem: Problem, state: HandEyeState, placed: Placed, linear: LinearSolution, share: float
) -> HandEyeState:
    """A share of the way to a linearised solution, and to the sensor's most likely error."""
    whole = np.zeros(placed.jacobian.shape[1])
    whole[problem.columns] = share * linear.step
    moved, sensor = state.retract(whole), problem.observations.sensor_covariance
    if moved.sensor is None or placed.by_sensor is None or sensor is None:
        return moved
    likeliest = -sensor @ placed.by_sensor.T @ (linear.projected @ placed.residual_mm)
    return replace(moved, sensor=moved.sensor + share * (likeliest - moved.sensor))


@dataclass(frozen=True, slots=True, eq=False)
class JointCovariance:
    """What the unknowns of a solution and the sensor err by, estimated scatter not taken as known.

    Parameters
    ----------
    unknowns
        (F, F) covariance of all that was solved for beside the sensor, its errors included.
    region_factor
        Of the hand-eye, as of `SolutionCovariance`.
    given_sensor
        (6, 6) covariance of the hand-eye, the sensor being held fixed.
    dhand_eye_dsensor
        (6, P) how the hand-eye follows the sensor's errors; None where the points do not say how
        they follow them.
    sensor
        (P, P) covariance of the sensor's parameters after the scan; None where they were not
        solved for.
    """

    unknowns: FloatArray
    region_factor: float
    given_sensor: FloatArray
    dhand_eye_dsensor: FloatArray | None
    sensor: FloatArray | None

    @property
    def hand_eye(self) -> FloatArray:
        """(6, 6) covariance of the hand-eye with what the sensor's uncertainty does to it."""
        return np.asarray(self.unknowns[:N_HAND_EYE, :N_HAND_EYE])


def joint_covariance(solution: HandEyeSolution) -> JointCovariance:
    """Covariance of hand-eye and sensor as one least squares has moved both."""
    placed, observations = solution.placed, solution.problem.observations
    n, hand_eye, by_sensor = len(solution.problem.columns), slice(0, N_HAND_EYE), placed.by_sensor
    before = observations.sensor_covariance
    if by_sensor is None or before is None or solution.state.sensor is None:
        whole = covariance_over_noise(
            placed.residual_mm,
            solution.jacobian,
            solution.components,
            solution.known,
            solution.noise,
            common=_about_common_centre(solution),
        )
        follow = None if by_sensor is None else -solution.linear.gain[hand_eye] @ by_sensor
        own = whole.matrix[hand_eye, hand_eye]
        return JointCovariance(whole.matrix, whole.region_factor, own, follow, None)
    root, units = observations.sensor_numbers()
    whole = covariance_over_noise(
        placed.residual_mm,
        np.concatenate([solution.jacobian, by_sensor @ root], axis=1),
        solution.components,
        solution.problem.surface_covariance(placed),
        solution.noise,
        n_unit=len(units),
        common=_about_common_centre(solution, root),
    )
    after, between = whole.matrix[n:, n:], whole.matrix[hand_eye, n:]
    by_units = np.linalg.solve(after, between.T).T
    given = whole.matrix[hand_eye, hand_eye] - by_units @ between.T
    moved = before + root @ (after - np.eye(len(units))) @ root.T
    return JointCovariance(
        unknowns=whole.matrix[:n, :n],
        region_factor=whole.region_factor,
        given_sensor=0.5 * (given + given.T),
        dhand_eye_dsensor=by_units @ units,
        sensor=0.5 * (moved + moved.T),
    )


def _about_common_centre(
    solution: HandEyeSolution, root: FloatArray | None = None
) -> CommonCentre | None:
    """About a sphere's common centre; None for a plate.

    ``root`` (P, U) is what the sensor errs by for each of the last U unknowns, if it is solved for.
    """
    problem = solution.problem.about_common_centre
    if problem is solution.problem:
        return None
    placed = problem.place(solution.state)
    jacobian, known = problem.jacobian(placed), problem.surface_covariance(placed)
    if root is not None and placed.by_sensor is not None:
        jacobian = np.concatenate([jacobian, placed.by_sensor @ root], axis=1)
    elif solution.state.sensor is not None:
        known = known + problem.sensor_covariance(placed)
    return CommonCentre(jacobian, problem.components(placed), known)


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """One posture predicted by the others.

    Parameters
    ----------
    change
        (F,) change of the solution when the posture is left out.
    normalised
        Root mean square of its predicted residuals over their standard deviation.
    pose_sigmas
        Size of the error of its pose that they ask for, over its standard deviation: of a shift and
        a slope of its stripes on a plate, of a shift on a sphere.
    probability
        Of such an error as large as this, if its pose errs as the others do.
    """

    change: FloatArray
    normalised: float
    pose_sigmas: float
    probability: float


def leave_out(solution: HandEyeSolution, posture: int) -> LeftOut:
    """Leave a posture out of the linearised solution, without solving again.

    Leaving observations out is giving each of them an unknown of its own: with P of
    `LinearSolution` the prediction error of the block is ``P_kk^-1 (P e)_k`` and has covariance
    ``P_kk^-1``. What the others tell of the plate's flatness there is taken into account. A weight
    of the posture is undone.
    """
    observations, weights = solution.problem.observations, solution.problem.weights
    rows = np.flatnonzero(observations.posture == posture)
    block, explained = solution.linear.projected[np.ix_(rows, rows)], solution.explained[rows]
    values, vectors = eigen(block)
    used = values > 1e-10 * values[-1]
    inverse = (vectors[:, used] / values[used]) @ vectors[:, used].T
    predicted = inverse @ explained
    shape = _pose_errors(solution, rows)
    weighted = block @ shape
    if weights is not None and weights[posture] < 1.0:
        lent = (1.0 - weights[posture]) * solution.scatter_of("arm", rows)
        weighted = pseudo_inverse(inverse - lent, 1e-10) @ shape
    weight, score = shape.T @ weighted, weighted.T @ predicted
    strength = np.linalg.eigvalsh(weight)
    rank = max(int((strength > 1e-6 * strength[-1]).sum()), 1)
    statistic = float(score @ pseudo_inverse(weight, 1e-6) @ score)
    size = float(explained @ predicted)
    return LeftOut(
        change=solution.linear.gain[:, rows] @ predicted,
        normalised=float(np.sqrt(max(size, 0.0) / max(int(used.sum()), 1))),
        pose_sigmas=float(np.sqrt(max(statistic, 0.0) / rank)),
        probability=float(chdtrc(shape.shape[1], statistic)),
    )


def _pose_errors(solution: HandEyeSolution, rows: IntArray) -> FloatArray:
    """(n, 2) or (n, 3) what an error of a posture's pose does to its residuals."""
    if not isinstance(solution.problem.surface, PlateSurface):
        return np.asarray(solution.placed.dresidual_dpose[rows, :3])
    points = solution.problem.observations.points_mm[rows]
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    along = centred @ axes[0] / LEVER_MM
    return np.column_stack([np.ones(len(rows)), along - along.mean()])


def leave_each_out(solution: HandEyeSolution) -> dict[int, LeftOut]:
    """Leave out every posture in turn; keys are posture numbers."""
    used = solution.problem.observations.used_postures
    return {int(posture): leave_out(solution, int(posture)) for posture in used}


def estimate_robustly(problem: Problem, start: HandEyeState) -> HandEyeSolution | None:
    """Estimate; postures whose pose errs far more than the others' lose weight.

    Weights fall with the fourth power of the error, so that a gross one does not swell the arm's
    scatter.
    """
    weights = np.ones(len(problem.observations.postures))
    solution = estimate(replace(problem, weights=weights), start)
    for _ in range(ROBUST_ROUNDS):
        if solution is None or len(weights) < LEAST_FOR_WEIGHTS:
            return solution
        errors = np.array([left.pose_sigmas for left in leave_each_out(solution).values()])
        limit = problem.options.posture_sigmas
        updated = np.minimum(1.0, (limit / np.maximum(errors, 1e-9)) ** 4)
        if float(np.abs(updated - weights).max()) < WEIGHTS_SETTLED:
            break
        weights = updated
        # Not from the last solution: it belongs to a sensor that may have moved, and beside the
        # stored one its residuals are larger than the start's; the scatter would begin with them.
        solution = estimate(replace(problem, weights=weights), start)
    else:
        return None if solution is None else replace(solution, is_settled=False)
    return solution


def conditioning_at(
    problem: Problem, state: HandEyeState, sigmas: FloatArray | None = None
) -> Conditioning:
    """Rank and condition of the hand-eye at a state, other unknowns eliminated; of any rank.

    ``sigmas`` (C,) are those of the causes of scatter; those to begin with if None.

    Raises
    ------
    LinAlgError
        If the covariance of the residuals is not positive definite.
    """
    placed = problem.place(state)
    components = problem.components(placed)
    if sigmas is None:
        total = total_covariance(components, first_sigmas(problem, components, placed))
    else:
        known = problem.surface_covariance(placed) + problem.sensor_covariance(placed)
        total = total_covariance(components, sigmas) + known
    whitened = Whitening(total)(problem.jacobian(placed))
    return conditioning_of(whitened[:, :N_HAND_EYE], whitened[:, N_HAND_EYE:])
