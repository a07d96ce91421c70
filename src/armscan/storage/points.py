# SPDX-License-Identifier: Apache-2.0
"""Lists of points and of poses: probed points and planes, markers, profiles of a sensor that
delivers points.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, get_args

import numpy as np

from armscan.errors import FileFormatError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import CloudFrame
from armscan.records.points import CommonErrors, MarkerSet, ProbedPoints
from armscan.records.profile import PointProfile, Profile, StripeFlag
from armscan.storage.files import is_folder, path_text, read_bytes, told_of
from armscan.storage.image_paths import expand_paths, natural_key
from armscan.storage.images import source_names
from armscan.storage.tables import (
    COORDINATES,
    LARGEST_MM,
    CsvTable,
    csv_bytes,
    number_columns,
    number_text,
    parse_csv,
    read_csv,
    refuse_beyond_reach,
)

STRIPE_NUMBERS: Final = (
    *("x_px", "y_px", "sigma_px", "normal_x", "normal_y", "width_px", "intensity"),
)
PLANE_NAMES = ("a", "b", "c", "d")
NAMED_POINT = re.compile(rb"^#[#\s]*(?:\w+[\s,;]+)*?x(?:_mm)?[\s,;]+y(?:_mm)?[\s,;]+z", re.I | re.M)
"""A comment that names the columns of points."""
MOST_OF_A_PLANE = 2000
"""Bytes of a file with four numbers, a header and comments."""


def read_probed_points(path: Path) -> ProbedPoints:
    """Read points in Base that a probe touched.

    A table ``x_mm,y_mm,z_mm[,feature]``. A comment ``# point = tip-centre, tip_diameter_mm = 6``
    says that the points are centres of the tip; without it they are on the surface.
    ``# point = surface, tip_diameter_mm = 6`` keeps the diameter that was compensated for.
    """
    return _probed(read_csv(path))


def probed_points_csv(points: ProbedPoints) -> bytes:
    """Text of a table of probed points; reads back as the same numbers."""
    columns = number_columns(COORDINATES, points.points_mm)
    if points.features:
        columns["feature"] = points.features
    kind = "tip-centre" if points.are_tip_centres else "surface"
    if points.tip_diameter_mm:
        kind += f", tip_diameter_mm = {points.tip_diameter_mm!r}"
    return csv_bytes(columns, (f"point = {kind}",))


def parse_plane(text: str, where: str = "") -> FloatArray:
    """Plane (4,) ``A B C D`` with ``A x + B y + C z + D = 0`` from four numbers of any scale.

    It is scaled so that the normal has length 1 and D is in mm (eq. 2.55).

    Raises
    ------
    OptionError
        If these are not four finite numbers, or the normal is zero.
    """
    words = re.split(r"[\s,]+", text.strip())
    remedy = "give four numbers A,B,C,D, with D in mm"
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise OptionError(f"'{text.strip()}' is no plane", where=where, remedy=remedy) from error
    if values.shape != (4,):
        fact = f"{len(words)} numbers where 4 are needed"
        raise OptionError(fact, where=where, remedy=remedy)
    for name, value in zip(PLANE_NAMES, values, strict=True):
        if not np.isfinite(value):
            raise OptionError(f"{name.upper()} is {value:g}", where=where, remedy=remedy)
    length = math.sqrt(float(values[:3] @ values[:3]))
    if not 0.0 < length < math.inf or abs(float(values[3])) > LARGEST_MM * length:
        raise OptionError(
            "the plane's normal A,B,C is zero, or the plane is beyond all reach",
            where=where,
            remedy="give a plane's A,B,C,D",
        )
    return np.asarray(values / length)


def read_points_or_plane(path: Path) -> ProbedPoints | FloatArray:
    """Read probed points, or a plane's four numbers with or without the header ``A,B,C,D``."""
    data = read_bytes(path)
    words = _plane_words(data)
    if words is None:
        return _probed(parse_csv(data, path_text(path)))
    try:
        return parse_plane(words, str(path))
    except OptionError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def is_plane(data: bytes) -> bool:
    """Whether a file holds a plane's four numbers and nothing else, no names of coordinates."""
    is_short = len(data) < MOST_OF_A_PLANE
    return is_short and _plane_words(data) is not None and not NAMED_POINT.search(data)


def _plane_words(data: bytes) -> str | None:
    """The numbers of a file that holds a plane and nothing else; None for any other file."""
    text = data.decode("utf-8-sig", errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    if len(lines) == 2 and tuple(re.split(r"[\s,]+", lines[0].lower())) == PLANE_NAMES:
        return lines[1]
    if len(lines) == 1 and re.fullmatch(r"[-+\d.eE]+(?:[\s,]+[-+\d.eE]+){3}", lines[0]):
        return lines[0]
    return None


def _probed(table: CsvTable) -> ProbedPoints:
    points = table.points("point")
    tip_diameter_mm, is_compensated = _tip(table)
    with told_of(table.where):
        return ProbedPoints(
            points_mm=points,
            tip_diameter_mm=tip_diameter_mm,
            features=table.columns.get("feature", ()),
            source=table.where,
            is_compensated=is_compensated,
        )


MEANS_TIP = re.compile(r"\btip[ _-]*(?:diam|rad|cent)", re.IGNORECASE)
"""What a comment would hold that tells of the tip, however it is written."""


def _tip(table: CsvTable) -> tuple[float, bool]:
    """Diameter that a comment gives, 0 for none; whether the points are on the surface."""
    stated: dict[str, str] = {}
    for comment in table.comments:
        found = re.findall(r"\b(point|tip_diameter_mm)\s*=\s*([^,;]+)", comment)
        stated |= {key: value.strip() for key, value in found}
    unclear = [comment.strip() for comment in table.comments if MEANS_TIP.search(comment)]
    if unclear and not stated:
        raise FileFormatError(
            f"the comment '{unclear[0]}' speaks of a tip and is not understood",
            where=table.where,
            remedy="write '# point = tip-centre, tip_diameter_mm = 6', or with surface where "
            "the tip's radius is taken off; else leave the comment out",
        )
    kind = stated.get("point", "tip-centre" if "tip_diameter_mm" in stated else "surface")
    is_surface = kind == "surface"
    if is_surface and "tip_diameter_mm" not in stated:
        return 0.0, True
    if kind not in ("surface", "tip-centre"):
        raise FileFormatError(
            f"'point = {kind}' is not known",
            where=table.where,
            remedy="write surface or tip-centre",
        )
    try:
        diameter_mm = float(stated.get("tip_diameter_mm", ""))
    except ValueError:
        diameter_mm = 0.0
    if not 0.0 < diameter_mm < math.inf:
        what = "on the surface" if is_surface else "centres of the tip"
        raise FileFormatError(
            f"the points are {what}, but the tip's diameter is not given as a number of mm",
            where=table.where,
            remedy=f"write the line '# point = {kind}, tip_diameter_mm = 6'",
        )
    return diameter_mm, is_surface


COVARIANCES = ("cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2")
ASSUMED_SIGMA_MM = 0.02
"""Standard deviation an axis of a marker about which a list says nothing: a probed point, or a
ring's centre measured by two cameras."""
FRAME = re.compile(r"frame\s*[=:]\s*(\S.*)", re.IGNORECASE)
COMMON_IDS, COMMON_COVARIANCE = "moved together =", "covariance of moves ="
SIMULATED = "simulated"
"""Comment of a list that was measured on rendered images."""
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerList:
    """A list as read.

    Parameters
    ----------
    markers
        The markers; without a column ``id`` they are numbered from 1 in the order of the rows.
    has_ids
        True if the list numbers its markers itself.
    is_sigma_assumed
        True if the list holds no covariance.
    is_simulated
        True if the list says that it was measured on rendered images.
    is_frame_assumed
        True if the list names no frame.
    """

    markers: MarkerSet
    path: Path
    has_ids: bool
    is_sigma_assumed: bool
    is_simulated: bool = False
    is_frame_assumed: bool = False


def markers_csv(markers: MarkerSet, *, is_simulated: bool = False) -> bytes:
    """Text of a table of markers; `read_marker_list` reads it back as the same numbers.

    Columns ``id,x_mm,y_mm,z_mm`` and the six different elements of the covariance; a comment
    ``# frame = Sensor`` names the coordinate frame, and ``# simulated`` marks rendered images.
    """
    upper = markers.covariance_mm2[:, _UPPER[0], _UPPER[1]]
    columns = {"id": tuple(str(number) for number in markers.ids)}
    columns |= number_columns(COORDINATES, markers.points_mm)
    columns |= number_columns(COVARIANCES, upper)
    marks = (SIMULATED,) if is_simulated else ()
    return csv_bytes(columns, (f"frame = {markers.frame}", *marks, *_common_lines(markers)))


def _common_lines(markers: MarkerSet) -> tuple[str, ...]:
    """Comments from which `_common_errors` reads the same numbers."""
    if markers.common is None:
        return ()
    covariance = markers.common.covariance
    upper = covariance[np.triu_indices(len(covariance))]
    return (
        *(f"{COMMON_IDS} {' '.join(map(str, group))}" for group in markers.common.groups),
        f"{COMMON_COVARIANCE} {' '.join(map(number_text, upper))}",
    )


def _common_errors(table: CsvTable) -> CommonErrors | None:
    said = [
        [text[len(key) :].split() for text in table.comments if text.startswith(key)]
        for key in (COMMON_IDS, COMMON_COVARIANCE)
    ]
    if not any(said):
        return None
    groups, numbers = said
    n = 6 * len(groups)
    covariance = np.zeros((n, n))
    try:
        covariance[np.triu_indices(n)] = [float(word) for word in numbers[0]]
        covariance = np.where(np.tri(n, dtype=bool), covariance.T, covariance)
        return CommonErrors(
            groups=tuple(tuple(map(int, group)) for group in groups), covariance=covariance
        )
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            f"the comments '# {COMMON_IDS}' and '# {COMMON_COVARIANCE}' do not belong together",
            where=table.where,
            remedy="copy the list again; without these comments its markers count as independent",
        ) from error


def stripes_csv(profiles: Sequence[Profile], *, is_simulated: bool = False) -> bytes:
    """Text of a table of the stripe points of images, rejected ones too.

    Columns ``image``, `STRIPE_NUMBERS`, ``segment``, ``accepted`` and ``flags``: the centre, its
    standard deviation along the normal, the normal, sigma of the line's section, peak above the
    background in grey levels, number of the connected segment in its image, 1 for points that
    count, and the names of all `StripeFlag` of the point.
    """
    said = {
        flags: "+".join(flag.name or "" for flag in StripeFlag(flags))
        for flags in {int(flags) for profile in profiles for flags in np.unique(profile.flags)}
    }
    columns: dict[str, tuple[str, ...]] = {
        "image": tuple(profile.source for profile in profiles for _ in range(len(profile)))
    }
    numbers = [
        np.column_stack([p.points_px, p.sigma_px, p.normals_px, p.width_px, p.intensity])
        for p in profiles
    ]
    columns |= number_columns(STRIPE_NUMBERS, np.concatenate([*numbers, np.zeros((0, 7))]))
    columns["segment"] = tuple(str(one) for p in profiles for one in p.segment.tolist())
    columns["accepted"] = tuple(str(int(one)) for p in profiles for one in p.is_accepted.tolist())
    columns["flags"] = tuple(said[one] for p in profiles for one in p.flags.tolist())
    return csv_bytes(columns, (SIMULATED,) if is_simulated else ())


def read_marker_list(path: Path, *, frame: str, sigma_mm: float = ASSUMED_SIGMA_MM) -> MarkerList:
    """Read a table ``x_mm,y_mm,z_mm`` with, if you like, ``id`` and the six covariances.

    A comment ``# frame = Base``, however it is written, names the frame, ``# simulated`` marks
    rendered images. Tables of
    probed points are such lists; points are taken as they stand, centres of a tip included.

    ``frame`` is that of the markers where the list names none, ``sigma_mm`` the standard deviation
    an axis where it gives no covariance.

    Raises
    ------
    FileFormatError
        If the file is no such table, holds no marker, is in metres, an id or a place occurs twice,
        or a covariance is none.
    """
    table = read_csv(path)
    points = table.points("marker")
    _, first, counts = np.unique(points, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        raise FileFormatError(
            "two markers have the same place",
            where=table.place(int(first[np.argmax(counts > 1)])),
            remedy="list each marker once",
        )
    ids = table.ints("id") if "id" in table else np.arange(1, len(table) + 1)
    table.refuse_repeats("id", ids.tolist())
    has_covariance = any(name in table for name in COVARIANCES)
    named = [str(found[1]) for text in table.comments if (found := FRAME.fullmatch(text))]
    known: dict[str, str] = {name.lower(): name for name in get_args(CloudFrame)}
    with told_of(table.where, remedy="correct the table, or measure again"):
        markers = MarkerSet(
            ids=ids,
            points_mm=points,
            covariance_mm2=_covariance(table, sigma_mm, has_covariance=has_covariance),
            frame=known.get(named[0].lower(), named[0]) if named else frame,
            source=path_text(path),
            common=_common_errors(table),
        )
    is_simulated = SIMULATED in (text.strip() for text in table.comments)
    return MarkerList(markers, path, "id" in table, not has_covariance, is_simulated, not named)


def _covariance(table: CsvTable, sigma_mm: float, *, has_covariance: bool) -> FloatArray:
    if not has_covariance:
        return np.tile(sigma_mm**2 * np.eye(3), (len(table), 1, 1))
    table.require(COVARIANCES)
    rows, columns = _UPPER
    covariance = np.zeros((len(table), 3, 3))
    covariance[:, rows, columns] = table.floats(COVARIANCES)
    covariance[:, columns, rows] = covariance[:, rows, columns]
    least = np.linalg.eigvalsh(covariance)[:, 0]
    if least.min() <= 0.0:
        raise FileFormatError(
            "the six covariances make no covariance matrix (it is not positive definite)",
            where=table.place(int(np.argmin(least))),
            remedy="give variances above 0, or leave the six columns out",
        )
    return covariance


PROFILE_SUFFIXES = frozenset({".yml", ".yaml", ".csv", ".txt"})
SCAN_LINE = re.compile(r"^[ \t]*scan_line[ \t]*:\s*\[([^\]]*)(\]?)", re.MULTILINE)
ROTATION = re.compile(
    r"\s*(?:(?:[abc]|r[xyz])[ _]?\W?(?:deg|rad)\W?|[abc]|r[xyz]|q_?[wxyz]|r\d\d|rotvec\w*)\s*"
)
"""A column of a table of poses, which has three of them or more."""
YAML_WORDS = {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf}


def read_profiles(paths: Sequence[Path | str]) -> tuple[PointProfile, ...]:
    """Read profiles, one a file, in the order given.

    CSV has the columns ``x_mm,z_mm`` or ``x_mm,y_mm,z_mm``; without ``y_mm`` the points lie in the
    plane y = 0. YAML has the list ``scan_line`` of x, y, z one after the other. A place with an
    empty or NaN coordinate is a gap and left out.

    Files or quoted patterns are given, a folder stands for the profiles in it; folders and patterns
    give natural order (p2 before p10).
    """
    files = [file for path in paths for file in profile_files(Path(path))]
    names = source_names(files)
    return tuple(_read(file, name) for file, name in zip(files, names, strict=True))


def profile_files(path: Path, poses: Path | None = None) -> list[Path]:
    """Profiles of a file, a pattern or a folder, in natural order.

    A table of poses in the folder is none, whether it is ``poses`` or is told by its header.
    """
    if not is_folder(path):
        return list(expand_paths([path]))
    found = [
        item
        for item in path.iterdir()
        if item.suffix.lower() in PROFILE_SUFFIXES
        and (poses is None or item.resolve() != poses.resolve())
        and _looks_like_profile(item)
    ]
    if not found:
        raise FileFormatError(
            "the folder holds no profile", where=str(path), remedy="name the profiles' YAML or CSV"
        )
    return sorted(found, key=lambda item: natural_key(item.name))


def _looks_like_profile(path: Path) -> bool:
    start = path.read_bytes()[:2000].decode("utf-8-sig", errors="replace")
    if SCAN_LINE.search(start):
        return True
    heading = next((line for line in start.splitlines() if "x_mm" in line), "")
    return bool(heading) and not has_rotations(heading.lower().split(","))


def has_rotations(names: Iterable[str]) -> bool:
    """Whether these are columns of a table of poses."""
    return sum(ROTATION.fullmatch(name) is not None for name in names) >= 3


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
    return PointProfile(source=name, points_mm=values[is_known], n_gaps=int((~is_known).sum()))


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
