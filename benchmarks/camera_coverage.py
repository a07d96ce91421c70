# SPDX-License-Identifier: Apache-2.0
"""Joint 95 % region of the nine intrinsics over seeded runs at feature level.

Command: ``python benchmarks/camera_coverage.py [runs]`` (default 200; seeds 0 to runs - 1).

For each geometry the normalised error ``e' C^-1 e`` of all nine parameters is compared with the
chi-squared distribution: with a right covariance, 182 to 197 of 200 runs are inside the 95 % region
(99 % test), and the mean over runs is 9.
"""

from __future__ import annotations

import sys
import time

import cv2
import numpy as np
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.vision.targets.target import Chessboard, CircleGrid
from rigs.camera_scene import CAMERA, Scene, make_views, normalised_error
from rigs.plain_scanner import plain_camera

WIDE = plain_camera((533.0, 534.0), (342.0, 236.0), (640, 480), [-0.29, 0.11, 1e-3, 0.0, 0.0])
HEAD = plain_camera(
    (5150.0, 5152.0), (1540.0, 1020.0), (3072, 2048), [-0.08, 0.15, 2e-4, -3e-4, 0.0]
)
GEOMETRIES = {
    "12 views, 11x9 grid, 2048x1536, noise 0.05 px": Scene(),
    "12 views, noise 0.5 px": Scene(noise_px=0.5),
    "5 views, noise 0.05 px": Scene(n_views=5),
    "20 views, tilt up to 50 deg": Scene(n_views=20, max_tilt_deg=50.0),
    "wide lens, 9 views of a chessboard 9x6": Scene(
        camera=WIDE, target=Chessboard(9, 6, 25.0), n_views=9, distance_mm=400.0, noise_px=0.1
    ),
    "f 5150 px, 12 views of 11x9 at 3.75 mm": Scene(
        camera=HEAD, target=CircleGrid(11, 9, 3.75), distance_mm=140.0, noise_px=0.01, reach=0.15
    ),
    "12 views, target points off by 0.005 mm": Scene(missed_mm=0.005),
    "f 5150 px, target points off by 0.0003 mm": Scene(
        camera=HEAD,
        target=CircleGrid(11, 9, 3.75),
        distance_mm=140.0,
        noise_px=0.003,
        reach=0.15,
        n_views=15,
        max_tilt_deg=45.0,
        missed_mm=0.0003,
    ),
}


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    options = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)
    cv2.setNumThreads(1)
    low, high = stats.binom.ppf([0.005, 0.995], runs, 0.95)
    print(f"{runs} runs each, seeds 0 to {runs - 1}; inside must be {low:.0f} to {high:.0f}\n")
    print(f"{'geometry':48s} {'inside 95 %':>11s} {'mean (9)':>9s} {'s/run':>7s}")
    for name, scene in GEOMETRIES.items():
        truth = scene.camera.parameters
        errors = []
        start = time.perf_counter()
        for seed in range(runs):
            fit = calibrate_camera(make_views(scene, seed)[0], options)
            if isinstance(fit, CameraFit):
                errors.append(normalised_error(truth, fit.camera.parameters, fit.covariance))
        seconds = (time.perf_counter() - start) / runs
        inside = int(np.sum(np.array(errors) <= stats.chi2.ppf(0.95, 9)))
        refused = f"  ({runs - len(errors)} refused)" if len(errors) < runs else ""
        print(f"{name:48s} {inside:11d} {np.mean(errors):9.2f} {seconds:7.3f}{refused}")
    print(f"\nfirst geometry: truth {np.array2string(CAMERA.parameters, precision=4)}")


if __name__ == "__main__":
    main()
