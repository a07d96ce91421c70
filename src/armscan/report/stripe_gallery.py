# SPDX-License-Identifier: Apache-2.0
"""Images of a reconstruction with every stripe point, coloured by what became of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from armscan.reconstruction.result import PointFate, ReconstructedImage
from armscan.records.exposure import Exposure
from armscan.report.page import Block, Gallery, Legend, Text
from armscan.report.stripe_figures import (
    evenly_chosen,
    stripe_legend,
    stripe_picture,
)

FATE_COLOURS = {
    PointFate.NO_RAY: "#8a6d5a",
    PointFate.OUT_OF_DEPTH: "#ff7a3c",
    PointFate.AMBIGUOUS: "#ffd23f",
    PointFate.STRAY: "#ff4d6d",
    PointFate.SHARED: "#7f8c99",
    PointFate.INCONSISTENT: "#d65db1",
}


def stripe_gallery(
    images: Sequence[ReconstructedImage],
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
        for value in image.profile.flags[image.fate == int(PointFate.FLAGGED)]:
            flags |= int(value)
    seen = {fate for fate in FATE_COLOURS if any(image.count(fate) for image in images)}
    fates = {int(fate): (FATE_COLOURS[fate], fate.label) for fate in PointFate if fate in seen}
    shown = evenly_chosen([image for image in images if image.profile.source in exposures])
    pictures = tuple(
        stripe_picture(
            exposures[image.profile.source],
            image.profile,
            image.fate,
            image.sheet,
            {int(fate): colour for fate, colour in FATE_COLOURS.items()},
            caption=f"{image.count(PointFate.MEASURED)} of {len(image.profile)} points measured",
        )
        for image in shown
    )
    text = "Every stripe point, measured or not. Dark photographs are brightened here."
    if len(shown) < len(images):
        text += f" {len(shown)} of {len(images)} images are shown, evenly chosen."
    legend = Legend(stripe_legend(sheet_names, fates, flags))
    return Text(text), legend, Gallery(pictures, 420)
