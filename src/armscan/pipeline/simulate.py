# SPDX-License-Identifier: Apache-2.0
"""Scenes of the twin, rendered by several processes and written as folder recordings."""

from __future__ import annotations

import signal
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import cast, get_args

from armscan.devices.registry import load_driver
from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Preset, Twin, TwinScene
from armscan.errors import EstimationError, OptionError
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.storage.atomic import check_outputs, write_files
from armscan.storage.atomic_folder import check_new_folder
from armscan.storage.probe_files import ProbeTip, write_probing
from armscan.storage.recording_images import encoded_png
from armscan.storage.recording_writer import write_recording, written_session

IMAGES_A_PROCESS = 15
"""Fewer do not pay: a process takes some seconds before its first image."""
STAGE = "render images"

_scans: list[ScanSource] = []
"""The scene of a rendering process, made once; empty in any other process."""


@dataclass(frozen=True, slots=True)
class SimulateOptions:
    """What is simulated, and by how many processes.

    Parameters
    ----------
    preset
        How good the instrument and how kind the surroundings are.
    seed
        Everything random follows from it.
    processes
        Processes that render; 1 renders in this one. A script that asks for more needs the usual
        ``if __name__ == "__main__"``.
    """

    preset: Preset = "thesis"
    seed: int = 1
    processes: int = 2

    def __post_init__(self) -> None:
        if self.preset not in get_args(Preset):
            raise OptionError(
                f"no preset is called '{self.preset}'",
                remedy=f"choose one of: {', '.join(get_args(Preset))}",
            )
        if self.seed < 0:
            raise OptionError(f"seed {self.seed} is negative", remedy="give 0 or more")
        if not 1 <= self.processes <= 64:
            raise OptionError(f"{self.processes} processes", remedy="give 1 to 64")


@dataclass(frozen=True, slots=True)
class SimulatedScene:
    """What was written.

    Parameters
    ----------
    folder
        The recording.
    truth
        What it was made from.
    n_images, n_arm_samples
        What it holds.
    target
        The calibration target, as the command line names it.
    """

    folder: Path
    truth: Path
    n_images: int
    n_arm_samples: int
    target: str


def truth_path(folder: Path) -> Path:
    """``NAME.truth.json`` beside the folder ``NAME``: truth never travels inside a recording."""
    return folder.with_name(f"{folder.name}.truth.json")


def simulate_scene(
    folder: Path,
    head: str,
    scene: TwinScene,
    options: SimulateOptions | None = None,
    progress: Progress = silent,
) -> SimulatedScene:
    """Write a scene of the twin as a folder recording, and its truth beside it.

    Parameters
    ----------
    folder
        Must not exist, or be empty.
    head
        Name of the head.
    scene
        What it looks at; ``probing`` gives no images, but touches of the plate.
    options
        Preset, seed, processes.
    progress
        Called after each image.

    Raises
    ------
    OutputError
        If a result exists or cannot be written.
    OptionError
        If there is no such head.
    """
    settings = SimulateOptions() if options is None else options
    truth = truth_path(folder)
    check_new_folder(folder)
    check_outputs((truth,))
    twin = _twin(head, settings)
    n_images, n_samples = 0, 0
    if scene == "probing":
        n_samples = _write_touches(folder, twin)
    else:
        source = twin.scan(scene)
        n_images = len(source.rows)
        n_samples = 0 if source.arm is None else len(source.arm)
        _write_scan(folder, source, (head, scene, settings), progress)
    write_files({truth: twin.truth.document()})
    return SimulatedScene(folder, truth, n_images, n_samples, twin.target)


def _twin(head: str, options: SimulateOptions) -> Twin:
    return cast(Twin, load_driver("twin")(head=head, preset=options.preset, seed=options.seed))


def _write_touches(folder: Path, twin: Twin) -> int:
    probing = twin.probe_plate()
    tip = ProbeTip(probing.tool_from_probe_mm, probing.tip_diameter_mm)
    write_probing(folder, probing.arm, tip, is_simulated=True)
    return len(probing.arm)


def _write_scan(
    folder: Path,
    source: ScanSource,
    made_from: tuple[str, TwinScene, SimulateOptions],
    progress: Progress,
) -> None:
    def report(done: int, total: int, item: str) -> None:
        progress(ProgressEvent(STAGE, done, total, item))

    n = len(source.rows)
    n_processes = min(made_from[2].processes, max(1, n // IMAGES_A_PROCESS))
    if n_processes == 1:
        write_recording(folder, source, report)
        return
    images = _rendered_elsewhere(n, n_processes, made_from)
    try:
        write_recording(folder, source, report, encoded=images)
    except BrokenProcessPool as error:
        raise EstimationError(
            "a process that rendered images came to an end",
            where=str(folder),
            remedy="free some memory, or give --processes 1",
        ) from error
    finally:
        images.close()


def _rendered_elsewhere(
    n_images: int, n_processes: int, made_from: tuple[str, TwinScene, SimulateOptions]
) -> Generator[bytes]:
    """PNG files in the order of the rows, from processes that each build the scene anew."""
    pool = ProcessPoolExecutor(
        n_processes, get_context("spawn"), initializer=_start_rendering, initargs=made_from
    )
    try:
        yield from pool.map(_render, range(n_images))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _start_rendering(head: str, scene: TwinScene, options: SimulateOptions) -> None:
    # an interrupt is for the process that writes; it ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _scans.append(_twin(head, options).scan(scene))


def _render(row: int) -> bytes:
    source = _scans[0]
    setup = written_session(source).cameras[source.rows[row].camera]
    return encoded_png(source.exposure(row), setup)
