# SPDX-License-Identifier: Apache-2.0
"""Normals of a scan that lies on disk: cells are summed in one pass, tangent planes fitted in a
second, in the order of the points.

Both passes do what `armscan.reconstruction.place` does with a cloud in memory, to the last bit
while its cells fit into memory and to the rounding of their sums beyond.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np

from armscan.errors import OutputError
from armscan.fusion.cell_sums import (
    IN_BLOCK_BITS,
    CellSums,
    cell_numbers,
    cells_of,
    numbers_at,
)
from armscan.fusion.point_spool import PointSpool
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.kernels.grids import PART_BITS
from armscan.reconstruction.place import (
    LARGEST_RADIUS_MM,
    LOOKED_AT,
    SAMPLED,
    SMALLEST_RADIUS_MM,
    NeighbourBins,
    cell_keys,
    radius_of_spacings,
    spacings_mm,
)

MOST_KEYS = 2**20
"""Cells of exposures among which the sampled ones are chosen, held in memory; of more, those whose
numbers' hash ends in zeros, so that the choice does not depend on their order."""
MIXER = np.uint64(0x9E3779B97F4A7C15)
"""Odd multiplier of Fibonacci hashing (Knuth, The Art of Computer Programming 3, 6.4)."""
CELLS_HELD = 400_000
"""Cells that are kept for the next points; 100 bytes each."""
EDGE = 5
"""Cells at a block's end from which the next block is within the radius: four, and the point's."""


def choose_scan_radius_mm(spool: PointSpool) -> float:
    """Radius for normals, as `armscan.reconstruction.place.choose_radius_mm`.

    Of scans of more than `MOST_KEYS` cells of exposures, the stripes' spacing is sampled among a
    part of them.
    """
    if len(spool) == 0:
        return SMALLEST_RADIUS_MM
    with ExitStack() as files:
        means = files.enter_context(_MeansFile(spool))
        asked = _rows_of(means, _sampled(spool, means))
        return radius_of_spacings(spacings_mm(asked, means, LOOKED_AT, LARGEST_RADIUS_MM))


@dataclass(slots=True, eq=False)
class _MeansFile:
    """One mean a cell and exposure, on disk, with its exposure; parts of whole exposures.

    Iterating gives each part as (M, 4), by rising number of the exposures.
    """

    spool: PointSpool
    file: BinaryIO = field(init=False)
    parts: list[int] = field(default_factory=list)

    def __enter__(self) -> _MeansFile:
        folder = self.spool.folder
        self.file = io.BytesIO() if folder is None else (folder / "means").open("w+b")
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()
        if self.spool.folder is not None:
            (self.spool.folder / "means").unlink(missing_ok=True)

    def add(self, means: FloatArray, exposure: IntArray) -> None:
        try:
            self.file.write(np.column_stack([means, exposure]).tobytes())
        except OSError as error:
            raise OutputError(
                f"means of the cloud cannot be kept ({error.strerror})",
                where=str(self.spool.folder),
                remedy="free some space",
            ) from error
        self.parts.append(len(means))

    def __iter__(self) -> Iterator[FloatArray]:
        self.file.seek(0)
        for n in self.parts:
            yield np.frombuffer(self.file.read(32 * n)).reshape(n, 4)


def _sampled(spool: PointSpool, means: _MeansFile) -> IntArray:
    """Write the means of cells and exposures, and choose rows of them by rising number."""
    low, high = spool.corners_mm
    size_mm, n_exposures = SMALLEST_RADIUS_MM / 4.0, len(spool.kept)
    keys, rows = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    written, mask = 0, np.uint64(0)
    for points, exposure in spool.places():
        if not len(points):
            continue
        number = cell_keys(points, size_mm, (low, high)) * n_exposures + exposure
        sums = CellSums(4)
        sums.add(number, np.column_stack([points, np.ones(len(points))]))
        found, values = sums.all()
        # of each exposure together, so that a stripe is read at once
        order = np.argsort(found % n_exposures, kind="stable")
        means.add((values[:, :3] / values[:, 3:])[order], found[order] % n_exposures)
        keys = np.concatenate([keys, found[order]])
        rows = np.concatenate([rows, np.arange(written, written + len(found))])
        written += len(found)
        while True:
            is_in = (keys.view(np.uint64) * MIXER >> np.uint64(40)) & mask == 0
            keys, rows = keys[is_in], rows[is_in]
            if len(keys) <= MOST_KEYS:
                break
            mask = np.uint64(2 * int(mask) + 1)
    order = np.argsort(keys)
    return np.asarray(rows[order][:: max(1, len(keys) // SAMPLED)])


def _rows_of(means: _MeansFile, rows: IntArray) -> FloatArray:
    """(S, 4) rows of the file."""
    found, first = np.zeros((len(rows), 4)), 0
    for part in means:
        inside = np.flatnonzero((rows >= first) & (rows < first + len(part)))
        found[inside] = part[rows[inside] - first]
        first += len(part)
    return found


@dataclass(slots=True, eq=False)
class ScanNormals:
    """Tangent planes of a spool's points, as `armscan.reconstruction.place.estimate_normals`."""

    spool: PointSpool
    radius_mm: float
    _low_mm: FloatArray = field(init=False)
    _blocks: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    _starts: IntArray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    _file: BinaryIO = field(init=False)
    _bins: NeighbourBins | None = None
    _held: frozenset[int] = frozenset()

    def __enter__(self) -> ScanNormals:
        folder = self.spool.folder
        self._low_mm = self.spool.corners_mm[0]
        self._file = io.BytesIO() if folder is None else (folder / "cells").open("w+b")
        sums = CellSums(4, folder)
        try:
            for points, _ in self.spool.places():
                values = np.column_stack([points, np.ones(len(points))])
                sums.add(self._numbers(points), values)
            self._write(sums)
        finally:
            sums.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        if self.spool.folder is not None:
            (self.spool.folder / "cells").unlink(missing_ok=True)

    def at(self, points: FloatArray, towards_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of points that follow each other, towards (N, 3); 0 where none."""
        return self.near(points).normals(points, towards_mm)

    def near(self, points: FloatArray) -> NeighbourBins:
        """What gives normals to points (N, 3) that follow those asked before."""
        needed, bins = self._blocks_near(points), self._bins
        if bins is None or not needed <= self._held:
            is_full = bins is None or len(bins.cells) >= CELLS_HELD
            self._held = needed if is_full else needed | self._held
            cells = self._read(np.array(sorted(self._held), dtype=np.int64))
            self._bins = bins = NeighbourBins.of(cells, self._low_mm, self.radius_mm)
        return bins

    def _numbers(self, points: FloatArray) -> IntArray:
        return numbers_at(points, self._low_mm, self.radius_mm / 4.0)

    def _write(self, sums: CellSums) -> None:
        """Means of the cells, block by block, and where each block begins."""
        blocks: list[IntArray] = []
        starts: list[IntArray] = []
        written, last = 0, -1
        for keys, found in sums.merged():
            self._file.write((found[:, :3] / found[:, 3:]).tobytes())
            number = keys >> IN_BLOCK_BITS
            first = np.flatnonzero(np.diff(number, prepend=last))
            blocks.append(number[first])
            starts.append(first + written)
            written, last = written + len(keys), int(number[-1])
        self._blocks = np.concatenate(blocks)
        self._starts = np.concatenate([*starts, [written]])

    def _blocks_near(self, points: FloatArray) -> frozenset[int]:
        """Places among the blocks of those that hold cells within the radius of a point.

        A neighbour lies four cells away at most, a mean anywhere in its cell.
        """
        number = self._numbers(points)
        # neighbours along a stripe mostly share their cell
        cell = cells_of(number[np.flatnonzero(np.diff(number, prepend=-1))])
        # where in a block's third a cell lies tells which blocks are near it
        block, part = cell >> PART_BITS, cell & (2**PART_BITS - 1)
        third = 1 + (part >= 2**PART_BITS - EDGE) - (part < EDGE).astype(np.int64)
        number = np.unique(cell_numbers(4 * block + third))
        thirds = cells_of(number)
        block, side = thirds >> 2, (thirds & 3) - 1
        found = [cell_numbers(block << PART_BITS) >> IN_BLOCK_BITS]
        for corner in np.ndindex(2, 2, 2):
            near = np.maximum(block + np.array(corner) * side, 0)
            found.append(cell_numbers(near << PART_BITS) >> IN_BLOCK_BITS)
        number = np.unique(np.concatenate(found))
        place = np.searchsorted(self._blocks, number)
        is_there = place < len(self._blocks)
        is_there[is_there] = self._blocks[place[is_there]] == number[is_there]
        return frozenset(place[is_there].tolist())

    def _read(self, places: IntArray) -> FloatArray:
        """(M, 3) means of the cells of blocks; consecutive blocks in one go."""
        parts = []
        for run in np.split(places, np.flatnonzero(np.diff(places) != 1) + 1):
            begin, end = int(self._starts[run[0]]), int(self._starts[run[-1] + 1])
            self._file.seek(24 * begin)
            parts.append(self._file.read(24 * (end - begin)))
        return np.frombuffer(b"".join(parts)).reshape(-1, 3)
