# SPDX-License-Identifier: Apache-2.0
"""The simulator's own lens: it shares no code with the model that calibration estimates.

Pixel (0, 0) is the centre of the top-left pixel. The distortion is that of eqs. 2.16 and 2.17,
written as a gain along the radius plus a tangential shift; it is inverted by damped fixed-point
steps instead of Newton's method, so that a slip in one of the two formulas shows in the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, ImageArray

Float = TypeVar("Float", np.float32, np.float64)

_MAX_STEPS = 400
STEP_TOLERANCE = 1e-13
_KERNEL_SIGMAS = 6.0


@dataclass(frozen=True, slots=True)
class RenderCamera:
    """A camera to render with.

    Parameters
    ----------
    fx, fy, cx, cy
        Focal lengths and principal point, px.
    k1, k2, p1, p2, k3
        Distortion of eq. 2.16.
    width_px, height_px
        Size of the full sensor.
    blur_sigma_px
        Standard deviation of the lens's Gaussian point spread; the pixel's own square aperture
        comes on top of it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    width_px: int = 3072
    height_px: int = 2048
    blur_sigma_px: float = 1.0

    def __post_init__(self) -> None:
        if min(self.fx, self.fy) <= 0.0 or min(self.width_px, self.height_px) < 1:
            raise InputError("a camera to render with needs a positive focal length and size")
        if self.blur_sigma_px < 0.0:
            raise InputError(f"blur of {self.blur_sigma_px} px is negative")

    def project(self, points_camera_mm: FloatArray) -> FloatArray:
        """Project (..., 3) points in the camera's frame, mm, to (..., 2) pixels.

        A point at or behind the camera gives NaN.
        """
        points = np.asarray(points_camera_mm, dtype=np.float64)
        depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        x, y = points[..., 0] / depth, points[..., 1] / depth
        gain, shift_x, shift_y = self._gain_and_shift(x, y)
        u = self.cx + self.fx * (gain * x + shift_x)
        v = self.cy + self.fy * (gain * y + shift_y)
        return np.stack([u, v], axis=-1)

    def cropped(self, x_px: int, y_px: int, width_px: int, height_px: int) -> RenderCamera:
        """Camera that delivers only the rectangle whose top-left pixel is given."""
        return replace(
            self, cx=self.cx - x_px, cy=self.cy - y_px, width_px=width_px, height_px=height_px
        )

    def rays(self, pixels_px: FloatArray, tolerance: float = STEP_TOLERANCE) -> FloatArray:
        """Return the ideal coordinates ``X/Z, Y/Z`` (..., 2) seen by (..., 2) pixels.

        Parameters
        ----------
        pixels_px
            (..., 2) pixels.
        tolerance
            Size of the step after which the search ends; what is left is smaller by far.

        Raises
        ------
        InputError
            If the fixed-point steps do not settle: the distortion folds over inside the image.
        """
        pixels = np.asarray(pixels_px, dtype=np.float64)
        seen_x = (pixels[..., 0] - self.cx) / self.fx
        seen_y = (pixels[..., 1] - self.cy) / self.fy
        x, y = seen_x, seen_y
        for _ in range(_MAX_STEPS):
            gain, shift_x, shift_y = self._gain_and_shift(x, y)
            new_x, new_y = (seen_x - shift_x) / gain, (seen_y - shift_y) / gain
            step = max(_largest(new_x - x), _largest(new_y - y))
            x, y = new_x, new_y
            if step < tolerance:
                return np.stack([x, y], axis=-1)
        raise InputError(
            "the rendered camera's distortion cannot be inverted over its image",
            remedy="use smaller distortion coefficients or a smaller sensor",
        )

    def _gain_and_shift(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        square = x**2 + y**2
        gain = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        lever = 2.0 * (self.p1 * y + self.p2 * x)
        return gain, x * lever + self.p2 * square, y * lever + self.p1 * square


def blur_image(image: NDArray[Float], sigma_px: float) -> NDArray[Float]:
    """Convolve a (H, W) or (H, W, 3) image with a Gaussian of ``sigma_px``, repeating borders."""
    if sigma_px <= 0.0:
        return image
    reach = int(np.ceil(_KERNEL_SIGMAS * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    kernel /= kernel.sum()
    blurred = cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=image.dtype)


def add_noise(
    image: FloatArray,
    rng: np.random.Generator,
    *,
    sigma: float = 2.0,
    electrons_per_level: float | None = None,
    bits: int = 8,
) -> ImageArray:
    """Turn a rendered image into what a camera delivers.

    Parameters
    ----------
    image
        Grey levels of an 8-bit image, whatever ``bits`` is: 255 is full scale.
    rng
        Source of the noise.
    sigma
        Read noise, in 8-bit grey levels.
    electrons_per_level
        Electrons per 8-bit grey level, for shot noise; None for none.
    bits
        Significant bits of the result, low aligned: uint8 up to 8 bits, else uint16.

    Returns
    -------
    Rounded and clipped image.
    """
    if not 1 <= bits <= 16:
        raise InputError(f"{bits} bits do not fit into 16")
    variance = np.full(image.shape, sigma**2)
    if electrons_per_level is not None:
        variance += np.maximum(image, 0.0) / electrons_per_level
    noisy = image + np.sqrt(variance) * rng.standard_normal(image.shape)
    full_scale = (1 << bits) - 1
    levels: FloatArray = np.clip(np.rint(noisy * (full_scale / 255.0)), 0, full_scale)
    return levels.astype(np.uint8) if bits <= 8 else levels.astype(np.uint16)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))
