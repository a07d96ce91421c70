# SPDX-License-Identifier: Apache-2.0
"""Recipes of an inspection and title blocks (TOML), what one found on a part (JSON), and the table
of parts.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from armscan.errors import ArmscanError, FileFormatError, OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import ShapeKind
from armscan.inspection.cad.alignment import AlignMethod
from armscan.inspection.cad.comparison import CadOptions
from armscan.inspection.cad.datums import Datums
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import PartModel
from armscan.inspection.cad.reference_points import ReferencePoints
from armscan.inspection.cleaning import CleaningOptions
from armscan.inspection.recipe import (
    FollowedRecipe,
    PartQuantity,
    PartRow,
    Recipe,
    RecipeFeature,
    RecipeRelation,
    RecipeStep,
    RelationMeasure,
)
from armscan.inspection.search import WantedFeature
from armscan.inspection.title_block import TITLE_LABELS, TitleBlock
from armscan.records.cloud import CloudFrame
from armscan.storage.codec import (
    FieldCodec,
    Layout,
    MismatchError,
    RecordCodec,
    json_bytes,
    parse_json,
    parse_toml,
)
from armscan.storage.documents import (
    is_scanner_document,
    read_scanner_calibration,
    read_sensor_calibration,
)
from armscan.storage.files import is_file, path_text, read_bytes
from armscan.storage.parts.meshes import read_part
from armscan.storage.parts.tables import (
    MEASURED,
    PICKED,
    datum_faces,
    datum_features,
    read_reference_markers,
    read_reference_points,
    require_face,
)
from armscan.storage.tables import csv_bytes, number_text, read_csv

REMEDY = "write it as in the reference of recipes (docs/reference/files.md)"
POSITIVE_MM = (1e-6, 1e4)
CLEAN_KEYS = tuple(item.name for item in fields(CleaningOptions))
TABLE_NOTE = "parts by a recipe; u: expanded uncertainty, k = 2; decision by ISO 14253-1"
RESULT_SCHEMA: Mapping[str, str] = {"schema": "armscan/inspected-part"}


def _read_faces(content: Any, key: str) -> dict[str, float]:
    """Tolerances by the names of faces."""
    if not isinstance(content, dict):
        raise MismatchError(key, "is no table of faces and mm")
    for name, value in content.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not POSITIVE_MM[0] <= value <= POSITIVE_MM[1]:
            raise MismatchError(f"{key}.{name}", "is no length above 0 in mm")
    return {str(name): float(value) for name, value in content.items()}


def _read_box(content: Any, key: str) -> Box:
    """A box of six numbers."""
    is_list = isinstance(content, list)
    if not is_list or not all(type(one) in (int, float) for one in content):
        raise MismatchError(key, "is no list of xmin, xmax, ymin, ymax, zmin, zmax in mm")
    try:
        return Box.from_limits([float(one) for one in content], key)
    except OptionError as error:
        raise MismatchError(key, f"does not do: {error.what}") from error


def _same(value: Any) -> Any:
    return value


def _same_table(content: Any, key: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise MismatchError(key, "is no table of names and texts")
    return content


@dataclass(frozen=True, slots=True)
class _FeatureKeys:
    """``[[feature]]``."""

    name: str
    kind: ShapeKind
    face: str | None = None
    diameter_mm: float | None = None
    diameter_range_mm: tuple[float, float] | None = None
    half_angle_deg: float | None = None
    axis: tuple[float, ...] | None = None
    seed_mm: tuple[float, ...] | None = None
    region: Box | None = None
    nominal_mm: float | None = None
    tolerance_mm: float | None = None
    nominal_deg: float | None = None
    tolerance_deg: float | None = None
    form_tolerance_mm: float | None = None


@dataclass(frozen=True, slots=True)
class _RelationKeys:
    """``[[relation]]``."""

    name: str
    of: tuple[str, ...]
    measure: RelationMeasure
    nominal_mm: float | None = None
    tolerance_mm: float | None = None
    nominal_deg: float | None = None
    tolerance_deg: float | None = None


@dataclass(frozen=True, slots=True)
class _StepKeys:
    """``[[step]]``."""

    name: str
    height_mm: float
    tolerance_mm: float | None = None
    region: Box | None = None
    normal: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class _RecipeKeys:
    """The whole file."""

    title: str = ""
    part: str | None = None
    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    align: AlignMethod = "best"
    datums: str | None = None
    points: str | None = None
    tolerance_mm: float | None = None
    uncertainty_mm: float | None = None
    reach_mm: float | None = None
    faces: Mapping[str, float] | None = None
    clean: CleaningOptions | None = None
    title_block: Mapping[str, Any] | None = None
    pdf: bool = False
    feature: tuple[_FeatureKeys, ...] = ()
    relation: tuple[_RelationKeys, ...] = ()
    step: tuple[_StepKeys, ...] = ()


BOX = FieldCodec(_same, _read_box)
LAYOUTS: Mapping[type, Layout] = {
    _RecipeKeys: Layout(
        codecs={
            "faces": FieldCodec(_same, _read_faces),
            "title_block": FieldCodec(_same, _same_table),
        },
        limits={
            "tolerance_mm": POSITIVE_MM, "uncertainty_mm": POSITIVE_MM, "reach_mm": POSITIVE_MM,
        },
    ),
    CleaningOptions: Layout(
        codecs={"region": BOX},
        limits={
            item.name: (1e-6, 89.999) if item.name.endswith("_deg") else (1e-6, 9999.0)
            for item in fields(CleaningOptions)
        },
    ),
    _FeatureKeys: Layout(
        codecs={"region": BOX},
        limits={
            "tolerance_mm": POSITIVE_MM, "tolerance_deg": (1e-6, 90.0),
            "form_tolerance_mm": POSITIVE_MM,
        },
    ),
    _RelationKeys: Layout(
        limits={"tolerance_mm": POSITIVE_MM, "tolerance_deg": (1e-6, 90.0)},
    ),
    _StepKeys: Layout(
        codecs={"region": BOX}, limits={"tolerance_mm": POSITIVE_MM, "height_mm": POSITIVE_MM}
    ),
    PartQuantity: Layout(is_evidence=True),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class RecipeFile:
    """A recipe with the model that it names.

    Parameters
    ----------
    part
        The model; None without one.
    inputs
        The recipe's file, the model's, and that of reference points.
    scanner_path
        The document that the title block names; None without one.
    has_pdf
        Whether every part's page is written as PDF too.
    measured_beside
        True if the places of reference points or markers were measured on each part: in a table
        beside its cloud, ``NAME.points.csv`` or ``NAME.markers.csv``.
    """

    recipe: Recipe
    part: PartModel | None
    inputs: tuple[Path, ...]
    title_block: TitleBlock = field(default_factory=TitleBlock)
    has_pdf: bool = False
    measured_beside: bool = False
    scanner_path: Path | None = None

    def measured_of(self, cloud: Path) -> Path | None:
        """The table beside a cloud; None where the recipe needs none."""
        if not self.measured_beside:
            return None
        return cloud.with_name(f"{cloud.stem}.{self.recipe.align}.csv")

    def for_part(self, cloud_path: Path, frame: CloudFrame) -> Recipe | FitFailure:
        """The recipe with what was measured beside a cloud."""
        measured = self.measured_of(cloud_path)
        if measured is None:
            return self.recipe
        if not is_file(measured):
            raise FileFormatError(
                "there is no table of what was measured on this part",
                where=path_text(measured),
                remedy='lay it beside the cloud, or say align = "best" in the recipe',
            )
        points = self.inputs[-1]
        if self.recipe.align == "points":
            found: ReferencePoints | FitFailure = read_reference_points(points, measured)
        else:
            found = read_reference_markers(points, measured, frame)
        if isinstance(found, FitFailure):
            return found
        return replace(self.recipe, datums=Datums(points=found))


def read_recipe(path: Path) -> RecipeFile:
    """Read a recipe and the model that it names, relative to it.

    Raises
    ------
    OptionError
        If the model's format needs a package that is not installed.
    """
    where = path_text(path)
    content = parse_toml(read_bytes(path), where, 'write lines as align = "best"')
    try:
        keys = RecordCodec(LAYOUTS).read(_RecipeKeys, content)
    except MismatchError as error:
        remedy = REMEDY
        if isinstance(content.get("feature"), dict):
            remedy = "write [[feature]] with two brackets, once a feature"
        raise FileFormatError(str(error), where=where, remedy=remedy) from error
    except OptionError as error:
        # filters are counted before keys that are no filters are noticed
        odd = [name for name in content["clean"] if name not in CLEAN_KEYS]
        what = f"'clean.{odd[0]}' is not known" if odd else f"'clean': {error.what}"
        raise FileFormatError(
            what, where=where, remedy=f"give one or more of {', '.join(CLEAN_KEYS)}"
        ) from error
    _check(keys, content, where)
    features = tuple(_feature(one, where) for one in keys.feature)
    recipe = Recipe(
        title=keys.title or path.stem,
        cleaning=keys.clean,
        features=features,
        relations=tuple(_relation(one, keys, where) for one in keys.relation),
        steps=tuple(_step(one, where) for one in keys.step),
    )
    place = f"{where}: 'title_block'"
    entries = keys.title_block or {}
    block = title_block_of(entries, place, path.parent)
    scanner = str(entries.get(SCANNER, ""))
    scanner_path = path.parent / scanner if scanner else None
    if keys.part is None:
        return RecipeFile(recipe, None, (path,), block, keys.pdf, scanner_path=scanner_path)
    part_path = path.parent / keys.part
    if not is_file(part_path):
        raise FileFormatError(
            f"'part' is {path_text(part_path)}, and there is no such file",
            where=where,
            remedy="name the model by its place beside the recipe",
        )
    part = read_part(part_path, unit=keys.unit)
    points = None if keys.points is None else path.parent / keys.points
    in_one_table = keys.align == "points" and points is not None and _holds_measured(points)
    recipe = replace(
        recipe,
        surface=PartSurface(part),
        align=keys.align,
        datums=_datums(keys, part, where, points if in_one_table else None),
        options=_options(keys, part, where),
    )
    inputs = (path, part_path) if points is None else (path, part_path, points)
    measured_beside = points is not None and not in_one_table
    return RecipeFile(recipe, part, inputs, block, keys.pdf, measured_beside, scanner_path)


def _holds_measured(path: Path) -> bool:
    table = read_csv(path)
    return any(name in table for name in (*MEASURED, *PICKED))


def _check(keys: _RecipeKeys, content: Mapping[str, Any], where: str) -> None:
    """Refuse what contradicts itself or would have no effect."""
    of_part = (
        "unit", "align", "datums", "points", "tolerance_mm", "uncertainty_mm", "reach_mm", "faces",
    )  # fmt: skip
    vain = [name for name in of_part if name in content] if keys.part is None else []
    names = [one.name for one in keys.feature]
    names += [f"{one.name} form" for one in keys.feature if one.form_tolerance_mm is not None]
    names += [one.name for one in keys.relation] + [one.name for one in keys.step]
    twice = [name for name, n in Counter(names).items() if n > 1]
    is_unnamed = any(not name.strip() or not name.isprintable() for name in names)
    faults = (
        (bool(vain), f"'{''.join(vain[:1])}' has no effect without 'part'",
         "name the model, or leave it out"),
        (keys.part is None and any(one.face is not None for one in keys.feature),
         "'feature.face' has no effect without 'part'", "name the model, or leave it out"),
        (keys.part is None and not names, "it names neither a 'part' nor a 'feature' or 'step'",
         "say what to inspect"),
        ((keys.align in ("321", "features")) != bool(keys.datums),
         "'datums' goes with align = \"321\" or \"features\", and only with these",
         "give both or none of them"),
        ((keys.align in ("points", "markers")) != bool(keys.points),
         "'points' goes with align = \"points\" or \"markers\", and only with these",
         "give both or none of them"),
        (bool(twice), f"the name '{''.join(twice[:1])}' is there twice",
         "give each feature, relation and step its own name"),
        (is_unnamed, "a name is empty or holds a line break", "give each feature a name"),
    )  # fmt: skip
    for is_wrong, what, remedy in faults:
        if is_wrong:
            raise FileFormatError(what, where=where, remedy=remedy)


def _feature(keys: _FeatureKeys, where: str) -> RecipeFeature:
    """A feature; the size that is looked for is the nominal one where no other is given."""
    place, is_cone = f"{where}: feature '{keys.name}'", keys.kind == "cone"
    in_mm, in_deg = (keys.nominal_mm, keys.tolerance_mm), (keys.nominal_deg, keys.tolerance_deg)
    own, foreign = (in_deg, in_mm) if is_cone else (in_mm, in_deg)
    refused = (*own, *foreign) if keys.kind in ("plane", "line") else foreign
    if any(one is not None for one in refused):
        raise FileFormatError(
            f"a {keys.kind} has no size in that unit, so no such nominal value or tolerance",
            where=place,
            remedy="give nominal_mm and tolerance_mm of a diameter, nominal_deg and tolerance_deg "
            "of a cone, and none of a plane or line",
        )
    nominal, tolerance = own
    if nominal is None:
        nominal = keys.half_angle_deg if is_cone else keys.diameter_mm
    if tolerance is not None and nominal is None:
        raise FileFormatError(
            "it has a tolerance and no nominal value", where=place, remedy="give both"
        )
    try:
        wanted = WantedFeature(
            kind=keys.kind,
            diameter_mm=keys.diameter_mm,
            diameter_range_mm=keys.diameter_range_mm,
            half_angle_deg=keys.half_angle_deg,
            axis=keys.axis,
            seed_mm=keys.seed_mm,
            region=keys.region,
        )
    except OptionError as error:
        raise FileFormatError(error.what, where=place, remedy=error.remedy) from error
    if keys.face is not None and keys.seed_mm is not None:
        raise FileFormatError(
            "'seed_mm' has no effect beside 'face'", where=place, remedy="give one of them"
        )
    return RecipeFeature(
        name=keys.name,
        wanted=wanted,
        nominal=_or_nan(nominal),
        tolerance=_or_nan(tolerance),
        face=keys.face or "",
        form_tolerance=_or_nan(keys.form_tolerance_mm),
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _relation(keys: _RelationKeys, recipe: _RecipeKeys, where: str) -> RecipeRelation:
    """A relation; zones of parallel and square features have the nominal width 0."""
    place = f"{where}: relation '{keys.name}'"
    known = [one.name for one in recipe.feature]
    in_mm, in_deg = (keys.nominal_mm, keys.tolerance_mm), (keys.nominal_deg, keys.tolerance_deg)
    own, foreign = (in_deg, in_mm) if keys.measure == "angle" else (in_mm, in_deg)
    nominal, tolerance = own
    is_zone = keys.measure in ("parallelism", "perpendicularity")
    unknown = [name for name in keys.of if name not in known]
    faults = (
        (len(keys.of) != 2 or len(set(keys.of)) != 2, "'of' names no two features",
         'write of = ["bore", "base"]'),
        (bool(unknown), f"there is no feature '{''.join(unknown[:1])}'",
         f"name two of {', '.join(known) or 'the features, which are missing'}"),
        (any(one is not None for one in foreign), "an angle is in degrees, all else in mm",
         "give nominal_deg and tolerance_deg of an angle, nominal_mm and tolerance_mm of others"),
        (is_zone and nominal is not None, f"{keys.measure} has no nominal value but 0",
         "leave nominal_mm out"),
        (tolerance is not None and nominal is None and not is_zone,
         "it has a tolerance and no nominal value", "give both"),
        (keys.nominal_deg is not None and not 0.0 <= keys.nominal_deg <= 90.0,
         f"nominal_deg is {keys.nominal_deg}, and angles are told as 0 to 90 degrees",
         f"write {_folded_deg(keys.nominal_deg or 0.0):g}"),
    )  # fmt: skip
    for is_wrong, what, remedy in faults:
        if is_wrong:
            raise FileFormatError(what, where=place, remedy=remedy)
    return RecipeRelation(
        name=keys.name,
        of=keys.of,
        measure=keys.measure,
        nominal=0.0 if is_zone else _or_nan(nominal),
        tolerance=_or_nan(tolerance),
    )


def _step(keys: _StepKeys, where: str) -> RecipeStep:
    if keys.normal is not None and not (len(keys.normal) == 3 and any(keys.normal)):
        raise FileFormatError(
            "the normal is no direction",
            where=f"{where}: step '{keys.name}'",
            remedy="give the three numbers x, y, z of the faces' normal, not all 0",
        )
    tolerance_mm = _or_nan(keys.tolerance_mm)
    return RecipeStep(keys.name, keys.height_mm, tolerance_mm, keys.region, keys.normal)


def _folded_deg(angle_deg: float) -> float:
    """The same angle between two directions of which either may be turned over, 0 to 90 degrees."""
    turned = angle_deg % 180.0
    return min(turned, 180.0 - turned)


def _datums(keys: _RecipeKeys, part: PartModel, where: str, points: Path | None) -> Datums:
    if points is not None:
        return Datums(points=read_reference_points(points))
    if keys.datums is None:
        return Datums()
    try:
        if keys.align == "321":
            return Datums(faces=datum_faces(keys.datums, part))
        return Datums(features=datum_features(keys.datums, part))
    except ArmscanError as error:
        raise FileFormatError(
            error.what, where=f"{where}: 'datums'", remedy=error.remedy
        ) from error


def _options(keys: _RecipeKeys, part: PartModel, where: str) -> CadOptions:
    faces = keys.faces or {}
    for name in faces:
        require_face(name, part, f"{where}: 'faces'")
    for one in keys.feature:
        if one.face is not None:
            require_face(one.face, part, f"{where}: feature '{one.name}'")
    given = {
        "tolerance_mm": keys.tolerance_mm,
        "uncertainty_mm": keys.uncertainty_mm,
        "reach_mm": keys.reach_mm,
    }
    known: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    return CadOptions(face_tolerances_mm=faces, **known)


SCANNER, VALID_DAYS = "scanner", "calibration_valid_days"
TITLE_KEYS = (*TITLE_LABELS, SCANNER, VALID_DAYS)
LONGEST_TEXT = 200
"""Characters of one entry of a title block: more would push the results off the first page."""


def read_title_block(words: Sequence[str], where: str) -> TitleBlock:
    """The title block of ``KEY=TEXT`` words and TOML files of such keys; the later one holds.

    Raises
    ------
    OptionError, FileFormatError
        If a key is not known, a value is none, or a file is not understood.
    """
    entries: dict[str, Any] = {}
    folder = Path()
    for word in words:
        key, is_pair, text = word.partition("=")
        if is_pair and not is_file(Path(word)):
            entries[key.strip()] = text.strip()
            folder = Path() if key.strip() == SCANNER else folder
        elif word.endswith(".toml"):
            found = parse_toml(read_bytes(Path(word)), word, 'write lines as operator = "A. Ray"')
            entries |= found
            folder = Path(word).parent if SCANNER in found else folder
        else:
            raise OptionError(
                f"'{word}' is no KEY=TEXT and no .toml file",
                where=where,
                remedy=f"write as serial=0012; keys are {', '.join(TITLE_KEYS)}",
            )
    return title_block_of(entries, where, folder)


def title_block_of(entries: Mapping[str, Any], where: str, folder: Path) -> TitleBlock:
    """The title block of keys and values; a scanner's document is named relative to ``folder``.

    Raises
    ------
    OptionError, FileFormatError
        If a key is not known, a value is none, or the scanner's document is not understood.
    """
    odd = [key for key in entries if key not in TITLE_KEYS]
    if odd:
        raise OptionError(
            f"a title block has no '{odd[0]}'",
            where=where,
            remedy=f"give one of {', '.join(TITLE_KEYS)}",
        )
    texts: dict[str, Any] = {
        key: _title_text(entries[key], key, where) for key in TITLE_LABELS if key in entries
    }
    days = _valid_days(entries[VALID_DAYS], where) if VALID_DAYS in entries else math.nan
    block = replace(TitleBlock(calibration_valid_days=days), **texts)
    name = str(entries.get(SCANNER, ""))
    if not name:
        return block
    path = folder / name
    is_scanner = is_scanner_document(path)
    provenance = (
        read_scanner_calibration(path) if is_scanner else read_sensor_calibration(path)
    ).provenance
    return replace(block, scanner=provenance.mark, scanner_name=path.name)


def _title_text(value: Any, key: str, where: str) -> str:
    text = str(value).strip()
    if isinstance(value, dict | list) or not text.isprintable() or len(text) > LONGEST_TEXT:
        raise OptionError(
            f"'{key}' is no line of at most {LONGEST_TEXT} characters",
            where=where,
            remedy="shorten it, without line breaks",
        )
    return text


def _valid_days(value: Any, where: str) -> float:
    try:
        days = float(value)
    except (TypeError, ValueError):
        days = math.nan
    if not 0.0 < days < math.inf:
        raise OptionError(
            f"'{VALID_DAYS}' is '{value}'", where=where, remedy="give a number of days above 0"
        )
    return days


@dataclass(frozen=True, slots=True)
class FoundFeature:
    """Where a feature of a part was found: place, direction, form and points."""

    name: str
    kind: ShapeKind
    point_mm: FloatArray
    direction: FloatArray
    form_mm: float
    n_points: int


@dataclass(frozen=True, slots=True)
class PartResult:
    """``features.json``: what a recipe found on a part, and from which files.

    A part that is done by the same version and files is not done again; ``row`` is its row of the
    table.
    """

    armscan_version: str
    recipe_sha256: str
    part_sha256: str
    cloud_sha256: str
    row: PartRow
    features: tuple[FoundFeature, ...]


RESULT = RecordCodec({**LAYOUTS, PartResult: Layout(constants=RESULT_SCHEMA)})


def found_features(run: FollowedRecipe) -> tuple[FoundFeature, ...]:
    """The features of a part, for its file."""
    return tuple(
        FoundFeature(
            name=name,
            kind=one.shape.kind,
            point_mm=one.shape.point_mm,
            direction=one.shape.direction,
            form_mm=one.form_mm,
            n_points=one.counts.n_feature,
        )
        for name, one in run.features.items()
    )


def part_result_bytes(result: PartResult) -> bytes:
    """JSON of a part's result."""
    return json_bytes(RESULT.write(result))


def read_part_result(path: Path) -> PartResult:
    """Read a part's result."""
    where = path_text(path)
    try:
        return RESULT.read(PartResult, parse_json(read_bytes(path), where))
    except MismatchError as error:
        raise FileFormatError(str(error), where=where, remedy="inspect the part anew") from error


def is_part_table(path: Path) -> bool:
    """True for a table that `part_table_bytes` made."""
    return is_file(path) and path.read_bytes().startswith(f"# {TABLE_NOTE}".encode())


def part_table_bytes(rows: Sequence[PartRow]) -> bytes:
    """CSV with a row a part and, a quantity, its value, U (k = 2) and decision.

    Names that would be one without their commas are numbered; comments say which are which.
    """
    columns: dict[str, tuple[str, ...]] = {
        "part": tuple(row.name for row in rows),
        "cloud": tuple(row.cloud for row in rows),
        "verdict": tuple(row.verdict for row in rows),
        "reason": tuple(row.reason for row in rows),
    }
    comments = [TABLE_NOTE]
    held = [{(one.name, one.kind): one for one in row.quantities} for row in rows]
    known = {key: one for by_key in held for key, one in by_key.items()}
    for key, one in known.items():
        value, u, decision = _headings(one, columns)
        each = [by_key.get(key) for by_key in held]
        columns[value] = tuple(_cell(one, "value") for one in each)
        columns[u] = tuple(_cell(one, "u_value") for one in each)
        columns[decision] = tuple("" if one is None else one.decision for one in each)
        stem = decision.removesuffix("_decision")
        if "," in one.name or stem != _plain(one):
            comments.append(f"column {stem}: {one.name}, {one.kind}")
        if math.isfinite(one.tolerance) and one.kind != "spot":
            comments.append(f"{one.name}: {one.nominal:g} +- {one.tolerance:g} {one.unit}")
    return csv_bytes(columns, comments)


def _plain(one: PartQuantity) -> str:
    """A quantity's label as headings hold it, without commas."""
    return one.label.replace(",", "")


def _headings(one: PartQuantity, taken: Mapping[str, object]) -> tuple[str, str, str]:
    """Of the columns of a quantity's value, U and decision; none is taken."""
    name, unit = _plain(one), "mm" if one.unit == "mm" else "deg"
    stem, k = name, 1
    while True:
        found = f"{stem}_{unit}", f"{stem}_u_{unit}", f"{stem}_decision"
        if taken.keys().isdisjoint(found):
            return found
        k += 1
        stem = f"{name} ({k})"


def _cell(one: PartQuantity | None, name: str) -> str:
    return "" if one is None else number_text(getattr(one, name))
