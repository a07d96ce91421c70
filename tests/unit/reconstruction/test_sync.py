# SPDX-License-Identifier: Apache-2.0
"""Poses of exposures: by id, by time, and never where nobody knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from armscan.errors import EstimationError, InputError
from armscan.geometry.poses import Pose
from armscan.reconstruction import sync
from armscan.reconstruction.sync import PoseStatus, exposure_poses
from armscan.records.recording import ArmTrack, ExposureRow

MS = 1_000_000
EPOCH_NS = 1_760_000_000_000_000_000
"""Times of day in ns need all 63 bits: a float would lose 128 ns."""


def rows(times_ns: Sequence[int], ids: Sequence[int | None] | None = None) -> list[ExposureRow]:
    wanted = ids or [None] * len(times_ns)
    return [
        ExposureRow(
            index=k, t_ns=t, camera=0, source=f"{k}.png", lasers=("A",), trigger_id=wanted[k]
        )
        for k, t in enumerate(times_ns)
    ]


def steady_track(n: int = 11, period_ns: int = 10 * MS, **changes: object) -> ArmTrack:
    """50 mm/s along x and 1 rad/s about one axis."""
    seconds = np.arange(n) * period_ns * 1e-9
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    rotations = Rotation.from_rotvec(seconds[:, None] * axis).as_matrix()
    places = np.array([100.0, 0.0, 30.0]) + seconds[:, None] * np.array([50.0, 0.0, 0.0])
    fields: dict[str, object] = {"is_known": np.ones(n, dtype=bool)} | changes
    return ArmTrack(
        t_ns=EPOCH_NS + np.arange(n) * period_ns,
        rotations=rotations,
        translations_mm=places,
        **fields,
    )


def test_between_samples_the_pose_moves_evenly() -> None:
    """A track of constant velocity comes back exactly; SciPy's Slerp agrees."""
    track = steady_track()
    times = [EPOCH_NS + t for t in (1, 3 * MS, 25 * MS + 123, 99 * MS, 100 * MS)]
    poses = exposure_poses(rows(times), track)
    assert poses.has_pose.all()
    assert poses.source == "time"
    seconds = (np.array(times) - EPOCH_NS) * 1e-9
    np.testing.assert_allclose(poses.translations_mm[:, 0], 100.0 + 50.0 * seconds, atol=1e-9)
    oracle = Slerp(np.arange(11) * 0.01, Rotation.from_matrix(track.rotations))(seconds)
    np.testing.assert_allclose(poses.rotations, oracle.as_matrix(), atol=1e-12)
    assert isinstance(poses.pose(1), Pose)


def test_at_a_sample_the_sample_itself_is_taken() -> None:
    track = steady_track()
    poses = exposure_poses(rows([EPOCH_NS, EPOCH_NS + 70 * MS]), track)
    np.testing.assert_array_equal(poses.translations_mm, track.translations_mm[[0, 7]])
    np.testing.assert_array_equal(poses.rotations, track.rotations[[0, 7]])


def test_latency_is_added_to_the_exposures_time() -> None:
    """250 microseconds at 50 mm/s are 0.0125 mm."""
    late = exposure_poses(rows([EPOCH_NS + 5 * MS]), steady_track(), latency_ns=250_000)
    assert late.translations_mm[0, 0] == pytest.approx(100.0 + 50.0 * 5.25e-3, abs=1e-9)


def test_unknown_samples_are_not_bridged() -> None:
    known = np.ones(11, dtype=bool)
    known[4] = False
    poses = exposure_poses(
        rows([EPOCH_NS + t * MS for t in (25, 35, 40, 45, 50)]), steady_track(is_known=known)
    )
    expected = [
        PoseStatus.FOUND,
        PoseStatus.GAP,
        PoseStatus.UNKNOWN_SAMPLE,
        PoseStatus.GAP,
        PoseStatus.FOUND,
    ]
    assert [PoseStatus(int(status)) for status in poses.status] == expected
    assert poses.sample.tolist() == [2, -1, -1, -1, 5]
    assert "2 in a gap" in poses.missing
    with pytest.raises(InputError, match="gap"):
        poses.pose(1)


def test_neighbours_too_far_apart_are_not_bridged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples are missing altogether for 40 ms, of a period of 10 ms: more than three periods."""
    track = steady_track()
    kept = np.array([0, 1, 2, 3, 7, 8, 9, 10])
    holed = ArmTrack(
        t_ns=track.t_ns[kept],
        rotations=track.rotations[kept],
        translations_mm=track.translations_mm[kept],
        is_known=np.ones(8, bool),
    )
    wanted = rows([EPOCH_NS + t * MS for t in (25, 50)])
    assert exposure_poses(wanted, holed).status.tolist() == [PoseStatus.FOUND, PoseStatus.GAP]
    monkeypatch.setattr(sync, "GAP_PERIODS", 4)
    wide = exposure_poses(wanted, holed)
    assert wide.has_pose.all()
    assert wide.how == "by time, between samples up to 40 ms apart"


def test_poses_taken_now_and_then_are_not_joined() -> None:
    """One sample a posture, seconds apart: three median periods would bridge them all."""
    track = steady_track(period_ns=5_000 * MS)
    poses = exposure_poses(rows([EPOCH_NS + 5_000 * MS, EPOCH_NS + 7_000 * MS]), track)
    assert poses.status.tolist() == [PoseStatus.FOUND, PoseStatus.GAP]


def test_before_and_after_the_track_there_is_no_pose() -> None:
    poses = exposure_poses(rows([EPOCH_NS - 1, EPOCH_NS, EPOCH_NS + 100 * MS + 1]), steady_track())
    assert poses.status.tolist() == [
        PoseStatus.BEFORE_TRACK,
        PoseStatus.FOUND,
        PoseStatus.AFTER_TRACK,
    ]


def test_trigger_ids_win_over_times() -> None:
    """The ids are shuffled against time on purpose; a clock of its own does not matter then."""
    track = steady_track(trigger_ids=np.array([7, -1, 3, 5, 4, -1, 6, 8, 9, 10, 11]))
    poses = exposure_poses(rows([5, 6, 7, 8], [3, 7, 99, None]), track, clock="separate")
    assert poses.how == "by trigger id"
    assert poses.sample[:2].tolist() == [2, 0]
    np.testing.assert_array_equal(poses.translations_mm[:2], track.translations_mm[[2, 0]])
    assert poses.status[2:].tolist() == [PoseStatus.UNKNOWN_TRIGGER, PoseStatus.NO_TRIGGER]
    assert poses.warnings == ()


def test_ids_that_contradict_a_shared_clock_are_pointed_out() -> None:
    track = steady_track(trigger_ids=np.arange(11))
    right = rows([EPOCH_NS + k * 10 * MS for k in range(11)], list(range(11)))
    assert exposure_poses(right, track).warnings == ()
    swapped = rows([EPOCH_NS + k * 10 * MS for k in range(11)], list(range(10, -1, -1)))
    (warning,) = exposure_poses(swapped, track).warnings
    assert "up to 100.0 ms" in warning


def test_times_that_are_not_those_of_the_arm_take_no_pose() -> None:
    """Clocks that drift, were set, in whole seconds or that only number images contradict no id."""
    n, ids = 400, list(range(400))
    track = replace(
        steady_track(n, 5_000 * MS, trigger_ids=np.arange(n)), t_ns=np.arange(n) * 5000 * MS
    )
    rng = np.random.default_rng(3)
    rough = np.round(track.t_ns / 1e9 + rng.uniform(-1.0, 1.0, n)).astype(np.int64) * 1000 * MS
    drifting = np.round(track.t_ns * (1 + 4e-4)).astype(np.int64)
    late = track.t_ns + 10**18 * (np.arange(n) > 200)
    # two of their clocks, one 5 s after the other
    two = track.t_ns + 5_000 * MS * (np.arange(n) % 2)
    for times in (drifting, rough, np.arange(n), late + 10**15, two):
        poses = exposure_poses(rows(times.tolist(), ids), track, "separate")
        assert poses.has_pose.all() and poses.warnings == ()
    # an overloaded computer takes images in late for a while, so that their clock seems to jump
    fast = steady_track(n, 12 * MS, trigger_ids=np.arange(n))
    behind = fast.t_ns + np.where((np.arange(n) // 100) % 2 == 1, 1_500 * MS, 0)
    times = np.maximum.accumulate(behind + np.arange(n))
    assert exposure_poses(rows(times.tolist(), ids), fast, "separate").has_pose.all()
    # images numbered by a nominal rate, while the triggers paused for 3 s
    paused = replace(fast, t_ns=fast.t_ns + 3_000 * MS * (np.arange(n) >= 150))
    assert exposure_poses(rows(fast.t_ns.tolist(), ids), paused, "separate").has_pose.all()


def test_an_unknown_sample_of_a_trigger_is_no_pose() -> None:
    known = np.ones(11, dtype=bool)
    known[2] = False
    track = steady_track(trigger_ids=np.arange(11), is_known=known)
    poses = exposure_poses(rows([0, 1], [2, 3]), track, clock="separate")
    assert poses.status.tolist() == [PoseStatus.UNKNOWN_SAMPLE, PoseStatus.FOUND]


def test_what_cannot_be_put_together_is_refused_with_a_way_out() -> None:
    with pytest.raises(InputError, match=r"separate clocks.*trigger_id"):
        exposure_poses(rows([EPOCH_NS]), steady_track(), clock="separate")
    with pytest.raises(InputError, match="no samples of the arm"):
        exposure_poses(rows([EPOCH_NS]), None)
    twice = steady_track(trigger_ids=np.array([1, 2, 2, 3, 4, 5, 6, 7, 8, 9, 10]))
    with pytest.raises(InputError, match="trigger id 2"):
        exposure_poses(rows([EPOCH_NS], [2]), twice)
    with pytest.raises(EstimationError, match=r"none of 2 exposures.*2 before.*span 0\.0"):
        exposure_poses(rows([5, 6]), steady_track())
    with pytest.raises(EstimationError, match="2 with a trigger id"):
        exposure_poses(rows([5, 6], [50, 51]), steady_track(trigger_ids=np.arange(11)))


def test_a_path_that_bends_between_samples_is_pointed_out() -> None:
    """Uniform acceleration a: the chord misses the path by a T^2 / 8 in the middle."""
    seconds = np.arange(21) * 0.04
    acceleration = 500.0
    places = np.zeros((21, 3))
    places[:, 0] = 0.5 * acceleration * seconds**2
    track = ArmTrack(
        t_ns=EPOCH_NS + np.arange(21) * 40 * MS,
        rotations=np.tile(np.eye(3), (21, 1, 1)),
        translations_mm=places,
        is_known=np.ones(21, bool),
    )
    (warning,) = exposure_poses(rows([EPOCH_NS + 420 * MS]), track).warnings
    assert f"{acceleration * 0.04**2 / 8:.2g} mm" in warning
    assert exposure_poses(rows([EPOCH_NS + 5 * MS]), steady_track()).warnings == ()
