# SPDX-License-Identifier: Apache-2.0
"""Boards that err more than they say are told from a sheet that is bowed."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.labels import SheetAssignment, assign_sheets
from armscan.calibration.sheets.model import board_scatter, start_sheet, stripe_noise
from armscan.calibration.sheets.result import BoardStripes, LaserFit, SheetOptions
from armscan.calibration.sheets.solve import (
    CommonErrors,
    SheetSolution,
    solve_sheets,
    stack_observations,
)
from armscan.calibration.sheets.voting import observe_boards
from armscan.geometry.poses import Pose
from armscan.models.light_sheet import LightSheet
from rigs.sheet_rig import SheetRig, placed, thesis_rig

SEEDS = range(8)
N_BOARDS = 14


def rig_of_many(bow_uu_mm: float = 0.0) -> SheetRig:
    rng = np.random.default_rng(0)
    tilts = rng.uniform(-30.0, 30.0, (N_BOARDS, 2))
    depths = np.linspace(122.0, 150.0, N_BOARDS)
    poses = tuple(
        placed(float(x), float(y), float(z), (16.0, 12.0))
        for (x, y), z in zip(tilts, depths, strict=True)
    )
    return replace(thesis_rig(bow_uu_mm), poses=poses, camera_covariance=1e-12 * np.eye(9))


def overrated(board: BoardStripes, factor: float) -> BoardStripes:
    """The same board that claims to be known better than it is."""
    pose = board.sensor_from_board
    claimed = replace(pose, covariance=pose.covariance / factor**2)
    return replace(board, sensor_from_board=claimed)


def fits(
    bow_uu_mm: float,
    factor: float,
    options: SheetOptions | None = None,
    *,
    corner_px: float = 0.05,
    seeds: range = SEEDS,
) -> list[LaserFit]:
    found = []
    rig = replace(rig_of_many(bow_uu_mm), sigma_corner_px=corner_px)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        boards = [overrated(board, factor) for board in rig.boards(rig.camera, rng)]
        fit = calibrate_sheets(boards, rig.calibration(rig.camera), options)
        assert isinstance(fit, LaserFit), fit
        found.append(fit)
    return found


@pytest.mark.parametrize("options", [None, SheetOptions(is_bow_allowed=False)])
def test_boards_that_claim_too_much_make_no_bow_and_are_charged_their_scatter(
    options: SheetOptions | None,
) -> None:
    """Poses claimed 8 times better than they are: no bow is asked for and the points' claim right.

    Root mean square over claim averages 1 within four of its own standard errors: the boards' two
    heights each, over all seeds, are 2 x 14 x 8 numbers, so 1 +- 0.047.
    """
    found = fits(0.0, 8.0, options)
    assert not any(fit.sheets[0].is_bow_free for fit in found)
    ratios = [
        f.sheets[0].points.fitted.rms_mm / f.sheets[0].points.fitted.claimed_rms_mm for f in found
    ]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=4 * 0.047)
    told = [w for fit in found for w in fit.warnings if "times as much as their targets" in w]
    factors = [float(w.split("err ")[1].split(" times")[0]) for w in told]
    assert len(factors) == len(found)
    assert np.median(factors) == pytest.approx(8.0, rel=0.25)


def bent(board: BoardStripes, form_px: float) -> BoardStripes:
    """The same board, its stripe curved by the board's own form, as no pose curves it."""
    points = board.profile.points_px
    middle = points.mean(axis=0)
    along, across = np.linalg.svd(points - middle, full_matrices=False)[2]
    t = (points - middle) @ along
    shape = form_px * (1.5 * (t / np.abs(t).max()) ** 2 - 0.5)
    return replace(
        board, profile=replace(board.profile, points_px=points + shape[:, None] * across)
    )


def test_a_bent_board_is_not_taken_for_a_pose_known_a_hundred_times_worse() -> None:
    """Boards that curve their stripes by 0.3 px, each its own way, in places that are as claimed.

    The bend is charged to the stripes. A hundred times the boards' errors, which is what curves
    would ask for if they were poses, would be told of and claimed of the points.
    """
    rig = rig_of_many()
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        boards = [bent(board, 0.3 * rng.standard_normal()) for board in rig.boards(rig.camera, rng)]
        fit = calibrate_sheets(boards, rig.calibration(rig.camera))
        assert isinstance(fit, LaserFit), fit
        assert not fit.sheets[0].is_bow_free
        told = [w for w in fit.warnings if "times as much as their targets" in w]
        factors = [float(w.split("err ")[1].split(" times")[0]) for w in told]
        assert all(factor < 4.0 for factor in factors), factors
        check = fit.sheets[0].points.fitted
        assert 0.5 < check.rms_mm / check.claimed_rms_mm < 2.0


def test_a_bow_is_a_bow_though_the_boards_scatter() -> None:
    for fit in fits(0.15, 4.0):
        assert fit.sheets[0].is_bow_free
        sheet = fit.sheets[0].sheet
        truth_mm = 0.15 * (sheet.scale_mm / 20.0) ** 2
        assert abs(sheet.bow_mm[0]) == pytest.approx(truth_mm, rel=0.25)


def test_a_faint_bow_shows_though_boards_err_by_thirty_times_their_claims() -> None:
    """Boards 0.3 px off in their corners that claim 0.01 px; the bow curves stripes by 0.05 mm.

    A sheet that follows the boards' errors, as they claim to have none, hides half of such bows.
    """
    seeds = range(4)
    for fit in fits(0.05, 30.0, corner_px=0.3, seeds=seeds):
        assert fit.sheets[0].is_bow_free
        sheet = fit.sheets[0].sheet
        truth_mm = 0.05 * (sheet.scale_mm / 20.0) ** 2
        assert abs(sheet.bow_mm[0]) == pytest.approx(truth_mm, rel=0.25)
    for fit in fits(0.0, 30.0, corner_px=0.3, seeds=seeds):
        assert not fit.sheets[0].is_bow_free


def test_honest_boards_are_charged_nothing() -> None:
    """No warning, and a bowed sheet with honest boards is explained by its bow alone."""
    for fit in (*fits(0.0, 1.0), *fits(0.15, 1.0)):
        assert not any("times as much as their targets" in warning for warning in fit.warnings)


def test_a_stripe_of_which_nothing_is_left_has_no_say() -> None:
    """Outliers may leave two points of a stripe, which have no slope of their own."""
    rig = rig_of_many()
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    boards = rig.boards(rig.camera, np.random.default_rng(1))
    images = observe_boards(boards, cameras, SheetOptions()).images
    named = assign_sheets(images, SheetOptions())
    assert isinstance(named, SheetAssignment)
    every = stack_observations(images, named)
    few = every.select((every.stripe != 0) | (np.arange(len(every)) < 2))
    start = start_sheet("A", few, images)
    assert isinstance(start, LightSheet)
    errors = CommonErrors.of(images)
    flat = solve_sheets(few, [start], errors, [False])
    assert isinstance(flat, SheetSolution)
    noise = stripe_noise(few, flat.remaining_px)
    without = few.select(few.stripe != 0)
    found = board_scatter(few, flat, errors, noise)
    assert np.isfinite(found.log_likelihood)
    assert found == board_scatter(without, flat, errors, noise)


def moved(board: BoardStripes, sigmas: float) -> BoardStripes:
    """The same board in a place that is wrong by so many of its own sigmas, along its normal."""
    pose = board.sensor_from_board
    normal = pose.value.rotation[:, 2]
    away_mm = sigmas * np.sqrt(normal @ pose.covariance[3:, 3:] @ normal) * normal
    place = Pose(pose.value.rotation, pose.value.translation_mm + away_mm)
    return replace(board, sensor_from_board=replace(pose, value=place))


@pytest.mark.parametrize("sigmas", [10.0, 30.0])
def test_a_board_in_the_wrong_place_hardly_moves_the_sheet_and_does_not_discredit_the_others(
    sigmas: float,
) -> None:
    """As if it had been left out: half a sigma of the sheet, as well known, and it is named.

    Charged to all boards alike it moves the sheet by 3 to 4 (12) of the sigmas that are right
    without it, and these become twice (six times) as large.
    """
    rig = rig_of_many()
    for seed in SEEDS[:3]:
        boards = list(rig.boards(rig.camera, np.random.default_rng(seed)))
        calibration = rig.calibration(rig.camera)
        boards[1] = moved(boards[1], sigmas)
        fit = calibrate_sheets(boards, calibration)
        left_out = calibrate_sheets(boards[:1] + boards[2:], calibration)
        assert isinstance(fit, LaserFit) and isinstance(left_out, LaserFit)
        one, other = fit.sheets[0], left_out.sheets[0]
        assert one.calibration.n_boards == other.calibration.n_boards + 1
        assert not any("times as much as their targets" in warning for warning in fit.warnings)
        told = [w for w in fit.warnings if "lie elsewhere than their targets say" in w]
        assert len(told) == 1 and boards[1].profile.source in told[0]
        apart_mm = (other.sheet.origin_mm - one.sheet.origin_mm) @ one.sheet.axes[2]
        turned = one.sheet.axes[:2] @ other.sheet.axes[2]
        assert abs(apart_mm) < 0.5 * other.offset_sigma_mm
        assert np.degrees(np.abs(turned)).max() < 0.5 * other.tilt_sigma_deg
        assert one.tilt_sigma_deg == pytest.approx(other.tilt_sigma_deg, rel=0.3)
