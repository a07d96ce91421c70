# SPDX-License-Identifier: Apache-2.0
"""The thesis's four methods (section 2.3.2.1): threshold, centroid, template, Hessian."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.stripe.ridge import gaussian_taps
from armscan.vision.stripe.ridge import (
    CELL_PX,
    LONGEST_RUN_PX,
    FloatImage,
    ImageLevel,
    RidgePoints,
    hessian_sigma,
    least_bend,
    link,
)

SHORTEST_RUN_PX = 2


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Stretches of pixels above the threshold, all down the columns or all along the rows.

    ``is_down``: True if the runs go down the columns. ``lines``: (N,) column or row of each run.
    ``first``, ``stop``: (N,) first pixel of each run and the one after its last. ``heights``:
    (lines, pixels) image less background, rows are the columns or rows of the image.
    """

    is_down: bool
    lines: IntArray
    first: IntArray
    stop: IntArray
    heights: FloatImage

    def points(self, centres: FloatArray) -> FloatArray:
        """Image points (N, 2) from positions (N,) along the runs."""
        pair = (self.lines, centres) if self.is_down else (centres, self.lines)
        return np.stack(pair, axis=1).astype(np.float64)

    def sums(self, values: FloatArray) -> FloatArray:
        """Sum (N,) of values (lines, pixels) over each run."""
        running = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
        return np.asarray(running[self.lines, self.stop] - running[self.lines, self.first])


def above_background(image: FloatImage, level: ImageLevel) -> FloatImage:
    """Image (H, W) less its interpolated background."""
    rows, columns = (
        np.clip((np.arange(n) + 0.5) / CELL_PX - 0.5, 0.0, cells - 1.0)
        for n, cells in zip(image.shape, level.background.shape, strict=True)
    )
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    surface = map_coordinates(level.background, grid, order=1, mode="nearest")
    return np.asarray(image - surface, dtype=np.float32)


def find_thesis_runs(image: FloatImage, level: ImageLevel) -> Runs:
    """Runs above the threshold across the lines: down the columns unless rows give more."""
    heights = above_background(image, level)
    down = _runs(heights.T, True, level.rise)
    along = _runs(heights, False, level.rise)
    return down if len(down.lines) >= len(along.lines) else along


def _runs(heights: FloatImage, is_down: bool, rise: float) -> Runs:
    lit: BoolArray = heights > rise
    edges = np.diff(np.pad(lit, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    lines, first = np.nonzero(edges == 1)
    _, stop = np.nonzero(edges == -1)
    fits = (stop - first <= LONGEST_RUN_PX) & (stop - first >= SHORTEST_RUN_PX)
    return Runs(is_down, lines[fits], first[fits], stop[fits], heights)


HALF_PIXEL = 0.5


def hessian_centres(image: FloatImage, level: ImageLevel, line_sigma_px: float) -> FloatArray:
    """Points where the Taylor polynomial across the line peaks inside its own pixel.

    The image is convolved with the derivatives of a Gaussian (eq. 2.41; Steger 1998); the
    eigenvector of the eigenvalue of largest curvature is the normal.
    """
    scale = hessian_sigma(line_sigma_px)
    gx, gy, gxx, gxy, gyy = derivative_images(image, scale)
    normals, bend = _principal(gxx, gxy, gyy)
    lit = above_background(image, level) > level.rise
    lit &= bend > least_bend(level.rise, line_sigma_px, scale)
    y, x = np.nonzero(lit)
    n, b = normals[y, x], bend[y, x]
    step = (gx[y, x] * n[:, 0] + gy[y, x] * n[:, 1]) / b
    offset = step[:, None] * n
    inside = (np.abs(offset) <= HALF_PIXEL).all(axis=1)
    points = np.stack([x, y], axis=1)[inside] + offset[inside]
    return np.column_stack([points, n[inside]])


def derivative_images(image: FloatImage, scale_px: float) -> tuple[FloatImage, ...]:
    """Images d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2 of the image smoothed at ``scale_px``."""
    g0, g1, g2 = gaussian_taps(scale_px)
    pairs = ((g1, g0), (g0, g1), (g2, g0), (g1, g1), (g0, g2))
    border = cv2.BORDER_REPLICATE
    return tuple(
        np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, a, b, borderType=border), dtype=np.float32)
        for a, b in pairs
    )


def ridge_normals(image: FloatImage, points: FloatArray, line_sigma_px: float) -> FloatArray:
    """Unit normals (N, 2) of the ridge at the pixels nearest to points (N, 2)."""
    _, _, gxx, gxy, gyy = derivative_images(image, hessian_sigma(line_sigma_px))
    x, y = np.rint(points).astype(np.int64).T
    normals, _ = _principal(gxx[y, x], gxy[y, x], gyy[y, x])
    return normals


def _principal(gxx: FloatImage, gxy: FloatImage, gyy: FloatImage) -> tuple[FloatArray, FloatArray]:
    """Normals (..., 2) and negative second derivative (...) along them."""
    half = 0.5 * (gxx - gyy).astype(np.float64)
    root = np.hypot(half, gxy)
    is_steep = half < 0.0
    nx = np.where(is_steep, root - half, -gxy)
    ny = np.where(is_steep, -gxy, root + half)
    length = np.hypot(nx, ny)
    flat = length <= 0.0
    length = np.where(flat, 1.0, length)
    normals = np.stack([np.where(flat, 1.0, nx / length), ny / length], axis=-1)
    return normals, root - 0.5 * (gxx + gyy)


def threshold_centres(image: FloatImage, level: ImageLevel, line_sigma_px: float) -> FloatArray:
    """Middle of each run of pixels above the threshold (section 2.3.2.1, first method).

    Simple, whole half pixels only, and as good as the line's edges are.
    """
    runs = find_thesis_runs(image, level)
    points = runs.points(np.asarray(0.5 * (runs.first + runs.stop - 1), dtype=np.float64))
    return np.column_stack([points, ridge_normals(image, points, line_sigma_px)])


def centroid_centres(image: FloatImage, level: ImageLevel, line_sigma_px: float) -> FloatArray:
    """Centre of gravity of the grey levels above the background in each run (eq. 3.1)."""
    runs = find_thesis_runs(image, level)
    heights = runs.heights.astype(np.float64)
    weight = runs.sums(heights)
    moment = runs.sums(heights * np.arange(heights.shape[1]))
    points = runs.points(moment / weight)
    return np.column_stack([points, ridge_normals(image, points, line_sigma_px)])


ANGLES_DEG = (0.0, 45.0, 90.0, 135.0)
HALF_LENGTH_SIGMAS = 2.0


def direction_template(angle_deg: float, line_sigma_px: float) -> FloatImage:
    """A short piece of line at ``angle_deg`` from the x axis: Gaussian across, even along."""
    half = max(int(np.ceil(HALF_LENGTH_SIGMAS * line_sigma_px)), 2)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    angle = np.radians(angle_deg)
    across = np.cos(angle) * y - np.sin(angle) * x
    template = np.exp(-0.5 * (across / line_sigma_px) ** 2) * (np.hypot(x, y) <= half + 0.5)
    return np.asarray(template / template.sum(), dtype=np.float32)


def template_centres(image: FloatImage, level: ImageLevel, line_sigma_px: float) -> FloatArray:
    """Pixel of each run where the best of four direction templates answers most strongly.

    Withstands noise and bridges small breaks, to whole pixels (section 2.3.2.1, third method).
    """
    answers = np.stack(
        [cv2.filter2D(image, -1, direction_template(a, line_sigma_px)) for a in ANGLES_DEG]
    )
    best = answers.max(axis=0)
    runs = find_thesis_runs(image, level)
    lines = best.T if runs.is_down else best
    spans = zip(runs.lines, runs.first, runs.stop, strict=True)
    peaks = [first + int(np.argmax(lines[line, first:stop])) for line, first, stop in spans]
    points = runs.points(np.array(peaks, dtype=np.float64))
    x, y = points.astype(np.int64).T
    angle = np.radians(np.array(ANGLES_DEG)[answers[:, y, x].argmax(axis=0)])
    return np.column_stack([points, -np.sin(angle), np.cos(angle)])


CentreFinder = Callable[[FloatImage, ImageLevel, float], FloatArray]
"""From an image (H, W), its background and threshold, and the typical sigma of its lines to centre
points without order: rows (N, 4) of x, y in image pixels and the unit normal, of either sign."""

THESIS_METHODS: Mapping[str, CentreFinder] = MappingProxyType(
    {
        "threshold": threshold_centres,
        "centroid": centroid_centres,
        "template": template_centres,
        "hessian": hessian_centres,
    }
)

ROUNDING_PX: Mapping[str, float] = MappingProxyType(
    {"threshold": float(np.sqrt(1.0 / 24.0)), "template": float(np.sqrt(1.0 / 12.0))}
)
"""Standard deviation of what rounding to pixels puts beside the line, also where points scatter by
nothing: of one whole pixel, and of half the sum of two edges in whole pixels. On synthetic lines
almost without noise, over all places within a pixel, the centres lie 0.290 px and, by their width,
0.10 to 0.19 px beside the truth; more noise moves edges and leaves less."""


def link_centres(centres: FloatArray, image: FloatImage) -> RidgePoints:
    """Order a method's points along chains; the curvature column holds the grey level."""
    table = np.zeros((len(centres), 6))
    table[:, :2] = np.clip(centres[:, :2], 0.0, np.array(image.shape[::-1]) - 1.0)
    table[:, 2:4] = centres[:, 2:]
    x, y = np.rint(table[:, :2]).astype(np.int64).T
    table[:, 4] = image[y, x]
    return link(table)
