# SPDX-License-Identifier: Apache-2.0
"""Rendered stripes against arithmetic done by hand, and where the light goes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.geometry.poses import Part, Pose, Sensor
from armscan.simulation.objects.body import Body, MetaballLimb
from armscan.simulation.optics.camera import Detector, RenderCamera, expose_mono
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.render import Speckle, camera_rays
from armscan.simulation.optics.scene import Floor, RoomLight, Scene, Sphere
from rigs.slow_renderer import laser_band, render_laser, render_room

WHITE = (1.0, 1.0, 1.0)
NO_SPECKLE = Speckle(contrast=0.0)
RNG_SEED = 5
TILTED = np.array([0.35, -0.2, -0.9])
"""Normal of the tilted plane; it passes (0, 0, 300)."""


def camera(blur_px: float = 0.8, **distortion: float) -> RenderCamera:
    return RenderCamera(
        500.0, 500.0, 159.5, 119.5, width_px=320, height_px=240, blur_sigma_px=blur_px, **distortion
    )


def side_laser(skew_rad: float = 0.0, waist_mm: float = 0.8, **changes: Any) -> LineLaser:
    return LineLaser(
        "A",
        np.array([-120.0, 0.0, 10.0]),
        np.array([120.0, 0.0, 290.0]),
        np.array([0.0, 1.0, 0.0]),
        skew_rad=skew_rad,
        waist_mm=waist_mm,
        **changes,
    )


def tilted_plane() -> Floor:
    return Floor(np.array([0.0, 0.0, 300.0]), TILTED, WHITE)


def rendered(
    scene: Scene, lens: RenderCamera, speckle: Speckle = NO_SPECKLE
) -> NDArray[np.float64]:
    rng = np.random.default_rng(RNG_SEED)
    return render_laser(scene, lens, scene.lasers[0], speckle, rng).light


def test_stripe_on_a_plane_lies_where_three_planes_meet() -> None:
    """Pixel row, object plane and light plane: solved by hand, a camera without distortion."""
    laser = side_laser()
    scene = Scene((tilted_plane(),), (laser,))
    truth = render_laser(scene, camera(), laser, NO_SPECKLE, np.random.default_rng(0)).truth
    light_normal = np.cross(laser.forward, laser.across)
    rows = truth.points_px[:, 1]
    assert len(rows) > 200
    for pixel, point in zip(truth.points_px, truth.points_mm, strict=True):
        row_plane = np.array([0.0, -500.0, pixel[1] - 119.5])
        corner = np.linalg.solve(
            np.stack([row_plane, TILTED, light_normal]),
            [0.0, TILTED @ [0.0, 0.0, 300.0], light_normal @ laser.source_mm],
        )
        np.testing.assert_allclose(point, corner, atol=1e-6)
        by_hand = 159.5 + 500.0 * corner[0] / corner[2]
        assert pixel[0] == pytest.approx(by_hand, abs=1e-6)


@pytest.mark.parametrize("skew_rad", [0.0, 0.02])
def test_centroid_of_the_rendered_light_is_the_true_centre(skew_rad: float) -> None:
    laser = side_laser(skew_rad, waist_mm=0.3)
    lens = camera(k1=-0.1, p1=5e-4)
    scene = Scene((tilted_plane(),), (laser,))
    result = render_laser(scene, lens, laser, NO_SPECKLE, np.random.default_rng(0))
    columns = np.arange(lens.width_px)
    inner = result.truth.points_px[15:-15]
    light = result.light[np.rint(inner[:, 1]).astype(int)]
    centroid = light @ columns / light.sum(axis=1)
    # Distance, angle and perspective each change by sigma / distance across the line, which
    # shifts the centroid by as many sigmas: 1 mm / 300 mm * 0.6 px.
    assert np.abs(centroid - inner[:, 0]).max() < 0.6 * 1.0 / 300.0 * 2


def test_truth_projects_onto_its_pixels_and_lies_on_sheet_and_surface() -> None:
    pose: Pose[Sensor, Part] = Pose(np.eye(3), np.array([0.0, 0.0, 300.0]))
    body = Body(
        (
            MetaballLimb((-8, -40, 0), (4, 40, 0), 25.0, 15.0),
            MetaballLimb((0, 0, -25), (0, 5, -26), 9, 8, 5),
        ),
        pose,
    )
    laser = side_laser(0.02)
    lens = camera(k1=-0.1)
    scene = Scene((body,), (laser,))
    truth = render_laser(scene, lens, laser, NO_SPECKLE, np.random.default_rng(0)).truth
    assert len(truth.points_px) > 60
    np.testing.assert_allclose(lens.project(truth.points_mm), truth.points_px, atol=1e-6)
    assert np.abs(body.distance_mm(truth.points_mm)).max() < 1e-4
    assert np.abs(laser.offset_mm(truth.points_mm)).max() < 1e-4


def test_a_ball_interrupts_the_line_for_camera_and_laser() -> None:
    laser = side_laser()
    ball = Sphere(np.array([0.0, 0.0, 290.0]), 12.0, WHITE)
    wall = Floor(np.array([0.0, 0.0, 420.0]), np.array([0.0, 0.0, -1.0]), WHITE)
    truth = render_laser(
        Scene((ball, wall), (laser,)), camera(), laser, NO_SPECKLE, np.random.default_rng(0)
    ).truth
    on_wall = truth.points_px[truth.surface == 1]
    on_ball = truth.points_px[truth.surface == 0]
    # The ball's shadow on the wall: tangent rays from the source in the light plane.
    to_ball = ball.centre_mm - laser.source_mm
    off_plane = to_ball @ laser.normal
    in_plane = np.sqrt(12.0**2 - off_plane**2)
    flat = np.linalg.norm(to_ball - off_plane * laser.normal)
    slope = np.tan(np.arcsin(in_plane / flat))
    reach = (420.0 - 10.0) / laser.forward[2]
    shadow_px = 500.0 * slope * reach / 420.0
    gap = np.abs(on_wall[:, 1] - 119.5).min()
    assert gap == pytest.approx(shadow_px, abs=1.0)
    assert len(on_ball) > 10
    assert np.abs(on_ball[:, 1] - 119.5).max() < shadow_px


def test_the_band_holds_all_light_and_little_else() -> None:
    laser = side_laser(0.02)
    lens = camera()
    ball = Sphere(np.array([-5.0, 10.0, 280.0]), 15.0, WHITE)
    scene = Scene((tilted_plane(), ball), (laser,))
    rows, columns = np.indices((240, 320))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    everywhere = scene.laser_light(laser, scene.trace(np.zeros(3), camera_rays(lens, pixels)))
    band = laser_band(scene, lens, laser)
    assert everywhere[~band.ravel()].max() < 1e-6
    assert everywhere.max() > 0.5
    assert band.mean() < 0.25


def test_blur_moves_light_and_loses_none() -> None:
    scene = Scene((Sphere(np.array([0.0, 0.0, 300.0]), 30.0, WHITE),), (side_laser(),))
    sharp, soft = rendered(scene, camera(0.0)), rendered(scene, camera(2.0))
    assert soft.sum() == pytest.approx(sharp.sum(), rel=1e-6)
    assert soft.max() < 0.8 * sharp.max()


def test_blur_widens_the_line_as_variances_add() -> None:
    lens_sigma = 1.5
    scene = Scene((tilted_plane(),), (side_laser(),))
    columns = np.arange(320)

    def variance(light: NDArray[np.float64]) -> float:
        row = light[120]
        mean = row @ columns / row.sum()
        return float(row @ (columns - mean) ** 2 / row.sum())

    gain = variance(rendered(scene, camera(lens_sigma))) - variance(rendered(scene, camera(0.0)))
    assert gain == pytest.approx(lens_sigma**2, rel=0.03)


def test_speckle_has_mean_one_and_the_stated_contrast() -> None:
    plane = Floor(np.array([0.0, 0.0, 300.0]), np.array([0.0, 0.0, -1.0]), WHITE)
    scene = Scene((plane,), (side_laser(divergence_rad=0.0),))
    lens = camera(0.0)
    clean = rendered(scene, lens)
    bright = clean > 0.3
    for grain_px in (0.0, 2.0):
        ratio = rendered(scene, lens, Speckle(0.3, grain_px))[bright] / clean[bright]
        # a pixel averages four fine samples; they are alike if the grain is coarse
        contrast = 0.3 / 2.0 if grain_px == 0.0 else 0.3
        n_grains = ratio.size / max(1.0, 4.0 * np.pi * grain_px**2)
        assert ratio.mean() == pytest.approx(1.0, abs=4 * contrast / np.sqrt(n_grains))
        assert ratio.std() == pytest.approx(contrast, rel=4 / np.sqrt(2 * n_grains) + 0.05)


def test_room_image_shows_the_ball_before_the_wall() -> None:
    ball = Sphere(np.array([0.0, 0.0, 300.0]), 30.0, (0.9, 0.6, 0.3))
    wall = Floor(np.array([0.0, 0.0, 500.0]), np.array([0.0, 0.0, -1.0]), (0.1, 0.2, 0.3))
    lamp = RoomLight(even=0.9, direct=0.0)
    image = render_room(Scene((ball, wall), lamp=lamp), camera(0.0))
    assert image.shape == (240, 320, 3)
    # both surfaces face the camera here: two thirds of the even light
    np.testing.assert_allclose(image[120, 160], 0.6 * np.array([0.9, 0.6, 0.3]), atol=0.01)
    np.testing.assert_allclose(image[10, 10], 0.6 * np.array([0.1, 0.2, 0.3]), rtol=1e-9)
    radius_px = 500.0 * np.tan(np.arcsin(30.0 / 300.0))
    n_ball = int((image[..., 0] > image[..., 2]).sum())
    assert n_ball == pytest.approx(np.pi * radius_px**2, rel=0.01)


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_detector_noise_is_shot_plus_read_plus_rounding(bits: int, dtype: type) -> None:
    level = 100.0
    detector = Detector(bits=bits, electrons_per_level=25.0, read_noise=1.5)
    light = np.full((300, 300), level / 255.0, np.float32)
    grey = expose_mono(light, detector, np.random.default_rng(3))
    assert grey.dtype == dtype
    step = 255.0 / (2**bits - 1)
    expected = level / 25.0 + 1.5**2 + step**2 / 12.0
    values = grey.astype(float) * step
    assert values.mean() == pytest.approx(level, abs=4 * np.sqrt(expected / values.size))
    assert values.var() == pytest.approx(expected, rel=4 * np.sqrt(2.0 / values.size))
