# SPDX-License-Identifier: Apache-2.0
"""The arm's pose at each exposure, and why some exposures have none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.reconstruction.track_faults import TrackFault

PoseSource = Literal["trigger", "time"]


class PoseFate(IntEnum):
    """Whether an exposure has a pose, and if not, why."""

    FOUND = 0
    NO_TRIGGER = 1
    """The exposure bears no trigger id, while poses are found by id."""
    UNKNOWN_TRIGGER = 2
    """No sample of the arm bears its trigger id."""
    UNKNOWN_SAMPLE = 3
    """The arm gave no pose for that trigger or time."""
    BEFORE_TRACK = 4
    """Earlier than the arm's first sample."""
    AFTER_TRACK = 5
    """Later than the arm's last sample."""
    GAP = 6
    """Between two samples too far apart, or next to one without pose."""
    CONTRADICTED = 7
    """At samples that the arm's own track shows to be wrong."""

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _LABELS[self]


_LABELS = {
    PoseFate.FOUND: "pose found",
    PoseFate.NO_TRIGGER: "without trigger id",
    PoseFate.UNKNOWN_TRIGGER: "with a trigger id that the arm does not know",
    PoseFate.UNKNOWN_SAMPLE: "at samples for which the arm gave no pose",
    PoseFate.BEFORE_TRACK: "before the arm's first sample",
    PoseFate.AFTER_TRACK: "after the arm's last sample",
    PoseFate.GAP: "in a gap of the arm's samples",
    PoseFate.CONTRADICTED: "at samples that the arm's own track shows to be wrong",
}


@dataclass(frozen=True, slots=True, eq=False)
class ExposurePoses:
    """``base_from_tool`` for each of N exposures.

    Parameters
    ----------
    rotations, translations_mm
        (N, 3, 3) and (N, 3); unit and zero where there is no pose.
    fate
        (N,) `PoseFate`.
    sample
        (N,) row of the arm's track that gave the pose, or the one before it; -1 for none.
    source
        Whether poses were found by trigger id or by time.
    max_gap_ns
        Widest step between samples that was bridged; 0 by trigger id.
    warnings
        What is weak, in words.
    track_faults
        What the arm's track says against itself.
    """

    rotations: FloatArray
    translations_mm: FloatArray
    fate: IntArray
    sample: IntArray
    source: PoseSource
    max_gap_ns: int
    warnings: tuple[str, ...] = ()
    track_faults: tuple[TrackFault, ...] = ()

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.fate))
        for name, shape in (("rotations", (n, 3, 3)), ("translations_mm", (n, 3))):
            object.__setattr__(self, name, frozen_floats(getattr(self, name), shape, name))
        for name in ("fate", "sample"):
            object.__setattr__(self, name, frozen_ints(getattr(self, name), (n,), name))

    def __len__(self) -> int:
        """Count of exposures, those without pose included."""
        return len(self.fate)

    @property
    def has_pose(self) -> BoolArray:
        """(N,) True where the pose is known."""
        return np.asarray(self.fate == int(PoseFate.FOUND))

    def count(self, fate: PoseFate) -> int:
        """Count of exposures of this fate."""
        return int((self.fate == int(fate)).sum())

    @property
    def missing(self) -> str:
        """How many exposures have no pose, and why; empty if all have one."""
        parts = [
            f"{self.count(fate)} {fate.label}"
            for fate in PoseFate
            if fate is not PoseFate.FOUND and self.count(fate)
        ]
        return ", ".join(parts)

    @property
    def how(self) -> str:
        """How poses were found, in words."""
        if self.source == "trigger":
            return "by trigger id"
        return f"by time, between samples up to {self.max_gap_ns / 1e6:g} ms apart"

    def pose(self, row: int) -> Pose[Base, Tool]:
        """Pose of one exposure.

        Raises
        ------
        InputError
            If it has none.
        """
        fate = PoseFate(int(self.fate[row]))
        if fate is not PoseFate.FOUND:
            raise InputError(f"exposure {row} has no pose: {fate.label}")
        return Pose(self.rotations[row], self.translations_mm[row])
