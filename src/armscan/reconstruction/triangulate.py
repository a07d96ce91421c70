# SPDX-License-Identifier: Apache-2.0
"""Stripe points to Sensor points with their covariance (eqs. 2.20 and 2.21)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, floats, ints
from armscan.kernels.rays import meet_sheets, move_by_shape
from armscan.models.calibration import (
    SHEET_PARAMETER_NAMES,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.camera import fold_radius
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.records.profile import PointProfile, Profile

N_CAMERA, N_SHEET = 9, len(SHEET_PARAMETER_NAMES)


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

    def holds(
        self, points_mm: FloatArray, sheet: IntArray | int, sensor: SensorCalibration
    ) -> BoolArray:
        """(..., N) True where points (..., N, 3) are within the depths of their sheets (N,)."""
        low, high = np.array([self.limits_mm(one) for one in sensor.sheets]).T
        depth = points_mm[..., 2]
        return np.asarray((depth >= low[sheet]) & (depth <= high[sheet]))


CALIBRATED_DEPTHS = DepthRange(0.0)
"""Depths that are accepted from one camera unless a person says more (ADR 15)."""
LABEL_DEPTHS = DepthRange(0.5)
"""Depths in which a sheet is looked for where several may have drawn a stripe, unless a person says
otherwise. Two cameras accept them too: the second one sees whether the sheet goes on as it was
calibrated."""


def intersect_sheets(
    points_px: FloatArray, sheet_of_point: IntArray, sensor: SensorCalibration
) -> tuple[FloatArray, BoolArray]:
    """Intersect the rays of pixels with their sheets, without covariance.

    Parameters
    ----------
    points_px
        (N, 2) full-sensor pixels.
    sheet_of_point
        (N,) index into ``sensor.sheets``; -1 for none.
    sensor
        Camera and sheets.

    Returns
    -------
    points_mm
        (N, 3) in the Sensor frame; zero where there is none.
    is_valid
        (N,) False without sheet, without inverse of the distortion, and where the ray misses.
    """
    points = np.zeros((len(points_px), 3))
    none = np.zeros((0, 0))
    return points, _meet(points_px, sheet_of_point, sensor, points, none, none)


def _meet(
    points_px: FloatArray,
    sheet_of_point: IntArray,
    sensor: SensorCalibration,
    *written: FloatArray,
) -> BoolArray:
    """Call the kernel `meet_sheets`, which writes points and derivatives; (N,) True where met."""
    camera = sensor.camera.camera
    is_met = np.zeros(len(points_px), dtype=np.int64)
    meet_sheets(
        np.ascontiguousarray(points_px, dtype=np.float64),
        np.ascontiguousarray(sheet_of_point, dtype=np.int64),
        np.append(camera.parameters, fold_radius(camera.distortion)),
        _numbers(sensor),
        written[0],
        is_met,
        written[1],
        written[2],
    )
    return is_met.astype(np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class SheetPoints:
    """Rays of the left camera or the only one, intersected with their sheets.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame (eq. 4.11); (0, 0, 1) where there is none.
    is_met
        (N,) False where the lens model has no inverse or the ray misses the sheet.
    dpoint_dpx
        (N, 3, 2) derivative by the pixel.
    dpoint_dsensor
        (N, 3, 17) derivative by the camera's 9 parameters and the sheet's 8.
    """

    points_mm: FloatArray
    is_met: BoolArray
    dpoint_dpx: FloatArray
    dpoint_dsensor: FloatArray


def intersect_with_jacobian(
    points_px: FloatArray, sheet_of_point: IntArray, sensor: SensorCalibration
) -> SheetPoints:
    """Intersect the rays of pixels (N, 2) with their sheets (N,), -1 for none; differentiate."""
    n = len(points_px)
    points = np.tile([0.0, 0.0, 1.0], (n, 1))
    n_parameters = N_CAMERA + N_SHEET
    by_px, by_sensor = np.zeros((n, 3, 2)), np.zeros((n, 3, n_parameters))
    flat = by_px.reshape(n, 6), by_sensor.reshape(n, 3 * n_parameters)
    is_met = _meet(points_px, sheet_of_point, sensor, points, *flat)
    # read-only and their own, so that records take them as they are
    for array in (points, by_px, by_sensor):
        array.setflags(write=False)
    return SheetPoints(points, is_met, by_px, by_sensor)


class StripePoints(RowRecord):
    """Points of one exposure in the Sensor frame, with what their errors come from.

    Parameters
    ----------
    row
        (M,) index of each point in the profile.
    points_mm
        (M, 3) in the Sensor frame.
    noise_mm
        (M, 3, J) one standard deviation of each independent noise: the direction in which it acts
        times its size. One camera has one, the stripe's own noise, which acts within the sheet;
        a point that both cameras see has one of each camera.
    shape_mm
        (M, 3) move of the point by one standard deviation of the sheet's own shape, which the
        model leaves (see `SheetCalibration`): smooth over the sheet, so that neighbours share it.
    by_sensor
        (M, 3, Q) derivative by the parameters that `sensor_columns` names for the point's sheet:
        the camera's 9, the sheet's 8, and the 15 of a second camera, if there is one.
    sheet
        (M,) index into ``sensor.sheets``.
    noise_length
        (M,) correlation length of the noise along the stripe, as in `Profile`; of a point of two
        cameras the mean by variance. None where it is not known.
    """

    row: IntArray = ints("N")
    points_mm: FloatArray = floats("N", 3)
    noise_mm: FloatArray = floats("N", 3, None)
    shape_mm: FloatArray = floats("N", 3)
    by_sensor: FloatArray = floats("N", 3, None)
    sheet: IntArray = ints("N")
    noise_length: FloatArray | None = floats("N", default=None)

    @property
    def own_covariance_mm2(self) -> FloatArray:
        """(M, 3, 3) by the stripes' noise and the sheets' shape, in Sensor."""
        own = np.concatenate([self.noise_mm, self.shape_mm[:, :, None]], axis=2)
        return np.asarray(own @ own.transpose(0, 2, 1))


def triangulate(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> PointCloud:
    """Turn stripe points into a cloud in the Sensor frame.

    Parameters and errors are those of `triangulate_stripe`.

    Returns
    -------
    PointCloud
        In the order of the profile; ``covariance_mm2`` is stripe noise, sheet shape and
        calibration, ``sigma_noise_mm`` the stripe noise alone.
    """
    return cloud_in_sensor(triangulate_stripe(profile, sheet_of_point, sensor), profile, sensor)


def cloud_in_sensor(
    stripe: StripePoints, profile: Profile, sensor: SensorCalibration
) -> PointCloud:
    """The points of one exposure as a cloud in the Sensor frame."""
    covariance = stripe.own_covariance_mm2
    for k in range(len(sensor.sheets)):
        of_sheet = stripe.sheet == k
        jacobian = stripe.by_sensor[of_sheet]
        covariance[of_sheet] += (
            jacobian @ sensor_covariance(sensor, k) @ jacobian.transpose(0, 2, 1)
        )
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    names = tuple(one.name for one in sensor.sheets)
    return stripe_cloud("Sensor", stripe, profile, stripe.points_mm, covariance, sheet_names=names)


def stripe_cloud(
    frame: CloudFrame,
    stripe: StripePoints,
    profile: Profile | PointProfile,
    points_mm: FloatArray,
    covariance_mm2: FloatArray,
    *,
    sheet_names: tuple[str, ...],
) -> PointCloud:
    """The points of one exposure, given in a frame with symmetric covariances, as a cloud."""
    if isinstance(profile, Profile):
        segment, intensity = profile.segment[stripe.row], profile.intensity[stripe.row]
    else:
        segment, intensity = np.zeros_like(stripe.row), np.zeros(len(stripe))
    return PointCloud(
        frame=frame,
        points_mm=points_mm,
        covariance_mm2=covariance_mm2,
        sigma_noise_mm=noise_size_mm(stripe.noise_mm),
        sheet=stripe.sheet,
        sheet_names=sheet_names,
        exposure=np.zeros(len(stripe), dtype=np.int64),
        exposure_sources=(profile.source,),
        segment=segment,
        intensity=intensity,
        noise_length=stripe.noise_length,
    )


def triangulate_stripe(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> StripePoints:
    """Intersect the rays of stripe points with their sheets, and say where errors come from.

    The stripe's noise acts across the stripe; along it a point's place is a choice of where to
    sample, not a measurement, so it has no error of its own. A point therefore errs in one
    direction within the sheet by its own noise, and with all others by the calibration.

    Parameters
    ----------
    profile
        Stripe points of one exposure.
    sheet_of_point
        (N,) index into ``sensor.sheets``; points with -1 are left out, and so are points whose
        ray does not meet the sheet in front of the camera.
    sensor
        Camera and sheets with their joint covariance.

    Raises
    ------
    InputError
        If ``sheet_of_point`` does not fit the profile or the sheets.
    """
    sheets = _checked_sheets(profile, sheet_of_point, sensor)
    asked = np.flatnonzero(sheets >= 0)
    met = intersect_with_jacobian(profile.points_px[asked], sheets[asked], sensor)
    noise = np.zeros((len(asked), 3, 1))
    across = (profile.normals_px * profile.sigma_px[:, None])[asked]
    np.einsum("nij,nj->ni", met.dpoint_dpx, across, out=noise[:, :, 0])
    noise.setflags(write=False)
    length = profile.noise_length
    by_sensor, n_rest = met.dpoint_dsensor, len(sensor_columns(sensor, 0)) - N_CAMERA - N_SHEET
    if n_rest:
        rest = np.zeros((len(asked), 3, n_rest))
        by_sensor = np.concatenate([by_sensor, rest], axis=2)
    found = StripePoints(
        row=asked,
        points_mm=met.points_mm,
        noise_mm=noise,
        shape_mm=moved_by_shape(met.points_mm, met.points_mm, sheets[asked], sensor),
        by_sensor=by_sensor,
        sheet=sheets[asked],
        noise_length=None if length is None else length[asked],
    )
    return found if met.is_met.all() else found.select(met.is_met)


OLD_SHAPE_SHARE = 0.3
"""Part of a sheet's residual that is taken for its own shape where a document, older than the
estimate, states none."""


def shape_mm(sensor: SensorCalibration, sheet: int) -> float:
    """Standard deviation of a sheet's true surface about its model."""
    one = sensor.sheets[sheet]
    return OLD_SHAPE_SHARE * one.rms_mm if one.shape_mm is None else one.shape_mm


def moved_by_shape(
    points_mm: FloatArray, rays: FloatArray, sheet: IntArray, sensor: SensorCalibration
) -> FloatArray:
    """(M, 3) move of points along their rays (M, 3) by one standard deviation of a sheet's shape.

    All in the Sensor frame; ``sheet`` (M,) is the index of each point's sheet.
    """
    moved = np.zeros((len(points_mm), 3))
    size = np.array([shape_mm(sensor, k) for k in range(len(sensor.sheets))])
    at = np.ascontiguousarray(points_mm, dtype=np.float64)
    along = np.ascontiguousarray(rays, dtype=np.float64)
    own = np.ascontiguousarray(sheet, dtype=np.int64)
    move_by_shape(at, along, own, _numbers(sensor), size, moved)
    return moved


def _numbers(sensor: SensorCalibration) -> FloatArray:
    """(S, 20) the sheets, as the kernels read them."""
    return np.stack([one.sheet.numbers for one in sensor.sheets])


def noise_size_mm(noise_mm: FloatArray) -> FloatArray:
    """(M,) root sum square of the independent noises (M, 3, J) of each point."""
    return np.asarray(np.sqrt(np.einsum("nij,nij->n", noise_mm, noise_mm)))


def _checked_sheets(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> IntArray:
    sheets = np.asarray(sheet_of_point)
    if sheets.shape != (len(profile),):
        raise InputError(
            f"{sheets.shape} sheet numbers for {len(profile)} stripe points", where=profile.source
        )
    if len(sheets) and not -1 <= int(sheets.min()) <= int(sheets.max()) < len(sensor.sheets):
        raise InputError(
            f"sheet numbers {int(sheets.min())} to {int(sheets.max())}, but the calibration has "
            f"{len(sensor.sheets)} sheets",
            where=profile.source,
        )
    return sheets


def sensor_columns(sensor: SensorCalibration, sheet: int) -> IntArray:
    """(Q,) places, in ``sensor.covariance``, of what the points of one sheet depend on.

    The camera's 9 parameters, the sheet's 8, then the 15 of a second camera, if there is one.
    """
    of_sheet, second = sensor.sheet_parameter_slice(sheet), sensor.second_parameter_slice
    return np.asarray(np.r_[:N_CAMERA, of_sheet, second])


def sensor_covariance(sensor: SensorCalibration, sheet: int) -> FloatArray:
    """(Q, Q) covariance of what the points of one sheet depend on, as `sensor_columns`."""
    places = sensor_columns(sensor, sheet)
    return np.asarray(sensor.covariance[np.ix_(places, places)])
