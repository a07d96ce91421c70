# SPDX-License-Identifier: Apache-2.0
"""Hold-out reprojection error on real photographs, ours against OpenCV's, same images and folds.

Command: ``python benchmarks/camera_holdout.py`` (real data from the folder in ARMSCAN_DATA, default
``../shared/data`` beside the project). Nothing is random.

View number i (file names sorted; images in which both programs find the target) belongs to fold
``i % n_folds``. The camera is solved from the other folds, each held-out view gets a fit of its
pose alone, and rms is the root mean square over all held-out points of the residual's length in px,
as OpenCV defines it. No point is left out of the rms, whatever a solver thought of it.

Columns: *ours* is detection, calibration with default options, pose; *OpenCV* is its own detector
(chessboard corners refined by cornerSubPix, or findCirclesGrid), calibrateCamera with its default
model (k1 k2 p1 p2 k3), solvePnP; *OpenCV, our points* is its calibrateCamera and solvePnP on the
points of our detector. *bowed* judges ours and OpenCV on boards bowed as our calibration of the
other folds finds them, in place of flat ones; *printed* judges ours with --solve-print, and OpenCV,
on such boards with their points where that calibration finds them; OpenCV's cameras are the same.
*released* is OpenCV's calibrateCameraRO, which finds the places (x, y and z) by itself, from the
other folds, too: on the points of its own detector and of ours, views that show all points only.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_views
from armscan.records.exposure import Exposure
from armscan.storage.images import read_exposure
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import Chessboard, CircleGrid, TargetView

DATA = Path(os.environ.get("ARMSCAN_DATA", Path(__file__).resolve().parents[2] / "shared/data"))
FOLDS = 5
SOLVED = CameraOptions(solve_print=True)


@dataclass(frozen=True)
class PhotoSet:
    pattern: str
    target: Chessboard | CircleGrid
    window_px: int = 11
    """Half size of OpenCV's refinement window: the larger one that stays within a square."""


SETS = {
    "ciclop": PhotoSet("ciclop/camera/*.jpg", Chessboard(11, 6, 13.0)),
    "circle_grid36": PhotoSet("circle_grid36/*.pgm", CircleGrid(6, 6, 30.0)),
    "stereo_chessboard left": PhotoSet("stereo_chessboard/left*.jpg", Chessboard(9, 6, 25.0), 5),
    "stereo_chessboard right": PhotoSet("stereo_chessboard/right*.jpg", Chessboard(9, 6, 25.0), 5),
}


def opencv_points(exposure: Exposure, photos: PhotoSet) -> FloatArray | None:
    image = exposure.image
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    target = photos.target
    size = (target.columns, target.rows)
    if isinstance(target, CircleGrid):
        found, points = cv2.findCirclesGrid(grey, size)
    else:
        found, points = cv2.findChessboardCorners(grey, size)
        if found:
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
            window = (photos.window_px, photos.window_px)
            points = cv2.cornerSubPix(grey, points.reshape(-1, 1, 2), window, (-1, -1), criteria)
    return np.asarray(points, dtype=np.float64).reshape(-1, 2) if found else None


def rms(residuals: list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.concatenate(residuals) ** 2, axis=1))))


def folds_of(n_views: int) -> list[tuple[list[int], list[int]]]:
    n_folds = min(FOLDS, n_views)
    every = range(n_views)
    return [
        ([i for i in every if i % n_folds != fold], [i for i in every if i % n_folds == fold])
        for fold in range(n_folds)
    ]


@dataclass(frozen=True)
class Ours:
    flat_px: float
    bowed_px: float
    printed_px: float
    models: str
    bows_mm: list[FloatArray]
    """(2,) a fold: zero where no bow shows."""
    printed_bows_mm: list[FloatArray]
    missed_mm: list[FloatArray]
    """(P, 2) a fold: zero where no print error shows."""


def bow_of(fit: CameraFit) -> FloatArray:
    return fit.warp.bow_mm if fit.warp is not None and fit.warp.is_significant else np.zeros(2)


def missed_of(fit: CameraFit, n_points: int) -> FloatArray:
    missed = np.zeros((n_points, 2))
    for view in fit.used_views:
        missed[view.view.point_index] = view.missed_mm
    return missed


def as_printed(view: TargetView, missed_mm: FloatArray) -> TargetView:
    places = view.points_board_mm.copy()
    places[:, :2] += missed_mm[view.point_index]
    return replace(view, points_board_mm=places)


def our_holdout(views: list[TargetView], n_points: int) -> Ours:
    flat: list[FloatArray] = []
    bowed: list[FloatArray] = []
    printed: list[FloatArray] = []
    models, bows, printed_bows, missed = [], [], [], []
    for train, test in folds_of(len(views)):
        run = calibrate_camera_from_views([views[i] for i in train])
        if not isinstance(run, CameraRun):
            raise SystemExit(run.reason)
        with_print = calibrate_camera_from_views([views[i] for i in train], SOLVED)
        if not isinstance(with_print, CameraRun):
            raise SystemExit(with_print.reason)
        fit, other = run.fit, with_print.fit
        models.append("".join(n for n in fit.free_parameters if n[0] in "kp"))
        bows.append(bow_of(fit))
        printed_bows.append(bow_of(other))
        missed.append(missed_of(other, n_points))
        for i in test:
            view = correct_centres(views[i], fit.camera) if views[i].edges else views[i]
            found = as_printed(view, missed[-1])
            for residuals, seen, camera, bow in (
                (flat, view, fit.camera, np.zeros(2)),
                (bowed, view, fit.camera, bows[-1]),
                (printed, found, other.camera, printed_bows[-1]),
            ):
                pose = estimate_board_pose(seen, camera, bow_mm=bow, allow_ambiguous=True)
                if not isinstance(pose, Estimate):
                    raise SystemExit(pose.reason)
                residuals.append(pose.residuals)
    told = " ".join(sorted(set(models)))
    return Ours(rms(flat), rms(bowed), rms(printed), told, bows, printed_bows, missed)


def bent(board: FloatArray, bow_mm: FloatArray) -> FloatArray:
    """The flat board (N, 3) with a bow as in `BoardWarp`."""
    low, high = board[:, :2].min(axis=0), board[:, :2].max(axis=0)
    unit = (2.0 * board[:, :2] - low - high) / (high - low)
    return np.column_stack([board[:, :2], (1.0 - unit**2) @ bow_mm])


def opencv_holdout(
    objects: list[FloatArray],
    images: list[FloatArray],
    size: tuple[int, int],
    ours: Ours | None = None,
    *,
    is_printed: bool = False,
) -> float:
    residuals = []
    for fold, (train, test) in enumerate(folds_of(len(images))):
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            [objects[i].astype(np.float32) for i in train],
            [images[i].astype(np.float32) for i in train],
            size,
            np.eye(3),
            np.zeros(5),
        )
        for i in test:
            board = objects[i]
            if ours is not None:
                bows = ours.printed_bows_mm if is_printed else ours.bows_mm
                board = bent(board, bows[fold])
            if ours is not None and is_printed:
                board = board + np.pad(ours.missed_mm[fold], ((0, 0), (0, 1)))
            residuals.append(posed(board, images[i], matrix, distortion))
    return rms(residuals)


def posed(
    board: FloatArray, image: FloatArray, matrix: FloatArray, distortion: FloatArray
) -> FloatArray:
    """Residuals of a view of which the pose alone is solved."""
    _, turn, shift = cv2.solvePnP(board, image, matrix, distortion)
    turn, shift = cv2.solvePnPRefineLM(board, image, matrix, distortion, turn, shift)
    predicted = cv2.projectPoints(board, turn, shift, matrix, distortion)[0]
    return image - predicted.reshape(-1, 2)


def released_holdout(
    board: FloatArray, images: list[FloatArray], size: tuple[int, int], columns: int
) -> float:
    """OpenCV's calibration that releases the places of the target's points."""
    residuals = []
    for train, test in folds_of(len(images)):
        _, matrix, distortion, _, _, found = cv2.calibrateCameraRO(
            [board.astype(np.float32)] * len(train),
            [images[i].astype(np.float32) for i in train],
            size,
            columns - 1,
            np.eye(3),
            np.zeros(5),
        )
        places = found.reshape(-1, 3).astype(np.float64)
        residuals += [posed(places, images[i], matrix, distortion) for i in test]
    return rms(residuals)


def compare(name: str, photos: PhotoSet) -> str:
    views, theirs = [], []
    for path in sorted(DATA.glob(photos.pattern)):
        exposure = read_exposure(path)
        view, points = detect_target(exposure, photos.target), opencv_points(exposure, photos)
        if isinstance(view, TargetView) and points is not None:
            views.append(view)
            theirs.append(points)
    size = (views[0].width_px, views[0].height_px)
    board = photos.target.points_board_mm
    ours = our_holdout(views, len(board))
    full = opencv_holdout([board] * len(theirs), theirs, size)
    bowed = opencv_holdout([board] * len(theirs), theirs, size, ours)
    printed = opencv_holdout([board] * len(theirs), theirs, size, ours, is_printed=True)
    final = calibrate_camera_from_views(views)
    shown = [view.view for view in final.fit.views] if isinstance(final, CameraRun) else views
    mixed = opencv_holdout(
        [view.points_board_mm for view in shown], [view.points_px for view in shown], size
    )
    whole = [view.points_px for view in shown if len(view) == len(board)]
    released = [
        released_holdout(board, points, size, photos.target.columns) for points in (theirs, whole)
    ]
    return (
        f"{name:24s} {len(views):5d} {ours.flat_px:9.4f} {full:9.4f} {ours.flat_px / full:7.3f} "
        f"{mixed:10.4f} {ours.flat_px / mixed:7.3f} {ours.bowed_px:9.4f} {bowed:9.4f} "
        f"{ours.bowed_px / bowed:7.3f} {ours.printed_px:9.4f} {printed:9.4f} "
        f"{ours.printed_px / printed:7.3f} {released[0]:9.4f} {released[1]:9.4f}  {ours.models}"
    )


def main() -> None:
    cv2.setNumThreads(1)
    print(__doc__.split("\n")[0])
    print(
        f"{'set':24s} {'views':>5s} {'ours':>9s} {'OpenCV':>9s} {'ratio':>7s} {'our points':>10s} "
        f"{'ratio':>7s} {'bowed':>9s} {'OpenCV':>9s} {'ratio':>7s} {'printed':>9s} {'OpenCV':>9s} "
        f"{'ratio':>7s} {'released':>9s} {'our pts':>9s}  model chosen (per fold)"
    )
    for name, photos in SETS.items():
        print(compare(name, photos), flush=True)


if __name__ == "__main__":
    main()
