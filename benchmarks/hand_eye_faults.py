# SPDX-License-Identifier: Apache-2.0
"""Faults put into hand-eye calibrations on a plate: named, refused, warned of, or silent.

    python benchmarks/hand_eye_faults.py [--runs 10] [--clean 100] [--seed 1]

Stripes are simulated from points, without images: 12 postures, an arm of 0.005 mm and plates as
probed in `plate_rig`, a light sheet that rises by 0.2 mm. *Effect* is the hand-eye's largest error
in its own standard deviations as they would be without the fault. A refusal or warning *names* the
fault if it holds one of the words beside it. A run whose effect is below three sigmas and that is
let pass counts as harmless, not as silent.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import euler_from_rotations, rotations_from_euler
from armscan.geometry.shapes import Plane
from rigs.plate_rig import PLATE_CENTRE, PLATE_NORMAL, TOOL_FROM_SENSOR, PlateRig, RigNoise
from rigs.plate_rig import good_postures as postures_of

N = 12
FORM_MM = 0.2
HARM_SIGMAS = 3.0
Stripes = list[PosedStripe]
Fault = Callable[[PlateRig, Stripes, PlateReference], tuple[Stripes, PlateReference]]


@dataclass(frozen=True)
class Row:
    """A fault, and the words that name it."""

    name: str
    words: tuple[str, ...]
    put_in: Fault


def reposed(
    stripes: Stripes, change: Callable[[int, Pose[Base, Tool]], Pose[Base, Tool]]
) -> Stripes:
    """Poses that are reported otherwise."""
    return [replace(s, base_from_tool=change(k, s.base_from_tool)) for k, s in enumerate(stripes)]


def moved(pose: Pose[Base, Tool], shift: FloatArray, tilt_deg: float = 0.0) -> Pose[Base, Tool]:
    """A pose in a Base that moved, tilted about a line through the plate."""
    turn = Rotation.from_rotvec([np.radians(tilt_deg), 0.0, 0.0]).as_matrix()
    place = turn @ (pose.translation_mm - PLATE_CENTRE) + PLATE_CENTRE + shift
    return Pose(turn @ pose.rotation, place)


def plate_moved(shift_mm: float, tilt_deg: float) -> Fault:
    turn = Rotation.from_rotvec([np.radians(tilt_deg), 0.0, 0.0]).as_matrix()

    def put_in(
        rig: PlateRig, stripes: Stripes, plate: PlateReference
    ) -> tuple[Stripes, PlateReference]:
        plane = plate.plane
        there = Plane(plane.point_mm + shift_mm * plane.normal, plane.axes @ turn.T)
        return stripes, replace(plate, plane=there)

    return put_in


def half_moved(shift_mm: float, tilt_deg: float, first: int = N // 2) -> Fault:
    shift = shift_mm * np.array([0.3, 0.3, 0.9])

    def put_in(
        rig: PlateRig, stripes: Stripes, plate: PlateReference
    ) -> tuple[Stripes, PlateReference]:
        late = reposed(stripes, lambda k, p: p if k < first else moved(p, shift, tilt_deg))
        return late, plate

    return put_in


def one_moved(shift_mm: float, number: int) -> Fault:
    def put_in(
        rig: PlateRig, stripes: Stripes, plate: PlateReference
    ) -> tuple[Stripes, PlateReference]:
        up = shift_mm * PLATE_NORMAL
        return reposed(stripes, lambda k, p: moved(p, up) if k == number else p), plate

    return put_in


def by_pose(change: Callable[[Pose[Base, Tool]], Pose[Base, Tool]]) -> Fault:
    return lambda rig, stripes, plate: (reposed(stripes, lambda _, pose: change(pose)), plate)


def by_points(change: Callable[[PlateRig, FloatArray], FloatArray]) -> Fault:
    return lambda rig, stripes, plate: (
        [replace(s, points_mm=change(rig, s.points_mm)) for s in stripes],
        plate,
    )


def in_order(order: Callable[[list[int]], list[int]]) -> Fault:
    def put_in(
        rig: PlateRig, stripes: Stripes, plate: PlateReference
    ) -> tuple[Stripes, PlateReference]:
        numbers = order(list(range(len(stripes))))
        return reposed(stripes, lambda k, _: stripes[numbers[k]].base_from_tool), plate

    return put_in


def mirrored_pose(pose: Pose[Base, Tool], axis: int) -> Pose[Base, Tool]:
    mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
    return Pose(mirror @ pose.rotation @ mirror, mirror @ pose.translation_mm)


def both_mirrored(
    rig: PlateRig, stripes: Stripes, plate: PlateReference
) -> tuple[Stripes, PlateReference]:
    mirror = np.diag([1.0, -1.0, 1.0])
    axes = plate.plane.axes @ mirror * np.array([[-1.0], [1.0], [1.0]])
    there = replace(plate, plane=Plane(mirror @ plate.plane.point_mm, axes))
    return reposed(stripes, lambda _, pose: mirrored_pose(pose, 1)), there


def image_reversed(axis: int) -> Fault:
    def change(rig: PlateRig, points: FloatArray) -> FloatArray:
        turned = points.copy()
        turned[:, axis] = 0.01 * points[:, 2] - points[:, axis]
        return rig.on_sheet(turned)

    return by_points(change)


def euler_mistaken(pose: Pose[Base, Tool]) -> Pose[Base, Tool]:
    angles = euler_from_rotations(pose.rotation[None], "intrinsic-xyz")
    return Pose(rotations_from_euler(angles, "extrinsic-xyz")[0], pose.translation_mm)


def swapped(numbers: list[int]) -> list[int]:
    numbers[3], numbers[7] = numbers[7], numbers[3]
    return numbers


def rows() -> Iterator[Row]:
    """All faults."""
    for shift in (0.1, -0.1, 0.5, -0.5, 1.0, 5.0):
        yield Row(f"plate moved by {shift:g} mm", ("probed",), plate_moved(shift, 0.0))
    for tilt in (0.05, 0.2, 0.5):
        yield Row(f"plate tilted by {tilt:g} deg", ("probed",), plate_moved(0.0, tilt))
    between = ("and those from",)
    for shift in (0.1, 0.3, 1.0, 3.0):
        yield Row(f"half re-referenced by {shift:g} mm", between, half_moved(shift, 0.0))
    yield Row("the last third by 1 mm", between, half_moved(1.0, 0.0, 8))
    for tilt in (0.05, 0.3):
        yield Row(f"plate tilted {tilt:g} deg half way", between, half_moved(0.0, tilt))
    wrong = ("left out 1 postures",)
    for shift in (0.1, 1.0, 1000.0):
        yield Row(f"one posture moved by {shift:g} mm", wrong, one_moved(shift, 4))
    yield Row("two postures swapped", ("left out 2 postures",), in_order(swapped))
    yield Row("one pose frozen", wrong, in_order(lambda n: [*n[:6], n[5], *n[7:]]))
    yield Row("poses off by one", ("the one",), in_order(lambda n: [*n[1:], n[0]]))
    mirrored = ("left-handed",)
    for axis, name in enumerate("xyz"):
        yield Row(
            f"poses mirrored, {name}",
            mirrored,
            by_pose(lambda pose, axis=axis: mirrored_pose(pose, axis)),
        )
    yield Row("poses and plate mirrored", mirrored, both_mirrored)
    yield Row("images mirrored, left-right", ("images", "left-handed"), image_reversed(0))
    yield Row("images mirrored, top-bottom", ("images",), image_reversed(1))
    for part in (0.002, 0.01, 0.02):
        yield Row(
            f"sensor's points {100 * part:g} % too large",
            ("sensor's calibration",),
            by_points(lambda rig, points, part=part: (1.0 + part) * points),
        )
    yield Row(
        "poses in metres", ("metres",), by_pose(lambda p: Pose(p.rotation, p.translation_mm / 1e3))
    )
    yield Row("poses inverted", ("tool_from_base",), by_pose(lambda pose: pose.inverse()))
    yield Row("Euler angles mistaken", ("intrinsic-xyz",), by_pose(euler_mistaken))


def stated_sigma(rig: PlateRig, seed: int) -> FloatArray:
    """(6,) standard deviations without the fault."""
    fit = calibrate_on_plate(*rig.draw(seed))
    return (
        np.sqrt(np.diag(fit.calibration.covariance)) if isinstance(fit, HandEyeFit) else np.ones(6)
    )


def judged(row: Row, fit: HandEyeFit | FitFailure, sigma: FloatArray) -> tuple[str, float]:
    """What became of a fault, and its effect in sigmas where a hand-eye was returned."""
    if isinstance(fit, FitFailure):
        text = f"{fit.reason} {fit.remedy}"
        return ("named" if any(word in text for word in row.words) else "refused"), float("nan")
    error = fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    effect = float(np.abs(error / sigma).max())
    text = " ".join(fit.warnings)
    if any(word in text for word in row.words):
        return "named", effect
    if fit.warnings:
        return "warned", effect
    return ("silent" if effect > HARM_SIGMAS else "harmless"), effect


def clean_sets(count: int, seed: int) -> None:
    """False alarms on sets without a fault, for arms from 0.005 to 0.2 mm."""
    for arm_mm in (0.0053, 0.02, 0.06, 0.2):
        noise = replace(RigNoise(), posture_mm=arm_mm, posture_rad=arm_mm / 265.0)
        refused, warned, inside = 0, Counter[str](), 0
        for run in range(count):
            rng = np.random.default_rng([seed, run])
            n = int(rng.integers(8, 17))
            rig = PlateRig(postures_of(n, rng), noise, points_per_stripe=80, form_mm=FORM_MM)
            fit = calibrate_on_plate(*rig.draw(run))
            if isinstance(fit, FitFailure):
                refused += 1
                print("   refused:", fit.reason[:140])
                continue
            warned.update({warning[:60] for warning in fit.warnings})
            error = fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
            inside += float(error @ np.linalg.solve(fit.calibration.covariance, error)) < 12.59
        print(f"arm of {arm_mm:g} mm: {count} clean sets, {refused} refused, "
              f"{inside} within the stated 95 %; warnings {dict(warned)}", flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="faults in a hand-eye calibration on a plate")
    parser.add_argument("--runs", type=int, default=10, help="of each fault")
    parser.add_argument("--clean", type=int, default=100, help="sets without a fault")
    parser.add_argument("--only", default="", help="faults whose name holds this")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    begun = time.perf_counter()
    print(
        "| fault | effect where let pass, sigmas | named | refused | warned | silent | harmless |"
    )
    print("|---|---|---|---|---|---|---|")
    sums, sigmas = Counter[str](), {}
    for row in (row for row in rows() if given.only in row.name):
        counts, effects = Counter[str](), []
        for run in range(given.runs):
            rng = np.random.default_rng([given.seed, run])
            rig = PlateRig(postures_of(N, rng), points_per_stripe=80, form_mm=FORM_MM)
            stripes, plate = rig.draw(run)
            fit = calibrate_on_plate(*row.put_in(rig, stripes, plate))
            if run not in sigmas:
                sigmas[run] = stated_sigma(rig, run)
            verdict, effect = judged(row, fit, sigmas[run])
            counts[verdict] += 1
            effects.append(effect)
        sums += counts
        known = [one for one in effects if np.isfinite(one)]
        effect_text = f"{min(known):.1f} to {max(known):.1f}" if known else ""
        cells = [str(counts[key]) for key in ("named", "refused", "warned", "silent", "harmless")]
        print(f"| {row.name} | {effect_text} | {' | '.join(cells)} |", flush=True)
    print(dict(sums))
    clean_sets(given.clean, given.seed)
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
