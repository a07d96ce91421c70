# SPDX-License-Identifier: Apache-2.0
"""Pose of the right camera in the left one pair by pair, and how far the pairs agree: which
pair is an outlier and what the noise of a pair is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from armscan.calibration.cameras.adjustment import (
    SINGULAR_CONDITION,
    State,
    adjust,
    condition_number,
    gather,
)
from armscan.calibration.cameras.distortion import NO_SHARED
from armscan.calibration.cameras.pairs import MIN_PAIRS, SIDES, SingleCamera, StereoPair
from armscan.calibration.cameras.robust import FALSE_ALARM, MISFIT_LEVEL, WRONG_LEVEL
from armscan.calibration.cameras.start import estimate_board_poses
from armscan.errors import InputError, begun
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, skew
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews
from armscan.vision.targets.detect import Numbering, numberings
from armscan.vision.targets.target import Target, TargetView


@dataclass(frozen=True, slots=True, eq=False)
class BoardSeen:
    """A pose of a board that one view allows; Sensor stands for that camera's frame.

    ``covariance`` (6, 6) is of rotation-vector increment (rad, in that frame, on the left) and
    translation (mm), due to the points' noise alone.
    """

    camera_from_board: Pose[Sensor, Board]
    covariance: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (6, 6), "covariance"))


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """``right_from_left`` with its covariance (6, 6), conventions as in `BoardSeen`."""

    right_from_left: Pose[CameraRight, Sensor]
    covariance: FloatArray


def boards_seen(view: TargetView, camera: CameraModel) -> tuple[BoardSeen, ...] | FitFailure:
    """The pose of a board; also the mirrored one where the view does not refute it."""
    found = estimate_board_poses(view, camera)
    if isinstance(found, FitFailure):
        return found
    return tuple(BoardSeen(pose.value, pose.covariance) for pose in found)


def board_near(
    view: TargetView, camera: CameraModel, near: Pose[Sensor, Board]
) -> BoardSeen | FitFailure:
    """The pose of a board by one view alone, from a pose that is nearly right."""
    shared = np.append(camera.parameters, np.zeros(2))
    result = adjust(gather([view], camera.lens), State.from_poses(shared, [near]), NO_SHARED)
    if isinstance(result, FitFailure):
        return result
    if not condition_number(result.system.pose[0]) < SINGULAR_CONDITION:
        return FitFailure("the points do not determine a pose", "show more of the board")
    level = result.system.chi2 / max(2 * len(view) - 6, 1)
    return BoardSeen(result.state.pose(0), level * np.linalg.inv(result.system.pose[0]))


def relative_pose(
    left: BoardSeen, right: BoardSeen, new_from_found: Pose[Board, Board]
) -> RelativePose:
    """Eliminate the board (eqs. 4.14 to 4.16) from what both cameras see of it.

    The right view's numbers are turned by ``new_from_found`` first.
    """
    renumbered = right.camera_from_board @ new_from_found.inverse()
    right_from_board: Pose[CameraRight, Board] = Pose(
        renumbered.rotation, renumbered.translation_mm
    )
    pose = right_from_board @ left.camera_from_board.inverse()
    arm = skew(pose.rotation @ left.camera_from_board.translation_mm)
    by_right, by_left = np.eye(6), np.zeros((6, 6))
    by_right[3:, :3] = arm
    by_left[:3, :3] = by_left[3:, 3:] = -pose.rotation
    by_left[3:, :3] = -arm @ pose.rotation
    # Numbers turned about the board's middle leave the image points, and so the noise of the pose
    # in the camera, as they are; its translation refers to another corner of the board.
    moved = np.eye(6)
    moved[3:, :3] = -skew(renumbered.translation_mm - right.camera_from_board.translation_mm)
    by_right = by_right @ moved
    covariance = by_left @ left.covariance @ by_left.T + by_right @ right.covariance @ by_right.T
    return RelativePose(pose, 0.5 * (covariance + covariance.T))


def differences(
    rotations: FloatArray, translations_mm: FloatArray, reference: Pose[CameraRight, Sensor]
) -> FloatArray:
    """(N, 6) increments, rad and mm, that take ``reference`` to each of N poses."""
    turns = Rotation.from_matrix(rotations @ reference.rotation.T).as_rotvec()
    return np.concatenate([turns, translations_mm - reference.translation_mm], axis=1)


NO_AGREEMENT_LEVEL = 2500.0
"""The typical pair lies fifty of its standard deviations from the best compromise."""

RIVAL_LEVEL = 9.0
"""Another compromise that fits up to three times as badly is not refuted."""

JUDGES, GUESSED = 8, 3
"""Left views, evenly chosen, that judge in which order lists are, and those of them of which any
right view is taken for the partner: with all, the time grew with the fourth power of the count."""

MEDIAN_LEVEL = float(chdtri(6, 0.5)) / 6.0
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


def relative_pose_candidates(
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
    """Find what most pairs agree on, of each pair's ways to be read, one at least.

    There is none where pairs contradict each other, or two answers fit alike.
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
        least = np.minimum.reduceat(levels, np.searchsorted(self.pair, np.arange(self.n_pairs)))
        rows = np.flatnonzero(levels == least[self.pair])
        return least, rows[np.unique(self.pair[rows], return_index=True)[1]]

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

    None unless another order than the given one makes more than half of the pairs agree. A few left
    views with any right view put the right camera somewhere; of these places the one is taken at
    which most of some more left views find a partner.
    """
    n = len(left)
    judges = np.unique(np.linspace(0, n - 1, JUDGES).round().astype(np.int64))
    some = _Stacked.of(
        [relative_pose_candidates(left[a], b, numberings) for a in judges for b in right]
    )
    guessed = np.linspace(0, len(judges) - 1, GUESSED).round().astype(np.int64)
    best, most = 0, 0
    for k in np.flatnonzero(np.isin(some.pair // n, guessed)).tolist():
        count = _partners(some, some.levels(k), n)[0]
        if count > most:
            best, most = k, count
        if most == len(judges):
            break
    every = _Stacked.of([relative_pose_candidates(a, b, numberings) for a in left for b in right])
    levels = every.levels_from(some.pose(best), some.covariances[best])
    count, partner = _partners(every, levels, n)
    if 2 * count <= n or count < MIN_PAIRS:
        return None
    return tuple(partner.tolist())


def _partners(stacked: _Stacked, levels: FloatArray, n: int) -> tuple[int, IntArray]:
    """How many right views are near to a left one, and which of the n comes nearest to each."""
    nearest = stacked.nearest(levels)[0].reshape(-1, n)
    partner = np.argmin(nearest, axis=1)
    near = nearest.min(axis=1) <= WRONG_LEVEL
    return len(np.unique(partner[near])), partner


@dataclass(frozen=True, slots=True, eq=False)
class PairNoise:
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

    Each finds the board by itself near to ``sensor_from_board``, where both together have it.

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


def compare_pairs(relatives: Sequence[RelativePose], near: Pose[CameraRight, Sensor]) -> PairNoise:
    """Set each pair against the weighted mean of the others, misfits not counted among them.

    The mean is linearised at ``near``, that of all together.
    """
    apart = differences(
        np.array([relative.right_from_left.rotation for relative in relatives]),
        np.array([relative.right_from_left.translation_mm for relative in relatives]),
        near,
    )
    covariances = np.array([relative.covariance for relative in relatives])
    n = len(relatives)
    limit = max(float(chdtri(6, FALSE_ALARM / n)) / 6.0, MISFIT_LEVEL)
    is_good = np.ones(n, dtype=np.bool_)
    while True:
        absolute = _left_out_levels(apart, covariances, is_good)
        typical = max(float(np.median(absolute[is_good])) / MEDIAN_LEVEL, 1.0)
        levels = absolute / typical
        worst = int(np.argmax(np.where(is_good, levels, -np.inf)))
        if levels[worst] <= limit or is_good.sum() <= max(2, n // 2):
            return PairNoise(levels, typical, np.asarray(~is_good))
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


LISTED = 4

Cameras = tuple[SingleCamera, SingleCamera]


@dataclass(frozen=True, slots=True, eq=False)
class RelatedPair:
    """One pair, and what it is used for.

    Parameters
    ----------
    pair
        Its views, those that cannot be used taken out, numbered as they are used; None if neither
        can be.
    seen
        Ways in which each view sees the board, by itself; empty for a view not used.
    numbering
        How the numbers in the right image were turned.
    start
        ``sensor_from_board`` to start from, of a pair that relates the cameras; else None.
    note
        What is to be said of it; empty for a good pair.
    """

    pair: StereoPair | None
    given: StereoPair
    seen: tuple[tuple[BoardSeen, ...], tuple[BoardSeen, ...]]
    numbering: Numbering
    start: Pose[Sensor, Board] | None
    note: str

    @property
    def is_related(self) -> bool:
        """True if it tells where the cameras are to each other."""
        return self.start is not None


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """All pairs with the relative pose to start from."""

    pairs: tuple[RelatedPair, ...]
    right_from_left: Pose[CameraRight, Sensor]

    def without(self, is_bad: BoolArray, note: str) -> Relation:
        """Take apart those of the related pairs that are bad."""
        bad = iter(is_bad.tolist())
        pairs = [
            replace(pair, start=None, note=note) if pair.is_related and next(bad) else pair
            for pair in self.pairs
        ]
        return replace(self, pairs=tuple(pairs))

    def unless_too_few(self) -> Relation | FitFailure:
        """Itself, or why its pairs do not do."""
        n_good = sum(pair.is_related for pair in self.pairs)
        return self if n_good >= MIN_PAIRS else too_few(n_good, _notes(self.pairs))


def _notes(pairs: Sequence[RelatedPair]) -> list[str]:
    return [f"{pair.given.name}: {pair.note}" for pair in pairs if pair.note]


def relate(pairs: Sequence[StereoPair], cameras: Cameras, target: Target) -> Relation | FitFailure:
    """Find where the cameras are to each other, and which pairs do not tell."""
    known = numberings(target)
    usable = [_usable(pair, cameras, known[0]) for pair in pairs]
    both = [k for k, pair in enumerate(usable) if all(pair.seen)]
    if len(both) < MIN_PAIRS:
        return too_few(len(both), _notes(usable))
    ways = [relative_pose_candidates(*usable[k].seen, known) for k in both]
    agreement = agree(ways)
    if isinstance(agreement, FitFailure):
        return _with_order(agreement, [usable[k] for k in both], known)
    for position, k in enumerate(both):
        found = usable[k]
        if agreement.agrees[position]:
            usable[k] = _read(found, agreement.ways[position], target)
        else:
            others = [usable[j] for i, j in enumerate(both) if not agreement.agrees[i]]
            level = float(agreement.levels[position]) / agreement.typical
            usable[k] = replace(found, note=_wrong(found, others, agreement, level, known))
    return Relation(tuple(usable), agreement.right_from_left).unless_too_few()


def too_few(n_pairs: int, reasons: Sequence[str]) -> FitFailure:
    """Refusal of too small a set."""
    listed = "; ".join(reasons[:LISTED])
    more = f"; and {len(reasons) - LISTED} more" if len(reasons) > LISTED else ""
    return FitFailure(
        f"{n_pairs} pairs tell where the cameras are to each other, {MIN_PAIRS} are needed"
        + (f" ({listed}{more})" if reasons else ""),
        "take 10 to 20 pairs in which both cameras see the board, tilted by 20 to 45 degrees in "
        "different directions",
    )


def _usable(pair: StereoPair, cameras: Cameras, as_found: Numbering) -> RelatedPair:
    """The pair with the views that can be used, and how they see the board."""
    kept, seen, notes = [], [], []
    for side, view in enumerate(pair.views):
        chosen = cameras[side].kept(view)
        boards = boards_seen(chosen, cameras[side].camera) if chosen is not None else ()
        if isinstance(boards, FitFailure):
            notes.append(f"{SIDES[side]} view not used: {boards.reason}")
            boards, chosen = (), None
        elif view is not None and chosen is None:
            notes.append(f"{SIDES[side]} view not used: {cameras[side].left_out[view.source]}")
        elif view is None:
            notes.append(f"the {SIDES[side]} camera did not see the target")
        kept.append(chosen)
        seen.append(boards)
    some = StereoPair(kept[0], kept[1]) if kept[0] is not None or kept[1] is not None else None
    return RelatedPair(some, pair, (seen[0], seen[1]), as_found, None, "; ".join(notes))


def _read(found: RelatedPair, way: Way, target: Target) -> RelatedPair:
    """The pair read the way that agrees with the others."""
    if found.pair is None:
        return found
    pair = found.pair.numbered(target, way.numbering)
    return replace(found, pair=pair, numbering=way.numbering, start=way.sensor_from_board, note="")


def _wrong(
    found: RelatedPair,
    wrong: Sequence[RelatedPair],
    agreement: Agreement,
    level: float,
    known: Sequence[Numbering],
) -> str:
    """What is wrong with a pair that contradicts the others."""
    facts = (
        f"it puts the right camera {np.sqrt(level):.0f} times as far from where the other pairs "
        "put it as the typical pair"
    )
    for other in wrong:
        swapped = relative_pose_candidates(found.seen[0], other.seen[1], known)
        if other is not found and swapped and agreement.fits(swapped):
            views = found.given.left, other.given.right
            names = " with ".join(view.source for view in views if view is not None)
            return f"{facts}; {names} would fit: the lists are not in one order"
    return f"{facts}: the board or a camera moved between its images, or they are no pair"


def _with_order(
    failure: FitFailure, pairs: Sequence[RelatedPair], known: Sequence[Numbering]
) -> FitFailure:
    """The failure, or the order of the lists that explains it."""
    partner = true_order([p.seen[0] for p in pairs], [p.seen[1] for p in pairs], known)
    if partner is None or partner == tuple(range(len(pairs))):
        return failure
    examples = []
    for pair, k in zip(pairs, partner, strict=True):
        views = pair.given.left, pairs[k].given.right
        examples.append(" with ".join(view.source for view in views if view is not None))
    listed = begun(examples, LISTED)
    return FitFailure(
        f"the lists of images are not in the same order: {listed} would fit",
        "give both lists in the order in which they were taken",
    )
