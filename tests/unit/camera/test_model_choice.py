# SPDX-License-Identifier: Apache-2.0
"""The rule that chooses the distortion model, on solutions that are only names."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import cast

import pytest

from armscan.calibration.cameras.calibrate import MODELS, ChosenModel, choose_model
from armscan.calibration.cameras.result import CrossValidation, DistortionModel
from armscan.calibration.cameras.robust import Solution
from armscan.geometry.estimate import FitFailure


def name_of(solution: Solution) -> DistortionModel:
    return cast(SimpleNamespace, solution).model


def chosen(
    held_out_px: Mapping[DistortionModel, float],
    folding: tuple[DistortionModel, ...] = (),
) -> ChosenModel | FitFailure:
    """The choice when models have these hold-out errors; those not named have no solution."""

    def solve(model: DistortionModel) -> Solution | FitFailure:
        if model in held_out_px:
            return cast(Solution, SimpleNamespace(model=model))
        return FitFailure(f"{model} is not determined")

    def validate(solution: Solution, _reference: Solution) -> CrossValidation | None:
        rms = held_out_px[name_of(solution)]
        return CrossValidation(5, rms, 0.1, (), ()) if rms > 0.0 else None

    return choose_model(solve, validate, lambda solution: name_of(solution) in folding)


ALIKE: dict[DistortionModel, float] = dict.fromkeys(MODELS, 0.2)


@pytest.mark.parametrize(
    ("held_out_px", "folding", "model", "reason"),
    [
        (ALIKE, (), "k1k2p1p2k3", "all five"),
        ({**ALIKE, "k1k2p1p2k3": 0.2019}, (), "k1k2p1p2k3", "all five"),
        ({**ALIKE, "k1k2p1p2k3": 0.2100}, (), "k1k2p1p2", "5.0 % worse"),
        (ALIKE, ("k1k2p1p2k3",), "k1k2p1p2", "k1k2p1p2k3 folds over"),
        ({**ALIKE, "k1k2p1p2k3": 0.199}, ("k1k2p1p2k3",), "k1k2p1p2k3", "all five"),
        (ALIKE, MODELS, "k1k2p1p2k3", "all five"),
        ({**ALIKE, "k1k2": 0.15, "k1": 0.1}, (), "k1", "k1k2 predicts unseen views 50.0 % worse"),
        (dict.fromkeys(MODELS, 0.0), (), "k1k2", "test: k1k2 without"),
        ({"k1": 0.0}, (), "k1", "test: k1 without"),
    ],
)
def test_the_largest_model_that_predicts_as_well_and_does_not_fold(
    held_out_px: Mapping[DistortionModel, float],
    folding: tuple[DistortionModel, ...],
    model: DistortionModel,
    reason: str,
) -> None:
    found = chosen(held_out_px, folding)
    assert isinstance(found, ChosenModel)
    assert found.model == model
    assert reason in found.reason


def test_without_any_solution_the_last_failure_is_told() -> None:
    found = chosen({})
    assert isinstance(found, FitFailure)
    assert found.reason == "k1 is not determined"


def test_models_are_compared_on_the_points_of_the_largest() -> None:
    """On its own points the smaller model looks better by 10 %, on the larger one's as good."""

    def validate(solution: Solution, reference: Solution) -> CrossValidation | None:
        is_own = name_of(reference) != "k1k2p1p2k3"
        return CrossValidation(5, 0.18 if is_own else 0.2, 0.1, (), ())

    found = choose_model(
        lambda model: cast(Solution, SimpleNamespace(model=model)),
        validate,
        lambda _solution: False,
    )
    assert isinstance(found, ChosenModel)
    assert found.model == "k1k2p1p2k3"
