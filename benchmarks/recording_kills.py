# SPDX-License-Identifier: Apache-2.0
"""What is left of a recording when its process is killed with -9 at random moments.

A process records two cameras and an arm into one MCAP file and says after each exposure that it was
taken. It is killed at a moment drawn from a seed. Then `armscan recover` must give every exposure
that was taken more than a second before, in order, with the pixels that were recorded.

    python benchmarks/recording_kills.py                     # 50 kills
    python benchmarks/recording_kills.py --kills 5 --compression raw
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import extract_recording
from armscan.storage.recordings.write_mcap import RecordingWriter, WriterOptions

SEED = 20261123
SIZE_PX = (480, 640)
RATE_HZ = 60.0
OLD_S = 1.0
"""Exposures that were taken so long before the kill must be there."""
SPAN_S = (0.3, 3.0)
"""Between such times after the first exposure the kill comes."""


def image(number: int) -> np.ndarray:
    """Noise that only this exposure has, over a dark ground that packs."""
    rng = np.random.default_rng(number)
    found = np.full(SIZE_PX, 12, np.uint8)
    found[100:200] = rng.integers(0, 255, (100, SIZE_PX[1]))
    return found


def record(path: Path, compression: str) -> None:
    """Record until somebody ends it; a line on standard output is an exposure that was taken."""
    setup = CameraSetup(width_px=SIZE_PX[1], height_px=SIZE_PX[0])
    writer = RecordingWriter(path, WriterOptions(compression))  # type: ignore[arg-type]
    writer.begin(Session(cameras=(setup, setup)))
    begun = time.monotonic()
    for number in range(10**9):
        t_ns, camera = number // 2 * 16_000_000, number % 2
        name = f"images/{camera}/{number:06d}.png"
        writer.add_exposure(
            ExposureRow(number, t_ns, camera, name, ("A",), trigger_id=number // 2), image(number)
        )
        if camera:
            writer.add_arm_samples(still_arm(t_ns, number // 2))
        os.write(1, f"{number} {time.monotonic()!r}\n".encode())
        time.sleep(max(0.0, begun + number / RATE_HZ - time.monotonic()))


def still_arm(t_ns: int, trigger: int) -> ArmTrack:
    return ArmTrack(
        t_ns=np.array([t_ns]),
        rotations=np.eye(3)[None],
        translations_mm=np.full((1, 3), 300.0),
        is_known=np.array([True]),
        trigger_ids=np.array([trigger]),
    )


def kill_once(folder: Path, after_s: float, compression: str) -> dict[str, float]:
    """Record, kill, recover; counts of one try."""
    path = folder / "scan.mcap"
    words = [sys.executable, __file__, "--record", str(path), "--compression", compression]
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
            n_wrong += not np.array_equal(pixels, image(row.index))
    except Exception as error:
        if must:
            raise
        print(f"  nothing was due, and nothing was there: {error}")
    late = [killed - at for number, at in taken if number >= n_found]
    return {
        "taken": len(taken),
        "due": must,
        "found": n_found,
        "missing": max(0, must - n_found),
        "wrong": n_wrong,
        "lost_s": max(late, default=0.0),
        "mb": path.stat().st_size / 1e6 if path.exists() else 0.0,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--compression", choices=("auto", "raw", "zstd"), default="auto")
    parser.add_argument("--record", type=Path, help="be the process that is killed")
    given = parser.parse_args()
    if given.record is not None:
        record(given.record, given.compression)
    rng = np.random.default_rng(given.seed)
    rows = []
    for k in range(given.kills):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(kill_once(Path(folder), float(rng.uniform(*SPAN_S)), given.compression))
        if k % 10 == 9:
            print(f"{k + 1} kills", flush=True)
    lost = np.array([row["lost_s"] for row in rows])
    total = {key: sum(row[key] for row in rows) for key in rows[0]}
    print(
        f"\n{len(rows)} kills, seed {given.seed}, {given.compression}, 2 cameras of "
        f"{SIZE_PX[1]} x {SIZE_PX[0]} px, {RATE_HZ:g} exposures/s asked\n"
        f"exposures taken {total['taken']:.0f}, older than {OLD_S:g} s {total['due']:.0f}, "
        f"recovered {total['found']:.0f}, {total['mb']:.0f} MB\n"
        f"of the older ones missing {total['missing']:.0f}; wrong or out of order "
        f"{total['wrong']:.0f}\n"
        f"age of the oldest exposure lost: median {np.median(lost):.2f} s, most {lost.max():.2f} s"
    )
    return 1 if total["missing"] or total["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
