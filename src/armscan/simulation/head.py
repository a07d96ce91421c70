# SPDX-License-Identifier: Apache-2.0
"""Scanner heads: cameras, line lasers and mounting, drawn around the thesis's printed numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from armscan.devices.twin import Preset
from armscan.errors import InputError
from armscan.geometry.frames import CameraRight, Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.simulation.head_drawing import Tolerances, draw_camera, draw_lasers, draw_mounting
from armscan.simulation.imaging import IMAGING, Imaging
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera
from armscan.simulation.printed_heads import printed_heads

HEADS = ("thesis-single", "thesis-cross", "thesis-multi", "thesis-multi-5")

LEFT, RIGHT = 0, 1
"""Indices of the cameras of a stereo head."""


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of the full sensor, px; its records' counterpart is `SensorWindow`."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        if min(self.x_px, self.y_px) < 0 or min(self.width_px, self.height_px) < 1:
            raise InputError(
                f"a window of {self.width_px} x {self.height_px} px is not on a sensor"
            )


_SCAN_WINDOW = Window(207, 624, 2658, 800)


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """One camera of a head.

    Parameters
    ----------
    camera
        Full sensor.
    camera_from_sensor
        Where it is; the identity for camera 0, whose frame is Sensor.
    scan_window
        What it reads out while scanning.
    """

    camera: RenderCamera
    camera_from_sensor: Pose[Any, Sensor]
    scan_window: Window

    @property
    def full_window(self) -> Window:
        """The whole sensor."""
        return Window(0, 0, self.camera.width_px, self.camera.height_px)


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """One scanner head.

    Parameters
    ----------
    name
        Kind of the head, for example ``thesis-single``.
    cameras
        Camera 0 first: the only one, or the left one.
    lasers
        Light sheets in the Sensor frame, in order along the head.
    tool_from_sensor
        Mounting: the true hand-eye.
    imaging
        Noise, gloss, light.
    """

    name: str
    cameras: tuple[MountedCamera, ...]
    lasers: tuple[LineLaser, ...]
    tool_from_sensor: Pose[Tool, Sensor]
    imaging: Imaging

    @property
    def camera(self) -> RenderCamera:
        """Camera 0."""
        return self.cameras[0].camera

    @property
    def scan_window(self) -> Window:
        """What camera 0 reads out while scanning."""
        return self.cameras[0].scan_window

    @property
    def full_window(self) -> Window:
        """The whole sensor of camera 0."""
        return self.cameras[0].full_window

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the light sources, in the order of their first sheets."""
        return tuple(dict.fromkeys(laser.source for laser in self.lasers))

    def sheets_of(self, sources: tuple[str, ...]) -> tuple[LineLaser, ...]:
        """All sheets that light up when these sources are switched on.

        Raises
        ------
        InputError
            If a source is not of this head.
        """
        for source in sources:
            if source not in self.sources:
                raise InputError(f"head '{self.name}' has no laser '{source}'")
        return tuple(laser for source in sources for laser in self.lasers if laser.source == source)


def build_head(
    name: str = "thesis-single",
    preset: Preset = "thesis",
    seed: int = 1,
    tolerances: Tolerances | None = None,
) -> Head:
    """Draw one instrument of a kind.

    Parameters
    ----------
    name
        One of `HEADS`.
    preset
        Which `Imaging` it has.
    seed
        Two seeds give two instruments that differ within the tolerances.
    tolerances
        How much they differ; zeros give the printed numbers.

    Raises
    ------
    InputError
        If there is no head of that name.
    """
    if name not in HEADS:
        raise InputError(
            f"no simulated head is called '{name}'", remedy=f"choose one of: {', '.join(HEADS)}"
        )
    spread = Tolerances() if tolerances is None else tolerances
    printed = printed_heads()[name]
    rng = np.random.default_rng([seed, 1])
    imaging = IMAGING[preset]
    cameras = [draw_camera(camera, spread, rng) for camera in printed.cameras]
    lasers = draw_lasers(printed.sheets, imaging.laser_level, spread, rng)
    tool_from_sensor = draw_mounting(printed.tool_from_sensor, spread, rng)
    here: Pose[Sensor, Sensor] = Pose(np.eye(3), np.zeros(3))
    mounted = [MountedCamera(cameras[0], here, _SCAN_WINDOW)]
    if printed.right_from_sensor is not None:
        right: Pose[CameraRight, Sensor] = draw_mounting(printed.right_from_sensor, spread, rng)
        mounted.append(MountedCamera(cameras[1], right, _SCAN_WINDOW))
    return Head(name, tuple(mounted), lasers, tool_from_sensor, imaging)
