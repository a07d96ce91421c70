# SPDX-License-Identifier: Apache-2.0
"""Hand-eye on a flat plate: error over the Cramer-Rao bound, and coverage of the stated covariance.

    python benchmarks/hand_eye_plate.py [--runs 200] [--seed 1] [--postures 6 12 24]
        [--whole]
    python benchmarks/hand_eye_plate.py --speed

Stripes are simulated from points, without images: an arm of 0.02 mm repeatability, a plate uneven
by 0.015 mm, touched at 64 points. Each run draws its errors anew. Columns: root mean square error
over bound for the six parameters and overall (root mean of e' B^-1 e / 6 with B the bound's
covariance), and how many runs lie within the joint 95 % region that is stated (of 200, 182 to 197
is right). A run without a result has an infinite error and lies outside. The estimate begins at the
truth; with ``--whole``, search and checks run too. Plain least squares is eq. 2.76 as it stands,
with the covariance that its own residuals suggest. ``--speed`` shows instead how long one estimate
of the scatter takes, by groups of observations as armscan has it and by full matrices.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
from scipy.stats import chi2

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.estimate import Problem, estimate, joint_covariance
from armscan.calibration.hand_eye.noise import estimate_noise
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateReference,
    PosedStripe,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import PlateSurface
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose, Sensor, Tool
from rigs.plate_bound import cramer_rao, plain_least_squares, scored_densely
from rigs.plate_rig import TOOL_FROM_SENSOR, PlateRig, RigNoise, good_postures

T = TypeVar("T")
REGION = float(chi2.ppf(0.95, 6))


def given_noise(noise: RigNoise) -> HandEyeOptions:
    """The scatter as it is, for a single exposure a posture; the flatness length is a guess."""
    return HandEyeOptions(
        arm_position_mm=float(np.hypot(noise.posture_mm, noise.exposure_mm)),
        arm_rotation_rad=float(np.hypot(noise.posture_rad, noise.exposure_rad)),
        plate_flatness_mm=noise.flatness_mm,
        stripe_noise_factor=1.0,
    )


def study(
    rig: PlateRig, runs: int, seed: int, options: HandEyeOptions, *, is_whole: bool
) -> tuple[FloatArray, int]:
    """Errors (runs, 6), infinite without a result, and how many lie in the joint 95 % region."""
    errors, inside = [], 0
    for run in range(runs):
        found = calibrated(*rig.draw(100_000 * seed + run), options, is_whole=is_whole)
        if found is None:
            print(f"run {run}: no result")
            errors.append(np.full(6, np.inf))
            continue
        pose, covariance, region_factor = found
        error = pose.step_from(TOOL_FROM_SENSOR)
        errors.append(error)
        inside += is_inside(error, covariance * region_factor)
    return np.array(errors), inside


def calibrated(
    stripes: list[PosedStripe], plate: PlateReference, options: HandEyeOptions, *, is_whole: bool
) -> tuple[Pose[Tool, Sensor], FloatArray, float] | None:
    """Hand-eye, covariance and factor of its region."""
    if is_whole:
        fit = calibrate_on_plate(stripes, plate, options)
        if not isinstance(fit, HandEyeFit) or fit.calibration.diagnostics is None:
            return None
        result = fit.calibration
        factor = fit.calibration.diagnostics.region_factor
        return result.tool_from_sensor, result.covariance, factor
    surface = PlateSurface(plate)
    observations = condense_plate(stripes, straight_stripes(stripes), surface.per_stripe)
    problem = Problem(observations, surface, options)
    found = estimate(problem, problem.start(TOOL_FROM_SENSOR))
    if found is None:
        return None
    stated = joint_covariance(found)
    return found.state.tool_from_sensor, stated.unknowns[:6, :6], stated.region_factor


def plain_study(rig: PlateRig, runs: int, seed: int) -> tuple[FloatArray, int]:
    """The same for plain least squares with its own covariance."""
    found = [plain_least_squares(*rig.draw(100_000 * seed + run)) for run in range(runs)]
    inside = sum(is_inside(error, covariance) for error, covariance in found)
    return np.array([error for error, _ in found]), inside


def is_inside(error: FloatArray, covariance: FloatArray) -> bool:
    return float(error @ np.linalg.solve(covariance, error)) <= REGION


def show(name: str, errors: FloatArray, inside: int, bound: FloatArray) -> None:
    is_known = np.isfinite(errors)
    ratios = np.sqrt((errors**2).mean(axis=0) / np.diag(bound))
    scaled = np.linalg.solve(np.linalg.cholesky(bound), np.where(is_known, errors, 0.0).T)
    squares = np.where(is_known[:, 0], (scaled**2).sum(axis=0), np.inf)
    overall = np.sqrt(squares.mean() / 6.0)
    each = " ".join(f"{ratio:5.2f}" for ratio in ratios)
    print(f"{name:32s} {each}   {overall:5.2f}   {inside} of {len(errors)}", flush=True)


def show_speed(seed: int) -> None:
    """Least processor time of five; the estimates of both ways begin at the typical scatter."""
    print("postures  exposures  observations  by groups ms  full matrices ms  ratio  sigmas differ")
    for exposures in (1, 2, 4):
        rig = PlateRig(
            good_postures(12, np.random.default_rng(seed)), exposures_per_posture=exposures
        )
        stripes, plate = rig.draw(seed)
        surface = PlateSurface(plate)
        observations = condense_plate(stripes, straight_stripes(stripes), surface.per_stripe)
        problem = Problem(observations, surface, HandEyeOptions())
        placed = problem.place(problem.start(TOOL_FROM_SENSOR))
        components = tuple(replace(one, follows="") for one in problem.components(placed))
        jacobian, known = placed.jacobian[:, problem.columns], problem.surface_covariance(placed)
        given = (placed.residual_mm, jacobian, components, known)
        ours, found = least_ms(partial(estimate_noise, *given))
        dense, plain = least_ms(partial(scored_densely, *given))
        apart = float(np.abs(found.sigmas / plain[0] - 1.0).max())
        print(f"{12:8d}  {exposures:9d}  {len(observations):12d}  {ours:12.1f}  {dense:16.1f}"
              f"  {dense / ours:5.1f}  {apart:.0e}", flush=True)  # fmt: skip


def least_ms(made: Callable[[], T]) -> tuple[float, T]:
    """Least processor time of five calls in ms, and what they return."""
    times = []
    for _ in range(5):
        begun = time.process_time()
        found = made()
        times.append(time.process_time() - begun)
    return 1e3 * min(times), found


def main() -> None:
    parser = argparse.ArgumentParser(description="hand-eye on a plate against its bound")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--postures", type=int, nargs="+", default=[12])
    parser.add_argument("--whole", action="store_true", help="with search and checks")
    parser.add_argument("--speed", action="store_true", help="time one estimate of the scatter")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.speed:
        show_speed(arguments.seed)
        return
    begun = time.perf_counter()
    print(f"{arguments.runs} runs, seed {arguments.seed}; error over bound, rotations then shifts")
    for count in arguments.postures:
        rig = PlateRig(good_postures(count, np.random.default_rng(arguments.seed)))
        bound = cramer_rao(rig)
        sigma = np.sqrt(np.diag(bound))
        print(f"{count} postures; bound {np.degrees(sigma[:3]).round(4)} deg, "
              f"{sigma[3:].round(4)} mm")  # fmt: skip
        runs, seed = arguments.runs, arguments.seed
        for name, options in (
            ("  scatter given", given_noise(rig.noise)),
            ("  scatter estimated", HandEyeOptions()),
        ):
            found = study(rig, runs, seed, options, is_whole=arguments.whole)
            show(name, *found, bound)
        show("  plain least squares", *plain_study(rig, runs, seed), bound)
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
