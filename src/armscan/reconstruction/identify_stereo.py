# SPDX-License-Identifier: Apache-2.0
"""Which of many sheets drew each stripe, told by a second camera (eqs. 4.17 and 4.18)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.epipolar_offset import (
    EpipolarOffset,
    estimate_offset,
    left_out_scores,
    no_offset,
    predicted_residuals,
)
from armscan.reconstruction.named_profile import NamedProfile, NameFate
from armscan.reconstruction.near_surface import OFF_MM, fit_planes, surface_distance
from armscan.reconstruction.sheet_scores import IMPOSSIBLE, Verdict, decide, log_ratio
from armscan.reconstruction.stereo_options import StereoNamingOptions
from armscan.reconstruction.stereo_residuals import (
    Crossings,
    Projections,
    RightStripes,
    find_crossings,
    possible_sheets,
    project_on_sheets,
)
from armscan.reconstruction.unbroken import Pieces, Samples, cut_stripes, take_samples
from armscan.records.profile import Profile

EXCHANGES = 2
"""Rounds in which the two cameras' certain names rule out pairs of the other."""
ROUNDS = 3
"""Names, then the offset from these and doubts about them, and again."""
MATCH_SIGMAS = 4.0
HOW = "the sheet on which the left stripe's picture falls on a right stripe (eqs. 4.17, 4.18)"


@dataclass(frozen=True, slots=True, eq=False)
class StereoNames:
    """Stripes of both cameras with their sheets, and the offset found on the way."""

    left: NamedProfile
    right: NamedProfile
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
    options: StereoNamingOptions,
) -> tuple[FloatArray, FloatArray]:
    """Residual (H,) beyond what the offset explains, and its standard deviation (H,), px."""
    expected, spread = predicted_residuals(projected, crossings, sensor, offset)
    sigma = np.sqrt(crossings.sigma_px**2 + spread**2 + options.floor_px**2)
    return crossings.residual_px - expected, sigma


def name_stripes(
    left: Profile, right: Profile, sensor: SensorCalibration, options: StereoNamingOptions
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
    options: StereoNamingOptions,
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
    options: StereoNamingOptions,
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
    pairs: _Pairs, sides: tuple[_Side, _Side], n_sheets: int, options: StereoNamingOptions
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
    options: StereoNamingOptions,
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
    options: StereoNamingOptions,
) -> Verdict:
    """The same pairs, seen from the right stripes: each sample takes its best partner."""
    scores = np.full((len(side), n_sheets), missing)
    chosen = np.flatnonzero(alive & (pairs.right >= 0))
    where = (pairs.right[chosen], pairs.sheet[chosen])
    np.maximum.at(scores, where, pairs.ratio[chosen])
    is_match = np.zeros((len(side), n_sheets), dtype=np.bool_)
    is_match[where] = True
    return decide(scores, is_match, side.pieces, side.samples, options)


def _named(side: _Side, verdict: Verdict, unasked: BoolArray, doubted: BoolArray) -> NamedProfile:
    """Every point takes the name of the sample that stands for it.

    ``unasked`` (S,) samples lose their name; ``doubted`` (S,) ones are ambiguous if they have none.
    """
    n = len(side.profile)
    sheet = np.full(n, -1)
    fate = np.full(n, int(NameFate.NOT_ASKED))
    nearest = side.samples.nearest
    if len(side):
        lost = np.zeros(int(verdict.piece.max()) + 1, dtype=np.bool_)
        lost[verdict.piece[unasked]] = True
        sure = verdict.is_sure & ~lost[verdict.piece]
        is_tied = verdict.is_tied | doubted | lost[verdict.piece]
        of_sample = np.where(is_tied, int(NameFate.AMBIGUOUS), int(NameFate.UNEXPLAINED))
        of_sample[sure] = int(NameFate.NAMED)
        sheet[side.pieces.row] = np.where(sure, verdict.state, -1)[nearest]
        fate[side.pieces.row] = of_sample[nearest]
    return NamedProfile(side.profile, sheet, fate, HOW)
