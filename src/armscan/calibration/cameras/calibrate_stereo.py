# SPDX-License-Identifier: Apache-2.0
"""Calibrate a stereo pair from pairs of views of a target: starting values, joint adjustment
and the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.distortion import (
    BEYOND_USUAL,
    rms,
    sigma_of_axis,
    typical_coefficients,
)
from armscan.calibration.cameras.joint import (
    N_INTRINSICS,
    N_SHARED,
    JointObservations,
    JointProblem,
    JointSolution,
    PointWeights,
    Prior,
    StereoCovariance,
    StereoState,
    adjust_both,
    hold_out_pairs,
    independent_share,
    solve_both,
    stack_pair_observations,
    stereo_covariance,
)
from armscan.calibration.cameras.pairs import (
    MIN_PAIRS,
    StereoOptions,
    StereoPair,
    check_pairs,
    common_bow,
    common_design_effect,
    prepare_cameras,
    views_of,
)
from armscan.calibration.cameras.relate import (
    Cameras,
    PairNoise,
    RelatedPair,
    Relation,
    RelativePose,
    compare_pairs,
    differences,
    own_pose,
    relate,
    too_few,
)
from armscan.calibration.cameras.result import CrossValidation, measure_coverage
from armscan.calibration.cameras.stereo_result import (
    MatchedPoints,
    PairFit,
    SideFit,
    StereoFit,
    ViewResiduals,
    advise,
)
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.models.calibration import CameraCalibration, independent_parameters
from armscan.models.camera import PARAMETER_NAMES
from armscan.models.two_views import TwoViews, epipolar_distances_px
from armscan.vision.targets.target import Target, TargetView


@dataclass(frozen=True, slots=True, eq=False)
class Boards:
    """The boards of an adjustment.

    Parameters
    ----------
    seen_by
        Views of each board; those of a pair that was taken apart are boards of their own.
    left_board, right_board
        Number of the board of each pair's left and right view; -1 where it has none.
    poses
        ``sensor_from_board`` of each, to start from.
    """

    seen_by: tuple[StereoPair, ...]
    left_board: tuple[int, ...]
    right_board: tuple[int, ...]
    poses: tuple[Pose[Sensor, Board], ...]


def boards_of(relation: Relation) -> Boards:
    """One board for each related pair, and one for each other view."""
    seen_by: list[StereoPair] = []
    poses: list[Pose[Sensor, Board]] = []
    left: list[int] = []
    right: list[int] = []
    for pair in relation.pairs:
        numbers = [-1, -1]
        if pair.pair is not None and pair.start is not None:
            numbers = [len(seen_by)] * 2
            seen_by.append(pair.pair)
            poses.append(pair.start)
        elif pair.pair is not None:
            for side, view in enumerate(pair.pair.views):
                if view is not None:
                    numbers[side] = len(seen_by)
                    seen_by.append(StereoPair(view, None) if side == 0 else StereoPair(None, view))
                    poses.append(_alone(pair, side, relation.right_from_left))
        left.append(numbers[0])
        right.append(numbers[1])
    return Boards(tuple(seen_by), tuple(left), tuple(right), tuple(poses))


def _alone(
    pair: RelatedPair, side: int, right_from_left: Pose[CameraRight, Sensor]
) -> Pose[Sensor, Board]:
    seen = pair.seen[side][0].camera_from_board
    if side == 0:
        return seen
    right_from_board: Pose[CameraRight, Board] = Pose(seen.rotation, seen.translation_mm)
    return right_from_left.inverse() @ right_from_board


def starting_state(
    boards: Boards, cameras: Cameras, right_from_left: Pose[CameraRight, Sensor]
) -> StereoState:
    """Cameras by themselves, the agreed relative pose, boards as the left camera sees them."""
    return StereoState(
        np.concatenate([camera.camera.parameters for camera in cameras]),
        right_from_left,
        np.array([pose.rotation for pose in boards.poses]),
        np.array([pose.translation_mm for pose in boards.poses]),
    )


def starting_weights(boards: Sequence[StereoPair], cameras: Cameras) -> PointWeights:
    """0 for points that are outliers in their camera by itself, else 1."""
    weights = []
    for side, camera in enumerate(cameras):
        views = [view for board in boards if (view := board.views[side]) is not None]
        outliers = np.concatenate([camera.outliers[view.source] for view in views])
        weights.append(np.where(outliers, 0.0, 1.0))
    return weights[0], weights[1]


def joint_basis(cameras: Cameras) -> FloatArray:
    """(24, F) of the free shared unknowns: those of each camera, and the relative pose."""
    left, right = (camera.basis for camera in cameras)
    n_left, n_right = left.shape[1], right.shape[1]
    basis = np.zeros((N_SHARED, n_left + n_right + 6))
    basis[: len(left), :n_left] = left
    basis[len(left) : N_INTRINSICS, n_left : n_left + n_right] = right
    basis[N_INTRINSICS:, n_left + n_right :] = np.eye(6)
    return basis


def prior_of(given: tuple[CameraCalibration, CameraCalibration]) -> Prior:
    """The given calibrations as observations of the intrinsics.

    Of focal lengths that were held to each other fx is observed; fy follows it (`joint_basis`).

    Raises
    ------
    OptionError
        If one brings no covariance.
    """
    information = np.zeros((N_INTRINSICS, N_INTRINSICS))
    n_known = 0
    for side, calibration in enumerate(given):
        known = independent_parameters(calibration.covariance)
        if not calibration.has_covariance or not len(known):
            raise OptionError(
                f"the {('left', 'right')[side]} camera's calibration brings no covariance",
                remedy="hold it (--intrinsics fixed), or calibrate the camera with armscan",
            )
        rows = known + side * len(PARAMETER_NAMES)
        information[np.ix_(rows, rows)] = _inverse(calibration.covariance[np.ix_(known, known)])
        n_known += len(known)
    values = np.concatenate([calibration.camera.parameters for calibration in given])
    return Prior(values, information, n_known)


def usual_prior(cameras: Cameras) -> Prior:
    """Coefficients of usual lenses, of the size that `typical_coefficients` tells, but those that
    a camera by itself has far larger.
    """
    information = np.zeros((2, len(PARAMETER_NAMES)))
    for side, single in enumerate(cameras):
        if single.camera.lens == "pinhole":
            usual = typical_coefficients(single.camera, PARAMETER_NAMES[4:])
            is_usual = np.abs(single.camera.parameters[4:]) < BEYOND_USUAL * usual
            information[side, 4:] = is_usual * common_design_effect(cameras) / usual**2
    n_known = int(np.count_nonzero(information))
    return Prior(np.zeros(N_INTRINSICS), np.diag(information.ravel()), n_known)


def _prior(cameras: Cameras, options: StereoOptions, given: Given | None) -> Prior | None:
    if given is None:
        return usual_prior(cameras) if options.camera.distortion == "auto" else None
    return prior_of(given) if options.intrinsics == "prior" else None


def held_covariance(given: tuple[CameraCalibration, CameraCalibration]) -> FloatArray | None:
    """(18, 18) covariance of held intrinsics; None if neither brings one."""
    if not any(calibration.has_covariance for calibration in given):
        return None
    n = len(PARAMETER_NAMES)
    held = np.zeros((N_INTRINSICS, N_INTRINSICS))
    held[:n, :n], held[n:, n:] = given[0].covariance, given[1].covariance
    return held


def _inverse(matrix: FloatArray) -> FloatArray:
    """Scaled to unit diagonal first: focal lengths and k3 differ by many orders."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale))


NO_POSE = np.full(6, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the parts of a result are made from; see the types."""

    relation: Relation
    boards: Boards
    cameras: Cameras
    solution: JointSolution
    own: tuple[RelativePose, ...]
    levels: PairNoise


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
    misses_px = solution.residuals_px()[side][kept]
    share = weight.sum() / sum(w.sum() for w in solution.weights)
    return SideFit(
        single=evidence.cameras[side],
        rms_px=rms(misses_px),
        sigma_point_px=sigma_of_axis(misses_px, share * solution.degrees_of_freedom),
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
        sensor_from_board=solution.state.pose(board),
        residuals_px=solution.residuals_px()[side][rows],
        is_outlier=solution.weights[side][rows] == 0.0,
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
    left_px, right_px = left.points_px[in_left], right.points_px[in_right]
    apart_left_px, apart_right_px = epipolar_distances_px(views, left_px, right_px)
    # at the edge of a wide lens a pixel may have no ray
    has_ray = np.isfinite(apart_left_px) & np.isfinite(apart_right_px)
    depth_mm = sensor_from_board.apply(left.points_board_mm[in_left])[:, 2]
    return MatchedPoints(
        left_px=left_px[has_ray],
        in_left_px=apart_left_px[has_ray],
        in_right_px=apart_right_px[has_ray],
        depth_mm=depth_mm[has_ray],
    )


TAKEN_APART = "taken apart: it disagrees with the other pairs"

Given = tuple[CameraCalibration, CameraCalibration]


def calibrate_stereo(
    pairs: Sequence[StereoPair],
    target: Target,
    options: StereoOptions | None = None,
    given: Given | None = None,
) -> StereoFit | FitFailure:
    """Calibrate two cameras from views of one flat target, taken by both at one instant.

    Each camera by itself, and each pair's relative pose by eqs. 4.12 to 4.16, start a
    Levenberg-Marquardt solution over both cameras, ``right_from_left`` and one board pose a pair,
    each point weighted by its covariance at the level of its camera's residuals. A view without
    partner counts for its camera alone. Targets that look the same when turned are numbered so
    that all pairs agree. Pairs that contradict the others are named and taken apart. A bow of the
    board that a camera by itself cannot do without is taken over from there.

    ``given`` are calibrations of the left and of the right camera; none for ``free`` intrinsics.

    Raises
    ------
    InputError
        If the images of one camera differ in size or name, or not in name.
    OptionError
        If a pair to leave out does not exist, or calibrations are given for ``free`` intrinsics,
        or are missing or without covariance where one is needed.
    """
    options = options or StereoOptions()
    options.check_given(is_given=given is not None)
    chosen = check_pairs(pairs, options.leave_out)
    n_both = sum(pair.is_seen_by_both for pair in chosen)
    if n_both < MIN_PAIRS:
        return too_few(n_both, [])
    cameras = prepare_cameras([views_of(chosen, 0), views_of(chosen, 1)], options, given)
    if isinstance(cameras, FitFailure):
        return cameras
    relation = relate(chosen, cameras, target)
    while True:
        if isinstance(relation, FitFailure):
            return relation
        boards = boards_of(relation)
        solution = _solve(boards, relation, cameras, options, given)
        if isinstance(solution, FitFailure):
            return solution
        own = _own_poses(boards, relation, solution)
        levels = compare_pairs(own, solution.state.right_from_left)
        if not (options.leave_out_misfits and levels.is_misfit.any()):
            break
        relation = relation.without(levels.is_misfit, TAKEN_APART).unless_too_few()
    evidence = Evidence(relation, boards, cameras, solution, tuple(own), levels)
    return _result(evidence, options, given)


def _solve(
    boards: Boards,
    relation: Relation,
    cameras: Cameras,
    options: StereoOptions,
    given: Given | None,
) -> JointSolution | FitFailure:
    observations = stack_pair_observations(
        boards.seen_by, (cameras[0].camera.lens, cameras[1].camera.lens)
    )
    bow = common_bow(cameras)
    problem = JointProblem(
        observations if bow is None else on_bowed_board(observations, bow.bow_mm),
        joint_basis(cameras),
        starting_weights(boards.seen_by, cameras),
        _prior(cameras, options, given),
    )
    start = starting_state(boards, cameras, relation.right_from_left)
    solution = solve_both(boards.seen_by, problem, start, options.camera.max_steps)
    if given is not None or problem.prior is None or isinstance(solution, FitFailure):
        return solution
    # what the target's points miss is no noise of the points: beside it usual sizes weigh less
    share = independent_share(solution)
    if share == 1.0:
        return solution
    usual = replace(problem.prior, information=share * problem.prior.information)
    problem = replace(problem, prior=usual)
    return solve_both(boards.seen_by, problem, solution.state, options.camera.max_steps)


def on_bowed_board(observations: JointObservations, bow_mm: FloatArray) -> JointObservations:
    """The same points on a board that is bowed by so much (2,) more; see `BoardWarp`."""
    left, right = (
        replace(
            seen,
            board_mm=seen.board_mm
            + (seen.board_warp_shape @ bow_mm)[:, None] * np.array([0.0, 0.0, 1.0]),
        )
        for seen in (observations.left, observations.right)
    )
    return JointObservations(left, right)


def covariance_of_bow(
    solution: JointSolution, covariance_mm2: FloatArray, max_steps: int
) -> FloatArray | FitFailure:
    """(24, 24) what the uncertainty (2, 2) of a board's bow does to the shared unknowns.

    The solution is repeated with the board bowed by one standard deviation more along each axis of
    the covariance.
    """
    found = np.zeros((N_SHARED, N_SHARED))
    for change_mm in np.linalg.cholesky(covariance_mm2).T:
        observations = on_bowed_board(solution.observations, change_mm)
        moved = adjust_both(
            replace(solution.problem, observations=observations), solution.state, max_steps
        )
        if isinstance(moved, FitFailure):
            return moved
        old, new = solution.state.right_from_left, moved.state.right_from_left
        intrinsics = moved.state.intrinsics - solution.state.intrinsics
        by = np.concatenate([intrinsics, new.step_from(old)])
        found += np.outer(by, by)
    return found


def _own_poses(boards: Boards, relation: Relation, solution: JointSolution) -> list[RelativePose]:
    """``right_from_left`` of each related pair by itself, with the cameras of the solution."""
    views = solution.state.views(solution.observations)
    numbers = [
        number
        for number, pair in zip(boards.left_board, relation.pairs, strict=True)
        if pair.is_related
    ]
    return [
        own_pose(boards.seen_by[number], views, solution.state.pose(number)) for number in numbers
    ]


def _result(
    evidence: Evidence, options: StereoOptions, given: Given | None
) -> StereoFit | FitFailure:
    held = held_covariance(given) if given is not None and options.intrinsics == "fixed" else None
    widening = common_design_effect(evidence.cameras) if held is None else 1.0
    covariance = stereo_covariance(evidence.solution, held, widening)
    if isinstance(covariance, FitFailure):
        return covariance
    steps = options.camera.max_steps
    bow = common_bow(evidence.cameras)
    matrix = covariance.matrix.copy()
    if bow is not None:
        by_bow = covariance_of_bow(evidence.solution, bow.covariance_mm2, steps)
        if isinstance(by_bow, FitFailure):
            return by_bow
        matrix[:N_SHARED, :N_SHARED] += by_bow
    covariance = replace(covariance, matrix=matrix)
    hold_out = (
        hold_out_pairs(evidence.solution, options.n_folds, steps) if options.n_folds else None
    )
    return assemble(evidence, covariance, hold_out, options)
