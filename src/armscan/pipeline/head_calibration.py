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
from armscan.pipeline.camera import CameraRun, calibrate_camera_from_exposures
from armscan.pipeline.documents import camera_calibration, sensor_calibration
from armscan.pipeline.hand_eye import HandEyeRun, calibrate_hand_eye_from_scan
from armscan.pipeline.laser import calibrate_sheets_from_exposures
from armscan.pipeline.progress import Progress
from armscan.pipeline.stopwatch import Stopwatch
from armscan.pipeline.twin_scans import TwinScans
from armscan.records.exposure import Exposure
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
    camera_run, camera
        The camera's calibration, and what its document keeps.
    laser, sensor
        The light sheet's, and camera and sheet together.
    plate
        The plate as it was probed.
    hand_eye
        The hand-eye's.
    """

    camera_run: CameraRun
    camera: CameraCalibration
    laser: LaserFit
    sensor: SensorCalibration
    plate: PlateReference
    hand_eye: HandEyeRun

    @property
    def cameras(self) -> tuple[CameraCalibration, ...]:
        """The camera or cameras, left first."""
        second = self.sensor.second
        return (self.camera,) if second is None else (self.camera, second.camera)

    @property
    def scanner(self) -> ScannerCalibration:
        """All together."""
        return ScannerCalibration(self.sensor, self.hand_eye.fit.calibration, IN_MEMORY)


def calibrate_head(
    twin: Twin, scans: TwinScans, progress: Progress, watch: Stopwatch
) -> Instrument:
    """Camera, light sheets, plate and hand-eye of a twin.

    Raises
    ------
    EstimationError
        If a scan does not determine what rests on it.
    """
    target = parse_target(twin.target)
    camera_run = watch.timed(
        "calibrate_camera",
        lambda: calibrate_camera_of(scans.calibration("camera"), target, progress),
    )
    camera = camera_calibration(camera_run.fit, IN_MEMORY)
    laser = watch.timed(
        "calibrate_laser",
        lambda: calibrate_sheets_of(scans.calibration("laser"), target, camera, progress),
    )
    sensor = sensor_calibration(laser, IN_MEMORY)
    plate = watch.timed("probe_plate", lambda: plate_of(twin.probe_plate()))
    hand_eye = watch.timed(
        "calibrate_hand_eye",
        lambda: calibrate_hand_eye_from_scan(
            scans.calibration("hand-eye"), sensor, plate, progress=progress
        ),
    )
    return Instrument(camera_run, camera, laser, sensor, plate, succeeded(hand_eye, "hand-eye"))


def calibrate_camera_of(source: ScanSource, target: Target, progress: Progress) -> CameraRun:
    """Camera from all exposures of a scan of the target.

    Raises
    ------
    EstimationError
        If the scan does not determine the camera.
    """
    return succeeded(
        calibrate_camera_from_exposures(_all(source), target, progress=progress), source.name
    )


def calibrate_sheets_of(
    source: ScanSource, target: Target, camera: CameraCalibration, progress: Progress
) -> LaserFit:
    """Light sheets from pairs of exposures with and without laser; equal views are a pair.

    Raises
    ------
    EstimationError
        If the scan does not determine the sheets.
    """
    exposures = _all(source)
    lit = [exposure for exposure in exposures if exposure.lasers]
    dark = {exposure.view: exposure for exposure in exposures if not exposure.lasers}
    backgrounds = [dark[exposure.view] for exposure in lit if exposure.view in dark]
    fit = calibrate_sheets_from_exposures(
        lit, target, camera, backgrounds=backgrounds, progress=progress
    )
    return succeeded(fit, source.name)


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


def _all(source: ScanSource) -> list[Exposure]:
    return [source.exposure(row) for row in range(len(source.rows))]
