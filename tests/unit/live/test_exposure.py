# SPDX-License-Identifier: Apache-2.0
"""Exposure control of a camera whose line is as bright as its time is long."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armscan.devices.protocols import CameraSettings, Frame
from armscan.errors import DeviceError, OptionError
from armscan.pipeline.live import exposure
from armscan.pipeline.live.exposure import (
    ExposureControl,
    ExposureSettings,
    LaserTarget,
    deciding_level,
    line_levels,
    wanted_factor,
)
from armscan.records.recording import CameraSetup

GROUND, SIGMA_PX = 12.0, 2.0
HEIGHT, WIDTH = 160, 240


def lit(peaks: Any, direction: str = "horizontal", bits: int = 8) -> Any:
    """A line of these peak grey levels above the ground; clipped as a sensor does."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    across = {
        "horizontal": rows - 80.0,
        "vertical": columns - 100.0,
        "oblique": (rows - 0.8 * columns + 20.0) / np.hypot(1.0, 0.8),
    }[direction]
    along = rows if direction == "vertical" else columns
    peak = np.broadcast_to(np.asarray(peaks, dtype=float), (WIDTH,))[along.astype(int)]
    level = GROUND + peak * np.exp(-0.5 * (across / SIGMA_PX) ** 2)
    kind = np.uint8 if bits == 8 else np.uint16
    return np.clip(np.round(level), 0, (1 << bits) - 1).astype(kind)


class Camera:
    """Takes times in steps of 5 us; the line rises ``per_us`` grey levels a microsecond."""

    def __init__(self, per_us: Any, exposure_us: float) -> None:
        self.per_us = per_us
        self.settings = CameraSettings(exposure_us=exposure_us, gain_db=0.0)
        self.name, self.setup = "camera 0", CameraSetup(WIDTH, HEIGHT)
        self.n_set = 0
        self.fault: Exception | None = None

    def configure(self, settings: CameraSettings) -> CameraSettings:
        if self.fault is not None:
            raise self.fault
        self.n_set += 1
        asked = settings.exposure_us or self.settings.exposure_us or 0.0
        gain = self.settings.gain_db if settings.gain_db is None else settings.gain_db
        self.settings = CameraSettings(exposure_us=5.0 * round(asked / 5.0), gain_db=gain)
        return self.settings

    def frame(self, laser: str = "A") -> Frame:
        per_us = self.per_us[laser] if isinstance(self.per_us, dict) else self.per_us
        return Frame(lit(np.asarray(per_us) * (self.settings.exposure_us or 0.0)), 0, 0, 0)


def settled(camera: Any, settings: ExposureSettings, *lasers: str) -> float:
    control = ExposureControl(camera, settings, lambda _: None)
    for _ in range(12):
        for laser in lasers or ("A",):
            control.adjust(camera.frame(laser), (laser,))
    return camera.settings.exposure_us


@pytest.mark.parametrize("direction", ["horizontal", "vertical", "oblique"])
@pytest.mark.parametrize("bits", [8, 12])
def test_the_line_s_peak_is_read_off_whichever_way_it_runs(direction: str, bits: int) -> None:
    peak, full = 150.0 * (1 << bits - 8), (1 << bits) - 1
    peaks, ground = line_levels(lit(peak, direction, bits), full)
    # a column meets the oblique line within 0.4 px of its middle: 2 % of a Gaussian of 2 px
    lowest = (GROUND + peak * (0.98 if direction == "oblique" else 1.0) - 1.0) / full
    assert lowest <= np.median(peaks) <= (GROUND + peak + 0.5) / full
    assert ground == pytest.approx(GROUND / full, abs=1e-9)
    colour = np.stack([np.zeros_like(lit(peak)), lit(peak), np.zeros_like(lit(peak))], axis=2)
    np.testing.assert_array_equal(line_levels(colour, 255)[0], line_levels(lit(peak), 255)[0])


@pytest.mark.parametrize("start_us", [40.0, 400.0, 4000.0])
@pytest.mark.parametrize("target", [0.3, 0.7])
def test_the_line_becomes_as_bright_as_asked_for(start_us: float, target: float) -> None:
    camera = Camera(0.25, start_us)
    exposure_us = settled(camera, ExposureSettings("automatic", target=target))
    # what rises above the ground is linear in time; a tenth is near enough
    assert 0.25 * exposure_us + GROUND == pytest.approx(255 * target, rel=0.1)
    n_set = camera.n_set
    settled(camera, ExposureSettings("automatic", target=target))
    assert camera.n_set == n_set


def test_what_the_control_sees_is_told_for_each_choice_of_lasers() -> None:
    camera = Camera({"A": 0.25, "B": 0.0}, 650.0)
    control = ExposureControl(camera, ExposureSettings("automatic"), lambda _: None)
    for laser in ("A", "B"):
        assert control.adjust(camera.frame(laser), (laser,)) is None
    lit_line, dark = control.brightness
    assert lit_line.level == pytest.approx((0.25 * 650.0 + GROUND) / 255, abs=0.01)
    assert (dark.level, dark.target, dark.exposure_us) == (None, 0.7, 650.0)
    assert (lit_line.lasers, dark.lasers) == (("A",), ("B",))
    assert lit_line.words == "A: 650 us, line at 68%, 70% wanted"
    assert dark.words == "B: 650 us, no line is seen, 70% wanted"


def test_glints_of_a_reflective_part_do_not_saturate() -> None:
    per_us = np.full(WIDTH, 0.1)
    per_us[::8] = np.where(np.arange(0, WIDTH, 8) % 80 == 0, 0.5, 0.1)
    reflective, automatic = Camera(per_us, 900.0), Camera(per_us, 900.0)
    settled(reflective, ExposureSettings("reflective", target=0.7))
    settled(automatic, ExposureSettings("automatic", target=0.7))
    assert reflective.frame().image.max() < 255 * 0.8
    assert automatic.frame().image.max() == 255
    assert np.median(automatic.frame().image.max(axis=0)) == pytest.approx(255 * 0.7, rel=0.1)


def test_lasers_in_turn_share_the_time_of_the_brighter_one_by_targets_of_their_own() -> None:
    camera = Camera({"A": 0.5, "B": 0.1}, 1000.0)
    settings = ExposureSettings("automatic", target=0.7)
    shared = settled(camera, settings, "A", "B")
    assert 0.5 * shared + GROUND == pytest.approx(255 * 0.7, rel=0.1)
    own = replace(settings, laser=(LaserTarget("A", 0.4),))
    less = settled(Camera({"A": 0.5, "B": 0.1}, 1000.0), own, "A", "B")
    assert 0.5 * less + GROUND == pytest.approx(255 * 0.4, rel=0.1)
    assert own.target_of(("A", "B")) == 0.4 and own.target_of(("B",)) == 0.7


def test_without_a_line_the_time_grows_to_its_bound_and_no_further() -> None:
    camera = Camera(0.0, 100.0)
    assert settled(camera, ExposureSettings("automatic", most_us=2000.0)) == 2000.0
    assert deciding_level(np.full(9, 0.05), 0.04, "automatic") is None
    assert wanted_factor(None, 0.04, 0.7) is None
    assert wanted_factor(1.0, 0.04, 0.7) == 0.5


def test_images_that_were_under_way_do_not_make_it_hunt(monkeypatch: pytest.MonkeyPatch) -> None:
    """A setting shows two images later, as on cameras that read one while they take the next."""
    monkeypatch.setattr(exposure, "EVERY_S", 0.001)
    camera: Any = Camera(0.25, 2000.0)
    control = ExposureControl(camera, ExposureSettings("automatic"), lambda _: None)
    control.start()
    times_us = [2000.0] * 2
    for _ in range(150):
        times_us.append(camera.settings.exposure_us)
        control.show(Frame(lit(0.25 * times_us[-3]), 0, 0, 0), ("A",))
        time.sleep(0.005)
    control.stop()
    np.testing.assert_allclose(0.25 * np.array(times_us[-30:]) + GROUND, 255 * 0.7, rtol=0.1)
    # from much too bright: 1000, 500, and at most some steps to the target
    assert camera.n_set <= 5


def test_it_runs_beside_the_images_and_outlives_a_camera_that_refuses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(exposure, "EVERY_S", 0.001)
    camera, told = Camera(0.25, 100.0), []
    control = ExposureControl(camera, ExposureSettings("automatic"), told.append)  # type: ignore[arg-type]
    control.start()
    control.show(camera.frame(), ())
    camera.fault = ValueError("the bus is busy")
    end = time.monotonic() + 10.0
    while not told and time.monotonic() < end:
        control.show(camera.frame(), None)
        time.sleep(0.002)
    camera.fault = None
    while abs(0.25 * camera.settings.exposure_us + GROUND - 178.5) > 18 and time.monotonic() < end:
        control.show(camera.frame(), ("A",))
        time.sleep(0.002)
    control.stop()
    assert isinstance(told[0], DeviceError) and "the bus is busy" in str(told[0])
    assert 0.25 * camera.settings.exposure_us + GROUND == pytest.approx(178.5, rel=0.1)
    assert told[-1] == camera.settings


def test_fixed_is_set_once_and_left() -> None:
    camera, told = Camera(0.25, 100.0), []
    control = ExposureControl(camera, ExposureSettings(exposure_us=350.0, gain_db=3.0), told.append)  # type: ignore[arg-type]
    control.start()
    control.show(camera.frame(), ("A",))
    control.stop()
    assert camera.n_set == 1 and camera.settings == CameraSettings(exposure_us=350.0, gain_db=3.0)


@pytest.mark.parametrize(
    "wrong",
    [{"target": 0.0}, {"target": 1.0}, {"least_us": 0.0}, {"least_us": 9.0, "most_us": 8.0},
     {"exposure_us": -1.0}, {"laser": (LaserTarget("A", 2.0),)}],
)  # fmt: skip
def test_wrong_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        ExposureSettings("automatic", **wrong)
