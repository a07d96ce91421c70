# SPDX-License-Identifier: Apache-2.0
"""A recording's folder and its MCAP file are the same to every command that takes a recording."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.reconstruction.sync import poses_by_time
from armscan.storage.arm import ARM_FILE
from armscan.storage.clouds import read_ply
from armscan.storage.recording import read_recording
from armscan.storage.recording_session import SESSION_FILE, session_toml
from armscan.storage.recordings import write_mcap
from armscan.storage.recordings.read_mcap import extract_recording, record_folder
from armscan.storage.recordings.write_mcap import RecordingWriter
from armscan.storage.tables import read_csv
from rigs.drawn_arm import PLANE, draw_bounce, draw_postures
from rigs.drawn_bench import TARGET, Bench

Fails = Callable[..., str]


def listed(folder: Path, images: list[tuple[Path, str, str]]) -> Path:
    """A recording of one camera of images with the lasers that are on, and their views."""
    (folder / "images").mkdir(parents=True)
    lines = ["index,t_ns,camera,file,lasers,view"]
    for k, (path, lasers, view) in enumerate(images):
        shutil.copy(path, folder / "images" / f"{k:02d}.png")
        lines.append(f"{k},{k * 50_000_000},0,images/{k:02d}.png,{lasers},{view}")
    (folder / "exposures.csv").write_text("\n".join(lines) + "\n")
    (folder / "session.toml").write_text('kind = "calibration"\n')
    return folder


@pytest.fixture(scope="module")
def folders(calibrated: Bench, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("recordings")
    root = calibrated.folder
    views = [(path, "", path.stem) for path in sorted((root / "camera").glob("*.png"))]
    pairs = [
        (path, lasers, path.stem)
        for k in range(len(list((root / "on").glob("*.png"))))
        for path, lasers in ((root / f"on/place{k}.png", "A"), (root / f"off/place{k}.png", ""))
    ]
    made = {"camera": listed(place / "camera", views), "laser": listed(place / "laser", pairs)}
    made |= {"postures": place / "postures", "moved": place / "moved"}
    draw_postures(made["postures"])
    draw_bounce(made["moved"], seconds=3.0)
    for folder in list(made.values()):
        record_folder(folder, folder.with_suffix(".mcap"))
        as_raw(folder, place / "raw" / f"{folder.name}.mcap")
    words = ["calibrate", "hand-eye", made["postures"], "--sensor", calibrated.sensor]
    made["scanner"] = place / "scanner.json"
    assert main([str(w) for w in (*words, "--plane", PLANE, "-o", made["scanner"])]) == 0
    made["plane"] = place / "plane.csv"
    made["plane"].write_text(f"A,B,C,D\n{PLANE}\n")
    return made


def given_files(bench: Bench, made: dict[str, Path]) -> dict[str, Path]:
    own = {name: made[name] for name in ("scanner", "plane")}
    return {"camera": bench.camera, "sensor": bench.sensor, **own}


def as_raw(folder: Path, path: Path) -> None:
    """As a rig records it: pixels, and the arm as it was sampled."""
    path.parent.mkdir(exist_ok=True)
    source = read_recording(folder)
    session = (folder / "session.toml").read_bytes() if (folder / "session.toml").exists() else b""
    with RecordingWriter(path) as writer:
        writer.begin(source.session, {"session.toml": session} if session else None)
        for k, row in enumerate(source.rows):
            writer.add_exposure(row, source.exposure(k).image)
        if source.arm is not None:
            writer.add_arm_samples(source.arm, cells=read_csv(folder / ARM_FILE).columns)


COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "info": ("postures", ("info", "{scan}")),
    "info of calibration images": ("laser", ("info", "{scan}")),
    "camera": ("camera", ("calibrate", "camera", "--scan", "{scan}", "--target", TARGET,
                          "--distortion", "none", "-o", "{out}/c.json")),
    "laser": ("laser", ("calibrate", "laser", "--camera", "{camera}", "--scan", "{scan}",
                        "--target", TARGET, "-o", "{out}/s.json")),
    "hand-eye": ("postures", ("calibrate", "hand-eye", "{scan}", "--sensor", "{sensor}",
                              "--plane", PLANE, "-o", "{out}/h.json")),
    "latency": ("moved", ("calibrate", "latency", "{scan}", "--scanner", "{scanner}",
                          "-o", "{out}/l.json")),
    "reconstruct": ("postures", ("reconstruct", "{scan}", "--scanner", "{scanner}",
                                 "-o", "{out}/cloud.ply")),
    "reconstruct in the sensor": ("laser", ("reconstruct", "{scan}", "--sensor", "{sensor}",
                                            "-o", "{out}/cloud.ply")),
    "verify": ("postures", ("verify", "{scan}", "--scanner", "{scanner}",
                           "--plate", "{plane}")),
    "markers": ("camera", ("markers", "{scan}/images/00.png", "-o", "{out}/m.html")),
}  # fmt: skip

LONG = ("camera", "hand-eye", "latency")


def run(
    words: tuple[str, ...], scan: Path, out: Path, given: dict[str, Path],
    capsys: pytest.CaptureFixture[str],
) -> tuple[int, str]:  # fmt: skip
    """Exit code and what is said, with the recording's and the output's names taken out."""
    out.mkdir(parents=True)
    filled = [word.format(scan=scan, out=out, **given) for word in words]
    code = main([*filled, "--json"])
    said = capsys.readouterr()
    data = json.loads(said.out) if code != 2 else {}
    data.pop("seconds", None)
    text = json.dumps(data, sort_keys=True) + said.err
    for name, path in (("SCAN", scan), ("OUT", out)):
        text = text.replace(path.as_posix(), name)
    return code, text


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_is_measured_as_its_folder(
    name: str, calibrated: Bench, folders: dict[str, Path], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    which, words = COMMANDS[name]
    given = given_files(calibrated, folders)
    there = run(words, folders[which], tmp_path / "folder", given, capsys)
    assert there[0] in (0, 1), there[1]
    packed = folders[which].with_suffix(".mcap")
    raw = packed.parent / "raw" / packed.name
    forms = {"raw": raw} if name in LONG else {"files": packed, "raw": raw}
    for how, path in forms.items():
        assert run(words, path, tmp_path / how, given, capsys) == there
        made, found = (sorted((tmp_path / one).iterdir()) for one in ("folder", how))
        assert [one.name for one in found] == [one.name for one in made]
        if (tmp_path / how / "cloud.ply").exists():
            a, b = (read_ply(tmp_path / one / "cloud.ply") for one in ("folder", how))
            assert len(a) > 100
            np.testing.assert_array_equal(a.points_mm, b.points_mm)
            np.testing.assert_array_equal(a.covariance_mm2, b.covariance_mm2)
            assert a.exposure_sources == b.exposure_sources


def test_photographs_are_not_looked_for_in_a_recording(
    folders: dict[str, Path], tmp_path: Path, fails: Fails
) -> None:
    scan = next(iter(folders.values())).with_suffix(".mcap")
    said = fails("stripes", scan, "-o", tmp_path / "stripes.csv")
    assert "this is a recording in one file" in said
    assert f"armscan convert {scan} FOLDER" in said


@pytest.mark.parametrize("name", COMMANDS)
def test_a_broken_file_costs_one_sentence(
    name: str, calibrated: Bench, folders: dict[str, Path], tmp_path: Path, fails: Fails
) -> None:
    which, words = COMMANDS[name]
    data = folders[which].with_suffix(".mcap").read_bytes()
    broken = tmp_path / "scan.mcap"
    given = given_files(calibrated, folders)
    filled = [word.format(scan=broken, out=tmp_path, **given) for word in words]
    for content, said in ((data[:-30], "armscan recover"), (b"", "empty"), (b"text", "no MCAP")):
        broken.write_bytes(content)
        assert said in fails(*filled, writes=tmp_path)


@pytest.mark.parametrize("clock", ["shared", "separate"])
def test_a_converted_file_that_is_cut_keeps_the_poses_of_what_is_left(
    folders: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    clock: Literal["shared", "separate"],
) -> None:
    """Samples stand among the exposures; at the end they were all lost with it."""
    monkeypatch.setattr(write_mcap, "CHUNK_BYTES", 1 << 14)
    folder = tmp_path / "moved"
    shutil.copytree(folders["moved"], folder)
    session = read_recording(folder).session
    (folder / SESSION_FILE).write_bytes(session_toml(replace(session, clock=clock)))
    record_folder(folder, tmp_path / "moved.mcap")
    content = (tmp_path / "moved.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: int(0.6 * len(content))])
    found = extract_recording(tmp_path / "cut.mcap", tmp_path / "back", is_recovering=True)
    whole, back = read_recording(folder), read_recording(tmp_path / "back")
    assert 5 < found.n_exposures < len(whole.rows) - 5
    poses = poses_by_time(back.rows, back.arm) if back.arm is not None else None
    assert poses is not None and poses.has_pose.all()
    assert whole.arm is not None and found.n_samples < len(whole.arm)


def test_recover_says_that_poses_are_lost_and_info_that_a_file_is_damaged(
    folders: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, path = read_recording(folders["moved"]), tmp_path / "late.mcap"
    with RecordingWriter(path) as writer:
        writer.begin(source.session)
        for k, row in enumerate(source.rows):
            writer.add_exposure(row, source.exposure(k).image)
        while writer.status().n_written < len(source.rows):
            time.sleep(0.05)
        n_bytes = writer.status().n_bytes
        assert source.arm is not None
        writer.add_arm_samples(source.arm)
    content = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[:n_bytes])
    assert main(["recover", str(tmp_path / "cut.mcap"), "-o", str(tmp_path / "back")]) == 0
    assert "NO POSES" in capsys.readouterr().out
    assert main(["recover", str(path), "-o", str(tmp_path / "whole")]) == 0
    assert "POSES" not in capsys.readouterr().out

    assert main(["info", str(path)]) == 0
    assert "damaged" not in capsys.readouterr().out
    path.write_bytes(content[:100_000] + bytes(200) + content[100_200:])
    assert main(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert ", damaged" in said
    assert "armscan recover" in said
