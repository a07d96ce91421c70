# SPDX-License-Identifier: Apache-2.0
"""The part of a page that says how a document came to be."""

from __future__ import annotations

from armscan.models.calibration import Provenance
from armscan.report.numbers import SIGMA_NOTE
from armscan.report.page import Facts, Section
from armscan.report.summary import Table


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
