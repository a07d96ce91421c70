# SPDX-License-Identifier: Apache-2.0
"""The hand-eye's page and numbers: what is printed is what the fit holds."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.hand_eye.result import angle_covariance, hand_eye_numbers
from armscan.geometry.rotations import rotations_from_euler
from armscan.jobs.hand_eye import hand_eye_summary
from armscan.models.calibration import ArmNoise, HandEyeCalibration, ScannerCalibration
from armscan.report.hand_eye import chi2_verdict, hand_eye_page, hand_eye_quantities, repeat_blocks
from armscan.report.page import render_page
from rigs.hand_eye_fake import N_POSTURES, TOOL_FROM_SENSOR, fake_fit
from rigs.sheet_rig import PROVENANCE


def text_of(page: bytes) -> str:
    """What a reader sees: no pictures, no markup."""
    text = re.sub(r"<(style|script|svg)[^>]*>.*?</\1>", " ", page.decode(), flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))


def correlated(seed: int) -> HandEyeCalibration:
    hand_eye = fake_fit()[0].calibration
    spread = np.random.default_rng(seed).standard_normal((6, 6))
    scale = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03])
    return replace(hand_eye, covariance=scale @ spread @ spread.T @ scale)


def test_printed_angles_make_the_rotation_again() -> None:
    hand_eye = correlated(1)
    numbers = hand_eye_numbers(hand_eye, hand_eye.covariance)
    again = rotations_from_euler(np.radians(numbers.euler_deg)[None], "intrinsic-xyz")[0]
    assert again == pytest.approx(TOOL_FROM_SENSOR.rotation, abs=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sigmas_of_the_angles_follow_from_the_covariance(seed: int) -> None:
    # differences here, the axes of the three turns there: two independent derivations
    hand_eye = correlated(seed)
    numbers = hand_eye_numbers(hand_eye, hand_eye.covariance)
    other = angle_covariance(TOOL_FROM_SENSOR.rotation, hand_eye.covariance)
    assert numbers.euler_sigma_deg == pytest.approx(np.sqrt(np.diag(other)[:3]), rel=1e-4)
    assert numbers.translation_sigma_mm == pytest.approx(np.sqrt(np.diag(other)[3:]))


@pytest.mark.parametrize("method", ["plate", "sphere"])
def test_the_page_shows_result_postures_noise_and_warnings(method: str) -> None:
    fit, stripes = fake_fit(method)
    scanner = ScannerCalibration(sensor=None, hand_eye=fit.calibration, provenance=PROVENANCE)
    page = render_page(hand_eye_page(fit, scanner, stripes, is_simulated=True))
    text = text_of(page)
    assert "simulated data" in text
    assert text.index("Posture 3 is the only one") < text.index("The hand-eye")
    assert f"{N_POSTURES} postures, {2 * N_POSTURES} exposures" in text
    assert "X 41.400 ± 0.015 mm" in text
    assert "rank 6 of 6" in text
    assert "compare it with the" in text
    assert ("Residuals over the plate" in text) == (method == "plate")
    assert ("alike within 40 mm" in text) == (method == "plate")
    assert page.count(b"<canvas") == 1


def test_programs_read_the_scatter_and_the_region_that_people_read() -> None:
    """Of one exposure, posture's and exposure's own part together, whoever asks."""
    fit, _ = fake_fit()
    noise = ArmNoise(0.003, 3e-5, 0.004, 4e-5, 6e-5, 8e-5)
    known = fit.calibration.diagnostics
    assert known is not None
    told = replace(fit.calibration, arm_noise=noise, diagnostics=replace(known, region_factor=1.44))
    scanner = ScannerCalibration(sensor=None, hand_eye=told, provenance=PROVENANCE)
    quantities = {item.key: item for item in hand_eye_quantities(scanner)}
    arm, region = quantities["arm_position_mm"], quantities["region_factor"]
    assert (arm.label, arm.value) == ("Arm's scatter", pytest.approx(0.005))
    assert arm.text == "0.0050 mm"
    turn_deg = np.degrees(np.hypot(5e-5, 1e-4))
    assert quantities["arm_rotation_deg"].value == pytest.approx(turn_deg)
    assert f"{turn_deg:.4f}°" in arm.line
    assert region.text.startswith("1.44 times")
    assert "1.20 times as wide" in region.line


@pytest.mark.parametrize("is_arm_given", [False, True])
def test_a_scatter_that_was_given_is_not_called_estimated(is_arm_given: bool) -> None:
    """The plate's flatness, which was not, is still estimated."""
    fit, _ = fake_fit()
    known = fit.calibration.diagnostics
    assert known is not None
    told = replace(known, is_noise_estimated=True, is_arm_given=is_arm_given)
    hand_eye = replace(fit.calibration, diagnostics=told)
    scanner = ScannerCalibration(sensor=None, hand_eye=hand_eye, provenance=PROVENANCE)
    line = next(q.line for q in hand_eye_quantities(scanner) if q.key == "arm_position_mm")
    assert ("the shift as given" in line) == is_arm_given
    assert ("test nothing" in line) != is_arm_given


def test_residuals_that_the_noise_model_does_not_allow_are_called_so() -> None:
    fit, stripes = fake_fit()
    known = fit.calibration.diagnostics
    assert known is not None
    odd = replace(
        fit.calibration, diagnostics=replace(known, chi2_probability=1e-6, is_noise_estimated=False)
    )
    fit = replace(fit, calibration=odd)
    scanner = ScannerCalibration(sensor=None, hand_eye=odd, provenance=PROVENANCE)
    text = text_of(render_page(hand_eye_page(fit, scanner, stripes)))
    assert "Fits the noise model no" in text
    assert "larger than the noise model allows" in chi2_verdict(1e-6)


def test_the_summary_holds_the_matrix_and_every_posture() -> None:
    fit, _ = fake_fit()
    scanner = ScannerCalibration(sensor=None, hand_eye=fit.calibration, provenance=PROVENANCE)
    data = hand_eye_summary(fit, scanner, (Path("s.json"),), is_simulated=False).data
    assert np.array(data["rotation_tool_from_sensor"]) == pytest.approx(TOOL_FROM_SENSOR.rotation)
    assert data["translation_tool_mm"] == pytest.approx([41.4, 21.5, 112.3])
    assert len(data["postures"]) == N_POSTURES
    assert data["method"] == "plate"


def test_repeats_are_tabled_with_mean_and_scatter() -> None:
    fits = []
    for shift in (-0.02, 0.0, 0.02):
        fit, _ = fake_fit()
        place = TOOL_FROM_SENSOR.translation_mm + np.array([shift, 0.0, 0.0])
        moved = replace(TOOL_FROM_SENSOR, translation_mm=place)
        fits.append(replace(fit, calibration=replace(fit.calibration, tool_from_sensor=moved)))
    table, text = repeat_blocks(["a", "b", "c"], fits)
    rows = {row[0]: row[1:] for row in table.rows}
    assert [rows[name][3] for name in "abc"] == ["41.380", "41.400", "41.420"]
    assert float(rows["standard deviation"][3]) == pytest.approx(0.02, abs=1e-4)
    assert float(rows["predicted"][3]) == pytest.approx(0.015, abs=1e-4)
    assert "theta_deg" in text.text


def test_sizes_of_a_hand_eyes_sigmas_are_root_mean_squares() -> None:
    covariance = np.diag([1e-8, 4e-8, 4e-8, 1e-4, 4e-4, 4e-4])
    numbers = hand_eye_numbers(fake_fit()[0].calibration, covariance)
    assert numbers.rotation_sigma_deg == pytest.approx(np.degrees(np.sqrt(3e-8)))
    assert numbers.size_sigma_mm == pytest.approx(np.sqrt(3e-4))
