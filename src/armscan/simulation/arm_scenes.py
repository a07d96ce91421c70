# SPDX-License-Identifier: Apache-2.0
"""The head on the arm before the bench: stills over the plate, and scans by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.records.arm_track import ArmTrack
from armscan.records.session import ExposureRow
from armscan.simulation.aim import sensor_over
from armscan.simulation.arm_inverse import COMFORTABLE_RAD, reach
from armscan.simulation.arm_recording import track_of_readings, track_of_sweeps
from armscan.simulation.hand_eye_plan import hand_eye_poses
from armscan.simulation.head import Window
from armscan.simulation.instrument import Instrument
from armscan.simulation.sheet_middle import sheet_middle_mm
from armscan.simulation.station import ExposureSettings, Station
from armscan.simulation.strokes import still_step
from armscan.simulation.sweep import Stroke, Sweep, sweep
from armscan.simulation.twin_scan import Shot

Recorded = tuple[tuple[Shot, ...], ArmTrack]

EXPOSURES_PER_POSTURE = 2
_POSTURE_NS = 5_000_000_000
_EXPOSURE_NS = 400_000_000
_PAUSE_NS = 3_000_000_000


def hand_eye_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """Stills of the stripe on the plate, equal views for the exposures of one posture."""
    head, station = instrument.head, instrument.bench.with_plate()
    poses = hand_eye_poses(head, instrument.bench, rng)
    views = [
        (f"posture-{k + 1:02d}", pose)
        for k, pose in enumerate(poses)
        for _ in range(EXPOSURES_PER_POSTURE)
    ]
    return _stills(instrument, station, views, head.full_window, rng)


def still_step_scene(instrument: Instrument, rng: np.random.Generator) -> Recorded:
    """One look at the higher gauge block and the ground beside it."""
    face, spot, aim = still_step(instrument.bench, instrument.head)
    middle = sheet_middle_mm(instrument.head, aim.depth_mm)
    pose = sensor_over(face, spot, aim, middle)
    window = instrument.head.scan_window
    station = instrument.bench.with_steps()
    return _stills(instrument, station, [("still", pose)], window, rng)


def scan_scene(
    instrument: Instrument,
    station: Station,
    strokes: Sequence[Stroke],
    rng: np.random.Generator,
) -> Recorded:
    """Strokes of a hand over a station, one after the other, with the scanning window."""
    head, hand = instrument.head, instrument.mechanics.hand
    sweeps = [sweep(stroke, head, instrument.arm.true, hand, rng) for stroke in strokes]
    starts = _starts_ns(sweeps)
    settings = ExposureSettings(head.scan_window, _laser_names(instrument))
    shots: list[Shot] = []
    for one, start in zip(sweeps, starts, strict=True):
        for t_ns in one.exposure_t_ns:
            row = _row(len(shots), start + int(t_ns), instrument)
            middle, *subs = _poses_during(instrument, one, int(t_ns))
            shots.append(Shot(row, station, middle, settings, tuple(subs)))
    return tuple(shots), track_of_sweeps(instrument.arm, sweeps, starts, rng)


def _stills(
    instrument: Instrument,
    station: Station,
    views: Sequence[tuple[str, Pose[Base, Sensor]]],
    window: Window,
    rng: np.random.Generator,
) -> Recorded:
    """Exposures with the arm at rest; each is named by its view, equal ones are neighbours."""
    sensor_from_tool = instrument.head.tool_from_sensor.inverse()
    settings = ExposureSettings(window, _laser_names(instrument))
    joints: FloatArray = COMFORTABLE_RAD
    shots: list[Shot] = []
    held, times = [], []
    t_ns = 0
    for k, (view, pose) in enumerate(views):
        is_new = k == 0 or view != views[k - 1][0]
        t_ns += _POSTURE_NS if is_new else _EXPOSURE_NS
        joints = reach(instrument.arm.true, pose @ sensor_from_tool, joints)
        shots.append(Shot(_row(k, t_ns, instrument, view), station, pose, settings))
        held.append(joints)
        times.append(t_ns)
    triggers = np.arange(1, len(shots) + 1, dtype=np.int64)
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


def _row(index: int, t_ns: int, instrument: Instrument, view: str | None = None) -> ExposureRow:
    return ExposureRow(
        index,
        t_ns,
        0,
        f"images/{index + 1:04d}.png",
        lasers=_laser_names(instrument),
        trigger_id=index + 1,
        view=view,
    )


def _laser_names(instrument: Instrument) -> tuple[str, ...]:
    return tuple(laser.name for laser in instrument.head.lasers)
