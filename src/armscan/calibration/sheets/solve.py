# SPDX-License-Identifier: Apache-2.0
"""Generalised least squares for all sheets at once: boards and camera are uncertain, too.

The residual of a point is the movement of the stripe across itself in the image. Besides the
sheets' parameters the unknowns are the errors of the boards' poses and of the cameras, with their
covariance as prior knowledge: errors that all points of an image, or all images, have in common are
so weighed as what they are. They are counted in their own sigmas, so that each is known to be 0 +-
1; the cameras' come last.

The cameras may be free or held. Free, they take up what their own errors do to the stripes, so that
it is not taken for a bow or for outliers: models are chosen so. Held, the sheets are those that
belong to the cameras as they were calibrated: only these may stand beside them in a document, for a
sheet of moved cameras makes wrong points with the unmoved ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from armscan.calibration.sheets.labels import SheetAssignment, board_numbers
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, floats, ints
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import eigen, huber_weights, robust_sigma, square_root
from armscan.models.light_sheet import LightSheet

ITERATIONS = 12
SETTLED_SIGMA = 1e-4
"""Steps end at a largest one of this part of a parameter's own sigma."""
CONVERGED_SIGMA = 0.01
"""A last step below this part of every parameter's own sigma does not matter any more."""
MAX_TILT_STEP = 1.0
"""A step that turns a sheet by more than 45 degrees has left what the linearised fit can do."""
HUBER_SIGMA = 2.5
MIN_EIGENVALUE = 1e-13
"""Of the normal matrix scaled to a unit diagonal, whose rounding is about 1e-15."""
N_SHEET = 8
N_PLANE = 3
LIKELY_BOW = 0.003
"""What a sheet may bow by at the edge of its calibrated region, in parts of that region's half
size: of a line lens that is 1 degree askew, three half sizes away."""
BOW_SHARES = np.array([3.0, 2.0, 1.0 / 3.0, 1.0, 1.0]) / 3.0
"""Likely size of the bow's terms (`BOW_TERMS`) over that of ``u**2``. Light spreads in straight
rays: what bends along the depth is the bow along the stripe, carried by rays that lean, and spread,
by a third, as from that source."""


class SheetObservations(RowRecord):
    """N stripe points on boards, each given to a sheet, ordered by image, then along each stripe.

    Parameters
    ----------
    image, row, board, sheet, stripe
        Numbers of the image, of the row of its profile, of the board placement, which images may
        share, of the sheet, and of the stripe (one image, one sheet).
    points_mm
        In the Sensor frame, boards as measured.
    across_mm_px, sigma_px
        Movement of the point for one pixel across the stripe, and the stripe's noise there.
    dpoint_dpose, dpoint_dcamera
        Derivative by the pose of the point's own board, and total derivative by the cameras'
        parameters, the boards' poses following them.
    """

    image: IntArray = ints("N")
    row: IntArray = ints("N")
    board: IntArray = ints("N")
    sheet: IntArray = ints("N")
    stripe: IntArray = ints("N")
    points_mm: FloatArray = floats("N", 3)
    across_mm_px: FloatArray = floats("N", 3)
    sigma_px: FloatArray = floats("N")
    dpoint_dpose: FloatArray = floats("N", 3, 6)
    dpoint_dcamera: FloatArray = floats("N", 3, "P")

    def as_one_sheet(self) -> SheetObservations:
        """Return the same points as points of sheet 0, for a fit of one sheet alone."""
        return replace(self, sheet=np.zeros(len(self), dtype=np.int64))

    def each_stripe(self) -> list[IntArray]:
        """Rows (K,) of the points of each stripe, by its number."""
        order = np.argsort(self.stripe, kind="stable")
        starts = np.flatnonzero(np.diff(self.stripe[order]))
        return np.split(order, starts + 1) if len(order) else []

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
        by_sheet = np.zeros((len(self), N_SHEET))
        for k, sheet in enumerate(sheets):
            of = self.sheet == k
            height[of], by_point[of], by_sheet[of] = sheet.height_with_jacobian(self.points_mm[of])
        mm_per_px = np.einsum("ni,ni->n", by_point, self.across_mm_px)
        return (
            height,
            height / mm_per_px,
            by_sheet / mm_per_px[:, None],
            by_point / mm_per_px[:, None],
        )


def stack_observations(
    images: Sequence[BoardImage], assignment: SheetAssignment
) -> SheetObservations:
    """All stripe points that are given to a sheet."""
    boards = board_numbers(images)
    stripes = [
        (i, stripe.rows, sheet)
        for i, (image, sheets) in enumerate(zip(images, assignment.sheets, strict=True))
        for stripe, sheet in zip(image.stripes, sheets, strict=True)
        if sheet >= 0
    ]
    parts = []
    for number, (i, rows, sheet) in enumerate(stripes):
        points, profile = images[i].points, images[i].data.profile
        parts.append(
            SheetObservations(
                image=np.full(len(rows), i),
                row=rows,
                board=np.full(len(rows), boards[i]),
                sheet=np.full(len(rows), sheet),
                stripe=np.full(len(rows), number),
                points_mm=points.points_mm[rows],
                across_mm_px=np.einsum(
                    "nij,nj->ni", points.dpoint_dq[rows], _to_one_side(profile.normals_px[rows])
                ),
                sigma_px=profile.sigma_px[rows],
                dpoint_dpose=points.dpoint_dpose[rows],
                dpoint_dcamera=images[i].dpoint_dcamera[rows],
            )
        )
    return SheetObservations.concat(parts)


def _to_one_side(normals: FloatArray) -> FloatArray:
    """Normals (N, 2) of the segments of a stripe, each known but for its sign, on the first's side.

    A residual means the same all along the stripe then.
    """
    middle = np.linalg.eigh(normals.T @ normals)[1][:, 1]
    is_there = normals @ middle >= 0.0
    return np.where((is_there == is_there[0])[:, None], normals, -normals)


@dataclass(frozen=True, eq=False)
class CommonErrors:
    """What the boards and the cameras are known to.

    A covariance (6, 6) of each board placement's pose, and that (P, P) of the cameras' parameters,
    in which rows of parameters that are taken as exact are zero; with their square roots.
    """

    pose_covariances: Sequence[FloatArray]
    camera_covariance: FloatArray

    @cached_property
    def pose_roots(self) -> list[FloatArray]:
        """(6, 6) for each board placement."""
        return [square_matrix_root(covariance) for covariance in self.pose_covariances]

    @cached_property
    def camera_root(self) -> FloatArray:
        """(P, P) of the cameras' parameters."""
        return square_matrix_root(self.camera_covariance)

    @staticmethod
    def of(images: Sequence[BoardImage]) -> CommonErrors:
        """Of the images' boards, in the order of their numbers, and of their cameras."""
        boards = board_numbers(images)
        firsts = [images[boards.index(board)] for board in range(max(boards) + 1)]
        covariances = [image.placed.covariance for image in firsts]
        return CommonErrors(covariances, images[0].camera_covariance)

    def with_boards(self, factors: FloatArray | Sequence[float]) -> CommonErrors:
        """The same with the standard deviations of each board multiplied by its own factor."""
        pairs = zip(factors, self.pose_covariances, strict=True)
        return replace(self, pose_covariances=[factor**2 * one for factor, one in pairs])

    @property
    def n_camera(self) -> int:
        """Count P of the cameras' parameters."""
        return len(self.camera_covariance)


def square_matrix_root(covariance: FloatArray) -> FloatArray:
    """(P, P) L with ``L L' = covariance``, its last columns zero where rank is missing."""
    root = square_root(covariance)
    return np.pad(root, ((0, 0), (0, len(root) - root.shape[1])))


@dataclass(frozen=True, slots=True, eq=False)
class SheetSolution:
    """S sheets at the optimum, of N points on M boards seen by cameras with P parameters.

    Parameters
    ----------
    covariance
        (P + 8 S, P + 8 S) of the errors of the cameras, as calibrated, and of these sheets.
    remaining_px
        (N,) residuals after boards, and cameras if free, are moved within their uncertainty.
    common
        (6 M + P,) estimated common errors of boards and cameras, in their own sigmas; zero for
        cameras that are held.
    chi2
        Weighted squares of ``remaining_px`` plus squares of ``common``, and of the bows that are
        known beforehand to be small, over what is likely of them.
    last_step_sigma
        Largest last step of a parameter, in its own sigma.
    active
        (8 S,) True for the sheets' parameters that are free.
    weight
        (N,) of the points, 1/px^2.
    system, normal
        The residuals, linearised with boards and camera as measured, and the last normal equations.
    """

    sheets: tuple[LightSheet, ...]
    covariance: FloatArray
    remaining_px: FloatArray
    common: FloatArray
    chi2: float
    last_step_sigma: float
    active: BoolArray
    weight: FloatArray
    system: StripeSystem
    normal: NormalSolution

    @property
    def n_parameters(self) -> int:
        """Parameters of all sheets of which nothing is known beforehand."""
        return int(np.count_nonzero(self.system.precision == 0.0))

    @property
    def has_converged(self) -> bool:
        """Whether the last step was too small to matter."""
        return self.last_step_sigma <= CONVERGED_SIGMA


def solve_sheets(
    observations: SheetObservations,
    start: Sequence[LightSheet],
    errors: CommonErrors,
    is_bowed: Sequence[bool],
    *,
    sigma_factor: float | FloatArray = 1.0,
    is_robust: bool = False,
    are_cameras_held: bool = False,
    may_bow: bool = False,
) -> SheetSolution | FitFailure:
    """Fit the sheets by Gauss-Newton steps.

    The axes of the starting sheets define u and v. A bow that is not free (``is_bowed``) is zero.
    ``sigma_factor`` multiplies the stripes' sigmas, one number or one a point; ``is_robust`` weighs
    points down by Huber's function on what remains, for finding outliers; ``are_cameras_held``
    solves for the sheets that belong to the cameras as calibrated. With ``may_bow`` a bow that is
    not free is not zero but known beforehand to be so to `LIKELY_BOW`: a plane is kept as long as
    no test asks for more, which is no proof that the sheet is one. Where the stripes say nothing of
    a bow it stays zero, and uncertain by as much; where they show that there is none, next to
    nothing is added.

    A failure where the points do not determine a sheet, or a step turns one by more than 45
    degrees.
    """
    sheets = [replace(sheet, bow_mm=np.zeros(5)) for sheet in start]
    is_free = np.concatenate(
        [np.arange(N_SHEET) < (N_SHEET if bowed else N_PLANE) for bowed in is_bowed]
    )
    active = is_free | may_bow
    precision = np.where(is_free, 0.0, _likely_bows_mm(sheets) ** -2.0)[active]
    n_active = int(active.sum())
    sigma = observations.sigma_px * sigma_factor
    robust = np.ones(len(observations))
    n_held = errors.n_camera if are_cameras_held else 0
    for k in range(ITERATIONS):
        system = _linearised(observations, sheets, errors, active, precision)
        solved = system.solve(robust / sigma**2, n_held)
        if solved is None:
            return _UNDETERMINED
        normal = solved
        full = np.zeros(N_SHEET * len(sheets))
        full[active] = normal.step[:n_active]
        if _turns_too_far(full, sheets):
            return _UNDETERMINED
        sheets = [
            sheet.updated(full[N_SHEET * k : N_SHEET * (k + 1)]) for k, sheet in enumerate(sheets)
        ]
        remaining = system.residual_px + system.times(normal.step)
        if is_robust:
            scale = max(1.0, robust_sigma(remaining / sigma))
            robust = huber_weights(remaining / sigma, HUBER_SIGMA * scale)
        last_step_sigma = _in_sigmas(normal, n_active)
        if last_step_sigma < SETTLED_SIGMA and (k > 0 or not is_robust):
            break
    common = normal.step[n_active:]
    system = _linearised(observations, sheets, errors, active, precision)
    remaining = system.residual_px + system.times(np.concatenate([np.zeros(n_active), common]))
    return SheetSolution(
        sheets=tuple(sheets),
        covariance=_joint_covariance(normal, active, errors),
        remaining_px=remaining,
        common=common,
        chi2=float(
            (robust * (remaining / sigma) ** 2).sum()
            + common @ common
            + system.precision @ system.bow_mm**2
        ),
        last_step_sigma=last_step_sigma,
        active=active,
        weight=robust / sigma**2,
        system=system,
        normal=normal,
    )


def _in_sigmas(normal: NormalSolution, n_active: int) -> float:
    """Largest step of a sheet's parameter, in its own sigma."""
    return float((np.abs(normal.step[:n_active]) / np.sqrt(np.diag(normal.covariance))).max())


def _likely_bows_mm(sheets: Sequence[LightSheet]) -> FloatArray:
    """(8 S,) likely size of the sheets' bows; of no meaning for the planes' parameters."""
    shares = np.concatenate([np.ones(N_PLANE), BOW_SHARES])
    return np.concatenate([LIKELY_BOW * sheet.scale_mm * shares for sheet in sheets])


_UNDETERMINED = FitFailure(
    "the stripes do not determine the light sheets: the fit leaves the plane through the points",
    "spread the boards over more depth, tilt them differently, and check their poses",
)


def _turns_too_far(full: FloatArray, sheets: Sequence[LightSheet]) -> bool:
    tilts_mm = full.reshape(len(sheets), N_SHEET)[:, :2]
    scales_mm = np.array([sheet.scale_mm for sheet in sheets])
    return bool((np.abs(tilts_mm).max(axis=1) > MAX_TILT_STEP * scales_mm).any())


def _linearised(
    observations: SheetObservations,
    sheets: Sequence[LightSheet],
    errors: CommonErrors,
    active: BoolArray,
    precision: FloatArray,
) -> StripeSystem:
    height, residual, by_sheet, by_point = observations.residuals_px(sheets)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.dpoint_dcamera)
    by_camera = by_camera @ errors.camera_root
    by_pose = np.einsum("ni,nij->nj", by_point, observations.dpoint_dpose)
    n_active, n_boards = int(active.sum()), len(errors.pose_roots)
    n_columns = n_active + 6 * n_boards + errors.n_camera
    column = np.cumsum(active) - 1
    stripes = []
    for rows in observations.each_stripe():
        sheet, board = int(observations.sheet[rows[0]]), int(observations.board[rows[0]])
        free = np.flatnonzero(active[N_SHEET * sheet : N_SHEET * (sheet + 1)])
        columns = np.concatenate(
            [
                column[N_SHEET * sheet + free],
                n_active + 6 * board + np.arange(6),
                np.arange(n_columns - errors.n_camera, n_columns),
            ]
        )
        design = [
            by_sheet[rows][:, free],
            by_pose[rows] @ errors.pose_roots[board],
            by_camera[rows],
        ]
        stripes.append(StripeRows(rows, board, columns, np.concatenate(design, axis=1)))
    bows = np.concatenate([np.append(np.zeros(N_PLANE), sheet.bow_mm) for sheet in sheets])
    unknowns = n_active, n_boards, n_columns
    return StripeSystem(tuple(stripes), *unknowns, residual, height, precision, bows[active])


def _joint_covariance(
    normal: NormalSolution, active: BoolArray, errors: CommonErrors
) -> FloatArray:
    """Covariance of the errors of cameras and sheets, the cameras as they were calibrated.

    With the cameras' error ``e_c = L w`` in its own sigmas: sheets of cameras that are held follow
    it, ``e_s = F w + n`` with F from the normal equations and n by stripes and boards. Sheets of
    free cameras err by ``e_s`` with ``cov(e_s, w)`` from the inverse.
    """
    n_sheets, p = len(active), errors.n_camera
    of_sheets, by_camera = normal.covariance, normal.by_cameras
    if normal.follow.shape[1]:
        by_camera = normal.follow
        of_sheets = of_sheets + by_camera @ by_camera.T
    joint = np.zeros((p + n_sheets, p + n_sheets))
    joint[:p, :p] = errors.camera_covariance
    places = p + np.flatnonzero(active)
    joint[np.ix_(places, places)] = of_sheets
    cross = by_camera @ errors.camera_root.T
    joint[np.ix_(places, np.arange(p))] = cross
    joint[np.ix_(np.arange(p), places)] = cross.T
    return 0.5 * (joint + joint.T)


@dataclass(frozen=True, slots=True, eq=False)
class StripeRows:
    """One stripe's residuals: ``design`` (K, C), px per unit, their derivative by C unknowns.

    ``rows`` (K,) are its points, ``board`` the number of its board, ``columns`` (C,) the unknowns
    that move it: of its sheet, of its board, of the cameras, in this order.
    """

    rows: IntArray
    board: int
    columns: IntArray
    design: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class StripeSystem:
    """All residuals (N,), in the image and in space, with their derivatives stripe by stripe.

    Of the ``n_columns`` unknowns the ``n_sheet`` free parameters of all sheets come first, then six
    for each of ``n_boards`` boards. ``precision`` (n_sheet,) is that with which the sheets' bows
    are known to be 0 beforehand, 0 for those of which nothing is, ``bow_mm`` (n_sheet,) what they
    are; both are 0 for other parameters.
    """

    stripes: tuple[StripeRows, ...]
    n_sheet: int
    n_boards: int
    n_columns: int
    residual_px: FloatArray
    height_mm: FloatArray
    precision: FloatArray
    bow_mm: FloatArray

    def times(self, unknowns: FloatArray) -> FloatArray:
        """(N,) change of the residuals."""
        change = np.zeros(len(self.residual_px))
        for stripe in self.stripes:
            change[stripe.rows] = stripe.design @ unknowns[stripe.columns]
        return change

    def solve(
        self,
        weight: FloatArray,
        n_held: int,
        without_board: int = -1,
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
        full = np.diag((np.arange(len(shared)) >= n_sheet).astype(np.float64))
        full[np.arange(n_sheet), np.arange(n_sheet)] = self.precision
        cross, board = np.zeros((n_boards, len(shared), 6)), np.tile(np.eye(6), (n_boards, 1, 1))
        pull = np.zeros(self.n_columns)
        pull[:n_sheet] = self.precision * self.bow_mm
        for stripe in self.stripes:
            if stripe.board == without_board:
                continue
            weighted = stripe.design * weight[stripe.rows, None]
            block = weighted.T @ stripe.design
            is_shared = place[stripe.columns] >= 0
            to = place[stripe.columns[is_shared]]
            full[np.ix_(to, to)] += block[np.ix_(is_shared, is_shared)]
            cross[stripe.board, to] += block[np.ix_(is_shared, ~is_shared)]
            board[stripe.board] += block[np.ix_(~is_shared, ~is_shared)]
            pull[stripe.columns] += weighted.T @ self.residual_px[stripe.rows]
        if not all(np.isfinite(part).all() for part in (full, cross, board)):
            return None
        # Boards do not meet each other: each is eliminated by itself.
        board = np.asarray(np.linalg.inv(board), dtype=np.float64)
        carried = cross @ board
        reduced = full - np.einsum("bik,bjk->ij", carried, cross)
        boards_pull = pull[n_sheet : n_sheet + 6 * n_boards].reshape(n_boards, 6)
        shared_pull = pull[shared] - np.einsum("bik,bk->i", carried, boards_pull)
        n_kept = len(shared) - n_held
        inverse = _inverse(reduced[:n_kept, :n_kept], full[:n_kept, :n_kept])
        if inverse is None:
            return None
        found = np.concatenate([-inverse @ shared_pull[:n_kept], np.zeros(n_held)])
        boards = -np.einsum("bkl,bl->bk", board, boards_pull)
        boards -= np.einsum("bik,i->bk", carried, found)
        to_boards = -np.einsum("si,bik->sbk", inverse[:n_sheet], carried[:, :n_kept])
        return NormalSolution(
            step=np.concatenate([found[:n_sheet], boards.ravel(), found[n_sheet:]]),
            gain=np.concatenate(
                [
                    inverse[:n_sheet, :n_sheet],
                    to_boards.reshape(n_sheet, 6 * n_boards),
                    inverse[:n_sheet, n_sheet:],
                ],
                axis=1,
            ),
            follow=np.asarray(-inverse[:n_sheet] @ reduced[:n_kept, n_kept:]),
            n_board=6 * n_boards,
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
    values, vectors = eigen(matrix * np.outer(scale, scale))
    if not values[0] > MIN_EIGENVALUE:
        return None
    return np.asarray(np.outer(scale, scale) * ((vectors / values) @ vectors.T))


@dataclass(frozen=True, slots=True, eq=False)
class NormalSolution:
    """Solution of the normal equations of U unknowns that are free and some that are held.

    ``step`` (n_columns,) is zero for those that are held. ``gain`` (S, U) are the rows of the
    inverse that belong to the S parameters of the sheets, which come first: their covariance with
    all that is free; their step is minus this times the design's weighted transpose times the
    residuals. ``follow`` (S, n_held) is how they follow the unknowns that are held; the ``n_board``
    unknowns of all boards come next.
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
