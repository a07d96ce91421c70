# SPDX-License-Identifier: Apache-2.0
"""Scenes as numbers, and the compiled loops that trace and shade them pixel by pixel.

They give what `armscan.simulation.optics.scene.Scene` and the lights give, surface by surface, some
ten times sooner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.simulation.kernels import (
    Floats,
    Three,
    compiled,
    meet_box,
    meet_floor,
    meet_plate,
    meet_print,
    meet_sphere,
    meet_waves,
    plate_slopes,
    waves_over,
)
from armscan.simulation.objects.boards import FLAT, CirclePattern, PrintedBoard
from armscan.simulation.objects.body import GRADIENT_STEP_MM, HIT_MM, Body, distance, marched
from armscan.simulation.objects.mesh import Mesh, meet_mesh, mesh_normal
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed, WavyPlate
from armscan.simulation.optics.camera import RenderCamera
from armscan.simulation.optics.lasers import LaserSource, LineLaser, TracedLight
from armscan.simulation.optics.scene import (
    CELLS_PER_GRAIN,
    DARKEST,
    FAINTEST,
    SHADOW_MARGIN_MM,
    SLANT,
    Floor,
    Hits,
    Material,
    Scene,
    SceneObject,
    Sphere,
    texture_pattern,
)
from armscan.simulation.optics.stray_light import CentreSpot

_BOX, _PLATE, _SPHERE, _WAVES, _BODY, _PRINT, _FLOOR, _MESH = range(8)
_KIND, _TEXTURE, _CELLS, _GLOSS = 0, 13, 14, 15
_GLOSS_WIDTH, _COLOUR, _START, _STOP = 16, 17, 18, 19
"""Columns of a surface's row; 1 to 9 are its rotation in the scene, 10 to 12 its place there."""
_FIXED_POINT_STEPS = 400
_SLANT_X, _SLANT_Y = SLANT
_N_SHEET = 22

Counts = NDArray[np.int64]


@compiled
def _into(row: Floats, x: float, y: float, z: float) -> Three:
    """A direction in the frame of a surface."""
    return (
        x * row[1] + y * row[4] + z * row[7],
        x * row[2] + y * row[5] + z * row[8],
        x * row[3] + y * row[6] + z * row[9],
    )


@compiled
def _out_of(row: Floats, x: float, y: float, z: float) -> Three:
    """A direction in the frame of a surface, seen from the scene."""
    return (
        x * row[1] + y * row[2] + z * row[3],
        x * row[4] + y * row[5] + z * row[6],
        x * row[7] + y * row[8] + z * row[9],
    )


@compiled
def _meet(
    row: Floats,
    data: Floats,
    limbs: Floats,
    balls: Floats,
    mesh: Floats | None,
    spare: Counts,
    start: Three,
    ray: Three,
) -> float:
    """Distance to one surface along a ray of the scene; infinite for none.

    ``mesh`` are the numbers of meshes; where there are none, what would meet them is not compiled.
    """
    sx, sy, sz = _into(row, start[0] - row[10], start[1] - row[11], start[2] - row[12])
    own, along = (sx, sy, sz), _into(row, ray[0], ray[1], ray[2])
    kind, at = int(row[_KIND]), int(row[_START])
    if kind == _PLATE:
        return meet_plate(data, at, own, along)
    if kind == _WAVES:
        return meet_waves(data, at, own, along)
    if kind == _BOX:
        return meet_box(data, at, own, along)
    if kind == _SPHERE:
        return meet_sphere(data, at, own, along)
    if kind == _PRINT:
        return meet_print(data, at, own, along)
    if kind == _FLOOR:
        return meet_floor(data, at, own, along)
    if mesh is not None and kind == _MESH:
        return meet_mesh(mesh, at, own, along)
    stop = int(row[_STOP])
    return float(marched(own, along, limbs[at:stop], balls[at:stop], HIT_MM, spare[0]))


@compiled
def _first(
    rows: Floats,
    data: Floats,
    limbs: Floats,
    balls: Floats,
    mesh: Floats | None,
    spare: Counts,
    ray: Three,
) -> tuple[float, int]:
    """Distance from the camera to the first surface, and which; infinite and -1 for none."""
    nearest, index = np.inf, -1
    for k in range(rows.shape[0]):
        reach = _meet(rows[k], data, limbs, balls, mesh, spare, (0.0, 0.0, 0.0), ray)
        if reach < nearest:
            nearest, index = reach, k
    return nearest, index


@compiled
def _normal(
    row: Floats,
    data: Floats,
    limbs: Floats,
    mesh: Floats | None,
    spare: Counts,
    point: Three,
) -> Three:
    """Outward unit normal of a surface at a point of it, both in the scene."""
    px, py, pz = _into(row, point[0] - row[10], point[1] - row[11], point[2] - row[12])
    kind, at = int(row[_KIND]), int(row[_START])
    nx, ny, nz = 0.0, 0.0, 1.0
    if kind == _PLATE:
        slope_x, slope_y = plate_slopes(data, at, px, py)
        nx, ny = -slope_x, -slope_y
    elif kind == _WAVES:
        _, slope_x, slope_y = waves_over(data, at, px, py)
        nx, ny = -slope_x, -slope_y
    elif kind == _SPHERE:
        nx, ny, nz = px - data[at], py - data[at + 1], pz - data[at + 2]
    elif kind == _PRINT:
        nz = -1.0
    elif kind == _FLOOR:
        nx, ny, nz = data[at + 3], data[at + 4], data[at + 5]
    elif kind == _BOX:
        pz -= 0.5 * data[at + 2]
        beyond_x, beyond_y = abs(px) - 0.5 * data[at], abs(py) - 0.5 * data[at + 1]
        beyond_z = abs(pz) - 0.5 * data[at + 2]
        nz = 0.0
        if beyond_x >= beyond_y and beyond_x >= beyond_z:
            nx = -1.0 if px < 0.0 else 1.0
        elif beyond_y >= beyond_z:
            ny = -1.0 if py < 0.0 else 1.0
        else:
            nz = -1.0 if pz < 0.0 else 1.0
    elif kind == _BODY:
        own, nz, d = limbs[at : int(row[_STOP])], 0.0, GRADIENT_STEP_MM
        every = spare[1, : own.shape[0]]
        a = distance(px + d, py - d, pz - d, own, every)
        b = distance(px - d, py - d, pz + d, own, every)
        c = distance(px - d, py + d, pz - d, own, every)
        e = distance(px + d, py + d, pz + d, own, every)
        nx, ny, nz = a - b - c + e, -a - b + c + e, -a + b - c + e
    elif mesh is not None:
        nx, ny, nz = mesh_normal(mesh, at, px, py, pz)
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return _out_of(row, nx / length, ny / length, nz / length)


@compiled
def _reflectance(
    row: Floats, base: Floats, data: Floats, pattern: Floats, x: float, y: float, z: float
) -> float:
    """Red albedo of a surface at a point of it in the scene, texture included."""
    if int(row[_KIND]) == _PRINT:
        px, py, _ = _into(row, x - row[10], y - row[11], z - row[12])
        return _printed(data, int(row[_START]), px, py)
    if row[_TEXTURE] == 0.0:
        return float(row[_COLOUR])
    bx, by, bz = _into(base, x - base[10], y - base[11], z - base[12])
    bx, by, bz = bx * row[_CELLS], by * row[_CELLS], bz * row[_CELLS]
    n = pattern.shape[0]
    u, v = int(bx + _SLANT_X * bz) % n, int(by + _SLANT_Y * bz) % n
    return float(row[_COLOUR] * max(1.0 + row[_TEXTURE] * pattern[v, u], DARKEST))


@compiled
def _printed(data: Floats, at: int, x: float, y: float) -> float:
    """Albedo of a print: extent, tones, edge, pitch, step, counts, radius, two flags, shifts."""
    light, dark, edge, pitch, step = (
        *(data[at + 4], data[at + 5], data[at + 6], data[at + 7], data[at + 8]),
    )
    columns, rows, radius = data[at + 9], data[at + 10], data[at + 11]
    row = min(max(np.rint(y / pitch), 0.0), rows - 1.0)
    shift = pitch * (row % 2.0) if data[at + 12] > 0.0 else 0.0
    column = min(max(np.rint((x - shift) / step), 0.0), columns - 1.0)
    disc = at + 14 + 2 * int(row * columns + column)
    dx, dy = x - shift - column * step - data[disc], y - row * pitch - data[disc + 1]
    beyond = math.sqrt(dx * dx + dy * dy) - radius
    signed = -beyond if data[at + 13] > 0.0 else beyond
    return float(dark + (light - dark) * min(max(0.5 + signed / edge, 0.0), 1.0))


@compiled
def _ray(
    lens: Floats, u: float, v: float, tolerance: float, bend: tuple[float, float]
) -> tuple[Three, tuple[float, float]]:
    """Unit ray of a pixel, by the fixed-point search of `RenderCamera.rays`; NaN if it fails.

    ``bend`` is by how much the lens bends it, guessed and then found.
    """
    seen_x, seen_y = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    x, y = seen_x + bend[0], seen_y + bend[1]
    for _ in range(_FIXED_POINT_STEPS):
        square = x * x + y * y
        gain = 1.0 / (1.0 + square * (lens[4] + square * (lens[5] + square * lens[8])))
        lever = 2.0 * (lens[6] * y + lens[7] * x)
        new_x = (seen_x - x * lever - lens[7] * square) * gain
        new_y = (seen_y - y * lever - lens[6] * square) * gain
        step = max(abs(new_x - x), abs(new_y - y))
        x, y = new_x, new_y
        if step < tolerance:
            length = 1.0 / math.sqrt(x * x + y * y + 1.0)
            return (x * length, y * length, length), (x - seen_x, y - seen_y)
    return (np.nan, np.nan, np.nan), (0.0, 0.0)


@compiled
def _trace(
    pixels: Floats,
    lens: Floats,
    tolerance: float,
    rows: Floats,
    data: Floats,
    limbs: Floats,
    balls: Floats,
    mesh: Floats | None,
    spare: Counts,
    reach: Floats,
    surface: Counts,
    points: Floats,
) -> None:
    """First hits of the rays of pixels (N, 2), from the origin."""
    bend = (0.0, 0.0)
    for i in range(pixels.shape[0]):
        ray, bend = _ray(lens, pixels[i, 0], pixels[i, 1], tolerance, bend)
        reach[i], surface[i] = _first(rows, data, limbs, balls, mesh, spare, ray)
        for k in range(3):
            points[i, k] = reach[i] * ray[k] if surface[i] >= 0 else np.nan


@compiled
def _is_seen(
    rows: Floats,
    data: Floats,
    limbs: Floats,
    balls: Floats,
    mesh: Floats | None,
    spare: Counts,
    own: int,
    source: Three,
    point: Three,
    normal: Three,
) -> bool:
    """Whether nothing stands between a source and a point of a surface.

    Where a surface without hollows faces the source, it does not shade its own.
    """
    x, y, z = point[0] - source[0], point[1] - source[1], point[2] - source[2]
    away = math.sqrt(x * x + y * y + z * z)
    ray = (x / away, y / away, z / away)
    kind = int(rows[own, _KIND])
    is_clear = x * normal[0] + y * normal[1] + z * normal[2] < 0.0
    is_clear = is_clear and kind not in (_WAVES, _BODY, _MESH)
    for k in range(rows.shape[0]):
        if k == own and is_clear:
            continue
        if _meet(rows[k], data, limbs, balls, mesh, spare, source, ray) < away - SHADOW_MARGIN_MM:
            return False
    return True


@compiled
def _sheet_of(lights: Floats, borders: Floats, x: float, y: float, z: float) -> int:
    """Which sheet of a source is nearest: the first row holds its middle sheet and its sense."""
    if len(borders) == 0:
        return 1
    m = lights[0]
    x, y, z = x - m[0], y - m[1], z - m[2]
    up, forward = x * m[9] + y * m[10] + z * m[11], x * m[3] + y * m[4] + z * m[5]
    angle = m[12] * math.atan2(up, forward)
    sheet = 1
    for border in borders:
        sheet += border < angle
    return sheet


@compiled
def _lit_by_sheet(sheet: Floats, point: Three, normal: Three) -> tuple[float, float]:
    """Reach in sigmas and irradiance if it were zero; see `LineLaser.reach_and_peak`."""
    x, y, z = point[0] - sheet[0], point[1] - sheet[1], point[2] - sheet[2]
    away = math.sqrt(x * x + y * y + z * z)
    forward = x * sheet[3] + y * sheet[4] + z * sheet[5]
    across = x * sheet[6] + y * sheet[7] + z * sheet[8]
    up = x * sheet[9] + y * sheet[10] + z * sheet[11]
    angle = math.atan2(across, forward)
    centre = sheet[13] + sheet[19] * angle**3
    sigma = math.hypot(sheet[14], sheet[16] * (away - sheet[15]))
    reach = away * (math.atan2(up, math.hypot(forward, across)) - centre) / sigma
    fan = angle / sheet[12]
    along = 1.0 - sheet[18] * fan * fan if abs(fan) <= 1.0 else 0.0
    facing = max(-(x * normal[0] + y * normal[1] + z * normal[2]) / away, 0.0)
    spread = sheet[14] * sheet[15] / (sigma * away)
    return reach, sheet[17] * spread * along * facing


@compiled
def _lit_by_spot(spot: Floats, point: Three, normal: Three) -> tuple[float, float]:
    """As `_lit_by_sheet`, of a round beam; see `CentreSpot`."""
    x, y, z = point[0] - spot[0], point[1] - spot[1], point[2] - spot[2]
    dx, dy, dz = spot[3], spot[4], spot[5]
    cx, cy, cz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    reach = math.sqrt(cx * cx + cy * cy + cz * cz) / spot[14]
    ahead = x * dx + y * dy + z * dz > 0.0
    facing = max(-(normal[0] * dx + normal[1] * dy + normal[2] * dz), 0.0)
    return reach, spot[17] * facing if ahead else 0.0


@compiled
def _glossy(row: Floats, source: Three, point: Three, normal: Three) -> float:
    """Gaussian lobe of the angle between the normal and the half-way ray."""
    if row[_GLOSS] == 0.0:
        return 0.0
    x, y, z = source[0] - point[0], source[1] - point[1], source[2] - point[2]
    to_source = math.sqrt(x * x + y * y + z * z)
    to_eye = math.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
    hx, hy, hz = (
        x / to_source - point[0] / to_eye,
        y / to_source - point[1] / to_eye,
        z / to_source - point[2] / to_eye,
    )
    cosine = (hx * normal[0] + hy * normal[1] + hz * normal[2]) / math.sqrt(
        hx * hx + hy * hy + hz * hz
    )
    square = 2.0 * (1.0 - min(max(cosine, -1.0), 1.0))
    return float(row[_GLOSS] * math.exp(-0.5 * square / row[_GLOSS_WIDTH] ** 2))


@compiled
def _shade(
    pixels: Floats,
    lens: Floats,
    tolerance: float,
    rows: Floats,
    base: Floats,
    data: Floats,
    limbs: Floats,
    balls: Floats,
    mesh: Floats | None,
    spare: Counts,
    pattern: Floats,
    lights: Floats,
    borders: Floats,
    far_sigmas: float,
    reach: Floats,
    peak: Floats,
) -> None:
    """Reach and peak (N,) of a light at pixels (N, 2); untouched where nothing is met or lit."""
    bend = (0.0, 0.0)
    for i in range(pixels.shape[0]):
        ray, bend = _ray(lens, pixels[i, 0], pixels[i, 1], tolerance, bend)
        away, index = _first(rows, data, limbs, balls, mesh, spare, ray)
        if index < 0:
            continue
        point = (away * ray[0], away * ray[1], away * ray[2])
        row = rows[index]
        normal = _normal(row, data, limbs, mesh, spare, point)
        sheet = lights[_sheet_of(lights, borders, point[0], point[1], point[2])]
        if sheet[20] > 0.0:
            near, strength = _lit_by_spot(sheet, point, normal)
        else:
            near, strength = _lit_by_sheet(sheet, point, normal)
        reach[i] = min(max(near, -far_sigmas), far_sigmas)
        if abs(near) >= far_sigmas or strength <= FAINTEST:
            continue
        source = (sheet[0], sheet[1], sheet[2])
        if _is_seen(rows, data, limbs, balls, mesh, spare, index, source, point, normal):
            albedo = _reflectance(row, base, data, pattern, point[0], point[1], point[2])
            peak[i] = strength * (albedo + _glossy(row, source, point, normal))


@compiled
def _room(
    points: Floats,
    surface: Counts,
    rows: Floats,
    base: Floats,
    data: Floats,
    limbs: Floats,
    balls: Floats,
    mesh: Floats | None,
    spare: Counts,
    pattern: Floats,
    lamp: Floats,
    radiance: Floats,
) -> None:
    """Red light of hits (N, 3) under a lamp: even, direct, place, direction of the even part."""
    for i in range(points.shape[0]):
        index = surface[i]
        if index < 0:
            continue
        row, point = rows[index], (points[i, 0], points[i, 1], points[i, 2])
        normal = _normal(row, data, limbs, mesh, spare, point)
        light = lamp[5] * normal[0] + lamp[6] * normal[1] + lamp[7] * normal[2]
        light = lamp[0] * (2.0 + light) / 3.0
        source = (lamp[2], lamp[3], lamp[4])
        x, y, z = source[0] - point[0], source[1] - point[1], source[2] - point[2]
        facing = x * normal[0] + y * normal[1] + z * normal[2]
        cosine = facing / math.sqrt(x * x + y * y + z * z)
        if cosine > 0.0 and _is_seen(
            rows, data, limbs, balls, mesh, spare, index, source, point, normal
        ):
            light += lamp[1] * cosine
        albedo = _reflectance(row, base, data, pattern, point[0], point[1], point[2])
        radiance[i] = light * albedo


@dataclass(frozen=True, slots=True, eq=False)
class SceneNumbers:
    """A scene for the compiled loops.

    Parameters
    ----------
    rows
        (S, 20) one a surface: kind, place, finish, where its numbers lie.
    base
        (13,) place of the frame in which textures lie.
    data
        (D,) what the shapes are made of, one after the other.
    limbs, balls
        (L, 12) and (L, 4) of bodies.
    lamp
        (8,) room light: even, direct, place, direction of the even part.
    """

    rows: Floats
    base: Floats
    data: Floats
    limbs: Floats
    balls: Floats
    lamp: Floats

    @property
    def spare(self) -> Counts:
        """(2, L) room in which the limbs that a ray crosses are noted, and the number of each."""
        every = np.arange(len(self.limbs))
        return np.stack([every, every])

    @property
    def mesh(self) -> Floats | None:
        """The data if there are meshes among it."""
        return self.data if (self.rows[:, _KIND] == _MESH).any() else None

    @property
    def _shapes(self) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats | None, Counts]:
        bodies = (self.limbs, self.balls)
        return self.rows, self.base, self.data, *bodies, self.mesh, self.spare

    @staticmethod
    def of(scene: Scene, finishes: tuple[Material, ...]) -> SceneNumbers | None:
        """None if a surface is none of those that the loops know."""
        rows, base = [], np.zeros(13)
        data: list[FloatArray] = []
        bodies: list[Body] = []
        for surface, finish in zip(scene.surfaces, finishes, strict=False):
            row = _row(surface, data, bodies)
            if row is None:
                return None
            row[_GLOSS], row[_GLOSS_WIDTH] = finish.gloss, finish.gloss_width_rad
            rows.append(row)
            if isinstance(surface, Placed):
                base[1:] = _place(surface.scene_from_shape)
        lamp = scene.lamp
        return SceneNumbers(
            np.array(rows).reshape(-1, 20),
            base,
            np.concatenate([*data, np.zeros(1)]),
            np.concatenate([np.zeros((0, 12)), *(body.rows for body in bodies)]),
            np.concatenate([np.zeros((0, 4)), *(body.balls for body in bodies)]),
            np.array([lamp.even, lamp.direct, *lamp.position_mm, *lamp.up]),
        )

    def trace(self, camera: RenderCamera, pixels: FloatArray, tolerance: float) -> Hits:
        """First hits of the rays of pixels (N, 2); see `Scene.trace`."""
        n = len(pixels)
        reach, surface, points = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 3))
        own = (self.rows, self.data, self.limbs, self.balls, self.mesh, self.spare)
        _trace(_own(pixels), camera.numbers, tolerance, *own, reach, surface, points)
        return Hits(reach, surface, points)

    def room_light(self, hits: Hits) -> FloatArray:
        """(N,) red light of hits under the lamp; see `Scene.room_light`."""
        light = np.zeros(len(hits.surface))
        own, pattern = self._shapes, texture_pattern()
        _room(_own(hits.points_mm), hits.surface, *own, pattern, self.lamp, light)
        return light

    def shade(
        self,
        camera: RenderCamera,
        pixels: FloatArray,
        light: LightNumbers,
        *,
        tolerance: float,
        far_sigmas: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Reach and peak (N,) of a light at pixels (N, 2)."""
        reach, peak = np.full(len(pixels), far_sigmas), np.zeros(len(pixels))
        own, pattern = self._shapes, texture_pattern()
        shone = (light.rows, light.borders, far_sigmas)
        _shade(_own(pixels), camera.numbers, tolerance, *own, pattern, *shone, reach, peak)
        return reach, peak


@dataclass(frozen=True, slots=True, eq=False)
class LightNumbers:
    """A light for the compiled loops.

    Parameters
    ----------
    rows
        (1 + K, 22) the middle sheet and its sense, then each sheet, or a spot.
    borders
        (K - 1,) angles between the sheets of a source; see `LaserSource`.
    """

    rows: Floats
    borders: Floats

    @staticmethod
    def of(light: TracedLight) -> LightNumbers | None:
        """None if it is none of those that the loops know."""
        if isinstance(light, CentreSpot):
            spot = np.zeros(_N_SHEET)
            spot[:6] = *light.source_mm, *light.direction
            spot[14], spot[17], spot[20] = light.sigma_mm, light.irradiance, 1.0
            return LightNumbers(np.stack([spot, spot]), np.zeros(0))
        if not isinstance(light, LaserSource):
            return None
        middle = _sheet(light.sheets[len(light.sheets) // 2])
        middle[12] = light.sense
        rows = np.stack([middle, *(_sheet(sheet) for sheet in light.sheets)])
        return LightNumbers(rows, np.array(light.between_rad))


def _own(values: FloatArray) -> Floats:
    return np.array(values, dtype=np.float64, order="C")


def _sheet(laser: LineLaser) -> Floats:
    row = np.zeros(_N_SHEET)
    row[:12] = *laser.source_mm, *laser.forward, *laser.across, *laser.normal
    row[12:16] = laser.half_angle_rad, laser.skew_rad, laser.waist_mm, laser.waist_distance_mm
    row[16:20] = laser.divergence_rad, laser.irradiance, laser.falloff, laser.cubic_rad
    return row


def _place(pose: Pose[Any, Any]) -> Floats:
    """(12,) rotation, row by row, and translation."""
    return np.concatenate([pose.rotation.ravel(), pose.translation_mm])


def _row(surface: Any, data: list[FloatArray], bodies: list[Body]) -> Floats | None:
    """Row of a surface, whose numbers are put behind the others'; None if it is not known."""
    row = np.zeros(20)
    pose: Pose[Any, Any] = Pose(np.eye(3), np.zeros(3))
    while isinstance(surface, (Placed, SceneObject)):
        if isinstance(surface, SceneObject):
            finish = surface.finish
            row[_TEXTURE], row[_CELLS] = finish.texture, CELLS_PER_GRAIN / finish.texture_mm
            surface = surface.surface
        else:
            pose, surface = pose @ surface.scene_from_shape, surface.shape
    if isinstance(surface, PrintedBoard):
        pose = pose @ surface.sensor_from_board
    elif isinstance(surface, Body):
        pose = pose @ surface.sensor_from_part
    shape = _shape(surface)
    if shape is None:
        return None
    row[_KIND], row[_START], row[1:13] = shape[0], sum(map(len, data)), _place(pose)
    data.append(np.asarray(shape[1], dtype=np.float64))
    if isinstance(surface, Body):
        row[_START] = sum(len(body.rows) for body in bodies)
        row[_STOP] = row[_START] + len(surface.rows)
        bodies.append(surface)
    if not isinstance(surface, PrintedBoard):
        row[_COLOUR] = surface.colour[0]
    return row


def _shape(surface: Any) -> tuple[int, list[float] | FloatArray] | None:
    """Kind of a shape, and what it is made of."""
    found: tuple[int, list[float] | FloatArray] | None = None
    if isinstance(surface, FlatPlate):
        terms = _in_powers(surface.waves_mm)
        found = _PLATE, [*surface.size_mm, *surface.tilt, len(terms), *terms.ravel()]
    elif isinstance(surface, WavyPlate):
        found = _WAVES, _wave_numbers(surface)
    elif isinstance(surface, Box):
        found = _BOX, list(surface.size_mm)
    elif isinstance(surface, Sphere):
        found = _SPHERE, [*surface.centre_mm, surface.radius_mm]
    elif isinstance(surface, Floor):
        found = _FLOOR, [*surface.point_mm, *surface.normal]
    elif isinstance(surface, Body):
        found = _BODY, []
    elif isinstance(surface, Mesh):
        found = _MESH, surface.numbers
    elif (
        isinstance(surface, PrintedBoard)
        and isinstance(surface.pattern, CirclePattern)
        and surface.substrate == FLAT
    ):
        found = _PRINT, _print_numbers(surface, surface.pattern)
    return found


def _wave_numbers(plate: WavyPlate) -> list[float]:
    steepest = sum(wave.steepest for wave in plate.waves)
    numbers = [*plate.size_mm, plate.highest_mm, steepest, len(plate.waves)]
    for wave in plate.waves:
        rate = 2.0 * math.pi / wave.length_mm
        along = rate * math.cos(wave.azimuth_rad), rate * math.sin(wave.azimuth_rad)
        numbers += [*along, wave.phase_rad, wave.amplitude_mm]
    return numbers


def _in_powers(waves_mm: FloatArray | None) -> FloatArray:
    """(K, K) the same waves as a polynomial in the two cosines: ``cos(k t)`` is one of degree k."""
    if waves_mm is None:
        return np.zeros((0, 0))
    n = max(waves_mm.shape)
    square = np.zeros((n, n))
    square[: waves_mm.shape[0], : waves_mm.shape[1]] = waves_mm
    powers = _cosine_powers(n)
    return np.asarray(powers.T @ square @ powers)


@cache
def _cosine_powers(n: int) -> FloatArray:
    """(n, n) factors of the powers of a cosine, for the cosine of each multiple of its angle."""
    powers = np.zeros((n, n))
    for k in range(n):
        powers[k, : k + 1] = np.polynomial.chebyshev.cheb2poly(np.eye(n)[k])[: k + 1]
    return powers


def _print_numbers(board: PrintedBoard, pattern: CirclePattern) -> list[float]:
    shifts = pattern.misplaced_mm or ((0.0, 0.0),) * (pattern.columns * pattern.rows)
    step = (2.0 if pattern.is_asymmetric else 1.0) * pattern.pitch_mm
    return [
        *pattern.extent_board_mm,
        *(board.light, board.dark, board.edge_mm, pattern.pitch_mm, step),
        *(pattern.columns, pattern.rows, 0.5 * pattern.diameter_mm),
        *(float(pattern.is_asymmetric), float(pattern.is_light_on_dark)),
        *np.ravel(shifts),
    ]
