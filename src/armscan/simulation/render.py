# SPDX-License-Identifier: Apache-2.0
"""What the pixels of a camera see of a scene; only the band that light can reach is traced finely.

Light is followed on a grid finer than the pixels, on which the lens's blur acts; speckle belongs
to the light before the blur.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera, blur_image
from armscan.simulation.scene import Scene
from armscan.simulation.stripe_truth import StripeTruth, camera_rays, find_stripe

SUBPIXELS = 2
BAND_SIGMAS = 5.5
BLUR_REACH = 6.0
COARSE_STEP_PX = 8


@dataclass(frozen=True, slots=True)
class Speckle:
    """Grain of laser light.

    Parameters
    ----------
    contrast
        Standard deviation of the light over its mean, before the lens's blur.
    grain_px
        Gaussian sigma of the grain; 0 gives independent samples.
    """

    contrast: float = 0.2
    grain_px: float = 0.5

    def __post_init__(self) -> None:
        if self.contrast < 0.0 or self.grain_px < 0.0:
            raise InputError("speckle contrast and grain cannot be negative")


@dataclass(frozen=True, slots=True, eq=False)
class LaserImage:
    """One laser's light in an image.

    Parameters
    ----------
    light
        (H, W) parts of full scale, blurred, neither clipped nor noisy.
    truth
        Where the centre of the sheet truly lies.
    """

    light: FloatArray
    truth: StripeTruth


def render_room(scene: Scene, camera: RenderCamera) -> FloatArray:
    """(H, W, 3) image under the lamp alone, parts of full scale, blurred; one ray a pixel."""
    rows, columns = np.indices((camera.height_px, camera.width_px))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    hits = scene.trace(np.zeros(3), camera_rays(camera, pixels))
    light = scene.room_light(hits).reshape(camera.height_px, camera.width_px, 3)
    return blur_image(light, camera.blur_sigma_px)


def render_laser(
    scene: Scene,
    camera: RenderCamera,
    laser: LineLaser,
    speckle: Speckle,
    rng: np.random.Generator,
) -> LaserImage:
    """Render the light of one laser and find the truth of its stripe."""
    band = laser_band(scene, camera, laser)
    light = np.zeros(band.shape)
    if not band.any():
        return LaserImage(light, find_stripe(scene, camera, laser, band))
    margin = int(np.ceil(BLUR_REACH * camera.blur_sigma_px)) + 1
    is_used = np.asarray(band.any(axis=1)), np.asarray(band.any(axis=0))
    window = _span(is_used[0], margin), _span(is_used[1], margin)
    fine = _trace_finely(scene, camera, laser, band[window], (window[1].start, window[0].start))
    fine *= _speckle_field(fine.shape, speckle, rng)
    blurred = blur_image(fine, SUBPIXELS * camera.blur_sigma_px)
    height, width = light[window].shape
    light[window] = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA)
    return LaserImage(light, find_stripe(scene, camera, laser, band))


def _span(is_used: BoolArray, margin: int) -> slice:
    """Slice around the True entries (N,), widened by a margin."""
    used = np.flatnonzero(is_used)
    return slice(max(int(used[0]) - margin, 0), min(int(used[-1]) + 1 + margin, len(is_used)))


def _trace_finely(
    scene: Scene,
    camera: RenderCamera,
    laser: LineLaser,
    band: BoolArray,
    corner_px: tuple[int, int],
) -> FloatArray:
    """Laser light on the fine grid of a window of the image whose top-left pixel is given."""
    rows, columns = np.nonzero(band)
    fine = np.zeros((SUBPIXELS * band.shape[0], SUBPIXELS * band.shape[1]))
    for b in range(SUBPIXELS):
        for a in range(SUBPIXELS):
            shift = (np.array([a, b]) + 0.5) / SUBPIXELS - 0.5 + corner_px
            rays = camera_rays(camera, np.stack([columns, rows], axis=1) + shift)
            hits = scene.trace(np.zeros(3), rays)
            fine[SUBPIXELS * rows + b, SUBPIXELS * columns + a] = scene.laser_light(laser, hits)
    return fine


def laser_band(scene: Scene, camera: RenderCamera, laser: LineLaser) -> BoolArray:
    """(H, W) True for pixels that the laser's light may reach.

    A coarse grid of rays is traced; a cell belongs to the band if the sheet lies, within its
    thickness, between the nearest and the farthest of the cell's corners; so do its neighbours.
    """
    return next(laser_bands(scene, camera, (laser,)))


def laser_bands(
    scene: Scene, camera: RenderCamera, lasers: Sequence[LineLaser]
) -> Iterator[BoolArray]:
    """The band of each laser; the coarse grid is traced once."""
    u = np.arange(0, camera.width_px + COARSE_STEP_PX, COARSE_STEP_PX)
    v = np.arange(0, camera.height_px + COARSE_STEP_PX, COARSE_STEP_PX)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(np.float64)
    hits = scene.trace(np.zeros(3), camera_rays(camera, grid))
    is_hit = hits.surface >= 0
    for laser in lasers:
        reach = np.full(len(grid), np.nan)
        reach[is_hit] = laser.reach_mm(hits.points_mm[is_hit])
        band = pixels_near_sheet(reach.reshape(len(v), len(u)))
        yield np.asarray(band[: camera.height_px, : camera.width_px])


def pixels_near_sheet(reach: FloatArray) -> BoolArray:
    """(8 (H - 1), 8 (W - 1)) True for pixels next to the sheet, whose reach (H, W) is known.

    The reach, in sigmas, is given on the coarse grid; NaN where nothing is met.
    """
    cells = cells_near_sheet(reach, (reach > 0.0).astype(np.float64)).astype(np.uint8)
    size = (COARSE_STEP_PX * cells.shape[1], COARSE_STEP_PX * cells.shape[0])
    return np.asarray(cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST) > 0)


def cells_near_sheet(reach: FloatArray, rank: FloatArray) -> BoolArray:
    """(H - 1, W - 1) True for cells of the coarse grid that a sheet crosses, and their neighbours.

    Parameters
    ----------
    reach
        (H, W) distance of the nodes from the nearest sheet, in sigmas; NaN where nothing is met.
    rank
        (H, W) how many of the sheets' centres lie below a node.
    """
    corners, ranks = np.abs(_corners(reach)), _corners(rank)
    is_hit = np.isfinite(corners)
    nearest = np.where(is_hit, corners, np.inf).min(axis=0)
    low = np.where(is_hit, ranks, np.inf).min(axis=0)
    high = np.where(is_hit, ranks, -np.inf).max(axis=0)
    cells = ((nearest <= BAND_SIGMAS) | (high > low)).astype(np.uint8)
    return np.asarray(cv2.dilate(cells, np.ones((3, 3), np.uint8)) > 0)


def _corners(grid: FloatArray) -> FloatArray:
    """(4, H - 1, W - 1) values at the corners of each cell."""
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]])


def _speckle_field(
    shape: tuple[int, ...], speckle: Speckle, rng: np.random.Generator
) -> FloatArray | float:
    """Positive random factor with mean 1: the logarithm is normal, smoothed to the grain."""
    if speckle.contrast == 0.0:
        return 1.0
    normal = rng.standard_normal(shape, dtype=np.float32)
    if speckle.grain_px > 0.0:
        normal = blur_image(normal, SUBPIXELS * speckle.grain_px)
        normal = normal / normal.std()
    variance = np.log1p(speckle.contrast**2)
    return np.asarray(np.exp(np.sqrt(variance) * normal - 0.5 * variance))
