# SPDX-License-Identifier: Apache-2.0
"""Scan passes of a head with one line over each object."""

from __future__ import annotations

import numpy as np

from armscan.simulation.arm.hand import (
    DEPTH_MM,
    HeadOrientation,
    ScanPass,
    leaning,
    on_face,
    quarter_turn,
)
from armscan.simulation.objects.fixtures import BALL_DIAMETER_MM, Bench

HALF_WAY_DEG = -21.3
"""Tilt at which laser and camera lie equally far from the face's normal."""

_OVER_BALL_DEG = -26.0
BALL_TILTS_DEG = (4.0, 26.0, 30.0, 24.0, 30.0, 26.0, 28.0)
BALL_AZIMUTHS_DEG = (0.0, 15.0, 75.0, 135.0, 195.0, 255.0, 315.0)
_BALL_WAY_MM = 25.0
BALL_HEIGHT = 0.8
"""Height, in radii, at which the stripe's middle passes over the ball's centre."""


def plate_strokes(bench: Bench) -> list[ScanPass]:
    """Three strokes of 130 mm across the plate, the head held differently in each."""
    face, origin = bench.base_from_plate.rotation, bench.base_from_plate.translation_mm
    ways = (
        ((-30.0, -65.0), (-30.0, 65.0), HeadOrientation(HALF_WAY_DEG, 3.0, 4.0, DEPTH_MM), 42.0),
        ((30.0, 65.0), (28.0, -65.0), HeadOrientation(-10.0, -6.0, -3.0, DEPTH_MM), 50.0),
        ((-65.0, 0.0), (65.0, 5.0), HeadOrientation(-34.0, 2.0, 84.0, DEPTH_MM), 38.0),
    )
    return [
        ScanPass(face, on_face(face, origin, start), on_face(face, origin, end), aim, speed, 8)
        for start, end, aim, speed in ways
    ]


def ball_strokes(bench: Bench) -> list[ScanPass]:
    """From above, then from six sides."""
    strokes = []
    for k, (tilt, azimuth) in enumerate(zip(BALL_TILTS_DEG, BALL_AZIMUTHS_DEG, strict=True)):
        face = leaning(tilt, azimuth)
        middle = bench.ball.centre_mm + BALL_HEIGHT * 0.5 * BALL_DIAMETER_MM * face[:, 2]
        way = (-1.0) ** k * 0.5 * _BALL_WAY_MM * face[:, 1]
        aim = HeadOrientation(_OVER_BALL_DEG, 0.0, 0.0, DEPTH_MM)
        strokes.append(ScanPass(face, middle - way, middle + way, aim, 30.0 + 2.0 * k, 10))
    return strokes


def step_strokes(bench: Bench) -> list[ScanPass]:
    """Two strokes over both blocks and the ground beside them, there and back."""
    face, origin = bench.base_from_ground.rotation, bench.base_from_ground.translation_mm
    lift = 10.0 * face[:, 2]
    return [
        ScanPass(
            face,
            on_face(face, origin, (0.0, side * 11.0)) + lift,
            on_face(face, origin, (0.0, -side * 11.0)) + lift,
            HeadOrientation(HALF_WAY_DEG + turn, 0.0, roll, DEPTH_MM),
            30.0,
            12,
        )
        for side, turn, roll in ((-1.0, 0.0, 2.0), (1.0, -6.0, -2.0))
    ]


def part_strokes(bench: Bench) -> list[ScanPass]:
    """Four strokes along the part, from its back, its top twice, and its front."""
    pose = bench.base_from_part
    strokes = []
    for side, lean, speed in (
        (-14.0, 25.0, 40.0),
        (-5.0, 6.0, 45.0),
        (5.0, -6.0, 50.0),
        (14.0, -25.0, 42.0),
    ):
        face = pose.rotation @ leaning(abs(lean), -90.0 if lean > 0.0 else 90.0) @ quarter_turn()
        start, end = (
            pose.translation_mm + pose.rotation @ np.array([x, side, 13.0]) for x in (-40.0, 40.0)
        )
        aim = HeadOrientation(HALF_WAY_DEG, 0.0, 0.0, DEPTH_MM)
        strokes.append(ScanPass(face, start, end, aim, speed, 10))
    return strokes


def wave_strokes(bench: Bench) -> list[ScanPass]:
    """Two strokes over the waves, square to each other."""
    pose = bench.base_from_waves
    ways = (
        ((-6.0, -35.0), (-2.0, 35.0), HeadOrientation(HALF_WAY_DEG, 2.0, 3.0, DEPTH_MM), 45.0),
        ((35.0, 4.0), (-35.0, -3.0), HeadOrientation(-16.0, -3.0, 86.0, DEPTH_MM), 40.0),
    )
    return [
        ScanPass(
            pose.rotation,
            on_face(pose.rotation, pose.translation_mm, start),
            on_face(pose.rotation, pose.translation_mm, end),
            aim,
            speed,
            12,
        )
        for start, end, aim, speed in ways
    ]
