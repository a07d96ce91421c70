# SPDX-License-Identifier: Apache-2.0
"""How well a camera predicts views that it has not seen."""

from __future__ import annotations

import numpy as np

from armscan.calibration.camera.adjustment import adjust
from armscan.calibration.camera.observations import Observations, State
from armscan.calibration.camera.options import MIN_VIEWS
from armscan.calibration.camera.result import CrossValidation
from armscan.calibration.camera.robust import Solution, residuals_px
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

NO_SHARED = np.zeros((11, 0))


def cross_validate(
    solution: Solution, sources: tuple[str, ...], n_folds: int
) -> CrossValidation | None:
    """Hold out views fold by fold (see `CrossValidation`).

    Points that the full solution rejected as outliers count neither in the folds' solutions nor
    in the result.

    Parameters
    ----------
    solution
        Of all used views; it also is the folds' starting value.
    sources
        Names of the views.
    n_folds
        Wanted folds; at most one a view.

    Returns
    -------
    result
        None if fewer than three views would be left to solve from, or if a fold has no solution.
    """
    observations = solution.observations
    n_views = observations.n_views
    folds = min(n_folds, n_views)
    if folds < 2 or n_views - int(np.ceil(n_views / folds)) < MIN_VIEWS:
        return None
    fold_of_view = np.arange(n_views) % folds
    held_out = np.zeros_like(observations.points_px)
    for fold in range(folds):
        train, test = np.flatnonzero(fold_of_view != fold), np.flatnonzero(fold_of_view == fold)
        part, weights = subset(observations, solution.weights, train)
        trained = adjust(part, _of_views(solution.state, train), solution.basis, weights)
        if isinstance(trained, FitFailure):
            return None
        part, weights = subset(observations, solution.weights, test)
        start = _of_views(solution.state, test)
        start = State(trained.state.shared, start.rotations, start.translations_mm)
        posed = adjust(part, start, NO_SHARED, weights)
        if isinstance(posed, FitFailure):
            return None
        rows = np.isin(observations.view_of_point, test)
        held_out[rows] = residuals_px(part, posed.state)
    in_sample = residuals_px(observations, solution.state)
    kept = solution.weights > 0.0
    per_view = []
    for v in range(n_views):
        rows_of_view = observations.rows(v)
        per_view.append(rms(held_out[rows_of_view][kept[rows_of_view]]))
    return CrossValidation(
        folds, rms(held_out[kept]), rms(in_sample[kept]), sources, tuple(per_view)
    )


def rms(residuals: FloatArray) -> float:
    """Root mean square over (N, 2) residuals of their length, as OpenCV defines it."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def subset(
    observations: Observations, weights: FloatArray, views: IntArray
) -> tuple[Observations, FloatArray]:
    """The observations of some views, in order, with their weights."""
    rows = np.isin(observations.view_of_point, views)
    counts = np.diff(observations.starts)[views]
    part = Observations(
        observations.points_px[rows],
        observations.whitening[rows],
        observations.board_mm[rows],
        observations.bow_shape[rows],
        (0, *(int(n) for n in np.cumsum(counts))),
        observations.width_px,
        observations.height_px,
    )
    return part, weights[rows]


def _of_views(state: State, views: IntArray) -> State:
    return State(state.shared, state.rotations[views], state.translations_mm[views])
