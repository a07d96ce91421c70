# SPDX-License-Identifier: Apache-2.0
"""From pairs of views to boards that both cameras see, starting values included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.stereo.agreement import Agreement, Way, agree, true_order, ways_of_pair
from armscan.calibration.stereo.options import MIN_PAIRS
from armscan.calibration.stereo.pairs import SIDES, StereoPair
from armscan.calibration.stereo.relative_pose import BoardSeen, boards_seen
from armscan.calibration.stereo.single_camera import SingleCamera
from armscan.geometry.arrays import BoolArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.vision.targets.definition import Target
from armscan.vision.targets.symmetry import Numbering, numberings

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
    given
        Its views as given.
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


def relate(pairs: Sequence[StereoPair], cameras: Cameras, target: Target) -> Relation | FitFailure:
    """Find where the cameras are to each other, and which pairs do not tell.

    Parameters
    ----------
    pairs
        As given.
    cameras
        Each camera by itself.
    target
        What they show: it may be numbered in several ways.
    """
    known = numberings(target)
    usable = [_usable(pair, cameras, known[0]) for pair in pairs]
    both = [k for k, pair in enumerate(usable) if all(pair.seen)]
    if len(both) < MIN_PAIRS:
        return too_few(len(both), [f"{p.given.name}: {p.note}" for p in usable if p.note])
    ways = [ways_of_pair(*usable[k].seen, known) for k in both]
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
    n_good = sum(pair.is_related for pair in usable)
    if n_good < MIN_PAIRS:
        return too_few(n_good, [f"{p.given.name}: {p.note}" for p in usable if p.note])
    return Relation(tuple(usable), agreement.right_from_left)


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
        swapped = ways_of_pair(found.seen[0], other.seen[1], known)
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
    listed = ", ".join(examples[:LISTED]) + (", ..." if len(examples) > LISTED else "")
    return FitFailure(
        f"the lists of images are not in the same order: {listed} would fit",
        "give both lists in the order in which they were taken",
    )
