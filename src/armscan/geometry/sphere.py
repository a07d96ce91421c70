# SPDX-License-Identifier: Apache-2.0
"""A sphere through points: least sum of squared distances from its surface (Gaussian sphere)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.round_fit import fit_round

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
        Sphere(fit.centre, fit.radius),
        SPHERE_PARAMETERS,
        fit.covariance,
        fit.residuals,
        freedom,
        float(freedom),
    )
