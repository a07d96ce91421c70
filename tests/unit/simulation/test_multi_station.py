# SPDX-License-Identifier: Apache-2.0
"""Exposures of heads with two lasers, eleven lines, two cameras; the single head as ever."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.geometry.poses import Base, Part, Plate, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.head import LEFT, RIGHT, Head, Window, build_head
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed
from armscan.simulation.optics.render import Speckle
from armscan.simulation.optics.scene import GROUND_STEEL, Material, SceneObject, Sphere
from armscan.simulation.station import (
    ExposureSettings,
    Station,
    TrueStripe,
    exposure_light,
    render_exposure,
    seen_from,
    true_stripes,
)
from rigs.slow_renderer import render_laser

MATT = Material()
WINDOW = Window(1150, 750, 700, 500)
REACH_PX = 30
SINGLE_SUM, SINGLE_ROW = 7_158_746, 1190.4936837553118


def quiet(head: Head) -> Head:
    """Without speckle, halo, gloss, texture, room light, spot and stray lines: pure geometry."""
    imaging = replace(
        head.imaging,
        speckle=Speckle(0.0, 0.0),
        ambient=0.0,
        gloss=0.0,
        texture=0.0,
        spot_level=0.0,
        stray_share=0.0,
        detector=replace(head.imaging.detector, halo_share=0.0),
    )
    return replace(head, imaging=imaging)


def above(head: Head, height_mm: float = 0.0, tilt_rad: float = 0.08) -> Pose[Base, Sensor]:
    """The whole head looks down on the origin of Base, a little tilted."""
    places = [camera.camera_from_sensor.inverse().translation_mm for camera in head.cameras]
    aim = np.array([0.0, 0.0, 140.0])
    z = aim - np.mean(places, axis=0)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    from_sensor = np.stack([x, np.cross(z, x), z])
    turn = rotation_from_vector(tilt_rad * np.array([1.0, 0.5, 0.3]))
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn @ from_sensor
    return Pose(rotation, np.array([0.0, 0.0, height_mm]) - rotation @ aim)


def plate(finish: Material = MATT, flatness_mm: float = 0.015) -> SceneObject:
    flat = FlatPlate.draw((200.0, 150.0), flatness_mm, np.random.default_rng(1))
    lying: Pose[Base, Plate] = Pose(np.eye(3), np.zeros(3))
    return SceneObject("plate", Placed(flat, lying), finish)


def light_of(
    head: Head, station: Station, camera: int, window: Window = WINDOW
) -> NDArray[np.float64]:
    settings = ExposureSettings(window, head.sources)
    rng = np.random.default_rng(0)
    light = exposure_light(head, station, [above(head)], settings, rng, camera=camera)
    return light.astype(np.float64)


def centroid_errors(light: NDArray[np.float64], stripe: TrueStripe) -> NDArray[np.float64]:
    """Centroid of the light less the true centre, along the row that each true point lies on."""
    errors = []
    for x, y in stripe.points_px - [WINDOW.x_px, WINDOW.y_px]:
        if abs(y - round(y)) > 1e-6:
            continue
        columns = np.arange(round(x) - REACH_PX, round(x) + REACH_PX + 1)
        if columns[0] < 0 or columns[-1] >= WINDOW.width_px:
            continue
        profile = light[round(y), columns]
        errors.append(profile @ columns / profile.sum() - x)
    return np.array(errors)


@pytest.mark.parametrize("camera", [LEFT, RIGHT])
def test_every_line_is_centred_on_its_truth_in_both_cameras(camera: int) -> None:
    head = quiet(build_head("thesis-multi", seed=3))
    station = Station((plate(),))
    light = light_of(head, station, camera)
    settings = ExposureSettings(WINDOW, head.sources)
    stripes = true_stripes(head, station, above(head), settings, camera=camera)
    biases = []
    for stripe in stripes:
        errors = centroid_errors(light, stripe)
        if len(errors) > 100:
            biases.append(errors.mean())
            assert errors.std() < 0.002
    assert len(biases) >= 2
    # as on the single head, the fan dims with the distance from its source: 0.002 px; a slanted
    # line is 1.4 times as wide along the row
    assert np.abs(biases).max() < 0.006


def test_all_lines_in_one_pass_equal_line_by_line_with_every_sample_traced() -> None:
    head = quiet(build_head("thesis-multi", seed=3))
    ball = SceneObject("ball", Sphere(np.array([2.0, 0.5, 3.0]), 5.0), MATT)
    block = SceneObject("block", Box(np.array([6.0, 40.0, 4.0])), MATT)
    station = Station((plate(flatness_mm=0.001), ball, block))
    window = Window(1300, 900, 400, 260)
    quick = light_of(head, station, LEFT, window)
    lens = head.camera.cropped(window.x_px, window.y_px, window.width_px, window.height_px)
    scene = seen_from(station, above(head))
    slow = np.zeros_like(quick)
    for laser in head.lasers:
        slow += render_laser(scene, lens, laser, Speckle(0.0, 0.0), np.random.default_rng(0)).light
    inner = (slice(10, -10), slice(10, -10))
    assert slow[inner].max() > 0.2
    # the two coarse grids differ: each misses a few faint pixels where the ball falls away
    assert np.abs(quick - slow)[inner].max() < 0.03 * slow.max()
    assert np.abs(quick - slow)[inner].mean() < 5e-5 * slow.max()


def test_both_lasers_of_the_cross_add_up_and_can_be_switched_alone() -> None:
    head = quiet(build_head("thesis-cross"))
    station = Station((plate(),))
    lights = []
    for lasers in (("A",), ("B",), ("A", "B")):
        settings = ExposureSettings(WINDOW, lasers)
        rng = np.random.default_rng(0)
        lights.append(exposure_light(head, station, [above(head)], settings, rng))
    np.testing.assert_allclose(lights[0] + lights[1], lights[2], atol=1e-6)
    assert min(lights[0].max(), lights[1].max()) > 0.2
    names = [
        [s.sheet for s in true_stripes(head, station, above(head), ExposureSettings(WINDOW, on))]
        for on in (("B",), ("A", "B"))
    ]
    assert names == [["B"], ["A", "B"]]


def test_the_spot_saturates_on_the_middle_line_of_both_cameras() -> None:
    head = build_head("thesis-multi", seed=1)
    station = Station((plate(),))
    middle = head.lasers[5]
    ray = middle.rays(np.zeros(1))[0]
    pose = above(head)
    down, start = pose.rotation[2], pose.translation_mm[2]
    reach = -(start + down @ middle.source_mm) / (down @ ray)
    on_plate = middle.source_mm + reach * ray
    for camera in head.cameras:
        in_camera = camera.camera_from_sensor.rotation @ on_plate
        x, y = camera.camera.project(in_camera + camera.camera_from_sensor.translation_mm)
        window = Window(round(x) - 100, round(y) - 100, 200, 200)
        index = head.cameras.index(camera)
        image = render_exposure(
            head,
            station,
            [pose],
            ExposureSettings(window, head.sources),
            np.random.default_rng(1),
            camera=index,
        )
        rows, columns = np.nonzero(image == 255)
        # saturated out to sigma sqrt(2 ln(6 * 0.8 * albedo)) = 0.6 * 1.6 mm, at 37 px / mm
        assert 2000 < len(rows) < 9000
        assert abs(columns.mean() - 100.0) < 3.0 and abs(rows.mean() - 100.0) < 3.0


def test_steel_shows_faint_lines_between_the_true_ones() -> None:
    head = build_head("thesis-multi", seed=1)
    still = replace(quiet(head).imaging, gloss=1.0)
    window = Window(600, 700, 1400, 300)
    lights = []
    for share in (0.0, 0.12):
        posed = replace(head, imaging=replace(still, stray_share=share))
        station = Station((plate(GROUND_STEEL, 0.001),))
        lights.append(light_of(posed, station, LEFT, window))
    extra = lights[1] - lights[0]
    assert extra.min() > -1e-6
    assert 0.02 < extra.max() / np.quantile(lights[0].max(axis=1), 0.5) < 0.2


def test_the_single_head_renders_what_it_did_before_there_were_others() -> None:
    """Numbers of the commit before; the last digits of exponentials differ between machines."""
    head = build_head("thesis-single", "thesis", 1)
    assert head.camera.fx == pytest.approx(5156.337190846746, rel=1e-12)
    np.testing.assert_allclose(
        head.lasers[0].source_mm,
        [0.44136936872673344, -124.27399938451693, -0.482911968429363],
        rtol=1e-10,
    )
    assert head.lasers[0].skew_rad == pytest.approx(0.043419403570772126, rel=1e-10)
    np.testing.assert_allclose(
        head.tool_from_sensor.translation_mm,
        [41.59548541337244, 22.04835234662134, 111.4052135555943],
        rtol=1e-12,
    )
    turn: Pose[Base, Part] = Pose.from_vectors([0.1, 0.05, 0.05], np.zeros(3))
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn.rotation
    poses: list[Pose[Base, Sensor]] = [
        Pose(rotation, np.array([0.0, 0.0, h]) - rotation @ np.array([0.0, 4.158, 140.0]))
        for h in (-0.05, 0.0, 0.05)
    ]
    flat = FlatPlate.draw((200.0, 150.0), 0.015, np.random.default_rng(1))
    station = Station((SceneObject("plate", flat, GROUND_STEEL),))
    settings = ExposureSettings(head.scan_window, ("A",))
    image = render_exposure(head, station, poses, settings, np.random.default_rng(5))
    assert int(image.sum()) == pytest.approx(SINGLE_SUM, rel=1e-5)
    (stripe,) = true_stripes(head, station, poses[1], settings)
    assert stripe.points_px[:, 1].mean() == pytest.approx(SINGLE_ROW, abs=1e-6)
