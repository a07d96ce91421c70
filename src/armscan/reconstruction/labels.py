# SPDX-License-Identifier: Apache-2.0
"""The state of each stripe point, the sheet it was given to, and the protocol of labellers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from armscan.geometry.arrays import IntArray, frozen_ints
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile


class PointStatus(IntEnum):
    """What became of a stripe point in a reconstruction."""

    MEASURED = 0
    FLAGGED = 1
    """Rejected by the stripe extraction; `Profile.flags` says why."""
    NO_RAY = 2
    """The lens model has no inverse there, or the ray misses the sheet."""
    OUT_OF_DEPTH = 3
    """Meets the sheet outside the depths accepted: those in which it was calibrated, widened."""
    AMBIGUOUS = 4
    """Several sheets explain it about as well."""
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
        return _FATE_LABELS[self]


_FATE_LABELS = {
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


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredProfile:
    """What one exposure gave.

    Parameters
    ----------
    profile
        All N stripe points.
    fate
        (N,) `PointStatus` of each.
    sheet
        (N,) index of its sheet in ``Reconstruction.cloud.sheet_names``; -1 for none.
    naming
        How the sheet was chosen, in words.
    """

    profile: Profile
    fate: IntArray
    sheet: IntArray
    naming: str

    def __post_init__(self) -> None:
        n = len(self.profile)
        object.__setattr__(self, "fate", frozen_ints(self.fate, (n,), "fate"))
        object.__setattr__(self, "sheet", frozen_ints(self.sheet, (n,), "sheet"))

    def count(self, fate: PointStatus) -> int:
        """Count of points with this fate."""
        return int((self.fate == int(fate)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Measured points and the evidence of each image.

    Parameters
    ----------
    cloud
        Points in the Sensor frame.
    images
        One entry an exposure, in the order given; ``cloud.exposure`` points into it.
    warnings
        What is weak, in words.
    """

    cloud: PointCloud
    images: tuple[MeasuredProfile, ...]
    warnings: tuple[str, ...] = ()


class LabelStatus(IntEnum):
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
    LabelStatus.NAMED: "named",
    LabelStatus.AMBIGUOUS: "on several sheets about as likely",
    LabelStatus.UNEXPLAINED: "on no sheet: stray light",
    LabelStatus.NOT_ASKED: "flagged by the stripe extraction",
}


@dataclass(frozen=True, slots=True, eq=False)
class LabelledProfile:
    """Stripe points of one exposure with their sheets.

    Parameters
    ----------
    profile
        The stripe points.
    sheet
        (N,) index into the sensor's sheets; -1 for none.
    fate
        (N,) `LabelStatus`; ``NAMED`` exactly where ``sheet`` is not -1.
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

    def count(self, fate: LabelStatus) -> int:
        """Count of points with this fate."""
        return int((self.fate == int(fate)).sum())


class StereoStatus(IntEnum):
    """What became of a stripe point of one of two cameras."""

    UNNAMED = 0
    """It has no sheet; its `LabelStatus` says why."""
    FUSED = 1
    """A left point that the right camera sees too: measured from both images."""
    ALONE = 2
    """Only this camera sees it: measured from its image and the sheet."""
    TAKEN = 3
    """A right point at or beside the right picture of a fused left point: it is measured there."""
    OUT_OF_DEPTH = 4
    """Only this camera sees it, and it lies outside the depths accepted: dropped."""
    INCONSISTENT = 5
    """Left and right picture contradict the sheet: dropped, as are the right points beside it."""
    NO_RAY = 6
    """The lens model has no inverse there, or the ray misses the sheet."""


STROKE_GAP_NS = 250_000_000
"""A longer pause between exposures begins a new stroke, of which nothing is known yet."""


class StripeLabeller(Protocol):
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
    ) -> LabelledProfile:
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
