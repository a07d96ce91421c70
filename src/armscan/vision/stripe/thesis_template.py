# SPDX-License-Identifier: Apache-2.0
"""The thesis's third method: direction templates."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray
from armscan.vision.stripe.centres import StripeCentres, find_thesis_runs
from armscan.vision.stripe.level import ImageLevel

ANGLES_DEG = (0.0, 45.0, 90.0, 135.0)
HALF_LENGTH_SIGMAS = 2.0


def direction_template(angle_deg: float, line_sigma_px: float) -> NDArray[np.float32]:
    """A short piece of line at ``angle_deg`` from the x axis: Gaussian across, even along."""
    half = max(int(np.ceil(HALF_LENGTH_SIGMAS * line_sigma_px)), 2)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    angle = np.radians(angle_deg)
    across = np.cos(angle) * y - np.sin(angle) * x
    template = np.exp(-0.5 * (across / line_sigma_px) ** 2) * (np.hypot(x, y) <= half + 0.5)
    return np.asarray(template / template.sum(), dtype=np.float32)


def template_centres(
    image: NDArray[np.float32], level: ImageLevel, line_sigma_px: float
) -> StripeCentres:
    """Pixel of each run where the best of four direction templates answers most strongly.

    Withstands noise and bridges small breaks, to whole pixels (section 2.3.2.1, third method).

    Parameters
    ----------
    image
        (H, W) float32.
    level
        Background and threshold.
    line_sigma_px
        Sigma across the templates.
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
    normals: FloatArray = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    return StripeCentres(points, normals)
