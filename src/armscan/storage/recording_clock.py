# SPDX-License-Identifier: Apache-2.0
"""What joins exposures and arm samples: trigger ids, or one clock."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.records.arm_track import NO_TRIGGER, ArmTrack
from armscan.records.session import ExposureRow
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_session import SessionFile


def check_clock(
    rows: Sequence[ExposureRow], arm: ArmTrack, said: SessionFile, folder: Path
) -> list[str]:
    """Refuse a recording whose poses cannot be found, and return what is assumed of its clock.

    Raises
    ------
    FileFormatError
        If there are neither common trigger ids nor a shared clock, or no exposure is within the
        arm's times.
    """
    where = str(folder / EXPOSURES_FILE)
    ids = {row.trigger_id for row in rows} - {None}
    of_arm = set() if arm.trigger_ids is None else set(arm.trigger_ids.tolist()) - {NO_TRIGGER}
    if ids & of_arm:
        return []
    if ids and of_arm:
        raise FileFormatError(
            "no trigger_id is in both tables",
            where=where,
            remedy="write the number of one trigger into both tables, or leave the columns out",
        )
    if said.session.clock == "separate":
        raise FileFormatError(
            "cameras and arm have neither a shared clock nor trigger ids, so no pose can be found",
            where=where,
            remedy="record trigger ids, or bring the times to one clock and say clock = 'shared'",
        )
    times = np.array([row.t_ns for row in rows], dtype=np.int64)
    if not bool(((times >= arm.t_ns[0]) & (times <= arm.t_ns[-1])).any()):
        raise FileFormatError(
            f"no exposure ({times[0]} to {times[-1]} ns) is within the arm's times "
            f"({arm.t_ns[0]} to {arm.t_ns[-1]} ns)",
            where=where,
            remedy="write both times in nanoseconds of one clock, or record trigger ids",
        )
    if "time.clock" in said.stated:
        return []
    return ["cameras and arm share one clock"]
