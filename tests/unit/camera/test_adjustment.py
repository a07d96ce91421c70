# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.adjustment import (
    SHARED_NAMES,
    Observations,
    State,
    adjust,
    basis_of,
    damped_step,
    free_basis,
    gather,
    joint_covariance,
    linearise,
    moved,
    normal_equations,
    predict,
    predict_px,
)
from armscan.calibration.cameras.result import CameraOptions
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import Lens
from rigs.camera_scene import CAMERA, Scene, make_views

SCENE = Scene(n_views=4, bow_mm=(0.3, -0.2))
BASIS = basis_of(SHARED_NAMES, is_aspect_fixed=False)


def problem(seed: int = 1) -> tuple[Observations, State]:
    views, poses = make_views(SCENE, seed)
    shared = np.append(CAMERA.parameters, SCENE.bow_mm)
    return gather(views, "pinhole"), State.from_poses(shared, poses)


def dense_jacobian(observations: Observations, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Whitened Jacobian (2N, 11 + 6 V) and residual, by central differences alone."""
    n_views = len(state.rotations)

    def residual(shared_step: np.ndarray, pose_steps: np.ndarray) -> np.ndarray:
        trial = moved(state, np.eye(11), shared_step, pose_steps)
        prediction = predict(observations, trial)
        assert prediction is not None
        error = observations.points_px - prediction[0]
        return np.einsum("nij,nj->ni", observations.whitening, error).ravel()

    still = np.zeros((n_views, 6))
    columns = []
    for index in range(11):
        step = 1e-5 * max(1.0, abs(state.shared[index])) * np.eye(11)[index]
        width = 2.0 * step[index]
        columns.append(-(residual(step, still) - residual(-step, still)) / width)
    for index in range(6 * n_views):
        step = 1e-5 * np.eye(6 * n_views)[index].reshape(n_views, 6)
        columns.append(-(residual(np.zeros(11), step) - residual(np.zeros(11), -step)) / 2e-5)
    return np.stack(columns, axis=1), residual(np.zeros(11), still)


def test_normal_equations_are_those_of_central_differences() -> None:
    observations, state = problem()
    jacobian, residual = dense_jacobian(observations, state)
    equations = linearise(observations, state, BASIS, np.ones(len(residual) // 2))
    assert equations is not None
    normal, right = jacobian.T @ jacobian, jacobian.T @ residual
    scale = np.sqrt(np.diag(normal))
    unit = normal / np.outer(scale, scale)
    assert np.isclose(equations.chi2, residual @ residual)
    assert np.abs(equations.shared / np.outer(scale[:11], scale[:11]) - unit[:11, :11]).max() < 1e-6
    assert np.abs((equations.shared_gradient - right[:11]) / scale[:11]).max() < 1e-4
    for v in range(4):
        rows = slice(11 + 6 * v, 17 + 6 * v)
        cross = equations.cross[v] / np.outer(scale[:11], scale[rows])
        pose = equations.pose[v] / np.outer(scale[rows], scale[rows])
        assert np.abs(cross - unit[:11, rows]).max() < 1e-6
        assert np.abs(pose - unit[rows, rows]).max() < 1e-6


def test_step_and_covariance_are_those_of_the_dense_system() -> None:
    observations, state = problem(2)
    jacobian, residual = dense_jacobian(observations, state)
    equations = linearise(observations, state, BASIS, np.ones(len(residual) // 2))
    assert equations is not None
    scale = np.linalg.norm(jacobian, axis=0)
    unit = jacobian / scale
    dense_step = np.linalg.lstsq(unit, residual, rcond=None)[0]
    dense_covariance = np.linalg.inv(unit.T @ unit)
    step = damped_step(equations, 0.0)
    assert step is not None
    ours = np.concatenate([step[0], step[1].ravel()]) * scale
    sigma = np.sqrt(np.diag(dense_covariance))
    assert np.abs((ours - dense_step) / sigma).max() < 1e-3
    joint = joint_covariance(equations, BASIS)
    assert not isinstance(joint, FitFailure)
    scaled = joint[0] * np.outer(scale, scale) / np.outer(sigma, sigma)
    assert np.abs(scaled - dense_covariance / np.outer(sigma, sigma)).max() < 1e-3


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_points_alone_are_to_the_bit_those_that_come_with_derivatives(lens: Lens) -> None:
    observations, state = problem(3)
    if lens == "fisheye":
        state.shared[6:8] = 0.0
    observations = replace(observations, lens=lens)
    both = predict(observations, state)
    assert both is not None
    assert np.array_equal(both[0], predict_px(observations, state))
    behind = replace(state, translations_mm=-state.translations_mm)
    assert predict_px(observations, behind) is None


def test_weights_leave_points_out_exactly() -> None:
    views, poses = make_views(SCENE, 3)
    observations = gather(views, "pinhole")
    start = State.from_poses(np.append(CAMERA.parameters, np.zeros(2)), poses)
    weights = np.ones(len(observations.points_px))
    weights[::7] = 0.0
    with_zeros = adjust(observations, start, BASIS, weights)
    spoiled = observations.points_px.copy()
    spoiled[::7] += 100.0
    other = replace(observations, points_px=spoiled)
    spoiled_fit = adjust(other, start, BASIS, weights)
    assert not isinstance(with_zeros, FitFailure)
    assert not isinstance(spoiled_fit, FitFailure)
    assert np.array_equal(with_zeros.state.shared, spoiled_fit.state.shared)


def test_noise_free_views_give_the_truth_back_from_a_poor_start() -> None:
    scene = Scene(noise_px=0.0)
    views, poses = make_views(scene, 4)
    observations = gather(views, "pinhole")
    poor = np.append(CAMERA.parameters * [1.05, 0.96, 1.02, 0.98, 0.5, 0, 0, 0, 0], np.zeros(2))
    basis, names = free_basis("k1k2p1p2k3", CameraOptions())
    result = adjust(observations, State.from_poses(poor, poses), basis)
    assert not isinstance(result, FitFailure)
    assert names == SHARED_NAMES[:9]
    assert np.abs(result.state.shared[:4] - CAMERA.parameters[:4]).max() < 1e-5
    assert np.abs(result.state.shared[4:9] - CAMERA.distortion).max() < 1e-5
    for found, truth in zip(result.state.rotations, poses, strict=True):
        assert np.abs(found - truth.rotation).max() < 1e-8


def test_fixed_aspect_and_centre_stay_fixed() -> None:
    options = CameraOptions(is_aspect_fixed=True, is_principal_point_fixed=True)
    basis, names = free_basis("k1k2", options)
    assert names == ("fx_px", "k1", "k2")
    step = basis @ np.array([2.0, 0.1, 0.2])
    assert step.tolist() == [2.0, 2.0, 0.0, 0.0, 0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_impossible_states_have_no_prediction() -> None:
    observations, state = problem(5)
    behind = State(state.shared, state.rotations, -state.translations_mm)
    negative = State(-state.shared, state.rotations, state.translations_mm)
    assert predict(observations, behind) is None
    assert predict(observations, negative) is None
    assert isinstance(adjust(observations, behind, BASIS), FitFailure)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_one_pass_over_the_points_sums_what_the_prediction_says(lens: Lens) -> None:
    """The compiled pass beside NumPy's, with weights, points without a say and a fixed aspect."""
    observations, state = problem(4)
    observations = replace(observations, lens=lens)
    if lens == "fisheye":
        shared = state.shared.copy()
        shared[6:8] = 0.0
        state = State(shared, state.rotations, state.translations_mm)
    rng = np.random.default_rng(5)
    weights = rng.uniform(0.0, 2.0, len(observations.points_px))
    weights[::7] = 0.0
    basis = basis_of(["fx_px", "cy_px", "k1", "p2", "k3", "bow_y_mm"], is_aspect_fixed=True)
    prediction = predict(observations, state)
    equations = linearise(observations, state, basis, weights)
    assert prediction is not None
    assert equations is not None
    predicted, by_shared, by_pose = prediction
    twin = normal_equations(observations, predicted, by_shared @ basis, by_pose, weights)
    for name in ("chi2", "shared", "cross", "pose", "shared_gradient", "pose_gradient"):
        ours, theirs = np.asarray(getattr(equations, name)), np.asarray(getattr(twin, name))
        largest = np.abs(theirs).max(axis=0)
        assert np.all(np.abs(ours - theirs) <= 1e-9 * (largest + 1e-12)), name


def test_a_board_behind_the_camera_has_no_equations() -> None:
    observations, state = problem()
    behind = state.translations_mm.copy()
    behind[2, 2] *= -1.0
    turned = State(state.shared, state.rotations, behind)
    weights = np.zeros(len(observations.points_px))
    assert linearise(observations, turned, BASIS, weights) is None
    assert predict(observations, turned) is None
