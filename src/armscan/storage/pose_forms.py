# SPDX-License-Identifier: Apache-2.0
"""How rotations are written in tables: quaternion, matrix, Euler angles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.euler import EulerConvention, euler_from_rotations, rotations_from_euler
from armscan.records.session import PoseForm

POSITION: Final = ("x_mm", "y_mm", "z_mm")
FORM_COLUMNS: Final[dict[PoseForm, tuple[str, ...]]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    "euler": ("a_deg", "b_deg", "c_deg"),
    "joints": (),
}
NORM_TOLERANCE = 1e-6
ORTHONORMAL_TOLERANCE = 1e-5
"""Six decimals of nine numbers leave up to about 3e-6."""
FULL_TURNS_DEG = 720.0


def rotations_of_form(
    numbers: FloatArray, form: PoseForm, convention: EulerConvention, places: Sequence[str]
) -> FloatArray:
    """Rotations (N, 3, 3) of numbers (N, C) in the order of `FORM_COLUMNS`.

    A quaternion is w, x, y, z (Hamilton, active), of either sign and norm 1 within 1e-6; a matrix
    is row by row and orthonormal within 1e-5, and the nearest rotation is taken.

    Parameters
    ----------
    numbers
        Finite.
    form, convention
        How they are written.
    places
        (N,) file and line of each, for messages.

    Raises
    ------
    FileFormatError
        If a row is no rotation.
    """
    if form == "quaternion":
        return _from_quaternions(numbers, places)
    if form == "matrix":
        return _from_matrices(numbers.reshape(-1, 3, 3), places)
    largest = np.abs(numbers).max(axis=1, initial=0.0)
    if (largest > FULL_TURNS_DEG).any():
        row = int(np.argmax(largest > FULL_TURNS_DEG))
        raise FileFormatError(
            f"an angle of {largest[row]:g} deg",
            where=places[row],
            remedy="check that positions and angles are in their columns",
        )
    return rotations_from_euler(np.radians(numbers), convention)


def pose_numbers(
    rotations: FloatArray, is_known: BoolArray, form: PoseForm, convention: EulerConvention
) -> FloatArray:
    """Numbers (N, C) in the order of `FORM_COLUMNS`, NaN where the pose is not known."""
    numbers = np.full((len(rotations), len(FORM_COLUMNS[form])), np.nan)
    known = rotations[is_known]
    if not len(known):
        return numbers
    if form == "quaternion":
        numbers[is_known] = np.roll(Rotation.from_matrix(known).as_quat(canonical=True), 1, axis=1)
    elif form == "matrix":
        numbers[is_known] = known.reshape(-1, 9)
    else:
        numbers[is_known] = np.degrees(euler_from_rotations(known, convention))
    return numbers


def _from_quaternions(numbers: FloatArray, places: Sequence[str]) -> FloatArray:
    if not len(numbers):
        return np.zeros((0, 3, 3))
    norms = np.linalg.norm(numbers, axis=1)
    wrong = np.abs(norms - 1.0) > NORM_TOLERANCE
    if wrong.any():
        row = int(np.argmax(wrong))
        raise FileFormatError(
            f"the quaternion's norm is {norms[row]:.8g}, not 1 within {NORM_TOLERANCE:g}",
            where=places[row],
            remedy="write qw,qx,qy,qz with seven decimals or more, each in its own column",
        )
    return np.asarray(Rotation.from_quat(np.roll(numbers, -1, axis=1)).as_matrix())


def _from_matrices(matrices: FloatArray, places: Sequence[str]) -> FloatArray:
    defect = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    is_mirrored = np.linalg.det(matrices) < 0.0
    wrong = (defect > ORTHONORMAL_TOLERANCE) | is_mirrored
    if wrong.any():
        row = int(np.argmax(wrong))
        fact = (
            "mirrors" if is_mirrored[row] else f"is not orthonormal: |R R' - 1| = {defect[row]:.2g}"
        )
        raise FileFormatError(
            f"the matrix {fact}",
            where=places[row],
            remedy="write r11,r12,r13,r21 and so on, row by row, with seven decimals or more",
        )
    left, _, right = np.linalg.svd(matrices)
    is_exact = defect < 1e-14
    return np.where(is_exact[:, None, None], matrices, left @ right)
