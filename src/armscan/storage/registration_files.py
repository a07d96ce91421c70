# SPDX-License-Identifier: Apache-2.0
"""``registration.json``: how scans were joined by markers, exact, written once."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.registration import REGISTRATION_PARAMETERS
from armscan.storage.calibration_bodies import covariance_body, triple
from armscan.storage.calibration_files import validated_document
from armscan.storage.calibration_schema import (
    REGISTRATION_SCHEMA,
    SCHEMA_VERSION,
    Body,
    CovarianceBody,
    KnownOrNot,
    ProvenanceBody,
    Triple,
)
from armscan.storage.images import read_bytes
from armscan.storage.json_text import json_bytes


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
