# SPDX-License-Identifier: Apache-2.0
"""Tables of probed points, and planes in place of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError, OptionError
from armscan.records.points import ProbedPoints
from armscan.storage.points import (
    parse_plane,
    probed_points_csv,
    read_points_or_plane,
    read_probed_points,
)

POINTS_MM = np.array([[1.5, -200.125, 3.0], [101.0, 1 / 3, 3.5], [7.0, 80.0, 1e-7]])
TABLE = "x_mm,y_mm,z_mm\n0,0,0\n100,0,0\n0,100,0\n"


def written(folder: Path, content: str | bytes) -> Path:
    path = folder / "plate.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("tip_mm", [0.0, 6.0, 2.9987])
@pytest.mark.parametrize("features", [(), ("plate", "plate", "Würfel, links")])
def test_points_come_back_bit_by_bit(
    tmp_path: Path, tip_mm: float, features: tuple[str, ...]
) -> None:
    points = ProbedPoints(points_mm=POINTS_MM, tip_diameter_mm=tip_mm, features=features)
    found = read_probed_points(written(tmp_path, probed_points_csv(points)))
    np.testing.assert_array_equal(found.points_mm, POINTS_MM)
    assert (found.tip_diameter_mm, found.features) == (tip_mm, features)


def test_points_are_on_the_surface_unless_a_comment_says_that_they_are_the_tips_centre(
    tmp_path: Path,
) -> None:
    assert not read_probed_points(written(tmp_path, TABLE)).are_tip_centres
    assert not read_probed_points(written(tmp_path, "# checkpoint = 3\n" + TABLE)).are_tip_centres
    text = "# tip centres of a ruby ball\n# point = tip-centre, tip_diameter_mm = 6\n" + TABLE
    assert read_probed_points(written(tmp_path, text)).tip_diameter_mm == 6.0
    text = "# point = surface\n" + TABLE
    assert read_probed_points(written(tmp_path, text)).tip_diameter_mm == 0.0
    surface = ProbedPoints(points_mm=POINTS_MM, tip_diameter_mm=6.0, is_compensated=True)
    content = probed_points_csv(surface)
    assert content.startswith(b"# point = surface, tip_diameter_mm = 6.0")
    found = read_probed_points(written(tmp_path, content))
    assert found.tip_diameter_mm == 6.0
    assert not found.are_tip_centres


def test_columns_are_found_by_name_and_marks_of_other_systems_do_no_harm(tmp_path: Path) -> None:
    text = "\ufeff# taken by hand\r\nz_mm, x_mm,force_n,y_mm\r\n3,1,9,2\r\n6,400,9,5\r\n"
    found = read_probed_points(written(tmp_path, text))
    assert found.points_mm.tolist() == [[1.0, 2.0, 3.0], [400.0, 5.0, 6.0]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("# point = tip-centre\n" + TABLE, "diameter is not given"),
        ("# point: tip-centre, tip_diameter_mm: 6\n" + TABLE, "is not understood"),
        ("# Tip diameter = 6\n" + TABLE, "is not understood"),
        ("# tip_radius_mm = 3\n" + TABLE, "is not understood"),
        ("# point = tip-centre, tip_diameter_mm = -6\n" + TABLE, "diameter is not given"),
        ("# point = surface, tip_diameter_mm = six\n" + TABLE, "diameter is not given"),
        ("# point = middle\n" + TABLE, "'point = middle' is not known"),
        ("x_mm,y_mm,z_mm\n", "holds no point"),
        ("x_mm,y_mm,z\n1,2,3\n", "'z' may be 'z_mm'"),
        ("x_m,y_m,z_m\n1,2,3\n", "in metres"),
        ("x_mm,y_mm,z_mm\n0,0,0\n0.3,0,0\n0,0.4,0\n", "look like metres"),
        ("x_mm,y_mm,z_mm\n1,2,\n", "line 2: '' in column z_mm is no number"),
        ("x_mm,y_mm,z_mm\n1,2,nan\n", "'nan' in column z_mm is no number"),
        ("x_mm,y_mm,z_mm\n1,5,2,5,3,5\n", "decimal point"),
        ("x_mm;y_mm;z_mm\n1;2;3\n", "not separated by commas"),
        ("x_mm,y_mm,z_mm\n1,2,3\n4,5", "may be cut"),
        ("1,2,3\n4,5,6\n", "holds numbers, not the names"),
        ("x_mm,y_mm,y_mm\n1,2,3\n", "more than one column is called y_mm"),
        ("# only a comment\n", "no header"),
        ("", "empty"),
        (TABLE.encode("utf-16"), "not UTF-8"),
    ],
)
def test_bad_tables_are_refused_in_words(tmp_path: Path, text: str | bytes, said: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_probed_points(written(tmp_path, text))
    assert said in str(caught.value)


def test_a_plane_is_scaled_to_a_unit_normal() -> None:
    np.testing.assert_allclose(parse_plane("0, 0, -4, 8"), [0.0, 0.0, -1.0, 2.0])
    np.testing.assert_allclose(parse_plane("3 4 0 5"), [0.6, 0.8, 0.0, 1.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "'' is no plane"),
        ("1,2,3", "3 numbers where 4 are needed"),
        ("1,2,3,4,5", "5 numbers where 4 are needed"),
        ("a,b,c,d", "'a,b,c,d' is no plane"),
        ("1,2,nan,4", "C is nan"),
        ("0,0,0,1", "normal A,B,C is zero"),
    ],
)
def test_what_is_no_plane_is_refused(text: str, said: str) -> None:
    with pytest.raises(OptionError, match=said):
        parse_plane(text)


@pytest.mark.parametrize("text", ["A,B,C,D\n0,0,2,-6\n", "0 0 2 -6", "# plate\n0,0,2,-6\n"])
def test_a_file_may_hold_a_plane_in_place_of_points(tmp_path: Path, text: str) -> None:
    found = read_points_or_plane(written(tmp_path, text))
    assert isinstance(found, np.ndarray)
    np.testing.assert_array_equal(found, [0.0, 0.0, 1.0, -3.0])


def test_a_file_of_points_is_not_taken_for_a_plane(tmp_path: Path) -> None:
    found = read_points_or_plane(written(tmp_path, TABLE))
    assert isinstance(found, ProbedPoints)
    with pytest.raises(FileFormatError, match="normal"):
        read_points_or_plane(written(tmp_path, "A,B,C,D\n0,0,0,1\n"))


def test_json_is_no_table(tmp_path: Path) -> None:
    path = written(tmp_path, '{\n"poses": [1, 2,\n3]}\n')
    with pytest.raises(FileFormatError, match=r"looks like JSON.*CSV file with the names"):
        read_probed_points(path)
