# SPDX-License-Identifier: Apache-2.0
"""Sheets of the stripes of many parallel lasers, from where the second camera sees them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.chains import best_states
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.epipolar import (
    Crossings,
    EpipolarOffset,
    Projections,
    RightStripes,
    estimate_offset,
    find_crossings,
    left_out_scores,
    no_offset,
    possible_sheets,
    predicted_residuals,
    project_on_sheets,
)
from armscan.reconstruction.label_single import DepthRange
from armscan.reconstruction.labels import LabelledProfile, LabelStatus
from armscan.reconstruction.segments import Pieces, Samples, cut_stripes, take_samples
from armscan.records.profile import Profile


@dataclass(frozen=True, slots=True)
class StereoLabelOptions:
    """Options of `armscan.reconstruction.stereo_points.measure_stereo`.

    Parameters
    ----------
    depths
        Depths in which a sheet is looked for: its calibrated range, widened.
    sample_points
        Every so many stripe points one is projected; the others follow it.
    reach_px
        A right stripe farther from the projected point than this is not its picture.
    floor_px
        What is left of the residual's bias after the epipolar offset was found: calibration
        errors that are not smooth, and the stripe's own.
    drift_px
        Standard deviation, before any data, of how far the two cameras have drifted apart since
        their calibration.
    seen_share
        Part of the points of one camera that the other is expected to see.
    runner_up
        A stretch is ambiguous if another sheet scores more than this part of the best one.
    least_matches
        A stretch with fewer samples that lie on a right stripe keeps no name.
    offset_chi_square
        A stretch is ambiguous if mean, slope and bend of its residuals differ by more (chi-square
        over its degrees of freedom) from the offset that the others show.
    consistency_sigmas
        Points whose left and right picture disagree by more are dropped.
    """

    depths: DepthRange = field(default_factory=lambda: DepthRange(0.5))
    sample_points: int = 6
    reach_px: float = 4.0
    floor_px: float = 0.06
    drift_px: float = 0.4
    seen_share: float = 0.75
    runner_up: float = 0.6
    least_matches: int = 3
    offset_chi_square: float = 4.0
    consistency_sigmas: float = 5.0

    def __post_init__(self) -> None:
        for name in ("reach_px", "floor_px", "drift_px", "consistency_sigmas", "offset_chi_square"):
            if not getattr(self, name) > 0.0:
                raise OptionError(f"{name} = {getattr(self, name)}", remedy="give more than 0")
        for name in ("sample_points", "least_matches"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}", remedy="give 1 or more")
        for name in ("seen_share", "runner_up"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise OptionError(
                    f"{name} = {getattr(self, name)}", remedy="give a share between 0 and 1"
                )


NEIGHBOURS = 24
ASKED = 3
"""Times as many neighbours are looked at: those on another thing are passed over."""
SAME_THING_MM = 10.0
"""Neighbours further in front or behind are taken for another thing."""
THINNING = 5
"""Of the samples along a line, so that the nearest are of several lines."""
SCALE_PX = 500.0
NOISE_MM = 0.03
"""Of a named point's depth, without the calibration."""
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
    stretch
        (B,) number of the stripe around whose middle the plane was fitted.
    """

    middle_px: FloatArray
    inverse: FloatArray
    covariance: FloatArray
    stretch: IntArray


def fit_planes(points_px: FloatArray, depth_mm: FloatArray, stretch: IntArray) -> Planes:
    """Plane through the nearest named points around the middle of each stripe, where it is flat.

    Parameters
    ----------
    points_px
        (N, 2) of named samples. The lens bends a plane by less than the tolerance.
    depth_mm
        (N,) on the sheet of their name.
    stretch
        (N,) number of the stripe.
    """
    none = Planes(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    thin = np.arange(0, len(points_px), THINNING)
    if len(thin) < NEIGHBOURS:
        return none
    numbers = np.unique(stretch)
    middle = np.stack([np.median(points_px[stretch == b], axis=0) for b in numbers])
    own_mm = np.array([np.median(depth_mm[stretch == b]) for b in numbers])
    n_asked = min(ASKED * NEIGHBOURS, len(thin))
    _, nearest = cKDTree(points_px[thin]).query(middle, n_asked)
    near = thin[nearest]
    # What stands in front or behind comes last, so that it is taken only where nothing else is.
    is_other = np.abs(depth_mm[near] - own_mm[:, None]) > SAME_THING_MM
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
    scatter = np.sqrt((misfit**2).mean(axis=1)) * np.median(depth_mm[near], axis=1) ** 2
    n_lines = np.array([len(np.unique(row)) for row in stretch[near]])
    kept = is_spread & (scatter < FLAT_MM) & (n_lines > 1)
    noise = np.maximum(scatter, NOISE_MM) / np.median(depth_mm[near], axis=1) ** 2
    covariance = np.linalg.inv(normal) * (noise**2)[:, None, None]
    return Planes(middle[kept], fitted[kept], covariance[kept], numbers[kept])


def depths_off(
    points_px: FloatArray, depth_mm: FloatArray, planes: Planes
) -> tuple[FloatArray, FloatArray]:
    """How far points are off each plane in depth (N, B), mm, and its standard deviation (N, B)."""
    place = (points_px[:, None, :] - planes.middle_px[None, :, :]) / SCALE_PX
    design = np.concatenate([np.ones((*place.shape[:2], 1)), place], axis=2)
    expected = np.einsum("nbj,bj->nb", design, planes.inverse)
    variance = np.einsum("nbj,bjk,nbk->nb", design, planes.covariance, design)
    square = depth_mm[:, None] ** 2
    return (expected - 1.0 / depth_mm[:, None]) * square, np.sqrt(variance) * square


def surface_distance(
    points_px: FloatArray,
    depth_mm: FloatArray,
    piece: IntArray,
    sheet: IntArray,
    planes: Planes,
    *,
    shape: tuple[int, int],
) -> tuple[FloatArray, BoolArray]:
    """How near each sheet puts each piece of stripe to a plane of others.

    Parameters
    ----------
    points_px, depth_mm, piece, sheet
        (H,) samples on sheets.
    planes
        From `fit_planes`.
    shape
        Count of pieces and of sheets.

    Returns
    -------
    distance_mm
        (pieces, sheets) mean distance in depth from the nearest plane that was fitted around
        another piece; infinite where none is known there.
    is_on
        (pieces, sheets) True where that is no more than the plane's own uncertainty.
    """
    distance = np.full(shape, np.inf)
    is_on = np.zeros(shape, dtype=np.bool_)
    if not len(planes.inverse) or not len(piece):
        return distance, is_on
    off, sigma = depths_off(points_px, depth_mm, planes)
    key = piece * shape[1] + sheet
    size = shape[0] * shape[1]
    count = np.maximum(np.bincount(key, minlength=size), 1)
    for b in range(len(planes.inverse)):
        # a tilted line is off at its ends only: the mean of the sizes, not of the signs
        mean = np.bincount(key, np.abs(off[:, b]), size) / count
        spread = np.bincount(key, sigma[:, b], size) / count
        seen = (np.bincount(key, minlength=size) > 0) & (spread < KNOWN_MM)
        seen &= np.repeat(np.arange(shape[0]), shape[1]) != planes.stretch[b]
        mean, spread = mean.reshape(shape), spread.reshape(shape)
        seen = seen.reshape(shape)
        distance = np.where(seen, np.minimum(distance, mean), distance)
        is_on |= seen & (mean <= np.maximum(ON_MM, SIGMAS * spread))
    return distance, is_on


INDEPENDENT_SHARE = 0.5
"""Neighbouring samples of a stripe err together: each counts as this part of one."""
IMPOSSIBLE = -8.0
"""Score of a sheet that is out of depth at a sample."""
CHANGE_COST = 20.0
"""Against the sheet changing along an unbroken piece: once in a thousand million samples."""
LEAST_SCORE = 5.0
"""Least log-likelihood ratio to a stripe on no sheet that makes a name certain."""


def log_ratio(
    residual_px: FloatArray, sigma_px: FloatArray, spacing_px: float, seen_share: float
) -> FloatArray:
    """(H,) log-likelihood of a residual if the sheet is right, over that if it is wrong.

    If it is right, the right camera sees the stripe with probability ``seen_share``, and the
    residual is Gaussian; else, and if it is wrong, any right stripe may lie there: uniform, one in
    ``spacing_px``.
    """
    density = np.exp(-0.5 * (residual_px / sigma_px) ** 2) / (np.sqrt(2.0 * np.pi) * sigma_px)
    return np.asarray(np.log((1.0 - seen_share) + seen_share * spacing_px * density))


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Sheets along the stripes of one camera.

    Parameters
    ----------
    state
        (S,) most likely sheet of each sample's piece.
    is_sure
        (S,) True where it is far ahead of any other.
    is_tied
        (S,) True where some sheet explains the sample, but not far enough ahead of another.
    piece
        (S,) number of the piece, counted from 0.
    is_candidate
        (pieces, K) True for sheets that explain a piece nearly as well as the best one.
    """

    state: IntArray
    is_sure: BoolArray
    is_tied: BoolArray
    piece: IntArray
    is_candidate: BoolArray

    @property
    def name(self) -> IntArray:
        """(S,) the sheet where it is sure; -1 elsewhere."""
        return np.where(self.is_sure, self.state, -1)


def decide(
    scores: FloatArray,
    is_match: BoolArray,
    pieces: Pieces,
    samples: Samples,
    options: StereoLabelOptions,
) -> Verdict:
    """Most likely sheet of each unbroken piece, and how sure it is.

    A piece is one line of light, so it has one sheet. Where along it another sheet is far more
    likely, the other camera may see another stripe there by chance, or two lines may have been
    linked unnoticed: such samples are ambiguous.

    Parameters
    ----------
    scores
        (S, K) log-likelihood ratio of each sheet at each sample.
    is_match
        (S, K) True where the sheet puts the sample on a stripe of the other camera.
    pieces, samples
        Of the camera's profile.
    options
        Limits.
    """
    n, n_sheets = scores.shape
    if n == 0:
        none = np.zeros(0, dtype=np.bool_)
        empty = np.zeros(0, dtype=np.int64)
        return Verdict(empty, none, none, empty, np.zeros((0, n_sheets), dtype=np.bool_))
    weighted = scores * (INDEPENDENT_SHARE * samples.weight)[:, None]
    piece = pieces.piece[samples.at]
    is_first = np.concatenate([[True], np.diff(piece) != 0])
    first, number = np.flatnonzero(is_first), np.cumsum(is_first) - 1
    total = np.add.reduceat(weighted, first, axis=0)
    matches = np.add.reduceat(is_match * samples.weight[:, None], first, axis=0)
    rows, winner = np.arange(len(first)), total.argmax(axis=1)
    best = total[rows, winner]
    others = total.copy()
    others[rows, winner] = 0.0
    is_candidate = (total > options.runner_up * best[:, None]) & (total >= LEAST_SCORE)
    is_ahead = others.max(axis=1) <= options.runner_up * best
    is_sure = is_ahead & (best >= LEAST_SCORE) & (matches[rows, winner] >= options.least_matches)
    state, path = winner[number], _path(weighted, is_first)
    is_other = (path < n_sheets) & (path != state)
    is_tied = ~is_sure & (best > 0.0)
    return Verdict(
        state, is_sure[number] & ~is_other, is_tied[number] | is_other, number, is_candidate
    )


def _path(weighted: FloatArray, is_first: BoolArray) -> IntArray:
    """(S,) most likely sheet of each sample if it may change along a piece; K for none."""
    table = np.concatenate([weighted, np.zeros((len(weighted), 1))], axis=1)
    cost = np.where(is_first, 0.0, CHANGE_COST)
    path = np.zeros(len(weighted), dtype=np.int64)
    best_states(np.ascontiguousarray(table), cost, path)
    return path


EXCHANGES = 2
"""Rounds in which the two cameras' certain names rule out pairs of the other."""
ROUNDS = 3
"""Names, then the offset from these and doubts about them, and again."""
MATCH_SIGMAS = 4.0
HOW = "the sheet on which the left stripe's picture falls on a right stripe (eqs. 4.17, 4.18)"


@dataclass(frozen=True, slots=True, eq=False)
class StereoNames:
    """Stripes of both cameras with their sheets, and the offset found on the way."""

    left: LabelledProfile
    right: LabelledProfile
    offset: EpipolarOffset


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """Stripes of one camera, cut into pieces, with their samples."""

    profile: Profile
    pieces: Pieces
    samples: Samples

    @staticmethod
    def of(profile: Profile, every: int) -> _Side:
        pieces = cut_stripes(profile)
        return _Side(profile, pieces, take_samples(pieces, every))

    def __len__(self) -> int:
        return len(self.samples.at)

    @property
    def row(self) -> IntArray:
        """(S,) row of each sample in the profile."""
        return self.pieces.row[self.samples.at]


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Left samples on sheets (H,) and the right samples beside which they fall, -1 for none."""

    left: IntArray
    right: IntArray
    sheet: IntArray
    ratio: FloatArray
    is_match: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Left samples (H,) on sheets, in the right image, with the stripes beside them."""

    sample: IntArray
    projected: Projections
    crossings: Crossings


def residual_and_sigma(
    projected: Projections,
    crossings: Crossings,
    sensor: SensorCalibration,
    offset: EpipolarOffset,
    options: StereoLabelOptions,
) -> tuple[FloatArray, FloatArray]:
    """Residual (H,) beyond what the offset explains, and its standard deviation (H,), px."""
    expected, spread = predicted_residuals(projected, crossings, sensor, offset)
    sigma = np.sqrt(crossings.sigma_px**2 + spread**2 + options.floor_px**2)
    return crossings.residual_px - expected, sigma


def name_stripes(
    left: Profile, right: Profile, sensor: SensorCalibration, options: StereoLabelOptions
) -> StereoNames:
    """Tell the sheet of every stripe point of both cameras.

    Each left sample is put on every sheet within the depths and projected into the right camera.
    Along each stripe the sheet is the one for which the distances to the right stripes are most
    likely (not the one with most of them near); a stripe may change its sheet where it is cut. The
    pairs of left and right stripe must be one to one: what one camera names for certain rules out
    other pairs of the same stripe, and what stays contradictory is ambiguous.

    Parameters
    ----------
    left, right
        Stripe points of both cameras at one instant.
    sensor
        Both cameras and all sheets.
    options
        Limits.

    Raises
    ------
    InputError
        If the sensor has one camera.
    """
    sides = (_Side.of(left, options.sample_points), _Side.of(right, options.sample_points))
    stripes = RightStripes.of(right)
    row = sides[0].row
    at, sheet = possible_sheets(left.points_px[row], sensor, options.depths)
    projected = project_on_sheets(left.points_px[row[at]], sheet, sensor)
    low, high = np.array([options.depths.limits_mm(s) for s in sensor.sheets]).T
    depth = projected.points_mm[:, 2]
    kept = projected.is_met & (depth >= low[sheet]) & (depth <= high[sheet])
    at, projected = at[kept], projected.select(kept)
    crossings = find_crossings(
        projected, left.normals_px[row[at]], left.sigma_px[row[at]], stripes, options.reach_px
    )
    found = _Found(at, projected, crossings)
    n_sheets = len(sensor.sheets)
    prior = offset = no_offset(sensor, options.drift_px)
    none = np.zeros(len(at), dtype=np.bool_)
    doubt = ever = none
    for _ in range(ROUNDS):
        pairs = _pairs(found, doubt, stripes, sides[1], sensor, offset=offset, options=options)
        verdicts = _decide_both(pairs, sides, n_sheets, options)
        used = pairs.is_match & (verdicts[0].name[at] == projected.sheet)
        asked = used | doubt | _is_tied(pairs, verdicts[0])
        piece = verdicts[0].piece[at]
        doubt = _doubtful(
            found,
            used,
            asked,
            piece,
            left.points_px[row],
            sensor=sensor,
            prior=prior,
            options=options,
        )
        ever = ever | doubt
        sure = used & ~doubt
        offset = estimate_offset(
            projected.select(sure), crossings.select(sure), sensor, prior, options.floor_px
        )
    unasked, doubted = used & doubt, ever
    return StereoNames(
        _named(sides[0], verdicts[0], *_marked(pairs.left, unasked, doubted, len(sides[0]))),
        _named(sides[1], verdicts[1], *_marked(pairs.right, unasked, doubted, len(sides[1]))),
        offset,
    )


def _marked(
    sample: IntArray, unasked: BoolArray, doubted: BoolArray, n: int
) -> tuple[BoolArray, BoolArray]:
    """(n,) samples of the pairs that two masks (H,) name; those of number -1 are none."""
    masks = []
    for mask in (unasked, doubted):
        marked = np.zeros(n + 1, dtype=np.bool_)
        marked[sample[mask]] = True
        masks.append(marked[:n])
    return masks[0], masks[1]


def _is_tied(pairs: _Pairs, verdict: Verdict) -> BoolArray:
    """(H,) pairs of pieces that several sheets explain, on one of these sheets."""
    open_piece = ~verdict.is_sure & verdict.is_tied
    candidate = verdict.is_candidate[verdict.piece[pairs.left], pairs.sheet]
    return np.asarray(pairs.is_match & open_piece[pairs.left] & candidate)


def _doubtful(
    found: _Found,
    used: BoolArray,
    asked: BoolArray,
    piece: IntArray,
    points_px: FloatArray,
    *,
    sensor: SensorCalibration,
    prior: EpipolarOffset,
    options: StereoLabelOptions,
) -> BoolArray:
    """(H,) pieces on sheets that do not fit the others, by their offset or by the surface.

    ``used`` pairs are those of certain names; ``asked`` ones are also those in doubt before, now
    that the others may be known better, and the candidates of pieces that several sheets explain.
    """
    doubt = np.zeros(len(used), dtype=np.bool_)
    at = np.flatnonzero(asked)
    if not len(at):
        return doubt
    projected, n_sheets = found.projected, len(sensor.sheets)
    keys, own = np.unique(piece[at] * n_sheets + projected.sheet[at], return_inverse=True)
    scores = left_out_scores(
        projected.select(at),
        found.crossings.select(at),
        own,
        used[at],
        sensor,
        prior=prior,
        floor_px=options.floor_px,
    )
    is_bad = scores > options.offset_chi_square
    known = at[used[at] & ~is_bad[own]]
    pixels, depth = points_px[found.sample], projected.points_mm[:, 2]
    planes = fit_planes(pixels[known], depth[known], piece[known])
    shape = (int(piece.max()) + 1, n_sheets)
    distance, is_on = surface_distance(pixels, depth, piece, projected.sheet, planes, shape=shape)
    of_piece, of_sheet = np.divmod(keys, n_sheets)
    off = distance[of_piece, of_sheet]
    is_bad |= (off > OFF_MM) & np.isfinite(off) & is_on[of_piece].any(axis=1)
    doubt[at] = is_bad[own]
    return doubt


def _pairs(
    found: _Found,
    doubted: BoolArray,
    stripes: RightStripes,
    right: _Side,
    sensor: SensorCalibration,
    *,
    offset: EpipolarOffset,
    options: StereoLabelOptions,
) -> _Pairs:
    """Log-likelihood ratio of each left sample on each sheet, given the offset known so far."""
    projected, crossings = found.projected, found.crossings
    n = len(found.sample)
    there = np.flatnonzero(crossings.is_found)
    missing = np.log(1.0 - options.seen_share)
    ratio = np.where(stripes.covers(projected.q_px), missing, 0.0)
    is_match = np.zeros(n, dtype=np.bool_)
    beside = np.full(n, -1)
    if len(there):
        crossed = crossings.select(there)
        residual, sigma = residual_and_sigma(
            projected.select(there), crossed, sensor, offset, options
        )
        ratio[there] = log_ratio(residual, sigma, stripes.spacing_px(), options.seen_share)
        is_match[there] = (np.abs(residual) < MATCH_SIGMAS * sigma) & (ratio[there] > 0.0)
        place = np.full(len(right.profile), -1)
        place[right.pieces.row] = right.samples.nearest
        beside[there] = place[crossed.row]
    is_match &= ~doubted
    ratio = np.where(doubted, missing, ratio)
    return _Pairs(found.sample, beside, projected.sheet, ratio, is_match)


def _decide_both(
    pairs: _Pairs, sides: tuple[_Side, _Side], n_sheets: int, options: StereoLabelOptions
) -> tuple[Verdict, Verdict]:
    """Names of both cameras that agree with each other."""
    missing = float(np.log(1.0 - options.seen_share))
    alive_left = alive_right = pairs.is_match
    for _ in range(EXCHANGES):
        left = _decide_left(pairs, alive_left, sides[0], n_sheets, missing, options=options)
        by_left = left.name[pairs.left]
        right = _decide_right(pairs, alive_right, sides[1], n_sheets, missing, options=options)
        by_right = np.append(right.name, -1)[pairs.right]
        alive_left = pairs.is_match & ((by_right == -1) | (by_right == pairs.sheet))
        alive_right = pairs.is_match & ((by_left == -1) | (by_left == pairs.sheet))
    left = _decide_left(pairs, alive_left, sides[0], n_sheets, missing, options=options)
    agreed = alive_left & (left.name[pairs.left] == pairs.sheet)
    return left, _decide_right(pairs, agreed, sides[1], n_sheets, missing, options=options)


def _decide_left(
    pairs: _Pairs,
    alive: BoolArray,
    side: _Side,
    n_sheets: int,
    missing: float,
    *,
    options: StereoLabelOptions,
) -> Verdict:
    scores = np.full((len(side), n_sheets), IMPOSSIBLE)
    scores[pairs.left, pairs.sheet] = np.where(alive | ~pairs.is_match, pairs.ratio, missing)
    is_match = np.zeros((len(side), n_sheets), dtype=np.bool_)
    is_match[pairs.left, pairs.sheet] = alive
    return decide(scores, is_match, side.pieces, side.samples, options)


def _decide_right(
    pairs: _Pairs,
    alive: BoolArray,
    side: _Side,
    n_sheets: int,
    missing: float,
    *,
    options: StereoLabelOptions,
) -> Verdict:
    """The same pairs, seen from the right stripes: each sample takes its best partner."""
    scores = np.full((len(side), n_sheets), missing)
    chosen = np.flatnonzero(alive & (pairs.right >= 0))
    where = (pairs.right[chosen], pairs.sheet[chosen])
    np.maximum.at(scores, where, pairs.ratio[chosen])
    is_match = np.zeros((len(side), n_sheets), dtype=np.bool_)
    is_match[where] = True
    return decide(scores, is_match, side.pieces, side.samples, options)


def _named(
    side: _Side, verdict: Verdict, unasked: BoolArray, doubted: BoolArray
) -> LabelledProfile:
    """Every point takes the name of the sample that stands for it.

    ``unasked`` (S,) samples lose their name; ``doubted`` (S,) ones are ambiguous if they have none.
    """
    n = len(side.profile)
    sheet = np.full(n, -1)
    fate = np.full(n, int(LabelStatus.NOT_ASKED))
    nearest = side.samples.nearest
    if len(side):
        lost = np.zeros(int(verdict.piece.max()) + 1, dtype=np.bool_)
        lost[verdict.piece[unasked]] = True
        sure = verdict.is_sure & ~lost[verdict.piece]
        is_tied = verdict.is_tied | doubted | lost[verdict.piece]
        of_sample = np.where(is_tied, int(LabelStatus.AMBIGUOUS), int(LabelStatus.UNEXPLAINED))
        of_sample[sure] = int(LabelStatus.NAMED)
        sheet[side.pieces.row] = np.where(sure, verdict.state, -1)[nearest]
        fate[side.pieces.row] = of_sample[nearest]
    return LabelledProfile(side.profile, sheet, fate, HOW)
