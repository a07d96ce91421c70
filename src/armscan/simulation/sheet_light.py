# SPDX-License-Identifier: Apache-2.0
"""One laser's sheet on what one pose sees: distance from its centre and brightness, by pixel.

Every second pixel of every second row is traced. Between them distance and brightness change
smoothly and are interpolated; where they do not, every pixel is traced, and at edges its quarters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.laser_source import NARROW_RIM_PX, TracedLight
from armscan.simulation.light_strips import FAR_SIGMAS, STRIDE_PX, Strip, cut_strips
from armscan.simulation.optics import RenderCamera
from armscan.simulation.region import Image32, Region
from armscan.simulation.render import BAND_SIGMAS, SUBPIXELS
from armscan.simulation.scene import FAINTEST, Hits, Scene
from armscan.simulation.stripe_truth import camera_rays
from armscan.simulation.thing import Finish

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
    """

    scene: Scene
    finishes: tuple[Finish, ...]
    nodes: Hits


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
    scene: Scene, finishes: tuple[Finish, ...], camera: RenderCamera, region: Region
) -> PosedView:
    """Trace the coarse grid of a region."""
    nodes, _ = region.nodes_px()
    hits = scene.trace(np.zeros(3), camera_rays(camera, nodes, RAY_TOLERANCE))
    return PosedView(scene, finishes, hits)


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
        places = [strip.near_nodes(self.light.rim_px) for strip in strips]
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
    reach, peak = np.full(len(pixels), FAR_SIGMAS), np.zeros(len(pixels))
    hits = view.scene.trace(np.zeros(3), camera_rays(camera, pixels, RAY_TOLERANCE))
    met = np.flatnonzero(hits.surface >= 0)
    at = hits.select(met)
    normals = view.scene.normals(at)
    near, strength = light.reach_and_peak(at.points_mm, normals)
    reach[met] = near
    lit = np.flatnonzero((np.abs(near) < _lit_sigmas(light)) & (strength > FAINTEST))
    lit = lit[view.scene.sees(light.source_of_mm(at.points_mm[lit]), at.points_mm[lit])]
    chosen = at.select(lit)
    reflected = view.scene.albedo(chosen)[:, 0] + _gloss(view, light, chosen, normals[lit])
    peak[met[lit]] = strength[lit] * reflected
    return reach, peak


def _lit_sigmas(light: TracedLight) -> float:
    """Reach up to which light is computed: all that is traced, if the rim is wide."""
    return FAR_SIGMAS if light.rim_px > NARROW_RIM_PX else BAND_SIGMAS + 1.0


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
