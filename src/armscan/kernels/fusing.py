# SPDX-License-Identifier: Apache-2.0
"""Points that up to two cameras and a light sheet tell: weighed against each other, and placed.

Errors of the sensor act on such a point through four distances alone: along and across the left
stripe, across the right one, and from the sheet. So its derivatives are held as a product: by the
distances, and of the distances by their own parameters.
"""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import FUSED, Floats, FloatsOut, Ints, Table, TableOut, compiled
from armscan.kernels.placing import (
    LANES,
    N_CAMERA,
    N_SHEET,
    POINT_X,
    POINT_Y,
    POINT_Z,
    SUMS,
    add_square,
    turn_sums,
    write_turned,
)
from armscan.kernels.rays import distort, height_of, radial_base

N_SECOND, N_SENSOR = 15, 32
"""Parameters that a second camera adds, and all that a point of one sheet depends on."""
ACROSS, RIGHT, SHEET = 9, 18, 33
N_PARAMETERS = 41
"""Where the derivatives of the distances by their own parameters begin, those along the left stripe
first: of the left camera, the same across it, of the second camera, of the sheet."""
LEAST_SHAPE_MM = 1e-6
"""A sheet is taken for no truer than this."""
OF_GAIN, OF_DISTANCES = 3, SUMS + 6
"""Rows of `LANES` numbers of points that are placed together: their place, the 12 numbers of their
gain, sums where `turn_sums` looks for them, and the derivatives of their distances."""
N_ROWS = OF_DISTANCES + N_PARAMETERS


@compiled(error_model="numpy")
def _weigh(
    rest: Table, covariance: Table, along: Floats, scratch: TableOut, gain: TableOut
) -> None:
    """Least-squares change (3, 4) of a point by four distances, the first of which is exact.

    ``rest``: (3, 3) derivatives of the three others by the point. ``covariance``: (3, 3) theirs.
    ``along``: (3,) derivative of the first. Moving along the stripe changes the other distances
    too, which the solution takes back. ``scratch``: (6, 3) is written to.
    """
    free, design, weighed = scratch[:2], scratch[2:4], scratch[4:]
    size = along[0] * along[0] + along[1] * along[1] + along[2] * along[2]
    for k in range(2):
        other = rest[0] if k == 0 else free[0]
        free[k, 0] = along[1] * other[2] - along[2] * other[1]
        free[k, 1] = along[2] * other[0] - along[0] * other[2]
        free[k, 2] = along[0] * other[1] - along[1] * other[0]
        length = math.sqrt(free[k, 0] ** 2 + free[k, 1] ** 2 + free[k, 2] ** 2)
        for a in range(3):
            free[k, a] /= length
    # Cholesky's factor of the covariance
    l00 = math.sqrt(covariance[0, 0])
    l10 = covariance[1, 0] / l00
    l20 = covariance[2, 0] / l00
    l11 = math.sqrt(covariance[1, 1] - l10 * l10)
    l21 = (covariance[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(covariance[2, 2] - l20 * l20 - l21 * l21)
    for k in range(2):
        for r in range(3):
            total = rest[r, 0] * free[k, 0] + rest[r, 1] * free[k, 1]
            design[k, r] = total + rest[r, 2] * free[k, 2]
        y0 = design[k, 0] / l00
        y1 = (design[k, 1] - l10 * y0) / l11
        y2 = (design[k, 2] - l20 * y0 - l21 * y1) / l22
        weighed[k, 2] = y2 / l22
        weighed[k, 1] = (y1 - l21 * weighed[k, 2]) / l11
        weighed[k, 0] = (y0 - l10 * weighed[k, 1] - l20 * weighed[k, 2]) / l00
    n00 = n01 = n11 = 0.0
    for r in range(3):
        n00 += weighed[0, r] * design[0, r]
        n01 += weighed[0, r] * design[1, r]
        n11 += weighed[1, r] * design[1, r]
    det = n00 * n11 - n01 * n01
    for a in range(3):
        gain[a, 0] = along[a] / size
    for r in range(3):
        by_first = (n11 * weighed[0, r] - n01 * weighed[1, r]) / det
        by_second = (n00 * weighed[1, r] - n01 * weighed[0, r]) / det
        changed = (rest[r, 0] * along[0] + rest[r, 1] * along[1] + rest[r, 2] * along[2]) / size
        for a in range(3):
            gain[a, 1 + r] = free[0, a] * by_first + free[1, a] * by_second
            gain[a, 0] -= gain[a, 1 + r] * changed


@compiled(error_model="numpy")
def _meet_alone(along: Floats, across: Floats, surface: Floats, gain: TableOut) -> None:
    """Change (3, 4) of a point on its sheet by three distances that tell it, none across the right
    stripe: the inverse of their derivatives by the point, of which the sheet's follow its height.
    """
    gx, gy, gz = surface[1], surface[2], surface[3]
    for k in range(3):
        # each moves the point along what leaves the other two as they are
        ax, ay, az = along[0], along[1], along[2]
        bx, by, bz = across[0], across[1], across[2]
        if k == 0:
            ax, ay, az, bx, by, bz = bx, by, bz, gx, gy, gz
        elif k == 1:
            ax, ay, az, bx, by, bz = gx, gy, gz, ax, ay, az
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        own = along if k == 0 else across
        size = x * own[0] + y * own[1] + z * own[2]
        size = x * gx + y * gy + z * gz if k == 2 else size
        column = 3 if k == 2 else k
        gain[0, column], gain[1, column], gain[2, column] = x / size, y / size, z / size
    for a in range(3):
        gain[a, 2] = 0.0


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _add_rows(shares: Floats, rows: Floats, width: int, moved: FloatsOut) -> None:
    """Weighted sum (``width``,) of rows that begin every `N_SENSOR` numbers, three at a time.

    One at a time, each would wait for the sums of the one before to be written.
    """
    for d in range(width):
        moved[d] = 0.0
    whole = len(shares) - len(shares) % 3
    for c in range(0, whole, 3):
        one, two, three = shares[c], shares[c + 1], shares[c + 2]
        first = rows[N_SENSOR * c : N_SENSOR * c + width]
        second = rows[N_SENSOR * (c + 1) : N_SENSOR * (c + 1) + width]
        third = rows[N_SENSOR * (c + 2) : N_SENSOR * (c + 2) + width]
        for d in range(width):
            moved[d] += one * first[d] + two * second[d] + three * third[d]
    for c in range(whole, len(shares)):
        row = rows[N_SENSOR * c : N_SENSOR * c + width]
        for d in range(width):
            moved[d] += shares[c] * row[d]


@compiled(error_model="numpy", fastmath=FUSED)
def _covariance_of_distances(
    own: Floats, covariance: Floats, moved: FloatsOut, found: TableOut
) -> None:
    """(3, 3) of distances across the left stripe, the right stripe and from the sheet.

    ``own``: (41,) derivatives by the sensor. ``covariance``: (1024,) of its parameters. ``moved``:
    (32,) is written to.
    """
    _add_rows(own[ACROSS : ACROSS + N_CAMERA], covariance, N_SENSOR, moved)
    both = beside = sheet = 0.0
    for d in range(N_CAMERA):
        both += moved[d] * own[ACROSS + d]
    for d in range(N_SHEET):
        sheet += moved[9 + d] * own[SHEET + d]
    for d in range(N_SECOND):
        beside += moved[17 + d] * own[RIGHT + d]
    found[0, 0] = both
    found[0, 1] = found[1, 0] = beside
    found[0, 2] = found[2, 0] = sheet
    # of the other two distances only what is not known yet
    from_sheet = N_SENSOR * (N_CAMERA + N_SHEET) + N_CAMERA - 1
    _add_rows(own[RIGHT : RIGHT + N_SECOND], covariance[from_sheet:], 24, moved[8:])
    both = sheet = 0.0
    for d in range(N_SECOND):
        both += moved[17 + d] * own[RIGHT + d]
    for d in range(N_SHEET):
        sheet += moved[9 + d] * own[SHEET + d]
    found[1, 1] = both
    found[1, 2] = found[2, 1] = sheet
    from_sheet = N_SENSOR * N_CAMERA + N_CAMERA
    _add_rows(own[SHEET : SHEET + N_SHEET], covariance[from_sheet:], N_SHEET, moved)
    both = 0.0
    for d in range(N_SHEET):
        both += moved[d] * own[SHEET + d]
    found[2, 2] = both


@compiled(error_model="numpy")
def fuse_stripes(
    rows: Ints,
    crossing: Ints,
    points: Table,
    sheet: Ints,
    left: Table,
    right_sigma: Floats,
    size_mm: Floats,
    missed: Floats,
    by_point: Table,
    by_errors: Table,
    camera: Floats,
    sheets: Table,
    covariance: Table,
    fused: TableOut,
    noise: TableOut,
    shape: TableOut,
    gain: TableOut,
    by_distance: TableOut,
) -> None:
    """Points of which two cameras and the sheet each tell a distance, weighed against each other.

    Points that no right stripe is beside stay on their sheet.

    ``rows``, ``crossing``: (M,) left points that are asked for, and the crossing of each, -1 for
    none. ``points``, ``sheet``, ``left``: (H, 3), (H,) and (H, 3) of left pixels on their sheets,
    and normals and sigma of the left stripe. ``right_sigma``: (F,) of the right stripes.
    ``size_mm``: (S,) sigma of each sheet's shape. ``missed``: (F,) distance across the right
    stripe. ``by_point``, ``by_errors``: (F, 3) and (F, 35) its derivatives, from `cross_stripes`.
    ``camera``, ``sheets``: As for `meet_sheets`. ``covariance``: (S, 1024) of the left camera, a
    sheet, and the second camera.

    ``fused``, ``shape``: (M, 3) output, the latter the move by one sigma of the sheet's shape.
    ``noise``: (M, 6) output, the rows' (3, 2) moves by one sigma of the left and of the right
    stripe. ``gain``: (M, 12) output, the rows' (3, 4) moves by the four distances.
    ``by_distance``: (M, 41) output, derivatives of the distances, see `N_PARAMETERS`.
    """
    second = N_CAMERA + N_SHEET
    lens = np.zeros(7)
    surface = np.zeros(12)
    along = np.zeros(3)
    rest = np.zeros((3, 3))
    joint = np.zeros((3, 3))
    weights = np.zeros((3, 4))
    scratch = np.zeros((6, 3))
    moved = np.zeros(N_SENSOR)
    for o in range(rows.shape[0]):
        i, f = rows[o], crossing[o]
        own = by_distance[o]
        z = points[i, 2]
        x = points[i, 0] / z
        y = points[i, 1] / z
        distort(x, y, camera, lens)
        height_of(points[i, 0], points[i, 1], z, sheets[sheet[i]], surface)
        r2 = x * x + y * y
        scale, q = radial_base(r2, camera[10] != 0.0)
        u, v = left[i, 0], left[i, 1]
        for k in range(2):
            across_x = (-v if k == 0 else u) * camera[0]
            across_y = (u if k == 0 else v) * camera[1]
            by_x = (across_x * lens[2] + across_y * lens[3]) / z
            by_y = (across_x * lens[3] + across_y * lens[4]) / z
            row = along if k == 0 else rest[0]
            row[0] = by_x
            row[1] = by_y
            row[2] = -(by_x * x + by_y * y)
            first = ACROSS * k
            own[first] = across_x / camera[0] * lens[0]
            own[first + 1] = across_y / camera[1] * lens[1]
            own[first + 2] = across_x / camera[0]
            own[first + 3] = across_y / camera[1]
            radial = (across_x * x + across_y * y) * scale
            own[first + 4] = radial * q
            own[first + 5] = radial * q * q
            by_p1 = across_x * 2.0 * x * y + across_y * (r2 + 2.0 * y * y)
            by_p2 = across_x * (r2 + 2.0 * x * x) + across_y * 2.0 * x * y
            own[first + 6], own[first + 7] = by_p1 * scale * scale, by_p2 * scale * scale
            own[first + 8] = radial * q * q * q
        for c in range(N_SHEET):
            own[SHEET + c] = -surface[4 + c]
        size = size_mm[sheet[i]]
        beside = apart = 0.0
        if f < 0:
            for c in range(N_SECOND):
                own[RIGHT + c] = 0.0
            _meet_alone(along, rest[0], surface, weights)
        else:
            for a in range(3):
                rest[1, a] = by_point[f, a]
                rest[2, a] = surface[1 + a]
            for c in range(N_SECOND):
                own[RIGHT + c] = by_errors[f, second + c]
            _covariance_of_distances(own, covariance[sheet[i]], moved, joint)
            size = max(size, LEAST_SHAPE_MM)
            beside, apart = right_sigma[f], missed[f]
            joint[0, 0] += left[i, 2] * left[i, 2]
            joint[1, 1] += beside * beside
            joint[2, 2] += size * size
            _weigh(rest, joint, along, scratch, weights)
        for a in range(3):
            fused[o, a] = points[i, a] - weights[a, 2] * apart
            noise[o, 2 * a] = weights[a, 1] * left[i, 2]
            noise[o, 2 * a + 1] = weights[a, 2] * beside
            shape[o, a] = weights[a, 3] * size
            for k in range(4):
                gain[o, 4 * a + k] = weights[a, k]


@compiled(error_model="numpy", fastmath=FUSED)
def _spread_distances(errors: Table, rows: FloatsOut) -> None:
    """Covariance in Sensor of a few points, by errors of sensor and hand-eye, into their sums.

    ``errors``: (38, 38), one error a row: its move of camera, sheet, second camera, hand-eye.
    """
    along, across = np.zeros(LANES), np.zeros(LANES)
    beside, off = np.zeros(LANES), np.zeros(LANES)
    second = N_CAMERA + N_SHEET
    for k in range(errors.shape[0]):
        own = errors[k]
        along[:] = 0.0
        across[:] = 0.0
        beside[:] = 0.0
        off[:] = 0.0
        for c in range(k, N_CAMERA):
            share = own[c]
            first = (OF_DISTANCES + c) * LANES
            by_along = rows[first : first + LANES]
            first += ACROSS * LANES
            by_across = rows[first : first + LANES]
            for i in range(LANES):
                along[i] += by_along[i] * share
                across[i] += by_across[i] * share
        for c in range(max(k - N_CAMERA, 0), N_SHEET):
            share = own[N_CAMERA + c]
            first = (OF_DISTANCES + SHEET + c) * LANES
            by_sheet = rows[first : first + LANES]
            for i in range(LANES):
                off[i] += by_sheet[i] * share
        for c in range(max(k - second, 0), N_SECOND):
            share = own[second + c]
            first = (OF_DISTANCES + RIGHT + c) * LANES
            by_right = rows[first : first + LANES]
            for i in range(LANES):
                beside[i] += by_right[i] * share
        h0, h1, h2, h3, h4, h5 = own[32], own[33], own[34], own[35], own[36], own[37]
        for i in range(LANES):
            px = rows[POINT_X * LANES + i]
            py = rows[POINT_Y * LANES + i]
            pz = rows[POINT_Z * LANES + i]
            a, b, r, s = along[i], across[i], beside[i], off[i]
            x = rows[OF_GAIN * LANES + i] * a + rows[(OF_GAIN + 1) * LANES + i] * b
            x += rows[(OF_GAIN + 2) * LANES + i] * r + rows[(OF_GAIN + 3) * LANES + i] * s
            y = rows[(OF_GAIN + 4) * LANES + i] * a + rows[(OF_GAIN + 5) * LANES + i] * b
            y += rows[(OF_GAIN + 6) * LANES + i] * r + rows[(OF_GAIN + 7) * LANES + i] * s
            z = rows[(OF_GAIN + 8) * LANES + i] * a + rows[(OF_GAIN + 9) * LANES + i] * b
            z += rows[(OF_GAIN + 10) * LANES + i] * r + rows[(OF_GAIN + 11) * LANES + i] * s
            add_square(
                h1 * pz - h2 * py + h3 - x,
                h2 * px - h0 * pz + h4 - y,
                h0 * py - h1 * px + h5 - z,
                i,
                rows,
            )


@compiled()
def carry_fused(
    points: Table,
    noise: Table,
    shape: Table,
    gain: Table,
    by_distance: Table,
    sheet: Ints,
    errors: Table,
    carried: Floats,
    placed: FloatsOut,
    covariance: FloatsOut,
) -> None:
    """Points from `fuse_stripes` in Base, with all of their covariance, in one pass.

    ``points``, ``noise``, ``shape``, ``gain``, ``by_distance``: From there. ``sheet``: (M,) of each
    point. ``errors``: (38 S, 38), for each sheet one independent error a row, that of camera,
    sheet, second camera, and the hand-eye's turn and shift in Sensor; in row k nothing before
    column k. ``carried``: As for `carry_stripe`. ``placed``: (3 M,) output. ``covariance``: (9 M,)
    output.
    """
    rows = np.zeros(N_ROWS * LANES)
    turned = np.zeros(9 * LANES)
    chosen = np.zeros(LANES, np.int64)
    width = errors.shape[1]
    for k in range(errors.shape[0] // width):
        start = 0
        while start < points.shape[0]:
            n = 0
            while start < points.shape[0] and n < LANES:
                if sheet[start] == k:
                    chosen[n] = start
                    n += 1
                start += 1
            for j in range(n):
                i = chosen[j]
                for c in range(3):
                    rows[(POINT_X + c) * LANES + j] = points[i, c]
                for c in range(12):
                    rows[(OF_GAIN + c) * LANES + j] = gain[i, c]
                for c in range(N_PARAMETERS):
                    rows[(OF_DISTANCES + c) * LANES + j] = by_distance[i, c]
                for c in range(6):
                    rows[(SUMS + c) * LANES + j] = 0.0
                for move in range(3):
                    x = noise[i, move] if move < 2 else shape[i, 0]
                    y = noise[i, 2 + move] if move < 2 else shape[i, 1]
                    z = noise[i, 4 + move] if move < 2 else shape[i, 2]
                    add_square(x, y, z, j, rows)
            if n > 0:
                _spread_distances(errors[k * width : (k + 1) * width], rows)
                turn_sums(carried, rows, turned)
            for j in range(n):
                write_turned(turned, j, chosen[j], placed, covariance)
