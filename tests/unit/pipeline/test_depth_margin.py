# SPDX-License-Identifier: Apache-2.0
"""The user's depth margin reaches the labels of crossed sheets, not only the gate behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.pipeline.measure import (
    MeasureOptions,
    SheetDepths,
    labeller_for,
    measurement_warnings,
)
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.labels import PointStatus
from armscan.reconstruction.points import MeasuredProfile, measure_points
from armscan.reconstruction.triangulate import LABEL_DEPTHS, DepthRange
from armscan.records.profile import Profile
from rigs.cross_rig import camera, light_sheet, sensor
from rigs.sheet_rig import make_profile

SENSOR = sensor()
LOW_MM, HIGH_MM = SENSOR.sheets[0].depth_range_mm
WIDTH_MM = HIGH_MM - LOW_MM


def stripe_of_a(beyond: float) -> Profile:
    """A's stripe on a plate beyond the calibrated range by this part of the range's width."""
    sheet = light_sheet("A")
    depth_mm = HIGH_MM + beyond * WIDTH_MM
    down = (depth_mm - sheet.origin_mm[2]) / sheet.axes[1, 2]
    along = np.arange(-4.0, 4.0, 0.04)[:, None]
    points = sheet.origin_mm + along * sheet.axes[0] + down * sheet.axes[1]
    pixels = camera().project(points)
    tangent = np.gradient(pixels, axis=0)
    normals = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return make_profile("plate", [(pixels, normals)], 0.1)


def measured(beyond: float, depths: DepthRange | None) -> MeasuredProfile:
    options = MeasureOptions(depths=depths)
    labeller = labeller_for(SENSOR, options, is_scan=True)
    assert isinstance(labeller, CrossLabeller)
    labels = labeller.label([stripe_of_a(beyond)], ("A",))
    (found,) = measure_points(labels, SENSOR, options.accepted_depths(SENSOR))
    return found


@pytest.mark.parametrize("beyond", [0.2, 0.8])
def test_a_stripe_that_the_margin_lets_in_is_labelled_and_measured(beyond: float) -> None:
    found = measured(beyond, DepthRange(1.0))
    n = len(found.labelled.profile)
    assert found.labelled.count(PointStatus.MEASURED) == n
    assert len(found.points) == n
    assert (found.points.sheet == 0).all()


def test_what_lies_beyond_the_margin_is_out_of_depth_and_the_margin_is_hinted_at() -> None:
    found = measured(0.8, DepthRange(0.3))
    assert found.labelled.count(PointStatus.OUT_OF_DEPTH) == len(found.labelled.profile)
    assert len(found.points) == 0
    told = measurement_warnings([found.labelled.counts], SheetDepths.of(SENSOR), SENSOR)
    assert any("--depth-margin" in text for text in told)


def test_points_that_several_sheets_may_have_drawn_are_told_of_where_they_are_many() -> None:
    """A user who never lights a laser alone otherwise sees a thin cloud and no reason."""
    counts = measured(0.2, DepthRange(1.0)).labelled.counts
    for share, is_told in ((0.2, False), (0.3, True)):
        n = round(share * len(counts))
        of_status = {PointStatus.MEASURED: len(counts) - n, PointStatus.AMBIGUOUS: n}
        some = replace(counts, by_status=tuple(of_status.get(one, 0) for one in PointStatus))
        told = measurement_warnings([some], SheetDepths.of(SENSOR), SENSOR)
        assert any(text.startswith(f"{n} points, 30 %") for text in told) == is_told


def test_without_a_margin_labels_look_further_than_points_are_kept() -> None:
    """The one place of the defaults: 0.5 for labels, the calibrated depths for points."""
    found = measured(0.2, None)
    assert LABEL_DEPTHS.margin > 0.2
    assert (found.labelled.sheet == 0).all()
    assert found.labelled.count(PointStatus.OUT_OF_DEPTH) == len(found.labelled.profile)
    beyond = measured(0.8, None).labelled
    assert beyond.count(PointStatus.OUT_OF_DEPTH) == len(beyond.profile)
    assert set(beyond.sheet.tolist()) == {-1}
