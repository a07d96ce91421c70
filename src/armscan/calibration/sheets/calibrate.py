# SPDX-License-Identifier: Apache-2.0
"""Calibrate light sheets from stripes on boards: observe, label, vote, solve, choose the shape,
check, and put the result together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.sheets.board_points import N_CAMERA, HeadCameras, intersect_sheet_of
from armscan.calibration.sheets.coplanarity import (
    CommonPlane,
    PosedObservation,
    fit_common_plane,
    geometry_warnings,
    refuse_few_boards,
    refuse_underdetermined_tilt,
)
from armscan.calibration.sheets.labels import SheetAssignment, board_numbers, name_stripes
from armscan.calibration.sheets.lack_of_fit import (
    find_outlier_view,
    scatter_by_stripe,
    stripe_noise,
)
from armscan.calibration.sheets.model import (
    SheetModel,
    choose_model,
    compare_planes,
    sheet_geometry,
    start_sheet,
)
from armscan.calibration.sheets.result import (
    BoardDistances,
    BoardPointCheck,
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
    LinearSolution,
    NormalSolution,
    SheetObservations,
    SheetSolution,
    StripeRows,
    collect_observations,
    placement_covariances,
    solve_sheets,
)
from armscan.calibration.sheets.stripes_on_board import BoardImage, observe_board_stripes
from armscan.calibration.sheets.voting import LEAST_BOARDS, Vote, vote_on_sheets
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration, SheetCalibration
from armscan.models.light_sheet import LightSheet
from armscan.models.two_views import StereoCalibration

FEWEST_OTHERS = 2
"""Boards that must remain when one is left out: the stripe of one alone is a line."""


def check_points(
    observations: SheetObservations,
    solution: SheetSolution,
    *,
    noise_px: FloatArray,
    images: Sequence[BoardImage],
    cameras: HeadCameras,
) -> tuple[SheetPointCheck, ...]:
    """Reconstruct the stripes with the solution and compare them with their boards.

    Parameters
    ----------
    observations
        The points used.
    solution
        Sheets that belong to the cameras as calibrated.
    noise_px
        (N,) scatter of single points; the weights hold the larger one with which they count as
        independent.
    images, cameras
        As the fit had them.
    """
    linear = solution.linear
    made = _Made(observations, images, cameras)
    claim = _Claim(linear, linear.normal, noise_px, is_in_fit=True)
    distance = made.distance_mm(solution.sheets)
    slope = made.slope_mm_px(solution.sheets)
    left_out = {
        int(board): _without(int(board), solution, noise_px)
        for board in np.unique(observations.board)
    }
    checks = []
    for k in range(len(solution.sheets)):
        of_sheet = observations.sheet == k
        boards = []
        numbers = np.unique(observations.board[of_sheet])
        for board in numbers:
            rows = of_sheet & (observations.board == board)
            others = left_out[int(board)] if len(numbers) > FEWEST_OTHERS else None
            first = int(observations.image[rows][0])
            boards.append(
                BoardPointCheck(
                    images[first].data.profile.source,
                    float(observations.points_mm[rows, 2].mean()),
                    claim.describe(rows, distance, slope),
                    None
                    if others is None
                    else others[1].describe(rows, made.distance_mm(others[0], rows), slope),
                )
            )
        checks.append(_sheet_check(claim.describe(of_sheet, distance, slope), boards))
    return tuple(checks)


def _sheet_check(fitted: BoardDistances, boards: Sequence[BoardPointCheck]) -> SheetPointCheck:
    alone = [board.left_out for board in boards if board.left_out is not None]
    count = sum(board.n_points for board in alone)
    if count == 0:
        return SheetPointCheck(fitted, float("nan"), float("nan"), tuple(boards))
    squares = sum(board.n_points * board.rms_mm**2 for board in alone)
    claimed = sum(board.n_points * board.claimed_rms_mm**2 for board in alone)
    return SheetPointCheck(
        fitted, float(np.sqrt(squares / count)), float(np.sqrt(claimed / count)), tuple(boards)
    )


def _without(
    board: int, solution: SheetSolution, noise_px: FloatArray
) -> tuple[tuple[LightSheet, ...], _Claim] | None:
    """Sheets of all boards but one, by one step from those of all; None if not determined."""
    linear = solution.linear
    n_held = linear.normal.follow.shape[1]
    normal = linear.system.solve(linear.weight, n_held, without_board=board)
    if normal is None:
        return None
    step = np.zeros(len(linear.active))
    step[linear.active] = normal.step[: normal.n_sheet]
    sheets = tuple(
        sheet.updated(step[N_SHEET * k : N_SHEET * (k + 1)])
        for k, sheet in enumerate(solution.sheets)
    )
    return sheets, _Claim(linear, normal, noise_px, is_in_fit=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Made:
    """Points as the stored calibration makes them, N in all."""

    observations: SheetObservations
    images: Sequence[BoardImage]
    cameras: HeadCameras

    def distance_mm(
        self, sheets: Sequence[LightSheet], rows: BoolArray | None = None
    ) -> FloatArray:
        """(N,) distance of the points from their boards; NaN for those that are not asked for."""
        found = np.full(len(self.observations), np.nan)
        for i, k, own in self._groups(rows):
            image = self.images[i]
            q = image.data.profile.points_px[self.observations.row[own]]
            points, is_met = intersect_sheet_of(q, image.data.camera, sheets[k], self.cameras)
            pose = image.placed.sensor_from_board
            distance = (points - pose.translation_mm) @ pose.rotation[:, 2]
            found[own] = np.where(is_met, distance, np.nan)
        return found

    def slope_mm_px(self, sheets: Sequence[LightSheet]) -> FloatArray:
        """(N,) change of that distance for one pixel of residual.

        A point of the board that lies ``h`` above the sheet slides along its ray by ``-h / (g.d)``,
        with the sheet's gradient g and the ray's direction d.
        """
        found = np.zeros(len(self.observations))
        for i, k, own in self._groups(None):
            image, points = self.images[i], self.observations.points_mm[own]
            _, gradient, _ = sheets[k].height_with_jacobian(points)
            ray = points - self.cameras.centre_mm(image.data.camera)
            normal = image.placed.sensor_from_board.rotation[:, 2]
            per_px = np.einsum("ni,ni->n", gradient, self.observations.across_mm_px[own])
            found[own] = -(ray @ normal) / np.einsum("ni,ni->n", gradient, ray) * per_px
        return found

    def _groups(self, rows: BoolArray | None) -> Iterator[tuple[int, int, BoolArray]]:
        """Image, sheet and points (N,) of each stripe."""
        observations = self.observations
        asked = np.ones(len(observations), dtype=np.bool_) if rows is None else rows
        for stripe in np.unique(observations.stripe[asked]):
            own = observations.stripe == stripe
            first = int(np.argmax(own))
            yield int(observations.image[first]), int(observations.sheet[first]), own


@dataclass(frozen=True, slots=True, eq=False)
class _Claim:
    """What the normal equations claim of residuals that no board was moved for.

    A residual is ``r = B w_b + C w_c + e + A e_s``: errors of boards and cameras in their own
    sigmas, the stripe's noise, and the sheets' error, ``e_s = F w_c + K w_b - G e`` where the board
    took part in the fit.
    """

    linear: LinearSolution
    normal: NormalSolution
    noise_px: FloatArray
    is_in_fit: bool

    def describe(self, rows: BoolArray, distance: FloatArray, slope: FloatArray) -> BoardDistances:
        """Figures of the points ``rows`` (N,), with the claims for them."""
        rows = rows & np.isfinite(distance)
        n = int(rows.sum())
        variance = np.where(rows, slope**2 * self.point_variances(rows), 0.0)
        return BoardDistances(
            n,
            float(distance[rows].mean()),
            float(np.sqrt(self.variance_of_sum(np.where(rows, slope / n, 0.0)))),
            float(np.sqrt((distance[rows] ** 2).mean())),
            float(np.sqrt(variance.sum() / n)),
        )

    def variance_of_sum(self, factor: FloatArray) -> float:
        """Variance of ``factor @ r``, points counting with the noise of the weights."""
        normal, n_sheet = self.normal, self.normal.n_sheet
        pull = self.linear.system.transposed(factor)
        by_sheet, by_board = pull[:n_sheet], pull[n_sheet : normal.n_free]
        by_camera = pull[normal.n_free :] + normal.follow.T @ by_sheet
        total = float((factor**2 / self.linear.weight).sum() + by_camera @ by_camera)
        if not self.is_in_fit:
            own = normal.covariance
            return total + float(by_board @ by_board + by_sheet @ own @ by_sheet)
        by_board = by_board + normal.by_boards.T @ by_sheet
        fitted = by_sheet @ (
            normal.by_stripes @ by_sheet - 2.0 * normal.gain @ pull[: normal.n_free]
        )
        return max(total + float(by_board @ by_board + fitted), 0.0)

    def point_variances(self, rows: BoolArray) -> FloatArray:
        """(N,) variance of single residuals; zero for stripes of which no point is asked for."""
        found = np.zeros(len(rows))
        for stripe in self.linear.system.stripes:
            if rows[stripe.rows].any():
                found[stripe.rows] = self._stripe_variances(stripe)
        return found

    def _stripe_variances(self, stripe: StripeRows) -> FloatArray:
        normal = self.normal
        is_sheet = stripe.columns < normal.n_sheet
        is_free = stripe.columns < normal.n_free
        own = stripe.columns[is_sheet]
        by_sheet = stripe.design[:, is_sheet]
        by_board = stripe.design[:, is_free & ~is_sheet]
        by_camera = stripe.design[:, ~is_free] + by_sheet @ normal.follow[own]
        total = self.noise_px[stripe.rows] ** 2 + (by_camera**2).sum(axis=1)
        if not self.is_in_fit:
            sheet = normal.covariance[np.ix_(own, own)]
            return np.asarray(
                total + (by_board**2).sum(axis=1) + ((by_sheet @ sheet) * by_sheet).sum(axis=1)
            )
        moved = by_sheet @ normal.by_boards[own]
        moved[:, stripe.columns[is_free & ~is_sheet] - normal.n_sheet] += by_board
        stripes = by_sheet @ normal.by_stripes[np.ix_(own, own)]
        lever = stripe.design[:, is_free] @ normal.gain[np.ix_(own, stripe.columns[is_free])].T
        total = total + (moved**2).sum(axis=1) + ((stripes - 2.0 * lever) * by_sheet).sum(axis=1)
        return np.asarray(np.maximum(total, 0.0))


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
    named: SheetAssignment
    observations: SheetObservations
    scatter: FloatArray
    kept: BoolArray
    models: Sequence[SheetModel]
    errors: CommonErrors
    cameras: HeadCameras
    options: SheetOptions


@dataclass(frozen=True, slots=True)
class UnderdeterminedSheet:
    """A sheet whose direction its boards leave open."""

    sheet: int
    failure: FitFailure


def assemble_fit(case: SheetCase) -> LaserFit | FitFailure | UnderdeterminedSheet:
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
            return UnderdeterminedSheet(k, fit)
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
    loose = refuse_underdetermined_tilt(named.names[k], geometry, tilt_sigma_deg)
    if loose is not None:
        return loose
    common = _common_plane(k, case)
    stripes = _stripes_of(used.select(own))
    warnings = geometry_warnings(geometry, common, tilt_sigma_deg)
    if model.plane_test.p_value < case.options.lack_of_fit_p:
        misfit = find_outlier_view(used.select(own), sheet, case.errors, case.options)
        if misfit is not None:
            warnings = (*warnings, _misfit_warning(images[misfit].data.profile.source))
    return SheetFit(
        SheetCalibration(
            name=named.names[k],
            sheet=sheet,
            rms_mm=float(np.sqrt((solution.height_mm[own] ** 2).mean())),
            n_boards=geometry.n_boards,
            n_points=int(own.sum()),
            depth_range_mm=geometry.depth_range_mm,
            is_redundant=geometry.n_boards > 2,
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
                PosedObservation(
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


OUTLIER_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class _Refused:
    """One sheet that its boards do not determine."""

    sheet: int
    failure: FitFailure


def calibrate_sheets(
    boards: Sequence[BoardStripes],
    camera: CameraCalibration | StereoCalibration,
    options: SheetOptions | None = None,
) -> LaserFit | FitFailure:
    """Calibrate one or several light sheets that lie on boards of known pose.

    The stripe points are carried to the board (`intersect_board`), sorted into straight stripes,
    named over the images, and fitted: generalised least squares of the residuals across the
    stripe in the image, with the stripe's sigma of each point, and with the errors of the boards'
    poses and of the cameras as common unknowns of known covariance. A bow is added where the
    lack-of-fit test asks for it and the boards support it.

    Parameters
    ----------
    boards
        One entry an image; images of one placement share its board's pose and the error of that.
    camera
        One camera, or the two of a stereo head. Their covariance goes into the weights and into
        the result.
    options
        Defaults if None.

    Returns
    -------
    LaserFit or FitFailure
        A failure for one board, for stripes that are all one line in space, for stripes that
        cannot be named, and where nothing usable is left. Of the lines of a fan, those that the
        boards do not determine are left out with a warning.

    Raises
    ------
    InputError
        If an image is of a camera that is not calibrated.
    """
    options = options or SheetOptions()
    cameras = HeadCameras.of(camera)
    vote = observe_boards(boards, cameras, options)
    images = vote.images
    if not any(image.sightings for image in images):
        return FitFailure(
            f"no straight stripe with {options.min_points} accepted points lies on the board in "
            f"any of {len(images)} images",
            "check that laser-on and board images belong together, the target's size, and the "
            "stripe extraction",
        )
    named = name_stripes(images, cameras.covariance, options)
    while not isinstance(named, FitFailure):
        fit = _fit_named(images, named, cameras, options)
        if isinstance(fit, LaserFit):
            return replace(
                fit,
                skipped=(*vote.outlying, *fit.skipped),
                warnings=(*vote.warnings, *fit.warnings),
            )
        if isinstance(fit, FitFailure):
            return fit
        if not named.is_fan or len(named.names) == 1:
            return fit.failure
        named = named.without(fit.sheet, fit.failure.reason)
    return named


def observe_boards(
    boards: Sequence[BoardStripes], cameras: HeadCameras, options: SheetOptions
) -> Vote:
    """Straight stripes on the boards, less the lines on which the boards do not agree.

    Stripes are looked for on the print and, where three boards can vote, on the carrier around it
    as far as the print is long (`armscan.calibration.sheets.voting`).
    """
    can_vote = len({board.place for board in boards}) >= LEAST_BOARDS
    n_lines = 0 if can_vote else options.n_sheets
    on_print = [
        observe_board_stripes(board, cameras, options, options.margin_mm, n_lines)
        for board in boards
    ]
    if not can_vote:
        return Vote(tuple(on_print))
    around = on_print
    if options.margin_mm is None:
        around = [
            observe_board_stripes(board, cameras, options, _carrier_mm(board)) for board in boards
        ]
    return vote_on_sheets(on_print, around, cameras, options)


def _carrier_mm(board: BoardStripes) -> float:
    """A board may go on beyond its print by the print's own length."""
    points = board.view.points_board_mm
    return float(np.ptp(points, axis=0).max())


def _fit_named(
    images: Sequence[BoardImage],
    named: SheetAssignment,
    cameras: HeadCameras,
    options: SheetOptions,
) -> LaserFit | FitFailure | _Refused:
    observations = collect_observations(images, named)
    errors = CommonErrors(placement_covariances(images), cameras.covariance)
    starts = _starts(images, named, observations)
    if isinstance(starts, _Refused):
        return starts
    scatter = scatter_by_stripe(observations, observations.residuals_px(starts)[1])
    observations = replace(observations, sigma_px=observations.sigma_px * scatter)
    models: list[SheetModel] = []
    kept = np.ones(len(observations), dtype=np.bool_)
    for k, start in enumerate(starts):
        own = observations.sheet == k
        chosen = _model_of(observations.select(own), start, errors, options)
        if isinstance(chosen, FitFailure):
            reason = f"sheet {named.names[k]}: {chosen.reason}"
            return _Refused(k, FitFailure(reason, chosen.remedy))
        kept[own] = chosen[0]
        models.append(chosen[1])
    fit = assemble_fit(
        SheetCase(images, named, observations, scatter, kept, models, errors, cameras, options)
    )
    return _Refused(fit.sheet, fit.failure) if isinstance(fit, UnderdeterminedSheet) else fit


def _starts(
    images: Sequence[BoardImage], named: SheetAssignment, observations: SheetObservations
) -> list[LightSheet] | _Refused:
    boards = np.array(board_numbers(images))
    for k, name in enumerate(named.names):
        shown = [k in sheets for sheets in named.sheets]
        failure = refuse_few_boards(name, len(np.unique(boards[shown])))
        if failure is not None:
            return _Refused(k, failure)
    starts: list[LightSheet] = []
    for k, name in enumerate(named.names):
        start = start_sheet(name, observations.select(observations.sheet == k), images)
        if isinstance(start, FitFailure):
            return _Refused(k, start)
        starts.append(start)
    return starts


def _model_of(
    observations: SheetObservations, start: LightSheet, errors: CommonErrors, options: SheetOptions
) -> tuple[BoolArray, SheetModel] | FitFailure:
    """Points of one sheet that are kept, and the model that they ask for."""
    near = _without_outliers(observations, start, errors, options)
    if isinstance(near, FitFailure):
        return near
    model = choose_model(observations.select(near), start, errors, options)
    return model if isinstance(model, FitFailure) else (near, model)


def _without_outliers(
    observations: SheetObservations,
    start: LightSheet,
    errors: CommonErrors,
    options: SheetOptions,
) -> BoolArray | FitFailure:
    """Keep the points near the plane; a bow widens the robust scale and so keeps its points."""
    keep = np.ones(len(observations), dtype=np.bool_)
    alone = observations.as_one_sheet()
    # Stripes that scatter more than they claim must not drag the boards along.
    noise = stripe_noise(alone, alone.residuals_px([start])[1])
    for _ in range(OUTLIER_ROUNDS):
        used = alone.select(keep)
        solution = solve_sheets(
            used, [start], errors, [False], sigma_factor=noise.sigma_factor, is_robust=True
        )
        if isinstance(solution, FitFailure):
            return solution
        normalised = np.full(len(keep), np.inf)
        normalised[keep] = np.abs(solution.remaining_px / used.sigma_px) / noise.factor
        scale = max(1.0, 1.4826 * float(np.median(normalised[keep])))
        before = int(keep.sum())
        keep = normalised < options.outlier_sigma * scale
        if int(keep.sum()) == before:
            break
    return keep
