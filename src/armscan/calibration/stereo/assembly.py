# SPDX-License-Identifier: Apache-2.0
"""From a joint solution to a `StereoFit`: evidence of each pair and of each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.coverage import measure_coverage
from armscan.calibration.camera.cross_validation import rms
from armscan.calibration.camera.noise import claimed_covariances
from armscan.calibration.camera.result import CrossValidation
from armscan.calibration.stereo.advice import advise
from armscan.calibration.stereo.covariance import StereoCovariance
from armscan.calibration.stereo.joint import N_SHARED
from armscan.calibration.stereo.options import StereoOptions
from armscan.calibration.stereo.pair_levels import PairLevels
from armscan.calibration.stereo.relate import Cameras, RelatedPair, Relation
from armscan.calibration.stereo.relative_pose import RelativePose, differences
from armscan.calibration.stereo.result import (
    MatchedPoints,
    PairFit,
    SideFit,
    StereoFit,
    ViewResiduals,
)
from armscan.calibration.stereo.solve import JointSolution
from armscan.calibration.stereo.start import Boards
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.models.two_views import TwoViews, epipolar_distances_px
from armscan.vision.targets.view import TargetView

NO_POSE = np.full(6, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the parts of a result are made from; see the types."""

    relation: Relation
    boards: Boards
    cameras: Cameras
    solution: JointSolution
    own: tuple[RelativePose, ...]
    levels: PairLevels


def assemble(
    evidence: Evidence,
    covariance: StereoCovariance,
    hold_out: CrossValidation | None,
    options: StereoOptions,
) -> StereoFit:
    """Put the result together."""
    solution = evidence.solution
    residuals = [
        values[weight > 0.0]
        for values, weight in zip(solution.residuals_px(), solution.weights, strict=True)
    ]
    pairs = _pair_fits(evidence)
    apart = np.concatenate(
        [
            np.concatenate([pair.matched.in_left_px, pair.matched.in_right_px])
            for pair in pairs
            if pair.matched is not None and pair.is_related
        ]
    )
    fit = StereoFit(
        views=solution.state.views(solution.observations),
        covariance=covariance.matrix[:N_SHARED, :N_SHARED],
        left=_side_fit(evidence, 0),
        right=_side_fit(evidence, 1),
        pairs=pairs,
        rms_px=rms(np.concatenate(residuals)),
        epipolar_rms_px=float(np.sqrt(np.mean(apart**2))),
        epipolar_mean_px=float(np.mean(apart)),
        typical_level=evidence.levels.typical,
        hold_out=hold_out,
        degrees_of_freedom=solution.degrees_of_freedom,
        condition=covariance.condition,
        target_error_mm=covariance.target_error.sigma_mm,
        is_converged=solution.is_converged,
        warnings=(),
        options=options,
    )
    return advise(fit)


def _side_fit(evidence: Evidence, side: int) -> SideFit:
    solution = evidence.solution
    observations = (solution.observations.left, solution.observations.right)[side]
    state = (solution.state.in_left(), solution.state.in_right())[side]
    weight = solution.weights[side]
    kept = weight > 0.0
    seen = np.flatnonzero(np.diff(observations.starts) > 0)
    claimed = claimed_covariances(observations)[kept]
    variance = 0.5 * float(np.mean(np.trace(claimed, axis1=1, axis2=2)))
    return SideFit(
        single=evidence.cameras[side],
        rms_px=rms(solution.residuals_px()[side][kept]),
        sigma_point_px=float(np.sqrt(variance * solution.variance_factor)),
        noise_scale=solution.noise_scales[side],
        n_views=len(seen),
        n_points=int(weight.sum()),
        coverage=measure_coverage(
            observations.points_px[kept],
            state.rotations[seen][:, :, 2],
            observations.width_px,
            observations.height_px,
        ),
    )


def _pair_fits(evidence: Evidence) -> tuple[PairFit, ...]:
    views = evidence.solution.state.views(evidence.solution.observations)
    fits = []
    position = 0
    for number, pair in enumerate(evidence.relation.pairs):
        fits.append(_pair_fit(evidence, number, position, pair, views))
        position += pair.is_related
    return tuple(fits)


def _pair_fit(
    evidence: Evidence, number: int, position: int, pair: RelatedPair, views: TwoViews
) -> PairFit:
    """Fit of pair ``number``, which is related pair ``position`` if it is one."""
    left = _view_residuals(evidence, 0, evidence.boards.left_board[number])
    right = _view_residuals(evidence, 1, evidence.boards.right_board[number])
    apart, level, is_misfit, note = NO_POSE, float("nan"), False, pair.note
    if pair.is_related:
        own = evidence.own[position].right_from_left
        apart = differences(own.rotation[None], own.translation_mm[None], views.right_from_left)[0]
        level = float(evidence.levels.levels[position])
        is_misfit = bool(evidence.levels.is_misfit[position])
    if is_misfit:
        note = (
            f"it puts the right camera {np.sqrt(level):.1f} times as far from where the other "
            "pairs put it as the typical pair: look at it, or leave it out"
        )
    matched = None
    if pair.pair is not None and left is not None and right is not None:
        matched = _matched(pair.pair.left, pair.pair.right, views, left.sensor_from_board)
    return PairFit(
        pair=pair.pair if pair.pair is not None else pair.given,
        left=left,
        right=right,
        matched=matched,
        quarter_turns=pair.numbering.quarter_turns,
        apart=apart,
        level=level,
        is_related=pair.is_related,
        is_misfit=is_misfit,
        note=note,
    )


def _view_residuals(evidence: Evidence, side: int, board: int) -> ViewResiduals | None:
    if board < 0:
        return None
    solution = evidence.solution
    rows = (solution.observations.left, solution.observations.right)[side].rows(board)
    return ViewResiduals(
        solution.state.pose(board),
        solution.residuals_px()[side][rows],
        solution.weights[side][rows] == 0.0,
    )


def _matched(
    left: TargetView | None,
    right: TargetView | None,
    views: TwoViews,
    sensor_from_board: Pose[Sensor, Board],
) -> MatchedPoints | None:
    if left is None or right is None:
        return None
    _, in_left, in_right = np.intersect1d(left.point_index, right.point_index, return_indices=True)
    points = left.points_board_mm[in_left] @ sensor_from_board.rotation.T
    distances = epipolar_distances_px(views, left.points_px[in_left], right.points_px[in_right])
    return MatchedPoints(
        left.points_px[in_left],
        right.points_px[in_right],
        *distances,
        points[:, 2] + sensor_from_board.translation_mm[2],
    )
