# SPDX-License-Identifier: Apache-2.0
"""From a solution to a `CameraFit`: covariance, evidence of each view, warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.camera.advice import advise
from armscan.calibration.camera.board_pose import estimate_board_pose
from armscan.calibration.camera.covariance import joint_covariance
from armscan.calibration.camera.coverage import measure_coverage
from armscan.calibration.camera.cross_validation import cross_validate, rms
from armscan.calibration.camera.model_choice import ChosenModel
from armscan.calibration.camera.noise import claimed_covariances
from armscan.calibration.camera.observations import free_basis, gather
from armscan.calibration.camera.options import CameraOptions
from armscan.calibration.camera.prepared_views import PreparedViews
from armscan.calibration.camera.result import CameraFit, RefusedView, ViewFit
from armscan.calibration.camera.robust import Solution, chi2_of_points, residuals_px
from armscan.calibration.camera.target_error import (
    board_residuals,
    covariance_with_target_error,
    estimate_target_error,
)
from armscan.calibration.camera.warp import judge_warp, with_warp
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.models.camera import CameraModel
from armscan.vision.targets.view import TargetView

N_CAMERA, N_SHARED = 9, 11
MAX_RELATIVE_FOCAL_SIGMA = 0.05


def assemble(
    views: Sequence[TargetView],
    prepared: PreparedViews,
    chosen: ChosenModel,
    is_misfit: BoolArray,
    options: CameraOptions,
) -> CameraFit | FitFailure:
    """Put the result together, or refuse a solution that the views do not determine."""
    used = [views[index] for index in prepared.used]
    solution, validation = chosen.solution, chosen.cross_validation
    if options.solve_warp:
        bowed = with_warp(solution, options.max_steps)
        if isinstance(bowed, FitFailure):
            return bowed
        solution = bowed
        sources = tuple(view.source for view in used)
        validation = cross_validate(solution, sources, options.n_folds)
    observations = solution.observations
    determined = joint_covariance(solution.equations, solution.basis)
    if isinstance(determined, FitFailure):
        return determined
    found = board_residuals(solution)
    target_error = estimate_target_error(found)
    covariance = covariance_with_target_error(
        determined[0], solution.variance_factor, target_error, found
    )
    condition = determined[1]
    refusal = _focal_refusal(solution, covariance)
    if refusal is not None:
        return refusal
    warp = judge_warp(chosen.solution, solution, covariance) if options.solve_warp else None
    camera = solution.state.camera(observations.width_px, observations.height_px)
    fits, refused = _view_fits(
        views, prepared, solution, covariance=covariance, is_misfit=is_misfit, camera=camera
    )
    kept = solution.weights > 0.0
    coverage = measure_coverage(
        observations.points_px[kept],
        solution.state.rotations[:, :, 2],
        observations.width_px,
        observations.height_px,
    )
    rows = np.r_[:N_CAMERA, N_SHARED : len(covariance)]
    fit = CameraFit(
        camera=camera,
        covariance=covariance[:N_CAMERA, :N_CAMERA],
        free_parameters=free_basis(chosen.model, options, with_warp=False)[1],
        joint_covariance=covariance[np.ix_(rows, rows)],
        views=fits,
        refused_views=prepared.refused + refused,
        rms_px=rms(residuals_px(observations, solution.state)[kept]),
        sigma_point_px=_sigma_point_px(solution),
        noise_scale=_noise_scale(used, solution),
        target_error_mm=target_error.sigma_mm,
        degrees_of_freedom=solution.degrees_of_freedom,
        condition=condition,
        coverage=coverage,
        cross_validation=validation,
        warp=warp,
        model_reason=chosen.reason,
        warnings=(),
        options=options,
    )
    repeats = [(views[a].source, views[b].source) for a, b in prepared.repeats.items()]
    return advise(fit, repeats, is_converged=solution.is_converged)


def _focal_refusal(solution: Solution, covariance: FloatArray) -> FitFailure | None:
    relative = np.sqrt(np.diag(covariance)[:2]) / solution.state.shared[:2]
    if relative.max() <= MAX_RELATIVE_FOCAL_SIGMA:
        return None
    return FitFailure(
        f"the focal length is uncertain by {100 * relative.max():.0f} %",
        "tilt the board by 20 to 45 degrees, in a different direction from view to view, and "
        "check the number of columns and rows",
    )


def _sigma_point_px(solution: Solution) -> float:
    kept = solution.weights > 0.0
    covariances = claimed_covariances(solution.observations)[kept]
    mean_variance = 0.5 * float(np.mean(np.trace(covariances, axis1=1, axis2=2)))
    return float(np.sqrt(mean_variance * solution.variance_factor))


def _noise_scale(used: Sequence[TargetView], solution: Solution) -> float:
    kept = solution.weights > 0.0
    chi2 = float(chi2_of_points(gather(used), solution.state)[kept].sum())
    return float(np.sqrt(chi2 / max(solution.degrees_of_freedom, 1)))


def _view_fits(
    views: Sequence[TargetView],
    prepared: PreparedViews,
    solution: Solution,
    *,
    covariance: FloatArray,
    is_misfit: BoolArray,
    camera: CameraModel,
) -> tuple[tuple[ViewFit, ...], tuple[RefusedView, ...]]:
    """Evidence of each view with a pose, in the order given."""
    observations = solution.observations
    residuals = residuals_px(observations, solution.state)
    fits: dict[int, ViewFit] = {}
    refused: list[RefusedView] = []
    for position, index in enumerate(prepared.used):
        rows = observations.rows(position)
        block = slice(N_SHARED + 6 * position, N_SHARED + 6 * position + 6)
        fits[index] = _view_fit(
            views[index],
            solution.state.pose(position),
            covariance=covariance[block, block],
            residuals=residuals[rows],
            is_outlier=solution.weights[rows] == 0.0,
            level=float(solution.view_levels[position]),
            is_misfit=bool(is_misfit[position]),
        )
    for index, note in prepared.left_out.items():
        left = _left_out_fit(views[index], camera, solution, note)
        if isinstance(left, FitFailure):
            refused.append(RefusedView(views[index].source, f"{note}; {left.reason}"))
        else:
            fits[index] = left
    return tuple(fits[index] for index in sorted(fits)), tuple(refused)


def _view_fit(
    view: TargetView,
    pose: Pose[Sensor, Board],
    *,
    covariance: FloatArray,
    residuals: FloatArray,
    is_outlier: BoolArray,
    level: float,
    is_misfit: bool,
    left_out: str = "",
) -> ViewFit:
    note = left_out
    if is_misfit:
        note = f"residuals {np.sqrt(level):.1f} times those of the typical view: leave it out"
    middle = pose.rotation @ view.points_board_mm.mean(axis=0) + pose.translation_mm
    tilt = float(np.rad2deg(np.arccos(min(1.0, abs(float(pose.rotation[2, 2]))))))
    return ViewFit(
        view=view,
        sensor_from_board=pose,
        pose_covariance=covariance,
        residuals_px=residuals,
        is_outlier=is_outlier,
        chi2_per_point=level,
        tilt_deg=tilt,
        distance_mm=float(middle[2]),
        is_used=not left_out,
        is_misfit=is_misfit,
        note=note,
    )


def _left_out_fit(
    view: TargetView,
    camera: CameraModel,
    solution: Solution,
    note: str,
) -> ViewFit | FitFailure:
    bow = solution.state.shared[N_CAMERA:]
    pose = estimate_board_pose(view, camera, bow_mm=bow, allow_ambiguous=True)
    if isinstance(pose, FitFailure):
        return pose
    typical = float(
        np.mean(np.sum(residuals_px(solution.observations, solution.state) ** 2, axis=1))
    )
    level = float(np.mean(np.sum(pose.residuals**2, axis=1))) / max(typical, 1e-300)
    return _view_fit(
        view,
        pose.value,
        covariance=pose.covariance,
        residuals=pose.residuals,
        is_outlier=np.zeros(len(view), dtype=np.bool_),
        level=level,
        is_misfit=False,
        left_out=note,
    )
