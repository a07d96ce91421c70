# SPDX-License-Identifier: Apache-2.0
"""Processor time of one simulated exposure and the bias of its line, by scene.

Command: ``OMP_NUM_THREADS=1 python benchmarks/render_speed.py [seeds [heads]]``
(default 3: seeds 1 to 3; all heads).

Each row is one kind of image of one head with all its lasers on, standing still, or moving with
three poses over the exposure; the processor time is the best of four, and for two cameras the sum
of both. The bias is the mean over seeds and lines of the light's centroid less the true centre,
counted across the line, without speckle, stray light and sensor noise; on curved things the light
itself is lopsided (a ball of 17.5 mm: 0.016 px), so only the plate has it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Board, Part, Plate, Pose, Sensor
from armscan.simulation.head import HEADS, Head, Window, build_head, sheet_middle_mm
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.body import free_form_part
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed
from armscan.simulation.optics.render import Speckle
from armscan.simulation.optics.scene import CERAMIC, GROUND_STEEL, SceneObject, Sphere
from armscan.simulation.station import (
    ExposureSettings,
    Station,
    Target,
    exposure_light,
    render_exposure,
    true_stripes,
)

REPEATS = 4
REACH_PX = 30
LEAST_POINTS = 100
TARGET = CirclePattern(11, 9, 3.75, 1.875)
BOARD: Pose[Base, Board] = Pose(np.diag([1.0, -1.0, -1.0]), np.array([-18.75, 15.0, 0.0]))
LYING: Pose[Base, Plate] = Pose(np.eye(3), np.zeros(3))
PART: Pose[Base, Part] = Pose(np.eye(3), np.zeros(3))


def over(head: Head, height_mm: float) -> Pose[Base, Sensor]:
    """The whole head looks down, a little tilted; its sheets pass a height over the origin."""
    aim = sheet_middle_mm(head, 140.0)
    places = [camera.camera_from_sensor.inverse().translation_mm for camera in head.cameras]
    z = np.array([0.0, 0.0, 140.0]) - np.mean(places, axis=0)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    turn: Pose[Base, Base] = Pose.from_vectors([0.1, 0.05, 0.05], np.zeros(3))
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn.rotation @ np.stack([x, np.cross(z, x), z])
    return Pose(rotation, np.array([0.0, 0.0, height_mm]) - rotation @ aim)


def plate(seed: int) -> SceneObject:
    flat = FlatPlate.draw((200.0, 150.0), 0.015, np.random.default_rng(seed))
    return SceneObject("plate", flat, CERAMIC)


def best_time_s(
    head: Head, station: Station, poses: Sequence[Pose[Base, Sensor]], settings: ExposureSettings
) -> float:
    """Of one exposure with every camera of the head."""
    times = []
    for seed in range(REPEATS):
        start = time.process_time()
        for camera in range(len(head.cameras)):
            rng = np.random.default_rng(seed)
            render_exposure(head, station, poses, settings, rng, camera=camera)
        times.append(time.process_time() - start)
    return min(times)


def quiet(head: Head) -> Head:
    imaging = replace(head.imaging, speckle=Speckle(0.0, 0.0), ambient=0.0)
    return replace(head, imaging=replace(imaging, spot_level=0.0, stray_share=0.0))


def line_bias_px(light: FloatArray, points_px: FloatArray) -> float:
    """Mean centroid less truth across the line; profiles along the columns or rows of the truth."""
    on_columns = np.abs(points_px[:, 0] - np.rint(points_px[:, 0])).max() < 1e-6
    image, points = (light, points_px) if on_columns else (light.T, points_px[:, ::-1])
    errors = []
    for x, y in points:
        rows = np.arange(round(y) - REACH_PX, round(y) + REACH_PX + 1)
        if rows[0] >= 0 and rows[-1] < len(image):
            profile = image[rows, round(x)]
            errors.append(profile @ rows / profile.sum() - y)
    slope = np.polyfit(points[:, 0], points[:, 1], 1)[0] if len(points) > 1 else 0.0
    across = float(np.mean(errors) / np.hypot(1.0, slope)) if errors else np.nan
    return across if len(errors) >= LEAST_POINTS else np.nan


def plate_bias_px(name: str, seeds: range) -> tuple[float, float]:
    """Mean bias over seeds, cameras and lines, and the largest of one line."""
    biases = []
    for seed in seeds:
        head = quiet(build_head(name, "clean", seed))
        settings = ExposureSettings(Window(600, 500, 1800, 1000), head.sources)
        station, pose = Station((plate(seed),)), over(head, 0.0)
        for camera in range(len(head.cameras)):
            for source in head.sources:
                alone = replace(settings, lasers=(source,))
                rng = np.random.default_rng(seed)
                light = exposure_light(head, station, [pose], alone, rng, camera=camera)
                for stripe in true_stripes(head, station, pose, alone, camera=camera):
                    if len(stripe.points_px):
                        points = stripe.points_px - np.array([600, 500])
                        biases.append(line_bias_px(light.astype(np.float64), points))
    return float(np.nanmean(biases)), float(np.nanmax(np.abs(biases)))


def time_head(name: str) -> None:
    head = build_head(name)
    window, full = head.scan_window, head.full_window
    steel = SceneObject("block", Box(np.array([22.0, 30.0, 5.0])), GROUND_STEEL)
    ground = SceneObject("ground", Placed(plate(2).surface, LYING), GROUND_STEEL)
    ball = SceneObject("ball", Sphere(np.array([0.0, 0.0, 17.48]), 17.48), CERAMIC)
    scenes = {
        "plate": (Station((plate(1),)), 0.0),
        "ball": (Station((ball,)), 30.0),
        "block on steel": (Station((ground, steel)), 3.0),
        "free-form part": (Station((SceneObject("part", Placed(free_form_part(), PART)),)), 14.0),
    }
    for scene, (station, height) in scenes.items():
        settings = ExposureSettings(window, head.sources)
        still = best_time_s(head, station, [over(head, height)], settings)
        poses = [over(head, height + shift) for shift in (-0.05, 0.0, 0.05)]
        moving = best_time_s(head, station, poses, settings)
        print(f"{name:15} {scene + ', 2658x800':26} {still:7.3f} {moving:9.3f}")
    board = Station((), Target(TARGET, BOARD))
    for scene, settings in (
        ("target, 3072x2048", ExposureSettings(full, room_light=0.9)),
        ("lines on it, 3072x2048", ExposureSettings(full, head.sources, room_light=0.1)),
    ):
        print(f"{name:15} {scene:26} {best_time_s(head, board, [over(head, 0.0)], settings):7.3f}")


def main() -> None:
    cv2.setNumThreads(1)
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    heads = sys.argv[2:] or list(HEADS)
    print(f"{'head':15} {'image':26} still s  moving s")
    for name in heads:
        time_head(name)
    for name in heads:
        mean, largest = plate_bias_px(name, range(1, n_seeds + 1))
        print(
            f"{name}: bias of lines on a plate, {n_seeds} seeds: mean {mean:+.4f} px, "
            f"largest of a line {largest:.4f} px"
        )


if __name__ == "__main__":
    main()
