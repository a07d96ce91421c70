# SPDX-License-Identifier: Apache-2.0
"""The twin's workpiece against its CAD model, over many scanners, command by command.

    python benchmarks/workpiece.py render  --seeds 20 --first 601 --folder DIR
    python benchmarks/workpiece.py measure --seeds 20 --first 601 --folder DIR
    python benchmarks/workpiece.py table   --folder DIR

``render`` draws a scanner a seed and writes its images, for calibration and of the part as it was
made: a bore 0.05 mm too large, a pad 0.08 mm too high. ``measure`` calibrates from them, makes the
cloud and compares it with the CAD model, laid on from the cloud alone; only then the truth is
looked at. Each step that is done is not done again; each seed measured is a line of
``DIR/measured.jsonl`` with the commit. ``measure --keep-clouds`` compares clouds that are there.
Everything here is simulated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from armscan.cli import main as armscan
from armscan.devices.sources import load_driver
from armscan.geometry.features import Shape, fit_shape
from armscan.inspection.cad.alignment import Alignment, align_best, fit_to_part
from armscan.inspection.cad.comparison import CadOptions, compare_with_part
from armscan.inspection.cad.distance import PartSurface
from armscan.jobs.job import solved
from armscan.records.cloud import PointCloud
from armscan.storage.clouds import read_cloud
from armscan.storage.parts.meshes import read_part

HEAD, PRESET = "thesis-single", "thesis"
SCENES = ("camera", "laser", "hand-eye", "probing", "workpiece")
TARGET = "circle-grid:11x9:3.75"
PAD, BORE = "plane 3", "cylinder 19"
MADE_MM = {PAD: 0.08, BORE: -0.0243}
"""Deviation of each face as it was made: outside is positive, and a larger bore lies inside."""
BORE_MM = 20.0487
"""Diameter of the bore as it was made: 20.05 mm over the corners of its 223 facets, whose middles
lie 0.001 mm nearer to the axis."""
NOMINAL_BORE = Shape(
    kind="cylinder", point_mm=np.array([-18.0, 12.0, 7.0]), axes=np.eye(3), radius_mm=10.0
)
TOLERANCE_MM, BORE_TOLERANCE_MM = 0.05, 0.015


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


def scanned(place: Path, *, is_kept: bool) -> Path:
    """The cloud of a seed, calibrated and reconstructed anew unless one is there and kept."""
    if is_kept and (place / "cloud.ply").is_file():
        return place / "cloud.ply"
    names = ("camera.json", "sensor.json", "plate.csv", "scanner.json", "cloud.ply")
    camera, sensor, plate, scanner, cloud = (place / name for name in names)
    anew = ("--force",)
    run("calibrate", "camera", "--scan", place / "camera", "--target", TARGET, "-o", camera, *anew)
    words = ("calibrate", "laser", "--scan", place / "laser", "--camera", camera)
    run(*words, "--target", TARGET, "-o", sensor, *anew)
    run("probe", place / "probing", "-o", plate, *anew)
    words = ("calibrate", "hand-eye", place / "hand-eye", "--sensor", sensor, "--plate", plate)
    run(*words, "-o", scanner, *anew)
    run("reconstruct", place / "workpiece", "--scanner", scanner, "-o", cloud, *anew)
    return cloud


def measured(seed: int, place: Path, *, is_kept: bool = False) -> dict[str, Any]:
    """What a seed's scan says of the part, and then how far that is from the truth."""
    cloud = read_cloud(scanned(place, is_kept=is_kept))
    model = Path(str(files("armscan.simulation"))) / "workpiece" / "workpiece.step"
    part = read_part(model)
    surface = PartSurface(part)
    alignment = solved(align_best(surface, cloud, True))
    options = CadOptions(tolerance_mm=TOLERANCE_MM, face_tolerances_mm={BORE: BORE_TOLERANCE_MM})
    found = solved(compare_with_part(surface, cloud, alignment, options, True))
    on_bore = (found.face == part.face_names.index(BORE)) & ~found.is_beside_edge
    bore = solved(fit_shape("cylinder", found.points_mm[on_bore], NOMINAL_BORE)).value
    faces = {
        one.name: {
            "n": one.statistics.n,
            "mean_mm": one.statistics.mean_mm,
            "u_mm": one.u_mean_mm,
            "decision": one.decision,
        }
        for one in found.faces
    }
    return {
        "seed": seed,
        "faces": faces,
        "bore_mm": 2.0 * bore.radius_mm,
        **_beside_truth(seed, cloud.points_mm, alignment),
        **_beside_as_made(cloud, alignment),
    }


def _beside_as_made(cloud: PointCloud, alignment: Alignment) -> dict[str, float]:
    """The alignment beside the best fit of the same cloud on the surface as it was made.

    What the calibration shifts the whole cloud by is in both, and not in their difference.
    """
    made = Path(str(files("armscan.simulation"))) / "workpiece" / "as_made.stl"
    best = fit_to_part(PartSurface(read_part(made)), cloud, alignment.cad_from_part, True)
    error = alignment.cad_from_part @ best.cad_from_part.inverse()
    middle = np.array([[0.0, 0.0, 10.0]])
    return {
        "own_shift_mm": float(np.linalg.norm(error.apply(middle) - middle)),
        "own_turn_deg": float(np.degrees(np.linalg.norm(error.rotation_vector_rad))),
    }


def _beside_truth(seed: int, points_mm: Any, alignment: Any) -> dict[str, float]:
    truth = load_driver("twin")(head=HEAD, preset=PRESET, seed=seed).truth
    away = truth.workpiece_distance_mm(points_mm)
    error = alignment.cad_from_part @ truth.base_from_workpiece
    middle = np.array([0.0, 0.0, 10.0])
    cosine = np.clip(0.5 * (np.trace(error.rotation) - 1.0), -1.0, 1.0)
    sine = 0.5 * np.linalg.norm(error.rotation - error.rotation.T) / np.sqrt(2.0)
    return {
        "percent_within_50_um": 100.0 * float(np.mean(away <= 0.05)),
        "shift_mm": float(np.linalg.norm(error.apply(middle) - middle)),
        "turn_deg": float(np.degrees(np.arctan2(sine, cosine))),
    }


def table(lines: list[dict[str, Any]]) -> str:
    """Markdown: median, 95th percentile and worst of each figure, and wrong decisions."""
    rows = ["| figure, simulated | median | 95 % | worst |", "|---|---|---|---|"]

    def row(name: str, values: list[float], digits: int = 4, *, is_most: bool = True) -> None:
        v = np.array(values)
        high = np.percentile(v, 95.0 if is_most else 5.0)
        worst = v.max() if is_most else v.min()
        rows.append(
            f"| {name} | {np.median(v):.{digits}f} | {high:.{digits}f} | {worst:.{digits}f} |"
        )

    row("alignment, shift at the part's middle, mm", [one["shift_mm"] for one in lines])
    row("alignment, turn, degrees", [one["turn_deg"] for one in lines])
    row("alignment beside the surface as made, shift, mm", [one["own_shift_mm"] for one in lines])
    row("the same, turn, degrees", [one["own_turn_deg"] for one in lines])
    within = [one["percent_within_50_um"] for one in lines]
    row("points within 0.05 mm of the surface as made, %", within, 2, is_most=False)
    seen = [
        (name, face)
        for one in lines
        for name, face in one["faces"].items()
        if face["decision"] != "not seen"
    ]
    off = [abs(face["mean_mm"] - MADE_MM.get(name, 0.0)) for name, face in seen]
    row("mean of a face against the face as made, mm", off)
    row("diameter of the bore, error, mm", [abs(one["bore_mm"] - BORE_MM) for one in lines])
    row("pad, error of its height, mm", [abs(f["mean_mm"] - 0.08) for n, f in seen if n == PAD])
    held = sum(abs(f["mean_mm"] - MADE_MM.get(n, 0.0)) <= f["u_mm"] for n, f in seen)
    called = {
        name: sum(one["faces"][name]["decision"] == "fail" for one in lines) for name in MADE_MM
    }
    wrong = [
        f"{one['seed']}: {name} {face['decision']}"
        for one in lines
        for name, face in one["faces"].items()
        if name not in MADE_MM and face["decision"] not in ("pass", "not seen")
    ]
    commits = ", ".join(sorted({one["commit"] for one in lines}))
    n_other = len(seen) - len(MADE_MM) * len(lines)
    rows += [
        "",
        f"{len(lines)} seeds, commit {commits}. {held} of {len(seen)} face means hold the truth "
        f"within their U. Called wrong: pad {called[PAD]}, bore {called[BORE]} of {len(lines)}; "
        f"other faces not passed: {len(wrong)} of {n_other}, of which failed "
        f"{sum(text.endswith('fail') for text in wrong)}"
        + (f" ({'; '.join(wrong)})." if wrong else "."),
    ]
    return "\n".join(rows)


def main() -> None:
    """One of the three steps."""
    parser = argparse.ArgumentParser()
    parser.add_argument("step", choices=("render", "measure", "table"))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=601)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--keep-clouds", action="store_true")
    parser.add_argument("--folder", type=Path, required=True)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    kept = given.folder / "measured.jsonl"
    lines = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    if given.step == "table":
        print(table(lines))
        return
    words = ("git", "rev-parse", "--short", "HEAD")
    commit = subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip()
    if given.step == "measure" and any(one["commit"] != commit for one in lines):
        raise SystemExit(f"{kept} holds lines of another commit than {commit}: name a new folder")
    done = {one["seed"] for one in lines}
    for seed in range(given.first, given.first + given.seeds):
        if given.step == "render":
            render(seed, given.folder, given.processes)
        elif seed not in done:
            place = given.folder / str(seed)
            line = {"commit": commit, **measured(seed, place, is_kept=given.keep_clouds)}
            with kept.open("a") as file:
                file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
