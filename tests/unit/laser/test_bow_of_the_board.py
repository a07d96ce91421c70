# SPDX-License-Identifier: Apache-2.0
"""What views that show no bow of the board leave likely of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from armscan.calibration.sheets.board_points import (
    LIKELY_BOARD_BOWS,
    BoardBow,
    HeadCameras,
    find_board_bow,
)
from armscan.geometry.arrays import FloatArray
from rigs.sheet_rig import thesis_rig

HALF_MM = 150.0
SIZES_MM = LIKELY_BOARD_BOWS * HALF_MM
BY_CAMERAS = np.arange(18.0).reshape(2, 9)
ENDS = -HALF_MM * np.ones(2), HALF_MM * np.ones(2)


def found(bow_mm: FloatArray, covariance: FloatArray) -> BoardBow:
    return BoardBow(bow_mm, covariance, BY_CAMERAS, *ENDS)


@pytest.mark.parametrize("noise_mm", [0.003, 0.03, 0.3])
def test_boards_of_any_size_of_bow_err_as_stated(noise_mm: float) -> None:
    """Squares of 4000 bows over those stated for each: 1 within four standard errors.

    Were all boards taken to bow by the rms of these sizes, 0.77 and 0.48 of the first two.
    """
    rng = np.random.default_rng(4)
    covariance = noise_mm**2 * np.array([[1.0, 0.3], [0.3, 0.5]])
    root = np.linalg.cholesky(covariance)
    squares = np.zeros(4000)
    for k, size in enumerate(rng.choice(SIZES_MM, len(squares))):
        true = size * rng.standard_normal(2)
        held = found(true + root @ rng.standard_normal(2), covariance).held_at_zero(SIZES_MM)
        assert not held.bow_mm.any()
        squares[k] = true @ true / np.trace(held.covariance_mm2)
    error = float(np.std(squares)) / np.sqrt(len(squares))
    assert error < 0.05
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * error)


def test_one_size_by_hand() -> None:
    """Bayes's rule in one dimension, integrated: mean square of what is left of a bow of 0.02.

    Of what the cameras move in the bow found as much is left as of the bow: 9 of 9 + 1 parts.
    """
    held = found(np.array([0.02, 0.0]), 0.01**2 * np.eye(2)).held_at_zero(np.array([0.03]))

    def weight(bow: float) -> float:
        return float(np.exp(-0.5 * ((bow - 0.02) / 0.01) ** 2 - 0.5 * (bow / 0.03) ** 2))

    mass = integrate.quad(weight, -0.3, 0.3, points=[0.02])[0]
    square = integrate.quad(lambda bow: bow**2 * weight(bow), -0.3, 0.3, points=[0.02])[0] / mass
    assert held.covariance_mm2[0, 0] == pytest.approx(square, rel=1e-6)
    assert held.by_cameras == pytest.approx(0.9 * BY_CAMERAS)


@pytest.mark.parametrize("stated_mm", [None, 0.05, 0.0])
def test_of_two_views_a_bow_is_as_likely_as_before(stated_mm: float | None) -> None:
    rig = thesis_rig()
    camera = rig.noisy_camera(np.random.default_rng(1))
    views = [rig.view(k, np.random.default_rng(k)) for k in range(2)]
    bow = find_board_bow(views, HeadCameras.of(rig.calibration(camera)), stated_mm)
    if stated_mm == 0.0:
        assert bow is None
        return
    assert bow is not None
    half_mm = 0.5 * float(np.ptp(views[0].points_board_mm, axis=0).max())
    rms_mm = stated_mm or half_mm * float(np.sqrt(np.mean(LIKELY_BOARD_BOWS**2)))
    assert bow.covariance_mm2 == pytest.approx(rms_mm**2 * np.eye(2))
    assert not bow.bow_mm.any()
