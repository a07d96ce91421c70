# SPDX-License-Identifier: Apache-2.0
"""Draw the README's picture from the demo's files.

Command: ``make demo && .venv/bin/python docs/images/demo_picture.py demo docs/images/demo.png``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armscan.geometry.estimate import FitFailure
from armscan.inspection.sphere import inspect_sphere
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.scan import measure_scan
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.recording import FolderRecording, read_recording
from armscan.vision.stripe.extract import extract_stripes

LINE, ACCENT, MUTED = "#0b6e7f", "#c8541b", "#5d6b7a"
BALL_MM = 34.96


def draw_stripe(axes: Axes, scan: FolderRecording) -> None:
    """One exposure of the ball with its stripe centres."""
    exposure = scan.exposure(len(scan.rows) // 3)
    levels = np.clip(exposure.image / 90.0, 0.0, 1.0) ** 0.6
    axes.imshow(levels, cmap="gray", extent=(0, exposure.width_px, exposure.height_px, 0))
    found = extract_stripes(exposure)
    x, y = (found.points_px[found.is_accepted] - [exposure.window.x_px, exposure.window.y_px]).T
    axes.plot(x, y, ".", color="#35f2d0", markersize=1.0)
    axes.set(xlim=(x.min() - 250, x.max() + 250), ylim=(exposure.height_px, 0))
    axes.set_title("1  the laser line on a ball, centres found", loc="left", fontsize=10)
    axes.set_axis_off()


def draw_postures(axes: Axes, scan: FolderRecording, scanner: ScannerCalibration) -> None:
    """The head over the plate, from the side: where it was and where it looked."""
    arm = scan.arm
    if arm is None:
        raise SystemExit("the recording has no arm")
    for row in np.flatnonzero(arm.is_known):
        pose = arm.pose(int(row)) @ scanner.hand_eye.tool_from_sensor
        start = pose.translation_mm
        end = start + 60.0 * pose.rotation[:, 2]
        axes.plot([start[0], end[0]], [start[2], end[2]], color=LINE, linewidth=1.2)
        axes.plot(start[0], start[2], "o", color=LINE, markersize=4.0)
    axes.axhline(scanner.hand_eye.plate.point_mm[2], color=ACCENT, linewidth=2.5)
    axes.set_title("2  hand-eye: postures over a flat plate", loc="left", fontsize=10)
    axes.set(xlabel="x in Base, mm", ylabel="z, mm", aspect="equal")


def draw_ball(axes: Axes, scan: FolderRecording, scanner: ScannerCalibration) -> None:
    """Distances of the ball's points from the nominal radius."""
    ball = inspect_sphere(measure_scan(scan, scanner).cloud, BALL_MM)
    if isinstance(ball, FitFailure):
        raise SystemExit(ball.reason)
    micrometres = 1000.0 * ball.nominal.deviations_mm
    axes.hist(micrometres, bins=np.arange(-50.0, 51.0, 1.0), color=LINE)
    axes.set_title(
        f"3  {len(micrometres):,} points: {ball.diameter.value_mm:.3f} mm for {BALL_MM} mm",
        loc="left",
        fontsize=10,
    )
    axes.set(xlabel="distance from the nominal radius, µm", yticks=[])


def main(demo: Path, picture: Path) -> None:
    """Draw three steps of the demo side by side."""
    scanner = read_scanner_calibration(demo / "scanner.json")
    ball = read_recording(demo / "recordings" / "ball")
    figure = Figure(figsize=(12.0, 3.3), layout="constrained")
    stripe, postures, histogram = figure.subplots(1, 3, width_ratios=(1.35, 1.0, 0.9))
    draw_stripe(stripe, ball)
    draw_postures(postures, read_recording(demo / "recordings" / "hand-eye"), scanner)
    draw_ball(histogram, ball, scanner)
    for axes in (postures, histogram):
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(colors=MUTED, labelsize=8)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
