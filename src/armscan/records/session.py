# SPDX-License-Identifier: Apache-2.0
"""What holds for a whole recording: its cameras, its clock, the form of its poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from armscan.geometry.euler import EulerConvention
from armscan.records.sensor_window import SensorWindow

SessionKind = Literal["scan", "calibration"]
Clock = Literal["shared", "separate"]
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
    window: SensorWindow = field(default_factory=SensorWindow)
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
        ``shared`` if exposures and arm samples bear times of one clock.
    pose_form, rotation
        How the arm's poses are written, and the convention if they are Euler angles.
    head
        Path of a description of the head beside the recording, or None.
    is_simulated
        True if the recording says that its images were rendered.
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
    assumed: tuple[str, ...] = ()


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
    lasers
        Names of the laser sources that were on.
    trigger_id
        Number of the trigger, or None.
    view
        Exposures of equal view saw one rigid arrangement; None stands for a view of its own.
    """

    index: int
    t_ns: int
    camera: int
    source: str
    lasers: tuple[str, ...] = ()
    trigger_id: int | None = None
    view: str | None = None
