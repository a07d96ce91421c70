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

from armscan.calibration.laser.normal_equations import NormalSolution, StripeRows, StripeSystem
from armscan.calibration.laser.observations import SheetObservations
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet

ITERATIONS = 12
STEP_TOLERANCE_MM = 1e-9
CONVERGED_SIGMA = 0.01
"""A last step below this part of every parameter's own sigma does not matter any more."""
MAX_TILT_STEP = 1.0
"""A step that turns a sheet by more than 45 degrees has left what the linearised fit can do."""
HUBER_SIGMA = 2.5
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

    def with_boards(self, factor: float) -> CommonErrors:
        """The same with the boards' standard deviations multiplied."""
        return replace(self, pose_covariances=[factor**2 * one for one in self.pose_covariances])

    @property
    def n_camera(self) -> int:
        """Count P of the cameras' parameters."""
        return len(self.camera_covariance)

    @property
    def count(self) -> int:
        """Count of the common errors: 6 a board, then P."""
        return 6 * len(self.pose_covariances) + self.n_camera


@dataclass(frozen=True, slots=True, eq=False)
class LinearSolution:
    """The last normal equations of a fit.

    Parameters
    ----------
    system
        At the solution.
    normal
        Its inverse, and the last step.
    weight
        (N,) of the points, 1/px^2.
    active
        (8 S,) True for the sheets' parameters that are free.
    """

    system: StripeSystem
    normal: NormalSolution
    weight: FloatArray
    active: BoolArray


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
    linear
        The normal equations.
    """

    sheets: tuple[LightSheet, ...]
    covariance: FloatArray
    height_mm: FloatArray
    residual_px: FloatArray
    remaining_px: FloatArray
    common: FloatArray
    chi2: float
    n_parameters: int
    last_step_sigma: float
    linear: LinearSolution

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
    normal: NormalSolution | None = None
    for _ in range(ITERATIONS):
        system = _linearised(observations, sheets, errors, active)
        normal = system.solve(robust / sigma**2, n_held)
        if normal is None:
            return _UNDETERMINED
        step = normal.step
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
    if normal is None:
        return _UNDETERMINED
    n_active = int(active.sum())
    common = step[n_active:]
    system = _linearised(observations, sheets, errors, active)
    remaining = system.residual_px + system.times(np.concatenate([np.zeros(n_active), common]))
    return SheetSolution(
        tuple(sheets),
        _joint_covariance(normal, active, errors),
        system.height_mm,
        system.residual_px,
        remaining,
        common,
        float((robust * (remaining / sigma) ** 2).sum() + common @ common),
        n_active,
        float((np.abs(step[:n_active]) / np.sqrt(np.diag(normal.covariance))).max()),
        LinearSolution(system, normal, robust / sigma**2, active),
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


def _linearised(
    observations: SheetObservations,
    sheets: Sequence[LightSheet],
    errors: CommonErrors,
    active: BoolArray,
) -> StripeSystem:
    height, residual, by_sheet, by_point = observations.residuals_px(sheets)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.by_camera)
    by_camera = by_camera @ square_root(errors.camera_covariance)
    by_pose = np.einsum("ni,nij->nj", by_point, observations.by_pose)
    pose_roots = [square_root(covariance) for covariance in errors.pose_covariances]
    n_active = int(active.sum())
    n_columns = n_active + errors.count
    column = np.cumsum(active) - 1
    order = np.argsort(observations.stripe, kind="stable")
    starts = np.flatnonzero(np.diff(observations.stripe[order], prepend=-1))
    stripes = []
    for rows in np.split(order, starts[1:]):
        sheet, board = int(observations.sheet[rows[0]]), int(observations.board[rows[0]])
        own = np.flatnonzero(active[N_SHEET * sheet : N_SHEET * (sheet + 1)])
        columns = np.concatenate(
            [
                column[N_SHEET * sheet + own],
                n_active + 6 * board + np.arange(6),
                np.arange(n_columns - errors.n_camera, n_columns),
            ]
        )
        design = [by_sheet[rows][:, own], by_pose[rows] @ pose_roots[board], by_camera[rows]]
        stripes.append(StripeRows(rows, board, columns, np.concatenate(design, axis=1)))
    return StripeSystem(tuple(stripes), n_active, len(pose_roots), n_columns, residual, height)


def _huber(normalised: FloatArray) -> FloatArray:
    scale = max(1.0, 1.4826 * float(np.median(np.abs(normalised))))
    return np.asarray(HUBER_SIGMA * scale / np.maximum(np.abs(normalised), HUBER_SIGMA * scale))


def _joint_covariance(
    normal: NormalSolution, active: BoolArray, errors: CommonErrors
) -> FloatArray:
    """Covariance of the errors of cameras and sheets, the cameras as they were calibrated.

    With the cameras' error ``e_c = L w`` in its own sigmas: sheets of cameras that are held follow
    it, ``e_s = F w + n`` with F from the normal equations and n by stripes and boards. Sheets of
    free cameras err by ``e_s`` with ``cov(e_s, w)`` from the inverse.
    """
    n_sheets, p = len(active), errors.n_camera
    own, by_camera = normal.covariance, normal.by_cameras
    if normal.follow.shape[1]:
        by_camera = normal.follow
        own = own + by_camera @ by_camera.T
    joint = np.zeros((p + n_sheets, p + n_sheets))
    joint[:p, :p] = errors.camera_covariance
    places = p + np.flatnonzero(active)
    joint[np.ix_(places, places)] = own
    cross = by_camera @ square_root(errors.camera_covariance).T
    joint[np.ix_(places, np.arange(p))] = cross
    joint[np.ix_(np.arange(p), places)] = cross.T
    return 0.5 * (joint + joint.T)
