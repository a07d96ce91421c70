# SPDX-License-Identifier: Apache-2.0
"""The truth of a rendered photo set: kept beside the images, never inside them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import OutputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.body import Body
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera
from armscan.simulation.stripe_truth import StripeTruth


@dataclass(frozen=True, slots=True, eq=False)
class PhotoSetTruth:
    """What the photographs were rendered from.

    Parameters
    ----------
    seed
        Seed of placement and noise.
    target
        The board, as the command line names it.
    camera
        The simulator's camera.
    laser
        The simulator's laser; its sheet is a cone, not a plane.
    camera_boards
        Where the board was in each camera photo.
    laser_boards, laser_stripes
        Where it was in each laser photo, and the true stripes.
    body, body_stripe
        The object and its true stripe.
    """

    seed: int
    target: str
    camera: RenderCamera
    laser: LineLaser
    camera_boards: tuple[Pose[Sensor, Board], ...]
    laser_boards: tuple[Pose[Sensor, Board], ...]
    laser_stripes: tuple[StripeTruth, ...]
    body: Body
    body_stripe: StripeTruth

    @property
    def camera_parameters(self) -> FloatArray:
        """(9,) ``fx fy cx cy`` in px and ``k1 k2 p1 p2 k3``."""
        c = self.camera
        return np.array([c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3])

    @property
    def sheet_points_mm(self) -> FloatArray:
        """(N, 3) true points of the sheet in the Sensor frame: all laser stripes on the board."""
        return np.concatenate([s.points_mm[s.surface == 0] for s in self.laser_stripes])

    def sheet_offset_mm(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) from the true sheet."""
        return self.laser.offset_mm(np.asarray(points_sensor_mm, dtype=np.float64))

    def object_distance_mm(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) from the object's true surface."""
        return self.body.distance_mm(np.asarray(points_sensor_mm, dtype=np.float64))

    def object_normals(self, points_sensor_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of the object's true surface next to points (N, 3)."""
        return self.body.normals(np.asarray(points_sensor_mm, dtype=np.float64))


def write_truth(path: Path, truth: PhotoSetTruth) -> None:
    """Write the truth as JSON, whole or not at all.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_whole(path, json.dumps(_document(truth), indent=1).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it.

    Raises
    ------
    OutputError
        If the folder or the file cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror or error}",
            where=str(path),
            remedy="choose a folder that can be written",
        ) from error


def _document(truth: PhotoSetTruth) -> dict[str, Any]:
    laser = truth.laser
    return {
        "simulated": True,
        "note": "The truth of the rendered photographs beside this file; no program may read it "
        "before it has measured.",
        "seed": truth.seed,
        "target": truth.target,
        "camera": asdict(truth.camera),
        "laser": {
            "name": laser.name,
            "source_sensor_mm": laser.source_mm.tolist(),
            "forward": laser.forward.tolist(),
            "across": laser.across.tolist(),
            "skew_rad": laser.skew_rad,
        },
        "camera_photos": [_pose(pose) for pose in truth.camera_boards],
        "laser_photos": [
            {**_pose(pose), **_stripe(stripe)}
            for pose, stripe in zip(truth.laser_boards, truth.laser_stripes, strict=True)
        ],
        "object": {
            **_pose(truth.body.sensor_from_part),
            "limbs": [asdict(limb) for limb in truth.body.limbs],
            **_stripe(truth.body_stripe),
        },
    }


def _pose(pose: Pose[Any, Any]) -> dict[str, Any]:
    return {
        "sensor_from_object": {
            "rotation": pose.rotation.tolist(),
            "translation_mm": pose.translation_mm.tolist(),
        }
    }


def _stripe(stripe: StripeTruth) -> dict[str, Any]:
    return {
        "stripe_px": np.round(stripe.points_px, 4).tolist(),
        "stripe_sensor_mm": np.round(stripe.points_mm, 5).tolist(),
    }
