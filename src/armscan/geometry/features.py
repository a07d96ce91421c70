# SPDX-License-Identifier: Apache-2.0
"""Geometric features through points by least squares of orthogonal distances (Gauss, ISO 14405).

Plane, line, circle, sphere, cylinder and cone are one `Shape` and one fit. A shape stands in axes
of its own; how far a point is off it, in which direction, and how its sizes change that, is all
that a kind has of itself. How a small motion of the shape changes a distance follows: with the unit
normal n of the surface at the point p, in the shape's axes, by ``-n`` for a shift and ``-(p x n)``
for a turn (Shakarji, J. Res. NIST 103 (1998) 633, by other parameters).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias, get_args

import numpy as np

from armscan.geometry.arrays import (
    ArrayRecord,
    FloatArray,
    IntArray,
    floats,
    frozen_floats,
    row_lengths,
)
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.least_squares import minimise
from armscan.geometry.rotations import rotation_from_vector

ShapeKind: TypeAlias = Literal["plane", "line", "circle", "sphere", "cylinder", "cone"]
SHAPE_KINDS: tuple[ShapeKind, ...] = get_args(ShapeKind)

MOTIONS = ("shift_1_mm", "shift_2_mm", "shift_3_mm", "turn_1_rad", "turn_2_rad", "turn_3_rad")
"""Small motions of a shape in its own axes."""
RADIUS, HALF_ANGLE = "radius_mm", "half_angle_rad"


class Shape(ArrayRecord):
    """A plane, line, circle, sphere, cylinder or cone.

    Parameters
    ----------
    point_mm
        (3,) a point of the plane, line or axis; the centre of a circle or sphere. After a fit it is
        the one nearest to the points' middle.
    axes
        (3, 3) rows: two directions across, and that of the line or axis, or the normal.
    radius_mm
        Of a circle, sphere or cylinder; of a cone at ``point_mm``, square to its axis; else 0.
    half_angle_rad
        Of a cone, from its axis to its surface; it opens along the third axis. Else 0.
    """

    kind: ShapeKind
    point_mm: FloatArray = floats(3)
    axes: FloatArray = floats(3, 3)
    radius_mm: float = 0.0
    half_angle_rad: float = 0.0

    @property
    def direction(self) -> FloatArray:
        """(3,) unit direction of the line or axis, or the normal."""
        return np.asarray(self.axes[2])

    @property
    def apex_mm(self) -> FloatArray:
        """(3,) tip of a cone."""
        back = self.radius_mm / float(np.tan(self.half_angle_rad))
        return np.asarray(self.point_mm - back * self.direction)

    def local_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N, 3) points in the shape's axes, from its point."""
        return np.asarray((points_mm - self.point_mm) @ self.axes.T)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of (N, 3) points: positive outside, of a plane along its normal.

        Of a line it has no sign, of a circle that of the distance in its plane.
        """
        local = self.local_mm(points_mm)
        if self.kind == "line":
            return np.asarray(np.hypot(local[:, 0], local[:, 1]))
        off = MODELS[self.kind].field(local, self)[0].off_mm
        if self.kind == "circle":
            return np.asarray(np.where(off < 0.0, -1.0, 1.0) * np.hypot(off, local[:, 2]))
        return off

    def outward(self, points_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of the surface nearest to points; not of a line."""
        normal = MODELS[self.kind].field(self.local_mm(points_mm), self)[0].normal
        return np.asarray(normal @ self.axes)

    def turned_to(self, direction: FloatArray) -> Shape:
        """The same with its direction to the side of ``direction`` (3,); a cone keeps its own."""
        if self.kind == "cone" or float(self.direction @ direction) >= 0.0:
            return self
        return Shape(
            kind=self.kind,
            point_mm=self.point_mm,
            axes=self.axes * np.array([[1.0], [-1.0], [-1.0]]),
            radius_mm=self.radius_mm,
            half_angle_rad=self.half_angle_rad,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """How points (N, 3) in a shape's axes lie to it along one direction each.

    Parameters
    ----------
    off_mm
        (N,) distances.
    normal
        (N, 3) unit direction along which each grows.
    by_size
        (N, K) derivative by the kind's sizes.
    """

    off_mm: FloatArray
    normal: FloatArray
    by_size: FloatArray


@dataclass(frozen=True, slots=True)
class _Model:
    """One kind: its free motions (indices into `MOTIONS`), its sizes, fewest points, distances."""

    motions: tuple[int, ...]
    sizes: tuple[str, ...]
    least: int
    field: Callable[[FloatArray, Shape], tuple[Field, ...]]


def _fixed(n: int, axis: int) -> FloatArray:
    return np.tile(np.eye(3)[axis], (n, 1))


def _flat(local: FloatArray, shape: Shape) -> tuple[Field, ...]:
    n = len(local)
    return (Field(local[:, 2], _fixed(n, 2), np.zeros((n, 0))),)


def _straight(local: FloatArray, shape: Shape) -> tuple[Field, ...]:
    """Two distances a point, along both directions across."""
    n = len(local)
    return tuple(Field(local[:, k], _fixed(n, k), np.zeros((n, 0))) for k in (0, 1))


def _round(local: FloatArray, shape: Shape, dimensions: int) -> tuple[Field, ...]:
    """About a point (3) or an axis (2)."""
    across = local.copy()
    across[:, dimensions:] = 0.0
    length = row_lengths(across)
    normal = across / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    return (Field(length - shape.radius_mm, normal, -np.ones((len(local), 1))),)


def _rim(local: FloatArray, shape: Shape) -> tuple[Field, ...]:
    """A circle in its plane, and its plane."""
    (flat,) = _flat(local, shape)
    return (*_round(local, shape, 2), Field(flat.off_mm, flat.normal, np.zeros((len(local), 1))))


def _conical(local: FloatArray, shape: Shape) -> tuple[Field, ...]:
    across = np.hypot(local[:, 0], local[:, 1])
    cosine, sine = np.cos(shape.half_angle_rad), np.sin(shape.half_angle_rad)
    wider = across - shape.radius_mm
    normal = local / np.maximum(across, np.finfo(np.float64).tiny)[:, None] * cosine
    normal[:, 2] = -sine
    by_angle = -wider * sine - local[:, 2] * cosine
    by_size = np.stack([np.full(len(local), -cosine), by_angle], axis=1)
    return (Field(wider * cosine - local[:, 2] * sine, normal, by_size),)


MODELS: dict[ShapeKind, _Model] = {
    "plane": _Model((2, 3, 4), (), 3, _flat),
    "line": _Model((0, 1, 3, 4), (), 2, _straight),
    # within the plane of its points, which is fitted first
    "circle": _Model((0, 1), (RADIUS,), 3, partial(_round, dimensions=2)),
    "sphere": _Model((0, 1, 2), (RADIUS,), 4, partial(_round, dimensions=3)),
    "cylinder": _Model((0, 1, 3, 4), (RADIUS,), 5, partial(_round, dimensions=2)),
    "cone": _Model((0, 1, 3, 4), (RADIUS, HALF_ANGLE), 6, _conical),
}


RIM = _Model((0, 1, 2, 3, 4), (RADIUS,), 3, _rim)
"""A circle with the plane that it is fitted in: how errors of points move both."""


def parameter_names(kind: ShapeKind, *, with_plane: bool = False) -> tuple[str, ...]:
    """Free parameters of a kind, of a circle also of its plane: motions in its own axes, then
    sizes.
    """
    model = RIM if with_plane and kind == "circle" else MODELS[kind]
    return (*(MOTIONS[k] for k in model.motions), *model.sizes)


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Distances of points to a shape, and how they follow from its parameters.

    Parameters
    ----------
    off_mm
        (R,) distances; of a line two a point.
    jacobian
        (R, P) their derivative by `parameter_names`.
    directions
        (R, 3) unit direction along which the point's error changes each.
    point
        (R,) index of the point of each.
    """

    off_mm: FloatArray
    jacobian: FloatArray
    directions: FloatArray
    point: IntArray


def linearise(shape: Shape, points_mm: FloatArray, *, with_plane: bool = False) -> Linearised:
    """Distances of points (N, 3) to a shape with their derivatives.

    ``with_plane``: of a circle also those to its plane, and by all motions of both.
    """
    model = RIM if with_plane and shape.kind == "circle" else MODELS[shape.kind]
    local = shape.local_mm(points_mm)
    fields = model.field(local, shape)
    rows = []
    for one in fields:
        motion = [_by_motion(local, one.normal, k) for k in model.motions]
        rows.append(np.column_stack([*motion, one.by_size]))
    normals = np.concatenate([one.normal for one in fields])
    return Linearised(
        np.concatenate([one.off_mm for one in fields]),
        np.concatenate(rows),
        normals @ shape.axes,
        np.tile(np.arange(len(local)), len(fields)),
    )


def _by_motion(local: FloatArray, normal: FloatArray, motion: int) -> FloatArray:
    """(N,) change of distances along normals (N, 3) at points (N, 3), by one of `MOTIONS`."""
    if motion < 3:
        return -normal[:, motion]
    j, k = (motion - 2) % 3, (motion - 1) % 3
    return np.asarray(local[:, k] * normal[:, j] - local[:, j] * normal[:, k])


def moved(shape: Shape, step: FloatArray, *, with_plane: bool = False) -> Shape:
    """The shape after a step (P,) of its `parameter_names`, of a circle also of its plane."""
    model = RIM if with_plane and shape.kind == "circle" else MODELS[shape.kind]
    motion = np.zeros(6)
    motion[list(model.motions)] = step[: len(model.motions)]
    sizes = dict(zip(model.sizes, step[len(model.motions) :].tolist(), strict=True))
    axes = rotation_from_vector(motion[3:]).T @ shape.axes
    return Shape(
        kind=shape.kind,
        point_mm=shape.point_mm + motion[:3] @ shape.axes,
        # rounding of many small turns is taken out at once
        axes=0.5 * (3.0 * np.eye(3) - axes @ axes.T) @ axes,
        radius_mm=shape.radius_mm + sizes.get(RADIUS, 0.0),
        half_angle_rad=shape.half_angle_rad + sizes.get(HALF_ANGLE, 0.0),
    )


SETTLED = 1e-15
LAST_STEPS = 60
"""Undamped steps after the search: they end where rounding does, which chi2 cannot tell."""
LEAST_RANK = 1e-10
"""Smallest eigenvalue of the scaled normal matrix, as a part of the largest, that is not zero."""
LARGEST_SIZE = 1e4
"""A radius this many times the points' extent is a plane or line."""
LARGEST_RADIUS_SIGMA = 0.5
"""A radius whose standard deviation is larger than this part of it is not determined."""
LEAST_ANGLE, MOST_ANGLE = 1e-4, 1.5
"""Half angles of a cone, rad: less is a cylinder, more a plane."""


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations in units that make the matrix's diagonal one."""

    matrix: FloatArray
    right: FloatArray
    scale: FloatArray

    @property
    def is_whole(self) -> bool:
        values = np.linalg.eigvalsh(self.matrix)
        return bool(values[0] > LEAST_RANK * values[-1])

    def step(self, damping: float) -> FloatArray:
        damped = self.matrix + damping * np.eye(len(self.matrix))
        return np.asarray(-np.linalg.lstsq(damped, self.right, rcond=1e-14)[0] * self.scale)

    def promised(self, step: FloatArray) -> float:
        s = step / self.scale
        return float(-2.0 * self.right @ s - s @ self.matrix @ s)


def _system(points: FloatArray, shape: Shape) -> tuple[float, _Normal] | None:
    extent = float(np.abs(points - shape.point_mm).max())
    if not 0.0 <= shape.radius_mm <= LARGEST_SIZE * extent:
        return None
    if shape.kind == "cone" and not LEAST_ANGLE < shape.half_angle_rad < MOST_ANGLE:
        return None
    found = linearise(shape, points)
    size = np.linalg.norm(found.jacobian, axis=0)
    scale = 1.0 / np.where(size > 0.0, size, 1.0)
    unit = found.jacobian * scale
    return float(found.off_mm @ found.off_mm), _Normal(unit.T @ unit, unit.T @ found.off_mm, scale)


def fit_shape(
    kind: ShapeKind, points_mm: FloatArray, start: Shape | None = None
) -> Estimate[Shape] | FitFailure:
    """Fit a shape to (N, 3) points: least sum of squared orthogonal distances.

    A circle is fitted within the least-squares plane of its points, as is usual in metrology.

    Covariance of `parameter_names`, the noise taken from the residuals (zero without redundancy);
    residuals (R,) in mm, two a point of a line; chi2 in units of that noise.

    Raises
    ------
    InputError
        If a value is not finite or a shape does not fit.
    """
    points = frozen_floats(points_mm, (None, 3), f"points of the {kind}")
    model = MODELS[kind]
    if len(points) < model.least:
        return FitFailure(
            f"a {kind} needs {model.least} points, got {len(points)}", "give more points"
        )
    middle = points.mean(axis=0)
    centred = points - middle
    starts: tuple[Shape, ...]
    if start is None or kind in ("plane", "line", "circle"):
        starts = starts_of(kind, centred)
    else:
        starts = (_about(start, -middle),)
    found = [one for each in starts if (one := _settled(centred, each)) is not None]
    if not found:
        return FitFailure(
            f"the points do not determine the {kind}: within their scatter they lie on a "
            "simpler shape",
            "give points on a larger part of it, apart from each other",
        )
    shape = min(found, key=lambda item: item[0])[1]
    return _estimate(centred, shape, middle)


def _about(shape: Shape, shift: FloatArray) -> Shape:
    return Shape(
        kind=shape.kind,
        point_mm=shape.point_mm + shift,
        axes=shape.axes,
        radius_mm=shape.radius_mm,
        half_angle_rad=shape.half_angle_rad,
    )


def _settled(points: FloatArray, start: Shape) -> tuple[float, Shape] | None:
    """Least chi2 from a start, and its shape; None where nothing is determined."""

    def propose(shape: Shape, system: _Normal, damping: float) -> tuple[Shape, float]:
        step = system.step(damping)
        return moved(shape, step), system.promised(step)

    found = minimise(centred_on(start, points), partial(_system, points), propose, settled=SETTLED)
    if found is None or not found.system.is_whole:
        return None
    return _polished(points, found.state, found.chi2)


def _polished(points: FloatArray, shape: Shape, chi2: float) -> tuple[float, Shape]:
    """Chi2 and the shape from which the next step is the shortest."""
    best, shortest, n_longer = (chi2, shape), np.inf, 0
    hessians: list[FloatArray] = []
    for _ in range(LAST_STEPS):
        shape = centred_on(shape, points)
        found = _system(points, shape)
        if found is None or not found[1].is_whole:
            break
        chi2, system = found
        step = system.step(0.0)
        size = float(np.abs(step / system.scale).max())
        if size < shortest:
            slow = size > SLOW * shortest
            best, shortest = (chi2, shape), size
        else:
            slow, n_longer = True, n_longer + 1
            if n_longer > MOST_LONGER or size <= np.finfo(np.float64).eps:
                break
        if slow:
            if len(hessians) < MOST_HESSIANS:
                hessians.append(_hessian(points, shape, system))
            step = -np.linalg.lstsq(hessians[-1], system.right, rcond=1e-14)[0] * system.scale
        shape = moved(shape, step)
    return best


MOST_LONGER = 4
SLOW = 0.1
"""A step that is not this much shorter than the one before is Newton's: residuals bend the sum."""
NEWTON_DIFFERENCE = 1e-5
"""Part of the step that changes a residual by 1, per root of points: the Hessian's differences."""


MOST_HESSIANS = 2
"""So near the end the second one holds for all further steps."""


def _hessian(points: FloatArray, shape: Shape, system: _Normal) -> FloatArray:
    """Second derivatives of chi2, in the system's units, by differences of its gradient."""
    n, width = len(system.right), NEWTON_DIFFERENCE * float(np.sqrt(len(points)))
    hessian = np.zeros((n, n))
    for k in range(n):
        by = np.eye(n)[k] * width * system.scale
        ahead, behind = linearise(moved(shape, by), points), linearise(moved(shape, -by), points)
        change = ahead.jacobian.T @ ahead.off_mm - behind.jacobian.T @ behind.off_mm
        hessian[:, k] = system.scale * change / (2.0 * width)
    return 0.5 * (hessian + hessian.T)


def centred_on(shape: Shape, points_mm: FloatArray) -> Shape:
    """The same shape, its point next to the middle of points (N, 3); of a round one as it is."""
    if shape.kind in ("circle", "sphere"):
        return shape
    offset = points_mm.mean(axis=0) - shape.point_mm
    along = float(offset @ shape.direction)
    shift = along * shape.direction if shape.kind != "plane" else offset - along * shape.direction
    radius = shape.radius_mm
    if shape.kind == "cone":
        radius += along * float(np.tan(shape.half_angle_rad))
        if radius < 0.0:
            # the points lie on the other half of the double cone: that one is meant
            flipped = shape.axes * np.array([[1.0], [-1.0], [-1.0]])
            return Shape(
                kind="cone",
                point_mm=shape.point_mm + shift,
                axes=flipped,
                radius_mm=-radius,
                half_angle_rad=shape.half_angle_rad,
            )
    return Shape(
        kind=shape.kind,
        point_mm=shape.point_mm + shift,
        axes=shape.axes,
        radius_mm=radius,
        half_angle_rad=shape.half_angle_rad,
    )


def _estimate(points: FloatArray, shape: Shape, middle: FloatArray) -> Estimate[Shape] | FitFailure:
    found = linearise(shape, points)
    names = parameter_names(shape.kind)
    freedom = len(found.off_mm) - len(names)
    squares = float(found.off_mm @ found.off_mm)
    variance = squares / freedom if freedom > 0 else 0.0
    _, values, axes = np.linalg.svd(found.jacobian, full_matrices=False)
    root = axes.T / values
    covariance = variance * root @ root.T
    if RADIUS in names:
        sigma = float(np.sqrt(covariance[names.index(RADIUS), names.index(RADIUS)]))
        if sigma > LARGEST_RADIUS_SIGMA * shape.radius_mm:
            return FitFailure(
                f"the points do not determine the {shape.kind}: its radius is "
                f"{shape.radius_mm:.3g} mm with a standard deviation of {sigma:.2g}",
                "give points on a larger part of it",
            )
    return Estimate(
        value=_about(shape, middle),
        parameter_names=names,
        covariance=covariance,
        residuals=found.off_mm,
        degrees_of_freedom=freedom,
        chi2=float(freedom) if variance > 0.0 else 0.0,
    )


N_DIRECTIONS = 200
"""Axes that are tried over half a ball: 10 degrees apart, within what a fit converges from."""
N_TRIED = 400
"""Points, evenly drawn, on which they are tried."""
N_STARTS = 6


def starts_of(kind: ShapeKind, points_mm: FloatArray) -> tuple[Shape, ...]:
    """Shapes from which a fit to points (N, 3) about their mean may begin, the best first."""
    spread = np.linalg.svd(points_mm, full_matrices=False)[2]
    main = np.stack([*spread[:2], np.cross(spread[0], spread[1])])
    if kind in ("plane", "line"):
        axes = main if kind == "plane" else main[[1, 2, 0]]
        return (Shape(kind=kind, point_mm=np.zeros(3), axes=axes),)
    if kind in ("circle", "sphere"):
        found = _algebraic(points_mm @ main.T, kind)
        return () if found is None else (_placed(kind, main, found),)
    step = max(1, len(points_mm) // N_TRIED)
    tried = points_mm[::step]
    scored = []
    for direction in (*main, *_half_ball()):
        axes = across(direction)
        found = _algebraic(tried @ axes.T, kind)
        if found is not None:
            shape = _placed(kind, axes, found)
            off = shape.distance_mm(tried)
            scored.append((float(off @ off), shape))
    scored.sort(key=lambda item: item[0])
    return tuple(shape for _, shape in scored[:N_STARTS])


def across(direction: FloatArray) -> FloatArray:
    """(3, 3) rows: two directions square to a direction (3,), and that at unit length."""
    third = direction / np.linalg.norm(direction)
    first = np.cross(third, np.eye(3)[int(np.argmin(np.abs(third)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def _half_ball() -> FloatArray:
    """(M, 3) directions evenly over half a ball (Fibonacci's spiral)."""
    k = np.arange(N_DIRECTIONS) + 0.5
    height, turn = k / N_DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k
    width = np.sqrt(1.0 - height**2)
    return np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)


def _placed(kind: ShapeKind, axes: FloatArray, found: tuple[FloatArray, float, float]) -> Shape:
    centre, radius, slope = found
    if slope < 0.0:
        axes, slope = axes * np.array([[1.0], [-1.0], [-1.0]]), -slope
        centre = centre * np.array([1.0, -1.0, -1.0])
    angle = float(np.clip(np.arctan(slope), 0.02, 1.4)) if kind == "cone" else 0.0
    return Shape(
        kind=kind, point_mm=centre @ axes, axes=axes, radius_mm=radius, half_angle_rad=angle
    )


def _algebraic(local: FloatArray, kind: ShapeKind) -> tuple[FloatArray, float, float] | None:
    """Centre (3,), radius and slope of ``|q - c|^2 = (r + t w)^2``, linear in what it holds."""
    size = float(np.abs(local).max())
    if size == 0.0:
        return None
    unit = local / size
    n = 3 if kind == "sphere" else 2
    columns = [2.0 * unit[:, k] for k in range(n)] + [np.ones(len(unit))]
    if kind == "cone":
        columns += [unit[:, 2], unit[:, 2] ** 2]
    right = (unit[:, :n] ** 2).sum(axis=1)
    solved = np.linalg.lstsq(np.stack(columns, axis=1), right, rcond=1e-12)[0]
    centre = np.zeros(3)
    centre[:n] = solved[:n]
    square = float(solved[n] + centre @ centre)
    if square <= 0.0:
        return None
    radius, slope = float(np.sqrt(square)), 0.0
    if kind == "cone":
        slope = float(solved[n + 1]) / (2.0 * radius)
    return centre * size, radius * size, slope
