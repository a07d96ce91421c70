# SPDX-License-Identifier: Apache-2.0
"""Target detection in folders of photographs, ours against OpenCV's finders.

Command: ``python benchmarks/target_detection.py TARGET FOLDER [FOLDER ...] [--pattern '*.png']
[--no-exhaustive]``, for example ``chessboard:8x6:40 photos``. Nothing is random and nothing is
written. One camera per folder: the hold-out needs that.

``--command`` runs, for each folder, ``armscan calibrate camera`` on its images without cache, and
OpenCV's finder at full size with its ``calibrateCamera``, each in a process of its own, and prints
the processor times and their ratio: a loaded machine slows both alike.

Columns: images; found by OpenCV's classic finder and by its sector-based one (circle grids: by
findCirclesGrid, in the second column with clustering), both on the luminance at full size reduced
to 1400 px; found by ours, of these whole and in part; missed, of those that OpenCV found; wrong,
views of which a point lies more than 3 % of the image's width off where a camera calibrated from
all views puts it; seconds an image for each finder.

Then the hold-out of `camera_holdout`: five folds, each held-out view gets a pose alone, the rms
is that of the residuals' lengths in px over the points of the views that OpenCV found, too, and of
those that only ours found: extra boards that were wrong or misnumbered would show there.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from camera_holdout import folds_of

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_views
from armscan.records.exposure import Exposure
from armscan.storage.images import read_exposure
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import CircleGrid, Target, TargetView, parse_target

SIZE_PX = 1400
SECTORS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
WRONG = 0.03


@dataclass
class Found:
    views: list[TargetView] = field(default_factory=list)
    by_opencv: list[bool] = field(default_factory=list)
    n_images: int = 0
    n_classic: int = 0
    n_sectors: int = 0
    missed: list[str] = field(default_factory=list)
    seconds: FloatArray = field(default_factory=lambda: np.zeros(3))


def luminance(exposure: Exposure) -> np.ndarray:
    image = exposure.image
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if grey.dtype != np.uint8:
        grey = np.clip(grey * (255.0 / exposure.full_scale), 0, 255).astype(np.uint8)
    factor = max(grey.shape) / SIZE_PX
    if factor > 1.0:
        grey = cv2.resize(grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    return grey


def opencv_finds(grey: np.ndarray, target: Target, flags: int) -> tuple[bool, bool, float, float]:
    size = (target.columns, target.rows)
    start = time.perf_counter()
    if isinstance(target, CircleGrid):
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.is_asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        first = cv2.findCirclesGrid(grey, size, flags=kind)[0]
        middle = time.perf_counter()
        second = cv2.findCirclesGrid(grey, size, flags=kind | cv2.CALIB_CB_CLUSTERING)[0]
    else:
        first = cv2.findChessboardCorners(grey, size)[0]
        middle = time.perf_counter()
        second = cv2.findChessboardCornersSB(grey, size, flags=flags)[0]
    return bool(first), bool(second), middle - start, time.perf_counter() - middle


def search(paths: list[Path], target: Target, flags: int) -> Found:
    found = Found(n_images=len(paths))
    for path in paths:
        exposure = read_exposure(path)
        classic, sectors, first, second = opencv_finds(luminance(exposure), target, flags)
        start = time.perf_counter()
        view = detect_target(exposure, target)
        found.seconds += (first, second, time.perf_counter() - start)
        found.n_classic += classic
        found.n_sectors += sectors
        if isinstance(view, TargetView):
            found.views.append(replace(view, source=str(path)))
            found.by_opencv.append(classic or sectors)
        elif classic or sectors:
            found.missed.append(f"{path.name}: {view.reason}")
    return found


def held_out(views: list[TargetView]) -> list[FloatArray]:
    """Residuals (N, 2) of each view, from a camera that was solved without it."""
    residuals = [np.full((len(view), 2), np.nan) for view in views]
    for train, test in folds_of(len(views)):
        run = calibrate_camera_from_views([views[i] for i in train])
        if not isinstance(run, CameraRun):
            continue
        for i in test:
            view = correct_centres(views[i], run.fit.camera) if views[i].edges else views[i]
            pose = estimate_board_pose(view, run.fit.camera, allow_ambiguous=True)
            if isinstance(pose, Estimate):
                residuals[i] = pose.residuals.reshape(-1, 2)
    return residuals


def rms(residuals: list[FloatArray]) -> str:
    if not residuals:
        return "-"
    return f"{np.sqrt(np.nanmean(np.sum(np.concatenate(residuals) ** 2, axis=1))):.3f}"


def report(folder: Path, found: Found, target: Target) -> None:
    n_points = len(target.points_board_mm)
    whole = sum(len(view) == n_points for view in found.views)
    residuals = held_out(found.views) if len(found.views) > 5 else []
    width = found.views[0].width_px if found.views else 1
    wrong = [
        view.source
        for view, residual in zip(found.views, residuals, strict=False)
        if np.isfinite(residual).all() and np.abs(residual).max() > WRONG * width
    ]
    known = [r for r, by in zip(residuals, found.by_opencv, strict=False) if by]
    extra = [r for r, by in zip(residuals, found.by_opencv, strict=False) if not by]
    seconds = found.seconds / max(found.n_images, 1)
    print(
        f"{folder.name:24s} {found.n_images:6d} {found.n_classic:7d} {found.n_sectors:7d} "
        f"{len(found.views):5d} {whole:5d} {len(found.views) - whole:5d} {len(found.missed):6d} "
        f"{len(wrong):5d} {rms(known):>8s} {rms(extra):>8s}  "
        + " ".join(f"{value:.2f}" for value in seconds),
        flush=True,
    )
    for line in [*found.missed, *(f"wrong: {name}" for name in wrong)]:
        print(f"    {line}")


OPENCV_ALONE = """
import sys
import cv2
import numpy as np
kind, columns, rows, *paths = sys.argv[1:]
cv2.setNumThreads(1)
size = (int(columns), int(rows))
board = np.zeros((size[0] * size[1], 3), np.float32)
board[:, :2] = np.mgrid[: size[0], : size[1]].T.reshape(-1, 2)
if kind == "acircles":
    board[:, 0] = 2 * board[:, 0] + board[:, 1] % 2
large = cv2.SimpleBlobDetector_Params()
large.maxArea = 50_000
flags = cv2.CALIB_CB_ASYMMETRIC_GRID if kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
boards, points = [], []
for path in paths:
    grey = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    if kind == "corners":
        found, corners = cv2.findChessboardCornersSB(grey, size)
    else:
        finder = cv2.SimpleBlobDetector_create(large)
        found, corners = cv2.findCirclesGrid(grey, size, flags=flags, blobDetector=finder)
    if found:
        boards.append(board)
        points.append(corners)
if boards:
    cv2.calibrateCamera(boards, points, grey.shape[::-1], None, None)
print(len(boards))
"""


def processor_seconds(command: list[str]) -> tuple[float, float, str]:
    """Processor and wall-clock seconds of a process and its own children, and what it printed."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(done.stderr)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return used, wall, done.stdout


@dataclass(frozen=True)
class Beside:
    """Processor and wall-clock seconds of our command and of OpenCV's script; boards it found."""

    ours: tuple[float, float]
    opencv: tuple[float, float]
    n_found: str


def beside_opencv(paths: list[Path], text: str, repeats: int = 3) -> Iterator[Beside]:
    """Whole command beside OpenCV's finder and calibration, after one run that warms the files."""
    target = parse_target(text)
    kind = "corners"
    if isinstance(target, CircleGrid):
        kind = "acircles" if target.is_asymmetric else "circles"
    names = [str(path) for path in paths]
    size = [str(target.columns), str(target.rows)]
    theirs = [sys.executable, "-c", OPENCV_ALONE, kind, *size, *names]
    with tempfile.TemporaryDirectory() as place:
        out = ["-o", f"{place}/camera.json", "--no-cache", "--force"]
        program = "from armscan.cli import main; main()"
        ours = [sys.executable, "-c", program, "calibrate", "camera", *names]
        ours += ["--target", text, *out]
        processor_seconds(ours)
        for _ in range(repeats):
            *taken, _ = processor_seconds(ours)
            *other, found = processor_seconds(theirs)
            yield Beside((taken[0], taken[1]), (other[0], other[1]), found.strip())


def tell_beside(folder: Path, paths: list[Path], text: str) -> None:
    for one in beside_opencv(paths, text):
        print(
            f"{folder.name:24s} {len(paths):3d} images: ours {one.ours[0]:.2f} s processor, "
            f"{one.ours[1]:.2f} s wall; OpenCV {one.opencv[0]:.2f} and {one.opencv[1]:.2f} s, "
            f"{one.n_found} found; ratio {one.ours[0] / one.opencv[0]:.2f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("target")
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--pattern", default="*.[pjbtPJBT][npgmiNPGMI]*")
    parser.add_argument("--no-exhaustive", action="store_true", help="of the sector-based finder")
    parser.add_argument("--command", action="store_true", help="time the whole command instead")
    options = parser.parse_args()
    if options.command:
        for folder in options.folders:
            tell_beside(folder, sorted(folder.glob(options.pattern)), options.target)
        return
    cv2.setNumThreads(1)
    target = parse_target(options.target)
    flags = SECTORS & ~cv2.CALIB_CB_EXHAUSTIVE if options.no_exhaustive else SECTORS
    print(
        f"{'folder':24s} {'images':>6s} {'classic':>7s} {'sectors':>7s} {'ours':>5s} {'whole':>5s} "
        f"{'part':>5s} {'missed':>6s} {'wrong':>5s} {'rms both':>8s} {'rms ours':>8s}  s an image"
    )
    for folder in options.folders:
        paths = sorted(folder.glob(options.pattern))
        report(folder, search(paths, target, flags), target)


if __name__ == "__main__":
    main()
