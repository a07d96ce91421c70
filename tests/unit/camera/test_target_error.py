# SPDX-License-Identifier: Apache-2.0
"""A target whose points miss their places: the same in every view, so views do not average it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from rigs.camera_scene import Scene, make_views, normalised_error

OPTIONS = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)
N_RUNS = 40


def mean_normalised_error(scene: Scene) -> float:
    errors = []
    for seed in range(N_RUNS):
        fit = calibrate_camera(make_views(scene, seed)[0], OPTIONS)
        assert isinstance(fit, CameraFit)
        errors.append(
            normalised_error(scene.camera.parameters, fit.camera.parameters, fit.covariance)
        )
    return float(np.mean(errors))


@pytest.mark.parametrize("missed_mm", [0.0, 0.005, 0.03])
def test_the_covariance_holds_the_targets_own_errors(missed_mm: float) -> None:
    """Taken for noise of each view, 0.03 mm would make the mean about 100 instead of 9."""
    low, high = stats.chi2.ppf([0.0005, 0.9995], 9 * N_RUNS) / N_RUNS
    assert low < mean_normalised_error(Scene(missed_mm=missed_mm)) < high
