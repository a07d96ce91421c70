# SPDX-License-Identifier: Apache-2.0
"""The whole chain of a scan, stripes to normals, beside OpenCV's Steger alone on the same images.

Command: ``OMP_NUM_THREADS=1 python benchmarks/chain_speed.py [HEAD ...] [--scene ball] [--most 40]
[--repeats 3]`` (default heads thesis-single and thesis-multi; preset thesis, seed 1). Renders the
first instants of the scene into a temporary folder; the scanner is the twin's own, so that nothing
is calibrated. One Markdown row of processor milliseconds an instant (of two cameras: a pair), the
least of the repeats: files decoded; the chain from decoded images in memory, with one thread that
extracts stripes and with one a core; OpenCV's filters and numpy (`opencv_steger` of
`stripe_speed.py`, which gives points without sigma, flags, names and places) on the same images in
memory; the chain over that. Then the shares of the stages, and peak memory, images included.
Processor time counts all threads, and hardly feels what else runs; rates follow from it.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
from stripe_speed import machine, opencv_steger

from armscan.devices.sources import ScanSource, TwinScene
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.progress import StageClock, peak_memory_mb
from armscan.pipeline.scan import ScanOptions, measure_long_scan, scan_spool
from armscan.pipeline.simulate import TwinName, fewer_views
from armscan.records.exposure import Exposure
from armscan.storage.recording import read_recording, write_recording
from armscan.vision.stripe.image import StripeOptions
from rigs.true_scanner import true_scanner


class InMemory:
    """A recording whose images are decoded already."""

    def __init__(self, source: ScanSource) -> None:
        self._source = source
        self._exposures = [source.exposure(k) for k in range(len(source.rows))]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def exposure(self, row: int) -> Exposure:
        return self._exposures[row]


def least_ms(work: Callable[[], object], repeats: int) -> float:
    """Least processor time of a piece of work, all threads, after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def chain(
    source: Any, scanner: ScannerCalibration, options: ScanOptions, clock: StageClock | None = None
) -> int:
    """Points of a scan in Base, with normals."""
    with tempfile.TemporaryDirectory() as place:
        spool = scan_spool(scanner, Path(place))
        measure_long_scan(source, scanner, spool, options, clock=clock)
        return len(spool)


def on_cores(count: int, work: Callable[[], object], repeats: int) -> float:
    """As `least_ms`, with this many cores allowed."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, set(sorted(before)[:count]))
    try:
        return least_ms(work, repeats)
    finally:
        os.sched_setaffinity(0, before)


def measure(head: str, scene: TwinScene, most: int, repeats: int, options: ScanOptions) -> None:
    twin = TwinName(head, "thesis", 1).build()
    scanner = true_scanner(twin)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "scan"
        write_recording(folder, fewer_views(twin.scan(scene), most))
        recording = read_recording(folder)
        n = len({row.t_ns for row in recording.rows})
        rows = range(len(recording.rows))
        decoding = least_ms(lambda: [recording.exposure(k) for k in rows], repeats) / n
        kept = InMemory(recording)
    images = [kept.exposure(k).image for k in rows]
    steger = least_ms(lambda: [opencv_steger(image) for image in images], repeats) / n
    alone = on_cores(1, lambda: chain(kept, scanner, options), repeats) / n
    both = on_cores(2, lambda: chain(kept, scanner, options), repeats) / n
    clock = StageClock()
    n_points = chain(kept, scanner, options, clock)
    print(
        f"| {head}, {scene} | {n} | {len(rows) // n} | {n_points / n:,.0f} | {decoding:.1f} | "
        f"{alone:.1f} | {both:.1f} | {steger:.1f} | {both / steger:.2f} | {1e3 / alone:.1f} |"
    )
    profile = clock.profile()
    shares = ", ".join(f"{name} {1e3 * seconds / n:.1f}" for name, seconds in profile.stages)
    print(f"\n  stages, ms: {shares}; peak {peak_memory_mb() or 0.0:.0f} MB\n", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("heads", nargs="*", default=["thesis-single", "thesis-multi"])
    parser.add_argument("--scene", default="ball")
    parser.add_argument("--most", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--stripe-method", default="fit")
    given = parser.parse_args()
    stripes = StripeOptions(method=given.stripe_method)
    options = ScanOptions(measure=MeasureOptions(stripes=stripes))
    cv2.setNumThreads(1)
    print(machine())
    print(
        "| head, scene | instants | cameras | points | decoding | chain, one core | two cores | "
        "Steger alone | chain over it | instants/s of one core |"
    )
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for head in given.heads:
        measure(head, given.scene, given.most, given.repeats, options)


if __name__ == "__main__":
    main()
