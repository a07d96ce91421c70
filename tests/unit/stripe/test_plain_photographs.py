# SPDX-License-Identifier: Apache-2.0
"""What ordinary photographs do to a stripe: thick saturated lines, crops, patterns."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from armscan.records.exposure import Exposure, SensorWindow
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import is_thresholded, lit_plane, mono_plane
from armscan.vision.stripe.ridge import find_candidates, find_line_sigma, measure_level
from rigs.stripe_image import StripeNoise, StripeScene
from rigs.stripe_scenes import line


def thick_line(seed: int, sigma_px: float) -> np.ndarray:
    """A line that saturates over most of its width, among many narrow bright scratches."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:400, :500].astype(np.float64)
    image = 20.0 + 2000.0 * np.exp(-0.5 * ((x - 240.0 - 0.05 * y) / sigma_px) ** 2)
    for _ in range(60):
        x0, y0 = rng.uniform(0, 480), rng.uniform(0, 380)
        slant = rng.uniform(-1.0, 1.0)
        near = np.abs(x - x0 - slant * (y - y0)) < 1.0
        image += 60.0 * (near & (np.abs(y - y0) < 14.0))
    image += rng.normal(0.0, 2.0, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def test_a_thick_saturated_line_sets_the_width_and_is_found() -> None:
    """Sigma 5 px, eight times full scale: 20 px of white, where narrow filters see nothing."""
    for seed in range(4):
        image = thick_line(seed, 5.0)
        plane = image.astype(np.float32)
        level = measure_level(plane, None)
        sigma = find_line_sigma(plane, find_candidates(plane, level), level)
        assert sigma > 4.0, "not that of the scratches, about 1"
        profile = extract_stripes(Exposure(image, "thick"))
        good = profile.points_px[profile.is_accepted]
        off = good[:, 0] - 240.0 - 0.05 * good[:, 1]
        on_line = np.abs(off) < 3.0
        assert on_line.sum() > 340
        assert np.sqrt((off[on_line] ** 2).mean()) < 0.15


def test_few_bright_reflections_do_not_set_the_width_of_a_thick_line() -> None:
    """They bend more than a line that is white over 20 px, and are a tenth as many candidates."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        y, x = np.mgrid[:700, :600].astype(np.float64)
        image = 20.0 + 1000.0 * np.exp(-0.5 * ((x - 240.0 - 0.05 * y) / 6.0) ** 2)
        for x0, y0 in rng.uniform((340.0, 20.0), (580.0, 680.0), (8, 2)):
            near = np.abs(x - x0 - rng.uniform(-0.5, 0.5) * (y - y0)) < 1.5
            image += 220.0 * (near & (np.abs(y - y0) < 8.0))
        image += rng.normal(0.0, 1.0, image.shape)
        profile = extract_stripes(Exposure(np.clip(image, 0, 255).astype(np.uint8), "reflections"))
        good = profile.points_px[profile.is_accepted]
        on_line = np.abs(good[:, 0] - 240.0 - 0.05 * good[:, 1]) < 1.0
        assert on_line.sum() > 650


def test_a_crop_gives_the_same_points_in_full_sensor_pixels() -> None:
    image = StripeScene((line(75.0),), 320, 240).expose(1)
    whole = extract_stripes(image)
    part = extract_stripes(image.cropped(40, 30, 300, 220))
    assert part.points_px.min(axis=0)[0] >= 40.0
    inner = [p for p in part.points_px[part.is_accepted] if 60 < p[0] < 280 and 50 < p[1] < 200]
    good = whole.points_px[whole.is_accepted]
    nearest = [float(np.abs(good - point).sum(axis=1).min()) for point in inner]
    assert len(inner) > 100
    assert np.median(nearest) < 0.02, "the noise model is estimated from other pixels"


def test_a_crop_of_a_binned_window_counts_sensor_pixels() -> None:
    image = Exposure(np.zeros((50, 60), np.uint8), "w", window=SensorWindow(100, 200, 2))
    crop = image.cropped(5, 7, 25, 37)
    assert (crop.width_px, crop.height_px) == (20, 30)
    assert crop.window == SensorWindow(110, 214, 2)


@pytest.mark.parametrize("bits", [8, 12])
def test_what_is_dark_need_not_be_copied(bits: int) -> None:
    """Lines found in the part that is copied are those of the whole image, to the last bit."""
    image = np.full((530, 700), 9, np.uint8)
    image[:200, :300] = thick_line(1, 2.0)[:200, :300]
    deep = image.astype(np.uint16) * 16 + 3
    exposure = Exposure(image if bits == 8 else deep, "corner", bits_used=bits)
    plane, level = lit_plane(exposure, None)
    whole = mono_plane(exposure, None).image
    every = measure_level(whole, None)
    assert (level.rise, level.noise, level.clutter) == (every.rise, every.noise, every.clutter)
    np.testing.assert_array_equal(level.background, every.background)
    runs = find_candidates(plane.image, level)
    assert len(runs) > 200
    np.testing.assert_array_equal(runs, find_candidates(whole, every))
    assert (plane.image[:320, :420] == whole[:320, :420]).all()
    assert not plane.image[470:, 570:].any()
    bright = every.lit.repeat(64, axis=0).repeat(64, axis=1)[:530, :700] > 0
    assert whole[~bright].max() < every.background.max() + every.rise


def test_the_corners_of_a_chessboard_beside_a_thick_line_are_no_narrow_lines() -> None:
    """Where squares meet they look like a ridge of 15 to 40 px, narrower than the laser's line."""
    y, x = np.mgrid[:600, :800].astype(np.float64)
    turned = np.stack([0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x]) / 70.0
    squares = np.where(np.floor(turned).astype(np.int64).sum(axis=0) % 2 == 0, 100.0, 25.0)
    for seed in range(3):
        image = gaussian_filter(squares, 2.0)
        image += 900.0 * np.exp(-0.5 * ((x - 80.0 - 0.05 * y) / 6.0) ** 2)
        image += np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
        profile = extract_stripes(Exposure(np.clip(image, 0, 255).astype(np.uint8), "print"))
        good = profile.points_px[profile.is_accepted]
        off = good[:, 0] - 80.0 - 0.05 * good[:, 1]
        assert (np.abs(off) < 3.0).sum() > 150
        assert (np.abs(off) > 40.0).sum() == 0


@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 2.5, 4.0])
@pytest.mark.parametrize("angle_deg", [0.5, 12.0, 30.0, 80.0])
def test_a_line_that_somebody_thresholded_is_as_uncertain_as_its_rounded_edges(
    angle_deg: float, sigma_px: float
) -> None:
    """White on black without a flank, as programs keep it beside the photograph, and as JPEG."""
    scene = StripeScene((line(angle_deg, sigma_px=sigma_px, peak=150.0),), 320, 240)
    rng = np.random.default_rng(5)
    white = np.where(scene.expose(1).image > 90, 252, 3)
    image = (white + rng.integers(-3, 4, white.shape)).astype(np.uint8)
    for picture in (image, np.repeat(image[:, :, None], 3, axis=2)):
        profile = extract_stripes(Exposure(picture, "thresholded"))
        away, _, along = scene.errors(profile.points_px[profile.is_accepted])
        assert len(np.unique(np.floor(along / 2.0))) > 0.95 * 240 / 2
        assert np.abs(away).max() < 0.8
        sigmas = away / profile.sigma_px[profile.is_accepted]
        assert 0.2 < np.sqrt((sigmas**2).mean()) < 1.2


def test_what_a_camera_saw_in_black_and_white_is_no_threshold() -> None:
    """Over-exposed eight times; in the dark; and without a line."""
    for peak, sigma_px in ((1600.0, 1.2), (1600.0, 5.0), (60.0, 1.5)):
        scene = StripeScene((line(0.5, sigma_px=sigma_px, peak=peak),), 320, 240)
        assert not is_thresholded(scene.expose(1))
    assert not is_thresholded(StripeScene((), 320, 240).expose(1))
    assert not is_thresholded(Exposure(np.zeros((240, 320), np.uint8), "dark"))


@pytest.mark.parametrize("peak", [7.0, 14.0, 22.0])
@pytest.mark.parametrize("side_px", [1, 9, 60])
def test_a_dim_line_beside_something_white_is_no_threshold(side_px: int, peak: float) -> None:
    """A hot pixel, a glint, a window: nothing lies between white and what is less than a tenth."""
    scene = StripeScene((line(0.5, peak=peak),), 320, 240, noise=StripeNoise(0.05, 0.0), bits=12)
    bright = scene.expose(1).image.copy()
    bright[20 : 20 + side_px, 30 : 30 + side_px] = 4095
    assert not is_thresholded(Exposure(bright, "dim", bits_used=12))


def test_grey_is_grey_however_it_is_stored() -> None:
    """A photograph and its view without laser, either of them in three channels."""
    lit, dark = (StripeScene(lines, 320, 240).expose(1).image for lines in ((line(12.0),), ()))
    plain = extract_stripes(Exposure(lit, "lit"), None, Exposure(dark, "dark"))
    assert plain.is_accepted.sum() > 250
    for one, other in ((True, False), (False, True), (True, True)):
        images = [
            Exposure(np.repeat(image[:, :, None], 3, axis=2) if is_wide else image, name)
            for image, is_wide, name in ((lit, one, "lit"), (dark, other, "dark"))
        ]
        found = extract_stripes(images[0], None, images[1])
        np.testing.assert_array_equal(found.points_px, plain.points_px)
