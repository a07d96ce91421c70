# SPDX-License-Identifier: Apache-2.0
"""The joint fit against generalised least squares with one full covariance matrix, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.sheets import solve
from armscan.calibration.sheets.solve import (
    CommonErrors,
    SheetObservations,
    SheetSolution,
    solve_sheets,
    square_matrix_root,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet

N_IMAGES, N_STRIPE = 4, 15
SIGMA_PX = 0.1
FLAT = LightSheet(
    origin_mm=np.array([1.0, -2.0, 100.0]),
    axes=np.eye(3)[[0, 2, 1]] * [1, 1, -1],
    scale_mm=20.0,
    bow_mm=np.zeros(5),
)


def correlated(rng: np.random.Generator, sigma: FloatArray) -> FloatArray:
    """A covariance with strong correlations, as that of a real camera."""
    mixing = np.linalg.qr(rng.normal(size=(len(sigma), len(sigma))))[0]
    correlation = mixing @ np.diag(np.geomspace(0.01, 3, len(sigma))) @ mixing.T
    return np.asarray(correlation * np.outer(sigma, sigma))


def observations(rng: np.random.Generator) -> SheetObservations:
    """Points within 1e-5 mm of the plane, so that the fit is linear to 1e-9."""
    n = N_IMAGES * N_STRIPE
    image = np.repeat(np.arange(N_IMAGES), N_STRIPE)
    local = np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.normal(0.0, 1e-5, n)])
    return SheetObservations(
        image=image,
        row=np.arange(n),
        board=image,
        sheet=np.zeros(n, dtype=np.int64),
        stripe=image,
        points_mm=FLAT.origin_mm + local @ FLAT.axes,
        across_mm_px=np.tile(0.03 * FLAT.axes[2] + 0.01 * FLAT.axes[0], (n, 1)),
        sigma_px=np.full(n, 1e-4 * SIGMA_PX),
        dpoint_dpose=1e-4 * rng.normal(size=(n, 3, 6)),
        dpoint_dcamera=1e-4 * smooth(local, rng),
    )


def smooth(local: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, 3, 9) camera derivatives that shift, tilt and bend: the sheet follows most of them."""
    u, v = local[:, 0] / 20.0, local[:, 1] / 20.0
    shapes = np.stack([np.ones_like(u), u, v, u * v], axis=1)
    return np.asarray(np.einsum("ns,sij->nij", shapes, rng.normal(size=(4, 3, 9))))


def test_fit_and_joint_covariance_are_those_of_the_full_matrix() -> None:
    """With V of stripes, boards and camera: G = (A'V^-1 A)^-1 A'V^-1, step -G r, cov(s, c) -G B C.

    A camera that errs by e moves the residuals by B e and so the sheet by -G B e.
    """
    rng = np.random.default_rng(3)
    points = observations(rng)
    pose = [correlated(rng, np.full(6, 0.01)) for _ in range(N_IMAGES)]
    camera = correlated(rng, np.geomspace(0.001, 0.1, 9))
    solution = solve_sheets(points, [FLAT], CommonErrors(pose, camera), [False])
    assert isinstance(solution, SheetSolution)
    assert solution.has_converged

    _, residual, by_sheet, by_point = points.residuals_px([FLAT])
    by_camera = np.einsum("ni,nij->nj", by_point, points.dpoint_dcamera)
    by_pose = np.einsum("ni,nij->nj", by_point, points.dpoint_dpose)
    full = np.diag(points.sigma_px**2) + by_camera @ camera @ by_camera.T
    for i in range(N_IMAGES):
        own = np.ix_(points.image == i, points.image == i)
        full[own] += by_pose[points.image == i] @ pose[i] @ by_pose[points.image == i].T
    design = by_sheet[:, :3]
    sheet_covariance = np.linalg.inv(design.T @ np.linalg.solve(full, design))
    gain = sheet_covariance @ np.linalg.solve(full, design).T
    remaining = residual - design @ (gain @ residual)

    found = solution.covariance
    np.testing.assert_allclose(found[:9, :9], camera, rtol=1e-12)
    sigma = np.sqrt(np.diag(sheet_covariance))
    np.testing.assert_allclose(
        found[9:12, 9:12] / np.outer(sigma, sigma),
        sheet_covariance / np.outer(sigma, sigma),
        atol=1e-5,
    )
    scale = np.outer(sigma, np.sqrt(np.diag(camera)))
    cross = -gain @ by_camera @ camera
    assert np.abs(cross / scale).max() > 0.1, "the case must have something to find"
    np.testing.assert_allclose(found[9:12, :9] / scale, cross / scale, atol=1e-5)
    np.testing.assert_array_equal(found[12:], 0.0)
    expected = remaining @ np.linalg.solve(full, remaining)
    np.testing.assert_allclose(solution.chi2, expected, rtol=1e-5)
    assert solution.common @ solution.common > 0.01 * expected, "boards and camera must have moved"


def test_sheets_of_cameras_that_are_held_are_those_of_the_conditional_estimate() -> None:
    """Weights by stripes and boards alone; e_s = D e_c + n with D = -G B, cov(s) = N + D C D'."""
    rng = np.random.default_rng(3)
    points = observations(rng)
    pose = [correlated(rng, np.full(6, 0.01)) for _ in range(N_IMAGES)]
    camera = correlated(rng, np.geomspace(0.001, 0.1, 9))
    errors = CommonErrors(pose, camera)
    held = solve_sheets(points, [FLAT], errors, [False], are_cameras_held=True)
    free = solve_sheets(points, [FLAT], errors, [False])
    assert isinstance(held, SheetSolution)
    assert isinstance(free, SheetSolution)
    np.testing.assert_array_equal(held.common[-9:], 0.0)

    _, residual, by_sheet, by_point = points.residuals_px([FLAT])
    by_camera = np.einsum("ni,nij->nj", by_point, points.dpoint_dcamera)
    by_pose = np.einsum("ni,nij->nj", by_point, points.dpoint_dpose)
    known = np.diag(points.sigma_px**2)
    for i in range(N_IMAGES):
        own = points.image == i
        known[np.ix_(own, own)] += by_pose[own] @ pose[i] @ by_pose[own].T
    design = by_sheet[:, :3]
    own_covariance = np.linalg.inv(design.T @ np.linalg.solve(known, design))
    gain = own_covariance @ np.linalg.solve(known, design).T
    follow = -gain @ by_camera
    expected = FLAT.updated(np.append(-gain @ residual, np.zeros(5)))
    sigma = np.sqrt(np.diag(own_covariance))
    off = held.sheets[0].height_with_jacobian(points.points_mm)[0]
    np.testing.assert_allclose(
        off, expected.height_with_jacobian(points.points_mm)[0], atol=1e-4 * sigma.max()
    )
    moved = free.sheets[0].height_with_jacobian(points.points_mm)[0]
    assert np.abs(moved - off).max() > 0.1 * sigma.max(), "the case must have something to find"
    joint = np.block([[camera, camera @ follow.T], [follow @ camera, np.zeros((3, 3))]])
    joint[9:, 9:] = own_covariance + follow @ camera @ follow.T
    scale = np.sqrt(np.diag(joint))
    np.testing.assert_allclose(
        held.covariance[:12, :12] / np.outer(scale, scale),
        joint / np.outer(scale, scale),
        atol=1e-5,
    )


def test_square_root_of_a_covariance_without_full_rank() -> None:
    sigma = np.array([600.0, 0.0, 1e-5])
    covariance = np.outer(sigma, sigma)
    root = square_matrix_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-9)


EXACT = CommonErrors([np.zeros((6, 6))] * N_IMAGES, np.zeros((9, 9)))


def test_points_on_one_line_are_a_failure_and_no_traceback() -> None:
    points = observations(np.random.default_rng(4))
    along = (points.points_mm - FLAT.origin_mm) @ FLAT.axes[0]
    line = replace(points, points_mm=FLAT.origin_mm + along[:, None] * FLAT.axes[0])
    failure = solve_sheets(line, [FLAT], EXACT, [False])
    assert isinstance(failure, FitFailure)
    assert "do not determine" in failure.reason


def test_too_few_steps_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a start that is 5 degrees off one step is not enough."""
    points = observations(np.random.default_rng(5))
    start = FLAT.updated(np.array([1.75, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    settled = solve_sheets(points, [start], EXACT, [False])
    assert isinstance(settled, SheetSolution)
    assert settled.has_converged
    monkeypatch.setattr(solve, "ITERATIONS", 1)
    hasty = solve_sheets(points, [start], EXACT, [False])
    assert isinstance(hasty, SheetSolution)
    assert not hasty.has_converged


def test_a_robust_fit_does_not_stay_where_least_squares_end() -> None:
    """The first step from there is none, and only then are points weighed."""
    rng = np.random.default_rng(5)
    points = replace(observations(rng), sigma_px=np.full(N_IMAGES * N_STRIPE, 1e-4))
    off = rng.random(len(points)) < 0.1
    moved = replace(points, points_mm=points.points_mm + 2e-3 * off[:, None] * FLAT.axes[2])
    exact = CommonErrors([np.zeros((6, 6))] * N_IMAGES, np.zeros((9, 9)))
    plain = solve_sheets(moved, [FLAT], exact, [False])
    assert isinstance(plain, SheetSolution)
    robust = [
        solve_sheets(moved, [start], exact, [False], is_robust=True)
        for start in (FLAT, plain.sheets[0])
    ]
    assert all(isinstance(one, SheetSolution) for one in robust)
    from_flat, from_plain, least_squares = (
        one.sheets[0].height_with_jacobian(points.points_mm)[0]
        for one in (*robust, plain)
        if isinstance(one, SheetSolution)
    )
    assert np.abs(least_squares - from_flat).max() > 1e-4, "the case must have something to find"
    np.testing.assert_allclose(from_plain, from_flat, atol=1e-6)


def test_stripes_are_told_by_their_numbers_in_any_order() -> None:
    points = observations(np.random.default_rng(1))
    numbers = np.array([7, 2, 4, 7, 2, 2, 9])
    few = replace(points.select(np.arange(7)), stripe=numbers)
    assert [rows.tolist() for rows in few.each_stripe()] == [[1, 4, 5], [2], [0, 3], [6]]
    assert [len(rows) for rows in few.select(np.arange(1)).each_stripe()] == [1]
    assert few.select(np.arange(0)).each_stripe() == []
