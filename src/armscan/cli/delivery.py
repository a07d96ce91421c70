# SPDX-License-Identifier: Apache-2.0
"""How a command runs its job, and what it hands out: progress, the report, its page as PDF.

``--title-block`` and ``--pdf`` are options of every command that inspects a cloud.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from armscan.jobs.job import Job
    from armscan.pipeline.progress import Progress, ProgressEvent
    from armscan.report.quantity import Summary

TitleBlockOption = Annotated[
    list[str] | None,
    typer.Option(
        "--title-block",
        help="At the head of the page: KEY=TEXT with part, serial, order, customer, operator, "
        "instrument, temperature, remark, scanner, calibration_valid_days; or a .toml file of "
        "them. Give it as often as needed.",
        show_default=False,
    ),
]
PdfOption = Annotated[
    Path | None,
    typer.Option("--pdf", help="The page of -o as PDF too (needs the extra pdf)."),
]


@dataclass(frozen=True, slots=True)
class Asked:
    """What a person asked for beside the inspection itself."""

    title_block: tuple[str, ...] = ()
    pdf: Path | None = None


ASKED: ContextVar[Asked | None] = ContextVar("asked", default=None)
"""Set while a command runs, so that each of them hands on nothing that it does not use."""


def delivered(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with both options; jobs that it runs are given them by `with_delivery`."""

    @functools.wraps(command)
    def both(*words: Any, title_block: list[str] | None, pdf: Path | None, **options: Any) -> Any:
        token = ASKED.set(Asked(tuple(title_block or ()), pdf))
        try:
            return command(*words, **options)
        finally:
            ASKED.reset(token)

    kinds: dict[str, tuple[Any, Any]] = {
        "title_block": (TitleBlockOption, None),
        "pdf": (PdfOption, None),
    }
    known = inspect.signature(command, eval_str=True)
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in kinds.items()
    ]
    # the options that all commands have stand last
    own = list(known.parameters.values())
    places = [k for k, one in enumerate(own) if one.name == "output"]
    at = places[0] + 1 if places else len(own)
    whole = known.replace(parameters=[*own[:at], *added, *own[at:]])
    both.__signature__ = whole  # type: ignore[attr-defined]
    both.__annotations__ = {name: one.annotation for name, one in whole.parameters.items()}
    return both


def with_delivery(job: Job) -> Job:
    """The job with the title block and PDF that were asked for.

    Raises
    ------
    ArmscanError
        If the title block is not understood, or there is no page for the PDF.
    """
    asked = ASKED.get()
    if asked is None or asked == Asked():
        return job
    from armscan.errors import OptionError
    from armscan.storage.parts.recipes import read_title_block

    if asked.pdf is not None and job.output is None:
        raise OptionError(
            "a PDF is made of the page", where=f"--pdf {asked.pdf}", remedy="give -o NAME.html too"
        )
    if asked.pdf is not None and asked.pdf.suffix.lower() != ".pdf":
        raise OptionError(
            f"the name of the PDF ends in '{asked.pdf.suffix}'",
            where=f"--pdf {asked.pdf}",
            remedy="end it in .pdf",
        )
    block = read_title_block(asked.title_block, "--title-block")
    return replace(job, title_block=block, pdf=asked.pdf)


def run(
    work: Callable[[Job], Summary],
    *,
    as_json: bool,
    output: Path | None = None,
    force: bool = False,
    force_bad: bool = False,
    cache: bool = False,
) -> Summary:
    """Run a job under a progress bar, and show what came out."""
    from armscan.jobs.job import Job

    with progress_bar() as progress:
        job = Job(
            output=output, is_overwriting=force, is_forced=force_bad, is_caching=cache,
            command=("armscan", *sys.argv[1:]), progress=progress,
        )  # fmt: skip
        job = with_delivery(job)
        try:
            summary = work(job)
        except KeyboardInterrupt:
            if job.cache is not None and job.cache.folder.is_dir():
                typer.echo("what was found in images is kept: the same command uses it", err=True)
            raise
    show(summary, as_json=as_json)
    return summary


def show(summary: Summary, *, as_json: bool) -> None:
    """Print a report: tables for people, or the same as JSON and nothing else."""
    from armscan.report.quantity import summary_json, summary_text

    typer.echo(summary_json(summary) if as_json else summary_text(summary))


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show progress events on standard error while the block runs; nothing if it is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBars

    from armscan.pipeline.progress import silent

    if not (console := Console(stderr=True)).is_terminal:
        yield silent
        return
    bars = ProgressBars(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[item]}"),
        console=console,
        transient=True,
    )
    tasks: dict[str, int] = {}

    def advance(event: ProgressEvent) -> None:
        if event.stage not in tasks:
            tasks[event.stage] = bars.add_task(event.stage, total=event.total, item="")
        task = bars.tasks[tasks[event.stage]]
        item = f"{task.speed:.0f}/s {event.item}" if task.speed else event.item
        bars.update(task.id, completed=event.done, total=event.total, item=item)

    with bars:
        yield advance
