# SPDX-License-Identifier: Apache-2.0
"""An arm that sends frames over TCP or serial; ``docs/reference/arm-stream.md`` has the bytes.

A frame whose checksum or content is wrong gives no sample. What follows it is found again by the
four bytes with which each frame begins.
"""

from __future__ import annotations

import errno
import socket
import struct
import threading
import time
import zlib
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.devices.inbox import Inbox
from armscan.devices.protocols import Arm, ArmFlag, ArmSample, DeviceInfo, DeviceKind
from armscan.devices.registry import needed_package
from armscan.errors import DeviceError, DeviceTakenError, InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.records.recording import PoseForm

MAGIC = b"\xa5ARM"
VERSION = 1
HAS_POSE, HAS_JOINTS = 1, 2
HEADER = struct.Struct("<4sBBHIqHHI")
"""Magic, version, content, payload bytes, number, time in ns, buttons, flags, trigger."""
CHECKSUM = struct.Struct("<I")
N_POSE = 7
MOST_JOINTS = 12
NO_TRIGGER_ID = 0xFFFFFFFF
_COUNT = 1 << 32
_QUATERNION_TOLERANCE = 1e-6
_LARGEST_MM, _LARGEST_RAD = 1e5, 1e3
"""Farther reaches no arm, and no joint turns so far."""
_MOST_SAMPLES = 20_000
_FIRST_S, _AGAIN_S, _CONNECT_S = 2.0, 0.5, 3.0
_READ_S, _READ_BYTES = 0.05, 65_536
KEEPALIVE = {"TCP_KEEPIDLE": 3, "TCP_KEEPALIVE": 3, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 7}
"""After 3 s of silence the other side's system is asked once a second whether the connection is
there, and it has ended where none of 7 questions is answered. Silence alone ends nothing: an arm
may wait for its next trigger. Names are those of systems, which lack some."""
_WRITE_S = 1.0
"""A device that takes no byte for so long hangs: who writes to it must not."""


def encode_sample(sample: ArmSample) -> bytes:
    """The frame of one sample; its time of arrival is left out.

    Raises
    ------
    InputError
        If it has more than 12 joints, or values that are not finite.
    """
    content, values = 0, np.zeros(0)
    if sample.pose is not None:
        content |= HAS_POSE
        quaternion = np.roll(Rotation.from_matrix(sample.pose.rotation).as_quat(), 1)
        values = np.concatenate([sample.pose.translation_mm, quaternion])
    if sample.joints_rad is not None:
        content |= HAS_JOINTS
        values = np.concatenate([values, sample.joints_rad])
    n_joints = 0 if sample.joints_rad is None else len(sample.joints_rad)
    if n_joints > MOST_JOINTS or not np.isfinite(values).all():
        raise InputError(f"a sample of {n_joints} joints with {values} cannot be sent")
    trigger = NO_TRIGGER_ID if sample.trigger_id is None else sample.trigger_id % _COUNT
    head = HEADER.pack(
        MAGIC,
        VERSION,
        content,
        8 * len(values),
        sample.number % _COUNT,
        sample.t_device_ns,
        sample.buttons & 0xFFFF,
        int(sample.flags) & 0xFFFF,
        trigger,
    )
    body = head + values.astype("<f8").tobytes()
    return body + CHECKSUM.pack(zlib.crc32(body))


class ArmStreamDecoder:
    """Finds the frames in what arrives, in pieces of any length.

    Attributes
    ----------
    n_corrupt
        Frames whose checksum or content was wrong.
    n_skipped
        Bytes that belong to no frame.
    n_lost
        Frames that the sender counted and that did not come.
    """

    def __init__(self) -> None:
        self.n_corrupt = 0
        self.n_skipped = 0
        self.n_lost = 0
        self._bytes = bytearray()
        self._last: int | None = None

    def feed(self, received: bytes, t_host_ns: int) -> list[ArmSample]:
        """Samples that are complete now, with their time of arrival."""
        self._bytes += received
        samples: list[ArmSample] = []
        while True:
            start = self._bytes.find(MAGIC)
            if start < 0:
                self._skip(max(len(self._bytes) - len(MAGIC) + 1, 0))
                return samples
            self._skip(start)
            if len(self._bytes) < HEADER.size:
                return samples
            length = self._length()
            if length is None:
                self._reject()
            elif len(self._bytes) < length:
                return samples
            else:
                frame = bytes(self._bytes[:length])
                sample = self._sample(frame, t_host_ns)
                if sample is None:
                    self._reject()
                else:
                    del self._bytes[:length]
                    samples.append(sample)

    def _skip(self, n_bytes: int) -> None:
        self.n_skipped += n_bytes
        del self._bytes[:n_bytes]

    def _reject(self) -> None:
        """What follows may hold the beginning of a sound frame: skip one byte only."""
        self.n_corrupt += 1
        self._skip(1)

    def _length(self) -> int | None:
        """Bytes of the frame that begins here; None if its header cannot be one."""
        _, version, content, n_bytes, *_ = HEADER.unpack_from(self._bytes)
        least = 8 * N_POSE if content & HAS_POSE else 0
        n_joints, rest = divmod(n_bytes - least, 8)
        is_sound = version == VERSION and content <= (HAS_POSE | HAS_JOINTS) and rest == 0
        has_joints = bool(content & HAS_JOINTS)
        if not is_sound or not (1 <= n_joints <= MOST_JOINTS if has_joints else n_joints == 0):
            return None
        return int(HEADER.size + n_bytes + CHECKSUM.size)

    def _sample(self, frame: bytes, t_host_ns: int) -> ArmSample | None:
        body = frame[: -CHECKSUM.size]
        if zlib.crc32(body) != CHECKSUM.unpack(frame[-CHECKSUM.size :])[0]:
            return None
        _, _, content, _, count, t_ns, buttons, flags, trigger = HEADER.unpack_from(body)
        values = np.frombuffer(body, dtype="<f8", offset=HEADER.size).astype(np.float64)
        pose, joints = None, None
        if content & HAS_POSE:
            pose, values = _pose(values[:N_POSE]), values[N_POSE:]
            if pose is None:
                return None
        if content & HAS_JOINTS:
            if not (np.abs(values) < _LARGEST_RAD).all():
                return None
            joints = values
        trigger_id = None if trigger == NO_TRIGGER_ID else int(trigger)
        number = self._number(count)
        return ArmSample(
            number, t_ns, t_host_ns, pose, joints, buttons, ArmFlag(flags & _KNOWN), trigger_id
        )

    def _number(self, count: int) -> int:
        """The count without its turn at 2**32."""
        if self._last is None:
            number = count
        else:
            step = (count - self._last + _COUNT // 2) % _COUNT - _COUNT // 2
            number = self._last + step
            self.n_lost += max(step - 1, 0)
        self._last = number
        return number


_KNOWN = int(ArmFlag.AT_REST | ArmFlag.REFERENCED | ArmFlag.END_STOP | ArmFlag.INACCURATE)


def _pose(values: FloatArray) -> Pose[Base, Tool] | None:
    """A pose of x, y, z, qw, qx, qy, qz; None if it is none."""
    norm = float(np.linalg.norm(values[3:]))
    is_near = bool((np.abs(values[:3]) < _LARGEST_MM).all())
    if not is_near or not abs(norm - 1.0) < _QUATERNION_TOLERANCE:
        return None
    return Pose(Rotation.from_quat(np.roll(values[3:], -1)).as_matrix(), values[:3])


class Link(Protocol):
    """Bytes from a device."""

    def read(self) -> bytes:
        """What came; empty if nothing did for a while. Raises `OSError` where the link ended."""

    def close(self) -> None:
        """Give it back."""


class TcpLink:
    """A connection to ``HOST:PORT``."""

    def __init__(self, place: str) -> None:
        host, _, port = place.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
            raise OptionError(
                f"'{place}' is no host and port", remedy="write tcp:HOST:PORT, as tcp:10.0.0.5:4712"
            )
        try:
            self._socket = socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S)
        except OSError as error:
            raise DeviceError(
                f"no connection ({error.strerror or error})",
                where=f"tcp:{place}",
                remedy="check that the arm's program runs and the address is right",
            ) from error
        self._socket.settimeout(_READ_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in KEEPALIVE.items():
            if hasattr(socket, name):
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def read(self) -> bytes:
        """What came; raises `OSError` where the other side closed, or is not there any more."""
        try:
            received = self._socket.recv(_READ_BYTES)
        except TimeoutError as error:
            if error.errno is not None:
                # of the system, for which the connection has ended; our own wait has no number
                raise
            return b""
        if not received:
            raise ConnectionError("the other side closed the connection")
        return received

    def close(self) -> None:
        """Close it."""
        self._socket.close()


class SerialLink:
    """A serial port ``PORT:BAUD``, 115200 baud if none is given, 8 bits, no parity."""

    def __init__(self, place: str) -> None:
        serial = needed_package("serial", "pip install 'armscan[serial]'")
        port, _, baud = place.rpartition(":")
        if not port or not baud.isdecimal():
            port, baud = place, "115200"
        if not port or not 0 < int(baud) <= 20_000_000:
            raise OptionError(
                f"'{place}' is no serial port", remedy="write PORT:BAUD, as /dev/ttyUSB0:921600"
            )
        try:
            self._port = serial.Serial(
                port, int(baud), timeout=_READ_S, write_timeout=_WRITE_S, exclusive=True
            )
        except (OSError, ValueError) as error:
            code = getattr(error, "errno", None)
            text = str(error).lower()
            if code in (errno.EBUSY, errno.EAGAIN) or "lock" in text or "denied" in text:
                raise DeviceTakenError(
                    f"the port cannot be opened ({error})",
                    where=port,
                    remedy="close the other program, or ask for the right to use the port",
                ) from error
            raise DeviceError(
                f"the port cannot be opened ({error})", where=port, remedy="check its name"
            ) from error

    def read(self) -> bytes:
        """What came; raises `OSError` where the port is gone."""
        return bytes(self._port.read(max(1, self._port.in_waiting)))

    def write(self, sent: bytes) -> None:
        """Send; raises `OSError` where the port is gone, or takes nothing any more."""
        self._port.write(sent)

    def close(self) -> None:
        """Close it."""
        self._port.close()


class StreamedArm:
    """See `armscan.devices.protocols.Arm`.

    A connection that ends is told of by `read`, and opened again when the arm is there again.
    """

    def __init__(self, scheme: type[TcpLink] | type[SerialLink], place: str) -> None:
        self._scheme, self._place = scheme, place
        self.name = f"arm {place}"
        self.decoder = ArmStreamDecoder()
        self._inbox: Inbox[ArmSample] = Inbox(self.name, _MOST_SAMPLES)
        self._is_started = False
        self._is_closed = False
        self._link: Link | None = scheme(place)
        first = self._first(self._link)
        by_joints = first.pose is None and first.joints_rad is not None
        self._form: PoseForm = "joints" if by_joints else "quaternion"
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def pose_form(self) -> PoseForm:
        """``joints`` where joint angles alone came first, of a referenced arm if one was seen."""
        return self._form

    def start(self) -> None:
        """Begin to deliver samples."""
        self._inbox.check_open()
        if not self._is_started:
            self._inbox.clear()
        self._is_started = True

    def read(self, timeout_s: float) -> tuple[ArmSample, ...]:
        """All samples that came since the last call; waits for the first."""
        return self._inbox.take_all(timeout_s)

    def stop(self) -> None:
        """Take no more; what was taken can still be read."""
        self._inbox.check_open()
        self._is_started = False

    def close(self) -> None:
        """Give the arm back. Does nothing the second time."""
        if not self._is_closed:
            self._is_closed = True
            self._thread.join()
            self._inbox.close()

    def _first(self, link: Link) -> ArmSample:
        """Wait for one frame, so that a wrong baud rate or address shows at once.

        It is the first that shows what the arm delivers, if one comes: an arm that is not
        referenced yet may send nothing, or joint angles alone.
        """
        n_bytes, end_s = 0, time.monotonic() + _FIRST_S
        last: ArmSample | None = None
        try:
            while time.monotonic() < end_s:
                received = link.read()
                n_bytes += len(received)
                for one in self.decoder.feed(received, time.monotonic_ns()):
                    has_joints = one.joints_rad is not None
                    if one.pose is not None or (has_joints and ArmFlag.REFERENCED in one.flags):
                        return one
                    last = one if has_joints or last is None else last
            if last is not None:
                return last
            fact = f"{n_bytes} bytes came within {_FIRST_S:g} s, but no frame of an arm"
            remedy = "check baud rate and address; the frames are in docs/reference/arm-stream.md"
            raise DeviceError(fact, where=self.name, remedy=remedy)
        except OSError as error:
            link.close()
            raise DeviceError(f"the connection ended ({error})", where=self.name) from error
        except DeviceError:
            link.close()
            raise

    def _run(self) -> None:
        has_ended = False
        while not self._is_closed:
            if self._link is None:
                self._connect_again()
                continue
            try:
                received = self._link.read()
            except Exception as error:
                # drivers of serial adapters raise whatever they like when they are pulled out
                self._link.close()
                self._link, has_ended = None, True
                self._inbox.fail(DeviceError(f"the connection ended ({error})", where=self.name))
                continue
            for sample in self.decoder.feed(received, time.monotonic_ns()):
                if has_ended:
                    self._inbox.fail(None)
                    has_ended = False
                if self._is_started:
                    self._inbox.put(sample)
        if self._link is not None:
            self._link.close()

    def _connect_again(self) -> None:
        try:
            self._link = self._scheme(self._place)
        except DeviceError:
            end_s = time.monotonic() + _AGAIN_S
            while not self._is_closed and time.monotonic() < end_s:
                time.sleep(_READ_S)


@dataclass(frozen=True, slots=True)
class ArmStreamDriver:
    """Opens ``tcp:HOST:PORT`` or ``serial:PORT:BAUD``."""

    link: Any
    kinds: tuple[DeviceKind, ...] = ("arm",)

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Nothing: a port does not say what is behind it."""
        if self.link is SerialLink:
            needed_package("serial", "pip install 'armscan[serial]'")
        return ()

    def open(self, kind: DeviceKind, place: str) -> Arm:
        """Connect to the arm at a place."""
        return StreamedArm(self.link, place)


TCP = ArmStreamDriver(TcpLink)
SERIAL = ArmStreamDriver(SerialLink)
