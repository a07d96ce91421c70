# SPDX-License-Identifier: Apache-2.0
"""``armscan register``: views, an arm that moved, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.records.cloud import PointCloud
from armscan.storage.clouds import CloudPiece, parse_ply, ply_bytes, read_ply
from armscan.storage.documents import read_registration
from armscan.storage.points import markers_csv, read_marker_list
from rigs.inspection_clouds import cloud_of
from rigs.marker_scenes import Walk, marker_set, two_views, walk

Fails = Callable[..., str]
PATCH = np.array([(x, y, 0.0) for x in np.linspace(-30, 30, 13) for y in np.linspace(-20, 20, 9)])


def cloud_in(points_mm: np.ndarray, frame: str) -> PointCloud:
    n = len(points_mm)
    cloud = cloud_of(points_mm, np.zeros(n, dtype=np.int64))
    return replace(cloud, frame=frame, covariance_mm2=np.tile(1e-4 * np.eye(3), (n, 1, 1)))


@pytest.fixture(scope="module")
def scene() -> Walk:
    return walk(np.random.default_rng(1), 4)


@pytest.fixture
def views(scene: Walk, tmp_path: Path) -> list[Path]:
    """Lists with the same patch of the part in each view's cloud, and a stranger."""
    paths = []
    for k, (view, pose) in enumerate(zip(scene.views, scene.part_from_sensor, strict=True)):
        path = tmp_path / f"view{k + 1}.csv"
        path.write_bytes(markers_csv(view))
        back = pose.inverse()
        patch = PATCH @ back.rotation.T + back.translation_mm
        path.with_suffix(".ply").write_bytes(ply_bytes(cloud_in(patch, "Sensor")))
        paths.append(path)
    return paths


def test_views_are_joined_and_their_clouds_coincide(
    views: list[Path], scene: Walk, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, fused = tmp_path / "joined", views[1].with_suffix(".ply")
    counts = np.arange(1, len(PATCH) + 1)
    fused.write_bytes(ply_bytes(CloudPiece(read_ply(fused), n_points=counts)))
    assert main(["register", *map(str, views), "-o", str(folder), "--json"]) == 0
    kept = parse_ply((folder / "view2.ply").read_bytes(), "view2").table["n_points"]
    np.testing.assert_array_equal(kept, counts)
    found = json.loads(capsys.readouterr().out)
    assert found["n_joined"] == 4
    assert found["of"] == "views"
    assert found["common_frame"] == "Part"
    document = read_registration(folder / "registration.json")
    assert [item.cloud for item in document.transforms] == [
        f"{item.name}.ply" for item in document.transforms
    ]
    clouds = {item.name: read_ply(folder / f"{item.name}.ply") for item in document.transforms}
    limit = 6.0 * found["drift_sigma_mm"]
    for name, cloud in clouds.items():
        apart = np.linalg.norm(cloud.points_mm - clouds["view1"].points_mm, axis=1)
        assert apart.max() < limit, name
        assert cloud.frame == "Part"
    # the first view defines the frame; the others' points carry the uncertainty of the joining
    assert clouds["view1"].sigma_mm.max() == pytest.approx(0.01)
    assert clouds[found["drift_of"]].sigma_mm.min() > 0.012
    markers = read_marker_list(folder / "markers.csv", frame="").markers
    assert markers.frame == "Part"
    assert len(markers) == found["n_markers"]
    page = (folder / "registration.html").read_text(encoding="utf-8")
    assert 'class="scene"' in page
    assert "How far the chain drifts" in page
    assert len(document.residuals) > 30
    assert document.provenance.inputs[0].path.endswith("view1.csv")


def test_an_arm_that_moved_goes_on_in_its_old_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = two_views(np.random.default_rng(2), 12, np.array([400.0, 300.0, 80.0]))
    old, new, cloud = tmp_path / "before.csv", tmp_path / "after.csv", tmp_path / "scan.ply"
    old.write_text(
        "# frame = Base\nx_mm,y_mm,z_mm\n"
        + "".join(f"{x},{y},{z}\n" for x, y, z in scene.a.points_mm.tolist())
    )
    new.write_bytes(markers_csv(scene.b))
    back = scene.a_from_b.inverse()
    cloud.write_bytes(ply_bytes(cloud_in(PATCH @ back.rotation.T + back.translation_mm, "Base")))
    folder = tmp_path / "joined"
    words = ["register", str(old), "--moved", str(new), "--cloud", str(cloud), "-o", str(folder)]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "found by distances" in out
    assert "before.csv gives no covariance: 0.02 mm an axis is assumed" in out
    assert "after.csv gives no covariance" not in out
    document = read_registration(folder / "registration.json")
    (transform,) = document.transforms
    assert transform.n_markers == 12
    sigma = np.sqrt(np.diag(transform.covariance))
    assert (
        np.abs(transform.translation_mm - scene.a_from_b.translation_mm).max() < 5.0 * sigma.max()
    )
    carried = read_ply(folder / "scan.ply")
    assert carried.frame == "Base"
    assert np.linalg.norm(carried.points_mm - PATCH, axis=1).max() < 0.1
    assert carried.sigma_mm.min() > 0.01
    joint = read_marker_list(folder / "markers.csv", frame="").markers
    assert len(joint) == len(scene.a) + len(scene.b) - 12
    assert main(["info", str(folder / "registration.json")]) == 0
    assert "registration by markers (moved arm)" in capsys.readouterr().out


def test_a_marker_that_moved_is_listed_where_it_is_now(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its old place is no marker any more: a third registration with it would be wrong."""
    scene = two_views(
        np.random.default_rng(4), 9, np.array([400.0, 300.0, 80.0]), missing=0.0, extra=0.0
    )
    old, new = replace(scene.a, ids=scene.true_a), replace(scene.b, ids=scene.true_b)
    number, step = int(old.ids[0]), np.array([1.0, -2.0, 3.0])
    points = new.points_mm.copy()
    points[new.ids == number] += scene.a_from_b.rotation.T @ step
    paths = tmp_path / "before.csv", tmp_path / "after.csv"
    paths[0].write_bytes(markers_csv(old))
    paths[1].write_bytes(markers_csv(replace(new, points_mm=points)))
    folder = tmp_path / "joined"
    words = ["register", str(paths[0]), "--moved", str(paths[1]), "--by-id", "-o", str(folder)]
    assert main(words) == 0
    assert "markers.csv has its new place" in capsys.readouterr().out
    assert "markers.csv has its new place" in (folder / "registration.html").read_text("utf-8")
    joint = read_marker_list(folder / "markers.csv", frame="").markers
    np.testing.assert_array_equal(joint.ids, old.ids)
    apart = joint.points_mm - old.points_mm
    sigma = np.sqrt(np.trace(joint.covariance_mm2[0]))
    np.testing.assert_allclose(apart[0], step, atol=6.0 * sigma)
    assert not apart[1:].any()
    assert sigma > np.sqrt(np.trace(joint.covariance_mm2[1]))


def test_what_cannot_be_joined_gets_one_sentence(
    views: list[Path], tmp_path: Path, fails: Fails
) -> None:
    folder = tmp_path / "joined"
    grid = tmp_path / "grid.csv"
    points = np.array([(20.0 * i, 20.0 * k, 140.0) for i in range(5) for k in range(5)])
    grid.write_bytes(markers_csv(marker_set(points, frame="Sensor")))
    copy = tmp_path / "copy.csv"
    copy.write_bytes(markers_csv(marker_set(points + 1.0, frame="Sensor")))
    assert "equal distances" in fails("register", grid, copy, "-o", folder, writes=tmp_path)
    assert "two views or more" in fails("register", views[0], "-o", folder)
    assert "given twice" in fails("register", views[0], views[0], "-o", folder)
    assert "it needs --moved" in fails("register", *views, "--by-id", "-o", folder)
    assert "it needs --moved" in fails("register", *views, "--cloud", "x.ply", "-o", folder)
    assert "2 lists for one old place" in fails(
        "register", *views[:2], "--moved", views[2], "-o", folder
    )
    assert "leave no check" in fails("register", *views, "--least-common", 3, "-o", folder)
    assert "--sigma-mm" in fails("register", *views, "--sigma-mm=nan", "-o", folder)
    assert "without effect: all lists give the covariances" in fails(
        "register", *views, "--sigma-mm", 0.1, "-o", folder, writes=tmp_path
    )
    assert "the markers are in Sensor, and an arm that moved" in fails(
        "register", views[0], "--moved", views[1], "-o", folder, writes=tmp_path
    )
    assert "there is no such file" in fails("register", *views, tmp_path / "no.csv", "-o", folder)
    views[1].with_suffix(".ply").write_bytes(ply_bytes(cloud_in(PATCH, "Base")))
    assert "the cloud is in Base, its markers are in Sensor" in fails(
        "register", *views, "-o", folder, writes=tmp_path
    )
    folder.mkdir()
    (folder / "mine.txt").write_text("keep")
    assert "not empty" in fails("register", *views, "-o", folder)


def test_views_whose_lists_name_different_frames_are_warned_of(
    views: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A list in Base may be joined by views, but is no view of a sensor itself."""
    views[1].with_suffix(".ply").unlink()
    views[1].write_text(views[1].read_text().replace("frame = Sensor", "frame = Base"))
    assert main(["register", *map(str, views[:2]), "-o", str(tmp_path / "one")]) == 0
    assert "view2.csv is in Base and view1.csv in Sensor" in capsys.readouterr().out
    assert main(["register", *map(str, views[1::-1]), "-o", str(tmp_path / "other")]) == 0
    assert "is in Sensor and" not in capsys.readouterr().out


def test_flat_lists_without_a_frame_are_joined_whatever_side_their_origin_is_on(
    tmp_path: Path,
) -> None:
    """A sensor sees a plate from the front; a table of its holes may count from behind it."""
    points = walk(np.random.default_rng(1), 4).views[0].points_mm * [1.0, 1.0, 0.0]
    paths = tmp_path / "table.csv", tmp_path / "seen.csv"
    for path, height in zip(paths, (40.0, -140.0), strict=True):
        rows = np.add(points, [3.0, 2.0, height]).tolist()
        path.write_text("x_mm,y_mm,z_mm\n" + "".join(f"{x},{y},{z}\n" for x, y, z in rows))
    assert main(["register", *map(str, paths), "-o", str(tmp_path / "joined")]) == 0


def test_a_damaged_registration_is_refused(
    views: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from armscan.errors import FileFormatError

    folder = tmp_path / "joined"
    assert main(["register", *map(str, views[:2]), "-o", str(folder)]) == 0
    capsys.readouterr()
    path = folder / "registration.json"
    text = path.read_text()
    for old, new, said in (
        ('"armscan/registration"', '"armscan/other"', "not a registration"),
        ('"schema_version": 1', '"schema_version": 2', "update armscan"),
        ('"kind": "views"', '"kind": "dreams"', "SHA-256"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(FileFormatError, match=said):
            read_registration(path)
