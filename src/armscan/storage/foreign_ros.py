# SPDX-License-Identifier: Apache-2.0
"""Cameras as ROS ``camera_info`` YAML.

Reading is `armscan.storage.foreign_opencv.read_foreign_camera`: the keys, the order of the
coefficients and the pixel origin (centre of the first pixel) are the same.
"""

from __future__ import annotations

from collections.abc import Iterable

from armscan.errors import InputError
from armscan.models.camera import CameraModel


def camera_info_yaml(
    camera: CameraModel, name: str = "camera", *, comments: Iterable[str] = ()
) -> str:
    """Text of a ``camera_info`` file with the model ``plumb_bob``.

    Rectification is the identity and the projection matrix repeats the intrinsics: a single
    camera. Numbers are written so that reading them back gives the same floats.

    Parameters
    ----------
    camera
        The camera.
    name
        ``camera_name``: letters, digits, ``_``, ``/`` and ``-``.
    comments
        Why the calibration was refused, if it was and was written all the same.

    Raises
    ------
    InputError
        If the name holds other characters.
    """
    if not name or not all(letter.isalnum() or letter in "_/-" for letter in name):
        raise InputError(
            f"camera name {name!r} cannot be written", remedy="use letters, digits, _ / and -"
        )
    matrix = camera.matrix
    lines = [
        *(f"# forced: {' '.join(comment.split())}" for comment in comments),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        f"camera_name: {name}",
        *_matrix("camera_matrix", 3, 3, matrix.ravel().tolist()),
        "distortion_model: plumb_bob",
        *_matrix("distortion_coefficients", 1, 5, camera.distortion.tolist()),
        *_matrix("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        *_matrix(
            "projection_matrix",
            3,
            4,
            [value for row in matrix.tolist() for value in (*row, 0.0)],
        ),
    ]
    return "\n".join(lines) + "\n"


def _matrix(key: str, rows: int, columns: int, values: Iterable[float]) -> list[str]:
    data = ", ".join(_number(value) for value in values)
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]


def _number(value: float) -> str:
    """Shortest text that reads back as the same float, with the dot that YAML's 1.1 rules want."""
    text = repr(float(value))
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
