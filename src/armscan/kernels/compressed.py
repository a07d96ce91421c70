# SPDX-License-Identifier: Apache-2.0
"""Compressed bytes: LZF of PCD files, and the entropy-coded data of sequential JPEGs."""

from __future__ import annotations

import numpy as np

from armscan.kernels.arrays import Bytes, BytesOut, IntTable, compiled

LITERALS = 32
"""First bytes below this count literals; others begin a reference of 3 to 8, or more, bytes."""


@compiled()
def decompress(data: Bytes, plain: BytesOut) -> int:
    """Write the bytes that LZF ``data`` (N,) stands for to ``plain`` (M,); 0 for damaged ones.

    LZF is runs of literal bytes and references to bytes before. Returns the bytes' count.
    A byte ``c < 32`` is followed by ``c + 1`` literals. Otherwise the length is ``(c >> 5) + 2``,
    a length of 9 being followed by a byte that is added, and the distance back one more than the
    13 bits of the rest of ``c`` and the next byte.
    """
    n, size, i, k = len(data), len(plain), 0, 0
    while i < n:
        control = int(data[i])
        i += 1
        if control < LITERALS:
            length = control + 1
            if i + length > n or k + length > size:
                return 0
            for j in range(length):
                plain[k + j] = data[i + j]
            i += length
            k += length
            continue
        length = (control >> 5) + 2
        if length == 9:
            if i >= n:
                return 0
            length += int(data[i])
            i += 1
        if i >= n:
            return 0
        back = ((control & 31) << 8) + int(data[i]) + 1
        i += 1
        if back > k or k + length > size:
            return 0
        # it may overlap what it writes: byte by byte
        for j in range(length):
            plain[k + j] = plain[k + j - back]
        k += length
    return k


WHOLE, NO_CODE, TOO_SHORT, OUT_OF_BLOCK, NO_RESTART = range(5)
BLOCK = 64


@compiled()
def walk_scan(
    data: Bytes,
    tables: IntTable,
    table_of_block: IntTable,
    n_units: int,
    restart: int,
) -> tuple[int, int]:
    """Walk through all codes of one scan of a JPEG without making a picture of it.

    Decoders fill what is missing with grey and say so on stderr at most; here the codes themselves
    are counted (ITU T.81, annex F.2.2).

    ``data``: (N,) from behind the scan's header to the marker that ends it. ``tables``: (T, 65536)
    of each Huffman table, by the next 16 bits: 256 times the length of the code plus its value; 0
    where there is no such code. ``table_of_block``: (B, 2) rows of ``tables`` of the DC and AC
    codes of each block of a unit (MCU). ``n_units``: Units of the picture. ``restart``: Units
    between restart markers; 0 for none.

    Returns ``defect``, ``left``: `WHOLE` and the bytes that were left over, or the defect and the
    units that are missing.
    """
    n = len(data)
    position, bits, n_bits, borrowed = 0, np.int64(0), 0, 0
    for unit in range(n_units):
        if restart > 0 and unit > 0 and unit % restart == 0:
            bits, n_bits, borrowed = np.int64(0), 0, 0
            while position + 1 < n and data[position] == 255 and data[position + 1] == 255:
                position += 1
            number = 0xD0 + (unit // restart - 1) % 8
            if position + 1 >= n or data[position] != 255 or data[position + 1] != number:
                return NO_RESTART, n_units - unit
            position += 2
        for block in range(len(table_of_block)):
            index = 0
            while index < BLOCK:
                while n_bits < 32:
                    byte = np.int64(255)
                    if position < n and data[position] != 255:
                        byte = np.int64(data[position])
                        position += 1
                    elif position + 1 < n and data[position + 1] == 0:
                        position += 2
                    else:
                        # behind the end; harmless until one of these bits is used
                        borrowed += 8
                    bits = ((bits << 8) | byte) & 0xFFFFFFFFFFFF
                    n_bits += 8
                row = table_of_block[block, min(index, 1)]
                entry = tables[row, (bits >> (n_bits - 16)) & 0xFFFF]
                if entry == 0:
                    return NO_CODE, n_units - unit
                value = entry & 0xFF
                n_bits -= (entry >> 8) + (value & 0x0F)
                if n_bits < borrowed:
                    return TOO_SHORT, n_units - unit
                if index == 0:
                    index = 1
                elif value == 0:
                    index = BLOCK
                else:
                    index += (value >> 4) + 1
                    if index > BLOCK:
                        return OUT_OF_BLOCK, n_units - unit
    unused = max(n_bits - borrowed, 0) // 8
    return WHOLE, n - position + unused
