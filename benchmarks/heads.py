# SPDX-License-Identifier: Apache-2.0
"""The whole chain of simulated arm scanners over many seeds, against their limits.

    python benchmarks/heads.py --head thesis-single --seeds 20 --preset thesis --processes 2

Each seed draws another instrument, fixtures, hand and noise; images are rendered, calibrated from,
measured and inspected, command by command. A row a seed, then the median and the 95th percentile of
each figure (of the 5th where more is better), beside the limit that the project demands of it. A
seed that comes to no end counts as infinitely bad in every figure. Names are compared with the
truth over eight instants of each scene. Everything here is simulated.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import cv2
import numpy as np

from armscan.devices.sources import Preset
from armscan.geometry.arrays import FloatArray
from armscan.jobs.demo import DemoRequest, make_head_demo
from armscan.pipeline.truth import HeadDemo, NamingErrors
from armscan.report.demo import head_data

HUGE = 1e30


@dataclass(frozen=True)
class Figure:
    """One figure of a demo: its limit, and whether that is the most or the least."""

    name: str
    value: Callable[[HeadDemo], float]
    limit: float | None = None
    is_most: bool = True

    @property
    def failed(self) -> float:
        return math.inf if self.is_most else -math.inf


def fraction_within(values_mm: FloatArray, limit_mm: float) -> float:
    return float(np.mean(np.abs(values_mm) <= limit_mm))


def plate_within(limit_mm: float) -> Callable[[HeadDemo], float]:
    return lambda demo: 100.0 * fraction_within(demo.plate.fitted.deviations_mm, limit_mm)


def plate_std(demo: HeadDemo) -> float:
    return 1000.0 * float(demo.plate.fitted.deviations_mm.std(ddof=1))


def ball_error(demo: HeadDemo) -> float:
    return 1000.0 * abs(demo.ball.diameter.value_mm - demo.ball.nominal_diameter_mm)


def ball_within(demo: HeadDemo) -> float:
    return 100.0 * fraction_within(demo.ball.nominal.deviations_mm, 0.05)


def still_error(demo: HeadDemo) -> float:
    still = demo.still_step
    return 1000.0 * abs(float(still.heights_mm.mean()) - still.nominal_height_mm)


def still_std(demo: HeadDemo) -> float:
    return 1000.0 * float(demo.still_step.heights_mm.std(ddof=1))


def step_error(nominal_mm: float) -> Callable[[HeadDemo], float]:
    def value(demo: HeadDemo) -> float:
        step = next(s for s in demo.steps if s.nominal_height_mm == nominal_mm)
        return 1000.0 * abs(float(step.heights_mm.mean()) - nominal_mm)

    return value


def step_std(demo: HeadDemo) -> float:
    step = max(demo.steps, key=lambda one: one.nominal_height_mm)
    return 1000.0 * float(step.heights_mm.std(ddof=1))


def names(demo: HeadDemo) -> NamingErrors:
    return sum(demo.naming.values(), NamingErrors())


def stripes(demo: HeadDemo) -> float:
    return float(head_data(demo)["named_stripes_per_exposure"])


def lines_used(demo: HeadDemo) -> float:
    found = names(demo)
    return 100.0 * found.n_stripes_named / max(found.n_stripes_in_view, 1)


PLATE = (
    Figure("plate in 0.05 %", plate_within(0.05), 99.5, False),
    Figure("in 0.03 %", plate_within(0.03), 99.0, False),
    Figure("plate std um", plate_std, 10.0),
)
CALIBRATION = (
    Figure("part rms um", lambda demo: 1000.0 * demo.part.rms_mm),
    Figure("hand-eye deg", lambda demo: demo.hand_eye.rotation_deg),
    Figure("um", lambda demo: 1000.0 * demo.hand_eye.translation_mm),
    Figure("in sigmas", lambda demo: demo.hand_eye.normalised),
    Figure("sheet um", lambda demo: 1000.0 * max(s.rms_mm for s in demo.sheets)),
    Figure("seconds", lambda demo: sum(demo.seconds.values())),
)
NAMES = (
    Figure("wrong names %", lambda demo: 100.0 * names(demo).wrong_share, 0.1),
    Figure("stray %", lambda demo: 100.0 * names(demo).n_stray / max(names(demo).n_named, 1)),
)
FIGURES: dict[str, tuple[Figure, ...]] = {
    "thesis-single": (
        *PLATE,
        Figure("ball diameter um", ball_error, 15.0),
        Figure("ball in 0.05 %", ball_within, 99.0, False),
        Figure("still step um", still_error, 3.0),
        Figure("its std um", still_std, 6.0),
        Figure("20 mm step um", step_error(20.0), 5.0),
        Figure("its std um", step_std, 8.0),
        Figure("5 mm step um", step_error(5.0), 5.0),
        *CALIBRATION,
    ),
    "thesis-cross": (
        *PLATE,
        Figure("ball diameter um", ball_error, 10.0),
        Figure("ball in 0.05 %", ball_within, 99.0, False),
        Figure("still step um", still_error),
        Figure("its std um", still_std),
        Figure("20 mm step um", step_error(20.0), 5.0),
        Figure("its std um", step_std),
        Figure("5 mm step um", step_error(5.0)),
        Figure("stripes an exposure", stripes, 1.9, False),
        *NAMES,
        *CALIBRATION,
    ),
    "thesis-multi": (
        *PLATE,
        Figure("ball diameter um", ball_error, 15.0),
        Figure("ball in 0.05 %", ball_within, 99.0, False),
        Figure("still step um", still_error, 3.0),
        Figure("its std um", still_std, 10.0),
        Figure("20 mm step um", step_error(20.0)),
        Figure("its std um", step_std),
        Figure("5 mm step um", step_error(5.0)),
        Figure("lines in view used %", lines_used, None, False),
        Figure("shared points named %", lambda d: 100.0 * names(d).named_share, 97.0, False),
        *NAMES,
        *CALIBRATION,
    ),
}
"""Limits are those of the project for the preset thesis; sizes of errors."""


def row_of(head: str, preset: str, seed: int) -> list[float]:
    # as many workers as cores: threads inside them would only wait for each other
    cv2.setNumThreads(1)
    with TemporaryDirectory() as folder:
        request = DemoRequest(Path(folder), head, seed, cast(Preset, preset), processes=1)
        _, demo = make_head_demo(request, Path(folder))
    return [figure.value(demo) for figure in FIGURES[head]]


def print_row(name: str, values: Iterable[float]) -> None:
    print(" | ".join([f"{name:>10}", *(f"{value:.5g}" for value in values)]), flush=True)


def quantiles(head: str, rows: list[list[float]], percent: float) -> list[float]:
    """Of each figure over all seeds, from good to bad; infinite from the first failed seed on."""
    signs = np.array([1.0 if figure.is_most else -1.0 for figure in FIGURES[head]])
    # numpy's interpolation makes nan of infinities
    table = np.clip(np.array(rows) * signs, -HUGE, HUGE)
    found = np.percentile(table, percent, axis=0)
    return list(signs * np.where(found > 1e-3 * HUGE, math.inf, found))


def study(head: str, n_seeds: int, first: int, preset: str, processes: int) -> None:
    figures = FIGURES[head]
    print(" | ".join(["      seed", *(figure.name for figure in figures)]), flush=True)
    rows: list[list[float]] = []
    n_done = 0
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        waiting = {pool.submit(row_of, head, preset, first + k): first + k for k in range(n_seeds)}
        for future in as_completed(waiting):
            if error := future.exception():
                print(f"{waiting[future]:>10} | failed: {error}", flush=True)
                rows.append([figure.failed for figure in figures])
                continue
            n_done += 1
            rows.append(future.result())
            print_row(str(waiting[future]), rows[-1])
    print_row("median", quantiles(head, rows, 50.0))
    print_row("95 %", quantiles(head, rows, 95.0))
    print_row("limit", [math.nan if f.limit is None else f.limit for f in figures])
    print(f"{n_done} of {n_seeds} seeds came to an end, head {head}, preset {preset}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--head", choices=tuple(FIGURES), default="thesis-single")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--preset", default="thesis")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    study(given.head, given.seeds, given.first, given.preset, given.processes)
