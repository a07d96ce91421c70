# SPDX-License-Identifier: Apache-2.0
"""Cramer-Rao bounds of a drawn instrument's calibrations, from the true variances.

The unknowns are all that is not known: cameras, the boards' poses, where the target's points truly
are (known to the print's own error), the light. Derivatives are differences of the rig's optics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.least_squares import pseudo_inverse
from rigs.instruments import Instrument, Light, Placement, in_camera, lens_of

STEPS = np.array([1e-2, 1e-2, 1e-2, 1e-2, 1e-6, 1e-6, 1e-7, 1e-7, 1e-6])
POSE_STEPS = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
EXACT_PRINT_MM = 1e-9


@dataclass(frozen=True)
class SeenPoints:
    """Which target points one camera saw on one board."""

    place: Placement
    side: int
    index: IntArray


@dataclass(frozen=True)
class SeenLine:
    """Pixels (N, 2) and normals (N, 2) of one line on one board in one camera."""

    place: Placement
    side: int
    pixels: FloatArray
    normals: FloatArray
    light: int


def moved_head(made: Instrument, step: FloatArray) -> Instrument:
    """The cameras with a step (9,) or (24,): left, right, turn and shift of the right one."""
    head = replace(made, left=made.left.moved(step[:9]))
    if len(step) == 9 or made.right is None or made.right_from_left is None:
        return head
    pose = made.right_from_left
    turned = Rotation.from_rotvec(step[18:21]).as_matrix() @ pose.rotation
    return replace(
        head,
        right=made.right.moved(step[9:18]),
        right_from_left=Placement(turned, pose.shift + step[21:]),
    )


def moved_place(place: Placement, step: FloatArray) -> Placement:
    """A pose with a step (6,): turn from the left, then shift."""
    turned = Rotation.from_rotvec(step[:3]).as_matrix() @ place.rotation
    return Placement(turned, place.shift + step[3:])


def shared_steps(n: int) -> FloatArray:
    """(n,) steps of the differences, for 9 or 24 parameters."""
    return STEPS if n == 9 else np.concatenate([STEPS, STEPS, POSE_STEPS])


def camera_information(made: Instrument, seen: Sequence[SeenPoints], n_shared: int) -> FloatArray:
    """(S + 2 M, S + 2 M) information of views on cameras and target points, poses eliminated."""
    m = len(made.target.stated)
    sigma = float(made.target.missed[:, :2].std()) if np.any(made.target.missed) else 0.0
    total = np.zeros((n_shared + 2 * m, n_shared + 2 * m))
    total[n_shared:, n_shared:] = np.eye(2 * m) / max(sigma, EXACT_PRINT_MM) ** 2
    return total + _boards(made, seen, n_shared, n_shared + 2 * m)


N_TERMS = 8
"""Of a light: plane and bow."""


def bound(information: FloatArray, n: int) -> FloatArray:
    """(n, n) smallest covariance of the first n unknowns."""
    scale = 1.0 / np.sqrt(np.diag(information))
    scaled = information * np.outer(scale, scale)
    inverse = pseudo_inverse(scaled, 1e-15)
    return np.asarray((inverse * np.outer(scale, scale))[:n, :n])


def sheet_information(
    made: Instrument,
    cameras: FloatArray,
    seen: Sequence[SeenPoints],
    lines: Sequence[SeenLine],
    n_shared: int,
) -> FloatArray:
    """Information on cameras, target points and the shape of each light.

    ``cameras`` is that of `camera_information`; `N_TERMS` parameters of each light (`light_terms`)
    follow.
    """
    size = len(cameras) + N_TERMS * len(made.lights)
    total = np.zeros((size, size))
    total[: len(cameras), : len(cameras)] = cameras
    places = {id(view.place): view.place for view in seen}
    for key in places:
        views = [view for view in seen if id(view.place) == key]
        rows = [_view_rows(made, view, n_shared, size) for view in views]
        for line in lines:
            if id(line.place) == key:
                first = len(cameras) + N_TERMS * line.light
                of = slice(first, first + N_TERMS)
                rows.append(_line_rows(made, line, n_shared, size, of))
        total += _eliminated(rows)
    return total


def _boards(made: Instrument, seen: Sequence[SeenPoints], n_shared: int, size: int) -> FloatArray:
    total = np.zeros((size, size))
    for key in {id(view.place) for view in seen}:
        views = [view for view in seen if id(view.place) == key]
        total += _eliminated([_view_rows(made, view, n_shared, size) for view in views])
    return total


def _eliminated(rows: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Information of observations (N, size) after their board's own pose (N, 6) is eliminated."""
    shared = np.concatenate([one for one, _ in rows])
    pose = np.concatenate([one for _, one in rows]) * POSE_STEPS
    cross = pose.T @ shared
    return np.asarray(shared.T @ shared - cross.T @ np.linalg.solve(pose.T @ pose, cross))


def _view_rows(
    made: Instrument, view: SeenPoints, n_shared: int, size: int
) -> tuple[FloatArray, FloatArray]:
    board = made.target.made[view.index]

    def pixels(head: Instrument, place: Placement, points: FloatArray) -> FloatArray:
        there = in_camera(head, place.apply(points), view.side)
        return lens_of(head, view.side).project(there).ravel()

    shared = np.zeros((2 * len(board), size))
    for k, h in enumerate(shared_steps(n_shared)):
        step = np.zeros(n_shared)
        step[k] = h
        ahead = pixels(moved_head(made, step), view.place, board)
        shared[:, k] = (ahead - pixels(moved_head(made, -step), view.place, board)) / (2.0 * h)
    for axis in range(2):
        step = np.zeros(3)
        step[axis] = 1e-4
        ahead = pixels(made, view.place, board + step) - pixels(made, view.place, board - step)
        row = np.arange(2 * len(board))
        column = n_shared + 2 * np.repeat(view.index, 2) + axis
        shared[row, column] = ahead / 2e-4
    pose = np.zeros((2 * len(board), 6))
    for k, h in enumerate(POSE_STEPS):
        step = np.zeros(6)
        step[k] = h
        ahead = pixels(made, moved_place(view.place, step), board)
        back = pixels(made, moved_place(view.place, -step), board)
        pose[:, k] = (ahead - back) / (2.0 * h)
    return shared / made.target_px, pose / made.target_px


def light_terms(made: Instrument, light: Light, points: FloatArray, n: int) -> FloatArray:
    """(N, n) change of the height over a light's surface: plane, and what bends it."""
    half = 0.5 * made.field_mm
    middle = np.array([0.0, 0.0, made.stand_off_mm]) - light.source
    u = (points - light.source) @ light.across / half
    v = ((points - light.source) @ light.forward - middle @ light.forward) / half
    terms = [u, v, np.ones_like(u), u**2, u * v, v**2, u**3, u**2 * v]
    return np.asarray(np.stack(terms[:n], axis=1))


def _line_rows(
    made: Instrument, line: SeenLine, n_shared: int, size: int, of: slice
) -> tuple[FloatArray, FloatArray]:
    light = made.lights[line.light]

    def height(head: Instrument, place: Placement, pixels: FloatArray) -> FloatArray:
        return light.height(_on_board(head, line.side, place, pixels))

    here = height(made, line.place, line.pixels)
    across = (height(made, line.place, line.pixels + 1e-3 * line.normals) - here) / 1e-3
    shared = np.zeros((len(here), size))
    for k, h in enumerate(shared_steps(n_shared)):
        step = np.zeros(n_shared)
        step[k] = h
        shared[:, k] = (height(moved_head(made, step), line.place, line.pixels) - here) / h
    pose = np.zeros((len(here), 6))
    for k, h in enumerate(POSE_STEPS):
        step = np.zeros(6)
        step[k] = h
        pose[:, k] = (height(made, moved_place(line.place, step), line.pixels) - here) / h
    points = _on_board(made, line.side, line.place, line.pixels)
    shared[:, of] = -light_terms(made, light, points, of.stop - of.start)
    weight = 1.0 / (across * made.stripe_px)
    return shared * weight[:, None], pose * weight[:, None]


def _on_board(made: Instrument, side: int, place: Placement, pixels: FloatArray) -> FloatArray:
    """(N, 3) where rays meet the plane of a board, in the left frame."""
    rays, origin = lens_of(made, side).rays(pixels), np.zeros(3)
    if side and made.right_from_left is not None:
        rays = rays @ made.right_from_left.rotation
        origin = -made.right_from_left.rotation.T @ made.right_from_left.shift
    normal = place.rotation[:, 2]
    distance = ((place.shift - origin) @ normal) / (rays @ normal)
    return np.asarray(origin + distance[:, None] * rays)
