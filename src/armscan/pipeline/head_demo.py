# SPDX-License-Identifier: Apache-2.0
"""The whole chain on a simulated arm scanner of any head, from rendered images to inspections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

from armscan.devices.twin import Twin, TwinScene
from armscan.geometry.arrays import FloatArray
from armscan.inspection.results import PlaneInspection, SphereInspection, StepInspection
from armscan.pipeline.head_calibration import Instrument, calibrate_head
from armscan.pipeline.head_measurements import (
    MeasuredPart,
    inspect_ball,
    inspect_part,
    inspect_plate,
    inspect_steps,
    measure_still_step,
    still_height_mm,
)
from armscan.pipeline.naming_truth import NamingErrors, naming_errors
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.scan import measure_scan
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.pipeline.stopwatch import Stopwatch
from armscan.pipeline.truth_errors import (
    CameraErrors,
    HandEyeErrors,
    SheetErrors,
    camera_errors,
    hand_eye_errors,
    sheet_errors,
    true_names,
)
from armscan.pipeline.twin_scans import RenderedScans, TwinScans

ONE_SHEET_SCENES: tuple[TwinScene, ...] = ("plate", "ball", "steps", "part")
"""Scenes scanned by hand with a head of one sheet; where sheets are named, waves come besides."""


@dataclass(frozen=True, slots=True)
class HeadOptions:
    """How much of the twin's scans the chain uses.

    Parameters
    ----------
    most_views
        Views of a scene that are used, evenly chosen; scenes that are not named are used whole.
    """

    most_views: Mapping[TwinScene, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class HeadErrors:
    """Errors of the calibrations against the twin's truth.

    Parameters
    ----------
    cameras
        One a camera, left first.
    sheets
        One a light sheet, in the order of the calibration.
    hand_eye
        Where the sensor sits on the arm.
    """

    cameras: tuple[CameraErrors, ...]
    sheets: tuple[SheetErrors, ...]
    hand_eye: HandEyeErrors


@dataclass(frozen=True, slots=True, eq=False)
class HeadDemo:
    """All that the chain found.

    Parameters
    ----------
    instrument
        The calibrated scanner.
    scans
        Points in Base of every scene that was scanned by hand.
    plate, ball
        Inspections of the plate and of the ball.
    steps
        One inspection a gauge block, through the arm.
    still_step, still_normal
        A block in one exposure, in Sensor; and the normal (3,) of its faces there, from the
        arm's pose.
    part
        The free-form part.
    naming
        Names of stripes against the truth, by scene; empty for a head of one sheet.
    errors
        Of the calibrations.
    seconds
        Time of each stage.
    """

    instrument: Instrument
    scans: Mapping[TwinScene, ScanReconstruction]
    plate: PlaneInspection
    ball: SphereInspection
    steps: tuple[StepInspection, ...]
    still_step: StepInspection
    still_normal: FloatArray
    part: MeasuredPart
    naming: Mapping[TwinScene, NamingErrors]
    errors: HeadErrors
    seconds: Mapping[str, float]


def run_head(
    twin: Twin,
    options: HeadOptions | None = None,
    progress: Progress = silent,
    *,
    scans: TwinScans | None = None,
) -> HeadDemo:
    """Calibrate the twin's scanner from its scans, measure its things, compare with the truth.

    Parameters
    ----------
    twin
        The simulated instrument.
    options
        Defaults if None.
    progress
        Told of every exposure.
    scans
        Where scans come from; None renders them when they are read.

    Raises
    ------
    EstimationError
        If a stage does not determine its result.
    """
    options = options or HeadOptions()
    given = scans or RenderedScans(twin, options.most_views)
    watch = Stopwatch()
    instrument = calibrate_head(twin, given, progress, watch)
    scanner, truth = instrument.scanner, twin.truth
    scenes = scanned_scenes(instrument)
    found: dict[TwinScene, ScanReconstruction] = {}
    for scene in scenes:
        source = watch.timed(f"take_{scene}", partial(given.scanned, scene, scanner, progress))
        found[scene] = watch.timed(scene, partial(measure_scan, source, scanner, progress=progress))
    steps = inspect_steps(found["steps"], truth.step_heights_mm)
    still, still_normal = watch.timed(
        "still_step",
        lambda: measure_still_step(
            given.scanned("still-step", scanner, progress),
            instrument,
            steps[0].normal,
            still_height_mm(instrument),
        ),
    )
    naming: dict[TwinScene, NamingErrors] = {}
    names = true_names(instrument.sensor, truth.sheet_points_mm)
    if len(scenes) > len(ONE_SHEET_SCENES):
        naming = {
            scene: watch.timed(
                "compare_names", partial(naming_errors, found[scene], twin.scan(scene), names)
            )
            for scene in scenes
        }
    return HeadDemo(
        instrument,
        found,
        inspect_plate(found["plate"], instrument),
        inspect_ball(found["ball"], truth.ball_diameter_mm),
        steps,
        still,
        still_normal,
        inspect_part(found["part"], truth),
        naming,
        calibration_errors(twin, instrument),
        watch.seconds,
    )


def scanned_scenes(instrument: Instrument) -> tuple[TwinScene, ...]:
    """Scenes that are scanned by hand: where sheets must be named, a wavy plate too."""
    return ONE_SHEET_SCENES if len(instrument.sensor.sheets) == 1 else (*ONE_SHEET_SCENES, "waves")


def calibration_errors(twin: Twin, instrument: Instrument) -> HeadErrors:
    """How far the calibrations are from the twin's truth."""
    truth, sensor = twin.truth, instrument.sensor
    cameras = [camera_errors(sensor.camera, truth.camera_parameters)]
    if sensor.second is not None and truth.right_camera_parameters is not None:
        cameras.append(camera_errors(sensor.second.camera, truth.right_camera_parameters))
    sheets, names = [], true_names(sensor, truth.sheet_points_mm)
    for k, sheet in enumerate(sensor.sheets):
        own = sensor.sheet_parameter_slice(k)
        points = truth.sheet_points_mm[names[sheet.name]]
        low, high = sheet.depth_range_mm
        inside = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
        sheets.append(sheet_errors(sheet, sensor.covariance[own, own], inside))
    return HeadErrors(
        tuple(cameras), tuple(sheets), hand_eye_errors(instrument.scanner, truth.tool_from_sensor)
    )
