# SPDX-License-Identifier: Apache-2.0
"""The common plane of straight stripes on several boards, and how far they miss it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.sightings import Sighting
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Plane, fit_plane

ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class PosedSighting:
    """A stripe with the covariance of its board's pose (6, 6) and of the camera (9, 9)."""

    sighting: Sighting
    pose_covariance: FloatArray
    camera_covariance: FloatArray

    def own_covariance_mm2(self, normal: FloatArray) -> FloatArray:
        """(2, 2) covariance of the ends along ``normal`` by the board's pose and stripe noise."""
        by_pose = np.einsum("i,eij->ej", normal, self.sighting.ends_by_pose)
        noise = self.sighting.noise_ends_mm2 * float(self.sighting.across @ normal) ** 2
        return np.asarray(by_pose @ self.pose_covariance @ by_pose.T + noise)

    def by_camera(self, normal: FloatArray) -> FloatArray:
        """(2, 9) derivative of the ends along ``normal`` by the camera."""
        return np.asarray(np.einsum("i,eij->ej", normal, self.sighting.ends_by_camera))

    def height_covariance_mm2(self, normal: FloatArray) -> FloatArray:
        """(2, 2) covariance of the ends along ``normal``, the camera's error included."""
        by_camera = self.by_camera(normal)
        return np.asarray(
            self.own_covariance_mm2(normal) + by_camera @ self.camera_covariance @ by_camera.T
        )


@dataclass(frozen=True, slots=True, eq=False)
class CommonPlane:
    """Plane through the ends of L stripes, each weighted by its covariance.

    Parameters
    ----------
    plane
        The plane.
    chi2
        Weighted sum of squares of what the ends miss it by.
    degrees_of_freedom
        ``2 L - 3``: one for two stripes, because any two coplanar lines fit.
    largest_mm, sigma_largest_mm
        Largest distance of an end from the plane and that distance's standard deviation.
    """

    plane: Plane
    chi2: float
    degrees_of_freedom: int
    largest_mm: float
    sigma_largest_mm: float


def fit_common_plane(stripes: Sequence[PosedSighting]) -> CommonPlane | FitFailure:
    """Fit one plane to two or more stripes by generalised least squares on their ends."""
    ends = np.concatenate([s.sighting.ends_mm for s in stripes])
    start = fit_plane(ends)
    if isinstance(start, FitFailure):
        return start
    plane = start.value
    for _ in range(ROUNDS):
        local = (ends - plane.point_mm) @ plane.axes.T
        design = np.stack([local[:, 0], local[:, 1], np.ones(len(ends))], axis=1)
        # All boards share the camera's error, hence one full matrix.
        by_camera = np.concatenate([s.by_camera(plane.normal) for s in stripes])
        covariance = by_camera @ stripes[0].camera_covariance @ by_camera.T
        for k, stripe in enumerate(stripes):
            block = slice(2 * k, 2 * k + 2)
            covariance[block, block] += stripe.own_covariance_mm2(plane.normal)
        weighted = np.linalg.solve(covariance, design)
        normal_matrix = design.T @ weighted
        step = np.linalg.solve(normal_matrix, weighted.T @ local[:, 2])
        missed = local[:, 2] - design @ step
        plane = _tilted(plane, step)
    remaining = covariance - design @ np.linalg.solve(normal_matrix, design.T)
    worst = int(np.argmax(np.abs(missed)))
    return CommonPlane(
        plane,
        float(missed @ np.linalg.solve(covariance, missed)),
        len(ends) - 3,
        float(np.abs(missed[worst])),
        float(np.sqrt(max(remaining[worst, worst], 0.0))),
    )


def _tilted(plane: Plane, step: FloatArray) -> Plane:
    """Add ``step[0] x + step[1] y + step[2]`` to the plane's height."""
    normal = plane.axes[2] - step[0] * plane.axes[0] - step[1] * plane.axes[1]
    normal = normal / np.linalg.norm(normal)
    first = plane.axes[0] - (plane.axes[0] @ normal) * normal
    first = first / np.linalg.norm(first)
    point = plane.point_mm + step[2] * plane.axes[2]
    return Plane(point, np.stack([first, np.cross(normal, first), normal]))
