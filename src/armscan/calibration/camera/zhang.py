# SPDX-License-Identifier: Apache-2.0
"""Zhang's closed form: intrinsics, poses and distortion as starting values (eqs. 2.30 to 2.38)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import nearest_rotation
from armscan.models.distortion import distort

_B11, _B22, _B13, _B23, _B33 = range(5)
_FREE_CENTRE = (_B11, _B22, _B13, _B23, _B33)
_FIXED_CENTRE = (_B11, _B22, _B33)


def constraint_rows(homography: FloatArray) -> FloatArray:
    """Two equations of one view (eq. 2.34) for ``b = (B11, B12, B22, B13, B23, B33)``.

    Parameters
    ----------
    homography
        (3, 3) from board to image.

    Returns
    -------
    rows
        (2, 6) rows ``v12`` and ``v11 - v22``.

    Notes
    -----
    The thesis prints ``v12 - v22`` in the second row, which is wrong, and lists b as ``B11 B12 B13
    B22 B23 B33``, which does not go with its own ``v_ij`` of eq. 2.33; both are corrected here.
    """

    def v(i: int, j: int) -> FloatArray:
        a, b = homography[:, i], homography[:, j]
        return np.array(
            [
                a[0] * b[0],
                a[0] * b[1] + a[1] * b[0],
                a[1] * b[1],
                a[2] * b[0] + a[0] * b[2],
                a[2] * b[1] + a[1] * b[2],
                a[2] * b[2],
            ]
        )

    return np.stack([v(0, 1), v(0, 0) - v(1, 1)])


def intrinsics_from_homographies(
    homographies: Sequence[FloatArray], width_px: int, height_px: int
) -> FloatArray | FitFailure:
    """Solve eq. 2.34 for the intrinsic matrix without skew.

    First with all five unknowns of B; if noise leaves no positive definite B (eq. 2.32), with the
    principal point in the middle of the image; and then with one focal length.

    Parameters
    ----------
    homographies
        (3, 3) matrices from board to pixels.
    width_px, height_px
        Size of the image.

    Returns
    -------
    matrix
        (3, 3) intrinsic matrix of eq. 2.18, or why there is none.
    """
    centre = np.array([0.5 * (width_px - 1), 0.5 * (height_px - 1)])
    scale = 0.5 * (width_px + height_px)
    to_unit = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, scale]]) / scale
    blocks = []
    for homography in homographies:
        unit = to_unit @ homography
        blocks.append(constraint_rows(unit / np.linalg.norm(unit[:, :2])))
    # Without skew B12 is zero: its column drops out.
    rows = np.concatenate(blocks)[:, [0, 2, 3, 4, 5]]
    for solution in (_solve(rows, _FREE_CENTRE), _solve(rows, _FIXED_CENTRE), _solve_square(rows)):
        matrix = _matrix_from_b(solution)
        if matrix is not None:
            return np.asarray(np.linalg.inv(to_unit) @ matrix)
    return FitFailure(
        "the views do not determine a focal length",
        "tilt the board by 20 to 45 degrees, in a different direction from view to view",
    )


def _solve(rows: FloatArray, free: tuple[int, ...]) -> FloatArray:
    b = np.zeros(5)
    b[list(free)] = np.linalg.svd(rows[:, free])[2][-1]
    return b


def _solve_square(rows: FloatArray) -> FloatArray:
    reduced = np.stack([rows[:, _B11] + rows[:, _B22], rows[:, _B33]], axis=1)
    b = np.zeros(5)
    b[[_B11, _B33]] = np.linalg.svd(reduced)[2][-1]
    b[_B22] = b[_B11]
    return b


def _matrix_from_b(b: FloatArray) -> FloatArray | None:
    """Intrinsic matrix in unit coordinates from B, or None if B is not definite or absurd."""
    b = b * (1.0 if b[_B11] > 0.0 else -1.0)
    if b[_B11] <= 0.0 or b[_B22] <= 0.0:
        return None
    cx, cy = -b[_B13] / b[_B11], -b[_B23] / b[_B22]
    factor = b[_B33] - b[_B13] ** 2 / b[_B11] - b[_B23] ** 2 / b[_B22]
    if factor <= 0.0:
        return None
    fx, fy = np.sqrt(factor / b[_B11]), np.sqrt(factor / b[_B22])
    if max(abs(cx), abs(cy)) > 1.0 or not 0.05 < min(fx, fy) <= max(fx, fy) < 500.0:
        return None
    if not 0.5 < fx / fy < 2.0:
        return None
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pose_from_homography(homography: FloatArray, matrix: FloatArray) -> Pose[Sensor, Board]:
    """Pose of a flat board from its homography (eq. 2.35), made a proper rotation.

    Parameters
    ----------
    homography
        (3, 3) from board mm to pixels.
    matrix
        (3, 3) intrinsic matrix.
    """
    columns = np.linalg.solve(matrix, homography)
    scale = 0.5 * (np.linalg.norm(columns[:, 0]) + np.linalg.norm(columns[:, 1]))
    columns = columns / scale * (1.0 if columns[2, 2] > 0.0 else -1.0)
    third = np.cross(columns[:, 0], columns[:, 1])
    rotation = nearest_rotation(np.column_stack([columns[:, 0], columns[:, 1], third]))
    return Pose(rotation, columns[:, 2])


def linear_distortion(
    ideal_xy: FloatArray, observed_xy: FloatArray, free: Sequence[int]
) -> FloatArray:
    """Distortion by linear least squares, ``K = (L'L)^-1 L'F`` (eqs. 2.36 to 2.38).

    Parameters
    ----------
    ideal_xy
        (N, 2) normalised coordinates predicted without distortion.
    observed_xy
        (N, 2) normalised coordinates observed.
    free
        Indices into ``k1 k2 p1 p2 k3`` of the coefficients to solve; the thesis has the first four.

    Returns
    -------
    coefficients
        (5,) with zeros where not free.
    """
    coefficients = np.zeros(5)
    if not len(free):
        return coefficients
    _, _, by_coefficient = distort(ideal_xy, coefficients)
    design = by_coefficient[:, :, list(free)].reshape(-1, len(free))
    difference = (observed_xy - ideal_xy).reshape(-1)
    coefficients[list(free)] = np.linalg.lstsq(design, difference, rcond=None)[0]
    return coefficients
