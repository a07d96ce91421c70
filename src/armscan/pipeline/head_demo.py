# SPDX-License-Identifier: Apache-2.0
"""The whole chain on a simulated single-line arm scanner, from rendered images to inspections."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import TypeVar

from armscan.devices.scan_source import ScanSource
from armscan.devices.twin import Twin, TwinScene
from armscan.geometry.arrays import FloatArray
from armscan.inspection.results import PlaneInspection, SphereInspection, StepInspection
from armscan.pipeline.documents import camera_calibration, sensor_calibration
from armscan.pipeline.fewer_views import FewerViews
from armscan.pipeline.hand_eye import calibrate_hand_eye_from_scan
from armscan.pipeline.head_calibration import (
    IN_MEMORY,
    Instrument,
    ScanOf,
    calibrate_camera_of,
    calibrate_sheets_of,
    plate_of,
    succeeded,
)
from armscan.pipeline.head_measurements import (
    MeasuredPart,
    measure_ball,
    measure_part,
    measure_plate,
    measure_steps,
    measure_still_step,
)
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.pipeline.truth_errors import (
    CameraErrors,
    HandEyeErrors,
    SheetErrors,
    camera_errors,
    hand_eye_errors,
    sheet_errors,
)
from armscan.vision.targets.specification import parse_target

T = TypeVar("T")

SCENES: tuple[TwinScene, ...] = (
    "camera", "laser", "hand-eye", "plate", "ball", "steps", "still-step", "part",
)  # fmt: skip
"""Scenes that the chain scans, in its order; the plate is probed besides."""


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
    """Errors of the calibrations against the twin's truth."""

    camera: CameraErrors
    sheet: SheetErrors
    hand_eye: HandEyeErrors


@dataclass(frozen=True, slots=True, eq=False)
class HeadDemo:
    """All that the chain found.

    Parameters
    ----------
    instrument
        The calibrated scanner.
    plate_scan, plate
        The plate, and its inspection.
    ball_scan, ball
        The ball, and its inspection.
    steps
        One inspection a gauge block, through the arm.
    still_step, still_normal
        The block in one exposure, in Sensor; and the normal (3,) of its faces there, from the
        arm's pose.
    part
        The free-form part.
    errors
        Of the calibrations.
    seconds
        Time of each stage.
    """

    instrument: Instrument
    plate_scan: ScanReconstruction
    plate: PlaneInspection
    ball_scan: ScanReconstruction
    ball: SphereInspection
    steps: tuple[StepInspection, ...]
    still_step: StepInspection
    still_normal: FloatArray
    part: MeasuredPart
    errors: HeadErrors
    seconds: Mapping[str, float]


class Stopwatch:
    """Seconds of named stages."""

    def __init__(self) -> None:
        """Start with no stage."""
        self.seconds: dict[str, float] = {}

    def timed(self, stage: str, work: Callable[[], T]) -> T:
        """Do the work and note how long it took."""
        start = perf_counter()
        result = work()
        self.seconds[stage] = round(perf_counter() - start, 2)
        return result


def run_head(
    twin: Twin,
    options: HeadOptions | None = None,
    progress: Progress = silent,
    *,
    scans: Mapping[TwinScene, ScanSource] | None = None,
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
        Recordings of the twin's scenes; scenes that are not there are rendered when read.

    Raises
    ------
    EstimationError
        If a stage does not determine its result.
    """
    options = options or HeadOptions()

    def scan_of(scene: TwinScene) -> ScanSource:
        found = (scans or {}).get(scene)
        source = twin.scan(scene) if found is None else found
        most = options.most_views.get(scene)
        return source if most is None else FewerViews(source, most)

    watch = Stopwatch()
    instrument = calibrate_head(twin, scan_of, progress, watch)
    truth = twin.truth
    plate_scan, plate = watch.timed(
        "plate", lambda: measure_plate(scan_of("plate"), instrument, progress)
    )
    ball_scan, ball = watch.timed(
        "ball",
        lambda: measure_ball(scan_of("ball"), instrument, truth.ball_diameter_mm, progress),
    )
    steps = watch.timed(
        "steps",
        lambda: measure_steps(scan_of("steps"), instrument, truth.step_heights_mm, progress),
    )
    still, still_normal = watch.timed(
        "still_step",
        lambda: measure_still_step(scan_of("still-step"), instrument, steps[0].normal, progress),
    )
    part = watch.timed("part", lambda: measure_part(scan_of("part"), instrument, truth, progress))
    errors = calibration_errors(twin, instrument)
    return HeadDemo(
        instrument,
        plate_scan,
        plate,
        ball_scan,
        ball,
        steps,
        still,
        still_normal,
        part,
        errors,
        watch.seconds,
    )


def calibrate_head(twin: Twin, scan_of: ScanOf, progress: Progress, watch: Stopwatch) -> Instrument:
    """Camera, light sheet, plate and hand-eye; arguments and errors as `run_head`."""
    target = parse_target(twin.target)
    camera_run = watch.timed(
        "calibrate_camera", lambda: calibrate_camera_of(scan_of("camera"), target, progress)
    )
    camera = camera_calibration(camera_run.fit, IN_MEMORY)
    laser = watch.timed(
        "calibrate_laser", lambda: calibrate_sheets_of(scan_of("laser"), target, camera, progress)
    )
    sensor = sensor_calibration(laser, IN_MEMORY)
    plate = watch.timed("probe_plate", lambda: plate_of(twin.probe_plate()))
    hand_eye = watch.timed(
        "calibrate_hand_eye",
        lambda: calibrate_hand_eye_from_scan(scan_of("hand-eye"), sensor, plate, progress=progress),
    )
    return Instrument(camera_run, camera, laser, sensor, plate, succeeded(hand_eye, "hand-eye"))


def calibration_errors(twin: Twin, instrument: Instrument) -> HeadErrors:
    """How far the calibrations are from the twin's truth."""
    truth, sensor = twin.truth, instrument.sensor
    own = sensor.sheet_parameter_slice(0)
    return HeadErrors(
        camera_errors(instrument.camera, truth.camera_parameters),
        sheet_errors(
            sensor.sheets[0],
            sensor.covariance[own, own],
            truth.sheet_points_mm[sensor.sheets[0].name],
        ),
        hand_eye_errors(instrument.scanner, truth.tool_from_sensor),
    )
