# SPDX-License-Identifier: Apache-2.0
"""Certainty of the hand-eye over instruments at random: chi2, coverage, and sigma over the bound.

    python benchmarks/hand_eye_coverage.py [--runs 400] [--seed 1] [--reference plate sphere]
        [--postures 3 6] [--typical 0.2 1 5] [--whole]

Each run draws an instrument and its errors: an arm of 0.005 to 0.2 mm with a lever (scatter of its
position over that of its orientation) of 30 to 300 mm, whose pose turns about the origin of Tool,
the scan point, or a point up to 400 mm behind the origin of Tool (the position's scatter is that of
the origin of Tool then, so that the point lies within the lever), 4 to 24 postures, one to three
exposures each, a plate uneven by 0.5 to 30 um over waves of 70 to 220 mm, touches that scatter by
0.3 to 3 times what the arm does, stripes of 2 um noise; or a sphere. From points, without images:
the estimate begins at the truth, unless ``--whole`` runs search and checks too. Nothing of the
scatter is given.

Columns: draws, refusals, results that say that they had not settled; mean of e' C^-1 e / 6 of error
e and stated covariance C; how many per cent of the truths lie in the stated joint 95 % region, and
in the usual one of C (without the region's factor); mean of the squared error of placed points over
their stated variance, along directions 10 to 40 degrees from the optical axis (a plate's normals)
and 50 to 75 (sides of balls), of plates only; median and 90 % quantile of the stated sigma over the
Cramer-Rao bound that knows every variance (sixth root of the ratio of determinants, as sigma; for
the sphere, over the sigma that is stated if the arm's scatter is given, of arms that do not turn
about a point behind). ``--typical`` multiplies the locations of all priors.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from armscan.calibration.hand_eye import noise as noise_model
from armscan.calibration.hand_eye.calibrate import calibrate_on_plate, calibrate_on_sphere
from armscan.calibration.hand_eye.estimate import (
    HandEyeSolution,
    Problem,
    estimate,
    estimate_robustly,
    joint_covariance,
)
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    condense_plate,
    condense_sphere,
    find_sections,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import (
    HandEyeState,
    PlateSurface,
    SphereSurface,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.models.calibration import ArmNoise
from armscan.reconstruction.place import arm_covariance
from rigs.plate_bound import cramer_rao
from rigs.plate_rig import SCAN_POINT_MM, TOOL_FROM_SENSOR, PlateRig, Postures, RigNoise
from rigs.sphere_rig import CENTRE_MM, DIAMETER_MM, HAND_EYE, SphereRig
from rigs.sphere_rig import SCAN_POINT_MM as ON_SPHERE_MM

REGION = float(chi2.ppf(0.95, 6))
COUNTS = (4, 5, 6, 8, 12, 18, 24)
ON_SPHERE = (5, 6, 8, 12, 18, 24)
EXPOSURES = (1, 1, 2, 3)
STRIPE_MM = 0.002
TURNING = ("Tool", "scan point", "behind")
MOST_BEHIND_MM = 400.0
PLATE_DEG, SIDES_DEG, N_PLACED = (10.0, 40.0), (50.0, 75.0), 60
HALF_RANGE_MM = 20.0
TILT_DEG = (8.0, 40.0)
Strata = dict[str, Callable[["Drawn"], bool]]


@dataclass(frozen=True)
class Drawn:
    """An instrument."""

    arm_mm: float
    lever_mm: float
    exposure_part: float
    touch_part: float
    turned_rad: float
    flatness_mm: float
    n_postures: int
    n_exposures: int
    turning: str
    behind_mm: float

    @staticmethod
    def draw(rng: np.random.Generator, counts: Sequence[int]) -> Drawn:
        return Drawn(
            arm_mm=between(rng, 0.005, 0.2),
            lever_mm=between(rng, 30.0, 300.0),
            exposure_part=float(rng.uniform(0.0, 0.6)),
            touch_part=between(rng, 0.3, 3.0),
            turned_rad=between(rng, 0.15, 0.8),
            flatness_mm=between(rng, 0.0005, 0.03),
            n_postures=int(rng.choice(counts)),
            n_exposures=int(rng.choice(EXPOSURES)),
            turning=str(rng.choice(TURNING)),
            behind_mm=float(rng.uniform(0.3, 1.0)),
        ).placed()

    def placed(self) -> Drawn:
        """With the part of the lever that the turning point lies behind as a distance (mm)."""
        longest_mm = min(MOST_BEHIND_MM, 1.1 * self.lever_mm)
        return replace(self, behind_mm=longest_mm * self.behind_mm * (self.turning == "behind"))

    def turns_about(self, scan_point_mm: FloatArray) -> FloatArray:
        """(3,) point of Tool about which the arm's pose turns."""
        if self.turning == "scan point":
            return scan_point_mm
        return -self.behind_mm * scan_point_mm / float(np.linalg.norm(scan_point_mm))

    @property
    def shift_mm(self) -> float:
        """Scatter of that point: what the turn adds at the origin of Tool is a part of the arm's.

        Two of three turns move a point along an axis.
        """
        turned = 2.0 / 3.0 * (self.behind_mm / self.lever_mm) ** 2
        return self.arm_mm * float(np.sqrt(1.0 - turned))

    @property
    def noise(self) -> RigNoise:
        own, common = self.exposure_part, np.sqrt(1.0 - self.exposure_part**2)
        return RigNoise(
            posture_mm=self.shift_mm * common,
            posture_rad=self.arm_mm / self.lever_mm * common,
            exposure_mm=self.shift_mm * own,
            exposure_rad=self.arm_mm / self.lever_mm * own,
            flatness_mm=self.flatness_mm,
            stripe_mm=STRIPE_MM,
            probing_mm=self.touch_part * self.arm_mm,
        )


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


STRATA: Strata = {
    "all": lambda one: True,
    "arm 5-15 um": lambda one: one.arm_mm < 0.015,
    "arm 15-60 um": lambda one: 0.015 <= one.arm_mm < 0.06,
    "arm 60-200 um": lambda one: one.arm_mm >= 0.06,
    "lever 30-65 mm": lambda one: one.lever_mm < 65.0,
    "lever 65-140 mm": lambda one: 65.0 <= one.lever_mm < 140.0,
    "lever 140-300 mm": lambda one: one.lever_mm >= 140.0,
    "turns about Tool": lambda one: one.turning == "Tool",
    "about the scan point": lambda one: one.turning == "scan point",
    "about a point behind": lambda one: one.turning == "behind",
    "3 postures": lambda one: one.n_postures == 3,
    "4-5 postures": lambda one: one.n_postures in (4, 5),
    "6-8 postures": lambda one: 6 <= one.n_postures <= 8,
    "12 postures": lambda one: one.n_postures == 12,
    "18-24 postures": lambda one: one.n_postures > 12,
    "flat to 0.5-3 um": lambda one: one.flatness_mm < 0.003,
    "flat to 3-30 um": lambda one: one.flatness_mm >= 0.003,
    "postures nearly alike": lambda one: one.turned_rad < 0.35,
    "one exposure each": lambda one: one.n_exposures == 1,
    "two or three": lambda one: one.n_exposures > 1,
    "6 postures and more": lambda one: one.n_postures >= 6,
    "12 and more": lambda one: one.n_postures >= 12,
}


@dataclass(frozen=True)
class Outcome:
    """Normalised square of the error, NaN where refused; its limit; sigma over the bound.

    ``placed`` are the mean squares of the errors of points over their stated variances, along the
    normals of a plate and of the sides of balls.
    """

    drawn: Drawn
    square: float = np.nan
    limit: float = np.nan
    ratio: float = np.nan
    is_settled: bool = True
    placed: tuple[float, float] = (np.nan, np.nan)


@contextmanager
def typical_times(factor: float) -> Iterator[None]:
    """The locations of all priors times a factor."""
    names = [name for name in vars(noise_model) if name.startswith("TYPICAL_")]
    before = {name: getattr(noise_model, name) for name in names}
    for name, value in before.items():
        setattr(noise_model, name, value * factor)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(noise_model, name, value)


def random_postures(count: int, rng: np.random.Generator) -> Postures:
    """Tilts all round, better or worse spread."""
    low, high = TILT_DEG
    return Postures(
        np.radians(rng.uniform(low, high, count)),
        2.0 * np.pi * (np.arange(count) + rng.uniform(0.0, 1.0, count)) / count,
        rng.uniform(-3.0, 3.0, count),
        rng.uniform(118.0, 165.0, count),
        rng.uniform(-80.0, 80.0, (count, 2)),
    )


@dataclass(frozen=True)
class Stated:
    """A hand-eye and an arm as they are stated."""

    pose: Pose[Tool, Sensor]
    covariance: FloatArray
    region_factor: float
    is_settled: bool
    arm: ArmNoise

    @staticmethod
    def of_fit(fit: HandEyeFit) -> Stated:
        known, result = fit.calibration.diagnostics, fit.calibration
        factor = 1.0 if known is None else known.region_factor
        settled = not any("settled" in warning for warning in fit.warnings)
        return Stated(result.tool_from_sensor, result.covariance, factor, settled, result.arm_noise)

    @staticmethod
    def of_solution(found: HandEyeSolution) -> Stated:
        stated = joint_covariance(found)
        pose = found.state.tool_from_sensor
        arm = noise_model.arm_noise(found.components, found.noise.sigmas)
        covariance = stated.unknowns[:6, :6]
        return Stated(pose, covariance, stated.region_factor, found.is_settled, arm)

    def outcome(self, drawn: Drawn, bound: FloatArray | None, truth: Pose[Tool, Sensor]) -> Outcome:
        """The error over what is stated, and what is stated over the bound if there is one."""
        error, ratio = self.pose.step_from(truth), np.nan
        if bound is not None:
            over = np.linalg.slogdet(self.covariance)[1] - np.linalg.slogdet(bound)[1]
            ratio = float(np.exp(over / 12.0))
        square = float(error @ np.linalg.solve(self.covariance, error))
        return Outcome(drawn, square, REGION * self.region_factor, ratio, self.is_settled)


def placed_squares(stated: Stated, rig: PlateRig, rng: np.random.Generator) -> tuple[float, float]:
    """Mean squared error of points near the scan point over what is stated (`Outcome.placed`).

    The arm's error has the variance that the rig draws it with; that of the hand-eye is its own.
    """
    hand_eye, noise = rig.tool_from_sensor, rig.noise
    scan_point = hand_eye.apply(SCAN_POINT_MM)
    error = stated.pose.step_from(hand_eye)
    shift = noise.posture_mm**2 + noise.exposure_mm**2
    true = ArmNoise(np.sqrt(shift), float(np.hypot(noise.posture_rad, noise.exposure_rad)))
    found = []
    for low, high in (PLATE_DEG, SIDES_DEG):
        tilt, azimuth = np.radians(rng.uniform(low, high, N_PLACED)), rng.uniform(0, 7, N_PLACED)
        axes = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
        along = np.stack(axes, axis=1) @ hand_eye.rotation.T
        points = scan_point + rng.uniform(-HALF_RANGE_MM, HALF_RANGE_MM, (N_PLACED, 3))
        turned = np.cross(points - hand_eye.translation_mm, along)
        by_hand_eye = np.column_stack([turned, along])
        truly = arm_covariance(points, rig.turns_about_mm, np.zeros(3), true)
        claimed = arm_covariance(points, scan_point, np.zeros(3), stated.arm)
        square, variance = (
            np.einsum("ni,nij,nj->n", along, own, along)
            + np.einsum("ni,ij,nj->n", by_hand_eye, matrix, by_hand_eye)
            for own, matrix in ((truly, np.outer(error, error)), (claimed, stated.covariance))
        )
        found.append(float(np.mean(square / variance)))
    return found[0], found[1]


def on_plate(drawn: Drawn, seed: int, *, is_whole: bool) -> Outcome:
    """One calibration on a plate."""
    rng = np.random.default_rng([seed, 1])
    rig = PlateRig(
        random_postures(drawn.n_postures, rng),
        drawn.noise,
        exposures_per_posture=drawn.n_exposures,
        points_per_stripe=90,
        turns_about_mm=drawn.turns_about(TOOL_FROM_SENSOR.apply(SCAN_POINT_MM)),
    )
    stripes, plate = rig.draw(seed)
    bound = cramer_rao(rig)
    if is_whole:
        fit = calibrate_on_plate(stripes, plate)
        if not isinstance(fit, HandEyeFit):
            return Outcome(drawn)
        stated = Stated.of_fit(fit)
        outcome = stated.outcome(drawn, bound, TOOL_FROM_SENSOR)
        return replace(outcome, placed=placed_squares(stated, rig, rng))
    surface = PlateSurface(plate)
    observations = condense_plate(stripes, straight_stripes(stripes), surface.per_stripe)
    problem = Problem(observations, surface, HandEyeOptions())
    found = estimate(problem, problem.start(TOOL_FROM_SENSOR))
    if found is None:
        return Outcome(drawn)
    stated = Stated.of_solution(found)
    outcome = stated.outcome(drawn, bound, TOOL_FROM_SENSOR)
    return replace(outcome, placed=placed_squares(stated, rig, rng))


def on_sphere(drawn: Drawn, seed: int, *, is_whole: bool) -> Outcome:
    """One calibration on a sphere, all of the arm's error common to a posture."""
    rng = np.random.default_rng([seed, 2])
    rig = SphereRig(
        pose_noise_mm=drawn.shift_mm,
        lever_mm=drawn.lever_mm * drawn.shift_mm / drawn.arm_mm,
        turns_about_mm=drawn.turns_about(HAND_EYE.apply(ON_SPHERE_MM)),
        point_noise_mm=0.005,
        n_points=60,
    )
    poses = [
        rig.base_from_tool(
            rng.uniform(-drawn.turned_rad, drawn.turned_rad, 3),
            float(rng.uniform(3.0, 16.0)) * float(rng.choice([-1.0, 1.0])),
            float(rng.uniform(-8.0, 8.0)),
            float(rng.uniform(-14.0, 14.0)),
        )
        for _ in range(drawn.n_postures)
    ]
    stripes = rig.stripes(poses, rng)
    about_tool = drawn.arm_mm / drawn.lever_mm if drawn.turning == "Tool" else 0.0
    given = HandEyeOptions(arm_position_mm=drawn.shift_mm, arm_rotation_rad=about_tool)
    surface = SphereSurface(0.5 * DIAMETER_MM)
    observations = condense_sphere(find_sections(stripes, surface.radius_mm)[0], 10)
    start = HandEyeState(HAND_EYE, np.array([*CENTRE_MM, surface.radius_mm]))
    known = estimate(Problem(observations, surface, given), start)
    if known is None:
        return Outcome(drawn)
    # A turn about the scan point hardly moves a section; one about a point behind cannot be given.
    bound = known.linear.covariance[:6, :6] if drawn.turning != "behind" else None
    if is_whole:
        fit = calibrate_on_sphere(stripes, DIAMETER_MM, HandEyeOptions(per_stripe=10))
        if not isinstance(fit, HandEyeFit):
            return Outcome(drawn)
        return Stated.of_fit(fit).outcome(drawn, bound, HAND_EYE)
    found = estimate_robustly(Problem(observations, surface, HandEyeOptions()), start)
    if found is None:
        return Outcome(drawn)
    return Stated.of_solution(found).outcome(drawn, bound, HAND_EYE)


def show(outcomes: Sequence[Outcome]) -> None:
    """A line a stratum."""
    print(
        f"{'':22s} draws refused unsettled  chi2/6     inside     usual  plate sides  "
        "sigma/bound   90 %"
    )
    for name, holds in STRATA.items():
        chosen = [one for one in outcomes if holds(one.drawn)]
        found = [one for one in chosen if np.isfinite(one.square)]
        if not found:
            continue
        squares = np.array([one.square for one in found])
        inside = np.mean([one.square <= one.limit for one in found])
        half = np.sqrt(max(inside * (1.0 - inside), 0.01) / len(found))
        spread = float(squares.std()) / 6.0 / np.sqrt(len(squares))
        ratios = [one.ratio for one in found if np.isfinite(one.ratio)] or [np.nan]
        middle, upper = np.quantile(ratios, [0.5, 0.9])
        plate, sides = np.mean([one.placed for one in found], axis=0)
        unsettled = sum(not one.is_settled for one in found)
        print(
            f"{name:22s} {len(chosen):5d} {len(chosen) - len(found):7d} {unsettled:9d}   "
            f"{squares.mean() / 6.0:5.2f} ±{spread:4.2f}  {100 * inside:5.1f} ±{100 * half:3.1f}  "
            f"{100 * (squares <= REGION).mean():5.1f}  {plate:5.2f} {sides:5.2f}  {middle:8.2f}  "
            f"{upper:9.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="certainty of the hand-eye")
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--reference", nargs="+", default=["plate", "sphere"])
    parser.add_argument("--typical", type=float, nargs="+", default=[1.0])
    parser.add_argument("--postures", type=int, nargs="+", help="counts to draw from")
    parser.add_argument("--whole", action="store_true", help="with search and checks")
    given = parser.parse_args()
    for reference in given.reference:
        study, usual = (on_plate, COUNTS) if reference == "plate" else (on_sphere, ON_SPHERE)
        counts = given.postures or usual
        for factor in given.typical:
            begun = time.perf_counter()
            with typical_times(factor):
                rng = np.random.default_rng(given.seed)
                outcomes = [
                    study(Drawn.draw(rng, counts), 1_000_000 * given.seed + k, is_whole=given.whole)
                    for k in range(given.runs)
                ]
            print(f"{reference}, seed {given.seed}, priors' locations x {factor:g}")
            show(outcomes)
            print(f"{time.perf_counter() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
