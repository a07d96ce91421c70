# SPDX-License-Identifier: Apache-2.0
"""Time and accuracy of stripe extraction beside the usual ways, in one run, as a Markdown table.

Command: ``python benchmarks/stripe_speed.py [repeats]`` (default 15). One thread; the least
processor time of the repeats. Trust the ratios: times on a shared machine vary. Images: 11 nearly
horizontal lines at 2658 x 800, one line at 3072 x 2048, 11 lines at 45 degrees at 2658 x 800; line
sigma 3, peak 150, speckle 0.2, seed 0. Error: RMS distance from the true line of the points within
3 px of one. The floor reads the frame once. scikit-image is used if it is installed; its
eigenvalues come without points.
"""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe.ridge import gaussian_taps
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions, lit_plane
from armscan.vision.stripe.ridge import find_candidates, trace_ridges
from rigs.stripe_image import SimulatedStripe, StripeScene, WaveCurve

SIGMA_PX = 3.0
NEAR_PX = 3.0
NO_POINTS = np.zeros((0, 2))


def horizontal(n: int, width: int, height: int) -> StripeScene:
    """Nearly horizontal lines."""
    gap = height / (n + 1.0)
    waves = tuple(
        SimulatedStripe(WaveCurve(0.0, gap * (k + 1), 0.3, 10.0, 700.0), sigma_px=SIGMA_PX)
        for k in range(n)
    )
    return StripeScene(waves, width, height)


def slanted(n: int, width: int, height: int) -> StripeScene:
    """Lines at 45 degrees."""
    waves = tuple(
        SimulatedStripe(WaveCurve(width * (k - 3.0) / n, 0.0, 45.0, 8.0, 600.0), sigma_px=SIGMA_PX)
        for k in range(n)
    )
    return StripeScene(waves, width, height)


def opencv_steger(image: np.ndarray) -> FloatArray:
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
    return np.stack([x + step[on] * nx[on], y + step[on] * ny[on]]).T


def skimage_hessian(image: np.ndarray) -> FloatArray:
    """The Hessian's eigenvalues by scikit-image, without points."""
    from skimage.feature import hessian_matrix, hessian_matrix_eigvals

    grey = image.astype(np.float64)
    matrix = hessian_matrix(grey, sigma=SIGMA_PX, use_gaussian_derivatives=False)
    hessian_matrix_eigvals(matrix)
    return NO_POINTS


def column_centroid(image: np.ndarray) -> FloatArray:
    """Grey centroid of each column around its brightest pixel: for one line."""
    reach = int(3 * SIGMA_PX)
    columns = np.arange(image.shape[1])
    peak = np.clip(image.argmax(axis=0), reach, image.shape[0] - reach - 1)
    rows = peak + np.arange(-reach, reach + 1)[:, None]
    level = image[rows, columns].astype(np.float64)
    light = np.maximum(level - level.min(axis=0), 0.0)
    return np.stack([columns, (light * rows).sum(axis=0) / light.sum(axis=0)]).T


def read_once(image: np.ndarray) -> FloatArray:
    """The floor: each pixel once."""
    image.max()
    return NO_POINTS


def ridge_points(exposure: Exposure) -> FloatArray:
    """Candidates, Hessian at the candidates and linking alone, line width given."""
    plane, level = lit_plane(exposure, None)
    runs = find_candidates(plane.image, level)
    return trace_ridges(plane.image, runs, SIGMA_PX, level.rise).table[:, :2]


FAST = StripeOptions(method="fast")


def accepted_points(exposure: Exposure, options: StripeOptions | None = None) -> FloatArray:
    """All of the extraction: points, sigma, flags."""
    profile = extract_stripes(exposure, options)
    return profile.points_px[profile.is_accepted]


def best_ms(work: Callable[[], object], repeats: int) -> float:
    """Least processor time."""
    times = []
    work()
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def machine() -> str:
    """The processor's name."""
    names = Path("/proc/cpuinfo")
    found = names.read_text("utf-8").splitlines() if names.exists() else []
    models = [line.partition(":")[2].strip() for line in found if line.startswith("model name")]
    return f"{len(models)} cores, {models[0]}" if models else platform.machine()


def error_px(scene: StripeScene, points: FloatArray) -> str:
    """RMS distance from the true lines, in words."""
    if not len(points):
        return ""
    distance = scene.errors(points)[0]
    near = distance[np.abs(distance) < NEAR_PX]
    return f"{np.sqrt((near**2).mean()):.3f} px"


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    print(f"{machine()}, {time.strftime('%Y-%m-%d')}\n")
    print("| image | method | points | error | ms | OpenCV + numpy Steger over it |")
    print("|---|---|---|---|---|---|")
    for name, scene in (
        ("11 lines, 2658 x 800", horizontal(11, 2658, 800)),
        ("1 line, 3072 x 2048", horizontal(1, 3072, 2048)),
        ("lines at 45 degrees, 2658 x 800", slanted(11, 2658, 800)),
    ):
        exposure = scene.expose(0)
        image = exposure.image
        work: dict[str, Callable[[], FloatArray]] = {
            "points, sigma, flags": lambda e=exposure: accepted_points(e),
            "points, sigma, flags: fast": lambda e=exposure: accepted_points(e, FAST),
            "ridge points, linked": lambda e=exposure: ridge_points(e),
            "OpenCV + numpy Steger": lambda i=image: opencv_steger(i),
        }
        if find_spec("skimage"):
            work["scikit-image eigenvalues"] = lambda i=image: skimage_hessian(i)
        if len(scene.stripes) == 1:
            work["per-column centroid"] = lambda i=image: column_centroid(i)
        work["frame read once"] = lambda i=image: read_once(i)
        times = {label: best_ms(call, repeats) for label, call in work.items()}
        for label, ms in times.items():
            points = work[label]()
            ratio = times["OpenCV + numpy Steger"] / ms
            count = f"{len(points):,}" if len(points) else ""
            cells = (name, label, count, error_px(scene, points), f"{ms:.1f}", f"{ratio:.2g}")
            print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
