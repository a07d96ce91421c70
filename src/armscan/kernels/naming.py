# SPDX-License-Identifier: Apache-2.0
"""Which sheet drew which stripe: unbroken segments, pictures in a second camera, equations."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    Bytes,
    BytesOut,
    Floats,
    FloatsOut,
    Ints,
    IntsOut,
    IntTable,
    Table,
    TableOut,
    compiled,
)
from armscan.kernels.chains import best_states
from armscan.kernels.rays import distort, height_of, radial_base, undistort

N_CAMERA, N_SHEET, N_SECOND, N_DRIFT = 9, 8, 15, 3
SECOND = N_CAMERA + N_SHEET
DRIFT = SECOND + N_SECOND
"""Places, among what a residual depends on, of what a second camera adds and of the drift."""
LEAST_LENGTH = 1e-12
SPIRAL = np.array(
    [[0, 0], [0, 1], [1, 0], [0, -1], [-1, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]], np.int64
)
"""A cell and those around it, rows and columns."""


@compiled()
def find_steps(
    points: Table, row: Ints, chain: Ints, is_beside: Bytes, step: FloatsOut, is_cut: BytesOut
) -> None:
    """Distance of each chosen point from the one before, and whether a chain ends between them.

    ``points``, ``chain``, ``is_beside``: (N, 2) and (N,) of all points: chain numbers, and 1 where
    another line is near. ``row``: (A,) of the chosen ones. ``step``, ``is_cut``: (A,) output; of
    the first 0 and 1. A point beside another line cuts, too, whether it is chosen or not.
    """
    for i in range(row.shape[0]):
        step[i] = 0.0
        is_cut[i] = 1
        if i == 0:
            continue
        here, before = row[i], row[i - 1]
        dx = points[here, 0] - points[before, 0]
        dy = points[here, 1] - points[before, 1]
        step[i] = math.hypot(dx, dy)
        is_apart = chain[here] != chain[before]
        for k in range(before + 1, here + 1):
            is_apart = is_apart or is_beside[k] != 0
        is_cut[i] = 1 if is_apart else 0


@compiled(error_model="numpy")
def number_segments(
    points: Table,
    normals: Table,
    is_cut: Bytes,
    reach: int,
    turn_limit: float,
    jump_limit: float,
    number: IntsOut,
) -> None:
    """Number unbroken segments, cut where chains end, and at kinks and steps.

    At a kink direction and place differ that ``reach`` points on either side show by their lines of
    least squares; of neighbouring places beyond the limits the largest is the kink.

    ``points``, ``normals``: (A, 2). ``is_cut``: (A,) 1 for the first point of each chain.
    ``turn_limit``: rad. ``jump_limit``: px. ``number``: (A,) output.
    """
    n, m = points.shape[0], reach
    total = 0
    for i in range(n):
        total += 1 if is_cut[i] != 0 else 0
        number[i] = total - 1
    places = n - 2 * m + 1
    if places < 1:
        return
    middle = 0.5 * (m - 1)
    square = 0.0
    for k in range(m):
        square += (k - middle) * (k - middle)
    windows = n - m + 1
    mean = np.zeros((2, windows))
    slope = np.zeros((2, windows))
    for axis in range(2):
        means, slopes, own = mean[axis], slope[axis], points[:, axis].copy()
        for k in range(m):
            share = (k - middle) / square
            for w in range(windows):
                means[w] += own[w + k] / m
                slopes[w] += share * own[w + k]
    size = np.zeros(places)
    sure = 0.99 * math.tan(turn_limit)
    half = 0.5 * m
    n_beyond = 0
    for w in range(places):
        if number[w] != number[w + 2 * m - 1]:
            continue
        a, b = w, w + m
        dx = mean[0, b] - mean[0, a] - half * (slope[0, b] + slope[0, a])
        dy = mean[1, b] - mean[1, a] - half * (slope[1, b] + slope[1, a])
        size[w] = abs(dx * normals[b, 0] + dy * normals[b, 1]) / jump_limit
        cross = slope[0, a] * slope[1, b] - slope[1, a] * slope[0, b]
        dot = slope[0, a] * slope[0, b] + slope[1, a] * slope[1, b]
        # only what exceeds the limit matters
        if not abs(cross) <= sure * dot:
            size[w] = max(size[w], abs(math.atan2(cross, dot)) / turn_limit)
        n_beyond += 1 if size[w] > 1.0 else 0
    if n_beyond == 0:
        return
    added = 0
    for i in range(n):
        w = i - m
        if 0 <= w < places and size[w] > 1.0 and is_cut[i] == 0:
            is_largest = True
            for k in range(max(w - m, 0), min(w + m + 1, places)):
                is_largest = is_largest and size[w] >= size[k]
            added += 1 if is_largest else 0
        number[i] += added


@compiled()
def take_every(number: Ints, every: int, at: IntsOut, weight: FloatsOut, nearest: IntsOut) -> int:
    """Samples of segments: every so many points, more densely on short ones; their count.

    ``number``: (A,) of each point's segment. ``at``, ``weight``: (A,) output, as many as there are
    samples: the point of each, and points it stands for over ``every``. ``nearest``: (A,) output,
    the sample that stands for each point.
    """
    n = number.shape[0]
    n_samples = 0
    start = 0
    while start < n:
        stop = start + 1
        while stop < n and number[stop] == number[start]:
            stop += 1
        length = stop - start
        step = min(max(length // 4, 1), every)
        n_cells = max(length // step, 1)
        for cell in range(n_cells):
            first = start + cell * step
            last = stop if cell == n_cells - 1 else first + step
            at[n_samples] = first + (last - first) // 2
            weight[n_samples] = (last - first) / every
            for i in range(first, last):
                nearest[i] = n_samples
            n_samples += 1
        start = stop
    return n_samples


@compiled(error_model="numpy")
def list_possible(
    pixels: Table, camera: Floats, sheets: Table, limits: Table, point: IntsOut, sheet: IntsOut
) -> int:
    """Pairs of pixel and sheet whose planes meet within depths, ordered by sheet; their count.

    ``pixels``: (N, 2). ``camera``, ``sheets``: As for `meet_sheets`. ``limits``: (S, 2) least and
    largest depth. ``point``, ``sheet``: (N S,) output.
    """
    n = pixels.shape[0]
    rays = np.zeros((n, 3))
    lens = np.zeros(7)
    for i in range(n):
        u = (pixels[i, 0] - camera[2]) / camera[0]
        v = (pixels[i, 1] - camera[3]) / camera[1]
        if undistort(u, v, camera, lens):
            rays[i, 0], rays[i, 1], rays[i, 2] = lens[5], lens[6], 1.0
    count = 0
    for k in range(sheets.shape[0]):
        one = sheets[k]
        high = one[9] * one[0] + one[10] * one[1] + one[11] * one[2]
        for i in range(n):
            slope = rays[i, 0] * one[9] + rays[i, 1] * one[10] + rays[i, 2] * one[11]
            depth = high / slope
            if abs(slope) > 1e-9 and limits[k, 0] <= depth <= limits[k, 1]:
                point[count] = i
                sheet[count] = k
                count += 1
    return count


@compiled(error_model="numpy")
def see_points(points: Table, is_met: Ints, camera: Floats, turn: Floats, seen: TableOut) -> None:
    """Pixels (N, 2) of points (N, 3) in another camera; NaN behind it and where nothing is met.

    ``is_met``: (N,). ``camera``: As for `meet_sheets`. ``turn``: (12,) rows of rotation and shift
    to the camera's frame.
    """
    lens = np.zeros(5)
    for i in range(points.shape[0]):
        seen[i, 0] = seen[i, 1] = np.nan
        if is_met[i] == 0:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = turn[8] * px + turn[9] * py + turn[10] * pz + turn[11]
        if not z > 0.0:
            continue
        x = (turn[0] * px + turn[1] * py + turn[2] * pz + turn[3]) / z
        y = (turn[4] * px + turn[5] * py + turn[6] * pz + turn[7]) / z
        distort(x, y, camera, lens)
        seen[i, 0] = camera[0] * lens[0] + camera[2]
        seen[i, 1] = camera[1] * lens[1] + camera[3]


@compiled(error_model="numpy")
def find_nearest(asked: Table, points: Table, reach: float, nearest: IntsOut) -> None:
    """Nearest of points (R, 2) to each asked place (N, 2), -1 where none is within reach.

    Points are sorted into square cells of that side. ``nearest``: (N,) output.
    """
    n = points.shape[0]
    for i in range(asked.shape[0]):
        nearest[i] = -1
    if n == 0:
        return
    low_x = high_x = points[0, 0]
    low_y = high_y = points[0, 1]
    for i in range(n):
        low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
        low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
    columns = int((high_x - low_x) / reach) + 1
    rows = int((high_y - low_y) / reach) + 1
    head = np.full(rows * columns, -1, np.int32)
    following = np.zeros(n, np.int32)
    for i in range(n):
        cell = int((points[i, 1] - low_y) / reach) * columns + int((points[i, 0] - low_x) / reach)
        following[i] = head[cell]
        head[cell] = i
    for i in range(asked.shape[0]):
        x, y = asked[i, 0], asked[i, 1]
        is_near = low_x - reach <= x <= high_x + reach and low_y - reach <= y <= high_y + reach
        if not is_near:
            continue
        column = math.floor((x - low_x) / reach)
        row = math.floor((y - low_y) / reach)
        best = reach * reach
        for k in range(9):
            # its own cell first, so that most of the others are too far away
            r = row + SPIRAL[k, 0]
            c = column + SPIRAL[k, 1]
            if 0 <= r < rows and 0 <= c < columns:
                far_x = max(low_x + c * reach - x, x - low_x - (c + 1) * reach, 0.0)
                far_y = max(low_y + r * reach - y, y - low_y - (r + 1) * reach, 0.0)
                if far_x * far_x + far_y * far_y > best:
                    continue
                j = head[r * columns + c]
                while j >= 0:
                    dx = points[j, 0] - x
                    dy = points[j, 1] - y
                    square = dx * dx + dy * dy
                    if square < best:
                        best = square
                        nearest[i] = j
                    j = following[j]


@compiled(error_model="numpy")
def cross_stripes(
    points: Table,
    sheet: Ints,
    seen: Table,
    left: Table,
    nearest: Ints,
    right: Table,
    camera: Floats,
    sheets: Table,
    second: Floats,
    turn: Floats,
    limits: Floats,
    at: IntsOut,
    across: TableOut,
    by_point: TableOut,
    by_errors: TableOut,
) -> int:
    """Right stripes that run beside pictures of left points, and what moves the distances across.

    ``points``, ``sheet``: (H, 3) and (H,) left points on sheets. ``seen``: (H, 2) from
    `see_points`. ``left``: (H, 3) normals of the left stripe and sigma. ``nearest``: (H,) row of
    ``right``, -1 for none. ``right``: (R, 5) points, normals, sigma of right stripes. ``camera``,
    ``sheets``: As for `meet_sheets`. ``second``, ``turn``: As for `see_points`. ``limits``: (5,)
    largest distance across and along, sine of the largest angle, half of the image's width and
    height.

    Output, as many rows as stripes were found, whose count is returned: ``at``: (H,) row of each.
    ``across``: (H, 4) distance, its sigma, normal of the right stripe. ``by_point``: (H, 3) its
    derivative by the point. ``by_errors``: (H, 35) by the left camera, the sheet, what the second
    camera adds, and the drift's three numbers.
    """
    lens = np.zeros(5)
    there = np.zeros(5)
    surface = np.zeros(12)
    by_lens = np.zeros((2, 9))
    by_right = np.zeros((2, 3))
    rows = np.zeros((2, 3))
    moved = np.zeros((2, 2))
    turned = np.zeros(3)
    g = np.zeros(3)
    fx, fy = camera[0], camera[1]
    count = 0
    for i in range(points.shape[0]):
        j = nearest[i]
        if j < 0:
            continue
        n0, n1 = right[j, 2], right[j, 3]
        away_x, away_y = seen[i, 0] - right[j, 0], seen[i, 1] - right[j, 1]
        distance = away_x * n0 + away_y * n1
        along = away_y * n0 - away_x * n1
        if not (abs(along) <= limits[1] and abs(distance) <= limits[0]):
            continue
        # the right pixel by the point, in the right camera's frame and in Sensor
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        for a in range(3):
            turned[a] = turn[4 * a] * px + turn[4 * a + 1] * py + turn[4 * a + 2] * pz
        rz = turned[2] + turn[11]
        rx, ry = (turned[0] + turn[3]) / rz, (turned[1] + turn[7]) / rz
        distort(rx, ry, second, there)
        by_right[0, 0], by_right[0, 1] = second[0] * there[2] / rz, second[0] * there[3] / rz
        by_right[1, 0], by_right[1, 1] = second[1] * there[3] / rz, second[1] * there[4] / rz
        for k in range(2):
            by_right[k, 2] = -(by_right[k, 0] * rx + by_right[k, 1] * ry)
            for a in range(3):
                rows[k, a] = by_right[k, 0] * turn[a] + by_right[k, 1] * turn[4 + a]
                rows[k, a] += by_right[k, 2] * turn[8 + a]
        # the left ray and the sheet
        x, y = px / pz, py / pz
        distort(x, y, camera, lens)
        height_of(px, py, pz, sheets[sheet[i]], surface)
        slope = x * surface[1] + y * surface[2] + surface[3]
        depth_x, depth_y = -surface[1] * pz / slope, -surface[2] * pz / slope
        det = lens[2] * lens[4] - lens[3] * lens[3]
        ixx, ixy, iyy = lens[4] / det, -lens[3] / det, lens[2] / det
        for k in range(2):
            ray = rows[k, 0] * x + rows[k, 1] * y + rows[k, 2]
            by_x = ray * depth_x + pz * rows[k, 0]
            by_y = ray * depth_y + pz * rows[k, 1]
            moved[k, 0] = (by_x * ixx + by_y * ixy) / fx
            moved[k, 1] = (by_x * ixy + by_y * iyy) / fy
        l0, l1 = left[i, 0], left[i, 1]
        runs_x = moved[0, 1] * l0 - moved[0, 0] * l1
        runs_y = moved[1, 1] * l0 - moved[1, 0] * l1
        length = max(math.sqrt(runs_x * runs_x + runs_y * runs_y), LEAST_LENGTH)
        if not abs(runs_x * n0 + runs_y * n1) / length <= limits[2]:
            continue
        gain = l0 * (n0 * moved[0, 0] + n1 * moved[1, 0])
        gain += l1 * (n0 * moved[0, 1] + n1 * moved[1, 1])
        at[count] = i
        across[count, 0] = distance
        across[count, 1] = math.hypot(gain * left[i, 2], right[j, 4])
        across[count, 2], across[count, 3] = n0, n1
        row = by_errors[count]
        for a in range(3):
            g[a] = n0 * rows[0, a] + n1 * rows[1, a]
            by_point[count, a] = g[a]
        # by the left camera and the sheet
        r2 = x * x + y * y
        scale, q = radial_base(r2, camera[10] != 0.0)
        by_lens[0, 2], by_lens[1, 2] = -ixx / fx, -ixy / fx
        by_lens[0, 3], by_lens[1, 3] = -ixy / fy, -iyy / fy
        for c in range(5):
            if c == 2:
                kx, ky = scale * scale * 2.0 * x * y, scale * scale * (r2 + 2.0 * y * y)
            elif c == 3:
                kx, ky = scale * scale * (r2 + 2.0 * x * x), scale * scale * 2.0 * x * y
            else:
                power = scale * (q if c == 0 else (q * q if c == 1 else q * q * q))
                kx, ky = x * power, y * power
            by_lens[0, 4 + c] = -(ixx * kx + ixy * ky)
            by_lens[1, 4 + c] = -(ixy * kx + iyy * ky)
        for k in range(2):
            by_lens[k, 0] = by_lens[k, 2] * lens[0]
            by_lens[k, 1] = by_lens[k, 3] * lens[1]
        ray = g[0] * x + g[1] * y + g[2]
        by_x, by_y = ray * depth_x + pz * g[0], ray * depth_y + pz * g[1]
        for c in range(N_CAMERA):
            row[c] = by_x * by_lens[0, c] + by_y * by_lens[1, c]
        for c in range(N_SHEET):
            row[N_CAMERA + c] = ray * surface[4 + c] / slope
        # by the second camera and its pose
        f0, f1 = n0 * second[0], n1 * second[1]
        r2 = rx * rx + ry * ry
        scale, q = radial_base(r2, second[10] != 0.0)
        radial = (f0 * rx + f1 * ry) * scale
        row[SECOND], row[SECOND + 1] = n0 * there[0], n1 * there[1]
        row[SECOND + 2], row[SECOND + 3] = n0, n1
        row[SECOND + 4], row[SECOND + 5] = radial * q, radial * q * q
        row[SECOND + 6] = (f0 * 2.0 * rx * ry + f1 * (r2 + 2.0 * ry * ry)) * scale * scale
        row[SECOND + 7] = (f0 * (r2 + 2.0 * rx * rx) + f1 * 2.0 * rx * ry) * scale * scale
        row[SECOND + 8] = radial * q * q * q
        for a in range(3):
            g[a] = n0 * by_right[0, a] + n1 * by_right[1, a]
            row[SECOND + 12 + a] = g[a]
        row[SECOND + 9] = turned[1] * g[2] - turned[2] * g[1]
        row[SECOND + 10] = turned[2] * g[0] - turned[0] * g[2]
        row[SECOND + 11] = turned[0] * g[1] - turned[1] * g[0]
        # by a drift across the epipolar line, which the picture follows with the point's depth
        line_x = rows[0, 0] * px + rows[0, 1] * py + rows[0, 2] * pz
        line_y = rows[1, 0] * px + rows[1, 1] * py + rows[1, 2] * pz
        length = max(math.sqrt(line_x * line_x + line_y * line_y), LEAST_LENGTH)
        drift = (line_x * n1 - line_y * n0) / length
        drift = -drift if line_x < 0.0 else drift
        row[DRIFT] = drift
        row[DRIFT + 1] = drift * (seen[i, 0] / limits[3] - 1.0)
        row[DRIFT + 2] = drift * (seen[i, 1] / limits[4] - 1.0)
        count += 1
    return count


@compiled()
def mark_beside(rows: Ints, chain: Ints, reach: int, is_beside: BytesOut) -> None:
    """Mark points (N,) of a chain that lie within ``reach`` places of some rows (M,)."""
    n = chain.shape[0]
    for i in range(rows.shape[0]):
        row = rows[i]
        for near in range(max(row - reach, 0), min(row + reach + 1, n)):
            if chain[near] == chain[row]:
                is_beside[near] = 1


@compiled(fastmath=True)
def explain_residuals(by_errors: Table, sheet: Ints, step: Table, found: FloatsOut) -> None:
    """What errors add to residuals, (H,) output.

    ``by_errors``: (H, Q). ``sheet``: (H,). ``step``: (S, Q) of what each sheet's points depend on.
    """
    for i in range(by_errors.shape[0]):
        row = by_errors[i]
        steps = step[sheet[i]]
        total = 0.0
        for c in range(row.shape[0]):
            total += row[c] * steps[c]
        found[i] = total


@compiled(fastmath=True)
def predict_residuals(
    by_errors: Table, sheet: Ints, step: Table, covariance: Table, found: TableOut
) -> None:
    """What errors add to residuals, and the variance that they leave, (H, 2) output.

    ``by_errors``: (H, Q). ``sheet``: (H,). ``step``, ``covariance``: (S, Q) and (S, Q Q) of what
    each sheet's points depend on.
    """
    q = by_errors.shape[1]
    for i in range(by_errors.shape[0]):
        row = by_errors[i]
        steps = step[sheet[i]]
        explained = 0.0
        for c in range(q):
            explained += row[c] * steps[c]
        variance = 0.0
        for c in range(q):
            # the products of two errors come twice
            products = covariance[sheet[i], c * q : c * q + c]
            total = 0.0
            for d in range(c):
                total += products[d] * row[d]
            variance += (2.0 * total + covariance[sheet[i], c * q + c] * row[c]) * row[c]
        found[i, 0] = explained
        found[i, 1] = variance


@compiled()
def score_left(
    sample: Ints,
    sheet: Ints,
    ratio: Floats,
    is_match: Bytes,
    is_alive: Bytes,
    missing: float,
    scores: TableOut,
    is_beside: BytesOut,
) -> None:
    """Scores of left samples on sheets, and which lie on a right stripe that may be theirs.

    ``sample``, ``sheet``, ``ratio``, ``is_match``, ``is_alive``: (H,) of each pair of sample and
    sheet; one that is not alive has the score ``missing``. ``scores``, ``is_beside``: (S, K) and
    (S K,), written where there is a pair.
    """
    k = scores.shape[1]
    for i in range(sample.shape[0]):
        is_ruled_out = is_match[i] != 0 and is_alive[i] == 0
        scores[sample[i], sheet[i]] = missing if is_ruled_out else ratio[i]
        is_beside[sample[i] * k + sheet[i]] = is_alive[i]


@compiled()
def score_right(
    sample: Ints,
    sheet: Ints,
    ratio: Floats,
    is_alive: Bytes,
    scores: TableOut,
    is_beside: BytesOut,
) -> None:
    """The same of right samples, -1 for none: each takes its best partner that is alive."""
    k = scores.shape[1]
    for i in range(sample.shape[0]):
        at = sample[i]
        if at >= 0 and is_alive[i] != 0:
            scores[at, sheet[i]] = max(scores[at, sheet[i]], ratio[i])
            is_beside[at * k + sheet[i]] = 1


@compiled()
def rule_out(
    sample: Ints,
    sheet: Ints,
    state: Ints,
    is_sure: Bytes,
    is_match: Bytes,
    is_strict: int,
    is_alive: BytesOut,
) -> None:
    """Pairs that matches are left to be, given what is certain of the samples of one camera.

    ``state``, ``is_sure``: (S,) sheet of each sample. ``is_strict``: 1 if the pair's sheet must be
    certain, 0 if no other may be. ``is_alive``: (H,) output.
    """
    for i in range(sample.shape[0]):
        at = sample[i]
        is_known = at >= 0 and is_sure[at] != 0
        is_left = state[at] == sheet[i] if is_known else is_strict == 0
        is_alive[i] = 1 if is_left and is_match[i] != 0 else 0


@compiled()
def choose_sheets(
    scores: Table,
    is_match: Bytes,
    weight: Floats,
    number: Ints,
    limits: Floats,
    state: IntsOut,
    is_sure: BytesOut,
    is_tied: BytesOut,
    is_candidate: BytesOut,
) -> None:
    """Most likely sheet of each segment, and how sure it is.

    ``scores``, ``is_match``: (S, K) of samples on sheets, and (S K,) 1 for one on a stripe of the
    other camera. ``weight``, ``number``: (S,) of each sample, and its segment, not decreasing.
    ``limits``: (5,) part of its weight that a sample counts, part of the best score at which
    another is a runner-up, least score, least sum of matches, cost of a change of sheet.
    ``state``, ``is_sure``, ``is_tied``: (S,) output. ``is_candidate``: (segments K,) zeros.
    """
    n, k = scores.shape
    table = np.zeros((n, k + 1))
    cost = np.zeros(n)
    path = np.zeros(n, np.int64)
    total = np.zeros(k)
    matches = np.zeros(k)
    first = 0
    while first < n:
        stop = first
        total[:] = 0.0
        matches[:] = 0.0
        while stop < n and number[stop] == number[first]:
            share = limits[0] * weight[stop]
            cost[stop] = limits[4] if stop > first else 0.0
            for s in range(k):
                table[stop, s] = scores[stop, s] * share
                total[s] += table[stop, s]
                if stop > first and is_match[stop * k + s] != 0:
                    matches[s] += weight[stop]
            stop += 1
        # the first one last: of a sum that is the limit but for rounding, the order decides
        for s in range(k):
            matches[s] += weight[first] if is_match[first * k + s] != 0 else 0.0
        winner = 0
        for s in range(1, k):
            if total[s] > total[winner]:
                winner = s
        best = total[winner]
        second = 0.0
        for s in range(k):
            if s != winner and total[s] > second:
                second = total[s]
            is_near = total[s] > limits[1] * best and total[s] >= limits[2]
            is_candidate[number[first] * k + s] = 1 if is_near else 0
        is_ahead = second <= limits[1] * best and best >= limits[2]
        is_ahead = is_ahead and matches[winner] >= limits[3]
        for i in range(first, stop):
            state[i] = winner
            is_sure[i] = 1 if is_ahead else 0
            is_tied[i] = 1 if not is_ahead and best > 0.0 else 0
        first = stop
    # the most likely sheets if they may change along a segment, or none
    best_states(table, cost, path)
    for i in range(n):
        if path[i] < k and path[i] != state[i]:
            is_sure[i] = 0
            is_tied[i] = 1


@compiled(error_model="numpy")
def sum_off_planes(
    samples: Table, key: Ints, planes: Table, scale_px: float, off: TableOut, sigma: TableOut
) -> None:
    """Sums, over the samples of each key, of the size and sigma of their depths off planes.

    ``samples``: (H, 3) pixel and depth. ``key``: (H,) column of the output. ``planes``: (B, 14)
    middle, inverse depth and its slopes, their covariance. ``off``, ``sigma``: (B, K) zeros.
    """
    x, y, depth = samples[:, 0].copy(), samples[:, 1].copy(), samples[:, 2].copy()
    far, spread = np.zeros(depth.shape[0]), np.zeros(depth.shape[0])
    for b in range(planes.shape[0]):
        plane = planes[b].copy()
        for i in range(depth.shape[0]):
            u, v = (x[i] - plane[0]) / scale_px, (y[i] - plane[1]) / scale_px
            square = depth[i] * depth[i]
            expected = plane[2] + u * plane[3] + v * plane[4]
            variance = plane[5] + u * u * plane[9] + v * v * plane[13]
            variance += u * (plane[6] + plane[8]) + v * (plane[7] + plane[11])
            variance += u * v * (plane[10] + plane[12])
            far[i] = abs(expected - 1.0 / depth[i]) * square
            spread[i] = math.sqrt(variance) * square
        # apart, so that the numbers are made together
        for i in range(depth.shape[0]):
            off[b, key[i]] += far[i]
            sigma[b, key[i]] += spread[i]


@compiled(fastmath=True)
def sum_moments(
    rows: Ints,
    segment: Ints,
    moments: Table,
    by_errors: Table,
    missed: Floats,
    variance: Floats,
    asked: TableOut,
    shapes: TableOut,
    noise: TableOut,
) -> None:
    """Moments of each segment's residuals, their derivatives, and their covariance by own noise.

    ``rows``, ``segment``: (M,) residuals of segments, and the numbers of these. ``moments``: (M, 3)
    share of each residual in the three moments of its segment. ``by_errors``, ``missed``,
    ``variance``: (H, Q), (H,) and (H,) of all residuals. ``asked``, ``shapes``, ``noise``:
    (B, 3 Q), (B, 3) and (B, 9), zeros.
    """
    q = by_errors.shape[1]
    for m in range(rows.shape[0]):
        i, b = rows[m], segment[m]
        row = by_errors[i]
        for k in range(3):
            share = moments[m, k]
            shapes[b, k] += share * missed[i]
            for d in range(3):
                noise[b, 3 * k + d] += share * moments[m, d] * variance[i]
            sums = asked[b, k * q : (k + 1) * q]
            for c in range(q):
                sums[c] += share * row[c]


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
