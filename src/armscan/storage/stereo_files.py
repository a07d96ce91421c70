# SPDX-License-Identifier: Apache-2.0
"""``stereo.json``: two calibrated cameras and where they are to each other."""

from __future__ import annotations

from pathlib import Path

from armscan.errors import FileFormatError, InputError
from armscan.models.stereo import STEREO_PARAMETER_NAMES, StereoCalibration, StereoDiagnostics
from armscan.storage.calibration_bodies import (
    camera_body,
    camera_from_body,
    covariance_body,
    covariance_from_body,
    provenance_body,
    provenance_from_body,
    right_pose_body,
    right_pose_from_body,
)
from armscan.storage.calibration_files import observations_body, validated_document
from armscan.storage.calibration_schema import STEREO_SCHEMA
from armscan.storage.images import read_bytes
from armscan.storage.json_text import json_bytes
from armscan.storage.stereo_schema import (
    LeftOutBody,
    StereoDiagnosticsBody,
    StereoDocument,
)


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
