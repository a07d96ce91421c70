# SPDX-License-Identifier: Apache-2.0
"""How well two calibrated cameras predict pairs that they have not seen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from armscan.calibration.camera.cross_validation import rms, subset
from armscan.calibration.camera.result import CrossValidation
from armscan.calibration.stereo.joint import (
    N_SHARED,
    JointObservations,
    JointProblem,
    StereoState,
    adjust_both,
)
from armscan.calibration.stereo.options import MIN_PAIRS
from armscan.calibration.stereo.solve import JointSolution, PointWeights, both_residuals_px
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

NO_SHARED = np.zeros((N_SHARED, 0))


def hold_out_pairs(solution: JointSolution, n_folds: int, max_steps: int) -> CrossValidation | None:
    """Hold out pairs fold by fold.

    Each fold's pairs are left out, cameras and relative pose are solved from the rest, and each
    held-out pair gets one board pose, fitted in both images. Views of one camera alone are never
    held out, and outliers count nowhere.

    Parameters
    ----------
    solution
        Of all pairs; it also is the folds' starting value.
    n_folds
        Wanted folds; at most one a pair.
    max_steps
        Most iterations of each adjustment.

    Returns
    -------
    result
        None if too few pairs would be left to solve from, or if a fold has no solution.
    """
    boards = solution.boards
    both = np.array([k for k, board in enumerate(boards) if board.is_seen_by_both], dtype=np.int64)
    folds = min(n_folds, len(both))
    if folds < 2 or len(both) - int(np.ceil(len(both) / folds)) < MIN_PAIRS:
        return None
    every = np.arange(len(boards))
    predicted: list[tuple[IntArray, FloatArray]] = []
    for fold in range(folds):
        test = both[np.arange(len(both)) % folds == fold]
        part = _held_out_residuals(solution, np.setdiff1d(every, test), test, max_steps)
        if part is None:
            return None
        predicted += [(test[k : k + 1], residuals) for k, residuals in enumerate(part)]
    in_sample = _per_board(
        solution.residuals_px(), solution.observations, solution.weights, both.tolist()
    )
    ordered = {int(board[0]): residuals for board, residuals in predicted}
    return CrossValidation(
        folds,
        rms(np.concatenate([ordered[int(k)] for k in both])),
        rms(np.concatenate(in_sample)),
        tuple(boards[k].name for k in both),
        tuple(rms(ordered[int(k)]) for k in both),
    )


def _held_out_residuals(
    solution: JointSolution, train: IntArray, test: IntArray, max_steps: int
) -> list[FloatArray] | None:
    """Residuals in both images of each board held out."""
    training = _subset(solution, train)
    trained = adjust_both(training, _of_boards(solution.state, train), max_steps)
    if isinstance(trained, FitFailure):
        return None
    start = _of_boards(solution.state, test)
    start = StereoState(
        trained.state.intrinsics,
        trained.state.right_from_left,
        start.rotations,
        start.translations_mm,
    )
    testing = replace(_subset(solution, test), basis=NO_SHARED, prior=None)
    posed = adjust_both(testing, start, max_steps)
    if isinstance(posed, FitFailure):
        return None
    residuals = both_residuals_px(testing.observations, posed.state)
    return _per_board(residuals, testing.observations, testing.weights, range(len(test)))


def _per_board(
    residuals: tuple[FloatArray, FloatArray],
    observations: JointObservations,
    weights: PointWeights,
    boards: Iterable[int],
) -> list[FloatArray]:
    """(K, 2) residuals of the points kept, left and right, of each board."""
    return [
        np.concatenate(
            [
                values[seen.rows(board)][weight[seen.rows(board)] > 0.0]
                for values, seen, weight in zip(
                    residuals, (observations.left, observations.right), weights, strict=True
                )
            ]
        )
        for board in boards
    ]


def _subset(solution: JointSolution, boards: IntArray) -> JointProblem:
    left, left_weights = subset(solution.observations.left, solution.weights[0], boards)
    right, right_weights = subset(solution.observations.right, solution.weights[1], boards)
    return replace(
        solution.problem,
        observations=JointObservations(left, right),
        weights=(left_weights, right_weights),
    )


def _of_boards(state: StereoState, boards: IntArray) -> StereoState:
    return StereoState(
        state.intrinsics,
        state.right_from_left,
        state.rotations[boards],
        state.translations_mm[boards],
    )
