# SPDX-License-Identifier: Apache-2.0
"""Clouds: PLY loses nothing and is what other programs expect; XYZ says what it loses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.jobs.info import describe_files
from armscan.records.cloud import PointCloud
from armscan.storage.clouds import XYZ_LOSES, parse_ply, ply_bytes, read_cloud, read_ply, xyz_bytes

ARRAYS = (
    "points_mm", "covariance_mm2", "sigma_noise_mm", "sheet", "exposure", "segment", "intensity",
)  # fmt: skip


def cloud(n: int = 50, has_normals: bool = True) -> PointCloud:
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(n, 3, 3)) * 0.01
    covariance = factor @ np.swapaxes(factor, 1, 2)
    normals = rng.normal(size=(n, 3))
    return PointCloud(
        frame="Sensor",
        points_mm=rng.normal(size=(n, 3)) * 100,
        covariance_mm2=(covariance + np.swapaxes(covariance, 1, 2)) / 2,
        sigma_noise_mm=rng.uniform(0.001, 0.1, n),
        sheet=rng.integers(0, 2, n),
        sheet_names=("A.1", 'B "ü"\n2'),
        exposure=rng.integers(0, 3, n),
        exposure_sources=("on 1.png", "on2.png", "größe.png"),
        segment=rng.integers(0, 9, n),
        intensity=rng.uniform(0, 255, n),
        normals=normals / np.linalg.norm(normals, axis=1)[:, None] if has_normals else None,
        noise_length=rng.uniform(1.0, 12.0, n) if has_normals else None,
    )


@pytest.mark.parametrize("n", [0, 1, 50])
@pytest.mark.parametrize("has_normals", [True, False])
def test_ply_round_trip_is_exact(tmp_path: Path, n: int, has_normals: bool) -> None:
    before = cloud(n, has_normals)
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply_bytes(before))
    after = read_ply(path)
    assert (after.frame, after.sheet_names, after.exposure_sources) == (
        before.frame, before.sheet_names, before.exposure_sources,
    )  # fmt: skip
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    if before.normals is None or before.noise_length is None:
        assert after.normals is None
        assert after.noise_length is None
    else:
        assert after.noise_length is not None
        np.testing.assert_array_equal(before.noise_length, after.noise_length)
        np.testing.assert_array_equal(before.normals, after.normals)


def test_ply_is_read_by_hand() -> None:
    """An independent reading of the bytes, after the format's specification."""
    before = cloud()
    data = ply_bytes(before)
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 50" in lines
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    table = np.frombuffer(
        body, [(name, {"double": "<f8", "int": "<i4"}[kind]) for kind, name in properties]
    )
    np.testing.assert_array_equal(table["y"], before.points_mm[:, 1])
    np.testing.assert_array_equal(table["cov_xz_mm2"], before.covariance_mm2[:, 0, 2])
    np.testing.assert_array_equal(table["sigma_mm"], before.sigma_mm)
    assert 'comment exposure 2 "gr\\u00f6\\u00dfe.png"' in lines


@pytest.mark.parametrize("order", ["ascii", "binary_big_endian"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_ply_of_other_programs_is_understood(order: str, line_end: str) -> None:
    header = line_end.join(
        [
            "ply",
            f"format {order} 1.0",
            "element vertex 2",
            "property float x",
            "property uchar red",
            "element face 0",
            "property list uchar int vertex_indices",
            "end_header",
            "",
        ]
    ).encode()
    table = np.array([(1.5, 7), (-2.25, 255)], dtype=[("x", ">f4"), ("red", "u1")])
    body = table.tobytes() if order != "ascii" else b"1.5 7\n-2.25 255\n"
    found = parse_ply(header + body, "x.ply").table
    assert found["x"].tolist() == [1.5, -2.25]
    assert found["red"].tolist() == [7, 255]


def test_broken_ply_has_a_reason(tmp_path: Path) -> None:
    data = ply_bytes(cloud())
    path = tmp_path / "cloud.ply"
    for broken, message in (
        (data[:-1], "holds 49 of 50 points"),
        (data[:40], "complete header"),
        (data.replace(b"double intensity", b"double intensitz"), "has no intensity"),
        (data.replace(b"frame Sensor", b"frame Nobody"), "name the frame"),
        (data.replace(b"property double x", b"property quad x"), "not understood"),
        (data.replace(b'comment sheet 1 "B', b"comment sheet 1 B "), "damaged"),
    ):
        path.write_bytes(broken)
        with pytest.raises(FileFormatError, match=message):
            read_ply(path)


def test_xyz_says_what_it_loses() -> None:
    before = cloud()
    text = xyz_bytes(before).decode()
    assert text.startswith("# x_mm y_mm z_mm in frame Sensor")
    assert all(loss in text.splitlines()[0] for loss in XYZ_LOSES)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    found = np.array([line.split() for line in lines], dtype=float)
    np.testing.assert_allclose(found, before.points_mm, atol=0.51e-7, rtol=0)


@pytest.mark.parametrize("suffix", [".ply", ".xyz"])
@pytest.mark.parametrize("is_simulated", [True, False])
def test_a_cloud_says_that_it_is_simulated(tmp_path: Path, suffix: str, is_simulated: bool) -> None:
    """In the file itself, which is moved away from the recording."""
    path = tmp_path / f"cloud{suffix}"
    before = replace(cloud(), is_simulated=is_simulated)
    path.write_bytes(ply_bytes(before) if suffix == ".ply" else xyz_bytes(before))
    after = read_cloud(path)
    assert after.is_simulated is is_simulated
    assert after.frame == "Sensor"
    (described,) = describe_files([str(path)]).data["items"] if suffix == ".ply" else ({},)
    assert described.get("simulated", is_simulated) is is_simulated
