# SPDX-License-Identifier: Apache-2.0
"""``scanner.json``: sensor and hand-eye in one document, exact, written once."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.models.scanner import (
    HAND_EYE_PARAMETER_NAMES,
    ArmNoise,
    HandEyeCalibration,
    HandEyeDiagnostics,
    ScannerCalibration,
)
from armscan.storage.calibration_bodies import (
    covariance_body,
    covariance_from_body,
    provenance_body,
    provenance_from_body,
    sensor_document_of,
    sensor_from_document,
    triple,
)
from armscan.storage.calibration_files import observations_body, validated_document
from armscan.storage.calibration_schema import SCANNER_SCHEMA
from armscan.storage.images import read_bytes
from armscan.storage.json_text import json_bytes, parse_json
from armscan.storage.scanner_schema import (
    ArmNoiseBody,
    CouplingBody,
    HandEyeBody,
    HandEyeDiagnosticsBody,
    PlateBody,
    PoseBody,
    ScannerDocument,
)


def scanner_document(
    calibration: ScannerCalibration, observations: tuple[str, bytes] | None = None
) -> bytes:
    """Text of ``scanner.json``.

    Parameters
    ----------
    calibration
        What to write.
    observations
        Name and content of the file of observations beside it.

    Raises
    ------
    InputError
        If the hand-eye depends on a sensor that is not given.
    """
    sensor = calibration.sensor
    names = () if sensor is None else sensor.parameter_names
    document = ScannerDocument(
        schema=SCANNER_SCHEMA,
        sensor=None if sensor is None else sensor_document_of(sensor, None),
        hand_eye=_hand_eye_body(calibration.hand_eye, names),
        latency_ns=calibration.latency_ns,
        observations=observations_body(observations),
        provenance=provenance_body(calibration.provenance),
    )
    return json_bytes(document.model_dump(mode="json", by_alias=True))


def is_scanner_document(path: Path) -> bool:
    """True if a file says that it is a scanner's document; it need not be whole.

    Raises
    ------
    FileFormatError
        If the file is missing or no JSON.
    """
    return bool(parse_json(read_bytes(path), str(path)).get("schema") == SCANNER_SCHEMA)


def read_scanner_calibration(path: Path) -> ScannerCalibration:
    """Read ``scanner.json``.

    Raises
    ------
    FileFormatError
        If the file is cut, of another kind, of a newer version, or holds values that cannot be.
    """
    document = validated_document(ScannerDocument, SCANNER_SCHEMA, read_bytes(path), path)
    try:
        sensor = None if document.sensor is None else sensor_from_document(document.sensor)
        names = () if sensor is None else sensor.parameter_names
        return ScannerCalibration(
            sensor=sensor,
            hand_eye=_hand_eye_from_body(document.hand_eye, names),
            provenance=provenance_from_body(document.provenance),
            latency_ns=document.latency_ns,
        )
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def _hand_eye_body(calibration: HandEyeCalibration, sensor_names: tuple[str, ...]) -> HandEyeBody:
    pose = calibration.tool_from_sensor
    first, second, third = (triple(row) for row in pose.rotation)
    known = calibration.diagnostics
    return HandEyeBody(
        tool_from_sensor=PoseBody(
            rotation_rows=(first, second, third), translation_tool_mm=triple(pose.translation_mm)
        ),
        covariance=covariance_body(HAND_EYE_PARAMETER_NAMES, calibration.covariance),
        sensor_coupling=_coupling_body(calibration.sensor_coupling, sensor_names),
        arm_noise=ArmNoiseBody(**asdict(calibration.arm_noise)),
        rms_mm=calibration.rms_mm,
        n_postures=calibration.n_postures,
        n_exposures=calibration.n_exposures,
        n_points=calibration.n_points,
        plate=_plate_body(calibration.plate),
        diagnostics=None if known is None else HandEyeDiagnosticsBody(**asdict(known)),
    )


def _hand_eye_from_body(body: HandEyeBody, sensor_names: tuple[str, ...]) -> HandEyeCalibration:
    pose = body.tool_from_sensor
    tool_from_sensor: Pose[Tool, Sensor] = Pose(
        np.array(pose.rotation_rows), np.array(pose.translation_tool_mm)
    )
    return HandEyeCalibration(
        tool_from_sensor=tool_from_sensor,
        covariance=covariance_from_body(body.covariance, HAND_EYE_PARAMETER_NAMES),
        sensor_coupling=_coupling_from_body(body.sensor_coupling, sensor_names),
        arm_noise=ArmNoise(**body.arm_noise.model_dump()),
        rms_mm=body.rms_mm,
        n_postures=body.n_postures,
        n_exposures=body.n_exposures,
        n_points=body.n_points,
        plate=_plate_from_body(body.plate),
        diagnostics=_diagnostics_from_body(body.diagnostics),
    )


def _diagnostics_from_body(body: HandEyeDiagnosticsBody | None) -> HandEyeDiagnostics | None:
    if body is None:
        return None
    return HandEyeDiagnostics(
        method=body.method,
        rank=body.rank,
        condition=body.condition,
        weakest=body.weakest,
        plate_flatness_mm=body.plate_flatness_mm,
        flatness_length_mm=body.flatness_length_mm,
        is_noise_estimated=body.is_noise_estimated,
        left_out_rotation_deg=body.left_out_rotation_deg,
        left_out_translation_mm=body.left_out_translation_mm,
        chi2_probability=body.chi2_probability,
    )


def _coupling_body(matrix: FloatArray | None, names: tuple[str, ...]) -> CouplingBody | None:
    if matrix is None:
        return None
    if matrix.shape[1] != len(names):
        raise InputError("the hand-eye depends on a sensor's parameters that have no names")
    return CouplingBody(
        row_names=HAND_EYE_PARAMETER_NAMES,
        column_names=names,
        matrix=tuple(tuple(row) for row in matrix.tolist()),
    )


def _coupling_from_body(body: CouplingBody | None, names: tuple[str, ...]) -> FloatArray | None:
    if body is None:
        return None
    if body.row_names != HAND_EYE_PARAMETER_NAMES or body.column_names != names:
        raise InputError("the coupling's parameter names are not those of hand-eye and sensor")
    if len(body.matrix) != 6 or any(len(row) != len(names) for row in body.matrix):
        raise InputError(f"the coupling is not a 6 x {len(names)} matrix")
    return np.array(body.matrix, dtype=np.float64)


def _plate_body(plate: Plane | None) -> PlateBody | None:
    if plate is None:
        return None
    return PlateBody(
        point_base_mm=triple(plate.point_mm),
        along_base=triple(plate.axes[0]),
        across_base=triple(plate.axes[1]),
        normal_base=triple(plate.axes[2]),
    )


def _plate_from_body(body: PlateBody | None) -> Plane | None:
    if body is None:
        return None
    axes = np.array([body.along_base, body.across_base, body.normal_base])
    if float(np.abs(axes @ axes.T - np.eye(3)).max()) > 1e-6:
        raise InputError("the plate's axes are not unit vectors at right angles")
    return Plane(np.array(body.point_base_mm), axes)
