# SPDX-License-Identifier: Apache-2.0
"""A small camera and small targets for the tests of detection."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.models.camera import CameraModel
from armscan.records.exposure import Exposure, SensorWindow
from armscan.simulation.objects.boards import FlatPattern
from armscan.simulation.optics.camera import RenderCamera
from rigs.flat_prints import ChessboardPattern, Lighting, RenderedTarget, render_flat_target
from rigs.plain_scanner import plain_camera
from rigs.slow_renderer import add_noise

NOISE = 2.0
DISTORTION = (-0.1, 0.05, 1e-3, -5e-4, 0.0)


def camera(blur_sigma_px: float = 1.0, distorted: bool = False) -> RenderCamera:
    k = DISTORTION if distorted else (0.0,) * 5
    return RenderCamera(2000.0, 2000.0, 600.4, 449.7, *k, 1200, 900, blur_sigma_px)


def model(distorted: bool = False) -> CameraModel:
    k = DISTORTION if distorted else (0.0,) * 5
    return plain_camera(2000.0, (600.4, 449.7), (1200, 900), np.array(k))


def render(
    pattern: FlatPattern,
    distance_mm: float,
    *,
    tilt_deg: float = 0.0,
    azimuth_deg: float = 0.0,
    roll_deg: float = 0.0,
    render_camera: RenderCamera | None = None,
    lighting: Lighting | None = None,
) -> RenderedTarget:
    azimuth = np.deg2rad(azimuth_deg)
    axis = np.deg2rad(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    tilt = cv2.Rodrigues(axis)[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))[0]
    rotation = tilt @ roll
    x_min, y_min, x_max, y_max = pattern.extent_board_mm
    middle = np.array([0.5 * (x_min + x_max), 0.5 * (y_min + y_max), 0.0])
    translation = np.array([0.0, 0.0, distance_mm]) - rotation @ middle
    chosen = camera() if render_camera is None else render_camera
    return render_flat_target(chosen, pattern, rotation, translation, lighting)


def exposure(
    image: FloatArray, seed: int = 0, bits: int = 8, window: SensorWindow | None = None
) -> Exposure:
    noisy = add_noise(image, np.random.default_rng(seed), sigma=NOISE, bits=bits)
    place = SensorWindow() if window is None else window
    return Exposure(noisy, "rendered", bits_used=bits, window=place)


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised error squared, mean 2 for an honest covariance of two coordinates."""
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


@dataclass(frozen=True)
class BareChessboard:
    """Squares without a rim: where they end, the renderer's surround begins.

    Of the outermost squares ``shown`` is left.
    """

    columns: int
    rows: int
    square_mm: float
    shown: float = 1.0

    @property
    def squares(self) -> ChessboardPattern:
        return ChessboardPattern(self.columns, self.rows, self.square_mm)

    @property
    def marks_board_mm(self) -> FloatArray:
        return self.squares.marks_board_mm

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        s, cut = self.square_mm, self.shown
        return -cut * s, -cut * s, (self.columns - 1 + cut) * s, (self.rows - 1 + cut) * s

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        return self.squares.is_light(x_mm, y_mm)

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return self.squares.edge_distance_mm(x_mm, y_mm)


def line_distance(
    shape: tuple[int, int], through_px: FloatArray, azimuth_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Way (H, W) along and away from a line through a point."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    du, dv = u - through_px[0], v - through_px[1]
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    return c * du + s * dv, c * dv - s * du


def with_laser_line(
    image: FloatArray,
    through_px: FloatArray,
    azimuth_rad: float,
    sigma_px: float = 2.0,
    peak: float = 400.0,
) -> FloatArray:
    """The image with a line of light, clipped at 255: brighter where the print is light."""
    _, away = line_distance(image.shape, through_px, azimuth_rad)
    light = peak * (0.3 + 0.7 * image / 255.0) * np.exp(-0.5 * (away / sigma_px) ** 2)
    return np.clip(image + light, 0.0, 255.0)


def vignetted(image: FloatArray, remaining: float) -> FloatArray:
    """The image darkened towards its corners, where ``remaining`` of the light is left."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    height, width = image.shape
    away = (u / (width - 1) - 0.5) ** 2 + (v / (height - 1) - 0.5) ** 2
    return image * (1.0 - (1.0 - remaining) * 2.0 * away)
