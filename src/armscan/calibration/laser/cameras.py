# SPDX-License-Identifier: Apache-2.0
"""The camera, or the two cameras, through which boards and stripes are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import CameraCalibration, SecondCamera
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.models.stereo import StereoCalibration

N_CAMERA = len(PARAMETER_NAMES)


@dataclass(frozen=True, slots=True, eq=False)
class HeadCameras:
    """Camera 0, whose frame is Sensor, and camera 1 of a stereo head.

    Parameters
    ----------
    left
        Camera 0.
    second
        Camera 1, if there is one.
    covariance
        (P, P) of the P parameters that all images have in common: 9, or 24 in the order of
        `armscan.models.stereo.STEREO_PARAMETER_NAMES`.
    """

    left: CameraCalibration
    second: SecondCamera | None
    covariance: FloatArray

    @staticmethod
    def of(calibration: CameraCalibration | StereoCalibration) -> HeadCameras:
        """The cameras of a calibration of one or of two."""
        if isinstance(calibration, CameraCalibration):
            return HeadCameras(calibration, None, calibration.covariance)
        second = SecondCamera(calibration.right, calibration.right_from_left)
        return HeadCameras(calibration.left, second, calibration.covariance)

    @property
    def n_parameters(self) -> int:
        """Count P of the cameras' parameters."""
        return len(self.covariance)

    @property
    def has_covariance(self) -> bool:
        """False if a camera came without uncertainty."""
        return self.left.has_covariance and (
            self.second is None or self.second.camera.has_covariance
        )

    def model(self, camera: int) -> CameraModel:
        """The model of camera 0 or 1.

        Raises
        ------
        InputError
            If there is no such camera.
        """
        if camera == 0:
            return self.left.camera
        return self._right(camera).camera.camera

    def centre_mm(self, camera: int) -> FloatArray:
        """(3,) where the rays of camera 0 or 1 start, in Sensor."""
        if camera == 0:
            return np.zeros(3)
        place = self._right(camera).right_from_sensor
        return np.asarray(-place.translation_mm @ place.rotation)

    def right(self) -> SecondCamera:
        """Camera 1.

        Raises
        ------
        InputError
            If there is none.
        """
        return self._right(1)

    def _right(self, camera: int) -> SecondCamera:
        if self.second is None or camera != 1:
            raise InputError(
                f"an image of camera {camera} is given, and that camera is not calibrated",
                remedy="give the stereo calibration of the head, or the images of camera 0 alone",
            )
        return self.second

    def by_parameters(self, by_left: FloatArray) -> FloatArray:
        """Derivatives (..., 9) by camera 0's parameters as derivatives (..., P) by all."""
        wide = np.zeros((*by_left.shape[:-1], self.n_parameters))
        wide[..., :N_CAMERA] = by_left
        return wide
