# SPDX-License-Identifier: Apache-2.0
"""The rule of verdicts, limits, and the hand-eye correction that a scan asks for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.inspection.conformity import (
    StandardDistances,
    Verdict,
    check_consistency,
    check_size,
    check_spread,
    judge,
    worst,
)


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (0.020, "still valid"),
        (-0.020, "still valid"),
        (0.0201, "inconclusive"),
        (-0.030, "inconclusive"),
        (0.0301, "not valid"),
        (-0.5, "not valid"),
        (math.nan, "inconclusive"),
    ],
)
def test_the_rule_at_its_limits(error: float, verdict: Verdict) -> None:
    """MPE 0.025 mm, U 0.005 mm: passed up to 0.020, failed above 0.030."""
    assert judge(error, 0.025, 0.005) == verdict


def test_a_test_that_is_too_coarse_never_passes() -> None:
    assert judge(0.0, 0.01, 0.011) == "inconclusive"


def test_one_failure_fails_all_and_one_open_question_leaves_all_open() -> None:
    assert worst(("still valid", "not valid", "inconclusive")) == "not valid"
    assert worst(("still valid", "inconclusive")) == "inconclusive"
    assert worst(("still valid", "still valid")) == "still valid"


def test_the_default_limit_is_three_predicted_sigmas_beyond_u() -> None:
    check = check_size("x", "y", 0.031, 0.01, 0.004, reference_u_mm=0.006)
    assert check.uncertainty == pytest.approx(0.01)
    assert check.limit == pytest.approx(0.04)
    assert check.verdict == "inconclusive"
    given = check_size("x", "y", 0.031, 0.01, 0.004, reference_u_mm=0.006, mpe_mm=0.05)
    assert (given.limit, given.limit_rule, given.verdict) == (0.05, "given", "still valid")
    with pytest.raises(InputError, match="limit of 0"):
        check_size("x", "y", 0.0, 0.01, 0.004, mpe_mm=0.0)


def test_exposures_that_disagree_more_than_they_may() -> None:
    exposure = np.repeat(np.arange(6), 50)
    shift = np.repeat([0.1, -0.1, 0.1, -0.1, 0.1, -0.1], 50)
    check = check_spread(shift, np.full(300, 0.02**2), exposure)
    assert check is not None
    assert check.error == pytest.approx(0.1)
    assert check.limit == pytest.approx(0.06)
    assert check.verdict == "not valid"
    assert check_spread(shift[:150], np.full(150, 0.02**2), exposure[:150]) is None


SIGMA = np.array([3e-4, 1.5e-4, 2.5e-4, 0.015, 0.024, 0.02])
N_EXPOSURES, N_POINTS = 24, 40
NOISE_MM = 0.003


def distances(seed: int, knock: FloatArray | None = None) -> StandardDistances:
    """Distances of a standard whose place is free, by a hand-eye drawn from its covariance."""
    rng = np.random.default_rng(seed)
    design = np.random.default_rng(99)
    n = N_EXPOSURES * N_POINTS
    mixing = design.normal(size=(6, 6)) / 3.0 + np.eye(6)
    scale = np.outer(SIGMA, SIGMA)
    covariance = mixing @ mixing.T * scale
    by_hand_eye = design.normal(size=(n, 6)) * [100.0, 100.0, 100.0, 1.0, 1.0, 1.0]
    by_place = design.normal(size=(n, 3))
    by_others = 0.002 * design.normal(size=(n, 1))
    error = SIGMA * (mixing @ rng.normal(size=6)) + (0.0 if knock is None else knock)
    values = by_hand_eye @ error + by_place @ rng.normal(0.0, 5.0, 3)
    values += by_others @ rng.normal(size=1) + rng.normal(0.0, NOISE_MM, n)
    return StandardDistances(
        values,
        by_hand_eye,
        covariance,
        by_place,
        by_others,
        np.repeat(np.arange(N_EXPOSURES), N_POINTS),
        NOISE_MM,
    )


def test_a_valid_hand_eyes_correction_is_distributed_as_expected() -> None:
    """The squared error is chi-square with 6 degrees of freedom: mean 6, variance 12."""
    n = 120
    squares = []
    for seed in range(n):
        check = check_consistency(distances(seed))
        assert check is not None
        squares.append(check.error**2)
    assert np.mean(squares) == pytest.approx(6.0, abs=3.3 * math.sqrt(12.0 / n))
    assert sum(square > 20.06 for square in squares) <= 3


def test_a_knocked_head_is_noticed() -> None:
    knock = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    check = check_consistency(distances(1, knock))
    assert check is not None
    assert check.verdict == "not valid"
    assert check.limit == pytest.approx(math.sqrt(20.06), abs=0.01)


def test_what_only_the_points_own_noise_shows_takes_no_part() -> None:
    """A derivative that is the noise itself would fit every distance exactly."""
    data = distances(1)
    by_hand_eye = np.array(data.by_calibration)
    by_hand_eye[:, 2] = 0.01 * data.distance_mm / SIGMA[2]
    check = check_consistency(
        replace(data, by_calibration=by_hand_eye, covariance=np.diag(SIGMA**2))
    )
    assert check is not None
    assert "5 parameters" in check.limit_rule


def test_too_few_exposures_ask_for_no_correction() -> None:
    data = distances(1)
    few = data.exposure < 9
    assert (
        check_consistency(
            StandardDistances(
                data.distance_mm[few],
                data.by_calibration[few],
                data.covariance,
                data.by_place[few],
                data.by_others[few],
                data.exposure[few],
                data.scatter_mm,
            )
        )
        is None
    )
