# SPDX-License-Identifier: Apache-2.0
"""Points of one instant of a head with two cameras and many sheets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.epipolar_offset import EpipolarOffset, drift_directions
from armscan.reconstruction.fuse import FusedPoints, fuse_points, misfit_mm
from armscan.reconstruction.identify_stereo import name_stripes, residual_and_sigma
from armscan.reconstruction.named_profile import NamedProfile, NameFate
from armscan.reconstruction.right_sheet import triangulate_right
from armscan.reconstruction.stereo_fate import StereoFate
from armscan.reconstruction.stereo_options import StereoNamingOptions
from armscan.reconstruction.stereo_residuals import (
    Crossings,
    Projections,
    RightStripes,
    find_crossings,
    project_on_sheets,
)
from armscan.reconstruction.triangulate import StripePoints
from armscan.records.profile import Profile

N_NOISES = 3
BESIDE_ROWS = 3
"""Where the right picture is larger, not every right point has a left one: this many between."""


@dataclass(frozen=True, slots=True)
class StereoCounts:
    """How many stripe points went which way.

    Parameters
    ----------
    n_fused
        Left points that the right camera sees too.
    n_left_alone, n_right_alone
        Points that only one camera sees.
    n_inconsistent
        Left points whose right picture contradicts their sheet: dropped.
    n_out_of_depth
        Points alone in one camera that lie outside the depths accepted: dropped.
    n_ambiguous, n_unexplained, n_flagged
        Points of both cameras by their `NameFate`: dropped.
    """

    n_fused: int
    n_left_alone: int
    n_right_alone: int
    n_inconsistent: int
    n_out_of_depth: int
    n_ambiguous: int
    n_unexplained: int
    n_flagged: int


@dataclass(frozen=True, slots=True, eq=False)
class StereoMeasurement:
    """Named stripes of both cameras and their points.

    Parameters
    ----------
    left, right
        Stripes with the sheets that the naming found.
    left_points
        Rows of the left profile; fused with the right camera where it sees the same point. The
        noises are those of the left stripe, the right stripe and the sheet's shape; zero where a
        camera has no part in the point.
    right_points
        Rows of the right profile: points that the left camera does not see.
    is_fused
        (M,) for ``left_points``: True where both cameras saw the point.
    left_fate, right_fate
        (N,) `StereoFate` of every stripe point.
    epipolar_offset_px, epipolar_sigma_px
        Mean distance of the right picture from the epipolar lines, and its standard deviation.
    offset
        The offset in full.
    counts
        What was kept and what was dropped.
    warnings
        What is weak, in words.
    """

    left: NamedProfile
    right: NamedProfile
    left_points: StripePoints
    right_points: StripePoints
    is_fused: BoolArray
    left_fate: IntArray
    right_fate: IntArray
    epipolar_offset_px: float
    epipolar_sigma_px: float
    offset: EpipolarOffset
    counts: StereoCounts
    warnings: tuple[str, ...] = ()


def measure_stereo(
    left: Profile,
    right: Profile,
    sensor: SensorCalibration,
    options: StereoNamingOptions | None = None,
) -> StereoMeasurement:
    """Name the stripes of two cameras and turn them into points.

    Parameters
    ----------
    left, right
        Stripe points of one instant.
    sensor
        Both cameras and all sheets.
    options
        Limits of the naming; defaults when None.

    Raises
    ------
    InputError
        If the sensor has one camera.
    """
    options = options or StereoNamingOptions()
    names = name_stripes(left, right, sensor, options)
    row = np.flatnonzero(names.left.sheet >= 0)
    left_fate = _before(names.left)
    projected = project_on_sheets(left.points_px[row], names.left.sheet[row], sensor)
    row, projected = row[projected.is_met], projected.select(projected.is_met)
    stripes = RightStripes.of(right)
    crossings = find_crossings(
        projected, left.normals_px[row], left.sigma_px[row], stripes, options.reach_px
    )
    other = np.where(crossings.is_found, names.right.sheet[crossings.row], -1)
    is_pair = crossings.is_found & ((other == projected.sheet) | (other == -1))
    residual, sigma = residual_and_sigma(projected, crossings, sensor, names.offset, options)
    agrees = np.abs(residual) <= options.consistency_sigmas * sigma
    fused = np.flatnonzero(is_pair & agrees)
    alone = np.flatnonzero(~is_pair)
    inside = _inside(projected.select(alone), sensor, options)
    both = _fused(
        projected, crossings, fused, row, (left, right), sensor=sensor, offset=names.offset
    )
    single = _left_alone(projected, alone[inside], row, left, sensor)
    left_points, is_fused = _in_order(both, single)
    left_fate[row[is_pair]] = np.where(
        agrees[is_pair], int(StereoFate.FUSED), int(StereoFate.INCONSISTENT)
    )
    left_fate[row[alone]] = np.where(inside, int(StereoFate.ALONE), int(StereoFate.OUT_OF_DEPTH))
    taken = _taken(crossings.row[is_pair], right)
    right_row = np.flatnonzero((names.right.sheet >= 0) & ~taken)
    right_points = triangulate_right(right, right_row, names.right.sheet, sensor)
    kept = _in_depth(right_points, sensor, options)
    right_fate = _before(names.right)
    named = names.right.sheet >= 0
    right_fate[named & taken] = int(StereoFate.INCONSISTENT)
    right_fate[named & _taken(crossings.row[fused], right)] = int(StereoFate.TAKEN)
    right_fate[right_points.row] = np.where(
        kept, int(StereoFate.ALONE), int(StereoFate.OUT_OF_DEPTH)
    )
    counts = StereoCounts(
        len(fused),
        int(inside.sum()),
        int(kept.sum()),
        int((is_pair & ~agrees).sum()),
        int((~inside).sum() + (~kept).sum()),
        *(
            names.left.count(fate) + names.right.count(fate)
            for fate in (NameFate.AMBIGUOUS, NameFate.UNEXPLAINED, NameFate.NOT_ASKED)
        ),
    )
    return StereoMeasurement(
        names.left,
        names.right,
        left_points,
        _chosen(right_points, kept),
        is_fused,
        left_fate,
        right_fate,
        names.offset.offset_px,
        names.offset.sigma_px,
        names.offset,
        counts,
        _warnings(names.offset),
    )


def _before(named: NamedProfile) -> IntArray:
    """(N,) `StereoFate` of points before their rays are met with the sheets."""
    return np.where(named.sheet >= 0, int(StereoFate.NO_RAY), int(StereoFate.UNNAMED))


def _inside(
    projected: Projections, sensor: SensorCalibration, options: StereoNamingOptions
) -> BoolArray:
    return _within(projected.points_mm, projected.sheet, sensor, options)


def _within(
    points_mm: FloatArray, sheet: IntArray, sensor: SensorCalibration, options: StereoNamingOptions
) -> BoolArray:
    limits = np.array([options.depths.limits_mm(s) for s in sensor.sheets])
    depth = points_mm[:, 2]
    return np.asarray((depth >= limits[sheet, 0]) & (depth <= limits[sheet, 1]))


def _in_depth(
    stripe: StripePoints, sensor: SensorCalibration, options: StereoNamingOptions
) -> BoolArray:
    return _within(stripe.points_mm, stripe.sheet, sensor, options)


def _chosen(stripe: StripePoints, kept: BoolArray | IntArray) -> StripePoints:
    return StripePoints(
        stripe.row[kept],
        stripe.points_mm[kept],
        stripe.noise_mm[kept],
        stripe.by_sensor[kept],
        stripe.sheet[kept],
    )


def _fused(
    projected: Projections,
    crossings: Crossings,
    fused: IntArray,
    row: IntArray,
    profiles: tuple[Profile, Profile],
    *,
    sensor: SensorCalibration,
    offset: EpipolarOffset,
) -> StripePoints:
    """Points that both cameras see."""
    left, right = profiles
    there, beside = projected.select(fused), crossings.select(fused)
    shift = np.zeros(len(fused))
    if offset.is_beyond_calibration:
        moved = drift_directions(there, sensor) @ offset.drift
        shift = -np.sum(beside.normal * moved, axis=1)
    found: FusedPoints = fuse_points(
        there,
        beside,
        left.normals_px[row[fused]],
        left.sigma_px[row[fused]],
        right.sigma_px[beside.row],
        sensor=sensor,
        shift_px=shift,
    )
    return StripePoints(row[fused], found.points_mm, found.noise_mm, found.by_sensor, there.sheet)


def _left_alone(
    projected: Projections,
    chosen: IntArray,
    row: IntArray,
    left: Profile,
    sensor: SensorCalibration,
) -> StripePoints:
    """Points on their sheet by the left camera alone (eq. 4.11)."""
    there, at = projected.select(chosen), row[chosen]
    noise = np.zeros((len(at), 3, N_NOISES))
    across = np.einsum("nij,nj->ni", there.point_by_px, left.normals_px[at])
    noise[:, :, 0] = across * left.sigma_px[at, None]
    noise[:, :, 2] = _by_misfit(there, sensor)
    second = np.zeros((len(at), 3, there.q_by_second.shape[2]))
    by_sensor = np.concatenate([there.point_by_sensor, second], axis=2)
    return StripePoints(at, there.points_mm, noise, by_sensor, there.sheet)


def _by_misfit(projected: Projections, sensor: SensorCalibration) -> FloatArray:
    """(M, 3) move along the ray for one standard deviation of the sheet's own shape."""
    move = np.zeros((len(projected.sheet), 3))
    for k in np.unique(projected.sheet):
        own = projected.sheet == k
        points = projected.points_mm[own]
        _, gradient, _ = sensor.sheets[k].sheet.height_with_jacobian(points)
        along = np.sum(gradient * points, axis=1)
        move[own] = points / along[:, None] * misfit_mm(sensor, int(k))
    return move


def _in_order(both: StripePoints, single: StripePoints) -> tuple[StripePoints, BoolArray]:
    """Both kinds in the order of the profile."""
    row = np.concatenate([both.row, single.row])
    order = np.argsort(row, kind="stable")
    merged = StripePoints(
        row[order],
        np.concatenate([both.points_mm, single.points_mm])[order],
        np.concatenate([both.noise_mm, single.noise_mm])[order],
        np.concatenate([both.by_sensor, single.by_sensor])[order],
        np.concatenate([both.sheet, single.sheet])[order],
    )
    return merged, np.asarray(order < len(both.row))


def _taken(rows: IntArray, right: Profile) -> BoolArray:
    """(N,) right points that a left point fell beside, with those between them."""
    taken = np.zeros(len(right), dtype=np.bool_)
    for step in range(-BESIDE_ROWS, BESIDE_ROWS + 1):
        near = np.clip(rows + step, 0, len(right) - 1)
        taken[near[right.segment[near] == right.segment[rows]]] = True
    return taken


def _warnings(offset: EpipolarOffset) -> tuple[str, ...]:
    if not offset.is_beyond_calibration:
        return ()
    return (
        f"the right camera's picture lies {offset.offset_px:+.2f} px off the epipolar lines, more "
        f"than the calibration's standard deviation of {offset.allowed_px:.2f} px explains: "
        "calibrate the two cameras again",
    )
