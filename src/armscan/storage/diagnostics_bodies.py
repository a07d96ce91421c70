# SPDX-License-Identifier: Apache-2.0
"""Between a calibration's diagnostics in memory and their bodies in documents."""

from __future__ import annotations

from typing import TypeVar

from armscan.models.diagnostics import (
    BowedBoard,
    CameraDiagnostics,
    FTest,
    SensorDiagnostics,
    SheetDiagnostics,
)
from armscan.storage.calibration_schema import (
    Body,
    BowedBoardBody,
    CameraDiagnosticsBody,
    FTestBody,
    SensorDiagnosticsBody,
    SheetDiagnosticsBody,
)

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
    return SensorDiagnostics(body.noise_factor, body.correlation_points, body.naming)


def _bowed_board(body: BowedBoardBody | None) -> BowedBoard | None:
    return None if body is None else BowedBoard(body.bow_mm, body.sigma_mm, _test(body.test))


def _test(body: FTestBody) -> FTest:
    return FTest(body.f_ratio, body.degrees_of_freedom, body.p_value)
