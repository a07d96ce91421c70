# SPDX-License-Identifier: Apache-2.0
"""Streams of a rig brought together live, and again from the tables that they leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.devices.matching import InstantMatcher, arm_track
from armscan.devices.protocols import ArmFlag, ArmSample, Frame, LaserEvent
from armscan.geometry.poses import Pose
from armscan.reconstruction.sync import PoseStatus, exposure_poses
from armscan.records.recording import ExposureRow

IMAGE = np.zeros((1, 1), dtype=np.uint8)
LATENCY_NS = -4_000_000


def true_pose(t_s):
    place = np.array([30 * np.sin(2 * t_s), 20 * np.cos(1.3 * t_s), 100 + 8 * np.sin(5 * t_s)])
    return Pose.from_vectors([0.2 * np.sin(t_s), 0.1, 0.3 * np.cos(0.7 * t_s)], place)


class Rig:
    """Two streams with clocks, delays and faults of their own, in the order of arrival."""

    def __init__(self, seed, *, seconds=4.0, drift=1e-4, has_ids=False, n_cameras=1):
        rng = np.random.default_rng(seed)
        self.items = []
        for camera in range(n_cameras):
            for k in range(round(80 * seconds)):
                t = k / 80 + 1.0
                stamp = round((t * (1 + drift) + 77.0 + camera) * 1e9)
                host = round(t * 1e9 + 5e6 + rng.exponential(2e5))
                frame = Frame(IMAGE, k, stamp, host, trigger_id=k if has_ids else None)
                self.items.append((host, "frame", camera, frame, t))
        for k in range(round(240 * (seconds + 0.1))):
            t = k / 240 + 0.9931
            host = round(t * 1e9 + 1e6 + rng.exponential(2e5))
            stamp = round((t * (1 - drift) - 300.0) * 1e9)
            sample = ArmSample(k, stamp, host, pose=true_pose(t))
            self.items.append((host, "sample", 0, sample, t))
        if has_ids:
            for k in range(round(80 * seconds)):
                t = k / 80 + 1.0
                host = round(t * 1e9 + 2e6 + rng.exponential(2e5))
                pose = true_pose(t)
                event = LaserEvent(k, round(t * 1e9), host, ("A",) if k % 2 else ("B",))
                self.items.append((host, "event", 0, event, t))
                triggered = ArmSample(k, round((t - 300) * 1e9), host, pose=pose, trigger_id=k)
                self.items.append((host, "triggered", 0, triggered, t))
        self.items.sort(key=lambda item: item[0])

    def run(self, matcher, kinds=("frame", "sample", "event"), drop=lambda kind, element: False):
        """Instants and timed samples, fed and asked for at every arrival."""
        instants, timed = [], []
        for host, kind, camera, element, _ in self.items:
            if kind not in kinds or drop(kind, element):
                continue
            if kind == "frame":
                matcher.add_frame(element, camera)
            elif kind == "event":
                matcher.add_events((element,))
            else:
                timed += matcher.add_samples((element,))
            instants += matcher.take(host)
        return [*instants, *matcher.take(host + 10**9)], timed


def of_tables(instants, timed):
    """What the recording's tables give in batch."""
    known = [one for one in timed if one.t_ns is not None]
    track = arm_track([one.t_ns for one in known], [one.pose for one in known])
    listed = [one for one in instants if one.t_ns is not None]
    rows = [
        ExposureRow(k, one.t_ns, 0, str(k), trigger_id=one.trigger_id)
        for k, one in enumerate(listed)
    ]
    return listed, exposure_poses(rows, track, latency_ns=LATENCY_NS)


def counts_anew(restarts, kinds, *, n=60):
    """A triggered rig whose streams count from 0 again, half a second after ``restarts`` triggers.

    Streams that are not among ``kinds`` go on counting. Each pose tells its time in x.
    """
    items = []
    for k in range(restarts + n):
        t_ns = 10**9 + round(1e9 * (k / 80 + (0.5 if k >= restarts else 0.0)))
        number = {kind: k - restarts * (kind in kinds and k >= restarts) for kind in KINDS}
        pose = Pose(np.eye(3), np.array([k, 0.0, 0.0]))
        lasers = ("A",) if k % 2 else ("B",)
        items += [
            (t_ns + 3_000_000, LaserEvent(number["event"], t_ns, t_ns + 3_000_000, lasers), k),
            (t_ns + 5_000_000, ArmSample(k, t_ns, t_ns + 5_000_000, pose=pose,
                                         trigger_id=number["sample"]), k),
            (t_ns + 4_000_000, Frame(IMAGE, k, t_ns, t_ns + 4_000_000,
                                     trigger_id=number["frame"]), k),
        ]  # fmt: skip
    return sorted(items, key=lambda item: item[0])


def test_images_that_an_overloaded_computer_takes_in_late_keep_their_poses():
    """Images arrive 0.6 s late for five seconds, so that their clock seems to jump."""
    items, frames = [], []
    for k in range(400):
        t_ns = 10**9 + round(1e9 * k / 40)
        late_ns = 600_000_000 if 100 <= k < 300 else 4_000_000
        pose = Pose(np.eye(3), np.array([k, 0.0, 0.0]))
        sample = ArmSample(k, t_ns, t_ns + 5_000_000, pose=pose, trigger_id=k)
        frames.append(Frame(IMAGE, k, t_ns, t_ns + late_ns, trigger_id=k))
        items += [(sample.t_host_ns, sample), (t_ns + late_ns, None)]
    matcher = InstantMatcher(is_triggered=True, has_controller=False)
    instants = []
    in_order = iter(frames)
    for host, told in sorted(items, key=lambda item: item[0]):
        if told is None:
            matcher.add_frame(replace(next(in_order), t_host_ns=host))
        else:
            matcher.add_samples((told,))
        instants += matcher.take(0)
    instants += matcher.take(10**12)
    assert matcher.cameras[0].counts.n_jumps > 0 and len(instants) == 400
    for k, one in enumerate(instants):
        assert one.pose is not None and one.pose.translation_mm[0] == k


KINDS = ("frame", "sample", "event")


@pytest.mark.parametrize("kinds", [KINDS, ("frame",), ("sample",), ("frame", "event")])
@pytest.mark.parametrize("restarts", [30, 90])
def test_an_id_of_an_earlier_count_belongs_to_nothing_taken_later(restarts, kinds):
    matcher = InstantMatcher(is_triggered=True)
    instants = []
    for host, element, _ in counts_anew(restarts, kinds):
        if isinstance(element, Frame):
            matcher.add_frame(element)
        elif isinstance(element, ArmSample):
            matcher.add_samples((element,))
        else:
            matcher.add_events((element,))
        instants += matcher.take(host)
    instants += matcher.take(host + 10**9)
    assert [one.frames[0].number for one in instants] == list(range(restarts + 60))
    for k, one in enumerate(instants):
        assert one.pose is None or one.pose.translation_mm[0] == k
        assert one.lasers in (None, ("A",) if k % 2 else ("B",))
    n_placed = sum(one.pose is not None for one in instants)
    # where all count anew alike nothing is lost; else all before
    assert n_placed == (restarts + 60 if kinds == KINDS else restarts)


def hole(kind, element):
    """Samples lost for 0.2 s; a sample here and there; unreferenced for a while."""
    return kind == "sample" and (400 <= element.number < 448 or element.number % 97 == 5)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_live_and_batch_give_the_same_poses(seed):
    matcher = InstantMatcher(has_controller=False, latency_ns=LATENCY_NS)
    instants, timed = Rig(seed).run(matcher, drop=hole)
    assert [one.frames[0].number for one in instants] == list(range(320))
    listed, poses = of_tables(instants, timed)
    assert poses.status.tolist() == [one.status for one in listed]
    for k, one in enumerate(listed):
        if one.pose is not None:
            assert np.array_equal(poses.rotations[k], one.pose.rotation)
            assert np.array_equal(poses.translations_mm[k], one.pose.translation_mm)
    status = [one.status for one in instants]
    # the first half second has no clock yet; the hole of 48 samples at 240/s takes 16 exposures
    first = status.index(PoseStatus.FOUND)
    assert 25 <= first < 100 and all(one.t_ns is None for one in instants[:25])
    assert 15 <= status.count(PoseStatus.GAP) <= 18
    assert status.count(PoseStatus.FOUND) > 200
    assert matcher.arm.counts.n_missing == 48 + 11


def test_poses_are_where_the_tool_truly_was():
    """The two least delays, 5 and 1 ms, leave 4 ms between the clocks: that is the latency."""
    matcher = InstantMatcher(has_controller=False, latency_ns=LATENCY_NS)
    rig = Rig(7)
    instants, _ = rig.run(matcher)
    t_of = {element.number: t for _, kind, _, element, t in rig.items if kind == "frame"}
    errors = [
        one.pose.translation_mm - true_pose(t_of[one.frames[0].number]).translation_mm
        for one in instants
        if one.pose is not None
    ]
    # 30 us of two clocks at 70 mm/s, and the chord's 40 mm/s^2 (4.2 ms)^2 / 8
    assert len(errors) > 200
    assert np.linalg.norm(errors, axis=1).max() < 0.01


@pytest.mark.parametrize("spread_ns", [2e4, 1e5])
@pytest.mark.parametrize("exposures_us", [(2000, 1000), (1000, 2000), (5000, 2500, 1250)])
def test_a_new_exposure_time_moves_no_clock_and_costs_no_frame(exposures_us, spread_ns):
    """A frame arrives 3 ms after the end of its exposure, and by chance a little later."""
    rng = np.random.default_rng(5)
    matcher = InstantMatcher(has_arm=False, has_controller=False)
    off_ns = []
    for k in range(2400):
        # the last but one for five frames only, as of a control that is quick
        step = 0 if k < 1200 else 1 if k < 1205 else -1
        exposure_ns = 1000 * exposures_us[step]
        middle_ns = 10**9 + 12_500_000 * k + exposure_ns // 2
        host_ns = middle_ns + exposure_ns // 2 + 3_000_000 + round(spread_ns * rng.exponential())
        frame = Frame(IMAGE, k, middle_ns + 10**14, host_ns, exposure_ns=exposure_ns)
        matcher.add_frame(frame)
        (one,) = matcher.take(10**18)
        off_ns.append(None if one.t_ns is None else one.t_ns - middle_ns)
    counts = matcher.cameras[0].counts
    assert (counts.n_jumps, counts.n_doubtful) == (0, 0)
    assert None not in off_ns[100:]
    # the constant least delay alone, before the change and after it
    assert np.abs(np.array(off_ns[100:]) - 3_000_000).max() < 40_000


def test_a_frame_whose_middle_is_not_certain_has_no_time_and_tells_nothing_of_the_clock():
    matcher = InstantMatcher(has_arm=False, has_controller=False)
    for k in range(400):
        is_timed = not 200 <= k < 220
        middle_ns = 10**9 + 12_500_000 * k
        # under way at a change: exposed for 2 ms longer than is told
        host_ns = middle_ns + 3_000_000 + 2_000_000 * (not is_timed)
        matcher.add_frame(Frame(IMAGE, k, middle_ns, host_ns, is_timed=is_timed))
    instants = matcher.take(10**18)
    assert [one.frames[0].number for one in instants if one.t_ns is None][-20:] == [
        *range(200, 220)
    ]
    assert instants[399].t_ns == pytest.approx(10**9 + 12_500_000 * 399 + 3_000_000, abs=100)
    assert matcher.cameras[0].counts.words == ""


def test_after_a_pause_in_which_two_clocks_ran_apart_poses_are_found_again():
    """80 parts in a million over an hour are 0.29 s."""
    matcher = InstantMatcher(is_triggered=True, has_controller=False)
    instants = []
    for k in range(120):
        t_ns = 10**9 + round(1e9 * (k / 80 + (3600.0 if k >= 60 else 0.0)))
        pose = Pose(np.eye(3), np.array([k, 0.0, 0.0]))
        stamp_ns = t_ns + round(8e-5 * t_ns)
        matcher.add_frame(Frame(IMAGE, k, stamp_ns, t_ns + 4_000_000, trigger_id=k))
        matcher.add_samples((ArmSample(k, t_ns, t_ns + 5_000_000, pose=pose, trigger_id=k),))
        instants += matcher.take(t_ns + 5_000_000)
    instants += matcher.take(10**13)
    assert [one.pose is not None for one in instants] == [True] * 120


def test_trigger_ids_alone_decide_where_there_are_any():
    matcher = InstantMatcher(is_triggered=True)
    kinds = ("frame", "triggered", "event")
    rig = Rig(4, has_ids=True)
    lost = {17, 60, 61}

    def drop(kind, element):
        return kind == "triggered" and element.number in lost

    instants, _ = rig.run(matcher, kinds, drop)
    assert len(instants) == 320
    for k, one in enumerate(instants):
        assert one.trigger_id == k
        assert one.lasers == (("A",) if k % 2 else ("B",))
        wanted = PoseStatus.UNKNOWN_TRIGGER if k in lost else PoseStatus.FOUND
        assert one.status == wanted
        if one.pose is not None:
            truth = true_pose(k / 80 + 1.0)
            assert np.array_equal(one.pose.translation_mm, truth.translation_mm)


def test_two_cameras_make_one_instant_and_a_lost_partner_is_left_open():
    matcher = InstantMatcher(2, is_triggered=True)
    kinds = ("frame", "triggered", "event")
    rig = Rig(5, has_ids=True, n_cameras=2)
    seen = set()

    def drop(kind, element):
        if kind != "frame" or element.number not in (9, 200):
            return False
        twice = (kind, element.number) in seen
        seen.add((kind, element.number))
        return not twice

    instants, _ = rig.run(matcher, kinds, drop)
    assert [one.trigger_id for one in instants] == list(range(320))
    open_ones = [k for k, one in enumerate(instants) if None in one.frames]
    assert open_ones == [9, 200]


def test_two_cameras_without_ids_meet_by_their_clocks():
    matcher = InstantMatcher(2, has_controller=False, has_arm=False)
    instants, _ = Rig(6, n_cameras=2).run(matcher, ("frame",))
    pairs = [one for one in instants if None not in one.frames]
    assert len(pairs) > 270
    assert all(one.frames[0].number == one.frames[1].number for one in pairs)


def test_lasers_without_ids_are_told_only_where_they_did_not_change():
    matcher = InstantMatcher(has_arm=False)
    found = []
    for k in range(400):
        t = k * 12_500_000
        on = ("A",) if k < 200 else ("B",)
        matcher.add_events((LaserEvent(k, t, t + 1_000_000, on),))
        matcher.add_frame(Frame(IMAGE, k, t, t + 15_000_000))
        found += [one.lasers for one in matcher.take(t + 15_000_000)]
    assert set(found[60:190]) == {("A",)}
    assert set(found[210:380]) == {("B",)}
    assert set(found[196:202]) == {None}


@pytest.mark.parametrize("said", [ArmFlag.NONE, ArmFlag.REFERENCED | ArmFlag.INACCURATE])
def test_an_arm_that_says_that_its_poses_are_not_right_gives_none(said):
    matcher = InstantMatcher(has_controller=False)
    for k in range(600):
        t = k * 5_000_000
        flags = said if 300 <= k < 400 else ArmFlag.REFERENCED
        matcher.add_samples((ArmSample(k, t, t + 10**6, pose=true_pose(t * 1e-9), flags=flags),))
        matcher.add_frame(Frame(IMAGE, k, t, t + 10**6))
    status = [one.status for one in matcher.take(10**12)]
    assert set(status[310:390]) == {PoseStatus.UNKNOWN_SAMPLE}
    assert set(status[410:590]) == {PoseStatus.FOUND}
    assert matcher.arm.counts.n_inaccurate == 100 * (ArmFlag.INACCURATE in said)


def test_poses_at_an_end_stop_are_used_and_counted():
    matcher = InstantMatcher(has_controller=False)
    for k in range(600):
        t = k * 5_000_000
        flags = ArmFlag.REFERENCED | (ArmFlag.END_STOP if k >= 590 else ArmFlag.NONE)
        matcher.add_samples((ArmSample(k, t, t + 10**6, pose=true_pose(t * 1e-9), flags=flags),))
        matcher.add_frame(Frame(IMAGE, k, t, t + 10**6))
    assert {one.status for one in matcher.take(10**12)[-10:]} == {PoseStatus.FOUND}
    assert matcher.arm.counts.words == "10 at an end stop of the arm"


@pytest.mark.parametrize("untimed", [0, 1])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_an_instant_with_an_image_of_unsure_time_has_none_whichever_came_first(order, untimed):
    matcher = InstantMatcher(2, has_arm=False, has_controller=False)
    for k in range(400):
        t_ns = 12_500_000 * k
        for camera in order:
            is_timed = not (camera == untimed and k == 300)
            host_ns = t_ns + 1_000_000
            frame = Frame(IMAGE, k, t_ns, host_ns, trigger_id=k, is_timed=is_timed)
            matcher.add_frame(frame, camera)
    instants = {one.trigger_id: one for one in matcher.take(10**18)}
    assert len(instants) == 400
    assert instants[300].t_ns is None and instants[299].t_ns is not None
    assert all(frame is not None for frame in instants[300].frames)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_an_image_of_an_unknown_clock_takes_the_time_of_the_other_camera(order):
    matcher = InstantMatcher(2, has_arm=False, has_controller=False)
    for k in range(400):
        t_ns = 12_500_000 * k
        for camera in order:
            # the first camera's clock is not known at all: it shows one time
            own_ns = t_ns if camera else 7
            frame = Frame(IMAGE, k, own_ns, t_ns + 1_000_000, trigger_id=k)
            matcher.add_frame(frame, camera)
    instants = {one.trigger_id: one for one in matcher.take(10**18)}
    assert instants[300].t_ns is not None


def test_lasers_are_mixed_where_events_near_name_several_and_not_where_none_came():
    for names, are_mixed in ((("A", "B"), True), ((), False)):
        matcher = InstantMatcher(has_arm=False)
        for k in range(400):
            t_ns = 12_500_000 * k
            if names:
                event = LaserEvent(k, t_ns, t_ns + 1_000_000, (names[k % 2],))
                matcher.add_events((event,))
            matcher.add_frame(Frame(IMAGE, k, t_ns, t_ns + 1_000_000))
        instant = matcher.take(10**18)[300]
        assert instant.lasers is None and instant.are_lasers_mixed == are_mixed
