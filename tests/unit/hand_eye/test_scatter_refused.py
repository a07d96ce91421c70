# SPDX-License-Identifier: Apache-2.0
"""Which estimates of the arm's scatter no arm explains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from armscan.calibration.hand_eye.checks import refuse_scatter
from armscan.calibration.hand_eye.estimate import HandEyeSolution


def solved(arm_mm: float, factor: float, given_mm: float | None = None) -> HandEyeSolution:
    """A solution whose arm's scatter is known to a factor (one sigma)."""
    options = SimpleNamespace(arm_position_mm=given_mm)
    problem = SimpleNamespace(options=options)
    found = SimpleNamespace(arm_mm=arm_mm, log_arm_mm=float(np.log(factor)), problem=problem)
    return cast(HandEyeSolution, found)


@pytest.mark.parametrize(
    ("arm_mm", "factor"),
    [
        (0.03, 1.1),
        (0.24, 1.05),
        # few postures: 0.6 mm that may well be 0.2
        (0.6, 1.7),
    ],
)
def test_an_arms_scatter_is_taken(arm_mm: float, factor: float) -> None:
    assert refuse_scatter(solved(arm_mm, factor)) is None


@pytest.mark.parametrize(
    ("arm_mm", "factor"),
    [
        (0.3, 1.05),
        (0.6, 1.2),
        # one of the random instruments: 11 mm, known to a factor of 7, a hand-eye 83 mm off
        (10.9, 7.0),
    ],
)
def test_what_no_arm_scatters_is_refused(arm_mm: float, factor: float) -> None:
    refused = refuse_scatter(solved(arm_mm, factor))
    assert refused is not None and f"{arm_mm:.2f} mm" in refused.reason


def test_a_scatter_that_was_given_is_not_judged() -> None:
    assert refuse_scatter(solved(2.0, 1.1, given_mm=2.0)) is None
