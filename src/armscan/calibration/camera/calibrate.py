# SPDX-License-Identifier: Apache-2.0
"""Camera calibration on a flat target (eqs. 2.27 to 2.39)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.camera.assembly import assemble
from armscan.calibration.camera.coverage import largest_angle_deg
from armscan.calibration.camera.cross_validation import cross_validate
from armscan.calibration.camera.model_choice import ChosenModel, choose_model
from armscan.calibration.camera.noise import (
    claimed_covariances,
    excess_variance_px2,
    with_excess,
)
from armscan.calibration.camera.observations import Observations, free_basis, gather
from armscan.calibration.camera.options import CameraOptions, DistortionModel
from armscan.calibration.camera.prepared_views import PreparedViews, prepare_views
from armscan.calibration.camera.result import CameraFit, CrossValidation
from armscan.calibration.camera.robust import (
    MISFIT_LEVEL,
    MISFIT_OUTLIERS,
    Solution,
    chi2_of_points,
    residuals_px,
    solve_robustly,
)
from armscan.calibration.camera.starting_values import starting_state
from armscan.geometry.arrays import BoolArray
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.view import TargetView

WRONG_LEVEL = 100.0
"""A view whose residuals are ten times those of the typical view is not noisy but wrong: numbered
wrongly, or moved during the exposure."""

EXCESS_ROUNDS = 2

MIN_ANGLE_DEG = 5.0
"""Boards that differ in tilt by less than this are parallel: the focal length is not determined."""

PARALLEL = FitFailure(
    "the board is parallel to itself in all views (tilts differ by less than "
    f"{MIN_ANGLE_DEG:.0f} degrees), so that the focal length is not determined",
    "tilt the board by 20 to 45 degrees, in a different direction from view to view",
)


def calibrate_camera(
    views: Sequence[TargetView], options: CameraOptions | None = None
) -> CameraFit | FitFailure:
    """Calibrate a camera from views of one flat target.

    Homographies and Zhang's closed form (eqs. 2.27 to 2.35) and linear distortion (2.36 to 2.38)
    start a Levenberg-Marquardt solution over intrinsics, distortion and all poses (2.39), each
    point weighted by its covariance (see `armscan.calibration.camera.noise` for what is added to
    the detector's). The covariance is that of the normal equations, scaled by sigma0 squared =
    chi2 / degrees of freedom: the point covariances give the weights, the residuals the level.

    A target of wrong size in mm cannot be noticed here: it scales the poses and leaves the camera
    as it is. A numbering that starts at the opposite corner of a symmetric target is harmless.

    Parameters
    ----------
    views
        One a photograph, all of one camera.
    options
        See `CameraOptions`.

    Returns
    -------
    fit
        The camera with its evidence; or why the views do not determine one.

    Raises
    ------
    InputError
        If the images differ in size, or two views have one name.
    OptionError
        If a view to leave out does not exist.
    """
    options = options or CameraOptions()
    prepared = prepare_views(views, options)
    if isinstance(prepared, FitFailure):
        return prepared
    chosen = _solve_model(views, prepared, options)
    if isinstance(chosen, FitFailure):
        return chosen
    while (bad := _to_leave_out(chosen.solution, options)).any():
        smaller = _without(bad, prepared, chosen.solution)
        if len(smaller.used) < max(3, len(prepared.used) // 2):
            break
        again = _solve_model(views, smaller, options)
        if isinstance(again, FitFailure):
            break
        prepared, chosen = smaller, again
    return assemble(views, prepared, chosen, misfits(chosen.solution), options)


def misfits(solution: Solution) -> BoolArray:
    """(V,) True for views that fit so much worse than the typical one that they should go."""
    return np.asarray(
        (solution.view_levels > MISFIT_LEVEL) | (solution.outlier_shares > MISFIT_OUTLIERS)
    )


def _to_leave_out(solution: Solution, options: CameraOptions) -> BoolArray:
    """Misfits if wanted; views that are plainly wrong in any case."""
    if options.leave_out_misfits:
        return misfits(solution)
    return np.asarray(solution.view_levels > WRONG_LEVEL)


def _without(bad: BoolArray, prepared: PreparedViews, solution: Solution) -> PreparedViews:
    left_out = dict(prepared.left_out)
    for position, index in enumerate(prepared.used):
        if bad[position]:
            ratio = float(np.sqrt(solution.view_levels[position]))
            left_out[index] = f"left out: residuals {ratio:.1f} times those of the typical view"
    keep = [position for position in range(len(prepared.used)) if not bad[position]]
    used = tuple(prepared.used[position] for position in keep)
    return PreparedViews(
        used,
        tuple(prepared.homographies[position] for position in keep),
        left_out,
        prepared.refused,
        {later: earlier for later, earlier in prepared.repeats.items() if later in used},
    )


def _solve_model(
    views: Sequence[TargetView], prepared: PreparedViews, options: CameraOptions
) -> ChosenModel | FitFailure:
    """Solve with the wanted model, or with the one that the rule chooses."""
    used = [views[index] for index in prepared.used]
    observations = gather(used)
    sources = tuple(view.source for view in used)

    def solve(model: DistortionModel) -> Solution | FitFailure:
        return _solve(used, observations, prepared, model, options)

    def validate(solution: Solution, reference: Solution) -> CrossValidation | None:
        on_points = replace(solution, weights=reference.weights)
        return cross_validate(on_points, sources, options.n_folds)

    def folds(solution: Solution) -> bool:
        camera = solution.state.camera(observations.width_px, observations.height_px)
        return len(camera.folded_border()) > 0

    if options.distortion == "auto" and options.n_folds:
        return choose_model(solve, validate, folds)
    model: DistortionModel = options.distortion
    reason = f"{model} was asked for"
    if model == "auto":
        model, reason = "k1k2p1p2k3", "all five coefficients, no hold-out test was wanted"
    solution = solve(model)
    if isinstance(solution, FitFailure):
        return solution
    return ChosenModel(model, solution, validate(solution, solution), reason)


def _solve(
    used: Sequence[TargetView],
    observations: Observations,
    prepared: PreparedViews,
    model: DistortionModel,
    options: CameraOptions,
) -> Solution | FitFailure:
    start = starting_state(used, observations, prepared.homographies, model, options)
    if isinstance(start, FitFailure):
        return start
    basis, _ = free_basis(model, options, with_warp=False)
    solution = solve_robustly(observations, start[0], basis, start[1], options.max_steps)
    for _ in range(EXCESS_ROUNDS):
        if isinstance(solution, FitFailure):
            return solution
        excess = _excess_variance_px2(observations, solution)
        if excess <= 0.0:
            break
        noisier = with_excess(observations, excess)
        solution = solve_robustly(noisier, solution.state, basis, start[1], options.max_steps)
    if isinstance(solution, FitFailure):
        return solution
    if largest_angle_deg(solution.state.rotations[:, :, 2]) < MIN_ANGLE_DEG:
        return PARALLEL
    return solution


def _excess_variance_px2(observations: Observations, solution: Solution) -> float:
    """Variance to add to the detector's covariances, by the rule of `calibration.camera.noise`."""
    kept = solution.weights > 0.0
    return excess_variance_px2(
        residuals_px(observations, solution.state)[kept],
        claimed_covariances(observations)[kept],
        float(chi2_of_points(observations, solution.state)[kept].sum()),
        solution.degrees_of_freedom,
    )
