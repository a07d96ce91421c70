# SPDX-License-Identifier: Apache-2.0
"""What became of each stripe point, the sheet it was given to, and the rule for one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, IntArray, given_away, ints
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.epipolar import EpipolarOffset
from armscan.reconstruction.triangulate import (
    CALIBRATED_DEPTHS,
    LABEL_DEPTHS,
    DepthRange,
    intersect_sheets,
)
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
    PointStatus.STRAY: "given to no sheet: stray light, or a line that nothing names",
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

    @property
    def counts(self) -> StripeCounts:
        """What tables tell of it."""
        flags = self.profile.flags
        return StripeCounts(
            source=self.profile.source,
            by_status=tuple(np.bincount(self.status, minlength=len(PointStatus)).tolist()),
            flags=int(np.bitwise_or.reduce(flags, initial=0)),
            rejecting_flags=int(
                np.bitwise_or.reduce(flags[self.status == PointStatus.FLAGGED], initial=0)
            ),
        )


@dataclass(frozen=True, slots=True)
class StripeCounts:
    """How many stripe points of one exposure became what, of a scan that does not keep them.

    Parameters
    ----------
    source
        The exposure's source name.
    by_status
        Count of points of each `PointStatus`, by its value.
    flags, rejecting_flags
        All `armscan.records.profile.StripeFlag` of its points, and those of flagged points.
    """

    source: str
    by_status: tuple[int, ...]
    flags: int
    rejecting_flags: int

    def __len__(self) -> int:
        """Count of stripe points."""
        return sum(self.by_status)

    def count(self, status: PointStatus) -> int:
        """Count of points of this status."""
        return self.by_status[status]


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

    def left_out(self, lasers: tuple[str, ...]) -> str:
        """Why no stripe is given to a sheet where these sources were on; empty if they may be."""

    def reset(self) -> None:
        """Forget the past: the next exposure begins a new pass."""


def sheets_of(sensor: SensorCalibration, lasers: Sequence[str]) -> tuple[int, ...]:
    """Sheets that these sources draw: those of their name, or of it up to the dot."""
    names = [sheet.name for sheet in sensor.sheets]
    return tuple(k for k, one in enumerate(names) if {one, one.partition(".")[0]} & {*lasers})


def without_sheet(sensor: SensorCalibration, lasers: Sequence[str]) -> tuple[str, ...]:
    """Those of these sources of which the calibration has no sheet."""
    return tuple(laser for laser in lasers if not sheets_of(sensor, (laser,)))


def given_to_none(profile: Profile, reason: str) -> LabelledInstant:
    """No stripe of the exposure has a sheet."""
    n = len(profile)
    return _labelled(profile, np.full(n, -1), np.full(n, PointStatus.STRAY), reason)


MIN_INSIDE = 0.9
"""A sheet is taken for a segment if this part of its points lies within the depths accepted."""
MAX_INSIDE_OTHERS = 0.1
"""It is the only one possible if no other sheet has more than this within its reach."""


@dataclass(frozen=True, slots=True, eq=False)
class SingleLabeller:
    """Labels each exposure of one camera by itself; a `StripeLabeller`.

    In this order: the user's word, but not against lasers that the exposure names; the only sheet
    there is; the only one of the lasers that were on; and else, segment by segment, the one sheet
    that puts the segment into the depths accepted, if no other sheet reaches it. A surface may lie
    outside the depths in which its own line was calibrated and inside those of another line: what
    others reach only beyond their depths is dropped, too.

    Parameters
    ----------
    sensor
        Camera and sheets.
    depths
        Depths that are accepted.
    sheet_name
        The user's choice; empty for none.
    reach
        Depths in which another sheet may have drawn a stripe.
    """

    sensor: SensorCalibration
    depths: DepthRange = CALIBRATED_DEPTHS
    sheet_name: str = ""
    reach: DepthRange = LABEL_DEPTHS

    def __post_init__(self) -> None:
        names = [sheet.name for sheet in self.sensor.sheets]
        if self.sheet_name and self.sheet_name not in names:
            raise OptionError(
                f"there is no sheet {self.sheet_name!r}",
                where="--sheet",
                remedy=f"give one of {', '.join(names)}",
            )

    def label(
        self,
        profiles: Sequence[Profile],
        lasers: tuple[str, ...] = (),
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> LabelledInstant:
        """See `StripeLabeller`; pose and time do not matter.

        Raises
        ------
        EstimationError
            If the depth leaves more than one sheet possible for all that could be labelled.
        """
        (profile,) = profiles
        names = [sheet.name for sheet in self.sensor.sheets]
        if why := self.left_out(lasers):
            return given_to_none(profile, why)
        known = sheets_of(self.sensor, lasers)
        if self.sheet_name:
            k, why = names.index(self.sheet_name), "as asked for"
        elif len(names) == 1:
            k, why = 0, "the only one calibrated"
        elif len(known) == 1:
            k, why = known[0], "the laser that was on"
        else:
            return self._by_depth(profile, known or tuple(range(len(names))))
        sheet, status = np.full(len(profile), k), np.full(len(profile), PointStatus.MEASURED)
        return _labelled(profile, sheet, status, f"sheet {names[k]}, {why}")

    def next_lasers(self) -> tuple[str, ...]:
        """Those of the recording."""
        return ()

    def left_out(self, lasers: tuple[str, ...]) -> str:
        """What contradicts the user's word, or may be taken for a calibrated sheet's stripe."""
        known, unknown = sheets_of(self.sensor, lasers), without_sheet(self.sensor, lasers)
        if known and unknown:
            return f"of {' and '.join(unknown)}, which was on, too, the calibration has no sheet"
        asked = [k for k in known if self.sensor.sheets[k].name == self.sheet_name]
        if known and self.sheet_name and (len(lasers) > 1 or not asked):
            return f"{' and '.join(lasers)} was on, not {self.sheet_name} alone (--sheet)"
        return ""

    def reset(self) -> None:
        """Nothing is remembered."""

    def _by_depth(self, profile: Profile, possible: Sequence[int]) -> LabelledInstant:
        sheet = np.full(len(profile), -1)
        status = np.full(len(profile), PointStatus.OUT_OF_DEPTH)
        inside = {k: self._is_inside(profile, self.depths, k) for k in possible}
        reached = {k: self._is_inside(profile, self.reach, k) for k in possible}
        ambiguous: list[str] = []
        for segment in np.unique(profile.segment[profile.is_accepted]):
            in_segment = profile.segment == segment
            used = in_segment & profile.is_accepted
            share = {k: float(inside[k][used].mean()) for k in possible}
            best = max(possible, key=lambda k: share[k])
            if share[best] < MIN_INSIDE:
                continue
            others = {k: float(reached[k][used].mean()) for k in possible if k != best}
            if max(others.values(), default=0.0) > MAX_INSIDE_OTHERS:
                status[in_segment] = PointStatus.AMBIGUOUS
                ambiguous.append(self._shares({best: share[best], **others}))
                continue
            sheet[in_segment], status[in_segment] = best, PointStatus.MEASURED
        found = np.unique(sheet[sheet >= 0]).tolist()
        if ambiguous and not found:
            remedy = "name the sheet with --sheet, or photograph one laser at a time"
            if self.reach.margin > 0.0:
                remedy += (
                    "; if no surface lies outside the depths in which its line was calibrated, say "
                    "so by --depth-margin 0"
                )
            raise EstimationError(
                f"{len(ambiguous)} stripe segments may belong to more than one light sheet "
                f"({ambiguous[0]}), and none belongs to one alone",
                where=profile.source,
                remedy=remedy,
            )
        reason = "no sheet puts a stripe into the depths accepted"
        if found:
            reached_by = ", ".join(self._reach(k) for k in found)
            reason = f"the only sheet that reaches the stripe: {reached_by}"
        if ambiguous:
            reason += "; what others reach, too, is left out: --sheet names one"
        return _labelled(profile, sheet, status, reason)

    def _shares(self, inside: dict[int, float]) -> str:
        shares = (f"{self.sensor.sheets[k].name} {share:.0%}" for k, share in inside.items())
        return f"points within reach of their depths: {', '.join(shares)}"

    def _is_inside(self, profile: Profile, depths: DepthRange, k: int) -> BoolArray:
        sheet = np.full(len(profile), k)
        points, is_met = intersect_sheets(profile.points_px, sheet, self.sensor)
        return np.asarray(is_met & depths.holds(points, sheet, self.sensor))

    def _reach(self, k: int) -> str:
        sheet = self.sensor.sheets[k]
        (low, high), (least, most) = sheet.depth_range_mm, self.depths.limits_mm(sheet)
        calibrated = f"{sheet.name} (calibrated Z {low:.0f} to {high:.0f} mm"
        return f"{calibrated}, accepted {least:.0f} to {most:.0f} mm)"


def _labelled(profile: Profile, sheet: IntArray, status: IntArray, reason: str) -> LabelledInstant:
    status[~profile.is_accepted] = PointStatus.FLAGGED
    return LabelledInstant(
        (
            LabelledProfile(
                profile=profile, sheet=given_away(sheet), status=given_away(status), reason=reason
            ),
        )
    )
