# SPDX-License-Identifier: Apache-2.0
"""Stripes that are pulled along edges of the target, or that claim a wrong noise."""

from dataclasses import replace

import numpy as np

from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit, PointUse
from armscan.calibration.sheets.stripes_on_board import PULL_WIDTHS, TargetEdges, runs_along_edge
from rigs.sheet_rig import SheetRig, thesis_rig

PULL_PX = 0.25


def fitted(rig: SheetRig, boards: list[BoardStripes]) -> LaserFit:
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit), fit
    return fit


def height_mm(rig: SheetRig, fit: LaserFit) -> float:
    """Root mean square distance of the sheet from the true plane, over its points."""
    sheet = fit.sheets[0].sheet
    points = np.concatenate([i.points_mm[i.use == PointUse.USED] for i in fit.images])
    height, _, _ = sheet.height_with_jacobian(points)
    truth = rig.sheets[0].height_mm(points - height[:, None] * sheet.axes[2])
    return float(np.sqrt((truth**2).mean()))


def pulled(board: BoardStripes) -> BoardStripes:
    """The first third of the stripe runs beside an edge and is pulled towards it."""
    profile = board.profile
    n = len(profile) // 3
    points, normals = profile.points_px.copy(), profile.normals_px[:n]
    edge = points[:n] + 2.0 * profile.width_px[:n, None] * normals
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    points[:n] += PULL_PX * normals
    moved = replace(profile, points_px=points)
    return replace(board, profile=moved, on_edge=runs_along_edge(moved, TargetEdges(edge, along)))


def test_points_along_an_edge_are_left_out_and_the_sheet_is_right() -> None:
    rig = thesis_rig()
    boards = [pulled(b) for b in rig.boards(rig.camera, np.random.default_rng(3))]
    fit = fitted(rig, boards)
    for image in fit.images:
        n = len(image.profile) // 3
        assert (image.use[1:n] == PointUse.ON_EDGE).all(), "the first may lie off the board"
        assert image.count(PointUse.ON_EDGE) < n + 12, "the edge's ends reach 9 px further"
        assert image.count(PointUse.USED) > 0.5 * len(image.profile)
    assert height_mm(rig, fit) < 3.0 * fit.sheets[0].offset_sigma_mm
    every = fitted(rig, [replace(b, on_edge=np.zeros_like(b.on_edge)) for b in boards])
    assert all(image.count(PointUse.ON_EDGE) == 0 for image in every.images)
    assert every.sheets[0].diagnostics.rms_px > 1.3 * fit.sheets[0].diagnostics.rms_px


def test_an_edge_that_crosses_the_stripe_costs_no_point() -> None:
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(3))
    crossed = [
        replace(
            b,
            on_edge=runs_along_edge(
                b.profile, TargetEdges(b.profile.points_px, b.profile.normals_px)
            ),
        )
        for b in boards
    ]
    fit = fitted(rig, crossed)
    assert all(image.count(PointUse.ON_EDGE) == 0 for image in fit.images)


def test_a_stripe_that_claims_too_little_noise_gets_no_say_for_it() -> None:
    """Claims wrong by 0.05 to 20 from board to board: the sheet stays within a fraction of it."""
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(6))
    claims = (0.05, 1.0, 20.0, 1.0, 4.0, 0.3)
    wrong = [
        replace(b, profile=replace(b.profile, sigma_px=b.profile.sigma_px * claim))
        for b, claim in zip(boards, claims, strict=True)
    ]
    plain, other = fitted(rig, boards).sheets[0], fitted(rig, wrong).sheets[0]
    moved, _, _ = other.sheet.height_with_jacobian(plain.sheet.origin_mm[None])
    assert abs(float(moved[0])) < 0.3 * plain.offset_sigma_mm
    assert 0.8 < other.offset_sigma_mm / plain.offset_sigma_mm < 1.25


def test_coplanarity_of_two_boards_against_correlated_noise() -> None:
    """Stripes 1.8 times noisier than they say, 17 points alike: 60 trials, one freedom each.

    The root mean square of 60 unit normals is 1 +- 0.09; two sigma allowed. Ends of a stripe
    that were taken to err independently would give 0.8.
    """
    rig = thesis_rig()
    rig = replace(
        rig,
        poses=(rig.poses[1], rig.poses[4]),
        camera_covariance=1e-6 * rig.camera_covariance,
        sigma_corner_px=0.01,
        sigma_stripe_px=0.3,
        correlated_points=17,
        points_per_stripe=300,
    )
    sigmas = []
    for seed in range(60):
        boards = [
            replace(b, profile=replace(b.profile, sigma_px=b.profile.sigma_px / 1.8))
            for b in rig.boards(rig.camera, np.random.default_rng(seed))
        ]
        sheet = fitted(rig, boards).sheets[0]
        sigmas.append(sheet.diagnostics.coplanarity_mm / sheet.diagnostics.coplanarity_sigma_mm)
    assert 0.82 < np.sqrt(np.mean(np.square(sigmas))) < 1.18


def test_a_stripe_that_runs_along_the_pattern_is_used_as_less_certain() -> None:
    """On one board an edge runs along the whole stripe: it is not lost, and weighs little."""
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(4))
    profile = boards[2].profile
    along = np.stack([-profile.normals_px[:, 1], profile.normals_px[:, 0]], axis=1)
    beside = TargetEdges(profile.points_px + 2.0 * profile.normals_px, along)
    pulled_px = profile.points_px + PULL_PX * profile.normals_px
    pulled = replace(profile, points_px=pulled_px)
    boards[2] = replace(boards[2], on_edge=runs_along_edge(pulled, beside), profile=pulled)
    fit = fitted(rig, boards)
    used = fit.images[2].use == PointUse.USED
    assert used.sum() > 0.8 * len(profile)
    widened = fit.images[2].profile.sigma_px[used]
    assert (widened >= PULL_WIDTHS * profile.width_px[used]).all()
    without = fitted(rig, boards[:2] + boards[3:])
    shift = fit.sheets[0].sheet.plane - without.sheets[0].sheet.plane
    assert height_mm(rig, fit) < 3.0 * fit.sheets[0].offset_sigma_mm
    assert abs(shift[3]) < without.sheets[0].offset_sigma_mm
