# SPDX-License-Identifier: Apache-2.0
"""Calibrations and the cloud that a demo writes, each with what it came from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from armscan.devices.twin import TwinScene
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.models.scanner import ScannerCalibration
from armscan.models.stereo import StereoCalibration
from armscan.pipeline.head_demo import HeadDemo
from armscan.storage.calibration_files import camera_document, sensor_document
from armscan.storage.clouds import ply_bytes
from armscan.storage.provenance import new_provenance
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_reader import FolderRecording
from armscan.storage.recording_session import SESSION_FILE
from armscan.storage.scanner_files import scanner_document
from armscan.storage.stereo_files import stereo_document


@dataclass(frozen=True, slots=True)
class DemoOrigin:
    """Where a demo's files come from.

    Parameters
    ----------
    command
        The command line.
    folder, place
        Where they will lie, and where they lie yet.
    """

    command: tuple[str, ...]
    folder: Path
    place: Path

    def provenance(self, files: Iterable[Path], *parents: Provenance) -> Provenance:
        """Provenance that names files in ``place`` as they will be in ``folder``."""
        found = new_provenance(files, command=self.command, parents=parents)
        inputs = tuple(
            replace(item, path=(self.folder / Path(item.path).relative_to(self.place)).as_posix())
            for item in found.inputs
        )
        return replace(found, inputs=inputs)

    def of_recording(self, recording: FolderRecording, *parents: Provenance) -> Provenance:
        """Provenance of what rests on a recording."""
        folder = recording.folder
        return self.provenance((folder / EXPOSURES_FILE, folder / SESSION_FILE), *parents)


def demo_documents(
    demo: HeadDemo, scans: Mapping[TwinScene, FolderRecording], origin: DemoOrigin
) -> dict[Path, bytes]:
    """Files to write: camera or cameras, sensor, scanner, and the part's cloud."""
    found, place = demo.instrument, origin.place
    base = origin.of_recording(scans["camera"])
    sensor = replace(
        found.sensor,
        camera=replace(found.sensor.camera, provenance=base),
        provenance=origin.of_recording(scans["laser"], base),
    )
    if sensor.second is not None:
        right = replace(sensor.second.camera, provenance=base)
        sensor = replace(sensor, second=replace(sensor.second, camera=right))
    scanner = ScannerCalibration(
        sensor,
        found.hand_eye.fit.calibration,
        origin.of_recording(scans["hand-eye"], sensor.provenance),
    )
    return {
        **_cameras(found.camera, place, base),
        place / "sensor.json": sensor_document(sensor),
        place / "scanner.json": scanner_document(scanner),
        place / "cloud.ply": ply_bytes(demo.part.scan.cloud),
    }


def _cameras(
    found: CameraCalibration | StereoCalibration, place: Path, provenance: Provenance
) -> dict[Path, bytes]:
    if isinstance(found, CameraCalibration):
        return {place / "camera.json": camera_document(replace(found, provenance=provenance))}
    return {place / "stereo.json": stereo_document(replace(found, provenance=provenance))}
