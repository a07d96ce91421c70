# SPDX-License-Identifier: Apache-2.0
"""How a person scans each object with each kind of head: the passes of ``scenes.toml``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose
from armscan.simulation.arm.hand import (
    BURST,
    DEPTH_MM,
    UNHURRIED,
    HeadOrientation,
    ScanPass,
    facing_both,
    leaning,
    light_upright,
    on_face,
    quarter_turn,
)
from armscan.simulation.head import Head
from armscan.simulation.objects.fixtures import (
    BALL_DIAMETER_MM,
    STEP_CENTRES_MM,
    STEP_HEIGHTS_MM,
    Fixtures,
)
from armscan.simulation.plans import PLANS

SweptScene = Literal["plate", "ball", "steps", "part", "waves"]
Way = tuple[FloatArray, FloatArray, FloatArray, list[float], float]
"""Face (3, 3), start and end (3,) of the middle of the stripe in Base, tilts and roll, speed."""

_OVER_STEPS_MM = 10.0
_OVER_PART_MM = 13.0
_OVER_BALL_MM = 0.8 * 0.5 * BALL_DIAMETER_MM


def scan_passes(scene: SweptScene, head: Head, fixtures: Fixtures) -> list[ScanPass]:
    """The passes of a hand over the object of a scene, which suit the head."""
    plan: dict[str, Any] = PLANS["passes"][head.kind][scene]
    is_stereo = len(head.cameras) > 1
    first = facing_both(head) if is_stereo else HeadOrientation(0.0, 0.0, 0.0, DEPTH_MM)
    if scene == "ball":
        ways = _around_ball(fixtures.ball.centre_mm, plan, 0 if is_stereo else 1)
    elif scene == "part":
        ways = _along_part(fixtures.base_from_part, plan, is_stereo)
    elif scene == "steps":
        ways = _over_face(fixtures.base_from_ground, _OVER_STEPS_MM, plan)
    else:
        is_plate = scene == "plate"
        pose = fixtures.base_from_plate if is_plate else fixtures.base_from_waves
        ways = _over_face(pose, 0.0, plan)
    profile = BURST if head.kind == "crossed" else UNHURRIED
    return [
        ScanPass(face, start, end, first.turned(*angles), speed, plan["n_exposures"], profile)
        for face, start, end, angles, speed in ways
    ]


def _over_face(pose: Pose[Base, Any], lift_mm: float, plan: dict[str, Any]) -> Iterator[Way]:
    face = pose.rotation
    lift = lift_mm * face[:, 2]
    for x, y, x_end, y_end, *angles, speed in plan["passes"]:
        start = on_face(face, pose.translation_mm, (x, y)) + lift
        yield face, start, on_face(face, pose.translation_mm, (x_end, y_end)) + lift, angles, speed


def _around_ball(centre_mm: FloatArray, plan: dict[str, Any], axis: int) -> Iterator[Way]:
    for tilt, azimuth, length, speed in plan["passes"]:
        face = leaning(tilt, azimuth)
        middle = centre_mm + _OVER_BALL_MM * face[:, 2]
        half = 0.5 * length * face[:, axis]
        yield face, middle - half, middle + half, [plan["tilt_deg"], 0.0, 0.0], speed


def _along_part(pose: Pose[Base, Any], plan: dict[str, Any], is_stereo: bool) -> Iterator[Way]:
    half = plan["half_way_mm"]
    for side, lean, speed in plan["passes"]:
        face = pose.rotation @ leaning(abs(lean), -90.0 if lean > 0.0 else 90.0)
        if not is_stereo:
            face = face @ quarter_turn()
        start, end = (
            pose.translation_mm + pose.rotation @ np.array([x, side, _OVER_PART_MM])
            for x in (-half, half)
        )
        yield face, start, end, [plan["tilt_deg"], 0.0, 0.0], speed


def still_step(fixtures: Fixtures, head: Head) -> tuple[FloatArray, FloatArray, HeadOrientation]:
    """Face (3, 3), spot (3,) in Base and orientation for one look at a block and the ground.

    The light is upright: from one stripe alone a height is known only in the sheet. The block is
    the higher one, but the lower one for a head of many lines.
    """
    block = 1 if len(head.cameras) > 1 else 0
    face, origin = fixtures.base_from_ground.rotation, fixtures.base_from_ground.translation_mm
    lift = 0.5 * STEP_HEIGHTS_MM[block] * face[:, 2]
    return face, on_face(face, origin, STEP_CENTRES_MM[block]) + lift, light_upright(head)
