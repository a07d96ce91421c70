# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, the report on standard output and progress on standard
error.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armscan.pipeline.progress import Progress, ProgressEvent
    from armscan.report.quantity import Summary


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
    from armscan.report.quantity import summary_json, summary_text

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


Target = Annotated[
    str,
    typer.Option(
        "--target",
        show_default=False,
        help="circle-grid:11x9:3.75, asymmetric-circle-grid:4x11:5, chessboard:11x6:13 (inner "
        "corners, mm) or charuco:10x7:4:3:DICT_4X4_50.",
    ),
]
BitsUsed = Annotated[
    int | None,
    typer.Option("--bits-used", help="Significant bits of 16-bit images, such as 10 or 12."),
]
BitsAlign = Annotated[
    str, typer.Option("--bits-align", help="Where they lie in 16 bits: low, or high.")
]
StripeMethodOption = Annotated[
    str,
    typer.Option(
        "--stripe-method", help="fit, or the thesis's threshold, centroid, template, hessian."
    ),
]
LaserColourOption = Annotated[
    str,
    typer.Option(
        "--laser-colour",
        help="What of colour images to use: auto; red, green, blue, grey; a difference (green-red) "
        "or an excess over the others (green-excess).",
    ),
]


Background = Annotated[
    list[str] | None, typer.Option(help="The same views without laser; repeatable.")
]
Right = Annotated[
    list[str] | None,
    typer.Option(help="Right camera's images of the same instants; of a stereo head."),
]
RightBackground = Annotated[
    list[str] | None, typer.Option(help="The right camera's without laser; repeatable.")
]
Sheet = Annotated[str, typer.Option(help="Sheet that drew the stripes; empty finds it.")]
DepthMargin = Annotated[
    float | None,
    typer.Option(
        help="Widen the calibrated depth range by this part of its width at either end; "
        "points beyond are left out. Without it 0; with two cameras 0.5; points between are "
        "extrapolated.",
        show_default=False,
    ),
]
Volume = Annotated[
    str,
    typer.Option(help="Part of Base to measure: xmin,xmax,ymin,ymax,zmin,zmax in mm."),
]
