# SPDX-License-Identifier: Apache-2.0
"""One image as the camera delivered it, and the part of the sensor that it shows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, ImageArray


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
    is_stated
        False where nobody said where the image lies: then it must be the whole sensor.
    """

    x_px: int = 0
    y_px: int = 0
    binning: int = 1
    is_stated: bool = field(default=True, compare=False)

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


def unstated_window() -> SensorWindow:
    """That of an image of which nobody said where it lies on the sensor."""
    return SensorWindow(is_stated=False)


def window_of_sensor(
    window: SensorWindow, size_px: tuple[int, int], sensor_px: tuple[int, int]
) -> SensorWindow:
    """A window that somebody asked for, stated as one only where it is less than the sensor.

    So an image of a whole sensor is still told from one of a larger sensor's corner.
    """
    is_whole = size_px == sensor_px and window.binning == 1
    return unstated_window() if is_whole else window


ColourLayout = Literal["mono", "rgb"]
COARSE_STEP_PX = 16
"""Of the pixels that are compared first: a colour photograph differs there already."""


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """An image with what is needed to read it; pixels are raw, never rescaled.

    Parameters
    ----------
    image
        (H, W) for mono or (H, W, 3) in the order red, green, blue; uint8 or uint16.
    source
        Where it came from, usually the file name: shown in messages and reports.
    bits_used
        Significant bits, low aligned: full scale is ``2**bits_used - 1``.
    window
        The part of the full sensor that the image shows.
    t_ns
        Mid-exposure time, or None if unknown.
    camera
        Number of the camera, counted from 0.
    trigger_id
        Number that the arm's sample of the same trigger bears too, or None.
    view
        Exposures of equal view saw one rigid arrangement; None stands for a view of its own.
    sensor_px
        Width and height of the full sensor where they are known; None where the image ends there.
    """

    image: ImageArray
    source: str
    bits_used: int = 8
    window: SensorWindow = field(default_factory=unstated_window)
    lasers: tuple[str, ...] = ()
    t_ns: int | None = None
    camera: int = 0
    trigger_id: int | None = None
    view: str | None = None
    sensor_px: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        image = np.ascontiguousarray(self.image)
        if image.dtype not in (np.uint8, np.uint16):
            raise InputError(
                f"image has type {image.dtype}", where=self.source, remedy="give uint8 or uint16"
            )
        if image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
            raise InputError(
                f"image has shape {image.shape}",
                where=self.source,
                remedy="give (rows, columns) or (rows, columns, 3)",
            )
        if not 1 <= self.bits_used <= 8 * image.dtype.itemsize:
            raise InputError(
                f"{self.bits_used} bits cannot be stored in {image.dtype}", where=self.source
            )
        image.setflags(write=False)
        object.__setattr__(self, "image", image)

    @property
    def colour(self) -> ColourLayout:
        """Layout of the channels."""
        return "mono" if self.image.ndim == 2 else "rgb"

    @property
    def is_colourless(self) -> bool:
        """True where red, green and blue are alike in each pixel: grey, however it is stored."""
        if self.image.ndim == 2:
            return True
        red, *others = np.moveaxis(self.image, 2, 0)
        return all(
            np.array_equal(red[::step, ::step], other[::step, ::step])
            for step in (COARSE_STEP_PX, 1)
            for other in others
        )

    def as_mono(self) -> Exposure:
        """The same of its red channel alone; of a colourless image nothing is lost."""
        return self if self.image.ndim == 2 else replace(self, image=self.image[:, :, 0])

    @property
    def height_px(self) -> int:
        """Rows of the image."""
        return int(self.image.shape[0])

    @property
    def width_px(self) -> int:
        """Columns of the image."""
        return int(self.image.shape[1])

    def cropped(self, left: int, top: int, right: int, bottom: int) -> Exposure:
        """Columns ``left`` to ``right`` and rows ``top`` to ``bottom``, ends excluded."""
        step = self.window.binning
        window = SensorWindow(self.window.x_px + left * step, self.window.y_px + top * step, step)
        return replace(self, image=self.image[top:bottom, left:right], window=window)

    @property
    def full_scale(self) -> int:
        """Grey level at which a pixel is saturated."""
        return (1 << self.bits_used) - 1
