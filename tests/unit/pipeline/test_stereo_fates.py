# SPDX-License-Identifier: Apache-2.0
"""What two cameras say became of each stripe point, and what a person may choose of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.measure import LitProfile, MeasureOptions
from armscan.pipeline.reconstruct import ByTwoCameras, measurer_for
from armscan.reconstruction.label_single import DepthRange
from armscan.reconstruction.label_stereo import StereoLabelOptions
from armscan.reconstruction.labels import LabelStatus, PointStatus, StereoStatus
from armscan.reconstruction.stereo_points import StereoMeasurement, measure_stereo
from armscan.records.profile import Profile
from rigs.stereo_scenes import Noise, draw_surfaces, expose
from rigs.two_camera_scan import small_head

STRICT = StereoLabelOptions(consistency_sigmas=1.0)
"""Drops many a pair that noise alone explains."""


@pytest.fixture(scope="module")
def sensor() -> SensorCalibration:
    return small_head().calibration()


@pytest.fixture(scope="module")
def profiles() -> tuple[Profile, Profile]:
    rng = np.random.default_rng(1)
    left, right = expose(small_head(), draw_surfaces("steps", rng), Noise(), rng)
    return left.profile, right.profile


def shallow(sensor: SensorCalibration, found: StereoMeasurement) -> SensorCalibration:
    """The sensor, calibrated to the middle of the depths of what one camera sees alone."""
    alone = found.right_points.points_mm[:, 2]
    limits = (float(np.median(alone)), float(alone.max()) + 50.0)
    sheets = tuple(replace(sheet, depth_range_mm=limits) for sheet in sensor.sheets)
    return replace(sensor, sheets=sheets)


def n_of(fate: np.ndarray, wanted: StereoStatus) -> int:
    return int((fate == int(wanted)).sum())


def check(found: StereoMeasurement) -> None:
    """Fates are those of the points and of the counts."""
    left, right, counts = found.left_fate, found.right_fate, found.counts
    for fate, points, named in (
        (left, found.left_points, found.left),
        (right, found.right_points, found.right),
    ):
        measured = np.isin(fate, (int(StereoStatus.FUSED), int(StereoStatus.ALONE)))
        np.testing.assert_array_equal(np.flatnonzero(measured), points.row)
        np.testing.assert_array_equal(fate == int(StereoStatus.UNNAMED), named.sheet == -1)
    assert n_of(left, StereoStatus.FUSED) == counts.n_fused
    assert n_of(left, StereoStatus.ALONE) == counts.n_left_alone
    assert n_of(right, StereoStatus.ALONE) == counts.n_right_alone
    assert n_of(left, StereoStatus.INCONSISTENT) == counts.n_inconsistent
    assert counts.n_out_of_depth == sum(n_of(f, StereoStatus.OUT_OF_DEPTH) for f in (left, right))


def test_dropped_pairs_are_inconsistent_in_both_images(
    sensor: SensorCalibration, profiles: tuple[Profile, Profile]
) -> None:
    kind = measure_stereo(*profiles, sensor)
    strict = measure_stereo(*profiles, sensor, STRICT)
    for found in (kind, strict):
        check(found)
    assert strict.counts.n_inconsistent > 100
    gone = n_of(strict.right_fate, StereoStatus.INCONSISTENT)
    assert gone > 0
    # a right point is taken, or falls with its left one: never both, never neither
    assert gone + n_of(strict.right_fate, StereoStatus.TAKEN) == n_of(
        kind.right_fate, StereoStatus.TAKEN
    ) + n_of(kind.right_fate, StereoStatus.INCONSISTENT)
    left, right = ByTwoCameras(sensor, STRICT).measure([LitProfile(p) for p in profiles])
    assert left.image.count(PointStatus.INCONSISTENT) == strict.counts.n_inconsistent
    assert right.image.count(PointStatus.INCONSISTENT) == gone
    assert right.image.count(PointStatus.SHARED) == n_of(strict.right_fate, StereoStatus.TAKEN)
    assert left.image.count(PointStatus.AMBIGUOUS) == strict.left.count(LabelStatus.AMBIGUOUS)


def test_a_margin_that_was_given_counts_and_what_lies_beyond_is_out_of_depth(
    sensor: SensorCalibration, profiles: tuple[Profile, Profile]
) -> None:
    narrow = shallow(sensor, measure_stereo(*profiles, sensor))
    seen = [LitProfile(profile) for profile in profiles]
    given = MeasureOptions(depths=DepthRange(0.0))
    left, right = measurer_for(narrow, given).measure(seen)
    found = measure_stereo(*profiles, narrow, StereoLabelOptions(depths=DepthRange(0.0)))
    check(found)
    n_out = [one.image.count(PointStatus.OUT_OF_DEPTH) for one in (left, right)]
    assert sum(n_out) == found.counts.n_out_of_depth > 0
    np.testing.assert_array_equal(left.points.points_mm, found.left_points.points_mm)
    usual = measurer_for(narrow, MeasureOptions()).measure(seen)
    own = measure_stereo(*profiles, narrow)
    for one, points in zip(usual, (own.left_points, own.right_points), strict=True):
        np.testing.assert_array_equal(one.points.points_mm, points.points_mm)
    assert len(own.left_points.row) > len(found.left_points.row)


def test_a_chosen_sheet_is_refused_for_two_cameras(sensor: SensorCalibration) -> None:
    with pytest.raises(OptionError, match="two cameras tell each stripe's sheet"):
        measurer_for(sensor, MeasureOptions(sheet="A.1"))
