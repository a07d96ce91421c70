# SPDX-License-Identifier: Apache-2.0
"""Time of stripe extraction against the usual ways to compute a Steger ridge, in one run.

Command: ``python benchmarks/stripe_speed.py [repeats]`` (default 15). One thread, processor time.
Trust the ratios: times on a shared machine vary. Images: 11 nearly horizontal lines at 2658 x 800
and one line at 3072 x 2048, line sigma 3, peak 150, speckle 0.2, seed 0. scikit-image is used if it
is installed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from importlib.util import find_spec

import cv2
import numpy as np

from armscan.kernels.ridge import gaussian_taps
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions, mono_plane
from armscan.vision.stripe.ridge import find_candidates, measure_level, trace_ridges
from rigs.stripe_image import SimulatedStripe, StripeScene, WaveCurve

SIGMA_PX = 3.0


def lines(n: int, width: int, height: int) -> Exposure:
    gap = height / (n + 1.0)
    waves = tuple(
        SimulatedStripe(WaveCurve(0.0, gap * (k + 1), 0.3, 10.0, 700.0), sigma_px=SIGMA_PX)
        for k in range(n)
    )
    return StripeScene(waves, width, height).expose(0)


def opencv_steger(image: np.ndarray) -> int:
    """Full-image derivatives by OpenCV, eigenvalues and Newton step in numpy."""
    g0, g1, g2 = gaussian_taps(SIGMA_PX)
    grey = image.astype(np.float32)
    gx, gy, gxx, gxy, gyy = (
        cv2.sepFilter2D(grey, cv2.CV_32F, a, b)
        for a, b in ((g1, g0), (g0, g1), (g2, g0), (g1, g1), (g0, g2))
    )
    half = 0.5 * (gxx - gyy)
    root = np.sqrt(half * half + gxy * gxy)
    bend = root - 0.5 * (gxx + gyy)
    nx, ny = -gxy, half + root
    length = np.sqrt(nx * nx + ny * ny) + 1e-12
    nx, ny = nx / length, ny / length
    step = (gx * nx + gy * ny) / np.maximum(bend, 1e-6)
    on = (bend > 0.5) & (np.abs(step * nx) <= 0.5) & (np.abs(step * ny) <= 0.5)
    y, x = np.nonzero(on)
    return len(np.stack([x + step[on] * nx[on], y + step[on] * ny[on]]).T)


def skimage_hessian(image: np.ndarray) -> int:
    """The Hessian's eigenvalues by scikit-image, without points."""
    from skimage.feature import hessian_matrix, hessian_matrix_eigvals

    grey = image.astype(np.float64)
    matrix = hessian_matrix(grey, sigma=SIGMA_PX, use_gaussian_derivatives=False)
    return int((hessian_matrix_eigvals(matrix)[1] < -0.5).sum())


def ridge_points(exposure: Exposure) -> int:
    """Candidates, Hessian at the candidates and linking alone, line width given."""
    plane = mono_plane(exposure, None)
    level = measure_level(plane.image, None)
    runs = find_candidates(plane.image, level)
    return len(trace_ridges(plane.image, runs, SIGMA_PX, level.rise))


def best_ms(work: Callable[[], object], repeats: int) -> float:
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def main() -> None:
    cv2.setNumThreads(1)
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    for name, exposure in (
        ("11 lines, 2658 x 800", lines(11, 2658, 800)),
        ("1 line, 3072 x 2048", lines(1, 3072, 2048)),
    ):
        image = exposure.image
        work: dict[str, Callable[[], object]] = {
            "fit (points, sigma, flags)": lambda e=exposure: extract_stripes(e),
            "fit, line width given": lambda e=exposure: extract_stripes(
                e, StripeOptions(line_sigma_px=SIGMA_PX)
            ),
            "ridge points, linked": lambda e=exposure: ridge_points(e),
            "OpenCV + numpy Steger": lambda i=image: opencv_steger(i),
        }
        if find_spec("skimage"):
            work["scikit-image eigenvalues"] = lambda i=image: skimage_hessian(i)
        print(f"{name}: {len(extract_stripes(exposure))} points")
        times = {label: best_ms(call, repeats) for label, call in work.items()}
        for label, ms in times.items():
            print(f"  {label:28s} {ms:8.1f} ms   {ms / times['ridge points, linked']:6.1f} x")


if __name__ == "__main__":
    main()
