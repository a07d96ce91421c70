# SPDX-License-Identifier: Apache-2.0
"""How a person holds and leads the head: orientations over a face, scan passes, tremor, ways."""

from __future__ import annotations

import tomllib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, floats, ints
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.arm.arm import COMFORTABLE_RAD, N_JOINTS, ScrewArm, reach
from armscan.simulation.head import Head, sheet_middle_mm
from armscan.simulation.objects.fixtures import (
    BALL_DIAMETER_MM,
    STEP_CENTRES_MM,
    STEP_HEIGHTS_MM,
    Fixtures,
)

PLANS: dict[str, Any] = tomllib.loads(
    (files("armscan.simulation") / "scenes.toml").read_text("utf-8")
)
"""The table that lies beside the simulator: what the hand does in each scene."""
FACE_DOWN = np.diag([1.0, -1.0, -1.0])
"""Sensor axes over a face with x to the right and z up: it looks down on it, upright."""
_JITTER = np.array([2.0, 2.0, 6.0, 2.0])
"""By how much a person misses tilts and roll, degrees, and depth, mm, at most."""


@dataclass(frozen=True, slots=True)
class HeadOrientation:
    """One way of holding the head over a face.

    Parameters
    ----------
    tilt_x_deg, tilt_y_deg
        The head turned from looking straight down, about its own x and y axes; negative
        ``tilt_x_deg`` brings the laser upright and lays the camera over.
    roll_deg
        The head turned about the face's normal first.
    depth_mm
        Depth, along the optical axis, of the middle of the stripe.
    """

    tilt_x_deg: float
    tilt_y_deg: float
    roll_deg: float
    depth_mm: float

    def rotation(self) -> FloatArray:
        """Rotation (3, 3) ``face_from_sensor``."""
        roll, about_y, about_x = (
            rotation_from_vector(np.radians(angle) * np.eye(3)[axis])
            for angle, axis in ((self.roll_deg, 2), (-self.tilt_y_deg, 1), (-self.tilt_x_deg, 0))
        )
        return np.asarray(roll @ FACE_DOWN @ about_x @ about_y)

    def turned(
        self, tilt_x_deg: float, tilt_y_deg: float, roll_deg: float, deeper_mm: float = 0.0
    ) -> HeadOrientation:
        """The same with more tilt, roll and depth."""
        return HeadOrientation(
            self.tilt_x_deg + tilt_x_deg,
            self.tilt_y_deg + tilt_y_deg,
            self.roll_deg + roll_deg,
            self.depth_mm + deeper_mm,
        )

    def by_hand(self, jitter: FloatArray) -> HeadOrientation:
        """The same as a person hits it; ``jitter`` (4,) is between -1 and 1."""
        return self.turned(*(_JITTER * jitter))


def sensor_over(
    base_rotation: FloatArray,
    spot_base_mm: FloatArray,
    aim: HeadOrientation,
    stripe_sensor_mm: FloatArray,
) -> Pose[Base, Sensor]:
    """``base_from_sensor`` that brings the middle of the stripe to a spot.

    Parameters
    ----------
    base_rotation
        (3, 3) ``base_from_face``: its z axis is the face's normal.
    spot_base_mm
        (3,) where the middle of the stripe shall fall.
    aim
        How the head is held.
    stripe_sensor_mm
        (3,) the middle of the stripe at the aim's depth, in Sensor.
    """
    rotation = base_rotation @ aim.rotation()
    return Pose(rotation, spot_base_mm - rotation @ stripe_sensor_mm)


def on_face(face: FloatArray, origin_mm: FloatArray, place_mm: tuple[float, float]) -> FloatArray:
    """(3,) point beside a face's origin, along its first two axes."""
    return np.asarray(origin_mm + face[:, :2] @ np.array(place_mm))


def leaning(tilt_deg: float, azimuth_deg: float) -> FloatArray:
    """(3, 3) axes of a face that leans towards an azimuth, without turning about the vertical."""
    azimuth = np.radians(azimuth_deg)
    axis = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return rotation_from_vector(np.radians(tilt_deg) * axis)


def quarter_turn() -> FloatArray:
    """A face whose y axis runs along the x of the one before it."""
    return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


DEPTH_MM = 137.0
"""Middle of the depths that the scanning window sees."""
_STEREO_DEPTH_MM = 140.0
"""There the axes of two cameras meet."""
_STEREO_ROLL_DEG = 92.0


def light_upright(head: Head) -> HeadOrientation:
    """Orientation at which the light falls along the face's normal.

    One sheet: its middle ray stands upright. Two: both sheets do, that is the line in which they
    meet. More: the middle ray of the middle one.
    """
    if len(head.lasers) == 2:
        along = np.cross(head.lasers[0].normal, head.lasers[1].normal)
        return _looking_along(head, along * np.sign(along[2]))
    return _looking_along(head, head.lasers[len(head.lasers) // 2].rays(np.zeros(1))[0])


def facing_both(head: Head) -> HeadOrientation:
    """Orientation at which a face is seen equally obliquely by all cameras."""
    return _looking_along(head, _mean_view(head))


def viewing_axes(head: Head) -> FloatArray:
    """(3, 3) axes, in Sensor, of a target that faces all cameras alike: its z points away."""
    away = _mean_view(head)
    down = np.array([0.0, 1.0, 0.0]) - away[1] * away
    down /= np.linalg.norm(down)
    return np.stack([np.cross(down, away), down, away], axis=1)


def aim_point_mm(head: Head, depth_mm: float) -> FloatArray:
    """(3,) point of Sensor, at a depth along camera 0's axis, that is brought to what is scanned.

    For one camera it is the middle of its light, for two the middle of what both see.
    """
    if len(head.cameras) == 1:
        return sheet_middle_mm(head, depth_mm)
    away = _mean_view(head)
    return overlap_middle_mm(head, (depth_mm - _STEREO_DEPTH_MM) / away[2])


def overlap_middle_mm(head: Head, farther_mm: float = 0.0) -> FloatArray:
    """(3,) point of Sensor on which all cameras look, or farther away from them.

    For one camera it is the middle of its light.
    """
    if len(head.cameras) > 1:
        return np.array([0.0, 0.0, _STEREO_DEPTH_MM]) + farther_mm * _mean_view(head)
    return sheet_middle_mm(head, DEPTH_MM + farther_mm)


def _mean_view(head: Head) -> FloatArray:
    """(3,) unit mean of the cameras' axes."""
    axes = [mounted.camera_from_sensor.rotation[2] for mounted in head.cameras]
    total = np.sum(axes, axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _looking_along(head: Head, direction: FloatArray) -> HeadOrientation:
    """Orientation that turns a direction (3,) of Sensor against the face's normal."""
    x, y, z = direction / np.linalg.norm(direction)
    is_stereo = len(head.cameras) > 1
    return HeadOrientation(
        float(-np.degrees(np.arcsin(y))),
        float(np.degrees(np.arctan2(x, z))),
        _STEREO_ROLL_DEG if is_stereo else 0.0,
        _STEREO_DEPTH_MM if is_stereo else DEPTH_MM,
    )


_FREQUENCIES_HZ = (0.4, 0.9, 1.7)
_SHARES = (0.6, 0.3, 0.1)


@dataclass(frozen=True, slots=True)
class HandTremor:
    """How far a hand strays; each a standard deviation over time.

    Parameters
    ----------
    depth_mm
        Of the stand-off.
    aside_mm
        Across the way.
    """

    tilt_deg: float = 1.5
    depth_mm: float = 1.0
    aside_mm: float = 1.5
    speed: float = 0.25


def sway(rng: np.random.Generator, t_s: FloatArray) -> FloatArray:
    """(N,) smooth random values at times (N,), of about unit standard deviation over time.

    A few slow waves with random phases.
    """
    phases_rad = rng.uniform(0.0, 2.0 * np.pi, len(_FREQUENCIES_HZ))
    angle = 2.0 * np.pi * np.outer(t_s, _FREQUENCIES_HZ) + phases_rad
    scale = np.sqrt(2.0 / np.sum(np.square(_SHARES)))
    return np.asarray(scale * np.sin(angle) @ np.array(_SHARES))


CAMERA_CLOCK_NS = 12_500_000
_KNOT_S = 0.06
_MARGIN_S = 0.12
_FINE_S = 0.002


@dataclass(frozen=True, slots=True)
class SpeedProfile:
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


UNHURRIED = SpeedProfile(24.0, 72.0)
"""What the hand adds stays within 20-80 mm/s."""
BURST = SpeedProfile(56.0, 140.0, is_burst=True)
"""What the hand adds stays within 50-150 mm/s."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanPass:
    """What the person means to do.

    Parameters
    ----------
    base_from_face
        (3, 3) rotation of the face that is scanned; z is its normal.
    start_mm, end_mm
        (3,) where the middle of the stripe shall go from and to, in Base.
    """

    base_from_face: FloatArray
    start_mm: FloatArray
    end_mm: FloatArray
    aim: HeadOrientation
    speed_mm_s: float
    n_exposures: int
    pace: SpeedProfile = UNHURRIED

    @property
    def length_mm(self) -> float:
        """Way of the middle of the stripe."""
        return float(np.linalg.norm(self.end_mm - self.start_mm))


class Trajectory(ArrayRecord):
    """What the person did: joint angles over time, cubic between knots.

    Parameters
    ----------
    t_s, joints_rad
        (N,) times of the knots from the start of the pass, from a little before its first exposure
        to a little after its last, and (N, 7) true joint angles there.
    exposure_t_ns
        (M,) mid-exposure times, ns from the start of the pass.
    """

    t_s: FloatArray = floats("N")
    joints_rad: FloatArray = floats("N", N_JOINTS)
    exposure_t_ns: IntArray = ints("M")

    def joints(self, t_s: FloatArray) -> FloatArray:
        """True joint angles (N, 7) at times (N,) within the knots."""
        return np.asarray(CubicSpline(self.t_s, self.joints_rad, axis=0)(t_s))


def sweep(
    stroke: ScanPass, head: Head, arm: ScrewArm, hand: HandTremor, rng: np.random.Generator
) -> Trajectory:
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
    stray = np.stack([size * sway(rng, knots) for size in sizes], axis=1)
    poses = _poses(stroke, head, np.interp(knots, times, way), stray)
    return _trajectory(head, arm, knots, poses, ticks)


def _trajectory(
    head: Head,
    arm: ScrewArm,
    knots: FloatArray,
    poses: Iterable[Pose[Base, Sensor]],
    ticks: IntArray,
) -> Trajectory:
    """How the arm holds the head at poses, one a knot, with exposures at ticks of the clock."""
    sensor_from_tool = head.tool_from_sensor.inverse()
    joints = [COMFORTABLE_RAD]
    for pose in poses:
        joints.append(reach(arm, pose @ sensor_from_tool, joints[-1]))
    return Trajectory(
        t_s=knots, joints_rad=np.array(joints[1:]), exposure_t_ns=CAMERA_CLOCK_NS * ticks
    )


_BOUNCE_HZ = (0.8, 1.3, 2.1)
_BOUNCE_MM_S, _ASIDE_MM = 30.0, 8.0
"""Speed of the stand-off, and way to the side, rms."""


def bounce(
    spot_mm: FloatArray, start: ScanPass, head: Head, arm: ScrewArm, rng: np.random.Generator
) -> Trajectory:
    """Hold the head over a spot (3,) as a pass begins, moved nearer and away, aside and tilted.

    Exposures are ``start.n_exposures`` at every second tick of the camera's clock.
    """
    ticks = 2 * np.arange(1, start.n_exposures + 1, dtype=np.int64)
    knots = np.arange(-2 * _MARGIN_S, 1e-9 * CAMERA_CLOCK_NS * ticks[-1] + 2 * _MARGIN_S, _KNOT_S)
    rates = 2.0 * np.pi * np.array(_BOUNCE_HZ)
    phases = rng.uniform(0.0, 2.0 * np.pi, len(rates))
    sizes = _BOUNCE_MM_S * np.sqrt(2.0 / len(rates)) / rates
    away = np.sin(np.outer(knots, rates) + phases) @ sizes
    x, y, tilt_x, tilt_y = (size * sway(rng, knots) for size in (_ASIDE_MM, _ASIDE_MM, 1.5, 1.5))
    poses = []
    for k, depth in enumerate(away):
        held = start.aim.turned(tilt_x[k], tilt_y[k], 0.0, depth)
        spot = spot_mm + start.base_from_face[:, :2] @ [x[k], y[k]]
        middle = aim_point_mm(head, held.depth_mm)
        poses.append(sensor_over(start.base_from_face, spot, held, middle))
    return _trajectory(head, arm, knots, poses, ticks)


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
    stroke: ScanPass, hand: HandTremor, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (N,) in s and the way (N,) in mm gone by then; both begin before the stroke."""
    pace = stroke.pace
    burst_s = 1e-9 * CAMERA_CLOCK_NS * stroke.n_exposures if pace.is_burst else 0.0
    longest = max(stroke.length_mm / pace.slowest_mm_s, burst_s) + 4.0 * _MARGIN_S
    times = np.arange(-2.0 * _MARGIN_S, longest, _FINE_S)
    wanted = stroke.speed_mm_s * (1.0 + hand.speed * sway(rng, times))
    speed = np.clip(wanted, pace.slowest_mm_s, pace.fastest_mm_s)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * _FINE_S)])
    return times, way - np.interp(0.0, times, way)


def _poses(
    stroke: ScanPass, head: Head, way_mm: FloatArray, stray: FloatArray
) -> list[Pose[Base, Sensor]]:
    """Poses of the sensor after ways (N,), with (N, 5) strays of three angles, depth, side."""
    along = (stroke.end_mm - stroke.start_mm) / stroke.length_mm
    across = np.cross(stroke.base_from_face[:, 2], along)
    aim = stroke.aim
    poses = []
    for way, (tilt_x, tilt_y, roll, depth, aside) in zip(way_mm, stray, strict=True):
        held = aim.turned(tilt_x, tilt_y, roll, depth)
        spot = stroke.start_mm + way * along + aside * across
        middle = aim_point_mm(head, held.depth_mm)
        poses.append(sensor_over(stroke.base_from_face, spot, held, middle))
    return poses


SweptScene = Literal["plate", "ball", "steps", "part", "waves", "workpiece"]
Way = tuple[FloatArray, FloatArray, FloatArray, list[float], float]
"""Face (3, 3), start and end (3,) of the middle of the stripe in Base, tilts and roll, speed."""

_OVER_STEPS_MM = 10.0
_OVER_PART_MM = 13.0
_UP_THE_WORKPIECE = 0.75
"""Where the middle of the stripe is led over it, as a part of its height."""
_OVER_BALL_MM = 0.8 * 0.5 * BALL_DIAMETER_MM


def scan_passes(scene: SweptScene, head: Head, fixtures: Fixtures) -> list[ScanPass]:
    """The passes of a hand over the object of a scene, which suit the head."""
    plan: dict[str, Any] = PLANS["passes"][head.kind][scene]
    is_stereo = len(head.cameras) > 1
    first = facing_both(head) if is_stereo else HeadOrientation(0.0, 0.0, 0.0, DEPTH_MM)
    if scene == "ball":
        ways = _around_ball(fixtures.ball.centre_mm, plan, 0 if is_stereo else 1)
    elif scene == "part":
        ways = _along_part(fixtures.base_from_part, plan, is_stereo)
    elif scene == "workpiece":
        ways = _over_workpiece(fixtures, plan, is_stereo)
    elif scene == "steps":
        ways = _over_face(fixtures.base_from_ground, _OVER_STEPS_MM, plan)
    else:
        is_plate = scene == "plate"
        pose = fixtures.base_from_plate if is_plate else fixtures.base_from_waves
        ways = _over_face(pose, 0.0, plan)
    profile = BURST if head.kind == "crossed" else UNHURRIED
    counted = [(way, plan["n_exposures"]) for way in ways]
    if scene == "workpiece" and fixtures.bore_mm is not None and "bore" in plan:
        into = _into_bore(fixtures.base_from_workpiece, fixtures.bore_mm, plan)
        counted += [(way, plan["bore"]["n_exposures"]) for way in into]
    return [
        ScanPass(face, start, end, first.turned(*angles), speed, n_exposures, profile)
        for (face, start, end, angles, speed), n_exposures in counted
    ]


def _over_face(pose: Pose[Base, Any], lift_mm: float, plan: dict[str, Any]) -> Iterator[Way]:
    face = pose.rotation
    lift = lift_mm * face[:, 2]
    for x, y, x_end, y_end, *angles, speed in plan["passes"]:
        start = on_face(face, pose.translation_mm, (x, y)) + lift
        yield face, start, on_face(face, pose.translation_mm, (x_end, y_end)) + lift, angles, speed


def _around_ball(centre_mm: FloatArray, plan: dict[str, Any], axis: int) -> Iterator[Way]:
    for tilt, azimuth, length, speed in plan["passes"]:
        face = leaning(tilt, azimuth)
        middle = centre_mm + _OVER_BALL_MM * face[:, 2]
        half = 0.5 * length * face[:, axis]
        yield face, middle - half, middle + half, [plan["tilt_deg"], 0.0, 0.0], speed


def _along_part(pose: Pose[Base, Any], plan: dict[str, Any], is_stereo: bool) -> Iterator[Way]:
    half = plan["half_way_mm"]
    for side, lean, speed in plan["passes"]:
        face = pose.rotation @ leaning(abs(lean), -90.0 if lean > 0.0 else 90.0)
        if not is_stereo:
            face = face @ quarter_turn()
        start, end = (
            pose.translation_mm + pose.rotation @ np.array([x, side, _OVER_PART_MM])
            for x in (-half, half)
        )
        yield face, start, end, [plan["tilt_deg"], 0.0, 0.0], speed


def _over_workpiece(fixtures: Fixtures, plan: dict[str, Any], is_stereo: bool) -> Iterator[Way]:
    """In lanes along the x of a part of any size, from each of the sides that are planned."""
    pose, bounds = fixtures.base_from_workpiece, fixtures.workpiece.bounds_mm
    middle, size = 0.5 * (bounds[0] + bounds[1]), bounds[1] - bounds[0]
    height = bounds[0, 2] + _UP_THE_WORKPIECE * size[2]
    n_lanes = max(1, int(np.ceil(size[1] / plan["lane_mm"])))
    lanes = middle[1] + size[1] * ((np.arange(n_lanes) + 0.5) / n_lanes - 0.5)
    for tilt, azimuth, speed in plan["passes"]:
        face = pose.rotation @ leaning(tilt, azimuth)
        if not is_stereo:
            face = face @ quarter_turn()
        for y in lanes:
            start, end = (
                pose.apply(np.array([x, y, height])) for x in (bounds[0, 0], bounds[1, 0])
            )
            yield face, start, end, [plan["tilt_deg"], 0.0, 0.0], speed


def _into_bore(pose: Pose[Base, Any], middle_mm: FloatArray, plan: dict[str, Any]) -> Iterator[Way]:
    """Short ways over a bore, the head leant so that it looks at one part of the wall each time."""
    half = np.array([0.5 * plan["bore"]["way_mm"], 0.0, 0.0])
    for tilt, azimuth, speed in plan["bore"]["passes"]:
        face = pose.rotation @ leaning(tilt, azimuth) @ quarter_turn()
        start, end = pose.apply(middle_mm - half), pose.apply(middle_mm + half)
        yield face, start, end, [plan["tilt_deg"], 0.0, 0.0], speed


def still_step(fixtures: Fixtures, head: Head) -> tuple[FloatArray, FloatArray, HeadOrientation]:
    """Face (3, 3), spot (3,) in Base and orientation for one look at a block and the ground.

    The light is upright: from one stripe alone a height is known only in the sheet. The block is
    the higher one, but the lower one for a head of many lines.
    """
    block = 1 if len(head.cameras) > 1 else 0
    face, origin = fixtures.base_from_ground.rotation, fixtures.base_from_ground.translation_mm
    lift = 0.5 * STEP_HEIGHTS_MM[block] * face[:, 2]
    return face, on_face(face, origin, STEP_CENTRES_MM[block]) + lift, light_upright(head)


_REST_SHARE = 0.2
"""Part of the way from stroke to stroke that the hand waits at its end."""


class HandWay:
    """Joint angles at each instant of a scene, and between them.

    Within a stroke a spline that begins and ends at rest; from stroke to stroke, and from the last
    instant back to the first, the smoothest way there, then a wait.

    Parameters
    ----------
    joints_rad
        (N, 7) at the instants.
    stroke
        N numbers: instants of one stroke have the same and follow each other.
    """

    def __init__(self, joints_rad: FloatArray, stroke: Sequence[int]) -> None:
        self.joints_rad = joints_rad
        self._stroke = list(stroke)
        self._first = [self._stroke.index(number) for number in self._stroke]
        self._splines = {
            first: CubicSpline(np.arange(n), joints_rad[first : first + n], bc_type="clamped")
            for first in set(self._first)
            if (n := self._first.count(first)) > 1
        }

    def is_travel(self, k: int) -> bool:
        """Whether another stroke follows after instant ``k``."""
        return k + 1 >= len(self._stroke) or self._stroke[k] != self._stroke[k + 1]

    def between(self, k: int, share: FloatArray) -> FloatArray:
        """(N, 7) after parts (N,) of the time from instant ``k`` to the next."""
        if not self.is_travel(k):
            first = self._first[k]
            return np.asarray(self._splines[first](k - first + share))
        following = self.joints_rad[(k + 1) % len(self.joints_rad)]
        return led(self.joints_rad[k], following, share)


def led(start: FloatArray, end: FloatArray, share: FloatArray) -> FloatArray:
    """(N, 7) on the way of least jerk (Flash and Hogan 1985), which is over before the time is."""
    u = np.clip(share / (1.0 - _REST_SHARE), 0.0, 1.0)[:, None]
    return np.asarray(start + (end - start) * u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


_HISTORY_NS = 12_000_000_000
"""What the hand did is forgotten after so long."""


class HandHistory:
    """Where the joints were over the last seconds: ways, each followed by a wait at its end.

    It begins at rest at ``joints_rad`` (7,).
    """

    def __init__(self, joints_rad: FloatArray) -> None:
        self._ways: deque[tuple[int, int, Callable[[FloatArray], FloatArray]]] = deque()
        self.go(0, 0, lambda share: np.tile(joints_rad, (len(share), 1)))

    @property
    def end_ns(self) -> int:
        """When the last way is or was over."""
        return self._ways[-1][1]

    def go(self, start_ns: int, end_ns: int, way: Callable[[FloatArray], FloatArray]) -> None:
        """Go a way between two times: ``way`` gives angles (N, 7) after parts (N,) of them."""
        self._ways.append((start_ns, end_ns, way))
        while len(self._ways) > 2 and self._ways[1][0] < start_ns - _HISTORY_NS:
            self._ways.popleft()

    def joints_rad(self, t_ns: IntArray) -> FloatArray:
        """True angles (N, 7) at times (N,); before the history where it begins."""
        joints = np.zeros((len(t_ns), N_JOINTS))
        starts = np.array([start_ns for start_ns, _, _ in self._ways])
        which = np.clip(np.searchsorted(starts, t_ns, side="right") - 1, 0, None)
        for k in np.unique(which):
            (start_ns, end_ns, way), here = self._ways[int(k)], which == k
            share = (t_ns[here] - start_ns) / max(end_ns - start_ns, 1)
            joints[here] = way(np.clip(share, 0.0, 1.0))
        return joints
