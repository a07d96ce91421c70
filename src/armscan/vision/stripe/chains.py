# SPDX-License-Identifier: Apache-2.0
"""Sums over neighbours along a chain."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray


def chain_bounds(chain: IntArray) -> tuple[IntArray, IntArray]:
    """First index, and index after the last, of each point's chain: two (N,) arrays."""
    first = np.searchsorted(chain, chain, side="left")
    stop = np.searchsorted(chain, chain, side="right")
    return first.astype(np.int64), stop.astype(np.int64)


def sum_along(values: FloatArray, chain: IntArray, half: int) -> FloatArray:
    """Sum (N, ...) over the neighbours within ``half`` places on the same chain."""
    first, stop = chain_bounds(chain)
    place = np.arange(len(chain))
    low = np.maximum(first, place - half)
    high = np.minimum(stop, place + half + 1)
    running = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    return np.asarray(running[high] - running[low])


def mean_along(values: FloatArray, weights: FloatArray, chain: IntArray, half: int) -> FloatArray:
    """Weighted mean (N,) over the neighbours; 0 where the weights sum to 0."""
    total = sum_along(weights, chain, half)
    mean = sum_along(weights * values, chain, half)
    return np.asarray(np.where(total > 0.0, mean / np.where(total > 0.0, total, 1.0), 0.0))


def chain_lengths_px(points_px: FloatArray, chain: IntArray) -> FloatArray:
    """Arc length (N,) of each point's chain."""
    n = int(chain.max()) + 1 if len(chain) else 0
    step = np.hypot(*np.diff(points_px, axis=0).T) * (np.diff(chain) == 0)
    total = np.bincount(chain[1:], weights=step, minlength=n) if n else np.zeros(0)
    return np.asarray(total[chain])


def strong_median(values: FloatArray) -> float:
    """Median of values (N,) >= 0 weighted by their squares: typical of the strong ones."""
    order = np.sort(values)
    weight = np.cumsum(order * order)
    if not len(order) or weight[-1] <= 0.0:
        return 0.0
    return float(order[np.searchsorted(weight, 0.5 * weight[-1])])
