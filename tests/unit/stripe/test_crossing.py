# SPDX-License-Identifier: Apache-2.0
"""Two rendered lines that cross as those of the cross-line head do: what is dropped, what right."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.vision.stripe.extract import extract_stripes
from rigs.stripe_image import (
    NO_NOISE,
    SimulatedStripe,
    StraightCurve,
    StripeNoise,
    StripeScene,
)

ANGLES_DEG = (-50.0, 55.0)
SIGMA_PX = 3.0
BIAS_PX = 0.02


def pulled(noise: StripeNoise, seed: int) -> tuple[FloatArray, FloatArray]:
    """(N,) distance of accepted points from the other line, and how far they err towards it."""
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
    middle = np.array([200.0, 150.0]) + shift
    stripes = tuple(
        SimulatedStripe(StraightCurve(*[*middle, angle]), sigma_px=SIGMA_PX) for angle in ANGLES_DEG
    )
    profile = extract_stripes(StripeScene(stripes, noise=noise).expose(seed))
    points = profile.points_px[profile.is_accepted]
    distance = np.stack([stripe.curve.locate(points)[0] for stripe in stripes], axis=1)
    own = np.abs(distance).argmin(axis=1)
    rows = np.arange(len(points))
    angle = np.radians(ANGLES_DEG)
    normals = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    side = np.sign(distance[rows, 1 - own] * (normals[own] * normals[1 - own]).sum(axis=1))
    return np.abs(distance[rows, 1 - own]), -side * distance[rows, own]


def test_what_is_kept_beside_a_crossing_is_not_pulled_towards_it() -> None:
    apart, towards = pulled(NO_NOISE, 1)
    assert apart.min() > 4.0 * SIGMA_PX
    assert np.abs(towards).max() < BIAS_PX


def test_nor_with_speckle() -> None:
    found = [pulled(StripeNoise(), seed) for seed in range(5)]
    apart, towards = (np.concatenate(part) for part in zip(*found, strict=True))
    for low, high in ((4.0, 7.0), (7.0, 10.0)):
        near = towards[(apart > low * SIGMA_PX) & (apart < high * SIGMA_PX)]
        # some ten neighbours are smoothed together: as many fewer are independent
        error = near.std() / np.sqrt(len(near) / 10.0)
        assert abs(near.mean()) < BIAS_PX + 2.0 * error
    assert float((apart < 4.0 * SIGMA_PX).mean()) < 0.002


def test_without_the_flag_there_would_be_a_pull() -> None:
    """The same profile's rejected points show what is dropped."""
    middle = (200.3, 150.2)
    stripes = tuple(SimulatedStripe(StraightCurve(*[*middle, angle])) for angle in ANGLES_DEG)
    profile = extract_stripes(StripeScene(stripes, noise=NO_NOISE).expose(1))
    dropped = profile.points_px[~profile.is_accepted]
    nearest = np.min([np.abs(stripe.curve.locate(dropped)[0]) for stripe in stripes], axis=0)
    assert nearest.max() > 10.0 * BIAS_PX
    assert np.hypot(*(dropped - middle).T).max() == pytest.approx(20.0, abs=8.0)
