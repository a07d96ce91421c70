# SPDX-License-Identifier: Apache-2.0
"""A tilted plate with ring markers before two cameras, drawn, and the cameras' document."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.models.calibration import Provenance
from armscan.models.two_views import StereoCalibration
from armscan.storage.documents import stereo_document
from rigs.plain_scanner import plain_camera
from rigs.ring_scenes import Mark, render, tilted
from rigs.true_scanner import certain_camera

WIDTH, HEIGHT, FOCAL_PX = 480, 400, 1000.0
DISTANCE_MM, BASELINE_MM, RADIUS_MM = 150.0, 60.0, 3.0
PLACES = [(-18.0, -11.0), (-2.0, -14.0), (14.0, -9.0), (-12.0, 4.0), (5.0, 1.0), (16.0, 9.0)]
PLACES += [(-4.0, 13.0)]


def right_from_left() -> tuple[FloatArray, FloatArray]:
    """The right camera stands 60 mm to the right and looks at the same place."""
    turn = np.arctan2(BASELINE_MM, DISTANCE_MM)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return rotation, -rotation @ np.array([BASELINE_MM, 0.0, 0.0])


def draw_marked_plate(path: Path) -> None:
    """Write ``left.png``, ``right.png`` and ``stereo.json`` into a folder."""
    marks = [Mark("ring", x, y, RADIUS_MM, 0.5 * RADIUS_MM) for x, y in PLACES]
    plate = tilted(15.0, 40.0), np.array([0.0, 0.0, DISTANCE_MM])
    turn, shift = right_from_left()
    for name, rotation, translation in (
        ("left", *plate),
        ("right", turn @ plate[0], turn @ plate[1] + shift),
    ):
        rendered = render(marks, rotation, translation, (WIDTH, HEIGHT), focal_px=FOCAL_PX, rays=4)
        cv2.imwrite(str(path / f"{name}.png"), rendered.exposure(1).image)
    camera = plain_camera(FOCAL_PX, ((WIDTH - 1) / 2, (HEIGHT - 1) / 2), (WIDTH, HEIGHT))
    origin = Provenance(
        document_id="drawn",
        created_utc="2026-01-01T00:00:00+00:00",
        armscan_version="0",
        command=(),
        inputs=(),
    )
    calibration = certain_camera(camera, origin)
    stereo = StereoCalibration(
        left=calibration,
        right=calibration,
        right_from_left=Pose(turn, shift),
        covariance=np.zeros((24, 24)),
        rms_px=0.1,
        n_pairs=9,
        n_points=99,
        provenance=origin,
    )
    (path / "stereo.json").write_bytes(stereo_document(stereo))
