# SPDX-License-Identifier: Apache-2.0
"""Streams of devices watched one element at a time, and clocks related to one another.

An element reaches the computer later than it was taken, by a delay that has a least value and no
greatest one. The time by another clock is therefore a line under the arrivals: of each block of
elements only the one that came fastest counts (Moon, Skelly and Towsley, Estimation and removal
of clock skew from network delay measurements, INFOCOM 1999). The least delay itself cannot be
seen; it stays in the offset, is as constant as the transport, and is what
`armscan.calibration.latency` measures.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from math import hypot, inf, sqrt

import numpy as np

from armscan.devices.protocols import AT_END_STOP, INACCURATE
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

FIRST_BLOCK = 4
"""Elements of the first blocks; doubled whenever there are `MOST_BLOCKS`."""
FEWEST_BLOCKS, MOST_BLOCKS = 8, 64
WINDOW_NS = 30_000_000_000
"""Blocks are joined until so much time is seen, then the oldest are forgotten: between one and two
times as long, over which a quartz that warms up stays straight within microseconds."""
LARGEST_DRIFT = 500e-6
"""Quartz clocks agree within 100 parts in a million each."""
LARGEST_SIGMA_NS = 100_000.0
"""A hand that scans at 200 mm/s moves by 0.02 mm meanwhile, an arm's own scatter."""
SLOWEST = 8.0
"""Blocks above the line by more than so many medians count as delayed as a whole."""
JUMP_SIGMAS, SMALLEST_JUMP_NS = 10.0, 100_000.0
BLOCKS_OF_A_JUMP = 3
"""So many blocks in a row, equally far above the line, are no delay any more."""
RESOLUTION_NS = 1.0
"""Times are whole nanoseconds: no line is known better."""


@dataclass(frozen=True, slots=True)
class ClockFit:
    """A device's clock against another: ``other = offset + (1 + drift) device``.

    Parameters
    ----------
    device_ns, other_ns
        A pair of times that belong together, in the middle of what was seen.
    drift
        Part by which the other clock runs faster.
    sigma_offset_ns, sigma_drift
        Standard deviations of ``other_ns`` and of the drift, which do not correlate.
    scatter_ns
        Of the fastest elements of the blocks about the line.
    """

    device_ns: int
    other_ns: int
    drift: float
    sigma_offset_ns: float
    sigma_drift: float
    scatter_ns: float

    def to_other_ns(self, t_device_ns: int) -> int:
        """Time of the other clock, in whole ns."""
        since = t_device_ns - self.device_ns
        return self.other_ns + since + round(self.drift * since)

    def sigma_ns(self, t_device_ns: int) -> float:
        """Standard deviation of `to_other_ns`, the constant least delay apart."""
        return hypot(self.sigma_offset_ns, self.sigma_drift * (t_device_ns - self.device_ns))


class ClockModel:
    """Relates a device's clock to another while elements come in.

    `add` takes a microsecond; once a block it fits anew. The state has a fixed size.
    A clock that jumped, or a transport that became slower for good, starts it anew.
    """

    def __init__(self) -> None:
        self.n_jumps = 0
        self.restart()

    def restart(self) -> None:
        """Forget all, as after a jump that was seen elsewhere."""
        self.fit: ClockFit | FitFailure = FitFailure("no block of elements is complete yet")
        self._blocks: list[tuple[int, int]] = []
        self._block_size = FIRST_BLOCK
        self._n_in_block = 0
        self._best: tuple[int, int] = (0, 0)
        self._best_excess = inf
        self._slope = 0.0
        self._origin: tuple[int, int] | None = None
        self._high: list[tuple[int, int]] = []

    def add(self, t_device_ns: int, t_other_ns: int) -> bool:
        """Take one element; True if it showed a jump, and all before it was forgotten."""
        if self._origin is None:
            self._origin = (t_device_ns, t_other_ns)
        since = t_device_ns - self._origin[0]
        excess = (t_other_ns - self._origin[1]) - since - self._slope * since
        if isinstance(self.fit, ClockFit) and self._is_early(t_device_ns, t_other_ns, self.fit):
            self._begin_anew([(t_device_ns, t_other_ns)])
            return True
        if excess < self._best_excess:
            self._best, self._best_excess = (t_device_ns, t_other_ns), excess
        self._n_in_block += 1
        return self._n_in_block >= self._block_size and self._end_block()

    def to_other_ns(self, t_device_ns: int) -> int:
        """Time of the other clock.

        Raises
        ------
        EstimationError
            If the clock is not determined at that time; `missing` says why.
        """
        reason = self.missing(t_device_ns)
        if reason or isinstance(self.fit, FitFailure):
            raise EstimationError(f"the clock is not determined: {reason}")
        return self.fit.to_other_ns(t_device_ns)

    def missing(self, t_device_ns: int) -> str:
        """Why a time cannot be told by the other clock; empty if it can."""
        if isinstance(self.fit, FitFailure):
            return self.fit.reason
        sigma = self.fit.sigma_ns(t_device_ns)
        if sigma > LARGEST_SIGMA_NS:
            return (
                f"its sigma is {sigma / 1e3:.3g} us, more than {LARGEST_SIGMA_NS / 1e3:g} us; "
                "elements come too unevenly, or too long ago"
            )
        return ""

    def _is_early(self, t_device_ns: int, t_other_ns: int, fit: ClockFit) -> bool:
        """Whether an element came before it can have been taken."""
        ahead = fit.to_other_ns(t_device_ns) - t_other_ns
        return ahead > SMALLEST_JUMP_NS and ahead > JUMP_SIGMAS * (
            fit.scatter_ns + fit.sigma_ns(t_device_ns)
        )

    def _begin_anew(self, blocks: list[tuple[int, int]]) -> None:
        size, n_jumps = self._block_size, self.n_jumps + 1
        self.restart()
        self.n_jumps = n_jumps
        if len(blocks) >= BLOCKS_OF_A_JUMP:
            self._block_size = size
        self._origin = blocks[0]
        self._blocks = blocks
        self._refit()

    def _end_block(self) -> bool:
        block = self._best
        self._n_in_block, self._best_excess = 0, inf
        if isinstance(self.fit, ClockFit):
            self._high = [*self._high, block] if self._is_high(block, self.fit) else []
            if len(self._high) >= BLOCKS_OF_A_JUMP and self._is_level(self.fit):
                self._begin_anew(self._high[-BLOCKS_OF_A_JUMP:])
                return True
        self._blocks.append(block)
        if len(self._blocks) > MOST_BLOCKS:
            self._make_room()
        self._refit()
        return False

    def _is_high(self, block: tuple[int, int], fit: ClockFit) -> bool:
        return -_ahead_ns(fit, block) > _limit_ns(fit, block)

    def _is_level(self, fit: ClockFit) -> bool:
        """Whether the last blocks are equally late; a queue that empties is not."""
        late = [-_ahead_ns(fit, block) for block in self._high[-BLOCKS_OF_A_JUMP:]]
        return max(late) - min(late) <= _limit_ns(fit, self._high[-1])

    def _make_room(self) -> None:
        first, last = self._blocks[0][0], self._blocks[-1][0]
        if last - first > WINDOW_NS:
            del self._blocks[0]
            return
        pairs = zip(self._blocks[::2], self._blocks[1::2], strict=False)
        odd = self._blocks[-1:] if len(self._blocks) % 2 else []
        self._blocks = [min(pair, key=self._excess) for pair in pairs] + odd
        self._block_size *= 2

    def _excess(self, block: tuple[int, int]) -> float:
        return block[1] - block[0] - self._slope * (block[0] - self._blocks[0][0])

    def _refit(self) -> None:
        self.fit = fit_clock(self._blocks)
        if isinstance(self.fit, ClockFit):
            self._slope = self.fit.drift
            self._origin = (self.fit.device_ns, self.fit.other_ns)


def _ahead_ns(fit: ClockFit, block: tuple[int, int]) -> int:
    return fit.to_other_ns(block[0]) - block[1]


def _limit_ns(fit: ClockFit, block: tuple[int, int]) -> float:
    return max(SMALLEST_JUMP_NS, JUMP_SIGMAS * (fit.scatter_ns + fit.sigma_ns(block[0])))


def fit_clock(fastest: list[tuple[int, int]]) -> ClockFit | FitFailure:
    """Fit the line of two clocks under pairs of times.

    Starts from the edge of the lower convex hull over the middle, below which no pair lies;
    leaves out pairs that are late as a whole; then fits by least squares and lowers the line by
    the scatter, by which the mean of delays with a hard lower limit lies above that limit.

    Pairs of times (device, other) in ns are in time order, each the fastest of a block.
    """
    if len(fastest) < FEWEST_BLOCKS:
        return FitFailure(f"{len(fastest)} of {FEWEST_BLOCKS} blocks of elements are complete")
    device0, other0 = fastest[len(fastest) // 2]
    x = np.array([device - device0 for device, _ in fastest], dtype=np.float64)
    y = np.array([other - other0 for _, other in fastest], dtype=np.float64) - x
    low, slope = _lower_edge(x, y)
    above = y - low - slope * x
    is_kept = above <= SLOWEST * np.median(above) + RESOLUTION_NS
    n = int(is_kept.sum())
    if n < FEWEST_BLOCKS:
        return FitFailure(f"{n} of {FEWEST_BLOCKS} blocks of elements came without long delay")
    x, y = x[is_kept], y[is_kept]
    middle = float(x.mean())
    spread = float(((x - middle) ** 2).sum())
    drift = float((x - middle) @ y) / spread
    residual = y - y.mean() - drift * (x - middle)
    # of few blocks the scatter itself is badly known: Student's variance in place of the normal's
    scatter = sqrt(float(residual @ residual) / (n - 2)) + RESOLUTION_NS
    known = scatter * sqrt((n - 2) / (n - 4))
    if abs(drift) > LARGEST_DRIFT:
        return FitFailure(f"it would drift by {drift * 1e6:.0f} ppm, more than a clock does")
    offset = round(middle)
    height = float(y.mean()) + drift * (offset - middle) - (scatter - RESOLUTION_NS)
    return ClockFit(
        device_ns=device0 + offset,
        other_ns=other0 + offset + round(height),
        drift=drift,
        sigma_offset_ns=hypot(known / sqrt(n), RESOLUTION_NS),
        sigma_drift=known / sqrt(spread),
        scatter_ns=scatter,
    )


def _lower_edge(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Height at 0 and slope of the hull's edge that passes below the mean of ``x``."""
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) > 1 and _turns_down(x, y, (hull[-2], hull[-1], k)):
            hull.pop()
        hull.append(k)
    right = int(np.searchsorted(x[hull], x.mean()))
    a, b = hull[max(right - 1, 0)], hull[max(right, 1)]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return float(y[a] - slope * x[a]), slope


def _turns_down(x: FloatArray, y: FloatArray, points: tuple[int, int, int]) -> bool:
    a, b, c = points
    return bool((x[b] - x[a]) * (y[c] - y[a]) <= (x[c] - x[a]) * (y[b] - y[a]))


class ElementStatus(IntEnum):
    """Whether one element of a stream can be used, and if not, why."""

    USABLE = 0
    DUPLICATE = 1
    """Its number came before."""
    LATE = 2
    """One with a higher number came before it."""
    JUMP = 3
    """Between this element and the last one the device's clock jumped."""
    DOUBTFUL = 4
    """It came far later than its clock says, at an uneven step: a stall of the transport, or a
    jump of the clock that is not certain yet."""

    @property
    def label(self) -> str:
        """The words that a report shows."""
        return _LABELS[self]


_LABELS = {
    ElementStatus.USABLE: "usable",
    ElementStatus.DUPLICATE: "delivered twice",
    ElementStatus.LATE: "after a newer one",
    ElementStatus.JUMP: "where the device's clock jumped",
    ElementStatus.DOUBTFUL: "later than the device's clock says",
}


@dataclass(slots=True)
class StreamCounts:
    """What was seen in a stream.

    Parameters
    ----------
    n_elements
        All that came.
    n_missing, n_gaps
        Elements that the device counted but that did not come, and stretches of such.
    n_duplicates, n_late, n_jumps, n_doubtful
        Elements by `ElementStatus`.
    n_restarts
        How often the device's count began anew; what was lost there cannot be counted.
    n_inaccurate, n_end_stop
        Samples of which the arm itself says that they are inaccurate, and have no valid pose, or
        that it is at an end stop.
    """

    n_elements: int = 0
    n_missing: int = 0
    n_gaps: int = 0
    n_duplicates: int = 0
    n_late: int = 0
    n_jumps: int = 0
    n_doubtful: int = 0
    n_restarts: int = 0
    n_inaccurate: int = 0
    n_end_stop: int = 0

    @property
    def words(self) -> str:
        """What was wrong; empty if nothing was."""
        parts = (
            (self.n_missing, f"lost in {self.n_gaps} gap{'' if self.n_gaps == 1 else 's'}"),
            (self.n_duplicates, ElementStatus.DUPLICATE.label),
            (self.n_late, ElementStatus.LATE.label),
            (self.n_jumps, ElementStatus.JUMP.label),
            (self.n_doubtful, ElementStatus.DOUBTFUL.label),
            (self.n_restarts, "times the count began anew"),
            (self.n_inaccurate, INACCURATE),
            (self.n_end_stop, AT_END_STOP),
        )
        return ", ".join(f"{n} {what}" for n, what in parts if n)


REMEMBERED = 1024
"""Elements that are known again, and lost ones that are still awaited."""


class StreamMonitor:
    """Watches count and times of one device's stream and keeps the model of its clock.

    Call `check` for every element in the order of arrival; then ask `clock` for its time.
    """

    def __init__(self) -> None:
        self.clock = ClockModel()
        self.counts = StreamCounts()
        self._number: int | None = None
        self._t_device_ns = 0
        self._seen: deque[tuple[int, int]] = deque(maxlen=REMEMBERED)
        self._missing: deque[int] = deque(maxlen=REMEMBERED)
        self._period_ns = 0.0
        self._uneven_ns = 0.0
        self._excess_ns = 0.0
        self._is_doubtful = False

    @property
    def is_timed(self) -> bool:
        """Whether the newest element has a time by this computer's clock."""
        return not self.clock.missing(self._t_device_ns)

    def check(
        self, number: int, t_device_ns: int, t_host_ns: int, *, is_timed: bool = True
    ) -> ElementStatus:
        """Take one element by its count and its times by the device's and this computer's clock.

        ``t_device_ns`` is a moment that arrivals follow by a constant least delay: of a frame the
        end of its exposure. An element that is not ``is_timed`` counts, and tells nothing of the
        clock.
        """
        self.counts.n_elements += 1
        last = self._number
        if last is not None and number <= last:
            old = self._old(number, t_device_ns)
            if old is not None:
                return old
            self.counts.n_restarts += 1
            self._seen.clear()
            self._missing.clear()
            last = None
        step = 0 if last is None else number - last
        if step > 1:
            self.counts.n_gaps += 1
            self.counts.n_missing += step - 1
            self._missing.extend(range(max(number - REMEMBERED, number - step + 1), number))
        has_time = self._number is not None
        back = has_time and t_device_ns <= self._t_device_ns
        uneven = has_time and self._is_uneven(step, t_device_ns)
        self._seen.append((number, t_device_ns))
        self._number, self._t_device_ns = number, t_device_ns
        if not is_timed and not back:
            return ElementStatus.USABLE
        if back:
            self.clock.restart()
            self.clock.n_jumps += 1
        if self.clock.add(t_device_ns, t_host_ns) or back:
            self.counts.n_jumps += 1
            self._is_doubtful = False
            return ElementStatus.JUMP
        if self._is_in_doubt(t_device_ns, t_host_ns, uneven):
            self.counts.n_doubtful += 1
            return ElementStatus.DOUBTFUL
        return ElementStatus.USABLE

    def _old(self, number: int, t_device_ns: int) -> ElementStatus | None:
        """What a number not above the last one is; None if the count began anew."""
        if (number, t_device_ns) in self._seen:
            self.counts.n_duplicates += 1
            return ElementStatus.DUPLICATE
        if number not in self._missing:
            return None
        self._missing.remove(number)
        self._seen.append((number, t_device_ns))
        self.counts.n_late += 1
        self.counts.n_missing -= 1
        return ElementStatus.LATE

    def _is_uneven(self, step: int, t_device_ns: int) -> bool:
        """Whether the clock's step does not fit the count; learns the usual step."""
        if step == 0:
            return True
        period = (t_device_ns - self._t_device_ns) / step
        off = abs(period - self._period_ns)
        is_uneven = off * step > max(SMALLEST_JUMP_NS, UNEVEN * self._uneven_ns)
        share = 1.0 if self._period_ns == 0.0 else LEARNT
        self._period_ns += share * (period - self._period_ns)
        self._uneven_ns += LEARNT * (min(off, self._period_ns) - self._uneven_ns)
        return is_uneven

    def _is_in_doubt(self, t_device_ns: int, t_host_ns: int, uneven: bool) -> bool:
        fit = self.clock.fit
        if isinstance(fit, FitFailure):
            return False
        excess = max(t_host_ns - fit.to_other_ns(t_device_ns), 0)
        if excess <= max(SMALLEST_JUMP_NS, JUMP_SIGMAS * self._excess_ns):
            self._excess_ns += LEARNT * (excess - self._excess_ns)
            self._is_doubtful = False
        elif uneven:
            self._is_doubtful = True
        return self._is_doubtful


LEARNT, UNEVEN = 0.05, 5.0
"""Weight of a new element in what is usual; and steps so far from it are uneven."""
