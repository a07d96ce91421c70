# SPDX-License-Identifier: Apache-2.0
"""One stroke of a hand over an object: when the camera looks, and where the head is then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.aim import Aim, sensor_over
from armscan.simulation.hand_path import HandPath, Sway, Unsteadiness
from armscan.simulation.head import Head
from armscan.simulation.posture import aim_point_mm
from armscan.simulation.screw_arm import ScrewArm

CAMERA_CLOCK_NS = 12_500_000
_KNOT_S = 0.06
_MARGIN_S = 0.12
_FINE_S = 0.002


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast the hand goes, and how often the camera looks.

    Parameters
    ----------
    slowest_mm_s, fastest_mm_s
        Of the progress along the stroke.
    is_burst
        True if images are taken at successive ticks of the camera's clock, half of them before
        the middle of the stroke and half after it, wherever the hand is then; False if they are
        taken from the start of the stroke to its end.
    """

    slowest_mm_s: float
    fastest_mm_s: float
    is_burst: bool = False


UNHURRIED = Pace(24.0, 72.0)
"""What the hand adds stays within 20-80 mm/s."""
BURST = Pace(56.0, 140.0, is_burst=True)
"""What the hand adds stays within 50-150 mm/s."""


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """What the person means to do.

    Parameters
    ----------
    base_from_face
        (3, 3) rotation of the face that is scanned; z is its normal.
    start_mm, end_mm
        (3,) where the middle of the stripe shall go from and to, in Base.
    aim
        How the head is held.
    speed_mm_s
        Mean speed.
    n_exposures
        Images to keep, evenly from all that the camera's clock gives.
    pace
        Slowest and fastest progress, and whether the camera takes every tick of its clock.
    """

    base_from_face: FloatArray
    start_mm: FloatArray
    end_mm: FloatArray
    aim: Aim
    speed_mm_s: float
    n_exposures: int
    pace: Pace = UNHURRIED

    @property
    def length_mm(self) -> float:
        """Way of the middle of the stripe."""
        return float(np.linalg.norm(self.end_mm - self.start_mm))


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """What the person did.

    Parameters
    ----------
    path
        True joint angles, from a little before the first exposure to a little after the last;
        times in s from the start of the stroke.
    exposure_t_ns
        (N,) mid-exposure times, ns from the start of the stroke.
    """

    path: HandPath
    exposure_t_ns: IntArray


def sweep(
    stroke: Stroke, head: Head, arm: ScrewArm, hand: Unsteadiness, rng: np.random.Generator
) -> Sweep:
    """Carry out a stroke with an unsteady hand.

    Raises
    ------
    InputError
        If the stroke is over before the camera has taken all images.
    EstimationError
        If the arm does not reach.
    """
    times, way = _progress(stroke, hand, rng)
    if stroke.pace.is_burst:
        ticks = np.arange(1, stroke.n_exposures + 1, dtype=np.int64)
        duration = 1e-9 * CAMERA_CLOCK_NS * (stroke.n_exposures + 1)
        way = way + 0.5 * stroke.length_mm - np.interp(0.5 * duration, times, way)
    else:
        duration = float(np.interp(stroke.length_mm, way, times))
        ticks = _even_ticks(stroke.n_exposures, duration)
    knots = np.arange(-_MARGIN_S, duration + _MARGIN_S + _KNOT_S, _KNOT_S)
    sizes = (hand.tilt_deg, hand.tilt_deg, hand.tilt_deg, hand.depth_mm, hand.aside_mm)
    stray = np.stack([size * Sway.draw(rng)(knots) for size in sizes], axis=1)
    poses = _poses(stroke, head, np.interp(knots, times, way), stray)
    path = HandPath.through(arm, head.tool_from_sensor, knots, poses)
    return Sweep(path, CAMERA_CLOCK_NS * ticks)


def _even_ticks(n_exposures: int, duration_s: float) -> IntArray:
    """(n,) ticks of the camera's clock from the start of a stroke to its end."""
    frames = int(duration_s * 1e9) // CAMERA_CLOCK_NS
    if frames < n_exposures:
        raise InputError(
            f"{n_exposures} images in a stroke of {duration_s:.2f} s: the camera takes {frames}",
            remedy="ask for fewer images or a longer stroke",
        )
    return np.rint(np.linspace(1, frames, n_exposures)).astype(np.int64)


def _progress(
    stroke: Stroke, hand: Unsteadiness, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (N,) in s and the way (N,) in mm gone by then; both begin before the stroke."""
    pace = stroke.pace
    burst_s = 1e-9 * CAMERA_CLOCK_NS * stroke.n_exposures if pace.is_burst else 0.0
    longest = max(stroke.length_mm / pace.slowest_mm_s, burst_s) + 4.0 * _MARGIN_S
    times = np.arange(-2.0 * _MARGIN_S, longest, _FINE_S)
    wanted = stroke.speed_mm_s * (1.0 + hand.speed * Sway.draw(rng)(times))
    speed = np.clip(wanted, pace.slowest_mm_s, pace.fastest_mm_s)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * _FINE_S)])
    return times, way - np.interp(0.0, times, way)


def _poses(
    stroke: Stroke, head: Head, way_mm: FloatArray, stray: FloatArray
) -> list[Pose[Base, Sensor]]:
    """Poses of the sensor after ways (N,), with (N, 5) strays of three angles, depth, side."""
    along = (stroke.end_mm - stroke.start_mm) / stroke.length_mm
    across = np.cross(stroke.base_from_face[:, 2], along)
    aim = stroke.aim
    poses = []
    for way, (tilt_x, tilt_y, roll, depth, aside) in zip(way_mm, stray, strict=True):
        held = Aim(
            aim.tilt_x_deg + tilt_x,
            aim.tilt_y_deg + tilt_y,
            aim.roll_deg + roll,
            aim.depth_mm + depth,
        )
        spot = stroke.start_mm + way * along + aside * across
        middle = aim_point_mm(head, held.depth_mm)
        poses.append(sensor_over(stroke.base_from_face, spot, held, middle))
    return poses
