# SPDX-License-Identifier: Apache-2.0
"""Profiles of a sensor that delivers points, and the robot's poses that go with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError
from armscan.geometry.rotations import EulerConvention
from armscan.records.recording import PoseForm
from armscan.storage.points import profile_files, read_profiles
from armscan.storage.recordings.robot_poses import read_robot_poses, rotations_of_form
from rigs.photographs import DATA, needs

YAML = "%YAML:1.0\n---\nscan_line: [ 1.5e+00, 0., .Nan, 2.,\n    0., -3.5, 4., 0., -6. ]\n"


def written(folder: Path, name: str, content: str) -> Path:
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


def test_yaml_triplets_are_points_and_nan_is_a_gap(tmp_path: Path) -> None:
    (profile,) = read_profiles([written(tmp_path, "p1.yml", YAML)])
    assert profile.points_mm.tolist() == [[2.0, 0.0, -3.5], [4.0, 0.0, -6.0]]
    assert (profile.source, profile.n_gaps) == ("p1.yml", 1)


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("x_mm,z_mm\n1,2\n3,\n5,6\n", [[1, 0, 2], [5, 0, 6]]),
        ("z_mm,y_mm,x_mm\n1,2,3\nnan,0,0\n", [[3, 2, 1]]),
    ],
)
def test_csv_profiles(tmp_path: Path, text: str, points: list[list[float]]) -> None:
    (profile,) = read_profiles([written(tmp_path, "p.csv", text)])
    assert profile.points_mm.tolist() == points


def test_a_folder_or_a_pattern_stands_for_its_profiles_in_natural_order(tmp_path: Path) -> None:
    for name in ("p10.yml", "p2.yml", "p1.yml"):
        written(tmp_path, name, YAML)
    written(tmp_path, "poses.txt", "1 2 3 4 5 6\n")
    for given in (tmp_path, f"{tmp_path}/p*.yml"):
        assert [item.source for item in read_profiles([given])] == ["p1.yml", "p2.yml", "p10.yml"]


def test_a_table_of_poses_beside_the_profiles_is_none_of_them(tmp_path: Path) -> None:
    written(tmp_path, "p1.csv", "x_mm,z_mm,qwality\n1,2,3\n")
    mine = written(tmp_path, "a.csv", "# by us\nx_mm,y_mm,z_mm\n1,2,3\n")
    for k, names in enumerate(
        (
            "a_deg,b_deg,c_deg",
            "A_rad, B_rad, C_rad",
            "qw,qx,qy,qz",
            "a [deg],b [deg],c [deg]",
            "rx,ry,rz",
            "a,b,c",
        )
    ):
        written(tmp_path, f"poses{k}.csv", f"# poses\nx_mm,y_mm,z_mm,{names}\n")
    assert [path.name for path in profile_files(tmp_path)] == ["a.csv", "p1.csv"]
    assert [path.name for path in profile_files(tmp_path, mine)] == ["p1.csv"]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("p.yml", YAML[:-20], "cut short"),
        ("p.yml", "%YAML:1.0\n---\nscan_line: [ 1., 2. ]\n", "three a point"),
        ("p.yml", "%YAML:1.0\n---\nscan_line: [ 1., 2., x ]\n", "'x' in scan_line"),
        ("p.yml", "%YAML:1.0\n---\nscan_line: [ 1., 0., .Nan ]\n", "no point (1 gaps)"),
        ("p.yml", "%YAML:1.0\n---\nother: 1\n", "no list called scan_line"),
        ("p.csv", "x_mm,y\n1,2\n", "no column is called z_mm"),
    ],
)
def test_bad_profiles_are_refused(tmp_path: Path, name: str, text: str, said: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_profiles([written(tmp_path, name, text)])
    assert said in str(caught.value)


ROW = "10 20 1000 0 0 90"


@pytest.mark.parametrize(
    "text",
    [
        f"{ROW}\n{ROW}\n",
        f"# robot 1\nX,Y,Z,W,P,R\n{ROW.replace(' ', ',')}\n{ROW}\n",
        f"\ufeffx_mm,y_mm,z_mm,a_deg,b_deg,c_deg\r\n{ROW}\r\n\r\n{ROW}",
        f'{{"RobPoses": [[{ROW.replace(" ", ",")}], [{ROW.replace(" ", ",")}]]}}',
    ],
)
def test_robot_poses_of_every_form(tmp_path: Path, text: str) -> None:
    poses = read_robot_poses(written(tmp_path, "poses", text), "extrinsic-xyz")
    assert len(poses) == 2
    np.testing.assert_array_equal(poses[1].translation_mm, [10.0, 20.0, 1000.0])
    np.testing.assert_allclose(poses[1].rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def printed(rows: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.7f}" for value in row) for row in rows)


TURN = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
PLACE = np.array([10.0, 20.0, 1000.0])
MATRIX = np.column_stack([TURN.as_matrix(), PLACE])
WHOLE = np.vstack([MATRIX, [0.0, 0.0, 0.0, 1.0]])
X, Y, Z, W = TURN.as_quat()
ANGLES = np.degrees(TURN.as_euler("xyz"))
VECTOR = TURN.as_rotvec()
METRES = PLACE / 1000.0


def table(header: str, *row: object) -> str:
    return header + "\n" + printed(np.array([np.hstack(row)] * 2))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "convention"),
    [
        (table("", MATRIX.ravel()), "intrinsic-xyz"),
        (table("", WHOLE.ravel()), "intrinsic-xyz"),
        (printed(np.vstack([MATRIX, MATRIX])), "intrinsic-xyz"),
        (printed(np.vstack([WHOLE, WHOLE])), "intrinsic-xyz"),
        (f"[{WHOLE.tolist()}, {WHOLE.ravel().tolist()}]", "intrinsic-xyz"),
        (table("m00 m01 m02 m03 m10 m11 m12 m13 m20 m21 m22 m23", MATRIX.ravel()), "intrinsic-xyz"),
        (table("# metres", np.column_stack([TURN.as_matrix(), METRES]).ravel()), "intrinsic-xyz"),
        (table("# places in metres, angles in degrees", METRES, ANGLES), "extrinsic-xyz"),
        (table("# Unit: meters", METRES, ANGLES), "extrinsic-xyz"),
        (table("# x y z (in metres), repeatability 0.1 mm", METRES, ANGLES), "extrinsic-xyz"),
        (table("# x y z metres, angles in degrees", METRES, ANGLES), "extrinsic-xyz"),
        (table("# arm stands 3 metres from the door", PLACE, ANGLES), "extrinsic-xyz"),
        (table("# was in metres, is in mm now", PLACE, ANGLES), "extrinsic-xyz"),
        (table("# in metres\nx_mm,y_mm,z_mm,a_deg,b_deg,c_deg", PLACE, ANGLES), "extrinsic-xyz"),
        (table("x,y,z,qw,qx,qy,qz", PLACE, W, X, Y, Z), "intrinsic-xyz"),
        (table("x_mm y_mm z_mm qx qy qz qw", PLACE, X, Y, Z, W), "intrinsic-xyz"),
        (table("x [m],y [m],z [m],qx,qy,qz,qw", METRES, X, Y, Z, W), "intrinsic-xyz"),
        (table("x_m,y_m,z_m,a_deg,b_deg,c_deg", METRES, ANGLES), "extrinsic-xyz"),
        (table("", PLACE, ANGLES), "extrinsic-xyz"),
        (table("x,y,z,a_rad,b_rad,c_rad", PLACE, np.radians(ANGLES)), "extrinsic-xyz"),
        (table("", PLACE, ANGLES[::-1]), "intrinsic-zyx"),
        (table("", PLACE, VECTOR), "rotation-vector"),
        (table("x,y,z,rx_deg,ry_deg,rz_deg", PLACE, np.degrees(VECTOR)), "rotation-vector"),
    ],
)
def test_poses_as_robots_write_them(tmp_path: Path, text: str, convention: EulerConvention) -> None:
    for pose in read_robot_poses(written(tmp_path, "poses", text), convention):
        np.testing.assert_allclose(pose.translation_mm, PLACE, atol=1e-3)
        np.testing.assert_allclose(pose.rotation, TURN.as_matrix(), atol=1e-6)


def test_the_convention_decides_what_the_angles_mean(tmp_path: Path) -> None:
    """W = P = 90 deg: R = Ry Rx sends x to -z, R = Rx Ry sends it to y."""
    path = written(tmp_path, "poses", "0 0 500 90 90 0\n")
    extrinsic = read_robot_poses(path, "extrinsic-xyz")[0].rotation
    intrinsic = read_robot_poses(path, "intrinsic-xyz")[0].rotation
    np.testing.assert_allclose(extrinsic @ [1, 0, 0], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(intrinsic @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2 3 4 5\n", "line 1: a pose is not six numbers"),
        ("Z,Y,X,W,P,R\n1 2 3 4 5 6\n", "line 1: the header Z,Y,X,W,P,R is not understood"),
        ("x_cm,y_cm,z_cm,a,b,c\n1 2 3 4 5 6\n", "the units of the header"),
        ("x_mm,y_m,z_mm,a,b,c\n1 2 3 4 5 6\n", "the units of the header"),
        ("x,y,z,a_gon,b_gon,c_gon\n1 2 3 4 5 6\n", "the units of the header"),
        ("1 2 3 nan 5 6\n", "line 1: a pose is not six numbers"),
        ('{"RobPoses": [[1, 2, 3, 4, 5, null]]}', "pose 1: a pose is not six numbers"),
        ('{"Poses": []}', "no list called RobPoses"),
        ("# nothing\n", "no pose"),
        ("0 0 500 1 0 0 0\n", "a pose is not six numbers: here are 7"),
        (f"x,y,z,qw,qx,qy,qz\n{ROW}\n", "a pose is not seven numbers"),
        ("x,y,z,qw,qx,qy,qz\n0 0 500 1 1 0 0\n", "norm is 1.4142136"),
        ("1 0 0 5\n0 1 0 5\n", "2 lines of four numbers are no matrices"),
        ("1 0 0 5 0 1 0 5 0 0 -1 500\n", "mirrors"),
        ("1 0 0 5 0 1 0 5 0 0 1 500 0 0 0 2\n", "last row of a 4 x 4 matrix"),
        ("x;y;z;w;p;r\n1,5;2,5;0,5;0,0;90,0;0,0\n", "line 2: the numbers have commas as decimal"),
        ("1,5 2 0,5 0 90,0 0\n", "line 1: the numbers have commas as decimal signs"),
        ("0 0 90 1300 500 200\n", "an angle of 1300 deg"),
        ("1.3 0 .5 0 0 0\n1.2 0 .5 20 0 0\n1.2 .1 .5 0 20 0\n", "look like metres"),
    ],
)
def test_bad_pose_tables_are_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_robot_poses(written(tmp_path, "poses", text), "extrinsic-xyz")
    assert said in str(caught.value)


@needs("sphere_profiles", "plate_profiles")
@pytest.mark.parametrize(
    ("folder", "table", "count"),
    [("sphere_profiles", "RobPoses.rob", 15), ("plate_profiles", "rob2board.txt", 12)],
)
def test_the_reference_profiles_and_poses_are_read(folder: str, table: str, count: int) -> None:
    profiles = read_profiles([DATA / folder])
    poses = read_robot_poses(DATA / folder / table, "extrinsic-xyz")
    assert len(profiles) == len(poses) == count
    assert [int(item.source.strip("p").split("_")[0].split(".")[0]) for item in profiles] == [
        *range(1, count + 1)
    ]
    assert all(len(item) > 100 and not item.points_mm[:, 1].any() for item in profiles)


FILES = [Path("scans/1.png"), Path("scans/2.png"), Path("scans/10.png")]


@pytest.mark.parametrize(
    "text",
    [
        "10.png 10 2 3 0 0 0|1.png 1 2 3 0 0 0|extra.png 7 7 7 0 0 0|2.png 2 2 3 0 0 0",
        "image,x,y,z,qx,qy,qz,qw|1.png,1,2,3,0,0,0,1|10.png,10,2,3,0,0,0,1|2.png,2,2,3,0,0,0,1",
        'filename; x; y; z; a; b; c|"scans\\1.png"; 1; 2; 3; 0; 0; 0|'
        "x/scans/10.png; 10; 2; 3; 0; 0; 0|2.png; 2; 2; 3; 0; 0; 0",
        "name,x_m,y_m,z_m,a,b,c|2,.002,.002,.003,0,0,0|10,.01,.002,.003,0,0,0|1,.001,.002,.003,0,0,0",
        "2.png 1 0 0 2 0 1 0 2 0 0 1 3|1.png 1 0 0 1 0 1 0 2 0 0 1 3|"
        "10.png 1 0 0 10 0 1 0 2 0 0 1 3",
    ],
)
def test_poses_that_name_their_files_go_to_these_whatever_the_order(
    tmp_path: Path, text: str
) -> None:
    path = written(tmp_path, "p.txt", text.replace("|", "\n"))
    poses = read_robot_poses(path, "extrinsic-xyz", FILES)
    assert [pose.translation_mm.round(9).tolist() for pose in poses] == [
        [1.0, 2.0, 3.0],
        [2.0, 2.0, 3.0],
        [10.0, 2.0, 3.0],
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1.png 1 2 3 0 0 0\n2.png 1 2 3 0 0 0\n", "there is no pose of 10.png"),
        ("pose1 1 2 3 0 0 0\npose2 1 2 3 0 0 0\n", "there is no pose of 1.png"),
        ("1.png 1 2 3 0 0 0\n1 1 2 3 0 0 0\n", "two poses of 1.png"),
        ("1.png 1 2 3 0 0 0\n2.png\n", "p.txt, line 2"),
        ("image,foo,bar\n1.png,1,2\n", "the header foo,bar is not understood"),
    ],
)
def test_names_that_do_not_go_with_the_files_are_refused(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_robot_poses(written(tmp_path, "p.txt", text), "extrinsic-xyz", FILES)
    assert said in str(caught.value)


def test_poses_without_names_come_as_they_stand(tmp_path: Path) -> None:
    path = written(tmp_path, "p.txt", "9 2 3 0 0 0\n1 2 3 0 0 0\n")
    given = [pose.translation_mm[0] for pose in read_robot_poses(path, "extrinsic-xyz", FILES)]
    assert given == [9.0, 1.0]


@pytest.mark.parametrize("decimals", [4, 5, 6])
@pytest.mark.parametrize("form", ["quaternion", "matrix"])
def test_rotations_that_are_written_with_few_decimals_are_read(
    form: PoseForm, decimals: int
) -> None:
    """As rounding leaves them; one wrong digit is still found."""
    true = Rotation.random(300, np.random.default_rng(decimals))
    exact = np.roll(true.as_quat(), 1, axis=1)
    if form == "matrix":
        exact = true.as_matrix().reshape(-1, 9)
    rounded, places = exact.round(decimals), [str(k) for k in range(300)]
    found = Rotation.from_matrix(rotations_of_form(rounded, form, "extrinsic-xyz", places))
    assert (found * true.inv()).magnitude().max() < 2.0 * 10.0**-decimals
    changed = rounded.copy()
    largest = int(np.argmax(np.abs(changed[7])))
    changed[7, largest] -= 6.0 * 10.0**-decimals * np.sign(changed[7, largest])
    if 6.0 * 10.0**-decimals > 5e-5:
        with pytest.raises(FileFormatError):
            rotations_of_form(changed, form, "extrinsic-xyz", places)


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    files = [Path("left/1.png"), Path("right/1.png")]
    text = "right/1.png 2 0 900 0 0 0\nleft/1.png 1 0 900 0 0 0\n"
    poses = read_robot_poses(written(tmp_path, "p.txt", text), "extrinsic-xyz", files)
    assert [pose.translation_mm[0] for pose in poses] == [1.0, 2.0]
    with pytest.raises(FileFormatError, match=r"1\.png may be left/1\.png or right/1\.png"):
        read_robot_poses(written(tmp_path, "q.txt", "1.png 2 0 9 0 0 0\n"), "extrinsic-xyz", files)
    with pytest.raises(FileFormatError, match=r"left/1\.png may be left/1\.png or right/1\.png"):
        left_only = written(tmp_path, "r.txt", "left/1.png 1 0 9 0 0 0\n")
        read_robot_poses(left_only, "extrinsic-xyz", files)


@pytest.mark.parametrize(
    "text",
    [
        'image,x,y,z,a,b,c\nshot#1.png,1,2,3,0,0,0\n"left, #2.png",2,2,3,0,0,0 # moved\n',
        'shot#1.png 1 2 3 0 0 0#first\n# none\n"left, #2.png"; 2; 2; 3; 0; 0; 0\n',
        '"left, #2.png","2","2","3","0","0","0"\n"shot#1.png","1","2","3","0","0","0"\n',
    ],
)
def test_names_of_files_may_hold_a_number_sign_and_quoted_ones_commas(
    tmp_path: Path, text: str
) -> None:
    """A # cut the line off, and a comma the name."""
    files = [Path("shot#1.png"), Path("left, #2.png")]
    poses = read_robot_poses(written(tmp_path, "p.csv", text), "extrinsic-xyz", files)
    assert [pose.translation_mm[0] for pose in poses] == [1.0, 2.0]


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3 0 0 0#first\n",
        "x,y,z,a,b,c#deg\n1,2,3,0,0,0\n",
        '"1","2","3","0","0","0" # first\n',
        "#a.png 9\n1,2,3,0,0,0,#first\n",
    ],
)
def test_comments_behind_numbers_stay_comments(tmp_path: Path, text: str) -> None:
    (pose,) = read_robot_poses(written(tmp_path, "p.csv", text), "extrinsic-xyz")
    assert pose.translation_mm.tolist() == [1.0, 2.0, 3.0]
