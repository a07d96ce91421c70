# SPDX-License-Identifier: Apache-2.0
"""The image of a ring's centre from its two rims, without a camera.

The centre of an ellipse is not the image of the circle's centre. With the homography H of the
ring's plane, the rims are ``Q_k ~ H^-T diag(1, 1, -r_k^2) H^-1``, so that ``Q_2^-1 Q_1`` is similar
to ``diag(1, 1, r_1^2 / r_2^2)``: a double eigenvalue, whose eigenvectors lie on the plane's
vanishing line, and a single one, whose eigenvector is the image of the common centre.

To first order this is ``(c_2 - q c_1) / (1 - q)`` with the ellipses' centres c and ``q = (r_2 /
r_1)^2``: the shift between the centres, continued to radius 0. It uses all that two circles say
about the centre: what else the rims determine (size, axes) is common to both to that order.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.vision.targets.ellipse import Ellipses


def common_centres(outer: Ellipses, inner: Ellipses) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Images of the centres of N rings.

    Parameters
    ----------
    outer, inner
        N conics each; row by row two concentric circles seen in perspective.

    Returns
    -------
    centres_px
        (N, 2).
    covariance_px2
        (N, 2, 2), the two rims' noise taken as independent.
    mismatch
        (N,) half the difference of the two eigenvalues that should be equal, over their mean:
        how far the rims' shapes are from those of concentric circles.
    """
    origin, unit = outer.origin_px, outer.scale_px
    first, dfirst = outer.conics_in(origin, unit)
    second, dsecond = inner.conics_in(origin, unit)
    pencil = np.linalg.solve(second, first)
    eigenvalues, eigenvectors = np.linalg.eig(pencil)
    rows = np.arange(len(pencil))
    single = eigenvalues.real.argmax(axis=1)
    value = eigenvalues[rows, single].real
    vector = eigenvectors[rows, :, single].real
    vector = vector / vector[:, 2:]
    pair = np.stack([eigenvalues[rows, (single + k) % 3] for k in (1, 2)], axis=1)
    mismatch = np.abs(pair[:, 0] - pair[:, 1]) / np.abs(pair.sum(axis=1))
    # (M - e) v = 0 with v_3 = 1, differentiated: three equations for dv_1, dv_2 and de.
    system = pencil - value[:, None, None] * np.eye(3)
    system[:, :, 2] = -vector
    change = np.concatenate([dfirst, -value[:, None, None, None] * dsecond], axis=1)
    changed = np.linalg.solve(second[:, None], change @ vector[:, None, :, None])[..., 0]
    derivative = -np.linalg.solve(system, changed.transpose(0, 2, 1))[:, :2]
    covariance = np.zeros((len(rows), 10, 10))
    covariance[:, :5, :5] = outer.covariance
    covariance[:, 5:, 5:] = inner.covariance
    spread = derivative @ covariance @ derivative.transpose(0, 2, 1)
    centres = origin + unit[:, None] * vector[:, :2]
    return centres, spread * (unit**2)[:, None, None], np.asarray(mismatch)
