# SPDX-License-Identifier: Apache-2.0
"""Images from several processes: all scenes' in order, and an end at once when it is asked for.

The twins here are fake ones that are found by the real one's name, so that no image is rendered.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from armscan.devices.sources import TwinScene
from armscan.errors import EstimationError, InputError
from armscan.pipeline import simulate
from armscan.pipeline.progress import ProgressEvent
from armscan.pipeline.simulate import TwinName, record_scenes, recorded_scenes
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


def test_a_scene_is_there_before_the_next_one_is_asked_for(tmp_path: Path) -> None:
    name = TwinName("quick", "thesis", 1)
    called: list[list[str]] = []
    folders = {scene: tmp_path / scene for scene in SCENES}

    def meanwhile() -> None:
        called.append([path.name for path in tmp_path.iterdir()])

    with closing(recorded_scenes(folders, name, processes=2, meanwhile=meanwhile)) as coming:
        for k, scene in enumerate(SCENES):
            assert next(coming)[0] == scene
            assert {path.name for path in tmp_path.iterdir()} == set(SCENES[: k + 1])
            assert len(read_recording(tmp_path / scene).rows) == 6
    assert len(called) == 1
    assert not set(called[0]) & set(SCENES)


def test_scenes_that_nobody_waits_for_are_given_up(tmp_path: Path) -> None:
    """Images of this head take a minute each."""
    name = TwinName(f"slow:{tmp_path}", "thesis", 1)

    def refuse() -> None:
        raise InputError("enough")

    before = time.monotonic()
    with pytest.raises(InputError, match="enough"):
        next(recorded_scenes({"ball": tmp_path / "ball"}, name, processes=2, meanwhile=refuse))
    # by two processes all six take three minutes
    assert time.monotonic() - before < 120.0
    assert not (tmp_path / "ball").exists()


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
