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
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.rotations import skew
from armscan.kernels.naming import mark_beside
from armscan.kernels.placing import fuse_stripes
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import fold_radius
from armscan.models.light_sheet import LightSheet
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
    N_CAMERA,
    N_SHEET,
    DepthRange,
    StripePoints,
    differentiated,
    gradients,
    lens_numbers,
    meet,
    moved_by_shape,
    sensor_covariance,
    shapes_mm,
    sheet_numbers,
    triangulate_stripe,
)
from armscan.records.profile import Profile

LARGEST_SLANT = 0.6
"""Tangent of the angle at which a ray may run to the sheet's depth axis: line lenses spread light
by up to 60 degrees. Where the sheet knows its rays, they are followed and half of it is enough."""
NEEDED = 0.5
"""A segment is left without rays if fewer than this part of its own width is free around it."""
STEP_SPACINGS = 3.0
"""Rays are told apart by so many of the spacings between neighbouring points."""
CONSISTENCY_SIGMAS = 5.0
"""Points whose left and right picture disagree by more are dropped."""
BESIDE_ROWS = 3
"""Where the right picture is larger, not every right point has a left one: this many between."""
N_STRIPES = 2
N_COLUMNS = 32
"""Parameters that a point of two cameras depends on: 9, 8 of its sheet, 15 of the second one."""


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
    for k, calibrated in enumerate(sensor.sheets):
        of_sheet = np.flatnonzero(found.sheet == k)
        row = found.row[of_sheet]
        is_lost = is_without_ray(
            found.points_mm[of_sheet],
            profile.intensity[row],
            profile.segment[row],
            calibrated.sheet,
        )
        status[row[is_lost]] = PointStatus.NO_LASER_RAY
    kept = found.select(status[found.row] == PointStatus.MEASURED)
    return MeasuredProfile(replace(labelled, status=status), kept)


def is_without_ray(
    points_mm: FloatArray, intensity: FloatArray, segment: IntArray, sheet: LightSheet
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
    residual, sigma = residual_and_sigma(Residuals.of(crossings, sensor), offset)
    is_fused = is_pair & (np.abs(residual) <= CONSISTENCY_SIGMAS * sigma)
    is_alone = depths.holds(projected.points_mm, projected.sheet, sensor)
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
    right_points, right_status = _right_alone(
        right, crossings.row[is_pair], crossings.row[is_fused], sensor, depths
    )
    left_status.setflags(write=False)
    right_status.setflags(write=False)
    return (
        MeasuredProfile(replace(left, status=left_status), left_points, offset.warnings),
        MeasuredProfile(replace(right, status=right_status), right_points),
    )


def _right_alone(
    right: LabelledProfile,
    paired: IntArray,
    fused: IntArray,
    sensor: SensorCalibration,
    depths: DepthRange,
) -> tuple[StripePoints, IntArray]:
    """Points that the left camera does not see, and the status (N,) of all right points.

    ``paired`` and ``fused`` are rows beside which left points fell, and those of them that agreed.
    """
    is_labelled = right.sheet >= 0
    is_beside = _beside(paired, right.profile)
    found = triangulate_right(
        right.profile, np.flatnonzero(is_labelled & ~is_beside), right.sheet, sensor
    )
    is_inside = depths.holds(found.points_mm, found.sheet, sensor)
    status = np.where(is_labelled, PointStatus.NO_RAY, right.status)
    status[is_labelled & is_beside] = PointStatus.INCONSISTENT
    status[is_labelled & _beside(fused, right.profile)] = PointStatus.SHARED
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
    chosen, alone = np.flatnonzero(is_fused), np.flatnonzero(is_alone)
    is_kept = is_alone.copy()
    is_kept[crossings.at[chosen]] = True
    kept, place = np.flatnonzero(is_kept), np.cumsum(is_kept) - 1
    shift = np.zeros(len(crossings.at))
    if offset.is_beyond_calibration:
        shift -= crossings.by_errors[:, -N_DRIFT:] @ offset.drift
    found = SpreadPoints.empty(len(kept))
    into, into_alone = place[crossings.at[chosen]], place[alone]
    sigma = np.column_stack([left.sigma_px[row[crossings.at]], right.sigma_px[crossings.row]])
    fuse_points(
        projected,
        crossings,
        left.normals_px[row],
        sigma,
        sensor=sensor,
        shift_px=shift,
        chosen=chosen,
        into=into,
        found=found,
    )
    _spread_alone(row[alone], projected.select(alone), left, sensor, into_alone, found=found)
    length = None
    if left.noise_length is not None and (right.noise_length is not None or not len(chosen)):
        length = left.noise_length[row[kept]]
        if right.noise_length is not None and len(chosen):
            pair = right.noise_length[crossings.row[chosen]]
            length[into] = _mean_length(length[into], pair, found.noise_mm[into])
        length.setflags(write=False)
    return found.stripe_points(row[kept], projected.sheet[kept], length)


def _mean_length(left: FloatArray, right: FloatArray, noise_mm: FloatArray) -> FloatArray:
    """(M,) mean by variance of the noise's lengths (M,) of both cameras; noises (M, 3, 2)."""
    variance = np.maximum((noise_mm**2).sum(axis=1), np.finfo(np.float64).tiny)
    total = left * variance[:, 0] + right * variance[:, 1]
    return np.asarray(total / variance.sum(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class SpreadPoints:
    """Points of two cameras with what moves them, as `StripePoints` has them; they are written to.

    Parameters
    ----------
    points_mm, shape_mm
        (M, 3).
    noise_mm
        (M, 3, 2) by the left stripe and by the right stripe.
    by_sensor
        (M, 3, 32).
    """

    points_mm: FloatArray
    noise_mm: FloatArray
    shape_mm: FloatArray
    by_sensor: FloatArray

    @staticmethod
    def empty(n: int) -> SpreadPoints:
        """Nothing is known of ``n`` points yet."""
        return SpreadPoints(
            points_mm=np.zeros((n, 3)),
            noise_mm=np.zeros((n, 3, N_STRIPES)),
            shape_mm=np.zeros((n, 3)),
            by_sensor=np.zeros((n, 3, N_COLUMNS)),
        )

    def stripe_points(
        self, row: IntArray, sheet: IntArray, noise_length: FloatArray | None
    ) -> StripePoints:
        """All of them, which are not written to any more."""
        for array in (self.points_mm, self.noise_mm, self.shape_mm, self.by_sensor, row, sheet):
            array.setflags(write=False)
        return StripePoints(
            row=row,
            points_mm=self.points_mm,
            noise_mm=self.noise_mm,
            shape_mm=self.shape_mm,
            dpoint_dsensor=self.by_sensor,
            sheet=sheet,
            noise_length=noise_length,
        )


def fuse_points(
    projected: Projections,
    crossings: Crossings,
    normals_px: FloatArray,
    sigma_px: FloatArray,
    *,
    sensor: SensorCalibration,
    shift_px: FloatArray,
    chosen: IntArray,
    into: IntArray,
    found: SpreadPoints,
) -> None:
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
    normals_px
        (H, 2) across the left stripe.
    sigma_px
        (F, 2) of the left stripe's point and of the right stripe's.
    sensor
        Both cameras and all sheets, with their joint covariance.
    shift_px
        (F,) known part of the residuals, to be taken off: of a camera that has moved.
    chosen
        (M,) crossings whose points are asked for.
    into
        (M,) their places in ``found``.
    found
        Receives them.
    """
    n = len(found.points_mm)
    fuse_stripes(
        chosen,
        into,
        crossings.at,
        projected.points_mm,
        projected.sheet,
        normals_px,
        sigma_px,
        np.maximum(shapes_mm(sensor), 1e-6),
        crossings.residual_px - shift_px,
        crossings.by_point,
        crossings.by_errors,
        lens_numbers(sensor),
        sheet_numbers(sensor),
        _covariances(sensor),
        found.points_mm,
        found.noise_mm.reshape(n, 3 * N_STRIPES),
        found.shape_mm,
        found.by_sensor.reshape(n, 3 * N_COLUMNS),
    )


@lru_cache(maxsize=8)
def _covariances(sensor: SensorCalibration) -> FloatArray:
    """(S, 1024) covariance of what the points of each sheet depend on."""
    return np.stack([sensor_covariance(sensor, k).ravel() for k in range(len(sensor.sheets))])


def _spread_alone(
    row: IntArray,
    projected: Projections,
    left: Profile,
    sensor: SensorCalibration,
    into: IntArray,
    *,
    found: SpreadPoints,
) -> None:
    """Points (M,) on their sheet by the left camera alone (eq. 4.11), into places of ``found``."""
    points, sheet = projected.points_mm, projected.sheet
    by_px, by_sensor = differentiated(points, sheet, lens_numbers(sensor), sheet_numbers(sensor))
    across = np.einsum("nij,nj->ni", by_px, left.normals_px[row])
    found.points_mm[into] = points
    found.noise_mm[into, :, 0] = across * left.sigma_px[row, None]
    found.noise_mm[into, :, 1] = 0.0
    found.shape_mm[into] = moved_by_shape(points, points, sheet, sensor)
    found.by_sensor[into, :, : N_CAMERA + N_SHEET] = by_sensor
    found.by_sensor[into, :, N_CAMERA + N_SHEET :] = 0.0


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
    by_sensor, second = np.zeros((n, 3, N_COLUMNS)), N_CAMERA + N_SHEET
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
    lens = np.append(camera.parameters, fold_radius(camera.distortion))
    return lens, np.stack([one.numbers for one in sheets])
