# SPDX-License-Identifier: Apache-2.0
"""Lines that are wider than a print leaves room for, photographed with and without laser."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from armscan.calibration.sheets.stripes_on_board import TargetEdges, runs_along_edge
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile, StripeFlag
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import (
    GROUND_PX,
    StripeOptions,
    local_moments,
    relative_reflectance,
)

SQUARE_PX = 34.0
INK = 0.08
BLUR_PX = 0.8
ROOM = 110.0
SLANT = 0.23
"""Of the line against the columns: it passes squares and their borders at all distances."""


def reflectance(fine: int) -> np.ndarray:
    """A chessboard turned by 7 degrees, (240 fine, 320 fine)."""
    y, x = (np.mgrid[: 240 * fine, : 320 * fine] + 0.5) / fine - 0.5
    c, s = np.cos(np.radians(7.0)), np.sin(np.radians(7.0))
    dark = (np.floor((c * x + s * y) / SQUARE_PX) + np.floor((c * y - s * x) / SQUARE_PX)) % 2
    return np.where(dark == 1, INK, 1.0)


def line_error_px(points: np.ndarray) -> np.ndarray:
    return np.asarray((points[:, 0] - 130.0 - SLANT * points[:, 1]) / np.hypot(1.0, SLANT))


def photographs(
    seed: int, sigma_px: float, black: float = 0.0, peak: float = 160.0
) -> tuple[Exposure, Exposure]:
    """With and without laser: light times ink, blurred by the lens, speckle and camera noise.

    The room is dark while the laser is on; the camera shows darkness as the grey level ``black``.
    """
    rng = np.random.default_rng(seed)
    fine = 3
    y, x = (np.mgrid[: 240 * fine, : 320 * fine] + 0.5) / fine - 0.5
    section = np.exp(-0.5 * ((x - 130.0 - SLANT * y) / np.hypot(1.0, SLANT) / sigma_px) ** 2)
    ink = reflectance(fine)

    def seen(light: np.ndarray) -> np.ndarray:
        sharp = gaussian_filter(light * ink, BLUR_PX * fine)
        return np.asarray(sharp.reshape(240, fine, 320, fine).mean(axis=(1, 3)))

    speckle = np.clip(1.0 + 0.15 * rng.standard_normal((240, 320)), 0.0, None)
    room = seen(np.full_like(ink, ROOM))
    levels = (seen(peak * section) * speckle + 0.01 * room, room)
    noisy = [v + rng.standard_normal(v.shape) * np.sqrt(v / 60.0 + 0.5) + black for v in levels]
    on, off = (np.clip(np.rint(v), 0, 255).astype(np.uint8) for v in noisy)
    return Exposure(on, "on"), Exposure(off, "off")


def accepted(profile: Profile) -> Profile:
    return profile.select(profile.is_accepted)


@pytest.mark.parametrize(("sigma_px", "black"), [(4.0, 0.0), (6.0, 0.0), (6.0, 4.0)])
def test_a_wide_line_on_print_is_found_within_its_sigma(sigma_px: float, black: float) -> None:
    """The same photographs without what is known of the print err by pixels."""
    normalised, errors, plain = [], [], []
    for seed in range(4):
        on, off = photographs(seed, sigma_px, black)
        good = accepted(extract_stripes(on, StripeOptions(on_print=True), off))
        assert len(good) > 200
        errors.append(line_error_px(good.points_px))
        normalised.append(errors[-1] / good.sigma_px)
        assert np.median(good.width_px) == pytest.approx(sigma_px, rel=0.05)
        plain.append(line_error_px(accepted(extract_stripes(on, None, off)).points_px))
    error, ratio = np.concatenate(errors), np.concatenate(normalised)
    assert np.sqrt((ratio**2).mean()) < 1.5
    assert (np.abs(ratio) > 4.0).mean() < 0.02
    assert np.concatenate(plain).std() > 4.0 * error.std()


@pytest.mark.parametrize(("sigma_px", "peak"), [(1.5, 160.0), (2.7, 500.0)])
def test_a_thin_line_is_taken_as_without_the_print(sigma_px: float, peak: float) -> None:
    """Below 3 px the lens's blur leaves more than a fifth of an edge's pull.

    The run of a clipped core is wider: that of 2.7 px then looks like one of 3.6 px.
    """
    on, off = photographs(1, sigma_px, peak=peak)
    printed, plain = (
        extract_stripes(on, StripeOptions(on_print=flag), off) for flag in (True, False)
    )
    assert np.array_equal(printed.points_px, plain.points_px)
    assert np.array_equal(printed.sigma_px, plain.sigma_px)
    assert not (printed.flags & int(StripeFlag.GROUND_KNOWN)).any()


def test_reflectance_is_that_of_the_ink_and_less_noisy_than_the_photograph() -> None:
    off = photographs(2, 6.0)[1]
    ground = relative_reflectance(off, "auto")
    truth = gaussian_filter(reflectance(3), 3 * BLUR_PX).reshape(240, 3, 320, 3).mean(axis=(1, 3))
    flat = gaussian_filter(np.abs(truth - np.rint(truth)), 3.0) < INK + 1e-3
    level = off.image / ROOM
    is_white = flat & (truth > 0.99)
    assert ground[is_white].std() < 0.5 * level[is_white].std()
    ratio = np.median(ground[flat & (truth < 0.1)]) / np.median(ground[is_white])
    assert ratio == pytest.approx(INK, rel=0.05)
    edge = (truth > 0.3) & (truth < 0.7)
    assert np.abs(ground - level)[edge].mean() < 0.06, "edges are not smoothed away"


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (60, 80)])
def test_local_moments_are_those_of_a_square_mirrored_at_the_border(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(1).uniform(0.0, 255.0, shape).astype(np.float32)
    mean, variance = local_moments(image)
    exact = image.astype(np.float64)
    expected = uniform_filter(exact, GROUND_PX)
    np.testing.assert_allclose(mean, expected, rtol=1e-5)
    spread = uniform_filter(exact**2, GROUND_PX) - expected**2
    np.testing.assert_allclose(variance, np.maximum(spread, 1e-3), rtol=1e-4, atol=0.05)


def test_a_view_in_the_dark_tells_nothing_of_the_print() -> None:
    rng = np.random.default_rng(4)
    image = np.clip(np.rint(rng.normal(2.0, 1.0, (240, 320))), 0, 255).astype(np.uint8)
    assert relative_reflectance(Exposure(image, "dark"), "auto").size == 1


def test_small_light_dots_are_print_and_no_noise() -> None:
    """Most 5 x 5 px of such a board hold an edge, so that their typical variance is the print's."""
    y, x = np.mgrid[:240, :320] % 24 - 11.5
    ink = gaussian_filter(np.where(np.hypot(x, y) < 5.0, 1.0, INK), BLUR_PX)
    rng = np.random.default_rng(5)
    level = ROOM * ink + rng.standard_normal(ink.shape) * np.sqrt(ROOM * ink / 60.0 + 0.5)
    off = Exposure(np.clip(np.rint(level), 0, 255).astype(np.uint8), "off")
    ground = relative_reflectance(off, "auto")
    assert ground.shape == ink.shape
    scale = np.median(ground[ink > 0.95]) / np.median(ink[ink > 0.95])
    assert np.abs(ground - scale * ink).std() < 0.02


def test_points_whose_print_is_known_are_not_left_out_along_its_edges() -> None:
    on, off = photographs(0, 6.0)
    for flag in (True, False):
        profile = extract_stripes(on, StripeOptions(on_print=flag), off)
        edge = TargetEdges(
            profile.points_px + 3.0 * profile.normals_px, profile.normals_px[:, ::-1] * [-1.0, 1.0]
        )
        assert runs_along_edge(profile, edge).any() == (not flag)


def test_a_black_view_without_laser_says_nothing_of_the_print() -> None:
    on, off = photographs(0, 6.0)
    black = replace(off, image=np.zeros_like(off.image))
    with_print, without = (
        extract_stripes(on, StripeOptions(on_print=flag), black) for flag in (True, False)
    )
    assert relative_reflectance(black, "auto").size == 1
    np.testing.assert_array_equal(with_print.points_px, without.points_px)
    assert len(without) > 0
