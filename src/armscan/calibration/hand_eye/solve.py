# SPDX-License-Identifier: Apache-2.0
"""Damped least squares for the hand-eye, its covariance model (noise of the points, poses,
sheets and plate), and how well the postures determine each direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from armscan.calibration.hand_eye.observations import (
    N_PLANE,
    HandEyeOptions,
    PlacedNodes,
    PlateNodes,
    PlateState,
    place_nodes,
)
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane
from armscan.models.calibration import SHEET_PARAMETER_NAMES, ArmNoise
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES

MAX_STEPS = 50
SETTLED = 1e-9
"""A step that lowers the objective by less than this part of it ends the search."""
LEVER_MM = 100.0
"""Turns are compared with shifts by what they move at this distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A minimum of the whitened objective.

    Parameters
    ----------
    state
        Hand-eye and plane.
    placed
        The nodes placed with it.
    chi2
        The objective: sum of squared whitened residuals.
    is_settled
        False if the steps ran out.
    """

    state: PlateState
    placed: PlacedNodes
    chi2: float
    is_settled: bool


def design(placed: PlacedNodes, solve_plate: bool) -> FloatArray:
    """(N, 6) derivative of the residuals by the hand-eye, or (N, 9) with the plane's."""
    if solve_plate:
        return np.concatenate([placed.by_hand_eye, placed.by_plane], axis=1)
    return placed.by_hand_eye


def refine(
    nodes: PlateNodes,
    plate: Plane,
    start: PlateState,
    covariance: FloatArray,
    *,
    solve_plate: bool = False,
) -> Refined:
    """Minimise ``e' C^-1 e`` over the hand-eye, and over the plane where it is free.

    Parameters
    ----------
    nodes, plate
        Data and the probed plane.
    start
        Where to begin.
    covariance
        (N, N) positive definite covariance of the residuals e, eq. 2.74.
    solve_plate
        Solve the plane along.
    """
    root = np.linalg.cholesky(covariance)
    state, damping = start, 0.0
    placed = place_nodes(nodes, plate, state)
    whitened = solve_triangular(root, placed.residual_mm, lower=True)
    chi2 = float(whitened @ whitened)
    for _ in range(MAX_STEPS):
        slope = solve_triangular(root, design(placed, solve_plate), lower=True)
        step = _damped_step(slope, whitened, damping)
        trial = state.stepped(step)
        moved = place_nodes(nodes, plate, trial)
        residual = solve_triangular(root, moved.residual_mm, lower=True)
        trial_chi2 = float(residual @ residual)
        if not trial_chi2 <= chi2:
            if chi2 - trial_chi2 >= -SETTLED * chi2:
                return Refined(state, placed, chi2, True)
            damping = max(10.0 * damping, 1e-6)
            continue
        gain = chi2 - trial_chi2
        state, placed, whitened, chi2 = trial, moved, residual, trial_chi2
        damping *= 0.1
        if gain <= SETTLED * chi2 + 1e-18:
            return Refined(state, placed, chi2, True)
    return Refined(state, placed, chi2, False)


def _damped_step(slope: FloatArray, whitened: FloatArray, damping: float) -> FloatArray:
    scale = np.linalg.norm(slope, axis=0)
    scale[scale == 0.0] = 1.0
    stacked = np.vstack([slope / scale, np.sqrt(damping) * np.eye(slope.shape[1])])
    target = np.concatenate([-whitened, np.zeros(slope.shape[1])])
    step, *_ = np.linalg.lstsq(stacked, target, rcond=1e-12)
    return np.asarray(step / scale)


@dataclass(frozen=True, slots=True, eq=False)
class LinearSolution:
    """Generalised least squares of ``e + A x = 0`` at a fixed linearisation.

    Parameters
    ----------
    step
        (K,) solution x.
    covariance
        (K, K) of x.
    inverse
        (N, N) inverse of the residuals' covariance.
    projected
        (N, N) ``P = C^-1 - C^-1 A cov A' C^-1``: zero along the columns of A.
    gain
        (K, N) ``G`` with ``x = -G e``.
    log_likelihood
        Restricted log-likelihood of the residuals, without constants.
    """

    step: FloatArray
    covariance: FloatArray
    inverse: FloatArray
    projected: FloatArray
    gain: FloatArray
    log_likelihood: float


def solve_linear(
    residual: FloatArray, slopes: FloatArray, covariance: FloatArray
) -> LinearSolution | None:
    """Solve ``residual + slopes x = 0`` (N,), (N, K) under (N, N) covariance.

    Returns None where the covariance or the normal matrix is not positive definite.
    """
    try:
        factor = cho_factor(covariance, lower=True)
        inverse = cho_solve(factor, np.eye(len(covariance)))
        carried = inverse @ slopes
        normal = slopes.T @ carried
        normal_factor = cho_factor(0.5 * (normal + normal.T), lower=True)
    except LinAlgError:
        return None
    spread = cho_solve(normal_factor, np.eye(slopes.shape[1]))
    gain = spread @ carried.T
    projected = inverse - carried @ gain
    determinants = np.log(np.diag(factor[0])).sum() + np.log(np.diag(normal_factor[0])).sum()
    quadratic = float(residual @ projected @ residual)
    return LinearSolution(
        -gain @ residual,
        0.5 * (spread + spread.T),
        inverse,
        0.5 * (projected + projected.T),
        gain,
        -0.5 * quadratic - float(determinants),
    )


RANK_RATIO = 1e-4
"""Singular values below this part of the largest are taken as zero: a posture that was meant to
repeat another still turns by a hundredth of a degree."""
MAX_CONDITION = 100.0
GOOD_POSTURES = 6
LEAST_POSTURES = 3
NAMED_SHARE = 0.3
"""Parts of the weakest combination above this are named."""
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class Conditioning:
    """How well six parameters are determined.

    Parameters
    ----------
    singular_values
        (6,) of the whitened system, largest first, in 1/mm: turns are scaled by what they move at
        100 mm (`LEVER_MM`).
    rank, condition
        Of that system; the condition is infinite below rank 6.
    weakest
        The combination of parameters that is known least, in words.
    """

    singular_values: FloatArray
    rank: int
    condition: float
    weakest: str


def describe_conditioning(information: FloatArray) -> Conditioning:
    """Rank and condition from the (6, 6) inverse covariance of the hand-eye.

    Parameters
    ----------
    information
        ``A' C^-1 A`` in the order of `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`, other
        unknowns eliminated.
    """
    scale = np.array([1.0 / LEVER_MM] * 3 + [1.0] * 3)
    scaled = information * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    rank = int((singular > RANK_RATIO * singular[0]).sum()) if singular[0] > 0.0 else 0
    condition = float(singular[0] / singular[5]) if rank == 6 else float("inf")
    sigma_mm = 1.0 / float(singular[5]) if rank == 6 else float("inf")
    return Conditioning(singular, rank, condition, _in_words(vectors[:, 0], sigma_mm))


def _in_words(direction: FloatArray, sigma_mm: float) -> str:
    names = [f"turning about tool {axis}" for axis in _AXES]
    names += [f"shifting along tool {axis}" for axis in _AXES]
    order = [k for k in np.argsort(-np.abs(direction)) if abs(direction[k]) >= NAMED_SHARE]
    parts = [f"{names[k]} ({abs(direction[k]):.2f})" for k in order]
    known = "not determined" if not np.isfinite(sigma_mm) else f"known to {sigma_mm:.3g} mm"
    return f"{' with '.join(parts)}: {known}, turns counted at {LEVER_MM:.0f} mm"


def refuse_open_hand_eye(conditioning: Conditioning, cause: str, remedy: str) -> FitFailure | None:
    """Refuse a system of rank below six; ``cause`` says what the postures have in common."""
    if conditioning.rank == 6:
        return None
    return FitFailure(
        f"the postures determine only {conditioning.rank} of the hand-eye's 6 parameters{cause} "
        f"(least known: {conditioning.weakest})",
        remedy,
    )


def refuse_few_postures(n_postures: int) -> FitFailure | None:
    """Refuse fewer postures than any solution needs."""
    if n_postures >= LEAST_POSTURES:
        return None
    return FitFailure(
        f"{n_postures} postures with a usable stripe; {LEAST_POSTURES} are the least for any "
        f"solution, {GOOD_POSTURES} for a checked one",
        "scan from 12 postures: tilts of 30 to 45 degrees in two or more directions, stand-off "
        "varied by 15 %",
    )


def conditioning_warnings(
    conditioning: Conditioning, n_postures: int, cause: str
) -> tuple[str, ...]:
    """What is weak about the postures of a solved hand-eye."""
    warnings = []
    if n_postures < GOOD_POSTURES:
        warnings.append(
            f"{n_postures} postures only: a wrong one would not be noticed, and the hand-eye is "
            f"several times less certain than from 12; use at least {GOOD_POSTURES}, better 12"
        )
    if conditioning.condition > MAX_CONDITION:
        warnings.append(
            f"the hand-eye is badly determined (condition {conditioning.condition:.0f}, good is "
            f"below {MAX_CONDITION:.0f}){cause}; least known: {conditioning.weakest}"
        )
    elif cause:
        warnings.append(
            f"the postures are less varied than they should be{cause}; least known: "
            f"{conditioning.weakest}"
        )
    return tuple(warnings)


ROTATION_LEVER_MM = 265.0
"""Scatter of the scan point over scatter of the orientation: 0.0053 mm and 0.00115 degrees for an
arm of 0.02 mm repeatability. Stands in where the orientation's scatter is not given: on stripes
of some tens of mm it hardly shows."""
TYPICAL_ARM_MM = 0.006
TYPICAL_EXPOSURE_MM = 0.001
TYPICAL_FLATNESS_MM = 0.003
TYPICAL_SHEET_SHAPE_MM = 0.001
"""What plane and bow leave of the sheets of simulated heads, root mean square."""
SHEET_SHAPE_LENGTH_MM = 15.0
"""Half a calibrated region and less: what is longer, plane and bow take up."""
WIDE = 1.0
"""Standard deviation of the logarithm of a scatter about its typical value: a factor of 2.7."""
LEAST_STRIPE_MM = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class NoiseComponent:
    """One cause of scatter.

    Parameters
    ----------
    name
        ``arm``, ``arm rotation``, ``exposure``, ``exposure rotation``, ``flatness``,
        ``sheet shape`` or ``stripe``.
    covariance
        (N, N) of the residuals when ``sigma`` is 1.
    sigma
        Given, or typical where it is to be estimated.
    is_estimated
        True if the data decide.
    log_width
        Standard deviation of the logarithm of ``sigma`` before the data were seen.
    """

    name: str
    covariance: FloatArray
    sigma: float
    is_estimated: bool = False
    log_width: float = WIDE


def noise_components(
    nodes: PlateNodes, placed: PlacedNodes, plate: Plane, options: HandEyeOptions
) -> tuple[NoiseComponent, ...]:
    """Build the causes of scatter at the given placing.

    Parameters
    ----------
    nodes, placed, plate
        Nodes, where they lie, and the plate whose axes the flatness is a function of.
    options
        Standard deviations given, or None for those to be estimated.
    """
    lever = np.cross(placed.points_base_mm - placed.scan_points_base_mm, plate.normal)
    turned = lever @ lever.T
    same_posture = _same(nodes.posture)
    components = _pose_components(
        "arm",
        (same_posture, same_posture * turned),
        (options.arm_position_mm, options.arm_rotation_rad),
        TYPICAL_ARM_MM,
    )
    if has_exposure_part(nodes, options):
        same_stripe = _same(nodes.stripe)
        components += _pose_components(
            "exposure",
            (same_stripe, same_stripe * turned),
            (options.exposure_position_mm, options.exposure_rotation_rad),
            TYPICAL_EXPOSURE_MM,
        )
    on_plate = (placed.points_base_mm - plate.point_mm) @ plate.axes[:2].T
    alike = _alike(on_plate, options.flatness_length_mm)
    own = np.diag(stripe_variance_mm2(nodes, placed))
    return (
        *components,
        _component("flatness", alike, options.plate_flatness_mm, TYPICAL_FLATNESS_MM),
        *_sheet_shape(nodes, placed, options),
        _component("stripe", own, options.stripe_noise_factor, 1.0),
    )


def has_exposure_part(nodes: PlateNodes, options: HandEyeOptions) -> bool:
    """True if a part that is new in every exposure was given, or can be told from the posture's."""
    if options.exposure_position_mm is not None or options.exposure_rotation_rad is not None:
        return True
    is_repeated = len(np.unique(nodes.stripe)) > len(nodes.used_postures)
    return is_repeated and options.arm_position_mm is None


def stripe_variance_mm2(nodes: PlateNodes, placed: PlacedNodes) -> FloatArray:
    """(N,) variance of the residuals by the stripe's own noise: its part along the normal."""
    normals = placed.normals_sensor
    variance = np.einsum("ni,nij,nj->n", normals, nodes.noise_mm2, normals)
    return np.asarray(np.maximum(variance, LEAST_STRIPE_MM**2))


def _sheet_shape(
    nodes: PlateNodes, placed: PlacedNodes, options: HandEyeOptions
) -> tuple[NoiseComponent, ...]:
    """The sheets' own shape beyond their parameters; nothing where points came without a sheet.

    It moves a point as an offset of its sheet would that is a smooth function of the place on the
    sheet. Two stripes of one exposure share arm and plate: without this part, whatever their
    sheets' shapes set between them would count as a scatter of arm or plate.
    """
    offset = len(CAMERA_PARAMETER_NAMES) + SHEET_PARAMETER_NAMES.index("offset_mm")
    column = offset + len(SHEET_PARAMETER_NAMES) * nodes.sheet
    if nodes.by_sensor is None or not len(nodes) or column.max() >= nodes.by_sensor.shape[2]:
        return ()
    by_offset = nodes.by_sensor[np.arange(len(nodes)), :, column]
    moved = np.einsum("ni,ni->n", placed.normals_sensor, by_offset)
    alike = _same(nodes.sheet) * _alike(nodes.points_mm, SHEET_SHAPE_LENGTH_MM)
    covariance = alike * moved[:, None] * moved[None, :]
    return (_component("sheet shape", covariance, options.sheet_shape_mm, TYPICAL_SHEET_SHAPE_MM),)


def _same(labels: IntArray) -> FloatArray:
    return np.asarray(labels[:, None] == labels[None, :], dtype=np.float64)


def _alike(places_mm: FloatArray, length_mm: float) -> FloatArray:
    """Correlation (N, N) of a smooth error at (N, 2) or (N, 3) places: Matern's of order 5/2.

    Near zero it bends like ``exp(-d^2 / (2 length^2))``. A Gaussian supposes more smoothness than
    any plate or sheet has and, given too long a length, takes whatever else is smooth for exactly
    known.
    """
    apart = np.linalg.norm(places_mm[:, None] - places_mm[None, :], axis=2)
    scaled = apart * (np.sqrt(3.0) / length_mm)
    return np.asarray((1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled))


def _component(
    name: str, covariance: FloatArray, given: float | None, typical: float
) -> NoiseComponent:
    return NoiseComponent(name, covariance, typical if given is None else given, given is None)


def _pose_components(
    name: str,
    covariances: tuple[FloatArray, FloatArray],
    given: tuple[float | None, float | None],
    typical_mm: float,
) -> tuple[NoiseComponent, ...]:
    """Shift and turn of one pose; the turn follows the shift unless it is given."""
    position, rotation = given
    if rotation is None:
        tied = covariances[0] + covariances[1] / ROTATION_LEVER_MM**2
        return (_component(name, tied, position, typical_mm),)
    return (
        _component(name, covariances[0], position, typical_mm),
        NoiseComponent(f"{name} rotation", covariances[1], rotation),
    )


def plane_covariance(placed: PlacedNodes, prior: FloatArray) -> FloatArray:
    """(N, N) covariance of the residuals by the uncertainty (3, 3) of the probed plane."""
    return np.asarray(placed.by_plane @ prior.reshape(N_PLANE, N_PLANE) @ placed.by_plane.T)


def total_covariance(components: tuple[NoiseComponent, ...], sigmas: FloatArray) -> FloatArray:
    """Sum of all causes of scatter with the given standard deviations."""
    total = np.zeros_like(components[0].covariance)
    for component, sigma in zip(components, sigmas, strict=True):
        total += sigma**2 * component.covariance
    return total


def arm_noise(components: tuple[NoiseComponent, ...], sigmas: FloatArray) -> ArmNoise:
    """What the standard deviations say about the arm."""
    by_name = {
        component.name: float(sigma) for component, sigma in zip(components, sigmas, strict=True)
    }
    values = []
    for name in ("arm", "exposure"):
        position = by_name.get(name, 0.0)
        values += [position, by_name.get(f"{name} rotation", position / ROTATION_LEVER_MM)]
    return ArmNoise(*values)
