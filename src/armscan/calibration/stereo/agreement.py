# SPDX-License-Identifier: Apache-2.0
"""What the pairs of images agree on: where the right camera is, and which of them do not fit.

Each pair gives ``right_from_left`` by itself, in as many ways as its target can be numbered and its
boards mirrored. The one that most pairs agree on, to within their noise, is taken; each pair takes
the way that comes nearest. A symmetric target turned by half a turn in one image gives another
``right_from_left`` in every pair unless the board lay alike in all: then nothing can tell, which is
said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from armscan.calibration.stereo.relative_pose import (
    BoardSeen,
    RelativePose,
    differences,
    relative_pose,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector
from armscan.vision.targets.symmetry import Numbering

WRONG_LEVEL = 100.0
"""A pair whose squared distance from the others, over its noise, is a hundred times that of the
typical pair does not scatter: it is wrong."""

NO_AGREEMENT_LEVEL = 2500.0
"""The typical pair lies fifty of its standard deviations from the best compromise."""

RIVAL_LEVEL = 9.0
"""Another compromise that fits up to three times as badly is not refuted."""

MEDIAN_LEVEL = float(stats.chi2.median(6)) / 6.0
ROUNDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """One way to read a pair.

    Parameters
    ----------
    sensor_from_board
        Where the board is in the left camera.
    relative
        Where the right camera is then.
    numbering
        How the target's numbers in the right image are to be turned.
    """

    sensor_from_board: Pose[Sensor, Board]
    relative: RelativePose
    numbering: Numbering


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """What the pairs agree on.

    Parameters
    ----------
    right_from_left
        Weighted mean over the pairs that agree.
    ways
        The way of each pair that comes nearest.
    levels
        (P,) squared distance of each pair from the mean over its covariance and the six degrees of
        freedom.
    typical
        Of the typical pair, at least 1.
    agrees
        (P,) False for wrong pairs.
    """

    right_from_left: Pose[CameraRight, Sensor]
    ways: tuple[Way, ...]
    levels: FloatArray
    typical: float
    agrees: BoolArray

    def fits(self, ways: Sequence[Way]) -> bool:
        """True if one of the ways to read some other pair agrees too."""
        levels = _Stacked.of([ways]).levels_from(self.right_from_left, np.zeros((6, 6)))
        return float(levels.min()) <= WRONG_LEVEL * self.typical


def ways_of_pair(
    left: Sequence[BoardSeen], right: Sequence[BoardSeen], numberings: Sequence[Numbering]
) -> list[Way]:
    """All ways to read a pair."""
    return [
        Way(a.camera_from_board, relative_pose(a, b, numbering.new_from_found), numbering)
        for a in left
        for b in right
        for numbering in numberings
    ]


def agree(ways: Sequence[Sequence[Way]]) -> Agreement | FitFailure:
    """Find what most pairs agree on.

    Parameters
    ----------
    ways
        Of each pair, at least one.

    Returns
    -------
    agreement
        Or why there is none: the pairs contradict each other, or two answers fit alike.
    """
    stacked = _Stacked.of(ways)
    levels = np.array([stacked.typical(stacked.levels(k)) for k in range(len(stacked.pair))])
    best = int(np.argmin(levels))
    if levels[best] > NO_AGREEMENT_LEVEL:
        return FitFailure(
            "the pairs do not agree on where the right camera is: typically they lie "
            f"{np.sqrt(levels[best]):.0f} standard deviations from the best compromise",
            "check that both lists are in the same order, that the two images of a pair were "
            "taken at one instant with the board at rest, and that the cameras are fixed to each "
            "other",
        )
    floor = max(float(levels[best]), 1.0)
    apart = stacked.levels(best)
    rivals = np.flatnonzero((apart > WRONG_LEVEL * floor) & (levels < RIVAL_LEVEL * floor))
    if len(rivals):
        return _undecided(stacked, best, int(rivals[0]))
    return _refined(ways, stacked, best)


@dataclass(frozen=True, slots=True, eq=False)
class _Stacked:
    """All ways of all pairs in arrays."""

    rotations: FloatArray
    translations: FloatArray
    covariances: FloatArray
    pair: IntArray
    turns: IntArray
    n_pairs: int

    @staticmethod
    def of(ways: Sequence[Sequence[Way]]) -> _Stacked:
        flat = [way for of_pair in ways for way in of_pair]
        poses = [way.relative.right_from_left for way in flat]
        return _Stacked(
            np.array([pose.rotation for pose in poses]),
            np.array([pose.translation_mm for pose in poses]),
            np.array([way.relative.covariance for way in flat]),
            np.repeat(np.arange(len(ways)), [len(of_pair) for of_pair in ways]),
            np.array([way.numbering.quarter_turns for way in flat], dtype=np.int64),
            len(ways),
        )

    def pose(self, k: int) -> Pose[CameraRight, Sensor]:
        return Pose(self.rotations[k], self.translations[k])

    def levels(self, k: int) -> FloatArray:
        """(H,) squared distance of each way from way number k over both covariances, per degree."""
        return self.levels_from(self.pose(k), self.covariances[k])

    def levels_from(
        self, reference: Pose[CameraRight, Sensor], covariance: FloatArray
    ) -> FloatArray:
        apart = differences(self.rotations, self.translations, reference)
        white = np.linalg.solve(self.covariances + covariance, apart[:, :, None])[:, :, 0]
        return np.asarray(np.sum(apart * white, axis=1) / 6.0)

    def nearest(self, levels: FloatArray) -> tuple[FloatArray, IntArray]:
        """(P,) least level of each pair, and the way that has it."""
        chosen = np.zeros(self.n_pairs, dtype=np.int64)
        for p in range(self.n_pairs):
            rows = np.flatnonzero(self.pair == p)
            chosen[p] = rows[np.argmin(levels[rows])]
        return levels[chosen], chosen

    def typical(self, levels: FloatArray) -> float:
        """The level that more than half of the pairs stay within."""
        return float(np.sort(self.nearest(levels)[0])[self.n_pairs // 2])


def _undecided(stacked: _Stacked, best: int, rival: int) -> FitFailure:
    turn = differences(
        stacked.rotations[rival : rival + 1],
        stacked.translations[rival : rival + 1],
        stacked.pose(best),
    )[0]
    facts = (
        f"two answers fit the pairs alike; they differ by "
        f"{np.rad2deg(np.linalg.norm(turn[:3])):.0f} degrees and {np.linalg.norm(turn[3:]):.0f} mm"
    )
    if len(np.unique(stacked.turns)) > 1:
        return FitFailure(
            f"the target looks the same when it is turned, and {facts}",
            "tilt the board differently from pair to pair, or use a target that cannot be turned: "
            "a chessboard with an odd sum of columns and rows, or ChArUco",
        )
    return FitFailure(facts, "tilt the board more, and differently from pair to pair")


def _refined(ways: Sequence[Sequence[Way]], stacked: _Stacked, best: int) -> Agreement:
    """Weighted mean over the pairs that agree, which are those near to it."""
    mean, covariance = stacked.pose(best), stacked.covariances[best]
    for _ in range(ROUNDS):
        levels, chosen = stacked.nearest(stacked.levels_from(mean, covariance))
        typical = max(float(np.sort(levels)[stacked.n_pairs // 2]) / MEDIAN_LEVEL, 1.0)
        agrees = levels <= WRONG_LEVEL * typical
        mean = weighted_mean(
            stacked.rotations[chosen[agrees]],
            stacked.translations[chosen[agrees]],
            stacked.covariances[chosen[agrees]],
            mean,
        )
        covariance = np.zeros((6, 6))
    starts = np.concatenate([[0], np.cumsum([len(of_pair) for of_pair in ways])])
    picked = tuple(ways[p][int(chosen[p]) - int(starts[p])] for p in range(len(ways)))
    return Agreement(mean, picked, levels, typical, np.asarray(agrees))


def weighted_mean(
    rotations: FloatArray,
    translations_mm: FloatArray,
    covariances: FloatArray,
    near: Pose[CameraRight, Sensor],
) -> Pose[CameraRight, Sensor]:
    """Mean of N poses, each weighted by its inverse covariance (6, 6), linearised at ``near``."""
    apart = differences(rotations, translations_mm, near)
    information = np.linalg.inv(covariances)
    step = np.linalg.solve(
        information.sum(axis=0), (information @ apart[:, :, None])[:, :, 0].sum(axis=0)
    )
    return Pose(rotation_from_vector(step[:3]) @ near.rotation, near.translation_mm + step[3:])


def true_order(
    left: Sequence[Sequence[BoardSeen]],
    right: Sequence[Sequence[BoardSeen]],
    numberings: Sequence[Numbering],
) -> tuple[int, ...] | None:
    """Which right view goes with each left view, if the lists are in different orders.

    Parameters
    ----------
    left, right
        P boards each, in the order given.
    numberings
        Of the target.

    Returns
    -------
    partner
        Index of the right view that fits each left view best, if another order than the given one
        makes more than half of the pairs agree; else None.
    """
    n = len(left)
    every = [ways_of_pair(a, b, numberings) for a in left for b in right]
    stacked = _Stacked.of(every)
    best: tuple[int, IntArray] | None = None
    for k in range(len(stacked.pair)):
        levels = stacked.nearest(stacked.levels(k))[0].reshape(n, n)
        partner = np.argmin(levels, axis=1)
        near = levels[np.arange(n), partner] <= WRONG_LEVEL
        count = len(np.unique(partner[near]))
        if best is None or count > best[0]:
            best = count, partner
    if best is None or 2 * best[0] <= n or best[0] < 3:
        return None
    return tuple(int(p) for p in best[1])
