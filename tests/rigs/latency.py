# SPDX-License-Identifier: Apache-2.0
"""A head led over a plate with a reversing stand-off, at feature level; truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.latency import PlateLooks, plate_looks
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.records.recording import ArmTrack

N_POINTS = 40


@dataclass(frozen=True)
class LatencyCase:
    """What is drawn, and what is asked for."""

    seconds: float = 10.0
    camera_hz: float = 80.0
    arm_hz: float = 240.0
    speed_mm_s: float = 30.0
    aside_mm_s: float = 15.0
    rocking_deg: float = 3.0
    reversing_hz: float = 0.9
    arm_mm: float = 0.008
    arm_turn_rad: float = 4e-5
    waves_mm: float = 0.01
    flatness_mm: float = 0.003
    stripe_mm: float = 0.01
    hand_eye_mm: float = 0.03
    scale: float = 1e-4
    latency_ns: int = -3_700_000
    drift: float = 0.0
    separate_ns: int = 0
    outliers: float = 0.0
    n_sheets: int = 1


def hand(rng, case):
    """Smooth functions of time (s): stand-off and asides in mm, turns in rad."""

    def wobble(hz, rms_speed, n=4):
        f = hz * rng.uniform(0.6, 1.5, n)
        size = rng.uniform(0.5, 1.0, n) / f
        phase = rng.uniform(0, 2 * np.pi, n)
        t = np.linspace(0.0, case.seconds, 2000)
        speed = (2 * np.pi * f * size) @ np.cos(2 * np.pi * f[:, None] * t + phase[:, None])
        size *= rms_speed / max(np.sqrt((speed**2).mean()), 1e-12)
        return lambda s: size @ np.sin(2 * np.pi * f[:, None] * s + phase[:, None])

    away = wobble(case.reversing_hz, case.speed_mm_s)
    aside = [wobble(0.25, case.aside_mm_s) for _ in range(2)]
    rock = np.radians(case.rocking_deg) * 2 * np.pi * 0.5
    turns = [wobble(0.5, rock) for _ in range(3)]
    tremor = [wobble(9.0, 1.5) for _ in range(3)]
    return away, aside, turns, tremor


def true_poses(t_s, base_from_plate, start, motion):
    """``base_from_sensor`` at times (N,), rotations and translations."""
    away, aside, turns, tremor = motion
    over = np.column_stack([aside[0](t_s), aside[1](t_s), 130.0 + away(t_s)])
    over += 0.3 * np.column_stack([one(t_s) for one in tremor])
    turn = Rotation.from_rotvec(np.column_stack([one(t_s) for one in turns]))
    rotation = (Rotation.from_matrix(base_from_plate.rotation) * start * turn).as_matrix()
    return rotation, over @ base_from_plate.rotation.T + base_from_plate.translation_mm


def draw(case, seed):
    """Looks, track, the hand-eye as calibrated, and the true time to add at the middle, ns."""
    rng = np.random.default_rng(seed)
    base_from_plate = Pose.from_vectors(rng.normal(0, 0.3, 3), rng.uniform(-400, 400, 3))
    lean = rng.uniform(-15, 15, 2)
    start = Rotation.from_euler("xyz", [180 + lean[0], lean[1], rng.uniform(-90, 90)], degrees=True)
    tool_from_sensor: Pose[Tool, Sensor] = Pose.from_vectors(
        rng.normal(0, 0.5, 3), rng.uniform(-80, 80, 3)
    )
    motion = hand(rng, case)
    t_s = np.arange(0.0, case.seconds, 1 / case.camera_hz) + rng.uniform(0, 1 / case.camera_hz)
    seen = true_poses(t_s, base_from_plate, start, motion)
    looks = camera_looks(case, rng, t_s, base_from_plate, seen)
    arm_s = np.arange(-0.5, case.seconds + 0.5, 1 / case.arm_hz)
    told = true_poses(arm_s, base_from_plate, start, motion)
    track = arm_track_of(case, rng, arm_s, told, tool_from_sensor)
    wrong = Pose.from_vectors(
        tool_from_sensor.rotation_vector_rad + rng.normal(0, case.hand_eye_mm / 200, 3),
        tool_from_sensor.translation_mm + rng.normal(0, case.hand_eye_mm, 3),
    )
    middle_ns = looks.t_ns[0] + (looks.t_ns[-1] - looks.t_ns[0]) // 2
    truth = case.latency_ns + case.separate_ns + case.drift * middle_ns
    return looks, track, wrong, truth


def waves(rng, n_out, size, shortest_mm, longest_mm, n=4):
    """A smooth function of places (N, 3) with ``n_out`` values of this rms."""
    k = rng.normal(size=(n_out, n, 3))
    k /= np.linalg.norm(k, axis=2, keepdims=True)
    k *= 2 * np.pi / rng.uniform(shortest_mm, longest_mm, (n_out, n, 1))
    phase = rng.uniform(0, 2 * np.pi, (n_out, n))
    share = size * np.sqrt(2.0 / n)
    return lambda places: share * np.sin(np.einsum("onk,mk->mon", k, places) + phase).sum(axis=2)


def camera_looks(case, rng, t_s, base_from_plate, seen) -> PlateLooks:
    """Stripes where slanted sheets meet the plate, with the noise of points and an uneven plate."""
    rotation, place = seen
    uneven = waves(rng, 1, case.flatness_mm, 30.0, 150.0)
    slants = np.radians(25.0 + 4.0 * np.arange(case.n_sheets))
    along = np.linspace(-20.0, 20.0, N_POINTS // case.n_sheets)
    points, times = [], []
    for k, t in enumerate(t_s):
        normal = rotation[k].T @ base_from_plate.rotation[:, 2]
        height = base_from_plate.rotation[:, 2] @ (base_from_plate.translation_mm - place[k])
        here = []
        for slant in slants:
            sheet = np.array([0.0, np.cos(slant), np.sin(slant)])
            line = np.cross(normal, sheet)
            line /= np.linalg.norm(line)
            rows = np.vstack([sheet, normal, line])
            foot = np.linalg.solve(rows, [sheet[2] * 130.0, height, 0.0])
            here.append(foot + along[:, None] * line)
        true = np.concatenate(here)
        on_plate = (true @ rotation[k].T + place[k] - base_from_plate.translation_mm) @ (
            base_from_plate.rotation
        )
        true = true + uneven(on_plate * [1.0, 1.0, 0.0]) * normal
        true = true * (1.0 + case.scale) + rng.normal(0, case.stripe_mm, (len(true), 1)) * normal
        if rng.random() < case.outliers:
            true = true + rng.normal(0, 3.0) * normal
        points.append(true)
        times.append(round(t * 1e9))
    return plate_looks(times, points)


def arm_track_of(case, rng, arm_s, told, tool_from_sensor) -> ArmTrack:
    """The arm's samples: its clock, white noise, and errors that depend on where it is."""
    rotation, place = told
    turn = rotation @ tool_from_sensor.rotation.T
    tool = place - turn @ tool_from_sensor.translation_mm
    smooth = waves(rng, 6, 1.0, 60.0, 400.0)(tool)
    shift = case.waves_mm * smooth[:, :3] + rng.normal(0, case.arm_mm, tool.shape)
    twist = case.waves_mm / 300 * smooth[:, 3:] + rng.normal(0, case.arm_turn_rad, tool.shape)
    t_ns = np.rint(arm_s * 1e9 * (1 + case.drift)).astype(np.int64)
    return ArmTrack(
        t_ns=t_ns + case.latency_ns + case.separate_ns,
        rotations=Rotation.from_rotvec(twist).as_matrix() @ turn,
        translations_mm=tool + shift,
        is_known=np.ones(len(arm_s), dtype=np.bool_),
    )
