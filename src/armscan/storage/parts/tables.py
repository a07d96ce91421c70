# SPDX-License-Identifier: Apache-2.0
"""Tables that go with a part, and what its alignment rests on as it is written.

Tolerances of its faces, faces and nominal features as datums, tables of reference points; and
deviations of points and faces.
"""

from __future__ import annotations

import math
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError, InputError, OptionError, listed
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import SHAPE_KINDS, Shape, across
from armscan.inspection.cad.comparison import DECISIONS, DEFINITIONS, CadComparison
from armscan.inspection.cad.datums import DatumFeature, datum_face
from armscan.inspection.cad.part import PartModel
from armscan.inspection.cad.reference_points import ReferencePoints, paired_markers
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.storage.codec import parse_toml
from armscan.storage.files import path_text, read_bytes
from armscan.storage.formats.ply import ply_header
from armscan.storage.points import ASSUMED_SIGMA_MM, read_marker_list
from armscan.storage.tables import (
    COORDINATES,
    CsvTable,
    csv_bytes,
    number_text,
    parse_csv,
    read_csv,
)

EVERY_FACE = "*"
"""Name, in a table of tolerances, of the faces that it does not name."""
HOW_TO_WRITE = "write default_mm = 0.05 and a table [faces] of names and mm"
MM_COLUMNS = tuple(key for key in DEFINITIONS if key.endswith("_mm"))


def read_tolerances(text: str, part: PartModel) -> tuple[float, dict[str, float]]:
    """The tolerance of all faces in mm, NaN for none, and those of single faces.

    The text is empty; a number in mm; or the name of a file: TOML with ``default_mm`` and a table
    ``[faces]`` of names and mm, or CSV with the columns ``face`` and ``tolerance_mm``, ``*``
    standing for every face that is not named.

    Raises
    ------
    OptionError
        If the text is neither a number nor the name of such a file.
    """
    if not text:
        return math.nan, {}
    try:
        limit = float(text)
    except ValueError:
        path = Path(text)
    else:
        if not math.isfinite(limit):
            raise OptionError(
                f"a tolerance of {text} mm", where="--tolerance", remedy="give a length in mm"
            )
        return limit, {}
    if path.suffix.lower() not in (".toml", ".csv"):
        raise OptionError(
            f"'{text}' is neither a length in mm nor a .toml or .csv file",
            where="--tolerance",
            remedy="give such as 0.05, or tolerances.toml",
        )
    where, data = path_text(path), read_bytes(path)
    if path.suffix.lower() == ".csv":
        table = parse_csv(data, where)
        table.require(("face", "tolerance_mm"), "face")
        names = table.columns["face"]
        table.refuse_repeats("face", names)
        limits = table.floats(("tolerance_mm",))[:, 0].tolist()
        faces = dict(zip(names, limits, strict=True))
        default = faces.pop(EVERY_FACE, math.nan)
    else:
        default, faces = _toml_tolerances(parse_toml(data, where, HOW_TO_WRITE), where)
    for name in faces:
        require_face(name, part, where)
    return default, faces


def _toml_tolerances(content: dict[str, Any], where: str) -> tuple[float, dict[str, float]]:
    default, faces = content.get("default_mm", math.nan), content.get("faces", {})
    unknown = sorted(set(content) - {"default_mm", "faces"})
    numbers = [default, *faces.values()] if isinstance(faces, dict) else [None]
    if unknown or not all(
        isinstance(one, int | float) and not isinstance(one, bool) for one in numbers
    ):
        fact = f"unknown entry {unknown[0]}" if unknown else "a tolerance is no number"
        raise FileFormatError(fact, where=where, remedy=HOW_TO_WRITE)
    return float(default), {str(name): float(one) for name, one in faces.items()}


def require_face(name: str, part: PartModel, where: str) -> None:
    """Refuse the name of a face that the part lacks."""
    if name in part.face_names:
        return
    near = get_close_matches(name, part.face_names, 1)
    hint = f"did you mean '{near[0]}'" if near else f"its faces are {listed(part.face_names, 12)}"
    raise FileFormatError(f"the part has no face '{name}'", where=where, remedy=hint)


def face_table_bytes(found: CadComparison) -> bytes:
    """CSV of the faces: statistics, spot that decides, tolerance and decision."""
    columns: dict[str, tuple[str, ...]] = {
        "face": tuple(one.name for one in found.faces),
        "n": tuple(str(one.statistics.n) for one in found.faces),
    }
    for key in MM_COLUMNS:
        columns[key] = tuple(_cell(getattr(one.statistics, key)) for one in found.faces)
    for key in ("u_mean_mm", "spot_mm", "u_spot_mm", "tolerance_mm"):
        columns[key] = tuple(_cell(getattr(one, key)) for one in found.faces)
    for k, axis in enumerate("xyz"):
        columns[f"spot_{axis}_mm"] = tuple(_cell(one.spot_place_mm[k]) for one in found.faces)
    columns["decision"] = tuple(one.decision for one in found.faces)
    comments = [f"{key}: {meaning}" for key, (_, meaning) in DEFINITIONS.items()]
    return csv_bytes(columns, comments)


def _cell(value: float) -> str:
    return number_text(float(value)) if math.isfinite(value) else ""


def deviation_ply_bytes(found: CadComparison, cloud: PointCloud, part: PartModel) -> bytes:
    """PLY of the points within reach, in Cad, with their deviations, U, faces and decisions."""
    columns = {
        **{name: found.points_mm[:, k] for k, name in enumerate("xyz")},
        "deviation_mm": found.deviation_mm,
        "u_mm": found.u_mm,
        "sheet": cloud.sheet[found.rows],
        "exposure": cloud.exposure[found.rows],
        "face": found.face,
        "decision": found.decision,
    }
    whole = ("sheet", "exposure", "face", "decision")
    kinds = [(name, "<i4" if name in whole else "<f8") for name in columns]
    table = np.zeros(len(found), dtype=kinds)
    for name, values in columns.items():
        table[name] = values
    comments = [
        "written by armscan",
        "unit mm",
        "frame Cad",
        "deviation_mm positive outside; u_mm k = 2, nan for not known",
        "decision " + " ".join(f"{k} {word}" for k, word in enumerate(DECISIONS)) + " -1 none",
        *(f"face {k} {name}" for k, name in enumerate(part.face_names)),
    ]
    if cloud.is_simulated:
        comments.append("simulated")
    plain = [text.encode("ascii", "replace").decode() for text in comments]
    return ply_header(table.dtype, len(found), plain) + table.tobytes()


MEASURED = tuple(f"measured_{name}" for name in COORDINATES)
PICKED = tuple(f"picked_{name}" for name in COORDINATES)
SIGMA = "sigma_mm"
WORDS = ("at", "axis", "diameter", "half-angle", "region")
"""What a description of a nominal feature may say."""
COUNTS = {"at": 3, "axis": 3, "diameter": 1, "half-angle": 1, "region": 6}
ROUND = ("circle", "sphere", "cylinder", "cone")
NOMINAL_MARKER_MM = 0.01
"""Standard deviation an axis of a marker's nominal place, where its list says none: as well as a
measuring machine tells it."""


def datum_faces(names: str, part: PartModel) -> tuple[int, ...]:
    """Numbers of three faces named between commas, or ``|``.

    Raises
    ------
    OptionError
        If they are not three different faces of the part.
    """
    words = _words(names)
    if len(words) != 3 or len(set(words)) != 3:
        raise OptionError(
            f"{len(set(words))} different datum faces where 3 are needed",
            where="--datums",
            remedy=f"name three of the faces, such as {', '.join(part.face_names[:3])}",
        )
    for word in words:
        require_face(word, part, "--datums")
    return tuple(part.face_names.index(word) for word in words)


def datum_features(text: str, part: PartModel) -> tuple[DatumFeature, ...]:
    """Datums in their order, as ``plane 5|cylinder 19`` or ``plane 5|sphere:at=1,2,3:diameter=8``.

    Each is the name of a face of the model, or a nominal feature ``KIND:WORD=VALUE:...`` with the
    words ``at`` (a point of it, the centre, a point of the axis), ``axis`` (or normal),
    ``diameter`` (of a cone that at ``at``), ``half-angle`` in degrees, ``region`` in mm of the
    model. Without ``|`` and ``:``, commas part the names.

    Raises
    ------
    OptionError
        If one of them is neither, or is named twice.
    """
    words = _words(text)
    if not words:
        raise OptionError(
            "no datum is named", where="--datums", remedy="name faces, such as 'plane 1|cylinder 2'"
        )
    twice = [word for word in words if words.count(word) > 1]
    if twice:
        raise OptionError(
            f"the datum '{twice[0]}' is named twice", where="--datums", remedy="name it once"
        )
    return tuple(_feature(word, part) for word in words)


def _words(text: str) -> list[str]:
    parts = text.split("|") if "|" in text or ":" in text else text.split(",")
    return [word.strip() for word in parts if word.strip()]


def _feature(word: str, part: PartModel) -> DatumFeature:
    kind, _, rest = word.partition(":")
    if kind in SHAPE_KINDS and word not in part.face_names:
        return _nominal_feature(word, kind, rest)
    require_face(word, part, "--datums")
    found = datum_face(part.face_names.index(word), part)
    if isinstance(found, FitFailure):
        raise OptionError(found.reason, where="--datums", remedy=found.remedy)
    return found


def _example(kind: str) -> str:
    """A nominal feature of a kind, such as is understood."""
    words = {"at": "1,2,3", "axis": "0,0,1", "diameter": "8", "half-angle": "30"}
    return ":".join([kind, *(f"{name}={words[name]}" for name in _needed(kind))])


def _needed(kind: str) -> list[str]:
    needed = ["at"] + ["axis"] * (kind != "sphere") + ["diameter"] * (kind in ROUND)
    return needed + ["half-angle"] * (kind == "cone")


def _nominal_feature(word: str, kind: str, rest: str) -> DatumFeature:
    remedy = f"write it with all its words, as {_example(kind)}"
    given: dict[str, list[float]] = {}
    for item in rest.split(":"):
        name, is_there, value = item.partition("=")
        try:
            numbers = [float(one) for one in value.split(",")]
        except ValueError:
            numbers = []
        if name not in WORDS or not is_there or len(numbers) != COUNTS.get(name):
            raise OptionError(
                f"'{item}' of the datum '{word}' is not understood", where="--datums", remedy=remedy
            )
        if not all(math.isfinite(one) for one in numbers):
            raise OptionError(f"'{item}' is not finite", where="--datums", remedy=remedy)
        given[name] = numbers
    needed = _needed(kind)
    missing = [name for name in needed if name not in given]
    vain = [name for name in given if name not in (*needed, "region")]
    if missing or vain:
        what = f"lacks '{missing[0]}'" if missing else f"has no '{vain[0]}'"
        raise OptionError(f"the datum '{word}' {what}", where="--datums", remedy=remedy)
    axis = np.array(given.get("axis", [0.0, 0.0, 1.0]))
    radius = given.get("diameter", [0.0])[0] / 2.0
    angle = given.get("half-angle", [0.0])[0]
    is_sound = axis.any() and radius >= 0.0 and 0.0 <= angle < 85.0
    if not is_sound or (kind in ROUND and radius == 0.0) or (kind == "cone" and angle == 0.0):
        raise OptionError(
            f"the datum '{word}' has an axis, diameter or angle of 0, or beyond reason",
            where="--datums",
            remedy=remedy,
        )
    box = given.get("region")
    return DatumFeature(
        name=word,
        shape=Shape(
            kind=kind,  # type: ignore[arg-type]
            point_mm=np.array(given["at"]),
            axes=across(axis),
            radius_mm=radius,
            half_angle_rad=math.radians(angle),
        ),
        region=None if box is None else Box.from_limits(box, "--datums"),
    )


def read_reference_points(path: Path, measured: Path | None = None) -> ReferencePoints:
    """Read nominal places of points, and where they were measured.

    Parameters
    ----------
    path
        CSV ``name,x_mm,y_mm,z_mm`` (nominal), and in the same table ``measured_x_mm`` and so on,
        or ``picked_x_mm`` for places picked roughly in the cloud; ``sigma_mm``, of each measured
        coordinate, if it is known.
    measured
        Or the measured places in a table of their own, ``name,x_mm,y_mm,z_mm[,sigma_mm]``; points
        of equal names are the same.

    Raises
    ------
    OptionError
        If measured places are given twice, or not at all.
    """
    table = read_csv(path)
    nominal, names = table.points("point"), _names(table)
    held = [kind for kind in (MEASURED, PICKED) if any(name in table for name in kind)]
    if len(held) + (measured is not None) != 1:
        what = "no measured places" if not held and measured is None else "measured places twice"
        raise OptionError(
            f"the reference points have {what}",
            where=table.where,
            remedy="give columns measured_x_mm, measured_y_mm, measured_z_mm (or picked_x_mm and "
            "so on), or a table of measured points (--measured), and one of these only",
        )
    if measured is None:
        table.require(held[0])
        sigma = _sigma(table)
        return _points(names, nominal, table.floats(held[0]), sigma, is_picked=held[0] is PICKED)
    other = read_csv(measured)
    places, theirs, sigma = other.points("point"), _names(other), _sigma(other)
    common = [name for name in names if name in theirs]
    if not common:
        raise FileFormatError(
            f"no point of it has a name of {table.where}",
            where=other.where,
            remedy="name the points alike in both tables",
        )
    rows = [theirs.index(name) for name in common]
    own = [names.index(name) for name in common]
    found = _points(tuple(common), nominal[own], places[rows], sigma[rows], is_picked=False)
    return found


def _names(table: CsvTable) -> tuple[str, ...]:
    names = table.columns.get("name") or tuple(str(k + 1) for k in range(len(table)))
    table.refuse_repeats("name", names)
    return tuple(names)


def _sigma(table: CsvTable) -> FloatArray:
    """(N,) zero where not told."""
    if SIGMA not in table:
        return np.zeros(len(table))
    sigma = table.floats((SIGMA,))[:, 0]
    if (sigma <= 0.0).any():
        raise FileFormatError(
            f"a {SIGMA} of {sigma.min():g}",
            where=table.place(int(np.argmin(sigma))),
            remedy="give standard deviations above 0, or leave the column out",
        )
    return sigma


def _points(
    names: tuple[str, ...],
    nominal: FloatArray,
    measured: FloatArray,
    sigma: FloatArray,
    *,
    is_picked: bool,
) -> ReferencePoints:
    return ReferencePoints(
        names=names,
        nominal_mm=nominal,
        measured_mm=measured,
        covariance_mm2=sigma[:, None, None] ** 2 * np.eye(3),
        is_picked=is_picked,
    )


def read_reference_markers(
    path: Path, measured: Path, frame: CloudFrame
) -> ReferencePoints | FitFailure:
    """Read nominal places of markers, and markers as `armscan markers` measured them.

    Parameters
    ----------
    path
        CSV ``x_mm,y_mm,z_mm``; with a column ``id``, equal numbers in both lists are one marker,
        else the lists are matched by their distances.
    measured
        List of the markers, in the cloud's frame.
    frame
        The cloud's.

    Raises
    ------
    InputError
        If the measured markers are in another frame than the cloud.
    """
    nominal = read_marker_list(path, frame="Cad", sigma_mm=NOMINAL_MARKER_MM)
    found = read_marker_list(measured, frame=frame)
    if found.markers.frame != frame:
        raise InputError(
            f"the markers are in the frame {found.markers.frame}, the cloud in {frame}",
            where=found.markers.source,
            remedy="give the list that was measured with the cloud",
        )
    if nominal.has_ids and not found.has_ids:
        raise FileFormatError(
            "the measured markers have no column id, and the nominal ones have one",
            where=found.markers.source,
            remedy="leave the nominal list's column id out: markers are matched by distances then",
        )
    pairs = paired_markers(nominal.markers, found.markers, by_number=nominal.has_ids)
    if isinstance(pairs, FitFailure) or not found.is_sigma_assumed:
        return pairs
    note = (
        "the list of measured markers tells no covariances: a standard deviation of "
        f"{ASSUMED_SIGMA_MM:g} mm an axis is assumed"
    )
    return replace(pairs, notes=(*pairs.notes, note))
