# SPDX-License-Identifier: Apache-2.0
"""Where a triangle mesh lies: its closest point by a tree of boxes, which is built and walked, and
many starts of a pose, each carried downhill in a field of its distances.
"""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    Floats,
    FloatsOut,
    Image,
    Ints,
    IntsOut,
    IntTable,
    Table,
    TableOut,
    compiled,
)

BINS = 16
"""Places at which a split is tried (binned surface area heuristic, Wald 2007)."""
MOST_IN_LEAF = 4
DEEPEST, STACK = 64, 128
"""From this depth on nodes are halved by count, so that no walk has more open nodes than the stack
holds."""
INSIDE, AT_A, AT_B, AT_C, ON_AB, ON_BC, ON_CA = range(7)
"""Where on its triangle a closest point lies: inside, at a corner, on an edge."""
DAMPING = 1e-3
"""Of the normal equations' mean, so that a plate's free directions do not run away."""
LEAST_GRADIENT = 1e-9


@compiled(error_model="numpy")
def _half_area(box: Floats) -> float:
    """Half the surface of a box: (6,) low corner, high corner."""
    x = box[3] - box[0]
    y = box[4] - box[1]
    z = box[5] - box[2]
    area: float = x * y + y * z + z * x
    return area


@compiled()
def _grow(box: FloatsOut, boxes: Table, i: int) -> None:
    for k in range(3):
        box[k] = min(box[k], boxes[i, k])
        box[3 + k] = max(box[3 + k], boxes[i, 3 + k])


@compiled()
def _clear(box: FloatsOut) -> None:
    for k in range(3):
        box[k] = np.inf
        box[3 + k] = -np.inf


@compiled(error_model="numpy")
def build_tree(boxes: Table, order: IntsOut, nodes: TableOut, links: TableOut) -> int:
    """Build the tree; returns the count of nodes.

    ``boxes``: (F, 6) of the triangles. ``order``: (F,) 0, 1, 2, ... in; the order of the leaves
    out. ``nodes``: (2 F, 6) output. ``links``: (2 F, 2) output, both children of a node, or of a
    leaf minus one minus its first place in ``order``, and its count.
    """
    todo = np.zeros((2 * STACK, 4), np.int64)
    counts = np.zeros(BINS, np.int64)
    bins = np.zeros((BINS, 6))
    right_area = np.zeros(BINS)
    box = np.zeros(6)
    middle = np.zeros(6)
    n_nodes = 1
    n_todo = 1
    todo[0, 0] = 0
    todo[0, 1] = 0
    todo[0, 2] = boxes.shape[0]
    while n_todo > 0:
        n_todo -= 1
        node = todo[n_todo, 0]
        start = todo[n_todo, 1]
        stop = todo[n_todo, 2]
        depth = todo[n_todo, 3]
        _clear(box)
        _clear(middle)
        for place in range(start, stop):
            i = order[place]
            _grow(box, boxes, i)
            for k in range(3):
                c = boxes[i, k] + boxes[i, 3 + k]
                middle[k] = min(middle[k], c)
                middle[3 + k] = max(middle[3 + k], c)
        for k in range(6):
            nodes[node, k] = box[k]
        axis = 0
        for k in range(1, 3):
            if middle[3 + k] - middle[k] > middle[3 + axis] - middle[axis]:
                axis = k
        width = middle[3 + axis] - middle[axis]
        if stop - start <= MOST_IN_LEAF:
            links[node, 0] = -1.0 - start
            links[node, 1] = stop - start
            continue
        split = start
        if width > 0.0 and depth < DEEPEST:
            scale = BINS * (1.0 - 1e-9) / width
            for b in range(BINS):
                counts[b] = 0
                _clear(bins[b])
            for place in range(start, stop):
                i = order[place]
                b = int((boxes[i, axis] + boxes[i, 3 + axis] - middle[axis]) * scale)
                counts[b] += 1
                _grow(bins[b], boxes, i)
            _clear(box)
            total = 0
            for b in range(BINS - 1, 0, -1):
                _grow(box, bins, b)
                total += counts[b]
                right_area[b] = total * _half_area(box) if total > 0 else np.inf
            _clear(box)
            total = 0
            best = np.inf
            at = 1
            for b in range(1, BINS):
                _grow(box, bins, b - 1)
                total += counts[b - 1]
                if total == 0 or total == stop - start:
                    continue
                cost = total * _half_area(box) + right_area[b]
                if cost < best:
                    best = cost
                    at = b
            last = stop
            while split < last:
                i = order[split]
                b = int((boxes[i, axis] + boxes[i, 3 + axis] - middle[axis]) * scale)
                if b < at:
                    split += 1
                else:
                    last -= 1
                    order[split] = order[last]
                    order[last] = i
        if split in (start, stop):
            split = (start + stop) // 2
        links[node, 0] = n_nodes
        links[node, 1] = n_nodes + 1
        todo[n_todo, 0] = n_nodes + 1
        todo[n_todo, 1] = split
        todo[n_todo, 2] = stop
        todo[n_todo, 3] = depth + 1
        todo[n_todo + 1, 0] = n_nodes
        todo[n_todo + 1, 1] = start
        todo[n_todo + 1, 2] = split
        todo[n_todo + 1, 3] = depth + 1
        n_todo += 2
        n_nodes += 2
    return n_nodes


@compiled(error_model="numpy")
def _box_distance(x: float, y: float, z: float, nodes: Table, i: int) -> float:
    """Squared distance from a point to the box of a node; 0 inside."""
    dx = max(nodes[i, 0] - x, x - nodes[i, 3], 0.0)
    dy = max(nodes[i, 1] - y, y - nodes[i, 4], 0.0)
    dz = max(nodes[i, 2] - z, z - nodes[i, 5], 0.0)
    square: float = dx * dx + dy * dy + dz * dz
    return square


@compiled(error_model="numpy")
def _triangle_distance(
    x: float, y: float, z: float, triangles: Table, i: int, found: FloatsOut
) -> float:
    """Squared distance from a point to a triangle (Ericson 2005, section 5.1.5).

    ``found``: (3,) receives the shares of both sides that lead to the closest point, and where on
    the triangle it is.
    """
    px = x - triangles[i, 0]
    py = y - triangles[i, 1]
    pz = z - triangles[i, 2]
    ux = triangles[i, 3]
    uy = triangles[i, 4]
    uz = triangles[i, 5]
    vx = triangles[i, 6]
    vy = triangles[i, 7]
    vz = triangles[i, 8]
    d1 = ux * px + uy * py + uz * pz
    d2 = vx * px + vy * py + vz * pz
    d3 = d1 - triangles[i, 12]
    d4 = d2 - triangles[i, 13]
    d5 = d1 - triangles[i, 13]
    d6 = d2 - triangles[i, 14]
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    s = 0.0
    t = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        place = AT_A
    elif d3 >= 0.0 and d4 <= d3:
        place = AT_B
        s = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        place = ON_AB
        s = d1 / (d1 - d3)
    elif d6 >= 0.0 and d5 <= d6:
        place = AT_C
        t = 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        place = ON_CA
        t = d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        place = ON_BC
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:
        place = INSIDE
        share = 1.0 / (va + vb + vc)
        s = vb * share
        t = vc * share
    found[0] = s
    found[1] = t
    found[2] = place
    dx = px - s * ux - t * vx
    dy = py - s * uy - t * vy
    dz = pz - s * uz - t * vz
    square: float = dx * dx + dy * dy + dz * dz
    return square


@compiled(error_model="numpy")
def find_closest(
    points: Table, order: Ints, towards: Table, least_cosine: float, reach: float, nodes: Table,
    links: IntTable, triangles: Table, face: IntsOut, place: IntsOut, closest: TableOut,
) -> None:  # fmt: skip
    """Closest point of a mesh to each of some points.

    ``points``: (N, 3). ``order``: (M,) rows to do, neighbours beside each other: each begins with
    the triangle of the one before. ``towards``: (N, 3) unit normals of the points, or (0, 3):
    triangles whose normal has a lesser cosine with it than ``least_cosine`` do not count.
    ``reach``: nothing is sought farther. ``nodes``, ``links``: of `build_tree`. ``triangles``:
    (F, 15) in the order of the leaves: corner a, sides ab and ac, unit normal, ab.ab, ab.ac, ac.ac.
    ``face``: (N,) output, row in ``triangles``, -1 for none. ``place``: (N,) output, where on it.
    ``closest``: (N, 3) output.
    """
    open_node = np.zeros(STACK, np.int64)
    open_distance = np.zeros(STACK)
    found = np.zeros(3)
    kept = np.zeros(3)
    is_gated = towards.shape[0] > 0
    last = -1
    for i in order:
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        best = reach * reach
        best_face = -1
        if last >= 0:
            # of triangles that are as near, beyond an edge, this one is kept
            bound = _triangle_distance(x, y, z, triangles, last, found)
            is_open = True
            if is_gated:
                cosine = 0.0
                for k in range(3):
                    cosine += towards[i, k] * triangles[last, 9 + k]
                is_open = cosine >= least_cosine
            if is_open and bound < best:
                best = bound
                best_face = last
                kept[0] = found[0]
                kept[1] = found[1]
                kept[2] = found[2]
        n_open = 1
        open_node[0] = 0
        open_distance[0] = 0.0
        while n_open > 0:
            n_open -= 1
            if open_distance[n_open] >= best:
                continue
            node = open_node[n_open]
            while links[node, 0] >= 0:
                near = links[node, 0]
                far = links[node, 1]
                near_distance = _box_distance(x, y, z, nodes, near)
                far_distance = _box_distance(x, y, z, nodes, far)
                if far_distance < near_distance:
                    near, far = far, near
                    near_distance, far_distance = far_distance, near_distance
                if far_distance < best and n_open < STACK:
                    open_node[n_open] = far
                    open_distance[n_open] = far_distance
                    n_open += 1
                if near_distance >= best:
                    node = -1
                    break
                node = near
            if node < 0:
                continue
            first = -1 - links[node, 0]
            for f in range(first, first + links[node, 1]):
                if is_gated:
                    cosine = 0.0
                    for k in range(3):
                        cosine += towards[i, k] * triangles[f, 9 + k]
                    if cosine < least_cosine:
                        continue
                distance = _triangle_distance(x, y, z, triangles, f, found)
                if distance < best:
                    best = distance
                    best_face = f
                    kept[0] = found[0]
                    kept[1] = found[1]
                    kept[2] = found[2]
        last = best_face
        face[i] = best_face
        if best_face >= 0:
            place[i] = int(kept[2])
            for k in range(3):
                closest[i, k] = (
                    triangles[best_face, k]
                    + kept[0] * triangles[best_face, 3 + k]
                    + kept[1] * triangles[best_face, 6 + k]
                )


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
