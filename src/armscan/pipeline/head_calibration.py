# SPDX-License-Identifier: Apache-2.0
"""An arm scanner of any head calibrated from its scans: camera, light sheet, plate, hand-eye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import plate_from_probing
from armscan.calibration.laser.result import LaserFit
from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Probing, Twin
from armscan.errors import EstimationError
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration, Provenance, SensorCalibration
from armscan.models.probe_tip import tip_centres, tool_from_probe
from armscan.models.scanner import ScannerCalibration
from armscan.models.stereo import StereoCalibration
from armscan.pipeline.camera import calibrate_camera_from_exposures
from armscan.pipeline.documents import camera_calibration, sensor_calibration
from armscan.pipeline.hand_eye import HandEyeRun, calibrate_hand_eye_from_scan
from armscan.pipeline.laser import calibrate_sheets_from_scan
from armscan.pipeline.progress import Progress
from armscan.pipeline.stereo import (
    calibrate_stereo_from_exposures,
    stereo_calibration,
    stereo_rows,
)
from armscan.pipeline.stopwatch import Stopwatch
from armscan.pipeline.twin_scans import TwinScans
from armscan.records.probing import ProbedPoints
from armscan.vision.targets.definition import Target
from armscan.vision.targets.specification import parse_target

T = TypeVar("T")

IN_MEMORY = Provenance("in memory", "", "", (), ())


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """A calibrated scanner with the evidence of each step.

    Parameters
    ----------
    camera
        The camera, or two.
    laser, sensor
        The light sheets, and cameras and sheets together.
    plate
        The plate as it was probed.
    hand_eye
        The hand-eye's.
    """

    camera: CameraCalibration | StereoCalibration
    laser: LaserFit
    sensor: SensorCalibration
    plate: PlateReference
    hand_eye: HandEyeRun

    @property
    def cameras(self) -> tuple[CameraCalibration, ...]:
        """The camera or cameras, left first."""
        second = self.sensor.second
        left = self.sensor.camera
        return (left,) if second is None else (left, second.camera)

    @property
    def scanner(self) -> ScannerCalibration:
        """All together."""
        return ScannerCalibration(self.sensor, self.hand_eye.fit.calibration, IN_MEMORY)


def calibrate_head(
    twin: Twin, scans: TwinScans, progress: Progress, watch: Stopwatch
) -> Instrument:
    """Camera or cameras, light sheets, plate and hand-eye of a twin.

    Raises
    ------
    EstimationError
        If a scan does not determine what rests on it.
    """
    target = parse_target(twin.target)
    camera = watch.timed(
        "calibrate_camera", lambda: _cameras_of(scans.calibration("camera"), target, progress)
    )
    laser = watch.timed(
        "calibrate_laser",
        lambda: succeeded(
            calibrate_sheets_from_scan(
                scans.calibration("laser"), target, camera, progress=progress
            ),
            "laser",
        ),
    )
    sensor = sensor_calibration(laser, IN_MEMORY)
    plate = watch.timed("probe_plate", lambda: plate_of(twin.probe_plate()))
    hand_eye = watch.timed(
        "calibrate_hand_eye",
        lambda: calibrate_hand_eye_from_scan(
            scans.calibration("hand-eye"), sensor, plate, progress=progress
        ),
    )
    return Instrument(camera, laser, sensor, plate, succeeded(hand_eye, "hand-eye"))


def _cameras_of(
    source: ScanSource, target: Target, progress: Progress
) -> CameraCalibration | StereoCalibration:
    """Camera, or two cameras, from all exposures of a scan of the target."""
    exposures = [source.exposure(row) for row in range(len(source.rows))]
    if {row.camera for row in source.rows} == {0}:
        run = calibrate_camera_from_exposures(exposures, target, progress=progress)
        return camera_calibration(succeeded(run, source.name).fit, IN_MEMORY)
    pairs = [
        (None if left is None else exposures[left], None if right is None else exposures[right])
        for left, right in stereo_rows(source.rows, source.name)
    ]
    found = calibrate_stereo_from_exposures(pairs, target, progress=progress)
    return stereo_calibration(succeeded(found, source.name).fit, IN_MEMORY)


def plate_of(probing: Probing) -> PlateReference:
    """Plane of the probed plate, the tip compensated on the side where the tool was.

    Raises
    ------
    EstimationError
        If the touches determine no plane.
    """
    track = probing.arm
    centres = tip_centres(track, tool_from_probe(probing.tool_from_probe_mm))
    points = ProbedPoints(centres, probing.tip_diameter_mm, source="probing")
    return succeeded(
        plate_from_probing(points, track.translations_mm[track.is_known]), points.source
    )


def succeeded(result: T | FitFailure, what: str) -> T:
    """The result, or its failure raised.

    Raises
    ------
    EstimationError
        If there is none.
    """
    if isinstance(result, FitFailure):
        raise EstimationError(result.reason, where=what, remedy=result.remedy)
    return result
