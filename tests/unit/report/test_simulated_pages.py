# SPDX-License-Identifier: Apache-2.0
"""What pages say of themselves when their data were rendered."""

from __future__ import annotations

from armscan.report.page import Page, Section, Text, render_page


def test_a_simulated_page_does_not_call_quoted_figures_simulated() -> None:
    """The demo's page quotes the thesis's real figures beside its own."""
    page = Page("Demo", "", (), (), (Section("a", (Text("b"),)),), True, "Foot.")
    text = render_page(page).decode()
    assert "was measured on simulated data" in text
    assert "All numbers on this page" not in text
