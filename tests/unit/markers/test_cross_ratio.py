# SPDX-License-Identifier: Apache-2.0
"""Cross ratios by hand, under random projections, and codes with noise."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.thesis.two_cameras import (
    DecodedLine,
    LineCode,
    cross_ratio,
    decode_line,
    find_coded_lines,
    simple_ratio,
)

SIGMA_PX = 0.05
CODES = (
    LineCode("even", (0.0, 10.0, 20.0, 30.0)),
    LineCode("early", (0.0, 4.0, 12.0, 30.0)),
    LineCode("wide", (0.0, 4.0, 26.0, 30.0)),
)


def seen(code: LineCode, seed: int, sigma_px: float = SIGMA_PX) -> tuple[FloatArray, FloatArray]:
    """The code's points through a random perspective, with noise, and their covariance."""
    rng = np.random.default_rng(seed)
    s = np.array(code.positions_mm)
    angle, turn = rng.uniform(-0.7, 0.7), rng.uniform(0.0, 2.0 * np.pi)
    x, z = (s - 15.0) * np.cos(angle), 150.0 + (s - 15.0) * np.sin(angle)
    along = 5000.0 * x / z
    points = along[:, None] * [np.cos(turn), np.sin(turn)] + rng.uniform(200.0, 1500.0, 2)
    noisy = points + sigma_px * rng.standard_normal((4, 2))
    return noisy, np.tile(sigma_px**2 * np.eye(2), (4, 1, 1))


def test_ratios_by_hand() -> None:
    assert simple_ratio(0.0, 1.0, 3.0) == 1.5
    # AC / BC = 2 / 1, AD / BD = 3 / 2.
    assert cross_ratio(0.0, 1.0, 2.0, 3.0) == pytest.approx(4.0 / 3.0)


def test_projections_do_not_change_it() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        places = np.sort(rng.uniform(0.0, 10.0, 4))
        p, q, r = rng.uniform(0.5, 2.0), rng.uniform(-5.0, 5.0), rng.uniform(-0.05, 0.05)
        mapped = (p * places + q) / (1.0 + r * places)
        assert cross_ratio(*mapped) == pytest.approx(cross_ratio(*places), rel=1e-9)
        assert abs(simple_ratio(*mapped[:3]) / simple_ratio(*places[:3]) - 1.0) > 1e-6


def test_the_24_orders_have_six_values() -> None:
    r = cross_ratio(0.0, 1.0, 4.0, 9.0)
    values = {round(cross_ratio(*order), 9) for order in permutations((0.0, 1.0, 4.0, 9.0))}
    expected = {r, 1 / r, 1 - r, 1 / (1 - r), (r - 1) / r, r / (r - 1)}
    assert values == {round(value, 9) for value in expected}
    assert cross_ratio(9.0, 4.0, 1.0, 0.0) == pytest.approx(r)


@pytest.mark.parametrize("code", CODES, ids=lambda code: code.name)
def test_codes_are_named_in_any_order(code: LineCode) -> None:
    for seed in range(30):
        points, covariance = seen(code, seed)
        shuffle = np.random.default_rng(seed).permutation(4)
        line = decode_line(points[shuffle], covariance, CODES)
        assert isinstance(line, DecodedLine)
        assert line.name == code.name
        named = shuffle[line.points].tolist()
        assert named in ([0, 1, 2, 3], [3, 2, 1, 0])
        if line.is_direction_known:
            assert named == [0, 1, 2, 3]


def test_direction_is_known_where_the_code_is_lopsided_only() -> None:
    known = {
        code.name: {
            line.is_direction_known
            for seed in range(20)
            if isinstance(line := decode_line(*seen(code, seed), CODES), DecodedLine)
        }
        for code in CODES
    }
    assert known == {"even": {False}, "early": {True}, "wide": {False}}


def test_sigma_of_the_ratio_is_that_of_repeats() -> None:
    rng = np.random.default_rng(3)
    points, covariance = seen(CODES[1], 3, 0.0)
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (4, 1, 1))
    lines = [
        decode_line(points + SIGMA_PX * rng.standard_normal((4, 2)), covariance, CODES)
        for _ in range(600)
    ]
    ratios = [line.ratio for line in lines if isinstance(line, DecodedLine)]
    sigmas = [line.sigma for line in lines if isinstance(line, DecodedLine)]
    assert len(ratios) > 590
    # The standard deviation of 600 repeats is known to 3 %.
    assert np.std(ratios) == pytest.approx(np.mean(sigmas), rel=0.12)


def reason(result: DecodedLine | FitFailure) -> str:
    assert isinstance(result, FitFailure)
    return result.reason


def test_what_is_not_clear_is_not_decoded() -> None:
    points, covariance = seen(CODES[1], 5)
    twin = LineCode("twin", (0.0, 4.0, 12.01, 30.0))
    assert "early and twin" in reason(decode_line(points, covariance, (*CODES, twin)))
    assert "no code" in reason(decode_line(points, covariance, (CODES[0], CODES[2])))
    bent = points + np.array([[0.0, 0.0], [3.0, 3.0], [0.0, 0.0], [-3.0, 1.0]])
    assert "off the line" in reason(decode_line(bent, covariance, CODES))
    doubled = points[[0, 0, 2, 3]]
    assert "coincide" in reason(decode_line(doubled, covariance, CODES))


def test_an_impossible_perspective_is_refused() -> None:
    """Places with the code's cross ratio, squeezed as if one end were twice as far away."""
    s = np.array(CODES[1].positions_mm)
    along = 300.0 * s / (1.0 + s / 30.0)
    points = np.column_stack([along, np.zeros(4)])
    failure = decode_line(points, np.tile(SIGMA_PX**2 * np.eye(2), (4, 1, 1)), CODES)
    assert "distances to differ" in reason(failure)


def test_codes_are_found_among_other_points() -> None:
    first, _ = seen(CODES[0], 11)
    second, _ = seen(CODES[1], 12)
    rng = np.random.default_rng(4)
    points = np.concatenate(
        [first, second + np.array([900.0, -150.0]), rng.uniform(0.0, 3000.0, (12, 2))]
    )
    shuffle = rng.permutation(len(points))
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(points), 1, 1))
    lines = find_coded_lines(points[shuffle], covariance, CODES)
    found = {line.name: set(shuffle[line.points].tolist()) for line in lines}
    assert found == {"even": {0, 1, 2, 3}, "early": {4, 5, 6, 7}}


def test_five_points_in_a_row_void_each_other() -> None:
    """Of five even points, the first and the last four both read as the even code."""
    points = np.column_stack([100.0 * np.arange(5), np.full(5, 50.0)])
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (5, 1, 1))
    assert find_coded_lines(points, covariance, CODES[:1]) == ()


def test_a_code_needs_four_increasing_positions() -> None:
    with pytest.raises(InputError, match="four that increase"):
        LineCode("bad", (0.0, 2.0, 1.0, 3.0))
