# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels against readable twins in NumPy and SciPy."""

import numpy as np
import pytest
from scipy.ndimage import correlate, map_coordinates, maximum_filter
from scipy.optimize import curve_fit

from armscan.kernels.arrays import COLUMN
from armscan.kernels.chains import find_other_lines, measure_chains, sum_windows, walk_chains
from armscan.kernels.stripe.profile_fit import (
    AMPLITUDE,
    CENTRE,
    FIT_COLUMNS,
    SIGMA,
    VARIANCE,
    average_sides,
    fit_profiles,
    read_sides,
)
from armscan.kernels.stripe.ridge import (
    derivatives_at,
    find_runs,
    gaussian_taps,
    interpolate_columns,
    refine_candidates,
    sample_across,
    sum_at_border,
)
from armscan.kernels.stripe.section import (
    NORMAL_00,
    NORMAL_11,
    SCORE_0,
    SCORE_1,
    bin_residuals,
    common_terms,
    mark_points,
    weigh_section,
    widen_sigmas,
)
from armscan.kernels.stripe.smoothing import (
    BEND_SPAN,
    BEYOND_BENDS,
    filter_residuals,
    multiply_lagged,
    seen_bend,
)
from armscan.records.exposure import Exposure
from armscan.vision.stripe.fit import BLOCK, estimate_section
from armscan.vision.stripe.image import lit_plane
from armscan.vision.stripe.ridge import measure_level

FLOAT32 = 3e-5
"""Rounding of 32-bit sums over a few hundred pixels of grey level 255, relative to 1."""


def gaussian_row(centre: float, width: int = 41, peak: float = 100.0) -> np.ndarray:
    x = np.arange(width)
    image = np.tile(peak * np.exp(-0.5 * ((x - centre) / 2.5) ** 2) + 5.0, (3, 1))
    return image.astype(np.float32)


def test_taps_differentiate_polynomials_exactly() -> None:
    smooth, slope, bend = gaussian_taps(2.3).astype(np.float64)
    k = np.arange(len(smooth)) - len(smooth) // 2
    assert smooth.sum() == pytest.approx(1.0, abs=1e-6)
    assert [slope.sum(), slope @ k] == pytest.approx([0.0, 1.0], abs=1e-6)
    assert [bend.sum(), bend @ k, bend @ k**2] == pytest.approx([0.0, 0.0, 2.0], abs=1e-5)


@pytest.mark.parametrize("pixel", [(20, 17), (2, 3), (37, 0)])
def test_derivatives_match_scipy(pixel: tuple[int, int]) -> None:
    image = np.random.default_rng(1).uniform(0, 255, (30, 40)).astype(np.float32)
    taps = gaussian_taps(1.7)
    radius, result = taps.shape[1] // 2, np.zeros(5, np.float32)
    padded = np.zeros((3, 16), np.float32)
    padded[:, : taps.shape[1]] = taps
    derivatives_at(image, *pixel, padded, radius, result)
    g0, g1, g2 = taps.astype(np.float64)
    pairs = ((g0, g1), (g1, g0), (g0, g2), (g1, g1), (g2, g0))
    x, y = pixel
    for k, (down, along) in enumerate(pairs):
        full = correlate(image.astype(np.float64), np.outer(down, along), mode="nearest")
        assert result[k] == pytest.approx(full[y, x], abs=255.0 * FLOAT32 * 3)


def test_ridge_point_of_a_slanted_line() -> None:
    y, x = np.mgrid[:60, :60]
    angle = np.radians(25.0)
    distance = np.cos(angle) * (y - 30.3) - np.sin(angle) * (x - 30.0)
    image = (100.0 * np.exp(-0.5 * (distance / 2.5) ** 2)).astype(np.float32)
    points = np.zeros((1, 6))
    runs = np.array([[30.0, 30.4, 0.0]])
    assert refine_candidates(image, runs, 1, gaussian_taps(2.5), 1.0, points) == 1
    assert points[0, :2] == pytest.approx([30.0, 30.3], abs=0.004)
    normal = points[0, 2:4] * np.sign(points[0, 3])
    assert normal == pytest.approx([-np.sin(angle), np.cos(angle)], abs=4e-3)
    assert refine_candidates(image, runs, 1, gaussian_taps(2.5), 50.0, points) == 0


def runs_twin(image: np.ndarray, floor: float, longest: int) -> set[tuple[int, int, int]]:
    """Twin: (axis, line, length) of the runs above ``floor``."""
    found = set()
    for axis, lines in ((0, image.T), (1, image)):
        for line, values in enumerate(lines):
            lit = np.concatenate([[0], (values > floor).astype(int), [0]])
            starts, stops = np.flatnonzero(np.diff(lit) == 1), np.flatnonzero(np.diff(lit) == -1)
            for a, b in zip(starts, stops, strict=True):
                if b - a <= longest:
                    found.add((axis, line, round(0.5 * (a + b - 1))))
    return found


def test_runs_match_the_twin() -> None:
    rng = np.random.default_rng(2)
    image = np.where(rng.uniform(size=(50, 70)) > 0.7, 100.0, 0.0).astype(np.float32)
    runs = np.zeros((4000, 3))
    count = find_runs(
        image, np.zeros((1, 2), np.float32), np.ones((1, 2), np.uint8), 64, 20.0, 6, runs
    )
    rows = runs[:count]
    axis = rows[:, 2].astype(int)
    line = np.where(axis == 0, rows[:, 0], rows[:, 1]).astype(int)
    centre = np.rint(np.where(axis == 0, rows[:, 1], rows[:, 0])).astype(int)
    assert set(zip(axis.tolist(), line.tolist(), centre.tolist(), strict=True)) == runs_twin(
        image, 20.0, 6
    )


def test_two_humps_on_one_foot_become_two_candidates() -> None:
    x = np.arange(60)
    profile = 150.0 * (np.exp(-0.5 * ((x - 22) / 3) ** 2) + np.exp(-0.5 * ((x - 37) / 3) ** 2))
    image = np.tile(profile + 12.0, (2, 1)).astype(np.float32)
    runs = np.zeros((200, 3))
    count = find_runs(
        image, np.zeros((1, 1), np.float32), np.ones((1, 1), np.uint8), 64, 10.0, 90, runs
    )
    along = runs[:count][runs[:count, 2] == 1]
    assert along[:, 0] == pytest.approx([22.0, 37.0] * 2, abs=0.2)


def test_capacity_is_reported() -> None:
    image = np.zeros((20, 40), np.float32)
    image[:, ::2] = 100.0
    needed = find_runs(
        image,
        np.zeros((1, 1), np.float32),
        np.ones((1, 1), np.uint8),
        64,
        20.0,
        90,
        np.zeros((5, 3)),
    )
    assert needed == 20 * 20 + 20


def test_background_is_linear_between_cells() -> None:
    grid = np.array([[0.0, 64.0], [128.0, 192.0]], np.float32)
    row = np.zeros(128, np.float32)
    interpolate_columns(grid, 64, 1, row)
    expected = 128.0 + np.interp(np.arange(128), [31.5, 95.5], [0.0, 64.0])
    assert row == pytest.approx(expected, abs=0.01)


def test_runs_follow_a_sloping_background() -> None:
    y, x = np.mgrid[:128, :128]
    ground = 0.5 * np.clip(x, 31.5, 95.5) + 0.3 * np.clip(y, 31.5, 95.5)
    centres = np.array([31.5, 95.5])
    grid = (0.5 * centres[None, :] + 0.3 * centres[:, None]).astype(np.float32)
    image = ground.astype(np.float32)
    runs = np.zeros((100, 3))
    assert find_runs(image, grid, np.ones(grid.shape, np.uint8), 64, 0.1, 90, runs) == 0
    image[100, 40] += 5.0
    assert find_runs(image, grid, np.ones(grid.shape, np.uint8), 64, 0.1, 90, runs) == 2


@pytest.mark.parametrize("centre", [20.0, 20.37, 20.5])
def test_profile_fit_matches_scipy(centre: float) -> None:
    rng = np.random.default_rng(3)
    image = gaussian_row(centre)
    image += rng.normal(0.0, 2.0, image.shape).astype(np.float32)
    points = np.array([[20.0, 1.0, 1.0, 0.0, 0.0, 1.0]])
    sides = np.full((1, 2), 5.0)
    noise = np.array([0.0, 0.0, 4.0])
    result = np.zeros((1, FIT_COLUMNS))
    width = np.full(1, 2.5)
    fit_profiles(
        image,
        np.zeros((1, 1), np.uint8),
        np.ones((1, 1), np.float32),
        points,
        width,
        sides,
        noise,
        np.zeros(4),
        np.full(1, 2.7),
        result,
    )
    x = np.arange(41)
    use = np.abs(x - 20.0) <= 2.7 * 2.5
    best, covariance = curve_fit(
        lambda t, c, a, s: a * np.exp(-0.5 * ((t - c) / s) ** 2),
        x[use],
        image[1, use].astype(np.float64) - 5.0,
        p0=[20.0, 100.0, 2.5],
        sigma=np.full(use.sum(), 2.0),
        absolute_sigma=True,
    )
    assert result[0, [CENTRE, AMPLITUDE, SIGMA]] == pytest.approx(best, rel=1e-4)
    assert result[0, VARIANCE] == pytest.approx(covariance[0, 0], rel=0.05)


def test_profile_fit_on_print_matches_scipy() -> None:
    """SciPy's least squares of ``reflectance (background + line)``: a border beside the centre."""
    rng = np.random.default_rng(5)
    x = np.arange(41.0)
    ground = np.where(x < 21.0, 0.1, 1.0)
    line = 100.0 * np.exp(-0.5 * ((x - 19.2) / 5.0) ** 2)
    image = np.tile(ground * (5.0 + line), (3, 1)).astype(np.float32)
    image += rng.normal(0.0, 0.3, image.shape).astype(np.float32)
    result, even = np.zeros((1, FIT_COLUMNS)), np.zeros((1, FIT_COLUMNS))
    for reflectance, out in (
        (np.tile(ground, (3, 1)).astype(np.float32), result),
        (np.ones((1, 1), np.float32), even),
    ):
        fit_profiles(
            image,
            np.zeros((1, 1), np.uint8),
            reflectance,
            np.array([[20.0, 1.0, 1.0, 0.0, 0.0, 1.0]]),
            np.full(1, 5.0),
            np.full((1, 2), 5.0),
            np.array([0.0, 0.0, 0.09]),
            np.zeros(4),
            np.full(1, 2.7),
            out,
        )
    use = np.abs(x - 20.0) <= 2.7 * 5.0
    best, covariance = curve_fit(
        lambda t, c, a, s: ground[use] * (5.0 + a * np.exp(-0.5 * ((t - c) / s) ** 2)),
        x[use],
        image[1, use].astype(np.float64),
        p0=[20.0, 100.0, 5.0],
        sigma=np.full(use.sum(), 0.3),
        absolute_sigma=True,
    )
    assert result[0, [CENTRE, AMPLITUDE, SIGMA]] == pytest.approx(best, rel=1e-4)
    assert result[0, VARIANCE] == pytest.approx(covariance[0, 0], rel=0.05)
    assert abs(result[0, CENTRE] - 19.2) < 4.0 * np.sqrt(covariance[0, 0])
    assert even[0, VARIANCE] == 0.0 or even[0, CENTRE] > 22.0, "a Gaussian goes to the bright side"


def test_clipped_pixels_are_left_out() -> None:
    image = gaussian_row(20.3, peak=400.0)
    clipped = (image >= 255.0).astype(np.uint8)
    points = np.array([[20.0, 1.0, 1.0, 0.0, 0.0, 1.0]])
    result = np.zeros((1, FIT_COLUMNS))
    arguments = (
        points,
        np.full(1, 2.5),
        np.full((1, 2), 5.0),
        np.array([0.0, 0.1, 1.0]),
        np.zeros(4),
        np.full(1, 2.7),
    )
    even = np.ones((1, 1), np.float32)
    fit_profiles(np.minimum(image, np.float32(255.0)), clipped, even, *arguments, result)
    assert result[0, [CENTRE, AMPLITUDE, SIGMA]] == pytest.approx([20.3, 400.0, 2.5], rel=1e-3)


def test_known_results_are_where_the_steps_begin() -> None:
    image = gaussian_row(20.3)
    points = np.array([[20.0, 1.0, 1.0, 0.0, 0.0, 1.0]])
    arguments = (
        image,
        np.zeros((1, 1), np.uint8),
        np.ones((1, 1), np.float32),
        points,
        np.full(1, 2.0),
        np.full((1, 2), 5.0),
        np.array([0.01, 0.1, 1.0]),
        np.zeros(4),
        np.full(1, 2.7),
    )
    result = np.zeros((1, FIT_COLUMNS))
    fit_profiles(*arguments, result)
    again = result.copy()
    fit_profiles(*arguments, again)
    assert again[0, :4] == pytest.approx(result[0, :4], rel=1e-4)
    wrong = result.copy()
    wrong[0, CENTRE] += 30.0
    fit_profiles(*arguments, wrong)
    assert wrong[0, VARIANCE] == 0.0


EVEN = np.ones((1, 1), np.float32)


def lopsided_rows(c3: float, c4: float, ground: np.ndarray = EVEN) -> tuple[np.ndarray, np.ndarray]:
    """Image of 40 noisy rows with a lopsided section, and their ridge points."""
    rng = np.random.default_rng(6)
    centre = 20.0 + rng.uniform(-0.5, 0.5, (40, 1))
    u = (np.arange(41) - centre) / 2.5
    section = 1.0 + c3 * (u**3 - 3.0 * u) + c4 * (u**4 - 6.0 * u**2 + 3.0)
    image = (5.0 + 150.0 * np.exp(-0.5 * u * u) * np.maximum(section, 0.0)) * ground
    points = np.zeros((40, 6))
    points[:, 0], points[:, 1] = centre[:, 0], np.arange(40)
    points[:, 2], points[:, 5] = 1.0, 1.0
    return (image + rng.normal(0.0, 1.0, image.shape)).astype(np.float32), points


def test_section_is_what_the_fit_leaves() -> None:
    """Each profile's normal matrix and right-hand side against weighted least squares in NumPy."""
    c3, c4 = 0.05, 0.01
    ground = (1.0 + 0.3 * np.sin(np.arange(41) / 2.0) * np.ones((40, 1))).astype(np.float32)
    image, points = lopsided_rows(c3, c4, ground)
    noise, none, sides = (
        np.array([1e-4, 0.0, 1.0]),
        np.zeros((1, 1), np.uint8),
        np.full((40, 2), 5.0),
    )
    start, fits = np.array([0.0, 0.0, 0.02, 0.0]), np.zeros((40, FIT_COLUMNS))
    images, arguments = (image, none, ground, points), (np.full(40, 2.5), sides, noise)
    reach = np.full(40, 2.7)
    fit_profiles(*images, *arguments, start, reach, fits)
    said, pixels = np.zeros((40, 8)), np.zeros((3, 40 * 31))
    weigh_section(*images, *arguments[:2], fits, noise, start, 15, said, pixels)
    for i in (0, 17, 39):
        _, amplitude, sigma = fits[i, [CENTRE, AMPLITUDE, SIGMA]]
        u = (np.arange(41) - fits[i, CENTRE]) / sigma
        near = np.abs(u) < 2.7
        u, light = u[near], amplitude * np.exp(-0.5 * u[near] ** 2)
        bell = light * ground[i, near]
        h3, h4 = u**3 - 3.0 * u, u**4 - 6.0 * u**2 + 3.0
        model = bell * (1.0 + 0.02 * h3)
        slope = bell * (u * (1.0 + 0.02 * h3) - 0.06 * (u * u - 1.0))
        weight = 1.0 / np.sqrt(noise[0] * model**2 + noise[2])
        fitted = np.stack([slope, model, slope * u], axis=1) * weight[:, None]
        black = -light * (1.0 + 0.02 * h3)
        terms = np.stack([bell * h3, bell * h4, black], axis=1) * weight[:, None]
        rest = terms - fitted @ np.linalg.lstsq(fitted, terms, rcond=None)[0]
        residual = (image[i, near] - 5.0 * ground[i, near] - model) * weight
        normal, score = rest.T @ rest, rest.T @ residual
        expected = [*normal[0, :2], normal[1, 1], *score[:2], 1.0, normal[2, 2], score[2]]
        assert said[i] == pytest.approx(expected, rel=1e-6)
    common = np.zeros(2)
    common_terms(said, 8, 0.7, common)
    sigma = np.sqrt(np.diag(np.linalg.inv(40.0 * normal[:2, :2])))
    # 1.6: what a clipped score loses against least squares
    assert np.all(np.abs(start[2:] + common - [c3, c4]) < 4.0 * 1.6 * sigma)
    true, fits = np.array([0.0, 0.0, c3, c4]), np.zeros((40, FIT_COLUMNS))
    fit_profiles(*images, *arguments, true, reach, fits)
    count = weigh_section(*images, *arguments[:2], fits, noise, true, 15, said, pixels)
    # the freedom that each fit took is given back
    assert np.std(pixels[2, :count]) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * count))


def test_a_narrow_section_is_told_however_far_is_looked() -> None:
    """Wide lines of an image decide how far is looked; the bell of a narrow one is 0 there."""
    image = np.full((3, 401), 5.0, np.float32)
    image[:, 180:221] = gaussian_row(20.3)
    points = np.tile([200.0, 1.0, 1.0, 0.0, 0.0, 1.0], (1, 1))
    fits = np.array([[200.3, 100.0, 0.6, 0.1, 0.0, 1.0, 0.0, 0.0]])
    none, noise, section = np.zeros((1, 1), np.uint8), np.array([0.01, 0.1, 1.0]), np.full(4, 0.01)
    told, sides = [], np.full((1, 2), 5.0)
    for reach in (12, 190):
        said, pixels = np.zeros((1, 8)), np.zeros((3, 2 * reach + 1))
        given = (image, none, EVEN, points, np.full(1, 0.6), sides, fits, noise, section)
        n = weigh_section(*given, reach, said, pixels)
        told.append((said, pixels[:, :n]))
    for near, far in zip(*told, strict=True):
        assert np.isfinite(far).all()
        assert far == pytest.approx(near, rel=1e-9)


def test_residuals_are_binned_by_the_lines_own_level() -> None:
    rng = np.random.default_rng(9)
    pixels = np.stack([rng.uniform(-5, 130, 5000), rng.uniform(-20, 150, 5000), np.zeros(5000)])
    pixels[2] = rng.normal(0.0, 1.0, 5000) * (rng.uniform(size=5000) > 0.05) * 40.0
    edges, bins = np.array([0.0, 10.0, 40.0, 41.0, 120.0]), np.zeros((4, 4))
    bin_residuals(pixels, pixels.shape[1], edges, bins)
    for b in range(4):
        own = pixels[:, (pixels[0] >= edges[b]) & (pixels[0] < edges[b + 1])]
        limit = 3.5 * 1.4826 * np.median(np.abs(own[2]))
        light, spread = np.maximum(own[1], 0.0).mean(), np.minimum(np.abs(own[2]), limit) ** 2
        expected = [own.shape[1], (own[0] ** 2).mean(), light, spread.mean()]
        assert bins[b] == pytest.approx(expected, rel=1e-5)


def test_clipped_cores_say_nothing_of_the_section() -> None:
    image, points = lopsided_rows(0.0, 0.0)
    fits, said, pixels = np.zeros((40, FIT_COLUMNS)), np.zeros((40, 8)), np.zeros((3, 40 * 31))
    noise, sides = np.array([0.0, 0.0, 1.0]), np.full((40, 2), 5.0)
    clipped = np.zeros(image.shape, np.uint8)
    clipped[3, 20] = 1  # the peak
    clipped[4, 25] = 1  # two sigmas beside it
    images, arguments = (image, clipped, EVEN, points), (np.full(40, 2.5), sides, noise)
    fit_profiles(*images, *arguments, np.zeros(4), np.full(40, 2.7), fits)
    weigh_section(*images, *arguments[:2], fits, noise, np.zeros(4), 15, said, pixels)
    assert np.flatnonzero(said[:, 5] == 0.0).tolist() == [4]


def test_one_profile_of_another_surface_hardly_moves_the_common_terms() -> None:
    rng = np.random.default_rng(7)
    said = np.zeros((101, 8))
    said[:, 0], said[:, 2], said[:, 5] = 100.0, 50.0, 1.0
    said[:, 3] = 100.0 * 0.03 + rng.normal(0.0, 10.0, 101)
    said[:, 4] = rng.normal(0.0, 7.0, 101)
    before, after = np.zeros(2), np.zeros(2)
    common_terms(said, 8, 0.7, before)
    said[50, 3] = 5000.0
    common_terms(said, 8, 0.7, after)
    assert abs(after[0] - before[0]) < 4.0 * 10.0 / (100.0 * np.sqrt(101.0))
    assert abs(said[:, 3].sum() / said[:, 0].sum() - 0.03) > 0.3


def test_sampling_across_matches_scipy() -> None:
    rng = np.random.default_rng(8)
    image = rng.uniform(0.0, 255.0, (40, 50)).astype(np.float32)
    angle = rng.uniform(0.0, 2.0 * np.pi, 6)
    points = np.stack(
        [rng.uniform(2, 47, 6), rng.uniform(2, 37, 6), *np.array([np.cos(angle), np.sin(angle)])]
    )
    points = np.ascontiguousarray(points.T)
    across, along = np.arange(-10.0, 10.5, 0.5), np.array([-2.0, 0.0, 2.0])
    found = np.zeros((6, len(across)))
    sample_across(image, points, across, along, found)
    x = points[:, 0, None, None] + points[:, 2, None, None] * across[:, None]
    y = points[:, 1, None, None] + points[:, 3, None, None] * across[:, None]
    x, y = x - points[:, 3, None, None] * along, y + points[:, 2, None, None] * along
    expected = map_coordinates(image.astype(np.float64), [y, x], order=1, mode="nearest")
    assert found == pytest.approx(expected.mean(axis=2), abs=255.0 * FLOAT32)


def test_sides_are_means_beside_the_line() -> None:
    image = np.zeros((3, 41), np.float32)
    image[:, :20] = 10.0
    image[:, 20:] = 30.0
    sides = np.zeros((1, 4))
    read_sides(image, np.array([[20.0, 1.0, 1.0, 0.0, 0.0, 1.0]]), np.full(1, 2.0), sides)
    assert sides[0].tolist() == [10.0, 4.0, 30.0, 4.0]


def test_sums_along_chains_are_those_of_each_chain() -> None:
    rng = np.random.default_rng(5)
    chain = np.repeat([0, 1, 4], [7, 1, 12])
    values, sums = rng.normal(size=(2, 20)), np.zeros((2, 20))
    sum_windows(values, chain, 3, sums)
    near = np.abs(np.arange(20)[:, None] - np.arange(20)) <= 3
    expected = values @ (near & (chain[:, None] == chain))
    assert sums == pytest.approx(expected, abs=1e-12)


def test_patches_are_summed_as_at_the_border() -> None:
    """The lanes of single precision against plain loops, of all widths of the taps."""
    image = np.random.default_rng(12).uniform(0, 255, (70, 90)).astype(np.float32)
    for sigma in (1.0, 3.0, 8.0):
        taps = gaussian_taps(sigma)
        radius, own, beside = taps.shape[1] // 2, np.zeros(5, np.float32), np.zeros(5, np.float32)
        padded = np.zeros((3, -(-taps.shape[1] // 8) * 8), np.float32)
        padded[:, : taps.shape[1]] = taps
        for x, y in ((radius, radius), (40, 35), (90 - padded.shape[1] + radius, 69 - radius)):
            derivatives_at(image, x, y, padded, radius, own)
            sum_at_border(image, x, y, padded, radius, beside)
            assert own == pytest.approx(beside, rel=FLOAT32, abs=255.0 * FLOAT32)


def averaged(values: np.ndarray, weights: np.ndarray, chain: np.ndarray, half: int) -> np.ndarray:
    """Twin: weighted means (N,) over the neighbours on a chain; NaN where nothing weighs."""
    places = np.arange(len(chain))
    near = np.abs(places[:, None] - places) <= half
    near &= chain[:, None] == chain
    total = near @ weights
    return np.where(total > 0.0, near @ (weights * values) / np.maximum(total, 1e-300), np.nan)


def test_sides_are_averaged_where_no_line_lights_them_up() -> None:
    rng = np.random.default_rng(13)
    n = 60
    raw, ground = rng.uniform(5.0, 9.0, (n, 4)), rng.uniform(0.3, 1.0, (n, 4))
    raw[:, 1::2] = rng.integers(0, 7, (n, 2))
    neighbour = rng.uniform(0.0, 40.0, (n, 2))
    neighbour[20:30] = 0.0
    chain = np.repeat([0, 2, 3], [31, 1, 28])
    found = np.zeros((n, 3))
    average_sides(raw, ground, neighbour, 15.0, chain, 4, found)
    count, clear = raw[:, 1::2], neighbour > 15.0
    seen = np.where(count > 0.0, ground[:, ::2], 1.0)
    level = raw[:, ::2] / seen
    mean = np.stack(
        [averaged(level[:, k], (count * clear * seen**2)[:, k], chain, 4) for k in (0, 1)], axis=1
    )
    own = np.where(clear, mean, np.nan)
    lowest = np.where(count > 0.0, level, np.inf).min(axis=1)
    lowest = np.where(np.isfinite(lowest), lowest, 0.0)[:, None]
    sides = np.where(np.isnan(own), own[:, ::-1], own)
    assert found[:, :2] == pytest.approx(np.where(np.isnan(sides), lowest, sides), rel=1e-9)
    places = np.minimum([31, 1, 28], 9)[np.searchsorted([0, 2, 3], chain)]
    pixels = np.where(np.isnan(own).any(axis=1), 1.0, count.min(axis=1)) * places
    expected = np.sqrt(2.0 / np.maximum(pixels, 1.0)) / seen.min(axis=1)
    assert found[:, 2] == pytest.approx(expected, rel=1e-9)
    assert (found[20:30, 0] == found[20:30, 1]).all()


def test_marks_follow_their_definitions() -> None:
    """Each flag against its definition in NumPy, on profiles of which a part shows each."""
    rng = np.random.default_rng(14)
    n = 200
    chain = np.repeat([0, 1], [120, 80])
    turn = rng.uniform(0.0, np.pi, n)
    is_row = np.abs(np.cos(turn)) > np.abs(np.sin(turn))
    line = rng.integers(2, 38, n).astype(np.float64)
    points = np.zeros((n, 6))
    points[:, 2], points[:, 3], points[:, 5] = np.cos(turn), np.sin(turn), is_row
    points[np.arange(n), is_row.astype(int)] = line
    fits = np.abs(rng.normal(1.0, 0.5, (n, FIT_COLUMNS))) + 0.2
    fits[:, 0] = rng.uniform(1.0, 38.0, n)
    fits[:, 4] = rng.normal(0.0, 3.0, n)
    fits[60:90, 4] = 12.0
    sides, side_sigma = rng.normal(0.0, 0.3, (n, 2)), rng.uniform(0.02, 0.2, n)
    neighbour = rng.uniform(0.0, 20.0, (n, 2))
    saturated = (rng.uniform(size=(40, 40)) > 0.93).astype(np.uint8)
    marks, flags = np.full((n, 8), np.nan), np.zeros(n, np.int64)
    given = (points, fits, sides, side_sigma, neighbour, chain, saturated)
    mark_points(*given, np.array([1, 2, 4, 8, 16]), marks, flags)
    across = np.maximum(np.abs(np.cos(turn)), np.abs(np.sin(turn)))
    centre = np.where(is_row[:, None], np.stack([fits[:, 0], line], 1), 0.0)
    centre += np.where(is_row[:, None], 0.0, np.stack([line, fits[:, 0]], 1))
    width = fits[:, 2] * across
    expected = np.stack([*centre.T, np.sqrt(fits[:, 3]) * across, width], axis=1)
    assert marks[:, :4] == pytest.approx(expected, rel=1e-12)
    x, y = np.rint(centre).astype(int).T
    step = np.abs(np.diff(sides, axis=1)[:, 0])
    near = np.abs(np.arange(n)[:, None] - np.arange(n)) <= 4
    near &= chain[:, None] == chain
    lean, norm = near @ fits[:, 4], near @ fits[:, 5]
    sine = np.minimum(np.abs(np.cos(turn)), np.abs(np.sin(turn)))
    shape = np.stack([near @ width / near.sum(axis=1), lean / np.sqrt(norm), sine], axis=1)
    assert marks[:, 4:7] == pytest.approx(shape, rel=1e-9, abs=1e-7)
    lean = np.abs(lean)
    is_clipped = maximum_filter(saturated, 3, mode="nearest")[y, x] > 0
    is_step, share = step > 5.0 * side_sigma, step / fits[:, 1]
    mostly = near @ is_clipped.astype(np.float64) > near.sum(axis=1) / 2
    pull = np.where(mostly & is_step & (share <= 0.5), 0.7 * share * width, 0.0)
    assert 5 < (pull > 0.0).sum() < (is_clipped & is_step).sum()
    assert marks[:, 7] == pytest.approx(pull, rel=1e-12)
    definitions = (
        is_clipped,
        is_step & (share > np.where(mostly, 0.5, 0.2)),
        (lean > 5.0 * np.sqrt(norm)) & (lean / norm > np.maximum(0.1, 0.3 / width)),
        neighbour.min(axis=1) < 4.5 * width,
        (pull > 0.0) & (share > 0.2),
    )
    for bit, holds in enumerate(definitions):
        assert 0 < holds.sum() < n
        assert (((flags >> bit) & 1) == holds).all()


def test_extents_are_those_of_each_chain() -> None:
    points = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0], [9.0, 9.0], [0.0, 0.0], [0.0, 2.0]])
    start, stop, length = np.zeros(6, np.int64), np.zeros(6, np.int64), np.zeros(6)
    measure_chains(points, np.array([0, 0, 0, 4, 7, 7]), start, stop, length)
    assert start.tolist() == [0, 0, 0, 3, 4, 4]
    assert stop.tolist() == [3, 3, 3, 4, 6, 6]
    assert length.tolist() == [6.0, 6.0, 6.0, 0.0, 2.0, 2.0]


def test_dark_cells_are_not_read() -> None:
    image = np.zeros((128, 192), np.float32)
    image[30:34, 20:170] = 100.0
    image[100:104, 20:170] = 100.0
    grid, lit = np.zeros((2, 3), np.float32), np.array([[1, 0, 1], [0, 0, 0]], np.uint8)
    runs = np.zeros((400, 3))
    runs = runs[: find_runs(image, grid, lit, 64, 10.0, 90, runs)]
    down = runs[runs[:, 2] == 0.0]
    assert set(down[:, 0]) == {*range(20, 64), *range(128, 170)}
    assert down[:, 1] == pytest.approx(31.5)


def test_chains_walk_ends_first_then_loops() -> None:
    ahead = np.array([1, 2, -1, 4, 5, 3, -1])
    behind = np.array([-1, 0, 1, 5, 3, 4, -1])
    order, chain = np.zeros(7, np.int64), np.zeros(7, np.int64)
    assert walk_chains(ahead, behind, order, chain) == 6
    assert order[:6].tolist() in ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 5, 4])
    assert chain[:6].tolist() == [0, 0, 0, 1, 1, 1]


def test_other_lines_match_brute_force() -> None:
    x = np.arange(60.0)
    lines = [np.stack([x, 20.0 + 0.0 * x], 1), np.stack([x, 5.0 + 0.5 * x], 1)]
    points = np.zeros((120, 6))
    points[:, :2] = np.concatenate(lines)
    chain = np.repeat([0, 1], 60)
    first, stop = np.repeat([0, 60], 60), np.repeat([60, 120], 60)
    found = np.zeros((120, 2))
    ones = np.ones(120, np.int64)
    find_other_lines(points, chain, first, stop, ones, 60, 60, 8.0, found)
    gap = np.hypot(*np.moveaxis(points[:, None, :2] - points[None, :, :2], 2, 0))
    gap[chain[:, None] == chain] = np.inf
    nearest = np.where(gap.min(axis=1) <= 8.0, gap.min(axis=1), np.inf)
    assert found.min(axis=1).tolist() == pytest.approx(nearest.tolist())


@pytest.mark.parametrize("shape", [(200, 333), (128, 192), (70, 40), (20, 9)])
def test_levels_of_bytes_are_those_of_the_same_numbers(shape: tuple[int, int]) -> None:
    # bytes are counted, other numbers sorted
    rng = np.random.default_rng(shape[0])
    image = np.clip(rng.normal(20.0, 4.0, shape), 0, 255).astype(np.uint8)
    image[shape[0] // 2 : shape[0] // 2 + 5] = 251
    counted = measure_level(image, None, 255.0 / 251.0)
    ordered = measure_level(image.astype(np.float32), None, 255.0 / 251.0)
    assert (counted.background == ordered.background).all()
    assert (counted.lit == ordered.lit).all()
    for name in ("noise", "clutter", "rise", "brightest"):
        assert getattr(counted, name) == pytest.approx(getattr(ordered, name), rel=1e-6)
    assert counted.brightest == 251.0


def test_cells_of_bytes_are_copied_as_those_of_deeper_images() -> None:
    rng = np.random.default_rng(9)
    image = rng.integers(0, 20, (500, 700)).astype(np.uint8)
    image[340:346, 100:250] = 127
    flat = Exposure(image=image, source="bytes", bits_used=7)
    deep = Exposure(image=image.astype(np.uint16), source="words", bits_used=7)
    (plane, _), (other, _) = lit_plane(flat, None), lit_plane(deep, None)
    assert (plane.image == other.image).all()
    assert (plane.clipped == (image == 127)).all()
    assert plane.image[343, 120] == pytest.approx(255.0)
    # far from the line nothing is copied, near it all is
    assert not plane.image[:100].any()
    assert plane.image[330:360, 90:260] == pytest.approx(image[330:360, 90:260] * (255.0 / 127.0))


def test_residuals_are_those_of_a_convolution() -> None:
    rng = np.random.default_rng(4)
    n, half = 300, 6
    chain = np.repeat([0, 3], [180, 120])
    points = np.stack([np.arange(n) + rng.normal(0, 0.1, n), rng.normal(0, 1, n)], axis=1)
    turn = rng.uniform(0, 6, n)
    normals = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    sigma, is_used = rng.uniform(0.5, 2, n), np.ones(n, np.uint8)
    is_used[[50, 200]] = 0
    weights = rng.uniform(0, 1, 2 * half + 1)
    residual, told = np.zeros(n), np.zeros(n)
    given = (points, normals, sigma, chain, is_used, weights)
    count = filter_residuals(*given, residual, told)
    filtered = np.stack([np.correlate(p, weights, "same") for p in points.T], axis=1)
    expected = ((points - filtered) * normals).sum(axis=1) / sigma
    near = np.abs(np.arange(n)[:, None] - np.arange(n)) <= half
    is_whole = (near & (chain[:, None] == chain) & (is_used > 0)).sum(axis=1) == 2 * half + 1
    assert (np.isfinite(residual) == is_whole).all()
    assert residual[is_whole] == pytest.approx(expected[is_whole], rel=1e-9, abs=1e-9)
    assert told[:count] == pytest.approx(np.abs(expected[is_whole]), rel=1e-9, abs=1e-9)
    total = np.zeros(2)
    for lag in (0, 3):
        multiply_lagged(residual, chain, lag, total)
        product = residual[: n - lag] * residual[lag:]
        own = np.isfinite(product) & (chain[: n - lag] == chain[lag:])
        assert total == pytest.approx([product[own].sum(), own.sum()], rel=1e-12)


def test_the_bend_of_a_line_is_seen_within_its_own_chain_only() -> None:
    """A circle of 150 px, its points a pixel apart, cut into two chains."""
    radius, n = 150.0, 80
    turn = np.arange(n) / radius
    normals = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points, chain = radius * normals, np.arange(n) // 40
    found = np.array([seen_bend(points, normals, chain, i) for i in range(n)])
    from_end = np.minimum(np.arange(n) % 40, 39 - np.arange(n) % 40)
    assert (found[from_end < BEND_SPAN] == BEYOND_BENDS).all()
    # a chord sees 1 + a quarter of the squared half angle times it
    assert found[from_end >= BEND_SPAN] == pytest.approx(1 / radius, rel=(BEND_SPAN / radius) ** 2)


def test_what_lies_beside_a_centre_widens_its_sigma() -> None:
    ridge = np.zeros((4, 6))
    ridge[2:, 5] = 1.0
    section, width = np.array([0.1, 0.0, -0.02, 0.0]), np.array([3.0, 3.0, 2.0, 0.5])
    ground = np.array([[1.0, 0.0], [1.0, 0.0], [0.9, 0.5], [0.9, 0.5]])
    sigma, pull = np.full(4, 0.04), np.array([0.0, 0.0, 0.0, 0.2])
    widen_sigmas(ridge, section, width, ground, np.array([1, 0, 0, 1]), pull, sigma)
    # flanks: lean times width; edges: the blur's share, at most half of the width, times contrast
    beside = np.array([0.3, 0.0, 0.5 * np.hypot(0.04, 0.5), np.hypot(0.5 * 0.25, 0.2)])
    assert sigma == pytest.approx(np.hypot(0.04, beside), rel=1e-12)


def test_stretches_that_say_nothing_of_a_term_leave_the_shape_of_the_section() -> None:
    """Sixty stretches of one shape, of every other one the second term is not told."""
    rng = np.random.default_rng(2)
    n, true = 60 * BLOCK, np.array([0.03, -0.02])
    normal = rng.uniform(50.0, 100.0, (n, 2))
    normal[np.arange(n) // BLOCK % 2 == 1, 1] = 0.0
    said = np.zeros((n, 8))
    said[:, [NORMAL_00, NORMAL_11]] = normal
    said[:, [SCORE_0, SCORE_1]] = normal * true + np.sqrt(normal) * rng.normal(0.0, 0.01, (n, 2))
    usable, axis, chain = np.ones(n, dtype=bool), np.full(n, COLUMN), np.zeros(n, dtype=np.int64)
    with np.errstate(all="raise"):
        found = estimate_section(said, np.zeros(4), usable, axis, chain)
    np.testing.assert_allclose(found[2 * COLUMN : 2 * COLUMN + 2], true, atol=1e-3)
