# SPDX-License-Identifier: Apache-2.0
"""What a recording of the stripe band saves, and whether the same points come out of it.

Images of the twin's scans, of all heads and presets, and real photographs of laser lines (one
channel) are set to zero away from what could be a stripe, as `RecordingWriter` does it; the points
of `extract_stripes` must be the same to the last bit.

    python benchmarks/stripe_band.py
    python benchmarks/stripe_band.py --seeds 1 --exposures 2
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import zstandard

from armscan.devices.sources import Preset
from armscan.pipeline.simulate import TwinName
from armscan.records.exposure import Exposure
from armscan.storage.images import read_exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.ridge import near_lines

HEADS = ("thesis-single", "thesis-cross", "thesis-multi")
SCENES = ("ball", "plate")


def twin_images(seeds: int, count: int) -> Iterator[tuple[str, Exposure]]:
    for head in HEADS:
        for preset in get_args(Preset):
            for seed in range(1, seeds + 1):
                twin = TwinName(head, preset, seed).build()
                for scene in SCENES:
                    scan = twin.scan(scene)
                    for k in np.linspace(0, len(scan.rows) - 1, count).astype(int):
                        yield f"{head} {preset}", scan.exposure(int(k))


def photographs() -> Iterator[tuple[str, Exposure]]:
    folder = Path(os.environ.get("ARMSCAN_DATA", "../shared/data")) / "ciclop"
    for path in sorted([*folder.glob("laser_pattern/*.png"), *folder.glob("laser_object/*.png")]):
        exposure = read_exposure(path)
        channels = exposure.image.shape[2] if exposure.image.ndim == 3 else 0
        for k in range(channels):
            own = np.ascontiguousarray(exposure.image[:, :, k])
            yield "photographs, by channel", Exposure(own, f"{path.name}:{k}")


def measured(exposure: Exposure) -> dict[str, Any]:
    """Of one image: whether the points are the same, how many, what is kept, sizes, time."""
    scale = np.float32(255.0 / exposure.full_scale)
    start = time.process_time()
    keep = near_lines(exposure.image.astype(np.float32) * scale)
    seconds = time.process_time() - start
    banded = np.where(keep, exposure.image, exposure.image.dtype.type(0))
    whole = extract_stripes(exposure)
    part = extract_stripes(replace(exposure, image=banded))
    arrays = [one.name for one in fields(whole) if isinstance(getattr(whole, one.name), np.ndarray)]
    packer = zstandard.ZstdCompressor(level=1)
    sizes = [len(packer.compress(image.tobytes())) for image in (exposure.image, banded)]
    return {
        "differs": not all(np.array_equal(getattr(whole, n), getattr(part, n)) for n in arrays),
        "points": len(whole),
        "kept": float(keep.mean()),
        "whole": sizes[0],
        "band": sizes[1],
        "seconds": seconds,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--exposures", type=int, default=3)
    given = parser.parse_args()
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for images in (twin_images(given.seeds, given.exposures), photographs()):
        for name, exposure in images:
            groups[name].append(measured(exposure))
    print("| images of | images | points | images that differ | kept | packed, of whole | ms |")
    print("|---|---|---|---|---|---|---|")
    for name, found in groups.items():
        total = {key: sum(one[key] for one in found) for key in found[0]}
        cells = (
            name,
            len(found),
            total["points"],
            total["differs"],
            f"{100 * total['kept'] / len(found):.0f} %",
            f"{100 * total['band'] / total['whole']:.0f} %",
            f"{1e3 * total['seconds'] / len(found):.0f}",
        )
        print("| " + " | ".join(map(str, cells)) + " |")
    return int(any(one["differs"] for found in groups.values() for one in found))


if __name__ == "__main__":
    sys.exit(main())
