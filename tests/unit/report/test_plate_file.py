# SPDX-License-Identifier: Apache-2.0
"""The plate that inspections and the daily check read: the same as `armscan probe` fits."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.errors import ArmscanError, EstimationError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.jobs.inspection.shapes import read_plate
from armscan.records.points import ProbedPoints
from armscan.storage.clouds import ply_bytes
from armscan.storage.points import probed_points_csv
from rigs.inspection_clouds import cloud_of

ORIGIN = np.zeros(3)
OUTLINE = np.array([[0, 0], [60, 0], [120, 0], [0, 80], [60, 80], [120, 80], [0, 40], [120, 40.0]])


def face(z_mm: float = 0.0, n: int = 8) -> FloatArray:
    return np.column_stack([OUTLINE[:n], np.full(n, z_mm)])


def written(folder: Path, points: ProbedPoints) -> Path:
    path = folder / "plate.csv"
    path.write_bytes(probed_points_csv(points))
    return path


def test_tip_centres_are_compensated_on_the_side_that_was_touched(tmp_path: Path) -> None:
    """By the user's word, by the arm, or upwards with a warning; never left at the centres."""
    path = written(tmp_path, ProbedPoints(points_mm=face(3.0), tip_diameter_mm=6.0))
    below = np.array([[60.0, 40.0, -200.0]])
    plate, weak = read_plate(path, ORIGIN)
    assert plate.plane.point_mm[2] == pytest.approx(0.0, abs=1e-9)
    assert any("--side" in text for text in weak)
    for plate, weak in (
        read_plate(path, ORIGIN, side="-z"),
        read_plate(path, ORIGIN, towards_mm=below),
    ):
        assert plate.plane.point_mm[2] == pytest.approx(6.0)
        assert weak == ()
        assert plate.tip_diameter_mm == 6.0


def test_three_touches_are_not_exact(tmp_path: Path) -> None:
    plate, weak = read_plate(
        written(tmp_path, ProbedPoints(points_mm=face(n=4)[[0, 2, 3]])), ORIGIN
    )
    assert plate.covariance is not None
    assert np.all(np.diag(plate.covariance) > 0.0)
    assert any("3 touches" in text for text in weak)


def test_what_is_no_plate_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    line = np.column_stack([np.arange(9.0) * 15, 0.1 * rng.normal(size=9), np.zeros(9)])
    names = ("plate",) * 8 + ("block",) * 8
    both = np.concatenate([face(), face(40.0)])
    cases: list[tuple[ProbedPoints, type[ArmscanError], str]] = [
        (ProbedPoints(points_mm=line), EstimationError, "nearly on one line"),
        (ProbedPoints(points_mm=both), EstimationError, "scatter"),
        (
            ProbedPoints(points_mm=both, features=names),
            InputError,
            "armscan probe POINTS --feature",
        ),
    ]
    for points, kind, words in cases:
        with pytest.raises(kind, match=words):
            read_plate(written(tmp_path, points), ORIGIN)


def test_coefficients_keep_their_sign_unless_a_side_is_said(tmp_path: Path) -> None:
    path = tmp_path / "plate.csv"
    path.write_text("A,B,C,D\n0,0,-2,10\n")
    near = np.array([7.0, 8.0, 30.0])
    plate, weak = read_plate(path, near)
    assert plate.plane.normal.tolist() == [0.0, 0.0, -1.0]
    np.testing.assert_allclose(plate.plane.point_mm, [7.0, 8.0, 5.0])
    assert (plate.covariance, weak) == (None, ())
    plate, _ = read_plate(path, near, side="+z")
    assert plate.plane.normal.tolist() == [0.0, 0.0, 1.0]


def test_an_upright_plate_on_the_surface_needs_no_side(tmp_path: Path) -> None:
    points = face()[:, [2, 0, 1]]
    plate, _ = read_plate(written(tmp_path, ProbedPoints(points_mm=points)), ORIGIN)
    np.testing.assert_allclose(plate.plane.normal, [1.0, 0.0, 0.0], atol=1e-12)
    with pytest.raises(EstimationError, match="--side"):
        read_plate(written(tmp_path, ProbedPoints(points_mm=points, tip_diameter_mm=6.0)), ORIGIN)


def test_inspection_and_daily_check_say_what_is_weak(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cloud 0.02 mm over a plate that three touches give, as centres of the tip, from below."""
    grid = np.stack(np.meshgrid(np.arange(0, 120, 4), np.arange(0, 80, 4), [0.02]), axis=-1)
    cloud = tmp_path / "cloud.ply"
    cloud.write_bytes(ply_bytes(cloud_of(grid.reshape(-1, 3), np.repeat(np.arange(20), 30))))
    plate = written(tmp_path, ProbedPoints(points_mm=face(-3.0, 4)[[0, 2, 3]], tip_diameter_mm=6.0))
    for words in (["inspect", "plane", str(cloud)], ["verify", str(cloud), "--mpe", "1"]):
        assert main([*words, "--plate", str(plate), "--side=-z", "--json"]) == 0
        content = json.loads(capsys.readouterr().out)
        assert any("3 touches" in text for text in content["warnings"])
    check = content["checks"][0]
    assert check["error"] == pytest.approx(-0.02)
    # no less than that of a plate at its middle, k = 2 and 0.01 mm a touch
    assert check["uncertainty"] > 2.0 * 0.01 / np.sqrt(3.0)
    assert main(["inspect", "plane", str(cloud), "--side", "+z"]) == 2
    assert "--plate" in capsys.readouterr().err
