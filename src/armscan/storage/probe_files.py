# SPDX-License-Identifier: Apache-2.0
"""``probe.toml``: the calibrated tip of a probe; and folders of the arm's touches."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.models.arm import ArmModel
from armscan.records.arm_track import ArmTrack
from armscan.records.session import Session
from armscan.storage.arm_files import ARM_MODEL_FILE, arm_model_toml
from armscan.storage.atomic_folder import new_folder
from armscan.storage.csv_table import csv_bytes
from armscan.storage.images import read_bytes
from armscan.storage.recording_arm import ARM_FILE, arm_columns
from armscan.storage.recording_session import SESSION_FILE, session_toml

PROBE_FILE = "probe.toml"


@dataclass(frozen=True, slots=True, eq=False)
class ProbeTip:
    """A ball at the end of a probe.

    Parameters
    ----------
    centre_tool_mm
        (3,) its centre in Tool.
    diameter_mm
        Its diameter.
    """

    centre_tool_mm: FloatArray
    diameter_mm: float

    def __post_init__(self) -> None:
        centre = frozen_floats(self.centre_tool_mm, (3,), "centre_tool_mm")
        object.__setattr__(self, "centre_tool_mm", centre)


class ProbeKeys(BaseModel):
    """The whole file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    centre_tool_mm: tuple[float, float, float]
    tip_diameter_mm: float = Field(gt=0, lt=1000)


def read_probe_tip(path: Path) -> ProbeTip:
    """Read ``probe.toml``.

    Raises
    ------
    FileFormatError
        If the file is missing, no TOML, or a key is missing, unknown or wrong.
    """
    try:
        content = tomllib.loads(read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n"))
        keys = ProbeKeys.model_validate_json(json.dumps(content, default=str), strict=True)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileFormatError(
            f"this is no TOML: {error}",
            where=str(path),
            remedy="write centre_tool_mm = [x, y, z] and tip_diameter_mm = 6.0",
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise FileFormatError(
            f"the probe is not valid at '{key}': {first['msg'].lower()}",
            where=str(path),
            remedy="write centre_tool_mm = [x, y, z] and tip_diameter_mm = 6.0",
        ) from error
    return ProbeTip(np.array(keys.centre_tool_mm), keys.tip_diameter_mm)


def probe_tip_toml(tip: ProbeTip) -> bytes:
    """Text of ``probe.toml``; reads back as the same numbers."""
    return (
        f"centre_tool_mm = {tip.centre_tool_mm.tolist()!r}\n"
        f"tip_diameter_mm = {float(tip.diameter_mm)!r}\n"
    ).encode()


def write_probing(
    folder: Path,
    track: ArmTrack,
    tip: ProbeTip,
    *,
    is_simulated: bool = False,
    arm: ArmModel | None = None,
    beside: Mapping[Path, bytes] | None = None,
) -> None:
    """Write touches as a folder: ``arm.csv`` with a sample a touch, ``probe.toml``, a session.

    Files ``beside`` it appear with it; see `new_folder`.

    Raises
    ------
    OutputError
        If the folder holds something, or cannot be written.
    """
    session = Session(cameras=(), is_simulated=is_simulated)
    columns = arm_columns(track, session.pose_form, session.rotation, {})
    with new_folder(folder, beside) as partial:
        (partial / ARM_FILE).write_bytes(csv_bytes(columns))
        (partial / PROBE_FILE).write_bytes(probe_tip_toml(tip))
        (partial / SESSION_FILE).write_bytes(session_toml(session))
        if arm is not None:
            (partial / ARM_MODEL_FILE).write_bytes(arm_model_toml(arm))
