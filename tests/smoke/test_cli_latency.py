# SPDX-License-Identifier: Apache-2.0
"""Latency on the command line: images of a plate, the head moved nearer and away."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.storage.clouds import read_ply
from armscan.storage.documents import observations_of, read_scanner_calibration
from rigs.drawn_arm import LATENCY_NS, PLANE, draw_bounce, draw_postures
from rigs.drawn_bench import Bench

Fails = Callable[..., str]


@pytest.fixture(scope="module")
def scanner(calibrated: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("latency")
    draw_postures(folder / "postures")
    output = folder / "scanner.json"
    words = ["calibrate", "hand-eye", folder / "postures", "--sensor", calibrated.sensor]
    assert main([str(word) for word in (*words, "--plane", PLANE, "-o", output)]) == 0
    return output


@pytest.fixture(scope="module")
def moved(scanner: Path) -> Path:
    folder = scanner.parent / "moved"
    draw_bounce(folder, seconds=4.0)
    return folder


def words_of(scan: Path, scanner: Path, output: Path) -> list[str]:
    return ["calibrate", "latency", str(scan), "--scanner", str(scanner), "-o", str(output)]


def copy_of(scan: Path, folder: Path) -> Path:
    shutil.copytree(scan, folder)
    return folder


def test_the_latency_is_found_and_used(
    scanner: Path, moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "timed.json"
    assert main([*words_of(moved, scanner, output), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert abs(data["latency_ns"] - LATENCY_NS) < 4.0 * data["latency_sigma_ns"]
    assert data["latency_sigma_ns"] < 100_000
    before, after = read_scanner_calibration(scanner), read_scanner_calibration(output)
    assert (before.latency_ns, after.latency_ns) == (0, data["latency_ns"])
    assert after.latency_sigma_ns == data["latency_sigma_ns"]
    assert after.provenance.parent_ids == (before.provenance.document_id,)
    assert output.with_suffix(".html").stat().st_size > 10_000
    # what the hand-eye rests on goes with the new document
    assert observations_of(output).read_bytes() == observations_of(scanner).read_bytes()
    flat = []
    for document in (scanner, output):
        cloud = tmp_path / f"cloud-{document.stem}.ply"
        words = ["reconstruct", str(moved), "--scanner", str(document), "-o", str(cloud)]
        assert main(words) == 0
        points = read_ply(cloud).points_mm
        flat.append(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2])
    assert flat[1] < 0.25 * flat[0]


def test_info_tells_the_latency(
    scanner: Path, moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "timed.json"
    assert main(words_of(moved, scanner, output)) == 0
    capsys.readouterr()
    assert main(["info", str(output), "--json"]) == 0
    assert '"latency_sigma_ns"' in capsys.readouterr().out


@pytest.mark.parametrize(("change", "is_told"), [("missing", False), ("changed", True)])
def test_observations_that_are_not_the_documents_own_are_left_out_and_told(
    scanner: Path,
    moved: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    *,
    change: str,
    is_told: bool,
) -> None:
    """None at all is what many documents have; others than it was solved from are odd."""
    (tmp_path / "scanner.json").write_bytes(scanner.read_bytes())
    if change == "changed":
        (tmp_path / "scanner.npz").write_bytes(b"other" + observations_of(scanner).read_bytes())
    output = tmp_path / "timed.json"
    assert main([*words_of(moved, tmp_path / "scanner.json", output), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    said = "are not the observations that scanner.json was solved from"
    assert any(said in text for text in data["warnings"]) is is_told
    assert (said in output.with_suffix(".html").read_text()) is is_told
    noted = read_scanner_calibration(output).provenance.warnings
    assert any(said in text for text in noted) is is_told
    assert not output.with_suffix(".npz").exists()


def test_separate_clocks_are_told_and_nothing_is_written(
    scanner: Path, moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copy_of(moved, tmp_path / "separate")
    session = folder / "session.toml"
    session.write_text(session.read_text().replace('"shared"', '"separate"'))
    head, *rows = (folder / "arm.csv").read_text().splitlines()
    shifted = [f"{int(row.split(',', 1)[0]) + 10**14},{row.split(',', 1)[1]}" for row in rows]
    (folder / "arm.csv").write_text("\n".join([head, *shifted]) + "\n")
    output = tmp_path / "timed.json"
    assert main([*words_of(folder, scanner, output), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert abs(data["latency_ns"] - LATENCY_NS - 10**14) < 4.0 * data["latency_sigma_ns"]
    assert not output.exists()
    assert any("nothing is written" in text for text in data["warnings"])


def test_too_little_is_refused(scanner: Path, moved: Path, tmp_path: Path, fails: Fails) -> None:
    folder = copy_of(moved, tmp_path / "short")
    lines = (folder / "exposures.csv").read_text().splitlines()
    (folder / "exposures.csv").write_text("\n".join(lines[:41]) + "\n")
    output = tmp_path / "timed.json"
    error = fails(*words_of(folder, scanner, output), writes=tmp_path)
    assert "40 exposures" in error and "60 are needed" in error


def test_bad_input_is_refused(
    scanner: Path, moved: Path, tmp_path: Path, calibrated: Bench, fails: Fails
) -> None:
    output = tmp_path / "timed.json"
    fails(*words_of(tmp_path / "none", scanner, output), writes=tmp_path)
    fails(*words_of(moved, calibrated.sensor, output), writes=tmp_path)
    fails(*words_of(moved, scanner, tmp_path / "timed.txt"), writes=tmp_path)
