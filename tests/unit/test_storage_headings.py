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
WITH_TIME = [[12.0, *POINTS[0]], [12.5, *POINTS[1]], [13.0, *POINTS[2]]]
WITH_NORMALS = [[*point, 0.0, 0.6, 0.8] for point in POINTS]
UNKNOWN = "does not say which of"
NOT_ONE_EACH = "does not give one name to each of"
PROSE_OR_NAMES = "may be prose or the names of"


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
    by_comment = opening.startswith(("#", "/", "3")) and not opening.endswith("\nid x y z")
    assert [text[:35] for text in found.remarks] == [
        "x, y and z are columns 2, 3 and 4, "
    ] * by_comment


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
        ("id,x,y", POINTS, UNKNOWN),
        ("Zcoord,Ycoord,Xcoord", POINTS, UNKNOWN),
        ("pos_y pos_x pos_z", POINTS, UNKNOWN),
        ("# id x y z in mm", NUMBERED, NOT_ONE_EACH),
        ("# z y x in mm", POINTS, NOT_ONE_EACH),
        ("Point Id X Y Z Grey", [[1.0, *WITH_GREY[0]]], NOT_ONE_EACH),
        ("x y z", NUMBERED, NOT_ONE_EACH),
        ("Point Cloud", WITH_GREY, UNKNOWN),
        ("Data X Y Z", WITH_GREY, PROSE_OR_NAMES),
        ("points x y z", WITH_GREY, PROSE_OR_NAMES),
        ("# time x y z", WITH_TIME, PROSE_OR_NAMES),
        ("# time x y z in mm", WITH_TIME, NOT_ONE_EACH),
        ("# columns 2-4: x, y, z; column 1: time", WITH_TIME, NOT_ONE_EACH),
        ("# 1: id, 2: x, 3: y, 4: z", NUMBERED, NOT_ONE_EACH),
        ("# points: x y z", NUMBERED, PROSE_OR_NAMES),
        ("# Coordinates x y z", NUMBERED, PROSE_OR_NAMES),
        ("# Each row: x y z intensity", NUMBERED, NOT_ONE_EACH),
        ("# x y z in mm", NUMBERED, NOT_ONE_EACH),
        ("# points x y z", WITH_TIME[:1], PROSE_OR_NAMES),
        ("# id y x h", NUMBERED, UNKNOWN),
        ("# Scanned with Artec Eva", NUMBERED, UNKNOWN),
        ("# Nr rechts hoch hoehe", [[101.1, *POINTS[0]], [101.2, *POINTS[1]]], UNKNOWN),
        ("# time pos_x pos_y pos_z", WITH_TIME, UNKNOWN),
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
    ("opening", "rows"),
    [
        ("# points: x y z", WITH_GREY),
        ("# Coordinates x y z", WITH_GREY),
        ("// Data X Y Z", WITH_GREY),
        ("# points x y z", WITH_GREY),
        ("# scan A, order x y z", WITH_COLOURS),
        ("# scan A, order x y z", WITH_NORMALS),
        ("# export of x y z intensity", WITH_COLOURS),
        ("# export of x y z intensity", WITH_NORMALS),
        ("# columns 1-3: x, y, z; column 4: intensity", WITH_GREY),
        ("# Each row: x y z intensity", WITH_GREY),
        ("# Columns are x y z", WITH_GREY),
        ("# Points (x, y, z) and grey", WITH_GREY),
        ("# scan no 5, order x y z", WITH_GREY),
        ("# Z, Y, X Axes follow ISO 841", POINTS),
        ("# x to the right, y up, z back", WITH_GREY),
        ("# Scanned with Artec Eva", WITH_GREY),
        ("# Copyright Acme Metrology GmbH", WITH_GREY),
        ("# Points measured with Eva", WITH_GREY),
        ("# Points from Eva", POINTS),
    ],
)
def test_prose_that_has_as_many_words_as_columns_moves_none(
    tmp_path: Path, opening: str, rows: list[list[float]]
) -> None:
    """The first were read from columns 2 to 4, without a word; the last were refused."""
    found = read(tmp_path / "c.xyz", opening, rows)
    assert found.cloud.points_mm.tolist() == POINTS
    (remark,) = found.remarks
    assert "the first three columns were taken for x, y and z" in remark


@pytest.mark.parametrize(
    "opening", ["# time,x,y,z", "# columns: time x y z", "# intensity x y z", "# time;x;y;z"]
)
def test_other_columns_before_x_are_named_with_commas_or_after_columns(
    tmp_path: Path, opening: str
) -> None:
    found = read(tmp_path / "c.xyz", opening, WITH_TIME)
    assert found.cloud.points_mm.tolist() == POINTS
    (remark,) = found.remarks
    assert "x, y and z are columns 2, 3 and 4" in remark


@pytest.mark.parametrize(
    ("opening", "rows"),
    [
        ("Points:0,Points:1,Points:2", POINTS),
        ('"Points:0","Points:1","Points:2"', POINTS),
        ('"Points_0","Points_1","Points_2","grey"', WITH_GREY),
        ("time,Points:0,Points:1,Points:2", WITH_TIME),
        ("Points:2,Points:1,Points:0", [point[::-1] for point in POINTS]),
    ],
)
def test_headings_of_paraview_are_read(
    tmp_path: Path, opening: str, rows: list[list[float]]
) -> None:
    assert read(tmp_path / "c.csv", opening, rows, ",").cloud.points_mm.tolist() == POINTS


@pytest.mark.parametrize(("opening", "rows"), [("# id x y z", NUMBERED), ("x y z", POINTS)])
def test_points_that_numpy_wrote_are_counted_as_others_are(
    tmp_path: Path, opening: str, rows: list[list[float]]
) -> None:
    """It writes 1.000e+00: under a comment that names fewer columns these are numbers, no x."""
    path = tmp_path / "c.xyz"
    np.savetxt(path, np.array(rows), header=opening.strip("# "))
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS
    np.savetxt(path, np.array(NUMBERED), header="points: x y z")
    with pytest.raises(FileFormatError, match=PROSE_OR_NAMES):
        read_cloud_file(path)


def test_decimal_commas_are_named_where_there_are_commas(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("x,y,z\n1,5,2,5,3,5\n")
    with pytest.raises(FileFormatError, match="twice as many numbers as columns"):
        read_cloud_file(path)
    path.write_text("My Point Cloud\n1.5,2,3,4,5,6\n")
    with pytest.raises(FileFormatError, match=UNKNOWN):
        read_cloud_file(path)


@pytest.mark.parametrize(
    ("opening", "unit"),
    [
        ("# x_m y_m z_m", "metres"),
        ("# X [cm] Y [cm] Z [cm]", "centimetres"),
        ("// x_in,y_in,z_in", "inches"),
        ("# X Y Z (m)", "metres"),
        ("X,Y,Z [m]", "metres"),
        ("X [\u00b5m],Y [\u00b5m],Z [\u00b5m]", "micrometres"),
        ("x(\u03bcm);y(\u03bcm);z(\u03bcm)", "micrometres"),
        ("# x_\u03bcm y_\u03bcm z_\u03bcm", "micrometres"),
        ("X Y Z (\u00b5m)", "micrometres"),
        ("# x_m y_m z_m\n# made elsewhere", "metres"),
    ],
)
def test_another_unit_is_refused_in_every_kind_of_heading(
    tmp_path: Path, opening: str, unit: str
) -> None:
    with pytest.raises(FileFormatError, match=rf"x_\w+, y_\w+, z_\w+ are in {unit}"):
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


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(
    ("heading", "rows"),
    [
        (("Name", "X", "Y", "Z"), ["Punkt 1|1.5|-2|3.25", "P2|4|5|-6.5", "a b c 3|7|8.5|9"]),
        (("Name", "X", "Y", "Z"), ["P1|1.5|-2|3.25", "Punkt 2|4|5|-6.5", "3 4 5 6|7|8.5|9"]),
        (("Name", "X", "Y", "Z"), ["a 1 |1.5|-2|3.25|", "|4|5|-6.5", "3, c; 4\t|7|8.5|9"]),
        (("# id", "x", "y", "z", "note"), ["1|1.5|-2|3.25|7", "2|4|5|-6.5|", "3 4|7|8.5|9|c"]),
        (("x_mm", "note", "y_mm", "z_mm"), ["1.5|2 9|-2|3.25", " ", "4|a|5|-6.5", "7||8.5|9"]),
        (("x_mm", "y_mm", "z_mm", "note"), ["1.5|-2|3.25|2 9", "4|5|-6.5|", "7|8.5|9|b c"]),
        (("Name", "X", "Y", "Z", "note"), ["a b|1.5|-2|3.25", "c|4|5|-6.5|d", "e f|7|8.5|9|g"]),
        (("X", "Y", "Z", "Name"), ['1.5|-2|3.25|"a|b"', '4|5|-6.5|5" 3', '"7"|8.5|9|']),
    ],
)
def test_blanks_in_a_column_of_text_move_no_column(
    tmp_path: Path, heading: tuple[str, ...], rows: list[str], separator: str
) -> None:
    """They moved all that follow: the point was `1.0 1.5 -2.0`, without a word."""
    path = tmp_path / "c.csv"
    others = ",;\t".replace(separator, "")
    rows = [row.replace(",", others[0]).replace(";", others[1]) for row in rows]
    rows = [row.replace("\t", "") if separator == "\t" else row for row in rows]
    lines = [separator.join(heading), *(row.replace("|", separator) for row in rows)]
    path.write_text("\n".join([*lines, ""]))
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS


def test_names_between_blanks_over_separated_rows_name_their_fields(tmp_path: Path) -> None:
    path = tmp_path / "c.txt"
    rows = "1{0}1.5{0}-2{0}3.25\nPunkt 2{0}4{0}5{0}-6.5\nP 3{0}7{0}8.5{0}9\n"
    for separator in (",", ";", "\t"):
        path.write_text("# columns: Name x y z\n" + rows.format(separator))
        assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS


def test_a_row_of_text_with_another_count_of_fields_is_refused_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("Name;X;Y;Z\nP 1;1;2;3\nP 2 4 5 6\nP 3;1;2;3\n")
    with pytest.raises(FileFormatError, match="line 3 is 'P 2 4 5 6'"):
        read_cloud_file(path)
    path.write_text("Name;X;Y;Z\nPunkt 1;1;2;3\nP2;1;2")
    with pytest.raises(FileFormatError, match="it ends within line 3, 'P2;1;2'"):
        read_cloud_file(path)
    path.write_text("Name;X;Y;Z\nPunkt 1;1;2;3\nPunkt 2;;2;3\n")
    with pytest.raises(FileFormatError, match=r"1 of 2 points .* empty or nan"):
        read_cloud_file(path)


def test_an_empty_last_value_is_none(tmp_path: Path) -> None:
    """The table was refused where the last column is one that is read."""
    path = tmp_path / "c.csv"
    path.write_text("x,y,z,intensity\n1.5,-2,3.25,\n4,5,-6.5,7\n7,8.5,9, \n")
    found = read_cloud_file(path).cloud
    assert found.points_mm.tolist() == POINTS
    assert found.intensity.tolist() == [0.0, 7.0, 0.0]


PADDED = [
    ("\tid\tx\ty\tz", "\t{0}\t{1}\t{2}\t{3}"),
    ("\tid\tx\ty\tz", "{0}\t{1}\t{2}\t{3}"),
    ("Punktnummer\tSatz\tx\ty\tz", "{0}\t\t7\t{1}\t{2}\t{3}"),
    ("Name\tx\ty\tz", "P{0}\t\t{1}\t{2}\t{3}"),
    ("Name\tx\ty\tz", "Punkt {0}\t\t{1}\t{2}\t{3}"),
    ("x\ty\tz", "{1}\t\t{2}\t\t{3}"),
    ("x\ty\tz", "{1}\t\t{2}\t \t{3}\t\t8\t\t9"),
    ("x\ty\tz\tname", "{1}\t\t{2}\t{3}\tPunkt {0}"),
    ("x\t\ty\t\tz", "{1}\t{2}\t{3}"),
    ("x\ty\tz\t", "{1}\t\t{2}\t{3}"),
    ("\tx\ty\tz", "\t{1}\t{2}\t{3}"),
    ("x\ty\tz", "\t{1}\t{2}\t{3}"),
    ("Name\tx\ty\tz", "N\u00ba {0}\t\t{1}\u00a0\t{2}\t\u00a0{3}"),
]


@pytest.mark.parametrize(("heading", "row"), PADDED)
def test_tabs_that_pad_move_no_column(tmp_path: Path, heading: str, row: str) -> None:
    """Each was taken for a separator: x was 1 or 7, without a word, or the table was refused."""
    path = tmp_path / "c.txt"
    path.write_text("\n".join([heading, *(row.format(*point) for point in NUMBERED), ""]), "utf-8")
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS


def test_tabs_that_pad_late_rows_are_seen_and_empty_ones_among_them_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.txt"
    rows = "Punktnummer\tSatz\tx\ty\tz\n" + "P 100000\t7\t1.5\t-2\t3.25\n" * 1200
    path.write_text(rows + "P 1\t\t7\t4\t5\t-6.5\n")
    assert read_cloud_file(path).cloud.points_mm[-2:].tolist() == POINTS[:2]
    path.write_text(rows + "P 1\t\t\t4\t5\t-6.5\n")
    with pytest.raises(FileFormatError, match="more tabs than stand between 5 columns"):
        read_cloud_file(path)
    path.write_text("x\ty\tz\n1.5\t-2\t3.25\t\t8\n4\t5\t-6.5\t7\t8\n7\t8.5\t9\t\t\n")
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(
    ("heading", "row"),
    [
        ("x|y|z|remark", '{0}|{1}|{2}|"'),
        ("remark|x|y|z", '"|{0}|{1}|{2}'),
        ("size|x|y|z", '"3|{0}|{1}|{2}'),
        ("size|x|y|z", '3"|{0}|{1}|{2}'),
        ("a|b|x|y|z|c", '"|"|{0}|{1}|{2}|"'),
        ("a|x|y|z|c", '"A|b ""c""|d"|{0}|{1}|{2}|"'),
        ("x|y|z|remark", '{0}|{1}|{2}|"see # 3"'),
    ],
)
def test_quotation_marks_without_a_second_one_take_no_points(
    tmp_path: Path, heading: str, row: str, separator: str
) -> None:
    """From one ditto mark to the next all lines were one field, and half of the points gone."""
    lines = [heading, *(row.format(*point) for point in POINTS), ""]
    path = tmp_path / "c.csv"
    path.write_text("\n".join(lines).replace("|", separator))
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS


@pytest.mark.parametrize(
    ("heading", "row"),
    [
        ("x y z", "{0} {1} {2} 255,128,0"),
        ("x y z", "{0} {1} {2} 255;128;0"),
        ("x y z", "{0} {1} {2}\t255\t128"),
        ("# x y z", "{0} {1} {2} 255,128,0"),
        ("X (mm);Y (mm);Z (mm);Farbe (r,g,b)", "{0};{1};{2};1,2,3"),
        ('X;Y;Z;"Remark, free"', '{0};{1};{2};"a, b, c, d"'),
        ("x;y;z;r,g,b", "{0};{1};{2};1,2,3"),
        ("x,y,z;r;g;b", "{0},{1},{2};1;2;3"),
        ("name\tx y z", "P1\t{0} {1} {2}"),
        ("x y z\tr g b", "{0} {1} {2}\t1 2 3"),
    ],
)
def test_tables_with_two_kinds_of_separators_are_read(
    tmp_path: Path, heading: str, row: str
) -> None:
    """They were split at the wrong one, and refused."""
    path = tmp_path / "c.txt"
    path.write_text("\n".join([heading, *(row.format(*point) for point in POINTS), ""]))
    assert read_cloud_file(path).cloud.points_mm.tolist() == POINTS


def test_words_of_a_field_are_not_taken_for_numbers_of_the_next(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("Name;X;Y;Z\nP 1 2 3;abc;2;3\nP 1 2 4;1;2;3\n")
    with pytest.raises(FileFormatError, match="line 2 is 'P 1 2 3;abc;2;3'"):
        read_cloud_file(path)
    path.write_text('x y z\n"1,5","2,5","3,5"\n')
    with pytest.raises(FileFormatError, match="the points are not understood: line 2"):
        read_cloud_file(path)
