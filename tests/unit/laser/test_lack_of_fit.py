# SPDX-License-Identifier: Apache-2.0
"""The two F tests of a light sheet, with every number by hand."""

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.sheets.lack_of_fit import StripeNoise, lack_of_fit
from armscan.calibration.sheets.solve import (
    LinearSolution,
    NormalSolution,
    SheetObservations,
    SheetSolution,
    StripeSystem,
)
from armscan.geometry.arrays import FloatArray

NOISE = StripeNoise(1.2, 4.0, 500.0)
"""500 degrees of freedom in points, of which four count as one: 125."""


def solution(chi2: float, n_parameters: int) -> SheetSolution:
    none: FloatArray = np.zeros(0)
    empty = np.zeros((0, 0))
    linear = LinearSolution(
        StripeSystem((), 0, 0, 0, none, none),
        NormalSolution(none, empty, empty, 0),
        none,
        none > 0.0,
    )
    return SheetSolution((), empty, none, none, none, none, chi2, n_parameters, 0.0, linear)


def observations(n_stripes: int) -> SheetObservations:
    stripe = np.repeat(np.arange(n_stripes), 30)
    n = len(stripe)
    index = np.zeros(n, dtype=np.int64)
    return SheetObservations(
        index,
        index,
        index,
        index,
        stripe,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.ones(n),
        np.zeros((n, 3, 6)),
        np.zeros((n, 3, 9)),
    )


def test_plane_over_six_stripes() -> None:
    """6 stripes of 4 shape terms less 3 parameters: 21; chi2 188 less 125 of noise is 3 * 21."""
    test = lack_of_fit(observations(6), solution(188.0, 3), NOISE)
    assert test.degrees_of_freedom == 21
    assert test.f_ratio == pytest.approx(3.0)
    assert test.p_value == pytest.approx(stats.f.sf(3.0, 21, 125))


def test_raised_sigmas_shrink_the_noise_in_chi2_by_their_square() -> None:
    """Sigmas twice as large: the noise's 125 count as 31.25, so that chi2 94.25 again gives 3."""
    test = lack_of_fit(observations(6), solution(94.25, 3), NOISE, 2.0 * NOISE.sigma_factor)
    assert test.f_ratio == pytest.approx(3.0)


def test_a_solution_with_no_stripe_to_spare_is_not_tested() -> None:
    assert lack_of_fit(observations(2), solution(1e6, 8), NOISE).p_value == 1.0
