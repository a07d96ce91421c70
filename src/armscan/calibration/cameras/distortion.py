# SPDX-License-Identifier: Apache-2.0
"""What coefficients of usual lenses are beforehand, which kind of lens the views support, and how
alike the residuals of one view are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from armscan.calibration.cameras.adjustment import (
    SHARED_NAMES,
    SINGULAR_CONDITION,
    Observations,
    State,
    adjust,
    basis_of,
    condition_number,
    damped_step,
    joint_covariance,
    linearise,
    normal_equations,
    predict,
    reduced_normal_matrix,
    with_known,
)
from armscan.calibration.cameras.print_errors import (
    begin_print,
    estimate_target_error,
    settle_print,
)
from armscan.calibration.cameras.result import (
    MAX_STEPS,
    MIN_VIEWS,
    CrossValidation,
    DistortionModel,
)
from armscan.calibration.cameras.robust import (
    Solution,
    chi2_of_points,
    covariance_with_target_error,
    residuals_px,
)
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.models.camera import PARAMETER_NAMES, TANGENTIAL, CameraModel

NO_SHARED = np.zeros((11, 0))


def cross_validate(
    solution: Solution, sources: tuple[str, ...], n_folds: int
) -> CrossValidation | None:
    """Hold out views fold by fold (see `CrossValidation`).

    Points that the full solution rejected as outliers count neither in the folds' solutions nor
    in the result.

    ``solution``, of all used views, also is the folds' starting value; there is at most one fold a
    view.

    None if fewer than three views would be left to solve from, or if a fold has no solution.
    """
    observations = solution.observations
    n_views = observations.n_views
    folds = min(n_folds, n_views)
    if folds < 2 or n_views - int(np.ceil(n_views / folds)) < MIN_VIEWS:
        return None
    fold_of_view = np.arange(n_views) % folds
    held_out = np.zeros_like(observations.points_px)
    for fold in range(folds):
        is_test = fold_of_view == fold
        residuals = _held_out(solution, np.flatnonzero(~is_test), np.flatnonzero(is_test))
        if residuals is None:
            return None
        held_out[is_test[observations.view_of_point]] = residuals
    in_sample = residuals_px(observations, solution.state)
    kept = solution.weights > 0.0
    per_view = []
    for v in range(n_views):
        rows_of_view = observations.rows(v)
        per_view.append(rms(held_out[rows_of_view][kept[rows_of_view]]))
    return CrossValidation(
        folds, rms(held_out[kept]), rms(in_sample[kept]), sources, tuple(per_view)
    )


def _held_out(solution: Solution, train: IntArray, test: IntArray) -> FloatArray | None:
    """(M, 2) residuals of the views ``test``, whose poses alone are solved; the rest by ``train``.

    Where the print's points lie, too, is told by the views that are not held out.
    """
    observations = solution.observations
    seen, weights = subset(observations, solution.weights, train)
    first = adjust(seen, of_views(solution.state, train), solution.basis, weights)
    if isinstance(first, FitFailure):
        return None
    begun = replace(
        solution, observations=seen, state=first.state, equations=first.system, weights=weights
    )
    trained = settle_print(begun, MAX_STEPS, is_held=True)
    if isinstance(trained, FitFailure):
        return None
    numbers, of_test = observations.point, np.isin(observations.view_of_point, test)
    missed_mm = np.zeros_like(observations.target_mm)
    missed_mm[numbers[~of_test]] = trained.observations.missed_mm
    part, weights = subset(observations, solution.weights, test)
    part = replace(part, missed_mm=missed_mm[numbers[of_test]])
    start = of_views(solution.state, test)
    start = State(trained.state.shared, start.rotations, start.translations_mm)
    posed = adjust(part, start, NO_SHARED, weights)
    return None if isinstance(posed, FitFailure) else residuals_px(part, posed.state)


def rms(residuals: FloatArray) -> float:
    """Root mean square over (N, 2) residuals of their length, as OpenCV defines it."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def sigma_of_axis(residuals: FloatArray, degrees_of_freedom: float) -> float:
    """Standard deviation along an axis of points that leave these (N, 2) residuals.

    Of the residuals, not of what detectors claim: two blurred corners would stand for all.
    """
    return float(np.sqrt(np.sum(residuals**2) / max(degrees_of_freedom, 1.0)))


def subset(
    observations: Observations, weights: FloatArray, views: IntArray
) -> tuple[Observations, FloatArray]:
    """The observations of some views, in order, with their weights."""
    rows = np.isin(observations.view_of_point, views)
    counts = np.diff(observations.starts)[views]
    part = replace(
        observations,
        points_px=observations.points_px[rows],
        whitening=observations.whitening[rows],
        board_mm=observations.board_mm[rows],
        point=observations.point[rows],
        missed_mm=observations.missed_mm[rows],
        board_warp_shape=observations.board_warp_shape[rows],
        starts=(0, *(int(n) for n in np.cumsum(counts))),
    )
    return part, weights[rows]


def of_views(state: State, views: IntArray) -> State:
    """The poses of some views, in order, with the shared unknowns."""
    return State(state.shared, state.rotations[views], state.translations_mm[views])


@dataclass(frozen=True, slots=True, eq=False)
class ChosenModel:
    """A distortion model with its solution and hold-out test.

    Parameters
    ----------
    model
        The model.
    solution
        Its solution.
    cross_validation
        Its hold-out test, None where there was none.
    reason
        Why this model, in words.
    untested
        Names of coefficients that the chosen kind of lens has not: nobody said that they are zero.
    doubt
        What speaks for another kind of lens, in words; empty for nothing.
    """

    model: DistortionModel
    solution: Solution
    cross_validation: CrossValidation | None
    reason: str
    untested: tuple[str, ...] = ()
    doubt: str = ""


WIDE = 0.6
"""Ideal radius X/Z up to which a fisheye's terms do what a pinhole's do."""
LENS_CHANCE, CLEAR_CHANCE, CLEAR_FALL, CLIPPED_FALL = 0.003, 0.03, 1.1, 3.0
"""A fisheye takes a pinhole's place if chance makes unseen views' residuals fall as they do in no
more than this part of cases, by Student's t of their logarithms over the views; in the second part
where they fall by the third factor or more. Less than that is a doubt. Pinholes of seven and ten
views that were taken for fisheyes fell by factors of 1.002 and 1.013, by 2.6 and 3.4 standard
errors; fisheyes mostly fall by more than 2. A view counts up to the last number of robust sigmas
beyond the middle one. The chances are nominal: of five views the first is met in 0.4 % for that,
and views of one fold share what the others told."""


def choose_lens(
    pinhole: ChosenModel | FitFailure,
    solve: Callable[[DistortionModel], Solution | FitFailure],
    validate: Callable[[Solution, Solution], CrossValidation | None],
) -> ChosenModel | FitFailure:
    """The pinhole, or a fisheye where points reach far from the axis and it predicts them better.

    ``solve`` gives the solution of a model, ``validate`` the hold-out test of a solution with the
    weights of another.
    """
    if not isinstance(pinhole, FitFailure) and not _is_wide(pinhole.solution):
        return pinhole
    fisheye = solve("fisheye")
    if isinstance(fisheye, FitFailure) or not fisheye.is_converged or not _is_wide(fisheye):
        return pinhole
    if isinstance(pinhole, FitFailure):
        reason = "fisheye: no pinhole with five coefficients explains the views"
        return ChosenModel("fisheye", fisheye, validate(fisheye, fisheye), reason, TANGENTIAL)
    both = replace(fisheye, weights=fisheye.weights * pinhole.solution.weights)
    fall, chance = _fall_of_residuals(validate(pinhole.solution, both), validate(both, both))
    if fall <= 0.0:
        return pinhole
    factor = float(np.exp(fall))
    if not chance < (CLEAR_CHANCE if factor > CLEAR_FALL else LENS_CHANCE):
        return replace(pinhole, doubt=_doubt(factor))
    reason = f"fisheye: unseen views are predicted {factor:.2f} times as well as by a pinhole"
    return ChosenModel("fisheye", fisheye, validate(fisheye, fisheye), reason, TANGENTIAL)


def _doubt(factor: float) -> str:
    better = f", which predicts them {factor:.3f} times as well" if np.isfinite(factor) else ""
    return (
        f"the lens is wide, and unseen views do not tell this pinhole from a fisheye{better}: "
        "where no target points lie the two may differ by many pixels; compare "
        "--distortion fisheye, and do not measure outside the covered part"
    )


def _is_wide(solution: Solution) -> bool:
    seen, kept = solution.observations, solution.weights > 0.0
    camera = seen.camera(solution.state.shared[: len(PARAMETER_NAMES)])
    xy, is_valid = camera.undistort(seen.points_px[kept])
    return bool(np.any(np.sum(xy[is_valid] ** 2, axis=1) > WIDE**2))


def _fall_of_residuals(
    pinhole: CrossValidation | None, fisheye: CrossValidation | None
) -> tuple[float, float]:
    """Mean over views of the fall of held-out residuals' logarithms; how likely it is by chance.

    Of logarithms, for one view that a pinhole cannot describe would hide in its own scatter. NaN
    and 1 where there was no hold-out test.
    """
    if pinhole is None or fisheye is None:
        return np.nan, 1.0
    fall = np.log(pinhole.view_rms_px) - np.log(fisheye.view_rms_px)
    middle = float(np.median(fall))
    # a view that the fisheye alone describes would speak against it by its own scatter
    usual = np.minimum(fall, middle + CLIPPED_FALL * robust_sigma(fall - middle))
    error = max(float(np.std(usual, ddof=1)) / np.sqrt(len(usual)), 1e-300)
    return float(np.mean(fall)), float(stdtr(len(usual) - 1, -np.mean(usual) / error))


SIGNIFICANT_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class DesignEffect:
    """By how much the views' pulls on the camera scatter more than points that err on their own.

    ``value`` is 1, with the standard deviation ``sigma``, where every point errs on its own.
    """

    value: float
    sigma: float

    @property
    def widening(self) -> float:
        """Factor for variances: 1 unless the value is larger by four of its deviations."""
        return self.value if self.value > 1.0 + SIGNIFICANT_SIGMAS * self.sigma else 1.0


def design_effect(solution: Solution) -> DesignEffect:
    """How alike the residuals of one view are, from what the views do to the camera.

    A bent board, uneven light or a detector that errs by the tilt moves neighbouring points alike;
    the points of a view then tell less than their count. At the minimum the pulls s_v of the views
    on the shared unknowns, poses eliminated, sum to zero. With R_v the information of view v and R
    their sum, independent points give
    ``E sum s_v' R^-1 s_v = sigma0^2 (F - sum tr((R^-1 R_v)^2))``; the design
    effect (Kish; views are the clusters) is what is found over this. Errors of the
    target's points, which are counted by themselves, are taken out before.
    """
    observations, basis = _without_target_error(solution), solution.basis
    known = observations.known
    observations = replace(observations, known=0.0 * known)
    information, pulls, chi2 = [], [], 0.0
    for v in range(observations.n_views):
        alone, weights = subset(observations, solution.weights, np.array([v]))
        equations = linearise(alone, of_views(solution.state, np.array([v])), basis, weights)
        if equations is None:
            return DesignEffect(1.0, 0.0)
        information.append(reduced_normal_matrix(equations))
        carried = equations.cross[0] @ np.linalg.inv(equations.pose[0])
        pulls.append(equations.shared_gradient - carried @ equations.pose_gradient[0])
        chi2 += equations.chi2
    views = np.array(information)
    total = views.sum(axis=0) + basis.T @ (known[:, None] * basis)
    scale = 1.0 / np.sqrt(np.diag(total))
    inverse = np.linalg.inv(total * np.outer(scale, scale)) * np.outer(scale, scale)
    shares = inverse @ views
    f = float(np.einsum("vii->", shares))
    own = float(np.einsum("vij,vji->", shares, shares))
    s = np.array(pulls) - np.mean(pulls, axis=0)
    found = float(np.einsum("vi,ij,vj->", s, inverse, s))
    sigma0_squared = chi2 / max(solution.degrees_of_freedom, 1)
    expected = max(f - own, 1e-3)
    return DesignEffect(
        found / max(sigma0_squared * expected, 1e-300), float(np.sqrt(2.0 * own)) / expected
    )


def _without_target_error(solution: Solution) -> Observations:
    """The observations less what each point of the target misses in the mean of all views."""
    observations, found = solution.observations, solution.board_residuals()
    if (
        solution.print_error.is_seen
        or found is None
        or estimate_target_error(found).sigma_mm == 0.0
    ):
        return observations
    missed = np.linalg.solve(found.by_board, found.residuals_px[:, :, None])[:, :, 0]
    point = found.point
    total = np.stack([np.bincount(point, missed[:, k]) for k in range(2)], axis=1)
    mean = total / np.maximum(np.bincount(point), 1)[:, None]
    points_px = observations.points_px.copy()
    points_px[solution.weights > 0.0] -= (found.by_board @ mean[point][:, :, None])[:, :, 0]
    return replace(observations, points_px=points_px)


def with_places_of_print(plain: Solution, max_steps: int) -> Solution:
    """With the places of the print solved along, if the views show that it errs (`begin_print`).

    What is usual of lenses weighs beside the points by the level that is left of them.
    """
    begun = begin_print(plain, max_steps, lambda one: max(design_effect(one).value, 1.0))
    if isinstance(begun, FitFailure) or not begun.print_error.is_seen:
        return plain
    ratio = begun.variance_factor * design_effect(begun).widening / level_of_points(plain)
    seen = replace(begun.observations, known=ratio * begun.observations.known)
    again = settle_print(replace(begun, observations=seen), max_steps)
    return plain if isinstance(again, FitFailure) else again


LEAST_FIRST, MOST_FIRST = 0.1, 0.3
"""The first radial term is counted to move points at the image's corner by r^2 of the radius, k1
being of the size 1, at most by 0.3 and at least by 0.1: lenses of long focal length bend their
smaller field about as much..."""
NEXT_TERM = 0.3
"""...and each further radial term is about this part of the one before it."""
TYPICAL_TANGENTIAL = 1e-3
"""Tangential coefficients of lenses that are centred as usual."""
MOST_COST = 25.0
"""By so much, in units of the points' level, chi2 may rise for the four usual sizes: of usual
lenses by 18 once in a thousand."""
BEYOND_USUAL = 3.0
"""Deviations by which the views contradict a usual size: the lens is none of the usual ones."""
MOST_SHARE = 0.9
"""Views that tell a coefficient to three times its usual size or worse contradict nothing: so large
a one would be no lens's."""


def typical_coefficients(camera: CameraModel, names: tuple[str, ...]) -> FloatArray:
    """(D,) how large coefficients of a usual lens are, without unit; of k1 anything is likely.

    Only an order of magnitude, of lenses in general: where views say more, they prevail.
    """
    half = 0.5 * np.array([camera.width_px, camera.height_px])
    square = float(np.sum((half / camera.parameters[:2]) ** 2))
    first = min(max(square, LEAST_FIRST), MOST_FIRST)
    typical = {
        "k1": np.inf,
        "k2": NEXT_TERM * first / square**2,
        "p1": TYPICAL_TANGENTIAL,
        "p2": TYPICAL_TANGENTIAL,
        "k3": NEXT_TERM**2 * first / square**3,
    }
    return np.array([typical[name] for name in names])


def level_of_points(solution: Solution) -> float:
    """Variance of a point of unit weight, widened where the residuals of one view are alike."""
    error = estimate_target_error(solution.board_residuals())
    return solution.variance_factor * design_effect(solution).widening * error.independent_share


def known_of_usual_lenses(solution: Solution, level: float) -> FloatArray:
    """(11,) of `Observations`: coefficients are normal variables about zero, of usual size (Bayes).

    ``level`` is that of the points; the solution's camera tells how far its image reaches.
    """
    n_camera = len(PARAMETER_NAMES)
    camera = solution.observations.camera(solution.state.shared[:n_camera])
    known = np.zeros(len(SHARED_NAMES))
    known[4:n_camera] = level / typical_coefficients(camera, PARAMETER_NAMES[4:]) ** 2
    return known


def resting_on_usual(solution: Solution) -> tuple[str, ...]:
    """Names of coefficients of which the views say less than what is usual of lenses does."""
    shares = _shares_of_usual(solution)
    return tuple(name for name, share in zip(SHARED_NAMES, shares, strict=True) if share > 0.5)


def contradicted_size(solution: Solution, level: float) -> int | None:
    """Row of the coefficient whose usual size s the views contradict most; None if they do none.

    ``level`` is that of the points by which the sizes were weighed (`known_of_usual_lenses`).

    Solved beside s it is m, of which s is the share w. By the views alone it would be m / (1 - w),
    known to the variance s^2 w / (1 - w). Of a usual lens m is a normal variable of the variance
    s^2 (1 - w), and what misprints add to that.
    """
    determined = joint_covariance(solution.equations, solution.basis)
    if isinstance(determined, FitFailure):
        return None
    n, unit, known = len(SHARED_NAMES), determined[0], solution.observations.known
    found = solution.board_residuals()
    error = estimate_target_error(found)
    whole = covariance_with_target_error(unit, level / error.independent_share, error, found)
    shares = known * np.diag(unit)[:n]
    added = np.maximum(np.diag(whole)[:n] - level * np.diag(unit)[:n], 0.0)
    is_told = (known > 0.0) & (shares < MOST_SHARE)
    variance = np.where(is_told, level / np.where(is_told, known, 1.0) * (1.0 - shares), 1.0)
    excess = np.where(is_told, np.abs(solution.state.shared), 0.0) / np.sqrt(variance + added)
    return int(excess.argmax()) if excess.max() > BEYOND_USUAL else None


def cost_of_usual(beside: Solution, free: Solution) -> float:
    """By how much chi2 is larger beside usual sizes than free, of the points that both kept, at the
    weights of the free solution: each solution sets points aside and levels weights for itself.
    What the target's points miss in all views, misprints, is no cost.
    """
    kept = (beside.weights > 0.0) & (free.weights > 0.0)
    chi2 = []
    for one in (beside, free):
        points_px = _without_target_error(one).points_px
        seen = replace(free.observations, points_px=points_px)
        chi2.append(float(chi2_of_points(seen, one.state)[kept].sum()))
    return chi2[0] - chi2[1]


def _shares_of_usual(solution: Solution) -> FloatArray:
    """(11,) share of what is known of each shared unknown that was known beforehand."""
    determined = joint_covariance(solution.equations, solution.basis)
    if isinstance(determined, FitFailure):
        return np.zeros(len(SHARED_NAMES))
    return np.asarray(solution.observations.known * np.diag(determined[0])[: len(SHARED_NAMES)])


@dataclass(frozen=True, slots=True, eq=False)
class LeftAtZero:
    """What coefficients that a kind of lens has not, and that may not be zero, do to all else.

    ``unit_covariance`` (S + 6 V, S + 6 V) is as from `joint_covariance`, with these coefficients
    unknown as well, but of a usual lens; ``shift`` (S + 6 V,) by what all would move if they were
    solved so.
    """

    unit_covariance: FloatArray
    shift: FloatArray


def coefficients_left_at_zero(
    solution: Solution, names: tuple[str, ...], sigma0_squared: float
) -> LeftAtZero | FitFailure:
    """Joint covariance with coefficients that a kind of lens has not as further unknowns.

    They are not zero for that: they are what lenses usually have, or less, and move the focal
    length and the principal point. Taken as normal variables about zero with
    `typical_coefficients`, the views' own information added (Bayes).

    ``sigma0_squared`` is the variance of a point of unit weight that the covariance will be scaled
    with.
    """
    added = basis_of(names, is_aspect_fixed=False)
    basis = np.concatenate([solution.basis, added], axis=1)
    equations = linearise(solution.observations, solution.state, basis, solution.weights)
    if equations is None:
        return FitFailure("the solution puts the board behind the camera")
    known = np.zeros(basis.shape[1])
    camera = solution.observations.camera(solution.state.shared[: len(PARAMETER_NAMES)])
    known[-len(names) :] = sigma0_squared / typical_coefficients(camera, names) ** 2
    equations = replace(equations, shared=equations.shared + np.diag(known))
    determined = joint_covariance(equations, basis)
    if isinstance(determined, FitFailure):
        return determined
    rows = [SHARED_NAMES.index(name) for name in names]
    pull = equations.shared_gradient[-len(names) :]
    return LeftAtZero(determined[0], np.asarray(determined[0][:, rows] @ pull))


def print_stretch(solution: Solution, max_steps: int) -> tuple[float, float]:
    """By how much the print is longer from row to row than is said of it, as a part, and its sigma.

    From column to column it is taken for right. Printers feed paper by half a percent too far; the
    camera takes that up in its focal lengths and its centre. One step with one unknown more, and
    another from the solution over the print so stretched, whose residuals tell the sigma. (0, inf)
    if the views do not tell.
    """
    first = _stretch_step(solution)
    if not np.isfinite(first[1]):
        return first
    observations = solution.observations
    longer = observations.board_mm * np.array([1.0, 1.0 + first[0], 1.0])
    stretched = replace(observations, board_mm=longer)
    found = adjust(stretched, solution.state, solution.basis, solution.weights, max_steps)
    if isinstance(found, FitFailure):
        return first
    again = replace(solution, observations=stretched, state=found.state, equations=found.system)
    rest, sigma = _stretch_step(again)
    widening = float(np.sqrt(design_effect(again).widening))
    return (1.0 + first[0]) * (1.0 + rest) - 1.0, sigma * widening


def _stretch_step(solution: Solution) -> tuple[float, float]:
    """Change of the stretch in one step, and its sigma for points that err on their own."""
    observations = solution.observations
    prediction = predict(observations, solution.state)
    if prediction is None:
        return 0.0, np.inf
    predicted, by_shared, by_pose = prediction
    ahead = solution.state.rotations[observations.view_of_point, :, 1]
    by_stretch = by_pose[:, :, 3:] @ (observations.board_mm[:, 1:2] * ahead)[:, :, None]
    free = np.concatenate([by_shared @ solution.basis, by_stretch], axis=2)
    equations = normal_equations(observations, predicted, free, by_pose, solution.weights)
    wide = np.column_stack([solution.basis, np.zeros(len(SHARED_NAMES))])
    equations = with_known(equations, observations.known, solution.state, wide)
    step, reduced = damped_step(equations, 0.0), reduced_normal_matrix(equations)
    if step is None or not condition_number(reduced) < SINGULAR_CONDITION:
        return 0.0, np.inf
    variance = float(np.linalg.inv(reduced)[-1, -1]) * solution.variance_factor
    return float(step[0][-1]), float(np.sqrt(variance))
