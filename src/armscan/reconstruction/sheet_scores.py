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
        (S,) most likely sheet of each sample's piece.
    is_sure
        (S,) True where it is far ahead of any other.
    is_tied
        (S,) True where some sheet explains the sample, but not far enough ahead of another.
    piece
        (S,) number of the piece, counted from 0.
    is_candidate
        (pieces, K) True for sheets that explain a piece nearly as well as the best one.
    """

    state: IntArray
    is_sure: BoolArray
    is_tied: BoolArray
    piece: IntArray
    is_candidate: BoolArray

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
    """Most likely sheet of each unbroken piece, and how sure it is.

    A piece is one line of light, so it has one sheet. Where along it another sheet is far more
    likely, the other camera may see another stripe there by chance, or two lines may have been
    linked unnoticed: such samples are ambiguous.

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
        return Verdict(empty, none, none, empty, np.zeros((0, n_sheets), dtype=np.bool_))
    weighted = scores * (INDEPENDENT_SHARE * samples.weight)[:, None]
    piece = pieces.piece[samples.at]
    is_first = np.concatenate([[True], np.diff(piece) != 0])
    first, number = np.flatnonzero(is_first), np.cumsum(is_first) - 1
    total = np.add.reduceat(weighted, first, axis=0)
    matches = np.add.reduceat(is_match * samples.weight[:, None], first, axis=0)
    rows, winner = np.arange(len(first)), total.argmax(axis=1)
    best = total[rows, winner]
    others = total.copy()
    others[rows, winner] = 0.0
    is_candidate = (total > options.runner_up * best[:, None]) & (total >= LEAST_SCORE)
    is_ahead = others.max(axis=1) <= options.runner_up * best
    is_sure = is_ahead & (best >= LEAST_SCORE) & (matches[rows, winner] >= options.least_matches)
    state, path = winner[number], _path(weighted, is_first)
    is_other = (path < n_sheets) & (path != state)
    is_tied = ~is_sure & (best > 0.0)
    return Verdict(
        state, is_sure[number] & ~is_other, is_tied[number] | is_other, number, is_candidate
    )


def _path(weighted: FloatArray, is_first: BoolArray) -> IntArray:
    """(S,) most likely sheet of each sample if it may change along a piece; K for none."""
    table = np.concatenate([weighted, np.zeros((len(weighted), 1))], axis=1)
    cost = np.where(is_first, 0.0, CHANGE_COST)
    path = np.zeros(len(weighted), dtype=np.int64)
    best_states(np.ascontiguousarray(table), cost, path)
    return path
