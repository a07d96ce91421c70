# SPDX-License-Identifier: Apache-2.0
"""One light sheet draws one line: each ray of the laser lights one point, the first that it meets.

Where a line runs on unbroken, all rays around there are spent on it. What else is bright in the
sheet's part of the image then is a reflection, an edge that a compressed photograph made, or light
of another source, however well it meets the sheet.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.light_sheet import LightSheet

LARGEST_SLANT = 0.6
"""Tangent of the angle at which a ray may run to the sheet's depth axis: line lenses spread light
by up to 60 degrees. Where the sheet knows its rays, they are followed and half of it is enough."""
NEEDED = 0.5
"""A segment is left without rays if fewer than this part of its own width is free around it."""
STEP_SPACINGS = 3.0
"""Rays are told apart by so many of the spacings between neighbouring points."""


def is_without_ray(
    points_mm: FloatArray,
    intensity: FloatArray,
    segment: IntArray,
    sheet: LightSheet,
) -> BoolArray:
    """(N,) True for the points of segments for which brighter ones left no ray of the laser.

    Parameters
    ----------
    points_mm
        (N, 3) on the sheet, Sensor frame.
    intensity
        (N,) peak grey level above the background.
    segment
        (N,) number of each point's connected segment.
    sheet
        The light sheet.
    """
    lost = np.zeros(len(points_mm), dtype=np.bool_)
    if len(np.unique(segment)) < 2:
        return lost
    ray, depth = _rays(points_mm, sheet)
    slant = LARGEST_SLANT * (0.5 if np.any(sheet.fan != 0.0) else 1.0)
    step = STEP_SPACINGS * _spacing(ray, segment)
    low = ray.min()
    bins = np.floor((ray - low) / step).astype(np.int64)
    first_depth = np.full(int(bins.max()) + 1, np.nan)
    inverse = np.unique(segment, return_inverse=True)[1]
    strength = np.bincount(inverse, np.maximum(intensity, 0.0))
    for k in np.argsort(-strength):
        own = np.flatnonzero(inverse == k)
        spent = np.isfinite(first_depth)
        apart = 0.0
        if spent.any():
            nearest = np.interp(bins[own], np.flatnonzero(spent), first_depth[spent])
            apart = float(np.abs(depth[own] - nearest).max())
        reach = int(np.ceil(slant * apart / step))
        start, stop = int(bins[own].min()) - reach, int(bins[own].max()) + reach + 1
        within = np.arange(max(start, 0), min(stop, len(spent)))
        n_free = stop - start - int(spent[within].sum())
        if n_free < NEEDED * (int(bins[own].max()) - int(bins[own].min()) + 1):
            lost[own] = True
            continue
        covered = np.arange(bins[own].min(), bins[own].max() + 1)
        order = np.argsort(bins[own])
        first_depth[covered] = np.interp(covered, bins[own][order], depth[own][order])
    return lost


def _rays(points_mm: FloatArray, sheet: LightSheet) -> tuple[FloatArray, FloatArray]:
    """Where the laser's ray of each point crosses the sheet's middle, and its depth, in mm."""
    local = (points_mm - sheet.origin_mm) @ sheet.axes[:2].T / sheet.scale_mm
    u, v = local[:, 0], local[:, 1]
    lean, spread = sheet.fan
    u0 = (u - lean * v) / np.maximum(1.0 + spread * v, 0.2)
    return np.asarray(u0 * sheet.scale_mm), np.asarray(v * sheet.scale_mm)


def _spacing(ray: FloatArray, segment: IntArray) -> float:
    steps = np.abs(np.diff(ray))[np.diff(segment) == 0]
    return max(float(np.median(steps)) if len(steps) else 0.0, 1e-6)
