# SPDX-License-Identifier: Apache-2.0
"""Scenes of a twin become recordings, their truth beside them; an interrupt leaves nothing.

The twin here is a fake one that is found by the real one's name, so that no image is rendered.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh

from armscan.cli.twin import PresetName, Scene
from armscan.devices.sources import Preset, TwinScene
from armscan.errors import ArmscanError, InputError, OptionError, OutputError
from armscan.jobs.twin import simulate as simulate_job_simulate
from armscan.jobs.twin.simulate import run_simulation
from armscan.pipeline import simulate
from armscan.pipeline.progress import ProgressEvent
from armscan.pipeline.simulate import (
    SimulatedScene,
    SimulateOptions,
    TwinName,
    fewer_views,
    scannable_part,
    simulate_scene,
    truth_path,
)
from armscan.storage import files
from armscan.storage.arm import read_probe_tip
from armscan.storage.image_paths import are_simulated
from armscan.storage.recording import read_arm_track, read_recording
from rigs import fake_twin
from rigs.recording_folders import memory_scan, pixels

HEAD = "thesis-single"


@pytest.fixture(autouse=True)
def _fake(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_twin.register(tmp_path_factory.mktemp("site"), monkeypatch)


def check_images(folder: Path) -> None:
    scan = read_recording(folder)
    assert len(scan.rows) == fake_twin.N_IMAGES
    for k in range(fake_twin.N_IMAGES):
        np.testing.assert_array_equal(scan.exposure(k).image, pixels(k))


def test_a_scene_is_a_recording_and_its_truth_lies_beside_it(tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    options = SimulateOptions(seed=3, processes=1)
    found = simulate_scene(tmp_path / "ball.1", HEAD, "ball", options, events.append)
    check_images(found.folder)
    assert found.truth == tmp_path / "ball.1.truth.json"
    truth = json.loads(found.truth.read_text())
    assert (truth["seed"], truth["scene"]) == (3, "ball")
    assert not list(found.folder.rglob("*truth*"))
    assert are_simulated([found.folder / "images/0000.png"])
    assert [(event.done, event.total) for event in events] == [(k, 6) for k in range(1, 7)]
    assert (found.n_images, found.n_arm_samples) == (6, 4)


def test_several_processes_write_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulate, "IMAGES_A_PROCESS", 3)
    simulate_scene(tmp_path / "two", HEAD, "ball", SimulateOptions(processes=2))
    simulate_scene(tmp_path / "one", HEAD, "ball", SimulateOptions(processes=1))
    names = [p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file()]
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.parametrize("images_a_process", [1000, 3])
def test_an_interrupt_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images_a_process: int
) -> None:
    monkeypatch.setattr(simulate, "IMAGES_A_PROCESS", images_a_process)

    def stop(event: ProgressEvent) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_scene(tmp_path / "scan", HEAD, "ball", progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("scene", ["ball", "probing"])
def test_no_recording_is_seen_without_its_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: TwinScene
) -> None:
    """The truth cannot be written, as on a full disk: then there is no recording either."""

    def full(contents: object, **_: object) -> None:
        raise OutputError("no space")

    monkeypatch.setattr(files, "write_files", full)
    with pytest.raises(OutputError, match="no space"):
        simulate_scene(tmp_path / "scan", HEAD, scene, SimulateOptions(processes=1))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", [".", "", "..", "sub/..", "/"])
def test_a_folder_that_cannot_be_made_anew_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="name a new folder"):
        simulate_scene(Path(name), HEAD, "probing")


def test_a_folder_named_from_below_has_its_truth_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scan" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert truth_path(Path("scan/below/..")) == tmp_path / "scan.truth.json"


def test_probing_gives_touches_and_the_tip(tmp_path: Path) -> None:
    found = simulate_scene(tmp_path / "touches", HEAD, "probing", SimulateOptions(seed=2))
    track, notes = read_arm_track(found.folder)
    assert (len(track), notes, found.n_images) == (4, (), 0)
    tip = read_probe_tip(found.folder / "probe.toml")
    assert (tip.centre_tool_mm.tolist(), tip.diameter_mm) == ([0.0, 0.5, 60.0], 6.0)
    assert found.truth.exists() and are_simulated([found.folder / "arm.csv"])


def test_results_that_exist_stop_it_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "scan.truth.json").write_text("mine")
    with pytest.raises(OutputError, match="the truth of an earlier recording is there"):
        simulate_scene(tmp_path / "scan", HEAD, "ball")
    with pytest.raises(OptionError, match="unit"):
        simulate_scene(tmp_path / "scan", HEAD, "workpiece", SimulateOptions(unit="m"))
    assert not (tmp_path / "scan").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    with pytest.raises(OutputError, match="not empty"):
        simulate_scene(tmp_path / "full", HEAD, "ball")


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"processes": 0}, {"preset": "best"}])
def test_wrong_options_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        SimulateOptions(**wrong)


def test_the_command_knows_all_scenes_and_presets() -> None:
    assert tuple(Scene) == get_args(TwinScene)
    assert tuple(PresetName) == get_args(Preset)


@pytest.mark.parametrize("scene", get_args(TwinScene))
def test_the_report_says_what_comes_next(tmp_path: Path, scene: TwinScene) -> None:
    summary = run_simulation(HEAD, scene, tmp_path / "scan", SimulateOptions())
    word = {"camera": "camera", "laser": "laser", "hand-eye": "hand-eye", "probing": "probe"}
    word |= {"markers": "markers", "markers-moved": "markers", "latency": "latency"}
    assert f" {word.get(scene, 'reconstruct')} " in summary.next_step
    assert str(tmp_path / "scan") in summary.next_step
    assert summary.data["simulated"] is True and summary.data["seed"] == 1


@pytest.mark.parametrize(
    ("scene", "step"),
    [
        ("camera", "calibrate stereo --scan board --target"),
        ("laser", "calibrate laser --camera stereo.json --scan board --target"),
        ("markers", "markers board/images/left/0001.png board/images/right/0001.png --stereo"),
    ],
)
def test_two_cameras_are_calibrated_as_a_pair(
    monkeypatch: pytest.MonkeyPatch, scene: TwinScene, step: str
) -> None:
    found = SimulatedScene(Path("board"), Path("t.json"), 4, 0, "circle-grid:11x9:3.75", 2, ("A",))
    monkeypatch.setattr(simulate_job_simulate, "simulate_scene", lambda *_: found)
    summary = run_simulation("thesis-multi", scene, Path("board"), SimulateOptions())
    assert step in summary.next_step.replace("\\", "/")


def test_views_of_two_cameras_stay_together() -> None:
    """Rows of one instant are one view, named or not."""
    whole = memory_scan(6)
    rows = tuple(
        replace(row, camera=k % 2, t_ns=1000 * (k // 2), view=None)
        for k, row in enumerate(whole.rows)
    )
    kept = fewer_views(replace(whole, rows=rows), 2).rows
    assert [(row.t_ns, row.camera) for row in kept] == [(0, 0), (0, 1), (2000, 0), (2000, 1)]


def block(folder: Path, name: str, scale: float = 1.0, *, is_open: bool = False) -> Path:
    """A block of 60 x 40 x 15 mm that stands on its origin."""
    mesh = trimesh.creation.box((60.0, 40.0, 15.0))
    mesh.apply_translation([0.0, 0.0, 7.5])
    mesh.apply_scale(scale)
    if is_open:
        mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(folder / name)
    return folder / name


@pytest.mark.parametrize(
    ("name", "unit", "scale"),
    [("a.stl", "mm", 1.0), ("a.obj", "m", 1e-3), ("a.ply", "inch", 1 / 25.4)],
)
def test_a_part_of_ones_own_stands_before_the_scanner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, unit: str, scale: float
) -> None:
    """The truth's surface is that of the file: distances by hand."""
    monkeypatch.undo()
    part = block(tmp_path, name, scale)
    truth = TwinName(HEAD, "clean", 1, part, unit).build().truth
    inside = np.array([[0.0, 0.0, 10.0], [28.0, 0.0, 7.5], [0.0, 0.0, 18.0], [33.0, 24.0, 7.0]])
    away = truth.workpiece_distance_mm(truth.base_from_workpiece.apply(inside))
    assert away == pytest.approx([5.0, 2.0, 3.0, 5.0], abs=1e-4)


def test_a_part_in_another_unit_or_for_another_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--unit m"):
        scannable_part(block(tmp_path, "metres.stl", 1e-3), "mm")
    with pytest.raises(InputError, match="5 to 500"):
        scannable_part(block(tmp_path, "large.stl", 100.0), "mm")
    (tmp_path / "none.stl").write_bytes(b"")
    with pytest.raises(ArmscanError, match="empty"):
        scannable_part(tmp_path / "none.stl", "mm")
    whole = block(tmp_path, "whole.stl")
    assert scannable_part(whole, "mm").notes == ()
    assert "open" in scannable_part(block(tmp_path, "open.stl", is_open=True), "mm").notes[0]
    with pytest.raises(OptionError, match="scene workpiece"):
        simulate_scene(tmp_path / "scan", HEAD, "ball", SimulateOptions(part=str(whole)))
    with pytest.raises(OptionError, match="unit"):
        simulate_scene(tmp_path / "scan", HEAD, "workpiece", SimulateOptions(unit="m"))
    assert not (tmp_path / "scan").exists()
