# SPDX-License-Identifier: Apache-2.0
"""The thesis's four methods: each does what it says, no more and no less."""

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeMethod, StripeOptions, mono_plane
from armscan.vision.stripe.ridge import measure_level
from armscan.vision.stripe.thesis import THESIS_METHODS
from rigs.stripe_image import NO_NOISE, CircleCurve, SimulatedStripe, StripeScene
from rigs.stripe_scenes import line, score

METHODS: tuple[StripeMethod, ...] = ("threshold", "centroid", "template", "hessian")
NOISE_PX = {"threshold": 0.4, "centroid": 0.2, "template": 0.45, "hessian": 0.1}


def centres(method: str, scene: StripeScene, threshold: float = 20.0) -> FloatArray:
    image = mono_plane(scene.expose(1), None).image
    return THESIS_METHODS[method](image, measure_level(image, threshold), 3.0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("angle_deg", [3.0, 86.0])
def test_noise_is_the_methods_own_and_the_mean_is_right(
    method: StripeMethod, angle_deg: float
) -> None:
    scene = StripeScene((line(angle_deg),), 320, 240)
    result = score(scene, range(3), StripeOptions(method=method))
    assert result.rms_px < NOISE_PX[method]
    assert abs(result.error_px.mean()) < 0.05
    assert result.normalised.std() < 3.0


@pytest.mark.parametrize("method", ["threshold", "template"])
def test_what_pixels_round_is_in_sigma_and_shared_along_the_line(method: StripeMethod) -> None:
    """A level line without noise lies beside the truth by the same all along."""
    means, sigmas, of_means = [], [], []
    rows = np.tile(np.arange(60.0)[:, None], (1, 300))
    for y in 30.02 + np.arange(0.0, 1.0, 0.125):
        grey = np.round(10.0 + 150.0 * np.exp(-0.5 * ((rows - y) / 2.6) ** 2))
        found = extract_stripes(Exposure(grey.astype(np.uint8), "a"), StripeOptions(method=method))
        assert found.noise_length is not None
        means.append(float(found.points_px[:, 1].mean()) - y)
        sigmas.append(float(found.sigma_px[0]))
        of_means.append(float(np.sqrt((found.sigma_px**2 * found.noise_length).sum()) / len(found)))
    rms = float(np.sqrt(np.mean(np.square(means))))
    assert rms > 0.1
    for stated in (sigmas, of_means):
        assert rms < 1.05 * np.sqrt(np.mean(np.square(stated))) < 3.0 * rms


def test_threshold_gives_the_middle_of_the_run() -> None:
    scene = StripeScene((line(0.0),), 40, 240, noise=NO_NOISE)
    found = centres("threshold", scene)
    assert len(found) == 40
    assert np.unique(found[:, 1] * 2 % 1).tolist() == [0.0]
    assert np.abs(found[:, 1] - 120.2).max() <= 0.5


def test_centroid_is_exact_for_a_symmetric_noise_free_line() -> None:
    scene = StripeScene((line(0.0),), 40, 240, background=0.0, noise=NO_NOISE, bits=16)
    assert np.abs(centres("centroid", scene, 0.5)[:, 1] - 120.2).max() < 0.02


def test_template_gives_whole_pixels_and_the_nearest_direction() -> None:
    found = centres("template", StripeScene((line(45.0),), 320, 240, noise=NO_NOISE))
    assert (found[:, :2] == np.rint(found[:, :2])).all()
    direction = np.median(np.abs(found[:, 2:]), axis=0)
    assert direction == pytest.approx([np.sqrt(0.5), np.sqrt(0.5)])


def test_hessian_has_the_known_bias_on_a_circle() -> None:
    radius, sigma = 80.0, 3.0
    stripe = SimulatedStripe(CircleCurve(120.0, 120.0, radius), sigma_px=sigma)
    scene = StripeScene((stripe,), 240, 240, noise=NO_NOISE)
    error, _, _ = scene.errors(centres("hessian", scene)[:, :2])
    assert error.mean() == pytest.approx(-(sigma**2) / (2.0 * radius), rel=0.15)


@pytest.mark.parametrize("method", METHODS)
def test_profiles_are_linked_and_flagged_alike(method: StripeMethod) -> None:
    scene = StripeScene((line(12.0, peak=600.0),), 320, 240)
    profile = extract_stripes(scene.expose(1), StripeOptions(method=method))
    step = np.hypot(*np.diff(profile.points_px, axis=0).T)
    assert step[np.diff(profile.segment) == 0].max() < 4.0
    assert (profile.flags & 1).mean() > 0.9
    assert len(np.unique(profile.sigma_px)) == 1
