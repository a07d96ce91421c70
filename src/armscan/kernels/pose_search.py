# SPDX-License-Identifier: Apache-2.0
"""Many starts of a pose, each carried downhill in a field of distances."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import Floats, FloatsOut, Image, Table, TableOut, compiled

DAMPING = 1e-3
"""Of the normal equations' mean, so that a plate's free directions do not run away."""
LEAST_GRADIENT = 1e-9


@compiled(error_model="numpy")
def _look_up(x: float, y: float, z: float, field: Image, grid: Floats, found: FloatsOut) -> None:
    """Distance and its slopes at a point, linear between nodes; outside, on from the border.

    ``grid``: (7,) first node, spacing, counts along x, y, z. ``found``: (4,) output.
    """
    inverse = 1.0 / grid[3]
    nx = int(grid[4])
    ny = int(grid[5])
    nz = int(grid[6])
    u = (x - grid[0]) * inverse
    v = (y - grid[1]) * inverse
    w = (z - grid[2]) * inverse
    cu = min(max(u, 0.0), nx - 1.000001)
    cv = min(max(v, 0.0), ny - 1.000001)
    cw = min(max(w, 0.0), nz - 1.000001)
    i = int(cu)
    j = int(cv)
    k = int(cw)
    a = cu - i
    b = cv - j
    c = cw - k
    row = k * ny + j
    d000 = field[row, i]
    d100 = field[row, i + 1]
    d010 = field[row + 1, i]
    d110 = field[row + 1, i + 1]
    d001 = field[row + ny, i]
    d101 = field[row + ny, i + 1]
    d011 = field[row + ny + 1, i]
    d111 = field[row + ny + 1, i + 1]
    e00 = d000 + a * (d100 - d000)
    e10 = d010 + a * (d110 - d010)
    e01 = d001 + a * (d101 - d001)
    e11 = d011 + a * (d111 - d011)
    e0 = e00 + b * (e10 - e00)
    e1 = e01 + b * (e11 - e01)
    gx0 = d100 - d000 + b * (d110 - d010 - d100 + d000)
    gx1 = d101 - d001 + b * (d111 - d011 - d101 + d001)
    gx = (gx0 + c * (gx1 - gx0)) * inverse
    gy = (e10 - e00 + c * (e11 - e01 - e10 + e00)) * inverse
    gz = (e1 - e0) * inverse
    distance = e0 + c * (e1 - e0)
    if cu != u or cv != v or cw != w:
        ox = (u - cu) * grid[3]
        oy = (v - cv) * grid[3]
        oz = (w - cw) * grid[3]
        off = math.sqrt(ox * ox + oy * oy + oz * oz)
        if off > LEAST_GRADIENT:
            distance += off
            gx = ox / off
            gy = oy / off
            gz = oz / off
    found[0] = distance
    found[1] = gx
    found[2] = gy
    found[3] = gz


@compiled(error_model="numpy")
def _solve_six(normal: TableOut, right: FloatsOut) -> None:
    """Solve six symmetric positive definite equations in place (Cholesky)."""
    for i in range(6):
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= normal[i, k] * normal[j, k]
            if i == j:
                normal[i, i] = math.sqrt(max(total, 1e-300))
            else:
                normal[i, j] = total / normal[j, j]
    for i in range(6):
        for k in range(i):
            right[i] -= normal[i, k] * right[k]
        right[i] /= normal[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            right[i] -= normal[k, i] * right[k]
        right[i] /= normal[i, i]


@compiled(error_model="numpy")
def descend_poses(
    points: Table, normals: Table, field: Image, grid: Floats, widths: Floats, radius: float,
    poses: TableOut, costs: FloatsOut,
) -> None:  # fmt: skip
    """Carry poses downhill, in place, and rate where they end.

    ``points``: (N, 3) about their middle. ``normals``: (N, 3) outward, or (0, 3). ``field``:
    (nz ny, nx) signed distances. ``grid``: (7,) as of `_look_up`. ``widths``: (K,) width of the
    weight 1 / (1 + (d / width)^2) in each step. ``radius``: of the points, a scale of turns.
    ``poses``: (S, 12) rotation by rows, then the place of the points' middle. ``costs``: (S,)
    output, mean of d^2 / (d^2 + width^2), of 1 for points that face the wrong way.
    """
    n = points.shape[0]
    found = np.zeros(4)
    normal = np.zeros((6, 6))
    right = np.zeros(6)
    row = np.zeros(6)
    turn = np.zeros((3, 3))
    new = np.zeros((3, 3))
    has_normals = normals.shape[0] > 0
    for s in range(poses.shape[0]):
        pose = poses[s]
        for step in range(widths.shape[0] + 1):
            is_last = step == widths.shape[0]
            width = widths[step - 1] if is_last else widths[step]
            square = width * width
            cost = 0.0
            for i in range(6):
                right[i] = 0.0
                for j in range(6):
                    normal[i, j] = 0.0
            for p in range(n):
                x = points[p, 0]
                y = points[p, 1]
                z = points[p, 2]
                rx = pose[0] * x + pose[1] * y + pose[2] * z
                ry = pose[3] * x + pose[4] * y + pose[5] * z
                rz = pose[6] * x + pose[7] * y + pose[8] * z
                _look_up(rx + pose[9], ry + pose[10], rz + pose[11], field, grid, found)
                d = found[0]
                gx = found[1]
                gy = found[2]
                gz = found[3]
                weight = square / (square + d * d)
                if has_normals:
                    x = normals[p, 0]
                    y = normals[p, 1]
                    z = normals[p, 2]
                    facing = gx * (pose[0] * x + pose[1] * y + pose[2] * z)
                    facing += gy * (pose[3] * x + pose[4] * y + pose[5] * z)
                    facing += gz * (pose[6] * x + pose[7] * y + pose[8] * z)
                    if facing < 0.0:
                        if is_last:
                            cost += 1.0
                            continue
                        weight *= 0.1
                if is_last:
                    cost += 1.0 - weight
                    continue
                weight *= weight
                row[0] = (ry * gz - rz * gy) / radius
                row[1] = (rz * gx - rx * gz) / radius
                row[2] = (rx * gy - ry * gx) / radius
                row[3] = gx
                row[4] = gy
                row[5] = gz
                for i in range(6):
                    wi = weight * row[i]
                    right[i] -= wi * d
                    for j in range(i + 1):
                        normal[i, j] += wi * row[j]
            if is_last:
                costs[s] = cost / n
                break
            mean = 0.0
            for i in range(6):
                mean += normal[i, i] / 6.0
            for i in range(6):
                normal[i, i] += DAMPING * mean + 1e-12
            _solve_six(normal, right)
            for i in range(3):
                pose[9 + i] += right[3 + i]
            wx = right[0] / radius
            wy = right[1] / radius
            wz = right[2] / radius
            angle = math.sqrt(wx * wx + wy * wy + wz * wz)
            if angle > 1e-12:
                size = min(angle, 0.5)
                wx /= angle
                wy /= angle
                wz /= angle
                sine = math.sin(size)
                rest = 1.0 - math.cos(size)
                turn[0, 0] = 1.0 - rest * (wy * wy + wz * wz)
                turn[1, 1] = 1.0 - rest * (wx * wx + wz * wz)
                turn[2, 2] = 1.0 - rest * (wx * wx + wy * wy)
                turn[0, 1] = rest * wx * wy - sine * wz
                turn[1, 0] = rest * wx * wy + sine * wz
                turn[0, 2] = rest * wx * wz + sine * wy
                turn[2, 0] = rest * wx * wz - sine * wy
                turn[1, 2] = rest * wy * wz - sine * wx
                turn[2, 1] = rest * wy * wz + sine * wx
                for i in range(3):
                    for j in range(3):
                        new[i, j] = 0.0
                        for k in range(3):
                            new[i, j] += turn[i, k] * pose[3 * k + j]
                for i in range(3):
                    for j in range(3):
                        pose[3 * i + j] = new[i, j]
