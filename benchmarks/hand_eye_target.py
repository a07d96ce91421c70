# SPDX-License-Identifier: Apache-2.0
"""Hand-eye of a camera before a target, over drawn arms: errors against what is stated.

    python benchmarks/hand_eye_target.py [--draws 400] [--seed 3000]

6 to 24 postures; arms of 0.01 to 1 mm with levers of 30 to 400 mm; a camera that errs by its own
sigma; boards that look alike from both ends in every second draw, numbered from either. In every
fourth draw one pose of the arm is off by 10 to 60 times its scatter, at least 1 mm. Simulated, from
points. Silent: an error beyond 4 sigma (the chance of that of one number) without a word. The last
columns: median of the stated scatter over the true one, the size's error over its sigma, and, of
draws that are numbered from one end and have no wrong pose, the median shift of the closed form of
all turns and places (Park and Martin 1994) over ours.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from armscan.calibration.hand_eye.board_result import BoardHandEyeFit
from armscan.calibration.hand_eye.on_board import calibrate_on_board
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation
from rigs.board_postures import BoardRig, board_rig, misread

SILENT = float(chi2.ppf(1.0 - 2.0 * norm.sf(4.0), 6))
REGION = float(chi2.ppf(0.95, 6))


@dataclass(frozen=True)
class Draw:
    """One rig, and what became of it."""

    n_postures: int
    arm_mm: float
    lever_mm: float
    wrong: str
    fit: BoardHandEyeFit | FitFailure
    square: float
    closed_mm: float
    ours_mm: float


def step_to_true(found: Pose[Tool, Sensor], rig: BoardRig) -> FloatArray:
    true = rig.tool_from_sensor
    turn = Rotation.from_matrix(true.rotation @ found.rotation.T).as_rotvec()
    return np.concatenate([turn, true.translation_mm - found.translation_mm])


def closed_form(rig: BoardRig) -> Pose[Tool, Sensor]:
    """Turns of all pairs, then places, of the first pose of each look."""
    arm = np.array([look.base_from_tool.matrix for look in rig.looks])
    seen = np.array([look.poses[0].sensor_from_board.matrix for look in rig.looks])
    i, j = np.triu_indices(len(arm), 1)
    a = np.linalg.inv(arm[i]) @ arm[j]
    b = seen[i] @ np.linalg.inv(seen[j])
    turns = Rotation.from_matrix(a[:, :3, :3]).as_rotvec()
    also = Rotation.from_matrix(b[:, :3, :3]).as_rotvec()
    rotation = nearest_rotation(turns.T @ also)
    matrix = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (b[:, :3, 3] @ rotation.T - a[:, :3, 3]).reshape(-1)
    return Pose(rotation, np.linalg.lstsq(matrix, right, rcond=None)[0])


def drawn(seed: int) -> Draw:
    generator = np.random.default_rng(seed)
    n = int(generator.integers(6, 25))
    arm_mm = float(np.exp(generator.uniform(np.log(0.01), np.log(1.0))))
    lever_mm = float(np.exp(generator.uniform(np.log(30.0), np.log(400.0))))
    is_alike = bool(generator.random() < 0.5)
    rig = board_rig(
        seed, n, arm_mm=arm_mm, lever_mm=lever_mm, turned=is_alike,
        target="chessboard:9x7:25" if is_alike else "chessboard:9x6:25",
    )  # fmt: skip
    wrong = ""
    if generator.random() < 0.25:
        row = int(generator.integers(n))
        wrong = f"{row}.png"
        rig = misread(rig, row, max(1.0, arm_mm * float(generator.uniform(10.0, 60.0))))
    fit = calibrate_on_board(rig.looks, rig.camera)
    closed_mm = np.nan
    if not is_alike and not wrong:
        closed_mm = float(np.linalg.norm(step_to_true(closed_form(rig), rig)[3:]))
    if isinstance(fit, FitFailure):
        return Draw(n, arm_mm, lever_mm, wrong, fit, np.nan, closed_mm, np.nan)
    step, follow = step_to_true(fit.calibration.tool_from_sensor, rig), np.zeros((6, 9))
    if fit.calibration.dhand_eye_dsensor is not None:
        follow = fit.calibration.dhand_eye_dsensor
    covariance = fit.calibration.covariance + follow @ fit.camera_covariance @ follow.T
    square = float(step @ np.linalg.solve(covariance, step))
    ours_mm = float(np.linalg.norm(step[3:]))
    return Draw(n, arm_mm, lever_mm, wrong, fit, square, closed_mm, ours_mm)


def show(name: str, draws: list[Draw]) -> None:
    fits = [(one, one.fit) for one in draws if isinstance(one.fit, BoardHandEyeFit)]
    squares = np.array([one.square for one, _ in fits])
    factors = [
        1.0 if fit.calibration.diagnostics is None else fit.calibration.diagnostics.region_factor
        for _, fit in fits
    ]
    silent = sum(square > SILENT for square in squares)
    named = [{source for source, _ in fit.not_used} for _, fit in fits]
    wrongly = sum(len(found - {one.wrong}) for (one, _), found in zip(fits, named, strict=True))
    found = [one.wrong in gone for (one, _), gone in zip(fits, named, strict=True) if one.wrong]
    scatter = np.median([fit.calibration.arm_noise.position_mm / one.arm_mm for one, fit in fits])
    sizes = [(fit.asked.scale - 1.0) / fit.asked.sigma for _, fit in fits]
    ratio = np.nanmedian([one.closed_mm / one.ours_mm for one, _ in fits])
    held = np.mean(squares < REGION * np.array(factors))
    print(
        f"{name:22s} {len(draws):4d} refused {len(draws) - len(fits)}, silent {silent}, "
        f"chi2/6 {squares.mean() / 6:.2f}, within 95 % {held:.3f}, "
        f"wrongly left out {wrongly}, wrong found {sum(found)} of {len(found)}, "
        f"scatter {scatter:.2f}, size {np.sqrt(np.mean(np.square(sizes))):.2f}, "
        f"closed form's shift / ours {ratio:.1f}",
        flush=True,
    )
    for one in draws:
        if isinstance(one.fit, FitFailure):
            print(f"    refused: {one.n_postures} postures, {one.arm_mm:.3f} mm: {one.fit.reason}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--seed", type=int, default=3000)
    given = parser.parse_args()
    draws = [drawn(given.seed + 10 * k) for k in range(given.draws)]
    show("all", draws)
    show("6 to 11 postures", [one for one in draws if one.n_postures < 12])
    show("12 to 24", [one for one in draws if one.n_postures >= 12])
    show("arms below 0.1 mm", [one for one in draws if one.arm_mm < 0.1])
    show("above", [one for one in draws if one.arm_mm >= 0.1])
    show("levers below 110 mm", [one for one in draws if one.lever_mm < 110.0])
    show("above", [one for one in draws if one.lever_mm >= 110.0])


if __name__ == "__main__":
    main()
