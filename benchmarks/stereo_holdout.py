# SPDX-License-Identifier: Apache-2.0
"""Hold-out error of stereo calibrations on real pairs, ours against OpenCV's, same pairs and folds.

Command: ``python benchmarks/stereo_holdout.py`` (real data from the folder in ARMSCAN_DATA, default
``../shared/data`` beside the project). Nothing is random.

Pair number i (file names sorted) belongs to fold ``i % 5``, and once more each pair is a fold of
its own (9 folds). Cameras and relative pose are calibrated from the other folds with the program's
own chain and default options: ours is detection and `calibrate_stereo`; OpenCV's is its detector
(findChessboardCorners, cornerSubPix), calibrateCamera of each camera, stereoCalibrate from there
with all intrinsics free; a third line is OpenCV's chain on the points of our detector.

Each held-out pair is judged in the same way for all: the calibrated cameras are held, and

- *both*: one board pose is fitted to the points of both images (least squares in px, SciPy), and
  the residuals are taken in both;
- *left to right*: the board pose is fitted in the left image alone, and the residuals are taken in
  the right image;
- *epipolar*: distances of the points from each other's epipolar lines, in both images.

rms is over all held-out points: of the residual's length in px, as OpenCV defines it; of the
distance, in px, for *epipolar*. Each chain is judged on the points of its own detector; no point is
left out. The pairs' own misfit levels are printed below.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoPair
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews, epipolar_distances_px
from armscan.storage.images import read_exposure
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.stereo_rig import project_right

DATA = Path(os.environ.get("ARMSCAN_DATA", Path(__file__).resolve().parents[2] / "shared/data"))
TARGET = Chessboard(9, 6, 25.0)
WINDOW_PX = 5
"""Half size of OpenCV's refinement window: the largest that stays within a square."""

Points = tuple[FloatArray, FloatArray, FloatArray]
"""Places on the board (M, 3), pixels left (M, 2), pixels right (M, 2)."""

Calibrate = Callable[[Sequence[int]], TwoViews]


def opencv_corners(path: Path) -> FloatArray:
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    found, corners = cv2.findChessboardCorners(grey, (TARGET.columns, TARGET.rows))
    if not found:
        raise SystemExit(f"OpenCV finds no board in {path}")
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    corners = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, corners, (WINDOW_PX, WINDOW_PX), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def opencv_views(points: Sequence[Points], size: tuple[int, int]) -> TwoViews:
    boards = [board.astype(np.float32) for board, _, _ in points]
    sides = [[pair[side].astype(np.float32) for pair in points] for side in (1, 2)]
    cameras = []
    for images in sides:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(boards, images, size, None, None)
        cameras += [matrix, distortion]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-10)
    solved = cv2.stereoCalibrate(
        boards,
        sides[0],
        sides[1],
        *cameras,
        size,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=criteria,
    )
    _, left, left_k, right, right_k, rotation, translation = solved[:7]
    models = [
        CameraModel.from_parameters([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.reshape(-1)[:5]], *size)
        for k, d in ((left, left_k), (right, right_k))
    ]
    return TwoViews(models[0], models[1], Pose(rotation, translation.reshape(3)))


def our_views(pairs: Sequence[StereoPair]) -> TwoViews:
    fit = calibrate_stereo(pairs, TARGET)
    if not isinstance(fit, StereoFit):
        raise SystemExit(fit.reason)
    return fit.views


def board_in_sensor(pose: FloatArray, board: FloatArray) -> FloatArray:
    return np.asarray(board @ rotation_from_vector(pose[:3]).T + pose[3:])


def held_out(views: TwoViews, points: Points) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals of both images, of the right from the left, and epipolar distances."""
    board, left, right = points

    def in_left(pose: FloatArray) -> FloatArray:
        return views.left.project(board_in_sensor(pose, board)) - left

    def in_right(pose: FloatArray) -> FloatArray:
        return project_right(views, board_in_sensor(pose, board)) - right

    def in_both(pose: FloatArray) -> FloatArray:
        return np.concatenate([in_left(pose), in_right(pose)])

    camera = views.left
    _, turn, shift = cv2.solvePnP(board, left, camera.matrix, camera.distortion)
    start = np.concatenate([turn.reshape(3), shift.reshape(3)])
    alone = least_squares(lambda pose: in_left(pose).ravel(), start, x_scale="jac").x
    together = least_squares(lambda pose: in_both(pose).ravel(), alone, x_scale="jac").x
    apart = np.concatenate(epipolar_distances_px(views, left, right))
    return in_both(together), in_right(alone), apart


def judge(calibrate: Calibrate, points: Sequence[Points], n_folds: int) -> list[float]:
    found: list[list[FloatArray]] = [[], [], []]
    every = range(len(points))
    for fold in range(n_folds):
        views = calibrate([i for i in every if i % n_folds != fold])
        for i in every:
            if i % n_folds == fold:
                for parts, residuals in zip(found, held_out(views, points[i]), strict=True):
                    parts.append(residuals.reshape(len(residuals), -1))
    return [float(np.sqrt(np.mean(np.sum(np.concatenate(parts) ** 2, axis=1)))) for parts in found]


def common_points(pair: StereoPair) -> Points:
    left, right = pair.views
    if left is None or right is None:
        raise SystemExit("a pair lacks a view")
    _, a, b = np.intersect1d(left.point_index, right.point_index, return_indices=True)
    return left.points_board_mm[a], left.points_px[a], right.points_px[b]


def main() -> None:
    cv2.setNumThreads(1)
    folder = DATA / "stereo_chessboard"
    paths = list(
        zip(sorted(folder.glob("left*.jpg")), sorted(folder.glob("right*.jpg")), strict=True)
    )
    pairs = []
    for left, right in paths:
        views = [detect_target(read_exposure(path), TARGET) for path in (left, right)]
        if not all(isinstance(view, TargetView) for view in views):
            raise SystemExit(f"no board in {left} or {right}")
        pairs.append(StereoPair(*(view for view in views if isinstance(view, TargetView))))
    board = TARGET.points_board_mm
    theirs = [(board, opencv_corners(left), opencv_corners(right)) for left, right in paths]
    ours = [common_points(pair) for pair in pairs]
    first = pairs[0].left
    size = (first.width_px, first.height_px) if first is not None else (0, 0)
    chains: dict[str, tuple[Calibrate, Sequence[Points]]] = {
        "ours": (lambda train: our_views([pairs[i] for i in train]), ours),
        "OpenCV": (lambda train: opencv_views([theirs[i] for i in train], size), theirs),
        "OpenCV, our points": (lambda train: opencv_views([ours[i] for i in train], size), ours),
    }
    print(__doc__.split("\n")[0])
    for n_folds in (5, len(pairs)):
        print(f"\n{n_folds} folds           {'both':>8s} {'left to right':>14s} {'epipolar':>9s}")
        results = {name: judge(*chain, n_folds) for name, chain in chains.items()}
        for name, (both, across, apart) in results.items():
            print(f"{name:20s} {both:8.4f} {across:14.4f} {apart:9.4f}")
        for name in list(results)[1:]:
            ratios = [a / b for a, b in zip(results["ours"], results[name], strict=True)]
            print(f"ours / {name:20s} {ratios[0]:.3f} {ratios[1]:.3f} {ratios[2]:.3f}")
    fit = calibrate_stereo(pairs, TARGET)
    if isinstance(fit, StereoFit):
        print(f"\nall pairs: rms {fit.rms_px:.4f} px, epipolar {fit.epipolar_rms_px:.4f} px")
        for pair in fit.pairs:
            rms = [view.rms_px for view in (pair.left, pair.right) if view is not None]
            print(f"  {pair.pair.name:28s} {rms[0]:.3f} {rms[1]:.3f} px  level {pair.level:5.2f}")


if __name__ == "__main__":
    main()
