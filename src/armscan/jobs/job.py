# SPDX-License-Identifier: Apache-2.0
"""What every job does besides its own work: check where it writes, write all or nothing, refuse.

A job reads, computes, lays out a page and writes. A run that ends without a document writes
``NAME.refused.html`` in its place: it replaces the page of an earlier refusal, never that of a
document, and the next run that writes a document removes it.

Every job raises `ArmscanError` if a file is unreadable, an option is wrong, or its input does not
determine the result, and then leaves no document.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from armscan.errors import ArmscanError, EstimationError, FileFormatError, OptionError, OutputError
from armscan.geometry.estimate import FitFailure
from armscan.inspection.title_block import TitleBlock, calibration_state
from armscan.models.calibration import Provenance
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.cloud import DELIVERED, PointCloud
from armscan.report.inspection.delivery import Delivery, delivery_of, pdf_bytes, require_pdf
from armscan.report.page import Page, render_page
from armscan.report.quantity import Summary, fact, sentences, summary_json
from armscan.storage.codec import parse_json
from armscan.storage.detection_cache import DetectionCache
from armscan.storage.documents import new_provenance
from armscan.storage.files import (
    Content,
    check_outputs,
    make_folder,
    read_bytes,
    sole_writer,
    write_files,
)
from armscan.storage.image_paths import are_simulated
from armscan.vision.targets.target import Charuco, Target, describe_target

T = TypeVar("T")

FORCE_REMEDY = (
    "mend that or take other photographs, or give --force-bad to have it written and marked in "
    "all that uses it"
)


@dataclass(frozen=True, slots=True)
class Job:
    """Where a job writes, what it may do there, and who is told how far it is.

    Parameters
    ----------
    output
        The document; other files are written beside it. None to write nothing.
    is_forced
        Write a result that makes no sense, marked as such.
    is_caching
        Keep the points found in images beside the document, and take those kept there.
    pdf
        Where the page goes as PDF too; None for nowhere.
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

    def places(
        self,
        *suffixes: str,
        beside: Sequence[str] = (),
        hint: str = "",
        reads: Sequence[Path] = (),
    ) -> list[Path]:
        """Check where files go before anything is read; none if there is no output.

        ``beside``: suffixes of the files beside it. ``hint``: behind the remedy of a wrong suffix.
        ``reads``: files that the job reads, and so must not replace.

        Raises
        ------
        OptionError
            If the document's name ends in something else.
        OutputError
            If a file exists, could not be written, or is one that the job reads.
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
        written = (*files, *(() if self.pdf is None else (self.pdf,)))
        for path in written:
            if path.exists() and any(one.exists() and path.samefile(one) for one in reads):
                word = "inspection" if self.output.suffix == ".html" else "new"
                beside_it = " beside the page" if path.suffix != self.output.suffix else ""
                raise OutputError(
                    f"{path.name} is read, and would be replaced{beside_it}",
                    where=f"-o {self.output}",
                    remedy=f"give another name: -o {self.output.stem}-{word}{self.output.suffix}",
                )
        check_outputs(written, is_overwriting=self.is_overwriting)
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
        is_simulated: bool = False,
    ) -> Provenance:
        """Record of this run, as `armscan.storage.documents.new_provenance`."""
        made = new_provenance(
            inputs,
            command=self.command,
            options=options,
            parents=parents,
            warnings=warnings,
            forced=forced,
        )
        return replace(made, is_simulated=is_simulated)

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
        """Write the page of a run without a result, and raise the failure, which names it."""
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


LEDGER = "batch.json"
LedgerEntry = dict[str, Any]


@dataclass(frozen=True, slots=True)
class BatchItem:
    """One of many results in one folder; ``name`` has no suffix, ``n_steps`` are its exposures.

    ``mark`` is a hash of all that the result follows from.
    """

    name: str
    mark: str
    n_steps: int
    work: Callable[[Job], Summary]


class Batch:
    """Many results in one folder: what is done is not done again, a failure ends no other.

    ``batch.json`` in the folder says of each result which inputs it follows from and how large it
    is. A result of other inputs, or one that was changed since, is not replaced unless the job may
    overwrite.

    Parameters
    ----------
    tell
        Told a line when a result is there or failed.
    """

    def __init__(self, job: Job, suffix: str, tell: Callable[[str], None]) -> None:
        if job.output is None or job.output.suffix:
            raise OptionError(
                "the results of several scans go into a folder",
                where=f"-o {job.output}",
                remedy="name a folder, without a dot in its name: -o clouds",
            )
        self._job, self.folder = job, job.output
        self._suffix, self._tell = suffix, tell
        self._ledger: dict[str, LedgerEntry] = {}
        self._n_before = 0

    def run(self, items: Sequence[BatchItem]) -> dict[str, LedgerEntry]:
        """Make what is not there yet; what is known of each result, by name.

        An entry has ``failed``, the reason, or ``seconds`` and ``data``, the result's own;
        ``is_old`` where it was there before, and ``kept``, the file of other inputs, or changed
        since, that was left.

        Raises
        ------
        OutputError
            If the folder or a file in it cannot be written: no other result could be; or if
            another run is at work there.
        FileFormatError
            If its ``batch.json`` is something else.
        OptionError
            If the work of all was asked for wrongly, or the cluster was lost.
        """
        make_folder(self.folder)
        with sole_writer(self.folder):
            self._open()
            return self._made(items)

    def _made(self, items: Sequence[BatchItem]) -> dict[str, LedgerEntry]:
        found: dict[str, LedgerEntry] = {}
        waiting = [one for one in items if not self._is_done(one)]
        for item in items:
            if item not in waiting:
                found[item.name] = {**self._ledger[item.name], "is_old": True}
        total, made = sum(item.n_steps for item in waiting), (0, 0.0)
        for k, item in enumerate(waiting):
            try:
                found[item.name] = entry = self._result(item, total)
            except KeyboardInterrupt:
                self._tell(f"{k} of {len(waiting)} are through; the same command goes on")
                raise
            self._n_before += item.n_steps
            if "kept" not in entry:
                self._write(item.name, {**entry, "mark": item.mark})
            what = f"failed: {entry['failed']}" if "failed" in entry else "done"
            if "seconds" in entry:
                made = made[0] + item.n_steps, made[1] + entry["seconds"]
            rest = total - self._n_before
            if rest and made[0]:
                minutes = rest * made[1] / made[0] / 60.0
                what += f"  ({made[0] / made[1]:.1f} exposures/s, {minutes:.1f} min left)"
            self._tell(f"{k + 1} of {len(waiting)}  {item.name}: {what}")
        return found

    def _open(self) -> None:
        place = self.folder / LEDGER
        if not place.exists():
            return
        document = parse_json(read_bytes(place), str(place))
        results = document.get("results")
        is_whole = isinstance(results, dict) and all(map(_is_entry, results.values()))
        if not isinstance(results, dict) or not is_whole or len(document) > 1:
            raise FileFormatError(
                "this is not the list of a batch's results",
                where=str(place),
                remedy="name another folder; if the list was damaged, remove it",
            )
        self._ledger = results

    def _place(self, name: str) -> Path:
        return self.folder / f"{name}{self._suffix}"

    def _is_done(self, item: BatchItem) -> bool:
        entry, place = self._ledger.get(item.name, {}), self._place(item.name)
        if entry.get("mark") != item.mark or "data" not in entry or not place.is_file():
            return False
        return bool(place.stat().st_size == entry.get("bytes"))

    def _result(self, item: BatchItem, total: int) -> LedgerEntry:
        place = self._place(item.name)
        entry = self._ledger.get(item.name, {})
        is_same = entry.get("mark") == item.mark
        # a run that was interrupted told no size, nor did it leave a part of a result
        is_changed = "bytes" in entry and place.is_file()
        is_own = is_same and not is_changed
        there = [one for one in (place, place.with_suffix(".html")) if one.exists()]
        if there and not (is_own or self._job.is_overwriting):
            kept = there[0].name
            why = "was changed since it was made" if is_same else "exists and is of other inputs"
            return {"failed": f"{kept} {why}; --force replaces it", "kept": kept}
        self._write(item.name, {"mark": item.mark})
        own = replace(
            self._job,
            output=place,
            is_overwriting=is_own or self._job.is_overwriting,
            progress=lambda event: self._advance(event, item, total),
        )
        start = time.monotonic()
        try:
            summary = item.work(own)
        except OutputError:
            raise
        except OptionError as error:
            if error.where.startswith("--"):
                raise
            return {"failed": str(error)}
        except Exception as error:  # one scan's fault must not cost the others of a night
            is_known = isinstance(error, ArmscanError)
            return {"failed": str(error) if is_known else f"{type(error).__name__}: {error}"}
        return {
            "seconds": time.monotonic() - start,
            "bytes": place.stat().st_size,
            "data": json.loads(summary_json(summary)),
        }

    def _advance(self, event: ProgressEvent, item: BatchItem, total: int) -> None:
        """Of all results together, in which this one's steps count by their share."""
        share = event.done / event.total if event.total else 0.0
        done = self._n_before + round(share * item.n_steps)
        self._job.progress(ProgressEvent("batch", done, total, item.name))

    def _write(self, name: str, entry: LedgerEntry) -> None:
        self._ledger[name] = entry
        content = json.dumps({"results": self._ledger}, indent=1)
        write_files({self.folder / LEDGER: content.encode()}, is_overwriting=True)


def _is_entry(entry: object) -> bool:
    """Whether it can be a `LedgerEntry`."""
    if not isinstance(entry, dict) or not isinstance(entry.get("mark"), str):
        return False
    is_timed = isinstance(entry.get("seconds", 0.0), int | float)
    return is_timed and isinstance(entry.get("data", {}), dict)


def solved(result: T | FitFailure, where: object = "") -> T:
    """The result of an estimation; `EstimationError` if it failed."""
    if isinstance(result, FitFailure):
        raise EstimationError(result.reason, where=str(where), remedy=result.remedy)
    return result


def with_old_layout(summary: Summary, target: Target) -> Summary:
    """The summary that says so where the board has the old layout; a person may not have known."""
    if not (isinstance(target, Charuco) and target.layout == "old"):
        return summary
    told = fact("target", describe_target(target))
    return replace(summary, quantities=(*summary.quantities, told))


def noise_remarks(cloud: PointCloud) -> tuple[str, ...]:
    """What to say where it is not known how far neighbours share the stripe's noise."""
    if cloud.noise_length is not None or not cloud.sigma_noise_mm.any():
        return ()
    is_delivered = tuple(cloud.sheet_names) == (DELIVERED,)
    why = "a sensor that delivers profiles does not tell" if is_delivered else "reconstruct again"
    return (
        "the cloud does not say how far neighbours share the stripe's noise: it is taken as new in "
        f"every point, as if nothing had been smoothed along it; {why}",
    )


def was_simulated(before: Provenance, document: Path) -> bool:
    """True if a document was made of rendered images.

    One from before does not tell: what lies beside its inputs does, as they are named from here or
    from its folder.
    """
    named = [Path(item.path) for item in before.inputs]
    beside = [document.parent / path for path in named]
    return before.is_simulated or are_simulated([*named, *beside])
