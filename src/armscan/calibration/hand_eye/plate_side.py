# SPDX-License-Identifier: Apache-2.0
"""Which side of a plate was touched."""

from __future__ import annotations

from typing import Literal

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Plane

ProbeSide = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
"""Axis of Base along which the plate's face looks, roughly."""

DEFAULT_SIDE: ProbeSide = "+z"
TAKEN_FOR_GRANTED = "taken for granted: nobody said where the tool was"
CLEAR_SIDE = 0.26
"""Cosine of 75 degrees: a plate steeper than that towards an axis has no clear side along it."""
LEAST_HEIGHT_MM = 1.0
"""The tool must be further than that from the plate's plane to tell its side."""


def face_towards(
    plane: Plane,
    towards_mm: FloatArray | None,
    side: ProbeSide | None,
    *,
    is_sign_only: bool = False,
) -> tuple[Plane, str] | FitFailure:
    """Turn a plane's normal to the side of the probe.

    Parameters
    ----------
    plane
        The plane in Base.
    towards_mm
        (3,) or (M, 3) places of the tool; None where not known.
    side
        The user's word, which wins; None to follow the tool, or `DEFAULT_SIDE` without it.
    is_sign_only
        Nothing but the normal's sign depends on the side: where nobody says it and `DEFAULT_SIDE`
        is not clear, the axis that the plate faces most will do.

    Returns
    -------
    plane, side_from
        The plane, and how its side was found, in words; a failure if it is not clear.
    """
    if side is None and towards_mm is not None:
        heights = plane.distance_mm(np.atleast_2d(np.asarray(towards_mm, dtype=np.float64)))
        above = float(np.median(heights))
        if abs(above) < LEAST_HEIGHT_MM:
            return FitFailure(
                "the tool lies in the plate's plane: the side of the probe is not clear",
                "say it with --side",
            )
        return _facing(plane, above), "where the tool was"
    how = "as asked for" if side else TAKEN_FOR_GRANTED
    if side is None and is_sign_only and abs(plane.normal[2]) < CLEAR_SIDE:
        axis = int(np.argmax(np.abs(plane.normal)))
        return _facing(plane, float(plane.normal[axis])), f"+{'xyz'[axis]}, {how}"
    side = side or DEFAULT_SIDE
    cosine = float(plane.normal["xyz".index(side[1])]) * (1.0 if side[0] == "+" else -1.0)
    if abs(cosine) < CLEAR_SIDE:
        return FitFailure(
            f"the plate stands within {90.0 - np.degrees(np.arccos(CLEAR_SIDE)):.0f} degrees of "
            f"the axis {side[1]}: '{side}' does not say which side was touched",
            "say it with --side, along the axis that the plate faces",
        )
    return _facing(plane, cosine), f"{side}, {how}"


def _facing(plane: Plane, sign: float) -> Plane:
    """The same plane; its normal turned over, about the first axis, for a negative sign."""
    if sign > 0.0:
        return plane
    return Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))
