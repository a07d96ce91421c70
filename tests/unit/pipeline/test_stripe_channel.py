# SPDX-License-Identifier: Apache-2.0
"""The channel of colour photographs is weighed over a set: rendered boards with a laser line."""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from armscan.calibration.sheets.board_points import HeadCameras, SeenBoard
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit, SheetOptions
from armscan.calibration.sheets.voting import choose_print, rank_channels
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import LaserColour
from armscan.pipeline import laser
from armscan.pipeline.measure import stripes_as_seen
from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions
from armscan.vision.targets.target import Chessboard
from rigs.calibration_documents import sensor_calibration
from rigs.sheet_rig import SheetRig, make_profile, thesis_rig

WIDTH_PX = 2.0


def rig_of_vga() -> SheetRig:
    """The thesis's geometry with a small camera: 640 x 480, as a webcam has."""
    rig = thesis_rig()
    camera = replace(
        rig.camera, fx_px=800.0, fy_px=800.0, cx_px=320.0, cy_px=240.0, width_px=640, height_px=480
    )
    return replace(rig, camera=camera)


def photograph(rig: SheetRig, board: BoardStripes, laser: Sequence[float], seed: int) -> Exposure:
    """Dark squares on white under white light, and the line in the colour of the laser (3,)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: rig.camera.height_px, : rig.camera.width_px].astype(np.float64)
    first = board.view.points_px[0]
    dark = ((x - first[0]) // 24 + (y - first[1]) // 24) % 2 > 0
    albedo = np.where(dark, 0.25, 1.0)
    centre = line_rows(rig, board, x[0])
    line = np.exp(-0.5 * ((y - centre[None, :]) / WIDTH_PX) ** 2)
    image = albedo[:, :, None] * (150.0 + line[:, :, None] * np.array(laser))
    image += rng.normal(0.0, 2.0, image.shape)
    return Exposure(np.clip(image, 0, 255).round().astype(np.uint8), board.profile.source)


def line_rows(rig: SheetRig, board: BoardStripes, x: FloatArray) -> FloatArray:
    """Row of the true stripe in each column; far outside the image where there is none."""
    q = board.profile.points_px
    order = np.argsort(q[:, 0])
    return np.interp(x, q[order, 0], q[order, 1], left=-100.0, right=-100.0)


@pytest.mark.parametrize(
    ("laser", "expected"),
    [((0.0, 70.0, 0.0), "green"), ((70.0, 0.0, 0.0), "red"), ((10.0, 20.0, 80.0), "blue")],
)
def test_a_faint_line_over_squares_is_taken_in_a_difference_of_channels(
    laser: tuple[float, float, float], expected: str
) -> None:
    """In the laser's own channel the squares are stronger than the line; in a difference they go.

    The choice must be as good as the best single channel, judged by the error against the truth.
    """
    rig = rig_of_vga()
    clean = replace(rig, sigma_stripe_px=1e-3).boards(rig.camera, np.random.default_rng(1))
    pictures = [photograph(rig, board, laser, k) for k, board in enumerate(clean)]

    def stripes_of(k: int, channel: LaserColour) -> BoardStripes | FitFailure:
        profile = extract_stripes(pictures[k], StripeOptions(laser_colour=channel))
        nothing = FitFailure("no stripe")
        return replace(clean[k], profile=profile) if profile.is_accepted.any() else nothing

    cameras = HeadCameras.of(rig.calibration(rig.camera))
    (chosen, reason), *_ = rank_channels(len(clean), stripes_of, cameras, SheetOptions())
    assert chosen.startswith(expected + "-")
    assert chosen in reason
    errors = {}
    for channel in (chosen, f"{expected}-excess", expected, "grey"):
        found = [stripes_of(k, channel) for k in range(len(clean))]  # type: ignore[arg-type]
        errors[channel] = error_px(
            rig, clean, [one for one in found if not isinstance(one, FitFailure)]
        )
    best = min(rms for rms, n in errors.values() if n > 0.8 * max(m for _, m in errors.values()))
    assert errors[chosen][0] < 1.1 * best


def error_px(
    rig: SheetRig, clean: Sequence[BoardStripes], found: Sequence[BoardStripes]
) -> tuple[float, int]:
    """Root mean square error of the points within 5 px of the true line, and their count."""
    missed = []
    truth = {board.profile.source: board for board in clean}
    for one in found:
        good = one.profile.points_px[one.profile.is_accepted]
        off = good[:, 1] - line_rows(rig, truth[one.profile.source], good[:, 0])
        missed.append(off[np.abs(off) < 5.0])
    every = np.concatenate([*missed, np.zeros(0)])
    return (float(np.sqrt((every**2).mean())) if len(every) else np.inf), len(every)


def test_nothing_is_chosen_where_nothing_is_straight() -> None:
    rig = rig_of_vga()
    clean = rig.boards(rig.camera, np.random.default_rng(2))
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    nothing = FitFailure("no stripe")
    found = rank_channels(len(clean), lambda k, channel: nothing, cameras, SheetOptions())
    assert found == ()


def test_after_a_channel_of_many_lines_comes_one_on_which_the_boards_agree() -> None:
    """Five edges of an overexposed board in grey, which no vote judges, and the line in green."""
    rig = rig_of_vga()
    boards = rig.boards(rig.camera, np.random.default_rng(2))
    cameras = HeadCameras.of(rig.calibration(rig.camera))

    def stripes_of(k: int, channel: LaserColour) -> BoardStripes | FitFailure:
        one = boards[k].profile
        if channel == "green-excess":
            return cut_to(boards[k], 120, 1.0, k)
        if channel != "grey":
            return FitFailure("no stripe")
        shifts = [40.0 * n * one.normals_px + 0.3 * (n + k) for n in range(-2, 3)]
        points = np.concatenate([one.points_px + shift for shift in shifts])
        stripes = [(part, one.normals_px) for part in np.split(points, 5)]
        return replace(boards[k], profile=make_profile(one.source, stripes, 0.06), on_edge=None)

    ranked = rank_channels(len(boards), stripes_of, cameras, SheetOptions())
    assert [channel for channel, _ in ranked] == ["grey", "green-excess"]


def test_lines_on_which_the_boards_do_not_agree_do_not_outweigh_one_on_which_they_do() -> None:
    """Three borders of each board in red, at random places, of more points together."""
    rig, rng = rig_of_vga(), np.random.default_rng(5)
    boards = rig.boards(rig.camera, np.random.default_rng(2))
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    borders = []
    for board in boards:
        middle = board.view.points_px.mean(axis=0)
        reach = 0.4 * np.ptp(board.view.points_px, axis=0).min()
        stripes = []
        for angle in rng.uniform(0.0, np.pi) + np.array([0.0, 1.0, 2.0]):
            along = np.array([np.cos(angle), np.sin(angle)])
            centre = middle + 0.4 * reach * rng.uniform(-1.0, 1.0, 2)
            points = centre + np.linspace(-reach, reach, 70)[:, None] * along
            normals = np.tile([-along[1], along[0]], (70, 1))
            stripes.append((points + rng.normal(0.0, 0.1, (70, 1)) * normals, normals))
        profile = make_profile(board.profile.source, stripes, 0.06)
        borders.append(replace(board, profile=profile, on_edge=None))

    def stripes_of(k: int, channel: LaserColour) -> BoardStripes | FitFailure:
        if channel == "red":
            return borders[k]
        return cut_to(boards[k], 120, 0.1, k) if channel == "green" else FitFailure("no stripe")

    (first, _), *_ = rank_channels(len(boards), stripes_of, cameras, SheetOptions())
    assert first == "green"


@pytest.mark.parametrize("second", ["green-excess", None])
def test_the_next_channel_is_tried_where_the_first_gives_no_sheet(
    second: LaserColour | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lines of an overexposed board are refused by the fit, not by the choice of a channel."""
    rig = rig_of_vga()
    fit = calibrate_sheets(
        rig.boards(rig.camera, np.random.default_rng(1)), rig.calibration(rig.camera)
    )
    assert isinstance(fit, LaserFit)
    refusal = FitFailure("no numbering holds (not used: b.png: no board)", "look")

    def calibrated(_: object, colour: LaserColour) -> LaserFit | FitFailure:
        return replace(fit, laser_colour=colour) if colour == "green-excess" else refusal

    ranked = [("grey", "grey: most"), *([] if second is None else [(second, f"{second}: next")])]
    placement = laser.BoardPlacement("a.png", {0: cast(SeenBoard, (0, None, None))}, None)
    monkeypatch.setattr(laser, "find_placements", lambda *_: iter([placement]))
    monkeypatch.setattr(laser, "wrong_count", lambda *_: None)
    monkeypatch.setattr(laser, "rank_channels", lambda *_: ranked)
    monkeypatch.setattr(laser._LitBoards, "calibrated", calibrated)
    size = (rig.camera.height_px, rig.camera.width_px, 3)
    levels = np.zeros(size, np.uint8)
    levels[0, 0, 0] = 1
    picture = Exposure(levels, "a.png")
    found = laser.calibrate_sheets_from_pairs(
        [(picture, None)], Chessboard(7, 5, 10.0), rig.calibration(rig.camera)
    )
    if second is None:
        assert found is refusal
        return
    assert isinstance(found, LaserFit)
    assert found.laser_colour == "green-excess"
    assert found.channel_reason == "green-excess: next; grey shows more, but no numbering holds"


def test_no_channel_is_weighed_of_grey_photographs_in_three_channels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, asked = rig_of_vga(), []
    placement = laser.BoardPlacement("a.png", {0: cast(SeenBoard, (0, None, None))}, None)
    monkeypatch.setattr(laser, "find_placements", lambda *_: iter([placement]))
    monkeypatch.setattr(laser, "wrong_count", lambda *_: None)
    monkeypatch.setattr(laser, "rank_channels", lambda *_: asked.append("channels"))
    refusal = FitFailure("no board", "look")
    monkeypatch.setattr(laser._LitBoards, "calibrated", lambda _, colour: refusal)
    grey = np.full((rig.camera.height_px, rig.camera.width_px, 3), 7, np.uint8)
    camera, target = rig.calibration(rig.camera), Chessboard(7, 5, 10.0)
    for levels, n_asked in ((grey, 0), (grey + np.uint8([0, 1, 0]), 1)):
        pairs = [(Exposure(levels, "a.png"), None)]
        assert laser.calibrate_sheets_from_pairs(pairs, target, camera) is refusal
        assert len(asked) == n_asked


@pytest.mark.parametrize(
    ("room", "light", "expected"),
    [(0.0, (255.0, 600.0, 255.0), "green"), (120.0, (0.0, 70.0, 0.0), "green-excess")],
    ids=["white core in the dark", "faint on a lit wall"],
)
def test_a_scan_is_seen_in_the_channel_that_shows_its_lines(
    room: float, light: tuple[float, float, float], expected: str
) -> None:
    """Calibrated in an excess: in the dark the line's middle is white, and it is that of no colour.

    The wall's stripes are stronger than the faint line in its own channel.
    """
    y, x = np.mgrid[:200, :320].astype(np.float64)
    wide, narrow = (np.exp(-0.5 * ((y - 90.3 - 0.05 * x) / s) ** 2) for s in (6.0, 2.0))
    wall = np.where((x // 24) % 2 > 0, 0.4, 1.0)
    image = room * wall[:, :, None] + np.random.default_rng(3).normal(2.0, 1.0, (*x.shape, 3))
    image += narrow[:, :, None] * np.array(light)
    if not room:
        # the lens spreads the laser's own light, and the core clips in every channel
        image += narrow[:, :, None] * 300.0 + wide[:, :, None] * np.array([0.0, 60.0, 0.0])
    seen = Exposure(np.clip(image, 0, 255).round().astype(np.uint8), "scan.png")
    sensor = replace(sensor_calibration(), laser_colour="green-excess")

    def pair_of(k: int) -> tuple[Exposure, None]:
        if k == 0:
            raise InputError("cut off")
        return seen, None

    stripes, about = stripes_as_seen(7, pair_of, sensor, StripeOptions())
    assert stripes.laser_colour == expected
    assert bool(about) is (expected == "green")
    own = stripes_as_seen(7, pair_of, replace(sensor, laser_colour="green"), StripeOptions())
    assert own == (StripeOptions(laser_colour="green"), ""), "nothing is looked at"
    chosen = StripeOptions(laser_colour="red")
    assert stripes_as_seen(7, lambda _: (seen, None), sensor, chosen) == (chosen, "")


def test_a_glint_in_one_image_of_a_scan_does_not_change_its_channel() -> None:
    y, x = np.mgrid[:200, :320].astype(np.float64)
    wall = np.where((x // 24) % 2 > 0, 48.0, 120.0)[:, :, None] * np.ones(3)
    line = np.exp(-0.5 * ((y - 90.3 - 0.05 * x) / 2.0) ** 2)[:, :, None] * [0.0, 70.0, 0.0]
    glint = np.exp(-0.5 * ((y - 60.0) / 2.0) ** 2) * (np.abs(x - 100.0) < 40.0)
    rng = np.random.default_rng(4)

    def pair_of(k: int) -> tuple[Exposure, None]:
        light = line if k else glint[:, :, None] * [255.0, 400.0, 255.0]
        image = wall + light + rng.normal(0.0, 1.0, (*x.shape, 3))
        return Exposure(np.clip(image, 0, 255).round().astype(np.uint8), f"{k}.png"), None

    sensor = replace(sensor_calibration(), laser_colour="green-excess")
    stripes, about = stripes_as_seen(6, pair_of, sensor, StripeOptions())
    assert (stripes.laser_colour, about) == ("green-excess", "")


def cut_to(board: BoardStripes, n: int, scatter_px: float, seed: int) -> BoardStripes:
    """The first n points of a board's stripe, with this scatter across the line."""
    profile = board.profile.select(np.arange(len(board.profile)) < n)
    rng = np.random.default_rng(seed)
    off = rng.normal(0.0, scatter_px, len(profile))[:, None] * profile.normals_px
    return replace(board, profile=replace(profile, points_px=profile.points_px + off), on_edge=None)


def test_a_line_on_all_boards_wins_over_a_precise_piece_on_two() -> None:
    """Two short pieces of print that scatter by 0.3 px, and a wide line of 1 px on all boards."""
    rig = rig_of_vga()
    boards = replace(rig, sigma_stripe_px=1e-3).boards(rig.camera, np.random.default_rng(2))
    assert len(boards) >= 6
    cameras = HeadCameras.of(rig.calibration(rig.camera))

    def stripes_of(k: int, channel: LaserColour) -> BoardStripes | FitFailure:
        if channel == "red-blue":
            return cut_to(boards[k], 120, 1.0, k)
        if channel == "grey" and k < 2:
            return cut_to(boards[k], 40, 0.3, k)
        return FitFailure("no stripe")

    (chosen, _), *_ = rank_channels(len(boards), stripes_of, cameras, SheetOptions())
    assert chosen == "red-blue"


@pytest.mark.parametrize(
    ("as_is", "less", "n_shown", "expected"),
    [(1.0, 0.1, 8, True), (0.1, 1.0, 8, False), (None, 0.1, 1, False), (None, None, 0, False)],
    ids=["clearer less its print", "clearer as it is", "on one board", "on none"],
)
def test_a_print_is_taken_away_where_that_shows_the_line_better(
    as_is: float | None, less: float | None, n_shown: int, expected: bool
) -> None:
    rig = rig_of_vga()
    boards = replace(rig, sigma_stripe_px=1e-3).boards(rig.camera, np.random.default_rng(2))
    cameras = HeadCameras.of(rig.calibration(rig.camera))

    def stripes_of(k: int, is_less: bool) -> BoardStripes | FitFailure:
        scatter = less if is_less else as_is
        if scatter is None or (is_less and k >= n_shown):
            return FitFailure("no stripe")
        return cut_to(boards[k], 120, scatter, k)

    is_taken, reason = choose_print(len(boards), stripes_of, cameras, SheetOptions())
    assert is_taken is expected
    assert bool(reason) is expected


def test_a_print_that_shows_no_line_is_given_up_after_three_photographs() -> None:
    """Telling a print takes a second an image."""
    rig = rig_of_vga()
    boards = replace(rig, sigma_stripe_px=1e-3).boards(rig.camera, np.random.default_rng(2))
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    asked: list[int] = []

    def stripes_of(k: int, is_less: bool) -> BoardStripes | FitFailure:
        if is_less:
            asked.append(k)
            return FitFailure("no stripe")
        return cut_to(boards[k], 120, 1.0, k)

    assert len(boards) > 3
    assert choose_print(len(boards), stripes_of, cameras, SheetOptions()) == (False, "")
    assert sorted(asked) == [0, len(boards) // 2, len(boards) - 1]


def test_without_bare_photographs_no_print_is_asked_for() -> None:
    rig = rig_of_vga()
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    assert choose_print(0, lambda _k, _less: FitFailure("asked"), cameras, SheetOptions()) == (
        False,
        "",
    )
