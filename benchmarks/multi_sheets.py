# SPDX-License-Identifier: Apache-2.0
"""Eleven bowed sheets from a small target in partial view, at feature level (simulated).

Command: ``python benchmarks/multi_sheets.py [sets] [fits]`` (default 100 and 20; seeds 0 to n - 1).

Every set draws an instrument around the printed one (thesis 5.3), cameras within their
calibrations' covariance, and places an 11 x 9 target of 3.75 mm pitch at random in the left view:
3 to 6 of the eleven lines cross it. Stripes scatter by 0.04 px, target points by 0.01 px.

First table, naming. *right*: all stripes that were named are named right; *refused*: no name was
given, for a reason; *wrong*: at least one stripe has another line's name; *named*: part of the
stripes of sets not refused that got a name (a line that only one board shows gets none).

Second table, calibration, sheets on four boards or more. *rms*: distance of the sheet from the
true light at its own stripe points, root mean square over sheets and sets; *ratio*: that over what
the stated covariance expects; *worst*: the largest rms of one sheet; *inside*: sets in which all
parameters of the cameras and of all sheets together lie in the 95 % region that is stated (sheets
without bow there, so that the model is exact); *points*: the calibration's own stripes made with
the stored document, against their boards, rms and that over the claimed one, and with each board
left out.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.stats import chi2

from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.labels import SheetAssignment, assign_sheets
from armscan.calibration.sheets.result import LaserFit, PointUse, SheetOptions
from armscan.calibration.sheets.stripes_on_board import observe_board_stripes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotations import vector_from_rotation
from armscan.models.calibration import CameraCalibration
from armscan.models.two_views import StereoCalibration
from rigs.fan_rig import FanRig, LaserTruth, fan_rig

Calibration = CameraCalibration | StereoCalibration
GRID = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), -1).reshape(-1, 2)


def left_alone(rig: FanRig, rng: np.random.Generator) -> Calibration:
    """The left camera's calibration."""
    camera: CameraCalibration = rig.drawn_stereo(rng).left
    return camera


def both(rig: FanRig, rng: np.random.Generator) -> Calibration:
    """The calibration of both cameras."""
    stereo: StereoCalibration = rig.drawn_stereo(rng)
    return stereo


def name_one(
    rig: FanRig, seed: int, cameras_of: Callable[..., Calibration], dropped: float, n_strays: int
) -> tuple[str, int, int]:
    """What became of one set, stripes named, stripes of true sheets."""
    rng = np.random.default_rng(seed)
    calibration = cameras_of(rig, rng)
    boards, truth = rig.boards(calibration, rng, dropped=dropped, n_strays=n_strays)
    cameras = HeadCameras.of(calibration)
    images = [observe_board_stripes(board, cameras) for board in boards]
    names = assign_sheets(images, SheetOptions(n_sheets=11))
    if not isinstance(names, SheetAssignment):
        return "refused", 0, 0
    differences: list[int] = []
    n_true = n_stray = 0
    for image, row, sheets in zip(images, truth, names.sheets, strict=True):
        for sighting, k in zip(image.stripes, sheets, strict=True):
            true = row[int(np.bincount(image.data.profile.segment[sighting.rows]).argmax())]
            n_true += true >= 0
            if k >= 0 and true >= 0:
                differences.append(true - int(names.names[k].split(".")[1]))
            n_stray += k >= 0 and true < 0
    is_right = len(set(differences)) == 1
    verdict = ("right" if n_stray == 0 else "a stray named") if is_right else "wrong"
    return verdict, len(differences), n_true


def naming_table(n_sets: int) -> None:
    """Print how the stripes were named."""
    print(f"\nnaming, {n_sets} sets a row")
    cases = [
        ("3 placements, left camera", 3, left_alone, 0.0, 0),
        ("5 placements, left camera", 5, left_alone, 0.0, 0),
        ("8 placements, left camera", 8, left_alone, 0.0, 0),
        ("8 placements, a sixth lost, one stray an image", 8, left_alone, 0.16, 1),
        ("5 placements, both cameras", 5, both, 0.0, 0),
    ]
    for title, n_placements, cameras_of, dropped, n_strays in cases:
        verdicts: Counter[str] = Counter()
        n_named = n_true = 0
        start = time.perf_counter()
        for seed in range(n_sets):
            rig = fan_rig(seed, n_placements)
            verdict, own, true = name_one(rig, seed, cameras_of, dropped, n_strays)
            verdicts[verdict] += 1
            n_named, n_true = n_named + own, n_true + true
        words = ", ".join(
            f"{verdicts[v]} {v}" for v in ("right", "a stray named", "refused", "wrong")
        )
        seconds = (time.perf_counter() - start) / n_sets
        share = n_named / max(n_true, 1)
        print(f"  {title:48s} {words}; named {share:.1%}; {seconds:.1f} s a set", flush=True)


def true_sheet(fit: LaserFit, truth: list[list[int]], k: int) -> int:
    """Number of the true sheet that most points of a fitted one lie on."""
    found: list[int] = []
    for row, image in zip(truth, fit.images, strict=True):
        own = (image.use == PointUse.USED) & (image.sheet == k)
        found += [row[int(segment)] for segment in image.profile.segment[own]]
    return Counter(found).most_common(1)[0][0]


def distances(fit: LaserFit, k: int, truth: LaserTruth) -> tuple[float, float]:
    """Mean square distance from the true light, mm^2: found, and expected by the covariance."""
    own = [image.points_mm[(image.use == PointUse.USED) & (image.sheet == k)]
           for image in fit.images]  # fmt: skip
    points = np.concatenate(own)
    for _ in range(4):
        points = points - truth.height_mm(points)[:, None] * truth.laser.normal
    height, _, by_parameters = fit.sheets[k].sheet.height_with_jacobian(points)
    covariance = fit.sheets[k].covariance
    expected = np.einsum("ni,ij,nj->n", by_parameters, covariance, by_parameters)
    return float((height**2).mean()), float(expected.mean())


def joint_square(
    fit: LaserFit, calibration: Calibration, truth: list[list[int]], rig: FanRig
) -> tuple[float, int]:
    """Normalised square of the errors of all free parameters, and their count; flat sheets."""
    is_stereo = isinstance(calibration, StereoCalibration)
    left = calibration.left if isinstance(calibration, StereoCalibration) else calibration
    errors: list[FloatArray] = [left.camera.parameters - rig.left.parameters]
    places = [np.arange(9)]
    for k, sheet in enumerate(fit.sheets):
        model, light = sheet.sheet, rig.sheets[true_sheet(fit, truth, k)].laser
        points = model.origin_mm + GRID * model.scale_mm @ model.axes[:2]
        height = -light.offset_mm(points) / float(light.normal @ model.axes[2])
        design = np.column_stack([GRID, np.ones(len(GRID))])
        errors.append(-np.linalg.lstsq(design, height, rcond=None)[0])
        places.append(9 + 8 * k + np.arange(3))
    if is_stereo and isinstance(calibration, StereoCalibration):
        pose, true = calibration.right_from_left, rig.right_from_left
        errors.append(calibration.right.camera.parameters - rig.right.parameters)
        errors.append(vector_from_rotation(pose.rotation @ true.rotation.T))
        errors.append(pose.translation_mm - true.translation_mm)
        places.append(9 + 8 * len(fit.sheets) + np.arange(15))
    error, place = np.concatenate(errors), np.concatenate(places)
    covariance = fit.covariance[np.ix_(place, place)]
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    return float((error / sigma) @ np.linalg.solve(correlation, error / sigma)), len(error)


def fit_table(n_fits: int) -> None:
    """Print how near the sheets come to the light."""
    print(f"\ncalibration, 12 placements, {n_fits} sets a row")
    for title, cameras_of in (("left camera", left_alone), ("both cameras", both)):
        for bow in ("bowed", "flat"):
            squares: list[tuple[float, float]] = []
            points: list[tuple[float, ...]] = []
            inside = refused = counted = 0
            normalised = freedom = 0.0
            for seed in range(n_fits):
                rig = fan_rig(seed, 12)
                if bow == "flat":
                    plane = [replace(s.laser, skew_rad=0.0, cubic_rad=0.0) for s in rig.sheets]
                    rig = replace(rig, sheets=tuple(LaserTruth(laser) for laser in plane))
                rng = np.random.default_rng(seed)
                calibration = cameras_of(rig, rng)
                boards, truth = rig.boards(calibration, rng)
                fit = calibrate_sheets(boards, calibration, SheetOptions(n_sheets=11))
                if not isinstance(fit, LaserFit):
                    refused += 1
                    continue
                squares += [
                    distances(fit, k, rig.sheets[true_sheet(fit, truth, k)])
                    for k, sheet in enumerate(fit.sheets)
                    if sheet.calibration.n_boards >= 4
                ]
                points += [
                    (
                        sheet.points.fitted.rms_mm,
                        sheet.points.fitted.claimed_rms_mm,
                        sheet.points.left_out_rms_mm,
                        sheet.points.left_out_claimed_mm,
                    )
                    for sheet in fit.sheets
                    if sheet.calibration.n_boards >= 4
                ]
                if bow == "flat" and not any(sheet.is_bow_free for sheet in fit.sheets):
                    square, count = joint_square(fit, calibration, truth, rig)
                    inside += square < chi2.ppf(0.95, count)
                    normalised, freedom = normalised + square, freedom + count
                    counted += 1
            found = np.array(squares)
            rms = np.sqrt(found.mean(axis=0))
            own, claimed, left, left_claimed = np.sqrt((np.array(points) ** 2).mean(axis=0))
            joint = (
                f"; inside {inside} of {counted}, normalised error {normalised / freedom:.2f}"
                if counted
                else ""
            )
            print(
                f"  {title}, {bow:6s} {len(found)} sheets: rms {1e3 * rms[0]:.2f} um, "
                f"ratio {rms[0] / rms[1]:.2f}, worst {1e3 * np.sqrt(found[:, 0].max()):.1f} um, "
                f"refused {refused}{joint}; points {1e3 * own:.2f} um, over claimed "
                f"{own / claimed:.2f}, left out {1e3 * left:.2f} um, {left / left_claimed:.2f}",
                flush=True,
            )


def main() -> None:
    """Print both tables."""
    cv2.setNumThreads(1)
    n_sets = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    n_fits = int(sys.argv[2]) if len(sys.argv) > 2 else 20
    naming_table(n_sets)
    fit_table(n_fits)


if __name__ == "__main__":
    main()
