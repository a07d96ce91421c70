# SPDX-License-Identifier: Apache-2.0
"""Small folder recordings, written as a lab would, and a scan source that lives in memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from armscan.storage.recording import read_recording

WIDTH_PX, HEIGHT_PX = 8, 6
SESSION = f"""kind = "scan"
[pose]
form = "quaternion"
[time]
clock = "shared"
[[camera]]
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
bits_used = 8
colour = "mono"
"""
EXPOSURES = """index,t_ns,camera,file,lasers
0,1000,0,images/0.png,A
1,2000,0,images/1.png,
2,3000,0,images/2.png,A+B
"""
ARM = """t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz
500,900,0,400,1,0,0,0
1500,901,1,400,0.8,0.6,0,0
3500,902,2,400,0,0,1,0
"""


HEADER = EXPOSURES.splitlines()[0]
POSITION = "t_ns,x_mm,y_mm,z_mm,"


def table(header: str, *lines: str) -> str:
    return "\n".join((header, *lines)) + "\n"


def refusal(folder: Path, **files: str | bytes | None) -> str:
    """What is said when such a recording is read."""
    with pytest.raises(FileFormatError) as caught:
        read_recording(lab_folder(folder, **files))
    return str(caught.value)


def pixels(number: int, shape: tuple[int, ...] = (HEIGHT_PX, WIDTH_PX)) -> Any:
    return np.random.default_rng(number).integers(0, 256, shape).astype(np.uint8)


def lab_folder(folder: Path, **files: str | bytes | None) -> Path:
    """A valid recording; ``session``, ``exposures``, ``arm`` replace its files, None omits one."""
    scan = folder / "scan"
    (scan / "images").mkdir(parents=True)
    for k in range(3):
        is_written = cv2.imwrite(str(scan / "images" / f"{k}.png"), pixels(k))
        assert is_written
    texts = {"session": SESSION, "exposures": EXPOSURES, "arm": ARM} | files
    names = {"session": "session.toml", "exposures": "exposures.csv", "arm": "arm.csv"}
    for key, text in texts.items():
        if text is not None:
            content = text if isinstance(text, bytes) else text.encode()
            (scan / names[key]).write_bytes(content)
    return scan


@dataclass(frozen=True)
class MemoryScan:
    """A scan source without files."""

    session: Session
    rows: tuple[ExposureRow, ...]
    images: tuple[Any, ...]
    arm: ArmTrack | None = None
    is_simulated: bool = True
    name: str = "memory"

    def exposure(self, row: int) -> Exposure:
        chosen = self.rows[row]
        setup = self.session.cameras[chosen.camera]
        return Exposure(
            self.images[row],
            chosen.source,
            bits_used=setup.bits_used,
            window=setup.window,
            lasers=chosen.lasers,
            t_ns=chosen.t_ns,
            camera=chosen.camera,
            trigger_id=chosen.trigger_id,
            view=chosen.view,
        )


def memory_scan(n: int = 3, arm: ArmTrack | None = None) -> MemoryScan:
    rows = tuple(
        ExposureRow(
            index=k,
            t_ns=1000 * (k + 1),
            camera=0,
            source=f"exposure {k}",
            lasers=("A",) if k % 2 else (),
            trigger_id=None,
            view=f"v{k}",
        )
        for k in range(n)
    )
    session = Session(cameras=(CameraSetup(width_px=WIDTH_PX, height_px=HEIGHT_PX),))
    return MemoryScan(session, rows, tuple(pixels(k) for k in range(n)), arm)
