# SPDX-License-Identifier: Apache-2.0
"""The scan passes of each kind of head over each object."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from armscan.geometry.arrays import FloatArray
from armscan.simulation.arm import cross_passes, multi_passes, single_passes
from armscan.simulation.arm.hand import (
    HeadOrientation,
    ScanPass,
    facing_both,
    light_upright,
    on_face,
)
from armscan.simulation.head import Head
from armscan.simulation.objects.fixtures import STEP_CENTRES_MM, STEP_HEIGHTS_MM, Bench
from armscan.simulation.station import Station

SweptScene = Literal["plate", "ball", "steps", "part", "waves"]

_STATIONS: Mapping[SweptScene, Callable[[Bench], Station]] = {
    "plate": Bench.with_plate,
    "ball": Bench.with_ball,
    "steps": Bench.with_steps,
    "part": Bench.with_part,
    "waves": Bench.with_waves,
}
_ONE_LINE: Mapping[SweptScene, Callable[[Bench], list[ScanPass]]] = {
    "plate": single_passes.plate_strokes,
    "ball": single_passes.ball_strokes,
    "steps": single_passes.step_strokes,
    "part": single_passes.part_strokes,
    "waves": single_passes.wave_strokes,
}
_CROSSED: Mapping[SweptScene, Callable[[Bench], list[ScanPass]]] = {
    "plate": cross_passes.plate_strokes,
    "ball": cross_passes.ball_strokes,
    "steps": cross_passes.step_strokes,
    "part": cross_passes.part_strokes,
    "waves": cross_passes.wave_strokes,
}
_MANY_LINES: Mapping[SweptScene, Callable[[Bench, HeadOrientation], list[ScanPass]]] = {
    "plate": multi_passes.plate_strokes,
    "ball": multi_passes.ball_strokes,
    "steps": multi_passes.step_strokes,
    "part": multi_passes.part_strokes,
    "waves": multi_passes.wave_strokes,
}


def station_of(scene: SweptScene, bench: Bench) -> Station:
    """What stands there."""
    return _STATIONS[scene](bench)


def strokes_of(scene: SweptScene, head: Head, bench: Bench) -> list[ScanPass]:
    """The strokes of a hand, which suit the head."""
    if len(head.cameras) > 1:
        return _MANY_LINES[scene](bench, facing_both(head))
    return (_CROSSED if len(head.sources) > 1 else _ONE_LINE)[scene](bench)


def still_step(bench: Bench, head: Head) -> tuple[FloatArray, FloatArray, HeadOrientation]:
    """Face (3, 3), spot (3,) in Base and aim of one look at a block and the ground beside it.

    The light is upright: from one stripe alone a height is known only in the sheet. The block is
    the higher one, but the lower one for a head of many lines.
    """
    block = 1 if len(head.cameras) > 1 else 0
    face, origin = bench.base_from_ground.rotation, bench.base_from_ground.translation_mm
    lift = 0.5 * STEP_HEIGHTS_MM[block] * face[:, 2]
    return face, on_face(face, origin, STEP_CENTRES_MM[block]) + lift, light_upright(head)
