# SPDX-License-Identifier: Apache-2.0
"""The two F tests of a light sheet, with every number by hand."""

import pytest
from scipy import stats

from armscan.calibration.sheets.model import StripeNoise, lack_of_fit

NOISE = StripeNoise(1.2, 4.0, 500.0)
"""500 degrees of freedom in points, of which four count as one: 125."""


def test_plane_over_six_stripes() -> None:
    """6 stripes of 4 shape terms less 3 parameters: 21; chi2 188 less 125 of noise is 3 * 21."""
    test = lack_of_fit(188.0, 6, 3, NOISE)
    assert test.degrees_of_freedom == 21
    assert test.f_ratio == pytest.approx(3.0)
    assert test.p_value == pytest.approx(stats.f.sf(3.0, 21, 125))


def test_raised_sigmas_shrink_the_noise_in_chi2_by_their_square() -> None:
    """Sigmas twice as large: the noise's 125 count as 31.25, so that chi2 94.25 again gives 3."""
    test = lack_of_fit(94.25, 6, 3, NOISE, 2.0 * NOISE.sigma_factor)
    assert test.f_ratio == pytest.approx(3.0)


def test_a_solution_with_no_stripe_to_spare_is_not_tested() -> None:
    assert lack_of_fit(1e6, 2, 8, NOISE).p_value == 1.0
