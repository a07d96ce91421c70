# SPDX-License-Identifier: Apache-2.0
"""What else could explain the stripes? Something that moved, or a sensor that is not as calibrated.

Scatter that is estimated from the residuals takes up whatever they hold: a plate that was moved
between two postures looks like an arm of so much scatter. So each alternative gets unknowns of its
own, the scatter is estimated anew beside them, and the unknowns are judged by that. What is known
of them (the probed plane, the sensor's covariance) stays in the covariance of the residuals, so
that an unknown which the prior explains is no alternative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from armscan.calibration.hand_eye.least_squares import solve_linear
from armscan.calibration.hand_eye.noise_model import total_covariance
from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, known_covariance
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import residual_by_sensor
from armscan.calibration.hand_eye.variance_components import estimate_noise
from armscan.geometry.arrays import FloatArray, IntArray
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
