# SPDX-License-Identifier: Apache-2.0
"""Array types, records that own arrays, and the axis-aligned box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armscan.errors import InputError, OptionError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
ImageArray: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]


def frozen_floats(
    values: ArrayLike, shape: tuple[int | None, ...], name: str, *, allow_nan: bool = False
) -> FloatArray:
    """Return a read-only float64 copy of ``values`` after checking shape and finiteness.

    Parameters
    ----------
    values
        Anything that numpy turns into an array.
    shape
        Expected shape; ``None`` matches any length on that axis.
    name
        The name that an error message shows, with frame and unit.
    allow_nan
        Accept NaN (a gap); infinity is refused all the same.

    Raises
    ------
    InputError
        If the shape differs or a value is not finite.
    """
    array = np.array(values, dtype=np.float64, order="C")
    _check_shape(array.shape, shape, name)
    bad = np.isinf(array) if allow_nan else ~np.isfinite(array)
    if bad.any():
        raise InputError(
            f"{name} holds {int(bad.sum())} values that are not finite",
            remedy="remove or mask these entries",
        )
    array.setflags(write=False)
    return array


def frozen_ints(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> IntArray:
    """Return a read-only int64 copy of ``values`` after checking its shape."""
    array = np.array(values, dtype=np.int64, order="C")
    _check_shape(array.shape, shape, name)
    array.setflags(write=False)
    return array


def _check_shape(actual: tuple[int, ...], shape: tuple[int | None, ...], name: str) -> None:
    matches = len(actual) == len(shape) and all(
        want is None or want == have for want, have in zip(shape, actual, strict=True)
    )
    if not matches:
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise InputError(f"{name} has shape {actual}, expected {wanted}")


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
