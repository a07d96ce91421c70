# SPDX-License-Identifier: Apache-2.0
"""Reference sets of least-squares features, right to 50 digits by their making.

Points are set off a shape along its normals by amounts that no small change of the shape's
parameters can lessen: the shape itself is then the least-squares shape of its points, whatever
their form error, and no fit is needed to know it. Distances are written here as in a textbook, from
global parameters, and differentiated numerically at 50 digits: nothing is shared with the fit.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.features import ShapeKind

DIGITS = 50
STEP = mp.mpf(10) ** -20
Vector = list[Any]


@dataclass(frozen=True)
class ReferenceSet:
    """``points_mm``: (N, 3). ``parameters``: of the shape as in a ``.fit`` file, in floats."""

    kind: ShapeKind
    points_mm: FloatArray
    parameters: tuple[float, ...]
    arc_deg: float
    digits: tuple[str, ...]

    def write(self, folder: Path, name: str) -> None:
        """The pair ``NAME.ds`` and ``NAME.fit``."""
        rows = (" ".join(repr(float(x)) for x in row) for row in self.points_mm)
        (folder / f"{name}.ds").write_text("\n".join(rows) + "\n")
        (folder / f"{name}.fit").write_text("\n".join(self.digits) + "\n")


def dot(a: Vector, b: Vector) -> Any:
    return mp.fsum(x * y for x, y in zip(a, b, strict=True))


def minus(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def unit(a: Vector) -> Vector:
    length = mp.sqrt(dot(a, a))
    return [x / length for x in a]


def cross(a: Vector, b: Vector) -> Vector:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def off_plane(p: Vector, q: Vector) -> Any:
    return dot(minus(p, q[:3]), unit(q[3:6]))


def off_sphere(p: Vector, q: Vector) -> Any:
    d = minus(p, q[:3])
    return mp.sqrt(dot(d, d)) - q[3] / 2


def off_cylinder(p: Vector, q: Vector) -> Any:
    d = cross(minus(p, q[:3]), unit(q[3:6]))
    return mp.sqrt(dot(d, d)) - q[6] / 2


def off_cone(p: Vector, q: Vector) -> Any:
    """Direction towards the tip, distance of the point to the surface, half angle in degrees."""
    d, axis = minus(p, q[:3]), unit(q[3:6])
    c, angle = cross(d, axis), q[7] * mp.pi / 180
    return mp.sqrt(dot(c, c)) * mp.cos(angle) + dot(d, axis) * mp.sin(angle) - q[6]


OFF: dict[str, Callable[[Vector, Vector], Any]] = {
    "plane": off_plane, "sphere": off_sphere, "cylinder": off_cylinder, "cone": off_cone,
}  # fmt: skip


def gradient(function: Callable[[Vector], Any], at: Vector) -> Vector:
    found = []
    for k in range(len(at)):
        ahead, behind = list(at), list(at)
        ahead[k] += STEP
        behind[k] -= STEP
        found.append((function(ahead) - function(behind)) / (2 * STEP))
    return found


def without(values: Vector, columns: list[Vector]) -> Vector:
    """Values less all that the columns span (Gram-Schmidt, twice; columns may depend)."""
    basis: list[Vector] = []
    for column in columns:
        left = column
        for _ in range(2):
            for one in basis:
                share = dot(left, one)
                left = [x - share * y for x, y in zip(left, one, strict=True)]
        if mp.sqrt(dot(left, left)) > mp.mpf(10) ** -15 * mp.sqrt(dot(column, column)):
            basis.append(unit(left))
    for _ in range(2):
        for one in basis:
            share = dot(values, one)
            values = [x - share * y for x, y in zip(values, one, strict=True)]
    return values


def reference_set(
    kind: ShapeKind, seed: int, *, arc_deg: float = 360.0, form_mm: float = 0.02, n: int = 40
) -> ReferenceSet:
    """Features of 1 to 500 mm, up to 1000 mm from the origin (as NIST's sets are)."""
    with mp.workdps(DIGITS):
        rng = random.Random(f"{kind} {seed}")

        def number(low: float, high: float) -> Any:
            return mp.mpf(rng.uniform(low, high))

        axis = unit([number(-1, 1) for _ in range(3)])
        first = unit(cross(axis, [mp.mpf(1), mp.mpf(2), mp.mpf(3)]))
        second = cross(axis, first)
        centre = [number(-570, 570) for _ in range(3)]
        radius = mp.mpf(10) ** number(0, 2.39)
        length = radius * number(0.5, 2.0)
        half_angle = number(5, 60)

        def place(u: Any, v: Any, w: Any) -> Vector:
            return [
                c + u * a + v * b + w * d
                for c, a, b, d in zip(centre, first, second, axis, strict=True)
            ]

        made = []
        for _ in range(n):
            turn = mp.radians(number(-arc_deg / 2, arc_deg / 2))
            u, v, w = mp.cos(turn), mp.sin(turn), number(-0.5, 0.5)
            if kind in ("plane", "line"):
                flat = kind == "plane"
                made.append(
                    (number(-1, 1) * radius, number(-1, 1) * length, mp.mpf(0))
                    if flat
                    else (mp.mpf(0), mp.mpf(0), w * length)
                )
            elif kind == "circle":
                made.append((radius * u, radius * v, mp.mpf(0)))
            elif kind == "sphere":
                tilt = mp.radians(number(-arc_deg / 4, arc_deg / 4))
                made.append(
                    (radius * u * mp.cos(tilt), radius * v * mp.cos(tilt), radius * mp.sin(tilt))
                )
            elif kind == "cylinder":
                made.append((radius * u, radius * v, w * length))
            else:
                height = w * min(length, radius / mp.tan(mp.radians(half_angle)))
                wide = radius - height * mp.tan(mp.radians(half_angle))
                made.append((wide * u, wide * v, height))
        exact = [place(*item) for item in made]
        # a small feature with a large form error has a second minimum, which may be the lower one
        form_mm = min(form_mm, float(radius) / 200.0)
        form = [number(-form_mm, form_mm) for _ in range(n)]
        if kind == "line":
            points, parameters = _off_line(exact, centre, axis, first, second, form, rng, form_mm)
        elif kind == "circle":
            points, parameters = _off_circle(exact, centre, axis, radius, form, rng, form_mm)
        else:
            sizes = {
                "plane": [], "sphere": [2 * radius], "cylinder": [2 * radius],
                "cone": [radius * mp.cos(mp.radians(half_angle)), half_angle],
            }[kind]  # fmt: skip
            parameters = [*centre, *([] if kind == "sphere" else axis), *sizes]
            points = _off_surface(OFF[kind], exact, parameters, form)
        return ReferenceSet(
            kind,
            np.array([[float(x) for x in point] for point in points]),
            tuple(float(x) for x in parameters),
            arc_deg,
            tuple(mp.nstr(x, 30) for x in parameters),
        )


def _off_surface(
    off: Callable[[Vector, Vector], Any], exact: list[Vector], parameters: Vector, form: Vector
) -> list[Vector]:
    rows = [gradient(lambda q, p=p: off(p, q), parameters) for p in exact]
    normals = [unit(gradient(lambda x: off(x, parameters), p)) for p in exact]
    # moved along its normal a point keeps its normal: first the amounts, then the rows once more
    for _ in range(12):
        columns = [[row[k] for row in rows] for k in range(len(parameters))]
        amounts = without(form, columns)
        points = [
            [x + amount * y for x, y in zip(p, normal, strict=True)]
            for p, normal, amount in zip(exact, normals, amounts, strict=True)
        ]
        rows = [gradient(lambda q, p=p: off(p, q), parameters) for p in points]
        left = max(abs(dot(amounts, [row[k] for row in rows])) for k in range(len(parameters)))
        if left < mp.mpf(10) ** -25:
            break
    return points


def _off_line(
    exact: list[Vector], centre: Vector, axis: Vector, first: Vector, second: Vector,
    form: Vector, rng: random.Random, form_mm: float,
) -> tuple[list[Vector], Vector]:  # fmt: skip
    """Both offsets without mean and without slope along the line."""
    along = [dot(minus(p, centre), axis) for p in exact]
    columns = [[mp.mpf(1)] * len(exact), along]
    u = without(form, columns)
    v = without([mp.mpf(rng.uniform(-form_mm, form_mm)) for _ in exact], columns)
    points = [
        [x + a * s + b * t for x, s, t in zip(p, first, second, strict=True)]
        for p, a, b in zip(exact, u, v, strict=True)
    ]
    return points, [*centre, *axis]


def _off_circle(
    exact: list[Vector], centre: Vector, axis: Vector, radius: Any,
    form: Vector, rng: random.Random, form_mm: float,
) -> tuple[list[Vector], Vector]:  # fmt: skip
    """In the plane as a circle's, out of it as a plane's; the plane holds the points' middle."""
    outward = [unit(minus(p, centre)) for p in exact]
    u = without(form, [[d[k] for d in outward] for k in range(3)] + [[mp.mpf(1)] * len(exact)])
    flat = [
        [x + a * y for x, y in zip(p, d, strict=True)]
        for p, d, a in zip(exact, outward, u, strict=True)
    ]
    columns = [[p[k] - centre[k] for p in flat] for k in range(3)] + [[mp.mpf(1)] * len(exact)]
    w = without([mp.mpf(rng.uniform(-form_mm, form_mm)) for _ in exact], columns)
    points = [
        [x + a * y for x, y in zip(p, axis, strict=True)] for p, a in zip(flat, w, strict=True)
    ]
    return points, [*centre, *axis, 2 * radius]
