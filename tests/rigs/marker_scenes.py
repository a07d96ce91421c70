# SPDX-License-Identifier: Apache-2.0
"""Random markers on parts, seen twice with noise, losses and strays; walks along a strip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Frame, Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.records.points import MarkerSet

NOISE_MM = 0.02
LEAST_GAP_MM = 8.0
"""Rings of 6 mm do not overlap."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """Two sets of markers of one part; equal numbers in ``true_a`` and ``true_b`` are one marker.

    ``a_from_b`` is the truth.
    """

    a: MarkerSet
    b: MarkerSet
    true_a: IntArray
    true_b: IntArray
    a_from_b: Pose[Frame, Frame]

    def n_wrong(self, pairs: IntArray) -> int:
        """Count of pairs that are not one marker."""
        return int((self.true_a[pairs[:, 0]] != self.true_b[pairs[:, 1]]).sum())


def marker_set(points_mm: FloatArray, sigma_mm: float = NOISE_MM, frame: str = "Base") -> MarkerSet:
    n = len(points_mm)
    covariance = np.tile(sigma_mm**2 * np.eye(3), (n, 1, 1))
    return MarkerSet(
        ids=np.arange(1, n + 1), points_mm=points_mm, covariance_mm2=covariance, frame=frame
    )


def scattered(
    generator: np.random.Generator, n: int, size_mm: FloatArray, gap_mm: float = LEAST_GAP_MM
) -> FloatArray:
    """(n, 3) points in a box, none nearer to another than ``gap_mm``."""
    found = np.zeros((0, 3))
    while len(found) < n:
        point = generator.uniform(-0.5, 0.5, 3) * size_mm
        if not len(found) or np.linalg.norm(found - point, axis=1).min() > gap_mm:
            found = np.vstack([found, point])
    return found


def random_pose(generator: np.random.Generator) -> Pose[Frame, Frame]:
    return Pose(rotation_from_vector(generator.normal(size=3)), generator.normal(size=3) * 300.0)


def two_views(
    generator: np.random.Generator,
    n_common: int,
    size_mm: FloatArray,
    *,
    missing: float = 0.3,
    extra: float = 0.2,
    noise_mm: float = NOISE_MM,
    gap_mm: float = LEAST_GAP_MM,
) -> TwoViews:
    """Markers of which each view misses a share, and has a share that is none of the part's."""
    n_all = int(np.ceil(n_common / (1.0 - missing)))
    n_lost, n_extra = n_all - n_common, round(extra * n_all)
    points = scattered(generator, n_common + 2 * (n_lost + n_extra), size_mm, gap_mm)
    split = n_common + n_lost + n_extra
    in_a = generator.permutation(split)
    in_b = generator.permutation(np.r_[0:n_common, split : len(points)])
    a_from_b = random_pose(generator)
    b_from_a = a_from_b.inverse()
    seen_a = points[in_a] + generator.normal(0.0, noise_mm, (len(in_a), 3))
    carried = points[in_b] @ b_from_a.rotation.T + b_from_a.translation_mm
    seen_b = carried + generator.normal(0.0, noise_mm, (len(in_b), 3))
    return TwoViews(marker_set(seen_a), marker_set(seen_b), in_a, in_b, a_from_b)


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """Views along a strip: markers in Sensor, true ``part_from_sensor``, true numbers."""

    views: tuple[MarkerSet, ...]
    part_from_sensor: tuple[Pose[Frame, Frame], ...]
    true: tuple[IntArray, ...]
    points_mm: FloatArray


FIELD_MM = (80.0, 55.0)
"""What the thesis's full sensor sees at 140 mm."""
DISTANCE_MM = 140.0


def walk(
    generator: np.random.Generator,
    n_views: int,
    *,
    step_mm: float = 40.0,
    pitch_mm: float = 15.0,
    seen: float = 0.9,
    noise_mm: float = NOISE_MM,
    around_mm: float | None = None,
) -> Walk:
    """Views side by side along a strip, or around a drum of the radius ``around_mm``."""
    length = step_mm * (n_views if around_mm else n_views - 1) + (0.0 if around_mm else FIELD_MM[0])
    count = round(1.3 * length * FIELD_MM[1] / pitch_mm**2)
    flat = scattered(generator, count, np.array([length, 1.3 * FIELD_MM[1], 10.0]), 7.0)
    along = np.arange(n_views) * step_mm - (length - FIELD_MM[0]) / 2.0
    views, poses, numbers = [], [], []
    for centre in along:
        apart = flat[:, 0] - centre
        if around_mm:
            apart = (apart + length / 2.0) % length - length / 2.0
        inside = (np.abs(apart) < FIELD_MM[0] / 2) & (np.abs(flat[:, 1]) < FIELD_MM[1] / 2)
        near = np.flatnonzero(inside & (generator.random(count) < seen))
        pose = _sensor_pose(generator, float(centre), length, around_mm)
        points = _bent(flat, length, around_mm)[near]
        b_from_a = pose.inverse()
        q = points @ b_from_a.rotation.T + b_from_a.translation_mm
        q = q + generator.normal(0.0, noise_mm, q.shape)
        views.append(marker_set(q, noise_mm, "Sensor"))
        poses.append(pose)
        numbers.append(near)
    return Walk(tuple(views), tuple(poses), tuple(numbers), _bent(flat, length, around_mm))


def _bent(flat: FloatArray, length: float, around_mm: float | None) -> FloatArray:
    if not around_mm:
        return flat
    angle = 2.0 * np.pi * flat[:, 0] / length
    radius = around_mm + flat[:, 2]
    return np.stack([radius * np.sin(angle), flat[:, 1], radius * np.cos(angle)], axis=1)


def _sensor_pose(
    generator: np.random.Generator, centre: float, length: float, around_mm: float | None
) -> Pose[Frame, Frame]:
    """A sensor that looks at the strip from ``DISTANCE_MM``, tilted a little by the hand."""
    tilt = rotation_from_vector(generator.normal(size=3) * np.array([0.1, 0.1, 0.3]))
    looking = np.diag([1.0, -1.0, -1.0])
    if around_mm:
        turn = rotation_from_vector(np.array([0.0, 2.0 * np.pi * centre / length, 0.0]))
        target = turn @ np.array([0.0, 0.0, around_mm])
        rotation = turn @ tilt @ looking
    else:
        target, rotation = np.array([centre, 0.0, 0.0]), tilt @ looking
    return Pose(rotation, target - rotation @ np.array([0.0, 0.0, DISTANCE_MM]))
