# SPDX-License-Identifier: Apache-2.0
"""Scan passes of a head with two crossed lines over each object."""

from __future__ import annotations

import numpy as np

from armscan.simulation.arm.hand import (
    BURST,
    DEPTH_MM,
    HeadOrientation,
    ScanPass,
    leaning,
    on_face,
    quarter_turn,
)
from armscan.simulation.arm.single_passes import BALL_HEIGHT, BALL_TILTS_DEG
from armscan.simulation.objects.fixtures import BALL_DIAMETER_MM, Bench

HALF_WAY_DEG = -19.1
"""Tilt at which camera and sheets lie equally far from the face's normal."""
_OVER_BALL_DEG = -24.0
_BALL_AZIMUTHS_DEG = (0.0, 15.0, 75.0, 135.0, 195.0, 255.0, 315.0)


def plate_strokes(bench: Bench) -> list[ScanPass]:
    """Three strokes across the plate, the head held differently in each."""
    face, origin = bench.base_from_plate.rotation, bench.base_from_plate.translation_mm
    ways = (
        ((-26.0, -28.0), (-22.0, 28.0), HeadOrientation(HALF_WAY_DEG, 3.0, 4.0, DEPTH_MM), 85.0),
        ((26.0, 28.0), (24.0, -28.0), HeadOrientation(-9.0, -6.0, -3.0, DEPTH_MM), 115.0),
        ((-28.0, 2.0), (28.0, -3.0), HeadOrientation(-30.0, 2.0, 84.0, DEPTH_MM), 100.0),
    )
    return [
        ScanPass(
            face, on_face(face, origin, start), on_face(face, origin, end), aim, speed, 40, BURST
        )
        for start, end, aim, speed in ways
    ]


def ball_strokes(bench: Bench) -> list[ScanPass]:
    """From above, then from six sides."""
    strokes = []
    for k, (tilt, azimuth) in enumerate(zip(BALL_TILTS_DEG, _BALL_AZIMUTHS_DEG, strict=True)):
        face = leaning(tilt, azimuth)
        middle = bench.ball.centre_mm + BALL_HEIGHT * 0.5 * BALL_DIAMETER_MM * face[:, 2]
        way = (-1.0) ** k * 12.0 * face[:, 1]
        aim = HeadOrientation(_OVER_BALL_DEG, 0.0, 0.0, DEPTH_MM)
        strokes.append(ScanPass(face, middle - way, middle + way, aim, 66.0 + k, 30, BURST))
    return strokes


def step_strokes(bench: Bench) -> list[ScanPass]:
    """Two strokes along the blocks, there and back: both stripes cross both blocks slantwise."""
    face, origin = bench.base_from_ground.rotation, bench.base_from_ground.translation_mm
    lift = 10.0 * face[:, 2]
    return [
        ScanPass(
            face,
            on_face(face, origin, (-side * 30.0, aside)) + lift,
            on_face(face, origin, (side * 30.0, aside)) + lift,
            HeadOrientation(HALF_WAY_DEG + turn, 0.0, roll, DEPTH_MM),
            95.0,
            50,
            BURST,
        )
        for side, aside, turn, roll in ((1.0, -3.0, 0.0, 2.0), (-1.0, 4.0, -6.0, -2.0))
    ]


def part_strokes(bench: Bench) -> list[ScanPass]:
    """Four strokes along the part, from its back, its top twice, and its front."""
    pose = bench.base_from_part
    strokes = []
    for side, lean, speed in (
        (-14.0, 25.0, 110.0),
        (-5.0, 6.0, 125.0),
        (5.0, -6.0, 120.0),
        (14.0, -25.0, 105.0),
    ):
        face = pose.rotation @ leaning(abs(lean), -90.0 if lean > 0.0 else 90.0) @ quarter_turn()
        start, end = (
            pose.translation_mm + pose.rotation @ np.array([x, side, 13.0]) for x in (-38.0, 38.0)
        )
        aim = HeadOrientation(HALF_WAY_DEG, 0.0, 0.0, DEPTH_MM)
        strokes.append(ScanPass(face, start, end, aim, speed, 50, BURST))
    return strokes


def wave_strokes(bench: Bench) -> list[ScanPass]:
    """Two strokes over the waves, square to each other."""
    face, origin = bench.base_from_waves.rotation, bench.base_from_waves.translation_mm
    ways = (
        ((-6.0, -28.0), (-2.0, 28.0), HeadOrientation(HALF_WAY_DEG, 2.0, 3.0, DEPTH_MM), 90.0),
        ((28.0, 4.0), (-28.0, -3.0), HeadOrientation(-15.0, -3.0, 86.0, DEPTH_MM), 105.0),
    )
    return [
        ScanPass(
            face, on_face(face, origin, start), on_face(face, origin, end), aim, speed, 45, BURST
        )
        for start, end, aim, speed in ways
    ]
