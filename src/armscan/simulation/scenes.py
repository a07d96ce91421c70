# SPDX-License-Identifier: Apache-2.0
"""The scenes of the twin: what is recorded for each calibration and each measurement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.records.recording import ArmTrack
from armscan.simulation.arm.arm import COMFORTABLE_RAD, reach
from armscan.simulation.arm.hand import (
    HeadOrientation,
    Trajectory,
    aim_point_mm,
    facing_both,
    sensor_over,
    sweep,
)
from armscan.simulation.arm.passes import SweptScene, station_of, still_step, strokes_of
from armscan.simulation.head import Head
from armscan.simulation.instrument import Instrument, track_of_readings, track_of_sweeps
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.fixtures import Bench
from armscan.simulation.optics.scene import Floor, RoomLight, SceneObject
from armscan.simulation.shots import Light, Moment, RenderRequest, instant_shots
from armscan.simulation.station import Station, Target
from armscan.simulation.targets import (
    CAMERA_PLACES,
    CROSS_LASER_PLACES,
    LASER_PLACES,
    MULTI_FAR_PLACES,
    MULTI_LASER_PLACES,
    MULTI_LEFT_PLACES,
    STEREO_CAMERA_PLACES,
    TURNED_CAMERA_PLACES,
    held_before_all,
    held_before_camera,
    held_in_sheet,
)

PLAN: tuple[HeadOrientation, ...] = (
    HeadOrientation(-44, -15, 0, 126),
    HeadOrientation(-44, 16, 75, 156),
    HeadOrientation(-38, -28, 20, 154),
    HeadOrientation(-36, 28, -40, 128),
    HeadOrientation(-30, -2, 110, 140),
    HeadOrientation(-8, 41, -15, 148),
    HeadOrientation(-8, -41, 50, 132),
    HeadOrientation(2, -34, -70, 152),
    HeadOrientation(2, 34, 10, 126),
    HeadOrientation(9, -12, 90, 126),
    HeadOrientation(9, 12, -25, 156),
    HeadOrientation(-2, 2, 35, 138),
)
CROSS_PLAN: tuple[HeadOrientation, ...] = (
    HeadOrientation(-42, -14, 0, 126),
    HeadOrientation(-42, 15, 75, 154),
    HeadOrientation(-33, -28, 20, 152),
    HeadOrientation(-32, 28, -40, 128),
    HeadOrientation(-25, -2, 110, 140),
    HeadOrientation(-5, 39, -15, 147),
    HeadOrientation(-5, -39, 50, 132),
    HeadOrientation(6, -32, -70, 150),
    HeadOrientation(6, 32, 10, 127),
    HeadOrientation(14, -12, 90, 127),
    HeadOrientation(14, 12, -25, 154),
    HeadOrientation(0, 2, 35, 138),
)
MULTI_PLAN: tuple[HeadOrientation, ...] = (
    HeadOrientation(-33, -7, -20, 128),
    HeadOrientation(-31, 9, 15, 152),
    HeadOrientation(-21, -17, 35, 148),
    HeadOrientation(-19, 17, -30, 131),
    HeadOrientation(-2, -22, 8, 135),
    HeadOrientation(2, 22, -15, 145),
    HeadOrientation(21, -16, 25, 129),
    HeadOrientation(19, 17, -40, 152),
    HeadOrientation(33, 6, 0, 133),
    HeadOrientation(31, -9, 30, 148),
    HeadOrientation(5, 3, 55, 126),
    HeadOrientation(-4, -3, -55, 156),
)
"""Tilts and rolls from facing both cameras alike."""
_SPOT_MM = 22.0
_GOLDEN_RAD = 2.399963
"""Turn from spot to spot on the plate: successive spots never line up."""
_JITTER_DEG = 2.0
_JITTER_ROLL_DEG = 6.0
_JITTER_DEPTH_MM = 2.0
_JITTER_SPOT_MM = 5.0


def hand_eye_poses(head: Head, bench: Bench, rng: np.random.Generator) -> list[Pose[Base, Sensor]]:
    """``base_from_sensor`` of the plan's postures over the plate, each a little off as by hand."""
    rotation = bench.base_from_plate.rotation
    poses = []
    for k, aim in enumerate(plan_of(head)):
        jitter = rng.uniform(-1.0, 1.0, 6)
        held = HeadOrientation(
            aim.tilt_x_deg + _JITTER_DEG * jitter[0],
            aim.tilt_y_deg + _JITTER_DEG * jitter[1],
            aim.roll_deg + _JITTER_ROLL_DEG * jitter[2],
            aim.depth_mm + _JITTER_DEPTH_MM * jitter[3],
        )
        on_plate = _spot_mm(k) + _JITTER_SPOT_MM * jitter[4:]
        spot = bench.base_from_plate.translation_mm + rotation[:, :2] @ on_plate
        poses.append(sensor_over(rotation, spot, held, aim_point_mm(head, held.depth_mm)))
    return poses


def plan_of(head: Head) -> tuple[HeadOrientation, ...]:
    """The plan that suits a head."""
    if len(head.cameras) == 1:
        return PLAN if len(head.sources) == 1 else CROSS_PLAN
    facing = facing_both(head)
    return tuple(
        HeadOrientation(
            facing.tilt_x_deg + aim.tilt_x_deg,
            facing.tilt_y_deg + aim.tilt_y_deg,
            facing.roll_deg + aim.roll_deg,
            aim.depth_mm,
        )
        for aim in MULTI_PLAN
    )


def _spot_mm(k: int) -> FloatArray:
    """(2,) place of the k-th posture's stripe on the plate."""
    turn = _GOLDEN_RAD * k
    return _SPOT_MM * np.array([np.cos(turn), np.sin(turn)])


PLACES: tuple[tuple[float, float, float, float, float, float], ...] = (
    (-22, -8, 4, 3, -8, 139),
    (-9, -9, -8, 2, 6, 143),
    (6, -8, 6, -7, 15, 138),
    (21, -9, 9, 4, -5, 144),
    (22, 7, -9, -4, 10, 141),
    (7, 9, -3, 8, -16, 146),
    (-8, 8, 7, -5, 4, 140),
    (-21, 9, -6, 6, -12, 143),
)
"""Across and along the part (mm); tilts and roll (degrees) from facing it with both cameras
alike; depth (mm)."""
_HIGH_MM = 9.0
"""Middle of the faces' heights."""


_JITTER_MM = 2.0


def marker_poses(
    head: Head, bench: Bench, is_moved: bool, rng: np.random.Generator
) -> list[tuple[str, Pose[Base, Sensor]]]:
    """Name and ``base_from_sensor`` of each place; after the move they are numbered on.

    Base is that before or after the arm was moved.
    """
    part = bench.marked_pose(is_moved)
    facing = facing_both(head)
    side = -1.0 if is_moved else 1.0
    first = len(PLACES) + 1 if is_moved else 1
    poses = []
    for k, (x, y, tilt_x, tilt_y, roll, depth) in enumerate(PLACES):
        jitter = rng.uniform(-1.0, 1.0, 6)
        aim = HeadOrientation(
            facing.tilt_x_deg + side * tilt_x + _JITTER_DEG * jitter[0],
            facing.tilt_y_deg + side * tilt_y + _JITTER_DEG * jitter[1],
            facing.roll_deg + side * roll + _JITTER_ROLL_DEG * jitter[2],
            depth + _JITTER_MM * jitter[3],
        )
        place = np.array([x, side * y, _HIGH_MM]) + _JITTER_MM * np.array([*jitter[4:], 0.0])
        spot = part.translation_mm + part.rotation @ place
        middle = aim_point_mm(head, aim.depth_mm)
        poses.append((f"place-{first + k:02d}", sensor_over(part.rotation, spot, aim, middle)))
    return poses


_LAMP = RoomLight(even=0.7, direct=0.35, position_mm=(120.0, -260.0, -250.0), up=(0.0, 0.0, -1.0))
_BACKGROUND = SceneObject(
    "table", Floor(np.array([0.0, 0.0, 280.0]), np.array([0.0, 0.0, -1.0]), (0.25, 0.25, 0.25))
)
_WITH_LASER = 0.15
"""Room light while the stripe is photographed, over that of the target's image."""
_INTERVAL_NS = 2_000_000_000
_FEW_LINES = 5


def camera_shots(
    head: Head, pattern: CirclePattern, rng: np.random.Generator
) -> tuple[RenderRequest, ...]:
    """The target at all places for the cameras, each a little off as by hand."""
    light = Light(room_light=head.imaging.target_light)
    is_stereo = len(head.cameras) > 1
    if is_stereo:
        targets = [held_before_all(head, pattern, place, rng) for place in STEREO_CAMERA_PLACES]
    else:
        places = CAMERA_PLACES if len(head.lasers) == 1 else TURNED_CAMERA_PLACES
        targets = [held_before_camera(head, pattern, place, rng) for place in places]
    shots: list[RenderRequest] = []
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


def laser_shots(
    head: Head, pattern: CirclePattern, rng: np.random.Generator
) -> tuple[RenderRequest, ...]:
    """The target at all places for the sheets: each source alone in dim light, then none."""
    room = head.imaging.target_light
    states = [
        (source if is_named(head) else "on", Light((source,), _WITH_LASER * room))
        for source in head.sources
    ]
    states.append(("off", Light(room_light=room)))
    shots: list[RenderRequest] = []
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
) -> list[RenderRequest]:
    here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    station = Station((_BACKGROUND,), target, _LAMP)
    return instant_shots(head, first_index, moment, station, light, here)


Recorded = tuple[tuple[RenderRequest, ...], ArmTrack]

_EXPOSURES_PER_POSTURE = 2
"""For one camera; two cameras see as much in one exposure."""
_POSTURE_NS = 5_000_000_000
_EXPOSURE_NS = 400_000_000
_PAUSE_NS = 3_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class StaticPose:
    """One exposure with the arm at rest.

    Parameters
    ----------
    view
        Name of the posture; neighbours of equal view are taken without moving between them.
    pose
        Where the head is held.
    light
        What shines.
    """

    view: str
    pose: Pose[Base, Sensor]
    light: Light


def hand_eye_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """Stills of the stripes on the plate, equal views for the exposures of one posture."""
    head, station = instrument.head, instrument.bench.with_plate()
    poses = hand_eye_poses(head, instrument.bench, rng)
    repeats = 1 if len(head.cameras) > 1 else _EXPOSURES_PER_POSTURE
    stills = [
        StaticPose(f"posture-{k + 1:02d}", pose, Light(head.sources))
        for k, pose in enumerate(poses)
        for _ in range(repeats)
    ]
    return _recorded(instrument, station, stills, rng)


def still_step_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """One look at a gauge block and the ground beside it."""
    head = instrument.head
    face, spot, aim = still_step(instrument.bench, head)
    pose = sensor_over(face, spot, aim, aim_point_mm(head, aim.depth_mm))
    # One line stays in the window; lines that run slantwise need the height of the sensor.
    is_windowed = len(head.lasers) == 1
    still = StaticPose("still", pose, Light(head.sources, is_windowed=is_windowed))
    return _recorded(instrument, instrument.bench.with_steps(), [still], rng)


def marker_scene(instrument: Instrument, is_moved: bool, rng: np.random.Generator) -> Recorded:
    """Stills of a part with ring markers, from place to place as it is held by hand.

    At each place one exposure in the light of the room, then one with the lasers in dim light.
    """
    head, bench = instrument.head, instrument.bench
    room = Light(room_light=head.imaging.target_light)
    stills = [
        StaticPose(view, pose, light)
        for view, pose in marker_poses(head, bench, is_moved, rng)
        for light in (room, Light(head.sources))
    ]
    return _recorded(instrument, bench.with_markers(is_moved), stills, rng)


def scan_scene(instrument: Instrument, scene: SweptScene, rng: np.random.Generator) -> Recorded:
    """Strokes of a hand, one after the other, with the scanning window."""
    head, hand = instrument.head, instrument.mechanics.hand
    station = station_of(scene, instrument.bench)
    strokes = strokes_of(scene, head, instrument.bench)
    sweeps = [sweep(stroke, head, instrument.arm.true, hand, rng) for stroke in strokes]
    starts = _starts_ns(sweeps)
    light = Light(head.sources, is_windowed=True)
    shots: list[RenderRequest] = []
    number = 0
    for one, start in zip(sweeps, starts, strict=True):
        for t_ns in one.exposure_t_ns:
            number += 1
            moment = Moment(start + int(t_ns), f"{number:04d}.png", number)
            poses = _poses_during(instrument, one, int(t_ns))
            shots += instant_shots(head, len(shots), moment, station, light, *poses)
    return tuple(shots), track_of_sweeps(instrument.arm, sweeps, starts, rng)


def _recorded(
    instrument: Instrument, station: Station, stills: Sequence[StaticPose], rng: np.random.Generator
) -> Recorded:
    """Exposures with the arm at rest."""
    head = instrument.head
    sensor_from_tool = head.tool_from_sensor.inverse()
    joints: FloatArray = COMFORTABLE_RAD
    shots: list[RenderRequest] = []
    held, times = [], []
    t_ns = 0
    for k, still in enumerate(stills):
        is_new = k == 0 or still.view != stills[k - 1].view
        t_ns += _POSTURE_NS if is_new else _EXPOSURE_NS
        joints = reach(instrument.arm.true, still.pose @ sensor_from_tool, joints)
        moment = Moment(t_ns, f"{k + 1:04d}.png", k + 1, still.view)
        shots += instant_shots(head, len(shots), moment, station, still.light, still.pose)
        held.append(joints)
        times.append(t_ns)
    triggers = np.arange(1, len(stills) + 1, dtype=np.int64)
    track = track_of_readings(
        instrument.arm, np.array(times, dtype=np.int64), triggers, np.array(held), rng
    )
    return tuple(shots), track


def _poses_during(
    instrument: Instrument, one: Trajectory, t_ns: int
) -> tuple[Pose[Base, Sensor], ...]:
    """Pose in the middle of an exposure, then the two whose mean square is that of all."""
    half = instrument.mechanics.exposure_s / np.sqrt(12.0)
    joints = one.path.joints(1e-9 * t_ns + np.array([0.0, -half, half]))
    return tuple(instrument.arm.true_pose(row) @ instrument.head.tool_from_sensor for row in joints)


def _starts_ns(sweeps: Sequence[Trajectory]) -> list[int]:
    """Start of each stroke, with a pause before it."""
    starts, now = [], 0
    for one in sweeps:
        now += _PAUSE_NS
        starts.append(now)
        now += int(one.exposure_t_ns[-1])
    return starts
