# SPDX-License-Identifier: Apache-2.0
"""What every job does besides its own work: the places of the files it writes, and how it ends
without a result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

from armscan.errors import EstimationError, OptionError, OutputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import Provenance
from armscan.records.exposure import Exposure
from armscan.report.drawing import Marks, photo_markup
from armscan.report.page import (
    Gallery,
    Legend,
    Page,
    Picture,
    Section,
    Text,
    footer,
    origin_section,
    render_page,
)
from armscan.report.quantity import Table, sentence, without_source
from armscan.storage.files import check_outputs, write_files
from armscan.vision.targets.target import TargetView


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """Files that are written together.

    Parameters
    ----------
    document
        The result itself.
    """

    document: Path

    @property
    def observations(self) -> Path:
        """What a calibration rests on, beside it."""
        return self.document.with_suffix(".npz")

    @property
    def page(self) -> Path:
        """The report beside it."""
        return self.document.with_suffix(".html")

    @property
    def refused_page(self) -> Path:
        """The page of a run that wrote no document; an earlier document keeps its own page."""
        return self.document.with_suffix(".refused.html")


def calibration_outputs(document: Path, *, is_overwriting: bool) -> OutputFiles:
    """Check the place of ``NAME.json``, and of ``NAME.npz`` and ``NAME.html`` beside it.

    Raises
    ------
    OptionError
        If the name does not end in ``.json``.
    OutputError
        If a file exists or could not be written.
    """
    files = _named(document, (".json",))
    check_outputs((files.document, files.observations, files.page), is_overwriting=is_overwriting)
    return files


def document_and_page(document: Path, *, is_overwriting: bool) -> OutputFiles:
    """Check the place of ``NAME.json``, and of ``NAME.html`` beside it; raises the same."""
    files = _named(document, (".json",))
    check_outputs((files.document, files.page), is_overwriting=is_overwriting)
    return files


def cloud_outputs(document: Path, *, is_overwriting: bool) -> OutputFiles:
    """Check the place of ``NAME.ply`` or ``NAME.xyz``, and of ``NAME.html``; raises the same."""
    files = _named(document, (".ply", ".xyz"))
    check_outputs((files.document, files.page), is_overwriting=is_overwriting)
    return files


def _named(document: Path, suffixes: tuple[str, ...]) -> OutputFiles:
    if document.suffix.lower() not in suffixes:
        raise OptionError(
            f"the output's name ends in '{document.suffix}'",
            where=f"-o {document}",
            remedy=f"end it in {' or '.join(suffixes)}",
        )
    return OutputFiles(document)


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
