# SPDX-License-Identifier: Apache-2.0
"""Pairs of ring images that may show one marker, by epipolar distance (eqs. 4.26 and 4.27)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.markers.matching_options import MatchingOptions
from armscan.markers.ring_size import diameters_mm
from armscan.models.stereo_points import triangulate_points
from armscan.models.two_views import TwoViews, epipolar_distances_px, sampson_distances_px
from armscan.records.markers import RingImages

_FIRST_LOOK_PX = 30.0
"""Pairs further than this from the epipolar constraint are not looked at more closely."""


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePairs:
    """K pairs of a left and a right ring that satisfy the epipolar constraint.

    Parameters
    ----------
    left, right
        (K,) rows of the ring images.
    distance_px, sigma_px
        (K,) distance from the constraint when both points may move (eq. 4.26 in pixels), and its
        standard deviation from both centres' covariances and the calibration's.
    points_mm
        (K, 3) where the marker would be, Sensor frame.
    covariance_mm2
        (K, 3, 3) its covariance from the centres alone, ``unmodelled_px`` included.
    diameter_mm
        (K,) how large it would be: geometric mean of what the two images show.
    """

    left: IntArray
    right: IntArray
    distance_px: FloatArray
    sigma_px: FloatArray
    points_mm: FloatArray
    covariance_mm2: FloatArray
    diameter_mm: FloatArray

    def __len__(self) -> int:
        """Count of pairs."""
        return len(self.left)

    def subset(self, chosen: BoolArray | IntArray) -> CandidatePairs:
        """Return some of the pairs."""
        return CandidatePairs(*(getattr(self, field.name)[chosen] for field in fields(self)))


def find_candidates(
    left: RingImages,
    right: RingImages,
    views: TwoViews,
    calibration_covariance: FloatArray,
    options: MatchingOptions,
) -> CandidatePairs:
    """Pairs within the epipolar threshold, the depth range, and of one size.

    The thesis sets ``p_r' F p_l < 0.01`` (eq. 4.27), an algebraic value whose meaning changes
    across the image. Here the value is divided by its gradient, so that it is a distance in
    pixels, its absolute value is compared, and the threshold follows from its own standard
    deviation.

    Parameters
    ----------
    left, right
        Rings in the two images.
    views
        The cameras.
    calibration_covariance
        (24, 24) in the order of `armscan.models.stereo.STEREO_PARAMETER_NAMES`.
    options
        Thresholds.
    """
    rows, columns = (grid.ravel() for grid in np.indices((len(left), len(right))))
    rough = sampson_distances_px(
        *epipolar_distances_px(views, left.centres_px[rows], right.centres_px[columns])
    )
    is_near = np.abs(rough) < _FIRST_LOOK_PX
    rows, columns = rows[is_near], columns[is_near]
    left_px, right_px = left.centres_px[rows], right.centres_px[columns]
    unmodelled = options.unmodelled_px**2 * np.eye(2)
    left_spread = left.covariance_px2[rows] + unmodelled
    right_spread = right.covariance_px2[columns] + unmodelled
    points = triangulate_points(views, left_px, right_px, left_spread, right_spread)
    shown = np.where(points.is_valid[:, None], points.points_sensor_mm, [0.0, 0.0, 1.0])
    spread = np.zeros((len(rows), 4, 4))
    spread[:, :2, :2], spread[:, 2:, 2:] = left_spread, right_spread
    observed = np.concatenate([left_px, right_px], axis=1)
    distance, sigma = _misclosure(views, shown, observed, spread, calibration_covariance)
    in_left = diameters_mm(left, rows, views.left, shown)
    in_right = diameters_mm(right, columns, views.right, views.points_right_mm(shown))
    is_near = points.is_valid & (np.abs(distance) < options.max_sigmas * sigma)
    is_near &= _is_in_depth(shown, views, options)
    is_near &= _is_of_one_size(in_left, in_right, options)
    diameter = np.sqrt(in_left * in_right)
    pairs = CandidatePairs(rows, columns, distance, sigma, shown, points.noise_mm2, diameter)
    return pairs.subset(is_near)


def _misclosure(
    views: TwoViews,
    points_mm: FloatArray,
    observed_px: FloatArray,
    spread: FloatArray,
    calibration_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Signed distance (N,) of pairs from the epipolar constraint and its sigma.

    Of the four pixel coordinates of a pair, three go with the point's place; the distance is what
    is left along the fourth direction.
    """
    left, left_by_point, left_by_camera = views.left.project_with_jacobian(points_mm)
    right, right_by_point, right_by_second = views.project_right_with_jacobian(points_mm)
    by_point = np.concatenate([left_by_point, right_by_point], axis=1)
    by_parameters = np.zeros((len(points_mm), 4, len(calibration_covariance)))
    n_camera = left_by_camera.shape[2]
    by_parameters[:, :2, :n_camera] = left_by_camera
    by_parameters[:, 2:, n_camera:] = right_by_second
    across = np.linalg.svd(by_point)[0][:, :, 3]
    residual = observed_px - np.concatenate([left, right], axis=1)
    by_parameters = np.einsum("ni,nij->nj", across, by_parameters)
    variance = np.einsum("ni,nij,nj->n", across, spread, across)
    variance += np.einsum("ni,ij,nj->n", by_parameters, calibration_covariance, by_parameters)
    return np.einsum("ni,ni->n", across, residual), np.sqrt(variance)


def _is_in_depth(points_mm: FloatArray, views: TwoViews, options: MatchingOptions) -> BoolArray:
    """True ahead of both cameras and, where a range is given, within it."""
    depth = points_mm[:, 2]
    ahead = (depth > 0.0) & (views.points_right_mm(points_mm)[:, 2] > 0.0)
    if options.depth_mm is None:
        return np.asarray(ahead)
    low, high = options.depth_mm
    return np.asarray(ahead & (depth >= low) & (depth <= high))


def _is_of_one_size(
    in_left: FloatArray, in_right: FloatArray, options: MatchingOptions
) -> BoolArray:
    """True where both images show a ring of one diameter, the one given if there is one."""
    tolerance = options.size_tolerance
    is_one = np.abs(np.log(in_left / in_right)) < tolerance
    if options.diameter_mm is not None:
        is_one &= np.abs(np.log(in_left / options.diameter_mm)) < tolerance
        is_one &= np.abs(np.log(in_right / options.diameter_mm)) < tolerance
    return np.asarray(is_one)
