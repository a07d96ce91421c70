# SPDX-License-Identifier: Apache-2.0
"""Printed boards: circle grids as functions of the place on the board, and their images,
supersampled at the edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.simulation.kernels import (
    SAMPLES,
    SUBPIXELS,
    disc_cells,
    lay_over,
)
from armscan.simulation.optics.camera import RenderCamera, blur_image, blur_kernel
from armscan.simulation.optics.render import PixelBox, camera_rays
from armscan.simulation.optics.scene import MISS, RoomLight


class FlatPattern(Protocol):
    """What the renderer asks of a print."""

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) true marks: circle centres or corners, row by row."""

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        """Print's rectangle ``x_min, y_min, x_max, y_max``; beyond it lies the surround."""

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Tell the tone at points inside the print."""

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return a distance to the nearest edge that is never larger than the true one."""


@dataclass(frozen=True, slots=True)
class CirclePattern:
    """Grid of discs, ``diameter_mm`` across; an asymmetric grid shifts odd rows by one pitch.

    As in OpenCV, ``pitch_mm`` of an asymmetric grid is the distance between rows, and half the
    distance between neighbours in a row. ``misplaced_mm`` holds, row by row, by how much each disc
    missed its place (x, y) when it was made; empty for an exact print.
    """

    columns: int
    rows: int
    pitch_mm: float
    diameter_mm: float
    is_asymmetric: bool = False
    is_light_on_dark: bool = False
    margin_mm: float | None = None
    misplaced_mm: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if len(self.misplaced_mm) not in (0, self.columns * self.rows):
            raise InputError(
                f"{len(self.misplaced_mm)} displacements for {self.columns * self.rows} discs"
            )

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) centres, row by row."""
        step = self._step_mm
        marks = [
            (column * step + self._row_shift_mm(row), row * self.pitch_mm, 0.0)
            for row in range(self.rows)
            for column in range(self.columns)
        ]
        centres = np.array(marks)
        centres[:, :2] += self._shifts_mm
        return centres

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        """One pitch around the outermost centres unless ``margin_mm`` says otherwise."""
        margin = self.pitch_mm if self.margin_mm is None else self.margin_mm
        right = (self.columns - 1) * self._step_mm + (self.pitch_mm if self.is_asymmetric else 0.0)
        return -margin, -margin, right + margin, (self.rows - 1) * self.pitch_mm + margin

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Tell the tone: inside a disc or not."""
        is_inside = self._radius_squared(x_mm, y_mm) < 0.25 * self.diameter_mm**2
        return is_inside if self.is_light_on_dark else ~is_inside

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Distance to the rim of the disc in whose cell the point lies."""
        return np.abs(np.sqrt(self._radius_squared(x_mm, y_mm)) - 0.5 * self.diameter_mm)

    @property
    def _step_mm(self) -> float:
        return (2.0 if self.is_asymmetric else 1.0) * self.pitch_mm

    def _row_shift_mm(self, row: int) -> float:
        return self.pitch_mm if self.is_asymmetric and row % 2 else 0.0

    def _radius_squared(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        row = np.clip(np.rint(y_mm / self.pitch_mm), 0, self.rows - 1)
        shift = self.pitch_mm * (row % 2) if self.is_asymmetric else 0.0
        column = np.clip(np.rint((x_mm - shift) / self._step_mm), 0, self.columns - 1)
        dx = x_mm - shift - column * self._step_mm
        dy = y_mm - row * self.pitch_mm
        if self.misplaced_mm:
            missed = self._shifts_mm[(row * self.columns + column).astype(np.int64)]
            dx, dy = dx - missed[..., 0], dy - missed[..., 1]
        return np.asarray(dx * dx + dy * dy)

    @property
    def _shifts_mm(self) -> FloatArray:
        if not self.misplaced_mm:
            return np.zeros((self.columns * self.rows, 2))
        return np.array(self.misplaced_mm)


@dataclass(frozen=True, slots=True)
class Substrate:
    """What a print is made on: paper in which light spreads, a board that is bowed.

    Parameters
    ----------
    spread_mm
        Length over which light that enters the paper fades sideways. It darkens the paper beside
        the ink more than it brightens the ink, so that an edge is no error function (optical dot
        gain; Yule and Nielsen, TAGA Proc. 1951).
    ink
        Part of the light that passes the ink once.
    bow_mm
        By how much the middle stands out, away from the viewer, over the two ends along x and
        along y: a parabola each.
    """

    spread_mm: float = 0.0
    ink: float = 0.3
    bow_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.spread_mm < 0.0 or not 0.0 <= self.ink < 1.0:
            raise InputError("light spreads over a positive length, under ink that is not clear")

    @property
    def reach_mm(self) -> float:
        """Distance from an edge beyond which the tones are pure."""
        return _SPREAD_REACH * self.spread_mm

    def reflectance(self, is_light: BoolArray, edge_mm: FloatArray) -> FloatArray:
        """Share (N,) of the light tone at a distance (N,) from a straight edge of tone (N,).

        Light passes the print, spreads in the paper by ``exp(-|x| / spread)`` and passes the print
        again; it is scaled so that the pure tones are 0 and 1.
        """
        if self.spread_mm == 0.0:
            return is_light.astype(np.float64)
        fading = 0.5 * np.exp(-edge_mm / self.spread_mm) / (1.0 + self.ink)
        return np.where(is_light, 1.0 - fading, self.ink * fading)

    def height_mm(self, pattern: FlatPattern, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Place (N,) of the print along the board's z axis."""
        along_x, along_y = _from_middle(pattern, x_mm, y_mm)
        bow_x, bow_y = self.bow_mm
        return np.asarray(bow_x * (1.0 - along_x**2) + bow_y * (1.0 - along_y**2))

    def slopes(
        self, pattern: FlatPattern, x_mm: FloatArray, y_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Change (N,) of the height with x and with y."""
        x_min, y_min, x_max, y_max = pattern.extent_board_mm
        along_x, along_y = _from_middle(pattern, x_mm, y_mm)
        bow_x, bow_y = self.bow_mm
        return -4.0 * bow_x * along_x / (x_max - x_min), -4.0 * bow_y * along_y / (y_max - y_min)


_SPREAD_REACH = 6.0
_BOW_STEPS = 4
FLAT = Substrate()


def _from_middle(
    pattern: FlatPattern, x_mm: FloatArray, y_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Places along x and y, from -1 to 1 on the print."""
    x_min, y_min, x_max, y_max = pattern.extent_board_mm
    return (
        (2.0 * x_mm - x_min - x_max) / (x_max - x_min),
        (2.0 * y_mm - y_min - y_max) / (y_max - y_min),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PrintedBoard:
    """A print somewhere in the scene, seen from its front only.

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
    substrate
        Paper and bow.
    """

    pattern: FlatPattern
    sensor_from_board: Pose[Sensor, Board]
    light: float = 0.85
    dark: float = 0.08
    edge_mm: float = 0.1
    substrate: Substrate = FLAT

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        normal = -self.sensor_from_board.rotation[:, 2]
        along = directions @ normal
        height = (origins_mm - self.sensor_from_board.translation_mm) @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where((along < 0.0) & (height > 0.0), -height / along, np.nan)
        points = self._on_board(origins_mm + distance[:, None] * directions)
        if any(self.substrate.bow_mm):
            for _ in range(_BOW_STEPS):
                height = self.substrate.height_mm(self.pattern, points[:, 0], points[:, 1])
                distance = distance - (height - points[:, 2]) / along
                points = self._on_board(origins_mm + distance[:, None] * directions)
        return np.where(self._is_on_print(points), distance, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        rotation = self.sensor_from_board.rotation
        if not any(self.substrate.bow_mm):
            return np.broadcast_to(-rotation[:, 2], points_mm.shape)
        board = self._on_board(points_mm)
        slope_x, slope_y = self.substrate.slopes(self.pattern, board[:, 0], board[:, 1])
        away = np.stack([slope_x, slope_y, -np.ones(len(board))], axis=1)
        return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True) @ rotation.T)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        board = self._on_board(points_mm)
        x, y = board[:, 0], board[:, 1]
        is_light, edge = self.pattern.is_light(x, y), self.pattern.edge_distance_mm(x, y)
        if self.substrate.spread_mm > self.edge_mm:
            share = self.substrate.reflectance(is_light, edge)
        else:
            share = np.clip(0.5 + np.where(is_light, edge, -edge) / self.edge_mm, 0.0, 1.0)
        albedo = self.dark + (self.light - self.dark) * share
        return np.repeat(albedo[:, None], 3, axis=1)

    def _on_board(self, points_mm: FloatArray) -> FloatArray:
        pose = self.sensor_from_board
        return np.asarray((points_mm - pose.translation_mm) @ pose.rotation)

    def _is_on_print(self, board_mm: FloatArray) -> BoolArray:
        x_min, y_min, x_max, y_max = self.pattern.extent_board_mm
        x, y = board_mm[:, 0], board_mm[:, 1]
        return np.asarray((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max))


_COARSE_STEP_PX = 16
_CHUNK = 1_000
_BLUR_REACH = 6.0
_RIM_STEPS = 24
_KNOT_STEP_PX = 8
_KNOT_TOLERANCE = 1e-9


def print_reflectance(
    board: PrintedBoard, camera: RenderCamera, surround: float = 1.0
) -> NDArray[np.float32]:
    """(H, W) part of the light tone in each pixel, blurred by the lens.

    ``surround`` is that part beyond the print.

    Raises
    ------
    InputError
        If the camera looks at the back of the print.
    """
    return _reflectance(_BoardView.of(board, camera), surround, PixelBox.of(camera))


def _reflectance(view: _BoardView, surround: float, box: PixelBox) -> NDArray[np.float32]:
    """As `print_reflectance`, of the pixels of a box."""
    camera, pattern = view.camera, view.board.pattern
    if isinstance(pattern, CirclePattern) and view.board.substrate == FLAT:
        is_endless = surround == float(not pattern.is_light_on_dark)
        if is_endless:
            return _discs(camera, pattern, view, box)
    fine = _fine_reflectance(view, surround)
    whole = _bin(blur_image(fine, SUBPIXELS * camera.blur_sigma_px))
    return np.ascontiguousarray(whole[box.within(PixelBox.of(camera))])


def _discs(
    camera: RenderCamera, pattern: CirclePattern, view: _BoardView, box: PixelBox
) -> NDArray[np.float32]:
    """As `_reflectance`, disc by disc, of a print whose ground goes on beyond its border."""
    tone = np.full(box.shape, not pattern.is_light_on_dark, np.float32)
    join = np.add if pattern.is_light_on_dark else np.subtract
    margin = int(np.ceil(_BLUR_REACH * camera.blur_sigma_px)) + 2
    lens, knots_x, knots_y = _lens_knots(camera)
    angle = 2.0 * np.pi * np.arange(_RIM_STEPS) / _RIM_STEPS
    radius = 0.5 * pattern.diameter_mm
    rim = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(_RIM_STEPS)], axis=1)
    centres = pattern.marks_board_mm
    rims = view.project((centres[:, None, :] + rim).reshape(-1, 3)).reshape(-1, _RIM_STEPS, 2)
    kernel = blur_kernel(SUBPIXELS * camera.blur_sigma_px)
    for centre, pixels in zip(centres, rims, strict=True):
        if not np.isfinite(pixels).all():
            continue
        own = PixelBox.around(pixels, margin, camera)
        height, width = own.shape
        inside = own.cut(box)
        if inside.is_empty:
            continue
        cells = np.zeros((SUBPIXELS * height, SUBPIXELS * width), np.float32)
        disc = np.array([centre[0], centre[1], radius])
        disc_cells(disc, own.left, own.top, lens, knots_x, knots_y, view.board_from_ray, cells)
        blurred = cv2.sepFilter2D(cells, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        cover = _bin(np.asarray(blurred, dtype=np.float32))
        part = tone[inside.within(box)]
        join(part, cover[inside.within(own)], out=part)
    return tone


@lru_cache(maxsize=8)
def _lens_knots(camera: RenderCamera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(12,) numbers of a lens for `disc_cells`, and (K, L) x and y of its knots' rays."""
    first = -_KNOT_STEP_PX
    u = np.arange(first, camera.width_px + 2 * _KNOT_STEP_PX, _KNOT_STEP_PX, dtype=np.float64)
    v = np.arange(first, camera.height_px + 2 * _KNOT_STEP_PX, _KNOT_STEP_PX, dtype=np.float64)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1), _KNOT_TOLERANCE)
    lens = [*camera.numbers, _KNOT_STEP_PX, first, first]
    x, y = (np.ascontiguousarray(rays[..., k]) for k in (0, 1))
    return np.array(lens), x, y


def _fine_reflectance(view: _BoardView, surround: float) -> NDArray[np.float32]:
    camera, pattern = view.camera, view.board.pattern
    x, y = view.coarse_mm()
    reach_mm = _reach_mm(x, y)
    beyond_mm = _beyond_border_mm(pattern, x, y)
    is_on_print = beyond_mm <= 0.0
    near_edge = np.abs(beyond_mm) < reach_mm
    edge_mm = pattern.edge_distance_mm(x[is_on_print], y[is_on_print])
    near_edge[is_on_print] |= edge_mm < reach_mm
    in_halo = np.zeros_like(near_edge)
    in_halo[is_on_print] = edge_mm < reach_mm + view.board.substrate.reach_mm
    tone = np.full(x.shape, surround, dtype=np.float32)
    tone[is_on_print] = pattern.is_light(x[is_on_print], y[is_on_print])
    size = (SUBPIXELS * camera.width_px, SUBPIXELS * camera.height_px)
    fine = np.asarray(cv2.resize(tone, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)
    for chosen, samples in ((near_edge, SAMPLES), (in_halo & ~near_edge, 1)):
        rows, columns = (index.astype(np.int64) for index in np.nonzero(chosen))
        chunk = _CHUNK * (SAMPLES // samples) ** 2
        for start in range(0, len(rows), chunk):
            v, u = rows[start : start + chunk], columns[start : start + chunk]
            cells = _sample(view, np.stack([u, v], axis=-1), samples, surround)
            for b in range(SUBPIXELS):
                for a in range(SUBPIXELS):
                    fine[SUBPIXELS * v + b, SUBPIXELS * u + a] = cells[:, b, a]
    return fine


def _sample(
    view: _BoardView, pixels_px: IntArray, samples: int, surround: float
) -> NDArray[np.float32]:
    """Mean reflectance (N, SUBPIXELS, SUBPIXELS) of the fine cells (row, column) of pixels (N, 2).

    Each cell has ``samples`` x ``samples`` samples.
    """
    centre, d_du, d_dv = view.linearised_mm(pixels_px.astype(np.float64))
    n = SUBPIXELS * samples
    offset = (np.arange(n) + 0.5) / n - 0.5
    step_u = d_du[:, :, None] * offset
    step_v = d_dv[:, :, None] * offset
    points = centre[:, :, None, None] + step_v[:, :, :, None] + step_u[:, :, None, :]
    tones = _tones(view.board, points[:, 0], points[:, 1], surround)
    cells = tones.reshape(-1, SUBPIXELS, samples, SUBPIXELS, samples).mean(axis=(2, 4))
    return np.asarray(cells, dtype=np.float32)


def _tones(
    board: PrintedBoard, x: FloatArray, y: FloatArray, surround: float
) -> NDArray[np.float32]:
    light = board.pattern.is_light(x, y)
    if board.substrate.spread_mm > 0.0:
        edge_mm = board.pattern.edge_distance_mm(x, y)
        tones = board.substrate.reflectance(light, edge_mm).astype(np.float32)
    else:
        tones = light.astype(np.float32)
    return np.where(_beyond_border_mm(board.pattern, x, y) <= 0.0, tones, np.float32(surround))


def _beyond_border_mm(pattern: FlatPattern, x: FloatArray, y: FloatArray) -> FloatArray:
    """Distance past the print's border, negative on the print."""
    x_min, y_min, x_max, y_max = pattern.extent_board_mm
    beyond_x = np.maximum(x_min - x, x - x_max)
    beyond_y = np.maximum(y_min - y, y - y_max)
    return np.maximum(beyond_x, beyond_y)


def _reach_mm(x: FloatArray, y: FloatArray) -> float:
    """Longest way on the board, mm, from a pixel's centre to its corner, with a small margin."""
    along_u = np.hypot(np.diff(x[::4], axis=1)[:, ::4], np.diff(y[::4], axis=1)[:, ::4]).max()
    along_v = np.hypot(np.diff(x[:, ::4], axis=0)[::4], np.diff(y[:, ::4], axis=0)[::4]).max()
    return 1.05 * 0.5 * float(along_u + along_v)


def _bin(fine: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width = fine.shape[0] // SUBPIXELS, fine.shape[1] // SUBPIXELS
    binned = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(binned, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _BoardView:
    """Where pixels of a camera meet a board."""

    board: PrintedBoard
    camera: RenderCamera
    board_from_ray: FloatArray

    @staticmethod
    def of(board: PrintedBoard, camera: RenderCamera) -> _BoardView:
        r, t = board.sensor_from_board.rotation, board.sensor_from_board.translation_mm
        if float(r[:, 2] @ t) <= 0.0:
            raise InputError(
                "the camera looks at the back of the print",
                remedy="turn the board: its z axis points away from the camera",
            )
        return _BoardView(board, camera, np.linalg.inv(np.column_stack([r[:, 0], r[:, 1], t])))

    def project(self, points_board_mm: FloatArray) -> FloatArray:
        """(N, 2) pixels of points (N, 3) of the board; NaN behind the camera."""
        return self.camera.project(self.board.sensor_from_board.apply(points_board_mm))

    def exact_mm(self, pixels_px: FloatArray) -> FloatArray:
        """(..., 2) board coordinates seen by (..., 2) pixels; far away if the ray misses."""
        rays = self.camera.rays(pixels_px)
        h = rays @ self.board_from_ray[:, :2].T + self.board_from_ray[:, 2]
        # The third component is 1 / depth: rays that never meet the plane see the surround.
        flat = np.asarray(h[..., :2] / np.maximum(h[..., 2:], 1e-9))
        if not any(self.board.substrate.bow_mm):
            return flat
        return self._on_bow_mm(flat)

    def _on_bow_mm(self, flat_mm: FloatArray) -> FloatArray:
        """Where rays that meet the flat board at (..., 2) meet the bowed one."""
        pattern, pose = self.board.pattern, self.board.sensor_from_board
        x_min, y_min, x_max, y_max = pattern.extent_board_mm
        size = np.array([x_max - x_min, y_max - y_min])
        low, high = np.array([x_min, y_min]) - size, np.array([x_max, y_max]) + size
        eye = -pose.rotation.T @ pose.translation_mm
        met = flat_mm
        for _ in range(_BOW_STEPS):
            # far beyond the print the parabola is not followed
            near = np.clip(met, low, high)
            height = self.board.substrate.height_mm(pattern, near[..., 0], near[..., 1])
            met = flat_mm + (height / eye[2])[..., None] * (eye[:2] - flat_mm)
        return np.asarray(met)

    def coarse_mm(self) -> tuple[FloatArray, FloatArray]:
        """Board coordinates (H, W) of every pixel, by linear interpolation on a coarse grid."""
        u, weights_u = _interpolation(self.camera.width_px)
        v, weights_v = _interpolation(self.camera.height_px)
        grid = self.exact_mm(np.stack(np.meshgrid(u, v), axis=-1))
        x = weights_v @ grid[..., 0].astype(np.float32) @ weights_u.T
        y = weights_v @ grid[..., 1].astype(np.float32) @ weights_u.T
        return x, y

    def linearised_mm(self, pixels_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(N, 2) board coordinates of pixel centres, and their change per pixel in u and v."""
        half_u, half_v = np.array([0.5, 0.0]), np.array([0.0, 0.5])
        d_du = self.exact_mm(pixels_px + half_u) - self.exact_mm(pixels_px - half_u)
        d_dv = self.exact_mm(pixels_px + half_v) - self.exact_mm(pixels_px - half_v)
        return self.exact_mm(pixels_px), d_du, d_dv


def _interpolation(size_px: int) -> tuple[FloatArray, FloatArray]:
    """Knots (K,) over 0..size and linear weights (size, K) that reach every pixel."""
    knots = np.arange(0, size_px + _COARSE_STEP_PX, _COARSE_STEP_PX, dtype=np.float64)
    where = np.arange(size_px)[:, None]
    weights = np.maximum(0.0, 1.0 - np.abs(where - knots) / _COARSE_STEP_PX)
    return knots, weights.astype(np.float32)


_OUTLINE_STEPS = 24
_OUTLINE_BITS = 6


def render_board(
    board: PrintedBoard, camera: RenderCamera, lamp: RoomLight, background: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Render a board under room light over a background (H, W), which is written over.

    Result and background are parts of full scale; the board is blurred by the lens, without noise.
    """
    view = _BoardView.of(board, camera)
    outline, kernel = outline_px(board, camera), blur_kernel(camera.blur_sigma_px)
    thickness = len(kernel) + 5
    box = PixelBox.around(outline, 2 * thickness, camera)
    if box.is_empty:
        return background
    mask, rim = np.zeros(box.shape, np.uint8), np.zeros(box.shape, np.uint8)
    corners = np.rint((outline - box.corner_px) * (1 << _OUTLINE_BITS)).astype(np.int32)
    cv2.fillPoly(mask, [corners], (255,), lineType=cv2.LINE_AA, shift=_OUTLINE_BITS)
    cv2.polylines(rim, [corners], True, (1,), thickness=thickness, shift=_OUTLINE_BITS)
    tone, lit = _reflectance(view, 1.0, box), _lamp_on_board(board, camera, lamp)
    lay_over(background, box.corner_px, tone, lit, mask, rim, kernel, board.dark, board.light)
    return background


def outline_px(board: PrintedBoard, camera: RenderCamera) -> FloatArray:
    """(N, 2) pixels along the board's rim."""
    x_min, y_min, x_max, y_max = board.pattern.extent_board_mm
    corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])
    share = (np.arange(_OUTLINE_STEPS) / _OUTLINE_STEPS)[:, None]
    sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    rim = np.concatenate(sides)
    pose = board.sensor_from_board
    return camera.project(rim @ pose.rotation[:, :2].T + pose.translation_mm)


def _lamp_on_board(
    board: PrintedBoard, camera: RenderCamera, lamp: RoomLight
) -> NDArray[np.float32]:
    """(H, W) light on the board's plane, from a coarse grid: it changes slowly."""
    pose, up = board.sensor_from_board, -board.sensor_from_board.rotation[:, 2]
    rays, (height, width) = _coarse_rays(camera)
    with np.errstate(divide="ignore"):
        away = (pose.translation_mm @ up) / (rays @ up)
    to_lamp = lamp.position_mm - np.where(away > 0.0, away, 0.0)[:, None] * rays
    facing = np.maximum(to_lamp @ up / np.linalg.norm(to_lamp, axis=1), 0.0)
    light = lamp.even * (2.0 + up @ np.asarray(lamp.up)) / 3.0 + lamp.direct * facing
    coarse = np.where(away > 0.0, light, 0.0).reshape(height, width).astype(np.float32)
    size = (camera.width_px, camera.height_px)
    fine = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine, dtype=np.float32)


@lru_cache(maxsize=8)
def _coarse_rays(camera: RenderCamera) -> tuple[FloatArray, tuple[int, int]]:
    """(N, 3) unit rays of the middles of coarse cells, and how many there are down and across."""
    shape = (camera.height_px // _COARSE_STEP_PX, camera.width_px // _COARSE_STEP_PX)
    rows, columns = np.indices(shape)
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    return camera_rays(camera, (cells + 0.5) * _COARSE_STEP_PX - 0.5, _KNOT_TOLERANCE), shape
