# SPDX-License-Identifier: Apache-2.0
"""Stripe extraction beside the usual ways: the part ``stripes`` of ``speed.py``.

One thread. Lines of sigma 3 px, peak 150, speckle contrast 0.2, seed 0: nearly level ones, and some
at 45 degrees. Error: RMS distance from the true line of the points within 3 px of one. OpenCV's
Steger gives points without sigma and flags, scikit-image eigenvalues without points, ridge-detector
linked points without sigma (both if they are installed); the floor reads the frame once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec

import cv2
import numpy as np
from timing import Comparison, compare

from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe.ridge import gaussian_taps
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions, lit_plane
from armscan.vision.stripe.ridge import find_candidates, trace_ridges
from rigs.stripe_image import SimulatedStripe, StripeScene, WaveCurve

SIGMA_PX = 3.0
NEAR_PX = 3.0
USUAL = "OpenCV + numpy Steger"
NO_POINTS = np.zeros((0, 2))
SIZES = (
    (1, 640, 480), (5, 640, 480), (1, 1280, 1024), (5, 1280, 1024), (11, 1280, 1024),
    (1, 2658, 800), (5, 2658, 800), (1, 4096, 3000), (11, 4096, 3000),
)  # fmt: skip
"""Lines, width and height: how the cost grows."""


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


def ridge_detector(image: np.ndarray) -> FloatArray:
    """Steger's lines by the package of that name, which links them, too."""
    from ridge_detector import RidgeDetector

    detector = RidgeDetector(
        line_widths=np.array([2.0 * SIGMA_PX]),
        low_contrast=20,
        high_contrast=60,
        dark_line=False,
        estimate_width=False,
    )
    detector.detect_lines(image)
    lines = [np.stack([one.col, one.row], axis=1) for one in detector.contours]
    return np.concatenate(lines) if lines else NO_POINTS


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


def error_px(scene: StripeScene, points: FloatArray) -> str:
    """RMS distance from the true lines, in words."""
    if not len(points):
        return ""
    distance = scene.errors(points)[0]
    near = distance[np.abs(distance) < NEAR_PX]
    return f"{np.sqrt((near**2).mean()):.3f} px"


def stripes(repeats: int) -> Iterator[Comparison]:
    """Extraction beside the usual ways, by scene; then against the size of the frame and lines."""
    cv2.setNumThreads(1)
    for name, scene in (
        ("11 lines, 2658 x 800", horizontal(11, 2658, 800)),
        ("1 line, 3072 x 2048", horizontal(1, 3072, 2048)),
        ("11 lines at 45 degrees, 2658 x 800", slanted(11, 2658, 800)),
    ):
        yield compare_ways(name, scene, repeats)
    for n, width, height in SIZES:
        yield compare_ways(
            f"{n} line{'s' if n > 1 else ''}, {width} x {height}",
            horizontal(n, width, height),
            repeats,
            is_short=True,
        )


def compare_ways(
    name: str, scene: StripeScene, repeats: int, *, is_short: bool = False
) -> Comparison:
    exposure = scene.expose(0)
    image = exposure.image
    ways: dict[str, Callable[[], FloatArray]] = {
        "**armscan: points, sigma, flags**": lambda: accepted_points(exposure),
        "**armscan, `fast`: the same**": lambda: accepted_points(exposure, FAST),
        USUAL: lambda: opencv_steger(image),
    }
    if not is_short:
        ways["armscan: ridge points, linked"] = lambda: ridge_points(exposure)
        if find_spec("skimage"):
            ways["scikit-image eigenvalues"] = lambda: skimage_hessian(image)
        if find_spec("ridge_detector") and len(scene.stripes) > 1:
            ways["ridge-detector, linked"] = lambda: ridge_detector(image)
        if len(scene.stripes) == 1:
            ways["centroid of each column"] = lambda: column_centroid(image)
        ways["each pixel read once"] = lambda: read_once(image)

    def tell(points: FloatArray) -> tuple[str, str]:
        return (f"{len(points):,} points" if len(points) else ""), error_px(scene, points)

    return compare(f"stripes: {name} px", ways, repeats, usual=USUAL, tell=tell)
