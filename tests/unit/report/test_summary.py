# SPDX-License-Identifier: Apache-2.0
"""Numbers and summaries as people and programs read them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from armscan.reconstruction.pass_agreement import PassAgreement, PassPair
from armscan.report.cloud import passes_text
from armscan.report.quantity import (
    Quantity,
    Summary,
    Table,
    fact,
    for_people,
    only,
    sentence,
    share_text,
    significant,
    summary_json,
    summary_text,
    triple,
    values,
    with_sigma,
)


def test_a_share_reads_none_or_all_only_where_it_is() -> None:
    shares = (0.0, 0.0003, 0.005, 50.0, 99.9994, 100.0)
    told = ("0.00 %", "below 0.01 %", "0.01 %", "50.00 %", "above 99.99 %", "100.00 %")
    assert tuple(map(share_text, shares)) == told


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (1431.2749, 0.8512, "1431.27 ± 0.85 px"),
        (0.0305123, 0.0033, "0.0305 ± 0.0033 px"),
        (-7.0, 12.3, "-7 ± 12 px"),
        (0.1, 0.0999, "0.100 ± 0.100 px"),
        (12345.6, 0.0, "12345.6 px"),
        (1.5, math.nan, "1.5 px"),
        (-0.0004, 0.3, "0.00 ± 0.30 px"),
        (20.0000000123456, 1.234e-8, "20.000000 ± 1.2e-08 px"),
        (0.0123456789012, 1.234e-9, "0.012345679 ± 1.2e-09 px"),
        (3.45678e-5, 1.234e-8, "3.4568e-05 ± 1.2e-08 px"),
        (0.0, 1.234e-8, "0 ± 1.2e-08 px"),
        (1.25, 0.000012, "1.250000 ± 0.000012 px"),
    ],
)
def test_a_value_is_shown_to_two_digits_of_its_sigma(value: float, sigma: float, text: str) -> None:
    assert with_sigma(value, sigma, "px") == text


def test_no_zero_has_a_sign() -> None:
    assert triple([-1e-9, -0.00006, 2.0]) == "0.0000, -0.0001, 2.0000"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0 mm"),
        (0.0748123, "0.0748 mm"),
        (1234.5, "1234 mm"),
        (-3.14159, "-3.14 mm"),
        (1.23456e-7, "1.23e-07 mm"),
        (math.nan, "not known"),
    ],
)
def test_a_few_digits(value: float, text: str) -> None:
    assert significant(value, "mm") == text


def test_a_path_with_a_blank_is_quoted_where_it_is_to_be_typed() -> None:
    path = Path("a b/page.html")
    told = summary_text(Summary("Done.", written=(path, Path("a b")), next_step=f"open {path}"))
    assert told.splitlines()[-3:] == [
        f"wrote {path}", "wrote a b", f"next: open '{path}'",
    ]  # fmt: skip
    plain = Summary("Done.", written=(Path("page.html"),), next_step="open page.html")
    assert summary_text(plain).endswith("next: open page.html")


def test_sentences() -> None:
    assert sentence("all is well") == "All is well."
    assert sentence("Done.") == "Done."
    assert sentence("") == ""
    assert sentence("is it the same board?") == "Is it the same board?"
    assert sentence("well-known") == "Well-known."


def test_names_at_the_start_of_a_sentence_stay_as_they_are() -> None:
    assert sentence("left03copy.png repeats left03.png") == "left03copy.png repeats left03.png."
    assert sentence("left.png: residuals are large") == "left.png: residuals are large."
    assert sentence("part-s: 3 points are beside it") == "part-s: 3 points are beside it."
    assert sentence("k1k2 without hold-out") == "k1k2 without hold-out."


def summary() -> Summary:
    return Summary(
        title="Done.",
        quantities=(Quantity("n_points", "points", 12), fact("path", "a\nb")),
        tables=(
            Table(("name", "rms", "why"), (("a", "1.0", "x"), ("long", "12.0", "")), "T", (2,)),
        ),
        warnings=("Careful.",),
        written=(Path("out") / "c.json",),
        next_step="look",
        extra={"rms": math.nan, "list": (1, 2.5, math.inf), "nested": {"path": "ü"}},
    )


def test_text_is_aligned() -> None:
    assert summary_text(summary()).splitlines() == [
        "Done.",
        "  points  12",
        "  path    a",
        "          b",
        "",
        "  T",
        "  name   rms  why",
        "  a      1.0  x",
        "  long  12.0",
        "",
        "warning: Careful.",
        "",
        f"wrote {Path('out') / 'c.json'}",
        "next: look",
    ]


def test_json_is_strict_and_says_null_for_what_is_not_known() -> None:
    text = summary_json(summary())
    assert json.loads(text, parse_constant=pytest.fail) == {
        "n_points": 12,
        "rms": None,
        "list": [1, 2.5, None],
        "nested": {"path": "ü"},
        "forced": [],
        "warnings": ["Careful."],
        "written": ["out/c.json"],
    }


def test_one_quantity_feeds_people_and_programs() -> None:
    length = Quantity("fitted.length_mm", "Length", 1.5, 0.012, "mm", "at 20 degrees")
    unknown = Quantity("hold_out_px", "", None)
    assert (length.text, length.line) == ("1.500 ± 0.012 mm", "1.500 ± 0.012 mm, at 20 degrees")
    assert Quantity("n", "Points", 12345).text == "12,345"
    assert Quantity("rms", "Rms", 0.0123456, unit="px").text == "0.0123 px"
    assert values((length, fact("Only", "words"), unknown)) == {
        "fitted": {"length_mm": 1.5},
        "hold_out_px": None,
    }
    told = (length, fact("Only", "words"), unknown)
    assert [item.label for item in for_people(told)] == ["Length", "Only"]
    assert values(for_people(told)) == {}
    assert only(told, "hold_out_px", "fitted.length_mm", "absent") == (unknown, length)
    done = Summary(title="Done.", quantities=told)
    assert "± is one standard deviation" in summary_text(done)
    assert done.data["fitted"] == {"length_mm": 1.5}


@pytest.mark.parametrize(("n", "told"), [(1, "(one pair)"), (3, "(median of 3 pairs; at most")])
def test_one_pair_of_passes_has_no_median(n: int, told: str) -> None:
    pairs = tuple(PassPair(0, k + 1, 0.02, 1.0) for k in range(n))
    found = PassAgreement(
        pairs=pairs,
        n_points=900,
        agreeing=0.99,
        distance_mm=0.02,
        worst_mm=0.02,
        claimed_mm=0.02,
        ratio=1.0,
        worst_ratio=1.0,
    )
    assert told in passes_text(found)
