# SPDX-License-Identifier: Apache-2.0
"""Where a target's edges run along a stripe, by hand."""

import numpy as np
import pytest

from armscan.calibration.sheets import stripes_on_board
from armscan.calibration.sheets.stripes_on_board import (
    TargetEdges,
    find_target_edges,
    runs_along_edge,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.records.profile import Profile
from armscan.vision.targets.target import (
    Charuco,
    Chessboard,
    CircleEdges,
    CircleGrid,
    Target,
    TargetView,
)
from rigs.plain_scanner import plain_camera

CAMERA = plain_camera(1000.0, (500.0, 400.0), (1001, 801))
HERE: Pose[Sensor, Board] = Pose(np.eye(3), np.array([-50.0, -40.0, 500.0]))
"""A board square to the camera at 2 px/mm, its origin at pixel (400, 320)."""
WIDTH_PX = 1.5


def upright(x_px: float, low_px: float, high_px: float) -> Profile:
    """A vertical stripe with a point each pixel."""
    y = np.arange(low_px, high_px + 0.5)
    n = len(y)
    zeros = np.zeros(n, dtype=np.int64)
    return Profile(
        source="stripe.png",
        points_px=np.stack([np.full(n, x_px), y], axis=1),
        normals_px=np.tile([1.0, 0.0], (n, 1)),
        sigma_px=np.full(n, 0.1),
        width_px=np.full(n, WIDTH_PX),
        intensity=np.full(n, 100.0),
        flags=zeros,
        segment=zeros,
    )


def view_of(target: Target, rim_px: FloatArray | None = None) -> TargetView:
    board = target.points_board_mm
    edges = None
    if rim_px is not None:
        n = len(rim_px)
        edges = CircleEdges(
            points_px=rim_px, circle=np.zeros(n, dtype=np.int64), sigma_px=np.full(n, 0.02)
        )
    return TargetView(
        source="board.png",
        width_px=1001,
        height_px=801,
        point_index=np.arange(len(board)),
        points_px=CAMERA.project(board + HERE.translation_mm),
        covariance_px2=np.tile(0.01 * np.eye(2), (len(board), 1, 1)),
        points_board_mm=board,
        edges=edges,
    )


def edges_of(target: Target, rim_px: FloatArray | None = None) -> TargetEdges:
    edges = find_target_edges(view_of(target, rim_px), target, HERE, CAMERA)
    assert edges is not None
    return edges


def near_px(stripe: Profile, edges: TargetEdges) -> FloatArray:
    """The y of the points next to an edge along the stripe."""
    return np.asarray(stripe.points_px[runs_along_edge(stripe, edges), 1], dtype=np.float64)


def ellipse(half_x: float, half_y: float) -> tuple[FloatArray, FloatArray]:
    """Points evenly around an ellipse at (100, 100), and its tangents."""
    t = np.linspace(0.0, 2.0 * np.pi, 240, endpoint=False)
    points = 100.0 + np.stack([half_x * np.cos(t), half_y * np.sin(t)], axis=1)
    tangent = np.stack([-half_x * np.sin(t), half_y * np.cos(t)], axis=1)
    return points, tangent / np.linalg.norm(tangent, axis=1)[:, None]


def test_a_stripe_that_grazes_a_circle() -> None:
    """2 px outside a rim of 30 px, reach 4.5 px: within sqrt(34.5^2 - 32^2) = 12.9 px in y."""
    edges = edges_of(CircleGrid(3, 2, 10.0), ellipse(30.0, 30.0)[0])
    near = near_px(upright(132.0, 50.0, 150.0), edges)
    assert abs(near.min() - 87.1) < 1.0
    assert abs(near.max() - 112.9) < 1.0
    assert len(near) == np.ptp(near) + 1
    assert len(near_px(upright(134.6, 50.0, 150.0), edges)) == 0


def test_a_stripe_through_the_middle_of_a_circle_crosses_its_rim(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    edges = edges_of(CircleGrid(3, 2, 10.0), ellipse(30.0, 30.0)[0])
    assert len(near_px(upright(100.0, 50.0, 150.0), edges)) == 0
    monkeypatch.setattr(stripes_on_board, "LARGEST_ANGLE_DEG", 90.0)
    assert runs_along_edge(upright(100.0, 50.0, 150.0), edges).any()


def test_tangents_of_a_slanted_circle() -> None:
    """A circle seen at 60 degrees: its tangents are not square to the radius (19 degrees off)."""
    rim, tangent = ellipse(30.0, 15.0)
    edges = edges_of(CircleGrid(3, 2, 10.0), rim)
    along = np.abs(np.einsum("ki,ki->k", edges.directions_px, tangent))
    assert np.degrees(np.arccos(np.minimum(along, 1.0))).max() < 0.01


def test_a_circle_grid_without_rims_tells_nothing() -> None:
    grid = CircleGrid(3, 2, 10.0)
    assert find_target_edges(view_of(grid), grid, HERE, CAMERA) is None


@pytest.mark.parametrize("target", [Chessboard(5, 4, 20.0), Charuco(6, 5, 20.0, 15.0, "4X4_50")])
def test_a_stripe_beside_the_borders_of_squares(target: Target) -> None:
    """Squares of 40 px, borders at x = 400 + 40 i: 3 px beside one, 10 px beside one, on one."""
    edges = edges_of(target)
    first, last = target.points_board_mm[:, 1].min(), target.points_board_mm[:, 1].max()
    low, high = 320.0 + 2.0 * first, 320.0 + 2.0 * last
    for x, is_near in ((443.0, True), (450.0, False), (480.0, True), (475.0, False)):
        near = near_px(upright(x, low, high), edges)
        assert len(near) == (high - low + 1 if is_near else 0), x


def test_the_outermost_squares_have_borders_too() -> None:
    """Inner corners at x = 400 to 560: outer borders at 360 and 600, and none beyond."""
    edges = edges_of(Chessboard(5, 4, 20.0))
    assert len(near_px(upright(361.0, 330.0, 430.0), edges)) == 101
    assert len(near_px(upright(599.0, 330.0, 430.0), edges)) == 101
    assert len(near_px(upright(640.0, 330.0, 430.0), edges)) == 0


def test_squares_behind_the_camera_are_left_out() -> None:
    """A board edge on, its far row of squares behind the camera: the rest is still known."""
    turned: Pose[Sensor, Board] = Pose.from_vectors(
        np.array([np.radians(-80.0), 0.0, 0.0]), np.array([-50.0, -10.0, 75.0])
    )
    board = Chessboard(5, 4, 20.0)
    corners = board.points_board_mm @ turned.rotation.T + turned.translation_mm
    beyond = board.points_board_mm + np.array([0.0, 20.0, 0.0])
    assert corners[:, 2].min() > 0.0
    assert (beyond @ turned.rotation.T + turned.translation_mm)[:, 2].min() < 0.0
    edges = find_target_edges(view_of(board), board, turned, CAMERA)
    assert edges is not None
    assert len(edges.points_px) > 100
    assert CAMERA.is_inside(edges.points_px, -25.0).all()


def test_edges_beyond_the_fold_of_the_lens_are_no_phantoms() -> None:
    """R (1 - 0.5 r^2) is largest at r = 0.816: what lies further out comes back into the image."""
    lens = plain_camera(1000.0, (500.0, 400.0), (1001, 801), [-0.5, 0, 0, 0, 0])
    board = Chessboard(5, 4, 200.0)
    near: Pose[Sensor, Board] = Pose(np.eye(3), np.array([-400.0, -300.0, 500.0]))
    edges = find_target_edges(view_of(board), board, near, lens)
    assert edges is not None
    xy, is_valid = lens.undistort(edges.points_px)
    assert is_valid.all()
    on_board = xy * 500.0 + [400.0, 300.0]
    off_line = np.abs(on_board / 200.0 - np.rint(on_board / 200.0)).min(axis=1)
    np.testing.assert_allclose(off_line, 0.0, atol=1e-6)
    assert np.linalg.norm(xy, axis=1).max() < 0.8165
