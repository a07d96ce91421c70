# SPDX-License-Identifier: Apache-2.0
"""Images of a folder recording: read as its session says, and encoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import ArmscanError, FileFormatError, InputError
from armscan.geometry.arrays import ImageArray
from armscan.records.exposure import Exposure
from armscan.records.session import CameraSetup, ExposureRow
from armscan.storage.image_options import ImageOptions
from armscan.storage.images import read_exposure

PNG_COMPRESSION = 1


def read_recorded(folder: Path, row: ExposureRow, setup: CameraSetup) -> Exposure:
    """Read the image of a row; a Bayer pattern is turned into red, green and blue.

    The pattern ``bayer_rggb`` begins with red at the image's top-left pixel, wherever the window
    lies.

    Raises
    ------
    FileFormatError
        If the image is missing or damaged, or its size or layout is not the camera's.
    OptionError
        If pixels exceed the stated bits.
    """
    path = folder / row.source
    options = ImageOptions(setup.bits_used, setup.align)
    image = read_exposure(path, options, source=row.source)
    _check_layout(image, setup, path)
    _check_size(image, setup, path)
    pixels = image.image if setup.colour != "bayer_rggb" else _demosaiced(image.image)
    return Exposure(
        pixels,
        row.source,
        bits_used=image.bits_used,
        window=setup.window,
        lasers=row.lasers,
        t_ns=row.t_ns,
        camera=row.camera,
        trigger_id=row.trigger_id,
        view=row.view,
    )


def setup_of_image(path: Path, setup: CameraSetup, lacking: Sequence[str]) -> CameraSetup:
    """Complete what nobody said about a camera by one of its images.

    Parameters
    ----------
    path
        The image.
    setup
        What is known, defaults elsewhere.
    lacking
        Names of the fields that nobody said.
    """
    bits = None if "bits_used" in lacking else setup.bits_used
    image = read_exposure(path, ImageOptions(bits, setup.align))
    found: dict[str, Any] = {key: getattr(image, key) for key in lacking}
    return replace(setup, **found)


def window_note(path: Path, setup: CameraSetup) -> str:
    """A sentence if an image is smaller than its camera, whose window nobody said; else empty.

    An image that cannot be read is no matter of this note; it is named when it is asked for.
    """
    try:
        image = read_exposure(path)
    except ArmscanError:
        return ""
    size = (setup.width_px or image.width_px, setup.height_px or image.height_px)
    is_larger = image.width_px > size[0] or image.height_px > size[1]
    if is_larger or (image.width_px, image.height_px) == size:
        return ""
    return (
        f"{path.name} with {image.width_px} x {image.height_px} px is a window at "
        f"{setup.window.x_px}, {setup.window.y_px} of the camera's {size[0]} x {size[1]} px; "
        "window_x_px and window_y_px say where it begins"
    )


def encoded_png(exposure: Exposure, setup: CameraSetup) -> bytes:
    """PNG of an exposure, little compressed: lossless and quick.

    Raises
    ------
    InputError
        If its bits, layout or window are not those of the camera.
    """
    said = (setup.bits_used, setup.colour, setup.window)
    has = (exposure.bits_used, exposure.colour, exposure.window)
    if said != has:
        raise InputError(
            f"the exposure has bits, colour and window {has}, its camera {said}",
            where=exposure.source,
        )
    pixels: NDArray[Any] = exposure.image
    stored = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])
    is_encoded, content = cv2.imencode(
        ".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
    )
    if not is_encoded:
        raise InputError("the image cannot be encoded as PNG", where=exposure.source)
    return bytes(content.tobytes())


def _demosaiced(mosaic: ImageArray) -> ImageArray:
    colour: NDArray[Any] = cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB)
    return colour.astype(np.uint8) if mosaic.dtype == np.uint8 else colour.astype(np.uint16)


def _check_layout(image: Exposure, setup: CameraSetup, path: Path) -> None:
    wanted = "rgb" if setup.colour == "rgb" else "mono"
    if image.colour != wanted:
        channels = "three channels" if image.colour == "rgb" else "one channel"
        raise FileFormatError(
            f"the image has {channels}, but its camera is '{setup.colour}'",
            where=str(path),
            remedy="correct colour under [[camera]] in session.toml",
        )


def _check_size(image: Exposure, setup: CameraSetup, path: Path) -> None:
    """An image has its camera's size, or is smaller and lies inside it at the window's place."""
    have = np.array([image.width_px, image.height_px])
    if setup.width_px is None or setup.height_px is None:
        return
    size = np.array([setup.width_px, setup.height_px])
    corner = np.array([setup.window.x_px, setup.window.y_px])
    is_whole = bool((have == size).all())
    is_inside = bool((corner + setup.window.binning * have <= size).all())
    if not (is_whole or is_inside):
        place = f" with a window at {corner[0]}, {corner[1]}" if corner.any() else ""
        raise FileFormatError(
            f"the image is {have[0]} x {have[1]} px, its camera {size[0]} x {size[1]} px{place}",
            where=str(path),
            remedy="correct the sizes in session.toml, or leave images of another camera out",
        )
