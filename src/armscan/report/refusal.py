# SPDX-License-Identifier: Apache-2.0
"""A run that ends without a document: its page, which shows every image and why, and its error.

The page is written as ``NAME.refused.html``: it replaces the page of an earlier refusal, never
that of a document, and the next run that writes a document removes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NoReturn

from armscan.errors import EstimationError, OutputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import Provenance
from armscan.records.exposure import Exposure
from armscan.report.drawing import Marks, photo_markup
from armscan.report.numbers import sentence, without_source
from armscan.report.origin import footer, origin_section
from armscan.report.outputs import OutputFiles
from armscan.report.page import Gallery, Legend, Page, Picture, Section, Text, render_page
from armscan.report.summary import Table
from armscan.storage.atomic import write_files
from armscan.vision.targets.view import TargetView

FORCE_REMEDY = (
    "take better photographs, or give --force-bad to have it written and marked in all that uses it"
)
MAX_PICTURES = 60
TARGET_COLOUR, STRIPE_COLOUR = "#35e0c0", "#ff5a4f"


@dataclass(frozen=True, slots=True, eq=False)
class TriedImage:
    """What was found in one image of a run that ended without a document.

    Parameters
    ----------
    source
        Name of the image.
    remark
        What it gave, or why it gave nothing.
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
    is_simulated: bool,
) -> Page:
    """Lay out the page of a run that found no result.

    Parameters
    ----------
    title
        What was tried.
    images
        What each image gave.
    exposures
        The photographs by source name.
    provenance
        Inputs, options and command.
    is_simulated
        True if the photographs were rendered.
    """
    n_used = sum(image.is_used for image in images)
    unwritten = replace(provenance, document_id="none was written")
    of_images = (_images_section(images, exposures),) if images else ()
    return Page(
        title=title,
        subtitle=f"{n_used} of {len(images)} images gave something to work with" if images else "",
        cards=(),
        warnings=(),
        sections=(*of_images, origin_section(unwritten)),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def _images_section(images: Sequence[TriedImage], exposures: Mapping[str, Exposure]) -> Section:
    rows = tuple((image.source, image.remark) for image in images)
    table = Table(("image", "what it gave"), rows, "", (1,))
    failed_first = sorted(images, key=lambda image: image.is_used)
    shown = [image for image in failed_first if image.source in exposures][:MAX_PICTURES]
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
    pictures = tuple(_picture(image, exposures[image.source]) for image in shown)
    return Section("The images", (table, Text(text), Legend(colours), Gallery(pictures, 300)))


def _picture(image: TriedImage, exposure: Exposure) -> Picture:
    marks = []
    if image.target_px is not None:
        marks.append(Marks(image.target_px, TARGET_COLOUR, "ring", 15.0))
        marks.append(Marks(image.target_px[:1], TARGET_COLOUR, "dot", 13.0))
    if image.stripe_px is not None:
        marks.append(Marks(image.stripe_px, STRIPE_COLOUR, "dot", 4.0))
    is_grey = image.stripe_px is not None
    alt = f"What was found in {image.source}"
    markup = photo_markup(exposure, marks, alt, longest_px=700, is_grey=is_grey)
    return Picture(markup, image.remark, image.source)


def refuse(files: OutputFiles, page: Page, failure: FitFailure) -> NoReturn:
    """Write the page and raise the failure, which names it.

    Raises
    ------
    EstimationError
        Always.
    """
    reasons = tuple(sentence(text) for text in (failure.reason, failure.remedy) if text)
    marked = replace(page, refused=reasons)
    remedy = failure.remedy
    # the reason counts more than the page: a full disk must not hide it
    with suppress(OutputError):
        write_files({files.refused_page: render_page(marked)}, is_overwriting=True)
        shown = f"{files.refused_page} shows what was found"
        remedy = f"{remedy}; {shown}" if remedy else shown
    raise EstimationError(failure.reason, remedy=remedy)


def refused_for(reasons: Sequence[str]) -> FitFailure:
    """The failure of a result that is there and makes no sense; it can be written on request."""
    return FitFailure("; ".join(reasons), FORCE_REMEDY)
