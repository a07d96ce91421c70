# SPDX-License-Identifier: Apache-2.0
"""The stripes' own scatter: level and correlation, whatever the smooth misfit."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.calibration.sheets.model import scatter_by_stripe, stripe_noise
from armscan.calibration.sheets.solve import SheetObservations
from armscan.geometry.arrays import FloatArray

N_STRIPES, N_POINTS = 8, 300
SIGMA_PX = 0.05


def straight_observations(n_points: int = N_POINTS) -> SheetObservations:
    n = N_STRIPES * n_points
    stripe: NDArray[np.int64] = np.repeat(np.arange(N_STRIPES), n_points)
    points = np.zeros((n, 3))
    points[:, 0] = np.tile(np.linspace(-20.0, 20.0, n_points), N_STRIPES)
    points[:, 2] = 130.0 + stripe
    return SheetObservations(
        image=stripe,
        row=np.tile(np.arange(n_points), N_STRIPES),
        board=stripe,
        sheet=np.zeros(n, dtype=np.int64),
        stripe=stripe,
        points_mm=points,
        across_mm_px=np.tile([0.0, 0.03, 0.0], (n, 1)),
        sigma_px=np.full(n, SIGMA_PX),
        dpoint_dpose=np.zeros((n, 3, 6)),
        dpoint_dcamera=np.zeros((n, 3, 9)),
    )


def moving_average(length: int, sigma: float, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    rows = [
        np.convolve(rng.normal(0.0, sigma, N_POINTS + length - 1), np.ones(length), "valid")
        for _ in range(N_STRIPES)
    ]
    return np.concatenate(rows) / np.sqrt(length)


@pytest.mark.parametrize("true_factor", [0.5, 1.0, 3.0])
def test_level_of_white_noise(true_factor: float) -> None:
    """2400 points: the level is known to 1 / sqrt(2 * 2400) = 1.4 %; four sigma allowed."""
    noise = stripe_noise(straight_observations(), moving_average(1, true_factor * SIGMA_PX, 1))
    assert abs(noise.factor / true_factor - 1.0) < 4.0 / np.sqrt(2 * 2368)
    assert noise.correlation_points < 1.15
    taken = 4 * N_STRIPES * noise.correlation_points
    np.testing.assert_allclose(noise.degrees_of_freedom, N_STRIPES * N_POINTS - taken)


@pytest.mark.parametrize("length", [3, 9])
def test_a_moving_average_counts_as_its_length(length: int) -> None:
    """For a moving average 1 + 2 sum of the correlations is its length, by hand."""
    noise = stripe_noise(straight_observations(), moving_average(length, SIGMA_PX, 2))
    assert 0.87 * length < noise.correlation_points < 1.15 * length
    assert abs(noise.factor - 1.0) < 4.0 * np.sqrt(length / (2.0 * N_STRIPES * N_POINTS))
    np.testing.assert_allclose(
        noise.sigma_factor, noise.factor * np.sqrt(noise.correlation_points), rtol=1e-12
    )


def test_a_cubic_misfit_is_no_noise() -> None:
    """Each stripe bent by its own cubic of 100 sigma: the noise stays what it is."""
    observations = straight_observations()
    white = moving_average(1, SIGMA_PX, 3)
    t = observations.points_mm[:, 0] / 20.0
    bend = (1.0 + observations.stripe) * (t**3 - 2.0 * t**2 + 0.5)
    plain, bent = (stripe_noise(observations, white + extra) for extra in (0.0, bend))
    np.testing.assert_allclose(bent.factor, plain.factor, rtol=1e-9)


def test_scatter_of_each_stripe_over_its_claim() -> None:
    """A median over 300 points knows the scatter to 1.17 / sqrt(600) = 4.8 %; four sigma."""
    true = np.repeat(np.linspace(0.3, 4.0, N_STRIPES), N_POINTS)
    residual = true * moving_average(1, SIGMA_PX, 4)
    found = scatter_by_stripe(straight_observations(), residual)
    np.testing.assert_allclose(found, true, rtol=4.0 * 0.048)
    assert len(np.unique(found)) == N_STRIPES


FEW_POINTS = 40
MEDIAN_OF_FEW = 1.17 / np.sqrt(FEW_POINTS - 4)
"""Standard deviation of the logarithm of a scatter by the median, a cubic being taken off."""


def test_stripes_of_few_points_that_scatter_alike_weigh_alike() -> None:
    """Weights that vary by a share c cost c^2 of the information, which no sigma then tells.

    By the median of 40 points alone they would vary by 2 x 0.195, and cost 15 %.
    """
    rng, observations = np.random.default_rng(5), straight_observations(FEW_POINTS)
    lost = []
    for _ in range(40):
        found = scatter_by_stripe(observations, rng.normal(0.0, SIGMA_PX, len(observations)))
        weight = found[::FEW_POINTS] ** -2.0
        lost.append(np.var(weight) / weight.mean() ** 2)
    assert np.mean(lost) < 0.2 * (2.0 * MEDIAN_OF_FEW) ** 2


def test_stripes_of_few_points_that_scatter_otherwise_weigh_otherwise() -> None:
    """From 0.3 to 4 times the claim: as large as what medians err by hides nothing of it."""
    true = np.repeat(np.geomspace(0.3, 4.0, N_STRIPES), FEW_POINTS)
    rng, observations = np.random.default_rng(6), straight_observations(FEW_POINTS)
    errors = []
    for _ in range(40):
        residual = true * rng.normal(0.0, SIGMA_PX, len(observations))
        ratio = np.log(scatter_by_stripe(observations, residual) / true)
        errors.append(ratio[::FEW_POINTS])
    spread = np.array(errors).std(axis=0)
    assert spread.max() < 1.3 * MEDIAN_OF_FEW
    # A cubic takes four of forty points, a median of few is low: what all have in common.
    assert np.abs(np.mean(errors, axis=0) - np.mean(errors)).max() < 0.5 * MEDIAN_OF_FEW


def test_a_stripe_of_no_more_points_than_its_course_has_terms_tells_nothing() -> None:
    """Its residuals are rounding: beside it the others keep what they have, and it takes theirs."""
    observations = straight_observations(FEW_POINTS)
    residual = np.random.default_rng(7).normal(0.0, SIGMA_PX, len(observations))
    with_short = observations.select(np.arange(len(observations) - FEW_POINTS + 4))
    found = scatter_by_stripe(with_short, residual[: len(with_short)])
    alone = scatter_by_stripe(with_short.select(slice(0, -4)), residual[: len(with_short) - 4])
    np.testing.assert_allclose(found[:-4], alone, rtol=1e-12)
    assert alone.min() <= found[-1] <= alone.max()
