# SPDX-License-Identifier: Apache-2.0
"""A recorded scan of the twin while its devices fail on purpose: told, whole, nothing wrong placed.

The twin tells where its tool truly was at each trigger; what the live chain and afterwards the
recording say of each image is set beside that.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.devices.matching import MatchedInstant
from armscan.devices.registry import open_device
from armscan.pipeline.live.acquire import Acquisition, LiveEvent
from armscan.pipeline.live.recorder import LiveRecorder
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.reconstruction.sync import PoseStatus, exposure_poses
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import extract_recording

RATE_HZ = 25.0
PLACE = "twin:thesis-single?scene=plate&preset=clean&pause=0.3&ahead=1&loop=1"
WINDOW = (1500, 900, 64, 32)
NEAR_MM = 0.1
"""The clean arm scatters by 0.01 mm, and poses are read off straight lines between samples."""
NEAR_NS: dict[bool, Any] = {True: [0], False: np.arange(-3_000_000, 3_000_001, 100_000)}
"""Clocks that were just related are known to milliseconds; the next exposure is 40 away."""


class Bench:
    """A rig that records and runs; every pose that is given is compared with the true one."""

    def __init__(self, path: Path, *, is_wired: bool) -> None:
        place = PLACE + ("" if is_wired else "&wired=0")
        self.description = RigDescription(
            (place,), place, place, rate_hz=RATE_HZ, is_common_trigger=is_wired, windows=(WINDOW,)
        )
        self.rig = Rig.open(self.description, open_device)
        self.rig.set_windows()
        self.twin: Any = self.rig.cameras[0].rig  # type: ignore[attr-defined]
        self.near_ns = NEAR_NS[is_wired]
        self.told: list[LiveEvent] = []
        self.live: dict[int, MatchedInstant] = {}
        self.errors_mm: list[float] = []
        self.recorder = LiveRecorder(path, self.rig)
        self.acquisition = Acquisition(
            self.rig, self.take, self.told.append, latency_ns=self.twin.latency_ns
        )

    def take(self, instant: MatchedInstant) -> None:
        (frame,) = instant.frames
        assert frame is not None
        self.live[frame.number] = instant
        if instant.pose is not None:
            # the camera's clock, undone with the twin's own numbers
            clock = self.twin.lines["camera0"].clock
            since = (frame.t_device_ns - clock.offset_ns) / (1.0 + clock.drift)
            t_ns = clock.zero_ns + round(since)
            place = instant.pose.translation_mm
            near = [self.twin.true_pose(t_ns + int(off)).translation_mm for off in self.near_ns]
            self.errors_mm.append(min(float(np.linalg.norm(place - true)) for true in near))

    def placed_since(self, number: int) -> int:
        return sum(n >= number and one.pose is not None for n, one in dict(self.live).items())

    def until(self, is_done: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + 60.0
        while not is_done():
            assert time.monotonic() < end, what
            time.sleep(0.02)

    def goes_on(self, n: int = 10) -> None:
        """Wait until so many more images are placed."""
        newest = max(self.live, default=0)
        self.until(lambda: self.placed_since(newest + 1) >= n, f"nothing placed after {newest}")


@pytest.mark.parametrize("is_wired", [True, False], ids=["wired", "by time"])
def test_faults_are_told_and_nothing_wrong_is_placed(is_wired: bool, tmp_path: Path) -> None:
    bench = Bench(tmp_path / "scan.mcap", is_wired=is_wired)
    bench.recorder.begin()
    bench.acquisition.start()
    bench.goes_on()
    n_before = bench.acquisition.matcher.cameras[0].counts.n_elements
    bench.acquisition.recorder = bench.recorder
    bench.goes_on()
    bench.twin.inject("camera0", "drop", 2)
    bench.twin.inject("camera0", "corrupt", 2)
    bench.twin.inject("camera0", "reorder", 1)
    bench.twin.inject("arm", "drop", 3)
    bench.goes_on()
    bench.twin.inject("camera0", "unplug", 0.7)
    bench.until(
        lambda: any("unplugged" in event.text for event in bench.told), "the camera was not told of"
    )
    bench.goes_on()
    n_told = len(bench.told)
    bench.twin.inject("arm", "stall", 2.5)
    for kind in ("fault", "recovered"):
        bench.until(
            lambda kind=kind: any(
                event.kind == kind and event.device.endswith("arm")
                for event in bench.told[n_told:]
            ),
            f"of the arm's stall no {kind} was told",
        )  # fmt: skip
    bench.goes_on()
    counts = bench.acquisition.matcher.cameras[0].counts
    # on a computer with too much to do, what arrived earlier is matched first
    bench.until(lambda: counts.n_missing >= 2 and counts.n_late == 1, f"lost or late: {counts}")
    # the true time of an image is no more to be had from a clock that jumped: last of all
    errors_mm = list(bench.errors_mm)
    bench.twin.inject("camera0", "clock-jump", 7.0)
    bench.goes_on()
    bench.acquisition.stop()
    bench.recorder.close()
    bench.rig.close()
    # on a computer with too much to do, more devices are silent for seconds than those that fail
    told = [one.text for one in bench.told if one.kind == "fault"]
    assert sum("camera0: it was unplugged" in text for text in told) == 1
    assert any("arm has delivered nothing" in text for text in told)
    words = {(one.kind, one.device) for one in bench.told}
    assert {("recovered", f"twin thesis-single {one}") for one in ("camera0", "arm")} <= words
    assert counts.n_jumps == 1
    jumps = [one.device for one in bench.told if "its clock jumped" in one.text]
    assert jumps.count("twin thesis-single camera0") == 1
    assert len(errors_mm) >= 30 and max(errors_mm) < NEAR_MM
    check_recording(bench, tmp_path, n_before)


def check_recording(bench: Bench, folder: Path, n_before: int) -> None:
    """All images that arrived are in the file, and it places none elsewhere than the live chain."""
    status = bench.recorder.status()
    n_arrived = bench.acquisition.matcher.cameras[0].counts.n_elements - n_before
    # instants that were being matched when the recording began
    assert status.n_written == status.n_accepted
    assert abs(status.n_written - n_arrived) <= 3
    n_arrived = status.n_written
    found = extract_recording(folder / "scan.mcap", folder / "scan")
    assert found.n_exposures + found.n_aside == n_arrived
    assert found.n_aside == bench.recorder.n_aside and not found.lost
    recorded = read_recording(folder / "scan")
    latency_ns = bench.twin.latency_ns
    poses = exposure_poses(recorded.rows, recorded.arm, recorded.session.clock, latency_ns)
    n_same = 0
    for k, row in enumerate(recorded.rows):
        if poses.status[k] != PoseStatus.FOUND:
            continue
        same = [
            one for one in bench.live.values()
            if (one.trigger_id == row.trigger_id if row.trigger_id is not None
                else one.t_ns == row.t_ns)
        ]  # fmt: skip
        (live,) = same
        assert live.frames[0] is not None and live.frames[0].is_complete
        if live.pose is not None:
            # the table's poses have 17 digits
            np.testing.assert_allclose(
                poses.translations_mm[k], live.pose.translation_mm, atol=1e-9
            )
            n_same += 1
    assert n_same >= 30
