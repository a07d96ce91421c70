# SPDX-License-Identifier: Apache-2.0
"""Rough chessboard corners by OpenCV's two finders."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.vision.targets.grey import Grey8, RawGrey, grey_channels, reduced, to_grey8

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
_SECTOR = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
_SMALLEST = 3


def rough_corners(
    exposure: Exposure, columns: int, rows: int, search_size_px: int
) -> Iterator[tuple[RawGrey, FloatArray]]:
    """Yield what the finders see, cheapest first.

    The classic finder runs on every channel, then the sector-based finder: it needs fifty times
    longer and sees boards in dark, noisy channels.

    Yields
    ------
    grey
        (H, W) raw levels of the channel in which the board shows.
    corners_px
        (rows * columns, 2) corners, image pixels, to about 1 px, in OpenCV's order.
    """
    channels = grey_channels(exposure)
    small = [
        reduced(to_grey8(channel, exposure.full_scale), search_size_px) for channel in channels
    ]
    for finder, index in product((_find_classic, _find_by_sectors), range(len(channels))):
        grey8, factor = small[index]
        corners = finder(grey8, (columns, rows))
        if corners is not None:
            yield channels[index], (corners + 0.5) * factor - 0.5


def seen_size(exposure: Exposure, search_size_px: int) -> tuple[int, int] | None:
    """Size of the largest chessboard of any size in the image, larger count first."""
    best: tuple[int, int] | None = None
    for channel in grey_channels(exposure)[:2]:
        grey8, _ = reduced(to_grey8(channel, exposure.full_scale), search_size_px)
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(
            grey8,
            (_SMALLEST, _SMALLEST),
            cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE,
        )
        if not found or corners is None or meta is None:
            continue
        size = (max(meta.shape[:2]), min(meta.shape[:2]))
        if best is None or size[0] * size[1] > best[0] * best[1]:
            best = size
    return best


def _find_classic(grey8: Grey8, size: tuple[int, int]) -> FloatArray | None:
    return _points(cv2.findChessboardCorners(grey8, size, flags=_CLASSIC))


def _find_by_sectors(grey8: Grey8, size: tuple[int, int]) -> FloatArray | None:
    return _points(cv2.findChessboardCornersSB(grey8, size, flags=_SECTOR))


def _points(answer: tuple[bool, object]) -> FloatArray | None:
    found, corners = answer
    if not found or corners is None:
        return None
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2)
