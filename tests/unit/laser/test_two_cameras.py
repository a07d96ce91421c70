# SPDX-License-Identifier: Apache-2.0
"""Sheets of a head with two cameras: one solve, one covariance of cameras and sheets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import LaserFit, PointUse, SheetOptions
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.rotations import vector_from_rotation
from armscan.models.two_views import StereoCalibration
from rigs.fan_rig import FanRig, LaserTruth, fan_rig
from rigs.sheet_rig import PROVENANCE

GRID = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), -1).reshape(-1, 2)


def flat(rig: FanRig) -> FanRig:
    """The rig with sheets that are planes, so that the model is exact."""
    plane = [replace(sheet.laser, skew_rad=0.0, cubic_rad=0.0) for sheet in rig.sheets]
    return replace(rig, sheets=tuple(LaserTruth(laser) for laser in plane), points_per_stripe=40)


def fitted(
    rig: FanRig, seed: int, *, n_sheets: int = 5, is_bow_allowed: bool = True
) -> tuple[LaserFit, StereoCalibration, list[int]]:
    """The fit, the calibration it rests on, and the true sheet of each of its sheets."""
    rng = np.random.default_rng(seed)
    stereo = rig.drawn_stereo(rng)
    boards, truth = rig.boards(stereo, rng)
    options = SheetOptions(n_sheets=n_sheets, is_bow_allowed=is_bow_allowed)
    fit = calibrate_sheets(boards, stereo, options)
    assert isinstance(fit, LaserFit), fit
    of = []
    for k in range(len(fit.sheets)):
        found = {
            truth[i][int(s)]
            for i, image in enumerate(fit.images)
            for s in image.profile.segment[(image.use == PointUse.USED) & (image.sheet == k)]
        }
        assert len(found) == 1, "points of two sheets under one name"
        of.append(found.pop())
    return fit, stereo, of


def errors(
    fit: LaserFit, stereo: StereoCalibration, of: list[int], rig: FanRig
) -> tuple[FloatArray, IntArray]:
    """Errors of all free parameters, and their places in the covariance."""
    pose = stereo.right_from_left
    error = [stereo.left.camera.parameters - rig.left.parameters]
    place = [np.arange(9)]
    for k, sheet in enumerate(fit.sheets):
        truth, model = rig.sheets[of[k]].laser, sheet.sheet
        points = model.origin_mm + GRID * model.scale_mm @ model.axes[:2]
        height = -truth.offset_mm(points) / float(truth.normal @ model.axes[2])
        design = np.column_stack([GRID, np.ones(len(GRID))])
        error.append(-np.linalg.lstsq(design, height, rcond=None)[0])
        place.append(9 + 8 * k + np.arange(3))
    error += [
        stereo.right.camera.parameters - rig.right.parameters,
        vector_from_rotation(pose.rotation @ rig.right_from_left.rotation.T),
        pose.translation_mm - rig.right_from_left.translation_mm,
    ]
    place.append(9 + 8 * len(fit.sheets) + np.arange(15))
    return np.concatenate(error), np.concatenate(place)


def test_joint_errors_of_cameras_and_sheets_are_as_large_as_stated() -> None:
    """Normalised error over all 39 free parameters, 6 calibrations of five sheets.

    Of planes that are known to be planes: what a bow that none has might be is not stated.
    """
    squares = []
    for seed in range(6):
        rig = flat(fan_rig(500 + seed, 6, 5))
        fit, stereo, of = fitted(rig, seed, is_bow_allowed=False)
        assert not any(sheet.is_bow_free for sheet in fit.sheets)
        error, place = errors(fit, stereo, of, rig)
        covariance = fit.covariance[np.ix_(place, place)]
        sigma = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(sigma, sigma)
        squares.append(float((error / sigma) @ np.linalg.solve(correlation, error / sigma)))
        assert len(error) == 24 + 3 * len(fit.sheets)
    low, high = (float(chi2.ppf(p, 6 * len(error))) for p in (0.0005, 0.9995))
    assert low < sum(squares) < high


def test_the_right_camera_makes_the_sheets_better_known() -> None:
    rig = flat(fan_rig(2, 6, 5))
    fit, _, of = fitted(rig, 2, is_bow_allowed=False)
    rng = np.random.default_rng(2)
    left = rig.drawn_stereo(rng).left
    boards, _ = rig.boards(left, rng)
    alone = calibrate_sheets(boards, left, SheetOptions(n_sheets=5, is_bow_allowed=False))
    assert isinstance(alone, LaserFit)
    assert of == [0, 1, 2, 3, 4]
    offsets = [[s.offset_sigma_mm for s in found.sheets] for found in (fit, alone)]
    assert sum(offsets[0]) < sum(offsets[1])
    # Each sheet follows the cameras as they are; what stripes and boards leave open shrinks: to
    # 0.82 where the stripes' noise is given, of which their points tell 3 % in either fit.
    own = [sum(own_offset_sigmas(found)) for found in (fit, alone)]
    np.testing.assert_allclose(own[0] / own[1], 0.82, rtol=3.0 * 0.03)


def own_offset_sigmas(fit: LaserFit) -> list[float]:
    """Sigma of each sheet's offset by stripes and boards, the cameras being as calibrated."""
    n_sheets = 8 * len(fit.sheets)
    sheets = np.arange(9, 9 + n_sheets)
    cameras = np.setdiff1d(np.arange(len(fit.covariance)), sheets)
    known = fit.covariance[np.ix_(cameras, cameras)]
    sigma = np.sqrt(np.diag(known))
    cross = fit.covariance[np.ix_(cameras, sheets)] / sigma[:, None]
    follow = np.linalg.solve(known / np.outer(sigma, sigma), cross)
    left = fit.covariance[np.ix_(sheets, sheets)] - cross.T @ follow
    return [float(np.sqrt(left[8 * k + 2, 8 * k + 2])) for k in range(len(fit.sheets))]


def test_the_document_has_both_cameras_and_their_order() -> None:
    rig = fan_rig(3, 6, 5)
    fit, stereo, _ = fitted(rig, 3)
    sensor = fit.to_calibration(PROVENANCE)
    assert sensor.second is not None
    assert sensor.second.camera is stereo.right
    known = sensor.covariance
    own = [*range(9), *range(*sensor.second_parameter_slice.indices(len(known)))]
    np.testing.assert_allclose(known[np.ix_(own, own)], stereo.covariance, rtol=1e-12)
    sheet = sensor.sheet_parameter_slice(0)
    assert np.abs(known[sheet, sensor.second_parameter_slice]).max() > 0.0


def test_a_sheet_that_the_boards_do_not_determine_is_left_out_of_the_fan() -> None:
    """Its line on two boards, the same piece of it: one line in space. The others stay."""
    rig = fan_rig(6, 6, 5)
    rng = np.random.default_rng(6)
    left = rig.stereo().left
    boards, truth = rig.boards(left, rng)
    last = [names.index(4) if 4 in names else -1 for names in truth]
    kept = [i for i, k in enumerate(last) if k >= 0][:1]
    for i, board in enumerate(boards):
        if last[i] >= 0 and i not in kept:
            rows = board.profile.segment != last[i]
            boards[i] = replace(board, profile=board.profile.select(rows))
    twin = replace(boards[kept[0]], placement="again")
    fit = calibrate_sheets([*boards, twin], left, SheetOptions(n_sheets=5))
    assert isinstance(fit, LaserFit), fit
    assert fit.sheet_names == ("A.1", "A.2", "A.3", "A.4")
    assert any("left out" in warning and "A.5" in warning for warning in fit.warnings)
