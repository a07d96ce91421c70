# SPDX-License-Identifier: Apache-2.0
"""Labelled stripes to points: on their sheet, or fused from both cameras; what is dropped and why.

One light sheet draws one line: each ray of the laser lights one point, the first that it meets.
Where a line runs on unbroken, all rays around there are spent on it. What else is bright in the
sheet's part of the image then is a reflection, an edge that a compressed photograph made, or light
of another source, however well it meets the sheet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, given_away
from armscan.geometry.rotations import skew
from armscan.kernels.fusing import N_PARAMETERS, N_SENSOR, fuse_stripes
from armscan.kernels.naming import mark_beside
from armscan.models.calibration import SensorCalibration
from armscan.models.light_sheet import BOW_TERMS, MAX_FAN, PLANE_PARAMETER_NAMES, LightSheet
from armscan.models.two_views import TwoViews
from armscan.reconstruction.epipolar import (
    N_DRIFT,
    Crossings,
    EpipolarOffset,
    Projections,
    Residuals,
    RightStripes,
    find_crossings,
    project_on_sheets,
    residual_and_sigma,
)
from armscan.reconstruction.labels import LabelledInstant, LabelledProfile, PointStatus
from armscan.reconstruction.triangulate import (
    CALIBRATED_DEPTHS,
    N_CAMERA,
    N_SHEET,
    DepthRange,
    StripePoints,
    differentiated,
    gradients,
    lens_numbers,
    meet,
    sensor_columns,
    sensor_covariance,
    shapes_mm,
    sheet_numbers,
    sheet_rows,
    triangulate_stripe,
)
from armscan.records.profile import Profile

LARGEST_SLANT = 0.6
"""Tangent of the angle at which a ray may run to the sheet's depth axis: line lenses spread light
by up to 60 degrees."""
LEAST_SLANT = 0.3
"""The same to a ray that the sheet knows, to first order of its bow."""
FAN_SIGMAS = 2.0
"""Standard deviations of a fan that rays may differ from it by."""
NEEDED = 0.5
"""A segment is left without rays if fewer than this part of its own width is free around it."""
STEP_SPACINGS = 3.0
"""Rays are told apart by so many of the spacings between neighbouring points."""
_U2, _UV, _U2V = (BOW_TERMS.index(term) for term in ((2, 0), (1, 1), (2, 1)))
_OF_BOW = len(PLANE_PARAMETER_NAMES)
CONSISTENCY_SIGMAS = 5.0
"""Points whose left and right picture disagree by more are dropped."""
BESIDE_ROWS = 3
"""Where the right picture is larger, not every right point has a left one: this many between."""
N_STRIPES = 2
USUAL_SIGMA_PX = 0.1
"""Of stripes before two cameras, where nobody asks for one: of a third or three times that, lengths
err by 10 % less or more by the calibration."""
LEAST_OF_BOTH = 20
"""Points of a sheet, of a grid over the image, that both cameras see."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredProfile:
    """What one exposure gave.

    Parameters
    ----------
    labelled
        Its stripe points, the sheet of each and what became of it.
    points
        The measured ones in the Sensor frame.
    warnings
        What is weak, in words.
    """

    labelled: LabelledProfile
    points: StripePoints
    warnings: tuple[str, ...] = ()


def measure_points(
    labelled: LabelledInstant, sensor: SensorCalibration, depths: DepthRange
) -> tuple[MeasuredProfile, ...]:
    """The points of one instant, camera by camera; those beyond the accepted depths are dropped.

    Of points that both cameras see, the left profile carries the fused one; in the right profile
    they are marked as shared, so that no point counts twice.
    """
    if labelled.offset is None:
        return tuple(_on_sheets(one, sensor, depths) for one in labelled.profiles)
    left, right = labelled.profiles
    return measure_stereo(left, right, labelled.offset, sensor, depths)


def points_again(labelled: LabelledProfile, sensor: SensorCalibration) -> StripePoints:
    """The measured points of a profile of one camera, from the states that it was given."""
    is_measured = labelled.status == PointStatus.MEASURED
    return triangulate_stripe(labelled.profile, np.where(is_measured, labelled.sheet, -1), sensor)


def _on_sheets(
    labelled: LabelledProfile, sensor: SensorCalibration, depths: DepthRange
) -> MeasuredProfile:
    """Points of one camera on their sheets (eq. 2.20)."""
    profile, found = labelled.profile, points_again(labelled, sensor)
    status = np.where(labelled.status == PointStatus.MEASURED, PointStatus.NO_RAY, labelled.status)
    is_inside = depths.holds(found.points_mm, found.sheet, sensor)
    status[found.row] = np.where(is_inside, PointStatus.MEASURED, PointStatus.OUT_OF_DEPTH)
    found = found.select(is_inside)
    for k, of_sheet in sheet_rows(found.sheet):
        row = found.row[of_sheet]
        is_lost = is_without_ray(
            found.points_mm[of_sheet],
            profile.intensity[row],
            profile.segment[row],
            *known_rays(sensor, k),
        )
        status[row[is_lost]] = PointStatus.NO_LASER_RAY
    kept = found.select(status[found.row] == PointStatus.MEASURED)
    return MeasuredProfile(replace(labelled, status=given_away(status)), kept)


@lru_cache(maxsize=64)
def known_rays(sensor: SensorCalibration, sheet: int) -> tuple[LightSheet, float]:
    """The sheet of that number, and the tangent by which a ray may leave the one that its fan says.

    A fan is what the bow's change with depth tells, and as uncertain as that over the bow: of a bow
    that is hardly known it is anything. Then, as of a sheet without a fan, rays are only taken to
    run within `LARGEST_SLANT` of the depth.
    """
    model = sensor.sheets[sheet].sheet
    bow = abs(float(model.bow_mm[_U2]))
    if not model.fan.any() or bow == 0.0:
        return model, LARGEST_SLANT
    variance = np.diag(sensor_covariance(sensor, sheet))[N_CAMERA : N_CAMERA + N_SHEET]
    of_uv, of_u2v = np.sqrt(variance[[_OF_BOW + _UV, _OF_BOW + _U2V]])
    slant = max(LEAST_SLANT, FAN_SIGMAS * float(np.hypot(0.5 * of_uv, of_u2v)) / bow)
    if slant < LARGEST_SLANT and (np.abs(model.fan) < MAX_FAN).all():
        return model, slant
    return replace(model, fan=np.zeros(2)), LARGEST_SLANT


def is_without_ray(
    points_mm: FloatArray,
    intensity: FloatArray,
    segment: IntArray,
    sheet: LightSheet,
    slant: float = LARGEST_SLANT,
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
    slant
        Tangent by which rays may leave those of the sheet.
    """
    lost = np.zeros(len(points_mm), dtype=np.bool_)
    if bool((segment == segment[:1]).all()):
        return lost
    ray, depth = _rays(points_mm, sheet)
    apart_mm = np.abs(np.diff(ray))[np.diff(segment) == 0]
    step = STEP_SPACINGS * max(float(np.median(apart_mm)) if len(apart_mm) else 0.0, 1e-6)
    bins = np.floor((ray - ray.min()) / step).astype(np.int64)
    first_depth = np.full(int(bins.max()) + 1, np.nan)
    number = np.unique(segment, return_inverse=True)[1]
    strength = np.bincount(number, np.maximum(intensity, 0.0))
    for k in np.argsort(-strength):
        rows = np.flatnonzero(number == k)
        first, last = int(bins[rows].min()), int(bins[rows].max())
        spent = np.isfinite(first_depth)
        apart = 0.0
        if spent.any():
            nearest = np.interp(bins[rows], np.flatnonzero(spent), first_depth[spent])
            apart = float(np.abs(depth[rows] - nearest).max())
        reach = int(np.ceil(slant * apart / step))
        start, stop = first - reach, last + reach + 1
        within = np.arange(max(start, 0), min(stop, len(spent)))
        if stop - start - int(spent[within].sum()) < NEEDED * (last - first + 1):
            lost[rows] = True
            continue
        covered = np.arange(first, last + 1)
        order = np.argsort(bins[rows])
        first_depth[covered] = np.interp(covered, bins[rows][order], depth[rows][order])
    return lost


def _rays(points_mm: FloatArray, sheet: LightSheet) -> tuple[FloatArray, FloatArray]:
    """Where the laser's ray of each point crosses the sheet's middle, and its depth, in mm."""
    local = (points_mm - sheet.origin_mm) @ sheet.axes[:2].T / sheet.scale_mm
    u, v = local[:, 0], local[:, 1]
    lean, spread = sheet.fan
    u0 = (u - lean * v) / np.maximum(1.0 + spread * v, 0.2)
    return np.asarray(u0 * sheet.scale_mm), np.asarray(v * sheet.scale_mm)


def measure_stereo(
    left: LabelledProfile,
    right: LabelledProfile,
    offset: EpipolarOffset,
    sensor: SensorCalibration,
    depths: DepthRange,
) -> tuple[MeasuredProfile, MeasuredProfile]:
    """Points of two cameras: fused where both see them, else of one camera on its sheet.

    The noises of each point are those of the left stripe and of the right stripe; zero where a
    camera has no part in it.

    Raises
    ------
    InputError
        If the sensor has one camera.
    """
    row, profile = np.flatnonzero(left.sheet >= 0), left.profile
    projected = project_on_sheets(profile.points_px[row], left.sheet[row], sensor)
    if not projected.is_met.all():
        row, projected = row[projected.is_met], projected.select(projected.is_met)
    crossings = find_crossings(
        projected,
        profile.normals_px[row],
        profile.sigma_px[row],
        RightStripes.of(right.profile),
        sensor,
    )
    other = right.sheet[crossings.row]
    is_pair = (other == crossings.sheet) | (other == -1)
    is_inside = depths.holds(projected.points_mm, projected.sheet, sensor)
    is_beyond = is_pair & ~is_inside[crossings.at]
    is_pair &= ~is_beyond
    residual, sigma = residual_and_sigma(Residuals.of(crossings, sensor), offset)
    is_fused = is_pair & (np.abs(residual) <= CONSISTENCY_SIGMAS * sigma)
    is_alone = is_inside.copy()
    is_alone[crossings.at[is_pair]] = False
    left_status = np.where(left.sheet >= 0, PointStatus.NO_RAY, left.status)
    left_status[row] = PointStatus.OUT_OF_DEPTH
    left_status[row[crossings.at[is_pair]]] = PointStatus.INCONSISTENT
    left_status[row[crossings.at[is_fused]]] = PointStatus.MEASURED
    left_status[row[is_alone]] = PointStatus.MEASURED
    left_points = _left_points(
        row,
        projected,
        crossings,
        is_fused,
        is_alone,
        profiles=(profile, right.profile),
        sensor=sensor,
        offset=offset,
    )
    rows = crossings.row
    right_points, right_status = _right_alone(
        right, (rows[is_pair], rows[is_fused], rows[is_beyond]), sensor, depths
    )
    left_status.setflags(write=False)
    right_status.setflags(write=False)
    return (
        MeasuredProfile(replace(left, status=left_status), left_points, offset.warnings),
        MeasuredProfile(replace(right, status=right_status), right_points),
    )


def _right_alone(
    right: LabelledProfile,
    beside: tuple[IntArray, IntArray, IntArray],
    sensor: SensorCalibration,
    depths: DepthRange,
) -> tuple[StripePoints, IntArray]:
    """Points that the left camera does not see, and the status (N,) of all right points.

    ``beside`` are rows beside which left points within the depths fell, those of them that agreed,
    and those beside which left points beyond the depths fell.
    """
    is_labelled = right.sheet >= 0
    paired, fused, beyond = (is_labelled & _beside(rows, right.profile) for rows in beside)
    is_beside = paired | beyond
    found = triangulate_right(
        right.profile, np.flatnonzero(is_labelled & ~is_beside), right.sheet, sensor
    )
    is_inside = depths.holds(found.points_mm, found.sheet, sensor)
    status = np.where(is_labelled, PointStatus.NO_RAY, right.status)
    status[beyond] = PointStatus.OUT_OF_DEPTH
    status[paired] = PointStatus.INCONSISTENT
    status[fused] = PointStatus.SHARED
    status[found.row] = np.where(is_inside, PointStatus.MEASURED, PointStatus.OUT_OF_DEPTH)
    return found.select(is_inside), status


def _beside(rows: IntArray, right: Profile) -> BoolArray:
    """(N,) right points that a left point fell beside, with those between them."""
    is_beside = np.zeros(len(right), dtype=np.bool_)
    mark_beside(rows, right.segment, BESIDE_ROWS, is_beside.view(np.uint8))
    return is_beside


def _left_points(
    row: IntArray,
    projected: Projections,
    crossings: Crossings,
    is_fused: BoolArray,
    is_alone: BoolArray,
    *,
    profiles: tuple[Profile, Profile],
    sensor: SensorCalibration,
    offset: EpipolarOffset,
) -> StripePoints:
    """Points (M,) of the left profile's rows: fused (F,) with crossings, or alone (M,) on a sheet.

    In the order of the profile; rows that are neither are left out.
    """
    left, right = profiles
    chosen = np.flatnonzero(is_fused)
    crossing = np.full(len(row), -1)
    crossing[crossings.at[chosen]] = chosen
    kept = np.flatnonzero(is_alone | (crossing >= 0))
    crossing = crossing[kept]
    missed = crossings.residual_px
    if offset.is_beyond_calibration:
        missed = missed + crossings.by_errors[:, -N_DRIFT:] @ offset.drift
    length, other = left.noise_length, right.noise_length
    is_pair = crossing >= 0
    found = fuse_points(
        projected,
        crossings,
        np.column_stack([left.normals_px[row], left.sigma_px[row]]),
        right.sigma_px[crossings.row],
        sensor=sensor,
        missed_px=missed,
        rows=kept,
        crossing=crossing,
    )
    if length is not None and other is None and is_pair.any():
        length = None
    if length is not None:
        length = length[row[kept]]
        if other is not None and is_pair.any():
            pair = other[crossings.row[crossing[is_pair]]]
            length[is_pair] = _mean_length(length[is_pair], pair, found.noise_mm[is_pair])
        length.setflags(write=False)
    row = row[kept]
    row.setflags(write=False)
    return replace(found, row=row, noise_length=length)


def _mean_length(left: FloatArray, right: FloatArray, noise_mm: FloatArray) -> FloatArray:
    """(M,) mean by variance of the noise's lengths (M,) of both cameras; noises (M, 3, 2)."""
    x, y, z = np.moveaxis(noise_mm * noise_mm, 1, 0)
    variance = np.maximum(x + y + z, np.finfo(np.float64).tiny)
    total = left * variance[:, 0] + right * variance[:, 1]
    return np.asarray(total / variance.sum(axis=1))


def fuse_points(
    projected: Projections,
    crossings: Crossings,
    left: FloatArray,
    right_sigma_px: FloatArray,
    *,
    sensor: SensorCalibration,
    missed_px: FloatArray,
    rows: IntArray,
    crossing: IntArray,
) -> StripePoints:
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
        (H,) left points on their sheets.
    crossings
        (F,) the right stripes beside them.
    left
        (H, 3) normals across the left stripe, and sigma of its points.
    right_sigma_px
        (F,) of the right stripe's points.
    sensor
        Both cameras and all sheets, with their joint covariance.
    missed_px
        (F,) distances across the right stripe, without the known part of a camera that has moved.
    rows
        (M,) left points that are asked for.
    crossing
        (M,) the crossing of each; -1 for a point that stays on its sheet.

    Returns
    -------
    StripePoints
        In the order asked; ``row`` is ``rows``.
    """
    n = len(rows)
    points, noise, shape = np.zeros((n, 3)), np.zeros((n, 3, N_STRIPES)), np.zeros((n, 3))
    gain, by_distance = np.zeros((n, 3, 4)), np.zeros((n, N_PARAMETERS))
    fuse_stripes(
        rows,
        crossing,
        projected.points_mm,
        projected.sheet,
        left,
        right_sigma_px,
        shapes_mm(sensor),
        missed_px,
        crossings.by_point,
        crossings.by_errors,
        lens_numbers(sensor),
        sheet_numbers(sensor),
        _covariances(sensor),
        points,
        noise.reshape(n, 3 * N_STRIPES),
        shape,
        gain.reshape(n, 12),
        by_distance,
    )
    sheet = projected.sheet[rows]
    for array in (points, noise, shape, gain, by_distance, sheet):
        array.setflags(write=False)
    return StripePoints(
        row=rows,
        points_mm=points,
        noise_mm=noise,
        shape_mm=shape,
        gain=gain,
        by_distance=by_distance,
        sheet=sheet,
    )


def over_sheet(
    points_px: FloatArray, sheet: int, sensor: SensorCalibration
) -> tuple[FloatArray, FloatArray]:
    """Points all over a sheet, and how the sensor's errors move them, as it would be measured.

    Parameters
    ----------
    points_px
        (N, 2) pixels of the first image; those that do not meet the sheet in the depths of its
        calibration are left out.
    sheet
        Index into ``sensor.sheets``.
    sensor
        One camera, or two: then those are left out that one camera sees alone, unless both hardly
        see the sheet.

    Returns
    -------
    points_mm
        (M, 3) in Sensor.
    by_sensor
        (M, 3, Q) derivative by what `sensor_columns` names.
    """
    number = np.full(len(points_px), sheet, dtype=np.int64)
    lens, sheets = lens_numbers(sensor), sheet_numbers(sensor)
    points, is_met = meet(points_px, number, lens, sheets)
    is_met &= CALIBRATED_DEPTHS.holds(points, number, sensor)
    points = points[is_met]
    if sensor.second is not None:
        both = _seen_by_both(points_px[is_met], sheet, sensor)
        if len(both) >= LEAST_OF_BOTH:
            return both.points_mm, both.by_sensor
    by_sensor = np.zeros((len(points), 3, len(sensor_columns(sensor, sheet))))
    own = differentiated(points, number[is_met], lens, sheets)[1]
    by_sensor[:, :, : own.shape[2]] = own
    return points, by_sensor


def _seen_by_both(points_px: FloatArray, sheet: int, sensor: SensorCalibration) -> StripePoints:
    """Points that two cameras tell of stripes along a sheet's first axis, without noise.

    ``points_px`` (N, 2) are of the left image; those that the right one misses are left out.
    """
    views, along = TwoViews.of_sensor(sensor), sensor.sheets[sheet].sheet.axes[0]
    there = project_on_sheets(points_px, np.full(len(points_px), sheet), sensor)
    rows = np.flatnonzero(there.is_met & views.right.is_inside(there.q_px))
    there, left_px = there.select(rows), points_px[rows]
    ahead_mm = there.points_mm + along
    sigma = np.full(len(rows), USUAL_SIGMA_PX)
    left = np.column_stack([_across(views.left.project(ahead_mm) - left_px), sigma])
    right_px = views.right.project(views.points_right_mm(ahead_mm))
    right = np.column_stack([there.q_px, _across(right_px - there.q_px), sigma])
    stripes = RightStripes(np.arange(len(rows)), right, (-np.inf, -np.inf), (np.inf, np.inf))
    crossings = find_crossings(there, left[:, :2], sigma, stripes, sensor)
    return fuse_points(
        there,
        crossings,
        left,
        sigma[crossings.row],
        sensor=sensor,
        missed_px=crossings.residual_px,
        rows=crossings.at,
        crossing=np.arange(len(crossings.at)),
    )


def _across(along_px: FloatArray) -> FloatArray:
    """(N, 2) unit vectors square to directions."""
    turned = np.column_stack([-along_px[:, 1], along_px[:, 0]])
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


@lru_cache(maxsize=8)
def _covariances(sensor: SensorCalibration) -> FloatArray:
    """(S, 1024) covariance of what the points of each sheet depend on."""
    return np.stack([sensor_covariance(sensor, k).ravel() for k in range(len(sensor.sheets))])


def triangulate_right(
    profile: Profile, row: IntArray, sheet: IntArray, sensor: SensorCalibration
) -> StripePoints:
    """Intersect the right camera's rays with their sheets (eq. 4.11 in the right camera).

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
        In the Sensor frame. The noises are those of a left stripe (zero) and of the right stripe.

    Raises
    ------
    InputError
        If the sensor has one camera.
    """
    if sensor.second is None:
        raise InputError("the sensor has one camera")
    pose, (lens, numbers) = sensor.second.right_from_sensor, _right_numbers(sensor)
    found, is_met = meet(profile.points_px[row], sheet[row], lens, numbers)
    row, found = row[is_met], found[is_met]
    own, n, turn = sheet[row], len(row), pose.rotation.T
    by_px, by_right = differentiated(found, own, lens, numbers)
    from_centre = found - pose.translation_mm
    points, ray = from_centre @ turn.T, found @ turn.T
    gradient = gradients(points, own, sensor)
    along = np.sum(gradient * ray, axis=1)
    noise = np.zeros((n, 3, N_STRIPES))
    across = np.einsum("nij,nj->ni", by_px, profile.normals_px[row])
    noise[:, :, 1] = (across @ turn.T) * profile.sigma_px[row, None]
    by_sensor, second = np.zeros((n, 3, N_SENSOR)), N_CAMERA + N_SHEET
    turned = turn @ by_right
    by_sensor[:, :, N_CAMERA:second] = turned[:, :, N_CAMERA:]
    by_sensor[:, :, second : second + N_CAMERA] = turned[:, :, :N_CAMERA]
    moved = np.concatenate([turn @ skew(from_centre), np.tile(-turn, (n, 1, 1))], axis=2)
    # a moved camera slides the point along its ray back onto the sheet
    slide = np.einsum("ni,nij->nj", gradient, moved) / along[:, None]
    by_sensor[:, :, second + N_CAMERA :] = moved - ray[:, :, None] * slide[:, None, :]
    return StripePoints(
        row=row,
        points_mm=points,
        noise_mm=noise,
        shape_mm=ray * (shapes_mm(sensor)[own] / along)[:, None],
        dpoint_dsensor=by_sensor,
        sheet=own,
        noise_length=None if profile.noise_length is None else profile.noise_length[row],
    )


@lru_cache(maxsize=8)
def _right_numbers(sensor: SensorCalibration) -> tuple[FloatArray, FloatArray]:
    """The right camera and the sheets in its frame, as `meet` takes them."""
    if sensor.second is None:
        raise InputError("the sensor has one camera")
    pose, camera = sensor.second.right_from_sensor, sensor.second.camera.camera
    sheets = [one.sheet.in_frame(pose.rotation, pose.translation_mm) for one in sensor.sheets]
    return camera.numbers, np.stack([one.numbers for one in sheets])
