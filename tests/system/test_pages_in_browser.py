# SPDX-License-Identifier: Apache-2.0
"""Pages of inspections and calibrations in a browser at two widths and on paper: nothing overlaps,
is cut or asked for from elsewhere. ``benchmarks/pages.py`` looks at the pages of any folder so.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoOptions
from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.calibration.latency import LatencyFit, calibrate_latency
from armscan.cli import main
from armscan.records.cloud import CalibrationMark
from armscan.records.exposure import Exposure
from armscan.report.hand_eye import latency_page
from armscan.report.page import Page, render_page
from armscan.report.stereo import stereo_page
from armscan.storage.clouds import ply_bytes
from armscan.storage.documents import scanner_document
from armscan.storage.points import markers_csv
from armscan.storage.recording import write_recording
from rigs.inspection_clouds import RADIUS_MM, ball_stripes, cloud_of
from rigs.latency import LatencyCase, draw
from rigs.marked_plate import draw_marked_plate
from rigs.marker_scenes import walk
from rigs.page_check import CHROMIUM, DRIVER, browser, page_faults
from rigs.parts import wedge_part
from rigs.scan_fake import as_source, fake_scan, scanner
from rigs.sheet_rig import PROVENANCE
from rigs.stereo_rig import StereoScene, make_pairs

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no Chromium with its driver is found"
)
LONG = "a-name-that-is-as-long-as-the-longest-that-a-title-block-takes-" * 3


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pages of a comparison with long names, of a recipe over two parts, and of a ball."""
    folder = tmp_path_factory.mktemp("pages")
    part = wedge_part()
    mesh = trimesh.Trimesh(part.vertices_mm, part.triangles, process=False)
    (folder / "part.stl").write_bytes(mesh.export(file_type="stl"))
    points, triangle = part.surface_points(4000)
    normals = part.normals[triangle]
    random = np.random.default_rng(0)
    cloud = cloud_of(points, random.integers(0, 20, 4000), sigma_mm=0.003, normals=normals)
    old = CalibrationMark("old", "2020-01-01T00:00:00+00:00")
    (folder / "scans").mkdir()
    for name in ("scans/a.ply", f"scans/{LONG[:80]}.ply"):
        (folder / name).write_bytes(ply_bytes(replace(cloud, calibrations=(old,))))
    ball = RADIUS_MM * ball_stripes(40, 40)
    (folder / "ball.ply").write_bytes(ply_bytes(cloud_of(ball, np.repeat(np.arange(40), 40))))
    (folder / "recipe.toml").write_text(
        'part = "part.stl"\nalign = "none"\ntolerance_mm = 0.05\n'
        f'[title_block]\ncustomer = "{LONG}"\n'
    )
    told = ["--title-block", f"part={LONG}", "--title-block", "calibration_valid_days=9"]
    made = [
        ["cad", "scans/a.ply", "part.stl", "--align", "none", "-o", "cad.html", *told],
        ["sphere", "ball.ply", "--diameter", "34.96", "-o", "ball.html", *told],
        ["recipe", "recipe.toml", "scans", "-o", "results"],
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for words in made:
            assert main(["inspect", *words]) in (0, 1)
    return folder


@pytest.fixture(scope="module")
def calibrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pages of two cameras, of a latency, of markers, of views that they join, of a check."""
    folder = tmp_path_factory.mktemp("calibrations")
    (folder / "stereo.html").write_bytes(render_page(page_of_two_cameras()))
    fit = calibrate_latency(*draw(LatencyCase(seconds=4.0), 0)[:3], is_shared=True)
    assert isinstance(fit, LatencyFit)
    told = latency_page(fit, PROVENANCE, warnings=[LONG], is_simulated=True)
    (folder / "latency.html").write_bytes(render_page(told))
    draw_marked_plate(folder)
    views = walk(np.random.default_rng(1), 3).views
    lists = [folder / f"{name}.csv" for name in ("first", LONG[:80], "third")]
    for path, view in zip(lists, views, strict=True):
        path.write_bytes(markers_csv(view))
    write_recording(folder / "plate", as_source(fake_scan(12, 2.0)))
    (folder / "scanner.json").write_bytes(scanner_document(scanner()))
    (folder / "plate.csv").write_text("A,B,C,D\n0,0,1,0\n")
    images = ["markers", "left.png", "right.png"]
    made = [
        [*images, "-o", "rings.html"],
        [*images, "--stereo", "stereo.json", "--diameter", "6", "-o", "markers.csv"],
        ["register", *(path.name for path in lists), "-o", "joined"],
        [
            "verify",
            "plate",
            "--scanner",
            "scanner.json",
            "--plate",
            "plate.csv",
            "-o",
            "check.html",
        ],
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for words in made:
            assert main(words) in (0, 1)
    return folder


def page_of_two_cameras() -> Page:
    scene = StereoScene(n_pairs=8)
    pairs, _ = make_pairs(scene, 0)
    options = StereoOptions(CameraOptions(distortion="k1k2p1p2k3", n_folds=0), n_folds=4)
    fit = calibrate_stereo(pairs, scene.target, options)
    assert isinstance(fit, StereoFit)
    names = [f"{LONG[:70]}.png", *(one.source for pair in pairs for one in pair.views if one)]
    grey = np.full((1536, 2048), 80, dtype=np.uint8)
    shown = {name: Exposure(grey, name) for name in names}
    return stereo_page(fit, [(names[0], "no target")], shown, PROVENANCE, is_simulated=True)


def test_pages_of_calibrations_are_whole(calibrations: Path, tmp_path: Path) -> None:
    found = sorted(calibrations.rglob("*.html"))
    names = {"stereo", "latency", "rings", "markers", "registration", "check"}
    assert {page.stem for page in found} == names
    with browser(tmp_path) as driver:
        faults = {page.name: page_faults(driver, page) for page in found}
    assert not any(faults.values()), faults


def test_pages_are_whole_on_the_screen_and_on_paper(pages: Path, tmp_path: Path) -> None:
    found = sorted(pages.rglob("*.html"))
    assert len(found) == 5
    with browser(tmp_path) as driver:
        faults = {page.name: page_faults(driver, page) for page in found}
    assert not any(faults.values()), faults


def test_faults_are_found(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(
        '<!doctype html><div style="width: 3000px; text-align: right">far</div>'
        '<p style="position: absolute; top: 90px">one text</p>'
        '<p style="position: absolute; top: 92px">other text</p>'
        '<p style="position: absolute; top: 200px; width: 40px; overflow: hidden; '
        'white-space: nowrap">much too long</p><img alt="gone" src="http://127.0.0.1:9/x.png">'
    )
    with browser(tmp_path / "browser") as driver:
        text = "\n".join(page_faults(driver, page))
    for word in ("px wide", "beyond the edge", "text on text", "cut: P", "asks for http"):
        assert word in text
