# SPDX-License-Identifier: Apache-2.0
"""Points that the stored calibration makes of its own stripes, against the boards they lay on.

A camera and a sheet may each look right and not belong together; what counts is the points that
they make. The stripes are reconstructed as any later stripe is: the pixel's ray meets the sheet.
The distance of these points from the boards' planes has a claimed standard deviation, that of the
difference of two things that share the cameras, and, where the board took part in the fit, its
errors. Each board is also left out: its points then rest on the other boards alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.normal_equations import NormalSolution, StripeRows
from armscan.calibration.laser.observations import SheetObservations
from armscan.calibration.laser.result import (
    BoardDistances,
    BoardPointCheck,
    SheetPointCheck,
)
from armscan.calibration.laser.second_view import meet_sheet_of
from armscan.calibration.laser.sightings import BoardImage
from armscan.calibration.laser.solve import N_SHEET, LinearSolution, SheetSolution
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.models.light_sheet import LightSheet

FEWEST_OTHERS = 2
"""Boards that must remain when one is left out: the stripe of one alone is a line."""


def check_points(
    observations: SheetObservations,
    solution: SheetSolution,
    *,
    noise_px: FloatArray,
    images: Sequence[BoardImage],
    cameras: HeadCameras,
) -> tuple[SheetPointCheck, ...]:
    """Reconstruct the stripes with the solution and compare them with their boards.

    Parameters
    ----------
    observations
        The points used.
    solution
        Sheets that belong to the cameras as calibrated.
    noise_px
        (N,) scatter of single points; the weights hold the larger one with which they count as
        independent.
    images, cameras
        As the fit had them.
    """
    linear = solution.linear
    made = _Made(observations, images, cameras)
    claim = _Claim(linear, linear.normal, noise_px, is_in_fit=True)
    distance = made.distance_mm(solution.sheets)
    slope = made.slope_mm_px(solution.sheets)
    left_out = {
        int(board): _without(int(board), solution, noise_px)
        for board in np.unique(observations.board)
    }
    checks = []
    for k in range(len(solution.sheets)):
        of_sheet = observations.sheet == k
        boards = []
        numbers = np.unique(observations.board[of_sheet])
        for board in numbers:
            rows = of_sheet & (observations.board == board)
            others = left_out[int(board)] if len(numbers) > FEWEST_OTHERS else None
            first = int(observations.image[rows][0])
            boards.append(
                BoardPointCheck(
                    images[first].data.profile.source,
                    float(observations.points_mm[rows, 2].mean()),
                    claim.describe(rows, distance, slope),
                    None
                    if others is None
                    else others[1].describe(rows, made.distance_mm(others[0], rows), slope),
                )
            )
        checks.append(_sheet_check(claim.describe(of_sheet, distance, slope), boards))
    return tuple(checks)


def _sheet_check(fitted: BoardDistances, boards: Sequence[BoardPointCheck]) -> SheetPointCheck:
    alone = [board.left_out for board in boards if board.left_out is not None]
    count = sum(board.n_points for board in alone)
    if count == 0:
        return SheetPointCheck(fitted, float("nan"), float("nan"), tuple(boards))
    squares = sum(board.n_points * board.rms_mm**2 for board in alone)
    claimed = sum(board.n_points * board.claimed_rms_mm**2 for board in alone)
    return SheetPointCheck(
        fitted, float(np.sqrt(squares / count)), float(np.sqrt(claimed / count)), tuple(boards)
    )


def _without(
    board: int, solution: SheetSolution, noise_px: FloatArray
) -> tuple[tuple[LightSheet, ...], _Claim] | None:
    """Sheets of all boards but one, by one step from those of all; None if not determined."""
    linear = solution.linear
    n_held = linear.normal.follow.shape[1]
    normal = linear.system.solve(linear.weight, n_held, without_board=board)
    if normal is None:
        return None
    step = np.zeros(len(linear.active))
    step[linear.active] = normal.step[: normal.n_sheet]
    sheets = tuple(
        sheet.updated(step[N_SHEET * k : N_SHEET * (k + 1)])
        for k, sheet in enumerate(solution.sheets)
    )
    return sheets, _Claim(linear, normal, noise_px, is_in_fit=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Made:
    """Points as the stored calibration makes them, N in all."""

    observations: SheetObservations
    images: Sequence[BoardImage]
    cameras: HeadCameras

    def distance_mm(
        self, sheets: Sequence[LightSheet], rows: BoolArray | None = None
    ) -> FloatArray:
        """(N,) distance of the points from their boards; NaN for those that are not asked for."""
        found = np.full(len(self.observations), np.nan)
        for i, k, own in self._groups(rows):
            image = self.images[i]
            q = image.data.profile.points_px[self.observations.row[own]]
            points, is_met = meet_sheet_of(q, image.data.camera, sheets[k], self.cameras)
            pose = image.placed.sensor_from_board
            distance = (points - pose.translation_mm) @ pose.rotation[:, 2]
            found[own] = np.where(is_met, distance, np.nan)
        return found

    def slope_mm_px(self, sheets: Sequence[LightSheet]) -> FloatArray:
        """(N,) change of that distance for one pixel of residual.

        A point of the board that lies ``h`` above the sheet slides along its ray by ``-h / (g.d)``,
        with the sheet's gradient g and the ray's direction d.
        """
        found = np.zeros(len(self.observations))
        for i, k, own in self._groups(None):
            image, points = self.images[i], self.observations.points_mm[own]
            _, gradient, _ = sheets[k].height_with_jacobian(points)
            ray = points - self.cameras.centre_mm(image.data.camera)
            normal = image.placed.sensor_from_board.rotation[:, 2]
            per_px = np.einsum("ni,ni->n", gradient, self.observations.across_mm_px[own])
            found[own] = -(ray @ normal) / np.einsum("ni,ni->n", gradient, ray) * per_px
        return found

    def _groups(self, rows: BoolArray | None) -> Iterator[tuple[int, int, BoolArray]]:
        """Image, sheet and points (N,) of each stripe."""
        observations = self.observations
        asked = np.ones(len(observations), dtype=np.bool_) if rows is None else rows
        for stripe in np.unique(observations.stripe[asked]):
            own = observations.stripe == stripe
            first = int(np.argmax(own))
            yield int(observations.image[first]), int(observations.sheet[first]), own


@dataclass(frozen=True, slots=True, eq=False)
class _Claim:
    """What the normal equations claim of residuals that no board was moved for.

    A residual is ``r = B w_b + C w_c + e + A e_s``: errors of boards and cameras in their own
    sigmas, the stripe's noise, and the sheets' error, ``e_s = F w_c + K w_b - G e`` where the board
    took part in the fit.
    """

    linear: LinearSolution
    normal: NormalSolution
    noise_px: FloatArray
    is_in_fit: bool

    def describe(self, rows: BoolArray, distance: FloatArray, slope: FloatArray) -> BoardDistances:
        """Figures of the points ``rows`` (N,), with the claims for them."""
        rows = rows & np.isfinite(distance)
        n = int(rows.sum())
        variance = np.where(rows, slope**2 * self.point_variances(rows), 0.0)
        return BoardDistances(
            n,
            float(distance[rows].mean()),
            float(np.sqrt(self.variance_of_sum(np.where(rows, slope / n, 0.0)))),
            float(np.sqrt((distance[rows] ** 2).mean())),
            float(np.sqrt(variance.sum() / n)),
        )

    def variance_of_sum(self, factor: FloatArray) -> float:
        """Variance of ``factor @ r``, points counting with the noise of the weights."""
        normal, n_sheet = self.normal, self.normal.n_sheet
        pull = self.linear.system.transposed(factor)
        by_sheet, by_board = pull[:n_sheet], pull[n_sheet : normal.n_free]
        by_camera = pull[normal.n_free :] + normal.follow.T @ by_sheet
        total = float((factor**2 / self.linear.weight).sum() + by_camera @ by_camera)
        if not self.is_in_fit:
            own = normal.covariance
            return total + float(by_board @ by_board + by_sheet @ own @ by_sheet)
        by_board = by_board + normal.by_boards.T @ by_sheet
        fitted = by_sheet @ (
            normal.by_stripes @ by_sheet - 2.0 * normal.gain @ pull[: normal.n_free]
        )
        return max(total + float(by_board @ by_board + fitted), 0.0)

    def point_variances(self, rows: BoolArray) -> FloatArray:
        """(N,) variance of single residuals; zero for stripes of which no point is asked for."""
        found = np.zeros(len(rows))
        for stripe in self.linear.system.stripes:
            if rows[stripe.rows].any():
                found[stripe.rows] = self._stripe_variances(stripe)
        return found

    def _stripe_variances(self, stripe: StripeRows) -> FloatArray:
        normal = self.normal
        is_sheet = stripe.columns < normal.n_sheet
        is_free = stripe.columns < normal.n_free
        own = stripe.columns[is_sheet]
        by_sheet = stripe.design[:, is_sheet]
        by_board = stripe.design[:, is_free & ~is_sheet]
        by_camera = stripe.design[:, ~is_free] + by_sheet @ normal.follow[own]
        total = self.noise_px[stripe.rows] ** 2 + (by_camera**2).sum(axis=1)
        if not self.is_in_fit:
            sheet = normal.covariance[np.ix_(own, own)]
            return np.asarray(
                total + (by_board**2).sum(axis=1) + ((by_sheet @ sheet) * by_sheet).sum(axis=1)
            )
        moved = by_sheet @ normal.by_boards[own]
        moved[:, stripe.columns[is_free & ~is_sheet] - normal.n_sheet] += by_board
        stripes = by_sheet @ normal.by_stripes[np.ix_(own, own)]
        lever = stripe.design[:, is_free] @ normal.gain[np.ix_(own, stripe.columns[is_free])].T
        total = total + (moved**2).sum(axis=1) + ((stripes - 2.0 * lever) * by_sheet).sum(axis=1)
        return np.asarray(np.maximum(total, 0.0))
