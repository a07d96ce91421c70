# SPDX-License-Identifier: Apache-2.0
"""Which sheet drew a stripe where one image tells: the laser that was on, or the depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import BoolArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.labels import LabelledInstant, LabelledProfile, PointStatus
from armscan.reconstruction.triangulate import CALIBRATED_DEPTHS, DepthRange, intersect_sheets
from armscan.records.profile import Profile

MIN_INSIDE = 0.9
"""A sheet is possible for a segment if this part of its points lies within its reach."""
MAX_INSIDE_OTHERS = 0.1
"""It is the only one possible if no other sheet has more than this."""
CALIBRATED = "within its calibrated depths"
WIDENED = "within reach of its calibrated depths"


@dataclass(frozen=True, slots=True, eq=False)
class SingleLabeller:
    """Labels each exposure of one camera by itself; a `StripeLabeller`.

    In this order: the user's word; the only sheet there is; the exposure's only laser; and else,
    segment by segment, the one sheet that puts the segment into its calibrated depth range, if no
    other sheet does so for its own. Only where no sheet does, the ranges are widened and the same
    is asked again.

    Parameters
    ----------
    sensor
        Camera and sheets.
    depths
        Depths that count as inside.
    sheet_name
        The user's choice; empty for none.
    """

    sensor: SensorCalibration
    depths: DepthRange = CALIBRATED_DEPTHS
    sheet_name: str = ""

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
            If the depth leaves more than one sheet possible.
        """
        (profile,) = profiles
        sheet, reason = self._sheets(profile, lasers)
        status = np.where(sheet < 0, PointStatus.OUT_OF_DEPTH, PointStatus.MEASURED)
        status[~profile.is_accepted] = PointStatus.FLAGGED
        return LabelledInstant(
            (LabelledProfile(profile=profile, sheet=sheet, status=status, reason=reason),)
        )

    def next_lasers(self) -> tuple[str, ...]:
        """Those of the recording."""
        return ()

    def reset(self) -> None:
        """Nothing is remembered."""

    def _sheets(self, profile: Profile, lasers: tuple[str, ...]) -> tuple[IntArray, str]:
        """(N,) sheet of each point, -1 for none, and how it was found, in words."""
        names = [sheet.name for sheet in self.sensor.sheets]
        known = [names.index(name) for name in lasers if name in names]
        if self.sheet_name:
            k, why = names.index(self.sheet_name), "as asked for"
        elif len(names) == 1:
            k, why = 0, "the only one calibrated"
        elif len(lasers) == 1 and known:
            k, why = known[0], "the laser that was on"
        else:
            return self._by_depth(profile, known or list(range(len(names))))
        return np.full(len(profile), k), f"sheet {names[k]}, {why}"

    def _by_depth(self, profile: Profile, possible: list[int]) -> tuple[IntArray, str]:
        chosen = np.full(len(profile), -1)
        ambiguous: list[str] = []
        reaches = []
        for how, accepted in ((CALIBRATED, CALIBRATED_DEPTHS), (WIDENED, self.depths)):
            inside = {k: self._is_inside(profile, accepted, k) for k in possible}
            found: set[int] = set()
            for segment in np.unique(profile.segment[profile.is_accepted & (chosen == -1)]):
                in_segment = profile.segment == segment
                used = in_segment & profile.is_accepted
                share = {k: float(inside[k][used].mean()) for k in possible}
                best = max(possible, key=lambda k: share[k])
                others = max((share[k] for k in possible if k != best), default=0.0)
                if share[best] < MIN_INSIDE:
                    continue
                if others > MAX_INSIDE_OTHERS:
                    shares = (f"{self.sensor.sheets[k].name} {share[k]:.0%}" for k in possible)
                    ambiguous.append(f"{how}: {', '.join(shares)}")
                    continue
                chosen[in_segment] = best
                found.add(best)
            if ambiguous:
                raise EstimationError(
                    f"{len(ambiguous)} stripe segments may belong to more than one light sheet "
                    f"(points {ambiguous[0]})",
                    where=profile.source,
                    remedy="name the sheet with --sheet, or photograph one laser at a time",
                )
            if found:
                names = ", ".join(self._reach(k) for k in sorted(found))
                reaches.append(f"the only sheet that puts the stripe {how}: {names}")
        nowhere = "no sheet puts a stripe within reach of its calibrated depths"
        return chosen, "; ".join(reaches) or nowhere

    def _is_inside(self, profile: Profile, depths: DepthRange, k: int) -> BoolArray:
        sheet = np.full(len(profile), k)
        points, is_met = intersect_sheets(profile.points_px, sheet, self.sensor)
        return np.asarray(is_met & depths.holds(points, sheet, self.sensor))

    def _reach(self, k: int) -> str:
        sheet = self.sensor.sheets[k]
        (low, high), (least, most) = sheet.depth_range_mm, self.depths.limits_mm(sheet)
        calibrated = f"{sheet.name} (calibrated Z {low:.0f} to {high:.0f} mm"
        return f"{calibrated}, accepted {least:.0f} to {most:.0f} mm)"
