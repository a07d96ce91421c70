# SPDX-License-Identifier: Apache-2.0
"""What the software costs beside what a user would pick instead: one Markdown table.

    python benchmarks/speed.py [PART ...] [--repeats 5]

Parts: ``stripes``, ``placing``, ``chain``, ``fusion``, ``camera``, ``length``; all of them take a
quarter of an hour, on Linux. Told is the least processor time of the repeats, of all threads; the
ways to do one work take turns, so that a loaded machine slows all alike: trust the ratios. The
usual way of each work has the ratio 1. *Gives* and *error* say what the time buys. scikit-image,
ridge-detector and small_gicp have their rows if they are installed. Everything is drawn or
simulated.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

from chain_speed import chains  # noqa: E402
from fusion_speed import fusion  # noqa: E402
from scan_length import run, write_scan  # noqa: E402
from scan_speed import placing  # noqa: E402
from stripe_speed import stripes  # noqa: E402
from target_detection import beside_opencv  # noqa: E402
from timing import Comparison, Row, heading, print_table  # noqa: E402

from armscan.pipeline.simulate import TwinName  # noqa: E402
from armscan.storage.recording import read_recording, write_recording  # noqa: E402

TARGET = "circle-grid:11x9:3.75"


def fused(repeats: int) -> Iterator[Comparison]:
    yield fusion(repeats)


def camera(repeats: int) -> Iterator[Comparison]:
    """`armscan calibrate camera` on rendered photographs, each command in its own process."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "camera"
        write_recording(folder, TwinName("thesis-single", "thesis", 1).build().scan("camera"))
        paths = [folder / row.source for row in read_recording(folder).rows]
        runs = list(beside_opencv(paths, TARGET, repeats))
    usual = "OpenCV's finder and `calibrateCamera`"
    rows = (
        Row("**armscan calibrate camera**", 1e3 * min(one.ours[0] for one in runs)),
        Row(usual, 1e3 * min(one.opencv[0] for one in runs), f"{runs[0].n_found} boards"),
    )
    work = f"a camera of {len(paths)} photographs of 3072 x 2048 px, whole command"
    yield Comparison(work, rows, usual)


def length(repeats: int) -> Iterator[Comparison]:
    """`armscan reconstruct` against the length of the scan, once each."""
    for n in (500, 2000):
        with tempfile.TemporaryDirectory() as place:
            write_scan(Path(place) / "scan", n)
            one = run(Path(place) / "scan", Path(__file__).parents[1] / "src")
        row = Row(
            "**armscan reconstruct**",
            1e3 * one.processor_s / n,
            f"{one.n_points:,} points; {one.peak_mb:.0f} MB at most",
        )
        yield Comparison(f"recording of {n:,} exposures of 320 x 240 px, one, run once", (row,))


PARTS: dict[str, Callable[[int], Iterator[Comparison]]] = {
    "stripes": stripes,
    "placing": placing,
    "chain": chains,
    "fusion": fused,
    "camera": camera,
    "length": length,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Time the software beside the usual ways.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    if unknown := set(given.parts) - set(PARTS):
        sys.exit(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    print(f"{heading()}, load {os.getloadavg()[0]:.0f}, least of {given.repeats}\n")
    print_table(one for part in given.parts or PARTS for one in PARTS[part](given.repeats))


if __name__ == "__main__":
    main()
