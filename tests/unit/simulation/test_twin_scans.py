# SPDX-License-Identifier: Apache-2.0
"""The twin as the pipeline meets it: by name, scene by scene, the same again and again."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest

from armscan.devices.sources import Probing, ScanSource, Twin, TwinScene, TwinTruth, load_driver
from armscan.errors import OptionError
from armscan.simulation.objects.fixtures import STEP_CENTRES_MM
from armscan.simulation.twin import build_twin

IMAGE_SCENES = [scene for scene in get_args(TwinScene) if scene != "probing"]


def test_the_twin_is_found_by_name_and_keeps_its_promises():
    twin: Twin = load_driver("twin")(head="thesis-single", preset="harsh", seed=4)
    assert (twin.head, twin.preset, twin.seed) == ("thesis-single", "harsh", 4)
    assert twin.target == "circle-grid:11x9:3.75"
    own = build_twin(seed=4)
    promised: tuple[Twin, TwinTruth, ScanSource, Probing] = (
        own,
        own.truth,
        own.scan("still-step"),
        own.probe_plate(),
    )
    assert len(promised) == 4


@pytest.mark.parametrize(
    "wrong", [{"head": "thesis-quint"}, {"preset": "perfect"}, {"seed": -1}], ids=str
)
def test_an_unknown_twin_is_refused_with_the_known_ones(wrong: dict[str, object]):
    with pytest.raises(OptionError):
        load_driver("twin")(**wrong)


def test_probing_is_not_a_scene_of_images():
    with pytest.raises(OptionError, match="no images of a scene 'probing'"):
        build_twin().scan("probing")


@pytest.mark.parametrize("scene", IMAGE_SCENES)
def test_every_scene_lists_its_exposures_without_rendering(scene: TwinScene):
    scan = build_twin(seed=1).scan(scene)
    rows = scan.rows
    assert [row.index for row in rows] == list(range(len(rows)))
    assert len({row.source for row in rows}) == len(rows)
    times = [row.t_ns for row in rows]
    assert times == sorted(set(times))
    assert scan.is_simulated and scan.session.is_simulated
    assert (scan.arm is None) == (scene in ("camera", "laser"))
    setup = scan.session.cameras[0]
    is_calibration = scene in ("camera", "laser", "hand-eye")
    is_full = is_calibration or scene in ("markers", "markers-moved", "still-part")
    assert (setup.width_px, setup.height_px) == ((3072, 2048) if is_full else (2658, 800))
    assert scan.session.kind == ("calibration" if is_calibration else "scan")


def test_laser_views_are_pairs_with_and_without_laser():
    rows = build_twin(seed=1).scan("laser").rows
    for lit, unlit in zip(rows[::2], rows[1::2], strict=True):
        assert lit.view == unlit.view
        assert (lit.lasers, unlit.lasers) == (("A",), ())
        assert lit.source == unlit.source.replace("/off/", "/on/") == f"images/on/{lit.view}.png"


def test_an_exposure_is_the_same_in_whatever_order_it_is_asked_for():
    scene: TwinScene = "ball"
    first = build_twin(seed=7).scan(scene)
    later = build_twin(seed=7).scan(scene)
    late, early = later.exposure(33), later.exposure(4)
    assert np.array_equal(first.exposure(4).image, early.image)
    assert np.array_equal(first.exposure(33).image, late.image)
    assert not np.array_equal(early.image, late.image)
    assert early.window.x_px == first.session.cameras[0].window.x_px
    assert (early.t_ns, early.trigger_id) == (first.rows[4].t_ns, 5)
    assert early.lasers == ("A",)
    arm, again = first.arm, later.arm
    assert arm is not None and again is not None
    assert np.array_equal(arm.translations_mm, again.translations_mm)


def test_the_noise_of_two_exposures_of_one_posture_differs():
    scan = build_twin(seed=7).scan("hand-eye")
    assert not np.array_equal(scan.exposure(0).image, scan.exposure(1).image)
    assert scan.arm is not None
    moved = np.linalg.norm(np.diff(scan.arm.translations_mm[:2], axis=0))
    assert 0.0005 < moved < 0.05


def test_the_still_step_shows_the_block_and_the_ground():
    twin = build_twin(seed=3)
    scan = twin.scan("still-step")
    stripe = scan.true_stripes(0)[0]
    ground = twin.instrument.fixtures.base_from_ground
    placed = (stripe.points_base_mm - ground.translation_mm) @ ground.rotation
    on_top = stripe.thing == 1.0
    np.testing.assert_allclose(placed[on_top, 2], 20.0, atol=1e-6)
    on_ground = stripe.thing == 0.0
    assert np.abs(placed[on_ground, 2]).max() < 0.002
    assert on_top.sum() > 500 and on_ground.sum() > 300
    # One stripe shows a height in its sheet: upright within 0.1 degrees, 20 mm lose 0.03 um.
    ray = twin.instrument.head.lasers[0].rays(np.zeros(1))[0]
    down = scan.shots[0].base_from_sensor.rotation @ ray
    assert down @ ground.rotation[:, 2] < -np.cos(np.radians(0.1))
    assert np.abs(placed[on_top, 0] - STEP_CENTRES_MM[0][0]).max() < 11.01


def test_the_part_in_view_has_no_distance_from_itself():
    twin = build_twin(seed=3)
    points = twin.scan("part").true_stripes(16)[0].points_base_mm
    assert len(points) > 500
    assert np.abs(twin.truth.part_distance_mm(points)).max() < 1e-4
    normals = twin.truth.part_normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    # Where limbs melt into each other the distance is true to some percent only.
    outside = twin.truth.part_distance_mm(points + 0.05 * normals)
    np.testing.assert_allclose(np.median(outside), 0.05, rtol=0.1)


def test_truth_is_of_the_same_instrument_and_says_that_it_is_simulated():
    twin = build_twin(seed=3)
    truth = twin.truth
    laser, camera = twin.instrument.head.lasers[0], twin.instrument.head.camera
    assert np.abs(laser.offset_mm(truth.sheet_points_mm["A"])).max() < 1e-9
    assert np.ptp(truth.sheet_points_mm["A"][:, 2]) == pytest.approx(60.0)
    assert truth.camera_parameters[0] == camera.fx
    assert np.linalg.norm(truth.plate_plane[:3]) == pytest.approx(1.0)
    plate = twin.instrument.fixtures.base_from_plate.translation_mm
    assert truth.plate_plane[:3] @ plate + truth.plate_plane[3] == pytest.approx(0.0, abs=1e-10)
    document = json.loads(truth.document())
    assert document["simulated"] is True
    assert document["ball"]["diameter_mm"] == truth.ball_diameter_mm == 34.96


def test_presets_differ_in_arm_plate_and_probing():
    clean, thesis, harsh = (build_twin(preset=p, seed=1) for p in ("clean", "thesis", "harsh"))
    noise = [t.instrument.arm.white_rad for t in (clean, thesis, harsh)]
    assert 20.0 * noise[0] < noise[1] < 0.5 * noise[2]
    x, y = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-99, 99, 41)]))
    uneven = [
        float(np.ptp(t.instrument.fixtures.plate.height_mm(x, y))) for t in (clean, thesis, harsh)
    ]
    np.testing.assert_allclose(uneven, [0.001, 0.015, 0.04], rtol=0.1)


@pytest.mark.parametrize(("preset", "limit_mm"), [("clean", 6e-4), ("thesis", 0.012)])
def test_touched_points_lie_on_the_plate_under_the_tip(preset: str, limit_mm: float):
    twin = load_driver("twin")(preset=preset, seed=6)
    probing: Probing = twin.probe_plate()
    arm = probing.arm
    assert 20 <= len(arm) <= 30
    centres = arm.translations_mm + arm.rotations @ probing.tool_from_probe_mm
    plane = twin.truth.plate_plane
    height = centres @ plane[:3] + plane[3] - 0.5 * probing.tip_diameter_mm
    assert np.sqrt(np.mean(height**2)) < limit_mm
    spread = np.linalg.svd(centres[:, :2] - centres[:, :2].mean(axis=0))[1]
    assert spread.min() > 150.0
