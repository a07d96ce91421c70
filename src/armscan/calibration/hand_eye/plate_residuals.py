# SPDX-License-Identifier: Apache-2.0
"""Distance of placed points from the plate, with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import nearest_rotation, rotation_from_vector

N_HAND_EYE = 6
N_PLANE = 3


@dataclass(frozen=True, slots=True, eq=False)
class PlateState:
    """A hand-eye, and the plate as two tilts (rad) and an offset (mm) from the probed one.

    The tilts and the offset are `armscan.geometry.fitting.PLANE_PARAMETERS`.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    plane: FloatArray

    def stepped(self, step: FloatArray) -> PlateState:
        """Add a step of (6,) or (9,): hand-eye, and the plate's plane where it is free."""
        pose = step_hand_eye(self.tool_from_sensor, step[:N_HAND_EYE])
        plane = self.plane if len(step) == N_HAND_EYE else self.plane + step[N_HAND_EYE:]
        return PlateState(pose, plane)


def step_hand_eye(pose: Pose[Tool, Sensor], step: FloatArray) -> Pose[Tool, Sensor]:
    """Add (6,) increments in the order of `armscan.models.scanner.HAND_EYE_PARAMETER_NAMES`."""
    rotation = nearest_rotation(rotation_from_vector(step[:3]) @ pose.rotation)
    return Pose(rotation, pose.translation_mm + step[3:6])


def hand_eye_difference(pose: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> FloatArray:
    """(6,) increments that lead from ``other`` to ``pose``."""
    turn: Pose[Tool, Tool] = Pose(pose.rotation @ other.rotation.T, np.zeros(3))
    return np.concatenate([turn.rotation_vector_rad, pose.translation_mm - other.translation_mm])


def shifted_plane(plate: Plane, plane: FloatArray) -> Plane:
    """Apply two tilts and an offset (3,) to the plate."""
    raised = plate.axes[2] - plane[0] * plate.axes[0] - plane[1] * plate.axes[1]
    normal = raised / np.linalg.norm(raised)
    across = np.cross(normal, plate.axes[0])
    across /= np.linalg.norm(across)
    return Plane(
        plate.point_mm + plane[2] * normal, np.stack([np.cross(across, normal), across, normal])
    )


@dataclass(frozen=True, slots=True, eq=False)
class PlacedNodes:
    """Nodes placed in Base, and what their distances depend on.

    Parameters
    ----------
    points_base_mm
        (N, 3).
    scan_points_base_mm
        (N, 3) middle of the sensor's working range, as the node's exposure had it.
    normals_tool, normals_sensor
        (N, 3) the plate's normal in Tool (eq. 2.57) and in Sensor.
    residual_mm
        (N,) signed distance from the plate: the misclosure of eq. 2.74.
    by_hand_eye
        (N, 6) its derivative by the hand-eye.
    by_plane
        (N, 3) its derivative by the plate's tilts and offset.
    """

    points_base_mm: FloatArray
    scan_points_base_mm: FloatArray
    normals_tool: FloatArray
    normals_sensor: FloatArray
    residual_mm: FloatArray
    by_hand_eye: FloatArray
    by_plane: FloatArray


def place_nodes(nodes: PlateNodes, plate: Plane, state: PlateState) -> PlacedNodes:
    """Place the nodes with a hand-eye and compare them with the plate."""
    rotations = nodes.rotations[nodes.stripe]
    translations = nodes.translations_mm[nodes.stripe]
    hand_eye = state.tool_from_sensor
    turned = nodes.points_mm @ hand_eye.rotation.T
    middle = hand_eye.rotation @ nodes.points_mm.mean(axis=0) + hand_eye.translation_mm
    placed = np.einsum("nij,nj->ni", rotations, turned + hand_eye.translation_mm) + translations
    local = (placed - plate.point_mm) @ plate.axes.T
    tilt_1, tilt_2, offset = state.plane
    scale = np.sqrt(1.0 + tilt_1**2 + tilt_2**2)
    height = (local[:, 2] - tilt_1 * local[:, 0] - tilt_2 * local[:, 1]) / scale
    normal = (plate.axes[2] - tilt_1 * plate.axes[0] - tilt_2 * plate.axes[1]) / scale
    normals_tool = np.einsum("nij,i->nj", rotations, normal)
    by_plane = -np.column_stack(
        [
            local[:, 0] / scale + height * tilt_1 / scale**2,
            local[:, 1] / scale + height * tilt_2 / scale**2,
            np.ones(len(nodes)),
        ]
    )
    by_hand_eye = np.concatenate([np.cross(turned, normals_tool), normals_tool], axis=1)
    return PlacedNodes(
        placed,
        rotations @ middle + translations,
        normals_tool,
        normals_tool @ hand_eye.rotation,
        height - offset,
        by_hand_eye,
        by_plane,
    )


def residual_by_sensor(nodes: PlateNodes, placed: PlacedNodes) -> FloatArray | None:
    """(N, P) derivative of the residuals by the sensor's parameters; None where not known."""
    if nodes.by_sensor is None:
        return None
    return np.asarray(np.einsum("ni,nip->np", placed.normals_sensor, nodes.by_sensor))


def sensor_covariance(nodes: PlateNodes, placed: PlacedNodes) -> FloatArray | None:
    """(N, N) covariance of the residuals by the sensor's calibration; None where not known."""
    by_sensor = residual_by_sensor(nodes, placed)
    if by_sensor is None or nodes.sensor_covariance is None:
        return None
    return np.asarray(by_sensor @ nodes.sensor_covariance @ by_sensor.T)
