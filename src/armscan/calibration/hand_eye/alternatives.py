# SPDX-License-Identifier: Apache-2.0
"""Other explanations of what does not agree: a plate that moved or was probed on another side,
a mirrored sensor, poses read in another convention, single known quantities that are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import f as f_distribution

from armscan.calibration.hand_eye.estimate import (
    PlateFit,
    estimate_noise,
    fit_plate,
    known_covariance,
)
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateNodes,
    PlateReference,
    PlateState,
    place_nodes,
    residual_by_sensor,
)
from armscan.calibration.hand_eye.search import (
    Start,
    few_stripes,
    find_start,
    linear_hand_eye,
    posture_rms,
    thinned,
)
from armscan.calibration.hand_eye.solve import refine, solve_linear, total_covariance
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import EulerConvention, euler_from_rotations, rotations_from_euler
from armscan.geometry.shapes import Plane
from armscan.models.calibration import SHEET_PARAMETER_NAMES
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES

LEAST_ON_A_SIDE = 3
"""Postures before and after a change: fewer are told from wrong ones by nothing."""
LARGEST_SCALE = 0.2
"""Scaled down to nothing, any stripes lie on one point of any plate."""
FACTS_OF_POSTURE = 2
"""What a stripe says of its posture's error: a shift and a slope."""


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Unknowns of something that should be as given, and what they would be.

    Parameters
    ----------
    name
        ``plate`` and ``offset`` (the plate is not where it was probed), ``change`` (plate or Base
        moved between two postures), ``scale`` or ``sheet`` (the sensor is not as calibrated).
    place
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
    place: int
    values: FloatArray
    covariance: FloatArray
    size_mm: float
    probability: float
    likelihood: float
    hand_eye_change: FloatArray
    hand_eye_covariance: FloatArray
    arm_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    name: str
    place: int
    slopes: FloatArray
    n_tried: int = 1


def find_alternatives(
    nodes: PlateNodes, plate: PlateReference, fit: PlateFit, options: HandEyeOptions
) -> tuple[Alternative, ...]:
    """Every kind of alternative at its best, likeliest first.

    Parameters
    ----------
    nodes, plate, options
        Data, reference and noise model of the fit.
    fit
        A refined hand-eye.
    """
    fixed = known_covariance(nodes, fit.refined.placed, plate, options)
    found = []
    for columns in _all_columns(nodes, fit, options):
        one = _weighed(nodes, fit, fixed, columns)
        if one is not None:
            found.append(one)
    return tuple(sorted(found, key=lambda one: -one.likelihood))


def _all_columns(nodes: PlateNodes, fit: PlateFit, options: HandEyeOptions) -> list[_Columns]:
    placed = fit.refined.placed
    along = np.einsum("ni,ni->n", placed.normals_sensor, nodes.points_mm)
    columns = [_Columns("scale", 0, along[:, None])]
    if not options.solve_plate:
        columns.append(_Columns("plate", 0, placed.by_plane))
        columns.append(_Columns("offset", 0, placed.by_plane[:, 2:]))
    by_sensor = residual_by_sensor(nodes, placed)
    first = len(CAMERA_PARAMETER_NAMES)
    for sheet in np.unique(nodes.sheet):
        begin = first + len(SHEET_PARAMETER_NAMES) * int(sheet)
        if by_sensor is not None and begin + 3 <= by_sensor.shape[1]:
            own = (nodes.sheet == sheet)[:, None] * by_sensor[:, begin : begin + 3]
            columns.append(_Columns("sheet", int(sheet), own))
    change = _likeliest_change(nodes, fit)
    return columns if change is None else [*columns, change]


def _likeliest_change(nodes: PlateNodes, fit: PlateFit) -> _Columns | None:
    """The place in the order of postures where a shift of the plate or Base explains most."""
    used = _in_order(nodes)
    places = used[LEAST_ON_A_SIDE : len(used) - LEAST_ON_A_SIDE + 1]
    explained = fit.linear.projected @ fit.refined.placed.residual_mm
    best, best_score = None, 0.0
    for first in places:
        slopes = (nodes.posture >= first)[:, None] * fit.refined.placed.by_plane
        weight = slopes.T @ fit.linear.projected @ slopes
        score = slopes.T @ explained
        statistic = float(score @ np.linalg.pinv(weight, rcond=1e-9, hermitian=True) @ score)
        if statistic > best_score:
            best, best_score = _Columns("change", int(first), slopes, len(places)), statistic
    return best


def _in_order(nodes: PlateNodes) -> IntArray:
    """Postures with nodes; they are numbered in the order of the exposures."""
    return np.sort(nodes.used_postures)


def _weighed(
    nodes: PlateNodes, fit: PlateFit, fixed: FloatArray, columns: _Columns
) -> Alternative | None:
    n_known, n_new = fit.slopes.shape[1], columns.slopes.shape[1]
    freedom = FACTS_OF_POSTURE * len(nodes.used_postures) - n_known - n_new
    scale = np.linalg.norm(columns.slopes, axis=0)
    if freedom < 1 or not (scale > 0.0).all():
        return None
    slopes = np.concatenate([fit.slopes, columns.slopes / scale], axis=1)
    residual = fit.refined.placed.residual_mm
    noise = estimate_noise(residual, slopes, fit.components, fixed, fit.noise.sigmas)
    total = total_covariance(fit.components, noise.sigmas) + fixed
    solution = solve_linear(residual, slopes, total)
    if solution is None:
        return None
    values, spread = solution.step[n_known:], solution.covariance[n_known:, n_known:]
    if np.linalg.cond(spread) > 1e12:
        return None
    statistic = float(values @ np.linalg.solve(spread, values)) / n_new
    probability = float(f_distribution.sf(statistic, n_new, freedom)) * columns.n_tried
    values = values / scale
    if columns.name == "scale" and abs(float(values[0])) > LARGEST_SCALE:
        return None
    moved = columns.slopes @ values
    quadratic = float(residual @ solution.projected @ residual)
    determinant = float(np.linalg.slogdet(total)[1])
    arm = {one.name: float(s) for one, s in zip(fit.components, noise.sigmas, strict=True)}
    return Alternative(
        columns.name,
        columns.place,
        values,
        spread / np.outer(scale, scale),
        float(np.sqrt((moved**2).mean())),
        min(probability, 1.0),
        -0.5 * (quadratic + determinant) - n_new,
        solution.step[:6] - fit.linear.step[:6],
        solution.covariance[:6, :6],
        arm["arm"],
    )


ALIKE = 0.1
"""An offset within this part of the tip's diameter or radius is taken for it."""


@dataclass(frozen=True, slots=True)
class FreePlane:
    """A plane solved along with the hand-eye.

    Parameters
    ----------
    offset_mm
        Its place on the probed plane's normal, where the stripes lie.
    tilt_deg
        Angle between the two planes.
    typical_mm
        Median over postures of their distance from it.
    """

    offset_mm: float
    tilt_deg: float
    typical_mm: float


def find_free_plane(nodes: PlateNodes, plate: Plane) -> FreePlane | None:
    """Solve hand-eye and plane together; None where the postures do not determine both."""
    start = linear_hand_eye(nodes, plate, is_offset_free=True)
    if start is None:
        return None
    state = PlateState(start, np.zeros(3))
    refined = refine(nodes, plate, state, np.eye(len(nodes)), solve_plate=True)
    placed = place_nodes(nodes, plate, refined.state)
    tilts, middle = refined.state.plane, -placed.by_plane.mean(axis=0)
    return FreePlane(
        float(middle @ tilts),
        float(np.degrees(np.arctan(np.hypot(tilts[0], tilts[1])))),
        float(np.nanmedian(posture_rms(nodes, placed.residual_mm))),
    )


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


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction:
    """An alternative that is believed.

    Parameters
    ----------
    kind
        As of `armscan.calibration.hand_eye.alternatives.Alternative`.
    reason, remedy
        In words.
    is_refused
        True if the hand-eye must not be used.
    widening
        (6, 6) to be added to the hand-eye's covariance, so that it holds what it would change by.
    arm_mm
        Scatter of the arm that the alternative leaves.
    """

    kind: str
    reason: str
    remedy: str
    is_refused: bool
    widening: FloatArray
    arm_mm: float

    @property
    def failure(self) -> FitFailure:
        """As a refusal."""
        return FitFailure(self.reason, self.remedy)


def find_contradiction(
    found: Sequence[Alternative], nodes: PlateNodes, plate: PlateReference, fit: PlateFit
) -> Contradiction | None:
    """The likeliest alternative that the stripes ask for; None if all is as given.

    Parameters
    ----------
    found
        What `armscan.calibration.hand_eye.alternatives.find_alternatives` gave.
    nodes, plate, fit
        Data and reference, and the refined hand-eye.
    """
    believed = [one for one in found if one.probability < SUSPICIOUS]
    if not believed:
        return None
    best = believed[0]
    change = best.hand_eye_change
    sigma = np.sqrt(np.minimum(np.diag(fit.covariance)[:6], np.diag(best.hand_eye_covariance)))
    is_refused = (
        best.probability < UNLIKELY
        and best.size_mm > ARM_ACCURACY_MM
        and float(np.abs(change / sigma).max()) > MOST_SIGMAS
    )
    reason, remedy = _in_words(best, nodes, plate, fit)
    return Contradiction(
        best.name, reason, remedy, is_refused, np.outer(change, change), best.arm_mm
    )


def plane_in_words(found: Sequence[Alternative]) -> str:
    """How the stripes alone see the probed plane; empty where they cannot tell."""
    checks = {one.name: one for one in found}
    if "plate" not in checks or "offset" not in checks:
        return ""
    by_offset = checks["offset"]
    shift_mm, sigma_mm = float(by_offset.values[0]), float(np.sqrt(by_offset.covariance[0, 0]))
    probability = min(checks["plate"].probability, by_offset.probability)
    agrees = "contradict it" if probability < SUSPICIOUS else "agree with it"
    return (
        f"the stripes {agrees} (p = {probability:.2g}): by themselves they put it "
        f"{shift_mm:+.3f} ± {sigma_mm:.3f} mm along its normal; a plate that moved by less than "
        f"{3.0 * sigma_mm:.2f} mm after probing may go unnoticed"
    )


def _in_words(
    one: Alternative, nodes: PlateNodes, plate: PlateReference, fit: PlateFit
) -> tuple[str, str]:
    """What is contradicted and by how much, and what to do."""
    chance = f"(probability {one.probability:.1g})"
    if one.name in ("plate", "offset"):
        plane = one.values if one.name == "plate" else np.array([0.0, 0.0, *one.values])
        where = offset_in_words(*_offset_and_tilt(plane, fit), plate)
        return (
            f"probed plane and scan disagree {chance}: the plane solved along lies {where}",
            PROBE_AGAIN,
        )
    if one.name == "change":
        offset_mm, tilt_deg = _offset_and_tilt(one.values, fit)
        first = int(np.flatnonzero(nodes.used_postures == one.place)[0])
        last = nodes.postures[nodes.used_postures[first - 1]]
        return (
            f"the postures up to {last} and those from {nodes.postures[one.place]} on each agree "
            f"among themselves, but not with each other {chance}: between them the plate or the "
            f"arm's base moved by {abs(offset_mm):.3f} mm and tilted by {tilt_deg:.3f} deg",
            FIND_WHAT_MOVED,
        )
    sheet = "" if one.name == "scale" else f" {one.place + 1}"
    what = (
        f"the sensor's points are too {'small' if one.values[0] > 0.0 else 'large'} by "
        f"{100.0 * abs(float(one.values[0])):.3f} %"
        if one.name == "scale"
        else f"light sheet{sheet} lies elsewhere than calibrated"
    )
    return (
        f"the stripes contradict the sensor's calibration {chance}: {what}, which moves them by "
        f"{one.size_mm:.3f} mm",
        "calibrate the sensor again: its camera or its light sheet has changed, or the calibration "
        "is another sensor's",
    )


def _offset_and_tilt(plane: FloatArray, fit: PlateFit) -> tuple[float, float]:
    """Offset (mm) where the stripes lie and tilt (deg) of a plane's two tilts and offset."""
    middle = -fit.refined.placed.by_plane.mean(axis=0)
    return float(middle @ plane), float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))


LIKELIER = 10.0
"""Logarithm of the likelihood ratio from which mirrored data are believed: 22,000 to 1."""
SMALLER = 0.7
"""And they leave less than this part of what the data as given leave."""
LARGEST_SHIFT = 0.1
"""Of the middle of a mirrored image, over the focal length."""
NO_FIT_MM = 1e6
"""What a shift without a hand-eye leaves: finite, for the search fits parabolas."""
BOW_DEGREE = 2
LEAST_OF_SHEET = 12


@dataclass(frozen=True, slots=True, eq=False)
class _Mirrored:
    words: str
    remedy: str
    nodes: PlateNodes
    pose: Pose[Tool, Sensor]


def find_mirror(
    nodes: PlateNodes,
    plate: PlateReference,
    start: Start,
    options: HandEyeOptions,
    smaller: float = SMALLER,
) -> FitFailure | None:
    """Refuse data that are much likelier if something was mirrored; None if nothing was.

    Parameters
    ----------
    nodes, plate, options
        Data, reference and noise model.
    start
        The best hand-eye for the data as they are; its wrong postures take no part.
    smaller
        Part of what the data as given leave that mirrored data must not exceed.
    """
    few = few_stripes(thinned(nodes.select(~start.is_wrong[nodes.posture])))
    given = _likelihood(few, plate, start.tool_from_sensor, options)
    if given is None:
        return None
    best: tuple[float, float, _Mirrored] | None = None
    for mirrored in _all_mirrored(few, plate.plane):
        found = _likelihood(mirrored.nodes, plate, mirrored.pose, options)
        if found is not None and (best is None or found[0] > best[0]):
            best = (*found, mirrored)
    if best is None or best[0] < given[0] + LIKELIER or best[1] > smaller * given[1]:
        return None
    return FitFailure(
        f"mirrored data: the stripes of the typical posture lie {given[1]:.3f} mm from the plate, "
        f"and {best[1]:.3f} mm {best[2].words}",
        best[2].remedy,
    )


def _likelihood(
    nodes: PlateNodes,
    plate: PlateReference,
    pose: Pose[Tool, Sensor],
    options: HandEyeOptions,
) -> tuple[float, float] | None:
    """Logarithm of the likelihood, and the typical distance of the postures in mm."""
    fit = fit_plate(nodes, plate, PlateState(pose, np.zeros(3)), options)
    if not isinstance(fit, PlateFit):
        return None
    typical = float(np.nanmedian(posture_rms(nodes, fit.refined.placed.residual_mm)))
    return fit.linear.log_likelihood, typical


def _all_mirrored(nodes: PlateNodes, plate: Plane) -> Iterator[_Mirrored]:
    for axis, name in enumerate("xyz"):
        mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
        poses = nodes.moved(mirror @ nodes.rotations @ mirror, nodes.translations_mm @ mirror)
        yield _solved(
            f"if the poses were left-handed, {name} pointing the other way (the plate was not)",
            f"give the poses in a right-handed frame: turn the sign of {name} and of the two "
            "rotations that it changes, or read them by the convention of the arm's maker",
            poses,
            plate,
        )
    turned = _reflected(nodes)
    yield _solved(
        "if poses and plate were left-handed (an axis of Base and Tool points the other way), or "
        "the sensor's points",
        "give poses, probed points and the sensor's points in right-handed frames",
        turned,
        plate,
    )
    if float(nodes.points_mm[:, 2].min()) > 0.0:
        for axis, name in ((0, "left and right"), (1, "top and bottom")):
            yield _reversed_image(
                f"if {name} of the images were exchanged",
                "turn off the camera's mirroring (reverse X or Y), and record calibration and "
                "scan with the same setting",
                nodes,
                plate,
                axis,
            )


def _solved(words: str, remedy: str, nodes: PlateNodes, plate: Plane) -> _Mirrored:
    return _Mirrored(words, remedy, nodes, find_start(nodes, plate).tool_from_sensor)


def _reflected(nodes: PlateNodes) -> PlateNodes:
    """The sensor's points in a mirror: what left-handed poses and plate come to."""
    mirror = np.diag([-1.0, 1.0, 1.0])
    return replace(
        nodes,
        points_mm=nodes.points_mm @ mirror,
        noise_mm2=mirror @ nodes.noise_mm2 @ mirror,
        by_sensor=None if nodes.by_sensor is None else mirror @ nodes.by_sensor,
    )


def _reversed_image(
    words: str, remedy: str, nodes: PlateNodes, plate: Plane, axis: int
) -> _Mirrored:
    """What the sheets give along the rays of a reversed image; where its middle is, is sought."""

    def left(shift: float) -> float:
        tried = _along_reversed_rays(nodes, axis, shift)
        pose = linear_hand_eye(tried, plate)
        if pose is None:
            return NO_FIT_MM
        placed = place_nodes(tried, plate, PlateState(pose, np.zeros(3)))
        return float(np.nanmedian(posture_rms(tried, placed.residual_mm)))

    found = minimize_scalar(
        left, bounds=(-LARGEST_SHIFT, LARGEST_SHIFT), method="bounded", options={"xatol": 1e-4}
    )
    return _solved(words, remedy, _along_reversed_rays(nodes, axis, float(found.x)), plate)


def _along_reversed_rays(nodes: PlateNodes, axis: int, shift: float) -> PlateNodes:
    """Points of the same sheets on the rays ``-x/z + shift`` (or y).

    A plane's inverse depth is linear in a ray's x/z and y/z; its bow adds quadratic terms.
    """
    rays = nodes.points_mm[:, :2] / nodes.points_mm[:, 2:]
    turned = rays.copy()
    turned[:, axis] = shift - rays[:, axis]
    points = nodes.points_mm.copy()
    for sheet in np.unique(nodes.sheet):
        own = nodes.sheet == sheet
        degree = BOW_DEGREE if int(own.sum()) >= LEAST_OF_SHEET else 1
        inverse = np.linalg.lstsq(
            _terms(rays[own], degree), 1.0 / nodes.points_mm[own, 2], rcond=1e-9
        )[0]
        depth = 1.0 / np.maximum(_terms(turned[own], degree) @ inverse, 1e-6)
        points[own] = np.column_stack([turned[own], np.ones(int(own.sum()))]) * depth[:, None]
    return replace(nodes, points_mm=points)


def _terms(rays: FloatArray, degree: int) -> FloatArray:
    a, b = rays.T
    return np.column_stack([a**i * b**j for i in range(degree + 1) for j in range(degree + 1 - i)])


BETTER = 0.1
"""A reading is offered if it leaves less than this part of what the given one leaves."""
_ASK_FOR_UNIT = "give the translations of the poses in mm"


@dataclass(frozen=True, slots=True)
class Reading:
    """Another way to read the poses, what it would leave, and how to ask for it."""

    words: str
    remedy: str
    typical_mm: float


def find_reading(
    nodes: PlateNodes, plate: Plane, typical_mm: float, *, most_mm: float = np.inf
) -> Reading | None:
    """First other reading of the same poses that the stripes agree with; None if there is none.

    Parameters
    ----------
    nodes, plate
        The data as read.
    typical_mm
        What they leave as read.
    most_mm
        What the reading may leave at most.
    """
    for words, remedy, moved in _readings(thinned(nodes)):
        left = find_start(moved, plate).typical_mm
        if left < BETTER * typical_mm and left <= most_mm:
            return Reading(words, remedy, left)
    return None


def _readings(nodes: PlateNodes) -> Iterator[tuple[str, str, PlateNodes]]:
    rotations, translations = nodes.rotations, nodes.translations_mm
    names: tuple[EulerConvention, ...] = get_args(EulerConvention)
    for read in names:
        angles = euler_from_rotations(rotations, read)
        for meant in names:
            if meant != read:
                for branch in (angles, _other_branch(angles, read)):
                    yield (
                        f"if the angles were read as {read}, reading them as {meant}",
                        f"give the rotation convention {meant}: of a recording in session.toml, "
                        f'[pose] rotation = "{meant}"; of robot poses with --euler',
                        nodes.moved(rotations_from_euler(branch, meant), translations),
                    )
    back = rotations.transpose(0, 2, 1)
    yield (
        "taking the poses as tool_from_base",
        "give base_from_tool: the inverse of the poses given",
        nodes.moved(back, -np.einsum("sij,sj->si", back, translations)),
    )
    yield (
        "transposing the rotations",
        "give the rotations row by row, the tool's axes in the columns",
        nodes.moved(back, translations),
    )
    for factor, unit in ((1000.0, "metres"), (25.4, "inches")):
        yield (
            f"reading the translations in {unit}",
            _ASK_FOR_UNIT,
            nodes.moved(rotations, factor * translations),
        )
    for shift in (-1, 1):
        yield (
            "giving each exposure the pose of the one "
            + ("after" if shift < 0 else "before")
            + " it",
            "check that no exposure and no pose is missing or doubled",
            nodes.moved(np.roll(rotations, shift, axis=0), np.roll(translations, shift, axis=0)),
        )


def _other_branch(angles_rad: FloatArray, convention: EulerConvention) -> FloatArray:
    """The other three angles (N, 3) of the same rotations."""
    first, middle, last = angles_rad.T
    turned = -middle if convention == "intrinsic-zxz" else np.pi - middle
    return np.column_stack([first + np.pi, turned, last + np.pi])
