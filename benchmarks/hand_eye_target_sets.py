# SPDX-License-Identifier: Apache-2.0
"""Hand-eye before a target on folders of real photographs and robot poses, postures left out.

    python benchmarks/hand_eye_target_sets.py SETS

SETS holds one folder a set: ``images/``, ``poses_mm.npy`` (N, 4, 4) of ``base_from_tool`` in mm, in
the order of the images, and ``board.json``: ``target`` as of the command line, ``is_at_rest`` true
where the camera stands still (its poses are turned round then). Told are the pixels, root mean
square, by which corners of a fifth of the postures are off where the other four fifths put them;
the camera is that of all photographs.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.hand_eye.board_looks import BoardLook, board_poses
from armscan.calibration.hand_eye.board_result import BoardHandEyeFit
from armscan.calibration.hand_eye.on_board import calibrate_on_board
from armscan.calibration.sheets.board_points import BoardBow, HeadCameras, find_board_bow
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import nearest_rotation
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.pipeline.cameras import calibrate_camera_from_found, camera_calibration
from armscan.pipeline.targets import find_targets
from armscan.storage.images import read_exposures
from armscan.vision.targets.detect import settle_target
from armscan.vision.targets.target import parse_target

FOLDS = 5


def looks_of(folder: Path) -> tuple[list[BoardLook], CameraCalibration, BoardBow | None] | str:
    known = json.loads((folder / "board.json").read_text())
    exposures = read_exposures(sorted((folder / "images").iterdir()))
    matrices = np.load(folder / "poses_mm.npy")
    if known.get("is_at_rest"):
        matrices = np.linalg.inv(matrices)
    target = settle_target(exposures, parse_target(known["target"]))
    found = find_targets(exposures, target)
    run = calibrate_camera_from_found(found, target, CameraOptions())
    if isinstance(run, FitFailure):
        return f"camera refused: {run.reason}"
    camera = camera_calibration(run.fit, Provenance("study", "", "", (), ()))
    found = found.before(camera.camera)
    bow = find_board_bow(found.views, HeadCameras.of(camera))
    place = {exposure.source: k for k, exposure in enumerate(exposures)}
    looks = []
    for view in found.views:
        poses = board_poses(view, target, camera.camera, bow)
        if not isinstance(poses, FitFailure):
            matrix = matrices[place[view.source]]
            held: Pose[Base, Tool] = Pose(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])
            looks.append(BoardLook(view.source, held, poses))
    return looks, camera, bow


def off_px(fit: BoardHandEyeFit, look: BoardLook) -> float:
    """Mean square of a left-out look, numbered as it agrees best."""
    held = look.base_from_tool @ fit.calibration.tool_from_sensor
    predicted = held.inverse() @ fit.base_from_board
    squares = []
    for pose in look.poses:
        seen = fit.camera.project(predicted.apply(pose.view.points_board_mm))
        squares.append(float(((pose.view.points_px - seen) ** 2).sum(axis=1).mean()))
    return min(squares)


def study(folder: Path) -> str:
    read = looks_of(folder)
    if isinstance(read, str):
        return read
    looks, camera, bow = read
    whole = calibrate_on_board(looks, camera, bow=bow)
    if isinstance(whole, FitFailure):
        return f"refused: {whole.reason}"
    squares: list[float] = []
    for k in range(FOLDS):
        kept = [look for n, look in enumerate(looks) if n % FOLDS != k]
        fit = calibrate_on_board(kept, camera, bow=bow)
        if isinstance(fit, BoardHandEyeFit):
            squares += [off_px(fit, look) for n, look in enumerate(looks) if n % FOLDS == k]
    noise = whole.calibration.arm_noise
    turn_deg = np.degrees(np.hypot(noise.rotation_rad, noise.tool_rotation_rad))
    left_out_px, asked = np.sqrt(np.mean(squares)), whole.asked
    return (
        f"{len(looks)} postures, left out {left_out_px:.2f} px, all {whole.rms_px:.2f} px; "
        f"arm {noise.position_mm:.2f} mm {turn_deg:.3f} deg; "
        f"size {asked.scale:.4f} +- {asked.sigma:.4f}; not used {len(whole.not_used)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", type=Path)
    for folder in sorted(parser.parse_args().sets.iterdir()):
        if (folder / "board.json").exists():
            print(f"{folder.name}: {study(folder)}", flush=True)


if __name__ == "__main__":
    main()
