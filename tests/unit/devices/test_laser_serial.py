# SPDX-License-Identifier: Apache-2.0
"""The laser controller's driver against firmware of the documented protocol."""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Iterator

import numpy as np
import pytest

from armscan.devices.protocols import LaserController, LaserEvent
from armscan.devices.registry import open_device
from armscan.drivers.arm_stream import SerialLink
from armscan.drivers.laser_serial import framed, unframed
from armscan.errors import DeviceError, DeviceStoppedError, DeviceTakenError, OptionError
from rigs.laser_controller import ReferenceController

pytest.importorskip("serial")


@pytest.fixture
def firmware() -> Iterator[ReferenceController]:
    running = ReferenceController()
    yield running
    running.end()


def events(lasers: LaserController, n: int) -> list[LaserEvent]:
    came: list[LaserEvent] = []
    end = time.monotonic() + 5.0
    while len(came) < n and time.monotonic() < end:
        came += lasers.read(0.1)
    return came


def test_a_line_is_the_page_s_example() -> None:
    # CRC-16/CCITT-FALSE of "123456789" is 29B1 in every list of CRCs
    assert framed("123456789") == b"123456789*29B1\n"
    assert unframed(b"123456789*29B1\r") == "123456789"
    for line in (b"", b"*", b"123456789*29B2", b"123456789*29b1", b"12345678929B1", b"\xff*FF00"):
        assert unframed(line) is None
    rng = np.random.default_rng(1)
    sound = framed("17 SCHED A;B;A+B;-")[:-1]
    for _ in range(2000):
        damaged = bytearray(sound)
        for bit in rng.integers(8 * len(damaged), size=int(rng.integers(1, 4))):
            damaged[bit // 8] ^= 1 << int(bit % 8)
        assert bytes(damaged) == sound or unframed(bytes(damaged)) is None


def test_a_schedule_runs_and_what_was_on_is_told(firmware: ReferenceController) -> None:
    lasers = open_device("lasers", firmware.address)
    assert lasers.sources == ("A", "B")
    assert not firmware.is_on
    lasers.set_schedule([("A",), ("B",), ("A", "B"), ()])
    lasers.start(100.0)
    came = events(lasers, 9)
    assert [one.trigger_id for one in came] == list(range(1, len(came) + 1))
    wanted = [("A",), ("B",), ("A", "B"), ()] * 5
    assert [one.lasers for one in came] == wanted[: len(came)]
    steps = np.diff([one.t_device_ns for one in came])
    assert abs(np.median(steps) - 10_000_000) < 3_000_000
    lasers.set_next(("B",))
    time.sleep(0.05)
    lasers.read(0.0)
    assert {one.lasers for one in events(lasers, 3)} == {("B",)}
    lasers.stop()
    assert not firmware.is_on
    while lasers.read(0.1):
        """Told before the stop."""
    lasers.start(None)
    assert lasers.read(0.05) == ()
    firmware.trigger()
    assert len(events(lasers, 1)) == 1
    lasers.close()
    lasers.close()
    assert not firmware.is_on
    with pytest.raises(DeviceError, match="closed"):
        lasers.read(0.0)


def test_damaged_lines_are_asked_again_or_leave_a_gap(firmware: ReferenceController) -> None:
    firmware.spoils_in, firmware.spoils_out = 1, 1
    lasers = open_device("lasers", firmware.address)
    lasers.set_schedule([("A",)])
    lasers.start(50.0)
    events(lasers, 2)
    firmware.spoils_out = 2
    came = events(lasers, 6)
    steps = np.diff([one.trigger_id for one in came])
    lasers.close()
    assert {one.lasers for one in came} == {("A",)}
    assert lasers.n_damaged >= 3  # type: ignore[attr-defined]
    assert max(steps) in (2, 3) or came[0].trigger_id > 3


def test_lasers_stay_on_while_the_host_lives_and_go_off_where_it_is_silent(
    firmware: ReferenceController,
) -> None:
    lasers = open_device("lasers", firmware.address)
    lasers.set_schedule([("A",)])
    lasers.start(20.0)
    time.sleep(1.4)
    assert firmware.is_on
    firmware.spoils_in = 1000
    time.sleep(1.3)
    assert not firmware.is_on
    with pytest.raises(DeviceError, match=r"switched the lasers off|no answer"):
        while True:
            lasers.read(0.1)
    firmware.spoils_in = 0
    lasers.start(20.0)
    assert events(lasers, 2)
    lasers.close()


def test_lasers_that_went_off_by_themselves_stay_off_until_they_are_started(
    firmware: ReferenceController,
) -> None:
    lasers = open_device("lasers", firmware.address)
    lasers.set_schedule([("A",)])
    lasers.start(20.0)
    firmware.say("OFF WATCHDOG")
    for _ in range(2):
        with pytest.raises(DeviceStoppedError, match=r"switched the lasers off; start it again"):
            while True:
                lasers.read(0.1)
    lasers.start(20.0)
    assert events(lasers, 2)
    lasers.close()


def test_a_silence_that_is_over_is_no_fault_any_more(firmware: ReferenceController) -> None:
    lasers = open_device("lasers", firmware.address)
    lasers.set_schedule([("A",)])
    lasers.start(20.0)
    # the controller hears all and its answers are lost: it goes on
    firmware.is_mute = True
    with pytest.raises(DeviceError, match="no answer to PING"):
        while True:
            lasers.read(0.1)
    firmware.is_mute = False
    end = time.monotonic() + 5.0
    found: tuple[LaserEvent, ...] = ()
    while not found and time.monotonic() < end:
        try:
            found = lasers.read(0.1)
        except DeviceError:
            time.sleep(0.01)
    assert found
    time.sleep(0.6)
    for _ in range(50):
        # a fault that stays is raised wherever nothing waits
        lasers.read(0.0)
    lasers.close()


def test_a_port_that_takes_nothing_keeps_nobody_waiting(firmware: ReferenceController) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    link = SerialLink(f"{os.ttyname(slave)}:115200")
    with pytest.raises(OSError, match=r"[Tt]imeout"):
        # nobody reads the other end of the line, whose buffer holds some kilobytes
        link.write(bytes(1_000_000))
    link.close()
    os.close(master)
    os.close(slave)


def test_what_is_no_controller_is_refused(firmware: ReferenceController) -> None:
    lasers = open_device("lasers", firmware.address)
    with pytest.raises(DeviceTakenError):
        open_device("lasers", firmware.address)
    with pytest.raises(OptionError, match="no laser is called 'C'"):
        lasers.set_schedule([("C",)])
    with pytest.raises(OptionError):
        lasers.start(-1.0)
    with pytest.raises(OptionError, match="too long"):
        lasers.set_schedule([("A", "B")] * 100)
    lasers.close()
    firmware.is_mute = True
    with pytest.raises(DeviceError, match="no answer to HELLO"):
        open_device("lasers", firmware.address)
    firmware.is_mute, firmware.sources = False, ""
    with pytest.raises(DeviceError, match="it answers"):
        open_device("lasers", firmware.address)
    with pytest.raises(DeviceError, match="opens laser controllers"):
        open_device("arm", firmware.address)
