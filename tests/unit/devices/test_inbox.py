# SPDX-License-Identifier: Apache-2.0
"""The inbox between a device's thread and its reader."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from armscan.devices.inbox import DeviceClock, FaultyLine, Inbox
from armscan.devices.protocols import Frame
from armscan.errors import DeviceError


def test_elements_keep_their_order_and_wait_until_they_are_due() -> None:
    inbox: Inbox[int] = Inbox("x", 10)
    now = time.monotonic_ns()
    inbox.put(1)
    inbox.put(2, now + 60_000_000)
    inbox.put(3)
    assert inbox.take_all(0.0) == (1,)
    assert inbox.take(0.0) is None
    assert inbox.take_all(1.0) == (2, 3)
    assert time.monotonic_ns() >= now + 60_000_000


def test_where_nobody_reads_the_oldest_are_lost() -> None:
    inbox: Inbox[int] = Inbox("x", 3)
    for k in range(5):
        inbox.put(k)
    assert inbox.take_all(0.0) == (2, 3, 4) and inbox.n_lost == 2


def test_a_fault_is_told_between_what_came_before_and_after() -> None:
    inbox: Inbox[int] = Inbox("x", 10)
    inbox.put(1)
    inbox.fail(DeviceError("gone"))
    inbox.fail(None)
    inbox.put(2)
    assert inbox.take_all(0.0) == (1,)
    with pytest.raises(DeviceError, match="gone"):
        inbox.take(0.0)
    assert inbox.take(0.0) == 2
    assert inbox.take(0.0) is None
    inbox.fail(DeviceError("gone"))
    for _ in range(2):
        with pytest.raises(DeviceError, match="gone"):
            inbox.take(0.0)


def test_a_reader_that_waits_is_woken_by_an_element_a_fault_and_the_close() -> None:
    for wake in (
        lambda inbox: inbox.put(7),
        lambda inbox: inbox.fail(DeviceError("gone")),
        lambda inbox: inbox.close(),
    ):
        inbox: Inbox[int] = Inbox("x", 3)
        threading.Timer(0.05, wake, (inbox,)).start()
        start = time.monotonic()
        try:
            assert inbox.take(10.0) == 7
        except DeviceError as error:
            assert "gone" in str(error) or "closed" in str(error)
        assert time.monotonic() - start < 5.0


@pytest.mark.parametrize("exposure_ns", [0, 2_000_000, 30_000_000])
def test_a_played_frame_arrives_after_the_end_of_its_exposure(exposure_ns: int) -> None:
    clock, rng = DeviceClock(0, 0.0, 0), np.random.default_rng(1)
    line: FaultyLine[Frame] = FaultyLine("f", 4, clock, delay_ns=5_000, spread_ns=0, rng=rng)
    line.open()
    image = np.zeros((1, 1), np.uint8)
    line.send(10**6, Frame(image, 0, 0, 0, exposure_ns=exposure_ns))
    frame = line.inbox.take(1.0)
    assert frame is not None and frame.t_device_ns == 10**6
    assert frame.t_host_ns == 10**6 + exposure_ns // 2 + 5_000
