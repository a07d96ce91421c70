# SPDX-License-Identifier: Apache-2.0
"""Ways to fit a light sheet, at feature level: the thesis's, total least squares, ours.

Command: ``python benchmarks/sheet_methods.py [runs]`` (default 100; seeds 0 to runs - 1).

Every run draws a camera within its calibration's covariance, corners and stripe points with noise.
The sheet is compared with the truth on a grid over the calibrated region. Columns:

- *rms mm*: root mean square over runs and grid of the distance between fitted and true sheet;
- *ratio*: that over what the Cramer-Rao bound of the scene allows (the covariance of ours, which
  uses all that is known of boards and camera), so 1.00 is the best that an unbiased method can do;
- *bias mm*: largest, over the grid, of the mean error over runs;
- *inside*: runs per cent inside the 95 % region that ours states (all free parameters and the
  camera's together);
- *bow*: runs per cent in which ours decided for a bow;
- *points*: the calibration's own stripes made with the stored document, against their boards: rms
  in mm over all runs, that over the claimed one, and with each board left out.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import LaserFit, SheetFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from rigs.sheet_rig import THESIS_PLANE, SheetRig, SheetTruth, placed, thesis_rig

CENTRE = (16.0, 12.0)
GRID = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 5), np.linspace(-0.9, 0.9, 5)), -1).reshape(
    -1, 2
)
METHODS = ("algebraic", "total least squares", "cross ratio", "ours")


def scenes() -> dict[str, SheetRig]:
    """Scenes by name; all but the last have a flat sheet."""
    plain = thesis_rig()
    deep = tuple(
        on_sheet(a, b, z)
        for a, b, z in ((0, 0, 105), (25, 5, 120), (-20, 15, 135), (15, -25, 150), (-25, -15, 170))
    )
    sharp = replace(plain, camera_covariance=1e-6 * plain.camera_covariance)
    oblique = (*plain.poses[:5], placed(62.0, 8.0, 141.0, CENTRE))
    return {
        "6 boards, 128-143 mm": plain,
        "the same, camera known exactly": sharp,
        "camera exact, stripe noise 1 px, boards 105-170 mm": replace(
            sharp, poses=deep, sigma_stripe_px=1.0, points_per_stripe=60
        ),
        "camera exact, one board at 62 deg, corners 0.2 px": replace(
            sharp, poses=oblique, sigma_corner_px=0.2
        ),
        "camera exact, stripe noise 0.3 px, correlated over 9 of 240 points": replace(
            sharp, sigma_stripe_px=0.3, points_per_stripe=240, correlated_points=9
        ),
        "two boards": replace(plain, poses=(plain.poses[1], plain.poses[4])),
        "bowed by 0.10 mm": thesis_rig(bow_uu_mm=0.10, bow_uv_mm=-0.03),
    }


def on_sheet(tilt_x_deg: float, tilt_y_deg: float, depth_mm: float) -> Pose[Sensor, Board]:
    """A board whose middle lies on the printed sheet at a depth."""
    pose = placed(tilt_x_deg, tilt_y_deg, depth_mm, CENTRE)
    y_mm = -(THESIS_PLANE[2] * depth_mm + THESIS_PLANE[3]) / THESIS_PLANE[1]
    return Pose(pose.rotation, pose.translation_mm + np.array([0.0, y_mm, 0.0]))


def true_heights(fit: SheetFit, truth: SheetTruth) -> tuple[FloatArray, FloatArray]:
    """Grid (25, 3) on the fitted frame's plane, and the true sheet's height over it."""
    sheet = fit.sheet
    reach = region(fit)
    points = sheet.origin_mm + (GRID * reach) @ sheet.axes[:2]

    def height(point: FloatArray) -> Callable[[float], float]:
        return lambda h: float(truth.height_mm((point + h * sheet.axes[2])[None])[0])

    return points, np.array([brentq(height(point), -8.0, 8.0, xtol=1e-10) for point in points])


def region(fit: SheetFit) -> FloatArray:
    """Half sizes in mm of the calibrated region along u and v."""
    low, high = fit.calibration.depth_range_mm
    along_depth = 0.5 * (high - low) / max(float(fit.sheet.axes[1, 2]), 0.2)
    return np.array([fit.sheet.scale_mm, min(along_depth, fit.sheet.scale_mm)])


def errors(fit: SheetFit, truth: SheetTruth) -> dict[str, FloatArray]:
    """(25,) error of each method on the grid, and under ``sigma`` what ours predicts."""
    points, height = true_heights(fit, truth)
    sheet = fit.sheet
    found = {}
    for comparison in fit.comparisons:
        plane = np.array(comparison.plane)
        over = -(points @ plane[:3] + plane[3]) / (plane[:3] @ sheet.axes[2])
        found[comparison.method] = over - height
    own, _, by_parameters = sheet.height_with_jacobian(points)
    found["ours"] = -own - height
    found["sigma"] = np.sqrt(np.einsum("ni,ij,nj->n", by_parameters, fit.covariance, by_parameters))
    return found


def is_inside(fit: LaserFit, rig: SheetRig, error: FloatArray) -> bool:
    """Is the truth inside the joint 95 % region of camera and sheet?"""
    sheet = fit.sheets[0]
    free = np.flatnonzero(np.diag(fit.covariance) > 0.0)
    points, _ = true_heights(sheet, rig.sheets[0])
    by_parameters = -sheet.sheet.height_with_jacobian(points)[2]
    sheet_free = free[free >= 9] - 9
    wrong = np.linalg.lstsq(by_parameters[:, sheet_free], error, rcond=None)[0]
    camera = fit.camera.camera.parameters - rig.camera.parameters
    whole = np.concatenate([camera, wrong])
    sigma = np.sqrt(np.diag(fit.covariance)[free])
    correlation = fit.covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
    square = (whole / sigma) @ np.linalg.solve(correlation, whole / sigma)
    return bool(square < chi2.ppf(0.95, len(free)))


def study(name: str, rig: SheetRig, n_runs: int) -> None:
    """Print the rows of one scene."""
    collected: dict[str, list[FloatArray]] = {method: [] for method in (*METHODS, "sigma")}
    inside = bowed = refused = 0
    points: list[tuple[float, ...]] = []
    start = time.perf_counter()
    for seed in range(n_runs):
        rng = np.random.default_rng(seed)
        camera = rig.noisy_camera(rng)
        fit = calibrate_sheets(rig.boards(camera, rng), rig.calibration(camera))
        if not isinstance(fit, LaserFit):
            refused += 1
            continue
        found = errors(fit.sheets[0], rig.sheets[0])
        for method, values in found.items():
            collected[method].append(values)
        inside += is_inside(fit, rig, found["ours"])
        bowed += fit.sheets[0].is_bow_free
        made = fit.sheets[0].points
        points.append(
            (
                made.fitted.rms_mm,
                made.fitted.claimed_rms_mm,
                made.left_out_rms_mm,
                made.left_out_claimed_mm,
            )
        )
    n_fitted = n_runs - refused
    bound = float(np.sqrt((np.array(collected["sigma"]) ** 2).mean()))
    seconds = (time.perf_counter() - start) / n_runs
    print(
        f"\n{name}: bound {bound:.4f} mm, inside {inside / n_fitted:.1%}, "
        f"bow {bowed / n_fitted:.0%}, refused {refused}, {seconds:.2f} s a run"
    )
    own, claimed, left, left_claimed = np.sqrt((np.array(points) ** 2).mean(axis=0))
    print(
        f"  points against their boards: rms {own:.4f} mm, over claimed {own / claimed:.2f}; "
        f"left out {left:.4f} mm, over claimed {left / left_claimed:.2f}"
    )
    for method in METHODS:
        values = np.array(collected[method])
        rms = float(np.sqrt((values**2).mean()))
        bias = float(np.abs(values.mean(axis=0)).max())
        print(f"  {method:20s} rms {rms:.4f} mm   ratio {rms / bound:5.2f}   bias {bias:.4f} mm")


def main() -> None:
    """Run all scenes."""
    cv2.setNumThreads(1)
    n_runs = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{n_runs} runs, seeds 0 to {n_runs - 1}")
    for name, rig in scenes().items():
        study(name, rig, n_runs)


if __name__ == "__main__":
    main()
