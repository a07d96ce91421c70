# SPDX-License-Identifier: Apache-2.0
"""Steps: through the arm and from one still exposure, whose lean no exposure can tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import StepInspection
from armscan.inspection.selection import StepOptions
from armscan.inspection.step import inspect_step
from armscan.report.inspection.shapes import step_report
from rigs.inspection_clouds import (
    RADIUS_MM,
    ball_stripes,
    block_stripes,
    cloud_of,
    random_motion,
    seen_from,
)

HEIGHT_MM = 20.0


def inspected(result: StepInspection | FitFailure) -> StepInspection:
    assert not isinstance(result, FitFailure), result
    return result


def profile(lean_rad: float, noise_mm: float = 0.0, seed: int = 1) -> FloatArray:
    """Stripe of a sheet leaning by an angle over a 20 mm step at x = 5, in the Sensor frame.

    The faces' normal is (0, sin, -cos) of the lean; the sheet is the plane y = 0.
    """
    x = np.linspace(-30.0, 30.0, 901)
    on_block = x > 5.0
    drop = np.where(on_block, 0.0, HEIGHT_MM / np.cos(lean_rad))
    z = 130.0 + drop + np.random.default_rng(seed).normal(0.0, noise_mm, len(x))
    return np.column_stack([x, np.zeros_like(x), z])[~((x > 2.0) & (x < 5.0))]


def test_an_exact_block_through_the_arm() -> None:
    points, exposure = block_stripes(HEIGHT_MM + 0.011)
    for seed in range(3):
        rotation, shift = random_motion(seed)
        normals = np.tile(rotation[:, 2], (len(points), 1))
        cloud = cloud_of(points @ rotation.T + shift, exposure, normals=normals)
        found = inspected(inspect_step(cloud, HEIGHT_MM))
        assert found.height.value_mm == pytest.approx(HEIGHT_MM + 0.011, abs=1e-9)
        assert found.normal == pytest.approx(rotation[:, 2], abs=1e-9)
        assert found.nominal.value("mean_mm") == pytest.approx(0.011, abs=1e-9)
        assert found.fitted.value("std_mm") == pytest.approx(0.0, abs=1e-9)
        assert set(exposure[found.upper]) <= set(range(11, 30))


def test_margins_keep_away_from_edges_corners_and_what_stands_about() -> None:
    points, exposure = block_stripes(HEIGHT_MM)
    found = inspected(
        inspect_step(cloud_of(points, exposure), HEIGHT_MM, step_options=StepOptions(margin_mm=2.0))
    )
    x, y = points[found.upper, 0], points[found.upper, 1]
    # the block's first and last point along each stripe lie up to 0.24 mm inside its edges
    assert x.min() >= 7.0
    assert x.max() <= 23.0
    # its outline are its outermost stripes, at y = 11 and 29
    assert (y.min(), y.max()) == (13.0, 27.0)
    low = points[found.lower]
    beside = (low[:, 1] > 10) & (low[:, 1] < 30)
    assert low[beside & (low[:, 0] < 15), 0].max() <= 3.1
    assert low[beside & (low[:, 0] > 15), 0].min() >= 30.0


def test_a_stripe_along_an_edge_is_half_on_the_face_only_and_takes_no_part() -> None:
    points, exposure = block_stripes(HEIGHT_MM)
    along_edge = (points[:, 1] == 11.0) & (points[:, 2] > 10.0)
    assert along_edge.sum() > 50
    pulled = points.copy()
    pulled[along_edge, 2] -= np.linspace(0.0, 0.18, int(along_edge.sum()))
    found = inspected(inspect_step(cloud_of(pulled, exposure), HEIGHT_MM))
    assert float(np.ptp(found.heights_mm)) < 1e-6


def test_exposures_at_rest_show_their_step_as_one_of_them_does() -> None:
    """Twenty stills of one line: all points lie in its sheet, of which no pair of faces is told."""
    profiles = [profile(0.0, 0.01, seed) for seed in range(20)]
    points = np.concatenate(profiles)
    exposure = np.repeat(np.arange(20), len(profiles[0]))
    tremble_mm = np.random.default_rng(0).normal(0.0, 0.01, (20, 3))
    turns = np.tile(np.eye(3), (20, 1, 1))
    placed = seen_from(cloud_of(points + tremble_mm[exposure], exposure), tremble_mm, turns)
    for cloud in (cloud_of(points, exposure, frame="Sensor"), placed):
        found = inspected(inspect_step(cloud, HEIGHT_MM))
        assert "taken to stand square" in found.normal_rule
        assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=4 * 0.01 / np.sqrt(20 * 250))


def test_a_light_sheet_that_holds_most_points_is_no_face() -> None:
    """A still of two crossed lines over a block: A's points lie in its sheet, more than in a face.

    On the block A has 300 points and B 250, on the floor 500 and 250: 800 lie in A's sheet, 750 on
    the floor.
    """
    rng = np.random.default_rng(3)
    parts = []
    for turn, n_block, n_floor in ((0.7, 300, 500), (-0.7, 250, 250)):
        along = np.concatenate([rng.uniform(-10, 10, n_block), rng.uniform(12, 30, n_floor)])
        along[n_block::2] *= -1.0
        z = np.where(np.arange(len(along)) < n_block, 0.0, HEIGHT_MM)
        # each sheet leans: its stripe lies farther out on the floor
        across = 0.3 * z
        c, s = np.cos(turn), np.sin(turn)
        parts.append(np.column_stack([c * along - s * across, s * along + c * across, z + 130.0]))
    points = np.concatenate(parts) + rng.normal(0.0, 0.01, (1300, 3))
    sheet = np.repeat([0, 1], [800, 500])
    cloud = cloud_of(points, np.zeros(1300, dtype=np.int64), frame="Sensor")
    cloud = replace(cloud, sheet=sheet, sheet_names=("A", "B"))
    found = inspected(inspect_step(cloud, HEIGHT_MM))
    assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=0.003)
    assert found.normal == pytest.approx([0.0, 0.0, -1.0], abs=1e-3)
    plane = inspect_plane(cloud)
    assert not isinstance(plane, FitFailure)
    assert abs(plane.plane.normal[2]) > 0.999


def test_two_groups_far_apart_leave_the_step_of_one_or_none() -> None:
    """With as many points in both, the median would lie between them, where there is none."""
    points, exposure = block_stripes(HEIGHT_MM)
    far = np.concatenate([points, points + np.array([0.0, 0.0, 2e5])])
    found = inspect_step(cloud_of(far, np.concatenate([exposure, exposure])), HEIGHT_MM)
    if isinstance(found, FitFailure):
        assert "points after 1 mm at its ends are left out" in found.reason
    else:
        assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=1e-6)


@pytest.mark.parametrize("n_stray", [1, 5, 20])
def test_strays_of_another_stripe_make_no_face_of_a_light_sheet(n_stray: int) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stripe = profile(0.0, 0.005, seed)
        strays = rng.uniform([-30.0, -20.0, 120.0], [30.0, 20.0, 160.0], (n_stray, 3))
        cloud = cloud_of(np.vstack([stripe, strays]), np.zeros(len(stripe) + n_stray, np.int64))
        sheet = (np.arange(len(cloud)) >= len(stripe)).astype(np.int64)
        cloud = replace(cloud, sheet=sheet, sheet_names=("A", "B"), frame="Sensor")
        refused = inspect_step(cloud, HEIGHT_MM)
        assert isinstance(refused, FitFailure)
        assert "points of several stripes" in refused.reason


def test_one_exposure_is_as_high_as_its_lean_lets_it_be() -> None:
    """Without a normal the sheet counts as square: at 5 degrees 20 mm reads 20 / cos 5."""
    lean = np.deg2rad(5.0)
    cloud = cloud_of(profile(lean), frame="Sensor")
    square = inspected(inspect_step(cloud, HEIGHT_MM))
    assert square.height.value_mm == pytest.approx(HEIGHT_MM / np.cos(lean), abs=1e-9)
    assert "taken to stand square" in square.normal_rule
    true = np.array([0.0, np.sin(lean), -np.cos(lean)])
    for normal in (true, -3.0 * true):
        told = inspected(inspect_step(cloud, HEIGHT_MM, normal=normal))
        assert told.height.value_mm == pytest.approx(HEIGHT_MM, abs=1e-9)
        assert told.normal == pytest.approx(true, abs=1e-9)
        assert "leans by 5.000 degrees" in told.normal_rule


@pytest.mark.parametrize("n_exposures", [1, 3, 20])
def test_how_a_sheet_leans_is_in_no_sigma_until_somebody_says_it(n_exposures: int) -> None:
    """At 10 degrees 20 mm reads 20.31, and exposures of that one sheet agree on it to a micron."""
    lean = np.deg2rad(10.0)
    profiles = [profile(lean, 0.01, seed) for seed in range(n_exposures)]
    points = np.concatenate(profiles)
    exposure = np.repeat(np.arange(n_exposures), len(profiles[0]))
    turns = np.tile(np.eye(3), (n_exposures, 1, 1))
    still = seen_from(cloud_of(points, exposure), np.zeros((n_exposures, 3)), turns)
    for cloud in (cloud_of(points, exposure, frame="Sensor"), still):
        square = inspected(inspect_step(cloud, HEIGHT_MM))
        assert square.height.value_mm == pytest.approx(HEIGHT_MM / np.cos(lean), abs=0.005)
        assert np.isnan(square.height.sigma_mm)
        report = step_report(square, cloud)
        assert any("is taken to stand square on the faces" in text for text in report.warnings)
        told = {one.key: one for one in report.quantities if one.key}
        assert "±" not in told["fitted.height"].shown
        assert np.isnan(told["fitted.height_u_mm"].value)
        normal = np.array([0.0, np.sin(lean), -np.cos(lean)])
        known = inspected(inspect_step(cloud, HEIGHT_MM, normal=normal))
        assert not any("stand square" in text for text in step_report(known, cloud).warnings)
        if n_exposures > 1:
            # 10 um a point, 400 and more on each face of each exposure
            assert known.height.sigma_mm < 0.005
            assert abs(known.height.value_mm - HEIGHT_MM) < 4.0 * known.height.sigma_mm


def test_a_bowed_sheet_that_leans_does_not_bend_the_faces() -> None:
    """Points lie on the faces AND on the bowed sheet: its bow must not tilt the fitted lines."""
    lean = np.deg2rad(20.0)
    points = profile(lean)
    bow = 0.05 * (points[:, 0] / 30.0) ** 2 + 0.02 * (points[:, 0] / 30.0) ** 3
    # along the faces, square to the stripe: a point leaves the plane y = 0 but not its face
    points += np.outer(bow, [0.0, np.cos(lean), np.sin(lean)])
    normal = np.array([0.0, np.sin(lean), -np.cos(lean)])
    found = inspected(inspect_step(cloud_of(points, frame="Sensor"), HEIGHT_MM, normal=normal))
    assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=5e-4)
    assert found.fitted.value("std_mm") < 5e-4


def test_an_error_of_the_given_normal_along_the_stripe_does_no_harm() -> None:
    """Only the lean is taken from it: 0.5 degrees about the sheet's normal change nothing."""
    turn = np.deg2rad(0.5)
    normal = np.array([np.sin(turn), 0.0, -np.cos(turn)])
    found = inspected(
        inspect_step(cloud_of(profile(0.0), frame="Sensor"), HEIGHT_MM, normal=normal)
    )
    assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=1e-9)


def test_outliers_leave_the_fit_but_not_the_heights() -> None:
    points = profile(0.0, 0.004)
    found = inspected(inspect_step(cloud_of(points, frame="Sensor"), HEIGHT_MM))
    points[700:710, 2] -= 0.4
    hit = inspected(inspect_step(cloud_of(points, frame="Sensor"), HEIGHT_MM))
    assert hit.counts.n_outliers >= 10
    assert hit.height.value_mm == pytest.approx(found.height.value_mm, abs=2e-4)
    assert len(hit.heights_mm) == len(found.heights_mm)
    assert hit.heights_mm.max() > HEIGHT_MM + 0.38


def test_points_of_another_program_have_no_stripes_and_work_all_the_same() -> None:
    points, _ = block_stripes(HEIGHT_MM)
    found = inspected(inspect_step(cloud_of(points), HEIGHT_MM))
    assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=1e-9)


def test_a_stray_far_away_hides_no_face() -> None:
    points, exposure = block_stripes(HEIGHT_MM)
    points[0, 2] = 1e6
    found = inspected(inspect_step(cloud_of(points, exposure), HEIGHT_MM))
    assert found.height.value_mm == pytest.approx(HEIGHT_MM, abs=1e-9)


@pytest.mark.parametrize("height_mm", [1.0, 2.0, 3.0, 5.0, 10.0])
def test_a_ball_has_no_faces_whatever_the_margin(height_mm: float) -> None:
    """It was measured as a step, or a smaller margin was asked for. Low ones are caps, bent."""
    for seed in range(5):
        rotation, shift = random_motion(seed)
        rng = np.random.default_rng(seed)
        outward = ball_stripes(120, 120)
        points = outward * (RADIUS_MM + rng.normal(0.0, 0.01, (len(outward), 1)))
        for exposure in (None, np.arange(len(points)) // 120):
            ball = cloud_of(points @ rotation.T + shift, exposure)
            nothing = inspect_step(ball, height_mm)
            if not isinstance(nothing, FitFailure):
                assert height_mm in (2.0, 3.0)
                shown = step_report(nothing, ball).warnings
                assert any("two faces are not flat" in text for text in shown)
                continue
            assert "no two parallel faces" in nothing.reason
            assert "--margin" not in nothing.remedy


@pytest.mark.parametrize("height_mm", [1.0, 2.0, 20.0])
@pytest.mark.parametrize("noise_mm", [0.005, 0.03, 0.1])
def test_faces_that_scatter_are_faces(height_mm: float, noise_mm: float) -> None:
    """A step of 1 mm cannot be told in noise of 0.1 mm that nobody states."""
    points, exposure = block_stripes(height_mm)
    noise = np.random.default_rng(3).normal(0.0, noise_mm, points.shape)
    cloud = cloud_of(points + noise, exposure)
    found = inspect_step(cloud, height_mm)
    if height_mm > 10.0 * noise_mm:
        assert inspected(found).height.value_mm == pytest.approx(height_mm, abs=noise_mm)
        shown = step_report(inspected(found), cloud).warnings
        assert not any("not flat" in text for text in shown)


def test_input_without_the_step_is_refused_in_words() -> None:
    points, exposure = block_stripes(HEIGHT_MM)
    wrong = inspect_step(cloud_of(points, exposure), 10.0)
    assert isinstance(wrong, FitFailure)
    assert "no two parallel faces 10 mm apart, to 0.5 mm" in wrong.reason
    assert "stand 20.000 mm apart" in wrong.reason
    flat = inspect_step(cloud_of(points[points[:, 2] == 0.0]), HEIGHT_MM)
    assert isinstance(flat, FitFailure)
    line = np.outer(np.arange(80.0), [1.0, 2.0, 3.0])
    assert isinstance(inspect_step(cloud_of(line), HEIGHT_MM), FitFailure)
    wide = StepOptions(margin_mm=12.0)
    failure = inspect_step(cloud_of(points, exposure), HEIGHT_MM, step_options=wide)
    assert isinstance(failure, FitFailure)
    assert "--margin" in failure.remedy
    with pytest.raises(InputError, match="the cloud holds 0 points"):
        inspect_step(cloud_of(np.zeros((0, 3))), HEIGHT_MM)
    with pytest.raises(InputError, match="-3"):
        inspect_step(cloud_of(points), -3.0)
    with pytest.raises(InputError, match="normal of the step's faces is zero"):
        inspect_step(cloud_of(profile(0.0)), HEIGHT_MM, normal=np.zeros(3))
    with pytest.raises(OptionError, match="margin_mm is -1"):
        StepOptions(margin_mm=-1.0)


@pytest.mark.parametrize("slope", [0.2, 0.4, 0.6, 1.2])
@pytest.mark.parametrize("height_mm", [1.0, 2.0, 3.0, 4.0, 5.0, 8.0])
def test_a_ramp_beside_a_floor_is_no_step(height_mm: float, slope: float) -> None:
    """Both levels settled on the floor: a height of 0.0000 mm was told. Or the margin cut a strip
    of the ramp down to its middle, which was taken for the upper face.
    """
    for noise_mm in (0.0, 0.02, 0.05):
        rng = np.random.default_rng(2)
        x, y = rng.uniform(-20.0, 20.0, (2, 8000))
        z = np.where(x > 0.0, slope * x, 0.0) + rng.normal(0.0, noise_mm, 8000)
        failure = inspect_step(cloud_of(np.column_stack([x, y, z])), height_mm)
        assert isinstance(failure, FitFailure)
        assert "no two parallel faces" in failure.reason


@pytest.mark.parametrize("height_mm", [2.0, 3.0, 8.0])
def test_a_step_beside_a_ramp_is_a_step(height_mm: float) -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-20.0, 20.0, (2, 8000))
    rise = np.where(y > 0.0, height_mm, 0.6 * x)
    z = np.where(x > 0.0, rise, 0.0) + rng.normal(0.0, 0.02, 8000)
    found = inspected(inspect_step(cloud_of(np.column_stack([x, y, z])), height_mm))
    assert found.height.value_mm == pytest.approx(height_mm, abs=0.01)


@pytest.mark.parametrize("height_mm", [0.3, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("told", [True, False])
def test_a_low_step_is_measured(height_mm: float, told: bool) -> None:
    """A band of 0.2 mm held both faces, or a plane across them; or both were one light sheet's."""
    rng = np.random.default_rng(5)
    for noise_mm in (0.0, height_mm / 20.0):
        x, y = rng.uniform(-20.0, 20.0, (2, 6000))
        z = np.where(x > 0.0, height_mm, 0.0) + rng.normal(0.0, noise_mm, 6000)
        exposure = np.floor(1.5 * (y + 20.0)).astype(np.int64) if told else None
        found = inspected(inspect_step(cloud_of(np.column_stack([x, y, z]), exposure), height_mm))
        # some 2,500 points on either face
        assert found.height.value_mm == pytest.approx(height_mm, abs=5 * noise_mm / 35 + 1e-9)


@pytest.mark.parametrize("height_mm", [0.3, 0.5, 1.0])
def test_neither_a_flat_face_nor_a_slope_is_a_low_step(height_mm: float) -> None:
    rng = np.random.default_rng(5)
    for slope, noise_mm in ((0.0, 0.01), (0.0, 0.1), (0.1, 0.02), (0.3, 0.02)):
        x, y = rng.uniform(-20.0, 20.0, (2, 6000))
        z = np.maximum(slope * x, 0.0) + rng.normal(0.0, noise_mm, 6000)
        assert isinstance(inspect_step(cloud_of(np.column_stack([x, y, z])), height_mm), FitFailure)


def test_a_low_step_in_one_foreign_profile_stays_one_light_sheets() -> None:
    points = profile(0.0, 0.005)
    points[:, 2] = 130.0 + (points[:, 2] - 130.0) / 25.0
    found = inspected(inspect_step(cloud_of(points), 0.8))
    assert "taken to stand square" in found.normal_rule
    assert found.height.value_mm == pytest.approx(0.8, abs=0.002)


@pytest.mark.parametrize("spacing_mm", [1.1, 2.0, 5.0])
def test_stripes_whose_points_lie_further_apart_than_the_margin_have_faces(
    spacing_mm: float,
) -> None:
    """Each point was a run of its own, and a smaller margin was advised, which made no run longer.

    The points next to the edge and the ends are left out all the same.
    """
    x, y = np.meshgrid(np.arange(-40.0, 40.0, spacing_mm), np.arange(-40.0, 40.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.where(x.ravel() > 0.0, 5.0, 0.0)])
    found = inspected(inspect_step(cloud_of(points, np.repeat(np.arange(80), x.shape[1])), 5.0))
    assert found.height.value_mm == pytest.approx(5.0, abs=1e-9)
    assert points[found.lower, 0].min() >= -39.0
    assert points[found.upper, 0].min() >= x[0][x[0] > 0.0].min() + 1.0


def test_a_face_of_few_points_is_not_told_to_have_a_smaller_margin() -> None:
    points, exposure = block_stripes(HEIGHT_MM)
    rows = np.flatnonzero(points[:, 2] > 10.0)[25:]
    few = np.setdiff1d(np.arange(len(points)), rows)
    failure = inspect_step(cloud_of(points[few], exposure[few]), HEIGHT_MM)
    assert isinstance(failure, FitFailure)
    assert "--margin" not in failure.remedy


def test_faces_of_a_noisy_step_are_not_doubted() -> None:
    """Where no neighbourhood is flat for noise, what neighbours scatter by is not known."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-5.0, 5.0, (2, 20_000))
    z = np.where(x > 0.0, HEIGHT_MM, 0.0) + rng.normal(0.0, 0.1, 20_000)
    cloud = cloud_of(np.column_stack([x, y, z]), sigma_mm=0.0)
    found = inspected(inspect_step(cloud, HEIGHT_MM))
    assert not any("not flat" in text for text in step_report(found, cloud).warnings)


@pytest.mark.parametrize("seed", range(4))
def test_strays_in_the_sheet_of_one_foreign_profile_make_it_no_area(seed: int) -> None:
    """Three in a hundred points of a line made each part of it as high as an area is."""
    rng = np.random.default_rng(seed)
    x = np.linspace(-30.0, 30.0, 900)
    z = np.where(x > 5.0, 5.0, 0.0) + rng.normal(0.0, 0.01, 900)
    strays = np.arange(600, 900, 11)
    z[strays] = rng.uniform(-30.0, 30.0, len(strays))
    strays = np.arange(15, 300, 11)
    z[strays] = rng.uniform(-30.0, 30.0, len(strays))
    found = inspected(inspect_step(cloud_of(np.column_stack([x, 0.0 * x, z])), 5.0))
    assert "taken to stand square" in found.normal_rule
    assert found.height.value_mm == pytest.approx(5.0, abs=0.005)
