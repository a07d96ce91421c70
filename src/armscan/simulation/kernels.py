# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the renderer: discs of a print, lines of light, the detector's grey levels, and
where a ray meets a shape.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

_TABLE = types.Array(types.float64, 2, "C", readonly=True)
_FLOATS = types.Array(types.float64, 1, "C", readonly=True)
_IMAGE = types.Array(types.float32, 2, "C", readonly=True)
_IMAGE_OUT = types.Array(types.float32, 2, "C")
_BYTES = types.Array(types.uint8, 2, "C", readonly=True)
_F32 = types.float32

SUBPIXELS = 2
SAMPLES = 8
_WALK_STEPS, _NEWTON_STEPS, _WALK_CLOSE_MM, _STEEP = 200, 4, 1e-3, 1e-3

Floats = NDArray[np.float64]
Three = tuple[float, float, float]

compiled = njit(cache=True, error_model="numpy")


@njit(types.void(_IMAGE, _IMAGE_OUT, _F32, _F32, _F32), cache=True)
def expose(
    light: NDArray[np.float32],
    noise: NDArray[np.float32],
    per_electron: float,
    read_square: float,
    full_scale: float,
) -> None:
    """Turn light (H, W), parts of full scale, into grey levels, in place of the noise.

    ``noise`` (H, W) is standard normal; shot noise has a variance of ``per_electron`` a level of an
    8-bit image, the rest of ``read_square``.
    """
    level, nothing = np.float32(255.0), np.float32(0.0)
    gain = np.float32(full_scale / level)
    for v in range(light.shape[0]):
        for u in range(light.shape[1]):
            grey = light[v, u] * level
            sigma = np.sqrt(max(grey, nothing) * per_electron + read_square)
            found = np.rint((grey + sigma * noise[v, u]) * gain)
            noise[v, u] = min(max(found, nothing), full_scale)


@njit(
    types.Tuple((types.float64, types.float64))(  # type: ignore[no-untyped-call]
        types.float64, types.float64, _FLOATS, _TABLE, _TABLE, _TABLE
    ),
    cache=True,
)
def _on_board(
    u: float,
    v: float,
    lens: NDArray[np.float64],
    knots_x: NDArray[np.float64],
    knots_y: NDArray[np.float64],
    board_from_ray: NDArray[np.float64],
) -> tuple[float, float]:
    """Place on the board that one pixel sees.

    Its ray is interpolated between knots and improved by one step of the fixed-point search.
    """
    step = lens[9]
    column, row = (u - lens[10]) / step, (v - lens[11]) / step
    i = min(max(int(row), 0), knots_x.shape[0] - 2)
    j = min(max(int(column), 0), knots_x.shape[1] - 2)
    a, b = column - j, row - i
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    x = w00 * knots_x[i, j] + w01 * knots_x[i, j + 1]
    x += w10 * knots_x[i + 1, j] + w11 * knots_x[i + 1, j + 1]
    y = w00 * knots_y[i, j] + w01 * knots_y[i, j + 1]
    y += w10 * knots_y[i + 1, j] + w11 * knots_y[i + 1, j + 1]
    square = x * x + y * y
    gain = 1.0 + square * (lens[4] + square * (lens[5] + square * lens[8]))
    lever = 2.0 * (lens[6] * y + lens[7] * x)
    rx = ((u - lens[2]) / lens[0] - x * lever - lens[7] * square) / gain
    ry = ((v - lens[3]) / lens[1] - y * lever - lens[6] * square) / gain
    h = board_from_ray
    scale = 1.0 / max(h[2, 0] * rx + h[2, 1] * ry + h[2, 2], 1e-9)
    return (
        (h[0, 0] * rx + h[0, 1] * ry + h[0, 2]) * scale,
        (h[1, 0] * rx + h[1, 1] * ry + h[1, 2]) * scale,
    )


@njit(
    types.void(_FLOATS, types.int64, types.int64, _FLOATS, _TABLE, _TABLE, _TABLE, _IMAGE_OUT),
    cache=True,
)
def disc_cells(
    disc: NDArray[np.float64],
    left: int,
    top: int,
    lens: NDArray[np.float64],
    knots_x: NDArray[np.float64],
    knots_y: NDArray[np.float64],
    board_from_ray: NDArray[np.float64],
    cells: NDArray[np.float32],
) -> None:
    """Part of each fine cell of a tile that a disc of a print covers.

    Parameters
    ----------
    disc
        (3,) centre and radius on the board, mm.
    left, top
        The tile's first pixel.
    lens
        (12,) fx, fy, cx, cy, k1, k2, p1, p2, k3, then the knots' step and their first column and
        row, px.
    knots_x, knots_y
        (K, L) rays of the knots.
    board_from_ray
        (3, 3) place on the board, homogeneous, of a ray.
    cells
        (2 H, 2 W) of a tile of H by W pixels; filled here from 64 samples each, the pixel's place
        on the board taken for linear.
    """
    height, width = cells.shape[0] // SUBPIXELS, cells.shape[1] // SUBPIXELS
    x, y = np.zeros((height + 2, width + 2)), np.zeros((height + 2, width + 2))
    for i in range(height + 2):
        for j in range(width + 2):
            px, py = float(left + j - 1), float(top + i - 1)
            x[i, j], y[i, j] = _on_board(px, py, lens, knots_x, knots_y, board_from_ray)
    n = SUBPIXELS * SAMPLES
    share = np.float32(1.0 / SAMPLES**2)
    square = disc[2] * disc[2]
    for i in range(height):
        for j in range(width):
            cx, cy = x[i + 1, j + 1] - disc[0], y[i + 1, j + 1] - disc[1]
            ux, uy = 0.5 * (x[i + 1, j + 2] - x[i + 1, j]), 0.5 * (y[i + 1, j + 2] - y[i + 1, j])
            vx, vy = 0.5 * (x[i + 2, j + 1] - x[i, j + 1]), 0.5 * (y[i + 2, j + 1] - y[i, j + 1])
            reach = 0.55 * (math.sqrt(ux * ux + uy * uy) + math.sqrt(vx * vx + vy * vy))
            away = math.sqrt(cx * cx + cy * cy) - disc[2]
            if abs(away) > reach:
                whole = np.float32(1.0) if away < 0.0 else np.float32(0.0)
                for b in range(SUBPIXELS):
                    for a in range(SUBPIXELS):
                        cells[SUBPIXELS * i + b, SUBPIXELS * j + a] = whole
                continue
            for b in range(SUBPIXELS):
                for a in range(SUBPIXELS):
                    count = 0
                    for q in range(SAMPLES):
                        down = (b * SAMPLES + q + 0.5) / n - 0.5
                        qx, qy = cx + down * vx, cy + down * vy
                        for p in range(SAMPLES):
                            along = (a * SAMPLES + p + 0.5) / n - 0.5
                            sx, sy = qx + along * ux, qy + along * uy
                            count += sx * sx + sy * sy < square
                    cells[SUBPIXELS * i + b, SUBPIXELS * j + a] = share * np.float32(count)


@njit(
    types.void(_IMAGE_OUT, types.int64[::1], _IMAGE, _IMAGE, _BYTES, _BYTES, _FLOATS, _F32, _F32),
    cache=True,
)
def lay_over(
    below: NDArray[np.float32],
    corner: NDArray[np.int64],
    tone: NDArray[np.float32],
    lamp: NDArray[np.float32],
    mask: NDArray[np.uint8],
    rim: NDArray[np.uint8],
    kernel: NDArray[np.float64],
    dark: float,
    light: float,
) -> None:
    """Lay a lit print over an image (H, W), in place.

    ``corner`` are the first column and row of the box (h, w) that it lies in; there ``tone`` is its
    part of the light tone, and ``mask``, 255 for 1, how much of a pixel it covers: blurred where
    ``rim`` says so, borders repeated. ``lamp`` (H, W) is the light on it.
    """
    height, width = mask.shape
    reach = len(kernel) // 2
    n = 2 * reach + 1
    along, known = np.zeros((n, width)), np.full((n, width), -1)
    for v in range(height):
        for u in range(width):
            if rim[v, u]:
                total = 0.0
                for b in range(-reach, reach + 1):
                    row = min(max(v + b, 0), height - 1)
                    k = row % n
                    if known[k, u] != row:
                        added = 0.0
                        for a in range(-reach, reach + 1):
                            added += kernel[a + reach] * mask[row, min(max(u + a, 0), width - 1)]
                        along[k, u], known[k, u] = added, row
                    total += kernel[b + reach] * along[k, u]
                cover = np.float32(total / 255.0)
            else:
                cover = np.float32(mask[v, u] * (1.0 / 255.0))
            y, x = corner[1] + v, corner[0] + u
            if cover > 0.0:
                lit = (dark + (light - dark) * tone[v, u]) * lamp[y, x]
                below[y, x] = cover * lit + (np.float32(1.0) - cover) * below[y, x]


@njit(types.void(_IMAGE, _BYTES, _BYTES, _F32, types.Array(types.uint8, 2, "C")), cache=True)
def mark_lit(
    nodes: NDArray[np.float32],
    near: NDArray[np.uint8],
    rough: NDArray[np.uint8],
    most: float,
    is_lit: NDArray[np.uint8],
) -> None:
    """Mark the pixels (8 H, 8 W) of cells (H, W) near a sheet that its light may reach.

    ``nodes`` (H + 1, W + 1) are reaches at the cells' corners; in rough cells, every pixel counts.
    """
    step = is_lit.shape[0] // near.shape[0]
    for row in range(near.shape[0]):
        for column in range(near.shape[1]):
            if not near[row, column]:
                continue
            a, b = nodes[row, column], nodes[row, column + 1]
            c, d = nodes[row + 1, column], nodes[row + 1, column + 1]
            for i in range(step):
                down = np.float32(i) / np.float32(step)
                left, right = a + down * (c - a), b + down * (d - b)
                for j in range(step):
                    between = left + np.float32(j) / np.float32(step) * (right - left)
                    if rough[row, column] or abs(between) < most:
                        is_lit[step * row + i, step * column + j] = 1


@njit(
    types.void(_IMAGE, _IMAGE, _BYTES, _FLOATS, types.Array(types.uint8, 2, "C")),
    cache=True,
)
def mark_rough(
    reach: NDArray[np.float32],
    peak: NDArray[np.float32],
    known: NDArray[np.uint8],
    limits: NDArray[np.float64],
    rough: NDArray[np.uint8],
) -> None:
    """Mark samples (H, W) around which something jumps, or near the light a line bends.

    ``limits`` (6,): reach at which light ends, faintest peak, jump of reach, jump of peak as a part
    of the highest, second difference, and reach within which that counts.
    """
    band, faintest, step, share, bend, bright = (
        *(limits[0], limits[1], limits[2], limits[3], limits[4], limits[5]),
    )
    height, width = reach.shape
    for v in range(height):
        for u in range(width):
            if not known[v, u]:
                continue
            least, most, nearest, low, high = np.inf, -np.inf, np.inf, np.inf, 0.0
            for i in range(max(v - 1, 0), min(v + 2, height)):
                for j in range(max(u - 1, 0), min(u + 2, width)):
                    if known[i, j]:
                        r, p = reach[i, j], peak[i, j]
                        least, most, nearest = min(least, r), max(most, r), min(nearest, abs(r))
                        low, high = min(low, p), max(high, p)
            jumps = most - least > step or high - low > share * high
            if nearest < band and high > faintest and jumps:
                rough[v, u] = 1
            elif bend > 0.0 and abs(reach[v, u]) < bright:
                r = 2.0 * reach[v, u]
                if 0 < u < width - 1 and known[v, u - 1] and known[v, u + 1]:
                    rough[v, u] |= abs(reach[v, u - 1] + reach[v, u + 1] - r) > bend
                if 0 < v < height - 1 and known[v - 1, u] and known[v + 1, u]:
                    rough[v, u] |= abs(reach[v - 1, u] + reach[v + 1, u] - r) > bend


@njit(types.void(_IMAGE, _IMAGE, _BYTES, _F32, _IMAGE_OUT, _IMAGE_OUT), cache=True)
def fill_between(
    half_reach: NDArray[np.float32],
    half_peak: NDArray[np.float32],
    known: NDArray[np.uint8],
    far: float,
    reach: NDArray[np.float32],
    peak: NDArray[np.float32],
) -> None:
    """Fill pixels (2 H, 2 W) between known samples (H, W); ``far`` where one around is not near."""
    height, width = known.shape
    for row in range(height):
        for column in range(width):
            if not known[row, column]:
                continue
            for b in range(2):
                below = min(row + b, height - 1)
                for a in range(2):
                    beside = min(column + a, width - 1)
                    r, p, is_near = np.float32(0.0), np.float32(0.0), True
                    for i in (row, below):
                        for j in (column, beside):
                            is_near &= known[i, j] and abs(half_reach[i, j]) < far
                            r += half_reach[i, j]
                            p += half_peak[i, j]
                    v, u = 2 * row + b, 2 * column + a
                    reach[v, u] = np.float32(0.25) * r if is_near else far
                    peak[v, u] = np.float32(0.25) * p if is_near else np.float32(0.0)


@njit(types.boolean(_F32, _F32, _F32), cache=True)
def _is_dark(reach: float, peak: float, far: float) -> bool:
    return bool(abs(reach) >= far or (reach == 0.0 and peak == 0.0))


@njit(
    types.void(
        _IMAGE,
        _IMAGE,
        types.Array(types.int32, 2, "C", readonly=True),
        types.Array(types.float32, 3, "C", readonly=True),
        types.Array(types.int64, 1, "C", readonly=True),
        _F32,
        _IMAGE_OUT,
    ),
    cache=True,
)
def add_fine_light(
    reach: NDArray[np.float32],
    peak: NDArray[np.float32],
    edges: NDArray[np.int32],
    edge_light: NDArray[np.float32],
    tile: NDArray[np.int64],
    far: float,
    light: NDArray[np.float32],
) -> None:
    """Add the light of a tile, ``peak * exp(-reach**2 / 2)``, on its fine grid (2 h, 2 w).

    ``tile`` is its first row and column; there may be no reach of some of its rows. Between pixels
    both are interpolated, but there is no light beside a pixel whose reach is ``far`` or of which
    nothing is known; at edges, numbered from 1, the light of the cells is known.
    """
    height, width = reach.shape
    quarter, rest = np.float32(0.25), np.float32(0.75)
    top, left = tile[0], tile[1]
    for row in range(max(-top, 0), min(light.shape[0] // 2, height - top)):
        for column in range(light.shape[1] // 2):
            v, u = top + row, left + column
            edge = edges[v, u]
            if edge > 0:
                for b in range(2):
                    for a in range(2):
                        light[2 * row + b, 2 * column + a] += edge_light[edge - 1, b, a]
                continue
            r0, p0 = reach[v, u], peak[v, u]
            if _is_dark(r0, p0, far):
                continue
            for b in range(2):
                other = min(max(v + 2 * b - 1, 0), height - 1)
                r1, p1 = reach[other, u], peak[other, u]
                for a in range(2):
                    side = min(max(u + 2 * a - 1, 0), width - 1)
                    r2, p2 = reach[v, side], peak[v, side]
                    r3, p3 = reach[other, side], peak[other, side]
                    is_dark = _is_dark(r1, p1, far) or _is_dark(r2, p2, far)
                    if not (is_dark or _is_dark(r3, p3, far)):
                        r = rest * (rest * r0 + quarter * r2) + quarter * (rest * r1 + quarter * r3)
                        p = rest * (rest * p0 + quarter * p2) + quarter * (rest * p1 + quarter * p3)
                        light[2 * row + b, 2 * column + a] += p * math.exp(np.float32(-0.5) * r * r)


@compiled
def plate_height(data: Floats, at: int, x: float, y: float) -> float:
    """Height of a plate: size, tilt, a count, and a polynomial in two cosines."""
    n = int(data[at + 5])
    cos_x = math.cos(math.pi * (x / data[at] + 0.5))
    cos_y = math.cos(math.pi * (y / data[at + 1] + 0.5))
    height = 0.0
    for k in range(n - 1, -1, -1):
        first, along = at + 6 + k * n, 0.0
        for m in range(n - 1, -1, -1):
            along = along * cos_y + data[first + m]
        height = height * cos_x + along
    return float(height - data[at + 2] - data[at + 3] * x - data[at + 4] * y)


@compiled
def plate_slopes(data: Floats, at: int, x: float, y: float) -> tuple[float, float]:
    """Slopes of a plate."""
    n = int(data[at + 5])
    angle_x, angle_y = math.pi * (x / data[at] + 0.5), math.pi * (y / data[at + 1] + 0.5)
    cos_x, cos_y = math.cos(angle_x), math.cos(angle_y)
    height, by_x, by_y = 0.0, 0.0, 0.0
    for k in range(n - 1, -1, -1):
        first, along, rise = at + 6 + k * n, 0.0, 0.0
        for m in range(n - 1, -1, -1):
            rise = rise * cos_y + along
            along = along * cos_y + data[first + m]
        by_x = by_x * cos_x + height
        height = height * cos_x + along
        by_y = by_y * cos_x + rise
    by_x *= -math.pi / data[at] * math.sin(angle_x)
    by_y *= -math.pi / data[at + 1] * math.sin(angle_y)
    return by_x - data[at + 3], by_y - data[at + 4]


@compiled
def waves_over(data: Floats, at: int, x: float, y: float) -> Three:
    """Height and slopes of a wavy plate: size, highest, steepest, count, then four a wave."""
    height, slope_x, slope_y = 0.0, 0.0, 0.0
    for k in range(int(data[at + 4])):
        w = at + 5 + 4 * k
        angle = data[w] * x + data[w + 1] * y + data[w + 2]
        height += data[w + 3] * math.sin(angle)
        rise = data[w + 3] * math.cos(angle)
        slope_x += rise * data[w]
        slope_y += rise * data[w + 1]
    return height, slope_x, slope_y


@compiled
def meet_plate(data: Floats, at: int, start: Three, ray: Three) -> float:
    """Distance along a ray to a plate, both in its frame; infinite for none."""
    if ray[2] >= 0.0 or start[2] <= 0.0:
        return np.inf
    reach = -start[2] / ray[2]
    x, y = start[0] + reach * ray[0], start[1] + reach * ray[1]
    if abs(x) > 0.5 * data[at] or abs(y) > 0.5 * data[at + 1]:
        return np.inf
    if data[at + 5] == 0.0:
        return reach
    return float(reach + plate_height(data, at, x, y) / ray[2])


@compiled
def meet_waves(data: Floats, at: int, start: Three, ray: Three) -> float:
    """As `meet_plate`, to a wavy plate; see `WavyPlate.intersect`."""
    highest = data[at + 2]
    if ray[2] >= 0.0 or start[2] <= highest:
        return np.inf
    reach = (highest - start[2]) / ray[2]
    rate = -ray[2] + data[at + 3] * math.hypot(ray[0], ray[1])
    is_close = False
    for _ in range(_WALK_STEPS):
        x, y = start[0] + reach * ray[0], start[1] + reach * ray[1]
        above = start[2] + reach * ray[2] - waves_over(data, at, x, y)[0]
        reach += above / rate
        if above <= _WALK_CLOSE_MM:
            is_close = True
            break
    if not is_close:
        return np.inf
    for _ in range(_NEWTON_STEPS):
        x, y = start[0] + reach * ray[0], start[1] + reach * ray[1]
        height, slope_x, slope_y = waves_over(data, at, x, y)
        falling = slope_x * ray[0] + slope_y * ray[1] - ray[2]
        step = (start[2] + reach * ray[2] - height) / falling if falling > _STEEP else 0.0
        reach += min(max(step, -10.0 * _WALK_CLOSE_MM), 10.0 * _WALK_CLOSE_MM)
    x, y = start[0] + reach * ray[0], start[1] + reach * ray[1]
    is_on = abs(x) <= 0.5 * data[at] and abs(y) <= 0.5 * data[at + 1]
    return float(reach) if is_on else np.inf


@compiled
def meet_box(data: Floats, at: int, start: Three, ray: Three) -> float:
    """As `meet_plate`, to a block: its size."""
    enter, leave = -np.inf, np.inf
    for axis in range(3):
        half = 0.5 * data[at + axis]
        from_middle = start[axis] - (half if axis == 2 else 0.0)
        if ray[axis] == 0.0:
            if abs(from_middle) > half:
                return np.inf
            continue
        a, b = (-half - from_middle) / ray[axis], (half - from_middle) / ray[axis]
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter if enter < leave and enter > 0.0 else np.inf


@compiled
def meet_sphere(data: Floats, at: int, start: Three, ray: Three) -> float:
    """As `meet_plate`, to a ball: its centre and radius."""
    x, y, z = start[0] - data[at], start[1] - data[at + 1], start[2] - data[at + 2]
    b = x * ray[0] + y * ray[1] + z * ray[2]
    root = b * b - (x * x + y * y + z * z - data[at + 3] ** 2)
    reach = -b - math.sqrt(max(root, 0.0))
    return float(reach) if root > 0.0 and reach > 0.0 else np.inf


@compiled
def meet_print(data: Floats, at: int, start: Three, ray: Three) -> float:
    """As `meet_plate`, to a print, seen from below: its extent."""
    if ray[2] <= 0.0 or start[2] >= 0.0:
        return np.inf
    reach = -start[2] / ray[2]
    x, y = start[0] + reach * ray[0], start[1] + reach * ray[1]
    is_on = data[at] <= x <= data[at + 2] and data[at + 1] <= y <= data[at + 3]
    return float(reach) if is_on else np.inf


@compiled
def meet_floor(data: Floats, at: int, start: Three, ray: Three) -> float:
    """As `meet_plate`, to a plane: a point and its normal."""
    nx, ny, nz = data[at + 3], data[at + 4], data[at + 5]
    along = ray[0] * nx + ray[1] * ny + ray[2] * nz
    height = (
        (start[0] - data[at]) * nx + (start[1] - data[at + 1]) * ny + (start[2] - data[at + 2]) * nz
    )
    return float(-height / along) if along < 0.0 and height > 0.0 else np.inf
