# SPDX-License-Identifier: Apache-2.0
"""Does the hand-eye's search find the least minimum? Random posture sets against brute force.

    python benchmarks/hand_eye_minima.py [--sets 125] [--starts 300] [--seed 1] [--only plate]
        [--search-only]

Plate and sphere, from points without images, each with sets of postures as arms and robots take
them: varied, hardly turned (some degrees, one axis at a time), tilted about one axis only, and four
to six postures. The arm errs by 0.02 to 0.2 mm. Brute force descends from random rotations and from
the truth; a set is found if what the search leaves (plain sum of squares) exceeds what brute force
leaves by less than one per cent. "Refused" counts the sets for which the calibration as a whole
returns no hand-eye, "wrong" those with a hand-eye more than 5 degrees off.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate, calibrate_on_sphere
from armscan.calibration.hand_eye.observations import (
    condense_plate,
    find_sections,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.search import (
    descend_all,
    many_placed,
    minima_on_plate,
    minima_on_sphere,
    place_sections,
    unit_steps,
)
from armscan.calibration.hand_eye.surface import PlateSurface
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from rigs.plate_rig import TOOL_FROM_SENSOR, PlateRig, Postures, RigNoise
from rigs.sphere_rig import CENTRE_MM, DIAMETER_MM, HAND_EYE, SphereRig

KINDS = ("varied", "hardly turned", "one axis", "four to six")
FOUND = 1.01
WRONG_DEG = 5.0
STEPS = 60
SKIPPED = FitFailure("not asked for", "leave out --search-only")


def turns_of(kind: str, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, 3) rotation vectors of a kind of postures."""
    if kind == "hardly turned":
        turns = np.zeros((count, 3))
        rows = np.arange(count // 3, count)
        turns[rows, rng.integers(0, 3, len(rows))] = rng.uniform(-0.25, 0.25, len(rows))
        return turns + rng.normal(0.0, 1e-4, turns.shape)
    if kind == "one axis":
        axis = rng.normal(size=3)
        return np.outer(rng.uniform(-0.7, 0.7, count), axis / np.linalg.norm(axis))
    return np.asarray(rng.uniform(-0.7, 0.7, (count, 3)))


def sphere_set(
    kind: str, rng: np.random.Generator, starts: int, is_whole: bool
) -> tuple[float, float, HandEyeFit | FitFailure]:
    """Sum of squares of search and brute force, and the calibration."""
    count = int(rng.integers(4, 7) if kind == "four to six" else rng.integers(7, 16))
    rig = SphereRig(pose_noise_mm=float(10.0 ** rng.uniform(-1.7, -0.7)), point_noise_mm=0.01,
                    n_points=60)  # fmt: skip
    least = rng.choice([-20.0, 2.0])
    poses = [
        rig.base_from_tool(
            turn, rng.uniform(least, 20.0), rng.uniform(-8.0, 8.0), rng.uniform(-12.0, 12.0)
        )
        for turn in turns_of(kind, count, rng)
    ]
    stripes = rig.stripes(poses, rng)
    sections, _ = find_sections(stripes, 0.5 * DIAMETER_MM)
    place, _ = place_sections(sections, 0.5 * DIAMETER_MM)
    states = minima_on_sphere(sections, 0.5 * DIAMETER_MM)
    rotations = np.array([state.tool_from_sensor.rotation for state in states])
    others = np.array([[*s.tool_from_sensor.translation_mm, *s.surface[:3]] for s in states])
    scale = np.array([0.007] * 3 + [1.0] * 6)
    ours = descend_all(place, rotations, others, STEPS, scale)[2].min()
    random = Rotation.random(starts, rng=rng).as_matrix()
    truth = np.concatenate([HAND_EYE.translation_mm, CENTRE_MM])
    far = truth + rng.normal(0.0, 100.0, (starts, 6))
    random[0], far[0] = HAND_EYE.rotation, truth
    brute = descend_all(place, random, far, STEPS, scale)[2].min()
    return (
        float(ours),
        float(brute),
        calibrate_on_sphere(stripes, DIAMETER_MM) if is_whole else SKIPPED,
    )


def plate_set(
    kind: str, rng: np.random.Generator, starts: int, is_whole: bool
) -> tuple[float, float, HandEyeFit | FitFailure]:
    """The same on the plate."""
    count = int(rng.integers(4, 7) if kind == "four to six" else rng.integers(7, 16))
    tilt, azimuth = rng.uniform(0.1, 0.7, count), rng.uniform(0.0, 2.0 * np.pi, count)
    roll = rng.uniform(-3.0, 3.0, count)
    if kind == "hardly turned":
        tilt, roll = rng.uniform(0.0, 0.2, count), rng.uniform(-0.2, 0.2, count)
    if kind == "one axis":
        tilt, azimuth, roll = rng.uniform(-0.7, 0.7, count), np.full(count, 1.0), np.zeros(count)
    postures = Postures(tilt, azimuth, roll, rng.uniform(120.0, 160.0, count),
                        rng.uniform(-80.0, 80.0, (count, 2)))  # fmt: skip
    noise = RigNoise(posture_mm=float(10.0 ** rng.uniform(-1.7, -0.7)))
    noise = replace(noise, posture_rad=noise.posture_mm / 265.0)
    rig = PlateRig(postures, noise, points_per_stripe=60)
    stripes, plate = rig.draw(int(rng.integers(1 << 30)))
    nodes = condense_plate(stripes, straight_stripes(stripes), 3)
    surface, scale = PlateSurface(plate), unit_steps(nodes.points_mm, 3)
    poses = nodes.rotations[nodes.stripe], nodes.translations_mm[nodes.stripe]
    place = many_placed(nodes.points_mm, *poses, surface)
    found = minima_on_plate(nodes, surface)
    rotations = np.array([pose.rotation for pose in found])
    shifts = np.array([pose.translation_mm for pose in found])
    ours = descend_all(place, rotations, shifts, STEPS, scale)[2].min()
    random = Rotation.random(starts, rng=rng).as_matrix()
    far = TOOL_FROM_SENSOR.translation_mm + rng.normal(0.0, 100.0, (starts, 3))
    random[0], far[0] = TOOL_FROM_SENSOR.rotation, TOOL_FROM_SENSOR.translation_mm
    brute = descend_all(place, random, far, STEPS, scale)[2].min()
    return float(ours), float(brute), calibrate_on_plate(stripes, plate) if is_whole else SKIPPED


def apart_deg(fit: HandEyeFit, truth: Pose[Tool, Sensor]) -> float:
    turn = fit.calibration.tool_from_sensor.rotation.T @ truth.rotation
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())))


def main() -> None:
    parser = argparse.ArgumentParser(description="the least minimum of the hand-eye")
    parser.add_argument("--sets", type=int, default=125, help="of each kind")
    parser.add_argument("--only", default="", help="reference and kind that hold this")
    parser.add_argument("--search-only", action="store_true", help="no calibration")
    parser.add_argument("--starts", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    begun = time.perf_counter()
    print("reference  kind            sets  found  returned  refused  wrong", flush=True)
    for reference, one_set, truth in (
        ("sphere", sphere_set, HAND_EYE),
        ("plate", plate_set, TOOL_FROM_SENSOR),
    ):
        for number, kind in enumerate(KINDS):
            if given.only not in f"{reference} {kind}":
                continue
            n_found, n_fits, n_wrong = 0, 0, 0
            for k in range(given.sets):
                rng = np.random.default_rng([given.seed, number, k])
                ours, brute, fit = one_set(kind, rng, given.starts, not given.search_only)
                n_found += ours <= FOUND * brute + 1e-9
                if not ours <= FOUND * brute + 1e-9:
                    print(f"  set {k}: {ours:.3g} where brute force leaves {brute:.3g}")
                if isinstance(fit, HandEyeFit):
                    n_fits += 1
                    if apart_deg(fit, truth) > WRONG_DEG:
                        n_wrong += 1
                        print(f"  set {k}: {apart_deg(fit, truth):.1f} deg off")
            calibrated = f"{n_fits:9d} {given.sets - n_fits:8d} {n_wrong:6d}"
            print(
                f"{reference:9s}  {kind:14s} {given.sets:5d} {n_found:6d} "
                + ("" if given.search_only else calibrated),
                flush=True,
            )
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
