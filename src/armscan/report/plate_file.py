# SPDX-License-Identifier: Apache-2.0
"""A plate's plane from a file: probed points, or its four coefficients."""

from __future__ import annotations

from pathlib import Path

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.plate_side import ProbeSide
from armscan.calibration.hand_eye.probed_plate import (
    ProbingOptions,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import plane_from_coefficients
from armscan.records.probing import ProbedPoints
from armscan.storage.probed_points import read_points_or_plane


def read_plate(
    path: Path,
    near_mm: FloatArray,
    *,
    towards_mm: FloatArray | None = None,
    side: ProbeSide | None = None,
) -> tuple[PlateReference, tuple[str, ...]]:
    """Read a plate, and what is weak about it, in words.

    Parameters
    ----------
    path
        Probed points, on the surface or centres of the tip; or a file with ``A,B,C,D``.
    near_mm
        (3,) a point near which the plane's own point shall lie if only coefficients are known.
    towards_mm
        (M, 3) places of the arm's tool while it scanned, for probed points; None where not known.
    side
        Side of the plate that was touched; None to take it from ``towards_mm``. Coefficients keep
        their own sign then.

    Raises
    ------
    ArmscanError
        If the file is neither, its points determine no plane, or they are of several features.
    """
    found = read_points_or_plane(path)
    if isinstance(found, ProbedPoints):
        fit = fit_probed_plate(found, towards_mm, ProbingOptions(side=side))
        if isinstance(fit, FitFailure):
            raise EstimationError(fit.reason, where=str(path), remedy=fit.remedy)
        return fit.reference, fit.warnings
    if side is None:
        return PlateReference(plane_from_coefficients(found, near_mm), source=str(path)), ()
    plate = plate_from_coefficients(found, near_mm, side, str(path))
    if isinstance(plate, FitFailure):
        raise EstimationError(plate.reason, where=str(path), remedy=plate.remedy)
    return plate, ()
