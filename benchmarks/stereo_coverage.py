# SPDX-License-Identifier: Apache-2.0
"""How often the stated covariance of a stereo calibration holds the truth (simulated features).

Command: ``python benchmarks/stereo_coverage.py [RUNS]`` (default 200; seeds 0 to RUNS - 1).

Each run projects a circle grid of 11 x 9 points, pitch 12 mm, into two cameras of 2048 x 1536 px
(f about 2300 px, all five distortion terms, baseline about 133 mm, axes 26 degrees apart) from 12
random places, adds Gaussian noise to each coordinate, and calibrates both cameras together with all
24 parameters free. The normalised error ``e' C^-1 e`` follows a chi-squared distribution of 24
degrees of freedom if the covariance is right: its mean over 24 is 1, and 95 % of the runs lie below
its 95 % point. In 200 runs a right covariance gives 182 to 197 of them (98.5 %).

Cases: *equal* noise of 0.05 px as the detector claims; *unequal*, 0.03 px left and 0.15 px right
while the detector claims 0.05 px of both; *target*, 0.05 px and a target whose points each miss
their places by 0.02 mm an axis, alike in all views.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy import stats

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoOptions
from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.cameras.stereo_result import StereoFit
from rigs.stereo_rig import StereoScene, make_pairs, normalised_stereo_error

N_PARAMETERS = 24
OPTIONS = StereoOptions(CameraOptions(distortion="k1k2p1p2k3", n_folds=0), n_folds=0)
CASES = {
    "equal": StereoScene(),
    "unequal": StereoScene(noise_px=(0.03, 0.15)),
    "target": StereoScene(missed_mm=0.02),
}


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    limit = float(stats.chi2.ppf(0.95, N_PARAMETERS))
    low, high = stats.binom.interval(0.985, runs, 0.95)
    print(__doc__.split("\n")[0])
    print(f"{runs} runs each, seeds 0 to {runs - 1}; expected inside: {low:.0f} to {high:.0f}")
    print(f"{'case':8s} {'failed':>6s} {'inside':>6s} {'mean / 24':>9s} {'95th / chi2':>11s}")
    for name, scene in CASES.items():
        errors = []
        for seed in range(runs):
            fit = calibrate_stereo(make_pairs(scene, seed)[0], scene.target, OPTIONS)
            found = isinstance(fit, StereoFit)
            errors.append(normalised_stereo_error(scene.views, fit) if found else np.inf)
        values = np.array(errors)
        known = values[np.isfinite(values)]
        print(
            f"{name:8s} {int(np.isinf(values).sum()):6d} {int((values < limit).sum()):6d} "
            f"{known.mean() / N_PARAMETERS:9.3f} {np.percentile(values, 95) / limit:11.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
