# SPDX-License-Identifier: Apache-2.0
"""How far a hand-eye's certainty holds before the twin's arm, whose errors are its encoders'.

Features, no images: where each light sheet truly meets the plate, with a little noise, seen by an
exact sensor; the plate is probed by the same arm. `noise` has encoders that err new at each
reading, `arm` also those that err by where they stand, and bent axes. `claims` is the mean of
e' C^-1 e over 6 (1 is right), `inside` counts those in the stated 95 % region, `across` is the mean
square of the worst axis's shift over its variance.

    python benchmarks/hand_eye_arm.py --heads thesis-single thesis-multi --seeds 40 --first 3001
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import HandEyeOptions, PlateReference, PosedStripe
from armscan.calibration.hand_eye.probed_plate import fit_probed_plate
from armscan.devices.sources import Preset
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose
from armscan.models.arm import tip_centres, tool_from_probe
from armscan.records.points import ProbedPoints
from armscan.simulation.arm.arm import COMFORTABLE_RAD, MeasuringArm, reach
from armscan.simulation.instrument import probe_plate
from armscan.simulation.twin import SimulatedInstrument, build_twin

NOISE_MM, EVERY, MOST_SHEETS = 0.003, 20, 4
OPTIONS = HandEyeOptions(per_stripe=6)
REGION = float(chi2.ppf(0.95, 6))


def without_habits(arm: MeasuringArm) -> MeasuringArm:
    """The same arm with no errors but the noise of its encoders."""
    return replace(arm, nominal=arm.true, waves_rad=np.zeros_like(arm.waves_rad))


def probed(twin: SimulatedInstrument, arm: MeasuringArm, seed: int) -> PlateReference | FitFailure:
    """The plate as an arm touches it."""
    tools = twin.instrument
    rng = np.random.default_rng([seed, 1])
    touches = probe_plate(arm, tools.fixtures, tools.mechanics.probe, rng)
    tip = tool_from_probe(touches.tool_from_probe_mm)
    points = ProbedPoints(tip_centres(touches.arm, tip), touches.tip_diameter_mm)
    plate = fit_probed_plate(points, touches.arm.translations_mm)
    return plate if isinstance(plate, FitFailure) else plate.reference


Look = tuple[str, np.ndarray, np.ndarray, np.ndarray]
"""Posture, true joint angles (7,), true points (N, 3) in Sensor, sheet (N,) of each."""


def looks(twin: SimulatedInstrument) -> list[Look]:
    """What the left camera truly sees of the plate in each exposure."""
    scan, tools = twin.scan("hand-eye"), twin.instrument
    names = [laser.name for laser in tools.head.lasers]
    used = names[:: -(-len(names) // MOST_SHEETS)]
    sensor_from_tool, joints = tools.head.tool_from_sensor.inverse(), COMFORTABLE_RAD
    found = []
    for number, row in enumerate(scan.rows):
        if row.camera:
            continue
        joints = reach(tools.arm.true, scan.true_pose(number) @ sensor_from_tool, joints)
        seen = [one for one in scan.true_stripes(number) if one.sheet in used]
        points = [one.points_sensor_mm[::EVERY] for one in seen]
        sheet = np.repeat([names.index(one.sheet) for one in seen], [len(own) for own in points])
        found.append((row.view or str(number), joints, np.concatenate(points), sheet))
    return found


def posed(seen: list[Look], arm: MeasuringArm, rng: np.random.Generator) -> Iterator[PosedStripe]:
    """The looks with noise, and with the poses that an arm reports."""
    for number, (posture, joints, points, sheet) in enumerate(seen):
        rotations, places = arm.nominal.transforms(arm.readings(joints[None], rng))
        noise = np.zeros((len(points), 3, 1))
        noise[:, 2, 0] = NOISE_MM
        yield PosedStripe(
            source=f"{number}",
            posture=posture,
            base_from_tool=Pose(rotations[0], places[0]),
            points_mm=points + noise[:, :, 0] * rng.standard_normal((len(points), 1)),
            noise_mm=noise,
            sheet=sheet,
        )


def main() -> None:
    """Draw, calibrate, print a row of Markdown for each head and arm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--heads", nargs="+", default=["thesis-single", "thesis-multi"])
    parser.add_argument("--preset", default="thesis")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=3001)
    asked = parser.parse_args()
    preset: Preset = asked.preset
    print("| head | arm | solved | claims | inside | shift: rms error, stated (um) | across |")
    print("|---|---|---|---|---|---|---|")
    for head in asked.heads:
        results: dict[str, list[tuple[float, bool, np.ndarray, np.ndarray]]] = {
            "noise": [],
            "arm": [],
        }
        for seed in range(asked.first, asked.first + asked.seeds):
            twin = build_twin(head, preset, seed)
            seen = looks(twin)
            for kind, kept in results.items():
                own = twin.instrument.arm
                arm = own if kind == "arm" else without_habits(own)
                plate, rng = probed(twin, arm, seed), np.random.default_rng([seed, 2])
                if isinstance(plate, FitFailure):
                    print(f"{head} {seed} {kind}: no plate: {plate.reason}")
                    continue
                fit = calibrate_on_plate(list(posed(seen, arm, rng)), plate, OPTIONS)
                if isinstance(fit, FitFailure):
                    print(f"{head} {seed} {kind}: refused: {fit.reason}")
                    continue
                found = fit.calibration
                step = found.tool_from_sensor.step_from(twin.truth.tool_from_sensor)
                square = float(step @ np.linalg.solve(found.covariance, step))
                limit = REGION * found.diagnostics.region_factor if found.diagnostics else REGION
                kept.append((square / 6.0, square < limit, step, np.diag(found.covariance)))
        for kind, kept in results.items():
            if not kept:
                continue
            claims, inside, steps, variances = (np.array(own) for own in zip(*kept, strict=True))
            shift, stated = steps[:, 3:] ** 2, variances[:, 3:]
            print(
                f"| {head} | {kind} | {len(kept)} of {asked.seeds} | {claims.mean():.2f} ± "
                f"{claims.std() / np.sqrt(len(claims)):.2f} | {100.0 * inside.mean():.1f} % | "
                f"{1e3 * np.sqrt(shift.sum(axis=1).mean()):.1f}, "
                f"{1e3 * np.sqrt(stated.sum(axis=1).mean()):.1f} | "
                f"{(shift / stated).mean(axis=0).max():.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
