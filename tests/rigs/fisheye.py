# SPDX-License-Identifier: Apache-2.0
"""Fisheye lenses: those that see what a pinhole sees, and views through OpenCV's."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import Target, TargetView
from rigs.camera_scene import Scene, board_pose
from rigs.plain_scanner import plain_camera

TANGENTIAL = [6, 7]


def as_fisheye(camera: CameraModel) -> CameraModel:
    """The same radial distortion told of the angle: the series of the tangent put into it."""
    k1, k2, _, _, k3 = camera.distortion
    terms = [
        1.0 / 3.0 + k1,
        2.0 / 15.0 + k1 + k2,
        17.0 / 315.0 + 11.0 / 15.0 * k1 + 5.0 / 3.0 * k2 + k3,
    ]
    distortion = np.array([terms[0], terms[1], 0.0, 0.0, terms[2]])
    return replace(camera, distortion=distortion, lens="fisheye")


def fisheye_sensor(sensor: SensorCalibration) -> SensorCalibration:
    """A sensor whose cameras are fisheyes, which have no tangential distortion to err in."""
    covariance = sensor.covariance.copy()
    held = [k for k, name in enumerate(sensor.parameter_names) if name.split(".")[-1] in "p1p2"]
    covariance[held] = covariance[:, held] = 0.0
    of_left = covariance[:9, :9]
    left = replace(sensor.camera, camera=as_fisheye(sensor.camera.camera), covariance=of_left)
    second = sensor.second
    if second is not None:
        there = second.camera.covariance.copy()
        there[TANGENTIAL] = there[:, TANGENTIAL] = 0.0
        own = replace(second.camera, camera=as_fisheye(second.camera.camera), covariance=there)
        second = replace(second, camera=own)
    return replace(sensor, camera=left, second=second, covariance=covariance)


MARGIN_PX = 2.0
NEAREST_COSINE = 0.1
"""Points farther than 84 degrees from the axis are not seen."""


def see_through_fisheye(truth: FloatArray, target: Target, pose: Pose[Sensor, Board]) -> FloatArray:
    """(M, 2) pixels of a target by `cv2.fisheye`; NaN for points beside the lens."""
    fx, fy, cx, cy, k1, k2, _, _, k3 = truth
    points = target.points_board_mm @ pose.rotation.T + pose.translation_mm
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    none, terms = np.zeros(3), np.array([k1, k2, k3, 0.0])
    seen, _ = cv2.fisheye.projectPoints(points[:, None], none, none, matrix, terms)
    is_before = points[:, 2] > NEAREST_COSINE * np.linalg.norm(points, axis=1)
    return np.where(is_before[:, None], seen[:, 0], np.nan)


def fisheye_views(
    truth: FloatArray,
    size_px: tuple[int, int],
    target: Target,
    *,
    n_views: int,
    noise_px: float,
    seed: int,
) -> list[TargetView]:
    """Views of a target before a fisheye of (9,) parameters, at least 0.7 of it in each.

    The board is held near: its length is seen under some 75 degrees.
    """
    rng, size = np.random.default_rng(seed), np.array(size_px)
    like = plain_camera((float(truth[0]),) * 2, tuple(0.5 * size - 0.5), size_px, [0.0] * 5)
    near_mm = 0.65 * float(np.ptp(target.points_board_mm[:, 0]))
    scene = Scene(like, target, distance_mm=near_mm, reach=0.45)
    views: list[TargetView] = []
    while len(views) < n_views:
        seen = see_through_fisheye(truth, target, board_pose(scene, rng))
        is_inside = np.all((seen > MARGIN_PX) & (seen < size - 1 - MARGIN_PX), axis=1)
        inside = np.flatnonzero(is_inside)
        if len(inside) < 0.7 * len(seen):
            continue
        views.append(
            TargetView(
                source=f"view{len(views):02d}.png",
                width_px=size_px[0],
                height_px=size_px[1],
                point_index=inside,
                points_px=seen[inside] + noise_px * rng.normal(size=(len(inside), 2)),
                covariance_px2=np.tile(noise_px**2 * np.eye(2), (len(inside), 1, 1)),
                points_board_mm=target.points_board_mm[inside],
            )
        )
    return views
