# SPDX-License-Identifier: Apache-2.0
"""Calibration of two cameras on a flat target (eqs. 4.1 to 4.5 and 4.12 to 4.16)."""

from __future__ import annotations

from collections.abc import Sequence

from armscan.calibration.stereo.assembly import Evidence, assemble
from armscan.calibration.stereo.covariance import stereo_covariance
from armscan.calibration.stereo.hold_out import hold_out_pairs
from armscan.calibration.stereo.joint import JointProblem
from armscan.calibration.stereo.options import MIN_PAIRS, StereoOptions
from armscan.calibration.stereo.pair_levels import compare_pairs, own_pose
from armscan.calibration.stereo.pairs import StereoPair, check_pairs, views_of
from armscan.calibration.stereo.relate import Cameras, Relation, relate, too_few
from armscan.calibration.stereo.relative_pose import RelativePose
from armscan.calibration.stereo.result import StereoFit
from armscan.calibration.stereo.single_camera import prepare_cameras
from armscan.calibration.stereo.solve import JointSolution, gather_both, solve_both
from armscan.calibration.stereo.start import (
    Boards,
    boards_of,
    held_covariance,
    joint_basis,
    prior_of,
    starting_state,
    starting_weights,
)
from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration
from armscan.vision.targets.definition import Target

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
    that all pairs agree. Pairs that contradict the others are named and taken apart.

    Parameters
    ----------
    pairs
        One an instant.
    target
        What they show.
    options
        See `StereoOptions`.
    given
        Calibrations of the left and of the right camera, unless the intrinsics are ``free``.

    Returns
    -------
    fit
        Both cameras with their evidence; or why the pairs do not determine them.

    Raises
    ------
    InputError
        If the images of one camera differ in size or name, or not in name.
    OptionError
        If a pair to leave out does not exist, or given calibrations are missing or without
        covariance where one is needed.
    """
    options = options or StereoOptions()
    if options.intrinsics != "free" and given is None:
        raise OptionError(
            f"intrinsics '{options.intrinsics}' need calibrations of both cameras",
            remedy="give them, or let the intrinsics be free",
        )
    given = None if options.intrinsics == "free" else given
    chosen = check_pairs(pairs, options.leave_out)
    n_both = sum(pair.is_seen_by_both for pair in chosen)
    if n_both < MIN_PAIRS:
        return too_few(n_both, [])
    cameras = prepare_cameras([views_of(chosen, 0), views_of(chosen, 1)], options, given)
    if isinstance(cameras, FitFailure):
        return cameras
    relation = relate(chosen, cameras, target)
    if isinstance(relation, FitFailure):
        return relation
    while True:
        boards = boards_of(relation)
        solution = _solve(boards, relation, cameras, options, given)
        if isinstance(solution, FitFailure):
            return solution
        own = _own_poses(boards, relation, solution)
        levels = compare_pairs(own, solution.state.right_from_left)
        if not (options.leave_out_misfits and levels.is_misfit.any()):
            break
        relation = relation.without(levels.is_misfit, TAKEN_APART)
    evidence = Evidence(relation, boards, cameras, solution, tuple(own), levels)
    return _result(evidence, options, given)


def _solve(
    boards: Boards,
    relation: Relation,
    cameras: Cameras,
    options: StereoOptions,
    given: Given | None,
) -> JointSolution | FitFailure:
    problem = JointProblem(
        gather_both(boards.seen_by),
        joint_basis(cameras),
        starting_weights(boards.seen_by, cameras),
        prior_of(given) if given is not None and options.intrinsics == "prior" else None,
    )
    start = starting_state(boards, cameras, relation.right_from_left)
    return solve_both(boards.seen_by, problem, start, options.camera.max_steps)


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
    covariance = stereo_covariance(evidence.solution, held)
    if isinstance(covariance, FitFailure):
        return covariance
    steps = options.camera.max_steps
    hold_out = (
        hold_out_pairs(evidence.solution, options.n_folds, steps) if options.n_folds else None
    )
    return assemble(evidence, covariance, hold_out, options)
