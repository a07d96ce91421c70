# SPDX-License-Identifier: Apache-2.0
"""Noise-weighted profile fits at ridge points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.kernels.stripe_fit import REACH_SIGMAS, VARIANCE, fit_profiles, read_sides
from armscan.vision.stripe.chains import chain_bounds, mean_along
from armscan.vision.stripe.noise import estimate_noise, start_noise
from armscan.vision.stripe.plane import StripePlane
from armscan.vision.stripe.ridge import RidgePoints

NOISE_SAMPLE = 1500
NOISE_ROUNDS = 2
SIDE_HALF = 8
"""Neighbours over which the background beside the line is averaged."""
RESULT_COLUMNS = 8


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
    noise
        (3,) ``C^2``, ``1 / gain``, ``read^2``.
    """

    ridge: RidgePoints
    values: FloatArray
    sides: FloatArray
    side_sigma: FloatArray
    noise: FloatArray


def axis_component(table: FloatArray) -> FloatArray:
    """(N,) size of the normal's component along the fitted column or row."""
    rows = np.arange(len(table))
    return np.abs(table[rows, 3 - table[:, 5].astype(np.int64)])


def fit_ridge(
    plane: StripePlane, ridge: RidgePoints, line_sigma_px: float, background_noise: float
) -> ProfileFits:
    """Fit a Gaussian with weights from the noise model at every ridge point.

    The noise model is estimated from a sample of the points first.
    """
    table = ridge.table
    sigma = line_sigma_px / np.maximum(axis_component(table), 0.5)
    sides, side_sigma = _sides(plane, ridge, sigma, background_noise)
    noise = start_noise(background_noise)
    pick = np.arange(0, len(table), max(len(table) // NOISE_SAMPLE, 1))
    for _ in range(NOISE_ROUNDS):
        sample = np.zeros((len(pick), RESULT_COLUMNS))
        fit_profiles(
            plane.image, plane.clipped, table[pick], sigma[pick], sides[pick], noise,
            REACH_SIGMAS, sample,
        )
        noise = estimate_noise(plane.image, table[pick], sides[pick], sample, noise)
    values = np.zeros((len(table), RESULT_COLUMNS))
    fit_profiles(
        plane.image, plane.clipped, table, sigma, sides, noise, REACH_SIGMAS, values
    )
    good = values[:, VARIANCE] > 0.0
    return ProfileFits(ridge.select(good), values[good], sides[good], side_sigma[good], noise)


def _sides(
    plane: StripePlane, ridge: RidgePoints, sigma: FloatArray, background_noise: float
) -> tuple[FloatArray, FloatArray]:
    raw = np.zeros((len(ridge), 4))
    read_sides(plane.image, ridge.table, sigma, raw)
    is_turned = _axis_runs(ridge)
    lower = mean_along(raw[:, 0], raw[:, 1], is_turned, SIDE_HALF)
    upper = mean_along(raw[:, 2], raw[:, 3], is_turned, SIDE_HALF)
    ones = np.ones(len(ridge))
    count = mean_along(np.minimum(raw[:, 1], raw[:, 3]), ones, is_turned, SIDE_HALF)
    first, stop = chain_bounds(is_turned)
    places = np.minimum(stop - first, 2 * SIDE_HALF + 1)
    has_lower, has_upper = count > 0, count > 0
    lower = np.where(has_lower | (lower != 0.0), lower, upper)
    upper = np.where(has_upper | (upper != 0.0), upper, lower)
    side_sigma = background_noise * np.sqrt(2.0 / np.maximum(count * places, 1.0))
    return np.stack([lower, upper], axis=1), side_sigma


def _axis_runs(ridge: RidgePoints) -> IntArray:
    """Number the stretches of a chain that keep the same axis, so that sides do not swap."""
    axis = ridge.table[:, 5]
    is_new = np.concatenate([[0], (np.diff(ridge.chain) != 0) | (np.diff(axis) != 0)])
    return np.cumsum(is_new).astype(np.int64)
