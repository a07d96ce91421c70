# SPDX-License-Identifier: Apache-2.0
"""The hand-eye on a sphere by generalised least squares: condensed observations, residuals and
Jacobians, starting values, solution with noise levels, leave-one-posture-out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from armscan.calibration.hand_eye.estimate import NoiseEstimate, estimate_noise
from armscan.calibration.hand_eye.search import (
    BaseTransform,
    descend_all,
    distinct,
    rotations_all_over,
)
from armscan.calibration.hand_eye.solve import (
    ROTATION_LEVER_MM,
    LinearSolution,
    NoiseComponent,
    solve_linear,
    total_covariance,
)
from armscan.calibration.hand_eye.sphere_sections import Section, SphereOptions
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector

N_HAND_EYE = 6
RADIUS_COLUMN = 9
SCALE_COLUMN = 10
N_COLUMNS = 11


@dataclass(frozen=True, slots=True, eq=False)
class SphereState:
    """All unknowns: hand-eye, centre (3,) in Base, radius in mm, scale of the sensor's points."""

    tool_from_sensor: Pose[Tool, Sensor]
    centre_mm: FloatArray
    radius_mm: float
    scale: float = 1.0

    def stepped(self, step: FloatArray) -> SphereState:
        """Apply a step (11,): hand-eye in `HAND_EYE_PARAMETER_NAMES`, centre, radius, scale."""
        rotation = rotation_from_vector(step[:3]) @ self.tool_from_sensor.rotation
        return SphereState(
            Pose(rotation, self.tool_from_sensor.translation_mm + step[3:6]),
            self.centre_mm + step[6:9],
            self.radius_mm + float(step[RADIUS_COLUMN]),
            self.scale + float(step[SCALE_COLUMN]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SphereNodes:
    """Points on the sphere, cut into nodes.

    Parameters
    ----------
    sections
        Where they come from.
    postures
        Names of the postures.
    points_mm
        (N, 3) in the Sensor frame, the points of a node one after another.
    point_section
        (N,) index into ``sections``.
    first, count
        (M,) row of each node's first point, and count of its points.
    section, posture
        (M,) indices of each node's section and posture.
    sigma_mm
        (M,) standard deviation of a node's mean residual by the stripe's own noise.
    by_sensor
        (N, 3, P) derivative of the points by the sensor's parameters; None where not known.
    sensor_covariance
        (P, P) of the sensor's parameters; None where it is taken as exact.
    """

    sections: tuple[Section, ...]
    postures: tuple[str, ...]
    points_mm: FloatArray
    point_section: IntArray
    first: IntArray
    count: IntArray
    section: IntArray
    posture: IntArray
    sigma_mm: FloatArray
    by_sensor: FloatArray | None = None
    sensor_covariance: FloatArray | None = None

    def __len__(self) -> int:
        """Count of nodes."""
        return len(self.first)

    def mean(self, values: FloatArray) -> FloatArray:
        """(M, ...) mean over each node of (N, ...) values of its points."""
        sums = np.add.reduceat(values, self.first, axis=0)
        return np.asarray(sums / self.count.reshape(-1, *([1] * (values.ndim - 1))))


def sphere_nodes(
    sections: tuple[Section, ...], per_stripe: int, sensor_covariance: FloatArray | None = None
) -> SphereNodes:
    """Cut sections into nodes of nearly equal count.

    The stripe's own error of a node is taken from how its mean leaves the section circle: errors
    of neighbouring points are alike, so that dividing the scatter of single points by the root of
    their count would promise too much.
    """
    names = tuple(dict.fromkeys(section.stripe.posture for section in sections))
    firsts, counts, owners, sigmas = [], [], [], []
    start = 0
    for k, section in enumerate(sections):
        n = len(section.rows)
        n_nodes = min(per_stripe, n // 2)
        edges = np.linspace(0, n, n_nodes + 1).astype(np.int64)
        count = np.diff(edges)
        means = np.add.reduceat(section.off_circle_mm, edges[:-1]) / count
        form = float(means @ means) / max(n_nodes - 3, 1)
        own = (section.stripe.noise_mm[section.rows] ** 2).sum(axis=(1, 2)).mean() / count
        firsts.append(edges[:-1] + start)
        counts.append(count)
        owners.append(np.full(n_nodes, k))
        sigmas.append(np.sqrt(np.maximum(own, max(form, 1e-12))))
        start += n
    owner = np.concatenate(owners)
    posture_of = np.array([names.index(section.stripe.posture) for section in sections])
    lengths = [len(section.rows) for section in sections]
    return SphereNodes(
        sections,
        names,
        np.concatenate([section.points_mm for section in sections]),
        np.repeat(np.arange(len(sections)), lengths),
        np.concatenate(firsts),
        np.concatenate(counts),
        owner,
        posture_of[owner],
        np.concatenate(sigmas),
        _by_sensor(sections),
        sensor_covariance,
    )


def _by_sensor(sections: tuple[Section, ...]) -> FloatArray | None:
    parts = [(section.stripe.by_sensor, section.rows) for section in sections]
    known = [by_sensor[rows] for by_sensor, rows in parts if by_sensor is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


@dataclass(frozen=True, slots=True, eq=False)
class PlacedOnSphere:
    """Points placed with a state.

    Parameters
    ----------
    points_base_mm
        (N, 3) placed points.
    point_residual_mm
        (N,) their distance from the sphere, positive outside.
    normals_sensor
        (N, 3) derivative of that by the point in the Sensor frame.
    residual_mm
        (M,) of the nodes.
    slopes
        (M, 11) derivative by all unknowns, in the order of `SphereState.stepped`.
    by_pose
        (M, 6) derivative by a shift of the arm's pose in Base and by its turn about the middle of
        the posture's points.
    """

    points_base_mm: FloatArray
    point_residual_mm: FloatArray
    normals_sensor: FloatArray
    residual_mm: FloatArray
    slopes: FloatArray
    by_pose: FloatArray


def place_on_sphere(nodes: SphereNodes, state: SphereState) -> PlacedOnSphere:
    """Place all points (eq. 2.46) and measure their distance from the sphere."""
    poses = [section.stripe.base_from_tool for section in nodes.sections]
    rotations = np.array([pose.rotation for pose in poses])[nodes.point_section]
    origins = np.array([pose.translation_mm for pose in poses])[nodes.point_section]
    hand_eye = state.tool_from_sensor
    turned = state.scale * nodes.points_mm @ hand_eye.rotation.T
    in_tool = turned + hand_eye.translation_mm
    base = np.einsum("nij,nj->ni", rotations, in_tool) + origins
    towards = base - state.centre_mm
    length = np.linalg.norm(towards, axis=1)
    normals = towards / np.maximum(length, 1e-12)[:, None]
    normals_tool = np.einsum("nij,ni->nj", rotations, normals)
    residual = length - state.radius_mm
    slopes = np.column_stack(
        [
            np.cross(turned, normals_tool),
            normals_tool,
            -normals,
            -np.ones(len(base)),
            np.einsum("ni,ni->n", normals_tool, turned) / state.scale,
        ]
    )
    lever = base - _posture_middles(nodes, base)
    by_pose = np.column_stack([normals, np.cross(lever, normals)])
    return PlacedOnSphere(
        base,
        residual,
        state.scale * normals_tool @ hand_eye.rotation,
        nodes.mean(residual),
        nodes.mean(slopes),
        nodes.mean(by_pose),
    )


def residual_by_sensor(nodes: SphereNodes, placed: PlacedOnSphere) -> FloatArray | None:
    """(M, P) derivative of the residuals by the sensor's parameters; None where not known."""
    if nodes.by_sensor is None:
        return None
    return nodes.mean(np.einsum("ni,nip->np", placed.normals_sensor, nodes.by_sensor))


def covariance_by_sensor(nodes: SphereNodes, placed: PlacedOnSphere) -> FloatArray:
    """(M, M) covariance of the residuals by the sensor's calibration; zero where it is exact."""
    by_sensor = residual_by_sensor(nodes, placed)
    if by_sensor is None or nodes.sensor_covariance is None:
        return np.zeros((len(nodes), len(nodes)))
    return np.asarray(by_sensor @ nodes.sensor_covariance @ by_sensor.T)


def _posture_middles(nodes: SphereNodes, base: FloatArray) -> FloatArray:
    """(N, 3) mean of all placed points of each point's posture."""
    posture = np.repeat(nodes.posture, nodes.count)
    count = np.bincount(posture, minlength=len(nodes.postures))
    sums = np.zeros((len(nodes.postures), 3))
    np.add.at(sums, posture, base)
    return np.asarray((sums / np.maximum(count, 1)[:, None])[posture])


N_ROTATIONS = 200
N_FIRST = 8
"""Steps of every start; the best of them go on."""
N_GO_ON = 60
N_LAST = 40
N_CANDIDATES = 12
POINTS_OF_SECTION = 7
APART_RAD = 0.05
OPEN_RATIO = 1e-4
"""Singular values of the linear equations below this part of the largest are taken as zero."""


def start_candidates(sections: tuple[Section, ...], radius_mm: float) -> tuple[SphereState, ...]:
    """Up to twelve distinct minima of the plain sum of squares, least first."""
    circles = _Circles.of(sections, radius_mm)
    every = rotations_all_over(N_ROTATIONS)
    completed = [circles.complete(every, side) for side in (1, -1, 0)]
    rotations, others = np.tile(every, (3, 1, 1)), np.concatenate(completed)
    place = _placing(sections, radius_mm)
    size = float(np.sqrt((np.concatenate([one.points_mm for one in sections]) ** 2).sum(1).mean()))
    scale = np.array([1.0 / size] * 3 + [1.0] * 6)
    rotations, others, cost = descend_all(place, rotations, others, N_FIRST, scale)
    best = np.argsort(cost)[:N_GO_ON]
    rotations, others, cost = descend_all(place, rotations[best], others[best], N_LAST, scale)
    kept = distinct(rotations, cost, APART_RAD, N_CANDIDATES)
    return tuple(
        SphereState(Pose(rotations[k], others[k, :3]), others[k, 3:], radius_mm) for k in kept
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """Section circles (S,): centre, normal of the sheet, height of the sphere's centre over it."""

    centres: FloatArray
    normals: FloatArray
    heights: FloatArray
    rotations: FloatArray
    origins: FloatArray

    @staticmethod
    def of(sections: tuple[Section, ...], radius_mm: float) -> _Circles:
        poses = [section.stripe.base_from_tool for section in sections]
        return _Circles(
            np.array([one.centre_mm for one in sections]),
            np.array([one.normal for one in sections]),
            np.array([one.height_mm(radius_mm) for one in sections]),
            np.array([pose.rotation for pose in poses]),
            np.array([pose.translation_mm for pose in poses]),
        )

    def complete(self, rotations: FloatArray, side: int) -> FloatArray:
        """(K, 6) translation and centre that suit (K, 3, 3) rotations.

        The centre in Sensor is ``R' (R_k' (c - T_k) - t)``. With ``side`` 0 only its place within
        the sheet counts at first.
        """
        if side:
            return self._solved(rotations, side * self.heights, 1.0)
        flat = self._solved(rotations, np.zeros(len(self.heights)), 0.0)
        seen = (
            np.einsum("sji,ksj->ksi", self.rotations, flat[:, None, 3:] - self.origins)
            - flat[:, None, :3]
        )
        seen = np.einsum("kji,ksj->ksi", rotations, seen)
        above = np.einsum("ksi,si->ks", seen - self.centres, self.normals)
        return self._solved(rotations, np.where(above < 0.0, -1.0, 1.0) * self.heights, 1.0)

    def _solved(self, rotations: FloatArray, heights: FloatArray, weight: float) -> FloatArray:
        """Least squares for ``R_k' c - t = R q + R_k' T_k``, across the sheets with a weight."""
        n = len(rotations)
        seen = self.centres + np.broadcast_to(heights, (n, len(self.centres)))[..., None] * (
            self.normals
        )
        weights = np.eye(3) - (1.0 - weight) * self.normals[:, :, None] * self.normals[:, None, :]
        back = self.rotations.transpose(0, 2, 1)
        rows = np.concatenate([np.broadcast_to(-np.eye(3), back.shape), back], axis=2)
        # In Sensor, where the weights are: R' (R_k' c - t) = q + R' R_k' T_k.
        turned = np.einsum("sab,kcb,scd->ksad", weights, rotations, rows)
        constant = np.einsum("sij,sj->si", back, self.origins)
        right = seen + np.einsum("kji,sj->ksi", rotations, constant)
        right = np.einsum("sab,ksb->ksa", weights, right)
        inverse = np.linalg.pinv(turned.reshape(n, -1, 6), rcond=OPEN_RATIO)
        return np.asarray(np.einsum("kun,kn->ku", inverse, right.reshape(n, -1)))


def _placing(sections: tuple[Section, ...], radius_mm: float) -> BaseTransform:
    """Distances of a few points of each section from the sphere, for many states at once."""
    picked = [
        section.points_mm[
            np.linspace(0, len(section.rows) - 1, POINTS_OF_SECTION).round().astype(int)
        ]
        for section in sections
    ]
    points = np.concatenate(picked)
    owner = np.repeat(np.arange(len(sections)), POINTS_OF_SECTION)
    poses = [section.stripe.base_from_tool for section in sections]
    rotations = np.array([pose.rotation for pose in poses])[owner]
    shifts = np.einsum(
        "nji,nj->ni", rotations, np.array([pose.translation_mm for pose in poses])[owner]
    )
    flat = rotations.transpose(1, 0, 2).reshape(3, -1)

    def place(turns: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        n = len(turns)
        turned = (points @ turns.transpose(0, 2, 1)).reshape(n, -1, 3)
        centres = (others[:, 3:] @ flat).reshape(n, -1, 3)
        towards = turned + others[:, None, :3] + shifts - centres
        length = np.linalg.norm(towards, axis=2)
        normals = towards / np.maximum(length, 1e-12)[:, :, None]
        in_base = np.einsum("nij,knj->kni", rotations, normals)
        slopes = np.concatenate([np.cross(turned, normals), normals, -in_base], axis=2)
        return length - radius_mm, slopes

    return place


def is_apart(one: SphereState, other: SphereState) -> bool:
    """True for states whose sensors are turned differently."""
    turn = one.tool_from_sensor.rotation.T @ other.tool_from_sensor.rotation
    return float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))) > APART_RAD


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

    As `armscan.calibration.hand_eye.estimate.hold_sensor`: its ``total`` is without the sensor's
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
