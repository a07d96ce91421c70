# SPDX-License-Identifier: Apache-2.0
"""Scanners drawn at random, through every calibration and the naming of lines, without images.

    python benchmarks/random_instruments.py [--draws 2000] [--seed-first 500000] [--processes 2]
                                            [--only STAGES] [--lines FILE] [--table]

Each draw (`rigs.instruments`) has a field of 20 to 400 mm, a stand-off of 60 to 600 mm and all else
of its own; about one in eight cannot be calibrated, by construction. Every stage ends as right
(the joint error and that of each group of parameters within four of their own sigma), silently
wrong, rightly refused (degenerate by construction, or the Cramer-Rao bound itself is beyond the
limit at which the software says that it refuses) or wrongly refused.

A line of JSON a draw is added to FILE, with the commit: a study that was stopped goes on where it
was, and lines of another commit are refused. ``--table`` prints the tables of what is there.
``--only`` takes some of camera, sheet, stereo, handeye, naming; a stage runs what it rests on.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armscan.models.calibration import SensorCalibration
from rigs.instrument_arm import run_hand_eye
from rigs.instrument_naming import run_naming
from rigs.instrument_stages import Outcome, SheetResult, run_camera, run_sheets
from rigs.instrument_stereo import run_stereo
from rigs.instruments import Instrument, draw_instrument
from rigs.sheet_rig import PROVENANCE

STAGES = ("camera", "sheet", "stereo", "handeye", "naming")
RESULTS = ("right", "rightly refused", "wrongly refused", "silently wrong")
NOT_REACHED = "not reached"
Row = dict[str, Any]


def outcomes(made: Instrument, stages: tuple[str, ...]) -> Iterator[Outcome]:
    """What becomes of every stage that is asked for."""
    camera = run_camera(made)
    yield camera.outcome
    if "stereo" in stages and made.right is not None:
        yield run_stereo(made)
    if not {"sheet", "handeye", "naming"} & set(stages):
        return
    sheets = run_sheets(made, camera.calibration, camera.information)
    yield sheets.outcome
    if sheets.outcome.result != "right" or sheets.fit is None:
        return
    sensor = sheets.fit.to_calibration(PROVENANCE)
    if "handeye" in stages:
        yield from _hand_eyes(made, sensor, sheets)
    if "naming" in stages:
        yield from run_naming(made, sensor, sheets.names)


def _hand_eyes(
    made: Instrument, sensor: SensorCalibration, sheets: SheetResult
) -> Iterator[Outcome]:
    n_lines = min(2 if made.is_crossed else 1, len(sheets.names))
    lights = {k: made.lights[sheets.names[k]] for k in range(n_lines)}
    yield run_hand_eye(made, sensor, lights, on_sphere=False)
    if made.references.has_sphere:
        yield run_hand_eye(made, sensor, lights, on_sphere=True)


def drawn(task: tuple[int, tuple[str, ...]]) -> Row:
    """One instrument: what it is, and its outcomes."""
    seed, stages = task
    cv2.setNumThreads(1)
    made, begun = draw_instrument(seed), time.process_time()
    found = [outcome.as_row() for outcome in outcomes(made, stages)]
    return {
        "seed": seed,
        "fault": made.fault,
        "strata": strata(made),
        "outcomes": found,
        "seconds": time.process_time() - begun,
    }


def strata(made: Instrument) -> dict[str, float]:
    """What the tables are split by."""
    bow = float(np.abs(made.target.bow_mm).max())
    return {
        "field (mm)": made.field_mm,
        "stand-off (mm)": made.stand_off_mm,
        "image width (px)": made.left.width_px,
        "noise of target points (px)": made.target_px,
        "noise of stripes (px)": made.stripe_px,
        "print error over field": float(made.target.missed.std()) / made.field_mm,
        "bow of the board over field": bow / made.field_mm,
        "views": made.n_views,
        "coverage": made.reach,
        "boards for sheets": made.n_boards,
        "arm (mm)": made.arm.position_mm,
        "lever (mm)": made.arm.lever_mm,
        "postures": made.arm.n_postures,
        "flatness (mm)": made.references.flatness_mm,
        "lines": len(made.lights),
    }


def commit() -> str:
    """Of the tree that is judged; marked if it has changes."""
    here = Path(__file__).parent
    said = ["git", "-C", str(here), "describe", "--always", "--dirty", "--exclude", "*"]
    return subprocess.run(said, capture_output=True, text=True, check=True).stdout.strip()


def read(path: Path, head: str) -> list[Row]:
    """Lines that are there, all of this commit."""
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    others = {row["commit"] for row in rows} - {head}
    if others:
        raise SystemExit(f"{path} holds draws of commit {', '.join(sorted(others))}, not {head}")
    return rows


def kind(text: str) -> str:
    """A warning or a reason without its numbers and names."""
    text = re.sub(r"\b(posture|image|laser|left|right)\d[\w.-]*", "X", text)
    text = re.sub(r"\b(sheet|light sheet|source|line) [A-Z\d]\b", r"\1 #", text)
    text = re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)
    text = re.sub(r"(X[^,;:]*, )+", "X, ", text)
    return text[:96]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seed-first", type=int, default=500_000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", default=",".join(STAGES))
    parser.add_argument("--lines", type=Path, default=Path("random_instruments.jsonl"))
    parser.add_argument("--table", action="store_true")
    asked = parser.parse_args()
    head, stages = commit(), tuple(asked.only.split(","))
    if unknown := set(stages) - set(STAGES):
        raise SystemExit(f"no stage {', '.join(unknown)}; there are {', '.join(STAGES)}")
    if asked.table:
        rows = [json.loads(line) for line in asked.lines.read_text().splitlines()]
        print_tables(rows)
        return
    rows = read(asked.lines, head)
    done = {row["seed"] for row in rows}
    seeds = range(asked.seed_first, asked.seed_first + asked.draws)
    tasks = [(seed, stages) for seed in seeds if seed not in done]
    with Pool(asked.processes) as pool, asked.lines.open("a") as file:
        for number, row in enumerate(pool.imap_unordered(drawn, tasks), 1):
            rows.append(row)
            file.write(json.dumps({"commit": head, **row}) + "\n")
            file.flush()
            if number % 50 == 0:
                print(f"{number} of {len(tasks)}", flush=True)
    print_tables([row for row in rows if row["seed"] in seeds])


def print_tables(rows: list[Row]) -> None:
    """Outcomes, certainty, strata, reasons and warnings."""
    seeds = [row["seed"] for row in rows]
    print(f"{len(rows)} draws, seeds {min(seeds)} to {max(seeds)}, commit {rows[0].get('commit')}")
    print(f"{np.mean([row['seconds'] for row in rows]):.1f} core-seconds a draw")
    found: dict[str, list[tuple[Row, Row]]] = {}
    for row in rows:
        for outcome in row["outcomes"]:
            found.setdefault(outcome["stage"], []).append((row, outcome))
    print_outcomes(found, len(rows))
    print_strata(found)
    print_words(found)


def print_outcomes(found: dict[str, list[tuple[Row, Row]]], n_draws: int) -> None:
    """Counts and rates, chi2 over its degrees of freedom, stated sigma over the bound."""
    print(
        "\n| stage | judged | "
        + " | ".join(RESULTS)
        + " | chi2 / f | of the right | sigma / bound |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    whole: Counter[str] = Counter()
    for stage, pairs in found.items():
        count = Counter(outcome["result"] for _, outcome in pairs)
        whole += count
        cells = [
            f"{count[result]} ({100 * count[result] / len(pairs):.1f} %)" for result in RESULTS
        ]
        mean, right = certainty(pairs), certainty(_right(pairs))
        over = np.array([o["over_bound"] for _, o in pairs if o["over_bound"]], dtype=float)
        bound = f"{np.nanmedian(over):.2f}" if np.isfinite(over).any() else "-"
        granted = np.array([o.get("over_granted", np.nan) for _, o in pairs], dtype=float)
        if np.isfinite(granted).any():
            bound += f" ({np.nanmedian(granted):.2f})"
        print(f"| {stage} | {len(pairs)} | {' | '.join(cells)} | {mean} | {right} | {bound} |")
    few = [
        o for pairs in found.values() for _, o in pairs if o["reason"].startswith("few postures")
    ]
    print(f"rightly refused for fewer postures than the software asks for: {len(few)}")
    total = sum(whole.values())
    for result in RESULTS[2:]:
        n = sum(any(o["result"] == result for o in row) for row in _by_draw(found))
        share = f"{100 * whole[result] / total:.2f} % of {total} stages"
        print(f"{result}: {whole[result]} ({share}); in {n} of {n_draws} instruments")


def _by_draw(found: dict[str, list[tuple[Row, Row]]]) -> list[list[Row]]:
    draws: dict[int, list[Row]] = {}
    for pairs in found.values():
        for row, outcome in pairs:
            draws.setdefault(row["seed"], []).append(outcome)
    return list(draws.values())


def _right(pairs: list[tuple[Row, Row]]) -> list[tuple[Row, Row]]:
    return [pair for pair in pairs if pair[1]["result"] == "right"]


def certainty(pairs: list[tuple[Row, Row]]) -> str:
    """Mean chi2 over its degrees of freedom, with its standard error."""
    judged = [o for _, o in pairs if o["freedom"]]
    if not judged:
        return "-"
    square = np.array([o["chi2"] for o in judged])
    freedom = np.array([o["freedom"] for o in judged], dtype=float)
    mean = square.sum() / freedom.sum()
    error = np.sqrt(np.sum((square - mean * freedom) ** 2)) / freedom.sum()
    return f"{mean:.2f} +- {error:.2f}"


def print_strata(found: dict[str, list[tuple[Row, Row]]]) -> None:
    """Chi2 over its degrees of freedom in thirds of each stratum, of the right results.

    One result that is wrong would be all that its third shows; these are counted above.
    """
    stages = [s for s, pairs in found.items() if any(o["freedom"] for _, o in pairs)]
    print("\n| chi2 / f in thirds of | " + " | ".join(stages) + " |")
    print("|---|" + "---|" * len(stages))
    for name in next(iter(found.values()))[0][0]["strata"]:
        cells = []
        for stage in stages:
            pairs = [pair for pair in _right(found[stage]) if pair[1]["freedom"]]
            value = np.array([row["strata"][name] for row, _ in pairs])
            if not pairs:
                cells.append("-")
                continue
            low, high = np.quantile(value, [1 / 3, 2 / 3])
            parts = [value <= low, (value > low) & (value <= high), value > high]
            thirds = [
                certainty([pairs[k] for k in np.flatnonzero(part)]).split(" ")[0] for part in parts
            ]
            cells.append(" ".join(thirds))
        print(f"| {name} | " + " | ".join(cells) + " |")


def print_words(found: dict[str, list[tuple[Row, Row]]]) -> None:
    """Reasons of refusals, and warnings on sound and on degenerate instruments."""
    for result in RESULTS[1:]:
        print(f"\n{result}:")
        for stage, pairs in found.items():
            reasons: dict[str, list[int]] = {}
            for row, outcome in pairs:
                if outcome["result"] == result:
                    reasons.setdefault(kind(outcome["reason"]), []).append(row["seed"])
            for reason, seeds in sorted(reasons.items(), key=lambda item: -len(item[1])):
                first = ", ".join(map(str, seeds[:4]))
                print(f"  {stage}: {len(seeds)} x {reason} (seeds {first})")
    print("\nwarnings of results that are right (a warning of what is weak is no alarm):")
    for stage, pairs in found.items():
        right = [outcome for _, outcome in pairs if outcome["result"] == "right"]
        counted = Counter(text for o in right for text in {kind(w) for w in o["warnings"]})
        for text, n in counted.most_common(14):
            print(f"  {stage}: {100 * n / max(len(right), 1):.1f} % {text}")


if __name__ == "__main__":
    main()
