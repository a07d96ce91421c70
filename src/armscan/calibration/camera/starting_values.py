# SPDX-License-Identifier: Apache-2.0
"""Starting values of a camera adjustment: homographies, closed form, linear distortion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.camera.homography import estimate_homography, flatness, map_points
from armscan.calibration.camera.observations import Observations, State
from armscan.calibration.camera.options import DISTORTION_PARAMETERS, CameraOptions, DistortionModel
from armscan.calibration.camera.zhang import (
    intrinsics_from_homographies,
    linear_distortion,
    pose_from_homography,
)
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import PARAMETER_NAMES
from armscan.vision.targets.view import TargetView

SUSPECT_HOMOGRAPHY = 6.0
"""A view whose homography fits this much worse than the median is not used for the start."""

EDGE_ON = 0.02
NEAR_PX_PER_WIDTH = 0.005
"""Two views whose points differ by less than this share of the image width are the same view."""


def view_homography(view: TargetView, min_points: int) -> FloatArray | FitFailure:
    """Homography of a view, or why the view cannot be used at all."""
    if len(view) < min_points:
        return FitFailure(f"only {len(view)} target points, needs {min_points}")
    if flatness(view.points_px) < EDGE_ON:
        return FitFailure("the board is seen edge-on")
    return estimate_homography(view.points_board_mm[:, :2], view.points_px)


def homography_rms_px(view: TargetView, homography: FloatArray) -> float:
    """Root median square distance of a view's points from its homography."""
    error = map_points(homography, view.points_board_mm[:, :2]) - view.points_px
    return float(np.sqrt(np.median(np.sum(error**2, axis=1))))


def repeated_views(views: Sequence[TargetView]) -> dict[int, int]:
    """Views that show the board where an earlier view shows it: index to earlier index."""
    repeated: dict[int, int] = {}
    for later in range(len(views)):
        for earlier in range(later):
            if earlier not in repeated and _is_repeated(views[earlier], views[later]):
                repeated[later] = earlier
                break
    return repeated


def _is_repeated(a: TargetView, b: TargetView) -> bool:
    _, in_a, in_b = np.intersect1d(a.point_index, b.point_index, return_indices=True)
    if not len(in_a):
        return False
    shift = a.points_px[in_a] - b.points_px[in_b]
    rms = float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
    return rms < NEAR_PX_PER_WIDTH * a.width_px


def starting_state(
    views: Sequence[TargetView],
    observations: Observations,
    homographies: Sequence[FloatArray],
    model: DistortionModel,
    options: CameraOptions,
) -> tuple[State, BoolArray] | FitFailure:
    """Closed-form camera and poses.

    Parameters
    ----------
    views
        The views.
    observations
        The same views from `gather`.
    homographies
        One (3, 3) a view, from board mm to pixels.
    model, options
        Which parameters are free.

    Returns
    -------
    state
        Starting values with those parameters at rest that are not free.
    trusted
        (V,) False for views that fit a plane so badly that they had no say.

    or why there are none.
    """
    width, height = observations.width_px, observations.height_px
    rms = np.array([homography_rms_px(v, h) for v, h in zip(views, homographies, strict=True)])
    trusted = np.asarray(rms <= max(SUSPECT_HOMOGRAPHY * float(np.median(rms)), 1e-6))
    chosen = [h for h, ok in zip(homographies, trusted, strict=True) if ok]
    matrix = intrinsics_from_homographies(chosen, width, height)
    if isinstance(matrix, FitFailure):
        return matrix
    matrix = _held(matrix, width, height, options)
    shared = np.zeros(11)
    shared[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    state = State.from_poses(shared, [pose_from_homography(h, matrix) for h in homographies])
    return _with_distortion(state, observations, trusted, model), trusted


def _held(matrix: FloatArray, width: int, height: int, options: CameraOptions) -> FloatArray:
    matrix = matrix.copy()
    if options.is_principal_point_fixed:
        matrix[:2, 2] = 0.5 * (width - 1), 0.5 * (height - 1)
    if options.is_aspect_fixed:
        matrix[0, 0] = matrix[1, 1] = np.sqrt(matrix[0, 0] * matrix[1, 1])
    return matrix


def _with_distortion(
    state: State, observations: Observations, trusted: BoolArray, model: DistortionModel
) -> State:
    """Add linear distortion (eqs. 2.36 to 2.38) where it is small enough to be believed."""
    free = [PARAMETER_NAMES.index(name) - 4 for name in DISTORTION_PARAMETERS[model]]
    # k3 is told from k1 and k2 only poorly before the poses are refined.
    free = [index for index in free if index != 4]
    points = np.concatenate(
        [
            observations.board_mm[observations.rows(v)] @ state.rotations[v].T
            + state.translations_mm[v]
            for v in range(observations.n_views)
        ]
    )
    ideal = points[:, :2] / points[:, 2:]
    observed = (observations.points_px - state.shared[2:4]) / state.shared[:2]
    rows = trusted[observations.view_of_point]
    if not rows.any() or not (points[rows, 2] > 0.0).all():
        return state
    coefficients = linear_distortion(ideal[rows], observed[rows], free)
    radius = float(np.sum(observed[rows] ** 2, axis=1).max())
    if abs(coefficients[0]) * radius + abs(coefficients[1]) * radius**2 > 0.5:
        return state
    shared = state.shared.copy()
    shared[4:9] = coefficients
    return State(shared, state.rotations, state.translations_mm)
