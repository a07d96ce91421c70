# SPDX-License-Identifier: Apache-2.0
"""Points that the stored calibration makes of its own stripes, against the boards they lay on.

A camera and a sheet may each look right and not belong together; what counts is the points that
they make. The stripes are reconstructed as any later stripe is: the pixel's ray meets the sheet.
The distance of these points from the boards' planes has a claimed standard deviation, that of the
difference of two things that share the cameras, and, where the board took part in the fit, its
errors. Each board is also left out: its points then rest on the other boards alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.sheets.board_points import HeadCameras, intersect_sheet_of
from armscan.calibration.sheets.result import BoardDistances, BoardPointCheck, SheetPointCheck
from armscan.calibration.sheets.solve import (
    N_SHEET,
    NormalSolution,
    SheetObservations,
    SheetSolution,
    StripeRows,
)
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.models.light_sheet import LightSheet

FEWEST_OTHERS = 2
"""Boards that must remain when one is left out: the stripe of one alone is a line."""


def check_points(
    observations: SheetObservations,
    solution: SheetSolution,
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
    case = _Case(observations, solution, noise_px, images, cameras)
    fitted = _Claim(case, solution.normal, is_in_fit=True)
    distance = case.distance_mm(solution.sheets)
    left_out = {int(board): case.without(int(board)) for board in np.unique(observations.board)}
    checks = []
    for k in range(len(solution.sheets)):
        of_sheet = observations.sheet == k
        boards = []
        numbers = np.unique(observations.board[of_sheet])
        for board in numbers:
            rows = of_sheet & (observations.board == board)
            others = left_out[int(board)] if len(numbers) > FEWEST_OTHERS else None
            alone = None
            if others is not None:
                alone = others[1].distances(rows, case.distance_mm(others[0], rows))
            source = images[int(observations.image[rows][0])].data.profile.source
            depth_mm = float(observations.points_mm[rows, 2].mean())
            boards.append(
                BoardPointCheck(source, depth_mm, fitted.distances(rows, distance), alone)
            )
        rms, claimed = (
            _pooled(
                [(b.left_out.n_points, getattr(b.left_out, name)) for b in boards if b.left_out]
            )
            for name in ("rms_mm", "claimed_rms_mm")
        )
        whole = fitted.distances(of_sheet, distance)
        checks.append(SheetPointCheck(whole, rms, claimed, tuple(boards)))
    return tuple(checks)


def _pooled(parts: Sequence[tuple[int, float]]) -> float:
    """Root mean square of all points from (count, root mean square) of parts; NaN for none."""
    count = sum(n for n, _ in parts)
    return float(np.sqrt(sum(n * rms**2 for n, rms in parts) / count)) if count else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """The points used and the solution, as `check_points` has them."""

    observations: SheetObservations
    solution: SheetSolution
    noise_px: FloatArray
    images: Sequence[BoardImage]
    cameras: HeadCameras

    def distance_mm(
        self, sheets: Sequence[LightSheet], rows: BoolArray | None = None
    ) -> FloatArray:
        """(N,) distance from their boards of points made with the sheets.

        NaN where there is none, and for points that are not asked for.
        """
        found = np.full(len(self.observations), np.nan)
        for of in self.observations.each_stripe():
            if rows is not None and not (of & rows).any():
                continue
            image, k = self._stripe(of)
            q = image.data.profile.points_px[self.observations.row[of]]
            points, is_met = intersect_sheet_of(q, image.data.camera, sheets[k], self.cameras)
            pose = image.placed.sensor_from_board
            distance = (points - pose.translation_mm) @ pose.rotation[:, 2]
            found[of] = np.where(is_met, distance, np.nan)
        return found

    def mm_per_px(self) -> FloatArray:
        """(N,) change of that distance for one pixel of residual.

        A point of the board that lies ``h`` above the sheet slides along its ray by ``-h / (g.d)``,
        with the sheet's gradient g and the ray's direction d.
        """
        found = np.zeros(len(self.observations))
        for of in self.observations.each_stripe():
            image, k = self._stripe(of)
            points = self.observations.points_mm[of]
            _, gradient, _ = self.solution.sheets[k].height_with_jacobian(points)
            ray = points - self.cameras.centre_mm(image.data.camera)
            normal = image.placed.sensor_from_board.rotation[:, 2]
            per_px = np.einsum("ni,ni->n", gradient, self.observations.across_mm_px[of])
            found[of] = -(ray @ normal) / np.einsum("ni,ni->n", gradient, ray) * per_px
        return found

    def _stripe(self, of: BoolArray) -> tuple[BoardImage, int]:
        first = int(np.argmax(of))
        image = self.images[int(self.observations.image[first])]
        return image, int(self.observations.sheet[first])

    def without(self, board: int) -> tuple[list[LightSheet], _Claim] | None:
        """Sheets of all boards but one, by one step from those of all; None if not determined."""
        solution = self.solution
        n_held = solution.normal.follow.shape[1]
        normal = solution.system.solve(solution.weight, n_held, without_board=board)
        if normal is None:
            return None
        step = np.zeros(len(solution.active))
        step[solution.active] = normal.step[: normal.n_sheet]
        sheets = [
            sheet.updated(step[N_SHEET * k : N_SHEET * (k + 1)])
            for k, sheet in enumerate(solution.sheets)
        ]
        return sheets, _Claim(self, normal, is_in_fit=False)


class _Claim:
    """What the normal equations claim of residuals that no board was moved for.

    A residual is ``r = B w_b + C w_c + e + A e_s``: errors of boards and cameras in their own
    sigmas, the stripe's noise, and the sheets' error, ``e_s = F w_c + K w_b - G e`` where the board
    took part in the fit.
    """

    def __init__(self, case: _Case, normal: NormalSolution, *, is_in_fit: bool) -> None:
        self._case, self._normal, self._is_in_fit = case, normal, is_in_fit
        self._mm_per_px = case.mm_per_px()

    def distances(self, rows: BoolArray, distance_mm: FloatArray) -> BoardDistances:
        """Figures of the points ``rows`` (N,), with the claims for them."""
        rows = rows & np.isfinite(distance_mm)
        n = int(rows.sum())
        per_px = self._mm_per_px
        variance = np.where(rows, per_px**2 * self._point_variances(rows), 0.0)
        return BoardDistances(
            n,
            float(distance_mm[rows].mean()),
            float(np.sqrt(self._variance_of_sum(np.where(rows, per_px / n, 0.0)))),
            float(np.sqrt((distance_mm[rows] ** 2).mean())),
            float(np.sqrt(variance.sum() / n)),
        )

    def _variance_of_sum(self, factor: FloatArray) -> float:
        """Variance of ``factor @ r``, points counting with the noise of the weights."""
        normal, n_sheet = self._normal, self._normal.n_sheet
        solution = self._case.solution
        pull = solution.system.transposed(factor)
        by_sheet, by_board = pull[:n_sheet], pull[n_sheet : normal.n_free]
        by_camera = pull[normal.n_free :] + normal.follow.T @ by_sheet
        total = float((factor**2 / solution.weight).sum() + by_camera @ by_camera)
        if not self._is_in_fit:
            return total + float(by_board @ by_board + by_sheet @ normal.covariance @ by_sheet)
        by_board = by_board + normal.by_boards.T @ by_sheet
        fitted = by_sheet @ (
            normal.by_stripes @ by_sheet - 2.0 * normal.gain @ pull[: normal.n_free]
        )
        return max(total + float(by_board @ by_board + fitted), 0.0)

    def _point_variances(self, rows: BoolArray) -> FloatArray:
        """(N,) variance of single residuals; zero for stripes of which no point is asked for."""
        found = np.zeros(len(rows))
        for stripe in self._case.solution.system.stripes:
            if rows[stripe.rows].any():
                found[stripe.rows] = self._stripe_variances(stripe)
        return found

    def _stripe_variances(self, stripe: StripeRows) -> FloatArray:
        normal = self._normal
        is_sheet = stripe.columns < normal.n_sheet
        is_free = stripe.columns < normal.n_free
        of_sheet = stripe.columns[is_sheet]
        by_sheet = stripe.design[:, is_sheet]
        by_board = stripe.design[:, is_free & ~is_sheet]
        by_camera = stripe.design[:, ~is_free] + by_sheet @ normal.follow[of_sheet]
        total = self._case.noise_px[stripe.rows] ** 2 + (by_camera**2).sum(axis=1)
        if not self._is_in_fit:
            sheet = normal.covariance[np.ix_(of_sheet, of_sheet)]
            return np.asarray(
                total + (by_board**2).sum(axis=1) + ((by_sheet @ sheet) * by_sheet).sum(axis=1)
            )
        moved = by_sheet @ normal.by_boards[of_sheet]
        moved[:, stripe.columns[is_free & ~is_sheet] - normal.n_sheet] += by_board
        stripes = by_sheet @ normal.by_stripes[np.ix_(of_sheet, of_sheet)]
        gain = normal.gain[np.ix_(of_sheet, stripe.columns[is_free])]
        lever = stripe.design[:, is_free] @ gain.T
        total = total + (moved**2).sum(axis=1) + ((stripes - 2.0 * lever) * by_sheet).sum(axis=1)
        return np.asarray(np.maximum(total, 0.0))
