# SPDX-License-Identifier: Apache-2.0
"""Clocks of devices: any offset and drift, any delay, losses and jumps; truth is known here."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armscan.devices.clocks import (
    ClockFit,
    ClockModel,
    ElementStatus,
    StreamMonitor,
    fit_clock,
)
from armscan.errors import EstimationError
from armscan.geometry.estimate import FitFailure

offsets = st.integers(-(2**61), 2**61)
drifts = st.floats(-200e-6, 200e-6)


def stream(rate_hz, seconds, drift, *, device0=0, host0=0, uneven=0.0, rng=None):
    """Device and true host times (N,) in ns of a stream."""
    n = round(rate_hz * seconds)
    steps = np.ones(n) if rng is None else rng.uniform(1 - uneven, 1 + uneven, n)
    t = np.rint(np.cumsum(steps) / rate_hz * 1e9)
    device = t.astype(np.int64) + device0
    return device, host0 + np.rint(t * (1 + drift)).astype(np.int64)


def arrivals(true, delay):
    """One after the other: nothing overtakes."""
    return np.maximum.accumulate(true + np.rint(delay).astype(np.int64))


def run(device, host, monitor=None):
    monitor = monitor or StreamMonitor()
    return monitor, [
        monitor.check(k, int(a), int(b)) for k, (a, b) in enumerate(zip(device, host, strict=True))
    ]


@settings(max_examples=40, deadline=None)
@given(offsets, offsets, drifts, st.sampled_from([80.0, 240.0, 1000.0]))
def test_exact_without_delay(device0, host0, drift, rate):
    device, host = stream(rate, 3.0, drift, device0=device0, host0=host0)
    monitor, status = run(device, host)
    assert set(status) == {ElementStatus.USABLE}
    found = [monitor.clock.to_other_ns(int(t)) for t in device[-50:]]
    assert np.abs(np.array(found) - host[-50:]).max() <= 2
    fit = monitor.clock.fit
    assert isinstance(fit, ClockFit)
    assert fit.drift == pytest.approx(drift, abs=2e-9)


def delays(kind, n, rng):
    """Delays in ns; the least is 1 ms."""
    if kind == "exponential":
        return 1e6 + rng.exponential(3e5, n)
    if kind == "even":
        return 1e6 + rng.uniform(0.0, 1e6, n)
    late = rng.random(n) < 0.1
    return 1e6 + rng.exponential(3e5, n) + late * rng.exponential(2e7, n)


@pytest.mark.parametrize("kind", ["exponential", "even", "outliers"])
def test_sigma_tells_the_error_under_one_sided_delay(kind):
    ratios = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        drift = rng.uniform(-200e-6, 200e-6)
        device, true = stream(80.0, 15.0, drift, host0=10**15, device0=10**12)
        monitor, _ = run(device, arrivals(true, delays(kind, len(true), rng)))
        fit = monitor.clock.fit
        assert isinstance(fit, ClockFit)
        error = fit.to_other_ns(int(device[-1])) - int(true[-1]) - 1_000_000
        ratios.append(error / fit.sigma_ns(int(device[-1])))
        assert monitor.counts.n_jumps == 0
        assert fit.sigma_ns(int(device[-1])) < 20_000
    # chi-square of 30: a sigma off by 1.6 either way falls out
    assert 30 * 0.4 < np.sum(np.square(ratios)) < 30 * 1.7


@pytest.mark.parametrize("seed", [0, 1])
def test_a_line_that_is_stable_under_jitter_is_known(seed):
    """Of the stamps, by 0.4 ms: it has no sharp lower limit, and hides no time."""
    rng = np.random.default_rng(seed)
    device, true = stream(80.0, 240.0, 50e-6, host0=10**15)
    host = true + np.rint(3e6 + 4e5 * rng.standard_normal(len(true))).astype(np.int64)
    model, n_unknown = ClockModel(), 0
    for k, (one, other) in enumerate(zip(device.tolist(), host.tolist(), strict=True)):
        model.add(one, other)
        if k >= 2400:
            assert isinstance(model.fit, ClockFit)
            n_unknown += model.missing(one) != ""
    assert n_unknown == model.n_jumps == 0


def test_least_squares_through_all_would_be_wrong():
    """The oracle's own line lies milliseconds above where the fastest elements are."""
    rng = np.random.default_rng(5)
    device, true = stream(80.0, 15.0, 50e-6)
    host = arrivals(true, delays("outliers", len(true), rng))
    slope, height = np.polyfit((device - device[0]) * 1e-9, (host - device).astype(float), 1)
    plain = height + slope * (device[-1] - device[0]) * 1e-9
    monitor, _ = run(device, host)
    ours = monitor.clock.to_other_ns(int(device[-1])) - int(device[-1])
    truth = int(true[-1] - device[-1]) + 1_000_000
    assert abs(plain - truth) > 1_000_000 > 50 * abs(ours - truth)


def test_undetermined_at_first_and_long_after():
    device, true = stream(80.0, 2.0, 1e-4)
    model = ClockModel()
    with pytest.raises(EstimationError, match="not determined"):
        model.to_other_ns(0)
    rng = np.random.default_rng(1)
    for a, b in zip(device[:31], true[:31], strict=True):
        model.add(int(a), int(b) + int(rng.exponential(3e5)))
    assert "7 of 8 blocks" in model.missing(int(device[31]))
    for a, b in zip(device[31:], true[31:], strict=True):
        model.add(int(a), int(b) + int(rng.exponential(3e5)))
    assert model.missing(int(device[-1])) == ""
    assert "sigma" in model.missing(int(device[-1]) + 3600 * 10**9)


def test_what_no_clock_does_is_no_fit():
    pairs = [(k * 10**8, k * 10**8 + k * 10**5) for k in range(12)]
    found = fit_clock(pairs)
    assert isinstance(found, FitFailure)
    assert "1000 ppm" in found.reason


@pytest.mark.parametrize("jump_ns", [-3_000_000_000, -30_000_000, 5_000_000, 3_000_000_000])
@pytest.mark.parametrize("uneven", [0.0, 0.2])
def test_a_jump_starts_anew_and_nothing_wrong_is_told(jump_ns, uneven):
    rng = np.random.default_rng(abs(jump_ns) % 1000 + round(10 * uneven))
    device, true = stream(80.0, 20.0, 80e-6, uneven=uneven, rng=rng)
    host = arrivals(true, 1e6 + rng.exponential(3e5, len(true)))
    device = device + jump_ns * (np.arange(len(device)) >= 800)
    monitor, usable_again = StreamMonitor(), None
    for k, (a, b) in enumerate(zip(device.tolist(), host.tolist(), strict=True)):
        status = monitor.check(k, a, b)
        assert (status == ElementStatus.JUMP) == (k == 800)
        if status == ElementStatus.USABLE and not monitor.clock.missing(a):
            assert abs(monitor.clock.to_other_ns(a) - true[k] - 1_000_000) < 300_000
            usable_again = k if k > 800 and usable_again is None else usable_again
    assert monitor.counts.n_jumps == 1
    assert usable_again is not None and usable_again < 880


def test_a_jump_less_than_a_step_is_doubtful_until_it_is_certain():
    """A clock set back by 5 of 12.5 ms looks like a stall: no time is told meanwhile."""
    rng = np.random.default_rng(2)
    device, true = stream(80.0, 20.0, 30e-6)
    host = arrivals(true, 1e6 + rng.exponential(3e5, len(true)))
    device = device - 5_000_000 * (np.arange(len(device)) >= 800)
    _, status = run(device, host)
    jump = status.index(ElementStatus.JUMP)
    assert set(status[:800]) == {ElementStatus.USABLE}
    assert set(status[800:jump]) == {ElementStatus.DOUBTFUL}
    assert jump < 860
    assert set(status[jump + 1 :]) == {ElementStatus.USABLE}


def test_a_stall_of_the_transport_is_no_jump():
    rng = np.random.default_rng(3)
    device, true = stream(80.0, 20.0, -60e-6)
    delay = 1e6 + rng.exponential(3e5, len(true))
    for start in (4e9, 9e9, 15e9):
        held = (true >= start) & (true < start + 0.7e9)
        delay = np.where(held, np.maximum(delay, start + 0.7e9 - true), delay)
    monitor, status = run(device, arrivals(true, delay))
    assert set(status) == {ElementStatus.USABLE}
    error = monitor.clock.to_other_ns(int(device[-1])) - int(true[-1]) - 1_000_000
    assert abs(error) < 30_000


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_counts_of_lost_doubled_and_late_elements(seed):
    rng = np.random.default_rng(seed)
    numbers = np.arange(1, 400)
    lost = np.unique(rng.choice(np.arange(20, 380, 4), 9, replace=False))
    kept = numbers[~np.isin(numbers, lost)].tolist()
    twice = int(rng.integers(50, 100))
    kept.insert(kept.index(kept[twice]) + 3, kept[twice])
    late = int(rng.integers(150, 300))
    kept[late], kept[late + 1] = kept[late + 1], kept[late]
    monitor = StreamMonitor()
    status = [monitor.check(k, k * 10**7, k * 10**7 + 5 * 10**6) for k in kept]
    counts = monitor.counts
    assert counts.n_missing == len(lost)
    assert counts.n_duplicates == 1 and status.count(ElementStatus.DUPLICATE) == 1
    assert counts.n_late == 1 and status.count(ElementStatus.LATE) == 1
    assert counts.n_jumps == counts.n_doubtful == 0
    assert counts.n_elements == len(kept)
    assert f"{len(lost)} lost" in counts.words


def test_a_count_that_wraps_is_no_jump_of_the_clock():
    monitor = StreamMonitor()
    for k in range(300):
        number = (65400 + k) % 65536
        status = monitor.check(number, k * 10**7, k * 10**7 + 10**6)
        assert status == ElementStatus.USABLE
    assert monitor.counts.n_restarts == 1 and monitor.counts.n_jumps == 0


@pytest.mark.parametrize("first", [0, 300])
def test_a_device_that_was_started_anew_goes_on_at_once(first):
    """Count and clock begin at their start again, early in the stream."""
    monitor = StreamMonitor()
    for k in range(400):
        monitor.check(first + k, k * 10**7, k * 10**7 + 10**6)
    assert monitor.clock.to_other_ns(390 * 10**7) == 390 * 10**7 + 10**6
    status = [
        monitor.check(k, k * 10**7 + 5, (k + 500) * 10**7 + 10**6) for k in range(first, first + 80)
    ]
    assert status[0] == ElementStatus.JUMP
    assert set(status[1:]) == {ElementStatus.USABLE}
    assert monitor.counts.n_restarts == 1 and monitor.counts.n_duplicates == 0
    found = monitor.clock.to_other_ns((first + 79) * 10**7 + 5)
    assert found == pytest.approx((first + 579) * 10**7 + 10**6, abs=3)


def test_an_hour_of_state_does_not_grow_and_takes_microseconds():
    monitor = StreamMonitor()
    start = time.process_time()
    n = 60_000
    for k in range(n):
        monitor.check(k, k * 10**6, k * 1_000_050 + (k * 7919) % 300_000)
    assert (time.process_time() - start) / n < 50e-6
    assert len(monitor.clock._blocks) <= 65
    assert len(monitor._seen) <= 1024
