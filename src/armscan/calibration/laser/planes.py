# SPDX-License-Identifier: Apache-2.0
"""Simpler planes: the start of the fit, and what a report compares it with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.cross_ratio import cross_ratio_points
from armscan.calibration.laser.result import PlaneComparison, PlaneMethod
from armscan.calibration.laser.sightings import BoardImage
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Plane, fit_plane
from armscan.models.light_sheet import LightSheet


def algebraic_plane(points_mm: FloatArray) -> FloatArray:
    """(4,) ``a b c D`` of the plane by eq. 2.44, scaled to a unit normal.

    The print lacks the inverse of the normal matrix. The method minimises the algebraic error
    ``a X + b Y + c Z - 1``, which is the distance over the plane's own distance from the camera:
    it draws the plane away from the camera.
    """
    coefficients = np.linalg.lstsq(points_mm, np.ones(len(points_mm)), rcond=None)[0]
    return np.asarray(np.array([*coefficients, -1.0]) / np.linalg.norm(coefficients))


def sheet_from_plane(plane: Plane, points_mm: FloatArray, directions: FloatArray) -> LightSheet:
    """Flat sheet on a plane, u along the stripes' mean direction and v towards larger depth.

    Parameters
    ----------
    plane
        The plane.
    points_mm
        (N, 3) points that the sheet's origin and scale should cover.
    directions
        (L, 3) directions of the stripes; their signs do not matter.
    """
    normal = plane.normal
    mean = np.linalg.eigh(directions.T @ directions)[1][:, -1]
    e_u = mean - (mean @ normal) * normal
    e_u = e_u / np.linalg.norm(e_u)
    if e_u[int(np.argmax(np.abs(e_u)))] < 0.0:
        e_u = -e_u
    e_v = np.cross(normal, e_u)
    if e_v[2] < 0.0:
        normal, e_v = -normal, -e_v
    axes = np.stack([e_u, e_v, normal])
    local = (points_mm - plane.point_mm) @ axes[:2].T
    middle = 0.5 * (local.min(axis=0) + local.max(axis=0))
    scale = 0.5 * float(np.ptp(local, axis=0).max())
    return LightSheet(plane.point_mm + middle @ axes[:2], axes, scale, np.zeros(5))


def compare_planes(
    sheet: LightSheet,
    points_mm: FloatArray,
    images: Sequence[BoardImage],
    stripes: Sequence[tuple[int, IntArray]],
    cameras: HeadCameras,
) -> tuple[PlaneComparison, ...]:
    """Compare eq. 2.44, total least squares and the cross-ratio points with the sheet in use.

    Parameters
    ----------
    sheet
        The sheet in use.
    points_mm
        (N, 3) its points.
    images, stripes
        Image number and profile rows of each of its stripes.
    cameras
        For the cross-ratio points.
    """
    found = [_comparison("algebraic", algebraic_plane(points_mm), sheet, points_mm)]
    total = fit_plane(points_mm)
    if not isinstance(total, FitFailure):
        plane = total.value.coefficients
        found.append(_comparison("total least squares", plane, sheet, points_mm))
    crossings = []
    for i, rows in stripes:
        data = images[i].data
        camera = cameras.model(data.camera)
        on_board = cross_ratio_points(data.view, data.profile.points_px[rows], camera)
        pose = images[i].placed.sensor_from_board
        crossings.append(on_board @ pose.rotation[:, :2].T + pose.translation_mm)
    crossed = fit_plane(np.concatenate(crossings))
    if not isinstance(crossed, FitFailure):
        plane = crossed.value.coefficients
        found.append(_comparison("cross ratio", plane, sheet, points_mm))
    return tuple(found)


def _comparison(
    method: PlaneMethod, plane: FloatArray, sheet: LightSheet, points_mm: FloatArray
) -> PlaneComparison:
    if plane[:3] @ sheet.axes[2] < 0.0:
        plane = -plane
    height, _, _ = sheet.height_with_jacobian(points_mm)
    on_sheet = points_mm - height[:, None] * sheet.axes[2]
    sine = float(np.linalg.norm(np.cross(plane[:3], sheet.axes[2])))
    a, b, c, d = (float(value) for value in plane)
    return PlaneComparison(
        method,
        (a, b, c, d),
        float(np.degrees(np.arcsin(min(sine, 1.0)))),
        float(np.abs(on_sheet @ plane[:3] + plane[3]).max()),
    )
