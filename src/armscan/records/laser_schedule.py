# SPDX-License-Identifier: Apache-2.0
"""Which lasers are on in which exposure, as data (figure 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class LaserSchedule:
    """Lasers that are on, exposure by exposure, over and over.

    Parameters
    ----------
    pattern
        Names of the sources that are on in each exposure of a period.
    """

    pattern: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        if not self.pattern or not any(self.pattern):
            raise OptionError(
                "a laser schedule without lasers", remedy="give at least one exposure with a laser"
            )

    def lasers(self, exposure: int) -> tuple[str, ...]:
        """Sources that are on in exposure number ``exposure``, counted from 0."""
        return self.pattern[exposure % len(self.pattern)]


THESIS_SCHEDULE = LaserSchedule((("A",), ("B",), ("A", "B")))
"""Figure 3.2: A alone, B alone, both; four stripes in three exposures, 1.33 of one laser's."""

ALWAYS_BOTH = LaserSchedule((("A", "B"),))
"""Both lasers on in every exposure."""
