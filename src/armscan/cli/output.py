# SPDX-License-Identifier: Apache-2.0
"""Reports on standard output, progress on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armscan.pipeline.progress import Progress, ProgressEvent
    from armscan.report.summary import Summary

AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON, for programs.")]
ForceBad = Annotated[
    bool,
    typer.Option(
        "--force-bad",
        help="Write a result that makes no sense, marked as such in all that uses it.",
    ),
]
Cache = Annotated[
    bool,
    typer.Option("--cache/--no-cache", help="Keep the points found in images beside the document."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace results that exist.")]


def show(summary: Summary, *, as_json: bool) -> None:
    """Print a report: tables for people, or the same as JSON and nothing else."""
    from armscan.report.summary import summary_json, summary_text

    typer.echo(summary_json(summary) if as_json else summary_text(summary))


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show progress events on standard error while the block runs; nothing if it is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    from armscan.pipeline.progress import silent

    console = Console(stderr=True)
    if not console.is_terminal:
        yield silent
        return
    bars = Bars(
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
        task = bars.tasks[tasks[event.stage]].id
        bars.update(task, completed=event.done, total=event.total, item=event.item)

    with bars:
        yield advance
