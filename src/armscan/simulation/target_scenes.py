# SPDX-License-Identifier: Apache-2.0
"""The head before its calibration target: images for its cameras, and for its light sheets.

No arm takes part, so Base is the Sensor frame here and the target moves.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.head import Head
from armscan.simulation.instant import Light, Moment, instant_shots
from armscan.simulation.scene import Lamp
from armscan.simulation.shared_places import (
    CROSS_LASER_PLACES,
    MULTI_FAR_PLACES,
    MULTI_LASER_PLACES,
    MULTI_LEFT_PLACES,
    STEREO_CAMERA_PLACES,
    held_before_all,
)
from armscan.simulation.station import Station, Target
from armscan.simulation.surfaces import Floor
from armscan.simulation.target_places import (
    CAMERA_PLACES,
    LASER_PLACES,
    TURNED_CAMERA_PLACES,
    held_before_camera,
    held_in_sheet,
)
from armscan.simulation.thing import Thing
from armscan.simulation.twin_scan import Shot

_LAMP = Lamp(even=0.7, direct=0.35, position_mm=(120.0, -260.0, -250.0), up=(0.0, 0.0, -1.0))
_BACKGROUND = Thing(
    "table", Floor(np.array([0.0, 0.0, 280.0]), np.array([0.0, 0.0, -1.0]), (0.25, 0.25, 0.25))
)
_WITH_LASER = 0.15
"""Room light while the stripe is photographed, over that of the target's image."""
_INTERVAL_NS = 2_000_000_000
_FEW_LINES = 5


def camera_shots(head: Head, pattern: CirclePattern, rng: np.random.Generator) -> tuple[Shot, ...]:
    """The target at all places for the cameras, each a little off as by hand."""
    light = Light(room_light=head.imaging.target_light)
    is_stereo = len(head.cameras) > 1
    if is_stereo:
        targets = [held_before_all(head, pattern, place, rng) for place in STEREO_CAMERA_PLACES]
    else:
        places = CAMERA_PLACES if len(head.lasers) == 1 else TURNED_CAMERA_PLACES
        targets = [held_before_camera(head, pattern, place, rng) for place in places]
    shots: list[Shot] = []
    for k, target in enumerate(targets):
        name = f"{k + 1:02d}"
        moment = Moment(
            _INTERVAL_NS * (k + 1),
            f"{name}.png",
            k + 1 if is_stereo else None,
            name if is_stereo else None,
        )
        shots += _shots(head, len(shots), moment, target, light)
    return tuple(shots)


def laser_shots(head: Head, pattern: CirclePattern, rng: np.random.Generator) -> tuple[Shot, ...]:
    """The target at all places for the sheets: each source alone in dim light, then none."""
    room = head.imaging.target_light
    states = [
        (source if is_named(head) else "on", Light((source,), _WITH_LASER * room))
        for source in head.sources
    ]
    states.append(("off", Light(room_light=room)))
    shots: list[Shot] = []
    moments = 0
    for k, target in enumerate(_before_lasers(head, pattern, rng)):
        view = f"{k + 1:02d}"
        for state, light in states:
            moments += 1
            trigger = moments if len(head.cameras) > 1 else None
            moment = Moment(_INTERVAL_NS * moments, f"{state}/{view}.png", trigger, view)
            shots += _shots(head, len(shots), moment, target, light)
    return tuple(shots)


def is_named(head: Head) -> bool:
    """True if folders bear the names of sources: a single line is only on or off."""
    return len(head.lasers) > 1


def _before_lasers(
    head: Head, pattern: CirclePattern, rng: np.random.Generator
) -> Iterator[Target]:
    if len(head.lasers) == 1:
        yield from (held_in_sheet(head, pattern, place, rng) for place in LASER_PLACES)
        return
    places = CROSS_LASER_PLACES
    if len(head.cameras) > 1:
        # A few lines in the middle are met at each place.
        is_many = len(head.lasers) > _FEW_LINES
        outer = MULTI_LEFT_PLACES + MULTI_FAR_PLACES
        places = MULTI_LASER_PLACES + outer if is_many else MULTI_LASER_PLACES[::2]
    yield from (held_before_all(head, pattern, place, rng) for place in places)


def _shots(
    head: Head, first_index: int, moment: Moment, target: Target, light: Light
) -> list[Shot]:
    here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    station = Station((_BACKGROUND,), target, _LAMP)
    return instant_shots(head, first_index, moment, station, light, here)
