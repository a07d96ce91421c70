# SPDX-License-Identifier: Apache-2.0
"""A flat face against a plane (figure 5.12)."""

from __future__ import annotations

import math

import numpy as np

from armscan.geometry.arrays import Box, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane, fit_plane
from armscan.inspection.results import (
    MeasuredLength,
    PlaneInspection,
    PointCounts,
    describe_deviations,
)
from armscan.inspection.selection import (
    LEAST_CONCENTRATION,
    InspectionOptions,
    Selection,
    dominant_flat,
    fit_robustly,
    outlier_rule,
    select,
)
from armscan.inspection.uncertainty import FitLinearised, measured_length
from armscan.records.cloud import PointCloud


def inspect_plane(
    cloud: PointCloud,
    reference: Plane | None = None,
    *,
    reference_text: str = "the given plane",
    region: Box | None = None,
    options: InspectionOptions | None = None,
) -> PlaneInspection | FitFailure:
    """Inspect a flat face.

    Parameters
    ----------
    cloud
        Points in any frame.
    reference
        The plane to be met, in the same frame; without it the plane that most points lie near is
        looked for, and only the fitted reference is reported.
    reference_text
        Where it came from, for the definitions.
    region
        Only points inside are looked at.
    options
        What belongs to the face; the default if None.

    Raises
    ------
    InputError
        If there are too few points.
    """
    options = options or InspectionOptions()
    selection = select(cloud, region, options, options.min_points)
    points = selection.points_mm
    middle = points.mean(axis=0)
    start = reference if reference is not None else _search(points, middle, options)
    if isinstance(start, FitFailure):
        return start
    is_near = np.abs(start.distance_mm(points)) <= options.feature_mm
    if int(is_near.sum()) < options.min_points:
        return FitFailure(
            f"{int(is_near.sum())} of {len(points)} points lie within {options.feature_mm:g} mm of "
            f"{reference_text}; the nearest is {_nearest(start, points):.3g} mm away",
            "check the plane, its frame and its unit (mm), or widen --feature-mm",
        )
    feature = selection.rows[is_near]
    return _inspected(selection, feature, start, reference, reference_text)


def _search(
    points: FloatArray, middle: FloatArray, options: InspectionOptions
) -> Plane | FitFailure:
    normal = dominant_flat(points - middle, options.search_band_mm)
    if isinstance(normal, FitFailure):
        return normal
    heights = (points - middle) @ normal
    # the densest bin: a median would fall between two faces
    edges = np.arange(heights.min(), heights.max() + 2 * options.search_band_mm, 0.1)
    counts = np.histogram(heights, edges)[0]
    height = float(edges[int(counts.argmax())]) + 0.05
    near = points[np.abs(heights - height) <= options.search_band_mm]
    fit = fit_plane(near)
    return fit if isinstance(fit, FitFailure) else fit.value


def _nearest(plane: Plane, points: FloatArray) -> float:
    return float(np.abs(plane.distance_mm(points)).min())


def _inspected(
    selection: Selection,
    feature: IntArray,
    start: Plane,
    reference: Plane | None,
    reference_text: str,
) -> PlaneInspection | FitFailure:
    cloud, options = selection.cloud, selection.options
    points = cloud.points_mm[feature]
    fit = fit_robustly(points, start, _plane, Plane.distance_mm, options)
    if isinstance(fit, FitFailure):
        return fit
    plane, is_fitted = fit
    near = np.abs(plane.distance_mm(points)) <= options.search_band_mm
    if reference is None and float(near.mean()) < LEAST_CONCENTRATION:
        return FitFailure(
            f"there is no flat face: at the best place for one, only {int(near.sum())} of "
            f"{len(near)} points within {options.feature_mm:g} mm of its plane lie within "
            f"{options.search_band_mm:g} mm",
            "show where the face is with --region, or give the plane it should be",
        )
    towards = start if reference is not None else _towards_sensor(cloud, feature, plane)
    plane = _facing(plane, towards)
    near_text = reference_text if reference is not None else "the face that most points lie near"
    counts = PointCounts(
        n_given=len(cloud),
        n_region=len(selection.rows),
        n_feature=len(feature),
        n_fitted=int(is_fitted.sum()),
        feature_rule=f"points within {options.feature_mm:g} mm of {near_text}",
        fit_rule=outlier_rule(options),
    )
    text = f"all {len(feature)} points within {options.feature_mm:g} mm of {near_text}"
    fitted = describe_deviations(
        plane.distance_mm(points), "fitted", "the least-squares plane of these points", text
    )
    nominal, offset, tilt = None, None, math.nan
    if reference is not None:
        nominal = describe_deviations(
            reference.distance_mm(points), "nominal", reference_text, text
        )
        offset = _offset(plane, reference, cloud, feature[is_fitted])
        sine = np.linalg.norm(np.cross(plane.normal, reference.normal))
        tilt = 1000.0 * math.asin(min(1.0, float(sine)))
    return PlaneInspection(
        plane, reference, feature, is_fitted, counts, fitted, nominal, offset, tilt
    )


def _plane(points: FloatArray) -> Plane | FitFailure:
    fit = fit_plane(points)
    return fit if isinstance(fit, FitFailure) else fit.value


def _towards_sensor(cloud: PointCloud, feature: IntArray, plane: Plane) -> Plane:
    """The fitted plane with its normal to the side that was scanned, where the cloud knows it."""
    if cloud.normals is None:
        return plane
    return (
        plane if float(cloud.normals[feature].mean(axis=0) @ plane.normal) >= 0 else _turned(plane)
    )


def _facing(plane: Plane, towards: Plane) -> Plane:
    return plane if float(plane.normal @ towards.normal) >= 0.0 else _turned(plane)


def _turned(plane: Plane) -> Plane:
    return Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))


def linearised_plane(plane: Plane, points_mm: FloatArray) -> FitLinearised:
    """The fit of a plane to points (N, 3) about its optimum; the length is the offset at
    ``plane.point_mm``.
    """
    local = (points_mm - plane.point_mm) @ plane.axes.T
    return FitLinearised(
        -np.column_stack([local[:, 0], local[:, 1], np.ones(len(local))]),
        np.tile(plane.normal, (len(local), 1)),
        local[:, 2],
        np.array([0.0, 0.0, 1.0]),
    )


def _offset(plane: Plane, reference: Plane, cloud: PointCloud, used: IntArray) -> MeasuredLength:
    fit = linearised_plane(plane, cloud.points_mm[used])
    height = float(reference.distance_mm(plane.point_mm[None, :])[0])
    return measured_length(height, fit, cloud, used)
