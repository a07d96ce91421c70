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
    describe_geometry,
    refuse_few_boards,
    refuse_lost_spread,
    refuse_one_line,
)
from armscan.calibration.sheets.lack_of_fit import (
    StripeNoise,
    board_scatter,
    lack_of_fit,
    stripe_noise,
)
from armscan.calibration.sheets.result import LackOfFit, PlaneComparison, PlaneMethod, SheetOptions
from armscan.calibration.sheets.solve import (
    N_PLANE,
    CommonErrors,
    SheetObservations,
    SheetSolution,
    solve_sheets,
)
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Line, Plane, fit_line, fit_plane
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import BOW_TERMS, LightSheet
from armscan.vision.targets.target import TargetView

MIN_COLLINEAR = 3
MIN_CROSSING_SINE = 0.5
"""Rows that the stripe crosses at less than 30 degrees give no sharp point."""


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


def projective_coordinate(image: FloatArray, board_mm: FloatArray, at: float) -> float:
    """Board coordinate at the image coordinate ``at`` on a line of K >= 3 known points.

    Parameters
    ----------
    image, board_mm
        (K,) coordinates along the line in the image and on the board.
    at
        Image coordinate of the point sought.

    Returns
    -------
    The coordinate at which the cross ratio with any three of the points equals that in the image;
    for K > 3 by least squares.
    """
    centre, reach = float(image.mean()), float(np.ptp(image))
    t = (image - centre) / reach
    middle, size = float(board_mm.mean()), float(np.ptp(board_mm))
    s = (board_mm - middle) / size
    # s = (h0 t + h1) / (h2 t + 1)
    design = np.stack([t, np.ones_like(t), -t * s], axis=1)
    h = np.linalg.lstsq(design, s, rcond=None)[0]
    here = (at - centre) / reach
    return float(middle + size * (h[0] * here + h[1]) / (h[2] * here + 1.0))


def _crossing(row_xy: FloatArray, row_mm: FloatArray, stripe: Line) -> float | None:
    """Board coordinate where the stripe crosses a row, or None where it does not."""
    if len(row_xy) < MIN_COLLINEAR:
        return None
    line = fit_line(row_xy)
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


def algebraic_plane(points_mm: FloatArray) -> FloatArray:
    """(4,) ``a b c D`` of the plane by eq. 2.44, scaled to a unit normal.

    The print lacks the inverse of the normal matrix. The method minimises the algebraic error
    ``a X + b Y + c Z - 1``, which is the distance over the plane's own distance from the camera:
    it draws the plane away from the camera.
    """
    coefficients = np.linalg.lstsq(points_mm, np.ones(len(points_mm)), rcond=None)[0]
    return np.asarray(np.array([*coefficients, -1.0]) / np.linalg.norm(coefficients))


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


def compare_planes(
    sheet: LightSheet,
    points_mm: FloatArray,
    images: Sequence[BoardImage],
    stripes: Sequence[tuple[int, IntArray]],
    cameras: HeadCameras,
) -> tuple[PlaneComparison, ...]:
    """Compare eq. 2.44, total least squares and the cross-ratio points with the sheet in use.

    Parameters
    ----------
    sheet
        The sheet in use.
    points_mm
        (N, 3) its points.
    images, stripes
        Image number and profile rows of each of its stripes.
    cameras
        For the cross-ratio points.
    """
    found = [_comparison("algebraic", algebraic_plane(points_mm), sheet, points_mm)]
    total = fit_plane(points_mm)
    if not isinstance(total, FitFailure):
        plane = total.value.coefficients
        found.append(_comparison("total least squares", plane, sheet, points_mm))
    crossings = []
    for i, rows in stripes:
        data = images[i].data
        camera = cameras.model(data.camera)
        on_board = cross_ratio_points(data.view, data.profile.points_px[rows], camera)
        pose = images[i].placed.sensor_from_board
        crossings.append(on_board @ pose.rotation[:, :2].T + pose.translation_mm)
    crossed = fit_plane(np.concatenate(crossings))
    if not isinstance(crossed, FitFailure):
        plane = crossed.value.coefficients
        found.append(_comparison("cross ratio", plane, sheet, points_mm))
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


MAX_BOW_CONDITION = 1e7
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
    plane_test: LackOfFit
    final_test: LackOfFit
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
    return describe_geometry(sheet, observations.points_mm, normals)


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
    directions = _stripe_directions(observations)
    sheet = sheet_from_plane(plane.value, observations.points_mm, directions)
    geometry = sheet_geometry(sheet, observations, images)
    refused = refuse_one_line(name, geometry)
    if refused is None:
        uncertain = _across_sigma_mm(sheet, observations, images)
        refused = refuse_lost_spread(name, geometry, uncertain)
    return sheet if refused is None else refused


def _across_sigma_mm(
    sheet: LightSheet, observations: SheetObservations, images: Sequence[BoardImage]
) -> float:
    """Root mean square sigma, by the boards' poses, of where points lie across the stripes."""
    by_pose = np.einsum("i,nij->nj", sheet.axes[1], observations.by_pose)
    total = 0.0
    for i in np.unique(observations.image):
        own = by_pose[observations.image == i]
        covariance = images[i].placed.covariance
        total += float(np.einsum("ni,ij,nj->", own, covariance, own))
    return float(np.sqrt(max(total, 0.0) / len(observations)))


def _stripe_directions(observations: SheetObservations) -> FloatArray:
    directions = []
    for stripe in np.unique(observations.stripe):
        points = observations.points_mm[observations.stripe == stripe]
        directions.append((points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0]))
    return np.stack(directions)


def choose_model(
    observations: SheetObservations,
    start: LightSheet,
    errors: CommonErrors,
    options: SheetOptions,
) -> SheetModel | FitFailure:
    """Fit the plane, test its fit, and let the sheet bow if the test asks for it."""
    alone = observations.as_one_sheet()
    noise = stripe_noise(alone, alone.residuals_px([start])[1])
    flat = solve_sheets(alone, [start], errors, [False], sigma_factor=noise.sigma_factor)
    if not isinstance(flat, FitFailure):
        noise = stripe_noise(alone, flat.remaining_px)
        flat = solve_sheets(alone, [start], errors, [False], sigma_factor=noise.sigma_factor)
    if isinstance(flat, FitFailure):
        return flat
    plane_test = lack_of_fit(alone, flat, noise)
    test = f"lack of fit F {plane_test.f_ratio:.2f}, p {plane_test.p_value:.2g}"

    plane_model = SheetModel(
        flat.sheets[0], False, noise, plane_test, plane_test, "", noise.sigma_factor
    )

    n_boards = len(np.unique(observations.board))

    def plane(decision: str) -> SheetModel | FitFailure:
        model = replace(plane_model, decision=decision)
        if n_boards == NO_SPARE:
            # one height is left over, and no test of it has power: its likeliest cause is taken
            scatter = board_scatter(alone, flat, errors, noise)
            factor = min(scatter.factor, MOST_OF_TWO)
            return _with_scattered_boards(model, factor, alone, errors, options)
        return _with_explained_stripes(model, alone, errors, options)

    if plane_test.p_value >= options.lack_of_fit_p:
        return plane(f"a plane is enough ({test})")
    if n_boards < options.min_boards_for_bow:
        decision = (
            f"a plane does not explain the stripes ({test}), but {n_boards} boards cannot tell a "
            f"bow from their own errors: {options.min_boards_for_bow} are needed"
        )
        return plane(decision)
    return _bow_or_boards(plane_model, flat, alone, errors, options)


def _bow_or_boards(
    plane_model: SheetModel,
    flat: SheetSolution,
    alone: SheetObservations,
    errors: CommonErrors,
    options: SheetOptions,
) -> SheetModel | FitFailure:
    """What a plane leaves unexplained: is the sheet bowed, or do its boards scatter?"""
    noise, plane_test = plane_model.noise, plane_model.plane_test
    test = f"lack of fit F {plane_test.f_ratio:.2f}, p {plane_test.p_value:.2g}"
    boards = board_scatter(alone, flat, errors, noise)

    def plane(decision: str) -> SheetModel | FitFailure:
        model = replace(plane_model, decision=decision)
        return _with_scattered_boards(model, boards.factor, alone, errors, options)

    if not options.is_bow_allowed:
        return plane(f"a plane was asked for, and does not explain the stripes ({test})")
    condition = _bow_condition(alone, flat)
    bowed = _solve_bowed(alone, flat.sheets[0], errors, noise.sigma_factor)
    if condition > MAX_BOW_CONDITION or isinstance(bowed, FitFailure):
        return plane(
            f"a plane does not explain the stripes ({test}), but the boards do not spread enough "
            f"to determine a bow (condition {condition:.2g})"
        )
    boards_bowed = board_scatter(alone, bowed, errors, noise)
    gain = 2.0 * (boards_bowed.log_likelihood - boards.log_likelihood)
    p_value = float(stats.chi2.sf(max(gain, 0.0), bowed.n_parameters - flat.n_parameters))
    likelihood = f"likelihood ratio {gain:.1f}, p {p_value:.2g}"
    if p_value >= options.lack_of_fit_p:
        return plane(
            f"a plane does not explain the stripes ({test}), and a bow does no better than boards "
            f"that err {boards.factor:.1f} times as much as their targets say ({likelihood})"
        )
    final = lack_of_fit(alone, bowed, noise)
    decision = (
        f"bow fitted: the plane does not explain the stripes ({test}), the bow does better "
        f"({likelihood})"
    )
    model = SheetModel(
        bowed.sheets[0], True, noise, plane_test, final, decision, noise.sigma_factor
    )
    if final.p_value >= options.lack_of_fit_p:
        return model
    return _with_scattered_boards(model, boards_bowed.factor, alone, errors, options)


def _with_scattered_boards(
    model: SheetModel,
    board_factor: float,
    observations: SheetObservations,
    errors: CommonErrors,
    options: SheetOptions,
) -> SheetModel | FitFailure:
    """Charge to the boards what they scatter, and to the stripes what is then left."""
    wider = errors.with_boards(board_factor)
    solution = solve_sheets(
        observations,
        [model.sheet],
        wider,
        [model.is_bowed],
        sigma_factor=model.noise.sigma_factor,
    )
    if isinstance(solution, FitFailure):
        return solution
    model = replace(
        model,
        sheet=solution.sheets[0],
        final_test=lack_of_fit(observations, solution, model.noise),
        board_factor=board_factor,
    )
    return _with_explained_stripes(model, observations, wider, options)


def _solve_bowed(
    observations: SheetObservations, start: LightSheet, errors: CommonErrors, sigma_factor: float
) -> SheetSolution | FitFailure:
    """Fit a bowed sheet, and find from the bow itself how its light spreads.

    Where the rays come from shows in how the bow along the stripe changes with depth: to first
    order a fan adds ``-2 lean u v - spread u^2 v`` to ``u^2``.
    """
    solution = solve_sheets(observations, [start], errors, [True], sigma_factor=sigma_factor)
    for _ in range(FAN_ROUNDS):
        if isinstance(solution, FitFailure):
            return solution
        sheet = solution.sheets[0]
        bow = sheet.bow_mm[U2]
        variance = np.diag(solution.covariance)[errors.n_camera + N_PLANE :]
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
        solution = solve_sheets(observations, [start], errors, [True], sigma_factor=sigma_factor)
    return solution


def _with_explained_stripes(
    model: SheetModel,
    observations: SheetObservations,
    errors: CommonErrors,
    options: SheetOptions,
) -> SheetModel | FitFailure:
    """Raise the stripes' sigmas until the model fits, if it did not.

    What neither the model nor the boards' scatter explains is charged to the stripes. The
    covariance of the sheet grows with it.
    """
    factor, test, sheet = model.sigma_factor, model.final_test, model.sheet
    for _ in range(MAX_RAISES):
        if test.p_value >= options.lack_of_fit_p or test.f_ratio <= 1.0:
            break
        factor *= float(np.sqrt(test.f_ratio))
        solution = solve_sheets(
            observations, [sheet], errors, [model.is_bowed], sigma_factor=factor
        )
        if isinstance(solution, FitFailure):
            return solution
        sheet = solution.sheets[0]
        test = lack_of_fit(observations, solution, model.noise, factor)
    return replace(model, sheet=sheet, sigma_factor=factor)


def _bow_condition(observations: SheetObservations, flat: SheetSolution) -> float:
    """Condition number of plane and bow terms together, columns scaled alike."""
    _, _, by_sheet = flat.sheets[0].height_with_jacobian(observations.points_mm)
    scaled = by_sheet / np.maximum(np.linalg.norm(by_sheet, axis=0), 1e-300)
    values = np.linalg.eigvalsh(scaled.T @ scaled)
    return float(values[-1] / max(values[0], 1e-300))
