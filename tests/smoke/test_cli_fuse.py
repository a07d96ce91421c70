# SPDX-License-Identifier: Apache-2.0
"""``armscan fuse``: one point a voxel, written whole or not at all."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.cli import main
from armscan.fusion.voxel_map import VoxelMap
from armscan.reconstruction.place import merge_clouds
from armscan.records.cloud import DELIVERED
from armscan.storage import clouds as clouds_module
from armscan.storage.clouds import ply_bytes, read_ply
from armscan.storage.documents import scanner_document
from rigs.long_scan import stripes
from rigs.scan_fake import line_image, looking_down, scanner


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    found = [
        replace(cloud, normals=np.tile([0.0, 0.0, 1.0], (len(cloud), 1))) for cloud in stripes(12)
    ]
    (tmp_path / "a.ply").write_bytes(ply_bytes(merge_clouds(found[:6])))
    (tmp_path / "b.ply").write_bytes(ply_bytes(replace(merge_clouds(found[6:]), forced=("why",))))
    return tmp_path


def test_two_clouds_become_one(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds_module, "PIECE_POINTS", 130)
    names = [str(folder / name) for name in ("a.ply", "b.ply")]
    output = folder / "fused.ply"
    assert main(["fuse", *names, "--voxel", "1.5", "-o", str(output), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    parts = [read_ply(Path(name)) for name in names]
    voxels = VoxelMap(1.5)
    voxels.add(parts[0])
    voxels.add(parts[1])
    (wanted,) = voxels.fused()
    found = read_ply(output)
    assert told["n_points"] == len(found) == len(wanted.cloud)
    assert told["n_measured"] == sum(map(len, parts))
    np.testing.assert_allclose(found.points_mm, wanted.cloud.points_mm, atol=1e-12)
    np.testing.assert_allclose(found.sigma_noise_mm, wanted.cloud.sigma_noise_mm, rtol=1e-12)
    assert found.forced == ("why",)
    assert found.normals is not None
    table = clouds_module.parse_ply(output.read_bytes(), "fused").table
    assert int(table["n_points"].sum()) == told["n_measured"]
    assert "why" in output.with_suffix(".html").read_text()


def test_clouds_in_the_frame_of_a_sensor_that_may_have_moved_are_warned_of(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [str(folder / name) for name in ("a.ply", "b.ply")]
    words = ["fuse", *names, "--voxel", "1.5", "--json", "-o"]
    warned = []
    for frame in ("Base", "Sensor"):
        for name in names:
            cloud = replace(read_ply(Path(name)), frame=frame)
            Path(name).write_bytes(ply_bytes(cloud))
        assert main([*words, str(folder / f"{frame}.ply")]) == 0
        told = json.loads(capsys.readouterr().out)["warnings"]
        warned.append(any("head and object stood still" in text for text in told))
    assert warned == [False, True]


def test_noise_whose_reach_is_not_known_is_warned_of(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It averages out as if each point had its own, which the sigma says without a word."""
    known = read_ply(folder / "a.ply")
    known = replace(known, noise_length=np.ones(len(known)))
    plain = replace(read_ply(folder / "b.ply"), noise_length=None)
    (folder / "a.ply").write_bytes(ply_bytes(known))
    (folder / "b.ply").write_bytes(ply_bytes(plain))
    (folder / "c.ply").write_bytes(
        ply_bytes(replace(plain, sheet_names=(DELIVERED,), sheet=np.zeros(len(plain), np.int64)))
    )
    words = ["fuse", *(str(folder / f"{name}.ply") for name in "abc"), "--voxel", "1.5", "--json"]
    assert main([*words, "-o", str(folder / "fused.ply")]) == 0
    told = json.loads(capsys.readouterr().out)["warnings"]
    found = [text for text in told if "share the stripe's noise" in text]
    assert [text[:6] for text in found] == ["b.ply:", "c.ply:"]
    assert "reconstruct again" in found[0] and "delivers profiles does not tell" in found[1]
    assert "share the stripe" in (folder / "fused.html").read_text(encoding="utf-8")


def test_how_the_clouds_of_others_were_read_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Numbers of points that stand before x, and a plate in metres, in text and as binary PLY."""
    plate = np.stack(np.meshgrid(np.arange(8) / 20.0, np.arange(6) / 20.0, [1.0]), axis=-1)
    points = plate.reshape(-1, 3)
    numbered = np.column_stack([np.arange(1, 49), 1000.0 * points])
    np.savetxt(tmp_path / "numbered.txt", numbered, fmt="%.9g")
    np.savetxt(tmp_path / "metres.xyz", points, fmt="%.9g")
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 48\n{properties}end_header\n"
    (tmp_path / "metres.ply").write_bytes(header.encode() + points.tobytes())
    wanted = {
        "numbered.txt": "counts the lines",
        "metres.xyz": "look like metres",
        "metres.ply": "look like metres",
    }
    for name, words in wanted.items():
        output = tmp_path / f"{name}-fused.ply"
        command = ["fuse", str(tmp_path / name), "--voxel", "1", "-o", str(output)]
        assert main(command) == 0
        told = capsys.readouterr()
        assert re.search(rf"{name}:.*{words}", re.sub(r"\s+", " ", told.out + told.err))
        assert words in output.with_suffix(".html").read_text(encoding="utf-8")
        assert main(["convert", str(tmp_path / name), str(tmp_path / f"{name}.obj")]) == 0
        told = capsys.readouterr()
        assert words in re.sub(r"\s+", " ", told.out + told.err)


def test_a_sigma_that_is_not_known_is_no_zero_on_the_page(folder: Path) -> None:
    for name in ("a", "b"):
        assert main(["convert", str(folder / f"{name}.ply"), str(folder / f"{name}.xyz")]) == 0
    clouds = [str(folder / "a.xyz"), str(folder / "b.xyz")]
    assert main(["fuse", *clouds, "--voxel", "1.5", "-o", str(folder / "plain.ply")]) == 0
    page = (folder / "plain.html").read_text(encoding="utf-8")
    assert "Standard deviations are not known." in page
    assert "sigma 0 µm" not in page


def test_points_that_would_count_twice_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same file, a copy of it, and a fused cloud."""
    first, copy, fused = folder / "a.ply", folder / "copy.ply", folder / "fused.pcd"
    copy.write_bytes(first.read_bytes())
    for words in ([first, first], [first, copy]):
        told = ["fuse", *map(str, words), "--voxel", "1", "-o", str(folder / "c.ply")]
        assert main(told) == 2
        assert "would count twice" in capsys.readouterr().err
    size = ["--voxel", "1.5"]
    assert main(["fuse", str(first), str(folder / "b.ply"), *size, "-o", str(fused)]) == 0
    assert "does not hold" not in capsys.readouterr().out
    assert main(["fuse", str(fused), str(first), "-o", str(folder / "c.ply"), *size]) == 2
    assert "the cloud is a fused one" in capsys.readouterr().err
    assert not (folder / "c.ply").exists()


def test_no_sigma_is_told_of_points_without_covariance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n")
    (tmp_path / "b.xyz").write_text("1 2 9\n4 5 16\n")
    words = ["fuse", str(tmp_path / "a.xyz"), str(tmp_path / "b.xyz"), "--voxel", "1"]
    assert main([*words, "-o", str(tmp_path / "c.ply")]) == 0
    text = capsys.readouterr().out
    assert re.search("Sigma of a point +not known", text)
    assert re.search("Noise left in it +not known", text)
    assert "How far to trust" not in (tmp_path / "c.html").read_text()
    assert main([*words, "-o", str(tmp_path / "d.ply"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sigma_median_mm"] is None


@pytest.mark.parametrize(
    "case", ["missing", "empty", "cut", "nan", "frame", "size", "suffix", "exists"]
)
def test_bad_input_is_refused_and_nothing_is_left(
    folder: Path, case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    first, size, output = folder / "a.ply", "1", folder / "fused.ply"
    data = first.read_bytes()
    if case == "missing":
        first.unlink()
    elif case == "empty":
        first.write_bytes(b"")
    elif case == "cut":
        first.write_bytes(data[:-100])
    elif case == "nan":
        first.write_bytes(data[:-100] + b"\xff" * 100)
    elif case == "frame":
        first.write_bytes(data.replace(b"comment frame Base\n", b"comment frame Part\n"))
    elif case == "size":
        size = "-1"
    elif case == "suffix":
        output = folder / "fused.stl"
    else:
        output = folder / "b.ply"
    before = sorted(path.name for path in folder.iterdir())
    words = [str(first), str(folder / "b.ply"), "--voxel", size, "-o", str(output)]
    assert main(["fuse", *words]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert sorted(path.name for path in folder.iterdir()) == before


def write_scan(folder: Path, n: int) -> tuple[Path, Path]:
    """A folder recording of n lines over a plate, 0.4 mm apart, and its scanner's document."""
    rng = np.random.default_rng(0)
    recording = folder / "scan"
    recording.mkdir()
    exposures = ["index,t_ns,camera,file,lasers,trigger_id"]
    arm = ["t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz,trigger_id"]
    for k in range(n):
        pose = looking_down(0.4 * k)
        grey = np.clip(np.round(line_image(pose, rng)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(recording / f"{k}.png"), grey)
        exposures.append(f"{k},{1000 * (k + 1)},0,{k}.png,A,{k}")
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        numbers = [float(value) for value in (*pose.translation_mm, w, x, y, z)]
        arm.append(f"{1000 * (k + 1)},{','.join(map(repr, numbers))},{k}")
    (recording / "exposures.csv").write_text("\n".join(exposures) + "\n")
    (recording / "arm.csv").write_text("\n".join(arm) + "\n")
    document = folder / "scanner.json"
    document.write_bytes(scanner_document(scanner()))
    return recording, document


def test_a_scan_thinned_as_it_is_written_is_its_cloud_fused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`reconstruct --voxel` and `fuse` of the whole cloud make the same points."""
    recording, scanner = write_scan(tmp_path, n=24)
    words = ["reconstruct", str(recording), "--scanner", str(scanner), "--no-cache", "--json"]
    whole, thin, fused = (tmp_path / f"{name}.ply" for name in ("whole", "thin", "fused"))
    assert main([*words, "-o", str(whole)]) == 0
    n_points = json.loads(capsys.readouterr().out)["n_points"]
    assert main([*words, "-o", str(thin), "--voxel", "0.5"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert main(["fuse", str(whole), "--voxel", "0.5", "-o", str(fused)]) == 0
    found, wanted = read_ply(thin), read_ply(fused)
    assert told["n_points"] == n_points > 2 * told["n_fused"]
    assert told["n_fused"] == len(found) == len(wanted)
    assert found.calibrations == wanted.calibrations != ()
    # the file of the whole cloud holds its numbers in single precision
    np.testing.assert_allclose(found.points_mm, wanted.points_mm, atol=1e-5)
    np.testing.assert_allclose(found.covariance_mm2, wanted.covariance_mm2, rtol=1e-4, atol=1e-9)
    assert main([*words, "-o", str(tmp_path / "no.ply"), "--voxel", "-1"]) == 2
    assert "voxels of -1 mm" in capsys.readouterr().err
    assert not (tmp_path / "no.ply").exists()
