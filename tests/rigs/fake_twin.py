# SPDX-License-Identifier: Apache-2.0
"""A twin whose images cost nothing, registered under the name of the real one."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack
from rigs.recording_folders import MemoryScan, memory_scan

N_IMAGES = 6


@dataclass(frozen=True)
class FakeTruth:
    seed: int

    def document(self, scene: str | None = None) -> bytes:
        return f'{{"simulated": true, "seed": {self.seed}, "scene": "{scene}"}}\n'.encode()


@dataclass(frozen=True)
class FakeProbing:
    arm: ArmTrack
    tool_from_probe_mm: FloatArray
    tip_diameter_mm: float


class SlowScan(MemoryScan):
    """An image takes a minute; which process began one is left in the folder of its name."""

    def exposure(self, row: int) -> Exposure:
        if row > 0:  # the first image is rendered while the other processes wait
            (Path(self.name) / f"started-{os.getpid()}").touch()
            time.sleep(60.0)
        return super().exposure(row)


class DyingScan(MemoryScan):
    """The process that renders an image comes to an end."""

    def exposure(self, row: int) -> Exposure:
        os._exit(1)


@dataclass(frozen=True)
class FakeTwin:
    head: str
    preset: str
    seed: int
    target: str = "circle-grid:11x9:3.75"

    @property
    def truth(self) -> FakeTruth:
        return FakeTruth(self.seed)

    def scan(self, scene: str) -> MemoryScan:
        scan = memory_scan(N_IMAGES, None if scene == "camera" else self.probe_plate().arm)
        if self.head.startswith("slow:"):
            return SlowScan(scan.session, scan.rows, scan.images, scan.arm, name=self.head[5:])
        if self.head == "dying":
            return DyingScan(scan.session, scan.rows, scan.images, scan.arm)
        return scan

    def probe_plate(self) -> FakeProbing:
        n = 4
        positions = np.arange(3.0 * n).reshape(n, 3) + 100.0 * self.seed
        track = ArmTrack(
            t_ns=2000 * np.arange(n),
            rotations=np.tile(np.eye(3), (n, 1, 1)),
            translations_mm=positions,
            is_known=np.ones(n, bool),
        )
        return FakeProbing(track, np.array([0.0, 0.5, 60.0]), 6.0)


def build(head: str, preset: str, seed: int) -> FakeTwin:
    return FakeTwin(head, preset, seed)


def register(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Make it the driver ``twin``, also of processes that are started."""
    info = folder / "fake_twin-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fake-twin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[armscan.drivers]\ntwin = rigs.fake_twin:build\n")
    patch.syspath_prepend(str(folder))
