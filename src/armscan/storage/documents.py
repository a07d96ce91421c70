# SPDX-License-Identifier: Apache-2.0
"""Calibration documents: ``camera.json``, ``sensor.json``, ``stereo.json``, ``scanner.json``,
``registration.json``; exact, written once.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.registration import REGISTRATION_PARAMETERS
from armscan.geometry.shapes import Plane
from armscan.models.calibration import (
    HAND_EYE_PARAMETER_NAMES,
    ArmNoise,
    CameraCalibration,
    HandEyeCalibration,
    HandEyeDiagnostics,
    ScannerCalibration,
    SensorCalibration,
)
from armscan.models.two_views import STEREO_PARAMETER_NAMES, StereoCalibration, StereoDiagnostics
from armscan.storage.bodies import (
    camera_body,
    camera_from_body,
    covariance_body,
    covariance_from_body,
    provenance_body,
    provenance_from_body,
    right_pose_body,
    right_pose_from_body,
    sensor_document_of,
    sensor_from_document,
    triple,
)
from armscan.storage.foreign import read_foreign_camera
from armscan.storage.images import read_bytes
from armscan.storage.json_text import json_bytes, parse_json
from armscan.storage.schema import (
    CAMERA_SCHEMA,
    REGISTRATION_SCHEMA,
    SCANNER_SCHEMA,
    SCHEMA_VERSION,
    SENSOR_SCHEMA,
    STEREO_SCHEMA,
    ArmNoiseBody,
    Body,
    CameraDocument,
    CouplingBody,
    CovarianceBody,
    HandEyeBody,
    HandEyeDiagnosticsBody,
    KnownOrNot,
    LeftOutBody,
    ObservationsBody,
    PlateBody,
    PoseBody,
    ProvenanceBody,
    ScannerDocument,
    SensorDocument,
    StereoDiagnosticsBody,
    StereoDocument,
    Triple,
)

D = TypeVar("D", bound=BaseModel)

BYTE_ORDER_MARK = b"\xef\xbb\xbf"

KINDS = {
    CAMERA_SCHEMA: "camera calibration",
    SENSOR_SCHEMA: "sensor calibration",
    SCANNER_SCHEMA: "scanner calibration",
    STEREO_SCHEMA: "stereo calibration",
    REGISTRATION_SCHEMA: "registration",
}
WRITERS = {
    CAMERA_SCHEMA: "calibrate camera",
    SENSOR_SCHEMA: "calibrate laser",
    SCANNER_SCHEMA: "calibrate hand-eye",
    STEREO_SCHEMA: "calibrate stereo",
    REGISTRATION_SCHEMA: "register",
}


def camera_document(
    calibration: CameraCalibration, observations: tuple[str, bytes] | None = None
) -> bytes:
    """Text of ``camera.json``.

    Parameters
    ----------
    calibration
        What to write.
    observations
        Name and content of the file of observations beside it.
    """
    document = CameraDocument(
        schema=CAMERA_SCHEMA,
        camera=camera_body(calibration),
        observations=observations_body(observations),
        provenance=provenance_body(calibration.provenance),
    )
    return json_bytes(document.model_dump(mode="json", by_alias=True))


def sensor_document(
    calibration: SensorCalibration, observations: tuple[str, bytes] | None = None
) -> bytes:
    """Text of ``sensor.json``; see `camera_document`."""
    document = sensor_document_of(calibration, observations_body(observations))
    return json_bytes(document.model_dump(mode="json", by_alias=True))


def document_schema(path: Path) -> str | None:
    """Name of the schema that a document says it has; None for a file without one.

    Raises
    ------
    FileFormatError
        If the file is missing, or JSON that is damaged.
    """
    data = read_bytes(path)
    if not data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return None
    found = parse_json(data, str(path)).get("schema")
    return found if isinstance(found, str) else None


def read_calibration(path: Path) -> CameraCalibration | SensorCalibration:
    """Read any calibration document of armscan.

    Raises
    ------
    FileFormatError
        If the file is cut, of another kind, of a newer version, or holds values that cannot be.
    """
    data = read_bytes(path)
    if parse_json(data, str(path)).get("schema") == SENSOR_SCHEMA:
        return _sensor(data, path)
    return _camera(data, path)


def read_camera_calibration(path: Path) -> CameraCalibration:
    """Read ``camera.json``, or a calibration that OpenCV or ROS wrote.

    Raises
    ------
    FileFormatError
        As `read_calibration`; a sensor's document is refused where a camera's is needed.
    """
    data = read_bytes(path)
    is_object = data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
    if not is_object or "schema" not in parse_json(data, str(path)):
        return read_foreign_camera(path)
    return _camera(data, path)


def read_sensor_calibration(path: Path) -> SensorCalibration:
    """Read ``sensor.json``.

    Raises
    ------
    FileFormatError
        As `read_calibration`; a camera's document is refused where a sensor's is needed.
    """
    return _sensor(read_bytes(path), path)


def _camera(data: bytes, path: Path) -> CameraCalibration:
    document = validated_document(CameraDocument, CAMERA_SCHEMA, data, path)
    try:
        return camera_from_body(document.camera, provenance_from_body(document.provenance))
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def _sensor(data: bytes, path: Path) -> SensorCalibration:
    document = validated_document(SensorDocument, SENSOR_SCHEMA, data, path)
    try:
        return sensor_from_document(document)
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def validated_document(kind: type[D], schema: str, data: bytes, path: Path) -> D:
    """Check the content of a document against its schema.

    Parameters
    ----------
    kind
        Model of the document.
    schema
        Name that its key ``schema`` must have.
    data, path
        Content and name of the file.

    Raises
    ------
    FileFormatError
        If it is of another kind or a newer version, cut, or a key is missing, unknown or wrong.
    """
    where = str(path)
    content = parse_json(data, where)
    wanted = KINDS[schema]
    found = content.get("schema")
    if found in KINDS and found != schema:
        raise FileFormatError(
            f"this is a {KINDS[found]}, and a {wanted} is needed",
            where=where,
            remedy=f"name the file that `armscan {WRITERS[schema]}` wrote",
        )
    if found != schema:
        raise FileFormatError(
            f"this is not a {wanted} of armscan",
            where=where,
            remedy=f"name the file that `armscan {WRITERS[schema]}` wrote",
        )
    version = content.get("schema_version")
    if isinstance(version, int) and version > SCHEMA_VERSION:
        raise FileFormatError(
            f"the file has schema version {version}, and this program reads up to {SCHEMA_VERSION}",
            where=where,
            remedy="update armscan",
        )
    try:
        return kind.model_validate_json(data.removeprefix(BYTE_ORDER_MARK), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise FileFormatError(
            f"the {wanted} is not valid at '{key}': {first['msg'].lower()}",
            where=where,
            remedy="use the file as it was written, or make it anew",
        ) from error


def observations_body(observations: tuple[str, bytes] | None) -> ObservationsBody | None:
    """Body that names a file of observations and its hash; None for None."""
    if observations is None:
        return None
    name, content = observations
    return ObservationsBody(file=name, sha256=hashlib.sha256(content).hexdigest())


def stereo_document(
    calibration: StereoCalibration, observations: tuple[str, bytes] | None = None
) -> bytes:
    """Text of ``stereo.json``.

    Parameters
    ----------
    calibration
        What to write.
    observations
        Name and content of the file of observations beside it.
    """
    document = StereoDocument(
        schema=STEREO_SCHEMA,
        left=camera_body(calibration.left),
        right=camera_body(calibration.right),
        right_from_sensor=right_pose_body(calibration.right_from_left),
        covariance=covariance_body(STEREO_PARAMETER_NAMES, calibration.covariance),
        rms_px=calibration.rms_px,
        n_pairs=calibration.n_pairs,
        n_points=calibration.n_points,
        diagnostics=_diagnostics_body(calibration.diagnostics),
        observations=observations_body(observations),
        provenance=provenance_body(calibration.provenance),
    )
    return json_bytes(document.model_dump(mode="json", by_alias=True))


def read_stereo_calibration(path: Path) -> StereoCalibration:
    """Read ``stereo.json``.

    Raises
    ------
    FileFormatError
        If the file is cut, of another kind, of a newer version, or holds values that cannot be.
    """
    document = validated_document(StereoDocument, STEREO_SCHEMA, read_bytes(path), path)
    try:
        provenance = provenance_from_body(document.provenance)
        return StereoCalibration(
            left=camera_from_body(document.left, provenance),
            right=camera_from_body(document.right, provenance),
            right_from_left=right_pose_from_body(document.right_from_sensor),
            covariance=covariance_from_body(document.covariance, STEREO_PARAMETER_NAMES),
            rms_px=document.rms_px,
            n_pairs=document.n_pairs,
            n_points=document.n_points,
            provenance=provenance,
            diagnostics=_diagnostics(document.diagnostics),
        )
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def _diagnostics_body(known: StereoDiagnostics | None) -> StereoDiagnosticsBody | None:
    if known is None:
        return None
    return StereoDiagnosticsBody(
        epipolar_rms_px=known.epipolar_rms_px,
        epipolar_mean_px=known.epipolar_mean_px,
        left_out=tuple(LeftOutBody(images=name, reason=why) for name, why in known.left_out),
        intrinsics=known.intrinsics,
        hold_out_rms_px=known.hold_out_rms_px,
        typical_level=known.typical_level,
        target_error_mm=known.target_error_mm,
    )


def _diagnostics(body: StereoDiagnosticsBody | None) -> StereoDiagnostics | None:
    if body is None:
        return None
    return StereoDiagnostics(
        epipolar_rms_px=body.epipolar_rms_px,
        epipolar_mean_px=body.epipolar_mean_px,
        left_out=tuple((item.images, item.reason) for item in body.left_out),
        intrinsics=body.intrinsics,
        hold_out_rms_px=body.hold_out_rms_px,
        typical_level=body.typical_level,
        target_error_mm=body.target_error_mm,
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


class TransformBody(Body):
    """``common_from_own`` of one scan, and how well its markers fit."""

    name: str = Field(min_length=1)
    markers: str
    own_frame: str
    rotation_rows: tuple[Triple, Triple, Triple]
    translation_mm: Triple
    covariance: CovarianceBody
    n_markers: int = Field(ge=0)
    rms_mm: KnownOrNot
    cloud: str | None = None


class ResidualBody(Body):
    """One marker of one scan against where it is in the common frame."""

    name: str
    id: int
    common_id: int
    residual_mm: Triple
    is_used: bool


class MovedBody(Body):
    """A marker that is not where the others say: its numbers and by how much, common frame."""

    id: int
    common_id: int
    offset_mm: Triple


class NotJoinedBody(Body):
    """A scan that could not be joined."""

    name: str
    reason: str


class RegistrationDocument(Body):
    """``registration.json``."""

    schema_name: Literal["armscan/registration"] = Field(alias="schema")
    schema_version: Literal[1] = SCHEMA_VERSION
    kind: Literal["views", "moved arm"]
    simulated: bool
    common_frame: str
    common_frame_of: str
    transforms: tuple[TransformBody, ...]
    residuals: tuple[ResidualBody, ...]
    moved: tuple[MovedBody, ...]
    not_joined: tuple[NotJoinedBody, ...]
    chi2: float = Field(ge=0)
    degrees_of_freedom: int
    provenance: ProvenanceBody


def transform_body(
    name: str,
    markers: Path,
    own_frame: str,
    pose: Pose[Any, Any],
    covariance: FloatArray,
    *,
    n_markers: int,
    rms_mm: float,
    cloud: str | None,
) -> TransformBody:
    """Body of one scan's transform; covariance (6, 6) of `REGISTRATION_PARAMETERS`."""
    first, second, third = (triple(row) for row in pose.rotation)
    return TransformBody(
        name=name,
        markers=markers.as_posix(),
        own_frame=own_frame,
        rotation_rows=(first, second, third),
        translation_mm=triple(pose.translation_mm),
        covariance=covariance_body(REGISTRATION_PARAMETERS, covariance),
        n_markers=n_markers,
        rms_mm=rms_mm,
        cloud=cloud,
    )


def registration_document(document: RegistrationDocument) -> bytes:
    """Text of ``registration.json``."""
    return json_bytes(document.model_dump(mode="json", by_alias=True))


def read_registration(path: Path) -> RegistrationDocument:
    """Read ``registration.json``.

    Raises
    ------
    FileFormatError
        If the file is cut, of another kind, of a newer version, or holds values that cannot be.
    """
    return validated_document(RegistrationDocument, REGISTRATION_SCHEMA, read_bytes(path), path)
