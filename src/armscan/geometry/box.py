# SPDX-License-Identifier: Apache-2.0
"""A box along the axes, from the six numbers that a person gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray

NAMES = ("xmin", "xmax", "ymin", "ymax", "zmin", "zmax")
REMEDY = f"give {','.join(NAMES)} in mm"


def box_corners_mm(values: Sequence[float], where: str) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner (3,) of ``xmin, xmax, ymin, ymax, zmin, zmax`` in mm.

    Parameters
    ----------
    values
        The numbers.
    where
        The option that gave them, for messages.

    Raises
    ------
    OptionError
        Naming the number that is not finite, or the pair that is not in order; or the count.
    """
    if len(values) != len(NAMES):
        fact = f"{len(values)} numbers where {len(NAMES)} are needed"
        raise OptionError(fact, where=where, remedy=REMEDY)
    numbers = np.array(values, dtype=np.float64)
    for name, value in zip(NAMES, numbers, strict=True):
        if not np.isfinite(value):
            raise OptionError(f"{name} is {value:g}", where=where, remedy=REMEDY)
    low, high = numbers[0::2], numbers[1::2]
    for axis in range(3):
        if not low[axis] < high[axis]:
            raise OptionError(
                f"{NAMES[2 * axis]} {low[axis]:g} is not below {NAMES[2 * axis + 1]} "
                f"{high[axis]:g}",
                where=where,
                remedy=REMEDY,
            )
    return low, high
