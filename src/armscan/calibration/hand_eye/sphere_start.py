# SPDX-License-Identifier: Apache-2.0
"""Starts of the hand-eye on a sphere, from everywhere and without any demand on the postures.

For a known rotation, translation and centre in Base follow linearly from where the sections'
centres lie within their sheets. On which side of its sheet a section's sphere is, it does not tell:
all on one side, all on the other, and each where the linear solution puts it are tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.many_starts import (
    Placing,
    descend_all,
    distinct,
    rotations_all_over,
)
from armscan.calibration.hand_eye.sphere_residuals import SphereState
from armscan.calibration.hand_eye.sphere_sections import Section
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose

N_ROTATIONS = 200
N_FIRST = 8
"""Steps of every start; the best of them go on."""
N_GO_ON = 60
N_LAST = 40
N_CANDIDATES = 12
POINTS_OF_SECTION = 7
APART_RAD = 0.05
OPEN_RATIO = 1e-4
"""Singular values of the linear equations below this part of the largest are taken as zero."""


def start_candidates(sections: tuple[Section, ...], radius_mm: float) -> tuple[SphereState, ...]:
    """Up to twelve distinct minima of the plain sum of squares, least first."""
    circles = _Circles.of(sections, radius_mm)
    every = rotations_all_over(N_ROTATIONS)
    completed = [circles.complete(every, side) for side in (1, -1, 0)]
    rotations, others = np.tile(every, (3, 1, 1)), np.concatenate(completed)
    place = _placing(sections, radius_mm)
    size = float(np.sqrt((np.concatenate([one.points_mm for one in sections]) ** 2).sum(1).mean()))
    scale = np.array([1.0 / size] * 3 + [1.0] * 6)
    rotations, others, cost = descend_all(place, rotations, others, N_FIRST, scale)
    best = np.argsort(cost)[:N_GO_ON]
    rotations, others, cost = descend_all(place, rotations[best], others[best], N_LAST, scale)
    kept = distinct(rotations, cost, APART_RAD, N_CANDIDATES)
    return tuple(
        SphereState(Pose(rotations[k], others[k, :3]), others[k, 3:], radius_mm) for k in kept
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """Section circles (S,): centre, normal of the sheet, height of the sphere's centre over it."""

    centres: FloatArray
    normals: FloatArray
    heights: FloatArray
    rotations: FloatArray
    origins: FloatArray

    @staticmethod
    def of(sections: tuple[Section, ...], radius_mm: float) -> _Circles:
        poses = [section.stripe.base_from_tool for section in sections]
        return _Circles(
            np.array([one.centre_mm for one in sections]),
            np.array([one.normal for one in sections]),
            np.array([one.height_mm(radius_mm) for one in sections]),
            np.array([pose.rotation for pose in poses]),
            np.array([pose.translation_mm for pose in poses]),
        )

    def complete(self, rotations: FloatArray, side: int) -> FloatArray:
        """(K, 6) translation and centre that suit (K, 3, 3) rotations.

        The centre in Sensor is ``R' (R_k' (c - T_k) - t)``. With ``side`` 0 only its place within
        the sheet counts at first.
        """
        if side:
            return self._solved(rotations, side * self.heights, 1.0)
        flat = self._solved(rotations, np.zeros(len(self.heights)), 0.0)
        seen = (
            np.einsum("sji,ksj->ksi", self.rotations, flat[:, None, 3:] - self.origins)
            - flat[:, None, :3]
        )
        seen = np.einsum("kji,ksj->ksi", rotations, seen)
        above = np.einsum("ksi,si->ks", seen - self.centres, self.normals)
        return self._solved(rotations, np.where(above < 0.0, -1.0, 1.0) * self.heights, 1.0)

    def _solved(self, rotations: FloatArray, heights: FloatArray, weight: float) -> FloatArray:
        """Least squares for ``R_k' c - t = R q + R_k' T_k``, across the sheets with a weight."""
        n = len(rotations)
        seen = self.centres + np.broadcast_to(heights, (n, len(self.centres)))[..., None] * (
            self.normals
        )
        weights = np.eye(3) - (1.0 - weight) * self.normals[:, :, None] * self.normals[:, None, :]
        back = self.rotations.transpose(0, 2, 1)
        rows = np.concatenate([np.broadcast_to(-np.eye(3), back.shape), back], axis=2)
        # In Sensor, where the weights are: R' (R_k' c - t) = q + R' R_k' T_k.
        turned = np.einsum("sab,kcb,scd->ksad", weights, rotations, rows)
        constant = np.einsum("sij,sj->si", back, self.origins)
        right = seen + np.einsum("kji,sj->ksi", rotations, constant)
        right = np.einsum("sab,ksb->ksa", weights, right)
        inverse = np.linalg.pinv(turned.reshape(n, -1, 6), rcond=OPEN_RATIO)
        return np.asarray(np.einsum("kun,kn->ku", inverse, right.reshape(n, -1)))


def _placing(sections: tuple[Section, ...], radius_mm: float) -> Placing:
    """Distances of a few points of each section from the sphere, for many states at once."""
    picked = [
        section.points_mm[
            np.linspace(0, len(section.rows) - 1, POINTS_OF_SECTION).round().astype(int)
        ]
        for section in sections
    ]
    points = np.concatenate(picked)
    owner = np.repeat(np.arange(len(sections)), POINTS_OF_SECTION)
    poses = [section.stripe.base_from_tool for section in sections]
    rotations = np.array([pose.rotation for pose in poses])[owner]
    shifts = np.einsum(
        "nji,nj->ni", rotations, np.array([pose.translation_mm for pose in poses])[owner]
    )
    flat = rotations.transpose(1, 0, 2).reshape(3, -1)

    def place(turns: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        n = len(turns)
        turned = (points @ turns.transpose(0, 2, 1)).reshape(n, -1, 3)
        centres = (others[:, 3:] @ flat).reshape(n, -1, 3)
        towards = turned + others[:, None, :3] + shifts - centres
        length = np.linalg.norm(towards, axis=2)
        normals = towards / np.maximum(length, 1e-12)[:, :, None]
        in_base = np.einsum("nij,knj->kni", rotations, normals)
        slopes = np.concatenate([np.cross(turned, normals), normals, -in_base], axis=2)
        return length - radius_mm, slopes

    return place


def is_apart(one: SphereState, other: SphereState) -> bool:
    """True for states whose sensors are turned differently."""
    turn = one.tool_from_sensor.rotation.T @ other.tool_from_sensor.rotation
    return float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))) > APART_RAD
