# SPDX-License-Identifier: Apache-2.0
"""Scanner heads: camera, line lasers and mounting, drawn around the thesis's printed numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.devices.twin import Preset
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import nearest_rotation, rotation_from_vector
from armscan.simulation.imaging import IMAGING, Imaging
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera

HEADS = ("thesis-single",)

_CAMERA = RenderCamera(
    fx=5145.36,
    fy=5153.66,
    cx=1517.37,
    cy=1023.36,
    k1=-0.09035,
    k2=0.1954,
    p1=-0.000659,
    p2=-0.000978,
    k3=-0.4617,
    width_px=3072,
    height_px=2048,
    blur_sigma_px=0.8,
)
"""Section 5.1.2."""

SINGLE_SHEET = np.array([-0.0042275, 0.73558, -0.67742, 91.78])
"""Section 5.1.2: the printed plane a x + b y + c z + D = 0 of the laser, Sensor frame, mm."""
_SOURCE_MM = np.array([0.0, -124.8, 0.0])
_AIM_MM = 140.0
_HALF_ANGLE_RAD = 0.32
_SKEW_RAD = 0.035
"""Bows the line by 0.12 mm over the 72 mm field, 0.16 % of its length: what line lenses do."""
_THICKNESS_MM = 0.075
_DIVERGENCE_RAD = 4.3e-4
"""Far field of a 405 nm beam of that waist."""

_TOOL_FROM_SENSOR = (
    np.array(
        [
            [-0.42453, 0.663009, -0.61659],
            [-0.90541, -0.31178, 0.28813],
            [-0.00121, 0.680594, 0.73266],
        ]
    ),
    np.array([41.376, 21.496, 112.286]),
)
"""Section 5.1.2."""


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Standard deviations of what differs from one instrument of a kind to the next.

    Parameters
    ----------
    focal_share, centre_px, distortion_share
        Camera: part of the focal length, principal point, part of each distortion coefficient.
    sheet_tilt_rad, sheet_offset_mm, skew_share
        Laser: mounting of the sheet and part of its bow.
    mount_rad, mount_mm
        Head on the tool, about and along each axis.
    """

    focal_share: float = 0.004
    centre_px: float = 8.0
    distortion_share: float = 0.08
    sheet_tilt_rad: float = 0.004
    sheet_offset_mm: float = 0.3
    skew_share: float = 0.25
    mount_rad: float = 0.006
    mount_mm: float = 0.5


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


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """One scanner head.

    Parameters
    ----------
    name
        Kind of the head, for example ``thesis-single``.
    camera
        In the Sensor frame, full sensor.
    lasers
        In the Sensor frame.
    tool_from_sensor
        Mounting: the true hand-eye.
    imaging
        Noise, gloss, light.
    scan_window
        What the camera reads out while scanning.
    """

    name: str
    camera: RenderCamera
    lasers: tuple[LineLaser, ...]
    tool_from_sensor: Pose[Tool, Sensor]
    imaging: Imaging
    scan_window: Window

    @property
    def full_window(self) -> Window:
        """The whole sensor."""
        return Window(0, 0, self.camera.width_px, self.camera.height_px)


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
    rng = np.random.default_rng([seed, 1])
    imaging = IMAGING[preset]
    camera = _draw_camera(spread, rng)
    laser = _draw_laser(spread, imaging.laser_level, rng)
    window = Window(207, 624, 2658, 800)
    return Head(name, camera, (laser,), _draw_mounting(spread, rng), imaging, window)


def _draw_camera(spread: Tolerances, rng: np.random.Generator) -> RenderCamera:
    focal = 1.0 + spread.focal_share * rng.standard_normal()
    shift = spread.centre_px * rng.standard_normal(2)
    k1, k2, p1, p2, k3 = 1.0 + spread.distortion_share * rng.standard_normal(5)
    c = _CAMERA
    return replace(
        c,
        fx=c.fx * focal,
        fy=c.fy * focal,
        cx=c.cx + float(shift[0]),
        cy=c.cy + float(shift[1]),
        k1=c.k1 * k1,
        k2=c.k2 * k2,
        p1=c.p1 * p1,
        p2=c.p2 * p2,
        k3=c.k3 * k3,
    )


def _draw_laser(spread: Tolerances, level: float, rng: np.random.Generator) -> LineLaser:
    """Sheet whose middle ray lies in the printed plane; its ends bow out of it."""
    normal = SINGLE_SHEET[:3] / np.linalg.norm(SINGLE_SHEET[:3])
    source = _SOURCE_MM - (normal @ _SOURCE_MM + SINGLE_SHEET[3]) * normal
    aim = np.array([0.0, 0.0, _AIM_MM])
    aim[1] = -(SINGLE_SHEET[2] * _AIM_MM + SINGLE_SHEET[3]) / SINGLE_SHEET[1]
    tilt = rotation_from_vector(spread.sheet_tilt_rad * rng.standard_normal(3))
    shift = spread.sheet_offset_mm * rng.standard_normal() * normal
    skew = _SKEW_RAD * (1.0 + spread.skew_share * rng.standard_normal())
    forward = (aim - source) / np.linalg.norm(aim - source)
    across = np.cross(normal, forward)
    # The cone's middle ray leaves the fan plane by the skew: turn the fan back by as much.
    back = rotation_from_vector(skew * across)
    return LineLaser(
        "A",
        aim + shift + tilt @ (source - aim),
        tilt @ back @ forward,
        tilt @ across,
        half_angle_rad=_HALF_ANGLE_RAD,
        skew_rad=skew,
        waist_mm=_THICKNESS_MM,
        waist_distance_mm=float(np.linalg.norm(aim - source)),
        divergence_rad=_DIVERGENCE_RAD,
        irradiance=level,
        colour=(1.0, 1.0, 1.0),
    )


def _draw_mounting(spread: Tolerances, rng: np.random.Generator) -> Pose[Tool, Sensor]:
    rotation, translation = _TOOL_FROM_SENSOR
    turn: FloatArray = rotation_from_vector(spread.mount_rad * rng.standard_normal(3))
    shift = spread.mount_mm * rng.standard_normal(3)
    return Pose(turn @ nearest_rotation(rotation), translation + shift)
