# SPDX-License-Identifier: Apache-2.0
"""Flat faces and balls found in a cloud by counting, the same way every time."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

N_TRIALS = 800
N_SCORED = 3000
"""Points, drawn evenly at random, on which candidates are scored."""

BATCH = 100
POLISHING_ROUNDS = 4
MIN_SINE = 0.02
"""Flattest triangle, as height over length, that may carry a candidate."""


def dominant_flat(points: FloatArray, band: float) -> FloatArray | FitFailure:
    """Unit normal (D,) of the plane (D = 3) or line (D = 2) that most points lie near.

    Parameters
    ----------
    points
        (N, D) points.
    band
        Largest distance of a supporting point.
    """
    rng = np.random.default_rng(0)
    n, dimension = points.shape
    drawn = points[rng.integers(0, n, (N_TRIALS, dimension))]
    normals, is_valid = _normals(drawn)
    if not is_valid.any():
        return FitFailure("the points lie on one line", "give points that spread in a face")
    normals, start = normals[is_valid], drawn[is_valid, 0]
    scored = points[rng.permutation(n)[:N_SCORED]]
    offsets = np.einsum("md,md->m", normals, start)
    votes = np.concatenate(
        [
            (np.abs(scored @ normals[k : k + BATCH].T - offsets[k : k + BATCH]) <= band).sum(axis=0)
            for k in range(0, len(normals), BATCH)
        ]
    )
    best = int(votes.argmax())
    return _polished(points, normals[best], float(offsets[best]), band)


def _normals(drawn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals of (M, D, D) sets of points, and which of them are determined."""
    edge = drawn[:, 1] - drawn[:, 0]
    length = np.linalg.norm(edge, axis=1)
    if drawn.shape[1] == 2:
        normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
        is_valid = length > 0.0
    else:
        other = drawn[:, 2] - drawn[:, 0]
        normal = np.cross(edge, other)
        is_valid = np.linalg.norm(normal, axis=1) > MIN_SINE * length * np.linalg.norm(
            other, axis=1
        )
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(size > 0.0, size, 1.0), is_valid


def _polished(points: FloatArray, normal: FloatArray, offset: float, band: float) -> FloatArray:
    for _ in range(POLISHING_ROUNDS):
        near = points[np.abs(points @ normal - offset) <= band]
        if len(near) < points.shape[1]:
            break
        centre = near.mean(axis=0)
        normal = np.linalg.svd(near - centre, full_matrices=False)[2][-1]
        offset = float(normal @ centre)
    return normal


def find_ball(
    points_mm: FloatArray, radius_mm: float, band_mm: float
) -> tuple[FloatArray, int] | FitFailure:
    """Centre (3,) of the ball of known radius that most points lie on, and their count.

    Candidates pass through three points of one neighbourhood each, as a ball may be a small part
    of the cloud; each has two centres.

    Parameters
    ----------
    points_mm
        (N, 3) points.
    radius_mm
        Radius of the ball.
    band_mm
        Largest distance of a supporting point from the surface.
    """
    rng = np.random.default_rng(0)
    scored = points_mm[rng.permutation(len(points_mm))[:N_SCORED]]
    centres = _ball_candidates(scored, radius_mm, rng)
    if len(centres) == 0:
        return FitFailure(
            f"no three points could lie on a ball of radius {radius_mm:g} mm",
            "check the diameter and the unit (mm)",
        )
    votes = np.concatenate(
        [
            _ball_votes(scored, centres[k : k + BATCH], radius_mm, band_mm)
            for k in range(0, len(centres), BATCH)
        ]
    )
    centre = centres[int(votes.argmax())]
    near = np.abs(np.linalg.norm(points_mm - centre, axis=1) - radius_mm) <= band_mm
    return centre, int(near.sum())


def _ball_candidates(scored: FloatArray, radius_mm: float, rng: np.random.Generator) -> FloatArray:
    found = []
    for first in scored[rng.integers(0, len(scored), N_TRIALS)]:
        offset = np.linalg.norm(scored - first, axis=1)
        near = scored[(offset <= 1.6 * radius_mm) & (offset > 0.2 * radius_mm)]
        if len(near) >= 2:
            found.append([first, *near[rng.choice(len(near), 2, replace=False)]])
    if not found:
        return np.zeros((0, 3))
    corners = np.array(found)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(a, b)
    size2 = np.einsum("ij,ij->i", across, across)
    aa, bb = np.einsum("ij,ij->i", a, a), np.einsum("ij,ij->i", b, b)
    is_wide = size2 > (0.1 * np.sqrt(aa * bb)) ** 2
    a, b, across, size2, aa, bb = (item[is_wide] for item in (a, b, across, size2, aa, bb))
    # circumcentre of each triangle, seen from its first corner
    middle = np.cross(aa[:, None] * b - bb[:, None] * a, across) / (2.0 * size2)[:, None]
    rise2 = radius_mm**2 - np.einsum("ij,ij->i", middle, middle)
    is_possible = rise2 > 0.0
    middle, start = middle[is_possible], corners[is_wide, 0][is_possible]
    up = across[is_possible] / np.sqrt(size2[is_possible])[:, None]
    rise = np.sqrt(rise2[is_possible])[:, None] * up
    return np.concatenate([start + middle + rise, start + middle - rise])


def _ball_votes(
    scored: FloatArray, centres: FloatArray, radius_mm: float, band_mm: float
) -> FloatArray:
    # |p - c|^2 by its parts: no (M, N, 3) array; about the mean, so that digits are kept
    mean = scored.mean(axis=0)
    p, c = scored - mean, centres - mean
    squared = (c**2).sum(axis=1)[:, None] + (p**2).sum(axis=1)[None, :] - 2.0 * c @ p.T
    distance = np.sqrt(np.maximum(squared, 0.0))
    return np.asarray((np.abs(distance - radius_mm) <= band_mm).sum(axis=1))
