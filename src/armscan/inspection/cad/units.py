# SPDX-License-Identifier: Apache-2.0
"""Whether cloud and model are in one unit of length."""

from __future__ import annotations

import math

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.search import PoseCandidate, search_pose
from armscan.records.cloud import PointCloud

LEAST_POINTS = 100
UNITS = (("metres", "m", 1000.0), ("inches", "inch", 25.4), ("centimetres", "cm", 10.0))
"""In words, as ``--unit`` calls it, and in mm."""
TOO_LARGE, TOO_SMALL = 6.0, 0.004
"""Extent of a cloud over the part's: a scan on a table is no six times larger than its part, nor is
a scan worth its name so small."""
LIKELY_SMALL = 0.2
"""A cloud is tried in another unit if it is larger than this over the part's extent then."""
DOUBTFUL = 0.001
"""Scatter over the cloud's extent above which other units are tried: tens of times that of a good
scan of a good part."""
MUCH_BETTER = 0.25
"""Part of that ratio which is left when the unit is the other one. Scaling alone leaves all of it:
a cloud laid on a flat face fits as well, over its extent, in any unit."""


def across_mm(points_mm: FloatArray) -> float:
    """Diagonal of the box about (N, 3) points, one of a hundred left out at either end."""
    low, high = np.percentile(points_mm, [1.0, 99.0], axis=0)
    return float(np.linalg.norm(high - low))


def scale_mismatch(surface: PartSurface, points_mm: FloatArray) -> FitFailure | None:
    """Notice a cloud or a part in another unit by comparing their sizes."""
    if len(points_mm) < LEAST_POINTS:
        return FitFailure(
            f"the cloud holds {len(points_mm)} points; {LEAST_POINTS} are needed",
            "scan more of the part",
        )
    ours, theirs = across_mm(points_mm), surface.diagonal_mm
    if TOO_SMALL * theirs < ours < TOO_LARGE * theirs:
        return None
    if UNITS[0][2] * ours < LIKELY_SMALL * theirs:
        return FitFailure(
            f"all points of the cloud lie within {ours:.2g} mm, and the part measures "
            f"{theirs:.4g} mm: in no unit they show anything of it",
            "scan more of the part",
        )
    ratio = ours / theirs
    unit = min(UNITS, key=lambda one: abs(abs(math.log(ratio)) - math.log(one[2])))
    return _refusal(unit, ours, theirs, is_model=ratio > 1.0)


def unit_mismatch(
    surface: PartSurface, cloud: PointCloud, best: PoseCandidate
) -> FitFailure | None:
    """Notice a cloud or a part in another unit by how much better the cloud fits when scaled.

    Parameters
    ----------
    surface
        The part.
    cloud
        Its points, of a size that a scan of the part may have.
    best
        Where they fit best as they are.
    """
    ours, theirs = across_mm(cloud.points_mm), surface.diagonal_mm
    if best.scale_mm <= DOUBTFUL * ours:
        return None
    for unit in UNITS:
        for is_model in (False, True):
            factor = 1.0 / unit[2] if is_model else unit[2]
            if not LIKELY_SMALL * theirs < factor * ours < TOO_LARGE * theirs:
                continue
            scaled = search_pose(surface, factor * cloud.points_mm, cloud.normals)[0]
            if scaled.scale_mm <= MUCH_BETTER * factor * best.scale_mm:
                return _refusal(unit, ours, theirs, is_model=is_model)
    return None


def _refusal(
    unit: tuple[str, str, float], ours: float, theirs: float, *, is_model: bool
) -> FitFailure:
    words, option, factor = unit
    other = "model" if is_model else "cloud"
    remedy = (
        f"if the model is in {words}, give --unit {option}; if the cloud is in mm and its part so "
        "large, cut it to the part with --region"
        if is_model
        else f"leave --unit {option} out if it was given; else multiply the cloud's coordinates by "
        f"{factor:g}, if they are in {words}"
    )
    return FitFailure(
        f"the cloud measures {ours:.4g} and the part {theirs:.4g} mm across: the {other} seems to "
        f"be in {words}",
        remedy,
    )
