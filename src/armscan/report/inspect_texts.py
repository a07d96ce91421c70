# SPDX-License-Identifier: Apache-2.0
"""What an inspection found, put in words, figures and pictures."""

from __future__ import annotations

import math

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.histogram import within_key
from armscan.inspection.results import (
    Deviations,
    MeasuredLength,
    PlaneInspection,
    PointCounts,
    SphereInspection,
    StepInspection,
)
from armscan.records.cloud import PointCloud
from armscan.report.deviation_figures import (
    BAND_MM,
    deviation_histogram,
    deviation_view,
    height_histogram,
    share_text,
)
from armscan.report.inspect_data import plane_data, sphere_data, step_data
from armscan.report.inspect_page import InspectionReport
from armscan.report.numbers import significant, with_sigma
from armscan.report.page import Card, Picture

NO_SIGMA = (
    "the cloud carries no standard deviations and no exposures, so it is not known how well the "
    "fit is determined"
)
STILL_SIGMA = (
    "Sigma of the height",
    "not known from one exposure: its error is the calibration's, which shifts both faces nearly "
    "alike",
)
NARROW_CAP_DEG = 60.0
MANY_OUTLIERS = 0.01
FOREIGN_FRAME = "a frame that the file does not name"


def plane_report(found: PlaneInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a flat face."""
    main = found.nominal or found.fitted
    references = [("against the fitted plane", found.fitted)]
    histograms = [
        deviation_histogram(
            found.fitted, title="Distance to the fitted plane", axis_label="distance, mm"
        )
    ]
    geometry = [
        ("Plane A, B, C, D", _coefficients(found.plane.coefficients)),
        ("Middle of the points", f"{_triple(found.plane.point_mm)} mm"),
    ]
    facts = list(_count_facts(found.counts))
    cards = [_share_card(main), _form_card(found.fitted)]
    if found.nominal is not None and found.offset is not None:
        references.insert(0, ("against the nominal plane", found.nominal))
        histograms.insert(
            0,
            deviation_histogram(
                found.nominal, title="Distance to the nominal plane", axis_label="distance, mm"
            ),
        )
        offset = length_text(found.offset)
        facts.append(("offset", f"{offset} over the nominal plane, at the middle of the points"))
        facts.append(("tilt", f"{significant(found.tilt_mrad)} mrad to the nominal plane"))
        cards.append(Card("Offset", offset, "of the fitted plane over the nominal one"))
        geometry += facts[-2:]
    cards.append(_points_card(found.counts))
    return InspectionReport(
        title="Plane inspected",
        subtitle=_subtitle(found.counts, cloud),
        cards=tuple(cards),
        facts=tuple(facts),
        references=tuple(references),
        histograms=tuple(histograms),
        views=(_view(cloud, found.rows, main),),
        counts=found.counts,
        geometry=tuple(geometry),
        warnings=_warnings(found.counts, cloud),
        data=plane_data(found),
    )


def sphere_report(found: SphereInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a ball."""
    error = found.diameter.value_mm - found.nominal_diameter_mm
    diameter = length_text(found.diameter)
    geometry = (
        ("Fitted diameter", diameter),
        ("Nominal diameter", f"{found.nominal_diameter_mm:g} mm"),
        ("Fitted minus nominal", f"{error:+.4f} mm"),
        ("Centre", f"{_triple(found.sphere.centre_mm)} mm"),
        ("Seen cap", f"half opening {found.seen_cap_deg:.0f} degrees; the whole ball is 180"),
        *_sigma_facts(found.diameter, "diameter"),
    )
    warnings = list(_warnings(found.counts, cloud))
    if found.seen_cap_deg < NARROW_CAP_DEG:
        warnings.append(
            f"the points cover a cap of only {found.seen_cap_deg:.0f} degrees half opening, where "
            "centre and diameter are poorly told apart; scan more of the ball"
        )
    return InspectionReport(
        title="Ball inspected",
        subtitle=_subtitle(found.counts, cloud),
        cards=(
            Card("Fitted diameter", diameter, f"nominal {found.nominal_diameter_mm:g} mm"),
            Card("Fitted minus nominal", f"{error:+.4f} mm"),
            _share_card(found.nominal),
            _form_card(found.fitted),
            _points_card(found.counts),
        ),
        facts=(*_count_facts(found.counts), *geometry[:3]),
        references=(
            ("against the standard ball", found.nominal),
            ("against the fitted ball", found.fitted),
        ),
        histograms=(
            deviation_histogram(
                found.nominal,
                title="Distance to the centre minus the standard ball's radius",
                axis_label="difference, mm",
            ),
            deviation_histogram(
                found.fitted,
                title="Distance to the centre minus the fitted radius",
                axis_label="difference, mm",
            ),
        ),
        views=(_view(cloud, found.rows, found.nominal),),
        counts=found.counts,
        geometry=geometry,
        warnings=tuple(warnings),
        data=sphere_data(found),
    )


def step_report(found: StepInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a step."""
    error = found.height.value_mm - found.nominal_height_mm
    is_still = len(np.unique(cloud.exposure[np.concatenate([found.lower, found.upper])])) == 1
    height = f"{found.height.value_mm:.4f} mm" if is_still else length_text(found.height)
    mean, std = float(found.heights_mm.mean()), float(found.heights_mm.std(ddof=1))
    geometry = (
        ("Fitted height", height),
        ("Nominal height", f"{found.nominal_height_mm:g} mm"),
        ("Fitted minus nominal", f"{error:+.4f} mm"),
        ("Heights of the points", f"mean {mean:.4f} mm, standard deviation {std:.4f} mm"),
        ("Normal", f"{_triple(found.normal, 6)}: {found.normal_rule}"),
        ("Points", f"{len(found.lower):,} on the lower face, {len(found.upper):,} on the upper"),
        *((STILL_SIGMA,) if is_still else _sigma_facts(found.height, "height")),
    )
    both = np.concatenate([found.lower, found.upper])
    return InspectionReport(
        title="Step inspected",
        subtitle=_subtitle(found.counts, cloud),
        cards=(
            Card("Fitted height", height, f"nominal {found.nominal_height_mm:g} mm"),
            Card("Fitted minus nominal", f"{error:+.4f} mm"),
            Card(
                "Standard deviation", f"{std:.4f} mm", "of the heights of the upper face's points"
            ),
            _points_card(found.counts),
        ),
        facts=(*_count_facts(found.counts), *geometry[:4]),
        references=(
            ("heights of the upper face against the nominal height", found.nominal),
            ("both faces against their fitted planes", found.fitted),
        ),
        histograms=(
            height_histogram(
                found.heights_mm,
                found.nominal_height_mm,
                found.height.value_mm,
                title="Heights of the upper face's points",
            ),
            deviation_histogram(
                found.fitted,
                title="Distance of both faces' points from their fitted planes",
                axis_label="distance, mm",
            ),
        ),
        views=(
            deviation_view(
                cloud.points_mm[both],
                found.fitted.deviations_mm,
                title="Both faces without their margins",
                frame=cloud.frame,
                reference=found.fitted.reference_text,
            ),
        ),
        counts=found.counts,
        geometry=geometry,
        warnings=_warnings(found.counts, cloud),
        data=step_data(found),
    )


def length_text(length: MeasuredLength) -> str:
    """A length with its standard deviation."""
    if math.isnan(length.sigma_mm):
        return f"{length.value_mm:.4f} mm"
    return with_sigma(length.value_mm, length.sigma_mm, "mm")


def _sigma_facts(length: MeasuredLength, name: str) -> tuple[tuple[str, str], ...]:
    return (
        (
            f"Sigma of the {name} from scatter",
            f"{significant(length.sigma_scatter_mm, 'mm')}: from what exposures, and blocks of "
            "neighbouring ones, disagree about (jackknife)",
        ),
        (
            f"Sigma of the {name} propagated",
            f"{significant(length.sigma_propagated_mm, 'mm')}: from the points' covariances, "
            "errors being common to an exposure, or to a block of neighbours: the larger",
        ),
        (
            "Not in either",
            "what a wrong calibration does alike to all exposures: `armscan verify` tests it",
        ),
    )


def _share_card(deviations: Deviations) -> Card:
    share = deviations.value(within_key(BAND_MM))
    return Card(
        f"Within {BAND_MM:g} mm", share_text(share), f"of the {deviations.reference} surface"
    )


def _form_card(fitted: Deviations) -> Card:
    note = f"95 % of the points; standard deviation {significant(fitted.value('std_mm'))} mm"
    return Card("Form, narrowest shell", significant(fitted.value("d95_mm"), "mm"), note)


def _points_card(counts: PointCounts) -> Card:
    return Card(
        "Points",
        f"{counts.n_feature:,}",
        f"of {counts.n_given:,} given; the fit left out {counts.n_outliers:,}",
    )


def _count_facts(counts: PointCounts) -> tuple[tuple[str, str], ...]:
    return (
        (
            "points",
            f"{counts.n_feature} of {counts.n_given} belong to the feature ({counts.feature_rule})",
        ),
        ("outliers", f"{counts.n_outliers} left out by the fit, counted by the statistics"),
    )


def _subtitle(counts: PointCounts, cloud: PointCloud) -> str:
    has_frame = bool(cloud.sheet_names[0]) if cloud.sheet_names else False
    frame = f"the {cloud.frame} frame" if has_frame else FOREIGN_FRAME
    return f"{counts.n_feature:,} points in {frame}"


def _warnings(counts: PointCounts, cloud: PointCloud) -> tuple[str, ...]:
    found = []
    if not cloud.covariance_mm2.any():
        found.append(NO_SIGMA)
    if counts.n_outliers > MANY_OUTLIERS * counts.n_feature:
        share = 100.0 * counts.n_outliers / counts.n_feature
        found.append(f"{share:.1f} % of the feature's points are outliers: see the pictures")
    return tuple(found)


def _view(cloud: PointCloud, rows: IntArray, deviations: Deviations) -> Picture:
    return deviation_view(
        cloud.points_mm[rows],
        deviations.deviations_mm,
        title="The feature's points",
        frame=cloud.frame,
        reference=deviations.reference_text,
    )


def _coefficients(values: FloatArray) -> str:
    a, b, c, d = (float(value) for value in values)
    return f"{a:.7f}, {b:.7f}, {c:.7f}, {d:.4f} mm"


def _triple(values: FloatArray, digits: int = 4) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
