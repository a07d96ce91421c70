# SPDX-License-Identifier: Apache-2.0
"""Tables that go with a part: tolerances of its faces, and deviations of points and faces."""

from __future__ import annotations

import math
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError, OptionError
from armscan.inspection.cad.comparison import DECISIONS, DEFINITIONS, CadComparison
from armscan.inspection.cad.part import PartModel
from armscan.records.cloud import PointCloud
from armscan.storage.codec import parse_toml
from armscan.storage.files import path_text, read_bytes
from armscan.storage.formats.ply import ply_header
from armscan.storage.tables import csv_bytes, number_text, parse_csv

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
    hint = f"did you mean '{near[0]}'" if near else f"its faces are {_listed(part.face_names)}"
    raise FileFormatError(f"the part has no face '{name}'", where=where, remedy=hint)


def _listed(names: tuple[str, ...], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


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
