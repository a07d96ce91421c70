# SPDX-License-Identifier: Apache-2.0
"""The second tutorial's commands on its real robot data: what they end with is what it shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from armscan.cli import main
from rigs.photographs import DATA, needs

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "02-hand-eye-on-real-robot-data.md"
pytestmark = needs("sphere_profiles")


def steps() -> list[tuple[list[str], str]]:
    """Each command on the robot's data with the output that the page shows for it."""
    page = PAGE.read_text().partition("## The same on a simulated arm")[0]
    texts = re.findall(r"^```\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    found = []
    for text, shown in zip(texts, [*texts[1:], ""], strict=True):
        if text.startswith("armscan calibrate"):
            line = text.replace("\\\n", " ").replace("$ARMSCAN_DATA", str(DATA))
            found.append((shlex.split(line)[1:], shown))
    return found


def words_of(text: str) -> list[str]:
    return text.replace(str(DATA), "~/profiles").split()


def test_the_commands_end_as_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(steps()) == 3
    for words, shown in steps():
        is_refused = shown.startswith("error:")
        assert main(words) == (2 if is_refused else 0)
        said = capsys.readouterr()
        if is_refused:
            # last digits of numbers differ between versions of the linear algebra
            assert words_of(said.err)[:6] == words_of(shown)[:6]
        else:
            origin = next(line for line in shown.splitlines() if "Origin of Sensor" in line)
            assert origin.split()[:5] == next(
                line.split()[:5] for line in said.out.splitlines() if "Origin of Sensor" in line
            )
    refused = ["board.refused.html", "wrong.refused.html"]
    found = sorted(path.name for path in tmp_path.iterdir())
    assert found == sorted([*refused, "scanner.html", "scanner.json", "scanner.npz"])
