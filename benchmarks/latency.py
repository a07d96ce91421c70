# SPDX-License-Identifier: Apache-2.0
"""How well the latency of camera and arm is found, and whether its sigma tells (feature level).

Draws arms, rates, noise, motions and heads at random; every draw is a calibration of its own:

    python benchmarks/latency.py --draws 200 --seed 1

prints how often the 95 % region holds the truth (182-197 of 200 is what a right sigma gives), and
the sigma of 10 s at 30 mm/s rms with an arm of 0.02 mm. Simulated; about 0.5 s a draw.
"""

from __future__ import annotations

import argparse

import numpy as np

from armscan.calibration.latency import calibrate_latency
from armscan.geometry.estimate import FitFailure
from rigs.latency import LatencyCase, draw


def drawn_case(seed: int) -> LatencyCase:
    """Any arm, rate, noise and motion; every fourth has clocks of its own."""
    rng = np.random.default_rng([seed, 99])
    is_separate = seed % 4 == 0
    return LatencyCase(
        seconds=float(rng.uniform(8.0, 15.0)),
        camera_hz=float(rng.choice([30.0, 60.0, 80.0, 120.0])),
        arm_hz=float(rng.choice([80.0, 125.0, 240.0, 500.0, 1000.0])),
        speed_mm_s=float(rng.uniform(15.0, 50.0)),
        aside_mm_s=float(rng.uniform(5.0, 25.0)),
        rocking_deg=float(rng.uniform(0.0, 6.0)),
        reversing_hz=float(rng.uniform(0.5, 1.6)),
        arm_mm=float(10.0 ** rng.uniform(-2.7, -1.6)),
        arm_turn_rad=float(10.0 ** rng.uniform(-5.0, -4.0)),
        waves_mm=float(10.0 ** rng.uniform(-3.0, -1.5)),
        flatness_mm=float(10.0 ** rng.uniform(-3.0, -1.8)),
        hand_eye_mm=float(rng.uniform(0.0, 0.1)),
        scale=2e-4 * float(rng.normal()),
        latency_ns=int(rng.uniform(-1e8, 1e8)),
        n_sheets=int(rng.choice([1, 1, 3])),
        outliers=float(rng.choice([0.0, 0.0, 0.03])),
        drift=float(rng.uniform(-2e-4, 2e-4)) if is_separate else 0.0,
        separate_ns=int(rng.integers(10**15)) if is_separate else 0,
    )


def study(cases: list[tuple[int, LatencyCase]]) -> None:
    """Print coverage and sigma of these draws."""
    ratios, drifts, sigmas, refused = [], [], [], []
    for seed, case in cases:
        looks, arm, hand_eye, truth = draw(case, seed)
        fit = calibrate_latency(looks, arm, hand_eye, is_shared=case.separate_ns == 0)
        if isinstance(fit, FitFailure):
            refused.append(f"{seed}: {fit.reason}")
            continue
        ratios.append((fit.latency_ns - truth) / fit.sigma_ns)
        drifts.append((fit.drift - case.drift) / fit.sigma_drift)
        sigmas.append(1e-3 * fit.sigma_ns)
    inside = int((np.abs(ratios) < 1.96).sum())
    of_drift = int((np.abs(drifts) < 1.96).sum())
    q = np.quantile(sigmas, [0.05, 0.5, 0.95])
    print(f"  95 % region of the latency holds the truth {inside} of {len(ratios)} times")
    print(f"  that of the drift {of_drift} of {len(drifts)} times")
    print(f"  rms error over sigma {np.sqrt(np.mean(np.square(ratios))):.2f}")
    print(f"  sigma 5 %, median, 95 %: {q[0]:.1f}, {q[1]:.1f}, {q[2]:.1f} us")
    print(f"  refused {len(refused)}", *refused, sep="\n  ")


def main() -> None:
    """Run the two studies."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--usual", type=int, default=20, help="draws of 10 s at 30 mm/s")
    options = parser.parse_args()
    seeds = range(1000 * options.seed, 1000 * options.seed + options.draws)
    print(f"any instrument, {options.draws} draws from seed {options.seed}")
    study([(seed, drawn_case(seed)) for seed in seeds])
    print("10 s at 30 mm/s rms, 80 exposures and 240 samples a second, arm of 0.02 mm (2 sigma)")
    study([(10**6 + k, LatencyCase()) for k in range(options.usual)])


if __name__ == "__main__":
    main()
