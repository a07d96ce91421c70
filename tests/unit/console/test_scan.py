# SPDX-License-Identifier: Apache-2.0
"""A scan of a session on a drawn rig, its recording and what is shown; placements as drawings."""

from __future__ import annotations

import errno
import re
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

import armscan.console.journey as journey_module
from armscan.console.cards import live_facts
from armscan.console.journey import SeeingSettings, SessionSettings, StepName
from armscan.console.placements import (
    CAMERA,
    HAND_EYE,
    HEIGHT,
    LASER,
    TOUCHES,
    WIDTH,
    Placement,
    drawing,
)
from armscan.console.rig import DeviceBench, _Hand, _HandArm, _HandCamera, take_back
from armscan.console.scan import LiveScan, ScanRecorder
from armscan.console.scene import ShownPoints, depths_mm, point_colours, range_bar, thinned
from armscan.console.work import recover_scans
from armscan.devices.matching import MatchedInstant
from armscan.devices.protocols import Frame, LaserEvent
from armscan.errors import DeviceError, FileFormatError, InputError, OutputError
from armscan.pipeline.live.acquire import LiveEvent, WaitingInstant
from armscan.pipeline.live.exposure import ExposureSettings
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.pipeline.measure import MeasuredInstant
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.reconstruction.place import BaseTransform
from armscan.reconstruction.sync import PoseStatus
from armscan.records.exposure import Exposure, SensorWindow
from armscan.storage.recording import read_recording
from armscan.storage.recordings import mcap_file
from rigs.console_rig import DrawnBench, FailingBench, drawn_scan, waited
from rigs.scan_fake import scanner


def test_what_is_recorded_is_what_was_shown(tmp_path: Path) -> None:
    bench = DrawnBench(10)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01.mcap", scanner())
    live.start()
    waited(lambda: bench.is_over and sum(live.snapshot.counts.values()) == 10)
    live.stop()
    recorded = read_recording(tmp_path / "scan-01.mcap")
    assert [row.trigger_id for row in recorded.rows] == list(range(10))
    assert {row.lasers for row in recorded.rows} == {("A",)}
    # a simulated hand's way keeps its times, however long its images took
    source = drawn_scan(10)
    assert [row.t_ns for row in recorded.rows] == [row.t_ns for row in source.rows]
    assert recorded.arm.t_ns.tolist() == source.arm.t_ns.tolist()
    cloud = measure_scan(recorded, scanner(), ScanOptions(has_normals=False)).cloud
    direct = measure_scan(drawn_scan(10), scanner(), ScanOptions(has_normals=False)).cloud
    # poses pass a table of 17 digits
    np.testing.assert_allclose(cloud.points_mm, direct.points_mm, atol=1e-9)
    shown = live.session.cloud().points_mm
    assert {tuple(p) for p in np.round(shown, 6).tolist()} <= {
        tuple(p) for p in np.round(cloud.points_mm, 6).tolist()
    }


def test_a_pass_taken_back_is_in_neither_cloud_nor_recording(tmp_path: Path) -> None:
    bench = DrawnBench(16, rate_hz=20.0)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01.mcap", scanner())
    live.start()
    waited(lambda: sum(live.snapshot.counts.values()) >= 5)
    live.pause()
    n_counted = -1
    while n_counted != (n_counted := sum(live.snapshot.counts.values())):
        time.sleep(0.5)  # what came before the pause is measured
    n_first = live.n_recorded
    before = set(live.session.cloud().exposure.tolist())
    live.start()
    waited(lambda: bench.is_over and live.n_recorded >= 14)
    live.session.stop()
    assert live.snapshot.n_passes == 2
    live.undo_pass()
    live.stop()
    assert set(live.session.cloud().exposure.tolist()) == before
    rows = read_recording(tmp_path / "scan-01.mcap").rows
    # an exposure that arrived while the pause began belongs to no pass that was taken back
    assert n_first - 1 <= len(rows) <= n_first + 1
    assert [row.trigger_id for row in rows][: len(before)] == list(range(len(before)))


def test_a_pass_of_which_nothing_is_shown_yet_is_taken_back_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = DrawnBench(30, rate_hz=20.0)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01.mcap", scanner())
    told: list[str] = []
    live.session.add_listener(lambda event: told.append(event.text))
    live.undo_pass()
    assert told[-1] == "there is no pass to take back"
    live.start()
    waited(lambda: sum(live.snapshot.counts.values()) >= 5)
    live.pause()
    n_counted = -1
    while n_counted != (n_counted := sum(live.snapshot.counts.values())):
        time.sleep(0.5)
    n_first, shown = live.n_recorded, live.session.cloud().exposure.tolist()
    place = live.session._place

    def place_late(one: MeasuredInstant, waiting: WaitingInstant, transform: BaseTransform) -> None:
        time.sleep(0.5)
        place(one, waiting, transform)

    monkeypatch.setattr(live.session, "_place", place_late)
    live.start()
    waited(lambda: live.n_recorded >= n_first + 3)
    live.pause()
    live.undo_pass()
    assert live.session.cloud().exposure.tolist() == shown
    assert n_first - 1 <= live.n_recorded <= n_first + 1
    live.undo_pass()
    assert live.snapshot.n_passes == 0 and live.n_recorded <= 1
    live.stop()


def full_disk(monkeypatch: pytest.MonkeyPatch, room: int) -> list[int]:
    """A disk with room for so many bytes; what is in the list is room that came later."""
    left, write = [room], mcap_file._write_some

    def some(handle, pieces):
        if left[0] <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        left[0] -= sum(map(len, pieces))
        return write(handle, pieces)

    monkeypatch.setattr(mcap_file, "_write_some", some)
    return left


def test_an_arms_button_counts_from_the_begin_on(tmp_path: Path) -> None:
    live = LiveScan(FailingBench(), StepName.SCAN, tmp_path / "scan-01.mcap", scanner())
    button = LiveEvent("button", "0", "arm")
    live.session._tell(button)
    live.open()
    live.session._tell(button)
    live.start()
    assert button not in live.events
    live.session._tell(button)
    assert live.events.count(button) == 1
    live.pause()
    assert "Paused: nothing is recorded." in live_facts(live, live.snapshot, None)
    fast = replace(live.snapshot, rate_hz=119.8)
    assert "119.8 a second" in live_facts(live, fast, None)
    # what came a minute ago is neither the rate nor the distance of now
    minute_ago_ns = time.monotonic_ns() - 60 * 10**9
    live.session._arrivals.extend(minute_ago_ns + 10**7 * k for k in range(500))
    live.session._ranged = minute_ago_ns, 130.0
    assert live.snapshot.rate_hz < 10.0 and live.snapshot.range_mm is None
    live.session.stop()


def test_a_disk_that_is_full_is_told_and_what_was_written_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = DrawnBench(40, rate_hz=10.0)
    path = tmp_path / "recordings" / "scan-01.mcap"
    live = LiveScan(bench, StepName.SCAN, path, scanner())
    left = full_disk(monkeypatch, room=400_000)
    live.start()
    waited(lambda: any("No space left" in event.text for event in live.events))
    assert not live.session.is_recording
    n_shown = live.snapshot.n_points
    waited(lambda: live.snapshot.n_points > n_shown)  # it goes on to show
    with pytest.raises(OutputError, match=r"of \d+ are safe"):
        live.stop()
    left[0] = 1 << 30
    assert journey_module.Journey(tmp_path, SessionSettings()).cut_short == (path,)
    assert "were saved" in recover_scans(tmp_path)[0]
    recorded = read_recording(path)
    assert 0 < len(recorded.rows) < 40
    assert [row.trigger_id for row in recorded.rows] == list(range(len(recorded.rows)))
    assert all(recorded.exposure(k).image.any() for k in range(len(recorded.rows)))


def test_a_killed_scan_is_saved_when_the_session_is_opened_again(tmp_path: Path) -> None:
    bench = DrawnBench(10, rate_hz=40.0)
    journey = journey_module.open_journey(tmp_path / "s")
    path = journey.recording(StepName.SCAN, "scan-01")
    live = LiveScan(bench, StepName.SCAN, path, scanner())
    live.start()
    waited(lambda: live.recorder.status().n_written == 10)
    killed = path.read_bytes()
    live.stop()
    assert journey.scans == ("scan-01",) and journey.cut_short == ()
    path.with_name("scan-02.mcap").write_bytes(killed)
    path.with_name("scan-03.mcap").write_bytes(killed[:300])
    assert journey.scans == ("scan-01",) and len(journey.cut_short) == 2
    saved, lost = recover_scans(journey.folder)
    assert "10 exposures were saved" in saved and "scan-03.aside" in lost
    assert journey.scans == ("scan-01", "scan-02") and journey.cut_short == ()
    assert journey.n_taken(StepName.SCAN, "scan-02") == 10
    assert journey.new_scan() == "scan-04"
    assert (path.parent / "scan-03.aside").read_bytes() == killed[:300]


@pytest.mark.parametrize("is_damaged", [False, True])
def test_what_took_the_place_of_a_recording_that_was_cut_short_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_damaged: bool
) -> None:
    place = tmp_path / "recordings" / "check.mcap"
    place.parent.mkdir()
    place.write_bytes(b"cut")

    def recover(path: Path, whole: Path, *, is_overwriting: bool) -> None:
        whole.write_bytes(b"saved")
        path.unlink()
        path.write_bytes(b"begun meanwhile")
        if is_damaged:
            whole.unlink()
            raise FileFormatError("nothing can be used")

    monkeypatch.setattr("armscan.console.work.recover_recording", recover)
    assert recover_scans(tmp_path) == ()
    assert [one.name for one in place.parent.iterdir()] == ["check.mcap"]
    assert place.read_bytes() == b"begun meanwhile"


def test_devices_are_taken_from_one_placement_at_a_time(tmp_path: Path) -> None:
    hand = _Hand(drawn_scan(40), rate_hz=50.0, is_held=False)
    rig = Rig(
        [_HandCamera(hand, 0)], _HandArm(hand), None, RigDescription(("d",), is_common_trigger=True)
    )
    bench = DeviceBench(rig, "rig.toml")
    for k in range(2):
        assert len(bench.take(StepName.HAND_EYE, tmp_path / "r", k)) == 1
    found = read_recording(tmp_path / "r")
    assert [row.view for row in found.rows] == ["01", "01", "02", "02"]
    assert found.arm.is_known.all() and len(found.arm.t_ns) == 4
    assert len(bench.look(StepName.HAND_EYE, 2)) == 1
    # what was taken last is taken back, and the next take goes on from there
    take_back(StepName.HAND_EYE, tmp_path / "r")
    found = read_recording(tmp_path / "r")
    assert [row.view for row in found.rows] == ["01", "01"] and len(found.arm.t_ns) == 2
    bench.take(StepName.HAND_EYE, tmp_path / "r", 1)
    assert [row.view for row in read_recording(tmp_path / "r").rows] == ["01", "01", "02", "02"]
    bench.close()


def test_light_sheets_are_not_taken_without_a_laser_controller(tmp_path: Path) -> None:
    bench = FailingBench()
    with pytest.raises(DeviceError, match="no laser controller"):
        bench.take(StepName.LASER, tmp_path / "r", 0)
    assert not (tmp_path / "r").exists()


class TellingLasers:
    """A laser that says what it was asked for."""

    name, sources = "drawn laser", ("A",)

    def __init__(self) -> None:
        self.asked: list[object] = []

    def set_schedule(self, steps: Sequence[tuple[str, ...]]) -> None:
        self.asked.append(("schedule", *steps))

    def set_next(self, lasers: tuple[str, ...]) -> None:
        self.asked.append(lasers)

    def start(self, rate_hz: float | None) -> None:
        self.asked.append("start")

    def read(self, timeout_s: float) -> tuple[LaserEvent, ...]:
        time.sleep(timeout_s)
        return ()

    def stop(self) -> None:
        self.asked.append("off")

    def close(self) -> None:
        self.asked.append("closed")


def test_lasers_are_on_only_where_the_step_needs_them_and_off_afterwards() -> None:
    hand, lasers = _Hand(drawn_scan(40), rate_hz=50.0, is_held=False), TellingLasers()
    description = RigDescription(("d",), is_common_trigger=True)
    rig = Rig([_HandCamera(hand, 0)], _HandArm(hand), lasers, description)
    bench = DeviceBench(rig, "rig.toml")
    assert lasers.asked == [], "a page that is opened turns nothing on"
    for step in (StepName.CAMERA, StepName.CAMERA, StepName.HAND_EYE):
        bench.look(step, 0)
    bench.rest()
    assert lasers.asked == ["start", (), "off", "start", ("A",), "off"]
    bench.close()


def test_lasers_go_off_where_a_take_fails_and_before_a_camera_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand, lasers = _Hand(drawn_scan(40), rate_hz=50.0), TellingLasers()
    automatic = ExposureSettings("automatic")
    description = RigDescription(("d",), is_common_trigger=True, exposure=automatic)
    rig = Rig([_HandCamera(hand, 0)], _HandArm(hand), lasers, description)
    bench = DeviceBench(rig, "rig.toml")
    monkeypatch.setattr("armscan.console.rig.WAIT_S", 0.05)
    with pytest.raises(DeviceError, match="no complete image"):
        bench.take(StepName.HAND_EYE, tmp_path / "r", 0)
    assert lasers.asked == ["start", ("A",), ()]
    for control in bench._watched[0]._controls:
        monkeypatch.setattr(control, "stop", lambda: lasers.asked.append("waited"))
    bench.rest()
    assert lasers.asked[3:] == ["off", "waited", "off"]
    bench.close()


@pytest.mark.parametrize("placement", [*CAMERA, *LASER, *HAND_EYE, *TOUCHES])
def test_drawings_stay_in_their_frame(placement: Placement) -> None:
    svg = drawing(placement)
    pairs = [
        (float(x), float(y))
        for text in re.findall(r'points="([^"]*)"', svg)
        for x, y in (pair.split(",") for pair in text.split())
    ]
    x, y = np.array([*pairs, (0.0, 0.0)]).T
    assert (x >= 0).all() and (x <= WIDTH).all() and (y >= 0).all() and (y <= HEIGHT).all()


@pytest.mark.parametrize(
    ("words", "shorter", "longer"),
    [("upper edge away", 0, 2), ("left edge away", 3, 1), ("right edge away", 1, 3)],
)
def test_an_edge_that_is_said_to_be_away_is_drawn_shorter(
    words: str, shorter: int, longer: int
) -> None:
    plain = [one for one in CAMERA if words in one.words and "turned" not in one.words]
    assert plain
    for one in plain:
        outline = re.search(r'polygon points="([^"]*)"', drawing(one))[1]
        corners = np.array([pair.split(",") for pair in outline.split()], dtype=float)
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        assert sides[shorter] < sides[longer]


def test_the_range_bar_says_where_to_move() -> None:
    low, high = depths_mm(scanner().sensor)
    assert (low, high) == (115.0, 160.0)
    assert "move away" in range_bar(100.0, low, high)
    assert "move nearer" in range_bar(170.0, low, high)
    assert "move" not in range_bar(140.0, low, high)
    assert "no surface" in range_bar(None, low, high)


def test_the_green_zone_is_where_more_than_half_of_the_sheets_are_calibrated() -> None:
    def with_depths(*depths: tuple[float, float]) -> tuple[float, float]:
        sensor: Any = SimpleNamespace(sheets=[SimpleNamespace(depth_range_mm=d) for d in depths])
        return depths_mm(sensor)

    assert with_depths((100.0, 160.0)) == (100.0, 160.0)
    assert with_depths((100.0, 160.0), (110.0, 170.0)) == (110.0, 160.0)
    # lines of a fan: the first is calibrated nearer than the last begins; at 119.5 mm two are
    fan = ((100.0, 119.0), (100.0, 144.0), (114.0, 173.0), (120.0, 177.0), (123.0, 184.0))
    low, high = with_depths(*fan)
    assert (low, high) == (120.0, 173.0)
    assert "move" not in range_bar(150.0, low, high)
    # of eleven no six share a depth; five do
    steps = tuple((100.0 + 5.0 * k, 125.0 + 5.0 * k) for k in range(11))
    assert with_depths(*steps) == (120.0, 155.0)
    assert with_depths((100.0, 119.0), (100.0, 120.0), (121.0, 184.0), (124.0, 190.0)) == (
        124.0,
        184.0,
    )
    # two that share no depth: the longer one
    assert with_depths((100.0, 119.0), (123.0, 184.0)) == (123.0, 184.0)


def test_two_million_points_are_shown_and_more_are_thinned_to_them() -> None:
    assert len(range(2_000_000)[thinned(2_000_000)]) == 2_000_000
    for n in (2_000_001, 7_654_321):
        assert 1_000_000 < len(range(n)[thinned(n)]) <= 2_000_000


def test_colours_say_what_they_mean() -> None:
    n = 50
    points = np.random.default_rng(2).uniform(0, 1, (n, 3))
    sheet, sigma = np.arange(n) % 2, np.linspace(0.01, 0.02, n)
    shown = ShownPoints(points, sheet, sigma, None, np.linspace(-0.2, 0.2, n))
    by_sheet, _ = point_colours(shown, "sheet")
    assert len(np.unique(by_sheet, axis=0)) == 2
    colours, text = point_colours(shown, "deviation")
    assert "0.1 mm too low" in text
    # low blue, high red, symmetric about white
    assert colours[0][2] > colours[0][0] and colours[-1][0] > colours[-1][2]
    _, missing = point_colours(shown, "incidence")
    assert missing.startswith("incidence is not known")
    covered, _ = point_colours(
        ShownPoints(np.zeros((9, 3)), np.zeros(9, int), np.ones(9)), "coverage"
    )
    assert covered[0][1] > covered[0][0], "nine points in one cell: green"


def test_windows_and_exposures_are_those_of_the_scan_while_it_runs(tmp_path: Path) -> None:
    bench = FailingBench()
    seeing = SeeingSettings(
        windows=((0, 40, 320, 160),), exposure=ExposureSettings(exposure_us=250.0), photo_us=9000.0
    )
    bench.see(seeing)
    camera = bench.cameras[0]
    assert len(bench.take(StepName.CAMERA, tmp_path / "photo", 0)) == 1
    # photographs show the whole sensor, in the light of the room
    assert camera.settings.size_px == (320, 240) and camera.settings.exposure_us == 9000.0
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01.mcap", scanner(), seeing)
    live.start()
    waited(lambda: live.n_recorded > 2)
    live.stop()
    assert camera.settings.size_px == (320, 160) and camera.settings.exposure_us == 250.0
    assert camera.settings.window == SensorWindow(0, 40)
    bench.take(StepName.HAND_EYE, tmp_path / "posture", 0)
    assert camera.settings.size_px == (320, 240)
    bench.see(None)
    bench.take(StepName.CAMERA, tmp_path / "photo", 1)
    assert camera.settings.exposure_us == 1000.0, "the camera's own again"
    with pytest.raises(InputError, match="2 windows for 1 cameras"):
        bench.see(replace(seeing, windows=seeing.windows * 2))
    bench.close()


def test_what_is_recorded_while_a_pass_is_taken_back_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = DrawnBench(30, rate_hz=20.0)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01.mcap", scanner())
    undo, before = live.session.undo_pass, []

    def undone() -> range:
        numbers = undo()
        before.append(live.recorder.n_exposures)
        waited(lambda: live.recorder.n_exposures >= before[0] + 4)
        return numbers

    monkeypatch.setattr(live.session, "undo_pass", undone)
    live.start()
    waited(lambda: live.snapshot.n_passes == 1 and live.n_recorded >= 5)
    live.undo_pass()
    waited(lambda: bench.is_over)
    live.stop()
    indices = [row.index for row in read_recording(tmp_path / "scan-01.mcap").rows]
    assert indices == list(range(indices[0], 30)) and live.n_recorded == len(indices)
    # one may have been on its way to the recorder
    assert before[0] <= indices[0] <= before[0] + 1


def test_an_instant_that_is_recorded_after_it_was_taken_back_is_not_listed(tmp_path: Path) -> None:
    bench = FailingBench()
    recorder = ScanRecorder(tmp_path / "s.mcap", bench.rig)
    recorder.begin()
    image = np.full((240, 320), 7, dtype=np.uint8)
    for k in range(5):
        if k == 2:
            recorder.leave_out(range(1, 4))
            recorder.leave_out(range(4, 4))  # nothing more
        # a camera that was begun anew counts from zero
        frames = (Frame(image, k % 2, 10**9 * k, 10**9 * k, k),)
        recorder.add_instant(
            MatchedInstant(frames, 10**9 * (k + 1), ("A",), k, None, PoseStatus.NO_TIME, number=k)
        )
    recorder.finish()
    assert [row.index for row in read_recording(tmp_path / "s.mcap").rows] == [0, 4]
    bench.close()


def test_a_simulated_hand_gives_both_cameras_images_at_one_moment() -> None:
    """Rendering takes longer than a matcher waits for a partner."""
    one = drawn_scan(3)
    rows = tuple(
        replace(row, index=2 * k + camera, camera=camera)
        for k, row in enumerate(one.rows)
        for camera in (0, 1)
    )

    class SlowSource:
        def __init__(self) -> None:
            self.rows, self.arm = rows, one.arm
            self.session = replace(one.session, cameras=one.session.cameras * 2)

        def exposure(self, k: int) -> Exposure:
            time.sleep(0.2)
            return one.exposure(k // 2)

    hand = _Hand(SlowSource(), rate_hz=1000.0, is_held=False)  # type: ignore[arg-type]
    for k in range(3):
        assert hand.frame(1, 0.01) is None, "the left one is first"
        left = hand.frame(0, 0.01)
        asked = time.monotonic()
        right = hand.frame(1, 0.01)
        assert time.monotonic() - asked < 0.15 and left is not None and right is not None
        assert left.t_host_ns == right.t_host_ns
        assert (left.number, right.number, left.trigger_id, right.trigger_id) == (k, k, k, k)
    assert hand.is_over and hand.frame(0, 0.01) is None


def test_an_image_that_is_rendered_when_the_scan_ends_has_its_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, begun = DrawnBench(30, rate_hz=20.0), threading.Event()
    render = type(bench.hand.source).exposure

    def render_slowly(source: object, k: int) -> Exposure:
        if k == 3:
            begun.set()
            time.sleep(0.5)
        return render(bench.hand.source, k)

    monkeypatch.setattr(type(bench.hand.source), "exposure", render_slowly)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01.mcap", scanner())
    live.start()
    assert begun.wait(30.0)
    live.stop()
    source = read_recording(tmp_path / "scan-01.mcap")
    assert source.arm is not None and source.arm.trigger_ids is not None
    known = set(source.arm.trigger_ids.tolist())
    assert [row.index for row in source.rows] == [0, 1, 2, 3]
    assert all(row.trigger_id in known for row in source.rows)


def test_both_cameras_of_an_instant_are_taken_back_together(tmp_path: Path) -> None:
    bench = FailingBench(n_cameras=2)
    recorder = ScanRecorder(tmp_path / "s.mcap", bench.rig)
    recorder.begin()
    image = np.full((240, 320), 7, dtype=np.uint8)
    for k in range(4):
        # the cameras count their frames by themselves
        frames = tuple(Frame(image, n, 10**9 * k, 10**9 * k, k) for n in (k, k + 2))
        recorder.add_instant(
            MatchedInstant(frames, 10**9 * (k + 1), ("A",), k, None, PoseStatus.NO_TIME, number=k)
        )
        if k == 2:
            recorder.leave_out(range(1, 3))
            assert (recorder.n_exposures, recorder.n_left_out) == (6, 4)
    recorder.leave_out(range(3, 4))
    recorder.leave_out(range(1, 4))  # are out already
    assert recorder.n_left_out == 6
    recorder.finish()
    rows = read_recording(tmp_path / "s.mcap").rows
    assert [(row.index, row.camera) for row in rows] == [(0, 0), (1, 1)]
    bench.close()
