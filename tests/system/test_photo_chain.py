# SPDX-License-Identifier: Apache-2.0
"""Photographs of a lab, rendered: camera, light sheet and points against the truth.

The simulator has its own lens and its own bowed sheet; nothing is shared with what is tested. The
bounds are chi-squared quantiles of the stated covariances, and plain ones from the geometry.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.sheets.result import PointUse
from armscan.cli.run import main
from armscan.jobs import demo
from armscan.jobs.demo import DemoRequest, run_photo_demo
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.photo_demo import PhotoErrors
from armscan.pipeline.progress import Progress
from armscan.pipeline.truth import SheetErrors
from armscan.simulation.photos import PhotoSetOptions, PhotoSetTruth, render_photo_set
from armscan.storage.documents import read_sensor_calibration

SIZE = PhotoSetOptions(width_px=640, height_px=480, n_camera=10)
FOUR_SIGMA = 2.0 * stats.norm.sf(4.0)
STRIPE_PX = 0.1
"""Stripe noise after speckle of contrast 0.2 on a line of sigma 1 px, systematic parts included."""
DEPTH_MM_PER_PX = 300.0 / 701.3 / 0.45
"""Distance over focal length, over the tangent between camera ray and sheet."""


@dataclass(frozen=True)
class Measured:
    folder: Path
    data: dict[str, Any]
    errors: PhotoErrors
    sensor: SensorCalibration
    truth: PhotoSetTruth


@pytest.fixture(scope="module", params=[1, 2])
def measured(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """The demo's whole chain, through its documents, on smaller photographs."""
    folder = tmp_path_factory.mktemp("demo")
    truths: list[PhotoSetTruth] = []

    def render(photos: Path, seed: int, progress: Progress) -> PhotoSetTruth:
        truths.append(render_photo_set(photos, seed, options=SIZE))
        return truths[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "render_photos", render)
        run_photo_demo(DemoRequest(folder, request.param))
    data = json.loads((folder / "summary.json").read_text())
    figures = data["errors"]
    errors = PhotoErrors(**{**figures, "sheet": SheetErrors(**figures["sheet"])})
    sensor = read_sensor_calibration(folder / "sensor.json")
    return Measured(folder, data, errors, sensor, truths[0])


def test_every_photo_is_used_and_every_file_written(measured: Measured) -> None:
    camera, sheet = measured.data["camera"], measured.sensor.sheets[0]
    assert camera["not_found"] == []
    assert camera["n_points"] == 10 * 99
    assert sheet.n_boards == 6
    assert measured.data["simulated"] is True
    assert {path.name for path in measured.folder.iterdir()} == demo.DEMO_JOB_OWN_NAMES
    for page in ("camera.html", "sensor.html", "cloud.html"):
        assert "simulated" in (measured.folder / page).read_text().lower()
    assert PointUse.ON_EDGE.label in (measured.folder / "sensor.html").read_text()


def test_camera_errors_are_what_its_covariance_says(measured: Measured) -> None:
    errors = measured.errors
    assert abs(errors.focal_px) < 4.0 * errors.focal_sigma_px
    limit = stats.chi2.isf(FOUR_SIGMA, errors.n_camera_parameters)
    assert errors.camera_normalised**2 < limit


def test_camera_projects_as_the_simulators_own_lens(measured: Measured) -> None:
    pose = measured.truth.camera_boards[0]
    grid = np.stack(np.meshgrid(np.arange(0, 121, 30), np.arange(0, 97, 32), [0]), -1)
    points = grid.reshape(-1, 3).astype(float) @ pose.rotation.T + pose.translation_mm
    camera = measured.sensor.camera
    projected, _, by_parameters = camera.camera.project_with_jacobian(points)
    difference = projected - measured.truth.camera.project(points)
    covariance = by_parameters @ camera.covariance @ np.swapaxes(by_parameters, 1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    assert np.abs(difference / sigma).max() < 4.5
    # the principal point, which a moved board makes up for, is the least well known
    assert sigma.max() < 1.5 * np.sqrt(np.diag(camera.covariance)[2:4]).max()


def test_sheet_errors_are_what_its_covariance_says(measured: Measured) -> None:
    sheet = measured.errors.sheet
    assert sheet.normalised**2 < stats.chi2.isf(FOUR_SIGMA, sheet.n_parameters)
    # a hundred stripe points a board, biased alike where the line passes circles
    assert sheet.rms_mm < STRIPE_PX * DEPTH_MM_PER_PX * np.sin(np.arctan(0.45))
    assert sheet.angle_deg < 0.03


def test_points_lie_on_the_bust_within_their_sigmas(measured: Measured) -> None:
    errors = measured.errors
    n_rows = int((measured.truth.body_stripe.surface == 0).sum())
    assert errors.n_on_object > 0.8 * n_rows
    assert errors.n_on_object > 0.98 * errors.n_points
    assert errors.points_median_mm < STRIPE_PX * DEPTH_MM_PER_PX
    assert errors.points_within_2_sigma > 0.9
    assert 0.3 < errors.points_normalised_rms < 1.3


def test_a_folder_with_other_files_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    assert main(["demo", "photos", "-o", str(tmp_path)]) == 2
    assert "thesis.txt" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
