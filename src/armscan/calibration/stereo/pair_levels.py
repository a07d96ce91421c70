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
    boards_seen,
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


def own_pose(pair: StereoPair, views: TwoViews) -> RelativePose:
    """``right_from_left`` by one pair alone (eqs. 4.14 to 4.16), the cameras being known.

    Of the poses that two mirrored boards allow, the one nearest to that of ``views`` is taken.

    Raises
    ------
    InputError
        If the pair lacks a view, or one shows no board.
    """
    if pair.left is None or pair.right is None:
        raise InputError("the pair lacks a view", where=pair.name)
    left, right = boards_seen(pair.left, views.left), boards_seen(pair.right, views.right)
    if isinstance(left, FitFailure) or isinstance(right, FitFailure):
        raise InputError("a view of the pair shows no board", where=pair.name)
    as_numbered: Pose[Board, Board] = Pose(np.eye(3), np.zeros(3))
    ways = [relative_pose(a, b, as_numbered) for a in left for b in right]
    apart = differences(
        np.array([way.right_from_left.rotation for way in ways]),
        np.array([way.right_from_left.translation_mm for way in ways]),
        views.right_from_left,
    )
    return ways[int(np.argmin(np.linalg.norm(apart[:, :3], axis=1)))]


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
