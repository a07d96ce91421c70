# SPDX-License-Identifier: Apache-2.0
"""Assignment of stripes to sheets by the lasers that were on, along a fan, and by common planes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from armscan.calibration.sheets.coplanarity import CommonPlane, fit_common_plane
from armscan.calibration.sheets.fan import number_fan
from armscan.calibration.sheets.result import SheetOptions
from armscan.calibration.sheets.stripes_on_board import BoardImage, StripeObservation
from armscan.geometry.estimate import FitFailure

CLEAR_CHI2 = 10_000
"""Beyond it rounding decides on the digits, and nobody asks."""
AMBIGUOUS_CHI2 = 9.0
"""An assignment must beat the next one by this much (three sigma) to be told from it by
coplanarity."""
MAX_SEEDS = 12
"""Pairs of images from which assignments are grown, those whose stripes are twisted most."""
GROWTH_ROUNDS = 6
NO_PLANE = 1e6
"""Chi-square of stripes that have no common plane."""
LEAST_FAN = 4
"""Lines in an image from which on they are taken for a fan of which others may be out of view."""
LEAST_SEVERAL = 3
"""Lines in most images of one source from which on it is taken to make several: two may be one
line and its reflection."""
ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"

Labels = tuple[tuple[int, ...], ...]
"""For each image, the sheet of each of its stripes; -1 for none."""
Stripes = Sequence[Sequence[StripeObservation]]
"""The stripes of each image."""


@dataclass(frozen=True, slots=True)
class SheetAssignment:
    """Sheets of all stripes: ``sheets[i][k]`` of stripe k of image i, -1 for none.

    If ``is_fan``, lines of a fan were found among others: one that cannot be calibrated may be left
    out.
    """

    names: tuple[str, ...]
    sheets: Labels
    how: str
    warnings: tuple[str, ...] = ()
    is_fan: bool = False

    def without(self, sheet: int, reason: str) -> SheetAssignment:
        """The same without a sheet, whose stripes lose their name."""
        place = [k - (k > sheet) if k != sheet else -1 for k in range(len(self.names))]
        return replace(
            self,
            names=self.names[:sheet] + self.names[sheet + 1 :],
            sheets=tuple(tuple(place[k] if k >= 0 else -1 for k in row) for row in self.sheets),
            warnings=(*self.warnings, f"left out: {reason}"),
        )


def assign_sheets(
    images: Sequence[BoardImage], options: SheetOptions
) -> SheetAssignment | FitFailure:
    """Give every straight stripe to a sheet, without the operator where that is possible.

    The caller's word comes first (one laser an image). The lines of a source that makes several
    are numbered along their fan (`armscan.calibration.sheets.fan`), though no image shows
    them all. Otherwise stripes that belong together are coplanar: assignments grown from pairs of
    images are compared by the chi-square of all stripes' common planes. Where coplanarity cannot
    tell (parallel stripes), the order across the image decides and a warning says so.
    """
    lasers = {image.data.lasers for image in images if image.stripes}
    if lasers and all(len(names) == 1 for names in lasers):
        return _by_caller(images, options)
    counts = [len(image.stripes) for image in images if image.stripes]
    wanted = options.n_sheets or len(options.sheet_names)
    together = next(iter(lasers)) if len(lasers) == 1 else ()
    usual = max(counts, key=lambda n: (counts.count(n), n), default=0)
    n_sheets = wanted or len(together) or usual
    most = max([n_sheets, *([] if wanted else counts)])
    if not any(len(names) > 1 for names in lasers) and most >= LEAST_FAN:
        return _one_fan(images, wanted, options.sheet_names or tuple(ALPHABET))
    if len(lasers) > 1:
        return FitFailure(
            "some images name several lasers, others different ones: "
            + "; ".join(", ".join(group) or "none" for group in sorted(lasers)),
            "switch on one laser an image, or all of them in every image",
        )
    names = options.sheet_names or together or tuple(ALPHABET[:n_sheets] or ("A",))
    if len(names) < n_sheets:
        return FitFailure(
            f"{n_sheets} stripes an image but {len(names)} names", "give one name a sheet"
        )
    if n_sheets > 1:
        return _by_coplanarity([image.stripes for image in images], names)
    sheets = tuple(_longest_only(image) for image in images)
    return SheetAssignment(names, sheets, "one stripe an image, hence one sheet")


def _one_fan(
    images: Sequence[BoardImage], n_sheets: int, pool: tuple[str, ...]
) -> SheetAssignment | FitFailure:
    """All stripes are lines of one source that has no name; the pool names its lines."""
    fan = number_fan([image.stripes for image in images], board_numbers(images), n_sheets)
    if isinstance(fan, FitFailure):
        return fan
    if fan.numbers[-1] > len(pool):
        return FitFailure(f"{fan.numbers[-1]} lines but {len(pool)} names", "give one name a line")
    names = tuple(pool[number - 1] for number in fan.numbers)
    return SheetAssignment(names, fan.sheets, fan.how, fan.warnings, is_fan=True)


def _by_caller(images: Sequence[BoardImage], options: SheetOptions) -> SheetAssignment | FitFailure:
    """One source an image; the lines of a source that makes several are numbered."""
    sources = tuple(dict.fromkeys(image.data.lasers[0] for image in images if image.stripes))
    boards = board_numbers(images)
    names: list[str] = []
    sheets: list[tuple[int, ...]] = [tuple(-1 for _ in image.stripes) for image in images]
    how, warnings = ["one laser an image, as named by the caller"], list[str]()
    for source in sources:
        of_source = [i for i, image in enumerate(images) if image.data.lasers[:1] == (source,)]
        counts = [len(images[i].stripes) for i in of_source if images[i].stripes]
        seems_several = float(np.median(counts)) >= LEAST_SEVERAL
        if not (options.n_sheets > 1 if options.n_sheets else seems_several):
            for i in of_source:
                longest = _longest_only(images[i])
                sheets[i] = tuple(len(names) if k == 0 else -1 for k in longest)
            names.append(source)
            continue
        stripes, numbers = [images[i].stripes for i in of_source], [boards[i] for i in of_source]
        fan = number_fan(stripes, numbers, options.n_sheets)
        if isinstance(fan, FitFailure):
            return FitFailure(f"source {source}: {fan.reason}", fan.remedy)
        for i, row in zip(of_source, fan.sheets, strict=True):
            sheets[i] = tuple(len(names) + k if k >= 0 else -1 for k in row)
        names += [f"{source}.{number}" for number in fan.numbers]
        how.append(f"source {source}: {fan.how}")
        warnings += [f"source {source}: {warning}" for warning in fan.warnings]
    is_fan = len(names) > len(sources)
    if options.sheet_names:
        if len(options.sheet_names) != len(names):
            return FitFailure(
                f"{len(names)} sheets were found ({', '.join(names)}), but "
                f"{len(options.sheet_names)} names are given",
                "give one name a sheet, or none",
            )
        names = list(options.sheet_names)
    return SheetAssignment(tuple(names), tuple(sheets), "; ".join(how), tuple(warnings), is_fan)


def board_numbers(images: Sequence[BoardImage]) -> list[int]:
    """Number of each image's board placement, counted from 0."""
    places = [image.data.place for image in images]
    order = list(dict.fromkeys(places))
    return [order.index(place) for place in places]


def _longest_only(image: BoardImage) -> tuple[int, ...]:
    """Sheet 0 for the stripe with the most points, none for the others."""
    counts = [len(stripe.rows) for stripe in image.stripes]
    best = int(np.argmax(counts)) if counts else -1
    return tuple(0 if k == best else -1 for k in range(len(counts)))


def _by_coplanarity(stripes: Stripes, names: tuple[str, ...]) -> SheetAssignment | FitFailure:
    n_sheets = len(names)
    if sum(len(shown) >= n_sheets for shown in stripes) < 2:
        return FitFailure(
            f"{n_sheets} sheets were looked for, but fewer than two images show {n_sheets} "
            "straight stripes on the board",
            "show every line on the board in at least two placements, or switch on one laser "
            "an image and name it",
        )
    found: dict[Labels, tuple[float, int]] = {}
    for seed in _seeds(stripes, n_sheets):
        labels, planes = _grown(stripes, seed, n_sheets)
        if planes:
            fit = sum(p.chi2 for p in planes), sum(p.degrees_of_freedom for p in planes)
            found.setdefault(_renumbered(labels, n_sheets), fit)
    by_order = _renumbered(_order_labels(stripes, n_sheets), n_sheets)
    if not found:
        return SheetAssignment(names, by_order, "by the order across the image")
    ranked = sorted(found, key=lambda labels: found[labels][0])
    best, (chi2, freedom) = ranked[0], found[ranked[0]]
    scale = max(1.0, chi2 / max(freedom, 1))
    alternatives = [
        labels for labels in ranked[1:] if (found[labels][0] - chi2) / scale < AMBIGUOUS_CHI2
    ]
    if not alternatives:
        margin = ""
        if len(ranked) > 1:
            worse = found[ranked[1]][0] - chi2
            text = f"{worse:.3g}" if worse < CLEAR_CHI2 else f"more than {CLEAR_CHI2:,}"
            margin = f"; the next naming is worse by chi2 {text}"
        how = f"by coplanarity over the boards (chi2 {chi2:.3g}{margin})"
        return SheetAssignment(names, best, how)
    is_by_order = by_order in (best, *alternatives)
    how = "by the order across the image" if is_by_order else "by the least chi2 of coplanarity"
    warning = (
        f"{len(alternatives) + 1} ways to name the stripes fit about equally well, because stripes "
        f"that are nearly parallel are coplanar in any pairing; named {how}: photograph one laser "
        "at a time to be sure"
    )
    return SheetAssignment(names, by_order if is_by_order else best, how, (warning,))


def _seeds(stripes: Stripes, n_sheets: int) -> list[Labels]:
    """Assignments of two images each; the other images are still unassigned."""

    def twist(pair: tuple[int, int]) -> float:
        """Sine of the angle between the first stripes of two images."""
        u, v = (stripes[i][0].ends_mm[1] - stripes[i][0].ends_mm[0] for i in pair)
        return float(np.linalg.norm(np.cross(u, v)) / (np.linalg.norm(u) * np.linalg.norm(v)))

    full = [i for i, shown in enumerate(stripes) if len(shown) >= n_sheets]
    pairs = sorted(itertools.combinations(full, 2), key=lambda pair: -twist(pair))[:MAX_SEEDS]
    seeds = [_order_labels(stripes, n_sheets)]
    for pair in pairs:
        for matches in _pairings(stripes[pair[0]], stripes[pair[1]], n_sheets):
            labels = [[-1] * len(shown) for shown in stripes]
            for sheet, match in enumerate(matches):
                for i, k in zip(pair, match, strict=True):
                    labels[i][k] = sheet
            seeds.append(tuple(map(tuple, labels)))
    return seeds


def _pairings(
    first: Sequence[StripeObservation], second: Sequence[StripeObservation], n_sheets: int
) -> list[list[tuple[int, int]]]:
    """All pairings of few stripes, or the best one by Hungarian assignment of many."""
    if len(first) == len(second) == n_sheets <= 3:
        return [list(enumerate(order)) for order in itertools.permutations(range(n_sheets))]
    planes = [[fit_common_plane([a, b]) for b in second] for a in first]
    cost = np.array([[NO_PLANE if isinstance(p, FitFailure) else p.chi2 for p in row]
                     for row in planes])  # fmt: skip
    rows, columns = linear_sum_assignment(np.minimum(cost, NO_PLANE))
    chosen = sorted(zip(rows, columns, strict=True), key=lambda rc: float(cost[rc]))[:n_sheets]
    return [sorted((int(r), int(c)) for r, c in chosen)]


def _grown(stripes: Stripes, labels: Labels, n_sheets: int) -> tuple[Labels, list[CommonPlane]]:
    """Assign the other images by the planes of those assigned, until nothing changes.

    With the planes of the sheets; none where a sheet has no plane.
    """
    for _ in range(GROWTH_ROUNDS):
        planes = _planes(stripes, labels, n_sheets)
        if not planes:
            return labels, []
        again = tuple(_nearest_planes(shown, planes) for shown in stripes)
        if again == labels:
            break
        labels = again
    return labels, _planes(stripes, labels, n_sheets)


def _planes(stripes: Stripes, labels: Labels, n_sheets: int) -> list[CommonPlane]:
    """Common plane of each sheet's stripes; empty if one has none."""
    planes = []
    for sheet in range(n_sheets):
        members = [
            stripe
            for shown, sheets in zip(stripes, labels, strict=True)
            for stripe, of in zip(shown, sheets, strict=True)
            if of == sheet
        ]
        plane = fit_common_plane(members) if len(members) >= 2 else None
        if plane is None or isinstance(plane, FitFailure):
            return []
        planes.append(plane)
    return planes


def _nearest_planes(
    stripes: Sequence[StripeObservation], planes: Sequence[CommonPlane]
) -> tuple[int, ...]:
    """Sheet of each stripe of one image, every sheet at most once."""
    if not stripes:
        return ()
    cost = np.zeros((len(stripes), len(planes)))
    for k, stripe in enumerate(stripes):
        for sheet, common in enumerate(planes):
            height = common.plane.distance_mm(stripe.ends_mm)
            covariance = stripe.height_covariance_mm2(common.plane.normal)
            cost[k, sheet] = height @ np.linalg.solve(covariance, height)
    rows, columns = linear_sum_assignment(np.minimum(cost, 1e9))
    of_stripe = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    return tuple(of_stripe.get(k, -1) for k in range(len(stripes)))


def _order_labels(stripes: Stripes, n_sheets: int) -> Labels:
    """Sheets by the order across the image; images with another count stay unassigned."""
    return tuple(
        tuple(range(n_sheets)) if len(shown) == n_sheets else tuple(-1 for _ in shown)
        for shown in stripes
    )


def _renumbered(labels: Labels, n_sheets: int) -> Labels:
    """Number the sheets by the order in which they appear across the images."""
    order: dict[int, int] = {-1: -1}
    for sheet in (*itertools.chain.from_iterable(labels), *range(n_sheets)):
        order.setdefault(sheet, len(order) - 1)
    return tuple(tuple(order[sheet] for sheet in sheets) for sheets in labels)
