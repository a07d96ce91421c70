# SPDX-License-Identifier: Apache-2.0
"""Smoothing along the line, with the sigma that correlated neighbours leave."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import MAD_TO_SIGMA
from armscan.kernels.stripe.smoothing import (
    COURSE_ROWS,
    LANES,
    SMOOTH_ROWS,
    WEIGHT,
    filter_residuals,
    lay_course,
    multiply_lagged,
    score_predictions,
    shift_points,
    smooth_lanes,
)

SMALLEST_WINDOW_PX = 3.2
WINDOW_RATIO = 1.6
CONFIDENCE = 2.2
LAGS = 6
WHITE = np.eye(LAGS)[0]
"""Covariances at distances 0, 1, ... of points that err on their own."""
SCATTER_HALVES = (30, 16, 8)
"""Wide windows show slow noise too, but need long chains."""
UNKNOWN_SCATTER_PX = 0.5
"""Assumed, and flagged, where chains are too short to show their scatter."""
SIGNIFICANT_CORRELATION = 2.5
BEND_WINDOWS_PX = np.array([7.5, 12.0, 19.0, 30.0])
LEAST_PAIRS = 200
LEAST_HALF = 8
OUTLIER_SIGMAS = 6.0
RESIDUAL_WIDENING = 1.5
"""A wider parabola takes less of the noise with it."""


@dataclass(frozen=True, slots=True, eq=False)
class Polyline:
    """Centres in the order of their chains.

    ``points``, ``normals``: (N, 2) image pixels and unit normals. ``sigma``: (N,) standard
    deviation along the normal as the fit predicts it. ``chain``: (N,) chain numbers. ``is_used``:
    (N,) False for points that must not pull their neighbours.
    """

    points: FloatArray
    normals: FloatArray
    sigma: FloatArray
    chain: IntArray
    is_used: BoolArray

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points)

    @property
    def rows(self) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, NDArray[np.uint8]]:
        """All of it, as kernels take it."""
        points, normals = (np.ascontiguousarray(one) for one in (self.points, self.normals))
        return points, normals, self.sigma, self.chain, self.is_used.view(np.uint8)


class Neighbourhoods:
    """The neighbours of each point of a polyline, in windows along its chain."""

    def __init__(
        self, course: Polyline, windows_px: FloatArray, asked: BoolArray | None = None
    ) -> None:
        """Lay the points out.

        ``windows_px``: (K,) half widths, increasing. ``asked``: (N,) points without which others
        tell nothing; the rest may be left out, and is then not smoothed. None for all.
        """
        n = len(course)
        self._windows = windows_px.astype(np.float32)
        n_blocks = -(-n // LANES) + 2
        self._laid = np.zeros((COURSE_ROWS, n_blocks * LANES))
        # weights up to 1, so that their products stay within single precision
        self._unit = float(course.sigma.min(initial=1.0)) ** 2
        lay_course(*course.rows, self._unit, self._laid)
        self._asked = np.ones(n_blocks, np.int64)
        if asked is not None:
            self._asked[:] = 0
            self._asked[np.flatnonzero(asked) // LANES + 1] = 1

    def leave_out(self, rows: IntArray) -> None:
        """Let points (M,) of the polyline count no longer."""
        self._laid[WEIGHT, LANES + rows] = 0.0

    def fit_parabolas(
        self, inflation: FloatArray, sigma: FloatArray, scale: float = 1.0
    ) -> NDArray[np.float32]:
        """Result (8, N) of `smooth_lanes`.

        ``inflation``: (K,). ``sigma``: (N,) of the points. ``scale``: Their variance over that by
        which the neighbours were weighted.
        """
        result = np.zeros((SMOOTH_ROWS, len(sigma)), np.float32)
        given = (self._laid, scale * self._unit, sigma, self._windows)
        smooth_lanes(*given, inflation.astype(np.float32), CONFIDENCE, self._asked, result)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedCentres:
    """Centres after smoothing.

    ``points``: (N, 2) image pixels. ``normals``: (N, 2) unit normals. ``sigma``: (N,) standard
    deviation along the normal. ``sigma_sum``: (N,) root of a point's share in the variance of a sum
    over its chain; a local quadratic has weights that sum to one, so that a sum over smoothed
    centres errs as that over raw ones does, however small the smoothed ones' own sigma is.
    ``is_outlier``: (N,) True where the raw centre disagrees with its neighbours' course.
    ``is_noise_measured``: False if the chains were too short to show their noise, so that the
    sigmas are those given.
    """

    points: FloatArray
    normals: FloatArray
    sigma: FloatArray
    sigma_sum: FloatArray
    is_outlier: BoolArray
    is_noise_measured: bool


@cache
def windows(largest_px: float) -> FloatArray:
    """Half windows from small to ``largest_px``, growing by a constant ratio."""
    steps = max(round(np.log(largest_px / SMALLEST_WINDOW_PX) / np.log(WINDOW_RATIO)), 0)
    half = np.geomspace(min(SMALLEST_WINDOW_PX, largest_px), largest_px, steps + 1)
    half.flags.writeable = False
    return half


def smooth(course: Polyline, largest_px: float) -> SmoothedCentres:
    """Smooth centres along their chains and give each its standard deviation.

    The noise of neighbours is measured from the residuals, not assumed: its size corrects the
    sigmas, and its correlation widens those of the smoothed centres.

    ``course``: The centres. ``largest_px``: Largest half window, `SMALLEST_WINDOW_PX` at least, as
    a parabola needs its points; 0 only measures the noise, in windows of twice that or more.
    """
    half = windows(max(largest_px, 2.0 * SMALLEST_WINDOW_PX))
    around = Neighbourhoods(course, half)
    rough = around.fit_parabolas(np.ones(len(half)), course.sigma)
    score = np.zeros(len(course))
    score_predictions(rough, course.sigma, score)
    scale = max(1.0, float(np.median(score)) / 0.6745) if len(score) else 1.0
    is_outlier = score > OUTLIER_SIGMAS * scale
    dropped = np.flatnonzero(is_outlier & course.is_used)
    if len(dropped):
        course = replace(course, is_used=course.is_used & ~is_outlier)
        around.leave_out(dropped)
    found = noise_correlation(course, half[-1])
    if 0.0 < largest_px < half[-1]:
        half = windows(max(largest_px, SMALLEST_WINDOW_PX))
        around = Neighbourhoods(course, half)
    is_measured = found is not None
    correlation = WHITE if found is None else found
    course = replace(course, sigma=course.sigma * np.sqrt(correlation[0]))
    alike = 1.0 + 2.0 * float(correlation[1:].sum()) / correlation[0]
    sigma_sum = course.sigma * np.sqrt(alike)
    if largest_px <= 0.0:
        return SmoothedCentres(
            course.points, course.normals, course.sigma, sigma_sum, is_outlier, is_measured
        )
    inflation = np.array([inflation_of(correlation, h) for h in half])
    result = around.fit_parabolas(inflation, course.sigma, float(correlation[0]))
    points, normals, sigma, _, is_used = course.rows
    moved, turned = np.zeros(points.shape), np.zeros(points.shape)
    shift_points(points, normals, is_used, result, moved, turned, sigma)
    return SmoothedCentres(moved, turned, sigma, sigma_sum, is_outlier, is_measured)


def bends(course: Polyline, asked: BoolArray) -> NDArray[np.float32]:
    """Result (8, N) of `smooth_lanes` in windows as curvature needs them.

    ``asked``: (N,) points where it matters; elsewhere it may be 0.
    """
    around = Neighbourhoods(course, BEND_WINDOWS_PX, asked)
    return around.fit_parabolas(np.ones(len(BEND_WINDOWS_PX)), course.sigma)


@cache
def quadratic_weights(half: int) -> FloatArray:
    """Weights (2 half + 1,) of a uniform local quadratic at its centre."""
    k = np.arange(-half, half + 1, dtype=np.float64)
    design = np.stack([np.ones_like(k), k, k * k], axis=1)
    weights = np.ascontiguousarray(np.linalg.pinv(design)[0])
    weights.flags.writeable = False
    return weights


def inflation_of(correlation: FloatArray, half_px: float) -> float:
    """Variance of a uniform local quadratic's centre, divided by its value for white noise."""
    overlap = _overlap(max(int(half_px), 2))
    shape = correlation[: len(overlap)] / correlation[0]
    return max(float((overlap * shape).sum() / overlap[0]), 0.3)


@cache
def _overlap(half: int) -> FloatArray:
    """Sums (<= LAGS,) of products of a quadratic's weights at each distance, to both sides."""
    weights = quadratic_weights(half)
    overlap = np.correlate(weights, weights, "full")[len(weights) - 1 :][:LAGS]
    overlap[1:] *= 2.0
    overlap.flags.writeable = False
    return overlap


def scatter(points: FloatArray, normals: FloatArray, chain: IntArray) -> float | None:
    """Standard deviation of the points across a smooth course of their own, in px.

    None where the chains are too short to show it.
    """
    n = len(points)
    course = Polyline(points, normals, np.ones(n), chain, np.ones(n, dtype=np.bool_))
    for half in SCATTER_HALVES:
        residual = _filter_residuals(course, half)
        if np.isfinite(residual).sum() >= LEAST_PAIRS:
            share = 1.0 - quadratic_weights(half)[half]
            return float(np.sqrt(np.nanmean(residual**2) / share))
    return None


def noise_correlation(course: Polyline, half_px: float) -> FloatArray | None:
    """Covariance (LAGS,) of normalised raw centres at distances 0, 1, ... along the chain.

    Measured on the residuals from a local quadratic; as the quadratic takes part of the noise with
    it, the measured covariances are a known linear mixture of the true ones, which is inverted.
    Without a significant correlation of nearest neighbours the noise is taken as white. None where
    the chains are too short to tell.
    """
    half = max(int(RESIDUAL_WIDENING * half_px), LEAST_HALF)
    residual = _filter_residuals(course, half)
    measured = _lag_products(residual, course.chain)
    while measured is None and half > LEAST_HALF:
        # A line that is often interrupted, as by the marks of a board, has no room for more.
        half = max(int(half / WINDOW_RATIO), LEAST_HALF)
        residual = _filter_residuals(course, half)
        measured = _lag_products(residual, course.chain)
    if measured is None:
        return None
    mixture = _mixture(half)
    scale = max(measured[0] / mixture[0, 0], 0.05)
    surplus = measured[1:] - scale * mixture[1:, 0]
    limit = SIGNIFICANT_CORRELATION * scale / np.sqrt(np.isfinite(residual).sum())
    if (surplus[:2] < limit).all():
        return np.asarray(scale * WHITE)
    solved, _ = nnls(mixture, measured)
    solved[0] = max(solved[0], 0.05)
    return np.asarray(solved)


@cache
def _mixture(half: int) -> FloatArray:
    """(LAGS, LAGS) by which covariances of residuals are mixed of those of the noise."""
    kernel = -quadratic_weights(half)
    kernel[half] += 1.0
    autocorrelation = np.correlate(kernel, kernel, "full")
    middle = len(autocorrelation) // 2
    mixture = np.zeros((LAGS, LAGS))
    for lag in range(LAGS):
        for m in range(LAGS):
            for signed in {m, -m}:
                at = middle + lag - signed
                if 0 <= at < len(autocorrelation):
                    mixture[lag, m] += autocorrelation[at]
    mixture.flags.writeable = False
    return mixture


def _lag_products(residual: FloatArray, chain: IntArray) -> FloatArray | None:
    """Mean product (LAGS,) of residuals at each distance; None where there are too few pairs."""
    measured, total = np.zeros(LAGS), np.zeros(2)
    for lag in range(LAGS):
        multiply_lagged(residual, chain, min(lag, len(residual)), total)
        if total[1] < LEAST_PAIRS:
            return None
        measured[lag] = total[0] / total[1]
    return measured


def _filter_residuals(course: Polyline, half: int) -> FloatArray:
    """Residuals over sigma from a uniform quadratic over 2 half + 1 places; NaN near ends."""
    residual, told = np.zeros(len(course)), np.zeros(len(course))
    count = filter_residuals(*course.rows, quadratic_weights(half), residual, told)
    limit = 5.0 * max(float(np.median(told[:count])), 0.3) if count else 0.0
    residual[np.abs(residual) > limit * MAD_TO_SIGMA] = np.nan
    return residual
