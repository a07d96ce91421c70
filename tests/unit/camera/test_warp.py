# SPDX-License-Identifier: Apache-2.0
"""The F test of the board's bow, by hand."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.robust import BowTest, Solution, board_warp


def solution(chi2: float, degrees_of_freedom: int) -> Solution:
    """What the test looks at of a solution."""
    shared = np.arange(11.0)
    found = SimpleNamespace(
        equations=SimpleNamespace(chi2=chi2),
        degrees_of_freedom=degrees_of_freedom,
        variance_factor=chi2 / degrees_of_freedom,
        state=SimpleNamespace(shared=shared),
    )
    return cast(Solution, found)


def test_two_parameters_that_lower_chi2_by_a_quarter() -> None:
    """(125 - 100) / 2 over 100 / 80: F is 10 with 2 and 80 degrees of freedom."""
    covariance = np.diag(np.arange(1.0, 18.0))
    bowed = solution(100.0, 80)
    warp = board_warp(bowed, BowTest.of(solution(125.0, 82), bowed), covariance)
    assert warp.f_statistic == pytest.approx(10.0)
    assert warp.p_value == pytest.approx(stats.f.sf(10.0, 2, 80))
    np.testing.assert_array_equal(warp.bow_mm, [9.0, 10.0])
    np.testing.assert_array_equal(warp.covariance_mm2, np.diag([10.0, 11.0]))
