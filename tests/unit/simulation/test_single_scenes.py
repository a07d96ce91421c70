# SPDX-License-Identifier: Apache-2.0
"""The single head's scenes are what they were when their figures were measured.

The table was written before heads of two cameras and of several lasers existed, from seed 7. It
changes only together with every figure in the docs that was measured on this head.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from armscan.devices.sources import TwinScene
from armscan.simulation.twin import build_twin

scan_of = cache(build_twin(seed=7).scan)
PLACE_MM = 2e-6
"""The table is rounded to a micrometre's thousandth; the arm's inverse stops below that."""


@dataclass(frozen=True)
class Pinned:
    """Count and last row of a scene, where things are then, and a patch of one image."""

    scene: TwinScene
    n_rows: int
    last_t_ns: int
    last_file: str
    place_mm: list[float]
    arm_mm: list[float] | None
    row: int
    corner: tuple[int, int]
    levels: list[list[int]]


TABLE = (
    Pinned(
        "camera",
        15,
        30000000000,
        "images/15.png",
        [16.827697, -17.110462, 167.345108],
        None,
        5,
        (900, 1297),
        [
            [159, 158, 158, 159, 155, 163],
            [161, 157, 160, 160, 159, 159],
            [158, 164, 158, 158, 161, 158],
        ],
    ),
    Pinned(
        "laser",
        16,
        32000000000,
        "images/off/08.png",
        [4.50582, 2.266484, 154.952385],
        None,
        5,
        (900, 1297),
        [[56, 56, 54, 58, 58, 59], [57, 57, 58, 56, 57, 58], [56, 56, 60, 57, 56, 58]],
    ),
    Pinned(
        "hand-eye",
        24,
        64800000000,
        "images/0024.png",
        [612.159956, -151.445649, 133.557432],
        [600.812172, -48.725058, 196.661565],
        8,
        (1165, 1969),
        [
            [160, 187, 238, 255, 216, 162],
            [135, 160, 196, 208, 167, 132],
            [102, 110, 126, 124, 109, 90],
        ],
    ),
    Pinned(
        "plate",
        24,
        17887500000,
        "images/0024.png",
        [746.944558, -180.062186, 105.545899],
        [707.894146, -137.053513, 210.69],
        8,
        (393, 741),
        [
            [167, 184, 212, 221, 117, 124],
            [164, 187, 213, 216, 128, 137],
            [138, 164, 181, 179, 132, 132],
        ],
    ),
    Pinned(
        "ball",
        70,
        25987500000,
        "images/0070.png",
        [641.382012, -234.682668, 152.270999],
        [711.909604, -208.964849, 250.318995],
        23,
        (361, 1256),
        [
            [127, 168, 213, 217, 195, 169],
            [117, 158, 197, 195, 179, 165],
            [94, 116, 134, 132, 136, 141],
        ],
    ),
    Pinned(
        "steps",
        24,
        7650000000,
        "images/0024.png",
        [604.893702, -228.137038, 126.291316],
        [653.65804, -182.601937, 227.605275],
        8,
        (168, 1084),
        [
            [208, 204, 230, 255, 250, 204],
            [222, 211, 221, 216, 211, 192],
            [191, 188, 179, 165, 160, 159],
        ],
    ),
    Pinned(
        "still-step",
        1,
        5000000000,
        "images/0001.png",
        [590.591102, -245.348309, 104.458952],
        [632.756262, -224.159868, 215.978831],
        0,
        (190, 1252),
        [[104, 118, 147, 153, 138, 113], [93, 117, 138, 137, 117, 103], [73, 87, 103, 94, 80, 76]],
    ),
    Pinned(
        "part",
        40,
        19175000000,
        "images/0040.png",
        [591.915431, -82.615948, 148.972946],
        [660.770955, -73.434346, 250.860612],
        13,
        (311, 1383),
        [
            [168, 166, 220, 255, 224, 179],
            [139, 155, 222, 255, 230, 191],
            [110, 127, 165, 183, 165, 149],
        ],
    ),
)


@pytest.mark.parametrize("pinned", TABLE, ids=lambda p: p.scene)
def test_rows_and_places_are_unchanged(pinned: Pinned):
    scan = scan_of(pinned.scene)
    last = scan.rows[-1]
    assert (len(scan.rows), last.t_ns, last.source) == (
        pinned.n_rows,
        pinned.last_t_ns,
        pinned.last_file,
    )
    assert last.camera == 0 and len(scan.session.cameras) == 1
    shot = scan.shots[-1]
    target = shot.station.target
    pose = shot.base_from_sensor if target is None else target.base_from_board
    np.testing.assert_allclose(pose.translation_mm, pinned.place_mm, atol=PLACE_MM)
    if pinned.arm_mm is not None:
        assert scan.arm is not None
        np.testing.assert_allclose(scan.arm.translations_mm[-1], pinned.arm_mm, atol=PLACE_MM)


@pytest.mark.parametrize("pinned", TABLE, ids=lambda p: p.scene)
def test_images_are_unchanged_to_their_noise(pinned: Pinned):
    """One level is left for another platform's rounding: other noise differs by more."""
    image = scan_of(pinned.scene).exposure(pinned.row).image
    top, left = pinned.corner
    patch = image[top : top + 3, left : left + 6].astype(int)
    assert np.abs(patch - np.array(pinned.levels)).max() <= 1
