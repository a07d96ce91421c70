# SPDX-License-Identifier: Apache-2.0
"""A small scan of the plane Z = 0 of Base, drawn without the simulator: a line on dark ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armscan.devices.sources import ScanSource
from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.models.calibration import (
    ScannerCalibration,
    SensorCalibration,
)
from armscan.models.light_sheet import LightSheet
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session
from rigs.plain_scanner import plain_camera, stored_hand_eye, stored_sheet
from rigs.sheet_rig import PROVENANCE, THESIS_PLANE
from rigs.true_scanner import certain_camera

CAMERA = plain_camera(600.0, (160.0, 120.0), (320, 240))
TOOL_FROM_SENSOR: Pose[Tool, Sensor] = Pose.from_vectors([0.0, 0.0, 0.7], [41.0, 20.0, 110.0])
PEAK, LINE_SIGMA_PX, GREY_NOISE = 180.0, 2.5, 2.0
PERIOD_NS = 10_000_000


def scanner(latency_ns: int = 0) -> ScannerCalibration:
    """A pinhole camera and the thesis's printed sheet."""
    normal = THESIS_PLANE[:3] / np.linalg.norm(THESIS_PLANE[:3])
    along = np.cross(normal, [0.0, 0.0, 1.0])
    along /= np.linalg.norm(along)
    axes = np.stack([along, np.cross(normal, along), normal])
    sheet = LightSheet(
        origin_mm=np.array([0.0, 0.0, THESIS_PLANE[3] / 0.67742]),
        axes=axes,
        scale_mm=20.0,
        bow_mm=np.zeros(5),
    )
    camera = certain_camera(CAMERA, PROVENANCE)
    sheets = (stored_sheet("A", sheet, (115.0, 160.0)),)
    hand_eye = stored_hand_eye(TOOL_FROM_SENSOR)
    sensor = SensorCalibration(
        camera=camera, sheets=sheets, covariance=np.zeros((17, 17)), provenance=PROVENANCE
    )
    return ScannerCalibration(
        sensor=sensor, hand_eye=hand_eye, provenance=PROVENANCE, latency_ns=latency_ns
    )


def looking_down(y_mm: float, tilt_rad: float = 0.15) -> Pose[Base, Tool]:
    """The tool with its camera 135 mm above the plane Z = 0 and the sheet near (0, y, 0)."""
    down: Pose[Base, Sensor] = Pose.from_vectors([np.pi - tilt_rad, 0.0, 0.0], [0.0, 0.0, 0.0])
    forward = down.rotation[:, 2] / -down.rotation[2, 2]
    base_from_sensor: Pose[Base, Sensor] = Pose(
        down.rotation, np.array([0.0, y_mm, 0.0]) - 135.0 * forward
    )
    return base_from_sensor @ TOOL_FROM_SENSOR.inverse()


def line_image(base_from_tool: Pose[Base, Tool], rng: np.random.Generator) -> FloatArray:
    """Where the sheet meets Z = 0, imaged by the pinhole: column by column, in float64."""
    base_from_sensor = base_from_tool @ TOOL_FROM_SENSOR
    up = base_from_sensor.rotation.T @ [0.0, 0.0, 1.0]
    height = base_from_sensor.translation_mm[2]
    columns = np.arange(CAMERA.width_px)
    x = (columns - CAMERA.cx_px) / CAMERA.fx_px
    # Both planes hold for p = Z (x, y, 1): eliminate Z, linear in y.
    a, b, c, d = THESIS_PLANE
    y = (d * (up[0] * x + up[2]) - height * (a * x + c)) / (height * b - d * up[1])
    v = CAMERA.cy_px + CAMERA.fy_px * y
    rows = np.arange(CAMERA.height_px)[:, None]
    line = PEAK * np.exp(-0.5 * ((rows - v) / LINE_SIGMA_PX) ** 2)
    return np.asarray(10.0 + line + rng.normal(0.0, GREY_NOISE, line.shape))


@dataclass
class FakeScan:
    """A source whose images are drawn when asked for; ``broken`` rows cannot be read."""

    rows: tuple[ExposureRow, ...]
    arm: ArmTrack | None
    truth: tuple[Pose[Base, Tool], ...]
    session: Session = field(default_factory=Session)
    broken: tuple[int, ...] = ()
    lit: bool = True
    name: str = "fake"
    is_simulated: bool = False
    reads: list[int] = field(default_factory=list)

    def exposure(self, row: int) -> Exposure:
        """Draw it."""
        self.reads.append(row)
        entry = self.rows[row]
        if row in self.broken:
            raise FileFormatError("the image is cut short", where=entry.source)
        rng = np.random.default_rng(row)
        is_lit = bool(entry.lasers) or not any(other.lasers for other in self.rows)
        grey = (
            line_image(self.truth[row], rng)
            if is_lit
            else 10.0 + rng.normal(0.0, GREY_NOISE, (CAMERA.height_px, CAMERA.width_px))
        )
        image = np.clip(np.round(grey), 0, 255).astype(np.uint8)
        return Exposure(image, entry.source, lasers=entry.lasers, t_ns=entry.t_ns)


def fake_scan(n: int = 6, step_mm: float = 1.0) -> FakeScan:
    """A sweep along y, across the stripe, at even speed.

    Each exposure lies half way between two samples of the arm.
    """
    truth = tuple(looking_down(step_mm * k) for k in range(n))
    samples = [looking_down(step_mm * (k - 0.5)) for k in range(n + 1)]
    track = ArmTrack(
        t_ns=1_000_000_000 + np.arange(n + 1) * PERIOD_NS,
        rotations=np.array([pose.rotation for pose in samples]),
        translations_mm=np.array([pose.translation_mm for pose in samples]),
        is_known=np.ones(n + 1, dtype=bool),
    )
    rows = tuple(
        ExposureRow(
            index=k,
            t_ns=int(track.t_ns[k]) + PERIOD_NS // 2,
            camera=0,
            source=f"images/{k}.png",
            lasers=("A",),
        )
        for k in range(n)
    )
    return FakeScan(rows, track, truth)


def with_rows(scan: FakeScan, changes: Sequence[dict[str, object]]) -> FakeScan:
    """The scan with fields of its rows replaced, row by row."""
    rows = tuple(replace(row, **change) for row, change in zip(scan.rows, changes, strict=True))
    return replace(scan, rows=rows)


def as_source(scan: FakeScan) -> ScanSource:
    """The type checker's word that the fake is a source."""
    return scan
