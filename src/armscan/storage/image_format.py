# SPDX-License-Identifier: Apache-2.0
"""Which format an image file has, and whether it is complete.

Decoders return a picture whose lower part is grey when a file was cut, without an error; so the
structure of the file is walked before it is decoded.
"""

from __future__ import annotations

import struct
import zlib

from armscan.errors import FileFormatError
from armscan.storage.jpeg_format import jpeg_defect

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_TYPE_BYTES = {1: 1, 3: 2, 4: 4}
TIFF_DATA_TAGS = {273: 279, 324: 325}
"""Tags of the offsets of strips and tiles, with the tags of their byte counts."""

CUT = "copy the file again or leave it out"


def image_format(data: bytes) -> str | None:
    """Name of the image format by its first bytes, or None if it is none that can be read."""
    if data.startswith(PNG_SIGNATURE):
        return "PNG"
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data.startswith(b"BM"):
        return "BMP"
    if data[:4] in (b"II*\0", b"MM\0*"):
        return "TIFF"
    if data[:2] in (b"P2", b"P3", b"P5", b"P6") and data[2:3].isspace():
        return "PGM"
    return None


def check_complete(data: bytes, where: str) -> None:
    """Raise if an image file ends before its picture does, or a PNG's checksums fail.

    Parameters
    ----------
    data
        The whole file.
    where
        Its name, for the message.

    Raises
    ------
    FileFormatError
        If the file is cut short or damaged.
    """
    checks = {"PNG": _png_defect, "JPEG": jpeg_defect, "BMP": _bmp_defect, "TIFF": _tiff_defect}
    name = image_format(data)
    if name not in checks:
        return
    try:
        defect = checks[name](data)
    except (struct.error, IndexError):
        defect = "is cut short"
    if defect:
        raise FileFormatError(f"the {name} file {defect}", where=where, remedy=CUT)


def _png_defect(data: bytes) -> str:
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != checksum:
            return f"is damaged near byte {position}"
        if data[position + 4 : position + 8] == b"IEND":
            return ""
        position = end
    return "is cut short"


def _bmp_defect(data: bytes) -> str:
    (pixel_offset,) = struct.unpack_from("<I", data, 10)
    width, height = struct.unpack_from("<ii", data, 18)
    bits, compression = struct.unpack_from("<HI", data, 28)
    row_bytes = (abs(width) * bits + 31) // 32 * 4
    is_plain = compression in (0, 3)
    return "is cut short" if is_plain and pixel_offset + row_bytes * abs(height) > len(data) else ""


def _tiff_defect(data: bytes) -> str:
    order = "<" if data[:2] == b"II" else ">"
    (directory,) = struct.unpack_from(f"{order}I", data, 4)
    (n_entries,) = struct.unpack_from(f"{order}H", data, directory)
    tags: dict[int, tuple[int, ...]] = {}
    for k in range(n_entries):
        entry = directory + 2 + 12 * k
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, entry)
        size = TIFF_TYPE_BYTES.get(kind)
        if size is None or tag not in (*TIFF_DATA_TAGS, *TIFF_DATA_TAGS.values()):
            continue
        if size * count > 4:
            (place,) = struct.unpack_from(f"{order}I", data, entry + 8)
        else:
            place = entry + 8
        code = {1: "B", 2: "H", 4: "I"}[size]
        tags[tag] = struct.unpack_from(f"{order}{count}{code}", data, place)
    for offset_tag, count_tag in TIFF_DATA_TAGS.items():
        pairs = zip(tags.get(offset_tag, ()), tags.get(count_tag, ()), strict=False)
        if any(offset + count > len(data) for offset, count in pairs):
            return "is cut short"
    return ""
