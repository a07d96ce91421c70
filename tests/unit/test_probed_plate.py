# SPDX-License-Identifier: Apache-2.0
"""A plate from touches: known planes, its covariance by repeats, the side, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import (
    ProbedPlate,
    ProbingOptions,
    find_outliers,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose
from armscan.records.points import ProbedPoints

NOISE_MM = 0.012
TIP_MM = 6.0
FRAME = Pose.from_vectors([0.3, -0.2, 0.5], [400.0, -150.0, 80.0])
NORMAL = FRAME.rotation[:, 2]


def touches(
    n: int = 16, noise_mm: float = 0.0, tip_mm: float = TIP_MM, seed: int = 0
) -> FloatArray:
    """Centres of a tip on the upper face of a plate 120 mm by 80 mm."""
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(-60, 60, n), rng.uniform(-40, 40, n), np.zeros(n)])
    flat[:, 2] = tip_mm / 2 + rng.normal(0.0, noise_mm, n)
    return flat @ FRAME.rotation.T + FRAME.translation_mm


def tip_points(**how: float) -> ProbedPoints:
    return ProbedPoints(points_mm=touches(**how), tip_diameter_mm=TIP_MM)


def test_the_surface_is_half_a_diameter_below_the_centres() -> None:
    """Whichever way the side is said: where the tool was, by axis, or taken for granted."""
    above = FRAME.translation_mm + 150.0 * NORMAL
    for towards, options in (
        (above, None),
        (np.stack([above, above + 10.0]), None),
        (None, ProbingOptions(side="+z")),
        (None, None),
    ):
        plate = plate_from_probing(tip_points(), towards, options)
        assert isinstance(plate, PlateReference)
        np.testing.assert_allclose(plate.plane.normal, NORMAL, atol=1e-12)
        assert plate.plane.distance_mm(FRAME.translation_mm[None])[0] == pytest.approx(
            0.0, abs=1e-9
        )
        assert plate.tip_diameter_mm == TIP_MM
        np.testing.assert_allclose(plate.plane.axes @ plate.plane.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(plate.plane.axes) > 0.0


def plate_from_probing(
    probed: ProbedPoints,
    towards_mm: FloatArray | None = None,
    options: ProbingOptions | None = None,
) -> PlateReference | FitFailure:
    fit = fit_probed_plate(probed, towards_mm, options)
    return fit.reference if isinstance(fit, ProbedPlate) else fit


def plate_of(probed: ProbedPoints, towards_mm: FloatArray) -> PlateReference:
    plate = plate_from_probing(probed, towards_mm)
    assert isinstance(plate, PlateReference)
    return plate


def test_from_the_other_side_the_face_is_the_other_one() -> None:
    """A plate touched from below: normal turned, and the surface above the centres."""
    below = FRAME.translation_mm - 150.0 * NORMAL
    plate = plate_from_probing(tip_points(), below)
    assert isinstance(plate, PlateReference)
    np.testing.assert_allclose(plate.plane.normal, -NORMAL, atol=1e-12)
    for found in (plate.plane, plate_of(tip_points(), 99 * NORMAL + FRAME.translation_mm).plane):
        assert np.linalg.det(found.axes) == pytest.approx(1.0), "right-handed either way up"
    top = FRAME.translation_mm + TIP_MM * NORMAL
    assert plate.plane.distance_mm(top[None])[0] == pytest.approx(0.0, abs=1e-9)
    asked = plate_from_probing(tip_points(), None, ProbingOptions(side="-z"))
    assert isinstance(asked, PlateReference)
    np.testing.assert_allclose(asked.plane.coefficients, plate.plane.coefficients, atol=1e-9)


def test_points_on_the_surface_are_left_where_they_are() -> None:
    surface = ProbedPoints(points_mm=touches(tip_mm=0.0))
    plate = plate_from_probing(surface)
    assert isinstance(plate, PlateReference)
    assert np.abs(plate.plane.distance_mm(surface.points_mm)).max() < 1e-9
    assert plate.tip_diameter_mm == 0.0


def test_a_tool_in_the_plates_plane_tells_no_side() -> None:
    """Of tip centres, half a diameter rests on it; of points on the surface, nothing does."""
    beside = FRAME.translation_mm + 400.0 * FRAME.rotation[:, 0] + 0.4 * NORMAL
    on_surface = touches(tip_mm=0.0)
    plate = fit_probed_plate(ProbedPoints(points_mm=on_surface, tip_diameter_mm=0.0), beside)
    assert isinstance(plate, ProbedPlate)
    np.testing.assert_allclose(plate.reference.plane.normal, NORMAL, atol=1e-12)
    assert "taken for granted" in plate.side_from
    refused = fit_probed_plate(tip_points(), beside + 0.5 * TIP_MM * NORMAL)
    assert isinstance(refused, FitFailure)
    assert "lies in the plate's plane" in refused.reason
    assert "--side" in refused.remedy


def test_the_users_word_wins_over_the_tool() -> None:
    below = FRAME.translation_mm - 150.0 * NORMAL
    plate = fit_probed_plate(tip_points(), below, ProbingOptions(side="+z"))
    assert isinstance(plate, ProbedPlate)
    assert plate.reference.plane.normal @ NORMAL > 0.99
    assert "as asked for" in plate.side_from


def test_covariance_is_that_of_repeats() -> None:
    """Touched again 400 times: tilts and offset at the first plate's point scatter as it says."""
    design = touches(12, 0.0, seed=1)
    first = plate_from_probing(
        ProbedPoints(points_mm=design, tip_diameter_mm=TIP_MM), FRAME.translation_mm + 99 * NORMAL
    )
    assert isinstance(first, PlateReference)
    rng = np.random.default_rng(2)
    errors, sigmas = [], []
    for _ in range(400):
        noisy = design + NOISE_MM * rng.normal(size=(12, 1)) * NORMAL
        plate = plate_from_probing(
            ProbedPoints(points_mm=noisy, tip_diameter_mm=TIP_MM),
            FRAME.translation_mm + 99 * NORMAL,
        )
        assert isinstance(plate, PlateReference)
        assert plate.covariance is not None
        slope = first.plane.axes @ plate.plane.normal
        offset = -first.plane.axes[2] @ (first.plane.point_mm - plate.plane.point_mm)
        errors.append([-slope[0] / slope[2], -slope[1] / slope[2], offset])
        sigmas.append(np.sqrt(np.diag(plate.covariance)))
    ratio = np.std(errors, axis=0) / np.sqrt(np.mean(np.square(sigmas), axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=4.0 / np.sqrt(2 * 400))


def test_a_touch_that_slipped_is_named_and_left_out_on_demand() -> None:
    points = touches(14, NOISE_MM, seed=3)
    points[5] += 0.15 * NORMAL
    named = fit_probed_plate(ProbedPoints(points_mm=points, tip_diameter_mm=TIP_MM))
    assert isinstance(named, ProbedPlate)
    assert named.outliers == (5,)
    assert any("row 6 (+0.1" in warning and "took part" in warning for warning in named.warnings)
    without = fit_probed_plate(
        ProbedPoints(points_mm=points, tip_diameter_mm=TIP_MM),
        options=ProbingOptions(leave_out_outliers=True),
    )
    assert isinstance(without, ProbedPlate)
    assert without.reference.n_points == 13
    assert without.flatness_mm < 6.0 * NOISE_MM < named.flatness_mm
    assert without.residual_mm[5] == pytest.approx(0.15, abs=4.0 * NOISE_MM)


def test_a_lonely_touch_that_slipped_pulls_the_plane_but_is_named() -> None:
    """Far from the others its residual is small, being what the plane follows most."""
    rng = np.random.default_rng(6)
    flat = np.column_stack([rng.uniform(-10, 10, (12, 2)), NOISE_MM * rng.normal(size=12)])
    points = np.concatenate([flat, [[100.0, 60.0, 0.8]]])
    assert find_outliers(points) == (12,)
    good = np.concatenate([flat, [[100.0, 60.0, 0.0]]])
    assert find_outliers(good) == ()


def test_good_touches_are_seldom_named() -> None:
    """At most one in a hundred plates by its rule: of 200, more than 7 come once in 1000."""
    n_named = sum(bool(find_outliers(touches(10, NOISE_MM, seed=k))) for k in range(200))
    assert n_named <= 7


def test_what_determines_no_plate_is_a_failure_in_words() -> None:
    line = np.outer(np.linspace(0.0, 100.0, 9), [1.0, 2.0, 0.5])
    nearly = line + np.random.default_rng(4).normal(0.0, 0.05, line.shape)
    upright = ((touches() - FRAME.translation_mm) @ FRAME.rotation)[:, [0, 2, 1]]
    rough = touches(noise_mm=3.0)
    for points, word in (
        (touches(2), "three points"),
        (line, "one line"),
        (nearly, "nearly on one line"),
        (rough, "scatter"),
        (upright, "--side"),
    ):
        failure = plate_from_probing(ProbedPoints(points_mm=points, tip_diameter_mm=TIP_MM))
        assert isinstance(failure, FitFailure)
        assert word in failure.reason + failure.remedy
    inside = plate_from_probing(tip_points(), FRAME.translation_mm + TIP_MM / 2 * NORMAL)
    assert isinstance(inside, FitFailure)
    with pytest.raises(InputError):
        ProbedPoints(points_mm=np.full((4, 3), np.nan))
    with pytest.raises(OptionError, match="up"):
        ProbingOptions(side="up")


@pytest.mark.parametrize("n", [3, 4, 8, 20])
def test_the_region_of_a_plate_from_few_touches_holds_95_percent(n: int) -> None:
    """600 plates whose touches err as the options say: none is taken for exact, or too sure."""
    angle = 2.0 * np.pi * np.arange(n) / n
    flat = np.column_stack([60.0 * np.cos(angle), 40.0 * np.sin(angle), np.zeros(n)])
    rng, options = np.random.default_rng(n), ProbingOptions()
    limit = chi2.ppf(0.95, 3)
    n_inside = 0
    for _ in range(600):
        noisy = flat + options.touch_sigma_mm * rng.normal(size=(n, 1)) * [0.0, 0.0, 1.0]
        plate = plate_from_probing(ProbedPoints(points_mm=noisy), options=options)
        assert isinstance(plate, PlateReference)
        assert plate.covariance is not None
        x, y, normal = plate.plane.axes
        tilts = (x[2] / normal[2], y[2] / normal[2])
        error = np.array([*tilts, plate.plane.point_mm[2] / normal[2]])
        n_inside += float(error @ np.linalg.solve(plate.covariance, error)) < limit
    # four sigma of a count; the few degrees of freedom of four touches cost two percent
    assert n_inside / 600 == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / 600) + 0.02)


def test_few_touches_are_warned_of_and_have_the_sigma_of_a_touch() -> None:
    for n, sigma_mm in ((3, 0.01), (3, 0.03), (7, 0.03)):
        plate = fit_probed_plate(tip_points(n=n), options=ProbingOptions(touch_sigma_mm=sigma_mm))
        assert isinstance(plate, ProbedPlate)
        assert plate.reference.covariance is not None
        # exact touches: no squares are added to the four degrees of freedom of the prior
        expected = sigma_mm * np.sqrt(4.0 / (4.0 + n - 3) / n)
        assert np.sqrt(plate.reference.covariance[2, 2]) == pytest.approx(expected)
        assert any(f"{n} touches" in w and f"{sigma_mm:g} mm" in w for w in plate.warnings)
    enough = fit_probed_plate(tip_points(n=8), options=ProbingOptions(side="+z"))
    assert isinstance(enough, ProbedPlate)
    assert enough.warnings == ()
    with pytest.raises(OptionError, match="sigma of 0"):
        ProbingOptions(touch_sigma_mm=0.0)


def test_a_touch_is_named_by_its_row_in_the_table() -> None:
    """Rows of another feature and rows without pose come before the one that slipped."""
    points = touches(14, NOISE_MM, seed=3)
    points[5] += 0.15 * NORMAL
    both = np.concatenate([touches(4, seed=9) + 50.0, points])
    names = ("block",) * 4 + ("plate",) * 14
    rows = tuple(range(3, 21))
    for probed, row in (
        (ProbedPoints(points_mm=both, tip_diameter_mm=TIP_MM, features=names), 10),
        (ProbedPoints(points_mm=both, tip_diameter_mm=TIP_MM, features=names, rows=rows), 12),
    ):
        plate = fit_probed_plate(probed, options=ProbingOptions(feature="plate"))
        assert isinstance(plate, ProbedPlate)
        assert any(f"row {row} (+0.1" in warning for warning in plate.warnings)
        assert plate.rows[plate.outliers[0]] == row


def test_points_on_the_surface_keep_the_tip_that_touched_them() -> None:
    surface = ProbedPoints(
        points_mm=touches(tip_mm=0.0), tip_diameter_mm=TIP_MM, is_compensated=True
    )
    assert not surface.are_tip_centres
    plate = plate_from_probing(surface)
    assert isinstance(plate, PlateReference)
    assert np.abs(plate.plane.distance_mm(surface.points_mm)).max() < 1e-9
    assert plate.tip_diameter_mm == TIP_MM


def test_a_feature_that_no_point_names_is_told_so() -> None:
    with pytest.raises(InputError, match=r"no point names a feature.* called 'plate'"):
        fit_probed_plate(ProbedPoints(np.eye(3)), None, ProbingOptions(feature="plate"))


def test_of_several_features_one_must_be_chosen() -> None:
    both = np.concatenate([touches(8), touches(6) + 50.0])
    probed = ProbedPoints(
        points_mm=both, tip_diameter_mm=TIP_MM, features=("plate",) * 8 + ("block",) * 6
    )
    with pytest.raises(InputError, match="block, plate"):
        plate_from_probing(probed)
    plate = plate_from_probing(probed, options=ProbingOptions(feature="plate"))
    assert isinstance(plate, PlateReference)
    assert plate.n_points == 8
    assert plate.plane.distance_mm(FRAME.translation_mm[None])[0] == pytest.approx(0.0, abs=1e-9)


def test_coefficients_of_any_scale_and_sign() -> None:
    offset = -NORMAL @ FRAME.translation_mm
    for scale in (1.0, -0.37, 2500.0):
        given = scale * np.array([*NORMAL, offset])
        plate = plate_from_coefficients(given, FRAME.translation_mm + 80.0 * NORMAL)
        assert isinstance(plate, PlateReference)
        np.testing.assert_allclose(plate.plane.coefficients, [*NORMAL, offset], atol=1e-9)
        np.testing.assert_allclose(plate.plane.point_mm, FRAME.translation_mm, atol=1e-9)
        assert plate.covariance is None
        assert plate.rms_mm is None
        free = plate_from_coefficients(given)
        assert isinstance(free, PlateReference)
        assert free.plane.normal[2] > 0.0
    for wrong in ([0.0, 0.0, 0.0, 1.0], [np.nan, 0, 0, 1], [1.0, 0.0, 0.0]):
        with pytest.raises(InputError, match="four finite"):
            plate_from_coefficients(np.array(wrong))
