# SPDX-License-Identifier: Apache-2.0
"""Laser light in a region of the sensor: profile, motion, speckle and blur on half pixels.

Only tiles that light reaches are worked on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from armscan.geometry.arrays import BoolArray
from armscan.simulation.laser_source import TracedLight
from armscan.simulation.optics import RenderCamera, blur_image
from armscan.simulation.region import Image32, Region
from armscan.simulation.render import BLUR_REACH, SUBPIXELS, Speckle
from armscan.simulation.sheet_light import PosedView, SheetImage, trace_sheet

_TILE_ROWS, _TILE_COLUMNS = 48, 192
_GRAIN_CELLS = 1536


def band_light(
    views: Sequence[PosedView],
    camera: RenderCamera,
    source: TracedLight,
    region: Region,
    *,
    speckle: Speckle,
    rng: np.random.Generator,
) -> Image32:
    """Light (H, W) of one source in a region, parts of full scale, blurred; mean over the views."""
    sheets = [trace_sheet(view, camera, source, region) for view in views]
    is_lit = np.logical_or.reduce([sheet.is_lit for sheet in sheets])
    light = np.zeros(is_lit.shape, np.float32)
    margin = int(np.ceil(BLUR_REACH * camera.blur_sigma_px)) + 1
    for top in range(0, region.height_px, _TILE_ROWS):
        for left in range(0, region.width_px, _TILE_COLUMNS):
            inner = _slices(is_lit, top, left, 0)
            outer = _slices(is_lit, top, left, margin)
            if not is_lit[outer].any():
                continue
            fine = sum((_fine(sheet, outer) for sheet in sheets[1:]), _fine(sheets[0], outer))
            fine *= np.float32(1.0 / len(sheets)) * speckle_piece(fine.shape, speckle, rng)
            blurred = blur_image(fine, SUBPIXELS * camera.blur_sigma_px)
            size = (fine.shape[1] // SUBPIXELS, fine.shape[0] // SUBPIXELS)
            tile = cv2.resize(blurred, size, interpolation=cv2.INTER_AREA)
            y, x = inner[0].start - outer[0].start, inner[1].start - outer[1].start
            rows, columns = light[inner].shape
            light[inner] = tile[y : y + rows, x : x + columns]
    return light


def _slices(image: BoolArray, top: int, left: int, margin: int) -> tuple[slice, slice]:
    rows = slice(max(top - margin, 0), min(top + _TILE_ROWS + margin, image.shape[0]))
    columns = slice(max(left - margin, 0), min(left + _TILE_COLUMNS + margin, image.shape[1]))
    return rows, columns


def _fine(sheet: SheetImage, where: tuple[slice, slice]) -> Image32:
    """Light of one sheet on the fine grid of a tile."""
    reach, peak = _finer(sheet.reach[where]), _finer(sheet.peak[where])
    light = peak * np.exp(-0.5 * reach * reach)
    edges = sheet.edges[where]
    rows, columns = np.nonzero(edges >= 0)
    if len(rows):
        exact = sheet.edge_light[edges[rows, columns]]
        for b in range(SUBPIXELS):
            for a in range(SUBPIXELS):
                light[SUBPIXELS * rows + b, SUBPIXELS * columns + a] = exact[:, b, a]
    return np.asarray(light)


def _finer(image: Image32) -> Image32:
    size = (SUBPIXELS * image.shape[1], SUBPIXELS * image.shape[0])
    finer = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(finer, dtype=np.float32)


def speckle_piece(shape: tuple[int, ...], speckle: Speckle, rng: np.random.Generator) -> Image32:
    """Speckle of a tile: a random piece of one large field."""
    if speckle.contrast == 0.0:
        return np.ones(shape, np.float32)
    y, x = (int(rng.integers(0, _GRAIN_CELLS - n)) for n in shape)
    piece = _grain_field(speckle)[y : y + shape[0], x : x + shape[1]]
    flip_y, flip_x = 1 - 2 * rng.integers(0, 2, 2)
    return piece[::flip_y, ::flip_x]


@lru_cache(maxsize=4)
def _grain_field(speckle: Speckle) -> Image32:
    """Positive random field of mean 1: its logarithm is normal, smoothed to the grain."""
    rng = np.random.default_rng(633)
    normal = rng.standard_normal((_GRAIN_CELLS, _GRAIN_CELLS), dtype=np.float32)
    if speckle.grain_px > 0.0:
        normal = blur_image(normal, SUBPIXELS * speckle.grain_px)
        normal = normal / normal.std()
    variance = np.log1p(speckle.contrast**2)
    field = np.exp(np.sqrt(variance) * normal - 0.5 * variance)
    return np.asarray(field / field.mean(), dtype=np.float32)
