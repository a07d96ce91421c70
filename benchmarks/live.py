# SPDX-License-Identifier: Apache-2.0
"""A live scan of rendered images: recorded, measured and shown; what is lost, late and used.

Command: ``python benchmarks/live.py [--cameras 1|2] [--rate 80] [--seconds 60] [--record-only]
[--compression auto|raw|zstd] [--folder /dev/shm] [--by-time] [--reconstruct]``, and with
``--budget --rate 4`` the processor time of each part an exposure: recorded as it is, recorded
packed, recorded and measured.

A process of its own holds rendered images of a plate in memory (2658x800; the thesis's head of one
line, or of eleven lines before two cameras). At each trigger it copies one a camera into a ring of
shared memory, as a camera's driver does, and sends a sample of the arm by the documented stream.
This process drives `LiveSession` on them, records to a file in a temporary folder, and asks for the
cloud twenty times a second, as a page does. From exposure to screen: until the cloud that holds the
instant was handed out. Simulated; the arm and all clocks are one computer's. With ``--by-time``
exposures are placed by clocks that have to be learned, not by triggers' ids; ``--reconstruct`` also
reads the recording again and places all of it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

import numpy as np

from armscan.devices.inbox import Inbox
from armscan.devices.matching import MatchedInstant
from armscan.devices.protocols import ArmSample, CameraSettings, Frame, TriggerMode
from armscan.devices.registry import open_device
from armscan.drivers.arm_stream import encode_sample
from armscan.geometry.arrays import ImageArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.live.recorder import LiveRecorder
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.pipeline.live.session import LiveSession
from armscan.pipeline.measure import reconstruct
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.pipeline.simulate import TwinName
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure, SensorWindow
from armscan.records.recording import CameraSetup
from armscan.storage.recording import read_recording
from armscan.storage.recordings.write_mcap import WriterOptions
from rigs.true_scanner import true_scanner

HEADS = {1: "thesis-single", 2: "thesis-multi"}
N_IMAGES = 8
SLOTS = 24
WINDOW = SensorWindow(207, 624)
"""Where the scanning window of the twin's heads lies."""
SHOWN_EVERY_S = 0.05


def serve(place: str, ring: str, pipes: Sequence[Connection], rate_hz: float) -> None:
    """The source: images into the ring, samples of the arm over TCP, until it is told to end."""
    with np.load(place) as found:
        images, rotations, places = found["images"], found["rotations"], found["places"]
    poses: list[Pose[Base, Tool]] = [Pose(*one) for one in zip(rotations, places, strict=True)]
    memory = SharedMemory(ring)
    slots: Any = np.ndarray((SLOTS, *images.shape[1:]), images.dtype, buffer=memory.buf)
    there_and_back = [*range(len(images)), *range(len(images) - 2, 0, -1)]
    with socket.create_server(("127.0.0.1", 0)) as server:
        pipes[0].send(server.getsockname()[1])
        arm = server.accept()[0]
    arm.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # one pose before the first trigger: whoever connects waits for it
    arm.sendall(encode_sample(ArmSample(0, time.monotonic_ns(), 0, poses[0])))
    pipes[0].recv()
    begun_ns, cpu, k = time.monotonic_ns() + 100_000_000, time.process_time(), 0
    while not pipes[0].poll():
        t_ns = begun_ns + round(1e9 * k / rate_hz)
        time.sleep(max(1e-9 * (t_ns - time.monotonic_ns()), 0.0))
        row = there_and_back[k % len(there_and_back)]
        arm.sendall(encode_sample(ArmSample(k + 1, t_ns, 0, poses[row], trigger_id=k)))
        slots[k % SLOTS] = images[row]
        for pipe in pipes:
            pipe.send((k, t_ns))
        k += 1
    pipes[0].recv()
    seconds = 1e-9 * (time.monotonic_ns() - begun_ns)
    for pipe in pipes:
        pipe.send(("end", (k, (time.process_time() - cpu) / seconds)))
    pipes[0].recv()
    arm.close()
    memory.close()


class RingCamera:
    """See `armscan.devices.protocols.Camera`: copies each image out of the ring when told of it."""

    is_simulated = True

    def __init__(self, camera: int, slots: Any, pipe: Connection) -> None:
        self.name, self.settings = f"ring camera {camera}", CameraSettings()
        height, width = slots.shape[-2:]
        self.setup = CameraSetup(width, height, WINDOW)
        self.taken_ns: dict[int, int] = {}
        self._camera, self._slots, self._pipe = camera, slots, pipe
        self._inbox: Inbox[Frame] = Inbox(self.name, 256)
        self.told: tuple[int, float] = (0, 0.0)
        self._thread = threading.Thread(target=self._receive, daemon=True)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        return self.settings

    def start(self, trigger: TriggerMode = "free") -> None:
        if self._camera == 0:
            self._pipe.send("go")
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        return self._inbox.take(timeout_s)

    def stop(self) -> None:
        if self._camera == 0:
            self._pipe.send("stop")
        self._thread.join(10.0)

    def close(self) -> None:
        self._inbox.close()

    def let_go(self) -> None:
        self._slots = None

    def _receive(self) -> None:
        try:
            while True:
                k, told = self._pipe.recv()
                if k == "end":
                    self.told = told
                    return
                image: ImageArray = self._slots[k % SLOTS, self._camera].copy()
                now_ns = time.monotonic_ns()
                self.taken_ns[k] = told
                self._inbox.put(
                    Frame(image, k, told, now_ns, trigger_id=k, lasers=("A",), window=WINDOW)
                )
        except (EOFError, OSError):
            return


class CountingRecorder(LiveRecorder):
    """Counts also which instants had a pose, and why others had none."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.poses: Counter[str] = Counter()

    def add_instant(self, instant: MatchedInstant) -> None:
        self.poses[instant.status.label] += 1
        super().add_instant(instant)


class Screen(threading.Thread):
    """Asks for the cloud as a page does, and notes when it first holds an instant."""

    def __init__(self, taken_ns: dict[int, int]) -> None:
        super().__init__(daemon=True)
        self._taken_ns = taken_ns
        self._new: list[int] = []
        self._is_over = threading.Event()
        self.latencies_ms: list[float] = []

    def look_at(self, session: LiveSession) -> None:
        self._session = session
        self.start()

    def keep(self, number: int, cloud: PointCloud) -> None:
        self._new.append(int(cloud.exposure_sources[0].rpartition(" ")[2]))

    def run(self) -> None:
        while not self._is_over.wait(SHOWN_EVERY_S):
            new, self._new = self._new, []
            self._session.snapshot()
            self._session.cloud()
            now_ns = time.monotonic_ns()
            self.latencies_ms += [(now_ns - self._taken_ns[k]) / 1e6 for k in new]

    def end(self) -> None:
        self._is_over.set()
        self.join()


def rendered(head: str, folder: Path) -> tuple[str, tuple[int, ...]]:
    """Images (N, cameras, H, W) of a pass over the plate and the poses of the arm, in a file."""
    scan = TwinName(head, "thesis", 1).build().scan("plate")
    n_cameras = len(scan.session.cameras)
    rows = range(min(N_IMAGES * n_cameras, len(scan.rows)))
    images = np.stack([scan.exposure(row).image for row in rows])
    images = images.reshape(-1, n_cameras, *images.shape[1:])
    arm = scan.arm
    if arm is None or arm.trigger_ids is None:
        raise ValueError("the scene has no triggered arm")
    of_trigger = {int(one): k for k, one in enumerate(arm.trigger_ids)}
    poses = [arm.pose(of_trigger[scan.rows[row].trigger_id or 0]) for row in rows[::n_cameras]]
    np.savez(
        folder / "images.npz",
        images=images,
        rotations=np.array([one.rotation for one in poses]),
        places=np.array([one.translation_mm for one in poses]),
    )
    return str(folder / "images.npz"), images.shape


def warm_up(scanner: ScannerCalibration, place: str) -> None:
    """Load what is compiled, which takes a second or two once a process."""
    if scanner.sensor is None:
        raise ValueError("a scanner without camera")
    with np.load(place) as found:
        pair = [Exposure(image, "first", window=WINDOW) for image in found["images"][0]]
    reconstruct(pair[:1], scanner.sensor, rights=pair[1:])


def placed_again(path: Path, scanner: ScannerCalibration) -> str:
    """What becomes of each exposure of the recording when it is read again."""
    source = read_recording(path)
    found = measure_scan(source, scanner, ScanOptions(has_normals=False))
    counts = Counter(one.status.value for one in found.exposures)
    return f"read again: {dict(counts)} of {len(source.rows)} listed; {source.warnings}"


def words(label: str, values: Sequence[float], unit: str) -> str:
    if not values:
        return f"{label}: none"
    median, most = np.median(values), np.quantile(values, 0.95)
    return f"{label}: median {median:.0f}, 95 % {most:.0f} {unit}"


def run(given: argparse.Namespace, folder: Path, place: str, shape: tuple[int, ...]) -> None:
    """One scan, and what came of it."""
    n_cameras, seconds = given.cameras, given.seconds
    scanner = None
    if not given.record_only:
        scanner = true_scanner(TwinName(HEADS[n_cameras], "thesis", 1).build())
        warm_up(scanner, place)
    ring = SharedMemory(create=True, size=SLOTS * int(np.prod(shape[1:])))
    slots: Any = np.ndarray((SLOTS, *shape[1:]), np.uint8, buffer=ring.buf)
    ends = [multiprocessing.Pipe() for _ in range(n_cameras)]
    source = multiprocessing.get_context("spawn").Process(
        target=serve, args=(place, ring.name, [one[1] for one in ends], given.rate)
    )
    source.start()
    cameras: list[Any] = [RingCamera(k, slots, ends[k][0]) for k in range(n_cameras)]
    arm = open_device("arm", f"tcp:127.0.0.1:{ends[0][0].recv()}")
    description = RigDescription(("ring",) * n_cameras, rate_hz=given.rate, is_common_trigger=True)
    description = replace(description, is_common_trigger=not given.by_time)
    rig = Rig(cameras, arm, None, description)
    path = folder / "scan.mcap"
    recorder = CountingRecorder(path, rig, options=WriterOptions(compression=given.compression))
    recorder.begin()
    screen = Screen(cameras[0].taken_ns)
    session = LiveSession(rig, scanner, recorder=recorder, keep_cloud=screen.keep)
    screen.look_at(session)
    session.add_listener(
        lambda one: print(one.kind, one.text) if one.kind in ("fault", "warning") else None
    )
    load, cpu, start = os.getloadavg()[0], time.process_time(), time.monotonic()
    session.open()
    while given.by_time and not session.is_timed:
        time.sleep(0.01)
    session.start()
    time.sleep(seconds)
    session.stop()
    taken_s = time.monotonic() - start
    end = recorder.close()
    cpu = (time.process_time() - cpu) / taken_s
    screen.end()
    n_sent, source_share = cameras[0].told
    ends[0][0].send("done")
    source.join()
    rig.close()
    counts, snapshot = session.stream_counts, session.snapshot()
    live = {one.value: n for one, n in snapshot.counts.items()}
    print(
        f"{n_cameras} cameras, {given.rate:g}/s, {seconds:g} s, {os.cpu_count()} cores, "
        f"load before {load:.1f}, {given.compression}, "
        f"{'recorded only' if scanner is None else 'recorded and measured'}\n"
        f"triggers {n_sent}; exposures recorded {end.n_written} of {n_sent * n_cameras}, lost "
        f"{sum(one.n_missing for one in counts[:n_cameras])}, aside {recorder.n_aside}\n"
        f"live: {live}, {snapshot.n_points} points; streams {snapshot.streams}\n"
        f"poses: {dict(recorder.poses)}\n"
        f"{words('exposure to screen', screen.latencies_ms, 'ms')}\n"
        f"source process {100 * source_share:.0f} %, this process {100 * cpu:.0f} % of a core, "
        f"{1e3 * cpu * taken_s / max(n_sent * n_cameras, 1):.1f} ms an exposure\n"
        f"disk {end.n_bytes / 1e6 / taken_s:.0f} MB/s "
        f"(pixels {n_sent * np.prod(shape[1:]) / 1e6 / taken_s:.0f} MB/s); "
        f"the recorder waited {end.n_waits} times; whole after {taken_s:.1f} s"
    )
    if given.reconstruct and scanner is not None:
        print(placed_again(path, scanner))
    del slots
    path.unlink()
    for camera in cameras:
        camera.let_go()
    ring.close()
    ring.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description="A live scan of rendered images.")
    parser.add_argument("--cameras", type=int, default=1, choices=(1, 2))
    parser.add_argument("--rate", type=float, default=80.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--record-only", action="store_true")
    parser.add_argument("--compression", default="auto", choices=("auto", "raw", "zstd"))
    parser.add_argument("--by-time", action="store_true", help="placed by clocks, not by ids")
    parser.add_argument("--reconstruct", action="store_true", help="place the recording again")
    parser.add_argument("--budget", action="store_true", help="what each part takes, one by one")
    parser.add_argument("--folder", default=None, help="where the recording is made and removed")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="armscan-live-", dir=given.folder) as folder:
        place, shape = rendered(HEADS[given.cameras], Path(folder))
        if not given.budget:
            run(given, Path(folder), place, shape)
            return
        for compression, record_only in (("raw", True), ("zstd", True), ("raw", False)):
            given.compression, given.record_only = compression, record_only
            run(given, Path(folder), place, shape)


if __name__ == "__main__":
    main()
