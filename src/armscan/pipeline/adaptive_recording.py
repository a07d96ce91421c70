# SPDX-License-Identifier: Apache-2.0
"""A scan whose lasers are chosen while it is taken, as a folder recording; strokes in parallel."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armscan.devices.twin import SimulatedScan, TwinScene
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.adaptive_scan import (
    ChosenLasers,
    TakenStroke,
    sensor_poses,
    strokes,
    take_stroke,
)
from armscan.pipeline.child_processes import in_processes
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.render_pool import TwinName
from armscan.pipeline.scan_part import ScanPart
from armscan.reconstruction.identify_cross import CrossNamer
from armscan.records.exposure import Exposure
from armscan.storage.recording_images import encoded_png
from armscan.storage.recording_writer import write_recording, written_session

STAGE = "scan with chosen lasers"


@dataclass(frozen=True, slots=True)
class _Taken:
    """A stroke with its images as PNG files."""

    stroke: TakenStroke
    images: tuple[bytes, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Rig:
    """What takes strokes in one process."""

    scan: SimulatedScan
    scanner: ScannerCalibration

    def take(self, rows: range) -> _Taken:
        """Take one stroke, and keep its images."""
        scan, sensor = self.scan, self.scanner.sensor
        if sensor is None:
            raise ValueError("a scanner without sensor names no stripes")
        setup = written_session(scan).cameras[0]
        images: list[bytes] = []

        def keep(_row: int, exposure: Exposure) -> None:
            images.append(encoded_png(exposure, setup))

        pose = sensor_poses(scan, self.scanner)
        stroke = take_stroke(scan, rows, CrossNamer(sensor), pose, keep=keep)
        return _Taken(stroke, tuple(images))


_here: list[_Rig] = []
"""What this process takes strokes with; empty in any but a process of the pool."""


def record_adaptively(
    folder: Path,
    name: TwinName,
    scene: TwinScene,
    scanner: ScannerCalibration,
    *,
    longest_stroke: int | None = None,
    processes: int = 2,
    progress: Progress = silent,
) -> None:
    """Take a scene of a twin with the lasers that the naming asks for, and write the recording.

    Parameters
    ----------
    folder
        Must not exist or be empty.
    name, scene
        The twin, and what it looks at.
    scanner
        The calibrated scanner.
    longest_stroke
        Exposures that are taken of each stroke, its first ones; None for all.
    processes
        Processes that take strokes; 1 takes them in this one.
    progress
        Told of every stroke.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    EstimationError
        If a process came to an end.
    """
    scan = _planned(name, scene, longest_stroke)
    pieces = strokes(scan.rows)
    done: list[_Taken] = []
    given = (name, scene, scanner, longest_stroke)
    with closing(_taken(pieces, processes, given)) as results:
        for taken in results:
            progress(ProgressEvent(STAGE, len(done), len(pieces), scene))
            done.append(taken)
    progress(ProgressEvent(STAGE, len(pieces), len(pieces)))
    chosen = ChosenLasers.of_strokes(scan, [taken.stroke for taken in done])
    write_recording(folder, chosen, encoded=[image for taken in done for image in taken.images])


_Given = tuple[TwinName, TwinScene, ScannerCalibration, int | None]
"""What a rig is made of, in any process."""


def _taken(pieces: Sequence[range], processes: int, given: _Given) -> Generator[_Taken]:
    n_processes = min(processes, len(pieces))
    if n_processes > 1:
        yield from in_processes(_take, pieces, n_processes, _prepare, given)
        return
    rig = _rig(*given)
    for rows in pieces:
        yield rig.take(rows)


def _planned(name: TwinName, scene: TwinScene, longest_stroke: int | None) -> SimulatedScan:
    """The scene, of each stroke as many exposures as are wanted."""
    whole = name.build().scan(scene)
    if longest_stroke is None:
        return whole
    kept = [row for rows in strokes(whole.rows) for row in rows[:longest_stroke]]
    return ScanPart(whole, tuple(kept))


def _rig(
    name: TwinName, scene: TwinScene, scanner: ScannerCalibration, longest_stroke: int | None
) -> _Rig:
    return _Rig(_planned(name, scene, longest_stroke), scanner)


def _prepare(*given: Any) -> None:
    _here.append(_rig(*given))


def _take(rows: range) -> _Taken:
    return _here[0].take(rows)
