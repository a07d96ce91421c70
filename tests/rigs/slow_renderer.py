# SPDX-License-Identifier: Apache-2.0
"""A plain renderer that traces every pixel: the twin's fast one is checked against it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, ImageArray
from armscan.simulation.optics.camera import RenderCamera, blur_image
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.render import (
    BLUR_REACH,
    COARSE_STEP_PX,
    SUBPIXELS,
    Speckle,
    StripeTruth,
    camera_rays,
    cells_near_sheet,
    find_stripe,
)
from armscan.simulation.optics.scene import Scene


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
    u = np.arange(0, camera.width_px + COARSE_STEP_PX, COARSE_STEP_PX)
    v = np.arange(0, camera.height_px + COARSE_STEP_PX, COARSE_STEP_PX)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(np.float64)
    hits = scene.trace(np.zeros(3), camera_rays(camera, grid))
    is_hit = hits.surface >= 0
    reach = np.full(len(grid), np.nan)
    reach[is_hit] = laser.reach_mm(hits.points_mm[is_hit])
    nodes = reach.reshape(len(v), len(u))
    cells = cells_near_sheet(nodes, (nodes > 0.0).astype(np.float64)).astype(np.uint8)
    size = (COARSE_STEP_PX * cells.shape[1], COARSE_STEP_PX * cells.shape[0])
    band = cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST) > 0
    return np.asarray(band[: camera.height_px, : camera.width_px])


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


def add_noise(
    image: FloatArray,
    rng: np.random.Generator,
    *,
    sigma: float = 2.0,
    electrons_per_level: float | None = None,
    bits: int = 8,
) -> ImageArray:
    """Turn a rendered image into what a camera delivers.

    Parameters
    ----------
    image
        Grey levels of an 8-bit image, whatever ``bits`` is: 255 is full scale.
    rng
        Source of the noise.
    sigma
        Read noise, in 8-bit grey levels.
    electrons_per_level
        Electrons per 8-bit grey level, for shot noise; None for none.
    bits
        Significant bits of the result, low aligned: uint8 up to 8 bits, else uint16.

    Returns
    -------
    Rounded and clipped image.
    """
    if not 1 <= bits <= 16:
        raise InputError(f"{bits} bits do not fit into 16")
    variance = np.full(image.shape, sigma**2)
    if electrons_per_level is not None:
        variance += np.maximum(image, 0.0) / electrons_per_level
    noisy = image + np.sqrt(variance) * rng.standard_normal(image.shape)
    full_scale = (1 << bits) - 1
    levels: FloatArray = np.clip(np.rint(noisy * (full_scale / 255.0)), 0, full_scale)
    return levels.astype(np.uint8) if bits <= 8 else levels.astype(np.uint16)
