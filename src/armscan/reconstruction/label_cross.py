# SPDX-License-Identifier: Apache-2.0
"""Sheets of the stripes of crossed lasers, from what the past of a pass showed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Base, Points, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.labels import (
    PASS_GAP_NS,
    LabelledInstant,
    LabelledProfile,
    PointStatus,
    given_to_none,
    sheets_of,
    without_sheet,
)
from armscan.reconstruction.segments import (
    SHARPNESS,
    ImageMemory,
    LoneLines,
    Pieces,
    SurfaceMemory,
    cut_pieces,
    likeliest,
    smoothed_posterior,
    switch_probability,
)
from armscan.reconstruction.triangulate import (
    LABEL_DEPTHS,
    MOST_MARGIN,
    DepthRange,
    intersect_sheets,
)
from armscan.records.profile import Profile

FIELD_MM = 85.0
"""The lengths in mm hold for fields of view up to this. Wider ones see coarser points of larger
things: there all lengths grow with the field. Smaller ones do not have a better arm, nor a slower
hand."""
OUTSIDE = -4.0
"""Log-likelihood of a piece that lies outside the depths of a sheet, over one that is inside."""
DIRECTION_RAD = np.radians(25.0)
"""Standard deviation of a stripe's direction from that on a surface that faces the camera."""
ODD_DIRECTION = 0.1
"""Share of stripes that run in any direction: walls and edges."""
CONVINCING = 3
"""What misleads one piece of a segment misleads all: they count once together. A segment of fewer
pieces than this counts for less: edges and outlines make short ones of any direction."""
ALIKE_PIECES = 8
"""A still has nothing but depth, direction and rays. Direction and rays count again every so many
pieces; depth does not: all of a surface that lies beyond those of its own line may be within those
of another."""
MOST_IN_STILL = 2
"""Of more lines direction does not count again either: on a surface that leans by 40 degrees one
runs as another does on one that faces the camera."""
INDEPENDENT = 0.5
"""Of sharp predictions: neighbouring pieces share some of what they err by."""
TAKEN = -3.0
"""Log-likelihood of a piece whose place in the sheet's light is taken by another segment."""
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
    is_near, is_inside
        (S, H) True where the point lies within the depths accepted or by their calibrated width
        beyond them, and where within them.
    place_mm
        (H, S) coordinate along the sheet.
    """

    sheets: tuple[int, ...]
    points_mm: FloatArray
    is_near: BoolArray
    is_inside: BoolArray
    place_mm: FloatArray


def hypothesise(
    points_px: FloatArray,
    sheets: tuple[int, ...],
    sensor: SensorCalibration,
    depths: DepthRange,
) -> Hypotheses:
    """Intersect the rays of samples (S, 2) with each sheet."""
    wider = DepthRange(min(depths.margin + 1.0, MOST_MARGIN))
    points, near, inside, place = [], [], [], []
    for k in sheets:
        of_sheet = np.full(len(points_px), k)
        met, is_met = intersect_sheets(points_px, of_sheet, sensor)
        sheet = sensor.sheets[k].sheet
        points.append(met)
        near.append(is_met & wider.holds(met, of_sheet, sensor))
        inside.append(is_met & depths.holds(met, of_sheet, sensor))
        place.append((met - sheet.origin_mm) @ sheet.axes[0])
    return Hypotheses(
        sheets, np.array(points), np.array(near).T, np.array(inside).T, np.array(place)
    )


def still_evidence(
    pieces: Pieces,
    hypotheses: Hypotheses,
    sensor: SensorCalibration,
    *,
    is_still: bool = False,
    is_wide: bool = False,
) -> FloatArray:
    """(P, H) log-likelihood of the pieces' depths and directions, in this exposure alone.

    With ``is_wide`` depths that are near speak against no sheet. Boards show each line other
    depths; what lies beyond those of its own line, and of many lines within those of another, would
    be named by depth alone and then be the past.
    """
    is_possible = hypotheses.is_near if is_wide else hypotheses.is_inside
    depth = OUTSIDE * pieces.mean((~is_possible).astype(np.float64))
    usual = np.stack([frontal_direction(sensor, k) for k in hypotheses.sheets], axis=1)
    turn = np.arccos(np.clip(np.abs(pieces.direction @ usual), 0.0, 1.0))
    likelihood = (1.0 - ODD_DIRECTION) * np.exp(-0.5 * (turn / DIRECTION_RAD) ** 2) + ODD_DIRECTION
    direction = _vote(pieces, is_still=is_still) * np.log(likelihood)
    return np.asarray(_vote(pieces) * depth + direction)


def _vote(pieces: Pieces, *, is_still: bool = False) -> FloatArray:
    """(P, 1) weights by which the pieces of a segment count once together, of a short one less."""
    count = np.bincount(pieces.segment)[pieces.segment]
    vote = 1.0 / np.maximum(count, CONVINCING)
    if is_still:
        vote = np.minimum(1.0, vote + 1.0 / ALIKE_PIECES)
    return np.asarray(vote[:, None])


def field_mm(sensor: SensorCalibration) -> float:
    """Width of the field of view in the middle of the depths of all sheets."""
    camera = sensor.camera.camera
    depth = float(np.mean([sheet.depth_range_mm for sheet in sensor.sheets]))
    return camera.width_px * depth / camera.fx_px


def frontal_direction(sensor: SensorCalibration, sheet: int) -> FloatArray:
    """(2,) direction, in the image, of a sheet's stripe on a surface that faces the camera."""
    model = sensor.sheets[sheet].sheet
    along = np.cross(model.axes[2], [0.0, 0.0, 1.0])
    ends = model.origin_mm + np.array([[-1.0], [1.0]]) * along
    first, last = sensor.camera.camera.project(ends)
    return np.asarray((last - first) / np.linalg.norm(last - first))


LEAST_APART_RAD = 0.5
"""Stripes whose directions differ by more are told from each other by direction."""


def stripes_apart(sensor: SensorCalibration) -> BoolArray:
    """(S, S) True where the stripes of two sheets on a wall that faces the camera run apart."""
    normals = np.array([calibrated.sheet.axes[2][:2] for calibrated in sensor.sheets])
    angles = np.arctan2(normals[:, 1], normals[:, 0])
    apart = np.abs(np.sin(angles[:, None] - angles))
    return np.asarray(apart > np.sin(LEAST_APART_RAD))


def past_evidence(pieces: Pieces, log_gain: FloatArray, sharpness: FloatArray) -> FloatArray:
    """(P, H) log-likelihood of the pieces, from how well their samples continue the past.

    Sharp predictions err apart from piece to piece, vague ones in common.

    Parameters
    ----------
    pieces
        Of the profile.
    log_gain, sharpness
        (S, H) from `armscan.reconstruction.segments.SurfaceMemory.evidence`.
    """
    sharp = INDEPENDENT * pieces.mean(log_gain * sharpness)
    vague = _vote(pieces) * pieces.mean(log_gain * (1.0 - sharpness))
    return np.asarray(sharp + vague)


def taken_evidence(
    log_posterior: FloatArray,
    pieces: Pieces,
    hypotheses: Hypotheses,
    ray_mm: float = RAY_MM,
    *,
    is_still: bool = False,
) -> FloatArray:
    """(P, H) penalty where another segment already holds the same rays of a sheet's light.

    A ray of a laser ends on the first thing that it meets, so it is seen once.

    Parameters
    ----------
    log_posterior
        (P, H) what is believed without this.
    pieces, hypotheses
        Of the profile.
    ray_mm
        Along the sheet, light within this counts as one ray of the laser.
    is_still
        True where nothing but the profile is known, see `ALIKE_PIECES`.
    """
    of_sample = pieces.of_sample
    segment = pieces.segment[of_sample]
    penalty = np.zeros(hypotheses.is_inside.shape)
    for h in range(len(hypotheses.sheets)):
        belief = np.where(hypotheses.is_inside[:, h], np.exp(log_posterior[of_sample, h]), 0.0)
        # only rays that occur: those nearly along the sheet meet it far away
        occurring = np.floor(hypotheses.place_mm[h] / ray_mm)
        ray = np.unique(occurring, return_inverse=True)[1]
        table = np.zeros((int(segment.max(initial=0)) + 1, int(ray.max(initial=0)) + 1))
        np.maximum.at(table, (segment, ray), belief)
        penalty[:, h] = TAKEN * _most_of_others(table)[segment, ray]
    return np.asarray(_vote(pieces, is_still=is_still) * pieces.mean(penalty))


def _most_of_others(table: FloatArray) -> FloatArray:
    """Largest value of each column over the other rows."""
    if len(table) == 1:
        return np.zeros_like(table)
    order = np.sort(table, axis=0)
    is_most = np.arange(len(table))[:, None] == table.argmax(axis=0)
    return np.asarray(np.where(is_most, order[-2], order[-1]))


MOST_BY_PAST = 2
"""Lines that the past alone tells. Of more, all may seem to lie one name further where a thing is
as high as two lines lie apart: a surface that continues the known one, at another depth."""
ROW_PX = 32.0
"""What lies within this along the stripes is beside each other. Light of a laser moves across its
stripes where the depth changes, so that it stays there."""
SEEN_AGAIN = 0.7
"""A piece of which a larger share was seen before is where the past says."""


def held_beside(
    pieces: Pieces, hypotheses: Hypotheses, named: IntArray, sensor: SensorCalibration
) -> FloatArray:
    """(P, H) share of a piece beside which, across the stripes, another segment has the name.

    Parameters
    ----------
    pieces, hypotheses
        Of the profile.
    named
        (P,) likely hypothesis of each piece; -1 for none.
    sensor
        Camera and sheets.
    """
    held = np.zeros((len(pieces), len(hypotheses.sheets)))
    segment = pieces.segment[pieces.of_sample]
    width = ROW_PX / sensor.camera.camera.fx_px
    for h, k in enumerate(hypotheses.sheets):
        met, is_met = hypotheses.points_mm[h], hypotheses.is_near[:, h]
        depth = np.where(is_met, met[:, 2], np.inf)
        along = met @ sensor.sheets[k].sheet.axes[0] / depth
        row = np.unique(np.floor(along / width), return_inverse=True)[1]
        has = (named == h)[pieces.of_sample] & is_met
        table = np.zeros((int(segment.max(initial=0)) + 1, int(row.max(initial=0)) + 1))
        table[segment[has], row[has]] = 1.0
        others = table.sum(axis=0)[row] - table[segment, row]
        held[:, h] = pieces.mean((is_met & (others > 0.0)).astype(np.float64))
    return held


def _order_beside(
    along: FloatArray, sheets: tuple[int, ...], sensor: SensorCalibration
) -> IntArray | None:
    """(H,) hypotheses in the order of their stripes across a wall; None where stripes cross."""
    camera = sensor.camera.camera
    depth = float(np.mean([sensor.sheets[k].depth_range_mm for k in sheets]))
    far = max(camera.width_px, camera.height_px) / camera.fx_px
    orders = []
    for end in (-0.5 * far, 0.5 * far):
        place = []
        for k in sheets:
            sheet = sensor.sheets[k].sheet
            n = sheet.axes[2]
            down = n @ sheet.origin_mm / depth - n[2] - end * (n[:2] @ along)
            place.append(down / (n[:2] @ [-along[1], along[0]]))
        orders.append(np.argsort(place))
    return orders[0] if (orders[0] == orders[1]).all() else None


def in_order_beside(
    samples_px: FloatArray,
    pieces: Pieces,
    sheets: tuple[int, ...],
    named: IntArray,
    sensor: SensorCalibration,
) -> BoolArray:
    """(S,) True where as many stripes as sheets lie side by side, and no name is out of order."""
    along = np.array([frontal_direction(sensor, k) for k in sheets])
    along *= np.sign(along @ along[0])[:, None]
    u = along.sum(axis=0) / np.linalg.norm(along.sum(axis=0))
    order = _order_beside(u, sheets, sensor)
    if order is None:
        return np.zeros(len(samples_px), dtype=np.bool_)
    segment = pieces.segment[pieces.of_sample]
    row = np.unique(np.floor(samples_px @ u / ROW_PX), return_inverse=True)[1]
    shape = (int(segment.max(initial=0)) + 1, int(row.max(initial=0)) + 1)
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, (segment, row), samples_px @ [-u[1], u[0]])
    np.add.at(count, (segment, row), 1.0)
    across = np.where(count > 0.0, total / np.maximum(count, 1.0), np.inf)
    rank = across.argsort(axis=0).argsort(axis=0)[segment, row]
    name = named[pieces.of_sample]
    is_odd = (name >= 0) & (order[np.minimum(rank, len(order) - 1)] != name)
    n_odd = np.bincount(row, is_odd, minlength=shape[1])
    is_whole = (count > 0.0).sum(axis=0) == len(order)
    return np.asarray((is_whole & (n_odd == 0))[row])


MARGIN = 5.0
"""Least log-odds of a sheet over all others; later stripes are predicted from such points. Chosen
with the other limits on the seeds that docs/explanations/naming-cross.md names."""
UNDECIDED_SHARE, LEAST_BETWEEN = 0.2, 4
"""A larger share of points without a sheet asks for one laser alone, but not before so many
exposures with all lasers."""
MOST = 0.5
"""With a larger share undecided, one stripe alone gives no less than all of them together."""
ROUNDS = 2
"""Times that the rays held by other segments are looked up."""


@dataclass(frozen=True, slots=True, eq=False)
class _Assignment:
    """Sheet (N,), status (N,) of points; undecided ones expected of each sheet."""

    sheet: IntArray
    status: IntArray
    undecided: FloatArray


class CrossLabeller:
    """Predicts every stripe from the past of its pass; a `StripeLabeller`.

    A segment of a profile gives other points in space under each sheet. Those of the right sheet
    continue the surface that the last exposures measured; those of a wrong one leave it steeply.
    The log-likelihoods of a segment's pieces are joined along it, and the light of a sheet falls
    on one thing only. What stays undecided is dropped and counted, and one laser is asked for
    alone. Without the arm's pose each stripe is predicted in the image, from its last place and
    motion.

    Parameters
    ----------
    sensor
        Camera and sheets; a source draws the sheets that bear its name.
    depths
        Depths that are possible.
    """

    def __init__(self, sensor: SensorCalibration, depths: DepthRange = LABEL_DEPTHS) -> None:
        self._sensor, self._depths = sensor, depths
        self._source_of = tuple(sheet.name.partition(".")[0] for sheet in sensor.sheets)
        self._sources = tuple(dict.fromkeys(self._source_of))
        self._lone = LoneLines(self._source_of)
        limits = [depths.limits_mm(sheet) for sheet in sensor.sheets]
        self._scale = max(1.0, field_mm(sensor) / FIELD_MM)
        span = max(high - low for low, high in limits)
        self._surface = SurfaceMemory(depth_span_mm=span, scale=self._scale)
        self._image = ImageMemory()
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next exposure begins a new pass."""
        self._surface.forget()
        self._image.forget()
        self._last_ns: int | None = None
        self._next = self._sources[:1]
        self._since_single = 0
        self._lone.reset()

    def next_lasers(self) -> tuple[str, ...]:
        """One laser alone as a pass starts (of many each) or if labels are in doubt, else all."""
        return self._next

    def left_out(self, lasers: tuple[str, ...]) -> str:
        """Sources without a sheet, whose stripes would be taken for those of others."""
        unknown = without_sheet(self._sensor, lasers)
        names = " and ".join(unknown)
        return f"of {names}, which was on, the calibration has no sheet" if unknown else ""

    def label(
        self,
        profiles: Sequence[Profile],
        lasers: tuple[str, ...] = (),
        base_from_sensor: Pose[Base, Sensor] | None = None,
        t_ns: int = 0,
    ) -> LabelledInstant:
        """Label the points of the next exposure; see `StripeLabeller`."""
        (profile,) = profiles
        if self._last_ns is not None and t_ns - self._last_ns > PASS_GAP_NS:
            self.reset()
        self._last_ns = t_ns
        if why := self.left_out(lasers):
            return given_to_none(profile, why)
        possible = sheets_of(self._sensor, lasers or self._sources)
        found = self._assign(profile, possible, base_from_sensor)
        self._learn(profile, found, base_from_sensor)
        self._plan(found, possible)
        reason = self._reason(possible, base_from_sensor is not None)
        return LabelledInstant(
            (
                LabelledProfile(
                    profile=profile, sheet=found.sheet, status=found.status, reason=reason
                ),
            )
        )

    def _assign(
        self, profile: Profile, possible: tuple[int, ...], pose: Pose[Base, Sensor] | None
    ) -> _Assignment:
        n = len(profile)
        pieces = cut_pieces(profile)
        status = np.full(n, int(PointStatus.FLAGGED))
        sheet = np.full(n, -1)
        undecided = np.zeros(len(self._source_of))
        if not len(pieces):
            return _Assignment(sheet, status, undecided)
        samples = profile.points_px[pieces.sample]
        hypotheses = hypothesise(samples, possible, self._sensor, self._depths)
        posterior = self._posterior(samples, pieces, hypotheses, pose)
        best, margin = likeliest(posterior)
        is_near, is_explained = (
            np.take_along_axis(pieces.mean(flag.astype(np.float64)), best[:, None], 1)[:, 0] > 0.5
            for flag in (hypotheses.is_near, hypotheses.is_inside)
        )
        is_told = margin >= MARGIN
        if len(possible) > MOST_BY_PAST and (pose is not None or len(self._image)):
            named = np.where(is_told & is_explained, best, -1)
            is_told &= (named < 0) | ~self._is_open(samples, pieces, hypotheses, named, pose)
        of_piece = np.where(is_told, PointStatus.MEASURED, PointStatus.AMBIGUOUS)
        beyond = np.where(is_near, PointStatus.OUT_OF_DEPTH, PointStatus.STRAY)
        of_piece[~is_explained] = beyond[~is_explained]
        accepted = pieces.of_point >= 0
        piece = pieces.of_point[accepted]
        status[accepted] = of_piece[piece]
        assigned = np.where(of_piece == PointStatus.MEASURED, np.array(possible)[best], -1)
        sheet[accepted] = assigned[piece]
        in_doubt = np.where(of_piece == PointStatus.AMBIGUOUS, pieces.size, 0)
        undecided[list(possible)] = in_doubt @ np.exp(posterior)
        return _Assignment(sheet, status, undecided)

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
                normal = self._sensor.sheets[k].sheet.axes[2]
                gain[:, h], sharpness[:, h] = self._surface.evidence(points, pose, normal)
        past = past_evidence(pieces, gain, sharpness)
        is_alone, n = pose is None and not len(self._image), len(hypotheses.sheets)
        is_still, is_wide = is_alone and n <= MOST_IN_STILL, not is_alone and n > MOST_BY_PAST
        evidence = past + still_evidence(
            pieces, hypotheses, self._sensor, is_still=is_still, is_wide=is_wide
        )
        switch = switch_probability(pieces, len(hypotheses.sheets))
        posterior = smoothed_posterior(evidence, switch)
        for _ in range(ROUNDS):
            taken = taken_evidence(
                posterior, pieces, hypotheses, RAY_MM * self._scale, is_still=is_still
            )
            posterior = smoothed_posterior(evidence + taken, switch)
        return posterior

    def _is_open(
        self,
        samples_px: FloatArray,
        pieces: Pieces,
        hypotheses: Hypotheses,
        named: IntArray,
        pose: Pose[Base, Sensor] | None,
    ) -> BoolArray:
        """(P,) True where many lines are on and another may as well have drawn the piece.

        Not open is what was seen before at the same place; what lies in order where all lines that
        are on lie beside each other; and what no other sheet may have drawn, because the piece is
        out of its depths, or showed nothing when it was on alone, or because its stripe is beside
        the piece, of one that was on alone.
        """
        is_inside = pieces.mean(hypotheses.is_inside.astype(np.float64)) > 0.0
        held = held_beside(pieces, hypotheses, named, self._sensor)
        is_free = (held < 1.0) | [k not in self._lone.shown for k in hypotheses.sheets]
        is_free &= [k not in self._lone.absent for k in hypotheses.sheets]
        others = np.arange(len(hypotheses.sheets)) != named[:, None]
        is_open = np.asarray((is_inside & is_free & others).any(axis=1))
        in_order = in_order_beside(samples_px, pieces, hypotheses.sheets, named, self._sensor)
        is_open &= pieces.mean(in_order.astype(np.float64)) < 1.0
        if pose is not None:
            name = named[pieces.of_sample]
            points = hypotheses.points_mm[name, np.arange(len(name))]
            again = self._surface.sees_again(points, pose)
            is_open &= pieces.mean(again.astype(np.float64)) < SEEN_AGAIN
        is_twice = np.take_along_axis(held, named[:, None], axis=1)[:, 0] > 0.5
        return is_open | is_twice

    def _learn(self, profile: Profile, found: _Assignment, pose: Pose[Base, Sensor] | None) -> None:
        known = found.sheet >= 0
        sheet, pixels = found.sheet[known], profile.points_px[known]
        self._image.remember(pixels, profile.normals_px[known], sheet)
        if pose is not None:
            points, is_met = intersect_sheets(pixels, sheet, self._sensor)
            in_sensor: Points[Sensor] = Points(points[is_met])
            self._surface.remember((pose @ in_sensor).xyz_mm)

    def _plan(self, found: _Assignment, possible: tuple[int, ...]) -> None:
        """Choose the lasers of the next exposure: all, or the one that most undecided are of."""
        on = {self._source_of[k] for k in possible}
        self._since_single = 0 if len(on) == 1 else self._since_single + 1
        self._lone.learn(possible, found.sheet)
        expected = dict.fromkeys(self._sources, 0.0)
        for source, points in zip(self._source_of, found.undecided.tolist(), strict=True):
            expected[source] += points
        n_asked = int((found.status != PointStatus.FLAGGED).sum())
        n_undecided = sum(expected.values())
        is_due = self._since_single > LEAST_BETWEEN or n_undecided > MOST * n_asked
        is_in_doubt = n_undecided > UNDECIDED_SHARE * n_asked
        most = max(self._sources, key=lambda source: expected[source])
        self._next = (most,) if is_in_doubt and is_due else self._sources
        if self._lone.due and len(self._sources) > MOST_BY_PAST:
            self._next = self._lone.due[:1]

    def _reason(self, possible: tuple[int, ...], has_pose: bool) -> str:
        if len(possible) == 1:
            return f"sheet {self._sensor.sheets[possible[0]].name}, the laser that was on"
        if has_pose:
            return "the sheet that continues the surface of the exposures before"
        return "the sheet whose stripe was last seen near, without the arm's pose"
