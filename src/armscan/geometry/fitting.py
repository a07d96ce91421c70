# SPDX-License-Identifier: Apache-2.0
"""Lines and planes by total least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.estimate import Estimate, FitFailure

PLANE_PARAMETERS = ("tilt_1_rad", "tilt_2_rad", "offset_mm")


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A straight line in D dimensions, in the unit of its data: point and unit direction, (D,)."""

    point: FloatArray
    direction: FloatArray

    def along(self, points: FloatArray) -> FloatArray:
        """(N,) coordinate along the line, from its point, of (N, D) points."""
        return np.asarray((points - self.point) @ self.direction)

    def at(self, along: FloatArray) -> FloatArray:
        """(N, D) points of the line at (N,) coordinates along it."""
        return self.point + np.asarray(along)[:, None] * self.direction

    def distance(self, points: FloatArray) -> FloatArray:
        """(N,) distance of (N, D) points; signed in the plane (D = 2), left of the line is > 0."""
        offset = points - self.point
        if offset.shape[1] == 2:
            return np.asarray(self.direction[0] * offset[:, 1] - self.direction[1] * offset[:, 0])
        across = offset - (offset @ self.direction)[:, None] * self.direction
        return np.asarray(np.linalg.norm(across, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A plane through ``point_mm`` (3,) with rows of ``axes`` (3, 3) along, across and normal.

    The first axis is the direction of the widest spread of the points it was fitted to.
    """

    point_mm: FloatArray
    axes: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "point_mm", frozen_floats(self.point_mm, (3,), "point_mm"))
        object.__setattr__(self, "axes", frozen_floats(self.axes, (3, 3), "axes"))

    @property
    def normal(self) -> FloatArray:
        """(3,) unit normal."""
        return np.asarray(self.axes[2])

    @property
    def coefficients(self) -> FloatArray:
        """(4,) ``a b c D`` of eq. 2.19, unit normal and D in mm."""
        return np.array([*self.axes[2], -float(self.axes[2] @ self.point_mm)])

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) signed distance of (N, 3) points along the normal."""
        return np.asarray((points_mm - self.point_mm) @ self.axes[2])


def fit_line(points: FloatArray, weights: FloatArray | None = None) -> Line | FitFailure:
    """Fit a line to (N, D) points: least sum of squared distances.

    Parameters
    ----------
    points
        (N, D) points.
    weights
        (N,) one over variance, or None for equal ones.
    """
    points = np.asarray(points, dtype=np.float64)
    w = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)
    if int((w > 0.0).sum()) < 2:
        return FitFailure("a line needs two points", "give more points")
    centre = w @ points / w.sum()
    _, spread, axes = np.linalg.svd((points - centre) * np.sqrt(w)[:, None], full_matrices=False)
    if spread[0] == 0.0:
        return FitFailure("all points of the line coincide", "give points apart from each other")
    return Line(centre, axes[0])


def plane_from_coefficients(
    coefficients: FloatArray, near_mm: FloatArray, source: str = ""
) -> Plane:
    """The plane ``A x + B y + C z + D = 0`` (eq. 2.55), its point next to ``near_mm`` (3,).

    Parameters
    ----------
    coefficients
        (4,) A, B, C, D in mm; they may share any factor, whose sign turns the normal.
    near_mm
        Some point; the plane's own is the foot of its perpendicular.
    source
        Where they came from, for messages.

    Raises
    ------
    InputError
        If these are not four finite numbers or the normal is zero.
    """
    values = np.asarray(coefficients, dtype=np.float64)
    length = float(np.linalg.norm(values[:3])) if values.shape == (4,) else 0.0
    if not np.isfinite(values).all() or not length > 0.0:
        raise InputError(
            "a plane needs four finite numbers A, B, C, D and a normal that is not 0",
            where=source,
            remedy="give A,B,C,D with D in mm",
        )
    normal, offset = values[:3] / length, float(values[3]) / length
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    foot = near_mm - (float(normal @ near_mm) + offset) * normal
    return Plane(foot, np.stack([across, np.cross(normal, across), normal]))


def fit_plane(
    points_mm: FloatArray, *, prior_sigma_mm: float = 0.0, prior_freedom: float = 0.0
) -> Estimate[Plane] | FitFailure:
    """Fit a plane to (N, 3) points: least sum of squared distances along the normal.

    Parameters
    ----------
    points_mm
        (N, 3) points.
    prior_sigma_mm, prior_freedom
        What is known of a point's noise beforehand, and how many degrees of freedom that is worth:
        the noise's variance is (prior_freedom prior_sigma_mm^2 + squared residuals) /
        (prior_freedom + N - 3). That is the expected variance if it was drawn from the scaled
        inverse chi-square distribution of prior_freedom + 2 degrees and that mean.

    Returns
    -------
    Estimate
        Covariance of `PLANE_PARAMETERS` (tilts about the centroid along axis 1 and 2, offset);
        without a prior the noise is taken from the residuals alone, and is zero for three points;
        residuals in mm; chi2 in units of that noise.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    n = len(points)
    if n < 3:
        return FitFailure(f"a plane needs three points, got {n}", "give more points")
    centre = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - centre, full_matrices=False)
    if spread[1] <= 1e-9 * max(spread[0], 1e-300):
        return FitFailure(
            "the points of the plane lie on one line", "give points that spread in two directions"
        )
    triad = np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])])
    plane = Plane(centre, triad)
    residuals = plane.distance_mm(points)
    freedom = n - 3
    squares = float(residuals @ residuals)
    known = prior_freedom + freedom
    variance = (prior_freedom * prior_sigma_mm**2 + squares) / known if known > 0.0 else 0.0
    information = np.array([spread[0] ** 2, spread[1] ** 2, float(n)])
    chi2 = squares / variance if variance > 0.0 else 0.0
    return Estimate(
        plane, PLANE_PARAMETERS, np.diag(variance / information), residuals, freedom, chi2
    )
