# SPDX-License-Identifier: Apache-2.0
"""Lines of one source are named over images that each show a few of them, or refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armscan.calibration.sheets import fan
from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.fan import FanAssignment, number_fan
from armscan.calibration.sheets.labels import assign_sheets, board_numbers
from armscan.calibration.sheets.result import BoardStripes, SheetOptions
from armscan.calibration.sheets.stripes_on_board import (
    BoardImage,
    StripeObservation,
    observe_board_stripes,
)
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from rigs.fan_rig import MIDDLE_MM, FanRig, fan_rig

Named = FanAssignment | FitFailure


def images_of(rig: FanRig, seed: int, *, dropped: float = 0.0, n_strays: int = 0,
              has_right: bool = False) -> tuple[list[BoardImage], list[list[int]]]:  # fmt: skip
    """Stripes on their boards, and the true sheet of each sighting."""
    rng = np.random.default_rng(seed)
    stereo = rig.drawn_stereo(rng)
    calibration = stereo if has_right else stereo.left
    boards, truth = rig.boards(calibration, rng, dropped=dropped, n_strays=n_strays)
    cameras = HeadCameras.of(calibration)
    images = [observe_board_stripes(board, cameras) for board in boards]
    return images, [true_sheets(image, names) for image, names in zip(images, truth, strict=True)]


def true_sheets(image: BoardImage, of_segment: list[int]) -> list[int]:
    segment = image.data.profile.segment
    return [of_segment[int(np.bincount(segment[s.rows]).argmax())] for s in image.stripes]


def named(images: list[BoardImage], n_sheets: int = 0) -> Named:
    return number_fan([image.stripes for image in images], board_numbers(images), n_sheets)


def offsets(names: FanAssignment, truth: list[list[int]]) -> set[int]:
    """True number less given number of every numbered stripe: one value if all are right."""
    return {
        true - names.numbers[k] if true >= 0 else -100
        for row, sheets in zip(truth, names.sheets, strict=True)
        for true, k in zip(row, sheets, strict=True)
        if k >= 0
    }


@pytest.mark.parametrize("seed", range(4))
def test_few_lines_an_image_are_named_over_all(seed: int) -> None:
    """Eleven bowed lines, 3 to 6 of them on each board; the numbers run along the head in order."""
    images, truth = images_of(fan_rig(seed, 7), seed)
    names = named(images)
    assert isinstance(names, FanAssignment), names
    assert len(offsets(names, truth)) == 1
    assert max(len(row) for row in truth) <= 6
    assert sum(k >= 0 for row in names.sheets for k in row) >= 0.85 * sum(map(len, truth))


def test_stripes_are_told_apart_on_boards_of_any_size() -> None:
    """The same images are those of a head and boards of a quarter of the size: of 9 mm, with lines
    1.7 mm apart, of which the band for large boards holds two.
    """
    rig = fan_rig(1, 4)
    camera = rig.stereo().left
    boards, truth = rig.boards(camera, np.random.default_rng(1))
    for board, of_segment in zip(boards, truth, strict=True):
        view, found = board.view, board.sensor_from_board
        pose = Pose(found.value.rotation, 0.25 * found.value.translation_mm)
        units = np.diag([1.0] * 3 + [0.25] * 3)
        small = replace(
            board,
            view=replace(view, points_board_mm=0.25 * view.points_board_mm),
            placed=None,
            sensor_from_board=replace(
                found, value=pose, covariance=units @ found.covariance @ units
            ),
        )
        stripes = observe_board_stripes(small, HeadCameras.of(camera)).stripes
        shown = [{of_segment[k] for k in board.profile.segment[one.rows]} for one in stripes]
        assert [len(one) for one in shown] == [1] * len(set(of_segment))


@pytest.mark.parametrize("seed", range(4))
def test_lost_lines_and_stray_stripes_mislead_no_one(seed: int) -> None:
    """A sixth of the stripes is not found, and each image has a straight stripe of no sheet."""
    images, truth = images_of(fan_rig(40 + seed, 8), seed, dropped=0.16, n_strays=1)
    names = named(images)
    assert isinstance(names, FanAssignment), names
    assert len(offsets(names, truth) - {-100}) == 1
    # A stray stripe that happens to lie in a sheet is not to be told from its line.
    assert sum(true < 0 for row, sheets in zip(truth, names.sheets, strict=True)
               for true, k in zip(row, sheets, strict=True) if k >= 0) <= 1  # fmt: skip


def test_both_cameras_name_together() -> None:
    images, truth = images_of(fan_rig(3, 6), 3, has_right=True)
    assert {image.data.camera for image in images} == {0, 1}
    names = named(images)
    assert isinstance(names, FanAssignment), names
    assert len(offsets(names, truth)) == 1


def test_a_line_that_is_never_seen_keeps_its_number() -> None:
    rig = fan_rig(1, 10)
    lost = replace(rig, sheets=rig.sheets[:4] + rig.sheets[5:])
    images, truth = images_of(lost, 1)
    names = named(images)
    assert isinstance(names, FanAssignment), names
    was = [[k + (k >= 4) for k in row] for row in truth]
    assert len(offsets(names, was)) == 1
    number = 4 - offsets(names, was).pop()
    assert number not in names.numbers
    assert any(f"line {number}:" in warning for warning in names.warnings)


def test_a_line_seen_on_one_board_counts_in_the_numbering() -> None:
    """The first line is on one board: no sheet comes of it, and the next one is still line 2."""
    images, truth = images_of(fan_rig(5, 6, 5), 5)
    first = next(i for i, row in enumerate(truth) if 0 in row)
    cut = [
        image if i == first else without(image, row, {0})[0]
        for i, (image, row) in enumerate(zip(images, truth, strict=True))
    ]
    names = named(cut)
    assert isinstance(names, FanAssignment), names
    assert names.numbers == (2, 3, 4, 5)
    assert any("line 1:" in warning for warning in names.warnings)


def without(image: BoardImage, truth: list[int], sheets: set[int]) -> tuple[BoardImage, list[int]]:
    kept = [s for s, true in zip(image.stripes, truth, strict=True) if true not in sheets]
    return replace(image, stripes=tuple(kept)), [true for true in truth if true not in sheets]


def test_parallel_boards_are_refused_with_the_reason() -> None:
    """Facing boards at two depths: which stripe follows which is open; no numbering is guessed."""
    rig = fan_rig(2, 1)
    poses: tuple[Pose[Sensor, Board], ...] = tuple(
        Pose(np.eye(3), np.array([0.0, 0.0, z]) - MIDDLE_MM) for z in (118.0, 165.0)
    )
    images, _ = images_of(replace(rig, poses=poses), 2)
    names = named(images)
    assert isinstance(names, FitFailure)
    assert "too parallel" in names.reason
    assert "tilts" in names.remedy


def test_a_fan_among_as_many_strays_recovers_from_a_round_that_looks_hopeless() -> None:
    """Thirty stripes of a fan and 23 strays: a first round that leaves few need not be the last."""
    images, _ = images_of(fan_rig(0, 8, 7), 0)
    rng, stripes = np.random.default_rng(1), list[list[StripeObservation]]()
    for image in images:
        row = list(image.stripes)
        for stripe in image.stripes:
            if rng.random() < 0.7:
                astray = stripe.ends_mm + rng.normal(0.0, 20.0, (2, 3))
                row.append(replace(stripe, ends_mm=astray))
        stripes.append(row)
    names = number_fan(stripes, board_numbers(images))
    assert isinstance(names, FanAssignment), names
    assert sum(k >= 0 for row in names.sheets for k in row) >= 25


def test_stripes_of_no_fan_are_given_up_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stripes thrown about by centimetres, as if beside their boards: few fits, then a reason."""
    images, _ = images_of(fan_rig(0, 8, 15), 0)
    rng, fits = np.random.default_rng(0), 0
    stripes = [
        [replace(s, ends_mm=s.ends_mm + rng.normal(0.0, 20.0, (2, 3))) for s in image.stripes * 5]
        for image in images
    ]
    fit_fan = fan._fit_fan

    def counted(*args: Any) -> Any:
        nonlocal fits
        fits += 1
        return fit_fan(*args)

    monkeypatch.setattr(fan, "_fit_fan", counted)
    names = number_fan(stripes, board_numbers(images))
    assert isinstance(names, FitFailure)
    assert "no numbering puts 25% of the 150 stripes" in names.reason
    assert fits < 1000


def test_boards_that_share_no_line_are_placed_by_the_fan_or_refused() -> None:
    """Half of the images show lines up to the fifth only, the others those after it."""
    images, truth = images_of(fan_rig(4, 8), 4)
    parts = [
        without(image, row, set(range(5) if i % 2 else range(5, 11)))
        for i, (image, row) in enumerate(zip(images, truth, strict=True))
    ]
    assert not set(parts[0][1]) & set(parts[1][1])
    names = named([image for image, _ in parts])
    if isinstance(names, FanAssignment):
        assert len(offsets(names, [row for _, row in parts])) == 1
    else:
        assert "share too few lines" in names.reason


def test_a_source_named_by_the_caller_gives_numbered_sheets() -> None:
    images, _ = images_of(fan_rig(5, 6, 5), 5)
    found = assign_sheets(images, SheetOptions(n_sheets=5))
    assert not isinstance(found, FitFailure), found
    assert found.names == ("A.1", "A.2", "A.3", "A.4", "A.5")
    assert found.is_fan


def test_more_lines_than_announced_are_refused() -> None:
    images, _ = images_of(fan_rig(5, 6, 5), 5)
    found = assign_sheets(images, SheetOptions(n_sheets=4))
    assert isinstance(found, FitFailure)
    assert "5 lines, and 4 were announced" in found.reason


def test_one_line_and_a_reflection_are_one_sheet() -> None:
    """Two stripes in each image of a source: the longer one is its line, as before."""
    rig = fan_rig(6, 4)
    images, _ = images_of(replace(rig, sheets=rig.sheets[5:6]), 6, n_strays=1)
    found = assign_sheets(images, SheetOptions())
    assert not isinstance(found, FitFailure), found
    assert found.names == ("A",)


def test_numbers_run_from_left_to_right() -> None:
    images, _ = images_of(fan_rig(7, 7), 7)
    names = named(images)
    assert isinstance(names, FanAssignment), names
    for image, sheets in zip(images, names.sheets, strict=True):
        where = [float(sighting.middle_px.sum()) for sighting in image.stripes]
        ordered = [at for k, at in sorted(zip(sheets, where, strict=True)) if k >= 0]
        assert ordered == sorted(ordered)


def test_two_images_of_one_placement_are_one_board() -> None:
    boards = [BoardStripes(i.data.profile, i.data.view, i.data.sensor_from_board,
                           placement=i.data.placement)
              for i in images_of(fan_rig(8, 2), 8)[0]]  # fmt: skip
    cameras = HeadCameras.of(fan_rig(8, 1).stereo().left)
    twice = [observe_board_stripes(board, cameras) for board in (boards[0], *boards)]
    assert board_numbers(twice) == [0, 0, 1]
