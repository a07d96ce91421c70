# SPDX-License-Identifier: Apache-2.0
"""The wavy plate: where rays meet it, and how it leans there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from armscan.errors import InputError
from armscan.simulation.objects.shapes import Wave, WavyPlate
from armscan.simulation.optics.scene import MISS

PLATE = WavyPlate((110.0, 90.0), (Wave(1.6, 40.0, 15.0, 0.4), Wave(0.9, 26.0, 105.0, 2.0)))


def _rays(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Origins 140 mm over the plate and unit directions down to it, up to 50 degrees oblique."""
    origins = np.column_stack([rng.uniform(-90, 90, (n, 2)), np.full(n, 140.0)])
    aims = np.column_stack([rng.uniform(-40, 40, (n, 2)), np.zeros(n)])
    directions = aims - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _first_root(origin: np.ndarray, direction: np.ndarray) -> float:
    """The same by brute force: the first change of sign over steps of 0.02 mm, then bisection."""

    def above(distance: float) -> float:
        x, y, z = origin + distance * direction
        waves = (
            w.amplitude_mm
            * np.sin(
                2 * np.pi / w.length_mm * (x * np.cos(np.radians(w.azimuth_deg)))
                + 2 * np.pi / w.length_mm * (y * np.sin(np.radians(w.azimuth_deg)))
                + w.phase_rad
            )
            for w in PLATE.waves
        )
        return float(z - sum(waves))

    start = (3.0 - origin[2]) / direction[2]
    steps = start + np.arange(0.0, 12.0, 0.02)
    heights = np.array([above(step) for step in steps])
    k = int(np.flatnonzero(heights <= 0.0)[0])
    return float(brentq(above, steps[k - 1], steps[k], xtol=1e-12))


def test_rays_stop_at_the_first_crest_that_they_meet():
    origins, directions = _rays(60, np.random.default_rng(1))
    found = PLATE.intersect(origins, directions)
    wanted = [_first_root(o, d) for o, d in zip(origins, directions, strict=True)]
    np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_normals_follow_the_heights():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-40, 40, (2, 50))
    step = 1e-4
    rise_x = (PLATE.height_mm(x + step, y) - PLATE.height_mm(x - step, y)) / (2 * step)
    rise_y = (PLATE.height_mm(x, y + step) - PLATE.height_mm(x, y - step)) / (2 * step)
    points = np.column_stack([x, y, PLATE.height_mm(x, y)])
    normals = PLATE.normals(points)
    np.testing.assert_allclose(-normals[:, 0] / normals[:, 2], rise_x, atol=1e-7)
    np.testing.assert_allclose(-normals[:, 1] / normals[:, 2], rise_y, atol=1e-7)
    np.testing.assert_allclose(PLATE.distance_mm(points + 0.01 * normals), 0.01, rtol=0.01)


def test_rays_beside_it_or_from_below_meet_nothing():
    down, up = np.array([[0.0, 0.0, -1.0]]), np.array([[0.0, 0.0, 1.0]])
    assert PLATE.intersect(np.array([[56.0, 0.0, 100.0]]), down)[0] == MISS
    assert PLATE.intersect(np.array([[54.0, 0.0, 100.0]]), down)[0] < 105.0
    assert PLATE.intersect(np.array([[0.0, 0.0, -100.0]]), up)[0] == MISS


def test_a_plate_without_waves_is_refused():
    with pytest.raises(InputError, match="0 waves"):
        WavyPlate((10.0, 10.0), ())
