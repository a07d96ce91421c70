# SPDX-License-Identifier: Apache-2.0
"""Touches from a folder and from tables: one plate, whichever way it is read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.hand_eye.probed_plate import ProbingOptions
from armscan.cli.run import main
from armscan.errors import ArmscanError, EstimationError, InputError, OptionError, OutputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.jobs.job import Job
from armscan.jobs.probe import probe, read_touches
from armscan.records.points import ProbedPoints
from armscan.records.recording import ArmTrack
from armscan.storage.arm import ProbeTip, write_probing
from armscan.storage.points import probed_points_csv, read_probed_points

TIP = ProbeTip(np.array([2.0, -5.0, 120.0]), 6.0)
PLANE = np.array([0.0, -0.6, 0.8, -30.0])


def on_plate(n: int = 9) -> FloatArray:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(300, 400, n), rng.uniform(-50, 50, n), np.zeros(n)])
    flat[:, 2] = -(flat[:, :2] @ PLANE[:2] + PLANE[3]) / PLANE[2]
    return flat


def track(n: int = 9) -> ArmTrack:
    """The probe comes along the normal, each time with another lean."""
    centres = on_plate(n) + 3.0 * PLANE[:3]
    rng = np.random.default_rng(1)
    down = Pose.from_vectors([np.pi - np.arctan2(-0.6, 0.8), 0.0, 0.0], np.zeros(3)).rotation
    rotations = np.array(
        [Pose.from_vectors(rng.normal(0.0, 0.2, 3), np.zeros(3)).rotation @ down for _ in range(n)]
    )
    places = centres - rotations @ TIP.centre_tool_mm
    return ArmTrack(
        t_ns=np.arange(n) * 10**9,
        rotations=rotations,
        translations_mm=places,
        is_known=np.ones(n, dtype=bool),
    )


def test_a_folder_of_touches(tmp_path: Path) -> None:
    write_probing(tmp_path / "touches", track(), TIP, is_simulated=True)
    output = tmp_path / "plate.csv"
    summary = probe(Job(output), tmp_path / "touches")
    np.testing.assert_allclose(summary.data["plane"], PLANE, atol=1e-9)
    assert summary.data["side"] == "where the tool was"
    assert summary.data["simulated"] is True
    assert "simulated" in summary.title
    assert summary.data["flatness_mm"] < 1e-9
    surface = read_probed_points(output)
    assert not surface.are_tip_centres
    assert surface.tip_diameter_mm == 6.0, "a wrong side is told by it"
    np.testing.assert_allclose(surface.points_mm, on_plate(), atol=1e-9)


def test_a_table_of_centres_gives_the_same(tmp_path: Path) -> None:
    table = tmp_path / "centres.csv"
    centres = on_plate() + 3.0 * PLANE[:3]
    table.write_bytes(probed_points_csv(ProbedPoints(points_mm=centres, tip_diameter_mm=6.0)))
    summary = probe(Job(), table)
    np.testing.assert_allclose(summary.data["plane"], PLANE, atol=1e-9)
    assert summary.written == ()
    assert any("taken for granted" in warning for warning in summary.warnings)
    other = probe(Job(), table, options=ProbingOptions(side="-z"))
    np.testing.assert_allclose(other.data["plane"][:3], -PLANE[:3], atol=1e-9)
    assert other.data["plane"][3] + PLANE[3] == pytest.approx(6.0), "the face below the ball"
    assert other.warnings == ()


def test_touches_without_pose_are_counted(tmp_path: Path) -> None:
    known = np.ones(9, dtype=bool)
    known[3] = False
    write_probing(tmp_path / "touches", replace(track(), is_known=known), TIP)
    found = read_touches(tmp_path / "touches")
    assert len(found.points) == 8
    assert any("1 of 9 touches" in warning for warning in found.warnings)
    assert found.points.rows == (1, 2, 3, 5, 6, 7, 8, 9)


def test_the_command_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, output = tmp_path / "touches", tmp_path / "plate.csv"
    write_probing(folder, track(), TIP)
    assert main(["probe", str(folder), "-o", str(output)]) == 0
    out, err = capsys.readouterr()
    assert "A B C D" in out
    assert "0.8 -30 (D in mm)" in out
    assert err == ""
    assert main(["probe", str(folder), "--side=-z", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["plane"][2] == pytest.approx(-0.8)
    assert data["sigma_offset_mm"] is not None
    assert main(["probe", str(folder), "-o", str(output)]) != 0
    assert "--force" in capsys.readouterr().err


def test_what_stands_in_the_way_is_said_and_nothing_is_written(tmp_path: Path) -> None:
    folder, output = tmp_path / "touches", tmp_path / "plate.csv"
    write_probing(folder, track(2), TIP)
    table = tmp_path / "centres.csv"
    table.write_bytes(
        probed_points_csv(
            ProbedPoints(
                points_mm=on_plate(), tip_diameter_mm=6.0, features=("plate",) * 5 + ("block",) * 4
            )
        )
    )
    cases: list[tuple[Path, Path, Path | None, type[ArmscanError], str]] = [
        (folder, output, None, EstimationError, "three points"),
        (table, output, None, InputError, "block, plate"),
        (table, output, table, OptionError, "--probe"),
        (table, tmp_path / "plate.txt", None, OptionError, r"\.csv"),
        (table, table, None, OutputError, "centres"),
        (tmp_path / "none", output, None, ArmscanError, "none"),
    ]
    for source, place, tip, kind, words in cases:
        with pytest.raises(kind, match=words):
            probe(Job(place), source, tip)
    assert not output.exists()
    (folder / "probe.toml").unlink()
    with pytest.raises(ArmscanError, match=r"probe\.toml"):
        probe(Job(output), folder)
