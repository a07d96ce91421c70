# SPDX-License-Identifier: Apache-2.0
"""Which distortion coefficients are free.

The rule of ``auto``: the largest model whose hold-out error is within 1 % of the best model's.
Where the views cover the image that is all five coefficients, as OpenCV: one that is held at zero
without being zero makes the covariance too small, and a free one that is near zero costs little.
With few views, or an empty rim of the image, a large model bends to the noise and predicts unseen
views worse: then coefficients are held at zero, k3 first, then p1 and p2, then k2. Where too few
views are left for a hold-out test, only k1 and k2 are free. Among the models within 1 %, one that
folds over inside the image (high powers run away where no target was seen) yields to one that does
not and whose hold-out error is no larger: a coefficient that the views show is not given up.

All models are compared on the points that the largest one kept. A model too small for the lens
takes the points that show it, those far out, for outliers; on its own points it would predict well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from armscan.calibration.camera.options import DistortionModel
from armscan.calibration.camera.result import CrossValidation
from armscan.calibration.camera.robust import Solution
from armscan.geometry.estimate import FitFailure

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
