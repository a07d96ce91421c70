# SPDX-License-Identifier: Apache-2.0
"""What is doubtful about each stripe point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.stripe_fit import AMPLITUDE, SKEW, SKEW_NORM
from armscan.vision.stripe.chains import chain_bounds, chain_lengths_px, sum_along
from armscan.vision.stripe.profile_fit import ProfileFits

SIGNIFICANT = 5.0
MERGED_SIGMAS = 20.0
"""Where two lines cross at a small angle they run as one over about this many sigmas."""
SKEW_HALF = 4
LEAST_SKEW = 0.1
"""Smallest third-order part of a profile that counts as leaning."""
SKEW_PX = 0.3
"""The part in px that counts on narrow lines, which few pixels describe."""


def is_background_step(fits: ProfileFits, least_share: float) -> BoolArray:
    """(N,) True where the two sides differ enough to move the centre.

    A step of height d beside a line of amplitude A and sigma s moves every method by about s d / A.

    Parameters
    ----------
    fits
        Fitted profiles.
    least_share
        Smallest step that matters, as a share of the line's amplitude.
    """
    step = np.abs(fits.sides[:, 1] - fits.sides[:, 0])
    is_certain = step > SIGNIFICANT * fits.side_sigma
    return np.asarray(is_certain & (step > least_share * fits.values[:, AMPLITUDE]))


def is_asymmetric(fits: ProfileFits, width_px: FloatArray) -> BoolArray:
    """(N,) True where the profile's third-order part is certain and moves the centre.

    The part is ``c m (u^3 - 3 u)`` beside the Gaussian ``m``; it moves the centre by about 0.6 c
    sigmas.

    Parameters
    ----------
    fits
        Fitted profiles.
    width_px
        (N,) sigma of the line.
    """
    both = np.stack([fits.values[:, SKEW], fits.values[:, SKEW_NORM]], axis=1)
    total = sum_along(both, fits.ridge.chain, SKEW_HALF)
    norm = np.maximum(total[:, 1], 1e-12)
    size = np.abs(total[:, 0]) / norm
    limit = np.maximum(LEAST_SKEW, SKEW_PX / width_px)
    return np.asarray((size * np.sqrt(norm) > SIGNIFICANT) & (size > limit))


def is_saturated(points: FloatArray, saturated: NDArray[np.uint8]) -> BoolArray:
    """(N,) True where one of the 3 x 3 pixels around a point (N, 2) is clipped."""
    found = np.zeros(len(points), dtype=np.bool_)
    if saturated.size == 1:
        return found
    height, width = saturated.shape
    x, y = np.rint(points).astype(np.int64).T
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            found |= saturated[np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)] > 0
    return found


def is_near_other_line(
    distance: FloatArray, chain: IntArray, width_px: FloatArray, sigmas: float
) -> BoolArray:
    """(N,) True where another line is within ``sigmas`` widths, and where two lines have merged.

    Parameters
    ----------
    distance
        (N, 2) to the nearest other line on both sides.
    chain
        (N,) chain numbers.
    width_px
        (N,) sigma of the line.
    sigmas
        Distance that matters.
    """
    near = np.asarray(distance.min(axis=1) < sigmas * width_px)
    if not near.any():
        return near
    return close_gaps(near, chain, MERGED_SIGMAS * width_px)


def close_gaps(flags: BoolArray, chain: IntArray, span: FloatArray) -> BoolArray:
    """Set also the points between two flagged ones of a chain that are within ``span`` (N,)."""
    place = np.arange(len(flags))
    first, stop = chain_bounds(chain)
    before = np.maximum.accumulate(np.where(flags, place, -1))
    after = np.minimum.accumulate(np.where(flags, place, len(flags))[::-1])[::-1]
    is_between = (before >= first) & (after < stop)
    return np.asarray(flags | (is_between & (after - before <= span)))


def is_short(points: FloatArray, chain: IntArray, shortest_px: float) -> BoolArray:
    """(N,) True where the point's chain is shorter than ``shortest_px``."""
    return np.asarray(chain_lengths_px(points, chain) < shortest_px)
