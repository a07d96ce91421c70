# SPDX-License-Identifier: Apache-2.0
"""The devices of one scanner, opened together and closed together, lasers off first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, cast

from armscan.devices.protocols import (
    Arm,
    Camera,
    CameraSettings,
    DeviceKind,
    LaserController,
    TriggerMode,
)
from armscan.errors import ArmscanError, DeviceError, FileFormatError, InputError, OptionError
from armscan.models.arm import ArmModel
from armscan.pipeline.live.exposure import ExposureSettings
from armscan.records.exposure import SensorWindow
from armscan.storage.arm import read_arm_model
from armscan.storage.codec import MismatchError, RecordCodec, parse_toml
from armscan.storage.files import path_text, read_bytes
from armscan.vision.stripe.image import StripeOptions

OpenDevice = Callable[[DeviceKind, str], Any]
"""Opens the device of a kind at an address, or raises `DeviceError`."""
MOST_RATE_HZ = 10_000.0
NO_CONTROLLER = "{} says which lasers are on, and there is no laser controller"
NAME_IT = 'name it, as lasers = "laser-serial:/dev/ttyUSB0:115200", or leave the key out'


@dataclass(frozen=True, slots=True)
class RigDescription:
    """What ``rig.toml`` says; its keys are the fields.

    Parameters
    ----------
    cameras
        Address of each camera, left first.
    arm, lasers
        Addresses; empty for none.
    trigger
        What triggers the cameras: ``external`` for the laser controller or a wire, ``free`` for
        their own clock, ``software``.
    rate_hz
        Triggers a second.
    schedule
        Lasers of one trigger after the other, joined by ``+``; empty leaves the controller's own.
    is_common_trigger
        Frames and arm samples bear ids of the same triggers.
    chooses_lasers
        The head's own rule says after each exposure which lasers come next; there is no schedule.
    arm_model
        Path of ``arm.toml``, for an arm that gives joint angles; empty for none.
    scanner
        Path of ``scanner.json``; empty for none.
    windows
        Part of the sensor that each camera reads while it scans, left first: corner x and y, width
        and height in px; none for what the cameras are set to.
    exposure
        How long the cameras expose while they scan.
    stripes
        Thresholds of the stripe extraction.

    Raises
    ------
    InputError
        If both a schedule and the head's rule say what is on, a step of the schedule names a laser
        twice or an empty one, or windows do not fit the cameras.
    """

    cameras: tuple[str, ...]
    arm: str = ""
    lasers: str = ""
    trigger: TriggerMode = "external"
    rate_hz: float = 80.0
    schedule: tuple[str, ...] = ()
    chooses_lasers: bool = False
    is_common_trigger: bool = False
    arm_model: str = ""
    scanner: str = ""
    windows: tuple[tuple[int, int, int, int], ...] = ()
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    stripes: StripeOptions = field(default_factory=StripeOptions)

    def __post_init__(self) -> None:
        if self.chooses_lasers and self.schedule:
            raise InputError("schedule and chooses_lasers both say which lasers are on")
        for step in filter(None, self.schedule):
            names = step.split("+")
            if not all(names) or len(set(names)) < len(names):
                raise InputError(
                    f"the step '{step}' of schedule names a laser twice, or none",
                    remedy='write steps as "A", "A+B", or "" for a dark one',
                )
        if self.windows and len(self.windows) != len(self.cameras):
            raise InputError(f"{len(self.windows)} windows for {len(self.cameras)} cameras")
        if any(min(x, y) < 0 or min(w, h) < 1 for x, y, w, h in self.windows):
            raise InputError(f"windows are {list(map(list, self.windows))}: x, y, width, height")

    @property
    def steps(self) -> tuple[tuple[str, ...], ...]:
        """Sources of each step of the schedule."""
        return tuple(tuple(filter(None, step.split("+"))) for step in self.schedule)

    @property
    def is_free(self) -> bool:
        """Whether each camera takes images by its own clock.

        What one wire triggers is of one time, however transports differ.
        """
        return self.trigger == "free" and not self.is_common_trigger

    @property
    def lasers_key(self) -> str:
        """The key that says which lasers are on, and needs a controller; empty for none."""
        return "schedule" if self.schedule else "chooses_lasers" if self.chooses_lasers else ""


def read_rig(path: Path) -> RigDescription:
    """Read ``rig.toml``; paths in it are relative to it.

    Raises
    ------
    FileFormatError
        If it is no TOML, a key is unknown or of a wrong type, it names no camera, or says which
        lasers are on and names no controller.
    """
    where = path_text(path)
    content = parse_toml(read_bytes(path), where, 'write lines as cameras = ["webcam:0"]')
    unknown: list[str] = []
    try:
        rig = RecordCodec({}, unknown).read(RigDescription, content)
    except (MismatchError, OptionError) as error:
        cause = error.__cause__
        own = cause.remedy if isinstance(cause, ArmscanError) else ""
        usual = 'write lines as cameras = ["webcam:0"], rate_hz = 40.0'
        raise FileFormatError(str(error), where=where, remedy=own or usual) from error
    fault = f"the key {unknown[0]}" if unknown else ""
    fault = fault or ("it names no camera" if not rig.cameras else "")
    if not 0.0 < rig.rate_hz <= MOST_RATE_HZ:
        fault = fault or f"rate_hz is {rig.rate_hz:g}"
    if fault:
        raise FileFormatError(fault, where=where, remedy="correct the description of the rig")
    if rig.lasers_key and not rig.lasers:
        raise FileFormatError(NO_CONTROLLER.format(rig.lasers_key), where=where, remedy=NAME_IT)

    def beside(name: str) -> str:
        return str(path.parent / name) if name else ""

    return replace(rig, arm_model=beside(rig.arm_model), scanner=beside(rig.scanner))


class ShowsScenes(Protocol):
    """A simulated device: another thing can be put before it."""

    def show(self, scene: str) -> None:
        """Put a scene before the head."""


class Rig:
    """Opened devices; a context manager that closes them.

    Parameters
    ----------
    cameras
        Left first.
    arm, lasers
        None for none.
    description
        How they are run.
    arm_model
        Turns joint angles into poses, for an arm that gives those alone.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        arm: Arm | None = None,
        lasers: LaserController | None = None,
        description: RigDescription | None = None,
        arm_model: ArmModel | None = None,
    ) -> None:
        self.cameras = tuple(cameras)
        self.arm = arm
        self.lasers = lasers
        self.description = description or RigDescription(tuple(one.name for one in cameras))
        self.arm_model = arm_model

    @staticmethod
    def open(description: RigDescription, open_device: OpenDevice) -> Rig:
        """Open all devices, or none.

        Raises
        ------
        DeviceError
            If one cannot be opened; those opened before it are closed.
        FileFormatError
            If the arm's document cannot be read.
        OptionError
            As of `check_targets`.
        """
        place = description.arm_model
        model = read_arm_model(Path(place)) if place else None
        opened: list[Any] = []
        addresses: list[tuple[DeviceKind, str]] = [("camera", one) for one in description.cameras]
        if description.arm:
            addresses.append(("arm", description.arm))
        if description.lasers:
            addresses.append(("lasers", description.lasers))
        try:
            for kind, address in addresses:
                with told_as_fault_of(address):
                    opened.append(open_device(kind, address))
            found = dict(zip((kind for kind, _ in addresses), opened, strict=True))
            check_targets(description, found.get("lasers"))
        except BaseException:
            _close(opened)
            raise
        cameras = opened[: len(description.cameras)]
        return Rig(cameras, found.get("arm"), found.get("lasers"), description, model)

    def set_windows(self) -> None:
        """Let each camera read the part of its sensor that the description says; before a start.

        Raises
        ------
        DeviceError
            If a camera does not take it.
        """
        for camera, (x, y, width, height) in zip(
            self.cameras, self.description.windows, strict=False
        ):
            wished = CameraSettings(window=SensorWindow(x, y), size_px=(width, height))
            with told_as_fault_of(camera.name):
                took = camera.configure(wished)
            if took.size_px is not None and took.size_px != (width, height):
                given = took.window or SensorWindow()
                raise DeviceError(
                    f"it reads {took.size_px[0]} x {took.size_px[1]} px at {given.x_px}, "
                    f"{given.y_px}, not {width} x {height} at {x}, {y}",
                    where=camera.name,
                    remedy="give a window that the camera can read, for example what it took",
                )

    def start(self) -> None:
        """Begin to deliver: arm and cameras first, then the lasers, which may trigger them.

        Raises
        ------
        DeviceError
            If a device does not answer; all are stopped then.
        """
        try:
            if self.arm is not None:
                with told_as_fault_of(self.arm.name):
                    self.arm.start()
            for camera in self.cameras:
                with told_as_fault_of(camera.name):
                    camera.start(self.description.trigger)
            if self.lasers is not None:
                with told_as_fault_of(self.lasers.name):
                    if self.description.steps:
                        self.lasers.set_schedule(self.description.steps)
                    self.lasers.start(self.description.rate_hz)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> tuple[str, ...]:
        """Lasers off, then no more frames and samples; what did not obey, in words.

        What the devices had taken can still be read.
        """
        return _stopped(self.lasers, *self.cameras, self.arm)

    def darken(self) -> tuple[str, ...]:
        """Lasers off, before what may take long; as `stop`, which is still to be called."""
        return _stopped(self.lasers)

    def close(self) -> None:
        """Give all devices back, lasers off first. Does nothing the second time."""
        _close([self.lasers, *self.cameras, self.arm])

    def __enter__(self) -> Rig:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    @property
    def is_simulated(self) -> bool:
        """Whether one of its devices says that what it delivers is simulated."""
        devices = (*self.cameras, self.arm, self.lasers)
        return any(getattr(device, "is_simulated", False) for device in devices)

    @property
    def can_show(self) -> bool:
        """Whether scenes can be put before it: a simulated rig."""
        return hasattr(self.cameras[0], "show")

    def show(self, scene: str) -> None:
        """Put a scene before a simulated rig.

        Raises
        ------
        DeviceError
            If the rig is a real one.
        """
        if not self.can_show:
            raise DeviceError("a real rig shows what stands before it")
        cast(ShowsScenes, self.cameras[0]).show(scene)


def _stopped(*devices: Any) -> tuple[str, ...]:
    silent = []
    for device in devices:
        if device is not None:
            try:
                with told_as_fault_of(device.name):
                    device.stop()
            except ArmscanError as error:
                silent.append(str(error))
    return tuple(silent)


@contextmanager
def told_as_fault_of(device: str) -> Iterator[None]:
    """Turn whatever somebody's driver raises into a `DeviceError` that names the device."""
    try:
        yield
    except ArmscanError:
        raise
    except Exception as error:
        raise DeviceError(f"its driver failed ({type(error).__name__}: {error})",
                          where=device) from error  # fmt: skip


def check_targets(description: RigDescription, lasers: LaserController | None) -> None:
    """Refuse a laser that is misspelt: it would count for none, and nobody would know.

    Without a controller the names are the rig's own business; a key that needs one is refused.

    Raises
    ------
    OptionError
        If the controller has no laser of that name, or lasers are to be chosen without one.
    DeviceError
        If it cannot tell.
    """
    if lasers is None:
        if description.lasers_key:
            raise OptionError(NO_CONTROLLER.format(description.lasers_key), remedy=NAME_IT)
        return
    with told_as_fault_of(lasers.name):
        known = lasers.sources
    asked = [("schedule", name) for step in description.steps for name in step]
    asked += [("exposure.laser", one.laser) for one in description.exposure.laser]
    for key, name in asked:
        if known and name not in known:
            raise OptionError(
                f"no laser is called '{name}'",
                where=key,
                remedy=f"choose from {', '.join(known)}",
            )


def _close(devices: Sequence[Any]) -> None:
    for device in devices:
        if device is not None:
            with suppress(Exception):
                device.close()
