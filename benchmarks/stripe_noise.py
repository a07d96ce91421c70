# SPDX-License-Identifier: Apache-2.0
"""The noise model of a line's pixels against the noise that was drawn, and the sigmas it leads to.

Command: ``python benchmarks/stripe_noise.py [seeds]`` (default 4; three directions each).

A row is a line's sigma in px, contrast of the speckle, sigma of its grains in px, peak in grey
levels. *error* rms of the accepted centres across the line, *sigma* median of what is stated, *z*
rms of error over sigma; *at peak*, *0.3*, *0.1*: median over the images of the noise's variance as
it was found over that drawn, at these parts of the peak's level. Grains of speckle make
neighbouring pixels err alike: the variance found is then what a fit does not follow.
"""

from __future__ import annotations

import sys

import numpy as np

import armscan.vision.stripe.fit
from armscan.geometry.arrays import FloatArray
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.fit import estimate_noise
from rigs.stripe_image import StripeNoise, StripeScene
from rigs.stripe_scenes import line

ROWS = (
    (0.6, 0.1, 0.0, 150.0),
    (0.8, 0.05, 0.0, 150.0),
    (0.8, 0.2, 0.0, 150.0),
    (1.0, 0.2, 0.0, 150.0),
    (1.5, 0.2, 0.0, 150.0),
    (1.5, 0.2, 0.0, 30.0),
    (2.5, 0.05, 0.0, 150.0),
    (2.5, 0.2, 0.0, 150.0),
    (2.5, 0.2, 1.0, 150.0),
    (4.0, 0.2, 0.0, 150.0),
    (4.0, 0.3, 1.5, 150.0),
)
DIRECTIONS_DEG, LEVELS = (0.0, 8.0, 30.0), np.array([1.0, 0.3, 0.1])
FARTHEST_PX = 3.0


class Heard:
    """`estimate_noise`, and what it found last."""

    def __init__(self) -> None:
        self.terms: FloatArray = np.zeros(3)

    def __call__(
        self, pixels: FloatArray, n_pixels: int, peak: float, fallback: FloatArray
    ) -> FloatArray:
        self.terms = estimate_noise(pixels, n_pixels, peak, fallback)
        return self.terms


def row(line_of: tuple[float, float, float, float], seeds: int, heard: Heard) -> str:
    sigma, speckle, grain, peak = line_of
    errors, sigmas, ratios = [], [], []
    noise = StripeNoise(speckle=speckle, grain_px=grain)
    level = LEVELS * peak
    terms = np.stack([level**2, level, np.ones(len(level))])
    drawn = np.array([speckle**2, 1.0 / noise.electrons_per_level, noise.read**2 + 1.0 / 12.0])
    for direction in DIRECTIONS_DEG:
        scene = StripeScene((line(direction, sigma_px=sigma, peak=peak),), 480, 300, noise=noise)
        for seed in range(seeds):
            profile = extract_stripes(scene.expose(seed))
            good = profile.select(profile.is_accepted)
            error, _, _ = scene.errors(good.points_px)
            near = np.abs(error) < FARTHEST_PX
            errors.append(error[near])
            sigmas.append(good.sigma_px[near])
            ratios.append((heard.terms @ terms) / (drawn @ terms))
    error, stated = np.concatenate(errors), np.concatenate(sigmas)
    z = float(np.sqrt(np.mean((error / stated) ** 2)))
    found = " ".join(f"{one:7.2f}" for one in np.median(ratios, axis=0))
    return (
        f"{sigma:5.1f} {speckle:8.2f} {grain:6.1f} {peak:6.0f} {np.sqrt(np.mean(error**2)):8.4f} "
        f"{np.median(stated):8.4f} {z:6.2f}  {found}"
    )


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 4
    heard = Heard()
    armscan.vision.stripe.fit.estimate_noise = heard
    print("sigma  speckle  grain   peak    error    sigma      z  at peak     0.3     0.1")
    for one in ROWS:
        print(row(one, seeds, heard), flush=True)


if __name__ == "__main__":
    main()
