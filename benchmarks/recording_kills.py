# SPDX-License-Identifier: Apache-2.0
"""What is left of a recording when its process is killed with -9 at random moments.

A process records two cameras and an arm into one MCAP file and says after each exposure that it was
taken. It is killed at a moment drawn from a seed. Then `armscan recover` must give every exposure
that was taken more than a second before, in order, with the pixels that were recorded.

    python benchmarks/recording_kills.py                     # 50 kills
    python benchmarks/recording_kills.py --kills 5 --compression raw
    python benchmarks/recording_kills.py --kills 20 --full --busy 2 --folder /dev/shm

`--full` records 80 images of 2658 x 800 px a second, and each of `--busy` processes wants a core
all the time, so that the packing thread is late and closed chunks wait to be packed. What waits for
a disk or a processor that is behind is lost, however old: the folder must take what is recorded.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import extract_recording
from armscan.storage.recordings.write_mcap import NICENESS, RecordingWriter, WriterOptions

SEED = 20261123
SIZES_PX = {False: (480, 640), True: (800, 2658)}
"""Height and width, and the same at full size."""
RATES_HZ = {False: 60.0, True: 80.0}
GROUNDS = 16
"""Images that are drawn once; each exposure has a line of its own over one of them."""
OLD_S = 1.0
"""Exposures that were taken so long before the kill must be there."""
SPAN_S = (0.3, 3.0)
"""Between such times after the first exposure the kill comes."""


@cache
def ground(k: int, is_full: bool) -> np.ndarray:
    """A dark image that packs, with a fifth of noise that does not."""
    height, width = SIZES_PX[is_full]
    found = np.full((height, width), 12, np.uint8)
    noise = np.random.default_rng(k).integers(0, 255, (height // 5, width))
    found[height // 5 : 2 * (height // 5)] = noise
    return found


def image(number: int, *, is_full: bool) -> np.ndarray:
    """Pixels that only this exposure has."""
    found = ground(number % GROUNDS, is_full).copy()
    found[number % len(found)] = np.random.default_rng(number).integers(0, 255, found.shape[1])
    return found


def record(path: Path, compression: str, *, is_full: bool) -> None:
    """Record until somebody ends it; a line on standard output is an exposure that was taken."""
    height, width = SIZES_PX[is_full]
    setup = CameraSetup(width_px=width, height_px=height)
    for number in range(GROUNDS):
        ground(number, is_full)
    writer = RecordingWriter(path, WriterOptions(compression))  # type: ignore[arg-type]
    writer.begin(Session(cameras=(setup, setup)))
    begun = time.monotonic()
    for number in range(10**9):
        t_ns, camera = number // 2 * 16_000_000, number % 2
        name = f"images/{camera}/{number:06d}.png"
        writer.add_exposure(
            ExposureRow(number, t_ns, camera, name, ("A",), trigger_id=number // 2),
            image(number, is_full=is_full),
        )
        if camera:
            writer.add_arm_samples(still_arm(t_ns, number // 2))
        os.write(1, f"{number} {time.monotonic()!r}\n".encode())
        time.sleep(max(0.0, begun + number / RATES_HZ[is_full] - time.monotonic()))


def still_arm(t_ns: int, trigger: int) -> ArmTrack:
    return ArmTrack(
        t_ns=np.array([t_ns]),
        rotations=np.eye(3)[None],
        translations_mm=np.full((1, 3), 300.0),
        is_known=np.array([True]),
        trigger_ids=np.array([trigger]),
    )


def be_busy() -> None:
    """Want a core until somebody ends it: before the packing thread, behind the recorder."""
    os.nice(NICENESS // 2)
    while True:
        sum(range(10**6))


def how_written(path: Path) -> tuple[int, int]:
    """Chunks of a file, and those of them that were packed."""
    n_chunks = n_packed = 0
    with path.open("rb") as file, suppress(EndOfFile, McapError):
        for record in StreamReader(file, emit_chunks=True, skip_magic=False).records:
            if isinstance(record, Chunk):
                n_chunks += 1
                n_packed += record.compression != ""
    return n_chunks, n_packed


def kill_once(folder: Path, after_s: float, compression: str, *, is_full: bool) -> dict[str, float]:
    """Record, kill, recover; counts of one try."""
    path = folder / "scan.mcap"
    words = [sys.executable, __file__, "--record", str(path), "--compression", compression]
    words += ["--full"] if is_full else []
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        if process.stdout is None:
            raise RuntimeError("no pipe")
        first = process.stdout.readline()
        time.sleep(after_s)
        process.kill()
        killed = time.monotonic()
        said = [first, *process.stdout.read().splitlines()]
    taken = [
        (int(line.split()[0]), float(line.split()[1])) for line in said if line.count(" ") == 1
    ]
    must = sum(at < killed - OLD_S for _, at in taken)
    saved = folder / "saved"
    n_found = n_wrong = 0
    try:
        extract_recording(path, saved, is_recovering=True)
        source = read_recording(saved)
        numbers = sorted(row.index for row in source.rows)
        n_found = len(numbers)
        n_wrong += numbers != list(range(n_found))
        for row in source.rows:
            pixels = cv2.imread(str(saved / row.source), cv2.IMREAD_UNCHANGED)
            n_wrong += not np.array_equal(pixels, image(row.index, is_full=is_full))
    except Exception as error:
        if must:
            raise
        print(f"  nothing was due, and nothing was there: {error}")
    n_chunks, n_packed = how_written(path)
    late = [killed - at for number, at in taken if number >= n_found]
    return {
        "taken": len(taken),
        "due": must,
        "found": n_found,
        "missing": max(0, must - n_found),
        "wrong": n_wrong,
        "chunks": n_chunks,
        "packed": n_packed,
        "lost_s": max(late, default=0.0),
        "mb": path.stat().st_size / 1e6,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--compression", choices=("auto", "raw", "zstd"), default="auto")
    parser.add_argument("--full", action="store_true", help="2658 x 800 px, 80 a second")
    parser.add_argument("--busy", type=int, default=0, help="processes that want a core meanwhile")
    parser.add_argument("--folder", help="where recordings are made and removed")
    parser.add_argument("--record", type=Path, help="be the process that is killed")
    given = parser.parse_args()
    if given.record is not None:
        record(given.record, given.compression, is_full=given.full)
    rng = np.random.default_rng(given.seed)
    rows = []
    others = [multiprocessing.Process(target=be_busy, daemon=True) for _ in range(given.busy)]
    for one in others:
        one.start()
    for k in range(given.kills):
        with tempfile.TemporaryDirectory(dir=given.folder) as folder:
            after_s = float(rng.uniform(*SPAN_S))
            rows.append(kill_once(Path(folder), after_s, given.compression, is_full=given.full))
        if k % 10 == 9:
            print(f"{k + 1} kills", flush=True)
    for one in others:
        one.terminate()
    lost = np.array([row["lost_s"] for row in rows])
    total = {key: sum(row[key] for row in rows) for key in rows[0]}
    height, width = SIZES_PX[given.full]
    print(
        f"\n{len(rows)} kills, seed {given.seed}, {given.compression}, 2 cameras of "
        f"{width} x {height} px, {RATES_HZ[given.full]:g} exposures/s asked, load "
        f"{os.getloadavg()[0]:.1f}\n"
        f"exposures taken {total['taken']:.0f}, older than {OLD_S:g} s {total['due']:.0f}, "
        f"recovered {total['found']:.0f}, {total['mb']:.0f} MB in {total['chunks']:.0f} chunks, "
        f"{total['packed']:.0f} of them packed\n"
        f"of the older ones missing {total['missing']:.0f}; wrong or out of order "
        f"{total['wrong']:.0f}\n"
        f"age of the oldest exposure lost: median {np.median(lost):.2f} s, most {lost.max():.2f} s"
    )
    return 1 if total["missing"] or total["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
