# SPDX-License-Identifier: Apache-2.0
"""Names of eleven lines by the second camera, at feature level: ours beside the thesis's own way.

Command: ``PYTHONPATH=tests python benchmarks/multi_naming.py [seeds]`` (default 20).

The seeds are 0, 1, ... The head is that of the thesis's printed numbers, its calibration drawn from
the covariance that it claims; the scenes are plates, a ball on a plate, waves, blocks on a plate,
drawn by seed, with what hides from the laser and from either camera. ``thesis``: stripe noise
0.07 px. ``drift``: the right picture 0.4 px off its epipolar lines besides. ``harsh``: noise
0.15 px, that drift, and twelve stray lines. No images: nothing here is about the extraction.

The thesis's way (4.18): each point takes the sheet that puts it within 1 px of a right stripe, and
each segment the sheet of most of its points.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import IntArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.identify_stereo import name_stripes
from armscan.reconstruction.stereo_options import StereoNamingOptions
from armscan.reconstruction.stereo_residuals import (
    RightStripes,
    find_crossings,
    possible_sheets,
    project_on_sheets,
)
from armscan.records.profile import Profile
from stereo_head import StereoHead
from stereo_scenes import KINDS, Noise, SeenProfile, draw_surfaces, expose

PRESETS = {
    "thesis": Noise(),
    "drift": Noise(shift_px=(0.0, 0.4)),
    "harsh": Noise(0.15, 12, (0.0, 0.4)),
}
RANGE_PX = 1.0
EVERY = 6


@dataclass
class Tally:
    """Counts of points, all accepted ones of the left camera."""

    n_segments: int = 0
    shared: int = 0
    shared_right: int = 0
    alone: int = 0
    alone_right: int = 0
    named: int = 0
    wrong: int = 0
    votes_shared_right: int = 0
    votes_named: int = 0
    votes_wrong: int = 0
    seconds: float = 0.0

    def add(self, seen: SeenProfile, sheet: IntArray, votes: IntArray, seconds: float) -> None:
        ok = seen.profile.is_accepted
        real = ok & (seen.sheet >= 0)
        shared, alone = real & seen.is_shared, real & ~seen.is_shared
        good, voted = sheet == seen.sheet, votes == seen.sheet
        self.n_segments += seen.n_segments
        self.shared += int(shared.sum())
        self.shared_right += int((shared & good).sum())
        self.alone += int(alone.sum())
        self.alone_right += int((alone & good).sum())
        self.named += int((ok & (sheet >= 0)).sum())
        self.wrong += int((ok & (sheet >= 0) & ~good).sum())
        self.votes_shared_right += int((shared & voted).sum())
        self.votes_named += int((ok & (votes >= 0)).sum())
        self.votes_wrong += int((ok & (votes >= 0) & ~voted).sum())
        self.seconds += seconds

    def row(self, name: str, n: int) -> str:
        return (
            f"{name:16s} {self.n_segments:8d} {self.shared_right / max(self.shared, 1):9.2%} "
            f"{self.wrong / max(self.named, 1):8.3%} {self.alone_right / max(self.alone, 1):9.1%} "
            f"{self.votes_shared_right / max(self.shared, 1):9.2%} "
            f"{self.votes_wrong / max(self.votes_named, 1):8.2%} {1e3 * self.seconds / n:6.0f}"
        )


def by_votes(
    left: Profile, right: Profile, sensor: SensorCalibration, options: StereoNamingOptions
) -> IntArray:
    """The thesis's way."""
    row = np.flatnonzero(left.is_accepted)[::EVERY]
    at, sheet = possible_sheets(left.points_px[row], sensor, options.depths)
    there = project_on_sheets(left.points_px[row[at]], sheet, sensor)
    beside = find_crossings(
        there,
        left.normals_px[row[at]],
        left.sigma_px[row[at]],
        RightStripes.of(right),
        RANGE_PX,
    )
    votes = np.zeros((int(left.segment.max()) + 1, len(sensor.sheets)))
    hit = beside.is_found
    np.add.at(votes, (left.segment[row[at[hit]]], sheet[hit]), 1.0)
    winner = np.where(votes.max(axis=1) > 0.0, votes.argmax(axis=1), -1)
    return np.where(left.is_accepted, winner[left.segment], -1)


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    head, options = StereoHead.thesis(), StereoNamingOptions()
    print(f"seeds 0 to {seeds - 1}; 'seen by both' and 'wrong' are shares of left points")
    print(
        f"{'':16s} {'segments':>8s} {'by both':>9s} {'wrong':>8s} {'one only':>9s} "
        f"{'votes':>9s} {'wrong':>8s} {'ms':>6s}"
    )
    for preset, noise in PRESETS.items():
        for kind in KINDS:
            tally = Tally()
            for seed in range(seeds):
                rng = np.random.default_rng([seed, KINDS.index(kind)])
                sensor = head.drawn_calibration(rng)
                left, right = expose(head, draw_surfaces(kind, rng), noise, rng)
                start = time.process_time()
                names = name_stripes(left.profile, right.profile, sensor, options)
                seconds = time.process_time() - start
                votes = by_votes(left.profile, right.profile, sensor, options)
                tally.add(left, names.left.sheet, votes, seconds)
            print(tally.row(f"{preset} {kind}", seeds), flush=True)


if __name__ == "__main__":
    main()
