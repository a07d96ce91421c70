# SPDX-License-Identifier: Apache-2.0
"""Lists of points and of poses: probed points and planes, markers, profiles of a sensor that
delivers points, poses of a robot, and how rotations and units are written in tables.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import (
    EulerConvention,
    euler_from_rotations,
    rotations_from_euler,
    vector_from_rotation,
)
from armscan.records.points import MarkerSet, ProbedPoints
from armscan.records.profile import PointProfile, Profile, StripeFlag
from armscan.records.recording import PoseForm
from armscan.storage.codec import parse_json
from armscan.storage.files import is_folder, path_text, read_bytes, told_of
from armscan.storage.image_paths import expand_paths, natural_key
from armscan.storage.images import source_names
from armscan.storage.tables import (
    COORDINATES,
    LARGEST_MM,
    CsvTable,
    csv_bytes,
    number_columns,
    parse_csv,
    read_csv,
    refuse_beyond_reach,
)

POSITION: Final = ("x_mm", "y_mm", "z_mm")
FORM_COLUMNS: Final[dict[PoseForm, tuple[str, ...]]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    "euler": ("a_deg", "b_deg", "c_deg"),
    "joints": (),
}
STRIPE_NUMBERS: Final = (
    *("x_px", "y_px", "sigma_px", "normal_x", "normal_y", "width_px", "intensity"),
)
NORM_TOLERANCE = 1e-6
ORTHONORMAL_TOLERANCE = 1e-5
"""Six decimals of nine numbers leave up to about 3e-6, more than a `Pose` allows; what passes is
made exact before it becomes one."""
FULL_TURNS_DEG = 720.0


def rotations_of_form(
    numbers: FloatArray, form: PoseForm, convention: EulerConvention, places: Sequence[str]
) -> FloatArray:
    """Rotations (N, 3, 3) of numbers (N, C) in the order of `FORM_COLUMNS`.

    A quaternion is w, x, y, z (Hamilton, active), of either sign and norm 1 within 1e-6; a matrix
    is row by row and orthonormal within 1e-5, and the nearest rotation is taken.

    Parameters
    ----------
    numbers
        Finite.
    form, convention
        How they are written.
    places
        (N,) file and line of each, for messages.

    Raises
    ------
    FileFormatError
        If a row is no rotation.
    """
    if form == "quaternion":
        return _from_quaternions(numbers, places)
    if form == "matrix":
        return _from_matrices(numbers.reshape(-1, 3, 3), places)
    largest = np.abs(numbers).max(axis=1, initial=0.0)
    if (largest > FULL_TURNS_DEG).any():
        row = int(np.argmax(largest > FULL_TURNS_DEG))
        raise FileFormatError(
            f"an angle of {largest[row]:g} deg",
            where=places[row],
            remedy="check that positions and angles are in their columns",
        )
    return rotations_from_euler(np.radians(numbers), convention)


def pose_numbers(
    rotations: FloatArray, is_known: BoolArray, form: PoseForm, convention: EulerConvention
) -> FloatArray:
    """Numbers (N, C) in the order of `FORM_COLUMNS`, NaN where the pose is not known."""
    numbers = np.full((len(rotations), len(FORM_COLUMNS[form])), np.nan)
    known = rotations[is_known]
    if not len(known):
        return numbers
    if form == "quaternion":
        numbers[is_known] = np.roll(Rotation.from_matrix(known).as_quat(canonical=True), 1, axis=1)
    elif form == "matrix":
        numbers[is_known] = known.reshape(-1, 9)
    else:
        numbers[is_known] = np.degrees(euler_from_rotations(known, convention))
    return numbers


def _from_quaternions(numbers: FloatArray, places: Sequence[str]) -> FloatArray:
    if not len(numbers):
        return np.zeros((0, 3, 3))
    norms = np.linalg.norm(numbers, axis=1)
    wrong = np.abs(norms - 1.0) > NORM_TOLERANCE
    if wrong.any():
        row = int(np.argmax(wrong))
        raise FileFormatError(
            f"the quaternion's norm is {norms[row]:.8g}, not 1 within {NORM_TOLERANCE:g}",
            where=places[row],
            remedy="write qw,qx,qy,qz with seven decimals or more, each in its own column",
        )
    return np.asarray(Rotation.from_quat(np.roll(numbers, -1, axis=1)).as_matrix())


def _from_matrices(matrices: FloatArray, places: Sequence[str]) -> FloatArray:
    defect = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    is_mirrored = np.linalg.det(matrices) < 0.0
    wrong = (defect > ORTHONORMAL_TOLERANCE) | is_mirrored
    if wrong.any():
        row = int(np.argmax(wrong))
        fact = (
            "mirrors" if is_mirrored[row] else f"is not orthonormal: |R R' - 1| = {defect[row]:.2g}"
        )
        raise FileFormatError(
            f"the matrix {fact}",
            where=places[row],
            remedy="write r11,r12,r13,r21 and so on, row by row, with seven decimals or more",
        )
    left, _, right = np.linalg.svd(matrices)
    is_exact = defect < 1e-14
    return np.where(is_exact[:, None, None], matrices, left @ right)


REACH_MM = 10.0
"""No arm keeps its last link this near to the origin of Base; in metres, no arm gets farther."""
MOVED_MM = 0.01
TURNED_RAD = math.radians(3.0)

METRES_REMEDY = (
    "multiply x, y and z by 1000; if they are millimetres, add 1000 to each x, for Base may lie "
    "anywhere"
)


def are_within_reach_of_base(translations_mm: FloatArray) -> bool:
    """True if all (N, 3) positions lie within 10 mm of Base's origin, and not all at it."""
    if not len(translations_mm):
        return False
    distance = np.linalg.norm(translations_mm, axis=1)
    return bool(0.0 < distance.max() < REACH_MM)


def are_surely_metres(rotations: FloatArray, translations_mm: FloatArray) -> bool:
    """True if the poses of an arm make no sense in millimetres.

    They do not where the tool stays within 10 mm of Base's origin and moves, while it turns about
    two axes: a stage of small travel does not turn, and a turntable turns about one axis only.

    Parameters
    ----------
    rotations
        (N, 3, 3) of ``base_from_tool``.
    translations_mm
        (N, 3) as written under the name of millimetres.
    """
    if len(rotations) < 3 or not are_within_reach_of_base(translations_mm):
        return False
    moved = np.linalg.norm(translations_mm - translations_mm.mean(axis=0), axis=1).max()
    chosen = np.unique(np.linspace(0, len(rotations) - 1, 200).astype(np.int64))
    turns = np.array([vector_from_rotation(rotations[0].T @ rotations[k]) for k in chosen])
    _, _, axes = np.linalg.svd(turns, full_matrices=False)
    about_second = np.abs(turns @ axes[1]).max()
    return bool(moved > MOVED_MM and about_second > TURNED_RAD)


JSON_KEY = "RobPoses"
HEADERS = (("x", "y", "z", "w", "p", "r"), ("x", "y", "z", "a", "b", "c"))
"""Headers that are understood, without units and case."""
FULL_TURN_DEG = 720.0


def read_robot_poses(path: Path, convention: EulerConvention) -> tuple[Pose[Base, Tool], ...]:
    """Read poses ``base_from_tool``.

    A JSON object with the list ``RobPoses``, or text with one pose a line, separated by commas or
    blanks, with or without a header; ``#`` starts a comment. Each pose is x, y, z in mm and the
    angles a, b, c of the convention in degrees (FANUC: W, P, R, ``extrinsic-xyz``).

    Raises
    ------
    FileFormatError
        If the file is missing, cut, or a pose is not six finite numbers, or positions are in
        metres.
    """
    data = read_bytes(path)
    where = str(path)
    is_json = data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
    table = _from_json(data, where) if is_json else _from_text(data, where)
    if not len(table):
        raise FileFormatError(
            "the file holds no pose",
            where=where,
            remedy="write six numbers a line: x, y, z in mm and three angles in degrees",
        )
    if np.abs(table[:, 3:]).max() > FULL_TURN_DEG:
        raise FileFormatError(
            f"an angle of {np.abs(table[:, 3:]).max():g} deg",
            where=where,
            remedy="write x, y, z in mm, then three angles in degrees",
        )
    refuse_beyond_reach(table[:, :3], where)
    rotations = rotations_from_euler(np.radians(table[:, 3:]), convention)
    if are_surely_metres(rotations, table[:, :3]):
        raise FileFormatError(
            "the tool turns but stays within 10 mm of Base's origin: positions look like metres",
            where=where,
            remedy=METRES_REMEDY,
        )
    return tuple(Pose(rotation, row[:3]) for rotation, row in zip(rotations, table, strict=True))


def _from_json(data: bytes, where: str) -> FloatArray:
    rows: Any = parse_json(data, where).get(JSON_KEY)
    if not isinstance(rows, list):
        raise FileFormatError(
            f"there is no list called {JSON_KEY}", where=where, remedy="name the robot's poses"
        )
    return np.array([_six(row, f"{where}, pose {k}") for k, row in enumerate(rows, start=1)])


def _from_text(data: bytes, where: str) -> FloatArray:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(
            "this is not UTF-8 text", where=where, remedy="save it as UTF-8"
        ) from error
    rows: list[list[float]] = []
    is_header_possible = True
    for number, line in enumerate(lines, start=1):
        words = re.split(r"[\s,;]+", line.split("#")[0].strip())
        if words == [""]:
            continue
        if is_header_possible and _is_header(words):
            is_header_possible = False
            continue
        is_header_possible = False
        rows.append(_six(words, f"{where}, line {number}"))
    return np.array(rows).reshape(-1, 6)


def _is_header(words: list[str]) -> bool:
    """True for the names of the six columns in the order that is understood."""
    names = tuple(re.sub(r"[_(\[].*", "", word).lower() for word in words)
    return names in HEADERS


def _six(row: Any, where: str) -> list[float]:
    try:
        values = [float(value) for value in row]
    except (TypeError, ValueError):
        values = []
    if len(values) != 6 or not bool(np.isfinite(values).all()):
        raise FileFormatError(
            "a pose is not six numbers",
            where=where,
            remedy="write x, y, z in mm and three angles in degrees, in this order",
        )
    return values


PLANE_NAMES = ("a", "b", "c", "d")


def read_probed_points(path: Path) -> ProbedPoints:
    """Read points in Base that a probe touched.

    A table ``x_mm,y_mm,z_mm[,feature]``. A comment ``# point = tip-centre, tip_diameter_mm = 6``
    says that the points are centres of the tip; without it they are on the surface.
    ``# point = surface, tip_diameter_mm = 6`` keeps the diameter that was compensated for.

    Raises
    ------
    FileFormatError
        If the file is not such a table, holds no point, or is in metres.
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

    Returns
    -------
    coefficients
        (4,) scaled so that the normal has length 1 and D is in mm (eq. 2.55).

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
    """Read probed points, or a plane's four numbers with or without the header ``A,B,C,D``.

    Returns
    -------
    points or coefficients
        As `read_probed_points` or `parse_plane` give them.

    Raises
    ------
    FileFormatError
        If the file is neither.
    """
    data = read_bytes(path)
    words = _plane_words(data)
    if words is None:
        return _probed(parse_csv(data, path_text(path)))
    try:
        return parse_plane(words, str(path))
    except OptionError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


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


def _tip(table: CsvTable) -> tuple[float, bool]:
    """Diameter that a comment gives, 0 for none; whether the points are on the surface."""
    stated: dict[str, str] = {}
    for comment in table.comments:
        stated |= {
            key: value.strip()
            for key, value in re.findall(r"(point|tip_diameter_mm)\s*=\s*([^,;]+)", comment)
        }
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
FRAME = "frame ="
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
    path
        The file.
    has_ids
        True if the list numbers its markers itself.
    is_sigma_assumed
        True if the list holds no covariance.
    is_simulated
        True if the list says that it was measured on rendered images.
    """

    markers: MarkerSet
    path: Path
    has_ids: bool
    is_sigma_assumed: bool
    is_simulated: bool = False


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
    return csv_bytes(columns, (f"{FRAME} {markers.frame}", *marks))


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

    A comment ``# frame = Base`` names the frame, ``# simulated`` marks rendered images. Tables of
    probed points are such lists; points are taken as they stand, centres of a tip included.

    Parameters
    ----------
    path
        The file.
    frame
        Frame of the markers where the list names none.
    sigma_mm
        Standard deviation an axis where the list gives no covariance.

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
    frames = [text[len(FRAME) :].strip() for text in table.comments if text.startswith(FRAME)]
    with told_of(table.where, remedy="correct the table, or measure again"):
        markers = MarkerSet(
            ids=ids,
            points_mm=points,
            covariance_mm2=_covariance(table, sigma_mm, has_covariance=has_covariance),
            frame=(*frames, frame)[0],
            source=path_text(path),
        )
    is_simulated = SIMULATED in (text.strip() for text in table.comments)
    return MarkerList(markers, path, "id" in table, not has_covariance, is_simulated)


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
    files = [file for path in paths for file in profile_files(Path(path))]
    names = source_names(files)
    return tuple(_read(file, name) for file, name in zip(files, names, strict=True))


def profile_files(path: Path) -> list[Path]:
    """Profiles of a file, a pattern or a folder, in natural order."""
    if not is_folder(path):
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
