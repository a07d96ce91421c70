# SPDX-License-Identifier: Apache-2.0
"""Sheets of the stripes of many parallel lasers, from where the second camera sees them.

The sheets are evenly spread and the laser stands between the cameras: on a plane, the left
stripe of sheet i, put on sheet (i + m) / 2, falls within about a pixel of the right stripe of
sheet m, all along. Where a thing in front hides the true partners of both, or where the
calibration's errors are of that size, the residuals alone do not tell. But that point floats
millimetres off the plane on which the neighbours lie, and the stripe's true sheet puts it there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.kernels.naming import (
    choose_sheets,
    rule_out,
    score_left,
    score_right,
    sum_off_planes,
)
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.epipolar import (
    EpipolarOffset,
    OffsetEquations,
    Projections,
    Residuals,
    RightStripes,
    estimate_offset,
    find_crossings,
    left_out_scores,
    no_offset,
    possible_sheets,
    project_on_sheets,
    residual_and_sigma,
)
from armscan.reconstruction.labels import LabelledInstant, LabelledProfile, PointStatus, sheets_of
from armscan.reconstruction.segments import (
    Samples,
    StripeSegments,
    cut_segments,
    take_samples,
)
from armscan.reconstruction.triangulate import SOUGHT_DEPTHS, DepthRange
from armscan.records.profile import Profile

BytesArray: TypeAlias = NDArray[np.uint8]

SAMPLE_POINTS = 6
"""Every so many stripe points one is projected; the others follow it."""
SEEN_SHARE = 0.75
"""Part of the points of one camera that the other is expected to see."""
MISSING = float(np.log(1.0 - SEEN_SHARE))
"""Score of a sheet where the other camera should see the stripe and does not."""
RUNNER_UP = 0.6
"""A segment is ambiguous if another sheet scores more than this part of the best one."""
LEAST_MATCHES = 3
"""A segment with fewer samples that lie on a right stripe gets no sheet."""
OFFSET_CHI_SQUARE = 4.0
"""A segment is ambiguous if mean, slope and bend of its residuals differ by more (chi-square over
its degrees of freedom) from the offset that the others show."""

NEIGHBOURS = 24
ASKED = 3
"""Times as many neighbours are looked at: those on another thing are passed over."""
SAME_THING_MM = 10.0
"""Neighbours further in front or behind are taken for another thing."""
THINNING = 5
"""Of the samples along a line, so that the nearest are of several lines."""
SCALE_PX = 500.0
NOISE_MM = 0.03
"""Of a labelled point's depth, without the calibration."""
FLAT_MM = 0.12
"""Neighbours that scatter more about their plane are on a bent surface, or on two."""
ON_MM = 0.15
SIGMAS = 3.0
KNOWN_MM = 0.5
"""A plane that is known no better at a point puts many sheets within reach of it."""
OFF_MM = 2.0
"""Less far off its neighbours' plane than this, a stripe may well be on their bent surface."""


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """Planes seen by the camera: the inverse depth is linear over the image.

    Parameters
    ----------
    middle_px
        (B, 2) about which the numbers are given.
    inverse
        (B, 3) inverse depth in the middle (1/mm) and its change to the right and downwards over
        `SCALE_PX`.
    covariance
        (B, 3, 3).
    segment
        (B,) number of the stripe around whose middle the plane was fitted.
    """

    middle_px: FloatArray
    inverse: FloatArray
    covariance: FloatArray
    segment: IntArray


def fit_planes(points_px: FloatArray, depth_mm: FloatArray, segment: IntArray) -> Planes:
    """Plane through the nearest labelled points around the middle of each stripe, where it is flat.

    Parameters
    ----------
    points_px
        (N, 2) of labelled samples. The lens bends a plane by less than the tolerance.
    depth_mm
        (N,) on their sheet.
    segment
        (N,) number of the stripe.
    """
    none = Planes(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    thin = np.arange(0, len(points_px), THINNING)
    if len(thin) < NEIGHBOURS:
        return none
    numbers = np.unique(segment)
    middle = np.stack([_medians(one, segment) for one in points_px.T], axis=1)
    middle_mm = _medians(depth_mm, segment)
    n_asked = min(ASKED * NEIGHBOURS, len(thin))
    _, nearest = cKDTree(points_px[thin]).query(middle, n_asked)
    near = thin[nearest]
    # What stands in front or behind comes last, so that it is taken only where nothing else is.
    is_other = np.abs(depth_mm[near] - middle_mm[:, None]) > SAME_THING_MM
    order = np.argsort(is_other, axis=1, kind="stable")[:, :NEIGHBOURS]
    near = np.take_along_axis(near, order, axis=1)
    place = (points_px[near] - middle[:, None, :]) / SCALE_PX
    design = np.concatenate([np.ones((*near.shape, 1)), place], axis=2)
    inverse = 1.0 / depth_mm[near]
    normal = design.transpose(0, 2, 1) @ design
    is_spread = np.linalg.cond(normal) < 1e6
    normal[~is_spread] = np.eye(3)
    fitted = np.linalg.solve(normal, (design.transpose(0, 2, 1) @ inverse[:, :, None]))[:, :, 0]
    misfit = inverse - np.einsum("nkj,nj->nk", design, fitted)
    square = np.median(depth_mm[near], axis=1) ** 2
    scatter = np.sqrt((misfit**2).mean(axis=1)) * square
    has_lines = (segment[near] != segment[near[:, :1]]).any(axis=1)
    kept = is_spread & (scatter < FLAT_MM) & has_lines
    noise = np.maximum(scatter, NOISE_MM) / square
    covariance = np.linalg.inv(normal) * (noise**2)[:, None, None]
    return Planes(middle[kept], fitted[kept], covariance[kept], numbers[kept])


def _medians(values: FloatArray, group: IntArray) -> FloatArray:
    """(G,) median of the values (N,) of each group (N,), in the order of the groups' numbers."""
    count = np.unique(group, return_counts=True)[1]
    ordered, first = values[np.lexsort((values, group))], np.cumsum(count) - count
    middle = ordered[first + (count - 1) // 2] + ordered[first + count // 2]
    return np.asarray(0.5 * middle)


def surface_distance(
    points_px: FloatArray,
    depth_mm: FloatArray,
    segment: IntArray,
    sheet: IntArray,
    planes: Planes,
    *,
    shape: tuple[int, int],
) -> tuple[FloatArray, BoolArray]:
    """How near each sheet puts each segment of stripe to a plane of others.

    Parameters
    ----------
    points_px, depth_mm, segment, sheet
        (H,) samples on sheets.
    planes
        From `fit_planes`.
    shape
        Count of segments and of sheets.

    Returns
    -------
    distance_mm
        (segments, sheets) mean distance in depth from the nearest plane that was fitted around
        another segment; infinite where none is known there.
    is_on
        (segments, sheets) True where that is no more than the plane's own uncertainty.
    """
    size = shape[0] * shape[1]
    distance, is_on = np.full(size, np.inf), np.zeros(size, dtype=np.bool_)
    if not len(planes.inverse) or not len(segment):
        return distance.reshape(shape), is_on.reshape(shape)
    key = segment * shape[1] + sheet
    count = np.bincount(key, minlength=size)
    mean, std = np.zeros((2, len(planes.inverse), size))
    sum_off_planes(
        np.column_stack([points_px, depth_mm]),
        key,
        np.column_stack([planes.middle_px, planes.inverse, planes.covariance.reshape(-1, 9)]),
        SCALE_PX,
        mean,
        std,
    )
    asked = np.flatnonzero(count)
    # a tilted line is off at its ends only: the mean of the sizes, not of the signs
    mean, std = mean[:, asked] / count[asked], std[:, asked] / count[asked]
    is_known = (std < KNOWN_MM) & (asked // shape[1] != planes.segment[:, None])
    distance[asked] = np.where(is_known, mean, np.inf).min(axis=0)
    is_on[asked] = (is_known & (mean <= np.maximum(ON_MM, SIGMAS * std))).any(axis=0)
    return distance.reshape(shape), is_on.reshape(shape)


INDEPENDENT_SHARE = 0.5
"""Neighbouring samples of a stripe err together: each counts as this part of one."""
IMPOSSIBLE = -8.0
"""Score of a sheet that is out of depth at a sample."""
CHANGE_COST = 20.0
"""Against the sheet changing along a segment: once in a thousand million samples."""
LEAST_SCORE = 5.0
"""Least log-likelihood ratio to a stripe on no sheet that makes a label certain."""
LIMITS = np.array([INDEPENDENT_SHARE, RUNNER_UP, LEAST_SCORE, LEAST_MATCHES, CHANGE_COST])
"""As `choose_sheets` takes them."""


def log_ratio(residual_px: FloatArray, sigma_px: FloatArray, spacing_px: float) -> FloatArray:
    """(H,) log-likelihood of a residual if the sheet is right, over that if it is wrong.

    If it is right, the right camera sees the stripe with probability `SEEN_SHARE`, and the
    residual is Gaussian; else, and if it is wrong, any right stripe may lie there: uniform, one in
    ``spacing_px``.
    """
    density = np.exp(-0.5 * (residual_px / sigma_px) ** 2) / (np.sqrt(2.0 * np.pi) * sigma_px)
    return np.asarray(np.log((1.0 - SEEN_SHARE) + SEEN_SHARE * spacing_px * density))


@dataclass(frozen=True, slots=True, eq=False)
class SheetAssignment:
    """Sheets along the stripes of one camera.

    Parameters
    ----------
    state
        (S,) most likely sheet of each sample's segment.
    is_sure
        (S,) True where it is far ahead of any other.
    is_tied
        (S,) True where some sheet explains the sample, but not far enough ahead of another.
    segment
        (S,) number of the segment, counted from 0.
    is_candidate
        (segments, K) True for sheets that explain a segment nearly as well as the best one.
    """

    state: IntArray
    is_sure: BoolArray
    is_tied: BoolArray
    segment: IntArray
    is_candidate: BoolArray

    @property
    def label(self) -> IntArray:
        """(S,) the sheet where it is sure; -1 elsewhere."""
        return np.where(self.is_sure, self.state, -1)


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """Stripes of one camera, cut into segments, with their samples."""

    profile: Profile
    segments: StripeSegments
    samples: Samples

    @staticmethod
    def of(profile: Profile) -> _Side:
        segments = cut_segments(profile, at_light=True)
        return _Side(profile, segments, take_samples(segments, SAMPLE_POINTS))

    def __len__(self) -> int:
        return len(self.samples.at)

    @property
    def row(self) -> IntArray:
        """(S,) row of each sample in the profile."""
        return self.segments.row[self.samples.at]

    def assign(self, scores: FloatArray, is_match: BytesArray) -> SheetAssignment:
        """Most likely sheet of each segment, and how sure it is.

        A segment is one line of light, so it has one sheet. Where along it another sheet is far
        more likely, the other camera may see another stripe there by chance, or two lines may have
        been linked unnoticed: such samples are ambiguous.

        Parameters
        ----------
        scores
            (S, K) log-likelihood ratio of each sheet at each sample.
        is_match
            (S K,) 1 where the sheet puts the sample on a stripe of the other camera.
        """
        n, n_sheets = scores.shape
        number = self.segments.number[self.samples.at]
        state = np.zeros(n, np.int64)
        is_sure, is_tied = np.zeros((2, n), np.bool_)
        n_segments = int(number[-1]) + 1 if n else 0
        is_candidate = np.zeros((n_segments, n_sheets), np.bool_)
        choose_sheets(
            scores,
            is_match,
            self.samples.weight,
            number,
            LIMITS,
            state,
            is_sure.view(np.uint8),
            is_tied.view(np.uint8),
            is_candidate.view(np.uint8).reshape(-1),
        )
        return SheetAssignment(state, is_sure, is_tied, number, is_candidate)

    def labelled(
        self, found: SheetAssignment, withdrawn: IntArray, doubted: IntArray
    ) -> LabelledProfile:
        """Every point takes the sheet of the sample that stands for it.

        Segments of ``withdrawn`` samples lose their sheet; ``doubted`` ones are ambiguous if they
        have none. Samples of number -1 are none.
        """
        sheet = np.full(len(self.profile), -1)
        status = np.full(len(self.profile), int(PointStatus.FLAGGED))
        if len(self):
            lost = np.zeros(int(found.segment.max()) + 1, dtype=np.bool_)
            lost[found.segment[withdrawn[withdrawn >= 0]]] = True
            is_tied = found.is_tied | lost[found.segment]
            is_tied[doubted[doubted >= 0]] = True
            sure = found.is_sure & ~lost[found.segment]
            of_sample = np.where(is_tied, PointStatus.AMBIGUOUS, PointStatus.STRAY)
            of_sample[sure] = PointStatus.MEASURED
            nearest = self.samples.nearest
            sheet[self.segments.row] = np.where(sure, found.state, -1)[nearest]
            status[self.segments.row] = of_sample[nearest]
        return LabelledProfile(profile=self.profile, sheet=sheet, status=status, reason=REASON)


EXCHANGES = 2
"""Rounds in which the two cameras' certain sheets rule out pairs of the other."""
ROUNDS = 3
"""Sheets, then the offset from these and doubts about them, and again."""
MATCH_SIGMAS = 4.0
REASON = "the sheet on which the left stripe's picture falls on a right stripe (eqs. 4.17, 4.18)"


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Left samples on sheets (H,), the right samples beside which they fall, -1 for none.

    ``ratio`` (H,) is the log-likelihood ratio of the sheet, ``is_match`` (H,) True on a stripe.
    """

    left: IntArray
    right: IntArray
    sheet: IntArray
    ratio: FloatArray
    is_match: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class StereoLabeller:
    """Each of two cameras tells the sheets of the other's stripes; a `StripeLabeller`.

    Each left sample is put on every sheet within the depths and projected into the right camera.
    Along each stripe the sheet is the one for which the distances to the right stripes are most
    likely (not the one with most of them near); a stripe may change its sheet where it is cut. The
    pairs of left and right stripe must be one to one: what one camera tells for certain rules out
    other pairs of the same stripe, and what stays contradictory is ambiguous.

    Parameters
    ----------
    sensor
        Both cameras and all sheets.
    depths
        Depths in which a sheet is looked for.
    """

    sensor: SensorCalibration
    depths: DepthRange = SOUGHT_DEPTHS
    _prior: EpipolarOffset = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_prior", no_offset(self.sensor))

    def label(
        self,
        profiles: Sequence[Profile],
        lasers: tuple[str, ...] = (),
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> LabelledInstant:
        """See `StripeLabeller`; each instant is labelled by itself.

        Only sheets of ``lasers`` are possible, or all of them where it names no calibrated one.

        Raises
        ------
        InputError
            If the sensor has one camera.
        """
        sides = _Side.of(profiles[0]), _Side.of(profiles[1])
        offset = self._prior
        found = _Hypotheses.of(sides, self.sensor, self.depths, sheets_of(self.sensor, lasers))
        at, projected = found.sample, found.projected
        doubt = ever = np.zeros(len(at), dtype=np.bool_)
        judged: tuple[BoolArray, BoolArray] | None = None
        equations: OffsetEquations | None = None
        for _ in range(ROUNDS):
            pairs = found.pairs(doubt, offset)
            left, right = _assign_both(pairs, sides, len(self.sensor.sheets))
            used = pairs.is_match & (left.label[at] == projected.sheet)
            asked = used | doubt | _is_tied(pairs, left)
            if judged is not None and _are_same(judged, (used, asked)):
                # the same question has the same answer, and so have all rounds to come
                break
            judged = used, asked
            equations = found.equations(used, self._prior, equations)
            doubt = found.doubtful(used, asked, left.segment[at], equations)
            ever = ever | doubt
            equations = found.equations(used & ~doubt, self._prior, equations)
            offset = estimate_offset(found.residuals, self.sensor, equations)
        withdrawn = used & doubt
        labelled = (
            side.labelled(assigned, sample[withdrawn], sample[ever])
            for side, assigned, sample in zip(
                sides, (left, right), (pairs.left, pairs.right), strict=True
            )
        )
        return LabelledInstant(tuple(labelled), offset)

    def next_lasers(self) -> tuple[str, ...]:
        """Those of the recording."""
        return ()

    def left_out(self, lasers: tuple[str, ...]) -> str:
        """No exposure: what is on no calibrated sheet has no partner in the other camera."""
        return ""

    def reset(self) -> None:
        """Nothing is remembered."""


@dataclass(frozen=True, slots=True, eq=False)
class _Hypotheses:
    """Left samples (H,) on sheets, in the right image, with the stripes beside them.

    ``beside`` (H,) is the right sample of the stripe beside each, -1 for none, ``is_covered`` (H,)
    True where the right camera sees stripes around. ``residuals`` are those of the F pairs found,
    which each round takes anew; ``found`` (F,) are these pairs, and ``place`` (H,) the row of each
    pair in them, -1 for none.
    """

    sides: tuple[_Side, _Side]
    sensor: SensorCalibration
    sample: IntArray
    projected: Projections
    spacing_px: float
    beside: IntArray
    is_covered: BoolArray
    residuals: Residuals
    found: IntArray
    place: IntArray

    @staticmethod
    def of(
        sides: tuple[_Side, _Side],
        sensor: SensorCalibration,
        depths: DepthRange,
        lit: tuple[int, ...],
    ) -> _Hypotheses:
        left, row = sides[0].profile, sides[0].row
        pixels = left.points_px[row]
        at, sheet = possible_sheets(pixels, sensor, depths)
        if 0 < len(lit) < len(sensor.sheets):
            is_lit = np.isin(sheet, lit)
            at, sheet = at[is_lit], sheet[is_lit]
        projected = project_on_sheets(pixels[at], sheet, sensor)
        low, high = depths.of_all_mm(sensor)
        depth = projected.points_mm[:, 2]
        kept = projected.is_met & (depth >= low) & (depth <= high)
        at, projected = at[kept], projected.select(kept)
        right, own = sides[1], row[at]
        stripes = RightStripes.of(right.profile)
        crossings = find_crossings(
            projected, left.normals_px[own], left.sigma_px[own], stripes, sensor
        )
        found = crossings.at
        sample_of_row = np.full(len(right.profile), -1)
        sample_of_row[right.segments.row] = right.samples.nearest
        beside, place = np.full((2, len(at)), -1)
        beside[found], place[found] = sample_of_row[crossings.row], np.arange(len(found))
        return _Hypotheses(
            sides=sides,
            sensor=sensor,
            sample=at,
            projected=projected,
            spacing_px=stripes.spacing_px(),
            beside=beside,
            is_covered=stripes.covers(projected.q_px),
            residuals=Residuals.of(crossings, sensor),
            found=found,
            place=place,
        )

    def equations(
        self, used: BoolArray, prior: EpipolarOffset, known: OffsetEquations | None
    ) -> OffsetEquations:
        """Equations of the pairs used, of those found; ``known`` if these are of the same."""
        is_used = used[self.found]
        if known is not None and np.array_equal(known.is_used, is_used):
            return known
        return OffsetEquations.of(self.residuals, prior, is_used)

    def pairs(self, doubted: BoolArray, offset: EpipolarOffset) -> _Pairs:
        """Log-likelihood ratio of each left sample on each sheet, given the offset so far."""
        found = self.found
        ratio = np.where(self.is_covered, MISSING, 0.0)
        is_match = np.zeros(len(self.sample), dtype=np.bool_)
        residual, sigma = residual_and_sigma(self.residuals, offset)
        likely = log_ratio(residual, sigma, self.spacing_px)
        ratio[found] = likely
        is_match[found] = (np.abs(residual) < MATCH_SIGMAS * sigma) & (likely > 0.0)
        ratio[doubted] = MISSING
        is_match[doubted] = False
        return _Pairs(self.sample, self.beside, self.projected.sheet, ratio, is_match)

    def doubtful(
        self,
        used: BoolArray,
        asked: BoolArray,
        segment: IntArray,
        equations: OffsetEquations,
    ) -> BoolArray:
        """(H,) segments on sheets that do not fit the others, by their offset or by the surface.

        ``used`` pairs are those of certain sheets; ``asked`` ones are also those in doubt before,
        now that the others may be known better, and the candidates of segments that several sheets
        explain. ``equations`` are those of the pairs used.
        """
        doubt = np.zeros(len(used), dtype=np.bool_)
        at = np.flatnonzero(asked)
        if not len(at):
            return doubt
        projected, n_sheets = self.projected, len(self.sensor.sheets)
        keys, key_of = np.unique(segment[at] * n_sheets + projected.sheet[at], return_inverse=True)
        scores = left_out_scores(self.residuals, equations, self.place[at], key_of)
        is_bad = scores > OFFSET_CHI_SQUARE
        known = at[used[at] & ~is_bad[key_of]]
        # along the stripes
        known = known[np.argsort(self.sample[known], kind="stable")]
        left = self.sides[0]
        pixels, depth = left.profile.points_px[left.row[self.sample]], projected.points_mm[:, 2]
        planes = fit_planes(pixels[known], depth[known], segment[known])
        shape = (int(segment.max()) + 1, n_sheets)
        distance, is_on = surface_distance(
            pixels, depth, segment, projected.sheet, planes, shape=shape
        )
        of_segment, of_sheet = np.divmod(keys, n_sheets)
        off = distance[of_segment, of_sheet]
        is_bad |= (off > OFF_MM) & np.isfinite(off) & is_on[of_segment].any(axis=1)
        doubt[at] = is_bad[key_of]
        return doubt


def _are_same(first: tuple[BoolArray, ...], second: tuple[BoolArray, ...]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def _is_tied(pairs: _Pairs, found: SheetAssignment) -> BoolArray:
    """(H,) pairs of segments that several sheets explain, on one of these sheets."""
    is_open = (~found.is_sure & found.is_tied)[pairs.left]
    return np.asarray(
        pairs.is_match & is_open & found.is_candidate[found.segment[pairs.left], pairs.sheet]
    )


def _assign_both(
    pairs: _Pairs, sides: tuple[_Side, _Side], n_sheets: int
) -> tuple[SheetAssignment, SheetAssignment]:
    """Sheets of both cameras that agree with each other."""
    alive_left = alive_right = pairs.is_match.view(np.uint8)
    left = _assign_left(pairs, alive_left, sides[0], n_sheets)
    right = _assign_right(pairs, alive_right, sides[1], n_sheets)
    for exchange in range(EXCHANGES):
        before_left, before_right = alive_left, alive_right
        alive_left = _alive(pairs, pairs.right, right)
        alive_right = _alive(pairs, pairs.left, left)
        # where nothing more was ruled out the sheets are those found before
        if not np.array_equal(alive_left, before_left):
            left = _assign_left(pairs, alive_left, sides[0], n_sheets)
        if exchange + 1 < EXCHANGES and not np.array_equal(alive_right, before_right):
            right = _assign_right(pairs, alive_right, sides[1], n_sheets)
    agreed = alive_left & _alive(pairs, pairs.left, left, is_strict=True)
    return left, _assign_right(pairs, agreed, sides[1], n_sheets)


def _alive(
    pairs: _Pairs, sample: IntArray, found: SheetAssignment, *, is_strict: bool = False
) -> BytesArray:
    """(H,) 1 for matches whose samples are on no other sheet for certain, or are on this one."""
    alive = np.zeros(len(sample), np.uint8)
    match, is_sure = pairs.is_match.view(np.uint8), found.is_sure.view(np.uint8)
    rule_out(sample, pairs.sheet, found.state, is_sure, match, int(is_strict), alive)
    return alive


def _assign_left(pairs: _Pairs, alive: BytesArray, side: _Side, n_sheets: int) -> SheetAssignment:
    scores = np.full((len(side), n_sheets), IMPOSSIBLE)
    is_beside, match = np.zeros(scores.size, np.uint8), pairs.is_match.view(np.uint8)
    score_left(pairs.left, pairs.sheet, pairs.ratio, match, alive, MISSING, scores, is_beside)
    return side.assign(scores, is_beside)


def _assign_right(pairs: _Pairs, alive: BytesArray, side: _Side, n_sheets: int) -> SheetAssignment:
    """The same pairs, seen from the right stripes: each sample takes its best partner."""
    scores = np.full((len(side), n_sheets), MISSING)
    is_beside = np.zeros(scores.size, np.uint8)
    score_right(pairs.right, pairs.sheet, pairs.ratio, alive, scores, is_beside)
    return side.assign(scores, is_beside)
