# SPDX-License-Identifier: Apache-2.0
"""Clouds of other programs: what is read, and what is refused in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.storage.clouds import ply_bytes, read_cloud, xyz_bytes
from armscan.storage.points import read_probed_points
from rigs.inspection_clouds import cloud_of

POINTS = np.array([[1.5, -2.0, 3.25], [4.0, 5.0, -6.5]])


def test_an_own_cloud_keeps_all_it_carries(tmp_path: Path) -> None:
    path = tmp_path / "own.ply"
    path.write_bytes(ply_bytes(cloud_of(POINTS, np.array([0, 1]))))
    found = read_cloud(path)
    assert found.frame == "Base"
    assert found.exposure.tolist() == [0, 1]
    assert found.sigma_mm == pytest.approx([0.01, 0.01])


def test_an_own_text_file_keeps_its_frame(tmp_path: Path) -> None:
    path = tmp_path / "own.xyz"
    path.write_bytes(xyz_bytes(cloud_of(POINTS, frame="Sensor")))
    found = read_cloud(path)
    assert found.frame == "Sensor"
    assert found.points_mm == pytest.approx(POINTS)
    assert not found.covariance_mm2.any()


def test_an_own_text_file_keeps_its_marks(tmp_path: Path) -> None:
    path = tmp_path / "own.xyz"
    marked = replace(cloud_of(POINTS), is_simulated=True, forced=("rms 9 px", "f unknown"))
    path.write_bytes(xyz_bytes(marked))
    found = read_cloud(path)
    assert found.forced == ("rms 9 px", "f unknown")
    assert found.is_simulated


@pytest.mark.parametrize(
    "text",
    [
        "1.5 -2 3.25\n4 5 -6.5\n",
        "2\n1.5 -2 3.25\n4 5 -6.5\n",
        "x,y,z,intensity\n1.5,-2,3.25,7\n4,5,-6.5,8\n",
        "\ufeff1.5;-2;3.25\r\n4;5;-6.5\r\n",
        "# made elsewhere\n1.5 -2 3.25 # first\n4 5 -6.5",
    ],
)
def test_text_of_other_programs(tmp_path: Path, text: str) -> None:
    path = tmp_path / "other.xyz"
    path.write_text(text, encoding="utf-8")
    found = read_cloud(path)
    assert found.points_mm.tolist() == POINTS.tolist()
    assert found.exposure_sources == ("other.xyz",)


@pytest.mark.parametrize(
    ("heading", "said"),
    [
        ("x_m,y_m,z_m", "are in metres; multiply them by 1000 and name them x_mm, y_mm, z_mm"),
        ("X_in;Y_in;Z_in", "are in inches; multiply them by 25.4"),
        ("n,x_um,y_um,z_um", "are in micrometres; multiply them by 0.001"),
    ],
)
def test_another_unit_in_the_heading_is_refused_alike_everywhere(
    tmp_path: Path, heading: str, said: str
) -> None:
    path = tmp_path / "cloud.csv"
    n_columns = len(heading.replace(";", ",").split(","))
    path.write_text(f"{heading}\n{','.join('1234'[:n_columns])}\n")
    for read in (read_cloud, read_probed_points):
        if ";" in heading and read is read_probed_points:
            continue
        with pytest.raises(FileFormatError) as caught:
            read(path)
        assert said in str(caught.value)


def test_micrometres_are_told_in_a_table_that_is_not_utf_8(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_bytes("X [\u00b5m];Y [\u00b5m];Z [\u00b5m]\n1500;2500;3500\n".encode("cp1252"))
    with pytest.raises(FileFormatError, match="are in micrometres"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["gap.csv", "gap.ply"])
def test_points_without_a_place_are_counted_and_shown(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    lines = ["1,2,3", "4,5,6", "7,,9", "nan,1,2"]
    if name == "gap.ply":
        header = "ply\nformat ascii 1.0\nelement vertex 4\n"
        header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        lines = [line.replace(",,", ",nan,").replace(",", " ") for line in lines]
        path.write_text(header + "\n".join(lines) + "\n")
    else:
        path.write_text("x_mm,y_mm,z_mm\n" + "\n".join(lines) + "\n")
    with pytest.raises(FileFormatError, match=r"2 of 4 points .* the first is point 3"):
        read_cloud(path)


def test_a_ply_file_of_another_program(tmp_path: Path) -> None:
    path = tmp_path / "other.ply"
    fields = "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    header = f"ply\nformat ascii 1.0\nelement vertex 2\n{fields}end_header\n"
    path.write_text(header + "1.5 -2 3.25 9\n4 5 -6.5 9\n")
    assert read_cloud(path).points_mm.tolist() == POINTS.tolist()
    path.write_text(header.replace("property float z\n", "") + "1.5 -2 9\n4 5 9\n")
    with pytest.raises(FileFormatError, match="no z"):
        read_cloud(path)


@pytest.mark.parametrize("comment", ["calibration done", "calibration 3 scans", "forced cooling"])
def test_comments_of_other_programs_are_no_marks_of_ours(tmp_path: Path, comment: str) -> None:
    """The header was told as damaged."""
    path = tmp_path / "other.xyz"
    path.write_text(f"# {comment}\n1.5 -2 3.25\n4 5 -6.5\n")
    assert read_cloud(path).points_mm.tolist() == POINTS.tolist()
    path = tmp_path / "other.ply"
    fields = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 2\n{fields}end_header\n"
    path.write_text(header + "1.5 -2 3.25\n4 5 -6.5\n")
    found = read_cloud(path)
    assert found.points_mm.tolist() == POINTS.tolist()
    assert found.forced == () and found.calibrations == ()
    path.write_bytes(ply_bytes(cloud_of(POINTS)).replace(b"unit mm", comment.encode(), 1))
    with pytest.raises(FileFormatError, match="is damaged"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("empty.xyz", "", "is empty"),
        ("heads.csv", "x,y,z\n", "holds no points"),
        ("two.xyz", "1 2 3\n4 5\n", "not understood: line 2 is '4 5'"),
        ("words.xyz", "x y z\n\n1 2 3\n4 five 6\n", "not understood: line 4 is '4 five 6'"),
        ("nan.xyz", "1 2 3\nnan 5 6\n", "empty or nan"),
        ("comma.csv", "1,5;2,5;3,5\n4,5;5,5;6,5\n", "commas"),
        ("comma.xyz", "1 2 3\n1,5 2,5 3,5\n", "commas"),
        ("named.csv", "x,y,z\n1,5,2,5,3,5\n", "commas"),
        ("letter.xyz", "1.0 2.0 3.O\n4 5 6\n7 8 9\n", "first line"),
        ("letters.xyz", "1.O 2.O 3.O\n4 5 6\n7 8 9\n", "first line"),
        ("cloud.stl", "1 2 3\n", "not an STL file"),
        ("cloud.wrl", "1 2 3\n", "no point cloud that armscan knows"),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_cloud(path)


@pytest.mark.parametrize(
    "heading", ["X [mm],Y [mm],Z [mm]", "x(mm);y(mm);z(mm)", "i,x [mm],y[mm],z"]
)
def test_units_in_brackets_are_part_of_a_columns_name(tmp_path: Path, heading: str) -> None:
    """They counted as columns, and the points of three were not understood."""
    path, sep = tmp_path / "c.csv", ";" if ";" in heading else ","
    row = (["7"] if heading.startswith("i") else []) + ["1.5", "2.5", "3.5"]
    path.write_text(f"{heading}\n{sep.join(row)}\n")
    assert read_cloud(path).points_mm.tolist() == [[1.5, 2.5, 3.5]]
    path.write_text(f"{heading.replace('mm', 'm')}\n{sep.join(row)}\n")
    if heading.count("mm") == 3:
        with pytest.raises(FileFormatError, match="are in metres"):
            read_cloud(path)
