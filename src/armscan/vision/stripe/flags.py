# SPDX-License-Identifier: Apache-2.0
"""What is doubtful about each stripe point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.stripe_fit import AMPLITUDE, SKEW, SKEW_NORM
from armscan.vision.stripe.chains import chain_lengths_px, sum_along
from armscan.vision.stripe.profile_fit import ProfileFits

SIGNIFICANT = 5.0
SKEW_HALF = 4
SKEW_SHIFT = 0.3
"""Third-order part of a profile, as a share of its amplitude, that counts as leaning."""


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


def is_asymmetric(fits: ProfileFits) -> BoolArray:
    """(N,) True where the profile's third-order part is certain and large."""
    both = np.stack([fits.values[:, SKEW], fits.values[:, SKEW_NORM]], axis=1)
    total = sum_along(both, fits.ridge.chain, SKEW_HALF)
    norm = np.maximum(total[:, 1], 1e-12)
    size = np.abs(total[:, 0]) / norm
    return np.asarray((size * np.sqrt(norm) > SIGNIFICANT) & (size > SKEW_SHIFT))


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
    points: FloatArray, chain: IntArray, width_px: FloatArray, sigmas: float
) -> BoolArray:
    """(N,) True where another line, or another part of the same, is within ``sigmas`` widths.

    Along its own chain a point may only be as near as the number of points between allows.
    """
    near = np.zeros(len(points), dtype=np.bool_)
    if len(points) < 2 or sigmas <= 0.0:
        return near
    reach = sigmas * float(np.quantile(width_px, 0.9))
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    own = (chain[i] == chain[j]) & (np.abs(i - j) <= 3.0 * reach + 3.0)
    i, j = i[~own], j[~own]
    distance = np.hypot(*(points[i] - points[j]).T)
    close = distance < sigmas * np.maximum(width_px[i], width_px[j])
    near[i[close]] = True
    near[j[close]] = True
    return near


def is_short(points: FloatArray, chain: IntArray, shortest_px: float) -> BoolArray:
    """(N,) True where the point's chain is shorter than ``shortest_px``."""
    return np.asarray(chain_lengths_px(points, chain) < shortest_px)
