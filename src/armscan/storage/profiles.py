# SPDX-License-Identifier: Apache-2.0
"""Profiles of a sensor that delivers points: CSV, or OpenCV's YAML with ``scan_line``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.records.point_profile import PointProfile
from armscan.storage.csv_table import parse_csv
from armscan.storage.image_paths import expand_paths, natural_key
from armscan.storage.images import read_bytes, source_names
from armscan.storage.pose_units import refuse_beyond_reach

PROFILE_SUFFIXES = frozenset({".yml", ".yaml", ".csv", ".txt"})
SCAN_LINE = re.compile(r"^\s*scan_line\s*:\s*\[([^\]]*)(\]?)", re.MULTILINE)
YAML_WORDS = {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf}


def read_profiles(paths: Sequence[Path | str]) -> tuple[PointProfile, ...]:
    """Read profiles, one a file, in the order given.

    CSV has the columns ``x_mm,z_mm`` or ``x_mm,y_mm,z_mm``; without ``y_mm`` the points lie in the
    plane y = 0. YAML has the list ``scan_line`` of x, y, z one after the other. A place with an
    empty or NaN coordinate is a gap and left out.

    Parameters
    ----------
    paths
        Files or quoted patterns; a folder stands for the profiles in it. Folders and patterns give
        natural order (p2 before p10).

    Raises
    ------
    FileFormatError
        If a file is missing, cut, no such profile, or holds no point.
    """
    files = [file for path in paths for file in _files(Path(path))]
    names = source_names(files)
    return tuple(_read(file, name) for file, name in zip(files, names, strict=True))


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return list(expand_paths([path]))
    found = [
        item
        for item in path.iterdir()
        if item.suffix.lower() in PROFILE_SUFFIXES and _looks_like_profile(item)
    ]
    if not found:
        raise FileFormatError(
            "the folder holds no profile", where=str(path), remedy="name the profiles' YAML or CSV"
        )
    return sorted(found, key=lambda item: natural_key(item.name))


def _looks_like_profile(path: Path) -> bool:
    start = path.read_bytes()[:2000].decode("utf-8-sig", errors="replace")
    return SCAN_LINE.search(start) is not None or "x_mm" in start


def _read(path: Path, name: str) -> PointProfile:
    data = read_bytes(path)
    text = data.decode("utf-8-sig", errors="replace")
    is_yaml = path.suffix.lower() in (".yml", ".yaml") or text.startswith("%YAML")
    values = _from_yaml(text, str(path)) if is_yaml else _from_csv(data, str(path))
    is_known = np.isfinite(values).all(axis=1)
    refuse_beyond_reach(values[is_known], str(path))
    if not bool(is_known.any()):
        raise FileFormatError(
            f"the profile holds no point ({len(values)} gaps)",
            where=str(path),
            remedy="leave this profile and its pose out",
        )
    return PointProfile(name, values[is_known], int((~is_known).sum()))


def _from_csv(data: bytes, where: str) -> FloatArray:
    table = parse_csv(data, where)
    if "y_mm" in table:
        return table.floats(("x_mm", "y_mm", "z_mm"), may_lack=True)
    table.require(("x_mm", "z_mm"))
    flat = table.floats(("x_mm", "z_mm"), may_lack=True)
    return np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]])


def _from_yaml(text: str, where: str) -> FloatArray:
    found = SCAN_LINE.search(text)
    if found is None:
        raise FileFormatError(
            "there is no list called scan_line", where=where, remedy="name a profile's YAML or CSV"
        )
    if not found[2]:
        raise FileFormatError("the list scan_line is cut short", where=where, remedy="copy it anew")
    words = found[1].replace(",", " ").split()
    if len(words) % 3:
        raise FileFormatError(
            f"scan_line holds {len(words)} numbers, not three a point",
            where=where,
            remedy="write x, y, z of each point one after the other; the file may be cut",
        )
    return np.array([_number(word, where) for word in words]).reshape(-1, 3)


def _number(word: str, where: str) -> float:
    known = YAML_WORDS.get(word.lower())
    if known is not None:
        return known
    try:
        return float(word)
    except ValueError as error:
        raise FileFormatError(
            f"'{word}' in scan_line is no number", where=where, remedy="write it as -12.5 or .Nan"
        ) from error
