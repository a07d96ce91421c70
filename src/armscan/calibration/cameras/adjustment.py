# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of one camera over views of a target: observations, parameters, the damped
normal equations with the views eliminated, and the covariance of what comes out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from armscan.calibration.cameras.result import (
    DISTORTION_PARAMETERS,
    MAX_STEPS,
    CameraOptions,
    DistortionModel,
)
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import Minimum, minimise
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, skew
from armscan.kernels.rays import sum_views
from armscan.models.camera import PARAMETER_NAMES, CameraModel, Lens
from armscan.vision.targets.target import TargetView

WARP_NAMES = ("bow_x_mm", "bow_y_mm")
SHARED_NAMES = (*PARAMETER_NAMES, *WARP_NAMES)
"""Unknowns that all views share: the camera, and the bow of the board."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Target points of V views, one after the other.

    Parameters
    ----------
    points_px
        (N, 2) observed image points.
    whitening
        (N, 2, 2) matrices L with ``L' L`` the inverse of each point's covariance.
    board_mm
        (N, 3) points of the flat board, where they should be.
    target_mm
        (P, 2) places of the target's points on the flat board.
    point
        (N,) number of the target's point: equal places are one point.
    missed_mm
        (N, 2) what the print misses these places by, along the board's axes, as far as solved.
    board_warp_shape
        (N, 2) height of the board per unit of the two bow parameters.
    starts
        (V + 1,) first row of each view, and N.
    known
        (11,) what is known beforehand of each shared unknown that is near zero: 1 / size^2 times
        the variance of a point of unit weight; 0 where nothing is.
    """

    points_px: FloatArray
    whitening: FloatArray
    board_mm: FloatArray
    target_mm: FloatArray
    point: IntArray
    missed_mm: FloatArray
    board_warp_shape: FloatArray
    starts: tuple[int, ...]
    width_px: int
    height_px: int
    lens: Lens
    known: FloatArray = field(default_factory=lambda: np.zeros(len(SHARED_NAMES)))

    def camera(self, parameters: FloatArray) -> CameraModel:
        """The camera of (9,) parameters."""
        return CameraModel.from_parameters(parameters, self.width_px, self.height_px, self.lens)

    @property
    def printed_mm(self) -> FloatArray:
        """(N, 3) points of the flat board, where the print has them."""
        return np.asarray(
            np.column_stack([self.board_mm[:, :2] + self.missed_mm, self.board_mm[:, 2]])
        )

    @property
    def rms_missed_mm(self) -> float:
        """Root mean square, along an axis, of what the target's points were solved to miss."""
        missed = np.zeros_like(self.target_mm)
        missed[self.point] = self.missed_mm
        return float(np.sqrt(np.mean(missed**2))) if len(missed) else 0.0

    @property
    def n_views(self) -> int:
        """Count of views."""
        return len(self.starts) - 1

    def rows(self, view: int) -> slice:
        """Rows of one view."""
        return slice(self.starts[view], self.starts[view + 1])

    @property
    def view_of_point(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """(N,) the view of each point."""
        return np.repeat(np.arange(self.n_views), np.diff(self.starts))


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all unknowns.

    Parameters
    ----------
    shared
        (11,) in the order of `SHARED_NAMES`.
    rotations
        (V, 3, 3) of ``sensor_from_board``.
    translations_mm
        (V, 3) of ``sensor_from_board``.
    """

    shared: FloatArray
    rotations: FloatArray
    translations_mm: FloatArray

    def pose(self, view: int) -> Pose[Sensor, Board]:
        """``sensor_from_board`` of one view."""
        return Pose(self.rotations[view], self.translations_mm[view])

    @staticmethod
    def from_poses(shared: FloatArray, poses: Sequence[Pose[Sensor, Board]]) -> State:
        """Put a state together from the shared unknowns and one pose a view."""
        return State(
            np.asarray(shared, dtype=np.float64),
            np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
            np.array([pose.translation_mm for pose in poses]).reshape(-1, 3),
        )


def gather(views: Sequence[TargetView], lens: Lens) -> Observations:
    """Collect the points of views, which must show images of one size, before a kind of lens.

    Raises
    ------
    InputError
        If the images differ in size or no view is given.
    """
    if not views:
        raise InputError("no views of the target were given")
    sizes = {(view.width_px, view.height_px) for view in views}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise InputError(
            f"the views come from images of different sizes: {listed} px",
            remedy="calibrate each camera, and each sensor setting, on its own images",
        )
    board = np.concatenate([view.points_board_mm for view in views])
    covariance = np.concatenate([view.covariance_px2 for view in views])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance)) if len(board) else covariance
    return Observations(
        np.concatenate([view.points_px for view in views]),
        np.asarray(whitening, dtype=np.float64),
        board,
        *target_points(board),
        np.zeros((len(board), 2)),
        board_warp_shape(board),
        tuple(int(n) for n in np.cumsum([0] + [len(view) for view in views])),
        views[0].width_px,
        views[0].height_px,
        lens,
    )


SAME_POINT_MM = 1e-6


def target_points(board_mm: FloatArray) -> tuple[FloatArray, IntArray]:
    """The P places (P, 2) among (N, 3), and which of them each is (N,)."""
    rounded = np.rint(board_mm[:, :2] / SAME_POINT_MM).astype(np.int64)
    _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return board_mm[first, :2], number.reshape(-1).astype(np.int64)


def board_warp_shape(board_mm: FloatArray) -> FloatArray:
    """(N, 2) factors ``1 - u^2`` and ``1 - v^2`` of the bow (see `BoardWarp`).

    The factors refer to the extent of all points of the target that were seen in any view.
    """
    if not len(board_mm):
        return np.zeros((0, 2))
    low, high = board_mm[:, :2].min(axis=0), board_mm[:, :2].max(axis=0)
    half = np.maximum(0.5 * (high - low), np.finfo(np.float64).tiny)
    unit = (board_mm[:, :2] - 0.5 * (low + high)) / half
    return np.asarray(1.0 - unit**2)


def free_basis(
    model: DistortionModel, options: CameraOptions
) -> tuple[FloatArray, tuple[str, ...]]:
    """Directions (11, F) in the shared unknowns that are solved, and the free parameters' names.

    A step is ``basis @ free_step``; with a fixed aspect ``fy_px`` follows ``fx_px``.
    """
    names = ["fx_px"] + ([] if options.is_aspect_fixed else ["fy_px"])
    if not options.is_principal_point_fixed:
        names += ["cx_px", "cy_px"]
    names += [name for name in PARAMETER_NAMES[4:] if name in DISTORTION_PARAMETERS[model]]
    return basis_of(names, is_aspect_fixed=options.is_aspect_fixed), tuple(names)


def basis_of(names: Sequence[str], *, is_aspect_fixed: bool) -> FloatArray:
    """(11, F) directions of F shared unknowns; with a fixed aspect fy follows fx, the first."""
    basis = np.zeros((len(SHARED_NAMES), len(names)))
    for column, name in enumerate(names):
        basis[SHARED_NAMES.index(name), column] = 1.0
    if is_aspect_fixed:
        basis[SHARED_NAMES.index("fy_px"), 0] = 1.0
    return basis


S = TypeVar("S")


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Gauss-Newton normal equations in blocks: F shared unknowns and V poses.

    Blocks (F, F), (V, F, 6) and (V, 6, 6) of ``J' J``, (F,) and (V, 6) of ``J' r`` with r observed
    minus predicted.
    """

    chi2: float
    shared: FloatArray
    cross: FloatArray
    pose: FloatArray
    shared_gradient: FloatArray
    pose_gradient: FloatArray


def predict(
    observations: Observations, state: State
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Predict the image points (N, 2), with derivatives; None if the state is impossible.

    These are (N, 2, 11) by the shared unknowns and (N, 2, 6) by the pose of the point's view:
    rotation-vector increment (rad, Sensor frame, on the left) and translation (mm). Impossible is a
    point behind the camera, or a focal length not positive.
    """
    placed = _placed(observations, state)
    if placed is None:
        return None
    turned, points = placed
    counts = np.diff(observations.starts)
    camera = observations.camera(state.shared[:9])
    predicted, by_point, by_camera = camera.project_with_jacobian(points)
    normal = np.repeat(state.rotations[:, :, 2], counts, axis=0)
    by_height = (by_point @ normal[:, :, None])[:, :, 0]
    by_bow = by_height[:, :, None] * observations.board_warp_shape[:, None, :]
    by_shared = np.concatenate([by_camera, by_bow], axis=2)
    by_pose = np.concatenate([-by_point @ skew(turned), by_point], axis=2)
    return predicted, by_shared, by_pose


def predict_px(observations: Observations, state: State) -> FloatArray | None:
    """The image points (N, 2) of `predict` alone."""
    placed = _placed(observations, state)
    return None if placed is None else observations.camera(state.shared[:9]).project(placed[1])


def _placed(observations: Observations, state: State) -> tuple[FloatArray, FloatArray] | None:
    """Target points (N, 3) turned into Sensor, and in their places there; None as of `predict`."""
    if not np.isfinite(state.shared).all() or min(state.shared[:2]) <= 0.0:
        return None
    board = observations.printed_mm
    board[:, 2] += observations.board_warp_shape @ state.shared[9:]
    turned = np.concatenate(
        [board[observations.rows(v)] @ state.rotations[v].T for v in range(observations.n_views)]
    )
    points = turned + np.repeat(state.translations_mm, np.diff(observations.starts), axis=0)
    return (turned, points) if points[:, 2].min() > 0.0 else None


def linearise(
    observations: Observations, state: State, basis: FloatArray, weights: FloatArray
) -> NormalEquations | None:
    """Form the normal equations at ``state``; ``weights`` (N,) multiply each point's chi2.

    Those of `normal_equations` of what `predict` says, in one pass over the points, and what is
    known beforehand.
    """
    if not np.isfinite(state.shared).all() or min(state.shared[:2]) <= 0.0:
        return None
    n, f = observations.n_views, basis.shape[1]
    size = f + 7
    sums = np.zeros((n, size * size))
    is_possible = sum_views(
        observations.points_px,
        observations.whitening.reshape(-1, 4),
        observations.printed_mm,
        observations.board_warp_shape,
        np.array(observations.starts),
        np.concatenate([state.rotations.reshape(n, 9), state.translations_mm], axis=1),
        state.shared,
        observations.lens == "fisheye",
        np.ascontiguousarray(basis),
        weights,
        sums,
    )
    if not is_possible:
        return None
    blocks = sums.reshape(n, size, size)
    total = blocks.sum(axis=0)
    of_points = NormalEquations(
        float(total[-1, -1]),
        total[:f, :f],
        blocks[:, :f, f:-1],
        blocks[:, f:-1, f:-1],
        total[:f, -1],
        blocks[:, f:-1, -1],
    )
    return with_known(of_points, observations.known, state, basis)


def with_known(
    equations: NormalEquations, known: FloatArray, state: State, basis: FloatArray
) -> NormalEquations:
    """The normal equations with what is known beforehand (see `Observations`)."""
    if not (known @ basis**2).any():
        return equations
    return replace(
        equations,
        chi2=equations.chi2 + float(known @ state.shared**2),
        shared=equations.shared + basis.T @ (known[:, None] * basis),
        shared_gradient=equations.shared_gradient - basis.T @ (known * state.shared),
    )


def normal_equations(
    observations: Observations,
    predicted_px: FloatArray,
    by_shared: FloatArray,
    by_pose: FloatArray,
    weights: FloatArray,
) -> NormalEquations:
    """Sum up the points' equations in blocks.

    Parameters
    ----------
    observations
        N points of V views; a view may have none.
    predicted_px
        (N, 2) prediction.
    by_shared, by_pose
        (N, 2, F) and (N, 2, 6) its derivatives by the free shared unknowns and by the view's pose.
    weights
        (N,) factors of each point's chi2.
    """
    whitening = observations.whitening * np.sqrt(weights)[:, None, None]
    residual = (whitening @ (observations.points_px - predicted_px)[:, :, None])[:, :, 0]
    jacobian = whitening @ np.concatenate([by_shared, by_pose], axis=2)
    f = by_shared.shape[2]
    n = observations.n_views
    shared, gradient = np.zeros((f, f)), np.zeros(f)
    cross, pose, pose_gradient = np.zeros((n, f, 6)), np.zeros((n, 6, 6)), np.zeros((n, 6))
    for v in range(n):
        rows = observations.rows(v)
        block = jacobian[rows].reshape(-1, f + 6)
        normal = block.T @ block
        projected = block.T @ residual[rows].reshape(-1)
        shared += normal[:f, :f]
        gradient += projected[:f]
        cross[v], pose[v], pose_gradient[v] = normal[:f, f:], normal[f:, f:], projected[f:]
    return NormalEquations(float(np.sum(residual**2)), shared, cross, pose, gradient, pose_gradient)


def damped_step(equations: NormalEquations, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """Solve the damped normal equations by Schur's complement of the poses.

    Returns
    -------
    shared_step, pose_steps
        (F,) and (V, 6), or None if the matrix is singular.
    """
    pose = equations.pose + damping * (equations.pose * np.eye(equations.pose.shape[-1]))
    shared = equations.shared + damping * np.diag(np.diag(equations.shared))
    try:
        inverse = np.linalg.inv(pose)
        carried = equations.cross @ inverse
        schur = shared - np.sum(carried @ equations.cross.transpose(0, 2, 1), axis=0)
        right = equations.shared_gradient - np.sum(
            (carried @ equations.pose_gradient[:, :, None])[:, :, 0], axis=0
        )
        shared_step = _solve_scaled(schur, right)
    except np.linalg.LinAlgError:
        return None
    remaining = equations.pose_gradient - equations.cross.transpose(0, 2, 1) @ shared_step
    return shared_step, (inverse @ remaining[:, :, None])[:, :, 0]


def _solve_scaled(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve after scaling to unit diagonal: focal lengths and k3 differ by many orders."""
    if not len(right):
        return right
    diagonal = np.diag(matrix)
    if not diagonal.min() > 0.0:
        raise np.linalg.LinAlgError
    scale = 1.0 / np.sqrt(diagonal)
    return np.asarray(scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right))


def moved(
    state: State, basis: FloatArray, shared_step: FloatArray, pose_steps: FloatArray
) -> State:
    """Apply a step; a product of a few dozen rotations stays one to 1e-14."""
    rotations = rotation_from_vector(pose_steps[:, :3]) @ state.rotations
    return State(
        state.shared + basis @ shared_step, rotations, state.translations_mm + pose_steps[:, 3:]
    )


def adjust(
    observations: Observations,
    start: State,
    basis: FloatArray,
    weights: FloatArray | None = None,
    max_steps: int = MAX_STEPS,
) -> Minimum[State, NormalEquations] | FitFailure:
    """Minimise eq. 2.39, weighted by each point's covariance.

    ``basis`` is (11, F) from `free_basis`; (11, 0) solves the poses alone. ``weights`` (N,) are
    factors of each point's chi2, 0 to leave a point out; all 1 if None. After ``max_steps`` what is
    reached by then is returned.
    """
    used = np.ones(len(observations.points_px)) if weights is None else weights
    return descend(
        start,
        lambda state: linearise(observations, state, basis, used),
        lambda state, shared_step, pose_steps: moved(state, basis, shared_step, pose_steps),
        max_steps,
    )


def descend(
    start: S,
    equations_at: Callable[[S], NormalEquations | None],
    move: Callable[[S, FloatArray, FloatArray], S],
    max_steps: int = MAX_STEPS,
) -> Minimum[S, NormalEquations] | FitFailure:
    """Levenberg-Marquardt with the poses eliminated per view, over any such unknowns.

    ``equations_at`` gives None where a state is impossible; ``move`` takes a step of the (F,)
    shared unknowns and the (V, 6) poses. After ``max_steps`` what is reached is returned.
    """

    def evaluate(state: S) -> tuple[float, NormalEquations] | None:
        equations = equations_at(state)
        return None if equations is None else (equations.chi2, equations)

    def propose(state: S, equations: NormalEquations, damping: float) -> tuple[S, float] | None:
        step = damped_step(equations, damping)
        if step is None:
            return None
        promised = equations.shared_gradient @ step[0] + np.sum(equations.pose_gradient * step[1])
        return move(state, *step), float(promised)

    found = minimise(start, evaluate, propose, settled=_SETTLED, max_steps=max_steps)
    if found is None:
        return FitFailure(
            "the starting values put the board behind the camera",
            "check the target's columns and rows; tilt the board by 20 to 45 degrees, in a "
            "different direction from view to view",
        )
    return found


_SETTLED = 1e-10
"""Part of chi2 by which a step must lower it: 2e-6 of 20,000 coordinates, a thousandth of their
sigma. Boards that fit badly are approached by ever smaller steps; 1e-12 takes twice as long."""
SINGULAR_CONDITION = 1e13


def reduced_normal_matrix(equations: NormalEquations) -> FloatArray:
    """(F, F) normal matrix of the shared unknowns after the poses are eliminated."""
    carried = equations.cross @ np.linalg.inv(equations.pose)
    return np.asarray(
        equations.shared - np.sum(carried @ equations.cross.transpose(0, 2, 1), axis=0)
    )


def condition_number(matrix: FloatArray) -> float:
    """Condition of a symmetric matrix scaled to unit diagonal; infinite if not positive."""
    diagonal = np.diag(matrix)
    if not np.isfinite(matrix).all() or not diagonal.min() > 0.0:
        return float("inf")
    scale = 1.0 / np.sqrt(diagonal)
    values = np.linalg.eigvalsh(matrix * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 0.0 else float("inf")


def joint_covariance(
    equations: NormalEquations, basis: FloatArray
) -> tuple[FloatArray, float] | FitFailure:
    """Invert the normal equations: covariance, and condition of the reduced matrix.

    (S + 6 V, S + 6 V) of the shared unknowns and the poses, for points whose covariance is what the
    detector says; scale it by sigma0 squared. ``basis`` is (S, F) from `free_basis`.
    """
    reduced = reduced_normal_matrix(equations)
    condition = condition_number(reduced)
    if not condition < SINGULAR_CONDITION:
        return FitFailure(
            f"the views do not determine all camera parameters (condition {condition:.1e})",
            "add views in which the board is tilted differently and reaches the image's corners, "
            "or free fewer distortion coefficients",
        )
    scale = 1.0 / np.sqrt(np.diag(reduced))
    free = np.linalg.inv(reduced * np.outer(scale, scale)) * np.outer(scale, scale)
    s, n = len(basis), len(equations.pose)
    inverse = np.linalg.inv(equations.pose)
    # The poses follow the shared unknowns by -V^-1 W' (implicit function).
    followed = -inverse @ equations.cross.transpose(0, 2, 1)
    lever = np.concatenate([basis, followed.reshape(6 * n, -1)])
    covariance = lever @ free @ lever.T
    for v in range(n):
        rows = slice(s + 6 * v, s + 6 * v + 6)
        covariance[rows, rows] += inverse[v]
    return 0.5 * (covariance + covariance.T), condition
