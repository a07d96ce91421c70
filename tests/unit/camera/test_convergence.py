# SPDX-License-Identifier: Apache-2.0
"""An adjustment that was stopped early says so, and so does the calibration built on it."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.adjustment import State, adjust, free_basis, gather
from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions, advise
from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from rigs.camera_scene import CAMERA, Scene, make_views

STOPPED = "stopped before it reached the best fit"
NOT_BEST = "did not converge to the best fit"


def solved(options: CameraOptions) -> CameraFit:
    fit = calibrate_camera(make_views(Scene(), 1)[0], options)
    assert isinstance(fit, CameraFit), fit
    return fit


@pytest.mark.parametrize("noise_px", [0.0, 0.05])
def test_adjustment_tells_whether_it_reached_the_minimum(noise_px: float) -> None:
    views, poses = make_views(Scene(noise_px=noise_px), 4)
    poor = np.append(CAMERA.parameters * [1.05, 0.96, 1.02, 0.98, 0.5, 0, 0, 0, 0], np.zeros(2))
    start = State.from_poses(poor, poses)
    basis, _ = free_basis("k1k2p1p2k3", CameraOptions())
    stopped, ended = (adjust(gather(views, "pinhole"), start, basis, max_steps=n) for n in (2, 100))
    assert not isinstance(stopped, FitFailure)
    assert not isinstance(ended, FitFailure)
    assert not stopped.is_settled
    assert ended.is_settled
    assert ended.chi2 < stopped.chi2


@pytest.mark.parametrize("solve_warp", [False, True])
def test_calibration_stopped_early_is_warned_of(solve_warp: bool) -> None:
    options = CameraOptions(distortion="k1k2p1p2k3", solve_warp=solve_warp)
    early, ended = solved(replace(options, max_steps=1)), solved(options)
    assert STOPPED in early.warnings[0]
    assert not any(STOPPED in warning for warning in ended.warnings)


def test_unseen_views_that_fit_better_show_a_solution_that_is_not_the_best() -> None:
    fit = solved(CameraOptions())
    assert fit.cross_validation is not None
    used_px = fit.cross_validation.rms_in_sample_px
    for share, expected in ((0.85, True), (0.95, False)):
        held_out = replace(fit.cross_validation, rms_px=share * used_px)
        told = advise(replace(fit, cross_validation=held_out), (), is_converged=True)
        assert any(NOT_BEST in warning for warning in told.warnings) == expected


def test_no_step_at_all_is_refused() -> None:
    with pytest.raises(OptionError, match="max_steps is 0"):
        CameraOptions(max_steps=0)
