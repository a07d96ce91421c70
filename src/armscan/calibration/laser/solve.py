# SPDX-License-Identifier: Apache-2.0
"""Generalised least squares for all sheets at once: boards and camera are uncertain, too.

The residual of a point is the movement of the stripe across itself in the image. Besides the
sheets' parameters the unknowns are the errors of the boards' poses and of the camera, with their
covariance as prior knowledge: errors that all points of an image, or all images, have in common
are so weighed as what they are.

The cameras may be free or held. Free, they take up what their own errors do to the stripes, so that
it is not taken for a bow or for outliers: models are chosen so. Held, the sheets are those that
belong to the cameras as they were calibrated: only these may stand beside them in a document, for a
sheet of moved cameras makes wrong points with the unmoved ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.laser.observations import SheetObservations
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet

ITERATIONS = 12
STEP_TOLERANCE_MM = 1e-9
CONVERGED_SIGMA = 0.01
"""A last step below this part of every parameter's own sigma does not matter any more."""
MAX_TILT_STEP = 1.0
"""A step that turns a sheet by more than 45 degrees has left what the linearised fit can do."""
HUBER_SIGMA = 2.5
MIN_EIGENVALUE = 1e-13
"""Of the normal matrix scaled to a unit diagonal, whose rounding is about 1e-15."""
N_SHEET = 8
N_PLANE = 3


@dataclass(frozen=True, slots=True, eq=False)
class CommonErrors:
    """What the boards and the cameras are known to.

    Parameters
    ----------
    pose_covariances
        (6, 6) for each board placement.
    camera_covariance
        (P, P) of the cameras' parameters, P = 9 for one camera; rows of parameters that are taken
        as exact are zero.
    """

    pose_covariances: Sequence[FloatArray]
    camera_covariance: FloatArray

    @property
    def n_camera(self) -> int:
        """Count P of the cameras' parameters."""
        return len(self.camera_covariance)


@dataclass(frozen=True, slots=True, eq=False)
class SheetSolution:
    """Sheets at the optimum.

    Parameters
    ----------
    sheets
        S sheets.
    covariance
        (P + 8 S, P + 8 S) of the errors of the cameras, as calibrated, and of these sheets.
    height_mm, residual_px
        (N,) residuals with boards and camera as measured.
    remaining_px
        (N,) residuals after the boards, and the cameras if free, are moved within their
        uncertainty.
    common
        (6 M + P,) estimated common errors of M boards and the cameras, in their own sigmas; zero
        for cameras that are held.
    chi2
        Weighted squares of ``remaining_px`` plus squares of ``common``.
    n_parameters
        Free parameters of all sheets.
    last_step_sigma
        Largest last step of a parameter, in its own sigma.
    """

    sheets: tuple[LightSheet, ...]
    covariance: FloatArray
    height_mm: FloatArray
    residual_px: FloatArray
    remaining_px: FloatArray
    common: FloatArray
    chi2: float
    n_parameters: int
    last_step_sigma: float = 0.0

    @property
    def has_converged(self) -> bool:
        """Whether the last step was too small to matter."""
        return self.last_step_sigma <= CONVERGED_SIGMA


def square_root(covariance: FloatArray) -> FloatArray:
    """(P, P) matrix L with ``L L' = covariance``, also for a covariance without full rank."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def solve_sheets(
    observations: SheetObservations,
    start: Sequence[LightSheet],
    errors: CommonErrors,
    is_bowed: Sequence[bool],
    *,
    sigma_factor: float | FloatArray = 1.0,
    is_robust: bool = False,
    are_cameras_held: bool = False,
) -> SheetSolution | FitFailure:
    """Fit the sheets by Gauss-Newton steps.

    Parameters
    ----------
    observations
        Points with the sheet of each.
    start
        Starting sheets; their axes define u and v.
    errors
        Covariance of the boards' poses and of the camera.
    is_bowed
        For each sheet, whether its bow is free; a bow that is not free is zero.
    sigma_factor
        Multiplies the stripes' sigmas in the weights; one number, or one a point.
    is_robust
        Weigh points down by Huber's function on what remains; for finding outliers.
    are_cameras_held
        Solve for the sheets that belong to the cameras as calibrated.

    Returns
    -------
    SheetSolution or FitFailure
        A failure where the points do not determine a sheet, or a step turns one by more than 45
        degrees.
    """
    sheets = [_without_bow(sheet) for sheet in start]
    active = np.concatenate(
        [np.arange(N_SHEET) < (N_SHEET if bowed else N_PLANE) for bowed in is_bowed]
    )
    sigma = observations.sigma_px * sigma_factor
    robust = np.ones(len(observations))
    n_held = errors.n_camera if are_cameras_held else 0
    for _ in range(ITERATIONS):
        system = _linearised(observations, sheets, errors, active)
        solved = system.step(robust / sigma**2, n_held)
        if solved is None:
            return _UNDETERMINED
        step, inverse, follow = solved
        full = np.zeros(N_SHEET * len(sheets))
        full[active] = step[: int(active.sum())]
        if _turns_too_far(full, sheets):
            return _UNDETERMINED
        sheets = [
            sheet.updated(full[N_SHEET * k : N_SHEET * (k + 1)]) for k, sheet in enumerate(sheets)
        ]
        remaining = system.residual_px + system.times(step)
        if is_robust:
            robust = _huber(remaining / sigma)
        elif float(np.abs(full).max()) < STEP_TOLERANCE_MM:
            break
    n_active = int(active.sum())
    common = step[n_active:]
    system = _linearised(observations, sheets, errors, active)
    remaining = system.residual_px + system.times(np.concatenate([np.zeros(n_active), common]))
    return SheetSolution(
        tuple(sheets),
        _joint_covariance(inverse, follow, active, errors),
        system.height_mm,
        system.residual_px,
        remaining,
        common,
        float((robust * (remaining / sigma) ** 2).sum() + common @ common),
        n_active,
        float((np.abs(step[:n_active]) / np.sqrt(np.diag(inverse)[:n_active])).max()),
    )


_UNDETERMINED = FitFailure(
    "the stripes do not determine the light sheets: the fit leaves the plane through the points",
    "spread the boards over more depth, tilt them differently, and check their poses",
)


def _turns_too_far(full: FloatArray, sheets: Sequence[LightSheet]) -> bool:
    tilts_mm = full.reshape(len(sheets), N_SHEET)[:, :2]
    scales_mm = np.array([sheet.scale_mm for sheet in sheets])
    return bool((np.abs(tilts_mm).max(axis=1) > MAX_TILT_STEP * scales_mm).any())


def _without_bow(sheet: LightSheet) -> LightSheet:
    return replace(sheet, bow_mm=np.zeros(5))


@dataclass(frozen=True, slots=True, eq=False)
class _Stripe:
    """Derivatives of one stripe's K residuals: (K, C) by the C of the sheets' and cameras' unknowns
    in ``columns`` that move it, (K, 6) by its board's pose.
    """

    rows: IntArray
    columns: IntArray
    design: FloatArray
    board: int
    by_board: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """All residuals with their derivatives by the active sheet parameters and common errors.

    The unknowns are the sheets' active parameters, then the boards' errors, then the cameras'. A
    board moves its own stripes only, so that the boards are eliminated one by one.
    """

    stripes: tuple[_Stripe, ...]
    n_active: int
    n_boards: int
    n_camera: int
    residual_px: FloatArray
    height_mm: FloatArray

    def times(self, unknowns: FloatArray) -> FloatArray:
        """(N,) change of the residuals."""
        shared, boards = self._parted(unknowns)
        change = np.zeros(len(self.residual_px))
        for stripe in self.stripes:
            change[stripe.rows] = (
                stripe.design @ shared[stripe.columns] + stripe.by_board @ boards[stripe.board]
            )
        return change

    def _parted(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sheets' and cameras' unknowns, and (M, 6) those of the boards."""
        a, b = self.n_active, self.n_active + 6 * self.n_boards
        return np.concatenate([unknowns[:a], unknowns[b:]]), unknowns[a:b].reshape(-1, 6)

    def step(
        self, weight: FloatArray, n_held: int
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Step, inverse of the normal matrix, and how the step follows the unknowns held.

        The common errors are known to be 0 +- 1; the last ``n_held`` of them stay 0. The second is
        (U, U) and the third (U, n_held) for the U unknowns of sheets and cameras that are free.
        None where the matrix is not positive definite to rounding, so that nothing of it means
        anything.
        """
        n = self.n_active + self.n_camera
        information = np.diag((np.arange(n) >= self.n_active).astype(np.float64))
        pull = np.zeros(n)
        blocks = np.tile(np.eye(6), (self.n_boards, 1, 1))
        mixed = np.zeros((self.n_boards, 6, n))
        pulls = np.zeros((self.n_boards, 6))
        for stripe in self.stripes:
            w, residual = weight[stripe.rows, None], self.residual_px[stripe.rows]
            weighted, board = stripe.design * w, (stripe.by_board * w).T
            information[np.ix_(stripe.columns, stripe.columns)] += weighted.T @ stripe.design
            pull[stripe.columns] += weighted.T @ residual
            blocks[stripe.board] += board @ stripe.by_board
            mixed[stripe.board][:, stripe.columns] += board @ stripe.design
            pulls[stripe.board] += board @ residual
        diagonal = np.diag(information)
        if not all(np.isfinite(part).all() for part in (information, blocks, mixed)):
            return None
        if not (diagonal > 0.0).all():
            return None
        of_boards = np.linalg.solve(blocks, np.concatenate([mixed, pulls[:, :, None]], axis=2))
        reduced = information - np.einsum("bki,bkj->ij", mixed, of_boards[:, :, :n])
        pull = pull - np.einsum("bki,bk->i", mixed, of_boards[:, :, n])
        free = n - n_held
        scale = 1.0 / np.sqrt(diagonal[:free])
        values, vectors = np.linalg.eigh(reduced[:free, :free] * np.outer(scale, scale))
        if not values[0] > MIN_EIGENVALUE:
            return None
        inverse = np.outer(scale, scale) * ((vectors / values) @ vectors.T)
        shared = np.concatenate([-inverse @ pull[:free], np.zeros(n_held)])
        boards = -of_boards[:, :, n] - of_boards[:, :, :n] @ shared
        a = self.n_active
        step = np.concatenate([shared[:a], boards.ravel(), shared[a:]])
        return step, np.asarray(inverse), np.asarray(-inverse @ reduced[:free, free:])


def _linearised(
    observations: SheetObservations,
    sheets: Sequence[LightSheet],
    errors: CommonErrors,
    active: BoolArray,
) -> _System:
    height, residual, by_sheet, by_point = observations.residuals_px(sheets)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.by_camera)
    by_camera = by_camera @ square_root(errors.camera_covariance)
    by_pose = np.einsum("ni,nij->nj", by_point, observations.by_pose)
    pose_roots = [square_root(covariance) for covariance in errors.pose_covariances]
    n_active = int(active.sum())
    column = np.cumsum(active) - 1
    order = np.argsort(observations.stripe, kind="stable")
    starts = np.flatnonzero(np.diff(observations.stripe[order], prepend=-1))
    cameras = np.arange(errors.n_camera)
    stripes = []
    for rows in np.split(order, starts[1:]):
        sheet, board = int(observations.sheet[rows[0]]), int(observations.board[rows[0]])
        own = np.flatnonzero(active[N_SHEET * sheet : N_SHEET * (sheet + 1)])
        columns = np.concatenate([column[N_SHEET * sheet + own], n_active + cameras])
        design = np.concatenate([by_sheet[rows][:, own], by_camera[rows]], axis=1)
        stripes.append(_Stripe(rows, columns, design, board, by_pose[rows] @ pose_roots[board]))
    n_boards = len(errors.pose_covariances)
    return _System(tuple(stripes), n_active, n_boards, errors.n_camera, residual, height)


def _huber(normalised: FloatArray) -> FloatArray:
    scale = max(1.0, 1.4826 * float(np.median(np.abs(normalised))))
    return np.asarray(HUBER_SIGMA * scale / np.maximum(np.abs(normalised), HUBER_SIGMA * scale))


def _joint_covariance(
    inverse: FloatArray, follow: FloatArray, active: BoolArray, errors: CommonErrors
) -> FloatArray:
    """Covariance of the errors of cameras and sheets, the cameras as they were calibrated.

    With the cameras' error ``e_c = L w`` in its own sigmas: sheets of cameras that are held follow
    it, ``e_s = F w + n`` with F from the normal equations (n by stripes and boards, of covariance
    ``inverse``). Sheets of free cameras err by ``e_s`` with ``cov(e_s, w) = inverse[s, w]``.
    """
    n_active, n_sheets, p = int(active.sum()), len(active), errors.n_camera
    root = square_root(errors.camera_covariance)
    own = inverse[:n_active, :n_active]
    if follow.shape[1]:
        by_camera = follow[:n_active]
        own = own + by_camera @ by_camera.T
    else:
        by_camera = inverse[:n_active, len(inverse) - p :]
    joint = np.zeros((p + n_sheets, p + n_sheets))
    joint[:p, :p] = errors.camera_covariance
    places = p + np.flatnonzero(active)
    joint[np.ix_(places, places)] = own
    cross = by_camera @ root.T
    joint[np.ix_(places, np.arange(p))] = cross
    joint[np.ix_(np.arange(p), places)] = cross.T
    return 0.5 * (joint + joint.T)
