# SPDX-License-Identifier: Apache-2.0
"""The whole chain of simulated arm scanners over many seeds, against their limits.

    python benchmarks/heads.py --head thesis-single --seeds 20 --first 101 --folder DIR
    python benchmarks/heads.py --folder DIR --table

Each seed draws another instrument, fixtures, hand and noise; images are rendered, calibrated from,
measured and inspected, command by command, by two processes that take seed after seed. Each seed
that is done is a line of ``DIR/HEAD-PRESET.jsonl`` with the commit that it was run at: what is
killed goes on where it was when it is started again. It is refused if the tree holds changes that
are not committed, or if the lines that are there are of another commit.

The table, Markdown, is made from the lines alone: of each figure the limit that the project demands
(of preset ``thesis`` only), the median, the 95th percentile (the 5th where more is better) and the
seeds that miss the limit. A seed that comes to no end counts as infinitely bad in every figure; its
reason stands below. Names are compared with the truth over all instants of all scenes. Everything
here is simulated.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, cast, get_args

import cv2
import numpy as np

from armscan.devices.sources import Preset
from armscan.geometry.arrays import FloatArray
from armscan.jobs.twin.demo import DemoRequest, make_head_demo
from armscan.pipeline.truth import HeadDemo, NamingErrors
from armscan.report.demo import head_data

HUGE = 1e30


@dataclass(frozen=True)
class Figure:
    """One figure of a demo: its limit, whether that is the most or the least, and the median's."""

    name: str
    value: Callable[[HeadDemo], float]
    limit: float | None = None
    is_most: bool = True
    median_limit: float | None = None

    def misses(self, value: float) -> bool:
        if self.limit is None:
            return False
        return not (value <= self.limit if self.is_most else value >= self.limit)

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
    Figure("hand-eye um", lambda demo: 1000.0 * demo.hand_eye.translation_mm),
    Figure("hand-eye in sigmas", lambda demo: demo.hand_eye.normalised),
    Figure("sheets calibrated", lambda demo: float(len(demo.sheets)), None, False),
    Figure("sheet um", lambda demo: 1000.0 * max(s.rms_mm for s in demo.sheets)),
)
NAMES = (
    Figure("wrong names %", lambda demo: 100.0 * names(demo).wrong_share, 0.1),
    Figure("stray %", lambda demo: 100.0 * names(demo).n_stray / max(names(demo).n_named, 1)),
)
FIGURES: dict[str, tuple[Figure, ...]] = {
    "thesis-single": (
        *PLATE,
        Figure("ball diameter um", ball_error, 15.0, median_limit=10.0),
        Figure("ball in 0.05 %", ball_within, 99.0, False),
        Figure("still step um", still_error, 3.0),
        Figure("still step std um", still_std, 6.0),
        Figure("20 mm step um", step_error(20.0), 5.0),
        Figure("20 mm step std um", step_std, 8.0),
        Figure("5 mm step um", step_error(5.0), 5.0),
        *CALIBRATION,
    ),
    "thesis-cross": (
        *PLATE,
        Figure("ball diameter um", ball_error, 10.0),
        Figure("ball in 0.05 %", ball_within, 99.0, False),
        Figure("still step um", still_error),
        Figure("still step std um", still_std),
        Figure("20 mm step um", step_error(20.0), 5.0),
        Figure("20 mm step std um", step_std),
        Figure("5 mm step um", step_error(5.0)),
        Figure("stripes an exposure", stripes, 1.9, False),
        *NAMES,
        *CALIBRATION,
    ),
    "thesis-multi": (
        *PLATE,
        Figure("ball diameter um", ball_error, 15.0, median_limit=10.0),
        Figure("ball in 0.05 %", ball_within, 99.0, False),
        Figure("still step um", still_error, 3.0),
        Figure("still step std um", still_std, 10.0),
        Figure("20 mm step um", step_error(20.0)),
        Figure("20 mm step std um", step_std),
        Figure("5 mm step um", step_error(5.0)),
        Figure("lines in view used %", lines_used, None, False),
        Figure("shared points named %", lambda d: 100.0 * names(d).named_share, 97.0, False),
        *NAMES,
        *CALIBRATION,
    ),
}
"""Limits are those of the project for the preset thesis; sizes of errors."""


Line = dict[str, Any]


def line_of(head: str, preset: str, seed: int, commit: str) -> Line:
    """What is stored of one seed."""
    # as many workers as cores: threads inside them would only wait for each other
    cv2.setNumThreads(1)
    line: Line = {"commit": commit, "head": head, "preset": preset, "seed": seed}
    start = perf_counter()
    try:
        with TemporaryDirectory() as folder:
            request = DemoRequest(Path(folder), head, seed, cast(Preset, preset), processes=1)
            summary, demo = make_head_demo(request, Path(folder))
    except Exception as error:  # a seed may end in any way: that is what the table is for
        return line | {"failed": f"{type(error).__name__}: {error}"}
    figures = {figure.name: figure.value(demo) for figure in FIGURES[head]}
    seconds = round(perf_counter() - start, 1)
    return line | {"figures": figures, "warnings": list(summary.warnings), "seconds": seconds}


def lines_in(path: Path) -> list[Line]:
    """Lines of a file; the last one is left out if it was cut off."""
    lines = []
    for text in path.read_text("utf-8").splitlines() if path.exists() else []:
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            continue
    return lines


def add_line(path: Path, line: Line) -> None:
    whole = path.read_bytes() if path.exists() else b""
    with path.open("ab") as file:
        if whole and not whole.endswith(b"\n"):
            file.write(b"\n")
        file.write(json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def commit_of_tree() -> str:
    """The commit that is checked out; ends the program if files differ from it."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=here, check=True, capture_output=True, text=True
        ).stdout.strip()

    if changed := git("status", "--porcelain"):
        sys.exit(f"the tree is not that of a commit:\n{changed}")
    return git("rev-parse", "HEAD")


def study(path: Path, head: str, preset: str, seeds: range, processes: int) -> None:
    """Run the seeds that the file lacks."""
    commit = commit_of_tree()
    lines = lines_in(path)
    if others := {line["commit"] for line in lines} - {commit}:
        sys.exit(f"{path} holds seeds of {', '.join(sorted(others))}; this is {commit}")
    done = {line["seed"] for line in lines}
    missing = [seed for seed in seeds if seed not in done]
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        waiting = {pool.submit(line_of, head, preset, seed, commit): seed for seed in missing}
        for future in as_completed(waiting):
            line = future.result()
            add_line(path, line)
            print(line["seed"], line.get("failed") or line["figures"], flush=True)


def percentile(figure: Figure, values: list[float], percent: float) -> float:
    """Of a figure over all seeds, from good to bad; infinite from the first failed seed on."""
    sign = 1.0 if figure.is_most else -1.0
    # numpy's interpolation makes nan of infinities
    found = float(np.percentile(np.clip(sign * np.array(values), -HUGE, HUGE), percent))
    return sign * (math.inf if found > 1e-3 * HUGE else found)


def missed_text(figure: Figure, values: dict[int, float], is_judged: bool) -> str:
    if figure.limit is None or not is_judged:
        return ""
    named = [
        f"{seed} ({values[seed]:.4g})" for seed in sorted(values) if figure.misses(values[seed])
    ]
    return ", ".join(named) or "none"


def print_table(path: Path) -> None:
    """Markdown of one file."""
    lines = sorted(lines_in(path), key=lambda line: line["seed"])
    if not lines:
        sys.exit(f"{path} holds no seed")
    if len(commits := {line["commit"] for line in lines}) > 1:
        sys.exit(f"{path} holds seeds of {', '.join(sorted(commits))}")
    head, preset = lines[0]["head"], lines[0]["preset"]
    done = [line for line in lines if "figures" in line]
    seeds = [line["seed"] for line in lines]
    print(
        f"Head {head}, preset {preset}, simulated: {len(done)} of {len(lines)} seeds came to an "
        f"end ({spans(seeds)}), commit {lines[0]['commit'][:7]}\n"
    )
    print("| | limit | median | 95th percentile | seeds that miss the limit |")
    print("|---|---|---|---|---|")
    is_judged = preset == "thesis"
    for figure in FIGURES[head]:
        values = {
            line["seed"]: line["figures"][figure.name] if "figures" in line else figure.failed
            for line in lines
        }
        limit = "" if figure.limit is None or not is_judged else f"{figure.limit:g}"
        if limit and figure.median_limit is not None:
            limit += f", median {figure.median_limit:g}"
        both = [percentile(figure, list(values.values()), percent) for percent in (50.0, 95.0)]
        missed = missed_text(figure, values, is_judged)
        print(f"| {figure.name} | {limit} | {both[0]:.4g} | {both[1]:.4g} | {missed} |")
    if done:
        seconds = float(np.median([line["seconds"] for line in done]))
        warned = [str(line["seed"]) for line in done if line["warnings"]]
        print(f"\n{seconds:.0f} s a seed in the median. Seeds with warnings: {', '.join(warned)}")
    for line in lines:
        if "failed" in line:
            print(f"\nSeed {line['seed']}: {line['failed']}")
    print()


def spans(seeds: list[int]) -> str:
    """Seeds in words: runs as first-last."""
    runs: list[list[int]] = []
    for seed in seeds:
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--head", choices=tuple(FIGURES), default="thesis-single")
    parser.add_argument("--preset", choices=get_args(Preset), default="thesis")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the files of the folder")
    given = parser.parse_args()
    if given.table:
        for path in sorted(given.folder.glob("*.jsonl")):
            print_table(path)
        return
    given.folder.mkdir(parents=True, exist_ok=True)
    path = given.folder / f"{given.head}-{given.preset}.jsonl"
    seeds = range(given.first, given.first + given.seeds)
    study(path, given.head, given.preset, seeds, given.processes)
    print_table(path)


if __name__ == "__main__":
    main()
