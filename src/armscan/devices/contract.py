# SPDX-License-Identifier: Apache-2.0
"""What every device must do, as checks that a driver's own tests call.

Each check opens the device by the function that it is given, drives it for a few seconds and
raises `ContractError` with the rule that was broken::

    def test_my_camera() -> None:
        check_camera(lambda: open_device("camera", "mine:0"))
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import pairwise
from typing import Any

import numpy as np

from armscan.devices.protocols import (
    Arm,
    ArmFlag,
    ArmSample,
    Camera,
    CameraSettings,
    Frame,
    LaserController,
    LaserEvent,
    TriggerMode,
)
from armscan.errors import ArmscanError, DeviceError

GRACE_S = 0.5
"""A call may take so much longer than its timeout, on a busy computer."""
_QUIET_S = 0.15
_STOPPED_S = 3.0
_RATE_SHARE = 0.5
_OTHER_LASER = "no such laser"


class ContractError(ArmscanError):
    """A device does not do what its protocol says."""


def check_camera(
    open_camera: Callable[[], Camera],
    *,
    trigger: TriggerMode = "free",
    n_frames: int = 5,
    timeout_s: float = 10.0,
    is_exclusive: bool = True,
) -> None:
    """Check a camera; see `armscan.devices.protocols.Camera`.

    Parameters
    ----------
    open_camera
        Opens it; called again after each `close`.
    trigger
        How it is started.
    n_frames
        Frames that are read in each part, 3 or more.
    timeout_s
        So long may that take.
    is_exclusive
        False for a source that any number may open, as a file.

    Raises
    ------
    ContractError
        If a rule is broken; it says which.
    """
    with closing(open_camera()) as camera:
        rule = _Rules(camera.name)
        _check_settings(camera, rule)

        def begun() -> list[Frame]:
            camera.start(trigger)
            frames = _frames(camera, n_frames, timeout_s, rule)
            _check_frames(frames, camera, rule)
            return frames

        _check_silence(camera, rule)
        first = begun()
        copies = [np.array(frame.image) for frame in first]
        later = _frames(camera, n_frames, timeout_s, rule)
        _check_frames([*first, *later], camera, rule)
        rule(
            all(
                np.array_equal(frame.image, copy) for frame, copy in zip(first, copies, strict=True)
            ),
            "the image of a frame changed after it was delivered: copy it out of the buffer",
        )
        _check_end(camera, begun, open_camera if is_exclusive else None, rule)
    with closing(open_camera()) as camera:
        camera.start(trigger)
        _frames(camera, 1, timeout_s, rule)


def check_arm(
    open_arm: Callable[[], Arm],
    *,
    n_samples: int = 50,
    timeout_s: float = 10.0,
    is_exclusive: bool = True,
) -> None:
    """Check an arm; see `armscan.devices.protocols.Arm` and `check_camera`."""
    with closing(open_arm()) as arm:
        rule = _Rules(arm.name)
        rule(
            arm.pose_form in ("quaternion", "matrix", "euler", "joints"),
            f"pose_form is '{arm.pose_form}'",
        )

        def begun() -> list[ArmSample]:
            arm.start()
            samples = _elements(arm, n_samples, timeout_s, rule)
            _check_samples(samples, arm, rule)
            return samples

        _check_silence(arm, rule)
        begun()
        _check_end(arm, begun, open_arm if is_exclusive else None, rule)
    with closing(open_arm()) as arm:
        arm.start()
        _elements(arm, 1, timeout_s, rule)


def check_lasers(
    open_lasers: Callable[[], LaserController],
    *,
    rate_hz: float = 20.0,
    can_switch: bool = True,
    timeout_s: float = 10.0,
    is_exclusive: bool = True,
) -> None:
    """Check a laser controller; see `armscan.devices.protocols.LaserController`, `check_camera`.

    Parameters
    ----------
    open_lasers, timeout_s, is_exclusive
        As for `check_camera`.
    rate_hz
        Triggers a second.
    can_switch
        False for lasers that are only listened to.
    """
    with closing(open_lasers()) as lasers:
        rule = _Rules(lasers.name)
        sources = lasers.sources
        rule(
            len(sources) > 0 and len(set(sources)) == len(sources) and all(sources),
            f"sources are {sources}: at least one, each with a name of its own",
        )
        _check_silence(lasers, rule)
        steps = [*((source,) for source in sources), sources, ()]
        if can_switch:
            _check_refusals(lasers, rule)
            lasers.set_schedule(steps)
        n = 2 * len(steps) + 1

        def begun() -> list[LaserEvent]:
            lasers.start(rate_hz)
            events = _elements(lasers, n, timeout_s, rule)
            _check_events(events, lasers, rule)
            return events

        events = begun()
        if can_switch:
            _check_schedule(events, steps, rate_hz, rule)
            lasers.set_next((sources[0],))
            last = _elements(lasers, n + 2, timeout_s, rule)[-1]
            rule(
                last.lasers == (sources[0],),
                f"after set_next(('{sources[0]}',)) {last.lasers} were on",
            )
        _check_end(lasers, begun, open_lasers if is_exclusive else None, rule)
    with closing(open_lasers()) as lasers:
        rule(lasers.sources == sources, "sources differ when it is opened again")


class _Rules:
    """Raises where a rule is broken."""

    def __init__(self, name: str) -> None:
        self.name = name
        self(isinstance(name, str) and bool(name), "its name is empty")

    def __call__(self, is_kept: Any, what: str) -> None:
        if not is_kept:
            raise ContractError(
                what, where=self.name, remedy="see armscan.devices.protocols for the rule"
            )


def _check_settings(camera: Camera, rule: _Rules) -> None:
    setup = camera.setup
    rule(
        setup.width_px and setup.height_px and setup.width_px > 0 and setup.height_px > 0,
        f"setup gives {setup.width_px} x {setup.height_px} px",
    )
    before = camera.settings
    rule(isinstance(before, CameraSettings), "settings are no CameraSettings")
    after = camera.configure(CameraSettings())
    rule(
        after == before == camera.settings,
        f"configure() without values changed {before} to {after}",
    )
    if before.exposure_us is not None:
        took = camera.configure(CameraSettings(exposure_us=2.0 * before.exposure_us))
        rule(took == camera.settings, f"configure returned {took}, but {camera.settings} are set")
        back = camera.configure(CameraSettings(exposure_us=before.exposure_us)).exposure_us
        rule(
            back is not None and abs(back / before.exposure_us - 1.0) < _RATE_SHARE,
            f"an exposure of {before.exposure_us} us could be read but not set: it became {back}",
        )


def _check_silence(device: Any, rule: _Rules) -> None:
    """What is not started delivers nothing, and says so in time."""
    start_s = time.monotonic()
    found = device.read(_QUIET_S)
    taken_s = time.monotonic() - start_s
    rule(not found, "it delivers though it is not started")
    rule(found is None or isinstance(found, tuple), f"read gives {found!r} where nothing came")
    rule(
        taken_s < _QUIET_S + GRACE_S, f"read({_QUIET_S}) took {taken_s:.2f} s: keep to the timeout"
    )


def _check_stopped(device: Any, rule: _Rules) -> None:
    """What was taken before the stop can be read, and then nothing comes any more."""
    end_s = time.monotonic() + _STOPPED_S
    while device.read(_QUIET_S) and time.monotonic() < end_s:
        """Taken before."""
    _check_silence(device, rule)


def _check_end(
    device: Any,
    begun: Callable[[], Sequence[Any]],
    open_again: Callable[[], Any] | None,
    rule: _Rules,
) -> None:
    """Stop, begin anew and close; where ``open_again`` is given it must fail meanwhile."""
    device.stop()
    _check_stopped(device, rule)
    since_ns = time.monotonic_ns()
    _check_new(begun(), since_ns, rule)
    if open_again is not None:
        _check_taken(open_again, rule)
    device.close()
    _check_closed(device, rule)


def _check_new(came: Sequence[Any], since_ns: int, rule: _Rules) -> None:
    rule(
        came[0].t_host_ns >= since_ns,
        "after a start it delivers what it had taken before the stop",
    )


def _check_closed(device: Any, rule: _Rules) -> None:
    device.close()
    try:
        device.read(0.0)
    except DeviceError:
        return
    rule(False, "read after close raises no DeviceError")


def _check_taken(open_device: Callable[[], Any], rule: _Rules) -> None:
    try:
        second = open_device()
    except DeviceError:
        return
    second.close()
    rule(False, "it can be opened twice; raise DeviceTakenError")


def _frames(camera: Camera, n: int, timeout_s: float, rule: _Rules) -> list[Frame]:
    frames: list[Frame] = []
    end_s = time.monotonic() + timeout_s
    while len(frames) < n and time.monotonic() < end_s:
        frame = camera.read(0.1)
        if frame is not None:
            rule(isinstance(frame, Frame), f"read gives {type(frame).__name__}, no Frame")
            frames.append(frame)
    rule(len(frames) == n, f"{len(frames)} frames came within {timeout_s:g} s, not {n}")
    return frames


def _elements(device: Any, n: int, timeout_s: float, rule: _Rules) -> list[Any]:
    came: list[Any] = []
    end_s = time.monotonic() + timeout_s
    while len(came) < n and time.monotonic() < end_s:
        found = device.read(0.1)
        rule(isinstance(found, tuple), f"read gives {type(found).__name__}, no tuple")
        came += found
    rule(len(came) >= n, f"{len(came)} elements came within {timeout_s:g} s, not {n}")
    return came


def _check_times(came: Sequence[Any], numbers: Sequence[int], rule: _Rules) -> None:
    device = [one.t_device_ns for one in came]
    host = [one.t_host_ns for one in came]
    for values, what in ((numbers, "the device's count"), (device, "the device's time")):
        rule(all(isinstance(value, int) for value in values), f"{what} is no int")
        rule(
            all(a < b for a, b in pairwise(values)),
            f"{what} does not increase: {list(values)[:8]}",
        )
    now_ns = time.monotonic_ns()
    rule(
        all(a <= b for a, b in pairwise(host)),
        "times of arrival go back: take time.monotonic_ns() where the element arrives",
    )
    rule(
        now_ns - 60_000_000_000 < host[0] and host[-1] <= now_ns,
        "times of arrival are not those of time.monotonic_ns()",
    )


def _check_frames(frames: Sequence[Frame], camera: Camera, rule: _Rules) -> None:
    setup = camera.setup
    for frame in frames:
        image = frame.image
        rule(
            image.dtype in (np.uint8, np.uint16),
            f"images are {image.dtype}, not uint8 or uint16",
        )
        rule(
            image.shape[:2] == (setup.height_px, setup.width_px),
            f"images are {image.shape}, but setup says {setup.width_px} x {setup.height_px} px",
        )
        rule(frame.window == setup.window, f"frames show {frame.window}, setup {setup.window}")
        rule(
            (image.ndim == 3 and image.shape[2] == 3) == (setup.colour == "rgb"),
            f"images are {image.shape}, but setup says {setup.colour}",
        )
        if setup.align == "low":
            rule(
                int(image.max()) < 1 << setup.bits_used,
                f"grey values reach {int(image.max())}, more than {setup.bits_used} bits hold",
            )
    _check_times(frames, [frame.number for frame in frames], rule)


def _check_samples(samples: Sequence[ArmSample], arm: Arm, rule: _Rules) -> None:
    for sample in samples:
        rule(isinstance(sample, ArmSample), f"read gives {type(sample).__name__}, no ArmSample")
        if ArmFlag.REFERENCED in sample.flags:
            has_it = sample.joints_rad if arm.pose_form == "joints" else sample.pose
            rule(has_it is not None, "a referenced sample has no pose, or no joint angles")
        rule(sample.buttons >= 0, "buttons are negative")
    _check_times(samples, [sample.number for sample in samples], rule)
    _check_triggers([one.trigger_id for one in samples if one.trigger_id is not None], rule)


def _check_events(events: Sequence[LaserEvent], lasers: LaserController, rule: _Rules) -> None:
    for event in events:
        unknown = set(event.lasers) - set(lasers.sources)
        rule(not unknown, f"an event names {sorted(unknown)}, which are no sources")
    ids = [event.trigger_id for event in events]
    _check_times(events, ids, rule)
    _check_triggers(ids, rule)
    rule(
        ids == list(range(ids[0], ids[0] + len(ids))), f"triggers are not counted one by one: {ids}"
    )


def _check_triggers(ids: Sequence[int], rule: _Rules) -> None:
    rule(
        all(a < b for a, b in pairwise(ids)),
        f"trigger ids do not increase: {list(ids)[:8]}",
    )


def _check_refusals(lasers: LaserController, rule: _Rules) -> None:
    try:
        lasers.set_next((_OTHER_LASER,))
    except ArmscanError:
        return
    rule(False, f"set_next(('{_OTHER_LASER}',)) raises no error")


def _check_schedule(
    events: Sequence[LaserEvent], steps: Sequence[tuple[str, ...]], rate_hz: float, rule: _Rules
) -> None:
    on = [frozenset(event.lasers) for event in events]
    wanted = [frozenset(steps[k % len(steps)]) for k in range(len(on))]
    rule(on == wanted, f"the schedule {list(steps)} gave {[event.lasers for event in events]}")
    taken_s = 1e-9 * (events[-1].t_device_ns - events[0].t_device_ns)
    rate = (len(events) - 1) / taken_s
    rule(
        abs(rate / rate_hz - 1.0) < _RATE_SHARE,
        f"{rate_hz:g} triggers a second were asked for, {rate:.3g} came",
    )
