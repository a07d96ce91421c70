# SPDX-License-Identifier: Apache-2.0
"""All scenes of a twin as folder recordings, rendered by several processes."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import cast

from armscan.devices.registry import load_driver
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.errors import EstimationError
from armscan.pipeline.fewer_views import FewerViews
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.storage.probe_files import ProbeTip, write_probing
from armscan.storage.recording_reader import FolderRecording, read_recording
from armscan.storage.recording_writer import write_recording

STAGE = "render scenes"


@dataclass(frozen=True, slots=True)
class TwinName:
    """What a twin is built from, in any process."""

    head: str
    preset: Preset
    seed: int

    def build(self) -> Twin:
        """Build it; the simulator is found by its name.

        Raises
        ------
        OptionError
            If there is no such head or preset.
        """
        driver = load_driver("twin")
        return cast(Twin, driver(head=self.head, preset=self.preset, seed=self.seed))


def record_scenes(
    folder: Path,
    name: TwinName,
    most_views: Mapping[TwinScene, int | None],
    *,
    processes: int = 2,
    progress: Progress = silent,
) -> dict[TwinScene, FolderRecording]:
    """Write scenes of a twin, one folder each, and its probing of the plate; read them back.

    Parameters
    ----------
    folder
        Must exist; ``SCENE`` and ``probing`` are written into it.
    name
        The twin.
    most_views
        The scenes, with the most views of each that are wanted; None for all.
    processes
        Processes that render, a scene at a time; 1 renders in this one.
    progress
        Told of every scene.

    Raises
    ------
    OutputError
        If a folder holds something or cannot be written.
    """
    probing = name.build().probe_plate()
    tip = ProbeTip(probing.tool_from_probe_mm, probing.tip_diameter_mm)
    write_probing(folder / "probing", probing.arm, tip, is_simulated=True)
    n = len(most_views)
    if processes == 1:
        for done, (scene, most) in enumerate(most_views.items()):
            progress(ProgressEvent(STAGE, done, n, scene))
            _record(folder, name, scene, most)
    else:
        _record_elsewhere(folder, name, most_views, processes, progress)
    progress(ProgressEvent(STAGE, n, n))
    return {scene: read_recording(folder / scene) for scene in most_views}


def _record_elsewhere(
    folder: Path,
    name: TwinName,
    most_views: Mapping[TwinScene, int | None],
    processes: int,
    progress: Progress,
) -> None:
    spawn = get_context("spawn")
    with ProcessPoolExecutor(processes, spawn, initializer=_leave_interrupts) as pool:
        waiting: dict[Future[None], TwinScene] = {
            pool.submit(_record, folder, name, scene, most): scene
            for scene, most in most_views.items()
        }
        try:
            for done, future in enumerate(as_completed(waiting)):
                future.result()
                progress(ProgressEvent(STAGE, done + 1, len(waiting), waiting[future]))
        except BrokenProcessPool as error:
            raise EstimationError(
                "a process that rendered images came to an end",
                where=str(folder),
                remedy="free some memory",
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _leave_interrupts() -> None:
    # an interrupt is for the process that waits; it ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _record(folder: Path, name: TwinName, scene: TwinScene, most: int | None) -> None:
    source = name.build().scan(scene)
    write_recording(folder / scene, source if most is None else FewerViews(source, most))
