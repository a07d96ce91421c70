# SPDX-License-Identifier: Apache-2.0
"""Two cameras as printed: a point from two pixels (eqs. 4.6, 4.7), coded lines of markers (4.22 to
4.25), and the eight steps of matching (4.3.1).

With A, B, C, D in order along the line the cross ratio of eq. 4.24, ``(AC / BC) / (AD / BD)``, does
not change when the line is read from its other end, so that it names a code of four points but
not its direction: some perspective turns every four points round. Only how strong a perspective
that takes can tell; see `MAX_PERSPECTIVE`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray, homogeneous
from armscan.geometry.estimate import FitFailure
from armscan.markers.alignments import LabelledMarkers, label_markers, paired_count
from armscan.models.two_views import PARALLEL_SINE, TwoViews
from armscan.records.points import MarkerSet

CODE_POINTS = 4
MAX_PERSPECTIVE = 0.3
"""Largest ratio of the distances from the camera of a line's two ends, minus 1, that is believed
when the direction is decided."""
MAX_SIGMAS = 4.0
"""Largest distance of a point from the line and of the ratio from a code's, in their standard
deviations. Two codes within it make the points ambiguous."""


def simple_ratio(a: float, b: float, c: float) -> float:
    """``SR(A, B, C) = AC / BC`` of directed lengths (eqs. 4.22 and 4.23)."""
    return (c - a) / (c - b)


def cross_ratio(a: float, b: float, c: float, d: float) -> float:
    """``CR(A, B, C, D) = SR(A, B, C) / SR(A, B, D)`` (eq. 4.24); invariant by eq. 4.25.

    The 24 orders of four points have six values: r, 1 / r, 1 - r, 1 / (1 - r), (r - 1) / r and
    r / (r - 1). In order along the line it is greater than 1.
    """
    return simple_ratio(a, b, c) / simple_ratio(a, b, d)


@dataclass(frozen=True, slots=True)
class LineCode:
    """Four points on a line, and what they stand for; their places along it increase."""

    name: str
    positions_mm: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.positions_mm) != CODE_POINTS or not (np.diff(self.positions_mm) > 0.0).all():
            raise InputError(
                f"code {self.name} has the positions {self.positions_mm}",
                remedy="give four that increase",
            )

    @property
    def ratio(self) -> float:
        """Its cross ratio."""
        a, b, c, d = self.positions_mm
        return cross_ratio(a, b, c, d)


def parse_code(text: str) -> LineCode:
    """Read ``NAME=A,B,C,D``: a code and the places of its four points along their line, mm.

    `OptionError` if it is not of that form, or the places do not increase.
    """
    name, _, places = text.partition("=")
    try:
        return LineCode(name.strip(), tuple(float(place) for place in places.split(",")))
    except (ValueError, InputError) as error:
        raise OptionError(
            f"'{text}' is no code",
            where="--code",
            remedy="write NAME=0,10,25,45: four places along the line, increasing",
        ) from error


@dataclass(frozen=True, slots=True, eq=False)
class DecodedLine:
    """A code found in an image.

    Parameters
    ----------
    name
        Of the code.
    points
        (4,) rows of the points, in the order of the code's positions; if the direction is not
        known, in the order along the line that starts at the row named first.
    is_direction_known
        False where the points may as well be those of the code read from its other end.
    ratio, sigma
        The cross ratio measured and its standard deviation.
    """

    name: str
    points: IntArray
    is_direction_known: bool
    ratio: float
    sigma: float


def decode_line(
    points_px: FloatArray,
    covariance_px2: FloatArray,
    codes: tuple[LineCode, ...],
) -> DecodedLine | FitFailure:
    """Name four points, given in any order, or say why not.

    Parameters
    ----------
    points_px
        (4, 2) image points, free of distortion.
    covariance_px2
        (4, 2, 2) their covariance.
    codes
        The codes that there are.
    """
    middle = points_px.mean(axis=0)
    direction = np.linalg.svd(points_px - middle)[2][0]
    across = np.array([-direction[1], direction[0]])
    off = (points_px - middle) @ across
    sigma_off = np.sqrt(np.einsum("i,nij,j->n", across, covariance_px2, across))
    if (np.abs(off) > MAX_SIGMAS * sigma_off).any():
        return FitFailure(
            f"a point lies {np.abs(off).max():.2g} px off the line", "take points on one line"
        )
    along = (points_px - middle) @ direction
    order = np.argsort(along, kind="stable")
    t = along[order]
    variance = np.einsum("i,nij,j->n", direction, covariance_px2[order], direction)
    if (np.diff(t) < MAX_SIGMAS * np.sqrt(variance[:-1] + variance[1:])).any():
        return FitFailure("two points coincide", "leave one of them out")
    ratio, sigma = _ratio_with_sigma(t, variance)
    fitting = [code for code in codes if abs(ratio - code.ratio) <= MAX_SIGMAS * sigma]
    if not fitting:
        return FitFailure(f"no code has the cross ratio {ratio:.4g} +- {sigma:.2g}")
    if len(fitting) > 1:
        names = " and ".join(code.name for code in fitting)
        return FitFailure(
            f"the cross ratio {ratio:.4g} +- {sigma:.2g} is that of {names}",
            "use codes that differ more, or larger images",
        )
    code = fitting[0]
    forward, backward = (_perspective(code, way * t[::way]) for way in (1, -1))
    is_forward, is_backward = (p <= MAX_PERSPECTIVE for p in (forward, backward))
    if not (is_forward or is_backward):
        return FitFailure(
            f"code {code.name} would need its ends' distances to differ by "
            f"{100.0 * min(forward, backward):.0f} %",
        )
    named = order[::-1] if is_backward and not is_forward else order
    return DecodedLine(code.name, named, is_forward != is_backward, ratio, sigma)


def find_coded_lines(
    points_px: FloatArray,
    covariance_px2: FloatArray,
    codes: tuple[LineCode, ...],
) -> tuple[DecodedLine, ...]:
    """Every code among N points; a point that two codes claim makes both void.

    Arguments as of `decode_line`.
    """
    sigma = np.sqrt(np.linalg.eigvalsh(covariance_px2)[:, 1]) if len(points_px) else np.zeros(0)
    found: list[DecodedLine] = []
    for first, last in combinations(range(len(points_px)), 2):
        span = points_px[last] - points_px[first]
        length = float(np.linalg.norm(span))
        offset = points_px - points_px[first]
        share = offset @ span / length**2
        off = np.abs(offset[:, 0] * span[1] - offset[:, 1] * span[0]) / length
        between = np.flatnonzero((share > 0.0) & (share < 1.0) & (off < 2.0 * MAX_SIGMAS * sigma))
        for inner in combinations(between.tolist(), CODE_POINTS - 2):
            rows = np.array([first, *inner, last])
            line = decode_line(points_px[rows], covariance_px2[rows], codes)
            if isinstance(line, DecodedLine):
                found.append(replace(line, points=rows[line.points]))
    uses = np.bincount(
        np.array([row for line in found for row in line.points], dtype=np.int64),
        minlength=len(points_px),
    )
    return tuple(line for line in found if (uses[line.points] == 1).all())


def _ratio_with_sigma(t: FloatArray, variance: FloatArray) -> tuple[float, float]:
    """Cross ratio of four places in order, and its standard deviation.

    The logarithm is ``ln AC + ln BD - ln BC - ln AD``, whose derivatives are sums of inverse
    lengths.
    """
    a, b, c, d = (float(value) for value in t)
    ac, bc, ad, bd = c - a, c - b, d - a, d - b
    slopes = np.array([1 / ad - 1 / ac, 1 / bc - 1 / bd, 1 / ac - 1 / bc, 1 / bd - 1 / ad])
    ratio = cross_ratio(a, b, c, d)
    return ratio, abs(ratio) * float(np.sqrt(slopes**2 @ variance))


def _perspective(code: LineCode, t: FloatArray) -> float:
    """Ratio of the distances of the code's ends, minus 1, if ``t`` are its places in the image.

    The homography of the line, ``t = (p s + q) / (1 + r s)`` with s the place along the code, has
    the distance from the camera, up to scale, as its denominator.
    """
    s = np.array(code.positions_mm) - code.positions_mm[0]
    length = s[-1]
    unit = (t - t[0]) / (t[-1] - t[0])
    # t unit: u (1 + r s) = p s, u - p s + r u s = 0 in the unknowns p and r, s as share of length.
    share = s / length
    design = np.column_stack([share, -unit * share])
    solution = np.linalg.lstsq(design, unit, rcond=None)[0]
    depth = 1.0 + float(solution[1])
    return max(depth, 1.0 / depth) - 1.0 if depth > 0.0 else float("inf")


def match_after_thesis(first: MarkerSet, second: MarkerSet, limit_mm: float) -> IntArray:
    """Match markers by the eight steps of 4.3.1.

    A first pair is found by the labels alone (steps (1)-(5)); every other marker is then matched
    by its distance to that pair alone (steps (6)-(8)), so two markers at equal distances from it
    are confused. Nothing is checked afterwards. Known failures: equal distances, a wrong first
    pair, markers that only one set holds.

    Returns
    -------
    pairs
        (K, 2) indices into first and second, each index once ("uniqueness"); empty if no label
        has a unique best partner.
    """
    a, b = label_markers(first), label_markers(second)
    start = _first_pair(a, b, limit_mm)
    return np.zeros((0, 2), dtype=np.int64) if start is None else _grown(a, b, start, limit_mm)


def _first_pair(a: LabelledMarkers, b: LabelledMarkers, limit_mm: float) -> tuple[int, int] | None:
    """Steps (4) and (5): the first marker whose greatest count of paired distances is unique."""
    for i, label in enumerate(a.labels_mm):
        counts = np.array([paired_count(label, other, limit_mm) for other in b.labels_mm])
        best = np.flatnonzero(counts == counts.max(initial=0))
        if len(best) == 1 and counts[best[0]] > 0:
            return i, int(best[0])
    return None


def _grown(
    a: LabelledMarkers, b: LabelledMarkers, start: tuple[int, int], limit_mm: float
) -> IntArray:
    """Steps (6) to (8): markers at an equal distance from the first pair."""
    pairs = [start]
    taken = {start[1]}
    reach: FloatArray = b.distance_mm[start[1]]
    for i, distance in enumerate(a.distance_mm[start[0]]):
        if i == start[0]:
            continue
        difference = np.abs(reach - distance)
        difference[list(taken)] = np.inf
        k = int(np.argmin(difference))
        if difference[k] < limit_mm:
            pairs.append((i, k))
            taken.add(k)
    return np.array(pairs, dtype=np.int64)


def triangulate_directly(views: TwoViews, left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """Points by the closed form of eq. 4.7.

    It uses both coordinates of the left pixel and the first one of the right; what the second one
    says against them is not looked at. Ideal normalised coordinates take the place of
    ``u / f``, so that the two focal lengths of a camera may differ and the lens may distort.

    Parameters
    ----------
    views
        The cameras.
    left_px, right_px
        (N, 2) pixels as taken, row by row of one point.

    Returns
    -------
    points_sensor_mm
        (N, 3); NaN where a pixel cannot be undistorted, the point lies behind the left camera, or
        the epipolar line runs along v in the right image, so that its u says nothing.
    """
    left, left_ok = views.left.undistort(left_px)
    right, right_ok = views.right.undistort(right_px)
    rotation = views.right_from_left.rotation
    translation = views.right_from_left.translation_mm
    rays = homogeneous(left)
    turned = rays @ rotation.T
    u = right[:, 0]
    below = u * turned[:, 2] - turned[:, 0]
    above = translation[0] - u * translation[2]
    is_known = left_ok & right_ok & (np.abs(below) > PARALLEL_SINE)
    depth = np.where(is_known, above / np.where(is_known, below, 1.0), np.nan)
    depth = np.where(depth > 0.0, depth, np.nan)
    return np.asarray(depth[:, None] * rays)
