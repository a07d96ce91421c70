# SPDX-License-Identifier: Apache-2.0
"""Light sheets from stripes on boards: values, refusals, warnings, bow, outliers."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.sheets import checks
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit, PointUse, SheetOptions
from armscan.errors import OptionError
from armscan.geometry.poses import Pose
from armscan.models.light_sheet import LightSheet
from armscan.pipeline import laser
from armscan.pipeline.laser import about_widths
from armscan.records.exposure import Exposure
from armscan.records.profile import StripeFlag
from rigs.sheet_rig import (
    THESIS_PLANE,
    SheetRig,
    exact,
    make_profile,
    placed,
    stripe_on_board,
    thesis_rig,
)

UNIT_PLANE = THESIS_PLANE / np.linalg.norm(THESIS_PLANE[:3])
CENTRE = (16.0, 12.0)


def fitted(rig: SheetRig, seed: int = 0, options: SheetOptions | None = None) -> LaserFit:
    rng = np.random.default_rng(seed)
    fit = calibrate_sheets(rig.boards(rig.camera, rng), rig.calibration(rig.camera), options)
    assert isinstance(fit, LaserFit), fit
    return fit


def refusal(rig: SheetRig, options: SheetOptions | None = None) -> str:
    boards = rig.boards(rig.camera, np.random.default_rng(0))
    fit = calibrate_sheets(boards, rig.calibration(rig.camera), options)
    assert not isinstance(fit, LaserFit)
    assert fit.remedy
    return fit.reason


def distance_mm(sheet: LightSheet, plane: np.ndarray) -> float:
    """Largest distance of the plane from the sheet at the corners of its region."""
    reach = sheet.scale_mm
    corners = sheet.origin_mm + reach * np.array([[1, 1], [1, -1], [-1, 1]]) @ sheet.axes[:2]
    return float(np.abs(corners @ plane[:3] + plane[3]).max())


def test_exact_features_give_the_printed_plane() -> None:
    """Features without noise: only the features' 1e-6 px is left, about 1e-7 mm."""
    fit = fitted(exact(thesis_rig()))
    sheet = fit.sheets[0]
    assert distance_mm(sheet.sheet, UNIT_PLANE) < 1e-6
    for comparison in sheet.comparisons:
        assert comparison.largest_mm < 1e-5, comparison
    assert sheet.calibration.is_redundant
    assert not sheet.warnings


def test_the_sign_of_a_normal_does_not_matter() -> None:
    """A normal is known but for its sign: one turned in any half of the points changes nothing."""
    rig, rng = thesis_rig(), np.random.default_rng(3)
    plain = rig.boards(rig.camera, rng)
    turned = [
        replace(
            board,
            profile=replace(
                board.profile,
                normals_px=board.profile.normals_px * rng.choice([-1.0, 1.0], (120, 1)),
            ),
        )
        for board in plain
    ]
    one, other = (calibrate_sheets(b, rig.calibration(rig.camera)) for b in (plain, turned))
    assert isinstance(one, LaserFit)
    assert isinstance(other, LaserFit)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-6, atol=1e-18)
    assert distance_mm(other.sheets[0].sheet, UNIT_PLANE) == pytest.approx(
        distance_mm(one.sheets[0].sheet, UNIT_PLANE), rel=1e-6
    )
    assert other.diagnostics.noise_factor == pytest.approx(one.diagnostics.noise_factor)


def test_document_carries_depths_counts_and_camera() -> None:
    fit = fitted(thesis_rig())
    points = np.concatenate([i.points_mm[i.use == PointUse.USED] for i in fit.images])
    own = fit.sheets[0].calibration
    assert own.n_boards == 6
    assert own.n_points == len(points)
    assert own.depth_range_mm == (points[:, 2].min(), points[:, 2].max())
    assert 0.9 < fit.diagnostics.noise_factor < 1.1
    assert fit.diagnostics.correlation_points < 1.3
    document = fit.to_calibration(fit.camera.provenance)
    np.testing.assert_array_equal(document.covariance, fit.covariance)
    np.testing.assert_array_equal(document.covariance[:9, :9], fit.camera.covariance)
    assert np.linalg.eigvalsh(_scaled(fit.covariance[:12, :12])).min() > 0.0


def test_one_board_is_refused() -> None:
    rig = thesis_rig()
    assert "any number of planes" in refusal(replace(rig, poses=rig.poses[:1]))


def test_boards_in_one_plane_are_refused_with_the_spread() -> None:
    """The board slides within its own plane: every stripe is the same line in space."""
    here = placed(20.0, 10.0, 136.0, CENTRE)
    slid = [Pose(here.rotation, here.translation_mm + s * here.rotation[:, 0]) for s in (0, 2, 4)]
    reason = refusal(replace(thesis_rig(), poses=tuple(slid)))
    assert "one line in space" in reason
    assert "depth" in reason


def test_two_tilted_boards_are_solved_with_a_warning() -> None:
    rig = thesis_rig()
    fit = fitted(replace(rig, poses=(rig.poses[1], rig.poses[4])))
    sheet = fit.sheets[0]
    assert distance_mm(sheet.sheet, UNIT_PLANE) < 6.0 * sheet.offset_sigma_mm
    assert not sheet.calibration.is_redundant
    assert any("two boards only" in warning for warning in sheet.warnings)
    assert sheet.diagnostics.coplanarity_mm < 4.0 * sheet.diagnostics.coplanarity_sigma_mm


def test_what_two_boards_check_and_what_not() -> None:
    """Stripes that are parallel in space: a twist is seen, a wrong depth of a board is not."""
    poses = (placed(25.0, 0.0, 137.0, CENTRE), placed(-25.0, 0.0, 131.0, CENTRE))
    rig = replace(thesis_rig(), poses=poses)
    boards = rig.boards(rig.camera, np.random.default_rng(0))
    for turn, shift, is_seen in (
        (np.array([0.0, 0.05, 0.0]), np.zeros(3), True),
        (np.zeros(3), np.array([0.0, 0.0, 0.5]), False),
    ):
        pose = boards[1].sensor_from_board
        rotation = Pose.from_vectors(turn, np.zeros(3)).rotation @ pose.value.rotation
        moved = replace(pose, value=Pose(rotation, pose.value.translation_mm + shift))
        fit = calibrate_sheets(
            [boards[0], replace(boards[1], sensor_from_board=moved)],
            rig.calibration(rig.camera),
            SheetOptions(),
        )
        assert isinstance(fit, LaserFit), fit
        sheet = fit.sheets[0]
        sigmas = sheet.diagnostics.coplanarity_mm / sheet.diagnostics.coplanarity_sigma_mm
        assert (sigmas > 5.0) == is_seen, sigmas
        assert distance_mm(sheet.sheet, UNIT_PLANE) > 0.1


def test_parallel_boards_at_two_depths_are_solved_with_a_warning() -> None:
    poses = tuple(placed(10.0, 5.0, z, CENTRE) for z in (128.0, 143.0, 136.0))
    fit = fitted(replace(thesis_rig(), poses=poses))
    assert any("parallel" in warning for warning in fit.sheets[0].warnings)
    assert distance_mm(fit.sheets[0].sheet, UNIT_PLANE) < 6.0 * fit.sheets[0].offset_sigma_mm


def test_a_flat_sheet_stays_flat_and_a_bowed_one_bows() -> None:
    """A bow of 0.15 mm is 5 px of stripe noise's 0.06: found, and followed over all boards."""
    flat = fitted(thesis_rig())
    assert not flat.sheets[0].is_bow_free
    rig = thesis_rig(bow_uu_mm=0.15, bow_uv_mm=-0.05)
    fit = fitted(rig)
    sheet = fit.sheets[0]
    assert sheet.is_bow_free, sheet.diagnostics.bow_decision
    assert sheet.diagnostics.plane_test.p_value < 1e-6
    assert sheet.diagnostics.final_test.p_value > 1e-3
    true_points = np.concatenate(
        [
            stripe_on_board(pose, rig.sheets[0], rig.board_points_mm(), 100) @ pose.rotation.T
            + pose.translation_mm
            for pose in rig.poses
        ]
    )
    height, _, by_parameters = sheet.sheet.height_with_jacobian(true_points)
    sigma = np.sqrt(np.einsum("ni,ij,nj->n", by_parameters, sheet.covariance, by_parameters))
    assert np.abs(height / sigma).max() < 4.0
    assert np.abs(height).max() < 0.02, "the camera is exact here: less than its sigma"


def test_three_boards_cannot_tell_a_bow_and_say_so() -> None:
    rig = thesis_rig(bow_uu_mm=0.4)
    fit = fitted(replace(rig, poses=rig.poses[:3]))
    sheet = fit.sheets[0]
    assert not sheet.is_bow_free
    assert "3 boards cannot tell" in sheet.diagnostics.bow_decision
    assert any("does not explain" in warning for warning in fit.warnings)
    flat = fitted(replace(thesis_rig(), poses=rig.poses[:3])).sheets[0]
    assert sheet.offset_sigma_mm > flat.offset_sigma_mm


def test_one_wrong_board_is_named() -> None:
    """A board 0.06 mm too far, 2 px: too little to be outvoted, too much for a plane."""
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(7))
    pose = boards[3].sensor_from_board
    moved = Pose(pose.value.rotation, pose.value.translation_mm + np.array([0.0, 0.0, 0.06]))
    boards[3] = replace(boards[3], sensor_from_board=replace(pose, value=moved))
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    named = [warning for warning in fit.sheets[0].warnings if "all boards but" in warning]
    assert len(named) == 1
    assert "laser-3.png" in named[0]
    bowed = fitted(thesis_rig(bow_uu_mm=0.15))
    assert not any("all boards but" in warning for warning in bowed.sheets[0].warnings)


def test_a_misfit_that_all_boards_share_is_put_on_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bow of 8 um held to a plane (p 5e-5): without one board or another little of it shows."""
    rig, plane = thesis_rig(bow_uu_mm=0.008), SheetOptions(is_bow_allowed=False)

    def n_named() -> int:
        found = [fitted(rig, seed, plane).sheets[0].warnings for seed in range(10)]
        return sum("all boards but" in " ".join(warnings) for warnings in found)

    assert n_named() == 0
    monkeypatch.setattr(checks, "CLEAR_CHI2", 0.0)
    assert n_named() >= 2


@pytest.mark.parametrize(("wider", "named"), [(1.7, False), (2.5, True)])
def test_an_image_of_a_much_wider_line_is_named(wider: float, named: bool) -> None:
    """A laser moved for one photograph; lines of all boards differ by less than a half."""
    fit = fitted(thesis_rig())
    images = list(fit.images)
    profile = images[2].profile
    images[2] = replace(images[2], profile=replace(profile, width_px=wider * profile.width_px))
    assert about_widths(fit) == ()
    said = about_widths(replace(fit, images=tuple(images)))
    assert len(said) == named
    assert all(text.startswith(images[2].source) for text in said)
    boards = list(fit.boards)
    boards[2] = replace(boards[2], profile=images[2].profile)
    pairs = [(Exposure(np.zeros((2, 2), np.uint8), image.source), None) for image in images]
    whole = laser._fit_sheets(pairs, boards, fit.camera, fit.options)
    assert isinstance(whole, LaserFit)
    assert set(said) <= set(whole.warnings)
    assert any("px wide" in warning for warning in whole.warnings) == named
    few = replace(fit, images=tuple(images[:4]), boards=fit.boards[:4])
    assert about_widths(few) == (), "of so few none is the usual one"


def test_points_are_rejected_for_the_reason_that_holds() -> None:
    rig = thesis_rig()
    rng = np.random.default_rng(5)
    boards = rig.boards(rig.camera, rng)
    board = boards[2]
    q, normal = rig.stripe(2, rig.sheets[0], rng)
    along = (q[-1] - q[0]) / np.linalg.norm(q[-1] - q[0])
    q = np.concatenate([q, q[-1] + along * np.array([[200.0], [220.0]])])
    normal = np.concatenate([normal, normal[-2:]])
    q[50] += 30.0 * normal[50]
    q[60] += 1.5 * normal[60]
    profile = make_profile("mixed.png", [(q, normal)], rig.sigma_stripe_px)
    flags = np.zeros(len(q), dtype=np.int64)
    flags[10] = StripeFlag.NEIGHBOUR
    flags[11] = StripeFlag.SATURATED
    flags[12] = StripeFlag.SATURATED | StripeFlag.PULLED
    boards[2] = BoardStripes(replace(profile, flags=flags), board.view, board.sensor_from_board)
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    use = fit.images[2].use
    assert use[10] == use[12] == PointUse.FLAGGED
    assert use[11] == PointUse.USED
    assert use[50] == use[60] == PointUse.OFF_LINE
    assert (use[-2:] == PointUse.OFF_BOARD).all()
    assert fit.images[2].count(PointUse.USED) >= len(q) - 8
    assert np.isnan(fit.images[2].residual_mm[[10, 50]]).all()


def test_noise_beyond_its_claim_widens_the_covariance() -> None:
    """Stripes four times noisier than they say: the sheet's sigma must follow."""
    rig = thesis_rig()
    rng = np.random.default_rng(1)
    honest = fitted(rig)
    loud = replace(rig, sigma_stripe_px=4.0 * rig.sigma_stripe_px)
    boards = [
        replace(b, profile=replace(b.profile, sigma_px=b.profile.sigma_px / 4.0))
        for b in loud.boards(rig.camera, rng)
    ]
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    assert 3.6 < fit.diagnostics.noise_factor < 4.4
    assert fit.sheets[0].calibration.n_points > 0.98 * honest.sheets[0].calibration.n_points
    loud_own, claimed = (own_covariance(found) for found in (fit, honest))
    assert (np.diag(loud_own) > np.diag(claimed)).all()


def own_covariance(fit: LaserFit) -> np.ndarray:
    """(3, 3) covariance of the plane by stripes and boards, the camera being as calibrated."""
    camera, plane = slice(0, 9), slice(9, 12)
    covariance = fit.covariance
    follow = np.linalg.solve(covariance[camera, camera], covariance[camera, plane])
    return np.asarray(covariance[plane, plane] - covariance[plane, camera] @ follow)


def test_nothing_on_the_board_is_refused() -> None:
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(0))
    far = [replace(b, profile=b.profile.select(np.arange(len(b.profile)) < 5)) for b in boards]
    fit = calibrate_sheets(far, rig.calibration(rig.camera))
    assert not isinstance(fit, LaserFit)
    assert "no straight stripe" in fit.reason


@pytest.mark.parametrize(
    "bad",
    [
        {"margin_mm": float("inf")},
        {"margin_mm": float("nan")},
        {"n_sheets": -1},
        {"sheet_names": ("A", "A")},
        {"sheet_names": ("A", "B"), "n_sheets": 3},
    ],
)
def test_bad_options_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        SheetOptions(**bad)  # type: ignore[arg-type]


def _scaled(covariance: np.ndarray) -> np.ndarray:
    sigma = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(sigma, sigma))
