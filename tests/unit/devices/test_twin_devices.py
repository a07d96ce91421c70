# SPDX-License-Identifier: Apache-2.0
"""The twin's devices against its own scan of the scene, and its clocks against lines."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armscan.devices.protocols import ArmFlag, ArmSample, CameraSettings, Frame, LaserEvent
from armscan.devices.registry import open_device
from armscan.errors import DeviceError, DeviceTakenError, OptionError
from armscan.records.exposure import SensorWindow
from armscan.simulation.live import TwinRig, _plan
from armscan.simulation.station import exposure_light
from armscan.simulation.twin import SceneStage

PLACE = "twin:thesis-cross?scene=plate&preset=clean&pause=0.2&rate=20"
SMALL = CameraSettings(window=SensorWindow(1400, 1000), size_px=(300, 100))


class Bench:
    """Opened devices of one rig, and all that came from them."""

    def __init__(self, place: str = PLACE) -> None:
        self.camera = open_device("camera", place)
        self.arm = open_device("arm", place)
        self.lasers = open_device("lasers", place)
        self.rig: Any = self.camera.rig  # type: ignore[attr-defined]
        self.frames: list[Frame] = []
        self.samples: list[ArmSample] = []
        self.events: list[LaserEvent] = []
        self.camera.configure(SMALL)

    def start(self, lasers: tuple[str, ...] = ("A",), rate_hz: float = 20.0) -> None:
        self.arm.start()
        self.camera.start("external")
        self.lasers.set_schedule([lasers])
        self.lasers.start(rate_hz)

    def until(self, is_enough: Callable[[], bool], timeout_s: float = 20.0) -> None:
        end = time.monotonic() + timeout_s
        while not is_enough():
            assert time.monotonic() < end, "the twin delivered too little"
            frame = self.camera.read(0.02)
            self.frames += [frame] if frame else []
            self.samples += self.arm.read(0.0)
            self.events += self.lasers.read(0.0)

    def close(self) -> None:
        for device in (self.camera, self.arm, self.lasers):
            device.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    opened = Bench()
    yield opened
    opened.close()


def test_delivers_the_images_of_the_scene_with_the_lasers_that_were_chosen(bench: Bench) -> None:
    bench.start(("A",))
    bench.until(lambda: len(bench.frames) >= 3)
    bench.lasers.set_next(("B",))
    bench.until(lambda: bool(bench.events) and bench.events[-1].lasers == ("B",))
    bench.until(lambda: len(bench.frames) >= len(bench.events))
    x, y = SMALL.window.x_px, SMALL.window.y_px
    shown = SMALL.size_px
    for k, (frame, event) in enumerate(zip(bench.frames, bench.events, strict=False)):
        assert frame.trigger_id == event.trigger_id == k + 1
        assert frame.lasers is None and frame.window == SensorWindow(x, y)
        assert frame.image.shape == (shown[1], shown[0])
        wanted = bench.rig.scan_by(0, bench.rig._stage).expose(k, event.lasers).image
        np.testing.assert_array_equal(frame.image, wanted)
        assert wanted.max() > 60
    assert {event.lasers for event in bench.events} == {("A",), ("B",)}


def test_arm_tells_where_it_was_when(bench: Bench) -> None:
    bench.close()
    bench = Bench(PLACE + "&clock=shared")
    bench.start()
    bench.until(lambda: len(bench.frames) >= 8)
    bench.close()
    latched = {one.trigger_id: one for one in bench.samples if one.trigger_id is not None}
    scan = bench.rig.twin.scan("plate")
    hand_eye = bench.rig.twin.truth.tool_from_sensor
    for frame in bench.frames[:-1]:
        pose = latched[frame.trigger_id].pose
        true = scan.true_pose(frame.number) @ hand_eye.inverse()
        # 0.01 of an arm whose E_Uni is 0.02 mm: the clean preset has that share of its errors
        assert np.linalg.norm(pose.translation_mm - true.translation_mm) < 0.01
        assert latched[frame.trigger_id].t_device_ns == frame.t_device_ns
    moving = [one for one in bench.samples if not one.flags & ArmFlag.AT_REST]
    assert len(moving) > 20
    apart, late = (
        [
            np.linalg.norm(
                one.pose.translation_mm
                - bench.rig.true_pose(one.t_device_ns + shift_ns).translation_mm
            )
            for one in moving
        ]
        for shift_ns in (0, 5_000_000)
    )
    assert max(apart) < 0.01 < np.median(late)
    numbers = np.diff([one.number for one in bench.samples])
    assert set(numbers) == {1}
    assert (np.diff([one.t_device_ns for one in bench.samples]) > 0).all()


def test_each_device_has_a_clock_of_its_own(bench: Bench) -> None:
    bench.start()
    bench.until(lambda: len(bench.frames) >= 6)
    offsets = []
    for came in (bench.frames, bench.samples, bench.events):
        device = np.array([one.t_device_ns for one in came])
        host = np.array([one.t_host_ns for one in came])
        spread = (host - device) - (host - device).min()
        # what is left after the offset is chance on the way: 2 ms on average at most
        assert 0 < np.median(spread) < 8e6
        offsets.append(int((host - device).min()))
    assert min(abs(np.diff(offsets))) > 1e9
    bench.close()
    again = Bench()
    again.close()
    clocks = [line.clock.offset_ns for line in again.rig.lines.values()]
    assert clocks == [line.clock.offset_ns for line in bench.rig.lines.values()]


def test_the_hand_waits_while_nothing_triggers(bench: Bench) -> None:
    bench.start()
    bench.until(lambda: len(bench.frames) >= 2)
    bench.lasers.stop()
    n = len(bench.frames)
    time.sleep(0.4)
    bench.frames += [frame] if (frame := bench.camera.read(0.0)) else []
    assert len(bench.frames) <= n + 1
    bench.samples = list(bench.arm.read(0.1))
    assert bench.samples[-1].flags & ArmFlag.AT_REST
    bench.lasers.start(20.0)
    bench.until(lambda: len(bench.frames) >= n + 2)
    ids = [frame.trigger_id for frame in bench.frames]
    assert ids == list(range(1, len(ids) + 1))


def test_another_thing_is_put_before_the_head(bench: Bench) -> None:
    bench.start()
    bench.until(lambda: len(bench.frames) >= 1)
    bench.camera.show("ball")  # type: ignore[attr-defined]
    n = len(bench.frames)
    scan = bench.rig.scan_by(0, bench.rig._stage)
    wanted = [scan.expose(k, ("A",)).image for k in range(3)]
    # images of the scene before may be on their way, and a busy machine skips triggers
    bench.until(
        lambda: any(np.array_equal(f.image, one) for f in bench.frames[n:] for one in wanted)
    )
    assert bench.rig.scene == "ball"
    with pytest.raises(OptionError, match="no images of a scene"):
        bench.rig.show("moon")


def test_faults_look_like_faults(bench: Bench) -> None:
    bench.start()
    bench.until(lambda: len(bench.frames) >= 1)
    rig = bench.rig
    rig.inject("camera0", "drop", 2)
    bench.until(lambda: len(bench.frames) >= 3)
    assert np.diff([frame.number for frame in bench.frames]).max() == 3
    rig.inject("camera0", "corrupt", 1)
    bench.until(lambda: not bench.frames[-1].is_complete)
    assert bench.frames[-1].image[40:60].max() == 0
    rig.inject("arm", "duplicate", 1)
    rig.inject("arm", "reorder", 1)
    rig.inject("camera0", "clock-jump", 2.0)
    n = len(bench.frames)
    bench.until(lambda: len(bench.frames) >= n + 2)
    steps = np.diff([frame.t_device_ns for frame in bench.frames])
    assert sum(steps > 1.9e9) == 1
    steps = np.diff([one.number for one in bench.samples])
    assert 0 in steps and 2 in steps and -1 in steps
    rig.press(1, 5.0)
    bench.until(lambda: bench.samples[-1].buttons == 2)
    rig.inject("camera0", "unplug", 0.3)
    with pytest.raises(DeviceError, match="unplugged"):
        bench.camera.read(0.1)
    with pytest.raises(OptionError):
        rig.inject("camera7", "drop")
    time.sleep(0.3)
    n = len(bench.frames)
    bench.until(lambda: len(bench.frames) > n)
    rig.inject("arm", "stall", 0.6)
    time.sleep(0.1)
    bench.arm.read(0.0)
    assert bench.arm.read(0.2) == ()
    came = bench.arm.read(1.0)
    assert len(came) > 50


def test_a_device_is_opened_once(bench: Bench) -> None:
    with pytest.raises(DeviceTakenError, match="open already"):
        open_device("camera", PLACE)
    with pytest.raises(DeviceError, match="no camera1"):
        open_device("camera", PLACE + "&camera=1")
    bench.camera.close()
    with pytest.raises(DeviceError, match="closed"):
        bench.camera.read(0.0)
    again = open_device("camera", PLACE)
    assert again.rig is bench.rig  # type: ignore[attr-defined]
    again.close()


def test_a_longer_exposure_is_brighter(bench: Bench) -> None:
    bench.start()
    bench.until(lambda: len(bench.frames) >= 1)
    took = bench.camera.configure(CameraSettings(exposure_us=250.0))
    assert took.exposure_us == 250.0 and took.window == SMALL.window
    n = len(bench.frames)
    bench.until(lambda: len(bench.frames) >= n + 3)
    first, last = bench.frames[0].image, bench.frames[-1].image
    assert bench.frames[0].exposure_ns > bench.frames[-1].exposure_ns == 250_000
    lit = first < 250
    assert 0.2 < last.astype(float).sum() / first.astype(float)[lit].sum() < 0.4


@pytest.fixture
def rig() -> Iterator[TwinRig]:
    found = TwinRig(_plan("thesis-single?scene=plate")[0])
    yield found
    found.end()


def variance_per_level(rig: TwinRig, gain_db: float) -> float:
    """Slope of the photon transfer curve, from pairs of images of the standing plate."""
    stage = SceneStage.of(rig.twin, "hand-eye")
    row = next(k for k, shot in enumerate(stage.scan.shots) if not shot.sub_poses)
    points = []
    for brighter in (30.0, 60.0):
        exposure_us = 1000.0 * brighter * 10.0 ** (-gain_db / 20.0)
        rig.settings[0] = replace(SMALL, exposure_us=exposure_us, gain_db=gain_db)
        scan = rig.scan_by(0, stage)
        pair = [replace(scan, seed=(k,)).expose(row, ()).image.astype(float) for k in range(2)]
        points.append((np.mean(pair), 0.5 * np.var(pair[1] - pair[0])))
    (dark, dark_variance), (bright, bright_variance) = points
    assert 60.0 < dark < 0.6 * bright < 110.0
    return float((bright_variance - dark_variance) / (bright - dark))


def test_gain_amplifies_the_noise_with_the_light(rig: TwinRig) -> None:
    found = [variance_per_level(rig, gain_db) for gain_db in (0.0, 24.0)]
    assert found[0] == pytest.approx(1.0 / 60.0, rel=0.1)
    assert found[1] == pytest.approx(15.85 * found[0], rel=0.2)


def test_a_longer_exposure_blurs_more(rig: TwinRig) -> None:
    stage, places, squares = SceneStage.of(rig.twin, "plate"), [], []
    for longer in (1.0, 8.0, 16.0):
        rig.settings[0] = replace(SMALL, exposure_us=1000.0 * longer)
        shot = rig.scan_by(0, stage).shots[3]
        places.append(np.array([pose.translation_mm for pose in shot.sub_poses]))
        light = exposure_light(
            rig.twin.instrument.head, shot.station, shot.sub_poses,
            shot.settings, np.random.default_rng(1),
        )  # fmt: skip
        column = light[:, 100:200].mean(axis=1).astype(float) - float(np.median(light))
        rows = np.arange(len(column))
        middle = column @ rows / column.sum()
        squares.append(column @ (rows - middle) ** 2 / column.sum())
    spread = [np.sqrt(np.var(one, axis=0).sum()) for one in places]
    np.testing.assert_allclose(np.array(spread) / spread[0], [1.0, 8.0, 16.0], rtol=1e-6)
    for one in places:
        np.testing.assert_allclose(one.mean(axis=0), places[0].mean(axis=0), atol=1e-9)
    # the mean square of the way of a steady motion grows with the square of its time
    assert (squares[2] - squares[0]) / (squares[1] - squares[0]) == pytest.approx(255 / 63, rel=0.1)


@pytest.mark.parametrize(
    "place",
    ["twin:no-head", "twin:?seed=-1", "twin:?scene=probing", "twin:?rate=x", "twin:?what=1"],
)
def test_an_address_that_names_no_instrument_is_refused(place: str) -> None:
    with pytest.raises(OptionError) as caught:
        open_device("camera", place)
    assert caught.value.remedy


def test_loops_are_compiled_before_the_first_trigger(monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[int] = []
    monkeypatch.setattr("armscan.simulation.live._PREPARED", set())
    monkeypatch.setattr(TwinRig, "_image", lambda rig, stage, k, camera, on: rendered.append(k))
    for _ in range(2):
        open_device("camera", PLACE).close()
    # once a process
    assert rendered == [0]
