# SPDX-License-Identifier: Apache-2.0
"""Sums over the cells of a grid, out of core past a given size.

Cells that do not fit any more are written to a file as one run, sorted by number; reading merges
the runs. A cell's number names its block of 32 x 32 x 32 cells first: cells of a block are
consecutive, so that a piece of space is a few ranges of the sorted cells.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from armscan.errors import InputError, OutputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.kernels.grids import BLOCK_BITS, PART_BITS, add_to_cells, number_cells

IN_BLOCK_BITS = 3 * PART_BITS
AXIS_CELLS = 2 ** (BLOCK_BITS + PART_BITS)
"""Cells along an axis that can be numbered."""
MOST_BYTES = 64 * 2**20
"""Memory that the cells of one grid take before they go to disk."""
WRITTEN_ROWS = 2**14
"""Rows of a run that are put together at a time."""
FEWEST_ROWS = 1024
"""Rows of each run that are held while runs are merged, at least."""


def cell_numbers(cell: IntArray) -> IntArray:
    """(N,) numbers of cells (N, 3), counted from 0 along each axis, block by block.

    Raises
    ------
    InputError
        If a cell lies beyond `AXIS_CELLS`.
    """
    if len(cell) and not 0 <= int(cell.min()) <= int(cell.max()) < AXIS_CELLS:
        raise _too_far()
    block, part = cell >> PART_BITS, cell & (2**PART_BITS - 1)
    number = block[:, 0] << BLOCK_BITS | block[:, 1]
    number = number << BLOCK_BITS | block[:, 2]
    for axis in range(3):
        number = number << PART_BITS | part[:, axis]
    return np.asarray(number)


def numbers_at(points: FloatArray, low: FloatArray, size: float) -> IntArray:
    """(N,) numbers, as `cell_numbers`, of the cells of a size that points (N, 3) lie in.

    ``low`` (3,) is the corner of the first cell.

    Raises
    ------
    InputError
        If a cell lies beyond `AXIS_CELLS`.
    """
    numbers = np.zeros(len(points), dtype=np.int64)
    if not number_cells(np.ascontiguousarray(points), low, size, numbers):
        raise _too_far()
    return numbers


def _too_far() -> InputError:
    return InputError(
        f"the points reach over more than {AXIS_CELLS:,} cells along an axis",
        remedy="choose larger cells, or cut away far points",
    )


def cells_of(numbers: IntArray) -> IntArray:
    """(N, 3) cells of numbers (N,): what `cell_numbers` numbered."""
    cells = np.zeros((len(numbers), 3), dtype=np.int64)
    block, part = numbers >> IN_BLOCK_BITS, numbers & (2**IN_BLOCK_BITS - 1)
    for axis in range(3):
        coarse = block >> BLOCK_BITS * (2 - axis) & (2**BLOCK_BITS - 1)
        fine = part >> PART_BITS * (2 - axis) & (2**PART_BITS - 1)
        cells[:, axis] = coarse << PART_BITS | fine
    return cells


@dataclass(slots=True, eq=False)
class CellSums:
    """Sums of K values over cells.

    Parameters
    ----------
    n_values
        K.
    folder
        Where runs go; None keeps all in memory however many cells there are.
    most_bytes
        Memory before a run is written.
    """

    n_values: int
    folder: Path | None = None
    most_bytes: int = MOST_BYTES
    _keys: IntArray = field(init=False)
    _sums: FloatArray = field(init=False)
    _slots: IntArray = field(init=False)
    _count: IntArray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    _runs: list[BinaryIO] = field(default_factory=list)

    def __post_init__(self) -> None:
        # a cell takes its sums, its number, and two to four places in the hash table
        most = max(2, self.most_bytes // (8 * (self.n_values + 5)))
        self._allot(min(4096, most))

    @property
    def n_runs(self) -> int:
        """Runs on disk."""
        return len(self._runs)

    def add(self, keys: IntArray, values: FloatArray) -> None:
        """Add values (N, K) to the cells numbered ``keys`` (N,), in order.

        Raises
        ------
        OutputError
            If the disk is full or refuses.
        """
        done = 0
        while True:
            done = add_to_cells(
                keys, values, done, self._slots, self._keys, self._sums, self._count
            )
            if done == len(keys):
                return
            most = max(2, self.most_bytes // (8 * (self.n_values + 5)))
            if self.folder is None or len(self._keys) < most:
                self._grow(2 * len(self._keys) if self.folder is None else most)
            else:
                self._spill()

    def merged(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Numbers (M,), rising, and sums (M, K) of all cells, piece by piece, as often
        as asked; ends the adding.
        """
        if not self._runs:
            keys, sums = self._sorted()
            step = max(FEWEST_ROWS, MOST_BYTES // (32 * (self.n_values + 1)))
            for first in range(0, len(keys), step):
                yield keys[first : first + step], sums[first : first + step]
            return
        if self._count[0]:
            self._spill()
        self._allot(2)
        yield from self._merge()

    def all(self) -> tuple[IntArray, FloatArray]:
        """As `merged`, in one piece."""
        keys, sums = zip(*self.merged(), strict=True)
        return np.concatenate(keys), np.concatenate(sums)

    def close(self) -> None:
        """Delete the runs."""
        for k, run in enumerate(self._runs):
            with suppress(OSError):
                run.close()
            if self.folder is not None:
                (self.folder / f"cells-{id(self)}-{k}").unlink(missing_ok=True)
        self._runs.clear()

    def _allot(self, n_cells: int) -> None:
        self._keys = np.zeros(n_cells, dtype=np.int64)
        self._sums = np.zeros((n_cells, self.n_values))
        n_slots = 2 ** int(np.ceil(np.log2(2 * n_cells)))
        self._slots = np.full(n_slots, -1, dtype=np.int64)
        self._count[0] = 0

    def _grow(self, n_cells: int) -> None:
        keys, sums, n = self._keys, self._sums, int(self._count[0])
        self._allot(min(n_cells, max(2 * n, 2)))
        add_to_cells(keys[:n], sums[:n], 0, self._slots, self._keys, self._sums, self._count)

    def _sorted(self) -> tuple[IntArray, FloatArray]:
        n = int(self._count[0])
        order = np.argsort(self._keys[:n])
        return self._keys[:n][order], self._sums[:n][order]

    def _spill(self) -> None:
        assert self.folder is not None  # noqa: S101 - only a grid with a folder spills
        order = np.argsort(self._keys[: int(self._count[0])])
        try:
            file = (self.folder / f"cells-{id(self)}-{len(self._runs)}").open("w+b")
            self._runs.append(file)
            for first in range(0, len(order), WRITTEN_ROWS):
                rows = order[first : first + WRITTEN_ROWS]
                keys = self._keys[rows].view(np.float64)
                file.write(np.column_stack([keys, self._sums[rows]]).tobytes())
        except OSError as error:
            raise OutputError(
                f"cells cannot be kept on disk ({error.strerror})",
                where=str(self.folder),
                remedy="free some space or choose larger cells",
            ) from error
        self._slots[:] = -1
        self._count[0] = 0

    def _merge(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Take from all runs what lies below the least of their windows' ends, over and over."""
        width = 8 * (self.n_values + 1)
        rows = max(FEWEST_ROWS, self.most_bytes // (8 * width * len(self._runs)))
        for run in self._runs:
            run.seek(0, io.SEEK_SET)

        def window(run: BinaryIO) -> FloatArray:
            return np.frombuffer(run.read(rows * width)).reshape(-1, self.n_values + 1)

        held = [window(run) for run in self._runs]
        while any(len(one) for one in held):
            ends = [int(one[-1:, 0].view(np.int64)[0]) for one in held if len(one)]
            limit = min(ends)
            taken = []
            for k, one in enumerate(held):
                n = int(np.searchsorted(_keys_of(one), limit, side="right"))
                taken.append(one[:n])
                held[k] = one[n:]
                if n and n == len(one):
                    held[k] = window(self._runs[k])
            yield _joined(np.concatenate(taken))


def _keys_of(table: FloatArray) -> IntArray:
    return np.ascontiguousarray(table[:, 0]).view(np.int64)


def _joined(table: FloatArray) -> tuple[IntArray, FloatArray]:
    """Rows of equal number added up, in the order of their runs."""
    keys = _keys_of(table)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    return keys[starts], np.add.reduceat(table[order, 1:], starts, axis=0)
