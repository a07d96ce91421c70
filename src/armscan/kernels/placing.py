# SPDX-License-Identifier: Apache-2.0
"""Points on light sheets with their covariance: spread by errors in Sensor, carried to Base."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import FUSED, Floats, FloatsOut, Ints, Table, TableOut, compiled
from armscan.kernels.rays import (
    NEAREST_SOURCE,
    bow_and_slopes,
    lens_slopes,
    radial_base,
)

LANES = 64
"""Points done together: their numbers stay in the nearest cache."""
N_CAMERA, N_SHEET = 9, 8
"""Parameters of a camera and of a sheet."""
(
    POINT_X, POINT_Y, POINT_Z, RAY_X, RAY_Y, DISTORTED_X, DISTORTED_Y, SQUARE,
    BASE, BASE_SQUARE, BY_XX, BY_XY, BY_YY, DEPTH_X, DEPTH_Y,
) = range(15)  # fmt: skip
"""Rows of what is known of each point before its covariance: its place in Sensor, its ray, that ray
distorted, the square of its radius, what `radial_base` gives of it, the derivative of the lens's
inverse with its sign turned, and that of the depth by the ray. The sheet's derivatives and the sums
follow."""
OF_SHEET, SUMS = 15, 23
N_ROWS = 29


@compiled(error_model="numpy", fastmath=FUSED)
def spread_stripe(
    points: Floats,
    normals: Floats,
    sigma: Floats,
    camera: Floats,
    sheet: Floats,
    size_mm: float,
    noise: FloatsOut,
    shape: FloatsOut,
) -> None:
    """Moves of points of one sheet by one sigma of their stripe, and of the sheet's own shape.

    ``points``: (3 N,) in Sensor. ``normals``, ``sigma``: (2 N,) and (N,) of each stripe, px.
    ``camera``, ``sheet``: As for `meet_sheets`. ``size_mm``: Sigma of the sheet's shape.
    ``noise``, ``shape``: (3 N,) output.
    """
    # a constant leaves a loop without a branch, which is vectorised
    if camera[10] == 0.0:
        _spread_behind(points, normals, sigma, camera, sheet, size_mm, noise, shape, False)
    else:
        _spread_behind(points, normals, sigma, camera, sheet, size_mm, noise, shape, True)


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _spread_behind(
    points: Floats,
    normals: Floats,
    sigma: Floats,
    camera: Floats,
    sheet: Floats,
    size_mm: float,
    noise: FloatsOut,
    shape: FloatsOut,
    is_fisheye: bool,
) -> None:
    lens = camera.copy()
    bow = sheet.copy()
    scale = 1.0 / bow[12]
    ux, uy, uz = bow[3] * scale, bow[4] * scale, bow[5] * scale
    vx, vy, vz = bow[6] * scale, bow[7] * scale, bow[8] * scale
    fx, fy = 1.0 / lens[0], 1.0 / lens[1]
    for i in range(sigma.shape[0]):
        depth = points[3 * i + 2]
        x = points[3 * i] / depth
        y = points[3 * i + 1] / depth
        dx = points[3 * i] - bow[0]
        dy = points[3 * i + 1] - bow[1]
        dz = depth - bow[2]
        _, slope_u, slope_v = bow_and_slopes(
            dx * ux + dy * uy + dz * uz, dx * vx + dy * vy + dz * vz, bow
        )
        gradient_x = bow[9] - slope_u * ux - slope_v * vx
        gradient_y = bow[10] - slope_u * uy - slope_v * vy
        gradient_z = bow[11] - slope_u * uz - slope_v * vz
        per_mm = 1.0 / (x * gradient_x + y * gradient_y + gradient_z)
        xx, xy, yy, _ = lens_slopes(x, y, lens, is_fisheye)
        det = 1.0 / (xx * yy - xy * xy)
        across_x = normals[2 * i] * sigma[i] * fx
        across_y = normals[2 * i + 1] * sigma[i] * fy
        ray_x = (yy * across_x - xy * across_y) * det
        ray_y = (xx * across_y - xy * across_x) * det
        away = -(gradient_x * ray_x + gradient_y * ray_y) * depth * per_mm
        noise[3 * i] = x * away + depth * ray_x
        noise[3 * i + 1] = y * away + depth * ray_y
        noise[3 * i + 2] = away
        shape[3 * i] = x * size_mm * per_mm
        shape[3 * i + 1] = y * size_mm * per_mm
        shape[3 * i + 2] = size_mm * per_mm


@compiled(error_model="numpy", fastmath=FUSED)
def _know_points(points: Floats, camera: Floats, sheet: Floats, rows: FloatsOut) -> None:
    """What the covariance of a few points depends on, into rows of `LANES` numbers each."""
    if camera[10] == 0.0:
        _know_behind(points, camera, sheet, rows, False)
    else:
        _know_behind(points, camera, sheet, rows, True)


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _know_behind(
    points: Floats, camera: Floats, sheet: Floats, rows: FloatsOut, is_fisheye: bool
) -> None:
    lens = camera.copy()
    bow = sheet.copy()
    scale = 1.0 / bow[12]
    ux, uy, uz = bow[3] * scale, bow[4] * scale, bow[5] * scale
    vx, vy, vz = bow[6] * scale, bow[7] * scale, bow[8] * scale
    p1, p2 = lens[6], lens[7]
    lean = bow[18]
    middle = math.sqrt(1.0 + lean * lean)
    for i in range(points.shape[0] // 3):
        depth = points[3 * i + 2]
        x = points[3 * i] / depth
        y = points[3 * i + 1] / depth
        dx = points[3 * i] - bow[0]
        dy = points[3 * i + 1] - bow[1]
        dz = depth - bow[2]
        u = dx * ux + dy * uy + dz * uz
        v = dx * vx + dy * vy + dz * vz
        _, slope_u, slope_v = bow_and_slopes(u, v, bow)
        gradient_x = bow[9] - slope_u * ux - slope_v * vx
        gradient_y = bow[10] - slope_u * uy - slope_v * vy
        gradient_z = bow[11] - slope_u * uz - slope_v * vz
        per_mm = 1.0 / (x * gradient_x + y * gradient_y + gradient_z)
        xx, xy, yy, radial = lens_slopes(x, y, lens, is_fisheye)
        det = -1.0 / (xx * yy - xy * xy)
        r2 = x * x + y * y
        rows[POINT_X * LANES + i] = points[3 * i]
        rows[POINT_Y * LANES + i] = points[3 * i + 1]
        rows[POINT_Z * LANES + i] = depth
        rows[RAY_X * LANES + i] = x
        rows[RAY_Y * LANES + i] = y
        rows[DISTORTED_X * LANES + i] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        rows[DISTORTED_Y * LANES + i] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        rows[SQUARE * LANES + i] = r2
        scale, q = radial_base(r2, is_fisheye)
        rows[BASE * LANES + i] = scale
        rows[BASE_SQUARE * LANES + i] = q
        rows[BY_XX * LANES + i] = yy * det
        rows[BY_XY * LANES + i] = -xy * det
        rows[BY_YY * LANES + i] = xx * det
        rows[DEPTH_X * LANES + i] = -gradient_x * depth * per_mm
        rows[DEPTH_Y * LANES + i] = -gradient_y * depth * per_mm
        # the terms of the bow, as `height_of` has them
        w = 1.0 + bow[19] * v
        w = w if w > NEAREST_SOURCE else NEAREST_SOURCE
        u0 = (u - lean * v) / w
        ray = lean + bow[19] * u0
        root = math.sqrt(1.0 + ray * ray)
        square = 2.0 * (middle * middle) * u0 * u0 / (1.0 + middle * root + lean * ray)
        rows[OF_SHEET * LANES + i] = u * per_mm
        rows[(OF_SHEET + 1) * LANES + i] = v * per_mm
        rows[(OF_SHEET + 2) * LANES + i] = per_mm
        rows[(OF_SHEET + 3) * LANES + i] = w * square * per_mm
        rows[(OF_SHEET + 4) * LANES + i] = u * v * per_mm
        rows[(OF_SHEET + 5) * LANES + i] = v * v * per_mm
        rows[(OF_SHEET + 6) * LANES + i] = w * (u0 * u0 * u0) * per_mm
        rows[(OF_SHEET + 7) * LANES + i] = u * u * v * per_mm


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _along_ray(
    i: int,
    s0: float,
    s1: float,
    s2: float,
    s3: float,
    s4: float,
    s5: float,
    s6: float,
    s7: float,
    rows: Floats,
) -> float:
    """Change of depth of point ``i`` by errors of the sheet's parameters."""
    away: float = rows[OF_SHEET * LANES + i] * s0 + rows[(OF_SHEET + 1) * LANES + i] * s1
    away += rows[(OF_SHEET + 2) * LANES + i] * s2 + rows[(OF_SHEET + 3) * LANES + i] * s3
    away += rows[(OF_SHEET + 4) * LANES + i] * s4 + rows[(OF_SHEET + 5) * LANES + i] * s5
    away += rows[(OF_SHEET + 6) * LANES + i] * s6 + rows[(OF_SHEET + 7) * LANES + i] * s7
    return away


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def add_square(x: float, y: float, z: float, i: int, rows: FloatsOut) -> None:
    """Add a move's products to the sums of point ``i``."""
    rows[SUMS * LANES + i] += x * x
    rows[(SUMS + 1) * LANES + i] += x * y
    rows[(SUMS + 2) * LANES + i] += x * z
    rows[(SUMS + 3) * LANES + i] += y * y
    rows[(SUMS + 4) * LANES + i] += y * z
    rows[(SUMS + 5) * LANES + i] += z * z


@compiled(error_model="numpy", fastmath=FUSED)
def _spread_points(camera: Floats, factor: Table, rows: FloatsOut) -> None:
    """Covariance in Sensor of a few points, by errors of sensor and hand-eye, into their sums.

    ``factor``: (K, 23), one error a row: its move of camera, sheet, hand-eye.
    """
    fx, fy = 1.0 / camera[0], 1.0 / camera[1]
    own = np.zeros(N_CAMERA + N_SHEET + 6)
    for k in range(factor.shape[0]):
        for c in range(own.shape[0]):
            own[c] = factor[k, c]
        f0, f1, f2, f3 = own[0] * fx, own[1] * fy, own[2] * fx, own[3] * fy
        f4, f5, f6, f7, f8 = own[4], own[5], own[6], own[7], own[8]
        s0, s1, s2, s3 = own[9], own[10], own[11], own[12]
        s4, s5, s6, s7 = own[13], own[14], own[15], own[16]
        h0, h1, h2, h3, h4, h5 = own[17], own[18], own[19], own[20], own[21], own[22]
        if k < N_CAMERA:
            for i in range(LANES):
                x = rows[RAY_X * LANES + i]
                y = rows[RAY_Y * LANES + i]
                px = rows[POINT_X * LANES + i]
                py = rows[POINT_Y * LANES + i]
                pz = rows[POINT_Z * LANES + i]
                r2 = rows[SQUARE * LANES + i]
                q = rows[BASE_SQUARE * LANES + i]
                radial = rows[BASE * LANES + i] * q * (f4 + q * (f5 + q * f8))
                u = rows[DISTORTED_X * LANES + i] * f0 + f2 + x * radial
                v = rows[DISTORTED_Y * LANES + i] * f1 + f3 + y * radial
                u += 2.0 * x * y * f6 + (r2 + 2.0 * x * x) * f7
                v += 2.0 * x * y * f7 + (r2 + 2.0 * y * y) * f6
                ray_x = rows[BY_XX * LANES + i] * u + rows[BY_XY * LANES + i] * v
                ray_y = rows[BY_XY * LANES + i] * u + rows[BY_YY * LANES + i] * v
                away = rows[DEPTH_X * LANES + i] * ray_x + rows[DEPTH_Y * LANES + i] * ray_y
                away += _along_ray(i, s0, s1, s2, s3, s4, s5, s6, s7, rows)
                add_square(
                    x * away + pz * ray_x + h1 * pz - h2 * py + h3,
                    y * away + pz * ray_y + h2 * px - h0 * pz + h4,
                    away + h0 * py - h1 * px + h5,
                    i,
                    rows,
                )
        elif k < N_CAMERA + N_SHEET:
            for i in range(LANES):
                px = rows[POINT_X * LANES + i]
                py = rows[POINT_Y * LANES + i]
                pz = rows[POINT_Z * LANES + i]
                away = _along_ray(i, s0, s1, s2, s3, s4, s5, s6, s7, rows)
                add_square(
                    rows[RAY_X * LANES + i] * away + h1 * pz - h2 * py + h3,
                    rows[RAY_Y * LANES + i] * away + h2 * px - h0 * pz + h4,
                    away + h0 * py - h1 * px + h5,
                    i,
                    rows,
                )
        else:
            for i in range(LANES):
                px = rows[POINT_X * LANES + i]
                py = rows[POINT_Y * LANES + i]
                pz = rows[POINT_Z * LANES + i]
                add_square(
                    h1 * pz - h2 * py + h3,
                    h2 * px - h0 * pz + h4,
                    h0 * py - h1 * px + h5,
                    i,
                    rows,
                )


@compiled(error_model="numpy", fastmath=FUSED)
def turn_sums(carried: Floats, rows: Floats, turned: FloatsOut) -> None:
    """Turn points and their sums to Base, and add what the arm errs.

    ``carried``: (21,) as for `carry_stripe`. ``turned``: (9 LANES,) output, places then sums.
    """
    r0, r1, r2, tx = carried[0], carried[1], carried[2], carried[3]
    r3, r4, r5, ty = carried[4], carried[5], carried[6], carried[7]
    r6, r7, r8, tz = carried[8], carried[9], carried[10], carried[11]
    v0, v1, v2 = carried[12], carried[13], carried[14]
    ax, ay, az = carried[15], carried[16], carried[17]
    bx, by, bz = carried[18], carried[19], carried[20]
    for i in range(LANES):
        px = rows[POINT_X * LANES + i]
        py = rows[POINT_Y * LANES + i]
        pz = rows[POINT_Z * LANES + i]
        xx = rows[SUMS * LANES + i]
        xy = rows[(SUMS + 1) * LANES + i]
        xz = rows[(SUMS + 2) * LANES + i]
        yy = rows[(SUMS + 3) * LANES + i]
        yz = rows[(SUMS + 4) * LANES + i]
        zz = rows[(SUMS + 5) * LANES + i]
        x = r0 * px + r1 * py + r2 * pz + tx
        y = r3 * px + r4 * py + r5 * pz + ty
        z = r6 * px + r7 * py + r8 * pz + tz
        turned[i] = x
        turned[LANES + i] = y
        turned[2 * LANES + i] = z
        # rows of the turn times the covariance
        a0 = r0 * xx + r1 * xy + r2 * xz
        a1 = r0 * xy + r1 * yy + r2 * yz
        a2 = r0 * xz + r1 * yz + r2 * zz
        b0 = r3 * xx + r4 * xy + r5 * xz
        b1 = r3 * xy + r4 * yy + r5 * yz
        b2 = r3 * xz + r4 * yz + r5 * zz
        c0 = r6 * xx + r7 * xy + r8 * xz
        c1 = r6 * xy + r7 * yy + r8 * yz
        c2 = r6 * xz + r7 * yz + r8 * zz
        sx, sy, sz = x - ax, y - ay, z - az
        wx, wy, wz = x - bx, y - by, z - bz
        all_of = v0 + v1 * (sx * sx + sy * sy + sz * sz) + v2 * (wx * wx + wy * wy + wz * wz)
        turned[3 * LANES + i] = a0 * r0 + a1 * r1 + a2 * r2 + all_of - v1 * sx * sx - v2 * wx * wx
        turned[4 * LANES + i] = a0 * r3 + a1 * r4 + a2 * r5 - v1 * sx * sy - v2 * wx * wy
        turned[5 * LANES + i] = a0 * r6 + a1 * r7 + a2 * r8 - v1 * sx * sz - v2 * wx * wz
        turned[6 * LANES + i] = b0 * r3 + b1 * r4 + b2 * r5 + all_of - v1 * sy * sy - v2 * wy * wy
        turned[7 * LANES + i] = b0 * r6 + b1 * r7 + b2 * r8 - v1 * sy * sz - v2 * wy * wz
        turned[8 * LANES + i] = c0 * r6 + c1 * r7 + c2 * r8 + all_of - v1 * sz * sz - v2 * wz * wz


@compiled(is_inlined=True)
def write_turned(
    turned: Floats, i: int, row: int, placed: FloatsOut, covariance: FloatsOut
) -> None:
    """Write what `turn_sums` made of point ``i`` as that of a row: (3 N,) and (9 N,) output."""
    for a in range(3):
        placed[3 * row + a] = turned[a * LANES + i]
    at = 9 * row
    covariance[at] = turned[3 * LANES + i]
    covariance[at + 1] = covariance[at + 3] = turned[4 * LANES + i]
    covariance[at + 2] = covariance[at + 6] = turned[5 * LANES + i]
    covariance[at + 4] = turned[6 * LANES + i]
    covariance[at + 5] = covariance[at + 7] = turned[7 * LANES + i]
    covariance[at + 8] = turned[8 * LANES + i]


@compiled(error_model="numpy", fastmath=FUSED)
def _begin_sums(noise: Floats, shape: Floats, rows: FloatsOut) -> None:
    """Products of the own noise and of the sheet's shape, (3 N,) each, into the sums."""
    for i in range(noise.shape[0] // 3):
        x, y, z = noise[3 * i], noise[3 * i + 1], noise[3 * i + 2]
        sx, sy, sz = shape[3 * i], shape[3 * i + 1], shape[3 * i + 2]
        rows[SUMS * LANES + i] = x * x + sx * sx
        rows[(SUMS + 1) * LANES + i] = x * y + sx * sy
        rows[(SUMS + 2) * LANES + i] = x * z + sx * sz
        rows[(SUMS + 3) * LANES + i] = y * y + sy * sy
        rows[(SUMS + 4) * LANES + i] = y * z + sy * sz
        rows[(SUMS + 5) * LANES + i] = z * z + sz * sz


@compiled()
def carry_stripe(
    points: Floats,
    noise: Floats,
    shape: Floats,
    camera: Floats,
    sheet: Floats,
    factor: Table,
    carried: Floats,
    placed: FloatsOut,
    covariance: FloatsOut,
) -> None:
    """Points of one camera on one sheet in Base, with all of their covariance, in one pass.

    The errors of sensor and hand-eye are carried as factors in Sensor, own noise is added, and the
    sum is turned to Base, where the arm's is added. Derivatives by the sensor are made on the way.

    ``points``, ``noise``, ``shape``: (3 N,) in Sensor, from `spread_stripe`. ``camera``, ``sheet``:
    As for `meet_sheets`. ``factor``: (K, 23), one independent error a row, that of camera, sheet,
    and the hand-eye's turn and shift in Sensor; in row k nothing before column k. ``carried``:
    (21,) rows of rotation and shift from Sensor to Base; variances of the arm's shift and of its
    turns about two points; these points in Base. ``placed``: (3 N,) output. ``covariance``: (9 N,)
    output.
    """
    rows = np.zeros(N_ROWS * LANES)
    turned = np.zeros(9 * LANES)
    total = points.shape[0] // 3
    for first in range(0, total, LANES):
        n = min(LANES, total - first)
        begin, end = 3 * first, 3 * (first + n)
        _know_points(points[begin:end], camera, sheet, rows)
        _begin_sums(noise[begin:end], shape[begin:end], rows)
        _spread_points(camera, factor, rows)
        turn_sums(carried, rows, turned)
        for i in range(n):
            write_turned(turned, i, first + i, placed, covariance)


@compiled(fastmath=True)
def spread_by_factor(point: Floats, by_sensor: Floats, factor: Table, moved: TableOut) -> None:
    """Errors (3, K) of one point in Sensor by those of sensor and hand-eye.

    ``point``: (3,). ``by_sensor``: (3 Q,) derivatives. ``factor``: (Q + 6, K): of the sensor, then
    of the hand-eye's turn and shift in Sensor.
    """
    q = by_sensor.shape[0] // 3
    width = factor.shape[1]
    first, second, third = moved[0], moved[1], moved[2]
    x, y, z = point[0], point[1], point[2]
    about_x, about_y, about_z = factor[q], factor[q + 1], factor[q + 2]
    shift_x, shift_y, shift_z = factor[q + 3], factor[q + 4], factor[q + 5]
    for k in range(width):
        first[k] = about_y[k] * z - about_z[k] * y + shift_x[k]
        second[k] = about_z[k] * x - about_x[k] * z + shift_y[k]
        third[k] = about_x[k] * y - about_y[k] * x + shift_z[k]
    for c in range(q):
        x, y, z = by_sensor[c], by_sensor[q + c], by_sensor[2 * q + c]
        # what one camera alone saw does not depend on the other
        if x == 0.0 and y == 0.0 and z == 0.0:
            continue
        row = factor[c]
        for k in range(min(c + 1, width)):
            first[k] += x * row[k]
            second[k] += y * row[k]
            third[k] += z * row[k]


@compiled(fastmath=True)
def sum_products(moved: Table, products: FloatsOut) -> None:
    """Add the products of rows (3, K) with each other: 00 01 02 11 12 22."""
    first, second, third = moved[0], moved[1], moved[2]
    xx = xy = xz = yy = yz = zz = 0.0
    for k in range(first.shape[0]):
        xx += first[k] * first[k]
        xy += first[k] * second[k]
        xz += first[k] * third[k]
        yy += second[k] * second[k]
        yz += second[k] * third[k]
        zz += third[k] * third[k]
    products[0] += xx
    products[1] += xy
    products[2] += xz
    products[3] += yy
    products[4] += yz
    products[5] += zz


@compiled()
def propagate_points(
    points: Table,
    own: Table,
    shape: Table,
    by_sensor: Table,
    factor: Table,
    base_from_sensor: Table,
    arm: Table,
    rows: Ints,
    placed: TableOut,
    covariance: TableOut,
) -> None:
    """Points of one sheet in Base, with all of their covariance, in one pass.

    The errors of sensor and hand-eye are carried as factors in Sensor, own noise is added, and the
    sum is turned to Base, where the arm's is added.

    ``points``, ``shape``: (N, 3) in Sensor, and their move by one sigma of the sheet's own shape.
    ``own``: (N, 3 J) of each independent noise, by coordinate. ``by_sensor``: (N, 3 Q).
    ``factor``: As for `spread_by_factor`. ``base_from_sensor``: (3, 4) turn and shift. ``arm``:
    (3, 3) variances of its shift and turns, and the two points in Base about which it turns.
    ``rows``: (M,) of the points. ``placed``: (N, 3), ``covariance``: (N, 9) output.
    """
    moved = np.zeros((3, factor.shape[1]))
    sums = np.zeros(6)
    inner = np.zeros((3, 3))
    half = np.zeros((3, 3))
    n_own = own.shape[1] // 3
    turn = base_from_sensor
    for i in rows:
        spread_by_factor(points[i], by_sensor[i], factor, moved)
        for k in range(6):
            sums[k] = 0.0
        sum_products(moved, sums)
        x, y, z = shape[i, 0], shape[i, 1], shape[i, 2]
        for k in range(n_own + 1):
            if k < n_own:
                x, y, z = own[i, k], own[i, n_own + k], own[i, 2 * n_own + k]
            else:
                x, y, z = shape[i, 0], shape[i, 1], shape[i, 2]
            sums[0] += x * x
            sums[1] += x * y
            sums[2] += x * z
            sums[3] += y * y
            sums[4] += y * z
            sums[5] += z * z
        inner[0, 0], inner[1, 1], inner[2, 2] = sums[0], sums[3], sums[5]
        inner[0, 1] = inner[1, 0] = sums[1]
        inner[0, 2] = inner[2, 0] = sums[2]
        inner[1, 2] = inner[2, 1] = sums[4]
        for a in range(3):
            total = turn[a, 0] * points[i, 0] + turn[a, 1] * points[i, 1]
            placed[i, a] = total + turn[a, 2] * points[i, 2] + turn[a, 3]
            for b in range(3):
                total = turn[a, 0] * inner[0, b] + turn[a, 1] * inner[1, b]
                half[a, b] = total + turn[a, 2] * inner[2, b]
        for a in range(3):
            for b in range(a + 1):
                total = half[a, 0] * turn[b, 0] + half[a, 1] * turn[b, 1] + half[a, 2] * turn[b, 2]
                if a == b:
                    total += arm[0, 0]
                for about in range(1, 3):
                    lever_a = placed[i, a] - arm[about, a]
                    lever_b = placed[i, b] - arm[about, b]
                    total -= arm[0, about] * lever_a * lever_b
                    if a == b:
                        for c in range(3):
                            total += arm[0, about] * (placed[i, c] - arm[about, c]) ** 2
                covariance[i, 3 * a + b] = total
                covariance[i, 3 * b + a] = total
