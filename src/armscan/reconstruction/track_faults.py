# SPDX-License-Identifier: Apache-2.0
"""Jumps, standstills and other faults that an arm's track shows of itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import maximum_filter1d

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.records.recording import ArmTrack

FaultKind = Literal["jump", "off the track", "stands still", "repeated"]

LEVER_MM = 200.0
"""Rotations are judged by points so far from the tool's origin: about where a head measures."""
SHORTEST_GAP_NS, LONGEST_STEP_NS, GAP_PERIODS = 100_000_000, 250_000_000, 3
"""Steps beyond three median periods (but at least 0.1 s), or beyond a quarter of a second, are
gaps: the tool may have gone anywhere meanwhile."""
JUDGED_AT_ONCE = 4096
"""Steps whose neighbours are held at a time: 3 KB each."""
WINDOW = 4
"""Steps on either side that tell the speed about a step."""
FEWEST_STEPS = 8
"""Shorter unbroken pieces of a track are not judged: postures, single triggers."""
ACCELERATION_MM_S2 = 10_000.0
"""About gravity: what a hand or a robot may do at any time."""
SPEED_SHARE = 3.0
"""A stop, a start or a late time changes a step by up to its own length; thrice is granted."""
NOISE_SIGMAS = 8.0
OUTSTANDING = 5.0
"""A step is at fault if, in units of what is granted, it also exceeds the rest of the recording so
many times: a rough track (late times, a robot's shocks) is its own measure."""
FEW_STEPS, FEW_SHARE = 8, 0.05
"""Steps, or part of all steps, that are not counted as "the rest of the recording"."""
RETURNS = 0.15
"""A second jump undoes a first one if their sum is less than this part of them."""
FEWEST_REPEATED = 5
SAME_MM = 1e-7


@dataclass(frozen=True, slots=True)
class TrackFault:
    """One contradiction in a track.

    Parameters
    ----------
    kind
        ``jump``: all that follows is shifted, or all that came before; ``off the track``: a stretch
        between two parts that fit together; ``stands still``: equal samples, then a leap;
        ``repeated``: after a leap, a run of the very samples that stand elsewhere in the track.
    first, last
        Samples concerned, both included; of a jump the ones before and after it.
    t_ns
        (first, last) their times.
    size_mm
        How far the tool leapt, of the tool's origin or of points near it, whichever went further.
    """

    kind: FaultKind
    first: int
    last: int
    t_ns: tuple[int, int]
    size_mm: float

    @property
    def words(self) -> str:
        """What happened, where and by how much."""
        start, end = (value / 1e9 for value in self.t_ns)
        n = self.last - self.first + 1
        if self.kind == "jump":
            return (
                f"the arm's pose jumps by {self.size_mm:.4g} mm within "
                f"{(end - start) * 1e3:.3g} ms at {start:.3f} s"
            )
        what = "sample" if n == 1 else "samples"
        if self.kind == "off the track":
            return (
                f"{n} {what} of the arm at {start:.3f} s lie {self.size_mm:.4g} mm off the track "
                "on both sides"
            )
        if self.kind == "repeated":
            return f"{n} {what} of the arm from {start:.3f} s on repeat others of the same track"
        return (
            f"the arm's pose stands still for {n} {what} from {start:.3f} s, then leaps by "
            f"{self.size_mm:.4g} mm: an encoder or the transmission hung"
        )


@dataclass(frozen=True, slots=True, eq=False)
class TrackCheck:
    """Which samples cannot be right, and why.

    Parameters
    ----------
    faults
        In order of time.
    is_faulty
        (N,) samples whose pose cannot be right.
    is_broken_step
        (N,) True where the tool cannot have gone from this sample to the next as the track says.
    """

    faults: tuple[TrackFault, ...]
    is_faulty: BoolArray
    is_broken_step: BoolArray

    @property
    def jumps(self) -> tuple[TrackFault, ...]:
        """Jumps after which nobody can say which half is right."""
        return tuple(fault for fault in self.faults if fault.kind == "jump")


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Steps that can be judged: first sample, leap (K, 12), its size, what is granted; in mm."""

    sample: IntArray
    leap: FloatArray
    size: FloatArray
    granted: FloatArray


def check_track(arm: ArmTrack) -> TrackCheck:
    """Look for jumps, samples off the track and hung encoders.

    Each step between samples is compared with the median velocity of the steps around it
    (`WINDOW`). What is left is granted `NOISE_SIGMAS` of the track's own scatter, `SPEED_SHARE` of
    the way that the tool goes in a step there, and `ACCELERATION_MM_S2`; it is at fault if it also
    stands out of the recording (`OUTSTANDING`). Steps over gaps are not judged.
    """
    known = _without_repeats(arm)
    places = _places(arm)[known]
    resolution = _resolution_mm(places)
    none = np.zeros(len(arm), dtype=np.bool_)
    steps = _judged_steps(places, arm.t_ns[known], resolution)
    events = _events(steps, len(known))
    if not len(events):
        return TrackCheck((), none, none.copy())
    equal = np.abs(np.diff(places, axis=0)).max(axis=1) < SAME_MM
    found = [
        TrackFault(
            kind,
            int(known[first]),
            int(known[last]),
            (int(arm.t_ns[known[first]]), int(arm.t_ns[known[last]])),
            size,
        )
        for kind, first, last, size in _explained(steps, events, equal, places)
    ]
    faulty, broken = none, none.copy()
    for fault in found:
        if fault.kind == "jump":
            broken[fault.first] = True
        else:
            faulty[fault.first : fault.last + 1] = True
    return TrackCheck(tuple(sorted(found, key=lambda f: f.first)), faulty, broken)


def _without_repeats(arm: ArmTrack) -> IntArray:
    """Known samples; of a controller that is polled faster than it has poses, one of each pose."""
    known = np.flatnonzero(arm.is_known)
    if len(known) < 2:
        return known
    is_new = np.abs(np.diff(_places(arm)[known], axis=0)).max(axis=1) >= SAME_MM
    start = np.concatenate([[0], 1 + np.flatnonzero(is_new)])
    run = np.diff(np.append(start, len(known)))
    held = int(np.median(run))
    since = np.arange(len(known)) - np.repeat(start, run)
    is_kept = (since == 0) | ((since % held == 0) & (np.repeat(run, run) > 2 * held))
    return np.asarray(known[is_kept])


def _places(arm: ArmTrack) -> FloatArray:
    """(N, 12) the tool's origin and three points on its axes, in Base."""
    points = np.concatenate([np.zeros((1, 3)), LEVER_MM * np.eye(3)])
    placed = np.einsum("nij,kj->nki", arm.rotations, points) + arm.translations_mm[:, None]
    return np.asarray(placed.reshape(len(arm), 12))


def _largest(differences: FloatArray) -> FloatArray:
    """(N,) length of the longest of the four vectors of each row (N, 12)."""
    x, y, z = np.moveaxis((differences * differences).reshape(-1, 4, 3), 2, 0)
    return np.asarray(np.sqrt(np.ascontiguousarray((x + y + z).T).max(axis=0)))


def _resolution_mm(places: FloatArray) -> float:
    """Smallest step of the numbers as written, of places and of rotations."""
    change = np.diff(places, axis=0).reshape(-1, 4, 3)
    total = 0.0
    for part in (np.abs(change[:, 0]), np.abs(change[:, 1:] - change[:, :1])):
        moved = part[part > SAME_MM]
        total += float(moved.min()) if len(moved) else 0.0
    return total


def _judged_steps(places: FloatArray, t_ns: IntArray, resolution_mm: float) -> _Steps:
    empty = _Steps(np.zeros(0, np.int64), np.zeros((0, 12)), np.zeros(0), np.zeros(0))
    if len(t_ns) < FEWEST_STEPS + 1:
        return empty
    step_ns = np.diff(t_ns)
    period = float(np.median(step_ns))
    longest = min(max(GAP_PERIODS * period, SHORTEST_GAP_NS), LONGEST_STEP_NS)
    seconds, way = step_ns * 1e-9, np.diff(places, axis=0)
    velocity = way / np.maximum(seconds, 0.25e-9 * period)[:, None]
    samples, leaps, speeds, sides = [], [], [], []
    is_joined = step_ns <= longest
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_joined.astype(np.int8), [0]])))
    beside = np.concatenate([np.arange(-WINDOW, 0), np.arange(1, WINDOW + 1)])
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if end - start < FEWEST_STEPS:
            continue
        # rows are judged each by itself: few at a time, of a track of minutes
        for own in np.array_split(np.arange(start, end), 1 + (end - start) // JUDGED_AT_ONCE):
            around = own[:, None] + beside
            inside = (around >= start) & (around < end)
            near = velocity[np.clip(around, start, end - 1)]
            usual = _medians(near, inside)
            speed = _largest(near.reshape(-1, 12)).reshape(*inside.shape, 1)
            samples.append(own)
            leaps.append(way[own] - usual * seconds[own, None])
            speeds.append(_medians(speed, inside)[:, 0])
            sides.append(np.where(inside.sum(axis=1) >= WINDOW + 2, 1.0, 2.0))
    if not samples:
        return empty
    sample, leap, speed = np.concatenate(samples), np.concatenate(leaps), np.concatenate(speeds)
    size = _largest(leap)
    scatter = robust_sigma(size) + resolution_mm
    time = np.maximum(seconds[sample], 1e-9 * period)
    moved = SPEED_SHARE * speed * time + ACCELERATION_MM_S2 * time**2
    # at the ends of a piece the speed is known from one side only
    granted = NOISE_SIGMAS * scatter + moved * np.concatenate(sides)
    return _Steps(sample, leap, size, np.maximum(granted, SAME_MM))


def _medians(values: FloatArray, is_counted: BoolArray) -> FloatArray:
    """(K, C) medians of those of values (K, W, C) that count, (K, W): one a row at least."""
    ordered = np.sort(np.where(is_counted[:, :, None], values, np.inf), axis=1)
    count, row = is_counted.sum(axis=1), np.arange(len(values))
    return np.asarray(0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2]))


def _events(steps: _Steps, n_samples: int) -> IntArray:
    """(E,) rows of ``steps`` at which the tool cannot have gone as the track says."""
    if not len(steps.sample):
        return np.zeros(0, np.int64)
    ratio = steps.size / steps.granted
    n_few = max(FEW_STEPS, int(FEW_SHARE * len(ratio)))
    rest = np.sort(ratio)[: max(len(ratio) - n_few, 1)][-1]
    is_odd = (ratio > 1.0) & (ratio > OUTSTANDING * rest)
    # a leap leaks into the velocities of its neighbours: only the largest of those counts
    of_sample = np.zeros(n_samples)
    of_sample[steps.sample] = ratio
    is_peak = of_sample == maximum_filter1d(of_sample, 3)
    near = is_odd & (ratio < 0.3 * maximum_filter1d(of_sample, 3)[steps.sample])
    return np.flatnonzero(is_odd & (is_peak[steps.sample] | ~near))


def _explained(
    steps: _Steps, events: IntArray, equal: BoolArray, places: FloatArray
) -> Iterator[tuple[FaultKind, int, int, float]]:
    """Kind, first and last sample, and size of each fault."""
    open_events: list[int] = []
    done = -1
    for event in events.tolist():
        sample, size = int(steps.sample[event]), float(steps.size[event])
        if sample <= done:
            continue
        n_repeated = _repeated(places, sample + 1)
        if n_repeated:
            done = sample + n_repeated
            yield "repeated", sample + 1, done, size
            continue
        start = sample
        while start > 0 and equal[start - 1]:
            start -= 1
        if sample - start >= 2:
            yield "stands still", start + 1, sample, size
            continue
        end = sample + 1
        while end < len(equal) and equal[end]:
            end += 1
        if end - sample >= 3:
            yield "stands still", sample + 1, end, size
            continue
        open_events.append(event)
    k = 0
    while k < len(open_events):
        first = open_events[k]
        after = open_events[k + 1] if k + 1 < len(open_events) else None
        if after is not None and _undoes(steps, first, after, len(equal)):
            yield (
                "off the track",
                int(steps.sample[first]) + 1,
                int(steps.sample[after]),
                float(max(steps.size[first], steps.size[after])),
            )
            k += 2
            continue
        sample = int(steps.sample[first])
        yield "jump", sample, sample + 1, float(steps.size[first])
        k += 1


def _repeated(places: FloatArray, start: int) -> int:
    """How many samples from ``start`` on are the very ones that stand elsewhere, in their order."""
    same = np.abs(places - places[start]).max(axis=1) < SAME_MM
    same[start:] = False
    longest = 0
    for other in np.flatnonzero(same).tolist():
        n = min(len(places) - start, start - other)
        equal = np.abs(places[start : start + n] - places[other : other + n]).max(axis=1) < SAME_MM
        length = n if equal.all() else int(equal.argmin())
        # a track at rest repeats one pose; that is no repeated way
        if np.ptp(places[start : start + length], axis=0).max(initial=0.0) > SAME_MM:
            longest = max(longest, length)
    return longest if longest >= FEWEST_REPEATED else 0


def _undoes(steps: _Steps, first: int, after: int, n_steps: int) -> bool:
    """Whether the second leap takes a minority of samples back to where the others are."""
    if 2 * (int(steps.sample[after]) - int(steps.sample[first])) > n_steps:
        return False
    left = float(_largest((steps.leap[first] + steps.leap[after])[None])[0])
    size = max(float(steps.size[first]), float(steps.size[after]))
    return left <= RETURNS * size + float(steps.granted[first] + steps.granted[after])
