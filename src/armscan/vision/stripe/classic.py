# SPDX-License-Identifier: Apache-2.0
"""The thesis's four methods (section 2.3.2.1) as profiles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from armscan.vision.stripe.centres import StripeCentres
from armscan.vision.stripe.level import ImageLevel
from armscan.vision.stripe.ridge import RidgePoints, link
from armscan.vision.stripe.thesis_centroid import centroid_centres
from armscan.vision.stripe.thesis_hessian import hessian_centres
from armscan.vision.stripe.thesis_template import template_centres
from armscan.vision.stripe.thesis_threshold import threshold_centres

CentreFinder = Callable[[NDArray[np.float32], ImageLevel, float], StripeCentres]

THESIS_METHODS: Mapping[str, CentreFinder] = MappingProxyType(
    {
        "threshold": threshold_centres,
        "centroid": centroid_centres,
        "template": template_centres,
        "hessian": hessian_centres,
    }
)


def link_centres(centres: StripeCentres, image: NDArray[np.float32]) -> RidgePoints:
    """Order a method's points along chains; the curvature column holds the grey level."""
    n = len(centres.points_px)
    table = np.zeros((n, 6))
    table[:, :2] = np.clip(centres.points_px, 0.0, np.array(image.shape[::-1]) - 1.0)
    table[:, 2:4] = centres.normals
    x, y = np.rint(table[:, :2]).astype(np.int64).T
    table[:, 4] = image[y, x]
    return link(table, image.shape)
