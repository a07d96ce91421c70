# SPDX-License-Identifier: Apache-2.0
"""A printed board in a scene: a rectangle whose albedo follows its print."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.flat_pattern import FlatPattern
from armscan.simulation.surfaces import MISS


@dataclass(frozen=True, slots=True, eq=False)
class PrintedBoard:
    """A flat print somewhere in the scene, seen from its front only.

    Parameters
    ----------
    pattern
        The print.
    sensor_from_board
        Where it is; its z axis points away from the camera.
    light, dark
        Albedo of the two tones, for every colour.
    edge_mm
        Width over which a sample averages the two tones: about the size of a sample's footprint.
    """

    pattern: FlatPattern
    sensor_from_board: Pose[Sensor, Board]
    light: float = 0.85
    dark: float = 0.08
    edge_mm: float = 0.1

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        normal = -self.sensor_from_board.rotation[:, 2]
        along = directions @ normal
        height = (origins_mm - self.sensor_from_board.translation_mm) @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where((along < 0.0) & (height > 0.0), -height / along, np.nan)
        points = origins_mm + distance[:, None] * directions
        return np.where(self._is_on_print(self._on_board(points)), distance, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(-self.sensor_from_board.rotation[:, 2], points_mm.shape)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        board = self._on_board(points_mm)
        x, y = board[:, 0], board[:, 1]
        side = np.where(self.pattern.is_light(x, y), 1.0, -1.0)
        signed = side * self.pattern.edge_distance_mm(x, y)
        share = np.clip(0.5 + signed / self.edge_mm, 0.0, 1.0)
        albedo = self.dark + (self.light - self.dark) * share
        return np.repeat(albedo[:, None], 3, axis=1)

    def _on_board(self, points_mm: FloatArray) -> FloatArray:
        pose = self.sensor_from_board
        return np.asarray((points_mm - pose.translation_mm) @ pose.rotation)

    def _is_on_print(self, board_mm: FloatArray) -> BoolArray:
        x_min, y_min, x_max, y_max = self.pattern.extent_board_mm
        x, y = board_mm[:, 0], board_mm[:, 1]
        return np.asarray((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max))
