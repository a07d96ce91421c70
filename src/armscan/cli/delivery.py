# SPDX-License-Identifier: Apache-2.0
"""How a command runs its job, and what it hands out: progress, the report, its page as PDF."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armscan.cli.options import AsJson, Cache, Force, ForceBad

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


Work = Callable[["Job"], "Summary"]
"""What a command does with its job: where to write, and whom to tell."""
OPTIONS: dict[str, tuple[Any, Any]] = {
    "title_block": (TitleBlockOption, None),
    "pdf": (PdfOption, None),
    "force": (Force, False),
    "force_bad": (ForceBad, False),
    "cache": (Cache, True),
}
OF_CALIBRATIONS = "force force_bad cache"
OF_INSPECTIONS = "title_block pdf force"


def job_command(
    output: Any,
    default: Any = inspect.Parameter.empty,
    *,
    also: str = "force",
    code: Callable[[Summary], int] | None = None,
) -> Callable[[Callable[..., Work]], Callable[..., int]]:
    """A command of a function that makes work out of its own arguments and options.

    The command has ``-o`` and ``--json`` besides, runs the work, and prints its report.

    Parameters
    ----------
    output, default
        What ``-o`` is, and its value where it is not given; empty if it must be.
    also
        Further options between ``-o`` and ``--json``: names in `OPTIONS`, between blanks.
    code
        The exit code that a report asks for; 0 if None.
    """
    kinds = {
        "output": (output, default),
        **{name: OPTIONS[name] for name in also.split()},
        "as_json": (AsJson, False),
    }
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value, annotation=kind)
        for name, (kind, value) in kinds.items()
    ]

    def command_of(work_of: Callable[..., Work]) -> Callable[..., int]:
        @functools.wraps(work_of)
        def command(*words: Any, **options: Any) -> int:
            asked = {name: options.pop(name) for name in kinds}
            summary = run(work_of(*words, **options), **asked)
            return 0 if code is None else code(summary)

        known = inspect.signature(work_of, eval_str=True)
        whole = known.replace(parameters=[*known.parameters.values(), *added])
        command.__signature__ = whole  # type: ignore[attr-defined]
        command.__annotations__ = {name: one.annotation for name, one in whole.parameters.items()}
        return command

    return command_of


def run(
    work: Work,
    *,
    output: Path | None,
    as_json: bool,
    force: bool = False,
    force_bad: bool = False,
    cache: bool = False,
    title_block: list[str] | None = None,
    pdf: Path | None = None,
) -> Summary:
    """Run the work of a job under a progress bar, and show what came out."""
    from armscan.jobs.job import Job

    with progress_bar() as progress:
        job = Job(
            output=output, is_overwriting=force, is_forced=force_bad, is_caching=cache,
            command=("armscan", *sys.argv[1:]), progress=progress,
        )  # fmt: skip
        if title_block or pdf is not None:
            job = _with_delivery(job, title_block or (), pdf)
        try:
            summary = work(job)
        except KeyboardInterrupt:
            if job.cache is not None and job.cache.folder.is_dir():
                with suppress(OSError):
                    # nobody may read it any more
                    typer.echo(FOUND_IS_KEPT, err=True)
            raise
    show(summary, as_json=as_json)
    _tell_compilation()
    return summary


FOUND_IS_KEPT = "what was found in images is kept: the same command uses it"
LONG_COMPILED_S = 3.0


def _tell_compilation() -> None:
    """Say on a terminal why a first run takes longer than those that follow."""
    kernels = sys.modules.get("armscan.kernels.arrays")
    seconds = sum(kernels.COMPILED.values()) if kernels is not None else 0.0
    if seconds > LONG_COMPILED_S and sys.stderr.isatty():
        typer.echo(
            f"{seconds:.0f} s of this were compilation, kept from now on; `armscan doctor --warm` "
            "compiles all",
            err=True,
        )


def _with_delivery(job: Job, title_block: Sequence[str], pdf: Path | None) -> Job:
    """The job with the title block and PDF that were asked for."""
    from armscan.errors import OptionError
    from armscan.storage.parts.recipes import read_title_block

    if pdf is not None and job.output is None:
        raise OptionError(
            "a PDF is made of the page", where=f"--pdf {pdf}", remedy="give -o NAME.html too"
        )
    if pdf is not None and pdf.suffix.lower() != ".pdf":
        raise OptionError(
            f"the name of the PDF ends in '{pdf.suffix}'",
            where=f"--pdf {pdf}",
            remedy="end it in .pdf",
        )
    return replace(job, title_block=read_title_block(title_block, "--title-block"), pdf=pdf)


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
