# SPDX-License-Identifier: Apache-2.0
"""Points made with the stored calibration: exactly those, with claims that repeats bear out."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armscan.calibration.sheets import calibrate
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit, PointUse, SheetPointCheck
from armscan.calibration.sheets.solve import solve_sheets
from armscan.geometry.arrays import FloatArray
from armscan.models.camera import CameraModel
from armscan.reconstruction.triangulate import triangulate
from rigs.sheet_rig import PROVENANCE, SheetRig, thesis_rig

N_RUNS = 60
POOR = 20.0
"""How much worse than a good camera the poor one is."""


def poor_rig() -> SheetRig:
    """A camera known to some 10 px whose errors bend the stripes' depths apart."""
    rig = replace(thesis_rig(), points_per_stripe=50)
    return replace(rig, camera_covariance=POOR**2 * rig.camera_covariance)


def drawn(rig: SheetRig, seed: int) -> tuple[list[BoardStripes], CameraModel]:
    rng = np.random.default_rng(seed)
    camera = rig.noisy_camera(rng)
    return rig.boards(camera, rng), camera


def fitted(rig: SheetRig, seed: int) -> LaserFit:
    boards, camera = drawn(rig, seed)
    fit = calibrate_sheets(boards, rig.calibration(camera))
    assert isinstance(fit, LaserFit), fit
    return fit


def distances(fit: LaserFit, boards: list[BoardStripes], number: int) -> FloatArray:
    """(K,) distance of one board's points from it, made by `triangulate` from the document."""
    image = fit.images[number]
    sensor = fit.to_calibration(PROVENANCE)
    of_point = np.where(image.use == PointUse.USED, image.sheet, -1)
    cloud = triangulate(image.profile, of_point, sensor)
    pose = boards[number].sensor_from_board.value
    return np.asarray((cloud.points_mm - pose.translation_mm) @ pose.rotation[:, 2])


def test_the_points_are_those_that_reconstruction_makes_with_the_document() -> None:
    rig = replace(thesis_rig(bow_uu_mm=0.1), points_per_stripe=60)
    boards, camera = drawn(rig, 4)
    fit = calibrate_sheets(boards, rig.calibration(camera))
    assert isinstance(fit, LaserFit), fit
    assert fit.sheets[0].sheet.is_bowed
    every = [distances(fit, boards, i) for i in range(len(boards))]
    for found, expected in zip(fit.sheets[0].points.boards, every, strict=True):
        assert found.fitted.n_points == len(expected)
        np.testing.assert_allclose(found.fitted.mean_mm, expected.mean(), atol=1e-9)
        np.testing.assert_allclose(found.fitted.rms_mm, np.sqrt((expected**2).mean()), rtol=1e-6)
    whole = np.concatenate(every)
    np.testing.assert_allclose(fit.sheets[0].points.fitted.mean_mm, whole.mean(), atol=1e-9)


def free_instead(*args: Any, **options: Any) -> Any:
    return solve_sheets(*args, **{**options, "are_cameras_held": False})


@pytest.mark.parametrize("is_moved", [False, True])
def test_with_a_poor_camera_the_stored_points_lie_on_their_boards(
    is_moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over 12 cameras the points' rms is near its claim.

    The sheet of the camera moved within its covariance, beside the unmoved one, misses the boards
    by far more.
    """
    if is_moved:
        monkeypatch.setattr(calibrate, "solve_sheets", free_instead)
    rig = poor_rig()
    checks = [raw_check(rig, seed) for seed in range(12)]
    rms = np.sqrt(np.mean([rms**2 for rms, _ in checks]))
    claimed = np.sqrt(np.mean([claimed**2 for _, claimed in checks]))
    assert (rms > 1.5 * claimed) if is_moved else (0.7 * claimed < rms < 1.5 * claimed)


def raw_check(rig: SheetRig, seed: int) -> tuple[float, float]:
    """Rms of the points off their boards, by `triangulate`, and what the right sheet claims."""
    boards, camera = drawn(rig, seed)
    fit = calibrate_sheets(boards, rig.calibration(camera))
    assert isinstance(fit, LaserFit), fit
    every = np.concatenate([distances(fit, boards, i) for i in range(len(boards))])
    with pytest.MonkeyPatch.context() as restored:
        restored.setattr(calibrate, "solve_sheets", solve_sheets)
        right = calibrate_sheets(boards, rig.calibration(camera))
    assert isinstance(right, LaserFit), right
    return float(np.sqrt((every**2).mean())), right.sheets[0].points.fitted.claimed_rms_mm


def test_claims_are_those_of_repeats() -> None:
    """Normalised squares of the boards' means, in the fit and left out, and of all points' rms."""
    rig = replace(thesis_rig(), points_per_stripe=30)
    checks = [fitted(rig, seed).sheets[0].points for seed in range(N_RUNS)]
    board: list[Callable[[SheetPointCheck], list[float]]] = [
        lambda c: [b.fitted.mean_mm / b.fitted.sigma_mean_mm for b in c.boards],
        lambda c: [b.left_out.mean_mm / b.left_out.sigma_mean_mm for b in c.boards if b.left_out],
        lambda c: [c.fitted.mean_mm / c.fitted.sigma_mean_mm],
    ]
    for normalised in board:
        squares = np.array([normalised(check) for check in checks]) ** 2
        # Boards of one run share little: 4 sigma of a mean over runs alone.
        assert abs(float(squares.mean()) - 1.0) < 4.0 * np.sqrt(2.0 / N_RUNS)
    for rms, claimed in (
        ([c.fitted.rms_mm for c in checks], [c.fitted.claimed_rms_mm for c in checks]),
        ([c.left_out_rms_mm for c in checks], [c.left_out_claimed_mm for c in checks]),
    ):
        ratio = np.mean(np.square(rms)) / np.mean(np.square(claimed))
        # Six boards' means make it: chi2 with about 6 degrees of freedom a run.
        assert abs(float(ratio) - 1.0) < 4.0 * np.sqrt(2.0 / 3.0 / N_RUNS)


def test_leaving_a_board_out_is_fitting_without_it() -> None:
    """Against a real fit of the other boards: the same sheet within a tenth of the claim."""
    rig = replace(thesis_rig(), points_per_stripe=60)
    boards, camera = drawn(rig, 7)
    calibration = rig.calibration(camera)
    fit = calibrate_sheets(boards, calibration)
    assert isinstance(fit, LaserFit), fit
    changes = []
    for k, board in enumerate(boards):
        rest = calibrate_sheets([b for i, b in enumerate(boards) if i != k], calibration)
        assert isinstance(rest, LaserFit), rest
        whole = replace(rest, images=fit.images)
        expected = distances(whole, boards, k)
        found = fit.sheets[0].points.boards[k].left_out
        assert found is not None, board.profile.source
        assert abs(found.mean_mm - expected.mean()) < 0.1 * found.sigma_mean_mm
        np.testing.assert_allclose(found.rms_mm, np.sqrt((expected**2).mean()), rtol=0.05)
        in_fit = fit.sheets[0].points.boards[k].fitted
        changes.append(abs(found.mean_mm - in_fit.mean_mm) / found.sigma_mean_mm)
    assert max(changes) > 0.1, "the case must have something to find"


def test_with_two_boards_neither_can_be_left_out() -> None:
    rig = thesis_rig()
    rig = replace(rig, poses=(rig.poses[1], rig.poses[4]))
    points = fitted(rig, 1).sheets[0].points
    assert all(board.left_out is None for board in points.boards)
    assert np.isnan(points.left_out_rms_mm)
    assert points.fitted.n_points > 100
