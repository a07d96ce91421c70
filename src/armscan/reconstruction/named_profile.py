# SPDX-License-Identifier: Apache-2.0
"""Stripe points with the light sheet that drew each, or why it has none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from armscan.geometry.arrays import IntArray, frozen_ints
from armscan.records.profile import Profile


class NameFate(IntEnum):
    """Whether the sheet of a stripe point could be told."""

    NAMED = 0
    AMBIGUOUS = 1
    """Several sheets explain it about as well: dropped and counted, not guessed."""
    UNEXPLAINED = 2
    """No sheet explains it: a stray reflection, or the laser's bright centre."""
    NOT_ASKED = 3
    """Rejected by the stripe extraction; its sheet was not looked for."""

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _LABELS[self]


_LABELS = {
    NameFate.NAMED: "named",
    NameFate.AMBIGUOUS: "on several sheets about as likely",
    NameFate.UNEXPLAINED: "on no sheet: stray light",
    NameFate.NOT_ASKED: "flagged by the stripe extraction",
}


@dataclass(frozen=True, slots=True, eq=False)
class NamedProfile:
    """Stripe points of one exposure with their sheets.

    Parameters
    ----------
    profile
        The stripe points.
    sheet
        (N,) index into the sensor's sheets; -1 for none.
    fate
        (N,) `NameFate`; ``NAMED`` exactly where ``sheet`` is not -1.
    how
        How the sheets were told, in words.
    """

    profile: Profile
    sheet: IntArray
    fate: IntArray
    how: str

    def __post_init__(self) -> None:
        n = len(self.profile)
        object.__setattr__(self, "sheet", frozen_ints(self.sheet, (n,), "sheet"))
        object.__setattr__(self, "fate", frozen_ints(self.fate, (n,), "fate"))

    def count(self, fate: NameFate) -> int:
        """Count of points with this fate."""
        return int((self.fate == int(fate)).sum())
