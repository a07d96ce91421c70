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

from armscan.storage.clouds import read_ply
from armscan.storage.images import read_exposure
from armscan.vision.stripe.extract import extract_stripes

LINE = "#0b6e7f"


def photo(axes: Axes, image: np.ndarray, title: str) -> None:
    """Show a photograph, brightened for the page."""
    levels = np.clip(image / image.max(), 0.0, 1.0) ** 0.6
    axes.imshow(levels)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_axis_off()


def main(demo: Path, picture: Path) -> None:
    """Draw three steps of the demo side by side."""
    photos = demo / "photos"
    figure = Figure(figsize=(12.0, 3.7), layout="constrained")
    board, stripe, profile = figure.subplots(1, 3, width_ratios=(1.25, 1.25, 0.9))
    photo(board, read_exposure(photos / "laser/on/02.png").image, "1  the laser line on a board")
    laser = read_exposure(photos / "object/laser.png")
    centres = extract_stripes(laser, background=read_exposure(photos / "object/background.png"))
    photo(stripe, laser.image, "2  stripe centres on an object")
    x, y = centres.points_px[centres.is_accepted].T
    stripe.plot(x, y, ".", color="#35f2d0", markersize=1.2)
    cloud = read_ply(demo / "cloud.ply")
    _, y_mm, z_mm = cloud.points_mm.T
    profile.plot(z_mm, y_mm, ".", color=LINE, markersize=2.0)
    sigma_um = 1000.0 * np.median(cloud.sigma_mm)
    profile.set_title(
        f"3  {len(cloud)} points, median σ {sigma_um:.0f} µm", loc="left", fontsize=10
    )
    profile.set_xlabel("z, mm")
    profile.set_ylabel("y, mm")
    profile.invert_yaxis()
    profile.set_aspect("equal", adjustable="datalim")
    profile.spines[["top", "right"]].set_visible(False)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
