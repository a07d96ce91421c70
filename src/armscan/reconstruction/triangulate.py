# SPDX-License-Identifier: Apache-2.0
"""Stripe points to Sensor points with their covariance (eqs. 2.20 and 2.21)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.calibration import SHEET_PARAMETER_NAMES, SensorCalibration
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile

N_CAMERA, N_SHEET = 9, len(SHEET_PARAMETER_NAMES)


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
    xy, is_valid = sensor.camera.camera.undistort(points_px)
    points = np.zeros((len(points_px), 3))
    is_met = np.zeros(len(points_px), dtype=np.bool_)
    for k, calibrated in enumerate(sensor.sheets):
        own = is_valid & (sheet_of_point == k)
        points[own], is_met[own] = calibrated.sheet.intersect(xy[own])
    return points, is_met


@dataclass(frozen=True, slots=True, eq=False)
class StripePoints:
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
    by_sensor
        (M, 3, Q) derivative by the parameters that `sensor_columns` names for the point's sheet:
        the camera's 9, the sheet's 8, and the 15 of a second camera, if there is one.
    sheet
        (M,) index into ``sensor.sheets``.
    """

    row: IntArray
    points_mm: FloatArray
    noise_mm: FloatArray
    by_sensor: FloatArray
    sheet: IntArray


def triangulate(
    profile: Profile, sheet_of_point: IntArray, sensor: SensorCalibration
) -> PointCloud:
    """Turn stripe points into a cloud in the Sensor frame.

    Parameters and errors are those of `triangulate_stripe`.

    Returns
    -------
    PointCloud
        In the order of the profile; ``covariance_mm2`` is stripe noise plus calibration,
        ``sigma_noise_mm`` the stripe noise alone.
    """
    return cloud_in_sensor(triangulate_stripe(profile, sheet_of_point, sensor), profile, sensor)


def cloud_in_sensor(
    stripe: StripePoints, profile: Profile, sensor: SensorCalibration
) -> PointCloud:
    """The points of one exposure as a cloud in the Sensor frame."""
    covariance = stripe.noise_mm @ stripe.noise_mm.transpose(0, 2, 1)
    for k in range(len(sensor.sheets)):
        own = stripe.sheet == k
        joint = sensor_covariance(sensor, k)
        covariance[own] += stripe.by_sensor[own] @ joint @ stripe.by_sensor[own].transpose(0, 2, 1)
    return PointCloud(
        frame="Sensor",
        points_mm=stripe.points_mm,
        covariance_mm2=0.5 * (covariance + covariance.transpose(0, 2, 1)),
        sigma_noise_mm=noise_size_mm(stripe.noise_mm),
        sheet=stripe.sheet,
        sheet_names=tuple(sheet.name for sheet in sensor.sheets),
        exposure=np.zeros(len(stripe.row), dtype=np.int64),
        exposure_sources=(profile.source,),
        segment=profile.segment[stripe.row],
        intensity=profile.intensity[stripe.row],
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
    xy, has_ray, dxy_dq, dxy_dcamera = sensor.camera.camera.undistort_with_jacobian(
        profile.points_px
    )
    points = np.zeros((len(profile), 3))
    noise = np.zeros((len(profile), 3))
    by_sensor = np.zeros((len(profile), 3, len(sensor_columns(sensor, 0))))
    is_met = np.zeros(len(profile), dtype=np.bool_)
    for k, calibrated in enumerate(sensor.sheets):
        own = np.flatnonzero(has_ray & (sheets == k))
        points[own], is_met[own], dpoint_dxy, dpoint_dsheet = (
            calibrated.sheet.intersect_with_jacobian(xy[own])
        )
        across = np.einsum("nij,njk,nk->ni", dpoint_dxy, dxy_dq[own], profile.normals_px[own])
        noise[own] = across * profile.sigma_px[own, None]
        by_sensor[own, :, :N_CAMERA] = dpoint_dxy @ dxy_dcamera[own]
        by_sensor[own, :, N_CAMERA : N_CAMERA + N_SHEET] = dpoint_dsheet
    kept = np.flatnonzero(is_met)
    return StripePoints(kept, points[kept], noise[kept, :, None], by_sensor[kept], sheets[kept])


def noise_size_mm(noise_mm: FloatArray) -> FloatArray:
    """(M,) root sum square of the independent noises (M, 3, J) of each point."""
    return np.asarray(np.sqrt((noise_mm**2).sum(axis=(1, 2))))


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
    own, second = sensor.sheet_parameter_slice(sheet), sensor.second_parameter_slice
    return np.concatenate(
        [np.arange(N_CAMERA), np.arange(own.start, own.stop), np.arange(second.start, second.stop)]
    )


def sensor_covariance(sensor: SensorCalibration, sheet: int) -> FloatArray:
    """(Q, Q) covariance of what the points of one sheet depend on, as `sensor_columns`."""
    places = sensor_columns(sensor, sheet)
    return np.asarray(sensor.covariance[np.ix_(places, places)])
