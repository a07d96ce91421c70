# SPDX-License-Identifier: Apache-2.0
"""The thesis's way: cross ratios give board coordinates."""

import numpy as np

from armscan.calibration.sheets.checks import cross_ratio_points, projective_coordinate
from rigs.sheet_rig import exact, stripe_on_board, thesis_rig

RIG = exact(thesis_rig())


def cross_ratio(a: float, b: float, c: float, d: float) -> float:
    return (c - a) / (c - b) * (d - b) / (d - a)


def test_three_points_give_the_point_with_their_cross_ratio() -> None:
    image, board = np.array([0.0, 1.0, 4.0]), np.array([0.0, 10.0, 20.0])
    found = projective_coordinate(image, board, 2.0)
    on_board, in_image = [*board, found], [*image, 2.0]
    np.testing.assert_allclose(cross_ratio(*on_board), cross_ratio(*in_image), rtol=1e-12)


def test_more_points_agree_with_three_of_them() -> None:
    """A projective map by hand: s = 30 t / (1 + t)."""
    t = np.array([0.0, 0.5, 1.0, 2.0, 3.0])
    found = projective_coordinate(t, 30.0 * t / (1.0 + t), 1.5)
    np.testing.assert_allclose(found, 30.0 * 1.5 / 2.5, rtol=1e-12)


def test_crossings_lie_on_the_stripe_and_on_rows_or_columns() -> None:
    """Through a distorting lens; only the lens inversion and the small noise are left."""
    rng = np.random.default_rng(0)
    for index in range(len(RIG.poses)):
        stripe, _ = RIG.stripe(index, RIG.sheets[0], rng)
        found = cross_ratio_points(RIG.view(index, rng), stripe, RIG.camera)
        truth = stripe_on_board(RIG.poses[index], RIG.sheets[0], RIG.board_points_mm(), 400)
        assert len(found) >= 7
        direction = (truth[-1] - truth[0])[:2] / np.linalg.norm(truth[-1] - truth[0])
        offset = found - truth[0, :2]
        across = direction[0] * offset[:, 1] - direction[1] * offset[:, 0]
        np.testing.assert_allclose(across, 0.0, atol=1e-5)
        on_grid = np.abs(found / RIG.pitch_mm - np.round(found / RIG.pitch_mm)).min(axis=1)
        np.testing.assert_allclose(on_grid, 0.0, atol=1e-9)


def test_two_known_points_are_too_few() -> None:
    rng = np.random.default_rng(0)
    view = RIG.view(0, rng)
    stripe, _ = RIG.stripe(0, RIG.sheets[0], rng)
    few = view.points_board_mm[:, 0] < 2 * RIG.pitch_mm
    few &= view.points_board_mm[:, 1] < 2 * RIG.pitch_mm
    small = view.select(few)
    assert cross_ratio_points(small, stripe, RIG.camera).shape == (0, 2)
