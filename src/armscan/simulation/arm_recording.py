# SPDX-License-Identifier: Apache-2.0
"""What the arm's controller reports: samples of its own clock, and one at each trigger."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.arm_track import NO_TRIGGER, ArmTrack
from armscan.simulation.measuring_arm import MeasuringArm
from armscan.simulation.sweep import Sweep

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
    return ArmTrack(t_ns, rotations, translations, known, trigger_ids, readings)


def track_of_sweeps(
    arm: MeasuringArm, sweeps: Sequence[Sweep], starts_ns: Sequence[int], rng: np.random.Generator
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
        joints.append(one.path.joints(both[order] * 1e-9))
    return track_of_readings(
        arm, np.concatenate(times), np.concatenate(triggers), np.concatenate(joints), rng
    )
