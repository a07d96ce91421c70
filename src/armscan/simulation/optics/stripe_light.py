# SPDX-License-Identifier: Apache-2.0
"""The light of a laser sheet on a camera's image, computed along the stripe at subpixel
sampling, with speckle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.optics.camera import RenderCamera, blur_image
from armscan.simulation.optics.lasers import TracedLight
from armscan.simulation.optics.render import (
    BAND_SIGMAS,
    BLUR_REACH,
    COARSE_STEP_PX,
    SUBPIXELS,
    Image32,
    Region,
    Speckle,
    between_nodes,
    camera_rays,
    cells_near_sheet,
    enlarged,
)
from armscan.simulation.optics.scene import FAINTEST, Hits, Material, Scene
from armscan.simulation.optics.tracing import LightNumbers, SceneNumbers

STRIDE_PX = 2
FAR_SIGMAS = 9.0
_STRIP_CELLS = 24
_SLACK_SIGMAS = 0.6
"""Half a pixel across the line, and what interpolation on the coarse grid may be wrong by."""
_EDGE_SIGMAS = 1.5
"""Neighbouring pixels whose reach differs by more lie on two sides of an edge."""
_EDGE_SHARE = 0.25
_BEND_SIGMAS = 0.01
"""Second difference above which every pixel is traced: an eighth of it is lost between."""
_BRIGHT_SIGMAS = 4.5
_RIM_PX = 4
_SQUARE = np.ones((3, 3), np.uint8)

Item = TypeVar("Item", np.float32, np.int32, np.bool_)


@dataclass(slots=True, eq=False)
class Strip:
    """One strip while it is worked on.

    Parameters
    ----------
    region
        Its rectangle of the sensor, margin included.
    place, inner
        Rows and columns of the whole region that are kept, and the same within the strip.
    reach, peak
        (H, W) distance from the sheet's centre in sigmas, and light were it zero.
    is_lit
        (H, W) pixels that the light may reach.
    is_rough
        (H, W) pixels that must be traced themselves; known after `interpolate`.
    """

    region: Region
    place: tuple[slice, slice]
    inner: tuple[slice, slice]
    reach: Image32
    is_lit: BoolArray
    peak: Image32 = field(init=False)
    is_rough: BoolArray = field(init=False)
    _near: BoolArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.peak = np.zeros_like(self.reach)
        self.is_rough = np.zeros_like(self.is_lit)
        self._near = cv2.dilate(self.is_lit.astype(np.uint8), _SQUARE) > 0

    def near_nodes(self) -> tuple[IntArray, ...]:
        """Rows and columns of the nodes, `STRIDE_PX` apart, that are to be traced.

        They reach so far around the light that its rim is not taken for an edge.
        """
        square = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
        near = cv2.dilate(self.is_lit.astype(np.uint8), square)
        return np.nonzero(near[::STRIDE_PX, ::STRIDE_PX])

    def interpolate(self, nodes: tuple[IntArray, ...], reach: FloatArray, peak: FloatArray) -> None:
        """Fill the strip between traced nodes, and tell where that will not do."""
        coarse_reach = np.ascontiguousarray(self.reach[::STRIDE_PX, ::STRIDE_PX])
        coarse_peak = np.zeros_like(coarse_reach)
        coarse_reach[nodes], coarse_peak[nodes] = reach, peak
        rough = _jumps(coarse_reach, coarse_peak, STRIDE_PX) | _bends(coarse_reach)
        is_rough = enlarged(rough.astype(np.uint8), STRIDE_PX)
        self.reach[:] = between_nodes(coarse_reach, STRIDE_PX)
        self.peak[:] = between_nodes(coarse_peak, STRIDE_PX)
        self.is_rough = (cv2.dilate(is_rough, _SQUARE) > 0) & self._near

    def edges(self) -> tuple[IntArray, ...]:
        """Rows and columns of the kept pixels at edges."""
        inside = cv2.erode(self.is_lit.astype(np.uint8), _SQUARE) > 0
        found = _jumps(self.reach, self.peak, 1) & inside
        rows, columns = np.nonzero(found[self.inner])
        return rows + self.inner[0].start, columns + self.inner[1].start

    def put(self, image: NDArray[Item], mine: NDArray[Item]) -> None:
        """Copy what is kept of an array of the strip into one of the whole region."""
        image[self.place] = mine[self.inner]


def cut_strips(nodes: Hits, light: TracedLight, region: Region) -> list[Strip]:
    """Strips of the pixels that a light may reach.

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
    strips = []
    for left in range(0, cells.shape[1], _STRIP_CELLS):
        columns = slice(left, min(left + _STRIP_CELLS, cells.shape[1]))
        used = np.flatnonzero(cells[:, columns].any(axis=1))
        if len(used):
            kept = slice(int(used[0]), int(used[-1]) + 1), columns
            strips.append(_strip(region, kept, coarse, cells, rough))
    return strips


def _strip(
    region: Region,
    kept: tuple[slice, slice],
    coarse: Image32,
    cells: BoolArray,
    rough: BoolArray,
) -> Strip:
    step = COARSE_STEP_PX
    # The light's rim is interpolated too: keep a cell around it, and work on one more.
    rows = _wider(kept[0], 1, cells.shape[0])
    worked = _wider(rows, 1, cells.shape[0]), _wider(kept[1], 1, cells.shape[1])
    (top, bottom), (left, right) = ((part.start, part.stop) for part in worked)
    between = between_nodes(coarse[top : bottom + 1, left : right + 1], step)[:-step, :-step]
    is_lit = np.abs(between) < BAND_SIGMAS + _SLACK_SIGMAS
    is_lit |= enlarged(rough[worked].astype(np.uint8), step) > 0
    is_lit &= enlarged(cells[worked].astype(np.uint8), step) > 0
    part = Region(
        region.x_px + step * left,
        region.y_px + step * top,
        step * (right - left),
        step * (bottom - top),
    )
    return Strip(
        part,
        _pixels((rows, kept[1]), 0, 0),
        _pixels((rows, kept[1]), top, left),
        # Outside, the sign of the reach still matters: it is interpolated across the band's rim.
        np.clip(between, -FAR_SIGMAS, FAR_SIGMAS),
        is_lit,
    )


def _wider(part: slice, by: int, count: int) -> slice:
    return slice(max(part.start - by, 0), min(part.stop + by, count))


def _pixels(cells: tuple[slice, slice], top: int, left: int) -> tuple[slice, slice]:
    """Pixels of cells, counted from a first cell."""
    rows, columns = cells
    step = COARSE_STEP_PX
    return (
        slice(step * (rows.start - top), step * (rows.stop - top)),
        slice(step * (columns.start - left), step * (columns.stop - left)),
    )


def _rough_cells(reach: Image32, surface: IntArray) -> BoolArray:
    """(H, W) cells whose corners or neighbours differ in surface, or bend in reach."""
    marks = (surface + 1).astype(np.float32)
    differs = cv2.dilate(marks, _SQUARE) != cv2.erode(marks, _SQUARE)
    bends = np.abs(cv2.Laplacian(reach, cv2.CV_32F)) > _SLACK_SIGMAS
    rough = cv2.dilate((differs | bends | (surface < 0)).astype(np.uint8), _SQUARE)
    return np.asarray(rough[:-1, :-1] > 0)


def _jumps(reach: Image32, peak: Image32, stride_px: int) -> BoolArray:
    """Samples (H, W) around which something jumps: an edge, a shadow, another surface."""
    spread = cv2.dilate(reach, _SQUARE) - cv2.erode(reach, _SQUARE)
    high = cv2.dilate(peak, _SQUARE)
    jump = high - cv2.erode(peak, _SQUARE)
    # A sample that misses the light itself may have a neighbour that does not.
    is_reached = (cv2.erode(np.abs(reach), _SQUARE) < BAND_SIGMAS) & (high > FAINTEST)
    is_rough = (spread > stride_px * _EDGE_SIGMAS) | (jump > _EDGE_SHARE * high)
    return np.asarray(is_rough & is_reached)


def _bends(reach: Image32) -> BoolArray:
    """Samples (H, W) near the light where a straight line between neighbours is not enough."""
    along = cv2.filter2D(reach, cv2.CV_32F, np.array([[1.0, -2.0, 1.0]]))
    across = cv2.filter2D(reach, cv2.CV_32F, np.array([[1.0], [-2.0], [1.0]]))
    bent = np.maximum(np.abs(along), np.abs(across)) > _BEND_SIGMAS
    return np.asarray(bent & (np.abs(reach) < _BRIGHT_SIGMAS))


RAY_TOLERANCE = 1e-7
"""The search for a pixel's ray stops at such a step: what is left is below 1e-4 px."""


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
    numbers
        The scene for the compiled loops; None if they do not know one of its surfaces.
    """

    scene: Scene
    finishes: tuple[Material, ...]
    nodes: Hits
    numbers: SceneNumbers | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SheetImage:
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
    view: PosedView, camera: RenderCamera, light: TracedLight, region: Region
) -> SheetImage:
    """Trace what a light may reach in a region."""
    shape = (region.height_px, region.width_px)
    image = SheetImage(
        np.full(shape, FAR_SIGMAS, np.float32),
        np.zeros(shape, np.float32),
        np.full(shape, -1, np.int32),
        np.zeros((0, SUBPIXELS, SUBPIXELS), np.float32),
        np.zeros(shape, np.bool_),
    )
    strips = cut_strips(view.nodes, light, region)
    if not strips:
        return image
    shader = _Shader(view, camera, light)
    shader.fill_nodes(strips)
    shader.fill_rough(strips)
    for strip in strips:
        strip.put(image.reach, strip.reach)
        strip.put(image.peak, strip.peak)
        strip.put(image.is_lit, strip.is_lit)
    return replace(image, edge_light=shader.quarters(strips, image.edges))


@dataclass(frozen=True, slots=True, eq=False)
class _Shader:
    """Traces pixels of all strips of a region at once."""

    view: PosedView
    camera: RenderCamera
    light: TracedLight

    def fill_nodes(self, strips: list[Strip]) -> None:
        """Trace every second pixel of every second row that is asked for; interpolate."""
        places = [strip.near_nodes() for strip in strips]
        found = self._shade(strips, [(STRIDE_PX * r, STRIDE_PX * c) for r, c in places])
        for strip, place, (reach, peak) in zip(strips, places, found, strict=True):
            strip.interpolate(place, reach, peak)

    def fill_rough(self, strips: list[Strip]) -> None:
        """Trace the pixels between which interpolation will not do."""
        places = [np.nonzero(strip.is_rough) for strip in strips]
        found = self._shade(strips, places)
        for strip, place, (reach, peak) in zip(strips, places, found, strict=True):
            strip.reach[place], strip.peak[place] = reach, peak

    def quarters(self, strips: list[Strip], edges: NDArray[np.int32]) -> Image32:
        """Light (E, SUBPIXELS, SUBPIXELS) of the fine cells of pixels at edges; number these."""
        offset = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
        shift = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
        pixels, count = [], 0
        for strip in strips:
            rows, columns = strip.edges()
            numbers = np.full(strip.reach.shape, -1, np.int32)
            numbers[rows, columns] = count + np.arange(len(rows))
            strip.put(edges, numbers)
            count += len(rows)
            pixels.append(strip.region.pixels_px(rows, columns))
        fine = (np.concatenate(pixels)[:, None, :] + shift).reshape(-1, 2)
        reach, peak = shade(self.view, self.camera, self.light, fine)
        light = peak * np.exp(-0.5 * reach**2)
        return light.reshape(-1, SUBPIXELS, SUBPIXELS).astype(np.float32)

    def _shade(
        self, strips: list[Strip], places: Sequence[tuple[IntArray, ...]]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Reach and peak of the rows and columns asked for in each strip."""
        pixels = [s.region.pixels_px(*place) for s, place in zip(strips, places, strict=True)]
        reach, peak = shade(self.view, self.camera, self.light, np.concatenate(pixels))
        ends = np.cumsum([len(one) for one in pixels])[:-1]
        reach = np.clip(reach, -FAR_SIGMAS, FAR_SIGMAS)
        return list(zip(np.split(reach, ends), np.split(peak, ends), strict=True))


def shade(
    view: PosedView, camera: RenderCamera, light: TracedLight, pixels: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Reach and peak (N,) at pixels (N, 2); the light is ``peak * exp(-reach**2 / 2)``."""
    numbers, source = view.numbers, LightNumbers.of(light)
    if numbers is not None and source is not None:
        section = light.section
        reach, peak = numbers.shade(
            camera,
            pixels,
            source,
            tolerance=RAY_TOLERANCE,
            lit_sigmas=FAR_SIGMAS * section.widest,
            far_sigmas=FAR_SIGMAS * section.widest,
        )
        return section.gaussian_reach(reach), peak
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
    return reach, peak


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
