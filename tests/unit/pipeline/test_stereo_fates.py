# SPDX-License-Identifier: Apache-2.0
"""What two cameras say became of each stripe point, and what a person may choose of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.measure import MeasureOptions, labeller_for
from armscan.reconstruction import points
from armscan.reconstruction.label_stereo import StereoLabeller
from armscan.reconstruction.labels import PointStatus
from armscan.reconstruction.points import MeasuredProfile, measure_points
from armscan.reconstruction.triangulate import LABEL_DEPTHS, DepthRange
from armscan.records.profile import Profile
from rigs.stereo_scenes import Noise, draw_surfaces, expose
from rigs.two_camera_scan import small_head

Pair = tuple[MeasuredProfile, ...]


@pytest.fixture(scope="module")
def sensor() -> SensorCalibration:
    return small_head().calibration()


@pytest.fixture(scope="module")
def profiles() -> tuple[Profile, Profile]:
    rng = np.random.default_rng(1)
    left, right = expose(small_head(), draw_surfaces("steps", rng), Noise(), rng)
    return left.profile, right.profile


def measured(
    profiles: tuple[Profile, Profile],
    sensor: SensorCalibration,
    depths: DepthRange | None = None,
) -> Pair:
    options = MeasureOptions(depths=depths)
    labels = labeller_for(sensor, options).label(profiles)
    return measure_points(labels, sensor, options.accepted_depths(sensor))


def shallow(sensor: SensorCalibration, found: Pair) -> SensorCalibration:
    """The sensor, calibrated to the middle of the depths of what one camera sees alone."""
    alone = found[1].points.points_mm[:, 2]
    limits = (float(np.median(alone)), float(alone.max()) + 50.0)
    sheets = tuple(replace(sheet, depth_range_mm=limits) for sheet in sensor.sheets)
    return replace(sensor, sheets=sheets)


def check(found: Pair) -> None:
    """States are those of the points; a right point is shared where the left one is fused."""
    for one in found:
        is_measured = one.labelled.status == PointStatus.MEASURED
        np.testing.assert_array_equal(np.flatnonzero(is_measured), one.points.row)
        unlabelled = (PointStatus.FLAGGED, PointStatus.AMBIGUOUS, PointStatus.STRAY)
        np.testing.assert_array_equal(
            np.isin(one.labelled.status, unlabelled), one.labelled.sheet == -1
        )
    assert found[0].labelled.count(PointStatus.SHARED) == 0


def test_dropped_pairs_are_inconsistent_in_both_images(
    sensor: SensorCalibration,
    profiles: tuple[Profile, Profile],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind = measured(profiles, sensor)
    monkeypatch.setattr(points, "CONSISTENCY_SIGMAS", 1.0)
    strict = measured(profiles, sensor)
    for found in (kind, strict):
        check(found)
    assert strict[0].labelled.count(PointStatus.INCONSISTENT) > 100
    gone = strict[1].labelled.count(PointStatus.INCONSISTENT)
    assert gone > 0
    # a right point is shared, or falls with its left one: never both, never neither
    assert gone + strict[1].labelled.count(PointStatus.SHARED) == sum(
        kind[1].labelled.count(status) for status in (PointStatus.SHARED, PointStatus.INCONSISTENT)
    )


def test_a_margin_that_was_given_counts_and_what_lies_beyond_is_out_of_depth(
    sensor: SensorCalibration, profiles: tuple[Profile, Profile]
) -> None:
    narrow = shallow(sensor, measured(profiles, sensor))
    given = measured(profiles, narrow, DepthRange(0.0))
    check(given)
    assert sum(one.labelled.count(PointStatus.OUT_OF_DEPTH) for one in given) > 0
    usual = measured(profiles, narrow)
    told = measured(profiles, narrow, LABEL_DEPTHS)
    for one, other in zip(usual, told, strict=True):
        np.testing.assert_array_equal(one.points.points_mm, other.points.points_mm)
    assert len(usual[0].points) > len(given[0].points)


def test_a_stripe_is_of_no_source_that_was_off(
    sensor: SensorCalibration, profiles: tuple[Profile, Profile]
) -> None:
    names = ("A.1", "B.1", "B.2")
    of_two = zip(sensor.sheets, names, strict=True)
    two = replace(sensor, sheets=tuple(replace(one, name=name) for one, name in of_two))
    labeller = StereoLabeller(two)
    every, both, unknown, one = (
        np.concatenate([found.sheet for found in labeller.label(profiles, lasers).profiles])
        for lasers in ((), ("B", "A"), ("Q",), ("A",))
    )
    assert {-1, 0, 1, 2} == set(every.tolist())
    np.testing.assert_array_equal(both, every)
    np.testing.assert_array_equal(unknown, every)
    assert set(one.tolist()) == {-1, 0}
    assert (one[every == 0] == 0).mean() > 0.99


def test_a_chosen_sheet_is_refused_for_two_cameras(sensor: SensorCalibration) -> None:
    assert isinstance(labeller_for(sensor, MeasureOptions()), StereoLabeller)
    with pytest.raises(OptionError, match="two cameras tell each stripe's sheet"):
        labeller_for(sensor, MeasureOptions(sheet="A.1"))
