# SPDX-License-Identifier: Apache-2.0
"""Conversions keep every number they promise, and say what they drop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from armscan.errors import ArmscanError, FileFormatError, OptionError, OutputError
from armscan.storage.clouds import convert_file, write_cloud
from armscan.storage.documents import (
    read_camera_calibration,
    read_scanner_calibration,
    read_sensor_calibration,
    scanner_document,
)
from rigs.calibration_documents import scanner_calibration
from rigs.inspection_clouds import cloud_of

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


def test_the_camera_of_a_scanner_is_that_of_its_sensor(tmp_path: Path) -> None:
    scanner = tmp_path / "scanner.json"
    scanner.write_bytes(scanner_document(scanner_calibration(has_sensor=True)))
    conversion = convert_file(scanner, tmp_path / "camera.yaml")
    assert {"light sheets", "hand-eye"} <= {*conversion.losses}
    found = read_camera_calibration(tmp_path / "camera.yaml").camera
    sensor = read_scanner_calibration(scanner).sensor
    assert sensor is not None
    assert found.fx_px == sensor.camera.camera.fx_px
    scanner.write_bytes(scanner_document(scanner_calibration(has_sensor=False)))
    with pytest.raises(FileFormatError, match="delivers points"):
        convert_file(scanner, tmp_path / "none.yaml")


def test_no_conversion_replaces_what_it_reads(tmp_path: Path) -> None:
    path = tmp_path / "cloud.xyz"
    write_cloud(path, cloud_of(np.eye(3)))
    before = path.read_bytes()
    with pytest.raises(OutputError, match="is read, and would be replaced"):
        convert_file(path, path, is_overwriting=True)
    assert path.read_bytes() == before


def test_only_what_the_source_had_is_said_to_be_lost(tmp_path: Path) -> None:
    own, plain = tmp_path / "own.csv", tmp_path / "plain.xyz"
    write_cloud(own, cloud_of(np.eye(3)))
    assert convert_file(own, tmp_path / "own.ply").losses == ()
    lost = convert_file(own, plain).losses
    assert "sigma_mm and covariance" in lost
    assert "normals" not in lost
    assert convert_file(plain, tmp_path / "again.xyz").losses == ("digits beyond 0.1 nm",)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj"])
def test_a_model_becomes_the_same_triangles_as_stl(tmp_path: Path, suffix: str) -> None:
    box = trimesh.creation.box((30.0, 20.0, 10.0))
    source, target = tmp_path / f"box{suffix}", tmp_path / "out.stl"
    box.export(source)
    told = convert_file(source, target)
    assert told.what == "model to STL" and "names of faces" in told.losses
    written = trimesh.load(target)
    assert isinstance(written, trimesh.Trimesh)
    assert len(written.faces) == 12 and written.is_watertight
    assert written.volume == pytest.approx(6000.0, rel=1e-6)
    with pytest.raises(OutputError, match="exists"):
        convert_file(source, target)


def test_a_cloud_becomes_no_stl(tmp_path: Path) -> None:
    cloud = cloud_of(np.random.default_rng(1).uniform(size=(50, 3)))
    for name, word in (("cloud.ply", "no faces"), ("cloud.pcd", "armscan mesh")):
        write_cloud(tmp_path / name, cloud)
        with pytest.raises(ArmscanError, match=word):
            convert_file(tmp_path / name, tmp_path / "out.stl")
    assert not (tmp_path / "out.stl").exists()


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
