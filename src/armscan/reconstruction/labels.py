# SPDX-License-Identifier: Apache-2.0
"""What became of each stripe point, the sheet it was given to, and what tells sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from armscan.geometry.arrays import ArrayRecord, IntArray, ints
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.reconstruction.epipolar import EpipolarOffset
from armscan.records.profile import Profile


class PointStatus(IntEnum):
    """What became of a stripe point: of its label first, then of its point in space."""

    MEASURED = 0
    """It has a sheet, and once it is triangulated a point."""
    FLAGGED = 1
    """Rejected by the stripe extraction; `Profile.flags` says why. Its sheet is not asked for."""
    NO_RAY = 2
    """The lens model has no inverse there, or the ray misses the sheet."""
    OUT_OF_DEPTH = 3
    """Meets the sheet outside the depths accepted: those in which it was calibrated, widened."""
    AMBIGUOUS = 4
    """Several sheets explain it about as well: dropped and counted, not guessed."""
    STRAY = 5
    """No sheet explains it: a reflection, or the laser's bright centre."""
    SHARED = 6
    """The other camera saw the same point: it is measured there, from both images."""
    INCONSISTENT = 7
    """The two cameras contradict each other."""
    NO_LASER_RAY = 8
    """Brighter parts of the line took all rays of the laser: a reflection, or other light."""

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _WORDS[self]


_WORDS = {
    PointStatus.MEASURED: "measured",
    PointStatus.FLAGGED: "flagged by the stripe extraction",
    PointStatus.NO_RAY: "no ray meets the sheet",
    PointStatus.OUT_OF_DEPTH: "too far outside the calibrated depths",
    PointStatus.AMBIGUOUS: "on several sheets about as likely",
    PointStatus.STRAY: "on no sheet: stray light",
    PointStatus.SHARED: "in the other camera's point",
    PointStatus.INCONSISTENT: "contradicted by the other camera",
    PointStatus.NO_LASER_RAY: "beside an unbroken line: a reflection",
}


class LabelledProfile(ArrayRecord):
    """Stripe points of one exposure with the light sheet that drew each.

    Parameters
    ----------
    profile
        All N stripe points.
    sheet
        (N,) index into the sensor's sheets; -1 for none.
    status
        (N,) `PointStatus` of each.
    reason
        How the sheets were told, in words.
    """

    profile: Profile
    sheet: IntArray = ints("N")
    status: IntArray = ints("N")
    reason: str

    def count(self, status: PointStatus) -> int:
        """Count of points of this status."""
        return int((self.status == status).sum())


@dataclass(frozen=True, slots=True, eq=False)
class LabelledInstant:
    """What the cameras saw at one instant, labelled.

    Parameters
    ----------
    profiles
        One a camera, left first.
    offset
        How far the right camera's picture has moved; None for one camera.
    """

    profiles: tuple[LabelledProfile, ...]
    offset: EpipolarOffset | None = None


PASS_GAP_NS = 250_000_000
"""A longer pause between exposures begins a new pass, of which nothing is known yet."""


class StripeLabeller(Protocol):
    """Tells the sheets of stripes, instant by instant in order of time; it may remember the past.

    What it returns depends on what it was given since the last `reset` and on nothing else, so
    that a recording whose rows name their lasers is labelled again as it was when it was taken.
    """

    def label(
        self,
        profiles: Sequence[Profile],
        lasers: tuple[str, ...] = (),
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> LabelledInstant:
        """Label the stripe points of the next instant.

        Parameters
        ----------
        profiles
            Stripe points of each camera.
        lasers
            Sources that were on; empty if unknown.
        base_from_sensor
            Where the sensor was; None if unknown.
        t_ns
            Mid-exposure time, larger than that of the instant before.
        """

    def next_lasers(self) -> tuple[str, ...]:
        """Sources that should be on in the next exposure; empty for those of the recording."""

    def reset(self) -> None:
        """Forget the past: the next exposure begins a new pass."""
