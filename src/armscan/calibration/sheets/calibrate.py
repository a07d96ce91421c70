# SPDX-License-Identifier: Apache-2.0
"""Calibrate light sheets from stripes on boards (thesis 2.3.2.2, eqs. 2.42 to 2.44): observe, vote,
assign, choose each sheet's shape, solve all together, check, and put the result together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from armscan.calibration.cameras.result import is_much_bowed
from armscan.calibration.sheets.board_points import (
    N_CAMERA,
    BoardBow,
    HeadCameras,
    find_bow,
)
from armscan.calibration.sheets.checks import (
    check_points,
    compare_planes,
    estimate_shapes_mm,
    find_outlier_view,
)
from armscan.calibration.sheets.coplanarity import (
    CommonPlane,
    fit_common_plane,
    geometry_warnings,
    refuse_few_boards,
    refuse_underdetermined_tilt,
)
from armscan.calibration.sheets.labels import SheetAssignment, assign_sheets, board_numbers
from armscan.calibration.sheets.model import (
    SheetModel,
    choose_model,
    scatter_by_stripe,
    sheet_geometry,
    start_sheet,
    stripe_noise,
)
from armscan.calibration.sheets.result import (
    LACK_OF_FIT_P,
    BoardStripes,
    LaserFit,
    PointUse,
    SheetFit,
    SheetImage,
    SheetOptions,
    SheetPointCheck,
)
from armscan.calibration.sheets.solve import (
    N_SHEET,
    CommonErrors,
    SheetObservations,
    SheetSolution,
    solve_sheets,
    stack_observations,
)
from armscan.calibration.sheets.stripes_on_board import MIN_POINTS, OUTLIER_SIGMA, BoardImage
from armscan.calibration.sheets.voting import observe_boards
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.models.calibration import (
    CameraCalibration,
    SensorCalibration,
    SensorDiagnostics,
    SheetCalibration,
    SheetDiagnostics,
    without_covariance,
)
from armscan.models.light_sheet import LightSheet
from armscan.models.two_views import StereoCalibration

OUTLIER_ROUNDS = 4
BOARDS_TO_KEEP = 6
"""With their shifts and slopes they tell twelve numbers of a bowed sheet's eight: of four boards, a
bow explains any stray."""
MOST_CAST_OUT = 0.2
"""Share of a stripe's points beyond which these are no outliers, but the stripe lies elsewhere."""
NOTED_FACTOR = 1.5
"""Scatter of boards over its claim from which on it is told."""
LIKELIEST = "; stored with the likeliest of small bows"
STRAY_FACTOR = 2.5
"""Scatter of a board over that of the others from which on it is named: it then has less than a
sixth of their weight."""


@dataclass(frozen=True, slots=True)
class _Refused:
    """One sheet that its boards do not determine."""

    sheet: int
    failure: FitFailure


def calibrate_sheets(
    boards: Sequence[BoardStripes],
    camera: CameraCalibration | StereoCalibration | SensorCalibration,
    options: SheetOptions | None = None,
) -> LaserFit | FitFailure:
    """Calibrate one or several light sheets that lie on boards of known pose.

    The stripe points are carried to the board, sorted into straight stripes, given to sheets over
    the images, and fitted: generalised least squares of the residuals across the stripe in
    the image, with the stripe's sigma of each point, and with the errors of the boards' poses and
    of the cameras as common unknowns of known covariance. A bow is added where the lack-of-fit
    test asks for it and the boards support it.

    Parameters
    ----------
    boards
        One entry an image; images of one placement share its board's pose and the error of that.
    camera
        One camera, the two of a stereo head, or those of a sensor whose sheets are solved again.
        Their covariance goes into the weights and into the result.
    options
        Defaults if None.

    Returns
    -------
    LaserFit or FitFailure
        A failure for one board, for stripes that are all one line in space, for stripes that
        cannot be given to sheets, and where nothing usable is left. Of the lines of a fan, those
        that the boards do not determine are left out with a warning.

    Raises
    ------
    InputError
        If an image is of a camera that is not calibrated.
    """
    options = options or SheetOptions()
    cameras = HeadCameras.of(camera)
    bow, bent = find_bow(boards, cameras, options.target_bow_mm)
    vote = observe_boards(bent, cameras, options, bow)
    if not any(image.stripes for image in vote.images):
        return FitFailure(
            f"no straight stripe with {MIN_POINTS} accepted points lies on the board in "
            f"any of {len(vote.images)} images",
            "check that the laser is on and crosses the board, that laser-on and board images "
            "belong together, and the target's size",
        )
    assignment = assign_sheets(vote.images, options)
    while not isinstance(assignment, FitFailure):
        case = _case_of(vote.images, assignment, cameras, options)
        fit = case if isinstance(case, _Refused) else case.solved()
        if isinstance(fit, LaserFit):
            warnings = (*_about_bow(bow), *vote.warnings, *fit.warnings)
            return replace(
                fit,
                boards=tuple(boards),
                skipped=vote.outlying,
                warnings=warnings,
                board_bow_mm=() if bow is None else tuple(bow.bow_mm.tolist()),
            )
        if isinstance(fit, FitFailure):
            return fit
        if not assignment.is_fan or len(assignment.names) == 1:
            return fit.failure
        assignment = assignment.without(fit.sheet, fit.failure.reason)
    return assignment


def _about_bow(bow: BoardBow | None) -> tuple[str, ...]:
    if bow is None or not is_much_bowed(bow.bow_mm, np.stack([bow.low_mm, bow.high_mm])):
        return ()
    along = ", ".join(f"{value:+.3f}" for value in bow.bow_mm)
    return (f"the board is bowed by {along} mm (along x, along y); stripes were placed so",)


def _case_of(
    images: Sequence[BoardImage],
    assignment: SheetAssignment,
    cameras: HeadCameras,
    options: SheetOptions,
) -> _Case | _Refused:
    """Everything for the joint fit: the points that are kept and the model of each sheet."""
    observations = stack_observations(images, assignment)
    starts: list[LightSheet] = []
    boards = np.array(board_numbers(images))
    for k, name in enumerate(assignment.names):
        shown = [k in sheets for sheets in assignment.sheets]
        few = refuse_few_boards(name, len(np.unique(boards[shown])))
        if few is not None:
            return _Refused(k, few)
    for k, name in enumerate(assignment.names):
        start = start_sheet(name, observations.select(observations.sheet == k), images)
        if isinstance(start, FitFailure):
            return _Refused(k, start)
        starts.append(start)
    errors = CommonErrors.of(images)
    scatter = scatter_by_stripe(observations, observations.residuals_px(starts)[1])
    observations = replace(observations, sigma_px=observations.sigma_px * scatter)
    models: list[SheetModel] = []
    kept = np.ones(len(observations), dtype=np.bool_)
    for k, start in enumerate(starts):
        of_sheet = observations.sheet == k
        points = observations.select(of_sheet)
        chosen = _points_and_model(points, start, errors, is_bow_allowed=options.is_bow_allowed)
        if isinstance(chosen, FitFailure):
            reason = f"sheet {assignment.names[k]}: {chosen.reason}"
            return _Refused(k, FitFailure(reason, chosen.remedy))
        kept[of_sheet], model = chosen
        models.append(model)
    return _Case(images, assignment, observations, scatter, kept, models, errors, cameras, options)


def _points_and_model(
    points: SheetObservations, start: LightSheet, errors: CommonErrors, *, is_bow_allowed: bool
) -> tuple[BoolArray, SheetModel] | FitFailure:
    """Which points of a sheet are kept, and its model.

    A stripe most of which lies off the plane that the others fit may be a stray, or the only one
    out where a bowed sheet bends away: it is kept where a bow explains it with all others to the
    noise.
    """
    near = _without_outliers(points, start, errors)
    if isinstance(near, FitFailure):
        return near
    model = choose_model(points.select(near), start, errors, is_bow_allowed=is_bow_allowed)
    is_told = len(np.unique(points.board)) >= BOARDS_TO_KEEP
    if not is_bow_allowed or not is_told or not _loses_a_stripe(points, near):
        return model if isinstance(model, FitFailure) else (near, model)
    wider = _without_outliers(points, start, errors, is_bowed=True)
    if not isinstance(wider, FitFailure) and not _loses_a_stripe(points, wider):
        bowed = choose_model(points.select(wider), start, errors, is_bow_allowed=True)
        if not isinstance(bowed, FitFailure) and bowed.explains_all:
            return wider, bowed
    return model if isinstance(model, FitFailure) else (near, model)


def _loses_a_stripe(points: SheetObservations, kept: BoolArray) -> bool:
    """Whether more than single points of some stripe are cast out."""
    stripe = np.unique(points.stripe, return_inverse=True)[1]
    return bool(np.any(np.bincount(stripe, ~kept) > MOST_CAST_OUT * np.bincount(stripe)))


def _without_outliers(
    observations: SheetObservations,
    start: LightSheet,
    errors: CommonErrors,
    *,
    is_bowed: bool = False,
) -> BoolArray | FitFailure:
    """Keep the points near the plane, or bow; a bow widens the robust scale off a plane."""
    keep = np.ones(len(observations), dtype=np.bool_)
    alone = observations.as_one_sheet()
    # Stripes that scatter more than they claim must not drag the boards along.
    noise = stripe_noise(alone, alone.residuals_px([start])[1])
    for _ in range(OUTLIER_ROUNDS):
        used = alone.select(keep)
        solution = solve_sheets(
            used, [start], errors, [is_bowed], sigma_factor=noise.sigma_factor, is_robust=True
        )
        if isinstance(solution, FitFailure):
            return solution
        normalised = np.full(len(keep), np.inf)
        normalised[keep] = np.abs(solution.remaining_px / used.sigma_px) / noise.factor
        before = int(keep.sum())
        keep = normalised < OUTLIER_SIGMA * max(1.0, robust_sigma(normalised[keep]))
        if int(keep.sum()) == before:
            break
    return keep


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """Everything that the joint fit rests on.

    ``observations`` (N) are all assigned points, their sigmas raised or lowered by ``scatter`` (N,)
    to their stripe's own; ``kept`` (N,) is False for points that are too far from their sheet.
    """

    images: Sequence[BoardImage]
    assignment: SheetAssignment
    observations: SheetObservations
    scatter: FloatArray
    kept: BoolArray
    models: Sequence[SheetModel]
    errors: CommonErrors
    cameras: HeadCameras
    options: SheetOptions

    @property
    def _errors(self) -> CommonErrors:
        """Of boards each of which errs as the sheet says that it makes err most."""
        factors = np.max([model.board_factors for model in self.models], axis=0)
        return self.errors.with_boards(factors)

    def solved(self) -> LaserFit | FitFailure | _Refused:
        """Solve all sheets together and put the result into words and numbers.

        Where the final lack-of-fit test of a sheet fails, its stripes' sigmas have been raised:
        what the model does not explain must not make the sheet look better known.
        """
        models, used = self.models, self.observations.select(self.kept)
        solved = partial(
            solve_sheets,
            used,
            [model.sheet for model in models],
            self._errors,
            [model.is_bowed for model in models],
            sigma_factor=np.array([model.sigma_factor for model in models])[used.sheet],
            are_cameras_held=True,
        )
        fitted, solution = solved(), solved(may_bow=self.options.is_bow_allowed)
        if isinstance(fitted, FitFailure):
            return fitted
        if isinstance(solution, FitFailure):
            return solution
        noise = np.array([model.noise.factor for model in models])
        noise_px = used.sigma_px * noise[used.sheet]
        points = check_points(used, solution, noise_px, self.images, self.cameras)
        independent = np.array([model.noise.sigma_factor for model in models])[used.sheet]
        shapes = estimate_shapes_mm(used, solution, used.sigma_px * independent)
        sheets = []
        for k in range(len(models)):
            fit = self._sheet_fit(k, used, (solution, fitted.covariance), points[k], shapes[k])
            if isinstance(fit, FitFailure):
                return _Refused(k, fit)
            sheets.append(fit)
        scatter = [
            float(np.sqrt((self.scatter[self.kept & (self.observations.sheet == k)] ** 2).mean()))
            for k in range(len(models))
        ]
        # From the order cameras, bow, sheets to that of a sensor: left camera, sheets, second one.
        n_camera = self.cameras.n_parameters
        order = np.delete(
            np.arange(len(solution.covariance)), slice(n_camera, self.errors.n_camera)
        )
        order = np.concatenate([order[:N_CAMERA], order[n_camera:], order[N_CAMERA:n_camera]])
        return LaserFit(
            sheets=tuple(sheets),
            images=self._image_evidence(solution),
            camera=self.cameras.left,
            second=self.cameras.second,
            covariance=solution.covariance[np.ix_(order, order)],
            diagnostics=SensorDiagnostics(
                noise_factor=float((noise * scatter).max()),
                correlation_points=max(model.noise.correlation_points for model in models),
                naming=self.assignment.how,
            ),
            boards=(),
            options=self.options,
            warnings=self._warnings(solution),
        )

    def _warnings(self, solution: SheetSolution) -> tuple[str, ...]:
        warnings = list(self.assignment.warnings)
        if not solution.has_converged:
            warnings.append(
                f"the fit of the sheets has not settled: its last step was "
                f"{solution.last_step_sigma:.2g} of a parameter's sigma; look at the boards' poses"
            )
        for name, model in zip(self.assignment.names, self.models, strict=True):
            raised = model.sigma_factor / model.noise.sigma_factor
            if raised > 1.0:
                warnings.append(
                    f"sheet {name}: its model does not explain the stripes within their noise and "
                    "the boards' errors; the stripes' sigmas are taken "
                    f"{raised:.1f} times larger"
                )
            if model.board_factor > NOTED_FACTOR:
                warnings.append(
                    f"sheet {name}: the boards err {model.board_factor:.1f} times as much as their "
                    "targets' points say: they may be bent, or the camera's lens is not as "
                    "calibrated"
                )
            strays = self._strays(model)
            if strays:
                warnings.append(
                    f"sheet {name}: boards that lie elsewhere than their targets say, far beyond "
                    f"the others' scatter, and count for little: {', '.join(strays)}; were they "
                    "found rightly, and are they flat? leave them out if not"
                )
        if not self.cameras.has_covariance:
            warnings.append(without_covariance("the sheets' sigmas"))
        return tuple(warnings)

    def _strays(self, model: SheetModel) -> list[str]:
        """Images, the first of each placement, of boards that scatter more than the others."""
        boards = board_numbers(self.images)
        return [
            self.images[boards.index(board)].data.profile.source
            for board, factor in enumerate(model.board_factors)
            if factor > STRAY_FACTOR * model.board_factor
        ]

    def _sheet_fit(
        self,
        k: int,
        used: SheetObservations,
        solved: tuple[SheetSolution, FloatArray],
        points: SheetPointCheck,
        shape_mm: float,
    ) -> SheetFit | FitFailure:
        """One sheet in words and numbers, of the joint fit.

        ``solved`` is the solution, and the covariance of the one with planes before it.
        """
        solution, of_planes = solved
        name, model, sheet = self.assignment.names[k], self.models[k], solution.sheets[k]
        of_sheet = used.sheet == k
        observations = used.select(of_sheet)
        first = self.errors.n_camera + N_SHEET * k
        own = slice(first, first + N_SHEET)
        covariance = solution.covariance[own, own]
        geometry = sheet_geometry(sheet, observations, self.images)
        # What the boards' places leave open; a bow that is likely is not mended by more depth.
        fitted_deg = _tilt_sigma_deg(of_planes[own, own], sheet.scale_mm)
        refused = refuse_underdetermined_tilt(name, geometry, fitted_deg)
        if refused is not None:
            return refused
        is_told = model.is_bowed or not self.options.is_bow_allowed
        common = self._common_plane(k)
        stated_deg = _tilt_sigma_deg(covariance, sheet.scale_mm)
        warnings = (*geometry_warnings(geometry, common, fitted_deg, stated_deg), *points.warnings)
        if model.plane_test.p_value < LACK_OF_FIT_P:
            outlier = find_outlier_view(observations, sheet, self.errors)
            if outlier is not None:
                warnings = (
                    *warnings,
                    "a plane explains all boards but the one in "
                    f"{self.images[outlier].data.profile.source}: check that its images belong "
                    "together and that the board was found rightly, or leave it out",
                )
        height_mm, residual_px = solution.system.height_mm, solution.system.residual_px
        return SheetFit(
            calibration=SheetCalibration(
                name=name,
                sheet=sheet,
                rms_mm=float(np.sqrt((height_mm[of_sheet] ** 2).mean())),
                n_boards=geometry.n_boards,
                n_points=len(observations),
                depth_range_mm=geometry.depth_range_mm,
                is_redundant=geometry.n_boards > 2,
                shape_mm=shape_mm,
            ),
            diagnostics=SheetDiagnostics(
                rms_px=float(np.sqrt((residual_px[of_sheet] ** 2).mean())),
                plane_test=model.plane_test,
                final_test=model.final_test,
                bow_decision=model.decision + ("" if is_told else LIKELIEST),
                coplanarity_mm=common.largest_mm if common else 0.0,
                coplanarity_sigma_mm=common.sigma_largest_mm if common else 0.0,
                board_angle_deg=geometry.board_angle_deg,
            ),
            covariance=covariance,
            is_bow_free=model.is_bowed,
            tilt_sigma_deg=stated_deg,
            offset_sigma_mm=float(np.sqrt(covariance[2, 2])),
            comparisons=compare_planes(sheet, observations, self.images, self.cameras),
            points=points,
            warnings=warnings,
        )

    def _common_plane(self, k: int) -> CommonPlane | None:
        """Plane of a sheet's straight stripes as measured, without any model."""
        # Not the raised sigmas: they would explain away the very misfit that is to be shown.
        factor = self.models[k].noise.sigma_factor
        members = []
        for i, (image, sheets) in enumerate(zip(self.images, self.assignment.sheets, strict=True)):
            for stripe, sheet in zip(image.stripes, sheets, strict=True):
                if sheet == k:
                    first = (self.observations.image == i) & (
                        self.observations.row == stripe.rows[0]
                    )
                    scale = factor * float(self.scatter[first][0])
                    noise = stripe.noise_ends_mm2 * scale**2
                    members.append(replace(stripe, noise_ends_mm2=noise))
        common = fit_common_plane(members)
        return None if isinstance(common, FitFailure) else common

    def _image_evidence(self, solution: SheetSolution) -> tuple[SheetImage, ...]:
        observations, kept = self.observations, self.kept
        height, residual, _, _ = observations.residuals_px(solution.sheets)
        remaining = np.full(len(observations), np.nan)
        remaining[kept] = solution.remaining_px
        evidence = []
        for i, board in enumerate(board_numbers(self.images)):
            image, of_image = self.images[i], observations.image == i
            rows = observations.row[of_image]
            use, sheet = image.use.copy(), np.full(len(image.use), -1)
            use[rows] = np.where(kept[of_image], int(PointUse.USED), int(PointUse.OFF_SHEET))
            sheet[rows] = observations.sheet[of_image]
            columns = np.full((3, len(use)), np.nan)
            columns[:, rows] = height[of_image], residual[of_image], remaining[of_image]
            shift = solution.common[6 * board : 6 * board + 6]
            evidence.append(
                SheetImage(
                    profile=image.data.profile,
                    view=image.data.view,
                    sensor_from_board=image.placed.sensor_from_board,
                    use=use,
                    sheet=sheet,
                    points_mm=image.points.points_mm,
                    residual_mm=columns[0],
                    residual_px=columns[1],
                    remaining_px=columns[2],
                    pose_shift_sigma=float(np.linalg.norm(shift)),
                )
            )
        return tuple(evidence)


def _tilt_sigma_deg(covariance: FloatArray, scale_mm: float) -> float:
    """Largest standard deviation of a direction, of a sheet's covariance (8, 8)."""
    variance = max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0)
    return float(np.degrees(np.sqrt(variance) / scale_mm))
