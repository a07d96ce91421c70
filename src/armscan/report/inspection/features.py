# SPDX-License-Identifier: Apache-2.0
"""The pages of features and of how two of them stand, and their numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from armscan.inspection.conformity import COVERAGE
from armscan.inspection.doubts import arc_warnings, seed_warnings, shape_warnings
from armscan.inspection.features import FeatureInspection, MeasuredAngle, Relation
from armscan.inspection.results import MeasuredLength, PointCounts
from armscan.records.cloud import PointCloud
from armscan.report.charts import deviation_view
from armscan.report.inspection.shapes import (
    InspectionReport,
    count_quantities,
    deviation_histogram,
    deviation_quantities,
    expanded,
    feature_view,
    form_card,
    length_quantities,
    place_quantity,
    point_subtitle,
    point_warnings,
    share_card,
    sigma_facts,
)
from armscan.report.quantity import (
    Quantity,
    fact,
    only,
    signed_mm,
    significant,
    triple,
    with_sigma,
)

ANGLE_NOTE = "near 0 and 90 degrees it is the size of a tilt, which noise never makes negative"


def feature_report(found: FeatureInspection, cloud: PointCloud) -> InspectionReport:
    """Report of one feature."""
    kind = found.shape.kind
    main = found.nominal or found.fitted
    told = feature_quantities(found)
    warnings = (*point_warnings(found.counts, cloud), *_doubts(found, cloud))
    references = [(f"against the fitted {kind}", found.fitted)]
    if found.nominal is not None:
        references.insert(0, ("against the nominal size", found.nominal))
    keys = ("fitted.diameter", "fitted.half_angle", "diameter_error_mm")
    return InspectionReport(
        title=f"{kind.capitalize()} inspected",
        subtitle=point_subtitle(found.counts, cloud),
        quantities=told,
        cards=(
            *only(told, *keys),
            share_card(main),
            form_card(found.fitted),
            *only(told, "points.n_feature"),
        ),
        references=tuple(references),
        histograms=tuple(
            deviation_histogram(one, title=f"Distance to the {one.reference} {kind}")
            for _, one in references
        ),
        views=(feature_view(cloud, found.rows, main),),
        counts=found.counts,
        warnings=warnings,
    )


def _doubts(found: FeatureInspection, cloud: PointCloud, whose: str = "") -> tuple[str, ...]:
    """Warn of a seed that is on no feature, points that may be of another shape, a narrow arc."""
    kind = found.shape.kind
    return (
        *seed_warnings(found, cloud, whose),
        *shape_warnings(found, cloud, kind, whose),
        *arc_warnings(found, whose),
    )


def feature_quantities(found: FeatureInspection) -> tuple[Quantity, ...]:
    """What is told of a feature."""
    shape, kind = found.shape, found.shape.kind
    told = [Quantity("feature", "", kind), *count_quantities(found.counts)]
    if found.diameter is not None:
        told += _diameter(found, found.diameter)
    if found.half_angle is not None:
        told += _half_angle(found, found.half_angle)
    where = {"circle": "Centre", "sphere": "Centre"}.get(kind, "Middle of the points on it")
    told.append(place_quantity("fitted.point_mm", where, shape.point_mm, found.centre_sigma_mm))
    if kind == "cone":
        told.append(place_quantity("fitted.apex_mm", "Tip", shape.apex_mm, math.nan))
    if kind != "sphere":
        told.append(_direction(found))
    if not math.isnan(found.seen_deg):
        about = "of the widest cap" if kind == "sphere" else "of the turn about the axis"
        told.append(
            Quantity(
                "fitted.seen_deg",
                "Seen",
                found.seen_deg,
                shown=f"{found.seen_deg:.0f} degrees {about}",
            )
        )
    if found.length_mm:
        told.append(Quantity("fitted.length_mm", "Extent along it", found.length_mm, unit="mm"))
    form = "diameter of the tube that holds them" if kind == "line" else "largest minus smallest"
    told.append(
        Quantity(
            "fitted.form_mm",
            found.form_name.capitalize(),
            found.form_mm,
            unit="mm",
            meaning=f"{form}, of all points, outliers included",
        )
    )
    told.append(fact("Positive", POSITIVE[kind]))
    if found.diameter is not None:
        told += sigma_facts(found.diameter, "diameter")
    told += deviation_quantities("fitted", found.fitted)
    if found.nominal is not None:
        told += deviation_quantities("nominal", found.nominal)
    return tuple(told)


def _diameter(found: FeatureInspection, diameter: MeasuredLength) -> list[Quantity]:
    nominal = found.wanted.diameter_mm
    meaning = "" if nominal is None else f"nominal {nominal:g} mm"
    told = [
        *length_quantities("fitted.diameter", "Fitted diameter", diameter, meaning),
    ]
    if nominal is not None:
        error = diameter.value_mm - nominal
        told += [
            Quantity("nominal.diameter_mm", "", nominal),
            Quantity("diameter_error_mm", "Fitted minus nominal", error, shown=signed_mm(error)),
        ]
    return told


def _half_angle(found: FeatureInspection, angle: MeasuredAngle) -> list[Quantity]:
    nominal = found.wanted.half_angle_deg
    meaning = "" if nominal is None else f"nominal {nominal:g} degrees"
    sigma = math.degrees(angle.sigma_rad)
    told = [
        angle_quantity("fitted.half_angle", "Fitted half angle", angle, meaning),
        expanded("fitted.half_angle_u_deg", "half angle", sigma, "degrees"),
    ]
    if nominal is not None:
        told.append(Quantity("nominal.half_angle_deg", "", nominal))
    return told


def angle_quantity(key: str, label: str, angle: MeasuredAngle, meaning: str) -> Quantity:
    """An angle in degrees with its standard deviation."""
    value, sigma = math.degrees(angle.value_rad), math.degrees(angle.sigma_rad)
    shown = f"{value:.4f} degrees" if math.isnan(sigma) else with_sigma(value, sigma, "degrees")
    return Quantity(
        key, label, {"value_deg": value, "sigma_deg": sigma}, meaning=meaning, shown=shown
    )


def _direction(found: FeatureInspection) -> Quantity:
    sigma = 1000.0 * found.direction_sigma_rad
    known = "" if math.isnan(sigma) else f", U (k = 2) {significant(COVERAGE * sigma, 'mrad', 2)}"
    name = "Normal" if found.shape.kind in ("plane", "circle") else "Direction"
    direction = found.shape.direction
    return Quantity(
        "fitted.direction", name, direction.tolist(), shown=f"{triple(direction, 6)}{known}"
    )


POSITIVE = {
    "plane": "on the side to which the normal points",
    "line": "always: distances from the line",
    "circle": "outside the circle, farther from its centre; in a hole that is in the material",
    "sphere": "outside the ball, farther from its centre; in a hollow that is in the material",
    "cylinder": "farther from the axis than the surface; in a bore that is in the material",
    "cone": "farther from the axis than the surface; in a bore that is in the material",
}
"""Which deviations are positive, by the kind of feature."""

SHOWN = (
    "points.n_feature",
    "fitted.diameter",
    "fitted.diameter_u_mm",
    "fitted.half_angle",
    "fitted.half_angle_u_deg",
    "fitted.point_mm",
    "fitted.direction",
    "fitted.form_mm",
)
"""What a relation tells people of each of its features; programs are told all."""


def _counts(first: PointCounts, second: PointCounts) -> PointCounts:
    """Of both features together; a point may be of both."""
    return PointCounts(
        n_given=first.n_given,
        n_region=max(first.n_region, second.n_region),
        n_feature=first.n_feature + second.n_feature,
        n_fitted=first.n_fitted + second.n_fitted,
        feature_rule=f"first: {first.feature_rule}; second: {second.feature_rule}",
        fit_rule=first.fit_rule,
    )


ZONE = "width of the zone about the second feature that holds the first one's fit"


def relation_report(found: Relation, cloud: PointCloud) -> InspectionReport:
    """Report of how two features stand to each other."""
    names = f"{found.first.wanted} and {found.second.wanted}"
    told = [Quantity("feature", "", "relation")]
    if found.distance is not None:
        told += length_quantities("distance", "Distance", found.distance, found.distance_text)
    else:
        told.append(fact("Distance", f"none: {found.distance_text}"))
    if found.angle is not None:
        sigma = math.degrees(found.angle.sigma_rad)
        told += [
            angle_quantity("angle", "Angle", found.angle, f"{found.angle_text}; {ANGLE_NOTE}"),
            expanded("angle_u_deg", "angle", sigma, "degrees"),
        ]
    for key in ("parallelism", "perpendicularity"):
        zone = getattr(found, key)
        if zone is not None:
            told += length_quantities(key, key.capitalize(), zone, ZONE)
    for place, one in (("first", found.first), ("second", found.second)):
        for item in feature_quantities(one):
            key = f"{place}.{item.key}" if item.key else ""
            label = f"{place.capitalize()}: {item.label}" if item.key in SHOWN else ""
            told.append(replace(item, key=key, label=label))
    both = (found.first, found.second)
    warnings = (
        *point_warnings(found.first.counts, cloud, "first feature"),
        *point_warnings(found.second.counts, cloud, "second feature"),
        *_doubts(found.first, cloud, "first feature: "),
        *_doubts(found.second, cloud, "second feature: "),
    )
    deviations = np.concatenate([one.fitted.deviations_mm for one in both])
    return InspectionReport(
        title=f"Relation of {names}",
        subtitle=f"{len(deviations):,} points of two features",
        quantities=tuple(told),
        cards=only(told, "distance", "angle"),
        references=tuple(
            (f"{one.wanted} against its fit ({place})", one.fitted)
            for place, one in zip(("first", "second"), both, strict=True)
        ),
        histograms=tuple(
            deviation_histogram(one.fitted, title=f"Distance to the fitted {one.shape.kind}")
            for one in both
        ),
        views=(
            deviation_view(
                cloud.points_mm[np.concatenate([one.rows for one in both])],
                deviations,
                title="Both features",
                frame=cloud.frame,
                reference="each one's own fit",
            ),
        ),
        counts=_counts(found.first.counts, found.second.counts),
        warnings=tuple(dict.fromkeys(warnings)),
    )
