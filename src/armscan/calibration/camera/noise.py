# SPDX-License-Identifier: Apache-2.0
"""How much the points scatter beyond what their detector claims.

The rule: a detector knows the noise of the image, not that the board is not quite flat, the lens
not quite as modelled, or the photograph compressed. Where chi2 shows that residuals are larger
than claimed, a variance common to all points and both axes is added to the detector's
covariances, of such a size that they explain the residuals. Without it the points that a detector
finds best would dominate although they are no better than the others. Where residuals are as
claimed, or smaller, nothing is added. In either case covariances are scaled by chi2 over the
degrees of freedom in the end.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.calibration.camera.observations import Observations
from armscan.geometry.arrays import FloatArray

SIGNIFICANT_SIGMAS = 4.0


def excess_variance_px2(
    residuals: FloatArray, covariances: FloatArray, chi2: float, degrees_of_freedom: int
) -> float:
    """Variance per axis to be added to the detector's covariances.

    Parameters
    ----------
    residuals
        (N, 2) of the points used, in px.
    covariances
        (N, 2, 2) that the detector claims for them.
    chi2
        Squared residuals over these covariances.
    degrees_of_freedom
        Coordinates minus unknowns.

    Returns
    -------
    variance
        In px^2; 0 unless chi2 is larger than its expectation by four of its standard deviations.
    """
    if degrees_of_freedom < 1:
        return 0.0
    expected_spread = np.sqrt(2.0 / degrees_of_freedom)
    if chi2 / degrees_of_freedom < 1.0 + SIGNIFICANT_SIGMAS * expected_spread:
        return 0.0
    scatter = float(np.sum(residuals**2)) / degrees_of_freedom
    claimed = 0.5 * float(np.mean(np.trace(covariances, axis1=1, axis2=2)))
    return max(scatter - claimed, 0.0)


def claimed_covariances(observations: Observations) -> FloatArray:
    """(N, 2, 2) covariances in px^2 that the whitening stands for."""
    whitening = observations.whitening
    return np.asarray(np.linalg.inv(whitening.transpose(0, 2, 1) @ whitening))


def with_excess(observations: Observations, variance_px2: float) -> Observations:
    """The observations with a variance added to every point and axis."""
    covariances = claimed_covariances(observations) + variance_px2 * np.eye(2)
    return replace(observations, whitening=np.linalg.inv(np.linalg.cholesky(covariances)))
