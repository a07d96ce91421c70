# SPDX-License-Identifier: Apache-2.0
"""A circle through points: least sum of squared distances, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.fitting import Plane, fit_plane
from armscan.geometry.round_fit import fit_round

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
        Circle(fit.centre, fit.radius),
        CIRCLE_PARAMETERS,
        fit.covariance,
        fit.residuals,
        freedom,
        float(freedom),
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
        SpaceCircle(Plane(centre, axes), flat.value.radius_mm),
        flat.parameter_names,
        flat.covariance,
        flat.residuals,
        flat.degrees_of_freedom,
        flat.chi2,
    )
