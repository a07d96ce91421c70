# SPDX-License-Identifier: Apache-2.0
"""Pairs of rings in two cameras that may be one marker: epipolar distance, depth, ring size;
the options of stereo matching.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import OptionError
from armscan.geometry.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    homogeneous,
    ints,
)
from armscan.models.camera import CameraModel
from armscan.models.two_views import (
    TwoViews,
    epipolar_distances_px,
    sampson_distances_px,
    triangulate_points,
)
from armscan.records.points import RingImages

MAX_SIGMAS = 4.0
"""Threshold on the epipolar distance (delta of eq. 4.27), in its standard deviations: of true pairs
one in 16,000 is lost."""
UNMODELLED_PX = 0.01
"""Standard deviation, an axis, that is added to each centre for what its covariance cannot know:
print, light and lens across the ring."""


@dataclass(frozen=True, slots=True)
class RingMatchOptions:
    """What is known of the markers before rings in two images are matched.

    Parameters
    ----------
    depth_mm
        Nearest and farthest Z of a marker in the Sensor frame; None for all that lie ahead.
    diameter_mm
        Outer diameter of the markers; None if not known.
    size_tolerance
        Largest difference, as a fraction, of the diameters that the two images of one marker show,
        and of each from ``diameter_mm``.
    """

    depth_mm: tuple[float, float] | None = None
    diameter_mm: float | None = None
    size_tolerance: float = 0.04

    def __post_init__(self) -> None:
        if self.depth_mm is not None and not 0.0 <= self.depth_mm[0] < self.depth_mm[1]:
            raise OptionError(
                f"a depth range of {self.depth_mm[0]:g} to {self.depth_mm[1]:g} mm",
                remedy="give the nearer depth first",
            )
        if self.diameter_mm is not None and not self.diameter_mm > 0.0:
            raise OptionError(f"a marker of {self.diameter_mm:g} mm diameter")


def parse_depth(text: str) -> tuple[float, float]:
    """Nearest and farthest depth in mm from ``NEAR:FAR``.

    Raises
    ------
    OptionError
        If the text is not two numbers with a colon between them.
    """
    try:
        near, far = (float(word) for word in text.split(":"))
    except ValueError as error:
        raise OptionError(
            f"'{text}' is no range of depths", remedy="write it as 100:180, in mm"
        ) from error
    return near, far


def diameters_mm(
    rings: RingImages, rows: IntArray, camera: CameraModel, points_camera_mm: FloatArray
) -> FloatArray:
    """Outer diameters of rings ``rows`` (K,) of an image at places (K, 3) in its camera's frame.

    The longer half axis of a circle's image, as an angle at the camera, is radius over distance
    whatever the tilt, to second order in that angle (0.0004 for 6 mm at 140 mm). As an angle,
    because the image itself stretches what lies off its axis.
    """
    angle, half = rings.direction_rad[rows], rings.outer_half_px[rows]
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    axes_px = np.stack([half[:, 1:] * along, half[:, :1] * across], axis=2)
    xy, _, by_px, _ = camera.undistort_with_jacobian(rings.centres_px[rows])
    rays = homogeneous(xy)
    length = np.linalg.norm(rays, axis=1)[:, None]
    unit = rays / length
    axes = np.concatenate([by_px @ axes_px, np.zeros((len(rows), 1, 2))], axis=1)
    # Only what is across the ray turns it.
    axes = (axes - unit[:, :, None] * np.einsum("ni,nij->nj", unit, axes)[:, None]) / length[
        ..., None
    ]
    longest = np.linalg.svd(axes, compute_uv=False)[:, 0]
    return np.asarray(2.0 * longest * np.linalg.norm(points_camera_mm, axis=1))


_FIRST_LOOK_PX = 30.0
"""Pairs further than this from the epipolar constraint are not looked at more closely."""


class CandidatePairs(RowRecord):
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
        (K, 3, 3) its covariance from the centres alone, `UNMODELLED_PX` included.
    diameter_mm
        (K,) how large it would be: geometric mean of what the two images show.
    """

    left: IntArray = ints("N")
    right: IntArray = ints("N")
    distance_px: FloatArray = floats("N")
    sigma_px: FloatArray = floats("N")
    points_mm: FloatArray = floats("N", 3)
    covariance_mm2: FloatArray = floats("N", 3, 3)
    diameter_mm: FloatArray = floats("N")


def find_candidates(
    left: RingImages,
    right: RingImages,
    views: TwoViews,
    calibration_covariance: FloatArray,
    options: RingMatchOptions,
) -> CandidatePairs:
    """Pairs within the epipolar threshold, the depth range, and of one size.

    The thesis sets ``p_r' F p_l < 0.01`` (eq. 4.27), an algebraic value whose meaning changes
    across the image. Here the value is divided by its gradient, so that it is a distance in
    pixels, its absolute value is compared, and the threshold follows from its own standard
    deviation.

    ``calibration_covariance`` is (24, 24) in the order of
    `armscan.models.two_views.STEREO_PARAMETER_NAMES`.
    """
    rows, columns = (grid.ravel() for grid in np.indices((len(left), len(right))))
    rough = sampson_distances_px(
        *epipolar_distances_px(views, left.centres_px[rows], right.centres_px[columns])
    )
    is_near = np.abs(rough) < _FIRST_LOOK_PX
    rows, columns = rows[is_near], columns[is_near]
    left_px, right_px = left.centres_px[rows], right.centres_px[columns]
    unmodelled = UNMODELLED_PX**2 * np.eye(2)
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
    is_near = points.is_valid & (np.abs(distance) < MAX_SIGMAS * sigma)
    is_near &= _is_in_depth(shown, views, options)
    is_near &= _is_of_one_size(in_left, in_right, options)
    diameter = np.sqrt(in_left * in_right)
    pairs = CandidatePairs(
        left=rows,
        right=columns,
        distance_px=distance,
        sigma_px=sigma,
        points_mm=shown,
        covariance_mm2=points.noise_mm2,
        diameter_mm=diameter,
    )
    return pairs.select(is_near)


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


def _is_in_depth(points_mm: FloatArray, views: TwoViews, options: RingMatchOptions) -> BoolArray:
    """True ahead of both cameras and, where a range is given, within it."""
    depth = points_mm[:, 2]
    ahead = (depth > 0.0) & (views.points_right_mm(points_mm)[:, 2] > 0.0)
    if options.depth_mm is None:
        return np.asarray(ahead)
    low, high = options.depth_mm
    return np.asarray(ahead & (depth >= low) & (depth <= high))


def _is_of_one_size(
    in_left: FloatArray, in_right: FloatArray, options: RingMatchOptions
) -> BoolArray:
    """True where both images show a ring of one diameter, the one given if there is one."""
    tolerance = options.size_tolerance
    is_one = np.abs(np.log(in_left / in_right)) < tolerance
    if options.diameter_mm is not None:
        is_one &= np.abs(np.log(in_left / options.diameter_mm)) < tolerance
        is_one &= np.abs(np.log(in_right / options.diameter_mm)) < tolerance
    return np.asarray(is_one)
