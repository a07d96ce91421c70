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
ENDS = -HALF_MM * np.ones(2), HALF_MM * np.ones(2)


def found(bow_mm: FloatArray, covariance: FloatArray) -> BoardBow:
    return BoardBow(bow_mm, covariance, np.zeros((2, 9)), *ENDS)


@pytest.mark.parametrize("noise_mm", [0.003, 0.03, 0.3])
def test_boards_of_any_size_of_bow_err_as_stated(noise_mm: float) -> None:
    """Normalised squares of 4000 bows of sizes as likely beforehand: 1 +- 0.03.

    Sizes taken to be 3e-4 always stated 0.3 of it where the views tell (0.003 mm).
    """
    rng = np.random.default_rng(3)
    total, stated = 0.0, 0.0
    covariance = noise_mm**2 * np.array([[1.0, 0.3], [0.3, 0.5]])
    root = np.linalg.cholesky(covariance)
    for size in rng.choice(SIZES_MM, 4000):
        true = size * rng.standard_normal(2)
        held = found(true + root @ rng.standard_normal(2), covariance).held_at_zero(SIZES_MM)
        assert not held.bow_mm.any()
        total, stated = total + true @ true, stated + float(np.trace(held.covariance_mm2))
    assert total / stated == pytest.approx(1.0, abs=0.15)


def test_one_size_by_hand() -> None:
    """Bayes's rule in one dimension, integrated: mean square of what is left of a bow of 0.02."""
    held = found(np.array([0.02, 0.0]), 0.01**2 * np.eye(2)).held_at_zero(np.array([0.03]))

    def weight(bow: float) -> float:
        return float(np.exp(-0.5 * ((bow - 0.02) / 0.01) ** 2 - 0.5 * (bow / 0.03) ** 2))

    mass = integrate.quad(weight, -0.3, 0.3, points=[0.02])[0]
    square = integrate.quad(lambda bow: bow**2 * weight(bow), -0.3, 0.3, points=[0.02])[0] / mass
    assert held.covariance_mm2[0, 0] == pytest.approx(square, rel=1e-6)


@pytest.mark.parametrize(("stated_mm", "n"), [(None, 2), (0.05, 2), (0.0, 2)])
def test_of_too_few_views_a_bow_is_as_likely_as_before(stated_mm: float | None, n: int) -> None:
    rig = thesis_rig()
    camera = rig.noisy_camera(np.random.default_rng(1))
    views = [rig.view(k, np.random.default_rng(k)) for k in range(n)]
    bow = find_board_bow(views, HeadCameras.of(rig.calibration(camera)), stated_mm)
    if stated_mm == 0.0:
        assert bow is None
        return
    assert bow is not None
    half_mm = 0.5 * float(np.ptp(views[0].points_board_mm, axis=0).max())
    rms_mm = stated_mm or half_mm * float(np.sqrt(np.mean(LIKELY_BOARD_BOWS**2)))
    assert bow.covariance_mm2 == pytest.approx(rms_mm**2 * np.eye(2))
    assert not bow.bow_mm.any()
