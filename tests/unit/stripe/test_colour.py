# SPDX-License-Identifier: Apache-2.0
"""Colour exposures: laser colour, saturated core with halo, laser-off views."""

import numpy as np
import pytest

from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import (
    StripeOptions,
    colour_planes,
    find_laser_colour,
    split_channels,
    subtract,
)
from rigs.stripe_image import StripeNoise, StripeScene
from rigs.stripe_scenes import line

SCENE = StripeScene((line(75.0),), 320, 240)
ROLL = {"red": 0, "green": 1, "blue": 2}
SAME_PX = 0.06


@pytest.mark.parametrize("colour", ["red", "green", "blue"])
def test_laser_colour_is_found(colour: str) -> None:
    image = np.roll(SCENE.expose_red(1, overdrive=1.0).image, ROLL[colour], axis=2)
    exposure = Exposure(image, colour)
    assert find_laser_colour(split_channels(exposure, None)) == colour
    profile = extract_stripes(exposure)
    error, _, _ = SCENE.errors(profile.points_px)
    assert profile.is_accepted.sum() > 200
    assert np.sqrt((error**2).mean()) < SAME_PX


def test_grey_line_in_a_colour_image() -> None:
    grey = SCENE.expose(1).image
    exposure = Exposure(np.stack([grey] * 3, axis=2), "grey")
    assert find_laser_colour(split_channels(exposure, None)) == "grey"
    assert np.abs(SCENE.errors(extract_stripes(exposure).points_px)[0]).max() < 0.3


@pytest.mark.parametrize("overdrive", [2.0, 6.0])
def test_saturated_core_with_halo(overdrive: float) -> None:
    exposure = SCENE.expose_red(2, overdrive)
    profile = extract_stripes(exposure)
    good = profile.select(profile.is_accepted)
    error, _, _ = SCENE.errors(good.points_px)
    assert (exposure.image[..., 0] == 255).mean() > 0.01
    assert len(good) > 200
    assert np.sqrt((error**2).mean()) < 0.1
    assert (np.abs(error) < 5.0 * good.sigma_px).all()


def test_glow_that_fills_the_lasers_own_channel_leaves_the_others() -> None:
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:240, :320]
    distance = (y - 100.0 - 0.2 * x) / np.hypot(1.0, 0.2)
    core = 700.0 * np.exp(-0.5 * (distance / 3.0) ** 2)
    # what the surface scatters, more of it on one side
    glow = 900.0 * np.exp(-0.5 * ((distance - 2.0) / 10.0) ** 2)
    light = np.stack([core + glow, core, 0.9 * core], axis=2) + 8.0
    image = np.clip(light + rng.normal(0.0, 1.5, light.shape), 0.0, 255.0).astype(np.uint8)
    profile = extract_stripes(Exposure(image, "glow"), StripeOptions(laser_colour="red"))
    good = profile.select(profile.is_accepted)
    column, row = good.points_px.T
    error = (row - 100.0 - 0.2 * column) / np.hypot(1.0, 0.2)
    assert (image[..., 0] == 255).mean() > 0.1
    assert len(good) > 290
    assert np.abs(error.mean()) < 0.02
    assert (np.abs(error) < 5.0 * good.sigma_px).all()


@pytest.mark.parametrize(
    ("sigma_px", "share", "n"), [(10, 1, 2), (10, 0.1, 2), (5, 1, 1), (10, 0.01, 1)]
)
def test_two_planes_are_looked_at_where_glow_fills_the_channel(
    sigma_px: float, share: float, n: int
) -> None:
    """A halo of 5 px leaves 14 px beside the line dark; a hundredth of it is not worth the time."""
    y, x = np.mgrid[:240, :640]
    core = 700.0 * np.exp(-0.5 * ((y - 100.0) / 3.0) ** 2)
    glow = 900.0 * np.exp(-0.5 * ((y - 100.0) / sigma_px) ** 2)
    dim = 150.0 * np.exp(-0.5 * ((y - 100.0) / 2.0) ** 2)
    is_white = x < share * 640
    light = np.stack(
        [np.where(is_white, core + glow, dim)] + 2 * [np.where(is_white, core, 0.05 * dim)], axis=2
    )
    image = np.clip(light + 8.0, 0.0, 255.0).astype(np.uint8)
    assert len(colour_planes(Exposure(image, "planes"), None, "red")) == n


@pytest.mark.parametrize("share", [0.1, 0.3])
@pytest.mark.parametrize("peak", [150.0, 450.0])
def test_a_line_that_glows_in_part_keeps_the_rest(share: float, peak: float) -> None:
    """What is dim beside an over-exposed part shows in the laser's own channel alone."""
    rng = np.random.default_rng(9)
    y, x = np.mgrid[:240, :640]
    distance = (y - 100.0 - 0.1 * x) / np.hypot(1.0, 0.1)
    is_white = x < share * 640
    core = np.where(is_white, 700.0, peak) * np.exp(
        -0.5 * (distance / np.where(is_white, 3.0, 2.0)) ** 2
    )
    glow = np.where(is_white, 900.0, 0.0) * np.exp(-0.5 * (distance / 10.0) ** 2)
    leak = np.where(is_white, 1.0, 0.08)
    light = np.stack([core + glow, leak * core, 0.7 * leak * core], axis=2) + 8.0
    image = np.clip(light + rng.normal(0.0, 1.5, light.shape), 0.0, 255.0).astype(np.uint8)
    profile = extract_stripes(Exposure(image, "part"), StripeOptions(laser_colour="red"))
    good = profile.points_px[profile.is_accepted]
    column, row = good.T
    assert (column > share * 640).sum() > 0.9 * (1.0 - share) * 640
    error = (row - 100.0 - 0.1 * column) / np.hypot(1.0, 0.1)
    assert np.sqrt((error**2).mean()) < SAME_PX


def test_white_things_before_a_wall_of_the_lasers_colour_cost_no_line() -> None:
    rng = np.random.default_rng(10)
    y, x = np.mgrid[:480, :640]
    wall = (y < 200)[..., None] * np.array([270.0, 120.0, 110.0])
    wall[60:70, 200:360] = 250.0
    line_at = 350.0 + 0.1 * x
    stripe = 150.0 * np.exp(-0.5 * ((y - line_at) / 2.0) ** 2)
    light = wall + stripe[..., None] * np.array([1.0, 0.08, 0.05]) + 8.0
    image = np.clip(light + rng.normal(0.0, 1.5, light.shape), 0.0, 255.0).astype(np.uint8)
    profile = extract_stripes(Exposure(image, "wall"), StripeOptions(laser_colour="red"))
    column, row = profile.points_px[profile.is_accepted].T
    assert (np.abs(row - 350.0 - 0.1 * column) < 1.0).sum() > 620


def test_wide_white_things_do_not_tell_how_wide_the_laser_is() -> None:
    """Sheets and folds in the room are wide, bright and many; the line is narrow on a dark box."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:480, :640]
    folds = sum(np.exp(-0.5 * ((y - v) / 12.0) ** 2) for v in range(20, 480, 60))
    room = 250.0 * folds * (np.abs(x - 320.0) > 80.0)
    line_at = 320.0 + 0.05 * y
    stripe = 150.0 * np.exp(-0.5 * ((x - line_at) / 1.7) ** 2)
    light = room[..., None] + stripe[..., None] * np.array([1.0, 0.1, 0.1]) + 20.0
    image = np.clip(light + rng.normal(0.0, 2.0, light.shape), 0.0, 255.0).astype(np.uint8)
    profile = extract_stripes(Exposure(image, "room"), StripeOptions(laser_colour="red"))
    column, row = profile.points_px[profile.is_accepted].T
    error = column - 320.0 - 0.05 * row
    assert (np.abs(error) < 1.0).sum() > 450
    assert np.sqrt((error[np.abs(error) < 1.0] ** 2).mean()) < SAME_PX


def test_line_of_another_colour_is_left_out() -> None:
    laser = SCENE.expose_red(3, overdrive=1.0).image.copy()
    other = StripeScene((line(10.0),), 320, 240).expose(4).image
    laser[..., 1] = np.maximum(laser[..., 1], other)
    laser[..., 2] = np.maximum(laser[..., 2], other)
    laser[..., 0] = np.maximum(laser[..., 0], other)
    profile = extract_stripes(Exposure(laser, "two"), StripeOptions(laser_colour="red"))
    good = profile.points_px[profile.is_accepted]
    assert (np.abs(SCENE.errors(good)[0]) < 1.0).mean() > 0.98


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (1.08, 0.0), (0.93, 3.0)])
def test_laser_off_view_removes_texture_even_if_the_light_changed(
    gain: float, offset: float
) -> None:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:240, :320]
    squares = 40.0 + 70.0 * ((x // 30 + y // 30) % 2)
    stripe = StripeScene((line(80.0),), 320, 240, background=0.0, noise=StripeNoise(read=0.0))
    light = stripe.expose(6).image.astype(np.float64)
    lit = squares + light + rng.normal(0, 1, squares.shape)
    dark = (squares - offset) / gain + rng.normal(0, 1, squares.shape)
    pair = [
        Exposure(np.clip(v, 0, 255).astype(np.uint8), n) for v, n in ((lit, "on"), (dark, "off"))
    ]
    profile = extract_stripes(pair[0], background=pair[1])
    good = profile.points_px[profile.is_accepted]
    error, _, _ = stripe.errors(good)
    assert len(good) > 225
    assert (np.abs(error) < 1.0).all()
    assert np.sqrt((error**2).mean()) < 0.06


@pytest.mark.parametrize("gain", [1.1, 0.01])
def test_subtraction_finds_gain_and_offset(gain: float) -> None:
    """A room that is nearly dark while the laser is on has a gain of next to nothing."""
    rng = np.random.default_rng(7)
    dark = rng.uniform(10, 120, (200, 200)).astype(np.float32)
    lit = gain * dark + 4.0
    lit[:, 95:105] += 90.0
    rest = subtract(lit.astype(np.float32), dark, 255.0)
    assert np.abs(rest[:, :90]).max() < 0.5
    assert rest[:, 100].mean() == pytest.approx(90.0, abs=0.5)
