# SPDX-License-Identifier: Apache-2.0
"""Names by the second camera on scenes with truth, and what is dropped."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import IntArray
from armscan.reconstruction.label_stereo import StereoLabelOptions, log_ratio
from armscan.reconstruction.labels import LabelStatus
from armscan.reconstruction.stereo_points import StereoMeasurement, measure_stereo
from armscan.reconstruction.triangulate import sensor_covariance
from armscan.records.profile import Profile
from rigs.placing_rig import scanner
from rigs.stereo_head import StereoHead
from rigs.stereo_scenes import KINDS, Noise, SeenProfile, draw_surfaces, expose

MOST_WRONG = 0.001
LEAST_NAMED = 0.97
DRIFT_PX = 1.5
QUIET = Noise()


@cache
def head() -> StereoHead:
    return StereoHead.thesis()


@cache
def measured(
    kind: str, seed: int, noise: Noise = QUIET
) -> tuple[StereoMeasurement, SeenProfile, SeenProfile]:
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    sensor = head().drawn_calibration(rng)
    left, right = expose(head(), draw_surfaces(kind, rng), noise, rng)
    return measure_stereo(left.profile, right.profile, sensor), left, right


def n_wrong(sheet: IntArray, truth: SeenProfile) -> int:
    return int(((sheet >= 0) & (sheet != truth.sheet)).sum())


@pytest.mark.parametrize("kind", KINDS)
def test_shared_points_get_their_sheets_and_hardly_any_a_wrong_one(kind: str) -> None:
    shared = right_names = wrong = named = 0
    for seed in (0, 1):
        found, left, right = measured(kind, seed)
        both = left.is_shared & left.profile.is_accepted
        shared += int(both.sum())
        right_names += int((both & (found.left.sheet == left.sheet)).sum())
        wrong += n_wrong(found.left.sheet, left) + n_wrong(found.right.sheet, right)
        named += found.left.count(LabelStatus.NAMED) + found.right.count(LabelStatus.NAMED)
    assert right_names >= LEAST_NAMED * shared
    assert wrong <= MOST_WRONG * named


def test_stray_lines_get_no_name() -> None:
    found, left, _ = measured("plate", 3, Noise(0.15, 12))
    stray = (left.sheet == -1) & left.profile.is_accepted
    assert stray.sum() > 300
    assert (found.left.sheet[stray] == -1).mean() > 0.98
    both = left.is_shared & left.profile.is_accepted
    assert (found.left.sheet[both] == left.sheet[both]).mean() > 0.9


def test_a_drift_beyond_the_calibration_is_found_with_its_sign_and_warned_of() -> None:
    still, _, _ = measured("waves", 0)
    moved, left, _ = measured("waves", 0, Noise(shift_px=(0.0, DRIFT_PX)))
    difference = moved.epipolar_offset_px - still.epipolar_offset_px
    # the epipolar lines are some degrees off the rows
    assert difference == pytest.approx(DRIFT_PX, abs=0.1)
    assert not still.warnings
    assert "calibrate the two cameras again" in moved.warnings[0]
    assert n_wrong(moved.left.sheet, left) == 0


def test_points_of_a_plate_err_as_they_say() -> None:
    found, left, right = measured("plate", 1)
    sensor_rng = np.random.default_rng([1, 0])
    sensor = head().drawn_calibration(sensor_rng)
    for points, truth in ((found.left_points, left), (found.right_points, right)):
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
    counts = found.counts
    assert counts.n_fused == int(found.is_fused.sum())
    assert counts.n_fused + counts.n_left_alone == len(found.left_points.row)
    assert counts.n_right_alone == len(found.right_points.row)
    assert len(np.unique(found.left_points.row)) == len(found.left_points.row)
    named = found.left.sheet[found.left_points.row]
    assert (named == found.left_points.sheet).all()
    total = sum(found.left.count(fate) for fate in LabelStatus)
    assert total == len(left.profile)
    assert len(found.right.sheet) == len(right.profile)


def test_no_stripes_give_no_points() -> None:
    none = Profile.empty(source="none")
    _, left, _ = measured("plate", 0)
    for pair in ((none, none), (left.profile, none), (none, left.profile)):
        found = measure_stereo(*pair, head().calibration())
        assert len(found.left_points.row) == 0
        assert len(found.right_points.row) == 0


def test_one_camera_is_refused() -> None:
    sensor = scanner().sensor
    assert sensor is not None
    with pytest.raises(InputError, match="one camera"):
        measure_stereo(Profile.empty(source="a"), Profile.empty(source="b"), sensor)


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(OptionError, match="runner_up"):
        StereoLabelOptions(runner_up=1.5)
    with pytest.raises(OptionError, match="reach_px"):
        StereoLabelOptions(reach_px=0.0)


def test_log_ratio_is_that_of_a_seen_gaussian_against_an_even_spread() -> None:
    ratio = log_ratio(np.array([0.0, 50.0]), np.array([0.1, 0.1]), 80.0, 0.75)
    peak = 1.0 / (0.1 * np.sqrt(2.0 * np.pi))
    assert ratio == pytest.approx([np.log(0.25 + 0.75 * 80.0 * peak), np.log(0.25)])
