# SPDX-License-Identifier: Apache-2.0
"""The digital twin: an instrument by name that delivers recordings and its truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, cast, get_args

import numpy as np

from armscan.devices.sources import Preset, TwinScene
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, CameraRight, Part, Pose, Sensor, Tool
from armscan.records.recording import SessionKind
from armscan.simulation.arm.arm import COMFORTABLE_RAD, reach
from armscan.simulation.arm.hand import HandWay, SweptScene
from armscan.simulation.head import HEADS, RIGHT, sheet_points_mm
from armscan.simulation.instrument import (
    TIP_DIAMETER_MM,
    TRUE_PROBE_MM,
    Instrument,
    PlateProbing,
    probe_plate,
)
from armscan.simulation.objects.fixtures import BALL_DIAMETER_MM, STEP_HEIGHTS_MM
from armscan.simulation.objects.rings import DISC_DIAMETER_MM, RING_DIAMETER_MM
from armscan.simulation.scenes import (
    Recorded,
    camera_shots,
    hand_eye_scene,
    laser_shots,
    latency_scene,
    marker_scene,
    scan_scene,
    still_part_scene,
    still_step_scene,
)
from armscan.simulation.station import TwinScan
from armscan.simulation.targets import TARGET


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentTruth:
    """See `armscan.devices.sources.TwinTruth`."""

    instrument: Instrument
    preset: Preset
    seed: int

    @property
    def camera_parameters(self) -> FloatArray:
        """(9,) ``fx fy cx cy`` in px and ``k1 k2 p1 p2 k3``."""
        return self.instrument.head.camera.numbers

    @property
    def right_camera_parameters(self) -> FloatArray | None:
        """(9,) the same of the right camera; None for a head of one camera."""
        cameras = self.instrument.head.cameras
        return cameras[RIGHT].camera.numbers if len(cameras) > RIGHT else None

    @property
    def right_from_sensor(self) -> Pose[CameraRight, Sensor] | None:
        """Where the left camera is in the right one's frame; None for a head of one camera."""
        cameras = self.instrument.head.cameras
        return cameras[RIGHT].camera_from_sensor if len(cameras) > RIGHT else None

    @property
    def sheet_points_mm(self) -> dict[str, FloatArray]:
        """(N, 3) true points of each light sheet over the working region, Sensor frame."""
        return sheet_points_mm(self.instrument.head)

    @property
    def tool_from_sensor(self) -> Pose[Tool, Sensor]:
        """The true hand-eye."""
        return self.instrument.head.tool_from_sensor

    @property
    def plate_plane(self) -> FloatArray:
        """(4,) unit normal and D of the best plane through the true plate, in Base (eq. 2.55)."""
        return self.instrument.fixtures.plate_plane

    @property
    def ball_diameter_mm(self) -> float:
        """Of the reference ball."""
        return BALL_DIAMETER_MM

    @property
    def step_heights_mm(self) -> tuple[float, ...]:
        """Heights of the gauge blocks over the ground plate."""
        return STEP_HEIGHTS_MM

    @property
    def marker_centres_base_mm(self) -> FloatArray:
        """(N, 3) middles of all ring markers of the scene ``markers``."""
        return self.instrument.fixtures.marker_centres_mm()

    @property
    def moved_from_base(self) -> Pose[Base, Base]:
        """From Base to the Base of the scene ``markers-moved``."""
        return self.instrument.fixtures.moved_from_base

    def part_distance_mm(self, points_base_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) in Base from the free-form part's surface."""
        return self.instrument.fixtures.part_distance_mm(points_base_mm)

    def part_normals(self, points_base_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of that surface next to points (N, 3)."""
        return self.instrument.fixtures.part_normals(points_base_mm)

    @property
    def base_from_workpiece(self) -> Pose[Base, Part]:
        """Where the workpiece, or the part in its place, stands."""
        return self.instrument.fixtures.base_from_workpiece

    def workpiece_distance_mm(self, points_base_mm: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 3) in Base from its surface as it was made."""
        points = self.base_from_workpiece.inverse().apply(points_base_mm)
        return self.instrument.fixtures.workpiece.distance_mm(points)

    def document(self, scene: TwinScene | None = None) -> bytes:
        """All of it as JSON, with the mark ``"simulated": true``.

        The scene ``latency`` alone has a ``latency_ns``.
        """
        arm, fixtures, head = self.instrument.arm, self.instrument.fixtures, self.instrument.head
        content: dict[str, Any] = {
            "simulated": True,
            "head": head.name,
            "preset": self.preset,
            "seed": self.seed,
            "camera_parameters": self.camera_parameters.tolist(),
            "sources": {
                source: [sheet.name for sheet in head.sheets_of((source,))]
                for source in head.sources
            },
            "sheet_points_sensor_mm": {
                name: points.tolist() for name, points in self.sheet_points_mm.items()
            },
            "target_marks_board_mm": self.instrument.target.marks_board_mm.tolist(),
            "tool_from_sensor": _pose(self.tool_from_sensor),
            "plate_plane_base": self.plate_plane.tolist(),
            "base_from_plate": _pose(fixtures.base_from_plate),
            "ball": {
                "diameter_mm": self.ball_diameter_mm,
                "centre_base_mm": fixtures.ball.centre_mm.tolist(),
            },
            "steps": {
                "heights_mm": list(self.step_heights_mm),
                "base_from_ground": _pose(fixtures.base_from_ground),
            },
            "base_from_part": _pose(fixtures.base_from_part),
            "base_from_workpiece": _pose(self.base_from_workpiece),
            "base_from_waves": _pose(fixtures.base_from_waves),
            "waves": [asdict(wave) for wave in fixtures.waves.waves],
            "markers": {
                "centres_base_mm": self.marker_centres_base_mm.tolist(),
                "disc_diameter_mm": DISC_DIAMETER_MM,
                "ring_diameter_mm": RING_DIAMETER_MM,
                "base_new_from_base_old": _pose(self.moved_from_base),
            },
            "probe": {
                "tool_from_probe_mm": TRUE_PROBE_MM.tolist(),
                "tip_diameter_mm": TIP_DIAMETER_MM,
            },
            "arm": {
                "axes": arm.true.axes.tolist(),
                "points_mm": arm.true.points_mm.tolist(),
                "encoder_noise_rad": arm.white_rad,
                "encoder_waves_rad": arm.waves_rad.tolist(),
            },
        }
        if scene == "latency":
            content["latency_ns"] = latency_ns(self.seed)
        right = self.right_camera_parameters
        if right is not None and self.right_from_sensor is not None:
            content["right_camera_parameters"] = right.tolist()
            content["right_from_sensor"] = _pose(self.right_from_sensor)
        return (json.dumps(content, indent=1) + "\n").encode()


def _pose(pose: Pose[Any, Any]) -> dict[str, Any]:
    return {
        "rotation": pose.rotation.tolist(),
        "translation_mm": pose.translation_mm.tolist(),
    }


_SCENES: tuple[TwinScene, ...] = get_args(TwinScene)
_PLAN, _NOISE, _PROBING, _CLOCK = 10, 11, 12, 13
"""Streams of random numbers, besides those that the instrument is drawn from."""


def latency_ns(seed: int) -> int:
    """By how much later than it is the arm of the scene ``latency`` tells its times, in ns."""
    return round(float(np.random.default_rng([seed, _CLOCK]).uniform(-8e6, 8e6)))


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedInstrument:
    """See `armscan.devices.sources.Twin`."""

    instrument: Instrument
    preset: Preset
    seed: int

    @property
    def head(self) -> str:
        """Name of the head."""
        return self.instrument.head.name

    @property
    def target(self) -> str:
        """The calibration target as the command line names it."""
        return TARGET

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the laser sources, each switched by itself."""
        return self.instrument.head.sources

    @property
    def truth(self) -> InstrumentTruth:
        """What it was made from."""
        return InstrumentTruth(self.instrument, self.preset, self.seed)

    def scan(self, scene: TwinScene) -> TwinScan:
        """The recording of one scene; pixels are rendered when an exposure is asked for.

        Raises
        ------
        OptionError
            If there is no such scene, or if it gives no images, as ``probing``.
        """
        images = tuple(name for name in _SCENES if name != "probing")
        if scene not in images:
            raise OptionError(
                f"the twin has no images of a scene '{scene}'",
                remedy=f"choose one of: {', '.join(images)}",
            )
        number = _SCENES.index(scene)
        rng = np.random.default_rng([self.seed, _PLAN, number])
        name = f"{self.head} {self.preset} {scene}"
        noise = (self.seed, _NOISE, number)
        head = self.instrument.head
        if scene in ("camera", "laser"):
            shots_of = camera_shots if scene == "camera" else laser_shots
            shots = shots_of(head, self.instrument.target, rng)
            return TwinScan(name, "calibration", head, shots, None, noise)
        shots, track = self._with_arm(scene, rng)
        kind: SessionKind = "calibration" if scene == "hand-eye" else "scan"
        return TwinScan(name, kind, head, shots, track, noise)

    def probe_plate(self) -> PlateProbing:
        """Touch the plate of the scene ``hand-eye``."""
        rng = np.random.default_rng([self.seed, _PROBING])
        tools = self.instrument
        return probe_plate(tools.arm, tools.fixtures, tools.mechanics.probe, rng)

    def _with_arm(self, scene: TwinScene, rng: np.random.Generator) -> Recorded:
        tools = self.instrument
        if scene == "hand-eye":
            return hand_eye_scene(tools, rng)
        if scene == "still-step":
            return still_step_scene(tools, rng)
        if scene == "still-part":
            return still_part_scene(tools, rng)
        if scene == "latency":
            return latency_scene(tools, latency_ns(self.seed), rng)
        if scene in ("markers", "markers-moved"):
            return marker_scene(tools, scene == "markers-moved", rng)
        return scan_scene(tools, cast(SweptScene, scene), rng)


STROKE_NS = 1_000_000_000
"""Instants of a scene that are farther apart belong to two strokes: passes last 0.4 s a step at
most, postures are 2 s apart at least."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneStage:
    """A scene as it is gone through; ``instants`` are rows of each, one a camera."""

    scene: TwinScene
    scan: TwinScan
    instants: tuple[tuple[int, ...], ...]
    way: HandWay

    @staticmethod
    def of(twin: SimulatedInstrument, scene: TwinScene) -> SceneStage:
        """Find the way through a scene; raises as `SimulatedInstrument.scan` does."""
        scan = twin.scan(scene)
        instants: dict[tuple[int, int | None], list[int]] = {}
        for number, row in enumerate(scan.rows):
            instants.setdefault((row.t_ns, row.trigger_id), []).append(number)
        rows = tuple(tuple(found) for found in instants.values())
        strokes = [0]
        for last, this in pairwise(rows):
            a, b = scan.rows[last[0]], scan.rows[this[0]]
            is_one = b.t_ns - a.t_ns < STROKE_NS or (a.view is not None and a.view == b.view)
            strokes.append(strokes[-1] + (not is_one))
        if scan.arm is None:
            joints = np.tile(COMFORTABLE_RAD, (len(rows), 1))
        else:
            joints = _joints_rad(twin, scan, [found[0] for found in rows])
        return SceneStage(scene, scan, rows, HandWay(joints, strokes))

    def rows_lit_by(self, k: int, lasers: tuple[str, ...]) -> tuple[int, ...]:
        """Rows of an instant; of one of the same view, if the scene has one with these lasers."""
        own = self.scan.rows[self.instants[k][0]]
        if own.lasers == lasers or own.view is None:
            return self.instants[k]
        for rows in self.instants:
            other = self.scan.rows[rows[0]]
            if other.view == own.view and other.lasers == lasers:
                return rows
        return self.instants[k]


def _joints_rad(twin: SimulatedInstrument, scan: TwinScan, rows: Sequence[int]) -> FloatArray:
    """(N, 7) true joint angles with which the arm holds the head as the rows' images saw it."""
    tools = twin.instrument
    sensor_from_tool = tools.head.tool_from_sensor.inverse()
    joints = [COMFORTABLE_RAD]
    for row in rows:
        joints.append(reach(tools.arm.true, scan.true_pose(row) @ sensor_from_tool, joints[-1]))
    return np.array(joints[1:])


def build_twin(
    head: str = "thesis-single",
    preset: Preset = "thesis",
    seed: int = 1,
    part_mm: FloatArray | None = None,
) -> SimulatedInstrument:
    """Draw one instrument.

    Parameters
    ----------
    head
        Kind of the head.
    preset
        How good it is and how kind the surroundings are.
    seed
        Everything random follows from it.
    part_mm
        (T, 3, 3) triangles of a part that stands in place of the workpiece; None for the workpiece.

    Raises
    ------
    OptionError
        If there is no such head or preset, or if the seed is negative.
    """
    if head not in HEADS:
        raise OptionError(
            f"no simulated head is called '{head}'", remedy=f"choose one of: {', '.join(HEADS)}"
        )
    if preset not in get_args(Preset):
        raise OptionError(
            f"no preset is called '{preset}'",
            remedy=f"choose one of: {', '.join(get_args(Preset))}",
        )
    if seed < 0:
        raise OptionError(f"seed {seed} is negative", remedy="give 0 or more")
    return SimulatedInstrument(Instrument.build(head, preset, seed, part_mm), preset, seed)
