# SPDX-License-Identifier: Apache-2.0
"""Headings of text clouds: which columns are x, y and z, and what is refused, not guessed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.storage.clouds import CloudFile, read_cloud_file

POINTS = [[1.5, -2.0, 3.25], [4.0, 5.0, -6.5], [7.0, 8.5, 9.0]]
NUMBERED = [[float(k), *point] for k, point in enumerate(POINTS, start=1)]
WITH_GREY = [[*point, 7.0] for point in POINTS]
WITH_COLOURS = [[*point, 7.0, 8.0, 9.0] for point in POINTS]
UNKNOWN = "does not say which of"
NOT_ONE_EACH = "does not give one name to each of"


def table(path: Path, opening: str, rows: list[list[float]], separator: str = " ") -> Path:
    lines = [separator.join(f"{value:g}" for value in row) for row in rows]
    path.write_text("\n".join([*([opening] if opening else []), *lines, ""]))
    return path


def read(path: Path, opening: str, rows: list[list[float]], separator: str = " ") -> CloudFile:
    return read_cloud_file(table(path, opening, rows, separator))


@pytest.mark.parametrize("separator", [" ", ",", ";", "\t"])
@pytest.mark.parametrize(
    "opening",
    [
        "# id x y z",
        "# id,x,y,z",
        "#id,x,y,z",
        "# ID;X [mm];Y [mm];Z [mm]",
        "# columns: id x y z",
        "// Id X Y Z",
        "# id x y z\n# made elsewhere",
        "3\n# id x y z",
        "# made elsewhere\nid x y z",
        "Point Id,X,Y,Z",
        "Nr.;X;Y;Z",
        ",x,y,z",
        "\tx\ty\tz",
        "#,x,y,z",
    ],
)
def test_a_number_before_the_coordinates_is_not_taken_for_x(
    tmp_path: Path, opening: str, separator: str
) -> None:
    """Of `#` lines and of nameless first columns it was: x, y, z were number, x, y."""
    found = read(tmp_path / "c.txt", opening, NUMBERED, separator)
    assert found.cloud.points_mm.tolist() == POINTS
    assert found.remarks == ()


def test_what_numpy_writes_with_a_header_is_read_by_it(tmp_path: Path) -> None:
    path = tmp_path / "saved.xyz"
    np.savetxt(path, np.array(POINTS)[:, ::-1], header="z y x")
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS
    np.savetxt(path, np.array(NUMBERED), header="id,x,y,z", delimiter=",")
    found = read_cloud_file(path)
    assert found.cloud.points_mm.tolist() == POINTS
    assert found.dropped == ("id",)


@pytest.mark.parametrize(
    ("opening", "rows", "grey"),
    [
        ("", POINTS, 0.0),
        ("", WITH_GREY, 0.0),
        ("", WITH_COLOURS, 0.0),
        ("3", POINTS, 0.0),
        ("3", WITH_GREY, 0.0),
        ("3", [[*row, 1.0] for row in WITH_COLOURS], 0.0),
        ("x y z", POINTS, 0.0),
        ("x y z", WITH_GREY, 0.0),
        ("X,Y,Z,R,G,B", WITH_COLOURS, 0.0),
        ('"X","Y","Z","Red","Green","Blue"', WITH_COLOURS, 0.0),
        ("//X Y Z Intensity", WITH_GREY, 7.0),
        ("//x y z intensity\n3", WITH_GREY, 7.0),
        ("# X Y Z Intensity", WITH_GREY, 7.0),
        ("// x y z", POINTS, 0.0),
        ("# x y z in mm", POINTS, 0.0),
        ("# x y z in mm", WITH_GREY, 0.0),
        ("# made elsewhere", POINTS, 0.0),
        ("# made elsewhere", WITH_GREY, 0.0),
        ("# Exported by Other 2.3", WITH_GREY, 0.0),
        ("# date: 2026-01-02 12:00:00 UTC", WITH_GREY, 0.0),
        ("# written by: someone else", WITH_GREY, 0.0),
        ("# FIELDS x y z", WITH_GREY, 0.0),
    ],
)
def test_what_is_plain_stays_as_it_was(
    tmp_path: Path, opening: str, rows: list[list[float]], grey: float
) -> None:
    found = read(tmp_path / "c.asc", opening, rows)
    assert found.cloud.points_mm.tolist() == POINTS
    assert found.cloud.intensity.tolist() == [grey] * len(POINTS)
    assert found.remarks == ()


@pytest.mark.parametrize(
    ("opening", "rows", "said"),
    [
        ("ID,Xcoord,Ycoord,Zcoord", NUMBERED, UNKNOWN),
        ("point,east,north,up", NUMBERED, UNKNOWN),
        ("# point east north up", NUMBERED, UNKNOWN),
        ("Points:0,Points:1,Points:2,grey", WITH_GREY, UNKNOWN),
        ("id,x,y", POINTS, UNKNOWN),
        ("Zcoord,Ycoord,Xcoord", POINTS, UNKNOWN),
        ("pos_y pos_x pos_z", POINTS, UNKNOWN),
        ("# id x y z in mm", NUMBERED, NOT_ONE_EACH),
        ("# z y x in mm", POINTS, NOT_ONE_EACH),
        ("Point Id X Y Z Grey", [[1.0, *WITH_GREY[0]]], NOT_ONE_EACH),
        ("x y z", NUMBERED, NOT_ONE_EACH),
        ("# x y z", NUMBERED, NOT_ONE_EACH),
    ],
)
def test_columns_that_are_not_told_are_refused(
    tmp_path: Path, opening: str, rows: list[list[float]], said: str
) -> None:
    path = table(tmp_path / "c.xyz", opening, rows, "," if "," in opening else " ")
    with pytest.raises(FileFormatError, match=said) as caught:
        read_cloud_file(path)
    assert "x, y" in caught.value.remedy
    assert "c.xyz" in str(caught.value)


@pytest.mark.parametrize(
    ("opening", "unit"),
    [
        ("# x_m y_m z_m", "metres"),
        ("# X [cm] Y [cm] Z [cm]", "centimetres"),
        ("// x_in,y_in,z_in", "inches"),
        ("# X Y Z (m)", "metres"),
        ("X,Y,Z [m]", "metres"),
        ("# x_m y_m z_m\n# made elsewhere", "metres"),
    ],
)
def test_another_unit_is_refused_in_every_kind_of_heading(
    tmp_path: Path, opening: str, unit: str
) -> None:
    with pytest.raises(FileFormatError, match=f"x_[a-z]+, y_[a-z]+, z_[a-z]+ are in {unit}"):
        read(tmp_path / "c.xyz", opening, POINTS)


@pytest.mark.parametrize("opening", ["east north up", "Xcoord;Ycoord;Zcoord", "# made by us"])
def test_three_columns_of_other_names_are_taken_with_a_remark(tmp_path: Path, opening: str) -> None:
    found = read(tmp_path / "c.csv", opening, POINTS)
    assert found.cloud.points_mm.tolist() == POINTS
    (remark,) = found.remarks
    assert "the first three columns were taken" in remark


def test_rows_that_are_counted_without_a_heading_are_remarked(tmp_path: Path) -> None:
    found = read(tmp_path / "c.xyz", "", NUMBERED)
    assert "counts the lines" in found.remarks[0]
    assert read(tmp_path / "c.xyz", "", [[1, 2, 3], [2, 3, 4], [3, 4, 5]]).remarks == ()


def test_an_empty_value_and_short_rows_do_not_move_columns(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("id,grade,x,y,z,a,b\n1,,1.5,-2,3.25,,\n")
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS[:1]
    path.write_text("id,x,y,z,label\n1,1.5,-2,3.25\n")
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS[:1]
