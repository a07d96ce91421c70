# SPDX-License-Identifier: Apache-2.0
"""Scan passes of a head with many lines and two cameras over each object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.simulation.arm.hand import HeadOrientation, ScanPass, leaning, on_face
from armscan.simulation.arm.single_passes import BALL_HEIGHT
from armscan.simulation.objects.fixtures import BALL_DIAMETER_MM, Bench

_BALL_TILTS_DEG = (3.0, 27.0, 30.0, 28.0, 32.0, 26.0)
_BALL_AZIMUTHS_DEG = (0.0, 30.0, 102.0, 174.0, 246.0, 318.0)
_BALL_WAY_MM = 16.0


def plate_strokes(bench: Bench, facing: HeadOrientation) -> list[ScanPass]:
    """Two strokes of 120 mm across the plate, the head held differently in each."""
    face, origin = bench.base_from_plate.rotation, bench.base_from_plate.translation_mm
    ways = (
        ((-60.0, -25.0), (60.0, -22.0), turned(facing, 4.0, 3.0, -4.0), 46.0),
        ((55.0, 28.0), (-55.0, 20.0), turned(facing, -9.0, -8.0, 12.0), 40.0),
    )
    return [
        ScanPass(face, on_face(face, origin, start), on_face(face, origin, end), aim, speed, 8)
        for start, end, aim, speed in ways
    ]


def ball_strokes(bench: Bench, facing: HeadOrientation) -> list[ScanPass]:
    """From above, then from five sides."""
    strokes = []
    for k, (tilt, azimuth) in enumerate(zip(_BALL_TILTS_DEG, _BALL_AZIMUTHS_DEG, strict=True)):
        face = leaning(tilt, azimuth)
        middle = bench.ball.centre_mm + BALL_HEIGHT * 0.5 * BALL_DIAMETER_MM * face[:, 2]
        way = (-1.0) ** k * 0.5 * _BALL_WAY_MM * face[:, 0]
        strokes.append(ScanPass(face, middle - way, middle + way, facing, 30.0 + 2.0 * k, 5))
    return strokes


def step_strokes(bench: Bench, facing: HeadOrientation) -> list[ScanPass]:
    """Two strokes along the blocks, there and back."""
    face, origin = bench.base_from_ground.rotation, bench.base_from_ground.translation_mm
    lift = 10.0 * face[:, 2]
    return [
        ScanPass(
            face,
            on_face(face, origin, (-side * 32.0, aside)) + lift,
            on_face(face, origin, (side * 32.0, aside)) + lift,
            turned(facing, tilt, 0.0, roll),
            36.0,
            8,
        )
        for side, aside, tilt, roll in ((1.0, -3.0, 0.0, 2.0), (-1.0, 4.0, -6.0, -5.0))
    ]


def part_strokes(bench: Bench, facing: HeadOrientation) -> list[ScanPass]:
    """Four strokes along the part, from its back, its top twice, and its front."""
    pose = bench.base_from_part
    strokes = []
    for side, lean, speed in (
        (-14.0, 25.0, 40.0),
        (-5.0, 6.0, 45.0),
        (5.0, -6.0, 50.0),
        (14.0, -25.0, 42.0),
    ):
        face = pose.rotation @ leaning(abs(lean), -90.0 if lean > 0.0 else 90.0)
        start, end = (
            pose.translation_mm + pose.rotation @ np.array([x, side, 13.0]) for x in (-40.0, 40.0)
        )
        strokes.append(ScanPass(face, start, end, facing, speed, 6))
    return strokes


def wave_strokes(bench: Bench, facing: HeadOrientation) -> list[ScanPass]:
    """Two strokes over the waves, the head turned between them."""
    face, origin = bench.base_from_waves.rotation, bench.base_from_waves.translation_mm
    ways = (
        ((-35.0, -5.0), (35.0, -2.0), turned(facing, 2.0, 2.0, -3.0), 44.0),
        ((4.0, 32.0), (-3.0, -32.0), turned(facing, -5.0, -4.0, -35.0), 38.0),
    )
    return [
        ScanPass(face, on_face(face, origin, start), on_face(face, origin, end), aim, speed, 8)
        for start, end, aim, speed in ways
    ]


def turned(
    aim: HeadOrientation, tilt_x_deg: float, tilt_y_deg: float, roll_deg: float
) -> HeadOrientation:
    """The aim with more tilt and roll."""
    return replace(
        aim,
        tilt_x_deg=aim.tilt_x_deg + tilt_x_deg,
        tilt_y_deg=aim.tilt_y_deg + tilt_y_deg,
        roll_deg=aim.roll_deg + roll_deg,
    )
