# SPDX-License-Identifier: Apache-2.0
"""Photographs of a scene: which point each pixel sees, the image with laser light and speckle,
image regions, and the true stripes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.devices.sources import Preset
from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, IntArray, floats
from armscan.simulation.optics.camera import STEP_TOLERANCE, Detector, RenderCamera
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.scene import Hits, Scene

FALSE_POSITIONS = 12
_ON_SHEET_MM = 1e-9
SAME_SURFACE_MM = 3.0
"""Neighbouring pixels that differ more in distance lie on two sides of a silhouette."""


class StripeTruth(ArrayRecord):
    """True centre points of one laser's stripe, one a row (or a column, if it lies flat).

    Full-sensor pixels (N, 2), places in Sensor (N, 3); ``surface`` (N,) is an index into the
    scene's surfaces, as float64.
    """

    points_px: FloatArray = floats("N", 2)
    points_mm: FloatArray = floats("N", 3)
    surface: FloatArray = floats("N")


def camera_rays(
    camera: RenderCamera, pixels_px: FloatArray, tolerance: float = STEP_TOLERANCE
) -> FloatArray:
    """(N, 3) unit directions, in the Sensor frame, of full-sensor pixels (N, 2)."""
    xy = camera.rays(pixels_px, tolerance)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


Tracer: TypeAlias = Callable[[FloatArray], Hits]
"""First hits of the rays of pixels (N, 2)."""


def find_stripe(
    scene: Scene,
    camera: RenderCamera,
    laser: LineLaser,
    band: BoolArray,
    tracer: Tracer | None = None,
) -> StripeTruth:
    """Find where the sheet's centre crosses the pixel rows or columns within a band.

    ``band`` (H, W) is True where the light may reach; ``tracer`` is quicker than the scene itself.
    """

    def trace(pixels_px: FloatArray) -> Hits:
        return scene.trace(np.zeros(3), camera_rays(camera, pixels_px))

    tracer = tracer or trace
    rows, columns = marked(band)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    hits = tracer(pixels)
    if len(rows) == 0:
        none = np.zeros((0, 2))
        return StripeTruth(points_px=none, points_mm=np.zeros((0, 3)), surface=np.zeros(0))
    top, left = int(rows.min()), int(columns.min())
    size = (int(rows.max()) - top + 1, int(columns.max()) - left + 1)
    number = np.full(size, -1, dtype=np.int64)
    number[rows - top, columns - left] = np.arange(len(rows))
    offset = np.full(len(rows), np.nan)
    is_hit = hits.surface >= 0
    offset[is_hit] = laser.offset_mm(hits.points_mm[is_hit])
    across_rows = _crossings(number[:, :-1], number[:, 1:], hits, offset)
    across_columns = _crossings(number[:-1, :], number[1:, :], hits, offset)
    pairs = across_rows if len(across_rows) >= len(across_columns) else across_columns
    return _refine(scene, laser, tracer, pixels[pairs[:, 0]], pixels[pairs[:, 1]])


def marked(marks: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of what is marked (H, W): `np.nonzero`, ten times sooner for few marks."""
    return np.divmod(np.flatnonzero(marks), marks.shape[1])


def _crossings(first: IntArray, second: IntArray, hits: Hits, offset_mm: FloatArray) -> IntArray:
    """(K, 2) neighbours on one surface between which the sheet's centre passes."""
    both = (first >= 0) & (second >= 0)
    a, b = first[both], second[both]
    changes = (offset_mm[a] <= 0.0) != (offset_mm[b] <= 0.0)
    known = np.isfinite(offset_mm[a]) & np.isfinite(offset_mm[b])
    same = hits.surface[a] == hits.surface[b]
    a, b = a[changes & known & same], b[changes & known & same]
    step = np.abs(hits.distance_mm[a] - hits.distance_mm[b])
    return np.asarray(np.stack([a, b], axis=1)[step < SAME_SURFACE_MM])


def _refine(
    scene: Scene, laser: LineLaser, tracer: Tracer, low_px: FloatArray, high_px: FloatArray
) -> StripeTruth:
    """Narrow the interval between two pixels until the sheet's centre is found.

    By false position; an end that stays twice counts half (the Illinois rule: Dowell and Jarratt,
    BIT 11, 1971).
    """
    low, high = low_px.copy(), high_px.copy()
    at_low = laser.offset_mm(tracer(low).points_mm)
    at_high = laser.offset_mm(tracer(high).points_mm)
    stayed = np.zeros(len(low))
    pixels = low
    for _ in range(FALSE_POSITIONS):
        share = np.clip(at_low / np.where(at_low == at_high, 1.0, at_low - at_high), 0.0, 1.0)
        pixels = low + share[:, None] * (high - low)
        offset = laser.offset_mm(tracer(pixels).points_mm)
        is_low = (offset <= 0.0) == (at_low <= 0.0)
        at_high = np.where(is_low & (stayed > 0.0), 0.5 * at_high, at_high)
        at_low = np.where(~is_low & (stayed < 0.0), 0.5 * at_low, at_low)
        stayed = np.where(is_low, 1.0, -1.0)
        low[is_low], at_low[is_low] = pixels[is_low], offset[is_low]
        high[~is_low], at_high[~is_low] = pixels[~is_low], offset[~is_low]
        if float(np.abs(offset).max(initial=0.0)) < _ON_SHEET_MM:
            break
    hits = tracer(pixels)
    is_lit = scene.laser_light(laser, hits) > 0.0
    return StripeTruth(
        points_px=pixels[is_lit],
        points_mm=hits.points_mm[is_lit],
        surface=hits.surface[is_lit].astype(np.float64),
    )


SUBPIXELS = 2
BAND_SIGMAS = 5.5
BLUR_REACH = 6.0
COARSE_STEP_PX = 8


@dataclass(frozen=True, slots=True)
class Speckle:
    """Grain of laser light: standard deviation over its mean before the lens's blur, and its sigma.

    A grain of 0 px gives independent samples.
    """

    contrast: float = 0.2
    grain_px: float = 0.5

    def __post_init__(self) -> None:
        if self.contrast < 0.0 or self.grain_px < 0.0:
            raise InputError("speckle contrast and grain cannot be negative")


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


Image32 = NDArray[np.float32]

MARGIN_PX = 2 * COARSE_STEP_PX


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
        x, y = (x_px - MARGIN_PX) // step * step, (y_px - MARGIN_PX) // step * step
        right, bottom = x_px + width_px + MARGIN_PX, y_px + height_px + MARGIN_PX
        return Region(x, y, -(-(right - x) // step) * step, -(-(bottom - y) // step) * step)

    def nodes_px(self) -> tuple[FloatArray, tuple[int, int]]:
        """(N, 2) full-sensor pixels of the coarse grid's nodes, and the grid's shape."""
        u = self.x_px + np.arange(0, self.width_px + 1, COARSE_STEP_PX)
        v = self.y_px + np.arange(0, self.height_px + 1, COARSE_STEP_PX)
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        return grid.astype(np.float64), (len(v), len(u))

    def pixels_px(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """(N, 2) full-sensor pixels of rows and columns of the region's image."""
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        return np.asarray(pixels + np.array([self.x_px, self.y_px]))


@dataclass(frozen=True, slots=True)
class PixelBox:
    """A rectangle of an image, from its first column and row to those behind its last."""

    left: int
    top: int
    right: int
    bottom: int

    @staticmethod
    def of(camera: RenderCamera) -> PixelBox:
        """The whole image."""
        return PixelBox(0, 0, camera.width_px, camera.height_px)

    @staticmethod
    def around(pixels_px: FloatArray, margin_px: int, camera: RenderCamera) -> PixelBox:
        """The part of an image that holds pixels (N, 2) with a margin; all if one is not known."""
        whole = PixelBox.of(camera)
        if not np.isfinite(pixels_px).all():
            return whole
        left, top = (np.floor(pixels_px.min(axis=0)) - margin_px).astype(int)
        right, bottom = (np.ceil(pixels_px.max(axis=0)) + margin_px + 1).astype(int)
        return PixelBox(int(left), int(top), int(right), int(bottom)).cut(whole)

    def cut(self, other: PixelBox) -> PixelBox:
        """What lies in another too; empty if nothing does."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return PixelBox(left, top, max(left, right), max(top, bottom))

    @property
    def is_empty(self) -> bool:
        """True without a pixel."""
        return 0 in self.shape

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top, self.right - self.left

    @property
    def corner_px(self) -> IntArray:
        """(2,) its first column and row."""
        return np.array([self.left, self.top])

    def within(self, other: PixelBox) -> tuple[slice, slice]:
        """Rows and columns of an image of another that holds it."""
        rows = slice(self.top - other.top, self.bottom - other.top)
        return rows, slice(self.left - other.left, self.right - other.left)


def between_nodes(nodes: Image32, step_px: int, size_px: tuple[int, int] | None = None) -> Image32:
    """(step H, step W) pixels between nodes (H, W), each of which is the pixel of its block.

    Only the first ``size_px``, width and height, of these if it is given.
    """
    step = 1.0 / step_px
    pixels = cv2.warpAffine(
        nodes,
        np.array([[step, 0.0, 0.0], [0.0, step, 0.0]]),
        size_px or (step_px * nodes.shape[1], step_px * nodes.shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(pixels, dtype=np.float32)


def to_pixels(nodes: Image32, region: Region) -> Image32:
    """(H, W) values of a region's pixels between those of its coarse grid."""
    return between_nodes(nodes, COARSE_STEP_PX, (region.width_px, region.height_px))


def enlarged(cells: NDArray[np.uint8], step_px: int) -> NDArray[np.uint8]:
    """(step H, step W) pixels that bear the value of their cell (H, W)."""
    size = (step_px * cells.shape[1], step_px * cells.shape[0])
    return np.asarray(cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


_FINE_GRAIN = Speckle(contrast=0.22, grain_px=0.6)
_MONO = Detector(halo_share=0.02)


@dataclass(frozen=True, slots=True)
class Imaging:
    """All that decides how good an image is, save the scene.

    Parameters
    ----------
    laser_level
        Peak of the laser's line on matt white that faces it, as a part of full scale, before the
        lens's blur.
    ambient
        Even light of the room during a scan on white, as a part of full scale.
    target_light
        The same while a target is photographed.
    speckle
        Grain of laser light.
    detector
        Sensor noise, halo, bits.
    gloss, texture
        Factors on the gloss and texture of everything in the scene.
    ghost_share, ghost_sigma_px
        Part of the light that comes back from the lens mirrored at the image's centre, and how
        blurred.
    spot_level, spot_mm
        Undiffracted beam in the middle of a projector of several lines: its brightness over that
        of the middle line, and the Gaussian sigma of its round section.
    stray_share
        Brightness, over that of the lines, of those that a glossy plate throws back to the head
        and the head back to the plate, for a plate of gloss 1; projectors of several lines only.
    laser_colour
        (3,) of a colour camera: what its red, green and blue pixels see of the laser's light, all
        three of each pixel; the room's light is white. None for a mono camera.
    """

    laser_level: float = 0.8
    ambient: float = 0.012
    target_light: float = 0.9
    speckle: Speckle = _FINE_GRAIN
    detector: Detector = _MONO
    gloss: float = 1.0
    texture: float = 1.0
    ghost_share: float = 0.0
    ghost_sigma_px: float = 5.0
    spot_level: float = 6.0
    spot_mm: float = 0.6
    stray_share: float = 0.12
    laser_colour: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        least = min(self.ambient, self.gloss, self.texture, self.ghost_share)
        least = min(least, self.spot_level, self.stray_share)
        if least < 0.0 or min(self.laser_level, self.target_light) <= 0.0:
            raise InputError("light, gloss and texture cannot be negative")
        if min(self.ghost_sigma_px, self.spot_mm) <= 0.0:
            raise InputError("a ghost image needs a blur and a spot a size")


IMAGING: dict[Preset, Imaging] = {
    "clean": Imaging(
        ambient=0.004,
        speckle=Speckle(contrast=0.01, grain_px=0.6),
        detector=Detector(electrons_per_level=2000.0, read_noise=0.2, halo_share=0.0),
        gloss=0.0,
        texture=0.0,
        spot_level=0.0,
        stray_share=0.0,
    ),
    "thesis": Imaging(),
    "harsh": Imaging(
        laser_level=1.3,
        ambient=0.08,
        speckle=Speckle(contrast=0.45, grain_px=0.9),
        detector=Detector(electrons_per_level=20.0, read_noise=2.0, halo_share=0.06),
        gloss=2.5,
        texture=2.5,
        ghost_share=0.01,
        spot_level=15.0,
        spot_mm=0.8,
    ),
}
