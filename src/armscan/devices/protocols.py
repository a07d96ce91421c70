# SPDX-License-Identifier: Apache-2.0
"""What a camera, an arm and a laser controller of a live rig do, and what they deliver.

A device has a clock of its own: every frame, sample and laser event bears the device's time and
the time at which it reached this computer. What the two have to do with one another is estimated,
never assumed; a device without clock repeats the time of arrival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Literal, Protocol

from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.records.exposure import SensorWindow, unstated_window
from armscan.records.recording import CameraSetup, PoseForm

DeviceKind = Literal["camera", "arm", "lasers"]
TriggerMode = Literal["free", "external", "software"]


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A device that was found.

    Parameters
    ----------
    address
        Opens it, for example ``webcam:0`` or ``tcp:127.0.0.1:4712``.
    label
        Maker, model and serial number, as far as the device says.
    """

    address: str
    kind: DeviceKind
    label: str


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image as a camera delivered it.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3) raw pixels, uint8 or uint16; nobody writes to it afterwards.
    number
        The camera's own count; where it jumps, frames were lost.
    t_device_ns
        Middle of the exposure by the camera's clock.
    t_host_ns
        Arrival by this computer's monotonic clock.
    trigger_id
        Number of the trigger, where the camera counts them.
    lasers
        Sources that were on, where the camera switches them itself; None where it does not know.
    window
        The part of the sensor that the image shows.
    is_complete
        False where parts of the image were lost on the way.
    exposure_ns
        How long this frame was exposed: it arrives after the END of the exposure. 0 where the
        driver cannot tell; then its arrivals tell the clock only while the time stays the same.
    is_timed
        False where the middle is not certain, as of a frame that was under way while the exposure
        time was changed.
    """

    image: ImageArray
    number: int
    t_device_ns: int
    t_host_ns: int
    trigger_id: int | None = None
    lasers: tuple[str, ...] | None = None
    window: SensorWindow = field(default_factory=unstated_window)
    is_complete: bool = True
    exposure_ns: int = 0
    is_timed: bool = True


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a person or the exposure control sets; None leaves the camera's own value.

    Parameters
    ----------
    rate_hz
        Frames a second, where the camera triggers itself.
    window
        Corner and binning of the part that is read.
    size_px
        Width and height of that part in image pixels.
    """

    exposure_us: float | None = None
    gain_db: float | None = None
    rate_hz: float | None = None
    window: SensorWindow | None = None
    size_px: tuple[int, int] | None = None


class Camera(Protocol):
    """A camera; its methods raise `DeviceError` where it does not answer.

    A device of any kind whose data are made up says so by an attribute ``is_simulated = True``.
    """

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def setup(self) -> CameraSetup:
        """Size, window, bits and colour of the frames that it delivers now."""

    @property
    def settings(self) -> CameraSettings:
        """What is set now, no value None that the camera can tell."""

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set what is not None and return what the camera took, which may be near it only."""

    def start(self, trigger: TriggerMode = "free") -> None:
        """Begin to deliver frames; those of before the last stop are forgotten."""

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, in the order of delivery; None if none came in time."""

    def stop(self) -> None:
        """Take no more; what was taken can still be read. May be started again."""

    def close(self) -> None:
        """Give the camera back. Does nothing the second time."""


class ArmFlag(IntFlag):
    """State of an arm at one sample."""

    NONE = 0
    AT_REST = 1
    REFERENCED = 2
    END_STOP = 4
    INACCURATE = 8


INACCURATE = "inaccurate as the arm itself says, their poses not used"
AT_END_STOP = "at an end stop of the arm"
"""How samples are called that bear these flags."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmSample:
    """One sample of an arm.

    Parameters
    ----------
    number
        The arm's own count; where it jumps, samples were lost.
    t_device_ns
        When the encoders were read, by the arm's clock.
    t_host_ns
        Arrival by this computer's monotonic clock.
    pose
        ``base_from_tool``; None where the arm gave none.
    joints_rad
        (J,) joint angles, where the arm delivers them.
    buttons
        Bit k is set while button k is down.
    flags
        State of the arm.
    trigger_id
        Number of the trigger that it was taken at, or None.
    """

    number: int
    t_device_ns: int
    t_host_ns: int
    pose: Pose[Base, Tool] | None = None
    joints_rad: FloatArray | None = None
    buttons: int = 0
    flags: ArmFlag = ArmFlag.REFERENCED
    trigger_id: int | None = None

    @property
    def is_valid(self) -> bool:
        """Whether pose and angles may be used: not of an arm that says that they are not right.

        At an end stop they are: whether that strains the arm, its own `ArmFlag.INACCURATE` says.
        """
        return ArmFlag.REFERENCED in self.flags and ArmFlag.INACCURATE not in self.flags


class Arm(Protocol):
    """An articulated arm or robot; its methods raise `DeviceError` where it does not answer."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def pose_form(self) -> PoseForm:
        """``joints`` where it delivers joint angles alone, else how its poses are kept."""

    def start(self) -> None:
        """Begin to deliver samples; those of before the last stop are forgotten."""

    def read(self, timeout_s: float) -> tuple[ArmSample, ...]:
        """All samples that came since the last call; waits for the first, empty if none came."""

    def stop(self) -> None:
        """Take no more; what was taken can still be read. May be started again."""

    def close(self) -> None:
        """Give the arm back. Does nothing the second time."""


@dataclass(frozen=True, slots=True)
class LaserEvent:
    """What was on at one trigger.

    Parameters
    ----------
    trigger_id
        The controller's own count of triggers.
    t_device_ns, t_host_ns
        Middle of the time that the lasers were on, by the controller's clock; and arrival.
    lasers
        Sources that were on.
    """

    trigger_id: int
    t_device_ns: int
    t_host_ns: int
    lasers: tuple[str, ...]


class LaserController(Protocol):
    """Switches lasers and as a rule triggers the cameras; `DeviceError` where it is silent."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the laser sources."""

    def set_schedule(self, steps: Sequence[tuple[str, ...]]) -> None:
        """Sources of one trigger after the other, repeated; holds until it is set anew.

        Until the first call it is the controller's own, if it has one.
        """

    def set_next(self, lasers: tuple[str, ...]) -> None:
        """Sources of the next trigger alone, and of those after it until the next call."""

    def start(self, rate_hz: float | None) -> None:
        """Trigger at this rate; None waits for triggers from elsewhere.

        Events of before the last stop are forgotten.
        """

    def read(self, timeout_s: float) -> tuple[LaserEvent, ...]:
        """All events since the last call; waits for the first, empty if none came."""

    def stop(self) -> None:
        """All lasers off, no more triggers; events that were told can still be read."""

    def close(self) -> None:
        """Lasers off, and give the controller back. Does nothing the second time."""


Fault = Literal["unplug", "stall", "drop", "corrupt", "clock-jump", "duplicate", "reorder"]


class DeviceDriver(Protocol):
    """What an entry point of the group ``armscan.devices`` names: finds devices and opens them.

    The entry point's name is the first part of an address, as ``webcam`` in ``webcam:0``.
    """

    @property
    def kinds(self) -> tuple[DeviceKind, ...]:
        """Kinds of device that it opens."""

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Devices that are there now; those that must be named by address are not found."""

    def open(self, kind: DeviceKind, place: str) -> Camera | Arm | LaserController:
        """Open the device at the rest of its address.

        Raises `DeviceError` if it is not there, taken, or no device of that kind; `OptionError` if
        the address cannot be read.
        """
