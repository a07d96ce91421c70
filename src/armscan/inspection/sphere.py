# SPDX-License-Identifier: Apache-2.0
"""A ball against the standard (figure 5.14)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, Box, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Sphere, fit_sphere
from armscan.inspection.results import PointCounts, SphereInspection, describe_deviations
from armscan.inspection.selection import (
    MIN_POINTS,
    OUTLIER_RULE,
    SEARCH_BAND_MM,
    SEARCH_SIGMAS,
    InspectionOptions,
    Selection,
    find_ball,
    fit_robustly,
    least_concentration,
    select,
)
from armscan.inspection.uncertainty import FitLinearised, measured_length
from armscan.records.cloud import PointCloud

LARGEST_MISFIT = 0.02
"""Largest difference of fitted and nominal diameter, as a part of it, that may be the same ball;
points that scatter so much that the search's band is wider add twice what it is wider by."""

SETTLING_ROUNDS = 3
PLACES = 4
"""Where a ball is looked for, if the places before are none."""
BESIDE = 0.9
"""Two balls' centres are that many diameters apart, but for what both err by."""
AS_ROUND, EXACT_MM = 3.0, 1e-6
"""Scatter of another ball's points, over that of the first's, and of points without any."""
LEAST_OTHER = 0.1
"""Points of another ball, over those of the one that is measured."""


def inspect_sphere(
    cloud: PointCloud,
    diameter_mm: float,
    *,
    region: Box | None = None,
    options: InspectionOptions | None = None,
) -> SphereInspection | FitFailure:
    """Find a ball of known diameter anywhere in a cloud and inspect it.

    Parameters
    ----------
    cloud
        Points in any frame; other objects may be among them.
    diameter_mm
        Of the standard ball.
    region
        Only points inside are looked at.
    options
        What belongs to the ball; the default if None.

    Raises
    ------
    InputError
        If there are too few points or the diameter is not positive.
    """
    if not 0.0 < diameter_mm < 1e4:
        raise InputError(f"a ball of {diameter_mm:g} mm diameter", remedy="give the diameter in mm")
    selection = select(cloud, region, options, size_mm=diameter_mm)
    found = _found(selection, diameter_mm)
    if isinstance(found, FitFailure):
        return found
    apart = found.sphere.distance_mm(selection.points_mm)
    rest = replace(selection, rows=selection.rows[apart > selection.feature_mm])
    if len(rest.rows) < MIN_POINTS:
        return found
    other = _found(rest, diameter_mm)
    if isinstance(other, FitFailure) or not _is_another(other, found):
        return found
    return replace(found, other=other.sphere)


def _is_another(other: SphereInspection, found: SphereInspection) -> bool:
    """True of a ball that is as well seen and as round as the first, and not in its place.

    Strays lie about the first; a post of that diameter is round one way only.
    """
    apart_mm = float(np.linalg.norm(other.sphere.centre_mm - found.sphere.centre_mm))
    off_mm, usual_mm = (
        float(np.sqrt(np.mean(one.fitted.deviations_mm[one.is_fitted] ** 2)))
        for one in (other, found)
    )
    return (
        apart_mm > BESIDE * found.nominal_diameter_mm
        and len(other.rows) > LEAST_OTHER * len(found.rows)
        and off_mm < AS_ROUND * usual_mm + EXACT_MM
    )


def _found(selection: Selection, diameter_mm: float) -> SphereInspection | FitFailure:
    """The ball that most points lie on, of the places where points do gather on one.

    A post or another ball of nearly that size may have more points in the band: places that turn
    out to be no ball are left out of the search in turn. Each is judged by all points about it:
    what the search has left of a post may be as round as a ball.
    """
    rest, radius_mm = selection, diameter_mm / 2.0
    refused: list[FitFailure] = []
    while len(refused) < PLACES and len(rest.rows) >= MIN_POINTS:
        place = find_ball(rest.points_mm, radius_mm, rest.search_band_mm)
        if isinstance(place, FitFailure):
            refused.append(place)
            break
        ball, n_near = Sphere(place[0], radius_mm), place[1]
        if n_near < MIN_POINTS:
            refused.append(_no_place(n_near, len(rest.rows), diameter_mm))
            break
        found = _settled(selection, ball, diameter_mm)
        if isinstance(found, SphereInspection):
            return found
        refused.append(found)
        is_away = np.abs(ball.distance_mm(rest.points_mm)) > rest.feature_mm
        rest = replace(rest, rows=rest.rows[is_away])
    return refused[0]


def _no_place(n_near: int, n_points: int, diameter_mm: float) -> FitFailure:
    return FitFailure(
        f"there is no ball of {diameter_mm:g} mm: the best place for one has {n_near} of "
        f"{n_points} points on it, {MIN_POINTS} are needed",
        "check the diameter, or show where the ball is with --region",
    )


def _settled(
    selection: Selection, sphere: Sphere, diameter_mm: float
) -> SphereInspection | FitFailure:
    """Fit to the feature, choose the feature anew about the fit, until it stays."""
    points, feature_mm = selection.points_mm, selection.feature_mm
    is_feature = np.zeros(len(points), dtype=np.bool_)
    is_fitted, band_mm = is_feature, selection.search_band_mm
    for _ in range(SETTLING_ROUNDS):
        chosen = np.abs(sphere.distance_mm(points)) <= feature_mm
        if np.array_equal(chosen, is_feature):
            break
        is_feature = chosen
        fit = fit_robustly(points[chosen], sphere, fit_sphere)
        if isinstance(fit, FitFailure):
            return FitFailure(
                f"there is no ball of {diameter_mm:g} mm: {fit.reason}",
                "check the diameter, or show where the ball is with --region",
            )
        sphere, is_fitted = fit
        misfit = 2.0 * sphere.radius_mm - diameter_mm
        wider_mm = float(np.median(band_mm[chosen])) - SEARCH_BAND_MM
        if abs(misfit) > LARGEST_MISFIT * diameter_mm + 2.0 * wider_mm:
            return FitFailure(
                f"the points that a ball of {diameter_mm:g} mm could have lie on one of "
                f"{2.0 * sphere.radius_mm:.4g} mm",
                "check the diameter, or show where the ball is with --region",
            )
    near = np.abs(sphere.distance_mm(points[is_feature])) <= band_mm[is_feature]
    middle_mm = float(np.median(band_mm[is_feature]))
    if float(near.mean()) < least_concentration(middle_mm, feature_mm):
        return _not_concentrated(selection, is_feature, int(near.sum()), middle_mm, diameter_mm)
    return _described(selection, is_feature, is_fitted, sphere, diameter_mm)


def _not_concentrated(
    selection: Selection, is_feature: BoolArray, n_near: int, band_mm: float, diameter_mm: float
) -> FitFailure:
    """The points about the best place for a ball do not gather on it: another shape, or smeared."""
    facts = (
        f"at the best place for one, only {n_near} of {int(is_feature.sum())} points within "
        f"{selection.feature_mm:g} mm of its surface lie within {band_mm:.3g} mm"
    )
    sigma_mm = float(np.median(selection.sigma_mm[is_feature]))
    if SEARCH_SIGMAS * sigma_mm <= SEARCH_BAND_MM:
        return FitFailure(
            f"there is no ball of {diameter_mm:g} mm: {facts}",
            "check the diameter, or show where the ball is with --region",
        )
    return FitFailure(
        f"the points scatter too much to tell a ball of {diameter_mm:g} mm: their stated sigma is "
        f"{sigma_mm:.2g} mm an axis (median), and {facts}",
        "the scanner's calibration says how much of it is the arm's; scan from fewer postures, or "
        f"give --feature-mm {2.0 * SEARCH_SIGMAS * sigma_mm:.2g}",
    )


def _described(
    selection: Selection,
    is_feature: BoolArray,
    is_fitted: BoolArray,
    sphere: Sphere,
    diameter_mm: float,
) -> SphereInspection:
    cloud = selection.cloud
    feature = selection.rows[is_feature]
    points = cloud.points_mm[feature]
    near = f"within {selection.feature_mm:g} mm of the fitted sphere"
    counts = PointCounts(
        n_given=len(cloud),
        n_region=len(selection.rows),
        n_feature=len(feature),
        n_fitted=int(is_fitted.sum()),
        feature_rule=f"points {near}; it was found by its diameter, anywhere among those given",
        fit_rule=OUTLIER_RULE,
    )
    text = f"all {len(feature)} points {near}"
    linear = linearised_sphere(sphere, points[is_fitted])
    from_centre = sphere.distance_mm(points) + sphere.radius_mm
    return SphereInspection(
        sphere=sphere,
        nominal_diameter_mm=diameter_mm,
        diameter=measured_length(
            2.0 * sphere.radius_mm, DIAMETER_OF_SPHERE, linear, cloud, feature[is_fitted]
        ),
        rows=feature,
        is_fitted=is_fitted,
        counts=counts,
        fitted=describe_deviations(
            from_centre - sphere.radius_mm,
            "fitted",
            "the least-squares sphere (centre and radius free)",
            text,
        ),
        nominal=describe_deviations(
            from_centre - diameter_mm / 2.0,
            "nominal",
            f"the standard ball's radius of {diameter_mm / 2.0:g} mm about the centre of the "
            "least-squares sphere",
            text,
        ),
        seen_cap_deg=cap_deg(points[is_fitted] - sphere.centre_mm),
    )


DIAMETER_OF_SPHERE = np.array([0.0, 0.0, 0.0, 2.0])
"""Derivatives of the diameter by the parameters of `linearised_sphere`: centre and radius."""


def linearised_sphere(sphere: Sphere, points_mm: FloatArray) -> FitLinearised:
    """The fit of a sphere to points (N, 3) about its optimum."""
    offset = points_mm - sphere.centre_mm
    distance = np.linalg.norm(offset, axis=1)
    outward = offset / distance[:, None]
    return FitLinearised(
        np.column_stack([-outward, -np.ones(len(outward))]),
        outward,
        distance - sphere.radius_mm,
    )


def cap_deg(offset_mm: FloatArray) -> float:
    """Half opening of the cap about the mean direction of offsets (N, 3) that holds them all."""
    outward = offset_mm / np.linalg.norm(offset_mm, axis=1, keepdims=True)
    mean = outward.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if size < 1e-9:
        return 180.0
    return math.degrees(math.acos(float(np.clip((outward @ mean / size).min(), -1.0, 1.0))))
