# SPDX-License-Identifier: Apache-2.0
"""Time that placing a scan takes, besides extracting its stripes.

Command: ``OMP_NUM_THREADS=1 python benchmarks/scan_speed.py [repeats]`` (default 15; seed 0).

Median milliseconds of processor time over the repeats, one thread; beside work on many points the
millions of them a second:

- *triangulate*: 3000 stripe points of one exposure, with the derivatives of their covariance;
- *place*: the same points in Base with full covariance;
- *an exposure after its stripes*: 1050 of them named, measured, placed and kept in the spool of a
  scan, one sheet, one camera;
- *poses*: 2000 exposures looked up by time among 20,000 samples of the arm;
- *naming*, *points of pairs*: twelve exposures of the thesis's head of eleven lines (the scenes of
  `multi_naming.py`), each of both cameras: names and epipolar offset, then points; a pair;
- *undistort, sheet, pose*: 100,000 pixels to points in Base without covariance; *with covariance*:
  triangulate and place; *NumPy and OpenCV*: the same without covariance by
  `cv2.undistortPoints`, the plane's formula and a matrix product, which knows no bow;
- *normals*: 200,000 points of a plate, and of a ball, scanned in 200 lines;
- *arm forward*, *arm Jacobian*: 10,000 joint vectors of seven axes; Jacobian by 28 parameters.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, homogeneous
from armscan.models.arm import forward, parameter_jacobian, thesis_arm
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.scan import scan_spool
from armscan.reconstruction.label_stereo import StereoLabeller
from armscan.reconstruction.labels import SingleLabeller
from armscan.reconstruction.place import BaseTransform, estimate_normals, propagate_to_base
from armscan.reconstruction.points import measure_points
from armscan.reconstruction.sync import exposure_poses
from armscan.reconstruction.triangulate import (
    LABEL_DEPTHS,
    DepthRange,
    intersect_sheets,
    triangulate_stripe,
)
from armscan.records.recording import ArmTrack, ExposureRow
from rigs import placing_rig as rig
from rigs.sheet_rig import thesis_rig
from rigs.stereo_head import StereoHead
from rigs.stereo_scenes import KINDS, Noise, draw_surfaces, expose

ARM = thesis_arm((300.0, 600.0, 500.0, 200.0), (40.0, 40.0, 40.0))
RNG = np.random.default_rng(0)
MANY = 100_000


def median_ms(work: Callable[[], object], repeats: int) -> float:
    """Median time of a piece of work, after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def surface(is_ball: bool) -> FloatArray:
    """200,000 points in 200 lines on a plate or on a ball's cap."""
    x, y = np.meshgrid(np.linspace(-12.0, 12.0, 1000), np.linspace(-12.0, 12.0, 200))
    z = np.sqrt(17.48**2 - x**2 - y**2) if is_ball else np.zeros_like(x)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return np.asarray(points + RNG.normal(0.0, 0.01, points.shape))


def track(n: int = 20_000) -> ArmTrack:
    """A moving arm, 1000 samples a second."""
    joints = RNG.uniform(-1.0, 1.0, 7) + 1e-4 * np.cumsum(RNG.normal(size=(n, 7)), axis=0)
    rotations, translations = forward(ARM, joints)
    return ArmTrack(
        t_ns=np.arange(n) * 1_000_000,
        rotations=rotations,
        translations_mm=translations,
        is_known=np.ones(n, dtype=bool),
    )


Row = tuple[str, Callable[[], object], int, int]


def pair_rows(repeats: int) -> list[Row]:
    """Exposures of two cameras: name, work, repeats, and count of pairs."""
    head = StereoHead.thesis()
    sensor = head.drawn_calibration(RNG)
    pairs = []
    for kind in KINDS:
        for _ in range(3):
            left, right = expose(head, draw_surfaces(kind, RNG), Noise(), RNG)
            pairs.append([left.profile, right.profile])
    labeller = StereoLabeller(sensor)
    named = [labeller.label(pair) for pair in pairs]
    return [
        ("naming, a pair", lambda: [labeller.label(pair) for pair in pairs], repeats, len(pairs)),
        (
            "points of pairs, a pair",
            lambda: [measure_points(one, sensor, LABEL_DEPTHS) for one in named],
            repeats,
            len(pairs),
        ),
    ]


def after_stripes(placing: BaseTransform) -> Callable[[], object]:
    """Everything that a scan does with one exposure of 1050 points once they are extracted."""
    scanner, depths = placing.scanner, DepthRange(20.0)
    sensor = scanner.sensor
    if sensor is None:
        raise SystemExit("the rig has a camera")
    pixels = np.stack([np.linspace(200.0, 1800.0, 1050), np.full(1050, 700.0)], axis=1)
    profile, labeller = rig.profile_at(pixels), SingleLabeller(sensor, depths, "A")

    def work() -> object:
        # one exposure a spool, so that none grows
        spool = scan_spool(scanner)
        (measured,) = measure_points(labeller.label([profile]), sensor, depths)
        cloud = propagate_to_base(measured.points, profile, rig.BASE_FROM_TOOL, placing)
        spool.add(cloud, profile.points_px[measured.points.row], instant=0)
        return spool

    return work


def ray_rows(sensor: SensorCalibration, placing: BaseTransform, repeats: int) -> list[Row]:
    """Pixels to Base: name, work, repeats, and 0: the work is one."""
    pixels = RNG.uniform([200.0, 600.0], [1800.0, 800.0], (MANY, 2))
    profile, sheet = rig.profile_at(pixels), np.zeros(MANY, dtype=np.int64)
    camera, plane = sensor.camera.camera, sensor.sheets[0].sheet.plane
    base_from_sensor = rig.BASE_FROM_TOOL @ placing.scanner.hand_eye.tool_from_sensor

    def by_opencv() -> object:
        xy = cv2.undistortPoints(pixels[:, None], camera.matrix, camera.distortion)[:, 0]
        rays = homogeneous(xy)
        points = rays * (-plane[3] / (rays @ plane[:3]))[:, None]
        return points @ base_from_sensor.rotation.T + base_from_sensor.translation_mm

    def with_covariance() -> object:
        stripe = triangulate_stripe(profile, sheet, sensor)
        return propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, placing)

    return [
        (
            "undistort, sheet, pose",
            lambda: intersect_sheets(pixels, sheet, sensor, base_from_sensor),
            repeats,
            0,
        ),
        ("NumPy and OpenCV", by_opencv, repeats, 0),
        ("with covariance", with_covariance, repeats, 0),
    ]


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    scanner = rig.scanner()
    placing = BaseTransform.of(scanner)
    sensor = rig.sensor_of(thesis_rig().camera, rig.sheets())
    pixels = np.stack([np.linspace(200.0, 1800.0, 3000), np.full(3000, 700.0)], axis=1)
    profile, sheet = rig.profile_at(pixels), np.zeros(3000, dtype=np.int64)
    stripe = triangulate_stripe(profile, sheet, sensor)
    samples = track()
    times = np.sort(RNG.integers(0, int(samples.t_ns[-1]), 2000))
    rows = [
        ExposureRow(index=k, t_ns=int(t), camera=0, source=f"{k}.png") for k, t in enumerate(times)
    ]
    joints = RNG.uniform(-3.0, 3.0, (10_000, 7))
    plate, ball = surface(is_ball=False), surface(is_ball=True)
    seen = np.tile([0.0, 0.0, 150.0], (len(plate), 1))
    few = max(1, repeats // 5)
    table: list[tuple[str, Callable[[], object], int]] = [
        ("triangulate 3000", lambda: triangulate_stripe(profile, sheet, sensor), repeats),
        (
            "place 3000",
            lambda: propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, placing),
            repeats,
        ),
        ("after stripes 1050", after_stripes(placing), repeats),
        ("poses 2000", lambda: exposure_poses(rows, samples), repeats),
        ("normals 200,000 plate", lambda: estimate_normals(plate, seen), few),
        ("normals 200,000 ball", lambda: estimate_normals(ball, seen), few),
        ("arm forward 10,000", lambda: forward(ARM, joints), repeats),
        ("arm Jacobian 10,000", lambda: parameter_jacobian(ARM, joints), few),
    ]
    for name, work, count in table:
        print(f"{name:24} {median_ms(work, count):10.2f} ms")
    for name, work, count, n_pairs in pair_rows(few):
        print(f"{name:24} {median_ms(work, count) / n_pairs:10.2f} ms")
    for name, work, count, _ in ray_rows(sensor, placing, repeats):
        taken = median_ms(work, count)
        print(f"{name:24} {taken:10.2f} ms {1e-3 * MANY / taken:7.2f} million/s")


if __name__ == "__main__":
    main()
