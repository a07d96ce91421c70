# SPDX-License-Identifier: Apache-2.0
"""What fills a session's recordings: the twin or real devices, one placement or touch at a time,
or a scan while the hand moves.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import cast

import numpy as np

from armscan.calibration.cameras.pairs import SIDES
from armscan.console.journey import BY_NAME, SeeingSettings, SessionSettings, StepName
from armscan.console.scan import ArmReading, Bench, GrowingRecording, samples_of
from armscan.devices.clocks import ElementStatus
from armscan.devices.matching import MatchedInstant, TimedSample, arm_track
from armscan.devices.protocols import (
    Arm,
    ArmSample,
    Camera,
    CameraSettings,
    Frame,
    LaserEvent,
    TriggerMode,
)
from armscan.devices.registry import open_device
from armscan.devices.sources import Preset, ScanSource, TwinScene
from armscan.errors import DeviceError, FileFormatError, OptionError
from armscan.pipeline.live.acquire import exposure_of
from armscan.pipeline.live.exposure import ExposureSettings
from armscan.pipeline.live.rig import Rig, RigDescription, check_targets, read_rig, told_as_fault_of
from armscan.pipeline.live.session import LiveOptions, LiveSession
from armscan.pipeline.simulate import TwinName, fewer_views
from armscan.records.exposure import Exposure
from armscan.records.recording import NO_TRIGGER, CameraSetup, ExposureRow, PoseForm, Session
from armscan.report.quantity import sentence
from armscan.storage.arm import (
    ARM_FILE,
    PROBE_FILE,
    ProbeTip,
    arm_columns,
    probe_tip_toml,
    read_probe_tip,
)
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.recording import read_arm_track, read_recording
from armscan.storage.recording_session import SESSION_FILE, session_toml
from armscan.storage.tables import csv_bytes

TWIN = "twin:"
WAIT_S = 5.0
"""A take waits so long for an image and a pose."""
SHOWN_NS = 2_000_000_000
"""An image that is older is not what a camera sees now."""


SHOWN_SCENES: dict[StepName, TwinScene] = {
    StepName.CAMERA: "camera",
    StepName.LASER: "laser",
    StepName.HAND_EYE: "hand-eye",
    StepName.LATENCY: "latency",
    StepName.CHECK: "ball",
}
"""Put before the devices of a twin that run by themselves; scans see what its address says."""
TAKEN_SCENES: dict[StepName, TwinScene] = {
    StepName.CAMERA: "camera",
    StepName.LASER: "laser",
    StepName.HAND_EYE: "hand-eye",
}


@dataclass(slots=True)
class _Hand:
    """Goes through a scan at a pace, exposure by exposure, and waits where it is held."""

    source: ScanSource
    rate_hz: float
    is_held: bool = True
    at: int = 0
    due: float = 0.0
    _sample: int = 0
    _ready: dict[int, Frame] = field(default_factory=dict)
    """Of the other cameras, taken at the same moment."""
    exposing: threading.Lock = field(default_factory=threading.Lock)
    """Held while images are rendered: the arm's sample of that moment is there afterwards."""

    @property
    def is_over(self) -> bool:
        return self.at >= len(self.source.rows)

    def frame(self, camera: int, timeout_s: float) -> Frame | None:
        """The next exposure, rendered when it is due; None while the hand is held.

        All cameras' images of a moment are rendered before the first of them is given: one after
        the other they would come too far apart to belong together.
        """
        if camera in self._ready:
            return self._ready.pop(camera)
        wait = min(max(self.due - time.monotonic(), 0.0), timeout_s)
        if self.is_held or self.is_over or wait >= timeout_s:
            time.sleep(timeout_s if wait == 0.0 else wait)
            return None
        time.sleep(wait)
        rows, first = self.source.rows, self.at
        if rows[first].camera != camera or self._ready:
            time.sleep(0.002)
            return None
        with self.exposing:
            return None if self.is_held else self._exposed(camera, first)

    def _exposed(self, camera: int, first: int) -> Frame:
        rows = self.source.rows
        last = first + 1
        while last < len(rows) and rows[last].t_ns == rows[first].t_ns:
            last += 1
        shots = [self.source.exposure(k) for k in range(first, last)]
        number, now_ns = first // len(self.source.session.cameras), time.monotonic_ns()
        frames = {
            row.camera: Frame(
                shot.image,
                number,
                row.t_ns,
                now_ns,
                trigger_id=row.trigger_id,
                lasers=row.lasers,
                window=shot.window,
            )
            for row, shot in zip(rows[first:last], shots, strict=True)
        }
        self.due = max(self.due, time.monotonic()) + 1.0 / self.rate_hz
        frame = frames.pop(camera)
        self._ready, self.at = frames, last
        return frame

    def samples(self, timeout_s: float) -> tuple[ArmSample, ...]:
        """Samples of the arm up to the latest exposure."""
        arm = self.source.arm
        if arm is None or self.at == 0:
            time.sleep(timeout_s)
            return ()
        until = self.source.rows[self.at - 1].t_ns if not self.is_over else arm.t_ns[-1]
        stop = int(np.searchsorted(arm.t_ns, until, side="right"))
        found, now = [], time.monotonic_ns()
        for k in range(self._sample, stop):
            ids = arm.trigger_ids
            trigger = None if ids is None or ids[k] == NO_TRIGGER else int(ids[k])
            pose = arm.pose(k) if arm.is_known[k] else None
            joints = None if arm.joints_rad is None else arm.joints_rad[k]
            found.append(ArmSample(k, int(arm.t_ns[k]), now, pose, joints, trigger_id=trigger))
        self._sample = max(stop, self._sample)
        if not found:
            time.sleep(min(timeout_s, 0.01))
        return tuple(found)


@dataclass(slots=True)
class _HandCamera:
    """See `armscan.devices.protocols.Camera`; what the hand's exposures show."""

    hand: _Hand
    camera: int
    settings: CameraSettings = field(default_factory=CameraSettings)

    @property
    def name(self) -> str:
        return f"simulated camera {self.camera}"

    @property
    def is_simulated(self) -> bool:
        return self.hand.source.is_simulated

    @property
    def setup(self) -> CameraSetup:
        return self.hand.source.session.cameras[self.camera]

    def configure(self, settings: CameraSettings) -> CameraSettings:
        return self.settings

    def start(self, trigger: TriggerMode = "free") -> None:
        """Deliver."""

    def read(self, timeout_s: float) -> Frame | None:
        return self.hand.frame(self.camera, timeout_s)

    def stop(self) -> None:
        """Deliver no more than what is being rendered now."""
        with self.hand.exposing:
            pass

    def close(self) -> None:
        """Nothing to give back."""


@dataclass(slots=True)
class _HandArm:
    """See `armscan.devices.protocols.Arm`."""

    hand: _Hand
    name: str = "simulated arm"
    pose_form: PoseForm = "quaternion"

    def start(self) -> None:
        """Deliver."""

    def read(self, timeout_s: float) -> tuple[ArmSample, ...]:
        return self.hand.samples(timeout_s)

    def stop(self) -> None:
        """Deliver no more."""

    def close(self) -> None:
        """Nothing to give back."""


class TwinBench:
    """The twin with its hand that holds targets and the head as a session's steps ask for.

    Parameters
    ----------
    address
        ``twin:HEAD?seed=1&preset=thesis&scene=workpiece&views=24&rate=10``; ``scene`` is what is
        scanned, ``views`` how many exposures of a scan are taken, 0 for all.
    """

    def __init__(self, address: str) -> None:
        head, values = _parsed(address)
        seed, self.views = _whole(values, "seed", 1), _whole(values, "views", 0)
        self.rate_hz = float(max(_whole(values, "rate", 10), 1))
        self.scene = cast(TwinScene, values.get("scene", "workpiece"))
        preset = cast(Preset, values.get("preset", "thesis"))
        self.twin = TwinName(head or "thesis-single", preset, seed).build()
        self.address, self.is_simulated, self.has_operator = address, True, True
        self._n_cameras = len(self.twin.scan("camera").session.cameras)
        self._sources: dict[str, ScanSource] = {}
        self._hand: _Hand | None = None
        self._shots: dict[tuple[TwinScene, int], Exposure] = {}
        self._seen: tuple[StepName, int] | None = None
        self.scan_source(self.scene)

    @property
    def settings(self) -> SessionSettings:
        """As of `Bench`."""
        place = files("armscan.simulation") / "workpiece" / "workpiece.stl"
        with as_file(place) as path:
            part = str(path) if self.scene == "workpiece" else ""
        return SessionSettings(
            rig=self.address,
            target=self.twin.target,
            n_cameras=self._n_cameras,
            ball_mm=self.twin.truth.ball_diameter_mm,
            part=part,
            tolerance="0.1" if part else "",
        )

    @property
    def n_placements(self) -> dict[StepName, int]:
        """As of `Bench`."""
        found = {step: len(self._views(scene)) for step, scene in TAKEN_SCENES.items()}
        return {**found, StepName.PROBING: len(self.twin.probe_plate().arm)}

    def scan_source(self, scene: TwinScene) -> ScanSource:
        """The exposures of a scene, as many as are wanted."""
        if scene not in self._sources:
            whole = self.twin.scan(scene)
            is_thinned = self.views > 0 and scene not in TAKEN_SCENES.values()
            self._sources[scene] = fewer_views(whole, self.views) if is_thinned else whole
        return self._sources[scene]

    def _views(self, scene: TwinScene) -> list[list[int]]:
        groups: dict[object, list[int]] = {}
        for k, row in enumerate(self.scan_source(scene).rows):
            groups.setdefault(row.arrangement, []).append(k)
        return list(groups.values())

    def take(self, step: StepName, folder: Path, k: int) -> tuple[Exposure, ...]:
        """As of `Bench`."""
        scene = TAKEN_SCENES[step]
        source, views = self.scan_source(scene), self._views(scene)
        if k >= len(views):
            raise DeviceError(
                "the simulated operator has shown all placements", remedy="calculate now"
            )
        grown = GrowingRecording.of(
            folder, replace(source.session, is_simulated=source.is_simulated)
        )
        shots = [self._rendered(scene, row) for row in views[k]]
        for row, shot in zip(views[k], shots, strict=True):
            grown.add(source.rows[row], shot)
        if source.arm is not None:
            last = source.rows[views[k][-1]].t_ns
            for t_ns, pose, trigger in samples_of(source.arm):
                if t_ns <= last:
                    grown.add_sample(t_ns, pose, trigger)
        grown.flush()
        return _one_a_camera(shots)

    def look(self, step: StepName, k: int) -> tuple[Exposure, ...]:
        """As of `Bench`: what the simulated operator holds for the next take."""
        if step not in TAKEN_SCENES or self._seen == (step, k):
            return ()
        self._seen = step, k
        scene = TAKEN_SCENES[step]
        rows, source = self._views(scene), self.scan_source(scene)
        if k >= len(rows):
            return ()
        lit = [row for row in rows[k] if source.rows[row].lasers] or rows[k]
        first = {source.rows[row].camera: row for row in reversed(lit)}
        return tuple(self._rendered(scene, first[camera]) for camera in sorted(first))

    def rest(self) -> None:
        """As of `Bench`: what is looked at next is shown, whatever was shown before."""
        self._seen = None

    def _rendered(self, scene: TwinScene, row: int) -> Exposure:
        """An image of a scene; the latest are kept: they are looked at, and then taken."""
        if (scene, row) not in self._shots:
            if len(self._shots) >= KEPT_SHOTS:
                self._shots.pop(next(iter(self._shots)))
            self._shots[scene, row] = self.scan_source(scene).exposure(row)
        return self._shots[scene, row]

    def touch(self, folder: Path, k: int) -> None:
        """As of `Bench`."""
        probing = self.twin.probe_plate()
        if k >= len(probing.arm):
            raise DeviceError("the simulated operator has touched all places")
        tip = ProbeTip(probing.tool_from_probe_mm, probing.tip_diameter_mm)
        samples = list(samples_of(probing.arm))[: k + 1]
        _write_touches(folder, samples, tip, is_simulated=True)

    def scan_rig(self, step: StepName) -> Rig:
        """As of `Bench`."""
        scenes: dict[StepName, TwinScene] = {StepName.CHECK: "ball", StepName.LATENCY: "latency"}
        source = self.scan_source(scenes.get(step, self.scene))
        hand = self._hand = _Hand(source, self.rate_hz)
        ids = source.arm is not None and source.arm.trigger_ids is not None
        description = RigDescription((self.address,) * self._n_cameras, is_common_trigger=ids)
        cameras: list[Camera] = [_HandCamera(hand, k) for k in range(self._n_cameras)]
        arm: Arm = _HandArm(hand)
        return Rig(cameras, arm, None, description)

    @property
    def seeing(self) -> SeeingSettings:
        """As of `Bench`."""
        return SeeingSettings()

    def see(self, seeing: SeeingSettings | None) -> None:
        """As of `Bench`; its images are rendered as they are, only thresholds matter."""
        if seeing is not None:
            seeing.set_in(RigDescription((self.address,) * self._n_cameras))

    def hold(self, is_held: bool) -> None:
        """As of `Bench`."""
        if self._hand is not None:
            self._hand.is_held = is_held

    @property
    def is_over(self) -> bool:
        """As of `Bench`."""
        return self._hand is not None and self._hand.is_over

    def close(self) -> None:
        """As of `Bench`."""


def _write_touches(
    folder: Path,
    samples: Sequence[ArmReading],
    tip: ProbeTip,
    *,
    is_simulated: bool,
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    track = arm_track([one[0] for one in samples], [one[1] for one in samples])
    session = Session(cameras=(), is_simulated=is_simulated)
    contents = {
        folder / ARM_FILE: csv_bytes(arm_columns(track, session.pose_form, session.rotation, {})),
        folder / PROBE_FILE: probe_tip_toml(tip),
        folder / SESSION_FILE: session_toml(session),
    }
    write_files(contents, is_overwriting=True)


def _parsed(address: str) -> tuple[str, dict[str, str]]:
    head, _, options = address.removeprefix(TWIN).partition("?")
    pairs = [word.partition("=") for word in options.split("&") if word]
    values = {key: value for key, _, value in pairs}
    if unknown := sorted(set(values) - {"seed", "preset", "scene", "views", "rate"}):
        raise OptionError(
            f"the address has no '{unknown[0]}'",
            where=address,
            remedy="write for example twin:thesis-single?seed=1&scene=workpiece",
        )
    return head, values


def _whole(values: dict[str, str], key: str, default: int) -> int:
    text = values.get(key, str(default))
    if not text.isdigit():
        raise OptionError(f"{key} is '{text}'", remedy="give a whole number, 0 or more")
    return int(text)


class _Latest:
    """Keeps what came last; see `armscan.pipeline.live.acquire.Recorder`."""

    def __init__(self) -> None:
        self.instants: deque[MatchedInstant] = deque(maxlen=8)
        self.samples: deque[TimedSample] = deque(maxlen=64)

    def add_frame(self, camera: int, frame: Frame, status: ElementStatus) -> None:
        """Instants hold the frames."""

    def add_samples(self, samples: tuple[TimedSample, ...]) -> None:
        """Keep them."""
        self.samples.extend(samples)

    def add_events(self, events: tuple[LaserEvent, ...]) -> None:
        """Instants know what was on."""

    def add_instant(self, instant: MatchedInstant) -> None:
        """Keep it."""
        self.instants.append(instant)


class DeviceBench:
    """Real devices, or any that were opened; ``close`` closes their rig."""

    def __init__(self, rig: Rig, name: str) -> None:
        self.rig, self.name = rig, name
        self.n_placements: dict[StepName, int] = {}
        self.is_over = self.has_operator = False
        self.is_simulated = rig.is_simulated
        self._described, self._photo_us = rig.description, 0.0
        self._whole = [camera.settings for camera in rig.cameras]
        self._lock = threading.RLock()
        self._watched: tuple[LiveSession, _Latest] | None = None
        self._watched_for: StepName | None = None
        self._lit: tuple[str, ...] | None = None

    @property
    def settings(self) -> SessionSettings:
        """As of `Bench`."""
        return SessionSettings(
            rig=self.name,
            n_cameras=len(self.rig.cameras),
            needs_latency=not self.rig.description.is_common_trigger,
        )

    def take(self, step: StepName, folder: Path, k: int) -> tuple[Exposure, ...]:
        """As of `Bench`: one image in the light of the room, one of each laser, or both."""
        sources = self._sources
        if step is StepName.LASER and not sources:
            raise DeviceError(
                "the rig has no laser controller; each take is with the laser and without",
                remedy="name one as lasers in rig.toml, or calibrate the sheets from photographs "
                "with `armscan calibrate laser`",
            )
        states: list[tuple[str, ...]] = [()]
        if step is StepName.LASER:
            states = [*((source,) for source in sources), ()]
        elif step is StepName.HAND_EYE:
            states = [sources, sources]
        # cameras deliver their whole sensor from here on
        self._watch(step)
        setups = [camera.setup for camera in self.rig.cameras]
        session = Session("calibration", tuple(setups), is_simulated=self.is_simulated)
        grown = GrowingRecording.of(folder, session)
        shots = []
        view = f"{k + 1:02d}"
        try:
            for state, instant in zip(states, self._instants(states, step), strict=True):
                t_ns = _later(grown, instant)
                for camera, frame in enumerate(instant.frames):
                    if frame is None:
                        continue
                    index = 1 + max((row.index for row in grown.rows), default=-1)
                    name = f"images/{index:04d}.png"
                    row = ExposureRow(index, t_ns, camera, name, state, None, view)
                    lit = replace(instant, lasers=state)
                    shots.append(exposure_of(frame, setups[camera], lit, camera))
                    grown.add(row, shots[-1])
                if step is StepName.HAND_EYE:
                    grown.add_sample(t_ns, instant.pose, None)
        finally:
            self._light(())
        grown.flush()
        return _one_a_camera(shots)

    def touch(self, folder: Path, k: int) -> None:
        """As of `Bench`; the tip is that of ``probe.toml`` in the session's folder."""
        tip = read_probe_tip(folder.parents[1] / PROBE_FILE)
        if self.rig.arm is None:
            raise DeviceError("the rig has no arm", remedy="name it in rig.toml")
        latest = self._watch(StepName.PROBING)
        self._light(())
        latest.samples.clear()
        end = time.monotonic() + WAIT_S
        while not (found := [one for one in tuple(latest.samples) if one.pose is not None]):
            if time.monotonic() > end:
                raise DeviceError("the arm gives no pose", remedy="reference it")
            time.sleep(0.01)
        before: list[ArmReading] = []
        with suppress(FileFormatError):
            before = list(samples_of(read_arm_track(folder)[0]))
        t_ns = max(found[-1].sample.t_host_ns, before[-1][0] + 1 if before else 0)
        _write_touches(folder, [*before, (t_ns, found[-1].pose, -1)], tip,
                       is_simulated=self.is_simulated)  # fmt: skip

    def look(self, step: StepName, k: int) -> tuple[Exposure, ...]:
        """As of `Bench`: the latest images; raises while a camera does not answer."""
        latest = self._watch(step)
        self._light(() if step is StepName.CAMERA else self._sources)
        since_ns = time.monotonic_ns() - SHOWN_NS
        found = {
            camera: (frame, one)
            for one in tuple(latest.instants)
            for camera, frame in enumerate(one.frames)
            if frame is not None and frame.t_host_ns > since_ns
        }
        watched = self._watched if len(found) < len(self.rig.cameras) else None
        if watched is not None and (faults := watched[0].snapshot().faults):
            raise DeviceError(" ".join(sentence(fault) for fault in faults))
        return tuple(
            exposure_of(frame, self.rig.cameras[camera].setup, one, camera)
            for camera, (frame, one) in sorted(found.items())
        )

    @property
    def seeing(self) -> SeeingSettings:
        """As of `Bench`."""
        return SeeingSettings.of(self._described)

    def see(self, seeing: SeeingSettings | None) -> None:
        """As of `Bench`."""
        how = seeing or SeeingSettings.of(self._described)
        described = how.set_in(self._described)
        check_targets(described, self.rig.lasers)
        self.rest()
        self.rig.description, self._photo_us = described, how.photo_us

    def _watch(self, step: StepName) -> _Latest:
        """What comes while targets and head are put right; nothing of it is recorded."""
        with self._lock:
            if self._watched is None or self._watched_for is not step:
                self.rest()
                self._set_out(step)
                # photographs are taken in the light of the room: there is no line to go by
                exposure = self.rig.description.exposure
                if step is StepName.CAMERA:
                    exposure = ExposureSettings(exposure_us=self._photo_us)
                latest = _Latest()
                session = LiveSession(
                    self.rig, options=LiveOptions(exposure=exposure), recorder=latest
                )
                session.start()
                self._watched, self._watched_for, self._lit = (session, latest), step, None
            return self._watched[1]

    def _set_out(self, step: StepName) -> None:
        """The cameras as they were opened: windows are for scans, exposures for their step."""
        for camera, whole in zip(self.rig.cameras, self._whole, strict=True):
            with told_as_fault_of(camera.name):
                camera.configure(replace(whole, rate_hz=None))
        if self.rig.can_show and step in SHOWN_SCENES:
            self.rig.show(SHOWN_SCENES[step])

    def rest(self) -> None:
        """As of `Bench`."""
        with self._lock:
            if self._watched is not None:
                self._watched[0].stop()
            self._watched = None

    @property
    def _sources(self) -> tuple[str, ...]:
        return () if self.rig.lasers is None else self.rig.lasers.sources

    def _light(self, lasers: tuple[str, ...]) -> None:
        """Have these lasers on from now."""
        if self.rig.lasers is not None and self._lit != lasers:
            # one that does not answer may have done it all the same
            self._lit = None
            self.rig.lasers.set_next(lasers)
            self._lit = lasers

    def _instants(
        self, states: Sequence[tuple[str, ...]], step: StepName
    ) -> Iterator[MatchedInstant]:
        """One complete instant of each state of the lasers."""
        latest = self._watch(step)
        for state in states:
            self._light(state)
            latest.instants.clear()
            end = time.monotonic() + WAIT_S
            while (one := self._complete(latest, state, step)) is None:
                if time.monotonic() > end:
                    raise DeviceError(
                        f"no complete image came within {WAIT_S:g} s",
                        remedy="check camera, trigger and arm in the list of devices",
                    )
                time.sleep(0.01)
            yield one

    def _complete(
        self, latest: _Latest, state: tuple[str, ...], step: StepName
    ) -> MatchedInstant | None:
        has_pose = step is not StepName.HAND_EYE
        for one in tuple(latest.instants):
            is_whole = all(frame is not None and frame.is_complete for frame in one.frames)
            is_state = self.rig.lasers is None or one.lasers == state
            if is_whole and is_state and (has_pose or one.pose is not None):
                return one
        return None

    def scan_rig(self, step: StepName) -> Rig:
        """As of `Bench`."""
        self.rest()
        self._set_out(step)
        self.rig.set_windows()
        return self.rig

    def hold(self, is_held: bool) -> None:
        """As of `Bench`."""

    def close(self) -> None:
        """As of `Bench`."""
        self.rest()
        self.rig.close()


def take_back(step: StepName, folder: Path) -> None:
    """Take the latest placement or touch out of a step's recording."""
    if BY_NAME[step].filling != "touches":
        grown = GrowingRecording.of(folder, read_recording(folder).session)
        grown.take_back()
        grown.flush()
        return
    track = read_arm_track(folder)[0]
    is_simulated = are_simulated([folder / ARM_FILE])
    left = list(samples_of(track))[:-1]
    if left:
        _write_touches(folder, left, read_probe_tip(folder / PROBE_FILE), is_simulated=is_simulated)
    else:
        (folder / ARM_FILE).unlink()


KEPT_SHOTS = 2
"""One of each camera that a head may have."""


def _one_a_camera(shots: Sequence[Exposure]) -> tuple[Exposure, ...]:
    """Of each camera the last image with a laser, or the last one."""
    lit = [shot for shot in shots if shot.lasers] or shots
    last = {shot.camera: shot for shot in lit}
    return tuple(last[camera] for camera in sorted(last))


def _later(grown: GrowingRecording, instant: MatchedInstant) -> int:
    first = next(frame for frame in instant.frames if frame is not None)
    t_ns = first.t_host_ns if instant.t_ns is None else instant.t_ns
    return max(t_ns, 1 + max((row.t_ns for row in grown.rows), default=0))


def open_bench(rig: str) -> Bench:
    """Open what fills a session: ``rig.toml``, or ``twin:HEAD?seed=1`` for the simulator."""
    if rig.startswith(TWIN):
        return TwinBench(rig)
    description = read_rig(Path(rig))
    if len(description.cameras) > len(SIDES):
        raise OptionError(
            f"{len(description.cameras)} cameras are more than a head of the console has",
            where=rig,
            remedy="name one or two; `armscan record` takes any number",
        )
    return DeviceBench(Rig.open(description, open_device), rig)
