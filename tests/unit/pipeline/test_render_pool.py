# SPDX-License-Identifier: Apache-2.0
"""Images from several processes: all scenes' in order, and an end at once when it is asked for.

The twins here are fake ones that are found by the real one's name, so that no image is rendered.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from armscan.devices.sources import TwinScene
from armscan.errors import EstimationError
from armscan.pipeline import simulate
from armscan.pipeline.progress import ProgressEvent
from armscan.pipeline.simulate import TwinName, record_scenes
from armscan.storage.recording import read_recording
from rigs import fake_twin
from rigs.recording_folders import pixels

SCENES: tuple[TwinScene, ...] = ("camera", "ball", "plate")


@pytest.fixture(autouse=True)
def _fake(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_twin.register(tmp_path_factory.mktemp("site"), monkeypatch)
    monkeypatch.setattr(simulate, "IMAGES_A_PROCESS", 3)


def record(folder: Path, head: str, events: list[ProgressEvent] | None = None) -> None:
    name = TwinName(head, "thesis", 1)
    told = [] if events is None else events
    folders = {scene: folder / scene for scene in SCENES}
    record_scenes(folders, name, {"ball": 2}, processes=2, progress=told.append)


def test_each_scene_gets_its_own_images(tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    record(tmp_path, "quick", events)
    for scene, rows in (("camera", range(6)), ("ball", (0, 5)), ("plate", range(6))):
        scan = read_recording(tmp_path / scene)
        assert len(scan.rows) == len(rows)
        for k, row in enumerate(rows):
            np.testing.assert_array_equal(scan.exposure(k).image, pixels(row))
    assert [(event.done, event.total) for event in events] == [(k, 14) for k in range(1, 15)]


def test_an_interrupt_ends_it_while_images_take_long(tmp_path: Path) -> None:
    """Images of this head take a minute each; the interrupt comes when both processes render."""
    asked: list[float] = []

    def interrupt() -> None:
        while len(list(tmp_path.glob("started-*"))) < 2:
            time.sleep(0.05)
        asked.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        record(tmp_path, f"slow:{tmp_path}")
    assert time.monotonic() - asked[0] < 3.0
    assert [path.name for path in tmp_path.iterdir() if "started" not in path.name] == []


def test_a_process_that_dies_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(EstimationError, match="a process that rendered images came to an end"):
        record(tmp_path, "dying")
    assert list(tmp_path.iterdir()) == []
