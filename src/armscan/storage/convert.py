# SPDX-License-Identifier: Apache-2.0
"""From one file format to another, saying what is lost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from armscan.errors import OptionError
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel
from armscan.storage.atomic import check_outputs, write_files
from armscan.storage.calibration_files import read_calibration, read_camera_calibration
from armscan.storage.clouds import XYZ_LOSES, read_ply, xyz_bytes
from armscan.storage.foreign_ros import camera_info_yaml
from armscan.storage.images import read_bytes
from armscan.storage.json_text import parse_json

YAML_LOSES = ("covariance", "evidence and provenance")


@dataclass(frozen=True, slots=True)
class Conversion:
    """What was converted, in words, what the new file does not hold, and marks of the old one."""

    what: str
    losses: tuple[str, ...]
    forced: tuple[str, ...] = ()


def convert_file(source: Path, output: Path, *, is_overwriting: bool = False) -> Conversion:
    """Write a calibration's camera as ROS ``camera_info``, or a cloud as XYZ.

    Parameters
    ----------
    source
        ``.ply`` of armscan, or any calibration that armscan reads: its own camera or sensor
        document, OpenCV's YAML, XML or JSON, ROS.
    output
        ``.yaml`` for a camera, ``.xyz`` for a cloud.
    is_overwriting
        Replace a file that exists.

    Raises
    ------
    OptionError
        If there is no way from the one kind of file to the other.
    FileFormatError
        If the source cannot be read.
    OutputError
        If the output exists or cannot be written.
    """
    kinds = source.suffix.lower() == ".ply", output.suffix.lower()
    if kinds not in ((True, ".xyz"), (False, ".yaml"), (False, ".yml")):
        raise OptionError(
            f"there is no conversion from {source.name} to {output.name}",
            remedy="convert a calibration to .yaml, or a cloud .ply to .xyz",
        )
    check_outputs((output,), is_overwriting=is_overwriting)
    if kinds[0]:
        cloud = read_ply(source)
        content = xyz_bytes(cloud)
        conversion = Conversion("cloud to XYZ", XYZ_LOSES, cloud.forced)
    else:
        camera, forced = _camera(source)
        content = camera_info_yaml(camera, comments=forced).encode()
        conversion = Conversion("camera to ROS camera_info", YAML_LOSES, forced)
    write_files({output: content}, is_overwriting=is_overwriting)
    return conversion


def _camera(path: Path) -> tuple[CameraModel, tuple[str, ...]]:
    data = read_bytes(path)
    is_own = data.lstrip().startswith(b"{") and "schema" in parse_json(data, str(path))
    calibration = read_calibration(path) if is_own else read_camera_calibration(path)
    if isinstance(calibration, SensorCalibration):
        return calibration.camera.camera, calibration.camera.provenance.forced
    return calibration.camera, calibration.provenance.forced
