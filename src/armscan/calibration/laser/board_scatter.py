# SPDX-License-Identifier: Apache-2.0
"""By how much boards err more than their targets' points say, judged by the stripes on them.

A board that is bent, or a lens that the camera's model does not follow, moves a board's stripe as a
whole: more than the covariance of its pose allows, and differently on every board. A bow of the
sheet moves them all by one law, and curves them. The likelihood of both readings tells them apart;
against the noise along the stripes alone, either would look certain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.lack_of_fit import StripeNoise
from armscan.calibration.laser.observations import SheetObservations
from armscan.calibration.laser.solve import CommonErrors, SheetSolution, square_root
from armscan.geometry.arrays import FloatArray

SHAPES = 3
"""Offset, slope and curvature of a stripe; a board's pose makes the first two."""
LEAST_POINTS = 8
"""With fewer points left of it a stripe has no shape."""
FACTORS = np.geomspace(1.0, 100.0, 81)


@dataclass(frozen=True, slots=True)
class BoardScatter:
    """Likeliest scatter of the boards under a model of the sheet.

    Parameters
    ----------
    factor
        Standard deviations of the boards' poses over what is claimed for them, at least 1.
    log_likelihood
        Of the stripes' shapes at this factor, up to a constant that all models share.
    """

    factor: float
    log_likelihood: float


def board_scatter(
    observations: SheetObservations,
    solution: SheetSolution,
    errors: CommonErrors,
    noise: StripeNoise,
) -> BoardScatter:
    """Estimate by restricted likelihood how much the boards of one sheet scatter.

    Parameters
    ----------
    observations
        Points of one sheet.
    solution
        A model fitted to them, with the cameras free.
    errors
        Claimed covariance of boards and cameras.
    noise
        Of the points along the stripes.
    """
    _, residual, _, by_point = observations.residuals_px(solution.sheets)
    by_pose = np.einsum("ni,nij->nj", by_point, observations.by_pose)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.by_camera)
    moved = solution.common[len(solution.common) - errors.n_camera :]
    residual = residual + by_camera @ (square_root(errors.camera_covariance) @ moved)
    numbers, counts = np.unique(observations.stripe, return_counts=True)
    stripes = numbers[counts >= LEAST_POINTS]
    n = SHAPES * len(stripes)
    lost = np.sqrt(n / max(n - solution.n_parameters, 1.0))
    log_likelihood = np.zeros(len(FACTORS))
    for stripe in stripes:
        own = observations.stripe == stripe
        shape, covariance = _shape(observations.select(own), lost * residual[own], noise)
        root = square_root(errors.pose_covariances[int(observations.board[own][0])])
        follow = shape.gain @ by_pose[own] @ root
        log_likelihood += _log_likelihood(shape.terms, covariance, follow)
    best = int(np.argmax(log_likelihood))
    return BoardScatter(float(FACTORS[best]), float(log_likelihood[best]))


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    """(3,) shape terms of a stripe's residuals, and (3, N) how they follow these."""

    terms: FloatArray
    gain: FloatArray


def _shape(
    stripe: SheetObservations, residual_px: FloatArray, noise: StripeNoise
) -> tuple[_Shape, FloatArray]:
    along = (stripe.points_mm - stripe.points_mm[0]) @ (stripe.points_mm[-1] - stripe.points_mm[0])
    t = 2.0 * (along - along.min()) / max(float(np.ptp(along)), 1e-12) - 1.0
    design = np.polynomial.legendre.legvander(t, SHAPES - 1)
    weighted = design / (stripe.sigma_px * noise.sigma_factor)[:, None] ** 2
    covariance = np.asarray(np.linalg.inv(weighted.T @ design), dtype=np.float64)
    gain = covariance @ weighted.T
    return _Shape(gain @ residual_px, gain), covariance


def _log_likelihood(terms: FloatArray, noise: FloatArray, follow: FloatArray) -> FloatArray:
    """Of one stripe's shape for every factor of the boards' scatter."""
    total = noise + FACTORS[:, None, None] ** 2 * (follow @ follow.T)
    _, log_determinant = np.linalg.slogdet(total)
    solved = np.linalg.solve(total, np.broadcast_to(terms[:, None], (len(FACTORS), len(terms), 1)))
    return np.asarray(-0.5 * (log_determinant + solved[:, :, 0] @ terms))
