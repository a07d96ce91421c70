# SPDX-License-Identifier: Apache-2.0
"""How an inspection is handed over: title block, set-up with its calibration, and the page as PDF.

PDF is made by WeasyPrint (extra ``pdf``): it needs no browser and gives the same pages on every
machine. It runs no scripts, so that views in space stand there as their pictures.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armscan.errors import OptionError
from armscan.inspection.title_block import TITLE_LABELS, CalibrationState, TitleBlock
from armscan.records.cloud import PointCloud
from armscan.report.page import Facts, Page, Section
from armscan.report.quantity import Quantity, Summary, fact, plural, sentences

NOT_TOLD = "not told"
MOST_NAMED = 12
"""Light sheets that are named in the set-up."""
LONG_YEARS = 800.0
"""Days from which an age is told in years."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """What a report says beside its results; ``quantities`` are for terminal and programs."""

    heading: tuple[Quantity, ...]
    quantities: tuple[Quantity, ...]
    setup: Section
    warnings: tuple[str, ...]

    def on_page(self, page: Page) -> Page:
        """The page with its title block, its set-up before its origin, and the warnings."""
        sections = (*page.sections[:-1], self.setup, *page.sections[-1:])
        warnings = tuple(dict.fromkeys((*sentences(self.warnings), *page.warnings)))
        return replace(page, heading=self.heading, sections=sections, warnings=warnings)

    def in_summary(self, summary: Summary) -> Summary:
        """The summary with title block, calibration and the warnings."""
        return replace(
            summary,
            quantities=(*self.quantities, *summary.quantities),
            warnings=(*sentences(self.warnings), *summary.warnings),
        )


def delivery_of(
    block: TitleBlock, state: CalibrationState, cloud: PointCloud, source: str
) -> Delivery:
    """What a report of a cloud says beside its results."""
    texts = {key: getattr(block, key) for key in TITLE_LABELS}
    heading = tuple(
        Quantity(f"title_block.{key}", TITLE_LABELS[key], text)
        for key, text in texts.items()
        if text
    )
    calibration = calibration_quantities(block, state)
    names = [name for name in cloud.sheet_names if name]
    sheets = ", ".join(names[:MOST_NAMED]) + (" and others" if len(names) > MOST_NAMED else "")
    exposures = f"in {plural(len(np.unique(cloud.exposure)), 'exposure')}"
    if cloud.is_fused or not names:
        exposures = "exposures are not told apart"
    setup = (
        fact("Cloud", f"{source}, {plural(len(cloud), 'point')} in the {cloud.frame} frame"),
        fact("Light sheets", sheets or NOT_TOLD, exposures),
        *(fact(item.label, item.text, item.meaning) for item in calibration if item.label),
    )
    is_asked = bool(state.marks) or math.isfinite(state.valid_days)
    return Delivery(
        heading=heading,
        quantities=(*heading, *(calibration if is_asked else ())),
        setup=Section("Set-up", (Facts(setup),)),
        warnings=calibration_warnings(block, state),
    )


def calibration_quantities(block: TitleBlock, state: CalibrationState) -> tuple[Quantity, ...]:
    """Which calibration, its age and whether it holds."""
    first = state.marks[0] if state.marks else None
    date = "" if first is None else first.created_utc
    if not state.marks:
        shown = "the cloud does not tell which"
    elif not date:
        shown = "its document has no date"
    else:
        shown = f"of {date[:10]}"
    meaning = age_text(state)
    if state.marks and not state.is_of_cloud:
        meaning += f"; that of {block.scanner_name}, the cloud does not tell its own"
    if len(state.marks) > 1:
        meaning += f"; the oldest of {len(state.marks)}"
    return (
        Quantity("calibration.created_utc", "Calibration", date, shown=shown, meaning=meaning),
        Quantity("calibration.documents", "", [mark.document_id for mark in state.marks]),
        Quantity("calibration.is_told_by_cloud", "", state.is_of_cloud),
        Quantity("calibration.age_days", "", state.age_days),
        Quantity("calibration.valid_days", "", state.valid_days),
        Quantity("calibration.is_valid", "", state.is_valid),
        Quantity("calibration.is_of_scanner", "", state.is_of_scanner),
    )


def age_text(state: CalibrationState) -> str:
    """Age and validity, in words; empty where neither is known."""
    words = []
    if math.isfinite(state.age_days):
        words.append(f"{_days(state.age_days, is_over=state.is_valid is False)} old")
    if math.isfinite(state.valid_days):
        held = f"laid down to hold for {_days(state.valid_days)}"
        answer = {True: "valid", False: "no longer valid", None: "not known whether it is valid"}
        words.append(f"{held}: {answer[state.is_valid]}")
    elif state.marks:
        words.append("no period of validity is laid down")
    return ", ".join(words)


def calibration_warnings(block: TitleBlock, state: CalibrationState) -> tuple[str, ...]:
    """What is odd about the calibration."""
    found = []
    if state.is_valid is False:
        found.append(
            f"the calibration is {_days(state.age_days, is_over=True)} old and was laid down to "
            f"hold for {_days(state.valid_days)}: verify the scanner or calibrate it anew"
        )
    if state.age_days < 0.0:
        found.append(
            "the calibration is dated after this inspection: the clock of one of the computers is "
            "wrong, so its age is not known"
        )
    if math.isfinite(state.valid_days) and not math.isfinite(state.age_days):
        found.append(
            "no date of the calibration is known, so it is not known whether it is still valid"
        )
    if state.is_of_scanner is False:
        found.append(
            f"the cloud was not measured with the calibration of {block.scanner_name}: it is of "
            "another head, or of another calibration of this one"
        )
    return tuple(found)


def _days(days: float, *, is_over: bool = False) -> str:
    """In words; what is over a limit is rounded up, or it would read as the limit does."""
    if abs(days) >= LONG_YEARS:
        tenths = days / 36.525
        return f"{(math.ceil(tenths) if is_over else tenths) / 10.0:.1f} years"
    return plural(math.ceil(days) if is_over else math.floor(days), "day")


def require_pdf() -> None:
    """Raise before long work if no PDF could be made afterwards.

    Raises
    ------
    OptionError
        If WeasyPrint, or the system's library for text that it needs, is not installed.
    """
    _weasyprint()


def pdf_bytes(page: bytes) -> bytes:
    """The PDF of a page, A4; nothing is loaded from elsewhere."""
    weasyprint = _weasyprint()
    logging.getLogger("fontTools").setLevel(logging.ERROR)
    logging.getLogger("weasyprint").setLevel(logging.CRITICAL)
    fetcher = weasyprint.URLFetcher(allowed_protocols={"data"})
    document = weasyprint.HTML(string=page.decode(), url_fetcher=fetcher)
    return bytes(document.write_pdf())


def _weasyprint() -> Any:
    try:
        import weasyprint
    except ImportError as error:
        raise OptionError(
            f"PDF needs a package that is not installed ({error.name})",
            where="--pdf",
            remedy="pip install 'armscan[pdf]', or print the page in a browser",
        ) from error
    except OSError as error:
        raise OptionError(
            "WeasyPrint does not find the library Pango, which the system brings",
            where="--pdf",
            remedy="install it (Debian: apt install libpango-1.0-0 libpangoft2-1.0-0), or print "
            "the page in a browser",
        ) from error
    return weasyprint
