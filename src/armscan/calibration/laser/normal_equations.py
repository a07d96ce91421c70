# SPDX-License-Identifier: Apache-2.0
"""Normal equations of stripes: sheets' parameters, boards' errors, cameras' errors.

The errors that points have in common are counted in their own sigmas, so that each is known to be
0 +- 1. The cameras' come last and may be held at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray

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
    n_sheet, n_columns
        Free parameters of all sheets, which come first, and count of all unknowns.
    residual_px, height_mm
        (N,) distance of the points from their sheets, in the image and in space.
    """

    stripes: tuple[StripeRows, ...]
    n_sheet: int
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
        n_free = self.n_columns - n_held
        information = np.diag((np.arange(self.n_columns) >= self.n_sheet).astype(np.float64))
        pull = np.zeros(self.n_columns)
        for stripe in self.stripes:
            if stripe.board == without_board:
                continue
            weighted = stripe.design * weight[stripe.rows, None]
            information[np.ix_(stripe.columns, stripe.columns)] += weighted.T @ stripe.design
            pull[stripe.columns] += weighted.T @ self.residual_px[stripe.rows]
        held = information[:n_free, n_free:]
        information = information[:n_free, :n_free]
        diagonal = np.diag(information)
        if not np.isfinite(information).all() or not (diagonal > 0.0).all():
            return None
        scale = 1.0 / np.sqrt(diagonal)
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        if not values[0] > MIN_EIGENVALUE:
            return None
        inverse = np.outer(scale, scale) * ((vectors / values) @ vectors.T)
        step = np.concatenate([-inverse @ pull[:n_free], np.zeros(n_held)])
        return NormalSolution(step, inverse, -inverse @ held, self.n_sheet)


@dataclass(frozen=True, slots=True, eq=False)
class NormalSolution:
    """Solution of the normal equations.

    Parameters
    ----------
    step
        (n_columns,) of the unknowns; zero for those that are held.
    inverse
        (U, U) of the normal matrix of the U unknowns that are free: their covariance.
    follow
        (U, n_held) how the step follows the unknowns that are held.
    n_sheet
        Free parameters of the sheets, which come first.
    """

    step: FloatArray
    inverse: FloatArray
    follow: FloatArray
    n_sheet: int

    @property
    def n_free(self) -> int:
        """Count U of free unknowns."""
        return len(self.inverse)

    @property
    def gain(self) -> FloatArray:
        """(S, U): the sheets' step is minus this times the design's weighted transpose times r."""
        return np.asarray(self.inverse[: self.n_sheet])

    @property
    def by_boards(self) -> FloatArray:
        """(S, 6 M) how the sheets' errors follow those of the boards, in sigmas of these."""
        return np.asarray(self.inverse[: self.n_sheet, self.n_sheet :])

    @property
    def by_stripes(self) -> FloatArray:
        """(S, S) covariance of the sheets by the stripes' noise alone."""
        return np.asarray(
            self.inverse[: self.n_sheet, : self.n_sheet] - self.by_boards @ self.by_boards.T
        )
