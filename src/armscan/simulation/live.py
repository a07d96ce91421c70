# SPDX-License-Identifier: Apache-2.0
"""The twin as devices that run: cameras, arm and laser controller of one simulated instrument.

The hand follows a scene's way at the pace of the triggers: an instant of the scene at each one.
It waits where nothing triggers, so that a person may stop and go on, and where an image is not
rendered yet: the twin is then slower than it was asked to be, never wrong.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast, get_args

import numpy as np

from armscan.devices.inbox import DeviceClock, FaultyLine
from armscan.devices.protocols import (
    Arm,
    ArmFlag,
    ArmSample,
    Camera,
    CameraSettings,
    DeviceInfo,
    DeviceKind,
    Fault,
    Frame,
    LaserController,
    LaserEvent,
    TriggerMode,
)
from armscan.devices.registry import number_option, split_place
from armscan.devices.sources import Preset, TwinScene
from armscan.errors import DeviceError, OptionError
from armscan.geometry.arrays import ImageArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.records.exposure import SensorWindow
from armscan.records.recording import CameraSetup, PoseForm
from armscan.simulation.arm.hand import HandHistory, led
from armscan.simulation.head import Window
from armscan.simulation.station import TwinScan
from armscan.simulation.twin import SceneStage, build_twin

_STILL_NS, _STILL_RAD = 50_000_000, 1e-6
"""At rest is who has not turned a joint by more for so long."""
_LATE_NS = 2_000_000
"""A trigger may be this late by the computer's own delays and still count as on time."""
_KNOWN_NS = 4_000_000
"""The arm is asked for what was so long ago: no trigger can change that any more."""
_BACKLOG_NS = 10_000_000_000
"""Samples that nobody has asked for in so long are lost."""
_MOST_FRAMES, _MOST_SAMPLES = 64, 20_000
_CACHE_BYTES = 2_000_000_000
_DRAWN = 20
"""Stream of random numbers, besides those of the instrument and its scenes."""
_LEAST_DELAY_NS = {"camera": 12_000_000, "arm": 5_000_000, "lasers": 3_000_000}
_DELAY_SPREAD_NS = {"camera": 2_000_000, "arm": 400_000, "lasers": 300_000}
"""Mean of what comes on top by chance, exponentially distributed as on a busy computer."""
_POLL_S, _FIRST_RENDER_S = 0.004, 0.3
_SLACK = 1.25
"""So much longer than an image takes to be rendered is the hand on its way to the next: it moves on
steadily, and the image is there when its time has come."""
_MOST_HZ, _LEAST_PX = 1e4, 16
_DRIFT = 20e-6
"""Standard deviation of a quartz clock."""
_UPTIME_S = 50_000.0


@dataclass(frozen=True, slots=True)
class _Plan:
    """What an address says of the rig."""

    head: str
    preset: Preset = "thesis"
    seed: int = 1
    scene: TwinScene = "plate"
    rate_hz: float = 10.0
    arm_hz: float = 200.0
    pause_s: float = 1.0
    is_loop: bool = False
    is_ahead: bool = False
    is_wired: bool = True
    has_shared_clock: bool = False


_KEYS = (
    *("seed", "preset", "scene", "rate", "arm", "pause", "loop", "ahead", "wired", "clock"),
    "camera",
)


def _plan(place: str) -> tuple[_Plan, int]:
    """What an address says, and the number of its camera."""
    head, options = split_place(place, _KEYS)
    scenes = [name for name in get_args(TwinScene) if name != "probing"]
    choices = {key: ["0", "1"] for key in ("loop", "ahead", "wired", "camera")}
    for key, names in {**choices, "scene": scenes, "clock": ["own", "shared"]}.items():
        if options.get(key, names[0]) not in names:
            raise OptionError(
                f"no {key} is called '{options[key]}'", remedy=f"choose one of: {', '.join(names)}"
            )
    plan = _Plan(
        head=head or "thesis-single",
        preset=cast(Preset, options.get("preset", "thesis")),
        seed=int(number_option(options, "seed", 1, 2**31)),
        scene=cast(TwinScene, options.get("scene", "plate")),
        rate_hz=max(number_option(options, "rate", 10.0, 1e4), 1e-3),
        arm_hz=max(number_option(options, "arm", 200.0, 1e4), 1e-3),
        pause_s=number_option(options, "pause", 1.0, 3600.0),
        is_loop=options.get("loop") == "1",
        is_ahead=options.get("ahead") == "1",
        is_wired=options.get("wired", "1") == "1",
        has_shared_clock=options.get("clock") == "shared",
    )
    return plan, int(options.get("camera", "0"))


class TwinRig:
    """One simulated instrument that runs; its devices know it as their attribute ``rig``."""

    def __init__(self, plan: _Plan) -> None:
        self.twin = build_twin(plan.head, plan.preset, plan.seed)
        self.arm_flags = ArmFlag.REFERENCED
        self.plan = plan
        self.lock = threading.Condition()
        rng = np.random.default_rng([plan.seed, _DRAWN])
        zero_ns = time.monotonic_ns()
        cameras = [f"camera{k}" for k in range(len(self.twin.instrument.head.cameras))]
        self.lines: dict[str, FaultyLine[Any]] = {}
        for name in (*cameras, "arm", "lasers"):
            at_start, drift = rng.uniform(0.0, _UPTIME_S), _DRIFT * rng.standard_normal()
            drawn = round(1e9 * at_start), drift, zero_ns
            clock = DeviceClock(*(0, 0.0, 0) if plan.has_shared_clock else drawn)
            kind = name.rstrip("01")
            self.lines[name] = FaultyLine(
                f"twin {plan.head} {name}",
                _MOST_SAMPLES if kind == "arm" else _MOST_FRAMES,
                clock,
                delay_ns=_LEAST_DELAY_NS[kind],
                spread_ns=_DELAY_SPREAD_NS[kind],
                rng=np.random.default_rng([plan.seed, _DRAWN, len(self.lines)]),
            )
        self._rng = np.random.default_rng([plan.seed, _DRAWN, 99])
        exposure_us = 1e6 * self.twin.instrument.mechanics.exposure_s
        self.settings = [CameraSettings(exposure_us, 0.0, plan.rate_hz) for _ in cameras]
        self.modes: dict[int, TriggerMode] = {}
        self.laser_rate_hz: float | None = None
        self.are_lasers_started = False
        self.schedule: list[tuple[str, ...]] | None = None
        self.n_steps = 0
        self._stage = SceneStage.of(self.twin, plan.scene)
        self._k = 0
        self._is_over = False
        self._next_ns = 0
        self._n_triggers = 0
        self._hand = HandHistory(self._stage.way.joints_rad[0])
        self.latches: deque[tuple[int, int]] = deque(maxlen=_MOST_SAMPLES)
        self._presses: list[tuple[int, int, int]] = []
        self._render_s = 0.0
        self._images: OrderedDict[tuple[Any, ...], ImageArray] = OrderedDict()
        self._lit: dict[tuple[Any, ...], TwinScan] = {}
        self._is_closed = False
        self._thread = threading.Thread(target=self._pace, daemon=True, name="twin")
        self._thread.start()

    @property
    def scene(self) -> TwinScene:
        """What is before the head."""
        return self._stage.scene

    @property
    def latency_ns(self) -> int:
        """Least delay of the arm less that of the cameras: what a latency calibration finds."""
        return self.lines["arm"].delay_ns - self.lines["camera0"].delay_ns

    def show(self, scene: TwinScene) -> None:
        """Put another thing before the head, and lead it there; the count of triggers goes on.

        Raises `OptionError` if there is no such scene.
        """
        stage = SceneStage.of(self.twin, scene)
        with self.lock:
            self._stage = stage
            self._images.clear()
            self._lit.clear()
            self._lead_to_start()
            self._next_ns = max(self._next_ns, self._hand.end_ns)
            self.lock.notify_all()

    def press(self, button: int, seconds: float = 0.2) -> None:
        """Hold a button of the arm, counted from 0."""
        with self.lock:
            now_ns = time.monotonic_ns()
            self._presses = [one for one in self._presses if one[1] > now_ns - _BACKLOG_NS]
            self._presses.append((now_ns, now_ns + round(1e9 * seconds), button))

    def inject(self, device: str, fault: Fault, amount: float = 1.0) -> None:
        """Make a device fail: see `FaultyLine.inject`; raises `OptionError` for others."""
        if device not in self.lines or fault not in get_args(Fault) or not amount > 0.0:
            raise OptionError(
                f"no fault '{fault}' of '{device}' by {amount}",
                remedy=f"devices are {', '.join(self.lines)}, faults {', '.join(get_args(Fault))}",
            )
        with self.lock:
            self.lines[device].inject(fault, amount)

    def true_pose(self, t_host_ns: int) -> Pose[Base, Tool]:
        """Where the tool truly was at a time of the monotonic clock, within the last seconds."""
        with self.lock:
            joints = self._hand.joints_rad(np.array([t_host_ns]))[0]
        return self.twin.instrument.arm.true_pose(joints)

    def take(self, device: str) -> None:
        """Open a device; raises `DeviceTakenError` or `DeviceError`."""
        with self.lock:
            if device not in self.lines:
                raise DeviceError(f"a head '{self.plan.head}' has no {device}")
            self.lines[device].open()

    def give_back(self, device: str) -> None:
        """Close a device; the last one closes the rig."""
        with _RIGS_LOCK:
            with self.lock:
                self.lines[device].close()
            if not any(line.is_open for line in self.lines.values()):
                self.end()
                _RIGS.pop(self.plan, None)

    def prepare(self, camera: int) -> None:
        """Render an image, the first time in a process."""
        known = self.plan.head, self.scene
        if known not in _PREPARED:
            self._image(self._stage, self._k, camera, self._lasers(self._k))
        _PREPARED.add(known)

    def end(self) -> None:
        """Let the thread end: a process must not end while it renders."""
        with self.lock:
            self._is_closed = True
            self.lock.notify_all()
        self._thread.join()

    def run_anew(self) -> None:
        """Take in that something was started or stopped; under the lock."""
        if self._is_over:
            self._lead_to_start()
        soonest_ns = time.monotonic_ns() + round(1e9 / self.rate_hz)
        self._next_ns = max(soonest_ns, self._hand.end_ns)
        self.lock.notify_all()

    @property
    def rate_hz(self) -> float:
        """Triggers a second: the controller's, or the first free camera's."""
        own = self.laser_rate_hz if self.are_lasers_started else None
        return own or self.settings[min(self.modes, default=0)].rate_hz or self.plan.rate_hz

    @property
    def is_running(self) -> bool:
        """Whether something triggers."""
        leads = self.are_lasers_started and self.laser_rate_hz is not None
        return (leads or "free" in self.modes.values()) and not self._is_over

    def scan_by(self, camera: int, stage: SceneStage) -> TwinScan:
        """The images of a scene as a camera is set."""
        settings = self.settings[camera]
        nominal_us = 1e6 * self.twin.instrument.mechanics.exposure_s
        longer = (settings.exposure_us or nominal_us) / nominal_us
        gain = 10.0 ** ((settings.gain_db or 0.0) / 20.0)
        window = None
        if settings.size_px is not None:
            corner = settings.window or SensorWindow()
            window = Window(corner.x_px, corner.y_px, *settings.size_px)
        if longer == gain == 1.0 and window is None:
            return stage.scan
        key = (stage.scene, longer, gain, window)
        if key not in self._lit:
            self._lit[key] = stage.scan.as_set(longer, gain, window)
        return self._lit[key]

    def setup(self, camera: int) -> CameraSetup:
        """How a camera delivers its images now."""
        row = self._stage.instants[self._k % len(self._stage.instants)][camera]
        scan = self.scan_by(camera, self._stage)
        window = scan.shots[row].settings.window
        return replace(
            self._stage.scan.session.cameras[camera],
            width_px=window.width_px,
            height_px=window.height_px,
            window=scan.sensor_window(window, camera),
        )

    def samples(self, after_ns: int, start_ns: int) -> int:
        """Send the arm's samples after a time up to now; returns until when."""
        now_ns = time.monotonic_ns() - _KNOWN_NS
        with self.lock:
            line = self.lines["arm"]
            step_ns = round(1e9 / self.plan.arm_hz)
            if now_ns - after_ns > _BACKLOG_NS:
                line.number += (now_ns - _BACKLOG_NS - after_ns) // step_ns
                after_ns = now_ns - _BACKLOG_NS
            first = (after_ns - start_ns) // step_ns + 1
            own = np.arange(start_ns + first * step_ns, now_ns + 1, step_ns, dtype=np.int64)
            both: list[tuple[int, int | None]] = [(int(t_ns), None) for t_ns in own]
            if self.plan.is_wired:
                both += [cast(Any, one) for one in self.latches if after_ns < one[0] <= now_ns]
            both.sort(key=lambda one: one[0])
            if both:
                self._send_samples(line, both)
        return max(now_ns, after_ns)

    def _send_samples(
        self, line: FaultyLine[ArmSample], taken: list[tuple[int, int | None]]
    ) -> None:
        times = np.array([t_ns for t_ns, _ in taken], dtype=np.int64)
        joints = self._hand.joints_rad(times)
        turned = np.abs(joints - self._hand.joints_rad(times - _STILL_NS)).max(axis=1)
        arm = self.twin.instrument.arm
        readings = arm.readings(joints, self._rng)
        rotations, translations = arm.nominal.transforms(readings)
        for k, (t_ns, trigger_id) in enumerate(taken):
            rest = ArmFlag.AT_REST if turned[k] < _STILL_RAD else ArmFlag.NONE
            down = sum({1 << one[2] for one in self._presses if one[0] <= t_ns < one[1]})
            pose: Pose[Base, Tool] = Pose(rotations[k], translations[k])
            flags = self.arm_flags | rest
            line.send(t_ns, ArmSample(0, 0, 0, pose, readings[k], down, flags, trigger_id))

    def _lead_to_start(self) -> None:
        """Bring the head from where it is to the scene's first instant."""
        now_ns = time.monotonic_ns()
        start = self._hand.joints_rad(np.array([now_ns]))[0]
        end = self._stage.way.joints_rad[0]
        arrived_ns = now_ns + round(1e9 * self.plan.pause_s)
        self._hand.go(now_ns, arrived_ns, lambda share: led(start, end, share))
        self._k, self._is_over = 0, False

    def _lasers(self, k: int, n_later: int = 0) -> tuple[str, ...]:
        """Sources at instant ``k``, so many triggers after the next."""
        if self.lines["lasers"].is_open and not self.are_lasers_started:
            return ()
        if self.schedule is None:
            return self._stage.scan.rows[self._stage.instants[k][0]].lasers
        return self.schedule[(self.n_steps + n_later) % len(self.schedule)]

    def _pace(self) -> None:
        """Trigger while something runs; the only place where instants go by."""
        while True:
            with self.lock:
                while not self.is_running and not self._is_closed:
                    self.lock.wait()
                if self._is_closed:
                    return
                stage, k, lasers = self._stage, self._k, self._lasers(self._k)
                cameras = tuple(self.modes)
            if self.plan.is_ahead:
                self._render_all(stage, cameras)
            images = {c: self._image(stage, k, c, lasers) for c in cameras}
            with self.lock:
                # any change ends the wait
                self.lock.wait(1e-9 * max(self._next_ns - time.monotonic_ns(), 0))
                is_same = stage is self._stage and k == self._k and lasers == self._lasers(k)
                if is_same and self.is_running and cameras == tuple(self.modes):
                    now_ns = time.monotonic_ns()
                    self._next_ns = max(self._next_ns, now_ns - _LATE_NS)
                    if now_ns >= self._next_ns:
                        self._trigger(stage, k, lasers, images)

    def _render_all(self, stage: SceneStage, cameras: Sequence[int]) -> None:
        """Render what the schedule will want, before the first trigger, into memory."""
        for k in range(len(stage.instants)):
            with self.lock:
                if self._is_closed or stage is not self._stage or not self.is_running:
                    return
                lasers = self._lasers(k, k - self._k)
            for camera in cameras:
                self._image(stage, k, camera, lasers)

    def _image(self, stage: SceneStage, k: int, camera: int, lasers: tuple[str, ...]) -> ImageArray:
        row = stage.rows_lit_by(k, lasers)[camera]
        key = (stage.scene, row, lasers, self.settings[camera])
        image = self._images.get(key)
        if image is None:
            start_s = time.monotonic()
            image = self.scan_by(camera, stage).expose(row, lasers).image
            taken_s = time.monotonic() - start_s
            # the first image may have compiled, which tells nothing of the next
            self._render_s = min(taken_s, 2.0 * self._render_s or _FIRST_RENDER_S)
            most = _CACHE_BYTES // image.nbytes if self.plan.is_ahead or self.plan.is_loop else 4
            with self.lock:
                self._images[key] = image
                while len(self._images) > most:
                    self._images.popitem(last=False)
        return image

    def _trigger(
        self, stage: SceneStage, k: int, lasers: tuple[str, ...], images: dict[int, ImageArray]
    ) -> None:
        t_ns = self._next_ns
        trigger_id = self._n_triggers = self._n_triggers + 1
        self.n_steps += 1
        self.latches.append((t_ns, trigger_id))
        for camera, image in images.items():
            window = self.setup(camera).window
            told = trigger_id if self.plan.is_wired else None
            seen = None if self.lines["lasers"].is_open else lasers
            exposure_ns = round(1e3 * (self.settings[camera].exposure_us or 0.0))
            frame = Frame(image, 0, 0, 0, told, seen, window, exposure_ns=exposure_ns)
            self.lines[f"camera{camera}"].send(t_ns, frame)
        if self.are_lasers_started:
            self.lines["lasers"].send(t_ns, LaserEvent(trigger_id, 0, 0, lasers))
        is_travel = stage.way.is_travel(k)
        slowest_s = 0.0 if self.plan.is_ahead else _SLACK * len(images) * self._render_s
        step_s = max(self.plan.pause_s if is_travel else 0.0, 1.0 / self.rate_hz, slowest_s)
        self._next_ns = t_ns + round(1e9 * step_s)
        self._k = k + 1
        if self._k == len(stage.instants):
            self._k, self._is_over = 0, not self.plan.is_loop
        if not self._is_over:
            way = stage.way
            self._hand.go(t_ns, self._next_ns, lambda share: way.between(k, share))


def _within(wanted: float | None, now: float | None, least: float, most: float) -> float | None:
    return now if wanted is None else float(np.clip(wanted, least, most))


class _TwinDevice:
    """What the twin's devices have in common; ``rig`` stands behind it."""

    is_simulated = True

    def __init__(self, rig: TwinRig, device: str) -> None:
        rig.take(device)
        self.rig = rig
        self._device = device
        self._is_started = False

    @property
    def name(self) -> str:
        """What messages call it."""
        return self._line.inbox.name

    def show(self, scene: TwinScene) -> None:
        """Put another thing before the head: see `TwinRig.show`."""
        self.rig.show(scene)

    def close(self) -> None:
        """Give the device back. Does nothing the second time."""
        if self._line.is_open:
            self._halt()
            self.rig.give_back(self._device)

    def stop(self) -> None:
        """Take no more; what was taken can still be read."""
        with self.rig.lock:
            self._line.check_answers()
            self._halt()

    def _begin(self, is_started: bool) -> None:
        self._line.check_answers()
        if not is_started:
            self._line.inbox.clear()

    @property
    def _line(self) -> FaultyLine[Any]:
        return self.rig.lines[self._device]

    def _halt(self) -> None:
        raise NotImplementedError


class TwinCamera(_TwinDevice):
    """See `armscan.devices.protocols.Camera`."""

    def __init__(self, rig: TwinRig, camera: int) -> None:
        super().__init__(rig, f"camera{camera}")
        self._camera = camera
        # no trigger waits while loops are compiled
        rig.prepare(camera)

    @property
    def setup(self) -> CameraSetup:
        """Size, window, bits and colour of the frames that it delivers now."""
        with self.rig.lock:
            return self.rig.setup(self._camera)

    @property
    def settings(self) -> CameraSettings:
        """What is set now."""
        window = self.setup
        return replace(
            self.rig.settings[self._camera],
            window=window.window,
            size_px=(window.width_px or 0, window.height_px or 0),
        )

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set what is not None, as near as the camera can, and return what it took."""
        with self.rig.lock:
            self._line.check_answers()
            old = self.settings
            took = replace(
                self.rig.settings[self._camera],
                exposure_us=_within(settings.exposure_us, old.exposure_us, 10.0, 1e5),
                gain_db=_within(settings.gain_db, old.gain_db, 0.0, 24.0),
                rate_hz=_within(settings.rate_hz, old.rate_hz, 0.1, 1e3),
            )
            if settings.size_px is not None or settings.window is not None:
                corner, size_px = settings.window or old.window, settings.size_px or old.size_px
                took = replace(took, **self._on_sensor(corner, size_px))
            self.rig.settings[self._camera] = took
        return self.settings

    def _on_sensor(self, corner: Any, size_px: Any) -> dict[str, Any]:
        sensor = self.rig.twin.instrument.head.cameras[self._camera].camera
        x_px = min(corner.x_px, sensor.width_px - _LEAST_PX)
        y_px = min(corner.y_px, sensor.height_px - _LEAST_PX)
        width = int(np.clip(size_px[0], _LEAST_PX, sensor.width_px - x_px))
        height = int(np.clip(size_px[1], _LEAST_PX, sensor.height_px - y_px))
        return {"window": SensorWindow(x_px, y_px), "size_px": (width, height)}

    def start(self, trigger: TriggerMode = "free") -> None:
        """Begin to deliver frames."""
        if trigger == "software":
            raise DeviceError("it has no software trigger", where=self.name)
        with self.rig.lock:
            self._begin(self._camera in self.rig.modes)
            self.rig.modes[self._camera] = trigger
            self.rig.run_anew()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if none came in time."""
        self._line.mend()
        return cast(Frame | None, self._line.inbox.take(timeout_s))

    def _halt(self) -> None:
        with self.rig.lock:
            self.rig.modes.pop(self._camera, None)
            self.rig.lock.notify_all()


class TwinArm(_TwinDevice):
    """See `armscan.devices.protocols.Arm`."""

    def __init__(self, rig: TwinRig) -> None:
        super().__init__(rig, "arm")
        self._start_ns = 0
        self._until_ns = 0

    @property
    def pose_form(self) -> PoseForm:
        """Quaternions: it delivers poses, and joint angles besides."""
        return "quaternion"

    def start(self) -> None:
        """Begin to deliver samples."""
        with self.rig.lock:
            self._begin(self._is_started)
            if not self._is_started:
                self._start_ns = self._until_ns = time.monotonic_ns()
            self._is_started = True

    def read(self, timeout_s: float) -> tuple[ArmSample, ...]:
        """All samples that came since the last call; waits for the first."""
        self._line.mend()
        until_ns = time.monotonic_ns() + round(1e9 * timeout_s)
        while True:
            if self._is_started:
                self._until_ns = self.rig.samples(self._until_ns, self._start_ns)
            rest_s = 1e-9 * (until_ns - time.monotonic_ns())
            found: tuple[ArmSample, ...] = self._line.inbox.take_all(min(max(rest_s, 0.0), _POLL_S))
            if found or rest_s <= 0.0:
                return found

    def _halt(self) -> None:
        if self._is_started:
            # what it took last becomes known a little later
            time.sleep(1e-9 * _KNOWN_NS)
            self._until_ns = self.rig.samples(self._until_ns, self._start_ns)
        self._is_started = False


class TwinLasers(_TwinDevice):
    """See `armscan.devices.protocols.LaserController`."""

    def __init__(self, rig: TwinRig) -> None:
        super().__init__(rig, "lasers")

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the laser sources."""
        return self.rig.twin.sources

    def set_schedule(self, steps: Sequence[tuple[str, ...]]) -> None:
        """Sources of one trigger after the other, repeated."""
        if not steps:
            raise OptionError("a schedule without steps", where=self.name)
        for lasers in steps:
            self._check(lasers)
        with self.rig.lock:
            self._line.check_answers()
            self.rig.schedule, self.rig.n_steps = [tuple(step) for step in steps], 0
            self.rig.lock.notify_all()

    def set_next(self, lasers: tuple[str, ...]) -> None:
        """Sources of the next trigger, and of those after it until the next call."""
        self.set_schedule([lasers])

    def start(self, rate_hz: float | None) -> None:
        """Trigger at this rate; None waits for triggers from elsewhere."""
        if rate_hz is not None and not 0.0 < rate_hz <= _MOST_HZ:
            raise OptionError(f"{rate_hz} triggers a second", where=self.name)
        with self.rig.lock:
            self._begin(self.rig.are_lasers_started)
            self.rig.laser_rate_hz, self.rig.are_lasers_started = rate_hz, True
            self.rig.run_anew()

    def read(self, timeout_s: float) -> tuple[LaserEvent, ...]:
        """All events since the last call; waits for the first."""
        self._line.mend()
        return cast(tuple[LaserEvent, ...], self._line.inbox.take_all(timeout_s))

    def _check(self, lasers: tuple[str, ...]) -> None:
        unknown = sorted(set(lasers) - set(self.sources))
        if unknown:
            raise OptionError(
                f"no laser is called '{unknown[0]}'",
                where=self.name,
                remedy=f"choose from {', '.join(self.sources)}",
            )

    def _halt(self) -> None:
        with self.rig.lock:
            self.rig.are_lasers_started = False
            self.rig.lock.notify_all()


_RIGS: dict[_Plan, TwinRig] = {}
_RIGS_LOCK, _PREPARED = threading.Lock(), set[tuple[str, TwinScene]]()


@atexit.register
def _end_all() -> None:
    for rig in _RIGS.values():
        rig.end()


class TwinDriver:
    """Opens ``twin:HEAD?seed=1&preset=thesis&scene=plate&rate=10``.

    Devices of one address are those of one instrument; ``camera=1`` is the right one of two. The
    page ``docs/reference/devices.md`` tells all options.
    """

    kinds: tuple[DeviceKind, ...] = ("camera", "arm", "lasers")

    def discover(self) -> tuple[DeviceInfo, ...]:
        """The devices of the head with one line: simulated ones are always there."""
        place = "twin:thesis-single"
        return tuple(DeviceInfo(place, one, f"simulated {one}") for one in self.kinds)

    def open(self, kind: DeviceKind, place: str) -> Camera | Arm | LaserController:
        """Open one device of the instrument at an address.

        Raises
        ------
        DeviceError
            If it is open already, or the head has no such camera.
        OptionError
            If the address names no instrument.
        """
        plan, camera = _plan(place)
        with _RIGS_LOCK:
            rig = _RIGS.get(plan) or TwinRig(plan)
            try:
                if kind == "camera":
                    return TwinCamera(rig, camera)
                return TwinArm(rig) if kind == "arm" else TwinLasers(rig)
            finally:
                if any(line.is_open for line in rig.lines.values()):
                    _RIGS[plan] = rig
                else:
                    rig.end()


DRIVER = TwinDriver()
