# SPDX-License-Identifier: Apache-2.0
"""Public photographs of laser lines on boards, for `real_lasers.py`: where they are, what they are.

Nothing of them is in this repository. Clone each repository into a folder of its own name under one
root, and give that root to the benchmark.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class LaserSet:
    """One set of photographs.

    Parameters
    ----------
    repository
        ``owner/name`` on GitHub; its name is the folder under the root.
    camera, on, off
        Patterns under that folder, parted by blanks: photographs of the board for the camera, with
        the laser, and of the same placements without it (empty: none were taken).
    target
        As the command line takes it.
    margin_mm
        How far the flat plate goes on around the target's points to the left, top, right and
        bottom, as one would measure it; the script is told, ours is not.
    n_lines
        Lines in the light at once.
    is_held_out
        Not looked at while the stripe and sheet parts were written.
    shows
        What it shows.
    """

    repository: str
    camera: str
    on: str
    off: str
    target: str
    margin_mm: tuple[float, ...]
    n_lines: int
    is_held_out: bool
    shows: str

    def files(self, root: Path, pattern: str) -> list[Path]:
        """Images of one of its fields, by name."""
        folder = root / self.repository.split("/")[1]
        return sorted(path for part in pattern.split() for path in folder.glob(part))


DESKTOP = "srv/desktop_3d_scanner"
DESKTOP_IMAGES = "python/calib_images"
BLASER = "biorobotics/blaser-calibration-matlab"
ETNA = "openlmd/etna"
STEREO = "SamJones329/laser_stereo_system"

SETS = {
    "desktop-0717": LaserSet(
        DESKTOP,
        f"{DESKTOP_IMAGES}/Camera/Calibracio17_07/*.jpg",
        f"{DESKTOP_IMAGES}/Laser/Calibracio17_07/*.jpg",
        "",
        "chessboard:8x6:40",
        (165.0, 90.0, 120.0, 80.0),
        1,
        is_held_out=False,
        shows="VGA webcam, JPEG, board held by hand in room light, faint green line 2 px wide, "
        "mostly on the white border",
    ),
    "light-stripe": LaserSet(
        "hjamal3/Light-Stripe-Calibration",
        "images/*.jpg",
        "images/*.jpg",
        "",
        "chessboard:8x6:40",
        (45.0,) * 4,
        1,
        is_held_out=False,
        shows="VGA, fx/fy = 0.75, strong distortion, green line with a halo across the squares; "
        "six images for camera and laser",
    ),
    "linelight": LaserSet(
        "zhaocongyang/structured_LineLight_calib",
        "calib_picture/*.jpg",
        "light_picture/*.jpg",
        "calib_picture/*.jpg",
        "circle-grid:7x7:37.5",
        (35.0,) * 4,
        1,
        is_held_out=False,
        shows="1920x1080, red line with a white core, circle grid, each placement with and without",
    ),
    "etna-4": LaserSet(
        ETNA,
        "etna_calib/data/calib4/*frame*.png",
        "etna_calib/data/calib4/*frame*.png",
        "",
        "chessboard:7x6:10",
        (70.0,) * 4,
        1,
        is_held_out=False,
        shows="monochrome, saturated line 15 px wide beside the board, on the same plate",
    ),
    "laser-stereo-4": LaserSet(
        STEREO,
        "calib_imgs/set4/*.png",
        "calib_imgs/set4/*.png",
        "",
        "chessboard:9x6:29.09",
        (500.0,) * 4,
        15,
        is_held_out=False,
        shows="2208x1242, 15 green lines at once beside the board, on a wall",
    ),
    "desktop-1207": LaserSet(
        DESKTOP,
        f"{DESKTOP_IMAGES}/Camera/Calibracio12_07/*.png",
        f"{DESKTOP_IMAGES}/Laser/CalibracioLaser1207/*.png",
        "",
        "chessboard:8x6:40",
        (165.0, 90.0, 120.0, 80.0),
        1,
        is_held_out=True,
        shows="1920x1080, dim, green line on the white border; board often cut by the image",
    ),
    "etna-3": LaserSet(
        ETNA,
        "etna_calib/data/calib3/*frame*.png",
        "etna_calib/data/calib3/*frame*.png",
        "",
        "chessboard:7x6:10",
        (50.0,) * 4,
        1,
        is_held_out=True,
        shows="as etna-4, dimmer, with reflections of the head",
    ),
    "blaser-640": LaserSet(
        BLASER,
        "blaser_data/640_unified/*.png",
        "blaser_data/640_unified/*.png",
        "",
        "chessboard:9x6:5",
        (25.0,) * 4,
        1,
        is_held_out=True,
        shows="VGA endoscope, red speckled line above and over the squares, near range",
    ),
    "blaser-1280": LaserSet(
        BLASER,
        "blaser_data/1280_unified/*.png",
        "blaser_data/1280_unified/*.png",
        "",
        "chessboard:9x6:5",
        (25.0,) * 4,
        1,
        is_held_out=True,
        shows="as blaser-640 with 1280x960",
    ),
    "blaser-handheld": LaserSet(
        BLASER,
        "blaser_data/handheld_1280x720/*.png",
        "blaser_data/handheld_1280x720/im[1-9].png blaser_data/handheld_1280x720/im1[0-7].png",
        "",
        "chessboard:9x6:30",
        (60.0,) * 4,
        1,
        is_held_out=True,
        shows="wide angle, strong distortion, saturated red line over the squares",
    ),
}
