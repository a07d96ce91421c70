# SPDX-License-Identifier: Apache-2.0
"""What a scan gave: a cloud in Base and the fate of every exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

from armscan.pipeline.instants import PARTNER_MISSING
from armscan.pipeline.scan_doubts import ScanDoubt
from armscan.reconstruction.exposure_poses import ExposurePoses
from armscan.reconstruction.result import PointFate, ReconstructedImage
from armscan.records.cloud import PointCloud
from armscan.records.session import ExposureRow

LISTED = 4


class ScanExposureFate(Enum):
    """What became of one exposure of a scan; the value is what a report shows."""

    PLACED = "placed in Base"
    NO_POSE = "without pose"
    LASER_OFF = "laser off"
    UNREADABLE = "image cannot be read"
    NO_PARTNER = PARTNER_MISSING
    EQUAL_POSE = "left out: the pose of another exposure, but another stripe"


@dataclass(frozen=True, slots=True)
class ScanExposure:
    """One exposure of a scan.

    Parameters
    ----------
    row
        What the recording says of it.
    fate
        What became of it.
    reason
        Why it was not placed; empty if it was.
    n_stripe_points
        Points that looked like a stripe.
    n_measured
        Of these, measured.
    n_outside_volume
        Of the measured, outside the working volume in Base; the rest is in the cloud.
    """

    row: ExposureRow
    fate: ScanExposureFate
    reason: str = ""
    n_stripe_points: int = 0
    n_measured: int = 0
    n_outside_volume: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ScanReconstruction:
    """Measured points in Base and the evidence of each exposure.

    Parameters
    ----------
    cloud
        Points in Base. ``normals`` are (0, 0, 0) where there is no tangent plane, None if not
        asked for.
    images
        Stripe points of the exposures that were placed, in order of time; ``cloud.exposure``
        points into it.
    image_rows
        Row of the recording that each of ``images`` is.
    exposures
        One entry a row of the recording.
    poses
        Of every row; how poses were found.
    warnings
        What is weak, in words.
    doubt
        How far the passes of the scan agree.
    """

    cloud: PointCloud
    images: tuple[ReconstructedImage, ...]
    image_rows: tuple[int, ...]
    exposures: tuple[ScanExposure, ...]
    poses: ExposurePoses
    warnings: tuple[str, ...] = ()
    doubt: ScanDoubt = field(default_factory=lambda: ScanDoubt(None))

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What shows that arm, clock, images and calibration do not belong together, in words."""
        hung = self.count(ScanExposureFate.EQUAL_POSE)
        found = [fault.words for fault in self.poses.track_faults]
        if hung:
            found.append(f"{hung} exposures bear the pose of another one but show another stripe")
        return (*found, *self.doubt.warnings)

    @property
    def without_pose(self) -> tuple[tuple[str, str], ...]:
        """(source, reason) of the exposures with the laser on that have no pose."""
        return tuple(
            (exposure.row.source, exposure.reason)
            for exposure in self.exposures
            if exposure.fate in (ScanExposureFate.NO_POSE, ScanExposureFate.EQUAL_POSE)
        )

    @property
    def unreadable(self) -> tuple[tuple[str, str], ...]:
        """(source, reason) of the exposures whose image could not be read."""
        return tuple(
            (exposure.row.source, exposure.reason)
            for exposure in self.exposures
            if exposure.fate is ScanExposureFate.UNREADABLE
        )

    def count(self, fate: ScanExposureFate) -> int:
        """Count of exposures of this fate."""
        return sum(exposure.fate is fate for exposure in self.exposures)


def scan_warnings(exposures: Sequence[ScanExposure], poses: ExposurePoses) -> tuple[str, ...]:
    """What a person should know of the exposures that are not in the cloud."""
    warnings = list(poses.warnings)
    without = [e for e in exposures if e.fate is ScanExposureFate.NO_POSE]
    if without:
        counts: dict[str, int] = {}
        for exposure in without:
            counts[exposure.reason] = counts.get(exposure.reason, 0) + 1
        reasons = ", ".join(f"{n} {reason}" for reason, n in counts.items())
        warnings.append(f"{len(without)} of {len(exposures)} exposures have no pose: {reasons}")
    broken = [e for e in exposures if e.fate is ScanExposureFate.UNREADABLE]
    if broken:
        named = "; ".join(exposure.reason.rstrip(".") for exposure in broken[:LISTED])
        warnings.append(f"{len(broken)} of {len(exposures)} images cannot be read: {named}")
    alone = [e.row.source for e in exposures if e.fate is ScanExposureFate.NO_PARTNER]
    if alone:
        warnings.append(
            f"{len(alone)} of {len(exposures)} images were not used, {PARTNER_MISSING}: "
            f"{', '.join(alone[:LISTED])}"
        )
    hung = [e for e in exposures if e.fate is ScanExposureFate.EQUAL_POSE]
    if hung:
        warnings.append(
            f"{len(hung)} of {len(exposures)} exposures were left out: {hung[0].reason}: the arm's "
            "pose hung or was repeated, or the object moved"
        )
    n_outside = sum(exposure.n_outside_volume for exposure in exposures)
    if n_outside:
        warnings.append(f"{n_outside} measured points lie outside the volume asked for")
    if not any(exposure.row.lasers for exposure in exposures):
        warnings.append("no exposure names its lasers: the laser was taken to be on in all")
    return tuple(warnings)


def scan_exposure(row: ExposureRow, image: ReconstructedImage, n_outside: int) -> ScanExposure:
    """The record of an exposure that was placed."""
    n_measured = image.count(PointFate.MEASURED)
    return ScanExposure(row, ScanExposureFate.PLACED, "", len(image.profile), n_measured, n_outside)
