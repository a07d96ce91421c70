# SPDX-License-Identifier: Apache-2.0
"""A recording's cameras, clock, pose form, arm track and laser schedule."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, bools, floats, ints
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import EulerConvention
from armscan.records.exposure import SensorWindow, unstated_window

SessionKind = Literal["scan", "calibration"]
Clock = Literal["shared", "related", "separate"]
PoseForm = Literal["quaternion", "matrix", "euler", "joints"]
PixelAlignment = Literal["low", "high"]
PixelColour = Literal["mono", "rgb", "bayer_rggb"]


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """How one camera delivered its images.

    Parameters
    ----------
    width_px, height_px
        Size of the images; None where nobody said.
    window
        Where the image lies on the full sensor.
    bits_used
        Significant bits of a pixel.
    align
        Where they lie in 16 stored bits.
    colour
        Layout of the pixels as stored.
    """

    width_px: int | None = None
    height_px: int | None = None
    window: SensorWindow = field(default_factory=unstated_window)
    bits_used: int = 8
    align: PixelAlignment = "low"
    colour: PixelColour = "mono"


@dataclass(frozen=True, slots=True)
class Session:
    """Facts about a recording that are not in its tables.

    Parameters
    ----------
    kind
        What it was taken for.
    cameras
        One entry a camera.
    clock
        ``shared`` if exposures and arm samples bear times of one clock; ``related`` if times of
        clocks of their own were brought to one by when they arrived: but for a constant, the
        latency.
    pose_form, rotation
        How the arm's poses are written, and the convention if they are Euler angles.
    head
        Path of a description of the head beside the recording, or None.
    is_simulated
        True if the recording says that its images were rendered.
    is_stripe_band
        True if images with a laser are zero away from what could be a stripe.
    assumed
        What nobody said and the program took for granted, in words.
    """

    kind: SessionKind = "scan"
    cameras: tuple[CameraSetup, ...] = (CameraSetup(),)
    clock: Clock = "shared"
    pose_form: PoseForm = "quaternion"
    rotation: EulerConvention = "intrinsic-xyz"
    head: str | None = None
    is_simulated: bool = False
    is_stripe_band: bool = False
    assumed: tuple[str, ...] = ()


UNTRIGGERED, LASER_UNKNOWN = "no-trigger", "laser-unknown"
"""Flags of a live recording that its readers obey: an image without a trigger's id where ids alone
give poses, and one of which nobody knows what lasers were on."""


@dataclass(frozen=True, slots=True)
class ExposureRow:
    """One line of a recording's list of exposures: everything but the pixels.

    Parameters
    ----------
    index
        The exposure's own number in the recording.
    t_ns
        Mid-exposure time.
    camera
        Number of the camera, counted from 0.
    source
        Name of the image, a path relative to the recording.
    trigger_id
        Number of the trigger, or None.
    view
        Exposures of equal view saw one rigid arrangement; None stands for a view of its own.
    flags
        Marks of a live recording, as `LASER_UNKNOWN`.
    """

    index: int
    t_ns: int
    camera: int
    source: str
    lasers: tuple[str, ...] = ()
    trigger_id: int | None = None
    view: str | None = None
    flags: tuple[str, ...] = ()

    @property
    def is_dark(self) -> bool:
        """True if it names no laser, and that is known to be so."""
        return not self.lasers and LASER_UNKNOWN not in self.flags

    @property
    def arrangement(self) -> str | int:
        """Alike of rows of one view, or else of one instant: they saw one rigid arrangement."""
        return self.t_ns if self.view is None else self.view


NO_TRIGGER = -1


class ArmTrack(RowRecord):
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

    t_ns: IntArray = ints("N")
    rotations: FloatArray = floats("N", 3, 3)
    translations_mm: FloatArray = floats("N", 3)
    is_known: BoolArray = bools("N")
    trigger_ids: IntArray | None = ints("N", default=None)
    joints_rad: FloatArray | None = floats("N", None, nan=True, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        late = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if len(late):
            raise InputError(
                f"times of the arm's samples do not increase at sample {int(late[0]) + 1}",
                remedy="sort the samples by time and remove duplicates",
            )

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
