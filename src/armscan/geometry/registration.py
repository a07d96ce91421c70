# SPDX-License-Identifier: Apache-2.0
"""The rigid motion between two lists of the same points, weighted by both lists' covariances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.special import chdtri

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, RowRecord, floats
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Frame, Pose

A = TypeVar("A", bound=Frame)
B = TypeVar("B", bound=Frame)

REGISTRATION_PARAMETERS = (
    "rotation_x_rad",
    "rotation_y_rad",
    "rotation_z_rad",
    "translation_x_mm",
    "translation_y_mm",
    "translation_z_mm",
)
"""Order of the parameters: a rotation-vector increment multiplied from the left, in the frame that
the pose leads to, and the translation."""

MAX_ROUNDS = 30
SETTLED = 1e-12
NOTED_MOVE = 1e-4
"""Square of a last step, in sigmas, from which on a fit counts as not settled."""
LEAST_SPREAD_SIGMAS, LEAST_SIGMA_MM = 10.0, 1e-10
"""Points whose second extent is within this many standard deviations lie on a line: the turn about
it would be uncertain by more than a tenth of a radian. And the smallest of these that counts."""


class PointPairs(RowRecord):
    """The same N points in two frames, A and B, each with its covariance.

    Parameters
    ----------
    points_a_mm, points_b_mm
        (N, 3).
    covariance_a_mm2, covariance_b_mm2
        (N, 3, 3), independent between points and lists; their sum is positive definite.
    """

    points_a_mm: FloatArray = floats("N", 3)
    points_b_mm: FloatArray = floats("N", 3)
    covariance_a_mm2: FloatArray = floats("N", 3, 3)
    covariance_b_mm2: FloatArray = floats("N", 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class PointMisfit(Generic[A]):
    """How far each point of one list is from where all the others put it, in A.

    ``offset_mm`` (N, 3) is the point in A minus that of B carried there by the motion that the
    OTHERS determine, NaN where these determine none; ``chi2`` (N,) its square in units of its
    covariance, of three degrees if the point did not move.
    """

    offset_mm: FloatArray
    chi2: FloatArray

    def moved(self, level: float) -> int | None:
        """Index of the worst point, if the chance of so large a misfit is below ``level``.

        ``level`` is for all points together (Bonferroni); None if every point fits.
        """
        known = np.flatnonzero(np.isfinite(self.chi2))
        if not len(known):
            return None
        worst = int(known[np.argmax(self.chi2[known])])
        limit = float(chdtri(3, level / len(known)))
        return worst if float(self.chi2[worst]) > limit else None


def closed_form_pose(
    points_a_mm: FloatArray, points_b_mm: FloatArray, weights: FloatArray | None = None
) -> Pose[A, B]:
    """``a_from_b`` of least weighted squares over (N, 3) points, in closed form.

    Eqs. 2.47-2.51 with 2.50 corrected: of H = U S V' the rotation is V diag(1, 1, det(V U')) U';
    the thesis prints it without the determinant, which gives a mirror image for points in a plane.
    """
    w = np.ones(len(points_a_mm)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    middle_a, middle_b = w @ points_a_mm, w @ points_b_mm
    h = (points_b_mm - middle_b).T @ ((points_a_mm - middle_a) * w[:, None])
    u, _, vt = np.linalg.svd(h)
    rotation = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return Pose(rotation, middle_a - rotation @ middle_b)


def register_points(pairs: PointPairs) -> Estimate[Pose[A, B]] | FitFailure:
    """Estimate ``a_from_b`` by generalised least squares over both lists' covariances.

    Gauss-Newton from the closed form; the weight of a pair is the inverse of
    ``C_a + R C_b R'`` at the rotation found.

    Covariance of `REGISTRATION_PARAMETERS`, by the covariances given; residuals (N, 3) in mm, point
    in A minus carried point of B, in A. There is none of fewer than three points, or points on a
    line.

    Raises
    ------
    InputError
        If the two covariances of a point add up to none that is positive definite.
    """
    failure = _degenerate(pairs)
    if failure is not None:
        return failure
    trace = np.trace(pairs.covariance_a_mm2 + pairs.covariance_b_mm2, axis1=1, axis2=2)
    if float(trace.min()) <= 0.0:
        raise _no_covariance()
    pose: Pose[A, B] = closed_form_pose(pairs.points_a_mm, pairs.points_b_mm, 1.0 / trace)
    for _ in range(MAX_ROUNDS):
        residuals, jacobian, weights = _linearised(pairs, pose)
        weighted = np.einsum("nji,njk->nik", jacobian, weights)
        normal = np.einsum("nij,njk->ik", weighted, jacobian)
        step = np.linalg.solve(normal, np.einsum("nij,nj->i", weighted, residuals))
        pose = pose.retract(step)
        moved = float(step @ normal @ step)
        if moved < SETTLED:
            break
    if not moved < NOTED_MOVE:
        return FitFailure(
            f"the registration did not settle in {MAX_ROUNDS} steps",
            "check that these are the same points, in the same order",
        )
    residuals, jacobian, weights = _linearised(pairs, pose)
    normal = np.einsum("nji,njk,nkl->il", jacobian, weights, jacobian)
    squares = float(np.einsum("ni,nij,nj->", residuals, weights, residuals))
    return Estimate(
        value=pose,
        parameter_names=REGISTRATION_PARAMETERS,
        covariance=np.linalg.inv(normal),
        residuals=residuals,
        degrees_of_freedom=3 * len(pairs) - 6,
        chi2=squares,
    )


def misfits(pairs: PointPairs, fit: Estimate[Pose[A, B]]) -> PointMisfit[A]:
    """Each point's offset from where the others put it (deleted residuals, Baarda's test)."""
    residuals, jacobian, weights = _linearised(pairs, fit.value)
    covariance = np.linalg.inv(weights)
    own = covariance - jacobian @ fit.covariance @ np.swapaxes(jacobian, 1, 2)
    n = len(pairs)
    offset, square = np.full((n, 3), np.nan), np.full(n, np.nan)
    for k in range(n):
        redundancy = own[k] @ weights[k]
        if float(np.linalg.eigvals(redundancy).real.min()) > 1e-6:
            offset[k] = np.linalg.solve(redundancy, residuals[k])
            square[k] = residuals[k] @ np.linalg.solve(own[k], residuals[k])
    return PointMisfit(offset, square)


def carried_covariance_mm2(
    points_b_mm: FloatArray,
    covariance_b_mm2: FloatArray,
    a_from_b: Pose[A, B],
    covariance: FloatArray,
) -> FloatArray:
    """(N, 3, 3) covariance in A of (N, 3) points of B: their own, turned, plus the registration's.

    ``covariance`` is (6, 6) in the order of `REGISTRATION_PARAMETERS`.
    """
    jacobian = a_from_b.jacobian(points_b_mm)
    own = a_from_b.rotate_covariance(covariance_b_mm2)
    return np.asarray(own + jacobian @ covariance @ np.swapaxes(jacobian, 1, 2))


def spread_mm(points_mm: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """(3,) root mean square extents of (N, 3) points about their middle, largest first.

    ``weights`` (N,) of the points; None for equal ones.
    """
    if len(points_mm) == 0:
        return np.zeros(3)
    w = np.ones(len(points_mm)) if weights is None else weights
    w = w / w.sum()
    centred = points_mm - w @ points_mm
    values = np.linalg.eigvalsh(centred.T @ (centred * w[:, None]))[::-1]
    return np.asarray(np.sqrt(np.maximum(values, 0.0)))


def _degenerate(pairs: PointPairs) -> FitFailure | None:
    if len(pairs) < 3:
        return FitFailure(
            f"a rigid motion needs three points in both lists, got {len(pairs)}",
            "measure more common points",
        )
    variance = np.linalg.eigvalsh(pairs.covariance_a_mm2 + pairs.covariance_b_mm2)[:, 2]
    # by weights: one rough point among good ones takes nothing from what these hold
    weights = 1.0 / np.maximum(variance, LEAST_SIGMA_MM**2)
    across = min(spread_mm(one, weights)[1] for one in (pairs.points_a_mm, pairs.points_b_mm))
    if across <= LEAST_SPREAD_SIGMAS / float(np.sqrt(weights.mean())):
        return FitFailure(
            f"the {len(pairs)} common points lie on a line, within {across:.3g} mm: the turn about "
            "it is not determined",
            "measure points that spread in two directions",
        )
    return None


def _linearised(pairs: PointPairs, pose: Pose[A, B]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (N, 3), derivative of the carried point (N, 3, 6), weights (N, 3, 3)."""
    residuals = pairs.points_a_mm - pose.apply(pairs.points_b_mm)
    total = pairs.covariance_a_mm2 + pose.rotate_covariance(pairs.covariance_b_mm2)
    if float(np.linalg.eigvalsh(total).min()) <= 0.0:
        raise _no_covariance()
    return residuals, pose.jacobian(pairs.points_b_mm), np.asarray(np.linalg.inv(total))


def _no_covariance() -> InputError:
    return InputError(
        "a point's covariances are not positive definite",
        remedy="give each point the covariance of its measurement",
    )
