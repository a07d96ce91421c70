# SPDX-License-Identifier: Apache-2.0
"""What names the sheets of stripes, exposure by exposure, and says which lasers it wants next."""

from __future__ import annotations

from typing import Protocol

from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.reconstruction.named_profile import NamedProfile
from armscan.records.profile import Profile

STROKE_GAP_NS = 250_000_000
"""A longer pause between exposures begins a new stroke, of which nothing is known yet."""


class StripeNamer(Protocol):
    """Names the stripes of one camera's exposures in order of time; it remembers the past.

    What it returns depends on what it was given since the last `reset` and on nothing else, so
    that a recording whose rows name their lasers is named again as it was when it was taken.
    """

    def name(
        self,
        profile: Profile,
        lasers: tuple[str, ...],
        base_from_sensor: Pose[Base, Sensor] | None,
        t_ns: int,
    ) -> NamedProfile:
        """Name the points of the next exposure.

        Parameters
        ----------
        profile
            Its stripe points.
        lasers
            Sources that were on.
        base_from_sensor
            Where the sensor was; None if unknown.
        t_ns
            Mid-exposure time, larger than that of the exposure before.
        """

    def next_lasers(self) -> tuple[str, ...]:
        """Sources that should be on in the next exposure."""

    def reset(self) -> None:
        """Forget the past: the next exposure begins a new stroke."""
