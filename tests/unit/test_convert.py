# SPDX-License-Identifier: Apache-2.0
"""Conversions keep every number they promise, and say what they drop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError, OptionError, OutputError
from armscan.storage.clouds import convert_file
from armscan.storage.documents import read_camera_calibration, read_sensor_calibration

GOLDEN = Path(__file__).parents[1] / "golden"


def documents(kind: str) -> list[Path]:
    found = sorted(GOLDEN.rglob(f"*{kind}*.json"))
    assert found
    return found


@pytest.mark.parametrize("kind", ["camera", "sensor"])
def test_camera_keeps_every_bit(tmp_path: Path, kind: str) -> None:
    source = documents(kind)[0]
    target = tmp_path / "camera_info.yaml"
    conversion = convert_file(source, target)
    if kind == "camera":
        camera = read_camera_calibration(source).camera
    else:
        camera = read_sensor_calibration(source).camera.camera
    back = read_camera_calibration(target)
    assert np.array_equal(back.camera.parameters, camera.parameters)
    assert (back.camera.width_px, back.camera.height_px) == (camera.width_px, camera.height_px)
    assert not back.has_covariance
    assert "covariance" in conversion.losses
    assert np.array_equal(
        read_camera_calibration(second(target, tmp_path)).camera.parameters, camera.parameters
    )


def second(first: Path, folder: Path) -> Path:
    """A foreign file converts as well as our own."""
    convert_file(first, folder / "again.yml")
    return folder / "again.yml"


def test_no_such_way(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no conversion"):
        convert_file(documents("camera")[0], tmp_path / "camera.xyz")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_replaced_or_half_written(tmp_path: Path) -> None:
    target = tmp_path / "camera.yaml"
    target.write_text("mine")
    with pytest.raises(OutputError):
        convert_file(documents("camera")[0], target)
    assert target.read_text() == "mine"
    broken = tmp_path / "broken.json"
    broken.write_text('{"schema": ')
    with pytest.raises(FileFormatError):
        convert_file(broken, tmp_path / "new.yaml")
    assert not (tmp_path / "new.yaml").exists()
