# SPDX-License-Identifier: Apache-2.0
"""The simulated camera: projection with distortion, defocus blur, the detector's response and
its noise.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.simulation.kernels import expose

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

    @property
    def numbers(self) -> FloatArray:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3."""
        return np.array(astuple(self)[:9])

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

        ``tolerance``: size of the step after which the search ends; what is left is smaller by far.
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
    kernel = blur_kernel(sigma_px)
    blurred = cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=image.dtype)


def blur_kernel(sigma_px: float) -> FloatArray:
    """(2 R + 1,) weights of a Gaussian of ``sigma_px`` along a line; a single 1 without blur."""
    if sigma_px <= 0.0:
        return np.ones(1)
    reach = int(np.ceil(_KERNEL_SIGMAS * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return np.asarray(kernel / kernel.sum())


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class Detector:
    """Sensor and amplifier of a mono camera.

    Parameters
    ----------
    bits
        Significant bits; more than 8 are stored in 16.
    electrons_per_level
        Electrons per level of an 8-bit image: sets the shot noise.
    read_noise
        Noise that does not depend on the light, in levels of an 8-bit image.
    halo_share, halo_sigma_px
        Part of strong light that the lens and the cover glass scatter, and how far.
    """

    bits: int = 8
    electrons_per_level: float = 60.0
    read_noise: float = 0.8
    halo_share: float = 0.05
    halo_sigma_px: float = 8.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.halo_share < 1.0 or not self.electrons_per_level > 0.0:
            raise InputError("a detector scatters a part of the light and counts electrons")


Image32 = NDArray[np.float32]

_HALO_CELL_PX = 4


def with_halo(light: Image32, share: float, sigma_px: float) -> Image32:
    """Move a share of light (H, W) into a wide halo; the sum is kept up to the border."""
    if share == 0.0:
        return light
    return np.asarray(cv2.addWeighted(light, 1.0 - share, _wide(light, sigma_px), share, 0.0))


def halo_rows(lit: slice, height: int, sigma_px: float) -> slice:
    """Rows of an image that the halo of lit rows reaches; `with_halo` needs no others.

    They hold whole cells of the halo's grid, or are all.
    """
    if lit.start >= lit.stop or height % _HALO_CELL_PX:
        return slice(0, height)
    cells = len(blur_kernel(sigma_px / _HALO_CELL_PX)) // 2 + 2
    top, stop = lit.start // _HALO_CELL_PX - cells, -(-lit.stop // _HALO_CELL_PX) + cells
    return slice(max(_HALO_CELL_PX * top, 0), min(_HALO_CELL_PX * stop, height))


def with_ghost(light: Image32, share: float, sigma_px: float) -> Image32:
    """Add a share of light (H, W) mirrored at the image's centre and blurred."""
    if share == 0.0:
        return light
    mirrored = np.ascontiguousarray(light[::-1, ::-1])
    return np.asarray(cv2.addWeighted(light, 1.0, _wide(mirrored, sigma_px), share, 0.0))


def expose_mono(light: Image32, detector: Detector, rng: np.random.Generator) -> ImageArray:
    """Grey levels of light (H, W), parts of full scale: shot and read noise, clipping, bits."""
    if not 1 <= detector.bits <= 16:
        raise InputError(f"{detector.bits} bits do not fit into 16")
    levels, full_scale = rng.standard_normal(light.shape, np.float32), (1 << detector.bits) - 1
    shone = np.ascontiguousarray(light, dtype=np.float32)
    expose(shone, levels, 1.0 / detector.electrons_per_level, detector.read_noise**2, full_scale)
    return levels.astype(np.uint8) if detector.bits <= 8 else levels.astype(np.uint16)


def _wide(light: Image32, sigma_px: float) -> Image32:
    """Wide blur on a coarser grid."""
    height, width = light.shape
    size = (-(-width // _HALO_CELL_PX), -(-height // _HALO_CELL_PX))
    coarse = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    blurred = blur_image(np.asarray(coarse, dtype=np.float32), sigma_px / _HALO_CELL_PX)
    return np.asarray(
        cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32
    )
