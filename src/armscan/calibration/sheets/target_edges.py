# SPDX-License-Identifier: Apache-2.0
"""Where a target's print changes between dark and light, and which stripe points lie along it.

A stripe that runs along such an edge is brighter on the one side, and every method of finding its
centre is pulled there. The edges are known, so such points can be told without looking at their
residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.camera import CameraModel
from armscan.records.profile import Profile
from armscan.vision.targets.target import (
    Charuco,
    Chessboard,
    CircleEdges,
    CircleGrid,
    Target,
    TargetView,
)

REACH_WIDTHS = 3.0
"""An edge pulls a point that is nearer to it than this many of the stripe's widths (sigma of its
cross-section): beyond three sigma there is no light."""
LARGEST_ANGLE_DEG = 75.0
"""Edges that are turned further from the stripe cross it, and pull it to neither side."""
SAMPLE_PX = 1.0
"""Spacing in the image of the points that stand for a straight edge."""
COARSE = 64
"""Points by which the part of an edge that is seen is found."""
MARGIN_PX = 20.0
"""Edges are followed this far outside the image."""
SAME_RAY = 1e-6
"""A point is the camera's own if its ray leads back to it this well, in the plane at distance 1."""
MIN_RIM_POINTS = 8
"""With fewer, the shape of a circle's rim is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetEdges:
    """Points of the target's reflectance edges in the image.

    ``points_px`` (K, 2) full-sensor pixels, about a pixel apart along an edge; ``directions_px``
    (K, 2) unit vectors along the edge, whose sign does not matter.
    """

    points_px: FloatArray
    directions_px: FloatArray


def find_target_edges(
    view: TargetView, target: Target, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> TargetEdges | None:
    """Edges of the target in the image in which it was found; None if they are not known.

    Circles have the rims that were found. The squares of a chessboard and of a ChArUco board are
    projected, the outermost ones included. The markers inside a ChArUco board's squares are left
    out: their cells are so many that hardly a point would be left.
    """
    if isinstance(target, CircleGrid):
        return None if view.edges is None else _rims(view.edges)
    return _borders(target, sensor_from_board, camera)


def runs_along_edge(profile: Profile, edges: TargetEdges) -> BoolArray:
    """(N,) True for stripe points near an edge that runs along the stripe."""
    near = np.zeros(len(profile), dtype=np.bool_)
    if len(edges.points_px) == 0 or len(profile) == 0:
        return near
    tree = cKDTree(edges.points_px)
    found = tree.query_ball_point(profile.points_px, REACH_WIDTHS * profile.width_px)
    row = np.repeat(np.arange(len(profile)), [len(neighbours) for neighbours in found])
    edge = np.concatenate([np.asarray(neighbours, dtype=np.int64) for neighbours in found])
    across = np.einsum("ni,ni->n", profile.normals_px[row], edges.directions_px[edge])
    near[row[np.abs(across) < np.sin(np.radians(LARGEST_ANGLE_DEG))]] = True
    return near


def _rims(edges: CircleEdges) -> TargetEdges:
    """Tangents of the rims, by the ellipse that has the rim points' second moments."""
    points, directions = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for circle in np.unique(edges.circle):
        rim = edges.points_px[edges.circle == circle]
        if len(rim) < MIN_RIM_POINTS:
            continue
        offset = rim - rim.mean(axis=0)
        normal = np.linalg.solve(offset.T @ offset / len(rim), offset.T).T
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        points.append(rim)
        directions.append(tangent / np.linalg.norm(tangent, axis=1)[:, None])
    return TargetEdges(np.concatenate(points), np.concatenate(directions))


def _borders(
    target: Chessboard | Charuco, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> TargetEdges:
    """Borders of all squares, corner to corner and one square beyond the inner corners."""
    corners = target.points_board_mm[:, :2]
    low = corners.min(axis=0) - target.square_mm
    high = corners.max(axis=0) + target.square_mm
    counts = np.rint((high - low) / target.square_mm).astype(int)
    x, y = (np.linspace(low[i], high[i], counts[i] + 1) for i in range(2))
    lines = [np.array([[value, low[1]], [value, high[1]]]) for value in x]
    lines += [np.array([[low[0], value], [high[0], value]]) for value in y]
    points, directions = [], []
    for ends in lines:
        image, is_seen = _image_of_line(ends, sensor_from_board, camera)
        step = np.gradient(image, axis=0)
        length = np.linalg.norm(step, axis=1)
        is_seen &= np.isfinite(length) & (length > 0.0)
        points.append(image[is_seen])
        directions.append(step[is_seen] / length[is_seen, None])
    return TargetEdges(np.concatenate(points), np.concatenate(directions))


def _image_of_line(
    ends_mm: FloatArray, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> tuple[FloatArray, BoolArray]:
    """(K, 2) pixels at most `SAMPLE_PX` apart along a straight line on the board, and (K,) where.

    Only the part of the line in and near the image is sampled finely. Not seen are points behind
    the camera, far outside the image, and beyond the lens model's fold: those the model throws
    back into the image, and the pixel's own ray does not lead to them.
    """

    def image(low: float, high: float, n: int) -> tuple[FloatArray, BoolArray]:
        t = np.linspace(low, high, n)[:, None]
        on_board = np.pad(ends_mm[0] + t * (ends_mm[1] - ends_mm[0]), ((0, 0), (0, 1)))
        points = on_board @ sensor_from_board.rotation.T + sensor_from_board.translation_mm
        q = camera.project(points)
        is_seen = camera.is_inside(q, -MARGIN_PX)
        xy, has_ray = camera.undistort(np.where(is_seen[:, None], q, 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            ideal = points[:, :2] / points[:, 2:]
            is_own = (np.abs(ideal - xy) < SAME_RAY).all(axis=1)
        return q, is_seen & has_ray & is_own

    coarse, is_seen = image(0.0, 1.0, COARSE)
    seen = np.flatnonzero(is_seen)
    if len(seen) == 0:
        return coarse, is_seen
    first, last = max(int(seen[0]) - 1, 0), min(int(seen[-1]) + 1, COARSE - 1)
    steps = np.linalg.norm(np.diff(coarse[is_seen], axis=0), axis=1)
    # A line that leaves the image may end within a step of the last point seen.
    length_px = float(steps.sum()) + 2.0 * float(steps.max(initial=SAMPLE_PX))
    n = max(int(np.ceil(length_px / SAMPLE_PX)), 2)
    return image(first / (COARSE - 1), last / (COARSE - 1), n)
