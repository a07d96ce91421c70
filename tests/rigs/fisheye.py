# SPDX-License-Identifier: Apache-2.0
"""Cameras of a fisheye lens that see what those of a pinhole see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel

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
