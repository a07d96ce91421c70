# SPDX-License-Identifier: Apache-2.0
"""The demo of the arm scanner with few exposures: files, figures, errors within their sigmas."""

from __future__ import annotations

import hashlib
import json
import math
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from armscan.cli.run import main
from armscan.devices.sources import TwinScene
from armscan.jobs.twin.demo import FILES, RECORDINGS, TRUTH, DemoRequest, run_head_demo
from armscan.report.quantity import Summary
from armscan.storage.clouds import read_ply
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.recording import read_recording

FEW: dict[TwinScene, int] = {
    "camera": 4,
    "laser": 4,
    "hand-eye": 7,
    "plate": 2,
    "ball": 8,
    "steps": 4,
    "part": 2,
}
HEAD = "thesis-single"
TUTORIAL = Path(__file__).parents[2] / "docs/tutorials/02-hand-eye-on-real-robot-data.md"
CHI_6_IN_999 = math.sqrt(22.46)
"""Length of six standard normal numbers that one in a thousand exceeds."""


@dataclass(frozen=True)
class Done:
    folder: Path
    summary: Summary
    head: Any


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp("single") / "demo"
    summary = run_head_demo(DemoRequest(folder, HEAD, seed=3, most_views=FEW, processes=1))
    content = json.loads((folder / "summary.json").read_text("utf-8"))
    return Done(folder, summary, content["heads"][HEAD])


DOCUMENTS = ("camera", "sensor", "scanner")


def test_everything_is_written_and_nothing_else(demo: Done) -> None:
    assert {path.name for path in demo.folder.iterdir()} == {
        RECORDINGS,
        TRUTH,
        FILES,
        *(f"{name}.{end}" for name in DOCUMENTS for end in ("json", "npz", "html")),
        "plate.csv",
        *("cloud.ply", "report.html", "summary.json"),
    }
    scanner = read_scanner_calibration(demo.folder / "scanner.json")
    assert scanner.provenance.parent_ids == (scanner.sensor.provenance.document_id,)
    assert read_ply(demo.folder / "cloud.ply").frame == "Base"
    recording = read_recording(demo.folder / "recordings" / "hand-eye")
    assert recording.is_simulated
    assert len({row.view for row in recording.rows}) == 7


def test_documents_name_files_where_they_lie(demo: Done) -> None:
    scanner = read_scanner_calibration(demo.folder / "scanner.json")
    for item in (*scanner.provenance.inputs, *scanner.sensor.camera.provenance.inputs):
        path = Path(item.path)
        assert path.is_relative_to(demo.folder)
        assert hashlib.sha256(path.read_bytes()).hexdigest() == item.sha256
    assert [path.name for path in demo.folder.parent.iterdir()] == [demo.folder.name]


def test_the_summary_has_the_layout_that_programs_rely_on(demo: Done) -> None:
    content = json.loads((demo.folder / "summary.json").read_text("utf-8"))
    assert content["simulated"] is True
    assert (content["seed"], content["preset"]) == (3, "thesis")
    head = demo.head
    assert set(head["camera"][0]) == {"rms_px"}
    assert set(head["sheets"][0]) == {"name", "rms_mm"}
    assert {"rotation_error_deg", "translation_error_mm"} < set(head["hand_eye"])
    assert {"sigma_rotation_deg", "sigma_translation_mm"} < set(head["hand_eye"])
    within = {"n_points", "n_measured", "n_beyond_1mm", "fraction_within_0p05mm", "reference"}
    assert within | {"fraction_within_0p08mm"} < set(head["plate"])
    assert within | {"diameter_mm", "diameter_error_mm"} < set(head["sphere"])
    for step in head["steps"]:
        assert {"nominal_mm", "mean_mm", "std_mm", "fitted_sigma_mm", "frame"} <= set(step)
        assert 0 < step["n_points"] < step["n_measured"]
    assert {"rms_mm", "fraction_within_0p05mm"} <= set(head["part"])
    for part in (head["plate"], head["sphere"], head["part"]):
        assert part["n_measured"] - part["n_beyond_1mm"] == part["n_points"] > 0
    assert head["part"]["n_measured"] == len(read_ply(demo.folder / "cloud.ply"))
    assert head["named_stripes_per_exposure"] == pytest.approx(1.0, abs=0.1)
    assert head["points_per_exposure"] > 300
    assert all(value >= 0.0 for value in head["seconds"].values())
    assert not [key for key in _keys(content) if "." in key]
    assert (head["plate"]["reference"], head["sphere"]["reference"]) == ("fitted", "nominal")


def _keys(content: Any) -> list[str]:
    if isinstance(content, list):
        return [key for item in content for key in _keys(item)]
    if isinstance(content, dict):
        return [*content, *(key for item in content.values() for key in _keys(item))]
    return []


def test_the_hand_eye_errs_as_its_covariance_says(demo: Done) -> None:
    hand_eye = demo.head["hand_eye"]
    assert hand_eye["normalised_error"] < CHI_6_IN_999
    assert hand_eye["sigma_translation_mm"] < 0.2


def test_things_measure_what_they_are(demo: Done) -> None:
    head = demo.head
    assert head["plate"]["fraction_within_0p05mm"] > 0.995
    sphere = head["sphere"]
    assert abs(sphere["diameter_error_mm"]) < 4.0 * sphere["diameter_sigma_mm"] < 0.4
    for step in head["steps"]:
        # one exposure states no sigma: its mean errs by less than its points scatter
        sigma = step["fitted_sigma_mm"] if step["frame"] == "Base" else step["std_mm"]
        assert abs(step["fitted_mm"] - step["nominal_mm"]) < 4.0 * sigma
        assert abs(step["mean_mm"] - step["fitted_mm"]) < step["std_mm"] < 0.015
    assert head["part"]["normalised_rms"] < 1.5


def tutorial_commands() -> list[list[str]]:
    """What the second tutorial types after its demo, in its order."""
    text = TUTORIAL.read_text("utf-8").partition("## The same on a simulated arm")[2]
    blocks = re.findall(r"^```\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    assert lines[0] == "armscan demo single -o demo"
    return [shlex.split(line)[1:] for line in lines[1:]]


def test_the_second_tutorial_measures_the_ball(
    demo: Done,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Typed as the page shows it: nothing is named that no command before it wrote."""
    shutil.copytree(demo.folder, tmp_path / "demo")
    monkeypatch.chdir(tmp_path)
    commands = tutorial_commands()
    assert [words[0] for words in commands] == [
        *("calibrate", "calibrate", "probe", "calibrate", "reconstruct", "inspect"),
    ]
    for words in commands[:-1]:
        assert main(words) == 0, capsys.readouterr().err
    capsys.readouterr()
    assert main([*commands[-1], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert abs(found["diameter_error_mm"]) < 0.1
    scanner = read_scanner_calibration(Path("twin-scanner.json"))
    by_demo = read_scanner_calibration(demo.folder / "scanner.json")
    shift = (
        scanner.hand_eye.tool_from_sensor.translation_mm
        - by_demo.hand_eye.tool_from_sensor.translation_mm
    )
    assert float(abs(shift).max()) < 0.05


def test_the_page_shows_the_chain_and_says_that_it_is_simulated(demo: Done) -> None:
    page = (demo.folder / "report.html").read_text("utf-8")
    assert "simulated data" in page
    for scene in ("camera", "hand-eye", "still-step"):
        assert f'<p class="figure-title">{scene}</p>' in page
    assert page.count("<canvas") == 2
    assert "<canvas" in (demo.folder / "scanner.html").read_text("utf-8")
    for part in (demo.head["plate"], demo.head["sphere"], demo.head["part"]):
        assert f"measured, {part['n_beyond_1mm']:,} beyond 1 mm" in page
    for word in ("5.12", "5.14", "5.19", "97.9 %", "armscan calibrate hand-eye"):
        assert word in page
