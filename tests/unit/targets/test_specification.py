# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from armscan.errors import OptionError
from armscan.vision.targets.target import (
    EXAMPLES,
    AprilGrid,
    Charuco,
    Chessboard,
    CircleGrid,
    as_two_lengths,
    describe_target,
    format_target,
    parse_target,
)


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("circle-grid:11x9:3.75", CircleGrid(11, 9, 3.75)),
        ("asymmetric-circle-grid:4x11:5", CircleGrid(4, 11, 5.0, is_asymmetric=True)),
        ("chessboard:11x6:13", Chessboard(11, 6, 13.0)),
        (" chessboard:11X6:13mm ", Chessboard(11, 6, 13.0)),
        ("chessboard:11x6:1.3cm", Chessboard(11, 6, 13.0)),
        ("chessboard:11x6:0.013m", Chessboard(11, 6, 13.0)),
        ("chessboard:11x6:13x13.26", Chessboard(11, 6, 13.0, 1.02)),
        ("circle-grid:11x9:4x4mm", CircleGrid(11, 9, 4.0)),
        ("circle-grid:11x9:1cmX9mm", CircleGrid(11, 9, 10.0, stretch=0.9)),
        ("chessboard:11x6:0.05mm", Chessboard(11, 6, 0.05)),
        ("charuco:10x7:4:3:DICT_4X4_50", Charuco(10, 7, 4.0, 3.0, "DICT_4X4_50")),
        ("charuco:10x7:4:3:4x4_50", Charuco(10, 7, 4.0, 3.0, "DICT_4X4_50")),
        ("charuco:10x6:4:3:4x4_50:old", Charuco(10, 6, 4.0, 3.0, "DICT_4X4_50", "old")),
        (
            "charuco:10x6:4:3:4x4_50:old:first=17",
            Charuco(10, 6, 4.0, 3.0, "DICT_4X4_50", "old", 17),
        ),
        ("aprilgrid:6x6:88:0.3", AprilGrid(6, 6, 88.0, 0.3)),
        ("aprilgrid:7x5:0.035m:10.5mm", AprilGrid(7, 5, 35.0, 0.3)),
        (
            "aprilgrid:6x4:3cm:.25:FIRST=36:down:border=1:family=36h10",
            AprilGrid(6, 4, 30.0, 0.25, "tag36h10", 36, 1, "down"),
        ),
    ],
)
def test_right_spellings(text: str, target: object) -> None:
    assert parse_target(text) == target


@pytest.mark.parametrize("kind", EXAMPLES)
def test_every_example_is_right(kind: str) -> None:
    assert EXAMPLES[kind].startswith(kind)
    parse_target(EXAMPLES[kind])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no kind of target"),
        ("checkerboard:11x6:13", "no kind of target"),
        ("chessboard", "needs 2 fields"),
        ("chessboard:11x6", "needs 2 fields"),
        ("chessboard:11x6:13:2", "needs 2 fields"),
        ("chessboard:11*6:13", "COLUMNSxROWS"),
        ("chessboard:11x-6:13", "COLUMNSxROWS"),
        ("chessboard:2x6:13", "too few"),
        ("chessboard:11x6:0", "no square"),
        ("chessboard:11x6:-1", "no square"),
        ("chessboard:11x6:nan", "no square"),
        ("chessboard:11x6:1e999", "no square"),
        ("chessboard:11x6:13in", "no square"),
        ("chessboard:11x6:13x", "no square"),
        ("chessboard:11x6:13x14x15", "no square"),
        ("chessboard:8x8:13x14", "no image tells which"),
        ("chessboard:11x6:1.3cmx1.31", "too unlike"),
        ("charuco:10x7:4x4.1:3:DICT_4X4_50", "no square"),
        ("circle-grid:11x9:ten", "no pitch"),
        ("charuco:10x7:4:3", "needs 4 fields"),
        ("charuco:10x7:3:4:DICT_4X4_50", "does not fit"),
        ("charuco:10x6:4:3:DICT_4X4_50:older", "first=, old, new may"),
        ("charuco:10x6:4:3:DICT_4X4_50:old:new", "each kind once"),
        ("charuco:10x7:4:3:DICT_4X4_50:first=16", "35 markers from 16 on"),
        ("charuco:10x7:4:3:DICT_4X4_50:first=-1", "no number of a marker"),
        ("aprilgrid:6x6:88", "needs 3 fields"),
        ("aprilgrid:1x6:88:0.3", "too few"),
        ("aprilgrid:6x6:88x89:0.3", "no tag"),
        ("aprilgrid:6x6:88:0", "0.05 to 1"),
        ("aprilgrid:6x6:88:100mm", "0.05 to 1"),
        ("aprilgrid:6x6:88:wide", "no spacing"),
        ("aprilgrid:6x6:88:0.3:border=3", "1 or 2"),
        ("aprilgrid:6x6:88:0.3:2", "border=1, border=2"),
        ("aprilgrid:6x6:88:0.3:family=36h12", "known are tag36h11"),
        ("aprilgrid:6x6:88:0.3:family=25h9", "DICT_APRILTAG_25h9 has 35"),
        ("aprilgrid:6x6:88:0.3:first=552", "36 markers from 552 on"),
        ("chessboard:11x6:13:old", "needs 2 fields"),
        ("charuco:10x7:4:3:DICT_9X9_50", "no ArUco dictionary"),
        ("charuco:20x17:4:3:DICT_4X4_50", "needs 170 markers"),
    ],
)
def test_every_wrong_spelling_shows_a_right_example(text: str, words: str) -> None:
    with pytest.raises(OptionError, match=words) as caught:
        parse_target(text)
    kind = text.split(":", maxsplit=1)[0]
    assert EXAMPLES.get(kind, EXAMPLES["chessboard"]) in str(caught.value)


@pytest.mark.parametrize("text", ["chessboard:11x6:0.013", "circle-grid:11x9:.00375"])
def test_a_length_that_was_meant_in_metres_is_asked_about(text: str) -> None:
    with pytest.raises(OptionError, match="metres") as caught:
        parse_target(text)
    assert f"{text.split(':')[2]}m " in str(caught.value)


def test_a_spacing_that_was_meant_in_mm_is_asked_about() -> None:
    with pytest.raises(OptionError, match="is it mm") as caught:
        parse_target("aprilgrid:6x6:88:26.4")
    assert "26.4mm, or 0.3" in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        *EXAMPLES.values(),
        "charuco:10x6:4:3:DICT_4X4_50:new",
        "charuco:10x6:4:3:DICT_4X4_50:first=12",
        "circle-grid:11x9:3.75x3.76",
        "aprilgrid:6x4:30:0.25:family=tag36h10:first=36:border=1:down",
    ],
)
def test_a_formatted_target_is_read_back(text: str) -> None:
    assert parse_target(format_target(parse_target(text))) == parse_target(text)


@pytest.mark.parametrize(
    ("text", "span"),
    [
        ("chessboard:11x6:13", "130 x 65 mm"),
        ("circle-grid:11x9:3.75", "37.5 x 30 mm"),
        ("chessboard:11x6:13x13.26", "130 x 66.3 mm"),
        ("asymmetric-circle-grid:4x11:5", "35 x 50 mm"),
        ("charuco:10x7:4:3:DICT_4X4_50", "32 x 20 mm"),
        ("aprilgrid:6x6:88:0.3", "660 x 660 mm"),
    ],
)
def test_a_description_tells_what_a_ruler_measures(text: str, span: str) -> None:
    assert span in describe_target(parse_target(text))


def test_a_stretched_target_is_described_as_the_parser_takes_it_or_not_at_all() -> None:
    for text, fits in (
        ("chessboard:9x6:25", "chessboard:9x6:25x26.25"),
        ("circle-grid:11x9:3.75x3.8", "circle-grid:11x9:3.75x3.99"),
        ("asymmetric-circle-grid:4x11:5", "asymmetric-circle-grid:4x11:5x5.25"),
    ):
        told = as_two_lengths(parse_target(text).points_board_mm, 0.05)
        kind, counts, _ = text.split(":")
        written = told.split("both lengths, ")[1].split()[0]
        assert parse_target(f"{kind}:{counts}:{written}") == parse_target(fits)
    points = parse_target("chessboard:9x6:25").points_board_mm
    grid = parse_target("aprilgrid:6x5:88:0.3").points_board_mm
    for refused in (parse_target("circle-grid:9x9:15").points_board_mm, grid, points):
        assert as_two_lengths(refused, 0.1 if refused is not points else 1.5) == "print another"
