# SPDX-License-Identifier: Apache-2.0
"""What a twin was made from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from armscan.devices.twin import Preset
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, CameraRight, Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.simulation.head import RIGHT
from armscan.simulation.instrument import Instrument
from armscan.simulation.optics import RenderCamera
from armscan.simulation.plate_probing import TIP_DIAMETER_MM, TRUE_PROBE_MM
from armscan.simulation.ring_markers import DISC_DIAMETER_MM, RING_DIAMETER_MM
from armscan.simulation.sheet_middle import sheet_points_mm
from armscan.simulation.stations import BALL_DIAMETER_MM, STEP_HEIGHTS_MM


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentTruth:
    """See `armscan.devices.twin.TwinTruth`.

    Parameters
    ----------
    instrument
        The twin's.
    preset, seed
        What it was drawn from.
    """

    instrument: Instrument
    preset: Preset
    seed: int

    @property
    def camera_parameters(self) -> FloatArray:
        """(9,) ``fx fy cx cy`` in px and ``k1 k2 p1 p2 k3``."""
        return _parameters(self.instrument.head.camera)

    @property
    def right_camera_parameters(self) -> FloatArray | None:
        """(9,) the same of the right camera; None for a head of one camera."""
        cameras = self.instrument.head.cameras
        return _parameters(cameras[RIGHT].camera) if len(cameras) > RIGHT else None

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
        return self.instrument.bench.plate_plane

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
        return self.instrument.bench.marker_centres_mm()

    @property
    def moved_from_base(self) -> Pose[Base, Base]:
        """From Base to the Base of the scene ``markers-moved``."""
        return self.instrument.bench.moved_from_base

    def part_distance_mm(self, points_base_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) in Base from the free-form part's surface."""
        return self.instrument.bench.part_distance_mm(points_base_mm)

    def part_normals(self, points_base_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of that surface next to points (N, 3)."""
        return self.instrument.bench.part_normals(points_base_mm)

    def document(self) -> bytes:
        """All of it as JSON, with the mark ``"simulated": true``."""
        arm, bench, head = self.instrument.arm, self.instrument.bench, self.instrument.head
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
            "base_from_plate": _pose(bench.base_from_plate),
            "ball": {
                "diameter_mm": self.ball_diameter_mm,
                "centre_base_mm": bench.ball.centre_mm.tolist(),
            },
            "steps": {
                "heights_mm": list(self.step_heights_mm),
                "base_from_ground": _pose(bench.base_from_ground),
            },
            "base_from_part": _pose(bench.base_from_part),
            "base_from_waves": _pose(bench.base_from_waves),
            "waves": [asdict(wave) for wave in bench.waves.waves],
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
        right = self.right_camera_parameters
        if right is not None and self.right_from_sensor is not None:
            content["right_camera_parameters"] = right.tolist()
            content["right_from_sensor"] = _pose(self.right_from_sensor)
        return (json.dumps(content, indent=1) + "\n").encode()


def _parameters(camera: RenderCamera) -> FloatArray:
    c = camera
    return np.array([c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3])


def _pose(pose: Pose[Any, Any]) -> dict[str, Any]:
    return {
        "rotation": pose.rotation.tolist(),
        "translation_mm": pose.translation_mm.tolist(),
    }
