# SPDX-License-Identifier: Apache-2.0
"""The limits at which a sheet's geometry is refused, or only warned of."""

import numpy as np

from armscan.calibration.laser.conditioning import (
    MAX_TILT_SIGMA_DEG,
    WEAK_TILT_SIGMA_DEG,
    SheetGeometry,
    geometry_warnings,
    refuse_loose_tilt,
)

GEOMETRY = SheetGeometry(3, 20.0, (120.0, 150.0), np.array([10.0, 8.0]))


def test_a_direction_that_the_boards_leave_open_is_refused_with_the_facts() -> None:
    assert refuse_loose_tilt("A", GEOMETRY, MAX_TILT_SIGMA_DEG) is None
    failure = refuse_loose_tilt("A", GEOMETRY, MAX_TILT_SIGMA_DEG + 0.1)
    assert failure is not None
    assert "known to 2.1 deg only" in failure.reason
    assert "depth 120.0 to 150.0 mm" in failure.reason
    assert "further in depth" in failure.remedy


def test_a_weak_direction_is_warned_of() -> None:
    assert geometry_warnings(GEOMETRY, None, WEAK_TILT_SIGMA_DEG) == ()
    (warning,) = geometry_warnings(GEOMETRY, None, WEAK_TILT_SIGMA_DEG + 0.1)
    assert "known to 0.30 deg only" in warning
