# SPDX-License-Identifier: Apache-2.0
"""Scenes of a twin as folder recordings, and its probing of the plate."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from itertools import islice
from pathlib import Path

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Twin, TwinScene
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.render_pool import MostViews, Scenes, TwinName, rendered
from armscan.storage.probe_files import ProbeTip, write_probing
from armscan.storage.recording_writer import write_recording

STAGE = "render images"


def record_scenes(
    folders: Mapping[TwinScene, Path],
    name: TwinName,
    most_views: MostViews | None = None,
    *,
    processes: int = 2,
    beside: Mapping[Path, bytes] | None = None,
    progress: Progress = silent,
) -> dict[TwinScene, ScanSource]:
    """Render scenes of a twin and write each as a folder recording.

    Each recording is there complete or not at all.

    Parameters
    ----------
    folders
        The scenes, with the folder of each, which must not exist or be empty.
    name
        The twin.
    most_views
        The most views that are wanted of some of them.
    processes
        Processes that render. A script that asks for more than 1 needs the usual
        ``if __name__ == "__main__"``.
    beside
        Files that belong to the recordings; they appear with the first one.
    progress
        Told of every image.

    Returns
    -------
    dict
        What was recorded, as the twin has it.

    Raises
    ------
    OutputError
        If a folder holds something or cannot be written.
    EstimationError
        If a process that renders came to an end.
    """
    wanted = {scene: (most_views or {}).get(scene) for scene in folders}
    scenes = Scenes(name.build(), wanted)
    scans = {scene: scenes.scan(scene) for scene in folders}
    total, before = sum(len(scan.rows) for scan in scans.values()), 0

    def report(done: int, _total: int, item: str) -> None:
        progress(ProgressEvent(STAGE, before + done, total, item))

    with closing(rendered(name, scenes, processes)) as images:
        for scene, scan in scans.items():
            own = islice(images, len(scan.rows))
            files = beside if before == 0 else None
            write_recording(folders[scene], scan, report, encoded=own, beside=files)
            before += len(scan.rows)
    return scans


def record_touches(folder: Path, twin: Twin, beside: Mapping[Path, bytes] | None = None) -> int:
    """Write the twin's touches of the plate, and files that belong to them; returns their count.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    """
    probing = twin.probe_plate()
    tip = ProbeTip(probing.tool_from_probe_mm, probing.tip_diameter_mm)
    write_probing(folder, probing.arm, tip, is_simulated=True, beside=beside)
    return len(probing.arm)
