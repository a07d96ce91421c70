# SPDX-License-Identifier: Apache-2.0
"""A view without laser that was taken a part of a pixel beside the one with it."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from armscan.geometry.arrays import FloatArray
from armscan.pipeline.laser import about_moved_views
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import laid_under, shift_between
from armscan.vision.targets.target import TargetView

FINE = 5
HEIGHT, WIDTH = 240, 320
SIGMA_PX, PEAK = 1.8, 90.0


def scene(shift_px: tuple[float, float], *, is_lit: bool, seed: int) -> FloatArray:
    """A turned chessboard, moved by ``shift_px``; lit in the middle by a line that stays."""
    y, x = (np.mgrid[: HEIGHT * FINE, : WIDTH * FINE] + 0.5) / FINE - 0.5
    c, s = np.cos(0.15), np.sin(0.15)
    across, down = x - shift_px[0], y - shift_px[1]
    squares = np.floor((c * across + s * down) / 30.0) + np.floor((c * down - s * across) / 30.0)
    light = np.where(squares % 2 == 0, 20.0, 100.0)
    if is_lit:
        light = 1.2 * light + 3.0
        light = light + PEAK * np.exp(-0.5 * ((x - 160.2 - 0.1 * y) / SIGMA_PX) ** 2)
    sharp = gaussian_filter(light, 0.7 * FINE)
    levels = sharp.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))
    rng = np.random.default_rng(seed)
    return np.asarray(levels + rng.normal(0.0, 1.0, levels.shape))


def exposure(levels: FloatArray, name: str) -> Exposure:
    return Exposure(np.clip(np.rint(levels), 0, 255).astype(np.uint8), name)


def pair(shift_px: tuple[float, float], seed: int) -> tuple[Exposure, Exposure]:
    lit = scene(shift_px, is_lit=True, seed=seed)
    dark = scene((0.0, 0.0), is_lit=False, seed=seed + 100)
    return exposure(lit, "on"), exposure(dark, "off")


@pytest.mark.parametrize("shift", [(0.25, -0.1), (-0.07, 0.18), (0.9, 1.3)])
def test_the_shift_between_two_photographs_is_found(shift: tuple[float, float]) -> None:
    lit, dark = pair(shift, seed=1)
    found = shift_between(lit.image.astype(np.float32), dark.image.astype(np.float32))
    # the noise moves it by 0.0005 px; pixels show borders of 0.7 px as slightly others when moved
    assert found == pytest.approx(shift, abs=0.01)
    # and by OpenCV's maximiser of the correlation, which the laser's own light disturbs more
    start, stop = np.eye(2, 3, dtype=np.float32), (3, 200, 1e-8)
    _, warp = cv2.findTransformECC(lit.image, dark.image, start, cv2.MOTION_TRANSLATION, stop)
    assert found == pytest.approx(-warp[:, 2], abs=0.05)


def test_what_stands_still_is_left_as_it_is() -> None:
    for seed in range(5):
        lit, dark = pair((0.0, 0.0), seed)
        assert laid_under(dark, lit) is dark


def test_a_dark_room_tells_no_shift() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        dark = exposure(rng.normal(8.0, 1.5, (HEIGHT, WIDTH)), "off")
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        line = 120.0 * np.exp(-0.5 * ((x - 160.0 - 0.1 * y) / SIGMA_PX) ** 2)
        lit = exposure(line + rng.normal(8.0, 1.5, (HEIGHT, WIDTH)), "on")
        assert laid_under(dark, lit) is dark


def test_a_view_of_something_else_is_left_as_it_is() -> None:
    rng = np.random.default_rng(3)
    others = [exposure(100.0 + 300.0 * uniform_filter(rng.normal(size=(HEIGHT, WIDTH)), 9), "off")]
    others.append(exposure(np.zeros((HEIGHT, WIDTH)), "off"))
    lit, _ = pair((0.0, 0.0), seed=3)
    for other in others:
        assert laid_under(other, lit) is other


@pytest.mark.parametrize("bits", [8, 12])
def test_borders_of_print_are_no_lines_where_the_board_moved(bits: int) -> None:
    lit, dark = pair((0.25, 0.1), seed=4)
    if bits == 12:
        lit, dark = (
            Exposure(one.image.astype(np.uint16) * 16, one.source, bits_used=12)
            for one in (lit, dark)
        )
    found = extract_stripes(lit, background=dark)
    off_px = np.abs(found.points_px[:, 0] - 160.2 - 0.1 * found.points_px[:, 1])
    assert (off_px < 1.0).sum() > 0.9 * HEIGHT
    assert (off_px > 3.0).sum() < 0.02 * HEIGHT
    error = off_px[found.is_accepted]
    assert np.sqrt(np.mean(error**2)) < 0.12


def test_colours_are_moved_together() -> None:
    lit, dark = pair((0.25, 0.1), seed=5)
    in_colour = [
        Exposure(np.repeat(one.image[:, :, None], 3, axis=2), one.source) for one in (lit, dark)
    ]
    moved = laid_under(in_colour[1], in_colour[0]).image
    assert moved.shape == (HEIGHT, WIDTH, 3)
    assert (moved == laid_under(dark, lit).image[:, :, None]).all()


def test_a_person_is_told_of_views_that_were_moved() -> None:
    corners = np.array([[20.0, 20.0], [300.0, 20.0], [300.0, 220.0], [20.0, 220.0]])
    board = np.column_stack([corners, np.zeros(4)])
    view = TargetView(
        source="board",
        width_px=WIDTH,
        height_px=HEIGHT,
        point_index=np.arange(4),
        points_px=corners,
        covariance_px2=np.tile(0.01 * np.eye(2), (4, 1, 1)),
        points_board_mm=board,
    )
    moved, still = pair((0.4, 0.2), seed=6), pair((0.0, 0.0), seed=7)
    (said,) = about_moved_views([(moved, view), (still, view), ((still[0], None), view)])
    assert "1 of 2 views" in said
    assert "0.4 px beside" in said
    assert about_moved_views([(still, view)]) == ()
