# SPDX-License-Identifier: Apache-2.0
"""Names the stripes of a cross-line head while its lasers stay on: each from its past."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Points, Pose
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.choose_sheet import DepthRange
from armscan.reconstruction.cross_evidence import (
    Hypotheses,
    hypothesise,
    past_evidence,
    still_evidence,
    taken_evidence,
)
from armscan.reconstruction.image_memory import SHARPNESS, ImageMemory
from armscan.reconstruction.named_profile import NamedProfile, NameFate
from armscan.reconstruction.piece_labels import smoothed_posterior
from armscan.reconstruction.stretches import Pieces, cut_pieces
from armscan.reconstruction.stripe_namer import STROKE_GAP_NS
from armscan.reconstruction.surface_memory import SurfaceMemory
from armscan.reconstruction.triangulate import meet_sheets
from armscan.records.profile import Profile

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


class CrossNamer:
    """Predicts every stripe from the past of its stroke; a `StripeNamer`.

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
    ) -> NamedProfile:
        """Name the points of the next exposure; see `StripeNamer`.

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
        return NamedProfile(profile, verdict.sheet, verdict.fate, how)

    def _judge(
        self, profile: Profile, possible: tuple[int, ...], pose: Pose[Base, Sensor] | None
    ) -> _Verdict:
        n = len(profile)
        pieces = cut_pieces(profile)
        fate = np.full(n, int(NameFate.NOT_ASKED))
        sheet, odds = np.full(n, -1), np.full(n, -np.inf)
        undecided = np.zeros(len(self._source_of))
        if not len(pieces):
            return _Verdict(sheet, odds, fate, undecided)
        samples = profile.points_px[pieces.sample]
        hypotheses = hypothesise(samples, possible, self._sensor, self._options.depths)
        posterior = self._posterior(samples, pieces, hypotheses, pose)
        best, margin = _best(posterior)
        inside = pieces.mean(hypotheses.is_inside.astype(np.float64))
        verdict = np.where(margin >= self._options.margin, NameFate.NAMED, NameFate.AMBIGUOUS)
        is_explained = np.take_along_axis(inside, best[:, None], axis=1)[:, 0] > 0.5
        verdict[~is_explained] = NameFate.UNEXPLAINED
        asked = pieces.of_point >= 0
        own = pieces.of_point[asked]
        fate[asked], odds[asked] = verdict[own], margin[own]
        sheet[asked] = np.where(verdict[own] == NameFate.NAMED, np.array(possible)[best[own]], -1)
        doubtful = np.where(verdict == NameFate.AMBIGUOUS, pieces.size, 0)
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
        points, is_met = meet_sheets(pixels, sheet, self._sensor)
        in_sensor: Points[Sensor] = Points(points[is_met])
        self._surface.remember((pose @ in_sensor).xyz_mm)

    def _plan(self, verdict: _Verdict, possible: tuple[int, ...]) -> None:
        """Choose the lasers of the next exposure: all, or the one that most undecided are of."""
        on = {self._source_of[k] for k in possible}
        self._since_single = 0 if len(on) == 1 else self._since_single + 1
        expected = dict.fromkeys(self._sources, 0.0)
        for source, points in zip(self._source_of, verdict.undecided.tolist(), strict=True):
            expected[source] += points
        n_asked = int((verdict.fate != int(NameFate.NOT_ASKED)).sum())
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
