# SPDX-License-Identifier: Apache-2.0
"""Laser light in a window of the sensor, quickly: one ray a pixel, and only near the sheet.

Between pixels the distance from the sheet and the brightness without profile change smoothly, so
they are interpolated onto a grid of half pixels on which the sheet's profile, the speckle and the
lens's blur act. Pixels at edges, where they do not, are traced anew on the finer grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera, blur_image
from armscan.simulation.render import (
    BAND_SIGMAS,
    BLUR_REACH,
    COARSE_STEP_PX,
    SUBPIXELS,
    Speckle,
    pixels_near_sheet,
)
from armscan.simulation.scene import FAINTEST, Hits, Scene
from armscan.simulation.stripe_truth import camera_rays
from armscan.simulation.thing import Finish

Image32 = NDArray[np.float32]

RAY_TOLERANCE = 1e-7
"""The search for a pixel's ray stops at such a step: what is left is below 1e-4 px."""
_FAR_SIGMAS = 9.0
_SLACK_SIGMAS = 0.6
"""Half a pixel across the line, and what interpolation on the coarse grid may be wrong by."""
_EDGE_SIGMAS = 1.5
_EDGE_SHARE = 0.08
_TILE_ROWS, _TILE_COLUMNS = 48, 192
_GRAIN_CELLS = 1536
_MARGIN_PX = 2 * COARSE_STEP_PX


@dataclass(frozen=True, slots=True)
class Region:
    """Rectangle of full-sensor pixels whose sides are whole cells of the coarse grid."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    @staticmethod
    def around(x_px: int, y_px: int, width_px: int, height_px: int) -> Region:
        """Smallest region with a margin around a window: blur brings light in from there."""
        step = COARSE_STEP_PX
        x, y = (x_px - _MARGIN_PX) // step * step, (y_px - _MARGIN_PX) // step * step
        right, bottom = x_px + width_px + _MARGIN_PX, y_px + height_px + _MARGIN_PX
        return Region(x, y, -(-(right - x) // step) * step, -(-(bottom - y) // step) * step)

    def nodes_px(self) -> tuple[FloatArray, tuple[int, int]]:
        """(N, 2) full-sensor pixels of the coarse grid's nodes, and the grid's shape."""
        u = self.x_px + np.arange(0, self.width_px + 1, COARSE_STEP_PX)
        v = self.y_px + np.arange(0, self.height_px + 1, COARSE_STEP_PX)
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        return grid.astype(np.float64), (len(v), len(u))


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """What one pose of the exposure sees.

    Parameters
    ----------
    scene
        Surfaces in the Sensor frame.
    finishes
        One for each surface.
    nodes
        Hits of the coarse grid's rays.
    """

    scene: Scene
    finishes: tuple[Finish, ...]
    nodes: Hits


@dataclass(frozen=True, slots=True, eq=False)
class _Sheet:
    """One laser seen from one pose.

    Parameters
    ----------
    reach, peak
        (H, W) distance from the sheet's centre in sigmas, and light were it zero.
    edges
        (H, W) row of ``edge_light`` for pixels at edges, else -1.
    edge_light
        (E, SUBPIXELS, SUBPIXELS) light of these.
    is_lit
        (H, W) pixels that were traced.
    """

    reach: Image32
    peak: Image32
    edges: NDArray[np.int32]
    edge_light: Image32
    is_lit: BoolArray


def look(
    scene: Scene, finishes: tuple[Finish, ...], camera: RenderCamera, region: Region
) -> PosedView:
    """Trace the coarse grid of a region."""
    nodes, _ = region.nodes_px()
    hits = scene.trace(np.zeros(3), camera_rays(camera, nodes, RAY_TOLERANCE))
    return PosedView(scene, finishes, hits)


def band_light(
    views: Sequence[PosedView],
    camera: RenderCamera,
    laser: LineLaser,
    region: Region,
    *,
    speckle: Speckle,
    rng: np.random.Generator,
) -> Image32:
    """Light (H, W) of one laser in a region, parts of full scale, blurred; mean over the views."""
    sheets = [_sheet(view, camera, laser, region) for view in views]
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
            fine *= np.float32(1.0 / len(sheets)) * _grain(fine.shape, speckle, rng)
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


def _sheet(view: PosedView, camera: RenderCamera, laser: LineLaser, region: Region) -> _Sheet:
    """Trace one ray for every pixel that the laser's light may reach."""
    shape = (region.height_px, region.width_px)
    is_lit, reach = _near_sheet(view, laser, region)
    rows, columns = np.nonzero(is_lit)
    values = _shade(view, camera, laser, _pixels(region, rows, columns))
    peak = np.zeros(shape, np.float32)
    reach[rows, columns] = np.clip(values[0], -_FAR_SIGMAS, _FAR_SIGMAS)
    peak[rows, columns] = values[1]
    edge_rows, edge_columns = _edges(reach, peak, is_lit)
    edges = np.full(shape, -1, np.int32)
    edges[edge_rows, edge_columns] = np.arange(len(edge_rows))
    edge_light = _edge_light(view, camera, laser, _pixels(region, edge_rows, edge_columns))
    return _Sheet(reach, peak, edges, edge_light, is_lit)


def _near_sheet(view: PosedView, laser: LineLaser, region: Region) -> tuple[BoolArray, Image32]:
    """(H, W) pixels that the light may reach, and the coarse reach for all the others.

    Where the coarse grid meets one surface smoothly, the reach is interpolated to tell; elsewhere
    all pixels of cells next to the sheet are taken.
    """
    _, shape = region.nodes_px()
    surface = view.nodes.surface
    reach = np.full(len(surface), np.nan)
    is_hit = surface >= 0
    reach[is_hit] = laser.reach_mm(view.nodes.points_mm[is_hit])
    band = pixels_near_sheet(reach.reshape(shape))
    coarse = np.where(is_hit, reach, 0.0).reshape(shape).astype(np.float32)
    between = to_pixels(coarse, region)
    is_rough = _rough_cells(coarse, surface.reshape(shape))
    # Outside, the sign of the reach still matters: it is interpolated across the band's rim.
    far = np.clip(between, -_FAR_SIGMAS, _FAR_SIGMAS)
    return band & (is_rough | (np.abs(between) < BAND_SIGMAS + _SLACK_SIGMAS)), far


def _rough_cells(reach: Image32, surface: IntArray) -> BoolArray:
    """(H, W) pixels of cells whose corners or neighbours differ in surface, or bend in reach."""
    square = np.ones((3, 3), np.uint8)
    marks = (surface + 1).astype(np.float32)
    differs = cv2.dilate(marks, square) != cv2.erode(marks, square)
    bends = np.abs(cv2.Laplacian(reach, cv2.CV_32F)) > _SLACK_SIGMAS
    rough = cv2.dilate((differs | bends | (surface < 0)).astype(np.uint8), square)[:-1, :-1]
    return np.asarray(np.kron(rough, np.ones((COARSE_STEP_PX, COARSE_STEP_PX), np.uint8)) > 0)


def to_pixels(nodes: Image32, region: Region) -> Image32:
    """(H, W) values of a region's pixels between those of its coarse grid."""
    step = 1.0 / COARSE_STEP_PX
    pixels = cv2.warpAffine(
        nodes,
        np.array([[step, 0.0, 0.0], [0.0, step, 0.0]]),
        (region.width_px, region.height_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(pixels, dtype=np.float32)


def _pixels(region: Region, rows: IntArray, columns: IntArray) -> FloatArray:
    """(N, 2) full-sensor pixels of rows and columns of a region."""
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    return np.asarray(pixels + np.array([region.x_px, region.y_px]))


def _shade(
    view: PosedView, camera: RenderCamera, laser: LineLaser, pixels: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Reach and peak (N,) at pixels (N, 2); the light is ``peak * exp(-reach**2 / 2)``."""
    reach, peak = np.full(len(pixels), _FAR_SIGMAS), np.zeros(len(pixels))
    hits = view.scene.trace(np.zeros(3), camera_rays(camera, pixels, RAY_TOLERANCE))
    met = np.flatnonzero(hits.surface >= 0)
    at = hits.select(met)
    normals = view.scene.normals(at)
    near, strength = laser.reach_and_peak(at.points_mm, normals)
    reach[met] = near
    lit = np.flatnonzero((np.abs(near) < BAND_SIGMAS + 1.0) & (strength > FAINTEST))
    lit = lit[view.scene.sees(laser.source_mm, at.points_mm[lit])]
    chosen = at.select(lit)
    reflected = view.scene.albedo(chosen)[:, 0] + _gloss(view, laser, chosen, normals[lit])
    peak[met[lit]] = strength[lit] * reflected
    return reach, peak


def _gloss(view: PosedView, laser: LineLaser, hits: Hits, normals: FloatArray) -> FloatArray:
    """(N,) glossy part: a Gaussian lobe of the angle between the normal and the half-way ray."""
    strength = np.array([finish.gloss for finish in view.finishes])[hits.surface]
    if not strength.any():
        return strength
    width = np.array([finish.gloss_width_rad for finish in view.finishes])[hits.surface]
    to_source, to_camera = laser.source_mm - hits.points_mm, -hits.points_mm
    half = to_source / np.linalg.norm(to_source, axis=1, keepdims=True)
    half = half + to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", half, normals) / np.linalg.norm(half, axis=1)
    angle_square = 2.0 * (1.0 - np.clip(cosine, -1.0, 1.0))
    return np.asarray(strength * np.exp(-0.5 * angle_square / width**2))


def _edges(reach: Image32, peak: Image32, is_lit: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of pixels whose surroundings cannot be interpolated: something jumps."""
    square = np.ones((3, 3), np.uint8)
    used = np.flatnonzero(is_lit.any(axis=1))
    if len(used) == 0:
        return used, used
    rows = slice(int(used[0]), int(used[-1]) + 1)
    near, light = reach[rows], peak[rows]
    spread = cv2.dilate(near, square) - cv2.erode(near, square)
    high = cv2.dilate(light, square)
    jump = high - cv2.erode(light, square)
    inside = cv2.erode(is_lit[rows].astype(np.uint8), square) > 0
    rough = (spread > _EDGE_SIGMAS) | (jump > _EDGE_SHARE * high)
    # A pixel that misses the light itself may hold a sample that does not.
    is_reached = (cv2.erode(np.abs(near), square) < BAND_SIGMAS) & (high > FAINTEST)
    found_rows, found_columns = np.nonzero(inside & rough & is_reached)
    return found_rows + rows.start, found_columns


def _edge_light(
    view: PosedView, camera: RenderCamera, laser: LineLaser, pixels: FloatArray
) -> Image32:
    """Light (E, SUBPIXELS, SUBPIXELS) of the fine cells of pixels (E, 2)."""
    offset = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    shift = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    fine = (pixels[:, None, :] + shift).reshape(-1, 2)
    reach, peak = _shade(view, camera, laser, fine)
    light = peak * np.exp(-0.5 * reach**2)
    return light.reshape(-1, SUBPIXELS, SUBPIXELS).astype(np.float32)


def _fine(sheet: _Sheet, where: tuple[slice, slice]) -> Image32:
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


def _grain(shape: tuple[int, ...], speckle: Speckle, rng: np.random.Generator) -> Image32:
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
