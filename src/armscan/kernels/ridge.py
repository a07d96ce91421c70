# SPDX-License-Identifier: Apache-2.0
"""Ridge points: runs of pixels above the background, then Newton steps (eq. 2.41)."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    COLUMN,
    ROW,
    BytesOut,
    Floats,
    FloatsOut,
    Image,
    ImageOut,
    IntsOut,
    Mask,
    Row,
    RowOut,
    Table,
    TableOut,
    compiled,
)

VALLEY_RATIO = 0.5
"""A dip below this share of the peak splits a run into two lines."""


@compiled()
def interpolate_columns(grid: Image, cell_px: int, i: int, row: RowOut) -> None:
    """Write row ``i`` of the grid, interpolated linearly between cell centres, to ``row`` (W,)."""
    columns = grid.shape[1]
    for x in range(row.shape[0]):
        u = min(max((x + 0.5) / cell_px - 0.5, 0.0), columns - 1.0)
        k = min(int(u), max(columns - 2, 0))
        m = min(k + 1, columns - 1)
        row[x] = grid[i, k] + (u - k) * (grid[i, m] - grid[i, k])


@compiled()
def hump_centre(
    levels: Floats, first: int, last: int, place: int, background: float, peak: float
) -> float:
    """Centroid of what rises above half of the peak, so that a bright ground does not pull it.

    ``levels``: Grey levels, of which ``first`` to ``last`` count. ``place``: That of level 0.
    """
    floor = background + 0.5 * peak
    weight = moment = 0.0
    for k in range(first, last + 1):
        above = max(levels[k] - floor, 0.0)
        weight += above
        # of whole places, so that the middle between two pixels stays exactly there
        moment += above * (place + k)
    return moment / weight if weight > 0.0 else place + 0.5 * (first + last)


@compiled()
def split_run(
    image: Image,
    axis: int,
    line: int,
    first: int,
    last: int,
    background: float,
    rise: float,
    levels: FloatsOut,
    runs: TableOut,
    count: int,
) -> int:
    """Append the centre of each hump of one run; return the new count.

    A run is split where the three-pixel mean dips below half of the peaks on both sides, so that
    two lines that share a foot become two candidates.

    ``image``: (H, W) grey levels. ``axis``, ``line``, ``first``, ``last``: The run: pixels
    ``first..last`` of column (axis 0) or row (axis 1) ``line``. ``background``, ``rise``: Local
    background, and the height above it at which the run was cut. ``levels``: Scratch, of the run's
    length and two more. ``runs``: (capacity, 3) output rows ``x, y, axis``; rows beyond the
    capacity are counted only. ``count``: Rows used so far.
    """
    n = last - first + 1
    for k in range(n):
        levels[k + 1] = image[first + k, line] if axis == COLUMN else image[line, first + k]
    levels[0] = levels[1]
    levels[n + 1] = levels[n]
    peak = 0.0
    low = np.inf
    low_at = start = 1
    for k in range(1, n + 2):
        is_end = k > n
        smooth = 0.0
        if not is_end:
            smooth = (levels[k] + levels[k - 1] + levels[k + 1]) / 3.0 - background
        if is_end or (low < VALLEY_RATIO * peak and smooth > 2.0 * low + rise):
            if count < runs.shape[0]:
                stop = n if is_end else low_at
                centre = hump_centre(levels, start, stop, first - 1, background, peak)
                runs[count, 0] = line if axis == COLUMN else centre
                runs[count, 1] = centre if axis == COLUMN else line
                runs[count, 2] = axis
            count += 1
            start = low_at
            peak = 0.0
        if smooth >= peak:
            peak = smooth
            low = np.inf
        if smooth < low:
            low = smooth
            low_at = k
    return count


ROUNDING = 1e-3
"""Of the threshold, in grey levels."""


@compiled()
def is_any_above(pixels: Row, level: float) -> bool:
    """True if one of some pixels is brighter."""
    limit = np.float32(level)
    count = np.int32(0)
    for k in range(pixels.shape[0]):
        count += np.int32(pixels[k] > limit)
    return bool(count > 0)


@compiled()
def mark_lit(
    pixels: Row, upper: Row, lower: Row, fraction: float, lift: float, is_lit: BytesOut
) -> None:
    """Mark pixels above the background, which lies between that of two rows of cells, by more than
    ``lift``.
    """
    share = np.float32(fraction)
    rise = np.float32(lift)
    for k in range(pixels.shape[0]):
        is_lit[k] = pixels[k] > upper[k] + share * (lower[k] - upper[k]) + rise


@compiled()
def find_runs(
    image: Image,
    background: Image,
    is_lit_cell: Mask,
    cell_px: int,
    rise: float,
    longest_px: int,
    runs: TableOut,
) -> int:
    """Find runs of pixels more than ``rise`` above the background in one pass over the image.

    ``image``: (H, W) grey levels. ``background``: (rows, columns) background per cell of
    ``cell_px`` pixels, interpolated in between. ``is_lit_cell``: (rows, columns) 0 for cells that
    are passed over unread. ``cell_px``: Side of a cell. ``rise``:
    Height above the background. ``longest_px``: Longer runs are no cross-sections of a line and are
    left out. ``runs``: (capacity, 3) output rows: ``x, y`` of the centroid above the threshold, and
    the axis (0: the run goes down a column, 1: along a row).

    Returns count of candidates; more than the capacity if the output was too short.
    """
    height, width = image.shape
    n_cells = -(-width // cell_px)
    quiet = np.zeros(n_cells)
    levels = np.zeros(longest_px + 2)
    upper = np.zeros(width, np.float32)
    lower = np.zeros(width, np.float32)
    n_words = -(-width // 8)
    is_lit = np.zeros(8 * n_words, np.uint8)
    words = is_lit.view(np.int64)
    n_open = np.zeros(n_words, np.int64)
    above = -1
    start = np.full(width, -1, np.int64)
    count = 0
    lift = np.float32(rise)
    fraction = np.float32(0.0)
    n_columns = 0
    for y in range(height + 1):
        row_start = -1
        is_lit[:] = 0
        if n_columns == 0 and (y == height or not is_lit_cell[y // cell_px].any()):
            continue
        if y < height:
            v = min(max((y + 0.5) / cell_px - 0.5, 0.0), background.shape[0] - 1.0)
            cell = int(v)
            if cell != above:
                interpolate_columns(background, cell_px, cell, upper)
                following = min(cell + 1, background.shape[0] - 1)
                interpolate_columns(background, cell_px, following, lower)
                above = cell
                for k in range(n_cells):
                    own = slice(k * cell_px, min((k + 1) * cell_px, width))
                    quiet[k] = min(upper[own].min(), lower[own].min()) + rise - ROUNDING
            fraction = np.float32(v - cell)
            row = image[y]
            for k in range(n_cells):
                # most of the image is dark, and is passed over by a cell's width at once
                low = k * cell_px
                high = min(low + cell_px, width)
                if is_lit_cell[y // cell_px, k] and is_any_above(row[low:high], quiet[k]):
                    own = slice(low, high)
                    mark_lit(row[own], upper[own], lower[own], v - cell, rise, is_lit[low:])
        for word in range(n_words):
            if words[word] == 0 and n_open[word] == 0 and row_start < 0:
                continue
            for x in range(8 * word, min(8 * word + 8, width)):
                if is_lit[x]:
                    if start[x] < 0:
                        start[x] = y
                        n_open[word] += 1
                        n_columns += 1
                    if row_start < 0:
                        row_start = x
                    if x < width - 1:
                        continue
                    stop = x
                else:
                    if start[x] >= 0:
                        if y - start[x] <= longest_px:
                            base = float(upper[x] + fraction * (lower[x] - upper[x]) + lift) - rise
                            count = split_run(
                                image, COLUMN, x, start[x], y - 1, base, rise, levels, runs, count
                            )
                        start[x] = -1
                        n_open[word] -= 1
                        n_columns -= 1
                    stop = x - 1
                if row_start >= 0:
                    if stop - row_start < longest_px:
                        base = float(upper[x] + fraction * (lower[x] - upper[x]) + lift) - rise
                        count = split_run(
                            image, ROW, y, row_start, stop, base, rise, levels, runs, count
                        )
                    row_start = -1
    return count


REACH_SIGMAS = 3.5
"""Taps cut at 3 sigma lock to pixels by 0.02 px, at 3.5 sigma by 0.003 px."""
STEEPNESS_SLACK = 0.85
REPEAT_PX = 1.5
ROUNDS = 3
LANES = 8


def gaussian_taps(sigma_px: float) -> Image:
    """Sampled Gaussian and its first two derivatives, (3, 2 r + 1) with r = 3.5 sigma.

    Scaled so that a constant, a ramp and a parabola give their exact derivatives.
    """
    radius = math.ceil(REACH_SIGMAS * sigma_px)
    k = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = np.exp(-0.5 * (k / sigma_px) ** 2)
    smooth /= smooth.sum()
    slope = k * smooth
    slope /= (k * slope).sum()
    bend = (k * k - (k * k * smooth).sum()) * smooth
    bend /= 0.5 * (k * k * bend).sum()
    return np.stack([smooth, slope, bend]).astype(np.float32)


@compiled(fastmath=True)
def smooth_columns(
    image: Image, left: int, n: int, y: int, taps: Image, radius: int, columns: ImageOut
) -> None:
    """Smooth and differentiate ``n`` columns from ``left`` on, once and twice, down around ``y``.

    ``image``: (H, W) grey levels, of which the columns are a part; beyond its first and last row it
    is continued constantly. ``taps``: (3, m) from `gaussian_taps`. ``radius``: Theirs; more columns
    of the taps are 0. ``columns``: (3, >= n) output.
    """
    height = image.shape[0]
    # views, because an index that might be negative keeps the loops from being vectorised
    down0, down1, down2 = columns[0, :n], columns[1, :n], columns[2, :n]
    middle = image[y, left : left + n]
    smooth, bend = taps[0, radius], taps[2, radius]
    for i in range(n):
        down0[i] = smooth * middle[i]
        down1[i] = np.float32(0.0)
        down2[i] = bend * middle[i]
    for j in range(1, radius + 1):
        upper = image[max(y - j, 0), left : left + n]
        lower = image[min(y + j, height - 1), left : left + n]
        smooth, slope, bend = taps[0, radius + j], taps[1, radius + j], taps[2, radius + j]
        for i in range(n):
            both = lower[i] + upper[i]
            apart = lower[i] - upper[i]
            down0[i] += smooth * both
            down1[i] += slope * apart
            down2[i] += bend * both


@compiled(fastmath=True)
def smooth_border(
    image: Image, left: int, n: int, y: int, taps: Image, radius: int, columns: ImageOut
) -> None:
    """As `smooth_columns`, of columns of which some lie beyond the image's border."""
    height, width = image.shape
    columns[:, :n] = np.float32(0.0)
    for j in range(2 * radius + 1):
        row = min(max(y + j - radius, 0), height - 1)
        for i in range(n):
            value = image[row, min(max(left + i, 0), width - 1)]
            columns[0, i] += taps[0, j] * value
            columns[1, i] += taps[1, j] * value
            columns[2, i] += taps[2, j] * value


@compiled(fastmath=True)
def derivatives_at(
    image: Image,
    x: int,
    y: int,
    taps: Image,
    radius: int,
    columns: ImageOut,
    result: FloatsOut,
) -> None:
    """Smoothed derivatives at one pixel; beyond the border the image is continued constantly.

    ``image``: (H, W) grey levels. ``x``, ``y``: Pixel. ``taps``: (3, m) from `gaussian_taps`, of
    which the first 2 radius + 1 columns count and the rest is 0.
    ``columns``: (3, >= m) scratch. ``result``: (5,) output: d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2.
    """
    m = taps.shape[1]
    left = x - radius
    if left >= 0 and left + m <= image.shape[1]:
        smooth_columns(image, left, m, y, taps, radius, columns)
    else:
        smooth_border(image, left, m, y, taps, radius, columns)
    down0, down1, down2 = columns[0, :m], columns[1, :m], columns[2, :m]
    taps0, taps1, taps2 = taps[0], taps[1], taps[2]
    gx = gy = gxx = gxy = gyy = np.float32(0.0)
    for i in range(m):
        gx += taps1[i] * down0[i]
        gxx += taps2[i] * down0[i]
        gxy += taps1[i] * down1[i]
        gy += taps0[i] * down1[i]
        gyy += taps0[i] * down2[i]
    result[0] = gx
    result[1] = gy
    result[2] = gxx
    result[3] = gxy
    result[4] = gyy


@compiled(fastmath=True)
def derivatives_along(
    image: Image,
    x: int,
    n: int,
    y: int,
    taps: Image,
    radius: int,
    columns: ImageOut,
    result: ImageOut,
) -> None:
    """As `derivatives_at`, at ``n`` pixels of a row from ``x`` on, which share their columns.

    All columns lie inside the image. ``columns``: (3, >= n + 2 radius) scratch. ``result``:
    (5, >= n) output.
    """
    smooth_columns(image, x - radius, n + 2 * radius, y, taps, radius, columns)
    gx, gy, gxx, gxy, gyy = (
        result[0, :n],
        result[1, :n],
        result[2, :n],
        result[3, :n],
        result[4, :n],
    )
    result[:, :n] = np.float32(0.0)
    for i in range(2 * radius + 1):
        down0, down1, down2 = columns[0, i : i + n], columns[1, i : i + n], columns[2, i : i + n]
        smooth, slope, bend = taps[0, i], taps[1, i], taps[2, i]
        for k in range(n):
            gx[k] += slope * down0[k]
            gxx[k] += bend * down0[k]
            gxy[k] += slope * down1[k]
            gy[k] += smooth * down1[k]
            gyy[k] += smooth * down2[k]


NO_RIDGE, FOUND, MOVED = range(3)


@compiled()
def step_across(derivatives: Floats, x: int, y: int, radius: int, result: FloatsOut) -> int:
    """One Newton step across the line from a pixel.

    The eigenvector of the eigenvalue of largest curvature is the normal ``n``; along it the Taylor
    polynomial has its maximum at ``t = -(g . n) / (n' H n)``.

    ``derivatives``: (5,) of `derivatives_at`. ``result``: (5,) output: x, y, normal x, normal y,
    negative second derivative along the normal; x and y alone where the step leaves the pixel.
    Returns `NO_RIDGE`, `FOUND`, or `MOVED`.
    """
    half = 0.5 * (derivatives[2] - derivatives[4])
    gxy = derivatives[3]
    root = math.sqrt(half * half + gxy * gxy)
    bend = 0.5 * (derivatives[2] + derivatives[4]) - root
    if bend >= 0.0 or root <= 0.0:
        return NO_RIDGE
    nx = root - half if half < 0.0 else -gxy
    ny = -gxy if half < 0.0 else root + half
    length = math.sqrt(nx * nx + ny * ny)
    nx /= length
    ny /= length
    step = -(derivatives[0] * nx + derivatives[1] * ny) / bend
    dx = step * nx
    dy = step * ny
    result[0] = x + dx
    result[1] = y + dy
    if abs(dx) <= 0.6 and abs(dy) <= 0.6:
        result[2] = nx
        result[3] = ny
        result[4] = -bend
        return FOUND
    return NO_RIDGE if abs(step) > radius else MOVED


@compiled()
def step_to_ridge(
    image: Image,
    x: int,
    y: int,
    rounds: int,
    taps: Image,
    radius: int,
    scratch: ImageOut,
    derivatives: FloatsOut,
    result: FloatsOut,
) -> bool:
    """Walk from a pixel to the nearest ridge; False if there is none.

    The expansion point is moved while the step leaves its pixel, in so many ``rounds`` at most.

    ``image``, ``taps``, ``radius``, ``scratch``: As for `derivatives_at`. ``derivatives``: (5,)
    scratch. ``result``: (5,) output of `step_across`.
    """
    height, width = image.shape
    for _ in range(rounds):
        if x < 0 or y < 0 or x >= width or y >= height:
            return False
        derivatives_at(image, x, y, taps, radius, scratch, derivatives)
        state = step_across(derivatives, x, y, radius, result)
        if state != MOVED:
            return state == FOUND
        x = math.floor(result[0] + 0.5)
        y = math.floor(result[1] + 0.5)
    return False


BLOCK_PX = 32
"""Columns by which candidates of a row are sorted, and so found together."""
MOST_BLOCKS = 3
"""Blocks of a row that are looked at together where a line runs along it."""
MOST_APART = 6
"""Pixels of a row for each candidate up to which its columns are smoothed together."""
SHARED_FROM = 3
"""Candidates beside each other from which on sharing columns is worth its time."""


@compiled()
def sort_candidates(runs: Table, n_runs: int, cell: IntsOut, order: IntsOut) -> int:
    """Sort candidates by row, and by block of columns within it.

    ``runs``, ``n_runs``: As for `refine_candidates`. ``cell``: (n_runs,) output: number of the row
    and block of each. ``order``: (n_runs,) output: candidates by rising cell. Returns count of
    blocks of a row.
    """
    blocks = rows = 0
    for r in range(n_runs):
        blocks = max(blocks, math.floor(runs[r, 0] + 0.5) // BLOCK_PX + 1)
        rows = max(rows, math.floor(runs[r, 1] + 0.5) + 1)
    place = np.zeros(rows * blocks + 1, np.int64)
    for r in range(n_runs):
        own = math.floor(runs[r, 1] + 0.5) * blocks + math.floor(runs[r, 0] + 0.5) // BLOCK_PX
        cell[r] = own
        place[own + 1] += 1
    for k in range(rows * blocks):
        place[k + 1] += place[k]
    for r in range(n_runs):
        order[place[cell[r]]] = r
        place[cell[r]] += 1
    return blocks


@compiled()
def find_ridges(image: Image, runs: Table, n_runs: int, taps: Image, ridges: TableOut) -> None:
    """Walk from each candidate to its ridge; ``ridges``: (n_runs, 5) output, 0 where there is none.

    The others: As for `refine_candidates` and `step_across`.
    """
    height, width = image.shape
    radius = taps.shape[1] // 2
    # whole registers: what is left over of a row would take as long as the rest
    padded = np.zeros((3, -(-taps.shape[1] // LANES) * LANES), np.float32)
    padded[:, : taps.shape[1]] = taps
    widest = MOST_BLOCKS * BLOCK_PX
    scratch = np.zeros((3, max(widest + 2 * radius, padded.shape[1])), np.float32)
    along = np.zeros((5, widest), np.float32)
    derivatives = np.zeros(5)
    cell = np.zeros(n_runs, np.int64)
    order = np.zeros(n_runs, np.int64)
    blocks = sort_candidates(runs, n_runs, cell, order)
    first = 0
    while first < n_runs:
        stop = first
        low, high = width, -1
        row = cell[order[first]] // blocks
        last = min(cell[order[first]] + MOST_BLOCKS, (row + 1) * blocks)
        while stop < n_runs and cell[order[stop]] < last:
            x = math.floor(runs[order[stop], 0] + 0.5)
            low, high = min(low, x), max(high, x)
            stop += 1
        n = high - low + 1
        is_shared = (stop - first >= SHARED_FROM) & (n <= MOST_APART * (stop - first))
        is_shared &= (low >= radius) & (high + radius < width) & (0 <= row < height)
        if is_shared:
            derivatives_along(image, low, n, row, padded, radius, scratch, along)
        for k in range(first, stop):
            r = order[k]
            x = math.floor(runs[r, 0] + 0.5)
            y = math.floor(runs[r, 1] + 0.5)
            state = MOVED
            rounds = ROUNDS
            if is_shared:
                for m in range(5):
                    derivatives[m] = along[m, x - low]
                state = step_across(derivatives, x, y, radius, ridges[r])
                x = math.floor(ridges[r, 0] + 0.5)
                y = math.floor(ridges[r, 1] + 0.5)
                rounds -= 1
            if state == MOVED:
                is_found = step_to_ridge(
                    image, x, y, rounds, padded, radius, scratch, derivatives, ridges[r]
                )
                state = FOUND if is_found else NO_RIDGE
            if state != FOUND:
                ridges[r, 4] = 0.0
        first = stop


@compiled()
def refine_candidates(
    image: Image,
    runs: Table,
    n_runs: int,
    taps: Image,
    least_bend: float,
    points: TableOut,
) -> int:
    """Ridge point in the column or row of each candidate.

    A column candidate is kept where the line is rather horizontal, a row candidate where it is
    rather vertical, with some overlap around the diagonal so that none is lost there.

    ``image``: (H, W) grey levels. ``runs``: (>= n_runs, 3) from `find_runs`. ``n_runs``: Candidates
    to use. ``taps``: (3, m) from `gaussian_taps`. ``least_bend``: Smallest negative second
    derivative across the line. ``points``: (>= n_runs, 6) output rows: x, y, normal x, normal y,
    negative second derivative, axis. The coordinate along the axis 0 (column) or 1 (row) that names
    the pixel line is whole.

    Returns count of points.
    """
    height, width = image.shape
    latest = np.full((2, max(height, width)), -1e9)
    ridges = np.zeros((n_runs, 5))
    find_ridges(image, runs, n_runs, taps, ridges)
    count = 0
    for r in range(n_runs):
        is_row = runs[r, 2] == ROW
        side = ROW if is_row else COLUMN
        ridge = ridges[r]
        if ridge[4] <= 0.0:
            continue
        if ridge[4] < least_bend:
            continue
        nx = abs(ridge[2])
        ny = abs(ridge[3])
        if (nx if is_row else ny) < STEEPNESS_SLACK * (ny if is_row else nx):
            continue
        if is_row:
            line = int(runs[r, 1])
            centre = ridge[0] - (line - ridge[1]) * ridge[3] / ridge[2]
        else:
            line = int(runs[r, 0])
            centre = ridge[1] - (line - ridge[0]) * ridge[2] / ridge[3]
        if abs(centre - latest[side, line]) < REPEAT_PX:
            continue
        if centre < 0.0 or centre > (width if is_row else height) - 1:
            continue
        latest[side, line] = centre
        points[count, 0] = centre if is_row else line
        points[count, 1] = line if is_row else centre
        points[count, 2] = ridge[2]
        points[count, 3] = ridge[3]
        points[count, 4] = ridge[4]
        points[count, 5] = side
        count += 1
    return count


@compiled()
def sample_across(
    image: Image, points: Table, across_px: Floats, along_px: Floats, profiles: TableOut
) -> None:
    """Grey levels across ridges, linear between pixels, constant beyond the border.

    ``image``: (H, W) grey levels. ``points``: (N, >= 4) x, y, normal. ``across_px``: (K,) places
    along the normal. ``along_px``: (M,) places along the tangent, of which the mean is taken.
    ``profiles``: (N, K) output.
    """
    height, width = image.shape
    n_along = along_px.shape[0]
    for i in range(points.shape[0]):
        nx, ny = points[i, 2], points[i, 3]
        for k in range(across_px.shape[0]):
            total = 0.0
            for m in range(n_along):
                x = points[i, 0] + nx * across_px[k] - ny * along_px[m]
                y = points[i, 1] + ny * across_px[k] + nx * along_px[m]
                x = min(max(x, 0.0), width - 1.0)
                y = min(max(y, 0.0), height - 1.0)
                u, v = int(x), int(y)
                right, below = min(u + 1, width - 1), min(v + 1, height - 1)
                fx, fy = x - u, y - v
                upper = image[v, u] + fx * (image[v, right] - image[v, u])
                lower = image[below, u] + fx * (image[below, right] - image[below, u])
                total += upper + fy * (lower - upper)
            profiles[i, k] = total / n_along
