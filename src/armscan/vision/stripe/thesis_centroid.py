# SPDX-License-Identifier: Apache-2.0
"""The thesis's second method: grey centroid of the line's pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.vision.stripe.centres import StripeCentres, find_thesis_runs
from armscan.vision.stripe.level import ImageLevel
from armscan.vision.stripe.thesis_hessian import ridge_normals


def centroid_centres(
    image: NDArray[np.float32], level: ImageLevel, line_sigma_px: float
) -> StripeCentres:
    """Centre of gravity of the grey levels above the background in each run (eq. 3.1).

    Parameters
    ----------
    image
        (H, W) float32.
    level
        Background and threshold.
    line_sigma_px
        Typical sigma of the lines, for the normals.
    """
    runs = find_thesis_runs(image, level)
    heights = runs.heights.astype(np.float64)
    weight = runs.sums(heights)
    moment = runs.sums(heights * np.arange(heights.shape[1]))
    points = runs.points(moment / weight)
    return StripeCentres(points, ridge_normals(image, points, line_sigma_px))
