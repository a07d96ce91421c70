# SPDX-License-Identifier: Apache-2.0
"""What a live recorder writes, read again as a recording."""

from __future__ import annotations

import json
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.devices.clocks import ElementStatus
from armscan.devices.matching import InstantMatcher, MatchedInstant, TimedSample
from armscan.devices.protocols import ArmFlag, ArmSample, Frame, LaserEvent
from armscan.errors import EstimationError, InputError
from armscan.geometry.poses import Base, Pose, Tool
from armscan.jobs.info import describe_recording
from armscan.models.arm import forward, thesis_arm
from armscan.pipeline.instants import group_instants
from armscan.pipeline.live.acquire import LiveEvent
from armscan.pipeline.live.recorder import CommonIds, LiveRecorder
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.pipeline.live.session import LiveSession
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.reconstruction.sync import PoseStatus, exposure_poses
from armscan.reconstruction.track_faults import check_track
from armscan.records.recording import LASER_UNKNOWN, CameraSetup
from armscan.storage.recording import read_recording, write_recording
from armscan.storage.recordings.read_mcap import ReadBack, extract_recording
from armscan.storage.recordings.write_mcap import WriterOptions
from armscan.storage.tables import read_csv
from rigs.scan_fake import scanner
from unit.live.test_session import ALL, Device, rig_of, triggered_scan, waited

Count = Callable[[int], int | None]
IMAGES = np.random.default_rng(1).integers(0, 255, (6, 12, 16)).astype(np.uint8)


def read_back(path: Path) -> tuple[Any, ReadBack, list[dict[str, Any]]]:
    folder = path.with_suffix("")
    found = extract_recording(path, folder)
    lines = (folder / "events.jsonl").read_text().splitlines()
    return read_recording(folder), found, [json.loads(line) for line in lines]


def small_rig(*, is_triggered: bool, form: str = "quaternion", **given: Any) -> Any:
    camera = Device("camera 0", [], setup=CameraSetup(16, 12))
    description = RigDescription(("c",), is_common_trigger=is_triggered)
    return Rig([camera], Device("arm", [], pose_form=form), None, description, **given)  # type: ignore[arg-type, list-item]


def instant(k: int, t_ns: int | None, **changes: Any) -> MatchedInstant:
    frame = replace(
        Frame(IMAGES[k], k, 10**15 + k, 5_000_000_000 + 10_000_000 * k, trigger_id=k + 3), **changes
    )
    return MatchedInstant((frame,), t_ns, ("A",), k + 3, None, PoseStatus.NO_TIME)


FRAME = Frame(IMAGES[0], 0, 1, 10**10)
TIMED = MatchedInstant((FRAME,), 10**10, (), 1, None, PoseStatus.UNKNOWN_TRIGGER)


def test_a_session_that_was_recorded_gives_the_points_that_were_shown(tmp_path: Path) -> None:
    scan = triggered_scan(8)
    rig = rig_of(scan)
    clouds: dict[int, Any] = {}
    recorder = LiveRecorder(tmp_path / "scan.mcap", rig)
    session = LiveSession(
        rig, scanner(), options=ALL, recorder=recorder, keep_cloud=clouds.__setitem__
    )
    frames, samples = rig.cameras[0].elements, rig.arm.elements
    rig.cameras[0].elements, rig.arm.elements = [], []
    session.open()
    recorder.begin()
    session.add_listener(recorder.hear)
    session.start()
    rig.cameras[0].elements, rig.arm.elements = frames, samples
    waited(lambda: sum(session.snapshot().counts.values()) == 8)
    session.stop()
    assert recorder.close().n_written == 8 and recorder.n_aside == 0
    recorded, found, _ = read_back(tmp_path / "scan.mcap")
    assert found.n_exposures == 8 and found.n_samples == 8
    cloud = measure_scan(recorded, scanner(), ScanOptions(has_normals=False)).cloud
    assert len(cloud) == sum(len(one) for one in clouds.values()) > 1000
    for k, one in clouds.items():
        # poses pass a table of 17 digits
        np.testing.assert_allclose(
            cloud.points_mm[cloud.exposure == k], one.points_mm, rtol=0, atol=1e-9
        )


def test_frames_that_no_table_places_are_kept_and_set_aside(tmp_path: Path) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=False))
    recorder.begin()
    recorder.add_instant(instant(0, 1_000))
    recorder.add_instant(instant(1, 2_000, is_complete=False))
    recorder.add_instant(instant(2, None))
    recorder.add_frame(0, Frame(IMAGES[3], 3, 10**15, 7), ElementStatus.LATE)
    recorder.add_frame(0, Frame(IMAGES[0], 0, 10**15, 8), ElementStatus.DUPLICATE)
    recorder.add_instant(instant(4, 3_000))
    recorder.hear(LiveEvent("button", "2", "arm"))
    recorder.add_events((LaserEvent(4, 10**15, 9, ("A", "B")),))
    assert recorder.close().n_written == 5
    assert (recorder.n_aside, recorder.n_usable) == (3, 2)
    said = "1 lack parts, 1 have no time that is known, 1 came after newer ones"
    note = f"3 of 5 exposures in the file are set aside: {said}"
    # no word of the column of marks, which is our own
    assert read_recording(tmp_path / "scan.mcap").warnings == (note,)
    assert describe_recording(tmp_path / "scan.mcap")["warnings"] == [note]
    recorded, found, events = read_back(tmp_path / "scan.mcap")
    assert (found.n_exposures, found.n_aside) == (2, 3)
    assert found.aside == (note,)
    assert [row.t_ns for row in recorded.rows] == [1_000, 3_000]
    for row, image in enumerate((0, 4)):
        np.testing.assert_array_equal(recorded.exposure(row).image, IMAGES[image])
    kinds = [one["kind"] for one in events]
    assert sorted(kinds) == ["button", "frame", "frame", "lasers"]
    told = {one["kind"]: one["facts"] for one in events}
    assert told["button"] == {"text": "2", "device": "arm"}
    assert told["lasers"] == {
        "trigger_id": 4, "t_device_ns": 10**15, "t_host_ns": 9, "lasers": ["A", "B"],
    }  # fmt: skip


@pytest.mark.parametrize("is_triggered", [False, True])
def test_a_first_frame_that_lacks_parts_is_no_exposure(tmp_path: Path, is_triggered: bool) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=is_triggered))
    recorder.begin()
    recorder.add_instant(instant(0, 10**9, is_complete=False))
    recorder.add_instant(instant(1, 2 * 10**9))
    recorder.hear(LiveEvent("button", "2", "arm"))
    recorder.close()
    recorded, found, _ = read_back(tmp_path / "scan.mcap")
    assert [row.t_ns for row in recorded.rows] == [2 * 10**9]
    assert (found.n_exposures, found.n_aside) == (1, 1)


def test_samples_that_a_busy_computer_reads_together_are_no_jump_of_the_arm(tmp_path: Path) -> None:
    # 250 a second at 200 mm/s; of every 25 the last 10 come together and late: their times are not
    # sure, those after them are
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    step_ns, n = 4_000_000, 200
    pose = triggered_scan(1).truth[0]
    for k in range(n):
        late = k % 25 >= 15
        t_ns = 10**9 + step_ns * k
        host_ns = 10**9 + step_ns * (25 * (k // 25) + 27) if late else t_ns + 1_000_000
        moved = replace(pose, translation_mm=pose.translation_mm + np.array([0.8 * k, 0.0, 0.0]))
        sample = ArmSample(k, 10**15 + step_ns * k, host_ns, moved, None, trigger_id=k)
        status = ElementStatus.DOUBTFUL if late else ElementStatus.USABLE
        recorder.add_samples((TimedSample(sample, None if late else t_ns, status, moved),))
    recorder.add_instant(instant(0, 10**9))
    recorder.close()
    arm = read_recording(tmp_path / "scan.mcap").arm
    assert arm is not None and arm.trigger_ids is not None
    np.testing.assert_array_equal(arm.trigger_ids, np.arange(n))
    np.testing.assert_array_equal(arm.t_ns, 10**9 + step_ns * np.arange(n))
    assert check_track(arm).faults == ()


@pytest.mark.parametrize("begins_ns", [0, 2 * 10**15])
def test_an_arm_that_was_started_anew_did_not_jump(tmp_path: Path, begins_ns: int) -> None:
    # silent for 3 s while it moved by 600 mm; its clock begins anew, and is not related at once
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    step_ns, pose = 4_000_000, triggered_scan(1).truth[0]
    for k in range(80):
        is_again = k >= 40
        t_ns = 10**9 + step_ns * k + 3 * 10**9 * is_again
        device_ns = begins_ns + step_ns * (k - 40) if is_again else 10**15 + step_ns * k
        x_mm = 200e-9 * (t_ns - 10**9)
        moved = replace(pose, translation_mm=pose.translation_mm + np.array([x_mm, 0.0, 0.0]))
        sample = ArmSample(k % 40, device_ns, t_ns + 1_000_000, moved, None, trigger_id=k)
        status = ElementStatus.JUMP if k == 40 else ElementStatus.USABLE
        recorder.add_samples((TimedSample(sample, None if is_again else t_ns, status, moved),))
    recorder.add_instant(instant(0, 10**9))
    recorder.close()
    arm = read_recording(tmp_path / "scan.mcap").arm
    assert arm is not None
    off_ns = arm.t_ns - 10**9 - step_ns * np.arange(80) - 3 * 10**9 * (np.arange(80) >= 40)
    assert np.all((off_ns >= 0) & (off_ns <= 1_000_000))
    assert check_track(arm).faults == ()


def test_where_ids_decide_a_clock_that_is_not_known_sets_nothing_aside(tmp_path: Path) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    # times of arrival, then of a clock that is known: they may go back a little at the change
    for k, t_ns in enumerate((None, None, 5_009_000_000, 5_030_000_000)):
        recorder.add_instant(instant(k, t_ns))
        pose = triggered_scan(4).truth[k]
        sample = ArmSample(k, 1, 5_000_000_000 + 10**7 * k, pose, trigger_id=k + 3)
        recorder.add_samples((TimedSample(sample, None, ElementStatus.USABLE, pose),))
    recorder.close()
    recorded, found, _ = read_back(tmp_path / "scan.mcap")
    assert (found.n_exposures, found.n_samples, found.n_aside) == (4, 4, 0)
    assert [row.trigger_id for row in recorded.rows] == [3, 4, 5, 6]
    assert recorded.arm.trigger_ids.tolist() == [3, 4, 5, 6]
    assert (np.diff([row.t_ns for row in recorded.rows]) > 0).all()


def test_times_of_arrival_are_no_false_alarm_about_ids(tmp_path: Path) -> None:
    """Images arrive 60 ms after the arm's samples, more than three of its steps: ids decide."""
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    for k in range(6):
        recorder.add_instant(instant(k, None))
        pose = triggered_scan(6).truth[k]
        sample = ArmSample(k, 1, 4_940_000_000 + 10**7 * k, pose, trigger_id=k + 3)
        recorder.add_samples((TimedSample(sample, None, ElementStatus.USABLE, pose),))
    recorder.close()
    recorded = read_recording(tmp_path / "scan.mcap")
    poses = exposure_poses(recorded.rows, recorded.arm, recorded.session.clock)
    assert poses.has_pose.all() and not any("trigger id" in text for text in poses.warnings)
    # they order, and place nothing
    assert recorded.session.clock == "separate" and recorded.warnings == ()


def test_frames_before_the_first_trigger_are_listed_and_get_no_pose(tmp_path: Path) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    for k in range(5):
        recorder.add_instant(instant(k, None, trigger_id=k if k > 1 else None))
        pose = triggered_scan(5).truth[k]
        sample = ArmSample(k, 1, 5_000_000_000 + 10**7 * k, pose, trigger_id=k if k > 1 else None)
        recorder.add_samples((TimedSample(sample, None, ElementStatus.USABLE, pose),))
    recorder.close()
    assert (recorder.n_untriggered, recorder.n_aside, recorder.n_usable) == (2, 0, 3)
    recorded = read_recording(tmp_path / "scan.mcap")
    assert recorded.exposure_columns["flags"] == ("no-trigger", "no-trigger", "", "", "")
    poses = exposure_poses(recorded.rows, recorded.arm, recorded.session.clock)
    none, found = int(PoseStatus.NO_TRIGGER), int(PoseStatus.FOUND)
    assert poses.status.tolist() == [none, none, found, found, found]


def test_counts_that_both_begin_anew_give_the_poses_that_were_shown(tmp_path: Path) -> None:
    # the camera was away for triggers 3 and 4 of the first count; x is the number of the step
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    matcher = InstantMatcher(is_triggered=True, has_controller=False)
    shown: list[float] = []
    for k in range(12):
        number, t_ns = k % 6, 10**10 + 10**9 * k
        pose = Pose[Base, Tool](np.eye(3), np.array([float(k), 0.0, 0.0]))
        sample = ArmSample(k, t_ns, t_ns + 5_000_000, pose, trigger_id=number)
        recorder.add_samples(matcher.add_samples((sample,)))
        if k not in (3, 4):
            matcher.add_frame(Frame(IMAGES[0], k, t_ns, t_ns + 6_000_000, trigger_id=number))
        for one in matcher.take(t_ns + 10**9):
            recorder.add_instant(one)
            shown += [] if one.pose is None else [float(one.pose.translation_mm[0])]
    recorder.close()
    recorded = read_recording(tmp_path / "scan.mcap")
    poses = exposure_poses(recorded.rows, recorded.arm, recorded.session.clock)
    assert shown == [0, 1, 2, 5, 6, 7, 8, 9, 10, 11]
    assert poses.has_pose.all() and poses.translations_mm[:, 0].tolist() == shown
    assert recorded.warnings == poses.warnings == ()


def counted(
    path: Path,
    n: int,
    arm_of: Count,
    *cameras_of: Count,
    late_ns: Callable[[int], int] = lambda _: 0,
    step_ns: int = 10**8,
) -> tuple[LiveRecorder, list[int], list[list[int]]]:
    """A recording of n triggers, by what id each device gives to each of them.

    Returns of which triggers an image had a pose when it was shown, and then by camera.
    """
    cameras: Any = [Device("camera", [], setup=CameraSetup(16, 12)) for _ in cameras_of]
    arm: Any = Device("arm", [], pose_form="quaternion")
    names = tuple(map(str, range(len(cameras))))
    rig = Rig(cameras, arm, None, RigDescription(names, is_common_trigger=True))
    recorder = LiveRecorder(path, rig)
    recorder.begin()
    matcher = InstantMatcher(len(cameras), is_triggered=True, has_controller=False)
    shown: list[int] = []
    begun_ns = 10**10
    elements: list[tuple[Any, int]] = []
    for k in range(n):
        t_ns = begun_ns + step_ns * k
        pose = Pose[Base, Tool](np.eye(3), np.array([float(k), 0.0, 0.0]))
        host_ns = t_ns + 5_000_000 + late_ns(k)
        elements.append((ArmSample(k, t_ns, host_ns, pose, trigger_id=arm_of(k)), -1))
        for camera, id_of in enumerate(cameras_of):
            if id_of(k) is not None:
                frame = Frame(IMAGES[camera], k, t_ns, t_ns + 6_000_000, trigger_id=id_of(k))
                elements.append((frame, camera))
    elements.sort(key=lambda element: element[0].t_host_ns)
    for one, camera in elements:
        if isinstance(one, ArmSample):
            recorder.add_samples(matcher.add_samples((one,)))
        else:
            matcher.add_frame(one, camera)
        is_last = one is elements[-1][0]
        for instant in matcher.take(one.t_host_ns + is_last * 10**9):
            recorder.add_instant(instant)
            if instant.pose is not None:
                shown.append(round(instant.pose.translation_mm[0]))
    recorder.close()
    if not recorder.n_samples or recorder.unplaced[0]:
        return recorder, shown, [[] for _ in cameras]
    recorded = read_recording(path)
    poses = exposure_poses(recorded.rows, recorded.arm, recorded.session.clock)
    posed: list[list[int]] = [[] for _ in cameras]
    for row in np.flatnonzero(poses.has_pose):
        true = round((recorded.rows[row].t_ns - begun_ns) / step_ns)
        assert round(poses.translations_mm[row, 0]) == true
        posed[recorded.rows[row].camera].append(true)
    return recorder, shown, posed


OTHER_COUNTS: list[tuple[str, Count, Count, int]] = [
    ("sound", lambda k: k, lambda k: k, 160),
    ("camera away, then counts anew",
     lambda k: k, lambda k: k if k < 40 else None if k < 70 else k - 70, 40),
    ("both count anew", lambda k: k % 80, lambda k: None if 40 <= k < 60 else k % 80, 140),
    ("the arm counts anew", lambda k: k % 80, lambda k: k, 80),
    ("the camera counts anew", lambda k: k, lambda k: k % 80, 80),
    ("16 bits", lambda k: (k + 65456) % 65536, lambda k: (k + 65456) % 65536, 160),
    ("the camera is behind", lambda k: k + 50, lambda k: k, 0),
    ("the camera is ahead", lambda k: k, lambda k: k + 50, 0),
]  # fmt: skip


@pytest.mark.parametrize(
    ("arm_of", "camera_of", "n_posed"),
    [pytest.param(*given, id=name) for name, *given in OTHER_COUNTS],
)
def test_an_id_of_another_count_gives_no_pose(
    arm_of: Count, camera_of: Count, n_posed: int, tmp_path: Path
) -> None:
    recorder, shown, posed = counted(tmp_path / "scan.mcap", 160, arm_of, camera_of)
    assert posed == [shown] and len(shown) == n_posed
    words, _ = recorder.unplaced
    assert words.startswith("no trigger's id is that of an image") != bool(n_posed)
    n_other = recorder.n_of_other_count + recorder.n_samples_of_other_count
    assert (n_other > 0) == (n_posed < 100)


def test_counts_that_were_apart_by_a_second_are_told_by_clocks_that_are_known(
    tmp_path: Path,
) -> None:
    counts: tuple[Count, Count] = (lambda k: k, lambda k: k + 100)
    recorder, shown, _ = counted(tmp_path / "scan.mcap", 200, *counts, step_ns=12_500_000)
    assert shown == [] and recorder.unplaced[0].startswith("no trigger's id is that of an image")


def test_a_camera_that_counts_otherwise_takes_no_pose_from_the_other_one(tmp_path: Path) -> None:
    cameras: tuple[Count, Count] = (lambda k: k, lambda k: k + 50)
    recorder, shown, posed = counted(tmp_path / "scan.mcap", 160, lambda k: k, *cameras)
    assert len(shown) == 160 and posed[1] == []
    # but for the ids that it bore before its clock was known
    assert len(posed[0]) == 160 - recorder.n_samples_of_other_count >= 160 - 32


@pytest.mark.parametrize("since", [0, 60])
def test_samples_that_come_late_keep_their_ids(since: int, tmp_path: Path) -> None:
    """Up to 1.9 s, before clocks are known and after: no pose is shown, and all have one."""

    def late(k: int) -> int:
        return 1_900_000_000 - 10**8 * (k - since) if 0 <= k - since < 19 else 0

    path = tmp_path / "scan.mcap"
    recorder, shown, posed = counted(path, 160, lambda k: k, lambda k: k, late_ns=late)
    assert posed == [list(range(160))] and len(shown) < 150
    assert recorder.n_of_other_count == recorder.n_samples_of_other_count == 0


def test_an_arm_that_is_always_late_and_stalls_keeps_its_images(tmp_path: Path) -> None:
    """A quarter of a second late, and another 0.4 s once its clock is known."""

    def late(k: int) -> int:
        return 250_000_000 + max(0, 400_000_000 - 50_000_000 * (k - 100)) * (k >= 100)

    path, step_ns = tmp_path / "scan.mcap", 50_000_000
    recorder, _, posed = counted(path, 200, lambda k: k, lambda k: k, late_ns=late, step_ns=step_ns)
    assert posed == [list(range(200))] and recorder.n_of_other_count == 0


def test_samples_that_a_transport_held_back_for_long_keep_their_ids(tmp_path: Path) -> None:
    """For three seconds, by a transport whose jitter leaves the arm's clock unknown."""
    jitter_ns = np.random.default_rng(0).exponential(2e6, 160).astype(int).tolist()

    def late(k: int) -> int:
        return max(int(jitter_ns[k]), (3_000_000_000 - 10**8 * (k - 60)) * (k >= 60))

    path = tmp_path / "scan.mcap"
    recorder, _, posed = counted(path, 160, lambda k: k, lambda k: k, late_ns=late)
    assert posed == [list(range(160))] and recorder.n_samples_of_other_count == 0


def test_ids_are_kept_in_eight_bytes_a_device() -> None:
    ids, n = CommonIds(), 20_000
    sample = ArmSample(0, 1, 10**10)
    one = TimedSample(sample, 10**10, ElementStatus.USABLE, None)
    tracemalloc.start()
    for k in range(n):
        assert ids.see_sample(10**6 + k, one) and ids.see_frame(10**6 + k, FRAME, TIMED)
    n_bytes = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert ids.is_found and n_bytes < 20 * n


@pytest.mark.parametrize(
    ("is_triggered", "changes", "reason"),
    [
        (True, {}, ""),
        (True, {"trigger_id": 10**6}, "no trigger's id is that of an image"),
        (True, {"trigger_id": None}, "no sample of the arm bears"),
        (True, {"pose": None}, "none of 5 samples of the arm has a pose"),
        (False, {}, ""),
        (False, {"pose": None}, "none of 5 samples of the arm has a pose"),
        (False, {"t_host_ns": 10**9}, "none came while the arm sent"),
        (False, {"t_host_ns": None}, "the arm sent no sample"),
    ],
)
def test_why_nothing_can_be_placed_is_known_at_the_end(
    is_triggered: bool, changes: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=is_triggered))
    recorder.begin()
    for k in range(5):
        t_ns = 5_000_000_000 + 10**7 * k
        recorder.add_instant(instant(k, t_ns))
        pose = triggered_scan(5).truth[k]
        sample = replace(ArmSample(k, 1, t_ns, pose, trigger_id=k + 3), **changes)
        if sample.t_host_ns is not None:
            timed = TimedSample(sample, sample.t_host_ns + k, ElementStatus.USABLE, sample.pose)
            recorder.add_samples((timed,))
    recorder.close()
    assert recorder.n_usable == 5
    words = recorder.unplaced[0]
    assert words.startswith(reason) if reason else recorder.unplaced == ("", "")


@pytest.mark.parametrize(("trigger", "n_instants"), [("free", 80), ("external", 40)])
def test_cameras_of_their_own_clock_keep_their_times(
    trigger: Any, n_instants: int, tmp_path: Path
) -> None:
    """7 ms apart at 30 Hz: a wire says that they are of one moment, their own clocks that not."""
    cameras: Any = [Device(f"camera {k}", [], setup=CameraSetup(16, 12)) for k in (0, 1)]
    rig = Rig(cameras, description=RigDescription(("c", "d"), trigger=trigger))
    recorder = LiveRecorder(tmp_path / "scan.mcap", rig)
    recorder.begin()
    matcher = InstantMatcher(2, has_arm=False, has_controller=False)
    for k in range(80):
        for camera in (0, 1):
            t_ns = 10**10 + 33_000_000 * k + 7_000_000 * camera
            matcher.add_frame(Frame(IMAGES[camera], k, t_ns, t_ns + 12_000_000), camera)
        for one in matcher.take(t_ns):
            if k >= 40:
                recorder.add_instant(one)
    recorder.close()
    rows = read_recording(tmp_path / "scan.mcap").rows
    assert len(rows) == 80 and len(group_instants(rows, "")) == n_instants
    apart_ns = {b.t_ns - a.t_ns for a, b in zip(rows[::2], rows[1::2], strict=True)}
    assert apart_ns == {7_000_000 if trigger == "free" else 0}


def test_a_band_is_kept_where_no_controller_says_that_a_laser_is_on(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(8, 12, (120, 160)).astype(np.uint8)
    pixels[58:62] = 200
    for k, lasers in enumerate((None, ("A",), ())):
        path = tmp_path / f"{k}.mcap"
        rig: Any = Rig([Device("camera 0", [], setup=CameraSetup(160, 120))])  # type: ignore[list-item]
        recorder = LiveRecorder(path, rig, options=WriterOptions(is_stripe_band=True))
        recorder.begin()
        one = instant(0, 10**9, image=pixels, lasers=lasers)
        recorder.add_instant(replace(one, lasers=lasers))
        recorder.close()
        is_dark = lasers == ()
        assert (read_recording(path).exposure(0).image == 0).any() != is_dark


def test_the_last_pose_of_a_slow_arm_is_written_when_it_is_old(tmp_path: Path) -> None:
    """One pose a posture: it must not wait for the next one, which may never come."""
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    now_ns = time.monotonic_ns()
    pose = triggered_scan(1).truth[0]
    sample = ArmSample(0, now_ns, now_ns, pose, trigger_id=3)
    recorder.add_samples((TimedSample(sample, now_ns, ElementStatus.USABLE, pose),))
    assert recorder.n_samples == 0
    time.sleep(0.11)
    recorder.add_frame(0, Frame(IMAGES[0], 0, now_ns, now_ns), ElementStatus.USABLE)
    assert recorder.n_samples == 1
    recorder.close()


@pytest.mark.parametrize("has_none", ["frames", "samples"])
def test_times_that_only_order_give_no_pose_where_no_id_is(tmp_path: Path, has_none: str) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    for k in range(5):
        of_frame = None if has_none == "frames" else k
        of_sample = None if has_none == "samples" else k
        # by arrival both tables span the same time
        recorder.add_instant(instant(k, None, trigger_id=of_frame))
        pose = triggered_scan(5).truth[k]
        sample = ArmSample(k, 1, 5_000_000_000 + 10**7 * k, pose, trigger_id=of_sample)
        recorder.add_samples((TimedSample(sample, None, ElementStatus.USABLE, pose),))
    recorder.close()
    recorded = read_recording(tmp_path / "scan.mcap")
    lacking = "exposure" if has_none == "frames" else "sample of the arm"
    with pytest.raises(InputError, match=f"no {lacking} bears a trigger id"):
        exposure_poses(recorded.rows, recorded.arm, recorded.session.clock)
    assert describe_recording(tmp_path / "scan.mcap")["exposures_with_pose"] == 0
    # as armscan wrote it before
    if has_none == "frames":
        with pytest.raises(EstimationError, match="5 without trigger id"):
            exposure_poses(recorded.rows, recorded.arm, "related")


def test_images_whose_lasers_are_not_known_are_marked_and_counted(tmp_path: Path) -> None:
    rig = small_rig(is_triggered=False)
    rig.lasers = Device("lasers", [])
    recorder = LiveRecorder(tmp_path / "scan.mcap", rig)
    recorder.begin()
    for k, lasers in enumerate((("A",), None, (), None)):
        recorder.add_instant(replace(instant(k, 10**9 * (k + 1)), lasers=lasers))
    recorder.add_instant(replace(instant(4, None), lasers=None))
    recorder.close()
    # the last has no time either: it is set aside, and counted there
    assert (recorder.n_laser_unknown, recorder.n_aside, recorder.n_usable) == (2, 1, 2)
    recorded = read_recording(tmp_path / "scan.mcap")
    assert [row.flags for row in recorded.rows] == [(), (LASER_UNKNOWN,), (), (LASER_UNKNOWN,)]
    assert [row.is_dark for row in recorded.rows] == [False, False, True, False]
    assert describe_recording(tmp_path / "scan.mcap")["exposures_with_lasers_unknown"] == 2
    write_recording(tmp_path / "again", recorded)
    assert read_recording(tmp_path / "again").rows == recorded.rows


def test_angles_that_an_arm_calls_inaccurate_are_gaps(tmp_path: Path) -> None:
    rig = small_rig(is_triggered=False, form="joints")
    recorder = LiveRecorder(tmp_path / "scan.mcap", rig)
    recorder.begin()
    said = (ArmFlag.REFERENCED, ArmFlag.NONE, ArmFlag.REFERENCED | ArmFlag.INACCURATE)
    for k, flags in enumerate(said):
        recorder.add_instant(instant(k, 10**9 * (k + 1)))
        own = ArmSample(k, 1, 10**9 * (k + 1), joints_rad=np.full(7, 0.1 * k), flags=flags)
        recorder.add_samples((TimedSample(own, own.t_host_ns, ElementStatus.USABLE, None),))
    recorder.close()
    table = read_csv(tmp_path / "scan.mcap" / "arm.csv")
    assert [cell != "" for cell in table.columns["j1_rad"]] == [True, False, False]


def test_joints_are_recorded_with_the_arm_s_document(tmp_path: Path) -> None:
    model = thesis_arm((300.0, 600.0, 500.0, 200.0), (40.0, 40.0, 40.0))
    rig = small_rig(is_triggered=True, form="joints", arm_model=model)
    recorder = LiveRecorder(tmp_path / "scan.mcap", rig)
    recorder.begin()
    joints = np.random.default_rng(2).uniform(-0.5, 0.5, (3, 7))
    rotations, places = forward(model, joints)
    scan = triggered_scan(1)
    for k in range(3):
        recorder.add_instant(instant(k, 10**9 * (k + 1)))
        own = ArmSample(
            k, 1, 10**9 * (k + 1), joints_rad=joints[k], trigger_id=k + 3,
            flags=ArmFlag.NONE if k == 1 else ArmFlag.REFERENCED,
        )  # fmt: skip
        pose = None if k == 1 else scan.truth[0]
        recorder.add_samples((TimedSample(own, 10**9 * (k + 1), ElementStatus.USABLE, pose),))
    recorder.close()
    recorded, _, _ = read_back(tmp_path / "scan.mcap")
    assert recorded.session.pose_form == "joints"
    assert recorded.arm.is_known.tolist() == [True, False, True]
    np.testing.assert_allclose(recorded.arm.translations_mm[::2], places[::2], atol=1e-9)
    np.testing.assert_allclose(recorded.arm.rotations[::2], rotations[::2], atol=1e-12)


def add_posed(recorder: LiveRecorder, samples: list[ArmSample]) -> None:
    """Exposures and samples of triggers from 3 on, their poses as they are sent."""
    for k, one in enumerate(samples):
        recorder.add_instant(instant(k, 10**9 * (k + 1)))
        own = replace(one, trigger_id=k + 3, t_host_ns=10**9 * (k + 1))
        pose = own.pose if ArmFlag.REFERENCED in own.flags else None
        recorder.add_samples((TimedSample(own, 10**9 * (k + 1), ElementStatus.USABLE, pose),))


def test_joint_angles_beside_poses_are_recorded_too(tmp_path: Path) -> None:
    """Also where the first samples have none: no column of a later one is lost."""
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    joints = np.random.default_rng(2).uniform(-0.5, 0.5, (4, 6))
    pose = triggered_scan(1).truth[0]
    empty = ArmSample(0, 1, 0, flags=ArmFlag.NONE)
    both = [replace(empty, number=k, pose=pose, joints_rad=joints[k]) for k in range(4)]
    flags = (ArmFlag.NONE, ArmFlag.REFERENCED, ArmFlag.REFERENCED)
    add_posed(recorder, [empty, *(replace(both[k + 1], flags=one) for k, one in enumerate(flags))])
    recorder.close()
    assert (recorder.n_samples, recorder.n_posed) == (4, 2)
    recorded, _, _ = read_back(tmp_path / "scan.mcap")
    assert recorded.session.pose_form == "quaternion"
    assert recorded.arm.is_known.tolist() == [False, False, True, True]
    np.testing.assert_array_equal(recorded.arm.joints_rad[2:], joints[2:])
    assert np.isnan(recorded.arm.joints_rad[:2]).all()
    np.testing.assert_allclose(recorded.arm.translations_mm[2], pose.translation_mm, atol=1e-9)
    # the gaps alone are told: two ways of saying one pose are no contradiction
    assert [note for note in recorded.warnings if "samples have no pose" not in note] == []
    assert describe_recording(tmp_path / "scan.mcap")["has_joints"] is True


def test_joint_angles_of_an_arm_that_showed_nothing_at_first_are_kept(tmp_path: Path) -> None:
    recorder = LiveRecorder(tmp_path / "scan.mcap", small_rig(is_triggered=True))
    recorder.begin()
    joints = np.random.default_rng(2).uniform(-0.5, 0.5, (3, 6))
    add_posed(recorder, [ArmSample(k, 1, 0, joints_rad=joints[k]) for k in range(3)])
    recorder.close()
    assert (recorder.n_samples, recorder.n_posed) == (3, 0)
    recorded, _, _ = read_back(tmp_path / "scan.mcap")
    assert not recorded.arm.is_known.any()
    np.testing.assert_array_equal(recorded.arm.joints_rad, joints)
