# SPDX-License-Identifier: Apache-2.0
"""A flat face against a plane (figure 5.12)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane, fit_plane
from armscan.inspection.results import (
    PlaneInspection,
    PointCounts,
    describe_deviations,
)
from armscan.inspection.selection import (
    MIN_POINTS,
    OUTLIER_RULE,
    SEARCH_BAND_MM,
    SEARCH_SIGMAS,
    InspectionOptions,
    Selection,
    dominant_flat,
    fit_robustly,
    least_concentration,
    select,
)
from armscan.inspection.uncertainty import FitLinearised, measured_length
from armscan.records.cloud import PointCloud

BIN_MM = 0.1
"""Heights along a normal are counted in bins of this width."""


def inspect_plane(
    cloud: PointCloud,
    reference: Plane | None = None,
    *,
    reference_covariance: FloatArray | None = None,
    reference_text: str = "the given plane",
    region: Box | None = None,
    options: InspectionOptions | None = None,
) -> PlaneInspection | FitFailure:
    """Inspect a flat face; fails where all of its points but a few lie in one light sheet.

    Parameters
    ----------
    cloud
        Points in any frame.
    reference
        The plane to be met, in the same frame; without it the plane that most points of several
        stripes lie near is looked for, and only the fitted reference is reported.
    reference_covariance
        (3, 3) what it errs itself, of `armscan.geometry.shapes.PLANE_PARAMETERS` (rad, rad, mm) at
        its point, as of a probed plate; zeros where it is exact, None where that is not known.
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
    selection = select(cloud, region, options)
    lone = selection.in_one_sheet()
    if lone is not None:
        return lone
    points = selection.points_mm
    middle = points.mean(axis=0)
    start = reference if reference is not None else _search(points, middle, selection.stripe)
    if isinstance(start, FitFailure):
        return start
    if reference is None:
        reference_text = "the face that most points lie near"
    is_near = np.abs(start.distance_mm(points)) <= selection.feature_mm
    if reference is None and int(is_near.sum()) < MIN_POINTS:
        return FitFailure(
            f"there is no flat face: at the best place for one, {int(is_near.sum())} of "
            f"{len(points)} points lie within {selection.feature_mm:g} mm, {MIN_POINTS} are needed",
            "show where the face is with --region, or give the plane it should be",
        )
    if int(is_near.sum()) < MIN_POINTS:
        return FitFailure(
            f"{int(is_near.sum())} of {len(points)} points lie within {selection.feature_mm:g} mm "
            f"of {reference_text}; the nearest is "
            f"{np.abs(start.distance_mm(points)).min():.3g} mm away",
            "check the plane, its frame and its unit (mm), or widen --feature-mm",
        )
    found = _inspected(selection, is_near, start, reference, reference_text)
    if reference_covariance is None or isinstance(found, FitFailure):
        return found
    return with_reference_errors(found, reference_covariance)


def with_reference_errors(found: PlaneInspection, covariance: FloatArray) -> PlaneInspection:
    """The same with what the reference errs itself in the offset's standard deviations.

    ``covariance`` is as ``reference_covariance`` of `inspect_plane`. Without a reference nothing
    changes.
    """
    reference, offset = found.reference, found.offset
    if reference is None or offset is None:
        return found
    along = reference.axes[:2] @ (found.plane.point_mm - reference.point_mm)
    slope = np.append(along, 1.0)
    own_mm = math.sqrt(max(float(slope @ covariance @ slope), 0.0))
    return replace(found, offset=offset.with_independent(own_mm), reference_sigma_mm=own_mm)


def _search(points: FloatArray, middle: FloatArray, stripe: IntArray | None) -> Plane | FitFailure:
    normal = dominant_flat(points - middle, stripe)
    if isinstance(normal, FitFailure):
        return normal
    heights = (points - middle) @ normal
    # the densest bin: a median would fall between two faces; bins without points would fill the
    # memory, as strays may lie far away
    low = float(heights.min())
    filled, counts = np.unique(np.floor((heights - low) / BIN_MM), return_counts=True)
    height = low + (float(filled[int(counts.argmax())]) + 0.5) * BIN_MM
    near = points[np.abs(heights - height) <= SEARCH_BAND_MM]
    fit = fit_plane(near)
    return fit if isinstance(fit, FitFailure) else fit.value


def _inspected(
    selection: Selection,
    is_feature: BoolArray,
    start: Plane,
    reference: Plane | None,
    reference_text: str,
) -> PlaneInspection | FitFailure:
    lone = selection.in_one_sheet(is_feature)
    if lone is not None:
        return lone
    cloud, band = selection.cloud, f"within {selection.feature_mm:g} mm"
    feature = selection.rows[is_feature]
    points = cloud.points_mm[feature]
    fit = fit_robustly(points, start, fit_plane)
    if isinstance(fit, FitFailure):
        return fit
    plane, is_fitted = fit
    off_mm = np.abs(plane.distance_mm(points))
    failure = None if reference is not None else _unlike(selection, is_feature, off_mm)
    if failure is not None:
        return failure
    towards, side_text = _positive(plane, reference, cloud, feature)
    plane = _facing(plane, towards)
    counts = PointCounts(
        n_given=len(cloud),
        n_region=len(selection.rows),
        n_feature=len(feature),
        n_fitted=int(is_fitted.sum()),
        feature_rule=f"points {band} of {reference_text}",
        fit_rule=OUTLIER_RULE,
    )
    text = f"all {len(feature)} points {band} of {reference_text}"
    fitted = describe_deviations(
        plane.distance_mm(points), "fitted", "the least-squares plane of these points", text
    )
    nominal, offset, tilt, n_beyond = None, None, math.nan, 0
    if reference is not None:
        nominal = describe_deviations(
            reference.distance_mm(points), "nominal", reference_text, text
        )
        used = feature[is_fitted]
        height = float(reference.distance_mm(plane.point_mm[None, :])[0])
        linear = linearised_plane(plane, cloud.points_mm[used])
        offset = measured_length(height, OFFSET_OF_PLANE, linear, cloud, used)
        sine = np.linalg.norm(np.cross(plane.normal, reference.normal))
        tilt = 1000.0 * math.asin(min(1.0, float(sine)))
        is_on = np.abs(plane.distance_mm(selection.points_mm)) <= SEARCH_BAND_MM
        n_beyond = int(is_on.sum()) - int((off_mm <= SEARCH_BAND_MM).sum())
    return PlaneInspection(
        plane=plane,
        reference=reference,
        rows=feature,
        is_fitted=is_fitted,
        counts=counts,
        fitted=fitted,
        nominal=nominal,
        offset=offset,
        tilt_mrad=tilt,
        side_text=side_text,
        n_beyond=n_beyond,
    )


def _unlike(selection: Selection, is_feature: BoolArray, off_mm: FloatArray) -> FitFailure | None:
    """Why points (F,) this far off their plane make no face, though they lie about it; else None.

    Near is what the points' own sigma may throw off it, as of a ball.
    """
    bands_mm = selection.search_band_mm[is_feature]
    band_mm, n_near = float(np.median(bands_mm)), int((off_mm <= bands_mm).sum())
    if n_near >= least_concentration(band_mm, selection.feature_mm) * len(off_mm):
        return None
    facts = (
        f"at the best place for one, only {n_near} of {len(off_mm)} points within "
        f"{selection.feature_mm:g} mm of its plane lie within {band_mm:.3g} mm"
    )
    remedy = "show where the face is with --region, or give the plane it should be"
    widest = 2.0 * SEARCH_SIGMAS * float(np.median(selection.sigma_mm[is_feature]))
    if widest > selection.feature_mm:
        # half of it is the widest band; rounding must not bring it below
        own = f"give --feature-mm {1.05 * widest:.2g}, as the points' stated sigma asks for"
        remedy = f"{own}; or {remedy}"
    return FitFailure(f"there is no flat face: {facts}", remedy)


def _positive(
    plane: Plane, reference: Plane | None, cloud: PointCloud, feature: IntArray
) -> tuple[FloatArray, str]:
    """A direction (3,) to the side where deviations are positive, and that side in words.

    The scanned side, where nothing is given and the cloud knows it; else the same at every run.
    """
    if reference is not None:
        return reference.normal, "on the side to which the nominal plane's normal points"
    if cloud.normals is not None and cloud.normals[feature].any():
        return cloud.normals[feature].mean(axis=0), "on the scanned side, as the normals tell"
    axis = int(np.argmax(np.abs(plane.normal)))
    return np.eye(3)[axis], f"on the side of +{'xyz'[axis]}: the cloud has no normals"


def _facing(plane: Plane, towards: FloatArray) -> Plane:
    """The plane with its normal to the side of ``towards`` (3,)."""
    if float(towards @ plane.normal) >= 0.0:
        return plane
    return Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))


OFFSET_OF_PLANE = np.array([0.0, 0.0, 1.0])
"""Derivatives of the offset at the plane's point by the parameters of `linearised_plane`: turns
about its axes, and that offset."""


def linearised_plane(plane: Plane, points_mm: FloatArray) -> FitLinearised:
    """The fit of a plane to points (N, 3) about its optimum."""
    local = (points_mm - plane.point_mm) @ plane.axes.T
    return FitLinearised(
        -np.column_stack([local[:, 0], local[:, 1], np.ones(len(local))]),
        np.tile(plane.normal, (len(local), 1)),
        local[:, 2],
    )
