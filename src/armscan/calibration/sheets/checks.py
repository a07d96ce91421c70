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
from functools import cached_property

import numpy as np

from armscan.calibration.sheets.board_points import HeadCameras, intersect_sheet_of
from armscan.calibration.sheets.result import BoardDistances, BoardPointCheck, SheetPointCheck
from armscan.calibration.sheets.solve import (
    N_SHEET,
    NormalSolution,
    SheetObservations,
    SheetSolution,
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
    """Reconstruct the stripes with a solution of held cameras and compare them with their boards.

    ``noise_px`` (N,) is the scatter of the single points used; the solution's weights hold the
    larger one with which they count as independent.
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


@dataclass(frozen=True, eq=False)
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
            if image.bow is not None:
                distance = distance - image.bow.height_mm(points, pose)
            found[of] = np.where(is_met, distance, np.nan)
        return found

    @cached_property
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

    def distances(self, rows: BoolArray, distance_mm: FloatArray) -> BoardDistances:
        """Figures of the points ``rows`` (N,), with the claims for them."""
        rows = rows & np.isfinite(distance_mm)
        n = int(rows.sum())
        solution, mm_per_px = self._case.solution, self._case.mm_per_px
        # The mean: points count with the noise of the weights.
        share = np.where(rows, mm_per_px / n, 0.0)
        pull = solution.system.transposed(share)[None]
        noise = np.array([(share**2 / solution.weight).sum()])
        variance = np.zeros(len(rows))
        for stripe in solution.system.stripes:
            if rows[stripe.rows].any():
                design = np.zeros((len(stripe.rows), solution.system.n_columns))
                design[:, stripe.columns] = stripe.design
                noise_px2 = self._case.noise_px[stripe.rows] ** 2
                variance[stripe.rows] = self._variances(design, noise_px2)
        return BoardDistances(
            n,
            float(distance_mm[rows].mean()),
            float(np.sqrt(self._variances(pull, noise)[0])),
            float(np.sqrt((distance_mm[rows] ** 2).mean())),
            float(np.sqrt((mm_per_px**2 * variance)[rows].sum() / n)),
        )

    def _variances(self, pull: FloatArray, noise: FloatArray) -> FloatArray:
        """(K,) of sums of residuals with derivatives (K, n_columns) by the unknowns, and noise."""
        normal = self._normal
        by_sheet, by_board = pull[:, : normal.n_sheet], pull[:, normal.n_sheet : normal.n_free]
        by_camera = pull[:, normal.n_free :] + by_sheet @ normal.follow
        covariance, lever = normal.covariance, np.zeros_like(by_sheet)
        if self._is_in_fit:
            covariance, lever = normal.by_stripes, 2.0 * pull[:, : normal.n_free] @ normal.gain.T
            by_board = by_board + by_sheet @ normal.by_boards
        total = noise + (by_camera**2).sum(axis=1) + (by_board**2).sum(axis=1)
        total = total + ((by_sheet @ covariance - lever) * by_sheet).sum(axis=1)
        return np.asarray(np.maximum(total, 0.0))
