# SPDX-License-Identifier: Apache-2.0
"""A small bench for the commands: a pinhole camera, a chessboard and one laser sheet, drawn here.

Nothing of the package is used to draw, so that the commands are tested against known truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 480, 360, 600.0
COLUMNS, ROWS, SQUARE_MM = 8, 6, 6.0
TARGET = f"chessboard:{COLUMNS}x{ROWS}:{SQUARE_MM:g}"
SHEET = np.array([0.92, 0.03, 0.39])
SHEET = SHEET / np.linalg.norm(SHEET)
SHEET_D_MM = -float(SHEET @ [0.0, 0.0, 150.0])
OVERSAMPLING = 3
CAMERA_TILTS = ((0, 0), (28, 5), (-28, -5), (5, 30), (-5, -30), (22, 22), (-22, 20))
LASER_PLACES = ((10, -10, 135.0), (-22, 18, 150.0), (25, 20, 165.0))
OBJECT_PLACE = (15, 25, 150.0)


@dataclass(frozen=True)
class Bench:
    """Folders of drawn images, and the documents that the commands wrote from them."""

    folder: Path

    @property
    def camera_images(self) -> str:
        return f"{self.folder}/camera/*.png"

    @property
    def on(self) -> str:
        return f"{self.folder}/on/*.png"

    @property
    def off(self) -> str:
        return f"{self.folder}/off/*.png"

    @property
    def camera(self) -> Path:
        return self.folder / "camera.json"

    @property
    def sensor(self) -> Path:
        return self.folder / "sensor.json"


def draw(
    tilt_x_deg: float, tilt_y_deg: float, z_mm: float, *, has_laser: bool, is_plain: bool = False
) -> np.ndarray:
    """Chessboard (or plain board) at a tilt, its middle on the optical axis, as 8-bit grey."""
    rotation = cv2.Rodrigues(np.array([0.0, np.deg2rad(tilt_y_deg), 0.0]))[0]
    rotation = rotation @ cv2.Rodrigues(np.array([np.deg2rad(tilt_x_deg), 0.0, 0.0]))[0]
    step = np.arange(OVERSAMPLING * np.array([WIDTH, HEIGHT]).max()) + 0.5
    u = step[: OVERSAMPLING * WIDTH] / OVERSAMPLING - 0.5
    v = step[: OVERSAMPLING * HEIGHT] / OVERSAMPLING - 0.5
    x, y = np.meshgrid((u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    depth = z_mm * rotation[2, 2] / (rays @ rotation[:, 2])
    points = rays * depth[..., None]
    board = (points - [0.0, 0.0, z_mm]) @ rotation
    i = board[..., 0] / SQUARE_MM + (COLUMNS - 1) / 2
    j = board[..., 1] / SQUARE_MM + (ROWS - 1) / 2
    is_on_squares = (i > -1) & (i < COLUMNS) & (j > -1) & (j < ROWS)
    is_dark = is_on_squares & ((np.floor(i) + np.floor(j)) % 2 == 0) & (not is_plain)
    reflectance = np.where(is_dark, 0.25, 1.0)
    light = 130.0 * reflectance
    if has_laser:
        height = points @ SHEET + SHEET_D_MM
        light = 0.35 * light + 150.0 * reflectance * np.exp(-0.5 * (height / 0.4) ** 2)
    image = light.reshape(HEIGHT, OVERSAMPLING, WIDTH, OVERSAMPLING).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    noise = np.random.default_rng(int(1000 + 7 * tilt_x_deg + tilt_y_deg)).normal(size=image.shape)
    return np.clip(image + 1.0 * noise + 5.0, 0, 255).astype(np.uint8)
