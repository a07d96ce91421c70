# SPDX-License-Identifier: Apache-2.0
"""What the arm reported over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose

NO_TRIGGER = -1


@dataclass(frozen=True, slots=True, eq=False)
class ArmTrack:
    """Samples of ``base_from_tool`` in time order; unknown ones are gaps, never bridged.

    Parameters
    ----------
    t_ns
        (N,) time of each sample, strictly increasing.
    rotations
        (N, 3, 3) proper rotations; anything in rows that are not known.
    translations_mm
        (N, 3) origin of Tool in Base; anything finite in rows that are not known.
    is_known
        (N,) False where the arm gave no pose.
    trigger_ids
        (N,) number of the trigger that each sample belongs to, `NO_TRIGGER` for none; or None.
    joints_rad
        (N, J) joint angles as delivered, NaN in unknown rows; None where the arm gave poses only.

    Raises
    ------
    InputError
        If times do not increase or shapes do not fit.
    """

    t_ns: IntArray
    rotations: FloatArray
    translations_mm: FloatArray
    is_known: BoolArray
    trigger_ids: IntArray | None = None
    joints_rad: FloatArray | None = None

    def __post_init__(self) -> None:
        times = frozen_ints(self.t_ns, (None,), "t_ns")
        n = len(times)
        if n and not bool((np.diff(times) > 0).all()):
            row = int(np.flatnonzero(np.diff(times) <= 0)[0]) + 1
            raise InputError(
                f"times of the arm's samples do not increase at sample {row}",
                remedy="sort the samples by time and remove duplicates",
            )
        object.__setattr__(self, "t_ns", times)
        for name, shape in (("rotations", (n, 3, 3)), ("translations_mm", (n, 3))):
            object.__setattr__(self, name, frozen_floats(getattr(self, name), shape, name))
        known = np.array(self.is_known, dtype=np.bool_)
        if known.shape != (n,):
            raise InputError(f"is_known has shape {known.shape}, expected ({n},)")
        known.setflags(write=False)
        object.__setattr__(self, "is_known", known)
        if self.trigger_ids is not None:
            ids = frozen_ints(self.trigger_ids, (n,), "trigger_ids")
            object.__setattr__(self, "trigger_ids", ids)
        if self.joints_rad is not None:
            joints = frozen_floats(self.joints_rad, (n, None), "joints_rad", allow_nan=True)
            object.__setattr__(self, "joints_rad", joints)

    def __len__(self) -> int:
        """Count of samples, unknown ones included."""
        return len(self.t_ns)

    def pose(self, row: int) -> Pose[Base, Tool]:
        """Pose of one known sample.

        Raises
        ------
        InputError
            If the sample is a gap.
        """
        if not self.is_known[row]:
            raise InputError(f"the arm gave no pose at sample {row}")
        return Pose(self.rotations[row], self.translations_mm[row])
