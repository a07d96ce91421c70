# SPDX-License-Identifier: Apache-2.0
"""The reports say what the results hold: numbers with sigma, views left out and why, all points."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import LaserFit, PointUse
from armscan.calibration.sheets.stripes_on_board import TargetEdges, runs_along_edge
from armscan.jobs.sheets import sheets_summary
from armscan.models.calibration import FTest
from armscan.pipeline.cameras import camera_calibration
from armscan.records.exposure import Exposure
from armscan.records.profile import REJECTING, StripeFlag
from armscan.report.camera import camera_page, camera_quantities
from armscan.report.charts import ARROW_SHARE, magnification
from armscan.report.page import render_page
from armscan.report.photographs import FLAG_COLOURS
from armscan.report.quantity import with_sigma
from armscan.report.sheets import USE_COLOURS, lack_of_fit_text, laser_page
from rigs.camera_scene import Scene, make_views
from rigs.sheet_rig import PROVENANCE, thesis_rig


@cache
def camera_fit() -> CameraFit:
    views, _ = make_views(Scene(n_views=8), seed=3)
    options = CameraOptions(leave_out=(views[2].source,), solve_warp=True)
    fit = calibrate_camera(views, options)
    assert isinstance(fit, CameraFit)
    return fit


@cache
def laser_fit() -> LaserFit:
    rig = thesis_rig(bow_uu_mm=0.1)
    boards = rig.boards(rig.camera, np.random.default_rng(5))
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    return fit


def blank(fit_source: str, width: int, height: int) -> Exposure:
    return Exposure(np.full((height, width), 90, np.uint8), fit_source)


def text_of(page: bytes) -> str:
    """What a reader sees: no pictures, no markup."""
    text = re.sub(r"<(style|script|svg)[^>]*>.*?</\1>", " ", page.decode(), flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))


def test_camera_page_shows_numbers_views_and_reasons() -> None:
    fit = camera_fit()
    sources = [view.source for view in fit.views]
    exposures = {name: blank(name, 2048, 1536) for name in sources[:3]}
    not_found = (("dark.png", "dark.png: no grid of 11 x 9 circles in view"),)
    page = render_page(camera_page(fit, not_found, exposures, PROVENANCE))
    text = text_of(page)
    assert with_sigma(fit.camera.fx_px, fit.sigma[0], "px") in text
    assert all(source in text for source in sources)
    assert "left out by request" in text
    assert "dark.png no grid of 11 x 9 circles in view" in text
    assert "Bow along x" in text
    assert page.count(b"<svg") == 3
    assert f"{fit.n_views} of {len(sources) + 1} images used" in text


def test_camera_page_says_that_there_was_no_hold_out() -> None:
    """Of three photographs two are left, and two solve no camera."""
    views, _ = make_views(Scene(n_views=3), seed=3)
    fit = calibrate_camera(views)
    assert isinstance(fit, CameraFit)
    assert fit.cross_validation is None
    text = text_of(render_page(camera_page(fit, (), {}, PROVENANCE)))
    assert "On images it has not seen not known" in text
    (told,) = (item for item in camera_quantities(fit, 3) if item.key == "hold_out_rms_px")
    assert told.value is None


def test_residual_arrows_are_enlarged_by_a_round_number() -> None:
    fit = camera_fit()
    scale = magnification(fit.camera, fit.rms_px)
    assert f"{scale:.0e}"[0] in "125"
    three_sigma = 3.0 * fit.rms_px * scale / fit.camera.width_px
    assert ARROW_SHARE / 2.5 <= three_sigma <= ARROW_SHARE


def test_document_of_a_camera_is_the_fit() -> None:
    fit = camera_fit()
    document = camera_calibration(fit, PROVENANCE)
    assert document.n_views == 7
    np.testing.assert_array_equal(document.covariance, fit.covariance)
    np.testing.assert_array_equal(document.camera.parameters, fit.camera.parameters)
    kept = document.diagnostics
    assert kept is not None
    assert kept.board is not None
    assert fit.warp is not None
    assert fit.cross_validation is not None
    assert kept.board.sigma_mm == tuple(fit.warp.sigma_mm)
    assert kept.board.test.p_value == fit.warp.p_value
    assert (kept.hold_out_rms_px, kept.n_folds) == (
        fit.cross_validation.rms_px,
        fit.cross_validation.n_folds,
    )
    assert (kept.condition, kept.noise_scale) == (fit.condition, fit.noise_scale)


def test_document_of_sheets_keeps_the_evidence() -> None:
    fit = laser_fit()
    document = fit.to_calibration(PROVENANCE)
    (sheet,), (kept,) = fit.sheets, [sheet.diagnostics for sheet in document.sheets]
    assert kept is not None
    assert kept.plane_test.f_ratio == sheet.diagnostics.plane_test.f_ratio > kept.final_test.f_ratio
    assert kept.final_test.p_value == sheet.diagnostics.final_test.p_value
    assert (kept.rms_px, kept.board_angle_deg) == (
        sheet.diagnostics.rms_px,
        sheet.diagnostics.board_angle_deg,
    )
    assert (kept.coplanarity_mm, kept.coplanarity_sigma_mm) == (
        sheet.diagnostics.coplanarity_mm,
        sheet.diagnostics.coplanarity_sigma_mm,
    )
    assert document.diagnostics is not None
    assert document.diagnostics.naming == fit.diagnostics.naming


def test_laser_page_shows_every_point_and_the_bow() -> None:
    fit = laser_fit()
    exposures = {
        name: blank(name, fit.camera.camera.width_px, fit.camera.camera.height_px)
        for image in fit.images
        for name in (image.source, image.view.source)
    }
    page = render_page(laser_page(fit, exposures, PROVENANCE))
    text = text_of(page)
    assert "bowed" in text
    assert "lack of fit" in text.lower()
    assert all(image.source in text for image in fit.images)
    dots = sum(len(re.findall(r"M[-\d.e ]+h0", part)) for part in page.decode().split("<svg")[1:])
    assert dots >= sum(len(image.profile) for image in fit.images)


def test_residuals_that_the_picture_cuts_off_are_counted() -> None:
    """It ends at 1.15 times what holds 98 % of a board's points."""
    fit = laser_fit()
    used = [one.residual_mm[np.isfinite(one.residual_mm)] for one in fit.images]
    residual_mm = np.copy(fit.images[0].residual_mm)
    inside = np.flatnonzero(np.abs(residual_mm) < 0.5 * np.nanstd(residual_mm))[:3]
    residual_mm[inside] = 100.0 * max(np.abs(one).max() for one in used)
    odd = replace(fit, images=(replace(fit.images[0], residual_mm=residual_mm), *fit.images[1:]))
    before, after = (
        sum(int(n) for n in re.findall(r"Beyond the pictures: (\d+) point", page))
        for page in (text_of(render_page(laser_page(one, {}, PROVENANCE))) for one in (fit, odd))
    )
    assert before + 1 <= after <= before + 3


def test_laser_page_names_the_points_along_an_edge_and_gives_every_status_a_colour() -> None:
    """The first half of one stripe runs on an edge of the target."""
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(5))
    profile = boards[0].profile
    half = profile.select(np.arange(len(profile)) < len(profile) // 2)
    along = np.stack([-half.normals_px[:, 1], half.normals_px[:, 0]], axis=1)
    on_edge = runs_along_edge(profile, TargetEdges(half.points_px, along))
    boards[0] = replace(boards[0], on_edge=on_edge)
    fit = calibrate_sheets(boards, rig.calibration(rig.camera))
    assert isinstance(fit, LaserFit)
    page = render_page(laser_page(fit, {}, PROVENANCE))
    assert PointUse.ON_EDGE.label in text_of(page)
    assert USE_COLOURS[PointUse.ON_EDGE].encode() in page
    assert len(set(USE_COLOURS.values())) == len(USE_COLOURS)
    assert set(USE_COLOURS) == set(PointUse) - {PointUse.USED, PointUse.FLAGGED}


def test_laser_summary_has_the_sheet_with_its_sigmas() -> None:
    fit = replace(laser_fit(), warnings=("odd",))
    written = (Path("s.json"), Path("s.npz"), Path("s.html"))
    summary = sheets_summary(fit, written, is_simulated=True)
    (sheet,) = summary.data["sheets"]
    assert sheet["plane_sensor_a_b_c_d_mm"] == fit.sheets[0].sheet.plane.tolist()
    sigmas = np.sqrt(np.diag(fit.sheets[0].covariance))[:3]
    np.testing.assert_array_equal(list(sheet["plane_sigma_mm"].values()), sigmas)
    assert "simulated" in summary.title
    assert summary.warnings[0] == "Odd."
    assert "s.json" in summary.next_step


@pytest.mark.parametrize("is_simulated", [True, False])
def test_pages_say_where_the_data_come_from(is_simulated: bool) -> None:
    page = camera_page(camera_fit(), (), {}, PROVENANCE, is_simulated=is_simulated)
    assert ("simulated data" in text_of(render_page(page))) == is_simulated


def test_every_flag_that_rejects_has_a_colour_of_its_own() -> None:
    assert {flag for flag in StripeFlag if flag & REJECTING} == set(FLAG_COLOURS)
    assert len({colour for colour, _ in FLAG_COLOURS.values()}) == len(FLAG_COLOURS)


@pytest.mark.parametrize(
    ("p_value", "words"),
    [(0.2, "no objection"), (0.0027, "weak objection"), (0.0004, "does not explain")],
)
def test_lack_of_fit_is_worded_by_the_decisions_own_limit(p_value: float, words: str) -> None:
    """The sheet is bowed below 0.001; 0.0027 is not nothing."""
    assert words in lack_of_fit_text(FTest(2.03, 20, p_value))
