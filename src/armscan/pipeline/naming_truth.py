# SPDX-License-Identifier: Apache-2.0
"""Whether stripes got the names of the sheets that truly drew them: for simulated scans only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial import cKDTree

from armscan.devices.twin import SimulatedScan, TrueStripe
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.pipeline.instants import group_instants
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.reconstruction.result import PointFate, ReconstructedImage

ON_STRIPE_PX = 2.0
"""An extracted point belongs to the nearest true stripe if that is nearer than this."""
CROSSING_PX = 2.0
"""Where the true stripe of the name given is as near as this, both names are right."""
SEEN_MM = 0.25
"""A true point is seen by the other camera if that one has a true point so near."""
LEAST_POINTS = 20
"""A sheet counts as in view if so many accepted points of it are seen by all cameras."""
MOST_CHECKED = 8
"""Instants of a scan whose truth is computed, evenly chosen."""


@dataclass(frozen=True, slots=True)
class NamingErrors:
    """Names of stripe points against the truth; counts over the instants checked.

    Parameters
    ----------
    n_instants
        Instants checked.
    n_named
        Points that were measured and lie on a true stripe; one that two cameras see counts in both
        images.
    n_wrong
        Of these, with the name of another sheet.
    n_stray
        Points that were measured and lie on no true stripe.
    n_shared
        Accepted points on a true stripe that every camera of the head sees.
    n_shared_named
        Of these, measured.
    n_ambiguous, n_unexplained
        Accepted points that were dropped because several sheets, or none, explain them.
    n_stripes_in_view, n_stripes_named
        Sheets of which the left camera saw a stripe that every camera of the head sees, and those
        of them that gave a measured point; summed over the instants.
    """

    n_instants: int = 0
    n_named: int = 0
    n_wrong: int = 0
    n_stray: int = 0
    n_shared: int = 0
    n_shared_named: int = 0
    n_ambiguous: int = 0
    n_unexplained: int = 0
    n_stripes_in_view: int = 0
    n_stripes_named: int = 0

    def __add__(self, other: NamingErrors) -> NamingErrors:
        """Counts of both."""
        return NamingErrors(
            *(getattr(self, f.name) + getattr(other, f.name) for f in fields(NamingErrors))
        )

    @property
    def wrong_share(self) -> float:
        """Share of the measured points that bear a wrong name."""
        return self.n_wrong / max(self.n_named, 1)

    @property
    def named_share(self) -> float:
        """Share of the points that all cameras see that were named."""
        return self.n_shared_named / max(self.n_shared, 1)


def naming_errors(
    scan: ScanReconstruction, truth: SimulatedScan, true_names: Mapping[str, str]
) -> NamingErrors:
    """Compare the names of a scan with the truth of the same exposures.

    Parameters
    ----------
    scan
        What was measured; its rows bear the numbers that they have in the twin's scan.
    truth
        The scan as the twin has it.
    true_names
        The true name of each calibrated sheet, by the name that it was given.
    """
    image_of = dict(zip(scan.image_rows, scan.images, strict=True))
    rows = [exposure.row for exposure in scan.exposures]
    instants = [
        instant
        for instant in group_instants(rows, truth.name)
        if all(row in image_of for row in instant.rows)
    ]
    places = np.linspace(0, len(instants) - 1, min(MOST_CHECKED, len(instants))).round()
    total = NamingErrors()
    for k in places.astype(int):
        own = [rows[row] for row in instants[k].rows]
        true = [_lit(truth.true_stripes(row.index), row.lasers) for row in own]
        images = [image_of[row] for row in instants[k].rows]
        names = tuple(true_names[name] for name in scan.cloud.sheet_names)
        total += _of_instant(images, true, names)
    return total


def _lit(stripes: Sequence[TrueStripe], lasers: tuple[str, ...]) -> list[TrueStripe]:
    """Stripes of the sources that are on; all where the row names none."""
    return [s for s in stripes if not lasers or s.sheet.split(".")[0] in lasers]


def _of_instant(
    images: Sequence[ReconstructedImage],
    true: Sequence[Sequence[TrueStripe]],
    names: tuple[str, ...],
) -> NamingErrors:
    total = NamingErrors(n_instants=1)
    in_view: set[str] = set()
    for k, (image, stripes) in enumerate(zip(images, true, strict=True)):
        others = [stripes for j, stripes in enumerate(true) if j != k]
        found, shared = _of_image(image, stripes, others, names)
        total += found
        if k == 0:
            in_view = {name for name, count in shared.items() if count >= LEAST_POINTS}
    seen = {names[k] for image in images for k in set(image.sheet[_measured(image)].tolist())}
    return total + NamingErrors(n_stripes_in_view=len(in_view), n_stripes_named=len(in_view & seen))


def _of_image(
    image: ReconstructedImage,
    stripes: Sequence[TrueStripe],
    others: Sequence[Sequence[TrueStripe]],
    names: tuple[str, ...],
) -> tuple[NamingErrors, dict[str, int]]:
    """Names of one image, and how many points that all cameras see each sheet has in it."""
    points, measured = image.profile.points_px, _measured(image)
    distance, nearest = _distances(points, stripes)
    best = np.argmin(distance, axis=1) if len(stripes) else np.zeros(len(points), dtype=np.int64)
    on = distance.min(axis=1, initial=np.inf) < ON_STRIPE_PX
    own = _own_distance(image.sheet, distance, stripes, names)
    right_name = own < CROSSING_PX
    shared = on & image.profile.is_accepted & _seen_by_all(nearest, best, stripes, others)
    counts = {s.sheet: int((shared & (best == k)).sum()) for k, s in enumerate(stripes)}
    errors = NamingErrors(
        n_named=int((measured & on).sum()),
        n_wrong=int((measured & on & ~right_name).sum()),
        n_stray=int((measured & ~on).sum()),
        n_shared=int(shared.sum()),
        n_shared_named=int((shared & measured).sum()),
        n_ambiguous=image.count(PointFate.AMBIGUOUS),
        n_unexplained=image.count(PointFate.STRAY),
    )
    return errors, counts


def _measured(image: ReconstructedImage) -> BoolArray:
    """(N,) points whose name counts: measured here or with the other camera's."""
    return np.isin(image.fate, (int(PointFate.MEASURED), int(PointFate.SHARED)))


def _distances(points: FloatArray, stripes: Sequence[TrueStripe]) -> tuple[FloatArray, IntArray]:
    """(N, S) distances of points from stripes in px, and (N, S) their nearest points."""
    distance = np.full((len(points), len(stripes)), np.inf)
    nearest = np.zeros((len(points), len(stripes)), dtype=np.int64)
    for k, stripe in enumerate(stripes):
        if len(stripe.points_px) and len(points):
            distance[:, k], nearest[:, k] = cKDTree(stripe.points_px).query(points)
    return distance, nearest


def _own_distance(
    sheet: IntArray, distance: FloatArray, stripes: Sequence[TrueStripe], names: tuple[str, ...]
) -> FloatArray:
    """(N,) distance from the true stripe of the name that each point was given."""
    column: Mapping[str, int] = {stripe.sheet: k for k, stripe in enumerate(stripes)}
    own = np.full(len(sheet), np.inf)
    for k, name in enumerate(names):
        if name in column:
            given = sheet == k
            own[given] = distance[given, column[name]]
    return own


def _seen_by_all(
    nearest: IntArray,
    best: IntArray,
    stripes: Sequence[TrueStripe],
    others: Sequence[Sequence[TrueStripe]],
) -> BoolArray:
    """(N,) True where the true point also lies on the same sheet's stripe of every other camera."""
    seen = np.ones(len(best), dtype=np.bool_)
    for other in others:
        by_name = {stripe.sheet: stripe for stripe in other}
        for k, stripe in enumerate(stripes):
            given = np.flatnonzero(best == k)
            there = by_name.get(stripe.sheet)
            if there is None or not len(there.points_base_mm) or not len(stripe.points_base_mm):
                seen[given] = False
                continue
            at = stripe.points_base_mm[nearest[given, k]]
            seen[given] &= cKDTree(there.points_base_mm).query(at)[0] < SEEN_MM
    return seen
