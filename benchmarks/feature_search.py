# SPDX-License-Identifier: Apache-2.0
"""How the search for features depends on its constants: each halved and doubled.

    python benchmarks/feature_search.py --scanner scanner.json --draws 2 --kept found.jsonl

Features are looked for by their nominal size in simulated parts: one of points strewn evenly
(bore 12 mm, boss 20, ball 16, cone 25 degrees), one of stripes far apart, traced through the twin's
arm, camera and light (bore 20, boss 16, ball 14); and in the first one with a twentieth of the
points and five times the noise. Right is a shape within 0.1 mm of the radius, 0.2
mm of the place and 1 degree of the half angle; the fit to all points comes after that. Of constants
that are cosines the angle is halved and doubled. What is done stands in ``--kept`` and is not done
again; told are, by constant and factor, how many were right and the processor time.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from armscan.devices.sources import load_driver
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import Shape
from armscan.inspection import search
from armscan.inspection.search import WantedFeature
from armscan.inspection.selection import select
from armscan.models.calibration import ScannerCalibration
from armscan.records.cloud import PointCloud
from armscan.storage.documents import read_scanner_calibration
from rigs import feature_clouds, traced_workpiece

COUNTS = ("N_SAMPLE", "N_NEIGHBOURS", "ALONG_STRIPE", "FACES", "SEED_POINTS", "NEAR_POINTS",
          "SIDE_POINTS", "N_POLISHED", "ROUNDS")  # fmt: skip
LENGTHS = ("THINNEST_LINE", "THICKEST_FACE", "THICKEST_STRIPE", "NOISE_BAND", "LEAST_BAND_MM",
           "RADIUS_SLACK", "FULLY_BENT", "SHELL_BANDS")  # fmt: skip
COSINES = ("SAME_SIDE", "SAME_FACE", "NEXT_FACE")
FACTORS = (0.5, 2.0)
NEAR_MM, PLACE_MM, NEAR_DEG = 0.1, 0.2, 1.0
FEW = 1500, 0.03
"""Points of the plate and noise in mm of the sparse cloud."""
Case = tuple[WantedFeature, float, FloatArray]
"""What is looked for, its true radius or half angle in degrees, and a true place of its middle."""


def varied(name: str, factor: float) -> dict[str, Any]:
    """Values of the search's constants that a variation sets."""
    value = getattr(search, name)
    if name == "N_TRIALS":
        return {name: {kind: max(1, int(n * factor)) for kind, n in value.items()}}
    if name in COSINES:
        cosine = math.cos(factor * math.acos(value))
        more = {"ACROSS": math.sqrt(1.0 - cosine**2)} if name == "SAME_SIDE" else {}
        return {name: cosine, **more}
    return {name: max(1, round(value * factor)) if name in COUNTS else value * factor}


@contextmanager
def set_to(values: dict[str, Any]) -> Iterator[None]:
    """The search with other constants."""
    before = {name: getattr(search, name) for name in values}
    for name, value in values.items():
        setattr(search, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(search, name, value)


def strewn(seed: int, n: int, noise_mm: float) -> tuple[PointCloud, list[Case]]:
    rig = feature_clouds
    places = [np.array([*at, z]) for at, z in ((rig.BORE_AT, -5.0), (rig.BOSS_AT, 6.0))]
    return rig.workpiece(seed, n=n, noise_mm=noise_mm), [
        (WantedFeature("cylinder", diameter_mm=rig.BORE_MM), rig.BORE_MM / 2, places[0]),
        (WantedFeature("cylinder", diameter_mm=rig.BOSS_MM), rig.BOSS_MM / 2, places[1]),
        (WantedFeature("sphere", diameter_mm=rig.BALL_MM), rig.BALL_MM / 2, rig.BALL_AT),
        (WantedFeature("cone", half_angle_deg=rig.CONE_DEG), rig.CONE_DEG,
         np.array([*rig.CONE_AT, 6.0])),
    ]  # fmt: skip


def striped(seed: int, document: ScannerCalibration) -> tuple[PointCloud, list[Case]]:
    rig = traced_workpiece
    twin = load_driver("twin")(head="thesis-single", preset="thesis", seed=seed)
    cloud, _, base_from_part = rig.scan_of(twin, document, seed)
    places = np.array([[*rig.BORE_AT, 2.0], [*rig.BOSS_AT, 13.0], rig.BALL_AT])
    bore, boss, ball = base_from_part.apply(places)
    return cloud, [
        (WantedFeature("cylinder", diameter_mm=rig.BORE_MM), rig.BORE_MM / 2, bore),
        (WantedFeature("cylinder", diameter_mm=rig.BOSS_MM), rig.BOSS_MM / 2, boss),
        (WantedFeature("sphere", diameter_mm=rig.BALL_MM), rig.BALL_MM / 2, ball),
    ]


def is_right(found: Shape | FitFailure, case: Case) -> bool:
    wanted, true, place = case
    if isinstance(found, FitFailure):
        return False
    offset = place - found.point_mm
    if wanted.kind != "sphere":
        offset = offset - (offset @ found.direction) * found.direction
    is_there = float(np.linalg.norm(offset)) <= PLACE_MM
    if wanted.kind == "cone":
        return is_there and abs(math.degrees(found.half_angle_rad) - true) <= NEAR_DEG
    return is_there and abs(found.radius_mm - true) <= NEAR_MM


def looked_for(cloud: PointCloud, cases: list[Case]) -> tuple[list[bool], float]:
    """Which were found, and the processor time."""
    start = time.process_time()
    sample = search.sample_of(select(cloud, None, None))
    right = [is_right(search.find_shape(sample, case[0]), case) for case in cases]
    return right, time.process_time() - start


def told(lines: list[dict[str, Any]]) -> str:
    """A row a constant: right and time, halved and doubled."""
    rows = [
        "| constant | as it is | halved: right, time | doubled: right, time |",
        "|---|---|---|---|",
    ]

    def cell(name: str, factor: float) -> str:
        own = [one for one in lines if (one["name"], one["factor"]) == (name, factor)]
        base = [one for one in lines if one["name"] == "" and
                any((one["part"], one["seed"]) == (k["part"], k["seed"]) for k in own)]  # fmt: skip
        right = [hit for one in own for hit in one["right"]]
        ratio = sum(one["s"] for one in own) / max(sum(one["s"] for one in base), 1e-9)
        return f"{sum(right)} of {len(right)}, {ratio:.1f}" if own else "-"

    for name in ("N_TRIALS", *COUNTS, *LENGTHS, *COSINES):
        value = getattr(search, name)
        shown = "all" if name == "N_TRIALS" else f"{value:g}"
        if name in COSINES:
            shown = f"{math.degrees(math.acos(value)):.0f} degrees"
        rows.append(f"| `{name}` | {shown} | {cell(name, 0.5)} | {cell(name, 2.0)} |")
    base = [one for one in lines if not one["name"]]
    hits = [hit for one in base for hit in one["right"]]
    spent = sum(one["s"] for one in base)
    return "\n".join([*rows, "", f"as they are: {sum(hits)} of {len(hits)} right, {spent:.0f} s"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scanner", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--first", type=int, default=7301)
    parser.add_argument("--kept", type=Path, required=True)
    given = parser.parse_args()
    document = read_scanner_calibration(given.scanner)
    lines = (
        [json.loads(k) for k in given.kept.read_text().split("\n") if k]
        if given.kept.exists()
        else []
    )
    done = {(one["name"], one["factor"], one["part"], one["seed"]) for one in lines}
    ways = [("", 1.0)] + [(name, factor) for name in ("N_TRIALS", *COUNTS, *LENGTHS, *COSINES)
                          for factor in FACTORS]  # fmt: skip
    for seed in range(given.first, given.first + given.draws):
        for part in ("strewn", "striped", "sparse"):
            if all((*way, part, seed) in done for way in ways):
                continue
            if part == "striped":
                cloud, cases = striped(seed, document)
            else:
                cloud, cases = strewn(seed, *((30_000, 0.006) if part == "strewn" else FEW))
            for name, factor in ways:
                if (name, factor, part, seed) in done:
                    continue
                with set_to(varied(name, factor) if name else {}):
                    right, spent = looked_for(cloud, cases)
                line = {"name": name, "factor": factor, "part": part, "seed": seed,
                        "right": right, "s": spent}  # fmt: skip
                lines.append(line)
                with given.kept.open("a") as file:
                    file.write(json.dumps(line) + "\n")
    print(told(lines))


if __name__ == "__main__":
    main()
