# SPDX-License-Identifier: Apache-2.0
"""How often U (k = 2) of diameters, distances and steps holds the truth.

    python benchmarks/feature_coverage.py --draws 100
    python benchmarks/feature_coverage.py --draws 100 --twin scanner.json

Each draw scans a workpiece with a bore, a boss, a ball and a step anew: six strokes that err as a
whole by 0.008 mm an axis, points that err by 0.006 mm along their normals. Points are simulated,
no images; those of a feature are known, so that its fit and U alone are tried. Told are how many
draws held the truth, the scatter of the error over the sigma stated, the median U, and what 95 %
of the errors stay below.

With ``--twin`` each draw is another instrument (preset `thesis`): arm, hand, camera and light are
those of the simulator, whose errors are none of the model that U rests on; the calibration errs
by as much as that of the scanner named (of the head `thesis-single`) says. Stripes err by 0.07 px.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from armscan.devices.sources import load_driver
from armscan.geometry.arrays import IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import ShapeKind
from armscan.inspection.conformity import COVERAGE
from armscan.inspection.features import FeatureInspection, inspect_points, relate
from armscan.inspection.results import MeasuredLength
from armscan.inspection.search import WantedFeature
from armscan.inspection.step import inspect_step
from armscan.models.calibration import ScannerCalibration
from armscan.records.cloud import PointCloud
from armscan.storage.documents import read_scanner_calibration
from rigs import feature_clouds as rig
from rigs import traced_workpiece
from rigs.inspection_clouds import cloud_of

NEAR_MM = 0.3
"""Points this near to a shape, and so far from its ends, are its own."""
STEP_MM, STROKES = 5.0, 6
LEAST_POINTS = 50


def of_shape(cloud: PointCloud, kind: str) -> FeatureInspection:
    """The bore, boss or ball, fitted to its own points; rows are of the whole cloud."""
    p = cloud.points_mm
    name: ShapeKind
    if kind == "ball":
        off = np.linalg.norm(p - rig.BALL_AT, axis=1) - rig.BALL_MM / 2
        own, name = (np.abs(off) < NEAR_MM) & (p[:, 2] > 2.0), "sphere"
    else:
        at, size, low, high = {
            "bore": (rig.BORE_AT, rig.BORE_MM, -10.0, -NEAR_MM),
            "boss": (rig.BOSS_AT, rig.BOSS_MM, NEAR_MM, 12.0),
        }[kind]
        off = np.linalg.norm(p[:, :2] - at, axis=1) - size / 2
        own = (np.abs(off) < NEAR_MM) & (p[:, 2] > low) & (p[:, 2] < high)
        name = "cylinder"
    rows = np.flatnonzero(own)
    found = inspect_points(cloud.select(rows), WantedFeature(kind=name), f"of the {kind}")
    if isinstance(found, FitFailure):
        raise SystemExit(f"{kind}: {found.reason}")
    return found


def step_cloud(seed: int) -> PointCloud:
    """Two flats of 30 x 40 mm, one 5 mm above the other, in strokes across both."""
    rng = np.random.default_rng(seed)
    n = 24_000
    points = np.column_stack([rng.uniform(0, 60, n), rng.uniform(0, 40, n), np.zeros(n)])
    points[:, 2] = STEP_MM * (points[:, 0] > 30.0)
    stroke = np.minimum(points[:, 1] / 40.0 * STROKES, STROKES - 1).astype(np.int64)
    exposure = np.minimum(points[:, 1] / 40.0 * STROKES * 8, STROKES * 8 - 1).astype(np.int64)
    # a stroke errs by a shift, an exposure of it by a lean of its own: of the arm's pose
    lean = rng.normal(0.0, 0.008 / 30.0, STROKES * 8)[exposure] * (points[:, 0] - 30.0)
    points += rng.normal(0.0, 0.008, (STROKES, 3))[stroke]
    points[:, 2] += lean + rng.normal(0.0, 0.006, n)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    return cloud_of(points, exposure, sigma_mm=0.008, noise_mm=0.006, noise_along=up)


def measured(seed: int) -> Iterator[tuple[str, MeasuredLength, float]]:
    """Name, measured and true value of one draw."""
    cloud = rig.workpiece(seed, n=12_000)
    for kind, true in (("bore", rig.BORE_MM), ("boss", rig.BOSS_MM), ("ball", rig.BALL_MM)):
        found = of_shape(cloud, kind)
        if found.diameter is not None:
            yield f"diameter of the {kind}", found.diameter, true
    both = distance(cloud)
    if both is not None:
        yield "distance of bore and boss", both, float(np.linalg.norm(rig.BOSS_AT - rig.BORE_AT))
    step = inspect_step(step_cloud(seed), STEP_MM)
    if isinstance(step, FitFailure):
        raise SystemExit(step.reason)
    yield "step", step.height, STEP_MM


def distance(cloud: PointCloud) -> MeasuredLength | None:
    """Of the axes of bore and boss, in one cloud of both."""
    p = cloud.points_mm
    own = {}
    for kind, at, size in (("bore", rig.BORE_AT, rig.BORE_MM), ("boss", rig.BOSS_AT, rig.BOSS_MM)):
        off = np.linalg.norm(p[:, :2] - at, axis=1) - size / 2
        own[kind] = (np.abs(off) < NEAR_MM) & (np.abs(p[:, 2]) > NEAR_MM)
    fits = []
    for kind in ("bore", "boss"):
        rows = np.flatnonzero(own[kind])
        found = inspect_points(cloud.select(rows), WantedFeature(kind="cylinder"), "known")
        if isinstance(found, FitFailure):
            raise SystemExit(found.reason)
        fits.append(replace(found, rows=rows[found.rows]))
    return relate(cloud, fits[0], fits[1]).distance


def scanned(document: ScannerCalibration, seed: int) -> Iterator[tuple[str, MeasuredLength, float]]:
    """Name, measured and true value of one scan by another twin."""
    twin = load_driver("twin")(head="thesis-single", preset="thesis", seed=seed)
    cloud, what, base_from_part = traced_workpiece.scan_of(twin, document, seed)
    z = base_from_part.inverse().apply(cloud.points_mm)[:, 2]
    away = np.ones(len(z), dtype=np.bool_)
    for level in (traced_workpiece.PLATE_MM, traced_workpiece.BOSS_END_MM):
        away &= np.abs(z - level) > NEAR_MM
    found: dict[str, FeatureInspection] = {}
    shapes: tuple[tuple[str, ShapeKind, float], ...] = (
        ("bore", "cylinder", traced_workpiece.BORE_MM),
        ("boss", "cylinder", traced_workpiece.BOSS_MM),
        ("ball", "sphere", traced_workpiece.BALL_MM),
    )
    for name, kind, true in shapes:
        one = fitted(
            cloud, np.flatnonzero((what == traced_workpiece.NAMES.index(name)) & away), kind
        )
        if one is not None and one.diameter is not None:
            found[name] = one
            yield f"diameter of the {name}", one.diameter, true
    if "ball" in found and "boss" in found:
        apart = relate(cloud, found["ball"], found["boss"]).distance
        offset = traced_workpiece.BALL_AT[:2] - traced_workpiece.BOSS_AT
        if apart is not None:
            yield "distance of ball and boss", apart, float(np.linalg.norm(offset))
    flat = np.flatnonzero(what < 2)
    height = traced_workpiece.PAD_MM - traced_workpiece.PLATE_MM
    step = inspect_step(cloud.select(flat), height)
    if isinstance(step, FitFailure):
        raise SystemExit(step.reason)
    yield "step", step.height, height


def fitted(cloud: PointCloud, rows: IntArray, kind: ShapeKind) -> FeatureInspection | None:
    """A shape fitted to its own points, rows of the whole cloud; None of too few."""
    if len(rows) < LEAST_POINTS:
        return None
    found = inspect_points(cloud.select(rows), WantedFeature(kind=kind), "known")
    return None if isinstance(found, FitFailure) else replace(found, rows=rows[found.rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--twin", type=Path)
    given = parser.parse_args()
    draw = measured
    if given.twin is not None:
        draw = partial(scanned, read_scanner_calibration(given.twin))
    errors: dict[str, list[tuple[float, float]]] = {}
    for seed in range(given.first, given.first + given.draws):
        for name, value, true in draw(seed):
            errors.setdefault(name, []).append((value.value_mm - true, value.sigma_mm))
    print(f"seeds {given.first} to {given.first + given.draws - 1}")
    columns = ("U holds the truth", "error rms / sigma", "median U, mm", "error, 95 %, mm")
    print(f"| quantity, simulated | {' | '.join(columns)} |")
    print("|---|---|---|---|---|")
    for name, pairs in errors.items():
        error, sigma = np.array(pairs).T
        held = int((np.abs(error) <= COVERAGE * sigma).sum())
        ratio = float(np.sqrt(np.mean((error / sigma) ** 2)))
        u = COVERAGE * float(np.median(sigma))
        most = float(np.percentile(np.abs(error), 95.0))
        print(f"| {name} | {held} of {len(error)} | {ratio:.2f} | {u:.4f} | {most:.4f} |")


if __name__ == "__main__":
    main()
