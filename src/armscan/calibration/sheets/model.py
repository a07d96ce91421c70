# SPDX-License-Identifier: Apache-2.0
"""Shape of each sheet, plane or bowed, chosen by tests, and the planes of simpler methods to
compare with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.coplanarity import (
    SheetGeometry,
    refuse_few_boards,
    refuse_lost_spread,
)
from armscan.calibration.sheets.lack_of_fit import (
    BoardScatter,
    StripeNoise,
    board_scatter,
    lack_of_fit,
    stripe_noise,
)
from armscan.calibration.sheets.result import LACK_OF_FIT_P, PlaneComparison, PlaneMethod
from armscan.calibration.sheets.solve import (
    N_PLANE,
    CommonErrors,
    SheetObservations,
    SheetSolution,
    solve_sheets,
)
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Line, Plane, fit_line, fit_plane
from armscan.models.calibration import FTest
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import BOW_TERMS, LightSheet
from armscan.vision.targets.target import TargetView

MIN_BOARDS_FOR_BOW = 4
"""Fewest boards from which a bow is told from the boards' own errors: three boards' two heights
each leave three numbers beside a plane, and a bow has five."""
MAX_BOW_CONDITION = 1e7
"""Of plane and bow terms together: beyond it the boards do not spread enough to tell them apart."""
NO_SPARE = 2
"""Boards of which two straight stripes fix a plane but for one height."""
MOST_OF_TWO = 5.0
"""Largest scatter that is charged to them; more is a board in the wrong place, and told as such."""
MAX_RAISES = 10
FAN_ROUNDS = 5
FAN_SETTLED = 1e-3
USUAL_FAN = 0.5
"""Size of a fan's lean and spread where the bow is too small to show them: a source twice as far as
the calibrated region is wide. It only keeps them finite."""
MAX_FAN = 0.8
U2, UV, U2V = (BOW_TERMS.index(term) for term in ((2, 0), (1, 1), (2, 1)))
MIN_COLLINEAR = 3
MIN_CROSSING_SINE = 0.5
"""Rows that the stripe crosses at less than 30 degrees give no sharp point."""


@dataclass(frozen=True, slots=True, eq=False)
class SheetModel:
    """The model chosen for one sheet, fitted to this sheet's points alone.

    Parameters
    ----------
    sheet
        Start of the joint fit.
    is_bowed
        Whether the bow is free.
    noise
        Scatter along its stripes.
    plane_test, final_test
        Lack of fit of the plane, and of the model chosen.
    decision
        Why there is a bow, or none.
    sigma_factor
        By which the stripes' sigmas are multiplied in the joint fit: their noise, its correlation,
        and what the model leaves unexplained.
    board_factor
        By which the sigmas of the boards' poses are multiplied in the joint fit.
    """

    sheet: LightSheet
    is_bowed: bool
    noise: StripeNoise
    plane_test: FTest
    final_test: FTest
    decision: str
    sigma_factor: float
    board_factor: float = 1.0


def sheet_geometry(
    sheet: LightSheet, observations: SheetObservations, images: Sequence[BoardImage]
) -> SheetGeometry:
    """Describe the boards on which one sheet's points lie."""
    _, first = np.unique(observations.board, return_index=True)
    normals = np.stack(
        [images[i].placed.sensor_from_board.rotation[:, 2] for i in observations.image[first]]
    )
    return SheetGeometry.of(sheet, observations.points_mm, normals)


def start_sheet(
    name: str, observations: SheetObservations, images: Sequence[BoardImage]
) -> LightSheet | FitFailure:
    """Total least squares plane of one sheet's points; refused where they are one line."""
    few = refuse_few_boards(name, len(np.unique(observations.board)))
    if few is not None:
        return few
    plane = fit_plane(observations.points_mm)
    if isinstance(plane, FitFailure):
        return FitFailure(f"sheet {name}: {plane.reason}", plane.remedy)
    stripes = [observations.points_mm[of] for of in observations.each_stripe()]
    along = np.stack([points[-1] - points[0] for points in stripes])
    directions = along / np.linalg.norm(along, axis=1)[:, None]
    sheet = sheet_from_plane(plane.value, observations.points_mm, directions)
    geometry = sheet_geometry(sheet, observations, images)
    # Sigma, by the boards' poses, of where points lie across the stripes.
    by_pose = np.einsum("i,nij->nj", sheet.axes[1], observations.dpoint_dpose)
    variance = np.zeros(len(observations))
    for i in np.unique(observations.image):
        of = observations.image == i
        covariance = images[i].placed.covariance
        variance[of] = np.einsum("ni,ij,nj->n", by_pose[of], covariance, by_pose[of])
    refused = refuse_lost_spread(name, geometry, float(np.sqrt(max(variance.mean(), 0.0))))
    return sheet if refused is None else refused


def sheet_from_plane(plane: Plane, points_mm: FloatArray, directions: FloatArray) -> LightSheet:
    """Flat sheet on a plane, u along the stripes' mean direction and v towards larger depth.

    Parameters
    ----------
    plane
        The plane.
    points_mm
        (N, 3) points that the sheet's origin and scale should cover.
    directions
        (L, 3) directions of the stripes; their signs do not matter.
    """
    normal = plane.normal
    mean = np.linalg.eigh(directions.T @ directions)[1][:, -1]
    e_u = mean - (mean @ normal) * normal
    e_u = e_u / np.linalg.norm(e_u)
    if e_u[int(np.argmax(np.abs(e_u)))] < 0.0:
        e_u = -e_u
    e_v = np.cross(normal, e_u)
    if e_v[2] < 0.0:
        normal, e_v = -normal, -e_v
    axes = np.stack([e_u, e_v, normal])
    local = (points_mm - plane.point_mm) @ axes[:2].T
    middle = 0.5 * (local.min(axis=0) + local.max(axis=0))
    scale = 0.5 * float(np.ptp(local, axis=0).max())
    return LightSheet(
        origin_mm=plane.point_mm + middle @ axes[:2], axes=axes, scale_mm=scale, bow_mm=np.zeros(5)
    )


def choose_model(
    observations: SheetObservations,
    start: LightSheet,
    errors: CommonErrors,
    *,
    is_bow_allowed: bool,
) -> SheetModel | FitFailure:
    """Fit the plane, test its fit, and let the sheet bow if the test asks for it."""
    data = _OneSheet(observations.as_one_sheet(), errors)
    noise = stripe_noise(data.points, data.points.residuals_px([start])[1])
    flat = data.solve(start, noise.sigma_factor)
    if not isinstance(flat, FitFailure):
        noise = stripe_noise(data.points, flat.remaining_px)
        flat = data.solve(start, noise.sigma_factor)
    if isinstance(flat, FitFailure):
        return flat
    plane_test = data.lack_of_fit(flat, noise)
    model = SheetModel(flat.sheets[0], False, noise, plane_test, plane_test, "", noise.sigma_factor)
    n_boards = len(np.unique(observations.board))
    test = f"lack of fit F {plane_test.f_ratio:.2f}, p {plane_test.p_value:.2g}"
    if plane_test.p_value >= LACK_OF_FIT_P:
        decision = f"a plane is enough ({test})"
    elif n_boards < MIN_BOARDS_FOR_BOW:
        decision = (
            f"a plane does not explain the stripes ({test}), but {n_boards} boards cannot tell a "
            f"bow from their own errors: {MIN_BOARDS_FOR_BOW} are needed"
        )
    else:
        return _bow_or_boards(model, flat, data, is_bow_allowed=is_bow_allowed)
    model = replace(model, decision=decision)
    if n_boards != NO_SPARE:
        return data.charged_to_stripes(model)
    # One height is left over, and no test of it has power: its likeliest cause is taken.
    scatter = data.board_scatter(flat, noise)
    return data.charged_to_boards(model, min(scatter.factor, MOST_OF_TWO))


def _bow_or_boards(
    plane_model: SheetModel, flat: SheetSolution, data: _OneSheet, *, is_bow_allowed: bool
) -> SheetModel | FitFailure:
    """What a plane leaves unexplained: is the sheet bowed, or do its boards scatter?"""
    noise, plane_test = plane_model.noise, plane_model.plane_test
    test = f"lack of fit F {plane_test.f_ratio:.2f}, p {plane_test.p_value:.2g}"
    boards = data.board_scatter(flat, noise)

    def plane(decision: str) -> SheetModel | FitFailure:
        return data.charged_to_boards(replace(plane_model, decision=decision), boards.factor)

    if not is_bow_allowed:
        return plane(f"a plane was asked for, and does not explain the stripes ({test})")
    condition = _bow_condition(data.points, flat)
    bowed = data.solve_bowed(flat.sheets[0], noise.sigma_factor)
    if condition > MAX_BOW_CONDITION or isinstance(bowed, FitFailure):
        return plane(
            f"a plane does not explain the stripes ({test}), but the boards do not spread enough "
            f"to determine a bow (condition {condition:.2g})"
        )
    boards_bowed = data.board_scatter(bowed, noise)
    gain = 2.0 * (boards_bowed.log_likelihood - boards.log_likelihood)
    p_value = float(stats.chi2.sf(max(gain, 0.0), bowed.n_parameters - flat.n_parameters))
    likelihood = f"likelihood ratio {gain:.1f}, p {p_value:.2g}"
    if p_value >= LACK_OF_FIT_P:
        return plane(
            f"a plane does not explain the stripes ({test}), and a bow does no better than boards "
            f"that err {boards.factor:.1f} times as much as their targets say ({likelihood})"
        )
    final = data.lack_of_fit(bowed, noise)
    decision = (
        f"bow fitted: the plane does not explain the stripes ({test}), the bow does better "
        f"({likelihood})"
    )
    model = SheetModel(
        bowed.sheets[0], True, noise, plane_test, final, decision, noise.sigma_factor
    )
    if final.p_value >= LACK_OF_FIT_P:
        return model
    return data.charged_to_boards(model, boards_bowed.factor)


@dataclass(frozen=True, slots=True, eq=False)
class _OneSheet:
    """Points of one sheet, with the errors of boards and cameras."""

    points: SheetObservations
    errors: CommonErrors

    def solve(
        self, start: LightSheet, sigma_factor: float, *, is_bowed: bool = False
    ) -> SheetSolution | FitFailure:
        return solve_sheets(
            self.points, [start], self.errors, [is_bowed], sigma_factor=sigma_factor
        )

    def lack_of_fit(
        self, solution: SheetSolution, noise: StripeNoise, sigma_factor: float | None = None
    ) -> FTest:
        n_stripes = len(np.unique(self.points.stripe))
        return lack_of_fit(solution.chi2, n_stripes, solution.n_parameters, noise, sigma_factor)

    def board_scatter(self, solution: SheetSolution, noise: StripeNoise) -> BoardScatter:
        return board_scatter(self.points, solution, self.errors, noise)

    def solve_bowed(self, start: LightSheet, sigma_factor: float) -> SheetSolution | FitFailure:
        """Fit a bowed sheet, and find from the bow itself how its light spreads.

        Where the rays come from shows in how the bow along the stripe changes with depth: to first
        order a fan adds ``-2 lean u v - spread u^2 v`` to ``u^2``.
        """
        solution = self.solve(start, sigma_factor, is_bowed=True)
        for _ in range(FAN_ROUNDS):
            if isinstance(solution, FitFailure):
                return solution
            sheet = solution.sheets[0]
            bow = sheet.bow_mm[U2]
            variance = np.diag(solution.covariance)[self.errors.n_camera + N_PLANE :]
            lean, spread = sheet.fan
            sideways = 2.0 * lean * bow - sheet.bow_mm[UV]
            weaker = spread * bow - sheet.bow_mm[U2V]
            fan = np.array(
                [
                    0.5 * bow * sideways / (bow**2 + 0.25 * variance[UV] / USUAL_FAN**2),
                    bow * weaker / (bow**2 + variance[U2V] / USUAL_FAN**2),
                ]
            )
            fan = np.clip(fan, -MAX_FAN, MAX_FAN)
            if float(np.abs(fan - sheet.fan).max()) < FAN_SETTLED:
                break
            start = replace(start, fan=fan)
            solution = self.solve(start, sigma_factor, is_bowed=True)
        return solution

    def charged_to_boards(self, model: SheetModel, board_factor: float) -> SheetModel | FitFailure:
        """Charge to the boards what they scatter, and to the stripes what is then left."""
        wider = _OneSheet(self.points, self.errors.with_boards(board_factor))
        solution = wider.solve(model.sheet, model.noise.sigma_factor, is_bowed=model.is_bowed)
        if isinstance(solution, FitFailure):
            return solution
        model = replace(
            model,
            sheet=solution.sheets[0],
            final_test=wider.lack_of_fit(solution, model.noise),
            board_factor=board_factor,
        )
        return wider.charged_to_stripes(model)

    def charged_to_stripes(self, model: SheetModel) -> SheetModel | FitFailure:
        """Raise the stripes' sigmas until the model fits, if it did not.

        What neither the model nor the boards' scatter explains is charged to the stripes. The
        covariance of the sheet grows with it.
        """
        factor, test, sheet = model.sigma_factor, model.final_test, model.sheet
        for _ in range(MAX_RAISES):
            if test.p_value >= LACK_OF_FIT_P or test.f_ratio <= 1.0:
                break
            factor *= float(np.sqrt(test.f_ratio))
            solution = self.solve(sheet, factor, is_bowed=model.is_bowed)
            if isinstance(solution, FitFailure):
                return solution
            sheet = solution.sheets[0]
            test = self.lack_of_fit(solution, model.noise, factor)
        return replace(model, sheet=sheet, sigma_factor=factor)


def _bow_condition(observations: SheetObservations, flat: SheetSolution) -> float:
    """Condition number of plane and bow terms together, columns scaled alike."""
    _, _, by_sheet = flat.sheets[0].height_with_jacobian(observations.points_mm)
    scaled = by_sheet / np.maximum(np.linalg.norm(by_sheet, axis=0), 1e-300)
    values = np.linalg.eigvalsh(scaled.T @ scaled)
    return float(values[-1] / max(values[0], 1e-300))


def compare_planes(
    sheet: LightSheet,
    observations: SheetObservations,
    images: Sequence[BoardImage],
    cameras: HeadCameras,
) -> tuple[PlaneComparison, ...]:
    """Compare eq. 2.44, total least squares and the cross-ratio points with the sheet in use.

    ``observations`` are the sheet's points, the cameras are for the cross-ratio points.
    """
    points = observations.points_mm
    crossings = []
    for of in observations.each_stripe():
        image = images[int(observations.image[of][0])]
        stripe_px = image.data.profile.points_px[observations.row[of]]
        camera = cameras.model(image.data.camera)
        on_board = cross_ratio_points(image.data.view, stripe_px, camera)
        pose = image.placed.sensor_from_board
        crossings.append(on_board @ pose.rotation[:, :2].T + pose.translation_mm)
    found = [_comparison("algebraic", algebraic_plane(points), sheet, points)]
    methods: tuple[PlaneMethod, ...] = ("total least squares", "cross ratio")
    for method, chosen in zip(methods, (points, np.concatenate(crossings)), strict=True):
        plane = fit_plane(chosen)
        if not isinstance(plane, FitFailure):
            found.append(_comparison(method, plane.value.coefficients, sheet, points))
    return tuple(found)


def _comparison(
    method: PlaneMethod, plane: FloatArray, sheet: LightSheet, points_mm: FloatArray
) -> PlaneComparison:
    if plane[:3] @ sheet.axes[2] < 0.0:
        plane = -plane
    height, _, _ = sheet.height_with_jacobian(points_mm)
    on_sheet = points_mm - height[:, None] * sheet.axes[2]
    sine = float(np.linalg.norm(np.cross(plane[:3], sheet.axes[2])))
    a, b, c, d = (float(value) for value in plane)
    return PlaneComparison(
        method,
        (a, b, c, d),
        float(np.degrees(np.arcsin(min(sine, 1.0)))),
        float(np.abs(on_sheet @ plane[:3] + plane[3]).max()),
    )


def algebraic_plane(points_mm: FloatArray) -> FloatArray:
    """(4,) ``a b c D`` of the plane by eq. 2.44, scaled to a unit normal.

    The print lacks the inverse of the normal matrix. The method minimises the algebraic error
    ``a X + b Y + c Z - 1``, which is the distance over the plane's own distance from the camera:
    it draws the plane away from the camera.
    """
    coefficients = np.linalg.lstsq(points_mm, np.ones(len(points_mm)), rcond=None)[0]
    return np.asarray(np.array([*coefficients, -1.0]) / np.linalg.norm(coefficients))


def cross_ratio_points(view: TargetView, stripe_px: FloatArray, camera: CameraModel) -> FloatArray:
    """Points where a straight stripe crosses rows and columns of target points.

    In the undistorted image the stripe's line meets the line of a row. Four collinear points keep
    their cross ratio, so the known points of the row give the board coordinate of the crossing;
    three suffice, more are used by least squares of the row's projective map.

    Parameters
    ----------
    view
        The target; rows and columns are points with equal y, or equal x, on the board.
    stripe_px
        (K, 2) points of one straight stripe, full-sensor pixels.
    camera
        For undistortion.

    Returns
    -------
    (C, 2) crossings in the Board frame, mm.
    """
    stripe_xy, is_valid = camera.undistort(stripe_px)
    stripe = fit_line(stripe_xy[is_valid]) if is_valid.sum() >= 2 else FitFailure("no stripe")
    points_xy, is_known = camera.undistort(view.points_px)
    if isinstance(stripe, FitFailure):
        return np.zeros((0, 2))
    board = view.points_board_mm
    found = []
    for along in (0, 1):
        level = np.round(board[:, 1 - along], 9)
        for value in np.unique(level[is_known]):
            row = is_known & (level == value)
            coordinate = _crossing(points_xy[row], board[row, along], stripe)
            if coordinate is not None:
                crossing = np.full(2, value)
                crossing[along] = coordinate
                found.append(crossing)
    return np.array(found).reshape(-1, 2)


def _crossing(row_xy: FloatArray, row_mm: FloatArray, stripe: Line) -> float | None:
    """Board coordinate where the stripe crosses a row, or None where it does not."""
    line = fit_line(row_xy) if len(row_xy) >= MIN_COLLINEAR else FitFailure("no row")
    if isinstance(line, FitFailure):
        return None
    sine = line.direction[0] * stripe.direction[1] - line.direction[1] * stripe.direction[0]
    if abs(sine) < MIN_CROSSING_SINE:
        return None
    offset = stripe.point - line.point
    at = (offset[0] * stripe.direction[1] - offset[1] * stripe.direction[0]) / sine
    along = line.along(row_xy)
    if not along.min() <= at <= along.max():
        return None
    return projective_coordinate(along, row_mm, float(at))


def projective_coordinate(image: FloatArray, board_mm: FloatArray, at: float) -> float:
    """Board coordinate at the image coordinate ``at`` on a line of K >= 3 known points.

    ``image`` and ``board_mm`` (K,) are their coordinates along the line. The cross ratio with any
    three of the points equals that in the image; for K > 3 by least squares.
    """
    centre, reach = float(image.mean()), float(np.ptp(image))
    t = (image - centre) / reach
    middle, size = float(board_mm.mean()), float(np.ptp(board_mm))
    s = (board_mm - middle) / size
    # s = (h0 t + h1) / (h2 t + 1)
    design = np.stack([t, np.ones_like(t), -t * s], axis=1)
    h = np.linalg.lstsq(design, s, rcond=None)[0]
    t_at = (at - centre) / reach
    return float(middle + size * (h[0] * t_at + h[1]) / (h[2] * t_at + 1.0))
