# SPDX-License-Identifier: Apache-2.0
"""Names of crossed stripes under a moving hand: the thesis's rule beside ours, at feature level.

    python benchmarks/cross_naming.py [--seeds 20] [--first 1] [--preset harsh] [--no-arm]
                                      [--scenes plate,ball] [--rules ours] [--drop 3]
                                      [--head flat]

The head of the thesis's printed numbers (two sheets, camera of 5.1.2, window 2658 x 800, 80
exposures a second) is moved by an unsteady hand over analytic height fields, 48 exposures a stroke,
one stroke a seed, at 50-150 mm/s. Stripe points err by 0.06 px (harsh 0.15), the arm's pose by
0.010 mm and 2e-5 rad (0.030, 6e-5), each sheet by 0.01 mm (0.03); chains have holes, half of them
follow the other line past a crossing, and with harsh every third exposure has a stray line. The
lasers that are on are those that each rule asks for. Columns, each the mean over the seeds and,
in brackets, the seed that is worst but one in twenty (95th percentile):

- *stripes*: stripes named in an exposure, over those of one laser of the same head that is always
  on. A stripe counts if it has 20 points and at least half of them have its name;
- *points*: points named rightly, over those of one laser that is always on (its points without
  those that the extraction drops near another line: one laser has none);
- *wrong*: per cent of the named points that bear the other sheet's name;
- *unnamed*: per cent of the accepted points without a name, in exposures with both lasers;
- *single*: exposures with one laser alone, a stroke;
- *ms*: processor time to name an exposure, the longest of a stroke.

Below each row, the same wrong names as counts over all seeds: points wrong of those named;
stretches (the extraction's chains of one exposure) with one wrong point or more, of those named at
least in part; strokes with one wrong point or more; and the upper limits (95 %, Clopper and
Pearson) of both shares. Stretches of a stroke are not independent, for each is named by those
before it; strokes are.

``--head`` turns the two sheets about the line in which they meet. ``--drop 3`` loses every third
image: its lasers were on, but the namer never sees it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field

import numpy as np
from scipy.special import betaincinv

from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.labels import LabelledProfile, PointStatus, StripeLabeller
from armscan.thesis.row_rule import RowLabeller
from rigs.cross_rig import HARSH, HEADS, NAMES, SCENES, THESIS, CrossExposure, CrossStroke

LEAST_POINTS = 20
RULES = {"thesis": RowLabeller, "ours": CrossLabeller}
CONFIDENCE = 0.95


def upper_limit(n_wrong: int, n: int) -> float:
    """Largest share that still gives so few in 5 % of all repetitions (3 / n if there are none)."""
    return float(betaincinv(n_wrong + 1, n - n_wrong, CONFIDENCE)) if n_wrong < n else 1.0


@dataclass
class Tally:
    """Counts over the exposures of one stroke."""

    stripes: int = 0
    in_view: np.ndarray = field(default_factory=lambda: np.zeros(2))
    right: int = 0
    alone: np.ndarray = field(default_factory=lambda: np.zeros(2))
    named: int = 0
    wrong: int = 0
    stretches: int = 0
    wrong_stretches: int = 0
    asked: int = 0
    without: int = 0
    singles: int = 0
    seconds: float = 0.0

    def add(self, exposure: CrossExposure, named: LabelledProfile, alone: list[int]) -> None:
        """Take in one exposure; ``alone`` points has each laser's stripe if it alone is on."""
        is_named = named.status == int(PointStatus.MEASURED)
        is_right = is_named & (named.sheet == exposure.true_sheet)
        for k, n_points in enumerate(alone):
            n_right = int((is_right & (named.sheet == k)).sum())
            self.in_view[k] += n_points >= LEAST_POINTS
            self.alone[k] += n_points
            self.stripes += n_points >= LEAST_POINTS and n_right >= 0.5 * n_points
        self.right += int(is_right.sum())
        self.named += int(is_named.sum())
        is_wrong = is_named & (exposure.true_sheet >= 0) & ~is_right
        self.wrong += int(is_wrong.sum())
        self.stretches += len(np.unique(exposure.profile.segment[is_named]))
        self.wrong_stretches += len(np.unique(exposure.profile.segment[is_wrong]))
        if len(exposure.lasers) == len(NAMES):
            n_asked = int(exposure.profile.is_accepted.sum())
            self.asked += n_asked
            self.without += n_asked - int(is_named.sum())
        else:
            self.singles += 1

    def row(self) -> list[float]:
        """Figures of the table's columns."""
        return [
            self.stripes / max(self.in_view.mean(), 1.0),
            self.right / max(self.alone.mean(), 1.0),
            100.0 * self.wrong / max(self.named, 1),
            100.0 * self.without / max(self.asked, 1),
            self.singles,
            1e3 * self.seconds,
        ]


def seen_alone(stroke: CrossStroke) -> list[list[int]]:
    """Points of each laser's stripe in each exposure, if it alone is on."""
    return [
        [int((stroke.expose(k, (name,)).true_sheet == s).sum()) for s, name in enumerate(NAMES)]
        for k in range(stroke.n_exposures)
    ]


def scanned(
    stroke: CrossStroke,
    namer: StripeLabeller,
    alone: list[list[int]],
    has_arm: bool,
    drop: int,
) -> Tally:
    """Take a stroke with the lasers that its rule asks for; every ``drop``-th image is lost."""
    tally = Tally()
    for k in range(stroke.n_exposures):
        if drop and k % drop == drop - 1:
            continue
        exposure = stroke.expose(k, namer.next_lasers())
        pose = exposure.base_from_sensor if has_arm else None
        start = time.process_time()
        named = namer.label([exposure.profile], exposure.lasers, pose, exposure.t_ns).profiles[0]
        tally.seconds = max(tally.seconds, time.process_time() - start)
        tally.add(exposure, named, alone[k])
    return tally


def table_row(scene: str, rule: str, rows: list[list[float]]) -> str:
    """One line of the table: mean and the worse end of the seeds."""
    values = np.array(rows)
    worse = [np.percentile(values[:, c], 5.0 if c < 2 else 95.0) for c in range(values.shape[1])]
    formats = ("{:.3f}", "{:.3f}", "{:.3f}", "{:.2f}", "{:.1f}", "{:.0f}")
    cells = [
        f"{form.format(mean)} ({form.format(end)})"
        for form, mean, end in zip(formats, values.mean(axis=0), worse, strict=True)
    ]
    return f"{scene:6s} {rule:7s} " + " ".join(f"{cell:>15s}" for cell in cells)


def counts(tallies: list[Tally]) -> str:
    """Wrong names of all seeds as counts."""
    named, wrong = sum(t.named for t in tallies), sum(t.wrong for t in tallies)
    n, bad = sum(t.stretches for t in tallies), sum(t.wrong_stretches for t in tallies)
    strokes = sum(t.wrong > 0 for t in tallies)
    return (
        f"{'':15s} wrong: points {wrong}/{named}, stretches {bad}/{n} "
        f"(below {upper_limit(bad, n):.3%}), strokes {strokes}/{len(tallies)} "
        f"(below {upper_limit(strokes, len(tallies)):.1%})"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--drop", type=int, default=0)
    parser.add_argument("--rules", default=",".join(RULES))
    parser.add_argument("--preset", choices=("thesis", "harsh"), default="thesis")
    parser.add_argument("--head", choices=tuple(HEADS), default="thesis")
    parser.add_argument("--no-arm", action="store_true")
    parser.add_argument("--scenes", default=",".join(SCENES))
    options = parser.parse_args()
    disturbance = {"thesis": THESIS, "harsh": HARSH}[options.preset]
    print(
        f"head {options.head}, preset {options.preset}, "
        f"seeds {options.first}-{options.first + options.seeds - 1}, "
        f"{'without' if options.no_arm else 'with'} the arm's pose"
        + (f", every image number {options.drop} lost" if options.drop else "")
    )
    columns = ("stripes", "points", "wrong %", "unnamed %", "single", "ms")
    print(" " * 15 + " ".join(f"{name:>15s}" for name in columns))
    rules = {rule: RULES[rule] for rule in options.rules.split(",")}
    everything: dict[str, list[Tally]] = {rule: [] for rule in rules}
    for scene in options.scenes.split(","):
        found: dict[str, list[Tally]] = {rule: [] for rule in rules}
        for seed in range(options.first, options.first + options.seeds):
            stroke = CrossStroke(scene, seed, disturbance, head=options.head)
            alone = seen_alone(stroke)
            for rule, kind in rules.items():
                namer = kind(stroke.sensor)
                tally = scanned(stroke, namer, alone, not options.no_arm, options.drop)
                found[rule].append(tally)
        for rule, tallies in found.items():
            print(table_row(scene, rule, [tally.row() for tally in tallies]))
            print(counts(tallies), flush=True)
            everything[rule] += tallies
    for rule, tallies in everything.items():
        print(f"{'all':6s} {rule:7s}")
        print(counts(tallies))


if __name__ == "__main__":
    main()
