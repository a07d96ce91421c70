# SPDX-License-Identifier: Apache-2.0
"""Calibration documents on disk: JSON, exact, written once."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from armscan.errors import FileFormatError, InputError
from armscan.models.calibration import CameraCalibration, SensorCalibration
from armscan.storage.calibration_bodies import (
    camera_body,
    camera_from_body,
    provenance_body,
    provenance_from_body,
    sensor_document_of,
    sensor_from_document,
)
from armscan.storage.calibration_schema import (
    CAMERA_SCHEMA,
    REGISTRATION_SCHEMA,
    SCANNER_SCHEMA,
    SCHEMA_VERSION,
    SENSOR_SCHEMA,
    STEREO_SCHEMA,
    CameraDocument,
    ObservationsBody,
    SensorDocument,
)
from armscan.storage.foreign_opencv import read_foreign_camera
from armscan.storage.images import read_bytes
from armscan.storage.json_text import json_bytes, parse_json

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
