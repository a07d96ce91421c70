# SPDX-License-Identifier: Apache-2.0
"""Lines, planes, circles and spheres through points, by least squares of the distances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import ArrayRecord, FloatArray, floats, frozen_floats, row_lengths
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.least_squares import levenberg_marquardt, robust_sigma

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


class Plane(ArrayRecord, kw_only=False):
    """A plane through ``point_mm`` (3,) with rows of ``axes`` (3, 3) along, across and normal.

    The first axis is the direction of the widest spread of the points it was fitted to.
    """

    point_mm: FloatArray = floats(3)
    axes: FloatArray = floats(3, 3)

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

    def tilted(self, step: FloatArray) -> Plane:
        """Add ``step[0] x + step[1] y + step[2]`` (x, y, mm of its axes) to its height.

        True to first order; the triad is turned so that it stays orthonormal.
        """
        normal = self.axes[2] - step[0] * self.axes[0] - step[1] * self.axes[1]
        normal = normal / np.linalg.norm(normal)
        first = self.axes[0] - (self.axes[0] @ normal) * normal
        first = first / np.linalg.norm(first)
        point = self.point_mm + step[2] * self.axes[2]
        return Plane(point, np.stack([first, np.cross(normal, first), normal]))


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
    _, singular, axes = np.linalg.svd((points - centre) * np.sqrt(w)[:, None], full_matrices=False)
    if singular[0] == 0.0:
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

    ``prior_sigma_mm`` and ``prior_freedom`` are what is known of a point's noise beforehand, and
    how many degrees of freedom that is worth: the noise's variance is (prior_freedom
    prior_sigma_mm^2 + squared residuals) / (prior_freedom + N - 3). That is the expected variance
    if it was drawn from the scaled inverse chi-square distribution of prior_freedom + 2 degrees and
    that mean.

    Covariance of `PLANE_PARAMETERS` (tilts about the centroid along axis 1 and 2, offset), zero for
    three points without a prior; residuals in mm; chi2 in units of the noise.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    n = len(points)
    if n < 3:
        return FitFailure(f"a plane needs three points, got {n}", "give more points")
    centre = points.mean(axis=0)
    _, singular, axes = np.linalg.svd(points - centre, full_matrices=False)
    if singular[1] <= 1e-9 * max(singular[0], 1e-300):
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
    information = np.array([singular[0] ** 2, singular[1] ** 2, float(n)])
    chi2 = squares / variance if variance > 0.0 else 0.0
    return Estimate(
        value=plane,
        parameter_names=PLANE_PARAMETERS,
        covariance=np.diag(variance / information),
        residuals=residuals,
        degrees_of_freedom=freedom,
        chi2=chi2,
    )


LARGEST_RADIUS_SIGMA = 0.5
"""A radius whose standard deviation is larger than this part of it is not determined."""
SCATTER_SIGMAS = 2.0
"""Points no thicker than this many standard deviations may as well lie on a line or plane."""
ROUNDS_OF_REJECTION = 20
SETTLED = 1e-17
"""To rounding: a fit costs little, and its figures are then those of any other solver."""
START_SAMPLES, START_POINTS = 150, 500
"""Surfaces through a few points that are tried, and points that judge them."""

CIRCLE_PARAMETERS = ("centre_x_mm", "centre_y_mm", "radius_mm")
SPHERE_PARAMETERS = ("centre_x_mm", "centre_y_mm", "centre_z_mm", "radius_mm")


class Circle(ArrayRecord, kw_only=False):
    """A circle in the plane: centre (2,) and radius in mm."""

    centre_mm: FloatArray = floats(2)
    radius_mm: float


class Sphere(ArrayRecord, kw_only=False):
    """A sphere: centre (3,) and radius in mm."""

    centre_mm: FloatArray = floats(3)
    radius_mm: float

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of (N, 3) points from the surface, positive outside."""
        return _off_round(points_mm, np.array([*self.centre_mm, self.radius_mm]))


def fit_circle(
    points_mm: FloatArray, *, outlier_sigmas: float | None = None
) -> Estimate[Circle] | FitFailure:
    """Fit a circle to (N, 2) points, as `fit_sphere` fits a sphere; needs three points."""
    points = frozen_floats(points_mm, (None, 2), "points of the circle")
    fit = _fit_round(points, outlier_sigmas, CIRCLE_PARAMETERS, "circle", "line")
    if isinstance(fit, FitFailure):
        return fit
    return fit.of(Circle(fit.value[:2], float(fit.value[2])))


def fit_sphere(
    points_mm: FloatArray, *, outlier_sigmas: float | None = None
) -> Estimate[Sphere] | FitFailure:
    """Fit a sphere to (N, 3) points: least sum of squared distances (the Gaussian sphere).

    Points further from the surface than ``outlier_sigmas`` robust standard deviations are rejected,
    after a start by least median of squares; None uses all. Covariance of `SPHERE_PARAMETERS`, the
    noise taken from the residuals (zero without redundancy); residuals (N,) of every point in mm,
    positive outside, of rejected points too; chi2 in units of that noise.

    Raises
    ------
    InputError
        If a value is not finite or a shape does not fit.
    OptionError
        If the limit of rejection is not positive.
    """
    points = frozen_floats(points_mm, (None, 3), "points of the sphere")
    fit = _fit_round(points, outlier_sigmas, SPHERE_PARAMETERS, "sphere", "plane")
    if isinstance(fit, FitFailure):
        return fit
    return fit.of(Sphere(fit.value[:3], float(fit.value[3])))


def _fit_round(
    points: FloatArray,
    outlier_sigmas: float | None,
    names: tuple[str, ...],
    name: str,
    flat: Literal["line", "plane"],
) -> Estimate[FloatArray] | FitFailure:
    """Centre and radius (D + 1,) of (N, D) points; solved in units of the points' extent."""
    if outlier_sigmas is not None and not 0.0 < outlier_sigmas < np.inf:
        raise OptionError(
            f"rejection beyond {outlier_sigmas} standard deviations", remedy="give 3 to 5"
        )
    n, dimensions = points.shape
    if n <= dimensions:
        return FitFailure(f"a {name} needs {dimensions + 1} points, got {n}", "give more points")
    centroid = points.mean(axis=0)
    extent = float(np.sqrt(((points - centroid) ** 2).sum(axis=1).mean()))
    if extent == 0.0:
        return FitFailure(f"all points of the {name} coincide", "give points apart from each other")
    scaled = (points - centroid) / extent
    found = _solve_round(scaled, outlier_sigmas)
    if found is None:
        return FitFailure(
            f"the points do not determine the {name}: within their scatter they lie on one {flat}",
            "give points on a larger part of the surface",
        )
    state, covariance, freedom = found
    return Estimate(
        value=extent * state + np.array([*centroid, 0.0]),
        parameter_names=names,
        covariance=extent**2 * covariance,
        residuals=extent * _off_round(scaled, state),
        degrees_of_freedom=freedom,
        chi2=float(freedom),
    )


def _solve_round(
    points: FloatArray, outlier_sigmas: float | None
) -> tuple[FloatArray, FloatArray, int] | None:
    """State, covariance and degrees of freedom; None where the points do not determine them."""
    is_used = np.ones(len(points), dtype=np.bool_)
    state = _taubin(points) if outlier_sigmas is None else _least_median(points)
    if state is None:
        return None
    fit = None
    for _ in range(ROUNDS_OF_REJECTION):
        size = np.abs(_off_round(points, state))
        limit = np.inf if outlier_sigmas is None else outlier_sigmas * robust_sigma(size[is_used])
        kept = size <= max(limit, 1e-12)
        if int(kept.sum()) < len(state):
            return None
        fit = levenberg_marquardt(
            state, partial(_round_system, points[kept]), np.add, settled=SETTLED
        )
        is_same, is_used = np.array_equal(kept, is_used), kept
        if fit is None or is_same:
            break
        state = fit.state
    if fit is None:
        return None
    state, freedom = fit.state, int(is_used.sum()) - len(state)
    covariance = fit.system.covariance
    if covariance is None:
        return None
    variance = fit.chi2 / freedom if freedom else 0.0
    used = points[is_used] - points[is_used].mean(axis=0)
    thickness = float(np.linalg.svd(used, compute_uv=False)[-1]) / np.sqrt(len(used))
    worst = np.sqrt(variance * float(np.linalg.eigvalsh(covariance)[-1]))
    if worst > LARGEST_RADIUS_SIGMA * state[-1] or thickness < SCATTER_SIGMAS * np.sqrt(variance):
        return None
    return state, variance * covariance, freedom


def _off_round(points: FloatArray, state: FloatArray) -> FloatArray:
    return np.asarray(row_lengths(points - state[:-1]) - state[-1])


def _round_system(points: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (N,) and their derivative (N, D + 1)."""
    towards = state[:-1] - points
    length = np.maximum(row_lengths(towards), 1e-300)
    jacobian = np.column_stack([towards / length[:, None], -np.ones(len(points))])
    return length - state[-1], jacobian


def _taubin(points: FloatArray) -> FloatArray | None:
    """(D + 1,) of Taubin's fit (nearly unbiased on short arcs); None for a straight set."""
    middle = points.mean(axis=0)
    centred = points - middle
    square = (centred**2).sum(axis=1)
    mean = float(square.mean())
    columns = np.column_stack([(square - mean) / (2.0 * np.sqrt(mean)), centred])
    _, _, axes = np.linalg.svd(columns, full_matrices=False)
    curvature = axes[-1, 0] / (2.0 * np.sqrt(mean))
    if abs(curvature) < 1e-12:
        return None
    centre = middle - axes[-1, 1:] / (2.0 * curvature)
    return np.array([*centre, float(row_lengths(points - centre).mean())])


def _least_median(points: FloatArray) -> FloatArray | None:
    """Of many rounds through D + 1 points, the one (D + 1,) with the least median distance."""
    n, dimensions = points.shape
    generator = np.random.default_rng(0)
    pick = np.argsort(generator.random((START_SAMPLES, min(n, 50))), axis=1)[:, : dimensions + 1]
    offset = generator.integers(0, n, size=(START_SAMPLES, 1))
    sample = points[(pick * max(n // 50, 1) + offset) % n]
    system = 2.0 * (sample[:, 1:] - sample[:, :1])
    square = (sample**2).sum(axis=2)
    is_solvable = np.abs(np.linalg.det(system)) > 1e-9
    if not is_solvable.any():
        return None
    right = (square[:, 1:] - square[:, :1])[is_solvable, :, None]
    centres = np.linalg.solve(system[is_solvable], right)[:, :, 0]
    sizes = np.linalg.norm(sample[is_solvable, 0] - centres, axis=1)
    judges = points[:: max(n // START_POINTS, 1)]
    reach = np.sqrt(((judges[None] - centres[:, None]) ** 2).sum(axis=2))
    best = int(np.argmin(np.median(np.abs(reach - sizes[:, None]), axis=1)))
    return np.array([*centres[best], sizes[best]])
