# SPDX-License-Identifier: Apache-2.0
"""Noise-weighted profile fits at ridge points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.stripe_fit import REACH_SIGMAS, VARIANCE, fit_profiles, read_sides
from armscan.kernels.stripe_neighbours import find_other_lines
from armscan.vision.stripe.chains import chain_bounds, chain_lengths_px, mean_along
from armscan.vision.stripe.noise import estimate_noise, start_noise
from armscan.vision.stripe.plane import StripePlane
from armscan.vision.stripe.ridge import RidgePoints

NOISE_SAMPLE = 1500
NOISE_ROUNDS = 2
SIDE_HALF = 8
"""Neighbours over which the background beside the line is averaged."""
RESULT_COLUMNS = 8
CLEAR_SIGMAS = 11.0
"""Another line within this many sigmas may light up the background beside a slanted line."""
LEAST_REACH_PX = 6.0
FOOT_SIGMAS = 3.2
LEAST_REACH_SIGMAS = 1.4
"""The window shrinks beside another line, so that its foot stays outside."""


@dataclass(frozen=True, slots=True, eq=False)
class ProfileFits:
    """Result of fitting the cross-section at each ridge point.

    Parameters
    ----------
    ridge
        The ridge points, only those whose fit succeeded.
    values
        (N, 8) columns as named in `armscan.kernels.stripe_fit`.
    sides
        (N, 2) background on the lower and upper side, averaged along the line.
    side_sigma
        (N,) standard deviation of the difference of the two sides.
    neighbour
        (N, 2) distance to the nearest other line on the lower and upper side, in px.
    noise
        (3,) ``C^2``, ``1 / gain``, ``read^2``.
    """

    ridge: RidgePoints
    values: FloatArray
    sides: FloatArray
    side_sigma: FloatArray
    neighbour: FloatArray
    noise: FloatArray


def axis_component(table: FloatArray) -> FloatArray:
    """(N,) size of the normal's component along the fitted column or row."""
    rows = np.arange(len(table))
    return np.abs(table[rows, 3 - table[:, 5].astype(np.int64)])


def fit_ridge(
    plane: StripePlane,
    ridge: RidgePoints,
    line_sigma_px: float,
    background_noise: float,
    shortest_px: float,
) -> ProfileFits:
    """Fit a Gaussian with weights from the noise model at every ridge point.

    The noise model is estimated from a sample of the points first. Chains shorter than
    ``shortest_px`` are fitted, but do not count as lines beside others.
    """
    table = ridge.table
    sigma = line_sigma_px / np.maximum(axis_component(table), 0.5)
    neighbour = _neighbours(plane, ridge, line_sigma_px, shortest_px)
    room = neighbour.min(axis=1) / line_sigma_px - FOOT_SIGMAS
    reach = np.clip(room, LEAST_REACH_SIGMAS, REACH_SIGMAS)
    is_clear = neighbour > CLEAR_SIGMAS * line_sigma_px
    sides, side_sigma = _sides(plane, ridge, sigma, is_clear, background_noise)
    noise = start_noise(background_noise)
    pick = np.arange(0, len(table), max(len(table) // NOISE_SAMPLE, 1))
    for _ in range(NOISE_ROUNDS):
        sample = np.zeros((len(pick), RESULT_COLUMNS))
        fit_profiles(
            plane.image,
            plane.clipped,
            table[pick],
            sigma[pick],
            sides[pick],
            noise,
            reach[pick],
            sample,
        )
        noise = estimate_noise(plane.image, table[pick], sides[pick], sample, noise)
    values = np.zeros((len(table), RESULT_COLUMNS))
    fit_profiles(plane.image, plane.clipped, table, sigma, sides, noise, reach, values)
    good = values[:, VARIANCE] > 0.0
    return ProfileFits(
        ridge.select(good), values[good], sides[good], side_sigma[good], neighbour[good], noise
    )


def _neighbours(
    plane: StripePlane, ridge: RidgePoints, line_sigma_px: float, shortest_px: float
) -> FloatArray:
    height, width = plane.image.shape
    length = chain_lengths_px(ridge.table[:, :2], ridge.chain)
    distance = np.zeros((len(ridge), 2))
    reach = max(CLEAR_SIGMAS * line_sigma_px, LEAST_REACH_PX)
    is_line = (length >= shortest_px).astype(np.int64)
    bounds = chain_bounds(ridge.chain)
    find_other_lines(ridge.table, ridge.chain, *bounds, is_line, height, width, reach, distance)
    return distance


def _sides(
    plane: StripePlane,
    ridge: RidgePoints,
    sigma: FloatArray,
    is_clear: BoolArray,
    background_noise: float,
) -> tuple[FloatArray, FloatArray]:
    """Background on both sides, averaged along the line, and the sigma of their difference.

    A side that another line lights up takes the value of the other side.
    """
    raw = np.zeros((len(ridge), 4))
    read_sides(plane.image, ridge.table, sigma, raw)
    level, count = raw[:, 0::2], raw[:, 1::2] * is_clear
    stretch = _axis_runs(ridge)
    places = np.minimum(np.subtract(*chain_bounds(stretch)[::-1]), 2 * SIDE_HALF + 1)
    total = np.stack([mean_along(np.ones(len(ridge)), c, stretch, SIDE_HALF) for c in count.T], 1)
    mean = np.stack(
        [mean_along(v, c, stretch, SIDE_HALF) for v, c in zip(level.T, count.T, strict=True)], 1
    )
    has_own = (total > 0.0) & is_clear
    lowest = np.where(raw[:, 1::2] > 0.0, level, np.inf).min(axis=1)
    lowest = np.where(np.isfinite(lowest), lowest, 0.0)[:, None]
    sides = np.where(has_own, mean, np.where(has_own[:, ::-1], mean[:, ::-1], lowest))
    pixels = np.where(has_own.all(axis=1), count.min(axis=1), 1.0) * places
    return sides, background_noise * np.sqrt(2.0 / np.maximum(pixels, 1.0))


def _axis_runs(ridge: RidgePoints) -> IntArray:
    """Number the stretches of a chain that keep the same axis, so that sides do not swap."""
    axis = ridge.table[:, 5]
    is_new = np.concatenate([[0], (np.diff(ridge.chain) != 0) | (np.diff(axis) != 0)])
    return np.cumsum(is_new).astype(np.int64)
