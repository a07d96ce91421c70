# SPDX-License-Identifier: Apache-2.0
"""Hand-eye before a grid of circles: their centres are those behind the lens, not of the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.geometry.poses import Base, Board, Pose, Sensor, Tool
from armscan.jobs import board_hand_eye
from armscan.jobs.board_hand_eye import LookSource, calibrate_hand_eye_on_board
from armscan.jobs.job import Job
from armscan.models.camera import CameraModel
from armscan.pipeline.targets import FoundTargets
from armscan.records.exposure import Exposure
from armscan.storage.documents import camera_document, read_scanner_calibration
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.target import CircleEdges, TargetView, parse_target
from rigs.board_postures import board_rig
from rigs.plain_scanner import plain_camera

TARGET, RADIUS_MM = "circle-grid:7x5:12", 4.5
CAMERA = plain_camera(600.0, (320.0, 240.0), (640, 480), (-0.3, 0.0, 0.0, 0.0, 0.0))
HAND_EYE: Pose[Tool, Sensor] = Pose(
    Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix(), np.array([20.0, -35.0, 60.0])
)
BASE_FROM_BOARD: Pose[Base, Board] = Pose(
    Rotation.from_rotvec([0.1, 2.9, 0.2]).as_matrix(), np.array([400.0, 30.0, -100.0])
)
TILTS = [(a, b, c) for a, b in ((-25, -15), (-20, 20), (25, -20), (20, 25)) for c in (-30, 40)]


def rims_of(sensor_from_board: Pose[Sensor, Board], camera: CameraModel, source: str) -> TargetView:
    """Exact rims of the circles, with the centres that the image alone gives."""
    centres = parse_target(TARGET).points_board_mm
    n, angle = len(centres), np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rim = RADIUS_MM * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    points = camera.project(sensor_from_board.apply((centres[:, None] + rim).reshape(-1, 3)))
    edges = CircleEdges(
        points_px=points, circle=np.repeat(np.arange(n), 24), sigma_px=np.full(24 * n, 0.05)
    )
    view = TargetView(
        source=source,
        width_px=camera.width_px,
        height_px=camera.height_px,
        point_index=np.arange(n),
        points_px=np.zeros((n, 2)),
        covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        points_board_mm=centres,
        edges=edges,
        is_ambiguous=True,
    )
    return correct_centres(view)


def test_the_lens_does_not_move_the_hand_eye(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of exact rims nothing is left; the image's own centres leave 0.1 px. One view folds over."""
    rows, seen = [], []
    middle = parse_target(TARGET).points_board_mm.mean(axis=0)
    for k, (tilt_x, tilt_y, turn) in enumerate(TILTS):
        spin = Rotation.from_euler("xyz", (tilt_x, tilt_y, turn), degrees=True).as_matrix()
        place = np.array([(-30.0, 30.0)[k % 2], (-15.0, 15.0)[k // 2 % 2], 160.0 + 4.0 * k])
        board: Pose[Sensor, Board] = Pose(spin, place - spin @ middle)
        held = BASE_FROM_BOARD @ board.inverse() @ HAND_EYE.inverse()
        rows.append(" ".join(map(repr, held.matrix.ravel().tolist())))
        seen.append(rims_of(board, CAMERA, f"{k:02d}.png"))
        blank = np.full((CAMERA.height_px, CAMERA.width_px), 90, dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"{k:02d}.png"), blank)
    edges = seen[3].edges
    assert edges is not None
    outside = edges.points_px.copy()
    outside[0] = 1e4
    seen[3] = replace(seen[3], edges=replace(edges, points_px=outside))

    def find_rims(exposures: Sequence[Exposure], *_: Any, **__: Any) -> FoundTargets:
        return FoundTargets(
            tuple(replace(v, source=e.source) for v, e in zip(seen, exposures, strict=True)), ()
        )

    monkeypatch.setattr(board_hand_eye, "find_targets", find_rims)
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    calibration = replace(board_rig(1, 3).camera, camera=CAMERA)
    (tmp_path / "camera.json").write_bytes(camera_document(calibration))
    source = LookSource(
        images=(str(tmp_path / "*.png"),),
        poses=tmp_path / "poses.csv",
        camera=tmp_path / "camera.json",
    )
    summary = calibrate_hand_eye_on_board(Job(tmp_path / "scanner.json"), source, TARGET)
    found = read_scanner_calibration(tmp_path / "scanner.json").hand_eye.tool_from_sensor
    assert found.translation_mm == pytest.approx(HAND_EYE.translation_mm, abs=2e-3)
    assert found.rotation == pytest.approx(HAND_EYE.rotation, abs=1e-5)
    (unused,) = (summary.extra or {})["not_used"]
    assert unused["source"] == "03.png" and "folds over" in unused["reason"]
    assert all(look["rms_px"] < 1e-3 for look in (summary.extra or {})["postures"])
