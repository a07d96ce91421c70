# SPDX-License-Identifier: Apache-2.0
"""A folder of photographs, rendered: what a lab with a camera, a line laser and a board has.

``camera/`` holds photos of the board, ``laser/on`` and ``laser/off`` the board with and without
the laser's line, ``object/`` a bust with and without it, and ``truth.json`` what they were
rendered from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ImageArray
from armscan.simulation.bench import CAMERA_PLACES, LASER_PLACES, TARGET, Bench
from armscan.simulation.photo_truth import PhotoSetTruth, write_truth, write_whole

Report: TypeAlias = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class PhotoSetOptions:
    """How many photos, how large, and how bright the laser is.

    Parameters
    ----------
    width_px, height_px
        Size of every photo; the field of view stays the same.
    n_camera, n_laser
        Photos of the board for the camera, and placements for the laser.
    laser_irradiance
        Light of the laser on a white board, as parts of full scale.
    skew_rad
        Bow of the laser's sheet; see `LineLaser`.
    """

    width_px: int = 1280
    height_px: int = 960
    n_camera: int = len(CAMERA_PLACES)
    n_laser: int = len(LASER_PLACES)
    laser_irradiance: float = 1.9
    skew_rad: float = 0.008

    def __post_init__(self) -> None:
        if min(self.width_px, self.height_px) < 240:
            raise InputError(f"photos of {self.width_px} x {self.height_px} px are too small")
        for count, places in ((self.n_camera, CAMERA_PLACES), (self.n_laser, LASER_PLACES)):
            if not 1 <= count <= len(places):
                raise InputError(f"{count} photos asked for; 1 to {len(places)} can be rendered")


def render_photo_set(
    folder: Path,
    seed: int = 1,
    progress: Report | None = None,
    options: PhotoSetOptions | None = None,
) -> PhotoSetTruth:
    """Render the photographs into a folder and return their truth.

    Parameters
    ----------
    folder
        Made if need be; files of the same names are replaced.
    seed
        Placement jitter and noise.
    progress
        Called with photos written, photos in all, and the name of the latest.
    options
        Counts and sizes.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    settings = PhotoSetOptions() if options is None else options
    rng = np.random.default_rng(seed)
    bench = Bench.build(
        settings.width_px, settings.height_px, settings.laser_irradiance, settings.skew_rad
    )
    album = _Album(folder, settings.n_camera + 2 * settings.n_laser + 2, progress)
    camera_boards = []
    for k, place in enumerate(CAMERA_PLACES[: settings.n_camera], start=1):
        image, board = bench.photograph_board(place, rng)
        album.add(f"camera/{k:02d}.png", image)
        camera_boards.append(board)
    laser_boards, stripes = [], []
    for k, place in enumerate(LASER_PLACES[: settings.n_laser], start=1):
        on, off, board, stripe = bench.photograph_stripe(place, rng)
        album.add(f"laser/on/{k:02d}.png", on)
        album.add(f"laser/off/{k:02d}.png", off)
        laser_boards.append(board)
        stripes.append(stripe)
    on, off, body, body_stripe = bench.photograph_object(rng)
    album.add("object/laser.png", on)
    album.add("object/background.png", off)
    truth = PhotoSetTruth(
        seed=seed,
        target=TARGET,
        camera=bench.camera,
        laser=bench.laser,
        camera_boards=tuple(camera_boards),
        laser_boards=tuple(laser_boards),
        laser_stripes=tuple(stripes),
        body=body,
        body_stripe=body_stripe,
    )
    write_truth(folder / "truth.json", truth)
    return truth


@dataclass(slots=True)
class _Album:
    """Writes photos and counts them."""

    folder: Path
    total: int
    progress: Report | None
    names: list[str] = field(default_factory=list)

    def add(self, name: str, image: ImageArray) -> None:
        """Write one photo, red first, as PNG; whole or not at all."""
        stored = image if image.ndim == 2 else image[..., ::-1]
        is_encoded, content = cv2.imencode(".png", stored)
        if not is_encoded:
            raise InputError("the photo cannot be encoded as PNG", where=name)
        write_whole(self.folder / name, content.tobytes())
        self.names.append(name)
        if self.progress is not None:
            self.progress(len(self.names), self.total, name)
