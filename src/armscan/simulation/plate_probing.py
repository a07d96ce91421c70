# SPDX-License-Identifier: Apache-2.0
"""The plate touched with a real tip: where the ball of the probe stops, and what the arm says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector
from armscan.records.arm_track import NO_TRIGGER, ArmTrack
from armscan.simulation.aim import FACE_DOWN
from armscan.simulation.arm_inverse import COMFORTABLE_RAD, reach
from armscan.simulation.arm_recording import track_of_readings
from armscan.simulation.measuring_arm import MeasuringArm
from armscan.simulation.stations import Bench

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


@dataclass(frozen=True, slots=True, eq=False)
class PlateProbing:
    """What a program gets; see `armscan.devices.twin.Probing`.

    Parameters
    ----------
    arm
        One sample a touch.
    tool_from_probe_mm
        (3,) calibrated centre of the tip in Tool.
    tip_diameter_mm
        Calibrated diameter of the tip.
    """

    arm: ArmTrack
    tool_from_probe_mm: FloatArray
    tip_diameter_mm: float

    def __post_init__(self) -> None:
        centre = frozen_floats(self.tool_from_probe_mm, (3,), "tool_from_probe_mm")
        object.__setattr__(self, "tool_from_probe_mm", centre)


def probe_plate(
    arm: MeasuringArm, bench: Bench, errors: ProbeErrors, rng: np.random.Generator
) -> PlateProbing:
    """Touch the plate all around with a tip that leans this way and that."""
    joints = []
    last = COMFORTABLE_RAD
    for x, y in _places_mm(rng):
        centre = _tip_centre_mm(bench, x, y, errors.touch_mm * rng.standard_normal())
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


def _tip_centre_mm(bench: Bench, x_mm: float, y_mm: float, touch_mm: float) -> FloatArray:
    """(3,) centre, in Base, of a tip that rests on the true face at x, y of the plate's frame."""
    x, y = np.array([x_mm]), np.array([y_mm])
    foot = np.array([[x_mm, y_mm, bench.plate.height_mm(x, y)[0]]])
    centre = foot[0] + (0.5 * TIP_DIAMETER_MM + touch_mm) * bench.plate.normals(foot)[0]
    pose = bench.base_from_plate
    return np.asarray(pose.rotation @ centre + pose.translation_mm)


def _tool_at(centre_mm: FloatArray, rng: np.random.Generator) -> Pose[Base, Tool]:
    """Pose of a tool that holds the tip's centre at a place, leaning by chance."""
    lean = rotation_from_vector(np.array([*(_LEAN_RAD * rng.uniform(-1.0, 1.0, 2)), 0.0]))
    roll = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-1.0, 1.0)]))
    rotation = lean @ roll @ FACE_DOWN
    return Pose(rotation, centre_mm - rotation @ TRUE_PROBE_MM)
