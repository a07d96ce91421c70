# SPDX-License-Identifier: Apache-2.0
"""The limits at which a sheet's geometry is refused, or only warned of."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.coplanarity import (
    MAX_PARALLEL_TILT_SIGMA_DEG,
    MAX_TILT_SIGMA_DEG,
    MIN_SPREAD_SIGMAS,
    WEAK_TILT_SIGMA_DEG,
    SheetGeometry,
    geometry_warnings,
    refuse_lost_spread,
    refuse_underdetermined_tilt,
)
from armscan.calibration.sheets.result import LaserFit
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose
from rigs.sheet_rig import thesis_rig

GEOMETRY = SheetGeometry(3, 20.0, (120.0, 150.0), np.array([10.0, 8.0]))


def test_a_direction_that_the_boards_leave_open_is_refused_with_the_facts() -> None:
    assert refuse_underdetermined_tilt("A", GEOMETRY, MAX_TILT_SIGMA_DEG) is None
    failure = refuse_underdetermined_tilt("A", GEOMETRY, MAX_TILT_SIGMA_DEG + 0.1)
    assert failure is not None
    assert "known to 2.10 deg only" in failure.reason
    assert "depth 120.0 to 150.0 mm" in failure.reason
    assert "further in depth" in failure.remedy
    parallel = replace(GEOMETRY, board_angle_deg=0.1)
    assert refuse_underdetermined_tilt("A", parallel, MAX_PARALLEL_TILT_SIGMA_DEG) is None
    assert refuse_underdetermined_tilt("A", parallel, MAX_PARALLEL_TILT_SIGMA_DEG + 0.1) is not None


def test_a_weak_direction_is_warned_of() -> None:
    """Where the boards' places leave it open; told is the sigma that stands in the table."""
    assert geometry_warnings(GEOMETRY, None, WEAK_TILT_SIGMA_DEG, 0.9168) == ()
    (warning,) = geometry_warnings(GEOMETRY, None, WEAK_TILT_SIGMA_DEG + 0.1, 0.9168)
    assert "known to 0.917 deg only" in warning


def test_a_spread_that_may_be_the_boards_error_is_refused() -> None:
    """8 mm across: known well enough if the boards are known to 1.6 mm."""
    assert refuse_lost_spread("A", GEOMETRY, 8.0 / MIN_SPREAD_SIGMAS) is None
    failure = refuse_lost_spread("A", GEOMETRY, 1.01 * 8.0 / MIN_SPREAD_SIGMAS)
    assert failure is not None
    assert "spread 8.000 mm across" in failure.reason
    assert "known to 1.616 mm there" in failure.reason


@pytest.mark.parametrize("n_boards", [2, 4])
@pytest.mark.parametrize("apart_mm", [0.01, 0.1, 0.15])
def test_nearly_the_same_placement_again_is_refused(n_boards: int, apart_mm: float) -> None:
    """Boards nearer together than they are known: no traceback, and no sheet of small sigma."""
    rig = replace(thesis_rig(), sigma_corner_px=0.2)
    first = rig.poses[1]
    steps = [np.array([0.0, 0.0, apart_mm * i]) for i in range(n_boards)]
    poses = tuple(Pose(first.rotation, first.translation_mm + step) for step in steps)
    for seed in range(5):
        boards = replace(rig, poses=poses).boards(rig.camera, np.random.default_rng(seed))
        fit = calibrate_sheets(boards, rig.calibration(rig.camera))
        assert isinstance(fit, FitFailure)
        assert fit.reason.startswith("sheet A")


def test_a_fit_that_has_settled_says_nothing() -> None:
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(0))
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    assert not any("settled" in warning for warning in fit.warnings)
