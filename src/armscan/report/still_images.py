# SPDX-License-Identifier: Apache-2.0
"""Images of stills: of files, or of a recording; of one camera or two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armscan.pipeline.instants import PARTNER_MISSING, ScanInstants
from armscan.records.exposure import Exposure
from armscan.storage.image_options import ImageOptions
from armscan.storage.image_paths import expand_paths
from armscan.storage.images import read_exposures
from armscan.storage.recording_reader import FolderRecording, is_recording, read_recording

LISTED = 4


@dataclass(frozen=True, slots=True, eq=False)
class CameraImages:
    """What one camera took: with laser, and the same without, one for each or none."""

    lit: tuple[Exposure, ...] = ()
    dark: tuple[Exposure, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StillImages:
    """Images of one camera or two, and the files that they came from.

    Parameters
    ----------
    lit_paths, dark_paths
        Files with laser and without.
    left, right
        Exposures; of the right camera none where there is one only.
    warnings
        What was left out, in words.
    """

    lit_paths: tuple[Path, ...]
    dark_paths: tuple[Path, ...]
    left: CameraImages
    right: CameraImages
    warnings: tuple[str, ...] = ()

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """All of them."""
        return (*self.left.lit, *self.left.dark, *self.right.lit, *self.right.dark)


@dataclass(frozen=True, slots=True)
class StillPaths:
    """Files, folders or patterns of images, or the folder of one recording.

    Parameters
    ----------
    images, background
        With the laser on and off.
    right, right_background
        The same of the right camera.
    """

    images: tuple[str, ...]
    background: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    right_background: tuple[str, ...] = ()


def read_stills(paths: StillPaths, options: ImageOptions, n_cameras: int) -> StillImages:
    """Read images of files and folders, or the exposures of one recording.

    Raises
    ------
    ArmscanError
        If an image cannot be read, or a recording has not that many cameras, or not one instant of
        which all have an image.
    """
    folder = Path(paths.images[0]) if len(paths.images) == 1 else None
    if folder is not None and is_recording(folder) and not (paths.background or paths.right):
        return _of_recording(folder, n_cameras)
    groups = [
        expand_paths(names) if names else ()
        for names in (paths.images, paths.background, paths.right, paths.right_background)
    ]
    every = read_exposures([path for group in groups for path in group], options)
    ends = [sum(len(group) for group in groups[: k + 1]) for k in range(len(groups))]
    lit, dark, right, right_dark = (
        tuple(every[end - len(group) : end]) for group, end in zip(groups, ends, strict=True)
    )
    return StillImages(
        (*groups[0], *groups[2]),
        (*groups[1], *groups[3]),
        CameraImages(lit, dark),
        CameraImages(right, right_dark),
    )


def _of_recording(folder: Path, n_cameras: int) -> StillImages:
    recording = read_recording(folder)
    scan = ScanInstants(recording, n_cameras)
    cameras = []
    warnings = list(_alone(recording, scan))
    for camera in range(n_cameras):
        pairs = [scan.pair(one.rows[camera]) for one in scan.lit]
        dark = [background for _, background in pairs if background is not None]
        is_complete = len(dark) == len(pairs)
        if dark and not is_complete:
            warnings.append(_dark_left_out(camera, n_cameras, len(pairs) - len(dark), len(pairs)))
        cameras.append(
            CameraImages(tuple(on for on, _ in pairs), tuple(dark) if is_complete else ())
        )
    left, right = (*cameras, CameraImages())[:2]
    return StillImages(
        _paths(folder, (*left.lit, *right.lit)),
        _paths(folder, (*left.dark, *right.dark)),
        left,
        right,
        tuple(warnings),
    )


def _alone(recording: FolderRecording, scan: ScanInstants) -> tuple[str, ...]:
    names = [recording.rows[row].source for row in scan.without_partner]
    if not names:
        return ()
    named = ", ".join(names[:LISTED])
    return (f"{len(names)} images were not used, {PARTNER_MISSING}: {named}",)


def _dark_left_out(camera: int, n_cameras: int, n_without: int, n: int) -> str:
    whose = f" of camera {camera}" if n_cameras > 1 else ""
    return (
        f"{n_without} of {n} images{whose} have no image without laser of their view: none of its "
        "images had a background subtracted"
    )


def _paths(folder: Path, exposures: Sequence[Exposure]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys(folder / exposure.source for exposure in exposures))
