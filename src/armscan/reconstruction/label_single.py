# SPDX-License-Identifier: Apache-2.0
"""Which sheet drew a stripe where one image tells: the laser that was on, or the depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.calibration import SensorCalibration, SheetCalibration
from armscan.models.light_sheet import LightSheet
from armscan.reconstruction.triangulate import intersect_sheets
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
    points, is_met = intersect_sheets(profile.points_px, np.full(len(profile), k), sensor)
    low, high = depths.limits_mm(sensor.sheets[k])
    return np.asarray(is_met & (points[:, 2] >= low) & (points[:, 2] <= high))


def _reach(sheet: SheetCalibration, depths: DepthRange) -> str:
    (low, high), (least, most) = sheet.depth_range_mm, depths.limits_mm(sheet)
    calibrated = f"{sheet.name} (calibrated Z {low:.0f} to {high:.0f} mm"
    return f"{calibrated}, accepted {least:.0f} to {most:.0f} mm)"


def _shares(share: dict[int, float], sensor: SensorCalibration) -> str:
    return ", ".join(f"{sensor.sheets[k].name} {value:.0%}" for k, value in share.items())


LARGEST_SLANT = 0.6
"""Tangent of the angle at which a ray may run to the sheet's depth axis: line lenses spread light
by up to 60 degrees. Where the sheet knows its rays, they are followed and half of it is enough."""
NEEDED = 0.5
"""A segment is left without rays if fewer than this part of its own width is free around it."""
STEP_SPACINGS = 3.0
"""Rays are told apart by so many of the spacings between neighbouring points."""


def is_without_ray(
    points_mm: FloatArray,
    intensity: FloatArray,
    segment: IntArray,
    sheet: LightSheet,
) -> BoolArray:
    """(N,) True for the points of segments for which brighter ones left no ray of the laser.

    Parameters
    ----------
    points_mm
        (N, 3) on the sheet, Sensor frame.
    intensity
        (N,) peak grey level above the background.
    segment
        (N,) number of each point's connected segment.
    sheet
        The light sheet.
    """
    lost = np.zeros(len(points_mm), dtype=np.bool_)
    if len(np.unique(segment)) < 2:
        return lost
    ray, depth = _rays(points_mm, sheet)
    slant = LARGEST_SLANT * (0.5 if np.any(sheet.fan != 0.0) else 1.0)
    step = STEP_SPACINGS * _spacing(ray, segment)
    low = ray.min()
    bins = np.floor((ray - low) / step).astype(np.int64)
    first_depth = np.full(int(bins.max()) + 1, np.nan)
    inverse = np.unique(segment, return_inverse=True)[1]
    strength = np.bincount(inverse, np.maximum(intensity, 0.0))
    for k in np.argsort(-strength):
        own = np.flatnonzero(inverse == k)
        spent = np.isfinite(first_depth)
        apart = 0.0
        if spent.any():
            nearest = np.interp(bins[own], np.flatnonzero(spent), first_depth[spent])
            apart = float(np.abs(depth[own] - nearest).max())
        reach = int(np.ceil(slant * apart / step))
        start, stop = int(bins[own].min()) - reach, int(bins[own].max()) + reach + 1
        within = np.arange(max(start, 0), min(stop, len(spent)))
        n_free = stop - start - int(spent[within].sum())
        if n_free < NEEDED * (int(bins[own].max()) - int(bins[own].min()) + 1):
            lost[own] = True
            continue
        covered = np.arange(bins[own].min(), bins[own].max() + 1)
        order = np.argsort(bins[own])
        first_depth[covered] = np.interp(covered, bins[own][order], depth[own][order])
    return lost


def _rays(points_mm: FloatArray, sheet: LightSheet) -> tuple[FloatArray, FloatArray]:
    """Where the laser's ray of each point crosses the sheet's middle, and its depth, in mm."""
    local = (points_mm - sheet.origin_mm) @ sheet.axes[:2].T / sheet.scale_mm
    u, v = local[:, 0], local[:, 1]
    lean, spread = sheet.fan
    u0 = (u - lean * v) / np.maximum(1.0 + spread * v, 0.2)
    return np.asarray(u0 * sheet.scale_mm), np.asarray(v * sheet.scale_mm)


def _spacing(ray: FloatArray, segment: IntArray) -> float:
    steps = np.abs(np.diff(ray))[np.diff(segment) == 0]
    return max(float(np.median(steps)) if len(steps) else 0.0, 1e-6)
