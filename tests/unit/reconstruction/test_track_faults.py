# SPDX-License-Identifier: Apache-2.0
"""What a track says against itself, and what no track may be blamed for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.sync import PoseStatus, exposure_poses
from armscan.reconstruction.track_faults import check_track
from armscan.records.recording import ArmTrack, ExposureRow

PERIOD_NS = 4_000_000
NOISE_MM = 0.01
Change = Callable[[FloatArray, FloatArray], None]


def hand_track(n: int = 1500, period_ns: int = PERIOD_NS, seed: int = 1) -> ArmTrack:
    """About 60 mm/s to and fro with rests of half a second, and a slow turn."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * period_ns * 1e-9
    speed = 60.0 * np.clip(1.6 * np.sin(2.0 * np.pi * 0.35 * t), -1.0, 1.0)
    speed[(t % 2.5) < 0.5] = 0.0
    way = np.cumsum(speed) * period_ns * 1e-9
    place = np.column_stack([500.0 + way, 0.3 * way, 5.0 * np.sin(t)])
    turn = Rotation.from_rotvec(np.column_stack([0.1 * np.sin(t), 0.0 * t, 0.002 * way]))
    place += NOISE_MM * rng.standard_normal(place.shape)
    times = 10**9 + np.arange(n, dtype=np.int64) * period_ns
    return ArmTrack(
        t_ns=times,
        rotations=turn.as_matrix(),
        translations_mm=place,
        is_known=np.ones(n, dtype=bool),
    )


def changed(change: Change) -> ArmTrack:
    track = hand_track()
    rotations, places = np.array(track.rotations), np.array(track.translations_mm)
    change(rotations, places)
    return replace(track, rotations=rotations, translations_mm=places)


@pytest.mark.parametrize("size_mm", [3.0, 30.0, 1000.0])
def test_a_jump_after_which_all_is_shifted_is_named_and_undecided(size_mm: float) -> None:
    def shift(_: FloatArray, places: FloatArray) -> None:
        places[700:] += size_mm * np.array([0.0, 0.6, 0.8])

    check = check_track(changed(shift))
    (fault,) = check.faults
    assert (fault.kind, fault.first, fault.last) == ("jump", 699, 700)
    assert fault.size_mm == pytest.approx(size_mm, abs=0.5)
    assert check.jumps == (fault,)
    assert not check.is_faulty.any()


def test_a_joint_that_slips_turns_the_tool_by_a_jump() -> None:
    def slip(rotations: FloatArray, _: FloatArray) -> None:
        rotations[700:] = rotations[700:] @ Rotation.from_rotvec([0.02, 0.0, 0.0]).as_matrix()

    (fault,) = check_track(changed(slip)).faults
    # 0.02 rad at 200 mm from the tool's origin
    assert fault.size_mm == pytest.approx(4.0, abs=0.5)


def test_one_sample_a_metre_off_is_left_out_alone() -> None:
    def spike(_: FloatArray, places: FloatArray) -> None:
        places[700] += [0.0, 600.0, 800.0]

    check = check_track(changed(spike))
    assert [fault.kind for fault in check.faults] == ["off the track"]
    assert np.flatnonzero(check.is_faulty).tolist() == [700]


@pytest.mark.parametrize("share", [0.25, 0.45])
def test_a_stuck_encoder_is_named_from_its_second_equal_sample(share: float) -> None:
    last = 400 + int(1500 * share)

    def stick(rotations: FloatArray, places: FloatArray) -> None:
        rotations[400:last], places[400:last] = rotations[400], places[400]

    check = check_track(changed(stick))
    assert [fault.kind for fault in check.faults] == ["stands still"]
    assert np.flatnonzero(check.is_faulty).tolist() == list(range(401, last))


def test_a_block_of_samples_that_comes_twice_is_named() -> None:
    def repeat(rotations: FloatArray, places: FloatArray) -> None:
        rotations[800:860], places[800:860] = rotations[500:560], places[500:560]

    check = check_track(changed(repeat))
    assert [fault.kind for fault in check.faults] == ["repeated"]
    assert np.flatnonzero(check.is_faulty).tolist() == list(range(800, 860))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("period_ns", [4_000_000, 12_500_000, 100_000_000, 400_000_000])
@pytest.mark.parametrize("decimals", [1, 3, 12])
def test_a_hand_with_rests_is_not_blamed(seed: int, period_ns: int, decimals: int) -> None:
    track = hand_track(400, period_ns, seed)
    angles = Rotation.from_matrix(track.rotations).as_euler("XYZ", degrees=True)
    written = Rotation.from_euler("XYZ", np.round(angles, decimals), degrees=True).as_matrix()
    places = np.round(track.translations_mm, decimals)
    assert check_track(replace(track, rotations=written, translations_mm=places)).faults == ()


def test_a_controller_that_is_polled_faster_than_it_moves_is_not_blamed() -> None:
    track = hand_track()
    held = np.arange(1500) // 3 * 3
    slow = replace(
        track, rotations=track.rotations[held], translations_mm=track.translations_mm[held]
    )
    assert check_track(slow).faults == ()


def test_postures_and_pauses_are_not_blamed() -> None:
    rng = np.random.default_rng(2)
    places = np.repeat(rng.uniform(-400.0, 400.0, (12, 3)), 4, axis=0)
    turns = Rotation.random(12, random_state=1).as_matrix()[np.arange(48) // 4]
    times = np.cumsum(np.where(np.arange(48) % 4 == 0, 3 * 10**9, 2 * 10**8))
    known = np.ones(48, dtype=bool)
    assert (
        check_track(
            ArmTrack(t_ns=times, rotations=turns, translations_mm=places, is_known=known)
        ).faults
        == ()
    )
    even = 10**9 * np.arange(48, dtype=np.int64)
    assert (
        check_track(
            ArmTrack(t_ns=even, rotations=turns, translations_mm=places, is_known=known)
        ).faults
        == ()
    )


def test_exposures_at_faulty_samples_get_no_pose_and_a_word() -> None:
    def spike(_: FloatArray, places: FloatArray) -> None:
        places[700] += [0.0, 600.0, 800.0]

    track = changed(spike)
    times = [int(track.t_ns[k]) + PERIOD_NS // 2 for k in (600, 699, 700, 701)]
    rows = [
        ExposureRow(index=k, t_ns=t, camera=0, source=f"{k}.png", lasers=("A",))
        for k, t in enumerate(times)
    ]
    poses = exposure_poses(rows, track)
    wrong, found = PoseStatus.CONTRADICTED, PoseStatus.FOUND
    assert poses.status.tolist() == [found, wrong, wrong, found]
    assert len(poses.track_faults) == 1
    assert any("off the track" in text for text in poses.warnings)
