# SPDX-License-Identifier: Apache-2.0
"""``arm.toml``: the geometry of an arm of revolute joints."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from armscan.errors import FileFormatError, InputError
from armscan.geometry.frames import Tool
from armscan.geometry.poses import Pose
from armscan.models.arm import AXIS_PARAMETERS, ArmModel
from armscan.storage.images import read_bytes

ARM_MODEL_FILE = "arm.toml"
Triple = tuple[float, float, float]


class Table(BaseModel):
    """A table of the file: unknown keys, NaN and wrong types are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AxisTable(Table):
    """``[[axis]]``: ``Rz(theta + theta_offset) Tz(offset) Tx(length) Rx(twist)`` (eq. 2.1)."""

    theta_offset_rad: float
    offset_mm: float
    length_mm: float
    twist_rad: float
    joint_min_rad: float | None = None
    joint_max_rad: float | None = None


class FlangeTable(Table):
    """``[flange]``: Tool in the frame of the last axis."""

    rotation_rows: tuple[Triple, Triple, Triple] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
    translation_mm: Triple = (0.0, 0.0, 0.0)


class ArmTables(Table):
    """The whole file."""

    name: str = "arm"
    axis: tuple[AxisTable, ...] = Field(min_length=1)
    flange: FlangeTable = FlangeTable()


def read_arm_model(path: Path) -> ArmModel:
    """Read ``arm.toml``.

    Raises
    ------
    FileFormatError
        If the file is missing, no TOML, or does not describe an arm.
    """
    try:
        content = tomllib.loads(read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n"))
        text = json.dumps(content, default=str)
        return _model(ArmTables.model_validate_json(text, strict=True))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileFormatError(
            f"this is no TOML: {error}",
            where=str(path),
            remedy='write lines as name = "my arm", one [[axis]] for each axis',
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise FileFormatError(
            f"the arm is not valid at '{key}': {first['msg'].lower()}",
            where=str(path),
            remedy=f"write [[axis]] with {', '.join(AXIS_PARAMETERS)} for each joint",
        ) from error
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def arm_model_toml(arm: ArmModel) -> bytes:
    """Text of ``arm.toml``; reads back as the same numbers."""
    lines = [f"name = {json.dumps(arm.name, ensure_ascii=False)}"]
    low, high = arm.joint_limits_rad
    for k in range(arm.n_axes):
        lines += ["", "[[axis]]"]
        lines += [f"{name} = {float(getattr(arm, name)[k])!r}" for name in AXIS_PARAMETERS]
        if math.isfinite(low[k]):
            lines.append(f"joint_min_rad = {float(low[k])!r}")
        if math.isfinite(high[k]):
            lines.append(f"joint_max_rad = {float(high[k])!r}")
    lines += [
        "",
        "[flange]",
        f"rotation_rows = {arm.flange.rotation.tolist()!r}",
        f"translation_mm = {arm.flange.translation_mm.tolist()!r}",
    ]
    return ("\n".join(lines) + "\n").encode()


def _model(tables: ArmTables) -> ArmModel:
    axes = np.array([[getattr(axis, name) for name in AXIS_PARAMETERS] for axis in tables.axis])
    low = [-math.inf if axis.joint_min_rad is None else axis.joint_min_rad for axis in tables.axis]
    high = [math.inf if axis.joint_max_rad is None else axis.joint_max_rad for axis in tables.axis]
    flange: Pose[Tool, Tool] = Pose(
        np.array(tables.flange.rotation_rows), np.array(tables.flange.translation_mm)
    )
    has_limits = bool(np.isfinite([*low, *high]).any())
    return ArmModel(
        theta_offset_rad=axes[:, 0],
        offset_mm=axes[:, 1],
        length_mm=axes[:, 2],
        twist_rad=axes[:, 3],
        flange=flange,
        joint_min_rad=np.array(low) if has_limits else None,
        joint_max_rad=np.array(high) if has_limits else None,
        name=tables.name,
    )
