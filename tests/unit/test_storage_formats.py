# SPDX-License-Identifier: Apache-2.0
"""Clouds in other programs' formats: what each keeps, what others write, what is refused."""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
import trimesh

from armscan.cli import main
from armscan.errors import ArmscanError, FileFormatError, InputError, OptionError
from armscan.jobs.info import describe_files
from armscan.records.cloud import (
    FIELD_POWERS,
    CalibrationErrors,
    CalibrationMark,
    PointCloud,
    largest_eigenvalue,
)
from armscan.storage.clouds import (
    CLOUD_SUFFIXES,
    CloudPiece,
    cloud_losses,
    ply_parts,
    read_cloud,
    read_cloud_file,
    read_cloud_pieces,
    write_cloud,
)
from armscan.storage.formats import columns
from armscan.storage.formats.las import FINEST_STEP_MM, step_mm
from armscan.storage.parts.meshes import read_part
from rigs.inspection_clouds import cloud_of

NAMES = ("A.1", 'B "ü"\n2')
LOSSLESS = {".ply": 0.0, ".e57": 1e-12, ".pcd": 0.0, ".laz": 0.51e-6, ".las": 0.51e-6, ".csv": 1e-7}
POINTS = np.array([[1.5, -2.0, 3.25], [4.0, 5.0, -6.5], [0.0, 1.0, 2.0]])


def calibration_errors(rng: np.random.Generator, n_errors: int = 4) -> CalibrationErrors:
    """Of two sheets and three exposures."""
    turns = np.linalg.qr(rng.normal(size=(3, 3, 3)))[0]
    return CalibrationErrors(
        turns=turns * np.linalg.det(turns)[:, None, None],
        middle=rng.normal(size=(2, 2)),
        half_width=rng.uniform(0.1, 1.0, (2, 2)),
        modes_mm=rng.normal(size=(2, len(FIELD_POWERS), 3, n_errors)) * 0.01,
        arm_mm=0.0025,
    )


def cloud(n: int = 60, has_normals: bool = True) -> PointCloud:
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(n, 3, 3)) * 0.01
    normals = rng.normal(size=(n, 3))
    return PointCloud(
        frame="Base",
        points_mm=rng.normal(size=(n, 3)) * 100 + [500.0, -300.0, 80.0],
        covariance_mm2=factor @ np.swapaxes(factor, 1, 2),
        sigma_noise_mm=rng.uniform(0.001, 0.1, n),
        sheet=rng.integers(0, 2, n),
        sheet_names=NAMES,
        exposure=rng.integers(0, 3, n),
        exposure_sources=("on 1.png", "on2.png", "größe.png"),
        segment=rng.integers(0, 9, n),
        intensity=rng.uniform(0, 255, n),
        normals=normals / np.linalg.norm(normals, axis=1)[:, None] if has_normals else None,
        noise_length=rng.uniform(1.0, 12.0, n) if has_normals else None,
        seen_from_mm=rng.normal(size=(3, 3)) * 100 if has_normals else None,
        calibration_errors=calibration_errors(rng) if has_normals else None,
        is_simulated=True,
        forced=("rms 9 px", "f unknown"),
        calibrations=(CalibrationMark("a1", "2026-05-01T10:00:00+00:00"), CalibrationMark("b")),
    )


@pytest.mark.parametrize(
    ("suffix", "n", "has_normals"),
    [
        (suffix, n, has_normals)
        for suffix in LOSSLESS
        for n, has_normals in ((60, True), (60, False), (1, True), (0, False))
        if n or suffix != ".csv"  # a table without points is refused
    ],
)
def test_all_that_a_cloud_carries_comes_back(
    tmp_path: Path, suffix: str, n: int, has_normals: bool
) -> None:
    before, path = cloud(n, has_normals), tmp_path / f"cloud{suffix}"
    write_cloud(path, before)
    after = read_cloud(path)
    names = ("frame", "sheet_names", "exposure_sources", "is_simulated", "forced")
    assert [getattr(after, name) for name in names] == [getattr(before, name) for name in names]
    for name in ("sheet", "exposure", "segment"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_allclose(after.points_mm, before.points_mm, rtol=0, atol=LOSSLESS[suffix])
    assert str(after.seen_from_mm) == str(before.seen_from_mm)
    was, found = before.calibration_errors, after.calibration_errors
    assert (found is None) is (was is None)
    if was is not None and found is not None:
        np.testing.assert_allclose(found.turns, was.turns, rtol=0, atol=2e-9)
        for name in ("middle", "half_width", "modes_mm", "arm_mm"):
            np.testing.assert_allclose(getattr(found, name), getattr(was, name), rtol=5e-6)
    nine_digits = 5e-9 if suffix == ".csv" else 0.0
    for name in ("covariance_mm2", "sigma_noise_mm", "intensity", "normals", "noise_length"):
        was, found = getattr(before, name), getattr(after, name)
        assert (found is None) is (was is None)
        if was is not None:
            np.testing.assert_allclose(found, was, rtol=nine_digits, atol=0)


def test_a_calibration_that_is_known_for_certain_has_no_errors(tmp_path: Path) -> None:
    certain = calibration_errors(np.random.default_rng(1), 0)
    write_cloud(tmp_path / "cloud.ply", replace(cloud(), calibration_errors=certain))
    after = read_cloud(tmp_path / "cloud.ply").calibration_errors
    assert after is not None
    assert after.modes_mm.shape == certain.modes_mm.shape


@pytest.mark.parametrize(
    ("was", "now"),
    [
        (b"comment sensor_turn_rad 1 [", b"comment sensor_turn_rad 1 [[], "),
        (b"comment arm_error_mm 0 [0", b"comment arm_error_mm 0 [-"),
        (b"comment arm_error_mm 0 [0.0025]", b"comment arm_error_mm 0 [NaN]"),
        (b"comment calibration_range 1", b"comment another_range 1"),
        (b"comment calibration_error_mm 1", b"comment calibration_error_mn 1"),
    ],
)
def test_damaged_errors_of_a_calibration_are_refused(
    tmp_path: Path, was: bytes, now: bytes
) -> None:
    path = tmp_path / "cloud.ply"
    write_cloud(path, cloud())
    whole = path.read_bytes()
    assert was in whole
    path.write_bytes(whole.replace(was, now, 1))
    with pytest.raises(ArmscanError):
        read_cloud(path)


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_positions_frame_and_marks_stand_in_every_file(tmp_path: Path, suffix: str) -> None:
    before, path = cloud(), tmp_path / f"cloud{suffix}"
    write_cloud(path, before)
    after = read_cloud(path)
    np.testing.assert_allclose(after.points_mm, before.points_mm, rtol=0, atol=5.1e-7)
    assert (after.frame, after.is_simulated, after.forced) == ("Base", True, before.forced)
    assert bool(cloud_losses(before, path)) is (suffix not in (".ply", ".e57", ".pcd"))


def test_converting_says_what_is_lost_and_what_a_mesh_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cloud(tmp_path / "cloud.ply", cloud())
    trimesh.creation.box((3, 4, 5)).export(tmp_path / "box.stl")
    assert main(["convert", str(tmp_path / "cloud.ply"), str(tmp_path / "cloud.e57")]) == 0
    assert "does not hold" not in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "cloud.e57"), str(tmp_path / "cloud.obj")]) == 0
    assert "does not hold: sigma_mm and covariance" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "box.stl"), str(tmp_path / "box.laz")]) == 0
    out = capsys.readouterr().out
    assert "12 faces" in out
    assert "multiples of 1e-06 mm" in out
    assert main(["convert", str(tmp_path / "cloud.ply"), str(tmp_path / "cloud.stl")]) == 2
    assert "points but no faces" in capsys.readouterr().err
    (item,) = describe_files([str(tmp_path / "cloud.e57")]).data["items"]
    assert item["what"] == "point cloud, 60 points"
    assert item["frame"] == "Base"


def test_the_grid_of_a_laz_file_is_as_fine_as_the_cloud_allows(tmp_path: Path) -> None:
    assert step_mm(cloud()) == FINEST_STEP_MM
    wide = replace(cloud(), points_mm=cloud().points_mm * 1000.0)
    assert step_mm(wide) == pytest.approx(1e-3)
    (lost,) = cloud_losses(wide, Path("x.laz"))
    assert "0.001 mm" in lost
    path = tmp_path / "wide.laz"
    write_cloud(path, wide)
    np.testing.assert_allclose(read_cloud(path).points_mm, wide.points_mm, rtol=0, atol=0.51e-3)


@pytest.mark.parametrize("start_mm", [0.0, 0.4, 0.5, 0.9, -1e5 + 0.3, 1e6])
@pytest.mark.parametrize(
    ("width_mm", "step"),
    [
        (4293.9, 1e-6),
        (4294.0, 1e-5),
        (4294.9, 1e-5),
        (4294.967, 1e-5),
        (42948.6, 1e-5),
        (42949.672, 1e-4),
    ],
)
def test_a_grid_reaches_to_the_ends_of_a_cloud(
    tmp_path: Path, start_mm: float, width_mm: float, step: float
) -> None:
    """The rounded offset moved one end beyond the largest multiple: an overflow."""
    ends = np.array([[start_mm, 0.0, 0.0], [start_mm + width_mm, 1.0, 2.0]])
    wide = cloud_of(ends)
    assert step_mm(wide) == pytest.approx(step)
    path = tmp_path / "wide.las"
    write_cloud(path, wide)
    np.testing.assert_allclose(read_cloud(path).points_mm, ends, rtol=0, atol=0.51 * step)


def test_largest_eigenvalues_are_those_of_a_general_solver() -> None:
    """Two equal eigenvalues are the hardest: 2e-8 there, rounding elsewhere."""
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(300, 3, 3)))[0]
    for values in ([1e-6, 1e-6, 1e-10], [1e-4, 1e-5, 0.0], [1e-6] * 3, [0.0] * 3):
        matrices = np.einsum("nij,j,nkj->nik", turn, values, turn)
        oracle = np.linalg.eigvalsh(matrices)[:, -1]
        np.testing.assert_allclose(largest_eigenvalue(matrices), oracle, rtol=2e-8, atol=1e-30)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_meshes_of_another_library_give_their_vertices(tmp_path: Path, suffix: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    path = tmp_path / f"ball{suffix}"
    mesh.export(path)
    found = read_cloud(path).points_mm
    assert len(found) == len(mesh.vertices)
    assert np.linalg.norm(found, axis=1) == pytest.approx(10.0, abs=1e-5)
    np.testing.assert_allclose(found.mean(axis=0), mesh.vertices.mean(axis=0), atol=1e-5)


def test_an_ascii_stl(tmp_path: Path) -> None:
    path = tmp_path / "one.stl"
    mesh = trimesh.Trimesh(POINTS, [[0, 1, 2]])
    path.write_text(trimesh.exchange.stl.export_stl_ascii(mesh))
    assert sorted(read_cloud(path).points_mm.tolist()) == sorted(POINTS.tolist())
    path.write_text(path.read_text()[:-30])
    with pytest.raises(FileFormatError, match="cut short"):
        read_cloud(path)


def test_las_files_of_another_program(tmp_path: Path) -> None:
    """Written by laspy in its oldest point format, with its own grid and grey levels."""
    file = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
    file.header.scales = [0.001] * 3
    file.x, file.y, file.z = POINTS.T
    file.intensity = np.array([7, 8, 9])
    for name in ("old.las", "old.laz"):
        file.write(str(tmp_path / name))
        found = read_cloud(tmp_path / name)
        np.testing.assert_allclose(found.points_mm, POINTS, atol=1e-9)
        assert found.intensity.tolist() == [7.0, 8.0, 9.0]
        assert found.frame == "Part"
        assert not found.covariance_mm2.any()


def test_e57_scans_of_another_program_stand_in_their_places(tmp_path: Path) -> None:
    """Metres, two scans, the second turned by 90 degrees about z and moved; one invalid point."""
    path = tmp_path / "two.e57"
    metres = {f"cartesian{axis}": POINTS[:, k] / 1000 for k, axis in enumerate("XYZ")}
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw({**metres, "intensity": np.array([1.0, 2.0, 3.0])})
    half = np.sqrt(0.5)
    file.write_scan_raw(
        {**metres, "cartesianInvalidState": np.array([0, 0, 1])},
        rotation=np.array([half, 0, 0, half]),
        translation=np.array([1.0, 0.0, 0.0]),
    )
    file.close()
    found = read_cloud(path)
    assert found.exposure_sources == ("two.e57 scan 1", "two.e57 scan 2")
    assert found.exposure.tolist() == [0, 0, 0, 1, 1]
    turned = np.stack([1000 - POINTS[:2, 1], POINTS[:2, 0], POINTS[:2, 2]], axis=1)
    np.testing.assert_allclose(found.points_mm, np.concatenate([POINTS, turned]), atol=2e-4)


PCD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z normal_x normal_y normal_z _ intensity
SIZE 4 4 4 4 4 4 1 4
TYPE F F F F F F U F
COUNT 1 1 1 1 1 1 4 1
WIDTH {width}
HEIGHT {height}
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA {form}
"""


def pcd_file(form: str, points: np.ndarray, height: int = 1) -> bytes:
    """Bytes after the format's description; fields one after another where compressed."""
    n = len(points)
    header = PCD.format(width=n // height, height=height, count=n, form=form).encode()
    kind = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("_", "u1", 4), ("i", "<f4")])
    table = np.zeros(n, kind)
    table["p"], table["n"], table["i"] = points, [0.0, 0.0, 2.0], np.arange(n)
    if form == "binary":
        return header + table.tobytes()
    if form == "ascii":
        rows = (" ".join(map(str, [*row["p"], *row["n"], *row["_"], row["i"]])) for row in table)
        return header + "\n".join(rows).encode()
    fields = [table["p"][:, k].tobytes() for k in range(3)]
    fields += [table["n"][:, k].tobytes() for k in range(3)]
    plain = b"".join(fields) + table["_"].tobytes() + table["i"].tobytes()
    packed = lzf(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


def lzf(plain: bytes) -> bytes:
    """LZF by its description: the longest match of three bytes or more within 8 KiB, at once."""
    out, literals, i = bytearray(), bytearray(), 0
    while i <= len(plain):
        best, back = 0, 0
        for j in range(max(0, i - 8191), i) if i < len(plain) else ():
            length = 0
            while (
                length < 264 and i + length < len(plain) and plain[j + length] == plain[i + length]
            ):
                length += 1
            if length > best:
                best, back = length, i - j - 1
        if (best >= 3 or i == len(plain) or len(literals) == 32) and literals:
            out += bytes([len(literals) - 1]) + literals
            literals = bytearray()
        if i == len(plain):
            break
        if best >= 3:
            n = best - 2
            out += bytes([(min(n, 7) << 5) | back >> 8])
            out += bytes([n - 7]) if n >= 7 else b""
            out += bytes([back & 255])
            i += best
        else:
            literals.append(plain[i])
            i += 1
    return bytes(out)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_of_other_programs(tmp_path: Path, form: str) -> None:
    points = np.round(np.random.default_rng(1).normal(size=(40, 3)) * 8) / 4
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd_file(form, points))
    found = read_cloud(path)
    assert found.points_mm.tolist() == points.tolist()
    assert found.intensity.tolist() == list(range(40))
    assert found.normals is not None
    assert found.normals.tolist() == [[0.0, 0.0, 1.0]] * 40


@pytest.mark.parametrize("name", ["x", "normal_x", "intensity"])
def test_pcd_fields_of_several_values_are_no_coordinates(tmp_path: Path, name: str) -> None:
    """They ended in a ValueError."""
    others = [one for one in ("x", "y", "z", "normal_x", "normal_y", "normal_z") if one != name]
    header = f"FIELDS {' '.join(others)} {name} more\nSIZE{' 4' * (len(others) + 2)}\n"
    header += f"TYPE{' F' * (len(others) + 2)}\nCOUNT{' 1' * len(others)} 3 2\n"
    header += "WIDTH 1\nHEIGHT 2\nPOINTS 2\nDATA ascii\n"
    path = tmp_path / "cloud.pcd"
    path.write_text(header + 2 * (" ".join(["1"] * (len(others) + 5)) + "\n"))
    wanted = {"normal_x": "nx"}.get(name, name)
    with pytest.raises(FileFormatError, match=f"field {wanted} of the PCD file has 3 values"):
        read_cloud(path)


def test_packed_colours_of_an_ascii_pcd_file_are_passed_over(tmp_path: Path) -> None:
    """Numpy warned of numbers that a field of four bytes does not hold."""
    path = tmp_path / "cloud.pcd"
    header = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F I\nCOUNT 1 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    path.write_text(header + "POINTS 1\nDATA ascii\n1.5 -2 3.25 4294967295\n")
    assert read_cloud(path).points_mm.tolist() == [[1.5, -2.0, 3.25]]


@pytest.mark.parametrize("name", ["c.csv", "c.xyz"])
def test_a_table_in_utf_16_is_told_as_such(tmp_path: Path, name: str) -> None:
    """It was told as cut."""
    path = tmp_path / name
    for encoding in ("utf-16", "utf-16-le", "utf-16-be"):
        path.write_bytes("x,y,z\n1.5,-2,3.25\n".encode(encoding))
        with pytest.raises(FileFormatError, match="this is not UTF-8 text"):
            read_cloud(path)


def test_empty_places_of_a_grid_are_no_points_but_nan_in_a_list_is_wrong(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[1] = np.nan
    points = np.concatenate([points, POINTS[:1]])
    path = tmp_path / "grid.pcd"
    path.write_bytes(pcd_file("binary", points, height=2))
    assert len(read_cloud(path)) == 3
    path.write_bytes(pcd_file("binary", points))
    with pytest.raises(FileFormatError, match="empty or nan"):
        read_cloud(path)


def test_columns_of_a_table_are_found_by_their_names(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("id,X,Y,Z,nx,ny,nz\n1,1.5,-2,3.25,0,0,3\n2,4,5,-6.5,0,1,0\n")
    found = read_cloud(path)
    assert found.points_mm.tolist() == POINTS[:2].tolist()
    assert found.normals is not None
    assert found.normals.tolist() == [[0, 0, 1], [0, 1, 0]]
    path.write_text("id,grade,x,y,z\n1,,1.5,-2,3.25\n,,4,5,-6.5\n")
    assert read_cloud(path).points_mm.tolist() == POINTS[:2].tolist()
    path.write_text("x,y,z\n1.5,-2,3.25\n4,,-6.5\n")
    with pytest.raises(FileFormatError, match="empty or nan"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".ply", ".e57", ".laz", ".las", ".pcd", ".stl"])
@pytest.mark.parametrize("kept", [0, 3, 60, 0.3, 0.7, 0.98])
def test_a_file_cut_short_is_refused(tmp_path: Path, suffix: str, kept: float) -> None:
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".stl":
        trimesh.creation.icosphere(subdivisions=2).export(path)
    else:
        write_cloud(path, cloud(500))
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(FileFormatError) as caught:
        read_cloud(path)
    assert caught.value.remedy


@pytest.mark.parametrize("suffix", [".csv", ".xyz"])
def test_a_table_of_ours_is_refused_wherever_it_is_cut(tmp_path: Path, suffix: str) -> None:
    """At a line's end it was read as a whole one; without its count it still is."""
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, cloud(7))
    whole = path.read_bytes()
    assert len(read_cloud(path)) == 7
    for n in range(1, len(whole)):
        path.write_bytes(whole[:n])
        with pytest.raises(ArmscanError) as caught:
            read_cloud(path)
        if whole[:n].count(b"\n") >= whole.count(b"\n") - 6:
            assert "seems cut" in caught.value.what
            assert "line " in caught.value.what
    lines = whole.splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-2]))
    with pytest.raises(FileFormatError, match="tells of 7 points, and it holds 5") as caught:
        read_cloud(path)
    assert "delete the line '# points 7'" in caught.value.remedy
    path.write_bytes(b"".join(line for line in lines[:-2] if line != b"# points 7\n"))
    assert len(read_cloud(path)) == 5
    path.write_bytes(b"".join([*lines, lines[-1]]))
    with pytest.raises(FileFormatError, match="tells of 7 points, and it holds 8"):
        read_cloud(path)


@pytest.mark.parametrize("end", ["4.5,", "4.5,x", "4.5,-", "4"])
def test_a_foreign_table_that_ends_within_a_line_is_told(tmp_path: Path, end: str) -> None:
    path = tmp_path / "cloud.csv"
    path.write_text(f"# points 9\n1.5,2.5,3.5\n1.5,2.5,4.5\n2.5,{end}")
    with pytest.raises(FileFormatError, match=r"seems cut: it ends within line 4, '2\.5,"):
        read_cloud(path)
    path.write_text("# points 9\n1.5,2.5,3.5\n1.5,2.5,4.5\n2.5,4.5,6.5")
    assert len(read_cloud(path)) == 3, "another program's count may be of anything"


@pytest.mark.parametrize("suffix", [".e57", ".laz", ".las", ".pcd"])
def test_damaged_bytes_never_end_in_a_traceback(tmp_path: Path, suffix: str) -> None:
    """Either they are refused in words, or the damage lies where nothing can tell."""
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, cloud(300))
    whole = path.read_bytes()
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(60):
        data = bytearray(whole)
        for place in rng.integers(0, min(len(data), 4000), 6):
            data[place] = rng.integers(0, 256)
        path.write_bytes(bytes(data))
        try:
            read_cloud(path)
        except FileFormatError:
            refused += 1
    assert refused > 10


@pytest.mark.parametrize(("package", "suffix"), [("pye57", ".e57"), ("laspy", ".laz")])
def test_a_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, suffix: str
) -> None:
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, cloud())
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(OptionError, match=r"armscan\[formats\]"):
        read_cloud(path)
    with pytest.raises(OptionError, match=r"armscan\[formats\]"):
        write_cloud(tmp_path / f"other{suffix}", cloud())


def test_columns_that_are_not_carried_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a fused cloud, of what `inspect cad` writes, and of a table."""
    one = CloudPiece(cloud(), n_points=np.arange(len(cloud())))
    fused = tmp_path / "fused.ply"
    fused.write_bytes(b"".join(ply_parts(cloud(), len(cloud()), [one], is_fused=True)))
    for suffix in (".xyz", ".obj"):
        assert main(["convert", str(fused), str(tmp_path / f"copy{suffix}")]) == 0
        text = capsys.readouterr().out
        assert text.count("n_points") == 1
        assert "n_points of a fused cloud" in text
    for suffix in (".ply", ".e57", ".laz", ".pcd", ".csv"):
        assert main(["convert", str(fused), str(tmp_path / f"copy{suffix}")]) == 0
        assert "n_points" not in capsys.readouterr().out
        again = read_cloud_file(tmp_path / f"copy{suffix}").n_points
        assert again is not None
        np.testing.assert_array_equal(again, np.arange(len(cloud())))
    assert main(["clean", str(fused), "-o", str(tmp_path / "clean.ply"), "--density", "9"]) == 0
    assert "the column n_points" in capsys.readouterr().out
    table = tmp_path / "deviations.csv"
    table.write_text("x,y,z,deviation_mm,face\n1,2,3,0.1,1\n4,5,6,0.2,1\n")
    assert main(["convert", str(table), str(tmp_path / "table.ply")]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "the columns deviation_mm, face" in text
    assert "stands for not known" in text
    own = read_cloud_file(tmp_path / "clean.ply")
    assert (own.dropped, own.remarks) == ((), ())


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_a_scan_of_very_many_exposures_is_read_again(tmp_path: Path, suffix: str) -> None:
    """Two lines of the header an exposure: 24 MB here, which no cap may cut."""
    n, path = 200_000, tmp_path / f"long{suffix}"
    places = np.stack([np.arange(n) / 7.0, np.zeros(n), np.ones(n)], axis=1)
    one = cloud_of(np.eye(3), np.array([0, 9, n - 1]))
    long = replace(
        one,
        exposure_sources=tuple(f"camera0/image{k:07d}.png" for k in range(n)),
        seen_from_mm=places,
    )
    write_cloud(path, long)
    found = read_cloud(path)
    assert path.stat().st_size > 16 * 2**20
    assert found.exposure_sources == long.exposure_sources
    assert np.array_equal(found.exposure, long.exposure)
    assert found.seen_from_mm is not None
    assert np.array_equal(found.seen_from_mm, places)
    (piece,) = read_cloud_pieces(path)
    assert piece.cloud.exposure_sources == long.exposure_sources


def test_a_header_that_could_not_be_read_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(columns, "MOST_HEADER_BYTES", 100)
    for suffix in (".ply", ".pcd"):
        with pytest.raises(InputError, match="names of the exposures"):
            write_cloud(tmp_path / f"cloud{suffix}", cloud())
    assert list(tmp_path.iterdir()) == []


def test_covariances_that_are_none_are_refused(tmp_path: Path) -> None:
    """A correlation of 5 between x and y."""
    path, one = tmp_path / "cloud.csv", cloud(3)
    covariance = np.tile(np.eye(3), (3, 1, 1))
    write_cloud(path, replace(one, covariance_mm2=covariance))
    assert np.array_equal(read_cloud(path).covariance_mm2, covariance)
    covariance[1, 0, 1] = covariance[1, 1, 0] = 5.0
    path.unlink()
    write_cloud(path, replace(one, covariance_mm2=covariance))
    with pytest.raises(FileFormatError, match="covariances of point 2 are none"):
        read_cloud(path)


def test_a_part_and_a_cloud_of_an_stl_have_the_same_corners(tmp_path: Path) -> None:
    """A binary file whose header begins with "solid", and an indented text in capitals."""
    box = trimesh.creation.box((3, 4, 5))
    data = trimesh.exchange.stl.export_stl(box)
    text = str(trimesh.exchange.stl.export_stl_ascii(box)).upper().encode()
    for k, content in enumerate((b"solid facet vertex".ljust(80) + data[80:], text)):
        path = tmp_path / f"{k}.stl"
        path.write_bytes(content)
        found = read_cloud(path).points_mm
        assert sorted(found.tolist()) == sorted(box.vertices.tolist())
        assert read_part(path).corners_mm.shape == (12, 3, 3)
