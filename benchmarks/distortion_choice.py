# SPDX-License-Identifier: Apache-2.0
"""`--distortion auto` over random cameras and coverages, at feature level (simulated).

Command: ``python benchmarks/distortion_choice.py [--draws N] [--first SEED]`` (default 100 a row,
seeds from 1000).

Each draw has its own lens (field of view 8 to 70 degrees, the size of each term at the image's
corner drawn over the one before), image, noise and views; the board covers most of the image or
only its middle. ``alike`` adds a smooth error field of its own to every view, as large as the
noise: residuals of one view then are correlated. ``--bow 0.005`` bows the board along x and y by up
to that part of its length, as home-made boards are.

Columns: *inside* the truth of fx, fy, cx, cy lies in the stated joint 95 % region; *chi2/4* mean of
the normalised squared error. *free in* and the next: the same for ``--distortion k1k2p1p2k3``;
*width* median of the four sigmas over theirs. *px*, *free px* median over draws of the rms error
over the whole image, a turn aside.

``--lenses`` draws wide lenses instead: pinholes with all five coefficients and half a field of
view of 30 to 48 degrees, and fisheyes (`cv2.fisheye`, k4 = 0) of 35 to 80 degrees to each side.
*right* the kind of lens; *inside*, *chi2/4* as above, of those; *px* the rms of points of ten more
views, without noise, whose board's pose is fitted to them, and *pinhole px* with
``--distortion k1k2p1p2k3``; *no pinhole* how many of these were refused.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from typing import get_args

import cv2
import numpy as np
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import (
    DISTORTION_PARAMETERS,
    CameraFit,
    CameraOptions,
    DistortionModel,
)
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import CameraModel, Lens
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import Scene, make_views, normalised_error
from rigs.fisheye import fisheye_views
from rigs.plain_scanner import plain_camera

MODELS: tuple[DistortionModel, ...] = ("k1", "k1k2", "k1k2p1p2", "k1k2p1p2k3")
ROWS = [
    (model, covers, alike)
    for alike in (False, True)
    for covers in ("all", "middle")
    for model in MODELS
]


@dataclass(frozen=True)
class Draw:
    views: list[TargetView]
    camera: CameraModel


def draw_camera(model: DistortionModel, rng: np.random.Generator) -> CameraModel:
    width, height = [(640, 480), (1280, 1024), (2048, 1536), (3072, 2048)][rng.integers(4)]
    half_field = np.deg2rad(rng.uniform(4.0, 35.0))
    f = 0.5 * width / np.tan(half_field)
    square = 0.25 * (width**2 + height**2) / f**2
    first = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-2.0, -0.9)
    second = first * rng.uniform(-0.6, 0.6)
    third = second * rng.uniform(-0.6, 0.6)
    has = DISTORTION_PARAMETERS[model]
    values = {
        "k1": first / square,
        "k2": second / square**2,
        "k3": third / square**3,
        "p1": rng.normal(0.0, 7e-4),
        "p2": rng.normal(0.0, 7e-4),
    }
    distortion = [values[name] if name in has else 0.0 for name in ("k1", "k2", "p1", "p2", "k3")]
    return plain_camera(
        (f, f * rng.uniform(0.998, 1.002)),
        (0.5 * width * rng.uniform(0.97, 1.03), 0.5 * height * rng.uniform(0.97, 1.03)),
        (width, height),
        np.array(distortion),
    )


def draw(model: DistortionModel, covers: str, *, alike: bool, bow: float, seed: int) -> Draw:
    rng = np.random.default_rng([seed, MODELS.index(model)])
    camera = draw_camera(model, rng)
    while len(camera.folded_border()):
        camera = draw_camera(model, rng)
    board = Chessboard(11, 8, 10.0)
    bow_mm = 100.0 * bow * np.random.default_rng([seed, 100]).uniform(-1.0, 1.0, 2)
    share, reach = (0.55, 0.28) if covers == "all" else (0.3, 0.03)
    distance = 100.0 * camera.fx_px / (share * camera.width_px)
    noise = 10.0 ** rng.uniform(-2.0, -0.7)
    scene = Scene(
        camera=camera,
        target=board,
        n_views=int(rng.integers(6, 18)),
        noise_px=noise,
        distance_mm=distance,
        max_tilt_deg=40.0,
        reach=reach,
        bow_mm=(float(bow_mm[0]), float(bow_mm[1])),
    )
    views = make_views(scene, seed)[0]
    if alike:
        views = [_with_field(view, noise, rng) for view in views]
    return Draw(views, camera)


def _with_field(view: TargetView, noise: float, rng: np.random.Generator) -> TargetView:
    """A cubic error field over the view, of the noise's size."""
    p = view.points_px - view.points_px.mean(axis=0)
    u, v = (p / np.abs(p).max(axis=0)).T
    terms = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)
    field = terms @ rng.normal(size=(terms.shape[1], 2))
    field *= noise / np.sqrt(np.mean(field**2))
    return replace(view, points_px=view.points_px + field)


def off_px(fit: CameraFit, truth: CameraModel) -> float:
    """Directions of the truth's pixels, turned to fit best, against those of the fit."""
    x, y = np.meshgrid(np.linspace(0, truth.width_px, 13), np.linspace(0, truth.height_px, 11))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = truth.undistort(pixels)[0]
    a = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    turn = np.eye(3)
    for _ in range(6):
        seen = fit.camera.project_with_jacobian(a @ turn.T)
        by_turn = -seen[1] @ np.array([_skew(p) for p in a @ turn.T])
        step = np.linalg.lstsq(by_turn.reshape(-1, 3), (pixels - seen[0]).ravel(), rcond=None)[0]
        turn = cv2.Rodrigues(step)[0] @ turn
    residual = pixels - fit.camera.project(a @ turn.T)
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def _skew(p: FloatArray) -> FloatArray:
    return np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])


def chi2_of(fit: CameraFit, truth: CameraModel) -> float:
    return normalised_error(truth.parameters[:4], fit.camera.parameters[:4], fit.covariance[:4, :4])


def row(model: DistortionModel, covers: str, *, alike: bool, bow: float, seeds: range) -> str:
    limit = stats.chi2.ppf(0.95, 4)
    auto, free, width, off = [], [], [], []
    refused = 0
    for seed in seeds:
        drawn = draw(model, covers, alike=alike, bow=bow, seed=seed)
        fit = calibrate_camera(drawn.views)
        full = calibrate_camera(drawn.views, CameraOptions(distortion="k1k2p1p2k3", n_folds=0))
        if not isinstance(fit, CameraFit) or not isinstance(full, CameraFit):
            refused += 1
            continue
        auto.append(chi2_of(fit, drawn.camera))
        free.append(chi2_of(full, drawn.camera))
        width.append(np.median(fit.sigma[:4] / full.sigma[:4]))
        off.append([off_px(fit, drawn.camera), off_px(full, drawn.camera)])
    n = len(auto)
    a, b = np.array(auto), np.array(free)
    px = np.median(np.array(off), axis=0)
    return (
        f"{model:11s} {covers:7s} {'yes' if alike else 'no':5s} {n:4d} "
        f"{np.sum(a <= limit):7d} {np.mean(a) / 4:7.2f}  {np.sum(b <= limit):7d} "
        f"{np.mean(b) / 4:7.2f} {np.median(width):6.2f} {px[0]:8.3f} {px[1]:8.3f}"
        + (f"  ({refused} refused)" if refused else "")
    )


def draw_wide(lens: Lens, seed: int) -> tuple[CameraModel, list[TargetView], list[TargetView]]:
    """A wide lens, its views, and ten more without noise."""
    rng = np.random.default_rng([seed, 7 if lens == "fisheye" else 8])
    width, height = [(640, 480), (960, 600), (1280, 960), (1920, 1080)][rng.integers(4)]
    noise, n_views = 10.0 ** rng.uniform(-1.7, -0.5), int(rng.integers(8, 20))
    board, ten = Chessboard(9, 6, 25.0), 10
    centre = [0.5 * width * rng.uniform(0.97, 1.03), 0.5 * height * rng.uniform(0.97, 1.03)]
    if lens == "fisheye":
        half_field = np.deg2rad(rng.uniform(35.0, 80.0))
        terms = rng.normal(0.0, [0.05, 0.02, 0.005]) / half_field ** np.array([2, 4, 6])
        f = 0.5 * width / (half_field * (1.0 + terms @ half_field ** np.array([2, 4, 6])))
        parameters = np.array(
            [f, f * rng.uniform(0.998, 1.002), *centre, terms[0], terms[1], 0.0, 0.0, terms[2]]
        )
        truth = CameraModel.from_parameters(parameters, width, height, "fisheye")
        size = (width, height)
        views = fisheye_views(parameters, size, board, n_views=n_views, noise_px=noise, seed=seed)
        more = fisheye_views(parameters, size, board, n_views=ten, noise_px=1e-6, seed=seed + 10**6)
        return truth, views, more
    half_field = np.deg2rad(rng.uniform(30.0, 48.0))
    f = 0.5 * width / np.tan(half_field)
    square = 0.25 * (width**2 + height**2) / f**2
    while True:
        first = rng.uniform(-0.35, 0.05)
        second = first * rng.uniform(-0.6, 0.0)
        third = second * rng.uniform(-0.6, 0.6)
        tangential = rng.normal(0.0, 7e-4, 2)
        k = [first / square, second / square**2, *tangential, third / square**3]
        truth = plain_camera((f, f), (centre[0], centre[1]), (width, height), np.array(k))
        if not len(truth.folded_border()):
            break
    near_mm = 200.0 * f / (0.6 * width)
    scene = Scene(truth, board, n_views, noise, near_mm, max_tilt_deg=40.0, reach=0.35)
    still = replace(scene, n_views=ten, noise_px=1e-6)
    return truth, make_views(scene, seed)[0], make_views(still, seed + 10**6)[0]


def unseen_px(fit: CameraFit, views: list[TargetView]) -> float:
    """Rms of points of views, the board's pose fitted to each; infinite where there is none."""
    squares = []
    for view in views:
        pose = estimate_board_pose(view, fit.camera, allow_ambiguous=True)
        lost = np.full((len(view), 2), np.inf)
        squares.append(np.sum((lost if isinstance(pose, FitFailure) else pose.residuals) ** 2, 1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def print_lenses(seeds: range) -> None:
    """Both kinds of lens, a row each."""
    limit = stats.chi2.ppf(0.95, 4)
    print("lens        n  right  refused  inside  chi2/4       px  pinhole px  no pinhole")
    for lens in get_args(Lens):
        right = refused = without = 0
        squares, own, pinhole = [], [], []
        for seed in seeds:
            truth, views, more = draw_wide(lens, seed)
            fit = calibrate_camera(views)
            if not isinstance(fit, CameraFit):
                refused += 1
                print(f"  {lens} {seed} refused: {fit.reason}", file=sys.stderr)
                continue
            if fit.camera.lens == lens:
                right += 1
                squares.append(chi2_of(fit, truth))
            else:
                print(f"  {lens} {seed} taken for a {fit.camera.lens}", file=sys.stderr)
            own.append(unseen_px(fit, more))
            plain = calibrate_camera(views, CameraOptions(distortion="k1k2p1p2k3", n_folds=0))
            if isinstance(plain, CameraFit):
                pinhole.append(unseen_px(plain, more))
            else:
                without += 1
        print(
            f"{lens:9s} {len(own):3d} {right:6d} {refused:8d} "
            f"{np.sum(np.array(squares) <= limit):7d} "
            f"{np.mean(squares) / 4:7.2f} {np.median(own):8.4f} {np.median(pinhole):11.4f} "
            f"{without:11d}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--alike", choices=["no", "yes"])
    parser.add_argument("--bow", type=float, default=0.0)
    parser.add_argument("--lenses", action="store_true")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.draws)
    cv2.setNumThreads(1)
    print(__doc__.split("\n")[0])
    print(f"seeds {seeds[0]} to {seeds[-1]}")
    if given.lenses:
        print_lenses(seeds)
        return
    print(
        f"{'lens has':11s} {'covers':7s} {'alike':5s} {'n':>4s} "
        f"{'inside':>7s} {'chi2/4':>7s}  {'free in':>7s} {'chi2/4':>7s} "
        f"{'width':>6s} {'px':>8s} {'free px':>8s}"
    )
    for model, covers, alike in ROWS:
        if given.alike and alike != (given.alike == "yes"):
            continue
        print(row(model, covers, alike=alike, bow=given.bow, seeds=seeds), flush=True)


if __name__ == "__main__":
    main()
