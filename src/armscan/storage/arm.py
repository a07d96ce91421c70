# SPDX-License-Identifier: Apache-2.0
"""The arm's files: its geometry (``arm.toml``), its track (``arm.csv``), and touches of its
probe.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats
from armscan.geometry.poses import Pose, Tool
from armscan.geometry.rotations import EulerConvention
from armscan.models.arm import AXIS_PARAMETERS, ArmModel, forward
from armscan.records.recording import NO_TRIGGER, ArmTrack, PoseForm, Session
from armscan.storage.codec import Layout, MismatchError, RecordCodec, parse_toml, toml_bytes
from armscan.storage.files import new_folder, path_text, read_bytes, told_of
from armscan.storage.recording_session import SESSION_FILE, session_toml
from armscan.storage.recordings.robot_poses import (
    FORM_COLUMNS,
    METRES_REMEDY,
    POSITION,
    are_surely_metres,
    are_within_reach_of_base,
    pose_numbers,
    rotations_of_form,
)
from armscan.storage.tables import CsvTable, csv_bytes, number_columns

ARM_MODEL_FILE = "arm.toml"
AXES_REMEDY = f"write [[axis]] with {', '.join(AXIS_PARAMETERS)} for each joint"


@dataclass(frozen=True, slots=True)
class _Axis:
    """``[[axis]]``: ``Rz(theta + theta_offset) Tz(offset) Tx(length) Rx(twist)`` (eq. 2.1)."""

    theta_offset_rad: float
    offset_mm: float
    length_mm: float
    twist_rad: float
    joint_min_rad: float | None = None
    joint_max_rad: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Flange:
    """``[flange]``: Tool in the frame of the last axis."""

    rotation_rows: FloatArray = field(default_factory=lambda: np.eye(3))
    translation_mm: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class _Arm:
    """The whole of ``arm.toml``."""

    axis: tuple[_Axis, ...]
    name: str = "arm"
    flange: _Flange = field(default_factory=_Flange)


def read_arm_model(path: Path) -> ArmModel:
    """Read ``arm.toml``."""
    where = path_text(path)
    content = parse_toml(read_bytes(path), where, AXES_REMEDY)
    with told_of(where, remedy=AXES_REMEDY):
        try:
            tables = RecordCodec().read(_Arm, content)
        except MismatchError as error:
            raise InputError(f"the arm is not valid: {error}") from error
        return _arm_model(tables)


def _arm_model(tables: _Arm) -> ArmModel:
    axes = {
        name: np.array([getattr(axis, name) for axis in tables.axis]) for name in AXIS_PARAMETERS
    }
    low = [-math.inf if axis.joint_min_rad is None else axis.joint_min_rad for axis in tables.axis]
    high = [math.inf if axis.joint_max_rad is None else axis.joint_max_rad for axis in tables.axis]
    flange: Pose[Tool, Tool] = Pose(tables.flange.rotation_rows, tables.flange.translation_mm)
    has_limits = bool(np.isfinite([*low, *high]).any())
    return ArmModel(
        **axes,
        flange=flange,
        joint_min_rad=np.array(low) if has_limits else None,
        joint_max_rad=np.array(high) if has_limits else None,
        name=tables.name,
    )


def arm_model_toml(arm: ArmModel) -> bytes:
    """Text of ``arm.toml``; reads back as the same numbers."""
    columns = {name: getattr(arm, name).tolist() for name in AXIS_PARAMETERS}
    low, high = arm.joint_limits_rad
    columns["joint_min_rad"] = [float(angle) if np.isfinite(angle) else None for angle in low]
    columns["joint_max_rad"] = [float(angle) if np.isfinite(angle) else None for angle in high]
    axes = [{name: column[k] for name, column in columns.items()} for k in range(arm.n_axes)]
    flange = _Flange(arm.flange.rotation, arm.flange.translation_mm)
    return toml_bytes({"name": arm.name, "axis": axes, "flange": RecordCodec().write(flange)})


ARM_FILE = "arm.csv"
JOINT = re.compile(r"j([0-9]{1,2})_rad")
WARN_TURNS_RAD = 2.0 * np.pi
REFUSE_TURNS_RAD = 4.0 * np.pi
FORMS_AGREE_DEG = 0.02
"""Angles of two decimals differ less from the rotation that they were rounded from."""
JOINTS_AGREE_DEG, JOINTS_AGREE_MM = 1.0, 10.0
"""An arm's nominal geometry differs less from what its controller reports."""

Columns = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class ArmTable:
    """What ``arm.csv`` says."""

    track: ArmTrack
    form: PoseForm
    extra: Columns
    warnings: tuple[str, ...]


def read_arm_table(
    table: CsvTable,
    form: PoseForm | None,
    rotation: EulerConvention,
    arm: ArmModel | None,
) -> ArmTable:
    """Samples of ``arm.csv``; a row is ``base_from_tool``.

    Parameters
    ----------
    table
        The file.
    form
        How the poses are written; None lets the columns decide.
    rotation
        Convention of Euler angles.
    arm
        Turns joint angles into poses; needed for the form ``joints`` only.

    Raises
    ------
    FileFormatError
        If columns are missing, a time or trigger id appears twice, times go back, a rotation is
        none, numbers can only be in another unit, or the columns hold poses of two forms that
        differ and nobody says which.
    """
    table.require(("t_ns",))
    if not len(table):
        raise FileFormatError(
            "the table holds no sample", where=table.where, remedy="write one line a sample"
        )
    times = _times(table)
    complete = _complete_forms(table)
    chosen = _form(table, form, complete)
    joint_names = _joint_names(table)
    used = ("t_ns", "trigger_id", *joint_names)
    joints = table.floats(joint_names, may_lack=True) if joint_names else None
    if chosen == "joints":
        is_known, rotations, positions = _from_joints(table, joints, arm)
    else:
        used += (*POSITION, *FORM_COLUMNS[chosen])
        is_known, rotations, positions = _from_poses(table, chosen, rotation)
    if are_surely_metres(rotations[is_known], positions[is_known]):
        raise FileFormatError(
            "the tool turns and moves but stays within 10 mm of Base's origin: positions look "
            "like metres",
            where=table.where,
            remedy=METRES_REMEDY,
        )
    track = ArmTrack(
        t_ns=times,
        rotations=rotations,
        translations_mm=positions,
        is_known=is_known,
        trigger_ids=_triggers(table),
        joints_rad=joints,
    )
    extra = {name: cells for name, cells in table.columns.items() if name not in used}
    others = [other for other in complete if other != chosen]
    if form is None:
        found = [_compared(table, track, chosen, (other, rotation), arm) for other in others]
    else:
        found = [_left(table, chosen, other) for other in others if other != "joints"]
    return ArmTable(track, chosen, extra, (*found, *_warnings(track, table.where, arm)))


def arm_columns(
    track: ArmTrack, form: PoseForm, rotation: EulerConvention, extra: Columns
) -> dict[str, tuple[str, ...]]:
    """Columns of ``arm.csv``: poses in the form asked for, and joints wherever they are known.

    Raises
    ------
    InputError
        If joints are asked for and not known.
    """
    columns = {"t_ns": tuple(str(time) for time in track.t_ns)}
    if form == "joints" and track.joints_rad is None:
        raise InputError("the arm gave no joint angles", remedy="write its poses")
    if form != "joints":
        numbers = np.hstack(
            [track.translations_mm, pose_numbers(track.rotations, track.is_known, form, rotation)]
        )
        numbers[~track.is_known] = np.nan
        columns |= number_columns((*POSITION, *FORM_COLUMNS[form]), numbers)
    if track.joints_rad is not None:
        names = tuple(f"j{k}_rad" for k in range(1, track.joints_rad.shape[1] + 1))
        columns |= number_columns(names, track.joints_rad)
    ids = track.trigger_ids
    if ids is not None and (ids != NO_TRIGGER).any():
        columns["trigger_id"] = tuple("" if k == NO_TRIGGER else str(k) for k in ids)
    return {**columns, **extra}


def _times(table: CsvTable) -> IntArray:
    times = table.ints("t_ns")
    table.refuse_repeats("t_ns", times.tolist(), "remove one of the two samples")
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        raise FileFormatError(
            f"t_ns goes back from {times[back[0]]}",
            where=table.place(int(back[0]) + 1),
            remedy="sort the lines by time",
        )
    return times


def _triggers(table: CsvTable) -> IntArray | None:
    if "trigger_id" not in table:
        return None
    ids = table.ints("trigger_id", NO_TRIGGER)
    seen: dict[int, int] = {}
    for k, number in enumerate(ids.tolist()):
        if not table.columns["trigger_id"][k]:
            continue
        if number < 0 or number in seen:
            fact = "is negative" if number < 0 else f"is in line {table.lines[seen[number]]} too"
            raise FileFormatError(
                f"trigger_id {number} {fact}",
                where=table.place(k),
                remedy="give each trigger one sample of the arm and a number from 0 on",
            )
        seen[number] = k
    return ids


def _complete_forms(table: CsvTable) -> list[PoseForm]:
    """Forms of which all columns are there."""
    complete: list[PoseForm] = [
        form
        for form, names in FORM_COLUMNS.items()
        if form != "joints" and all(name in table for name in (*POSITION, *names))
    ]
    return [*complete, "joints"] if _joint_names(table) else complete


def _form(table: CsvTable, stated: PoseForm | None, complete: list[PoseForm]) -> PoseForm:
    if stated is None and complete:
        return complete[0]
    if stated is not None and stated in complete:
        return stated
    _hint_at_names(table)
    if stated == "joints" or (stated is None and any(JOINT.fullmatch(n) for n in table.columns)):
        table.require(("t_ns", "j1_rad"))
    form = stated or "quaternion"
    if complete:
        raise FileFormatError(
            f"session.toml says '{form}', but the columns are those of '{complete[0]}'",
            where=table.where,
            remedy="correct form under [pose], or the header",
        )
    table.require(("t_ns", *POSITION, *FORM_COLUMNS[form]))
    return form


def _left(table: CsvTable, chosen: PoseForm, other: PoseForm) -> str:
    return (
        f"{table.where}: there are columns of '{chosen}' and of '{other}'; '{chosen}' is used, as "
        "session.toml says"
    )


def _compared(
    table: CsvTable,
    track: ArmTrack,
    chosen: PoseForm,
    other: tuple[PoseForm, EulerConvention],
    arm: ArmModel | None,
) -> str:
    """Refuse columns of a second form that tell of other poses, where nobody says which count."""
    form, rotation = other
    both = f"there are columns of '{chosen}' and of '{form}'"
    limit_deg = JOINTS_AGREE_DEG if form == "joints" else FORMS_AGREE_DEG
    if form != "joints":
        is_known, rotations, positions = _from_poses(table, form, rotation)
    elif arm is not None and track.joints_rad is not None:
        is_known, rotations, positions = _from_joints(table, np.array(track.joints_rad), arm)
    else:
        return f"{table.where}: {both}; '{chosen}' is used, as nobody says which"
    rows = np.flatnonzero(is_known & track.is_known)
    relative = np.einsum("nji,njk->nik", track.rotations[rows], rotations[rows])
    angles = np.degrees(Rotation.from_matrix(relative).magnitude()) if len(rows) else np.zeros(0)
    apart = np.linalg.norm(track.translations_mm[rows] - positions[rows], axis=1)
    is_other = (angles > limit_deg) | (apart > JOINTS_AGREE_MM)
    if is_other.any():
        first = int(np.argmax(is_other))
        raise FileFormatError(
            f"{both}, and they differ by {angles[first]:.3g} deg and {apart[first]:.3g} mm",
            where=table.place(int(rows[first])),
            remedy=f'say form = "{chosen}" or form = "{form}" under [pose] in session.toml'
            + (", or correct rotation there" if "euler" in (chosen, form) else ""),
        )
    return f"{table.where}: {both}, which agree; '{chosen}' is used"


def _hint_at_names(table: CsvTable) -> None:
    """Refuse headers whose meaning is plain, but which are not those of the format."""
    names = set(table.columns)
    hints = (
        ({"x_m"}, "positions are in metres", "multiply them by 1000 and name them x_mm,y_mm,z_mm"),
        ({"a_rad"}, "Euler angles are in radians", "write degrees as a_deg,b_deg,c_deg"),
        ({"j1_deg"}, "joints are in degrees", "write radians as j1_rad, j2_rad and so on"),
        ({"q1", "q2", "q3"}, "the order of the quaternion is not said", "name it qw,qx,qy,qz"),
        ({"w", "x", "y", "z"}, "the columns lack units", "name them x_mm,y_mm,z_mm,qw,qx,qy,qz"),
    )
    for signs, fact, remedy in hints:
        if signs <= names:
            raise FileFormatError(fact, where=table.where, remedy=remedy)


def _joint_names(table: CsvTable) -> tuple[str, ...]:
    """Columns ``j1_rad`` to ``jN_rad`` if there are any and none is missing between."""
    numbers = [int(found[1]) for name in table.columns if (found := JOINT.fullmatch(name))]
    if not numbers:
        return ()
    names = tuple(f"j{k}_rad" for k in range(1, max(numbers) + 1))
    table.require(names)
    return names


def _from_poses(
    table: CsvTable, form: PoseForm, rotation: EulerConvention
) -> tuple[BoolArray, FloatArray, FloatArray]:
    names = (*POSITION, *FORM_COLUMNS[form])
    numbers = table.floats(names, may_lack=True)
    is_known = np.asarray(np.isfinite(numbers).all(axis=1))
    lines = np.flatnonzero(is_known)
    rotations = np.tile(np.eye(3), (len(table), 1, 1))
    rotations[lines] = rotations_of_form(
        numbers[lines, 3:], form, rotation, [table.place(int(k)) for k in lines]
    )
    positions = np.where(is_known[:, None], numbers[:, :3], 0.0)
    return is_known, rotations, positions


def _from_joints(
    table: CsvTable, joints: FloatArray | None, arm: ArmModel | None
) -> tuple[BoolArray, FloatArray, FloatArray]:
    if joints is None or arm is None:
        raise FileFormatError(
            "joint angles need the arm's geometry",
            where=table.where,
            remedy="put its arm.toml into the recording, or record poses",
        )
    if joints.shape[1] != arm.n_axes:
        raise FileFormatError(
            f"{joints.shape[1]} joints, but the arm '{arm.name}' has {arm.n_axes}",
            where=table.where,
            remedy="give the arm that was recorded",
        )
    is_known = np.asarray(np.isfinite(joints).all(axis=1))
    largest = float(np.abs(joints[is_known]).max()) if is_known.any() else 0.0
    if largest > REFUSE_TURNS_RAD:
        raise FileFormatError(
            f"a joint angle of {largest:g} rad is more than two turns: these look like degrees",
            where=table.where,
            remedy="multiply the joint angles by pi/180",
        )
    rotations = np.tile(np.eye(3), (len(table), 1, 1))
    positions = np.zeros((len(table), 3))
    rotations[is_known], positions[is_known] = forward(arm, joints[is_known])
    return is_known, rotations, positions


def _warnings(track: ArmTrack, where: str, arm: ArmModel | None) -> list[str]:
    found = []
    n_gaps = int((~track.is_known).sum())
    if n_gaps:
        found.append(f"{where}: {n_gaps} of {len(track)} samples have no pose: gaps, not bridged")
    if are_within_reach_of_base(track.translations_mm[track.is_known]):
        found.append(
            f"{where}: all positions are within 10 mm of Base's origin: are they in metres?"
        )
    if track.joints_rad is not None:
        known = track.joints_rad[track.is_known]
        if known.size and float(np.nanmax(np.abs(known))) > WARN_TURNS_RAD:
            found.append(f"{where}: a joint angle exceeds one turn: are they in degrees?")
        if arm is not None and known.shape[1] == arm.n_axes:
            low, high = arm.joint_limits_rad
            n_beyond = ((known < low) | (known > high)).sum(axis=0)
            found += [
                f"{where}: joint j{k + 1}_rad is beyond its limits in arm.toml in {n_beyond[k]} of "
                f"{len(known)} samples"
                for k in np.flatnonzero(n_beyond)
            ]
    return found


PROBE_FILE = "probe.toml"
PROBE_REMEDY = "write centre_tool_mm = [x, y, z] and tip_diameter_mm = 6.0"
TIP_DIAMETERS_MM = (1e-3, 1000.0)


@dataclass(frozen=True, slots=True, eq=False)
class ProbeTip:
    """A ball at the end of a probe; ``centre_tool_mm`` (3,) is in Tool."""

    centre_tool_mm: FloatArray
    diameter_mm: float

    def __post_init__(self) -> None:
        centre = frozen_floats(self.centre_tool_mm, (3,), "centre_tool_mm")
        object.__setattr__(self, "centre_tool_mm", centre)


def read_probe_tip(path: Path) -> ProbeTip:
    """Read ``probe.toml``."""
    where = path_text(path)
    content = parse_toml(read_bytes(path), where, PROBE_REMEDY)
    with told_of(where, remedy=PROBE_REMEDY):
        try:
            return PROBE_CODEC.read(ProbeTip, content)
        except MismatchError as error:
            raise InputError(f"the probe is not valid: {error}") from error


def probe_tip_toml(tip: ProbeTip) -> bytes:
    """Text of ``probe.toml``; reads back as the same numbers."""
    return toml_bytes(PROBE_CODEC.write(tip))


PROBE_CODEC = RecordCodec(
    {
        ProbeTip: Layout(
            keys={"diameter_mm": "tip_diameter_mm"}, limits={"diameter_mm": TIP_DIAMETERS_MM}
        )
    }
)


def write_probing(
    folder: Path,
    track: ArmTrack,
    tip: ProbeTip,
    *,
    is_simulated: bool = False,
    beside: Mapping[Path, bytes] | None = None,
) -> None:
    """Write touches as a folder: ``arm.csv`` with a sample a touch, ``probe.toml``, a session.

    Files ``beside`` it appear with it; see `new_folder`.
    """
    session = Session(cameras=(), is_simulated=is_simulated)
    columns = arm_columns(track, session.pose_form, session.rotation, {})
    with new_folder(folder, beside) as partial:
        (partial / ARM_FILE).write_bytes(csv_bytes(columns))
        (partial / PROBE_FILE).write_bytes(probe_tip_toml(tip))
        (partial / SESSION_FILE).write_bytes(session_toml(session))
