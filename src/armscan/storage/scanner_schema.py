# SPDX-License-Identifier: Apache-2.0
"""The keys of ``scanner.json``, schema version 1; every key carries its frame or unit."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from armscan.storage.calibration_schema import (
    SCHEMA_VERSION,
    Body,
    CovarianceBody,
    KnownOrNot,
    ObservationsBody,
    ProvenanceBody,
    SensorDocument,
    Triple,
)


class PoseBody(Body):
    """The Sensor frame seen in Tool: rows of a rotation matrix, and the origin."""

    rotation_rows: tuple[Triple, Triple, Triple]
    translation_tool_mm: Triple


class CouplingBody(Body):
    """Derivative of the hand-eye's parameters (rows) by the sensor's (columns)."""

    row_names: tuple[str, ...]
    column_names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class ArmNoiseBody(Body):
    """Standard deviations of the arm's reported pose, an axis."""

    position_mm: float = Field(ge=0)
    rotation_rad: float = Field(ge=0)
    exposure_position_mm: float = Field(ge=0)
    exposure_rotation_rad: float = Field(ge=0)


class PlateBody(Body):
    """A plane in Base: a point and three unit vectors, the last of them the normal."""

    point_base_mm: Triple
    along_base: Triple
    across_base: Triple
    normal_base: Triple


class HandEyeDiagnosticsBody(Body):
    """Evidence of a hand-eye calibration."""

    method: Literal["plate", "sphere"]
    rank: int = Field(ge=0, le=6)
    condition: KnownOrNot
    weakest: str
    plate_flatness_mm: KnownOrNot
    flatness_length_mm: KnownOrNot
    is_noise_estimated: bool
    left_out_rotation_deg: KnownOrNot
    left_out_translation_mm: KnownOrNot
    chi2_probability: KnownOrNot


class HandEyeBody(Body):
    """Where the sensor sits on the arm."""

    tool_from_sensor: PoseBody
    covariance: CovarianceBody
    sensor_coupling: CouplingBody | None
    arm_noise: ArmNoiseBody
    rms_mm: KnownOrNot
    n_postures: int = Field(ge=0)
    n_exposures: int = Field(ge=0)
    n_points: int = Field(ge=0)
    plate: PlateBody | None
    diagnostics: HandEyeDiagnosticsBody | None


class ScannerDocument(Body):
    """``scanner.json``; ``sensor`` is null for a sensor that delivers points itself."""

    schema_name: Literal["armscan/scanner-calibration"] = Field(alias="schema")
    schema_version: Literal[1] = SCHEMA_VERSION
    sensor: SensorDocument | None
    hand_eye: HandEyeBody
    latency_ns: int = Field(ge=-(10**12), le=10**12)
    observations: ObservationsBody | None = None
    provenance: ProvenanceBody
