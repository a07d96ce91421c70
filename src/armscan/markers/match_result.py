# SPDX-License-Identifier: Apache-2.0
"""What matching two sets of markers says: matched, not unique, or no match."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from armscan.errors import OptionError
from armscan.geometry.arrays import IntArray, frozen_ints
from armscan.geometry.frames import Frame
from armscan.geometry.poses import Pose

LEAST_TO_CHECK = 4
"""Three markers fit wherever their triangle occurs, its mirror image included; a fourth checks."""


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How markers are matched.

    Parameters
    ----------
    least_common
        Markers that must agree, 4 at least.
    distance_sigmas
        Two distances agree within this many standard deviations of their difference: of true
        pairs one in 16,000 is lost at 4.
    position_sigmas
        A marker agrees with an alignment within this many standard deviations.
    false_alarms
        Expected count of alignments, in sets without anything in common, that would explain as
        many markers: above it a match is taken for chance.
    rival_share
        A second alignment that explains this share of the best one's markers makes it not unique.
    max_triangles
        Triangles of markers that are looked for in the other set; all of them where there are
        no more.
    """

    least_common: int = LEAST_TO_CHECK
    distance_sigmas: float = 4.0
    position_sigmas: float = 4.5
    false_alarms: float = 1e-4
    rival_share: float = 0.5
    max_triangles: int = 400

    def __post_init__(self) -> None:
        if self.least_common < LEAST_TO_CHECK:
            raise OptionError(
                f"{self.least_common} common markers leave no check",
                where="least_common",
                remedy=f"ask for {LEAST_TO_CHECK} or more",
            )
        for name in ("distance_sigmas", "position_sigmas", "false_alarms", "rival_share"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise OptionError(f"{name} is {getattr(self, name)}", remedy="give a number > 0")


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A rigid motion that carries markers of the second set onto markers of the first.

    Parameters
    ----------
    pairs
        (K, 2) indices into the first and the second set, each index once, ordered by the first.
    first_from_second
        The motion, unweighted; `armscan.geometry.registration` gives the weighted one.
    """

    pairs: IntArray
    first_from_second: Pose[Frame, Frame]

    def __post_init__(self) -> None:
        pairs = self.pairs[self.pairs[:, 0].argsort()]
        object.__setattr__(self, "pairs", frozen_ints(pairs, (None, 2), "pairs of markers"))

    def __len__(self) -> int:
        """Count of markers explained."""
        return len(self.pairs)


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """The one alignment that explains the markers.

    Parameters
    ----------
    alignment
        Pairs and motion.
    n_rival
        Markers that the best other alignment explains.
    log10_false_alarms
        Logarithm of the count of alignments as good that chance alone would give.
    """

    alignment: Alignment
    n_rival: int
    log10_false_alarms: float


@dataclass(frozen=True, slots=True, eq=False)
class NotUnique:
    """More than one alignment explains the markers; none is chosen. Falsy."""

    reason: str
    remedy: str
    rivals: tuple[Alignment, ...]

    def __bool__(self) -> bool:
        """Return False: this is no match."""
        return False


@dataclass(frozen=True, slots=True)
class NoMatch:
    """No alignment explains enough markers. Falsy.

    Parameters
    ----------
    reason, remedy
        What and what to do.
    n_best
        Markers that the best alignment explains.
    """

    reason: str
    remedy: str
    n_best: int = 0

    def __bool__(self) -> bool:
        """Return False: this is no match."""
        return False


MatchResult: TypeAlias = Matched | NotUnique | NoMatch
