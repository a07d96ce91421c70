# SPDX-License-Identifier: Apache-2.0
"""PGM and PPM images, whose header says how many bits are used."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError
from armscan.geometry.arrays import ImageArray, IntArray

HEADER = re.compile(rb"P([2356])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d+)" + rb"\s")


def decode_netpbm(data: bytes, where: str) -> tuple[ImageArray, int]:
    """Decode a PGM (P2, P5) or PPM (P3, P6) file.

    Parameters
    ----------
    data
        The whole file.
    where
        Its name, for messages.

    Returns
    -------
    image
        (H, W) or (H, W, 3) in the order red, green, blue; uint8 or uint16, values as stored.
    bits_used
        Bits that the header's greatest value needs.

    Raises
    ------
    FileFormatError
        If the header is not understood or values are missing.
    """
    header = HEADER.match(data)
    if header is None:
        raise FileFormatError(
            "the PGM header is not understood", where=where, remedy="save the image as PNG"
        )
    kind = int(header[1])
    width, height, greatest = (int(header[k]) for k in (2, 3, 4))
    if not 1 <= greatest <= 65535 or width < 1 or height < 1:
        raise FileFormatError(
            f"the PGM header gives {width} x {height} px and a greatest value of {greatest}",
            where=where,
            remedy="save the image as PNG",
        )
    shape = (height, width, 3) if kind in (3, 6) else (height, width)
    body = data[header.end() :]
    stored = np.dtype(">u2" if greatest > 255 else "u1")
    count = int(np.prod(shape))
    values: NDArray[Any]
    if kind in (2, 3):
        values = _ascii_values(body, where)
    else:
        values = np.frombuffer(body[: len(body) // stored.itemsize * stored.itemsize], stored)
    if len(values) < count:
        raise FileFormatError(
            f"the PGM file holds {len(values)} of {count} values",
            where=where,
            remedy="copy the file again or leave it out",
        )
    values = values[:count].reshape(shape)
    image = values.astype(np.uint16) if greatest > 255 else values.astype(np.uint8)
    return image, greatest.bit_length()


def _ascii_values(body: bytes, where: str) -> IntArray:
    words = re.sub(rb"#[^\n]*", b"", body).split()
    try:
        values = np.array([int(word) for word in words], dtype=np.int64)
    except ValueError as error:
        raise FileFormatError(
            "the PGM file holds words that are no numbers",
            where=where,
            remedy="save the image as PNG",
        ) from error
    if len(values) and not 0 <= values.min() <= values.max() <= 65535:
        raise FileFormatError(
            "the PGM file holds values outside 0 to 65535",
            where=where,
            remedy="save the image as PNG",
        )
    return values
