# SPDX-License-Identifier: Apache-2.0
"""Calibrate one camera from views of a target: which views can be used, which do not fit, and the
evidence for what comes out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce

import numpy as np

from armscan.calibration.cameras.adjustment import (
    Observations,
    State,
    free_basis,
    gather,
    joint_covariance,
)
from armscan.calibration.cameras.distortion import (
    MOST_COST,
    ChosenModel,
    choose_lens,
    coefficients_left_at_zero,
    contradicted_size,
    cost_of_usual,
    cross_validate,
    design_effect,
    known_of_usual_lenses,
    level_of_points,
    print_stretch,
    resting_on_usual,
    rms,
    sigma_of_axis,
    with_places_of_print,
)
from armscan.calibration.cameras.print_errors import eliminate_print, estimate_target_error
from armscan.calibration.cameras.result import (
    DISTORTION_PARAMETERS,
    MIN_VIEWS,
    CameraFit,
    CameraOptions,
    CrossValidation,
    DistortionModel,
    RefusedView,
    ViewFit,
    advise,
    largest_angle_deg,
    measure_coverage,
    rms_reasons,
)
from armscan.calibration.cameras.robust import (
    MISFIT_LEVEL,
    MISFIT_OUTLIERS,
    SUSPECT_LEVEL,
    WRONG_LEVEL,
    Solution,
    added_variance_px2,
    better_fit,
    board_warp,
    chi2_of_points,
    covariance_with_target_error,
    residuals_px,
    solve_robustly,
    with_excess,
    with_significant_bow,
)
from armscan.calibration.cameras.start import (
    estimate_board_pose,
    mirrored_pose,
    seen_stretch,
    starting_state,
    view_homography,
)
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.camera import PARAMETER_NAMES, TANGENTIAL, CameraModel
from armscan.vision.targets.target import TargetView, as_two_lengths


@dataclass(frozen=True, slots=True, eq=False)
class PreparedViews:
    """Views sorted by what can be done with them.

    Parameters
    ----------
    used
        Indices of the views that take part.
    homographies
        (3, 3) of each used view.
    left_out
        Index and reason of views that have a pose and do not take part.
    refused
        Views from which no pose can be had.
    repeats
        Used views that repeat an earlier one: index to earlier index.
    """

    used: tuple[int, ...]
    homographies: tuple[FloatArray, ...]
    left_out: dict[int, str]
    refused: tuple[RefusedView, ...]
    repeats: dict[int, int]


def prepare_views(
    views: Sequence[TargetView], options: CameraOptions
) -> PreparedViews | FitFailure:
    """Sort the views, and refuse a set that cannot determine a camera."""
    gather(views, "pinhole")
    sources = [view.source for view in views]
    twice = sorted({source for source in sources if sources.count(source) > 1})
    if twice:
        raise InputError(f"views share a name: {', '.join(twice)}", remedy="give each image once")
    unknown = sorted(set(options.leave_out) - set(sources))
    if unknown:
        raise OptionError(
            f"cannot leave out {', '.join(unknown)}: no such view",
            remedy=f"the views are {', '.join(sources)}",
        )
    used: list[int] = []
    homographies: list[FloatArray] = []
    left_out: dict[int, str] = {}
    refused: list[RefusedView] = []
    for index, view in enumerate(views):
        homography = view_homography(view)
        if isinstance(homography, FitFailure):
            refused.append(RefusedView(view.source, homography.reason))
        elif view.source in options.leave_out:
            left_out[index] = "left out by request"
        else:
            used.append(index)
            homographies.append(homography)
    among_used = repeated_views([views[i] for i in used])
    repeats = {used[later]: used[earlier] for later, earlier in among_used.items()}
    prepared = PreparedViews(tuple(used), tuple(homographies), left_out, tuple(refused), repeats)
    failure = _too_few(prepared, len(views))
    return prepared if failure is None else failure


NEAR_PX_PER_WIDTH = 0.005
"""Two views whose points differ by less than this share of the image width are the same view."""


def repeated_views(views: Sequence[TargetView]) -> dict[int, int]:
    """Views that show the board where an earlier view shows it: index to earlier index."""
    repeated: dict[int, int] = {}
    for later in range(len(views)):
        for earlier in range(later):
            if earlier not in repeated and _is_repeated(views[earlier], views[later]):
                repeated[later] = earlier
                break
    return repeated


def _is_repeated(a: TargetView, b: TargetView) -> bool:
    if np.array_equal(a.point_index, b.point_index):
        shift = a.points_px - b.points_px
    else:
        _, in_a, in_b = np.intersect1d(a.point_index, b.point_index, return_indices=True)
        shift = a.points_px[in_a] - b.points_px[in_b]
    if not len(shift):
        return False
    rms = float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
    return rms < NEAR_PX_PER_WIDTH * a.width_px


def _too_few(prepared: PreparedViews, n_given: int) -> FitFailure | None:
    n_distinct = len(prepared.used) - len(prepared.repeats)
    if n_distinct >= MIN_VIEWS:
        return None
    facts = []
    if prepared.refused:
        listed = "; ".join(f"{view.source}: {view.reason}" for view in prepared.refused)
        facts.append(f"{len(prepared.refused)} not usable ({listed})")
    if prepared.left_out:
        facts.append(f"{len(prepared.left_out)} left out")
    if prepared.repeats:
        facts.append(f"{len(prepared.repeats)} nearly identical to another")
    detail = f": of {n_given}, " + ", ".join(facts) if facts else ""
    return FitFailure(
        f"{n_distinct} different usable views of the target, a camera needs {MIN_VIEWS}{detail}",
        "take 10 to 20 images with the board tilted by 20 to 45 degrees in different directions",
    )


N_CAMERA, N_SHARED = 9, 11
MAX_RELATIVE_FOCAL_SIGMA = 0.05


def assemble(
    views: Sequence[TargetView],
    prepared: PreparedViews,
    chosen: ChosenModel,
    is_misfit: BoolArray,
    options: CameraOptions,
) -> CameraFit | FitFailure:
    """Put the result together, or refuse a solution that the views do not determine."""
    used = [views[index] for index in prepared.used]
    validation = chosen.cross_validation
    bow = with_significant_bow(chosen.solution, options.max_steps, is_wanted=options.solve_warp)
    if isinstance(bow, FitFailure):
        return bow
    plain, bow_test = bow
    solution = with_places_of_print(plain, options.max_steps) if options.solve_print else plain
    if bow_test is not None or solution.print_error.is_seen:
        sources = tuple(view.source for view in used)
        validation = cross_validate(solution, sources, options.n_folds)
    observations = solution.observations
    determined = joint_covariance(solution.equations, solution.basis)
    if isinstance(determined, FitFailure):
        return determined
    unit, condition = determined
    target_mm = estimate_target_error(solution.board_residuals()).sigma_mm
    target_mm = observations.rms_missed_mm if solution.print_error.is_seen else target_mm
    design = design_effect(solution)
    # with fy held to fx, pixels that are not square would pass for the print's stretch
    is_told = not options.is_aspect_fixed
    stretch = print_stretch(plain, options.max_steps) if is_told else (0.0, np.inf)
    sigma0_squared = solution.variance_factor * design.widening
    covariance = _stated_covariance(unit, solution, chosen.untested, sigma0_squared)
    if isinstance(covariance, FitFailure):
        return covariance
    # a bent or stretched target is told by its residuals, not by the sigma that they widen
    refusal = _focal_refusal(solution, covariance / design.widening)
    if refusal is not None:
        return refusal
    warp = None if bow_test is None else board_warp(solution, bow_test, covariance)
    camera = observations.camera(solution.state.shared[:N_CAMERA])
    fits, refused = _view_fits(
        views, prepared, solution, covariance=covariance, is_misfit=is_misfit, camera=camera
    )
    kept = solution.weights > 0.0
    misses_px = residuals_px(observations, solution.state)[kept]
    coverage = measure_coverage(
        observations.points_px[kept],
        solution.state.rotations[:, :, 2],
        observations.width_px,
        observations.height_px,
    )
    rows = np.r_[:N_CAMERA, N_SHARED : len(covariance)]
    fit = CameraFit(
        camera=camera,
        covariance=covariance[:N_CAMERA, :N_CAMERA],
        free_parameters=free_basis(chosen.model, options)[1],
        joint_covariance=covariance[np.ix_(rows, rows)],
        views=fits,
        refused_views=prepared.refused + refused,
        rms_px=rms(misses_px),
        sigma_point_px=sigma_of_axis(misses_px, solution.degrees_of_freedom),
        noise_scale=_noise_scale(used, solution),
        target_error_mm=target_mm,
        degrees_of_freedom=solution.degrees_of_freedom,
        condition=condition,
        coverage=coverage,
        cross_validation=validation,
        warp=warp,
        model_reason=chosen.reason,
        design_effect=design.widening,
        stretch=stretch[0],
        stretch_sigma=stretch[1],
        warnings=(),
        options=options,
    )
    repeats = [(views[a].source, views[b].source) for a, b in prepared.repeats.items()]
    told = advise(fit, repeats, is_converged=solution.is_converged)
    return replace(told, warnings=(*told.warnings, chosen.doubt)) if chosen.doubt else told


def _stated_covariance(
    unit: FloatArray,
    solution: Solution,
    untested: tuple[str, ...],
    sigma0_squared: float,
) -> FloatArray | FitFailure:
    """Joint covariance with what the target's points miss and what was left at zero may be."""
    found = solution.board_residuals()
    target_error = estimate_target_error(found)
    shift, first = np.zeros(len(unit)), unit
    if untested:
        level = target_error.independent_share * sigma0_squared
        left = coefficients_left_at_zero(solution, untested, level)
        if isinstance(left, FitFailure):
            return left
        unit, shift = left.unit_covariance, left.shift
    covariance = covariance_with_target_error(unit, sigma0_squared, target_error, found)
    if found is not None and solution.print_error.is_seen:
        places = eliminate_print(
            solution.equations, solution.basis, found, solution.print_error
        ).covariance(solution.basis)
        covariance = sigma0_squared * (places + unit - first)
    covariance = covariance + np.outer(shift, shift)
    if solution.observations.lens == "fisheye":
        # what its decentring may be widens the others; it has no such parameters itself
        absent = [PARAMETER_NAMES.index(name) for name in TANGENTIAL]
        covariance[absent] = covariance[:, absent] = 0.0
    return covariance


def _focal_refusal(solution: Solution, covariance: FloatArray) -> FitFailure | None:
    relative = np.sqrt(np.diag(covariance)[:2]) / solution.state.shared[:2]
    if relative.max() <= MAX_RELATIVE_FOCAL_SIGMA:
        return None
    return FitFailure(
        f"the focal length is uncertain by {100 * relative.max():.0f} %",
        "tilt the board by 20 to 45 degrees, in a different direction from view to view, and "
        "check the number of columns and rows",
    )


def _noise_scale(used: Sequence[TargetView], solution: Solution) -> float:
    kept = solution.weights > 0.0
    missed_mm = solution.observations.missed_mm
    claimed = replace(gather(used, solution.observations.lens), missed_mm=missed_mm)
    chi2 = float(chi2_of_points(claimed, solution.state)[kept].sum())
    return float(np.sqrt(chi2 / max(solution.degrees_of_freedom, 1)))


def _view_fits(
    views: Sequence[TargetView],
    prepared: PreparedViews,
    solution: Solution,
    *,
    covariance: FloatArray,
    is_misfit: BoolArray,
    camera: CameraModel,
) -> tuple[tuple[ViewFit, ...], tuple[RefusedView, ...]]:
    """Evidence of each view with a pose, in the order given."""
    observations = solution.observations
    residuals = residuals_px(observations, solution.state)
    fits: dict[int, ViewFit] = {}
    refused: list[RefusedView] = []
    for position, index in enumerate(prepared.used):
        rows = observations.rows(position)
        block = slice(N_SHARED + 6 * position, N_SHARED + 6 * position + 6)
        fits[index] = _view_fit(
            views[index],
            solution.state.pose(position),
            covariance=covariance[block, block],
            residuals=residuals[rows],
            missed_mm=observations.missed_mm[rows],
            is_outlier=solution.weights[rows] == 0.0,
            level=float(solution.view_levels[position]),
            is_misfit=bool(is_misfit[position]),
        )
    for index, note in prepared.left_out.items():
        left = _left_out_fit(views[index], camera, solution, note)
        if isinstance(left, FitFailure):
            refused.append(RefusedView(views[index].source, f"{note}; {left.reason}"))
        else:
            fits[index] = left
    return tuple(fits[index] for index in sorted(fits)), tuple(refused)


def _view_fit(
    view: TargetView,
    pose: Pose[Sensor, Board],
    *,
    covariance: FloatArray,
    residuals: FloatArray,
    missed_mm: FloatArray,
    is_outlier: BoolArray,
    level: float,
    is_misfit: bool,
    left_out: str = "",
) -> ViewFit:
    note = left_out
    if is_misfit:
        note = f"residuals {np.sqrt(level):.1f} times those of the typical view: leave it out"
    middle = pose.rotation @ view.points_board_mm.mean(axis=0) + pose.translation_mm
    tilt = float(np.rad2deg(np.arccos(min(1.0, abs(float(pose.rotation[2, 2]))))))
    return ViewFit(
        view=view,
        sensor_from_board=pose,
        pose_covariance=covariance,
        residuals_px=residuals,
        missed_mm=missed_mm,
        is_outlier=is_outlier,
        chi2_per_point=level,
        tilt_deg=tilt,
        distance_mm=float(middle[2]),
        is_used=not left_out,
        is_misfit=is_misfit,
        note=note,
    )


def _left_out_fit(
    view: TargetView,
    camera: CameraModel,
    solution: Solution,
    note: str,
) -> ViewFit | FitFailure:
    bow = solution.state.shared[N_CAMERA:]
    pose = estimate_board_pose(view, camera, bow_mm=bow, allow_ambiguous=True)
    if isinstance(pose, FitFailure):
        return pose
    typical = float(
        np.mean(np.sum(residuals_px(solution.observations, solution.state) ** 2, axis=1))
    )
    level = float(np.mean(np.sum(pose.residuals**2, axis=1))) / max(typical, 1e-300)
    return _view_fit(
        view,
        pose.value,
        covariance=pose.covariance,
        residuals=pose.residuals,
        missed_mm=np.zeros((len(view), 2)),
        is_outlier=np.zeros(len(view), dtype=np.bool_),
        level=level,
        is_misfit=False,
        left_out=note,
    )


EXCESS_ROUNDS = 2

MIN_ANGLE_DEG = 5.0
"""Boards that differ in tilt by less than this are parallel: the focal length is not determined."""

PARALLEL = FitFailure(
    "the board is parallel to itself in all views (tilts differ by less than "
    f"{MIN_ANGLE_DEG:.0f} degrees), so that the focal length is not determined",
    "tilt the board by 20 to 45 degrees, in a different direction from view to view",
)


def calibrate_camera(
    views: Sequence[TargetView], options: CameraOptions | None = None
) -> CameraFit | FitFailure:
    """Calibrate a camera from views of one flat target.

    Homographies and Zhang's closed form (eqs. 2.27 to 2.35) and linear distortion (2.36 to 2.38)
    start a Levenberg-Marquardt solution over intrinsics, distortion and all poses (2.39), each
    point weighted by its covariance (see `armscan.calibration.cameras.robust` for what is added to
    the detector's). The covariance is that of the normal equations, scaled by sigma0 squared =
    chi2 / degrees of freedom: the point covariances give the weights, the residuals the level.

    A target of wrong size in mm cannot be noticed here: it scales the poses and leaves the camera
    as it is. A numbering that starts at the opposite corner of a symmetric target leaves it, too,
    but its sigmas are right only where all views are numbered alike; see
    `armscan.calibration.cameras.print_errors.agreeing_numberings`.

    Raises
    ------
    InputError
        If the images differ in size, or two views have one name.
    OptionError
        If a view to leave out does not exist.
    """
    options = options or CameraOptions()
    prepared = prepare_views(views, options)
    if isinstance(prepared, FitFailure):
        return prepared
    chosen = _solve_model(views, prepared, options)
    if isinstance(chosen, FitFailure):
        return chosen if (told := _of_other_cells(views, prepared)) is None else told
    while (bad := _to_leave_out(chosen.solution, options)).any():
        smaller = _without(bad, prepared, chosen.solution)
        if len(smaller.used) < max(3, len(prepared.used) // 2):
            break
        again = _solve_model(views, smaller, options)
        if isinstance(again, FitFailure):
            break
        prepared, chosen = smaller, again
    fit = assemble(views, prepared, chosen, misfits(chosen.solution), options)
    if isinstance(fit, FitFailure):
        return fit if (told := _of_other_cells(views, prepared)) is None else told
    stretch = _seen_stretch(views, prepared) if rms_reasons(fit.camera, fit.rms_px) else None
    return fit if stretch is None else replace(fit, stretch=stretch - 1.0, stretch_sigma=0.0)


def _seen_stretch(views: Sequence[TargetView], prepared: PreparedViews) -> float | None:
    return seen_stretch(prepared.homographies, views[0].width_px, views[0].height_px)


def _of_other_cells(views: Sequence[TargetView], prepared: PreparedViews) -> FitFailure | None:
    """Asked where no camera fits: whether one does if the target's cells are no squares."""
    stretch = _seen_stretch(views, prepared)
    if stretch is None:
        return None
    return FitFailure(
        "no camera fits the target as it is described, and one does if rows lie "
        f"{stretch:.2f} times as far apart as columns",
        "measure the print both ways and "
        f"{as_two_lengths(views[0].points_board_mm, stretch - 1.0)}; print without fitting to the "
        "page",
    )


def misfits(solution: Solution) -> BoolArray:
    """(V,) True for views that fit so much worse than the typical one that they should go."""
    return np.asarray(
        (solution.view_levels > MISFIT_LEVEL) | (solution.outlier_shares > MISFIT_OUTLIERS)
    )


def _to_leave_out(solution: Solution, options: CameraOptions) -> BoolArray:
    """Misfits if wanted; views that are plainly wrong in any case."""
    if options.leave_out_misfits:
        return misfits(solution)
    return np.asarray(solution.view_levels > WRONG_LEVEL)


def _without(bad: BoolArray, prepared: PreparedViews, solution: Solution) -> PreparedViews:
    left_out = dict(prepared.left_out)
    for position, index in enumerate(prepared.used):
        if bad[position]:
            ratio = float(np.sqrt(solution.view_levels[position]))
            left_out[index] = f"left out: residuals {ratio:.1f} times those of the typical view"
    keep = [position for position in range(len(prepared.used)) if not bad[position]]
    used = tuple(prepared.used[position] for position in keep)
    return PreparedViews(
        used,
        tuple(prepared.homographies[position] for position in keep),
        left_out,
        prepared.refused,
        {later: earlier for later, earlier in prepared.repeats.items() if later in used},
    )


def _solve_model(
    views: Sequence[TargetView], prepared: PreparedViews, options: CameraOptions
) -> ChosenModel | FitFailure:
    """Solve with the wanted model; or all coefficients, and the kind of lens that is chosen."""
    used = [views[index] for index in prepared.used]
    observations = gather(used, "pinhole")
    sources = tuple(view.source for view in used)

    @cache
    def solve(model: DistortionModel) -> Solution | FitFailure:
        seen = replace(observations, lens="fisheye") if model == "fisheye" else observations
        return _solve(used, seen, prepared, model, options)

    def validate(solution: Solution, reference: Solution) -> CrossValidation | None:
        on_points = replace(solution, weights=reference.weights)
        return cross_validate(on_points, sources, options.n_folds)

    if options.distortion == "auto":
        solution = _beside_usual_sizes(used, observations, prepared, options)
        if isinstance(solution, FitFailure):
            pinhole: ChosenModel | FitFailure = solution
        else:
            reason = _reason_of_sizes(solution)
            pinhole = ChosenModel(_ALL, solution, validate(solution, solution), reason)
        return choose_lens(pinhole, solve, validate) if options.n_folds else pinhole
    model = options.distortion
    solution = solve(model)
    if isinstance(solution, FitFailure):
        return solution
    return ChosenModel(model, solution, validate(solution, solution), f"{model} was asked for")


_ALL: DistortionModel = "k1k2p1p2k3"


def _beside_usual_sizes(
    used: Sequence[TargetView],
    observations: Observations,
    prepared: PreparedViews,
    options: CameraOptions,
) -> Solution | FitFailure:
    """All five coefficients, each beside the size that it has in usual lenses, unless the views
    contradict that.

    What the sizes weigh beside the points is told by the residuals of the free solution: where too
    much of a lens is held at zero, they are large and alike, and would hold it there.
    """
    first = _solve(used, observations, prepared, _ALL, options)
    if isinstance(first, FitFailure):
        first = _solve(used, observations, prepared, "k1", options)
    if isinstance(first, FitFailure):
        return first
    free = _with_its_bow(first, options)
    level = level_of_points(free)
    known = known_of_usual_lenses(free, level)
    while True:
        beside_sizes = replace(observations, known=known)
        solution = _solve(used, beside_sizes, prepared, _ALL, options, more=[first.state])
        if isinstance(solution, FitFailure):
            return solution
        beside = _with_its_bow(solution, options)
        row = contradicted_size(beside, level)
        if row is None:
            is_dear = cost_of_usual(beside, free) > MOST_COST * level
            return first if is_dear and first.basis.shape == solution.basis.shape else solution
        known = np.where(np.arange(len(known)) == row, 0.0, known)


def _with_its_bow(solution: Solution, options: CameraOptions) -> Solution:
    """On a board that is bowed where that is significant: a bow passes for tangential terms."""
    bow = with_significant_bow(solution, options.max_steps, is_wanted=options.solve_warp)
    return solution if isinstance(bow, FitFailure) else bow[0]


def _reason_of_sizes(solution: Solution) -> str:
    resting = resting_on_usual(solution)
    told = [name for name in DISTORTION_PARAMETERS[_ALL] if name not in resting]
    verb = "rests" if len(resting) == 1 else "rest"
    rest = f"{' '.join(resting)} {verb} more on what is usual of lenses" if resting else ""
    return "all five coefficients: " + f"the views tell {' '.join(told)}; {rest}".rstrip("; ")


def _solve(
    used: Sequence[TargetView],
    observations: Observations,
    prepared: PreparedViews,
    model: DistortionModel,
    options: CameraOptions,
    *,
    more: Sequence[State] = (),
) -> Solution | FitFailure:
    """The best fit from the closed forms, and from states that are likely to be near."""
    basis, _ = free_basis(model, options)
    starts = _starts(used, observations, prepared, model, options)
    if isinstance(starts, FitFailure):
        return starts
    trusted = starts[0][1]
    found = [
        solve_robustly(observations, state, basis, trusted, options.max_steps)
        for state in [*(state for state, _ in starts), *more]
    ]
    solution = reduce(better_fit, [_unmirrored(each, trusted, options) for each in found])
    for _ in range(EXCESS_ROUNDS):
        if isinstance(solution, FitFailure):
            return solution
        excess = added_variance_px2(observations, solution)
        if excess <= 0.0:
            break
        noisier = with_excess(observations, excess)
        solution = solve_robustly(noisier, solution.state, basis, trusted, options.max_steps)
    if isinstance(solution, FitFailure):
        return solution
    if largest_angle_deg(solution.state.rotations[:, :, 2]) < MIN_ANGLE_DEG:
        return PARALLEL
    return solution


def _starts(
    used: Sequence[TargetView],
    observations: Observations,
    prepared: PreparedViews,
    model: DistortionModel,
    options: CameraOptions,
) -> list[tuple[State, BoolArray]] | FitFailure:
    """The closed form, and for a pinhole the one of square pixels with its axis in the middle.

    Where views tell little, noise throws the principal point out of the image or makes one focal
    length twice the other, from where the adjustment may end in a minimum that is not the least.
    """
    first = starting_state(used, observations, prepared.homographies, model, options)
    if isinstance(first, FitFailure):
        return first
    if model == "fisheye" or options.is_principal_point_fixed:
        return [first]
    second = starting_state(
        used, observations, prepared.homographies, model, options, is_centred=True
    )
    if isinstance(second, FitFailure) or np.array_equal(first[0].shared, second[0].shared):
        return [first]
    return [first, second]


MIRROR_ROUNDS = 5


def _unmirrored(
    solution: Solution | FitFailure, trusted: BoolArray, options: CameraOptions
) -> Solution | FitFailure:
    """The solution, or a better one with boards mirrored that fit badly: all of them, or the worst.

    A distant board fits almost as well when it is mirrored at the line of sight; from a poor start
    some boards stay so, and draw the camera with them.
    """
    for _ in range(MIRROR_ROUNDS):
        if isinstance(solution, FitFailure):
            break
        before, seen, steps = solution, solution.observations, options.max_steps
        bad = np.flatnonzero(before.view_levels > SUSPECT_LEVEL)
        worst = bad[np.argsort(before.view_levels[bad])[-1:]]
        for chosen in [bad, worst][: len(bad)]:
            turned = _mirrored(before, chosen)
            other = solve_robustly(seen, turned, before.basis, trusted, steps)
            solution = better_fit(before, other)
            if solution is not before:
                break
        if solution is before:
            break
    return solution


def _mirrored(solution: Solution, views: IntArray) -> State:
    """The state with the boards of some views mirrored at the line of sight."""
    state, seen = solution.state, solution.observations
    poses = [state.pose(v) for v in range(seen.n_views)]
    for v in views:
        poses[v] = mirrored_pose(poses[v], seen.board_mm[seen.rows(v)].mean(axis=0))
    return State.from_poses(state.shared, poses)
