# SPDX-License-Identifier: Apache-2.0
"""Statistics of deviations: hand-computed values, an oracle, and their definitions in words."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from armscan.errors import InputError
from armscan.inspection.results import (
    WITHIN_MM,
    describe_deviations,
    histogram,
    narrowest_shell_mm,
    within_key,
)


def test_statistics_of_four_values_by_hand() -> None:
    found = describe_deviations(
        np.array([-0.03, 0.01, 0.04, 0.06]), "nominal", "a plane", "four points"
    )
    assert found.value("mean_mm") == pytest.approx(0.02)
    # deviations from the mean: -0.05 -0.01 0.02 0.04; squares sum to 0.0046
    assert found.value("std_mm") == pytest.approx((0.0046 / 3) ** 0.5)
    # squares: 9 1 16 36 (1e-4) sum to 62e-4
    assert found.value("rms_mm") == pytest.approx((0.0062 / 4) ** 0.5)
    assert found.value("range_mm") == pytest.approx(0.09)
    # ceil(0.95 * 4) = 4 points: all of them
    assert found.value("d95_mm") == pytest.approx(0.09)
    assert [found.value(within_key(limit)) for limit in WITHIN_MM] == [50.0, 75.0, 100.0]
    assert {item.reference for item in found.statistics} == {"nominal"}
    for item in found.statistics:
        assert "from a plane, four points" in item.definition
        assert item.definition.endswith(item.formula)
    assert "divided by n - 1 = 3" in found.statistics[1].definition
    assert "divided by n = 4" in found.statistics[2].definition


def test_statistics_agree_with_scipy() -> None:
    values = np.random.default_rng(3).normal(0.002, 0.02, 5001)
    found = describe_deviations(values, "fitted", "x", "y")
    oracle = stats.describe(values)
    assert found.value("mean_mm") == pytest.approx(oracle.mean, rel=1e-12)
    assert found.value("std_mm") == pytest.approx(oracle.variance**0.5, rel=1e-12)
    assert found.value("range_mm") == pytest.approx(oracle.minmax[1] - oracle.minmax[0], rel=1e-12)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60))
def test_the_narrowest_shell_is_that_of_a_search_over_all_shells(values: list[float]) -> None:
    """Every pair of values bounds a shell; the narrowest that holds 95 % is wanted."""
    d = np.array(values)
    widths = [
        high - low
        for low in values
        for high in values
        if high >= low and ((d >= low) & (d <= high)).sum() * 100 >= 95 * len(d)
    ]
    assert narrowest_shell_mm(d) == pytest.approx(min(widths), abs=1e-15)


def test_twenty_points_lose_one_to_the_shell() -> None:
    """0.95 * 20 is not a whole number in binary: the outlier must be dropped all the same."""
    values = np.append(np.arange(19) / 1000.0, 5.0)
    assert narrowest_shell_mm(values) == pytest.approx(0.018)


def test_no_points_give_no_numbers() -> None:
    found = describe_deviations(np.zeros(0), "fitted", "x", "no points")
    assert all(np.isnan(item.value) for item in found.statistics)


def test_a_histogram_counts_what_lies_beyond_it() -> None:
    values = np.array([-9.0, -0.09, -0.01, 0.0, 0.01, 0.05, 8.0, 9.0])
    found = histogram(values, 0.1, 5)
    assert found.counts.tolist() == [1, 0, 3, 1, 0]
    assert (found.n_below, found.n_above) == (1, 2)
    assert int(found.counts.sum()) + found.n_below + found.n_above == len(values)
    assert all(b - a == pytest.approx(0.04) for a, b in pairwise(found.edges_mm))
    with pytest.raises(InputError, match=r"0\.0 mm"):
        histogram(values, 0.0)
