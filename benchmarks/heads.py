# SPDX-License-Identifier: Apache-2.0
"""The whole chain of a simulated single-line arm scanner over many seeds, against its limits.

    python benchmarks/heads.py --seeds 20 --preset thesis --processes 2

Each seed draws another instrument, bench, hand and noise; images are rendered, calibrated from,
measured and inspected in memory. A row a seed, then the median and the 95th percentile of each
figure (of the 5th where more is better), beside the limit that the project demands of it. A seed
that comes to no end counts as infinitely bad in every figure.
Everything here is simulated.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import cast

import cv2
import numpy as np

from armscan.devices.twin import Preset
from armscan.pipeline.head_demo import HeadDemo, run_head
from armscan.pipeline.render_pool import TwinName
from armscan.report.head_demo_data import fraction_within

FIGURES = (
    ("plate in 0.05 %", 99.5, "least"),
    ("in 0.03 %", 99.0, "least"),
    ("plate std um", 10.0, "most"),
    ("ball diameter um", 15.0, "most"),
    ("ball in 0.05 %", 99.0, "least"),
    ("still step um", 3.0, "most"),
    ("its std um", 6.0, "most"),
    ("20 mm step um", 5.0, "most"),
    ("its std um", 8.0, "most"),
    ("5 mm step um", 5.0, "most"),
    ("part rms um", None, "most"),
    ("hand-eye deg", None, "most"),
    ("um", None, "most"),
    ("in sigmas", None, "most"),
    ("chi2 p", None, "least"),
    ("seconds", None, "most"),
)
"""Name, limit, and whether it is the most or the least that is allowed; sizes of errors."""

HUGE = 1e30
FAILED = [math.inf if kind == "most" else -math.inf for _, _, kind in FIGURES]
"""Figures of a seed that came to no end."""


def figures_of(demo: HeadDemo) -> list[float]:
    plate, ball = demo.plate.fitted.deviations_mm, demo.ball.nominal.deviations_mm
    still, errors = demo.still_step, demo.errors.hand_eye
    large = max(demo.steps, key=lambda step: step.nominal_height_mm)
    small = min(demo.steps, key=lambda step: step.nominal_height_mm)
    known = demo.instrument.hand_eye.fit.calibration.diagnostics
    return [
        100.0 * fraction_within(plate, 0.05),
        100.0 * fraction_within(plate, 0.03),
        1000.0 * float(plate.std(ddof=1)),
        1000.0 * abs(demo.ball.diameter.value_mm - demo.ball.nominal_diameter_mm),
        100.0 * fraction_within(ball, 0.05),
        1000.0 * abs(float(still.heights_mm.mean()) - still.nominal_height_mm),
        1000.0 * float(still.heights_mm.std(ddof=1)),
        1000.0 * abs(float(large.heights_mm.mean()) - large.nominal_height_mm),
        1000.0 * float(large.heights_mm.std(ddof=1)),
        1000.0 * abs(float(small.heights_mm.mean()) - small.nominal_height_mm),
        1000.0 * demo.part.rms_mm,
        errors.rotation_deg,
        1000.0 * errors.translation_mm,
        errors.normalised,
        float("nan") if known is None else known.chi2_probability,
        sum(demo.seconds.values()),
    ]


def row_of(preset: str, seed: int) -> list[float]:
    # as many workers as cores: threads inside them would only wait for each other
    cv2.setNumThreads(1)
    return figures_of(run_head(TwinName("thesis-single", cast(Preset, preset), seed).build()))


def print_row(name: str, values: Iterable[float]) -> None:
    print(" | ".join([f"{name:>10}", *(f"{value:.5g}" for value in values)]), flush=True)


def quantiles(rows: list[list[float]], percent: float) -> list[float]:
    """Of each figure over all seeds, from good to bad; infinite from the first failed seed on."""
    signs = np.array([1.0 if kind == "most" else -1.0 for _, _, kind in FIGURES])
    # numpy's interpolation makes nan of infinities
    table = np.clip(np.array(rows) * signs, -HUGE, HUGE)
    found = np.percentile(table, percent, axis=0)
    return list(signs * np.where(found > 1e-3 * HUGE, math.inf, found))


def study(n_seeds: int, first: int, preset: str, processes: int) -> None:
    print(" | ".join(["      seed", *(name for name, _, _ in FIGURES)]), flush=True)
    rows: list[list[float]] = []
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        waiting = {pool.submit(row_of, preset, first + k): first + k for k in range(n_seeds)}
        for future in as_completed(waiting):
            if error := future.exception():
                print(f"{waiting[future]:>10} | failed: {error}", flush=True)
                rows.append(FAILED)
                continue
            rows.append(future.result())
            print_row(str(waiting[future]), rows[-1])
    print_row("median", quantiles(rows, 50.0))
    print_row("95 %", quantiles(rows, 95.0))
    print_row("limit", [float("nan") if limit is None else limit for _, limit, _ in FIGURES])
    n_done = n_seeds - sum(row is FAILED for row in rows)
    print(f"{n_done} of {n_seeds} seeds came to an end, preset {preset}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--preset", default="thesis")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    study(given.seeds, given.first, given.preset, given.processes)
