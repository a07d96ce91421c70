# SPDX-License-Identifier: Apache-2.0
"""The arm's stream: bytes by hand, damage on purpose, loopback and a pseudo-terminal."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import os
import socket
import struct
import threading
import time
import tty
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.devices.protocols import ArmFlag, ArmSample
from armscan.devices.registry import open_device
from armscan.drivers.arm_stream import (
    KEEPALIVE,
    ArmStreamDecoder,
    StreamedArm,
    TcpLink,
    encode_sample,
)
from armscan.errors import DeviceError, DeviceTakenError, InputError, OptionError
from armscan.geometry.poses import Pose

EXAMPLE = Path(__file__).parents[3] / "examples" / "arm_sender.py"


def sample(number: int, seed: int = 0, n_joints: int = 0, **changes: Any) -> ArmSample:
    rng = np.random.default_rng([seed, number])
    pose: Any = Pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1500.0, 1500.0, 3))
    given: dict[str, Any] = {
        "pose": pose,
        "joints_rad": rng.uniform(-3.0, 3.0, n_joints) if n_joints else None,
        "buttons": int(rng.integers(8)),
        "flags": ArmFlag(int(rng.integers(16))),
        "trigger_id": number if number % 3 else None,
    }
    return ArmSample(number, 5_000_000 * number + 7, 0, **(given | changes))


def same(one: ArmSample, other: ArmSample) -> bool:
    """Equal but for rounding: a quaternion keeps a rotation to 1e-15."""
    assert one.number == other.number and one.t_device_ns == other.t_device_ns
    assert (one.buttons, one.flags, one.trigger_id) == (
        other.buttons,
        other.flags,
        other.trigger_id,
    )
    if one.joints_rad is not None or other.joints_rad is not None:
        np.testing.assert_array_equal(one.joints_rad, other.joints_rad)
    if one.pose is not None or other.pose is not None:
        np.testing.assert_array_equal(one.pose.translation_mm, other.pose.translation_mm)
        np.testing.assert_allclose(one.pose.rotation, other.pose.rotation, atol=1e-14)
    return True


def test_the_bytes_are_those_of_the_page() -> None:
    w, x, y, z = 0.5, 0.5, -0.5, 0.5
    body = b"\xa5ARM" + bytes([1, 1]) + struct.pack("<H", 56)
    body += struct.pack("<I", 258) + struct.pack("<q", 1_700_000_000_123_456_789)
    body += struct.pack("<H", 5) + struct.pack("<H", 3) + struct.pack("<I", 77)
    body += struct.pack("<7d", 10.5, -20.25, 300.0, w, x, y, z)
    frame = body + struct.pack("<I", zlib.crc32(body))
    assert len(frame) == 88
    (found,) = ArmStreamDecoder().feed(frame, 42)
    assert (found.number, found.t_device_ns, found.t_host_ns) == (
        258,
        1_700_000_000_123_456_789,
        42,
    )
    assert found.buttons == 5 and found.trigger_id == 77
    assert found.flags == ArmFlag.AT_REST | ArmFlag.REFERENCED
    assert found.pose is not None and found.joints_rad is None
    np.testing.assert_allclose(
        found.pose.rotation, Rotation.from_quat([x, y, z, w]).as_matrix(), atol=1e-15
    )
    assert encode_sample(found) == frame


@pytest.mark.parametrize("n_joints", [0, 1, 6, 7, 12])
def test_what_is_sent_comes_back_in_pieces_of_any_length(n_joints: int) -> None:
    rng = np.random.default_rng(n_joints)
    sent = [sample(k, n_joints=n_joints) for k in range(200)]
    if n_joints:
        sent += [sample(k, n_joints=n_joints, pose=None) for k in range(200, 300)]
    sent.append(sample(len(sent), pose=None))
    stream = b"".join(encode_sample(one) for one in sent)
    decoder, came = ArmStreamDecoder(), []
    while stream:
        n = int(rng.integers(1, 300))
        came += decoder.feed(stream[:n], 0)
        stream = stream[n:]
    assert len(came) == len(sent) and all(map(same, came, sent))
    assert (decoder.n_corrupt, decoder.n_skipped, decoder.n_lost) == (0, 0, 0)


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 179.9999, 180.0])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 3), (-1, -1, 0)])
def test_any_rotation_is_kept(angle_deg: float, axis: tuple[float, ...]) -> None:
    vector = np.radians(angle_deg) * np.array(axis) / np.linalg.norm(axis)
    pose: Any = Pose(Rotation.from_rotvec(vector).as_matrix(), np.zeros(3))
    (found,) = ArmStreamDecoder().feed(encode_sample(sample(0, pose=pose)), 0)
    np.testing.assert_allclose(found.pose.rotation, pose.rotation, atol=1e-14)


def test_damage_never_makes_a_wrong_sample() -> None:
    rng = np.random.default_rng(3)
    n = 3000
    sent = {k: sample(k, n_joints=7 * (k % 2)) for k in range(n)}
    frames = [bytearray(encode_sample(one)) for one in sent.values()]
    damaged = set(rng.choice(n, 900, replace=False).tolist())
    for k in damaged:
        frame, kind = frames[k], rng.integers(5)
        if kind == 0:
            for bit in rng.integers(8 * len(frame), size=int(rng.integers(1, 5))):
                frame[bit // 8] ^= 1 << int(bit % 8)
        elif kind == 1:
            del frame[int(rng.integers(len(frame))) :]
        elif kind == 2:
            del frame[: int(rng.integers(1, len(frame)))]
        elif kind == 3:
            frame[:0] = rng.bytes(int(rng.integers(1, 200)))
        else:
            frame[len(frame) // 2 : len(frame) // 2] = b"\xa5ARM\x01\x01"
    decoder = ArmStreamDecoder()
    came = []
    stream = b"".join(bytes(frame) for frame in frames)
    for start in range(0, len(stream), 1000):
        came += decoder.feed(stream[start : start + 1000], 0)
    for one in came:
        assert same(one, sent[one.number])
    numbers = [one.number for one in came]
    assert numbers == sorted(set(numbers))
    # an undamaged frame is lost only where the header before it claims its bytes
    missing = set(range(n)) - set(numbers)
    assert missing <= damaged
    assert decoder.n_lost == len(missing - set(range(max(numbers), n)) - set(range(numbers[0])))
    assert decoder.n_corrupt > 100


@pytest.mark.parametrize(
    "change",
    [
        {"content": 4},
        {"quaternion": 1.001},
        {"x": np.nan},
        {"x": 1e6},
        {"version": 2},
    ],
)
def test_a_frame_whose_content_cannot_be_is_no_sample(change: dict[str, float]) -> None:
    values = [change.get("x", 1.0), 2.0, 3.0, change.get("quaternion", 1.0), 0.0, 0.0, 0.0]
    body = b"\xa5ARM" + bytes([int(change.get("version", 1)), int(change.get("content", 1))])
    body += struct.pack("<HIqHHI7d", 56, 0, 0, 0, 2, 0xFFFFFFFF, *values)
    wrong = body + struct.pack("<I", zlib.crc32(body))
    decoder = ArmStreamDecoder()
    (found,) = decoder.feed(wrong + encode_sample(sample(1)), 0)
    assert same(found, sample(1)) and decoder.n_corrupt >= 1


def test_the_count_turns_over_and_lost_frames_are_counted() -> None:
    decoder = ArmStreamDecoder()
    numbers = [2**32 - 2, 2**32 - 1, 2**32, 2**32 + 3, 2**32 + 2]
    came = [
        found.number
        for k in numbers
        for found in decoder.feed(encode_sample(sample(k, trigger_id=None)), 0)
    ]
    assert came == numbers and decoder.n_lost == 2
    with pytest.raises(InputError):
        encode_sample(sample(0, joints_rad=np.zeros(13)))


@contextlib.contextmanager
def serving(frames: list[ArmSample]) -> Iterator[str]:
    """Address of a server that sends frames to whoever connects first, then nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        is_over = threading.Event()

        def send() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(b"".join(encode_sample(one) for one in frames))
                is_over.wait(60.0)

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        yield f"tcp:127.0.0.1:{server.getsockname()[1]}"
        is_over.set()
        thread.join()


class FakeClock:
    """Time that passes by reading alone, so that a slow computer changes nothing."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now_s)


class PlayedLink:
    """Frames that come in pieces a tenth of a second apart, then nothing."""

    def __init__(self, clock: FakeClock, pieces: list[list[ArmSample]], place: str) -> None:
        self.clock, self.pieces, self.name = clock, iter(pieces), place

    def read(self) -> bytes:
        self.clock.now_s += 0.1
        return b"".join(encode_sample(one) for one in next(self.pieces, []))

    def close(self) -> None:
        """Nothing is held."""


EMPTY: dict[str, Any] = {"pose": None, "flags": ArmFlag.NONE}
JOINTS: dict[str, Any] = {"pose": None, "n_joints": 6}


@pytest.mark.parametrize(
    ("first", "later", "form"),
    [
        (EMPTY, {}, "quaternion"),
        (EMPTY, {"n_joints": 6}, "quaternion"),
        (EMPTY, JOINTS | {"flags": ArmFlag.REFERENCED}, "joints"),
        (JOINTS | {"flags": ArmFlag.NONE}, {}, "quaternion"),
        (EMPTY, JOINTS | {"flags": ArmFlag.NONE}, "joints"),
        (EMPTY, EMPTY, "quaternion"),
    ],
)
def test_the_first_frame_that_shows_it_says_what_an_arm_delivers(
    first: dict[str, Any], later: dict[str, Any], form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before it is referenced an arm may send neither pose nor joint angles."""
    pieces = [[sample(n, **given), sample(n + 1, **given)] for n, given in ((0, first), (2, later))]
    clock = FakeClock()
    monkeypatch.setattr("armscan.drivers.arm_stream.time", clock)
    link: Any = partial(PlayedLink, clock, pieces)
    arm = StreamedArm(link, "played")
    assert arm.pose_form == form
    arm.close()


def test_a_connection_is_asked_whether_the_other_side_is_there() -> None:
    """A pulled cable ends no connection; an arm that waits for its next trigger is there."""
    with serving([sample(0)]) as address:
        link = TcpLink(address.removeprefix("tcp:"))
        asked = link._socket
        assert asked.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        set_here = {name: seconds for name, seconds in KEEPALIVE.items() if hasattr(socket, name)}
        for name, wanted in set_here.items():
            assert asked.getsockopt(socket.IPPROTO_TCP, getattr(socket, name)) == wanted
        link.close()


class Unanswered:
    """A connection of which the system finds that it has ended."""

    def recv(self, most: int) -> bytes:
        raise TimeoutError(errno.ETIMEDOUT, "Connection timed out")


def test_a_connection_that_the_system_gives_up_has_ended_and_silence_is_none() -> None:
    with serving([]) as address:
        link: Any = TcpLink(address.removeprefix("tcp:"))
        assert link.read() == b""
        link.close()
        link._socket = Unanswered()
        with pytest.raises(OSError, match="timed out"):
            link.read()


class Sender(threading.Thread):
    """A TCP server that sends samples as long as it is told to."""

    def __init__(self, server: socket.socket) -> None:
        super().__init__(daemon=True)
        self.server = server
        self.number, self.wanted = 0, True
        self.start()

    def run(self) -> None:
        while self.wanted:
            client, _ = self.server.accept()
            with client, contextlib.suppress(OSError):
                self.client = client
                while self.wanted:
                    client.sendall(encode_sample(sample(self.number)))
                    self.number += 1
                    time.sleep(0.002)


@pytest.fixture
def sender() -> Iterator[Sender]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        sending = Sender(server)
        yield sending
        sending.wanted = False
        with socket.create_connection(server.getsockname()):
            sending.join()


def test_over_tcp_also_after_the_connection_was_cut(sender: Sender) -> None:
    port = sender.server.getsockname()[1]
    arm = open_device("arm", f"tcp:127.0.0.1:{port}")
    assert arm.pose_form == "quaternion"
    assert arm.read(0.05) == ()
    arm.start()
    came = list(arm.read(1.0))
    assert all(same(one, sample(one.number)) for one in came) and came
    sender.client.shutdown(socket.SHUT_RDWR)
    with pytest.raises(DeviceError, match="connection ended"):
        for _ in range(100):
            arm.read(0.01)
    end = time.monotonic() + 5.0
    again: tuple[ArmSample, ...] = ()
    while not again and time.monotonic() < end:
        try:
            again = arm.read(0.1)
        except DeviceError:
            time.sleep(0.02)
    assert again and same(again[0], sample(again[0].number))
    arm.stop()
    time.sleep(0.05)
    taken = arm.read(0.0)
    assert all(same(one, sample(one.number)) for one in taken)
    assert arm.read(0.05) == ()
    arm.close()
    arm.close()
    with pytest.raises(DeviceError, match="closed"):
        arm.read(0.1)


def test_what_is_no_arm_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def talk() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(b"HTTP/1.1 400 Bad Request\r\n")
                time.sleep(2.5)

        thread = threading.Thread(target=talk, daemon=True)
        thread.start()
        with pytest.raises(DeviceError, match=r"26 bytes came .* no frame"):
            open_device("arm", f"tcp:127.0.0.1:{port}")
        thread.join()
    with pytest.raises(DeviceError, match="no connection"):
        open_device("arm", f"tcp:127.0.0.1:{port}")
    with pytest.raises(OptionError):
        open_device("arm", "tcp:127.0.0.1")
    with pytest.raises(DeviceError, match="opens arms"):
        open_device("camera", "tcp:127.0.0.1:1")


def test_over_a_serial_line() -> None:
    pytest.importorskip("serial")
    master, slave = os.openpty()
    tty.setraw(slave)
    port = os.ttyname(slave)
    wanted = True

    def send() -> None:
        number = 0
        while wanted:
            os.write(master, encode_sample(sample(number)))
            number += 1
            time.sleep(0.005)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    arm = open_device("arm", f"serial:{port}:921600")
    with pytest.raises(DeviceTakenError):
        open_device("arm", f"serial:{port}:921600")
    arm.start()
    came = [one for _ in range(5) for one in arm.read(0.5)]
    arm.close()
    wanted = False
    thread.join()
    os.close(master)
    os.close(slave)
    assert len(came) > 2 and all(same(one, sample(one.number)) for one in came)
    with pytest.raises(DeviceError, match="cannot be opened"):
        open_device("arm", "serial:/dev/no-such-port")


def test_the_example_serves_the_arm_of_the_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    # a busy computer needs its time to build the twin
    monkeypatch.setattr("armscan.drivers.arm_stream._FIRST_S", 60.0)
    found = importlib.util.spec_from_file_location("arm_sender", EXAMPLE)
    assert found is not None and found.loader is not None
    example = importlib.util.module_from_spec(found)
    found.loader.exec_module(example)
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = "twin:thesis-single?scene=plate&loop=1&preset=clean"
        thread = threading.Thread(target=example.serve, args=(server, place, 150), daemon=True)
        thread.start()
        arm = open_device("arm", f"tcp:127.0.0.1:{server.getsockname()[1]}")
        arm.start()
        came: list[ArmSample] = []
        with pytest.raises(DeviceError, match="connection ended"):
            while True:
                came += arm.read(1.0)
        arm.close()
        thread.join()
    assert 100 < len(came) < 160
    assert all(one.pose is not None and len(one.joints_rad) == 7 for one in came)
    assert any(one.trigger_id is not None for one in came)
