# SPDX-License-Identifier: Apache-2.0
"""What the distances of scanned points from a surface depend on: calibration, arm, plate."""

from __future__ import annotations

import math

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.uncertainty import COARSE_BLOCKS, exposure_blocks
from armscan.models.scanner import ArmNoise, ScannerCalibration
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.pipeline.sheet_rules import measured_again
from armscan.reconstruction.place import place_with_jacobian
from armscan.reconstruction.triangulate import sensor_columns
from armscan.records.cloud import PointCloud


def distance_by_plate(plate: PlateReference, points_mm: FloatArray) -> FloatArray:
    """(N, 3) derivative of distances by independent errors of the probed plane, one sigma each."""
    if plate.covariance is None:
        return np.zeros((len(points_mm), 0))
    away = (points_mm - plate.plane.point_mm) @ plate.plane.axes.T
    lever = np.column_stack([away[:, 0], away[:, 1], np.ones(len(away))])
    values, vectors = np.linalg.eigh(plate.covariance)
    return np.asarray(lever @ vectors * np.sqrt(np.maximum(values, 0.0)))


def distance_by_arm(
    cloud: PointCloud, rows: IntArray, directions: FloatArray, noise: ArmNoise
) -> FloatArray:
    """(N, 6 B) derivative of distances by shifts and turns of the arm, one sigma each.

    Neighbouring exposures, B blocks of them, are taken to err alike: an arm's errors depend on its
    posture, which changes little from one to the next.
    """
    points = cloud.points_mm[rows]
    block, n_blocks = exposure_blocks(cloud.exposure[rows], COARSE_BLOCKS[0])
    count = np.bincount(block, minlength=n_blocks)[:, None]
    middle = np.stack([np.bincount(block, points[:, k], n_blocks) for k in range(3)], 1) / count
    turns = np.cross(points - middle[block], directions)
    position = math.hypot(noise.position_mm, noise.exposure_position_mm)
    rotation = math.hypot(noise.rotation_rad, noise.exposure_rotation_rad)
    found = np.zeros((len(points), n_blocks, 6))
    found[np.arange(len(points)), block, :3] = position * directions
    found[np.arange(len(points)), block, 3:] = rotation * turns
    return found.reshape(len(points), -1)


def distance_by_calibration(
    scan: ScanReconstruction, scanner: ScannerCalibration, directions: FloatArray
) -> FloatArray:
    """Derivative of every point's distance by the calibration's parameters.

    Parameters
    ----------
    scan
        Points of the whole scan, none cut off by a working volume.
    scanner
        The calibration that made them.
    directions
        (N, 3) unit vector along which each point of ``scan.cloud`` is measured; points with zero
        are left out.

    Returns
    -------
    FloatArray
        (N, P + 6) in the order of ``scanner.covariance``.

    Raises
    ------
    EstimationError
        If the scanner has no camera, or points of the scan were cut off.
    """
    sensor = scanner.sensor
    if sensor is None:
        raise EstimationError("this scanner has no camera", remedy="verify a cloud instead")
    n = len(sensor.parameter_names)
    found = np.zeros((len(scan.cloud), n + 6))
    order = np.argsort(scan.cloud.exposure, kind="stable")
    ends = np.searchsorted(scan.cloud.exposure[order], np.arange(len(scan.images) + 1))
    for k, stripe in measured_again(scan.images, sensor):
        rows = order[ends[k] : ends[k + 1]]
        along = directions[rows]
        if not along.any():
            continue
        if len(stripe.row) != len(rows):
            raise EstimationError("points of the scan were cut off before the check")
        pose = scan.poses.pose(scan.image_rows[k])
        placed = place_with_jacobian(stripe.points_mm, pose, scanner.hand_eye.tool_from_sensor)
        by_sheet = np.einsum("ni,nip->np", along @ placed.by_sensor_point, stripe.by_sensor)
        for sheet in np.unique(stripe.sheet):
            on = stripe.sheet == sheet
            found[np.ix_(rows[on], sensor_columns(sensor, int(sheet)))] = by_sheet[on]
        found[rows, n:] = np.einsum("ni,nip->np", along, placed.by_hand_eye)
    return found
