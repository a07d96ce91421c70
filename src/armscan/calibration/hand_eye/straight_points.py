# SPDX-License-Identifier: Apache-2.0
"""Which points of an exposure lie on the straight stripe that a flat plate makes."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray

N_PAIRS = 80
MAX_COUNTED = 400
LEAST_SIGMA_MM = 1e-4
MAD_TO_SIGMA = 1.4826


def find_straight_points(
    points_mm: FloatArray, tolerance_mm: float, outlier_sigma: float
) -> BoolArray:
    """Mark the points of the one straight, slightly bowed stripe that most points lie on.

    A sheet of light may be bowed by a tenth of a millimetre, so the points are finally compared
    with a parabola; edges of the plate and whatever lies beyond it are left out.

    Parameters
    ----------
    points_mm
        (N, 3) points of one sheet in one exposure.
    tolerance_mm
        Half width of the band about a straight line in which points belong together.
    outlier_sigma
        Robust sigmas from the parabola that are accepted.
    """
    if len(points_mm) < 3:
        return np.zeros(len(points_mm), dtype=np.bool_)
    kept = _most_common_line(points_mm, tolerance_mm)
    for _ in range(4):
        if int(kept.sum()) < 4:
            return kept
        off = _off_parabola_mm(points_mm, kept)
        sigma = max(MAD_TO_SIGMA * float(np.median(off[kept])), LEAST_SIGMA_MM)
        updated = off <= min(outlier_sigma * sigma, tolerance_mm)
        if bool((updated == kept).all()):
            break
        kept = updated
    return kept


def bow_mm(points_mm: FloatArray) -> float:
    """Root mean square distance of (N, 3) points from their straight line."""
    spread = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return float(np.sqrt((spread[1:] ** 2).sum() / len(points_mm)))


def _most_common_line(points_mm: FloatArray, tolerance_mm: float) -> BoolArray:
    """Points within the tolerance of the line through two points that has most of them."""
    sample = points_mm[:: max(1, len(points_mm) // MAX_COUNTED)]
    draw = np.random.default_rng(0).integers(0, len(sample), (N_PAIRS, 2))
    start, chord = sample[draw[:, 0]], sample[draw[:, 1]] - sample[draw[:, 0]]
    length = np.linalg.norm(chord, axis=1)
    usable = length > 5.0 * tolerance_mm
    if not bool(usable.any()):
        return np.ones(len(points_mm), dtype=np.bool_)
    start, direction = start[usable], chord[usable] / length[usable, None]
    counts = [
        int((_off_line_mm(sample, p, d) <= tolerance_mm).sum())
        for p, d in zip(start, direction, strict=True)
    ]
    best = int(np.argmax(counts))
    return np.asarray(_off_line_mm(points_mm, start[best], direction[best]) <= tolerance_mm)


def _off_line_mm(points_mm: FloatArray, start: FloatArray, direction: FloatArray) -> FloatArray:
    offset = points_mm - start
    across = offset - (offset @ direction)[:, None] * direction
    return np.asarray(np.linalg.norm(across, axis=1))


def _off_parabola_mm(points_mm: FloatArray, kept: BoolArray) -> FloatArray:
    centre = points_mm[kept].mean(axis=0)
    _, _, axes = np.linalg.svd(points_mm[kept] - centre, full_matrices=False)
    local = (points_mm - centre) @ axes.T
    along = local[:, 0] / max(float(np.abs(local[kept, 0]).max()), 1e-12)
    basis = np.column_stack([np.ones(len(along)), along, along**2])
    fitted, *_ = np.linalg.lstsq(basis[kept], local[kept, 1:], rcond=None)
    return np.asarray(np.linalg.norm(local[:, 1:] - basis @ fitted, axis=1))
