# SPDX-License-Identifier: Apache-2.0
"""Stripe points on a flat board, sorted into straight stripes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.laser.options import SheetOptions
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Line, fit_line

TRIALS = 300
MAX_SCORED = 1500
"""Points that vote on a trial line; more are thinned out evenly."""
MIN_SPAN = 0.15
"""A stripe is at least this long, as a fraction of the board's shorter side."""
COURSE_DEGREE = 3
"""Degree of the gentle curve that a bowed sheet may draw on a flat board."""
COURSE_ROUNDS = 20
HUBER = 1.0
"""In robust sigmas: low, because what is off a stripe may be many points on one side."""
SEED = 20


@dataclass(frozen=True, slots=True, eq=False)
class StraightStripe:
    """Points of one straight stripe: ``rows`` (K,) into the points given, and its line (2-D)."""

    rows: IntArray
    line: Line


def find_straight_stripes(
    points_board_mm: FloatArray,
    sigma_mm: FloatArray,
    segment: IntArray,
    board_size_mm: tuple[float, float],
    options: SheetOptions,
    *,
    n_lines: int = 0,
) -> list[StraightStripe]:
    """Group points on the board into straight stripes, the one with the most points first.

    Lines through two points of one segment, or of two, are tried with a fixed seed; the best
    supported one is refined, its points are taken away, and the search goes on.

    Parameters
    ----------
    points_board_mm
        (N, 2) points in the board's plane.
    sigma_mm
        (N,) standard deviation across the stripe.
    segment
        (N,) connected segment of each point.
    board_size_mm
        Width and height of the board's known region.
    options
        Tolerances.
    n_lines
        Most stripes to look for; 0 for all.
    """
    stripes: list[StraightStripe] = []
    rest = np.arange(len(points_board_mm))
    shortest_mm = MIN_SPAN * min(board_size_mm)
    limit = n_lines or len(points_board_mm)
    generator = np.random.default_rng(SEED)
    while len(rest) >= options.min_points and len(stripes) < limit:
        line = _best_line(points_board_mm[rest], segment[rest], options, generator)
        if line is None:
            break
        near = np.abs(line.distance(points_board_mm[rest])) < options.line_tolerance_mm
        keep = _on_course(points_board_mm[rest], sigma_mm[rest], line, near, options)
        chosen = rest[keep]
        if len(chosen) < options.min_points:
            break
        # Outliers of a stripe already found must not come back as a stripe of their own.
        rest = rest[~keep & ~(near & _is_repeat(line, points_board_mm[chosen], stripes, options))]
        refined = fit_line(points_board_mm[chosen], sigma_mm[chosen] ** -2.0)
        if isinstance(refined, FitFailure):
            break
        along = refined.along(points_board_mm[chosen])
        repeats = _is_repeat(refined, points_board_mm[chosen], stripes, options)
        if not repeats and float(np.ptp(along)) >= shortest_mm:
            stripes.append(StraightStripe(chosen[np.argsort(along)], refined))
    return sorted(stripes, key=lambda stripe: -len(stripe.rows))


def _best_line(
    points: FloatArray, segment: IntArray, options: SheetOptions, generator: np.random.Generator
) -> Line | None:
    """Try lines through pairs of points; half of the pairs within one segment."""
    n = len(points)
    first = generator.integers(n, size=TRIALS)
    second = generator.integers(n, size=TRIALS)
    _, own, counts = np.unique(segment, return_inverse=True, return_counts=True)
    by_segment = np.argsort(own, kind="stable")
    starts = np.cumsum(counts) - counts
    half = own[first[::2]]
    second[::2] = by_segment[starts[half] + generator.integers(counts[half])]
    step = points[second] - points[first]
    length = np.linalg.norm(step, axis=1)
    usable = length > 2.0 * options.line_tolerance_mm
    if not usable.any():
        return None
    first, step, length = first[usable], step[usable], length[usable]
    direction = step / length[:, None]
    scored = points[:: max(1, n // MAX_SCORED)]
    offset = scored[None, :, :] - points[first][:, None, :]
    distance = np.abs(
        direction[:, None, 0] * offset[:, :, 1] - direction[:, None, 1] * offset[:, :, 0]
    )
    # Truncated squares rather than counts: of two lines in one band the centred one wins.
    score = np.maximum(1.0 - (distance / options.line_tolerance_mm) ** 2, 0.0).sum(axis=1)
    best = int(np.argmax(score))
    line = Line(points[first[best]], direction[best])
    for _ in range(3):
        near = np.abs(line.distance(points)) < options.line_tolerance_mm
        refined = fit_line(points[near])
        if isinstance(refined, FitFailure):
            return None
        line = refined
    return line


def _on_course(
    points: FloatArray, sigma_mm: FloatArray, line: Line, near: BoolArray, options: SheetOptions
) -> BoolArray:
    """Keep the points within the outlier limit of a gentle curve along the line."""
    along, across = line.along(points), line.distance(points)
    reach = max(float(np.abs(along[near]).max(initial=0.0)), 1e-9)
    design = np.polynomial.legendre.legvander(along / reach, COURSE_DEGREE)
    if int(near.sum()) <= 2 * (COURSE_DEGREE + 1):
        return near
    scaled, target = design[near] / sigma_mm[near, None], across[near] / sigma_mm[near]
    weight = np.ones(len(target))
    for _ in range(COURSE_ROUNDS):
        root = np.sqrt(weight)
        course = np.linalg.lstsq(scaled * root[:, None], target * root, rcond=None)[0]
        missed = np.abs(target - scaled @ course)
        scale = max(1.0, 1.4826 * float(np.median(missed)))
        weight = HUBER * scale / np.maximum(missed, HUBER * scale)
    normalised = (across - design @ course) / sigma_mm
    return np.asarray(near & (np.abs(normalised) < options.outlier_sigma * scale))


def _is_repeat(
    line: Line, points: FloatArray, stripes: list[StraightStripe], options: SheetOptions
) -> bool:
    """True if the line runs along a stripe already found over all of its points."""
    ends = line.at(np.array([line.along(points).min(), line.along(points).max()]))
    limit = 2.0 * options.line_tolerance_mm
    return any(bool((np.abs(s.line.distance(ends)) < limit).all()) for s in stripes)
