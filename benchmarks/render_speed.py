# SPDX-License-Identifier: Apache-2.0
"""Processor time of one simulated exposure and the bias of its line, by scene.

Command: ``OMP_NUM_THREADS=1 python benchmarks/render_speed.py [seeds]`` (default 3: seeds 1 to 3).

Each row is one kind of image of the head thesis-single, standing still, or moving with three poses
over the exposure; the processor time is the best of four. The bias is the mean over seeds and
columns of the light's centroid less the true centre, without speckle and sensor noise; on curved
things the light itself is lopsided (a ball of 17.5 mm: 0.016 px), so only the plate has it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from armscan.geometry.frames import Base, Board, Part, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.free_form import free_form_part
from armscan.simulation.head import Head, Window, build_head
from armscan.simulation.plate import FlatPlate
from armscan.simulation.render import Speckle
from armscan.simulation.shapes import Box, Placed
from armscan.simulation.station import (
    ExposureSettings,
    Station,
    Target,
    exposure_light,
    render_exposure,
    true_stripes,
)
from armscan.simulation.surfaces import Sphere
from armscan.simulation.thing import CERAMIC, GROUND_STEEL, Thing

REPEATS = 4
REACH_PX = 24
TARGET = CirclePattern(11, 9, 3.75, 1.875)
BOARD: Pose[Base, Board] = Pose(np.diag([1.0, -1.0, -1.0]), np.array([-18.75, 15.0, 0.0]))
PART: Pose[Base, Part] = Pose(np.eye(3), np.zeros(3))


def over(height_mm: float) -> Pose[Base, Sensor]:
    """Sensor that looks down so that its sheet passes a height over the origin."""
    turn: Pose[Base, Sensor] = Pose.from_vectors([0.1, 0.05, 0.05], np.zeros(3))
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn.rotation
    return Pose(
        rotation, np.array([0.0, 0.0, height_mm]) - rotation @ np.array([0.0, 4.158, 140.0])
    )


def plate(seed: int) -> Thing:
    flat = FlatPlate.draw((200.0, 150.0), 0.015, np.random.default_rng(seed))
    return Thing("plate", flat, CERAMIC)


def best_time_s(
    head: Head, station: Station, poses: Sequence[Pose[Base, Sensor]], settings: ExposureSettings
) -> float:
    times = []
    for seed in range(REPEATS):
        start = time.process_time()
        render_exposure(head, station, poses, settings, np.random.default_rng(seed))
        times.append(time.process_time() - start)
    return min(times)


def plate_bias_px(seeds: range) -> tuple[float, float]:
    """Mean bias over seeds, and the largest of one seed."""
    means = []
    for seed in seeds:
        head = build_head("thesis-single", "clean", seed)
        quiet = replace(head.imaging, speckle=Speckle(0.0, 0.0), ambient=0.0)
        head = replace(head, imaging=quiet)
        window = Window(600, 500, 1800, 1000)
        settings = ExposureSettings(window, ("A",))
        station = Station((plate(seed),))
        rng = np.random.default_rng(seed)
        light = exposure_light(head, station, [over(0.0)], settings, rng).astype(np.float64)
        (stripe,) = true_stripes(head, station, over(0.0), settings)
        errors = []
        for x, y in stripe.points_px - np.array([window.x_px, window.y_px]):
            rows = np.arange(round(y) - REACH_PX, round(y) + REACH_PX + 1)
            profile = light[rows, round(x)]
            errors.append(profile @ rows / profile.sum() - y)
        means.append(float(np.mean(errors)))
    return float(np.mean(means)), float(np.max(np.abs(means)))


def main() -> None:
    cv2.setNumThreads(1)
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    head = build_head()
    window, full = head.scan_window, head.full_window
    steel = Thing("block", Box(np.array([22.0, 30.0, 20.0])), GROUND_STEEL)
    ball = Thing("ball", Sphere(np.array([0.0, 0.0, 17.48]), 17.48), CERAMIC)
    scenes = {
        "plate": (Station((plate(1),)), 0.0),
        "ball": (Station((ball,)), 30.0),
        "block on plate": (Station((plate(1), steel)), 10.0),
        "free-form part": (Station((Thing("part", Placed(free_form_part(), PART)),)), 14.0),
    }
    print(f"{'image':34} still s  moving s")
    for name, (station, height) in scenes.items():
        settings = ExposureSettings(window, ("A",))
        still = best_time_s(head, station, [over(height)], settings)
        poses = [over(height + shift) for shift in (-0.05, 0.0, 0.05)]
        moving = best_time_s(head, station, poses, settings)
        print(f"{name + ', 2658x800':34} {still:7.3f} {moving:9.3f}")
    board = Station((), Target(TARGET, BOARD))
    for name, settings in (
        ("target, 3072x2048", ExposureSettings(full, room_light=0.9)),
        ("line on target, 3072x2048", ExposureSettings(full, ("A",), room_light=0.1)),
    ):
        print(f"{name:34} {best_time_s(head, board, [over(0.0)], settings):7.3f}")
    mean, largest = plate_bias_px(range(1, n_seeds + 1))
    print(f"bias on a plate, {n_seeds} seeds: mean {mean:+.4f} px, largest {largest:.4f} px")


if __name__ == "__main__":
    main()
