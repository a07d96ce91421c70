# SPDX-License-Identifier: Apache-2.0
"""Images without a line, tiny images, deep images, and options that make no sense."""

import numpy as np
import pytest

from armscan.errors import InputError, OptionError
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions
from rigs.stripe_image import StripeScene
from rigs.stripe_scenes import line

METHODS = ("fit", "threshold", "centroid", "template", "hessian")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [(120, 160), (7, 9), (1, 1), (1, 300), (200, 2), (90, 120, 3)])
@pytest.mark.parametrize("level", [0, 100, 255])
def test_even_images_hold_no_stripe(method: str, shape: tuple[int, ...], level: int) -> None:
    exposure = Exposure(np.full(shape, level, np.uint8), "even")
    assert len(extract_stripes(exposure, StripeOptions(method=method))) == 0


def test_pure_noise_holds_no_accepted_stripe() -> None:
    rng = np.random.default_rng(1)
    for spread in (1.0, 8.0):
        image = np.clip(rng.normal(60.0, spread, (300, 400)), 0, 255).astype(np.uint8)
        assert not extract_stripes(Exposure(image, "noise")).is_accepted.any()


def test_line_at_the_border_is_kept_or_dropped_but_not_wrong() -> None:
    scene = StripeScene((line(3.0),), 320, 124)
    profile = extract_stripes(scene.expose(2))
    error, _, _ = scene.errors(profile.points_px[profile.is_accepted])
    assert np.abs(error).max() < 1.0


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_bit_depths(bits: int) -> None:
    scene = StripeScene((line(15.0),), 320, 240, bits=bits)
    profile = extract_stripes(scene.expose(4))
    error, _, _ = scene.errors(profile.points_px)
    assert len(profile) > 300
    assert np.sqrt((error**2).mean()) < 0.045
    assert np.median(profile.intensity) == pytest.approx(150.0 * (2**bits - 1) / 255.0, rel=0.05)


def test_bright_wide_area_is_no_stripe() -> None:
    exposure = StripeScene((line(0.0),), 320, 240).expose(1)
    image = exposure.image.copy()
    image[170:, :] = 250
    profile = extract_stripes(Exposure(image, "table"))
    assert (profile.points_px[profile.is_accepted, 1] < 130).all()
    assert profile.is_accepted.sum() > 300


def test_background_of_another_size_is_refused() -> None:
    scene = StripeScene((line(0.0),), 320, 240)
    with pytest.raises(InputError, match="same camera settings"):
        extract_stripes(scene.expose(1), background=Exposure(np.zeros((9, 9), np.uint8), "dark"))


@pytest.mark.parametrize(
    "wrong",
    [
        {"method": "steger"},
        {"laser_colour": "infrared"},
        {"line_sigma_px": 0.1},
        {"threshold": -1.0},
        {"smoothing_px": -2.0},
        {"smoothing_px": 101.0},
    ],
)
def test_wrong_options_are_named(wrong: dict[str, object]) -> None:
    with pytest.raises(OptionError, match=next(iter(wrong))):
        StripeOptions(**wrong)
