# SPDX-License-Identifier: Apache-2.0
"""Points of a set of exposures, with what a report shows of each image."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from armscan.geometry.arrays import IntArray, frozen_ints
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile


class PointFate(IntEnum):
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
    PointFate.MEASURED: "measured",
    PointFate.FLAGGED: "flagged by the stripe extraction",
    PointFate.NO_RAY: "no ray meets the sheet",
    PointFate.OUT_OF_DEPTH: "too far outside the calibrated depths",
    PointFate.AMBIGUOUS: "on several sheets about as likely",
    PointFate.STRAY: "on no sheet: stray light",
    PointFate.SHARED: "in the other camera's point",
    PointFate.INCONSISTENT: "contradicted by the other camera",
    PointFate.NO_LASER_RAY: "beside an unbroken line: a reflection",
}


@dataclass(frozen=True, slots=True, eq=False)
class ReconstructedImage:
    """What one exposure gave.

    Parameters
    ----------
    profile
        All N stripe points.
    fate
        (N,) `PointFate` of each.
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

    def count(self, fate: PointFate) -> int:
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
    images: tuple[ReconstructedImage, ...]
    warnings: tuple[str, ...] = ()
