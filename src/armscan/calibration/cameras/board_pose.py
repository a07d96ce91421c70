# SPDX-License-Identifier: Apache-2.0
"""Pose of a known target before a known camera, with its covariance; both solutions of the
planar problem are tried.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.adjustment import (
    NormalEquations,
    Observations,
    State,
    adjust,
    condition_number,
    gather,
    linearise,
)
from armscan.calibration.cameras.robust import excess_variance_px2, residuals_px
from armscan.calibration.cameras.start import estimate_homography, pose_from_homography
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import TargetView

POSE_PARAMETER_NAMES = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
AMBIGUOUS_CHI2 = 9.0
"""The second solution is refuted if its chi2, over the noise variance, is larger by this much:
three standard deviations."""

SAME_POSE_RAD = 1e-3
SCALED_FROM_DEGREES_OF_FREEDOM = 10

_POSE_ONLY = np.zeros((11, 0))
_CAMERA = np.eye(11, 9)


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """A local minimum of the reprojection error of a flat board.

    Parameters
    ----------
    sensor_from_board
        The pose.
    chi2
        Squared residuals over the detector's covariances.
    """

    sensor_from_board: Pose[Sensor, Board]
    chi2: float


def board_pose_candidates(
    view: TargetView, camera: CameraModel, bow_mm: FloatArray | None = None
) -> tuple[PoseCandidate, ...] | FitFailure:
    """The one or two poses of a flat board that a view allows, the better first.

    The first comes from the homography (eq. 2.35). A distant board seen with little perspective
    fits almost as well when its normal is mirrored at the line of sight: that pose starts the
    second.

    Parameters
    ----------
    view
        Target points.
    camera
        The camera, held fixed.
    bow_mm
        (2,) bow of the board as in `BoardWarp`; flat if None.

    Raises
    ------
    InputError
        If view and camera do not belong to images of one size.
    """
    if (view.width_px, view.height_px) != (camera.width_px, camera.height_px):
        raise InputError(
            f"the image is {view.width_px}x{view.height_px} px, the camera was calibrated with "
            f"{camera.width_px}x{camera.height_px} px",
            where=view.source,
            remedy="use images of the size that the camera was calibrated with",
        )
    xy, is_valid = camera.undistort(view.points_px)
    homography = estimate_homography(view.points_board_mm[is_valid, :2], xy[is_valid])
    if isinstance(homography, FitFailure):
        return homography
    observations = gather([view])
    shared = _shared(camera, bow_mm)
    centre = view.points_board_mm.mean(axis=0)
    first = _refined(observations, shared, pose_from_homography(homography, np.eye(3)))
    if isinstance(first, FitFailure):
        return first
    second = _refined(observations, shared, mirrored_pose(first.sensor_from_board, centre))
    if isinstance(second, FitFailure) or _is_same(first, second):
        return (first,)
    return (first, second) if first.chi2 <= second.chi2 else (second, first)


def mirrored_pose(pose: Pose[Sensor, Board], centre_board_mm: FloatArray) -> Pose[Sensor, Board]:
    """Turn a board so that its normal is mirrored at the line of sight to ``centre_board_mm``."""
    centre = pose.rotation @ centre_board_mm + pose.translation_mm
    sight = centre / np.linalg.norm(centre)
    normal = pose.rotation[:, 2]
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    angle = 2.0 * float(np.arctan2(sine, normal @ sight))
    turn = rotation_from_vector(axis * (angle / sine)) if sine > 1e-9 else np.eye(3)
    rotation = turn @ pose.rotation
    return Pose(rotation, centre - rotation @ centre_board_mm)


def estimate_board_pose(
    view: TargetView,
    camera: CameraModel,
    camera_covariance: FloatArray | None = None,
    bow_mm: FloatArray | None = None,
    *,
    allow_ambiguous: bool = False,
) -> Estimate[Pose[Sensor, Board]] | FitFailure:
    """Pose of a board in one view.

    Parameters
    ----------
    view
        Target points with covariances.
    camera
        The camera.
    camera_covariance
        (9, 9); if given, the camera's uncertainty is carried into the pose.
    bow_mm
        (2,) bow of the board as in `BoardWarp`; flat if None.
    allow_ambiguous
        Return the better of two poses even if they fit alike, instead of refusing.

    Returns
    -------
    estimate
        ``sensor_from_board``; covariance (6, 6) of (rotation-vector increment in rad in the Sensor
        frame, applied on the left; translation in mm); residuals (M, 2) in px. The points'
        covariances give the weights (see `armscan.calibration.cameras.robust`), the residuals the
        level: the covariance is scaled by chi2
        over the degrees of freedom (with fewer than ten of them never below 1). Or why there is
        no pose: too few points, points on a line, or two poses that fit alike.
    """
    found = estimate_board_poses(view, camera, camera_covariance, bow_mm)
    if isinstance(found, FitFailure):
        return found
    if len(found) > 1 and not allow_ambiguous:
        return FitFailure(
            "two poses of the board fit alike, mirrored at the line of sight",
            "tilt the board more, bring it nearer, or use a larger one",
        )
    return found[0]


def estimate_board_poses(
    view: TargetView,
    camera: CameraModel,
    camera_covariance: FloatArray | None = None,
    bow_mm: FloatArray | None = None,
) -> tuple[Estimate[Pose[Sensor, Board]], ...] | FitFailure:
    """All poses of a board that one view does not refute, the best first.

    Parameters and the content of each estimate as in `estimate_board_pose`.
    """
    degrees = 2 * len(view) - 6
    candidates = board_pose_candidates(view, camera, bow_mm)
    if not isinstance(candidates, FitFailure):
        noisier = _with_excess(view, camera, candidates[0], bow_mm)
        if noisier is not view:
            view, candidates = noisier, board_pose_candidates(noisier, camera, bow_mm)
    if isinstance(candidates, FitFailure):
        return candidates
    best = candidates[0]
    factor = best.chi2 / max(degrees, 1)
    if degrees < SCALED_FROM_DEGREES_OF_FREEDOM:
        factor = max(factor, 1.0)
    observations = gather([view])
    found = []
    for candidate in candidates:
        if candidate.chi2 - best.chi2 >= AMBIGUOUS_CHI2 * factor and candidate is not best:
            continue
        state = State.from_poses(_shared(camera, bow_mm), [candidate.sensor_from_board])
        equations = linearise(observations, state, _CAMERA, np.ones(len(view)))
        if equations is None or not condition_number(equations.pose[0]) < 1e13:
            return FitFailure("the points do not determine a pose", "show more of the board")
        found.append(
            Estimate(
                value=candidate.sensor_from_board,
                parameter_names=POSE_PARAMETER_NAMES,
                covariance=_pose_covariance(equations, factor, camera_covariance),
                residuals=residuals_px(observations, state),
                degrees_of_freedom=degrees,
                chi2=candidate.chi2,
            )
        )
    return tuple(found)


def _shared(camera: CameraModel, bow_mm: FloatArray | None) -> FloatArray:
    return np.append(camera.parameters, np.zeros(2) if bow_mm is None else bow_mm)


def _with_excess(
    view: TargetView, camera: CameraModel, best: PoseCandidate, bow_mm: FloatArray | None
) -> TargetView:
    """The view with the variance that explains its residuals, see `calibration.camera.noise`."""
    state = State.from_poses(_shared(camera, bow_mm), [best.sensor_from_board])
    residuals = residuals_px(gather([view]), state)
    excess = excess_variance_px2(residuals, view.covariance_px2, best.chi2, 2 * len(view) - 6)
    if excess <= 0.0:
        return view
    return replace(view, covariance_px2=view.covariance_px2 + excess * np.eye(2))


def _pose_covariance(
    equations: NormalEquations, factor: float, camera_covariance: FloatArray | None
) -> FloatArray:
    inverse = np.linalg.inv(equations.pose[0])
    covariance = factor * inverse
    if camera_covariance is not None:
        # The pose follows the camera by -V^-1 W' (implicit function).
        by_camera = -inverse @ equations.cross[0].T
        covariance = covariance + by_camera @ camera_covariance @ by_camera.T
    return np.asarray(0.5 * (covariance + covariance.T))


def _refined(
    observations: Observations, shared: FloatArray, start: Pose[Sensor, Board]
) -> PoseCandidate | FitFailure:
    result = adjust(observations, State.from_poses(shared, [start]), _POSE_ONLY)
    if isinstance(result, FitFailure):
        return result
    return PoseCandidate(result.state.pose(0), result.system.chi2)


def _is_same(a: PoseCandidate, b: PoseCandidate) -> bool:
    turn = vector_from_rotation(a.sensor_from_board.rotation.T @ b.sensor_from_board.rotation)
    return float(np.linalg.norm(turn)) < SAME_POSE_RAD
