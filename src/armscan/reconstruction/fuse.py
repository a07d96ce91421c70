# SPDX-License-Identifier: Apache-2.0
"""One point from its left picture, its right picture and its light sheet, by their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.stereo_residuals import Crossings, Projections
from armscan.reconstruction.triangulate import N_CAMERA, N_SHEET, sensor_covariance

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
