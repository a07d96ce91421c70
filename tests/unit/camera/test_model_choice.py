# SPDX-License-Identifier: Apache-2.0
"""The rule that chooses the distortion model, on solutions that are only names, and what it leaves
unsaid about the coefficients that it drops, on random lenses.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.distortion import (
    MODELS,
    ChosenModel,
    choose_model,
    predicts_better,
)
from armscan.calibration.cameras.result import CameraFit, CrossValidation, DistortionModel
from armscan.calibration.cameras.robust import Solution
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import Scene, make_views, normalised_error
from rigs.plain_scanner import plain_camera

VIEWS = 8
RIPPLE = np.array([0.98, 1.01, 1.0, 1.02, 0.99, 1.0, 1.01, 0.99])
"""How the held-out rms differs from view to view."""


def name_of(solution: Solution) -> DistortionModel:
    return cast(SimpleNamespace, solution).model


def chosen(
    held_out_px: Mapping[DistortionModel, float],
    chances: Mapping[DistortionModel, float] | None = None,
    folding: tuple[DistortionModel, ...] = (),
    unsettled: tuple[DistortionModel, ...] = (),
    alike: tuple[DistortionModel, ...] = (),
) -> ChosenModel | FitFailure:
    """The choice when models have these hold-out errors; those not named have no solution.

    ``chances`` of a larger model's further coefficients; significant where not named. ``alike``:
    models that leave residuals which are alike within a view.
    """

    def solve(model: DistortionModel) -> Solution | FitFailure:
        if model in held_out_px:
            named = SimpleNamespace(model=model, is_converged=model not in unsettled)
            return cast(Solution, named)
        return FitFailure(f"{model} is not determined")

    def validate(solution: Solution, _reference: Solution) -> CrossValidation | None:
        rms = held_out_px[name_of(solution)]
        return CrossValidation(5, rms, 0.1, (), tuple(rms * RIPPLE)) if rms > 0.0 else None

    return choose_model(
        solve,
        validate,
        lambda solution: name_of(solution) in folding,
        lambda _smaller, larger, _names: (chances or {}).get(name_of(larger), 0.0),
        lambda solution: name_of(solution) in alike,
    )


BETTER: dict[DistortionModel, float] = dict(zip(MODELS, (0.4, 0.3, 0.25, 0.2), strict=True))
ALIKE: dict[DistortionModel, float] = dict.fromkeys(MODELS, 0.2)


@pytest.mark.parametrize(
    ("found", "model", "reason"),
    [
        (chosen(BETTER), "k1k2p1p2k3", "all five"),
        (chosen(BETTER, {"k1k2p1p2k3": 0.02}), "k1k2p1p2", "k3 not told from zero"),
        (chosen(BETTER, {"k1k2p1p2k3": 0.02, "k1k2p1p2": 0.5}), "k1k2", "p1 p2 not told"),
        (chosen(BETTER, {"k1k2": 0.5}), "k1k2p1p2k3", "all five"),
        (chosen(ALIKE), "k1", "predicted no better with k2"),
        (chosen({**BETTER, "k1k2p1p2k3": 0.26}), "k1k2p1p2", "predicted no better with k3"),
        (chosen(BETTER, unsettled=("k1k2p1p2k3",)), "k1k2p1p2", "k3 not told"),
        (chosen({"k1": 0.4, "k1k2": 0.3}), "k1k2", "no larger model has a solution"),
        (chosen({**ALIKE, "k1": 0.3}, folding=("k1k2",)), "k1k2p1p2", "k1k2 folds over"),
        (chosen({**BETTER}, folding=("k1k2p1p2k3",)), "k1k2p1p2k3", "all five"),
        (chosen(ALIKE, folding=MODELS), "k1", "predicted no better"),
        (chosen(BETTER, {"k1k2p1p2k3": 0.5}, alike=MODELS), "k1k2p1p2k3", "all five"),
        (chosen(ALIKE, dict.fromkeys(MODELS, 0.5), alike=MODELS), "k1", "not told"),
        (chosen(BETTER, {"k1k2p1p2k3": 0.5}, (), ("k1k2p1p2k3",), MODELS), "k1k2p1p2", "k3 not"),
        (chosen(dict.fromkeys(MODELS, 0.0)), "k1k2p1p2k3", "all five"),
        (chosen(dict.fromkeys(MODELS, 0.0), dict.fromkeys(MODELS, 0.3)), "k1", "not told"),
    ],
)
def test_the_smallest_model_beyond_which_the_views_show_nothing(
    found: ChosenModel | FitFailure, model: DistortionModel, reason: str
) -> None:
    assert isinstance(found, ChosenModel)
    assert found.model == model
    assert reason in found.reason


@pytest.mark.parametrize(
    ("larger_px", "is_asked_for"), [(0.19, True), (0.1998, False), (0.21, False)]
)
def test_coefficients_are_given_up_with_a_bow_free_only_if_unseen_views_do(
    larger_px: float, is_asked_for: bool
) -> None:
    """A gain of 0.2 per cent is less than what held-out views scatter by."""
    noise = np.array([0.004, -0.003, 0.002, -0.004, 0.003, -0.002, 0.001, -0.001])
    held_out = {4: 0.2 + np.zeros(VIEWS), 6: larger_px + noise}

    def solution(n_free: int, *, is_converged: bool = True) -> Solution:
        basis = np.eye(9)[:, :n_free]
        return cast(Solution, SimpleNamespace(basis=basis, is_converged=is_converged))

    def validate(each: Solution, _reference: Solution) -> CrossValidation:
        rms = held_out[each.basis.shape[1]]
        return CrossValidation(5, float(np.sqrt(np.mean(rms**2))), 0.1, (), tuple(rms))

    smaller = ChosenModel("k1", solution(4), None, "")
    assert predicts_better(solution(6), smaller, validate) == is_asked_for
    larger = ChosenModel("k1k2", solution(6), None, "")
    assert not predicts_better(solution(6), larger, validate)
    assert not predicts_better(FitFailure("none"), smaller, validate)
    assert not predicts_better(solution(6, is_converged=False), smaller, validate)


def test_without_any_solution_the_first_failure_is_told() -> None:
    found = chosen({})
    assert isinstance(found, FitFailure)
    assert found.reason == "k1 is not determined"


def test_a_gain_that_scatters_more_than_it_is_does_not_count() -> None:
    """One view of eight gains much, the others lose a little: its mean is under its own error."""
    per_view = {"k1": np.full(VIEWS, 0.2), "k1k2": np.array([0.1, *[0.203] * 7])}

    def validate(solution: Solution, _reference: Solution) -> CrossValidation:
        rms = per_view[name_of(solution)]
        return CrossValidation(5, float(np.sqrt(np.mean(rms**2))), 0.1, (), tuple(rms))

    found = choose_model(
        lambda model: (
            cast(Solution, SimpleNamespace(model=model, is_converged=True))
            if model in per_view
            else FitFailure("not asked")
        ),
        validate,
        lambda _solution: False,
        lambda _smaller, _larger, _names: 0.0,
        lambda _solution: False,
    )
    assert isinstance(found, ChosenModel)
    assert found.model == "k1"


def lens(rng: np.random.Generator) -> CameraModel:
    """A lens with all of the usual coefficients."""
    first, second = rng.uniform(-0.1, -0.02), rng.uniform(-0.5, 0.5)
    square = 0.25 * (1280**2 + 1024**2) / 1800.0**2
    return plain_camera(
        (1800.0, 1801.0),
        (650.0, 500.0),
        (1280, 1024),
        np.array([first / square, first * second / square**2, *rng.normal(0.0, 7e-4, 2), 0.0]),
    )


def bent(view: TargetView, rng: np.random.Generator, size_px: float) -> TargetView:
    """Residuals that neighbours share: a cubic error field over the view."""
    p = view.points_px - view.points_px.mean(axis=0)
    u, v = (p / np.abs(p).max(axis=0)).T
    terms = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)
    field = terms @ rng.normal(size=(7, 2))
    return replace(view, points_px=view.points_px + size_px / np.sqrt(np.mean(field**2)) * field)


@pytest.mark.parametrize(("reach", "share", "is_bent"), [(0.03, 0.3, False), (0.28, 0.55, True)])
def test_errors_stay_within_sigma_where_the_board_covers_little_or_views_are_bent(
    *, reach: float, share: float, is_bent: bool
) -> None:
    """Fixed draws; mean of e' C^-1 e over 4 for fx, fy, cx, cy. Without the coefficients left at
    zero it is 40 in the first case, without the design effect 9 in the second.
    """
    squares = []
    for seed in range(10):
        rng = np.random.default_rng([7, seed])
        camera = lens(rng)
        distance = 100.0 * camera.fx_px / (share * camera.width_px)
        views = make_views(
            Scene(camera, Chessboard(11, 8, 10.0), 12, 0.03, distance, 40.0, reach), 70 + seed
        )[0]
        if is_bent:
            views = [bent(view, rng, 0.03) for view in views]
        fit = calibrate_camera(views)
        assert isinstance(fit, CameraFit)
        truth, value = camera.parameters[:4], fit.camera.parameters[:4]
        squares.append(normalised_error(truth, value, fit.covariance[:4, :4]))
    low, high = stats.chi2.ppf([0.001, 0.999], 4 * len(squares)) / 4 / len(squares)
    assert low < np.mean(squares) / 4 < high, np.round(squares, 2)
