# SPDX-License-Identifier: Apache-2.0
"""The part of the sensor that an image shows."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class SensorWindow:
    """Region of interest and binning of an image on the full sensor.

    Pixel (0, 0) is the CENTRE of the top-left pixel of the full sensor; intrinsics are always
    those of the full sensor, and pixel coordinates leave the vision package in full-sensor pixels.

    Parameters
    ----------
    x_px, y_px
        Top-left corner pixel of the window on the full sensor (unbinned pixels).
    binning
        Sensor pixels per image pixel along each axis.
    """

    x_px: int = 0
    y_px: int = 0
    binning: int = 1

    def __post_init__(self) -> None:
        if self.x_px < 0 or self.y_px < 0 or self.binning < 1:
            raise InputError(
                f"sensor window ({self.x_px}, {self.y_px}) with binning {self.binning} is not on "
                "the sensor",
                remedy="give a corner >= 0 and a binning >= 1",
            )

    def to_full_sensor(self, image_px: FloatArray) -> FloatArray:
        """Map (..., 2) image pixels to full-sensor pixels."""
        centre = 0.5 * (self.binning - 1)
        return image_px * self.binning + centre + [self.x_px, self.y_px]

    def to_image(self, full_sensor_px: FloatArray) -> FloatArray:
        """Map (..., 2) full-sensor pixels to image pixels."""
        centre = 0.5 * (self.binning - 1)
        return (full_sensor_px - [self.x_px, self.y_px] - centre) / self.binning
