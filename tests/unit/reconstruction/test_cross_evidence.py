# SPDX-License-Identifier: Apache-2.0
"""Depth, direction and uniqueness of stripes, on the printed sheets of the thesis."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.label_cross import (
    CONVINCING,
    OUTSIDE,
    TAKEN,
    frontal_direction,
    hypothesise,
    past_evidence,
    still_evidence,
    taken_evidence,
)
from armscan.reconstruction.segments import Pieces, cut_pieces
from armscan.reconstruction.triangulate import DepthRange
from rigs.cross_rig import PLANES, camera, light_sheet, sensor
from rigs.sheet_rig import make_profile

SENSOR = sensor()
DEPTHS = DepthRange(0.0)


def stripe_px(
    name: str, depth_mm: float, span_mm: float = 16.0, start_mm: float = 0.0
) -> FloatArray:
    """Pixels where a plate at one depth, square to the camera, shows a sheet from a place on."""
    sheet = light_sheet(name)
    down = (depth_mm - sheet.origin_mm[2]) / sheet.axes[1, 2]
    along = start_mm + np.arange(0.0, span_mm, 0.025)[:, None]
    points = sheet.origin_mm + down * sheet.axes[1] + along * sheet.axes[0]
    return camera().project(points)


def pieces_of(*stripes: FloatArray) -> tuple[Pieces, FloatArray]:
    normals = [np.tile([0.0, 1.0], (len(points), 1)) for points in stripes]
    profile = make_profile("plate", list(zip(stripes, normals, strict=True)), 0.06)
    pieces = cut_pieces(profile)
    return pieces, profile.points_px[pieces.sample]


def test_directions_are_those_that_were_measured() -> None:
    """FINDINGS: stripes of A lie at about -50 degrees in the image, those of B at about +55."""
    found = []
    for sheet in (0, 1):
        x, y = frontal_direction(SENSOR, sheet)
        found.append(np.degrees(np.arctan2(y, x) + np.pi / 2) % 180.0 - 90.0)
    assert found == pytest.approx([-50.0, 55.0], abs=2.0)


def test_points_of_the_right_hypothesis_are_the_plate() -> None:
    pieces, samples = pieces_of(stripe_px("A", 140.0))
    found = hypothesise(samples, (0, 1), SENSOR, DEPTHS)
    assert found.points_mm[0, :, 2] == pytest.approx(np.full(len(samples), 140.0), abs=1e-6)
    plane = PLANES["B"]
    assert found.points_mm[1] @ plane[:3] + plane[3] == pytest.approx(0.0, abs=1e-6)
    # 16 mm of A's stripe lead B's sheet out of its depths: the wrong name is mostly impossible
    assert found.is_inside[:, 0].all()
    assert not found.is_inside[:, 1].all()
    evidence = still_evidence(pieces, found, SENSOR)
    assert (evidence[:, 0] > evidence[:, 1] + 2.0 / len(pieces)).all()
    out = pieces.mean((~found.is_inside).astype(float))[:, 1] == 1.0
    assert out.any()
    assert (evidence[out, 1] < evidence[out, 0] + OUTSIDE / len(pieces)).all()


def test_depths_that_are_near_speak_against_no_sheet_where_that_is_asked() -> None:
    """A plate beyond the depths of its own line, and within those of another: no name by depth."""
    pieces, samples = pieces_of(stripe_px("A", 140.0))
    found = hypothesise(samples, (0, 1), SENSOR, DEPTHS)
    assert found.is_near.all()
    outside = ~found.is_inside[:, 1]
    strict = still_evidence(pieces, found, SENSOR)
    wide = still_evidence(pieces, found, SENSOR, is_wide=True)
    assert wide[:, 0] == pytest.approx(strict[:, 0], abs=1e-12)
    share = pieces.mean(outside.astype(float))
    assert wide[:, 1] - strict[:, 1] == pytest.approx(-OUTSIDE * share / len(pieces))


def test_a_long_stretch_does_not_count_each_of_its_pieces() -> None:
    long, short = pieces_of(stripe_px("B", 140.0))[0], pieces_of(stripe_px("B", 140.0, 0.6))[0]
    assert len(short) == 1
    certain = np.ones((len(long.sample), 2)) * [0.0, 1.0]
    vague = past_evidence(long, certain, np.zeros_like(certain))[:, 1].sum()
    sharp = past_evidence(long, certain, np.ones_like(certain))[:, 1].sum()
    assert vague == pytest.approx(1.0)
    assert sharp == pytest.approx(0.5 * len(long))
    one = np.ones((len(short.sample), 1))
    assert past_evidence(short, one, np.zeros_like(one)).sum() == pytest.approx(1.0 / CONVINCING)


def test_light_that_falls_on_one_thing_does_not_fall_on_another() -> None:
    """Two stretches along the same rays of A: the one believed to be A's denies it to the other."""
    apart = stripe_px("A", 140.0, 6.0), stripe_px("A", 132.0, 6.0), stripe_px("A", 140.0, 6.0, -9.0)
    pieces, samples = pieces_of(*apart)
    found = hypothesise(samples, (0, 1), SENSOR, DepthRange(0.2))
    believed = np.log(np.full((len(pieces), 2), 0.5))
    believed[pieces.segment == 0] = np.log([1.0 - 1e-9, 1e-9])
    believed[pieces.segment == 1] = np.log([1e-9, 1.0 - 1e-9])
    penalty = taken_evidence(believed, pieces, found)[:, 0]
    total = [penalty[pieces.segment == k].sum() for k in range(3)]
    assert total[1] == pytest.approx(TAKEN, rel=0.2)
    assert total[0] == pytest.approx(0.0, abs=1e-6)
    assert total[2] == pytest.approx(0.0, abs=1e-6)
