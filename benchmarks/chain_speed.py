# SPDX-License-Identifier: Apache-2.0
"""A scan, stripes to normals, beside OpenCV's Steger alone: the part ``chain`` of ``speed.py``.

Simulated: the first instants of the strokes over the plate, preset thesis, seed 1; the scanner is
the twin's own, so that nothing is calibrated. Told is one instant, of a head of two cameras a pair.
Images are in memory; to decode the files is a row of its own. OpenCV and numpy
(`stripe_speed.opencv_steger`) give points without sigma, flags, names and places. One core.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
from stripe_speed import USUAL, opencv_steger
from timing import Comparison, compare

from armscan.devices.sources import ScanSource
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.progress import StageClock
from armscan.pipeline.scan import ScanOptions, measure_long_scan, scan_spool
from armscan.pipeline.simulate import TwinName, fewer_views
from armscan.records.exposure import Exposure
from armscan.storage.recording import read_recording, write_recording
from armscan.vision.stripe.image import StripeMethod, StripeOptions
from rigs.true_scanner import true_scanner

INSTANTS = 12
HEADS = {"thesis-single": "one line", "thesis-multi": "eleven lines, two cameras"}


class InMemory:
    """A recording whose images are decoded already."""

    def __init__(self, source: ScanSource) -> None:
        self._source = source
        self._exposures = [source.exposure(k) for k in range(len(source.rows))]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def exposure(self, row: int) -> Exposure:
        return self._exposures[row]


def chain(source: Any, scanner: ScannerCalibration, method: StripeMethod) -> str:
    """Points of a scan in Base, with normals, and what its stages took."""
    options = ScanOptions(measure=MeasureOptions(stripes=StripeOptions(method=method)))
    clock, before = StageClock(), os.sched_getaffinity(0)
    os.sched_setaffinity(0, set(sorted(before)[:1]))
    try:
        with tempfile.TemporaryDirectory() as place:
            spool = scan_spool(scanner, Path(place))
            measure_long_scan(source, scanner, spool, options, clock=clock)
            n_points = len(spool)
    finally:
        os.sched_setaffinity(0, before)
    shares = [f"{name} {1e3 * taken / INSTANTS:.1f}" for name, taken in clock.profile().stages]
    return f"{n_points / INSTANTS:,.0f} points; ms: {', '.join(shares)}"


def chains(repeats: int) -> Iterator[Comparison]:
    """Each head."""
    cv2.setNumThreads(1)
    for head, name in HEADS.items():
        twin = TwinName(head, "thesis", 1).build()
        scanner = true_scanner(twin)
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "scan"
            write_recording(folder, fewer_views(twin.scan("plate"), INSTANTS))
            yield _beside_steger(name, read_recording(folder), scanner, repeats)


def _beside_steger(
    name: str, recording: ScanSource, scanner: ScannerCalibration, repeats: int
) -> Comparison:
    rows = range(len(recording.rows))
    kept = InMemory(recording)
    images = [kept.exposure(k).image for k in rows]

    def steger() -> str:
        n_points = sum(len(opencv_steger(image)) for image in images)
        return f"{n_points / INSTANTS:,.0f} points"

    def decode() -> str:
        for k in rows:
            recording.exposure(k)
        return ""

    ways: dict[str, Callable[[], str]] = {
        "**armscan**": lambda: chain(kept, scanner, "fit"),
        "**armscan, `fast`**": lambda: chain(kept, scanner, "fast"),
        f"{USUAL} alone": steger,
        "PNG files decoded": decode,
    }
    return compare(
        f"scan of a plate, {name}: an instant of 2658 x 800 px",
        ways,
        repeats,
        usual=f"{USUAL} alone",
        tell=lambda found: (found, ""),
        parts=INSTANTS,
    )
