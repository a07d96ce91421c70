# SPDX-License-Identifier: Apache-2.0
"""Reference pairs of least-squares features, as national institutes give them out.

``NAME.ds`` holds points, x y z a line; ``NAME.fit`` the parameters of the certified fit, a number a
line: a point and a direction (plane, line, and with the diameter behind them circle and cylinder),
centre and diameter of a sphere, of a cone a point on the axis, the direction towards the tip, the
distance of the point from the surface and the half angle in degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.features import Shape, ShapeKind, across
from armscan.storage.files import path_text, read_bytes

N_NUMBERS: dict[ShapeKind, int] = {
    "plane": 6,
    "line": 6,
    "circle": 7,
    "sphere": 4,
    "cylinder": 7,
    "cone": 8,
}


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePair:
    """Points (N, 3) and the certified shape through them."""

    points_mm: FloatArray
    shape: Shape


@dataclass(frozen=True, slots=True)
class ShapeError:
    """How far a fitted shape is from a certified one.

    Parameters
    ----------
    place_mm
        Of the certified point from the plane, line or axis; of centres from each other.
    direction_rad
        Between the directions; 0 for a sphere.
    size_mm
        Of diameters; of a cone its distance from the surface.
    angle_rad
        Of a cone's half angle; else 0.
    """

    place_mm: float
    direction_rad: float
    size_mm: float
    angle_rad: float


def read_reference_pair(path: Path, kind: ShapeKind) -> ReferencePair:
    """Read ``NAME.ds`` with the ``NAME.fit`` beside it; neither says of which kind it is.

    Raises
    ------
    FileFormatError
        If one is missing, or does not hold such numbers.
    """
    points = _numbers(path)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise FileFormatError(
            "the points are not three numbers a line", where=path_text(path), remedy="correct it"
        )
    beside = path.with_suffix(".fit")
    told = _numbers(beside).ravel()
    if len(told) != N_NUMBERS[kind] or not np.isfinite(told).all():
        raise FileFormatError(
            f"{len(told)} numbers where a {kind} has {N_NUMBERS[kind]}",
            where=path_text(beside),
            remedy="check of which kind the pair is",
        )
    return ReferencePair(points, _shape(kind, told))


def _numbers(path: Path) -> FloatArray:
    lines = read_bytes(path).decode("ascii", errors="replace").splitlines()
    rows = [line.replace(",", " ").split() for line in lines if line.strip()]
    try:
        return np.array([[float(word) for word in row] for row in rows], dtype=np.float64)
    except ValueError as error:
        raise FileFormatError(
            "these are not rows of numbers of one length",
            where=path_text(path),
            remedy="correct it, or copy it again",
        ) from error


def _shape(kind: ShapeKind, told: FloatArray) -> Shape:
    if kind == "sphere":
        return Shape(kind=kind, point_mm=told[:3], axes=np.eye(3), radius_mm=float(told[3]) / 2.0)
    axes = across(told[3:6])
    if kind == "cone":
        angle = float(np.radians(told[7]))
        return Shape(
            kind=kind,
            point_mm=told[:3],
            axes=axes * np.array([[1.0], [-1.0], [-1.0]]),
            radius_mm=float(told[6]) / float(np.cos(angle)),
            half_angle_rad=angle,
        )
    radius = float(told[6]) / 2.0 if len(told) == 7 else 0.0
    return Shape(kind=kind, point_mm=told[:3], axes=axes, radius_mm=radius)


def shape_error(found: Shape, certified: Shape) -> ShapeError:
    """Differences of a fitted shape from a certified one of its kind."""
    kind, offset = found.kind, certified.point_mm - found.point_mm
    along = float(offset @ found.direction)
    across_mm = float(np.linalg.norm(offset - along * found.direction))
    place = {"plane": abs(along), "sphere": _length(offset), "circle": _length(offset)}
    size = 2.0 * abs(found.radius_mm - certified.radius_mm)
    if kind == "cone":
        wide = found.radius_mm + along * float(np.tan(found.half_angle_rad))
        own = wide * float(np.cos(found.half_angle_rad))
        size = abs(own - certified.radius_mm * float(np.cos(certified.half_angle_rad)))
    return ShapeError(
        place.get(kind, across_mm),
        0.0 if kind == "sphere" else _length(np.cross(found.direction, certified.direction)),
        size,
        abs(found.half_angle_rad - certified.half_angle_rad),
    )


def _length(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))
