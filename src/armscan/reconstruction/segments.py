# SPDX-License-Identifier: Apache-2.0
"""Unbroken segments of stripes: within one, neighbouring points lie on one line of light. How names
go on along them, and from image to image: by the stripe's last place and by the surface.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.geometry.poses import Base, Points, Pose, Sensor
from armscan.kernels.chains import compare_light, cut_at_largest
from armscan.kernels.naming import find_steps, number_segments, take_every
from armscan.records.profile import Profile, StripeFlag

GAP_PX, GAP_STEPS = 6.0, 3.0
"""Accepted neighbours farther apart than this, and than so many of the profile's usual steps from
point to point, are not linked: a crossing or another line lies between."""
KINK_POINTS = 8
"""Points on either side from which direction and place at a kink are extrapolated."""
KINK_RAD = np.radians(20.0)
JUMP_PX, JUMP_SIGMAS = 0.6, 4.0
"""A line steps where it is off by more than both, the second in sigmas of its points."""
LIGHT_POINTS = 24
"""Points on either side of which the brightness is compared."""
LIGHT_STEP, LIGHT_SIGMAS = float(np.log(1.2)), 3.5
"""A line becomes another one's where its brightness changes by more than both, the second in usual
changes of it, which speckle makes."""
FAINTEST = 1.0
"""Grey level below which lines are equally dark."""
PIECE_PX, SAMPLE_PX = 24.0, 8.0
"""Lengths of pieces that are judged by themselves, and between samples on them."""


@dataclass(frozen=True, slots=True, eq=False)
class StripeSegments:
    """Accepted points of a profile with the unbroken segment of each.

    Parameters
    ----------
    row
        (A,) index of each accepted point in the profile.
    number
        (A,) number of its segment, counted from 0 without gaps; it lies in one chain of the profile
        (`Profile.segment`).
    """

    row: IntArray
    number: IntArray


def cut_segments(profile: Profile, *, at_light: bool = False) -> StripeSegments:
    """Cut the chains of a profile where they may pass from one line to another.

    That is where they end; at gaps; where rejected points near another line lie between, because
    a chain may follow the other line beyond a crossing; and where two lines happen to end at one
    another, which leaves a kink or a small step.

    Parameters
    ----------
    profile
        Stripe points in the order of their chains.
    at_light
        Also where the line becomes brighter or darker at once. At the edge of a thing the line on
        it may happen to go on as another line on what lies behind, too smoothly for a kink or a
        step; that the two are equally bright is another chance.
    """
    row = np.flatnonzero(profile.is_accepted)
    if not len(row):
        return StripeSegments(row, row)
    points, n = profile.points_px, len(row)
    step, is_cut, number = np.zeros(n), np.zeros(n, np.uint8), np.zeros(n, np.int64)
    find_steps(points, row, profile.segment, _is_beside(profile).view(np.uint8), step, is_cut)
    linked = step[is_cut == 0]
    usual = float(np.median(linked)) if len(linked) else 0.0
    is_cut[step > max(GAP_PX, GAP_STEPS * usual)] = 1
    if at_light:
        _cut_at_light(np.log(np.maximum(profile.intensity[row], FAINTEST)), is_cut)
    jump_px = max(JUMP_PX, JUMP_SIGMAS * float(np.median(profile.sigma_px[row])))
    normals = profile.normals_px
    if n < len(points):
        points, normals = points.take(row, axis=0), normals.take(row, axis=0)
    number_segments(points, normals, is_cut, KINK_POINTS, float(KINK_RAD), jump_px, number)
    return StripeSegments(row, number)


def _cut_at_light(light: FloatArray, is_cut: NDArray[np.uint8]) -> None:
    """Mark in ``is_cut`` (A,) where the logarithm of the brightness (A,) changes at once."""
    change = np.zeros(len(light))
    compare_light(light, is_cut, LIGHT_POINTS, change)
    told = change[change >= 0.0]
    if len(told):
        limit = max(LIGHT_STEP, LIGHT_SIGMAS * robust_sigma(told))
        cut_at_largest(change, limit, LIGHT_POINTS, is_cut)


def _is_beside(profile: Profile) -> BoolArray:
    """(N,) True for points with another line beside them."""
    return np.asarray((profile.flags & int(StripeFlag.NEIGHBOUR)) != 0)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Points that stand for their neighbours.

    Parameters
    ----------
    at
        (S,) index into the arrays of `StripeSegments`.
    weight
        (S,) points that a sample stands for, as a part of the usual number.
    nearest
        (A,) the sample that stands for each accepted point.
    """

    at: IntArray
    weight: FloatArray
    nearest: IntArray


def take_samples(segments: StripeSegments, every: int) -> Samples:
    """Every so many points of each long segment, more densely on short ones."""
    n = len(segments.row)
    at, nearest = np.zeros((2, n), np.int64)
    weight = np.zeros(n)
    count = take_every(segments.number, every, at, weight, nearest)
    return Samples(at[:count], weight[:count], nearest)


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Short pieces of segments, and the points by which these are judged.

    Parameters
    ----------
    of_point
        (N,) piece of each point of the profile; -1 for points that the extraction rejected.
    segment
        (P,) segment of each piece, not decreasing.
    sample
        (S,) points that are looked at, about every 8 px; each piece has at least one.
    of_sample
        (S,) their pieces, not decreasing.
    direction
        (P, 2) unit vectors along the pieces.
    is_joined
        (P,) True where the piece goes on from the one before: in its segment, or in the same chain
        beyond a kink or a gap with no other line beside it.
    """

    of_point: IntArray
    segment: IntArray
    sample: IntArray
    of_sample: IntArray
    direction: FloatArray
    is_joined: BoolArray

    def __len__(self) -> int:
        """Count of pieces."""
        return len(self.segment)

    @property
    def size(self) -> IntArray:
        """(P,) count of points."""
        return np.bincount(self.of_point[self.of_point >= 0], minlength=len(self))

    def mean(self, values: FloatArray) -> FloatArray:
        """(P, ...) mean over the samples of each piece of values (S, ...)."""
        count = np.bincount(self.of_sample, minlength=len(self))
        total = np.zeros((len(self), *values.shape[1:]))
        np.add.at(total, self.of_sample, values)
        return np.asarray(total / count.reshape(-1, *([1] * (values.ndim - 1))))


def cut_pieces(profile: Profile) -> Pieces:
    """Cut the segments of a profile every 24 px."""
    segments = cut_segments(profile)
    rows, number = segments.row, segments.number
    of_point = np.full(len(profile), -1)
    if not len(rows):
        return Pieces(of_point, rows, rows, rows, np.zeros((0, 2)), rows.astype(np.bool_))
    points = profile.points_px[rows]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc_px = np.concatenate([[0.0], np.cumsum(step)])
    along = arc_px - arc_px[np.flatnonzero(np.diff(number, prepend=-1))][number]
    piece = _renumbered(number, np.floor(along / PIECE_PX))
    of_point[rows] = piece
    sample = np.flatnonzero(np.diff(_renumbered(piece, np.floor(along / SAMPLE_PX)), prepend=-1))
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    n_beside = np.cumsum(_is_beside(profile))[rows]
    is_apart = (np.diff(profile.segment[rows]) != 0) | (np.diff(n_beside) > 0)
    return Pieces(
        of_point=of_point,
        segment=number[starts],
        sample=rows[sample],
        of_sample=piece[sample],
        direction=_directions(points, piece),
        is_joined=np.concatenate([[False], ~is_apart])[starts],
    )


def _renumbered(outer: IntArray, inner: FloatArray) -> IntArray:
    """Number runs of equal (outer, inner) from 0."""
    is_new = (np.diff(outer) != 0) | (np.diff(inner) != 0)
    return np.asarray(np.concatenate([[0], np.cumsum(is_new)]))


def _directions(points: FloatArray, piece: IntArray) -> FloatArray:
    """(P, 2) principal direction of the points of each piece."""
    n = int(piece[-1]) + 1
    count = np.bincount(piece, minlength=n)
    middle = np.stack([np.bincount(piece, points[:, k]) for k in range(2)], axis=1) / count[:, None]
    x, y = (points - middle[piece]).T
    xx, xy, yy = (np.bincount(piece, v, minlength=n) for v in (x * x, x * y, y * y))
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


SWITCH, SWITCH_AT_KINK = 1e-3, 0.02
"""Probabilities that the sheet changes unnoticed between two pieces: of a segment, and of a chain
that has a kink or a gap between them. It mostly is an edge of the surface; two lines that end at
one another are rare."""


def switch_probability(pieces: Pieces, n_sheets: int) -> FloatArray:
    """(P,) probability that a piece is of another sheet than the one before it."""
    is_same = np.diff(pieces.segment, prepend=-1) == 0
    joined = np.where(is_same, SWITCH, SWITCH_AT_KINK)
    return np.asarray(np.where(pieces.is_joined, joined, 1.0 - 1.0 / n_sheets))


def smoothed_posterior(log_likelihood: FloatArray, switch: FloatArray) -> FloatArray:
    """Posterior log-probability of each hypothesis for each piece, by forward and backward passes.

    Parameters
    ----------
    log_likelihood
        (P, H) of each piece under each hypothesis.
    switch
        (P,) from `switch_probability`; ``1 - 1 / H`` where the piece before tells nothing.

    Returns
    -------
    FloatArray
        (P, H) logarithms of the posterior probabilities.
    """
    n, h = log_likelihood.shape
    if h == 1 or not n:
        return np.zeros((n, h))
    stay, change = np.log1p(-switch), np.log(switch / (h - 1))
    step = np.where(np.eye(h, dtype=np.bool_), stay[:, None, None], change[:, None, None])
    ahead, behind = log_likelihood.copy(), np.zeros((n, h))
    for p in range(1, n):
        ahead[p] += np.logaddexp.reduce(ahead[p - 1][:, None] + step[p], axis=0)
    for p in range(n - 2, -1, -1):
        onward = (behind[p + 1] + log_likelihood[p + 1])[:, None] + step[p + 1]
        behind[p] = np.logaddexp.reduce(onward, axis=0)
    total = ahead + behind
    return np.asarray(total - np.logaddexp.reduce(total, axis=1, keepdims=True))


def likeliest(posterior: FloatArray) -> tuple[IntArray, FloatArray]:
    """(P,) likeliest hypothesis and its log-odds over all others together; infinite if alone."""
    best = posterior.argmax(axis=1)
    if posterior.shape[1] == 1:
        return best, np.full(len(best), np.inf)
    top = np.take_along_axis(posterior, best[:, None], axis=1)[:, 0]
    rest = posterior.copy()
    np.put_along_axis(rest, best[:, None], -np.inf, axis=1)
    return best, np.asarray(top - np.logaddexp.reduce(rest, axis=1))


STUDENT = 3.0
"""Degrees of freedom of the error's distribution: edges and sharp bends have long tails."""
REACH_PX = 60.0
"""A stripe is not looked for further from where it is expected."""
SIGMA_PX = 5.0
"""Of the expected place across the stripe; a hand's acceleration and the surface's shape."""
WINDOW_PX = 600.0
"""A stripe of which nothing is known may be anywhere over about this width."""
SHARPNESS = 0.15
"""What the prediction errs by is nearly the same all along a stripe."""
STIFFNESS = 20.0
"""Points' worth of belief that a stripe stands still, so that its motion is always determined."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stripe:
    points_px: FloatArray
    normals_px: FloatArray
    motion_px: FloatArray


@dataclass(slots=True, eq=False)
class ImageMemory:
    """The last stripe of each sheet with its motion from the one before."""

    _last: dict[int, _Stripe] = field(default_factory=dict)

    def __len__(self) -> int:
        """Count of sheets whose stripe was seen."""
        return len(self._last)

    def forget(self) -> None:
        """Begin anew."""
        self._last.clear()

    def remember(self, points_px: FloatArray, normals_px: FloatArray, sheet: IntArray) -> None:
        """Take in the named points (N, 2) of an exposure, their normals and sheets (N,)."""
        for k in np.unique(sheet).tolist():
            points, normals = points_px[sheet == k], normals_px[sheet == k]
            self._last[k] = _Stripe(points, normals, self._motion(k, points, normals))

    def log_gain(self, points_px: FloatArray, sheet: int) -> FloatArray:
        """How well new points (S, 2) continue a sheet's stripe.

        The logarithm (S,) of the density of their place, if they are of the sheet, over that of
        something new, which may be anywhere: 0 where nothing is expected.
        """
        gain = np.zeros(len(points_px))
        if sheet not in self._last or not len(points_px):
            return gain
        last = self._last[sheet]
        distance, index = _nearest(last, points_px)
        known = np.flatnonzero(distance < REACH_PX)
        place = last.points_px[index[known]] + last.motion_px
        across = np.einsum("ni,ni->n", points_px[known] - place, last.normals_px[index[known]])
        share = 1.0 + (across / SIGMA_PX) ** 2 / STUDENT
        peak = 2.0 / (np.pi * np.sqrt(STUDENT)) / SIGMA_PX
        gain[known] = np.log1p(WINDOW_PX * peak / share**2)
        return gain

    def _motion(self, sheet: int, points: FloatArray, normals: FloatArray) -> FloatArray:
        """(2,) motion since the last image: only its part across the stripe can be seen."""
        if sheet not in self._last:
            return np.zeros(2)
        last = self._last[sheet]
        distance, index = _nearest(last, points)
        near = distance < REACH_PX
        n = normals[near]
        step = np.einsum("ni,ni->n", points[near] - last.points_px[index[near]], n)
        return np.asarray(np.linalg.solve(n.T @ n + STIFFNESS * np.eye(2), n.T @ step))


def _nearest(last: _Stripe, points_px: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance (N,) to the nearest point of a stripe that moved on, and its index."""
    found = cKDTree(last.points_px + last.motion_px).query(points_px)
    return np.asarray(found[0]), np.asarray(found[1])


SPACING_MM = 0.5
"""Remembered points of one stripe are thinned to about this."""
N_NEAR = 32
REACH_MM = 5.0
"""Nothing is predicted further than this from all that is known."""
NOISE_MM = 0.04
"""Stripe, arm and calibration together, between exposures of one pass."""
BEND_PER_MM = 0.06
"""Half the curvature of surfaces, 1/mm: a plane is off by this times the distance squared."""
SLOPE = 1.0
"""Standard deviation, before anything is known, of a surface's slope towards the camera."""
EDGE_ON = 0.05
"""Least cosine between a surface's normal and the camera's axis, or sine of that to a sheet's."""
SHARP_MM = 0.3
"""Vaguer predictions err by the same all along a segment; the change is steep (fourth power)."""
AMID_MM, MOST_PULL, LEAST_AMID = 2.0, 0.5, 3
"""A place is seen again if so many known points lie within this of it, and not on one side: the
mean of the unit vectors to them is shorter than this (of a half disc it is 0.64)."""
MOST_ROUGH, ROUGHER, ROUGHEST, N_ROUGH = 1.0, 3.0, 3.0, 200
"""Chi-square, over its degrees of freedom, of the plane through a place that is seen again and the
known points around it. Between two levels a plane fits the points of neither. Known surfaces may
have so many times what their smooth quarter has, up to a most, told from so many points."""


@dataclass(slots=True, eq=False)
class SurfaceMemory:
    """Points in Base of the last exposures.

    Parameters
    ----------
    n_exposures
        How many exposures are remembered.
    depth_span_mm
        Width of the range over which a new surface is as likely at any depth.
    scale
        By which all lengths in mm grow in wide fields.
    """

    n_exposures: int = 40
    depth_span_mm: float = 60.0
    scale: float = 1.0
    _kept: deque[FloatArray] = field(default_factory=deque)
    _tree: cKDTree | None = None

    def __len__(self) -> int:
        """Count of remembered points."""
        return sum(len(points) for points in self._kept)

    def forget(self) -> None:
        """Begin anew."""
        self._kept.clear()
        self._tree = None

    def remember(self, points_base_mm: FloatArray) -> None:
        """Add the points (N, 3) of an exposure, in the order of their stripes."""
        points = points_base_mm / self.scale
        step = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
        # a jump between stripes counts for one step, so that each stripe's first point is kept
        arc = np.floor(np.cumsum(np.minimum(step, SPACING_MM)) / SPACING_MM)
        kept = points[np.diff(arc, prepend=-1.0) != 0]
        self._kept.append(kept)
        while len(self._kept) > self.n_exposures:
            self._kept.popleft()
        self._tree = None

    def evidence(
        self,
        points_sensor_mm: FloatArray,
        base_from_sensor: Pose[Base, Sensor],
        sheet_normal: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """How well points (S, 3) of a new exposure continue what is known.

        Where the surface is known nearby, it is continued by a local plane with a weak prior on
        its slope, so that the prediction is the vaguer the further it reaches, and the vaguer the
        closer it runs along the sheet of that normal (3,), in Sensor.

        Returns
        -------
        log_gain
            (S,) logarithm of the density of the point's depth over that of a new surface, which
            may be anywhere: 0 where nothing is known or the point does not fit.
        sharpness
            (S,) 1 for a prediction well within `SHARP_MM`, towards 0 the vaguer it is.
        """
        n = len(points_sensor_mm)
        gain, sharpness = np.zeros(n), np.zeros(n)
        if not n or not len(self):
            return gain, sharpness
        near, distance = self._neighbours(points_sensor_mm, base_from_sensor, REACH_MM)
        known = np.flatnonzero(np.isfinite(distance[:, 0]))
        if not len(known):
            return gain, sharpness
        near, distance = near[known], distance[known]
        offset, sigma = _continued(near @ base_from_sensor.rotation, distance, sheet_normal)
        share = 1.0 + (offset / sigma) ** 2 / STUDENT
        peak = 2.0 / (np.pi * np.sqrt(STUDENT)) / sigma
        gain[known] = np.log1p(self.depth_span_mm / self.scale * peak / share**2)
        sharpness[known] = 1.0 / (1.0 + (sigma / SHARP_MM) ** 4)
        return gain, sharpness

    def sees_again(
        self, points_sensor_mm: FloatArray, base_from_sensor: Pose[Base, Sensor]
    ) -> BoolArray:
        """(S,) True for points (S, 3) amid known ones, on one smooth surface with them.

        That is neither beyond the edge of what is known, nor between two levels of it.
        """
        if not len(self):
            return np.zeros(len(points_sensor_mm), dtype=np.bool_)
        near, distance = self._neighbours(points_sensor_mm, base_from_sensor, AMID_MM)
        is_near = np.isfinite(distance)
        towards = near / np.where(is_near & (distance > 0.0), distance, np.inf)[..., None]
        n_near = is_near.sum(axis=1)
        pull = np.linalg.norm(towards.sum(axis=1), axis=1) / np.maximum(n_near, 1)
        is_amid = (n_near >= LEAST_AMID) & (pull < MOST_PULL)
        return np.asarray(is_amid & (_roughness(near, distance) < self._most_rough()))

    def _most_rough(self) -> float:
        """Most roughness about a place on one surface: what known surfaces have, if that is more.

        An arm that errs more than is expected scatters them all; the quarter that is least rough
        has no steps.
        """
        known = np.concatenate(self._kept)
        some = known[:: max(len(known) // N_ROUGH, 1)]
        usual = np.quantile(_roughness(*self._around(some, AMID_MM)), 0.25)
        return float(np.clip(ROUGHER * usual, MOST_ROUGH, ROUGHEST))

    def _neighbours(
        self, points_sensor_mm: FloatArray, base_from_sensor: Pose[Base, Sensor], reach_mm: float
    ) -> tuple[FloatArray, FloatArray]:
        """From each place to known points around it, see `_around`."""
        in_sensor: Points[Sensor] = Points(points_sensor_mm)
        return self._around((base_from_sensor @ in_sensor).xyz_mm / self.scale, reach_mm)

    def _around(self, places: FloatArray, reach_mm: float) -> tuple[FloatArray, FloatArray]:
        """From places (S, 3) to known points around each: (S, K, 3) in Base, and distances (S, K),
        infinite where there are no more.
        """
        if self._tree is None:
            self._tree = cKDTree(np.concatenate(self._kept))
        found = self._tree.query(places, k=N_NEAR, distance_upper_bound=reach_mm)
        distance, index = np.asarray(found[0]), np.asarray(found[1])
        near = self._tree.data[np.where(np.isfinite(distance), index, 0)] - places[:, None]
        return near, distance


def _scatter(
    near_mm: FloatArray, distance_mm: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weight (S,), middle (S, 3) and scatter about it (S, 3, 3) of neighbours (S, K, 3)."""
    is_near = np.isfinite(distance_mm)
    bend = BEND_PER_MM * np.where(is_near, distance_mm, 0.0) ** 2
    weight = is_near / (NOISE_MM**2 + bend**2)
    total = weight.sum(axis=1)
    near = np.where(is_near[..., None], near_mm, 0.0)
    middle = np.einsum("sk,ski->si", weight, near) / total[:, None]
    off = near - middle[:, None]
    return total, middle, (off * weight[..., None]).transpose(0, 2, 1) @ off


def _roughness(near_mm: FloatArray, distance_mm: FloatArray) -> FloatArray:
    """(S,) chi-square over its freedom of the plane through each place and its neighbours."""
    near = np.pad(near_mm, ((0, 0), (1, 0), (0, 0)))
    scatter = _scatter(near, np.pad(distance_mm, ((0, 0), (1, 0))))[2]
    n_near = np.isfinite(distance_mm).sum(axis=1)
    return np.asarray(np.linalg.eigvalsh(scatter)[:, 0] / np.maximum(n_near - 2, 1))


def _continued(
    near_mm: FloatArray, distance_mm: FloatArray, sheet_normal: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Depth (S,) of the surface over each place, from its neighbours (S, K, 3), and its sigma.

    The plane of least squared distances, so that a wall seen edge-on is a plane like any other: to
    depths over the image plane, noise across the wall would be a slope, and the plane beside it.
    Where that plane runs along the sheet it tells nothing: no light falls on a wall within the
    sheet, and all that the sheet may have drawn lies on it. A stripe that jumps gives such planes.
    """
    total, middle, scatter = _scatter(near_mm, distance_mm)
    scatter[:, [0, 1], [0, 1]] += SLOPE**-2
    size, axes = np.linalg.eigh(scatter)
    normal = axes[:, :, 0]
    along = np.einsum("sij,si->sj", axes, middle)
    # what scatters across the plane scatters along it too, and tells nothing of its slope
    spread = np.maximum(size[:, 1:] - size[:, :1], SLOPE**-2)
    variance = NOISE_MM**2 + 1.0 / total + (along[:, 1:] ** 2 / spread).sum(axis=1)
    facing = np.abs(normal[:, 2])
    if sheet_normal is not None:
        facing = np.minimum(facing, np.linalg.norm(np.cross(normal, sheet_normal), axis=1))
    facing = np.maximum(facing, EDGE_ON)
    return along[:, 0] / facing, np.sqrt(variance) / facing


LEAST_SEEN = 30
"""Points of a laser that is on alone; with fewer its line is not on the part."""


class LoneLines:
    """Lasers of one line each that a pass lit alone, and what they showed.

    Parameters
    ----------
    source_of
        Source of each sheet; of one that draws several lines none is ever alone.

    Attributes
    ----------
    shown, absent
        Sheets whose line was seen when it was on alone, and those whose line was not, nor since:
        one that was seen once may come back at any time.
    """

    def __init__(self, source_of: tuple[str, ...]) -> None:
        self._sheet_of = {s: k for k, s in enumerate(source_of) if source_of.count(s) == 1}
        self._asked: set[int] = set()
        self.shown: set[int] = set()
        self.absent: set[int] = set()

    def reset(self) -> None:
        """Begin a new pass; a round that was not finished goes on, for where exposures are seconds
        apart each is a pass by itself.
        """
        self.shown.clear()
        self.absent.clear()
        if not self.due:
            self._asked.clear()

    @property
    def due(self) -> tuple[str, ...]:
        """Sources that are still to be lit alone."""
        return tuple(s for s, k in self._sheet_of.items() if k not in self._asked)

    def learn(self, possible: tuple[int, ...], sheet: IntArray) -> None:
        """Take in an exposure in which the sheets ``possible`` were on, by its names (N,).

        While nothing at all was seen, the head is in the air: that tells of no line.
        """
        self.absent -= set(sheet.tolist())
        if len(possible) != 1:
            return
        is_seen = int((sheet >= 0).sum()) >= LEAST_SEEN
        if is_seen and not self.shown:
            self._asked -= self.absent
            self.absent.clear()
        (self.shown if is_seen else self.absent).update(possible)
        self.absent -= self.shown
        self._asked.update(possible)
        if not self.due and not self.shown:
            self._asked.clear()
            self.absent.clear()
