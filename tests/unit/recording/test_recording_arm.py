# SPDX-License-Identifier: Apache-2.0
"""Rules of ``arm.csv``: forms, conventions, gaps, units."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError
from armscan.jobs.live.recordings import recording_mark
from armscan.models.arm import ArmModel, forward, thesis_arm
from armscan.storage.arm import arm_model_toml, read_arm_model
from armscan.storage.recording import (
    FolderRecording,
    camera_tables,
    read_recording,
    recording_tables,
)
from rigs.recording_folders import ARM, POSITION, SESSION, lab_folder, refusal, table

NO_SESSION = SESSION.replace('form = "quaternion"\n', "")
ANGLES = np.array([[10.0, 0.0, 0.0], [30.0, -40.0, 75.0], [-170.0, 20.0, 100.0]])
SCIPY_NAMES = {"intrinsic-xyz": "XYZ", "extrinsic-xyz": "xyz", "intrinsic-zxz": "ZXZ"}


def track_of(tmp_path: Path, header: str, numbers: np.ndarray, session: str) -> FolderRecording:
    lines = [
        f"{500 + 1500 * k},{900 + k},0,0," + ",".join(repr(float(value)) for value in row)
        for k, row in enumerate(numbers)
    ]
    return read_recording(
        lab_folder(tmp_path, arm=table(POSITION + header, *lines), session=session)
    )


@pytest.mark.parametrize("convention", SCIPY_NAMES)
def test_euler_angles_of_each_convention(tmp_path: Path, convention: str) -> None:
    session = SESSION.replace('"quaternion"', f'"euler"\nrotation = "{convention}"')
    scan = track_of(tmp_path, "a_deg,b_deg,c_deg", ANGLES, session)
    expected = Rotation.from_euler(SCIPY_NAMES[convention], ANGLES, degrees=True).as_matrix()
    assert scan.arm is not None
    np.testing.assert_allclose(scan.arm.rotations, expected, atol=1e-15)


def test_matrices_are_row_by_row(tmp_path: Path) -> None:
    rotations = Rotation.from_euler("xyz", ANGLES, degrees=True).as_matrix()
    header = "r11,r12,r13,r21,r22,r23,r31,r32,r33"
    scan = track_of(tmp_path, header, rotations.reshape(-1, 9), NO_SESSION)
    assert scan.arm is not None
    np.testing.assert_allclose(scan.arm.rotations, rotations, atol=1e-15)
    rounded = track_of(tmp_path / "b", header, rotations.reshape(-1, 9).round(6), NO_SESSION).arm
    assert rounded is not None
    defect = rounded.rotations @ rounded.rotations.transpose(0, 2, 1) - np.eye(3)
    assert np.abs(defect).max() < 1e-14


def test_a_quaternion_is_w_x_y_z_active_and_of_either_sign(tmp_path: Path) -> None:
    """Half of 90 degrees about z: x goes to y."""
    half = np.sqrt(0.5)
    numbers = np.array([[half, 0, 0, half], [-half, 0, 0, -half], [half, 0, 0, half + 5e-7]])
    scan = track_of(tmp_path, "qw,qx,qy,qz", numbers, SESSION)
    assert scan.arm is not None
    for rotation in scan.arm.rotations:
        np.testing.assert_allclose(rotation @ [1, 0, 0], [0, 1, 0], atol=1e-6)


def test_joints_go_through_the_arms_geometry(tmp_path: Path) -> None:
    model = thesis_arm((300, 400, 300, 100), (20, 30, 20))
    joints = np.random.default_rng(1).uniform(-3, 3, (3, 7))
    header = "t_ns," + ",".join(f"j{k}_rad" for k in range(1, 8))
    lines = [
        f"{500 + 1500 * k}," + ",".join(map(repr, row)) for k, row in enumerate(joints.tolist())
    ]
    text = table(header, *lines)
    session = SESSION.replace("quaternion", "joints")
    assert "joint angles need the arm's geometry" in refusal(tmp_path, arm=text, session=session)
    rotations, positions = forward(model, joints)
    for scan in (read_recording(tmp_path / "scan", model), _with_model(tmp_path / "scan", model)):
        assert scan.arm is not None and scan.arm.joints_rad is not None
        np.testing.assert_array_equal(scan.arm.joints_rad, joints)
        np.testing.assert_allclose(scan.arm.rotations, rotations, atol=1e-12)
        np.testing.assert_allclose(scan.arm.translations_mm, positions, atol=1e-9)


def test_what_a_recording_gives_follows_from_its_arms_geometry_too(tmp_path: Path) -> None:
    folder = lab_folder(tmp_path)
    assert camera_tables(folder) == tuple(
        p for p in recording_tables(folder) if "arm" not in p.name
    )
    before = recording_mark(folder, "")
    (folder / "arm.toml").write_text("name = 'x'\n")
    assert folder / "arm.toml" in recording_tables(folder)
    assert folder / "arm.toml" not in camera_tables(folder)
    between = recording_mark(folder, "")
    (folder / "arm.toml").write_text("name = 'y'\n")
    assert len({before, between, recording_mark(folder, "")}) == 3


def _with_model(folder: Path, model: ArmModel) -> FolderRecording:
    (folder / "arm.toml").write_bytes(arm_model_toml(model))
    return read_recording(folder)


@pytest.mark.parametrize(
    "gap", ["901,1,400,,,,", ",,,,,,", "nan,1,400,0.8,0.6,0,0", ",1,400,NaN,0,0,0"]
)
def test_an_empty_or_nan_pose_is_a_gap(tmp_path: Path, gap: str) -> None:
    lines = ARM.splitlines()
    scan = read_recording(
        lab_folder(tmp_path, arm=table(lines[0], lines[1], f"1500,{gap}", lines[3]))
    )
    assert scan.arm is not None and scan.arm.is_known.tolist() == [True, False, True]
    assert any("1 of 3 samples have no pose" in warning for warning in scan.warnings)


def two_forms(turn_deg: float) -> str:
    """Quaternions of 40 degrees about z, and angles of so much more."""
    half = np.radians(20.0)
    pose = f"{float(np.cos(half))!r},0,0,{float(np.sin(half))!r},0,0,{40.0 + turn_deg}"
    lines = (f"{500 + 1500 * k},{900 + k},0,400,{pose}" for k in range(3))
    return table(POSITION + "qw,qx,qy,qz,a_deg,b_deg,c_deg", *lines)


def test_of_two_forms_that_agree_one_is_used_and_named(tmp_path: Path) -> None:
    scan = read_recording(lab_folder(tmp_path, arm=two_forms(0.01), session=NO_SESSION))
    assert scan.session.pose_form == "quaternion"
    assert any("which agree; 'quaternion' is used" in text for text in scan.warnings)


def test_of_two_forms_that_differ_the_session_must_say_which(tmp_path: Path) -> None:
    message = refusal(tmp_path / "1", arm=two_forms(0.5), session=NO_SESSION)
    assert "line 2: there are columns of 'quaternion' and of 'euler'" in message
    assert "differ by 0.5 deg" in message and 'form = "euler"' in message
    for form, angle in (("quaternion", 40.0), ("euler", 40.5)):
        session = SESSION.replace("quaternion", form)
        scan = read_recording(lab_folder(tmp_path / form, arm=two_forms(0.5), session=session))
        assert scan.arm is not None
        turned = np.degrees(np.arctan2(scan.arm.rotations[0, 1, 0], scan.arm.rotations[0, 0, 0]))
        assert turned == pytest.approx(angle)
        assert any(f"'{form}' is used, as session.toml says" in text for text in scan.warnings)


def test_joints_beside_poses_are_compared_if_the_arm_is_known(tmp_path: Path) -> None:
    model = thesis_arm((300, 400, 300, 100), (20, 30, 20))
    joints = np.random.default_rng(1).uniform(-3, 3, (3, 7))
    rotations, positions = forward(model, joints)
    header = "t_ns,x_mm,y_mm,z_mm,r11,r12,r13,r21,r22,r23,r31,r32,r33,j1_rad,j2_rad,j3_rad,j4_rad"

    def text(off_mm: float) -> str:
        numbers = np.hstack([positions + np.array([off_mm, 0, 0]), rotations.reshape(3, 9), joints])
        lines = (
            f"{500 + 1500 * k}," + ",".join(map(repr, row))
            for k, row in enumerate(numbers.tolist())
        )
        return table(header + ",j5_rad,j6_rad,j7_rad", *lines)

    for off_mm, stated, said in (
        (2.0, NO_SESSION, "which agree; 'matrix' is used"),
        (20.0, SESSION.replace("quaternion", "matrix"), ""),
    ):
        folder = lab_folder(tmp_path / str(off_mm), arm=text(off_mm), session=stated)
        assert said in "".join(read_recording(folder, model).warnings)
        assert bool(read_recording(folder, model).warnings) == bool(said)
    folder = lab_folder(tmp_path, arm=text(20.0), session=NO_SESSION)
    with pytest.raises(FileFormatError, match=r"differ by .* deg and 20 mm"):
        read_recording(folder, model)
    assert any("nobody says which" in text for text in read_recording(folder).warnings)


BAD_ARM = {
    "empty file": ("", "empty"),
    "no rows": (ARM.splitlines()[0] + "\n", "no sample"),
    "duplicate time": (ARM.replace("3500,", "1500,"), "line 4: t_ns 1500 appears again"),
    "time back": (ARM.replace("3500,", "1499,"), "line 4: t_ns goes back from 1500"),
    "no norm": (ARM.replace("0.8,0.6", "0.8,0.7"), "line 3: the quaternion's norm is 1.06"),
    "swapped columns": (ARM.replace("z_mm,qw", "qw,z_mm"), "norm is 400"),
    "norm off by 2e-6": (ARM.replace("0.8,0.6", "0.8000025,0.6"), "not 1 within 1e-06"),
    "infinite": (ARM.replace("901", "inf"), "line 3: 'inf' in column x_mm is no number"),
    "Python's digits": (ARM.replace("900,", "9_00,"), "line 2: '9_00' in column x_mm is no number"),
    "other digits": (ARM.replace("900,", "\u0669\u0660\u0660,"), "in column x_mm is no number"),
    "infinity": (ARM.replace("901", "infinity"), "'infinity' in column x_mm is no number"),
    "too large": (ARM.replace("901", "1e999"), "'1e999' in column x_mm is no number"),
    "10 km away": (ARM.replace("901", "1.1e7"), "line 3: 1.1e+07 in column x_mm is beyond"),
    "text": (ARM.replace("901", "lost"), "'lost' in column x_mm is no number"),
    "order not said": (ARM.replace("qw,qx,qy,qz", "q1,q2,q3,q4"), "order of the quaternion"),
    "no units": (ARM.replace("x_mm,y_mm,z_mm,qw,qx,qy,qz", "x,y,z,w,a,b,c"), "lack units"),
    "metres by name": (ARM.replace("x_mm,y_mm,z_mm", "x_m,y_m,z_m"), "metres"),
    "other form": (ARM.replace("qw,qx,qy,qz", "a_deg,b_deg,c_deg,d"), "are those of 'euler'"),
    "cut": (ARM[:-4], "line 4: 7 cells"),
    "decimal commas": (ARM.replace("0.8,0.6", "0,8,0,6"), "decimal point"),
}


@pytest.mark.parametrize("case", BAD_ARM)
def test_bad_poses_are_refused(tmp_path: Path, case: str) -> None:
    text, said = BAD_ARM[case]
    message = refusal(tmp_path, arm=text)
    assert said in message and "arm.csv" in message


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1,0,0,0,1,0,0,0,-1", "mirrors"),
        ("1,0,0,0,1,0,0,0,1.01", "not orthonormal"),
        ("10,0,0,0,1,0,0,0,0.1", "not orthonormal"),
    ],
)
def test_what_is_no_rotation_matrix_is_refused(tmp_path: Path, row: str, said: str) -> None:
    header = "t_ns,x_mm,y_mm,z_mm,r11,r12,r13,r21,r22,r23,r31,r32,r33"
    text = table(header, f"500,900,0,0,{row}", "5000,900,0,0,1,0,0,0,1,0,0,0,1")
    assert said in refusal(tmp_path, arm=text, session=NO_SESSION)


def test_euler_angles_of_many_turns_are_swapped_columns(tmp_path: Path) -> None:
    text = table(POSITION + "a_deg,b_deg,c_deg", "500,0,0,90,900,20,10", "5000,0,0,90,900,20,10")
    assert "angle of 900 deg" in refusal(tmp_path, arm=text, session=NO_SESSION)


def test_joints_in_degrees_are_refused_and_doubtful_ones_warned_of(tmp_path: Path) -> None:
    model = thesis_arm((300, 400, 300, 100), (20, 30, 20))
    header = "t_ns," + ",".join(f"j{k}_rad" for k in range(1, 8))
    for largest, is_refused in ((90.0, True), (7.0, False)):
        text = table(header, f"500,{largest},1,2,3,1,0,0", "5000,1,1,1,1,1,1,1")
        folder = lab_folder(tmp_path / str(largest), arm=text, session=NO_SESSION)
        (folder / "arm.toml").write_bytes(arm_model_toml(model))
        if is_refused:
            with pytest.raises(FileFormatError, match="look like degrees"):
                read_recording(folder)
        else:
            assert any("degrees?" in text for text in read_recording(folder).warnings)


def poses(positions: np.ndarray, vectors: np.ndarray) -> str:
    quaternions = np.roll(Rotation.from_rotvec(vectors).as_quat(), 1, axis=1)
    lines = [
        f"{500 + 1500 * k}," + ",".join(map(repr, row))
        for k, row in enumerate(np.hstack([positions, quaternions]).tolist())
    ]
    return table(ARM.splitlines()[0], *lines)


PATH_MM = np.array([[900.0, 0, 400], [850, 90, 420], [800, 160, 380], [820, 100, 300]])
TURNS = np.array([[0.0, 0, 0], [0.3, 0, 0.1], [0, 0.4, 0], [0.1, 0.2, 0.5]])


def test_metres_are_refused(tmp_path: Path) -> None:
    assert "look like metres" in refusal(tmp_path, arm=poses(PATH_MM / 1000, TURNS))


@pytest.mark.parametrize("case", ["arm", "stage", "turntable", "gimbal", "tripod"])
def test_no_recording_in_millimetres_is_taken_for_metres(tmp_path: Path, case: str) -> None:
    """A stage does not turn, a table turns about one axis, a gimbal stays where it is."""
    about_z = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 0, 3]])
    positions, vectors = {
        "arm": (PATH_MM, TURNS),
        "stage": (PATH_MM / 1000, 0 * TURNS),
        "turntable": (PATH_MM / 500, about_z),
        "gimbal": (np.tile([5.0, 0, 0], (4, 1)), TURNS),
        "tripod": (0 * PATH_MM, 0 * TURNS),
    }[case]
    scan = read_recording(lab_folder(tmp_path, arm=poses(positions, vectors)))
    is_warned = any("are they in metres?" in warning for warning in scan.warnings)
    assert is_warned == (case in ("stage", "turntable", "gimbal"))


def test_unknown_columns_of_the_arm_are_kept_and_warned_of(tmp_path: Path) -> None:
    text = "\n".join(
        line + extra
        for line, extra in zip(ARM.splitlines(), (",force_n", ",1", ",", ",x"), strict=True)
    )
    scan = read_recording(lab_folder(tmp_path, arm=text + "\n"))
    assert scan.arm_columns == {"force_n": ("1", "", "x")}
    assert any("arm.csv: columns not known, kept: force_n" in item for item in scan.warnings)


def test_joints_beyond_the_limits_of_their_arm_are_warned_of_by_name(tmp_path: Path) -> None:
    limits = np.full(7, 1.0)
    limits[5] = np.inf
    free = thesis_arm((300, 0, 300, 100), (20, 30, 20))
    model = replace(free, joint_min_rad=-limits, joint_max_rad=limits)
    joints = np.array([[0.1] * 7, [0.1, 1.1, 0.1, 0.1, 0.1, 3.0, -1.2], [0.1] * 6 + [-1.3]])
    rows = [
        f"{500 + 1500 * k}," + ",".join(map(repr, row)) for k, row in enumerate(joints.tolist())
    ]
    text = table("t_ns," + ",".join(f"j{k}_rad" for k in range(1, 8)), *rows)
    folder = lab_folder(tmp_path, arm=text, session=SESSION.replace("quaternion", "joints"))
    said = {}
    for one in (free, model):
        (folder / "arm.toml").write_bytes(arm_model_toml(one))
        said[one is model] = [
            item for item in read_recording(folder).warnings if "beyond its limits" in item
        ]
    assert not said[False]
    assert [item.split(": ")[1] for item in said[True]] == [
        "joint j2_rad is beyond its limits in arm.toml in 1 of 3 samples",
        "joint j7_rad is beyond its limits in arm.toml in 2 of 3 samples",
    ]


def test_an_arms_geometry_comes_back_bit_by_bit(tmp_path: Path) -> None:
    model = thesis_arm((300, 1 / 3, 300, 100), (20, 30, 20), name='Arm "7"')
    path = tmp_path / "arm.toml"
    path.write_bytes(arm_model_toml(model))
    found = read_arm_model(path)
    np.testing.assert_array_equal(found.parameters, model.parameters)
    np.testing.assert_array_equal(found.flange.matrix, model.flange.matrix)
    assert (found.name, found.joint_min_rad) == (model.name, None)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name = 'x'\n", "axis"),
        ("[[axis]]\ntwist_rad = 1.0\n", "axis.0.theta_offset_rad"),
        ("[[axis]\n", "no TOML"),
        ("name = 3\n", "name"),
    ],
)
def test_a_bad_arm_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_arm_model(path)
    assert said in str(caught.value)
