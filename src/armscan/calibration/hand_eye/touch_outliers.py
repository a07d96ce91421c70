# SPDX-License-Identifier: Apache-2.0
"""Touches of a flat face that do not fit the others."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import fit_plane

OUTLIER_PROBABILITY = 0.01
"""Chance that good touches, all together, get one of them named."""
FEWEST_TO_JUDGE = 6
ROUNDING_MM = 1e-9
"""Residuals that small are the rounding of numbers, not touches."""


def find_outliers(points_mm: FloatArray) -> tuple[int, ...]:
    """Touches that do not fit the others: the worst first, each judged without itself.

    The externally studentised residual of the worst touch follows Student's t with n - 4 degrees
    of freedom if all are good; it is named if it is less probable than `OUTLIER_PROBABILITY` over
    n, and the rest is judged again. At most a quarter of the touches is named.
    """
    left = np.arange(len(points_mm))
    named: list[int] = []
    while len(left) >= FEWEST_TO_JUDGE and len(named) < len(points_mm) // 4:
        scores = _studentised(points_mm[left])
        worst = int(np.argmax(scores))
        limit = student.isf(OUTLIER_PROBABILITY / (2 * len(left)), len(left) - 4)
        if not scores[worst] > limit:
            break
        named.append(int(left[worst]))
        left = np.delete(left, worst)
    return tuple(named)


def _studentised(points: FloatArray) -> FloatArray:
    """(N,) size of each residual over its standard deviation as the others tell it."""
    fit = fit_plane(points)
    n = len(points)
    if isinstance(fit, FitFailure):
        return np.zeros(n)
    along = (points - fit.value.point_mm) @ fit.value.axes[:2].T
    leverage = 1.0 / n + (along**2 / np.maximum((along**2).sum(axis=0), 1e-300)).sum(axis=1)
    free = np.maximum(1.0 - leverage, 1e-12)
    squares = float(fit.residuals @ fit.residuals)
    if squares <= n * ROUNDING_MM**2:
        return np.zeros(n)
    others = np.maximum(squares - fit.residuals**2 / free, 1e-24 * squares)
    return np.asarray(np.abs(fit.residuals) / np.sqrt(others / (n - 4) * free))
