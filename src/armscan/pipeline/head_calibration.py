# SPDX-License-Identifier: Apache-2.0
"""A single-line arm scanner calibrated from its scans: camera, light sheet, plate, hand-eye."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import plate_from_probing
from armscan.calibration.laser.result import LaserFit
from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Probing, TwinScene
from armscan.errors import EstimationError
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration, Provenance, SensorCalibration
from armscan.models.probe_tip import tip_centres, tool_from_probe
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.camera import CameraRun, calibrate_camera_from_exposures
from armscan.pipeline.hand_eye import HandEyeRun
from armscan.pipeline.laser import calibrate_sheets_from_exposures
from armscan.pipeline.progress import Progress
from armscan.records.exposure import Exposure
from armscan.records.probing import ProbedPoints
from armscan.vision.targets.definition import Target

T = TypeVar("T")

ScanOf = Callable[[TwinScene], ScanSource]
"""Gives the scan of a scene."""

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
    def scanner(self) -> ScannerCalibration:
        """All together."""
        return ScannerCalibration(self.sensor, self.hand_eye.fit.calibration, IN_MEMORY)


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
