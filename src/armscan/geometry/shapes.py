# SPDX-License-Identifier: Apache-2.0
"""Lines, planes, circles and spheres through points, by least squares of the distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, floats, frozen_floats
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
        value=plane,
        parameter_names=PLANE_PARAMETERS,
        covariance=np.diag(variance / information),
        residuals=residuals,
        degrees_of_freedom=freedom,
        chi2=chi2,
    )


MAX_STEPS = 100
SETTLED = 1e-12
"""Step, over the spread of the points, at which an iteration has settled."""
MAX_DAMPING = 1e15
LARGEST_RADIUS_SIGMA = 0.5
"""A radius whose standard deviation is larger than this part of it is not determined."""
SCATTER_SIGMAS = 2.0
"""Points no thicker than this many standard deviations across may as well lie in one plane."""
AMBIGUOUS_SIGMAS = 4.0
"""Two centres are told apart only if the worse one costs this many standard deviations more."""
RIVAL_COST_RATIO = 4.0
"""A centre that costs this many times more than the best one is no rival."""
START_SAMPLES = 150
START_POINTS = 500
ROUNDS_OF_REJECTION = 20
NORMAL_MAD = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""


@dataclass(frozen=True, slots=True, eq=False)
class RoundFit:
    """A circle (D = 2) or sphere (D = 3) and what it rests on.

    Parameters
    ----------
    centre, radius
        (D,) and its radius, in the unit of the points.
    covariance
        (D + 1, D + 1) of centre and radius; the radius's row is zero where it was given.
    residuals
        (N,) distance from the surface, positive outside, of all points.
    is_used
        (N,) False for points that were rejected or have no weight.
    n_free
        Count of free parameters.
    """

    centre: FloatArray
    radius: float
    covariance: FloatArray
    residuals: FloatArray
    is_used: BoolArray
    n_free: int

    @property
    def degrees_of_freedom(self) -> int:
        """Count of points used minus count of free parameters."""
        return int(self.is_used.sum()) - self.n_free


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Points about their centroid in units of their spread; ``radius`` None if it is free."""

    points: FloatArray
    weights: FloatArray
    radius: float | None

    @property
    def n_free(self) -> int:
        return int(self.points.shape[1]) + (self.radius is None)

    def residuals(self, centre: FloatArray, radius: float) -> FloatArray:
        return np.asarray(np.linalg.norm(self.points - centre, axis=1) - radius)

    def cost(self, centre: FloatArray, radius: float) -> float:
        return float(self.weights @ self.residuals(centre, radius) ** 2)

    def jacobian(self, centre: FloatArray) -> FloatArray:
        towards = centre - self.points
        length = np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
        columns = towards / length[:, None]
        if self.radius is not None:
            return np.asarray(columns)
        return np.column_stack([columns, -np.ones(len(columns))])


def fit_round(
    points: FloatArray,
    radius: float | None,
    weights: FloatArray | None,
    outlier_sigmas: float | None,
    name: str,
) -> RoundFit | FitFailure:
    """Fit a circle or sphere to (N, D) points: least sum of squared distances from its surface.

    Parameters
    ----------
    points
        (N, D) points.
    radius
        Known radius, or None if it is to be found.
    weights
        (N,) one over variance up to a common factor, or None for equal ones; the size of the noise
        is taken from the residuals.
    outlier_sigmas
        Reject points further from the surface than this many robust standard deviations, after a
        start by least median of squares; None to use all.
    name
        What is fitted, for messages.

    Raises
    ------
    InputError
        If values are not finite, weights are negative, or shapes do not fit.
    OptionError
        If the radius or the limit of rejection is not positive.
    """
    cloud = frozen_floats(points, (None, points.shape[1]), f"points of the {name}")
    n, dimensions = cloud.shape
    w = _checked_weights(weights, n, name)
    _check_options(radius, outlier_sigmas)
    is_used = w > 0.0
    n_free = dimensions + (radius is None)
    if int(is_used.sum()) < n_free:
        return FitFailure(
            f"a {name} needs {n_free} points, got {int(is_used.sum())}", "give more points"
        )
    centroid = cloud[is_used].mean(axis=0)
    spread = float(np.sqrt(((cloud[is_used] - centroid) ** 2).sum(axis=1).mean()))
    if spread == 0.0:
        return FitFailure(f"all points of the {name} coincide", "give points apart from each other")
    scaled = (cloud - centroid) / spread
    known = None if radius is None else radius / spread
    if outlier_sigmas is None:
        solved = _solve(_Problem(scaled[is_used], w[is_used] / w.max(), known), (), name)
    else:
        is_used, solved = _solve_robust(scaled, w / w.max(), known, outlier_sigmas, name)
    if isinstance(solved, FitFailure):
        return solved
    centre, size, covariance = solved
    residuals = (np.linalg.norm(scaled - centre, axis=1) - size) * spread
    return RoundFit(
        centroid + centre * spread,
        size * spread,
        covariance * spread**2,
        residuals,
        is_used,
        n_free,
    )


_Solved = tuple[FloatArray, float, FloatArray]


def _checked_weights(weights: FloatArray | None, n: int, name: str) -> FloatArray:
    if weights is None:
        return np.ones(n)
    w = frozen_floats(weights, (n,), f"weights of the {name}")
    if n and float(w.min()) < 0.0:
        raise InputError(f"weights of the {name} are negative", remedy="give one over variance")
    return w


def _check_options(radius: float | None, outlier_sigmas: float | None) -> None:
    if radius is not None and not 0.0 < radius < np.inf:
        raise OptionError(f"a radius of {radius}", remedy="give a positive number")
    if outlier_sigmas is not None and not 0.0 < outlier_sigmas < np.inf:
        raise OptionError(
            f"rejection beyond {outlier_sigmas} standard deviations", remedy="give 3 to 5"
        )


def _solve(problem: _Problem, centres: tuple[FloatArray, ...], name: str) -> _Solved | FitFailure:
    """Best of the minima that are reached from several starts; refused where it is not unique."""
    starts = [*centres, *_starts(problem)]
    ends = [_descend(problem, start) for start in starts]
    ends.sort(key=lambda end: problem.cost(*end))
    centre, radius = ends[0]
    freedom = len(problem.points) - problem.n_free
    variance = problem.cost(centre, radius) / freedom if freedom > 0 else 0.0
    covariance = _covariance(problem, centre, variance)
    flat = "line" if problem.points.shape[1] == 2 else "plane"
    if covariance is None or _is_loose(problem, radius, covariance, variance):
        return FitFailure(
            f"the points do not determine the {name}: within their scatter they lie on one {flat}",
            "give points on a larger part of the surface",
        )
    if any(_is_rival(problem, ends[0], end, variance) for end in ends[1:]):
        return FitFailure(
            f"two places of the {name}'s centre, on either side of the points, fit equally well",
            f"give points that do not lie on one {flat}",
        )
    return centre, radius, covariance


def _is_loose(problem: _Problem, radius: float, covariance: FloatArray, variance: float) -> bool:
    """True if the radius is unknown, or rests on no more than the scatter across the points."""
    if float(np.linalg.eigvalsh(covariance)[-1]) > (LARGEST_RADIUS_SIGMA * radius) ** 2:
        return True
    if problem.radius is not None:
        return False
    share = problem.weights / problem.weights.sum()
    centred = problem.points - share @ problem.points
    thickness = float(np.linalg.svd(centred * np.sqrt(share)[:, None], compute_uv=False)[-1])
    return thickness < SCATTER_SIGMAS * float(np.sqrt(variance))


def _is_rival(
    problem: _Problem,
    best: tuple[FloatArray, float],
    other: tuple[FloatArray, float],
    variance: float,
) -> bool:
    """True for another place of the centre that the points do not tell from the best one."""
    if float(np.linalg.norm(other[0] - best[0])) < 1e-3 * best[1]:
        return False
    costs = problem.weights * problem.residuals(*other) ** 2
    gain = costs - problem.weights * problem.residuals(*best) ** 2
    lost = float(gain.sum())
    if lost < AMBIGUOUS_SIGMAS**2 * max(variance, 1e-20):
        return True
    is_close = float(costs.sum()) < RIVAL_COST_RATIO * problem.cost(*best)
    return is_close and lost < AMBIGUOUS_SIGMAS * float(np.linalg.norm(gain))


def _starts(problem: _Problem) -> list[FloatArray]:
    """Taubin's algebraic fit; with a known radius also a centre on each side of the points."""
    algebraic = _taubin(problem)
    starts = [] if algebraic is None else [algebraic]
    _, _, axes = np.linalg.svd(problem.points * np.sqrt(problem.weights)[:, None], False)
    normal = axes[-1]
    if problem.radius is not None:
        starts += [normal * problem.radius, -normal * problem.radius]
    return starts or [normal, -normal]


def _taubin(problem: _Problem) -> FloatArray | None:
    """(D,) centre of Taubin's fit (nearly unbiased on short arcs); None for a straight set."""
    w = problem.weights / problem.weights.sum()
    middle = w @ problem.points
    centred = problem.points - middle
    square = (centred**2).sum(axis=1)
    mean = float(w @ square)
    columns = np.column_stack([(square - mean) / (2.0 * np.sqrt(mean)), centred])
    _, _, axes = np.linalg.svd(columns * np.sqrt(w)[:, None], full_matrices=False)
    curvature = axes[-1, 0] / (2.0 * np.sqrt(mean))
    if abs(curvature) < 1e-12:
        return None
    return np.asarray(middle - axes[-1, 1:] / (2.0 * curvature))


def _descend(problem: _Problem, centre: FloatArray) -> tuple[FloatArray, float]:
    """Levenberg and Marquardt's iteration from a centre."""
    weights = problem.weights
    radius = problem.radius
    size = float(weights @ problem.residuals(centre, 0.0) / weights.sum())
    size = size if radius is None else radius
    cost, damping = problem.cost(centre, size), 1e-6
    for _ in range(MAX_STEPS):
        jacobian = problem.jacobian(centre)
        normal = (jacobian.T * weights) @ jacobian
        gradient = (jacobian.T * weights) @ problem.residuals(centre, size)
        while True:
            damped = normal + damping * np.diag(np.diag(normal) + 1e-12)
            step = -np.linalg.lstsq(damped, gradient, rcond=None)[0]
            candidate = centre + step[: len(centre)]
            new_size = size + float(step[-1]) if radius is None else radius
            new_cost = problem.cost(candidate, new_size)
            if new_cost <= cost or damping > MAX_DAMPING:
                break
            damping *= 10.0
        if new_cost > cost:
            break
        centre, size, cost, damping = candidate, new_size, new_cost, damping * 0.1
        if float(np.abs(step).max()) < SETTLED * max(1.0, abs(size)):
            break
    return centre, size


def _covariance(problem: _Problem, centre: FloatArray, variance: float) -> FloatArray | None:
    """(D + 1, D + 1) of centre and radius; None where the points leave a direction free."""
    jacobian = problem.jacobian(centre) * np.sqrt(problem.weights)[:, None]
    _, values, axes = np.linalg.svd(jacobian, full_matrices=False)
    if values[-1] <= 1e-9 * values[0]:
        return None
    dimensions = problem.points.shape[1]
    covariance = np.zeros((dimensions + 1, dimensions + 1))
    covariance[: problem.n_free, : problem.n_free] = variance * (axes.T / values**2) @ axes
    return covariance


def _solve_robust(
    points: FloatArray, weights: FloatArray, radius: float | None, limit: float, name: str
) -> tuple[BoolArray, _Solved | FitFailure]:
    """Start by least median of squares, then reject and fit in turn until nothing changes."""
    start = _least_median(points[weights > 0.0], radius)
    if start is None:
        failure = FitFailure(
            f"no {name} passes through the points: they lie on a line or plane",
            "give points on a larger part of the surface",
        )
        return weights > 0.0, failure
    centre, size = start
    is_used = weights > 0.0
    solved: _Solved | FitFailure = FitFailure(f"the {name} was not fitted")
    for _ in range(ROUNDS_OF_REJECTION):
        deviation = np.abs(np.linalg.norm(points - centre, axis=1) - size) * np.sqrt(weights)
        scale = NORMAL_MAD * float(np.median(deviation[is_used]))
        kept = (weights > 0.0) & (deviation <= max(limit * scale, 1e-12))
        if int(kept.sum()) < points.shape[1] + (radius is None):
            return kept, FitFailure(f"too few points lie on one {name}", "check the points")
        problem = _Problem(points[kept], weights[kept], radius)
        solved = _solve(problem, (centre,), name)
        if isinstance(solved, FitFailure) or bool((kept == is_used).all()):
            return kept, solved
        is_used = kept
        centre, size, _ = solved
    return is_used, solved


def _least_median(points: FloatArray, radius: float | None) -> tuple[FloatArray, float] | None:
    """Of many rounds through D + 1 points, the one with the least median distance."""
    n, dimensions = points.shape
    if n <= dimensions:
        return None
    generator = np.random.default_rng(0)
    pick = np.argsort(generator.random((START_SAMPLES, min(n, 50))), axis=1)[:, : dimensions + 1]
    offset = generator.integers(0, n, size=(START_SAMPLES, 1))
    sample = points[(pick * max(n // 50, 1) + offset) % n]
    system = 2.0 * (sample[:, 1:] - sample[:, :1])
    square = (sample**2).sum(axis=2)
    volume = np.abs(np.linalg.det(system))
    is_solvable = volume > 1e-9
    if not is_solvable.any():
        return None
    right = (square[:, 1:] - square[:, :1])[is_solvable, :, None]
    centres = np.linalg.solve(system[is_solvable], right)[:, :, 0]
    sizes = np.linalg.norm(sample[is_solvable, 0] - centres, axis=1)
    judges = points[:: max(n // START_POINTS, 1)]
    reach = np.sqrt(((judges[None] - centres[:, None]) ** 2).sum(axis=2))
    best = int(np.argmin(np.median(np.abs(reach - sizes[:, None]), axis=1)))
    return centres[best], float(sizes[best]) if radius is None else radius


CIRCLE_PARAMETERS = ("centre_x_mm", "centre_y_mm", "radius_mm")


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle in the plane: centre (2,) and radius in mm."""

    centre_mm: FloatArray
    radius_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", frozen_floats(self.centre_mm, (2,), "centre_mm"))

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of (N, 2) points from the line, positive outside."""
        return np.asarray(np.linalg.norm(points_mm - self.centre_mm, axis=1) - self.radius_mm)


@dataclass(frozen=True, slots=True, eq=False)
class SpaceCircle:
    """A circle in space: its plane, with the centre (3,) as the plane's point, and its radius."""

    plane: Plane
    radius_mm: float

    @property
    def centre_mm(self) -> FloatArray:
        """(3,) centre."""
        return self.plane.point_mm


def fit_circle(
    points_mm: FloatArray,
    radius_mm: float | None = None,
    weights: FloatArray | None = None,
    *,
    outlier_sigmas: float | None = None,
) -> Estimate[Circle] | FitFailure:
    """Fit a circle to (N, 2) points: least sum of squared distances from its line.

    Parameters
    ----------
    points_mm
        (N, 2) points; three at least, two with a known radius, and not all on one line.
    radius_mm
        Known radius, or None to find it.
    weights
        (N,) one over variance up to a common factor, None for equal ones; 0 leaves a point out.
    outlier_sigmas
        Reject points further from the line than this many robust standard deviations; None to
        use all.

    Returns
    -------
    Estimate
        Covariance of `CIRCLE_PARAMETERS`, the size of the noise taken from the residuals (zero
        without redundancy; zero in the radius's row where it was given). Residuals: (N,) distance
        of every point in mm, positive outside. ``chi2`` in units of that noise.

    Raises
    ------
    InputError
        If a value is not finite or a shape does not fit.
    OptionError
        If the radius or the limit is not positive.
    """
    points = frozen_floats(points_mm, (None, 2), "points of the circle")
    fit = fit_round(points, radius_mm, weights, outlier_sigmas, "circle")
    if isinstance(fit, FitFailure):
        return fit
    freedom = fit.degrees_of_freedom
    return Estimate(
        value=Circle(fit.centre, fit.radius),
        parameter_names=CIRCLE_PARAMETERS,
        covariance=fit.covariance,
        residuals=fit.residuals,
        degrees_of_freedom=freedom,
        chi2=float(freedom),
    )


def fit_space_circle(
    points_mm: FloatArray, radius_mm: float | None = None
) -> Estimate[SpaceCircle] | FitFailure:
    """Fit a circle to (N, 3) points as reference sets define it: plane, projection, circle.

    Parameters
    ----------
    points_mm
        (N, 3) points near one plane.
    radius_mm
        Known radius, or None to find it.

    Returns
    -------
    Estimate
        Parameters and residuals within the plane as from `fit_circle`, x and y along the first two
        axes of the plane.
    """
    points = frozen_floats(points_mm, (None, 3), "points of the circle")
    plane = fit_plane(points)
    if isinstance(plane, FitFailure):
        return plane
    axes = plane.value.axes
    middle = plane.value.point_mm
    flat = fit_circle((points - middle) @ axes[:2].T, radius_mm)
    if isinstance(flat, FitFailure):
        return flat
    centre = middle + flat.value.centre_mm @ axes[:2]
    return Estimate(
        value=SpaceCircle(Plane(centre, axes), flat.value.radius_mm),
        parameter_names=flat.parameter_names,
        covariance=flat.covariance,
        residuals=flat.residuals,
        degrees_of_freedom=flat.degrees_of_freedom,
        chi2=flat.chi2,
    )


SPHERE_PARAMETERS = ("centre_x_mm", "centre_y_mm", "centre_z_mm", "radius_mm")


@dataclass(frozen=True, slots=True, eq=False)
class Sphere:
    """A sphere: centre (3,) and radius in mm, in the frame of its points."""

    centre_mm: FloatArray
    radius_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", frozen_floats(self.centre_mm, (3,), "centre_mm"))

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of (N, 3) points from the surface, positive outside."""
        return np.asarray(np.linalg.norm(points_mm - self.centre_mm, axis=1) - self.radius_mm)


def fit_sphere(
    points_mm: FloatArray,
    radius_mm: float | None = None,
    weights: FloatArray | None = None,
    *,
    outlier_sigmas: float | None = None,
) -> Estimate[Sphere] | FitFailure:
    """Fit a sphere to (N, 3) points: least sum of squared distances from its surface.

    Parameters
    ----------
    points_mm
        (N, 3) points; four at least, three with a known radius, and not all in one plane.
    radius_mm
        Known radius, or None to find it.
    weights
        (N,) one over variance up to a common factor, None for equal ones; 0 leaves a point out.
    outlier_sigmas
        Reject points further from the surface than this many robust standard deviations (least
        median of squares, then rejection in turn with the fit); None to use all.

    Returns
    -------
    Estimate
        Covariance of `SPHERE_PARAMETERS`, the size of the noise taken from the residuals (zero
        without redundancy; zero in the radius's row where it was given). Residuals: (N,) distance
        of every point in mm, positive outside, rejected points included. ``chi2`` in units of
        that noise.

    Raises
    ------
    InputError
        If a value is not finite or a shape does not fit.
    OptionError
        If the radius or the limit is not positive.
    """
    points = frozen_floats(points_mm, (None, 3), "points of the sphere")
    fit = fit_round(points, radius_mm, weights, outlier_sigmas, "sphere")
    if isinstance(fit, FitFailure):
        return fit
    freedom = fit.degrees_of_freedom
    return Estimate(
        value=Sphere(fit.centre, fit.radius),
        parameter_names=SPHERE_PARAMETERS,
        covariance=fit.covariance,
        residuals=fit.residuals,
        degrees_of_freedom=freedom,
        chi2=float(freedom),
    )
