# SPDX-License-Identifier: Apache-2.0
"""Photographs of a lab, rendered: camera, light sheet and points against the truth.

The simulator has its own lens and its own bowed sheet; nothing is shared with what is tested. The
bounds are chi-squared quantiles of the stated covariances, and plain ones from the geometry.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import Provenance, SensorCalibration
from armscan.pipeline.camera import CameraRun, calibrate_camera_from_exposures
from armscan.pipeline.laser import calibrate_sheets_from_exposures
from armscan.pipeline.photo_demo import PhotoErrors, compare_with_truth
from armscan.pipeline.reconstruct import reconstruct
from armscan.records.exposure import Exposure
from armscan.report.camera_job import camera_calibration
from armscan.simulation.photo_set import PhotoSetOptions, render_photo_set
from armscan.simulation.photo_truth import PhotoSetTruth
from armscan.storage.images import read_exposures
from armscan.vision.targets.specification import parse_target

SIZE = PhotoSetOptions(width_px=640, height_px=480, n_camera=10)
FOUR_SIGMA = 2.0 * stats.norm.sf(4.0)
STRIPE_PX = 0.1
"""Stripe noise after speckle of contrast 0.2 on a line of sigma 1 px, systematic parts included."""
DEPTH_MM_PER_PX = 300.0 / 701.3 / 0.45
"""Distance over focal length, over the tangent between camera ray and sheet."""
ORIGIN = Provenance("test", "2000-01-01T00:00:00+00:00", "0", ("test",), ())


@pytest.fixture(scope="module", params=[1, 2])
def measured(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[CameraRun, SensorCalibration, PhotoErrors, PhotoSetTruth]:
    folder = tmp_path_factory.mktemp("photos")
    truth = render_photo_set(folder, request.param, options=SIZE)
    target = parse_target(truth.target)
    run = calibrate_camera_from_exposures(read_all(folder / "camera"), target)
    assert not isinstance(run, FitFailure)
    boards = read_exposures(
        [p for state in ("on", "off") for p in sorted((folder / "laser" / state).glob("*.png"))]
    )
    half = len(boards) // 2
    camera = camera_calibration(run.fit, ORIGIN)
    fit = calibrate_sheets_from_exposures(boards[:half], target, camera, backgrounds=boards[half:])
    assert not isinstance(fit, FitFailure)
    sensor = fit.to_calibration(ORIGIN)
    background, laser = read_all(folder / "object")
    result = reconstruct([laser], sensor, backgrounds=[background])
    return run, sensor, compare_with_truth(sensor, result.cloud, truth), truth


def read_all(folder: Path) -> tuple[Exposure, ...]:
    return read_exposures(sorted(folder.glob("*.png")))


Measured = tuple[CameraRun, SensorCalibration, PhotoErrors, PhotoSetTruth]


def test_every_photo_is_used(measured: Measured) -> None:
    run, sensor, _, _ = measured
    assert run.not_found == ()
    assert run.fit.n_points == 10 * 99
    assert sensor.sheets[0].n_boards == 6


def test_camera_errors_are_what_its_covariance_says(measured: Measured) -> None:
    _, _, errors, _ = measured
    assert abs(errors.focal_px) < 4.0 * errors.focal_sigma_px
    limit = stats.chi2.isf(FOUR_SIGMA, errors.n_camera_parameters)
    assert errors.camera_normalised**2 < limit


def test_camera_projects_as_the_true_one(measured: Measured) -> None:
    """The largest difference over the points seen, by the simulator's own projection."""
    run, _, _, truth = measured
    pose = truth.camera_boards[0]
    grid = np.stack(np.meshgrid(np.arange(0, 121, 30), np.arange(0, 97, 32), [0]), -1)
    points = grid.reshape(-1, 3).astype(float) @ pose.rotation.T + pose.translation_mm
    difference = run.fit.camera.project(points) - truth.camera.project(points)
    # a noise of 0.006 px on 990 points, seven of nine parameters in play near the middle
    assert np.abs(difference).max() < 4.0 * 0.006 * np.sqrt(9 / 990) * 20


def test_sheet_errors_are_what_its_covariance_says(measured: Measured) -> None:
    _, _, errors, _ = measured
    sheet = errors.sheet
    assert sheet.normalised**2 < stats.chi2.isf(FOUR_SIGMA, sheet.n_parameters)
    # a hundred stripe points a board, biased alike where the line passes circles
    assert sheet.rms_mm < STRIPE_PX * DEPTH_MM_PER_PX * np.sin(np.arctan(0.45))
    assert sheet.angle_deg < 0.03


def test_points_lie_on_the_bust_within_their_sigmas(measured: Measured) -> None:
    _, _, errors, truth = measured
    n_rows = int((truth.body_stripe.surface == 0).sum())
    assert errors.n_on_object > 0.8 * n_rows
    assert errors.n_on_object > 0.98 * errors.n_points
    assert errors.points_median_mm < STRIPE_PX * DEPTH_MM_PER_PX
    assert errors.points_within_2_sigma > 0.9
    assert 0.3 < errors.points_normalised_rms < 1.3
