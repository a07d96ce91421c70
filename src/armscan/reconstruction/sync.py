# SPDX-License-Identifier: Apache-2.0
"""Which pose the arm had at each exposure: by trigger id, or by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.errors import EstimationError, InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.slerp import slerp
from armscan.reconstruction.exposure_poses import ExposurePoses, PoseFate
from armscan.reconstruction.track_faults import check_track
from armscan.records.arm_track import NO_TRIGGER, ArmTrack
from armscan.records.session import Clock, ExposureRow

GAP_PERIODS = 3
"""Steps between samples up to this many median periods are bridged, unless the user says more."""
LARGEST_DEFAULT_GAP_NS = 500_000_000
"""And never longer ones: an arm that gives a pose now and then may have gone anywhere between."""
LISTED_FAULTS = 3
"""Faults of a track that are told one by one."""
BEND_MM = 0.02
"""Interpolation errors of this size in the tool's place are warned of: an arm's own scatter."""


@dataclass(frozen=True, slots=True)
class SyncOptions:
    """How exposures and the arm's samples are put together.

    Parameters
    ----------
    max_gap_ns
        Widest step between two samples within which a pose is interpolated. None: three median
        periods of the track, at most half a second.
    """

    max_gap_ns: int | None = None

    def __post_init__(self) -> None:
        if self.max_gap_ns is not None and self.max_gap_ns <= 0:
            raise OptionError(f"largest gap {self.max_gap_ns} ns", remedy="give more than 0")


def exposure_poses(
    rows: Sequence[ExposureRow],
    arm: ArmTrack | None,
    clock: Clock = "shared",
    latency_ns: int = 0,
    options: SyncOptions | None = None,
) -> ExposurePoses:
    """Find ``base_from_tool`` of each exposure; a pose that is not known is never guessed.

    The arm's track is checked by itself (`armscan.reconstruction.track_faults`): exposures at
    samples that cannot be right get no pose.

    Trigger ids decide if exposures and samples have them. Else the pose is interpolated in time
    between two neighbouring known samples: the rotation by SLERP, the place along a straight line.

    Parameters
    ----------
    rows
        The exposures.
    arm
        The arm's samples.
    clock
        ``shared`` if both bear times of one clock.
    latency_ns
        Added to an exposure's time before the pose is looked up by time.
    options
        Defaults if None.

    Raises
    ------
    InputError
        If there is no arm, two samples share a trigger id, or there are neither ids nor a shared
        clock.
    EstimationError
        If no exposure has a pose.
    """
    options = options or SyncOptions()
    if arm is None or len(arm) == 0:
        raise InputError(
            "the scan has no samples of the arm", remedy="record the arm's poses in arm.csv"
        )
    has_ids = arm.trigger_ids is not None and bool((arm.trigger_ids != NO_TRIGGER).any())
    if has_ids and any(row.trigger_id is not None for row in rows):
        poses = _by_trigger(rows, arm, clock, latency_ns)
    elif clock == "shared":
        poses = poses_by_time(rows, arm, latency_ns, options)
    else:
        raise InputError(
            "exposures and arm samples have separate clocks and no trigger ids in common",
            remedy="record trigger_id in both tables, or times of one clock "
            'and then clock = "shared"',
        )
    poses = _without_contradicted(poses, rows, arm, latency_ns)
    if not poses.has_pose.any():
        raise EstimationError(
            f"none of {len(rows)} exposures has a pose: {poses.missing or 'there are none'}"
            f"{_spans(rows, arm) if poses.source == 'time' else ''}",
            remedy="check the times and trigger ids of exposures and arm samples",
        )
    return poses


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
    fate = np.where(is_wrong, int(PoseFate.CONTRADICTED), poses.fate)
    rotations = np.where(is_wrong[:, None, None], np.eye(3), poses.rotations)
    translations = np.where(is_wrong[:, None], 0.0, poses.translations_mm)
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
        poses,
        rotations=rotations,
        translations_mm=translations,
        fate=fate,
        sample=np.where(is_wrong, -1, poses.sample),
        warnings=tuple(warnings),
        track_faults=check.faults,
    )


def largest_gap_ns(arm: ArmTrack, options: SyncOptions) -> int:
    """Widest step between samples that is bridged; 0 if the track has one sample only."""
    if options.max_gap_ns is not None:
        return options.max_gap_ns
    if len(arm) < 2:
        return 0
    median = float(np.median(np.diff(arm.t_ns)))
    return int(min(GAP_PERIODS * median, LARGEST_DEFAULT_GAP_NS))


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
    fate = np.full(len(rows), int(PoseFate.NO_TRIGGER))
    found = np.full(len(rows), -1)
    for k, row in enumerate(rows):
        if row.trigger_id is None or row.trigger_id == NO_TRIGGER:
            continue
        found[k] = sample_of.get(row.trigger_id, -1)
        fate[k] = int(PoseFate.UNKNOWN_TRIGGER)
        if found[k] >= 0:
            is_known = arm.is_known[found[k]]
            fate[k] = int(PoseFate.FOUND if is_known else PoseFate.UNKNOWN_SAMPLE)
    rotations, translations = _at_samples(arm, found, fate)
    warnings = _times_apart(rows, arm, found, latency_ns) if clock == "shared" else ()
    return ExposurePoses(rotations, translations, fate, found, "trigger", 0, warnings)


def _times_apart(
    rows: Sequence[ExposureRow], arm: ArmTrack, found: IntArray, latency_ns: int
) -> tuple[str, ...]:
    """Ids and times of one clock must tell the same story; swapped or shifted ids do not."""
    limit = largest_gap_ns(arm, SyncOptions())
    times = np.array([row.t_ns for row in rows], dtype=np.int64) + latency_ns
    apart = np.abs(times - arm.t_ns[found])[found >= 0]
    n_far = int((apart > limit).sum()) if limit else 0
    if not n_far:
        return ()
    return (
        f"{n_far} exposures lie up to {apart.max() / 1e6:.1f} ms from the arm sample of their "
        "trigger id, though the clock is said to be shared: check the ids and the clock",
    )


def _at_samples(arm: ArmTrack, found: IntArray, fate: IntArray) -> tuple[FloatArray, FloatArray]:
    rotations, translations = np.tile(np.eye(3), (len(found), 1, 1)), np.zeros((len(found), 3))
    own = fate == int(PoseFate.FOUND)
    rotations[own] = arm.rotations[found[own]]
    translations[own] = arm.translations_mm[found[own]]
    return rotations, translations


def poses_by_time(
    rows: Sequence[ExposureRow],
    arm: ArmTrack,
    latency_ns: int = 0,
    options: SyncOptions | None = None,
) -> ExposurePoses:
    """Poses by times of one clock alone, whatever trigger ids there are; see `exposure_poses`."""
    options = options or SyncOptions()
    times = np.array([row.t_ns for row in rows], dtype=np.int64) + latency_ns
    max_gap = largest_gap_ns(arm, options)
    before = np.searchsorted(arm.t_ns, times, side="right") - 1
    after = np.minimum(before + 1, len(arm) - 1)
    start = np.maximum(before, 0)
    is_exact = (before >= 0) & (arm.t_ns[start] == times)
    step = arm.t_ns[after] - arm.t_ns[start]
    is_bridged = arm.is_known[start] & arm.is_known[after] & (step > 0) & (step <= max_gap)
    fate = np.where(is_bridged, int(PoseFate.FOUND), int(PoseFate.GAP))
    fate[before < 0] = int(PoseFate.BEFORE_TRACK)
    fate[times > arm.t_ns[-1]] = int(PoseFate.AFTER_TRACK)
    at_sample = np.where(arm.is_known[start], PoseFate.FOUND, PoseFate.UNKNOWN_SAMPLE)
    fate[is_exact] = at_sample[is_exact]
    rotations, translations = _at_samples(arm, start, fate)
    between = np.flatnonzero((fate == int(PoseFate.FOUND)) & ~is_exact)
    low, high = start[between], after[between]
    fraction = (times[between] - arm.t_ns[low]) / step[between]
    rotations[between] = slerp(arm.rotations[low], arm.rotations[high], fraction)
    way = arm.translations_mm[high] - arm.translations_mm[low]
    translations[between] = arm.translations_mm[low] + fraction[:, None] * way
    sample = np.where(fate == int(PoseFate.FOUND), start, -1)
    warnings = _bend_warning(arm, low, fraction)
    return ExposurePoses(rotations, translations, fate, sample, "time", max_gap, warnings)


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
