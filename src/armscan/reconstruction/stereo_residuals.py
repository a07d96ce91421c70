# SPDX-License-Identifier: Apache-2.0
"""Left stripe points on their possible sheets, seen by the right camera (eqs. 4.11, 4.17, 4.18)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.calibration import SensorCalibration
from armscan.models.two_views import TwoViews
from armscan.reconstruction.choose_sheet import DepthRange
from armscan.reconstruction.triangulate import N_CAMERA, N_SHEET
from armscan.records.profile import Profile

ALONG_PX = 2.0
"""A projected point farther than this beyond a stripe's end does not lie beside the stripe."""
SINE_OF_SAME_DIRECTION = 0.42
"""The projected stripe runs along the right one within 25 degrees."""
BOW_DEPTH_SHARE = 0.03
"""Part of the depth by which a bow may move a point from its place on the plane."""


@dataclass(frozen=True, slots=True, eq=False)
class Projections:
    """Left stripe points, each on one sheet, in the right image.

    Parameters
    ----------
    sheet
        (H,) index into the sensor's sheets.
    points_mm
        (H, 3) in the Sensor frame (eq. 4.11).
    q_px
        (H, 2) pixels of the right image (eqs. 4.17 and 4.18).
    is_met
        (H,) False where the ray does not meet the sheet in front of both cameras.
    point_by_px
        (H, 3, 2) derivative of the point by the left pixel.
    point_by_sensor
        (H, 3, 17) by the left camera and the sheet.
    q_by_point
        (H, 2, 3) derivative of the right pixel by the point.
    q_by_second
        (H, 2, 15) by what the second camera adds, at a fixed point.
    """

    sheet: IntArray
    points_mm: FloatArray
    q_px: FloatArray
    is_met: BoolArray
    point_by_px: FloatArray
    point_by_sensor: FloatArray
    q_by_point: FloatArray
    q_by_second: FloatArray

    def q_by_sensor(self) -> FloatArray:
        """(H, 2, 32) derivative of the right pixel by all parameters of the point's sheet."""
        return np.concatenate([self.q_by_point @ self.point_by_sensor, self.q_by_second], axis=2)

    def select(self, chosen: BoolArray | IntArray) -> Projections:
        """Those that a mask or an index names."""
        return Projections(
            self.sheet[chosen],
            self.points_mm[chosen],
            self.q_px[chosen],
            self.is_met[chosen],
            self.point_by_px[chosen],
            self.point_by_sensor[chosen],
            self.q_by_point[chosen],
            self.q_by_second[chosen],
        )


def possible_sheets(
    points_px: FloatArray, sensor: SensorCalibration, depths: DepthRange
) -> tuple[IntArray, IntArray]:
    """Pairs of point and sheet whose planes meet within the depths accepted, widened for the bow.

    Returns
    -------
    point, sheet
        (H,) indices, ordered by point.
    """
    xy, is_valid = sensor.camera.camera.undistort(points_px)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    planes = np.stack([s.sheet.plane for s in sensor.sheets])
    slope = rays @ planes[:, :3].T
    depth = -planes[:, 3] / np.where(np.abs(slope) > 1e-9, slope, np.nan)
    limits = np.array([depths.limits_mm(s) for s in sensor.sheets])
    low, high = limits[:, 0] * (1.0 - BOW_DEPTH_SHARE), limits[:, 1] * (1.0 + BOW_DEPTH_SHARE)
    with np.errstate(invalid="ignore"):
        inside = (depth >= low) & (depth <= high) & is_valid[:, None]
    point, sheet = np.nonzero(inside)
    return point, sheet


def project_on_sheets(
    points_px: FloatArray, sheet: IntArray, sensor: SensorCalibration
) -> Projections:
    """Put each left pixel (H, 2) on its sheet (H,) and project it into the right camera."""
    camera = sensor.camera.camera
    xy, has_ray, xy_by_px, xy_by_camera = camera.undistort_with_jacobian(points_px)
    n = len(points_px)
    points = np.tile([0.0, 0.0, 1.0], (n, 1))
    point_by_xy, by_sheet = np.zeros((n, 3, 2)), np.zeros((n, 3, N_SHEET))
    is_met = np.zeros(n, dtype=np.bool_)
    for k, calibrated in enumerate(sensor.sheets):
        own = np.flatnonzero(has_ray & (sheet == k))
        if not len(own):
            continue
        found, met, by_xy, by_parameters = calibrated.sheet.intersect_with_jacobian(xy[own])
        own = own[met]
        is_met[own] = True
        points[own], point_by_xy[own], by_sheet[own] = found[met], by_xy[met], by_parameters[met]
    by_sensor = np.zeros((n, 3, N_CAMERA + N_SHEET))
    by_sensor[:, :, :N_CAMERA] = point_by_xy @ xy_by_camera
    by_sensor[:, :, N_CAMERA:] = by_sheet
    q, by_point, by_second = TwoViews.of_sensor(sensor).project_right_with_jacobian(points)
    is_met &= np.isfinite(q).all(axis=1)
    return Projections(
        sheet, points, q, is_met, point_by_xy @ xy_by_px, by_sensor, by_point, by_second
    )


@dataclass(frozen=True, slots=True, eq=False)
class RightStripes:
    """The right profile, ready for the search of the nearest stripe.

    Parameters
    ----------
    profile
        Stripe points of the right camera.
    row
        (R,) the accepted ones.
    tree
        Of their pixels.
    """

    profile: Profile
    row: IntArray
    tree: cKDTree

    @staticmethod
    def of(profile: Profile) -> RightStripes:
        """Index the accepted points."""
        row = np.flatnonzero(profile.is_accepted)
        return RightStripes(profile, row, cKDTree(profile.points_px[row]))

    def spacing_px(self) -> float:
        """Mean distance between stripes: the picture's area over the stripes' length."""
        if len(self.row) < 2:
            return 1.0
        size = np.ptp(self.profile.points_px[self.row], axis=0)
        return max(float(size[0] * size[1]) / len(self.row), 1.0)

    def covers(self, q_px: FloatArray) -> BoolArray:
        """(H,) True within the rectangle in which there are right stripes."""
        points = self.profile.points_px[self.row]
        if not len(points):
            return np.zeros(len(q_px), dtype=np.bool_)
        low, high = points.min(axis=0), points.max(axis=0)
        return np.asarray(((q_px >= low) & (q_px <= high)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """The right stripe beside each projected point.

    Parameters
    ----------
    row
        (H,) index of the nearest point in the right profile; -1 where no stripe is within reach.
    residual_px
        (H,) signed distance of the projected point across that stripe, along its normal.
    sigma_px
        (H,) standard deviation of the residual from the noise of both stripes alone.
    normal
        (H, 2) across the right stripe.
    """

    row: IntArray
    residual_px: FloatArray
    sigma_px: FloatArray
    normal: FloatArray

    @property
    def is_found(self) -> BoolArray:
        """(H,) True where there is a stripe within reach."""
        return np.asarray(self.row >= 0)

    def select(self, chosen: BoolArray | IntArray) -> Crossings:
        """Those that a mask or an index names."""
        return Crossings(
            self.row[chosen], self.residual_px[chosen], self.sigma_px[chosen], self.normal[chosen]
        )


def find_crossings(
    projected: Projections,
    normals_px: FloatArray,
    sigma_px: FloatArray,
    right: RightStripes,
    reach_px: float,
) -> Crossings:
    """Find the right stripe that runs beside each projected point, and the distance across it.

    Parameters
    ----------
    projected
        (H,) left points on sheets.
    normals_px, sigma_px
        (H, 2) and (H,) of the left stripe.
    right
        The right profile.
    reach_px
        Largest distance.
    """
    n = len(projected.sheet)
    row = np.full(n, -1)
    residual, sigma, normal = np.zeros(n), np.ones(n), np.zeros((n, 2))
    asked = np.flatnonzero(projected.is_met)
    if not len(right.row) or not len(asked):
        return Crossings(row, residual, sigma, normal)
    distance, nearest = right.tree.query(
        projected.q_px[asked], distance_upper_bound=float(np.hypot(reach_px, ALONG_PX))
    )
    is_near = np.isfinite(distance)
    asked, nearest = asked[is_near], np.asarray(nearest)[is_near]
    found = right.row[nearest]
    n_right = right.profile.normals_px[found]
    away = projected.q_px[asked] - right.profile.points_px[found]
    across = np.sum(away * n_right, axis=1)
    along = away[:, 0] * -n_right[:, 1] + away[:, 1] * n_right[:, 0]
    by_left = projected.q_by_point[asked] @ projected.point_by_px[asked]
    tangent = np.stack([-normals_px[asked, 1], normals_px[asked, 0]], axis=1)
    runs = np.einsum("nij,nj->ni", by_left, tangent)
    sine = np.abs(np.sum(runs * n_right, axis=1)) / np.maximum(np.linalg.norm(runs, axis=1), 1e-12)
    good = (np.abs(along) <= ALONG_PX) & (np.abs(across) <= reach_px)
    good &= sine <= SINE_OF_SAME_DIRECTION
    gain = np.einsum("ni,nij,nj->n", n_right, by_left, normals_px[asked])
    at = asked[good]
    row[at], residual[at], normal[at] = found[good], across[good], n_right[good]
    sigma[at] = np.hypot(gain * sigma_px[asked], right.profile.sigma_px[found])[good]
    return Crossings(row, residual, sigma, normal)
