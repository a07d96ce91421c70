# SPDX-License-Identifier: Apache-2.0
"""Names, places and normals beside NumPy and OpenCV: the part ``placing`` of ``speed.py``.

One thread, seed 0, stripe points given. Pixels go to points in Base by the camera, a bowed sheet,
the hand-eye and the arm's pose; the same by `cv2.undistortPoints`, the plane's formula and a matrix
product knows no bow and no covariance. An exposure's points are kept in the spool of a scan. Pairs
are of the scenes of `multi_naming.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp
from timing import Comparison, compare

from armscan.geometry.arrays import FloatArray, homogeneous
from armscan.models.arm import forward, parameter_jacobian, thesis_arm
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
OPENCV, TREE = "OpenCV and NumPy, plane", "SciPy k-d tree, NumPy, of a plate"
SLERP = "SciPy `Slerp`, NumPy"


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


def pairs(repeats: int) -> Comparison:
    """Twelve exposures of both cameras of the thesis's head of eleven lines, a pair."""
    head = StereoHead.thesis()
    sensor = head.drawn_calibration(RNG)
    seen = []
    for kind in KINDS:
        for _ in range(3):
            left, right = expose(head, draw_surfaces(kind, RNG), Noise(), RNG)
            seen.append([left.profile, right.profile])
    labeller = StereoLabeller(sensor)
    named = [labeller.label(pair) for pair in seen]
    ways: dict[str, Callable[[], object]] = {
        "armscan: names and epipolar offset": lambda: [labeller.label(pair) for pair in seen],
        "armscan: points": lambda: [measure_points(one, sensor, LABEL_DEPTHS) for one in named],
    }
    n = sum(len(left) + len(right) for left, right in seen) / len(seen)
    work = f"a pair of images of eleven lines, {n:,.0f} stripe points"
    return compare(work, ways, repeats, parts=len(seen))


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


def rays(repeats: int) -> Comparison:
    """100,000 pixels to points in Base."""
    scanner = rig.scanner()
    placing, sensor = BaseTransform.of(scanner), rig.sensor_of(thesis_rig().camera, rig.sheets())
    pixels = RNG.uniform([200.0, 600.0], [1800.0, 800.0], (MANY, 2))
    profile, sheet = rig.profile_at(pixels), np.zeros(MANY, dtype=np.int64)
    camera, plane = sensor.camera.camera, sensor.sheets[0].sheet.plane
    base_from_sensor = rig.BASE_FROM_TOOL @ scanner.hand_eye.tool_from_sensor

    def by_opencv() -> object:
        xy = cv2.undistortPoints(pixels[:, None], camera.matrix, camera.distortion)[:, 0]
        directions = homogeneous(xy)
        points = directions * (-plane[3] / (directions @ plane[:3]))[:, None]
        return points @ base_from_sensor.rotation.T + base_from_sensor.translation_mm

    def with_covariance() -> object:
        stripe = triangulate_stripe(profile, sheet, sensor)
        return propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, placing)

    ways: dict[str, Callable[[], object]] = {
        "**armscan: places**": lambda: intersect_sheets(pixels, sheet, sensor, base_from_sensor),
        "**armscan: places and covariance**": with_covariance,
        OPENCV: by_opencv,
    }
    return compare(f"{MANY:,} pixels to places in Base", ways, repeats, usual=OPENCV)


def surfaces(repeats: int) -> Comparison:
    """Normals of 200,000 points scanned in 200 lines."""
    plate, ball = surface(is_ball=False), surface(is_ball=True)
    seen = np.tile([0.0, 0.0, 150.0], (len(plate), 1))

    def by_scipy() -> object:
        near = plate[cKDTree(plate).query(plate, 32)[1]]
        near -= near.mean(axis=1, keepdims=True)
        return np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]

    ways: dict[str, Callable[[], object]] = {
        "**armscan: of a plate**": lambda: estimate_normals(plate, seen),
        "**armscan: of a ball**": lambda: estimate_normals(ball, seen),
        TREE: by_scipy,
    }
    return compare("normals of 200,000 points", ways, repeats, usual=TREE)


def arms(repeats: int) -> Iterator[Comparison]:
    """The arm's model, and its poses at the times of exposures."""
    samples, joints = track(), RNG.uniform(-3.0, 3.0, (10_000, 7))
    times = np.sort(RNG.integers(0, int(samples.t_ns[-1]), 10_000))
    rows = [
        ExposureRow(index=k, t_ns=int(t), camera=0, source=f"{k}.png") for k, t in enumerate(times)
    ]

    def by_scipy() -> object:
        turns = Slerp(samples.t_ns, Rotation.from_matrix(samples.rotations))(times)
        places = [np.interp(times, samples.t_ns, axis) for axis in samples.translations_mm.T]
        return turns.as_matrix(), places

    at_times: dict[str, Callable[[], object]] = {
        "**armscan: with gaps, standstills, steps looked for**": lambda: exposure_poses(
            rows, samples
        ),
        SLERP: by_scipy,
    }
    yield compare("10,000 poses of 20,000 samples at given times", at_times, repeats, usual=SLERP)
    model: dict[str, Callable[[], object]] = {
        "armscan: poses": lambda: forward(ARM, joints),
        "armscan: derivatives by 28 parameters": lambda: parameter_jacobian(ARM, joints),
    }
    yield compare("10,000 poses of seven joints", model, repeats)


def placing(repeats: int) -> Iterator[Comparison]:
    """All of these."""
    base_transform = BaseTransform.of(rig.scanner())
    yield rays(repeats)
    after: dict[str, Callable[[], object]] = {
        "armscan: named, measured, placed, kept": after_stripes(base_transform)
    }
    yield compare("an exposure of 1,050 stripe points", after, repeats)
    yield pairs(repeats)
    yield surfaces(repeats)
    yield from arms(repeats)
