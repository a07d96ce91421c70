# SPDX-License-Identifier: Apache-2.0
"""Assignment of stripes to sheets by the lasers that were on and by common planes."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from armscan.calibration.sheets.coplanarity import CommonPlane, PosedObservation, fit_common_plane
from armscan.calibration.sheets.fan import number_fan
from armscan.calibration.sheets.result import SheetOptions
from armscan.calibration.sheets.stripes_on_board import BoardImage
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

AMBIGUOUS_CHI2 = 9.0
"""A naming must beat the next one by this much (three sigma) to be told from it by coplanarity."""
MAX_SEEDS = 12
LEAST_FAN = 4
"""Lines in an image from which on they are taken for a fan of which others may be out of view."""
LEAST_SEVERAL = 3
"""Lines in most images of one source from which on it is taken to make several: two may be one
line and its reflection."""
ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"

Naming = tuple[tuple[int, ...], ...]
"""For each image, the sheet of each of its sightings; -1 for none."""


@dataclass(frozen=True, slots=True)
class SheetAssignment:
    """Sheets of all stripes.

    Parameters
    ----------
    names
        Of the sheets.
    sheets
        ``sheets[i][k]`` is the sheet of sighting k of image i, -1 for none.
    how
        In words.
    warnings
        What is doubtful.
    is_fan
        True where lines of a fan were found among others: one that cannot be calibrated may then be
        left out.
    """

    names: tuple[str, ...]
    sheets: Naming
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


def name_stripes(
    images: Sequence[BoardImage], camera_covariance: FloatArray, options: SheetOptions
) -> SheetAssignment | FitFailure:
    """Give every straight stripe to a sheet, without the operator where that is possible.

    The caller's word comes first (one laser an image). The lines of a source that makes several
    are numbered along their fan (`armscan.calibration.sheets.fan`), though no image shows
    them all. Otherwise stripes that belong together are coplanar: namings grown from pairs of
    images are compared by the chi-square of all stripes' common planes. Where coplanarity cannot
    tell (parallel stripes), the order across the image decides and a warning says so.
    """
    lasers = {image.data.lasers for image in images if image.sightings}
    posed = [
        [PosedObservation(s, image.placed.covariance, camera_covariance) for s in image.sightings]
        for image in images
    ]
    if lasers and all(len(names) == 1 for names in lasers):
        return _by_caller(images, posed, options)
    n_sheets = _count_sheets(images, options, lasers)
    if not any(len(names) > 1 for names in lasers) and _is_fan(images, n_sheets):
        return _one_fan(images, posed, options)
    names = _sheet_names(n_sheets, options, lasers)
    if isinstance(names, FitFailure):
        return names
    if n_sheets == 1:
        sheets = tuple(_longest_only(image) for image in images)
        return SheetAssignment(names, sheets, "one stripe an image, hence one sheet")
    if sum(len(image.sightings) >= n_sheets for image in images) < 2:
        return FitFailure(
            f"{n_sheets} sheets were looked for, but fewer than two images show {n_sheets} "
            "straight stripes on the board",
            "show every line on the board in at least two placements, or switch on one laser "
            "an image and name it",
        )
    return _by_coplanarity(posed, names)


def _count_sheets(
    images: Sequence[BoardImage], options: SheetOptions, lasers: set[tuple[str, ...]]
) -> int:
    wanted = options.n_sheets or len(options.sheet_names)
    if wanted:
        return wanted
    if len(lasers) == 1 and next(iter(lasers)):
        return len(next(iter(lasers)))
    counts = Counter(len(image.sightings) for image in images if image.sightings)
    return max(counts, key=lambda n: (counts[n], n)) if counts else 0


def _sheet_names(
    n_sheets: int, options: SheetOptions, lasers: set[tuple[str, ...]]
) -> tuple[str, ...] | FitFailure:
    names = options.sheet_names
    if not names and len(lasers) == 1:
        names = next(iter(lasers))
    if len(lasers) > 1:
        return FitFailure(
            "some images name several lasers, others different ones: "
            + "; ".join(", ".join(group) or "none" for group in sorted(lasers)),
            "switch on one laser an image, or all of them in every image",
        )
    names = names or tuple(ALPHABET[:n_sheets] or ("A",))
    if len(names) < n_sheets:
        return FitFailure(
            f"{n_sheets} stripes an image but {len(names)} names", "give one name a sheet"
        )
    return names


def _is_fan(images: Sequence[BoardImage], n_sheets: int) -> bool:
    """Many lines, of which no image need show all."""
    largest = max((len(image.sightings) for image in images), default=0)
    return max(n_sheets, largest) >= LEAST_FAN


def _one_fan(
    images: Sequence[BoardImage], posed: list[list[PosedObservation]], options: SheetOptions
) -> SheetAssignment | FitFailure:
    """All stripes are lines of one source that has no name."""
    n_sheets = options.n_sheets or len(options.sheet_names)
    fan = number_fan(posed, board_numbers(images), n_sheets)
    if isinstance(fan, FitFailure):
        return fan
    pool = options.sheet_names or tuple(ALPHABET)
    if fan.numbers[-1] > len(pool):
        return FitFailure(f"{fan.numbers[-1]} lines but {len(pool)} names", "give one name a line")
    names = tuple(pool[number - 1] for number in fan.numbers)
    return SheetAssignment(names, fan.sheets, fan.how, fan.warnings, is_fan=True)


def _by_caller(
    images: Sequence[BoardImage], posed: list[list[PosedObservation]], options: SheetOptions
) -> SheetAssignment | FitFailure:
    """One source an image; the lines of a source that makes several are numbered."""
    sources = tuple(dict.fromkeys(image.data.lasers[0] for image in images if image.sightings))
    boards = board_numbers(images)
    names: list[str] = []
    sheets: list[tuple[int, ...]] = [tuple(-1 for _ in image.sightings) for image in images]
    how, warnings = ["one laser an image, as named by the caller"], list[str]()
    for source in sources:
        own = [i for i, image in enumerate(images) if image.data.lasers[:1] == (source,)]
        if not _has_several([images[i] for i in own], options):
            for i in own:
                sheets[i] = tuple(len(names) if k == 0 else -1 for k in _longest_only(images[i]))
            names.append(source)
            continue
        fan = number_fan([posed[i] for i in own], [boards[i] for i in own], options.n_sheets)
        if isinstance(fan, FitFailure):
            return FitFailure(f"source {source}: {fan.reason}", fan.remedy)
        for i, row in zip(own, fan.sheets, strict=True):
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


def _has_several(images: Sequence[BoardImage], options: SheetOptions) -> bool:
    """Does a source make several lines? As told, or as most of its images show."""
    if options.n_sheets:
        return options.n_sheets > 1
    counts = [len(image.sightings) for image in images if image.sightings]
    return float(np.median(counts)) >= LEAST_SEVERAL


def board_numbers(images: Sequence[BoardImage]) -> list[int]:
    """Number of each image's board placement, counted from 0."""
    places = [image.data.place for image in images]
    order = list(dict.fromkeys(places))
    return [order.index(place) for place in places]


def _longest_only(image: BoardImage) -> tuple[int, ...]:
    """Sheet 0 for the stripe with the most points, none for the others."""
    counts = [len(s.rows) for s in image.sightings]
    best = int(np.argmax(counts)) if counts else -1
    return tuple(0 if k == best else -1 for k in range(len(counts)))


@dataclass(frozen=True, slots=True)
class _Candidate:
    naming: Naming
    chi2: float
    degrees_of_freedom: int


def _by_coplanarity(posed: list[list[PosedObservation]], names: tuple[str, ...]) -> SheetAssignment:
    n_sheets = len(names)
    found: dict[Naming, _Candidate] = {}
    for naming in _seeds(posed, n_sheets):
        candidate = _grow(posed, naming, n_sheets)
        if candidate is not None:
            found.setdefault(_relabelled(candidate.naming, n_sheets), candidate)
    by_order = _relabelled(_order_naming(posed, n_sheets), n_sheets)
    ranked = sorted(found, key=lambda naming: found[naming].chi2)
    best = ranked[0] if ranked else by_order
    if not ranked:
        return SheetAssignment(names, by_order, "by the order across the image")
    scale = max(1.0, found[best].chi2 / max(found[best].degrees_of_freedom, 1))
    rivals = [
        naming
        for naming in ranked[1:]
        if (found[naming].chi2 - found[best].chi2) / scale < AMBIGUOUS_CHI2
    ]
    if not rivals:
        margin = (
            f"; the next naming is worse by chi2 {found[ranked[1]].chi2 - found[best].chi2:.3g}"
            if len(ranked) > 1
            else ""
        )
        how = f"by coplanarity over the boards (chi2 {found[best].chi2:.3g}{margin})"
        return SheetAssignment(names, best, how)
    is_by_order = by_order in (best, *rivals)
    how = "by the order across the image" if is_by_order else "by the least chi2 of coplanarity"
    warning = (
        f"{len(rivals) + 1} ways to name the stripes fit about equally well, because stripes that "
        f"are nearly parallel are coplanar in any pairing; named {how}: photograph one laser at a "
        "time to be sure"
    )
    return SheetAssignment(names, by_order if is_by_order else best, how, (warning,))


def _seeds(posed: list[list[PosedObservation]], n_sheets: int) -> list[Naming]:
    """Namings of two images each; the other images are still unnamed."""
    full = [i for i, stripes in enumerate(posed) if len(stripes) >= n_sheets]
    pairs = sorted(itertools.combinations(full, 2), key=lambda p: -_turn(posed, *p))[:MAX_SEEDS]
    seeds: list[Naming] = [_order_naming(posed, n_sheets)]
    for a, b in pairs:
        for assignment in _pairings(posed[a], posed[b], n_sheets):
            naming: list[tuple[int, ...]] = [tuple(-1 for _ in stripes) for stripes in posed]
            sheet_a = {k: sheet for sheet, (k, _) in enumerate(assignment)}
            sheet_b = {k: sheet for sheet, (_, k) in enumerate(assignment)}
            naming[a] = tuple(sheet_a.get(k, -1) for k in range(len(posed[a])))
            naming[b] = tuple(sheet_b.get(k, -1) for k in range(len(posed[b])))
            seeds.append(tuple(naming))
    return seeds


def _turn(posed: list[list[PosedObservation]], a: int, b: int) -> float:
    """Sine of the angle between the longest stripes of two images: how well twist shows."""
    u, v = (posed[i][0].sighting.ends_mm[1] - posed[i][0].sighting.ends_mm[0] for i in (a, b))
    return float(np.linalg.norm(np.cross(u, v)) / (np.linalg.norm(u) * np.linalg.norm(v)))


def _pairings(
    first: list[PosedObservation], second: list[PosedObservation], n_sheets: int
) -> list[list[tuple[int, int]]]:
    """All pairings of few stripes, or the best one by Hungarian assignment of many."""
    if len(first) == len(second) == n_sheets <= 3:
        orders = itertools.permutations(range(n_sheets))
        return [list(enumerate(order)) for order in orders]
    cost = np.array([[_pair_chi2(a, b) for b in second] for a in first])
    rows, columns = linear_sum_assignment(np.minimum(cost, 1e6))
    chosen = sorted(zip(rows, columns, strict=True), key=lambda rc: float(cost[rc]))[:n_sheets]
    return [sorted((int(r), int(c)) for r, c in chosen)]


def _pair_chi2(a: PosedObservation, b: PosedObservation) -> float:
    plane = fit_common_plane([a, b])
    return 1e6 if isinstance(plane, FitFailure) else plane.chi2


def _grow(posed: list[list[PosedObservation]], naming: Naming, n_sheets: int) -> _Candidate | None:
    """Name the other images by the planes of those named, until nothing changes."""
    for _ in range(6):
        planes = _planes(posed, naming, n_sheets)
        if planes is None:
            return None
        renamed = tuple(_assign(stripes, planes) for stripes in posed)
        if renamed == naming:
            break
        naming = renamed
    planes = _planes(posed, naming, n_sheets)
    if planes is None:
        return None
    return _Candidate(
        naming, sum(p.chi2 for p in planes), sum(p.degrees_of_freedom for p in planes)
    )


def _planes(
    posed: list[list[PosedObservation]], naming: Naming, n_sheets: int
) -> list[CommonPlane] | None:
    planes = []
    for sheet in range(n_sheets):
        members = [
            stripe
            for stripes, sheets in zip(posed, naming, strict=True)
            for stripe, own in zip(stripes, sheets, strict=True)
            if own == sheet
        ]
        plane = fit_common_plane(members) if len(members) >= 2 else None
        if plane is None or isinstance(plane, FitFailure):
            return None
        planes.append(plane)
    return planes


def _assign(stripes: list[PosedObservation], planes: list[CommonPlane]) -> tuple[int, ...]:
    if not stripes:
        return ()
    cost = np.array([[_misfit(stripe, plane) for plane in planes] for stripe in stripes])
    rows, columns = linear_sum_assignment(np.minimum(cost, 1e9))
    sheets = [-1] * len(stripes)
    for row, column in zip(rows, columns, strict=True):
        sheets[int(row)] = int(column)
    return tuple(sheets)


def _misfit(stripe: PosedObservation, plane: CommonPlane) -> float:
    height: FloatArray = plane.plane.distance_mm(stripe.sighting.ends_mm)
    covariance = stripe.height_covariance_mm2(plane.plane.normal)
    return float(height @ np.linalg.solve(covariance, height))


def _order_naming(posed: list[list[PosedObservation]], n_sheets: int) -> Naming:
    """Sheets by the order across the image; images with another count stay unnamed."""
    return tuple(
        tuple(range(n_sheets)) if len(stripes) == n_sheets else tuple(-1 for _ in stripes)
        for stripes in posed
    )


def _relabelled(naming: Naming, n_sheets: int) -> Naming:
    """Number the sheets by the order in which they appear across the images."""
    order: dict[int, int] = {}
    for sheet in itertools.chain.from_iterable(naming):
        if sheet >= 0:
            order.setdefault(sheet, len(order))
    for sheet in range(n_sheets):
        order.setdefault(sheet, len(order))
    return tuple(tuple(order.get(s, -1) for s in sheets) for sheets in naming)
