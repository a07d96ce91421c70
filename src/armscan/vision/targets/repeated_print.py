# SPDX-License-Identifier: Apache-2.0
"""What a lit target would show without the laser, told from the repetition of its print.

Where no image without laser was taken, bright print beside and under a line pulls its centre, and
discs and squares are taken for lines. But the print of a grid or chessboard repeats: what lies
under the line in one cell is seen without it in most of the others. Their median, brought to the
cell by pose and lens and to its brightness by the lamp's course over the board, is subtracted like
an image without laser. Light is taken to scale it: of a camera with a black level, dark print keeps
some levels. Many parallel lines a whole pitch apart lie alike in many cells, and go with the print.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, homogeneous
from armscan.geometry.least_squares import robust_sigma
from armscan.geometry.poses import Board, Pose
from armscan.models.camera import CameraModel
from armscan.records.exposure import Exposure
from armscan.vision.stripe.image import less_noise, local_moments
from armscan.vision.targets.target import (
    AprilGrid,
    Charuco,
    Chessboard,
    CircleGrid,
    Target,
    TargetView,
)

Floats32: TypeAlias = NDArray[np.float32]

LEAST_CELLS = 8
"""Of a kind: a median of fewer still shows the line where two of them are lit alike."""
NODE_PX = 8
"""Between pixels so far apart lens and perspective bend a place by some thousandths of a pixel."""
SAMPLES_PX = 1.5
MOST_SAMPLES = 6_000_000
STAGGERED_REACH = 1.25
"""Of the diamond around a point of an asymmetric grid, a little more: the discs at the tips of the
square around it stay out."""
FLATTEST = 2.0
"""Variance of 25 pixels of noise over its expectation: 3.5 of its standard deviations more."""
SLACK_STEPS = 3.0
"""Beyond a cell's border, so that no gap is left between two that misprints move apart."""
STRAY_SIGMAS = 3.0
"""A point farther than this off the others' scatter is pulled by the laser, not misprinted."""
MOST_UNLIKE = 0.25
"""A cell that differs by more from the print, of its contrast, is hidden or is none."""
ROUNDS = 4
LAMP_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Powers of x and y in the logarithm of the lamp's light over a board."""


def predict_print(
    exposure: Exposure,
    view: TargetView,
    target: Target,
    camera_from_board: Pose[Any, Board],
    camera: CameraModel,
) -> Exposure | None:
    """An exposure with its target as it would be without laser.

    Parameters
    ----------
    exposure
        With the laser on.
    view, target
        The target as it was found in that exposure.
    camera_from_board
        Its pose.
    camera
        The camera's intrinsics.

    Returns
    -------
    Cells that look like the others show their print. What is elsewhere loses its noise only, so
    that a difference shows no line there. None where no print is told.
    """
    if not does_repeat(target):
        return None
    cells = _Cells.of(view, target, camera_from_board, camera, exposure.window.binning)
    image = exposure.image if exposure.image.ndim == 3 else exposure.image[:, :, None]
    seen, is_seen = _places_seen(cells, exposure)
    spots = _Spots.of(cells, exposure)
    predicted, is_told = np.zeros_like(image), False
    for channel in range(image.shape[2]):
        own = image[:, :, channel].astype(np.float32)
        at = [seen[..., 1], seen[..., 0]]
        samples = map_coordinates(own, at, np.float32, order=3, mode="nearest")
        samples[~is_seen | ~cells.is_own] = np.nan
        print_of = _Print.of(samples, cells)
        if print_of is None:
            told = cv2.blur(own, cells.size_px)
        else:
            told, is_told = _laid_in(own, print_of, cells, spots), True
        predicted[:, :, channel] = np.rint(np.clip(told, 0.0, exposure.full_scale))
    return replace(exposure, image=predicted.reshape(exposure.image.shape)) if is_told else None


MOST_STRETCHED = 0.1
"""Cells are taken for square."""


def does_repeat(target: Target) -> bool:
    """Whether a target's print is the same in cells enough to be told from them."""
    if isinstance(target, Charuco | AprilGrid) or abs(target.stretch - 1.0) > MOST_STRETCHED:
        return False
    return bool(min(np.bincount(_kinds(target))) >= LEAST_CELLS)


def _kinds(target: Target) -> IntArray:
    """(K,) which of its prints a target shows around each point."""
    row, column = np.divmod(np.arange(len(target.points_board_mm)), target.columns)
    return (row + column) % 2 if isinstance(target, Chessboard) else np.zeros_like(row)


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Squares of a board, one around each target point, that show one print.

    ``centres_mm`` (K, 2), ``kind`` (K,) of the print in each, ``half_mm`` half of their side,
    ``shift_px`` (K, 2) by which a cell lies beside where the pose puts it, ``step_mm`` between
    samples of a cell, ``n_steps`` from its centre to its border. Of an asymmetric grid the cells
    overlap: what lies nearer to another centre is not their own.
    """

    centres_mm: FloatArray
    kind: IntArray
    half_mm: float
    shift_px: FloatArray
    step_mm: float
    n_steps: int
    is_staggered: bool
    camera_from_board: Pose[Any, Board]
    camera: CameraModel

    @staticmethod
    def of(
        view: TargetView,
        target: Target,
        camera_from_board: Pose[Any, Board],
        camera: CameraModel,
        binning: int,
    ) -> _Cells:
        points = target.points_board_mm[:, :2]
        distance, other = (np.asarray(found)[:, 1] for found in cKDTree(points).query(points, k=2))
        is_staggered = isinstance(target, CircleGrid) and target.is_asymmetric
        nearest_mm = float(np.median(distance))
        half = nearest_mm / np.sqrt(2.0) if is_staggered else 0.5 * nearest_mm
        where = camera.project(camera_from_board.apply(target.points_board_mm))
        width = np.linalg.norm(where - where[other], axis=1)
        shift = np.zeros_like(where)
        off = view.points_px - where[view.point_index]
        near = np.abs(off).max(axis=1) < STRAY_SIGMAS * robust_sigma(off.ravel())
        shift[view.point_index[near]] = off[near]
        half_px = half * float(np.nanmedian(width)) / nearest_mm / binning
        most = 0.5 * np.sqrt(MOST_SAMPLES / len(points))
        n = max(int(np.ceil(min(half_px * SAMPLES_PX, most))), 1)
        return _Cells(
            *(points, _kinds(target), half, shift, half / n, n),
            *(is_staggered, camera_from_board, camera),
        )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of a cell in the image, about: a line hardly shows in such means."""
        side = 2 * int(np.ceil(self.n_steps / SAMPLES_PX)) + 1
        return side, side

    @property
    def is_own(self) -> BoolArray:
        """(S * S,) samples that lie in the cell, or near its border."""
        return self.holds(self.offsets_mm, (STAGGERED_REACH - 1.0) * self.half_mm)

    def holds(self, offsets_mm: FloatArray, slack_mm: float) -> BoolArray:
        """(N,) whether places (N, 2) from a centre lie in its cell, or that far beyond it."""
        size = np.abs(offsets_mm)
        with np.errstate(invalid="ignore"):
            inside = np.all(size <= self.half_mm + slack_mm, axis=1)
            if self.is_staggered:
                inside &= size.sum(axis=1) <= self.half_mm + slack_mm
        return np.asarray(inside)

    @property
    def offsets_mm(self) -> FloatArray:
        """(S * S, 2) of the samples of a cell from its centre, row by row."""
        steps = np.linspace(-self.half_mm, self.half_mm, 2 * self.n_steps + 1)
        return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)

    def on_board_mm(self, q_px: FloatArray) -> FloatArray:
        """(N, 2) points of the board's plane behind full-sensor pixels (N, 2); NaN for none."""
        xy, is_valid = self.camera.undistort(q_px)
        turn, shift = self.camera_from_board.rotation, self.camera_from_board.translation_mm
        ray_from_board = np.column_stack([turn[:, 0], turn[:, 1], shift])
        places = homogeneous(xy) @ np.linalg.inv(ray_from_board).T
        is_valid &= places[:, 2] > 0.0
        return np.where(is_valid[:, None], places[:, :2] / places[:, 2:], np.nan)


def _places_seen(cells: _Cells, exposure: Exposure) -> tuple[Floats32, BoolArray]:
    """(K, S * S, 2) image pixels of all samples, and which of them (K, S * S) are in the image."""
    offsets = cells.offsets_mm
    pixels = np.zeros((len(cells.centres_mm), *offsets.shape), np.float32)
    last = np.array([exposure.width_px - 1, exposure.height_px - 1])
    is_seen = np.zeros(pixels.shape[:2], np.bool_)
    for k, (centre, shift) in enumerate(zip(cells.centres_mm, cells.shift_px, strict=True)):
        flat = np.column_stack([centre + offsets, np.zeros(len(offsets))])
        q = cells.camera.project(cells.camera_from_board.apply(flat)) + shift
        own = exposure.window.to_image(q)
        is_seen[k] = np.all((own >= 0.0) & (own <= last), axis=1)
        pixels[k, is_seen[k]] = own[is_seen[k]]
    return pixels, is_seen


@dataclass(frozen=True, slots=True, eq=False)
class _Spots:
    """Pixels of an image that lie in cells: ``rows``, ``columns`` (N,), the cell of each and where
    in it, ``offsets_mm`` (N, 2) from its centre.
    """

    rows: IntArray
    columns: IntArray
    cell: IntArray
    offsets_mm: FloatArray

    @staticmethod
    def of(cells: _Cells, exposure: Exposure) -> _Spots:
        places = _Places.of(cells, exposure)
        v, u = (part.ravel() for part in np.indices((exposure.height_px, exposure.width_px)))
        middle = 0.5 * (cells.centres_mm.min(axis=0) + cells.centres_mm.max(axis=0))
        reach = 0.5 * np.ptp(cells.centres_mm, axis=0) + 2.0 * cells.half_mm
        on_board = places.at(v, u)
        with np.errstate(invalid="ignore"):
            chosen = np.flatnonzero(np.all(np.abs(on_board - middle) < reach, axis=1))
        v, u = v[chosen], u[chosen]
        cell = np.asarray(cKDTree(cells.centres_mm).query(on_board[chosen])[1])
        shift = cells.shift_px[cell] / exposure.window.binning
        offsets = places.at(v - shift[:, 1], u - shift[:, 0]) - cells.centres_mm[cell]
        inside = cells.holds(offsets, slack_mm=SLACK_STEPS * cells.step_mm)
        return _Spots(v[inside], u[inside], cell[inside], offsets[inside])


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Places on the board (H, W, 2) behind every `NODE_PX`-th pixel of an image."""

    nodes_mm: FloatArray

    @staticmethod
    def of(cells: _Cells, exposure: Exposure) -> _Places:
        size = (exposure.height_px // NODE_PX + 2, exposure.width_px // NODE_PX + 2)
        v, u = NODE_PX * np.indices(size).astype(np.float64)
        q = exposure.window.to_full_sensor(np.stack([u, v], axis=-1).reshape(-1, 2))
        return _Places(cells.on_board_mm(q).reshape(*size, 2))

    def at(self, rows: FloatArray | IntArray, columns: FloatArray | IntArray) -> FloatArray:
        """(N, 2) places behind pixels, between the nodes by straight lines."""
        where = [rows / NODE_PX, columns / NODE_PX]
        parts = (self.nodes_mm[:, :, k] for k in range(2))
        return np.stack([map_coordinates(one, where, order=1, mode="nearest") for one in parts], 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Print:
    """A print in one channel: ``levels`` (kinds, S, S) under even light, ``lamp`` the light's
    coefficients over ``LAMP_TERMS``, and which cells ``is_like`` (K,) the others.
    """

    levels: FloatArray
    lamp: FloatArray
    is_like: BoolArray

    @staticmethod
    def of(samples: Floats32, cells: _Cells) -> _Print | None:
        """From the samples (K, S * S) of all cells, NaN outside the image; None for none."""
        whole: BoolArray = np.any(np.isfinite(samples), axis=1)
        lamp, kinds = np.zeros(len(LAMP_TERMS)), range(int(cells.kind.max()) + 1)
        levels = np.zeros((len(kinds), samples.shape[1]))
        is_like = whole
        for _ in range(ROUNDS):
            of_lamp = _lamp_at(lamp, cells.centres_mm, cells)
            even = samples / of_lamp[:, None].astype(np.float32)
            for kind in kinds:
                own = is_like & (cells.kind == kind)
                if own.sum() < LEAST_CELLS:
                    return None
                levels[kind] = _median_over(even[own])
            dark, light = np.nanquantile(levels, [0.05, 0.95])
            if not light > max(dark, 1.0):
                return None
            expected = levels[cells.kind]
            with np.errstate(invalid="ignore"):
                is_light = expected > 0.5 * (dark + light)
                unlike = _median_over(np.abs(even - expected).T) / (light - dark)
            is_like = whole & (unlike < MOST_UNLIKE)
            ratio = np.where(is_light, samples / np.maximum(expected, 1.0), np.nan)
            lamp = _fit_lamp(_median_over(ratio.T), is_like, cells)
        side = 2 * cells.n_steps + 1
        return _Print(np.nan_to_num(levels).reshape(-1, side, side), lamp, is_like)


def _median_over(values: FloatArray | Floats32) -> FloatArray:
    """(N,) median of columns (M, N), without what is not known; NaN for columns without any."""
    ordered = np.sort(values, axis=0)
    count = np.isfinite(values).sum(axis=0)
    last, columns = len(values) - 1, np.arange(values.shape[1])
    low = ordered[np.maximum(count - 1, 0) // 2, columns]
    high = ordered[np.minimum(count // 2, last), columns]
    return np.where(count > 0, 0.5 * (low + high), np.nan)


def _lamp_design(places_mm: FloatArray, cells: _Cells) -> FloatArray:
    middle = cells.centres_mm.mean(axis=0)
    x, y = ((places_mm - middle) / np.ptp(cells.centres_mm, axis=0).max()).T
    return np.stack([x**i * y**j for i, j in LAMP_TERMS], axis=1)


def _lamp_at(lamp: FloatArray, places_mm: FloatArray, cells: _Cells) -> FloatArray:
    """(N,) light at places (N, 2) of the board."""
    return np.asarray(np.exp(_lamp_design(places_mm, cells) @ lamp))


def _fit_lamp(light: FloatArray, is_like: BoolArray, cells: _Cells) -> FloatArray:
    """Coefficients of the light that cells (K,) have, without those that stray."""
    with np.errstate(invalid="ignore", divide="ignore"):
        known = is_like & np.isfinite(light) & (light > 0.0)
    design, wanted = _lamp_design(cells.centres_mm[known], cells), np.log(light[known])
    use, lamp = np.ones(len(wanted), bool), np.zeros(len(LAMP_TERMS), np.float64)
    for _ in range(ROUNDS):
        if use.sum() < 2 * len(LAMP_TERMS):
            return lamp
        lamp = np.asarray(np.linalg.lstsq(design[use], wanted[use], rcond=None)[0])
        rest = wanted - design @ lamp
        use = np.abs(rest) <= STRAY_SIGMAS * max(robust_sigma(rest[use]), 1e-3)
    return lamp


def _laid_in(image: Floats32, print_of: _Print, cells: _Cells, spots: _Spots) -> Floats32:
    """What an image (H, W) is without laser in the cells of its print, elsewhere without noise."""
    likely = print_of.is_like[spots.cell]
    places = cells.centres_mm[spots.cell] + spots.offsets_mm
    at = (spots.offsets_mm / cells.step_mm + cells.n_steps)[:, ::-1]
    level = np.zeros(len(places))
    for kind, levels in enumerate(print_of.levels):
        own = np.flatnonzero(likely & (cells.kind[spots.cell] == kind))
        level[own] = map_coordinates(levels, at[own].T, order=3, mode="nearest")
    level = (level * _lamp_at(print_of.lamp, places, cells))[likely]
    where = spots.rows[likely], spots.columns[likely]
    noise = FLATTEST * robust_sigma(image[where] - level) ** 2
    told = less_noise(image, *local_moments(image), noise)
    told[where] = level
    return told
