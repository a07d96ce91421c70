# SPDX-License-Identifier: Apache-2.0
"""Photographs with what was found in them: target points, stripes, or nothing and why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_
from typing import TypeVar

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.calibration import Provenance
from armscan.reconstruction.labels import LabelledProfile, PointStatus, StripeCounts
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile, StripeFlag
from armscan.report.drawing import Marks, photo_markup
from armscan.report.page import Block, Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, plural, without_source
from armscan.vision.targets.target import TargetView

T = TypeVar("T")

MAX_PICTURES = 24
MAX_TRIED = 60
TARGET_COLOUR, LEFT_OUT_COLOUR, STRIPE_COLOUR = "#35e0c0", "#ff8a4c", "#ff5a4f"
ARROW_COLOUR = "#ffb000"
SHEET_COLOURS = (
    "#2fe6c3", "#5aa9ff", "#c58bff", "#a6e22e", "#ffc2f2", "#8fd3ff",
    "#ffb35c", "#4dd0e1", "#f48fb1", "#dce775", "#b39ddb", "#80cbc4",
)  # fmt: skip
"""Bright colours of the sheets on photographs, in order, then repeated."""
FLAG_COLOURS = {
    StripeFlag.BACKGROUND_STEP: ("#ff9f1c", "flagged: background step"),
    StripeFlag.ASYMMETRIC: ("#ff5a4f", "flagged: lopsided profile"),
    StripeFlag.NEIGHBOUR: ("#e0559b", "flagged: neighbour line"),
    StripeFlag.OUTLIER: ("#ffe14d", "flagged: off the line's course"),
    StripeFlag.SHORT_SEGMENT: ("#b58863", "flagged: too short a piece"),
    StripeFlag.END: ("#f4f1de", "flagged: cut off at a slant"),
    StripeFlag.TARGET_EDGE: ("#8d7bff", "flagged: along an edge of the target"),
}
STATUS_COLOURS = {
    PointStatus.NO_RAY: "#8a6d5a",
    PointStatus.OUT_OF_DEPTH: "#ff7a3c",
    PointStatus.AMBIGUOUS: "#ffd23f",
    PointStatus.STRAY: "#ff4d6d",
    PointStatus.SHARED: "#7f8c99",
    PointStatus.INCONSISTENT: "#d65db1",
}
OUTLINE, OUTLINE_EDGE = "#ffffff", "#1d2733"
DOT_SIZE = 4.2


@dataclass(frozen=True, slots=True, eq=False)
class TriedImage:
    """What was found in one image of a run that ended without a document.

    Parameters
    ----------
    is_used
        False if it gave nothing.
    target_px
        (M, 2) target points found, in full-sensor pixels; None for none.
    stripe_px
        (N, 2) stripe points found; None where none were looked for.
    """

    source: str
    remark: str
    is_used: bool
    target_px: FloatArray | None = None
    stripe_px: FloatArray | None = None


def tried_targets(
    views: Sequence[TargetView], not_found: Sequence[tuple[str, str]], order: Sequence[str]
) -> tuple[TriedImage, ...]:
    """Images in which a target was looked for, in the order of their sources."""
    tried = [
        TriedImage(view.source, f"{len(view)} target points", True, view.points_px)
        for view in views
    ]
    tried += [
        TriedImage(source, without_source(source, reason), False) for source, reason in not_found
    ]
    place = {source: k for k, source in enumerate(order)}
    return tuple(sorted(tried, key=lambda image: place[image.source]))


def refused_page(
    title: str,
    images: Sequence[TriedImage],
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    warnings: Sequence[str] = (),
    is_simulated: bool,
) -> Page:
    """Lay out the page of a run that found no result; ``exposures`` by source name."""
    n_used = sum(image.is_used for image in images)
    return page_of(
        replace(provenance, document_id="none was written"),
        title,
        f"{n_used} of {len(images)} images gave something to work with" if images else "",
        (_tried_section(images, exposures),) if images else (),
        warnings=warnings,
        is_simulated=is_simulated,
    )


def _tried_section(images: Sequence[TriedImage], exposures: Mapping[str, Exposure]) -> Section:
    rows = tuple((image.source, image.remark) for image in images)
    table = Table(("image", "what it gave"), rows, "", (1,))
    failed_first = sorted(images, key=lambda image: image.is_used)
    shown = [image for image in failed_first if image.source in exposures][:MAX_TRIED]
    if not shown:
        return Section("The images", (table,))
    kinds = (
        (TARGET_COLOUR, "target point, the filled one is the first", [i.target_px for i in images]),
        (STRIPE_COLOUR, "stripe point", [i.stripe_px for i in images]),
    )
    colours = tuple(
        (colour, word)
        for colour, word, points in kinds
        if any(one is not None and len(one) for one in points)
    )
    text = "Images that gave nothing come first. Click a picture to enlarge it."
    if len(shown) < len(images):
        text += f" {len(shown)} of {len(images)} images are shown."
    pictures = tuple(_tried_picture(image, exposures[image.source]) for image in shown)
    return Section("The images", (table, Text(text), Legend(colours), Gallery(pictures, 300)))


def _tried_picture(image: TriedImage, exposure: Exposure) -> Picture:
    marks = [] if image.target_px is None else target_marks(image.target_px)
    if image.stripe_px is not None:
        marks.append(Marks(image.stripe_px, STRIPE_COLOUR))
    alt = f"What was found in {image.source}"
    is_grey = image.stripe_px is not None
    markup = photo_markup(exposure, marks, alt, longest_px=700, is_grey=is_grey)
    return Picture(markup, image.remark, image.source)


def nothing_found_section(
    title: str, reasons: Sequence[tuple[str, str]], exposures: Mapping[str, Exposure]
) -> Section:
    """Images that gave nothing, (source, reason), with their photographs where there are some."""
    told = [(source, without_source(source, reason)) for source, reason in reasons]
    pictures = tuple(
        Picture(photo_markup(exposures[source], (), source, longest_px=500), reason, source)
        for source, reason in told
        if source in exposures
    )
    return Section(title, (Table(("image", "why"), tuple(told), "", (1,)), Gallery(pictures, 240)))


def target_marks(
    points_px: FloatArray, colour: str = TARGET_COLOUR, arrows_px: FloatArray | None = None
) -> list[Marks]:
    """Rings about (N, 2) target points, the first one filled, with (N, 2) arrows if given."""
    marks = [Marks(points_px, colour, "ring", 15.0), Marks(points_px[:1], colour, "dot", 13.0)]
    if arrows_px is not None:
        ends = np.stack([points_px, points_px + arrows_px], axis=1).reshape(-1, 2)
        marks.append(Marks(ends, ARROW_COLOUR, "line", 3.2))
    return marks


def stripe_gallery(
    images: Sequence[LabelledProfile],
    sheet_names: Sequence[str],
    exposures: Mapping[str, Exposure],
    counts: Sequence[StripeCounts] = (),
) -> tuple[Block, ...]:
    """Text, legend and pictures of every stripe point, coloured by what became of it.

    ``images``: stripe points of all exposures, or of some. ``exposures``: images by source name;
    those that are missing are not shown. ``counts``: of all exposures; empty if ``images`` are all.
    """
    counts = counts or [image.counts for image in images]
    seen = {status for status in STATUS_COLOURS if any(one.count(status) for one in counts)}
    statuses = [(STATUS_COLOURS[status], status.label) for status in PointStatus if status in seen]
    flags = reduce(or_, (one.rejecting_flags for one in counts), 0)
    shown = evenly_chosen([image for image in images if image.profile.source in exposures])
    pictures = tuple(
        stripe_picture(
            exposures[image.profile.source],
            image.profile,
            image.status,
            image.sheet,
            {int(status): colour for status, colour in STATUS_COLOURS.items()},
            caption=f"{image.count(PointStatus.MEASURED)} of {len(image.profile)} points measured",
        )
        for image in shown
    )
    text = "Every stripe point, measured or not. Dark photographs are brightened here."
    if len(shown) < len(counts):
        text += f" {len(shown)} of {len(counts)} images are shown, evenly chosen."
    return Text(text), stripe_legend(sheet_names, statuses, flags), Gallery(pictures, 420)


def stripe_page(
    profiles: Sequence[Profile],
    exposures: Mapping[str, Exposure],
    warnings: Sequence[str],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of the stripes of photographs, each found by itself.

    ``exposures``: those that are shown, by source name.
    """
    pictures = []
    for profile in profiles:
        if profile.source in exposures:
            status = (~profile.is_accepted).astype(np.int64)
            caption = f"{(status == 0).sum()} of {len(profile)} points accepted"
            sheet = np.zeros(len(profile), np.int64)
            exposure = exposures[profile.source]
            pictures.append(stripe_picture(exposure, profile, status, sheet, {}, caption=caption))
    flags = flags_of((profile, (~profile.is_accepted).astype(np.int64)) for profile in profiles)
    accepted = ((sheet_colour(0), "accepted"),)
    text = "Every stripe point found, each photograph by itself. Dark ones are brightened here."
    if len(pictures) < len(profiles):
        text += f" {len(pictures)} of {len(profiles)} images are shown, evenly chosen."
    return page_of(
        provenance,
        "Laser stripes",
        plural(len(profiles), "image"),
        (
            Section(
                "Stripes in the images",
                (Text(text), stripe_legend((), accepted, flags), Gallery(tuple(pictures), 420)),
            ),
            Section("Every image", (stripe_table(profiles),)),
        ),
        cards=stripe_quantities(profiles),
        warnings=warnings,
        is_simulated=is_simulated,
    )


def stripe_quantities(profiles: Sequence[Profile]) -> tuple[Quantity, ...]:
    """What is told of the stripes of photographs."""
    good = [profile.select(profile.is_accepted) for profile in profiles]
    n_points = sum(map(len, good))
    flagged = plural(sum(map(len, profiles)) - n_points, "flagged point") + " beside them"
    sigma_px, width_px = (
        float(np.median(np.concatenate(values))) if n_points else float("nan")
        for values in ([one.sigma_px for one in good], [one.width_px for one in good])
    )
    n_shown = sum(len(one) > 0 for one in good)
    told = "along its normal, median"
    return (
        Quantity("n_images", "Images with a line", n_shown, meaning=f"of {len(profiles)}"),
        Quantity("n_points", "Points accepted", n_points, meaning=flagged),
        Quantity("sigma_px", "Sigma of a centre", sigma_px, unit="px", meaning=told),
        Quantity(
            "width_px", "Sigma of the stripe", width_px, unit="px", meaning="across it, median"
        ),
    )


def stripe_table(profiles: Sequence[Profile]) -> Table:
    """Counts of points of each photograph, and what the others were flagged for."""
    rows = []
    for profile in profiles:
        rejected = profile.flags[~profile.is_accepted]
        said = []
        for flag, (_, label) in FLAG_COLOURS.items():
            if n := int(((rejected & int(flag)) != 0).sum()):
                said.append(f"{n} {label.removeprefix('flagged: ')}")
        n_good = len(profile) - len(rejected)
        rows.append((profile.source, str(n_good), str(len(rejected)), ", ".join(said)))
    return Table(
        ("image", "accepted", "flagged", "flagged for (one or more each)"), tuple(rows), "", (3,)
    )


def stripe_picture(
    exposure: Exposure,
    profile: Profile,
    status: IntArray,
    sheet: IntArray,
    status_colours: Mapping[int, str],
    *,
    outline_px: FloatArray | None = None,
    caption: str = "",
) -> Picture:
    """A photograph with its stripe points.

    ``status``: (N,) what became of each point: 0 good, 1 flagged, other values as
    ``status_colours``. ``sheet``: (N,) index of the sheet of good points; -1 for none.
    ``status_colours``: colour of each status above 1. ``outline_px``: (M, 2) points of the target,
    whose outline is drawn; None for no target.
    """
    points = profile.points_px
    marks = [] if outline_px is None else _outline(outline_px)
    for value, colour in status_colours.items():
        marks.append(Marks(points[status == value], colour, "dot", DOT_SIZE))
    is_open = status == 1
    for flag, (colour, _) in FLAG_COLOURS.items():
        chosen = is_open & ((profile.flags & int(flag)) != 0)
        marks.append(Marks(points[chosen], colour, "dot", DOT_SIZE))
        is_open &= ~chosen
    for index in range(int(sheet.max(initial=0)) + 1):
        chosen = (status == 0) & (np.maximum(sheet, 0) == index)
        marks.append(Marks(points[chosen], sheet_colour(index), "dot", DOT_SIZE))
    markup = photo_markup(
        exposure, marks, f"Stripe points of {profile.source}", longest_px=1200, is_grey=True
    )
    return Picture(markup, caption, profile.source)


def stripe_legend(
    sheet_names: Sequence[str], statuses: Iterable[tuple[str, str]], flags: int
) -> Legend:
    """Colours with their meaning: sheets, statuses (colour, label), flags that occur."""
    sheets = [(sheet_colour(k), f"sheet {name}") for k, name in enumerate(sheet_names)]
    flagged = [entry for flag, entry in FLAG_COLOURS.items() if flags & int(flag)]
    return Legend((*sheets, *statuses, *flagged))


def flags_of(profiles: Iterable[tuple[Profile, IntArray]]) -> int:
    """All flags of the points whose status is 1, flagged."""
    flags = 0
    for profile, status in profiles:
        flags |= int(np.bitwise_or.reduce(profile.flags[status == 1], initial=0))
    return flags


def sheet_colour(index: int) -> str:
    """Colour of a sheet on photographs."""
    return SHEET_COLOURS[index % len(SHEET_COLOURS)]


def evenly_chosen(items: Sequence[T], most: int = MAX_PICTURES) -> list[T]:
    """At most ``most`` of the items, evenly chosen."""
    if len(items) <= most:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, most).astype(int)]


def _outline(points_px: FloatArray) -> list[Marks]:
    """A white line on a dark one, seen on bright and dark boards."""
    hull = cv2.convexHull(points_px.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    ends = np.stack([hull, np.roll(hull, -1, axis=0)], axis=1).reshape(-1, 2)
    return [Marks(ends, OUTLINE_EDGE, "line", 3.2), Marks(ends, OUTLINE, "line", 1.4)]
