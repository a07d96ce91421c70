# SPDX-License-Identifier: Apache-2.0
"""Options that several commands have, and how a command runs its job and shows what came out.

A default stands once, in the class that the option sets: an option that is not given is None here
and left to that class, and help reads it from there when it is printed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from armscan.cli.delivery import with_delivery

if TYPE_CHECKING:
    from armscan.jobs.job import Job
    from armscan.pipeline.progress import Progress, ProgressEvent
    from armscan.report.quantity import Summary

T = TypeVar("T")


class DefaultOf(str):
    """A default that help shows, as ``package.module:Class.field`` of a dataclass.

    Help formats it; only then is the module imported and the field's default read.
    """

    __slots__ = ()

    def __format__(self, spec: str) -> str:
        module, _, place = self.partition(":")
        name, _, wanted = place.partition(".")
        known = fields(getattr(import_module(module), name))
        return str({field.name: field.default for field in known}[wanted])


class Side(StrEnum):
    """Axis of Base along which a plate's face looks."""

    PLUS_X = "+x"
    MINUS_X = "-x"
    PLUS_Y = "+y"
    MINUS_Y = "-y"
    PLUS_Z = "+z"
    MINUS_Z = "-z"


STRIPES = "armscan.vision.stripe.image:StripeOptions."
PIXELS = "armscan.storage.images:ImageOptions."
INSPECTION = "armscan.inspection.selection:InspectionOptions."

AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON, for programs.")]
Force = Annotated[bool, typer.Option("--force", help="Replace results that exist.")]
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
Document = Annotated[
    Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
]
TARGET = typer.Option(
    "--target",
    show_default=False,
    help="circle-grid:11x9:3.75, asymmetric-circle-grid:4x11:5, chessboard:11x6:13 (inner "
    "corners, mm) or charuco:10x7:4:3:DICT_4X4_50.",
)
Target = Annotated[str, TARGET]
OptionalTarget = Annotated[str | None, TARGET]
BitsUsed = Annotated[
    int | None,
    typer.Option("--bits-used", help="Significant bits of 16-bit images, such as 10 or 12."),
]
BitsAlign = Annotated[
    str | None,
    typer.Option(
        "--bits-align",
        help="Where they lie in 16 bits: low, or high.",
        show_default=DefaultOf(PIXELS + "align"),
    ),
]


class Method(StrEnum):
    """Whose way a result is found beside armscan's own."""

    THESIS = "thesis"


MethodOption = Annotated[
    Method | None,
    typer.Option("--method", help="thesis: as the thesis prints it, to set it beside armscan's."),
]
StripeMethodOption = Annotated[
    str | None,
    typer.Option(
        "--stripe-method",
        help="fit, or the thesis's threshold, centroid, template, hessian.",
        show_default=DefaultOf(STRIPES + "method"),
    ),
]
EulerAngles = Annotated[
    str | None,
    typer.Option(
        help="Angles in --poses: intrinsic-xyz, extrinsic-xyz (FANUC), intrinsic-zxz.",
        show_default=DefaultOf("armscan.jobs.hand_eye:StripeSource.euler"),
    ),
]
LaserColourOption = Annotated[
    str | None,
    typer.Option(
        "--laser-colour",
        help="What of colour images to use: auto; red, green, blue, grey; a difference (green-red) "
        "or an excess over the others (green-excess).",
        show_default=DefaultOf(STRIPES + "laser_colour"),
    ),
]
ArmFile = Annotated[
    Path | None, typer.Option(help="arm.toml, for recordings of joint angles.", show_default=False)
]
RegionOption = Annotated[
    str,
    typer.Option(
        "--region", help="Look only inside xmin,xmax,ymin,ymax,zmin,zmax (mm).", show_default=False
    ),
]
FeatureOption = Annotated[
    float | None,
    typer.Option(
        "--feature-mm",
        help="Points this near to the surface belong to it, outliers included.",
        show_default=DefaultOf(INSPECTION + "feature_mm"),
    ),
]
SideOption = Annotated[
    Side | None,
    typer.Option(
        "--side",
        help="Axis that the face of --plate looks along, for centres of the tip.",
        show_default=False,
    ),
]
PageOption = Annotated[
    Path | None,
    typer.Option("-o", "--output", help="Page to write, .html; without it none is written."),
]


def given(options: type[T], **values: Any) -> T:
    """Options of which only those that are not None were given."""
    return options(**{name: value for name, value in values.items() if value is not None})


def refuse_vain(options: Mapping[str, Any], what: str, remedy: str = "leave out") -> None:
    """Refuse options that would be without effect.

    Parameters
    ----------
    options
        Value of each option by its name; None, False, or empty where it was not given.
    what
        Why they have no effect.
    remedy
        What to do, in front of the names.

    Raises
    ------
    OptionError
        If one or more were given.
    """
    from armscan.errors import OptionError

    # zero is a value: `== False` would take it for one that was not given
    named = [
        name
        for name, value in options.items()
        if not (value is None or value is False or value in ("", [], ()))
    ]
    if named:
        names = ", ".join(named)
        raise OptionError(what, where=names, remedy=f"{remedy} {names}")


def refuse_given(context: typer.Context, names: str, what: str) -> None:
    """Refuse parameters of a command, named between blanks, that would be without effect here."""
    sources = {name: context.get_parameter_source(name) for name in names.split()}
    given_here = [
        parameter
        for parameter in context.command.params
        if (source := sources.get(parameter.name or "")) and source.name == "COMMANDLINE"
    ]
    is_off = [context.params[parameter.name or ""] is False for parameter in given_here]
    options = {
        (parameter.secondary_opts if off else parameter.opts)[0]: True
        for parameter, off in zip(given_here, is_off, strict=True)
    }
    refuse_vain(options, what)


def numbers(text: str, option: str) -> tuple[float, ...]:
    """Numbers between commas.

    Raises
    ------
    OptionError
        If a word is no number.
    """
    from armscan.errors import OptionError

    try:
        return tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError as error:
        raise OptionError(
            f"'{text}' is not a list of numbers", where=option, remedy="put commas between them"
        ) from error


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
