# SPDX-License-Identifier: Apache-2.0
"""Frames, laser events and arm samples that belong to one instant, and its pose.

A trigger id decides where both have one. Else each device's time is brought to this computer's
clock by the model of its own clock, and the pose is interpolated as it is in a recording, by the
same function and the same limits. What is not known is left open, with the reason.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from armscan.devices.clocks import LARGEST_DRIFT, ElementStatus, StreamMonitor
from armscan.devices.protocols import ArmFlag, ArmSample, Frame, LaserEvent
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.arm import ArmModel, forward
from armscan.reconstruction.sync import PoseStatus, bridged_ns, poses_at
from armscan.records.recording import ArmTrack

T = TypeVar("T")

PATIENCE_NS = 500_000_000
"""An instant waits so long after its last frame for what belongs to it, then goes without."""
TRACK_NS = 60_000_000_000
"""Samples of the arm are kept so long: frames lie behind where a disk keeps all waiting."""
USUAL_STEPS = 256
"""The arm's usual step is the median of its last ones."""
REMEMBERED_NS = TRACK_NS
"""And what was told of a trigger."""
LASER_BOUND_NS = 50_000_000
"""Without trigger ids a frame may be so much later than its laser event: transport delays differ.
Its lasers are known only if all events that near agree."""
SAME_TRIGGER_NS = 100_000_000
"""What bears one trigger id was taken within this, by the devices' own clocks: another count, of
before a device began to count anew, has the same ids."""
SAME_COUNT_NS = 500_000_000
"""And within this by clocks that were related by arrivals, on a computer that may be overloaded."""
ARRIVED_TOGETHER_NS = 2_000_000_000
"""And arrived within this, while nothing else is known: no count ends so soon after its start."""
SAME_INSTANT = 0.25
"""Frames of two cameras without ids are of one instant within this part of the usual step."""


@dataclass(frozen=True, slots=True, eq=False)
class TimedSample:
    """A sample of the arm with its time on this computer's clock.

    Parameters
    ----------
    sample
        As delivered.
    t_ns
        None where the sample cannot be used or the arm's clock is not determined.
    status
        Whether it can be used.
    pose
        ``base_from_tool``; None where the arm gave none that is valid.
    """

    sample: ArmSample
    t_ns: int | None
    status: ElementStatus
    pose: Pose[Base, Tool] | None


@dataclass(frozen=True, slots=True, eq=False)
class MatchedInstant:
    """What belongs to one moment.

    Parameters
    ----------
    frames
        One a camera, in their order; None for a camera that delivered none.
    t_ns
        Middle of the exposure on this computer's clock; None where it is not known.
    lasers
        Sources that were on; None where it is not known.
    trigger_id
        As the frames bear it, or None.
    pose
        ``base_from_tool``; None where it is not known.
    status
        Why not.
    number
        How many instants the matcher handed out before it.
    are_lasers_mixed
        True where its lasers are not known because events so near in time name several.
    times_ns
        As ``t_ns``, of each camera by its own clock; empty where nobody told.
    """

    frames: tuple[Frame | None, ...]
    t_ns: int | None
    lasers: tuple[str, ...] | None
    trigger_id: int | None
    pose: Pose[Base, Tool] | None
    status: PoseStatus
    number: int = 0
    are_lasers_mixed: bool = False
    times_ns: tuple[int | None, ...] = ()

    @property
    def has_sample(self) -> bool:
        """Where ids decide: whether a sample of the arm is of its trigger, with a pose or none."""
        return self.status in (PoseStatus.FOUND, PoseStatus.UNKNOWN_SAMPLE)


@dataclass(slots=True)
class _Open:
    """An instant that is not complete yet."""

    frames: list[Frame | None]
    t_ns: int | None
    trigger_id: int | None
    is_passed: list[bool] = field(default_factory=list)
    times_ns: list[int | None] = field(default_factory=list)
    is_timed: bool = True

    @property
    def newest_host_ns(self) -> int:
        return max(frame.t_host_ns for frame in self.frames if frame is not None)


@dataclass(frozen=True, slots=True)
class _Told(Generic[T]):
    """What was told of a trigger, and when: by the common clock, the device's, and on arrival."""

    value: T
    t_ns: int | None
    t_device_ns: int
    t_host_ns: int


class InstantMatcher:
    """Brings the streams of a rig together while they come in; called from one thread.

    Parameters
    ----------
    n_cameras
        Cameras of the head.
    is_triggered
        True if frames and samples of the arm bear ids of common triggers: ids alone then decide.
    has_arm, has_controller
        Whether to wait for samples and laser events.
    latency_ns
        Added to an exposure's time before the pose is looked up: `ScannerCalibration.latency_ns`.
    arm
        Turns joint angles into poses, for an arm that delivers those alone.

    Attributes
    ----------
    cameras, arm, controller
        Monitors of the streams, with their counts and clocks.
    """

    def __init__(
        self,
        n_cameras: int = 1,
        *,
        is_triggered: bool = False,
        has_arm: bool = True,
        has_controller: bool = True,
        latency_ns: int = 0,
        arm: ArmModel | None = None,
    ) -> None:
        self.cameras = tuple(StreamMonitor() for _ in range(n_cameras))
        self.arm = StreamMonitor()
        self.controller = StreamMonitor()
        self.latency_ns = latency_ns
        self._is_triggered = is_triggered
        self._has_arm = has_arm
        self._has_controller = has_controller
        self._model = arm
        self._open: deque[_Open] = deque()
        self._times: list[int] = []
        self._poses: list[Pose[Base, Tool] | None] = []
        self._steps: deque[int] = deque(maxlen=USUAL_STEPS)
        self._pose_of: dict[int, _Told[Pose[Base, Tool] | None]] = {}
        self._lasers_of: dict[int, _Told[tuple[str, ...]]] = {}
        self._apart_ns: dict[tuple[int, int], tuple[int, int]] = {}
        self._events: deque[tuple[int, tuple[str, ...]]] = deque(maxlen=USUAL_STEPS)
        self._frame_step_ns = 0.0
        self._n_taken = 0
        self._last_ns: list[int | None] = [None] * n_cameras

    def add_samples(self, samples: tuple[ArmSample, ...]) -> tuple[TimedSample, ...]:
        """Take samples of the arm in the order of arrival; each comes back with its time."""
        return tuple(self._add_sample(sample) for sample in samples)

    def add_events(self, events: tuple[LaserEvent, ...]) -> None:
        """Take laser events in the order of arrival."""
        for event in events:
            times = (event.t_device_ns, event.t_host_ns)
            status = self.controller.check(event.trigger_id, *times)
            if status in _SEEN_BEFORE:
                continue
            self._forget_apart(status)
            t_ns = _common_ns(self.controller, event.t_device_ns)
            _remember(self._lasers_of, event.trigger_id, _Told(event.lasers, t_ns, *times))
            if t_ns is not None:
                self._events.append((t_ns, event.lasers))

    def add_frame(self, frame: Frame, camera: int = 0) -> ElementStatus:
        """Take a frame in the order of arrival.

        One that came twice, or after a newer one, makes no instant; one whose time is doubtful
        makes an instant without time.
        """
        monitor = self.cameras[camera]
        # a frame is sent when its exposure is over, however long that was
        end_ns = frame.t_device_ns + frame.exposure_ns // 2
        status = monitor.check(frame.number, end_ns, frame.t_host_ns, is_timed=frame.is_timed)
        if status in _SEEN_BEFORE:
            return status
        self._forget_apart(status)
        is_known = frame.is_timed and status == ElementStatus.USABLE
        t_ns = _common_ns(monitor, frame.t_device_ns) if is_known else None
        self._learn_step(camera, t_ns)
        partner = self._partner(frame, camera, t_ns)
        if partner is None:
            frames: list[Frame | None] = [None] * len(self.cameras)
            n = len(frames)
            partner = _Open(frames, t_ns, frame.trigger_id, [False] * n, [None] * n)
            self._open.append(partner)
        partner.frames[camera], partner.times_ns[camera] = frame, t_ns
        # where one frame's middle is not sure, the other's time is not that of both
        partner.is_timed &= frame.is_timed
        if t_ns is not None and (camera == 0 or partner.t_ns is None):
            partner.t_ns = t_ns
        if not partner.is_timed:
            partner.t_ns = None
        for earlier in self._open:
            if earlier is partner:
                break
            earlier.is_passed[camera] = True
        return status

    def take(self, now_ns: int) -> tuple[MatchedInstant, ...]:
        """Instants that are complete, or have waited long enough, in the order of their frames.

        All that arrived before ``now_ns``, by this computer's monotonic clock, was added.
        """
        done: list[MatchedInstant] = []
        while self._open:
            first = self._open[0]
            if not self._is_complete(first) and now_ns - first.newest_host_ns <= PATIENCE_NS:
                break
            self._open.popleft()
            pose, status = self._pose(first)
            lasers, are_mixed = self._lasers(first)
            done.append(
                MatchedInstant(
                    frames=tuple(first.frames),
                    t_ns=first.t_ns,
                    lasers=lasers,
                    trigger_id=first.trigger_id,
                    pose=pose,
                    status=status,
                    number=self._n_taken,
                    are_lasers_mixed=are_mixed,
                    times_ns=tuple(first.times_ns) if first.is_timed else (),
                )
            )
            self._n_taken += 1
        return tuple(done)

    def _add_sample(self, sample: ArmSample) -> TimedSample:
        status = self.arm.check(sample.number, sample.t_device_ns, sample.t_host_ns)
        pose = self._valid_pose(sample)
        if status in _SEEN_BEFORE:
            return TimedSample(sample, None, status, pose)
        self.arm.counts.n_inaccurate += ArmFlag.INACCURATE in sample.flags
        self.arm.counts.n_end_stop += ArmFlag.END_STOP in sample.flags
        self._forget_apart(status)
        t_ns = None
        if status == ElementStatus.USABLE:
            t_ns = _common_ns(self.arm, sample.t_device_ns)
        if sample.trigger_id is not None:
            times = sample.t_device_ns, sample.t_host_ns
            _remember(self._pose_of, sample.trigger_id, _Told(pose, t_ns, *times))
        if t_ns is None or (self._times and t_ns <= self._times[-1]):
            return TimedSample(sample, None, status, pose)
        if self._times:
            self._steps.append(t_ns - self._times[-1])
        self._times.append(t_ns)
        self._poses.append(pose)
        old = bisect_right(self._times, t_ns - TRACK_NS)
        if old > len(self._times) // 2:
            del self._times[:old], self._poses[:old]
        return TimedSample(sample, t_ns, status, pose)

    def _valid_pose(self, sample: ArmSample) -> Pose[Base, Tool] | None:
        if not sample.is_valid:
            return None
        if sample.pose is not None or sample.joints_rad is None or self._model is None:
            return sample.pose
        rotations, translations = forward(self._model, sample.joints_rad[None])
        return Pose(rotations[0], translations[0])

    def _learn_step(self, camera: int, t_ns: int | None) -> None:
        last = self._last_ns[camera]
        self._last_ns[camera] = t_ns
        if last is not None and t_ns is not None:
            step = float(t_ns - last)
            usual = self._frame_step_ns
            self._frame_step_ns = step if usual == 0.0 else usual + 0.05 * (step - usual)

    def _partner(self, frame: Frame, camera: int, t_ns: int | None) -> _Open | None:
        for one in self._open:
            if one.frames[camera] is not None:
                continue
            if frame.trigger_id is not None and one.trigger_id is not None:
                is_same = frame.trigger_id == one.trigger_id
                if t_ns is not None and one.t_ns is not None:
                    is_same = is_same and abs(t_ns - one.t_ns) <= SAME_COUNT_NS
            elif t_ns is not None and one.t_ns is not None:
                is_same = abs(t_ns - one.t_ns) <= SAME_INSTANT * self._frame_step_ns
            else:
                is_same = False
            if is_same:
                return one
        return None

    def _is_complete(self, one: _Open) -> bool:
        there = zip(one.frames, one.is_passed, strict=True)
        if not all(frame is not None or passed for frame, passed in there):
            return False
        return self._has_lasers(one) and self._has_track(one)

    def _told(self, of_trigger: dict[int, _Told[T]], one: _Open) -> _Told[T] | None:
        """What was told of an instant's trigger; None for what bears its id from another count.

        By how far the two devices' own clocks were apart at the trigger before, which no delay of
        this computer changes; else by the common clock; else by arrival.
        """
        found = None if one.trigger_id is None else of_trigger.get(one.trigger_id)
        if found is None:
            return None
        camera, frame = next((k, f) for k, f in enumerate(one.frames) if f is not None)
        pair, apart_ns = (id(of_trigger), camera), frame.t_device_ns - found.t_device_ns
        if pair in self._apart_ns:
            before_ns, then_ns = self._apart_ns[pair]
            drifted_ns = 2.0 * LARGEST_DRIFT * abs(frame.t_device_ns - then_ns)
            is_same = abs(apart_ns - before_ns) <= SAME_TRIGGER_NS + drifted_ns
        elif one.t_ns is not None and found.t_ns is not None:
            is_same = abs(one.t_ns - found.t_ns) <= SAME_COUNT_NS
        else:
            is_same = abs(one.newest_host_ns - found.t_host_ns) <= ARRIVED_TOGETHER_NS
        if is_same:
            self._apart_ns[pair] = apart_ns, frame.t_device_ns
        return found if is_same else None

    def _is_told(self, of_trigger: dict[int, _Told[T]], one: _Open) -> bool:
        """Whether an instant's trigger, or one after it, was told of: nothing more is to come."""
        if self._told(of_trigger, one) is not None:
            return True
        if not of_trigger or one.trigger_id is None:
            return False
        last = next(reversed(of_trigger))
        # what arrived long before belongs to another count
        is_current = of_trigger[last].t_host_ns >= one.newest_host_ns - PATIENCE_NS
        return last > one.trigger_id and is_current

    def _forget_apart(self, status: ElementStatus) -> None:
        if status == ElementStatus.JUMP:
            self._apart_ns.clear()

    def _has_lasers(self, one: _Open) -> bool:
        if not self._has_controller:
            return True
        if one.trigger_id is not None:
            return self._is_told(self._lasers_of, one)
        if one.t_ns is None:
            return True
        return bool(self._events) and self._events[-1][0] > one.t_ns + LASER_BOUND_NS

    def _has_track(self, one: _Open) -> bool:
        if not self._has_arm:
            return True
        if self._is_triggered:
            return one.trigger_id is None or self._is_told(self._pose_of, one)
        if one.t_ns is None:
            return True
        return bool(self._times) and self._times[-1] >= one.t_ns + self.latency_ns

    def _lasers(self, one: _Open) -> tuple[tuple[str, ...] | None, bool]:
        """What was on, None where it is not known, and whether that is because several were."""
        told = {frame.lasers for frame in one.frames if frame is not None} - {None}
        if len(told) == 1:
            return told.pop(), False
        if one.trigger_id is not None and self._has_controller:
            switched = self._told(self._lasers_of, one)
            return None if switched is None else switched.value, False
        if one.t_ns is None:
            return None, False
        near = {on for t_ns, on in self._events if abs(t_ns - one.t_ns) <= LASER_BOUND_NS}
        return near.pop() if len(near) == 1 else None, len(near) > 1

    def _pose(self, one: _Open) -> tuple[Pose[Base, Tool] | None, PoseStatus]:
        if self._is_triggered:
            if one.trigger_id is None:
                return None, PoseStatus.NO_TRIGGER
            latched = self._told(self._pose_of, one)
            if latched is None:
                return None, PoseStatus.UNKNOWN_TRIGGER
            pose = latched.value
            return pose, PoseStatus.UNKNOWN_SAMPLE if pose is None else PoseStatus.FOUND
        if one.t_ns is None:
            return None, PoseStatus.NO_TIME
        if not self._times:
            return None, PoseStatus.BEFORE_TRACK
        k = bisect_right(self._times, one.t_ns + self.latency_ns)
        piece = slice(max(k - 2, 0), k + 2)
        track = arm_track(self._times[piece], self._poses[piece])
        limit = bridged_ns(np.array(self._steps, dtype=np.int64)) if self._steps else 0
        time = np.array([one.t_ns + self.latency_ns], dtype=np.int64)
        found = poses_at(time, track, max_gap_ns=limit)
        status = PoseStatus(int(found.status[0]))
        return (found.pose(0) if status == PoseStatus.FOUND else None), status


_SEEN_BEFORE = (ElementStatus.DUPLICATE, ElementStatus.LATE)


def arm_track(times_ns: list[int], poses: list[Pose[Base, Tool] | None]) -> ArmTrack:
    """A track of N times and poses; None is a gap."""
    n = len(times_ns)
    rotations, translations = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    for k, pose in enumerate(poses):
        if pose is not None:
            rotations[k], translations[k] = pose.rotation, pose.translation_mm
    return ArmTrack(
        t_ns=np.array(times_ns, dtype=np.int64),
        rotations=rotations,
        translations_mm=translations,
        is_known=np.array([pose is not None for pose in poses], dtype=np.bool_),
    )


def _common_ns(monitor: StreamMonitor, t_device_ns: int) -> int | None:
    """Time on this computer's clock; None where it cannot be told."""
    if monitor.clock.missing(t_device_ns):
        return None
    return monitor.clock.to_other_ns(t_device_ns)


def _remember(of_trigger: dict[int, _Told[T]], trigger_id: int, value: _Told[T]) -> None:
    """Keep the last triggers only; a count that began anew forgets the old ones."""
    # by arrival: a device's own clock may jump
    if of_trigger and trigger_id < next(reversed(of_trigger)):
        of_trigger.clear()
    of_trigger[trigger_id] = value
    while of_trigger[first := next(iter(of_trigger))].t_host_ns < value.t_host_ns - REMEMBERED_NS:
        del of_trigger[first]
