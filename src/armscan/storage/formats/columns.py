# SPDX-License-Identifier: Apache-2.0
"""A cloud as named columns and notes, which is how every file of points holds it.

A format that keeps all columns and notes loses nothing; others keep those that they know.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError, InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.cloud import (
    FIELD_POWERS,
    CalibrationErrors,
    CalibrationMark,
    CloudFrame,
    PointCloud,
)
from armscan.storage.files import path_text, told_of
from armscan.storage.tables import refuse_beyond_reach

Column = NDArray[Any]

POINT = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COVARIANCE = {
    "cov_xx_mm2": (0, 0),
    "cov_xy_mm2": (0, 1),
    "cov_xz_mm2": (0, 2),
    "cov_yy_mm2": (1, 1),
    "cov_yz_mm2": (1, 2),
    "cov_zz_mm2": (2, 2),
}
INDICES = ("sheet", "exposure", "segment")
NOISE_LENGTH = "noise_length_points"
N_POINTS = "n_points"
"""Measured points that one of a fused cloud stands for."""
WHOLE = (*INDICES, N_POINTS)
"""Columns of whole numbers."""
SIMULATED = "simulated"
"""Note of a cloud that was measured on rendered images."""
FORCED = "forced"
"""Note with a reason for which the cloud's calibration was refused, and used all the same."""
CALIBRATION = "calibration"
"""Note of the calibration that points were measured with: its document's id and its time."""
SEEN_FROM = "seen_from_mm"
"""Note of where the sensor stood at an exposure."""
SENSOR_TURN = "sensor_turn_rad"
"""Note of how the sensor was turned at an exposure, as a rotation vector."""
SEEN_RANGE = "calibration_range"
"""Note of middle and half width of the directions of a sheet, of `CalibrationErrors`."""
ARM_ERROR = "arm_error_mm"
"""Note of what the arm errs alike at all postures of a scan."""
ERROR_MODES = "calibration_error_mm"
"""Note of a sheet's moves by the calibration's errors, of one product of powers: 3 K numbers."""
OWN_MARK = re.compile(rf"({FORCED}|{CALIBRATION}) \d+ [\[\"]")
"""How such notes begin; comments of other programs may begin with the word."""
FOREIGN_FRAME: CloudFrame = "Part"
"""Frame of points about which a file says nothing."""

TINY = float(np.finfo(np.float64).tiny)
DAMAGED = "copy the file again; it may be cut or damaged"
MOST_HEADER_BYTES = 512 * 2**20
"""Of a PLY or PCD file: three notes for each of two and a half million exposures."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudColumns:
    """What a file of points holds.

    Parameters
    ----------
    columns
        (N,) values of each column by its name, in the order of the file.
    notes
        Lines beside them: ``frame Sensor``, ``sheet 0 "A"``, ``exposure 0 "laser.png"``.
    sources
        Names of the exposures of a file that is not armscan's; empty for the file's own.
    passed_over
        Names of columns that the file has and that were not read.
    """

    columns: Mapping[str, Column]
    notes: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    passed_over: tuple[str, ...] = ()

    @property
    def is_own(self) -> bool:
        """Whether armscan wrote it, with all that a cloud carries."""
        return set(COVARIANCE) <= set(self.columns)


@dataclass(frozen=True, slots=True, eq=False)
class CloudPiece:
    """Points of a cloud that is written piece by piece.

    ``sigma_mm`` (N,) is that of the cloud, where it is known already; ``n_points`` (N,) are the
    measured points that each stands for, None if each is one.
    """

    cloud: PointCloud
    sigma_mm: FloatArray | None = None
    n_points: IntArray | None = None

    @staticmethod
    def joined(pieces: Sequence[CloudPiece]) -> CloudPiece:
        """One or more pieces as one; sigmas are those of the points."""
        counts = [piece.n_points for piece in pieces]
        known = [n for n in counts if n is not None]
        return CloudPiece(
            PointCloud.concat([piece.cloud for piece in pieces]),
            n_points=np.concatenate(known) if len(known) == len(counts) else None,
        )


def cloud_columns(piece: CloudPiece) -> CloudColumns:
    """All that a cloud carries."""
    return CloudColumns(point_columns(piece), cloud_notes(piece.cloud))


def point_columns(piece: CloudPiece) -> dict[str, Column]:
    """Columns of a cloud; ``sigma_mm`` is there for other programs and follows from the rest."""
    cloud = piece.cloud
    columns: dict[str, Column] = {name: cloud.points_mm[:, k] for k, name in enumerate(POINT)}
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, k] for k, name in enumerate(NORMAL)}
    columns["sigma_mm"] = cloud.sigma_mm if piece.sigma_mm is None else piece.sigma_mm
    columns["sigma_noise_mm"] = cloud.sigma_noise_mm
    if cloud.noise_length is not None:
        columns[NOISE_LENGTH] = cloud.noise_length
    columns |= {name: cloud.covariance_mm2[:, i, j] for name, (i, j) in COVARIANCE.items()}
    columns["intensity"] = cloud.intensity
    columns |= {name: getattr(cloud, name) for name in INDICES}
    if piece.n_points is not None:
        columns[N_POINTS] = piece.n_points
    return columns


def cloud_notes(cloud: PointCloud) -> tuple[str, ...]:
    """Frame, names and marks of a cloud, one a line."""
    notes = ["written by armscan", "unit mm", f"frame {cloud.frame}"]
    if cloud.is_simulated:
        notes.append(SIMULATED)
    for word, names in (
        ("sheet", cloud.sheet_names),
        ("exposure", cloud.exposure_sources),
        (FORCED, cloud.forced),
    ):
        notes += [f"{word} {k} {json.dumps(name)}" for k, name in enumerate(names)]
    notes += [
        f"{CALIBRATION} {k} {json.dumps([mark.document_id, mark.created_utc])}"
        for k, mark in enumerate(cloud.calibrations)
    ]
    if cloud.seen_from_mm is not None:
        places = cloud.seen_from_mm.tolist()
        notes += [f"{SEEN_FROM} {k} {json.dumps(place)}" for k, place in enumerate(places)]
    if cloud.calibration_errors is not None:
        notes += _error_notes(cloud.calibration_errors)
    return tuple(notes)


def _error_notes(errors: CalibrationErrors) -> list[str]:
    """Of what the calibration may err by; short lines, as some readers take no longer ones."""
    turns = np.round(Rotation.from_matrix(errors.turns).as_rotvec(), 9).tolist()
    notes = [f"{SENSOR_TURN} {k} {json.dumps(turn)}" for k, turn in enumerate(turns)]
    notes.append(f"{ARM_ERROR} 0 [{errors.arm_mm:.6g}]")
    for k, modes in enumerate(errors.modes_mm):
        seen = [*errors.middle[k].tolist(), *errors.half_width[k].tolist()]
        notes.append(f"{SEEN_RANGE} {k} {json.dumps(seen)}")
        for mode in modes.reshape(len(modes), -1):
            numbers = ", ".join(f"{value:.6g}" for value in mode)
            notes.append(f"{ERROR_MODES} {k} [{numbers}]")
    return notes


def header_bytes(lines: Sequence[str]) -> bytes:
    """Lines of a header that can be read again.

    Raises
    ------
    InputError
        If it is longer than `MOST_HEADER_BYTES`.
    """
    header = ("\n".join(lines) + "\n").encode("ascii")
    if len(header) > MOST_HEADER_BYTES:
        raise InputError(
            f"the names of the exposures fill {len(header):,} bytes of the header, more than "
            f"the {MOST_HEADER_BYTES:,} that are read",
            remedy="write the scan in parts",
        )
    return header


def dropped_columns(found: CloudColumns) -> tuple[str, ...]:
    """Columns that `cloud_of_columns` passes over, in the order of the file."""
    kept = {*POINT, "intensity"}
    if set(NORMAL) <= set(found.columns):
        kept |= set(NORMAL)
    if found.is_own:
        kept |= {"sigma_mm", "sigma_noise_mm", NOISE_LENGTH, *COVARIANCE, *INDICES}
    elif found.sources:
        kept.add("exposure")
    return tuple(name for name in (*found.columns, *found.passed_over) if name not in kept)


def structured(columns: Mapping[str, Column]) -> NDArray[Any]:
    """(N,) structured array of columns, float64 and int32."""
    kinds = [(name, "<i4" if name in WHOLE else "<f8") for name in columns]
    table = np.zeros(len(columns["x"]), dtype=kinds)
    for name, values in columns.items():
        table[name] = values
    return table


def columns_of(table: NDArray[Any]) -> dict[str, Column]:
    """Columns of a structured array."""
    return {name: table[name] for name in table.dtype.names or ()}


def cloud_of_columns(found: CloudColumns, path: Path) -> PointCloud:
    """The cloud of columns that armscan wrote, or of another program's x, y, z.

    Points of other programs come with covariances of zero, which stands for "not known". Their
    normals and intensities are kept.
    """
    where = path_text(path)
    if found.is_own:
        return own_cloud(found, where)
    if missing := sorted(set(POINT) - set(found.columns)):
        kind = path.suffix.lstrip(".").upper()
        raise FileFormatError(
            f"the {kind} file's points have no {missing[0]}",
            where=where,
            remedy="give a cloud with x, y and z in mm",
        )
    points = _joined(found.columns, POINT)
    refuse_beyond_reach(points, where)
    _refuse_gaps(points, where)
    n = len(points)
    zeros = np.zeros(n, dtype=np.int64)
    exposure = found.columns.get("exposure") if found.sources else None
    has_intensity = "intensity" in found.columns
    marks = [text for text in found.notes if OWN_MARK.match(text)]
    with told_of(where):
        return PointCloud(
            frame=_frame(found.notes) or FOREIGN_FRAME,
            points_mm=points,
            covariance_mm2=np.zeros((n, 3, 3)),
            sigma_noise_mm=np.zeros(n),
            sheet=zeros,
            sheet_names=("",),
            exposure=zeros if exposure is None else exposure,
            exposure_sources=found.sources or (path.name,),
            segment=zeros,
            intensity=_finite(found.columns["intensity"]) if has_intensity else np.zeros(n),
            normals=_unit(found.columns),
            is_simulated=SIMULATED in found.notes,
            forced=_names(marks, FORCED),
            calibrations=_calibrations(marks),
        )


def _refuse_gaps(points_mm: FloatArray, where: str) -> None:
    """Raise for points (N, 3) without a place."""
    rows = np.flatnonzero(np.isnan(points_mm).any(axis=1))
    if len(rows):
        raise FileFormatError(
            f"{len(rows)} of {len(points_mm)} points have an x, y or z that is empty or nan, the "
            f"first is point {int(rows[0]) + 1}",
            where=where,
            remedy="leave these points out, or write their values",
        )


def own_cloud(found: CloudColumns, where: str) -> PointCloud:
    """The cloud of columns that armscan wrote."""
    columns = found.columns
    needed = {*POINT, *COVARIANCE, *INDICES, "sigma_noise_mm", "intensity"}
    if missing := sorted(needed - set(columns)):
        raise FileFormatError(
            f"the file has no {missing[0]}, so it was not written by armscan",
            where=where,
            remedy="use the cloud that `armscan reconstruct` wrote",
        )
    covariance = np.zeros((len(columns["x"]), 3, 3))
    for name, (i, j) in COVARIANCE.items():
        covariance[:, i, j] = covariance[:, j, i] = columns[name]
    covariance.setflags(write=False)
    _refuse_impossible(covariance, where)
    points = _joined(columns, POINT)
    refuse_beyond_reach(points, where)
    _refuse_gaps(points, where)
    with told_of(where):
        named = _named(found.notes)
        return PointCloud(
            frame=named.frame,
            points_mm=points,
            covariance_mm2=covariance,
            sigma_noise_mm=columns["sigma_noise_mm"],
            sheet=columns["sheet"],
            sheet_names=named.sheets,
            exposure=columns["exposure"],
            exposure_sources=named.exposures,
            segment=columns["segment"],
            intensity=columns["intensity"],
            normals=_joined(columns, NORMAL) if set(NORMAL) <= set(columns) else None,
            noise_length=columns.get(NOISE_LENGTH),
            seen_from_mm=named.places_mm,
            calibration_errors=named.errors,
            is_simulated=named.is_simulated,
            forced=named.forced,
            calibrations=named.calibrations,
        )


INDEFINITE_TOLERANCE = 1e-6
"""How far a minor of a covariance may lie below 0 by rounding, in parts of its diagonal."""


def _refuse_impossible(covariance: FloatArray, where: str) -> None:
    """Raise if the (N, 3, 3) make the variance of some direction negative."""
    xx, yy, zz = (covariance[:, k, k] for k in range(3))
    xy, xz, yz = (covariance[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2)))
    least = -INDEFINITE_TOLERANCE
    is_possible = (xx >= 0.0) & (yy >= 0.0) & (zz >= 0.0)
    for one, other, both in ((xx, yy, xy), (xx, zz, xz), (yy, zz, yz)):
        is_possible &= one * other - both**2 >= least * one * other
    whole = xx * yy * zz + 2.0 * xy * xz * yz - xx * yz**2 - yy * xz**2 - zz * xy**2
    is_possible &= whole >= least * xx * yy * zz
    if not is_possible.all():
        raise FileFormatError(
            f"the six covariances of point {int(np.argmin(is_possible)) + 1} are none: they make "
            "some variance negative",
            where=where,
            remedy=DAMAGED,
        )


def needed_packages(kind: str, *names: str) -> Any:
    """The first of the packages, all of the extra ``formats``, that a kind of file needs.

    Raises
    ------
    OptionError
        If one of them is not installed.
    """
    try:
        packages = [import_module(name) for name in names]
    except ImportError as error:
        raise OptionError(
            f"{kind} files need packages that are not installed ({error.name})",
            remedy="pip install 'armscan[formats]'",
        ) from error
    return packages[0]


def _joined(columns: Mapping[str, Column], names: Sequence[str]) -> FloatArray:
    """(N, 3) of three columns, read-only so that a record takes it as it is."""
    joined = np.zeros((len(columns[names[0]]), len(names)))
    for k, name in enumerate(names):
        joined[:, k] = columns[name]
    joined.setflags(write=False)
    return joined


def _finite(values: Column) -> FloatArray:
    """Values of another program, zero where it had none."""
    return np.nan_to_num(np.asarray(values, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def _unit(columns: Mapping[str, Column]) -> FloatArray | None:
    """(N, 3) normals of another program at unit length, zero where it had none."""
    if not set(NORMAL) <= set(columns):
        return None
    normals = _finite(_joined(columns, NORMAL))
    # damaged numbers may be so large that their squares are none
    normals /= np.maximum(np.abs(normals).max(axis=1, initial=0.0, keepdims=True), TINY)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0.0, length, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Named:
    """Names and marks of a cloud, as its notes tell them; ``places_mm``: (E, 3) or None."""

    frame: CloudFrame
    sheets: tuple[str, ...]
    exposures: tuple[str, ...]
    places_mm: FloatArray | None
    errors: CalibrationErrors | None
    is_simulated: bool
    forced: tuple[str, ...]
    calibrations: tuple[CalibrationMark, ...]


@lru_cache(maxsize=1)
def _named(notes: tuple[str, ...]) -> _Named:
    """Kept for the next piece of the same file: a long scan has a million notes.

    Raises
    ------
    InputError
        If they name no frame, or are damaged.
    """
    frame = _frame(notes)
    if frame is None:
        raise InputError("the header does not name the frame of the points")
    places = _places(notes)
    if places is not None:
        places.setflags(write=False)
    sheets, exposures, forced = (_names(notes, word) for word in ("sheet", "exposure", FORCED))
    simulated = SIMULATED in notes
    errors = None if places is None else _errors(notes, len(sheets))
    marks = _calibrations(notes)
    return _Named(frame, sheets, exposures, places, errors, simulated, forced, marks)


def _frame(notes: Sequence[str]) -> CloudFrame | None:
    found = [text[6:] for text in notes if text.startswith("frame ")]
    if len(found) != 1 or found[0] not in get_args(CloudFrame):
        return None
    return cast(CloudFrame, found[0])


def _places(notes: Sequence[str]) -> FloatArray | None:
    """(E, 3) where the sensor stood, if the notes say so of every exposure."""
    found = _numbers(notes, SEEN_FROM, "places of the sensor")
    return found if len(found) else None


def _errors(notes: Sequence[str], n_sheets: int) -> CalibrationErrors | None:
    """What the calibration may err by, if the notes say so."""
    what = "errors of the calibration"
    turns = _numbers(notes, SENSOR_TURN, "turns of the sensor")
    if not len(turns):
        return None
    words = (SEEN_RANGE, ERROR_MODES, ARM_ERROR)
    seen, modes, arm = (_numbers(notes, word, what) for word in words)
    terms = len(FIELD_POWERS)
    is_whole = turns.shape[1:] == (3,) and seen.shape == (n_sheets, 4) and arm.shape == (1, 1)
    is_whole &= modes.ndim == 2 and len(modes) == n_sheets * terms
    if not is_whole or modes.shape[1] % 3:
        raise InputError(f"the header's {what} ({SENSOR_TURN}, {ERROR_MODES}) are damaged")
    return CalibrationErrors(
        turns=Rotation.from_rotvec(turns).as_matrix(),
        middle=seen[:, :2],
        half_width=seen[:, 2:],
        modes_mm=modes.reshape(n_sheets, terms, 3, modes.shape[1] // 3),
        arm_mm=float(arm[0, 0]),
    )


def _numbers(notes: Sequence[str], word: str, what: str) -> FloatArray:
    """(M, K) numbers of the notes of a word, in their order."""
    texts = [text.split(" ", 2)[2] for text in notes if text.startswith(f"{word} ")]
    try:
        return np.array([json.loads(text) for text in texts], dtype=np.float64)
    except (IndexError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"the header's {what} ({word}) are damaged") from error


def _calibrations(notes: Sequence[str]) -> tuple[CalibrationMark, ...]:
    found = []
    for text in notes:
        if text.startswith(f"{CALIBRATION} "):
            try:
                document_id, created_utc = json.loads(text.split(" ", 2)[2])
            except (IndexError, TypeError, ValueError, RecursionError) as error:
                raise InputError(f"the header's comment {text!r} is damaged") from error
            found.append(CalibrationMark(str(document_id), str(created_utc)))
    return tuple(found)


def _names(notes: Sequence[str], word: str) -> tuple[str, ...]:
    names = []
    for text in notes:
        if text.startswith(f"{word} "):
            try:
                names.append(str(json.loads(text.split(" ", 2)[2])))
            except (IndexError, ValueError, RecursionError) as error:
                raise InputError(f"the header's comment {text!r} is damaged") from error
    return tuple(names)
