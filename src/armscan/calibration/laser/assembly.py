# SPDX-License-Identifier: Apache-2.0
"""The joint fit of all sheets, and the evidence of every image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.laser.cameras import N_CAMERA, HeadCameras
from armscan.calibration.laser.conditioning import geometry_warnings, refuse_loose_tilt
from armscan.calibration.laser.coplanarity import CommonPlane, PosedSighting, fit_common_plane
from armscan.calibration.laser.misfit import find_misfit_image
from armscan.calibration.laser.naming import NamedStripes, board_numbers
from armscan.calibration.laser.observations import SheetObservations
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.planes import compare_planes
from armscan.calibration.laser.result import (
    LaserFit,
    PointUse,
    SheetFit,
    SheetImage,
    SheetPointCheck,
)
from armscan.calibration.laser.sheet_model import SheetModel, sheet_geometry
from armscan.calibration.laser.sightings import BoardImage
from armscan.calibration.laser.solve import CommonErrors, SheetSolution, solve_sheets
from armscan.calibration.laser.stored_points import check_points
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import SheetCalibration

NOTED_FACTOR = 1.5
"""Scatter of boards over its claim from which on it is told."""


@dataclass(frozen=True, slots=True, eq=False)
class SheetCase:
    """Everything that the joint fit rests on.

    Parameters
    ----------
    images
        Stripe points on their boards.
    named
        The sheet of each straight stripe.
    observations
        All named points, their sigmas raised or lowered to their stripe's own scatter.
    scatter
        (N,) factor by which they were.
    kept
        (N,) False for points that are too far from their sheet.
    models
        The model of each sheet.
    errors
        Covariance of boards and camera.
    cameras
        The cameras.
    options
        In force.
    """

    images: Sequence[BoardImage]
    named: NamedStripes
    observations: SheetObservations
    scatter: FloatArray
    kept: BoolArray
    models: Sequence[SheetModel]
    errors: CommonErrors
    cameras: HeadCameras
    options: SheetOptions


@dataclass(frozen=True, slots=True)
class LooseSheet:
    """A sheet whose direction its boards leave open."""

    sheet: int
    failure: FitFailure


def assemble_fit(case: SheetCase) -> LaserFit | FitFailure | LooseSheet:
    """Solve all sheets together and put the result into words and numbers.

    Where the final lack-of-fit test of a sheet fails, its stripes' sigmas have been raised: what
    the model does not explain must not make the sheet look better known.
    """
    models, used = case.models, case.observations.select(case.kept)
    is_bowed = [model.is_bowed for model in models]
    factors = np.array([model.sigma_factor for model in models])
    solution = solve_sheets(
        used,
        [model.sheet for model in models],
        case.errors.with_boards(max(model.board_factor for model in models)),
        is_bowed,
        sigma_factor=factors[used.sheet],
        are_cameras_held=True,
    )
    if isinstance(solution, FitFailure):
        return solution
    points = check_points(
        used,
        solution,
        noise_px=_noise_px(case),
        images=case.images,
        cameras=case.cameras,
    )
    sheets = []
    for k in range(len(models)):
        fit = _sheet_fit(k, case, solution, points[k])
        if isinstance(fit, FitFailure):
            return LooseSheet(k, fit)
        sheets.append(fit)
    warnings = list(case.named.warnings)
    if not solution.has_converged:
        warnings.append(
            f"the fit of the sheets has not settled: its last step was "
            f"{solution.last_step_sigma:.2g} of a parameter's sigma; look at the boards' poses"
        )
    for name, model in zip(case.named.names, models, strict=True):
        raised = model.sigma_factor / model.noise.sigma_factor
        if raised > 1.0:
            warnings.append(
                f"sheet {name}: its model does not explain the stripes within their noise and the "
                f"boards' errors; the stripes' sigmas are taken {raised:.1f} times larger"
            )
        if model.board_factor > NOTED_FACTOR:
            warnings.append(
                f"sheet {name}: the boards err {model.board_factor:.1f} times as much as their "
                "targets' points say: they may be bent, or the camera's lens is not as calibrated"
            )
    if not case.cameras.has_covariance:
        warnings.append(
            "the camera came without covariance: the sheets' sigmas leave its errors out"
        )
    return LaserFit(
        tuple(sheets),
        _image_evidence(case, solution),
        case.cameras.left,
        _with_second_last(solution.covariance, case.cameras.n_parameters),
        max(_noise_factor(k, case) for k in range(len(models))),
        max(model.noise.correlation_points for model in models),
        case.named.how,
        case.options,
        tuple(warnings),
        second=case.cameras.second,
    )


def _with_second_last(covariance: FloatArray, n_camera: int) -> FloatArray:
    """From the order cameras, sheets to that of a sensor: left camera, sheets, second camera."""
    order = np.arange(len(covariance))
    order = np.concatenate([order[:N_CAMERA], order[n_camera:], order[N_CAMERA:n_camera]])
    return np.asarray(covariance[np.ix_(order, order)])


def _noise_px(case: SheetCase) -> FloatArray:
    """(N,) scatter of the single points used around their stripes."""
    used = case.observations.select(case.kept)
    factors = np.array([model.noise.factor for model in case.models])
    return np.asarray(used.sigma_px * factors[used.sheet])


def _sheet_fit(
    k: int, case: SheetCase, solution: SheetSolution, points_made: SheetPointCheck
) -> SheetFit | FitFailure:
    images, named, model = case.images, case.named, case.models[k]
    used = case.observations.select(case.kept)
    own = used.sheet == k
    points, sheet = used.points_mm[own], solution.sheets[k]
    start = case.cameras.n_parameters + 8 * k
    covariance = solution.covariance[start : start + 8, start : start + 8]
    geometry = sheet_geometry(sheet, used.select(own), images)
    tilt_variance = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    tilt_sigma_deg = float(np.degrees(np.sqrt(max(tilt_variance, 0.0)) / sheet.scale_mm))
    loose = refuse_loose_tilt(named.names[k], geometry, tilt_sigma_deg)
    if loose is not None:
        return loose
    common = _common_plane(k, case)
    stripes = _stripes_of(used.select(own))
    warnings = geometry_warnings(geometry, common, tilt_sigma_deg)
    if model.plane_test.p_value < case.options.lack_of_fit_p:
        misfit = find_misfit_image(used.select(own), sheet, case.errors, case.options)
        if misfit is not None:
            warnings = (*warnings, _misfit_warning(images[misfit].data.profile.source))
    return SheetFit(
        SheetCalibration(
            named.names[k],
            sheet,
            float(np.sqrt((solution.height_mm[own] ** 2).mean())),
            geometry.n_boards,
            int(own.sum()),
            geometry.depth_range_mm,
            geometry.n_boards > 2,
        ),
        covariance,
        float(np.sqrt((solution.residual_px[own] ** 2).mean())),
        model.plane_test,
        model.final_test,
        model.decision,
        tilt_sigma_deg,
        float(np.sqrt(covariance[2, 2])),
        common.largest_mm if common else 0.0,
        common.sigma_largest_mm if common else 0.0,
        geometry.board_angle_deg,
        compare_planes(sheet, points, images, stripes, case.cameras),
        warnings,
        points_made,
    )


def _noise_factor(k: int, case: SheetCase) -> float:
    """Scatter of one sheet's points over what the stripe extraction claimed."""
    own = case.kept & (case.observations.sheet == k)
    return case.models[k].noise.factor * float(np.sqrt((case.scatter[own] ** 2).mean()))


def _misfit_warning(source: str) -> str:
    return (
        f"a plane explains all boards but the one in {source}: check that its images belong "
        "together and that the board was found rightly, or leave it out"
    )


def _common_plane(k: int, case: SheetCase) -> CommonPlane | None:
    # Not the raised sigmas: they would explain away the very misfit that is to be shown.
    factor = case.models[k].noise.sigma_factor
    members = []
    for i, (image, sheets) in enumerate(zip(case.images, case.named.sheets, strict=True)):
        for sighting, sheet in zip(image.sightings, sheets, strict=True):
            if sheet != k:
                continue
            first = (case.observations.image == i) & (case.observations.row == sighting.rows[0])
            level = factor * float(case.scatter[first][0])
            members.append(
                PosedSighting(
                    replace(sighting, noise_ends_mm2=sighting.noise_ends_mm2 * level**2),
                    image.placed.covariance,
                    case.cameras.covariance,
                )
            )
    common = fit_common_plane(members)
    return None if isinstance(common, FitFailure) else common


def _stripes_of(own: SheetObservations) -> list[tuple[int, IntArray]]:
    return [
        (int(own.image[own.stripe == s][0]), own.row[own.stripe == s])
        for s in np.unique(own.stripe)
    ]


def _image_evidence(case: SheetCase, solution: SheetSolution) -> tuple[SheetImage, ...]:
    observations, kept = case.observations, case.kept
    height, residual, _, _ = observations.residuals_px(solution.sheets)
    remaining = np.full(len(observations), np.nan)
    remaining[kept] = solution.remaining_px
    boards = board_numbers(case.images)
    evidence = []
    for i, image in enumerate(case.images):
        own = observations.image == i
        rows = observations.row[own]
        n = len(image.data.profile)
        use, sheet = image.use.copy(), np.full(n, -1)
        use[rows] = np.where(kept[own], int(PointUse.USED), int(PointUse.OFF_SHEET))
        sheet[rows] = observations.sheet[own]
        columns = np.full((3, n), np.nan)
        columns[:, rows] = height[own], residual[own], remaining[own]
        evidence.append(
            SheetImage(
                image.data.profile,
                image.data.view,
                image.placed.sensor_from_board,
                use,
                sheet,
                image.points.points_mm,
                columns[0],
                columns[1],
                columns[2],
                float(np.linalg.norm(solution.common[6 * boards[i] : 6 * boards[i] + 6])),
            )
        )
    return tuple(evidence)
