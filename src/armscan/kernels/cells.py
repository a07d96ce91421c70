# SPDX-License-Identifier: Apache-2.0
"""Sums over cells of a grid: cubes numbered by one integer, found by hashing."""

from __future__ import annotations

from armscan.kernels.arrays import Ints, IntsOut, Table, TableOut, compiled

SPREAD = 0x2545F4914F6CDD1D
"""Odd multiplier of a linear congruential step (L'Ecuyer 1999): neighbouring numbers land apart."""


@compiled()
def add_to_cells(
    keys: Ints,
    values: Table,
    start: int,
    slots: IntsOut,
    cell_keys: IntsOut,
    sums: TableOut,
    count: IntsOut,
) -> int:
    """Add rows to the sums of their cells, in order, until one more cell does not fit.

    Parameters
    ----------
    keys
        (N,) number of each row's cell.
    values
        (N, K).
    start
        First row to add.
    slots
        (S,) hash table, S a power of two of at least twice the cells: row of the cell, -1 if free.
    cell_keys
        (M,) number of each cell.
    sums
        (M, K).
    count
        (1,) cells in use.

    Returns
    -------
    int
        Row that was not added any more; N if all were.
    """
    mask = len(slots) - 1
    for n in range(start, len(keys)):
        key = keys[n]
        mixed = key * SPREAD
        slot = (mixed ^ (mixed >> 29)) & mask
        while slots[slot] >= 0 and cell_keys[slots[slot]] != key:
            slot = (slot + 1) & mask
        row = slots[slot]
        if row < 0:
            row = count[0]
            if row == len(cell_keys):
                return n
            slots[slot] = row
            cell_keys[row] = key
            for k in range(values.shape[1]):
                sums[row, k] = 0.0
            count[0] = row + 1
        for k in range(values.shape[1]):
            sums[row, k] += values[n, k]
    return len(keys)
