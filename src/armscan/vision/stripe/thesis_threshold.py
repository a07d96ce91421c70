# SPDX-License-Identifier: Apache-2.0
"""The thesis's first method: geometric centre between the threshold's two crossings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.vision.stripe.centres import StripeCentres, find_thesis_runs
from armscan.vision.stripe.level import ImageLevel
from armscan.vision.stripe.thesis_hessian import ridge_normals


def threshold_centres(
    image: NDArray[np.float32], level: ImageLevel, line_sigma_px: float
) -> StripeCentres:
    """Middle of each run of pixels above the threshold (section 2.3.2.1, first method).

    Simple, whole half pixels only, and as good as the line's edges are.

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
    points = runs.points(np.asarray(0.5 * (runs.first + runs.stop - 1), dtype=np.float64))
    return StripeCentres(points, ridge_normals(image, points, line_sigma_px))
