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
from armscan.simulation.screw_arm import ScrewArm
from armscan.simulation.sheet_middle import sheet_middle_mm

CAMERA_CLOCK_NS = 12_500_000
SLOWEST_MM_S, FASTEST_MM_S = 24.0, 72.0
"""Of the progress along the stroke; what the hand adds stays within 20-80 mm/s."""
_KNOT_S = 0.06
_MARGIN_S = 0.12
_FINE_S = 0.002


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
    """

    base_from_face: FloatArray
    start_mm: FloatArray
    end_mm: FloatArray
    aim: Aim
    speed_mm_s: float
    n_exposures: int

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
    duration = float(np.interp(stroke.length_mm, way, times))
    frames = int(duration * 1e9) // CAMERA_CLOCK_NS
    if frames < stroke.n_exposures:
        raise InputError(
            f"{stroke.n_exposures} images in a stroke of {duration:.2f} s: the camera takes "
            f"{frames}",
            remedy="ask for fewer images or a longer stroke",
        )
    ticks = np.rint(np.linspace(1, frames, stroke.n_exposures)).astype(np.int64)
    knots = np.arange(-_MARGIN_S, duration + _MARGIN_S + _KNOT_S, _KNOT_S)
    sizes = (hand.tilt_deg, hand.tilt_deg, hand.tilt_deg, hand.depth_mm, hand.aside_mm)
    stray = np.stack([size * Sway.draw(rng)(knots) for size in sizes], axis=1)
    poses = _poses(stroke, head, np.interp(knots, times, way), stray)
    path = HandPath.through(arm, head.tool_from_sensor, knots, poses)
    return Sweep(path, CAMERA_CLOCK_NS * ticks)


def _progress(
    stroke: Stroke, hand: Unsteadiness, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (N,) in s and the way (N,) in mm gone by then; both begin before the stroke."""
    longest = stroke.length_mm / SLOWEST_MM_S + 4.0 * _MARGIN_S
    times = np.arange(-2.0 * _MARGIN_S, longest, _FINE_S)
    wanted = stroke.speed_mm_s * (1.0 + hand.speed * Sway.draw(rng)(times))
    speed = np.clip(wanted, SLOWEST_MM_S, FASTEST_MM_S)
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
        middle = sheet_middle_mm(head, held.depth_mm)
        poses.append(sensor_over(stroke.base_from_face, spot, held, middle))
    return poses
