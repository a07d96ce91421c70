# SPDX-License-Identifier: Apache-2.0
"""Size and shape of a ring's image, by which it is told from other things (eqs. 4.19 to 4.21).

The thesis calls P "the contour circumference ... when the angle between the camera and the
non-coding point is 0", and it sets the limit of C to 1.7 for a tilt of about 50 degrees. Both fit
together only if P stays that of the untilted ring while A is the area as seen: the longer half
axis ``a`` of the image does not shrink with tilt, so that ``P = 2 pi a``, ``A = pi a b`` and
``C = P^2 / (4 pi A) = a / b``, which is 1.56 at 50 degrees and 1.7 at 54. With the ellipse's own
circumference C would be 1.10 at 50 degrees and reach 1.7 at 73.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray


def perimeters_px(half_px: FloatArray) -> FloatArray:
    """P (N,) of eq. 4.19 from half axes (N, 2), the shorter one first."""
    return np.asarray(2.0 * np.pi * half_px[:, 1])


def roundness(half_px: FloatArray) -> FloatArray:
    """C (N,) of eq. 4.20 from half axes (N, 2), the shorter one first."""
    area = np.pi * half_px[:, 0] * half_px[:, 1]
    return np.asarray(perimeters_px(half_px) ** 2 / (4.0 * np.pi * area))
