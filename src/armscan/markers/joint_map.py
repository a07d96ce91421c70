# SPDX-License-Identifier: Apache-2.0
"""All views and all markers in one least squares: the bundle adjustment of points in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    bools,
    floats,
    ints,
)
from armscan.geometry.poses import Part, Pose, Sensor
from armscan.geometry.rotations import skew

MAX_ROUNDS = 30
SETTLED = 1e-10
NOTED_GAIN = 1e-2
"""Fall of chi2 at the last step, a sighting, from which on a map counts as not settled."""
OUTLIER_LEVEL = 1e-3
"""Chance that any observation of a whole map without a moved marker is left out."""


class MarkerObservations(RowRecord):
    """Which view saw which marker where.

    Parameters
    ----------
    view, marker
        (K,) indices.
    point_mm, covariance_mm2
        (K, 3) and (K, 3, 3) in the frame of the view.
    """

    view: IntArray = ints("N")
    marker: IntArray = ints("N")
    point_mm: FloatArray = floats("N", 3)
    covariance_mm2: FloatArray = floats("N", 3, 3)


class JointMap(ArrayRecord):
    """Views and markers in the frame of the first view.

    Parameters
    ----------
    part_from_view
        A pose for each view; the first is the identity and defines the frame.
    pose_covariance
        (V, 6, 6) in the order of `armscan.geometry.registration.REGISTRATION_PARAMETERS`; zero for
        the first view.
    markers_mm, marker_covariance_mm2
        (M, 3) and (M, 3, 3).
    residual_mm
        (K, 3) carried sighting minus marker, in the frame of the map.
    is_used
        (K,) False where a sighting did not fit and was left out: its marker moved, or was mistaken.
    chi2, degrees_of_freedom
        Of the sightings used.
    is_settled
        False if the adjustment was stopped before the minimum.
    """

    part_from_view: tuple[Pose[Part, Sensor], ...]
    pose_covariance: FloatArray = floats("V", 6, 6)
    markers_mm: FloatArray = floats("M", 3)
    marker_covariance_mm2: FloatArray = floats("M", 3, 3)
    residual_mm: FloatArray = floats("K", 3)
    is_used: BoolArray = bools("K")
    chi2: float
    degrees_of_freedom: int
    is_settled: bool


def adjust_jointly(
    sightings: MarkerObservations, start: Sequence[Pose[Part, Sensor]], markers_mm: FloatArray
) -> JointMap:
    """Solve all poses but the first and all markers; leave out sightings that do not fit.

    Parameters
    ----------
    sightings
        Every marker is seen at least once.
    start
        A pose for each view, from the chain.
    markers_mm
        (M, 3) start of the markers.

    Returns
    -------
    JointMap
        The worst sighting is left out, and all solved again, until every one fits at
        `OUTLIER_LEVEL`; a marker needs two other sightings for that.
    """
    is_used = np.ones(len(sightings), dtype=bool)
    problem = _Problem(sightings, tuple(start), np.array(markers_mm))
    while True:
        problem, is_settled = replace(problem, sightings=sightings.select(is_used)).solved()
        worst = problem.worst()
        if worst is None:
            break
        is_used[np.flatnonzero(is_used)[worst]] = False
    poses, covariance, own = problem.covariances()
    residual = replace(problem, sightings=sightings).residuals()
    used = sightings.select(is_used)
    return JointMap(
        part_from_view=problem.poses,
        pose_covariance=poses,
        markers_mm=problem.markers_mm,
        marker_covariance_mm2=own,
        residual_mm=residual,
        is_used=is_used,
        chi2=problem.squares(),
        degrees_of_freedom=3 * len(used) - 6 * (len(start) - 1) - 3 * len(covariance),
        is_settled=is_settled,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations in blocks: poses (V, 6, 6), markers (M, 3, 3), and what couples them."""

    poses: FloatArray
    markers: FloatArray
    coupling: FloatArray
    right_poses: FloatArray
    right_markers: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    sightings: MarkerObservations
    poses: tuple[Pose[Part, Sensor], ...]
    markers_mm: FloatArray

    def turned(self) -> FloatArray:
        """(K, 3) sightings turned into the frame of the map, not shifted."""
        rotation = np.stack([pose.rotation for pose in self.poses])[self.sightings.view]
        return np.asarray(np.einsum("kij,kj->ki", rotation, self.sightings.point_mm))

    def residuals(self) -> FloatArray:
        """(K, 3) carried sighting minus marker."""
        shift = np.stack([pose.translation_mm for pose in self.poses])[self.sightings.view]
        return np.asarray(self.turned() + shift - self.markers_mm[self.sightings.marker])

    def weights(self) -> FloatArray:
        """(K, 3, 3) inverse covariances in the frame of the map."""
        rotation = np.stack([pose.rotation for pose in self.poses])[self.sightings.view]
        inverse = np.linalg.inv(self.sightings.covariance_mm2)
        return np.asarray(rotation @ inverse @ np.swapaxes(rotation, 1, 2))

    def jacobian(self) -> FloatArray:
        """(K, 3, 6) derivative of a residual by its view's pose."""
        turned = self.turned()
        identity = np.broadcast_to(np.eye(3), (len(turned), 3, 3))
        return np.concatenate([-skew(turned), identity], axis=2)

    def squares(self) -> float:
        residual = self.residuals()
        return float(np.einsum("ki,kij,kj->", residual, self.weights(), residual))

    def normal(self) -> _Normal:
        seen, n_views, n_markers = self.sightings, len(self.poses), len(self.markers_mm)
        weights, jacobian, residual = self.weights(), self.jacobian(), self.residuals()
        by_pose = np.einsum("kji,kjl->kil", jacobian, weights)
        result = _Normal(
            np.zeros((n_views, 6, 6)),
            np.zeros((n_markers, 3, 3)),
            np.zeros((n_views, 6, n_markers, 3)),
            np.zeros((n_views, 6)),
            np.zeros((n_markers, 3)),
        )
        np.add.at(result.poses, seen.view, by_pose @ jacobian)
        np.add.at(result.markers, seen.marker, weights)
        # views and markers first, so that both indices stand side by side
        np.add.at(result.coupling.transpose(0, 2, 1, 3), (seen.view, seen.marker), -by_pose)
        np.add.at(result.right_poses, seen.view, -np.einsum("kij,kj->ki", by_pose, residual))
        np.add.at(result.right_markers, seen.marker, np.einsum("kij,kj->ki", weights, residual))
        return result

    def solved(self) -> tuple[_Problem, bool]:
        """Gauss-Newton with the markers eliminated block by block (Schur complement).

        Also returns whether it settled.
        """
        problem = self
        n = 6 * (len(self.poses) - 1)
        for _ in range(MAX_ROUNDS):
            normal = problem.normal()
            spread, reduced = _reduced(normal)
            right = normal.right_poses[1:].ravel() - np.einsum(
                "pmi,mi->p", spread, normal.right_markers
            )
            step = np.linalg.solve(reduced, right) if n else np.zeros(0)
            coupling = normal.coupling[1:].reshape(n, *normal.coupling.shape[2:])
            left = normal.right_markers - np.einsum("pmi,p->mi", coupling, step)
            shift = np.linalg.solve(normal.markers, left[:, :, None])[:, :, 0]
            problem = problem.moved(step.reshape(-1, 6), shift)
            gain = float(step @ right) + float((shift * normal.right_markers).sum())
            if abs(gain) < SETTLED * max(1.0, len(problem.sightings)):
                break
        return problem, abs(gain) < NOTED_GAIN * max(1.0, len(problem.sightings))

    def moved(self, steps: FloatArray, shift_mm: FloatArray) -> _Problem:
        """The problem after a step of the poses (V - 1, 6) and the markers (M, 3)."""
        poses = [pose.retract(step) for pose, step in zip(self.poses[1:], steps, strict=True)]
        return replace(self, poses=(self.poses[0], *poses), markers_mm=self.markers_mm + shift_mm)

    def covariances(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Poses (V, 6, 6); markers given the poses (M, 3, 3); markers in all (M, 3, 3)."""
        normal = self.normal()
        spread, reduced = _reduced(normal)
        joint = np.linalg.inv(reduced) if reduced.size else reduced
        n = len(self.poses)
        poses = np.zeros((n, 6, 6))
        for k in range(1, n):
            part = slice(6 * (k - 1), 6 * k)
            poses[k] = joint[part, part]
        given = np.linalg.inv(normal.markers)
        own = given + np.einsum("pmi,pq,qmj->mij", spread, joint, spread)
        return poses, np.asarray(given, dtype=np.float64), np.asarray(own)

    def worst(self) -> int | None:
        """The sighting that fits worst, if the chance of it is below `OUTLIER_LEVEL`."""
        seen = self.sightings
        residual, weights, jacobian = self.residuals(), self.weights(), self.jacobian()
        normal = self.normal()
        spread, reduced = _reduced(normal)
        joint = np.linalg.inv(reduced) if reduced.size else reduced
        given = np.linalg.inv(normal.markers)[seen.marker]
        # derivative of a carried sighting minus its marker by all poses, markers following
        total = np.moveaxis(spread[:, seen.marker], 0, 2).copy()
        for k, view in enumerate(seen.view):
            if view:
                total[k, :, 6 * (view - 1) : 6 * view] += jacobian[k]
        own = np.linalg.inv(weights) - given - total @ joint @ np.swapaxes(total, 1, 2)
        values, vectors = np.linalg.eigh(np.swapaxes(weights, 1, 2) @ own @ weights)
        scale = np.trace(weights, axis1=1, axis2=2) / 3.0
        along = np.einsum("kij,ki->kj", vectors, np.einsum("kij,kj->ki", weights, residual))
        redundancy = values / scale[:, None]
        score = np.where(redundancy > 1e-3, along**2 / np.maximum(values, 1e-300), 0.0).sum(axis=1)
        n_seen = np.bincount(seen.marker, minlength=len(self.markers_mm))[seen.marker]
        score[n_seen < 3] = 0.0
        k = int(np.argmax(score))
        return k if score[k] > float(chdtri(3, OUTLIER_LEVEL / len(seen))) else None


def _reduced(normal: _Normal) -> tuple[FloatArray, FloatArray]:
    """``W H_mm^-1`` (P, M, 3) and the reduced normal matrix (P, P) of all poses but the first."""
    n, m = 6 * (len(normal.poses) - 1), len(normal.markers)
    coupling = normal.coupling[1:].reshape(n, m, 3)
    spread = np.einsum("pmi,mij->pmj", coupling, np.linalg.inv(normal.markers))
    reduced = -np.einsum("pmi,qmi->pq", spread, coupling)
    for k in range(n // 6):
        part = slice(6 * k, 6 * (k + 1))
        reduced[part, part] += normal.poses[k + 1]
    return spread, reduced
