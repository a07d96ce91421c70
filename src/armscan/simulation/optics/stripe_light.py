# SPDX-License-Identifier: Apache-2.0
"""The light of a laser sheet on a camera's image, computed along the stripe at subpixel
sampling, with speckle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.kernels import add_fine_light, fill_between, mark_lit, mark_rough
from armscan.simulation.optics.camera import RenderCamera, blur_image
from armscan.simulation.optics.lasers import TracedLight
from armscan.simulation.optics.render import (
    BAND_SIGMAS,
    BLUR_REACH,
    SUBPIXELS,
    Image32,
    Region,
    Speckle,
    camera_rays,
    cells_near_sheet,
    enlarged,
    marked,
)
from armscan.simulation.optics.scene import FAINTEST, Hits, Material, Scene
from armscan.simulation.optics.tracing import LightNumbers, SceneNumbers

STRIDE_PX = 2
FAR_SIGMAS = 9.0
_SLACK_SIGMAS = 0.6
"""Half a pixel across the line, and what interpolation on the coarse grid may be wrong by."""
_EDGE_SIGMAS = 1.5
"""Neighbouring pixels whose reach differs by more lie on two sides of an edge."""
_EDGE_SHARE = 0.25
_BEND_SIGMAS = 0.01
"""Second difference above which every pixel is traced: an eighth of it is lost between."""
_BRIGHT_SIGMAS = 4.5
_RIM_PX = 4
"""Samples are traced so far around the light that its rim is not taken for an edge."""
_SQUARE = np.ones((3, 3), np.uint8)
_AROUND = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)

Bytes = NDArray[np.uint8]


def lit_pixels(
    nodes: Hits, light: TracedLight, region: Region, sigmas: float = BAND_SIGMAS
) -> Bytes:
    """(H, W) 1 for pixels of a region whose reach may be within some sigmas: that a light reaches.

    Where the coarse grid meets one surface smoothly, the reach is interpolated to tell; elsewhere
    all pixels of cells next to the sheet are taken.
    """
    _, shape = region.nodes_px()
    reach, rank = np.full(len(nodes.surface), np.nan), np.zeros(len(nodes.surface))
    is_hit = nodes.surface >= 0
    reach[is_hit], rank[is_hit] = light.reach_and_rank(nodes.points_mm[is_hit])
    cells = cells_near_sheet(reach.reshape(shape), rank.reshape(shape))
    coarse = np.where(is_hit, reach, 0.0).reshape(shape).astype(np.float32)
    rough = _rough_cells(coarse, nodes.surface.reshape(shape))
    is_lit = np.zeros((region.height_px, region.width_px), np.uint8)
    most = sigmas + _SLACK_SIGMAS
    mark_lit(coarse, cells.astype(np.uint8), rough.astype(np.uint8), most, is_lit)
    return is_lit


def _rough_cells(reach: Image32, surface: IntArray) -> BoolArray:
    """(H, W) cells whose corners or neighbours differ in surface, or bend in reach."""
    marks = (surface + 1).astype(np.float32)
    differs = cv2.dilate(marks, _SQUARE) != cv2.erode(marks, _SQUARE)
    bends = np.abs(cv2.Laplacian(reach, cv2.CV_32F)) > _SLACK_SIGMAS
    rough = cv2.dilate((differs | bends | (surface < 0)).astype(np.uint8), _SQUARE)
    return np.asarray(rough[:-1, :-1] > 0)


def _rough(reach: Image32, peak: Image32, known: Bytes, stride_px: int) -> Bytes:
    """(H, W) known samples around which something jumps: an edge, a shadow, another surface.

    Of samples further apart than a pixel, those too between which a straight line is not enough.
    """
    rough = np.zeros(reach.shape, np.uint8)
    bend = _BEND_SIGMAS if stride_px > 1 else 0.0
    limits = (BAND_SIGMAS, FAINTEST, stride_px * _EDGE_SIGMAS, _EDGE_SHARE, bend, _BRIGHT_SIGMAS)
    mark_rough(reach, peak, known, np.array(limits), rough)
    return rough


RAY_TOLERANCE = 1e-7
"""The search for a pixel's ray stops at such a step: what is left is below 1e-4 px."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """What one pose of the exposure sees, in Sensor; ``nodes`` are hits of the coarse grid's rays.

    ``numbers`` are None if the compiled loops do not know one of the surfaces.
    """

    scene: Scene
    finishes: tuple[Material, ...]
    nodes: Hits
    numbers: SceneNumbers | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SheetImage:
    """One laser seen from one pose, in the rows of a region that its light may reach.

    Parameters
    ----------
    top
        The first of these rows.
    reach, peak
        (H, W) distance from the sheet's centre in sigmas, and light were it zero; both are zero
        where no light comes near, and no reach is beyond `FAR_SIGMAS`.
    edges
        (H, W) for pixels at edges the row of ``edge_light``, counted from 1, else 0.
    edge_light
        (E, SUBPIXELS, SUBPIXELS) light of these.
    """

    top: int
    reach: Image32
    peak: Image32
    edges: NDArray[np.int32]
    edge_light: Image32


def look(
    scene: Scene, finishes: tuple[Material, ...], camera: RenderCamera, region: Region
) -> PosedView:
    """Trace the coarse grid of a region."""
    nodes, _ = region.nodes_px()
    numbers = SceneNumbers.of(scene, finishes)
    if numbers is not None:
        hits = numbers.trace(camera, nodes, RAY_TOLERANCE)
    else:
        hits = scene.trace(np.zeros(3), camera_rays(camera, nodes, RAY_TOLERANCE))
    return PosedView(scene, finishes, hits, numbers)


def trace_sheet(
    view: PosedView, camera: RenderCamera, light: TracedLight, region: Region, is_lit: Bytes
) -> SheetImage:
    """Trace what a light may reach in a region: its `lit_pixels` (H, W).

    Every second pixel of every second row is traced, and each where interpolation will not do.
    """
    eye, rows = (view, camera, light), _rows_around(is_lit)
    is_lit, corner = is_lit[rows], np.array([rows.start, 0])

    def shaded(at: tuple[IntArray, ...], stride_px: int) -> tuple[FloatArray, FloatArray]:
        v, u = (stride_px * k + first for k, first in zip(at, corner, strict=True))
        return shade(*eye, region.pixels_px(v, u))

    near = _dilated(is_lit, _AROUND)
    known = np.ascontiguousarray(near[::STRIDE_PX, ::STRIDE_PX])
    half_reach, half_peak = np.zeros(known.shape, np.float32), np.zeros(known.shape, np.float32)
    at = marked(known.view(np.bool_))
    half_reach[at], half_peak[at] = shaded(at, STRIDE_PX)
    reach, peak = np.zeros(is_lit.shape, np.float32), np.zeros(is_lit.shape, np.float32)
    fill_between(half_reach, half_peak, known, FAR_SIGMAS, reach, peak)
    rough = enlarged(_rough(half_reach, half_peak, known, STRIDE_PX), STRIDE_PX)
    traced = _dilated(rough, _SQUARE) & _dilated(is_lit, _SQUARE)
    at = marked(traced.view(np.bool_))
    reach[at], peak[at] = shaded(at, 1)
    found = _rough(reach, peak, near, 1) & cv2.erode(is_lit, _SQUARE).astype(np.uint8, copy=False)
    at = marked(found.view(np.bool_))
    edges = np.zeros(is_lit.shape, np.int32)
    edges[at] = np.arange(1, len(at[0]) + 1)
    pixels = region.pixels_px(at[0] + rows.start, at[1])
    cells = _cells_light(view, camera, light, pixels)
    return SheetImage(rows.start, reach, peak, edges, cells)


def _rows_around(is_lit: Bytes) -> slice:
    """Rows of an image (H, W) with what is lit in it, and more than is asked around that.

    They begin and end where the coarse samples do.
    """
    lit = np.flatnonzero(is_lit.view(np.bool_).any(axis=1))
    if len(lit) == 0:
        return slice(0, STRIDE_PX)
    step = 2 * STRIDE_PX
    top, bottom = int(lit[0]) - 2 * _RIM_PX, int(lit[-1]) + 1 + 2 * _RIM_PX
    return slice(max(top // step * step, 0), min(-(-bottom // step) * step, len(is_lit)))


def _dilated(marks: Bytes, around: Bytes) -> Bytes:
    return np.asarray(cv2.dilate(marks, around), dtype=np.uint8)


def _cells_light(
    view: PosedView, camera: RenderCamera, light: TracedLight, pixels: FloatArray
) -> Image32:
    """Light (E, SUBPIXELS, SUBPIXELS) of the fine cells of pixels (E, 2)."""
    offset = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    shift = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    reach, peak = shade(view, camera, light, (pixels[:, None, :] + shift).reshape(-1, 2))
    light_of = peak * np.exp(-0.5 * reach**2)
    return light_of.reshape(-1, SUBPIXELS, SUBPIXELS).astype(np.float32)


def shade(
    view: PosedView, camera: RenderCamera, light: TracedLight, pixels: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Reach, within `FAR_SIGMAS`, and peak (N,) at pixels (N, 2).

    The light is ``peak * exp(-reach**2 / 2)``.
    """
    numbers, source = view.numbers, LightNumbers.of(light)
    if numbers is not None and source is not None:
        section = light.section
        reach, peak = numbers.shade(
            camera,
            pixels,
            source,
            tolerance=RAY_TOLERANCE,
            far_sigmas=FAR_SIGMAS * section.widest,
        )
        return np.clip(section.gaussian_reach(reach), -FAR_SIGMAS, FAR_SIGMAS), peak
    reach, peak = np.full(len(pixels), FAR_SIGMAS), np.zeros(len(pixels))
    hits = view.scene.trace(np.zeros(3), camera_rays(camera, pixels, RAY_TOLERANCE))
    met = np.flatnonzero(hits.surface >= 0)
    at = hits.select(met)
    normals = view.scene.normals(at)
    near, strength = light.reach_and_peak(at.points_mm, normals)
    reach[met] = near
    lit = np.flatnonzero((np.abs(near) < FAR_SIGMAS) & (strength > FAINTEST))
    lit = lit[view.scene.sees(light.source_of_mm(at.points_mm[lit]), at.points_mm[lit])]
    chosen = at.select(lit)
    reflected = view.scene.albedo(chosen)[:, 0] + _gloss(view, light, chosen, normals[lit])
    peak[met[lit]] = strength[lit] * reflected
    return np.clip(reach, -FAR_SIGMAS, FAR_SIGMAS), peak


def _gloss(view: PosedView, light: TracedLight, hits: Hits, normals: FloatArray) -> FloatArray:
    """(N,) glossy part: a Gaussian lobe of the angle between the normal and the half-way ray."""
    strength = np.array([finish.gloss for finish in view.finishes])[hits.surface]
    if not strength.any():
        return strength
    width = np.array([finish.gloss_width_rad for finish in view.finishes])[hits.surface]
    to_source = light.source_of_mm(hits.points_mm) - hits.points_mm
    to_camera = -hits.points_mm
    half = to_source / np.linalg.norm(to_source, axis=1, keepdims=True)
    half = half + to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", half, normals) / np.linalg.norm(half, axis=1)
    angle_square = 2.0 * (1.0 - np.clip(cosine, -1.0, 1.0))
    return np.asarray(strength * np.exp(-0.5 * angle_square / width**2))


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
) -> tuple[int, Image32]:
    """Light (H, W) of one source in a region, parts of full scale, blurred; mean over the views.

    Of the rows that it reaches, and the first of them.
    """
    lit = [lit_pixels(view.nodes, source, region) for view in views]
    sheets = [
        trace_sheet(view, camera, source, region, own) for view, own in zip(views, lit, strict=True)
    ]
    is_lit = np.bitwise_or.reduce(lit).view(np.bool_)
    margin = int(np.ceil(BLUR_REACH * camera.blur_sigma_px)) + 1
    rows = np.flatnonzero(is_lit.any(axis=1))
    if len(rows) == 0:
        return 0, np.zeros((0, region.width_px), np.float32)
    first = max(int(rows[0]) - margin, 0) // _TILE_ROWS * _TILE_ROWS
    stop = min(int(rows[-1]) + 1 + margin, region.height_px)
    light = np.zeros(
        (min(-(-stop // _TILE_ROWS) * _TILE_ROWS, region.height_px) - first, region.width_px),
        np.float32,
    )
    for top in range(first, stop, _TILE_ROWS):
        for left in range(0, region.width_px, _TILE_COLUMNS):
            inner = _slices(is_lit, top, left, 0)
            outer = _slices(is_lit, top, left, margin)
            if not is_lit[outer].any():
                continue
            fine = _fine(sheets, outer)
            fine *= np.float32(1.0 / len(sheets)) * speckle_piece(fine.shape, speckle, rng)
            blurred = blur_image(fine, SUBPIXELS * camera.blur_sigma_px)
            size = (fine.shape[1] // SUBPIXELS, fine.shape[0] // SUBPIXELS)
            tile = cv2.resize(blurred, size, interpolation=cv2.INTER_AREA)
            y, x = inner[0].start - outer[0].start, inner[1].start - outer[1].start
            own = light[inner[0].start - first : inner[0].stop - first, inner[1]]
            own[:] = tile[y : y + own.shape[0], x : x + own.shape[1]]
    return first, light


def _slices(image: BoolArray, top: int, left: int, margin: int) -> tuple[slice, slice]:
    rows = slice(max(top - margin, 0), min(top + _TILE_ROWS + margin, image.shape[0]))
    columns = slice(max(left - margin, 0), min(left + _TILE_COLUMNS + margin, image.shape[1]))
    return rows, columns


def _fine(sheets: Sequence[SheetImage], where: tuple[slice, slice]) -> Image32:
    """Light of all sheets on the fine grid of a tile, added up."""
    rows, columns = (part.stop - part.start for part in where)
    light = np.zeros((SUBPIXELS * rows, SUBPIXELS * columns), np.float32)
    for sheet in sheets:
        tile = np.array([where[0].start - sheet.top, where[1].start])
        add_fine_light(
            *(sheet.reach, sheet.peak, sheet.edges, sheet.edge_light, tile, FAR_SIGMAS, light)
        )
    return light


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
