# SPDX-License-Identifier: Apache-2.0
"""Joint solution of all sheets and the boards' poses: observations of each sheet, normal
equations with the boards eliminated, and the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.sheets.labels import SheetAssignment, board_numbers
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet


@dataclass(frozen=True, slots=True, eq=False)
class SheetObservations:
    """N stripe points on boards, each given to a sheet, ordered by image, then along each stripe.

    Parameters
    ----------
    image, row
        (N,) image, and row of its profile.
    board
        (N,) board placement: images of one placement share it.
    sheet
        (N,) index of the sheet.
    stripe
        (N,) number of the stripe (one image, one sheet) that the point belongs to.
    points_mm
        (N, 3) in the Sensor frame, boards as measured.
    across_mm_px
        (N, 3) movement of the point for one pixel across the stripe.
    sigma_px
        (N,) stripe noise across the stripe.
    by_pose
        (N, 3, 6) derivative by the pose of the point's own board.
    by_camera
        (N, 3, P) total derivative by the cameras' parameters, the boards' poses following them.
    """

    image: IntArray
    row: IntArray
    board: IntArray
    sheet: IntArray
    stripe: IntArray
    points_mm: FloatArray
    across_mm_px: FloatArray
    sigma_px: FloatArray
    by_pose: FloatArray
    by_camera: FloatArray

    def __len__(self) -> int:
        """Count of points."""
        return len(self.image)

    def select(self, keep: BoolArray) -> SheetObservations:
        """Return the observations where ``keep`` (N,) is True."""
        return SheetObservations(
            self.image[keep],
            self.row[keep],
            self.board[keep],
            self.sheet[keep],
            self.stripe[keep],
            self.points_mm[keep],
            self.across_mm_px[keep],
            self.sigma_px[keep],
            self.by_pose[keep],
            self.by_camera[keep],
        )

    def as_one_sheet(self) -> SheetObservations:
        """Return the same points as points of sheet 0, for a fit of one sheet alone."""
        return replace(self, sheet=np.zeros(len(self), dtype=np.int64))

    def residuals_px(
        self, sheets: Sequence[LightSheet]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Distances from the sheets and their derivatives.

        Returns
        -------
        height_mm
            (N,) distance of each point from its sheet along the normal.
        residual_px
            (N,) the same as a movement of the stripe across itself in the image.
        dr_dsheet
            (N, 8) derivative of ``residual_px`` by the parameters of the point's own sheet.
        dr_dpoint
            (N, 3) derivative of ``residual_px`` by the point, px/mm.
        """
        height = np.zeros(len(self))
        by_point = np.zeros((len(self), 3))
        by_sheet = np.zeros((len(self), 8))
        for k, sheet in enumerate(sheets):
            own = self.sheet == k
            height[own], by_point[own], by_sheet[own] = sheet.height_with_jacobian(
                self.points_mm[own]
            )
        mm_per_px = np.einsum("ni,ni->n", by_point, self.across_mm_px)
        return (
            height,
            height / mm_per_px,
            by_sheet / mm_per_px[:, None],
            by_point / mm_per_px[:, None],
        )


def placement_covariances(images: Sequence[BoardImage]) -> list[FloatArray]:
    """(6, 6) covariance of the pose of each board placement, in the order of their numbers."""
    boards = board_numbers(images)
    return [images[boards.index(board)].placed.covariance for board in range(max(boards) + 1)]


def collect_observations(images: Sequence[BoardImage], named: SheetAssignment) -> SheetObservations:
    """Gather all named stripe points."""
    parts: list[tuple[int, IntArray, int]] = [
        (i, sighting.rows, sheet)
        for i, (image, sheets) in enumerate(zip(images, named.sheets, strict=True))
        for sighting, sheet in zip(image.sightings, sheets, strict=True)
        if sheet >= 0
    ]
    across = [
        np.einsum(
            "nij,nj->ni",
            images[i].points.dpoint_dq[rows],
            images[i].data.profile.normals_px[rows],
        )
        for i, rows, _ in parts
    ]
    by_pose = [images[i].points.dpoint_dpose[rows] for i, rows, _ in parts]
    by_camera = [images[i].by_camera[rows] for i, rows, _ in parts]
    boards = board_numbers(images)
    return SheetObservations(
        np.concatenate([np.full(len(rows), i) for i, rows, _ in parts]),
        np.concatenate([rows for _, rows, _ in parts]),
        np.concatenate([np.full(len(rows), boards[i]) for i, rows, _ in parts]),
        np.concatenate([np.full(len(rows), sheet) for _, rows, sheet in parts]),
        np.concatenate([np.full(len(rows), k) for k, (_, rows, _) in enumerate(parts)]),
        np.concatenate([images[i].points.points_mm[rows] for i, rows, _ in parts]),
        np.concatenate(across),
        np.concatenate([images[i].data.profile.sigma_px[rows] for i, rows, _ in parts]),
        np.concatenate(by_pose),
        np.concatenate(by_camera),
    )


MIN_EIGENVALUE = 1e-13
"""Of the normal matrix scaled to a unit diagonal, whose rounding is about 1e-15."""


@dataclass(frozen=True, slots=True, eq=False)
class StripeRows:
    """One stripe's residuals: ``design`` (K, C) is their derivative by the C unknowns ``columns``.

    Parameters
    ----------
    rows
        (K,) its points.
    board
        Number of its board.
    columns
        (C,) unknowns that move it: of its sheet, of its board, of the cameras, in this order.
    design
        (K, C) px per unit of each.
    """

    rows: IntArray
    board: int
    columns: IntArray
    design: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class StripeSystem:
    """All residuals with their derivatives.

    Parameters
    ----------
    stripes
        One entry a stripe.
    n_sheet, n_boards, n_columns
        Free parameters of all sheets, which come first; boards, with six unknowns each; count of
        all unknowns.
    residual_px, height_mm
        (N,) distance of the points from their sheets, in the image and in space.
    """

    stripes: tuple[StripeRows, ...]
    n_sheet: int
    n_boards: int
    n_columns: int
    residual_px: FloatArray
    height_mm: FloatArray

    def times(self, unknowns: FloatArray) -> FloatArray:
        """(N,) change of the residuals."""
        change = np.zeros(len(self.residual_px))
        for stripe in self.stripes:
            change[stripe.rows] = stripe.design @ unknowns[stripe.columns]
        return change

    def transposed(self, values: FloatArray) -> FloatArray:
        """(n_columns,) the design's transpose times values (N,)."""
        result = np.zeros(self.n_columns)
        for stripe in self.stripes:
            result[stripe.columns] += values[stripe.rows] @ stripe.design
        return result

    def solve(
        self, weight: FloatArray, n_held: int, without_board: int = -1
    ) -> NormalSolution | None:
        """Solve with weights (N,), the last ``n_held`` unknowns held and one board left out.

        None where the matrix is not positive definite to rounding, so that nothing of it means
        anything.
        """
        n_sheet, n_boards = self.n_sheet, self.n_boards
        shared = np.concatenate(
            [np.arange(n_sheet), np.arange(n_sheet + 6 * n_boards, self.n_columns)]
        )
        place = np.full(self.n_columns, -1)
        place[shared] = np.arange(len(shared))
        own = np.diag((np.arange(len(shared)) >= n_sheet).astype(np.float64))
        cross, board = np.zeros((n_boards, len(shared), 6)), np.tile(np.eye(6), (n_boards, 1, 1))
        pull = np.zeros(self.n_columns)
        for stripe in self.stripes:
            if stripe.board == without_board:
                continue
            weighted = stripe.design * weight[stripe.rows, None]
            block = weighted.T @ stripe.design
            is_shared = place[stripe.columns] >= 0
            to = place[stripe.columns[is_shared]]
            own[np.ix_(to, to)] += block[np.ix_(is_shared, is_shared)]
            cross[stripe.board, to] += block[np.ix_(is_shared, ~is_shared)]
            board[stripe.board] += block[np.ix_(~is_shared, ~is_shared)]
            pull[stripe.columns] += weighted.T @ self.residual_px[stripe.rows]
        if not all(np.isfinite(part).all() for part in (own, cross, board)):
            return None
        # Boards do not meet each other: each is eliminated by itself.
        board = np.asarray(np.linalg.inv(board), dtype=np.float64)
        carried = cross @ board
        reduced = own - np.einsum("bik,bjk->ij", carried, cross)
        boards_pull = pull[n_sheet : n_sheet + 6 * n_boards].reshape(n_boards, 6)
        shared_pull = pull[shared] - np.einsum("bik,bk->i", carried, boards_pull)
        n_kept = len(shared) - n_held
        inverse = _inverse(reduced[:n_kept, :n_kept], own[:n_kept, :n_kept])
        if inverse is None:
            return None
        found = np.concatenate([-inverse @ shared_pull[:n_kept], np.zeros(n_held)])
        boards = -np.einsum("bkl,bl->bk", board, boards_pull)
        boards -= np.einsum("bik,i->bk", carried, found)
        to_boards = -np.einsum("si,bik->sbk", inverse[:n_sheet], carried[:, :n_kept])
        return NormalSolution(
            np.concatenate([found[:n_sheet], boards.ravel(), found[n_sheet:]]),
            np.concatenate(
                [
                    inverse[:n_sheet, :n_sheet],
                    to_boards.reshape(n_sheet, 6 * n_boards),
                    inverse[:n_sheet, n_sheet:],
                ],
                axis=1,
            ),
            np.asarray(-inverse[:n_sheet] @ reduced[:n_kept, n_kept:]),
            6 * n_boards,
        )


def _inverse(matrix: FloatArray, scaled_by: FloatArray) -> FloatArray | None:
    """Inverse of a positive definite matrix; None if it is not, to rounding.

    ``scaled_by`` is the same before anything was eliminated: what is left must not be lost in its
    rounding.
    """
    diagonal = np.diag(scaled_by)
    if not (diagonal > 0.0).all():
        return None
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    if not values[0] > MIN_EIGENVALUE:
        return None
    return np.asarray(np.outer(scale, scale) * ((vectors / values) @ vectors.T))


@dataclass(frozen=True, slots=True, eq=False)
class NormalSolution:
    """Solution of the normal equations of U unknowns that are free and some that are held.

    Parameters
    ----------
    step
        (n_columns,) of the unknowns; zero for those that are held.
    gain
        (S, U) the rows of the inverse that belong to the S parameters of the sheets, which come
        first: their covariance with all that is free. Their step is minus this times the design's
        weighted transpose times the residuals.
    follow
        (S, n_held) how they follow the unknowns that are held.
    n_board
        Unknowns of all boards, which come next.
    """

    step: FloatArray
    gain: FloatArray
    follow: FloatArray
    n_board: int

    @property
    def n_sheet(self) -> int:
        """Count S of the sheets' free parameters."""
        return len(self.gain)

    @property
    def n_free(self) -> int:
        """Count U of free unknowns."""
        return int(self.gain.shape[1])

    @property
    def covariance(self) -> FloatArray:
        """(S, S) of the sheets by all that is free."""
        return self.gain[:, : self.n_sheet]

    @property
    def by_cameras(self) -> FloatArray:
        """(S, P) covariance of the sheets with the cameras' errors; none if these are held."""
        return self.gain[:, self.n_sheet + self.n_board :]

    @property
    def by_boards(self) -> FloatArray:
        """(S, U - S) how the sheets' errors follow those of the boards, in sigmas of these."""
        return self.gain[:, self.n_sheet :]

    @property
    def by_stripes(self) -> FloatArray:
        """(S, S) covariance of the sheets by the stripes' noise alone."""
        return np.asarray(self.covariance - self.by_boards @ self.by_boards.T)


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
