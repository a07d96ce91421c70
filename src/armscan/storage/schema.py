# SPDX-License-Identifier: Apache-2.0
"""The keys of calibration documents, schema version 1; every key carries its frame or unit."""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from armscan.vision.stripe.image import LaserColour

SCHEMA_VERSION: Final = 1
CAMERA_SCHEMA: Final = "armscan/camera-calibration"
SENSOR_SCHEMA: Final = "armscan/sensor-calibration"
SCANNER_SCHEMA: Final = "armscan/scanner-calibration"
STEREO_SCHEMA: Final = "armscan/stereo-calibration"
REGISTRATION_SCHEMA: Final = "armscan/registration"


def _nan_from_null(value: object) -> object:
    return math.nan if value is None else value


def _null_if_unknown(value: float) -> float | None:
    return value if math.isfinite(value) else None


KnownOrNot = Annotated[
    float,
    Field(allow_inf_nan=True),
    BeforeValidator(_nan_from_null),
    PlainSerializer(_null_if_unknown, return_type=float | None),
]
"""A figure that is not known, as of a foreign calibration: ``null`` in the file, NaN in the
program."""

Bounded = Annotated[float, Field(ge=-1e7, le=1e7)]
"""Lengths in mm, pixels and coefficients beyond this are damage: they overflow later."""

Triple = tuple[Bounded, Bounded, Bounded]


class Body(BaseModel):
    """Part of a document: unknown keys, NaN and wrong types are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class InputFileBody(Body):
    """A file that went in."""

    path: str
    sha256: str


class ProvenanceBody(Body):
    """How the document came to be."""

    document_id: str
    created_utc: str
    armscan_version: str
    command: tuple[str, ...]
    inputs: tuple[InputFileBody, ...]
    parent_ids: tuple[str, ...]
    options: dict[str, str]
    warnings: tuple[str, ...]
    forced: tuple[str, ...] = ()

    @model_serializer(mode="wrap")
    def _without_empty_mark(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only a document that was refused bears the mark; older programs refuse to read it."""
        content: dict[str, Any] = write(self)
        if not self.forced:
            del content["forced"]
        return content


class ObservationsBody(Body):
    """The file beside the document that holds what is needed to solve again."""

    file: str
    sha256: str


class IntrinsicsBody(Body):
    """The camera model of the full sensor."""

    model: Literal["pinhole k1 k2 p1 p2 k3"] = "pinhole k1 k2 p1 p2 k3"
    pixel_origin: Literal["centre of the top-left pixel"] = "centre of the top-left pixel"
    width_px: int = Field(ge=1)
    height_px: int = Field(ge=1)
    fx_px: Bounded = Field(gt=0)
    fy_px: Bounded = Field(gt=0)
    cx_px: Bounded
    cy_px: Bounded
    k1: Bounded
    k2: Bounded
    p1: Bounded
    p2: Bounded
    k3: Bounded


class CovarianceBody(Body):
    """A covariance with the names of its rows; the unit of an entry follows from the names."""

    parameter_names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class CoveredBody(Body):
    """The part of the image that the points covered."""

    x_min_px: float
    y_min_px: float
    x_max_px: float
    y_max_px: float


class FTestBody(Body):
    """An F test."""

    f_ratio: KnownOrNot
    degrees_of_freedom: int = Field(ge=0)
    p_value: KnownOrNot


class BowedBoardBody(Body):
    """Bow of the target along x and y, solved with the camera."""

    bow_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    test: FTestBody


class CameraDiagnosticsBody(Body):
    """Evidence of a camera's calibration."""

    free_parameters: tuple[str, ...]
    model_reason: str
    hold_out_rms_px: float | None
    n_folds: int = Field(ge=0)
    condition: KnownOrNot
    noise_scale: float
    covered_fraction: float
    board: BowedBoardBody | None


class SheetDiagnosticsBody(Body):
    """Evidence of one light sheet."""

    rms_px: float
    plane_test: FTestBody
    final_test: FTestBody
    bow_decision: str
    coplanarity_mm: float
    coplanarity_sigma_mm: float
    board_angle_deg: float


class SensorDiagnosticsBody(Body):
    """Evidence of all light sheets together."""

    noise_factor: float
    correlation_points: float
    naming: str


class CameraBody(Body):
    """A camera with its uncertainty."""

    intrinsics: IntrinsicsBody
    has_covariance: bool
    covariance: CovarianceBody
    rms_px: KnownOrNot
    sigma_point_px: KnownOrNot
    n_views: int = Field(ge=0)
    n_points: int = Field(ge=0)
    valid_region: CoveredBody
    diagnostics: CameraDiagnosticsBody | None


class AxesBody(Body):
    """Unit vectors of the sheet in the Sensor frame."""

    u_sensor: Triple
    v_sensor: Triple
    normal_sensor: Triple


class FanBody(Body):
    """How the light of a sheet spreads, without unit; see `LightSheet`."""

    lean: float
    spread: float


class SheetBody(Body):
    """A light sheet ``n.(p - o) = sum(bow[i, j] u^i v^j)`` in the Sensor frame.

    The fan is there only for a sheet whose bow follows the light's rays, see `LightSheet`.
    """

    name: str = Field(min_length=1)
    origin_sensor_mm: Triple
    axes: AxesBody
    scale_mm: float = Field(gt=0)
    bow_mm: dict[str, float]
    fan: FanBody | None = None
    rms_mm: KnownOrNot
    n_boards: int = Field(ge=0)
    n_points: int = Field(ge=0)
    depth_min_sensor_mm: float
    depth_max_sensor_mm: float
    is_redundant: bool
    diagnostics: SheetDiagnosticsBody | None

    @model_serializer(mode="wrap")
    def _without_absent_fan(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Sheets without it keep the document that they always had."""
        content: dict[str, Any] = write(self)
        if self.fan is None:
            del content["fan"]
        return content


class RightPoseBody(Body):
    """``p_right = R p_sensor + t`` (eqs. 4.3 to 4.5), the rotation by its rows."""

    rotation_rows: tuple[Triple, Triple, Triple]
    translation_right_mm: Triple


class SecondCameraBody(Body):
    """The right camera of a stereo head, and where the Sensor frame lies in its own."""

    camera: CameraBody
    camera_provenance: ProvenanceBody
    right_from_sensor: RightPoseBody


class CameraDocument(Body):
    """``camera.json``."""

    schema_name: Literal["armscan/camera-calibration"] = Field(alias="schema")
    schema_version: Literal[1] = SCHEMA_VERSION
    camera: CameraBody
    observations: ObservationsBody | None = None
    provenance: ProvenanceBody


class SensorDocument(Body):
    """``sensor.json``.

    ``second`` is there only for a head of two cameras, ``laser_colour`` only where a channel of
    colour images was chosen.
    """

    schema_name: Literal["armscan/sensor-calibration"] = Field(alias="schema")
    schema_version: Literal[1] = SCHEMA_VERSION
    camera: CameraBody
    camera_provenance: ProvenanceBody
    sheets: tuple[SheetBody, ...] = Field(min_length=1)
    covariance: CovarianceBody
    diagnostics: SensorDiagnosticsBody | None
    second: SecondCameraBody | None = None
    laser_colour: LaserColour = "auto"
    observations: ObservationsBody | None = None
    provenance: ProvenanceBody

    @model_serializer(mode="wrap")
    def _without_what_is_absent(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Heads of one grey camera keep the document that they always had."""
        content: dict[str, Any] = write(self)
        if self.second is None:
            del content["second"]
        if self.laser_colour == "auto":
            del content["laser_colour"]
        return content


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
