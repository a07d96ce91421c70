# SPDX-License-Identifier: Apache-2.0
"""One laser's sheet on what one pose sees: distance from its centre and brightness, by pixel.

Every second pixel of every second row is traced. Between them distance and brightness change
smoothly and are interpolated; where they do not, every pixel is traced, and at edges its quarters.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera
from armscan.simulation.region import Image32, Region, between_nodes, enlarged, to_pixels
from armscan.simulation.render import BAND_SIGMAS, COARSE_STEP_PX, SUBPIXELS, pixels_near_sheet
from armscan.simulation.scene import FAINTEST, Hits, Scene
from armscan.simulation.stripe_truth import camera_rays
from armscan.simulation.thing import Finish

RAY_TOLERANCE = 1e-7
"""The search for a pixel's ray stops at such a step: what is left is below 1e-4 px."""
_STRIDE_PX = 2
_FAR_SIGMAS = 9.0
_SLACK_SIGMAS = 0.6
"""Half a pixel across the line, and what interpolation on the coarse grid may be wrong by."""
_EDGE_SIGMAS = 1.5
"""Neighbouring pixels whose reach differs by more lie on two sides of an edge."""
_EDGE_SHARE = 0.25
_BEND_SIGMAS = 0.01
"""Second difference above which every pixel is traced: an eighth of it is lost between."""
_BRIGHT_SIGMAS = 4.5
_SQUARE = np.ones((3, 3), np.uint8)


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
    view: PosedView, camera: RenderCamera, laser: LineLaser, region: Region
) -> SheetImage:
    """Trace what the laser's light may reach in a region."""
    shape = (region.height_px, region.width_px)
    is_lit, reach = _near_sheet(view, laser, region)
    peak = np.zeros(shape, np.float32)
    edges = np.full(shape, -1, np.int32)
    used = np.flatnonzero(is_lit.any(axis=1))
    if len(used) == 0:
        return SheetImage(
            reach, peak, edges, np.zeros((0, SUBPIXELS, SUBPIXELS), np.float32), is_lit
        )
    top = int(used[0]) // _STRIDE_PX * _STRIDE_PX
    rows = slice(top, top + -(-(int(used[-1]) + 1 - top) // _STRIDE_PX) * _STRIDE_PX)
    part = Region(region.x_px, region.y_px + top, region.width_px, rows.stop - top)
    tracer = _Tracer(view, camera, laser, part)
    tracer.fill(reach[rows], peak[rows], is_lit[rows])
    at_edge = np.nonzero(_jumps(reach[rows], peak[rows], 1) & _inside(is_lit[rows]))
    edges[rows][at_edge] = np.arange(len(at_edge[0]))
    return SheetImage(reach, peak, edges, tracer.quarters(*at_edge), is_lit)


@dataclass(frozen=True, slots=True, eq=False)
class _Tracer:
    """Traces pixels of a region."""

    view: PosedView
    camera: RenderCamera
    laser: LineLaser
    region: Region

    def fill(self, reach: Image32, peak: Image32, is_lit: BoolArray) -> None:
        """Set reach and peak (H, W) where they are asked for."""
        near = cv2.dilate(is_lit.astype(np.uint8), _SQUARE) > 0
        coarse_reach = np.ascontiguousarray(reach[::_STRIDE_PX, ::_STRIDE_PX])
        coarse_peak = np.zeros_like(coarse_reach)
        rows, columns = np.nonzero(near[::_STRIDE_PX, ::_STRIDE_PX])
        found = self._shade(_STRIDE_PX * rows, _STRIDE_PX * columns)
        coarse_reach[rows, columns], coarse_peak[rows, columns] = found
        rough = _jumps(coarse_reach, coarse_peak, _STRIDE_PX) | _bends(coarse_reach)
        is_rough = enlarged(rough.astype(np.uint8), _STRIDE_PX)
        reach[:] = between_nodes(coarse_reach, _STRIDE_PX)
        peak[:] = between_nodes(coarse_peak, _STRIDE_PX)
        exact = np.nonzero((cv2.dilate(is_rough, _SQUARE) > 0) & near)
        reach[exact], peak[exact] = self._shade(*exact)

    def quarters(self, rows: IntArray, columns: IntArray) -> Image32:
        """Light (E, SUBPIXELS, SUBPIXELS) of the fine cells of pixels (E,)."""
        offset = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
        shift = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
        fine = (self.region.pixels_px(rows, columns)[:, None, :] + shift).reshape(-1, 2)
        reach, peak = shade(self.view, self.camera, self.laser, fine)
        light = peak * np.exp(-0.5 * reach**2)
        return light.reshape(-1, SUBPIXELS, SUBPIXELS).astype(np.float32)

    def _shade(self, rows: IntArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
        pixels = self.region.pixels_px(rows, columns)
        reach, peak = shade(self.view, self.camera, self.laser, pixels)
        return np.clip(reach, -_FAR_SIGMAS, _FAR_SIGMAS), peak


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
    return enlarged(np.asarray(rough, dtype=np.uint8), COARSE_STEP_PX) > 0


def shade(
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


def _inside(is_lit: BoolArray) -> BoolArray:
    return np.asarray(cv2.erode(is_lit.astype(np.uint8), _SQUARE) > 0)
