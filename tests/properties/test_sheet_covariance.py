# SPDX-License-Identifier: Apache-2.0
"""The sheet's covariance is that of repeats: boards, stripes and camera all noisy."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import LaserFit, SheetOptions
from armscan.geometry.arrays import FloatArray
from armscan.models.light_sheet import LightSheet
from rigs.sheet_rig import SheetRig, thesis_rig

N_RUNS = 200
INSIDE_95 = range(182, 198)
FLAT = SheetOptions(target_bow_mm=0.0)
"""The boards that are drawn are flat, and known to be."""
"""99 % of binomial(200, 0.95)."""


def plane_error(sheet: LightSheet, truth: FloatArray) -> FloatArray:
    """(3,) tilts and offset of the estimate minus those of the true plane, in its own frame."""
    unit = truth / np.linalg.norm(truth[:3])
    places = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]) * sheet.scale_mm
    points = sheet.origin_mm + places @ sheet.axes[:2]
    truth_height = -(points @ unit[:3] + unit[3]) / (unit[:3] @ sheet.axes[2])
    return -np.array([*(truth_height[:2] - truth_height[2]), truth_height[2]])


def test_normalised_errors_of_sheet_and_camera_over_200_runs() -> None:
    """Per run: a camera with its calibration's error, new corners, new stripes."""
    rig = replace(thesis_rig(), points_per_stripe=50)
    sheet_squares, joint_squares, p_values = [], [], []
    for seed in range(N_RUNS):
        fit, camera_error = one_run(rig, seed)
        error = plane_error(fit.sheets[0].sheet, rig.sheets[0].plane)
        covariance = fit.covariance[:12, :12]
        sheet_squares.append(error @ np.linalg.solve(covariance[9:, 9:], error))
        joint_squares.append(normalised_square(np.append(camera_error, error), covariance))
        p_values.append(fit.sheets[0].diagnostics.plane_test.p_value)
    assert int((np.array(sheet_squares) < chi2.ppf(0.95, 3)).sum()) in INSIDE_95
    assert int((np.array(joint_squares) < chi2.ppf(0.95, 12)).sum()) in INSIDE_95
    # Mean of chi2 with 12 degrees over 200 runs: 12 +- 4 * sqrt(24 / 200).
    assert abs(np.mean(joint_squares) - 12.0) < 4.0 * np.sqrt(24.0 / N_RUNS)
    # The lack-of-fit test cries wolf as often as it says: 5 % of 200 is 10 +- 4 * 3.
    assert int((np.array(p_values) < 0.05).sum()) <= 22


def test_leaving_the_camera_out_would_be_noticed() -> None:
    """The test above can fail: without the camera's error the region is far too small."""
    rig = replace(thesis_rig(), points_per_stripe=50)
    inside = 0
    for seed in range(20):
        camera = rig.noisy_camera(np.random.default_rng(seed))
        boards = rig.boards(camera, np.random.default_rng(1000 + seed))
        exact_camera = replace(rig.calibration(camera), covariance=np.zeros((9, 9)))
        fit = calibrate_sheets(boards, exact_camera, FLAT)
        assert isinstance(fit, LaserFit), fit
        error = plane_error(fit.sheets[0].sheet, rig.sheets[0].plane)
        square = error @ np.linalg.solve(fit.covariance[9:12, 9:12], error)
        inside += int(square < chi2.ppf(0.95, 3))
    assert inside < 15


def one_run(rig: SheetRig, seed: int) -> tuple[LaserFit, FloatArray]:
    rng = np.random.default_rng(seed)
    camera = rig.noisy_camera(rng)
    fit = calibrate_sheets(rig.boards(camera, rng), rig.calibration(camera), FLAT)
    assert isinstance(fit, LaserFit), fit
    return fit, np.asarray(camera.parameters - rig.camera.parameters)


def normalised_square(error: FloatArray, covariance: FloatArray) -> float:
    sigma = np.sqrt(np.diag(covariance))
    scaled = error / sigma
    return float(scaled @ np.linalg.solve(covariance / np.outer(sigma, sigma), scaled))
