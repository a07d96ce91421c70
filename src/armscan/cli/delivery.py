# SPDX-License-Identifier: Apache-2.0
"""``--title-block`` and ``--pdf``, which every command that inspects a cloud has."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from armscan.jobs.job import Job

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
