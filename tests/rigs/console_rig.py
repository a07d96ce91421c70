# SPDX-License-Identifier: Apache-2.0
"""A console's rig that is drawn: a hand over a plane, with devices that fail on demand."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armscan.console.journey import SessionSettings, StepName
from armscan.console.rig import DeviceBench, _Hand, _HandArm, _HandCamera
from armscan.devices.protocols import ArmSample, CameraSettings, Frame
from armscan.devices.sources import ScanSource
from armscan.errors import DeviceError
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.records.recording import ArmTrack, CameraSetup, Session
from armscan.storage.documents import scanner_document
from rigs.scan_fake import CAMERA as DRAWN
from rigs.scan_fake import as_source, fake_scan, scanner


def drawn_scan(n: int) -> ScanSource:
    scan = fake_scan(n)
    poses = [scan.truth[k] for k in range(n)]
    track = ArmTrack(
        t_ns=np.array([row.t_ns for row in scan.rows]),
        rotations=np.array([pose.rotation for pose in poses]),
        translations_mm=np.array([pose.translation_mm for pose in poses]),
        is_known=np.ones(n, dtype=bool),
        trigger_ids=np.arange(n),
    )
    rows = tuple(replace(row, trigger_id=k, lasers=("A",)) for k, row in enumerate(scan.rows))
    session = Session("scan", (CameraSetup(DRAWN.width_px, DRAWN.height_px),))
    return as_source(replace(scan, rows=rows, arm=track, session=session))


class DrawnBench:
    """A hand over a drawn scan."""

    def __init__(self, n: int, rate_hz: float = 200.0) -> None:
        self.hand = _Hand(drawn_scan(n), rate_hz)
        self.settings = SessionSettings()
        self.is_simulated = self.has_operator = True

    def scan_rig(self, step: StepName) -> Rig:
        description = RigDescription(("drawn",), is_common_trigger=True)
        return Rig([_HandCamera(self.hand, 0)], _HandArm(self.hand), None, description)

    def hold(self, is_held: bool) -> None:
        self.hand.is_held = is_held

    @property
    def is_over(self) -> bool:
        return self.hand.is_over


def waited(done) -> None:
    end = time.monotonic() + 240.0
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


@dataclass(slots=True)
class FailingCamera(_HandCamera):
    """A camera that can be unplugged, and that keeps what it was told."""

    is_gone: bool = False

    def configure(self, settings: CameraSettings) -> CameraSettings:
        told = {name: getattr(settings, name) for name in settings.__slots__}
        self.settings = replace(self.settings, **{k: v for k, v in told.items() if v is not None})
        return self.settings

    def read(self, timeout_s: float) -> Frame | None:
        if self.is_gone:
            time.sleep(timeout_s)
            raise DeviceError("it was unplugged", where=self.name)
        return _HandCamera.read(self, timeout_s)


@dataclass(slots=True)
class FailingArm(_HandArm):
    """An arm whose stream can stall."""

    is_stalled: bool = False

    def read(self, timeout_s: float) -> tuple[ArmSample, ...]:
        if self.is_stalled:
            time.sleep(timeout_s)
            return ()
        return _HandArm.read(self, timeout_s)


class FailingBench(DeviceBench):
    """Devices over a drawn plane, as a person holds them: they never wait."""

    def __init__(self, n: int = 400, rate_hz: float = 20.0, n_cameras: int = 1) -> None:
        self.hand = _Hand(drawn_scan(n), rate_hz, is_held=False)
        whole = CameraSettings(exposure_us=1000.0, size_px=(DRAWN.width_px, DRAWN.height_px))
        self.cameras = [FailingCamera(self.hand, 0, whole) for _ in range(n_cameras)]
        self.arm = FailingArm(self.hand)
        description = RigDescription(("drawn",) * n_cameras, is_common_trigger=True)
        super().__init__(Rig(self.cameras, self.arm, None, description), "rig.toml")


def put_scanner(folder: Path) -> None:
    """A session in which the scanner is calibrated."""
    folder.mkdir(parents=True)
    (folder / "console.toml").write_text("ball_mm = 30.0\n")
    (folder / "scanner.json").write_bytes(scanner_document(scanner()))
