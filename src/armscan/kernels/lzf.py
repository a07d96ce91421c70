# SPDX-License-Identifier: Apache-2.0
"""LZF, the compression of PCD files: runs of literal bytes and references to bytes before."""

from __future__ import annotations

from armscan.kernels.arrays import Bytes, BytesOut, compiled

LITERALS = 32
"""First bytes below this count literals; others begin a reference of 3 to 8, or more, bytes."""


@compiled()
def decompress(data: Bytes, plain: BytesOut) -> int:
    """Write the bytes that ``data`` (N,) stands for to ``plain`` (M,); their count, 0 for damaged.

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
