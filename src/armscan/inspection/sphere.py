# SPDX-License-Identifier: Apache-2.0
"""A ball against the standard (figure 5.14)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import Shape, fit_shape
from armscan.geometry.shapes import Sphere, fit_sphere
from armscan.inspection.results import PointCounts, SphereInspection, describe_deviations
from armscan.inspection.search import RADIUS_SLACK, scatter_about_mm
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
from armscan.inspection.uncertainty import FitErrors, FitLinearised, worst_sigma
from armscan.records.cloud import PointCloud

LARGEST_MISFIT, MOST_MISFIT = 0.02, 0.1
"""Largest difference of fitted and nominal diameter, as a part of it, that may be the same ball;
points that scatter so much that the search's band is wider add twice what it is wider by. A
diameter that is known badly may differ by the first part and `MISFIT_SIGMAS`, by the second part at
most, and not where one sigma leads there: of any patch some ball's diameter is known to nothing."""
MISFIT_SIGMAS = 3.0

SETTLING_ROUNDS = 3
PLACES = 4
"""Where a ball is looked for, if the places before are none."""
BESIDE = 0.9
"""Two balls' centres are that many diameters apart, but for what both err by."""
AS_ROUND, EXACT_MM = 3.0, 1e-6
"""Scatter of another ball's points, over that of the first's, and of points without any."""
LEAST_OTHER = 0.1
"""Points of another ball, over those of the one that is measured."""
OTHER_PLACES = 12
"""Where other balls are looked for."""
AS_NEAR, N_COMPARED = 1.5, 2000
"""Rms distance of points from a cylinder, over that from a ball, up to which they may be of a disc
or a post: rims of discs have 1.3 at most, caps of balls of 10 degrees and more 2.5 at least. And of
how many of the points it is taken."""


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
    post = post_of(selection.cloud, found.rows[found.is_fitted], found.sphere)
    others = _others(selection, found)
    if post is not None and others:
        # a disc with more points than the ball
        ball = _settled(selection, Sphere(others[0].centre_mm, diameter_mm / 2.0), diameter_mm)
        if isinstance(ball, SphereInspection):
            found, post, others = ball, None, others[1:]
    return replace(
        found,
        others=others,
        post=post,
        scatter_mm=scatter_about_mm(selection, found.rows),
    )


def post_of(cloud: PointCloud, rows: IntArray, ball: Sphere | Shape) -> Shape | None:
    """A cylinder of the ball's diameter to which points are as near; None if there is none.

    A ball is round in two ways, the rim of a disc and a short post in one.

    ``rows`` are those (N,) of the points in the cloud that the ball was fitted to.
    """
    points = cloud.points_mm[np.random.default_rng(0).permutation(rows)[:N_COMPARED]]
    fit = fit_shape("cylinder", points)
    if isinstance(fit, FitFailure):
        return None
    post = fit.value
    off_mm, usual_mm = (
        float(np.sqrt(np.mean(one.distance_mm(points) ** 2))) for one in (post, ball)
    )
    is_as_wide = abs(post.radius_mm - ball.radius_mm) < RADIUS_SLACK * ball.radius_mm
    return post if is_as_wide and off_mm < AS_NEAR * usual_mm else None


def _others(selection: Selection, found: SphereInspection) -> tuple[Sphere, ...]:
    """Other balls of that diameter, in the order in which they are found; no discs and posts."""
    rest, place, balls = selection, found, [found]
    for _ in range(OTHER_PLACES):
        is_away = place.sphere.distance_mm(rest.points_mm) > rest.feature_mm
        rest = replace(rest, rows=rest.rows[is_away])
        if len(rest.rows) < MIN_POINTS:
            break
        at = _found(rest, found.nominal_diameter_mm)
        if isinstance(at, FitFailure):
            break
        place = at
        is_another = _is_another(at, found) and all(_are_apart(at, ball) for ball in balls)
        if is_another and post_of(rest.cloud, at.rows[at.is_fitted], at.sphere) is None:
            balls.append(at)
    return tuple(ball.sphere for ball in balls[1:])


def _are_apart(one: SphereInspection, other: SphereInspection) -> bool:
    """Whether two balls have room beside each other."""
    apart_mm = float(np.linalg.norm(one.sphere.centre_mm - other.sphere.centre_mm))
    return apart_mm > BESIDE * one.nominal_diameter_mm


def _is_another(other: SphereInspection, found: SphereInspection) -> bool:
    """True of a ball that is as well seen and as round as the first.

    A post of that diameter is round one way only.
    """
    off_mm, usual_mm = (
        float(np.sqrt(np.mean(one.fitted.deviations_mm[one.is_fitted] ** 2)))
        for one in (other, found)
    )
    return (
        len(other.rows) > LEAST_OTHER * len(found.rows) and off_mm < AS_ROUND * usual_mm + EXACT_MM
    )


def _found(selection: Selection, diameter_mm: float) -> SphereInspection | FitFailure:
    """The ball that most points lie on, of the places where points do gather on one.

    A post or another ball of nearly that size may have more points in the band: places that turn
    out to be no ball are left out of the search in turn. Each is judged by all points about it:
    what the search has left of a post may be as round as a ball. One whose diameter is known badly
    is taken where no place has one that is known to be of the size that was asked for.
    """
    rest, radius_mm = selection, diameter_mm / 2.0
    refused: list[FitFailure] = []
    unsure: list[SphereInspection] = []
    while len(refused) + len(unsure) < PLACES and len(rest.rows) >= MIN_POINTS:
        place = find_ball(rest.points_mm, radius_mm, rest.search_band_mm)
        if isinstance(place, FitFailure):
            refused.append(place)
            break
        ball, n_near = Sphere(place[0], radius_mm), place[1]
        if n_near < MIN_POINTS:
            refused.append(_no_place(n_near, len(rest.rows), diameter_mm))
            break
        found = _settled(selection, ball, diameter_mm)
        if isinstance(found, FitFailure):
            refused.append(found)
        elif _is_sure(selection, found):
            return found
        else:
            unsure.append(found)
        is_away = np.abs(ball.distance_mm(rest.points_mm)) > rest.feature_mm
        rest = replace(rest, rows=rest.rows[is_away])
    if unsure:
        return min(unsure, key=_unlikely)
    return refused[0]


def _is_sure(selection: Selection, found: SphereInspection) -> bool:
    """Whether the diameter is the one asked for, and is known so well that it could be no other."""
    band_mm = selection.search_band_mm[np.isin(selection.rows, found.rows)]
    usual_mm = _usual_misfit_mm(band_mm, found.nominal_diameter_mm)
    # of a single exposure sigma is NaN
    return _misfit_mm(found) <= usual_mm and not found.diameter.sigma_mm > usual_mm


def _unlikely(found: SphereInspection) -> float:
    """Twice the negative log-likelihood of a ball of the diameter asked for."""
    sigma_mm = found.diameter.sigma_mm
    return (_misfit_mm(found) / sigma_mm) ** 2 + 2.0 * math.log(sigma_mm)


def _misfit_mm(found: SphereInspection) -> float:
    return abs(found.diameter.value_mm - found.nominal_diameter_mm)


def _usual_misfit_mm(band_mm: FloatArray, diameter_mm: float) -> float:
    """Of a ball whose diameter is known well, whose points are sought in bands (N,)."""
    return LARGEST_MISFIT * diameter_mm + 2.0 * (float(np.median(band_mm)) - SEARCH_BAND_MM)


def _another_size(found: SphereInspection) -> FitFailure | None:
    """Why a ball that is not of the usual size is none of the size that was asked for."""
    diameter_mm, sigma_mm = found.nominal_diameter_mm, found.diameter.sigma_mm
    least_mm, most_mm = LARGEST_MISFIT * diameter_mm, MOST_MISFIT * diameter_mm
    # NaN, a sigma that nothing tells, is in none of these
    is_open = MISFIT_SIGMAS * sigma_mm > most_mm - least_mm
    allowed_mm = min(most_mm, least_mm + MISFIT_SIGMAS * sigma_mm)
    if _misfit_mm(found) <= allowed_mm and sigma_mm <= most_mm - least_mm:
        return None
    lie = (
        f"the points that a ball of {diameter_mm:g} mm could have lie on one of "
        f"{found.diameter.value_mm:.4g} mm"
    )
    if not is_open:
        return FitFailure(lie, "check the diameter, or show where the ball is with --region")
    return FitFailure(
        f"{lie}, whose diameter they tell to {sigma_mm:.2g} mm only",
        "scan more of the ball, from more postures; else check the diameter, or show where the "
        "ball is with --region",
    )


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
        if abs(2.0 * sphere.radius_mm - diameter_mm) > _usual_misfit_mm(
            band_mm[chosen], diameter_mm
        ):
            described = _described(selection, chosen, is_fitted, sphere, diameter_mm)
            if (another := _another_size(described)) is not None:
                return another
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
    errors = FitErrors.of(linear, cloud, feature[is_fitted])
    from_centre = sphere.distance_mm(points) + sphere.radius_mm
    return SphereInspection(
        sphere=sphere,
        nominal_diameter_mm=diameter_mm,
        diameter=errors.measured(2.0 * sphere.radius_mm, DIAMETER_OF_SPHERE),
        centre_sigma_mm=worst_sigma(
            np.eye(3), lambda way: errors.measured(0.0, np.append(way, 0.0)).sigma_mm
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
