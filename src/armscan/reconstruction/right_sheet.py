# SPDX-License-Identifier: Apache-2.0
"""Points that only the right camera sees, on their sheet (eq. 4.11 in the right camera)."""

from __future__ import annotations

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import IntArray
from armscan.geometry.rotation import skew
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.fuse import misfit_mm
from armscan.reconstruction.triangulate import N_CAMERA, N_SHEET, StripePoints, sensor_columns
from armscan.records.profile import Profile


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
