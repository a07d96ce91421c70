# SPDX-License-Identifier: Apache-2.0
"""How well each sheet explains each sample of a stripe, and which sheet wins along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.stripe_names import best_states
from armscan.reconstruction.stereo_options import StereoNamingOptions
from armscan.reconstruction.unbroken import Pieces, Samples

INDEPENDENT_SHARE = 0.5
"""Neighbouring samples of a stripe err together: each counts as this part of one."""
IMPOSSIBLE = -8.0
"""Score of a sheet that is out of depth at a sample."""
CHANGE_COST = 20.0
"""Against the sheet changing along an unbroken piece: once in a thousand million samples."""
CUT_COST = 3.0
"""Against it changing where the stripe is cut: once in twenty."""
LEAST_SCORE = 5.0
"""Least log-likelihood ratio to a stripe on no sheet that makes a name certain."""


def log_ratio(
    residual_px: FloatArray, sigma_px: FloatArray, spacing_px: float, seen_share: float
) -> FloatArray:
    """(H,) log-likelihood of a residual if the sheet is right, over that if it is wrong.

    If it is right, the right camera sees the stripe with probability ``seen_share``, and the
    residual is Gaussian; else, and if it is wrong, any right stripe may lie there: uniform, one in
    ``spacing_px``.
    """
    density = np.exp(-0.5 * (residual_px / sigma_px) ** 2) / (np.sqrt(2.0 * np.pi) * sigma_px)
    return np.asarray(np.log((1.0 - seen_share) + seen_share * spacing_px * density))


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Sheets along the stripes of one camera.

    Parameters
    ----------
    state
        (S,) sheet of each sample by itself and its stretch; -1 for none.
    is_sure
        (S,) True where the stretch's sheet is far ahead of any other.
    is_tied
        (S,) True where some sheet explains the stretch, but not far enough ahead of another.
    stretch
        (S,) number of the stretch, unbroken and of one sheet, counted from 0.
    """

    state: IntArray
    is_sure: BoolArray
    is_tied: BoolArray
    stretch: IntArray

    @property
    def name(self) -> IntArray:
        """(S,) the sheet where it is sure; -1 elsewhere."""
        return np.where(self.is_sure, self.state, -1)


def decide(
    scores: FloatArray,
    is_match: BoolArray,
    pieces: Pieces,
    samples: Samples,
    options: StereoNamingOptions,
) -> Verdict:
    """Most likely sequence of sheets along each stripe, and how sure each stretch of it is.

    Parameters
    ----------
    scores
        (S, K) log-likelihood ratio of each sheet at each sample.
    is_match
        (S, K) True where the sheet puts the sample on a stripe of the other camera.
    pieces, samples
        Of the camera's profile.
    options
        Limits.
    """
    n, n_sheets = scores.shape
    if n == 0:
        none = np.zeros(0, dtype=np.bool_)
        empty = np.zeros(0, dtype=np.int64)
        return Verdict(empty, none, none, empty)
    weighted = scores * (INDEPENDENT_SHARE * samples.weight)[:, None]
    table = np.concatenate([weighted, np.zeros((n, 1))], axis=1)
    piece, segment = pieces.piece[samples.at], pieces.segment[samples.at]
    cost = np.full(n, CHANGE_COST)
    cost[1:][np.diff(piece) != 0] = CUT_COST
    cost[0] = 0.0
    cost[1:][np.diff(segment) != 0] = 0.0
    state = np.zeros(n, dtype=np.int64)
    best_states(np.ascontiguousarray(table), cost, state)
    return _judge(state, weighted, is_match, piece, samples, options)


def _judge(
    state: IntArray,
    weighted: FloatArray,
    is_match: BoolArray,
    piece: IntArray,
    samples: Samples,
    options: StereoNamingOptions,
) -> Verdict:
    """A stretch is what has one state and is unbroken."""
    n, n_sheets = weighted.shape
    start = np.concatenate([[True], (np.diff(state) != 0) | (np.diff(piece) != 0)])
    first = np.flatnonzero(start)
    stretch = np.cumsum(start) - 1
    total = np.add.reduceat(weighted, first, axis=0)
    matches = np.add.reduceat(is_match * samples.weight[:, None], first, axis=0)
    own = state[first]
    rows = np.arange(len(first))
    has_sheet = own < n_sheets
    column = np.minimum(own, n_sheets - 1)
    best = np.where(has_sheet, total[rows, column], 0.0)
    others = total.copy()
    others[rows, column] = -np.inf
    second = others.max(axis=1) if n_sheets > 1 else np.zeros(len(first))
    enough = (matches[rows, column] >= options.least_matches) & (best >= LEAST_SCORE)
    sure = has_sheet & enough & (second <= options.runner_up * best)
    tied = ~sure & (np.where(has_sheet, best, total.max(axis=1)) > 0.0)
    state = np.where(state < n_sheets, state, -1)
    return Verdict(state, sure[stretch], tied[stretch], stretch)
