# SPDX-License-Identifier: Apache-2.0
"""The variance that explains residuals beyond the detector's claim, by hand."""

import numpy as np
import pytest

from armscan.calibration.cameras.robust import excess_variance_px2

RESIDUALS = np.tile([[0.3, 0.0], [0.0, -0.5]], (50, 1))
"""Sum of squares 50 * (0.09 + 0.25) = 17 px^2 over 100 points."""
CLAIMED = np.tile(np.diag([0.03, 0.05]), (100, 1, 1))
"""0.04 px^2 an axis in the mean."""


def test_the_claim_is_taken_off_the_scatter() -> None:
    """170 degrees of freedom: 17 / 170 = 0.1 px^2 of scatter, less the 0.04 that are claimed."""
    assert excess_variance_px2(RESIDUALS, CLAIMED, 425.0, 170) == pytest.approx(0.06)


def test_nothing_is_added_within_four_sigmas_of_the_expected_chi2() -> None:
    """Standard deviation of chi2 / 200 is 0.1: the limit is 1.4."""
    assert excess_variance_px2(RESIDUALS, CLAIMED, 1.39 * 200, 200) == 0.0
    assert excess_variance_px2(RESIDUALS, CLAIMED, 1.41 * 200, 200) > 0.0
    assert excess_variance_px2(RESIDUALS, CLAIMED, 1e9, 0) == 0.0
