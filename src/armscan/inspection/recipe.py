# SPDX-License-Identifier: Apache-2.0
"""A recipe: cleaning, alignment, comparison and features that are the same for every part."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import Box
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.alignment import AlignMethod
from armscan.inspection.cad.comparison import (
    DECISIONS,
    OF_VALIDITY,
    CadComparison,
    CadOptions,
    Decision,
    FaceComparison,
    compare_with_part,
)
from armscan.inspection.cad.datums import Datums, align
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cleaning import Cleaning, CleaningOptions, clean_cloud
from armscan.inspection.conformity import COVERAGE, judge
from armscan.inspection.doubts import (
    arc_warnings,
    face_warnings,
    lean_warnings,
    outlier_warnings,
    seed_warnings,
    shape_warnings,
    sigma_warnings,
)
from armscan.inspection.features import (
    FeatureInspection,
    inspect_feature,
    inspect_points,
    relate,
)
from armscan.inspection.search import WantedFeature
from armscan.inspection.step import inspect_step
from armscan.records.cloud import PointCloud

QuantityKind = Literal["feature", "mean", "spot"]
PartDecision = Literal["pass", "undecided", "fail", "not seen", ""]


@dataclass(frozen=True, slots=True)
class RecipeFeature:
    """A feature that every part has.

    Parameters
    ----------
    wanted
        What is looked for, in the model's frame.
    nominal, tolerance
        Of its diameter in mm, or a cone's half angle in degrees; NaN for none.
    face
        Name of the model's face that it is, whose points are its own; empty to look for it.
    form_tolerance
        Of its form error in mm; NaN for none.
    """

    name: str
    wanted: WantedFeature
    nominal: float = math.nan
    tolerance: float = math.nan
    face: str = ""
    form_tolerance: float = math.nan


RelationMeasure = Literal["distance", "angle", "parallelism", "perpendicularity"]


@dataclass(frozen=True, slots=True)
class RecipeRelation:
    """How two features of the recipe stand to each other, as `armscan.inspection.features.relate`.

    ``nominal`` and ``tolerance`` are in mm, of an angle in degrees; NaN for none.
    """

    name: str
    of: tuple[str, ...]
    measure: RelationMeasure
    nominal: float = math.nan
    tolerance: float = math.nan

    @property
    def unit(self) -> Literal["mm", "degrees"]:
        """Of its value."""
        return "degrees" if self.measure == "angle" else "mm"


@dataclass(frozen=True, slots=True)
class RecipeStep:
    """A step between parallel faces, as `armscan.inspection.step.inspect_step` measures it.

    ``tolerance_mm`` is NaN for none; ``region`` in the model's frame, None for the whole cloud;
    ``normal`` of the faces in that frame, for points of one light sheet, None where nobody says it.
    """

    name: str
    height_mm: float
    tolerance_mm: float = math.nan
    region: Box | None = None
    normal: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Recipe:
    """What is done with every part.

    Parameters
    ----------
    title
        Of the inspection.
    surface
        Of the part's model; None to measure features alone, in the cloud's own frame.
    align, datums
        How the cloud is laid on it, and what that rests on.
    options
        Tolerances of the faces.
    cleaning
        Filters before all else; None for none.
    features, relations, steps
        What is measured after the alignment.
    """

    title: str = ""
    surface: PartSurface | None = None
    align: AlignMethod = "best"
    datums: Datums = field(default_factory=Datums)
    options: CadOptions = field(default_factory=CadOptions)
    cleaning: CleaningOptions | None = None
    features: tuple[RecipeFeature, ...] = ()
    relations: tuple[RecipeRelation, ...] = ()
    steps: tuple[RecipeStep, ...] = ()


@dataclass(frozen=True, slots=True)
class PartQuantity:
    """One measured value of a part.

    Parameters
    ----------
    name
        Of the feature or face.
    kind
        ``feature``: its diameter or half angle, a form error, relation or step; ``mean``, ``spot``:
        of a face, its mean deviation and that of the spot that decides.
    unit
        mm or degrees.
    value, u_value
        Measured, and its U (k = 2); NaN where not known.
    nominal, tolerance
        What it should be, and the largest deviation from it; NaN for none.
    decision
        By ISO 14253-1; empty without a tolerance. Of a spot it is that of all spots of the face.
    """

    name: str
    kind: QuantityKind
    unit: Literal["mm", "degrees"]
    value: float
    u_value: float
    nominal: float
    tolerance: float
    decision: PartDecision

    @property
    def label(self) -> str:
        """The name, of a face with what it is of it."""
        return self.name if self.kind == "feature" else f"{self.name}, {self.kind}"

    @property
    def deviation(self) -> float:
        """Value less nominal."""
        return self.value - self.nominal


@dataclass(frozen=True, slots=True, eq=False)
class FollowedRecipe:
    """What a recipe found on one part.

    Parameters
    ----------
    cloud
        After cleaning, in the cloud's own frame.
    cleaning
        What the filters took; None without filters.
    errors_known
        True if the cloud's covariances were used.
    comparison
        With the model; None without one.
    placed
        The same cloud where the features were measured: in Cad, or its own frame.
    features
        Those that were found, by name.
    quantities
        Each value: features, relations and steps as in the recipe, then the faces that have a
        tolerance.
    notes
        What was not found, and why, and what is weak about what was: a feature that may be of
        another shape, and what rests on it, does not pass.
    """

    cloud: PointCloud
    cleaning: Cleaning | None
    errors_known: bool
    comparison: CadComparison | None
    placed: PointCloud
    features: dict[str, FeatureInspection]
    quantities: tuple[PartQuantity, ...]
    notes: tuple[str, ...]


def follow_recipe(recipe: Recipe, cloud: PointCloud) -> FollowedRecipe | FitFailure:
    """Do with a cloud what a recipe says.

    Returns
    -------
    FitFailure
        If the cloud cannot be laid on the model.
    """
    cleaning = None if recipe.cleaning is None else clean_cloud(cloud, recipe.cleaning)
    cleaned = cloud if cleaning is None else cleaning.cloud
    if len(cleaned) == 0:
        raise InputError("the cloud holds no point", remedy="give the scan of a part")
    known = bool(cleaned.covariance_mm2.any()) and not math.isfinite(recipe.options.uncertainty_mm)
    comparison, placed = None, cleaned
    if recipe.surface is not None:
        alignment = align(recipe.surface, cleaned, recipe.align, recipe.datums, known)
        if isinstance(alignment, FitFailure):
            return alignment
        found = compare_with_part(recipe.surface, cleaned, alignment, recipe.options, known)
        if isinstance(found, FitFailure):
            return found
        comparison, placed = found, placed_cloud(cleaned, alignment.cad_from_part)
    features: dict[str, FeatureInspection] = {}
    quantities: list[PartQuantity] = []
    doubted: set[str] = set()
    notes = list(sigma_warnings(placed)) if recipe.features or recipe.steps else []
    for one in recipe.features:
        feature = _feature(placed, one, comparison)
        if isinstance(feature, FitFailure):
            notes.append(f"{one.name}: {feature.reason}")
        else:
            features[one.name] = feature
            notes += [f"{one.name}: {text}" for text in _weak(feature, placed)]
            if shape_warnings(feature, placed, feature.shape.kind):
                doubted.add(one.name)
        told = [feature_value(one, features.get(one.name))]
        if math.isfinite(one.form_tolerance):
            told.append(_form_value(one, features.get(one.name), placed))
        quantities += [_at_best_undecided(each) if one.name in doubted else each for each in told]
    for relation in recipe.relations:
        found_value = _relation_value(placed, relation, features)
        if isinstance(found_value, FitFailure):
            notes.append(f"{relation.name}: {found_value.reason}")
        judged = _judged(relation, found_value)
        is_doubted = not doubted.isdisjoint(relation.of)
        quantities.append(_at_best_undecided(judged) if is_doubted else judged)
    for step in recipe.steps:
        judged, texts = _step_value(placed, step)
        notes += [f"{step.name}: {text}" for text in texts]
        quantities.append(judged)
    faces = () if comparison is None else comparison.faces
    return FollowedRecipe(
        cloud=cleaned,
        cleaning=cleaning,
        errors_known=known,
        comparison=comparison,
        placed=placed,
        features=features,
        quantities=(*quantities, *(value for face in faces for value in face_values(face))),
        notes=tuple(notes),
    )


def _weak(found: FeatureInspection, cloud: PointCloud) -> tuple[str, ...]:
    """What the report of a feature alone warns of."""
    return (
        *outlier_warnings(found.counts),
        *seed_warnings(found, cloud),
        *shape_warnings(found, cloud, found.shape.kind),
        *arc_warnings(found),
    )


def _at_best_undecided(one: PartQuantity) -> PartQuantity:
    """The value of what may be another shape: within its limits it says nothing."""
    return replace(one, decision="undecided") if one.decision == "pass" else one


def placed_cloud(cloud: PointCloud, pose: Pose[Cad, Part]) -> PointCloud:
    """A cloud moved into the model's frame, covariances and directions turned with it."""
    seen_from = None if cloud.seen_from_mm is None else pose.apply(cloud.seen_from_mm)
    errors = cloud.calibration_errors
    return replace(
        cloud,
        frame="Cad",
        points_mm=pose.apply(cloud.points_mm),
        covariance_mm2=pose.rotate_covariance(cloud.covariance_mm2),
        normals=None if cloud.normals is None else pose.rotate(cloud.normals),
        seen_from_mm=seen_from,
        calibration_errors=None if errors is None else errors.turned(pose.rotation),
    )


def _feature(
    cloud: PointCloud, one: RecipeFeature, comparison: CadComparison | None
) -> FeatureInspection | FitFailure:
    try:
        if not one.face or comparison is None:
            return inspect_feature(cloud, one.wanted)
        number = [face.name for face in comparison.faces].index(one.face)
        own = (comparison.face == number) & ~comparison.is_beside_edge
        rows = comparison.rows[own]
        rule = f"nearest to the face {one.face} of the model"
        found = inspect_points(cloud.select(rows), one.wanted, rule)
        return found if isinstance(found, FitFailure) else replace(found, rows=rows[found.rows])
    except InputError as error:
        return FitFailure(error.what, error.remedy)


def feature_value(one: RecipeFeature, found: FeatureInspection | None) -> PartQuantity:
    """The diameter or half angle of a feature with its decision; ``not seen`` if it is None."""
    is_cone = one.wanted.kind == "cone"
    value = sigma = math.nan
    if found is not None and found.half_angle is not None:
        value = math.degrees(found.half_angle.value_rad)
        sigma = math.degrees(found.half_angle.sigma_rad)
    elif found is not None and found.diameter is not None:
        value, sigma = found.diameter.value_mm, found.diameter.sigma_mm
    return _quantity(
        one.name, "degrees" if is_cone else "mm", (value, COVERAGE * sigma),
        (one.nominal, one.tolerance), is_seen=found is not None,
    )  # fmt: skip


def _quantity(
    name: str,
    unit: Literal["mm", "degrees"],
    measured: tuple[float, float],
    limits: tuple[float, float],
    *,
    is_seen: bool,
) -> PartQuantity:
    """A value and its U against its nominal value and tolerance."""
    (value, u), (nominal, tolerance) = measured, limits
    decision: PartDecision = ""
    if math.isfinite(tolerance):
        verdict = judge(value - nominal, tolerance, u)
        decision = OF_VALIDITY[verdict] if is_seen else "not seen"
    return PartQuantity(
        name=name,
        kind="feature",
        unit=unit,
        value=value,
        u_value=u,
        nominal=nominal,
        tolerance=tolerance,
        decision=decision,
    )


def _form_value(
    one: RecipeFeature, found: FeatureInspection | None, cloud: PointCloud
) -> PartQuantity:
    """Form error of a feature: it holds the scatter of its points, and so does its U.

    U is the range that as many points would show that err by their own sigmas alone.
    """
    value = u = math.nan
    if found is not None:
        value = found.form_mm
        sigma = float(np.median(cloud.sigma_mm[found.rows]))
        if sigma > 0.0:
            u = 2.0 * sigma * math.sqrt(2.0 * math.log(len(found.rows)))
    return _quantity(
        f"{one.name} form", "mm", (value, u), (0.0, one.form_tolerance), is_seen=found is not None
    )


def _relation_value(
    cloud: PointCloud, one: RecipeRelation, features: dict[str, FeatureInspection]
) -> tuple[float, float] | FitFailure:
    """Value and U of a relation."""
    lost = [name for name in one.of if name not in features]
    if lost:
        return FitFailure(f"{lost[0]} was not found", "look at its own note")
    first, second = (features[name] for name in one.of)
    try:
        found = relate(cloud, first, second)
    except OptionError as error:
        return FitFailure(error.what, error.remedy)
    if one.measure == "angle" and found.angle is not None:
        degrees = math.degrees(found.angle.value_rad), math.degrees(found.angle.sigma_rad)
        return degrees[0], COVERAGE * degrees[1]
    length = getattr(found, one.measure)
    if length is None or one.measure == "angle":
        return FitFailure(
            f"{one.of[0]} and {one.of[1]} have no {one.measure} as they stand", "ask for another"
        )
    return length.value_mm, COVERAGE * length.sigma_mm


def _judged(one: RecipeRelation, found: tuple[float, float] | FitFailure) -> PartQuantity:
    is_seen = not isinstance(found, FitFailure)
    measured = (math.nan, math.nan) if isinstance(found, FitFailure) else found
    limits = (one.nominal, one.tolerance)
    return _quantity(one.name, one.unit, measured, limits, is_seen=is_seen)


def _step_value(cloud: PointCloud, one: RecipeStep) -> tuple[PartQuantity, tuple[str, ...]]:
    """The height of a step with its decision, and what is weak about it or why there is none."""
    normal = None if one.normal is None else np.asarray(one.normal, dtype=np.float64)
    try:
        found = inspect_step(cloud, one.height_mm, normal=normal, region=one.region)
    except InputError as error:
        found = FitFailure(error.what, error.remedy)
    limits = (one.height_mm, one.tolerance_mm)
    if isinstance(found, FitFailure):
        lost = _quantity(one.name, "mm", (math.nan, math.nan), limits, is_seen=False)
        return lost, (found.reason,)
    height = found.height.value_mm, COVERAGE * found.height.sigma_mm
    judged = _quantity(one.name, "mm", height, limits, is_seen=True)
    bent = face_warnings(found, cloud)
    weak = (*outlier_warnings(found.counts), *lean_warnings(found), *bent)
    return _at_best_undecided(judged) if bent else judged, weak


def face_values(face: FaceComparison) -> tuple[PartQuantity, ...]:
    """Mean and worst spot of a face with their decisions; empty without a tolerance.

    The worse of both decisions is the face's.
    """
    if not math.isfinite(face.tolerance_mm):
        return ()
    found: list[PartQuantity] = []
    mean, spot = (face.statistics.mean_mm, face.u_mean_mm), (face.spot_mm, face.u_spot_mm)
    pairs: tuple[tuple[QuantityKind, tuple[float, float]], ...] = (("mean", mean), ("spot", spot))
    for kind, (value, u) in pairs:
        decision = face.decision
        if decision in DECISIONS:
            own = OF_VALIDITY[judge(value, face.tolerance_mm, u)]
            # another spot may decide the face, and what one exposure alone shows fails nothing
            is_worse = DECISIONS.index(own) > DECISIONS.index(decision)
            is_by_spots = kind == "spot" and all(one.decision != decision for one in found)
            decision = decision if is_worse or is_by_spots else own
        found.append(
            PartQuantity(
                name=face.name,
                kind=kind,
                unit="mm",
                value=value,
                u_value=u,
                nominal=0.0,
                tolerance=face.tolerance_mm,
                decision=decision,
            )
        )
    return tuple(found)


@dataclass(frozen=True, slots=True)
class PartRow:
    """One part in the table of all; not inspected: a ``reason`` in place of ``quantities``."""

    name: str
    cloud: str
    quantities: tuple[PartQuantity, ...] = ()
    notes: tuple[str, ...] = ()
    reason: str = ""
    is_simulated: bool = False
    forced: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst decision; ``not inspected`` with a reason, empty if nothing has a tolerance.

        A feature that is not found is undecided, and so is a part of which no face is seen; a face
        among others that the scan does not show is not judged, as in a comparison by itself.
        """
        if self.reason:
            return "not inspected"
        found: list[Decision] = [
            "undecided" if one.decision == "not seen" else one.decision
            for one in self.quantities
            if one.decision and (one.decision != "not seen" or one.kind == "feature")
        ]
        is_wanted = any(one.decision for one in self.quantities)
        return max(found, key=DECISIONS.index, default="undecided" if is_wanted else "")

    @property
    def is_passed(self) -> bool:
        """True if it was inspected and nothing stands against it."""
        return self.verdict in ("pass", "")

    @property
    def wrong(self) -> tuple[PartQuantity, ...]:
        """What did not pass, failures first, and the farthest off before others."""
        found = [one for one in self.quantities if one.decision in ("fail", "undecided")]
        lost = [
            one for one in self.quantities if one.decision == "not seen" and one.kind == "feature"
        ]
        return (*sorted(found, key=_badness), *lost)


def _badness(one: PartQuantity) -> tuple[bool, float]:
    ratio = abs(one.deviation) / one.tolerance
    return one.decision != "fail", -ratio if np.isfinite(ratio) else 0.0
