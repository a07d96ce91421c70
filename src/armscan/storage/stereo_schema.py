# SPDX-License-Identifier: Apache-2.0
"""The keys of ``stereo.json``, schema version 1; every key carries its frame or unit."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from armscan.storage.calibration_schema import (
    SCHEMA_VERSION,
    Body,
    CameraBody,
    CovarianceBody,
    ObservationsBody,
    ProvenanceBody,
    RightPoseBody,
)


class LeftOutBody(Body):
    """Images that do not tell where the cameras are to each other."""

    images: str
    reason: str


class StereoDiagnosticsBody(Body):
    """Evidence of a stereo calibration."""

    epipolar_rms_px: float
    epipolar_mean_px: float
    left_out: tuple[LeftOutBody, ...]
    intrinsics: Literal["free", "prior", "fixed"]
    hold_out_rms_px: float | None
    typical_level: float
    target_error_mm: float


class StereoDocument(Body):
    """``stereo.json``."""

    schema_name: Literal["armscan/stereo-calibration"] = Field(alias="schema")
    schema_version: Literal[1] = SCHEMA_VERSION
    left: CameraBody
    right: CameraBody
    right_from_sensor: RightPoseBody
    covariance: CovarianceBody
    rms_px: float
    n_pairs: int = Field(ge=0)
    n_points: int = Field(ge=0)
    diagnostics: StereoDiagnosticsBody | None
    observations: ObservationsBody | None = None
    provenance: ProvenanceBody
