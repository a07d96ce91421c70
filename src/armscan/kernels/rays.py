# SPDX-License-Identifier: Apache-2.0
"""From pixels to points: rays on light sheets with their derivatives, planes, covariances."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    Floats,
    FloatsOut,
    Ints,
    IntsOut,
    IntTable,
    Table,
    TableOut,
    compiled,
)

RAY_STEPS = 20
RAY_TOLERANCE = 1e-7
"""Of a step; Newton's next one is its square."""
SHEET_STEPS = 12
SHEET_TOLERANCE_MM = 1e-6
SETTLED_MM = 1e-7
"""Of a step along the ray; Newton's next one is its square."""
NEAREST_SOURCE = 0.2
"""As in the models of the camera and the light sheet."""


@compiled(error_model="numpy")
def _distort(x: float, y: float, camera: Floats, out: FloatsOut) -> None:
    """Distorted x and y, and their derivatives xx, xy = yx, yy, into ``out`` (5,)."""
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
    xy2 = 2.0 * x * y
    out[0] = x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x)
    out[1] = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy2
    out[2] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    out[3] = x * y * slope + 2.0 * (p1 * x + p2 * y)
    out[4] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x


@compiled(error_model="numpy")
def _undistort(
    u: float, v: float, from_u: float, from_v: float, camera: Floats, out: FloatsOut
) -> bool:
    """Newton's inverse of `_distort`: x and y into ``out`` (7,) behind its five numbers.

    It begins ``from_u``, ``from_v`` beside the distorted place.
    """
    x = u + from_u
    y = v + from_v
    if not (math.isfinite(u) and math.isfinite(v)):
        return False
    for _ in range(RAY_STEPS):
        _distort(x, y, camera, out)
        det = out[2] * out[4] - out[3] * out[3]
        if not (det > 0.0 and out[2] > 0.0):
            return False
        ex = out[0] - u
        ey = out[1] - v
        step_x = (out[4] * ex - out[3] * ey) / det
        step_y = (out[2] * ey - out[3] * ex) / det
        x -= step_x
        y -= step_y
        if abs(step_x) < RAY_TOLERANCE and abs(step_y) < RAY_TOLERANCE:
            out[5] = x
            out[6] = y
            return bool(x * x + y * y < camera[9] * camera[9])
    return False


@compiled(error_model="numpy")
def _height(x: float, y: float, z: float, sheet: Floats, out: FloatsOut) -> None:
    """Distance from a sheet, its gradient, and by the parameters, into ``out`` (12,).

    ``sheet``: (20,) origin, axes, scale, bow, fan.
    """
    dx = x - sheet[0]
    dy = y - sheet[1]
    dz = z - sheet[2]
    scale = 1.0 / sheet[12]
    u = (dx * sheet[3] + dy * sheet[4] + dz * sheet[5]) * scale
    v = (dx * sheet[6] + dy * sheet[7] + dz * sheet[8]) * scale
    lean = sheet[18]
    spread = sheet[19]
    w = 1.0 + spread * v
    dw_dv = spread
    if w <= NEAREST_SOURCE:
        w = NEAREST_SOURCE
        dw_dv = 0.0
    u0 = (u - lean * v) / w
    root = math.sqrt(1.0 + spread * u0 * (spread * u0))
    square = 2.0 * u0 * u0 / (1.0 + root)
    by_square = 2.0 * u0 / root
    cube = u0 * u0 * u0
    by_cube = 3.0 * u0 * u0
    b0, b1, b2, b3, b4 = sheet[13], sheet[14], sheet[15], sheet[16], sheet[17]
    out[4] = u
    out[5] = v
    out[6] = 1.0
    out[7] = w * square
    out[8] = u * v
    out[9] = v * v
    out[10] = w * cube
    out[11] = u * u * v
    bow = b0 * out[7] + b1 * out[8] + b2 * out[9] + b3 * out[10] + b4 * out[11]
    by_u = (b0 * by_square + b1 * v + b3 * by_cube + b4 * 2.0 * u * v) * scale
    by_v = b0 * (dw_dv * (square - u0 * by_square) - lean * by_square)
    by_v += b3 * (dw_dv * (cube - u0 * by_cube) - lean * by_cube)
    by_v = (by_v + b1 * u + b2 * 2.0 * v + b4 * u * u) * scale
    out[0] = dx * sheet[9] + dy * sheet[10] + dz * sheet[11] - bow
    for i in range(3):
        out[1 + i] = sheet[9 + i] - by_u * sheet[3 + i] - by_v * sheet[6 + i]


@compiled(error_model="numpy")
def _meet(x: float, y: float, sheet: Floats, out: FloatsOut) -> float:
    """Depth at which the ray (x, y, 1) meets a sheet, 0 if it does not; ``out`` as `_height`."""
    slope = x * sheet[9] + y * sheet[10] + sheet[11]
    if not abs(slope) > 1e-9 * math.sqrt(x * x + y * y + 1.0):
        return 0.0
    depth = (sheet[0] * sheet[9] + sheet[1] * sheet[10] + sheet[2] * sheet[11]) / slope
    is_bowed = False
    for i in range(13, 18):
        is_bowed = is_bowed or sheet[i] != 0.0
    step = 0.0
    for _ in range(SHEET_STEPS if is_bowed else 0):
        _height(x * depth, y * depth, depth, sheet, out)
        along = x * out[1] + y * out[2] + out[3]
        if not abs(along) > 1e-9:
            return 0.0
        step = out[0] / along
        depth -= step
        if abs(step) < SETTLED_MM:
            break
    return depth if depth > 0.0 and abs(step) < SHEET_TOLERANCE_MM else 0.0


@compiled(error_model="numpy")
def meet_sheets(
    pixels: Table,
    sheet: Ints,
    camera: Floats,
    sheets: Table,
    points: TableOut,
    is_met: IntsOut,
    by_px: TableOut,
    by_sensor: TableOut,
) -> None:
    """Intersect the rays of pixels with light sheets, with derivatives if asked.

    ``pixels``: (N, 2). ``sheet``: (N,) row of ``sheets``, -1 for none. ``camera``: (10,) its
    parameters and the radius at which the model folds over. ``sheets``: (S, 20) origin, axes,
    scale, bow, fan. ``points``: (N, 3) output, left as it is where nothing is met. ``is_met``: (N,)
    output, 1 where met. ``by_px``, ``by_sensor``: (N, 6) and (N, 51) output, the rows' (3, 2) and
    (3, 17) derivatives by the pixel, and by the camera and the sheet; no rows if not wanted.
    """
    lens = np.zeros(7)
    surface = np.zeros(12)
    ddepth = np.zeros(2)
    by_camera = np.zeros((2, 9))
    has_ray = False
    is_differentiated = False
    shift_u = shift_v = 0.0
    number = 0
    of_sheet = sheets[number]
    fx = camera[0]
    fy = camera[1]
    is_full = by_px.shape[0] > 0
    for i in range(pixels.shape[0]):
        is_same = i > 0 and pixels[i, 0] == pixels[i - 1, 0] and pixels[i, 1] == pixels[i - 1, 1]
        if not is_same:
            u = (pixels[i, 0] - camera[2]) / fx
            v = (pixels[i, 1] - camera[3]) / fy
            # of its neighbour, which is nearly the pixel's own
            has_ray = _undistort(u, v, shift_u, shift_v, camera, lens)
            if not has_ray and (shift_u != 0.0 or shift_v != 0.0):
                has_ray = _undistort(u, v, 0.0, 0.0, camera, lens)
            shift_u = lens[5] - u if has_ray else 0.0
            shift_v = lens[6] - v if has_ray else 0.0
            is_differentiated = False
        if not has_ray or sheet[i] < 0:
            continue
        x = lens[5]
        y = lens[6]
        if sheet[i] != number:
            number = sheet[i]
            of_sheet = sheets[number]
        depth = _meet(x, y, of_sheet, surface)
        if not depth > 0.0:
            continue
        is_met[i] = 1
        points[i, 0] = x * depth
        points[i, 1] = y * depth
        points[i, 2] = depth
        if not is_full:
            continue
        if not is_differentiated:
            is_differentiated = True
            # of the inverse of the lens, at a fixed pixel
            _distort(x, y, camera, lens)
            det = lens[2] * lens[4] - lens[3] * lens[3]
            ixx = lens[4] / det
            ixy = -lens[3] / det
            iyy = lens[2] / det
            r2 = x * x + y * y
            for c in range(5):
                if c == 2:
                    kx = 2.0 * x * y
                    ky = r2 + 2.0 * y * y
                elif c == 3:
                    kx = r2 + 2.0 * x * x
                    ky = 2.0 * x * y
                else:
                    power = r2 if c == 0 else (r2 * r2 if c == 1 else r2 * r2 * r2)
                    kx = x * power
                    ky = y * power
                by_camera[0, 4 + c] = -(ixx * kx + ixy * ky)
                by_camera[1, 4 + c] = -(ixy * kx + iyy * ky)
            by_camera[0, 2] = -ixx / fx
            by_camera[1, 2] = -ixy / fx
            by_camera[0, 3] = -ixy / fy
            by_camera[1, 3] = -iyy / fy
            for j in range(2):
                by_camera[j, 0] = by_camera[j, 2] * lens[0]
                by_camera[j, 1] = by_camera[j, 3] * lens[1]
        _height(x * depth, y * depth, depth, of_sheet, surface)
        along = x * surface[1] + y * surface[2] + surface[3]
        ddepth[0] = -surface[1] * depth / along
        ddepth[1] = -surface[2] * depth / along
        for a in range(3):
            ray = x if a == 0 else (y if a == 1 else 1.0)
            dx = ray * ddepth[0] + (depth if a == 0 else 0.0)
            dy = ray * ddepth[1] + (depth if a == 1 else 0.0)
            by_px[i, 2 * a] = -(dx * by_camera[0, 2] + dy * by_camera[1, 2])
            by_px[i, 2 * a + 1] = -(dx * by_camera[0, 3] + dy * by_camera[1, 3])
            for c in range(9):
                by_sensor[i, 17 * a + c] = dx * by_camera[0, c] + dy * by_camera[1, c]
            for c in range(8):
                by_sensor[i, 17 * a + 9 + c] = ray * surface[4 + c] / along


@compiled(error_model="numpy")
def sum_off_planes(
    samples: Table, key: Ints, planes: Table, scale_px: float, off: TableOut, sigma: TableOut
) -> None:
    """Sums, over the samples of each key, of the size and sigma of their depths off planes.

    ``samples``: (H, 3) pixel and depth. ``key``: (H,) column of the output. ``planes``: (B, 14)
    middle, inverse depth and its slopes, their covariance. ``off``, ``sigma``: (B, K) zeros.
    """
    for b in range(planes.shape[0]):
        plane = planes[b]
        for i in range(samples.shape[0]):
            x = (samples[i, 0] - plane[0]) / scale_px
            y = (samples[i, 1] - plane[1]) / scale_px
            depth = samples[i, 2]
            square = depth * depth
            expected = plane[2] + x * plane[3] + y * plane[4]
            variance = plane[5] + x * x * plane[9] + y * y * plane[13]
            variance += x * (plane[6] + plane[8]) + y * (plane[7] + plane[11])
            variance += x * y * (plane[10] + plane[12])
            off[b, key[i]] += abs(expected - 1.0 / depth) * square
            sigma[b, key[i]] += math.sqrt(variance) * square


@compiled(error_model="numpy")
def move_by_shape(
    points: Table, rays: Table, sheet: Ints, sheets: Table, size_mm: Floats, moved: TableOut
) -> None:
    """Move of points (N, 3) along their rays (N, 3) by a size (S,) across their sheets (N,).

    ``sheets``: As for `meet_sheets`. ``moved``: (N, 3) output.
    """
    surface = np.zeros(12)
    for i in range(points.shape[0]):
        _height(points[i, 0], points[i, 1], points[i, 2], sheets[sheet[i]], surface)
        along = surface[1] * rays[i, 0] + surface[2] * rays[i, 1] + surface[3] * rays[i, 2]
        share = size_mm[sheet[i]] / along if abs(along) > 0.0 else 0.0
        for a in range(3):
            moved[i, a] = rays[i, a] * share


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
        for k in range(width):
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


@compiled(fastmath=True)
def add_equations(
    rows: Table, group: Ints, weight: Floats, wanted: Floats, matrix: TableOut, vector: TableOut
) -> None:
    """Add rows of equations to the normal equations of their groups.

    ``rows``: (H, Q) derivatives. ``group``: (H,). ``weight``: (H,). ``wanted``: (H,) right-hand
    side. ``matrix``: (G, Q Q) sums of weighted products. ``vector``: (G, Q) of each with what is
    wanted.
    """
    q = rows.shape[1]
    for i in range(rows.shape[0]):
        if weight[i] == 0.0:
            continue
        row = rows[i]
        sums = vector[group[i]]
        share = weight[i] * wanted[i]
        for c in range(q):
            sums[c] += share * row[c]
        for c in range(q):
            products = matrix[group[i], c * q : (c + 1) * q]
            share = weight[i] * row[c]
            if share == 0.0:
                continue
            for d in range(q):
                products[d] += share * row[d]


@compiled()
def join_equations(
    matrix: Table, vector: Table, columns: IntTable, whole: TableOut, side: FloatsOut
) -> None:
    """Add normal equations of groups, (G, Q Q) and (G, Q), to those of all parameters.

    ``columns``: (G, Q) places of a group's parameters. ``whole``: (P, P). ``side``: (P,).
    """
    q = columns.shape[1]
    for g in range(columns.shape[0]):
        for c in range(q):
            row = whole[columns[g, c]]
            side[columns[g, c]] += vector[g, c]
            for d in range(q):
                row[columns[g, d]] += matrix[g, c * q + d]


@compiled(fastmath=True)
def combine_rows(
    rows: Table, group: Ints, columns: IntTable, factor: Table, combined: TableOut
) -> None:
    """Multiply rows (H, Q) by what a factor (P, K) has of their groups' parameters; (H, K) zeros.

    ``group``: (H,). ``columns``: (G, Q) places of a group's parameters.
    """
    k = factor.shape[1]
    for i in range(rows.shape[0]):
        total = combined[i]
        for c in range(rows.shape[1]):
            share = rows[i, c]
            if share == 0.0:
                continue
            own = factor[columns[group[i], c]]
            for j in range(k):
                total[j] += share * own[j]
