# SPDX-License-Identifier: Apache-2.0
"""A homography between two images of markers on a plane, by random samples (eqs. 4.28 to 4.30).

The print of eq. 4.29 has ``h13`` as the first coefficient of the left side; it is ``h31``, as in
eq. 4.30: both denominators are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure

SAMPLE = 4
"""Pairs that a homography needs: eight unknowns, two equations a pair."""
MAX_SAMPLES = 500
"""Samples tried where there are more than this many: with half of the pairs wrong, 500 samples
miss a pure one with a probability of 1e-14."""
MIN_TRIANGLE_SHARE = 0.01
"""Three points of a sample that span less than this share of the points' mean square spread are
taken for collinear."""
_REFITS = 5


@dataclass(frozen=True, slots=True, eq=False)
class HomographyConsensus:
    """A homography and the pairs that agree with it.

    Parameters
    ----------
    matrix
        (3, 3) H of eq. 4.28: ``(x', y', 1) ~ H (x, y, 1)``; scaled to norm 1.
    is_inlier
        (N,) True for the pairs that lie within the threshold.
    rms_px
        Root mean square distance of their right points from where H maps the left ones. Four
        pairs fit exactly: 0 says nothing then.
    """

    matrix: FloatArray
    is_inlier: BoolArray
    rms_px: float


def fit_homography(left_px: FloatArray, right_px: FloatArray) -> FloatArray | FitFailure:
    """Least-squares homography (eqs. 4.29 and 4.30, the denominators multiplied out).

    Both images are shifted to their mean and scaled to unit spread first, without which the
    equations are badly conditioned.

    Parameters
    ----------
    left_px, right_px
        (N, 2) points, row by row of one marker; N >= 4.

    Returns
    -------
    (3, 3) H, norm 1; or why there is none.
    """
    if len(left_px) < SAMPLE:
        return FitFailure(
            f"{len(left_px)} pairs, a homography needs {SAMPLE}",
            "show more markers to both cameras",
        )
    to_left, to_right = _normaliser(left_px), _normaliser(right_px)
    equations = _equations(_mapped(to_left, left_px), _mapped(to_right, right_px))
    _, singular, rows = np.linalg.svd(equations)
    if singular[7] < 1e-9 * singular[0]:
        return FitFailure(
            "the pairs determine no homography", "use markers that do not lie on one line"
        )
    matrix = np.linalg.inv(to_right) @ rows[-1].reshape(3, 3) @ to_left
    return np.asarray(matrix / np.linalg.norm(matrix))


def transfer_px(matrix: FloatArray, left_px: FloatArray) -> FloatArray:
    """Where H maps (N, 2) left points in the right image (eqs. 4.29 and 4.30)."""
    return _mapped(matrix, left_px)


def find_homography(
    left_px: FloatArray,
    right_px: FloatArray,
    threshold_px: float,
    *,
    min_inliers: int = SAMPLE + 1,
    seed: int = 0,
) -> HomographyConsensus | FitFailure:
    """Find the homography with which most pairs agree: the six steps of section 4.3.1.

    Parameters
    ----------
    left_px, right_px
        (N, 2) points, row by row of what may be one marker.
    threshold_px
        T: largest distance of a right point from where H maps its left one.
    min_inliers
        Fewest pairs that must agree; four always do.
    seed
        Of the random samples; all samples are tried where they are few.
    """
    n = len(left_px)
    if n < max(min_inliers, SAMPLE):
        return FitFailure(
            f"{n} pairs, {max(min_inliers, SAMPLE)} are needed", "show more markers to both cameras"
        )
    samples = _samples(n, seed)
    samples = samples[_is_spread(left_px, samples) & _is_spread(right_px, samples)]
    if not len(samples):
        return FitFailure("the pairs lie on one line", "place markers off that line too")
    counts = _count_inliers(left_px, right_px, samples, threshold_px)
    inlier = np.zeros(n, np.bool_)
    inlier[samples[int(counts.argmax())]] = True
    return _refined(left_px, right_px, inlier, threshold_px, min_inliers)


def _refined(
    left_px: FloatArray,
    right_px: FloatArray,
    inlier: BoolArray,
    threshold_px: float,
    min_inliers: int,
) -> HomographyConsensus | FitFailure:
    """Fit to all that agree, look again who agrees, until nothing changes (step 6)."""
    for _ in range(_REFITS):
        fitted = fit_homography(left_px[inlier], right_px[inlier])
        if isinstance(fitted, FitFailure):
            return fitted
        matrix = fitted
        distance = np.linalg.norm(transfer_px(matrix, left_px) - right_px, axis=1)
        before, inlier = inlier, np.asarray(distance <= threshold_px)
        count = int(inlier.sum())
        if count < max(min_inliers, SAMPLE):
            return FitFailure(
                f"{count} of {len(inlier)} pairs agree on a homography, {min_inliers} are needed",
                "the markers may not lie on a plane",
            )
        if np.array_equal(before, inlier):
            break
    rms = float(np.sqrt(np.mean(distance[inlier] ** 2)))
    return HomographyConsensus(matrix, inlier, rms)


def _samples(n: int, seed: int) -> IntArray:
    """Rows (S, 4) of pairs: all combinations where they are few, random ones otherwise."""
    if comb(n, SAMPLE) <= MAX_SAMPLES:
        return np.array(list(combinations(range(n), SAMPLE)), dtype=np.int64)
    rng = np.random.default_rng(seed)
    return np.asarray(rng.random((MAX_SAMPLES, n)).argsort(axis=1)[:, :SAMPLE])


def _is_spread(points_px: FloatArray, samples: IntArray) -> BoolArray:
    """(S,) True where no three of the four points are nearly collinear."""
    spread = float(points_px.var(axis=0).sum())
    found = np.ones(len(samples), np.bool_)
    for triple in combinations(range(SAMPLE), 3):
        a, b, c = (points_px[samples[:, k]] for k in triple)
        first, second = b - a, c - a
        area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        found &= area > MIN_TRIANGLE_SHARE * spread
    return found


def _count_inliers(
    left_px: FloatArray, right_px: FloatArray, samples: IntArray, threshold_px: float
) -> IntArray:
    to_left, to_right = _normaliser(left_px), _normaliser(right_px)
    left, right = _mapped(to_left, left_px), _mapped(to_right, right_px)
    threshold = threshold_px * to_right[0, 0]
    equations = _equations(left[samples], right[samples])
    # The last row of V' spans the null space of the eight equations.
    matrices = np.linalg.svd(equations)[2][:, -1].reshape(-1, 3, 3)
    own = np.concatenate([left, np.ones((len(left), 1))], axis=1)
    mapped = np.einsum("sij,nj->sni", matrices, own)
    weight = np.where(np.abs(mapped[..., 2:]) > 1e-12, mapped[..., 2:], 1e-12)
    distance = np.linalg.norm(mapped[..., :2] / weight - right, axis=2)
    return np.asarray((distance <= threshold).sum(axis=1))


def _equations(left: FloatArray, right: FloatArray) -> FloatArray:
    """Coefficients (..., 2 N, 9) of h11 ... h33 in eqs. 4.29 and 4.30."""
    x, y = left[..., 0], left[..., 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    plain = np.stack([x, y, one], axis=-1)
    none = np.stack([zero, zero, zero], axis=-1)
    in_x = np.concatenate([plain, none, -right[..., :1] * plain], axis=-1)
    in_y = np.concatenate([none, plain, -right[..., 1:] * plain], axis=-1)
    return np.concatenate([in_x, in_y], axis=-2)


def _normaliser(points_px: FloatArray) -> FloatArray:
    """Similarity (3, 3) that shifts points to their mean and scales them to unit spread."""
    mean = points_px.mean(axis=0)
    scale = 1.0 / max(float(np.sqrt(points_px.var(axis=0).sum())), 1e-12)
    return np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0, 0, 1.0]])


def _mapped(matrix: FloatArray, points: FloatArray) -> FloatArray:
    mapped = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
