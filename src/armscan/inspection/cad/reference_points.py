# SPDX-License-Identifier: Apache-2.0
"""A cloud laid on points whose places on the part are known: reference points, or markers.

All points hold together, by generalised least squares over what is known of each. A point that the
others exclude is named; what points on a line leave free is named too, and refused.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2, f

from armscan.geometry.arrays import BoolArray, FloatArray, RowRecord, floats
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Cad, Part, Pose
from armscan.geometry.registration import (
    PointMisfit,
    PointPairs,
    closed_form_pose,
    misfits,
    register_points,
    spread_mm,
)
from armscan.inspection.cad.alignment import (
    Alignment,
    DatumUse,
    about_origin,
    free_text,
    middle_and_radius,
    named_motions,
)
from armscan.markers.alignments import Matched
from armscan.markers.match_3d import match_markers
from armscan.records.cloud import PointCloud
from armscan.records.points import MarkerSet

UNLIKELY = 1e-3
"""Chance, for all points together, of a misfit below which the worst point is named."""
OTHER_UNIT = 0.05
"""Part by which the spreads of measured and nominal points may differ: no part is so deformed."""
MIRRORED = 0.2
"""Points that fit a mirror image with less than this part of their rms are mirrored."""
PICK_MM = 5.0
"""A point that was picked in a cloud lies this near to one of its points."""


class ReferencePoints(RowRecord):
    """Points whose places on the part are known.

    Parameters
    ----------
    nominal_mm
        (N, 3) in Cad.
    measured_mm
        (N, 3) the same points in the cloud's frame.
    covariance_mm2
        (N, 3, 3) of each measured less its nominal place, in the cloud's frame; zero for not known.
    is_picked
        True if they were picked roughly in the cloud: the nearest point of the cloud is taken.
    is_marker
        True if they are markers, whose calibration's error is common and not in the covariance.
    """

    names: tuple[str, ...]
    nominal_mm: FloatArray = floats("N", 3)
    measured_mm: FloatArray = floats("N", 3)
    covariance_mm2: FloatArray = floats("N", 3, 3)
    is_picked: bool = False
    is_marker: bool = False
    notes: tuple[str, ...] = ()


def paired_markers(
    nominal: MarkerSet, measured: MarkerSet, *, by_number: bool
) -> ReferencePoints | FitFailure:
    """Measured markers, in the cloud's frame, beside their nominal places in Cad.

    ``by_number``: equal numbers are the same marker; else their distances match them.
    """
    notes: tuple[str, ...] = ()
    if by_number:
        _, a, b = np.intersect1d(nominal.ids, measured.ids, return_indices=True)
    else:
        found = match_markers(nominal, measured)
        if not isinstance(found, Matched):
            return FitFailure(
                f"the markers cannot be matched by their distances: {found.reason}", found.remedy
            )
        a, b = found.alignment.pairs[:, 0], found.alignment.pairs[:, 1]
    lost = len(measured) - len(b)
    if lost:
        notes = (f"{lost} of {len(measured)} measured markers have no nominal place",)
    noise = np.trace(nominal.covariance_mm2[a], axis1=1, axis2=2) / 3.0
    return ReferencePoints(
        names=tuple(f"marker {number}" for number in nominal.ids[a].tolist()),
        nominal_mm=nominal.points_mm[a],
        measured_mm=measured.points_mm[b],
        covariance_mm2=measured.covariance_mm2[b] + noise[:, None, None] * np.eye(3),
        is_marker=True,
        notes=notes,
    )


def align_points(cloud: PointCloud, points: ReferencePoints) -> Alignment | FitFailure:
    """Lay a cloud on measured points.

    Returns
    -------
    Alignment
        Without known sigmas its covariance follows from how far the points disagree. A point that
        the others exclude (Baarda's test, or its F where no sigma is known) is in the notes.
    FitFailure
        If they leave motions free, which are named; if they are mirrored, or in another unit.
    """
    if points.is_picked:
        picked = _picked(cloud, points)
        if isinstance(picked, FitFailure):
            return picked
        points = picked
    failure = _degenerate(points)
    failure = _unlike(points) if failure is None else failure
    if failure is not None:
        return failure
    is_known = bool((np.trace(points.covariance_mm2, axis1=1, axis2=2) > 0.0).all())
    covariance = points.covariance_mm2 if is_known else np.tile(np.eye(3), (len(points), 1, 1))
    pairs = PointPairs(
        points_a_mm=points.nominal_mm,
        points_b_mm=points.measured_mm,
        covariance_a_mm2=np.zeros_like(covariance),
        covariance_b_mm2=covariance,
    )
    fit: Estimate[Pose[Cad, Part]] | FitFailure
    fit = register_points(pairs if is_known else _finer(pairs, points))
    if isinstance(fit, FitFailure):
        return fit
    off = misfits(pairs if is_known else _finer(pairs, points), fit)
    return _described(cloud, points, fit, off, is_known=is_known)


FINE = 1e-6
"""Sigma, over the spread of the points, that is stated for points about which none is known: the
equal weights are all that counts, and a large one would make every triangle a line."""


def _finer(pairs: PointPairs, points: ReferencePoints) -> PointPairs:
    size = (FINE * float(spread_mm(points.nominal_mm)[0])) ** 2
    return replace(pairs, covariance_b_mm2=pairs.covariance_b_mm2 * size)


def _picked(cloud: PointCloud, points: ReferencePoints) -> ReferencePoints | FitFailure:
    """The cloud's points where somebody picked."""
    found = cKDTree(cloud.points_mm).query(points.measured_mm)
    distance, row = np.asarray(found[0]), np.asarray(found[1])
    far = np.flatnonzero(distance > PICK_MM)
    if len(far):
        k = int(far[0])
        return FitFailure(
            f"the point {points.names[k]} was picked {distance[k]:.3g} mm from the cloud's nearest "
            "point",
            "give picked places in the frame of this cloud",
        )
    return replace(points, measured_mm=cloud.points_mm[row], is_picked=False)


def _degenerate(points: ReferencePoints) -> FitFailure | None:
    """Name what too few points, or points on a line, leave free."""
    nominal = points.nominal_mm
    n = len(nominal)
    if n == 0:
        return FitFailure("there is no reference point", "measure three that span a triangle")
    variance = np.trace(points.covariance_mm2, axis1=1, axis2=2) / 3.0
    weights, sigma = np.ones(n), math.sqrt(float(variance.max()))
    if (variance > 0.0).all():
        # one rough point among good ones takes nothing from what these hold
        weights, sigma = 1.0 / variance, 1.0 / math.sqrt(float(np.mean(1.0 / variance)))
    spread, own = spread_mm(nominal), spread_mm(nominal, weights)
    if spread[1] > max(1e-3 * float(spread[0]), 1e-6) and own[1] > 10.0 * sigma and n > 2:
        return None
    least = max(10.0 * sigma, 1e-3 * float(own[0]), 1e-6)
    centre, radius = middle_and_radius(nominal)
    radius = max(radius, 1.0)
    offset = nominal - centre
    rows = np.concatenate([np.concatenate([np.cross(offset, way) / radius, np.tile(way, (n, 1))],
                                          axis=1) for way in np.eye(3)])  # fmt: skip
    share = np.tile(weights / weights.sum(), 3)
    values, vectors = np.linalg.eigh(rows.T @ (rows * share[:, None]))
    unit = np.repeat([1.0 / radius, 1.0], 3)
    free = vectors[:, values < max((least / radius) ** 2, 1e-12)] * unit[:, None]
    text = free_text(named_motions(free, centre, radius), ", ") or "a turn"
    what = "point" if n == 1 else "points" if n == 2 else "points lie on a line: they"
    return FitFailure(
        f"{n} reference {what} {'leaves' if n == 1 else 'leave'} {text} free",
        "measure three or more that span a triangle",
    )


def _unlike(points: ReferencePoints) -> FitFailure | None:
    """Notice points in another unit, mirrored ones, and lists of other points."""
    given, nominal = points.measured_mm, points.nominal_mm
    ratio = float(np.linalg.norm(spread_mm(given)) / np.linalg.norm(spread_mm(nominal)))
    if abs(ratio - 1.0) > OTHER_UNIT:
        return FitFailure(
            f"the measured points spread {ratio:.4g} times as far as the nominal ones",
            "give both in mm, and the same points in the same order",
        )
    pose: Pose[Cad, Part] = closed_form_pose(nominal, given)
    mirror = given * np.array([1.0, 1.0, -1.0])
    other: Pose[Cad, Part] = closed_form_pose(nominal, mirror)
    size = float(np.linalg.norm(spread_mm(nominal)))
    own, mirrored = _rms(nominal, pose.apply(given)), _rms(nominal, other.apply(mirror))
    if own > 1e-3 * size and mirrored < MIRRORED * own:
        return FitFailure(
            f"the measured points fit the mirror image of the nominal ones ({mirrored:.3g} mm rms, "
            f"and {own:.3g} mm as they are)",
            "look whether an axis of one list is reversed",
        )
    return None


def _rms(a: FloatArray, b: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


def _described(
    cloud: PointCloud,
    points: ReferencePoints,
    fit: Estimate[Pose[Cad, Part]],
    off: PointMisfit[Cad],
    *,
    is_known: bool,
) -> Alignment:
    pose = fit.value
    size = 1.0 if is_known else fit.chi2 / fit.degrees_of_freedom
    # the fit's turn leaves the translation alone; a step of an alignment carries the whole cloud
    covariance = about_origin(fit.covariance * size, pose.translation_mm)
    centre, _ = middle_and_radius(pose.apply(cloud.points_mm))
    distance = np.linalg.norm(fit.residuals, axis=1)
    sigma = _sigmas(points, fit, size, is_known=is_known)
    noun = "markers" if points.is_marker else "points"
    rule = (
        f"from the covariances of the {noun}' places"
        if is_known
        else f"from how far the {noun} disagree: no sigma of them is told"
    )
    if points.is_marker:
        rule += "; an error of the calibration moves all markers alike and is not in it"
    return Alignment(
        method="markers" if points.is_marker else "points",
        cad_from_part=pose,
        centre_mm=centre,
        step_covariance=about_origin(covariance, -centre),
        covariance=covariance,
        rows=np.zeros(0, dtype=np.int64),
        influence=np.zeros((6, 0)),
        normals=np.zeros((0, 3)),
        n_used=len(points),
        rms_mm=float(np.sqrt(np.mean(distance**2))),
        sigma_rule=rule,
        datums=tuple(
            DatumUse(name, 1, (), float(left), float(own))
            for name, left, own in zip(points.names, distance, sigma, strict=True)
        ),
        notes=(*points.notes, *_notes(points, fit, off, is_known=is_known)),
    )


def _sigmas(
    points: ReferencePoints, fit: Estimate[Pose[Cad, Part]], size: float, *, is_known: bool
) -> FloatArray:
    """(N,) root of the mean variance an axis of each point's place."""
    if is_known:
        return np.asarray(np.sqrt(np.trace(points.covariance_mm2, axis1=1, axis2=2) / 3.0))
    one = FINE * float(spread_mm(points.nominal_mm)[0])
    return np.full(len(points), one * math.sqrt(size))


def _notes(
    points: ReferencePoints,
    fit: Estimate[Pose[Cad, Part]],
    off: PointMisfit[Cad],
    *,
    is_known: bool,
) -> list[str]:
    """The point that does not fit, and points that disagree more than their sigmas allow."""
    worst = off.moved(UNLIKELY) if is_known else _odd_one(off.chi2, fit)
    if worst is not None:
        far = float(np.linalg.norm(off.offset_mm[worst]))
        return [
            f"the point {points.names[worst]} does not fit: it lies {far:.3g} mm from where the "
            "others put it; measure it again, or leave it out"
        ]
    if is_known and fit.chi2 > chi2.isf(UNLIKELY, fit.degrees_of_freedom):
        ratio = math.sqrt(fit.chi2 / fit.degrees_of_freedom)
        return [f"the points disagree {ratio:.2g} times as much as their sigmas say"]
    return []


def _odd_one(square: FloatArray, fit: Estimate[Pose[Cad, Part]]) -> int | None:
    """The worst point where no sigma is known: its square against the other points' (F)."""
    rest = fit.degrees_of_freedom - 3
    is_told: BoolArray = np.isfinite(square)
    if rest < 1 or not is_told.any():
        return None
    square = np.where(is_told, square, 0.0)
    worst = int(np.argmax(square))
    others = max(fit.chi2 - float(square[worst]), np.finfo(np.float64).tiny)
    ratio = (float(square[worst]) / 3.0) / (others / rest)
    limit = float(f.isf(UNLIKELY / int(is_told.sum()), 3, rest))
    return worst if ratio > limit else None
