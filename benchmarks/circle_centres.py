# SPDX-License-Identifier: Apache-2.0
"""Circle centres by four methods against the rendered truth, and what uncorrected centres cost.

Command: ``python benchmarks/circle_centres.py`` (about three minutes on one core).

A camera of 3072 x 2048 px, f = 5150 px, sees a grid of 13 x 9 circles, 69 px across at 140 mm,
noise 2 grey levels, with distortion. Tilt 0, 30, 45 degrees; the azimuths, blurs 0.7 to 2 px,
a 50 % illumination gradient and both polarities take turns. Printed: rms per axis and the mean
(bias) of the error along the tilt direction and across it, px. Seeds: the row's number.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.models.camera import CameraModel
from armscan.records.exposure import Exposure
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.optics.camera import RenderCamera
from armscan.thesis.ellipse import thesis_centres
from armscan.vision.targets.circle_edges import measure_circles
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import CircleGrid, TargetView
from rigs.flat_prints import Lighting, RenderedTarget, render_flat_target
from rigs.plain_scanner import plain_camera
from rigs.slow_renderer import add_noise

TARGET = CircleGrid(13, 9, 3.75)
DISTORTION = np.array([-0.1, 0.05, 1e-3, -5e-4, 0.0])
FOCAL_PX, WIDTH_PX, HEIGHT_PX, RADIUS_MM, NOISE = 5150.0, 3072, 2048, 0.9375, 2.0


def pose(tilt_deg: float, azimuth_deg: float, roll_deg: float) -> tuple[FloatArray, FloatArray]:
    azimuth = np.deg2rad(azimuth_deg)
    axis = np.deg2rad(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    tilt, _ = cv2.Rodrigues(axis)
    roll, _ = cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))
    rotation = tilt @ roll
    return rotation, np.array([0.3, 0.2, 140.0]) - rotation @ TARGET.points_board_mm.mean(axis=0)


def blob_centres(image: np.ndarray, is_light: bool, truth: FloatArray) -> FloatArray:
    parameters = cv2.SimpleBlobDetector_Params()
    parameters.maxArea = 50_000
    parameters.blobColor = 255 if is_light else 0
    found, centres = cv2.findCirclesGrid(
        image,
        (TARGET.columns, TARGET.rows),
        flags=cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING,
        blobDetector=cv2.SimpleBlobDetector_create(parameters),
    )
    if not found:
        return np.full(truth.shape, np.nan)
    points = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
    nearest = np.linalg.norm(points[None] - truth[:, None], axis=2).argmin(axis=1)
    return points[nearest]


def measured(
    image: np.ndarray, rendered: RenderedTarget, is_light: bool, camera: CameraModel
) -> dict[str, FloatArray]:
    view = detect_target(Exposure(image, "rendered"), TARGET)
    if not isinstance(view, TargetView):
        return {}
    # The grid looks the same after half a turn: take the numbering that was meant.
    either = (rendered.marks_px[view.point_index], rendered.marks_px[::-1][view.point_index])
    truth = min(either, key=lambda marks: float(np.abs(marks - view.points_px).sum()))
    shapes = ellipse_shapes(view)
    circles = measure_circles(image, view.points_px, shapes, 5.0)
    ideal = correct_centres(view, camera)
    error = ideal.points_px - truth
    inverse = np.linalg.inv(ideal.covariance_px2)
    return {
        "OpenCV blob": blob_centres(image, is_light, truth) - truth,
        "thesis: Canny + algebraic": thesis_centres(image, view.points_px, shapes) - truth,
        "ours, centre of the ellipse": circles.ellipses.centres()[0] - truth,
        "ours, no intrinsics": view.points_px - truth,
        "ours, with intrinsics": error,
        "nees": np.einsum("ni,nij,nj->n", error, inverse, error),
    }


def ellipse_shapes(view: TargetView) -> FloatArray:
    edges = view.edges
    if edges is None:
        raise ValueError("a circle grid's view holds edges")
    shapes = []
    for k in range(len(view)):
        offset = edges.points_px[edges.circle == k] - view.points_px[k]
        shapes.append(2.0 * np.cov(offset.T))
    return np.array(shapes)


def accuracy() -> None:
    conditions = [
        (tilt, azimuth, blur, gradient, is_light)
        for tilt in (0.0, 30.0, 45.0)
        for azimuth, blur, gradient, is_light in (
            (10.0, 1.0, 0.0, False),
            (60.0, 0.7, 0.0, True),
            (130.0, 1.0, 0.5, False),
            (200.0, 1.4, 0.0, False),
            (285.0, 2.0, 0.0, True),
        )
    ]
    k = DISTORTION
    model = plain_camera(FOCAL_PX, (1535.5, 1023.5), (WIDTH_PX, HEIGHT_PX), k)
    errors: dict[tuple[str, float], list[FloatArray]] = defaultdict(list)
    for seed, (tilt, azimuth, blur, gradient, is_light) in enumerate(conditions):
        rotation, translation = pose(tilt, azimuth, 17.0 * seed)
        camera = RenderCamera(
            FOCAL_PX, FOCAL_PX, 1535.5, 1023.5, *k, WIDTH_PX, HEIGHT_PX, blur_sigma_px=blur
        )
        pattern = CirclePattern(
            TARGET.columns, TARGET.rows, TARGET.pitch_mm, 2 * RADIUS_MM, False, is_light
        )
        light = Lighting(gradient=gradient)
        rendered = render_flat_target(camera, pattern, rotation, translation, light)
        noisy = add_noise(rendered.image, np.random.default_rng(seed), sigma=NOISE)
        along = np.deg2rad(azimuth + 90.0)
        turn = np.array([[np.cos(along), -np.sin(along)], [np.sin(along), np.cos(along)]])
        line = f"tilt {tilt:2.0f} azimuth {azimuth:3.0f} blur {blur} gradient {gradient} "
        line += "light " if is_light else "dark  "
        for method, error in measured(noisy, rendered, is_light, model).items():
            if method == "nees":
                line += f" nees/2 {error.mean() / 2:.2f}"
                continue
            errors[method, tilt].append(error @ turn)
            if method == "ours, with intrinsics":
                rms, bias = np.sqrt(np.mean(error**2, axis=0)), np.abs(error.mean(axis=0))
                line += f"  ours rms {rms[0]:.4f} {rms[1]:.4f}  bias {bias[0]:.4f} {bias[1]:.4f}"
        print(line)
    print("\nmethod                        tilt   rms per axis   bias along   across  (px)")
    for (method, tilt), parts in sorted(errors.items()):
        every = np.concatenate(parts)
        every = every[np.isfinite(every).all(axis=1)]
        if not len(every):
            print(f"{method:28s} {tilt:5.0f}   not found")
            continue
        rms, bias = np.sqrt(np.mean(every**2)), every.mean(axis=0)
        lost = sum(len(part) for part in parts) - len(every)
        note = f"   {lost} circles not found" if lost else ""
        print(f"{method:28s} {tilt:5.0f} {rms:12.4f} {bias[0]:14.4f} {bias[1]:9.4f}{note}")


def focal_bias() -> None:
    """Focal length from noise-free ellipse centres: the residual looks fine, f does not."""
    x = TARGET.points_board_mm[:, :2]
    matrix = np.array([[FOCAL_PX, 0.0, 1535.5], [0.0, FOCAL_PX, 1023.5], [0.0, 0.0, 1.0]])
    board, images = [], []
    for azimuth in range(0, 360, 45):
        rotation, translation = pose(35.0, azimuth, azimuth / 2.0)
        inverse = np.linalg.inv(matrix @ np.column_stack([rotation[:, :2], translation]))
        centres = []
        for a, b in x:
            shift = np.array([[1.0, 0.0, -a], [0.0, 1.0, -b], [0.0, 0.0, 1.0]]) @ inverse
            conic = shift.T @ np.diag([1.0, 1.0, -(RADIUS_MM**2)]) @ shift
            centres.append(-np.linalg.solve(conic[:2, :2], conic[:2, 2]))
        board.append(TARGET.points_board_mm.astype(np.float32))
        images.append(np.array(centres, dtype=np.float32))
    fix = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    rms, fitted, *_ = cv2.calibrateCamera(
        board, images, (WIDTH_PX, HEIGHT_PX), matrix.copy(), np.zeros(5), flags=fix
    )
    ppm = 1e6 * (fitted[0, 0] / FOCAL_PX - 1.0)
    print(f"\nuncorrected centres, no noise: f off by {ppm:.0f} ppm at an rms of {rms:.4f} px")


if __name__ == "__main__":
    cv2.setNumThreads(1)
    accuracy()
    focal_bias()
    sys.exit(0)
