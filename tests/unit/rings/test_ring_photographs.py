# SPDX-License-Identifier: Apache-2.0
"""Photographs of ring tags; what is in them was counted by eye."""

from __future__ import annotations

import numpy as np

from armscan.storage.images import read_exposures
from armscan.vision.rings import RingDetection, detect_rings
from rigs.photographs import DATA, needs

FOLDER = DATA / "ring_markers"
pytestmark = needs("ring_markers")


def found_in(name: str) -> RingDetection:
    return detect_rings(read_exposures([FOLDER / name])[0])


def is_near(found: RingDetection, places: list[tuple[float, float]]) -> None:
    centres = found.rings.centres_px
    distance = np.linalg.norm(centres[:, None] - np.array(places), axis=2)
    assert len(centres) == len(places)
    assert distance.min(axis=0).max() < 3.0


def test_four_whole_tags_on_the_wall() -> None:
    """A fifth is cut by the image's border."""
    is_near(found_in("01.png"), [(486, 481), (885, 812), (932, 964), (1148, 886)])


def test_three_tags_within_the_tilt_and_two_beyond() -> None:
    """A sixth, 40 px high, is too small for its three rings to be apart."""
    found = found_in("02.png")
    is_near(found, [(1704, 514), (1450, 667), (1476, 827)])
    assert found.reasons == ("roundness", "roundness")


def test_plate_of_coded_rings_part_out_of_focus() -> None:
    """About 74 whole rings are sharp; none may be found where there is none."""
    found = found_in("target_3_split_00.png").rings
    assert 66 <= len(found) <= 80
    # Rings stand about 57 px apart: no ring is found twice, and none between two.
    distance = np.linalg.norm(found.centres_px[:, None] - found.centres_px, axis=2)
    np.fill_diagonal(distance, np.inf)
    assert distance.min() > 45.0
    assert found.perimeter_px.min() > 120.0
    assert found.perimeter_px.max() < 165.0
