# SPDX-License-Identifier: Apache-2.0
"""Does the sheet's model explain the stripes? F test against the noise along each stripe, the
scatter between boards, and the view without which a plane would do.

A board that is bent, or a lens that the camera's model does not follow, moves a board's stripe as a
whole: more than the covariance of its pose allows, and differently on every board. A bow of the
sheet moves them all by one law, and curves them. The likelihood of both readings tells them apart;
against the noise along the stripes alone, either would look certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, fdtrc

from armscan.calibration.sheets.coplanarity import SheetGeometry, refuse_lost_spread
from armscan.calibration.sheets.result import LACK_OF_FIT_P
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
from armscan.geometry.least_squares import p_text, robust_sigma
from armscan.geometry.shapes import Plane, fit_plane
from armscan.models.calibration import FTest
from armscan.models.light_sheet import BOW_TERMS, MAX_FAN, LightSheet

SHAPE_DEGREE = 3
N_SHAPE = SHAPE_DEGREE + 1
MAX_LAG = 100
CORRELATION_ROUNDS = 20
MAX_TAKEN = 0.5
"""Largest share of the noise that the cubic is believed to take."""
MEDIAN_VARIANCE = 1.36
"""Of the logarithm of a standard deviation by the median, times the count of points: it is 0.37
times as efficient as the mean square."""
BOARD_SHAPES = 3
"""Offset, slope and curvature of a stripe."""
POSE_SHAPES = 2
"""The first two of them: what a board's pose makes."""
LEAST_POINTS = 8
"""With fewer points left of it a stripe has no shape."""
FACTORS = np.geomspace(1.0, 100.0, 81)
"""Scatter of the boards that is tried, in steps of 6 %."""
STRAY_SHARE = 0.1
"""Boards that stray: rare enough to leave boards alone that scatter alike (their scatter rises by
a few hundredths), common enough that one of few may."""
FORMS_PX = np.append(0.0, np.geomspace(0.01, 10.0, 37))
"""Form of the boards that is tried, in steps of 21 %."""


@dataclass(frozen=True, slots=True)
class StripeNoise:
    """Scatter of the points around a smooth course of each stripe.

    ``factor`` is their standard deviation over what the stripes' sigmas claim, and
    ``correlation_points`` the variance of a mean over that of independent points: 1 + 2 sum of the
    correlations. ``degrees_of_freedom`` of the factor are counted in points: each shape term of a
    stripe takes the noise of as many points as count as one.
    """

    factor: float
    correlation_points: float
    degrees_of_freedom: float

    @property
    def sigma_factor(self) -> float:
        """By which a sigma must be multiplied so that points count as independent."""
        return self.factor * float(np.sqrt(self.correlation_points))

    @property
    def effective_freedom(self) -> float:
        """Degrees of freedom counted in independent points."""
        return self.degrees_of_freedom / self.correlation_points


def stripe_noise(observations: SheetObservations, residual_px: FloatArray) -> StripeNoise:
    """Estimate the noise of the stripes from their scatter around a cubic course.

    ``residual_px`` (N,) are residuals from the sheets; a smooth misfit does not matter.
    """
    rest = [
        _off_course(observations.select(of), residual_px[of]) for of in observations.each_stripe()
    ]
    squares = sum(float(left @ left) for left in rest)
    correlation = _correlation(rest)
    count = sum(len(left) for left in rest)
    freedom = max(count - N_SHAPE * len(rest) * correlation, 1.0)
    return StripeNoise(float(np.sqrt(squares / freedom)), correlation, freedom)


def scatter_by_stripe(observations: SheetObservations, residual_px: FloatArray) -> FloatArray:
    """(N,) scatter of each point's stripe over what its sigmas claim.

    The stripes of one calibration lie on boards of different brightness and slant, and their
    claims may be wrong by different factors: one that claims too little would outweigh all others.
    So would one of few points whose median happens to be small. Each stripe's own scatter, by the
    median, therefore counts as much as it is known, and what all have in common for the rest: its
    logarithm is the posterior mean beside a normal distribution over the stripes, whose width comes
    from what they differ by more than medians of independent points err (DerSimonian and Laird
    1986, eqs. 7 to 9). Medians of points that are alike err more; such stripes keep their own. A
    stripe with no more points than its course has terms tells nothing, and takes the mean of all.
    """
    stripes = observations.each_stripe()
    rest = [_off_course(observations.select(of), residual_px[of]) for of in stripes]
    own = np.array([robust_sigma(left) for left in rest])
    free = np.array([len(left) - N_SHAPE for left in rest])
    is_known = (own > 0.0) & (free > 0)
    factor = np.ones(len(observations))
    if not is_known.any():
        return factor
    logarithms = np.log(own, out=np.zeros(len(own)), where=is_known)
    variances = np.divide(MEDIAN_VARIANCE, free, out=np.full(len(own), np.inf), where=is_known)
    for stripe, logarithm in zip(stripes, _moderated(logarithms, variances), strict=True):
        factor[stripe] = np.exp(logarithm)
    return factor


def _moderated(values: FloatArray, variances: FloatArray) -> FloatArray:
    """(K,) posterior means of values that differ by an unknown variance and err by known ones,
    infinite where a value tells nothing.
    """
    weight = 1.0 / variances
    mean = weight @ values / weight.sum()
    excess = weight @ (values - mean) ** 2 - (np.count_nonzero(weight) - 1)
    between = max(float(excess), 0.0) / max(weight.sum() - weight @ weight / weight.sum(), 1e-300)
    whole = 1.0 / (variances + between)
    mean = whole @ values / whole.sum()
    return np.asarray(mean + between * whole * (values - mean))


def _course(stripe: SheetObservations, degree: int) -> FloatArray:
    """(N, degree + 1) Legendre polynomials along one stripe."""
    along = (stripe.points_mm - stripe.points_mm[0]) @ (stripe.points_mm[-1] - stripe.points_mm[0])
    t = 2.0 * (along - along.min()) / max(float(np.ptp(along)), 1e-12) - 1.0
    return np.asarray(np.polynomial.legendre.legvander(t, degree))


def _off_course(stripe: SheetObservations, residual_px: FloatArray) -> FloatArray:
    """What one stripe's residuals leave of a cubic course, in the points' own sigmas."""
    design = _course(stripe, SHAPE_DEGREE) / stripe.sigma_px[:, None]
    normalised = residual_px / stripe.sigma_px
    return np.asarray(normalised - design @ np.linalg.lstsq(design, normalised, rcond=None)[0])


def _correlation(rest: list[FloatArray]) -> float:
    """Sum the correlations over the lags until they drown in their own noise.

    The cubic takes a share of the noise with it, which lowers every correlation by about that
    share; it depends on the sum itself, hence the rounds.
    """
    count = sum(len(left) for left in rest)
    power = sum(float(left @ left) for left in rest) / count
    lags: list[float] = []
    for lag in range(1, MAX_LAG + 1):
        pairs = [(left[:-lag], left[lag:]) for left in rest if len(left) > 4 * lag]
        n_pairs = sum(len(a) for a, _ in pairs)
        if n_pairs == 0 or power == 0.0:
            break
        rho = sum(float(a @ b) for a, b in pairs) / n_pairs / power
        if rho < 2.5 / np.sqrt(n_pairs):
            break
        lags.append(rho)
    correlation = 1.0
    for _ in range(CORRELATION_ROUNDS if lags else 0):
        taken = min(N_SHAPE * len(rest) * correlation / count, MAX_TAKEN)
        correlation = 1.0 + 2.0 * float((np.array(lags) * (1.0 - taken) + taken).sum())
    return min(correlation, MAX_TAKEN * count / (N_SHAPE * len(rest)))


def lack_of_fit(
    chi2: float,
    n_stripes: int,
    n_parameters: int,
    noise: StripeNoise,
    sigma_factor: float | None = None,
) -> FTest:
    """Test a solution that was weighted with ``noise.sigma_factor``, or with a larger one.

    Of each stripe the first four shape terms (offset, slope, curvature, twist) are compared with
    the model; what scatters around them is the noise. Board and camera errors are free within
    their covariance, and cost what that covariance says.
    """
    freedom = N_SHAPE * n_stripes - n_parameters
    if freedom <= 0:
        return FTest(f_ratio=0.0, degrees_of_freedom=0, p_value=1.0)
    share = (noise.sigma_factor / (sigma_factor or noise.sigma_factor)) ** 2
    ratio = max(chi2 - noise.effective_freedom * share, 0.0) / freedom
    p_value = float(fdtrc(freedom, max(noise.effective_freedom, 1.0), ratio))
    return FTest(f_ratio=ratio, degrees_of_freedom=freedom, p_value=p_value)


@dataclass(frozen=True, slots=True)
class BoardScatter:
    """Likeliest scatter of the boards under a model of the sheet.

    ``factor``, at least 1, is the standard deviations of the boards' poses over what is claimed for
    them, by the offsets and slopes of the stripes; ``of_boards`` (M,) those of each board by the
    mean of its weight, larger for boards that stray, ``of_places`` the logarithm of its likelihood.
    ``log_likelihood`` is that of the stripes' shapes, curvature included, up to a constant that all
    models share: of poses that scatter, and of what each board's own form, or the lens where it
    stands, adds to every shape term. A pose does not curve a stripe, and a bend is not a pose that
    is known a hundred times worse.
    """

    factor: float
    of_boards: tuple[float, ...]
    of_places: float
    log_likelihood: float


def board_scatter(
    observations: SheetObservations,
    solution: SheetSolution,
    errors: CommonErrors,
    noise: StripeNoise,
) -> BoardScatter:
    """Estimate by restricted likelihood how much the boards of one sheet scatter.

    Boards scatter alike, but for one in ten (`STRAY_SHARE`), which strays by an unknown factor
    more: seen in part, bent or found wrongly, it would make all others look badly known.

    ``solution`` is a model fitted to the sheet's points with the cameras free, ``errors`` the
    claimed covariance of boards and cameras, ``noise`` that of the points along the stripes.
    """
    _, residual, _, by_point = observations.residuals_px(solution.sheets)
    by_pose = np.einsum("ni,nij->nj", by_point, observations.dpoint_dpose)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.dpoint_dcamera)
    moved = solution.common[len(solution.common) - errors.n_camera :]
    residual = residual + by_camera @ (errors.camera_root @ moved)
    stripes = [of for of in observations.each_stripe() if len(of) >= LEAST_POINTS]
    n, n_boards = BOARD_SHAPES * len(stripes), len(errors.pose_roots)
    lost = np.sqrt(n / max(n - solution.n_parameters, 1.0))
    of_shapes = np.zeros((n_boards, len(FORMS_PX), len(FACTORS)))
    of_poses = np.zeros((n_boards, 1, len(FACTORS)))
    for of in stripes:
        stripe = observations.select(of)
        board = int(stripe.board[0])
        design = _course(stripe, BOARD_SHAPES - 1)
        weighted = design / (stripe.sigma_px * noise.sigma_factor)[:, None] ** 2
        covariance = np.asarray(np.linalg.inv(weighted.T @ design), dtype=np.float64)
        gain = covariance @ weighted.T
        root = errors.pose_roots[board]
        terms, follow = gain @ (lost * residual[of]), gain @ by_pose[of] @ root
        of_shapes[board] += _log_likelihood(terms, covariance, follow, FORMS_PX)
        by_a_pose = slice(0, POSE_SHAPES)
        of_poses[board] += _log_likelihood(
            terms[by_a_pose], covariance[by_a_pose, by_a_pose], follow[by_a_pose], np.zeros(1)
        )
    likely = _with_strays(of_poses).sum(axis=(0, 1))
    common = int(np.argmax(likely))
    shapes = _with_strays(of_shapes).sum(axis=0)
    own = _own_factors(of_poses[:, 0], common)
    return BoardScatter(float(FACTORS[common]), own, float(likely[common]), float(shapes.max()))


def _with_strays(log_likelihood: FloatArray) -> FloatArray:
    """(M, R, F) of each board, for every common factor, if it scatters so or strays."""
    backwards = np.logaddexp.accumulate(log_likelihood[..., ::-1], axis=-1)[..., ::-1]
    strays = backwards - np.log(np.arange(len(FACTORS), 0, -1))
    alike = log_likelihood + np.log1p(-STRAY_SHARE)
    return np.asarray(np.logaddexp(alike, strays + np.log(STRAY_SHARE)))


def _own_factors(log_likelihood: FloatArray, common: int) -> tuple[float, ...]:
    """(M,) by the mean weight of each board, of its likelihood (M, F) and the common factor."""
    factors, tail = FACTORS[common:], log_likelihood[:, common:]
    prior = np.full(len(factors), STRAY_SHARE / len(factors))
    prior[0] += 1.0 - STRAY_SHARE
    share = prior * np.exp(tail - tail.max(axis=1, keepdims=True))
    weight = (share / factors**2).sum(axis=1) / share.sum(axis=1)
    return tuple(float(one) for one in 1.0 / np.sqrt(weight))


def _log_likelihood(
    terms: FloatArray, noise: FloatArray, follow: FloatArray, forms_px: FloatArray
) -> FloatArray:
    """Of one stripe's shape for every form (rows) and factor of the boards' scatter."""
    formed = noise + forms_px[:, None, None, None] ** 2 * np.eye(len(terms))
    total = formed + FACTORS[:, None, None] ** 2 * (follow @ follow.T)
    _, log_determinant = np.linalg.slogdet(total)
    solved = np.linalg.solve(total, np.broadcast_to(terms[:, None], (*total.shape[:3], 1)))
    return np.asarray(-0.5 * (log_determinant + solved[..., 0] @ terms))


MIN_BOARDS_FOR_BOW = 4
"""Fewest boards from which a bow is told from the boards' own errors: three boards' two heights
each leave three numbers beside a plane, and a bow has five."""
MAX_BOW_CONDITION = 1e7
"""Of plane and bow terms together: beyond it the boards do not spread enough to tell them apart."""
NO_SPARE = 2
"""Boards of which two straight stripes fix a plane but for one height."""
MOST_OF_TWO = 5.0
"""Largest scatter that is charged to them; more is a board in the wrong place, and told as such."""
SCATTER_ROUNDS = 12
N_DOUBTED = 4
"""Boards that are left out for a trial: more than one in ten of the sets of a user."""
SCATTER_SETTLED = 0.06
"""A step of the factors that are tried."""
MAX_RAISES = 10
FAN_ROUNDS = 8
FAN_SETTLED, FAN_SLACK = 1e-3, 4.0
MOST_AHEAD = 3.0
"""Steps by which a round may go on beyond what it asks for."""
USUAL_FAN = 0.5
"""Size of a fan's lean and spread where the bow is too small to show them: a source twice as far as
the calibrated region is wide. It only keeps them finite."""
U2, UV, U3, U2V = (BOW_TERMS.index(term) for term in ((2, 0), (1, 1), (3, 0), (2, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class SheetModel:
    """The model chosen for one sheet, fitted to this sheet's points alone: where the joint fit
    starts.

    ``decision`` tells why there is a bow, or none. In the joint fit the stripes' sigmas are
    multiplied by ``sigma_factor`` (their noise, its correlation, and what the model leaves
    unexplained), those of each board's pose by its own of ``board_factors`` (M,).
    """

    sheet: LightSheet
    is_bowed: bool
    noise: StripeNoise
    plane_test: FTest
    final_test: FTest
    decision: str
    sigma_factor: float
    board_factors: tuple[float, ...]

    @property
    def explains_all(self) -> bool:
        """Whether it leaves no more than the noise of stripes and boards that err as claimed."""
        return self.final_test.p_value >= LACK_OF_FIT_P and self.board_factor <= 1.0

    @property
    def board_factor(self) -> float:
        """What is common to all boards: of the one that strays least."""
        return min(self.board_factors)


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

    Its origin and scale cover the points (N, 3); signs of the directions (L, 3) do not matter.
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
    data = _OneSheet(observations.as_one_sheet(), errors, is_bow_allowed)
    noise = stripe_noise(data.points, data.points.residuals_px([start])[1])
    flat = data.solve(start, noise.sigma_factor)
    if not isinstance(flat, FitFailure):
        noise = stripe_noise(data.points, flat.remaining_px)
        flat = data.solve(start, noise.sigma_factor)
    if isinstance(flat, FitFailure):
        return flat
    plane_test = data.lack_of_fit(flat, noise)
    as_claimed = (1.0,) * len(errors.pose_roots)
    model = SheetModel(
        flat.sheets[0], False, noise, plane_test, plane_test, "", noise.sigma_factor, as_claimed
    )
    n_boards = len(np.unique(observations.board))
    test = f"lack of fit F {plane_test.f_ratio:.2f}, {p_text(plane_test.p_value)}"
    if plane_test.p_value >= LACK_OF_FIT_P:
        decision = f"a plane is enough ({test})"
    elif n_boards < MIN_BOARDS_FOR_BOW:
        decision = (
            f"a plane does not explain the stripes ({test}), but {n_boards} boards cannot tell a "
            f"bow from their own errors: {MIN_BOARDS_FOR_BOW} are needed"
        )
    else:
        return _bow_or_boards(model, flat, data)
    model = replace(model, decision=decision)
    if n_boards != NO_SPARE:
        is_enough = plane_test.p_value >= LACK_OF_FIT_P
        return model if is_enough else data.charged_to_stripes(model)
    # One height is left over, and no test of it has power: its likeliest cause is taken.
    scatter = data.board_scatter(flat, noise)
    factor = min(scatter.factor, MOST_OF_TWO)
    return data.charged_to_boards(model, (factor,) * len(as_claimed))


def _bow_or_boards(
    plane_model: SheetModel, flat: SheetSolution, data: _OneSheet
) -> SheetModel | FitFailure:
    """What a plane leaves unexplained: is the sheet bowed, or do its boards scatter?"""
    noise, plane_test = plane_model.noise, plane_model.plane_test
    test = f"lack of fit F {plane_test.f_ratio:.2f}, {p_text(plane_test.p_value)}"
    boards = data.board_scatter(flat, noise)

    def plane(decision: str) -> SheetModel | FitFailure:
        return data.charged_to_boards(replace(plane_model, decision=decision), boards.of_boards)

    if not data.is_bow_allowed:
        return plane(f"a plane was asked for, and does not explain the stripes ({test})")
    condition = _bow_condition(data.points, flat)
    bowed = data.solve_bowed(flat.sheets[0], noise.sigma_factor)
    if condition > MAX_BOW_CONDITION or isinstance(bowed, FitFailure):
        return plane(
            f"a plane does not explain the stripes ({test}), but the boards do not spread enough "
            f"to determine a bow (condition {condition:.2g})"
        )
    _, boards = data.likelier(flat, noise, boards)
    bowed, boards_bowed = data.likelier(bowed, noise, is_bowed=True)
    gain = 2.0 * (boards_bowed.log_likelihood - boards.log_likelihood)
    p_value = float(chdtrc(bowed.n_parameters - flat.n_parameters, max(gain, 0.0)))
    likelihood = f"likelihood ratio {gain:.1f}, {p_text(p_value)}"
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
    model = replace(
        plane_model, sheet=bowed.sheets[0], is_bowed=True, final_test=final, decision=decision
    )
    if final.p_value >= LACK_OF_FIT_P:
        return model
    charged = data.charged_to_boards(model, boards_bowed.of_boards)
    if isinstance(charged, FitFailure):
        return plane(f"a bow does better than a plane ({likelihood}), but {charged.reason}")
    return charged


@dataclass(frozen=True, slots=True, eq=False)
class _OneSheet:
    """Points of one sheet, with the errors of boards and cameras."""

    points: SheetObservations
    errors: CommonErrors
    is_bow_allowed: bool

    def solve(
        self,
        start: LightSheet,
        sigma_factor: float,
        *,
        is_bowed: bool = False,
        may_bow: bool = False,
    ) -> SheetSolution | FitFailure:
        return solve_sheets(
            self.points,
            [start],
            self.errors,
            [is_bowed],
            sigma_factor=sigma_factor,
            may_bow=may_bow,
        )

    def solve_as_stored(self, model: SheetModel, sigma_factor: float) -> SheetSolution | FitFailure:
        """With the likeliest of small bows where none is free."""
        return self.solve(
            model.sheet, sigma_factor, is_bowed=model.is_bowed, may_bow=self.is_bow_allowed
        )

    def lack_of_fit(
        self, solution: SheetSolution, noise: StripeNoise, sigma_factor: float | None = None
    ) -> FTest:
        n_stripes = len(np.unique(self.points.stripe))
        return lack_of_fit(solution.chi2, n_stripes, solution.n_parameters, noise, sigma_factor)

    def board_scatter(self, solution: SheetSolution, noise: StripeNoise) -> BoardScatter:
        return board_scatter(self.points, solution, self.errors, noise)

    def likelier(
        self,
        solution: SheetSolution,
        noise: StripeNoise,
        scatter: BoardScatter | None = None,
        *,
        is_bowed: bool = False,
    ) -> tuple[SheetSolution, BoardScatter]:
        """The solution, or the one in which boards weigh as they scatter, if that is likelier.

        Where boards err far more than claimed, a solution of the claims follows their errors, and a
        bow that is there does not show in it.
        """
        scatter = scatter or self.board_scatter(solution, noise)
        wider = replace(self, errors=self.errors.with_boards(scatter.of_boards))
        solve = wider.solve_bowed if is_bowed else wider.solve
        other = solve(solution.sheets[0], noise.sigma_factor)
        if isinstance(other, FitFailure):
            return solution, scatter
        found = self.board_scatter(other, noise)
        if found.log_likelihood > scatter.log_likelihood:
            return other, found
        return solution, scatter

    def likeliest_scatter(self, solution: SheetSolution, noise: StripeNoise) -> BoardScatter:
        """Of the solution, or of the sheet without one of the boards that seem to stray most.

        A stray that pulls the sheet hides: all others then seem to scatter.
        """
        best = self.board_scatter(solution, noise)
        for board in np.argsort(best.of_boards)[-N_DOUBTED:]:
            normal = solution.system.solve(solution.weight, 0, without_board=int(board))
            if normal is None:
                continue
            step = np.zeros(len(solution.active))
            step[solution.active] = normal.step[: normal.n_sheet]
            sheet = solution.sheets[0].updated(step)
            common = normal.step[normal.n_sheet :]
            other = self.board_scatter(replace(solution, sheets=(sheet,), common=common), noise)
            if other.of_places > best.of_places:
                best = other
        return best

    def solve_bowed(self, start: LightSheet, sigma_factor: float) -> SheetSolution | FitFailure:
        """Fit a bowed sheet, and find from the bow itself how its light spreads.

        Where the rays come from shows in how the bow along the stripe changes with depth: to first
        order a fan adds ``-2 lean u v - spread u^2 v`` to ``u^2`` and ``-3 lean u^2 v`` to ``u^3``.
        A right fan of a weak bow may fit worse by one or two; else halfway ones are tried.
        """
        kept: SheetSolution | None = None
        before: tuple[FloatArray, FloatArray] | None = None
        least = limit = np.inf
        for _ in range(FAN_ROUNDS):
            solution = self.solve(start, sigma_factor, is_bowed=True)
            if isinstance(solution, FitFailure):
                return solution if kept is None else kept
            if kept is not None and solution.chi2 > limit:
                start = replace(start, fan=0.5 * (kept.sheets[0].fan + start.fan))
                before, limit = None, max(least, kept.chi2)
                continue
            kept, least = solution, min(least, solution.chi2)
            asked = self._fan_of(solution)
            step = asked - start.fan
            if float(np.abs(step).max()) < FAN_SETTLED:
                break
            limit, start = least + FAN_SLACK, replace(start, fan=_ahead(asked, step, before))
            before = asked, step
        return solution if kept is None else kept

    def _fan_of(self, solution: SheetSolution) -> FloatArray:
        """(2,) the fan by which a bow's terms ``u v`` and ``u^2 v`` would vanish."""
        sheet = solution.sheets[0]
        bow = sheet.bow_mm[U2]
        variance = np.diag(solution.covariance)[self.errors.n_camera + N_PLANE :]
        lean, spread = sheet.fan
        sideways = 2.0 * lean * bow - sheet.bow_mm[UV]
        leans = 0.5 * bow * sideways / (bow**2 + 0.25 * variance[UV] / USUAL_FAN**2)
        leans = float(np.clip(leans, -MAX_FAN[0], MAX_FAN[0]))
        # a cone whose rays lean has a cubic part of its own
        cubic = sheet.bow_mm[U3] - lean * spread / (1.0 + lean**2) * bow
        weaker = spread * bow - sheet.bow_mm[U2V] - 3.0 * (leans - lean) * cubic
        spreads = bow * weaker / (bow**2 + variance[U2V] / USUAL_FAN**2)
        return np.array([leans, np.clip(spreads, -MAX_FAN[1], MAX_FAN[1])])

    def charged_to_boards(
        self, model: SheetModel, factors: tuple[float, ...]
    ) -> SheetModel | FitFailure:
        """Charge to the boards what they scatter, and to the stripes what is then left.

        In rounds: the less boards that stray pull at the sheet, the clearer it shows which do. What
        is common to all boards does not rise in them: with the poses freer to follow, the boards'
        form would show as scatter, and that is charged to the stripes.
        """
        for _ in range(SCATTER_ROUNDS):
            wider = replace(self, errors=self.errors.with_boards(factors))
            solution = wider.solve_as_stored(model, model.noise.sigma_factor)
            if isinstance(solution, FitFailure):
                return solution
            if not solution.has_converged:
                return FitFailure(
                    f"with boards that err {min(factors):.1f} times as much as their targets say "
                    "the sheet's shape did not settle",
                    "take more boards, farther apart, and check their poses",
                )
            charged = wider.charged_to_stripes(replace(model, board_factors=factors))
            if isinstance(charged, FitFailure) or len(np.unique(self.points.board)) <= NO_SPARE:
                return charged
            model = charged
            solution = wider.solve_as_stored(model, model.sigma_factor)
            if isinstance(solution, FitFailure):
                return solution
            found = np.array(self.likeliest_scatter(solution, model.noise).of_boards)
            found *= min(1.0, min(factors) / found.min())
            if np.allclose(np.log(found), np.log(factors), rtol=0.0, atol=SCATTER_SETTLED):
                break
            factors = tuple(found.tolist())
        return model

    def charged_to_stripes(self, model: SheetModel) -> SheetModel | FitFailure:
        """Raise the stripes' sigmas until the model fits, if it did not.

        What neither the model nor the boards' scatter explains is charged to the stripes. The
        covariance of the sheet grows with it. Where a small bow explains it, nothing is charged;
        else that bow is made by the same error, and takes none of it away.
        """
        factor = model.noise.sigma_factor
        solution = self.solve_as_stored(model, factor)
        if isinstance(solution, FitFailure):
            return solution
        test = self.lack_of_fit(solution, model.noise)
        model = replace(model, sheet=solution.sheets[0], final_test=test, sigma_factor=factor)
        if _is_explained(test):
            return model
        for _ in range(MAX_RAISES):
            solution = self.solve(model.sheet, factor, is_bowed=model.is_bowed)
            if isinstance(solution, FitFailure):
                return solution
            test = self.lack_of_fit(solution, model.noise, factor)
            if _is_explained(test):
                break
            factor *= float(np.sqrt(test.f_ratio))
        return replace(model, sheet=solution.sheets[0], sigma_factor=factor)


def _ahead(
    asked: FloatArray, step: FloatArray, before: tuple[FloatArray, FloatArray] | None
) -> FloatArray:
    """Where rounds ``x -> asked`` of steps ``asked - x`` lead, by the secant of the last two."""
    if before is None:
        return asked
    change = step - before[1]
    share = float(step @ change) / max(float(change @ change), FAN_SETTLED**2)
    ahead = asked - np.clip(share, -MOST_AHEAD, 1.0) * (asked - before[0])
    return np.asarray(np.clip(ahead, -np.array(MAX_FAN), MAX_FAN))


def _is_explained(test: FTest) -> bool:
    return test.p_value >= LACK_OF_FIT_P or test.f_ratio <= 1.0


def _bow_condition(observations: SheetObservations, flat: SheetSolution) -> float:
    """Condition number of plane and bow terms together, columns scaled alike."""
    _, _, by_sheet = flat.sheets[0].height_with_jacobian(observations.points_mm)
    scaled = by_sheet / np.maximum(np.linalg.norm(by_sheet, axis=0), 1e-300)
    values = np.linalg.eigvalsh(scaled.T @ scaled)
    return float(values[-1] / max(values[0], 1e-300))
