# SPDX-License-Identifier: Apache-2.0
"""Image files to exposures: raw pixels, never turned, never rescaled."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError, InputError, OptionError
from armscan.geometry.arrays import ImageArray
from armscan.records.exposure import Exposure
from armscan.storage.image_format import check_complete, image_format
from armscan.storage.image_options import ImageOptions
from armscan.storage.netpbm import decode_netpbm

FORMATS = "PNG, BMP, JPEG, TIFF or PGM"
PNG_GREY_WITH_ALPHA = 4
DEFAULT_OPTIONS = ImageOptions()


def read_exposure(
    path: Path | str,
    options: ImageOptions = DEFAULT_OPTIONS,
    *,
    source: str | None = None,
    lasers: tuple[str, ...] = (),
) -> Exposure:
    """Read an image file of 8 to 16 bits, grey or colour.

    An orientation that a camera wrote into the file is ignored: a lens does not turn with the
    picture. An alpha channel is dropped if it is opaque everywhere, and refused otherwise.

    Parameters
    ----------
    path
        A PNG, BMP, JPEG, TIFF or PGM file.
    options
        What the file does not say about its pixels.
    source
        Name for messages and reports; the file's name if None.
    lasers
        Names of the laser sources that were on.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, cut short, or no such image.
    OptionError
        If pixels exceed the stated bits.
    """
    path = Path(path)
    name = path.name if source is None else source
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
            remedy="state the bits that the camera uses",
        )
    return Exposure(image, name, bits_used=bits, lasers=lasers)


def read_exposures(
    paths: Sequence[Path],
    options: ImageOptions = DEFAULT_OPTIONS,
) -> tuple[Exposure, ...]:
    """Read image files; each is named as `source_names` says."""
    names = source_names(paths)
    return tuple(
        read_exposure(path, options, source=name) for path, name in zip(paths, names, strict=True)
    )


def check_same_size(exposures: Sequence[Exposure]) -> None:
    """Raise if images that one camera took differ in size.

    Raises
    ------
    InputError
        Naming the first image that differs from the majority.
    """
    sizes = Counter((exposure.width_px, exposure.height_px) for exposure in exposures)
    if len(sizes) < 2:
        return
    usual = sizes.most_common(1)[0][0]
    odd = next(item for item in exposures if (item.width_px, item.height_px) != usual)
    raise InputError(
        f"the image is {odd.width_px} x {odd.height_px} px, others are {usual[0]} x {usual[1]} px",
        where=odd.source,
        remedy="give images of one camera in its full size, none cropped, scaled or turned",
    )


def source_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of files for messages: the file name, with folders where file names repeat."""
    tails = [list(reversed(path.as_posix().split("/"))) for path in paths]
    names = [tail[0] for tail in tails]
    for depth in range(2, max(map(len, tails), default=0) + 1):
        repeated = {name for name, count in Counter(names).items() if count > 1}
        names = [
            "/".join(reversed(tail[:depth])) if name in repeated else name
            for name, tail in zip(names, tails, strict=True)
        ]
    return tuple(names)


def read_bytes(path: Path) -> bytes:
    """Content of a file that must exist and hold something.

    Raises
    ------
    FileFormatError
        If there is no such file, it is a folder, it is empty or it may not be read.
    """
    if path.is_dir():
        raise FileFormatError("this is a folder, not a file", where=str(path), remedy="name a file")
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FileFormatError(
            "there is no such file", where=str(path), remedy="check the path"
        ) from error
    except OSError as error:
        raise FileFormatError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="check that it may be read",
        ) from error
    if not data:
        raise FileFormatError(
            "the file is empty (0 bytes)", where=str(path), remedy="copy the file again"
        )
    return data


def _decode(data: bytes, path: Path) -> tuple[ImageArray, int]:
    """Decode with OpenCV to (H, W) or (H, W, 3) red, green, blue, with all bits of the type."""
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
        if int(pixels[:, :, 3].min()) < np.iinfo(pixels.dtype).max:
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
