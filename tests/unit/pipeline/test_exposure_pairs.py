# SPDX-License-Identifier: Apache-2.0
"""Images with laser find their partners without, or a sentence says why not."""

from typing import Any

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.pipeline.instants import _reduced, check_sizes, pair_by_view, pair_exposures
from armscan.records.exposure import Exposure, SensorWindow
from rigs.plain_scanner import plain_camera

CAMERA = plain_camera(100.0, (20.0, 15.0), (40, 30))


def image(source: str, shape: tuple[int, int] = (30, 40), **more: Any) -> Exposure:
    return Exposure(np.zeros(shape, dtype=np.uint8), source, **more)


def test_by_order_when_names_differ() -> None:
    on, off = [image("a1.png"), image("a2.png")], [image("b1.png"), image("b2.png")]
    assert [(e.source, b.source if b else "") for e, b in pair_exposures(on, off)] == [
        ("a1.png", "b1.png"),
        ("a2.png", "b2.png"),
    ]


def test_by_name_when_the_names_are_the_same() -> None:
    on = [image("on/1.png"), image("on/2.png")]
    off = [image("off/2.png"), image("off/1.png")]
    assert [b.source if b else "" for _, b in pair_exposures(on, off)] == ["off/1.png", "off/2.png"]


def test_views_pair_also_against_the_names_and_two_images_share_one_without_laser() -> None:
    """By name ``on/0.png`` and ``on/1.png`` would be exchanged, or the set refused."""
    on = [image(f"on/{k}.png", lasers=("A",), view=v) for k, v in ((0, "b"), (1, "a"), (2, "b"))]
    off = [image("off/0.png", view="a"), image("off/1.png", view="b")]
    assert pair_by_view([*on, *off]) == [(on[0], off[1]), (on[1], off[0]), (on[2], off[1])]
    assert pair_by_view([on[0], on[1], *off]) == [(on[0], off[1]), (on[1], off[0])]


def test_no_backgrounds_is_fine_and_no_images_is_not() -> None:
    assert pair_exposures([image("a.png")], [])[0][1] is None
    with pytest.raises(InputError, match="no images"):
        pair_exposures([], [])


def test_counts_that_differ_are_refused_with_the_names() -> None:
    with pytest.raises(InputError, match=r"2 images with laser \(a\.png, b\.png\) but 1"):
        pair_exposures([image("a.png"), image("b.png")], [image("c.png")])


def test_pairs_of_two_sizes_or_of_one_image_are_refused() -> None:
    with pytest.raises(InputError, match=r"a\.png.*b\.png"):
        pair_exposures([image("a.png")], [image("b.png", (30, 41))])
    with pytest.raises(InputError, match="same image"):
        pair_exposures([image("a.png")], [image("a.png")])


def test_images_must_be_of_the_cameras_size_or_lie_on_its_sensor() -> None:
    check_sizes([image("a.png")], CAMERA)
    check_sizes([image("w.png", (10, 40), window=SensorWindow(0, 20))], CAMERA)
    # a window in the corner, where somebody said that it is one
    check_sizes([image("w.png", (10, 40), window=SensorWindow(0, 0))], CAMERA)
    for wrong in (
        image("small.png", (10, 40)),
        image("small.png", (10, 40), window=SensorWindow(is_stated=False)),
        image("turned.png", (40, 30)),
        image("w.png", (10, 40), window=SensorWindow(0, 21)),
    ):
        with pytest.raises(InputError, match="camera was calibrated with 40 x 30") as caught:
            check_sizes([wrong], CAMERA)
        assert ("window_x_px and window_y_px" in str(caught.value)) == (wrong.source == "small.png")
        assert "is of another" in caught.value.remedy


def scene(seed: int, has_line: bool) -> np.ndarray:
    """Squares at random places with noise; a bright line where the laser is on."""
    rng = np.random.default_rng(seed)
    picture = np.full((300, 400), 30.0)
    for x, y in rng.integers(0, (380, 280), (30, 2)):
        picture[y : y + 20, x : x + 20] = 50.0
    picture += np.random.default_rng(seed + 100 * has_line).normal(0.0, 2.0, picture.shape)
    if has_line:
        picture[:, 200:204] += 150.0
    return np.clip(picture, 0, 255).astype(np.uint8)


def test_pairs_in_the_wrong_order_are_refused_by_what_they_show() -> None:
    on = [Exposure(scene(k, True), f"on-{k}.png") for k in range(3)]
    off = [Exposure(scene(k, False), f"off-{k}.png") for k in range(3)]
    assert [b for _, b in pair_exposures(on, off)] == off
    with pytest.raises(InputError, match=r"on-0\.png.*looks like off-0\.png.*off-1\.png"):
        pair_exposures(on, [off[1], off[0], off[2]])


def test_views_without_structure_are_taken_by_order() -> None:
    rng = np.random.default_rng(1)
    noise = [rng.normal(30.0, 2.0, (300, 400)).astype(np.uint8) for _ in range(4)]
    on = [Exposure(noise[0], "1.png"), Exposure(noise[1], "2.png")]
    off = [Exposure(noise[2], "3.png"), Exposure(noise[3], "4.png")]
    assert [b for _, b in pair_exposures(on, off)] == off


def test_a_swapped_pair_is_noticed_also_when_it_is_the_only_one() -> None:
    lit, dark = Exposure(scene(1, True), "lit.png"), Exposure(scene(1, False), "dark.png")
    assert pair_exposures([lit], [dark]) == [(lit, dark)]
    with pytest.raises(InputError, match=r"dark\.png.*wrong image.*swap"):
        pair_exposures([dark], [lit])


def test_a_swapped_pair_is_noticed_in_a_large_photograph_of_a_line_along_its_rows() -> None:
    picture = np.full((3000, 4000, 3), 30, np.uint8)
    picture[:, :, 0] += np.random.default_rng(1).integers(0, 4, picture.shape[:2], np.uint8)
    line = picture.copy()
    line[1497:1504] = 200
    lit, dark = Exposure(line, "lit.png"), Exposure(picture, "dark.png")
    assert pair_exposures([lit], [dark]) == [(lit, dark)]
    with pytest.raises(InputError, match=r"dark\.png.*wrong image.*swap"):
        pair_exposures([dark], [lit])


@pytest.mark.parametrize("shape", [(30, 40), (7, 9), (487, 655), (487, 655, 3)])
def test_scenes_are_compared_by_means_of_square_blocks(shape: tuple[int, ...]) -> None:
    levels = np.random.default_rng(1).integers(0, 4096, shape).astype(np.uint16)
    grey = levels.mean(axis=2) if levels.ndim == 3 else levels.astype(np.float64)
    step = max(1, min(shape[:2]) // 120)
    rows, columns = shape[0] // step, shape[1] // step
    blocks = grey[: rows * step, : columns * step].reshape(rows, step, columns, step)
    found = _reduced(Exposure(levels, "levels.png", bits_used=12))
    np.testing.assert_allclose(found, blocks.mean(axis=(1, 3)), rtol=1e-5)


@pytest.mark.parametrize("gain", [0.5, 2.0, 4.0])
def test_the_partner_may_be_exposed_longer_or_shorter(gain: float) -> None:
    lit = Exposure(scene(1, True), "lit.png")
    dark = Exposure((scene(1, False) * gain).astype(np.uint8), "dark.png")
    assert pair_exposures([lit], [dark]) == [(lit, dark)]


def test_a_pair_of_two_scenes_is_refused_and_a_dark_room_is_not() -> None:
    lit, other = Exposure(scene(1, True), "lit.png"), Exposure(scene(2, False), "other.png")
    with pytest.raises(InputError, match=r"lit\.png.*scene of its partner other\.png"):
        pair_exposures([lit], [other])
    night = np.random.default_rng(5).normal(3.0, 1.0, (300, 400)).clip(0, 255).astype(np.uint8)
    dark = Exposure(night, "night.png")
    assert pair_exposures([lit], [dark]) == [(lit, dark)]
