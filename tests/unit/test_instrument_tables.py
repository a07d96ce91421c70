# SPDX-License-Identifier: Apache-2.0
"""How wrong results of drawn instruments are counted: warned of, or silently."""

from __future__ import annotations

import pytest

from rigs.instrument_stages import FEW_BOARDS
from rigs.instrument_tables import (
    RESULTS,
    Row,
    answered,
    by_stage,
    certainty,
    of_result,
    print_outcomes,
    print_silent,
    share_limits,
)


def row(seed: int, result: str, *warnings: str) -> Row:
    outcome = {"stage": "camera", "result": result, "warnings": warnings, "reason": ""}
    return {"seed": seed, "outcomes": [outcome]}


def counts(rows: list[Row]) -> dict[str, int]:
    pairs = by_stage(rows)["camera"]
    return {result: len(of_result(pairs, result)) for result in RESULTS}


SOUND = [row(k, "right", *(["only 5 views"] if k < 10 else [])) for k in range(20)]


def test_a_warning_that_few_sound_results_have_bears_on_a_wrong_one() -> None:
    said = [row(20, "wrong", "residuals of one view are alike: widened by 2.9")]
    assert counts([*SOUND, *said])["wrong, warned"] == 1


def test_what_is_said_to_half_of_all_sound_results_is_no_warning() -> None:
    """Whatever its number: "only 7 views" is of one kind with "only 5 views"."""
    found = counts([*SOUND, row(20, "wrong", "only 7 views"), row(21, "wrong")])
    assert found["silently wrong"] == 2
    assert found["wrong, warned"] == 0
    assert found["right"] == 20


def test_one_in_ten_is_the_limit() -> None:
    twice = [row(k, "right", *(["weak arc"] if k < 2 else [])) for k in range(20)]
    thrice = [row(k, "right", *(["weak arc"] if k < 3 else [])) for k in range(20)]
    wrong = row(20, "wrong", "weak arc")
    assert counts([*twice, wrong])["wrong, warned"] == 1
    assert counts([*thrice, wrong])["silently wrong"] == 1


def test_a_warning_of_another_stage_does_not_count() -> None:
    sheet = {"stage": "sheet", "result": "wrong", "warnings": (), "reason": ""}
    rows = [{"seed": 1, "outcomes": [row(1, "right", "a bent board")["outcomes"][0], sheet]}]
    assert len(of_result(by_stage(rows)["sheet"], "silently wrong")) == 1


def test_limits_of_shares_are_those_of_tables() -> None:
    """Clopper and Pearson 1934: 0 of 20 and 3 of 20, 95 % two-sided."""
    assert share_limits(0, 20) == pytest.approx((0.0, 0.1684), abs=1e-4)
    assert share_limits(3, 20) == pytest.approx((0.0321, 0.3789), abs=1e-4)
    assert share_limits(20, 20) == pytest.approx((0.8316, 1.0), abs=1e-4)


def test_certainty_weighs_by_degrees_of_freedom() -> None:
    mean, error = certainty([{"chi2": 9.0, "freedom": 9}, {"chi2": 9.0, "freedom": 3}])
    assert mean == 1.5
    assert error == pytest.approx((4.5**2 + 4.5**2) ** 0.5 / 12.0)


def test_what_is_silently_wrong_is_told_of_the_answers_given_too(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Refusals give no answer: one of 20 judged is one of four answers. Limits from tables."""
    refused = [row(k, "rightly refused") for k in range(10)]
    refused += [row(k, FEW_BOARDS) for k in range(10, 14)]
    refused += [row(k, "wrongly refused") for k in range(14, 16)]
    given = [row(k, "right") for k in range(16, 19)] + [row(19, "wrong")]
    found = by_stage([*refused, *given])
    assert len(answered(found["camera"])) == 4
    print_silent(found)
    said = capsys.readouterr().out
    judged = "1 of 20: 5.00 % (95 %: 0.13 to 24.87 %)"
    answers = "1 of 4: 25.00 % (95 %: 0.63 to 80.59 %)"
    assert f"| camera | {judged} | {answers} |" in said
    assert f"| all | {judged} | {answers} |" in said


def test_a_line_on_fewer_than_two_boards_has_a_column_of_its_own(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = [row(1, FEW_BOARDS), row(2, "rightly refused"), row(3, "rightly refused")]
    for one in rows:
        one["outcomes"][0]["freedom"] = 0
    print_outcomes(by_stage(rows))
    table = [line.split("|") for line in capsys.readouterr().out.splitlines() if "|" in line]
    assert len({len(line) for line in table}) == 1
    named = dict(zip((cell.strip() for cell in table[0]), table[2], strict=True))
    assert named[FEW_BOARDS].strip() == "1"
    assert named["rightly refused"].strip() == "2"
