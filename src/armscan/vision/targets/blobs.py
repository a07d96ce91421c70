# SPDX-License-Identifier: Apache-2.0
"""Candidate circles: contours that are ellipses, at several threshold scales, both polarities."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.vision.targets.grey import Grey8
from armscan.vision.targets.options import TargetOptions

BLOCK_FRACTIONS = (1 / 40, 1 / 12, 1 / 4)
"""Sides of the squares over which a threshold is the local mean, as fractions of the image."""
MAX_ROUNDNESS_ERROR = 0.12
"""Largest deviation of a contour from its ellipse of inertia, as a fraction of the radius."""
MIN_AXIS_RATIO = 0.25
SAME_LOG_AREA = 1.0
"""Blobs around one place whose areas differ by less than this, in logarithm, are one blob found at
several thresholds; a target's circles never nest."""
_PIXEL_ERROR = 1.0
_NOISE_SIGMAS = 5.0
_PARENT = 3


@dataclass(frozen=True, slots=True, eq=False)
class Blobs:
    """Ellipse-shaped blobs.

    Parameters
    ----------
    centres_px
        (N, 2) centres, image pixels.
    shapes_px2
        (N, 2, 2) matrices S with ``d' S^-1 d = 1`` on the rim, ``d`` from the centre.
    is_light
        (N,) True for a light blob on a dark ground.
    """

    centres_px: FloatArray
    shapes_px2: FloatArray
    is_light: BoolArray

    def __len__(self) -> int:
        """Count of blobs."""
        return len(self.centres_px)

    def subset(self, chosen: BoolArray) -> Blobs:
        """Return the chosen blobs."""
        return Blobs(self.centres_px[chosen], self.shapes_px2[chosen], self.is_light[chosen])


def find_blobs(grey8: Grey8, options: TargetOptions, same_log_area: float = SAME_LOG_AREA) -> Blobs:
    """Return every contour that is an ellipse within the range of sizes, once.

    A blob found at several threshold scales is kept where its contour is roundest.

    Parameters
    ----------
    grey8
        The image.
    options
        Sizes and contrast.
    same_log_area
        Where circles nest, less than `SAME_LOG_AREA`, so that their rims stay apart.
    """
    rows: list[tuple[float, ...]] = []
    margin = max(255.0 * options.min_contrast / 2.0, _NOISE_SIGMAS * _noise(grey8))
    for fraction in BLOCK_FRACTIONS:
        block = max(11, round(fraction * max(grey8.shape)) | 1)
        mean = cv2.boxFilter(grey8, -1, (block, block), borderType=cv2.BORDER_REPLICATE)
        for is_light in (True, False):
            difference = cv2.subtract(grey8, mean) if is_light else cv2.subtract(mean, grey8)
            _, binary = cv2.threshold(difference, margin, 255, cv2.THRESH_BINARY)
            contours, hierarchy = cv2.findContours(binary, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            rows += [
                (*ellipse, float(is_light))
                for contour, links in zip(contours, _links(hierarchy), strict=True)
                if links[_PARENT] < 0
                and (ellipse := _ellipse_of(np.asarray(contour), options)) is not None
            ]
    table = np.array(rows).reshape(-1, 7)
    table = table[np.argsort(table[:, 5], kind="stable")]
    table = table[_first_of_each(table, same_log_area)]
    shapes = table[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Blobs(table[:, :2].copy(), shapes, table[:, 6] > 0.5)


def _links(hierarchy: object) -> IntArray:
    """OpenCV's contour hierarchy as (N, 4); empty if there is no contour."""
    return np.zeros((0, 4), np.int64) if hierarchy is None else np.asarray(hierarchy)[0]


def _noise(grey8: Grey8) -> float:
    """Standard deviation of the pixel noise, from second differences along rows."""
    rows = grey8[::8].astype(np.float64)
    second = rows[:, 2:] - 2.0 * rows[:, 1:-1] + rows[:, :-2]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))


def _ellipse_of(
    contour: np.ndarray[tuple[int, ...], np.dtype[np.int32]], options: TargetOptions
) -> tuple[float, float, float, float, float, float] | None:
    """Centre u, v, shape uu, uv, vv and roundness error of a contour, if it is an ellipse."""
    if len(contour) < 2.0 * options.min_circle_px:
        return None
    low = contour.reshape(-1, 2).min(axis=0)
    high = contour.reshape(-1, 2).max(axis=0)
    extent = float((high - low).max())
    if not options.min_circle_px - 2.0 <= extent <= options.max_circle_px:
        return None
    moments = cv2.moments(contour)
    area = moments["m00"]
    if area < 0.4 * options.min_circle_px**2:
        return None
    centre = np.array([moments["m10"], moments["m01"]]) / area
    inertia = (
        4.0
        / area
        * np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]])
    )
    eigenvalues = np.linalg.eigvalsh(inertia)
    if eigenvalues[0] < MIN_AXIS_RATIO**2 * eigenvalues[1] or eigenvalues[0] < 4.0:
        return None
    offset = contour.reshape(-1, 2) - centre
    radius = np.sqrt(np.einsum("ki,ij,kj->k", offset, np.linalg.inv(inertia), offset))
    error = float(np.abs(radius - 1.0).max())
    if error > MAX_ROUNDNESS_ERROR + _PIXEL_ERROR / np.sqrt(eigenvalues[0]):
        return None
    # The contour runs through the centres of border pixels: half a pixel inside the rim.
    grown = inertia * (1.0 + 0.5 / np.sqrt(eigenvalues.mean())) ** 2
    return centre[0], centre[1], grown[0, 0], grown[0, 1], grown[1, 1], error


def _first_of_each(table: FloatArray, same_log_area: float) -> BoolArray:
    """Keep the first of all blobs whose centres lie within a third of its short half axis."""
    kept = np.ones(len(table), dtype=np.bool_)
    if not len(table):
        return kept
    tree = cKDTree(table[:, :2])
    area = np.sqrt(np.maximum(table[:, 2] * table[:, 4] - table[:, 3] ** 2, 0.0))
    for k, row in enumerate(table):
        if not kept[k]:
            continue
        near = np.array(tree.query_ball_point(row[:2], 0.35 * np.sqrt(area[k])), dtype=np.int64)
        same = (near > k) & (table[near, 6] == row[6])
        same &= np.abs(np.log(area[near] / area[k])) < same_log_area
        kept[near[same]] = False
    return kept
