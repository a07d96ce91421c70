# SPDX-License-Identifier: Apache-2.0
"""Halo, ghost and speckle: where scattered light goes, and how grainy laser light is."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.simulation.optics.camera import (
    Detector,
    RenderCamera,
    expose_mono,
    halo_rows,
    with_ghost,
    with_halo,
)
from armscan.simulation.optics.render import (
    Image32,
    PixelBox,
    Region,
    Speckle,
    between_nodes,
    enlarged,
)
from armscan.simulation.optics.stripe_light import speckle_piece


def line(row: int = 40) -> Image32:
    light = np.zeros((160, 240), np.float32)
    light[row, 60:180] = 1.0
    return light


def test_a_halo_moves_light_symmetrically_and_loses_none() -> None:
    light = line(80)
    scattered = with_halo(light, 0.2, 8.0)
    assert float(scattered.sum()) == pytest.approx(float(light.sum()), rel=1e-5)
    assert scattered[80, 120] == pytest.approx(0.8 + 0.2 / (8.0 * np.sqrt(2.0 * np.pi)), rel=0.02)
    rows = np.arange(160)
    column = scattered[:, 120].astype(float)
    centre = column @ rows / column.sum()
    # the halo's cells are 4 px wide: its own centre may be half a cell off
    assert abs(centre - 80.0) < 0.2 * 2.0
    spread = np.sqrt(column @ (rows - centre) ** 2 / column.sum())
    assert spread == pytest.approx(np.sqrt(0.2) * 8.0, rel=0.05)
    assert with_halo(light, 0.0, 8.0) is light


@pytest.mark.parametrize(("row", "height"), [(80, 160), (2, 160), (157, 160), (81, 161)])
def test_a_halo_of_the_rows_around_a_line_is_that_of_the_image(row: int, height: int) -> None:
    light = np.zeros((height, 242), np.float32)
    light[row, 60:180] = 1.0
    rows = halo_rows(slice(row, row + 1), height, 8.0)
    whole = with_halo(light, 0.2, 8.0)
    np.testing.assert_array_equal(with_halo(light[rows], 0.2, 8.0), whole[rows])
    whole[rows] = 0.0
    assert not whole.any()
    assert height % 4 or rows != slice(0, height)


def test_a_ghost_lies_mirrored_at_the_centre() -> None:
    light = line(40)
    ghost = with_ghost(light, 0.05, 4.0) - light
    rows = np.arange(160)
    profile = ghost[:, 120].astype(float)
    assert profile @ rows / profile.sum() == pytest.approx(159 - 40, abs=2.0)
    assert float(ghost.sum()) == pytest.approx(0.05 * float(light.sum()), rel=1e-3)
    assert with_ghost(light, 0.0, 4.0) is light


def test_mono_levels_clip_at_full_scale_and_refuse_odd_bits() -> None:
    light = np.array([[-0.2, 0.0, 0.502, 1.0, 7.0]], np.float32)
    quiet = Detector(read_noise=0.0, electrons_per_level=1e9)
    levels = expose_mono(light, quiet, np.random.default_rng(0))
    assert levels.tolist() == [[0, 0, 128, 255, 255]]
    with pytest.raises(InputError, match="17 bits"):
        expose_mono(light, Detector(bits=17), np.random.default_rng(0))


@pytest.mark.parametrize("grain_px", [0.0, 0.6, 1.5])
def test_speckle_has_mean_one_its_contrast_and_its_grain(grain_px: float) -> None:
    pieces = [
        speckle_piece((300, 400), Speckle(0.3, grain_px), np.random.default_rng(seed))
        for seed in range(8)
    ]
    values = np.concatenate([piece.ravel() for piece in pieces]).astype(float)
    n_grains = values.size / max(1.0, 4.0 * np.pi * (2.0 * grain_px) ** 2)
    assert values.mean() == pytest.approx(1.0, abs=4 * 0.3 / np.sqrt(n_grains))
    assert values.std() == pytest.approx(0.3, rel=0.05 + 4 / np.sqrt(2.0 * n_grains))
    logs = np.log(pieces[0].astype(float))
    step = max(round(4.0 * grain_px), 1)
    together = np.mean((logs[:, step:] - logs.mean()) * (logs[:, :-step] - logs.mean()))
    # a Gaussian filter of sigma s correlates as exp(-d^2 / 4 s^2); cells are half pixels
    expected = np.exp(-(step**2) / (4.0 * (2.0 * grain_px) ** 2)) if grain_px else 0.0
    assert together / logs.var() == pytest.approx(expected, abs=0.06)
    assert (pieces[0] != pieces[1]).any()


def test_speckle_without_contrast_is_one() -> None:
    flat = speckle_piece((5, 7), Speckle(0.0, 0.5), np.random.default_rng(0))
    assert flat.shape == (5, 7)
    assert bool((flat == 1.0).all())


def test_a_region_covers_its_window_with_whole_cells_and_a_margin() -> None:
    region = Region.around(207, 624, 2658, 800)
    assert region.x_px % 8 == region.y_px % 8 == region.width_px % 8 == region.height_px % 8 == 0
    assert region.x_px <= 207 - 16
    assert region.x_px + region.width_px >= 207 + 2658 + 16
    nodes, shape = region.nodes_px()
    assert nodes[0].tolist() == [region.x_px, region.y_px]
    assert shape == (region.height_px // 8 + 1, region.width_px // 8 + 1)
    np.testing.assert_array_equal(
        region.pixels_px(np.array([2]), np.array([5])), [[region.x_px + 5, region.y_px + 2]]
    )


def test_values_between_nodes_lie_on_straight_lines() -> None:
    rows, columns = np.indices((6, 9)).astype(np.float32)
    nodes = np.asarray(3.0 * rows - 2.0 * columns, dtype=np.float32)
    for step in (2, 8):
        y, x = np.indices((5 * step, 8 * step)) / step
        pixels = between_nodes(nodes, step)[: 5 * step, : 8 * step]
        np.testing.assert_allclose(pixels, 3.0 * y - 2.0 * x, atol=1e-5)
        np.testing.assert_array_equal(between_nodes(nodes, step, (8 * step, 5 * step)), pixels)
    cells = np.array([[1, 2], [3, 4]], np.uint8)
    np.testing.assert_array_equal(enlarged(cells, 3), np.kron(cells, np.ones((3, 3), np.uint8)))


def test_a_box_of_pixels_is_cut_at_the_image() -> None:
    camera = RenderCamera(1000.0, 1000.0, 0.0, 0.0, width_px=300, height_px=200)
    places = np.array([[-5.5, 20.2], [40.7, 150.0]])
    box = PixelBox.around(places, 3, camera)
    assert box == PixelBox(0, 17, 45, 154)
    assert box.shape == (137, 45)
    whole, part = np.arange(200 * 300).reshape(200, 300), PixelBox(10, 30, 20, 60).cut(box)
    seen = whole[box.within(PixelBox.of(camera))][part.within(box)]
    np.testing.assert_array_equal(seen, whole[30:60, 10:20])
    assert PixelBox.around(places - [900.0, 0.0], 3, camera).is_empty
    assert PixelBox.around(places * np.nan, 3, camera) == PixelBox.of(camera)
