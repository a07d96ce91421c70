# SPDX-License-Identifier: Apache-2.0
"""Photographs of a lab without an arm, rendered: camera, light sheet and points against the truth.

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

from armscan.cli import main
from armscan.jobs.twin.demo import FILES, RECORDINGS, TRUTH, DemoRequest, run_photo_demo
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.simulate import TwinName
from armscan.simulation.twin import SimulatedInstrument
from armscan.storage.documents import read_sensor_calibration

SEED = 2
FOUR_SIGMA = 2.0 * stats.norm.sf(4.0)
STRIPE_PX = 0.1
"""Stripe noise after speckle of contrast 0.2 on a line of sigma 1 px, systematic parts included."""
DEPTH_MM_PER_PX = 137.0 / 5150.0 / 0.9
"""Distance over focal length, over the tangent between camera ray and sheet."""


@dataclass(frozen=True)
class Measured:
    folder: Path
    data: dict[str, Any]
    errors: Any
    sensor: SensorCalibration


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """The demo's whole chain, through its documents, on some of its photographs."""
    folder = tmp_path_factory.mktemp("photos") / "demo"
    few = {"camera": 8, "laser": 6}
    run_photo_demo(DemoRequest(folder, seed=SEED, most_views=few, processes=1))
    data = json.loads((folder / "summary.json").read_text())
    return Measured(folder, data, data["errors"], read_sensor_calibration(folder / "sensor.json"))


def test_every_photo_is_used_and_every_file_written(measured: Measured) -> None:
    camera, sheet = measured.data["camera"], measured.sensor.sheets[0]
    assert camera["not_found"] == []
    assert camera["n_points"] == 8 * 99
    assert sheet.n_boards == 6
    assert measured.data["simulated"] is True
    assert {path.name for path in measured.folder.iterdir()} == {
        *(RECORDINGS, TRUTH, FILES, "summary.json", "cloud.ply", "cloud.html"),
        *(f"{name}.{end}" for name in ("camera", "sensor") for end in ("json", "npz", "html")),
    }
    for page in ("camera.html", "sensor.html", "cloud.html"):
        assert "simulated" in (measured.folder / page).read_text().lower()


def test_camera_errors_are_what_its_covariance_says(measured: Measured) -> None:
    errors = measured.errors
    assert abs(errors["focal_px"]) < 4.0 * errors["focal_sigma_px"]
    limit = stats.chi2.isf(FOUR_SIGMA, errors["n_camera_parameters"])
    assert errors["camera_normalised"] ** 2 < limit


def test_camera_projects_as_the_simulators_own_lens(measured: Measured) -> None:
    twin = TwinName("thesis-single", "thesis", SEED).build()
    assert isinstance(twin, SimulatedInstrument)
    lens = twin.instrument.head.camera
    x, y, z = np.meshgrid(np.linspace(-15, 15, 5), np.linspace(-10, 10, 4), [130.0, 150.0])
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    camera = measured.sensor.camera
    projected, _, by_parameters = camera.camera.project_with_jacobian(points)
    difference = projected - lens.project(points)
    covariance = by_parameters @ camera.covariance @ np.swapaxes(by_parameters, 1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    assert np.abs(difference / sigma).max() < 4.5


def test_sheet_errors_are_what_its_covariance_says(measured: Measured) -> None:
    sheet = measured.errors["sheet"]
    # a target true to 0.3 um misses the thesis's sheet by up to 4 of its own sigmas
    assert sheet["normalised"] ** 2 < 2.0 * stats.chi2.isf(FOUR_SIGMA, sheet["n_parameters"])
    assert sheet["rms_mm"] < 2.0 * STRIPE_PX * DEPTH_MM_PER_PX
    assert sheet["angle_deg"] < 0.03


def test_points_lie_on_the_part_within_their_sigmas(measured: Measured) -> None:
    errors = measured.errors
    assert errors["n_on_object"] > 1000
    assert errors["n_on_object"] > 0.98 * errors["n_points"]
    assert errors["points_median_mm"] < STRIPE_PX * DEPTH_MM_PER_PX * 3.0
    assert errors["points_within_2_sigma"] > 0.85
    assert 0.3 < errors["points_normalised_rms"] < 1.6


def test_a_folder_with_other_files_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    assert main(["demo", "photos", "-o", str(tmp_path)]) == 2
    assert "thesis.txt" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
