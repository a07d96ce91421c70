# SPDX-License-Identifier: Apache-2.0
"""The head on the arm before the bench: stills, and scans by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.records.arm_track import ArmTrack
from armscan.simulation.aim import sensor_over
from armscan.simulation.arm_inverse import COMFORTABLE_RAD, reach
from armscan.simulation.arm_recording import track_of_readings, track_of_sweeps
from armscan.simulation.hand_eye_plan import hand_eye_poses
from armscan.simulation.instant import Light, Moment, instant_shots
from armscan.simulation.instrument import Instrument
from armscan.simulation.marker_plan import marker_poses
from armscan.simulation.posture import aim_point_mm
from armscan.simulation.scan_plan import SweptScene, station_of, still_step, strokes_of
from armscan.simulation.station import Station
from armscan.simulation.sweep import Sweep, sweep
from armscan.simulation.twin_scan import Shot

Recorded = tuple[tuple[Shot, ...], ArmTrack]

_EXPOSURES_PER_POSTURE = 2
"""For one camera; two cameras see as much in one exposure."""
_POSTURE_NS = 5_000_000_000
_EXPOSURE_NS = 400_000_000
_PAUSE_NS = 3_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Still:
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
        Still(f"posture-{k + 1:02d}", pose, Light(head.sources))
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
    still = Still("still", pose, Light(head.sources, is_windowed=is_windowed))
    return _recorded(instrument, instrument.bench.with_steps(), [still], rng)


def marker_scene(instrument: Instrument, is_moved: bool, rng: np.random.Generator) -> Recorded:
    """Stills of a part with ring markers, from place to place as it is held by hand.

    At each place one exposure in the light of the room, then one with the lasers in dim light.
    """
    head, bench = instrument.head, instrument.bench
    room = Light(room_light=head.imaging.target_light)
    stills = [
        Still(view, pose, light)
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
    shots: list[Shot] = []
    number = 0
    for one, start in zip(sweeps, starts, strict=True):
        for t_ns in one.exposure_t_ns:
            number += 1
            moment = Moment(start + int(t_ns), f"{number:04d}.png", number)
            poses = _poses_during(instrument, one, int(t_ns))
            shots += instant_shots(head, len(shots), moment, station, light, *poses)
    return tuple(shots), track_of_sweeps(instrument.arm, sweeps, starts, rng)


def _recorded(
    instrument: Instrument, station: Station, stills: Sequence[Still], rng: np.random.Generator
) -> Recorded:
    """Exposures with the arm at rest."""
    head = instrument.head
    sensor_from_tool = head.tool_from_sensor.inverse()
    joints: FloatArray = COMFORTABLE_RAD
    shots: list[Shot] = []
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


def _poses_during(instrument: Instrument, one: Sweep, t_ns: int) -> tuple[Pose[Base, Sensor], ...]:
    """Pose in the middle of an exposure, then the two whose mean square is that of all."""
    half = instrument.mechanics.exposure_s / np.sqrt(12.0)
    joints = one.path.joints(1e-9 * t_ns + np.array([0.0, -half, half]))
    return tuple(instrument.arm.true_pose(row) @ instrument.head.tool_from_sensor for row in joints)


def _starts_ns(sweeps: Sequence[Sweep]) -> list[int]:
    """Start of each stroke, with a pause before it."""
    starts, now = [], 0
    for one in sweeps:
        now += _PAUSE_NS
        starts.append(now)
        now += int(one.exposure_t_ns[-1])
    return starts
