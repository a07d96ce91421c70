# SPDX-License-Identifier: Apache-2.0
"""The demo of crossed lines with few exposures: lasers chosen meanwhile, names, figures, files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.devices.sources import TwinScene
from armscan.jobs.twin.demo import DemoRequest, run_head_demo
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.storage.clouds import read_ply
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.recording import read_recording

HEAD = "thesis-cross"
FEW: dict[TwinScene, int] = {
    "camera": 6,
    "laser": 5,
    "hand-eye": 6,
    "plate": 5,
    "ball": 4,
    "steps": 12,
    "part": 3,
    "waves": 5,
}
"""Views of the calibrations; of the scans, exposures of each stroke."""


@dataclass(frozen=True)
class Done:
    folder: Path
    head: Any


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp("cross") / "demo"
    run_head_demo(DemoRequest(folder, HEAD, seed=3, most_views=FEW, processes=1))
    content = json.loads((folder / "summary.json").read_text("utf-8"))
    return Done(folder, content["heads"][HEAD])


def test_recordings_say_which_lasers_were_on(demo: Done) -> None:
    """A stroke begins with one laser alone; then both stay on."""
    rows = read_recording(demo.folder / "recordings" / "plate").rows
    assert rows[0].lasers == ("A",)
    n_both = sum(row.lasers == ("A", "B") for row in rows)
    assert n_both >= 0.7 * len(rows)
    assert {row.lasers for row in rows} <= {("A",), ("B",), ("A", "B")}


def test_a_recording_is_measured_again_as_it_was(demo: Done) -> None:
    scanner = read_scanner_calibration(demo.folder / "scanner.json")
    recording = read_recording(demo.folder / "recordings" / "part")
    again = measure_scan(recording, scanner, ScanOptions(has_normals=False)).cloud
    kept = read_ply(demo.folder / "cloud.ply")
    np.testing.assert_array_equal(again.sheet, kept.sheet)
    np.testing.assert_allclose(again.points_mm, kept.points_mm, atol=1e-6)


def test_no_stripe_bears_the_wrong_name(demo: Done) -> None:
    naming = demo.head["naming"]
    assert set(naming) == {"plate", "ball", "steps", "part", "waves"}
    assert sum(found["n_named"] for found in naming.values()) > 10_000
    assert sum(found["n_wrong"] for found in naming.values()) == 0
    assert 1.4 < demo.head["named_stripes_per_exposure"] <= 2.0


def test_things_measure_what_they_are(demo: Done) -> None:
    head = demo.head
    assert [sheet["name"] for sheet in head["sheets"]] == ["A", "B"]
    assert head["plate"]["fraction_within_0p05mm"] > 0.99
    sphere = head["sphere"]
    assert abs(sphere["diameter_error_mm"]) < 4.0 * sphere["diameter_sigma_mm"]
    for step in head["steps"]:
        assert abs(step["fitted_mm"] - step["nominal_mm"]) < 0.03


def test_the_page_shows_the_names(demo: Done) -> None:
    page = (demo.folder / "report.html").read_text("utf-8")
    assert "The names of the stripes" in page
    assert "A cross-line scanner on a measuring arm" in page
