# SPDX-License-Identifier: Apache-2.0
"""What each kind of head does in each scene that is scanned by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from armscan.geometry.arrays import FloatArray
from armscan.simulation import cross_strokes, multi_strokes, strokes
from armscan.simulation.aim import Aim
from armscan.simulation.faces import on_face
from armscan.simulation.head import Head
from armscan.simulation.posture import facing_both, light_upright
from armscan.simulation.station import Station
from armscan.simulation.stations import STEP_CENTRES_MM, STEP_HEIGHTS_MM, Bench
from armscan.simulation.sweep import Stroke

SweptScene = Literal["plate", "ball", "steps", "part", "waves"]

_STATIONS: Mapping[SweptScene, Callable[[Bench], Station]] = {
    "plate": Bench.with_plate,
    "ball": Bench.with_ball,
    "steps": Bench.with_steps,
    "part": Bench.with_part,
    "waves": Bench.with_waves,
}
_ONE_LINE: Mapping[SweptScene, Callable[[Bench], list[Stroke]]] = {
    "plate": strokes.plate_strokes,
    "ball": strokes.ball_strokes,
    "steps": strokes.step_strokes,
    "part": strokes.part_strokes,
    "waves": strokes.wave_strokes,
}
_CROSSED: Mapping[SweptScene, Callable[[Bench], list[Stroke]]] = {
    "plate": cross_strokes.plate_strokes,
    "ball": cross_strokes.ball_strokes,
    "steps": cross_strokes.step_strokes,
    "part": cross_strokes.part_strokes,
    "waves": cross_strokes.wave_strokes,
}
_MANY_LINES: Mapping[SweptScene, Callable[[Bench, Aim], list[Stroke]]] = {
    "plate": multi_strokes.plate_strokes,
    "ball": multi_strokes.ball_strokes,
    "steps": multi_strokes.step_strokes,
    "part": multi_strokes.part_strokes,
    "waves": multi_strokes.wave_strokes,
}


def station_of(scene: SweptScene, bench: Bench) -> Station:
    """What stands there."""
    return _STATIONS[scene](bench)


def strokes_of(scene: SweptScene, head: Head, bench: Bench) -> list[Stroke]:
    """The strokes of a hand, which suit the head."""
    if len(head.cameras) > 1:
        return _MANY_LINES[scene](bench, facing_both(head))
    return (_CROSSED if len(head.sources) > 1 else _ONE_LINE)[scene](bench)


def still_step(bench: Bench, head: Head) -> tuple[FloatArray, FloatArray, Aim]:
    """Face (3, 3), spot (3,) in Base and aim of one look at a block and the ground beside it.

    The light is upright: from one stripe alone a height is known only in the sheet. The block is
    the higher one, but the lower one for a head of many lines.
    """
    block = 1 if len(head.cameras) > 1 else 0
    face, origin = bench.base_from_ground.rotation, bench.base_from_ground.translation_mm
    lift = 0.5 * STEP_HEIGHTS_MM[block] * face[:, 2]
    return face, on_face(face, origin, STEP_CENTRES_MM[block]) + lift, light_upright(head)
