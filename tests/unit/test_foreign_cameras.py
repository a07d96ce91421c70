# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.models.camera import CameraModel
from armscan.storage.documents import read_foreign_camera
from armscan.storage.foreign import camera_info_yaml
from rigs.plain_scanner import plain_camera

CAMERA = plain_camera(
    (1430.123456789, 1425.5), (478.25, 642.1), (960, 1280), [-0.2, 0.08, 6e-4, -1e-17, 0.01]
)
FISHEYE = CameraModel.from_parameters(
    [230.0, 229.5, 472.0, 305.0, 0.02, -0.004, 0.0, 0.0, 0.001], 960, 600, "fisheye"
)
ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336,
         0.000000, 437.302876, 243.738352, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000]
"""


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (1, 8)])
def test_files_written_by_opencv(tmp_path: Path, suffix: str, shape: tuple[int, int]) -> None:
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 960)
    storage.write("image_height", 1280)
    storage.write("camera_matrix", CAMERA.matrix)
    coefficients = np.zeros(shape[0] * shape[1])
    coefficients[:5] = CAMERA.distortion
    storage.write("distortion_coefficients", coefficients.reshape(shape))
    storage.write("avg_reprojection_error", 0.25)
    storage.release()
    found = read_foreign_camera(path)
    assert np.array_equal(found.camera.parameters, CAMERA.parameters)
    assert (found.camera.width_px, found.camera.height_px) == (960, 1280)
    assert found.rms_px == 0.25
    assert not found.has_covariance
    assert not found.covariance.any()
    assert np.isnan(found.sigma_point_px)


def test_plain_json_with_nested_lists(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(
        '{"camera_matrix": [[500, 0, 320], [0, 501, 240], [0, 0, 1]], '
        '"dist_coeff": [[-0.1, 0.02, 0.001, 0.002]], "image_size": [640, 480]}'
    )
    camera = read_foreign_camera(path).camera
    assert camera.parameters.tolist() == [500, 501, 320, 240, -0.1, 0.02, 0.001, 0.002, 0.0]


def test_names_of_the_usual_script(tmp_path: Path) -> None:
    """``mtx`` and ``dist``, as OpenCV's tutorial calls them."""
    path = tmp_path / "camera.json"
    path.write_text(
        '{"mtx": [[500, 0, 320], [0, 501, 240], [0, 0, 1]], '
        '"dist": [[-0.1, 0.02, 0.001, 0.002, 0]], "image_size": [640, 480]}'
    )
    assert read_foreign_camera(path).camera.parameters.tolist()[:5] == [500, 501, 320, 240, -0.1]


def test_ros_camera_info(tmp_path: Path) -> None:
    path = tmp_path / "left.yaml"
    path.write_text(ROS)
    camera = read_foreign_camera(path).camera
    assert camera.fx_px == 438.783367
    assert camera.cy_px == 243.738352
    assert camera.distortion.tolist() == [-0.361976, 0.110510, 0.001014, 0.000505, 0.0]
    path.write_bytes(b"\xef\xbb\xbf---\r\n" + ROS.replace("\n", "\r\n").encode())
    assert np.array_equal(read_foreign_camera(path).camera.parameters, camera.parameters)


def test_ros_export_reads_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "out.yaml"
    path.write_text(camera_info_yaml(CAMERA))
    found = read_foreign_camera(path).camera
    assert np.array_equal(found.parameters, CAMERA.parameters)
    assert (found.width_px, found.height_px) == (960, 1280)
    text = path.read_text()
    assert "distortion_model: plumb_bob" in text
    assert "camera_name: camera" in text
    assert "data: [-0.2, 0.08, 0.0006, -1.0e-17, 0.01]" in text


def test_a_fisheye_reads_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "wide.yaml"
    path.write_text(camera_info_yaml(FISHEYE))
    assert "distortion_model: equidistant" in path.read_text()
    assert "data: [0.02, -0.004, 0.001, 0.0]" in path.read_text()
    found = read_foreign_camera(path).camera
    assert found.lens == "fisheye"
    assert np.array_equal(found.parameters, FISHEYE.parameters)


BAD = {
    "empty": ("", "empty|not a camera calibration"),
    "text": ("hello", "not a camera calibration"),
    "cut short": (ROS[:150], "camera_matrix|not a camera calibration"),
    "no matrix": (ROS.replace("camera_matrix", "something"), "no camera_matrix"),
    "no distortion": (ROS.replace("distortion_coefficients", "x"), "no distortion_coefficients"),
    "no size": (ROS.replace("image_width", "x"), "image size"),
    "other lens": (ROS.replace("plumb_bob", "division"), "division"),
    "fisheye of five": (ROS.replace("plumb_bob", "equidistant"), "expected k1 k2 k3 k4"),
    "fourth term of a fisheye": (
        ROS.replace("plumb_bob", "equidistant").replace("0.000505, 0.000000]", "0.000505]"),
        "k4 = 0.000505",
    ),
    "nan": (ROS.replace("438.783367", ".Nan"), "not finite|not a"),
    "negative": (ROS.replace("438.783367", "-438.7"), "positive"),
    "in parts of the image": (ROS.replace("438.783367", "0.6856"), "focal length of 0.6856 px"),
    "skew": (ROS.replace("[438.783367, 0.000000", "[438.783367, 2.5"), "skew"),
    "transposed": (
        ROS.replace("[438.783367, 0.000000, 305.593336", "[438.783367, 0.0, 0.0").replace(
            "0.000000, 0.000000, 1.000000]", "305.5, 243.7, 1.0]"
        ),
        "order of rows and columns",
    ),
    "eight numbers": (ROS.replace("0.000000, 0.000000, 1.000000]", "0.0, 0.0]"), "8 numbers"),
    "rational": (
        ROS.replace("0.000505, 0.000000]", "0.000505, 0.0, 0.1, 0.2, 0.3]"),
        "8 distortion coefficients",
    ),
    "list of images": (
        "<?xml version='1.0'?><opencv_storage><imagelist>a.jpg b.jpg</imagelist></opencv_storage>",
        "no camera_matrix",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name(tmp_path: Path, name: str) -> None:
    content, words = BAD[name]
    path = tmp_path / "bad.yaml"
    path.write_text(content)
    with pytest.raises(FileFormatError, match=words) as caught:
        read_foreign_camera(path)
    assert "bad.yaml" in str(caught.value)


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError):
        read_foreign_camera(tmp_path / "nothing.yaml")
    binary = tmp_path / "photo.png"
    binary.write_bytes(bytes(range(256)))
    with pytest.raises(FileFormatError, match="not a camera calibration"):
        read_foreign_camera(binary)
