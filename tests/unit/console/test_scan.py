# SPDX-License-Identifier: Apache-2.0
"""A scan of a session on a drawn rig, its recording and what is shown; placements as drawings."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser")

import armscan.console.scan as scan_module
from armscan.console.journey import SessionSettings, StepName
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
from armscan.console.scan import LiveScan
from armscan.console.scene import ShownPoints, depths_mm, point_colours, range_bar, thinned
from armscan.devices.protocols import LaserEvent
from armscan.devices.sources import ScanSource
from armscan.errors import OutputError
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.records.recording import ArmTrack, CameraSetup, Session
from armscan.storage.files import write_files
from armscan.storage.recording import read_recording
from rigs.scan_fake import CAMERA as DRAWN
from rigs.scan_fake import as_source, fake_scan, scanner


def drawn_scan(n: int) -> ScanSource:
    scan = fake_scan(n)
    poses = [scan.truth[k] for k in range(n)]
    track = ArmTrack(
        t_ns=np.array([row.t_ns for row in scan.rows]),
        rotations=np.array([pose.rotation for pose in poses]),
        translations_mm=np.array([pose.translation_mm for pose in poses]),
        is_known=np.ones(n, dtype=bool),
        trigger_ids=np.arange(n),
    )
    rows = tuple(replace(row, trigger_id=k, lasers=("A",)) for k, row in enumerate(scan.rows))
    session = Session("scan", (CameraSetup(DRAWN.width_px, DRAWN.height_px),))
    return as_source(replace(scan, rows=rows, arm=track, session=session))


class DrawnBench:
    """A hand over a drawn scan."""

    def __init__(self, n: int, rate_hz: float = 200.0) -> None:
        self.hand = _Hand(drawn_scan(n), rate_hz)
        self.settings = SessionSettings()
        self.is_simulated = True

    def scan_rig(self, step: StepName) -> Rig:
        description = RigDescription(("drawn",), is_common_trigger=True)
        return Rig([_HandCamera(self.hand, 0)], _HandArm(self.hand), None, description)

    def hold(self, is_held: bool) -> None:
        self.hand.is_held = is_held

    @property
    def is_over(self) -> bool:
        return self.hand.is_over


def waited(done) -> None:
    end = time.monotonic() + 20.0
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_what_is_recorded_is_what_was_shown(tmp_path: Path) -> None:
    bench = DrawnBench(10)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01", scanner())
    live.start()
    waited(lambda: bench.is_over and sum(live.snapshot.counts.values()) == 10)
    live.stop()
    recorded = read_recording(tmp_path / "scan-01")
    assert [row.trigger_id for row in recorded.rows] == list(range(10))
    assert {row.lasers for row in recorded.rows} == {("A",)}
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
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01", scanner())
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
    rows = read_recording(tmp_path / "scan-01").rows
    # an exposure that arrived while the pause began belongs to no pass that was taken back
    assert n_first - 1 <= len(rows) <= n_first + 1
    assert [row.trigger_id for row in rows][: len(before)] == list(range(len(before)))


def test_a_disk_that_refuses_is_told_and_what_was_listed_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, n_written = DrawnBench(30, rate_hz=20.0), 0
    write = write_files

    def full_after_five(files, **how) -> None:
        nonlocal n_written
        n_written += any(path.suffix == ".png" for path in files)
        if n_written > 5:
            raise OutputError("the disk is full")
        write(files, **how)

    monkeypatch.setattr(scan_module, "write_files", full_after_five)
    monkeypatch.setattr(scan_module, "TABLES_EVERY_S", 0.0)
    live = LiveScan(bench, StepName.SCAN, tmp_path / "scan-01", scanner())
    live.start()
    waited(lambda: any("the disk is full" in event.text for event in live.events))
    assert not live.session.is_recording
    n_shown = live.snapshot.n_points
    waited(lambda: live.snapshot.n_points > n_shown)  # it goes on to show
    live.session.stop()
    monkeypatch.setattr(scan_module, "write_files", write)
    live.recorder.grown.flush()
    recorded = read_recording(tmp_path / "scan-01")
    assert [row.trigger_id for row in recorded.rows] == list(range(5))
    assert all(recorded.exposure(k).image.any() for k in range(5))


def test_devices_are_taken_from_one_placement_at_a_time(tmp_path: Path) -> None:
    hand = _Hand(drawn_scan(40), rate_hz=50.0, is_held=False)
    rig = Rig(
        [_HandCamera(hand, 0)], _HandArm(hand), None, RigDescription(("d",), is_common_trigger=True)
    )
    bench = DeviceBench(rig, "rig.toml")
    for k in range(2):
        assert bench.take(StepName.HAND_EYE, tmp_path / "r", k) is not None
    found = read_recording(tmp_path / "r")
    assert [row.view for row in found.rows] == ["01", "01", "02", "02"]
    assert found.arm.is_known.all() and len(found.arm.t_ns) == 4
    assert bench.look(StepName.HAND_EYE, 2) is not None
    # what was taken last is taken back, and the next take goes on from there
    take_back(StepName.HAND_EYE, tmp_path / "r")
    found = read_recording(tmp_path / "r")
    assert [row.view for row in found.rows] == ["01", "01"] and len(found.arm.t_ns) == 2
    bench.take(StepName.HAND_EYE, tmp_path / "r", 1)
    assert [row.view for row in read_recording(tmp_path / "r").rows] == ["01", "01", "02", "02"]
    bench.close()


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
    assert lasers.asked == ["start", (), ("A",), "off"]
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
