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
