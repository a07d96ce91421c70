# SPDX-License-Identifier: Apache-2.0
"""A camera on an arm before a flat target at rest; the images' points are OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.board_looks import BoardLook, board_poses
from armscan.calibration.sheets.board_points import BoardBow
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Board, Pose, Sensor, Tool
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.models.camera import CameraModel
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import TargetView, parse_target

WIDTH, HEIGHT = 1280, 960
TRUE_CAMERA = np.array([1200.0, 1205.0, 640.0, 490.0, -0.1, 0.05, 5e-4, -3e-4, 0.0])
CAMERA_SIGMA = np.array([1.0, 1.0, 1.0, 1.0, 2e-3, 1e-2, 1e-4, 1e-4, 0.0])
NOISE_PX = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class BoardRig:
    """Looks at a target, the camera's calibration, and what is true."""

    looks: tuple[BoardLook, ...]
    camera: CameraCalibration
    tool_from_sensor: Pose[Tool, Sensor]
    base_from_board: Pose[Base, Board]


def board_rig(
    seed: int,
    n: int = 12,
    *,
    target: str = "chessboard:9x6:25",
    arm_mm: float = 0.1,
    lever_mm: float = 150.0,
    scale: float = 1.0,
    turned: bool = False,
    one_axis: bool = False,
    images: int = 1,
    bow: BoardBow | None = None,
    true_bow_mm: tuple[float, float] = (0.0, 0.0),
) -> BoardRig:
    """Draw ``n`` postures with so many images each; ``scale`` is the true size over the stated.

    ``turned`` numbers every second view of a symmetric target from its other end; ``one_axis`` has
    the camera turn about its optical axis only. The target's bow is ``true_bow_mm``, and the views'
    poses are found with ``bow``.
    """
    generator = np.random.default_rng(seed)
    plate = parse_target(target)
    camera = _calibrated(generator)
    points = plate.points_board_mm
    true_points = scale * points
    true_points[:, 2] += arched(points) @ true_bow_mm
    hand_eye: Pose[Tool, Sensor] = Pose(
        Rotation.random(random_state=seed).as_matrix(), generator.uniform(-80, 80, 3)
    )
    board: Pose[Base, Board] = Pose(
        Rotation.random(random_state=seed + 1).as_matrix(), generator.uniform(-600, 600, 3)
    )
    looks: list[BoardLook] = []
    while len(looks) < n * images:
        seen = _seen_from(generator, scale * points.mean(axis=0), one_axis=one_axis)
        pixels = projected(seen, true_points)
        if pixels.min() < 10 or pixels[:, 0].max() > WIDTH - 10 or pixels[:, 1].max() > HEIGHT - 10:
            continue
        held = board @ seen.inverse() @ hand_eye.inverse()
        turn = Rotation.from_rotvec(generator.normal(0.0, arm_mm / lever_mm, 3)).as_matrix()
        told: Pose[Base, Tool] = Pose(
            turn @ held.rotation, held.translation_mm + generator.normal(0.0, arm_mm, 3)
        )
        taken: list[BoardLook] = []
        for _ in range(images):
            source = f"{len(looks) + len(taken)}.png"
            view = TargetView(
                source=source,
                width_px=WIDTH,
                height_px=HEIGHT,
                point_index=np.arange(len(points)),
                points_px=pixels + generator.normal(0.0, NOISE_PX, pixels.shape),
                covariance_px2=np.tile(NOISE_PX**2 * np.eye(2), (len(points), 1, 1)),
                points_board_mm=points,
            )
            if turned and len(looks) % 2:
                view = renumbered(view, plate, numberings(plate)[1])
            poses = board_poses(view, plate, camera.camera, bow)
            if not isinstance(poses, FitFailure):
                posture = source if images == 1 else f"p{len(looks) // images}"
                taken.append(BoardLook(posture, told, poses))
        looks += taken if len(taken) == images else []
    return BoardRig(tuple(looks), camera, hand_eye, board)


def arched(points_mm: FloatArray) -> FloatArray:
    """(N, 2) arches ``1 - u^2`` and ``1 - v^2``, where u and v go from -1 to 1 over the target."""
    low, high = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    return np.asarray(1.0 - ((2.0 * points_mm[:, :2] - low - high) / (high - low)) ** 2)


def projected(pose: Pose[Sensor, Board], points_mm: FloatArray) -> FloatArray:
    """(N, 2) pixels of points in Board, by OpenCV with the true camera."""
    fx, fy, cx, cy = TRUE_CAMERA[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    vector = Rotation.from_matrix(pose.rotation).as_rotvec()
    found, _ = cv2.projectPoints(points_mm, vector, pose.translation_mm, matrix, TRUE_CAMERA[4:])
    return np.asarray(found[:, 0], dtype=np.float64)


def misread(rig: BoardRig, row: int, shift_mm: float) -> BoardRig:
    """The rig with one pose of the arm off."""
    looks = list(rig.looks)
    pose = looks[row].base_from_tool
    step = np.array([0.0, 0.0, 0.0, shift_mm, 0.0, 0.0])
    looks[row] = replace(looks[row], base_from_tool=pose.retract(step))
    return replace(rig, looks=tuple(looks))


def _seen_from(
    generator: np.random.Generator, middle_mm: FloatArray, *, one_axis: bool
) -> Pose[Sensor, Board]:
    depth, turn = generator.uniform(350, 600), generator.uniform(-np.pi, np.pi)
    tilt = 0.3 if one_axis else np.radians(generator.uniform(5, 40))
    azimuth = 0.0 if one_axis else generator.uniform(0, 2 * np.pi)
    axis = tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    spin, lean = Rotation.from_rotvec([0.0, 0.0, turn]), Rotation.from_rotvec(axis)
    rotation = (spin * lean if one_axis else lean * spin).as_matrix()
    place = depth * np.array([generator.uniform(-0.15, 0.15), generator.uniform(-0.1, 0.1), 1.0])
    return Pose(rotation, place - rotation @ middle_mm)


def _calibrated(generator: np.random.Generator) -> CameraCalibration:
    drawn = TRUE_CAMERA + CAMERA_SIGMA * generator.normal(size=9)
    fx, fy, cx, cy = drawn[:4]
    return CameraCalibration(
        camera=CameraModel(
            width_px=WIDTH, height_px=HEIGHT, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy,
            distortion=drawn[4:],
        ),
        covariance=np.diag(CAMERA_SIGMA**2),
        has_covariance=True,
        rms_px=0.14,
        sigma_point_px=NOISE_PX,
        n_views=12,
        n_points=600,
        covered_px=np.array([0.0, 0.0, WIDTH, HEIGHT]),
        provenance=Provenance("rig", "2026-01-01T00:00:00Z", "0", (), ()),
    )  # fmt: skip
