# SPDX-License-Identifier: Apache-2.0
"""How residuals of a moving instrument scatter: each by itself, and slowly together.

White noise plus an Ornstein-Uhlenbeck process, its two sizes and its time found by restricted
maximum likelihood (Patterson and Thompson, Biometrika 58, 1971); and the scatter of a sum of scores
whatever their process, by Bartlett's weights (Newey and West, Econometrica 55, 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded, solveh_banded
from scipy.optimize import minimize

from armscan.geometry.arrays import FloatArray
from armscan.geometry.least_squares import robust_sigma


@dataclass(frozen=True, slots=True)
class ResidualNoise:
    """Scatter of one kind of residual: white, and one whose correlation fades in time (1/e)."""

    white_mm: float
    slow_mm: float
    fades_s: float


class NoiseCovariance:
    """Of residuals at times (K,) in s: ``C = white^2 I + slow^2 exp(-|dt| / fades)``.

    The slow part alone is a Markov process, its inverse Q tridiagonal, so that
    ``C^-1 = (I - (Q + I / white^2)^-1 / white^2) / white^2`` is applied in O(K).
    """

    def __init__(self, noise: ResidualNoise, seconds: FloatArray) -> None:
        self._white2 = noise.white_mm**2
        self._banded: FloatArray | None = None
        log_determinant = len(seconds) * float(np.log(self._white2))
        if noise.slow_mm > 0.0:
            follows = np.exp(-np.diff(seconds) / noise.fades_s)
            new = noise.slow_mm**2 * np.maximum(1.0 - follows**2, 1e-12)
            diagonal = np.full(len(seconds), 1.0 / self._white2)
            diagonal[0] += 1.0 / noise.slow_mm**2
            diagonal[1:] += 1.0 / new
            diagonal[:-1] += follows**2 / new
            self._banded = np.vstack([np.append(0.0, -follows / new), diagonal])
            pivots = cholesky_banded(self._banded)[1]
            log_determinant += 2.0 * float(np.log(pivots).sum())
            log_determinant += float(np.log(new).sum()) + 2.0 * float(np.log(noise.slow_mm))
        self._log_determinant = log_determinant

    @property
    def log_determinant(self) -> float:
        """Natural logarithm of C's determinant."""
        return self._log_determinant

    def solve(self, values: FloatArray) -> FloatArray:
        """``C^-1`` times values (K,) or (K, P)."""
        plain = values / self._white2
        if self._banded is None:
            return np.asarray(plain)
        return np.asarray(plain - solveh_banded(self._banded, plain) / self._white2)


def likeliest_noise(
    residuals: FloatArray, jacobian: FloatArray, seconds: FloatArray
) -> ResidualNoise:
    """Noise of residuals by restricted maximum likelihood.

    Parameters
    ----------
    residuals
        (K,) in mm, at or near the fit.
    jacobian
        (K, P) derivative by the parameters of that fit, in any units; columns may be zero.
    seconds
        (K,) times, increasing.
    """
    size = max(robust_sigma(residuals), 1e-9)
    scale = np.abs(jacobian).max(axis=0)
    columns = np.linalg.qr(jacobian[:, scale > 0.0] / scale[scale > 0.0])[0]
    step, span = float(np.median(np.diff(seconds))), float(seconds[-1] - seconds[0])

    def noise_of(logs: FloatArray) -> ResidualNoise:
        white, slow = np.exp(np.clip(logs[:2], -7.0, 3.0))
        return ResidualNoise(
            float(size * white), float(size * slow), float(np.clip(np.exp(logs[2]), step, span))
        )

    def misfit(logs: FloatArray) -> float:
        covariance = NoiseCovariance(noise_of(logs), seconds)
        weighed = covariance.solve(columns)
        normal = columns.T @ weighed
        left = residuals - columns @ np.linalg.solve(normal, weighed.T @ residuals)
        chi2 = float(left @ covariance.solve(left))
        return float(covariance.log_determinant + chi2 + np.linalg.slogdet(normal)[1])

    starts = [np.log([0.9, 0.3, 0.1 * span]), np.log([0.7, 0.7, 4.0 * step])]
    found = [
        minimize(
            misfit,
            np.asarray(start, dtype=np.float64),
            method="Nelder-Mead",
            options={"maxiter": 200, "xatol": 0.02, "fatol": 0.02},
        )
        for start in starts
    ]
    return noise_of(np.asarray(min(found, key=lambda one: float(one.fun)).x))


def score_sigma(scores: FloatArray, lag: int) -> float:
    """Standard deviation of the sum of scores (K,) that correlate over ``lag`` neighbours."""
    left = scores - scores.mean()
    variance = float(left @ left)
    for k in range(1, lag):
        variance += 2.0 * (1.0 - k / lag) * float(left[k:] @ left[:-k])
    return float(np.sqrt(max(variance, 0.0)))
