# SPDX-License-Identifier: Apache-2.0
"""What the other segments say of the cameras' offset, against solving once a segment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction import epipolar
from armscan.reconstruction.epipolar import (
    FLOOR_PX,
    OffsetEquations,
    Residuals,
    RightStripes,
    find_crossings,
    left_out_scores,
    no_offset,
    project_on_sheets,
)
from rigs.stereo_head import StereoHead
from rigs.stereo_scenes import Noise, draw_surfaces, expose

SHIFTED_PX = 1.5


def test_scores_are_those_of_solving_without_each_segment() -> None:
    """Its rows taken out of the normal equations, and the rest solved: exact.

    One segment lies 1.5 px off, one has one point and one has two, and some have no say. Scores of
    a solution in which the segment has its own say are lower by up to a third and more.
    """
    rng = np.random.default_rng(4)
    head = StereoHead.thesis()
    sensor = head.drawn_calibration(rng)
    left, right = expose(head, draw_surfaces("waves", rng), Noise(), rng)
    rows = np.flatnonzero((left.sheet >= 0) & left.profile.is_accepted)[::9]
    projected = project_on_sheets(left.profile.points_px[rows], left.sheet[rows], sensor)
    crossings = find_crossings(
        projected,
        left.profile.normals_px[rows],
        left.profile.sigma_px[rows],
        RightStripes.of(right.profile),
        sensor,
    )
    rows = rows[crossings.at]
    _, segment = np.unique(left.profile.segment[rows], return_inverse=True)
    counts = np.cumsum(segment[:, None] == segment, axis=0)[
        np.arange(len(rows)), np.arange(len(rows))
    ]
    most = np.array([1, 2])
    kept = np.flatnonzero((segment > 1) | (counts <= most[np.minimum(segment, 1)]))
    crossings, segment = crossings.select(kept), segment[kept]
    off = segment == 3
    crossings = replace(crossings, residual_px=crossings.residual_px + SHIFTED_PX * off)
    is_used = segment % 4 != 2
    residuals = Residuals.of(crossings, sensor)
    prior = no_offset(sensor)
    equations = OffsetEquations.of(residuals, prior, is_used)
    scores = left_out_scores(residuals, equations, np.arange(len(segment)), segment)

    whitened = np.zeros((len(segment), prior.factor.shape[1]))
    for row, (sheet, by_errors) in enumerate(
        zip(residuals.sheet, residuals.by_errors, strict=True)
    ):
        whitened[row] = by_errors @ prior.factor[residuals.columns[sheet]]
    wanted_all = -residuals.px
    all_weight = equations.weight / equations.sigma**2
    whole = np.eye(whitened.shape[1]) + (whitened.T * all_weight) @ whitened
    np.testing.assert_allclose(equations.information, whole, rtol=1e-9, atol=1e-6)
    right_side = whitened.T @ (all_weight * wanted_all)
    naive, own = np.zeros(len(scores)), np.zeros(len(scores))
    for b in np.unique(segment):
        at = segment == b
        design, wanted = whitened[at], wanted_all[at]
        sigma, weight = equations.sigma[at], equations.weight[at] / equations.sigma[at] ** 2
        others = whole - (design.T * weight) @ design
        state = np.linalg.solve(others, right_side - design.T @ (weight * wanted))
        covariance = design @ np.linalg.solve(others, design.T) + np.diag(sigma**2)
        naive[b] = _of_shape(wanted - design @ state, covariance)
        covariance = design @ np.linalg.solve(whole, design.T) + np.diag(sigma**2)
        own[b] = _of_shape(wanted - design @ np.linalg.solve(whole, right_side), covariance)
    assert set(np.bincount(segment)) >= {1, 2}
    assert np.bincount(segment).max() > 10
    np.testing.assert_allclose(scores, naive, rtol=1e-8, atol=1e-8)
    assert np.abs(own / naive - 1.0).max() > 0.3
    assert np.argmax(scores) == 3


def _of_shape(missed: FloatArray, covariance: FloatArray) -> float:
    """Chi-square, over their count, of the constant, slope and bend that fit what is missed."""
    place = np.linspace(-1.0, 1.0, len(missed))
    shape = np.vander(place, min(len(missed), 3), increasing=True)
    fitted, *_ = np.linalg.lstsq(shape, missed, rcond=None)
    gain, *_ = np.linalg.lstsq(shape, np.eye(len(missed)), rcond=None)
    spread = gain @ covariance @ gain.T
    spread[0, 0] += FLOOR_PX**2
    return float(fitted @ np.linalg.solve(spread, fitted)) / len(fitted)


def test_the_moments_that_are_kept_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        epipolar._moments(5)[0, 0] = 1.0
