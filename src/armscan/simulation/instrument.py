# SPDX-License-Identifier: Apache-2.0
"""The whole simulated instrument: head, arm, probe and fixtures of one seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armscan.devices.sources import Preset
from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, floats
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import rotation_from_vector
from armscan.records.recording import NO_TRIGGER, ArmTrack
from armscan.simulation.arm.arm import COMFORTABLE_RAD, ArmErrors, MeasuringArm, reach
from armscan.simulation.arm.hand import FACE_DOWN, HandTremor, Trajectory
from armscan.simulation.head import Head, build_head
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.fixtures import Fixtures
from armscan.simulation.targets import made_target

SAMPLE_NS = 4_000_000
"""250 samples a second."""
_EDGE_NS = 60_000_000


def track_of_readings(
    arm: MeasuringArm,
    t_ns: IntArray,
    trigger_ids: IntArray,
    joints_rad: FloatArray,
    rng: np.random.Generator,
) -> ArmTrack:
    """Track of true joint angles (N, 7) at increasing times (N,), as the controller sees them."""
    readings = arm.readings(joints_rad, rng)
    rotations, translations = arm.nominal.transforms(readings)
    known = np.ones(len(t_ns), dtype=np.bool_)
    return ArmTrack(
        t_ns=t_ns,
        rotations=rotations,
        translations_mm=translations,
        is_known=known,
        trigger_ids=trigger_ids,
        joints_rad=readings,
    )


def track_of_sweeps(
    arm: MeasuringArm,
    sweeps: Sequence[Trajectory],
    starts_ns: Sequence[int],
    rng: np.random.Generator,
) -> ArmTrack:
    """Track of strokes that start at the given times; between them the arm sends nothing.

    Triggers are numbered from 1 through all strokes, in order of time.
    """
    times, triggers, joints = [], [], []
    first_trigger = 1
    for one, start in zip(sweeps, starts_ns, strict=True):
        phase = int(rng.integers(SAMPLE_NS))
        last = int(one.exposure_t_ns[-1]) + _EDGE_NS
        own = np.arange(phase - _EDGE_NS, last, SAMPLE_NS, dtype=np.int64)
        own = own[~np.isin(own, one.exposure_t_ns)]
        both = np.concatenate([own, one.exposure_t_ns])
        ids = np.full(len(both), NO_TRIGGER, dtype=np.int64)
        ids[len(own) :] = first_trigger + np.arange(len(one.exposure_t_ns))
        first_trigger += len(one.exposure_t_ns)
        order = np.argsort(both)
        times.append(start + both[order])
        triggers.append(ids[order])
        joints.append(one.joints(both[order] * 1e-9))
    return track_of_readings(
        arm, np.concatenate(times), np.concatenate(triggers), np.concatenate(joints), rng
    )


TIP_DIAMETER_MM = 6.0
TRUE_PROBE_MM = np.array([0.4, -0.3, 61.2])
"""Centre of the tip in Tool: on the last axis, but for the mounting."""

_RINGS = ((14, 78.0), (7, 42.0), (3, 14.0))
"""Touches and radius in mm of each ring around the plate's middle."""
_STRAY_MM = 5.0
_LEAN_RAD = 0.35
_TOUCH_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class ProbeErrors:
    """Errors of probing; each a standard deviation in mm.

    Parameters
    ----------
    touch_mm
        Of one touch, along the normal: the tip's form and the finger's force.
    calibration_mm
        Of each coordinate of the tip's calibrated centre in Tool.
    diameter_mm
        Of the tip's calibrated diameter.
    """

    touch_mm: float
    calibration_mm: float
    diameter_mm: float


class PlateProbing(ArrayRecord):
    """What a program gets, a sample a touch; see `armscan.devices.sources.Probing`.

    ``tool_from_probe_mm`` (3,) is the calibrated centre of the tip in Tool.
    """

    arm: ArmTrack
    tool_from_probe_mm: FloatArray = floats(3)
    tip_diameter_mm: float


def probe_plate(
    arm: MeasuringArm, fixtures: Fixtures, errors: ProbeErrors, rng: np.random.Generator
) -> PlateProbing:
    """Touch the plate all around with a tip that leans this way and that."""
    joints = []
    last = COMFORTABLE_RAD
    for x, y in _places_mm(rng):
        centre = _tip_centre_mm(fixtures, x, y, errors.touch_mm * rng.standard_normal())
        last = reach(arm.true, _tool_at(centre, rng), last)
        joints.append(last)
    n = len(joints)
    times = _TOUCH_NS * np.arange(1, n + 1, dtype=np.int64)
    track = track_of_readings(arm, times, np.full(n, NO_TRIGGER), np.array(joints), rng)
    return PlateProbing(
        arm=track,
        tool_from_probe_mm=TRUE_PROBE_MM + errors.calibration_mm * rng.standard_normal(3),
        tip_diameter_mm=TIP_DIAMETER_MM + errors.diameter_mm * float(rng.standard_normal()),
    )


def _places_mm(rng: np.random.Generator) -> FloatArray:
    """(N, 2) places on the plate, on rings, each a little off."""
    rings = []
    for count, radius in _RINGS:
        turn = 2.0 * np.pi * (np.arange(count) + rng.uniform()) / count
        rings.append(radius * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    places = np.concatenate(rings)
    return np.asarray(places + _STRAY_MM * rng.uniform(-1.0, 1.0, places.shape))


def _tip_centre_mm(fixtures: Fixtures, x_mm: float, y_mm: float, touch_mm: float) -> FloatArray:
    """(3,) centre, in Base, of a tip that rests on the true face at x, y of the plate's frame."""
    x, y = np.array([x_mm]), np.array([y_mm])
    foot = np.array([[x_mm, y_mm, fixtures.plate.height_mm(x, y)[0]]])
    centre = foot[0] + (0.5 * TIP_DIAMETER_MM + touch_mm) * fixtures.plate.normals(foot)[0]
    pose = fixtures.base_from_plate
    return np.asarray(pose.rotation @ centre + pose.translation_mm)


def _tool_at(centre_mm: FloatArray, rng: np.random.Generator) -> Pose[Base, Tool]:
    """Pose of a tool that holds the tip's centre at a place, leaning by chance."""
    lean = rotation_from_vector(np.array([*(_LEAN_RAD * rng.uniform(-1.0, 1.0, 2)), 0.0]))
    roll = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-1.0, 1.0)]))
    rotation = lean @ roll @ FACE_DOWN
    return Pose(rotation, centre_mm - rotation @ TRUE_PROBE_MM)


@dataclass(frozen=True, slots=True)
class Mechanics:
    """How good the arm and its probe are, and how steady the hand.

    During ``exposure_s`` of scans the hand blurs the image; each circle of the target misses its
    place along x and y by ``target_mm``, a standard deviation.
    """

    arm: ArmErrors
    probe: ProbeErrors
    hand: HandTremor = field(default_factory=HandTremor)
    exposure_s: float = 1e-3
    target_mm: float = 0.0003
    """The thesis's target is true to 0.001 mm (5.2.1): three of these."""


MECHANICS: dict[Preset, Mechanics] = {
    "clean": Mechanics(
        ArmErrors(0.01, 0.0, 0.0, 0.0, 0.0), ProbeErrors(0.0, 0.0, 0.0), target_mm=0.0
    ),
    "thesis": Mechanics(ArmErrors(1.0, 1.0, 0.5, 0.25, 0.001), ProbeErrors(0.0015, 0.0015, 0.0005)),
    "harsh": Mechanics(
        ArmErrors(2.7, 2.7, 1.3, 0.7, 0.0025),
        ProbeErrors(0.003, 0.004, 0.001),
        HandTremor(tilt_deg=2.5, depth_mm=1.5, aside_mm=2.0, speed=0.4),
        exposure_s=2e-3,
        target_mm=0.001,
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """Head, arm, fixtures and calibration target of one twin, and what they were drawn from."""

    head: Head
    arm: MeasuringArm
    fixtures: Fixtures
    target: CirclePattern
    mechanics: Mechanics

    @staticmethod
    def build(
        head: str, preset: Preset, seed: int, part_mm: FloatArray | None = None
    ) -> Instrument:
        """Draw one instrument; everything follows from the seed.

        ``part_mm`` (T, 3, 3) are the triangles of a part in place of the workpiece.
        """
        mechanics = MECHANICS[preset]
        return Instrument(
            head=build_head(head, preset, seed),
            arm=MeasuringArm.build(mechanics.arm, np.random.default_rng([seed, 2])),
            fixtures=Fixtures.build(preset, np.random.default_rng([seed, 3]), part_mm),
            target=made_target(mechanics.target_mm, np.random.default_rng([seed, 4])),
            mechanics=mechanics,
        )
