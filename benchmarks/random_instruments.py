# SPDX-License-Identifier: Apache-2.0
"""Scanners drawn at random, through every calibration and the naming of lines, without images.

    python benchmarks/random_instruments.py [--draws 2000] [--seed-first 500000] [--processes 2]
                                            [--only STAGES] [--lines FILE] [--table]

Each draw (`rigs.instruments`) has a field of 20 to 400 mm, a stand-off of 60 to 600 mm and all else
of its own; about one in eight cannot be calibrated, by construction. Every stage ends as right
(the joint error and that of each group of parameters within four of their own sigma), wrong,
rightly refused (degenerate by construction, or beyond the limit at which the software says that it
refuses: of cameras the Cramer-Rao bound, of hand-eyes the bound or the drawn arm, and the reason
must say so), refused for a line that fewer than two boards show, or wrongly refused. The tables
(`rigs.instrument_tables`) tell what is wrong and was warned of from what is silently wrong.

A line of JSON a draw is added to FILE, with the commit and the stages: a study that was stopped
goes on where it was; lines of another commit or of other stages are refused, and so is a tree with
changes. ``--table`` prints the tables of what is there.
``--only`` takes some of camera, sheet, stereo, handeye, naming; a stage runs what it rests on.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from multiprocessing import Pool
from pathlib import Path

import cv2
import numpy as np
from heads import commit_of_tree

from armscan.models.calibration import SensorCalibration
from rigs.instrument_arm import run_hand_eye
from rigs.instrument_naming import run_naming
from rigs.instrument_stages import Outcome, SheetResult, run_camera, run_sheets
from rigs.instrument_stereo import run_stereo
from rigs.instrument_tables import Row, print_tables
from rigs.instruments import Instrument, draw_instrument
from rigs.sheet_rig import PROVENANCE

STAGES = ("camera", "sheet", "stereo", "handeye", "naming")


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
        "stages": list(stages),
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


def read(path: Path, head: str, stages: tuple[str, ...]) -> list[Row]:
    """Lines that are there, all of this commit and of these stages."""
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    others = {row["commit"] for row in rows} - {head}
    if others:
        raise SystemExit(f"{path} holds draws of commit {', '.join(sorted(others))}, not {head}")
    ran = {",".join(sorted(row["stages"])) for row in rows} - {",".join(sorted(stages))}
    if ran:
        raise SystemExit(f"{path} holds draws of the stages {'; '.join(sorted(ran))}")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seed-first", type=int, default=500_000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", default=",".join(STAGES))
    parser.add_argument("--lines", type=Path, default=Path("random_instruments.jsonl"))
    parser.add_argument("--table", action="store_true")
    asked = parser.parse_args()
    stages = tuple(dict.fromkeys(asked.only.split(",")))
    if unknown := set(stages) - set(STAGES):
        raise SystemExit(f"no stage {', '.join(unknown)}; there are {', '.join(STAGES)}")
    if asked.table:
        rows = [json.loads(line) for line in asked.lines.read_text().splitlines()]
        print_tables(rows)
        return
    head = commit_of_tree()
    rows = read(asked.lines, head, stages)
    done = {row["seed"] for row in rows}
    seeds = range(asked.seed_first, asked.seed_first + asked.draws)
    tasks = [(seed, stages) for seed in seeds if seed not in done]
    with Pool(asked.processes) as pool, asked.lines.open("a") as file:
        for number, row in enumerate(pool.imap_unordered(drawn, tasks), 1):
            rows.append({"commit": head, **row})
            file.write(json.dumps(rows[-1]) + "\n")
            file.flush()
            if number % 50 == 0:
                print(f"{number} of {len(tasks)}", flush=True)
    print_tables([row for row in rows if row["seed"] in seeds])


if __name__ == "__main__":
    main()
