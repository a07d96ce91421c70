# SPDX-License-Identifier: Apache-2.0
"""Places in an image where two edges cross and the four sectors alternate: chessboard corners.

The blurred image has a saddle there, whatever the contrast. On a ring around a crossing opposite
sectors are alike, so that the ring's half-turn average keeps the contrast (an edge, the outer
corner of a square or a blob lose it), and it changes its tone twice: the two edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.vision.targets.grey import Grey32

_BLUR_PX = 1.2
_RING_PX = 4.0
_N_RING = 32
_MAX_ODD = 0.6
"""Most of the half-turn average's amplitude that may be odd: 1 at the outer corner of a square."""
_NARROWEST = 2
"""Narrowest sector in steps of the ring, 11 degrees each."""
_MAX_CROSSINGS = 3000
_SAME_PLACE_PX = 3.0
_LEVELS = (1.0, 2.0, 4.0)
"""Reductions of the image in which crossings are looked for: the coarse ones are for blur."""


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Crossings of two edges.

    Parameters
    ----------
    points_px
        (N, 2) places, image pixels, to about half a pixel.
    rising_rad, falling_rad
        (N,) directions of the edges, from u towards v: turning further that way, the image gets
        lighter at the rising one and darker at the falling one. Modulo half a turn.
    contrast
        (N,) difference in level between light and dark sectors.
    """

    points_px: FloatArray
    rising_rad: FloatArray
    falling_rad: FloatArray
    contrast: FloatArray

    def __len__(self) -> int:
        """Count of crossings."""
        return len(self.points_px)


def find_crossings(grey: Grey32, min_contrast: float) -> Crossings:
    """Find all crossings with at least ``min_contrast`` levels between light and dark."""
    found = []
    for level in _LEVELS:
        size = (round(grey.shape[1] / level), round(grey.shape[0] / level))
        if min(size) < 8 * _RING_PX:
            break
        small = grey if level == 1.0 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        rows = _crossings_in(np.asarray(small, dtype=np.float32), min_contrast)
        rows[:, :2] = (rows[:, :2] + 0.5) * level - 0.5
        found.append(np.column_stack([rows, np.full(len(rows), level)]))
    table = np.concatenate(found)
    table = table[_first_of_each(table)]
    return Crossings(table[:, :2].copy(), table[:, 2], table[:, 3], table[:, 4])


def _crossings_in(grey: Grey32, min_contrast: float) -> FloatArray:
    """Rows u, v, rising, falling, contrast of the crossings at one scale, strongest first."""
    blurred = np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), dtype=np.float32)
    points = _saddles(blurred, min_contrast)
    ring = _ring_levels(blurred, points)
    half = ring.shape[1] // 2
    even = 0.5 * (ring[:, :half] + ring[:, half:])
    odd = 0.5 * (ring[:, :half] - ring[:, half:])
    high, low = even.max(axis=1), even.min(axis=1)
    amplitude = 0.5 * (high - low)
    is_light = even > (0.5 * (high + low))[:, None]
    changes = np.diff(np.column_stack([is_light, is_light[:, :1]]).astype(np.int8), axis=1)
    n_light = is_light.sum(axis=1)
    is_crossing = (np.abs(changes).sum(axis=1) == 2) & (2.0 * amplitude >= min_contrast)
    is_crossing &= (n_light >= _NARROWEST) & (n_light <= half - _NARROWEST)
    is_crossing &= np.sqrt((odd**2).mean(axis=1)) < _MAX_ODD * amplitude
    even, changes, amplitude = even[is_crossing], changes[is_crossing], amplitude[is_crossing]
    middle = 0.5 * (high + low)[is_crossing]
    rising = _where_it_passes(even, middle, np.argmax(changes, axis=1))
    falling = _where_it_passes(even, middle, np.argmin(changes, axis=1))
    return np.column_stack([points[is_crossing], rising, falling, 2.0 * amplitude])


def _saddles(blurred: Grey32, min_contrast: float) -> FloatArray:
    """Saddle points (N, 2) of the blurred image, the strongest first."""
    uu = cv2.filter2D(blurred, cv2.CV_32F, np.array([[1.0, -2.0, 1.0]]))
    vv = cv2.filter2D(blurred, cv2.CV_32F, np.array([[1.0], [-2.0], [1.0]]))
    cross = np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    uv = cv2.filter2D(blurred, cv2.CV_32F, 0.25 * cross)
    strength = uv * uv - uu * vv
    peak = cv2.dilate(strength, np.ones((5, 5), np.uint8))
    # A sharp crossing of amplitude c has the saddle (2 c / (pi s^2))^2; defocus may take 3/4.
    least = 0.25 * 0.5 * min_contrast * 2.0 / (np.pi * (_BLUR_PX**2 + 0.3))
    is_peak = (strength >= peak) & (strength > least**2)
    margin = int(np.ceil(_RING_PX)) + 1
    is_peak[:margin] = is_peak[-margin:] = False
    is_peak[:, :margin] = is_peak[:, -margin:] = False
    v, u = np.nonzero(is_peak)
    order = np.argsort(-strength[v, u], kind="stable")[:_MAX_CROSSINGS]
    u, v = u[order], v[order]
    gradient_u = 0.5 * (blurred[v, u + 1] - blurred[v, u - 1])
    gradient_v = 0.5 * (blurred[v + 1, u] - blurred[v - 1, u])
    a, b, c, size = uu[v, u], uv[v, u], vv[v, u], strength[v, u]
    du = (c * gradient_u - b * gradient_v) / size
    dv = (a * gradient_v - b * gradient_u) / size
    is_near = np.maximum(np.abs(du), np.abs(dv)) < 1.5
    return np.column_stack([u + du, v + dv])[is_near].astype(np.float64)


def _ring_levels(blurred: Grey32, points: FloatArray) -> FloatArray:
    """Levels (N, steps) on a ring around each point."""
    angle = 2.0 * np.pi * np.arange(_N_RING) / _N_RING
    at_u = (points[:, :1] + _RING_PX * np.cos(angle)).astype(np.float32)
    at_v = (points[:, 1:] + _RING_PX * np.sin(angle)).astype(np.float32)
    if not len(points):
        return np.zeros((0, _N_RING))
    levels = cv2.remap(blurred, at_u, at_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels, dtype=np.float64)


def _where_it_passes(even: FloatArray, middle: FloatArray, step: IntArray) -> FloatArray:
    """Angle (N,) at which each half ring passes its middle level after the step given."""
    every = np.arange(len(even))
    before = even[every, step]
    after = even[every, (step + 1) % even.shape[1]]
    part = (middle - before) / (after - before)
    return np.asarray(np.mod((step + part) * np.pi / even.shape[1], np.pi))


def _first_of_each(table: FloatArray) -> BoolArray:
    """Keep, of crossings found at several scales, the one at the finest."""
    kept = np.ones(len(table), dtype=np.bool_)
    if not len(table):
        return kept
    pairs = cKDTree(table[:, :2]).query_pairs(_SAME_PLACE_PX * max(_LEVELS), output_type="ndarray")
    apart = np.hypot(*(table[pairs[:, 0], :2] - table[pairs[:, 1], :2]).T)
    pairs = pairs[apart < _SAME_PLACE_PX * table[pairs[:, 1], 5]]
    for fine, coarse in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
        if kept[fine]:
            kept[coarse] = False
    return kept
