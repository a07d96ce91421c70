# SPDX-License-Identifier: Apache-2.0
"""Which distortion model the views support: tests of nested models, and the error on views that
took no part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.cameras.adjustment import Observations, State, adjust
from armscan.calibration.cameras.result import MIN_VIEWS, CrossValidation, DistortionModel
from armscan.calibration.cameras.robust import Solution, residuals_px
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
        observations.board_warp_shape[rows],
        (0, *(int(n) for n in np.cumsum(counts))),
        observations.width_px,
        observations.height_px,
    )
    return part, weights[rows]


def _of_views(state: State, views: IntArray) -> State:
    return State(state.shared, state.rotations[views], state.translations_mm[views])


TOLERATED = 1.01
MODELS: tuple[DistortionModel, ...] = ("k1k2p1p2k3", "k1k2p1p2", "k1k2", "k1")
"""Largest first."""

UNTESTED_MODEL: DistortionModel = "k1k2"


@dataclass(frozen=True, slots=True, eq=False)
class ChosenModel:
    """A distortion model with its solution and hold-out test.

    Parameters
    ----------
    model
        The model.
    solution
        Its solution.
    cross_validation
        Its hold-out test, None where there was none.
    reason
        Why this model, in words.
    """

    model: DistortionModel
    solution: Solution
    cross_validation: CrossValidation | None
    reason: str


def choose_model(
    solve: Callable[[DistortionModel], Solution | FitFailure],
    validate: Callable[[Solution, Solution], CrossValidation | None],
    folds: Callable[[Solution], bool],
) -> ChosenModel | FitFailure:
    """Apply the rule of this module.

    Parameters
    ----------
    solve
        Solves with a given model.
    validate
        Tests a solution on held-out views, on the points that the second solution kept.
    folds
        Whether a solution's distortion folds over inside the image.
    """
    tried: list[ChosenModel] = []
    for model in MODELS:
        solution = solve(model)
        if isinstance(solution, FitFailure):
            if model == MODELS[-1] and not tried:
                return solution
            continue
        reference = tried[0].solution if tried else solution
        tried.append(ChosenModel(model, solution, validate(solution, reference), ""))
    tested = [(c, c.cross_validation.rms_px) for c in tried if c.cross_validation is not None]
    if not tested:
        names = [chosen.model for chosen in tried]
        chosen = tried[names.index(UNTESTED_MODEL)] if UNTESTED_MODEL in names else tried[0]
        reason = f"too few views for a hold-out test: {chosen.model} without one"
        return _with_reason(chosen, reason)
    best = min(rms for _, rms in tested)
    good = [(chosen, rms) for chosen, rms in tested if rms <= TOLERATED * best]
    chosen, rms = good[0]
    if folds(chosen.solution):
        yielding = [(c, r) for c, r in good[1:] if r <= rms and not folds(c.solution)]
        chosen, rms = (yielding or good)[0]
    reason = _reason(chosen.model, rms, tested, good)
    if chosen is tried[0]:
        return _with_reason(chosen, reason)
    on_own_points = validate(chosen.solution, chosen.solution)
    return ChosenModel(chosen.model, chosen.solution, on_own_points, reason)


def _reason(
    model: DistortionModel,
    rms: float,
    tested: Sequence[tuple[ChosenModel, float]],
    good: Sequence[tuple[ChosenModel, float]],
) -> str:
    if model == MODELS[0]:
        return (
            "all five coefficients: no smaller model predicts unseen views better by more than 1 %"
        )
    if model != good[0][0].model:
        return (
            f"{good[0][0].model} folds over inside the image, and {model} predicts unseen views "
            "as well"
        )
    models = [chosen.model for chosen, _ in tested]
    larger, larger_rms = tested[models.index(model) - 1]
    return (
        f"{larger.model} predicts unseen views {100.0 * (larger_rms / rms - 1.0):.1f} % worse than "
        f"{model}: too few views, or too little of the image covered, for more coefficients"
    )


def _with_reason(chosen: ChosenModel, reason: str) -> ChosenModel:
    return ChosenModel(chosen.model, chosen.solution, chosen.cross_validation, reason)
