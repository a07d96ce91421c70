# SPDX-License-Identifier: Apache-2.0
"""Planes: exact shapes, outliers that stay counted, references kept apart, bad input."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import Box
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Plane, fit_plane, plane_from_coefficients
from armscan.inspection.features import FeatureInspection, inspect_feature, inspect_points
from armscan.inspection.plane import inspect_plane, with_reference_errors
from armscan.inspection.results import PlaneInspection
from armscan.inspection.search import WantedFeature
from armscan.inspection.selection import InspectionOptions, standings
from armscan.records.cloud import FUSED
from armscan.report.inspection.shapes import plane_report
from rigs.inspection_clouds import cloud_of, random_motion, seen_from

GRID = np.stack(np.meshgrid(np.arange(20.0), np.arange(10.0), [0.0]), axis=-1).reshape(-1, 3)


def inspected(result: PlaneInspection | FitFailure) -> PlaneInspection:
    assert not isinstance(result, FitFailure), result
    return result


def given_plane(a: float, b: float, c: float, d: float) -> Plane:
    return plane_from_coefficients(np.array([a, b, c, d]), np.array([10.0, 5.0, 0.0]))


def test_offset_and_tilt_show_against_the_nominal_plane_only() -> None:
    """Points at z = 0.04 + 0.001 x over the plane z = 0, given with a factor of -2."""
    points = GRID + np.outer(0.04 + 0.001 * GRID[:, 0], [0.0, 0.0, 1.0])
    found = inspected(inspect_plane(cloud_of(points), given_plane(0.0, 0.0, -2.0, 0.0)))
    assert found.nominal is not None
    assert found.offset is not None
    # the reference's normal points down, so points above it are negative
    assert found.offset.value_mm == pytest.approx(-(0.04 + 0.0095))
    assert found.tilt_mrad == pytest.approx(1000.0 * np.arctan(0.001))
    assert found.nominal.value("mean_mm") == pytest.approx(-0.0495)
    assert found.nominal.value("within_50_um_percent") == pytest.approx(55.0)
    assert found.nominal.reference == "nominal"
    assert found.fitted.reference == "fitted"
    assert found.fitted.value("range_mm") == pytest.approx(0.0, abs=1e-12)


def test_outliers_leave_the_fit_but_not_the_statistics() -> None:
    rng = np.random.default_rng(5)
    points = GRID + rng.normal(0.0, 0.005, (200, 1)) * [0.0, 0.0, 1.0]
    outliers = np.arange(0, 200, 10)
    points[outliers, 2] += 0.5
    far = np.array([[5.0, 5.0, 30.0]])
    found = inspected(inspect_plane(cloud_of(np.concatenate([points, far]))))
    assert found.counts.n_given == 201
    assert found.counts.n_feature == 200
    assert found.counts.n_outliers == 20
    assert np.flatnonzero(~found.is_fitted).tolist() == outliers.tolist()
    assert found.fitted.value("within_50_um_percent") == pytest.approx(90.0)
    assert abs(found.plane.normal[2]) == pytest.approx(1.0, abs=1e-6)
    assert len(found.fitted.deviations_mm) == 200


def test_without_normals_the_positive_side_is_that_of_the_largest_axis() -> None:
    points = GRID + np.random.default_rng(3).normal(0.0, 0.01, GRID.shape)
    for axis in range(3):
        turned = np.roll(points, axis + 1, axis=1) @ np.diag([1.0, -1.0, 1.0])
        for order in (slice(None), slice(None, None, -1)):
            found = inspected(inspect_plane(cloud_of(turned[order])))
            assert found.plane.normal[axis] == pytest.approx(1.0, abs=1e-3)
            assert found.side_text == f"on the side of +{'xyz'[axis]}: the cloud has no normals"
    down = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    found = inspected(inspect_plane(cloud_of(points, normals=down)))
    assert found.plane.normal[2] < -0.9
    assert "scanned side" in found.side_text


def test_a_tilted_face_is_said_to_go_on_beyond_the_limit() -> None:
    points = GRID + np.outer(0.2 * GRID[:, 0], [0.0, 0.0, 1.0])
    other = GRID + np.array([0.0, 0.0, 8.0])
    cloud = cloud_of(np.concatenate([points, other]))
    found = inspected(inspect_plane(cloud, given_plane(0.0, 0.0, 1.0, 0.0)))
    assert found.counts.n_feature == 60
    assert found.n_beyond == 140
    assert any("140 points (70 %)" in text for text in plane_report(found, cloud).warnings)
    level = inspected(inspect_plane(cloud_of(np.concatenate([GRID, other])), found.reference))
    assert level.n_beyond == 0


def test_too_few_points_for_a_face_name_no_plane_that_nobody_gave() -> None:
    points = np.random.default_rng(0).uniform(0.0, 500.0, (200, 3))
    found = inspect_plane(cloud_of(points))
    assert isinstance(found, FitFailure)
    assert found.reason.startswith("there is no flat face: at the best place for one, ")
    assert "check the plane" not in found.remedy


def test_moving_points_and_reference_changes_nothing() -> None:
    rng = np.random.default_rng(6)
    points = GRID + rng.normal(0.0, 0.01, GRID.shape)
    still = inspected(inspect_plane(cloud_of(points), given_plane(0.0, 0.0, 1.0, -0.02)))
    for seed in range(3):
        rotation, shift = random_motion(seed)
        moved = points @ rotation.T + shift
        normal = rotation[:, 2]
        reference = plane_from_coefficients(
            np.array([*normal, -0.02 - normal @ shift]), moved.mean(axis=0)
        )
        found = inspected(inspect_plane(cloud_of(moved), reference))
        assert found.nominal is not None
        assert still.nominal is not None
        assert found.offset is not None
        assert still.offset is not None
        for key in ("mean_mm", "std_mm", "d95_mm"):
            assert found.nominal.value(key) == pytest.approx(still.nominal.value(key), abs=1e-9)
            assert found.fitted.value(key) == pytest.approx(still.fitted.value(key), abs=1e-9)
        assert found.offset.value_mm == pytest.approx(still.offset.value_mm, abs=1e-9)
        assert found.tilt_mrad == pytest.approx(still.tilt_mrad, abs=1e-6)


def test_the_sigma_of_an_offset_holds_what_touches_of_the_plate_err() -> None:
    """Touches of 0.05 mm on one end of a face that was scanned at the other, 200 times.

    The scan errs by a hundredth of that. The plate's tilts count over the 40 mm between.
    """
    rng = np.random.default_rng(0)
    touched = np.array([[x, y, 0.0] for x in (0.0, 10.0, 20.0) for y in (0.0, 30.0)])
    up = np.tile([0.0, 0.0, 1.0], (200, 1))
    scanned = GRID + [50.0, 5.0, 0.0] + rng.normal(0.0, 0.001, (200, 1)) * up
    exposure = np.arange(200) // 20
    cloud = cloud_of(scanned, exposure, sigma_mm=1e-4, noise_mm=0.001, noise_along=up)
    offsets, sigmas = [], []
    for _ in range(200):
        probed = fit_plane(touched + rng.normal(0.0, 0.05, (6, 1)) * [0.0, 0.0, 1.0])
        assert not isinstance(probed, FitFailure)
        bare = inspected(inspect_plane(cloud, probed.value))
        found = with_reference_errors(bare, probed.covariance)
        assert bare.offset is not None
        assert found.offset is not None
        assert bare.offset.sigma_mm < 0.001
        assert np.isnan(bare.reference_sigma_mm)
        offsets.append(found.offset.value_mm)
        sigmas.append(found.offset.sigma_mm)
        assert found.offset.sigma_mm == pytest.approx(
            np.hypot(bare.offset.sigma_mm, found.reference_sigma_mm)
        )
    # rms of 200 draws, 5 % by chance; each sigma rests on three degrees of freedom
    rms = np.sqrt(np.mean(np.square(offsets)))
    assert np.sqrt(np.mean(np.square(sigmas))) == pytest.approx(rms, rel=0.2)


def test_the_page_says_whether_the_plate_counts() -> None:
    cloud = cloud_of(GRID)
    reference = given_plane(0.0, 0.0, 1.0, -0.02)
    touches = np.diag([0.0, 0.0, 0.03**2])
    texts = {"exact": np.zeros((3, 3)), "probed": touches, "unknown": None}
    shown = {}
    for name, covariance in texts.items():
        found = inspected(inspect_plane(cloud, reference, reference_covariance=covariance))
        told = {one.key: one for one in plane_report(found, cloud).quantities}
        shown[name] = told["nominal.offset"].meaning
    assert "plate" not in shown["exact"]
    assert "± holds 0.030 mm of the plate itself" in shown["probed"]
    assert "without the plate's own uncertainty" in shown["unknown"]


def test_the_largest_of_several_faces_is_found_without_a_reference() -> None:
    wall = np.stack([np.zeros(80), np.tile(np.arange(10.0), 8), np.repeat(np.arange(8.0), 10)], 1)
    small = GRID[:90] + np.array([0.0, 0.0, 8.0])
    found = inspected(inspect_plane(cloud_of(np.concatenate([wall, small, GRID]))))
    assert np.abs(found.plane.coefficients) == pytest.approx([0, 0, 1, 0], abs=1e-9)
    # of the wall, the two rows at z = 0 and 1 lie within 1 mm as well
    assert found.counts.n_feature == len(GRID) + 20


def test_one_stripe_shows_its_light_sheet_and_no_face() -> None:
    """Whatever it crosses, its points lie in a plane: flat to 0.000 mm, and not the part's.

    On a flat face the fitted plane turns about it as noise will: by 89 degrees in this case.
    """
    rng = np.random.default_rng(0)
    x = np.linspace(-30.0, 30.0, 600)
    for z in (np.where(x > 0.0, 5.0, 0.0), rng.normal(0.0, 0.005, 600)):
        stripe = np.column_stack([x, 0.2 * x + rng.normal(0.0, 0.002, 600), z])
        for n_stray in (0, 1, 20):
            exposure = (np.arange(600) < n_stray).astype(np.int64)
            stripe[:n_stray, 1] += 10.0
            cloud = cloud_of(stripe, exposure)
            for reference in (None, given_plane(0.0, 0.0, 1.0, 0.0)):
                refused = inspect_plane(cloud, reference)
                assert isinstance(refused, FitFailure)
                assert "all but a few lie in one light sheet" in refused.reason


def test_one_stripe_on_the_face_is_no_face_though_others_lie_on_a_block_above() -> None:
    """The sheet of the one stripe was taken for the face: 88 degrees off it."""
    rng = np.random.default_rng(1)
    exposure = np.repeat(np.arange(20), 200)
    x = np.tile(np.linspace(0.0, 60.0, 200), 20)
    points = np.column_stack([x, 5.0 + exposure, np.where(exposure > 0, 20.0, 0.0)])
    points += rng.normal(0.0, [0.0, 0.002, 0.01], points.shape)
    cloud, plate = cloud_of(points, exposure), given_plane(0.0, 0.0, 1.0, 0.0)
    refused = inspect_plane(cloud, plate)
    assert isinstance(refused, FitFailure)
    assert "of 200 points all but a few lie in one light sheet" in refused.reason
    seed = WantedFeature("plane", seed_mm=(30.0, 5.0, 0.0))
    for found in (
        inspect_feature(cloud, seed),
        inspect_points(cloud.select(np.flatnonzero(exposure == 0)), WantedFeature("plane"), ""),
    ):
        assert isinstance(found, FitFailure)
        assert "lie in one light sheet" in found.reason
    # a cloud that tells no sheets counts all points
    assert isinstance(inspect_plane(cloud_of(points), plate), PlaneInspection)
    above = WantedFeature("plane", seed_mm=(30.0, 15.0, 20.0))
    assert isinstance(inspect_feature(cloud, above), FeatureInspection)


@pytest.mark.parametrize(("n_stripes", "n_points"), [(2, 28), (3, 14), (4, 9)])
def test_a_small_face_that_several_stripes_cross_is_measured(n_stripes: int, n_points: int) -> None:
    """Fewer than 30 points lie beside the largest stripe; what strays are depends on the count."""
    exposure = np.repeat(np.arange(n_stripes), n_points)
    x = np.tile(0.1 * np.arange(n_points), n_stripes)
    z = np.random.default_rng(0).normal(0.0, 0.005, len(x))
    points = np.column_stack([x, exposure.astype(np.float64), z])
    seen = inspected(inspect_plane(cloud_of(points, exposure)))
    assert abs(seen.plane.normal[2]) > np.cos(np.radians(2.0))
    found = inspect_feature(cloud_of(points, exposure), WantedFeature("plane"))
    assert isinstance(found, FeatureInspection)
    # as many points, all but five in one stripe
    strays = (np.arange(len(x)) < 5).astype(np.int64)
    points[:, :2] = np.column_stack([0.1 * np.arange(len(x)), strays])
    refused = inspect_plane(cloud_of(points, strays))
    assert isinstance(refused, FitFailure)
    assert "lie in one light sheet" in refused.reason


def test_exposures_from_one_place_share_their_light_sheet() -> None:
    x = np.tile(np.linspace(-30.0, 30.0, 300), 3)
    z = np.random.default_rng(0).normal(0.0, 0.005, 900)
    stripes = np.column_stack([x, 0.2 * x, z])
    refused = inspect_plane(cloud_of(stripes, np.repeat([0, 1, 2], 300), frame="Sensor"))
    assert isinstance(refused, FitFailure)
    assert "lie in one light sheet" in refused.reason


@pytest.mark.parametrize(
    ("step_mm", "turn_mrad", "n_places"),
    [
        (0.0, 0.0, 1),
        (0.03, 0.0, 1),
        (0.2, 0.0, 5),
        (0.6, 0.0, 10),
        (0.0, 0.3, 1),
        (0.0, 4.5, 10),
    ],
)
def test_exposures_at_rest_have_one_place(step_mm: float, turn_mrad: float, n_places: int) -> None:
    """Ten exposures at 100 mm: a place is left where a point there has moved by 0.3 mm."""
    k = np.arange(10)
    points = np.array([[0.0, y, 0.0] for y in (-1.0, 1.0)] * 10)
    for axis in np.eye(3):
        turns = Rotation.from_rotvec(1e-3 * turn_mrad * k[:, None] * axis).as_matrix()
        places = np.array([0.0, 0.0, 100.0]) + step_mm * k[:, None] * axis
        cloud = seen_from(cloud_of(points, np.repeat(k, 2)), places, turns)
        found = standings(cloud)
        assert (found[0], found[-1]) == (0, n_places - 1)
        assert set(np.diff(found)) <= {0, 1}
    assert standings(cloud_of(points, np.repeat(k, 2))).tolist() == k.tolist()


def test_a_cloud_that_tells_no_stripes_counts_all_points() -> None:
    """Fused points stand for many stripes, though all bear one number."""
    one = cloud_of(GRID, np.zeros(len(GRID), dtype=np.int64))
    assert isinstance(inspect_plane(one), FitFailure)
    fused = replace(one, sheet_names=(FUSED,), exposure_sources=(FUSED,))
    assert inspected(inspect_plane(fused)).plane.normal[2] == pytest.approx(1.0)


def test_a_region_leaves_the_rest_out() -> None:
    other = GRID[:150] + np.array([0.0, 0.0, 8.0])
    cloud = cloud_of(np.concatenate([GRID, other]))
    region = Box(np.array([-1.0, -1.0, 7.0]), np.array([30.0, 30.0, 9.0]))
    found = inspected(inspect_plane(cloud, region=region))
    assert found.counts.n_region == 150
    assert found.rows.min() == 200
    with pytest.raises(OptionError, match="xmin 1 is not below xmax 0"):
        Box(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 1.0]))


def test_the_fitted_normal_points_to_the_scanned_side() -> None:
    for sign in (1.0, -1.0):
        normals = np.tile([0.0, 0.0, sign], (len(GRID), 1))
        found = inspected(inspect_plane(cloud_of(GRID, normals=normals)))
        assert found.plane.normal[2] == pytest.approx(sign)


def test_a_curved_surface_is_no_flat_face_but_may_be_compared_with_a_plane() -> None:
    points = GRID + np.outer(0.02 * (GRID[:, 0] - 9.5) ** 2, [0.0, 0.0, 1.0])
    failure = inspect_plane(cloud_of(points))
    assert isinstance(failure, FitFailure)
    assert "there is no flat face" in failure.reason
    found = inspected(inspect_plane(cloud_of(points), given_plane(0.0, 0.0, 1.0, 0.0)))
    assert found.nominal is not None


@pytest.mark.parametrize("sigma_mm", [0.5, 0.6, 2.0])
def test_a_face_that_scatters_as_its_sigma_says_is_one(sigma_mm: float) -> None:
    """What the refusal advises does it; without a sigma the points may be of anything."""
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(0.0, 200.0, (2000, 2)), rng.normal(0.0, sigma_mm, 2000)])
    cloud = cloud_of(points, np.arange(2000) // 50, sigma_mm=sigma_mm)
    failure = inspect_plane(cloud)
    assert isinstance(failure, FitFailure)
    advice = re.search(r"give --feature-mm (\S+),", failure.remedy)
    assert advice is not None
    wide = InspectionOptions(feature_mm=float(advice[1]))
    assert wide.feature_mm == pytest.approx(4.0 * sigma_mm, rel=0.1)
    found = inspected(inspect_plane(cloud, options=wide))
    assert found.fitted.value("std_mm") == pytest.approx(sigma_mm, rel=0.05)
    assert isinstance(inspect_plane(cloud_of(points, sigma_mm=0.0), options=wide), FitFailure)


def test_a_stray_kilometres_away_costs_no_memory() -> None:
    points = np.concatenate([GRID, [[1.0, 2.0, 1e12]]])
    assert inspected(inspect_plane(cloud_of(points))).counts.n_feature == len(GRID)


def test_input_without_a_plane_is_refused_in_words() -> None:
    with pytest.raises(InputError, match="the cloud holds 0 points; an inspection needs 30"):
        inspect_plane(cloud_of(np.zeros((0, 3))))
    with pytest.raises(InputError, match="all 60 points lie in one place"):
        inspect_plane(cloud_of(np.full((60, 3), 7.0)))
    line = np.outer(np.arange(50.0), [1.0, 2.0, 3.0])
    failure = inspect_plane(cloud_of(line))
    assert isinstance(failure, FitFailure)
    assert "on one line" in failure.reason
    failure = inspect_plane(cloud_of(GRID), given_plane(0.0, 0.0, 1.0, -500.0))
    assert isinstance(failure, FitFailure)
    assert "0 of 200 points lie within 1 mm" in failure.reason
    assert "the nearest is 500 mm away" in failure.reason
    with pytest.raises(InputError, match="four finite"):
        given_plane(0.0, 0.0, 0.0, 1.0)
    with pytest.raises(OptionError, match="search band"):
        InspectionOptions(feature_mm=0.1)
