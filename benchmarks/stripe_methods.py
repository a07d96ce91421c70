# SPDX-License-Identifier: Apache-2.0
"""Compare the stripe methods on rendered and real images.

Command: ``python benchmarks/stripe_methods.py [seeds]`` (default 5; seeds are 0, 1, ...). The real
images are those of the folder ``ciclop`` below ``ARMSCAN_DATA``; without it that part is left out.

Rendered: bias and noise are mean and standard deviation across the line of the accepted points;
completeness is the share of the line's 2 px pieces that have an accepted point; false are accepted
points more than 1 px (or 2 px for the close pair) from any line. Real: the truth is unknown, so
noise is the scatter about a cubic through each line on the flat board. Of lopsided sections the
bias is that against the brightest place: what matters is that it is the same at every peak.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeMethod, StripeOptions
from rigs.stripe_image import (
    CircleCurve,
    SimulatedStripe,
    StraightCurve,
    StripeNoise,
    StripeScene,
    WaveCurve,
)

METHODS: tuple[StripeMethod, ...] = get_args(StripeMethod)
FALSE_PX = 1.0
PIECE_PX = 2.0
MARGIN_PX = 14
SLOPES_DEG = tuple(float(a) + 0.3 for a in range(0, 180, 15))
ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("ARMSCAN_DATA", ROOT.parent / "shared" / "data")) / "ciclop"
NAMES = f"{'scene':26s} {'method':10s} {'bias':>8s} {'noise':>7s}"
HEAD = f"{NAMES} {'complete':>9s} {'false':>7s} {'ms':>6s}"
BUST_X, BUST_Y = (500.0, 610.0), (53.0, 1120.0)
RIM_X, RIM_Y = (770.0, 786.0), 1220.0
BOARD_LINES = {"8": ((276, 273), (597, 588)), "8-x": ((316, 314), (645, 632))}
BOARD_TOP, BOARD_BOTTOM, BOARD_REACH = 475.0, 990.0, 5.0


def straight(angle_deg: float, shift: float = 0.0, **kw: float) -> SimulatedStripe:
    return SimulatedStripe(StraightCurve(200.3, 150.2 + shift, angle_deg), **kw)


def scenes() -> dict[str, list[StripeScene]]:
    one = straight(8.0)
    wave = WaveCurve(0.0, 150.0, 5.0, amplitude_px=10.0, period_px=140.0)
    coarse = StripeNoise(grain_px=1.0)
    return {
        "straight": [StripeScene((straight(0.4),))],
        "every slope": [StripeScene((straight(a),)) for a in SLOPES_DEG],
        "circle, radius 100": [StripeScene((SimulatedStripe(CircleCurve(200, 150, 100)),))],
        f"wave, radius {wave.crest_radius_px:.0f}": [StripeScene((SimulatedStripe(wave),))],
        "speckle with grain 1 px": [StripeScene((one,), noise=coarse)],
        "weak, peak 15": [StripeScene((straight(8.0, peak=15.0),))],
        "thin, sigma 0.8": [StripeScene((straight(8.0, sigma_px=0.8),))],
        **{
            f"lopsided {part:g}, peak {peak:g}": [
                StripeScene((straight(8.0, lopsided=part, peak=peak),))
            ]
            for part in (0.15, 0.3, 0.45)
            for peak in (20.0, 150.0, 500.0)
        },
        **{
            f"one-sided tail, peak {peak:g}": [StripeScene((straight(8.0, tail=0.15, peak=peak),))]
            for peak in (20.0, 150.0, 500.0)
        },
        "wide, sigma 8": [StripeScene((straight(8.0, sigma_px=8.0),))],
        "saturated, peak 700": [StripeScene((straight(8.0, peak=700.0),))],
        "reflectance 5 % / sigma": [StripeScene((straight(8.0, reflectance_gradient=0.05),))],
        "background step 50": [StripeScene((one,), background_step=50.0)],
        "pair 6 sigma apart": [StripeScene((straight(0.0), straight(0.0, 18.0)))],
        "pair 4 sigma apart": [StripeScene((straight(0.0), straight(0.0, 12.0)))],
        "crossing at 40 degrees": [StripeScene((straight(8.0), straight(48.0)))],
    }


def pieces(scene: StripeScene, points: FloatArray) -> set[tuple[int, int]]:
    inside = (points > MARGIN_PX).all(axis=1)
    inside &= (points < np.array([scene.width_px, scene.height_px]) - 1 - MARGIN_PX).all(axis=1)
    distance, stripe, along = scene.errors(points[inside])
    near = np.abs(distance) < FALSE_PX
    place = np.floor(along[near] / PIECE_PX).astype(int)
    return set(zip(stripe[near].tolist(), place.tolist(), strict=True))


def wanted(scene: StripeScene) -> set[tuple[int, int]]:
    y, x = np.mgrid[: scene.height_px, : scene.width_px]
    return pieces(scene, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))


def rendered_row(scene_list: list[StripeScene], method: StripeMethod, seeds: int) -> str:
    errors, biases, n_false, n_found, n_wanted, total, n_runs = [], [], 0, 0, 0, 0.0, 0
    for scene in scene_list:
        target = wanted(scene)
        here = []
        for seed in range(seeds):
            exposure = scene.expose(seed)
            start = time.perf_counter()
            profile = extract_stripes(exposure, StripeOptions(method=method))
            total += time.perf_counter() - start
            n_runs += 1
            points = profile.points_px[profile.is_accepted]
            error = scene.errors(points)[0]
            true = np.abs(error) < FALSE_PX
            n_false += int((~true).sum())
            n_wanted += len(target)
            n_found += len(target & pieces(scene, points))
            here.append(error[true])
        errors.append(np.concatenate(here))
        biases.append(errors[-1].mean() if len(errors[-1]) else np.nan)
    every = np.concatenate(errors)
    worst = max(biases, key=abs) if len(every) else np.nan
    noise = every.std() if len(every) else np.nan
    false = n_false / max(len(every) + n_false, 1)
    return (
        f"{method:10s} {worst:+8.4f} {noise:7.4f} {n_found / n_wanted:9.2%} {false:7.2%} "
        f"{1e3 * total / n_runs:6.1f}"
    )


def photograph(name: str) -> Exposure:
    image = cv2.imread(str(DATA / name))
    return Exposure(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), name)


def timed(lit: Exposure, dark: Exposure, method: StripeMethod) -> tuple[Profile, float]:
    start = time.perf_counter()
    profile = extract_stripes(lit, StripeOptions(method=method), dark)
    return profile, 1e3 * (time.perf_counter() - start)


def board_row(board: str, method: StripeMethod) -> str:
    lit = photograph(f"laser_pattern/laser-0-255-255-{board}.png")
    dark = photograph(f"laser_pattern/laser-background-0-255-255-{board}.png")
    profile, ms = timed(lit, dark, method)
    points = profile.points_px[profile.is_accepted]
    share = (points[:, 1] - BOARD_TOP) / (BOARD_BOTTOM - BOARD_TOP)
    scatter, rows, on_any = [], 0, np.zeros(len(points), dtype=bool)
    for top, bottom in BOARD_LINES[board]:
        on = np.abs(points[:, 0] - top - share * (bottom - top)) < BOARD_REACH
        on_any |= on
        line = points[on & (share > 0) & (share < 1)]
        fit = np.polynomial.Polynomial.fit(line[:, 1], line[:, 0], 3)
        scatter.append(line[:, 0] - fit(line[:, 1]))
        rows += len(np.unique(np.rint(line[:, 1])))
    length = 2 * (BOARD_BOTTOM - BOARD_TOP)
    noise = np.concatenate(scatter).std()
    return (
        f"{method:10s} {'-':>8s} {noise:7.3f} {rows / length:9.2%} "
        f"{(~on_any).mean():7.2%} {ms:6.1f}"
    )


def bust_row(method: StripeMethod) -> str:
    lit, dark = (
        photograph("laser_object/laser.png"),
        photograph("laser_object/laser_background.png"),
    )
    profile, ms = timed(lit, dark, method)
    x, y = profile.points_px[profile.is_accepted].T
    on = (x > BUST_X[0]) & (x < BUST_X[1]) & (y > BUST_Y[0] - 3) & (y < BUST_Y[1] + 3)
    rim = (x > RIM_X[0]) & (x < RIM_X[1]) & (y > RIM_Y)
    rows = len(np.unique(np.rint(y[on])))
    return (
        f"{method:10s} {'-':>8s} {'-':>7s} {rows / (BUST_Y[1] - BUST_Y[0]):9.2%} "
        f"{(~on & ~rim).mean():7.2%} {ms:6.1f}"
    )


def main() -> None:
    cv2.setNumThreads(1)
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    extract_stripes(StripeScene((straight(5.0),)).expose(0))
    print(HEAD)
    for name, scene_list in scenes().items():
        for method in METHODS:
            print(f"{name:26s} {rendered_row(scene_list, method, seeds)}", flush=True)
    if not DATA.is_dir():
        print("real images: left out, ARMSCAN_DATA names no folder with ciclop")
        return
    for board in BOARD_LINES:
        for method in METHODS:
            print(f"{'board ' + board:26s} {board_row(board, method)}")
    for method in METHODS:
        print(f"{'bust':26s} {bust_row(method)}")


if __name__ == "__main__":
    main()
