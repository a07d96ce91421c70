# SPDX-License-Identifier: Apache-2.0
"""One HTML page: cards, figures, tables, text, and where its content came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

from jinja2 import Environment, PackageLoader, StrictUndefined

from armscan.models.calibration import Provenance
from armscan.report.quantity import SIGMA_NOTE, Table


@dataclass(frozen=True, slots=True)
class Card:
    """A key figure: what, how much, and what that means in a few words."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure.

    Parameters
    ----------
    markup
        Trusted HTML: an ``<img>`` with a data URI, or an ``<svg>``, from this package only.
    caption
        How to read it.
    title
        Short name; empty for none.
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
    """Labels with values, below a title if there is one."""

    rows: tuple[tuple[str, str], ...]
    title: str = ""


@dataclass(frozen=True, slots=True)
class Legend:
    """Names of colours: (CSS colour, text)."""

    entries: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph."""

    text: str


Block: TypeAlias = Gallery | Facts | Legend | Text | Table


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
    title, subtitle
        What was done, and to what.
    cards
        Key figures.
    warnings
        Sentences that a person should read first.
    sections
        The rest, most asked for first.
    is_simulated
        True marks every number as coming from rendered data.
    footer
        One line about origin.
    forced
        Why what is shown, or what it rests on, was refused and made all the same.
    refused
        Why the run ended without a document, and what to do; empty if it did not.
    """

    title: str
    subtitle: str
    cards: tuple[Card, ...]
    warnings: tuple[str, ...]
    sections: tuple[Section, ...]
    is_simulated: bool
    footer: str
    forced: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()


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
    kinds: Mapping[str, type] = {
        "gallery": Gallery,
        "facts": Facts,
        "legend": Legend,
        "text": Text,
        "table": Table,
    }
    for name, kind in kinds.items():
        environment.tests[name] = lambda block, kind=kind: isinstance(block, kind)
    return environment


def origin_section(provenance: Provenance) -> Section:
    """Inputs with hashes, options, parents, command."""
    facts = Facts(
        (
            ("Document", provenance.document_id),
            ("Written", f"{provenance.created_utc} by armscan {provenance.armscan_version}"),
            ("Command", " ".join(provenance.command)),
            ("Rests on", ", ".join(provenance.parent_ids) or "no other document"),
        )
    )
    options = Table(("option", "value"), provenance.options, "Options in force", (1,))
    inputs = Table(
        ("file", "SHA-256"),
        tuple((item.path, item.sha256[:16] + "…") for item in provenance.inputs),
        "Files that went in",
        (1,),
    )
    return Section("Origin", (facts, inputs, options), is_folded=True)


def footer(provenance: Provenance) -> str:
    """One line for the foot of a page."""
    return (
        f"Written {provenance.created_utc} by armscan {provenance.armscan_version}. "
        f"{SIGMA_NOTE} This page holds all its pictures and asks no other host for anything."
    )
