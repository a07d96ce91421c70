# SPDX-License-Identifier: Apache-2.0
"""The homography against a projected plane and OpenCV's, with wrong pairs among the right ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray, apply_homography
from armscan.geometry.estimate import FitFailure
from armscan.markers.surface_support import (
    HomographyConsensus,
    find_homography,
    fit_homography,
)

TRUE = np.array([[0.9, 0.2, 300.0], [-0.1, 1.1, -50.0], [2e-4, -1e-4, 1.0]])


def pairs(n: int, seed: int, noise_px: float = 0.0) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    left = rng.uniform([0.0, 0.0], [3000.0, 2000.0], (n, 2))
    x, y = left.T
    below = TRUE[2, 0] * x + TRUE[2, 1] * y + TRUE[2, 2]
    right = np.column_stack(
        [
            (TRUE[0, 0] * x + TRUE[0, 1] * y + TRUE[0, 2]) / below,
            (TRUE[1, 0] * x + TRUE[1, 1] * y + TRUE[1, 2]) / below,
        ]
    )
    return left, right + noise_px * rng.standard_normal((n, 2))


@pytest.mark.parametrize("n", [4, 5, 12])
def test_exact_pairs_give_the_matrix(n: int) -> None:
    matrix = fit_homography(*pairs(n, 1))
    assert not isinstance(matrix, FitFailure)
    np.testing.assert_allclose(matrix / matrix[2, 2], TRUE, rtol=1e-7, atol=1e-10)


def test_noisy_pairs_give_what_opencv_gives() -> None:
    left, right = pairs(20, 2, 0.3)
    matrix = fit_homography(left, right)
    assert not isinstance(matrix, FitFailure)
    other, _ = cv2.findHomography(left, right)
    # OpenCV minimises the distance itself: the two differ by less than the noise of the fit.
    difference = apply_homography(matrix, left) - apply_homography(np.asarray(other), left)
    assert np.sqrt(np.mean(difference**2)) < 0.3 * np.sqrt(8.0 / 40.0) / 3.0


@pytest.mark.parametrize("seed", range(8))
def test_wrong_pairs_are_left_out(seed: int) -> None:
    left, right = pairs(20, seed, 0.2)
    rng = np.random.default_rng(seed)
    wrong = rng.choice(20, 8, replace=False)
    right[wrong] += rng.uniform(40.0, 400.0, (8, 2)) * rng.choice([-1.0, 1.0], (8, 2))
    fit = find_homography(left, right, 2.0)
    assert isinstance(fit, HomographyConsensus)
    assert set(np.flatnonzero(~fit.is_inlier)) == set(wrong)
    assert fit.rms_px < 0.5


def test_what_does_not_determine_it_is_refused() -> None:
    left, right = pairs(10, 3)
    line = np.column_stack([np.arange(10.0), 2.0 * np.arange(10.0)])
    for result, reason in (
        (fit_homography(left[:3], right[:3]), "3 pairs"),
        (fit_homography(line, line), "no homography"),
        (find_homography(line, line, 2.0), "on one line"),
        (find_homography(left[:4], right[:4], 2.0), "4 pairs, 5 are needed"),
        (find_homography(left, pairs(10, 4)[1], 2.0, min_inliers=7), "pairs agree"),
    ):
        assert isinstance(result, FitFailure)
        assert reason in result.reason
