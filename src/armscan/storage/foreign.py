# SPDX-License-Identifier: Apache-2.0
"""Calibrations of other programs: OpenCV's YAML, XML or JSON is read, ROS ``camera_info`` read
and written.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.models.camera import CameraModel, Lens
from armscan.storage.codec import LARGEST_SIZE_PX as MOST_PX
from armscan.storage.codec import is_json, parse_json

MATRIX_KEYS = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "mtx")
DISTORTION_KEYS = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distCoeffs",
    "dist_coeffs",
    "dist_coeff",
    "D",
    "dist",
)
WIDTH_KEYS = ("image_width", "image_Width", "width")
HEIGHT_KEYS = ("image_height", "image_Height", "height")
SIZE_KEYS = ("image_size", "imageSize", "img_size")
RMS_KEYS = ("avg_reprojection_error", "rms", "reprojection_error")
PLUMB_BOB = ("", "plumb_bob")
EQUIDISTANT = ("equidistant", "fisheye")
"""OpenCV's fisheye model in ROS and in other programs: k1 k2 k3 k4."""
KEYS = (
    *(MATRIX_KEYS + DISTORTION_KEYS + WIDTH_KEYS + HEIGHT_KEYS + SIZE_KEYS + RMS_KEYS),
    *("distortion_model", "fisheye_model"),
)
"""All that is read of such a file: others may hold the points of all images."""
INNER = ("data",)
MOST_ENTRIES = 100
SKEW_LIMIT = 1e-6
LEAST_FOCAL = 0.01
"""Focal length in widths of the image: below it is no lens, but a matrix in parts of the image."""
N_COEFFICIENTS = 5


def parse_foreign_camera(data: bytes, where: str) -> tuple[CameraModel, float]:
    """Camera of a file that OpenCV (YAML, XML, JSON) or ROS (``camera_info`` YAML) wrote.

    Coefficients beyond ``k1 k2 p1 p2 k3``, of a fisheye beyond ``k1 k2 k3``, are accepted when they
    are zero. With the reprojection error (px) that the file states; NaN for none.

    Raises
    ------
    FileFormatError
        If the file is cut short, has no camera matrix or image size, or describes a lens by
        another model.
    """
    tree = _read_tree(data, where)
    matrix = _matrix(tree, where)
    width, height = _size(tree, where)
    lens = _lens(tree, where)
    if 0.0 < matrix[0, 0] < LEAST_FOCAL * width:
        raise FileFormatError(
            f"camera_matrix has a focal length of {matrix[0, 0]:g} px for an image {width} px wide",
            where=where,
            remedy="write the matrix in pixels: its rows times width and height if it is in parts "
            "of the image",
        )
    try:
        camera = CameraModel(
            fx_px=matrix[0, 0],
            fy_px=matrix[1, 1],
            cx_px=matrix[0, 2],
            cy_px=matrix[1, 2],
            distortion=_distortion(tree, where, lens),
            width_px=width,
            height_px=height,
            lens=lens,
        )
    except InputError as error:
        raise FileFormatError(error.what, where=where, remedy=error.remedy) from error
    rms = _first(tree, RMS_KEYS)
    return camera, float(rms) if isinstance(rms, int | float) else math.nan


def _read_tree(data: bytes, where: str) -> Mapping[str, Any]:
    if is_json(data):
        return parse_json(data, where)
    unreadable = FileFormatError(
        "this is not a camera calibration of armscan, OpenCV or ROS, or it is cut short",
        where=where,
        remedy="name a camera.json, or a YAML, XML or JSON file with camera_matrix and "
        "distortion_coefficients",
    )
    mode = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    try:
        storage = cv2.FileStorage(_with_yaml_header(data.decode("utf-8")), mode)
        tree = _plain(storage.root(), KEYS) if storage.isOpened() else None
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise unreadable from error
    if not isinstance(tree, Mapping):
        raise unreadable
    return tree


def _with_yaml_header(text: str) -> str:
    """OpenCV 4 takes a text for YAML by its first line only, which ROS does not write."""
    start = re.sub(r"\A[\ufeff\s]*(---\s*\n)?", "", text)
    return text if start.startswith(("%YAML", "<?xml", "<opencv")) else f"%YAML:1.0\n---\n{start}"


def _plain(node: cv2.FileNode, keys: Sequence[str], depth: int = 3) -> Any:
    """The content of a node as mappings of these keys, lists, numbers and text."""
    if node.isMap() and depth:
        there = set(node.keys())
        return {key: _plain(node.getNode(key), INNER, depth - 1) for key in keys if key in there}
    if node.isSeq() and depth and node.size() <= MOST_ENTRIES:
        return [_plain(node.at(index), INNER, depth - 1) for index in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isInt() or node.isReal() else None


def _first(tree: Mapping[str, Any], keys: Sequence[str]) -> Any:
    return next((tree[key] for key in keys if tree.get(key) is not None), None)


def _numbers(value: Any, name: str, where: str) -> FloatArray:
    """Numbers of a matrix: nested lists, or a mapping with ``data``."""
    content = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.asarray(content, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"'{name}' is not a matrix of numbers", where=where, remedy="copy the file again"
        ) from error
    if not np.isfinite(numbers).all():
        raise FileFormatError(
            f"'{name}' holds values that are not finite",
            where=where,
            remedy="calibrate the camera again",
        )
    return numbers


def _matrix(tree: Mapping[str, Any], where: str) -> FloatArray:
    value = _first(tree, MATRIX_KEYS)
    if value is None:
        raise FileFormatError(
            "there is no camera_matrix in this file",
            where=where,
            remedy="name the file that the camera calibration wrote",
        )
    numbers = _numbers(value, "camera_matrix", where)
    if numbers.size != 9:
        raise FileFormatError(
            f"camera_matrix has {numbers.size} numbers, expected 9",
            where=where,
            remedy="write fx 0 cx 0 fy cy 0 0 1",
        )
    matrix = numbers.reshape(3, 3)
    if abs(matrix[0, 1]) > SKEW_LIMIT * abs(matrix[0, 0]):
        raise FileFormatError(
            f"camera_matrix has a skew of {matrix[0, 1]:g}",
            where=where,
            remedy="calibrate without skew",
        )
    if np.abs(matrix[[1, 2, 2], [0, 0, 1]]).max() > 0.0 or matrix[2, 2] != 1.0:
        raise FileFormatError(
            "camera_matrix is not [fx 0 cx; 0 fy cy; 0 0 1]",
            where=where,
            remedy="check the order of rows and columns",
        )
    return np.asarray(matrix)


def _distortion(tree: Mapping[str, Any], where: str, lens: Lens) -> FloatArray:
    value = _first(tree, DISTORTION_KEYS)
    if value is None:
        raise FileFormatError(
            "there are no distortion_coefficients in this file",
            where=where,
            remedy="give five zeros for a lens without distortion",
        )
    numbers = _numbers(value, "distortion_coefficients", where)
    if lens == "fisheye":
        return _of_fisheye(numbers, where)
    if numbers.size > N_COEFFICIENTS and np.any(numbers[N_COEFFICIENTS:] != 0.0):
        raise FileFormatError(
            f"the lens is described by {numbers.size} distortion coefficients",
            where=where,
            remedy="calibrate with k1 k2 p1 p2 k3 only",
        )
    if numbers.size not in (0, 4) and numbers.size < N_COEFFICIENTS:
        raise FileFormatError(
            f"distortion_coefficients has {numbers.size} numbers, expected k1 k2 p1 p2 [k3]",
            where=where,
            remedy="calibrate with the plain model of five coefficients",
        )
    coefficients = np.zeros(N_COEFFICIENTS)
    coefficients[: numbers.size] = numbers[:N_COEFFICIENTS]
    return coefficients


def _of_fisheye(numbers: FloatArray, where: str) -> FloatArray:
    if numbers.size != 4:
        raise FileFormatError(
            f"a fisheye lens with {numbers.size} distortion coefficients, expected k1 k2 k3 k4",
            where=where,
            remedy="calibrate with OpenCV's fisheye model, or with `armscan calibrate camera`",
        )
    if numbers[3] != 0.0:
        raise FileFormatError(
            f"the fisheye lens has k4 = {numbers[3]:g}, and only k1 k2 k3 are used here",
            where=where,
            remedy="calibrate with `armscan calibrate camera --distortion fisheye`, or in OpenCV "
            "with fisheye.CALIB_FIX_K4",
        )
    return np.array([numbers[0], numbers[1], 0.0, 0.0, numbers[2]])


def _size(tree: Mapping[str, Any], where: str) -> tuple[int, int]:
    pair = _first(tree, SIZE_KEYS)
    found = pair if pair is not None else [_first(tree, WIDTH_KEYS), _first(tree, HEIGHT_KEYS)]
    is_pair = isinstance(found, Sequence) and len(found) == 2
    if not is_pair or not all(isinstance(n, int | float) and 1 <= n <= MOST_PX for n in found):
        raise FileFormatError(
            "the file does not say for which image size the camera was calibrated",
            where=where,
            remedy="add image_width and image_height",
        )
    return int(found[0]), int(found[1])


def _lens(tree: Mapping[str, Any], where: str) -> Lens:
    """ROS names its lens model; OpenCV's fisheye files have a flag, or free text at most."""
    model = tree.get("distortion_model", "")
    if model in EQUIDISTANT or tree.get("fisheye_model") not in (None, 0, 0.0, False):
        return "fisheye"
    if model not in PLUMB_BOB:
        raise FileFormatError(
            f"the lens model is {model!r}, only plumb_bob and equidistant are read",
            where=where,
            remedy="calibrate with k1 k2 p1 p2 k3",
        )
    return "pinhole"


def camera_info_yaml(camera: CameraModel, comments: Iterable[str] = ()) -> str:
    """Text of a ``camera_info`` file with the model ``plumb_bob``, of a fisheye ``equidistant``.

    Rectification is the identity and the projection matrix repeats the intrinsics: a single
    camera. Numbers are written so that reading them back gives the same floats.

    ``comments`` are why the calibration was refused, if it was and was written all the same.
    """
    matrix = camera.matrix
    model, coefficients = "plumb_bob", camera.distortion.tolist()
    if camera.lens == "fisheye":
        model, coefficients = "equidistant", [*camera.distortion[[0, 1, 4]].tolist(), 0.0]
    lines = [
        *(f"# forced: {' '.join(comment.split())}" for comment in comments),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        "camera_name: camera",
        *_foreign_ros_matrix("camera_matrix", 3, 3, matrix.ravel().tolist()),
        f"distortion_model: {model}",
        *_foreign_ros_matrix("distortion_coefficients", 1, len(coefficients), coefficients),
        *_foreign_ros_matrix(
            "rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        ),
        *_foreign_ros_matrix(
            "projection_matrix",
            3,
            4,
            [value for row in matrix.tolist() for value in (*row, 0.0)],
        ),
    ]
    return "\n".join(lines) + "\n"


def _foreign_ros_matrix(key: str, rows: int, columns: int, values: Iterable[float]) -> list[str]:
    data = ", ".join(_number(value) for value in values)
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]


def _number(value: float) -> str:
    """Shortest text that reads back as the same float, with the dot that YAML's 1.1 rules want."""
    text = repr(float(value))
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
