# SPDX-License-Identifier: Apache-2.0
"""Exposures of a posed head: where the light is, where it is not, and what noise there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.poses import Base, Board, Part, Pose, Sensor
from armscan.records.exposure import Exposure, SensorWindow
from armscan.simulation.head import Head, Tolerances, Window, build_head
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed
from armscan.simulation.optics.render import Speckle
from armscan.simulation.optics.scene import MATT_PAINT, Material, SceneObject, Sphere
from armscan.simulation.station import (
    ExposureSettings,
    Station,
    Target,
    TrueStripe,
    exposure_light,
    render_exposure,
    seen_from,
    true_stripes,
)
from armscan.vision.stripe.extract import extract_stripes
from rigs.slow_renderer import render_laser

MATT = Material()
GROUND = SceneObject("ground", FlatPlate(np.array([200.0, 150.0])), MATT)
BALL = SceneObject("ball", Sphere(np.array([2.0, 0.5, 6.0]), 6.0), MATT)
BLOCK = SceneObject("block", Box(np.array([20.0, 40.0, 5.0])), MATT)
STAND_OFF_MM = 140.0
SMALL = Window(1200, 650, 500, 640)


def quiet(head: Head) -> Head:
    """Without speckle, halo, gloss, texture, room light: pure geometry."""
    imaging = replace(
        head.imaging,
        speckle=Speckle(0.0, 0.0),
        ambient=0.0,
        gloss=0.0,
        texture=0.0,
        ghost_share=0.0,
        detector=replace(head.imaging.detector, halo_share=0.0),
    )
    return replace(head, imaging=imaging)


def above(height_mm: float = 0.0, tilt_rad: float = 0.1) -> Pose[Base, Sensor]:
    """Sensor over the origin of Base, looking down; its sheet passes the origin at a height."""
    down: Pose[Base, Base] = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    turn: Pose[Base, Sensor] = Pose.from_vectors([tilt_rad, 0.5 * tilt_rad, 0.05], np.zeros(3))
    rotation = down.rotation @ turn.rotation
    # on the printed sheet, 140 mm deep: y = (0.67742 * 140 - 91.78) / 0.73558
    aim = np.array([0.0, 4.158, STAND_OFF_MM])
    return Pose(rotation, np.array([0.0, 0.0, height_mm]) - rotation @ aim)


def on(window: Window, **changes: float) -> ExposureSettings:
    return ExposureSettings(window, ("A",), **changes)


def light_of(
    head: Head, station: Station, window: Window, height_mm: float = 0.0
) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    return exposure_light(head, station, [above(height_mm)], on(window), rng).astype(np.float64)


def centroid_errors(
    light: NDArray[np.float64], stripe: TrueStripe, window: Window, reach_px: int = 22
) -> NDArray[np.float64]:
    """Centroid of the light in each column less the true centre, px; ends are left out."""
    errors = []
    for x, y in stripe.points_px[15:-15]:
        column, row = round(x - window.x_px), round(y - window.y_px)
        rows = np.arange(row - reach_px, row + reach_px + 1)
        profile = light[rows, column]
        errors.append(profile @ rows / profile.sum() - (y - window.y_px))
    return np.array(errors)


@pytest.mark.parametrize("seed", [1, 2])
def test_light_on_a_plate_is_centred_on_the_truth(seed: int) -> None:
    head = quiet(build_head(seed=seed))
    plate = SceneObject("plate", FlatPlate.draw((200.0, 150.0), 0.015, np.random.default_rng(seed)))
    station = Station((plate,))
    window = Window(800, 500, 1200, 1000)
    (stripe,) = true_stripes(head, station, above(), on(window))
    assert len(stripe.points_px) == 1200
    light = light_of(head, station, window)
    errors = centroid_errors(light, stripe, window)
    # the fan dims with the distance from its source, which alone shifts the light by 0.002 px
    assert abs(errors.mean()) < 0.005
    assert errors.std() < 0.001
    assert np.abs(plate.surface.distance_mm(stripe.points_base_mm)).max() < 1e-5  # type: ignore[attr-defined]


def test_the_quick_way_equals_tracing_every_sample() -> None:
    head = quiet(build_head())
    station = Station((GROUND, BALL))
    window = SMALL
    quick = light_of(head, station, window)
    camera = head.camera.cropped(window.x_px, window.y_px, window.width_px, window.height_px)
    scene = seen_from(station, above())
    rng = np.random.default_rng(0)
    slow = render_laser(scene, camera, head.lasers[0], Speckle(0.0, 0.0), rng).light
    inner = (slice(10, -10), slice(10, -10))
    assert slow[inner].max() > 0.3
    # the two coarse grids differ: each misses a few faint pixels where the ball falls away
    assert np.abs(quick - slow)[inner].max() < 0.03 * slow.max()
    assert np.abs(quick - slow)[inner].mean() < 2e-5 * slow.max()


def test_a_window_is_a_crop_of_the_full_sensor() -> None:
    head = quiet(build_head())
    head = replace(head, imaging=replace(head.imaging, ambient=0.1))
    station = Station((GROUND, BLOCK))
    whole = light_of(head, station, head.full_window)
    part = light_of(head, station, SMALL)
    rows = slice(SMALL.y_px, SMALL.y_px + SMALL.height_px)
    columns = slice(SMALL.x_px, SMALL.x_px + SMALL.width_px)
    assert whole[rows, columns].max() > 0.3
    np.testing.assert_allclose(part, whole[rows, columns], atol=2e-5)


def test_a_block_lifts_the_line_and_hides_the_laser_behind_it() -> None:
    """Shadow on the ground along the sheet, from the block's edges: all by straight lines."""
    head = quiet(build_head(tolerances=Tolerances(*([0.0] * 8))))
    laser = head.lasers[0]
    pose = above()
    (stripe,) = true_stripes(head, Station((GROUND, BLOCK)), pose, on(head.full_window))
    on_block = stripe.points_base_mm[stripe.thing == 1]
    on_ground = stripe.points_base_mm[stripe.thing == 0]
    top = on_block[on_block[:, 2] > 5.0 - 1e-6]
    assert len(top) > 500
    assert top[:, 0].min() == pytest.approx(-10.0, abs=0.05)
    assert top[:, 0].max() == pytest.approx(10.0, abs=0.05)
    # rays over the block's top edges, from the laser and from the camera, end on the ground
    source = pose.rotation @ laser.source_mm + pose.translation_mm
    for side in (-1.0, 1.0):
        edge = top[np.argmax(side * top[:, 0])]
        shadows = [
            eye[0] + (edge[0] - eye[0]) * eye[2] / (eye[2] - 5.0)
            for eye in (source, pose.translation_mm)
        ]
        beyond = side * on_ground[side * on_ground[:, 0] > 0.0, 0]
        assert beyond.min() == pytest.approx(max(side * x for x in (*shadows, edge[0])), abs=0.1)
    light = light_of(head, Station((GROUND, BLOCK)), head.full_window)
    columns = light.sum(axis=0)
    assert (columns[100:-100] < 1e-4 * columns.max()).any()


def test_extraction_finds_the_truth_within_the_sigma_it_states() -> None:
    head = build_head("thesis-single", "thesis", 3)
    station = Station((SceneObject("plate", GROUND.surface, MATT_PAINT),))
    rng = np.random.default_rng(11)
    window = head.scan_window
    image = render_exposure(head, station, [above()], on(window), rng)
    assert image.dtype == np.uint8
    assert image.shape == (800, 2658)
    (stripe,) = true_stripes(head, station, above(), on(window))
    exposure = Exposure(
        image, "rendered", window=SensorWindow(window.x_px, window.y_px), lasers=("A",)
    )
    found = extract_stripes(exposure)
    assert len(found.points_px) > 2500
    order = np.argsort(stripe.points_px[:, 0])
    truth = np.interp(found.points_px[:, 0], *stripe.points_px[order].T)
    error = found.points_px[:, 1] - truth
    assert 0.03 < error.std() < 0.10
    assert error.std() == pytest.approx(np.median(found.sigma_px), rel=0.25)
    # neighbours share speckle: about one independent value in ten columns
    assert abs(error.mean()) < 4.0 * error.std() / np.sqrt(len(error) / 10.0)


def test_a_moving_head_smears_the_line_about_its_middle_pose() -> None:
    head = quiet(build_head())
    station = Station((GROUND,))
    window = SMALL
    poses = [above(shift) for shift in (-0.15, 0.0, 0.15)]
    rng = np.random.default_rng(0)
    moving = exposure_light(head, station, poses, on(window), rng).astype(np.float64)
    still = light_of(head, station, window)
    assert moving.sum() == pytest.approx(still.sum(), rel=5e-3)
    (stripe,) = true_stripes(head, station, poses[1], on(window))
    errors = centroid_errors(moving, stripe, window, 30)
    assert abs(errors.mean()) < 0.02
    # three lines 0.15 mm, about 5 px, apart: their variances add
    rows = np.arange(window.height_px)

    def variance(light: NDArray[np.float64]) -> float:
        profile = light[:, 250]
        mean = profile @ rows / profile.sum()
        return float(profile @ (rows - mean) ** 2 / profile.sum())

    lines = [true_stripes(head, station, pose, on(window))[0].points_px for pose in poses]
    at = [np.interp(window.x_px + 250, line[:, 0], line[:, 1]) for line in lines]
    assert variance(moving) - variance(still) == pytest.approx(np.var(at), rel=0.05)


def test_a_moving_head_sees_the_room_from_all_its_poses_alike() -> None:
    """With two poses neither is the middle: the image is the mean of both, in either order."""
    head = quiet(build_head())
    board: Pose[Base, Board] = Pose(np.diag([1.0, -1.0, -1.0]), np.array([-18.75, 15.0, 0.0]))
    station = Station((GROUND,), Target(CirclePattern(11, 9, 3.75, 1.875), board))
    settings = ExposureSettings(Window(1300, 800, 200, 160), room_light=0.9)
    early, late = above(), above(0.5)

    def light(*poses: Pose[Base, Sensor]) -> NDArray[np.float64]:
        rng = np.random.default_rng(0)
        return exposure_light(head, station, poses, settings, rng).astype(np.float64)

    first, last = light(early), light(late)
    assert np.abs(first - last).max() > 0.05
    for poses in ((early, late), (late, early)):
        assert np.abs(light(*poses) - 0.5 * (first + last)).max() < 1e-5


def test_gloss_brightens_the_mirror_direction_only() -> None:
    head = build_head("thesis-single", "thesis", 1)
    base = replace(quiet(head).imaging, gloss=1.0)
    head = replace(head, imaging=base)
    window = Window(400, 400, 2200, 1200)
    ball = BALL.surface
    matt = light_of(head, Station((SceneObject("ball", ball, MATT),)), window, 8.0)
    glossy = light_of(head, Station((SceneObject("ball", ball, Material(gloss=2.0)),)), window, 8.0)
    gain = glossy - matt
    assert gain.min() > -1e-6
    assert gain.max() > 1.0
    lit = matt > 0.2 * matt.max()
    ratio = gain[lit] / matt[lit]
    # somewhere on the ball the half-way direction is many lobe widths off
    assert ratio.min() < 0.01 * ratio.max()


def test_a_post_stands_in_the_cameras_way() -> None:
    post_pose: Pose[Base, Part] = Pose(np.eye(3), np.array([0.0, 6.0, 0.0]))
    post = SceneObject("post", Placed(Box(np.array([4.0, 4.0, 40.0])), post_pose), MATT)
    head = quiet(build_head(tolerances=Tolerances(*([0.0] * 8))))
    pose = above()
    free = true_stripes(head, Station((GROUND,)), pose, on(head.full_window))[0]
    hidden = true_stripes(head, Station((GROUND, post)), pose, on(head.full_window))[0]
    ground = hidden.points_base_mm[hidden.thing == 0]
    assert len(ground) < len(free.points_base_mm) - 50
    for eye in (
        pose.translation_mm,
        pose.rotation @ head.lasers[0].source_mm + pose.translation_mm,
    ):
        share = np.linspace(0.02, 0.98, 200)[None, :, None]
        path = ground[:, None, :] + share * (eye - ground)[:, None, :]
        inside = np.hypot(path[..., 0], path[..., 1] - 6.0) < 2.0 - 0.05
        assert not (inside & (path[..., 2] < 40.0 - 0.05)).any()


def test_same_seed_same_image_and_presets_differ_in_noise() -> None:
    station = Station((GROUND,))
    noise = {}
    for preset in ("clean", "thesis", "harsh"):
        head = build_head("thesis-single", preset, 1)
        images = [
            render_exposure(head, station, [above()], on(SMALL), np.random.default_rng(seed))
            for seed in (5, 5, 6)
        ]
        np.testing.assert_array_equal(images[0], images[1])
        assert (images[0] != images[2]).any()
        dark = images[0][:50].astype(float)
        noise[preset] = float(dark.std()) + float(dark.mean())
    assert noise["clean"] < noise["thesis"] < noise["harsh"]


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_noise_is_shot_plus_read_plus_rounding(bits: int, dtype: type) -> None:
    head = build_head()
    detector = replace(
        head.imaging.detector, bits=bits, electrons_per_level=25.0, read_noise=1.5, halo_share=0.0
    )
    head = replace(head, imaging=replace(head.imaging, detector=detector))
    settings = ExposureSettings(SMALL, room_light=0.6)
    image = render_exposure(head, Station((GROUND,)), [above()], settings, np.random.default_rng(2))
    light = exposure_light(head, Station((GROUND,)), [above()], settings, np.random.default_rng(2))
    assert image.dtype == dtype
    step = 255.0 / (2**bits - 1)
    level = 255.0 * light.astype(float)
    error = image * step - level
    expected = float(level.mean()) / 25.0 + 1.5**2 + step**2 / 12.0
    assert error.mean() == pytest.approx(0.0, abs=4 * np.sqrt(expected / error.size))
    assert error.var() == pytest.approx(expected, rel=4 * np.sqrt(2.0 / error.size) + 0.01)


def test_a_target_is_drawn_where_it_projects() -> None:
    head = quiet(build_head())
    pattern = CirclePattern(11, 9, 3.75, 1.875)
    board: Pose[Base, Board] = Pose(np.diag([1.0, -1.0, -1.0]), np.array([-18.75, 15.0, 0.0]))
    station = Station((), Target(pattern, board))
    window = Window(1100, 700, 800, 600)
    settings = ExposureSettings(window, room_light=0.9)
    pose = above()
    image = exposure_light(head, station, [pose], settings, np.random.default_rng(0))
    sensor_from_board = pose.inverse() @ board
    marks = pattern.marks_board_mm @ sensor_from_board.rotation.T + sensor_from_board.translation_mm
    pixels = head.camera.project(marks) - [window.x_px, window.y_px]
    size = [window.width_px, window.height_px]
    inside = ((pixels > 60) & (pixels < np.array(size) - 60)).all(axis=1)
    assert inside.sum() >= 9
    for x, y in pixels[inside]:
        left, top = round(x) - 55, round(y) - 55
        patch = float(image.max()) - image[top : top + 111, left : left + 111].astype(float)
        dark = np.where(patch > 0.4 * patch.max(), patch, 0.0)
        rows, columns = np.indices(dark.shape)
        centre = [(dark * columns).sum() / dark.sum(), (dark * rows).sum() / dark.sum()]
        # the centre of an ellipse is not the image of the disc's centre: up to 0.03 px here
        assert np.hypot(centre[0] + left - x, centre[1] + top - y) < 0.15
    lit = exposure_light(
        head, station, [pose], on(window, room_light=0.2), np.random.default_rng(0)
    )
    assert lit.max() > 0.3
    (stripe,) = true_stripes(head, station, pose, on(window))
    assert np.abs(stripe.points_base_mm[:, 2]).max() < 1e-6


def test_foreign_lasers_and_missing_poses_are_refused() -> None:
    head = build_head()
    settings = ExposureSettings(SMALL, ("B",))
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="has no laser 'B'"):
        render_exposure(head, Station((GROUND,)), [above()], settings, rng)
    with pytest.raises(InputError, match="needs a pose"):
        render_exposure(head, Station((GROUND,)), [], on(SMALL), rng)
    with pytest.raises(InputError, match="negative"):
        ExposureSettings(SMALL, room_light=-0.1)
