# SPDX-License-Identifier: Apache-2.0
"""What a session records: placements one by one in a folder, and a scan while it is taken, with its
live chain, in one file.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from armscan.console.journey import SeeingSettings, SessionSettings, StepName
from armscan.console.quality import Incidence, passes_apart_mm
from armscan.devices.matching import MatchedInstant, TimedSample, arm_track
from armscan.errors import DeviceError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.arm import axis_frames
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.live.acquire import OWN_PARTS, LiveEvent
from armscan.pipeline.live.recorder import LiveRecorder
from armscan.pipeline.live.rig import Rig
from armscan.pipeline.live.session import (
    LiveSession,
    LiveSnapshot,
    ShownCloud,
)
from armscan.records.exposure import Exposure
from armscan.records.recording import NO_TRIGGER, ArmTrack, ExposureRow, Session
from armscan.storage.arm import ARM_FILE, arm_columns
from armscan.storage.files import (
    SetAside,
    bring_back,
    make_folder,
    set_aside,
    settle_aside,
    write_files,
)
from armscan.storage.recording import encoded_png, read_recording
from armscan.storage.recording_session import (
    EXPOSURES_FILE,
    SESSION_FILE,
    exposure_columns,
    session_toml,
)
from armscan.storage.tables import csv_bytes

CLOCKS_S = 5.0
"""A scan begins when the devices' clocks are known, or after so long with those that are."""
ArmReading = tuple[int, Pose[Base, Tool] | None, int]
"""Time in ns, ``base_from_tool`` or None, and number of the trigger."""


@dataclass(slots=True)
class GrowingRecording:
    """A folder recording that is whole after every `flush`; what the folder holds is kept."""

    folder: Path
    session: Session
    rows: list[ExposureRow] = field(default_factory=list)
    samples: list[ArmReading] = field(default_factory=list)

    @staticmethod
    def of(folder: Path, session: Session) -> GrowingRecording:
        """That of a folder, empty if there is none."""
        cameras = tuple(replace(one, align="low") for one in session.cameras)
        grown = GrowingRecording(folder, replace(session, cameras=cameras))
        if (folder / EXPOSURES_FILE).is_file():
            found = read_recording(folder)
            grown.rows = list(found.rows)
            if found.arm is not None:
                grown.samples = list(samples_of(found.arm))
        return grown

    def add(self, row: ExposureRow, exposure: Exposure) -> None:
        """Write an image; `flush` lists it."""
        content = encoded_png(exposure, self.session.cameras[row.camera])
        path = self.folder / row.source
        make_folder(path.parent, with_parents=True)
        write_files({path: content}, is_overwriting=True)
        self.rows.append(row)

    def take_back(self) -> None:
        """Take the latest view out of the list, and samples of the arm that came after the rest."""
        last = self.rows[-1].arrangement if self.rows else None
        self.rows = [row for row in self.rows if row.arrangement != last]
        until = max((row.t_ns for row in self.rows), default=-1)
        self.samples = [one for one in self.samples if one[0] <= until]

    def add_sample(self, t_ns: int, pose: Pose[Base, Tool] | None, trigger_id: int | None) -> None:
        """Keep a sample of the arm; one that is not later than the last is passed over."""
        if not self.samples or t_ns > self.samples[-1][0]:
            self.samples.append((t_ns, pose, NO_TRIGGER if trigger_id is None else trigger_id))

    def flush(self) -> None:
        """Write the tables, all or none."""
        if not self.rows:
            (self.folder / EXPOSURES_FILE).unlink(missing_ok=True)
            return
        contents = {self.folder / EXPOSURES_FILE: csv_bytes(exposure_columns(self.rows, {}))}
        if self.samples:
            columns = arm_columns(self._track(), "quaternion", self.session.rotation, {})
            contents[self.folder / ARM_FILE] = csv_bytes(columns)
        facts = replace(self.session, pose_form="quaternion")
        contents[self.folder / SESSION_FILE] = session_toml(facts)
        write_files(contents, is_overwriting=True)

    def _track(self) -> ArmTrack:
        times, poses, triggers = zip(*self.samples, strict=True)
        ids = np.array(triggers, dtype=np.int64)
        has_ids = bool((ids != NO_TRIGGER).any())
        return replace(arm_track(list(times), list(poses)), trigger_ids=ids if has_ids else None)


def samples_of(arm: ArmTrack) -> Iterator[ArmReading]:
    """The samples of a track one by one."""
    for k, t_ns in enumerate(arm.t_ns.tolist()):
        trigger = NO_TRIGGER if arm.trigger_ids is None else int(arm.trigger_ids[k])
        yield t_ns, arm.pose(k) if arm.is_known[k] else None, trigger


class Bench(Protocol):
    """A rig and what stands before it, as the console uses them."""

    @property
    def settings(self) -> SessionSettings:
        """What a new session knows of it."""

    @property
    def is_simulated(self) -> bool:
        """Whether images are rendered."""

    @property
    def has_operator(self) -> bool:
        """Whether a simulated operator shows what each step asks for."""

    @property
    def seeing(self) -> SeeingSettings:
        """How they are looked at where nothing else is said."""

    def see(self, seeing: SeeingSettings | None) -> None:
        """Look at cameras and lines so from now; None for what the rig's description says."""

    @property
    def n_placements(self) -> dict[StepName, int]:
        """Placements or touches of a step, where the rig knows them better than the list."""

    def take(self, step: StepName, folder: Path, k: int) -> tuple[Exposure, ...]:
        """Record placement ``k`` of a step into a folder; returns an image a camera to show."""

    def touch(self, folder: Path, k: int) -> None:
        """Record touch ``k``; raises as `take`."""

    def look(self, step: StepName, k: int) -> tuple[Exposure, ...]:
        """What each camera sees now, before placement ``k`` is taken; none if nothing is new.

        The lasers that the step is about are on meanwhile, until `rest`.
        """

    def rest(self) -> None:
        """Lasers off, and no more images."""

    def scan_rig(self, step: StepName) -> Rig:
        """Opened devices for a scan, with the thing that the step is about before them."""

    def hold(self, is_held: bool) -> None:
        """Keep a simulated hand where it is; a person's stays by itself."""

    @property
    def is_over(self) -> bool:
        """Whether a simulated hand has come to its end."""

    def close(self) -> None:
        """Give the devices back."""


class ScanRecorder(LiveRecorder):
    """Records a live scan to one file, and knows what came with which frame.

    Parameters
    ----------
    path, rig
        As of `LiveRecorder`.
    keeps_times
        Times are the devices' own, of one clock: a simulated hand arrives as fast as its images are
        rendered, and this computer's time says nothing of it.

    Attributes
    ----------
    pose_of
        The tool's pose by the instant's number.
    latest_joints_rad
        (J,) angles of the arm, where it gives them.
    n_left_out
        Exposures that were taken back.
    """

    def __init__(self, path: Path, rig: Rig, *, keeps_times: bool = False) -> None:
        super().__init__(path, rig)
        self.path, self._keeps_times = path, keeps_times
        self.pose_of: dict[int, Pose[Base, Tool] | None] = {}
        self.latest_joints_rad: FloatArray | None = None
        self.n_left_out = 0
        self._indices: dict[int, range] = {}
        """Exposures that are listed, by the number of their instant."""
        self._gone = range(0)
        self._lock = threading.Lock()

    def add_samples(self, samples: tuple[TimedSample, ...]) -> None:
        """Keep them, and the latest angles to draw the arm."""
        for one in samples:
            if one.sample.joints_rad is not None:
                self.latest_joints_rad = one.sample.joints_rad
        if self._keeps_times:
            samples = tuple(replace(one, t_ns=one.sample.t_device_ns) for one in samples)
        super().add_samples(samples)

    def add_instant(self, instant: MatchedInstant) -> None:
        """Write its images."""
        with self._lock:
            first = self.n_exposures
            if self._keeps_times:
                times = [frame.t_device_ns for frame in instant.frames if frame is not None]
                instant = replace(instant, t_ns=times[0])
            super().add_instant(instant)
            self.pose_of[instant.number] = instant.pose
            self._indices[instant.number] = range(first, self.n_exposures)
            # it was taken back while it waited to be recorded
            if instant.number in self._gone:
                self._leave_out(range(instant.number, instant.number + 1))

    def leave_out(self, numbers: range) -> None:
        """Take instants out of the list, also those of them that are still to be recorded."""
        with self._lock:
            self._gone = numbers or self._gone
            self._leave_out(numbers)

    def _leave_out(self, numbers: range) -> None:
        gone = [self._indices.pop(one) for one in numbers if one in self._indices]
        if gone:
            self.n_left_out += sum(map(len, gone))
            self.take_back(gone[0].start, gone[-1].stop)

    def finish(self) -> None:
        """Write the file's end; one without an exposure is removed.

        Raises
        ------
        OutputError
            If the disk is full or refuses; says how much is safe.
        """
        try:
            self.close()
        finally:
            if not self.status().n_written:
                self.path.unlink(missing_ok=True)


class LiveScan:
    """One scan of a session: the live session, its recording, and what a page shows of them.

    Parameters
    ----------
    path
        Of the recording, ``.mcap``; must not exist.
    scanner
        Places points; None only to show images and record.
    seeing
        How lines are seen; None for what the rig's description says.

    Raises
    ------
    ArmscanError
        If the rig has not what the scanner needs, or a camera does not take its settings.
    """

    def __init__(
        self,
        bench: Bench,
        step: StepName,
        path: Path,
        scanner: ScannerCalibration | None,
        seeing: SeeingSettings | None = None,
    ) -> None:
        self.bench, self.step, self.path = bench, step, path
        self.rig = bench.scan_rig(step)
        self.recorder = ScanRecorder(path, self.rig, keeps_times=bench.has_operator)
        self.events: deque[LiveEvent] = deque(maxlen=50)
        self._scanner = scanner
        self._incidence = Incidence()
        self._drift: tuple[int, float | None] = -1, None
        self._before: SetAside | None = None
        self.session = LiveSession(
            self.rig,
            scanner,
            options=(seeing or SeeingSettings.of(self.rig.description)).options,
            recorder=self.recorder,
        )
        self.session.add_listener(self._hear)

    def open(self) -> None:
        """Start the devices, and make the file; nothing is recorded yet.

        What lay at its place is set aside until `stop`: it comes back where no image came.

        Raises
        ------
        ArmscanError
            If a device does not answer, or the file cannot be made; nothing runs then.
        """
        self.session.open()
        try:
            self._wait_for_clocks()
            make_folder(self.path.parent, with_parents=True)
            settle_aside(self.path)
            self._before = set_aside(self.path, is_overwriting=True)
            self.recorder.begin()
        except BaseException:
            self.session.stop()
            self._settle()
            raise
        self.session.add_listener(self.recorder.hear)

    def start(self) -> None:
        """Begin, or go on after a pause, with a new pass; raises as `open`, which it may call."""
        if self.snapshot.state == "closed":
            self.open()
        self.session.start()
        self.bench.hold(False)

    def _wait_for_clocks(self) -> None:
        end = time.monotonic() + CLOCKS_S
        while not self.is_timed and time.monotonic() < end:
            time.sleep(CLOCKS_S / 100.0)

    @property
    def is_timed(self) -> bool:
        """Whether what is recorded now can be placed: by ids, or by clocks that are known."""
        is_by_time = self.rig.arm is not None and not self.rig.description.is_common_trigger
        return not is_by_time or self.session.is_timed

    def pause(self) -> None:
        """Record nothing until `start`."""
        self.bench.hold(True)
        self.session.pause()

    def undo_pass(self) -> None:
        """Take the last pass out of the cloud and out of the recording's list."""
        self.recorder.leave_out(self.session.undo_pass())

    def clear(self) -> None:
        """Take all that was recorded out."""
        self.recorder.leave_out(self.session.clear())

    def stop(self) -> None:
        """End the scan; the recording is whole.

        Raises
        ------
        OutputError
            If the disk was full or refused; says how much is safe. All else has ended then.
        DeviceError
            If no image came.
        """
        self.bench.hold(True)
        self.session.stop()
        try:
            self.recorder.finish()
        finally:
            self._settle()
        if not self.recorder.n_exposures:
            raise DeviceError(
                "no image came", remedy="check camera and trigger; what was there before stays"
            )

    def _settle(self) -> None:
        before, self._before = self._before, None
        if before is not None and self.path.exists():
            before.remove()
        elif before is not None:
            bring_back(before, self.path)

    @property
    def snapshot(self) -> LiveSnapshot:
        """What there is to show now."""
        return self.session.snapshot()

    @property
    def n_recorded(self) -> int:
        """Exposures in the recording that were not taken back."""
        return self.recorder.n_exposures - self.recorder.n_left_out

    def drift_mm(self) -> float | None:
        """Median distance of the last pass from the surface of the earlier ones, where they meet.

        None where they do not.
        """
        version = self.snapshot.cloud_version
        if self._drift[0] != version:
            cloud = self.session.cloud()
            last = cloud.exposure >= self.session.last_pass_start
            self._drift = version, passes_apart_mm(cloud.points_mm[~last], cloud.points_mm[last])
        return self._drift[1]

    def incidence_deg(self, cloud: ShownCloud) -> FloatArray:
        """(N,) angle between surface and line of sight; nan where it is not known."""
        hand_eye = None if self._scanner is None else self._scanner.hand_eye
        seen_from: dict[int, FloatArray] = {}
        for number in np.unique(cloud.exposure).tolist():
            pose = self.recorder.pose_of.get(number)
            if pose is not None and hand_eye is not None:
                seen_from[number] = (pose @ hand_eye.tool_from_sensor).translation_mm
        return self._incidence.angles_deg(cloud, seen_from)

    def arm_mm(self, base_from_tool: Pose[Base, Tool]) -> FloatArray:
        """(K, 3) from the arm's base along its axes to the tool; where they are not known, two."""
        joints, model = self.recorder.latest_joints_rad, self.rig.arm_model
        ends = [np.zeros(3), base_from_tool.translation_mm]
        if joints is None or model is None or not np.isfinite(joints).all():
            return np.array(ends)
        return np.array([*axis_frames(model, joints).origins_mm[0], ends[1]])

    def _hear(self, event: LiveEvent) -> None:
        is_of_device = bool(event.device) and event.device not in OWN_PARTS
        # what does not answer is told while it lasts, and a simulated hand waits for its images
        is_told = is_of_device and (event.kind != "warning" or self.bench.has_operator)
        if event.kind == "button":
            # one that was pressed while the devices start would pause what has just begun
            is_told = self.snapshot.state not in ("scanning", "paused")
        if not is_told:
            self.events.append(event)
