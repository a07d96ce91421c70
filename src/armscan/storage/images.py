# SPDX-License-Identifier: Apache-2.0
"""Image files to exposures: raw pixels, never turned, never rescaled.

Decoders return a picture whose lower part is grey when a file was cut, without an error; so
the structure of a file is walked before it is decoded.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError, InputError, OptionError, listed
from armscan.geometry.arrays import ImageArray, IntArray
from armscan.records.exposure import Exposure
from armscan.storage.files import path_text, read_bytes

Alignment = Literal["low", "high"]


@dataclass(frozen=True, slots=True)
class ImageOptions:
    """What a file does not say: significant bits of a pixel, and where they lie in 16.

    None takes what the file says (PGM), else all its bits; high-aligned pixels are shifted down.
    """

    bits_used: int | None = None
    align: Alignment = "low"

    def __post_init__(self) -> None:
        if self.bits_used is not None and not 1 <= self.bits_used <= 16:
            raise OptionError(f"bits used is {self.bits_used}", remedy="give 1 to 16")
        if self.align not in ("low", "high"):
            raise OptionError(f"align is {self.align!r}", remedy="choose low or high")
        if self.align == "high" and self.bits_used is None:
            raise OptionError(
                "high-aligned pixels need the count of bits used", remedy="give 10, 12 or 14"
            )

    def check_unused(self) -> None:
        """Raise `OptionError` if anything is said of pixels: a recording describes its own."""
        if self != ImageOptions():
            raise OptionError(
                "a recording says itself how its pixels are stored",
                where="--bits-used and --bits-align",
                remedy="leave them out, or correct bits_used and align under [[camera]] in "
                "session.toml",
            )


NO_LENGTH = frozenset({0x01, *range(0xD0, 0xD8)})
END, SCAN, HUFFMAN, RESTART_INTERVAL = 0xD9, 0xDA, 0xC4, 0xDD
SEQUENTIAL = (0xC0, 0xC1)
FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
FILL_BYTES = 2
"""Bytes that some writers leave between the last code and the end."""
MOST_PIXELS_A_BYTE = 1600
"""A block of 64 pixels takes two codes of at least two bits in all: 0.04 bytes with its share of
the chroma. A header that claims more than this is not that of the data."""
STANDARD_TABLES = bytes.fromhex(
    "0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000"
    "017d01020300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718"
    "191a25262728292a3435363738393a434445464748494a535455565758595a636465666768696a7374757677"
    "78797a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7"
    "c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa010003010101010101010101"
    "0000000000000102030405060708090a0b110002010204040304070504040001027700010203110405213106"
    "1241510761711322328108144291a1b1c109233352f0156272d10a162434e125f11718191a262728292a3536"
    "3738393a434445464748494a535455565758595a636465666768696a737475767778797a8283848586878889"
    "8a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8"
    "d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
"""Codes of T.81, annex K: single pictures of a camera's MJPEG stream hold none, and mean these."""


@dataclass
class _Picture:
    """What the markers have said so far."""

    is_sequential: bool = False
    size_px: tuple[int, int] = (0, 0)
    components: dict[int, tuple[int, int]] = field(default_factory=dict)
    tables: dict[int, IntArray] = field(default_factory=dict)
    restart: int = 0


def jpeg_defect(data: bytes) -> str:
    """What is wrong with a JPEG file, as the end of a sentence; empty if nothing was found.

    Raises
    ------
    struct.error, IndexError
        If it ends within a marker.
    """
    picture, position = _Picture(), 2
    while True:
        position = data.find(b"\xff", position)
        if position < 0 or position + 1 >= len(data):
            return "is cut short"
        marker = data[position + 1]
        if marker == END:
            return ""
        if marker in NO_LENGTH or marker in (0x00, 0xFF):
            position += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, position + 2)
        body = data[position + 4 : position + 2 + length]
        position += 2 + length
        if marker == SCAN:
            if not picture.tables:
                _read_tables(STANDARD_TABLES, picture.tables)
            end = _end_of_scan(data, position)
            defect = "is cut short" if end < 0 else _scan_defect(data[position:end], body, picture)
            position = end
        else:
            defect = _heading_defect(marker, body, picture, len(data))
        if defect:
            return defect


def _heading_defect(marker: int, body: bytes, picture: _Picture, n_bytes: int) -> str:
    """Take in what a marker says of the picture."""
    if marker in FRAMES:
        picture.is_sequential = marker in SEQUENTIAL
        height, width, n = struct.unpack_from(">HHB", body, 1)
        picture.size_px = (width, height)
        picture.components = {
            body[6 + 3 * k]: (body[7 + 3 * k] >> 4, body[7 + 3 * k] & 15) for k in range(n)
        }
        if defect := _claim_defect(width, height, 8, n):
            return defect
        if width * height > MOST_PIXELS_A_BYTE * n_bytes:
            return f"claims {width} x {height} px, more than its {n_bytes} bytes can hold"
    elif marker == HUFFMAN:
        _read_tables(body, picture.tables)
    elif marker == RESTART_INTERVAL:
        (picture.restart,) = struct.unpack_from(">H", body)
    return ""


def _read_tables(body: bytes, tables: dict[int, IntArray]) -> None:
    """Spread each code over all 16-bit words that begin with it (T.81, annex C)."""
    position = 0
    while position + 17 <= len(body):
        kind, counts = body[position], body[position + 1 : position + 17]
        values = body[position + 17 : position + 17 + sum(counts)]
        position += 17 + sum(counts)
        table = np.zeros(1 << 16, dtype=np.int64)
        start, used = 0, 0
        for length, count in enumerate(counts, start=1):
            width = 1 << (16 - length)
            for value in values[used : used + count]:
                table[start : start + width] = 256 * length + value
                start += width
            used += count
        tables[kind] = table


def _end_of_scan(data: bytes, position: int) -> int:
    """Where the next marker that does not belong to a scan begins; -1 if there is none."""
    while True:
        position = data.find(b"\xff", position)
        if position < 0 or position + 1 >= len(data):
            return -1
        marker = data[position + 1]
        if marker == 0x00 or 0xD0 <= marker <= 0xD7:
            position += 2
        elif marker == 0xFF:
            position += 1
        else:
            return position


def _scan_defect(codes: bytes, header: bytes, picture: _Picture) -> str:
    from armscan.kernels.decoding import WHOLE, walk_scan  # compiled: only JPEGs wait for it

    if not picture.is_sequential:
        return ""
    n = header[0]
    chosen = [(header[1 + 2 * k], header[2 + 2 * k]) for k in range(n)]
    kinds = sorted(picture.tables)
    places: list[tuple[int, int]] = []
    across, down = (max(sizes) for sizes in zip(*picture.components.values(), strict=True))
    width, height = picture.size_px
    for component, codes_of in chosen:
        if component not in picture.components:
            return f"has a scan of a colour {component} that it has not"
        pair = (codes_of >> 4, 0x10 | (codes_of & 15))
        if not set(pair) <= set(kinds):
            return "lacks a table of codes"
        h, v = picture.components[component]
        # a scan of one colour has one block a unit
        n_blocks = h * v if n > 1 else 1
        places += [(kinds.index(pair[0]), kinds.index(pair[1]))] * n_blocks
    if n > 1:
        n_units = ceil(width / (8 * across)) * ceil(height / (8 * down))
    else:
        h, v = picture.components[chosen[0][0]]
        n_units = ceil(ceil(width * h / across) / 8) * ceil(ceil(height * v / down) / 8)
    tables = np.stack([picture.tables[kind] for kind in kinds])
    defect, left = walk_scan(
        np.frombuffer(codes, np.uint8), tables, np.array(places), n_units, picture.restart
    )
    if defect != WHOLE:
        return f"is damaged: {left} of {n_units} blocks of its picture are missing or unreadable"
    return f"is damaged: {left} bytes too many in its picture" if left > FILL_BYTES else ""


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_TYPE_BYTES = {1: 1, 3: 2, 4: 4}
TIFF_DATA_TAGS = {273: 279, 324: 325}
"""Tags of the offsets of strips and tiles, with the tags of their byte counts."""

TIFF_SIZE_TAGS = {256: "width", 257: "height", 258: "bits", 277: "channels"}
TIFF_WHOLE_TYPES = {1: "B", 3: "H", 4: "I"}
TIFF_SUBFILE, TIFF_PHOTOMETRIC, TIFF_ORIENTATION, TIFF_PLANES = 254, 262, 274, 284
TIFF_KIND_TAGS = (TIFF_SUBFILE, TIFF_PHOTOMETRIC, TIFF_PLANES)
PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
MOST_PICTURE_BYTES = 400_000_000
"""Of a decoded picture: 200 million grey pixels of 16 bits. A small file may claim any size."""
MOST_INFLATION = 1100
"""Bytes that one byte of a PNG file may become."""

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
    """Raise if an image file ends before its picture does, or a PNG's checksums fail."""
    checks = {"PNG": _png_defect, "JPEG": jpeg_defect, "BMP": _bmp_defect, "TIFF": _tiff_defect}
    name = image_format(data)
    if name not in checks:
        return
    try:
        defect = checks[name](data)
    except (struct.error, IndexError, ValueError, OverflowError):
        defect = "is cut short"
    if defect:
        raise FileFormatError(f"the {name} file {defect}", where=where, remedy=CUT)


def _claim_defect(width: int, height: int, bits: int, channels: int = 1) -> str:
    """What is wrong with the size that a header claims; empty for nothing."""
    n_bytes = width * height * channels * (2 if bits > 8 else 1)
    if width < 1 or height < 1:
        return f"claims {width} x {height} px"
    if n_bytes > MOST_PICTURE_BYTES:
        return f"claims {width} x {height} px, {n_bytes} bytes; up to {MOST_PICTURE_BYTES} are read"
    return ""


def _png_defect(data: bytes) -> str:
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    if defect := _claim_defect(width, height, bits, PNG_CHANNELS.get(colour, 1)):
        return defect
    if width * height * bits // 8 > MOST_INFLATION * len(data):
        return f"claims {width} x {height} px, more than its {len(data)} bytes can hold"
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
    if defect := _claim_defect(abs(width), abs(height), 8, 4 if bits > 24 else 3):
        return defect
    row_bytes = (abs(width) * bits + 31) // 32 * 4
    is_plain = compression in (0, 3)
    return "is cut short" if is_plain and pixel_offset + row_bytes * abs(height) > len(data) else ""


@dataclass(frozen=True, slots=True)
class _Directory:
    """What a TIFF file says of one picture: values of the tags that count here, the place of its
    orientation in the file (0 for none) with the code of its type, and the place of the next
    directory (0 for none).
    """

    tags: dict[int, tuple[int, ...]]
    orientation: int
    orientation_code: str
    following: int

    def first(self, tag: int, otherwise: int) -> int:
        """First value of a tag that may be missing."""
        return (self.tags.get(tag) or (otherwise,))[0]


def _tiff_directory(data: bytes, place: int) -> _Directory:
    order = _tiff_order(data)
    (n_entries,) = struct.unpack_from(f"{order}H", data, place)
    tags: dict[int, tuple[int, ...]] = {}
    known = {*TIFF_DATA_TAGS, *TIFF_DATA_TAGS.values(), *TIFF_SIZE_TAGS, *TIFF_KIND_TAGS}
    orientation, orientation_code, end = 0, "H", place + 2 + 12 * n_entries
    for entry in range(place + 2, end, 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, entry)
        n_bytes = TIFF_TYPE_BYTES.get(kind)
        if tag == TIFF_ORIENTATION and kind in TIFF_WHOLE_TYPES and count == 1:
            orientation, orientation_code = entry + 8, TIFF_WHOLE_TYPES[kind]
        if n_bytes is None or tag not in known:
            continue
        if n_bytes * count > 4:
            (start,) = struct.unpack_from(f"{order}I", data, entry + 8)
        else:
            start = entry + 8
        code = {1: "B", 2: "H", 4: "I"}[n_bytes]
        tags[tag] = struct.unpack_from(f"{order}{count}{code}", data, start)
    following = struct.unpack_from(f"{order}I", data, end)[0] if end + 4 <= len(data) else 0
    return _Directory(tags, orientation, orientation_code, following)


def _tiff_order(data: bytes) -> str:
    return "<" if data[:2] == b"II" else ">"


def _first_place(data: bytes) -> int:
    return int(struct.unpack_from(f"{_tiff_order(data)}I", data, 4)[0])


def _tiff_defect(data: bytes) -> str:
    tags = _tiff_directory(data, _first_place(data)).tags
    size = {name: tags[tag][0] for tag, name in TIFF_SIZE_TAGS.items() if tags.get(tag)}
    if defect := _claim_defect(**{"width": 0, "height": 0, "bits": 1} | size):
        return defect
    for offset_tag, count_tag in TIFF_DATA_TAGS.items():
        pairs = zip(tags.get(offset_tag, ()), tags.get(count_tag, ()), strict=False)
        if any(offset + count > len(data) for offset, count in pairs):
            return "is cut short"
    return ""


def _has_another_image(data: bytes, page: _Directory) -> bool:
    """Whether a second picture is as large as the first, and not said to be its preview."""
    if not page.following:
        return False
    try:
        other = _tiff_directory(data, page.following)
    except struct.error:  # a damaged end, behind a picture that is whole
        return False
    is_preview = bool(other.first(TIFF_SUBFILE, 0) & 1)
    return not is_preview and all(other.first(tag, 0) == page.first(tag, 0) for tag in (256, 257))


def _plain_tiff(data: bytes, where: str) -> bytes:
    """The file without its orientation, by which the decoder would turn the picture.

    Raises
    ------
    FileFormatError
        If it holds several pictures of one size, of which the decoder gives the first, or stores
        pixels in a way that the decoder misreads.
    """
    page = _tiff_directory(data, _first_place(data))
    if _has_another_image(data, page):
        raise FileFormatError(
            "the TIFF file holds several images",
            where=where,
            remedy="save each of them in a file of its own",
        )
    if page.first(258, 1) > 8:
        fact = ""
        if page.first(277, 1) > 1 and page.first(TIFF_PLANES, 1) == 2:
            fact = "keeps its colours in planes of 16 bits, one after the other"
        elif page.first(TIFF_PHOTOMETRIC, 1) == 0:
            fact = "counts from white, in 16 bits"
        if fact:
            raise FileFormatError(f"the TIFF file {fact}", where=where, remedy="save it as PNG")
    at = page.orientation
    upright = struct.pack(f"{_tiff_order(data)}{page.orientation_code}", 1)
    return data[:at] + upright + data[at + len(upright) :] if at else data


HEADER = re.compile(rb"P([2356])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d{1,6})" + rb"\s")


def decode_netpbm(data: bytes, where: str) -> tuple[ImageArray, int]:
    """Decode a PGM (P2, P5) or PPM (P3, P6) file to its pixels and the bits that they need.

    (H, W) or (H, W, 3) in the order red, green, blue; uint8 or uint16, values as stored.
    """
    header = HEADER.match(data)
    if header is None:
        raise FileFormatError(
            "the PGM header is not understood", where=where, remedy="save the image as PNG"
        )
    kind, width, height, greatest = (int(header[k]) for k in (1, 2, 3, 4))
    if not 1 <= greatest <= 65535 or _claim_defect(width, height, 16, 3):
        raise FileFormatError(
            f"the PGM header gives {width} x {height} px and a greatest value of {greatest}",
            where=where,
            remedy="save the image as PNG",
        )
    shape = (height, width, 3) if kind in (3, 6) else (height, width)
    stored, count = np.dtype(">u2" if greatest > 255 else "u1"), math.prod(shape)
    body = data[header.end() :]
    if data[header.end() - 1 :].startswith(b"\r\n") and len(body) == count * stored.itemsize + 1:
        body = body[1:]  # a line's end of two bytes, of which the standard knows one
    if kind in (2, 3):
        values = _ascii_values(body, where)
    else:
        n_stored = min(count, len(body) // stored.itemsize)
        values = np.frombuffer(body, stored, n_stored)
    if len(values) < count:
        raise FileFormatError(
            f"the PGM file holds {len(values)} of {count} values", where=where, remedy=CUT
        )
    image = values[:count].reshape(shape)
    return _as_image(image.astype(stored.newbyteorder("="))), greatest.bit_length()


def _ascii_values(body: bytes, where: str) -> NDArray[Any]:
    words = re.sub(rb"#[^\n]*", b"", body).split()
    if not all(word.isdigit() and len(word) <= 5 for word in words):
        raise FileFormatError(
            "the PGM file holds words that are no numbers from 0 to 65535",
            where=where,
            remedy="save the image as PNG",
        )
    values = np.array(list(map(int, words)), dtype=np.int64)
    if values.max(initial=0) > 65535:
        raise FileFormatError(
            "the PGM file holds values beyond 65535", where=where, remedy="save the image as PNG"
        )
    return values


FORMATS = "PNG, BMP, JPEG, TIFF or PGM"
PNG_GREY_WITH_ALPHA = 4
DEFAULT_OPTIONS = ImageOptions()


def read_exposure(
    path: Path | str,
    options: ImageOptions = DEFAULT_OPTIONS,
    *,
    source: str | None = None,
) -> Exposure:
    """Read an image file of 8 to 16 bits, grey or colour.

    An orientation that a camera wrote into the file is ignored: a lens does not turn with the
    picture. An alpha channel is dropped if it is opaque everywhere or, but in TIFF, 0
    everywhere, and refused otherwise. A TIFF file that holds several images of one size is refused.

    Parameters
    ----------
    path
        A PNG, BMP, JPEG, TIFF or PGM file.
    options
        What the file does not say about its pixels.
    source
        Name for messages and reports; the file's name if None.

    Raises
    ------
    OptionError
        If pixels exceed the stated bits.
    """
    path = Path(path)
    name = path_text(path.name) if source is None else source
    data = read_bytes(path)
    kind = image_format(data)
    if kind is None:
        raise FileFormatError(
            f"this is not a {FORMATS} image",
            where=str(path),
            remedy="give an image, and copy it again if it was one",
        )
    check_complete(data, str(path))
    image, stated_bits = decode_netpbm(data, str(path)) if kind == "PGM" else _decode(data, path)
    bits = options.bits_used or stated_bits
    if bits > 8 * image.dtype.itemsize:
        raise OptionError(
            f"the file has {8 * image.dtype.itemsize} bits a pixel, not {bits}",
            where=str(path),
            remedy="give the bits that the file has, or leave the option out",
        )
    if options.align == "high":
        image = _as_image(image >> (8 * image.dtype.itemsize - bits))
    if int(image.max()) >= 1 << bits:
        raise OptionError(
            f"pixels reach {int(image.max())}, more than {bits} bits hold",
            where=str(path),
            remedy="state the bits that the camera uses (--bits-used), and --bits-align high where "
            "they are the upper ones of 16",
        )
    return Exposure(image, name, bits_used=bits)


def read_exposures(
    paths: Sequence[Path],
    options: ImageOptions = DEFAULT_OPTIONS,
) -> tuple[Exposure, ...]:
    """Read image files; each is named as `source_names` says."""
    names = source_names(paths)
    return tuple(
        read_exposure(path, options, source=name) for path, name in zip(paths, names, strict=True)
    )


NAMED = 5
"""Images that a message names."""


def check_same_size(exposures: Sequence[Exposure]) -> None:
    """Raise if images that one camera took differ in size.

    Raises
    ------
    InputError
        Naming the images that differ from the majority.
    """
    sizes = Counter((exposure.width_px, exposure.height_px) for exposure in exposures)
    if len(sizes) < 2:
        return
    usual = sizes.most_common(1)[0][0]
    odd = [item for item in exposures if (item.width_px, item.height_px) != usual]
    width, height = odd[0].width_px, odd[0].height_px
    more = listed([item.source for item in odd[1:]], NAMED)
    also = f" (another size, too: {more})" if more else ""
    raise InputError(
        f"the image is {width} x {height} px, others are {usual[0]} x {usual[1]} px{also}",
        where=odd[0].source,
        remedy="give images of one camera in its full size, none cropped, scaled or turned, "
        "or leave it out",
    )


def of_one_size(exposures: Sequence[Exposure], leave_out: Sequence[str]) -> tuple[Exposure, ...]:
    """Images of one camera; of those left out, by source, only what has the size of the others.

    Raises
    ------
    InputError
        If those that are not left out differ in size.
    """
    used = [exposure for exposure in exposures if exposure.source not in leave_out]
    check_same_size(used)
    if not used:
        return tuple(exposures)
    size = (used[0].width_px, used[0].height_px)
    return tuple(item for item in exposures if (item.width_px, item.height_px) == size)


def source_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of files for messages: the file name, with folders where file names repeat."""
    tails = [list(reversed(path_text(path).split("/"))) for path in paths]
    names = [tail[0] for tail in tails]
    for depth in range(2, max(map(len, tails), default=0) + 1):
        repeated = {name for name, count in Counter(names).items() if count > 1}
        names = [
            "/".join(reversed(tail[:depth])) if name in repeated else name
            for name, tail in zip(names, tails, strict=True)
        ]
    return tuple(names)


def _decode(data: bytes, path: Path) -> tuple[ImageArray, int]:
    """Decode with OpenCV to (H, W) or (H, W, 3) red, green, blue, with all bits of the type."""
    if image_format(data) == "TIFF":
        data = _plain_tiff(data, str(path))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise FileFormatError(
            "the image cannot be decoded",
            where=str(path),
            remedy="open it in a viewer and save it as PNG",
        )
    pixels: NDArray[Any] = np.asarray(image)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise FileFormatError(
            f"pixels have type {pixels.dtype}", where=str(path), remedy="save 8 or 16 bits a pixel"
        )
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        alpha = pixels[:, :, 3]
        # all zero is what writers of four bytes a pixel leave in the one that they do not use; of a
        # TIFF the decoder may have made black what is transparent
        is_filled = bool(alpha.any()) or image_format(data) == "TIFF"
        if is_filled and int(alpha.min()) < np.iinfo(pixels.dtype).max:
            raise FileFormatError(
                "the image has transparent pixels",
                where=str(path),
                remedy="save it without an alpha channel",
            )
        pixels = pixels[:, :, :3]
        if image_format(data) == "PNG" and data[25] == PNG_GREY_WITH_ALPHA:
            pixels = pixels[:, :, 0]
    if pixels.ndim == 3:
        pixels = pixels[:, :, 0] if pixels.shape[2] == 1 else pixels[:, :, ::-1]
    return _as_image(pixels), 8 * pixels.dtype.itemsize


def _as_image(pixels: NDArray[Any]) -> ImageArray:
    is_byte = pixels.dtype == np.uint8
    return pixels.astype(np.uint8) if is_byte else pixels.astype(np.uint16)


def raw_encoding(image: ImageArray, colour: str, source: str) -> str:
    """Name by which viewers of recordings know how pixels are stored.

    Raises
    ------
    InputError
        If no viewer knows such pixels.
    """
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        return "rgb8"
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or not image.size:
        raise InputError(
            f"an image of shape {image.shape} and type {image.dtype} is not recorded raw",
            where=source,
            remedy="give uint8, or uint16 of one channel, or the bytes of an image file",
        )
    if image.dtype == np.uint16:
        return "mono16"
    return "bayer_rggb8" if colour == "bayer_rggb" else "mono8"
