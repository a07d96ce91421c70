# SPDX-License-Identifier: Apache-2.0
"""The scenes of the twin: the head before its target, and the head on the arm, at rest or moving.

Before the target no arm takes part: Base is the Sensor frame there, and the target moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.records.recording import ArmTrack
from armscan.simulation.arm.arm import COMFORTABLE_RAD, reach
from armscan.simulation.arm.hand import (
    PLANS,
    HeadOrientation,
    SweptScene,
    Trajectory,
    aim_point_mm,
    bounce,
    facing_both,
    scan_passes,
    sensor_over,
    still_step,
    sweep,
)
from armscan.simulation.head import Head
from armscan.simulation.instrument import Instrument, track_of_readings, track_of_sweeps
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.fixtures import Fixtures
from armscan.simulation.optics.scene import Floor, RoomLight, SceneObject
from armscan.simulation.station import Light, Moment, RenderRequest, Station, Target, instant_shots
from armscan.simulation.targets import camera_targets, laser_targets

Recorded = tuple[tuple[RenderRequest, ...], ArmTrack]
StaticPose = tuple[str, Pose[Base, Sensor], Light]
"""Name of the view, where the head is held, and what shines; neighbours of one view are taken
without moving between them."""

_LAMP = RoomLight(even=0.7, direct=0.35, position_mm=(120.0, -260.0, -250.0), up=(0.0, 0.0, -1.0))
_BACKGROUND = SceneObject(
    "table", Floor(np.array([0.0, 0.0, 280.0]), np.array([0.0, 0.0, -1.0]), (0.25, 0.25, 0.25))
)
_WITH_LASER = 0.15
"""Room light while the stripe is photographed, over that of the target's image."""
_TARGET_NS, _POSTURE_NS, _EXPOSURE_NS, _PAUSE_NS = 2 * 10**9, 5 * 10**9, 4 * 10**8, 3 * 10**9
_SPOT_MM = 22.0
_GOLDEN_RAD = 2.399963
"""Turn from spot to spot on the plate: successive spots never line up."""
_JITTER_SPOT_MM = 5.0
_FACES_HIGH_MM = 9.0
"""Middle of the heights of the faces with markers."""
_JITTER_PLACE_MM = 2.0


def camera_shots(
    head: Head, pattern: CirclePattern, rng: np.random.Generator
) -> tuple[RenderRequest, ...]:
    """The target at all places for the cameras, each a little off as by hand."""
    light = Light(room_light=head.imaging.target_light)
    is_stereo = len(head.cameras) > 1
    shots: list[RenderRequest] = []
    for k, target in enumerate(camera_targets(head, pattern, rng), start=1):
        trigger, view = (k, f"{k:02d}") if is_stereo else (None, None)
        moment = Moment(_TARGET_NS * k, f"{k:02d}.png", trigger, view)
        shots += _before_target(head, len(shots), moment, target, light)
    return tuple(shots)


def laser_shots(
    head: Head, pattern: CirclePattern, rng: np.random.Generator
) -> tuple[RenderRequest, ...]:
    """The target at all places for the sheets: each source alone in dim light, then none.

    Folders bear the names of the sources; a single line is only on or off.
    """
    room = head.imaging.target_light
    is_single = len(head.lasers) == 1
    states = [
        ("on" if is_single else source, Light((source,), _WITH_LASER * room))
        for source in head.sources
    ]
    states.append(("off", Light(room_light=room)))
    shots: list[RenderRequest] = []
    moments = 0
    for k, target in enumerate(laser_targets(head, pattern, rng), start=1):
        for state, light in states:
            moments += 1
            trigger = moments if len(head.cameras) > 1 else None
            moment = Moment(_TARGET_NS * moments, f"{state}/{k:02d}.png", trigger, f"{k:02d}")
            shots += _before_target(head, len(shots), moment, target, light)
    return tuple(shots)


def _before_target(
    head: Head, first_index: int, moment: Moment, target: Target, light: Light
) -> list[RenderRequest]:
    here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    station = Station((_BACKGROUND,), target, _LAMP)
    return instant_shots(head, first_index, moment, station, light, here)


def hand_eye_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """Stills of the stripes on the plate, equal views for the exposures of one posture.

    One camera takes two exposures; two cameras see as much in one.
    """
    head, light = instrument.head, Light(instrument.head.sources)
    stills: list[StaticPose] = [
        (f"posture-{k:02d}", pose, light)
        for k, pose in enumerate(hand_eye_poses(head, instrument.fixtures, rng), start=1)
        for _ in range(1 if len(head.cameras) > 1 else 2)
    ]
    return _recorded(instrument, instrument.fixtures.with_plate(), stills, rng)


def hand_eye_poses(
    head: Head, fixtures: Fixtures, rng: np.random.Generator
) -> list[Pose[Base, Sensor]]:
    """``base_from_sensor`` of the plan's postures over the plate, each a little off as by hand."""
    rotation, origin = fixtures.base_from_plate.rotation, fixtures.base_from_plate.translation_mm
    poses = []
    for k, planned in enumerate(hand_eye_plan(head)):
        jitter = rng.uniform(-1.0, 1.0, 6)
        held = planned.by_hand(jitter[:4])
        turn = _GOLDEN_RAD * k
        on_plate = _SPOT_MM * np.array([np.cos(turn), np.sin(turn)]) + _JITTER_SPOT_MM * jitter[4:]
        spot = origin + rotation[:, :2] @ on_plate
        poses.append(sensor_over(rotation, spot, held, aim_point_mm(head, held.depth_mm)))
    return poses


def hand_eye_plan(head: Head) -> list[HeadOrientation]:
    """The postures over the plate that suit a head."""
    plan = [HeadOrientation(*row) for row in PLANS["hand_eye"][head.kind]]
    if head.kind != "many":
        return plan
    first = facing_both(head)
    return [one.turned(first.tilt_x_deg, first.tilt_y_deg, first.roll_deg) for one in plan]


def still_step_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """One look at a gauge block and the ground beside it."""
    head = instrument.head
    face, spot, aim = still_step(instrument.fixtures, head)
    pose = sensor_over(face, spot, aim, aim_point_mm(head, aim.depth_mm))
    # one line stays in the window; lines that run slantwise need the height of the sensor
    light = Light(head.sources, is_windowed=len(head.lasers) == 1)
    return _recorded(instrument, instrument.fixtures.with_steps(), [("still", pose, light)], rng)


def still_part_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """The part as somebody without an arm photographs it: with the laser, and without."""
    head, fixtures = instrument.head, instrument.fixtures
    held = scan_passes("part", head, fixtures)[1]
    spot, middle = 0.5 * (held.start_mm + held.end_mm), aim_point_mm(head, held.aim.depth_mm)
    pose = sensor_over(held.base_from_face, spot, held.aim, middle)
    stills = [("still", pose, light) for light in (Light(head.sources), Light())]
    return _recorded(instrument, fixtures.with_part(), stills, rng)


def marker_scene(instrument: Instrument, is_moved: bool, rng: np.random.Generator) -> Recorded:
    """Stills of a part with ring markers, from place to place as it is held by hand.

    At each place one exposure in the light of the room, then one with the lasers in dim light.
    """
    head, fixtures = instrument.head, instrument.fixtures
    room = Light(room_light=head.imaging.target_light)
    stills: list[StaticPose] = [
        (view, pose, light)
        for view, pose in marker_poses(head, fixtures, is_moved, rng)
        for light in (room, Light(head.sources))
    ]
    return _recorded(instrument, fixtures.with_markers(is_moved), stills, rng)


def marker_poses(
    head: Head, fixtures: Fixtures, is_moved: bool, rng: np.random.Generator
) -> list[tuple[str, Pose[Base, Sensor]]]:
    """Name and ``base_from_sensor`` of each place over the part with ring markers.

    After the arm is moved the places are taken the other way round, the head held differently, and
    numbered on: the first one then is near the last before. Base is that before or after the move.
    """
    part, facing = fixtures.marked_pose(is_moved), facing_both(head)
    places = PLANS["markers"]["places"]
    side = -1.0 if is_moved else 1.0
    first = len(places) + 1 if is_moved else 1
    poses = []
    for k, (x, y, tilt_x, tilt_y, roll, depth) in enumerate(places, start=first):
        jitter = rng.uniform(-1.0, 1.0, 6)
        planned = facing.turned(side * tilt_x, side * tilt_y, side * roll, depth - facing.depth_mm)
        held = planned.by_hand(jitter[:4])
        offset = _JITTER_PLACE_MM * np.array([*jitter[4:], 0.0])
        place = np.array([x, side * y, _FACES_HIGH_MM]) + offset
        spot = part.translation_mm + part.rotation @ place
        middle = aim_point_mm(head, held.depth_mm)
        poses.append((f"place-{k:02d}", sensor_over(part.rotation, spot, held, middle)))
    return poses


def scan_scene(instrument: Instrument, scene: SweptScene, rng: np.random.Generator) -> Recorded:
    """Passes of a hand, one after the other, with the scanning window."""
    head, hand, arm = instrument.head, instrument.mechanics.hand, instrument.arm
    station = getattr(instrument.fixtures, f"with_{scene}")()
    passes = scan_passes(scene, head, instrument.fixtures)
    sweeps = [sweep(one, head, arm.true, hand, rng) for one in passes]
    return _swept(instrument, station, sweeps, rng)


LATENCY_EXPOSURES = 160


def latency_scene(instrument: Instrument, latency_ns: int, rng: np.random.Generator) -> Recorded:
    """The plate with the head moved nearer and away; the arm tells its times later than it is."""
    head, fixtures = instrument.head, instrument.fixtures
    first = replace(scan_passes("plate", head, fixtures)[0], n_exposures=LATENCY_EXPOSURES)
    middle = fixtures.base_from_plate.translation_mm
    moved = bounce(middle, first, head, instrument.arm.true, rng)
    shots, track = _swept(instrument, fixtures.with_plate(), [moved], rng)
    return shots, replace(track, t_ns=track.t_ns + latency_ns, trigger_ids=None)


def _swept(
    instrument: Instrument,
    station: Station,
    sweeps: Sequence[Trajectory],
    rng: np.random.Generator,
) -> Recorded:
    head, arm = instrument.head, instrument.arm
    light = Light(head.sources, is_windowed=True)
    # pose in the middle of an exposure, then the two whose mean square is that of all
    half = instrument.mechanics.exposure_s / np.sqrt(12.0)
    shots: list[RenderRequest] = []
    starts, now, number = [], 0, 0
    for one in sweeps:
        now += _PAUSE_NS
        starts.append(now)
        for t_ns in one.exposure_t_ns:
            number += 1
            moment = Moment(now + int(t_ns), f"{number:04d}.png", number)
            joints = one.joints(1e-9 * int(t_ns) + np.array([0.0, -half, half]))
            poses = [arm.true_pose(row) @ head.tool_from_sensor for row in joints]
            shots += instant_shots(head, len(shots), moment, station, light, *poses)
        now += int(one.exposure_t_ns[-1])
    return tuple(shots), track_of_sweeps(arm, sweeps, starts, rng)


def _recorded(
    instrument: Instrument, station: Station, stills: Sequence[StaticPose], rng: np.random.Generator
) -> Recorded:
    """Exposures with the arm at rest."""
    head = instrument.head
    sensor_from_tool = head.tool_from_sensor.inverse()
    joints: FloatArray = COMFORTABLE_RAD
    shots: list[RenderRequest] = []
    held, times = [], []
    t_ns, last_view = 0, None
    for k, (view, pose, light) in enumerate(stills, start=1):
        t_ns += _POSTURE_NS if view != last_view else _EXPOSURE_NS
        last_view = view
        joints = reach(instrument.arm.true, pose @ sensor_from_tool, joints)
        moment = Moment(t_ns, f"{k:04d}.png", k, view)
        shots += instant_shots(head, len(shots), moment, station, light, pose)
        held.append(joints)
        times.append(t_ns)
    triggers = np.arange(1, len(stills) + 1, dtype=np.int64)
    track = track_of_readings(
        instrument.arm, np.array(times, dtype=np.int64), triggers, np.array(held), rng
    )
    return tuple(shots), track
