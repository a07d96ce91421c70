# SPDX-License-Identifier: Apache-2.0
"""Features of a cloud: plane, line, circle, sphere, cylinder, cone, and how two of them stand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.linalg import block_diag

from armscan.errors import OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, IntArray, bools, ints
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import (
    Linearised,
    Shape,
    fit_shape,
    linearise,
    moved,
    parameter_names,
)
from armscan.inspection.results import (
    Deviations,
    MeasuredLength,
    PointCounts,
    describe_deviations,
)
from armscan.inspection.search import (
    Sample,
    WantedFeature,
    connected,
    find_shape,
    sample_of,
)
from armscan.inspection.selection import (
    LEAST_CONCENTRATION,
    MIN_POINTS,
    OUTLIER_RULE,
    SEARCH_BAND_MM,
    SEARCH_SIGMAS,
    InspectionOptions,
    Selection,
    fit_robustly,
    select,
)
from armscan.inspection.sphere import cap_deg, post_of
from armscan.inspection.uncertainty import FitErrors, FitLinearised, worst_sigma
from armscan.records.cloud import PointCloud

FORMS = {
    "plane": "flatness",
    "line": "straightness",
    "circle": "roundness",
    "sphere": "form",
    "cylinder": "cylindricity",
    "cone": "form",
}
"""What the range of a kind's deviations is called (ISO 1101); a sphere's and cone's has no name."""
ROUNDS = 4
GAP_SPACINGS = 3.0
"""Gap, in spacings of the search's sample, over which a feature hangs together about a seed."""
LARGEST_SIGMA = 0.2
"""Standard deviation of a diameter, as a part of it, beyond which there is none to speak of."""
SHIFT_MM, TURN_RAD = 1e-5, 1e-8
"""Steps by which a value is differentiated by a shape's parameters. The angle of two features has
a kink where they are parallel or square: large planes stand 1e-6 rad from it.
"""


@dataclass(frozen=True, slots=True)
class MeasuredAngle:
    """An angle with both of its standard deviations, rad; as `MeasuredLength`."""

    value_rad: float
    sigma_scatter_rad: float
    sigma_propagated_rad: float

    @property
    def sigma_rad(self) -> float:
        """As of a length; NaN if neither is known."""
        return MeasuredLength(0.0, self.sigma_scatter_rad, self.sigma_propagated_rad).sigma_mm


class FeatureInspection(ArrayRecord):
    """A feature found in a cloud.

    Parameters
    ----------
    rows
        (N,) rows of the feature's points in the cloud.
    is_fitted
        (N,) True for those that the fit used.
    nominal
        The same with the nominal diameter or half angle; None without one.
    half_angle
        Of a cone; else None.
    direction_sigma_rad
        Standard deviation of the direction, as of `Fitted`; NaN where not known, or none.
    centre_sigma_mm
        Standard deviation of a centre, as of `Fitted`; NaN for other kinds.
    seen_deg
        Angle about the axis, or about a sphere's middle direction, that the points cover; NaN for
        planes and lines.
    length_mm
        Extent of the points along the axis or line; 0 for others.
    scatter_mm
        What neighbouring points scatter by off the faces that they make; NaN where not known.
    post
        Of a sphere, a cylinder to which its points are as near; else None.
    """

    wanted: WantedFeature
    shape: Shape
    rows: IntArray = ints("N")
    is_fitted: BoolArray = bools("N")
    counts: PointCounts
    fitted: Deviations
    nominal: Deviations | None
    diameter: MeasuredLength | None
    half_angle: MeasuredAngle | None
    direction_sigma_rad: float
    centre_sigma_mm: float
    seen_deg: float
    length_mm: float
    scatter_mm: float
    post: Shape | None

    @property
    def form_mm(self) -> float:
        """Range of its deviations, outliers included; of a line the diameter of the tube."""
        if self.shape.kind == "line":
            return 2.0 * float(self.fitted.deviations_mm.max())
        return self.fitted.value("range_mm")

    @property
    def form_name(self) -> str:
        """What the range of its deviations is called."""
        return FORMS[self.shape.kind]


def inspect_feature(
    cloud: PointCloud, wanted: WantedFeature, options: InspectionOptions | None = None
) -> FeatureInspection | FitFailure:
    """Find a feature in a cloud, fit it, and say how well it is known.

    Parameters
    ----------
    cloud
        Points in any frame; other faces may be among them.
    wanted
        What is looked for.
    options
        Which points belong to it; the default if None.

    Raises
    ------
    InputError
        If there are too few points.
    """
    selection = select(cloud, wanted.region, options, size_mm=wanted.radii_mm[1])
    sample = sample_of(selection)
    start = find_shape(sample, wanted)
    if isinstance(start, FitFailure):
        return start
    shape, chosen = start, np.zeros(len(selection.rows), dtype=np.bool_)
    is_fitted = chosen
    for _ in range(ROUNDS):
        found = _belonging(selection, sample, shape, wanted)
        if np.array_equal(found, chosen):
            break
        chosen = found
        if int(chosen.sum()) < MIN_POINTS:
            return FitFailure(
                f"there is no {wanted}: the best place for one has {int(chosen.sum())} of "
                f"{len(chosen)} points on it, {MIN_POINTS} are needed",
                "check the nominal values, or show where it is with --region or --seed",
            )
        refit = partial(fit_shape, shape.kind, start=shape)
        fit = fit_robustly(selection.points_mm[chosen], shape, refit)
        if isinstance(fit, FitFailure):
            return FitFailure(f"there is no {wanted}: {fit.reason}", fit.remedy)
        shape, is_fitted = fit
    failure = _unlike(selection, chosen, shape, wanted)
    if failure is not None:
        return failure
    return _described(selection, wanted, shape, chosen, is_fitted, scatter_mm=sample.scatter_mm)


def inspect_points(
    cloud: PointCloud, wanted: WantedFeature, rule: str
) -> FeatureInspection | FitFailure:
    """Fit a feature to points that are known to be of it, as those of a face of the part's model.

    ``rule`` is how they were chosen, in words, after "points".
    """
    selection = select(cloud, wanted.region, None, size_mm=wanted.radii_mm[1])
    points = selection.points_mm
    first = fit_shape(wanted.kind, points)
    if isinstance(first, FitFailure):
        return first
    start = first.value
    fit = fit_robustly(points, start, partial(fit_shape, start.kind, start=start))
    if isinstance(fit, FitFailure):
        return fit
    shape, is_fitted = fit
    chosen = np.ones(len(points), dtype=np.bool_)
    failure = _unlike(selection, chosen, shape, wanted)
    if failure is not None:
        return failure
    scatter_mm = sample_of(selection).scatter_mm
    return _described(selection, wanted, shape, chosen, is_fitted, scatter_mm=scatter_mm, rule=rule)


def _belonging(
    selection: Selection, sample: Sample, shape: Shape, wanted: WantedFeature
) -> BoolArray:
    """(N,) points near to the shape that face as it does, about the seed those that hang on it."""
    points = selection.points_mm
    chosen = np.abs(shape.distance_mm(points)) <= selection.feature_mm
    if shape.kind not in ("line", "circle"):
        near = points[chosen]
        chosen[chosen] = sample.facing(shape, near, sample.nearest(near))
    if wanted.seed_mm is not None and chosen.any():
        step = GAP_SPACINGS * sample.spacing_mm
        chosen[chosen] = connected(points[chosen], np.asarray(wanted.seed_mm), step)
    return np.asarray(chosen)


def _unlike(
    selection: Selection, chosen: BoolArray, shape: Shape, wanted: WantedFeature
) -> FitFailure | None:
    """Why the shape is none of that kind; None if it is one."""
    lone = selection.in_one_sheet(chosen) if shape.kind == "plane" else None
    if lone is not None:
        return FitFailure(f"there is no {wanted}: {lone.reason}", lone.remedy)
    remedy = "check the nominal values, or show where it is with --region or --seed"
    if not wanted.may_be(shape):
        if shape.kind == "cone":
            return FitFailure(
                f"there is no {wanted}: the points at the best place are of none", remedy
            )
        size = "" if not shape.radius_mm else f" of {2.0 * shape.radius_mm:.4g} mm"
        what = f"there is no {wanted}: the nearest that the points allow is a {shape.kind}{size}"
        return FitFailure(what, remedy)
    # as far as their own sigma throws points off, else a quarter of what would be filled evenly
    quarter = max(selection.feature_mm / 4.0, SEARCH_BAND_MM / 4.0)
    own = np.minimum(SEARCH_SIGMAS * selection.sigma_mm[chosen], selection.feature_mm / 2.0)
    band = np.maximum(np.minimum(selection.search_band_mm[chosen], quarter), own)
    near = np.abs(shape.distance_mm(selection.points_mm[chosen])) <= band
    wider = max(float(np.median(band)) - quarter, 0.0)
    least = LEAST_CONCENTRATION + wider / selection.feature_mm
    if float(near.mean()) < least:
        return FitFailure(
            f"there is no {wanted}: at the best place for one, only {int(near.sum())} of "
            f"{len(near)} points within {selection.feature_mm:g} mm lie within "
            f"{float(np.median(band)):.3g} mm of it",
            remedy,
        )
    return None


def _described(
    selection: Selection,
    wanted: WantedFeature,
    shape: Shape,
    chosen: BoolArray,
    is_fitted: BoolArray,
    *,
    scatter_mm: float,
    rule: str = "",
) -> FeatureInspection | FitFailure:
    cloud, rows = selection.cloud, selection.rows[chosen]
    points = cloud.points_mm[rows]
    shape = _facing(shape, wanted, cloud, rows)
    rule = f"points {rule}" if rule else _found_rule(selection, shape, wanted)
    counts = PointCounts(
        n_given=len(cloud),
        n_region=len(selection.rows),
        n_feature=len(rows),
        n_fitted=int(is_fitted.sum()),
        feature_rule=rule,
        fit_rule=OUTLIER_RULE,
    )
    text = f"all {len(rows)} {rule}"
    own = describe_deviations(
        _deviations(shape, points), "fitted", f"the least-squares {shape.kind}", text
    )
    fit = Fitted(shape, cloud, rows[is_fitted])
    has_diameter = shape.kind in ("circle", "sphere", "cylinder")
    diameter = fit.length(_diameter) if has_diameter else None
    if diameter is not None and diameter.sigma_mm > LARGEST_SIGMA * diameter.value_mm:
        return FitFailure(
            f"the points do not determine the {shape.kind}: its diameter is "
            f"{diameter.value_mm:.3g} mm with a standard deviation of {diameter.sigma_mm:.2g}",
            "scan more of it, or show where it is with --region or --seed",
        )
    return FeatureInspection(
        wanted=wanted,
        shape=shape,
        rows=rows,
        is_fitted=is_fitted,
        counts=counts,
        fitted=own,
        nominal=_nominal(shape, points, wanted, text),
        diameter=diameter,
        half_angle=fit.angle(_half_angle) if shape.kind == "cone" else None,
        direction_sigma_rad=fit.direction_sigma_rad(),
        centre_sigma_mm=fit.centre_sigma_mm() if shape.kind in POINTLIKE else math.nan,
        seen_deg=_seen_deg(shape, points),
        length_mm=float(np.ptp(shape.local_mm(points)[:, 2]))
        if shape.kind in ("line", "cylinder", "cone")
        else 0.0,
        scatter_mm=scatter_mm,
        post=post_of(cloud, rows[is_fitted], shape) if shape.kind == "sphere" else None,
    )


def _found_rule(selection: Selection, shape: Shape, wanted: WantedFeature) -> str:
    """How the points of a feature that was looked for were chosen, in words."""
    rule = f"points within {selection.feature_mm:g} mm of the fitted {shape.kind}"
    if shape.kind not in ("line", "circle"):
        rule += " on faces that look the way it does, to 30 degrees"
    if wanted.seed_mm is not None:
        rule += ", that hang together with the seed"
    return rule


def _diameter(shape: Shape) -> float:
    return 2.0 * shape.radius_mm


def _half_angle(shape: Shape) -> float:
    return shape.half_angle_rad


def _facing(shape: Shape, wanted: WantedFeature, cloud: PointCloud, rows: IntArray) -> Shape:
    """A direction that is the same at every run: the axis given, the scanned side, or upwards."""
    if wanted.axis is not None:
        return shape.turned_to(np.asarray(wanted.axis))
    if shape.kind == "plane" and cloud.normals is not None and cloud.normals[rows].any():
        return shape.turned_to(cloud.normals[rows].mean(axis=0))
    return shape.turned_to(np.eye(3)[int(np.argmax(np.abs(shape.direction)))])


def _deviations(shape: Shape, points: FloatArray) -> FloatArray:
    """Of a circle those in its plane."""
    if shape.kind != "circle":
        return shape.distance_mm(points)
    local = shape.local_mm(points)
    return np.asarray(np.hypot(local[:, 0], local[:, 1]) - shape.radius_mm)


def _nominal(
    shape: Shape, points: FloatArray, wanted: WantedFeature, text: str
) -> Deviations | None:
    if wanted.diameter_mm is not None:
        known = replace(shape, radius_mm=wanted.diameter_mm / 2.0)
        words = f"the nominal diameter of {wanted.diameter_mm:g} mm about the fitted axis or centre"
    elif wanted.half_angle_deg is not None:
        known = replace(shape, half_angle_rad=math.radians(wanted.half_angle_deg))
        words = (
            f"the nominal half angle of {wanted.half_angle_deg:g} degrees about the fitted axis, "
            "as wide at the middle of the points"
        )
    else:
        return None
    return describe_deviations(_deviations(known, points), "nominal", words, text)


def _seen_deg(shape: Shape, points: FloatArray) -> float:
    """Full turn less the widest gap about the axis; of a sphere the widest angle of its cap."""
    local = shape.local_mm(points)
    if shape.kind in ("plane", "line"):
        return math.nan
    if shape.kind == "sphere":
        return 2.0 * cap_deg(local)
    turn = np.sort(np.arctan2(local[:, 1], local[:, 0]))
    gaps = np.diff(np.concatenate([turn, [turn[0] + 2.0 * math.pi]]))
    return 360.0 - math.degrees(float(gaps.max()))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted shape with the rows (N,) of the cloud that it was fitted to."""

    shape: Shape
    cloud: PointCloud
    rows: IntArray

    def linearised(self) -> Linearised:
        """The fit about its optimum, of a circle with its plane."""
        return linearise(self.shape, self.cloud.points_mm[self.rows], with_plane=True)

    @cached_property
    def errors(self) -> FitErrors:
        """What its parameters err by, for all lengths that follow from them."""
        return _errors_of((self,))

    def length(self, value: Callable[[Shape], float]) -> MeasuredLength:
        """A length that follows from the shape."""
        return together((self,), lambda shapes: value(shapes[0]))

    def angle(self, value: Callable[[Shape], float]) -> MeasuredAngle:
        """An angle, rad, that follows from the shape."""
        return as_angle(self.length(value))

    def direction_sigma_rad(self) -> float:
        """Standard deviation of the direction along the worst way; NaN for a sphere."""
        if self.shape.kind == "sphere":
            return math.nan
        return self._worst_sigma(self.shape.axes[:2], _along)

    def centre_sigma_mm(self) -> float:
        """Standard deviation of a centre along the worst way in space."""
        return self._worst_sigma(np.eye(3), _at)

    def _worst_sigma(
        self, axes: FloatArray, value: Callable[[FloatArray, tuple[Shape, ...]], float]
    ) -> float:
        """Along the worst of all ways in the span of axes (K, 3)."""
        return worst_sigma(axes, lambda way: together((self,), partial(value, way)).sigma_mm)


def _along(way: FloatArray, shapes: tuple[Shape, ...]) -> float:
    return float(shapes[0].direction @ way)


def _at(way: FloatArray, shapes: tuple[Shape, ...]) -> float:
    return float(shapes[0].point_mm @ way)


def as_angle(length: MeasuredLength) -> MeasuredAngle:
    """An angle in rad that was measured as a length would be."""
    return MeasuredAngle(length.value_mm, length.sigma_scatter_mm, length.sigma_propagated_mm)


def together(
    fits: tuple[Fitted, ...], value: Callable[[tuple[Shape, ...]], float]
) -> MeasuredLength:
    """A value that follows from one or more shapes fitted to one cloud.

    What an exposure errs moves all of them: their errors are not independent, and are not taken so.
    """
    shapes = tuple(fit.shape for fit in fits)
    slope = np.concatenate([_slopes(shapes, k, value) for k in range(len(fits))])
    errors = fits[0].errors if len(fits) == 1 else _errors_of(fits)
    return errors.measured(value(shapes), slope)


def _errors_of(fits: tuple[Fitted, ...]) -> FitErrors:
    """What the parameters of all fits err by, one fit's after the other's."""
    parts = [fit.linearised() for fit in fits]
    linear = FitLinearised(
        block_diag(*(part.jacobian for part in parts)),
        np.concatenate([part.directions for part in parts]),
        np.concatenate([part.off_mm for part in parts]),
    )
    rows = np.concatenate([fit.rows[part.point] for fit, part in zip(fits, parts, strict=True)])
    return FitErrors.of(linear, fits[0].cloud, rows)


def _slopes(
    shapes: tuple[Shape, ...], k: int, value: Callable[[tuple[Shape, ...]], float]
) -> FloatArray:
    """(P,) derivatives of a value by the parameters of one shape, of a circle with its plane."""
    names = parameter_names(shapes[k].kind, with_plane=True)
    steps = [TURN_RAD if name.endswith("_rad") else SHIFT_MM for name in names]
    slopes = np.zeros(len(steps))
    for j, step in enumerate(np.diag(steps)):
        ahead, behind = list(shapes), list(shapes)
        ahead[k] = moved(shapes[k], step, with_plane=True)
        behind[k] = moved(shapes[k], -step, with_plane=True)
        slopes[j] = (value(tuple(ahead)) - value(tuple(behind))) / (2.0 * steps[j])
    return slopes


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """How two features stand to each other.

    Parameters
    ----------
    distance
        Between them, as ``distance_text`` defines it; None where they cross.
    angle
        Between their directions, or of a line to a plane; None where one has none.
    parallelism, perpendicularity
        Width of the zone, parallel or square to the second feature, that holds the first one's
        fitted plane or axis as far as its points reach (ISO 1101 orientation; its form is not in
        it); None where they stand otherwise, or one has no direction.
    """

    first: FeatureInspection
    second: FeatureInspection
    distance: MeasuredLength | None
    angle: MeasuredAngle | None
    distance_text: str
    angle_text: str
    parallelism: MeasuredLength | None = None
    perpendicularity: MeasuredLength | None = None


PARALLEL = math.radians(10.0)
"""Planes and axes within 10 degrees of parallel have a distance; others cross."""
SAME_PART = 0.5
"""Part of the points of one feature that another may share: corners and edges, not a face."""
POINTLIKE = ("circle", "sphere")


def relate(cloud: PointCloud, first: FeatureInspection, second: FeatureInspection) -> Relation:
    """Distance and angle of two features of one cloud, with their standard deviations.

    Raises
    ------
    OptionError
        If more than half of the points of one are the other's: both are the same.
    """
    shared = len(np.intersect1d(first.rows, second.rows))
    if shared > SAME_PART * min(len(first.rows), len(second.rows)):
        place = ",".join(f"{round(value, 3) + 0.0:.10g}" for value in first.shape.point_mm.tolist())
        raise OptionError(
            f"both features are one: they share {shared} of {len(first.rows)} and "
            f"{len(second.rows)} points, about {place}",
            where="the second feature",
            remedy=f"give it the seed or region of another {second.shape.kind}, as "
            f"{second.shape.kind}:seed=x,y,z with a point on that",
        )
    fits = tuple(Fitted(one.shape, cloud, one.rows[one.is_fitted]) for one in (first, second))
    angle, angle_text = None, "one of them has no direction"
    if first.shape.kind != "sphere" and second.shape.kind != "sphere":
        angle = as_angle(together(fits, _angle))
        angle_text = "between their directions"
        if _is_flat(first.shape) != _is_flat(second.shape):
            angle_text = "of the line or axis to the plane"
    measure, distance_text = _distance(first.shape, second.shape)
    distance = None if measure is None else together(fits, measure)
    leaning: list[MeasuredLength | None] = [None, None]
    for k, square in enumerate((0.0, math.pi / 2.0)):
        if angle is not None and abs(angle.value_rad - square) < PARALLEL:
            reach = _reach(cloud, first, second.shape)
            leaning[k] = together(fits, partial(_leaning, square=square, reach=reach))
    return Relation(first, second, distance, angle, distance_text, angle_text, *leaning)


def _reach(cloud: PointCloud, first: FeatureInspection, second: Shape) -> float:
    """How far a feature's points reach: along its axis, or where its plane rises steepest."""
    if not _is_flat(first.shape):
        return float(np.ptp(first.shape.local_mm(cloud.points_mm[first.rows])[:, 2]))
    normal = first.shape.direction
    rise = second.direction - float(second.direction @ normal) * normal
    if np.linalg.norm(rise) < np.finfo(np.float64).eps:
        rise = first.shape.axes[0]
    rise = rise / np.linalg.norm(rise)
    return float(np.ptp(cloud.points_mm[first.rows] @ rise))


def _leaning(shapes: tuple[Shape, ...], square: float, reach: float) -> float:
    return reach * math.sin(abs(_angle(shapes) - square))


def _is_flat(shape: Shape) -> bool:
    return shape.kind in ("plane", "circle")


def _angle(shapes: tuple[Shape, ...]) -> float:
    a, b = shapes[0].direction, shapes[1].direction
    sine, cosine = float(np.linalg.norm(np.cross(a, b))), abs(float(a @ b))
    between = math.atan2(sine, cosine)
    return math.pi / 2.0 - between if _is_flat(shapes[0]) != _is_flat(shapes[1]) else between


def _distance(
    first: Shape, second: Shape
) -> tuple[Callable[[tuple[Shape, ...]], float] | None, str]:
    """How the distance of two shapes is measured, and in words; None where they cross."""
    kinds = [
        ("point" if one.kind in POINTLIKE else "plane" if one.kind == "plane" else "axis")
        for one in (first, second)
    ]
    if kinds == ["point", "point"]:
        return lambda s: float(np.linalg.norm(s[0].point_mm - s[1].point_mm)), "of the centres"
    if "point" in kinds:
        k = kinds.index("point")
        where = "plane" if kinds[1 - k] == "plane" else "axis"
        return partial(
            _from_point, at=k, where=second.point_mm if k else first.point_mm
        ), f"of the centre from the {where}"
    along = float(abs(first.direction @ second.direction))
    if kinds == ["axis", "axis"] and along < math.cos(PARALLEL):
        return _skew, "of the axes where they come nearest to each other"
    is_mixed = kinds[0] != kinds[1]
    if along > math.sin(PARALLEL) if is_mixed else along < math.cos(PARALLEL):
        return None, "they cross"
    k = 0 if kinds[0] == "axis" else 1
    text = (
        f"of the middle of the {('first', 'second')[k]} one's points from the other {kinds[1 - k]}"
    )
    # the foot stays abreast of the middle of the points when the shape turns
    return partial(_from_point, at=k, where=(first, second)[k].point_mm), text


def _from_point(shapes: tuple[Shape, ...], at: int, where: FloatArray) -> float:
    """Distance of one shape's point, or its element's foot next to ``where``, from the other."""
    one, other = shapes[at], shapes[1 - at]
    point = one.point_mm
    if one.kind == "plane":
        point = where - float((where - point) @ one.direction) * one.direction
    elif one.kind not in POINTLIKE:
        point = point + float((where - point) @ one.direction) * one.direction
    offset = point - other.point_mm
    along = float(offset @ other.direction)
    if other.kind == "plane":
        return abs(along)
    return float(np.linalg.norm(offset - along * other.direction))


def _skew(shapes: tuple[Shape, ...]) -> float:
    across = np.cross(shapes[0].direction, shapes[1].direction)
    offset = shapes[1].point_mm - shapes[0].point_mm
    return abs(float(offset @ across)) / float(np.linalg.norm(across))
