# SPDX-License-Identifier: Apache-2.0
"""Title block, age of the calibration, and the page as PDF."""

from __future__ import annotations

import json
import math
import socket
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from armscan.cli import main
from armscan.errors import OptionError
from armscan.inspection.title_block import TitleBlock, calibration_state
from armscan.records.cloud import CalibrationMark
from armscan.report.drawing import _turned
from armscan.report.inspection.delivery import (
    age_text,
    calibration_warnings,
    pdf_bytes,
    require_pdf,
)
from armscan.storage.clouds import ply_bytes
from armscan.storage.documents import scanner_document
from rigs.calibration_documents import scanner_calibration
from rigs.inspection_clouds import cloud_of


def skip_without_pdf() -> None:
    try:
        require_pdf()
    except OptionError as error:
        pytest.skip(f"no PDF here: {error.what}")


NOW = datetime(2026, 11, 23, 12, tzinfo=UTC)
MAY = CalibrationMark("may", "2026-05-27T12:00:00+00:00")
JUNE = CalibrationMark("june", "2026-06-26T14:00:00+02:00")
UNDATED = CalibrationMark("foreign")
FUTURE = CalibrationMark("future", "2026-12-01T00:00:00+00:00")


@pytest.mark.parametrize(
    ("marks", "valid_days", "age", "is_valid"),
    [
        ((JUNE,), 150.0, 150.0, True),
        ((JUNE,), 149.99, 150.0, False),
        ((JUNE, MAY), 179.0, 180.0, False),
        ((JUNE,), math.nan, 150.0, None),
        ((UNDATED,), 150.0, math.nan, None),
        ((JUNE, UNDATED), 150.0, math.nan, None),
        ((FUTURE,), 150.0, -7.5, None),
        ((), 150.0, math.nan, None),
    ],
)
def test_a_calibration_holds_as_long_as_laid_down_and_the_oldest_counts(
    marks: tuple[CalibrationMark, ...], valid_days: float, age: float, is_valid: bool | None
) -> None:
    block = TitleBlock(calibration_valid_days=valid_days)
    state = calibration_state(block, marks, NOW)
    np.testing.assert_allclose(state.age_days, age, atol=1e-9)
    assert state.is_valid is is_valid
    is_odd = is_valid is False or age < 0.0 or (math.isnan(age) and not math.isnan(valid_days))
    assert bool(calibration_warnings(block, state)) is is_odd


@pytest.mark.parametrize("valid_days", [149.0, 150.0])
def test_an_age_that_is_over_never_reads_as_the_limit(valid_days: float) -> None:
    block = TitleBlock(calibration_valid_days=valid_days)
    state = calibration_state(block, (JUNE,), NOW + timedelta(hours=3))
    limit = f"laid down to hold for {valid_days:.0f} days"
    (told,) = calibration_warnings(block, state)
    assert f"151 days old and was {limit}" in told
    assert age_text(state) == f"151 days old, {limit}: no longer valid"


def test_a_cloud_of_another_head_is_told() -> None:
    block = TitleBlock(scanner=MAY, scanner_name="scanner.json")
    assert calibration_state(block, (MAY,), NOW).is_of_scanner is True
    assert calibration_state(block, (MAY, JUNE), NOW).is_of_scanner is False
    silent = calibration_state(block, (), NOW)
    assert (silent.is_of_scanner, silent.is_of_cloud, silent.marks) == (None, False, (MAY,))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate measured with a calibration of 2020, and the document of another."""
    folder = tmp_path_factory.mktemp("delivery")
    random = np.random.default_rng(3)
    points = np.column_stack([random.uniform(-40, 40, (4000, 2)), random.normal(0, 0.01, 4000)])
    cloud = cloud_of(points, random.integers(0, 9, 4000), normals=np.tile([0.0, 0, 1], (4000, 1)))
    old = CalibrationMark("old", "2020-01-01T00:00:00+00:00")
    (folder / "plate.ply").write_bytes(ply_bytes(replace(cloud, calibrations=(old,))))
    (folder / "scanner.json").write_bytes(scanner_document(scanner_calibration()))
    (folder / "ours.toml").write_text(
        'customer = "Müller & Söhne"\nscanner = "scanner.json"\ncalibration_valid_days = 365\n'
    )
    return folder


def test_title_block_and_age_are_on_page_terminal_and_json(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["inspect", "plane", str(folder / "plate.ply"), "--title-block", "serial=00<12>"]
    words += ["--title-block", str(folder / "ours.toml"), "-o", str(folder / "p.html"), "--force"]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["title_block"] == {"serial": "00<12>", "customer": "Müller & Söhne"}
    assert told["calibration"]["documents"] == ["old"]
    assert told["calibration"]["is_valid"] is False
    assert told["calibration"]["is_of_scanner"] is False
    assert told["calibration"]["age_days"] > 2500
    assert len(told["warnings"]) == 2
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "Müller & Söhne" in text and "no longer valid" in text
    page = (folder / "p.html").read_text()
    for part in ("00&lt;12&gt;", "Müller &amp; Söhne", "no longer valid", "another head"):
        assert part in page


@pytest.mark.parametrize(
    "words",
    [
        ("--title-block", "colour=red"),
        ("--title-block", "0012"),
        ("--title-block", "calibration_valid_days=0"),
        ("--title-block", "calibration_valid_days=soon"),
        ("--title-block", "scanner=missing.json"),
        ("--title-block", "missing.toml"),
        ("--title-block", "remark=" + 300 * "a"),
        ("--pdf", "report.doc"),
        ("--pdf", "nowhere/report.pdf"),
    ],
)
def test_a_wrong_title_block_is_refused_before_anything_is_written(
    folder: Path, tmp_path: Path, words: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    assert main(["inspect", "plane", str(folder / "plate.ply"), "-o", str(page), *words]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert not list(tmp_path.iterdir())


def test_a_pdf_without_a_page_is_refused(folder: Path, tmp_path: Path) -> None:
    pdf = tmp_path / "report.pdf"
    assert main(["inspect", "plane", str(folder / "plate.ply"), "--pdf", str(pdf)]) == 2
    assert not pdf.exists()


def test_the_page_is_written_as_pdf(folder: Path, tmp_path: Path) -> None:
    skip_without_pdf()
    page, pdf = tmp_path / "report.html", tmp_path / "report.pdf"
    words = ["inspect", "plane", str(folder / "plate.ply"), "-o", str(page), "--pdf", str(pdf)]
    assert main(words) == 0
    assert pdf.read_bytes().startswith(b"%PDF-")
    assert main(words) == 2, "an existing PDF is not replaced without --force"


def test_a_pdf_asks_no_other_host() -> None:
    skip_without_pdf()
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/x"
        page = f'<link rel="stylesheet" href="{address}.css"><img src="{address}.png">text'
        assert pdf_bytes(page.encode()).startswith(b"%PDF-")
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.parametrize("is_z_up", [True, False])
def test_the_picture_of_a_scene_is_turned_and_not_stretched(is_z_up: bool) -> None:
    axes = _turned(np.eye(3), is_z_up=is_z_up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    # z points up on the page, or in Sensor y down
    assert (axes[2, 1] < -0.8) if is_z_up else (axes[1, 1] > 0.8)
