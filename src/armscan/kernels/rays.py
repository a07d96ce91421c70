# SPDX-License-Identifier: Apache-2.0
"""From pixels to points: rays on light sheets; from boards to the equations of a camera."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    FUSED,
    Floats,
    FloatsOut,
    Four,
    Ints,
    IntsOut,
    Table,
    TableOut,
    Three,
    Two,
    compiled,
)

RAY_STEPS = 20
RAY_TOLERANCE = 1e-7
"""Of a step; Newton's next one is its square."""
SHEET_STEPS = 12
SHEET_TOLERANCE_MM = 1e-6
SETTLED_MM = 1e-7
"""Of a step along the ray; Newton's next one is its square."""
LEAST_SLOPE = 1e-6
"""Of a ray to a sheet, below which it is left to the careful search."""
NEAREST_SOURCE = 0.2
"""As in the models of the camera and the light sheet."""
NEAR_AXIS = 1e-12
"""As in the model of the camera."""


@compiled(error_model="numpy", is_inlined=True)
def radial_base(r2: float, is_fisheye: bool) -> Two:
    """Factor of the radius, and the square that a lens's radial terms are powers of."""
    if not is_fisheye or r2 < NEAR_AXIS:
        return 1.0, r2
    r = math.sqrt(r2)
    theta = math.atan(r)
    return theta / r, theta * theta


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def radial_slope(r2: float, radial: float, camera: Floats, is_fisheye: bool) -> float:
    """Derivative of a lens's radial factor by the radius, over the radius."""
    k1, k2, k3 = camera[4], camera[5], camera[8]
    slope: float = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
    if is_fisheye:
        slope = 2.0 * (k1 - 1.0 / 3.0)
        if r2 >= NEAR_AXIS:
            _, q = radial_base(r2, True)
            growth = 1.0 + q * (3.0 * k1 + q * (5.0 * k2 + q * 7.0 * k3))
            slope = (growth / (1.0 + r2) - radial) / r2
    return slope


@compiled(error_model="numpy")
def distort(x: float, y: float, camera: Floats, out: FloatsOut) -> None:
    """Distorted x and y, and their derivatives xx, xy = yx, yy, into ``out`` (5,)."""
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    is_fisheye = camera[10] != 0.0
    r2 = x * x + y * y
    scale, q = radial_base(r2, is_fisheye)
    radial = scale * (1.0 + q * (k1 + q * (k2 + q * k3)))
    slope = radial_slope(r2, radial, camera, is_fisheye)
    xy2 = 2.0 * x * y
    out[0] = x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x)
    out[1] = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy2
    out[2] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    out[3] = x * y * slope + 2.0 * (p1 * x + p2 * y)
    out[4] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x


@compiled(error_model="numpy")
def undistort(u: float, v: float, camera: Floats, out: FloatsOut) -> bool:
    """Newton's inverse of `distort`: x and y into ``out`` (7,) behind its five numbers."""
    x = u
    y = v
    if not (math.isfinite(u) and math.isfinite(v)):
        return False
    for _ in range(RAY_STEPS):
        distort(x, y, camera, out)
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
def height_of(x: float, y: float, z: float, sheet: Floats, out: FloatsOut) -> None:
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
    ray = lean + spread * u0
    middle = math.sqrt(1.0 + lean * lean)
    root = math.sqrt(1.0 + ray * ray)
    share = 2.0 * (middle * middle) * u0 / (root * (1.0 + middle * root + lean * ray))
    square = u0 * root * share
    by_square = (middle + root) * share
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
    """Depth at which the ray (x, y, 1) meets a sheet, 0 if it does not; ``out`` as `height_of`."""
    slope = x * sheet[9] + y * sheet[10] + sheet[11]
    if not abs(slope) > 1e-9 * math.sqrt(x * x + y * y + 1.0):
        return 0.0
    depth = (sheet[0] * sheet[9] + sheet[1] * sheet[10] + sheet[2] * sheet[11]) / slope
    is_bowed = False
    for i in range(13, 18):
        is_bowed = is_bowed or sheet[i] != 0.0
    step = 0.0
    for _ in range(SHEET_STEPS if is_bowed else 0):
        height_of(x * depth, y * depth, depth, sheet, out)
        along = x * out[1] + y * out[2] + out[3]
        if not abs(along) > 1e-9:
            return 0.0
        step = out[0] / along
        depth -= step
        if abs(step) < SETTLED_MM:
            break
    return depth if depth > 0.0 and abs(step) < SHEET_TOLERANCE_MM else 0.0


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def bow_and_slopes(u: float, v: float, sheet: Floats) -> Three:
    """Height of the bow over a sheet's plane, and its slopes by u and v; see `height_of`."""
    lean = sheet[18]
    w = 1.0 + sheet[19] * v
    spread = sheet[19] if w > NEAREST_SOURCE else 0.0
    w = w if w > NEAREST_SOURCE else NEAREST_SOURCE
    u0 = (u - lean * v) / w
    ray = lean + sheet[19] * u0
    middle = math.sqrt(1.0 + lean * lean)
    root = math.sqrt(1.0 + ray * ray)
    both = middle + root
    share = 2.0 * (middle * middle) * u0 / (root * (1.0 + middle * root + lean * ray))
    square = sheet[13] * u0 * root * share + sheet[16] * u0 * u0 * u0
    slope = sheet[13] * both * share + 3.0 * sheet[16] * u0 * u0
    along_v = sheet[14] + sheet[17] * u
    bow = w * square + v * (u * along_v + sheet[15] * v)
    by_u = slope + v * (along_v + sheet[17] * u)
    by_v = spread * (square - u0 * slope) - lean * slope + u * along_v + 2.0 * sheet[15] * v
    return bow, by_u, by_v


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def lens_slopes(x: float, y: float, camera: Floats, is_fisheye: bool) -> Four:
    """What `distort` gives: the derivatives xx, xy, yy of the lens, and its radial factor."""
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    r2 = x * x + y * y
    scale, q = radial_base(r2, is_fisheye)
    radial = scale * (1.0 + q * (k1 + q * (k2 + q * k3)))
    slope = radial_slope(r2, radial, camera, is_fisheye)
    xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    xy = x * y * slope + 2.0 * (p1 * x + p2 * y)
    yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, xy, yy, radial


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def distorted_at(x: float, y: float, camera: Floats, radial: float) -> Two:
    """Distorted x and y, of the radial factor from `lens_slopes`."""
    p1, p2, r2 = camera[6], camera[7], x * x + y * y
    return (
        x * radial + p1 * 2.0 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + p2 * 2.0 * x * y,
    )


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _lens_step(x: float, y: float, u: float, v: float, camera: Floats, safe: float) -> Four:
    """One of Newton's steps to the inverse of `distort` for a pinhole.

    The new place, the step's size, and the least of ``safe`` and what it divides by.
    """
    xx, xy, yy, radial = lens_slopes(x, y, camera, False)
    ex, ey = distorted_at(x, y, camera, radial)
    ex, ey = ex - u, ey - v
    det = xx * yy - xy * xy
    safe = det if det < safe else safe
    safe = xx if xx < safe else safe
    step_x = (yy * ex - xy * ey) / det
    step_y = (xx * ey - xy * ex) / det
    return x - step_x, y - step_y, abs(step_x) + abs(step_y), safe


@compiled(error_model="numpy", fastmath=FUSED)
def _meet_run(
    pixels: Floats, camera: Floats, sheet: Floats, turn: Floats, points: FloatsOut, is_met: IntsOut
) -> None:
    """Points of a pinhole's pixels on one sheet, by a fixed count of steps without a branch.

    That count is enough for usual lenses and sheets. ``is_met`` is 0 for a point for which it was
    not, or for which anything is doubtful: `meet_sheets` asks again.
    """
    lens = camera.copy()
    bow = sheet.copy()
    fx, fy, cx, cy = 1.0 / lens[0], 1.0 / lens[1], lens[2], lens[3]
    fold = lens[9] * lens[9]
    scale = 1.0 / bow[12]
    ux, uy, uz = bow[3] * scale, bow[4] * scale, bow[5] * scale
    vx, vy, vz = bow[6] * scale, bow[7] * scale, bow[8] * scale
    nx, ny, nz = bow[9], bow[10], bow[11]
    origin_u = bow[0] * ux + bow[1] * uy + bow[2] * uz
    origin_v = bow[0] * vx + bow[1] * vy + bow[2] * vz
    origin_n = bow[0] * nx + bow[1] * ny + bow[2] * nz
    for i in range(is_met.shape[0]):
        u = (pixels[2 * i] - cx) * fx
        v = (pixels[2 * i + 1] - cy) * fy
        x, y, _, safe = _lens_step(u, v, u, v, lens, 1.0)
        x, y, _, safe = _lens_step(x, y, u, v, lens, safe)
        x, y, shift, safe = _lens_step(x, y, u, v, lens, safe)
        by_u = x * ux + y * uy + uz
        by_v = x * vx + y * vy + vz
        by_n = x * nx + y * ny + nz
        depth = origin_n / by_n
        high, _, _ = bow_and_slopes(depth * by_u - origin_u, depth * by_v - origin_v, bow)
        depth += high / by_n
        high, slope_u, slope_v = bow_and_slopes(
            depth * by_u - origin_u, depth * by_v - origin_v, bow
        )
        per_mm = 1.0 / (by_n - slope_u * by_u - slope_v * by_v)
        depth -= (depth * by_n - origin_n - high) * per_mm
        high, _, _ = bow_and_slopes(depth * by_u - origin_u, depth * by_v - origin_v, bow)
        step = (depth * by_n - origin_n - high) * per_mm
        depth -= step
        is_settled = (safe > 0.0) & (shift < RAY_TOLERANCE) & (abs(step) < SETTLED_MM)
        is_settled &= (x * x + y * y < fold) & (abs(by_n) > LEAST_SLOPE) & (depth > 0.0)
        is_met[i] = 1 if is_settled else 0
        points[3 * i] = depth * (turn[0] * x + turn[1] * y + turn[2]) + turn[3]
        points[3 * i + 1] = depth * (turn[4] * x + turn[5] * y + turn[6]) + turn[7]
        points[3 * i + 2] = depth * (turn[8] * x + turn[9] * y + turn[10]) + turn[11]


@compiled(error_model="numpy")
def meet_sheets(
    pixels: Floats,
    sheet: Ints,
    camera: Floats,
    sheets: Table,
    turn: Floats,
    points: FloatsOut,
    is_met: IntsOut,
) -> None:
    """Intersect the rays of pixels with light sheets.

    Consecutive pixels on one sheet are done together.

    ``pixels``: (2 N,). ``sheet``: (N,) row of ``sheets``, -1 for none. ``camera``: (11,)
    `CameraModel.numbers`. ``sheets``: (S, 20) origin, axes,
    scale, bow, fan. ``turn``: (12,) rows of rotation and shift from Sensor to the points' frame.
    ``points``: (3 N,) output, zero where nothing is met. ``is_met``: (N,) zeros, 1 where met.
    """
    n = sheet.shape[0]
    lens = np.zeros(7)
    surface = np.zeros(12)
    first = 0
    while first < n:
        number = sheet[first]
        last = first + 1
        while last < n and sheet[last] == number:
            last += 1
        if number >= 0 and camera[10] == 0.0:
            _meet_run(
                pixels[2 * first : 2 * last],
                camera,
                sheets[number],
                turn,
                points[3 * first : 3 * last],
                is_met[first:last],
            )
        first = last
    for i in range(n):
        if sheet[i] < 0 or is_met[i] == 1:
            continue
        u = (pixels[2 * i] - camera[2]) / camera[0]
        v = (pixels[2 * i + 1] - camera[3]) / camera[1]
        depth = 0.0
        if undistort(u, v, camera, lens):
            depth = _meet(lens[5], lens[6], sheets[sheet[i]], surface)
        is_met[i] = 1 if depth > 0.0 else 0
        for a in range(3):
            at = turn[4 * a] * lens[5] + turn[4 * a + 1] * lens[6] + turn[4 * a + 2]
            points[3 * i + a] = at * depth + turn[4 * a + 3] if depth > 0.0 else 0.0


@compiled(error_model="numpy")
def differentiate_sheets(
    points: Table, sheet: Ints, camera: Floats, sheets: Table, by_px: TableOut, by_sensor: TableOut
) -> None:
    """Derivatives of points on light sheets by their pixels, by the camera and by the sheet.

    ``points``: (N, 3) in Sensor. ``sheet``, ``camera``, ``sheets``: As for `meet_sheets`; nothing
    is done for a point with -1. ``by_px``, ``by_sensor``: (N, 6) and (N, 51) output, the rows'
    (3, 2) and (3, 17).
    """
    lens = np.zeros(7)
    surface = np.zeros(12)
    by_camera = np.zeros((2, 9))
    fx = camera[0]
    fy = camera[1]
    for i in range(points.shape[0]):
        if sheet[i] < 0:
            continue
        depth = points[i, 2]
        x = points[i, 0] / depth
        y = points[i, 1] / depth
        # of the inverse of the lens, at a fixed pixel
        distort(x, y, camera, lens)
        det = lens[2] * lens[4] - lens[3] * lens[3]
        ixx = lens[4] / det
        ixy = -lens[3] / det
        iyy = lens[2] / det
        r2 = x * x + y * y
        scale, q = radial_base(r2, camera[10] != 0.0)
        for c in range(5):
            if c == 2:
                kx = scale * scale * 2.0 * x * y
                ky = scale * scale * (r2 + 2.0 * y * y)
            elif c == 3:
                kx = scale * scale * (r2 + 2.0 * x * x)
                ky = scale * scale * 2.0 * x * y
            else:
                power = scale * (q if c == 0 else (q * q if c == 1 else q * q * q))
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
        height_of(points[i, 0], points[i, 1], depth, sheets[sheet[i]], surface)
        along = x * surface[1] + y * surface[2] + surface[3]
        ddepth_x = -surface[1] * depth / along
        ddepth_y = -surface[2] * depth / along
        for a in range(3):
            ray = x if a == 0 else (y if a == 1 else 1.0)
            dx = ray * ddepth_x + (depth if a == 0 else 0.0)
            dy = ray * ddepth_y + (depth if a == 1 else 0.0)
            by_px[i, 2 * a] = -(dx * by_camera[0, 2] + dy * by_camera[1, 2])
            by_px[i, 2 * a + 1] = -(dx * by_camera[0, 3] + dy * by_camera[1, 3])
            for c in range(9):
                by_sensor[i, 17 * a + c] = dx * by_camera[0, c] + dy * by_camera[1, c]
            for c in range(8):
                by_sensor[i, 17 * a + 9 + c] = ray * surface[4 + c] / along


@compiled(error_model="numpy")
def sheet_gradients(points: Table, sheet: Ints, sheets: Table, gradients: TableOut) -> None:
    """Gradients (N, 3) of the distance from their sheets at points (N, 3); as `meet_sheets`."""
    surface = np.zeros(12)
    for i in range(points.shape[0]):
        height_of(points[i, 0], points[i, 1], points[i, 2], sheets[sheet[i]], surface)
        for a in range(3):
            gradients[i, a] = surface[1 + a]


POSE = 6
"""Unknowns of a view: rotation-vector increment (rad, Sensor frame, on the left), translation."""
CAMERA_AND_BOW = 11
"""Shared unknowns: the camera's nine parameters, and the board's bow along its two axes, mm."""


@compiled(error_model="numpy", fastmath=FUSED)
def board_rows(
    board: Floats, bow: Floats, pose: Floats, shared: Floats, is_fisheye: bool, rows: TableOut
) -> bool:
    """Prediction of one target point and its derivatives; False behind the camera.

    ``board``: (3,) mm. ``bow``: (2,) how far the two bows lift it. ``pose``: (12,) rotation, row by
    row, and translation. ``shared``: (11,). ``rows``: (2, 18) output, for u and v: derivatives by
    the shared unknowns and the view's pose, and the prediction, px.
    """
    height = board[2] + bow[0] * shared[9] + bow[1] * shared[10]
    tx = pose[0] * board[0] + pose[1] * board[1] + pose[2] * height
    ty = pose[3] * board[0] + pose[4] * board[1] + pose[5] * height
    tz = pose[6] * board[0] + pose[7] * board[1] + pose[8] * height
    z = tz + pose[11]
    if not z > 0.0:
        return False
    x, y = (tx + pose[9]) / z, (ty + pose[10]) / z
    xx, xy, yy, radial = lens_slopes(x, y, shared, is_fisheye)
    scale, q = radial_base(x * x + y * y, is_fisheye)
    u, v = scale * x, scale * y
    distorted_x, distorted_y = distorted_at(x, y, shared, radial)
    for i in range(2):
        focal = shared[i]
        along, across = (u, v) if i == 0 else (v, u)
        own, other = (distorted_x, xy) if i == 0 else (distorted_y, yy)
        by_x, by_y = focal * (xx if i == 0 else xy) / z, focal * other / z
        by_z = -(by_x * x + by_y * y)
        row = rows[i]
        row[0], row[1] = (own, 0.0) if i == 0 else (0.0, own)
        row[2], row[3] = (1.0, 0.0) if i == 0 else (0.0, 1.0)
        row[4], row[5], row[8] = focal * along * q, focal * along * q * q, focal * along * q * q * q
        row[6 + i] = focal * 2.0 * along * across
        row[7 - i] = focal * (q + 2.0 * along * along)
        by_height = by_x * pose[2] + by_y * pose[5] + by_z * pose[8]
        row[9], row[10] = by_height * bow[0], by_height * bow[1]
        row[11] = ty * by_z - tz * by_y
        row[12] = tz * by_x - tx * by_z
        row[13] = tx * by_y - ty * by_x
        row[14], row[15], row[16] = by_x, by_y, by_z
        row[17] = focal * own + shared[2 + i]
    return True


@compiled(error_model="numpy", fastmath=FUSED)
def sum_views(
    points: Table,
    whitening: Table,
    board: Table,
    bow: Table,
    starts: Ints,
    poses: Table,
    shared: Floats,
    is_fisheye: bool,
    basis: Table,
    weights: Floats,
    sums: TableOut,
) -> bool:
    """Normal equations of target points, view by view; False if one lies behind the camera.

    ``points``: (N, 2) px. ``whitening``: (N, 4) rows of the inverse of their sigmas' root.
    ``board``, ``bow``: (N, 3), (N, 2), and ``poses``: (V, 12), as for `board_rows`. ``starts``:
    (V + 1,) first point of each view. ``shared``: (11,). ``basis``: (11, F) directions that are
    solved. ``weights``: (N,). ``sums``: (V, S S), S = F + 7, zeros; output: products of the free
    unknowns', the pose's and the residual's columns.
    """
    n_free = basis.shape[1]
    size = n_free + POSE + 1
    raw, white = np.zeros((2, CAMERA_AND_BOW + POSE + 1)), np.zeros((2, size))
    free = np.zeros((2, size))
    for v in range(poses.shape[0]):
        for n in range(starts[v], starts[v + 1]):
            if not board_rows(board[n], bow[n], poses[v], shared, is_fisheye, raw):
                return False
            if weights[n] == 0.0:
                continue
            for i in range(2):
                for j in range(n_free):
                    free[i, j] = 0.0
                for k in range(CAMERA_AND_BOW):
                    for j in range(n_free):
                        free[i, j] += raw[i, k] * basis[k, j]
                for j in range(POSE):
                    free[i, n_free + j] = raw[i, CAMERA_AND_BOW + j]
                free[i, size - 1] = points[n, i] - raw[i, CAMERA_AND_BOW + POSE]
            root = math.sqrt(weights[n])
            for i in range(2):
                by_u, by_v = root * whitening[n, 2 * i], root * whitening[n, 2 * i + 1]
                for j in range(size):
                    white[i, j] = by_u * free[0, j] + by_v * free[1, j]
            for i in range(size):
                first, second = white[0, i], white[1, i]
                for j in range(i, size):
                    sums[v, i * size + j] += first * white[0, j] + second * white[1, j]
        for i in range(size):
            for j in range(i):
                sums[v, i * size + j] = sums[v, j * size + i]
    return True
