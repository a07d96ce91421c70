# SPDX-License-Identifier: Apache-2.0
"""Memory and rate of `armscan reconstruct` against the length of a scan.

Command: ``OMP_NUM_THREADS=1 python benchmarks/scan_length.py [exposures ...]`` (default 500 2000
8000; seed 0). ``--reference PATH`` runs the sources in PATH as well and compares the clouds;
``--stripes-once`` extracts the stripes of images that repeat once: what is left is the rest of the
chain.

A recording of a plate: 16 drawn images of one line (320 x 240 px, 320 points), repeated under
names of their own, 80 a second; the arm carries the line to and fro over lanes that run 30 mm
aside each, 0.5 mm an exposure, so that new surface comes all the time. Simulated: drawn without
the renderer. Each length is one run of the command in a process of its own, without cache. Told
are exposures and points a second by the wall clock, processor time an exposure, the process's peak
memory (of 2^20 bytes an MB), and the beginning of the hash of the cloud's points. Needs Linux.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.poses import Base, Pose, Tool
from armscan.storage.documents import scanner_document
from rigs.scan_fake import line_image, looking_down, scanner

IMAGES, PERIOD_NS = 16, 12_500_000
STEP_MM, LANE_MM, LANE_APART_MM = 0.5, 150.0, 30.0
RUN = """
import sys
from armscan.cli import main
code = main()
with open("/proc/self/status") as status:
    print(*(line.split()[1] for line in status if line.startswith("VmHWM:")), file=sys.stderr)
sys.exit(code)
"""
"""The command, then the kilobytes that its process held at most: what `os.wait4` tells counts the
process that started it, too."""
STRIPES_KEPT = f"""
from dataclasses import replace
from pathlib import Path
from armscan.pipeline import measure
real, kept = measure.extract_stripes, {{}}
def again(exposure, *others):
    number = int(Path(exposure.source).stem) % {IMAGES}
    if number not in kept:
        kept[number] = real(exposure, *others)
    return replace(kept[number], source=exposure.source)
measure.extract_stripes = again
"""
"""Images are decoded, but stripes extracted once of each of those that repeat."""
MB = 1024.0
"""Kilobytes, in which Linux tells peak memory."""


def tool_pose(k: float) -> Pose[Base, Tool]:
    """Where the tool is at exposure k: along a lane, then back along the next one."""
    way = k * STEP_MM
    lane, along = divmod(way, LANE_MM)
    y = along if int(lane) % 2 == 0 else LANE_MM - along
    pose = looking_down(y)
    aside = np.array([LANE_APART_MM * way / LANE_MM, 0.0, 0.0])
    return Pose(pose.rotation, pose.translation_mm + aside)


def write_scan(folder: Path, n: int) -> None:
    """A folder recording of n exposures, and ``scanner.json`` beside it."""
    rng = np.random.default_rng(0)
    images = folder / "images"
    images.mkdir(parents=True)
    for k in range(min(IMAGES, n)):
        grey = np.clip(np.round(line_image(looking_down(0.0), rng)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(images / f"{k:06d}.png"), grey)
    for k in range(IMAGES, n):
        os.link(images / f"{k % IMAGES:06d}.png", images / f"{k:06d}.png")
    rows = [f"{k},{(k + 1) * PERIOD_NS},0,images/{k:06d}.png,A,{k}" for k in range(n)]
    head = "index,t_ns,camera,file,lasers,trigger_id"
    (folder / "exposures.csv").write_text("\n".join([head, *rows]) + "\n")
    arm = ["t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz,trigger_id"]
    for k in range(n):
        pose = tool_pose(k)
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        t = pose.translation_mm
        numbers = ",".join(repr(float(value)) for value in (*t, w, x, y, z))
        arm.append(f"{(k + 1) * PERIOD_NS},{numbers},{k}")
    (folder / "arm.csv").write_text("\n".join(arm) + "\n")
    (folder.parent / "scanner.json").write_bytes(scanner_document(scanner()))


@dataclass(frozen=True)
class Run:
    """One run of the command."""

    wall_s: float
    processor_s: float
    peak_mb: float
    n_points: int
    digest: str


def run(folder: Path, sources: Path, before: str = "") -> Run:
    """Reconstruct the recording with the package in ``sources``."""
    cloud = folder.parent / "cloud.ply"
    environment = {**os.environ, "PYTHONPATH": str(sources)}
    words = ["reconstruct", str(folder), "--scanner", str(folder.parent / "scanner.json")]
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-c", before + RUN, *words, "-o", str(cloud), "--no-cache", "--force"],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    told = child.stderr.read() if child.stderr is not None else ""
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"the command failed with status {status}: {told}")
    wall = time.perf_counter() - start
    digest = hashlib.sha256()
    n_points = 0
    with cloud.open("rb") as file:
        for line in iter(file.readline, b"end_header\n"):
            n_points = int(line.split()[2]) if line.startswith(b"element vertex") else n_points
        while piece := file.read(2**20):
            digest.update(piece)
    cloud.unlink()
    return Run(
        wall_s=wall,
        processor_s=used.ru_utime + used.ru_stime,
        peak_mb=int(told.split()[-1]) / MB,
        n_points=n_points,
        digest=digest.hexdigest(),
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("exposures", nargs="*", type=int, default=[500, 2000, 8000])
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--stripes-once", action="store_true")
    given = parser.parse_args()
    own = Path(__file__).parents[1] / "src"
    print("| exposures | points | exposures/s | points/s | ms an exposure | peak MB | hash |")
    print("|--:|--:|--:|--:|--:|--:|---|")
    for n in given.exposures:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "scan"
            write_scan(folder, n)
            for sources in [own, *([given.reference] if given.reference else [])]:
                found = run(folder, sources, STRIPES_KEPT if given.stripes_once else "")
                print(
                    f"| {n:,} | {found.n_points:,} | {n / found.wall_s:.0f} | "
                    f"{found.n_points / found.wall_s:,.0f} | {1e3 * found.processor_s / n:.1f} | "
                    f"{found.peak_mb:.0f} | {found.digest[:12]} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
