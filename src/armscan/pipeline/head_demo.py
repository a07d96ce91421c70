# SPDX-License-Identifier: Apache-2.0
"""One head of the twin calibrated and measured, scene by scene, and what came out beside the
truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Protocol, TypeVar

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import plate_from_probing
from armscan.calibration.sheets.result import LaserFit
from armscan.devices.sources import Probing, ScanSource, Twin, TwinScene, TwinTruth
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import PlaneInspection, SphereInspection, StepInspection
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.step import inspect_step
from armscan.models.calibration import (
    CameraCalibration,
    Provenance,
    ScannerCalibration,
    SensorCalibration,
)
from armscan.models.probe import tip_centres, tool_from_probe
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.adaptive_scan import record_adaptively, scan_adaptively
from armscan.pipeline.cameras import (
    calibrate_camera_from_exposures,
    calibrate_stereo_from_exposures,
    stereo_calibration,
    stereo_rows,
)
from armscan.pipeline.documents import camera_calibration
from armscan.pipeline.hand_eye import HandEyeRun, calibrate_hand_eye_from_scan
from armscan.pipeline.instants import pair_by_view
from armscan.pipeline.laser import calibrate_sheets_from_pairs
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.reconstruct import reconstruct
from armscan.pipeline.scan import ScanReconstruction, measure_scan
from armscan.pipeline.scan_part import FewerViews
from armscan.pipeline.simulate import TwinName, record_scenes, record_touches
from armscan.pipeline.truth import (
    CameraErrors,
    HandEyeErrors,
    NamingErrors,
    SheetErrors,
    camera_errors,
    hand_eye_errors,
    naming_errors,
    sheet_errors,
    true_names,
)
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.label_single import DepthRange
from armscan.reconstruction.sync import exposure_poses
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.records.points import ProbedPoints
from armscan.storage.recording import FolderRecording, read_recording
from armscan.vision.targets.target import Target, parse_target

T = TypeVar("T")


class Stopwatch:
    """Seconds of named stages."""

    def __init__(self) -> None:
        """Start with no stage."""
        self.seconds: dict[str, float] = {}

    def timed(self, stage: str, work: Callable[[], T]) -> T:
        """Do the work and note how long it took; parts of one stage are added up."""
        start = perf_counter()
        result = work()
        before = self.seconds.get(stage, 0.0)
        self.seconds[stage] = round(before + perf_counter() - start, 2)
        return result


class TwinScans(Protocol):
    """Gives the scans of a twin, in the order in which the chain asks for them."""

    def calibration(self, scene: TwinScene) -> ScanSource:
        """A scan that a calibration rests on."""

    def scanned(
        self, scene: TwinScene, scanner: ScannerCalibration, progress: Progress
    ) -> ScanSource:
        """A scan by hand with the calibrated scanner, which may choose its lasers meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedScans:
    """Scans in memory; pixels are rendered when an exposure is asked for.

    Parameters
    ----------
    twin
        The simulated instrument.
    most_views
        Views of a scene that are used, evenly chosen; scenes that are not named are used whole.
    """

    twin: Twin
    most_views: Mapping[TwinScene, int] = field(default_factory=dict)

    def calibration(self, scene: TwinScene) -> ScanSource:
        """See `TwinScans`."""
        whole, most = self.twin.scan(scene), self.most_views.get(scene)
        return whole if most is None else FewerViews(whole, most)

    def scanned(
        self, scene: TwinScene, scanner: ScannerCalibration, progress: Progress
    ) -> ScanSource:
        """See `TwinScans`."""
        sensor = scanner.sensor
        if len(self.twin.sources) < 2 or scene == "still-step" or sensor is None:
            return self.calibration(scene)
        taken: dict[int, Exposure] = {}
        namer = CrossLabeller(sensor)
        chosen, _ = scan_adaptively(self.twin.scan(scene), scanner, namer, keep=taken.__setitem__)
        return replace(chosen, taken=taken)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScans:
    """See `armscan.pipeline.head_demo.TwinScans`.

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


IN_MEMORY = Provenance(
    document_id="in memory", created_utc="", armscan_version="", command=(), inputs=()
)


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
        return ScannerCalibration(
            sensor=self.sensor, hand_eye=self.hand_eye.fit.calibration, provenance=IN_MEMORY
        )


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
    source = scans.calibration("laser")
    laser = watch.timed(
        "calibrate_laser",
        lambda: succeeded(
            calibrate_sheets_from_pairs(
                pair_by_view([source.exposure(row) for row in range(len(source.rows))]),
                target,
                camera,
                progress=progress,
            ),
            "laser",
        ),
    )
    sensor = laser.to_calibration(IN_MEMORY)
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
    points = ProbedPoints(
        points_mm=centres, tip_diameter_mm=probing.tip_diameter_mm, source="probing"
    )
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


STILL_HEIGHT_MM = 20.0
STEREO_STILL_HEIGHT_MM = 5.0
STILL_MARGIN = 0.3
"""The block fills the view, and its lower face lies up to 13 mm beyond the 55 mm of depth in which
the crossed lines are calibrated."""
PART_REACH_MM = 1.0
"""Points of the part's scan further than this from its surface lie on what stands around it."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPart:
    """A free-form part against its true surface.

    Parameters
    ----------
    scan
        The scan of it.
    rows
        (N,) rows, in its cloud, of the points within `PART_REACH_MM` of the true surface.
    distance_mm
        (N,) their signed distances from it.
    n_elsewhere
        Points further away.
    normalised_rms
        Root mean square of these distances over the stated sigma along the surface's normal.
    """

    scan: ScanReconstruction
    rows: IntArray
    distance_mm: FloatArray
    n_elsewhere: int
    normalised_rms: float

    @property
    def rms_mm(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean(self.distance_mm**2)))

    def fraction_within(self, limit_mm: float) -> float:
        """Share of the points within a distance of the true surface."""
        return float(np.mean(np.abs(self.distance_mm) <= limit_mm))


def inspect_plate(scan: ScanReconstruction, instrument: Instrument) -> PlaneInspection:
    """Points of the plate against the fitted and the probed plane.

    Raises
    ------
    EstimationError
        If no plane was found.
    """
    plane = instrument.plate.plane
    return succeeded(inspect_plane(scan.cloud, plane, reference_text="the probed plane"), "plate")


def inspect_ball(scan: ScanReconstruction, diameter_mm: float) -> SphereInspection:
    """Points of the ball against fitted and nominal diameter; raises the same."""
    return succeeded(inspect_sphere(scan.cloud, diameter_mm), "ball")


def inspect_steps(
    scan: ScanReconstruction, heights_mm: tuple[float, ...]
) -> tuple[StepInspection, ...]:
    """Heights of gauge blocks through the arm; raises the same."""
    return tuple(succeeded(inspect_step(scan.cloud, height), "steps") for height in heights_mm)


def still_height_mm(instrument: Instrument) -> float:
    """Height of the block of the scene ``still-step``: figure 5.19, or 5.33 with two cameras."""
    return STILL_HEIGHT_MM if instrument.sensor.second is None else STEREO_STILL_HEIGHT_MM


def measure_still_step(
    source: ScanSource, instrument: Instrument, normal_base: FloatArray, height_mm: float
) -> tuple[StepInspection, FloatArray]:
    """Height of a block from one exposure, in the Sensor frame; raises the same.

    Within the light sheet the faces stand further apart than the height if the sheet leans; how
    far it leans follows from the arm's pose and the faces' direction in Base.

    Parameters
    ----------
    source
        One exposure, of each camera.
    instrument
        The scanner.
    normal_base
        (3,) normal of the faces in Base, as the scan of the blocks gave it.
    height_mm
        Nominal height.

    Returns
    -------
    step, normal_sensor
        The inspection, and the normal (3,) in the Sensor frame that it rests on.
    """
    poses = exposure_poses(source.rows, source.arm, source.session.clock)
    base_from_sensor = poses.pose(0) @ instrument.scanner.hand_eye.tool_from_sensor
    normal = base_from_sensor.rotation.T @ normal_base
    first, *others = (source.exposure(row) for row in range(len(source.rows)))
    options = MeasureOptions(depths=DepthRange(margin=STILL_MARGIN))
    cloud = reconstruct([first], instrument.sensor, rights=others, options=options).cloud
    return succeeded(inspect_step(cloud, height_mm, normal=normal), source.name), normal


def inspect_part(scan: ScanReconstruction, truth: TwinTruth) -> MeasuredPart:
    """Points of the free-form part against the true surface; raises the same."""
    cloud = scan.cloud
    distance = truth.part_distance_mm(cloud.points_mm)
    rows = np.flatnonzero(np.abs(distance) <= PART_REACH_MM)
    if len(rows) == 0:
        raise EstimationError("no measured point lies on the part")
    sigma = _sigma_along(cloud, truth, rows)
    normalised = float(np.sqrt(np.mean((distance[rows] / sigma) ** 2)))
    return MeasuredPart(scan, rows, distance[rows], len(cloud) - len(rows), normalised)


def _sigma_along(cloud: PointCloud, truth: TwinTruth, rows: IntArray) -> FloatArray:
    normals = truth.part_normals(cloud.points_mm[rows])
    variance = np.einsum("ni,nij,nj->n", normals, cloud.covariance_mm2[rows], normals)
    return np.asarray(np.sqrt(variance))


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
