# SPDX-License-Identifier: Apache-2.0
"""The demo's scans as folder recordings: written first, then read like any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import TwinScene
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.adaptive_recording import record_adaptively
from armscan.pipeline.progress import Progress
from armscan.pipeline.render_pool import TwinName
from armscan.pipeline.twin_recordings import record_scenes, record_touches
from armscan.storage.recording_reader import FolderRecording, read_recording


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScans:
    """See `armscan.pipeline.twin_scans.TwinScans`.

    Parameters
    ----------
    folder
        Where the recordings go.
    name
        The twin.
    most_views
        The most views that are wanted of some scenes; where lasers are chosen meanwhile, the most
        exposures of a stroke.
    processes
        Processes that render.
    """

    folder: Path
    name: TwinName
    most_views: Mapping[TwinScene, int] = field(default_factory=dict)
    processes: int = 2
    recordings: dict[TwinScene, FolderRecording] = field(default_factory=dict, init=False)

    def record(self, scenes: Sequence[TwinScene], progress: Progress) -> None:
        """Render and write scenes, and the touches of the plate."""
        self.folder.mkdir()
        record_touches(self.folder / "probing", self.name.build())
        record_scenes(
            {scene: self.folder / scene for scene in scenes},
            self.name,
            self.most_views,
            processes=self.processes,
            progress=progress,
        )
        for scene in scenes:
            self.recordings[scene] = read_recording(self.folder / scene)

    def calibration(self, scene: TwinScene) -> ScanSource:
        """Read what was recorded."""
        return self.recordings[scene]

    def scanned(
        self, scene: TwinScene, scanner: ScannerCalibration, progress: Progress
    ) -> ScanSource:
        """Read what was recorded, or record it now, with lasers chosen by the naming."""
        if scene not in self.recordings:
            record_adaptively(
                self.folder / scene,
                self.name,
                scene,
                scanner,
                longest_stroke=self.most_views.get(scene),
                processes=self.processes,
                progress=progress,
            )
            self.recordings[scene] = read_recording(self.folder / scene)
        return self.recordings[scene]
