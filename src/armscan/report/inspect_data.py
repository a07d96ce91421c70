# SPDX-License-Identifier: Apache-2.0
"""What an inspection found, as plain values for programs."""

from __future__ import annotations

from typing import Any

from armscan.inspection.results import (
    Deviations,
    MeasuredLength,
    PlaneInspection,
    PointCounts,
    SphereInspection,
    StepInspection,
)


def plane_data(found: PlaneInspection) -> dict[str, Any]:
    """A flat face."""
    return {
        "feature": "plane",
        "points": counts_data(found.counts),
        "fitted": {
            "plane": found.plane.coefficients.tolist(),
            **deviations_data(found.fitted),
        },
        "nominal": None
        if found.nominal is None
        else {
            "offset": None if found.offset is None else length_data(found.offset),
            "tilt_mrad": found.tilt_mrad,
            **deviations_data(found.nominal),
        },
    }


def sphere_data(found: SphereInspection) -> dict[str, Any]:
    """A ball."""
    error = found.diameter.value_mm - found.nominal_diameter_mm
    return {
        "feature": "sphere",
        "points": counts_data(found.counts),
        "diameter_error_mm": error,
        "fitted": {
            "diameter": length_data(found.diameter),
            "centre_mm": found.sphere.centre_mm.tolist(),
            "seen_cap_deg": found.seen_cap_deg,
            **deviations_data(found.fitted),
        },
        "nominal": {
            "diameter_mm": found.nominal_diameter_mm,
            **deviations_data(found.nominal),
        },
    }


def step_data(found: StepInspection) -> dict[str, Any]:
    """A step."""
    error = found.height.value_mm - found.nominal_height_mm
    mean, std = float(found.heights_mm.mean()), float(found.heights_mm.std(ddof=1))
    return {
        "feature": "step",
        "points": counts_data(found.counts),
        "height_error_mm": error,
        "fitted": {
            "height": length_data(found.height),
            "normal": found.normal.tolist(),
            "normal_from": found.normal_rule,
            **deviations_data(found.fitted),
        },
        "nominal": {
            "height_mm": found.nominal_height_mm,
            "mean_height_mm": mean,
            "std_height_mm": std,
            **deviations_data(found.nominal),
        },
    }


def length_data(length: MeasuredLength) -> dict[str, Any]:
    """A length for programs."""
    return {
        "value_mm": length.value_mm,
        "sigma_mm": length.sigma_mm,
        "sigma_scatter_mm": length.sigma_scatter_mm,
        "sigma_propagated_mm": length.sigma_propagated_mm,
    }


def deviations_data(deviations: Deviations) -> dict[str, Any]:
    """Deviations' statistics for programs, with their definitions."""
    return {
        "reference": deviations.reference,
        "counted_from": deviations.reference_text,
        "points": deviations.points_text,
        **{item.key: item.value for item in deviations.statistics},
        "definitions": {item.key: item.definition for item in deviations.statistics},
    }


def counts_data(counts: PointCounts) -> dict[str, Any]:
    """Counts for programs."""
    return {
        "n_given": counts.n_given,
        "n_region": counts.n_region,
        "n_feature": counts.n_feature,
        "n_fitted": counts.n_fitted,
        "n_outliers": counts.n_outliers,
        "feature_rule": counts.feature_rule,
        "fit_rule": counts.fit_rule,
    }
