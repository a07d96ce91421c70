# SPDX-License-Identifier: Apache-2.0
"""Tables of what became of instruments drawn at random: counts, certainty, strata, words.

A wrong result is *warned* of if its stage gave a warning that bears on it: of a kind that at most
one in ten of that stage's right results has. What is said to more sound results than that warns of
no fault, whatever its words; warnings of earlier stages do not count.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numpy as np
from scipy.stats import beta

from armscan.geometry.arrays import FloatArray
from rigs.instrument_stages import FEW_BOARDS

RESULTS = (
    "right",
    "rightly refused",
    FEW_BOARDS,
    "wrongly refused",
    "wrong, warned",
    "silently wrong",
)
ANSWERS = ("right", "wrong, warned", "silently wrong")
"""Results that are given, not refused."""
SPARING = 0.1
"""Part of the right results that a warning may be given to and still bear on a wrong one."""
WANTED = (0.9, 1.15)
"""Of chi2 over its degrees of freedom."""
Row = dict[str, Any]
Pairs = list[tuple[Row, Row]]
"""Instruments, each with its outcome of one stage."""


def kind(text: str) -> str:
    """A warning or a reason without its numbers and names."""
    text = re.sub(r"\b(posture|image|laser|left|right)\d[\w.-]*", "X", text)
    text = re.sub(r"\b(sheet|light sheet|source|line) [A-Z\d]\b", r"\1 #", text)
    text = re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)
    text = re.sub(r"(X[^,;:]*, )+", "X, ", text)
    return text[:96]


def by_stage(rows: list[Row]) -> dict[str, Pairs]:
    """Outcomes of each stage; wrong ones told apart by whether they were warned of."""
    found: dict[str, Pairs] = {}
    for row in rows:
        for outcome in row["outcomes"]:
            found.setdefault(outcome["stage"], []).append((row, outcome))
    return {stage: _told_apart(pairs) for stage, pairs in found.items()}


def _told_apart(pairs: Pairs) -> Pairs:
    shares = warned_shares([one for _, one in of_result(pairs, "right")])
    told = []
    for row, outcome in pairs:
        result = outcome["result"]
        if result == "wrong":
            kinds = {kind(text) for text in outcome["warnings"]}
            is_warned = any(shares.get(one, 0.0) <= SPARING for one in kinds)
            result = "wrong, warned" if is_warned else "silently wrong"
        told.append((row, {**outcome, "result": result}))
    return told


def warned_shares(outcomes: list[Row]) -> dict[str, float]:
    """Part of the outcomes that has a warning of each kind."""
    counted = Counter(one for o in outcomes for one in {kind(text) for text in o["warnings"]})
    return {one: n / len(outcomes) for one, n in counted.most_common()}


def of_result(pairs: Pairs, result: str) -> Pairs:
    """Those that ended so."""
    return [pair for pair in pairs if pair[1]["result"] == result]


def share_limits(n: int, n_all: int) -> tuple[float, float]:
    """Two-sided 95 % limits of a share of which n of n_all were seen (Clopper and Pearson)."""
    low = float(beta.ppf(0.025, n, n_all - n + 1)) if n else 0.0
    high = float(beta.ppf(0.975, n + 1, n_all - n)) if n < n_all else 1.0
    return low, high


def rate(n: int, n_all: int) -> str:
    """Count and share with its limits, in words; of none nothing is known."""
    if not n_all:
        return "0 of 0"
    low, high = (100.0 * one for one in share_limits(n, n_all))
    return f"{n} of {n_all}: {100.0 * n / n_all:.2f} % (95 %: {low:.2f} to {high:.2f} %)"


def answered(pairs: Pairs) -> Pairs:
    """Those that gave an answer, right or wrong."""
    return [pair for pair in pairs if pair[1]["result"] in ANSWERS]


def certainty(outcomes: list[Row]) -> tuple[float, float]:
    """Mean chi2 over its degrees of freedom, and its standard error; NaN for none."""
    judged = [o for o in outcomes if o["freedom"]]
    if not judged:
        return float("nan"), float("nan")
    square = np.array([o["chi2"] for o in judged])
    freedom = np.array([o["freedom"] for o in judged], dtype=float)
    mean = square.sum() / freedom.sum()
    error = np.sqrt(np.sum((square - mean * freedom) ** 2)) / freedom.sum()
    return float(mean), float(error)


def print_tables(rows: list[Row]) -> None:
    """Outcomes, certainty, strata, reasons and warnings."""
    seeds = [row["seed"] for row in rows]
    print(f"{len(rows)} draws, seeds {min(seeds)} to {max(seeds)}, commit {rows[0].get('commit')}")
    print(f"{np.mean([row['seconds'] for row in rows]):.1f} core-seconds a draw")
    found = by_stage(rows)
    print_outcomes(found)
    print_silent(found)
    print_strata(found)
    print_words(found)


def print_outcomes(found: dict[str, Pairs]) -> None:
    """Counts and rates, chi2 over its degrees of freedom, stated sigma over the bound."""
    print(f"\n| stage | judged | {' | '.join(RESULTS)} | chi2 / f of the right | sigma / bound |")
    print("|---" * (len(RESULTS) + 4) + "|")
    for stage, pairs in found.items():
        counts = [str(len(of_result(pairs, result))) for result in RESULTS]
        mean, error = certainty([one for _, one in of_result(pairs, "right")])
        bound = f"{_median(pairs, 'over_bound'):.2f} ({_median(pairs, 'over_granted'):.2f})"
        cells = [stage, str(len(pairs)), *counts, f"{mean:.2f} ± {error:.2f}", bound]
        print(f"| {' | '.join(cells)} |".replace("nan ± nan", "").replace("nan (nan)", ""))
    whole = [pair for pairs in found.values() for pair in pairs]
    few = sum(one["reason"].startswith("few postures") for _, one in whole)
    print(f"rightly refused for fewer postures than the software asks for: {few}")
    for result in RESULTS[2:]:
        seen = of_result(whole, result)
        print(
            f"{result}, of judged stages: {rate(len(seen), len(whole))}; "
            f"in {len({row['seed'] for row, _ in seen})} of "
            f"{len({row['seed'] for row, _ in whole})} instruments"
        )


def print_silent(found: dict[str, Pairs]) -> None:
    """Rate of what is silently wrong, of all that was judged and of the answers given."""
    print("\n| silently wrong | of all judged | of the answers given |")
    print("|---|---|---|")
    whole = [pair for pairs in found.values() for pair in pairs]
    for stage, pairs in {**found, "all": whole}.items():
        n = len(of_result(pairs, "silently wrong"))
        print(f"| {stage} | {rate(n, len(pairs))} | {rate(n, len(answered(pairs)))} |")


def _median(pairs: Pairs, name: str) -> float:
    values = np.array([one.get(name) or np.nan for _, one in pairs], dtype=float)
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else float("nan")


def print_strata(found: dict[str, Pairs]) -> None:
    """Chi2 over its degrees of freedom in thirds of each stratum, of the right results.

    One result that is wrong would be all that its third shows; these are counted above.
    """
    right = {
        stage: [pair for pair in of_result(pairs, "right") if pair[1]["freedom"]]
        for stage, pairs in found.items()
    }
    right = {stage: pairs for stage, pairs in right.items() if pairs}
    print("\n| chi2 / f in thirds of | " + " | ".join(right) + " |")
    print("|---|" + "---|" * len(right))
    beyond: dict[str, list[float]] = {stage: [] for stage in right}
    for name in next(iter(found.values()))[0][0]["strata"]:
        cells = []
        for stage, pairs in right.items():
            parts = [certainty(part) for part in _thirds(pairs, name) if part]
            cells.append(", ".join(f"{mean:.2f} ± {error:.2f}" for mean, error in parts))
            beyond[stage] += [_errors_beyond(*part) for part in parts]
        print(f"| {name} | " + " | ".join(cells) + " |")
    for stage, errors in beyond.items():
        n, far = sum(one > 0.0 for one in errors), sum(one > 2.0 for one in errors)
        print(
            f"{stage}: {n} of {len(errors)} thirds outside {WANTED[0]} to {WANTED[1]}, "
            f"{far} by more than two standard errors"
        )


def _thirds(pairs: Pairs, name: str) -> list[list[Row]]:
    value: FloatArray = np.array([row["strata"][name] for row, _ in pairs], dtype=np.float64)
    low, high = np.quantile(value, [1 / 3, 2 / 3])
    parts = [value <= low, (value > low) & (value <= high), value > high]
    return [[pairs[k][1] for k in np.flatnonzero(part)] for part in parts]


def _errors_beyond(mean: float, error: float) -> float:
    """How many standard errors a mean lies outside what is wanted; 0 within."""
    return max(WANTED[0] - mean, mean - WANTED[1], 0.0) / max(error, 1e-12)


def print_words(found: dict[str, Pairs]) -> None:
    """Reasons of refusals, warnings of wrong results, and how often right ones have a warning."""
    for result in RESULTS[1:]:
        print(f"\n{result}:")
        for stage, pairs in found.items():
            reasons: dict[str, list[int]] = {}
            for row, outcome in of_result(pairs, result):
                said = outcome["reason"] or "; ".join({kind(text) for text in outcome["warnings"]})
                reasons.setdefault(kind(said), []).append(row["seed"])
            for reason, seeds in sorted(reasons.items(), key=lambda item: -len(item[1])):
                first = ", ".join(map(str, seeds[:4]))
                print(f"  {stage}: {len(seeds)} x {reason or '(nothing said)'} (seeds {first})")
    print("\nwarnings of results that are right (a warning of what is weak is no alarm):")
    for stage, pairs in found.items():
        right = [outcome for _, outcome in of_result(pairs, "right")]
        for text, share in list(warned_shares(right).items())[:14]:
            print(f"  {stage}: {100 * share:.1f} % {text}")
