# SPDX-License-Identifier: Apache-2.0
"""How far each pair's own relative pose lies from that of the other pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from armscan.calibration.stereo.agreement import MEDIAN_LEVEL
from armscan.calibration.stereo.pairs import StereoPair
from armscan.calibration.stereo.relative_pose import (
    RelativePose,
    board_near,
    differences,
    relative_pose,
)
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.models.two_views import TwoViews

FALSE_ALARM = 1e-3
"""A pair is a misfit if noise would yield one so far out, among all pairs, once in a thousand
calibrations..."""

MISFIT_LEVEL = 9.0
"""...and if it lies three times as far out as the typical pair: lenses and boards are never quite
as modelled, so that more than noise sets the pairs apart."""


@dataclass(frozen=True, slots=True, eq=False)
class PairLevels:
    """Distances of P pairs.

    Parameters
    ----------
    levels
        (P,) squared distance from the other pairs over both covariances and the six degrees of
        freedom, over that of the typical pair.
    typical
        Of the typical pair, at least 1.
    is_misfit
        (P,) pairs that disagree with the others.
    """

    levels: FloatArray
    typical: float
    is_misfit: BoolArray


def own_pose(
    pair: StereoPair, views: TwoViews, sensor_from_board: Pose[Sensor, Board]
) -> RelativePose:
    """``right_from_left`` by one pair alone (eqs. 4.14 to 4.16), the cameras being known.

    Parameters
    ----------
    pair
        Seen by both cameras.
    views
        The cameras; each finds the board by itself near to where both together have it.
    sensor_from_board
        That place.

    Raises
    ------
    InputError
        If the pair lacks a view, or one does not determine the board's pose.
    """
    if pair.left is None or pair.right is None:
        raise InputError("the pair lacks a view", where=pair.name)
    in_right = views.right_from_left @ sensor_from_board
    near_right: Pose[Sensor, Board] = Pose(in_right.rotation, in_right.translation_mm)
    left = board_near(pair.left, views.left, sensor_from_board)
    right = board_near(pair.right, views.right, near_right)
    if isinstance(left, FitFailure) or isinstance(right, FitFailure):
        raise InputError("a view of the pair does not determine the board's pose", where=pair.name)
    as_numbered: Pose[Board, Board] = Pose(np.eye(3), np.zeros(3))
    return relative_pose(left, right, as_numbered)


def compare_pairs(relatives: Sequence[RelativePose], near: Pose[CameraRight, Sensor]) -> PairLevels:
    """Set each pair against the weighted mean of the others, misfits not counted among them.

    Parameters
    ----------
    relatives
        ``right_from_left`` of each pair by itself.
    near
        That of all together, at which the mean is linearised.
    """
    apart = differences(
        np.array([relative.right_from_left.rotation for relative in relatives]),
        np.array([relative.right_from_left.translation_mm for relative in relatives]),
        near,
    )
    covariances = np.array([relative.covariance for relative in relatives])
    n = len(relatives)
    limit = max(float(stats.chi2.isf(FALSE_ALARM / n, 6)) / 6.0, MISFIT_LEVEL)
    is_good = np.ones(n, dtype=np.bool_)
    while True:
        absolute = _left_out_levels(apart, covariances, is_good)
        typical = max(float(np.median(absolute[is_good])) / MEDIAN_LEVEL, 1.0)
        levels = absolute / typical
        worst = int(np.argmax(np.where(is_good, levels, -np.inf)))
        if levels[worst] <= limit or is_good.sum() <= max(2, n // 2):
            return PairLevels(levels, typical, np.asarray(~is_good))
        is_good[worst] = False


def _left_out_levels(apart: FloatArray, covariances: FloatArray, is_good: BoolArray) -> FloatArray:
    information = np.linalg.inv(covariances)
    pulls = (information @ apart[:, :, None])[:, :, 0]
    levels = np.zeros(len(apart))
    for p in range(len(apart)):
        others = is_good.copy()
        others[p] = False
        spread = np.linalg.inv(information[others].sum(axis=0))
        miss = apart[p] - spread @ pulls[others].sum(axis=0)
        levels[p] = float(miss @ np.linalg.solve(covariances[p] + spread, miss)) / 6.0
    return levels
