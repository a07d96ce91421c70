# SPDX-License-Identifier: Apache-2.0
"""The pipelines tell what is wrong with images that hold nothing, and report their progress."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.sheets.result import LaserFit
from armscan.errors import EstimationError, InputError
from armscan.models.calibration import SensorCalibration
from armscan.models.light_sheet import LightSheet
from armscan.pipeline.laser import (
    BOARDS_STAGE,
    STRIPES_STAGE,
    calibrate_sheets_from_pairs,
    unseen_lasers,
)
from armscan.pipeline.measure import MeasureOptions, reconstruct
from armscan.pipeline.progress import ProgressEvent
from armscan.reconstruction.labels import PointStatus
from armscan.reconstruction.triangulate import DepthRange
from armscan.records.exposure import Exposure
from armscan.vision.targets.target import Chessboard
from rigs.plain_scanner import plain_camera, stored_sheet
from rigs.sheet_rig import PROVENANCE
from rigs.true_scanner import certain_camera

WIDTH, HEIGHT = 320, 240
CAMERA = plain_camera(400.0, (159.5, 119.5), (WIDTH, HEIGHT))
CALIBRATION = certain_camera(CAMERA, PROVENANCE)
LINE_SIGMA_PX = 2.0
DEPTH_MM = 200.0


def picture(source: str, line_x_px: float | None = None, width: int = WIDTH) -> Exposure:
    """Noise, and a vertical Gaussian line at the column given."""
    grey = np.random.default_rng(len(source)).normal(20.0, 1.0, (HEIGHT, width))
    if line_x_px is not None:
        offset = np.arange(width) - line_x_px
        grey += 150.0 * np.exp(-0.5 * (offset / LINE_SIGMA_PX) ** 2)
    return Exposure(np.clip(np.rint(grey), 0, 255).astype(np.uint8), source)


def sensor() -> SensorCalibration:
    """One upright sheet x = z - 200, calibrated from 190 to 210 mm."""
    normal = np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0)
    axes = np.stack([[0.0, 1.0, 0.0], np.cross(normal, [0.0, 1.0, 0.0]), normal])
    sheet = LightSheet(
        origin_mm=np.array([0.0, 0.0, DEPTH_MM]), axes=axes, scale_mm=40.0, bow_mm=np.zeros(5)
    )
    entry = stored_sheet("A", sheet, (190.0, 210.0), n_boards=4, n_points=99)
    return SensorCalibration(
        camera=CALIBRATION, sheets=(entry,), covariance=np.zeros((17, 17)), provenance=PROVENANCE
    )


def test_images_without_a_board_are_named_with_the_reason() -> None:
    events: list[ProgressEvent] = []
    fit = calibrate_sheets_from_pairs(
        [(picture("one.png", 100.0), None), (picture("two.png", 120.0), None)],
        Chessboard(7, 5, 10.0),
        CALIBRATION,
        progress=events.append,
    )
    assert not isinstance(fit, LaserFit)
    assert "no board with stripes in any of 2 images" in fit.reason
    assert "one.png" in fit.reason
    boards = [(event.done, event.total) for event in events if event.stage == BOARDS_STAGE]
    stripes = [(event.done, event.total) for event in events if event.stage == STRIPES_STAGE]
    assert boards == [(1, 2), (2, 2)]
    assert stripes == [(0, 2), (1, 2), (2, 2)]
    assert [event.item for event in events[:2]] == ["one.png", "two.png"]


def test_images_of_another_size_are_refused_before_any_work() -> None:
    small = picture("small.png", width=300)
    for call in (
        lambda: calibrate_sheets_from_pairs([(small, None)], Chessboard(7, 5, 10.0), CALIBRATION),
        lambda: reconstruct([small], sensor()),
    ):
        with pytest.raises(InputError, match=r"small\.png.*320 x 240"):
            call()


def test_a_line_becomes_points_at_the_depth_by_hand() -> None:
    """At x / z = t the sheet x = z - 200 is met at z = 200 / (1 - t)."""
    line_x_px = CAMERA.cx_px + 8.0
    result = reconstruct([picture("line.png", line_x_px)], sensor())
    depth = DEPTH_MM / (1.0 - 8.0 / CAMERA.fx_px)
    mm_per_px = depth**2 / DEPTH_MM / CAMERA.fx_px
    assert len(result.cloud) > 0.9 * HEIGHT
    error = result.cloud.points_mm[:, 2] - depth
    np.testing.assert_allclose(error, 0.0, atol=0.1 * mm_per_px)
    assert abs(error.mean()) < 0.02 * mm_per_px
    assert result.images[0].count(PointStatus.MEASURED) == len(result.cloud)
    assert result.warnings == ()


def test_a_line_far_outside_the_depths_and_no_line_are_told_apart() -> None:
    with pytest.raises(EstimationError, match="too far outside the calibrated depths"):
        reconstruct([picture("far.png", 310.0)], sensor())
    with pytest.raises(EstimationError, match="no stripe was found in 1 images"):
        reconstruct([picture("none.png")], sensor())


def test_extrapolated_points_and_empty_images_are_counted() -> None:
    lines = [picture("a.png", CAMERA.cx_px + 40.0), picture("bb.png")]
    wide = MeasureOptions(depths=DepthRange(3.0))
    result = reconstruct(lines, sensor(), options=wide)
    assert set(result.cloud.exposure.tolist()) == {0}
    assert any("bb.png" in warning for warning in result.warnings)
    assert any("outside its calibrated depth range" in warning for warning in result.warnings)


def test_sigmas_without_the_cameras_part_are_told() -> None:
    known = sensor()
    foreign = replace(known, camera=replace(known.camera, has_covariance=False))
    result = reconstruct([picture("a.png", CAMERA.cx_px)], foreign)
    assert any("came without covariance" in warning for warning in result.warnings)


def test_an_image_with_little_clean_line_is_pointed_out() -> None:
    """Fifteen rows of a line measure; the rest is torn into pieces too short to be one."""
    image = picture("torn.png", CAMERA.cx_px + 8.0).image.copy()
    rows = np.arange(HEIGHT)
    image[(rows > 25) & (rows % 14 > 9)] = 20
    result = reconstruct([Exposure(image, "torn.png")], sensor())
    assert 0 < len(result.cloud) < 0.5 * len(result.images[0].profile)
    assert any("torn.png" in warning and "half" in warning for warning in result.warnings)


def test_lasers_of_which_no_sheet_came_are_found() -> None:
    """In a scan that does not name its lasers their points would go to other sheets."""
    lit = [replace(picture(f"{k}.png"), lasers=(name,)) for k, name in enumerate("ABBC")]
    assert unseen_lasers([(one, None) for one in lit], ["A", "C.1", "C.2"]) == {"B": 2}
    assert unseen_lasers([(lit[0], None), (picture("unnamed.png"), None)], ["A"]) == {}
