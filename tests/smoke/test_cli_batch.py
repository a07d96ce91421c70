# SPDX-License-Identifier: Apache-2.0
"""``armscan reconstruct`` of a folder of scans: each once, whatever ends it in between."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.cli import main
from armscan.errors import OptionError
from armscan.jobs import reconstruct as module
from armscan.storage.clouds import read_ply
from armscan.storage.documents import scanner_document
from armscan.storage.recording import write_recording
from armscan.storage.recordings.read_mcap import record_folder
from rigs.scan_fake import as_source, fake_scan, scanner

Run = Callable[..., tuple[int, dict[str, Any]]]
N = 6


@pytest.fixture
def week(tmp_path: Path) -> Path:
    """Scans a and b of one scanner, c whose end is missing, and something else."""
    week = tmp_path / "week"
    week.mkdir()
    write_recording(week / "a", as_source(fake_scan(N)))
    write_recording(tmp_path / "b", as_source(fake_scan(N + 2)))
    record_folder(tmp_path / "b", week / "b.mcap")
    (week / "c.mcap").write_bytes((week / "b.mcap").read_bytes()[:-30])
    (week / "notes.txt").write_text("two parts\n")
    (tmp_path / "scanner.json").write_bytes(scanner_document(scanner()))
    return week


@pytest.fixture
def run(week: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*more: str) -> tuple[int, dict[str, Any]]:
        place = week.parent
        words = [str(week), "--scanner", str(place / "scanner.json"), "-o", str(place / "clouds")]
        code = main(["reconstruct", *words, "--json", *more])
        out = capsys.readouterr().out
        return code, json.loads(out) if out else {}

    return run


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the scans that are measured; one that is called so is interrupted."""
    names: list[str] = []
    real = module._scan

    def scan(job: Any, calibration: Path, folder: Path, *given: Any, **named: Any) -> Any:
        names.append(folder.stem)
        if names.count("interrupted") and folder.stem == "b":
            names.clear()
            raise KeyboardInterrupt
        return real(job, calibration, folder, *given, **named)

    monkeypatch.setattr(module, "_scan", scan)
    return names


def test_each_scan_is_measured_once_and_a_failure_ends_no_other(
    week: Path, run: Run, measured: list[str]
) -> None:
    code, told = run()
    assert code == 2 and measured == ["a", "b", "c"]
    clouds = week.parent / "clouds"
    kept = {path.name for path in clouds.iterdir()} - {"armscan-cache"}
    assert kept == {"a.ply", "a.html", "b.ply", "b.html", "batch.json"}
    scans = told["scans"]
    assert told["n_failed"] == 1 and "armscan recover" in scans["c"]["failed"]
    for name in "ab":
        assert scans[name]["data"]["n_points"] == len(read_ply(clouds / f"{name}.ply")) > 500
    before = (clouds / "a.ply").read_bytes()
    measured.clear()
    code, told = run("--force")
    assert code == 2 and measured == ["c"] and told["scans"]["a"]["is_old"]
    (week / "c.mcap").write_bytes((week / "b.mcap").read_bytes())
    measured.clear()
    assert run()[0] == 0 and measured == ["c"]
    assert (clouds / "a.ply").read_bytes() == before
    alone = week.parent / "alone.ply"
    words = ["reconstruct", str(week / "a"), "--scanner", str(week.parent / "scanner.json")]
    assert main([*words, "-o", str(alone)]) == 0
    np.testing.assert_array_equal(read_ply(alone).points_mm, read_ply(clouds / "a.ply").points_mm)


def test_after_an_interrupt_what_is_done_is_not_done_again(
    week: Path, run: Run, measured: list[str]
) -> None:
    measured.append("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr("armscan.cli.reconstruct.typer.echo", lambda line, **_: said.append(line))
        assert run()[0] == 130
    told_first, told_last = (line for line in said if " of 3 " in line)
    assert re.fullmatch(r"1 of 3  a: done  \([\d.]+ exposures/s, [\d.]+ min left\)", told_first)
    assert told_last == "1 of 3 are through; the same command goes on"
    code, told = run()
    assert code == 2 and measured == ["b", "c"]
    assert told["scans"]["a"]["is_old"] and "is_old" not in told["scans"]["b"]


def test_a_result_of_other_inputs_is_replaced_only_by_force(
    week: Path, run: Run, measured: list[str]
) -> None:
    run()
    cloud = week.parent / "clouds" / "a.ply"
    before = cloud.read_bytes()
    table = week / "a" / "exposures.csv"
    whole = table.read_text()
    table.write_text(whole.rsplit("\n", 2)[0] + "\n")
    for _ in range(2):  # to be refused once is not to be owned then
        measured.clear()
        code, told = run()
        assert code == 2 and measured == ["c"] and "--force" in told["scans"]["a"]["failed"]
        assert cloud.read_bytes() == before
    table.write_text(whole)
    assert run()[1]["scans"]["a"]["is_old"]
    image = next((week / "a").rglob("*.png"))
    image.write_bytes(image.read_bytes())
    assert "--force" in run()[1]["scans"]["a"]["failed"]
    measured.clear()
    assert "data" in run("--force")[1]["scans"]["a"] and measured == ["a", "c"]


def test_a_result_that_was_changed_since_is_replaced_only_by_force(
    week: Path, run: Run, measured: list[str]
) -> None:
    run()
    cloud = week.parent / "clouds" / "a.ply"
    made = cloud.read_bytes()
    cloud.write_bytes(b"cut by hand")
    for _ in range(2):
        measured.clear()
        told = run()[1]["scans"]["a"]
        assert told["failed"] == "a.ply was changed since it was made; --force replaces it"
        assert cloud.read_bytes() == b"cut by hand" and measured == ["c"]
    assert "data" in run("--force")[1]["scans"]["a"]
    assert len(cloud.read_bytes()) == len(made) and run()[1]["scans"]["a"]["is_old"]
    cloud.unlink()
    assert "data" in run()[1]["scans"]["a"]


def test_a_page_that_is_left_ends_no_other(week: Path, run: Run, measured: list[str]) -> None:
    clouds = week.parent / "clouds"
    clouds.mkdir()
    (clouds / "a.html").write_text("mine")
    told = run()[1]["scans"]
    assert "a.html exists" in told["a"]["failed"] and measured == ["b", "c"]
    assert (clouds / "a.html").read_text() == "mine" and "data" in told["b"]


def test_what_is_hidden_is_no_recording(week: Path, run: Run, measured: list[str]) -> None:
    for name in ("._a.mcap", ".scan.123.part", "._photo.png"):
        (week / name).write_bytes(b"\0")
    (week / ".trash").mkdir()
    (week / ".trash" / "exposures.csv").write_text("index\n")
    assert set(run()[1]["scans"]) == {"a", "b", "c"}


def test_images_beside_recordings_are_told_of(
    week: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    (week / "photo.png").write_bytes(b"")
    scanner_file = str(week.parent / "scanner.json")
    assert main(["reconstruct", str(week), "--scanner", scanner_file, "-o", "clouds"]) == 2
    assert "image photo.png lies beside the recording a" in capsys.readouterr().err


def test_what_is_wrong_for_all_is_said_once(
    week: Path, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scanner_file = str(week.parent / "scanner.json")
    assert main(["reconstruct", str(week), "--scanner", scanner_file, "-o", "x.ply"]) == 2
    assert "-o clouds" in capsys.readouterr().err

    def lost(*_: Any, **__: Any) -> None:
        raise OptionError("the cluster's workers were lost", where="--cluster tcp://h:1")

    monkeypatch.setattr(module, "_scan", lost)
    assert run()[0] == 2
    ledger = json.loads((week.parent / "clouds" / "batch.json").read_text())
    assert list(ledger["results"]) == ["a"] and "data" not in ledger["results"]["a"]


def test_a_second_batch_into_one_folder_is_refused_while_the_first_runs(
    week: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another process has the folder; killed, it leaves it free."""
    clouds = week.parent / "clouds"
    clouds.mkdir()
    program = (
        "import sys; from pathlib import Path; from armscan.storage.files import sole_writer\n"
        "with sole_writer(Path(sys.argv[1])):\n"
        "    print('held', flush=True); sys.stdin.read()"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", program, str(clouds)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with first:
        assert first.stdout is not None and first.stdout.readline() == b"held\n"
        scanner_file = str(week.parent / "scanner.json")
        words = ["reconstruct", str(week), "--scanner", scanner_file, "-o", str(clouds)]
        assert main(words) == 2
        assert "another run writes into this folder" in capsys.readouterr().err
        assert list(clouds.iterdir()) == []
        first.kill()
    assert "data" in run()[1]["scans"]["a"]


@pytest.mark.parametrize(
    "content",
    [
        b"{}",
        b'{"results": []}',
        b'{"results": {"a": 3}}',
        b'{"results": {"a": {"mark": "x", "data": [1]}}}',
        b'{"results": {}, "jobs": 3}',
    ],
)
def test_a_file_of_another_program_with_the_ledger_s_name_is_left(
    content: bytes, week: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    clouds = week.parent / "clouds"
    clouds.mkdir()
    (clouds / "batch.json").write_bytes(content)
    scanner_file = str(week.parent / "scanner.json")
    words = ["reconstruct", str(week), "--scanner", scanner_file, "-o", str(clouds)]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "this is not the list of a batch's results" in said and "batch.json" in said
    assert [path.name for path in clouds.iterdir()] == ["batch.json"]
    assert (clouds / "batch.json").read_bytes() == content
