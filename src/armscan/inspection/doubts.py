# SPDX-License-Identifier: Apache-2.0
"""What speaks against a measured feature, in words."""

from __future__ import annotations

import math

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.features import FeatureInspection
from armscan.inspection.results import PointCounts, SphereInspection, StepInspection
from armscan.records.cloud import PointCloud

NO_SIGMA = (
    "the cloud carries no standard deviations, so it is not known how well the fit is determined"
)
FUSED_SIGMA = (
    "the cloud is fused and no longer tells its exposures apart, so that no ± and no U is known; "
    "inspect the cloud from before it was fused"
)
MANY_OUTLIERS = 0.01
ROUND = ("sphere", "cylinder", "cone")
OTHER_SHAPE, BEYOND_STATED = 8.0, 2.0
"""Rms distance from a fitted shape beyond which it is doubted, in scatters of neighbours: bores,
bosses and balls have 3 at most, a cylinder in a cone of 25 degrees or in two flat faces 15 and
more. And in stated sigmas, for stripes that an arm shifts are smooth themselves."""
NARROW_ARC_DEG = 90.0
"""Less of a turn tells radius and place poorly apart: their errors grow as 1 / arc^2."""
SEED_OFF_MM = 1.0
"""Distance from a feature within which its seed is on it."""


def sigma_warnings(cloud: PointCloud) -> tuple[str, ...]:
    """Of a cloud that does not tell how well anything fitted to it is known."""
    if not cloud.covariance_mm2.any():
        return (NO_SIGMA,)
    return (FUSED_SIGMA,) if cloud.is_fused else ()


def outlier_warnings(counts: PointCounts, whose: str = "feature") -> tuple[str, ...]:
    """Of a feature many of whose points the fit left out."""
    if counts.n_outliers <= MANY_OUTLIERS * counts.n_feature:
        return ()
    share = 100.0 * counts.n_outliers / counts.n_feature
    return (f"{share:.1f} % of the {whose}'s points are outliers: see the pictures",)


def shape_warnings(
    found: SphereInspection | FeatureInspection, cloud: PointCloud, kind: str, whose: str = ""
) -> tuple[str, ...]:
    """Warn of points that may be of another shape than the one that was fitted to them.

    They are as near to a post, or lie much farther off the shape than off their neighbours and
    than their sigmas say. ``kind`` is what the shape is called.
    """
    rows = found.rows[found.is_fitted]
    rms = _rms(found.fitted.deviations_mm[found.is_fitted])
    if found.post is not None:
        off = _rms(found.post.distance_mm(cloud.points_mm[rows]))
        return (
            f"{whose}the points may be of no {kind}, but of a disc or a post: they lie {_mm(off)} "
            f"(rms) off a cylinder of {2.0 * found.post.radius_mm:.4g} mm, and {_mm(rms)} off the "
            f"{kind}; scan it from more sides, or show where the {kind} is with --region",
        )
    is_round = isinstance(found, SphereInspection) or found.shape.kind in ROUND
    if not is_round or not _is_far(rms, found.scatter_mm, cloud, rows):
        return ()
    return (
        f"{whose}the points may be of no {kind}: they lie {_mm(rms)} (rms) off "
        f"it, {rms / found.scatter_mm:.0f} times as much as neighbours scatter; see the pictures, "
        "and show where it is by a region or a seed",
    )


def seed_warnings(found: FeatureInspection, cloud: PointCloud, whose: str = "") -> tuple[str, ...]:
    """Of a seed off the surface, or farther from its points than these lie from each other."""
    if found.wanted.seed_mm is None:
        return ()
    seed, points = np.asarray(found.wanted.seed_mm), cloud.points_mm[found.rows]
    off = abs(float(found.shape.distance_mm(seed[None, :])[0]))
    far = float(np.linalg.norm(points - seed, axis=1).min())
    if off <= SEED_OFF_MM and far <= float(np.linalg.norm(np.ptp(points, axis=0))):
        return ()
    return (
        f"{whose}the seed is not on it: the nearest of its points is {_mm(far)} away; another "
        "feature may be meant",
    )


def arc_warnings(found: FeatureInspection, whose: str = "") -> tuple[str, ...]:
    """Of a round feature of which only a narrow arc was seen."""
    is_turned = found.shape.kind in ("circle", "cylinder", "cone")
    if not is_turned or not found.seen_deg < NARROW_ARC_DEG:
        return ()
    return (
        f"{whose}the points cover only {found.seen_deg:.0f} degrees of the turn, where radius and "
        "place are poorly told apart; scan more of it",
    )


def face_warnings(found: StepInspection, cloud: PointCloud) -> tuple[str, ...]:
    """Warn of faces that are bent, as parts of a ball are."""
    rms = found.fitted.value("rms_mm")
    both = np.concatenate([found.lower, found.upper])
    if not _is_far(rms, found.scatter_mm, cloud, both):
        return ()
    return (
        f"the two faces are not flat: their points lie {_mm(rms)} (rms) off them, "
        f"{rms / found.scatter_mm:.0f} times as much as neighbours scatter; see the pictures, and "
        "show where the step is with --region",
    )


def lean_warnings(found: StepInspection) -> tuple[str, ...]:
    """Of a height from one light sheet of which nobody said how it leans on the faces."""
    if not found.is_lean_assumed:
        return ()
    return (f"{found.normal_rule}; no ± and no U is known: give the normal of the faces",)


def _is_far(rms: float, scatter_mm: float, cloud: PointCloud, rows: IntArray) -> bool:
    """Whether points are much farther off a shape than they scatter, and than their sigmas say."""
    variance = np.median(np.einsum("nii->n", cloud.covariance_mm2[rows])) / 3.0
    stated = BEYOND_STATED * math.sqrt(max(float(variance), 0.0))
    # written so that a scatter that is not known is no doubt
    return bool(rms > OTHER_SHAPE * scatter_mm and rms > stated)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mm(value: float) -> str:
    """A length with two digits, without an exponent."""
    digits = np.format_float_positional(value, 2, unique=False, fractional=False, trim="-")
    return f"{digits} mm"
