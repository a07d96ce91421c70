# SPDX-License-Identifier: Apache-2.0
"""A live recording: whole for another library's reader, and after a kill or a full disk."""

from __future__ import annotations

import errno
import io
import json
import os
import subprocess
import sys
import threading
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_protobuf.decoder import DecoderFactory

from armscan.errors import InputError, OutputError
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from armscan.storage.recordings import mcap_file, write_mcap
from armscan.storage.recordings.read_mcap import extract_recording
from armscan.storage.recordings.write_mcap import RecordingWriter, WriterOptions

SESSION = Session(cameras=(CameraSetup(width_px=40, height_px=30),))
STEP_NS = 12_500_000


def image(k: int, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 255, (30, 40)).astype(dtype)


def row(k: int) -> ExposureRow:
    return ExposureRow(k, k * STEP_NS, 0, f"images/{k:04d}.png", ("A",), trigger_id=k)


@pytest.mark.parametrize("compression", ["raw", "zstd", "auto"])
def test_another_reader_finds_all_that_was_recorded(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "scan.mcap"
    track = ArmTrack(
        t_ns=np.arange(3) * STEP_NS,
        rotations=np.tile(np.eye(3), (3, 1, 1)),
        translations_mm=np.full((3, 3), 250.0),
        is_known=np.array([True, False, True]),
    )
    with RecordingWriter(path, WriterOptions(compression=compression)) as writer:
        writer.begin(SESSION, {"arm.toml": b"name = 'x'\n"})
        for k in range(20):
            writer.add_exposure(row(k), image(k, np.uint16 if k % 2 else np.uint8), ("no-pose",))
        writer.add_arm_samples(track, {"button": ("1", "0", "0")})
        writer.add_event(5, "button", {"number": 1})
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        seen = [m.decoded_message for m in reader.iter_decoded_messages(["/camera/0/raw"])]
        facts = [json.loads(m.data) for _, _, m in reader.iter_messages(["/exposures"])]
        poses = [m.decoded_message for m in reader.iter_decoded_messages(["/tf"])]
        arm = [json.loads(m.data) for _, _, m in reader.iter_messages(["/arm/samples"])]
        names = {one.name for one in reader.iter_attachments()}
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 46
    assert names == {"session.toml", "arm.toml"}
    assert [len(one["rows"]) for one in arm] == [3]
    assert [pose.translation.x for pose in poses] == [0.25, 0.25]
    for k, (pixels, said) in enumerate(zip(seen, facts, strict=True)):
        dtype = "<u2" if k % 2 else np.uint8
        found = np.frombuffer(pixels.data, dtype).reshape(pixels.height, pixels.width)
        np.testing.assert_array_equal(found, image(k))
        assert said["index"] == k and said["flags"] == ["no-pose"] and said["lasers"] == ["A"]
        assert said["image"]["crc32"] == zlib.crc32(pixels.data)


def found_in(data: bytes) -> tuple[list[int], dict[int, int]]:
    """Indices listed before the damage, and the checksum of each image by its time."""
    listed, images = [], {}
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    decode = DecoderFactory()
    try:
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic == "/exposures":
                listed.append(json.loads(message.data))
            elif channel.topic == "/camera/0/raw":
                pixels = decode.decoder_for("protobuf", schema)(message.data)
                images[message.log_time] = zlib.crc32(pixels.data)
    except McapError:
        pass
    assert all(images[one["t_ns"]] == one["image"]["crc32"] for one in listed)
    return [one["index"] for one in listed], images


RECORDER = """
import sys, time
from pathlib import Path
from unit.recording.test_mcap_writer import SESSION, image, row
from armscan.storage.recordings.write_mcap import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]))
writer.begin(SESSION)
for k in range(100000):
    print(k, time.monotonic(), flush=True)
    writer.add_exposure(row(k), image(k))
    time.sleep(0.01)
"""


@pytest.mark.parametrize("seconds", [1.3, 1.7])
def test_a_killed_recorder_keeps_all_that_is_older_than_a_second(
    tmp_path: Path, seconds: float
) -> None:
    path = tmp_path / "scan.mcap"
    command = [sys.executable, "-c", RECORDER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(seconds)
        process.kill()
        killed = time.monotonic()
        lines = [line.split() for line in process.stdout.read().splitlines()]
    old = [int(k) for k, added in (line for line in lines if len(line) == 2)
           if float(added) < killed - 1.0]  # fmt: skip
    listed, _ = found_in(path.read_bytes())
    assert listed == list(range(len(listed)))
    assert len(listed) > max(old, default=0) > 0
    saved = extract_recording(path, tmp_path / "saved", is_recovering=True)
    assert saved.n_exposures == len(listed)
    assert saved.lost


def test_a_full_disk_keeps_what_is_there_and_says_how_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, real = tmp_path / "scan.mcap", os.writev
    writer = RecordingWriter(path, WriterOptions(compression="raw"))
    writer.begin(SESSION)
    for k in range(10):
        writer.add_exposure(row(k), image(k))
    limit = time.monotonic() + 10.0
    while writer.status().n_written < 10 and time.monotonic() < limit:
        time.sleep(0.05)

    def full(handle: int, pieces: list[memoryview]) -> int:
        monkeypatch.setattr(os, "writev", real)
        os.write(handle, bytes(pieces[0])[:5])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "writev", full)
    writer.add_exposure(row(10), image(10))
    with pytest.raises(OutputError, match="10 exposures of 11 are safe"):
        writer.close()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert len(list(reader.iter_messages(["/exposures"]))) == 10


def test_what_no_processor_has_time_to_pack_is_written_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_end, packs = threading.Event(), mcap_file.Chunk.packed
    niceness = []

    def slow(chunk: mcap_file.Chunk) -> list[bytes]:
        niceness.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
        may_end.wait(20.0)
        return packs(chunk)

    monkeypatch.setattr(mcap_file.Chunk, "packed", slow)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    path = tmp_path / "scan.mcap"
    with RecordingWriter(path) as writer:
        writer.begin(SESSION)
        added = time.monotonic()
        for k in range(10):
            writer.add_exposure(row(k), image(k))
        while writer.status().n_written < 10 and time.monotonic() < added + 10.0:
            time.sleep(0.01)
        assert writer.status().n_written == 10
        may_end.set()
        monkeypatch.setattr(write_mcap, "PACKED_WITHIN_SECONDS", 20.0)
        for k in range(10, 20):
            writer.add_exposure(row(k), image(k))
        while writer.status().n_written < 20 and time.monotonic() < added + 10.0:
            time.sleep(0.01)
    stored = StreamReader(io.BytesIO(path.read_bytes()), emit_chunks=True).records
    kinds = [one.compression for one in stored if isinstance(one, Chunk)]
    assert kinds == ["", "", "zstd", "zstd"]
    assert found_in(path.read_bytes())[0] == list(range(20))
    if sys.platform == "linux":
        own = os.getpriority(os.PRIO_PROCESS, 0)
        assert set(niceness) == {min(max(own, write_mcap.NICENESS), 19)}


def test_a_file_that_exists_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "scan.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(OutputError, match="cannot be begun"):
        RecordingWriter(path).begin(SESSION)
    assert path.read_bytes() == b"mine"


def writing_fails(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def refuse(*_: object) -> int:
        raise error

    monkeypatch.setattr(os, "writev", refuse)


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("error", [FULL, MemoryError("no memory"), ValueError("a bug")])
def test_whatever_ends_the_writing_thread_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    writer = RecordingWriter(tmp_path / "scan.mcap", WriterOptions("raw", queue_bytes=3000))
    writer.begin(SESSION)
    writing_fails(monkeypatch, error)
    writer.add_exposure(row(0), image(0))
    with pytest.raises(OutputError, match="0 exposures of 1 are safe"):
        writer.close()
    with pytest.raises(OutputError, match=r"the recording stopped \((No space|MemoryError|Value)"):
        writer.add_exposure(row(1), image(1))


def test_a_file_that_cannot_even_be_cut_is_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    writer = RecordingWriter(tmp_path / "scan.mcap")
    writer.begin(SESSION)
    writing_fails(monkeypatch, FULL)
    monkeypatch.setattr(os, "ftruncate", refuse)
    writer.add_exposure(row(0), image(0))
    with pytest.raises(OutputError, match=r"No space.*armscan recover"):
        writer.close()


def test_a_recording_that_cannot_be_begun_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, closed = tmp_path / "scan.mcap", []
    monkeypatch.setattr(os, "close", lambda handle, real=os.close: closed.append(real(handle)))
    writer = RecordingWriter(path)
    with monkeypatch.context() as patch:
        writing_fails(patch, FULL)
        with pytest.raises(OutputError, match=r"cannot be begun \(No space"):
            writer.begin(SESSION)
    assert not path.exists()
    assert len(closed) == 1
    with pytest.raises(InputError, match="begun before"):
        writer.begin(SESSION)
    writer.close()


def test_each_chunk_declares_what_it_holds_and_facts_follow_their_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write_mcap, "CHUNK_BYTES", 4000)
    path = tmp_path / "scan.mcap"
    with RecordingWriter(path) as writer:
        writer.begin(SESSION)
        for k in range(12):
            writer.add_exposure(row(k), image(k))
    stored = StreamReader(io.BytesIO(path.read_bytes()), emit_chunks=True).records
    chunks = [breakup_chunk(one, validate_crc=True) for one in stored if isinstance(one, Chunk)]
    n_images = n_facts = 0
    for listed in chunks:
        topics = {one.id: one.topic for one in listed if isinstance(one, Channel)}
        found = [topics[one.channel_id] for one in listed if isinstance(one, Message)]
        n_images += found.count("/camera/0/raw")
        n_facts += found.count("/exposures")
        assert n_images - n_facts in (0, 3)
    assert len(chunks) == 8
    assert n_images == n_facts == 12
