# SPDX-License-Identifier: Apache-2.0
"""AprilGrids, drawn here from OpenCV's codes and seen by 25 rays a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from armscan.geometry.arrays import FloatArray, apply_homography
from armscan.geometry.estimate import FitFailure
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_views
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.vision.targets.april_grid import read_markers
from armscan.vision.targets.detect import detect_target, settle_target
from armscan.vision.targets.target import (
    APRIL_FAMILIES,
    AprilGrid,
    TargetView,
    describe_target,
    parse_target,
)

KALIBR = AprilGrid(6, 6, 88.0)
SIZE_PX = (640, 480)
FOCAL_PX = 800.0
FINE = 5


@dataclass(frozen=True)
class Print:
    """A grid as it is printed: ``turn`` is that of the tags, 2 and rows ``up`` those of Kalibr."""

    grid: AprilGrid = KALIBR
    bits: int = 2
    is_up: bool = True
    turn: int = 2
    has_squares: bool = True
    has_outer_squares: bool = True

    def tone(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """1 where it is light, at places in sides of a tag from the upper left tag's corner."""
        grid = self.grid
        dictionary = cv2.aruco.getPredefinedDictionary(
            getattr(cv2.aruco, APRIL_FAMILIES[grid.family])
        )
        side = int(dictionary.markerSize) + 2 * self.bits
        numbers = range(grid.first_id, grid.first_id + grid.columns * grid.rows)
        drawn = [dictionary.generateImageMarker(k, side, borderBits=self.bits) for k in numbers]
        codes = np.array([np.rot90(one, self.turn) for one in drawn]) > 0
        step = 1.0 + grid.spacing
        i, j = np.floor(x / step).astype(int), np.floor(y / step).astype(int)
        u, v = x - i * step, y - j * step
        row = grid.rows - 1 - j if self.is_up else j
        inside = (i >= 0) & (j >= 0) & (i < grid.columns) & (j < grid.rows)
        number = np.where(inside, row * grid.columns + i, 0)
        a, b = (np.clip((part * side).astype(int), 0, side - 1) for part in (u, v))
        tone = np.where(inside & (u < 1.0) & (v < 1.0), codes[number, b, a], 1.0)
        more = 1 if self.has_outer_squares else 0
        in_reach = (i >= -more) & (j >= -more)
        in_reach &= (i < grid.columns - 1 + more) & (j < grid.rows - 1 + more)
        is_square = self.has_squares & in_reach & (u >= 1.0) & (v >= 1.0)
        return np.where(is_square, 0.0, tone)


def from_grid(
    grid: AprilGrid, turns_deg: tuple[float, float, float], fill: float = 0.7
) -> FloatArray:
    """(3, 3) homography from sides of a tag to pixels: turned about x, y and the board's normal,
    the larger extent ``fill`` times the image's height.
    """
    about_x, about_y, roll = np.radians(turns_deg)
    rotation = cv2.Rodrigues(np.array([about_x, about_y, 0.0]))[0]
    rotation = rotation @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    extent = np.array([grid.columns, grid.rows]) * (1.0 + grid.spacing) - grid.spacing
    depth = FOCAL_PX * extent.max() / (fill * SIZE_PX[1])
    shift = np.array([0.0, 0.0, depth]) - rotation @ np.array([*(0.5 * extent), 0.0])
    camera = np.array([[FOCAL_PX, 0.0, 319.5], [0.0, FOCAL_PX, 239.5], [0.0, 0.0, 1.0]])
    return np.asarray(camera @ np.column_stack([rotation[:, 0], rotation[:, 1], shift]))


TILTED = (25.0, -20.0, 12.0)


@cache
def photograph(
    shown: Print,
    turns_deg: tuple[float, float, float] = TILTED,
    fill: float = 0.7,
    blur_px: float = 0.8,
) -> Exposure:
    width, height = SIZE_PX
    v, u = np.mgrid[: height * FINE, : width * FINE]
    pixels = (np.stack([u.ravel(), v.ravel()], axis=1) + 0.5) / FINE - 0.5
    back = np.linalg.inv(from_grid(shown.grid, turns_deg, fill))
    x, y = apply_homography(back, pixels).T
    levels = 40.0 + 165.0 * shown.tone(x, y)
    image = levels.reshape(height, FINE, width, FINE).mean(axis=(1, 3))
    noise = np.random.default_rng(7).normal(0.0, 1.5, image.shape)
    image = gaussian_filter(image, blur_px) + noise
    return Exposure(np.clip(np.rint(image), 0, 255).astype(np.uint8), "drawn")


def found(exposure: Exposure, grid: AprilGrid) -> TargetView:
    view = detect_target(exposure, grid)
    assert isinstance(view, TargetView), view
    return view


def refused(exposure: Exposure, grid: AprilGrid) -> FitFailure:
    failure = detect_target(exposure, grid)
    assert isinstance(failure, FitFailure)
    return failure


def errors(view: TargetView, seen: FloatArray) -> FloatArray:
    """(N, 2) px; the truth by the rendering's homography and places counted here."""
    side = KALIBR.tag_mm
    return view.points_px - apply_homography(seen, view.points_board_mm[:, :2] / side)


def truth_of(grid: AprilGrid) -> FloatArray:
    """Corners in sides of a tag, row by row from the top, by plain counting."""
    lines = [
        [k * (1.0 + grid.spacing) + end for k in range(count) for end in (0.0, 1.0)]
        for count in (grid.columns, grid.rows)
    ]
    return np.array([[x, y] for y in lines[1] for x in lines[0]])


@pytest.mark.parametrize("bits", [2, 1])
@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_every_corner_is_found_as_near_as_its_sigma_says(bits: int, blur_px: float) -> None:
    view = found(photograph(Print(bits=bits), TILTED, 0.7, blur_px), KALIBR)
    assert view.point_index.tolist() == list(range(144))
    np.testing.assert_allclose(view.points_board_mm[:, :2], 88.0 * truth_of(KALIBR))
    error = errors(view, from_grid(KALIBR, TILTED))
    # 25 rays a pixel err by 0.005 px themselves; the code's blur reaches into narrow borders
    covariance = view.covariance_px2 + 0.005**2 * np.eye(2)
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / 2.0
    assert chi2.mean() < (1.5 if bits == 2 else 2.5)
    assert np.sqrt((error**2).mean()) < 0.03


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
@pytest.mark.parametrize("is_up", [True, False])
def test_rows_up_or_down_and_tags_turned_are_told_by_the_image(*, is_up: bool, turn: int) -> None:
    view = found(photograph(Print(is_up=is_up, turn=turn)), KALIBR)
    assert len(view) == 144
    assert np.abs(errors(view, from_grid(KALIBR, TILTED))).max() < 0.1
    order = "down" if is_up else "up"
    failure = refused(photograph(Print(is_up=is_up, turn=turn)), replace(KALIBR, order=order))
    assert f":{'up' if is_up else 'down'}" in failure.remedy


def test_other_counts_spacings_first_numbers_and_families() -> None:
    for grid in (
        AprilGrid(7, 4, 88.0, 0.25, first_id=100),
        AprilGrid(4, 5, 88.0, 0.4, "tag25h9", 5),
        AprilGrid(5, 4, 88.0, 0.3, "tag36h10"),
    ):
        view = found(photograph(Print(grid)), grid)
        assert len(view) == 4 * grid.columns * grid.rows
        np.testing.assert_allclose(view.points_board_mm[:, :2], 88.0 * truth_of(grid))
        assert np.abs(errors(view, from_grid(grid, TILTED))).max() < 0.1


def test_a_part_of_the_grid_keeps_its_numbers() -> None:
    view = found(photograph(Print(), (5.0, 40.0, 33.0), 1.7), KALIBR)
    assert 40 < len(view) < 120
    assert np.abs(errors(view, from_grid(KALIBR, (5.0, 40.0, 33.0), 1.7))).max() < 0.1


def test_tags_that_the_reader_misses_are_found_beside_the_others() -> None:
    exposure = photograph(Print(), (45.0, 5.0, -40.0), 0.55, 1.2)
    read = read_markers(np.asarray(exposure.image, np.uint8), APRIL_FAMILIES["tag36h11"], 2)
    assert len(read.ids) < 30
    view = found(exposure, KALIBR)
    assert len(view) > 136
    assert np.abs(errors(view, from_grid(KALIBR, (45.0, 5.0, -40.0), 0.55))).max() < 0.15


def test_corners_of_a_tag_that_is_covered_are_left_out() -> None:
    exposure = photograph(Print())
    covered = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]) + 1.3 * np.array([2, 1])
    outline = apply_homography(from_grid(KALIBR, TILTED), covered)
    image = exposure.image.copy()
    cv2.fillPoly(image, [np.rint(outline).astype(np.int32)], 120)
    view = found(Exposure(image, "covered"), KALIBR)
    lost = set(range(144)) - set(view.point_index.tolist())
    assert lost == {2 * 12 + 4, 2 * 12 + 5, 3 * 12 + 4, 3 * 12 + 5}


def test_corners_that_touch_no_square_are_left_out_and_a_grid_without_any_is_refused() -> None:
    view = found(photograph(Print(has_outer_squares=False)), KALIBR)
    corner = truth_of(KALIBR)[view.point_index]
    last = truth_of(KALIBR).max()
    assert len(view) == 100
    assert not ((corner == 0.0) | (corner == last)).any()
    assert np.abs(errors(view, from_grid(KALIBR, TILTED))).max() < 0.1
    failure = refused(photograph(Print(has_squares=False)), KALIBR)
    assert "touch no small dark square" in failure.reason
    assert "Kalibr" in failure.remedy


@pytest.mark.parametrize(
    ("shown", "asked", "says", "fits"),
    [
        (KALIBR, replace(KALIBR, columns=5), "grow by 6", "aprilgrid:6x6:88:0.3"),
        (KALIBR, replace(KALIBR, columns=7), "grow by 6", "aprilgrid:6x6:88:0.3"),
        (KALIBR, replace(KALIBR, rows=4), "tags 0 to 35", "aprilgrid:6x6:88:0.3"),
        (KALIBR, replace(KALIBR, first_id=1), "tags 0 to 35", "aprilgrid:6x6:88:0.3"),
        (
            replace(KALIBR, first_id=40),
            KALIBR,
            "tags 40 to 75",
            "aprilgrid:6x6:88:0.3:first=40",
        ),
        (
            replace(KALIBR, first_id=12),
            KALIBR,
            "tags 12 to 47",
            "aprilgrid:6x6:88:0.3:first=12",
        ),
        (KALIBR, replace(KALIBR, spacing=0.25), "0.300 of their side", "aprilgrid:6x6:88:0.3"),
        (KALIBR, replace(KALIBR, spacing=0.32), "0.300 of their side", "aprilgrid:6x6:88:0.3"),
        (KALIBR, replace(KALIBR, border_bits=1), "2 cells", "aprilgrid:6x6:88:0.3:border=2"),
        (
            KALIBR,
            replace(KALIBR, family="tag36h10"),
            "36 tags of tag36h11",
            "aprilgrid:6x6:88:0.3",
        ),
    ],
)
def test_a_wrong_grid_is_refused_with_what_is_seen_and_what_to_type(
    shown: AprilGrid, asked: AprilGrid, says: str, fits: str
) -> None:
    exposure = photograph(Print(shown))
    failure = refused(exposure, asked)
    assert says in failure.reason
    assert fits in failure.remedy.replace(",", " ").replace(";", " ").split()
    assert len(found(exposure, grid_of(fits))) == 144


def grid_of(text: str) -> AprilGrid:
    grid = parse_target(text)
    assert isinstance(grid, AprilGrid)
    return grid


def test_a_border_of_one_cell_is_told_from_one_of_two() -> None:
    failure = refused(photograph(Print(bits=1)), replace(KALIBR, border_bits=2))
    assert "1 cells" in failure.reason
    assert len(found(photograph(Print(bits=1)), replace(KALIBR, border_bits=1))) == 144


def test_of_two_grids_in_view_the_one_that_is_meant_is_taken() -> None:
    other = replace(KALIBR, first_id=36)
    one, two = (photograph(Print(grid)) for grid in (KALIBR, other))
    both = Exposure(np.concatenate([one.image, two.image], axis=1), "both")
    for grid, aside in ((KALIBR, 0), (other, SIZE_PX[0])):
        view = found(both, grid)
        assert len(view) == 144
        assert np.abs(errors(view, from_grid(KALIBR, TILTED)) - [aside, 0]).max() < 0.1


def test_one_row_is_numbered_as_the_set_tells() -> None:
    whole, seen = photograph(Print()), from_grid(KALIBR, TILTED)
    image = whole.image.copy()
    for top, bottom in ((-0.4, 2.29), (3.91, 8.0)):
        strip = np.array([[-1.0, top], [9.0, top], [9.0, bottom], [-1.0, bottom]])
        cv2.fillPoly(image, [np.rint(apply_homography(seen, strip)).astype(np.int32)], 205)
    row = Exposure(image, "row")
    assert "next row" in refused(row, KALIBR).reason
    assert settle_target([row, whole], KALIBR) == replace(KALIBR, border_bits=2, order="up")
    views = find_targets([row, whole], KALIBR).views
    assert [view.source for view in views] == ["row", "drawn"]
    assert len(views[0]) >= 6
    assert np.abs(errors(views[0], seen)).max() < 0.1


def test_an_image_without_a_grid_is_refused() -> None:
    blank = Exposure(np.full((240, 320), 90, np.uint8), "blank")
    assert "0 tags of tag36h11" in refused(blank, KALIBR).reason
    assert settle_target([blank], KALIBR) == KALIBR
    mirrored = Exposure(np.ascontiguousarray(photograph(Print()).image[:, ::-1]), "mirrored")
    assert "mirrored" in refused(mirrored, KALIBR).remedy


def test_a_camera_is_calibrated_within_its_sigmas() -> None:
    poses = [(25.0, -20.0, 12.0), (-30.0, 5.0, 40.0), (5.0, 35.0, -20.0), (-20.0, -30.0, 95.0)]
    poses += [(35.0, 10.0, 170.0), (3.0, -38.0, 60.0)]
    views = [
        replace(found(photograph(Print(), pose), KALIBR), source=f"view {k}")
        for k, pose in enumerate(poses)
    ]
    run = calibrate_camera_from_views(views)
    assert isinstance(run, CameraRun)
    focal = run.fit.camera.fx_px, run.fit.camera.fy_px
    np.testing.assert_allclose(focal, FOCAL_PX, atol=0.5)
    centre = run.fit.camera.cx_px, run.fit.camera.cy_px
    np.testing.assert_allclose(centre, (319.5, 239.5), atol=0.5)


def test_a_grid_is_described() -> None:
    text = describe_target(replace(KALIBR, first_id=36))
    assert "6 x 6 tags of tag36h11, 36 to 71" in text
    assert "660 x 660 mm" in text
