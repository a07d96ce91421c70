# SPDX-License-Identifier: Apache-2.0
"""The devices of one scanner, opened together and closed together, lasers off first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from armscan.devices.protocols import (
    Arm,
    Camera,
    DeviceKind,
    LaserController,
    TriggerMode,
)
from armscan.errors import DeviceError, FileFormatError
from armscan.storage.codec import MismatchError, RecordCodec, parse_toml
from armscan.storage.files import path_text, read_bytes

OpenDevice = Callable[[DeviceKind, str], Any]
"""Opens the device of a kind at an address, or raises `DeviceError`."""
MOST_RATE_HZ = 10_000.0


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
    scanner
        Path of ``scanner.json``; empty for none.
    """

    cameras: tuple[str, ...]
    arm: str = ""
    lasers: str = ""
    trigger: TriggerMode = "external"
    rate_hz: float = 80.0
    schedule: tuple[str, ...] = ()
    is_common_trigger: bool = False
    scanner: str = ""

    @property
    def steps(self) -> tuple[tuple[str, ...], ...]:
        """Sources of each step of the schedule."""
        return tuple(tuple(filter(None, step.split("+"))) for step in self.schedule)


def read_rig(path: Path) -> RigDescription:
    """Read ``rig.toml``.

    Raises
    ------
    FileFormatError
        If it is no TOML, a key is unknown or of a wrong type, or it names no camera.
    """
    where = path_text(path)
    content = parse_toml(read_bytes(path), where, 'write lines as cameras = ["webcam:0"]')
    unknown: list[str] = []
    try:
        rig = RecordCodec({}, unknown).read(RigDescription, content)
    except MismatchError as error:
        raise FileFormatError(
            str(error), where=where, remedy='write lines as cameras = ["webcam:0"], rate_hz = 40.0'
        ) from error
    fault = f"the key {unknown[0]}" if unknown else ""
    fault = fault or ("it names no camera" if not rig.cameras else "")
    if not 0.0 < rig.rate_hz <= MOST_RATE_HZ:
        fault = fault or f"rate_hz is {rig.rate_hz:g}"
    if fault:
        raise FileFormatError(fault, where=where, remedy="correct the description of the rig")
    return rig


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
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        arm: Arm | None = None,
        lasers: LaserController | None = None,
        description: RigDescription | None = None,
    ) -> None:
        self.cameras = tuple(cameras)
        self.arm = arm
        self.lasers = lasers
        self.description = description or RigDescription(tuple(one.name for one in cameras))

    @staticmethod
    def open(description: RigDescription, open_device: OpenDevice) -> Rig:
        """Open all devices, or none.

        Raises
        ------
        DeviceError
            If one cannot be opened; those opened before it are closed.
        """
        opened: list[Any] = []
        addresses: list[tuple[DeviceKind, str]] = [("camera", one) for one in description.cameras]
        try:
            opened += [open_device(kind, address) for kind, address in addresses]
            arm = open_device("arm", description.arm) if description.arm else None
            opened += [arm] if arm else []
            lasers = open_device("lasers", description.lasers) if description.lasers else None
        except BaseException:
            _close(opened)
            raise
        cameras = opened[: len(description.cameras)]
        return Rig(cameras, arm, lasers, description)

    def start(self) -> None:
        """Begin to deliver: arm and cameras first, then the lasers, which may trigger them.

        Raises
        ------
        DeviceError
            If a device does not answer; all are stopped then.
        """
        try:
            if self.arm is not None:
                self.arm.start()
            for camera in self.cameras:
                camera.start(self.description.trigger)
            if self.lasers is not None:
                if self.description.steps:
                    self.lasers.set_schedule(self.description.steps)
                self.lasers.start(self.description.rate_hz)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> tuple[str, ...]:
        """Lasers off, then no more frames and samples; what did not obey, in words."""
        silent = []
        for device in (self.lasers, *self.cameras, self.arm):
            if device is not None:
                try:
                    device.stop()
                except DeviceError as error:
                    silent.append(str(error))
        return tuple(silent)

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


def _close(devices: Sequence[Any]) -> None:
    for device in devices:
        if device is not None:
            with suppress(DeviceError):
                device.close()
