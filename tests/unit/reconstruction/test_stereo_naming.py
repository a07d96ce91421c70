# SPDX-License-Identifier: Apache-2.0
"""Names by the second camera on scenes with truth, and what is dropped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import IntArray
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.measure import MeasureOptions, labeller_for
from armscan.pipeline.scan import measure_scan
from armscan.pipeline.simulate import SimulatedPart, TwinName
from armscan.pipeline.truth import naming_errors, true_names
from armscan.reconstruction.epipolar import EpipolarOffset
from armscan.reconstruction.label_stereo import StereoLabeller, log_ratio
from armscan.reconstruction.labels import LabelledInstant, PointStatus
from armscan.reconstruction.points import MeasuredProfile, measure_points
from armscan.reconstruction.triangulate import LABEL_DEPTHS, sensor_covariance
from armscan.records.profile import Profile
from rigs.placing_rig import scanner
from rigs.stereo_head import StereoHead
from rigs.stereo_scenes import KINDS, Noise, SeenProfile, draw_surfaces, expose
from rigs.true_scanner import true_scanner

MOST_WRONG = 0.001
LEAST_NAMED = 0.97
DRIFT_PX = 1.5
QUIET = Noise()


@cache
def head() -> StereoHead:
    return StereoHead.thesis()


@dataclass(frozen=True)
class Found:
    """Labels of one instant and the points of each camera."""

    labels: LabelledInstant
    measured: tuple[MeasuredProfile, ...]

    @property
    def offset(self) -> EpipolarOffset:
        assert self.labels.offset is not None
        return self.labels.offset

    def n_labelled(self) -> int:
        return sum(one.count(PointStatus.MEASURED) for one in self.labels.profiles)


def measure(sensor: SensorCalibration, left: Profile, right: Profile) -> Found:
    labeller = StereoLabeller(sensor)
    labels = labeller.label([left, right])
    return Found(labels, measure_points(labels, sensor, labeller.depths))


@cache
def measured(kind: str, seed: int, noise: Noise = QUIET) -> tuple[Found, SeenProfile, SeenProfile]:
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    sensor = head().drawn_calibration(rng)
    left, right = expose(head(), draw_surfaces(kind, rng), noise, rng)
    return measure(sensor, left.profile, right.profile), left, right


def n_wrong(sheet: IntArray, truth: SeenProfile) -> int:
    return int(((sheet >= 0) & (sheet != truth.sheet)).sum())


@pytest.mark.parametrize("kind", KINDS)
def test_shared_points_get_their_sheets_and_hardly_any_a_wrong_one(kind: str) -> None:
    """Over eight heads: one line of 88 may be dropped as a whole where its depth cannot be told."""
    shared = right_names = wrong = named = 0
    for seed in range(8):
        found, left, right = measured(kind, seed)
        both = left.is_shared & left.profile.is_accepted
        shared += int(both.sum())
        in_left, in_right = found.labels.profiles
        right_names += int((both & (in_left.sheet == left.sheet)).sum())
        wrong += n_wrong(in_left.sheet, left) + n_wrong(in_right.sheet, right)
        named += found.n_labelled()
    assert right_names >= LEAST_NAMED * shared
    assert wrong <= MOST_WRONG * named


def test_a_plate_nearer_than_all_sheets_were_calibrated_has_no_wrong_names() -> None:
    """At 134 to 149 mm, where 150 to 162 mm were calibrated.

    Where a sheet was looked for over half of these depths beyond them, 900 points bore the name of
    the line beside. What lies farther beyond than that is still no point.
    """
    rng = np.random.default_rng([5, KINDS.index("plate")])
    drawn = head().drawn_calibration(rng)
    sensor = replace(
        drawn, sheets=tuple(replace(one, depth_range_mm=(150.0, 162.0)) for one in drawn.sheets)
    )
    left, right = expose(head(), draw_surfaces("plate", rng), QUIET, rng)
    labels = labeller_for(sensor, MeasureOptions()).label([left.profile, right.profile])
    named = labels.profiles[0].sheet
    assert n_wrong(named, left) == 0
    assert (named >= 0).mean() > LEAST_NAMED
    points = measure_points(labels, sensor, LABEL_DEPTHS)[0].points
    assert points.points_mm[:, 2].min() > 143.5


def test_a_sheet_that_was_calibrated_in_few_depths_is_looked_for_in_those_of_all() -> None:
    """One of eleven at 152 to 154 mm, the others at 118 to 162, and a plate before its depths."""
    rng = np.random.default_rng([5, KINDS.index("plate")])
    drawn = head().drawn_calibration(rng)
    narrow = 5
    sheets = [replace(one, depth_range_mm=(118.0, 162.0)) for one in drawn.sheets]
    sheets[narrow] = replace(sheets[narrow], depth_range_mm=(152.0, 154.0))
    sensor = replace(drawn, sheets=tuple(sheets))
    left, right = expose(head(), draw_surfaces("plate", rng), QUIET, rng)
    labels = labeller_for(sensor, MeasureOptions()).label([left.profile, right.profile])
    named = labels.profiles[0].sheet
    assert n_wrong(named, left) == 0
    own = (left.sheet == narrow) & left.is_shared
    assert own.sum() > 500
    assert (named[own] == narrow).mean() > LEAST_NAMED


def test_a_line_that_goes_on_as_the_next_one_behind_an_edge_does_not_take_its_name() -> None:
    """Rendered: line 8 on the floor goes on as line 7 on a block, with a step of 0.2 px.

    The right camera sees the floor's line only in part. As one line, 249 points bore the name of
    the other.
    """
    twin = TwinName("thesis-multi", "thesis", 502).build()
    whole, sensor = twin.scan("steps"), true_scanner(twin)
    scan = measure_scan(SimulatedPart(whole, (28, 29)), sensor)
    found = naming_errors(scan, whole, true_names(sensor.sensor, twin.truth.sheet_points_mm))
    assert found.n_named > 5000
    assert found.n_wrong == 0


def test_stray_lines_get_no_name() -> None:
    found, left, _ = measured("plate", 3, Noise(0.15, 12))
    stray = (left.sheet == -1) & left.profile.is_accepted
    assert stray.sum() > 300
    sheet = found.labels.profiles[0].sheet
    assert (sheet[stray] == -1).mean() > 0.98
    both = left.is_shared & left.profile.is_accepted
    assert (sheet[both] == left.sheet[both]).mean() > 0.9


def test_a_drift_beyond_the_calibration_is_found_with_its_sign_and_warned_of() -> None:
    still, _, _ = measured("waves", 0)
    moved, left, _ = measured("waves", 0, Noise(shift_px=(0.0, DRIFT_PX)))
    difference = moved.offset.offset_px - still.offset.offset_px
    # the epipolar lines are some degrees off the rows
    assert difference == pytest.approx(DRIFT_PX, abs=0.1)
    assert not still.measured[0].warnings
    assert "calibrate the two cameras again" in moved.measured[0].warnings[0]
    assert n_wrong(moved.labels.profiles[0].sheet, left) == 0


def test_points_of_a_plate_err_as_they_say() -> None:
    found, left, right = measured("plate", 1)
    sensor_rng = np.random.default_rng([1, 0])
    sensor = head().drawn_calibration(sensor_rng)
    for one, truth in zip(found.measured, (left, right), strict=True):
        points = one.points
        own = points.sheet == truth.sheet[points.row]
        error = points.points_mm - truth.points_mm[points.row]
        normal = _plane_normal(truth.points_mm)
        across = (error @ normal)[own]
        spread = np.zeros(len(points.row))
        for k in np.unique(points.sheet):
            at = points.sheet == k
            by = np.einsum("i,nij->nj", normal, points.by_sensor[at])
            noise = np.einsum("i,nij->nj", normal, points.noise_mm[at])
            joint = sensor_covariance(sensor, int(k))
            spread[at] = np.einsum("nj,jk,nk->n", by, joint, by) + (noise**2).sum(axis=1)
        # the calibration's error is one draw for all points
        assert np.sqrt((across**2 / spread[own]).mean()) < 3.0


def _plane_normal(points: np.ndarray) -> np.ndarray:
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]


def test_each_point_is_counted_once() -> None:
    found, left, right = measured("steps", 1)
    for one, seen in zip(found.measured, (left, right), strict=True):
        status, row = one.labelled.status, one.points.row
        assert len(status) == len(seen.profile)
        np.testing.assert_array_equal(np.flatnonzero(status == PointStatus.MEASURED), row)
        assert (one.labelled.sheet[row] == one.points.sheet).all()
    shared = found.measured[1].labelled.status == PointStatus.SHARED
    is_fused = found.measured[0].points.noise_mm[:, :, 1].any(axis=1)
    assert shared.sum() > 0.5 * is_fused.sum() > 0
    assert not (found.measured[0].labelled.status == PointStatus.SHARED).any()


def test_no_stripes_give_no_points() -> None:
    none = Profile.empty(source="none")
    _, left, _ = measured("plate", 0)
    for pair in ((none, none), (left.profile, none), (none, left.profile)):
        found = measure(head().calibration(), *pair)
        assert [len(one.points) for one in found.measured] == [0, 0]


def test_one_camera_is_refused() -> None:
    sensor = scanner().sensor
    assert sensor is not None
    with pytest.raises(InputError, match="one camera"):
        measure(sensor, Profile.empty(source="a"), Profile.empty(source="b"))


def test_log_ratio_is_that_of_a_seen_gaussian_against_an_even_spread() -> None:
    ratio = log_ratio(np.array([0.0, 50.0]), np.array([0.1, 0.1]), 80.0)
    peak = 1.0 / (0.1 * np.sqrt(2.0 * np.pi))
    assert ratio == pytest.approx([np.log(0.25 + 0.75 * 80.0 * peak), np.log(0.25)])
