# SPDX-License-Identifier: Apache-2.0
"""Ridge points: runs of pixels above the background, then Newton steps (eq. 2.41)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils as numba_code
from numba.extending import intrinsic

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


@compiled()
def copy_cells(source: Mask, is_copied: Mask, cell_px: int, factor: float, image: ImageOut) -> None:
    """Copy the pixels of some cells of an image of eight bits.

    ``source``: (H, W). ``is_copied``: (rows, columns) 0 for cells of ``cell_px`` pixels that stay
    as they are. ``factor``: By which grey levels are multiplied. ``image``: (H, W) output.
    """
    height, width = source.shape
    columns = is_copied.shape[1]
    share = np.float32(factor)
    for y in range(height):
        cells = is_copied[y // cell_px]
        first = 0
        while first < columns:
            stop = first
            while stop < columns and cells[stop] != 0:
                stop += 1
            span = slice(first * cell_px, min(stop * cell_px, width))
            own, row = source[y, span], image[y, span]
            for k in range(own.shape[0]):
                row[k] = np.float32(own[k]) * share
            first = stop + 1


@compiled()
def rank_cells(image: Mask, cell_px: int, step_px: int, rank: int, levels: ImageOut) -> None:
    """Grey level of a rank, from 0 on, among the sampled pixels of each cell.

    ``image``: (H, W). ``cell_px``: Side of a cell. ``step_px``: Every so many rows and columns are
    sampled; what a cell lacks at the border, the last of them stand for. ``levels``: (rows,
    columns) output.
    """
    last_row, last_column = (image.shape[0] - 1) // step_px, (image.shape[1] - 1) // step_px
    side = cell_px // step_px
    counts = np.zeros(256, np.int64)
    for r in range(levels.shape[0]):
        for c in range(levels.shape[1]):
            counts[:] = 0
            for i in range(side):
                row = image[min(r * side + i, last_row) * step_px]
                for j in range(side):
                    counts[row[min(c * side + j, last_column) * step_px]] += 1
            level, total = 0, counts[0]
            while total <= rank:
                level += 1
                total += counts[level]
            levels[r, c] = np.float32(level)


@compiled()
def read_steps(
    image: Mask, row_step: int, column_step: int, lag: int, steps: ImageOut, counts: IntsOut
) -> None:
    """How much pixels of an image (H, W) differ from those ``lag`` columns before them.

    ``row_step``, ``column_step``: Every so many are sampled. ``steps``: (rows, columns) output.
    ``counts``: (256,) output: how many there are of each.
    """
    counts[:] = 0
    for i in range(steps.shape[0]):
        row = image[i * row_step]
        for k in range(steps.shape[1]):
            # of bytes themselves, differences would have no sign
            x = k * column_step
            step = abs(np.int64(row[x + lag]) - np.int64(row[x]))
            steps[i, k] = np.float32(step)
            counts[step] += 1


@compiled()
def count_bright(
    image: Mask, is_looked_at: Mask, cell_px: int, step_px: int, limit: int, counts: IntsOut
) -> None:
    """Count the grey levels above a limit of every so many pixels of some cells.

    ``image``: (H, W). ``is_looked_at``: (rows, columns) 0 for cells that are passed over unread.
    ``cell_px``: Side of a cell, a multiple of ``step_px``. ``counts``: (256,) output.
    """
    counts[:] = 0
    width = image.shape[1]
    for y in range(0, image.shape[0], step_px):
        cells, row = is_looked_at[y // cell_px], image[y]
        for c in range(cells.shape[0]):
            if cells[c] == 0:
                continue
            for x in range(c * cell_px, min((c + 1) * cell_px, width), step_px):
                if row[x] > limit:
                    counts[row[x]] += 1


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


ALL_LIT = 0x0101010101010101
"""Eight pixels, each marked by a byte."""
ROUNDING = 1e-3
"""Of the threshold, in grey levels."""


@compiled(fastmath=True)
def is_any_above(pixels: Row, level: float) -> bool:
    """True if one of some pixels is brighter."""
    limit = np.float32(level)
    # of single precision, whose sums are vectorised
    count = np.float32(0.0)
    for k in range(pixels.shape[0]):
        count += np.float32(1.0) if pixels[k] > limit else np.float32(0.0)
    return bool(count > np.float32(0.0))


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
    left out. ``runs``: (capacity, 3) output rows: ``x, y`` of the centroid above half its peak, and
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
    is_lit, was_lit = np.zeros(8 * n_words, np.uint8), np.zeros(8 * n_words, np.uint8)
    above = -1
    start = np.full(width, -1, np.int64)
    count = 0
    lift = np.float32(rise)
    fraction = np.float32(0.0)
    n_columns = 0
    for y in range(height + 1):
        row_start = -1
        is_lit, was_lit = was_lit, is_lit
        is_lit[:] = 0
        words, before = is_lit.view(np.int64), was_lit.view(np.int64)
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
            # pixels that are dark, or lit, as those above and before them, begin and end nothing
            same = ALL_LIT if row_start >= 0 and word < n_words - 1 else 0
            if words[word] == same and before[word] == same and (same != 0 or row_start < 0):
                continue
            for x in range(8 * word, min(8 * word + 8, width)):
                if is_lit[x]:
                    if start[x] < 0:
                        start[x] = y
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
"""Least of the normal's component across the run, over the other one."""
REPEAT_PX = 1.5
ROUNDS = 3


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


PATCH_LANES = 8
"""Columns of a patch that are summed together, in one register."""
FAST = ("fast",)
cg: Any = numba_code
"""Numba's own parts of code; without types."""


class _Lanes:
    """Instructions on rows of `PATCH_LANES` numbers of single precision."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder
        self.place = ir.IntType(64)
        self.row = ir.VectorType(ir.FloatType(), PATCH_LANES)
        self.zero = ir.Constant(self.row, [0.0] * PATCH_LANES)
        self._undefined = ir.Constant(self.row, ir.Undefined)
        self._first = ir.Constant(ir.VectorType(ir.IntType(32), PATCH_LANES), [0] * PATCH_LANES)

    def load(self, data: Any, at: Any) -> Any:
        """A row from a place on."""
        where = self.builder.gep(data, [at])
        return self.builder.load(self.builder.bitcast(where, self.row.as_pointer()), align=4)

    def repeat(self, data: Any, at: Any) -> Any:
        """A row of one number."""
        one = self.builder.load(self.builder.gep(data, [at]))
        first = ir.Constant(ir.IntType(32), 0)
        row = self.builder.insert_element(self._undefined, one, first)
        return self.builder.shuffle_vector(row, self._undefined, self._first)

    def add_product(self, total: Any, a: Any, b: Any) -> None:
        """Add the product of two rows to a sum in memory."""
        product = self.builder.fmul(a, b, flags=FAST)
        before = self.builder.load(total)
        self.builder.store(self.builder.fadd(before, product, flags=FAST), total)

    def sum(self, total: Any) -> Any:
        """Sum of the numbers of a row in memory."""
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), self.row])
        name = f"llvm.vector.reduce.fadd.v{PATCH_LANES}f32"
        reduce = cg.get_or_insert_function(self.builder.module, kind, name)
        start = ir.Constant(ir.FloatType(), 0.0)
        return self.builder.call(reduce, [start, self.builder.load(total)], fastmath=FAST)


def _sum_patch(
    typing: Any, image: Any, first: Any, taps: Any, radius: Any, sums: Any
) -> tuple[Any, Any]:
    """Sums of a patch times the five products of the taps, of which the compiler is told how.

    What plain loops take several times as long for: short ones with several sums.

    ``first``: Place of the middle row's first pixel in the image. The others: As for
    `derivatives_at`; the patch and the columns beside it up to whole lanes lie in the image.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = _Lanes(builder)
        images, tap_rows, out = (
            context.make_array(signature.args[k])(context, builder, args[k]) for k in (0, 2, 4)
        )
        width = cg.unpack_tuple(builder, images.shape, 2)[1]
        m = cg.unpack_tuple(builder, tap_rows.shape, 2)[1]
        row_of = [builder.mul(m, ir.Constant(lanes.place, k)) for k in range(3)]
        middle = [builder.add(row, args[3]) for row in row_of]
        totals = [cg.alloca_once_value(builder, lanes.zero) for _ in range(5)]
        n_groups = builder.sdiv(m, ir.Constant(lanes.place, PATCH_LANES))
        down = [cg.alloca_once_value(builder, lanes.zero) for _ in range(3)]
        one = ir.Constant(lanes.place, 1)
        with cg.for_range(builder, n_groups) as group:
            left = builder.mul(group.index, ir.Constant(lanes.place, PATCH_LANES))
            at = builder.add(args[1], left)
            for total in down:
                builder.store(lanes.zero, total)
            for k in (0, 2):
                lanes.add_product(
                    down[k], lanes.repeat(tap_rows.data, middle[k]), lanes.load(images.data, at)
                )
            with cg.for_range(builder, args[3]) as row:
                j = builder.add(row.index, one)
                away = builder.mul(j, width)
                lower = lanes.load(images.data, builder.add(at, away))
                upper = lanes.load(images.data, builder.sub(at, away))
                both = builder.fadd(lower, upper, flags=FAST)
                apart = builder.fsub(lower, upper, flags=FAST)
                for k, part in enumerate((both, apart, both)):
                    tap = lanes.repeat(tap_rows.data, builder.add(middle[k], j))
                    lanes.add_product(down[k], tap, part)
            along = [lanes.load(tap_rows.data, builder.add(row, left)) for row in row_of]
            for total, (k, n) in zip(totals, ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2)), strict=True):
                lanes.add_product(total, along[k], builder.load(down[n]))
        for k, total in enumerate(totals):
            where = builder.gep(out.data, [ir.Constant(lanes.place, k)])
            builder.store(lanes.sum(total), where)
        return context.get_dummy_value()

    return types.void(image, types.intp, taps, types.intp, sums), generate


def _sum_patch_slowly(image: Image, first: int, taps: Image, radius: int, sums: RowOut) -> None:
    """The same where compilation is switched off."""
    y, x = divmod(first + radius, image.shape[1])
    rows = slice(x - radius, x - radius + taps.shape[1])
    patch = image[y - radius : y + radius + 1, rows]
    down = taps[:, : 2 * radius + 1] @ patch
    for k, (i, n) in enumerate(((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))):
        sums[k] = taps[i] @ down[n]


# compiled functions have what they were made of; plain ones are where compilation is switched off
IS_PLAIN = not hasattr(interpolate_columns, "py_func")
sum_patch: Any = _sum_patch_slowly if IS_PLAIN else intrinsic(_sum_patch)


@compiled(fastmath=True)
def sum_at_border(image: Image, x: int, y: int, taps: Image, radius: int, sums: RowOut) -> None:
    """As `sum_patch`, where pixels lie beyond the image's border: it is continued constantly."""
    height, width = image.shape
    sums[:5] = np.float32(0.0)
    for i in range(2 * radius + 1):
        column = min(max(x + i - radius, 0), width - 1)
        smooth = slope = bend = np.float32(0.0)
        for j in range(2 * radius + 1):
            value = image[min(max(y + j - radius, 0), height - 1), column]
            smooth += taps[0, j] * value
            slope += taps[1, j] * value
            bend += taps[2, j] * value
        sums[0] += taps[1, i] * smooth
        sums[1] += taps[0, i] * slope
        sums[2] += taps[2, i] * smooth
        sums[3] += taps[1, i] * slope
        sums[4] += taps[0, i] * bend


@compiled(is_inlined=True)
def derivatives_at(image: Image, x: int, y: int, taps: Image, radius: int, result: RowOut) -> None:
    """Smoothed derivatives at one pixel; beyond the border the image is continued constantly.

    ``image``: (H, W) grey levels. ``x``, ``y``: Pixel. ``taps``: (3, m) from `gaussian_taps`, of
    which the first 2 radius + 1 columns count and the rest is 0; m a multiple of `PATCH_LANES`.
    ``result``: (5,) output: d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2.
    """
    height, width = image.shape
    m = taps.shape[1]
    is_inside = (x >= radius) & (x - radius + m <= width)
    if is_inside & (y >= radius) & (y + radius < height):
        sum_patch(image, y * width + x - radius, taps, radius, result)
    else:
        sum_at_border(image, x, y, taps, radius, result)


NO_RIDGE, FOUND, MOVED = range(3)


@compiled(fastmath=True, error_model="numpy", is_inlined=True)
def step_across(derivatives: Row, x: int, y: int, radius: int, result: FloatsOut) -> int:
    """One Newton step across the line from a pixel.

    The eigenvector of the eigenvalue of largest curvature is the normal ``n``; along it the Taylor
    polynomial has its maximum at ``t = -(g . n) / (n' H n)``.

    ``derivatives``: (5,) of `derivatives_at`. ``result``: (5,) output: x, y, normal x, normal y,
    negative second derivative along the normal.
    Returns `NO_RIDGE`, `FOUND`, or `MOVED`.
    """
    half = np.float32(0.5) * (derivatives[2] - derivatives[4])
    gxy = derivatives[3]
    root = np.float32(math.sqrt(half * half + gxy * gxy))
    bend = np.float32(0.5) * (derivatives[2] + derivatives[4]) - root
    if bend >= np.float32(0.0) or root <= np.float32(0.0):
        return NO_RIDGE
    nx = root - half if half < np.float32(0.0) else -gxy
    ny = -gxy if half < np.float32(0.0) else root + half
    share = np.float32(1.0) / np.float32(math.sqrt(nx * nx + ny * ny))
    nx *= share
    ny *= share
    step = -(derivatives[0] * nx + derivatives[1] * ny) / bend
    dx = float(step * nx)
    dy = float(step * ny)
    result[0] = x + dx
    result[1] = y + dy
    result[2] = nx
    result[3] = ny
    result[4] = -bend
    if abs(dx) <= 0.6 and abs(dy) <= 0.6:
        return FOUND
    return NO_RIDGE if abs(step) > radius else MOVED


@compiled(error_model="numpy")
def walk_to_ridge(
    image: Image, taps: Image, radius: int, derivatives: RowOut, result: FloatsOut
) -> bool:
    """Walk on to the nearest ridge; False if there is none.

    ``image``, ``taps``, ``radius``: As for `derivatives_at`. ``derivatives``: (5,) scratch.
    ``result``: (5,) of `step_across`, input of a first step that left its pixel, and output.
    """
    height, width = image.shape
    for _ in range(ROUNDS - 1):
        x = math.floor(result[0] + 0.5)
        y = math.floor(result[1] + 0.5)
        if x < 0 or y < 0 or x >= width or y >= height:
            return False
        derivatives_at(image, x, y, taps, radius, derivatives)
        state = step_across(derivatives, x, y, radius, result)
        if state != MOVED:
            return state == FOUND
    return False


CHUNK = 256


@compiled(error_model="numpy")
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
    radius = taps.shape[1] // 2
    # whole registers: what is left over of a row would take as long as the rest
    padded = np.zeros((3, -(-taps.shape[1] // PATCH_LANES) * PATCH_LANES), np.float32)
    for row in range(3):
        for k in range(taps.shape[1]):
            padded[row, k] = taps[row, k]
    derivatives = np.zeros(5, np.float32)
    ridges, states = np.zeros((CHUNK, 5)), np.zeros(CHUNK, np.int64)
    count = 0
    for r in range(n_runs):
        if r % CHUNK == 0:
            # first steps of many, before what is unlike in each: a processor overlaps them
            for k in range(min(CHUNK, n_runs - r)):
                x, y = math.floor(runs[r + k, 0] + 0.5), math.floor(runs[r + k, 1] + 0.5)
                derivatives_at(image, x, y, padded, radius, derivatives)
                states[k] = step_across(derivatives, x, y, radius, ridges[k])
        ridge, state = ridges[r % CHUNK], states[r % CHUNK]
        is_row = runs[r, 2] == ROW
        side = ROW if is_row else COLUMN
        if state == MOVED:
            is_found = walk_to_ridge(image, padded, radius, derivatives, ridge)
            state = FOUND if is_found else NO_RIDGE
        if state != FOUND or ridge[4] < least_bend:
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
