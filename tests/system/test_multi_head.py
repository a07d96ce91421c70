# SPDX-License-Identifier: Apache-2.0
"""Five lines and two cameras from rendered images: calibrated, placed, named as the truth says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import PlaneInspection
from armscan.jobs.twin.demo import Calibrated, DemoRequest, calibrate_head
from armscan.pipeline.scan import ScanReconstruction, measure_scan
from armscan.pipeline.simulate import TwinName, fewer_views
from armscan.pipeline.truth import hand_eye_errors, naming_errors, sheet_errors, true_names

HEAD, SEED = "thesis-multi-5", 4
TWIN = TwinName(HEAD, "thesis", SEED).build()
FEW = {"camera": 8, "laser": 8, "hand-eye": 6}
CHI_6_IN_999 = math.sqrt(22.46)


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    folder = tmp_path_factory.mktemp("multi")
    request = DemoRequest(folder, HEAD, SEED, most_views=FEW, processes=1)
    return calibrate_head(request, "multi", folder)


@pytest.fixture(scope="module")
def steps(instrument: Calibrated) -> ScanReconstruction:
    return measure_scan(fewer_views(TWIN.scan("steps"), 3), instrument.scanner)


def test_all_five_lines_are_found_and_lie_where_they_are(instrument: Calibrated) -> None:
    sensor = instrument.sensor
    assert sensor.second is not None
    assert [sheet.name for sheet in sensor.sheets] == [f"A.{k}" for k in range(1, 6)]
    truth = TWIN.truth.sheet_points_mm
    assert true_names(sensor, truth) == {name: name for name in truth}
    for k, sheet in enumerate(sensor.sheets):
        low, high = sheet.depth_range_mm
        points = truth[sheet.name]
        inside = points[(points[:, 2] > low) & (points[:, 2] < high)]
        own = sensor.sheet_parameter_slice(k)
        errors = sheet_errors(sheet, sensor.covariance[own, own], inside)
        assert errors.rms_mm < 0.008, sheet.name


def test_the_hand_eye_errs_as_its_covariance_says(instrument: Calibrated) -> None:
    errors = hand_eye_errors(instrument.scanner, TWIN.truth.tool_from_sensor)
    assert errors.normalised < CHI_6_IN_999
    assert errors.translation_mm < 0.1


def test_stripes_bear_the_names_of_the_sheets_that_drew_them(
    instrument: Calibrated, steps: ScanReconstruction
) -> None:
    names = true_names(instrument.sensor, TWIN.truth.sheet_points_mm)
    found = naming_errors(steps, TWIN.scan("steps"), names)
    assert found.n_instants == 3
    assert found.n_named > 5_000
    assert found.wrong_share < 0.001
    assert found.named_share > 0.95
    assert found.n_stripes_named >= 0.9 * found.n_stripes_in_view


def test_wrong_names_are_noticed(instrument: Calibrated, steps: ScanReconstruction) -> None:
    """The comparison itself: names shifted by one are all wrong."""
    names = {f"A.{k}": f"A.{k % 5 + 1}" for k in range(1, 6)}
    assert naming_errors(steps, TWIN.scan("steps"), names).wrong_share > 0.9


def test_the_plate_is_flat_and_where_it_was_probed(instrument: Calibrated) -> None:
    scan = measure_scan(fewer_views(TWIN.scan("plate"), 2), instrument.scanner)
    plane = inspect_plane(scan.cloud, instrument.plate.plane)
    assert isinstance(plane, PlaneInspection)
    assert np.mean(np.abs(plane.fitted.deviations_mm) < 0.05) > 0.99
    times = {scan.exposures[row].row.t_ns for row in scan.image_rows}
    assert (len(times), len(scan.images)) == (2, 4)
