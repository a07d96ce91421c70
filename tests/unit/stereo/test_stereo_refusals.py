# SPDX-License-Identifier: Apache-2.0
"""Two cameras that make no sense are refused, each limit by its own reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoOptions
from armscan.calibration.cameras.result import LARGEST_FOCAL_SIGMA, CameraOptions
from armscan.calibration.cameras.stereo_result import (
    LARGEST_BASELINE_SIGMA,
    StereoFit,
    reasons_to_refuse,
)
from armscan.models.camera import PARAMETER_NAMES
from rigs.stereo_rig import StereoScene, make_pairs

SCENE = StereoScene(n_pairs=6)
OPTIONS = StereoOptions(CameraOptions(distortion="k1k2", n_folds=0), n_folds=0)
N = len(PARAMETER_NAMES)


@pytest.fixture(scope="module")
def fit() -> StereoFit:
    found = calibrate_stereo(make_pairs(SCENE, 1)[0], SCENE.target, OPTIONS)
    assert isinstance(found, StereoFit), found
    return found


def with_sigma(fit: StereoFit, index: int, sigma: float) -> StereoFit:
    """One parameter known to ``sigma``, all others as they are."""
    scale = np.ones(len(fit.covariance))
    scale[index] = sigma / fit.sigma[index]
    return replace(fit, covariance=fit.covariance * np.outer(scale, scale))


def test_a_good_pair_is_not_refused(fit: StereoFit) -> None:
    assert reasons_to_refuse(fit) == ()


@pytest.mark.parametrize(("side", "word"), [(0, "left"), (1, "right")])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_focal_length_of_each_camera_counts(
    fit: StereoFit, side: int, word: str, axis: int
) -> None:
    focal = (fit.views.left, fit.views.right)[side].parameters[axis]
    index = side * N + axis
    assert reasons_to_refuse(with_sigma(fit, index, 0.9 * LARGEST_FOCAL_SIGMA * focal)) == ()
    (reason,) = reasons_to_refuse(with_sigma(fit, index, 1.1 * LARGEST_FOCAL_SIGMA * focal))
    assert reason.startswith(f"{word} camera: ")
    assert "focal length" in reason


def test_the_baseline_counts_along_itself(fit: StereoFit) -> None:
    """Across the baseline the same sigma moves the cameras, not their distance."""
    translation = fit.views.right_from_left.translation_mm
    length = float(np.linalg.norm(translation))
    along, across = int(np.argmax(abs(translation))), int(np.argmin(abs(translation)))
    sigma = 1.5 * LARGEST_BASELINE_SIGMA * length
    (reason,) = reasons_to_refuse(with_sigma(fit, 2 * N + 3 + along, sigma))
    assert "distance" in reason
    assert reasons_to_refuse(with_sigma(fit, 2 * N + 3 + across, sigma)) == ()


def test_pairs_that_disagree_are_named_before_what_they_spoil(fit: StereoFit) -> None:
    """Only beside a reason to refuse: by themselves they are warned of."""
    unsteady = replace(fit, typical_level=49.0)
    assert reasons_to_refuse(unsteady) == ()
    focal_px = fit.views.left.fx_px
    spoilt = with_sigma(unsteady, 0, 1.1 * LARGEST_FOCAL_SIGMA * focal_px)
    first, second = reasons_to_refuse(spoilt)
    worst = max(fit.related, key=lambda pair: pair.level)
    assert "7 standard deviations apart" in first and worst.pair.name in first
    assert "focal length" in second
