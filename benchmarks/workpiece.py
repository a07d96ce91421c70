# SPDX-License-Identifier: Apache-2.0
"""The twin's workpiece against its CAD model, over many scanners, command by command.

    python benchmarks/workpiece.py render  --seeds 20 --first 601 --folder DIR
    python benchmarks/workpiece.py measure --seeds 20 --first 601 --folder DIR
    python benchmarks/workpiece.py table   --folder DIR

``render`` draws a scanner a seed and writes its images, for calibration and of the part as it was
made: a bore 0.05 mm too large, a pad 0.08 mm too high. ``measure`` calibrates from them, makes the
cloud and compares it with the CAD model, laid on from the cloud alone; only then the truth is
looked at. Each step that is done is not done again; each seed measured is a line of
``DIR/measured.jsonl`` with the commit. Everything here is simulated.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from armscan.cli import main as armscan

HEAD, PRESET = "thesis-single", "thesis"
SCENES = ("camera", "laser", "hand-eye", "probing", "workpiece")


def run(*words: object) -> None:
    """One command; its failure ends the study with the seed's place."""
    if armscan([str(word) for word in words]) != 0:
        raise SystemExit(f"failed: armscan {' '.join(map(str, words))}")


def render(seed: int, folder: Path, processes: int) -> None:
    """All recordings of a seed that are not there yet."""
    for scene in SCENES:
        place = folder / str(seed) / scene
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            words = ("simulate", HEAD, scene, "-o", place, "--preset", PRESET, "--seed", seed)
            run(*words, "--processes", processes)


def main() -> None:
    """One of the three steps."""
    parser = argparse.ArgumentParser()
    parser.add_argument("step", choices=("render", "measure", "table"))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=601)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--folder", type=Path, required=True)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for seed in range(given.first, given.first + given.seeds):
        render(seed, given.folder, given.processes)


if __name__ == "__main__":
    main()
