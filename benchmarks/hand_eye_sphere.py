# SPDX-License-Identifier: Apache-2.0
"""Hand-eye on a sphere: one least squares against the thesis's two steps, and its coverage.

    python benchmarks/hand_eye_sphere.py [--runs 40] [--seed 1]

Section circles of a 50 mm sphere are simulated from points, without images; the arm's pose errs by
0.02 mm an axis at the scan point, points by 0.01 mm. Columns: root mean square error of the turn
and of the shift, and how many runs lie within the joint 95 % region of the covariance stated.
The two steps need postures that only shift; from the turned ones they have no answer.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

from armscan.calibration.hand_eye.calibrate import calibrate_on_sphere
from armscan.calibration.hand_eye.observations import HandEyeOptions
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.rotations import vector_from_rotation
from armscan.thesis.hand_eye import TwoStepHandEye, calibrate_in_two_steps
from rigs.sphere_rig import DIAMETER_MM, HAND_EYE, SphereRig, shifted_poses, turned_poses

REGION = float(chi2.ppf(0.95, 6))
OPTIONS = HandEyeOptions(per_stripe=10)
RIG = SphereRig(pose_noise_mm=0.02, point_noise_mm=0.01, n_points=60)


def error_of(found: Pose[Tool, Sensor]) -> FloatArray:
    turn = vector_from_rotation(found.rotation @ HAND_EYE.rotation.T)
    return np.concatenate([turn, found.translation_mm - HAND_EYE.translation_mm])


def study(name: str, poses: list[Pose[Base, Tool]], runs: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    one, two, inside = [], [], 0
    for _ in range(runs):
        stripes = RIG.stripes(poses, generator)
        fit = calibrate_on_sphere(stripes, DIAMETER_MM, OPTIONS)
        if isinstance(fit, HandEyeFit):
            error = error_of(fit.calibration.tool_from_sensor)
            one.append(error)
            known = fit.calibration.diagnostics
            limit = REGION * (1.0 if known is None else known.region_factor)
            inside += int(error @ np.linalg.solve(fit.calibration.covariance, error) < limit)
        steps = calibrate_in_two_steps(stripes, DIAMETER_MM)
        if isinstance(steps, TwoStepHandEye):
            two.append(error_of(steps.tool_from_sensor))
    show(f"{name}, one least squares", one, f"{inside} of {len(one)} within 95 %")
    show(f"{name}, two steps", two, "states no covariance")


def show(name: str, errors: list[FloatArray], note: str) -> None:
    if not errors:
        print(f"{name:36s} refused")
        return
    square = np.mean(np.square(errors), axis=0)
    turn, shift = np.degrees(np.sqrt(square[:3].sum())), np.sqrt(square[3:].sum())
    print(f"{name:36s} {turn:8.4f} deg {shift:8.4f} mm   {note}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    cases: dict[str, Callable[[SphereRig], list[Pose[Base, Tool]]]] = {
        "6 shifted and 5 turned": shifted_poses,
        "12 turned": turned_poses,
    }
    for name, poses in cases.items():
        study(name, poses(RIG), given.runs, given.seed)


if __name__ == "__main__":
    main()
