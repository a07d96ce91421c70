# SPDX-License-Identifier: Apache-2.0
"""Points of a head with two cameras: fused from both, or of the right camera alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.rotations import skew
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.epipolar import (
    Crossings,
    EpipolarOffset,
    Projections,
    RightStripes,
    drift_directions,
    find_crossings,
    project_on_sheets,
)
from armscan.reconstruction.label_stereo import StereoLabelOptions, name_stripes, residual_and_sigma
from armscan.reconstruction.labels import LabelledProfile, LabelStatus, StereoStatus
from armscan.reconstruction.triangulate import (
    N_CAMERA,
    N_SHEET,
    StripePoints,
    sensor_columns,
    sensor_covariance,
)
from armscan.records.profile import Profile

MISFIT_SHARE = 0.3
"""Part of a sheet's residual from its calibration that is its own shape, not the stripes' noise."""
N_OBSERVED = 3


@dataclass(frozen=True, slots=True, eq=False)
class FusedPoints:
    """Points with the derivatives that their covariance needs.

    Parameters
    ----------
    points_mm
        (M, 3) in the Sensor frame.
    noise_mm
        (M, 3, 3) one standard deviation each of the left stripe's noise, the right stripe's, and
        the sheet's own shape.
    by_sensor
        (M, 3, 32) derivative by the left camera's 9, the sheet's 8 and the second camera's 15.
    """

    points_mm: FloatArray
    noise_mm: FloatArray
    by_sensor: FloatArray


def misfit_mm(sensor: SensorCalibration, sheet: int) -> float:
    """Standard deviation of a sheet's true surface about its model."""
    return MISFIT_SHARE * sensor.sheets[sheet].rms_mm


def fuse_points(
    projected: Projections,
    crossings: Crossings,
    normals_px: FloatArray,
    sigma_px: FloatArray,
    right_sigma_px: FloatArray,
    *,
    sensor: SensorCalibration,
    shift_px: FloatArray,
) -> FusedPoints:
    """Weigh left stripe, right stripe and sheet against each other (eqs. 4.7, 4.11, 4.17).

    A point has three unknowns. Its place along the left stripe is a choice of where to sample, so
    it keeps its left pixel along the stripe. Three distances remain for the other two: across the
    left stripe, across the right stripe, and from the sheet. They are weighed by the inverse of
    their joint covariance: noise of both stripes, the sheet's own shape, and the calibration,
    which all three share. With the sheet alone (weight of the right stripe zero) this is eq. 4.11;
    with the sheet's weight zero it is the direct triangulation of eq. 4.7.

    Parameters
    ----------
    projected
        (M,) left points on their sheets.
    crossings
        (M,) the right stripes beside them; all found.
    normals_px, sigma_px
        (M, 2) and (M,) of the left stripe.
    right_sigma_px
        (M,) of the right stripe's point.
    sensor
        Both cameras and all sheets, with their joint covariance.
    shift_px
        (M,) known part of the residuals, to be taken off: of a camera that has moved.
    """
    n = len(projected.sheet)
    by_point, by_sensor = _observations(projected, crossings, normals_px, sensor)
    misfit = np.array([misfit_mm(sensor, k) for k in range(len(sensor.sheets))])
    noise = np.stack([sigma_px, right_sigma_px, np.maximum(misfit[projected.sheet], 1e-6)], axis=1)
    covariance = np.zeros((n, N_OBSERVED, N_OBSERVED))
    for k in np.unique(projected.sheet):
        own = np.flatnonzero(projected.sheet == k)
        j = by_sensor[own, 1:]
        covariance[own] = (j @ sensor_covariance(sensor, int(k))) @ j.transpose(0, 2, 1)
    covariance[:, np.arange(N_OBSERVED), np.arange(N_OBSERVED)] += noise**2
    gain = _gain(by_point, covariance)
    missed = np.zeros((n, 1 + N_OBSERVED))
    missed[:, 2] = crossings.residual_px - shift_px
    points = projected.points_mm - np.einsum("nij,nj->ni", gain, missed)
    return FusedPoints(points, gain[:, :, 1:] * noise[:, None, :], -gain @ by_sensor)


def _observations(
    projected: Projections,
    crossings: Crossings,
    normals_px: FloatArray,
    sensor: SensorCalibration,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of four distances by the point (M, 4, 3) and by the sensor (M, 4, 32).

    The first is along the left stripe, then across the left stripe, across the right stripe, and
    from the sheet.
    """
    points = projected.points_mm
    n = len(points)
    by_point = np.zeros((n, 4, 3))
    by_sensor = np.zeros((n, 4, N_CAMERA + N_SHEET + projected.q_by_second.shape[2]))
    _, q_by_point, q_by_camera = sensor.camera.camera.project_with_jacobian(points)
    tangents = np.stack([-normals_px[:, 1], normals_px[:, 0]], axis=1)
    axes = np.stack([tangents, normals_px], axis=1)
    by_point[:, :2], by_sensor[:, :2, :N_CAMERA] = axes @ q_by_point, axes @ q_by_camera
    across = crossings.normal[:, None, :]
    by_point[:, 2] = (across @ projected.q_by_point)[:, 0]
    by_sensor[:, 2, N_CAMERA + N_SHEET :] = (across @ projected.q_by_second)[:, 0]
    for k in np.unique(projected.sheet):
        own = np.flatnonzero(projected.sheet == k)
        _, gradient, by_sheet = sensor.sheets[k].sheet.height_with_jacobian(points[own])
        by_point[own, 3] = gradient
        by_sensor[own, 3, N_CAMERA : N_CAMERA + N_SHEET] = by_sheet
    return by_point, by_sensor


def _gain(by_point: FloatArray, covariance: FloatArray) -> FloatArray:
    """(M, 3, 4) least-squares change of the point by each of the four distances.

    The first distance is kept at zero exactly; the others are weighed.
    """
    along, rest = by_point[:, 0], by_point[:, 1:]
    first = along / np.sum(along**2, axis=1, keepdims=True)
    second = np.cross(along, by_point[:, 1])
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    third = np.cross(along, second)
    third /= np.linalg.norm(third, axis=1, keepdims=True)
    free = np.stack([second, third], axis=2)
    design = rest @ free
    weighed = np.linalg.solve(covariance, design).transpose(0, 2, 1)
    solve = free @ np.linalg.solve(weighed @ design, weighed)
    # moving along the stripe changes the other distances too, which the solution takes back
    place = first - np.einsum("nij,njk,nk->ni", solve, rest, first)
    return np.concatenate([place[:, :, None], solve], axis=2)


def triangulate_right(
    profile: Profile, row: IntArray, sheet: IntArray, sensor: SensorCalibration
) -> StripePoints:
    """Intersect the right camera's rays with their sheets.

    Parameters
    ----------
    profile
        Stripe points of the right camera.
    row
        (M,) those to intersect; points whose ray does not meet the sheet are left out.
    sheet
        (N,) index into the sensor's sheets of every point of the profile.
    sensor
        Both cameras and all sheets.

    Returns
    -------
    StripePoints
        In the Sensor frame. The noises are those of a left stripe (zero), of the right stripe, and
        of the sheet's own shape.

    Raises
    ------
    InputError
        If the sensor has one camera.
    """
    second = sensor.second
    if second is None:
        raise InputError("the sensor has one camera")
    pose = second.right_from_sensor
    turn = pose.rotation.T
    xy, has_ray, xy_by_px, xy_by_camera = second.camera.camera.undistort_with_jacobian(
        profile.points_px[row]
    )
    n = len(row)
    points, noise = np.zeros((n, 3)), np.zeros((n, 3, 3))
    by_sensor = np.zeros((n, 3, len(sensor_columns(sensor, 0))))
    is_met = np.zeros(n, dtype=np.bool_)
    own_second = N_CAMERA + N_SHEET
    for k, calibrated in enumerate(sensor.sheets):
        own = np.flatnonzero(has_ray & (sheet[row] == k))
        if not len(own):
            continue
        there = calibrated.sheet
        seen = there.in_frame(pose.rotation, pose.translation_mm)
        found, met, by_xy, by_sheet = seen.intersect_with_jacobian(xy[own])
        own, found, by_xy, by_sheet = own[met], found[met], by_xy[met], by_sheet[met]
        is_met[own] = True
        from_centre = found - pose.translation_mm
        points[own] = from_centre @ turn.T
        _, gradient, _ = there.height_with_jacobian(points[own])
        ray = found @ turn.T
        along = np.sum(gradient * ray, axis=1)
        across = np.einsum("nij,njk,nk->ni", by_xy, xy_by_px[own], profile.normals_px[row[own]])
        noise[own, :, 1] = (across @ turn.T) * profile.sigma_px[row[own], None]
        noise[own, :, 2] = ray / along[:, None] * misfit_mm(sensor, k)
        by_sensor[own, :, N_CAMERA:own_second] = turn @ by_sheet
        by_sensor[own, :, own_second : own_second + N_CAMERA] = turn @ (by_xy @ xy_by_camera[own])
        moved = np.concatenate([turn @ skew(from_centre), np.tile(-turn, (len(own), 1, 1))], axis=2)
        # a moved camera slides the point along its ray back onto the sheet
        slide = np.einsum("ni,nij->nj", gradient, moved) / along[:, None]
        by_sensor[own, :, own_second + N_CAMERA :] = moved - ray[:, :, None] * slide[:, None, :]
    kept = np.flatnonzero(is_met)
    return StripePoints(row[kept], points[kept], noise[kept], by_sensor[kept], sheet[row[kept]])


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
        Points of both cameras by their `LabelStatus`: dropped.
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
        (N,) `StereoStatus` of every stripe point.
    epipolar_offset_px, epipolar_sigma_px
        Mean distance of the right picture from the epipolar lines, and its standard deviation.
    offset
        The offset in full.
    counts
        What was kept and what was dropped.
    warnings
        What is weak, in words.
    """

    left: LabelledProfile
    right: LabelledProfile
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
    options: StereoLabelOptions | None = None,
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
    options = options or StereoLabelOptions()
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
        agrees[is_pair], int(StereoStatus.FUSED), int(StereoStatus.INCONSISTENT)
    )
    left_fate[row[alone]] = np.where(
        inside, int(StereoStatus.ALONE), int(StereoStatus.OUT_OF_DEPTH)
    )
    taken = _taken(crossings.row[is_pair], right)
    right_row = np.flatnonzero((names.right.sheet >= 0) & ~taken)
    right_points = triangulate_right(right, right_row, names.right.sheet, sensor)
    kept = _in_depth(right_points, sensor, options)
    right_fate = _before(names.right)
    named = names.right.sheet >= 0
    right_fate[named & taken] = int(StereoStatus.INCONSISTENT)
    right_fate[named & _taken(crossings.row[fused], right)] = int(StereoStatus.TAKEN)
    right_fate[right_points.row] = np.where(
        kept, int(StereoStatus.ALONE), int(StereoStatus.OUT_OF_DEPTH)
    )
    counts = StereoCounts(
        len(fused),
        int(inside.sum()),
        int(kept.sum()),
        int((is_pair & ~agrees).sum()),
        int((~inside).sum() + (~kept).sum()),
        *(
            names.left.count(fate) + names.right.count(fate)
            for fate in (LabelStatus.AMBIGUOUS, LabelStatus.UNEXPLAINED, LabelStatus.NOT_ASKED)
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


def _before(named: LabelledProfile) -> IntArray:
    """(N,) `StereoStatus` of points before their rays are met with the sheets."""
    return np.where(named.sheet >= 0, int(StereoStatus.NO_RAY), int(StereoStatus.UNNAMED))


def _inside(
    projected: Projections, sensor: SensorCalibration, options: StereoLabelOptions
) -> BoolArray:
    return _within(projected.points_mm, projected.sheet, sensor, options)


def _within(
    points_mm: FloatArray, sheet: IntArray, sensor: SensorCalibration, options: StereoLabelOptions
) -> BoolArray:
    limits = np.array([options.depths.limits_mm(s) for s in sensor.sheets])
    depth = points_mm[:, 2]
    return np.asarray((depth >= limits[sheet, 0]) & (depth <= limits[sheet, 1]))


def _in_depth(
    stripe: StripePoints, sensor: SensorCalibration, options: StereoLabelOptions
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
