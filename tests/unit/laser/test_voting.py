# SPDX-License-Identifier: Apache-2.0
"""Boards agree on a sheet; lines that are straight and elsewhere are outvoted and named."""

import math
from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import (
    BoardDistances,
    BoardPointCheck,
    BoardStripes,
    LaserFit,
    PointUse,
    SheetOptions,
    SheetPointCheck,
)
from armscan.calibration.sheets.voting import observe_boards
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate
from rigs.sheet_rig import SheetRig, SheetTruth, make_profile, project, stripe_on_board, thesis_rig

Stripe = tuple[FloatArray, FloatArray]


def fitted(rig: SheetRig, boards: list[BoardStripes]) -> LaserFit:
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit), fit
    return fit


def image_line(first: tuple[float, float], last: tuple[float, float], n: int = 150) -> Stripe:
    """A straight line of the image: (N, 2) points and normals."""
    points = np.linspace(first, last, n)
    along = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
    return points, np.tile([-along[1], along[0]], (n, 1))


def with_stripes(board: BoardStripes, stripes: list[Stripe]) -> BoardStripes:
    return replace(board, profile=make_profile(board.profile.source, stripes, 0.06))


def own(board: BoardStripes) -> Stripe:
    return board.profile.points_px, board.profile.normals_px


def test_a_line_that_stays_where_it_is_in_the_image_makes_no_sheet() -> None:
    """Carried to any board it lies in the plane of its own rays: perfectly coplanar, and no sheet.

    It is longer than the stripe in every image, so that neither length nor count tells it.
    """
    rig = thesis_rig()
    clean = rig.boards(rig.camera, np.random.default_rng(1))
    static = image_line((760, 560), (1240, 700), 400)
    boards = [with_stripes(board, [static, own(board)]) for board in clean]
    fit, alone = fitted(rig, boards), fitted(rig, clean)
    assert len(fit.sheets) == 1
    assert np.allclose(fit.sheets[0].sheet.plane, alone.sheets[0].sheet.plane, atol=1e-5)
    assert all(image.count(PointUse.OUTVOTED) > 300 for image in fit.images)
    assert fit.skipped == ()


def test_one_sheet_that_is_asked_for_is_voted_on_among_many_lines() -> None:
    """Four others an image, edges of an overexposed board: no fan, where one sheet is said."""
    rig, rng = thesis_rig(), np.random.default_rng(8)
    clean = rig.boards(rig.camera, np.random.default_rng(1))
    boards = []
    for board in clean:
        q, _ = own(board)
        middle, along = q.mean(axis=0), q[-1] - q[0]
        across = np.array([-along[1], along[0]])
        others = []
        for shift in (-0.3, -0.15, 0.15, 0.3):
            start = middle + shift * across - 0.3 * along
            end = start + 0.6 * along + rng.uniform(-0.08, 0.08) * across
            others.append(image_line(tuple(start), tuple(end)))
        boards.append(with_stripes(board, [*others, own(board)]))
    found = calibrate_sheets(boards, rig.calibration(rig.camera), SheetOptions(n_sheets=1))
    assert isinstance(found, LaserFit), found
    alone = fitted(rig, clean)
    assert np.allclose(found.sheets[0].sheet.plane, alone.sheets[0].sheet.plane, atol=1e-3)


def test_a_board_whose_line_is_another_one_is_named_with_its_distance() -> None:
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(2))
    q, normals = own(boards[4])
    boards[4] = with_stripes(boards[4], [(q + 40.0 * normals, normals)])
    fit = fitted(rig, boards)
    assert [item.source for item in fit.skipped] == ["laser-4.png"]
    assert "outlying board" in fit.skipped[0].reason
    told_px = float(fit.skipped[0].reason.split(" px")[0].split()[-1])
    assert told_px == pytest.approx(40.0, abs=1.5), "its farther end, of the others' fitted plane"
    assert "5 boards" in fit.skipped[0].reason
    assert fit.images[4].count(PointUse.USED) == 0
    rest = fitted(rig, [*boards[:4], boards[5]])
    assert np.allclose(fit.sheets[0].sheet.plane, rest.sheets[0].sheet.plane, atol=1e-9)


def beside(rig: SheetRig, i: int, rng: np.random.Generator) -> Stripe:
    """The sheet's stripe on a carrier that goes on past the print by the print's own length."""
    wide = rig.board_points_mm() * np.array([3.0, 3.0, 1.0]) - np.array([32.0, 24.0, 0.0])
    on_board = stripe_on_board(rig.poses[i], rig.sheets[0], wide, 600)
    q = project(rig.camera, rig.poses[i], on_board)
    tangent = np.gradient(q, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return q + rng.normal(0.0, 0.06, (len(q), 1)) * normal, normal


def test_a_stripe_beside_the_print_is_used_where_the_boards_agree_on_it() -> None:
    """The same sheet, the boards moved up so that the stripe misses their prints."""
    rig = thesis_rig()
    shift = np.array([0.0, 22.0, 0.0])
    poses = tuple(
        replace(pose, translation_mm=pose.translation_mm + pose.rotation @ shift)
        for pose in rig.poses
    )
    moved = replace(rig, poses=poses)
    rng = np.random.default_rng(3)
    stripes = [beside(moved, i, rng) for i in range(len(poses))]
    boards = []
    for i, stripe in enumerate(stripes):
        view = moved.view(i, rng)
        pose = estimate_board_pose(view, rig.camera)
        assert isinstance(pose, Estimate)
        boards.append(BoardStripes(make_profile(f"laser-{i}.png", [stripe], 0.06), view, pose))
    fit = fitted(moved, boards)
    assert fit.sheets[0].calibration.n_boards == len(poses)
    sheet = fit.sheets[0].sheet
    points = np.concatenate([i.points_mm[i.use == PointUse.USED] for i in fit.images])
    height, _, _ = sheet.height_with_jacobian(points)
    missed = rig.sheets[0].height_mm(points - height[:, None] * sheet.axes[2])
    assert np.sqrt((missed**2).mean()) < 4.0 * fit.sheets[0].offset_sigma_mm
    strict = calibrate_sheets(boards, rig.calibration(rig.camera), SheetOptions(margin_mm=0.0))
    assert not isinstance(strict, LaserFit)


def test_points_beyond_what_is_claimed_of_left_out_boards_are_warned_of() -> None:
    claimed = BoardDistances(9, 0.0, 1.0, 1.0, 1.0)
    for n, ratio, is_said in ((6, 2.0, False), (6, 2.6, True), (60, 1.6, True), (60, 1.4, False)):
        boards = tuple(BoardPointCheck(f"{k}.png", 300.0, claimed, claimed) for k in range(n))
        check = SheetPointCheck(claimed, ratio, 1.0, boards)
        assert bool(check.warnings) is is_said
        assert all(f"{ratio:.1f} times as large" in text for text in check.warnings)
    unknown = SheetPointCheck(claimed, math.nan, math.nan, ())
    assert unknown.warnings == ()


def test_the_warning_reaches_the_sheet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SheetPointCheck, "warnings", ("beyond",))
    rig = thesis_rig()
    fit = fitted(rig, rig.boards(rig.camera, np.random.default_rng(1)))
    assert all("beyond" in sheet.warnings for sheet in fit.sheets)


@pytest.mark.parametrize("bow_mm", [0.0, 0.15])
def test_honest_boards_are_not_outvoted(bow_mm: float) -> None:
    """A refusal is a claim: with noisy cameras, boards and a bowed sheet it must not be made."""
    rig = thesis_rig(bow_uu_mm=bow_mm)
    for seed in range(25):
        rng = np.random.default_rng(100 + seed)
        camera = rig.noisy_camera(rng)
        boards = rig.boards(camera, rng)
        vote = observe_boards(boards, HeadCameras.of(rig.calibration(camera)), SheetOptions())
        assert vote.outlying == (), seed
        assert all(len(image.stripes) == 1 for image in vote.images)


def test_two_sheets_are_both_kept() -> None:
    rig = thesis_rig()
    second = SheetTruth(rig.sheets[0].plane * [1.0, 1.0, 1.0, 1.0] + [0.0, 0.06, 0.0, 3.0])
    both = replace(rig, sheets=(rig.sheets[0], second))
    fit = fitted(both, both.boards(rig.camera, np.random.default_rng(5)))
    assert len(fit.sheets) == 2
    assert all(image.count(PointUse.OUTVOTED) == 0 for image in fit.images)


def test_two_boards_do_not_vote() -> None:
    rig = replace(thesis_rig(), poses=thesis_rig().poses[:2])
    boards = rig.boards(rig.camera, np.random.default_rng(6))
    vote = observe_boards(boards, HeadCameras.of(rig.calibration(rig.camera)), SheetOptions())
    assert vote.outlying == ()
