# SPDX-License-Identifier: Apache-2.0
"""Fits of features against reference sets that are right to 50 digits by their making.

    python benchmarks/reference_features.py [SETS]
    python benchmarks/reference_features.py --pairs FOLDER KIND

The first makes SETS sets (20) of each kind and arc: features of 1 to 250 mm radius, up to 1000 mm
from the origin, form errors of up to 0.02 mm. The second reads a folder of NAME.ds with NAME.fit
beside it, as institutes give them out, all of one kind. Printed are the largest differences.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import SHAPE_KINDS, ShapeKind, fit_shape
from rigs.reference_features import reference_set
from rigs.reference_sets import ReferencePair, read_reference_pair, shape_error

ARCS_DEG = (360.0, 90.0, 30.0, 15.0)


def row(what: str, kind: ShapeKind, pairs: Sequence[ReferencePair]) -> None:
    """Print the largest differences of some pairs."""
    errors, refused = [], 0
    for pair in pairs:
        fit = fit_shape(kind, pair.points_mm)
        if isinstance(fit, FitFailure):
            refused += 1
        else:
            errors.append(shape_error(fit.value, pair.shape))
    names = ("place_mm", "direction_rad", "size_mm", "angle_rad")
    worst = (max((getattr(one, name) for one in errors), default=0.0) for name in names)
    text = "".join(f"{value:>15.1e}" for value in worst)
    print(f"{kind:<10}{what:>8}{len(pairs):>6}{refused:>9}{text}")


def main() -> None:
    words = sys.argv[1:]
    heads = ("place mm", "direction rad", "size mm", "angle rad")
    print(f"{'kind':<10}{'arc':>8}{'sets':>6}{'refused':>9}" + "".join(f"{x:>15}" for x in heads))
    if words[:1] == ["--pairs"]:
        kind = cast(ShapeKind, words[2])
        files = sorted(Path(words[1]).glob("*.ds"))
        row("", kind, [read_reference_pair(path, kind) for path in files])
        return
    n = int(words[0]) if words else 20
    with tempfile.TemporaryDirectory() as folder:
        for kind in SHAPE_KINDS:
            arcs = ARCS_DEG if kind not in ("plane", "line") else ARCS_DEG[:1]
            for arc_deg in arcs:
                pairs = []
                for seed in range(n):
                    name = f"{kind}-{arc_deg:g}-{seed}"
                    reference_set(kind, seed, arc_deg=arc_deg).write(Path(folder), name)
                    pairs.append(read_reference_pair(Path(folder) / f"{name}.ds", kind))
                row(f"{arc_deg:g}", kind, pairs)


if __name__ == "__main__":
    main()
