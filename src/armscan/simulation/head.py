# SPDX-License-Identifier: Apache-2.0
"""The heads of the thesis as printed, and one instrument of a kind, drawn within tolerances of
manufacture.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Literal, TypeVar

import numpy as np

from armscan.devices.sources import Preset
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import CameraRight, Frame, Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector
from armscan.simulation.optics.camera import RenderCamera
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.render import IMAGING, Imaging

PRINTED: dict[str, Any] = tomllib.loads((files(__package__) / "heads.toml").read_text("utf-8"))
"""The table of the printed heads that lies beside the simulator."""
_BLUR_PX = 0.8
_AIM_MM = 140.0

SINGLE_SHEET = np.array(PRINTED["sheets"]["single"][0])
"""(4,) the printed plane of the laser; section 5.1.2."""
CROSS_SHEETS = np.array(PRINTED["sheets"]["cross"])
"""(2, 4) lasers A and B; section 5.2.2."""
MULTI_SHEETS = np.array(PRINTED["sheets"]["multi"])
"""(5, 4) the middle five of eleven; section 5.3.3."""

_MULTI_SOURCE_MM = np.array([63.03, -0.58, 20.89])
"""Midway between the cameras: near the axis that the five planes miss by 0.1 mm at most."""
_OUTER_SHEETS = 3
_OUTER_STEP_RAD = np.radians(3.15)
"""The printed neighbours are 3.10, 3.15, 3.19, 3.20 degrees apart."""

_SINGLE_SOURCE_MM = np.array([0.0, -124.8, 0.0])
_SINGLE_SKEW_RAD = 0.035
"""Bows the line by 0.12 mm over the 72 mm field, 0.16 % of its length: what line lenses do."""

_MIDDLE_BOW_MM, _OUTERMOST_BOW_MM = 0.05, 0.35
_HALF_FIELD_MM = 36.0
_CUBIC_BOW_MM = 0.015
_OUTERMOST_ORDER = 5
_LOST_AT_OUTERMOST = 0.3

BLUE_MM, RED_MM = 405e-6, 650e-6


@dataclass(frozen=True, slots=True, eq=False)
class PrintedSheet:
    """One light sheet before an instrument is drawn.

    Parameters
    ----------
    plane
        (4,) of eq. 2.19, in which the fan's middle lies.
    source_mm, aim_mm
        (3,) where the fan starts, and a point of its middle in the working region.
    half_angle_rad
        The fan ends at plus and minus this angle.
    skew_rad, cubic_rad
        Bow; see `armscan.simulation.optics.lasers.LineLaser`. The second is a standard deviation.
    brightness
        As a part of the head's brightest line.
    wavelength_mm
        Sets how the sheet's thickness grows away from its waist.
    """

    name: str
    source: str
    plane: FloatArray
    source_mm: FloatArray
    aim_mm: FloatArray
    half_angle_rad: float
    skew_rad: float
    cubic_rad: float = 0.0
    brightness: float = 1.0
    wavelength_mm: float = BLUE_MM


@dataclass(frozen=True, slots=True, eq=False)
class PrintedHead:
    """One kind of head before an instrument is drawn: camera 0 first, sheets in order along it."""

    cameras: tuple[RenderCamera, ...]
    right_from_sensor: Pose[CameraRight, Sensor] | None
    sheets: tuple[PrintedSheet, ...]
    tool_from_sensor: Pose[Tool, Sensor]


def printed_heads() -> dict[str, PrintedHead]:
    """All kinds of heads by name."""
    single, left, right = (
        RenderCamera(**PRINTED["cameras"][name], blur_sigma_px=_BLUR_PX)
        for name in ("single", "left", "right")
    )
    right_from_left: Pose[CameraRight, Sensor] = _pose(PRINTED["right_from_left"])
    on_tool: dict[str, Pose[Tool, Sensor]] = {
        name: _pose(printed) for name, printed in PRINTED["tool_from_sensor"].items()
    }
    sheets = _multi_sheets()
    middle = tuple(
        replace(sheet, name=f"A.{k}")
        for k, sheet in enumerate(sheets[_OUTER_SHEETS:-_OUTER_SHEETS], start=1)
    )
    two = (left, right)
    return {
        "thesis-single": PrintedHead((single,), None, (_single_sheet(),), on_tool["single"]),
        "thesis-cross": PrintedHead((single,), None, _cross_sheets(), on_tool["cross"]),
        "thesis-multi": PrintedHead(two, right_from_left, sheets, on_tool["multi"]),
        "thesis-multi-5": PrintedHead(two, right_from_left, middle, on_tool["multi"]),
    }


def _pose(printed: dict[str, Any]) -> Pose[Any, Sensor]:
    return Pose(
        nearest_rotation(np.array(printed["rotation"])), np.array(printed["translation_mm"])
    )


def _single_sheet() -> PrintedSheet:
    normal = SINGLE_SHEET[:3] / np.linalg.norm(SINGLE_SHEET[:3])
    source = _SINGLE_SOURCE_MM - (normal @ _SINGLE_SOURCE_MM + SINGLE_SHEET[3]) * normal
    aim = np.array([0.0, 0.0, _AIM_MM])
    aim[1] = -(SINGLE_SHEET[2] * _AIM_MM + SINGLE_SHEET[3]) / SINGLE_SHEET[1]
    return PrintedSheet("A", "A", SINGLE_SHEET, source, aim, 0.32, _SINGLE_SKEW_RAD)


def _cross_sheets() -> tuple[PrintedSheet, ...]:
    """Each laser beside the camera, where its plane comes nearest to it, aimed at the axis."""
    return tuple(
        PrintedSheet(
            name,
            name,
            plane,
            _nearest_to_axis(plane, 0.0),
            _nearest_to_axis(plane, _AIM_MM),
            0.36,
            _SINGLE_SKEW_RAD,
        )
        for name, plane in zip(("A", "B"), CROSS_SHEETS, strict=True)
    )


def _nearest_to_axis(plane: FloatArray, depth_mm: float) -> FloatArray:
    """(3,) point of a plane at a depth that is nearest to the optical axis."""
    rest = -(plane[3] + depth_mm * plane[2]) / (plane[:2] @ plane[:2])
    return np.array([*(rest * plane[:2]), depth_mm])


def _multi_sheets() -> tuple[PrintedSheet, ...]:
    """Eleven sheets of one projector: the printed five, and three more on each side.

    The printed planes miss a common axis, so each keeps its own source point: the foot of the
    perpendicular from the common one. The others are turned about the axis.
    """
    printed = MULTI_SHEETS / np.linalg.norm(MULTI_SHEETS[:, :3], axis=1, keepdims=True)
    axis = np.linalg.svd(printed[:, :3])[2][2]
    axis = axis * np.sign(axis @ np.cross(printed[0, :3], printed[-1, :3]))
    normals = [
        *(_turned(printed[0, :3], axis, -k) for k in range(_OUTER_SHEETS, 0, -1)),
        *printed[:, :3],
        *(_turned(printed[-1, :3], axis, k) for k in range(1, _OUTER_SHEETS + 1)),
    ]
    offsets = np.array([-normal @ _MULTI_SOURCE_MM for normal in normals])
    offsets[_OUTER_SHEETS:-_OUTER_SHEETS] = printed[:, 3]
    return tuple(
        _multi_sheet(k - _OUTERMOST_ORDER, np.append(normal, offset), axis)
        for k, (normal, offset) in enumerate(zip(normals, offsets, strict=True))
    )


def _turned(normal: FloatArray, axis: FloatArray, steps: int) -> FloatArray:
    return np.asarray(rotation_from_vector(steps * _OUTER_STEP_RAD * axis) @ normal)


def _multi_sheet(order: int, plane: FloatArray, axis: FloatArray) -> PrintedSheet:
    """The line of one diffraction order.

    A grating bends oblique rays more: its orders lie on cones, bowed in proportion to the order
    (Born & Wolf, Principles of Optics, 8.6.1). Projectors are designed against the linear part;
    what is supposed to be left is cubic in the order, on top of the line lens's own bow: 0.05 mm
    in the middle, 0.4 and -0.3 mm at the two ends, over the 72 mm field.
    """
    normal = plane[:3]
    source = _MULTI_SOURCE_MM - (normal @ _MULTI_SOURCE_MM + plane[3]) * normal
    forward = np.cross(axis, normal)
    forward = forward * np.sign(forward[2])
    distance = (_AIM_MM - source[2]) / forward[2]
    outward = order / _OUTERMOST_ORDER
    bow_mm = _MIDDLE_BOW_MM + _OUTERMOST_BOW_MM * outward**3
    fan_rad = _HALF_FIELD_MM / distance
    return PrintedSheet(
        f"A.{order + _OUTERMOST_ORDER + 1}",
        "A",
        plane,
        source,
        source + distance * forward,
        half_angle_rad=0.42,
        skew_rad=2.0 * bow_mm / (distance * fan_rad**2),
        cubic_rad=_CUBIC_BOW_MM / (distance * fan_rad**3),
        brightness=1.0 - _LOST_AT_OUTERMOST * outward**2,
        wavelength_mm=RED_MM,
    )


_THICKNESS_MM = 0.075
_BLUE_DIVERGENCE_RAD = 4.3e-4
"""Far field of a 405 nm beam of that waist."""
_ORDER_SHARE = 0.25
"""Lines of one projector sit firmly on each other: this part of the tolerance is each one's own."""

A = TypeVar("A", bound=Frame)


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
        Head on the tool, and a second camera on the head, about and along each axis.
    """

    focal_share: float = 0.004
    centre_px: float = 8.0
    distortion_share: float = 0.08
    sheet_tilt_rad: float = 0.004
    sheet_offset_mm: float = 0.3
    skew_share: float = 0.25
    mount_rad: float = 0.006
    mount_mm: float = 0.5


def draw_camera(
    printed: RenderCamera, spread: Tolerances, rng: np.random.Generator
) -> RenderCamera:
    """One camera of a kind."""
    focal = 1.0 + spread.focal_share * rng.standard_normal()
    shift = spread.centre_px * rng.standard_normal(2)
    k1, k2, p1, p2, k3 = 1.0 + spread.distortion_share * rng.standard_normal(5)
    c = printed
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


def draw_mounting(
    printed: Pose[A, Sensor], spread: Tolerances, rng: np.random.Generator
) -> Pose[A, Sensor]:
    """Where the head sits on something, or something on the head."""
    turn: FloatArray = rotation_from_vector(spread.mount_rad * rng.standard_normal(3))
    shift = spread.mount_mm * rng.standard_normal(3)
    return Pose(turn @ printed.rotation, printed.translation_mm + shift)


def draw_lasers(
    printed: Sequence[PrintedSheet], level: float, spread: Tolerances, rng: np.random.Generator
) -> tuple[LineLaser, ...]:
    """All sheets; those of one source are mounted as one, and each is a little off besides."""
    n_sheets = {sheet.source: 0 for sheet in printed}
    for sheet in printed:
        n_sheets[sheet.source] += 1
    lasers: list[LineLaser] = []
    for source, count in n_sheets.items():
        own = [sheet for sheet in printed if sheet.source == source]
        if count == 1:
            lasers.append(_draw_laser(own[0], level, spread, rng))
            continue
        middle = own[count // 2]
        tilt = rotation_from_vector(spread.sheet_tilt_rad * rng.standard_normal(3))
        shift = spread.sheet_offset_mm * rng.standard_normal(3)
        each = replace(
            spread,
            sheet_tilt_rad=_ORDER_SHARE * spread.sheet_tilt_rad,
            sheet_offset_mm=_ORDER_SHARE * spread.sheet_offset_mm,
        )
        mount: Pose[Sensor, Sensor] = Pose(tilt, middle.aim_mm + shift - tilt @ middle.aim_mm)
        lasers += [_draw_laser(sheet, level, each, rng).moved(mount) for sheet in own]
    return tuple(lasers)


def _draw_laser(
    printed: PrintedSheet, level: float, spread: Tolerances, rng: np.random.Generator
) -> LineLaser:
    """Sheet whose middle ray lies in the printed plane; its ends bow out of it."""
    normal = printed.plane[:3] / np.linalg.norm(printed.plane[:3])
    source, aim = printed.source_mm, printed.aim_mm
    tilt = rotation_from_vector(spread.sheet_tilt_rad * rng.standard_normal(3))
    shift = spread.sheet_offset_mm * rng.standard_normal() * normal
    skew = printed.skew_rad * (1.0 + spread.skew_share * rng.standard_normal())
    forward = (aim - source) / np.linalg.norm(aim - source)
    across = np.cross(normal, forward)
    # The cone's middle ray leaves the fan plane by the skew: turn the fan back by as much.
    back = rotation_from_vector(skew * across)
    cubic = 0.0
    if printed.cubic_rad > 0.0 and spread.skew_share > 0.0:
        cubic = printed.cubic_rad * rng.standard_normal()
    return LineLaser(
        printed.name,
        aim + shift + tilt @ (source - aim),
        tilt @ back @ forward,
        tilt @ across,
        half_angle_rad=printed.half_angle_rad,
        skew_rad=skew,
        waist_mm=_THICKNESS_MM,
        waist_distance_mm=float(np.linalg.norm(aim - source)),
        divergence_rad=_BLUE_DIVERGENCE_RAD * (printed.wavelength_mm / BLUE_MM),
        irradiance=printed.brightness * level,
        source=printed.source,
        cubic_rad=cubic,
    )


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
    """One camera of a head; camera 0's frame is Sensor.

    ``scan_window`` is what it reads out while scanning.
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
    """One scanner head: camera 0, the only or the left one, first; sheets in order along it, in
    Sensor.
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

    @property
    def kind(self) -> Literal["one_line", "crossed", "many"]:
        """What the plans of scenes go by."""
        if len(self.cameras) > 1:
            return "many"
        return "one_line" if len(self.sources) == 1 else "crossed"

    def sheets_of(self, sources: tuple[str, ...]) -> tuple[LineLaser, ...]:
        """All sheets that light up when these sources of this head are switched on."""
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
    """Draw one instrument of a kind; two seeds give two that differ within the tolerances."""
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


_DEPTHS_MM = np.linspace(112.0, 172.0, 31)
_FAN_STEPS = 61


def sheet_middle_mm(head: Head, depth_mm: float, sheet: str | None = None) -> FloatArray:
    """(3,) point of a sheet's middle ray at a depth along the optical axis.

    Without a name it is the middle sheet of an odd number, the mean of the two of an even one.
    """
    count = len(head.lasers)
    chosen = [laser for laser in head.lasers if laser.name == sheet]
    middles = chosen or head.lasers[(count - 1) // 2 : count // 2 + 1]
    return np.asarray(np.mean([_middle_mm(laser, depth_mm) for laser in middles], axis=0))


def sheet_points_mm(head: Head) -> dict[str, FloatArray]:
    """(N, 3) points of each sheet that camera 0's full sensor sees, 112-172 mm deep."""
    return {laser.name: _points_mm(head, laser) for laser in head.lasers}


def _middle_mm(laser: LineLaser, depth_mm: float) -> FloatArray:
    ray = laser.rays(np.zeros(1))[0]
    return np.asarray(laser.source_mm + (depth_mm - laser.source_mm[2]) / ray[2] * ray)


def _points_mm(head: Head, laser: LineLaser) -> FloatArray:
    camera = head.camera
    fan = np.linspace(-laser.half_angle_rad, laser.half_angle_rad, _FAN_STEPS)
    rays = laser.rays(fan)
    reach = (_DEPTHS_MM[:, None] - laser.source_mm[2]) / rays[:, 2]
    points = (laser.source_mm + reach[..., None] * rays).reshape(-1, 3)
    pixels = camera.project(points)
    size = np.array([camera.width_px - 1, camera.height_px - 1])
    return np.asarray(points[((pixels >= 0.0) & (pixels <= size)).all(axis=1)])
