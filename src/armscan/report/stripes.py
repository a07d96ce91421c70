# SPDX-License-Identifier: Apache-2.0
"""Photographs with the stripes that were found in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.reconstruction.labels import LabelledProfile, PointStatus
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile, StripeFlag
from armscan.report.drawing import Marks, photo_markup
from armscan.report.page import Block, Gallery, Legend, Picture, Text

T = TypeVar("T")

MAX_PICTURES = 24
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
OUTLINE, OUTLINE_EDGE = "#ffffff", "#1d2733"
DOT_SIZE = 4.2


def sheet_colour(index: int) -> str:
    """Colour of a sheet on photographs."""
    return SHEET_COLOURS[index % len(SHEET_COLOURS)]


def stripe_picture(
    exposure: Exposure,
    profile: Profile,
    fate: IntArray,
    sheet: IntArray,
    fate_colours: Mapping[int, str],
    *,
    outline_px: FloatArray | None = None,
    caption: str = "",
) -> Picture:
    """A photograph with its stripe points.

    Parameters
    ----------
    exposure, profile
        The image and all its stripe points.
    fate
        (N,) what became of each point: 0 good, 1 flagged, other values as ``fate_colours``.
    sheet
        (N,) index of the sheet of good points; -1 for none.
    fate_colours
        Colour of each fate above 1.
    outline_px
        (M, 2) points of the target, whose outline is drawn; None for no target.
    caption
        Text below.
    """
    points = profile.points_px
    marks = [] if outline_px is None else _outline(outline_px)
    for value, colour in fate_colours.items():
        marks.append(Marks(points[fate == value], colour, "dot", DOT_SIZE))
    is_open = fate == 1
    for flag, (colour, _) in FLAG_COLOURS.items():
        chosen = is_open & ((profile.flags & int(flag)) != 0)
        marks.append(Marks(points[chosen], colour, "dot", DOT_SIZE))
        is_open &= ~chosen
    for index in range(int(sheet.max(initial=0)) + 1):
        chosen = (fate == 0) & (np.maximum(sheet, 0) == index)
        marks.append(Marks(points[chosen], sheet_colour(index), "dot", DOT_SIZE))
    markup = photo_markup(
        exposure, marks, f"Stripe points of {profile.source}", longest_px=1200, is_grey=True
    )
    return Picture(markup, caption, profile.source)


def evenly_chosen(items: Sequence[T], most: int = MAX_PICTURES) -> list[T]:
    """At most ``most`` of the items, evenly chosen."""
    if len(items) <= most:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, most).astype(int)]


def stripe_legend(
    sheet_names: Sequence[str], fates: Mapping[int, tuple[str, str]], flags_seen: int
) -> tuple[tuple[str, str], ...]:
    """Colours with their meaning: sheets, then fates, then the flags that occur."""
    sheets = [(sheet_colour(k), f"sheet {name}") for k, name in enumerate(sheet_names)]
    flags = [entry for flag, entry in FLAG_COLOURS.items() if flags_seen & int(flag)]
    return (*sheets, *fates.values(), *flags)


def _outline(points_px: FloatArray) -> list[Marks]:
    """A white line on a dark one, seen on bright and dark boards."""
    hull = cv2.convexHull(points_px.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    ends = np.stack([hull, np.roll(hull, -1, axis=0)], axis=1).reshape(-1, 2)
    return [Marks(ends, OUTLINE_EDGE, "line", 3.2), Marks(ends, OUTLINE, "line", 1.4)]


FATE_COLOURS = {
    PointStatus.NO_RAY: "#8a6d5a",
    PointStatus.OUT_OF_DEPTH: "#ff7a3c",
    PointStatus.AMBIGUOUS: "#ffd23f",
    PointStatus.STRAY: "#ff4d6d",
    PointStatus.SHARED: "#7f8c99",
    PointStatus.INCONSISTENT: "#d65db1",
}


def stripe_gallery(
    images: Sequence[LabelledProfile],
    sheet_names: Sequence[str],
    exposures: Mapping[str, Exposure],
) -> tuple[Block, ...]:
    """Text, legend and pictures.

    Parameters
    ----------
    images
        Stripe points of all exposures.
    sheet_names
        Names of the sheets, in the order of their numbers.
    exposures
        Images by source name; those that are missing are not shown.
    """
    flags = 0
    for image in images:
        for value in image.profile.flags[image.status == PointStatus.FLAGGED]:
            flags |= int(value)
    seen = {fate for fate in FATE_COLOURS if any(image.count(fate) for image in images)}
    fates = {int(fate): (FATE_COLOURS[fate], fate.label) for fate in PointStatus if fate in seen}
    shown = evenly_chosen([image for image in images if image.profile.source in exposures])
    pictures = tuple(
        stripe_picture(
            exposures[image.profile.source],
            image.profile,
            image.status,
            image.sheet,
            {int(fate): colour for fate, colour in FATE_COLOURS.items()},
            caption=f"{image.count(PointStatus.MEASURED)} of {len(image.profile)} points measured",
        )
        for image in shown
    )
    text = "Every stripe point, measured or not. Dark photographs are brightened here."
    if len(shown) < len(images):
        text += f" {len(shown)} of {len(images)} images are shown, evenly chosen."
    legend = Legend(stripe_legend(sheet_names, fates, flags))
    return Text(text), legend, Gallery(pictures, 420)
