# SPDX-License-Identifier: Apache-2.0
"""Eight passes over a ball by a moving head, made from sections of a sphere by a plane alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.fusion.point_spool import PointSpool
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.scan_doubts import ScanDoubt, doubt_scan
from armscan.reconstruction.sync import ExposurePoses
from armscan.reconstruction.triangulate import intersect_sheets
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from rigs.scan_fake import CAMERA, TOOL_FROM_SENSOR, scanner

CENTRE_MM, RADIUS_MM = np.array([600.0, -150.0, 200.0]), 17.5
N_PASSES, N_STEPS, STEP_MM = 6, 12, 2.2
SAMPLE_NS, SAMPLES_A_STEP, PAUSE_NS = 4_000_000, 10, 1_000_000_000
NOISE_PX, NOISE_MM = 0.05, 0.02
ASIDE_MM = 4.0
"""Of the ball beside the image's middle, where a mirrored image of it would look the same."""


def head_at(turn_rad: float, lean_rad: float, along_mm: float) -> Pose[Base, Tool]:
    """The tool with its sheet ``along_mm`` beside the ball, whose top is in sharp view."""
    down: Pose[Base, Sensor] = Pose.from_vectors([np.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    lean: Pose[Base, Base] = Pose.from_vectors([lean_rad, 0.0, 0.0], [0.0, 0.0, 0.0])
    turn: Pose[Base, Base] = Pose.from_vectors([0.0, 0.0, turn_rad], [0.0, 0.0, 0.0])
    rotation = turn.rotation @ lean.rotation @ down.rotation
    sheet = scanner().sensor.sheets[0].sheet  # type: ignore[union-attr]
    depth = sheet.intersect(np.zeros((1, 2)))[0][0]
    place = (
        CENTRE_MM + rotation @ np.array([ASIDE_MM, along_mm, -0.6 * RADIUS_MM]) - rotation @ depth
    )
    base_from_sensor: Pose[Base, Sensor] = Pose(rotation, place)
    return base_from_sensor @ TOOL_FROM_SENSOR.inverse()


@dataclass(frozen=True)
class BallScan:
    """The recording as it is read; ``truth`` are the poses at which the stripes were taken."""

    rows: tuple[ExposureRow, ...]
    arm: ArmTrack | None
    truth: tuple[Pose[Base, Tool], ...]
    session: Session = field(
        default_factory=lambda: Session(
            cameras=(CameraSetup(width_px=CAMERA.width_px, height_px=CAMERA.height_px),)
        )
    )
    name: str = "ball"
    is_simulated: bool = True

    def exposure(self, row: int) -> Exposure:
        """Nothing here needs a picture."""
        raise NotImplementedError


def ball_scan() -> BallScan:
    """Passes that cross under four directions, leaning four ways, at 50 mm/s."""
    times: list[int] = []
    tool: list[Pose[Base, Tool]] = []
    rows: list[ExposureRow] = []
    truth: list[Pose[Base, Tool]] = []
    start = 1_000_000_000
    for number in range(N_PASSES):
        turn, lean = 0.25 * np.pi * (3 * number % 8), 0.2 * (-1.0) ** number + 0.03 * number
        middle = 0.5 * (N_STEPS - 1) * SAMPLES_A_STEP
        for sample in range((N_STEPS - 1) * SAMPLES_A_STEP + 60):
            along = (sample - 30 - middle) * STEP_MM / SAMPLES_A_STEP
            times.append(start + sample * SAMPLE_NS)
            tool.append(head_at(turn, lean, along))
            step, rest = divmod(sample - 30, SAMPLES_A_STEP)
            if rest == 0 and 0 <= step < N_STEPS:
                rows.append(
                    ExposureRow(
                        index=len(rows),
                        t_ns=times[-1],
                        camera=0,
                        source=f"{len(rows)}.png",
                        lasers=("A",),
                    )
                )
                truth.append(tool[-1])
        start = times[-1] + PAUSE_NS
    track = ArmTrack(
        t_ns=np.array(times, dtype=np.int64),
        rotations=np.array([pose.rotation for pose in tool]),
        translations_mm=np.array([pose.translation_mm for pose in tool]),
        is_known=np.ones(len(times), dtype=bool),
    )
    return BallScan(tuple(rows), track, tuple(truth))


def section_px(base_from_tool: Pose[Base, Tool], rng: np.random.Generator) -> FloatArray:
    """(N, 2) pixels of the ball's section by the true sheet, on the side of the camera."""
    head = scanner()
    assert head.sensor is not None
    base_from_sensor = base_from_tool @ head.hand_eye.tool_from_sensor
    centre = base_from_sensor.rotation.T @ (CENTRE_MM - base_from_sensor.translation_mm)
    sheet = head.sensor.sheets[0].sheet
    u, v, normal = sheet.axes
    height = float(normal @ (centre - sheet.origin_mm))
    radius = np.sqrt(max(RADIUS_MM**2 - height**2, 0.0))
    angle = np.arange(0.0, 2.0 * np.pi, 0.025)
    round_mm = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    points = centre - height * normal + radius * round_mm
    outward = (points - centre) / RADIUS_MM
    facing = -np.einsum("ni,ni->n", outward, points) / np.linalg.norm(points, axis=1)
    pixels = CAMERA.project(points[facing > 0.4])
    pixels = pixels[CAMERA.is_inside(pixels)]
    return np.asarray(pixels + NOISE_PX * rng.standard_normal(pixels.shape))


def doubt(
    scan: BallScan,
    read: ExposurePoses | None = None,
    head: ScannerCalibration | None = None,
    *,
    mirrored: bool = False,
    n_cameras: int = 1,
) -> ScanDoubt:
    """What the passes say when stripes of ``scan.truth`` are placed by the poses ``read``.

    With two cameras each sees every other point of a stripe, and both have one pose.
    """
    rng = np.random.default_rng(1)
    head = head or scanner()
    assert head.sensor is not None
    poses = read_as(scan.truth) if read is None else read
    points = PointSpool("Base", ("A",))
    rows = []
    for row, true_pose in enumerate(scan.truth):
        pixels = section_px(true_pose, rng)
        if mirrored:
            pixels[:, 0] = CAMERA.width_px - 1 - pixels[:, 0]
        for camera in range(n_cameras):
            own = pixels[camera::n_cameras]
            found, is_met = intersect_sheets(own, np.zeros(len(own), dtype=np.int64), head.sensor)
            rows.append(row)
            pose = poses.pose(row) @ head.hand_eye.tool_from_sensor
            placed = found[is_met] @ pose.rotation.T + pose.translation_mm
            points.add(_cloud(placed, scan.rows[row].source), own[is_met], instant=row)
    return doubt_scan(scan, head, poses, points=points, pose_rows=rows)


def read_as(poses: tuple[Pose[Base, Tool], ...]) -> ExposurePoses:
    """Poses of the exposures as somebody's file told them."""
    return poses_of(
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation_mm for pose in poses]),
    )


def poses_of(rotations: FloatArray, translations_mm: FloatArray) -> ExposurePoses:
    """All found."""
    n = len(rotations)
    zeros = np.zeros(n, dtype=np.int64)
    return ExposurePoses(
        rotations=rotations,
        translations_mm=translations_mm,
        status=zeros,
        sample=np.arange(n),
        source="trigger",
    )


def _cloud(points_mm: FloatArray, source: str) -> PointCloud:
    n = len(points_mm)
    zeros: IntArray = np.zeros(n, dtype=np.int64)
    covariance = np.broadcast_to(NOISE_MM**2 * np.eye(3), (n, 3, 3))
    return PointCloud(
        frame="Base",
        points_mm=points_mm,
        covariance_mm2=covariance,
        sigma_noise_mm=np.full(n, NOISE_MM),
        sheet=zeros,
        sheet_names=("A",),
        exposure=zeros,
        exposure_sources=(source,),
        segment=zeros,
        intensity=np.full(n, 150.0),
    )
