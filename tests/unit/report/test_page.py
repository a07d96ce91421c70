# SPDX-License-Identifier: Apache-2.0
"""Pages: nothing escapes unescaped, pictures carry what they show."""

from __future__ import annotations

import base64
import re
import shlex
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes

from armscan.records.exposure import Exposure, SensorWindow
from armscan.report.drawing import (
    Marks,
    SceneLines,
    display_levels,
    photo_markup,
    ramp_colours,
    scene_markup,
    uniform_dots,
)
from armscan.report.page import (
    Facts,
    Gallery,
    Legend,
    Page,
    Picture,
    Section,
    Text,
    page_of,
    render_page,
)
from armscan.report.quantity import Table, fact
from armscan.storage.documents import new_provenance

HOSTILE = '<script>alert("1")</script>&'


def page(is_simulated: bool = False) -> Page:
    blocks = (
        Text(HOSTILE),
        Facts((fact(HOSTILE, HOSTILE, HOSTILE),), HOSTILE),
        Legend((("#123456", HOSTILE),)),
        Table((HOSTILE,), ((HOSTILE,),), HOSTILE),
        Gallery((Picture("<img>", HOSTILE, HOSTILE),)),
    )
    return Page(
        title=HOSTILE,
        subtitle=HOSTILE,
        cards=(fact(HOSTILE, HOSTILE, HOSTILE),),
        warnings=(HOSTILE,),
        sections=(Section(HOSTILE, blocks), Section("Folded", blocks, is_folded=True)),
        is_simulated=is_simulated,
        footer=HOSTILE,
    )


def test_names_from_outside_are_escaped() -> None:
    """A file may be called anything; it must not become part of the page."""
    text = render_page(page()).decode()
    assert "alert" in text
    assert "<script>alert" not in text
    assert text.count("<img>") == 2


def test_print_parts_no_heading_and_its_first_words_from_what_follows() -> None:
    """A browser printed heading and text at the foot of a page, the pictures on the next one."""
    text = render_page(page()).decode()
    rule = next(line for line in text.splitlines() if "break-after: avoid" in line)
    assert {"h2", "h2 + p"} <= {one.strip() for one in rule.partition("{")[0].split(",")}


def test_the_command_is_shown_as_a_shell_takes_it() -> None:
    command = ("armscan", "inspect", "cad", "my cloud.ply", "--title-block", "operator=A. Ray")
    origin = page_of(new_provenance((), command=command), "Part", "", ()).sections[-1]
    block = next(block for block in origin.blocks if isinstance(block, Facts))
    shown = next(item.text for item in block.quantities if item.label == "Command")
    assert "'operator=A. Ray'" in shown
    assert tuple(shlex.split(shown)) == command


def test_simulated_data_are_called_so() -> None:
    assert b"simulated" not in render_page(page())
    assert render_page(page(is_simulated=True)).count(b"simulated") >= 3


def exposure(level: int, window: SensorWindow | None = None) -> Exposure:
    image = np.full((60, 90, 3), level, np.uint8)
    return Exposure(image, 'a"b.png', window=window or SensorWindow())


def test_labels_that_would_lie_on_each_other_are_drawn_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[str] = []
    plain = Axes.text

    def text(axes: Axes, x: float, y: float, s: str, **how: Any) -> Any:
        drawn.append(s)
        return plain(axes, x, y, s, **how)

    monkeypatch.setattr(Axes, "text", text)
    dots = uniform_dots(np.array([[0.0, 0.0, 0.0], [100.0, 50.0, 0.0]]), "#000000")
    labels = [("p1", (0.0, 0.0, 0.0)), ("p2", (0.5, 0.0, 0.0)), ("p3", (90.0, 40.0, 0.0))]
    scene_markup([dots], [], labels, "three postures")
    assert [name for name in drawn if name.startswith("p")] == ["p1", "p3"]


def test_photographs_are_reduced_and_marks_stay_where_they_are() -> None:
    marks = [Marks(np.array([[10.0, 20.0]]), "#ff0000"), Marks(np.zeros((0, 2)), "#00ff00")]
    markup = photo_markup(exposure(99), marks, 'x"y', longest_px=30)
    assert 'viewBox="-0.5 -0.5 90 60"' in markup
    assert "M10 20h0" in markup
    assert "#00ff00" not in markup
    assert 'aria-label="x&quot;y"' in markup
    found = re.search(r"base64,([^\"]+)", markup)
    assert found
    photo = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), -1)
    assert photo.shape == (20, 30, 3)


def test_marks_are_given_on_the_full_sensor() -> None:
    window = SensorWindow(x_px=100, y_px=50, binning=2)
    markup = photo_markup(
        exposure(99, window), [Marks(np.array([[120.5, 70.5]]), "#f00", "dot")], "x"
    )
    assert "M10 10h0" in markup


def test_dark_photographs_are_brightened_and_bright_ones_left_alone() -> None:
    assert display_levels(exposure(12)).mean() > 100
    np.testing.assert_array_equal(display_levels(exposure(240)), 240)
    assert display_levels(exposure(240), is_grey=True).shape == (60, 90)


def test_photographs_of_nearly_one_light_look_alike() -> None:
    means = [display_levels(exposure(level)).mean() for level in range(100, 250)]
    assert np.abs(np.diff(means)).max() <= 6


def test_scene_carries_its_points() -> None:
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.5]])
    lines = [SceneLines(points, "#0000ff")]
    markup = scene_markup([uniform_dots(points, "#ff0000")], lines, [("A", (0, 0, 1))], "x")
    data = dict(re.findall(r'data-([a-z-]+)="([^"]*)"', markup))
    decoded = np.frombuffer(base64.b64decode(data["points"]), "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(decoded, points)
    assert base64.b64decode(data["colours"]) == b"\xff\x00\x00" * 2
    assert base64.b64decode(data["line-colours"]) == b"\x00\x00\xff"
    np.testing.assert_allclose(
        np.frombuffer(base64.b64decode(data["centre"]), "<f4"), [2.5, 3.5, 4.75]
    )


@pytest.mark.parametrize("values", [np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 2.0])])
def test_ramp_colours_run_from_end_to_end(values: np.ndarray) -> None:
    colours = ramp_colours(values, float(values.min()), float(values.max()))
    assert colours.shape == (3, 3)
    assert (colours[0] == colours[-1]).all() == (values[0] == values[-1])
