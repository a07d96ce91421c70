# SPDX-License-Identifier: Apache-2.0
"""One scene of the twin as a folder recording, its truth beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from armscan.devices.twin import Preset, TwinScene
from armscan.errors import OptionError, OutputError
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.render_pool import TwinName
from armscan.pipeline.twin_recordings import record_scenes, record_touches
from armscan.storage.atomic import check_outputs
from armscan.storage.atomic_folder import check_new_folder


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
    n_cameras
        Cameras that took the images.
    sources
        Laser sources that were on in any of them.
    """

    folder: Path
    truth: Path
    n_images: int
    n_arm_samples: int
    target: str
    n_cameras: int = 0
    sources: tuple[str, ...] = ()


def truth_path(folder: Path) -> Path:
    """``NAME.truth.json`` beside the folder ``NAME``: truth never travels inside a recording.

    Raises
    ------
    OutputError
        If the folder is a root.
    """
    # "." and "a/.." have no name of their own
    named = folder if folder.name not in ("", "..") else folder.resolve()
    if not named.name:
        raise OutputError("a root has no name", where=str(folder), remedy="name a new folder")
    return named.with_name(f"{named.name}.truth.json")


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
    EstimationError
        If a process that renders came to an end.
    """
    settings = SimulateOptions() if options is None else options
    truth = truth_path(folder)
    check_new_folder(folder)
    if truth.is_file():
        raise OutputError(
            "the truth of an earlier recording is there",
            where=str(truth),
            remedy="remove it, or name another folder",
        )
    check_outputs((truth,))
    name = TwinName(head, settings.preset, settings.seed)
    twin = name.build()
    beside = {truth: twin.truth.document()}
    if scene == "probing":
        n_touches = record_touches(folder, twin, beside)
        return SimulatedScene(folder, truth, 0, n_touches, twin.target)
    source = record_scenes(
        {scene: folder}, name, processes=settings.processes, beside=beside, progress=progress
    )[scene]
    return SimulatedScene(
        folder,
        truth,
        n_images=len(source.rows),
        n_arm_samples=0 if source.arm is None else len(source.arm),
        target=twin.target,
        n_cameras=len({row.camera for row in source.rows}),
        sources=tuple(dict.fromkeys(name for row in source.rows for name in row.lasers)),
    )
