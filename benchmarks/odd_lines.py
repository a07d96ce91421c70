# SPDX-License-Identifier: Apache-2.0
"""Lines of another width than most of an image's, and lines as faint as the noise of a pixel.

Command: ``python benchmarks/odd_lines.py [seeds]`` (default 4). PYTHONPATH chooses the tree.

*widths*: three lines of one sigma and peak 300 (clipped at 255), one of another sigma and peak 150.
*faint*: one line beside noise of 10 grey levels a pixel, peak in multiples of that. *found*: part
of the odd line's length with an accepted point, *error* rms, *z* rms of error over sigma; *false*:
accepted points farther than a line's sigma from every line.
"""

from __future__ import annotations

import sys

import numpy as np

from armscan.vision.stripe.extract import extract_stripes
from rigs.stripe_image import SimulatedStripe, StraightCurve, StripeNoise, StripeScene

WIDTHS = (
    *((3.0, own) for own in (0.9, 1.05, 1.2, 1.5, 2.4)),
    *((2.5, own) for own in (3.75, 5.0, 6.25, 7.5, 10.0)),
)
FAINT = tuple((sigma, peak) for sigma in (1.5, 4.0) for peak in (2.0, 3.0, 4.0, 5.0, 6.0, 8.0))
WIDTH_PX, HEIGHT_PX = 600, 300
READ_NOISE = 10.0


def of_widths(most_px: float, own_px: float) -> StripeScene:
    """Three lines of one width, and the odd one last."""
    curves = [StraightCurve(300.0, 40.0 + 60.0 * k, 3.0 + k) for k in range(4)]
    stripes = [SimulatedStripe(curve, sigma_px=most_px, peak=300.0) for curve in curves[:3]]
    stripes.append(SimulatedStripe(curves[3], sigma_px=own_px, peak=150.0))
    return StripeScene(tuple(stripes), WIDTH_PX, HEIGHT_PX)


def faint(sigma_px: float, times: float) -> StripeScene:
    """One line so many times as high as the noise."""
    stripe = SimulatedStripe(
        StraightCurve(300.0, 150.0, 6.0), sigma_px=sigma_px, peak=times * READ_NOISE
    )
    return StripeScene((stripe,), WIDTH_PX, HEIGHT_PX, noise=StripeNoise(read=READ_NOISE))


def row(scene: StripeScene, seeds: int) -> str:
    """Figures of the scene's last line."""
    found, errors, squares, false = 0, [], [], 0
    odd = len(scene.stripes) - 1
    for seed in range(seeds):
        profile = extract_stripes(scene.expose(seed))
        good = profile.select(profile.is_accepted)
        distance, stripe, along = scene.errors(good.points_px)
        limit = np.array([one.sigma_px for one in scene.stripes])[stripe]
        is_own = (stripe == odd) & (np.abs(distance) < limit)
        false += int((np.abs(distance) >= limit).sum())
        found += len(np.unique(np.floor(along[is_own])))
        errors.append(distance[is_own])
        squares.append((distance / good.sigma_px)[is_own] ** 2)
    error, square = np.concatenate(errors), np.concatenate(squares)
    whole = seeds * WIDTH_PX
    if not len(error):
        return f"0 % | - | - | {false}"
    rms, z = np.sqrt((error**2).mean()), np.sqrt(square.mean())
    return f"{min(100.0 * found / whole, 100.0):.0f} % | {rms:.3f} px | {z:.2f} | {false}"


if __name__ == "__main__":
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 4
    print("| most, px | the odd line, px | found | error | z | false |\n|--:|--:|--:|--:|--:|--:|")
    for most_px, own_px in WIDTHS:
        print(f"| {most_px} | {own_px} | {row(of_widths(most_px, own_px), n)} |", flush=True)
    print(
        "\n| sigma, px | peak over noise | found | error | z | false |\n|--:|--:|--:|--:|--:|--:|"
    )
    for sigma_px, times in FAINT:
        print(f"| {sigma_px} | {times:g} | {row(faint(sigma_px, times), n)} |", flush=True)
