# SPDX-License-Identifier: Apache-2.0
"""What else could explain the stripes on a plate, judged by likelihood.

Scatter that is estimated from the residuals takes up whatever they hold: a plate that was moved
between two postures looks like an arm of so much scatter. So each alternative gets unknowns of its
own, the scatter is estimated anew beside them, and the unknowns are judged by that. What is known
of them (the probed plane, the sensor's covariance) stays in the covariance of the residuals, so
that an unknown which the prior explains is no alternative. Where no hand-eye fits at all, mirrored
data and poses read in another way are tried.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from armscan.calibration.hand_eye.estimate import (
    HandEyeSolution,
    Problem,
    estimate,
    joint_covariance,
    minimise_distances,
)
from armscan.calibration.hand_eye.noise import (
    NoiseComponent,
    NoiseEstimate,
    estimate_noise,
    solve_linear,
    total_covariance,
)
from armscan.calibration.hand_eye.observations import CondensedObservations, PlateReference
from armscan.calibration.hand_eye.search import (
    Start,
    find_start,
    linear_hand_eye,
    posture_rms,
    posture_rms_at,
    thinned,
    three_a_stripe,
)
from armscan.calibration.hand_eye.surface import N_HAND_EYE, PlateSurface
from armscan.geometry.arrays import FloatArray, homogeneous
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import p_text, pseudo_inverse
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import EulerConvention, euler_from_rotations, rotations_from_euler
from armscan.models.calibration import SHEET_PARAMETER_NAMES
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES

LEAST_ON_A_SIDE = 3
"""Postures before and after a change: fewer are told from wrong ones by nothing."""
LARGEST_MOVE = 0.2
"""Of the points' distance from the sensor, by another sensor."""
ASKED_FOR = 0.05
"""Another sensor is asked for if its unknowns are less probable than this under the scatter as it
is. Scaled down to nothing, by a scale or by a sheet shifted on to the camera, any stripes lie on
one point of any plate: scatter that is estimated beside such unknowns vanishes."""
OF_SENSOR = ("scale", "sheet")
LEAST_FREEDOM = 2.0
"""Up to which an F statistic has no mean."""
FACTS_OF_POSTURE = 2
"""What a stripe says of its posture's error: a shift and a slope."""
SUSPICIOUS = 2e-3
"""An alternative is named if unknowns as large as its are less probable than this."""
UNLIKELY = 3e-4
"""And it may be a reason to refuse below this."""
ARM_ACCURACY_MM = 0.05
"""What measuring arms err by from place to place without anything being wrong: what moves the
stripes by less is said, and held by the stated covariance; more is refused."""
MOST_SIGMAS = 3.0
"""A hand-eye that an alternative would move by more of its sigmas is refused."""
PROBE_AGAIN = (
    "where the tip was compensated to the wrong side, run `armscan probe --side` with the side "
    "that was touched; else probe the plate again, from the side that is scanned and after its "
    "last move, or solve the plate along (--solve-plate)"
)
FIND_WHAT_MOVED = (
    "find out what moved there (a plate that slid, an arm that was referenced anew), and scan all "
    "postures again without it, or only those before or after it"
)
UNCHECKED_PLANE = (
    "not checked: the postures do not tell a plate that lies elsewhere from another hand-eye"
)
ALIKE = 0.1
"""An offset within this part of the tip's diameter or radius is taken for it."""
LIKELIER = 10.0
"""Logarithm of the likelihood ratio from which mirrored data are believed: 22,000 to 1."""
SMALLER = 0.7
"""And they leave less than this part of what the data as given leave."""
HOPELESS = 2.0
"""Mirrored data whose start, with wrong postures left out, leaves more than so many times what the
data as given leave are no reason to refuse: what a refusal rests on leaves less than `SMALLER`."""
LARGEST_SHIFT = 0.1
"""Of the middle of a mirrored image, over the focal length."""
NO_FIT_MM = 1e6
"""What a shift without a hand-eye leaves: finite, for the search fits parabolas."""
BOW_DEGREE = 2
LEAST_OF_SHEET = 12
BETTER = 0.1
"""A reading of the poses is offered if it leaves less than this part of what the given one does."""


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Unknowns of something that should be as given, and what they would be.

    Parameters
    ----------
    name
        ``plate`` and ``offset`` (the plate is not where it was probed), ``change`` (plate or Base
        moved between two postures), ``scale`` or ``sheet`` (the sensor is not as calibrated).
    number
        For a change, the number of the first posture after it; for a sheet, its number; else 0.
    values, covariance
        (Q,) what the unknowns would be, and (Q, Q) how well that is known, the prior included.
    size_mm
        Root mean square of what they move the stripes by.
    probability
        Of unknowns as large as these if all is as given, over all alternatives of the kind.
    likelihood
        Logarithm of the likelihood with them, one taken off for each unknown.
    hand_eye_change, hand_eye_covariance
        (6,) what the hand-eye would change by, and (6, 6) its covariance then.
    arm_mm
        Scatter of the arm that is left.
    """

    name: str
    number: int
    values: FloatArray
    covariance: FloatArray
    size_mm: float
    probability: float
    likelihood: float
    hand_eye_change: FloatArray
    hand_eye_covariance: FloatArray
    arm_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class _Unknowns:
    """Derivative (M, Q) of the residuals by an alternative's unknowns."""

    name: str
    jacobian: FloatArray
    number: int = 0
    n_tried: int = 1


def find_alternatives(fit: HandEyeSolution) -> tuple[Alternative, ...]:
    """Every kind of alternative to a solution on a plate at its best, likeliest first."""
    placed = fit.placed
    known = fit.problem.surface_covariance(placed) + fit.problem.sensor_covariance(placed)
    found = [
        _weighed(fit, known, replace(one, jacobian=fit.problem.of_smooth_stripes(one.jacobian)))
        for one in _all_unknowns(fit)
    ]
    return tuple(sorted((one for one in found if one is not None), key=lambda o: -o.likelihood))


def _all_unknowns(fit: HandEyeSolution) -> Iterator[_Unknowns]:
    problem, placed = fit.problem, fit.placed
    observations = problem.observations
    yield _Unknowns("scale", fit.by_scale)
    if not problem.options.solve_plate:
        yield _Unknowns("plate", placed.by_surface)
        yield _Unknowns("offset", placed.by_surface[:, 2:])
    by_sensor = placed.by_sensor
    for sheet in np.unique(observations.sheet).tolist():
        first = len(CAMERA_PARAMETER_NAMES) + len(SHEET_PARAMETER_NAMES) * sheet
        if by_sensor is not None and first + 3 <= by_sensor.shape[1]:
            of_sheet = (observations.sheet == sheet)[:, None]
            yield _Unknowns("sheet", of_sheet * by_sensor[:, first : first + 3], sheet)
    change = _likeliest_change(fit)
    if change is not None:
        yield change


def _likeliest_change(fit: HandEyeSolution) -> _Unknowns | None:
    """The place in the order of postures where a shift of the plate or Base explains most.

    Postures are numbered in the order of the exposures.
    """
    observations = fit.problem.observations
    used = observations.used_postures
    numbers = used[LEAST_ON_A_SIDE : len(used) - LEAST_ON_A_SIDE + 1]
    best, best_score = None, 0.0
    for first in numbers:
        jacobian = (observations.posture >= first)[:, None] * fit.placed.by_surface
        weight = jacobian.T @ fit.linear.projected @ jacobian
        score = jacobian.T @ fit.explained
        statistic = float(score @ pseudo_inverse(weight, 1e-9) @ score)
        if statistic > best_score:
            best, best_score = _Unknowns("change", jacobian, int(first), len(numbers)), statistic
    return best


def _weighed(fit: HandEyeSolution, known: FloatArray, unknowns: _Unknowns) -> Alternative | None:
    """Judge unknowns under the scatter that is left beside them; None where they stay open."""
    n_known, n_new = fit.jacobian.shape[1], unknowns.jacobian.shape[1]
    n_facts = FACTS_OF_POSTURE * len(fit.problem.observations.used_postures)
    scale = np.linalg.norm(unknowns.jacobian, axis=0)
    if n_facts - n_known - n_new < 1 or not (scale > 0.0).all():
        return None
    jacobian = np.concatenate([fit.jacobian, unknowns.jacobian / scale], axis=1)
    noise = estimate_noise(
        fit.placed.residual_mm, jacobian, fit.components, known, fit.noise.sigmas
    )
    total = total_covariance(fit.components, noise.sigmas) + known
    found = _judged(replace(fit, noise=noise), total, unknowns, jacobian)
    if unknowns.name not in OF_SENSOR:
        return found
    total = total_covariance(fit.components, fit.noise.sigmas) + known
    plain = _judged(fit, total, unknowns, jacobian)
    if plain is not None and plain.probability > ASKED_FOR:
        found = plain
    points = fit.problem.observations.points_mm
    most_mm = LARGEST_MOVE * float(np.median(np.linalg.norm(points, axis=1)))
    return None if found is None or found.size_mm > most_mm else found


def _judged(
    fit: HandEyeSolution, total: FloatArray, unknowns: _Unknowns, jacobian: FloatArray
) -> Alternative | None:
    """Unknowns beside those of ``fit``, whose scatter is of ``total`` covariance.

    ``jacobian`` (M, K + Q) is by both, the columns of the new ones of unit length.
    """
    n_known, n_new = fit.jacobian.shape[1], unknowns.jacobian.shape[1]
    n_facts = FACTS_OF_POSTURE * len(fit.problem.observations.used_postures)
    scale = np.linalg.norm(unknowns.jacobian, axis=0)
    residual = fit.placed.residual_mm
    solution = solve_linear(residual, jacobian, total)
    if solution is None:
        return None
    values, covariance = solution.step[n_known:], solution.covariance[n_known:, n_known:]
    if np.linalg.cond(covariance) > 1e12:
        return None
    statistic = float(values @ np.linalg.solve(covariance, values)) / n_new
    told = freedom_of(fit.components, fit.noise, solution.gain[n_known:], covariance)
    freedom = min(float(n_facts - n_known - n_new), told)
    chance = float(fdtrc(n_new, freedom, max(statistic, 0.0)))
    moved = unknowns.jacobian @ (values / scale)
    quadratic = float(residual @ solution.projected @ residual)
    determinant = float(np.linalg.slogdet(total)[1])
    return Alternative(
        name=unknowns.name,
        number=unknowns.number,
        values=values / scale,
        covariance=covariance / np.outer(scale, scale),
        size_mm=float(np.sqrt((moved**2).mean())),
        probability=min(chance * unknowns.n_tried, 1.0),
        likelihood=-0.5 * (quadratic + determinant) - n_new,
        hand_eye_change=solution.step[:N_HAND_EYE] - fit.linear.step[:N_HAND_EYE],
        hand_eye_covariance=solution.covariance[:N_HAND_EYE, :N_HAND_EYE],
        arm_mm=fit.arm_mm,
    )


def freedom_of(
    components: Sequence[NoiseComponent],
    noise: NoiseEstimate,
    gain: FloatArray,
    covariance: FloatArray,
) -> float:
    """Degrees of freedom of a covariance (Q, Q) of unknowns that rests on estimated scatter.

    A cause or two may set it, and each is known only as the covariance of its logarithm says:
    how many numbers the postures tell of all causes together is no measure of that. Of each
    principal direction they are those of the chi-square of equal mean and variance
    (Satterthwaite), of all together as by Fai and Cornelius, J. Statist. Comput. Simul. 54, 1996,
    but the least where one has no mean.
    ``gain`` (Q, M) takes residuals to the unknowns.
    """
    variances, axes = np.linalg.eigh(covariance)
    turned = axes.T @ gain
    by_log = np.array(
        [
            2.0 * sigma**2 * np.einsum("qm,qm->q", turned @ one.covariance, turned)
            for one, sigma in zip(components, noise.sigmas, strict=True)
        ]
    )
    spread = np.einsum("kq,kl,lq->q", by_log, noise.log_covariance, by_log)
    each = 2.0 * variances**2 / np.maximum(spread, 1e-12 * variances**2)
    if len(each) == 1 or each.min() <= LEAST_FREEDOM:
        return float(each.min())
    mean = float((each / (each - LEAST_FREEDOM)).sum())
    return 2.0 * mean / (mean - len(each))


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction:
    """An alternative that is believed, and the scatter of the arm that it leaves.

    ``widening`` (6, 6) is added to the hand-eye's covariance to hold what it would change by.
    """

    failure: FitFailure
    is_refused: bool
    widening: FloatArray
    arm_mm: float


def find_contradiction(
    found: Sequence[Alternative], fit: HandEyeSolution, plate: PlateReference
) -> Contradiction | None:
    """The likeliest of the alternatives that the stripes ask for; None if all is as given."""
    believed = [one for one in found if one.probability < SUSPICIOUS]
    if not believed:
        return None
    best = believed[0]
    change = best.hand_eye_change
    own = joint_covariance(fit).given_sensor
    variance = np.minimum(np.diag(own), np.diag(best.hand_eye_covariance))
    is_refused = (
        best.probability < UNLIKELY
        and best.size_mm > ARM_ACCURACY_MM
        and float(np.abs(change / np.sqrt(variance)).max()) > MOST_SIGMAS
    )
    return Contradiction(
        failure=_contradicted(best, fit, plate),
        is_refused=is_refused,
        widening=np.outer(change, change),
        arm_mm=best.arm_mm,
    )


def plane_in_words(found: Sequence[Alternative]) -> str:
    """How the stripes alone see the probed plane, or that they cannot tell."""
    checks = {one.name: one for one in found}
    if "plate" not in checks or "offset" not in checks:
        return UNCHECKED_PLANE
    by_offset = checks["offset"]
    shift_mm, sigma_mm = float(by_offset.values[0]), float(np.sqrt(by_offset.covariance[0, 0]))
    probability = min(checks["plate"].probability, by_offset.probability)
    agrees = "contradict it" if probability < SUSPICIOUS else "agree with it"
    return (
        f"the stripes {agrees} ({p_text(probability)}): by themselves they put it "
        f"{shift_mm:+.3f} ± {sigma_mm:.3f} mm along its normal; a plate that moved by less than "
        f"{3.0 * sigma_mm:.2f} mm after probing may go unnoticed"
    )


def _contradicted(one: Alternative, fit: HandEyeSolution, plate: PlateReference) -> FitFailure:
    """What is contradicted and by how much, and what to do."""
    chance = f"(probability {one.probability:.1g})"
    if one.name in ("plate", "offset"):
        plane = one.values if one.name == "plate" else np.array([0.0, 0.0, *one.values])
        where = offset_in_words(*_offset_and_tilt(plane, fit.placed.by_surface), plate)
        fact = f"probed plane and scan disagree {chance}: the plane solved along lies {where}"
        return FitFailure(fact, PROBE_AGAIN)
    if one.name == "change":
        offset_mm, tilt_deg = _offset_and_tilt(one.values, fit.placed.by_surface)
        observations = fit.problem.observations
        before = observations.used_postures[observations.used_postures < one.number].max()
        return FitFailure(
            f"the postures up to {observations.postures[before]} and those from "
            f"{observations.postures[one.number]} on each agree among themselves, but not with "
            f"each other {chance}: between them the plate or the arm's base moved by "
            f"{abs(offset_mm):.3f} mm and tilted by {tilt_deg:.3f} deg",
            FIND_WHAT_MOVED,
        )
    what = f"light sheet {one.number + 1} lies elsewhere than calibrated"
    if one.name == "scale":
        size = "small" if one.values[0] > 0.0 else "large"
        what = f"the sensor's points are too {size} by {100.0 * abs(float(one.values[0])):.3f} %"
    return FitFailure(
        f"the stripes contradict the sensor's calibration {chance}: {what}, which moves them by "
        f"{one.size_mm:.3f} mm",
        "calibrate the sensor again: its camera or its light sheet has changed, or the calibration "
        "is another sensor's",
    )


def _offset_and_tilt(plane: FloatArray, by_surface: FloatArray) -> tuple[float, float]:
    """Offset (mm) where the stripes lie and tilt (deg) of a plane's two tilts and offset."""
    middle = -by_surface.mean(axis=0)
    return float(middle @ plane), float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))


def find_free_plane(problem: Problem, plate: PlateSurface) -> tuple[float, float, float] | None:
    """Solve hand-eye and plane together; None where the postures do not determine both.

    Its offset (mm) along the probed one's normal, where the stripes lie, its tilt (deg), and the
    median over postures of their distance from it (mm).
    """
    observations = problem.observations
    start = linear_hand_eye(observations, plate.plane, is_offset_free=True)
    if start is None:
        return None
    freed = replace(problem, options=replace(problem.options, solve_plate=True))
    found = minimise_distances(freed, problem.start(start), np.eye(len(observations)))
    if found is None:
        return None
    placed = problem.place(found.state)
    offset_mm, tilt_deg = _offset_and_tilt(found.state.surface, placed.by_surface)
    typical = float(np.nanmedian(posture_rms(observations, placed.residual_mm)))
    return offset_mm, tilt_deg, typical


def offset_in_words(offset_mm: float, tilt_deg: float, plate: PlateReference) -> str:
    """Say where a plane lies relative to the probed one, and what that looks like."""
    side = "above" if offset_mm > 0.0 else "below"
    words = f"{abs(offset_mm):.3f} mm {side} the probed one, tilted by {tilt_deg:.3f} deg"
    diameter = plate.tip_diameter_mm
    if diameter > 0.0 and abs(abs(offset_mm) - diameter) < ALIKE * diameter:
        return (
            f"{words}; that is the tip's diameter ({diameter:g} mm): the tip was compensated "
            "to the wrong side of the plate, which `armscan probe --side` sets right"
        )
    if diameter > 0.0 and abs(abs(offset_mm) - 0.5 * diameter) < ALIKE * diameter:
        return (
            f"{words}; that is the tip's radius ({0.5 * diameter:g} mm): the tip was not "
            "compensated for, or twice"
        )
    return words


def find_mirror(
    problem: Problem, plate: PlateSurface, start: Start, smaller: float = SMALLER
) -> FitFailure | None:
    """Refuse data that are much likelier if something was mirrored; None if nothing was.

    Mirrored data must leave less than ``smaller`` times what the data as given leave.

    A reflection in a flat light sheet leaves the sheet's points where they are, so that mirrored
    data of one perfectly flat sheet fit as well as right ones: nothing but a drawing of the head
    can tell. The bow of real sheets and a second sheet tell them apart, by a misfit of some tenths
    of a millimetre that passes for scatter of a bad arm. So mirrored readings are always tried.
    """
    few = thinned(problem.without(start.is_wrong).observations)
    given = _likelihood(replace(problem, observations=few), start.tool_from_sensor)
    if given is None:
        return None
    best = None
    # A reading that is far off cannot be the mirror, but may be likelier than one that could: all
    # are heard before anything is refused.
    for most_mm in (HOPELESS * given[1], np.inf):
        best = _likeliest_mirrored(replace(problem, observations=few), plate, most_mm)
        if best is None or best[0] < given[0] + LIKELIER or best[1] > smaller * given[1]:
            return None
    if best is None:
        return None
    return FitFailure(
        f"mirrored data: the stripes of the typical posture lie {given[1]:.3f} mm from the plate, "
        f"and {best[1]:.3f} mm {best[2]}",
        best[3],
    )


def _likeliest_mirrored(
    problem: Problem, plate: PlateSurface, most_mm: float
) -> tuple[float, float, str, str] | None:
    """`_likelihood`, words and remedy of the likeliest of the mirrored readings.

    Those whose start leaves more than ``most_mm``, wrong postures left out, are not estimated.
    """
    best: tuple[float, float, str, str] | None = None
    for words, remedy, mirrored in _all_mirrored(problem.observations, plate):
        start = find_start(mirrored, plate)
        if start.typical_mm > most_mm:
            continue
        found = _likelihood(replace(problem, observations=mirrored), start.tool_from_sensor)
        if found is not None and (best is None or found[0] > best[0]):
            best = (*found, words, remedy)
    return best


def _likelihood(problem: Problem, pose: Pose[Tool, Sensor]) -> tuple[float, float] | None:
    """Logarithm of the likelihood, and the typical distance of the postures in mm."""
    fit = estimate(problem, problem.start(pose))
    if fit is None:
        return None
    typical = float(np.nanmedian(posture_rms(problem.observations, fit.placed.residual_mm)))
    return fit.linear.log_likelihood, typical


def _all_mirrored(
    given: CondensedObservations, plate: PlateSurface
) -> Iterator[tuple[str, str, CondensedObservations]]:
    """Words, remedy and data of everything that may have been mirrored."""
    for axis, name in enumerate("xyz"):
        mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
        rotations, translations = mirror @ given.rotations @ mirror, given.translations_mm @ mirror
        yield (
            f"if the poses were left-handed, {name} pointing the other way (the plate was not)",
            f"give the poses in a right-handed frame: turn the sign of {name} and of the two "
            "rotations that it changes, or read them by the convention of the arm's maker",
            replace(given, rotations=rotations, translations_mm=translations),
        )
    # The sensor's points in a mirror: what left-handed poses and plate come to.
    mirror, by_sensor = np.diag([-1.0, 1.0, 1.0]), given.dpoint_dsensor
    yield (
        "if poses and plate were left-handed (an axis of Base and Tool points the other way), or "
        "the sensor's points",
        "give poses, probed points and the sensor's points in right-handed frames",
        replace(
            given,
            points_mm=given.points_mm @ mirror,
            noise_mm2=mirror @ given.noise_mm2 @ mirror,
            dpoint_dsensor=None if by_sensor is None else mirror @ by_sensor,
        ),
    )
    if float(given.points_mm[:, 2].min()) > 0.0:
        for axis, name in ((0, "left and right"), (1, "top and bottom")):
            yield (
                f"if {name} of the images were exchanged",
                "turn off the camera's mirroring (reverse X or Y), and record calibration and "
                "scan with the same setting",
                _reversed_image(given, plate, axis),
            )


def _reversed_image(
    given: CondensedObservations, plate: PlateSurface, axis: int
) -> CondensedObservations:
    """What the sheets give along the rays of a reversed image; where its middle is, is sought."""

    def left(shift: float) -> float:
        tried = _along_reversed_rays(given, axis, shift)
        pose = linear_hand_eye(tried, plate.plane)
        return (
            NO_FIT_MM if pose is None else float(np.nanmedian(posture_rms_at(tried, plate, pose)))
        )

    limits = (-LARGEST_SHIFT, LARGEST_SHIFT)
    found = minimize_scalar(left, bounds=limits, method="bounded", options={"xatol": 1e-4})
    return _along_reversed_rays(given, axis, float(found.x))


def _along_reversed_rays(
    given: CondensedObservations, axis: int, shift: float
) -> CondensedObservations:
    """Points of the same sheets on the rays ``-x/z + shift`` (or y).

    A plane's inverse depth is linear in a ray's x/z and y/z; its bow adds quadratic terms.
    """
    rays = given.points_mm[:, :2] / given.points_mm[:, 2:]
    turned = rays.copy()
    turned[:, axis] = shift - rays[:, axis]
    points = given.points_mm.copy()
    for sheet in np.unique(given.sheet):
        of_sheet = given.sheet == sheet
        degree = BOW_DEGREE if int(of_sheet.sum()) >= LEAST_OF_SHEET else 1
        terms, inverse_depth = _terms(rays[of_sheet], degree), 1.0 / given.points_mm[of_sheet, 2]
        inverse = np.linalg.lstsq(terms, inverse_depth, rcond=1e-9)[0]
        depth = 1.0 / np.maximum(_terms(turned[of_sheet], degree) @ inverse, 1e-6)
        points[of_sheet] = homogeneous(turned[of_sheet]) * depth[:, None]
    return replace(given, points_mm=points)


def _terms(rays: FloatArray, degree: int) -> FloatArray:
    a, b = rays.T
    return np.column_stack([a**i * b**j for i in range(degree + 1) for j in range(degree + 1 - i)])


def find_reading(
    given: CondensedObservations,
    plate: PlateSurface,
    fact: str,
    typical_mm: float,
    *,
    most_mm: float,
) -> FitFailure | None:
    """Refuse in favour of another way to read the poses, if the stripes agree with one.

    Convention, direction, unit and order are tried. ``fact`` says what is wrong as they are read,
    and that leaves ``typical_mm``; the other reading may leave ``most_mm``.
    """
    few = three_a_stripe(given)
    for words, remedy, rotations, translations in other_readings(
        few.rotations, few.translations_mm
    ):
        read = replace(few, rotations=rotations, translations_mm=translations)
        left = find_start(read, plate).typical_mm
        if left < BETTER * typical_mm and left <= most_mm:
            return FitFailure(f"{fact}; {words} would leave {left:.3f} mm", remedy)
    return None


def other_readings(
    rotations: FloatArray, translations: FloatArray, convention: EulerConvention | None = None
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Other ways to read (N, 3, 3) and (N, 3) of ``base_from_tool``: words, remedy, and both so.

    ``convention`` is that of the angles as they were read; None tries each.
    """
    names: tuple[EulerConvention, ...] = get_args(EulerConvention)
    for read in names if convention is None else (convention,):
        angles = euler_from_rotations(rotations, read)
        for meant in names:
            if meant == read:
                continue
            words = f"if the angles were read as {read}, reading them as {meant}"
            remedy = (
                f"give the rotation convention {meant}: of a recording in session.toml, "
                f'[pose] rotation = "{meant}"; of robot poses with --euler'
            )
            if convention is None and {read, meant} == REVERSED:
                words = f"taking the angles in the other order ({read} for {meant}, or vice versa)"
                remedy += f"; or {read}, if {meant} was given"
            for branch in _branches(angles, read):
                yield words, remedy, rotations_from_euler(branch, meant), translations
    yield from _as_radians(rotations, translations, convention)
    quaternions = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    for shift, order, was in ((1, "qx,qy,qz,qw", "qw first"), (-1, "qw,qx,qy,qz", "qw last")):
        yield (
            f"taking the quaternions, which were read with {was}, as {order}",
            f"name their columns {order}, in the order in which they stand",
            Rotation.from_quat(np.roll(quaternions, shift, axis=1), scalar_first=True).as_matrix(),
            translations,
        )
    back = rotations.transpose(0, 2, 1)
    yield (
        "taking the poses as tool_from_base",
        "give base_from_tool: the inverse of the poses given",
        back,
        -np.einsum("sij,sj->si", back, translations),
    )
    yield (
        "transposing the rotations",
        "give the rotations row by row, the tool's axes in the columns",
        back,
        translations,
    )
    for factor, unit in ((1000.0, "metres"), (25.4, "inches")):
        words = f"reading the translations in {unit}"
        yield words, "give the translations of the poses in mm", rotations, factor * translations
    for shift, which in ((-1, "after"), (1, "before")):
        yield (
            f"giving each exposure the pose of the one {which} it",
            "check that no exposure and no pose is missing or doubled",
            np.roll(rotations, shift, axis=0),
            np.roll(translations, shift, axis=0),
        )


def _as_radians(
    rotations: FloatArray, translations: FloatArray, convention: EulerConvention | None
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """As `other_readings`: angles that were written in radians and read as degrees."""
    names: tuple[EulerConvention, ...] = get_args(EulerConvention)
    for read in names if convention is None else (convention,):
        angles = np.degrees(euler_from_rotations(rotations, read))
        if np.abs(angles).max() > 2.0 * np.pi:
            continue
        for meant in (read, *(name for name in names if name != read)):
            told = "" if meant == read else f", and give the rotation convention {meant}"
            yield (
                f"reading the angles ({meant}) as radians",
                "write angles in degrees (of robot poses a header with a_rad, b_rad, c_rad will "
                f"do){told}",
                rotations_from_euler(angles, meant),
                translations,
            )


REVERSED: set[EulerConvention] = {"extrinsic-xyz", "intrinsic-zyx"}
"""The same three turns, in reversed order: which of them was read makes no difference."""


def _branches(angles_rad: FloatArray, convention: EulerConvention) -> Iterator[FloatArray]:
    """Ways to write the same rotations as angles (N, 3): one way, the other, and of both what is
    nearest to the first one's.
    """
    other = _other_branch(angles_rad, convention)
    yield angles_rad
    yield other
    for first in (angles_rad[0], other[0]):
        far = [
            np.abs(np.remainder(one - first + np.pi, 2.0 * np.pi) - np.pi).sum(axis=1)
            for one in (angles_rad, other)
        ]
        is_near = far[0] <= far[1]
        if is_near.any() and not is_near.all():
            yield np.where(is_near[:, None], angles_rad, other)


def _other_branch(angles_rad: FloatArray, convention: EulerConvention) -> FloatArray:
    """The other three angles (N, 3) of the same rotations."""
    if convention == "rotation-vector":
        size = np.linalg.norm(angles_rad, axis=1, keepdims=True)
        return np.asarray(angles_rad * (1.0 - 2.0 * np.pi / np.maximum(size, 1e-12)))
    first, middle, last = angles_rad.T
    turned = -middle if convention == "intrinsic-zxz" else np.pi - middle
    return np.column_stack([first + np.pi, turned, last + np.pi])
