# SPDX-License-Identifier: Apache-2.0
"""A plate's plane from a file: probed points, or its four coefficients."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.errors import EstimationError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Plane, fit_plane
from armscan.inspection.plane import plane_from_coefficients
from armscan.records.probing import ProbedPoints
from armscan.storage.probed_points import read_points_or_plane


def read_plate(path: Path, near_mm: FloatArray) -> PlateReference:
    """Read a plate.

    Parameters
    ----------
    path
        Probed points, or a file with ``A,B,C,D``.
    near_mm
        (3,) a point near which the plane's own point shall lie if only coefficients are known.

    Raises
    ------
    ArmscanError
        If the file is neither, or its points determine no plane.
    """
    found = read_points_or_plane(path)
    if not isinstance(found, ProbedPoints):
        return PlateReference(plane_from_coefficients(found, near_mm), source=str(path))
    return _fitted(found, path)


def _fitted(found: ProbedPoints, path: Path) -> PlateReference:
    if found.are_tip_centres:
        raise InputError(
            f"these are centres of a tip of {found.tip_diameter_mm:g} mm, not points on the plate",
            where=str(path),
            remedy="give the points on the surface that `armscan probe` writes",
        )
    fit = fit_plane(found.points_mm)
    if isinstance(fit, FitFailure):
        raise EstimationError(fit.reason, where=str(path), remedy=fit.remedy)
    rms = float(np.sqrt(np.mean(fit.residuals**2)))
    plane = fit.value
    # heights over the plate count upwards; its covariance is diagonal and stays
    if plane.normal[int(np.argmax(np.abs(plane.normal)))] < 0.0:
        plane = Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))
    return PlateReference(plane, fit.covariance, rms, len(found), str(path))
