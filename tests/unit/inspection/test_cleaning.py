# SPDX-License-Identifier: Apache-2.0
"""Each filter takes the points that were planted for it, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import Box, IntArray
from armscan.geometry.poses import Pose
from armscan.inspection.cleaning import Cleaning, CleaningOptions, clean_cloud
from armscan.pipeline.register import carry_cloud
from armscan.records.cloud import PointCloud
from rigs.inspection_clouds import RADIUS_MM, ball_stripes, cloud_of, random_motion

SPACING_MM, N_STRIPES, N_POINTS = 0.1, 20, 300


def plate(spacing_mm: float = 0.5) -> PointCloud:
    """Stripes along x, 0.1 mm from point to point, side by side along y."""
    x = np.tile(np.arange(N_POINTS) * SPACING_MM, N_STRIPES)
    exposure = np.repeat(np.arange(N_STRIPES), N_POINTS)
    return cloud_of(np.stack([x, exposure * spacing_mm, 0.0 * x], axis=1), exposure)


def taken(found: Cleaning) -> IntArray:
    return np.flatnonzero(found.taken_by >= 0)


def test_isolated_points() -> None:
    cloud = plate()
    lone = np.array([[5.0, 3.0, 2.0], [5.1, 3.0, 2.0], [-9.0, 0.0, 0.0]])
    whole = replace(
        cloud_of(np.concatenate([cloud.points_mm, lone]), np.append(cloud.exposure, [1, 1, 2]))
    )
    found = clean_cloud(whole, CleaningOptions(isolated_mm=0.6))
    assert taken(found).tolist() == [6000, 6001, 6002]
    assert len(found.cloud) == 6000
    assert found.steps[0].n_taken == 3


def test_points_off_their_line() -> None:
    """On a bent stripe too: its sagitta over five points is far below the limit."""
    cloud = plate()
    points = cloud.points_mm.copy()
    points[:, 2] = 5.0 * np.sin(points[:, 0] / 10.0)
    spikes = np.array([1050, 2077, 4203])
    points[spikes, 2] += 0.3
    found = clean_cloud(replace(cloud, points_mm=points), CleaningOptions(line_deviation_mm=0.15))
    assert taken(found).tolist() == spikes.tolist()


def test_ends_of_pieces() -> None:
    """0.25 mm at each end are points 0, 0.1 and 0.2 mm from it; a hole of 2 mm makes two more."""
    cloud = plate()
    options = CleaningOptions(edge_mm=0.25)
    assert len(taken(clean_cloud(cloud, options))) == N_STRIPES * 6
    x = cloud.points_mm[:, 0]
    holed = cloud.select((x < 9.95) | (x > 11.95))
    assert len(taken(clean_cloud(holed, options))) == N_STRIPES * 12
    wide = CleaningOptions(edge_mm=0.25, hole_mm=3.0)
    assert len(taken(clean_cloud(holed, wide))) == N_STRIPES * 6


def test_dust_along_a_stripe() -> None:
    cloud = plate()
    kept = np.ones(len(cloud), dtype=np.bool_)
    kept[100:106] = kept[107:113] = False
    sparse = cloud.select(kept)
    assert taken(clean_cloud(sparse, CleaningOptions(line_spacing_mm=0.5))).tolist() == [100]


def test_stripes_too_near() -> None:
    """0.1 mm apart and 0.5 wanted (0.45 for rounding): every fifth stays."""
    found = clean_cloud(plate(0.1), CleaningOptions(line_to_line_mm=0.45))
    assert np.unique(found.cloud.exposure).tolist() == [0, 5, 10, 15]


def test_of_overlapping_passes_the_better_stays() -> None:
    """The second pass, 0.1 mm higher, saw half of the plate again and something more."""
    first = plate()
    again = first.points_mm + np.array([15.0, 0.0, 0.1])
    points = np.concatenate([first.points_mm, again])
    exposure = np.concatenate([first.exposure, first.exposure + 100])
    for better, n_first in ((0, N_STRIPES * N_POINTS), (1, N_STRIPES * N_POINTS // 2)):
        cloud = cloud_of(points, exposure)
        sigma = np.where((exposure >= 100) == bool(better), 0.01, 0.02)
        cloud = replace(cloud, covariance_mm2=np.eye(3) * sigma[:, None, None] ** 2)
        found = clean_cloud(cloud, CleaningOptions(overlap_mm=1.0)).cloud
        assert (found.exposure < 100).sum() == pytest.approx(n_first, abs=2 * N_STRIPES)
        # one surface everywhere: no place has both
        x = found.points_mm[:, 0]
        both = (x > 16.0) & (x < 29.0)
        assert len(np.unique(found.points_mm[both, 2])) == 1
        assert x.min() == 0.0
        assert x.max() > 44.0


def test_grazing_points_of_a_ball() -> None:
    """Seen from far above, the angle of incidence is that from the pole."""
    outward = ball_stripes(16, 40)
    exposure = np.repeat(np.arange(16), 40)
    cloud = cloud_of(RADIUS_MM * outward, exposure, normals=outward)
    above = np.tile([0.0, 0.0, 1e7], (16, 1))
    found = clean_cloud(replace(cloud, seen_from_mm=above), CleaningOptions(max_incidence_deg=50.0))
    assert np.array_equal(found.taken_by >= 0, outward[:, 2] < np.cos(np.radians(50.0)))
    with pytest.raises(InputError, match="where the sensor stood"):
        clean_cloud(cloud, CleaningOptions(max_incidence_deg=50.0))
    with pytest.raises(InputError, match="no normals"):
        clean_cloud(replace(cloud, normals=None), CleaningOptions(max_incidence_deg=50.0))


def test_density_and_region() -> None:
    cloud = plate()
    box = Box([-0.05, -1.0, -1.0], [9.95, 20.0, 1.0])
    found = clean_cloud(cloud, CleaningOptions(region=box, density_mm=0.5))
    assert [step.name for step in found.steps] == ["region", "density"]
    assert found.steps[0].n_taken == N_STRIPES * 200
    # five points of 0.1 mm a cell, of which the middle one stays
    assert len(found.cloud) == N_STRIPES * 20
    assert np.allclose(np.diff(np.unique(found.cloud.points_mm[:, 0])), 0.5)


def test_filters_work_one_after_the_other() -> None:
    """A point counts for the first that took it; numbers add up."""
    options = CleaningOptions(edge_mm=0.25, line_to_line_mm=0.45)
    found = clean_cloud(plate(0.1), options)
    taken_in_all = sum(step.n_taken for step in found.steps)
    assert taken_in_all + len(found.cloud) == N_STRIPES * N_POINTS
    assert np.bincount(found.taken_by + 1)[1:].tolist() == [s.n_taken for s in found.steps]


@pytest.mark.parametrize(
    "given", [{}, {"hole_mm": 1.0}, {"edge_mm": 0.0}, {"max_incidence_deg": 95.0},
              {"density_mm": float("nan")}, {"overlap_mm": -1.0}],
)  # fmt: skip
def test_options_that_make_no_sense(given: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        CleaningOptions(**given)


def test_a_cloud_without_points_is_refused_in_words() -> None:
    for options in (CleaningOptions(density_mm=1.0), CleaningOptions(isolated_mm=1.0)):
        with pytest.raises(InputError, match="the cloud holds no point"):
            clean_cloud(plate().select(np.zeros(0, dtype=np.int64)), options)


def test_what_a_cloud_does_not_carry_is_said() -> None:
    bare = cloud_of(plate().points_mm, sigma_mm=0.0)
    for options in (CleaningOptions(edge_mm=1.0), CleaningOptions(overlap_mm=1.0)):
        with pytest.raises(InputError, match="of one stripe"):
            clean_cloud(bare, options)
    (told,) = clean_cloud(plate(), CleaningOptions(edge_mm=10.0)).warnings
    assert "took 67 %" in told
    with pytest.raises(InputError, match="no point is left"):
        clean_cloud(plate(), CleaningOptions(isolated_mm=0.01))


def test_angles_of_incidence_stay_when_a_cloud_is_carried_to_another_frame() -> None:
    outward = ball_stripes(16, 40)
    cloud = cloud_of(RADIUS_MM * outward, np.repeat(np.arange(16), 40), normals=outward)
    cloud = replace(cloud, seen_from_mm=np.tile([30.0, 0.0, 200.0], (16, 1)))
    rotation, shift = random_motion(3)
    moved = carry_cloud(cloud, Pose(rotation, shift), np.zeros((6, 6)), "Part")
    options = CleaningOptions(max_incidence_deg=50.0)
    before, after = (clean_cloud(one, options).taken_by for one in (cloud, moved))
    assert np.array_equal(before, after)
    assert 0 < int((before >= 0).sum()) < len(before)


@pytest.mark.parametrize(
    "options",
    [
        CleaningOptions(edge_mm=0.3),
        CleaningOptions(line_deviation_mm=0.3),
        CleaningOptions(line_spacing_mm=0.3),
        CleaningOptions(line_to_line_mm=0.3),
        CleaningOptions(overlap_mm=0.3),
    ],
)
def test_a_fused_cloud_has_no_stripes(options: CleaningOptions) -> None:
    fused = replace(
        cloud_of(plate().points_mm), sheet_names=("fused",), exposure_sources=("fused",)
    )
    with pytest.raises(InputError, match="fused one"):
        clean_cloud(fused, options)
    assert len(clean_cloud(fused, CleaningOptions(density_mm=1.0)).cloud)


def test_a_cleaned_cloud_keeps_what_its_points_know() -> None:
    """Every filter chooses points and changes none: covariances and noise stay theirs."""
    random = np.random.default_rng(3)
    cloud = plate(0.2)
    n = len(cloud)
    root = 0.01 * random.normal(size=(n, 3, 3))
    whole = replace(
        cloud,
        covariance_mm2=root @ np.swapaxes(root, 1, 2),
        sigma_noise_mm=random.uniform(0.001, 0.01, n),
        noise_length=np.ones(n),
    )
    options = CleaningOptions(
        region=Box.from_limits([1.0, 25.0, -1.0, 10.0, -1.0, 1.0], "region"),
        isolated_mm=0.6, line_spacing_mm=0.5, edge_mm=0.3, line_to_line_mm=0.3, overlap_mm=1.0,
        density_mm=0.4,
    )  # fmt: skip
    found = clean_cloud(whole, options)
    kept = np.flatnonzero(found.taken_by < 0)
    assert 0 < len(kept) < n // 2
    for name in ("points_mm", "covariance_mm2", "sigma_noise_mm", "noise_length", "exposure"):
        assert np.array_equal(getattr(found.cloud, name), getattr(whole, name)[kept]), name


def test_thinned_points_share_their_noise_with_fewer() -> None:
    """White noise averaged over nine points, every third kept: the mean scatters as is stated.

    Its correlations sum to 9; at every third point to 1 + 2 (6/9 + 3/9) = 3.
    """
    width, sigma, runs = 9, 0.01, 400
    cloud = replace(plate(5.0), noise_length=np.full(N_POINTS * N_STRIPES, float(width)))
    every = Box.from_limits([-1.0, 99.0, -1.0, 999.0, -1.0, 1.0], "region")
    whole = replace(cloud, sigma_noise_mm=np.full(len(cloud), sigma))
    found = clean_cloud(whole, CleaningOptions(region=every, density_mm=3.0 * SPACING_MM))
    inner = np.abs(found.cloud.points_mm[:, 0] - 15.0) < 13.0
    assert found.cloud.noise_length is not None
    assert np.median(found.cloud.noise_length[inner]) == pytest.approx(3.0)
    random = np.random.default_rng(0)
    rows = np.flatnonzero(found.taken_by < 0)
    means = []
    for _ in range(runs):
        white = random.normal(0.0, sigma * np.sqrt(width), (N_STRIPES, N_POINTS + width - 1))
        smooth = np.apply_along_axis(np.convolve, 1, white, np.full(width, 1.0 / width), "valid")
        means.append(smooth.ravel()[rows].mean())
    stated = np.sqrt(np.sum(sigma**2 * found.cloud.noise_length)) / len(rows)
    assert np.std(means) / stated == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * runs) + 0.03)
