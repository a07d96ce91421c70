# SPDX-License-Identifier: Apache-2.0
"""Exposures that look at a standard but do not show it where the others do.

A robust fit takes the part of a scan that agrees and leaves the rest out; what it left out must
take part in the verdict. A point ought to lie on the standard if it lies near it, on the side that
the fitted points show: stands, tables and what is beside the standard do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.options import InspectionOptions
from armscan.inspection.results import PlaneInspection, SphereInspection
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.verdict import MIN_EXPOSURE_POINTS, Check, judge
from armscan.records.cloud import PointCloud

SIDE_RAD = 0.15
"""A point is over the ball's scanned side if a fitted point lies in its direction within this."""
BALL_SHARE = 0.5
"""Points within this part of the ball's radius from its surface ought to lie on it."""
PLATE_MM = 10.0
"""And points within the plate's scanned outline up to so far above or below it."""
OFF_SIGMAS = 5.0
"""An exposure is off if the median distance of those points exceeds this many times what their
covariances predict of it, and the band within which a fit leaves nothing out."""
LIMIT_PERCENT = 5.0
"""Exposures that may be off: dust, a cable before the standard."""


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """Points that ought to lie on the standard: rows in the cloud, distances, directions."""

    rows: IntArray
    distance_mm: FloatArray
    outward: FloatArray


def check_exposures_off(
    cloud: PointCloud,
    found: SphereInspection | PlaneInspection,
    within: BoolArray,
    options: InspectionOptions,
) -> Check | None:
    """Count exposures that show the standard somewhere else than the fit has it.

    Parameters
    ----------
    cloud
        All points.
    found
        The fit.
    within
        (N,) points in the region that was asked for.
    options
        Those of the fit.

    Returns
    -------
    Check
        Of the share of exposures that are off, in percent of those that ought to show the standard;
        None if fewer than four do.
    """
    if isinstance(found, SphereInspection):
        name, near = "ball", _near_ball(cloud, found, within)
    else:
        name, near = "plate", _near_plate(cloud, found, within)
    exposure = cloud.exposure[near.rows]
    covariance = cloud.covariance_mm2[near.rows]
    variance = np.einsum("ni,nij,nj->n", near.outward, covariance, near.outward)
    judged, off = set(), set()
    for number in np.unique(exposure).tolist():
        own = exposure == number
        if int(own.sum()) < MIN_EXPOSURE_POINTS:
            continue
        judged.add(number)
        limit = max(options.kept_band_mm, OFF_SIGMAS * float(np.sqrt(np.mean(variance[own]))))
        if abs(float(np.median(near.distance_mm[own]))) > limit:
            off.add(number)
    if isinstance(found, SphereInspection):
        elsewhere = _second_ball(cloud, found, within & ~np.isin(cloud.exposure, list(judged)))
        judged, off = judged | elsewhere, off | elsewhere
    if len(judged) < 4:
        return None
    share = 100.0 * len(off) / len(judged)
    return Check(
        name=f"exposures off the {name}",
        definition=f"share of the {len(judged)} exposures with points near the {name}'s scanned "
        "side, of which more than half lie off it, or which show it in another place",
        unit="%",
        error=share,
        predicted=0.0,
        limit=LIMIT_PERCENT,
        limit_rule="something may stand in the way once; a valid scanner shows the standard in one "
        "place",
        uncertainty=0.0,
        uncertainty_rule="none: a count",
        verdict=judge(share, LIMIT_PERCENT, 0.0),
    )


def _near_ball(cloud: PointCloud, found: SphereInspection, within: BoolArray) -> _Near:
    offset = cloud.points_mm - found.sphere.centre_mm
    size = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    outward, distance = offset / size[:, None], size - found.sphere.radius_mm
    rows = np.flatnonzero(within & (np.abs(distance) <= BALL_SHARE * found.sphere.radius_mm))
    side = cKDTree(outward[found.rows[found.is_fitted]])
    apart = side.query(outward[rows], distance_upper_bound=SIDE_RAD)[0]
    rows = rows[np.isfinite(apart)]
    return _Near(rows, distance[rows], outward[rows])


def _near_plate(cloud: PointCloud, found: PlaneInspection, within: BoolArray) -> _Near:
    local = (cloud.points_mm - found.plane.point_mm) @ found.plane.axes.T
    rows = np.flatnonzero(within & (np.abs(local[:, 2]) <= PLATE_MM))
    try:
        outline = Delaunay(local[found.rows[found.is_fitted], :2][_hull_sample(found)])
    except QhullError:
        rows = rows[:0]
    else:
        rows = rows[outline.find_simplex(local[rows, :2]) >= 0]
    return _Near(rows, local[rows, 2], np.broadcast_to(found.plane.normal, (len(rows), 3)))


def _hull_sample(found: PlaneInspection) -> slice:
    """Few enough points for an outline."""
    return slice(None, None, max(1, int(found.is_fitted.sum()) // 20_000))


def _second_ball(cloud: PointCloud, found: SphereInspection, rest: BoolArray) -> set[int]:
    """Exposures without points near the ball that show another one of its size."""
    rows = np.flatnonzero(rest)
    if len(rows) < 10 * MIN_EXPOSURE_POINTS:
        return set()
    other = inspect_sphere(cloud.select(rows), found.nominal_diameter_mm)
    if isinstance(other, FitFailure):
        return set()
    used = np.zeros(len(rows), dtype=np.bool_)
    used[other.rows[other.is_fitted]] = True
    count = np.bincount(cloud.exposure[rows], used)
    shown = np.flatnonzero(count >= MIN_EXPOSURE_POINTS)
    return set(shown.tolist()) if len(shown) >= 2 else set()
