# SPDX-License-Identifier: Apache-2.0
"""Sheets of the stripes of crossed lasers, from what the past of a pass showed."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Base, Points, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.image_memory import SHARPNESS, ImageMemory
from armscan.reconstruction.label_single import DepthRange
from armscan.reconstruction.labels import STROKE_GAP_NS, LabelledProfile, LabelStatus
from armscan.reconstruction.stretches import Pieces, cut_pieces
from armscan.reconstruction.triangulate import intersect_sheets
from armscan.records.profile import Profile

SPACING_MM = 0.5
"""Remembered points of one stripe are thinned to about this."""
N_NEAR = 32
REACH_MM = 5.0
"""Nothing is predicted further than this from all that is known."""
NOISE_MM = 0.04
"""Stripe, arm and calibration together, between exposures of one stroke."""
BEND_PER_MM = 0.06
"""Half the curvature of surfaces, 1/mm: a plane is off by this times the distance squared."""
SLOPE = 1.0
"""Standard deviation, before anything is known, of a surface's slope towards the camera."""
SHARP_MM = 0.3
"""Vaguer predictions err by the same all along a stretch."""
STUDENT = 3.0
"""Degrees of freedom of the error's distribution: edges and sharp bends have long tails."""


@dataclass(slots=True, eq=False)
class SurfaceMemory:
    """Points in Base of the last exposures.

    Parameters
    ----------
    n_exposures
        How many exposures are remembered.
    depth_span_mm
        Width of the range over which a new surface is as likely at any depth.
    """

    n_exposures: int = 40
    depth_span_mm: float = 60.0
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
        step = np.linalg.norm(np.diff(points_base_mm, axis=0, prepend=points_base_mm[:1]), axis=1)
        # a jump between stripes counts for one step, so that each stripe's first point is kept
        way = np.floor(np.cumsum(np.minimum(step, SPACING_MM)) / SPACING_MM)
        kept = points_base_mm[np.diff(way, prepend=-1.0) != 0]
        self._kept.append(kept)
        while len(self._kept) > self.n_exposures:
            self._kept.popleft()
        self._tree = None

    def evidence(
        self, points_sensor_mm: FloatArray, base_from_sensor: Pose[Base, Sensor]
    ) -> tuple[FloatArray, FloatArray]:
        """How well points (S, 3) of a new exposure continue what is known.

        Where the surface is known nearby, it is continued by a local plane with a weak prior on
        its slope, so that the prediction is the vaguer the further it reaches.

        Returns
        -------
        log_gain
            (S,) logarithm of the density of the point's depth over that of a new surface, which
            may be anywhere: 0 where nothing is known or the point does not fit.
        sharpness
            (S,) 1 for a prediction to within `SHARP_MM`, towards 0 the vaguer it is.
        """
        n = len(points_sensor_mm)
        gain, sharpness = np.zeros(n), np.zeros(n)
        if self._tree is None and len(self):
            self._tree = cKDTree(np.concatenate(self._kept))
        if self._tree is None or not n:
            return gain, sharpness
        in_sensor: Points[Sensor] = Points(points_sensor_mm)
        places = (base_from_sensor @ in_sensor).xyz_mm
        found = self._tree.query(places, k=N_NEAR, distance_upper_bound=REACH_MM)
        distance, index = np.asarray(found[0]), np.asarray(found[1])
        known = np.flatnonzero(np.isfinite(distance[:, 0]))
        if not len(known):
            return gain, sharpness
        distance = distance[known]
        is_near = np.isfinite(distance)
        near = self._tree.data[np.where(is_near, index[known], 0)] - places[known, None]
        offset, sigma = _continued(near @ base_from_sensor.rotation, distance, is_near)
        share = 1.0 + (offset / sigma) ** 2 / STUDENT
        peak = 2.0 / (np.pi * np.sqrt(STUDENT)) / sigma
        gain[known] = np.log1p(self.depth_span_mm * peak / share**2)
        sharpness[known] = 1.0 / (1.0 + (sigma / SHARP_MM) ** 2)
        return gain, sharpness


def _continued(
    near_mm: FloatArray, distance_mm: FloatArray, is_near: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Depth (S,) of the surface over each place, from its neighbours (S, K, 3), and its sigma."""
    bend = BEND_PER_MM * np.where(is_near, distance_mm, 0.0) ** 2
    weight = is_near / (NOISE_MM**2 + bend**2)
    x, y, z = np.moveaxis(np.where(is_near[..., None], near_mm, 0.0), 2, 0)
    design = np.stack([np.ones_like(x), x, y], axis=2)
    weighted = design * weight[..., None]
    normal = weighted.transpose(0, 2, 1) @ design
    normal[:, [1, 2], [1, 2]] += SLOPE**-2
    right = (weighted.transpose(0, 2, 1) @ z[..., None])[..., 0]
    covariance = np.linalg.inv(normal)
    offset = np.einsum("si,si->s", covariance[:, 0], right)
    return offset, np.sqrt(covariance[:, 0, 0] + NOISE_MM**2)


OUTSIDE = -4.0
"""Log-likelihood of a piece that lies outside the depths of a sheet, over one that is inside."""
DIRECTION_RAD = np.radians(25.0)
"""Standard deviation of a stripe's direction from that on a surface that faces the camera."""
ODD_DIRECTION = 0.1
"""Share of stripes that run in any direction: walls and edges."""
ALIKE_PIECES = 8
"""Over so many pieces of a stretch, some 5 mm, what misleads one of them misleads all."""
INDEPENDENT = 0.5
"""Of sharp predictions: neighbouring pieces share some of what they err by."""
TAKEN = -3.0
"""Log-likelihood of a piece whose place in the sheet's light is taken by another stretch."""
RAY_MM = 1.0
"""Along the sheet, light within this counts as one ray of the laser."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What the samples of a profile would be in space under each of H sheets.

    Parameters
    ----------
    sheets
        (H,) indices into the sensor's sheets.
    points_mm
        (H, S, 3) in Sensor.
    is_inside
        (S, H) True where the point exists, within the depths accepted.
    place_mm
        (H, S) coordinate along the sheet.
    """

    sheets: tuple[int, ...]
    points_mm: FloatArray
    is_inside: BoolArray
    place_mm: FloatArray


def hypothesise(
    points_px: FloatArray,
    sheets: tuple[int, ...],
    sensor: SensorCalibration,
    depths: DepthRange,
) -> Hypotheses:
    """Meet the rays of samples (S, 2) with each sheet."""
    points, inside, place = [], [], []
    for k in sheets:
        met, is_met = intersect_sheets(points_px, np.full(len(points_px), k), sensor)
        low, high = depths.limits_mm(sensor.sheets[k])
        sheet = sensor.sheets[k].sheet
        points.append(met)
        inside.append(is_met & (met[:, 2] >= low) & (met[:, 2] <= high))
        place.append((met - sheet.origin_mm) @ sheet.axes[0])
    return Hypotheses(sheets, np.array(points), np.array(inside).T, np.array(place))


def still_evidence(pieces: Pieces, hypotheses: Hypotheses, sensor: SensorCalibration) -> FloatArray:
    """(P, H) log-likelihood of the pieces' depths and directions, in this exposure alone."""
    depth = OUTSIDE * pieces.mean((~hypotheses.is_inside).astype(np.float64))
    direction = _direction_evidence(pieces, hypotheses.sheets, sensor)
    return np.asarray(_vote(pieces) * (depth + direction))


def _vote(pieces: Pieces) -> FloatArray:
    """(P, 1) weights by which the pieces of a stretch do not count for more than they know."""
    count = np.bincount(pieces.stretch)[pieces.stretch]
    return np.asarray(np.minimum(1.0, 1.0 / count + 1.0 / ALIKE_PIECES)[:, None])


def _direction_evidence(
    pieces: Pieces, sheets: tuple[int, ...], sensor: SensorCalibration
) -> FloatArray:
    turn = np.stack(
        [_angle_between(pieces.direction, frontal_direction(sensor, k)) for k in sheets], axis=1
    )
    usual = np.exp(-0.5 * (turn / DIRECTION_RAD) ** 2)
    return np.asarray(np.log((1.0 - ODD_DIRECTION) * usual + ODD_DIRECTION))


def frontal_direction(sensor: SensorCalibration, sheet: int) -> FloatArray:
    """(2,) direction, in the image, of a sheet's stripe on a surface that faces the camera."""
    model = sensor.sheets[sheet].sheet
    along = np.cross(model.axes[2], [0.0, 0.0, 1.0])
    ends = model.origin_mm + np.array([[-1.0], [1.0]]) * along
    first, last = sensor.camera.camera.project(ends)
    return np.asarray((last - first) / np.linalg.norm(last - first))


def _angle_between(direction: FloatArray, line: FloatArray) -> FloatArray:
    """(P,) angles in 0 to 90 degrees between directions (P, 2) and a line."""
    return np.asarray(np.arccos(np.clip(np.abs(direction @ line), 0.0, 1.0)))


def past_evidence(pieces: Pieces, log_gain: FloatArray, sharpness: FloatArray) -> FloatArray:
    """(P, H) log-likelihood of the pieces, from how well their samples continue the past.

    Sharp predictions err apart from piece to piece, vague ones in common.

    Parameters
    ----------
    pieces
        Of the profile.
    log_gain, sharpness
        (S, H) from `armscan.reconstruction.label_cross.SurfaceMemory.evidence`.
    """
    sharp = INDEPENDENT * pieces.mean(log_gain * sharpness)
    vague = _vote(pieces) * pieces.mean(log_gain * (1.0 - sharpness))
    return np.asarray(sharp + vague)


def taken_evidence(log_posterior: FloatArray, pieces: Pieces, hypotheses: Hypotheses) -> FloatArray:
    """(P, H) penalty where another stretch already holds the same rays of a sheet's light.

    A ray of a laser ends on the first thing that it meets, so it is seen once.

    Parameters
    ----------
    log_posterior
        (P, H) what is believed without this.
    pieces, hypotheses
        Of the profile.
    """
    of_sample = pieces.of_sample
    stretch = pieces.stretch[of_sample]
    penalty = np.zeros(hypotheses.is_inside.shape)
    for h in range(len(hypotheses.sheets)):
        belief = np.where(hypotheses.is_inside[:, h], np.exp(log_posterior[of_sample, h]), 0.0)
        ray = np.floor(hypotheses.place_mm[h] / RAY_MM).astype(np.int64)
        ray -= ray.min(initial=0)
        table = np.zeros((int(stretch.max(initial=0)) + 1, int(ray.max(initial=0)) + 1))
        np.maximum.at(table, (stretch, ray), belief)
        penalty[:, h] = TAKEN * _most_of_others(table)[stretch, ray]
    return np.asarray(_vote(pieces) * pieces.mean(penalty))


def _most_of_others(table: FloatArray) -> FloatArray:
    """Largest value of each column over the other rows."""
    if len(table) == 1:
        return np.zeros_like(table)
    order = np.sort(table, axis=0)
    is_most = np.arange(len(table))[:, None] == table.argmax(axis=0)
    return np.asarray(np.where(is_most, order[-2], order[-1]))


SWITCH = 1e-3
"""Probability that the sheet changes between two pieces of a stretch unnoticed."""


def smoothed_posterior(log_likelihood: FloatArray, stretch: IntArray) -> FloatArray:
    """Posterior log-probability of each hypothesis for each piece, by forward and backward passes.

    Parameters
    ----------
    log_likelihood
        (P, H) of each piece under each hypothesis.
    stretch
        (P,) stretch of each piece, not decreasing; stretches are independent.

    Returns
    -------
    FloatArray
        (P, H) logarithms of the posterior probabilities.
    """
    n, h = log_likelihood.shape
    if h == 1 or not n:
        return np.zeros((n, h))
    step = np.full((h, h), np.log(SWITCH / (h - 1)))
    np.fill_diagonal(step, np.log1p(-SWITCH))
    ahead, behind = log_likelihood.copy(), np.zeros((n, h))
    for p in range(1, n):
        if stretch[p] == stretch[p - 1]:
            ahead[p] += _summed(ahead[p - 1][:, None] + step)
    for p in range(n - 2, -1, -1):
        if stretch[p] == stretch[p + 1]:
            behind[p] = _summed((behind[p + 1] + log_likelihood[p + 1])[:, None] + step)
    total = ahead + behind
    return np.asarray(total - np.logaddexp.reduce(total, axis=1, keepdims=True))


def _summed(terms: FloatArray) -> FloatArray:
    return np.asarray(np.logaddexp.reduce(terms, axis=0))


MOST = 0.5
"""With a larger share undecided, one stripe alone gives no less than all of them together."""
ROUNDS = 2
"""Times that the rays held by other stretches are looked up."""


@dataclass(frozen=True, slots=True)
class CrossOptions:
    """When a name is believed, and when one laser is asked for alone.

    Parameters
    ----------
    margin
        Least log-odds of a name over all others.
    remember_margin
        Least log-odds of points from which later stripes are predicted.
    undecided_share
        A larger share of points without a name asks for one laser alone.
    least_between
        Exposures with all lasers between two single ones.
    stroke_gap_ns
        A longer pause begins a new stroke.
    depths
        Depths that are possible.
    """

    margin: float = 5.5
    remember_margin: float = 7.0
    undecided_share: float = 0.2
    least_between: int = 4
    stroke_gap_ns: int = STROKE_GAP_NS
    depths: DepthRange = field(default_factory=lambda: DepthRange(0.5))

    def __post_init__(self) -> None:
        if not 0.0 < self.margin <= self.remember_margin:
            raise OptionError(
                f"margins of {self.margin} and {self.remember_margin}",
                remedy="give positive ones, the second not below the first",
            )
        if not 0.0 < self.undecided_share <= 1.0 or self.least_between < 0:
            raise OptionError(
                f"an undecided share of {self.undecided_share}, at least {self.least_between} "
                "exposures between single ones",
                remedy="give a share above 0 and up to 1, and 0 or more exposures",
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Verdict:
    """Sheet (N,), log-odds (N,) and fate (N,) of points; undecided ones expected of each sheet."""

    sheet: IntArray
    odds: FloatArray
    fate: IntArray
    undecided: FloatArray


class CrossLabeller:
    """Predicts every stripe from the past of its stroke; a `StripeLabeller`.

    A stretch of a profile gives other points in space under each sheet. Those of the right sheet
    continue the surface that the last exposures measured; those of a wrong one leave it steeply.
    The log-likelihoods of a stretch's pieces are joined along it, and the light of a sheet falls
    on one thing only. What stays undecided is dropped and counted, and one laser is asked for
    alone. Without the arm's pose each stripe is predicted in the image, from its last place and
    motion.

    Parameters
    ----------
    sensor
        Camera and sheets; a source draws the sheets that bear its name.
    options
        Defaults if None.
    """

    def __init__(self, sensor: SensorCalibration, options: CrossOptions | None = None) -> None:
        self._sensor = sensor
        self._options = options or CrossOptions()
        self._source_of = tuple(sheet.name.partition(".")[0] for sheet in sensor.sheets)
        self._sources = tuple(dict.fromkeys(self._source_of))
        limits = [self._options.depths.limits_mm(sheet) for sheet in sensor.sheets]
        self._surface = SurfaceMemory(depth_span_mm=max(high - low for low, high in limits))
        self._image = ImageMemory()
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next exposure begins a new stroke."""
        self._surface.forget()
        self._image.forget()
        self._last_ns: int | None = None
        self._next = self._sources[:1]
        self._since_single = 0

    def next_lasers(self) -> tuple[str, ...]:
        """One laser alone at the start of a stroke and when names are in doubt, else all."""
        return self._next

    def name(
        self,
        profile: Profile,
        lasers: tuple[str, ...],
        base_from_sensor: Pose[Base, Sensor] | None,
        t_ns: int,
    ) -> LabelledProfile:
        """Name the points of the next exposure; see `StripeLabeller`.

        Raises
        ------
        InputError
            If the calibration has no sheet of any laser that was on.
        """
        if self._last_ns is not None and t_ns - self._last_ns > self._options.stroke_gap_ns:
            self.reset()
        self._last_ns = t_ns
        possible = tuple(
            k for k, source in enumerate(self._source_of) if not lasers or source in lasers
        )
        if not possible:
            raise InputError(
                f"the laser that was on is {' and '.join(lasers)}, the calibration has "
                f"{', '.join(self._sources)}",
                where=profile.source,
                remedy="give a calibration of this head",
            )
        verdict = self._judge(profile, possible, base_from_sensor)
        self._learn(profile, verdict, base_from_sensor)
        self._plan(verdict, possible)
        how = self._how(possible, base_from_sensor is not None)
        return LabelledProfile(profile, verdict.sheet, verdict.fate, how)

    def _judge(
        self, profile: Profile, possible: tuple[int, ...], pose: Pose[Base, Sensor] | None
    ) -> _Verdict:
        n = len(profile)
        pieces = cut_pieces(profile)
        fate = np.full(n, int(LabelStatus.NOT_ASKED))
        sheet, odds = np.full(n, -1), np.full(n, -np.inf)
        undecided = np.zeros(len(self._source_of))
        if not len(pieces):
            return _Verdict(sheet, odds, fate, undecided)
        samples = profile.points_px[pieces.sample]
        hypotheses = hypothesise(samples, possible, self._sensor, self._options.depths)
        posterior = self._posterior(samples, pieces, hypotheses, pose)
        best, margin = _best(posterior)
        inside = pieces.mean(hypotheses.is_inside.astype(np.float64))
        verdict = np.where(margin >= self._options.margin, LabelStatus.NAMED, LabelStatus.AMBIGUOUS)
        is_explained = np.take_along_axis(inside, best[:, None], axis=1)[:, 0] > 0.5
        verdict[~is_explained] = LabelStatus.UNEXPLAINED
        asked = pieces.of_point >= 0
        own = pieces.of_point[asked]
        fate[asked], odds[asked] = verdict[own], margin[own]
        sheet[asked] = np.where(
            verdict[own] == LabelStatus.NAMED, np.array(possible)[best[own]], -1
        )
        doubtful = np.where(verdict == LabelStatus.AMBIGUOUS, pieces.size, 0)
        undecided[list(possible)] = doubtful @ np.exp(posterior)
        return _Verdict(sheet, odds, fate, undecided)

    def _posterior(
        self,
        samples_px: FloatArray,
        pieces: Pieces,
        hypotheses: Hypotheses,
        pose: Pose[Base, Sensor] | None,
    ) -> FloatArray:
        """(P, H) log-probability of each sheet for each piece."""
        gain = np.zeros((len(samples_px), len(hypotheses.sheets)))
        sharpness = np.full_like(gain, SHARPNESS)
        for h, k in enumerate(hypotheses.sheets):
            if pose is None:
                gain[:, h] = self._image.log_gain(samples_px, k)
            else:
                points = hypotheses.points_mm[h]
                gain[:, h], sharpness[:, h] = self._surface.evidence(points, pose)
        past = past_evidence(pieces, gain, sharpness)
        evidence = past + still_evidence(pieces, hypotheses, self._sensor)
        posterior = smoothed_posterior(evidence, pieces.stretch)
        for _ in range(ROUNDS):
            taken = taken_evidence(posterior, pieces, hypotheses)
            posterior = smoothed_posterior(evidence + taken, pieces.stretch)
        return posterior

    def _learn(self, profile: Profile, verdict: _Verdict, pose: Pose[Base, Sensor] | None) -> None:
        known = verdict.odds >= self._options.remember_margin
        known &= verdict.sheet >= 0
        sheet = verdict.sheet[known]
        pixels = profile.points_px[known]
        self._image.remember(pixels, profile.normals_px[known], sheet)
        if pose is None:
            return
        points, is_met = intersect_sheets(pixels, sheet, self._sensor)
        in_sensor: Points[Sensor] = Points(points[is_met])
        self._surface.remember((pose @ in_sensor).xyz_mm)

    def _plan(self, verdict: _Verdict, possible: tuple[int, ...]) -> None:
        """Choose the lasers of the next exposure: all, or the one that most undecided are of."""
        on = {self._source_of[k] for k in possible}
        self._since_single = 0 if len(on) == 1 else self._since_single + 1
        expected = dict.fromkeys(self._sources, 0.0)
        for source, points in zip(self._source_of, verdict.undecided.tolist(), strict=True):
            expected[source] += points
        n_asked = int((verdict.fate != int(LabelStatus.NOT_ASKED)).sum())
        n_undecided = sum(expected.values())
        is_due = self._since_single > self._options.least_between or n_undecided > MOST * n_asked
        is_in_doubt = n_undecided > self._options.undecided_share * n_asked
        most = max(self._sources, key=lambda source: expected[source])
        self._next = (most,) if is_in_doubt and is_due else self._sources

    def _how(self, possible: tuple[int, ...], has_pose: bool) -> str:
        if len(possible) == 1:
            return f"sheet {self._sensor.sheets[possible[0]].name}, the laser that was on"
        if has_pose:
            return "the sheet that continues the surface of the exposures before"
        return "the sheet whose stripe was last seen near, without the arm's pose"


def _best(posterior: FloatArray) -> tuple[IntArray, FloatArray]:
    """(P,) likeliest hypothesis and its log-odds over all others together; infinite if alone."""
    best = posterior.argmax(axis=1)
    if posterior.shape[1] == 1:
        return best, np.full(len(best), np.inf)
    top = np.take_along_axis(posterior, best[:, None], axis=1)[:, 0]
    rest = posterior.copy()
    np.put_along_axis(rest, best[:, None], -np.inf, axis=1)
    return best, np.asarray(top - np.logaddexp.reduce(rest, axis=1))
