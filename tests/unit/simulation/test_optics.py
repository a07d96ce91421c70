# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest

from armscan.errors import InputError
from armscan.simulation.optics.camera import RenderCamera, blur_image
from rigs.slow_renderer import add_noise

CAMERA = RenderCamera(
    1500.0, 1490.0, 610.0, 440.0, -0.2, 0.08, 1e-3, -7e-4, 0.01, width_px=1200, height_px=900
)


def test_projection_agrees_with_opencv() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-40, -30, 120], [40, 30, 180], (200, 3))
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    k = np.array([CAMERA.k1, CAMERA.k2, CAMERA.p1, CAMERA.p2, CAMERA.k3])
    oracle = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, k)[0].reshape(-1, 2)
    np.testing.assert_allclose(CAMERA.project(points), oracle, atol=1e-9)


def test_rays_invert_the_projection_over_the_whole_sensor() -> None:
    u, v = np.meshgrid(np.linspace(-0.5, 1199.5, 25), np.linspace(-0.5, 899.5, 19))
    pixels = np.stack([u, v], axis=-1)
    rays = CAMERA.rays(pixels)
    points = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
    np.testing.assert_allclose(CAMERA.project(250.0 * points), pixels, atol=1e-8)


def test_points_behind_the_camera_have_no_image() -> None:
    assert np.isnan(CAMERA.project(np.array([[0.0, 0.0, -10.0], [1.0, 1.0, 0.0]]))).all()


def test_a_distortion_that_folds_over_is_refused() -> None:
    camera = RenderCamera(300.0, 300.0, 320.0, 240.0, k1=-1.0, width_px=640, height_px=480)
    with pytest.raises(InputError, match="cannot be inverted"):
        camera.rays(np.array([[0.0, 0.0]]))


def test_blur_has_the_variance_asked_for() -> None:
    impulse = np.zeros((61, 61))
    impulse[30, 30] = 1.0
    blurred = blur_image(impulse, 2.3)
    offset = np.arange(61) - 30.0
    assert blurred.sum() == pytest.approx(1.0, abs=1e-12)
    assert (blurred.sum(axis=0) * offset**2).sum() == pytest.approx(2.3**2, rel=1e-5)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_noise_has_the_variance_asked_for_at_every_bit_depth(bits: int) -> None:
    image = np.full((300, 400), 100.0)
    noisy = add_noise(image, np.random.default_rng(2), sigma=2.0, electrons_per_level=20, bits=bits)
    level = 255.0 / ((1 << bits) - 1)
    expected = 4.0 + 100.0 / 20.0 + level**2 / 12.0
    n = image.size
    assert noisy.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.var(noisy * level) == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 / n))
    assert np.mean(noisy * level) == pytest.approx(100.0, abs=4.0 * np.sqrt(expected / n))
