# SPDX-License-Identifier: Apache-2.0
"""The hand that leads the head: speed, time, arm samples, blur."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.devices.sources import TwinScene
from armscan.errors import InputError
from armscan.records.recording import NO_TRIGGER
from armscan.simulation.arm.hand import (
    CAMERA_CLOCK_NS,
    HandTremor,
    HeadOrientation,
    ScanPass,
    scan_passes,
    sweep,
)
from armscan.simulation.head import sheet_middle_mm
from armscan.simulation.instrument import SAMPLE_NS
from armscan.simulation.twin import build_twin
from rigs.traced_workpiece import BORE_AT, NAMES, seen

TWIN = build_twin(seed=2)
TOOLS = TWIN.instrument


def _middle_of_stripe(joints: np.ndarray) -> np.ndarray:
    """(N, 3) where the sheet's middle ray is 137 mm deep, in Base."""
    rotations, translations = TOOLS.arm.true.transforms(joints)
    mount = TOOLS.head.tool_from_sensor
    in_tool = mount.rotation @ sheet_middle_mm(TOOLS.head, 137.0) + mount.translation_mm
    return translations + rotations @ in_tool


def test_a_stroke_has_a_persons_speed_and_ends_where_it_should():
    stroke = scan_passes("plate", TOOLS.head, TOOLS.fixtures)[0]
    hand = TOOLS.mechanics.hand
    done = sweep(stroke, TOOLS.head, TOOLS.arm.true, hand, np.random.default_rng(3))
    assert len(done.exposure_t_ns) == stroke.n_exposures
    assert (done.exposure_t_ns % CAMERA_CLOCK_NS == 0).all()
    assert (np.diff(done.exposure_t_ns) > 0).all()
    times = np.arange(0.0, 1e-9 * done.exposure_t_ns[-1], 0.01)
    way = _middle_of_stripe(done.joints(times))
    speed = np.linalg.norm(np.diff(way, axis=0), axis=1) / 0.01
    assert speed.min() > 18.0 and speed.max() < 82.0
    assert speed.std() > 2.0
    first, last = _middle_of_stripe(done.joints(1e-9 * done.exposure_t_ns[[0, -1]]))
    strays = 4.0 * np.hypot(hand.aside_mm, hand.depth_mm)
    assert np.linalg.norm(first - stroke.start_mm) < strays
    assert np.linalg.norm(last - stroke.end_mm) < strays


def test_a_steady_hand_follows_the_line_at_even_speed():
    here = TOOLS.fixtures.base_from_plate
    start = here.translation_mm
    end = start + 60.0 * here.rotation[:, 0]
    stroke = ScanPass(here.rotation, start, end, HeadOrientation(-20.0, 0.0, 0.0, 137.0), 40.0, 4)
    steady = HandTremor(tilt_deg=0.0, depth_mm=0.0, aside_mm=0.0, speed=0.0)
    done = sweep(stroke, TOOLS.head, TOOLS.arm.true, steady, np.random.default_rng(1))
    times = np.linspace(0.0, 1.5, 31)
    wanted = start + np.outer(40.0 * times, here.rotation[:, 0])
    # Between knots the joints are cubic: the line is kept to micrometres.
    np.testing.assert_allclose(_middle_of_stripe(done.joints(times)), wanted, atol=0.005)


def test_a_stroke_too_short_for_its_images_is_refused():
    here = TOOLS.fixtures.base_from_plate
    end = here.translation_mm + 5.0 * here.rotation[:, 0]
    aim = HeadOrientation(0.0, 0.0, 0.0, 137.0)
    stroke = ScanPass(here.rotation, here.translation_mm, end, aim, 40.0, 50)
    with pytest.raises(InputError, match="50 images"):
        sweep(stroke, TOOLS.head, TOOLS.arm.true, HandTremor(), np.random.default_rng(1))


@pytest.mark.parametrize(("scene", "count"), [("plate", 24), ("ball", 70), ("steps", 24)])
def test_arm_samples_and_exposures_share_clock_and_triggers(scene: TwinScene, count: int):
    scan = TWIN.scan(scene)
    arm = scan.arm
    assert arm is not None and arm.trigger_ids is not None
    assert len(scan.rows) == count
    assert arm.is_known.all()
    triggered = arm.trigger_ids != NO_TRIGGER
    rows = scan.rows
    assert arm.trigger_ids[triggered].tolist() == [row.trigger_id for row in rows]
    assert arm.t_ns[triggered].tolist() == [row.t_ns for row in rows]
    # On its own clock the arm samples every 4 ms, but for the pauses between strokes.
    own = np.diff(arm.t_ns[~triggered])
    pauses = own != SAMPLE_NS
    assert 1 <= pauses.sum() <= 6
    assert own[pauses].min() > 1_000_000_000
    # Around each exposure there are samples on both sides, to interpolate between.
    for row in rows:
        before, after = (arm.t_ns[~triggered] <= row.t_ns, arm.t_ns[~triggered] >= row.t_ns)
        assert row.t_ns - arm.t_ns[~triggered][before][-1] <= SAMPLE_NS
        assert arm.t_ns[~triggered][after][0] - row.t_ns <= SAMPLE_NS


def test_reported_poses_are_the_true_ones_but_for_the_arms_errors():
    scan = TWIN.scan("plate")
    arm = scan.arm
    assert arm is not None and arm.trigger_ids is not None and arm.joints_rad is not None
    mount = TOOLS.head.tool_from_sensor
    errors = []
    for sample in np.flatnonzero(arm.trigger_ids != NO_TRIGGER):
        true = scan.shots[int(arm.trigger_ids[sample]) - 1].base_from_sensor
        said = arm.pose(int(sample)) @ mount
        point = np.array([0.0, 0.0, 137.0])
        errors.append(
            (said.rotation - true.rotation) @ point + said.translation_mm - true.translation_mm
        )
        own = TOOLS.arm.nominal.pose(arm.joints_rad[sample])
        np.testing.assert_allclose(own.matrix, arm.pose(int(sample)).matrix, atol=1e-12)
    size = np.linalg.norm(errors, axis=1)
    assert 0.002 < np.sqrt(np.mean(size**2)) < 0.03


def test_what_moves_during_an_exposure_is_in_its_poses():
    scan = TWIN.scan("plate")
    shot = scan.shots[3]
    first, last = (pose.translation_mm for pose in shot.sub_poses)
    # Two equal parts with the mean square of an even motion lie 0.577 of its length apart.
    moved = float(np.linalg.norm(last - first)) / 0.57735
    assert 18e-3 < moved < 90e-3
    middle = 0.5 * (first + last)
    np.testing.assert_allclose(middle, shot.base_from_sensor.translation_mm, atol=1e-4)


def test_the_ball_is_seen_from_many_sides():
    scan = TWIN.scan("ball")
    axes = np.array([shot.base_from_sensor.rotation[:, 2] for shot in scan.shots])
    middle = axes.reshape(7, 10, 3).mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    between = np.degrees(np.arccos(np.clip(middle @ middle.T, -1.0, 1.0)))[np.triu_indices(7, 1)]
    assert between.min() > 10.0
    assert between.max() > 45.0
    tilt = np.degrees(np.arccos(-axes[:, 2]))
    assert 40.0 < tilt.max() < 65.0


def test_the_bore_is_seen_by_many_exposures_from_all_sides():
    """A diameter of the few that happen to look in errs by what the arm errs at each of them."""
    twin = build_twin("thesis-single", seed=3)
    scan, part = twin.scan("workpiece"), twin.truth.base_from_workpiece.inverse()
    light = scan.head.lasers[0]
    fan = light.rays(np.linspace(-light.half_angle_rad, light.half_angle_rad, 400))
    sides = []
    for row in scan.rows:
        pose = part @ scan.true_pose(row.index)
        points, what = seen(
            pose.apply(light.source_mm[None])[0], pose.translation_mm, pose.rotate(fan)
        )
        wall = points[what == NAMES.index("bore"), :2] - BORE_AT
        if len(wall) >= 5:
            sides.append(np.degrees(np.arctan2(wall[:, 1], wall[:, 0])) % 360.0 // 45.0)
    assert len(sides) >= 30
    n_side = np.bincount(np.concatenate(sides).astype(np.int64), minlength=8)
    assert n_side.min() > 30, n_side


def test_short_ways_over_a_bore_are_those_of_the_workpiece_alone():
    """A part in its place has no bore there, and is scanned in lanes as before."""
    block = np.array([[[0, 0, 0], [60, 0, 0], [60, 40, 0]], [[0, 0, 9], [60, 0, 9], [60, 40, 9]]])
    for part_mm, n_short in ((None, 4), (block.astype(float), 0)):
        tools = build_twin("thesis-single", seed=3, part_mm=part_mm).instrument
        lengths = [one.length_mm for one in scan_passes("workpiece", tools.head, tools.fixtures)]
        assert sum(length < 20.0 for length in lengths) == n_short
        assert len(lengths) == 5 + n_short
