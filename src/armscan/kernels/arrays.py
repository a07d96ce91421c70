# SPDX-License-Identifier: Apache-2.0
"""Array types of the kernels, for Numba and for the type checker.

Inputs are declared read-only, so that frozen records and writable arrays share one compiled
version.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

Float32Array: TypeAlias = NDArray[np.float32]
Float64Array: TypeAlias = NDArray[np.float64]
Int64Array: TypeAlias = NDArray[np.int64]
MaskArray: TypeAlias = NDArray[np.uint8]
MapArray: TypeAlias = NDArray[np.int32]

IMAGE_IN = types.Array(types.float32, 2, "C", readonly=True)
MASK_IN = types.Array(types.uint8, 2, "C", readonly=True)
TAPS_IN = types.Array(types.float32, 2, "C", readonly=True)
TAPS_OUT = types.Array(types.float32, 2, "C")
TABLE_IN = types.Array(types.float64, 2, "C", readonly=True)
FLOATS_IN = types.Array(types.float64, 1, "C", readonly=True)
INTS_IN = types.Array(types.int64, 1, "C", readonly=True)
TABLE_OUT = types.Array(types.float64, 2, "C")
FLOATS_OUT = types.Array(types.float64, 1, "C")
INTS_OUT = types.Array(types.int64, 1, "C")
ROW_OUT = types.Array(types.float32, 1, "C")

COLUMN = 0
"""A point at an integer column: its centre was sought down that column."""
ROW = 1
"""A point at an integer row: its centre was sought along that row."""
