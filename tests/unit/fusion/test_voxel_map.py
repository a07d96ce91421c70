# SPDX-License-Identifier: Apache-2.0
"""A voxel's mean, and above all what its sigma promises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from armscan.errors import InputError, OptionError
from armscan.fusion.voxel_map import FusedPoints, VoxelMap
from armscan.geometry.arrays import FloatArray
from armscan.kernels.grids import principal_axes
from armscan.reconstruction.place import merge_clouds
from armscan.records.cloud import PointCloud
from rigs.long_scan import stripes

SIZE_MM = 2.0


def fuse(clouds: list[PointCloud], size_mm: float = SIZE_MM, **options: object) -> FusedPoints:
    voxels = VoxelMap(size_mm, **options)  # type: ignore[arg-type]
    for cloud in clouds:
        voxels.add(cloud)
    (found,) = voxels.fused()
    return found


def measured(
    points: FloatArray, covariance: FloatArray, noise: FloatArray, length: float = 1.0
) -> PointCloud:
    n = len(points)
    zeros = np.zeros(n, dtype=np.int64)
    return PointCloud(
        frame="Base",
        points_mm=points,
        covariance_mm2=np.broadcast_to(covariance, (n, 3, 3)),
        sigma_noise_mm=noise,
        sheet=zeros,
        sheet_names=("A",),
        exposure=zeros,
        exposure_sources=("a.png",),
        segment=zeros,
        intensity=np.full(n, 100.0),
        noise_length=np.full(n, length),
    )


def test_each_voxel_is_what_a_loop_over_its_points_gives() -> None:
    clouds = stripes(30)
    cloud = merge_clouds(clouds)
    normals = cloud.points_mm / np.linalg.norm(cloud.points_mm, axis=1)[:, None]
    cloud = replace(cloud, normals=normals)
    found = fuse([cloud])
    cells = np.floor(cloud.points_mm / SIZE_MM)
    assert cloud.noise_length is not None
    assert found.cloud.normals is not None
    assert int(found.n_points.sum()) == len(cloud)
    for k in range(0, len(found.cloud), 7):
        own = np.flatnonzero((cells == np.floor(found.cloud.points_mm[k] / SIZE_MM)).all(axis=1))
        weights = 1.0 / np.trace(cloud.covariance_mm2[own], axis1=1, axis2=2)
        place = weights @ cloud.points_mm[own] / weights.sum()
        common, first, second = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
        for row, weight in zip(own, weights, strict=True):
            values, axes = np.linalg.eigh(cloud.covariance_mm2[row])
            left, noise = cloud.sigma_noise_mm[row] ** 2, np.zeros((3, 3))
            for value, axis in zip(values[::-1], axes.T[::-1], strict=True):
                taken = min(left, max(value, 0.0))
                noise += taken * np.outer(axis, axis)
                left -= taken
            common += weight * (cloud.covariance_mm2[row] - noise) / weights.sum()
            first += weight * noise / weights.sum()
            second += weight**2 * cloud.noise_length[row] * noise / weights.sum() ** 2
        private = min(first, second, key=np.trace)
        np.testing.assert_allclose(found.cloud.points_mm[k], place, atol=1e-11)
        scale = float(np.trace(common + private))
        np.testing.assert_allclose(found.common_mm2[k], common, atol=1e-9 * scale)
        np.testing.assert_allclose(
            found.cloud.covariance_mm2[k], common + private, atol=1e-9 * scale
        )
        assert found.cloud.sigma_noise_mm[k] == pytest.approx(np.sqrt(np.trace(private)))
        mean = weights @ normals[own]
        np.testing.assert_allclose(found.cloud.normals[k], mean / np.linalg.norm(mean), atol=1e-12)
        assert found.n_points[k] == len(own)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_sigma_is_that_of_the_error(correlation: float) -> None:
    """400 scans of four voxels with an error of the calibration in common, noise along one axis.

    Noise of neighbours correlates as an autoregression, whose sums have (1 + r) / (1 - r) times the
    variance of independent ones. 1200 components of chi2: their mean must lie in its 99.9 %
    interval; were the shared error taken to average out too, it would be far beyond.
    """
    rng = np.random.default_rng(5)
    axis = np.array([0.6, 0.0, 0.8])
    half = rng.normal(0.0, 0.006, (3, 3))
    common = half @ half.T + 0.002**2 * np.eye(3)
    n = 60
    along = np.linspace(0.2, 1.8, n)
    true = np.concatenate([np.column_stack([along + 2 * k, 0 * along + 1, 0 * along + 1])
                           for k in range(4)])  # fmt: skip
    sigma = 0.04 * np.repeat([1.0, 0.5, 2.0, 1.0], n)
    covariance = common + sigma[:, None, None] ** 2 * np.outer(axis, axis)
    length = (1.0 + correlation) / (1.0 - correlation)
    wanted = fuse([measured(true, covariance, sigma, length)]).cloud.points_mm
    scores, naive = [], []
    for _ in range(400):
        drive = rng.normal(size=len(true)) * np.sqrt(1.0 - correlation**2)
        noise = np.zeros(len(true))
        state = rng.normal(size=4)
        for k in range(n):
            rows = np.arange(4) * n + k
            state = correlation * state + (drive[rows] if k else state * (1.0 - correlation))
            noise[rows] = state
        points = true + (sigma * noise)[:, None] * axis + rng.multivariate_normal([0, 0, 0], common)
        found = fuse([measured(points, covariance, sigma, length)])
        error = found.cloud.points_mm - wanted
        # of one voxel: the four share their common error
        total = found.cloud.covariance_mm2[0]
        scores.append(error[0] @ np.linalg.solve(total, error[0]))
        averaged = total - found.common_mm2[0] * (1.0 - length / n)
        naive.append(error[0] @ np.linalg.solve(averaged, error[0]))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * 400) / 400
    # an autoregression of 60 points falls short of its length's limit by some 3 %
    assert np.mean(naive) > 5.0 * high
    assert low * (1.0 if correlation == 0.0 else 0.93) < np.mean(scores) < high


def test_what_points_share_does_not_average_out() -> None:
    """However many points: sigma goes to that of the calibration, not to zero."""
    rng = np.random.default_rng(0)
    common = np.diag([0.0, 0.0, 0.01**2])
    sigmas = []
    for n in (1, 100, 10_000):
        points = rng.uniform(0.1, 1.9, (n, 3))
        covariance = common + np.diag([0.0, 0.0, 0.03**2])
        found = fuse([measured(points, covariance, np.full(n, 0.03))])
        sigmas.append(float(found.cloud.sigma_mm[0]))
        assert found.cloud.sigma_noise_mm[0] == pytest.approx(0.03 / np.sqrt(n))
        np.testing.assert_allclose(found.common_mm2[0], common, atol=1e-12)
    expected = [np.hypot(0.01, 0.03 / np.sqrt(n)) for n in (1, 100, 10_000)]
    np.testing.assert_allclose(sigmas, expected, rtol=1e-9)


def test_one_point_keeps_its_covariance_whatever_its_correlation() -> None:
    covariance = np.diag([1e-4, 2e-4, 9e-4])
    found = fuse([measured(np.ones((1, 3)), covariance, np.array([0.02]), length=7.0)])
    np.testing.assert_allclose(found.cloud.covariance_mm2[0], covariance, rtol=1e-12)
    assert found.cloud.sigma_noise_mm[0] == pytest.approx(0.02)


def test_order_of_points_and_size_of_memory_do_not_matter(tmp_path: Path) -> None:
    """But for the rounding of sums of some hundred terms."""
    clouds = stripes(40)
    cloud = merge_clouds(clouds)
    one = fuse(clouds, 0.4)
    mixed = fuse([cloud.select(np.random.default_rng(1).permutation(len(cloud)))], 0.4)
    voxels = VoxelMap(0.4, tmp_path, most_bytes=60_000)
    for part in clouds:
        voxels.add(part)
    pieces = list(voxels.fused())
    assert voxels.n_runs > 5
    spilled = FusedPoints(
        PointCloud.concat([piece.cloud for piece in pieces]),
        np.concatenate([piece.n_points for piece in pieces]),
        np.concatenate([piece.common_mm2 for piece in pieces]),
    )
    voxels.close()
    assert not any(tmp_path.iterdir())
    for other in (mixed, spilled):
        np.testing.assert_array_equal(other.n_points, one.n_points)
        np.testing.assert_allclose(other.cloud.points_mm, one.cloud.points_mm, atol=1e-12)
        np.testing.assert_allclose(
            other.cloud.covariance_mm2, one.cloud.covariance_mm2, rtol=1e-9, atol=1e-16
        )


def test_voxels_meet_at_the_origin_alike_on_both_sides() -> None:
    places = np.array([[-0.1, 0.1, 5.0], [0.1, 0.1, 5.0], [-2.1, 0.1, 5.0]])
    found = fuse([measured(places, np.eye(3), np.zeros(3))])
    assert sorted(found.cloud.points_mm[:, 0]) == pytest.approx([-2.1, -0.1, 0.1])


def test_two_sides_of_a_sheet_in_one_voxel_have_no_normal() -> None:
    points = np.array([[0.5, 0.5, 0.5], [0.6, 0.5, 0.9]])
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    cloud = replace(measured(points, 1e-4 * np.eye(3), np.zeros(2)), normals=up)
    found = fuse([cloud]).cloud.normals
    assert found is not None
    assert not found.any()


@pytest.mark.parametrize("case", ["frame", "far", "covariance"])
def test_what_does_not_fuse_is_refused(case: str) -> None:
    cloud = measured(np.ones((2, 3)), np.eye(3), np.zeros(2))
    voxels = VoxelMap(SIZE_MM)
    voxels.add(cloud)
    other = {
        "frame": replace(cloud, frame="Part"),
        "far": replace(cloud, points_mm=np.full((2, 3), 3e6)),
        "covariance": replace(cloud, covariance_mm2=np.zeros((2, 3, 3))),
    }[case]
    with pytest.raises(InputError):
        voxels.add(other)


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_a_size_must_be_a_length(size: float) -> None:
    with pytest.raises(OptionError):
        VoxelMap(size)


def test_principal_axes_are_those_of_lapack() -> None:
    rng = np.random.default_rng(0)
    nearly = np.eye(3) + 1e-200 * np.ones((3, 3))
    nearly[0, 1] = 3e-200
    drawn = [*rng.normal(size=(50, 3, 3)), np.diag([1.0, 1.0, 2.0]), np.ones((3, 3)), nearly]
    for matrix in drawn:
        whole = matrix @ matrix.T
        values, axes = whole.copy(), np.zeros((3, 3))
        principal_axes(values, axes)
        assert sorted(np.diag(values)) == pytest.approx(np.linalg.eigvalsh(whole), abs=1e-13)
        np.testing.assert_allclose(axes @ np.diag(np.diag(values)) @ axes.T, whole, atol=1e-13)
