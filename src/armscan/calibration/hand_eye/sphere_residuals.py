# SPDX-License-Identifier: Apache-2.0
"""Distance of placed points from the sphere, condensed to nodes, with its derivatives.

A node is the mean of the residuals of neighbouring points, not the residual of a mean point: on a
curved stripe the mean of points lies inside the sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.sphere_sections import Section
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector

N_HAND_EYE = 6
RADIUS_COLUMN = 9
SCALE_COLUMN = 10
N_COLUMNS = 11


@dataclass(frozen=True, slots=True, eq=False)
class SphereState:
    """All unknowns: hand-eye, centre (3,) in Base, radius in mm, scale of the sensor's points."""

    tool_from_sensor: Pose[Tool, Sensor]
    centre_mm: FloatArray
    radius_mm: float
    scale: float = 1.0

    def stepped(self, step: FloatArray) -> SphereState:
        """Apply a step (11,): hand-eye in `HAND_EYE_PARAMETER_NAMES`, centre, radius, scale."""
        rotation = rotation_from_vector(step[:3]) @ self.tool_from_sensor.rotation
        return SphereState(
            Pose(rotation, self.tool_from_sensor.translation_mm + step[3:6]),
            self.centre_mm + step[6:9],
            self.radius_mm + float(step[RADIUS_COLUMN]),
            self.scale + float(step[SCALE_COLUMN]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SphereNodes:
    """Points on the sphere, cut into nodes.

    Parameters
    ----------
    sections
        Where they come from.
    postures
        Names of the postures.
    points_mm
        (N, 3) in the Sensor frame, the points of a node one after another.
    point_section
        (N,) index into ``sections``.
    first, count
        (M,) row of each node's first point, and count of its points.
    section, posture
        (M,) indices of each node's section and posture.
    sigma_mm
        (M,) standard deviation of a node's mean residual by the stripe's own noise.
    by_sensor
        (N, 3, P) derivative of the points by the sensor's parameters; None where not known.
    sensor_covariance
        (P, P) of the sensor's parameters; None where it is taken as exact.
    """

    sections: tuple[Section, ...]
    postures: tuple[str, ...]
    points_mm: FloatArray
    point_section: IntArray
    first: IntArray
    count: IntArray
    section: IntArray
    posture: IntArray
    sigma_mm: FloatArray
    by_sensor: FloatArray | None = None
    sensor_covariance: FloatArray | None = None

    def __len__(self) -> int:
        """Count of nodes."""
        return len(self.first)

    def mean(self, values: FloatArray) -> FloatArray:
        """(M, ...) mean over each node of (N, ...) values of its points."""
        sums = np.add.reduceat(values, self.first, axis=0)
        return np.asarray(sums / self.count.reshape(-1, *([1] * (values.ndim - 1))))


def sphere_nodes(
    sections: tuple[Section, ...], per_stripe: int, sensor_covariance: FloatArray | None = None
) -> SphereNodes:
    """Cut sections into nodes of nearly equal count.

    The stripe's own error of a node is taken from how its mean leaves the section circle: errors
    of neighbouring points are alike, so that dividing the scatter of single points by the root of
    their count would promise too much.
    """
    names = tuple(dict.fromkeys(section.stripe.posture for section in sections))
    firsts, counts, owners, sigmas = [], [], [], []
    start = 0
    for k, section in enumerate(sections):
        n = len(section.rows)
        n_nodes = min(per_stripe, n // 2)
        edges = np.linspace(0, n, n_nodes + 1).astype(np.int64)
        count = np.diff(edges)
        means = np.add.reduceat(section.off_circle_mm, edges[:-1]) / count
        form = float(means @ means) / max(n_nodes - 3, 1)
        own = (section.stripe.noise_mm[section.rows] ** 2).sum(axis=(1, 2)).mean() / count
        firsts.append(edges[:-1] + start)
        counts.append(count)
        owners.append(np.full(n_nodes, k))
        sigmas.append(np.sqrt(np.maximum(own, max(form, 1e-12))))
        start += n
    owner = np.concatenate(owners)
    posture_of = np.array([names.index(section.stripe.posture) for section in sections])
    lengths = [len(section.rows) for section in sections]
    return SphereNodes(
        sections,
        names,
        np.concatenate([section.points_mm for section in sections]),
        np.repeat(np.arange(len(sections)), lengths),
        np.concatenate(firsts),
        np.concatenate(counts),
        owner,
        posture_of[owner],
        np.concatenate(sigmas),
        _by_sensor(sections),
        sensor_covariance,
    )


def _by_sensor(sections: tuple[Section, ...]) -> FloatArray | None:
    parts = [(section.stripe.by_sensor, section.rows) for section in sections]
    known = [by_sensor[rows] for by_sensor, rows in parts if by_sensor is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


@dataclass(frozen=True, slots=True, eq=False)
class PlacedOnSphere:
    """Points placed with a state.

    Parameters
    ----------
    points_base_mm
        (N, 3) placed points.
    point_residual_mm
        (N,) their distance from the sphere, positive outside.
    normals_sensor
        (N, 3) derivative of that by the point in the Sensor frame.
    residual_mm
        (M,) of the nodes.
    slopes
        (M, 11) derivative by all unknowns, in the order of `SphereState.stepped`.
    by_pose
        (M, 6) derivative by a shift of the arm's pose in Base and by its turn about the middle of
        the posture's points.
    """

    points_base_mm: FloatArray
    point_residual_mm: FloatArray
    normals_sensor: FloatArray
    residual_mm: FloatArray
    slopes: FloatArray
    by_pose: FloatArray


def place_on_sphere(nodes: SphereNodes, state: SphereState) -> PlacedOnSphere:
    """Place all points (eq. 2.46) and measure their distance from the sphere."""
    poses = [section.stripe.base_from_tool for section in nodes.sections]
    rotations = np.array([pose.rotation for pose in poses])[nodes.point_section]
    origins = np.array([pose.translation_mm for pose in poses])[nodes.point_section]
    hand_eye = state.tool_from_sensor
    turned = state.scale * nodes.points_mm @ hand_eye.rotation.T
    in_tool = turned + hand_eye.translation_mm
    base = np.einsum("nij,nj->ni", rotations, in_tool) + origins
    towards = base - state.centre_mm
    length = np.linalg.norm(towards, axis=1)
    normals = towards / np.maximum(length, 1e-12)[:, None]
    normals_tool = np.einsum("nij,ni->nj", rotations, normals)
    residual = length - state.radius_mm
    slopes = np.column_stack(
        [
            np.cross(turned, normals_tool),
            normals_tool,
            -normals,
            -np.ones(len(base)),
            np.einsum("ni,ni->n", normals_tool, turned) / state.scale,
        ]
    )
    lever = base - _posture_middles(nodes, base)
    by_pose = np.column_stack([normals, np.cross(lever, normals)])
    return PlacedOnSphere(
        base,
        residual,
        state.scale * normals_tool @ hand_eye.rotation,
        nodes.mean(residual),
        nodes.mean(slopes),
        nodes.mean(by_pose),
    )


def residual_by_sensor(nodes: SphereNodes, placed: PlacedOnSphere) -> FloatArray | None:
    """(M, P) derivative of the residuals by the sensor's parameters; None where not known."""
    if nodes.by_sensor is None:
        return None
    return nodes.mean(np.einsum("ni,nip->np", placed.normals_sensor, nodes.by_sensor))


def covariance_by_sensor(nodes: SphereNodes, placed: PlacedOnSphere) -> FloatArray:
    """(M, M) covariance of the residuals by the sensor's calibration; zero where it is exact."""
    by_sensor = residual_by_sensor(nodes, placed)
    if by_sensor is None or nodes.sensor_covariance is None:
        return np.zeros((len(nodes), len(nodes)))
    return np.asarray(by_sensor @ nodes.sensor_covariance @ by_sensor.T)


def _posture_middles(nodes: SphereNodes, base: FloatArray) -> FloatArray:
    """(N, 3) mean of all placed points of each point's posture."""
    posture = np.repeat(nodes.posture, nodes.count)
    count = np.bincount(posture, minlength=len(nodes.postures))
    sums = np.zeros((len(nodes.postures), 3))
    np.add.at(sums, posture, base)
    return np.asarray((sums / np.maximum(count, 1)[:, None])[posture])
