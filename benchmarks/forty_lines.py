# SPDX-License-Identifier: Apache-2.0
"""The competitor of `real_lasers.py`: a laser calibration of forty lines of OpenCV and numpy.

It is what a user who knows OpenCV writes in an hour, and no more: chessboard or circle grid,
`calibrateCamera`, one colour channel or difference of channels an image, the peak of every row or
column inside the board, a grey centroid, a RANSAC line, the board's plane, a plane through all
points. Nothing here is of armscan. Frames and units: camera frame, mm, px (pixel centre = 0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

Array = Any
"""OpenCV's own types are too loose to be more exact here."""

MIXES = {  # blue, green, red
    "G": (0, 1, 0),
    "R": (0, 0, 1),
    "B": (1, 0, 0),
    "G-R": (0, 1, -1),
    "R-G": (0, -1, 1),
    "G-(R+B)/2": (-0.5, 1, -0.5),
    "R-(G+B)/2": (-0.5, -0.5, 1),
    "B-(G+R)/2": (1, -0.5, -0.5),
}
LINE_PX = 1.5
DRAWS = 300


@dataclass(frozen=True)
class Board:
    """A flat target: ``points_mm`` (N, 2) in the order in which OpenCV finds them."""

    kind: str
    columns: int
    rows: int
    points_mm: Array

    @staticmethod
    def of(specification: str) -> Board:
        """Read ``chessboard:8x6:40`` or ``circle-grid:7x7:37.5``."""
        kind, size, pitch = specification.split(":")
        columns, rows = (int(n) for n in size.split("x"))
        y, x = np.mgrid[:rows, :columns]
        points = np.column_stack([x.ravel(), y.ravel()]) * float(pitch)
        return Board(kind, columns, rows, points)

    def object_points(self) -> Array:
        """(N, 3) float32, as OpenCV wants them."""
        return np.column_stack([self.points_mm, np.zeros(len(self.points_mm))]).astype(np.float32)


def find_board(image: Array, board: Board) -> Array | None:
    """(N, 2) points of the target in px, the first towards the image's top left, or None."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    size = (board.columns, board.rows)
    if board.kind == "circle-grid":
        found, points = cv2.findCirclesGrid(grey, size)
        return upright(points) if found else None
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, points = cv2.findChessboardCornersSB(grey, size, flags=flags)
    if not found:
        found, points = cv2.findChessboardCorners(grey, size)
        if found:
            points = cv2.cornerSubPix(grey, points, (5, 5), (-1, -1), (3, 40, 0.001))
    return upright(points) if found else None


def upright(points: Array) -> Array:
    """The same points; the two ends of a target look alike."""
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    return points[::-1] if points[0].sum() > points[-1].sum() else points


def calibrate_camera(views: list[Array], board: Board, size: Any) -> tuple[float, Array, Array]:
    """Rms in px, camera matrix and OpenCV's five coefficients; once more without bad views."""
    target = board.object_points()
    for _ in range(2):
        pixels = [view.astype(np.float32).reshape(-1, 1, 2) for view in views]
        rms, matrix, distortion, rotations, translations = cv2.calibrateCamera(
            [target] * len(views), pixels, size, None, None
        )
        errors = [
            np.sqrt(np.mean((cv2.projectPoints(target, r, t, matrix, distortion)[0] - p) ** 2))
            for r, t, p in zip(rotations, translations, pixels, strict=True)
        ]
        limit = 3 * float(np.median(errors))
        views = [view for view, error in zip(views, errors, strict=True) if error < limit]
    return rms, matrix, distortion


def board_pose(view: Array, board: Board, matrix: Array, distortion: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) in mm of the board in the camera frame."""
    _, rotation, translation = cv2.solvePnP(board.object_points(), view, matrix, distortion)
    return cv2.Rodrigues(rotation)[0], translation.ravel()


def board_mask(pose: Any, board: Board, camera: Any, shape: Any, margin_mm: Any) -> Array:
    """Pixels of the board's plate: its points' rectangle and a margin left, top, right, bottom."""
    margins = np.array(margin_mm)
    low, high = board.points_mm.min(0) - margins[:2], board.points_mm.max(0) + margins[2:]
    u, v = np.meshgrid(np.linspace(0, 1, 12), np.linspace(0, 1, 12))
    grid = np.column_stack([u.ravel(), v.ravel()]) * (high - low) + low
    outline = cv2.convexHull(grid.astype(np.float32)).reshape(-1, 2)
    rotation, _ = cv2.Rodrigues(pose[0])
    corners = np.column_stack([outline, np.zeros(len(outline))])
    pixels, _ = cv2.projectPoints(corners, rotation, pose[1], *camera)
    pixels = np.clip(np.nan_to_num(pixels), -4 * shape[1], 4 * shape[1])
    mask = np.zeros(shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.int32(np.round(pixels.reshape(-1, 2)))], 1)
    return mask.astype(bool)


def signals(on: Array, off: Array | None) -> dict[str, Array]:
    """Candidates for the image in which the line is brightest."""
    light = on.astype(np.float32) - (0 if off is None else off.astype(np.float32))
    if light.ndim == 2 or np.ptp(light, axis=2).max() < 2:
        return {"grey": light if light.ndim == 2 else light[..., 1]}
    return {name: light @ np.float32(mix) for name, mix in MIXES.items()}


def peaks(signal: Array, mask: Array, n_lines: int) -> tuple[Array, Array]:
    """(N, 2) px: a peak a row, more for several lines, by grey centroid; (N,) height over noise."""
    inside = np.where(mask, signal, np.nan)
    rows = np.flatnonzero(mask.sum(1) > 10)
    if not len(rows):
        return np.zeros((0, 2)), np.zeros(0)
    level, noise = np.zeros(len(signal)), np.ones(len(signal))
    level[rows] = np.nanmedian(inside[rows], axis=1)
    noise[rows] += np.nanmedian(np.abs(inside[rows] - level[rows, None]), axis=1)
    light = np.where(mask, signal - level[:, None], 0.0).astype(np.float32)
    smooth = np.where(mask, cv2.GaussianBlur(light, (0, 0), 1.5), 0.0)
    top = smooth.max(1)
    width = np.median((light[rows] > 0.5 * top[rows, None]).sum(1)) / n_lines
    half = int(np.clip(width, 5, 25))
    if half > 5:
        smooth = np.where(mask, cv2.GaussianBlur(light, (0, 0), half / 3.0), 0.0)
        top = smooth.max(1)
    is_peak = smooth >= top[:, None]
    if n_lines > 1:
        is_peak = smooth == cv2.dilate(smooth, np.ones((1, 2 * half + 1), np.uint8))
        is_peak &= smooth > 0.3 * top[:, None]
    y, x = np.nonzero(is_peak & (smooth > 0) & mask)
    columns = np.clip(x[:, None] + np.arange(-half, half + 1), 0, signal.shape[1] - 1)
    window = light[y[:, None], columns]
    weight = np.clip(window - 0.25 * window.max(1, keepdims=True), 0, None)
    good = weight.sum(1) > 0
    centre = (weight * columns).sum(1)[good] / weight.sum(1)[good]
    return np.column_stack([centre, y[good]]), (smooth[y, x] / noise[y])[good]


def ransac_line(points: Array, random: np.random.Generator) -> Array:
    """(N,) which points lie on the best straight line."""
    first, second = points[random.integers(0, len(points), (2, DRAWS))]
    normal = np.column_stack([first[:, 1] - second[:, 1], second[:, 0] - first[:, 0]])
    length = np.hypot(*normal.T)
    normal = normal[length > 5] / length[length > 5, None]
    if not len(normal):
        return np.zeros(len(points), dtype=bool)
    offset = np.einsum("ij,ij->i", normal, first[length > 5])
    on_line = np.abs(normal @ points.T - offset[:, None]) < LINE_PX
    return np.asarray(on_line[on_line.sum(1).argmax()])


def lines_of(signal: Array, mask: Array, camera: Any, n_lines: int, corner: Array) -> Any:
    """How well straight lines stand out, and the points (M, 2) px of each from left to right."""
    best, found = 0.0, []
    for is_turned in (False, True):
        points, height = peaks(*((signal.T, mask.T) if is_turned else (signal, mask)), n_lines)
        points = (points[:, ::-1] if is_turned else points) + corner
        lines, random, score = [], np.random.default_rng(0), 0.0
        for _ in range(n_lines):
            if len(points) < 20:
                break
            straight = cv2.undistortPoints(points, *camera, P=camera[0]).reshape(-1, 2)
            on_line = ransac_line(straight, random)
            if on_line.sum() >= 20:
                lines.append(points[on_line])
                score += on_line.sum() * min(float(np.median(height[on_line])), 10.0)
            points, height = points[~on_line], height[~on_line]
        if score > best:
            axis = 1 if is_turned else 0
            best, found = score, sorted(lines, key=lambda line: float(line[:, axis].mean()))
    return best, found


def find_lines(on: Array, off: Array | None, mask: Array, camera: Any, n_lines: int) -> Any:
    """Name of the best channel, and its lines; a line must hold in 30 % of its rows."""
    best: tuple[float, str, list[Array]] = (0.0, "none", [])
    y, x = np.nonzero(mask)
    if not len(y):
        return "none", []
    top, left = int(y.min()), int(x.min())
    crop = slice(top, int(y.max()) + 1), slice(left, int(x.max()) + 1)
    for name, signal in signals(on[crop], None if off is None else off[crop]).items():
        score, lines = lines_of(signal, mask[crop], camera, n_lines, np.array([left, top]))
        if score > best[0]:
            best = (score, name, lines)
    span = min(mask.any(1).sum(), mask.any(0).sum())
    return best[1], [line for line in best[2] if len(line) >= max(20, 0.3 * span)]


def rays(pixels: Array, camera: Any) -> Array:
    """(N, 3) rays ``x, y, 1`` of pixels."""
    xy = cv2.undistortPoints(pixels.reshape(-1, 1, 2).astype(float), *camera).reshape(-1, 2)
    return np.column_stack([xy, np.ones(len(xy))])


def meet_plane(directions: Array, plane: Array) -> Array:
    """(N, 3) points where rays meet ``n.p + d = 0``."""
    return directions * (-plane[3] / (directions @ plane[:3]))[:, None]


def plane_of_pose(pose: Any) -> Array:
    """(4,) the board's plane."""
    normal = pose[0][:, 2]
    return np.array([*normal, -normal @ pose[1]])


def fit_plane(points: Array) -> tuple[Array, Array]:
    """(4,) plane through points by SVD with 3-sigma rejection, and (N,) which were kept."""
    keep = np.ones(len(points), dtype=bool)
    plane = np.zeros(4)
    for _ in range(20):
        middle = points[keep].mean(0)
        normal = np.linalg.svd(points[keep] - middle, full_matrices=False)[2][2]
        plane = np.array([*normal, -normal @ middle])
        distance = np.abs(points @ normal + plane[3])
        sigma = 1.4826 * np.median(distance[keep])
        now = distance < 3 * max(sigma, 1e-6)
        if (now == keep).all():
            break
        keep = now
    return plane, keep
