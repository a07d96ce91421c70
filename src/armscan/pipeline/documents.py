# SPDX-License-Identifier: Apache-2.0
"""From what a fit found to what a calibration document keeps, its evidence included."""

from __future__ import annotations

from armscan.calibration.cameras.result import BoardWarp, CameraFit
from armscan.models.calibration import (
    CameraCalibration,
    CameraDiagnostics,
    FTest,
    Provenance,
    WarpedBoard,
)


def camera_calibration(fit: CameraFit, provenance: Provenance) -> CameraCalibration:
    """The document's content of a fit."""
    return CameraCalibration(
        camera=fit.camera,
        covariance=fit.covariance,
        has_covariance=True,
        rms_px=fit.rms_px,
        sigma_point_px=fit.sigma_point_px,
        n_views=fit.n_views,
        n_points=fit.n_points,
        covered_px=fit.coverage.covered_px,
        provenance=provenance,
        diagnostics=_camera_diagnostics(fit),
    )


def _camera_diagnostics(fit: CameraFit) -> CameraDiagnostics:
    """Diagnostics of a camera's calibration."""
    held_out = fit.cross_validation
    return CameraDiagnostics(
        free_parameters=fit.free_parameters,
        model_reason=fit.model_reason,
        hold_out_rms_px=None if held_out is None else held_out.rms_px,
        n_folds=0 if held_out is None else held_out.n_folds,
        condition=fit.condition,
        noise_scale=fit.noise_scale,
        covered_fraction=fit.coverage.fraction,
        board=None if fit.warp is None else _bowed_board(fit.warp),
    )


def _bowed_board(warp: BoardWarp) -> WarpedBoard:
    bow_x, bow_y = warp.bow_mm.tolist()
    sigma_x, sigma_y = warp.sigma_mm.tolist()
    test = FTest(
        f_ratio=warp.f_statistic, degrees_of_freedom=len(warp.bow_mm), p_value=warp.p_value
    )
    return WarpedBoard((bow_x, bow_y), (sigma_x, sigma_y), test)
