# SPDX-License-Identifier: Apache-2.0
"""A report as one self-contained HTML page: what it is made of, and how it is rendered."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

from jinja2 import Environment, PackageLoader, StrictUndefined

from armscan.models.calibration import Provenance
from armscan.report.quantity import SIGMA_NOTE, Quantity, Table, fact, sentences


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure. Its markup is an ``<img>`` with a data URI, or an ``<svg>``, from this package
    only.
    """

    markup: str
    caption: str = ""
    title: str = ""


@dataclass(frozen=True, slots=True)
class Gallery:
    """Pictures side by side, each at least ``min_width_px`` wide."""

    pictures: tuple[Picture, ...]
    min_width_px: int = 420


@dataclass(frozen=True, slots=True)
class Facts:
    """Quantities one below the other, under a title if there is one."""

    quantities: tuple[Quantity, ...]
    title: str = ""


@dataclass(frozen=True, slots=True)
class Legend:
    """Names of colours: (CSS colour, text)."""

    entries: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Links:
    """Pages beside this one: (relative address, text)."""

    entries: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph."""

    text: str


Block: TypeAlias = Gallery | Facts | Legend | Links | Text | Table


@dataclass(frozen=True, slots=True)
class Section:
    """A titled part of a page; a folded one opens on a click."""

    title: str
    blocks: tuple[Block, ...]
    is_folded: bool = False


@dataclass(frozen=True, slots=True)
class Page:
    """A whole report.

    Parameters
    ----------
    is_simulated
        True marks every number as coming from rendered data.
    forced
        Why what is shown, or what it rests on, was refused and made all the same.
    refused
        Why the run ended without a document, and what to do; empty if it did not.
    heading
        The title block: what the report is about, for whom, by whom.
    """

    title: str
    subtitle: str
    cards: tuple[Quantity, ...]
    warnings: tuple[str, ...]
    sections: tuple[Section, ...]
    is_simulated: bool
    footer: str
    forced: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    heading: tuple[Quantity, ...] = ()


def page_of(
    provenance: Provenance,
    title: str,
    subtitle: str,
    sections: Sequence[Section],
    *,
    cards: Sequence[Quantity] = (),
    warnings: Sequence[str] = (),
    is_simulated: bool = False,
) -> Page:
    """A page that ends with where its content came from.

    ``provenance``: told in the last section and in the foot; its ``forced`` marks the page.
    """
    return Page(
        title=title,
        subtitle=subtitle,
        cards=tuple(cards),
        warnings=sentences(warnings),
        sections=(*sections, _origin_section(provenance)),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def _origin_section(provenance: Provenance) -> Section:
    """Inputs with hashes, options, parents, command."""
    facts = Facts(
        (
            fact("Document", provenance.document_id),
            fact("Written", f"{provenance.created_utc} by armscan {provenance.armscan_version}"),
            fact("Command", shlex.join(provenance.command)),
            fact("Rests on", ", ".join(provenance.parent_ids) or "no other document"),
        )
    )
    inputs = tuple((item.path, item.sha256[:16] + "…") for item in provenance.inputs)
    blocks = (
        facts,
        Table(("file", "SHA-256"), inputs, "Files that went in", (1,)),
        Table(("option", "value"), provenance.options, "Options in force", (1,)),
    )
    return Section("Origin", blocks, is_folded=True)


def footer(provenance: Provenance) -> str:
    """One line for the foot of a page."""
    return (
        f"Written {provenance.created_utc} by armscan {provenance.armscan_version}. "
        f"{SIGMA_NOTE} This page holds all its pictures and asks no other host for anything."
    )


def render_page(page: Page) -> bytes:
    """HTML of a page; nothing in it is loaded from elsewhere."""
    template = _environment().get_template("page.html.j2")
    # names of files may hold bytes that are no text
    return template.render(page=page).encode(errors="backslashreplace")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("armscan.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for kind in (Gallery, Facts, Legend, Links, Text, Table):
        name = kind.__name__.lower()
        environment.tests[name] = lambda block, kind=kind: isinstance(block, kind)
    return environment
