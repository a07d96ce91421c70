# SPDX-License-Identifier: Apache-2.0
"""What every job does besides its own work: check where it writes, write all or nothing, refuse.

A job reads, computes, lays out a page and writes. A run that ends without a document writes
``NAME.refused.html`` in its place: it replaces the page of an earlier refusal, never that of a
document, and the next run that writes a document removes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from armscan.errors import EstimationError, OptionError, OutputError
from armscan.geometry.estimate import FitFailure
from armscan.inspection.title_block import TitleBlock, calibration_state
from armscan.models.calibration import Provenance
from armscan.pipeline.progress import Progress, silent
from armscan.records.cloud import PointCloud
from armscan.report.inspection.delivery import Delivery, delivery_of, pdf_bytes, require_pdf
from armscan.report.page import Page, render_page
from armscan.report.quantity import sentences
from armscan.storage.detection_cache import DetectionCache
from armscan.storage.documents import new_provenance
from armscan.storage.files import Content, check_outputs, write_files

T = TypeVar("T")

FORCE_REMEDY = (
    "take better photographs, or give --force-bad to have it written and marked in all that uses it"
)


@dataclass(frozen=True, slots=True)
class Job:
    """Where a job writes, what it may do there, and who is told how far it is.

    Parameters
    ----------
    output
        The document; other files are written beside it. None to write nothing.
    is_overwriting
        Replace results that exist.
    is_forced
        Write a result that makes no sense, marked as such.
    is_caching
        Keep the points found in images beside the document, and take those kept there.
    pdf
        Where the page goes as PDF too; None for nowhere.
    title_block
        At the head of an inspection's page.
    command
        The command line, for the record.
    progress
        Is told of every step.
    """

    output: Path | None = None
    is_overwriting: bool = False
    is_forced: bool = False
    is_caching: bool = False
    pdf: Path | None = None
    title_block: TitleBlock = field(default_factory=TitleBlock)
    command: tuple[str, ...] = ()
    progress: Progress = silent

    @property
    def cache(self) -> DetectionCache | None:
        """Points found in images; None if they are not kept."""
        if self.output is None or not self.is_caching:
            return None
        return DetectionCache.beside(self.output)

    def places(self, *suffixes: str, beside: Sequence[str] = (), hint: str = "") -> list[Path]:
        """Check where files go before anything is read; none if there is no output.

        Parameters
        ----------
        suffixes
            Those that the document's name may end in.
        beside
            Suffixes of the files beside it.
        hint
            Behind the remedy of a wrong suffix.

        Raises
        ------
        OptionError
            If the document's name ends in something else.
        OutputError
            If a file exists or could not be written.
        """
        if self.output is None:
            return []
        if self.output.suffix.lower() not in suffixes:
            raise OptionError(
                f"the output's name ends in '{self.output.suffix}'",
                where=f"-o {self.output}",
                remedy=f"end it in {' or '.join(suffixes)}{hint}",
            )
        files = [self.output, *(self.output.with_suffix(suffix) for suffix in beside)]
        check_outputs(
            (*files, *(() if self.pdf is None else (self.pdf,))), is_overwriting=self.is_overwriting
        )
        if self.pdf is not None:
            require_pdf()
        return files

    def delivery(self, cloud: PointCloud, source: Path) -> Delivery:
        """What the report of a cloud from a file says beside its results."""
        state = calibration_state(self.title_block, cloud.calibrations, datetime.now(UTC))
        return delivery_of(self.title_block, state, cloud, source.name)

    def provenance(
        self,
        inputs: Sequence[Path],
        options: Sequence[Any],
        *,
        parents: Sequence[Provenance] = (),
        warnings: Sequence[str] = (),
        forced: Sequence[str] = (),
    ) -> Provenance:
        """Record of this run, as `armscan.storage.provenance.new_provenance`."""
        return new_provenance(
            inputs,
            command=self.command,
            options=options,
            parents=parents,
            warnings=warnings,
            forced=forced,
        )

    def write(self, contents: Mapping[Path, Content | Page]) -> tuple[Path, ...]:
        """Write all files or none, and remove the page of an earlier refusal.

        The first page is written as PDF too, where one is wanted.
        """
        files: dict[Path, Content] = {}
        pdf = self.pdf
        for path, content in contents.items():
            rendered = render_page(content) if isinstance(content, Page) else content
            files[path] = rendered
            if pdf is not None and isinstance(content, Page) and isinstance(rendered, bytes):
                files[pdf], pdf = pdf_bytes(rendered), None
        write_files(files, is_overwriting=self.is_overwriting)
        if self.output is not None:
            self.output.with_suffix(".refused.html").unlink(missing_ok=True)
        return tuple(files)

    def refuse(self, page: Page, failure: FitFailure) -> NoReturn:
        """Write the page of a run without a result, and raise the failure, which names it.

        Raises
        ------
        EstimationError
            Always.
        """
        remedy = failure.remedy
        if self.output is not None:
            place = self.output.with_suffix(".refused.html")
            reasons = sentences(text for text in (failure.reason, remedy) if text)
            # the reason counts more than the page: a full disk must not hide it
            with suppress(OutputError):
                content = render_page(replace(page, refused=reasons))
                write_files({place: content}, is_overwriting=True)
                shown = f"{place} shows what was found"
                remedy = f"{remedy}; {shown}" if remedy else shown
        raise EstimationError(failure.reason, remedy=remedy)

    def refuse_nonsense(self, page: Page, reasons: Sequence[str]) -> None:
        """Refuse a result that is there and makes no sense, unless it is forced."""
        if reasons and not self.is_forced:
            self.refuse(replace(page, forced=()), FitFailure("; ".join(reasons), FORCE_REMEDY))


def solved(result: T | FitFailure, where: object = "") -> T:
    """The result of an estimation.

    Raises
    ------
    EstimationError
        If it failed.
    """
    if isinstance(result, FitFailure):
        raise EstimationError(result.reason, where=str(where), remedy=result.remedy)
    return result
