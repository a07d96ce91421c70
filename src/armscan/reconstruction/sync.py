# SPDX-License-Identifier: Apache-2.0
"""The arm's pose at each exposure, why some have none, and poses that stood still."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import EstimationError, InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, floats, ints
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import slerp
from armscan.reconstruction.track_faults import TrackFault, check_track
from armscan.records.cloud import PointCloud
from armscan.records.recording import (
    NO_TRIGGER,
    UNTRIGGERED,
    ArmTrack,
    Clock,
    ExposureRow,
)

PoseSource = Literal["trigger", "time", "given"]


class PoseStatus(IntEnum):
    """Whether an exposure has a pose, and if not, why."""

    FOUND = 0
    NO_TRIGGER = 1
    """The exposure bears no trigger id, while poses are found by id."""
    UNKNOWN_TRIGGER = 2
    """No sample of the arm bears its trigger id."""
    UNKNOWN_SAMPLE = 3
    """The arm gave no pose for that trigger or time."""
    BEFORE_TRACK = 4
    """Earlier than the arm's first sample."""
    AFTER_TRACK = 5
    """Later than the arm's last sample."""
    GAP = 6
    """Between two samples too far apart, or next to one without pose."""
    CONTRADICTED = 7
    """At samples that the arm's own track shows to be wrong."""
    NO_TIME = 8
    """Its time on the common clock is not known: the device's clock is not related to it yet, or
    jumped."""

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _LABELS[self]


_LABELS = {
    PoseStatus.FOUND: "pose found",
    PoseStatus.NO_TRIGGER: "without trigger id",
    PoseStatus.UNKNOWN_TRIGGER: "with a trigger id that the arm does not know",
    PoseStatus.UNKNOWN_SAMPLE: "at samples for which the arm gave no pose",
    PoseStatus.BEFORE_TRACK: "before the arm's first sample",
    PoseStatus.AFTER_TRACK: "after the arm's last sample",
    PoseStatus.GAP: "in a gap of the arm's samples",
    PoseStatus.CONTRADICTED: "at samples that the arm's own track shows to be wrong",
    PoseStatus.NO_TIME: "whose clock was not related to the arm's",
}


class ExposurePoses(RowRecord):
    """``base_from_tool`` for each of N exposures, those without pose included.

    Parameters
    ----------
    rotations, translations_mm
        (N, 3, 3) and (N, 3); unit and zero where there is no pose.
    status
        (N,) `PoseStatus`.
    sample
        (N,) row of the arm's track that gave the pose, or the one before it; -1 for none.
    source
        Whether poses were found by trigger id, by time, or given one by one.
    max_gap_ns
        Widest step between samples that was bridged; 0 unless by time.
    warnings
        What is weak, in words.
    track_faults
        What the arm's track says against itself.
    """

    rotations: FloatArray = floats("N", 3, 3)
    translations_mm: FloatArray = floats("N", 3)
    status: IntArray = ints("N")
    sample: IntArray = ints("N")
    source: PoseSource
    max_gap_ns: int = 0
    warnings: tuple[str, ...] = ()
    track_faults: tuple[TrackFault, ...] = ()

    @property
    def has_pose(self) -> BoolArray:
        """(N,) True where the pose is known."""
        return np.asarray(self.status == PoseStatus.FOUND)

    def count(self, status: PoseStatus) -> int:
        """Count of exposures of this status."""
        return int((self.status == status).sum())

    @property
    def missing(self) -> str:
        """How many exposures have no pose, and why; empty if all have one."""
        parts = [
            f"{self.count(status)} {status.label}"
            for status in PoseStatus
            if status is not PoseStatus.FOUND and self.count(status)
        ]
        return ", ".join(parts)

    @property
    def how(self) -> str:
        """How poses were found, in words."""
        if self.source != "time":
            return "by trigger id" if self.source == "trigger" else "one for each, in order"
        return f"by time, between samples up to {self.max_gap_ns / 1e6:g} ms apart"

    def pose(self, row: int) -> Pose[Base, Tool]:
        """Pose of one exposure.

        Raises
        ------
        InputError
            If it has none.
        """
        status = PoseStatus(int(self.status[row]))
        if status is not PoseStatus.FOUND:
            raise InputError(f"exposure {row} has no pose: {status.label}")
        return Pose(self.rotations[row], self.translations_mm[row])


GAP_PERIODS = 3
"""Steps between samples up to this many median periods are bridged."""
LARGEST_GAP_NS = 500_000_000
"""And never longer ones: an arm that gives a pose now and then may have gone anywhere between."""
LISTED_FAULTS = 3
"""Faults of a track that are told one by one."""
BEND_MM = 0.02
"""Interpolation errors of this size in the tool's place are warned of: an arm's own scatter."""


def exposure_poses(
    rows: Sequence[ExposureRow],
    arm: ArmTrack | None,
    clock: Clock = "shared",
    latency_ns: int = 0,
) -> ExposurePoses:
    """Find ``base_from_tool`` of each exposure; a pose that is not known is never guessed.

    The arm's track is checked by itself (`armscan.reconstruction.track_faults`): exposures at
    samples that cannot be right get no pose.

    Trigger ids decide if exposures and samples have them. Else the pose is interpolated in time
    between two neighbouring known samples: the rotation by SLERP, the place along a straight line.
    An exposure that was to have an id and has none gets no pose: its time may only order.

    Parameters
    ----------
    rows
        The exposures.
    arm
        The arm's samples.
    clock
        ``shared`` if both bear times of one clock, ``related`` if they were brought to one.
    latency_ns
        Added to an exposure's time before the pose is looked up by time.

    Raises
    ------
    InputError
        If there is no arm, two samples share a trigger id, or there are neither ids nor a shared
        clock.
    EstimationError
        If no exposure has a pose.
    """
    if arm is None or len(arm) == 0:
        raise InputError(
            "the scan has no samples of the arm", remedy="record the arm's poses in arm.csv"
        )
    has_ids = arm.trigger_ids is not None and bool((arm.trigger_ids != NO_TRIGGER).any())
    has_row_ids = any(row.trigger_id is not None for row in rows)
    if has_ids and has_row_ids:
        poses = _by_trigger(rows, arm, clock, latency_ns)
    elif clock != "separate":
        poses = _without_untriggered(poses_by_time(rows, arm, latency_ns), rows)
    elif any(row.trigger_id is not None or UNTRIGGERED in row.flags for row in rows):
        lacking = "sample of the arm" if has_row_ids else "exposure"
        raise InputError(
            f"no {lacking} bears a trigger id, and poses were to be found by ids alone",
            remedy="let cameras and arm tell the number of their common trigger, or, where there "
            "is none, record without is_common_trigger (--common-trigger)",
        )
    else:
        raise InputError(
            "exposures and arm samples have separate clocks and no trigger ids in common",
            remedy="record trigger_id in both tables, or times of one clock "
            'and then clock = "shared"; `armscan calibrate latency` tells offset and drift',
        )
    poses = _without_contradicted(poses, rows, arm, latency_ns)
    if not poses.has_pose.any():
        raise EstimationError(
            f"none of {len(rows)} exposures has a pose: {poses.missing or 'there are none'}"
            f"{_spans(rows, arm) if poses.source == 'time' else ''}",
            remedy="check the times and trigger ids of exposures and arm samples",
        )
    return poses


def _without_untriggered(poses: ExposurePoses, rows: Sequence[ExposureRow]) -> ExposurePoses:
    """Take the pose from exposures whose time was never meant to place them."""
    is_without = np.array([UNTRIGGERED in row.flags for row in rows], dtype=np.bool_)
    return _taken_from(poses, is_without, PoseStatus.NO_TRIGGER) if is_without.any() else poses


def _taken_from(poses: ExposurePoses, is_taken: BoolArray, status: PoseStatus) -> ExposurePoses:
    """Poses without those of some exposures (N,)."""
    return replace(
        poses,
        rotations=np.where(is_taken[:, None, None], np.eye(3), poses.rotations),
        translations_mm=np.where(is_taken[:, None], 0.0, poses.translations_mm),
        status=np.where(is_taken, status, poses.status),
        sample=np.where(is_taken, -1, poses.sample),
    )


def _without_contradicted(
    poses: ExposurePoses, rows: Sequence[ExposureRow], arm: ArmTrack, latency_ns: int
) -> ExposurePoses:
    """Take the pose from exposures at samples that the track itself shows to be wrong."""
    check = check_track(arm)
    if not check.faults:
        return poses
    sample = np.maximum(poses.sample, 0)
    is_wrong = check.is_faulty[sample]
    if poses.source == "time":
        times = np.array([row.t_ns for row in rows], dtype=np.int64) + latency_ns
        after = np.minimum(sample + 1, len(arm) - 1)
        is_between = times > arm.t_ns[sample]
        is_wrong |= is_between & (check.is_faulty[after] | check.is_broken_step[sample])
    is_wrong &= poses.has_pose
    named = [fault.words for fault in check.faults[:LISTED_FAULTS]]
    if len(check.faults) > LISTED_FAULTS:
        named.append(f"and {len(check.faults) - LISTED_FAULTS} more of this kind")
    warnings = [*poses.warnings, "; ".join(named)]
    if check.jumps:
        warnings.append(
            "a jump shifts all that was scanned before it against all that was scanned after it, "
            "and the track does not tell which of the two is right: scan again"
        )
    return replace(
        _taken_from(poses, is_wrong, PoseStatus.CONTRADICTED),
        warnings=tuple(warnings),
        track_faults=check.faults,
    )


def largest_gap_ns(arm: ArmTrack) -> int:
    """Widest step between samples that is bridged; 0 if the track has one sample only."""
    if len(arm) < 2:
        return 0
    return bridged_ns(np.diff(arm.t_ns))


def bridged_ns(steps_ns: IntArray) -> int:
    """Widest step that is bridged, by the usual steps (N,) of a track."""
    return int(min(GAP_PERIODS * float(np.median(steps_ns)), LARGEST_GAP_NS))


def _by_trigger(
    rows: Sequence[ExposureRow], arm: ArmTrack, clock: Clock, latency_ns: int
) -> ExposurePoses:
    ids = np.full(len(arm), NO_TRIGGER) if arm.trigger_ids is None else arm.trigger_ids
    sample_of: dict[int, int] = {}
    for sample in np.flatnonzero(ids != NO_TRIGGER):
        if int(ids[sample]) in sample_of:
            raise InputError(
                f"two samples of the arm bear the trigger id {ids[sample]}",
                remedy="each trigger must have one sample",
            )
        sample_of[int(ids[sample])] = int(sample)
    status = np.full(len(rows), int(PoseStatus.NO_TRIGGER))
    found = np.full(len(rows), -1)
    for k, row in enumerate(rows):
        if row.trigger_id is None or row.trigger_id == NO_TRIGGER:
            continue
        found[k] = sample_of.get(row.trigger_id, -1)
        status[k] = PoseStatus.UNKNOWN_TRIGGER
        if found[k] >= 0:
            is_known = arm.is_known[found[k]]
            status[k] = PoseStatus.FOUND if is_known else PoseStatus.UNKNOWN_SAMPLE
    rotations, translations = _at_samples(arm, found, status)
    return ExposurePoses(
        rotations=rotations,
        translations_mm=translations,
        status=status,
        sample=found,
        source="trigger",
        warnings=_times_apart(rows, arm, found, latency_ns) if clock == "shared" else (),
    )


def _times_apart(
    rows: Sequence[ExposureRow], arm: ArmTrack, found: IntArray, latency_ns: int
) -> tuple[str, ...]:
    """Ids and times of one clock must tell the same story; swapped or shifted ids do not."""
    limit = largest_gap_ns(arm)
    times = np.array([row.t_ns for row in rows], dtype=np.int64) + latency_ns
    apart = np.abs(times - arm.t_ns[found])[found >= 0]
    n_far = int((apart > limit).sum()) if limit else 0
    if not n_far:
        return ()
    return (
        f"{n_far} exposures lie up to {apart.max() / 1e6:.1f} ms from the arm sample of their "
        "trigger id, though the clock is said to be shared: check the ids and the clock",
    )


def _at_samples(arm: ArmTrack, found: IntArray, status: IntArray) -> tuple[FloatArray, FloatArray]:
    rotations, translations = np.tile(np.eye(3), (len(found), 1, 1)), np.zeros((len(found), 3))
    has_pose = status == PoseStatus.FOUND
    rotations[has_pose] = arm.rotations[found[has_pose]]
    translations[has_pose] = arm.translations_mm[found[has_pose]]
    return rotations, translations


def poses_by_time(rows: Sequence[ExposureRow], arm: ArmTrack, latency_ns: int = 0) -> ExposurePoses:
    """Poses by times of one clock alone, whatever trigger ids there are; see `exposure_poses`."""
    return poses_at(np.array([row.t_ns for row in rows], dtype=np.int64) + latency_ns, arm)


def poses_at(times: IntArray, arm: ArmTrack, *, max_gap_ns: int | None = None) -> ExposurePoses:
    """Poses at times (N,) of the arm's clock in ns; see `exposure_poses`.

    ``max_gap_ns`` is the widest step that is bridged; None takes it from the track, which must
    then be longer than the piece around an exposure that a live rig asks for.
    """
    max_gap = largest_gap_ns(arm) if max_gap_ns is None else max_gap_ns
    before = np.searchsorted(arm.t_ns, times, side="right") - 1
    after = np.minimum(before + 1, len(arm) - 1)
    start = np.maximum(before, 0)
    is_exact = (before >= 0) & (arm.t_ns[start] == times)
    step = arm.t_ns[after] - arm.t_ns[start]
    is_bridged = arm.is_known[start] & arm.is_known[after] & (step > 0) & (step <= max_gap)
    status = np.where(is_bridged, PoseStatus.FOUND, PoseStatus.GAP)
    status[before < 0] = PoseStatus.BEFORE_TRACK
    status[times > arm.t_ns[-1]] = PoseStatus.AFTER_TRACK
    at_sample = np.where(arm.is_known[start], PoseStatus.FOUND, PoseStatus.UNKNOWN_SAMPLE)
    status[is_exact] = at_sample[is_exact]
    rotations, translations = _at_samples(arm, start, status)
    between = np.flatnonzero((status == PoseStatus.FOUND) & ~is_exact)
    low, high = start[between], after[between]
    fraction = (times[between] - arm.t_ns[low]) / step[between]
    rotations[between] = slerp(arm.rotations[low], arm.rotations[high], fraction)
    path = arm.translations_mm[high] - arm.translations_mm[low]
    translations[between] = arm.translations_mm[low] + fraction[:, None] * path
    return ExposurePoses(
        rotations=rotations,
        translations_mm=translations,
        status=status,
        sample=np.where(status == PoseStatus.FOUND, start, -1),
        source="time",
        max_gap_ns=max_gap,
        warnings=_bend_warning(arm, low, fraction),
    )


def _bend_warning(arm: ArmTrack, low: IntArray, fraction: FloatArray) -> tuple[str, ...]:
    """How far the tool strays from the straight line between samples, from its acceleration."""
    error = interpolation_error_mm(arm, low, fraction)
    n_bent = int((error > BEND_MM).sum())
    if not n_bent:
        return ()
    return (
        f"between its samples the tool strays up to {error.max():.2g} mm from a straight line "
        f"({n_bent} exposures by more than {BEND_MM} mm): sample the arm more often, or by trigger",
    )


def interpolation_error_mm(arm: ArmTrack, low: IntArray, fraction: FloatArray) -> FloatArray:
    """Estimate what linear interpolation of the place leaves out.

    The line between two samples misses a path of acceleration a by ``f (1 - f) a T^2 / 2``; the
    acceleration is that of the four samples around it.

    Parameters
    ----------
    arm
        The track.
    low
        (N,) sample before each exposure.
    fraction
        (N,) part of the step to the next sample.

    Returns
    -------
    FloatArray
        (N,) in mm; 0 where the samples around it are not known.
    """
    first, last = low - 1, low + 2
    inside = (first >= 0) & (last < len(arm))
    first, last = np.maximum(first, 0), np.minimum(last, len(arm) - 1)
    inside &= arm.is_known[first] & arm.is_known[last]
    seconds = (arm.t_ns - arm.t_ns[0]) * 1e-9
    place = arm.translations_mm

    def velocity(a: IntArray, b: IntArray) -> FloatArray:
        step = np.maximum(seconds[b] - seconds[a], 1e-12)
        return np.asarray((place[b] - place[a]) / step[:, None])

    high = np.minimum(low + 1, len(arm) - 1)
    change = velocity(high, last) - velocity(first, low)
    middle_step = seconds[high] - seconds[low]
    outer = 0.5 * (seconds[last] + seconds[high] - seconds[low] - seconds[first])
    acceleration = np.linalg.norm(change, axis=1) / np.maximum(outer, 1e-12)
    error = 0.5 * fraction * (1.0 - fraction) * acceleration * middle_step**2
    return np.where(inside, error, 0.0)


def _spans(rows: Sequence[ExposureRow], arm: ArmTrack) -> str:
    if not rows:
        return ""
    times = [row.t_ns for row in rows]
    return (
        f"; exposures span {min(times) / 1e9:.6f} to {max(times) / 1e9:.6f} s, the arm's samples "
        f"{arm.t_ns[0] / 1e9:.6f} to {arm.t_ns[-1] / 1e9:.6f} s"
    )


SAME_MM, SAME = 1e-6, 1e-9
FEWEST_POINTS = 30
MOVED_MM = 0.3
"""Stripes further apart were not taken from one place: poses that are written with one decimal of
a millimetre or a degree stay equal over less than that."""


def stripes_at_equal_poses(
    clouds: Mapping[int, PointCloud], poses: ExposurePoses
) -> dict[int, float]:
    """Exposures that bear the pose of an earlier one but show another stripe.

    An arm at rest may well say the very same pose again, and a robot comes back to it; the object
    then shows the same stripe. A pose that hung, or was repeated, does not.

    Parameters
    ----------
    clouds
        Points in Base of each instant, of all its cameras, by the row whose pose it has.
    poses
        Of all rows.

    Returns
    -------
    dict[int, float]
        Distance in mm from the earlier stripe, by row; only where the same sheet shows in both.
    """
    found: dict[int, float] = {}
    first: dict[bytes, int] = {}
    for row in sorted(clouds):
        key = _key(poses, row)
        if key not in first:
            first[key] = row
            continue
        apart = _apart_mm(clouds[first[key]], clouds[row])
        if apart > MOVED_MM:
            found[row] = apart
    return found


def _key(poses: ExposurePoses, row: int) -> bytes:
    place = np.rint(poses.translations_mm[row] / SAME_MM).astype(np.int64)
    turn = np.rint(poses.rotations[row] / SAME).astype(np.int64)
    return bytes(place.tobytes() + turn.tobytes())


def _apart_mm(one: PointCloud, other: PointCloud) -> float:
    """Median distance between two stripes of one sheet; 0 where they cannot be compared."""
    distances: list[FloatArray] = []
    for sheet in np.intersect1d(one.sheet, other.sheet):
        a, b = (cloud.points_mm[cloud.sheet == sheet] for cloud in (one, other))
        if min(len(a), len(b)) >= FEWEST_POINTS:
            distances.append(np.asarray(cKDTree(a).query(b)[0]))
    return float(np.median(np.concatenate(distances))) if distances else 0.0
