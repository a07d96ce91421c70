# SPDX-License-Identifier: Apache-2.0
"""Points that the stored calibration makes of its own stripes, against the boards they lay on.

A camera and a sheet may each look right and not belong together; what counts is the points that
they make. The stripes are reconstructed as any later stripe is: the pixel's ray meets the sheet.
The distance of these points from the boards' planes has a claimed standard deviation, that of the
difference of two things that share the cameras, and, where the board took part in the fit, its
errors. Each board is also left out: its points then rest on the other boards alone.

What a sheet's model leaves of its shape shows in the same place of the sheet on every board.

Beside it stand other methods: eq. 2.44, total least squares and cross ratios on rows of points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from armscan.calibration.sheets.board_points import HeadCameras, intersect_sheet_of
from armscan.calibration.sheets.model import StripeNoise, lack_of_fit, stripe_noise
from armscan.calibration.sheets.result import (
    LACK_OF_FIT_P,
    BoardDistances,
    BoardPointCheck,
    PlaneComparison,
    PlaneMethod,
    SheetPointCheck,
)
from armscan.calibration.sheets.solve import (
    N_SHEET,
    CommonErrors,
    NormalSolution,
    SheetObservations,
    SheetSolution,
    solve_sheets,
)
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Line, fit_line, fit_plane
from armscan.models.calibration import FTest
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.vision.targets.target import TargetView

FEWEST_OTHERS = 2
"""Boards that must remain when one is left out: the stripe of one alone is a line."""


def check_points(
    observations: SheetObservations,
    solution: SheetSolution,
    noise_px: FloatArray,
    images: Sequence[BoardImage],
    cameras: HeadCameras,
) -> tuple[SheetPointCheck, ...]:
    """Reconstruct the stripes with a solution of held cameras and compare them with their boards.

    ``noise_px`` (N,) is the scatter of the single points used; the solution's weights hold the
    larger one with which they count as independent.
    """
    case = _Case(observations, solution, noise_px, images, cameras)
    fitted = _Claim(case, solution.normal, is_in_fit=True)
    distance = case.distance_mm(solution.sheets)
    left_out = {int(board): case.without(int(board)) for board in np.unique(observations.board)}
    checks = []
    for k in range(len(solution.sheets)):
        of_sheet = observations.sheet == k
        boards = []
        numbers = np.unique(observations.board[of_sheet])
        for board in numbers:
            rows = of_sheet & (observations.board == board)
            others = left_out[int(board)] if len(numbers) > FEWEST_OTHERS else None
            alone = None
            if others is not None:
                alone = others[1].distances(rows, case.distance_mm(others[0], rows))
            source = images[int(observations.image[rows][0])].data.profile.source
            depth_mm = float(observations.points_mm[rows, 2].mean())
            boards.append(
                BoardPointCheck(source, depth_mm, fitted.distances(rows, distance), alone)
            )
        rms, claimed = (
            _pooled(
                [(b.left_out.n_points, getattr(b.left_out, name)) for b in boards if b.left_out]
            )
            for name in ("rms_mm", "claimed_rms_mm")
        )
        whole = fitted.distances(of_sheet, distance)
        checks.append(SheetPointCheck(whole, rms, claimed, tuple(boards)))
    return tuple(checks)


def _pooled(parts: Sequence[tuple[int, float]]) -> float:
    """Root mean square of all points from (count, root mean square) of parts; NaN for none."""
    count = sum(n for n, _ in parts)
    return float(np.sqrt(sum(n * rms**2 for n, rms in parts) / count)) if count else float("nan")


@dataclass(frozen=True, eq=False)
class _Case:
    """The points used and the solution, as `check_points` has them."""

    observations: SheetObservations
    solution: SheetSolution
    noise_px: FloatArray
    images: Sequence[BoardImage]
    cameras: HeadCameras

    def distance_mm(
        self, sheets: Sequence[LightSheet], rows: BoolArray | None = None
    ) -> FloatArray:
        """(N,) distance from their boards of points made with the sheets.

        NaN where there is none, and for points that are not asked for.
        """
        found = np.full(len(self.observations), np.nan)
        for of in self.observations.each_stripe():
            if rows is not None and not rows[of].any():
                continue
            image, k = self._stripe(of)
            q = image.data.profile.points_px[self.observations.row[of]]
            points, is_met = intersect_sheet_of(q, image.data.camera, sheets[k], self.cameras)
            pose = image.placed.sensor_from_board
            distance = (points - pose.translation_mm) @ pose.rotation[:, 2]
            if image.bow is not None:
                distance = distance - image.bow.height_mm(points, pose)
            found[of] = np.where(is_met, distance, np.nan)
        return found

    @cached_property
    def mm_per_px(self) -> FloatArray:
        """(N,) change of that distance for one pixel of residual.

        A point of the board that lies ``h`` above the sheet slides along its ray by ``-h / (g.d)``,
        with the sheet's gradient g and the ray's direction d.
        """
        found = np.zeros(len(self.observations))
        for of in self.observations.each_stripe():
            image, k = self._stripe(of)
            points = self.observations.points_mm[of]
            _, gradient, _ = self.solution.sheets[k].height_with_jacobian(points)
            ray = points - self.cameras.centre_mm(image.data.camera)
            normal = image.placed.sensor_from_board.rotation[:, 2]
            per_px = np.einsum("ni,ni->n", gradient, self.observations.across_mm_px[of])
            found[of] = -(ray @ normal) / np.einsum("ni,ni->n", gradient, ray) * per_px
        return found

    def _stripe(self, of: IntArray) -> tuple[BoardImage, int]:
        image = self.images[int(self.observations.image[of[0]])]
        return image, int(self.observations.sheet[of[0]])

    def without(self, board: int) -> tuple[list[LightSheet], _Claim] | None:
        """Sheets of all boards but one, by one step from those of all; None if not determined."""
        solution = self.solution
        n_held = solution.normal.follow.shape[1]
        normal = solution.system.solve(solution.weight, n_held, without_board=board)
        if normal is None:
            return None
        step = np.zeros(len(solution.active))
        step[solution.active] = normal.step[: normal.n_sheet]
        sheets = [
            sheet.updated(step[N_SHEET * k : N_SHEET * (k + 1)])
            for k, sheet in enumerate(solution.sheets)
        ]
        return sheets, _Claim(self, normal, is_in_fit=False)


class _Claim:
    """What the normal equations claim of residuals that no board was moved for.

    A residual is ``r = B w_b + C w_c + e + A e_s``: errors of boards and cameras in their own
    sigmas, the stripe's noise, and the sheets' error, ``e_s = F w_c + K w_b - G e`` where the board
    took part in the fit.
    """

    def __init__(self, case: _Case, normal: NormalSolution, *, is_in_fit: bool) -> None:
        self._case, self._normal, self._is_in_fit = case, normal, is_in_fit

    def distances(self, rows: BoolArray, distance_mm: FloatArray) -> BoardDistances:
        """Figures of the points ``rows`` (N,), with the claims for them."""
        rows = rows & np.isfinite(distance_mm)
        n = int(rows.sum())
        solution, mm_per_px = self._case.solution, self._case.mm_per_px
        # The mean: points count with the noise of the weights.
        share = np.where(rows, mm_per_px / n, 0.0)
        pull = np.zeros((1, solution.system.n_columns))
        noise = np.array([(share**2 / solution.weight).sum()])
        variance = np.zeros(len(rows))
        for stripe in solution.system.stripes:
            if rows[stripe.rows].any():
                pull[0, stripe.columns] += share[stripe.rows] @ stripe.design
                design = np.zeros((len(stripe.rows), solution.system.n_columns))
                design[:, stripe.columns] = stripe.design
                noise_px2 = self._case.noise_px[stripe.rows] ** 2
                variance[stripe.rows] = self._variances(design, noise_px2)
        return BoardDistances(
            n,
            float(distance_mm[rows].mean()),
            float(np.sqrt(self._variances(pull, noise)[0])),
            float(np.sqrt((distance_mm[rows] ** 2).mean())),
            float(np.sqrt((mm_per_px**2 * variance)[rows].sum() / n)),
        )

    def _variances(self, pull: FloatArray, noise: FloatArray) -> FloatArray:
        """(K,) of sums of residuals with derivatives (K, n_columns) by the unknowns, and noise."""
        normal = self._normal
        by_sheet, by_board = pull[:, : normal.n_sheet], pull[:, normal.n_sheet : normal.n_free]
        by_camera = pull[:, normal.n_free :] + by_sheet @ normal.follow
        covariance, lever = normal.covariance, np.zeros_like(by_sheet)
        if self._is_in_fit:
            covariance, lever = normal.by_stripes, 2.0 * pull[:, : normal.n_free] @ normal.gain.T
            by_board = by_board + by_sheet @ normal.by_boards
        total = noise + (by_camera**2).sum(axis=1) + (by_board**2).sum(axis=1)
        total = total + ((by_sheet @ covariance - lever) * by_sheet).sum(axis=1)
        return np.asarray(np.maximum(total, 0.0))


FEWEST_BOARDS = 4
"""For an outlier among them: with fewer, two are left of which each explains the other."""
CLEAR_CHI2 = 36.0
"""By how much more chi-square, six sigma, an outlier leaves than any other board: of any misfit
that is spread over the boards, as of a bow, leaving out one or the other takes the significance."""


def find_outlier_view(
    observations: SheetObservations, sheet: LightSheet, errors: CommonErrors
) -> int | None:
    """Number of an image without whose board a plane explains all others, or None.

    ``observations`` are points of one sheet that a plane does not explain; fits start at ``sheet``.
    """
    alone = observations.as_one_sheet()
    boards = np.unique(alone.board)
    if len(boards) < FEWEST_BOARDS:
        return None
    noise = stripe_noise(alone, alone.residuals_px([sheet])[1])
    whole = solve_sheets(alone, [sheet], errors, [False], sigma_factor=noise.sigma_factor)
    if isinstance(whole, FitFailure):
        return None
    tests = {board: _test_without(int(board), alone, whole, noise) for board in boards}
    misfit = {board: test.f_ratio * test.degrees_of_freedom for board, test in tests.items()}
    best, second = sorted(misfit, key=lambda board: misfit[board])[:2]
    is_clear = CLEAR_CHI2 <= misfit[second] - misfit[best] < math.inf
    if tests[best].p_value < LACK_OF_FIT_P or not is_clear:
        return None
    return int(alone.image[alone.board == best][0])


def _test_without(
    board: int, observations: SheetObservations, whole: SheetSolution, noise: StripeNoise
) -> FTest:
    """Of the lack of fit of all other boards, by one step from the plane of all."""
    normal = whole.system.solve(whole.weight, 0, without_board=board)
    if normal is None:
        return FTest(f_ratio=math.inf, degrees_of_freedom=1, p_value=0.0)
    rest = observations.board != board
    remaining = (whole.system.residual_px + whole.system.times(normal.step))[rest]
    common = normal.step[normal.n_sheet :]
    chi2 = float((whole.weight[rest] * remaining**2).sum() + common @ common)
    share = replace(noise, degrees_of_freedom=noise.degrees_of_freedom * float(rest.mean()))
    n_stripes = len(np.unique(observations.stripe[rest]))
    return lack_of_fit(chi2, n_stripes, whole.n_parameters, share)


MIN_COLLINEAR = 3
MIN_CROSSING_SINE = 0.5
"""Rows that the stripe crosses at less than 30 degrees give no sharp point."""


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
        image = images[int(observations.image[of[0]])]
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

    Rows and columns of the view are points with equal y, or equal x, on the board; ``stripe_px``
    (K, 2) are points of one straight stripe. The crossings (C, 2) are in the Board frame, mm.
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


CELLS = 12
"""Pieces into which a stripe is cut, along the sheet's extent."""
SHAPE_LENGTH = 0.2
"""Distance over which a sheet's shape is alike, as a part of its extent: 15 mm of 75 mm."""
SHAPE_STEPS = np.linspace(0.0, 1.0, 13) ** 2
LARGEST_SHAPE = 2.0
"""Shapes up to this many times the residuals' root mean square are thought of."""


def estimate_shapes_mm(
    observations: SheetObservations, solution: SheetSolution, noise_px: FloatArray
) -> tuple[float, ...]:
    """Standard deviation by which each sheet leaves its model, smoothly over the sheet.

    Distances of the stripes from their sheet have four sources: noise, the boards' and the cameras'
    errors, a course of its own that each stripe has (a bent board), and the sheet's shape, which
    alone is the same on all boards at one place of the sheet. Their variances are told from each
    other by restricted likelihood (Patterson and Thompson 1971): the sheet's parameters are free,
    boards and cameras have their covariance, the last two are smooth fields of unknown size. Of the
    shape's variance the mean over the likelihood is returned, all sizes up to the residuals' own
    being alike beforehand: where few boards tell little, it stays as large as it may be.

    ``noise_px`` (N,) is the standard deviation with which points count as independent.
    """
    return tuple(
        _shape_mm(_cells(observations, solution, noise_px, k)) for k in range(len(solution.sheets))
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Mean distances (C,) in mm of pieces of the stripes of one sheet, and what they rest on.

    ``by_sheet`` (C, F) and ``by_others`` (C, O): derivatives by the sheet's free parameters, and by
    boards, cameras and a bow that is likely to be small, in their own sigmas; the distances are
    those without that bow, of which it leaves ``rms_mm``. ``noise_mm2`` (C,). ``place_mm`` (C, 2)
    on the sheet. ``stripe`` (C,) number of the stripe.
    """

    height_mm: FloatArray
    rms_mm: float
    by_sheet: FloatArray
    by_others: FloatArray
    noise_mm2: FloatArray
    place_mm: FloatArray
    stripe: IntArray


def _cells(
    observations: SheetObservations, solution: SheetSolution, noise_px: FloatArray, k: int
) -> _Cells:
    system, sheet = solution.system, solution.sheets[k]
    place = (observations.points_mm - sheet.origin_mm) @ sheet.axes[:2].T
    along = place[observations.sheet == k, 0]
    step = max(float(np.ptp(along)) / CELLS, 1e-9)
    gradient = sheet.height_with_jacobian(observations.points_mm)[1]
    mm_per_px = np.einsum("ni,ni->n", gradient, observations.across_mm_px)
    height, design, noise, places, stripes = [], [], [], [], []
    for number, stripe in enumerate(system.stripes):
        if observations.sheet[stripe.rows[0]] != k:
            continue
        piece = np.floor((place[stripe.rows, 0] - along.min()) / step).astype(np.int64)
        for cell in np.unique(piece):
            own = piece == cell
            rows = stripe.rows[own]
            by_all = np.zeros(system.n_columns)
            by_all[stripe.columns] = (mm_per_px[rows, None] * stripe.design[own]).mean(axis=0)
            height.append(float(system.height_mm[rows].mean()))
            design.append(by_all)
            noise.append(float(((noise_px * mm_per_px)[rows] ** 2).mean()) / len(rows))
            places.append(place[rows].mean(axis=0))
            stripes.append(number)
    by_all = np.array(design)
    is_used = np.any(by_all != 0.0, axis=0)
    is_free = np.arange(system.n_columns) < system.n_sheet
    likely = np.flatnonzero(system.precision)
    is_free[likely] = False
    without_bow = np.array(height) - by_all[:, likely] @ system.bow_mm[likely]
    by_all[:, likely] /= np.sqrt(system.precision[likely])
    return _Cells(
        without_bow,
        float(np.sqrt(np.mean(np.square(height)))),
        by_all[:, is_used & is_free],
        by_all[:, is_used & ~is_free],
        np.array(noise),
        np.array(places),
        np.array(stripes),
    )


def _shape_mm(cells: _Cells) -> float:
    length = max(SHAPE_LENGTH * float(np.ptp(cells.place_mm[:, 0])), 1e-9)
    apart = cells.place_mm[:, None] - cells.place_mm[None, :]
    alike = np.exp(-0.5 * np.sum(apart**2, axis=2) / length**2)
    own = alike * (cells.stripe[:, None] == cells.stripe[None, :])
    known = np.diag(cells.noise_mm2) + cells.by_others @ cells.by_others.T
    scale = np.sqrt(np.sum(cells.by_sheet**2, axis=0))
    free = cells.by_sheet / scale
    sizes = LARGEST_SHAPE * cells.rms_mm * SHAPE_STEPS
    steps = np.gradient(SHAPE_STEPS)
    likelihood = np.array(
        [
            [
                _restricted(known + s * s * alike + t * t * own, free, cells.height_mm)
                for t in sizes[::2]
            ]
            for s in sizes
        ]
    )
    weight = np.exp(likelihood - likelihood.max()) * steps[:, None] * np.gradient(SHAPE_STEPS[::2])
    return float(np.sqrt(weight.sum(axis=1) @ sizes**2 / weight.sum()))


def _restricted(covariance: FloatArray, free: FloatArray, value: FloatArray) -> float:
    """Logarithm of the restricted likelihood of ``value`` (C,), up to a constant."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, np.column_stack([free, value]))
    q, r = np.linalg.qr(white[:, :-1])
    left = white[:, -1] - q @ (q.T @ white[:, -1])
    logs = np.log(np.diag(root)).sum() + np.log(np.abs(np.diag(r))).sum()
    return float(-logs - 0.5 * left @ left)
