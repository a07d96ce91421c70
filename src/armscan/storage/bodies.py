# SPDX-License-Identifier: Apache-2.0
"""Between calibrations in memory and the bodies of their documents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import CameraRight, Pose, Sensor
from armscan.models.calibration import (
    CameraCalibration,
    CameraDiagnostics,
    FTest,
    InputFile,
    Provenance,
    SecondCamera,
    SensorCalibration,
    SensorDiagnostics,
    SheetCalibration,
    SheetDiagnostics,
    WarpedBoard,
)
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.models.light_sheet import BOW_TERMS, LightSheet
from armscan.storage.schema import (
    SENSOR_SCHEMA,
    AxesBody,
    Body,
    BowedBoardBody,
    CameraBody,
    CameraDiagnosticsBody,
    CovarianceBody,
    CoveredBody,
    FanBody,
    FTestBody,
    InputFileBody,
    IntrinsicsBody,
    ObservationsBody,
    ProvenanceBody,
    RightPoseBody,
    SecondCameraBody,
    SensorDiagnosticsBody,
    SensorDocument,
    SheetBody,
    SheetDiagnosticsBody,
    Triple,
)
from armscan.vision.stripe.image import LaserColour

B = TypeVar("B", bound=Body)


def diagnostics_body(
    known: CameraDiagnostics | SheetDiagnostics | SensorDiagnostics | None, kind: type[B]
) -> B | None:
    """Body of diagnostics; its keys are the names of their fields."""
    return None if known is None else kind.model_validate(known, from_attributes=True)


def camera_diagnostics(body: CameraDiagnosticsBody | None) -> CameraDiagnostics | None:
    """Camera's diagnostics from their body."""
    if body is None:
        return None
    return CameraDiagnostics(
        free_parameters=body.free_parameters,
        model_reason=body.model_reason,
        hold_out_rms_px=body.hold_out_rms_px,
        n_folds=body.n_folds,
        condition=body.condition,
        noise_scale=body.noise_scale,
        covered_fraction=body.covered_fraction,
        board=_bowed_board(body.board),
    )


def sheet_diagnostics(body: SheetDiagnosticsBody | None) -> SheetDiagnostics | None:
    """One sheet's diagnostics from their body."""
    if body is None:
        return None
    return SheetDiagnostics(
        rms_px=body.rms_px,
        plane_test=_test(body.plane_test),
        final_test=_test(body.final_test),
        bow_decision=body.bow_decision,
        coplanarity_mm=body.coplanarity_mm,
        coplanarity_sigma_mm=body.coplanarity_sigma_mm,
        board_angle_deg=body.board_angle_deg,
    )


def sensor_diagnostics(body: SensorDiagnosticsBody | None) -> SensorDiagnostics | None:
    """Diagnostics of all sheets together from their body."""
    if body is None:
        return None
    return SensorDiagnostics(
        noise_factor=body.noise_factor,
        correlation_points=body.correlation_points,
        naming=body.naming,
    )


def _bowed_board(body: BowedBoardBody | None) -> WarpedBoard | None:
    return None if body is None else WarpedBoard(body.bow_mm, body.sigma_mm, _test(body.test))


def _test(body: FTestBody) -> FTest:
    return FTest(body.f_ratio, body.degrees_of_freedom, body.p_value)


BOW_KEYS = tuple(f"u{i}_v{j}" for i, j in BOW_TERMS)
SYMMETRY_TOLERANCE = 1e-9


def camera_body(calibration: CameraCalibration) -> CameraBody:
    """Body of a camera's calibration, without its provenance."""
    camera = calibration.camera
    values = dict(zip(PARAMETER_NAMES, camera.parameters.tolist(), strict=True))
    low_x, low_y, high_x, high_y = calibration.covered_px.tolist()
    return CameraBody(
        intrinsics=IntrinsicsBody(width_px=camera.width_px, height_px=camera.height_px, **values),
        has_covariance=calibration.has_covariance,
        covariance=covariance_body(PARAMETER_NAMES, calibration.covariance),
        rms_px=calibration.rms_px,
        sigma_point_px=calibration.sigma_point_px,
        n_views=calibration.n_views,
        n_points=calibration.n_points,
        valid_region=CoveredBody(x_min_px=low_x, y_min_px=low_y, x_max_px=high_x, y_max_px=high_y),
        diagnostics=diagnostics_body(calibration.diagnostics, CameraDiagnosticsBody),
    )


def camera_from_body(body: CameraBody, provenance: Provenance) -> CameraCalibration:
    """Camera calibration from its body."""
    inner = body.intrinsics
    region = body.valid_region
    return CameraCalibration(
        camera=CameraModel.from_parameters(
            [getattr(inner, name) for name in PARAMETER_NAMES], inner.width_px, inner.height_px
        ),
        covariance=covariance_from_body(body.covariance, PARAMETER_NAMES),
        has_covariance=body.has_covariance,
        rms_px=body.rms_px,
        sigma_point_px=body.sigma_point_px,
        n_views=body.n_views,
        n_points=body.n_points,
        covered_px=np.array([region.x_min_px, region.y_min_px, region.x_max_px, region.y_max_px]),
        provenance=provenance,
        diagnostics=camera_diagnostics(body.diagnostics),
    )


def sensor_document_of(
    calibration: SensorCalibration, observations: ObservationsBody | None
) -> SensorDocument:
    """Document of a sensor's calibration."""
    return SensorDocument(
        schema=SENSOR_SCHEMA,
        camera=camera_body(calibration.camera),
        camera_provenance=provenance_body(calibration.camera.provenance),
        sheets=tuple(_sheet_body(sheet) for sheet in calibration.sheets),
        covariance=covariance_body(calibration.parameter_names, calibration.covariance),
        diagnostics=diagnostics_body(calibration.diagnostics, SensorDiagnosticsBody),
        second=None if calibration.second is None else second_camera_body(calibration.second),
        laser_colour=cast(LaserColour, calibration.laser_colour),
        observations=observations,
        provenance=provenance_body(calibration.provenance),
    )


def sensor_from_document(document: SensorDocument) -> SensorCalibration:
    """Sensor calibration from its document."""
    camera = camera_from_body(document.camera, provenance_from_body(document.camera_provenance))
    sheets = tuple(_sheet_from_body(body) for body in document.sheets)
    second = None if document.second is None else second_camera_from_body(document.second)
    size = len(document.covariance.parameter_names)
    empty = SensorCalibration(
        camera=camera,
        sheets=sheets,
        covariance=np.zeros((size, size)),
        provenance=provenance_from_body(document.provenance),
        diagnostics=sensor_diagnostics(document.diagnostics),
        second=second,
        laser_colour=document.laser_colour,
    )
    covariance = covariance_from_body(document.covariance, empty.parameter_names)
    return replace(empty, covariance=covariance)


def second_camera_body(second: SecondCamera) -> SecondCameraBody:
    """Body of a stereo head's right camera."""
    return SecondCameraBody(
        camera=camera_body(second.camera),
        camera_provenance=provenance_body(second.camera.provenance),
        right_from_sensor=right_pose_body(second.right_from_sensor),
    )


def second_camera_from_body(body: SecondCameraBody) -> SecondCamera:
    """Right camera of a stereo head from its body."""
    provenance = provenance_from_body(body.camera_provenance)
    pose = right_pose_from_body(body.right_from_sensor)
    return SecondCamera(camera_from_body(body.camera, provenance), pose)


def right_pose_body(pose: Pose[CameraRight, Sensor]) -> RightPoseBody:
    """Body of the pose of the left camera in the right one's frame."""
    first, second, third = (triple(row) for row in pose.rotation)
    return RightPoseBody(
        rotation_rows=(first, second, third), translation_right_mm=triple(pose.translation_mm)
    )


def right_pose_from_body(body: RightPoseBody) -> Pose[CameraRight, Sensor]:
    """Pose of the left camera in the right one's frame from its body."""
    return Pose(np.array(body.rotation_rows), np.array(body.translation_right_mm))


def provenance_body(provenance: Provenance) -> ProvenanceBody:
    """Body of a provenance."""
    return ProvenanceBody(
        document_id=provenance.document_id,
        created_utc=provenance.created_utc,
        armscan_version=provenance.armscan_version,
        command=provenance.command,
        inputs=tuple(
            InputFileBody(path=item.path, sha256=item.sha256) for item in provenance.inputs
        ),
        parent_ids=provenance.parent_ids,
        options=dict(provenance.options),
        warnings=provenance.warnings,
        forced=provenance.forced,
    )


def provenance_from_body(body: ProvenanceBody) -> Provenance:
    """Provenance from its body."""
    return Provenance(
        document_id=body.document_id,
        created_utc=body.created_utc,
        armscan_version=body.armscan_version,
        command=body.command,
        inputs=tuple(InputFile(item.path, item.sha256) for item in body.inputs),
        parent_ids=body.parent_ids,
        options=tuple(body.options.items()),
        warnings=body.warnings,
        forced=body.forced,
    )


def _sheet_body(calibration: SheetCalibration) -> SheetBody:
    sheet = calibration.sheet
    low, high = calibration.depth_range_mm
    return SheetBody(
        name=calibration.name,
        origin_sensor_mm=triple(sheet.origin_mm),
        axes=AxesBody(
            u_sensor=triple(sheet.axes[0]),
            v_sensor=triple(sheet.axes[1]),
            normal_sensor=triple(sheet.axes[2]),
        ),
        scale_mm=sheet.scale_mm,
        bow_mm=dict(zip(BOW_KEYS, sheet.bow_mm.tolist(), strict=True)),
        fan=_fan_body(sheet),
        rms_mm=calibration.rms_mm,
        n_boards=calibration.n_boards,
        n_points=calibration.n_points,
        depth_min_sensor_mm=low,
        depth_max_sensor_mm=high,
        is_redundant=calibration.is_redundant,
        diagnostics=diagnostics_body(calibration.diagnostics, SheetDiagnosticsBody),
    )


def _fan_body(sheet: LightSheet) -> FanBody | None:
    lean, spread = sheet.fan.tolist()
    return FanBody(lean=lean, spread=spread) if lean or spread else None


def _sheet_from_body(body: SheetBody) -> SheetCalibration:
    if set(body.bow_mm) != set(BOW_KEYS):
        raise InputError(f"sheet {body.name} needs the bow terms {', '.join(BOW_KEYS)}")
    axes = np.array([body.axes.u_sensor, body.axes.v_sensor, body.axes.normal_sensor])
    bow = np.array([body.bow_mm[key] for key in BOW_KEYS])
    fan = np.zeros(2) if body.fan is None else np.array([body.fan.lean, body.fan.spread])
    return SheetCalibration(
        name=body.name,
        sheet=LightSheet(
            origin_mm=np.array(body.origin_sensor_mm),
            axes=axes,
            scale_mm=body.scale_mm,
            bow_mm=bow,
            fan=fan,
        ),
        rms_mm=body.rms_mm,
        n_boards=body.n_boards,
        n_points=body.n_points,
        depth_range_mm=(body.depth_min_sensor_mm, body.depth_max_sensor_mm),
        is_redundant=body.is_redundant,
        diagnostics=sheet_diagnostics(body.diagnostics),
    )


def triple(values: FloatArray) -> Triple:
    """Three numbers of an array (3,)."""
    x, y, z = values.tolist()
    return x, y, z


def covariance_body(names: Sequence[str], matrix: FloatArray) -> CovarianceBody:
    """Body of a covariance (P, P) with P names."""
    return CovarianceBody(
        parameter_names=tuple(names), matrix=tuple(tuple(row) for row in matrix.tolist())
    )


def covariance_from_body(body: CovarianceBody, names: Sequence[str]) -> FloatArray:
    """Covariance (P, P) from its body.

    Raises
    ------
    InputError
        If names or size are not those expected, or it is not symmetric with a positive diagonal.
    """
    if body.parameter_names != tuple(names):
        raise InputError("the covariance's parameter names are not those of the model, in order")
    if any(len(row) != len(names) for row in body.matrix) or len(body.matrix) != len(names):
        raise InputError(f"the covariance is not a {len(names)} x {len(names)} matrix")
    matrix = np.array(body.matrix, dtype=np.float64)
    scale = np.sqrt(np.outer(np.abs(np.diag(matrix)), np.abs(np.diag(matrix))))
    if np.diag(matrix).min() < 0.0 or np.any(
        np.abs(matrix - matrix.T) > SYMMETRY_TOLERANCE * (scale + np.abs(matrix))
    ):
        raise InputError("the covariance is not symmetric with a positive diagonal")
    return matrix
