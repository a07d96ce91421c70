# SPDX-License-Identifier: Apache-2.0
"""A live scan: what the command line and the console drive."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from typing import Literal

import numpy as np

from armscan.devices.clocks import StreamCounts, StreamMonitor
from armscan.devices.matching import MatchedInstant
from armscan.devices.protocols import CameraSettings, Frame
from armscan.errors import ArmscanError, DeviceError, InputError, OptionError
from armscan.geometry.arrays import FloatArray, ImageArray, IntArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.kernels.arrays import load_kernels
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.instants import Instant, InstantImages
from armscan.pipeline.live.acquire import (
    MEASURING,
    Acquisition,
    LiveEvent,
    Recorder,
    WaitingInstant,
    WaitingInstants,
    exposure_of,
    instant_ns,
)
from armscan.pipeline.live.exposure import ExposureControl, ExposureSettings, LineBrightness
from armscan.pipeline.live.rig import Rig, RigDescription, told_as_fault_of
from armscan.pipeline.measure import (
    MeasuredInstant,
    MeasureOptions,
    cameras_of,
    labeller_for,
    measure_instants,
)
from armscan.reconstruction.labels import PointStatus, StripeLabeller
from armscan.reconstruction.place import BaseTransform, merge_clouds, propagate_to_base
from armscan.records.cloud import PointCloud
from armscan.vision.stripe.extract import load_stripe_method

NEW_PASS_RAD = np.radians(25.0)
"""The head shows another side: a pass of its own, that can be undone by itself."""
STILL_MM, STILL_RAD = 0.05, 5e-4
"""A hand at rest and an arm's scatter move the tool by less between exposures."""
STOP_NS = 500_000_000
"""Standing still for so long ends a pass."""
NEWER_NS = 1_000_000_000
"""An image that came so long after the last one that was measured is shown without stripes."""
RANGE_NS = 2 * NEWER_NS
SELDOM_NS = 500_000_000
"""While recording is behind, one instant in so long is measured: it needs the processor."""
LATENCIES = 500
"""Latest instants over which rate and latency are told."""

SessionState = Literal["closed", "ready", "scanning", "paused", "stopped"]


class LiveStatus(Enum):
    """What became of an instant in the live chain; the recording holds them all."""

    PLACED = "placed in Base"
    NO_POSE = "without pose"
    LASER_OFF = "laser off"
    LASER_UNKNOWN = "what laser was on is not known"
    INCOMPLETE = "parts of an image were lost"
    NO_PARTNER = "the other camera's image is missing"
    STILL = "the hand stood still"
    NOT_SHOWN = "not measured live: the chain was behind"
    FAILED = "could not be measured"


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """How a live scan is measured and shown.

    Parameters
    ----------
    measure
        As of `armscan.pipeline.measure.measure_instants`.
    voxel_mm
        One point a voxel and pass is shown.
    measured_every
        Every so many instants is measured live.
    is_thinned
        Where measuring is slower than the triggers the newest instant is measured, of each choice
        of lasers in turn; else all are, in order, while not too many wait.
    exposure
        How long the cameras expose.
    """

    measure: MeasureOptions = field(default_factory=MeasureOptions)
    voxel_mm: float = 0.5
    measured_every: int = 1
    is_thinned: bool = True
    exposure: ExposureSettings = field(default_factory=ExposureSettings)

    def __post_init__(self) -> None:
        if not 1e-3 <= self.voxel_mm <= 1e3 or self.measured_every < 1:
            raise OptionError(
                f"voxels of {self.voxel_mm:g} mm, every {self.measured_every}th instant",
                remedy="give an edge from 0.001 to 1000 mm and a count from 1",
            )

    @staticmethod
    def of(rig: RigDescription) -> LiveOptions:
        """What the description of a rig says of stripes and exposure times."""
        return LiveOptions(MeasureOptions(stripes=rig.stripes), exposure=rig.exposure)


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """The latest image of one camera that was measured, or one that is a second newer.

    Parameters
    ----------
    image
        As delivered.
    points_px
        (N, 2) stripe points measured in this image, full-sensor pixels.
    sheet
        (N,) index into the sensor's sheets.
    """

    image: ImageArray
    points_px: FloatArray
    sheet: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LiveSnapshot:
    """What a page shows of a session at one moment.

    Parameters
    ----------
    state
        What it does.
    cameras
        One a camera that delivered an image.
    base_from_tool
        The latest pose; None where it is not known.
    range_mm
        Median depth in Sensor of the latest points; None where none was placed for two seconds.
    n_passes, n_points
        Passes and shown points.
    cloud_version
        Changes when `LiveSession.cloud` does.
    counts
        Instants by status since the start.
    rate_hz
        Instants a second that arrived lately.
    latency_ms
        Median and 95 % of exposure to shown; None before anything was placed.
    brightness
        Of the lines, one a camera and choice of lasers, where exposure times are controlled.
    streams
        What was lost, late or doubtful in the stream of each device, in words; empty where nothing.
    faults
        What is wrong now, in words: devices that do not answer.
    """

    state: SessionState
    cameras: tuple[CameraView, ...]
    base_from_tool: Pose[Base, Tool] | None
    range_mm: float | None
    n_passes: int
    n_points: int
    cloud_version: int
    counts: dict[LiveStatus, int]
    rate_hz: float
    latency_ms: tuple[float, float] | None
    brightness: tuple[tuple[LineBrightness, ...], ...]
    streams: tuple[str, ...]
    faults: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ShownCloud:
    """Points of the live cloud, one a voxel and pass.

    Parameters
    ----------
    points_mm
        (N, 3) in Base.
    sheet
        (N,) index into the sensor's sheets.
    sigma_mm
        (N,) standard deviation along the worst direction.
    exposure
        (N,) number of the instant since the start of the session.
    """

    points_mm: FloatArray
    sheet: IntArray
    sigma_mm: FloatArray
    exposure: IntArray


@dataclass(slots=True, eq=False)
class _Pass:
    """Points of one pass, thinned as they come; ``start`` is the number of its first instant."""

    first: Pose[Base, Tool]
    start: int
    voxels: set[int] = field(default_factory=set)
    pieces: list[ShownCloud] = field(default_factory=list)

    def add(self, cloud: PointCloud, number: int, voxel_mm: float) -> None:
        cells = np.floor(cloud.points_mm / voxel_mm).astype(np.int64) & (2**21 - 1)
        keys, places = np.unique(cells @ [1 << 42, 1 << 21, 1], return_index=True)
        is_new = np.array([key not in self.voxels for key in keys.tolist()], dtype=np.bool_)
        self.voxels.update(keys[is_new].tolist())
        kept = cloud.select(np.sort(places[is_new]))
        exposure = np.full(len(kept), number)
        self.pieces.append(ShownCloud(kept.points_mm, kept.sheet, kept.sigma_mm, exposure))


class LiveSession:
    """Drives a rig; every method may be called from any thread.

    Parameters
    ----------
    rig
        Opened; `stop` stops it, who opened it closes it.
    scanner
        Places what is seen in Base; None only to show images and to record.
    options
        Defaults if None.
    recorder
        Keeps all that arrives while scanning; None to keep nothing.
    keep_cloud
        Told of the full points in Base of every instant placed, all cameras in one cloud, with
        the instant's number.

    Raises
    ------
    InputError
        If the rig has not the scanner's cameras, no arm, or one whose joint angles need its
        document.
    """

    def __init__(
        self,
        rig: Rig,
        scanner: ScannerCalibration | None = None,
        *,
        options: LiveOptions | None = None,
        recorder: Recorder | None = None,
        keep_cloud: Callable[[int, PointCloud], None] | None = None,
    ) -> None:
        self.options = options or LiveOptions()
        self._rig, self._scanner, self._recorder = rig, scanner, recorder
        self._keep_cloud = keep_cloud
        self._labeller = self._checked(rig, scanner)
        latency_ns = 0 if scanner is None else scanner.latency_ns
        self._acquisition = Acquisition(rig, self._take, self._tell, latency_ns=latency_ns)
        self._lock = threading.RLock()
        self._listeners: list[Callable[[LiveEvent], None]] = []
        self._state: SessionState = "closed"
        self._todo = WaitingInstants(is_thinned=self.options.is_thinned)
        self._measuring = threading.Thread(target=self._measure, daemon=True)
        self._passes: list[_Pass] = []
        self._version = self._n_instants = 0
        self._counts: Counter[LiveStatus] = Counter()
        self._frames: dict[int, Frame] = {}
        self._measured: dict[int, tuple[int, CameraView]] = {}
        self._latest: Pose[Base, Tool] | None = None
        self._moved_ns = 0
        self._last_moved: Pose[Base, Tool] | None = None
        self._ranged: tuple[int, float | None] = 0, None
        self._arrivals: deque[int] = deque(maxlen=LATENCIES)
        self._latencies: deque[float] = deque(maxlen=LATENCIES)
        self._next_pass: int | None = 0
        """Number of the instant with which a pass begins; those before belong to the last one."""
        self._begun = self._scanned = 0
        """Numbers of the instant with which scanning was begun last, and behind the last one that
        was to be placed."""
        self._taken_back = 0
        """Instants before this number that still wait to be measured are not placed any more."""
        self._told = ""
        self._now: WaitingInstant | None = None
        self._waits_since_ns = 0
        self._asked: tuple[str, ...] = ()
        self._controls = [
            ExposureControl(one, self.options.exposure, partial(self._tell_set, one.name))
            for one in rig.cameras
        ]

    def _checked(self, rig: Rig, scanner: ScannerCalibration | None) -> StripeLabeller | None:
        if scanner is None:
            return None
        if scanner.sensor is None or rig.arm is None:
            raise InputError("a live scan needs a scanner with cameras and an arm")
        if rig.arm.pose_form == "joints" and rig.arm_model is None:
            raise InputError(
                "the arm gives joint angles, and nothing says which poses they are",
                remedy='name its document in rig.toml: arm_model = "arm.toml"',
            )
        n = len(cameras_of(scanner.sensor))
        if n != len(rig.cameras):
            raise InputError(
                f"the rig has {len(rig.cameras)} cameras, the scanner {n}",
                remedy="give the scanner's calibration that belongs to this rig",
            )
        return labeller_for(scanner.sensor, self.options.measure, is_scan=True)

    def add_listener(self, listener: Callable[[LiveEvent], None]) -> None:
        """Have events told; from the threads in which they happen."""
        self._listeners.append(listener)

    def open(self) -> None:
        """Start the rig and show its images; nothing is recorded yet.

        Raises
        ------
        DeviceError
            If a device does not answer, or the session was opened before.
        """
        if self._state != "closed":
            raise DeviceError("a session is opened once", remedy="make a new one")
        if self._labeller is not None:
            # no exposure waits for a loop to be loaded or compiled
            load_stripe_method(self.options.measure.stripes.method)
            load_kernels()
        try:
            for control, camera in zip(self._controls, self._rig.cameras, strict=True):
                with told_as_fault_of(camera.name):
                    control.start()
            self._acquisition.start()
        except BaseException:
            for control in self._controls:
                control.stop()
            raise
        self._measuring.start()
        self._choose_lasers()
        self._change("ready")

    def start(self) -> None:
        """Begin to scan with a new pass; opens the rig if nobody did. Raises as `resume`."""
        if self._state == "closed":
            self.open()
        self.resume()

    def resume(self) -> None:
        """Go on with a new pass.

        Raises
        ------
        DeviceError
            If the session is not open, or over.
        """
        if self._state in ("closed", "stopped"):
            fact = "is over" if self._state == "stopped" else "is not open"
            raise DeviceError(f"the session {fact}", remedy="open a new one")
        self._next_pass = self._begun = self._n_instants
        self._acquisition.recorder = self._recorder
        self._change("scanning")

    def pause(self) -> None:
        """Show images, and neither record nor place."""
        if self._state in ("closed", "stopped"):
            return
        self._acquisition.recorder = None
        self._change("paused")

    @property
    def last_pass_start(self) -> int:
        """Number of the instant with which the last pass begins; 0 if there is no pass."""
        with self._lock:
            return self._passes[-1].start if self._passes else 0

    def undo_pass(self) -> range:
        """Take the last pass out of the live cloud; the recorder has and keeps all of it.

        The last pass is what came since scanning was begun, if that is still to be placed.

        Returns the numbers of the instants since the pass began, also of those that were not
        placed; none if there was no pass.
        """
        self._acquisition.wait_until_kept()
        with self._lock:
            end = self._n_instants
            start, stop = max(self._begun, self._taken_back), self._scanned
            if self._passes and (self._passes[-1].start >= self._begun or start >= stop):
                start, stop = self._passes.pop().start, end
            if start < stop:
                self._next_pass = self._taken_back = end
                self._version += 1
        told = "the last pass was taken back" if start < stop else "there is no pass to take back"
        self._tell(LiveEvent("pass", told))
        return range(start, max(start, stop))

    def clear(self) -> range:
        """Empty the live cloud, which the recorder keeps; returns the numbers of all instants."""
        self._acquisition.wait_until_kept()
        with self._lock:
            self._passes.clear()
            end = self._next_pass = self._taken_back = self._n_instants
            self._version += 1
        return range(end)

    def stop(self) -> None:
        """Lasers off; what arrived is recorded and measured to its end."""
        if self._state in ("closed", "stopped"):
            return
        if self.options.exposure.mode != "fixed":
            self._rig.darken()  # a control waits for its camera, which may be unplugged
        for control in self._controls:
            control.stop()
        self._acquisition.stop()
        self._todo.close()
        self._measuring.join()
        self._change("stopped")

    @property
    def is_recording(self) -> bool:
        """Whether what arrives is kept now; not any more after the recorder failed."""
        return self._acquisition.recorder is not None and self._acquisition.is_matching

    @property
    def is_timed(self) -> bool:
        """Whether the clocks of all devices are known well enough to place by time."""
        return all(one.is_timed for one in self._monitors)

    @property
    def stream_counts(self) -> tuple[StreamCounts, ...]:
        """What was seen of each camera, the arm and the laser controller, as far as there are."""
        return tuple(replace(one.counts) for one in self._monitors)

    @property
    def _monitors(self) -> tuple[StreamMonitor, ...]:
        return tuple(monitor for _, monitor in self._acquisition.monitored)

    def snapshot(self) -> LiveSnapshot:
        """What there is to show now."""
        with self._lock:
            views = tuple(self._view(k) for k in sorted(self._frames))
            times, late = list(self._arrivals), list(self._latencies)
            now_ns = time.monotonic_ns()
            span = (now_ns - times[0]) * 1e-9 if len(times) > 1 else 0.0
            return LiveSnapshot(
                state=self._state,
                cameras=views,
                base_from_tool=self._latest,
                range_mm=self._ranged[1] if now_ns - self._ranged[0] < RANGE_NS else None,
                n_passes=len(self._passes),
                n_points=sum(len(one.voxels) for one in self._passes),
                cloud_version=self._version,
                counts=dict(self._counts),
                rate_hz=(len(times) - 1) / span if span > 0.0 else 0.0,
                latency_ms=(float(np.median(late)), float(np.quantile(late, 0.95)))
                if late
                else None,
                brightness=tuple(one.brightness for one in self._controls),
                streams=tuple(
                    f"{device.name}: {monitor.counts.words}" if monitor.counts.words else ""
                    for device, monitor in self._acquisition.monitored
                ),
                faults=tuple(self._acquisition.faults.copy().values()),
            )

    def _view(self, camera: int) -> CameraView:
        """The latest image that was measured, with its own stripes, or a much newer one."""
        frame = self._frames[camera]
        taken_ns, view = self._measured.get(camera, (0, None))
        if view is not None and frame.t_host_ns - taken_ns < NEWER_NS:
            return view
        return CameraView(frame.image, np.zeros((0, 2)), np.zeros(0, dtype=np.int64))

    def cloud(self) -> ShownCloud:
        """The live cloud of all passes that were not taken back."""
        with self._lock:
            pieces = [piece for one in self._passes for piece in one.pieces]
        if not pieces:
            none = np.zeros(0, dtype=np.int64)
            return ShownCloud(np.zeros((0, 3)), none, np.zeros(0), none)
        return ShownCloud(
            np.concatenate([one.points_mm for one in pieces]),
            np.concatenate([one.sheet for one in pieces]),
            np.concatenate([one.sigma_mm for one in pieces]),
            np.concatenate([one.exposure for one in pieces]),
        )

    def _change(self, state: SessionState) -> None:
        self._state = state
        self._tell(LiveEvent("state", state))

    def _tell(self, event: LiveEvent) -> None:
        for listener in tuple(self._listeners):
            try:
                listener(event)
            except Exception as error:  # a listener's fault must not end a device's thread
                self._listeners.remove(listener)
                text = f"a listener failed and is told no more: {type(error).__name__}: {error}"
                self._tell(LiveEvent("warning", text))

    def _tell_set(self, camera: str, what: CameraSettings | DeviceError) -> None:
        if isinstance(what, DeviceError):
            self._tell(LiveEvent("warning", f"its exposure is not controlled: {what}", camera))
        elif what.exposure_us is not None:
            self._tell(LiveEvent("setting", f"exposure {what.exposure_us:.1f} us", camera))

    def _choose_lasers(self) -> None:
        """Ask for the lasers that the head's rule wants next, if it is to choose."""
        lasers, labeller = self._rig.lasers, self._labeller
        if lasers is None or labeller is None or not self._rig.description.chooses_lasers:
            return
        wanted = labeller.next_lasers()
        if wanted and wanted != self._asked:
            try:
                with told_as_fault_of(lasers.name):
                    lasers.set_next(wanted)
            except ArmscanError as error:
                self._tell(LiveEvent("warning", f"the lasers are not chosen: {error}", lasers.name))
            else:
                self._asked = wanted

    def _take(self, instant: MatchedInstant) -> None:
        """Decide what becomes of an instant; from the matching thread."""
        frames = enumerate(instant.frames)
        for control, frame in zip(self._controls, instant.frames, strict=True):
            if frame is not None:
                control.show(frame, instant.lasers)
        with self._lock:
            self._frames |= {k: one for k, one in frames if one is not None}
            self._arrivals.append(time.monotonic_ns())
            self._latest = instant.pose
            number = instant.number
            self._n_instants = number + 1
            if self._state != "scanning":
                return
            if self._labeller is None:
                self._scanned = number + 1
                return
            status = self._fault(instant) or self._moved(instant, number)
            if status is not None:
                self._counts[status] += 1
                return
            self._scanned = number + 1
        now_ns = time.monotonic_ns()
        if self._acquisition.is_behind and now_ns - self._waits_since_ns < SELDOM_NS:
            self._count(LiveStatus.NOT_SHOWN)
            return
        self._waits_since_ns = now_ns
        n_left_out = self._todo.put(WaitingInstant(number, instant, now_ns))
        self._count(LiveStatus.NOT_SHOWN, n_left_out)

    def _count(self, status: LiveStatus, n: int = 1) -> None:
        with self._lock:
            if n:
                self._counts[status] += n

    def _fault(self, instant: MatchedInstant) -> LiveStatus | None:
        if any(frame is None for frame in instant.frames):
            return LiveStatus.NO_PARTNER
        if not all(frame is not None and frame.is_complete for frame in instant.frames):
            return LiveStatus.INCOMPLETE
        if instant.lasers is None and self._rig.lasers is not None:
            return LiveStatus.LASER_UNKNOWN
        if instant.lasers == ():
            return LiveStatus.LASER_OFF
        return LiveStatus.NO_POSE if instant.pose is None else None

    def _moved(self, instant: MatchedInstant, number: int) -> LiveStatus | None:
        """Drop what the hand shows while it is still, and thin what is measured."""
        pose, frame = instant.pose, instant.frames[0]
        if pose is None or frame is None:
            return LiveStatus.NO_POSE
        last, t_ns = self._last_moved, frame.t_device_ns
        if last is not None and _is_still(last, pose):
            if self._next_pass is None and t_ns - self._moved_ns > STOP_NS:
                self._next_pass = number
            if time.monotonic_ns() - self._ranged[0] < RANGE_NS:
                self._ranged = time.monotonic_ns(), self._ranged[1]
            return LiveStatus.STILL
        self._last_moved, self._moved_ns = pose, t_ns
        return LiveStatus.NOT_SHOWN if number % self.options.measured_every else None

    def _feed(self) -> Iterator[InstantImages]:
        while (found := self._next()) is not None:
            self._now = found
            number, instant = found.number, found.instant
            if self._scanner is None or instant.pose is None:
                continue
            setups = [camera.setup for camera in self._rig.cameras]
            both = zip(instant.frames, setups, strict=True)
            exposures = [
                exposure_of(frame, setup, instant, camera)
                for camera, (frame, setup) in enumerate(both)
                if frame is not None
            ]
            yield InstantImages(
                tuple((exposure, None) for exposure in exposures),
                instant.pose @ self._scanner.hand_eye.tool_from_sensor,
                Instant((number,) * len(exposures), instant_ns(instant)),
            )
        self._now = None

    def _next(self) -> WaitingInstant | None:
        found, n_left_out = self._todo.take()
        self._count(LiveStatus.NOT_SHOWN, n_left_out)
        return found

    def _measure(self) -> None:
        if self._scanner is None or self._scanner.sensor is None or self._labeller is None:
            while self._next() is not None:
                """Nothing can be placed."""
            return
        transform = BaseTransform.of(self._scanner)
        while True:
            try:
                for one in measure_instants(
                    self._feed(), self._labeller, self._scanner.sensor, self.options.measure,
                    is_pass=True, reads_ahead=False,
                ):  # fmt: skip
                    self._choose_lasers()
                    if why := self._labeller.left_out(one.images.lasers):
                        self._fail(why, f"images are not measured: {why}")
                    elif self._now is not None:
                        self._place(one, self._now, transform)
                return
            except ArmscanError as error:
                self._fail(error.what, str(error))
            except Exception as error:  # the thread must live: others wait for it
                text = f"an image could not be measured: {type(error).__name__}: {error}"
                self._fail(text, text)

    def _fail(self, fact: str, text: str) -> None:
        """Count one instant and tell; the same fact once, until an instant is placed."""
        self._count(LiveStatus.FAILED)
        is_new, self._told = fact != self._told, fact
        if is_new:
            self._tell(LiveEvent("warning", text, MEASURING))

    def _place(
        self, one: MeasuredInstant, waiting: WaitingInstant, transform: BaseTransform
    ) -> None:
        """Put the points of an instant into the pass that it belongs to."""
        number, instant, pose = waiting.number, waiting.instant, waiting.instant.pose
        if pose is None:
            return
        clouds, depths = [], []
        for found in one.profiles:
            labelled = found.labelled
            clouds.append(propagate_to_base(found.points, labelled.profile, pose, transform))
            depths.append(found.points.points_mm[:, 2])
        with self._lock:
            if number < self._taken_back:
                self._counts[LiveStatus.PLACED] += 1
                return
            is_next = self._next_pass is not None and number >= self._next_pass
            if is_next or not self._passes or self._has_turned(pose):
                # a pass begins with what was asked for, though its first images were not placed
                start = self._next_pass if is_next and self._next_pass is not None else number
                self._passes.append(_Pass(pose, start))
                self._next_pass = None if is_next else self._next_pass
            for cloud in clouds:
                self._passes[-1].add(cloud, number, self.options.voxel_mm)
            for camera, (frame, found) in enumerate(
                zip(instant.frames, one.profiles, strict=False)
            ):
                if frame is not None:
                    seen = found.labelled.status == PointStatus.MEASURED
                    pixels, sheet = found.labelled.profile.points_px, found.labelled.sheet
                    view = CameraView(frame.image, pixels[seen], sheet[seen])
                    self._measured[camera] = frame.t_host_ns, view
            depth = np.concatenate(depths)
            self._ranged = time.monotonic_ns(), float(np.median(depth)) if len(depth) else None
            self._counts[LiveStatus.PLACED] += 1
            self._version += 1
            taken_ns = instant.t_ns or max(one.t_host_ns for one in instant.frames if one)
            self._latencies.append((time.monotonic_ns() - taken_ns) / 1e6)
        self._told = ""
        if self._keep_cloud is not None:
            try:
                self._keep_cloud(number, merge_clouds(clouds))
            except Exception as error:  # not ours; the instant is placed all the same
                text = f"a cloud was not kept: {type(error).__name__}: {error}"
                self._tell(LiveEvent("warning", text))

    def _has_turned(self, pose: Pose[Base, Tool]) -> bool:
        return bool(_turn_rad(self._passes[-1].first, pose) > NEW_PASS_RAD)


def _is_still(one: Pose[Base, Tool], other: Pose[Base, Tool]) -> bool:
    moved = one.translation_mm - other.translation_mm
    return float(np.linalg.norm(moved)) < STILL_MM and _turn_rad(one, other) < STILL_RAD


def _turn_rad(one: Pose[Base, Tool], other: Pose[Base, Tool]) -> float:
    chord = float(np.linalg.norm(one.rotation - other.rotation)) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(chord, 1.0)))
