# SPDX-License-Identifier: Apache-2.0
"""Which sheet drew a stripe on an object, where no board tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import BoolArray, IntArray
from armscan.models.calibration import SensorCalibration, SheetCalibration
from armscan.reconstruction.triangulate import meet_sheets
from armscan.records.profile import Profile

MIN_INSIDE = 0.9
"""A sheet is possible for a segment if this part of its points lies within its reach."""
MAX_INSIDE_OTHERS = 0.1
"""It is the only one possible if no other sheet has more than this."""
CALIBRATED = "within its calibrated depths"
WIDENED = "within reach of its calibrated depths"


@dataclass(frozen=True, slots=True)
class DepthRange:
    """Depths that a reconstruction accepts: the calibrated range of the sheet, or more.

    Parameters
    ----------
    margin
        Part of the calibrated range's width by which it is widened at either end. Between the
        calibrated range and this limit points are extrapolated: their covariance grows, and a
        warning counts them.
    """

    margin: float = 0.0

    def __post_init__(self) -> None:
        if not self.margin >= 0.0:
            raise OptionError(
                f"depth margin {self.margin}", remedy="give 0 or more, as a part of the range"
            )

    def limits_mm(self, sheet: SheetCalibration) -> tuple[float, float]:
        """Smallest and largest Z accepted."""
        low, high = sheet.depth_range_mm
        slack = self.margin * (high - low)
        return low - slack, high + slack


@dataclass(frozen=True, slots=True, eq=False)
class SheetChoice:
    """(N,) sheet of each point, -1 for none, and how it was found, in words."""

    sheet: IntArray
    how: str


def choose_sheets(
    profile: Profile,
    sensor: SensorCalibration,
    depths: DepthRange,
    *,
    sheet_name: str = "",
    lasers: tuple[str, ...] = (),
) -> SheetChoice:
    """Give every stripe point to a sheet.

    In this order: the user's word; the only sheet there is; the exposure's only laser; and else,
    segment by segment, the one sheet that puts the segment into its calibrated depth range, if no
    other sheet does so for its own. Only where no sheet does, the ranges are widened
    (`DepthRange.limits_mm`) and the same is asked again.

    Parameters
    ----------
    profile
        Stripe points.
    sensor
        Camera and sheets.
    depths
        Depths that count as inside.
    sheet_name
        The user's choice; empty for none.
    lasers
        The lasers that were on, as the exposure names them; empty if unknown.

    Raises
    ------
    OptionError
        If there is no sheet of the name given.
    EstimationError
        If the depth leaves more than one sheet possible.
    """
    names = [sheet.name for sheet in sensor.sheets]
    whole = np.zeros(len(profile), dtype=np.int64)
    if sheet_name:
        if sheet_name not in names:
            raise OptionError(
                f"there is no sheet {sheet_name!r}",
                where="--sheet",
                remedy=f"give one of {', '.join(names)}",
            )
        return SheetChoice(whole + names.index(sheet_name), f"sheet {sheet_name}, as asked for")
    if len(names) == 1:
        return SheetChoice(whole, f"sheet {names[0]}, the only one calibrated")
    known = [names.index(name) for name in lasers if name in names]
    if len(lasers) == 1 and known:
        return SheetChoice(whole + known[0], f"sheet {lasers[0]}, the laser that was on")
    return _by_depth(profile, sensor, depths, known or list(range(len(names))))


def _by_depth(
    profile: Profile, sensor: SensorCalibration, depths: DepthRange, possible: list[int]
) -> SheetChoice:
    chosen = np.full(len(profile), -1)
    ambiguous: list[str] = []
    reaches = []
    for how, accepted in ((CALIBRATED, DepthRange(0.0)), (WIDENED, depths)):
        inside = {k: _inside(profile, sensor, accepted, k) for k in possible}
        found: set[int] = set()
        for segment in np.unique(profile.segment[profile.is_accepted & (chosen == -1)]):
            own = profile.segment == segment
            used = own & profile.is_accepted
            share = {k: float(inside[k][used].mean()) for k in possible}
            best = max(possible, key=lambda k: share[k])
            others = max((share[k] for k in possible if k != best), default=0.0)
            if share[best] < MIN_INSIDE:
                continue
            if others > MAX_INSIDE_OTHERS:
                ambiguous.append(f"{how}: {_shares(share, sensor)}")
                continue
            chosen[own] = best
            found.add(best)
        if ambiguous:
            raise EstimationError(
                f"{len(ambiguous)} stripe segments may belong to more than one light sheet (points "
                f"{ambiguous[0]})",
                where=profile.source,
                remedy="name the sheet with --sheet, or photograph one laser at a time",
            )
        if found:
            names = ", ".join(_reach(sensor.sheets[k], depths) for k in sorted(found))
            reaches.append(f"the only sheet that puts the stripe {how}: {names}")
    return SheetChoice(
        chosen, "; ".join(reaches) or "no sheet puts a stripe within reach of its calibrated depths"
    )


def _inside(profile: Profile, sensor: SensorCalibration, depths: DepthRange, k: int) -> BoolArray:
    points, is_met = meet_sheets(profile.points_px, np.full(len(profile), k), sensor)
    low, high = depths.limits_mm(sensor.sheets[k])
    return np.asarray(is_met & (points[:, 2] >= low) & (points[:, 2] <= high))


def _reach(sheet: SheetCalibration, depths: DepthRange) -> str:
    (low, high), (least, most) = sheet.depth_range_mm, depths.limits_mm(sheet)
    calibrated = f"{sheet.name} (calibrated Z {low:.0f} to {high:.0f} mm"
    return f"{calibrated}, accepted {least:.0f} to {most:.0f} mm)"


def _shares(share: dict[int, float], sensor: SensorCalibration) -> str:
    return ", ".join(f"{sensor.sheets[k].name} {value:.0%}" for k, value in share.items())
